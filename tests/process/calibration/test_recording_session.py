"""A pair calibrated from a recording in which a board was held still, moved on, and held still again."""

import json
import sys

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from capture.errors import ProcessError, UsageError
from process.board import Board
from process.calibration_recording import find_in_recording
from process.camera_model import CameraModel, StereoPair, pose_matrix, read_pair
from process.cli import app
from process.recording import open_recording

BOARD = Board(8, 5, 0.03)
CAMERA = CameraModel(640, 480, [[830.0, 0, 320.9], [0, 831.8, 238.7], [0, 0, 1]], [-0.08, 0.05, -3e-4, 6e-4, 0.0])
PAIR = StereoPair(CAMERA, CAMERA, pose_matrix([0.004, -0.05, 0.003], [-0.2, 0.001, -0.0005]))


@pytest.fixture(scope="module")
def flight(tmp_path_factory, render_board, world):
    """Eight places, two sets each, and a set on the way between two of them."""
    conftest = sys.modules[type(world).__module__]
    folder = tmp_path_factory.mktemp("calibration")
    writer = conftest.RecordingWriter(folder / "left_0000.mcap")
    rng = np.random.default_rng(2)
    trigger = 0
    for _ in range(8):
        tilt = rng.uniform(0.25, 0.6) * np.exp(1j * rng.uniform(0, 2 * np.pi))
        z = rng.uniform(0.8, 1.1)
        place = np.array([0.1 + rng.uniform(-0.03, 0.03), rng.uniform(-0.06, 0.06), z])
        for shift in ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.02, 0.0, 0.0]):
            pose = pose_matrix([tilt.real, tilt.imag, rng.uniform(-0.02, 0.02) * bool(shift[0])], place + shift)
            for camera, from_cam0 in enumerate((np.eye(4), PAIR.T_cam1_cam0)):
                image = render_board(CAMERA, BOARD, from_cam0 @ pose, seed=100 * trigger + camera)
                writer.frame("left", f"cam{camera}", trigger, image, 1_700_000_000_000_000_000 + trigger * 40_000_000)
            trigger += 1
    writer.close()
    return folder


def test_views_are_of_a_board_at_rest(flight):
    session = find_in_recording(open_recording([flight]), "left", BOARD, workers=1)
    assert session.size_px == (640, 480)
    triggers = [int(first.path.name.split("#")[1]) for first, _ in session.views]
    # of each place the first set; the second is followed by the motion, the third by the next place
    assert set(triggers) <= {*range(0, 24, 3), 23}
    assert len(triggers) >= 7
    assert session.views[0][1].path.name.startswith("left_0000.mcap#")


def test_the_command_calibrates_a_recording(flight, tmp_path):
    out = tmp_path / "pair.json"
    options = ["--board", "8x5", "--square-mm", "30", "-o", str(out), "--json", "--workers", "1"]
    done = CliRunner().invoke(app, ["calibrate", str(flight), "--side", "left", *options], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    summary = json.loads(done.stdout)
    assert summary["stereo"]["rms_px"] < 0.1
    pair = read_pair(out)
    error = pair.parameters - PAIR.parameters
    assert error @ np.linalg.solve(pair.covariance, error) < 24 + 6 * 48**0.5
    for arguments, says in (
        ([str(flight)], "--side left or --side right"),
        ([str(flight), "--side", "left", "--cam0", "a", "--cam1", "b"], "not both"),
        (["--side", "left"], "name its folder"),
        (["--cam0", "a"], "--cam0 and --cam1"),
    ):
        with pytest.raises(UsageError, match=says):
            CliRunner().invoke(app, ["calibrate", *arguments, *options], catch_exceptions=False)


def test_recordings_without_a_board_are_refused(flight, tmp_path, recording_writer):
    with pytest.raises(ProcessError, match=r"no frame sets of the right pair \(sides recorded: left\)"):
        find_in_recording(open_recording([flight]), "right", BOARD, workers=1)
    writer = recording_writer(tmp_path / "left.mcap")
    grey = np.full((480, 640), 90, np.uint8) + cv2.randu(np.zeros((480, 640), np.uint8), 0, 5)
    for trigger in range(4):
        for camera in range(2):
            writer.frame("left", f"cam{camera}", trigger, grey, 1_700_000_000_000_000_000 + trigger * 40_000_000)
    writer.close()
    with pytest.raises(ProcessError, match=r"0 of 4 sets looked at show the whole 8x5 board at rest"):
        find_in_recording(open_recording([tmp_path]), "left", BOARD, workers=1)
