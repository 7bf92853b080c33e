"""What calibration and mount do to points: against triangulation and pose fits with other parameters, and by chance."""

import cv2
import numpy as np
import pyarrow as pa
import pytest
from scipy.stats import binomtest

from process.camera_model import PAIR_PARAMETER_NAMES, RigSide
from process.shared_error import (
    displacement_covariance_m2,
    point_covariance_m2,
    shared_covariance,
    shared_jacobian,
    sides_of,
    with_rig,
)
from process.triangulate import triangulate

# of fx fy cx cy (px), k1 k2 p1 p2 k3, then the rotation (rad) and translation (m) between the cameras: as good as
# what fifteen views of a board give
SIGMA = np.array([0.3, 0.3, 0.3, 0.3, 4e-4, 8e-4, 3e-5, 3e-5, 5e-4] * 2 + [1e-4] * 3 + [4e-5] * 3)
POSE_SIGMA = np.array([2e-4] * 3 + [3e-4] * 3)


@pytest.fixture(scope="module")
def side(world) -> RigSide:
    known = world.rig.right
    rng = np.random.default_rng(4)
    mixed = np.linalg.qr(rng.normal(size=(24, 24)))[0] * 0.3 + np.eye(24)  # correlated, as they are
    pair = type(known.pair)(
        known.pair.cam0,
        known.pair.cam1,
        known.pair.T_cam1_cam0,
        np.diag(SIGMA) @ mixed @ mixed.T @ np.diag(SIGMA),
    )
    return RigSide(pair, known.T_body_cam0, "0", "1", 0.0, np.diag(POSE_SIGMA**2), rng.normal(size=(6, 24)) * 1e-4)


def measured(side: RigSide, change: np.ndarray, pixels) -> np.ndarray:
    """Points (N, 3) of the same pixels with other parameters, by the definitions in camera_model."""
    pair = side.pair.with_parameters(side.pair.parameters + change[:24])
    moved = change[24:] + side.pose_by_calibration @ change[:24]
    T = side.T_body_cam0.copy()
    T[:3, :3] = cv2.Rodrigues(moved[:3])[0] @ T[:3, :3]
    T[:3, 3] += moved[3:]
    eye = np.broadcast_to(np.eye(2), (len(pixels[0]), 2, 2))
    return triangulate(RigSide(pair, T, "0", "1", 0.0), *pixels, eye, eye, "default").xyz_m


def test_the_jacobian_is_what_triangulation_does(world, side):
    points = world.markers_m("right", 0.12)
    pixels = world.project("right", points)
    jacobian = shared_jacobian(side, points)
    steps = np.concatenate([SIGMA, POSE_SIGMA]) / 10
    for index, name in enumerate([*PAIR_PARAMETER_NAMES, *"abcdef"]):
        change = np.eye(30)[index] * steps[index]
        slope = (measured(side, change, pixels) - measured(side, -change, pixels)) / (2 * steps[index])
        # pixels weigh alike here, and in triangulation by their covariances seen through the lens: the two optima
        # differ by the epipolar part of the error, which is a small part of it
        scale = np.abs(slope).max()
        np.testing.assert_allclose(jacobian[:, :, index], slope, atol=0.02 * scale, err_msg=name)


def test_points_and_displacements_have_the_errors_that_are_said(world, side):
    at_rest, in_flight = world.markers_m("right", 0.02), world.markers_m("right", 0.15, 0.05)
    pixels = world.project("right", at_rest), world.project("right", in_flight)
    rng = np.random.default_rng(11)
    root = np.linalg.cholesky(shared_covariance(side))
    place, moved = 17, in_flight - at_rest
    said = {
        "point": point_covariance_m2(side, in_flight)[place],
        "displacement": displacement_covariance_m2(side, at_rest, in_flight)[place],
    }
    nees: dict[str, list[float]] = {name: [] for name in said}
    for _ in range(300):
        change = root @ rng.normal(size=30)
        rest, flight = (measured(side, change, seen) for seen in pixels)
        for name, error in (("point", flight - in_flight), ("displacement", flight - rest - moved)):
            nees[name].append(error[place] @ np.linalg.solve(said[name], error[place]))
    for name, values in nees.items():
        inside = int(np.sum(np.array(values) < 7.815))  # 95 % of χ² with 3 degrees of freedom
        assert binomtest(inside, len(values), 0.95).pvalue > 0.01, (name, inside)
        assert 2.4 < np.mean(values) < 3.6, name  # 3 ± 0.14
    # what this is for: a displacement of 0.4 m is known far better than the places between which it is
    assert np.trace(said["displacement"]) < 0.25 * np.trace(said["point"])


def test_the_table_carries_it_once_a_side(world):
    table = pa.table({"x_m": [1.0, 2.0]})
    assert sides_of(table) == {}
    sides = sides_of(with_rig(table, world.rig))
    np.testing.assert_array_equal(sides["left"].T_body_cam0, world.rig.left.T_body_cam0)


def test_what_is_not_known_is_nan(world):
    points = world.markers_m("left", 0.1)
    assert np.isnan(point_covariance_m2(world.rig.left, points)).all()  # no covariances in this rig
    jacobian = shared_jacobian(world.rig.left, [[np.nan] * 3, points[0]])
    assert np.isnan(jacobian[0]).any()
    assert np.isfinite(jacobian[1]).all()
