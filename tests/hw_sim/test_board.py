"""The rendered checkerboard against an independent corner finder."""

import dataclasses
import functools

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates, spline_filter
from scipy.optimize import least_squares

from hw_sim import board, optics
from hw_sim.board import board_light_e, corners_m, render_board
from hw_sim.sessions import survey_points
from hw_sim.world import World

board_poses = functools.cache(board.board_poses)  # many tests, the same few poses


def _true_corners_px(world: World, camera: object, pose: np.ndarray) -> np.ndarray:
    points = corners_m(world).reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3]
    return optics.project(camera, points)  # type: ignore[arg-type]


def _centre_of_symmetry(image: np.ndarray, start: np.ndarray) -> np.ndarray:
    """The point that a half turn about maps the image around it onto itself, by quintic interpolation."""
    x, y = np.rint(start).astype(int)
    smooth = spline_filter(image[y - 12 : y + 13, x - 12 : x + 13].astype(float), order=5)
    arm = np.array([(i, j) for i in range(-4, 5) for j in range(-4, 5) if (i, j) > (0, 0)], dtype=float).T

    def asymmetry(off: np.ndarray) -> np.ndarray:
        centre = 12.0 + off[::-1, None]
        there, back = (map_coordinates(smooth, centre + sign * arm, order=5, prefilter=False) for sign in (1, -1))
        return there - back

    return np.array([x, y]) + least_squares(asymmetry, start - [x, y] + 0.05, x_scale=0.1).x


@pytest.mark.parametrize("number", [0, 9, 14])
def test_corners_are_where_the_true_corners_project(world: World, number: int) -> None:
    exact = dataclasses.replace(world, board=dataclasses.replace(world.board, print_sigma_m=0.0))
    for made, side, tolerance in ((exact, "left", 0.002), (world, "right", 0.01)):
        # A misprinted corner has kinked edges, 0.05 mm in 30: over the window's 4 px up to 0.01 px of asymmetry.
        pose = board_poses(made, side)[number]
        for name in ("cam0", "cam1"):
            camera = made.camera(side, name)
            true = _true_corners_px(made, camera, pose)
            light = board_light_e(made, camera, pose) / made.board.white_e * 255
            symmetric = np.array([_centre_of_symmetry(light, corner) for corner in true[::4]])
            assert np.sqrt(np.mean((symmetric - true[::4]) ** 2)) < tolerance
            start = (true + 0.3).astype(np.float32).reshape(-1, 1, 2)
            stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 200, 1e-5)
            found = cv2.cornerSubPix(light.astype(np.float32), start, (4, 4), (-1, -1), stop).reshape(-1, 2)
            # OpenCV's finder interpolates linearly between pixels, which alone costs it up to 0.02 px with the corner's
            # place in its pixel; that averages out over a board.
            assert np.sqrt(np.mean((found - true) ** 2)) < 0.025
            assert np.abs(np.mean(found - true, axis=0)).max() < 0.01


def test_print_errors_are_as_stated_and_the_same_in_every_image(world: World) -> None:
    size = world.board.square_m
    grid = np.stack(np.meshgrid(np.arange(10) - 4.5, np.arange(7) - 3.0), axis=-1) * size
    off = corners_m(world)[..., :2] - grid
    assert off.std() == pytest.approx(5e-5, rel=5 / (2 * off.size) ** 0.5)
    assert np.array_equal(corners_m(world), corners_m(world))
    assert (corners_m(world)[..., 2] == 0.0).all()  # flat


@pytest.mark.parametrize("scale", [pytest.param(1, marks=pytest.mark.slow), 4])
def test_every_pose_is_found_in_both_images(scale: int) -> None:
    made = World.make(seed=2, scale=scale)
    seen = 0
    for side in ("left", "right"):
        poses = board_poses(made, side)
        assert len(poses) == 15
        distances = [np.linalg.norm(p[:3, 3] - optics.position_m(made.camera(side, "cam0"))) for p in poses]
        assert max(distances) > 2 * min(distances)
        for number in (1, 13):
            for name in ("cam0", "cam1"):
                camera = made.camera(side, name)
                true = _true_corners_px(made, camera, poses[number])
                assert (true > 5).all()
                assert (true < [made.sensor.width_px - 6, made.sensor.height_px - 6]).all()
                image = render_board(made, camera, poses[number], number)
                found, corners = cv2.findChessboardCornersSB(image, (10, 7))
                seen += found
                if found:
                    near = np.linalg.norm(corners.reshape(-1, 1, 2) - true, axis=-1).min(axis=1)
                    assert np.median(near) < 0.35
    assert seen == 8


def test_boards_cover_the_image(world: World) -> None:
    for side in ("left", "right"):
        for name in ("cam0", "cam1"):
            camera = world.camera(side, name)
            pixels = np.concatenate([_true_corners_px(world, camera, pose) for pose in board_poses(world, side)])
            cells, _, _ = np.histogram2d(*pixels.T, bins=(8, 6), range=((0, 2080), (0, 1552)))
            assert np.mean(cells > 0) > 0.7


def test_survey_points_fill_the_volume_and_are_seen_apart(world: World) -> None:
    for side, out in (("left", -1), ("right", 1)):
        points = survey_points(world, side)
        assert len(points) == 12
        assert np.ptp(points[:, 1]) > 2.4
        assert (points[:, 1] * out > 0.4).all()
        assert np.ptp(points[:, 2]) > 0.3
        assert min((points[:, 0] < 0.03).sum(), (points[:, 0] > 0.03).sum()) >= 4
        for name in ("cam0", "cam1"):
            pixels = optics.project(world.camera(side, name), points)
            apart = np.linalg.norm(pixels[:, None] - pixels, axis=-1) + 1e9 * np.eye(12)
            assert apart.min() > 60
