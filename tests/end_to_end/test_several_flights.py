"""`reconstruct` of several flights in one call: a folder each, and one that fails does not stop the others."""

import json
import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from needs import needs_module
from rendered_flight import true_rig, write_flight

from hw_sim.demo import executable
from hw_sim.world import World
from reconstruct.wing import example_path

SCALE, SECONDS = 8, 2.0
NAMES = ("monday", "tuesday", "wednesday")


@pytest.fixture(scope="module")
def week(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three flights of one aircraft, rig and wing; of Tuesday's, nothing can be read, of Wednesday's, a part."""
    folder = tmp_path_factory.mktemp("week")
    world = World.make(5, SCALE)
    for number, name in enumerate(NAMES):
        write_flight(replace(world, epoch_ns=world.epoch_ns + number * 3_600_000_000_000), folder / name, SECONDS)
    for side in ("left", "right"):
        os.truncate(folder / f"tuesday/ssd_{side}/{side}_0000.mcap", 2000)
    with (folder / "wednesday/ssd_left/left_0000.mcap").open("r+b") as file:
        file.seek(1_000_000)
        file.write(bytes(200_000))
    true_rig(world).write(folder / "rig.json")
    shutil.copyfile(example_path("xhale.toml"), folder / "wing.toml")
    return folder


def reconstruct(week: Path, out: Path, *words: object) -> subprocess.CompletedProcess[str]:
    fixed = (
        "--rig",
        week / "rig.json",
        "--wing",
        week / "wing.toml",
        "-o",
        out,
        "--no-report",
        "--no-mat",
        "--no-mcap",
    )
    command = [executable("reconstruct"), "run", *map(str, (*fixed, *words))]
    return subprocess.run(command, cwd=week, capture_output=True, text=True, timeout=200)


@pytest.fixture(scope="module")
def result(week: Path) -> tuple[subprocess.CompletedProcess[str], Path]:
    return reconstruct(week, week / "results", *NAMES, "--workers", 2), week / "results"


def same(one: Path, other: Path) -> bool:
    """Whether two tables are equal; at this size some markers are not seen, and NaN."""
    return bool(pq.read_table(one).to_pandas().equals(pq.read_table(other).to_pandas()))


def test_each_gets_its_folder_and_the_damaged_one_a_reason(result, week):
    done, out = result
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert done.stderr.strip().splitlines()[-1].startswith("error: 1 of 3 flights failed (tuesday)")
    ledger = json.loads((out / "flights.json").read_text())
    assert [(entry["flight"], entry["state"]) for entry in ledger["flights"]] == [
        ("monday", "done"),
        ("tuesday", "failed"),
        ("wednesday", "done"),
    ]
    assert ledger["failed"] == 1
    assert "tuesday/ssd_left" in ledger["flights"][1]["error"]
    assert json.loads((out / "monday/summary.json").read_text())["sets_without_shape"] == 0
    assert json.loads((out / "wednesday/summary.json").read_text())["sets_without_shape"] > 0
    table = [line.split() for line in done.stdout.splitlines()[:4]]
    assert [line[0] for line in table] == ["flight", *NAMES]
    assert table[1][1:3] == ["100", "100.00"]  # sets of both wings
    assert table[2][1] == "failed:"


def test_each_is_what_it_is_alone(result, week, tmp_path):
    _, out = result
    assert reconstruct(week, tmp_path / "alone", "monday", "--workers", 1).returncode == 0
    for name in ("markers", "shape", "frames", "loads", "residuals", "unloaded"):
        assert same(out / f"monday/{name}.parquet", tmp_path / f"alone/{name}.parquet"), name


@pytest.mark.slow
def test_run_again_it_keeps_what_is_done(result, week, tmp_path):
    """Unless other files are asked for."""
    out = tmp_path / "results"
    shutil.copytree(result[1], out)
    before = (out / "monday/shape.parquet").stat().st_mtime_ns
    again = reconstruct(week, out, *NAMES, "--json")
    assert again.returncode == 1
    assert [entry["state"] for entry in json.loads(again.stdout)["flights"]] == ["kept", "failed", "kept"]
    assert (out / "monday/shape.parquet").stat().st_mtime_ns == before
    assert reconstruct(week, out, "monday", "wednesday", "--no-csv").returncode == 0
    assert {entry["state"] for entry in json.loads((out / "flights.json").read_text())["flights"]} == {"done"}


@pytest.mark.slow
def test_by_a_cluster(result, week, tmp_path):
    needs_module("distributed")
    done = reconstruct(week, tmp_path / "dask", *NAMES, "--scheduler", "local", "--workers", 2)
    assert done.returncode == 1
    for name in ("monday", "wednesday"):
        assert same(result[1] / name / "shape.parquet", tmp_path / "dask" / name / "shape.parquet")


def test_what_concerns_all_is_refused_at_once(week, tmp_path):
    (week / "bad.toml").write_text("name = 1\n")
    done = reconstruct(week, tmp_path / "out", "monday", "wednesday", "--wing", "bad.toml")
    assert done.returncode == 2
    assert "bad.toml" in done.stderr
    assert not (tmp_path / "out").exists()
