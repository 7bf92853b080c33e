"""Matched pixels of a camera pair to points in the body frame, with the covariance that image noise gives them.

Points are worked out in ideal normalised coordinates (X/Z, Y/Z), to which pixels and their covariances are taken by the
lens model; over a centroid's error of some 0.01 px the lens is linear.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from process.camera_model import CameraModel, RigSide, StereoPair

Array = NDArray[np.float64]
Method = Literal["default", "linear", "paper"]

GAUSS_NEWTON_STEPS = 3
"""From a linear start a centroid's error away from the optimum each step squares what is left: 2 are enough."""
LEAST_PARALLAX = 1e-6  # sine of the angle between rays that counts as parallel
_SINGULAR = 1e-16  # determinant over the cube of the trace, where rounding has eaten it up


@dataclass(frozen=True, eq=False)
class Points:
    """N triangulated points; NaN, with a reason, where the rays do not meet in front of both cameras."""

    xyz_m: Array
    """(N, 3) body frame"""
    covariance_m2: Array
    """(N, 3, 3) body frame, from the centroids' covariances alone"""
    epipolar_px: Array
    """(N,) signed (Sampson) distance from the epipolar condition"""
    reasons: tuple[str, ...]
    """empty, ``parallel``, ``behind`` or ``outside_lens``"""

    @classmethod
    def join(cls, parts: Sequence["Points"]) -> "Points":
        """Those of all ``parts``, at least one, in their order."""
        return cls(
            np.concatenate([part.xyz_m for part in parts]),
            np.concatenate([part.covariance_m2 for part in parts]),
            np.concatenate([part.epipolar_px for part in parts]),
            tuple(reason for part in parts for reason in part.reasons),
        )


@dataclass(frozen=True, eq=False)
class Rays:
    """N centroids of one camera in ideal normalised coordinates."""

    xy: Array
    """(N, 2)"""
    covariance: Array
    """(N, 2, 2)"""

    def __getitem__(self, chosen: NDArray[np.intp] | slice) -> "Rays":
        return Rays(self.xy[chosen], self.covariance[chosen])

    @classmethod
    def join(cls, parts: Sequence["Rays"]) -> "Rays":
        """Those of all ``parts``, at least one, in their order."""
        return cls(np.concatenate([part.xy for part in parts]), np.concatenate([part.covariance for part in parts]))


def rays(camera: CameraModel, pixels: Array, covariance_px2: Array) -> Rays:
    """Normalised coordinates of ``pixels`` (N, 2), their covariances (N, 2, 2) taken along; NaN beyond the lens."""
    xy = camera.undistort(pixels)
    ahead = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    slope = camera.project_with_jacobian(ahead)[1][:, :, :2]  # pixels by normalised coordinates
    bad = ~_finite(slope)
    slope[bad] = np.eye(2)
    inverse = np.linalg.inv(slope)
    covariance = inverse @ covariance_px2 @ inverse.transpose(0, 2, 1)
    covariance[bad] = np.nan
    return Rays(xy, covariance)


def triangulate(
    side: RigSide, pixels0: Array, pixels1: Array, covariance0_px2: Array, covariance1_px2: Array, method: Method
) -> Points:
    """Points of N matched centroids (N, 2) with covariances (N, 2, 2).

    ``default``: least squares of the reprojection error in both cameras, each weighted by its covariance. ``linear``:
    least algebraic error (Hartley & Zisserman, section 12.2), as MATLAB's ``triangulate`` has it. ``paper``: eqs. 4 to
    6 on rectified pixels (errata: Q's last row has −1/T_x), the row taken from cam0.
    """
    rays0 = rays(side.pair.cam0, pixels0, covariance0_px2)
    rays1 = rays(side.pair.cam1, pixels1, covariance1_px2)
    return triangulate_as(method, side, rays0, rays1)


def triangulate_as(method: Method, side: RigSide, rays0: Rays, rays1: Rays) -> Points:
    """``triangulate`` of what is through the lens already."""
    if method == "paper":
        return _in_one_go(side, rays0, rays1, lambda xy0, xy1: _by_q(side.pair, xy0, xy1))
    if method == "linear":
        return _in_one_go(side, rays0, rays1, lambda xy0, xy1: _by_least_algebraic(side.pair, xy0, xy1))
    return triangulate_rays(side, rays0, rays1)


def triangulate_rays(side: RigSide, rays0: Rays, rays1: Rays) -> Points:
    """Maximum-likelihood points of N pairs of rays, in the body frame.

    Minimises Σ rᵢᵀ Σᵢ⁻¹ rᵢ over both cameras by Gauss–Newton from the point nearest to both rays; the covariance is
    (Σ Jᵢᵀ Σᵢ⁻¹ Jᵢ)⁻¹. (Hartley & Zisserman, Multiple View Geometry, 2nd ed., section 12.3: the same optimum.)
    """
    R, t = side.pair.T_cam1_cam0[:3, :3], side.pair.T_cam1_cam0[:3, 3]
    with np.errstate(all="ignore"):  # rays that do not meet overflow before they are set to NaN
        points = _nearest_to_rays(R, t, rays0.xy, rays1.xy)
        reasons = _reasons(R, t, rays0.xy, rays1.xy, points)
        good = np.array([not reason for reason in reasons], dtype=bool)
        points[~good] = (0.0, 0.0, 1.0)  # a stand-in that keeps the stacked systems regular
        weight0, weight1 = (_inverse_or_identity(r.covariance) for r in (rays0, rays1))
        for _ in range(GAUSS_NEWTON_STEPS):
            information, gradient = _normal_equations(R, t, points, rays0.xy, rays1.xy, weight0, weight1)
            step = np.einsum("nij,nj->ni", _inverse_or_nan(information), gradient)
            points = points + np.where(_finite(step)[:, None], step, 0.0)
        information, _ = _normal_equations(R, t, points, rays0.xy, rays1.xy, weight0, weight1)
        covariance = _inverse_or_nan(information)
    epipolar_px = epipolar_distance_px(side.pair, rays0.xy, rays1.xy)
    return _in_body(side, points, covariance, epipolar_px, reasons)


def epipolar_distance_px(pair: StereoPair, xy0: Array, xy1: Array) -> Array:
    """Signed Sampson distance (...) of normalised coordinates (..., 2) from x₁ᵀ E x₀ = 0, in pixels of cam0.

    Hartley & Zisserman, eq. 11.9. ``xy0`` and ``xy1`` are broadcast against each other.
    """
    essential = _cross(pair.T_cam1_cam0[:3, 3]) @ pair.T_cam1_cam0[:3, :3]
    x0, x1 = (np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1) for xy in (xy0, xy1))
    line1, line0 = x0 @ essential.T, x1 @ essential
    algebraic = np.sum(x1 * line1, axis=-1)
    gradient = np.sum(line1[..., :2] ** 2, axis=-1) + np.sum(line0[..., :2] ** 2, axis=-1)
    focal_px = np.sqrt(pair.cam0.K[0, 0] * pair.cam0.K[1, 1])
    return np.asarray(algebraic / np.sqrt(gradient) * focal_px)


def rectified_pixels(pair: StereoPair, camera: Literal[0, 1], xy: Array) -> Array:
    """Pixels (N, 2) of normalised coordinates (N, 2) in the pair's rectified images."""
    rectification = pair.rectification
    R, P = (rectification.R0, rectification.P0) if camera == 0 else (rectification.R1, rectification.P1)
    turned = np.concatenate([xy, np.ones((len(xy), 1))], axis=1) @ R.T
    projected = turned @ P[:, :3].T
    return np.asarray(projected[:, :2] / projected[:, 2:])


def _by_q(pair: StereoPair, xy0: Array, xy1: Array) -> Array:
    left, right = rectified_pixels(pair, 0, xy0), rectified_pixels(pair, 1, xy1)
    disparity = left[:, 0] - right[:, 0]
    stacked = np.stack([left[:, 0], left[:, 1], disparity, np.ones(len(left))], axis=1)  # eq. 5
    homogeneous = stacked @ pair.rectification.Q.T
    return np.asarray((homogeneous[:, :3] / homogeneous[:, 3:]) @ pair.rectification.R0)  # eq. 6, then cam0


def _by_least_algebraic(pair: StereoPair, xy0: Array, xy1: Array) -> Array:
    """Pixels and millimetres, as MATLAB has them: the result depends on the units by parts of a micrometre."""
    rows = []
    for xy, camera, T in ((xy0, pair.cam0, np.eye(4)), (xy1, pair.cam1, pair.T_cam1_cam0)):
        P = camera.K @ np.column_stack([T[:3, :3], 1000.0 * T[:3, 3]])
        pixels = xy @ camera.K[:2, :2].T + camera.K[:2, 2]
        rows += [pixels[:, axis, None] * P[2] - P[axis] for axis in (0, 1)]
    system = np.stack(rows, axis=1)
    finite = _finite(system)
    homogeneous = np.full((len(xy0), 4), np.nan)
    homogeneous[finite] = np.linalg.svd(system[finite])[2][:, -1]
    return np.asarray(homogeneous[:, :3] / homogeneous[:, 3:] / 1000.0)


def _in_one_go(side: RigSide, rays0: Rays, rays1: Rays, points_of: Callable[[Array, Array], Array]) -> Points:
    """Points in cam0's frame by a formula, the covariances taken through its derivatives."""
    R, t = side.pair.T_cam1_cam0[:3, :3], side.pair.T_cam1_cam0[:3, 3]
    with np.errstate(all="ignore"):
        points = points_of(rays0.xy, rays1.xy)
        reasons = _reasons(R, t, rays0.xy, rays1.xy, points)
        step = 1e-6  # normalised: a thousandth of a pixel, far above rounding
        covariance = np.zeros((len(points), 3, 3))
        for camera, ray in enumerate((rays0, rays1)):
            slope = np.empty((len(points), 3, 2))
            for axis in range(2):
                shift = step * np.eye(2)[axis]
                shifts = (shift, 0.0) if camera == 0 else (0.0, shift)
                ahead = points_of(rays0.xy + shifts[0], rays1.xy + shifts[1])
                behind = points_of(rays0.xy - shifts[0], rays1.xy - shifts[1])
                slope[:, :, axis] = (ahead - behind) / (2 * step)
            covariance += slope @ ray.covariance @ slope.transpose(0, 2, 1)
    return _in_body(side, points, covariance, epipolar_distance_px(side.pair, rays0.xy, rays1.xy), reasons)


def _nearest_to_rays(R: Array, t: Array, xy0: Array, xy1: Array) -> Array:
    """(N, 3) midpoints of the shortest segments between the rays, frame of cam0."""
    d0 = np.concatenate([xy0, np.ones((len(xy0), 1))], axis=1)
    d1 = np.concatenate([xy1, np.ones((len(xy1), 1))], axis=1) @ R  # into cam0
    centre1 = -R.T @ t
    a, b, c = np.sum(d0 * d0, axis=1), np.sum(d0 * d1, axis=1), np.sum(d1 * d1, axis=1)
    e, f = d0 @ centre1, d1 @ centre1
    determinant = a * c - b * b
    along0 = (c * e - b * f) / determinant
    along1 = (b * e - a * f) / determinant
    return np.asarray((d0 * along0[:, None] + centre1 + d1 * along1[:, None]) / 2.0)


def _reasons(R: Array, t: Array, xy0: Array, xy1: Array, points: Array) -> tuple[str, ...]:
    d0 = np.concatenate([xy0, np.ones((len(xy0), 1))], axis=1)
    d1 = np.concatenate([xy1, np.ones((len(xy1), 1))], axis=1) @ R
    sine = np.linalg.norm(np.cross(d0, d1), axis=1) / np.linalg.norm(d0, axis=1) / np.linalg.norm(d1, axis=1)
    depth1 = points @ R[2] + t[2]
    conditions = [
        ~(_finite(d0) & _finite(d1)),
        ~(sine >= LEAST_PARALLAX) | ~_finite(points),
        (points[:, 2] <= 0.0) | (depth1 <= 0.0),
    ]
    return tuple(np.select(conditions, ["outside_lens", "parallel", "behind"], "").tolist())


def _normal_equations(
    R: Array, t: Array, points: Array, xy0: Array, xy1: Array, weight0: Array, weight1: Array
) -> tuple[Array, Array]:
    information = np.zeros((len(points), 3, 3))
    gradient = np.zeros((len(points), 3))
    for rotation, shift, xy, weight in ((np.eye(3), np.zeros(3), xy0, weight0), (R, t, xy1, weight1)):
        seen = points @ rotation.T + shift
        projected = seen[:, :2] / seen[:, 2:]
        jacobian = (rotation[:2] - projected[:, :, None] * rotation[2]) / seen[:, 2, None, None]
        weighted = jacobian.transpose(0, 2, 1) @ weight
        information += weighted @ jacobian
        gradient += np.einsum("nij,nj->ni", weighted, xy - projected)
    return information, gradient


def _in_body(side: RigSide, points: Array, covariance: Array, epipolar_px: Array, reasons: Sequence[str]) -> Points:
    R, t = side.T_body_cam0[:3, :3], side.T_body_cam0[:3, 3]
    finite = _finite(points) & _finite(covariance)
    reasons = [reason or ("" if ok else "parallel") for reason, ok in zip(reasons, finite, strict=True)]
    bad = np.array([bool(reason) for reason in reasons], dtype=bool)
    xyz_m = points @ R.T + t
    covariance_m2 = R @ covariance @ R.T
    xyz_m[bad], covariance_m2[bad] = np.nan, np.nan
    return Points(xyz_m, covariance_m2, epipolar_px, tuple(reasons))


def _inverse_or_identity(matrices: Array) -> Array:
    """Of (N, 2, 2); the identity instead of one that is not finite."""
    a, b, c, d = np.where(_finite(matrices), matrices.reshape(-1, 4).T, np.eye(2).reshape(4, 1))
    return np.asarray((np.stack([d, -b, -c, a]) / (a * d - b * c)).T.reshape(-1, 2, 2))


def _inverse_or_nan(matrices: Array) -> Array:
    """Of symmetric (N, 3, 3), by cofactors; NaN instead of one that is singular or not finite."""
    a, b, c, _, d, e, _, _, f = matrices.reshape(-1, 9).T
    aa, ab, ac = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * aa + b * ab + c * ac
    size = a + d + f
    determinant = np.where(determinant > _SINGULAR * size * size * size, determinant, np.nan)
    bc = b * c - a * e
    cofactors = np.stack([aa, ab, ac, ab, a * f - c * c, bc, ac, bc, a * d - b * b])
    return np.asarray((cofactors / determinant).T.reshape(-1, 3, 3))


def _finite(stacked: Array) -> NDArray[np.bool_]:
    return np.asarray(np.isfinite(stacked.reshape(len(stacked), stacked[0:1].size)).all(axis=1))


def _cross(t: Array) -> Array:
    return np.array([[0.0, -t[2], t[1]], [t[2], 0.0, -t[0]], [-t[1], t[0], 0.0]])
