"""The whole way from a recording to the marker table, and the command, on small rendered flights."""

import json
import sys

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import typer

from capture.console import run
from capture.errors import ProcessError
from process.markers_command import markers as markers_command
from process.pipeline import PipelineSettings, blocks, markers
from process.recording import open_recording
from process.shared_error import sides_of
from process.tables import MARKER_SCHEMA, read_table, table_provenance, write_table

START_NS = 1_700_000_000_123_456_789
PERIOD_NS = 40_000_000
TRIGGERS = (48, 49, 50, 51)  # across a cut between blocks


def curvature(trigger: int) -> float:
    return 0.1 + 0.004 * (trigger - 48)


@pytest.fixture(scope="session")
def flight(tmp_path_factory, small_world, request):
    """Two sides, four triggers at half the size; left/cam1 of trigger 49 lost, one light of the right wing out."""
    conftest = sys.modules[type(small_world).__module__]
    folder = tmp_path_factory.mktemp("flight")
    for side in ("left", "right"):
        writer = conftest.RecordingWriter(folder / f"disk_{side}" / f"{side}_0000.mcap")
        for trigger in TRIGGERS:
            points_m = small_world.markers_m(side, curvature(trigger))
            for camera, pixels in enumerate(small_world.project(side, points_m)):
                if (side, trigger, camera) == ("left", 49, 1):
                    continue
                canvas = conftest.SpotPainter(776, 1040, seed=1000 * trigger + 10 * camera + len(side))
                for marker, (u, v) in enumerate(pixels):
                    if (side, marker) != ("right", 5):
                        canvas.add(u, v, 0.6, 0.7, 140)
                at_ns = START_NS + trigger * PERIOD_NS + camera * 2000
                writer.frame(side, f"cam{camera}", trigger, canvas.image(), at_ns)
        writer.close()
    return folder


@pytest.fixture(scope="session")
def result(flight, small_world):
    return markers([flight], small_world.rig, workers=1)


def column(table, name):
    return table.column(name).to_numpy(zero_copy_only=False)


def assert_same(one, other):
    """Equal to the bit, NaN being equal to NaN."""
    assert one.schema.equals(other.schema)
    for name in one.column_names:
        np.testing.assert_array_equal(column(one, name), column(other, name))


def test_one_row_for_each_marker_trigger_and_side(result):
    table = result.table
    assert table.schema.equals(MARKER_SCHEMA)
    keys = list(zip(*(column(table, n) for n in ("side", "trigger_index", "marker")), strict=True))
    assert keys == [(s, t, m) for s in ("left", "right") for t in TRIGGERS for m in range(18)]
    assert result.frame_sets == 8
    assert result.problems == ("left/cam1: 1 of 4 frames are missing (1 without a reason)",)


def test_markers_are_where_the_wing_is(result, small_world):
    table = result.table
    xyz = np.stack([column(table, f"{a}_m") for a in "xyz"], axis=1)
    truth = np.concatenate(
        [small_world.markers_m(s, curvature(t)) for s in ("left", "right") for t in TRIGGERS], axis=0
    )
    seen = np.isfinite(xyz[:, 0])
    lost = (column(table, "side") == "left") & (column(table, "trigger_index") == 49)
    out = (column(table, "side") == "right") & (column(table, "marker") == 5)
    np.testing.assert_array_equal(seen, ~(lost | out))
    flags = column(table, "flags")
    assert set(flags[lost]) == {"no_frame"}
    assert set(flags[out]) == {"not_seen"}
    assert set(flags[seen]) == {""}
    error = (xyz - truth)[seen]
    cov = np.zeros((len(error), 3, 3))
    for k, a in enumerate("xyz"):
        for m, b in enumerate("xyz"):
            cov[:, k, m] = column(table, f"cov_{min(a, b)}{max(a, b)}_m2")[seen]
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error)
    # 3 degrees of freedom each; a dozen spots overlap with others, whose light the fit takes out but imperfectly
    assert 2.0 < np.mean(nees) < 4.5
    assert np.sqrt((error**2).sum(axis=1)).max() < 0.004
    assert np.sqrt(np.mean(column(table, "epipolar_px")[seen] ** 2)) < 0.04


def test_a_marker_has_its_rows_time(result, small_world):
    table = result.table
    row_time_ns = 10_000  # as recorded, not the rig's
    for k in np.flatnonzero(np.isfinite(column(table, "x_m")))[::7]:
        trigger = int(column(table, "trigger_index")[k])
        # mid-exposure of row 0 is 1 ms after the start; cam1 opens 2 µs after cam0
        row0_ns = START_NS + trigger * PERIOD_NS + 1_000_000 + 1_000
        rows = (column(table, "v0_px")[k] + column(table, "v1_px")[k]) / 2
        assert abs(int(column(table, "timestamp_ns")[k]) - row0_ns - rows * row_time_ns) <= 1.0
        assert int(column(table, "frame_timestamp_ns")[k]) - row0_ns == 775 * row_time_ns // 2
    lost = np.flatnonzero(column(table, "flags") == "no_frame")
    assert (column(table, "timestamp_ns")[lost] == column(table, "frame_timestamp_ns")[lost]).all()
    assert int(column(table, "frame_timestamp_ns")[lost[0]]) == START_NS + 49 * PERIOD_NS + 1_000_000 + 3_875_000


@pytest.mark.slow
def test_the_table_does_not_depend_on_the_number_of_workers(flight, small_world, result):
    assert_same(markers([flight], small_world.rig, workers=3).table, result.table)


def test_a_light_that_one_camera_saw(tmp_path, small_world, recording_writer, painter):
    """It has that camera's pixels, their covariance and its row's time, but no place."""
    writer = recording_writer(tmp_path / "right.mcap")
    truth = {}
    for trigger in range(3):
        for camera, pixels in enumerate(
            small_world.project("right", small_world.markers_m("right", curvature(trigger)))
        ):
            truth[trigger, camera] = pixels
            canvas = painter(776, 1040, seed=10 * trigger + camera)
            for marker, (u, v) in enumerate(pixels):
                if (trigger, camera, marker) != (2, 1, 6):
                    canvas.add(u, v, 0.6, 0.7, 140)
            writer.frame("right", f"cam{camera}", trigger, canvas.image(), START_NS + trigger * PERIOD_NS)
    writer.close()
    rows = markers([tmp_path], small_world.rig, workers=1).table.to_pylist()
    (row,) = [one for one in rows if one["flags"]]
    assert (row["trigger_index"], row["marker"], row["flags"]) == (2, 6, "one_camera")
    assert np.hypot(*(np.array([row["u0_px"], row["v0_px"]]) - truth[2, 0][6])) < 0.1
    assert 0 < row["cov_uu0_px2"] < 0.01
    assert np.isnan([row["x_m"], row["cov_xx_m2"], row["u1_px"], row["v1_px"], row["cov_vv1_px2"]]).all()
    row0_ns = START_NS + 2 * PERIOD_NS + 1_000_000
    assert abs(row["timestamp0_ns"] - row0_ns - row["v0_px"] * 10_000) <= 1
    assert row["timestamp_ns"] == row["timestamp0_ns"]
    assert row["timestamp1_ns"] == row["frame_timestamp_ns"]
    both = rows[0]
    assert abs((both["timestamp0_ns"] + both["timestamp1_ns"]) / 2 - both["timestamp_ns"]) <= 1


def test_progress_reaches_the_end(flight, small_world):
    calls = []
    markers([flight], small_world.rig, progress=lambda done, total: calls.append((done, total)), workers=1)
    assert calls == [(2, 8), (4, 8), (6, 8), (8, 8)]


def test_papers_methods_run_through(flight, small_world):
    from process.detect import DetectSettings
    from process.match import MatchSettings

    settings = PipelineSettings(DetectSettings(method="paper"), MatchSettings(method="rows"), "paper")
    table = markers([flight], small_world.rig, settings, workers=1).table
    assert table.num_rows == 8 * 18


def test_images_of_the_wrong_size_are_refused(flight, world):
    with pytest.raises(ProcessError, match="1040 × 776, the rig was calibrated at 2080 × 1552"):
        markers([flight], world.rig, workers=1)


def test_a_recording_of_images_only_uses_the_stamps_and_the_rigs_row_time(tmp_path, small_world, recording_writer):
    writer = recording_writer(tmp_path / "bag.mcap")
    for trigger in range(2):
        for camera in range(2):
            image = np.zeros((776, 1040), np.uint8)
            writer.frame("left", f"cam{camera}", trigger, image, START_NS + trigger * PERIOD_NS, meta=False)
    writer.close()
    table = markers([tmp_path], small_world.rig, workers=1).table
    assert set(column(table, "flags")) == {"not_seen"}
    expected = START_NS + 1_000_000 + round(775 / 2 * small_world.rig.left.row_time_ns)
    assert column(table, "frame_timestamp_ns")[0] == expected


def call(*arguments) -> int:
    app = typer.Typer(add_completion=False)
    app.command()(markers_command)
    before = sys.argv
    sys.argv = ["wingproc", *map(str, arguments)]
    try:
        run(app)
    except SystemExit as stop:
        return int(stop.code or 0)
    finally:
        sys.argv = before


def test_the_command(flight, small_world, tmp_path, capsys):
    rig_path = tmp_path / "rig.json"
    small_world.rig.write(rig_path)
    out = tmp_path / "markers.parquet"
    assert call(flight, "--rig", rig_path, "-o", out, "--workers", 1, "--json") == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["frame_sets"] == 8
    assert summary["markers_seen"] == 7 * 18 - 4
    assert summary["flags"] == {"no_frame": 18, "not_seen": 4}
    table = read_table(out, MARKER_SCHEMA)
    note = table_provenance(table)
    assert "--rig" in note["command"]
    assert list(note["inputs"]) == [str(rig_path)]
    assert call(flight, "--rig", rig_path, "-o", out, "--workers", 1) == 0
    said = capsys.readouterr()
    assert "markers seen" in said.out
    assert "left/cam1: 1 of 4 frames" in said.err


def test_the_command_fails_in_one_line(flight, small_world, tmp_path, capsys):
    rig_path = tmp_path / "rig.json"
    small_world.rig.write(rig_path)
    out = tmp_path / "m.parquet"
    (tmp_path / "empty").mkdir()
    for arguments, names, code in (
        ((flight, "--rig", tmp_path / "no.json", "-o", out), "no.json", 1),
        ((tmp_path / "empty", "--rig", rig_path, "-o", out), "empty", 1),
        ((flight, "--rig", rig_path, "-o", tmp_path / "no" / "m.parquet"), "no", 1),
        ((flight, "--rig", rig_path, "-o", rig_path), "rig.json", 2),
        ((flight, "--rig", rig_path, "-o", out, "--detection", "best"), "best", 2),
        ((flight, "-o", out), "--rig", 2),
    ):
        assert call(*arguments) == code
        error = capsys.readouterr().err.strip()
        assert names in error
        assert "Traceback" not in error
        assert "\n" not in error or "Usage:" in error
    assert not out.exists()


def test_tables_survive_the_round_trip_and_bad_ones_are_named(result, tmp_path):
    path = tmp_path / "sub" / "markers.parquet"
    write_table(result.table, path, command="me", inputs=[])
    assert_same(read_table(path, MARKER_SCHEMA), result.table)
    assert pq.read_schema(path).metadata[b"wingshape"]
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    for bad, says in ((path, "not a whole Parquet"), (tmp_path / "none.parquet", "no such file")):
        with pytest.raises(ProcessError, match=says) as caught:
            read_table(bad, MARKER_SCHEMA)
        assert str(bad) in str(caught.value)
        assert "\n" not in str(caught.value)
    write_table(result.table.drop_columns(["x_m"]), path, command="me")
    with pytest.raises(ProcessError, match="column x_m is missing"):
        read_table(path, MARKER_SCHEMA)
    wrong = result.table.set_column(0, "trigger_index", pa.array(["a"] * result.table.num_rows))
    write_table(wrong, path, command="me")
    with pytest.raises(ProcessError, match=r"markers\.parquet: "):
        read_table(path, MARKER_SCHEMA)
    lean = result.table.drop_columns(["cov_xx_m2", "u0_px", "flags"])
    write_table(lean, path, command="me")
    assert read_table(path, MARKER_SCHEMA, truth=True).num_columns == len(MARKER_SCHEMA) - 3


def test_a_block_ends_where_the_trigger_number_says(flight):
    cut = [(b.side, [places.trigger_index for places in b.places]) for b in blocks(open_recording([flight]))]
    assert cut == [("left", [48, 49]), ("right", [48, 49]), ("left", [50, 51]), ("right", [50, 51])]


def test_the_commands_table_carries_the_rig(flight, small_world, tmp_path, capsys):
    rig_path, out = tmp_path / "rig.json", tmp_path / "markers.parquet"
    small_world.rig.write(rig_path)
    assert call(flight, "--rig", rig_path, "-o", out, "--workers", 1, "--json") == 0
    capsys.readouterr()
    sides = sides_of(read_table(out, MARKER_SCHEMA))
    np.testing.assert_array_equal(sides["right"].T_body_cam0, small_world.rig.right.T_body_cam0)
