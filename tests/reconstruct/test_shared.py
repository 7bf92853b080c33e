"""What all frames share, in shapes: against refits of moved markers, and by chance against cameras that are off."""

import cv2
import numpy as np
import pyarrow as pa
import pytest
from scipy.stats import binomtest

from process.camera_model import CameraModel, Light, MarkerLayout, Rig, RigSide, StereoPair
from process.shared_error import shared_covariance, with_rig
from reconstruct.fit import fit_each, fit_frame, marker_problem
from reconstruct.posterior import Fit
from reconstruct.reference import mean_of
from reconstruct.shared import SharedError, shared_errors, sigma_of

# of fx fy cx cy (px), k1 k2 p1 p2 k3, then the rotation (rad) and translation (m) between the cameras; the pose: as
# good as a careful calibration, so that markers agree with the wing within their noise
SIGMA = 0.2 * np.array(
    [0.3, 0.3, 0.3, 0.3, 4e-4, 8e-4, 3e-5, 3e-5, 5e-4] * 2 + [1e-4] * 3 + [4e-5] * 3 + [2e-4] * 3 + [3e-4] * 3
)
NOISE = np.eye(3) * (0.1e-3) ** 2


@pytest.fixture(scope="module")
def side() -> RigSide:
    """Two cameras 0.4 m apart above the right wing's root, looking outboard (+y) and down to its middle."""
    K = np.array([[2000.0, 0, 1040], [0, 2000, 776], [0, 0, 1]])
    camera = CameraModel(2080, 1552, K, np.zeros(5))
    T = np.eye(4)
    T[:3, :3] = np.column_stack([[1.0, 0, 0], [0, -0.2, -0.98], [0, 0.98, -0.2]])  # x aft, y down, z outboard
    T[:3, :3] = np.linalg.svd(T[:3, :3])[0] @ np.linalg.svd(T[:3, :3])[2]
    T[:3, 3] = [0.0, -0.6, 0.5]
    beside = np.eye(4)
    beside[0, 3] = -0.4
    pair = StereoPair(camera, camera, beside, np.diag(SIGMA[:24] ** 2))
    return RigSide(pair, T, "0", "1", 0.0, np.diag(SIGMA[24:] ** 2), None)


@pytest.fixture(scope="module")
def shared(side) -> SharedError:
    layout = MarkerLayout((0.5, 1.0, 1.5), (0.05, -0.09), 0.01, Light(0.002, 0.0005))
    return shared_errors(with_rig(pa.table({"x": [1]}), Rig(side, side, layout)))["right"]


def fitted(wing, xyz: np.ndarray, start: Fit | None = None) -> Fit:
    cov = np.tile(NOISE, (len(xyz), 1, 1))
    fit = fit_frame(wing.right, xyz, cov, wing.fit, start=start, prior_scale=np.ones(4))
    assert fit.converged, fit.reason
    return fit


def test_the_response_is_what_refits_do(xhale, closed_form, shared):
    truth = closed_form(xhale.right, 0.25, 2.0, 0.01)
    xyz = truth.markers_m.copy()
    xyz[3] = np.nan
    fit = fitted(xhale, xyz)
    response = shared.of_shapes(xhale.right, Fit.join([fit]))[0]
    rng = np.random.default_rng(3)
    for _ in range(5):
        push = rng.normal(size=xyz.shape) * 2e-5
        ahead, behind = (fitted(xhale, xyz + sign * push, fit) for sign in (1, -1))
        found = np.column_stack([ahead.position_m - behind.position_m, ahead.twist_rad - behind.twist_rad]) / 2
        expected = fit.moved_by(np.nan_to_num(push)[:, :, None])[:, :, 0]
        # Gauss–Newton leaves out how the response itself changes with the residuals
        assert np.abs(found - expected).max() < 0.02 * np.abs(found).max()
    assert response.shape == (len(truth.position_m), 4, 32)


def test_shapes_and_displacements_hold_the_truth(xhale, closed_form, side, shared):
    """400 rigs, each off by a draw of what is stated of it; markers without noise: all of the error is shared."""
    rest, flight = (closed_form(xhale.right, *state) for state in ((0.05, 0.3, 0.0), (0.3, 2.5, 0.01)))
    fits = [fitted(xhale, truth.markers_m) for truth in (rest, flight)]
    reference = mean_of("rest", xhale.right, Fit.join(fits[:1]), shared)
    assert reference is not None
    response = shared.of_shapes(xhale.right, Fit.join(fits))[1]
    sigma, sigma_moved = sigma_of(response), sigma_of(response - reference.shared)
    at = [len(sigma) // 2, len(sigma) - 1]
    assert (sigma_moved[at, :3] < sigma[at, :3]).all()  # the pose's shift is in both
    inside, inside_moved, squared = 0, 0, []
    draws, rng = 400, np.random.default_rng(11)
    for _ in range(draws):
        error = rng.normal(size=30) * SIGMA
        standoff = rng.normal() * 0.0005
        shapes = [
            fitted(xhale, _as_measured(side, error, standoff, truth), fit)
            for truth, fit in zip((rest, flight), fits, strict=True)
        ]
        off = [_difference(found, fit) for found, fit in zip(shapes, fits, strict=True)]
        score = off[1][at[1], 2] / sigma[at[1], 2]
        moved = (off[1] - off[0])[at[1], 2] / sigma_moved[at[1], 2]
        inside, inside_moved = inside + (abs(score) < 1.96), inside_moved + (abs(moved) < 1.96)
        squared.append((score**2, moved**2))
    assert binomtest(inside, draws, 0.95).pvalue > 0.01
    assert binomtest(inside_moved, draws, 0.95).pvalue > 0.01
    assert np.mean(squared, axis=0) == pytest.approx([1.0, 1.0], abs=4 * np.sqrt(2 / draws))


def test_weights_that_know_of_shared_errors(xhale, closed_form, side, shared):
    """300 rigs and their noise: the shape is better than by noise's weights alone, and bands still hold the truth."""
    truth = closed_form(xhale.right, 0.25, 2.0, 0.01)
    rng, draws = np.random.default_rng(12), 300
    xyz = np.array([_as_measured(side, rng.normal(size=30) * SIGMA, rng.normal() * 5e-4, truth) for _ in range(draws)])
    xyz += 1e-4 * rng.standard_normal(xyz.shape)
    cov = np.tile(NOISE, (*xyz.shape[:2], 1, 1))
    rms_m = []
    for known in (None, shared.of_markers(xhale.right, xyz)):
        fits = fit_each(marker_problem(xhale.right, xyz, cov, xhale.fit, known), xhale.fit, np.ones(4))
        assert fits.converged.all()
        error = fits.position_m - truth.position_m
        rms_m.append(np.sqrt(np.mean(np.sum(error**2, axis=2))))
    assert rms_m[1] < 0.9 * rms_m[0]
    noise = np.concatenate([fits.sigma_position_m, fits.sigma_twist_rad[:, :, None]], axis=2)
    sigma = np.hypot(noise, sigma_of(shared.of_shapes(xhale.right, fits)))
    place = rng.integers(4, len(truth.position_m), draws)
    for axis in (0, 2):
        score = error[np.arange(draws), place, axis] / sigma[np.arange(draws), place, axis]
        # the marker model's sigma and the prior make bands wider than these errors: they may hold more than 95 %
        assert binomtest(int(np.sum(np.abs(score) < 1.96)), draws, 0.95, alternative="less").pvalue > 0.01
    # what is new in every set is what it was: the noise, and less of it than of what is shared
    assert np.median(noise[:, -1, 2]) < np.median(sigma[:, -1, 2])


def test_a_table_that_does_not_state_its_errors_has_none(side):
    layout = MarkerLayout((0.5, 1.0, 1.5), (0.05, -0.09), 0.01)
    bare = RigSide(side.pair, side.T_body_cam0, "0", "1", 0.0, None, None)
    assert set(shared_errors(with_rig(pa.table({"x": [1]}), Rig(bare, side, layout)))) == {"right"}
    assert shared_errors(pa.table({"x": [1]})) == {}
    assert np.isnan(shared_covariance(bare)[24:, 24:]).any()


def _difference(found: Fit, fit: Fit) -> np.ndarray:
    return np.column_stack([found.position_m - fit.position_m, found.twist_rad - fit.twist_rad])


def _as_measured(side: RigSide, error: np.ndarray, standoff_m: float, truth) -> np.ndarray:
    """Markers (M, 3) that a rig sees which believes parameters that are off by ``error``: its rays meet here."""
    up = truth.R_body_section[truth.half.marker_node][:, :, 2]
    xyz = truth.markers_m - standoff_m * up
    T, pair = side.T_body_cam0, side.pair
    seen = (xyz - T[:3, 3]) @ T[:3, :3]
    pixels = pair.cam0.project(seen), pair.cam1.project(seen @ pair.T_cam1_cam0[:3, :3].T + pair.T_cam1_cam0[:3, 3])
    believed = pair.with_parameters(pair.parameters + error[:24])
    rays = [
        cv2.undistortPoints(px, camera.K, camera.distortion).reshape(-1, 2)
        for px, camera in zip(pixels, (believed.cam0, believed.cam1), strict=True)
    ]
    P0, P1 = np.eye(4)[:3], believed.T_cam1_cam0[:3]
    homogeneous = cv2.triangulatePoints(P0, P1, rays[0].T, rays[1].T)
    in_cam0 = (homogeneous[:3] / homogeneous[3]).T
    R = cv2.Rodrigues(error[24:27])[0] @ T[:3, :3]
    return in_cam0 @ R.T + T[:3, 3] + error[27:]
