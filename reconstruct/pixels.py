"""Both cameras' pixels of one instant, without triangulation, into the loads and shape of the half wing they show.

The fit's other way in (direct mode): residuals are pixels, through the camera models, so that a light that one camera
saw still counts. The marker's place on the wing and the prior are those of the fit to triangulated markers.
"""

import numpy as np

from process.camera_model import RigSide
from reconstruct.fit import Fit, Unscaled, fit_measured, pose
from reconstruct.rotation import Array, Mask
from reconstruct.wing import HalfWing
from reconstruct.wing_file import FitSettings

_CAMERAS = 2


def fit_pixels(
    half: HalfWing,
    rig: RigSide,
    pixels: Array,
    covariance_px2: Array,
    settings: FitSettings,
    start: Fit | None = None,
    prior_scale: Array | None = None,
    epipolar_px: float = 0.0,
) -> Fit:
    """Fit loads and shape to centroids in both cameras (eq. 27).

    Args:
        half: the half wing.
        rig: its cameras.
        pixels: (M, 2, 2) of marker, camera, (u, v), all of one instant; NaN where a camera did not see the marker.
        covariance_px2: (M, 2, 2, 2) of each centroid; one that is not positive definite counts as not seen.
        settings: from the wing file; ``marker_model_sigma_m`` is taken to pixels by the cameras.
        start: the fit of a neighbouring instant.
        prior_scale: (4,) as in ``fit_frame``.
        epipolar_px: one sigma of what calibration adds to the distance from the epipolar condition.

    Returns:
        the fit, ``distance`` in sigmas of all that was seen of a marker; ``residual_m`` is NaN, nothing was measured
        in metres. NaN and a reason as in ``fit_frame``; a marker counts when one camera saw it.
    """
    posed = pixel_problem(half, rig, pixels, covariance_px2, settings, epipolar_px)
    return fit_measured(posed, settings, start, prior_scale)


def pixel_problem(
    half: HalfWing,
    rig: RigSide,
    pixels: Array,
    covariance_px2: Array,
    settings: FitSettings,
    epipolar_px: float = 0.0,
) -> Unscaled:
    """The problem of centroids (M, 2, 2) with covariances (M, 2, 2, 2); raises ValueError for other shapes.

    Calibration makes the cameras disagree on lights by more than centroids' noise. No place of a light explains that,
    so ``epipolar_px`` widens what is across (both saw it), or half of its variance any direction (one did).
    """
    markers = len(half.marker_ids)
    if pixels.shape != (markers, _CAMERAS, 2) or covariance_px2.shape != (markers, _CAMERAS, 2, 2):
        raise ValueError(f"expected {markers} markers in 2 cameras, got {pixels.shape} and {covariance_px2.shape}")
    known = np.concatenate([pixels[..., None], covariance_px2], axis=3)
    seen: Mask = np.isfinite(known).all(axis=(2, 3))
    safe = np.where(seen[:, :, None, None], covariance_px2, np.eye(2))
    seen = np.logical_and(seen, np.linalg.eigvalsh(safe)[:, :, 0] > 0)
    safe = np.where(seen[:, :, None, None], safe, np.eye(2))
    given = np.where(seen[:, :, None], pixels, 0.0)
    body_to_camera = _cameras_from_body(rig)
    both = seen.all(axis=1)
    safe = safe + np.where(both, 0.0, epipolar_px**2 / 2)[:, None, None, None] * np.eye(2)

    def measure(point: Array) -> tuple[Array, Array]:
        """In sigmas: (M, 4) and (M, 4, 3). Where a light cannot be (behind a camera), it has no pull for this step."""
        image, slope = np.zeros((markers, _CAMERAS, 2)), np.zeros((markers, _CAMERAS, 2, 3))
        for at, (camera, T) in enumerate(zip((rig.pair.cam0, rig.pair.cam1), body_to_camera, strict=True)):
            image[:, at], by_camera = camera.project_with_jacobian(point @ T[:3, :3].T + T[:3, 3])
            slope[:, at] = by_camera @ T[:3, :3]
        ahead = np.isfinite(image).all(axis=2) & np.isfinite(slope).all(axis=(2, 3)) & seen
        error = np.where(ahead[:, :, None], image - given, 0.0).reshape(markers, 4)
        slopes = np.where(ahead[:, :, None, None], slope, 0.0).reshape(markers, 4, 3)
        spread = settings.marker_model_sigma_m**2 * slopes @ slopes.transpose(0, 2, 1)
        for at in range(_CAMERAS):
            spread[:, 2 * at : 2 * at + 2, 2 * at : 2 * at + 2] += safe[:, at]
        spread[both] += epipolar_px**2 * _across(slopes[both])
        whiten = np.asarray(np.linalg.inv(np.linalg.cholesky(spread)), dtype=np.float64)
        return (whiten @ error[:, :, None])[:, :, 0], whiten @ slopes

    numbers: Array = 2.0 * seen.sum(axis=1)
    return pose(half, settings, measure, numbers > 0, numbers)


def px_per_m(half: HalfWing, rig: RigSide) -> Array:
    """(M, 2) by how many pixels a marker of the unloaded wing moves at most in each camera, a metre; 0 out of view."""
    place = half.rest_marker_m
    found: Array = np.zeros((len(place), _CAMERAS))
    for at, (camera, T) in enumerate(zip((rig.pair.cam0, rig.pair.cam1), _cameras_from_body(rig), strict=True)):
        slope = camera.project_with_jacobian(place @ T[:3, :3].T + T[:3, 3])[1]
        visible = np.isfinite(slope).all(axis=(1, 2))
        found[visible, at] = np.linalg.norm(slope[visible], ord=2, axis=(1, 2))
    return found


def _across(slopes: Array) -> Array:
    """(n, 4, 4) what of both cameras' pixels no motion of a light, by ``slopes`` (n, 4, 3), can make."""
    normal = slopes.transpose(0, 2, 1) @ slopes
    regular = np.linalg.det(normal) > 0
    normal = np.where(regular[:, None, None], normal, np.eye(3))
    made = slopes @ np.linalg.solve(normal, slopes.transpose(0, 2, 1))
    return np.asarray(np.where(regular[:, None, None], np.eye(4) - made, 0.0))


def _cameras_from_body(rig: RigSide) -> tuple[Array, Array]:
    """Poses (4, 4) that take body coordinates into each camera's."""
    T_cam0_body = np.asarray(np.linalg.inv(rig.T_body_cam0), dtype=np.float64)
    return T_cam0_body, rig.pair.T_cam1_cam0 @ T_cam0_body
