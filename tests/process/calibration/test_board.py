"""Corner finding against rendered boards with known corners."""

import re

import cv2
import numpy as np
import pytest

from capture.errors import ProcessError, UsageError
from process.board import Board, find_corners, in_board_order, read_grey, refuse_blank
from process.camera_model import CameraModel, pose_matrix

CAMERA = CameraModel(1040, 776, [[1350.0, 0, 522.4], [0, 1351.5, 386.1], [0, 0, 1]], [-0.11, 0.14, -3e-4, 6e-4, 0.02])
BOARD = Board(10, 7, 0.03)
POSE = pose_matrix([0.3, -0.35, 0.3], [0.02, -0.01, 0.66])  # no edge along the pixels: the renderer samples there


def true_corners(board, pose=POSE):
    points = np.column_stack([board.points_m, np.zeros(board.corners)])
    return CAMERA.project(points @ pose[:3, :3].T + pose[:3, 3])


@pytest.fixture(scope="module")
def picture(render_board):
    return render_board(CAMERA, BOARD, POSE)


def rms(a, b):
    return np.sqrt(np.mean(np.sum((a - b) ** 2, axis=1)))


def test_each_finder_measures_the_corners_in_their_order(picture, tmp_path):
    view = find_corners(tmp_path, picture, BOARD)
    assert view.reason == ""
    # Cramér–Rao of one corner here: noise 1.5 + quantisation 0.3 grey, slope 150 / (√(2π) 0.75 px) = 80 grey/px over
    # edges of 40 px in all: 1.53 / 80 / √20 per axis = 0.004 px. The others' figures are those of the literature.
    for finder, limit_px in (("edges", 0.02), ("subpix", 0.1), ("sb", 0.15)):
        assert rms(view.corners[finder], true_corners(BOARD)) < limit_px, finder
    assert rms(view.corners["edges"], true_corners(BOARD)) < 0.6 * rms(view.corners["subpix"], true_corners(BOARD))


@pytest.mark.parametrize("turn_deg", [90, 180, 270])
def test_the_first_corner_is_the_boards_however_the_board_is_turned(render_board, tmp_path, turn_deg):
    pose = POSE @ pose_matrix([0, 0, np.radians(turn_deg)], [0, 0, 0])
    view = find_corners(tmp_path, render_board(CAMERA, BOARD, pose), BOARD)
    assert rms(view.corners["edges"], true_corners(BOARD, pose)) < 0.03


def test_reading_from_the_other_end_is_put_right(picture):
    truth = true_corners(BOARD)
    np.testing.assert_array_equal(in_board_order(picture, truth[::-1].copy(), BOARD), truth)


def test_a_board_that_looks_the_same_upside_down_runs_rightward(render_board, tmp_path):
    board = Board(8, 6, 0.03)
    assert board.looks_the_same_upside_down
    for turn in (0.0, np.pi):
        image = render_board(CAMERA, board, POSE @ pose_matrix([0, 0, turn], [0, 0, 0]))
        view = find_corners(tmp_path, image, board)
        assert view.corners["edges"][7, 0] > view.corners["edges"][0, 0] + 100


@pytest.mark.parametrize("size", ["9x6", "11x8", "5x4", "6x5"])
def test_another_board_is_not_taken_for_this_one(picture, tmp_path, size):
    view = find_corners(tmp_path, picture, Board.parse(size, 30.0))
    assert not view.corners
    assert size in view.reason


def test_a_board_partly_out_of_the_picture_is_not_found(render_board, tmp_path):
    image = render_board(CAMERA, BOARD, pose_matrix([0.3, 0, 0], [0.2, 0, 0.6]))
    assert "no board" in find_corners(tmp_path, image, BOARD).reason


def test_board_size_is_parsed():
    assert Board.parse("10x7", 30.0) == BOARD
    for size, square_mm in (("10", 30.0), ("10x7x2", 30.0), ("2x7", 30.0), ("10x7", 0.0), ("10x7", np.nan)):
        with pytest.raises(UsageError, match=r"--board|--square-mm"):
            Board.parse(size, square_mm)


def test_unusable_pictures_are_refused(picture, tmp_path):
    ok, png = cv2.imencode(".png", picture)
    assert ok
    cases = {
        "deep.png": (cv2.imencode(".png", picture.astype(np.uint16) * 200)[1].tobytes(), "16-bit"),
        "colour.png": (cv2.imencode(".png", cv2.merge([picture] * 3))[1].tobytes(), "3 channels"),
        "half.png": (png.tobytes()[: len(png) // 2], "truncated"),
        "half.jpg": (cv2.imencode(".jpg", picture)[1].tobytes()[:5000], "truncated"),
        "half.bmp": (cv2.imencode(".bmp", picture)[1].tobytes()[:5000], "truncated"),
        "half.pgm": (cv2.imencode(".pgm", picture)[1].tobytes()[:5000], "truncated"),
        "empty.png": (b"", "not a picture"),
        "text.png": (b"hello", "not a picture"),
    }
    for name, (data, reason) in cases.items():
        path = tmp_path / name
        path.write_bytes(data)
        with pytest.raises(ProcessError, match=f"{re.escape(name)}.*{reason}"):
            read_grey(path)
    with pytest.raises(ProcessError, match="No such file"):
        read_grey(tmp_path / "none.png")
    (tmp_path / "good.png").write_bytes(png.tobytes())
    np.testing.assert_array_equal(read_grey(tmp_path / "good.png"), picture)
    with pytest.raises(ProcessError, match="blank"):
        refuse_blank(tmp_path, np.full((50, 50), 7, np.uint8))
