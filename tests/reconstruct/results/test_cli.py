"""The command as a user meets it: exit codes, one-line errors, files."""

import io
import json
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from reconstruct.cli import main
from reconstruct.result_tables import result_tables
from reconstruct.series import fit_series
from reconstruct.tables import marker_series
from reconstruct.wing import read_wing


@dataclass(frozen=True)
class Done:
    """What a shell sees of a command."""

    returncode: int
    stdout: str
    stderr: str


def reconstruct(*arguments: object) -> Done:
    """Run the command's entry point in this process."""
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        patch.setattr(sys, "argv", ["reconstruct", *map(str, arguments)])
        with pytest.raises(SystemExit) as stop:
            main()
    return Done(stop.value.code if isinstance(stop.value.code, int) else 0, out.getvalue(), err.getvalue())


def error_line(done: Done, code: int) -> str:
    """The one line that a failed command says."""
    assert done.returncode == code, done.stderr
    assert done.stdout == ""
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("error: ")
    return lines[0]


@pytest.fixture(scope="module")
def table(bending_wing: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("cli") / "markers.parquet"
    pq.write_table(bending_wing().marker_table(np.arange(6) * 0.04, sigma_m=0.001, missing=0.05), path)
    return path


@pytest.fixture(scope="module")
def out(table: Path, wing_file: Path) -> Path:
    """A result made by the command in its own process, without naming `run`."""
    folder = table.parent / "deep" / "out"
    line = [sys.executable, "-W", "error", "-c", "from reconstruct.cli import main; main()"]
    line += [str(item) for item in (table, "--wing", wing_file, "-o", folder, "--workers", 1)]
    done = subprocess.run(line, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert done.stdout.splitlines()[-1].split() == ["report", str(folder / "report.html")]
    return folder


def test_files_of_a_run(out: Path, table: Path, wing_file: Path) -> None:
    names = {path.name for path in out.iterdir()}
    tables = {"markers", "shape", "frames", "loads", "residuals"}
    assert names == {f"{name}.{kind}" for name in tables for kind in ("parquet", "csv")} | {
        "unloaded.parquet",
        "result.mat",
        "wing.mcap",
        "wing.mp4",
        "summary.json",
        "report.html",
        "figures",
    }
    expected = result_tables(fit_series(marker_series(pq.read_table(table), "made"), read_wing(wing_file), workers=1))
    for name, content in expected.items():
        assert pq.read_table(out / name).column_names == content.column_names
        assert pq.read_table(out / name).num_rows == content.num_rows
        note = json.loads(pq.read_schema(out / name).metadata[b"wingshape"])
        assert "reconstruct" in note["command"] or "-c" in note["command"]
        assert len(note["inputs"]) == 2
    frames = pq.read_table(out / "frames.parquet").to_pydict()
    assert np.allclose(frames["tip_dz_m"], expected["frames.parquet"].to_pydict()["tip_dz_m"], atol=1e-9)
    assert (out / "frames.csv").read_text().count("\n") == 13


def test_summary(out: Path) -> None:
    summary = json.loads((out / "summary.json").read_text())
    assert summary["sets"] == 12
    assert summary["triggers"] == 6
    assert summary["converged_percent"] == 100.0
    # 5 % of 216 markers are missing: ± 3 sigma = 3 × 1.5 %
    assert summary["markers_seen_percent"] == pytest.approx(95.0, abs=4.5)
    assert summary["residual_rms_mm"] == pytest.approx(1.7, abs=0.4)  # √3 mm, less what 18 markers' fit takes up
    timing = summary["timing_s"]
    assert set(timing) == {"start", "markers", "fit", "tables", "formats", "report", "animation"}
    assert summary["wall_s"] == pytest.approx(timing["markers"] + timing["fit"] + timing["tables"], abs=1e-6)
    assert set(summary["by_side"]) == {"left", "right"}


def test_compare_and_report(out: Path, bending_wing: Any, tmp_path: Path) -> None:
    truth = bending_wing().reference(tmp_path / "truth", np.arange(-0.1, 0.4, 0.01))
    done = reconstruct("compare", out, truth, "-o", tmp_path / "compared", "--json")
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    written = json.loads((tmp_path / "compared" / "comparison.json").read_text())
    for key in ("marker_rms_mm", "shape_rms_mm", "tip_error_mm", "twist_rms_deg", "frames_compared"):
        assert said[key] == written[key]
    assert said["frames_compared"] == 12
    assert said["marker_rms_mm"] == pytest.approx(np.sqrt(3), rel=0.15)
    assert "Error against the reference" in (tmp_path / "compared" / "report.html").read_text()
    assert "Error against the reference" not in (out / "report.html").read_text()
    again = reconstruct("report", out, "--compare", tmp_path / "compared" / "comparison.json")
    assert again.returncode == 0, again.stderr
    assert "Error against the reference" in (out / "report.html").read_text()


@pytest.mark.slow
def test_a_result_is_a_reference_too(out: Path, tmp_path: Path) -> None:
    done = reconstruct("compare", out, out, "-o", tmp_path / "compared", "--json")
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert said["frames_compared"] == 12
    assert said["shape_rms_mm"] < 1e-6
    assert said["marker_rms_mm"] < 1e-6


def test_example_is_a_wing_file(tmp_path: Path) -> None:
    done = reconstruct("example", "xhale", "-o", tmp_path / "wing.toml")
    assert done.returncode == 0, done.stderr
    assert read_wing(tmp_path / "wing.toml").left.marker_ids.size == 18
    assert "xhale" in error_line(reconstruct("example", "albatross", "-o", tmp_path / "other.toml"), 2)


def test_help_lists_the_commands() -> None:
    done = reconstruct("--help")
    assert done.returncode == 0
    for name in ("run", "compare", "report", "static", "example"):
        assert f" {name} " in done.stdout


class TestErrors:
    def test_nothing_given(self, wing_file: Path) -> None:
        line = error_line(reconstruct("run", "--wing", wing_file, "-o", "out"), 2)
        assert "--markers" in line

    def test_a_flight_that_is_not_there(self, wing_file: Path) -> None:
        line = error_line(reconstruct("comapre", "--wing", wing_file, "-o", "out"), 2)
        assert "comapre: no such flight folder (nor a command" in line

    def test_frames_without_a_rig(self, wing_file: Path, tmp_path: Path) -> None:
        assert "--rig" in error_line(reconstruct(tmp_path, "--wing", wing_file, "-o", tmp_path / "out"), 2)

    @pytest.mark.parametrize("option", ["--rig", "--wing", "--markers"])
    def test_a_missing_file_is_named(self, wing_file: Path, tmp_path: Path, option: str) -> None:
        files: dict[str, Path] = {"--rig": wing_file, "--wing": wing_file, "--markers": wing_file}
        files[option] = tmp_path / "gone"
        flight = [] if option == "--markers" else [tmp_path]
        given = {key: value for key, value in files.items() if not (flight and key == "--markers")}
        arguments = [item for pair in given.items() for item in pair]
        line = error_line(reconstruct("run", *flight, *arguments, "-o", tmp_path / "out"), 2)
        assert f"{tmp_path / 'gone'}: no such file; give {option}" in line
        assert not (tmp_path / "out").exists()

    def test_a_rig_that_is_none(self, wing_file: Path, tmp_path: Path) -> None:
        done = reconstruct(tmp_path, "--rig", wing_file, "--wing", wing_file, "-o", tmp_path / "out")
        assert str(wing_file) in error_line(done, 1)

    def test_a_table_that_is_none(self, wing_file: Path, tmp_path: Path) -> None:
        (tmp_path / "markers.parquet").write_text("not a table")
        done = reconstruct(tmp_path / "markers.parquet", "--wing", wing_file, "-o", tmp_path / "out")
        assert "not a readable Parquet file" in error_line(done, 2)

    def test_a_table_with_other_columns(self, wing_file: Path, tmp_path: Path) -> None:
        pq.write_table(pa.table({"side": ["left"], "trigger_index": [1]}), tmp_path / "markers.parquet")
        done = reconstruct("--markers", tmp_path / "markers.parquet", "--wing", wing_file, "-o", tmp_path / "out")
        assert "lacks the columns marker, timestamp_ns, frame_timestamp_ns, x_m" in error_line(done, 2)

    def test_all_markers_missing(self, bending_wing: Any, wing_file: Path, tmp_path: Path) -> None:
        pq.write_table(bending_wing().marker_table(np.arange(3) * 0.04, missing=1.0), tmp_path / "markers.parquet")
        done = reconstruct(tmp_path / "markers.parquet", "--wing", wing_file, "-o", tmp_path / "out")
        assert "no marker was measured in any set" in error_line(done, 2)
        assert not (tmp_path / "out").exists()

    def test_an_empty_flight_folder(self, out: Path, wing_file: Path, tmp_path: Path) -> None:
        (tmp_path / "empty").mkdir()
        done = reconstruct("compare", out, tmp_path / "empty")
        assert "shape.parquet: no such table" in error_line(done, 2)
        done = reconstruct("report", tmp_path / "empty")
        assert "summary.json" in error_line(done, 2)

    def test_an_output_that_is_a_file(self, table: Path, wing_file: Path) -> None:
        assert "is a file" in error_line(reconstruct(table, "--wing", wing_file, "-o", wing_file), 2)

    def test_both_table_and_flight(self, table: Path, wing_file: Path, tmp_path: Path) -> None:
        done = reconstruct(tmp_path, "--markers", table, "--wing", wing_file, "-o", tmp_path / "out")
        assert "not both" in error_line(done, 2)


@pytest.mark.slow
def test_close_lights_a_reference_and_smoothing_are_named(bending_wing: Any, wing_file: Path, tmp_path: Path) -> None:
    """Lights 140 mm apart in the file are not 10: with 30 mm of noise they might as well be, and the report says so."""
    pq.write_table(bending_wing().marker_table(np.arange(8) * 0.04, sigma_m=0.03), tmp_path / "markers.parquet")
    described = wing_file.read_text() + '\nloads = "everywhere"\n'
    described += "[stiffness_sigma]\nGJ = 0.1\nEI_out = 0.1\n"
    (tmp_path / "wing.toml").write_text(described)
    arguments = ("run", tmp_path / "markers.parquet", "--wing", tmp_path / "wing.toml", "-o", tmp_path / "out")
    done = reconstruct(*arguments, "--reference-window", "0:0.2", "--smooth", "0.3", "--json", "--no-csv")
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["reference"] == "mean of 0 to 0.2 s"
    assert summary["smoothed_s"] == 0.3
    assert summary["warnings"][0].startswith("Twist is predicted from stiffness")
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Twist is predicted from stiffness" in page
    assert "displacements are from the mean of 0 to 0.2 s" in page
    shape = pq.read_table(tmp_path / "out" / "shape.parquet")
    assert {"curvature_out_1pm", "sigma_curvature_twist_1pm"} <= set(shape.column_names)
    told = error_line(reconstruct(*arguments, "--reference-window", "9:10"), 2)
    assert "no set of the" in told
    both = reconstruct(*arguments, "--reference-window", "0:1", "--reference", tmp_path)
    assert "not both" in error_line(both, 2)


@pytest.mark.slow
def test_stiffness_found_at_stations_is_in_the_report(bending_wing: Any, wing_file: Path, tmp_path: Path) -> None:
    pq.write_table(bending_wing().marker_table(np.arange(4) * 0.04, sigma_m=0.001), tmp_path / "markers.parquet")
    described = wing_file.read_text() + '\nloads = "stations"\n[stiffness_sigma]\nGJ = 0.1\nEI_out = 0.1\nEI_in = 0.1\n'
    (tmp_path / "wing.toml").write_text(described)
    done = reconstruct("run", tmp_path / "markers.parquet", "--wing", tmp_path / "wing.toml", "-o", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert 1 < summary["sigma_stiffness_percent"]["GJ"] < 11
    assert "GJ found, against the wing file" in (tmp_path / "out" / "report.html").read_text()
