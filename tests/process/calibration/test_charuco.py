"""ChArUco boards: parts of them, drawn by OpenCV's own generator through known cameras."""

import json

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from capture.errors import ProcessError, UsageError
from process.board import Board
from process.camera_model import CameraModel, StereoPair, pose_matrix, read_pair
from process.charuco import dictionary, find_charuco
from process.cli import app

BOARD = Board(10, 7, 0.03, "4X4_50", 0.022)
CAMERA = CameraModel(1040, 776, [[1350.0, 0, 520.9], [0, 1351.8, 385.7], [0, 0, 1]], [-0.11, 0.14, -3e-4, 6e-4, 0.0])
PAIR = StereoPair(CAMERA, CAMERA, pose_matrix([0.004, -0.05, 0.003], [-0.2794, 0.001, -0.0005]))
SCALE = 2000.0  # pixels a metre of the drawing
SUPERSAMPLING = 2


def drawing(board, legacy=False):
    squares = cv2.aruco.CharucoBoard(
        (board.columns + 1, board.rows + 1), board.square_m, board.marker_m, dictionary(board.charuco)
    )
    squares.setLegacyPattern(legacy)
    size = (round((board.columns + 1) * board.square_m * SCALE), round((board.rows + 1) * board.square_m * SCALE))
    return squares.generateImage(size)


def picture(board, T_cam_board, seed, camera=CAMERA, legacy=False):
    """8-bit image: rays through OpenCV's undistortion to the drawing, box-averaged, blurred, with noise."""
    wide, high = camera.width * SUPERSAMPLING, camera.height * SUPERSAMPLING
    u, v = np.meshgrid((np.arange(wide) + 0.5) / SUPERSAMPLING - 0.5, (np.arange(high) + 0.5) / SUPERSAMPLING - 0.5)
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    rays = cv2.undistortPoints(pixels[::1], camera.K, camera.distortion).reshape(-1, 2)
    H = T_cam_board[:3][:, [0, 1, 3]]
    plane = np.column_stack([rays, np.ones(len(rays))]) @ np.linalg.inv(H).T
    places = plane[:, :2] / plane[:, 2:]
    sheet = drawing(board, legacy)
    # the drawing's pixel i covers i to i + 1; the board's origin is the middle of its inner corners
    middle = np.array([(board.columns + 1) / 2, (board.rows + 1) / 2]) * board.square_m
    at = ((places + middle) * SCALE - 0.5).astype(np.float32).reshape(high, wide, 2)
    fine = cv2.remap(sheet, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=255)
    grey = 40 + 0.6 * cv2.resize(fine, (camera.width, camera.height), interpolation=cv2.INTER_AREA).astype(np.float64)
    grey = cv2.GaussianBlur(grey, (0, 0), 0.7) + np.random.default_rng(seed).normal(0.0, 1.0, grey.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def truth_px(board, T_cam_board, camera=CAMERA):
    flat = np.column_stack([board.points_m, np.zeros(board.corners)])
    turn = cv2.Rodrigues(T_cam_board[:3, :3])[0]
    return cv2.projectPoints(flat, turn, T_cam_board[:3, 3], camera.K, camera.distortion)[0].reshape(-1, 2)


@pytest.mark.parametrize("legacy", [False, True])
def test_corners_in_view_are_found_by_their_numbers(tmp_path, legacy):
    board = BOARD if not legacy else Board(9, 7, 0.03, "5X5_100", 0.022)  # an even number of rows of squares
    pose = pose_matrix([0.3, -0.2, 0.4], [0.12, 0.05, 0.55])  # a part is out of the picture
    view = find_charuco(tmp_path / "a.png", picture(board, pose, 1, legacy=legacy), board)
    truth = truth_px(board, pose)
    inside = np.all((truth > 0) & (truth < [1039, 775]), axis=1)
    assert 0.3 < inside.mean() < 0.95
    for name, limit in (("edges", 0.06), ("subpix", 0.5)):
        found = view.corners[name]
        seen = np.isfinite(found).all(axis=1)
        assert seen.sum() > 0.7 * inside.sum()
        assert not seen[~inside].any()
        assert np.linalg.norm(found - truth, axis=1)[seen].max() < limit, name


def test_a_board_of_another_dictionary_is_not_found(tmp_path):
    pose = pose_matrix([0.3, -0.2, 0.1], [0.0, 0.0, 0.6])
    other = Board(10, 7, 0.03, "6X6_250", 0.022)
    view = find_charuco(tmp_path / "a.png", picture(other, pose, 1), BOARD)
    assert view.corners == {}
    assert "too few" in view.reason


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    folder = tmp_path_factory.mktemp("charuco")
    rng = np.random.default_rng(5)
    for number in range(9):
        tilt = rng.uniform(0.2, 0.6) * np.exp(1j * rng.uniform(0, 2 * np.pi))
        z = rng.uniform(0.7, 1.2)
        place = [0.14 + rng.uniform(-0.25, 0.25) * z, rng.uniform(-0.2, 0.2) * z, z]
        pose = pose_matrix([tilt.real, tilt.imag, rng.uniform(-0.4, 0.4)], place)
        for camera, from_cam0 in enumerate((np.eye(4), PAIR.T_cam1_cam0)):
            cv2.imwrite(
                str(folder / f"cam{camera}_{number}.png"), picture(BOARD, from_cam0 @ pose, 10 * number + camera)
            )
    return folder


def command(folder, out, *more):
    arguments = ["--cam0", str(folder / "cam0_*.png"), "--cam1", str(folder / "cam1_*.png"), "-o", str(out)]
    options = ["--board", "10x7", "--square-mm", "30", "--json", "--workers", "1"]
    return CliRunner().invoke(app, ["calibrate", *arguments, *options, *more], catch_exceptions=False)


@pytest.mark.slow
def test_a_pair_is_calibrated_from_parts_of_a_board(session, tmp_path):
    done = command(session, tmp_path / "pair.json", "--charuco", "4x4_50", "--marker-mm", "22")
    assert done.exit_code == 0, done.output
    summary = json.loads(done.stdout)
    assert summary["calibration"]["finders"] == ["edges", "edges"]
    assert summary["calibration"]["sigma_px"] < 0.05
    pair = read_pair(tmp_path / "pair.json")
    error = pair.parameters - PAIR.parameters
    assert abs(1000 * error[21]) < 0.5
    # χ² with 24, from few views: parts of a board leave some parameters poorly known, which the covariance says
    assert error @ np.linalg.solve(pair.covariance, error) < 24 + 6 * 48**0.5


@pytest.mark.parametrize(
    ("more", "says"),
    [
        (("--charuco", "4X4_50"), "--marker-mm"),
        (("--charuco", "4X4_50", "--marker-mm", "40"), "smaller than the square"),
        (("--charuco", "9X9_9", "--marker-mm", "20"), "no such dictionary"),
        (("--marker-mm", "20"), "--charuco"),
    ],
)
def test_wrong_options_are_refused(session, tmp_path, more, says):
    with pytest.raises(UsageError, match=says):
        command(session, tmp_path / "pair.json", *more)


def test_the_wrong_dictionary_is_refused(session, tmp_path):
    with pytest.raises(ProcessError, match="0 of 9 views"):
        command(session, tmp_path / "pair.json", "--charuco", "6X6_50", "--marker-mm", "22")
