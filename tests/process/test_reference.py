"""The at-rest shape: means and covariances against known places, and the refusals."""

import dataclasses
import json
import sys

import numpy as np
import pyarrow as pa
import pytest
from typer.testing import CliRunner

from capture.errors import ProcessError, UsageError
from process.cli import app
from process.recording import open_recording
from process.reference import Window, parse_window, rest_shape, within
from process.shared_error import point_covariance_m2, sides_of, with_rig
from process.tables import MARKER_SCHEMA, read_table, write_table

START_NS = 1_700_000_000_000_000_000
SIGMA_M = np.array([2e-4, 1e-3, 3e-4])


def marker_table(places, sets=200, seed=1, path_m=None, side="right"):
    """Markers at ``places`` (M, 3) with noise, 25 sets a second; ``path_m`` (sets, 3) is added to all."""
    rng = np.random.default_rng(seed)
    count = len(places)
    xyz = places + rng.normal(size=(sets, count, 3)) * SIGMA_M
    if path_m is not None:
        xyz = xyz + path_m[:, None]
    times = np.repeat(START_NS + np.arange(sets) * 40_000_000, count)
    columns = {
        "trigger_index": np.repeat(np.arange(sets), count),
        "side": np.full(sets * count, side),
        "marker": np.tile(np.arange(count), sets).astype(np.int32),
        "timestamp_ns": times,
        "frame_timestamp_ns": times,
        "time_sigma_ns": np.full(sets * count, 1000.0),
        "ptp_state": np.full(sets * count, "", dtype=object),
        **{f"{axis}_m": xyz[..., k].ravel() for k, axis in enumerate("xyz")},
        **{f"cov_{axes}_m2": np.zeros(sets * count) for axes in ("xy", "xz", "yz")},
        **{f"cov_{a}{a}_m2": np.full(sets * count, SIGMA_M[k] ** 2) for k, a in enumerate("xyz")},
        **{name: np.zeros(sets * count) for name in ("u0_px", "v0_px", "u1_px", "v1_px", "epipolar_px")},
        "flags": np.full(sets * count, "", dtype=object),
    }
    rows = len(columns["side"])
    columns |= {"time_sigma_ns": np.zeros(rows), "ptp_state": np.full(rows, "SLAVE")}
    schema = pa.schema([member for member in MARKER_SCHEMA if member.name in columns])
    return pa.table([pa.array(columns[m.name]) for m in schema], schema=schema)


def places_of(table):
    return np.stack([table.column(f"{axis}_m").to_numpy() for axis in "xyz"], axis=1)


def covariances_of(table, prefix="cov"):
    return np.stack([table.column(f"{prefix}_{a}{a}_m2").to_numpy() for a in "xyz"], axis=1)


def edited(table, **columns):
    for name, values in columns.items():
        at = table.column_names.index(name)
        table = table.set_column(at, table.schema.field(at), pa.array(values, type=table.schema.field(at).type))
    return table


def test_the_mean_is_as_good_as_it_says(world):
    truth = world.markers_m("right", 0.05)
    chi2 = []
    for seed in range(20):
        rest = rest_shape(marker_table(truth, seed=seed), Window(0.0, 4.0), 1e-3)
        assert rest.num_rows == 18
        assert set(rest.column("sets").to_pylist()) <= set(range(95, 101))
        chi2.append(np.sum((places_of(rest) - truth) ** 2 / covariances_of(rest)))
    # 54 degrees of freedom, 20 times; the covariance is never less than noise over the number, so below 54 on average
    assert 0.75 * 54 < np.mean(chi2) < 1.1 * 54


def test_outliers_and_doubtful_markers_do_not_matter(world):
    truth = world.markers_m("right", 0.05)
    table = marker_table(truth)
    rng = np.random.default_rng(5)
    z_m, flags = table.column("z_m").to_numpy().copy(), np.array(table.column("flags").to_pylist(), dtype=object)
    wild = rng.choice(len(z_m), len(z_m) // 10, replace=False)
    z_m[wild] += 0.05
    doubtful = rng.choice(len(z_m), len(z_m) // 10, replace=False)
    z_m[doubtful] += 0.001
    flags[doubtful] = "ambiguous"
    seen = np.ones(len(z_m), bool)
    seen[table.column("marker").to_numpy() == 7] = False
    z_m[~seen] = np.nan
    rest = rest_shape(edited(table, z_m=z_m, flags=flags), None, 1e-3)
    error = places_of(rest) - truth
    assert np.isnan(error[7]).all()
    assert rest.column("flags").to_pylist()[7] == "not_seen"
    others = np.delete(error, 7, axis=0)
    assert (np.abs(others) < 5 * SIGMA_M / np.sqrt(150)).all()


def test_what_moves_slowly_is_not_averaged_away(world):
    truth = world.markers_m("right", 0.05)
    time = np.arange(200) / 200
    path = np.stack([0 * time, 0 * time, 5e-4 * np.sin(2 * np.pi * 1.5 * time)], axis=1)
    still, breeze = (rest_shape(marker_table(truth, path_m=p), None, 1e-3) for p in (None, path))
    # each part's mean is off by the path: RMS 0.35 mm over ten parts, where noise alone gives 0.07 mm
    assert np.median(covariances_of(breeze)[:, 2] / covariances_of(still)[:, 2]) > 5
    moved = np.array(breeze.column("moved_m").to_pylist())
    assert np.abs(moved - path[:, 2].std()).max() < 1.5e-4
    with pytest.raises(ProcessError, match=r"not at rest: marker \d+ of the right wing moved by 3\.\d+ mm"):
        rest_shape(marker_table(truth, path_m=10 * path), None, 1e-3)


def test_the_shared_part_is_the_rigs(world):
    covariance = np.diag(np.array([0.3] * 4 + [1e-4] * 5 + [0.3] * 4 + [1e-4] * 5 + [1e-4] * 6) ** 2)
    pair = dataclasses.replace(world.rig.right.pair, covariance=covariance)
    side = dataclasses.replace(world.rig.right, pair=pair, pose_covariance=np.eye(6) * 1e-8)
    rig = dataclasses.replace(world.rig, right=side)
    truth = world.markers_m("right", 0.05)
    rest = rest_shape(with_rig(marker_table(truth), rig), None, 1e-3)
    said = point_covariance_m2(side, places_of(rest))
    np.testing.assert_allclose(covariances_of(rest, "shared"), np.diagonal(said, axis1=1, axis2=2), rtol=1e-9)
    assert "right" in sides_of(rest)
    unknown = rest_shape(marker_table(truth), None, 1e-3)
    assert np.isnan(covariances_of(unknown, "shared")).all()


def test_windows_that_cannot_be_used_are_refused(world):
    table = marker_table(world.markers_m("right", 0.05))
    with pytest.raises(ProcessError, match=r"right: 0 sets from 20 to 30 s, 5 are needed \(the recording has 0 to 8.0"):
        rest_shape(table, Window(20.0, 30.0), 1e-3)
    nothing = edited(table, x_m=np.full(table.num_rows, np.nan))
    with pytest.raises(ProcessError, match="no marker was seen"):
        rest_shape(nothing, None, 1e-3)
    with pytest.raises(ProcessError, match="no rows"):
        rest_shape(MARKER_SCHEMA.empty_table(), None, 1e-3)
    for text in ("5", "a:b", "3:1", "-1:2", "0:nan"):
        with pytest.raises(UsageError, match="--window"):
            parse_window(text, "--window")


@pytest.fixture(scope="module")
def flight(tmp_path_factory, small_world):
    """Twelve triggers of the right wing at half the size: six at rest, then bent."""
    conftest = sys.modules[type(small_world).__module__]
    folder = tmp_path_factory.mktemp("rest")
    writer = conftest.RecordingWriter(folder / "right_0000.mcap")
    for trigger in range(12):
        places = small_world.markers_m("right", 0.1 if trigger < 6 else 0.15)
        for camera, pixels in enumerate(small_world.project("right", places)):
            canvas = conftest.SpotPainter(776, 1040, seed=100 * trigger + camera)
            for u, v in pixels:
                canvas.add(u, v, 0.6, 0.7, 140)
            writer.frame("right", f"cam{camera}", trigger, canvas.image(), START_NS + trigger * 40_000_000)
    writer.close()
    return folder


def test_a_window_of_a_recording_is_cut_out(flight):
    recording = open_recording([flight])
    assert [s.trigger_index for s in within(recording, Window(0.04, 0.24)).sides["right"]] == [1, 2, 3, 4, 5]
    with pytest.raises(ProcessError, match=r"right: 1 sets from 0.42 to 2 s"):
        within(recording, Window(0.42, 2.0))


def test_the_command(flight, small_world, tmp_path):
    rig, out = tmp_path / "rig.json", tmp_path / "reference.parquet"
    small_world.rig.write(rig)
    options = ["--window", "0:0.24", "-o", str(out)]
    done = CliRunner().invoke(app, ["reference", str(flight), "--rig", str(rig), "--workers", "1", "--json", *options])
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)["right"]
    assert found["markers"] == 18
    assert found["sets"] == 6
    rest = read_table(out, MARKER_SCHEMA)
    # a dozen spots of this small picture overlap: see test_pipeline
    assert np.abs(places_of(rest) - small_world.markers_m("right", 0.1)).max() < 3e-3
    table = tmp_path / "markers.parquet"
    write_table(marker_table(small_world.markers_m("right", 0.1)), table, command="me")
    done = CliRunner().invoke(app, ["reference", str(table), "--window", "0:8", "-o", str(out)])
    assert done.exit_code == 0, done.output
    assert "18 markers, mean of up to 200 sets" in done.stdout
    for arguments, says in (
        ([str(flight), *options], "--rig"),
        ([str(table), str(table), *options], "stands alone"),
        ([str(table), "--window", "0:8", "-o", str(table)], "overwrite"),
        ([str(table), "--window", "0:8", "-o", str(tmp_path / "no" / "r.parquet")], "no such folder"),
    ):
        done = CliRunner().invoke(app, ["reference", *arguments])
        assert done.exit_code != 0
        assert says in str(done.exception)
