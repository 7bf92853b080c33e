"""Both cameras' pixels of one instant, without triangulation, into the loads and shape of the half wing they show.

The fit's other way in (direct mode): residuals are pixels, through the camera models, so that a light that one camera
saw still counts. The marker's place on the wing and the prior are those of the fit to triangulated markers.
"""

from dataclasses import dataclass, replace

import numpy as np

from process.camera_model import RigSide
from reconstruct.fit import Fit, Unscaled, fit_each, pose
from reconstruct.rotation import Array, Index, Mask
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
    posed = pixel_problem(half, rig, pixels[None], covariance_px2[None], settings, epipolar_px)
    return fit_each(posed, settings, prior_scale, start)[0]


@dataclass(frozen=True, eq=False)
class Seen:
    """Lights' pixels: see ``iteration.Measure``, d is four, (u, v) of cam0 and of cam1."""

    rig: RigSide
    given: Array  # (…, M, 2, 2) of marker, camera, (u, v); any number where not seen
    covariance_px2: Array  # (…, M, 2, 2, 2), with what calibration adds where one camera saw a light
    seen: Mask  # (…, M, 2)
    epipolar_px: Array  # (…, 1) what it adds where both did
    model_sigma_m: float

    def __call__(self, point: Array) -> tuple[Array, Array]:
        """What stands between them and ``point`` (…, M, 3).

        Where a light cannot be (behind a camera), it has no pull for this step.
        """
        image, slope = np.zeros(self.given.shape), np.zeros((*self.given.shape, 3))
        point = np.broadcast_to(point, (*self.given.shape[:-2], 3))
        flat = point.reshape(-1, 3)
        cameras = self.rig.pair.cam0, self.rig.pair.cam1
        for at, (camera, T) in enumerate(zip(cameras, _cameras_from_body(self.rig), strict=True)):
            found, by_camera = camera.project_with_jacobian(flat @ T[:3, :3].T + T[:3, 3])
            image[..., at, :] = found.reshape(*point.shape[:-1], 2)
            slope[..., at, :, :] = (by_camera @ T[:3, :3]).reshape(*point.shape[:-1], 2, 3)
        ahead = np.isfinite(image).all(axis=-1) & np.isfinite(slope).all(axis=(-1, -2)) & self.seen
        error = np.where(ahead[..., None], image - self.given, 0.0).reshape(*point.shape[:-1], 4)
        slopes = np.where(ahead[..., None, None], slope, 0.0).reshape(*point.shape[:-1], 4, 3)
        spread = self.model_sigma_m**2 * slopes @ np.swapaxes(slopes, -1, -2)
        for at in range(_CAMERAS):
            own = slice(2 * at, 2 * at + 2)
            spread[..., own, own] += self.covariance_px2[..., at, :, :]
        both = self.seen.all(axis=-1)
        across = np.broadcast_to(self.epipolar_px, both.shape)[both] ** 2
        spread[both] += across[:, None, None] * _across(slopes[both])
        whiten = np.asarray(np.linalg.inv(np.linalg.cholesky(spread)), dtype=np.float64)
        return (whiten @ error[..., None])[..., 0], whiten @ slopes

    def __getitem__(self, rows: Index) -> "Seen":
        """Some of the instants."""
        own = {name: getattr(self, name)[rows] for name in ("given", "covariance_px2", "seen", "epipolar_px")}
        return replace(self, **own)


def pixel_problem(
    half: HalfWing,
    rig: RigSide,
    pixels: Array,
    covariance_px2: Array,
    settings: FitSettings,
    epipolar_px: Array | float = 0.0,
) -> Unscaled:
    """The problem of centroids (…, M, 2, 2) with covariances (…, M, 2, 2, 2); raises ValueError for other shapes.

    Calibration makes the cameras disagree on lights by more than centroids' noise. No place of a light explains that,
    so ``epipolar_px``, one for all instants or each, widens what is across (both saw it), or half of its variance any
    direction (one did).
    """
    markers = len(half.marker_ids)
    if pixels.shape[-3:] != (markers, _CAMERAS, 2) or covariance_px2.shape[-4:] != (markers, _CAMERAS, 2, 2):
        raise ValueError(f"expected {markers} markers in 2 cameras, got {pixels.shape} and {covariance_px2.shape}")
    known = np.concatenate([pixels[..., None], covariance_px2], axis=-1)
    seen: Mask = np.isfinite(known).all(axis=(-1, -2))
    safe = np.where(seen[..., None, None], covariance_px2, np.eye(2))
    seen = np.logical_and(seen, np.linalg.eigvalsh(safe)[..., 0] > 0)
    safe = np.where(seen[..., None, None], safe, np.eye(2))
    given = np.where(seen[..., None], pixels, 0.0)
    sigma = np.broadcast_to(np.asarray(epipolar_px, dtype=np.float64), pixels.shape[:-3])[..., None]
    alone = np.where(seen.all(axis=-1), 0.0, sigma**2 / 2)
    safe = safe + alone[..., None, None, None] * np.eye(2)
    numbers: Array = 2.0 * seen.sum(axis=-1)
    measure = Seen(rig, given, safe, seen, sigma, settings.marker_model_sigma_m)
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
