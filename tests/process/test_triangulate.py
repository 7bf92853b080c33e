"""Triangulation against closed forms, brute-force minimisation and Monte Carlo."""

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

from process.camera_model import CameraModel, RigSide, StereoPair
from process.triangulate import epipolar_distance_px, rays, triangulate

SIGMA_PX = 0.05


def covariances(count: int, sigma_px: float = SIGMA_PX) -> np.ndarray:
    return np.broadcast_to(np.eye(2) * sigma_px**2, (count, 2, 2)).copy()


@pytest.fixture(scope="module")
def parallel() -> RigSide:
    """Two equal pinholes side by side, body frame = cam0: everything has a closed form."""
    camera = CameraModel(2000, 1500, np.array([[1400.0, 0, 1000], [0, 1400.0, 750], [0, 0, 1]]), np.zeros(5))
    T_cam1_cam0 = np.eye(4)
    T_cam1_cam0[0, 3] = -0.28
    return RigSide(StereoPair(camera, camera, T_cam1_cam0), np.eye(4), "a", "b", 1e4)


@pytest.mark.parametrize("method", ["default", "linear", "paper"])
@pytest.mark.parametrize("side", ["left", "right"])
def test_exact_pixels_give_the_exact_points(world, side, method):
    points_m = world.markers_m(side, 0.15, 0.1)
    pixels0, pixels1 = world.project(side, points_m)
    found = triangulate(world.rig.side(side), pixels0, pixels1, covariances(18), covariances(18), method)
    # OpenCV projects in double precision; undistortion stops at 1e-13: a nanometre at 3 m is far above both
    np.testing.assert_allclose(found.xyz_m, points_m, atol=2e-8)
    np.testing.assert_allclose(found.epipolar_px, 0.0, atol=1e-6)
    assert set(found.reasons) == {""}


@pytest.mark.parametrize("method", ["default", "linear", "paper"])
def test_parallel_cameras_closed_form(parallel, method):
    """Z = f B / d, and σ_Z = Z²/(f B) σ_d with σ_d = √2 σ."""
    pixels0 = np.array([[1100.0, 800.0], [950.0, 700.0]])
    disparity = np.array([196.0, 130.0])
    pixels1 = pixels0 - np.stack([disparity, np.zeros(2)], axis=1)
    found = triangulate(parallel, pixels0, pixels1, covariances(2), covariances(2), method)
    depth = 1400 * 0.28 / disparity
    np.testing.assert_allclose(found.xyz_m[:, 2], depth, rtol=1e-12)
    np.testing.assert_allclose(found.xyz_m[:, 0], (pixels0[:, 0] - 1000) * depth / 1400, atol=1e-12)
    sigma_z = depth**2 / (1400 * 0.28) * np.sqrt(2) * SIGMA_PX
    # the optimum averages the two rows, which has no bearing on Z for parallel cameras
    np.testing.assert_allclose(np.sqrt(found.covariance_m2[:, 2, 2]), sigma_z, rtol=1e-6)


def test_it_is_the_least_reprojection_error(world):
    """Against a general minimiser on OpenCV's projection, with unequal, correlated covariances."""
    rng = np.random.default_rng(3)
    side = world.rig.right
    truth = world.markers_m("right", 0.1)[[1, 6, 17]]
    pixels = [p + rng.normal(0, 0.5, p.shape) for p in world.project("right", truth)]
    cov = [np.array([[0.25, 0.1], [0.1, 0.4]]), np.array([[0.09, -0.02], [-0.02, 0.16]])]
    found = triangulate(side, *pixels, *(np.broadcast_to(c, (3, 2, 2)) for c in cov), "default")
    halves = [np.linalg.cholesky(np.linalg.inv(c)).T for c in cov]
    for k in range(3):

        def residuals(x, k=k):
            seen = world.project("right", x[None])
            return np.concatenate([halves[c] @ (seen[c][0] - pixels[c][k]) for c in range(2)])

        best = least_squares(residuals, truth[k], x_scale=1e-3, xtol=1e-15, ftol=1e-15, gtol=1e-15)
        sigma_m = np.sqrt(np.linalg.eigvalsh(found.covariance_m2[k]))
        # the lens is taken as linear over the 0.5 px residual: a thousandth of a sigma of second order
        assert np.linalg.norm(found.xyz_m[k] - best.x) < 0.01 * sigma_m.max()
        np.testing.assert_allclose(np.linalg.inv(best.jac.T @ best.jac), found.covariance_m2[k], rtol=0.01, atol=1e-12)


@pytest.mark.parametrize("method", ["default", "linear", "paper"])
def test_covariance_is_that_of_many_trials(world, method):
    """Mean normalised squared error: χ² of 3·n degrees of freedom, two-sided 1e-4."""
    rng = np.random.default_rng(7)
    trials = 4000
    truth = np.repeat(world.markers_m("left", 0.12)[[0, 9, 16]], trials, axis=0)
    pixels = [p + rng.normal(0, SIGMA_PX, p.shape) for p in world.project("left", truth)]
    n = len(truth)
    found = triangulate(world.rig.left, *pixels, covariances(n), covariances(n), method)
    error = found.xyz_m - truth
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance_m2), error)
    low, high = chi2.ppf([5e-5, 1 - 5e-5], 3 * n)
    assert low < nees.sum() < high


def test_the_optimum_is_never_worse_than_the_paper(world):
    n = 18
    pixels = world.project("right", world.markers_m("right", 0.2))
    best, paper = (
        triangulate(world.rig.right, *pixels, covariances(n), covariances(n), method) for method in ("default", "paper")
    )
    assert np.all(
        np.trace(best.covariance_m2, axis1=1, axis2=2) <= np.trace(paper.covariance_m2, axis1=1, axis2=2) * (1 + 1e-9)
    )


def test_what_cannot_be_is_nan_with_a_reason(parallel):
    pixels0 = np.array([[1000.0, 750.0], [1000.0, 750.0], [1000.0, 750.0], [np.nan, 750.0]])
    pixels1 = np.array([[1000.0, 750.0], [1100.0, 750.0], [900.0, 750.0], [900.0, 750.0]])
    for method in ("default", "linear", "paper"):
        found = triangulate(parallel, pixels0, pixels1, covariances(4), covariances(4), method)
        assert found.reasons == ("parallel", "behind", "", "outside_lens")
        assert np.isnan(found.xyz_m[[0, 1, 3]]).all()
        assert np.isnan(found.covariance_m2[[0, 1, 3]]).all()
        assert np.isfinite(found.xyz_m[2]).all()


def test_nothing_in_nothing_out(parallel):
    nothing = np.empty((0, 2))
    found = triangulate(parallel, nothing, nothing, covariances(0), covariances(0), "default")
    assert found.xyz_m.shape == (0, 3)
    assert found.reasons == ()


def test_sampson_distance_is_the_correction_needed(world):
    """First order: the sum of squares of the least shift of both points onto the epipolar condition, times f."""
    rng = np.random.default_rng(5)
    pair = world.rig.right.pair
    pixels = world.project("right", world.markers_m("right", 0.1))
    xy0, xy1 = (rays(c, p, covariances(18)).xy for c, p in zip((pair.cam0, pair.cam1), pixels, strict=True))
    xy0 = xy0 + rng.normal(0, 1e-4, xy0.shape)
    distance = epipolar_distance_px(pair, xy0, xy1)
    corrected0, corrected1 = cv2.correctMatches(_essential(pair), xy0[None].copy(), xy1[None].copy())
    shift = np.sqrt(((corrected0[0] - xy0) ** 2).sum(1) + ((corrected1[0] - xy1) ** 2).sum(1))
    np.testing.assert_allclose(np.abs(distance), shift * pair.cam0.K[0, 0], rtol=1e-3, atol=1e-6)


def _essential(pair: StereoPair) -> np.ndarray:
    x, y, z = pair.T_cam1_cam0[:3, 3]
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ pair.T_cam1_cam0[:3, :3]
