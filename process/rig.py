"""A pair's picture of surveyed lights to the pair's pose in the body frame, with its covariance.

The pose and the lights' true places minimise the reprojection errors in both cameras and the distances from the
surveyed places, each by its own sigma: the survey's errors are thereby part of the pose's covariance.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, linear_sum_assignment

from capture.errors import ProcessError
from process.bundle import cross_matrix, rotation_matrix
from process.camera_model import StereoPair
from process.detect import Detections

Array = NDArray[np.float64]

MIN_POINTS = 4
MODEL_SIGMA_PX = 0.03  # what the lens model and the spot model leave, added to each centroid's own noise
EPIPOLAR_GATE_PX = 4.0
MOUNT_ANGLE_DEG = 8.0  # how far the mount may be from what the survey says
MOUNT_SHIFT_M = 0.10
HYPOTHESES = 2000
AGREE_PX = 12.0  # a hypothesis from three lights with survey errors predicts the others this well
ENOUGH = 0.75  # of the best score: no need to look for a better hypothesis
ASSIGN_PX = 60.0  # far enough for a light with a wrong coordinate to be named as such
CHI2_LIMIT = 25.0  # of a light's 4 degrees of freedom: one good light in 20 000 is beyond
MAX_ROTATION_SIGMA_DEG = 0.5
WARNED_MISFIT, REFUSED_MISFIT = 2.0, 4.0  # times the sigmas; good pairs have 0.5 to 1.1, exchanged ones 8 to 35


@dataclass(frozen=True, eq=False)
class PointFit:
    """One surveyed light in the solution."""

    name: str
    used: bool
    reason: str
    """why it is not used"""
    error_body_m: Array
    """(3,) triangulated minus surveyed place; NaN if not seen by both cameras"""
    residuals_px: Array
    """(2, 2) measured minus projected, in cam0 and cam1, of the adjusted place; NaN if not used"""


@dataclass(frozen=True, eq=False)
class PoseFit:
    """A pair's pose in the body frame."""

    T_body_cam0: Array
    covariance: Array
    """(6, 6) of a small rotation (rad) and shift (m) in body axes; see camera_model.RigSide"""
    by_calibration: Array
    """(6, 24) how these change with the pair's parameters, the pictures being the same"""
    points: list[PointFit]
    chi2_ratio: float
    """χ² a degree of freedom: 1 if everything is as good as its sigma says"""
    warnings: list[str]


def approximate_pose(pair: StereoPair, position_m: Array, outboard: Array) -> Array:
    """T_body_cam0 (4, 4) of an upright pair whose middle is at ``position_m`` and that looks along ``outboard``."""
    look = np.asarray(outboard, np.float64) / np.linalg.norm(outboard)
    down = np.array([0.0, 0.0, -1.0])
    down -= (down @ look) * look
    down /= np.linalg.norm(down)
    T = np.eye(4)
    T[:3, :3] = np.stack([np.cross(down, look), down, look], axis=1)
    T[:3, 3] = position_m - 0.5 * pair.baseline_m * T[:3, 0]
    return T


def solve_pose(
    pair: StereoPair,
    T_approx: Array,
    names: list[str],
    surveyed_m: Array,
    sigma_m: Array,
    spots0: Detections,
    spots1: Detections,
) -> PoseFit:
    """Pose of ``pair`` from lights at ``surveyed_m`` (N, 3) ± ``sigma_m`` (N,), seen as spots in both cameras.

    ``T_approx`` (4, 4) may be wrong by 8 deg and 0.1 m. Which spot is which light is found, not given; lights that are
    not seen or do not fit are left out with a reason. Raises ProcessError with fewer than four good lights, if they do
    not determine the pose, or if they fit far worse than their sigmas say: the calibration is not of these cameras.
    """
    assigned = _assign(pair, T_approx, surveyed_m, spots0, spots1)
    seen = np.all(assigned >= 0, axis=1)
    reasons = [_why_unseen(pair, T_approx, point, spots) for point, spots in zip(surveyed_m, assigned, strict=True)]
    in_cam0 = np.full((len(names), 3), np.nan)
    in_cam0[seen] = triangulate_midpoint(pair, spots0.pixels[assigned[seen, 0]], spots1.pixels[assigned[seen, 1]])
    used = np.isfinite(in_cam0[:, 0])
    for lone in np.flatnonzero(seen & ~used):
        reasons[lone] = "the rays of its two spots do not meet"
    while True:
        if used.sum() < MIN_POINTS:
            detail = "; ".join(f"{name}: {reason}" for name, reason in zip(names, reasons, strict=True) if reason)
            raise ProcessError(
                f"{int(used.sum())} of {len(names)} surveyed lights can be used, {MIN_POINTS} are needed ({detail}); "
                "is the survey right, and is this not the other side's pair file?"
            )
        problem = _Problem(pair, surveyed_m[used], sigma_m[used], *_measured(assigned[used], spots0, spots1))
        T, chi2, covariance, residuals, by_calibration = problem.solve()
        worst = int(np.argmax(chi2))
        # measured against the others: with a poor calibration all are beyond their sigmas, and none is the culprit
        if chi2[worst] <= CHI2_LIMIT * max(1.0, float(np.median(chi2)) / 3.36):  # 3.36: median of χ² with 4
            break
        index = int(np.flatnonzero(used)[worst])
        used[index] = False
        reasons[index] = f"does not fit the others (chi2 {chi2[worst]:.0f} of 4): check its coordinates"
    return _fit(names, surveyed_m, T, covariance, by_calibration, chi2, residuals, used, reasons, in_cam0)


def _fit(
    names: list[str],
    surveyed_m: Array,
    T: Array,
    covariance: Array,
    by_calibration: Array,
    chi2: Array,
    residuals: Array,
    used: NDArray[np.bool_],
    reasons: list[str],
    in_cam0: Array,
) -> PoseFit:
    ratio = float(chi2.sum()) / (4 * len(chi2) - 6)
    rotation_sigma_deg = float(np.degrees(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])))
    if rotation_sigma_deg > MAX_ROTATION_SIGMA_DEG:
        raise ProcessError(
            f"the surveyed lights leave the pair's attitude uncertain by {rotation_sigma_deg:.1f} deg: "
            "they are nearly in a line; survey lights that are well apart in all directions"
        )
    errors = in_cam0 @ T[:3, :3].T + T[:3, 3] - surveyed_m
    misfit = f"the lights fit {np.sqrt(ratio):.1f} times worse than their sigmas say"
    if ratio > REFUSED_MISFIT**2:
        rms_mm = 1000.0 * np.sqrt(np.mean(np.sum(errors[used] ** 2, axis=1)))
        raise ProcessError(
            f"{misfit} ({rms_mm:.1f} mm RMS): is this the other side's pair file, or one of other cameras? Else the "
            "survey is wrong, or a lens was touched after the calibration: calibrate the pair again"
        )
    warnings = []
    if ratio > WARNED_MISFIT**2:
        warnings.append(f"{misfit}: the survey or the calibration is worse than stated")
    pixels = np.full((len(names), 2, 2), np.nan)
    pixels[used] = residuals
    points = [
        PointFit(name, bool(use), "" if use else reason, error, pixel)
        for name, use, reason, error, pixel in zip(names, used, reasons, errors, pixels, strict=True)
    ]
    return PoseFit(T, covariance * max(1.0, ratio), by_calibration, points, ratio, warnings)


def triangulate_midpoint(pair: StereoPair, pixels0: Array, pixels1: Array) -> Array:
    """Points (N, 3), cam0's frame, half way between the rays of ``pixels0`` and ``pixels1`` (N, 2); NaN if parallel."""
    R, t = pair.T_cam1_cam0[:3, :3], pair.T_cam1_cam0[:3, 3]
    ray0, ray1 = (
        np.column_stack([camera.undistort(pixels), np.ones(len(pixels))])
        for camera, pixels in ((pair.cam0, pixels0), (pair.cam1, pixels1))
    )
    ray1, centre1 = ray1 @ R, -R.T @ t
    a, b, c = (np.sum(x * y, axis=1) for x, y in ((ray0, ray0), (ray0, ray1), (ray1, ray1)))
    d, e = ray0 @ centre1, ray1 @ centre1
    with np.errstate(all="ignore"):  # parallel rays divide by zero: inf is set to NaN
        denominator = a * c - b * b
        s, u = (c * d - b * e) / denominator, (b * d - a * e) / denominator
        points = 0.5 * (s[:, None] * ray0 + centre1 + u[:, None] * ray1)
        ahead = (s > 0.0) & (u > 0.0) & np.all(np.isfinite(points), axis=1)
    points[~ahead] = np.nan
    return np.asarray(points)


def _assign(
    pair: StereoPair, T_approx: Array, surveyed_m: Array, spots0: Detections, spots1: Detections
) -> NDArray[np.intp]:
    """Index (N, 2) of each light's spot in cam0 and cam1; −1 where there is none."""
    nobody = np.full((len(surveyed_m), 2), -1, dtype=np.intp)
    if len(spots0) == 0 or len(spots1) == 0:
        return nobody
    T = _best_hypothesis(pair, T_approx, surveyed_m, spots0, spots1)
    if T is None:
        return nobody
    return np.stack(
        [
            _nearest_spots(camera_pixels, spots.pixels)
            for camera_pixels, spots in zip(_project(pair, T, surveyed_m), (spots0, spots1), strict=True)
        ],
        axis=1,
    )


def _nearest_spots(predicted_px: Array, spots_px: Array) -> NDArray[np.intp]:
    """Spot of each prediction, one to one with the least total distance; −1 beyond ASSIGN_PX."""
    distance = np.linalg.norm(predicted_px[:, None] - spots_px, axis=2)
    cost = np.minimum(np.nan_to_num(distance, nan=np.inf), ASSIGN_PX)
    rows, columns = linear_sum_assignment(cost)
    chosen = np.full(len(predicted_px), -1, dtype=np.intp)
    good = cost[rows, columns] < ASSIGN_PX
    chosen[rows[good]] = columns[good]
    return chosen


def _best_hypothesis(
    pair: StereoPair, T_approx: Array, surveyed_m: Array, spots0: Detections, spots1: Detections
) -> Array | None:
    """Pose on which most lights agree, among poses from three lights each (RANSAC with a fixed seed)."""
    candidates = _candidate_points(pair, spots0, spots1)
    expected = (surveyed_m - T_approx[:3, 3]) @ T_approx[:3, :3]
    reach = MOUNT_SHIFT_M + np.radians(MOUNT_ANGLE_DEG) * np.linalg.norm(expected, axis=1)
    near = [np.flatnonzero(np.linalg.norm(candidates - p, axis=1) < r) for p, r in zip(expected, reach, strict=True)]
    seen = [index for index, choice in enumerate(near) if choice.size]
    if len(seen) < 3:
        return None
    rng = np.random.default_rng(0)
    best: tuple[float, Array] | None = None
    for _ in range(HYPOTHESES):
        chosen = rng.choice(seen, 3, replace=False)
        picked = np.array([rng.choice(near[index]) for index in chosen])
        T = _align(candidates[picked], surveyed_m[chosen])
        if T is None or not _near_mount(T, T_approx):
            continue
        score = sum(
            _agreement(predicted, spots.pixels)
            for predicted, spots in zip(_project(pair, T, surveyed_m), (spots0, spots1), strict=True)
        )
        if best is None or score > best[0]:
            best = (score, T)
            if score > ENOUGH * 2 * len(seen):
                break
    return None if best is None else best[1]


def _candidate_points(pair: StereoPair, spots0: Detections, spots1: Detections) -> Array:
    """Points (M, 3), cam0's frame, of all pairs of spots whose rays meet."""
    first, second = (
        axis.ravel() for axis in np.meshgrid(np.arange(len(spots0)), np.arange(len(spots1)), indexing="ij")
    )
    points = triangulate_midpoint(pair, spots0.pixels[first], spots1.pixels[second])
    again0, again1 = _project(pair, np.eye(4), points)
    miss = np.linalg.norm(again0 - spots0.pixels[first], axis=1) + np.linalg.norm(
        again1 - spots1.pixels[second], axis=1
    )
    return np.asarray(points[miss < EPIPOLAR_GATE_PX])  # NaN is not below


def _agreement(predicted_px: Array, spots_px: Array) -> float:
    """How many lights have a spot where they are predicted, the nearer the more."""
    distance = np.linalg.norm(predicted_px[:, None] - spots_px, axis=2).min(axis=1)
    return float(np.sum(np.clip(1.0 - np.nan_to_num(distance, nan=np.inf) / AGREE_PX, 0.0, 1.0)))


def _align(points_cam: Array, points_body: Array) -> Array | None:
    """Pose from three points to their three places; None if the triangles differ or are nearly a line."""
    sides = [np.linalg.norm(a[[0, 1, 2]] - a[[1, 2, 0]], axis=1) for a in (points_cam, points_body)]
    if np.any(np.abs(sides[0] - sides[1]) > 0.05 * sides[1] + 0.01):
        return None
    flatness = np.linalg.svd(points_body - points_body.mean(axis=0), compute_uv=False)
    return None if flatness[1] < 0.03 * flatness[0] else _kabsch(points_cam, points_body)


def _kabsch(points_cam: Array, points_body: Array) -> Array:
    """Pose (4, 4) that takes ``points_cam`` (N, 3) to ``points_body`` with least squares (Kabsch, 1976)."""
    centre_cam, centre_body = points_cam.mean(axis=0), points_body.mean(axis=0)
    U, _, Vt = np.linalg.svd((points_body - centre_body).T @ (points_cam - centre_cam))
    T = np.eye(4)
    T[:3, :3] = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    T[:3, 3] = centre_body - T[:3, :3] @ centre_cam
    return T


def _near_mount(T: Array, T_approx: Array) -> bool:
    cosine = 0.5 * (np.trace(T[:3, :3].T @ T_approx[:3, :3]) - 1.0)
    shift = np.linalg.norm(T[:3, 3] - T_approx[:3, 3])
    # three near lights with survey errors leave some play: twice the mount's own tolerance
    return bool(cosine > np.cos(np.radians(2 * MOUNT_ANGLE_DEG)) and shift < 2 * MOUNT_SHIFT_M)


def _project(pair: StereoPair, T_body_cam0: Array, points_body: Array) -> tuple[Array, Array]:
    in_cam0 = (points_body - T_body_cam0[:3, 3]) @ T_body_cam0[:3, :3]
    in_cam1 = in_cam0 @ pair.T_cam1_cam0[:3, :3].T + pair.T_cam1_cam0[:3, 3]
    return pair.cam0.project(in_cam0), pair.cam1.project(in_cam1)


def _why_unseen(pair: StereoPair, T_approx: Array, point: Array, spots: NDArray[np.intp]) -> str:
    missing = [f"cam{camera}" for camera in (0, 1) if spots[camera] < 0]
    if not missing:
        return ""
    size = np.array([pair.cam0.width, pair.cam0.height])
    for camera, pixels in enumerate(_project(pair, T_approx, point[None])):
        if f"cam{camera}" in missing and not np.all((pixels > 0) & (pixels < size)):
            return f"outside the view of cam{camera}"
    return f"no light where it should be in {' and '.join(missing)}"


def _measured(assigned: NDArray[np.intp], spots0: Detections, spots1: Detections) -> tuple[Array, Array]:
    """Pixels (N, 2, 2) by light and camera, and the inverse square roots (N, 2, 2, 2) of their covariances."""
    pixels = np.stack([spots0.pixels[assigned[:, 0]], spots1.pixels[assigned[:, 1]]], axis=1)
    covariance = np.stack([spots0.covariance_px2[assigned[:, 0]], spots1.covariance_px2[assigned[:, 1]]], axis=1)
    covariance = np.nan_to_num(covariance, nan=0.0) + MODEL_SIGMA_PX**2 * np.eye(2)
    return pixels, np.linalg.inv(np.linalg.cholesky(covariance))


class _Problem:
    """Unknowns: the pose's change (rotation vector, shift; body axes), then each light's offset from its survey."""

    def __init__(self, pair: StereoPair, surveyed_m: Array, sigma_m: Array, pixels: Array, whitening: Array) -> None:
        self._pair, self._surveyed, self._sigma = pair, surveyed_m, sigma_m
        self._pixels, self._whitening = pixels, whitening

    def solve(self) -> tuple[Array, Array, Array, Array, Array]:
        """T_body_cam0, χ² of each light, the pose's covariance, residuals in pixels (N, 2, 2), pose by calibration."""
        points = triangulate_midpoint(self._pair, self._pixels[:, 0], self._pixels[:, 1])
        T = _kabsch(points, self._surveyed)
        count = len(self._surveyed)
        solution = least_squares(
            lambda x: self._residuals(T, x)[0],
            np.zeros(6 + 3 * count),
            jac=lambda x: self._residuals(T, x)[1],
            x_scale="jac",
            xtol=1e-12,
            ftol=1e-14,
            gtol=1e-12,
        )
        moved = _moved(T, solution.x[:6])
        residuals, jacobian = self._residuals(moved, np.concatenate([np.zeros(6), solution.x[6:]]))
        by_light = np.hstack([residuals[: 4 * count].reshape(count, 4), residuals[4 * count :].reshape(count, 3)])
        chi2: Array = np.sum(by_light**2, axis=1)
        inverse = np.linalg.inv(jacobian.T @ jacobian)
        covariance = np.asarray(inverse[:6, :6], np.float64)
        # the optimum stays one when θ changes: Jᵀ J dx + Jᵀ (∂r/∂θ) dθ = 0, to first order
        by_calibration = -inverse[:6] @ jacobian.T @ self._by_calibration(moved, solution.x[6:])
        projected = np.stack(_project(self._pair, moved, self._surveyed + solution.x[6:].reshape(-1, 3)), axis=1)
        return moved, chi2, covariance, np.asarray(self._pixels - projected), np.asarray(by_calibration)

    def _by_calibration(self, T: Array, offsets: Array) -> Array:
        """Derivative (7N, 24) of the residuals by the pair's parameters."""
        values, x = self._pair.parameters, np.concatenate([np.zeros(6), offsets])
        slope = np.empty((7 * len(self._surveyed), len(values)))
        for index, value in enumerate(values):
            step = np.zeros(len(values))
            step[index] = 1e-6 * max(1.0, abs(value))
            ahead, behind = (
                _Problem(
                    self._pair.with_parameters(values + sign * step),
                    self._surveyed,
                    self._sigma,
                    self._pixels,
                    self._whitening,
                )._residuals(T, x)[0]
                for sign in (1, -1)
            )
            slope[:, index] = (ahead - behind) / (2 * step[index])
        return slope

    def _residuals(self, T_start: Array, x: Array) -> tuple[Array, Array]:
        """Whitened residuals (7N,), pixels then survey, and their Jacobian (7N, 6 + 3N)."""
        count = len(self._surveyed)
        offsets = x[6:].reshape(-1, 3)
        T = _moved(T_start, x[:6])
        R = T[:3, :3]
        from_pair = self._surveyed + offsets - T[:3, 3]
        in_cam0 = from_pair @ R
        R10, t10 = self._pair.T_cam1_cam0[:3, :3], self._pair.T_cam1_cam0[:3, 3]
        pixels0, by_cam0 = self._pair.cam0.project_with_jacobian(in_cam0)
        pixels1, by_cam1 = self._pair.cam1.project_with_jacobian(in_cam0 @ R10.T + t10)
        by_point = self._whitening @ (np.stack([by_cam0, by_cam1 @ R10], axis=1) @ R.T)  # (N, 2, 2, 3), body axes
        error = (self._whitening @ (np.stack([pixels0, pixels1], axis=1) - self._pixels)[..., None])[..., 0]
        jacobian = np.zeros((7 * count, len(x)))
        # R = exp(ω) R0: d(Rᵀ v)/dω = Rᵀ [v]× J(ω), with J(ω) = I at the solution, where it is used for covariances
        by_turn = cross_matrix(from_pair) @ _left_jacobian(x[:3])
        jacobian[: 4 * count, :3] = (by_point @ by_turn[:, None]).reshape(-1, 3)
        jacobian[: 4 * count, 3:6] = -by_point.reshape(-1, 3)
        for light in range(count):
            jacobian[4 * light : 4 * light + 4, 6 + 3 * light : 9 + 3 * light] = by_point[light].reshape(4, 3)
        jacobian[4 * count :, 6:] = np.diag(np.repeat(1.0 / self._sigma, 3))
        return np.concatenate([error.ravel(), (offsets / self._sigma[:, None]).ravel()]), jacobian


def _left_jacobian(rotation_rad: Array) -> Array:
    """To second order: the change from the aligned start is some milliradians."""
    w = cross_matrix(rotation_rad)
    return np.asarray(np.eye(3) + 0.5 * w + w @ w / 6.0)


def _moved(T: Array, change: Array) -> Array:
    moved = T.copy()
    moved[:3, :3] = rotation_matrix(change[:3]) @ T[:3, :3]
    moved[:3, 3] += change[3:6]
    return moved
