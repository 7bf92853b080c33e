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

    Returns:
        the fit, ``distance`` in sigmas of all that was seen of a marker; ``residual_m`` is NaN, nothing was measured
        in metres. NaN and a reason as in ``fit_frame``; a marker counts when one camera saw it.
    """
    posed = pixel_problem(half, rig, pixels, covariance_px2, settings)
    return fit_measured(posed, settings, start, prior_scale)


def pixel_problem(
    half: HalfWing, rig: RigSide, pixels: Array, covariance_px2: Array, settings: FitSettings
) -> Unscaled:
    """The problem of centroids (M, 2, 2) with covariances (M, 2, 2, 2); raises ValueError for other shapes."""
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
        whiten = np.asarray(np.linalg.inv(np.linalg.cholesky(spread)), dtype=np.float64)
        return (whiten @ error[:, :, None])[:, :, 0], whiten @ slopes

    numbers: Array = 2.0 * seen.sum(axis=1)
    return pose(half, settings, measure, numbers > 0, numbers)


def _cameras_from_body(rig: RigSide) -> tuple[Array, Array]:
    """Poses (4, 4) that take body coordinates into each camera's."""
    T_cam0_body = np.asarray(np.linalg.inv(rig.T_body_cam0), dtype=np.float64)
    return T_cam0_body, rig.pair.T_cam1_cam0 @ T_cam0_body
