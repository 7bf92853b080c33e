"""Own projection against OpenCV's, and what the mounted cameras see."""

import dataclasses

import cv2
import numpy as np
import pytest

from hw_sim import optics
from hw_sim.wing_motion import LedMotion
from hw_sim.world import CameraTruth, World


def _opencv(camera: CameraTruth, points: np.ndarray) -> np.ndarray:
    pose = np.linalg.inv(np.array(camera.T_body_cam))
    rotation, _ = cv2.Rodrigues(pose[:3, :3])
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    lens = np.array([camera.k1, camera.k2, camera.p1, camera.p2, camera.k3])
    return cv2.projectPoints(points, rotation, pose[:3, 3], matrix, lens)[0].reshape(-1, 2)


def test_projection_agrees_with_opencv(world: World) -> None:
    rng = np.random.default_rng(0)
    for camera in world.cameras:
        out = 1 if camera.side == "right" else -1
        points = rng.uniform([-1.0, 0.5, -0.8], [1.0, 3.0, 1.2], (200, 3)) * [1, out, 1]
        strong = dataclasses.replace(camera, p1=0.01, p2=-0.02, k3=0.03)
        for lens in (camera, strong):
            assert optics.project(lens, points) == pytest.approx(_opencv(lens, points), abs=1e-8)


def test_rays_lead_back_to_their_pixels(world: World) -> None:
    rng = np.random.default_rng(1)
    for camera in world.cameras:
        pixels = rng.uniform([0, 0], [2079, 1551], (300, 2))
        points = optics.position_m(camera) + 1.7 * optics.rays(camera, pixels)
        assert optics.project(camera, points) == pytest.approx(pixels, abs=1e-8)


def test_what_is_behind_is_not_seen(world: World) -> None:
    camera = world.camera("right", "cam0")
    behind = optics.position_m(camera) - optics.rays(camera, np.array([1000.0, 700.0]))
    assert np.isnan(optics.project(camera, behind)).all()


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("seed", [1, 3])
def test_all_pairs_stay_in_view_of_both_cameras(side: str, seed: int) -> None:
    made = World.make(seed)
    still = dataclasses.replace(made.motion, sines=())
    for mean in (-0.03, 0.0, 0.15, 0.35):  # 0.35 rad lifts the tip by 0.8 m beyond the dihedral's part
        moved = dataclasses.replace(made, motion=dataclasses.replace(still, bending_mean_rad=mean))
        leds = LedMotion(moved, side)
        times = np.repeat(made.epoch_ns + np.arange(0, 7000, 50)[:, None] * 1_000_000, len(leds), axis=1)
        centres, frames = leds.centres(times)
        for name in ("cam0", "cam1"):
            camera = made.camera(side, name)
            pixels = optics.project(camera, centres)
            assert (pixels > 40).all()
            assert (pixels < [2040, 1512]).all()
            toward = optics.position_m(camera) - centres
            toward /= np.linalg.norm(toward, axis=-1, keepdims=True)
            if mean >= 0.0:  # seen from above, in the beam
                assert (np.sum(toward * frames[..., :, 2], axis=-1) > 0).all()
                assert (np.sum(toward * leds.beams(frames), axis=-1) > 0.8).all()
