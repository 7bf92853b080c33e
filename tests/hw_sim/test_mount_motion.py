"""Camera pairs that move against the fuselage, as the truth says they do."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest

from capture.errors import UsageError
from hw_sim import optics
from hw_sim.mount_motion import PairMotion
from hw_sim.render import scene_e
from hw_sim.spots import led_spots
from hw_sim.truth import write_truth
from hw_sim.wing_motion import LedMotion
from hw_sim.world import FUSELAGE_LIGHTS, MountMotion, World

MOVING = MountMotion(drift_mm=2.0, drift_mrad=3.0, vibration_mm=0.3, vibration_mrad=0.5)


@pytest.fixture(scope="module")
def moving() -> World:
    return World.make(3, fuselage=FUSELAGE_LIGHTS, mount_motion=MOVING)


def moved_camera(world: World, side: str, name: str, change: np.ndarray):
    """The camera as it is once its pair has turned and shifted about cam0's centre, by OpenCV's rotation."""
    centre = np.array(world.camera(side, "cam0").T_body_cam)[:3, 3]
    R = cv2.Rodrigues(change[:3])[0]
    pose = np.array(world.camera(side, name).T_body_cam)
    pose[:3, :3] = R @ pose[:3, :3]
    pose[:3, 3] = R @ (pose[:3, 3] - centre) + centre + change[3:]
    return dataclasses.replace(world.camera(side, name), T_body_cam=tuple(map(tuple, pose.tolist())))


@pytest.mark.parametrize("key", [("left", "cam1"), ("right", "cam0")])
def test_a_moving_pair_sees_what_a_moved_camera_would(moving: World, key: tuple[str, str]) -> None:
    side = key[0]
    camera = moving.camera(*key)
    start_ns = moving.epoch_ns + 1_234_567_890
    leds = LedMotion(moving, side)
    spots = led_spots(moving, camera, leds, start_ns, 2000)
    assert len(spots) == 42  # lights, mirror images, fuselage
    fixed = moving.fuselage_lights_m(side)
    still = optics.project(camera, fixed)
    for light, centre in enumerate(spots.centre_px[36:]):
        instant = start_ns + round((centre[1] * 10.0 + 1000.0) * 1000.0)
        change = PairMotion.of(moving, side).at(np.array(instant))
        there = optics.project(moved_camera(moving, *key, change), fixed[light])
        assert centre == pytest.approx(there, abs=1e-3)
    assert np.linalg.norm(spots.centre_px[36:] - still, axis=1).max() > 0.5
    for light, centre in enumerate(spots.centre_px[:18]):
        instant = start_ns + round((centre[1] * 10.0 + 1000.0) * 1000.0)
        change = PairMotion.of(moving, side).at(np.array(instant))
        place = leds.centres(np.full(18, instant))[0][light]
        assert centre == pytest.approx(optics.project(moved_camera(moving, *key, change), place), abs=1e-3)


def test_amplitudes_are_as_asked_and_the_truth_has_them(moving: World, tmp_path: Path) -> None:
    write_truth(moving, moving.epoch_ns, moving.epoch_ns + 35_000_000_000, tmp_path)
    table = pq.read_table(tmp_path / "mount.parquet").to_pandas()
    for side in ("left", "right"):
        own = table[table.side == side]
        turn = np.linalg.norm(own[[f"turn_{axis}_mrad" for axis in "xyz"]].to_numpy(), axis=1)
        shift = np.linalg.norm(own[[f"shift_{axis}_mm" for axis in "xyz"]].to_numpy(), axis=1)
        assert 2.5 < turn.max() < 3.5
        assert 1.7 < shift.max() < 2.3
    lights = pq.read_table(tmp_path / "fuselage.parquet").to_pandas()
    assert lights.groupby("side").size().to_dict() == {"left": 6, "right": 6}
    np.testing.assert_allclose(lights[lights.side == "left"].y_m, -lights[lights.side == "right"].y_m)


def test_a_world_without_motion_stands_still(world: World) -> None:
    pair = PairMotion.of(world, "right")
    assert pair.at_rest
    assert not pair.at(np.array([world.epoch_ns, world.epoch_ns + 10**9])).any()
    assert len(world.fuselage_lights_m("left")) == 0


def test_the_file_keeps_lights_and_motion(moving: World, tmp_path: Path) -> None:
    moving.write(tmp_path / "world.toml")
    assert World.read(tmp_path / "world.toml") == moving
    with pytest.raises(UsageError, match="form 'bulb' of the lights is unknown"):
        World.make(1, form="bulb")


def test_a_dome_is_seen_where_its_outline_is() -> None:
    """The middle of the light of each bulb against that of OpenCV's picture of half a ball, filled."""
    world = World.make(3, form="dome")
    camera = world.camera("right", "cam0")
    leds = LedMotion(world, "right")
    start_ns = world.epoch_ns + 2_000_000_000
    spots = led_spots(world, camera, leds, start_ns, 2000)
    radius = world.leds.diameter_m / 2.0
    times = start_ns + np.rint((spots.centre_px[:18, 1] * 10.0 + 1000.0) * 1000.0).astype(np.int64)
    centres, frames = leds.centres(times)
    rng = np.random.default_rng(1)
    ball = rng.normal(size=(20_000, 3))
    ball /= np.linalg.norm(ball, axis=1)[:, None]
    ball[:, 2] = np.abs(ball[:, 2])
    for light in (0, 1, 4, 9, 16):
        angle = np.linspace(0.0, 2.0 * np.pi, 2000)
        flat = np.column_stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
        points = centres[light] + radius * np.concatenate([ball, flat]) @ frames[light].T
        fine = 64
        outline = np.rint(cv2.convexHull((optics.project(camera, points) * fine).astype(np.float32)))
        x, y = (outline[:, 0] - outline[0, 0]).T
        cross = x * np.roll(y, -1) - np.roll(x, -1) * y
        middle = outline[0, 0] + [np.sum((a + np.roll(a, -1)) * cross) / (3.0 * cross.sum()) for a in (x, y)]
        middle = middle / fine
        assert spots.centre_px[light] == pytest.approx(middle, abs=0.05)
        flat_centre = optics.project(camera, centres[light])
        if light < 2:
            assert np.linalg.norm(middle - flat_centre) > 1.0  # 0.42 of some 6 px
    light_e = scene_e(world, spots, 2000)
    x, y = np.rint(spots.centre_px[0]).astype(int)
    patch = light_e[y - 9 : y + 10, x - 9 : x + 10]
    rows, columns = np.mgrid[y - 9 : y + 10, x - 9 : x + 10]
    centroid = [np.sum(patch * columns) / patch.sum(), np.sum(patch * rows) / patch.sum()]
    assert centroid == pytest.approx(spots.centre_px[0], abs=0.02)
