"""A board renderer of the tests' own: rays through OpenCV's undistortion, squares by area, blur, noise."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest

SUPERSAMPLING = 4


def undistorted(pixels, camera):
    """OpenCV's own inverse of its lens model (N, 2), iterated to 1e-10; its name differs between versions 4 and 5."""
    source, criteria = pixels.reshape(-1, 1, 2), (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-10)
    if hasattr(cv2, "undistortPointsIter"):
        found = cv2.undistortPointsIter(source, camera.K, camera.distortion, None, None, criteria)
    else:
        found = cv2.undistortPoints(source, camera.K, camera.distortion, criteria=criteria)
    return found.reshape(-1, 2)


def draw_board(camera, board, T_cam_board, *, noise_grey=1.5, blur_px=0.7, seed=1):
    """8-bit image of ``board`` (one dark square at its first inner corner, white rim) as ``camera`` sees it."""
    grid = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1).astype(np.float64)
    rays = undistorted(grid, camera)
    H = T_cam_board[:3][:, [0, 1, 3]]
    plane = np.column_stack([rays, np.ones(len(rays))]) @ np.linalg.inv(H).T
    squares = (plane[:, :2] / plane[:, 2:] / board.square_m).reshape(camera.height, camera.width, 2)
    size = (camera.width * SUPERSAMPLING, camera.height * SUPERSAMPLING)
    fine = cv2.resize(squares.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    x = fine[..., 0] + (board.columns - 1) / 2
    y = fine[..., 1] + (board.rows - 1) / 2
    dark = ((np.floor(x) + np.floor(y)) % 2 == 0) & (x > -1) & (x < board.columns) & (y > -1) & (y < board.rows)
    on_paper = (x > -1.7) & (x < board.columns + 0.7) & (y > -1.7) & (y < board.rows + 0.7)
    grey = np.where(dark, 40.0, np.where(on_paper, 190.0, 70.0)).astype(np.float32)
    image = cv2.resize(grey, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    image = cv2.GaussianBlur(image, (0, 0), blur_px)
    image = image + np.random.default_rng(seed).normal(0.0, noise_grey, image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


@pytest.fixture(scope="session")
def render_board() -> Callable:
    return draw_board
