"""The fit to pixels of both cameras against the fit to triangulated markers, on the same pixels."""

import cv2
import numpy as np
import pytest
from mounted_pair import mounted

from process.camera_model import RigSide
from process.triangulate import triangulate
from reconstruct.fit import fit_frame
from reconstruct.pixels import fit_pixels, pixel_problem

SIGMA_PX = 0.3  # far above a centroid's, so that errors are of millimetres


def seen_by(rig: RigSide, points_m: np.ndarray) -> np.ndarray:
    """(M, 2, 2) pixels of body points, by OpenCV."""
    in_cam0 = np.linalg.inv(rig.T_body_cam0)
    images = [
        cv2.projectPoints(points_m, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], rig.pair.cam0.K, rig.pair.cam0.distortion)[0]
        for T in (in_cam0, rig.pair.T_cam1_cam0 @ in_cam0)
    ]
    return np.stack([image.reshape(-1, 2) for image in images], axis=1)


COVARIANCE = np.tile(SIGMA_PX**2 * np.eye(2), (18, 2, 1, 1))


def by_triangulation(xhale, truth, rig, pixels):
    points = triangulate(rig, pixels[:, 0], pixels[:, 1], COVARIANCE[:, 0], COVARIANCE[:, 1], "default")
    return fit_frame(truth.half, points.xyz_m, points.covariance_m2, xhale.fit.model_copy(update={"prior_weight": 1.0}))


def direct(xhale, truth, rig, pixels):
    return fit_pixels(truth.half, rig, pixels, COVARIANCE, xhale.fit.model_copy(update={"prior_weight": 1.0}))


def error_mm(fit, truth) -> float:
    return 1e3 * float(np.sqrt(np.mean(np.sum((fit.position_m - truth.position_m) ** 2, axis=1))))


@pytest.fixture(scope="module")
def flights(xhale, random_states):
    rng = np.random.default_rng(21)
    truths = random_states(xhale, "loads", 30, rng)
    rigs = [mounted(truth.half.sign) for truth in truths]
    noise = SIGMA_PX * rng.standard_normal((30, 18, 2, 2))
    return [(truth, rig, seen_by(rig, truth.markers_m) + n) for truth, rig, n in zip(truths, rigs, noise, strict=True)]


def test_with_every_light_in_both_cameras_it_is_the_same_fit(xhale, flights) -> None:
    """Triangulated points carry all that pixels tell, but for their curvature at this noise."""
    for truth, rig, pixels in flights:
        one, other = direct(xhale, truth, rig, pixels), by_triangulation(xhale, truth, rig, pixels)
        assert one.converged
        assert np.abs(one.position_m - other.position_m).max() < 0.3 * other.sigma_position_m.max()
        assert one.sigma_position_m == pytest.approx(other.sigma_position_m, rel=0.05, abs=1e-5)
    assert np.mean([one.chi2 / one.dof]) < 2


def test_a_light_in_one_camera_still_counts(xhale, flights) -> None:
    rng = np.random.default_rng(22)
    ours, theirs = [], []
    for truth, rig, pixels in flights:
        hidden = pixels.copy()
        lost = rng.random(18) < 0.6
        hidden[lost, rng.integers(0, 2, 18)[lost]] = np.nan
        one, other = direct(xhale, truth, rig, hidden), by_triangulation(xhale, truth, rig, hidden)
        assert one.converged
        assert one.used.sum() >= 17
        ours.append(error_mm(one, truth))
        if other.converged:
            theirs.append(error_mm(other, truth))
            assert one.sigma_position_m[-1].max() <= 1.01 * other.sigma_position_m[-1].max()
    assert np.sqrt(np.mean(np.square(ours))) < 0.8 * np.sqrt(np.mean(np.square(theirs)))


def test_one_camera_alone_gives_a_shape_with_wider_bands(xhale, flights) -> None:
    truth, rig, pixels = flights[0]
    alone = pixels.copy()
    alone[:, 1] = np.nan
    one, both = direct(xhale, truth, rig, alone), direct(xhale, truth, rig, pixels)
    assert one.converged
    assert one.sigma_position_m[-1].max() > both.sigma_position_m[-1].max()
    assert np.all(np.abs(one.position_m - truth.position_m)[5:] < 4 * one.sigma_position_m[5:])


def test_an_outlier_and_nothing_seen(xhale, flights) -> None:
    truth, rig, pixels = flights[1]
    wrong = pixels.copy()
    wrong[4, 0, 1] += 40.0
    assert np.flatnonzero(direct(xhale, truth, rig, wrong).outlier).tolist() == [4]
    nothing = direct(xhale, truth, rig, np.full_like(pixels, np.nan))
    assert not nothing.converged
    assert nothing.reason == "0 of 18 markers measured, 3 needed"


def test_its_derivative(xhale, flights) -> None:
    truth, rig, pixels = flights[2]
    settings = xhale.fit.model_copy(update={"marker_model_sigma_m": 0.0})
    measure = pixel_problem(truth.half, rig, pixels, COVARIANCE, settings).problem.measure
    slope = measure(truth.markers_m)[1]
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        numeric = (measure(truth.markers_m + step)[0] - measure(truth.markers_m - step)[0]) / 2e-6
        assert slope[:, :, axis] == pytest.approx(numeric, rel=1e-5, abs=1e-3)
