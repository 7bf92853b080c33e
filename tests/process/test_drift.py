"""Drift of cameras in flight, against cameras that were turned and pairs that were knocked by known amounts."""

import dataclasses

import numpy as np
import pyarrow as pa
import pytest

from process.camera_model import ReferenceLight, Rig, pose_matrix
from process.drift import drift, worst
from process.fuselage_lights import LIGHTS_SCHEMA, light_spots, lights_seen
from process.pipeline import markers
from process.tables import MARKER_SCHEMA
from process.triangulate import triangulate

NO_LIGHTS = LIGHTS_SCHEMA.empty_table()
START_NS = 1_700_000_000_000_000_000
LIGHTS_M = [
    [-0.2, 0.6, 0.15],
    [0.25, 0.7, 0.2],
    [-0.1, 0.9, -0.05],
    [0.3, 1.2, 0.3],
    [-0.3, 1.4, 0.1],
    [0.1, 1.0, 0.35],
]


def turned(world, turn_rad, pose=(0.0,) * 6):
    """The right side as it is once cam1 has turned and the pair has been knocked."""
    side = world.rig.right
    values = side.pair.parameters
    values[18:21] += turn_rad
    knocked = pose_matrix(pose[:3], pose[3:]) @ side.T_body_cam0
    return dataclasses.replace(side, pair=side.pair.with_parameters(values), T_body_cam0=knocked)


def seen_by(world, side, points):
    rig = Rig(world.rig.left, side, world.rig.markers)
    return dataclasses.replace(world, rig=rig).project("right", points)


def measured(world, pixels):
    eye = np.broadcast_to(np.eye(2), (len(pixels[0]), 2, 2))
    return triangulate(world.rig.right, *pixels, eye, eye, "default")


def flight_table(world, turns, sets=40, noise_px=0.02):
    """Ten seconds for each of ``turns`` (rad, about cam1's axes): the wing beats, and is measured with the old rig."""
    rng = np.random.default_rng(3)
    parts = {name: [] for name in MARKER_SCHEMA.names}
    trigger = 0
    for turn in turns:
        side = turned(world, turn)
        for _ in range(sets):
            truth = world.markers_m("right", 0.06 + 0.05 * np.sin(0.7 * trigger))
            pixels = [p + rng.normal(0.0, noise_px, p.shape) for p in seen_by(world, side, truth)]
            points = measured(world, pixels)
            row = {
                "trigger_index": np.full(18, trigger),
                "side": np.full(18, "right"),
                "marker": np.arange(18),
                "timestamp_ns": np.full(18, START_NS + round(trigger * 1e10 / sets)),
                "frame_timestamp_ns": np.full(18, START_NS + round(trigger * 1e10 / sets)),
                **{f"{axis}_m": points.xyz_m[:, k] for k, axis in enumerate("xyz")},
                **{f"{c}{k}_px": pixels[k][:, at] for k in (0, 1) for at, c in enumerate("uv")},
                "epipolar_px": points.epipolar_px,
                "flags": np.full(18, ""),
                "ptp_state": np.full(18, ""),
            }
            for name in parts:
                parts[name].append(row.get(name, np.zeros(18)))
            trigger += 1
    return pa.table([pa.array(np.concatenate(parts[m.name]), type=m.type) for m in MARKER_SCHEMA], schema=MARKER_SCHEMA)


def true_cost_m(world, side):
    """What the old rig makes the outermost markers wrong by, seen by cameras that have moved."""
    truth = world.markers_m("right", 0.06)
    return np.linalg.norm((measured(world, seen_by(world, side, truth)).xyz_m - truth)[-2:].mean(axis=0))


def test_the_epipolar_residual_shows_a_camera_that_turns(world):
    turns = [(0.0, 0.0, 0.0), (3e-4, 0.0, 0.0), (6e-4, 0.0, -4e-4)]
    found = drift(flight_table(world, turns), NO_LIGHTS, world.rig)
    assert found.column("side").to_pylist() == ["right"] * 3
    cost = found.column("epipolar_tip_mm").to_numpy()
    sigma = found.column("epipolar_tip_sigma_mm").to_numpy()
    assert cost[0] == 0.0
    for place in (1, 2):
        truth = 1000 * true_cost_m(world, turned(world, turns[place]))
        assert abs(cost[place] - truth) < 3 * sigma[place]
    assert abs(found.column("epipolar_px").to_numpy()[1]) == pytest.approx(3e-4 * 1404 / 2**0.5, rel=0.15)
    # a turn about the vertical hardly shows, and the sigma says so
    assert sigma.min() > 1.0
    steady = worst(drift(flight_table(world, turns[:1] * 3), NO_LIGHTS, world.rig))["right"]
    assert abs(steady["epipolar_px"]) < 0.02
    assert steady["epipolar_tip_mm"] < 3 * steady["epipolar_tip_sigma_mm"]


def with_references(rig):
    lights = tuple(ReferenceLight(f"F{k}", tuple(place), 3e-4) for k, place in enumerate(LIGHTS_M))
    return dataclasses.replace(rig, right=dataclasses.replace(rig.right, references=lights))


@pytest.mark.parametrize(
    ("turn", "pose"),
    [((0.0, 4e-4, 0.0), (0.0,) * 6), ((0.0, 0.0, 0.0), (1e-3, -5e-4, 8e-4, 0.0, 1e-3, 0.0))],
    ids=["cam1 turns about the vertical", "the pair is knocked"],
)
def test_lights_on_the_fuselage_show_the_rest(tmp_path, small_world, painter, recording_writer, turn, pose):
    rig = with_references(small_world.rig)
    writer = recording_writer(tmp_path / "right.mcap")
    now = turned(small_world, turn, pose)
    for trigger in range(8):
        side = small_world.rig.right if trigger < 4 else now
        points = np.concatenate([small_world.markers_m("right", 0.06), LIGHTS_M])
        for camera, pixels in enumerate(seen_by(small_world, side, points)):
            canvas = painter(776, 1040, seed=10 * trigger + camera)
            for u, v in pixels:
                canvas.add(u, v, 0.6, 0.7, 140)
            writer.frame("right", f"cam{camera}", trigger, canvas.image(), START_NS + trigger * 2_500_000_000)
    writer.close()
    measured_flight = markers([tmp_path], rig, workers=1)
    table = measured_flight.table
    assert np.isfinite(table.column("x_m").to_numpy()).reshape(8, 18)[:, :12].all()
    sets = lights_seen(measured_flight.lights, "right", rig.right)
    assert sets.trigger_index.tolist() == list(range(8))
    assert sets.timestamp_ns[7] - sets.timestamp_ns[0] == 7 * 2_500_000_000
    spots = sets.spots
    assert (
        np.abs(
            spots.pixels[0] - np.stack(seen_by(small_world, small_world.rig.right, np.array(LIGHTS_M)), axis=1)
        ).max()
        < 0.1
    )
    assert 0.0 < spots.covariance_px2[:, :, :, 0, 0].max() < 0.05**2
    found = drift(table, measured_flight.lights, rig).to_pylist()
    assert [row["lights"] for row in found] == [6, 6]
    assert found[0]["lights_px"] == 0.0
    truth_mm = 1000 * true_cost_m(small_world, now)
    assert truth_mm > 2.0
    assert abs(found[1]["lights_tip_mm"] - truth_mm) < 3 * found[1]["lights_tip_sigma_mm"]
    # 0.02 px of 700 px on six lights at 1 m: 0.03 mrad, some millimetres of depth at 3 m
    assert found[1]["lights_tip_sigma_mm"] < 3.0


def test_fuselage_lights_are_no_markers(world, painter):
    rig = with_references(world.rig)
    from process.detect import detect

    pixels = seen_by(world, world.rig.right, np.array(LIGHTS_M))
    marker_like = [[300.0, 300.0], [1500.0, 1200.0]]
    spots = []
    for camera in (0, 1):
        canvas = painter(1552, 2080, seed=camera)
        for u, v in [*pixels[camera][:5], *marker_like]:
            canvas.add(u, v, 1.0, 0.8, 140)
        spots.append(detect(canvas.image()))
    lights, others = light_spots(rig.right, tuple(spots))
    found = lights.pixels
    np.testing.assert_allclose(found[:5], np.stack(pixels, axis=1)[:5], atol=0.06)
    assert np.isnan(found[5]).all()
    for left in others:
        assert sorted(left.u_px.round()) == [300.0, 1500.0]
        assert len(left.flags) == 2
    assert light_spots(world.rig.right, tuple(spots))[1][0] is spots[0]


def test_a_flight_without_markers_has_no_drift(world):
    assert drift(flight_table(world, [(0.0, 0.0, 0.0)]).slice(0, 0), NO_LIGHTS, world.rig).num_rows == 0
