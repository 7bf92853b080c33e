"""Camera models against OpenCV, finite differences and direct triangulation."""

import json

import cv2
import numpy as np
import pytest

from capture.errors import ProcessError
from process.camera_model import (
    CameraModel,
    MarkerLayout,
    Rig,
    RigSide,
    StereoPair,
    pose_matrix,
    read_pair,
    write_pair,
)

WIDE = CameraModel(2080, 1552, [[1403.0, 0, 1033.2], [0, 1401.5, 779.9], [0, 0, 1]], [-0.28, 0.12, 7e-4, -4e-4, -0.025])
LONG = CameraModel(2080, 1552, [[2701.0, 0, 1041.7], [0, 2703.5, 771.3], [0, 0, 1]], [-0.11, 0.14, -3e-4, 6e-4, 0.02])


def undistorted(pixels, camera, R=None, P=None):
    """OpenCV's own inverse of its lens model (N, 2), iterated to the end; its name differs between versions 4 and 5."""
    source, criteria = pixels.reshape(-1, 1, 2), (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-14)
    if hasattr(cv2, "undistortPointsIter"):
        found = cv2.undistortPointsIter(source, camera.K, camera.distortion, R, P, criteria)
    else:
        found = cv2.undistortPoints(source, camera.K, camera.distortion, R=R, P=P, criteria=criteria)
    return found.reshape(-1, 2)


def make_pair(covariance=None):
    return StereoPair(LONG, LONG, pose_matrix([0.004, -0.02, 0.003], [-0.2794, 0.001, -0.0005]), covariance)


def points_in_view(count=500):
    rng = np.random.default_rng(7)
    depth = rng.uniform(0.5, 3.0, count)
    return np.stack([rng.uniform(-0.5, 0.5, count) * depth, rng.uniform(-0.4, 0.4, count) * depth, depth], axis=1)


@pytest.mark.parametrize("camera", [WIDE, LONG])
def test_project_agrees_with_opencv(camera):
    points = points_in_view()
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.K, camera.distortion)[0].reshape(-1, 2)
    np.testing.assert_allclose(camera.project(points), expected, atol=1e-9)  # two orders of rounding


@pytest.mark.parametrize("camera", [WIDE, LONG])
def test_undistort_inverts_project_to_rounding(camera):
    points = points_in_view()
    ideal = camera.undistort(camera.project(points))
    np.testing.assert_allclose(ideal, points[:, :2] / points[:, 2:], atol=1e-11)


def test_undistort_agrees_with_opencv():
    pixels = np.stack(np.meshgrid(np.linspace(0, 2079, 30), np.linspace(0, 1551, 30)), axis=-1).reshape(-1, 2)
    expected = undistorted(pixels, LONG)
    np.testing.assert_allclose(LONG.undistort(pixels), expected, atol=1e-10)


def test_jacobian_agrees_with_finite_differences():
    points = points_in_view(50)
    _, jacobian = WIDE.project_with_jacobian(points)
    step = 1e-6
    for axis in range(3):
        shift = np.eye(3)[axis] * step
        numeric = (WIDE.project(points + shift) - WIDE.project(points - shift)) / (2 * step)
        # rounding 1e-13 · 2000 px / 1e-6 m, truncation step² · third derivative: both below 1e-3 of 1000 px/m
        np.testing.assert_allclose(jacobian[:, :, axis], numeric, rtol=1e-6, atol=1e-3)


def test_points_behind_the_camera_and_beyond_the_fold_are_nan():
    # r (1 − 0.5 r²) grows up to r = sqrt(1 / 1.5): beyond it the polynomial folds back into the picture
    folding = CameraModel(2000, 1500, [[1000.0, 0, 1000], [0, 1000.0, 750], [0, 0, 1]], [-0.5, 0, 0, 0, 0])
    assert folding.fold_radius == pytest.approx((1 / 1.5) ** 0.5)
    assert np.isnan(folding.project([[0.1, 0.1, -1.0], [0, 0, 0], [1.2, 0.0, 1.0]])).all()
    radius = folding.fold_radius
    reach = 1000 * radius * (1 - 0.5 * radius**2)
    inside, outside = folding.undistort([[1000 + reach - 5, 750], [1000 + reach + 5, 750]])
    assert inside[0] < radius
    assert np.isnan(outside).all()


def test_undistort_leaves_nan_pixels_nan():
    assert np.isnan(LONG.undistort([[np.nan, 3.0]])).all()
    assert LONG.undistort(np.empty((0, 2))).shape == (0, 2)


def test_q_gives_the_point_that_direct_triangulation_gives():
    pair = make_pair()
    points = points_in_view(200)
    in_cam1 = points @ pair.T_cam1_cam0[:3, :3].T + pair.T_cam1_cam0[:3, 3]
    rectified = [
        undistorted(camera.project(p), camera, R, P)
        for camera, p, R, P in (
            (pair.cam0, points, pair.rectification.R0, pair.rectification.P0),
            (pair.cam1, in_cam1, pair.rectification.R1, pair.rectification.P1),
        )
    ]
    np.testing.assert_allclose(rectified[0][:, 1], rectified[1][:, 1], atol=1e-6)
    disparity = rectified[0][:, 0] - rectified[1][:, 0]
    homogeneous = np.stack([*rectified[0].T, disparity, np.ones(len(points))])
    X, Y, Z, W = pair.rectification.Q @ homogeneous
    by_q = np.stack([X / W, Y / W, Z / W], axis=1) @ pair.rectification.R0  # back into cam0's own frame
    np.testing.assert_allclose(by_q, points, atol=1e-8)
    T_x = pair.rectification.P1[0, 3] / pair.rectification.P1[0, 0]
    assert pair.rectification.Q[3, 2] == pytest.approx(-1 / T_x)  # errata: eq. 4 prints −T_x
    assert T_x < 0


def test_pair_file_round_trip(tmp_path):
    covariance = np.diag(np.arange(1.0, 25.0))
    path = tmp_path / "pair.json"
    write_pair(path, make_pair(covariance), camera_rms_px=(0.1, 0.2), stereo_rms_px=0.3, provenance={}, views=[])
    value = json.loads(path.read_text())
    assert value["format"] == "wingshape pair"
    assert value["version"] == 1
    assert [camera["rms_px"] for camera in value["cameras"]] == [0.1, 0.2]
    assert value["stereo"]["rms_px"] == 0.3
    assert value["stereo"]["baseline_m"] == make_pair().baseline_m
    again = read_pair(path)
    np.testing.assert_array_equal(again.parameters, make_pair().parameters)
    np.testing.assert_array_equal(again.covariance, covariance)
    np.testing.assert_allclose(again.with_parameters(again.parameters).parameters, again.parameters, atol=1e-15)


def test_rig_file_round_trip(tmp_path):
    side = RigSide(make_pair(), pose_matrix([1.5, 0, 0.2], [0.1, -0.3, 0.08]), "1", "2", 10_000.0, np.eye(6))
    rig = Rig(side, side, MarkerLayout((0.1, 0.4), (0.04, -0.10), 0.008), {"command": "wingproc rig"})
    rig.write(tmp_path / "rig.json", points=[])
    again = Rig.read(tmp_path / "rig.json")
    assert again.markers == rig.markers
    assert again.provenance == rig.provenance
    np.testing.assert_array_equal(again.side("left").T_body_cam0, side.T_body_cam0)
    np.testing.assert_array_equal(again.right.pose_covariance, np.eye(6))
    assert (again.right.cam0_serial, again.right.row_time_ns) == ("1", 10_000.0)
    assert again.right.pair.covariance is None


def broken_files(tmp_path):
    whole = tmp_path / "whole.json"
    write_pair(whole, make_pair(), camera_rms_px=(0.1, 0.2), stereo_rms_px=0.3, provenance={})
    value = json.loads(whole.read_text())
    yield "no such file", None
    yield "not a whole JSON file", whole.read_text()[:300]
    yield 'not a "wingshape pair" file', "[1, 2]"
    yield 'not a "wingshape pair" file', json.dumps({**value, "format": "wingshape rig"})
    yield "version 99", json.dumps({**value, "version": 99})
    yield "'cameras' is missing", json.dumps({name: item for name, item in value.items() if name != "cameras"})
    bad_pose = {**value["stereo"], "T_cam1_cam0": (2 * np.eye(4)).tolist()}
    yield "T_cam1_cam0 is not a rotation", json.dumps({**value, "stereo": bad_pose})


def test_broken_pair_files_are_refused_in_one_line(tmp_path):
    for number, (reason, text) in enumerate(broken_files(tmp_path)):
        path = tmp_path / f"pair{number}.json"
        if text is not None:
            path.write_text(text)
        with pytest.raises(ProcessError) as caught:
            read_pair(path)
        message = str(caught.value)
        assert str(path) in message
        assert reason in message
        assert "wingproc calibrate" in message
        assert "\n" not in message


def test_impossible_cameras_are_refused():
    with pytest.raises(ValueError, match="distortion"):
        CameraModel(10, 10, np.eye(3), [0.1, 0.2])
    with pytest.raises(ValueError, match="focal"):
        CameraModel(10, 10, np.diag([-1.0, 1, 1]), np.zeros(5))
