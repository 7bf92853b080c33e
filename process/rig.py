"""A pair's picture of surveyed lights to the pair's pose in the body frame, with its covariance.

The pose and the lights' true places minimise the reprojection errors in both cameras and the distances from the
surveyed places, each by its own sigma: the survey's errors are thereby part of the pose's covariance.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from capture.errors import ProcessError
from process.camera_model import StereoPair
from process.detect import Detections
from process.lens_check import LensCheck, check_lens
from process.pose_fit import CHI2_LIMIT, MEDIAN_CHI2, PoseProblem, kabsch, measured, project, triangulate_midpoint

Array = NDArray[np.float64]

MIN_POINTS = 4
EPIPOLAR_GATE_PX = 4.0
MOUNT_ANGLE_DEG = 8.0  # how far the mount may be from what the survey says
MOUNT_SHIFT_M = 0.10
HYPOTHESES = 2000
AGREE_PX = 12.0  # a hypothesis from three lights with survey errors predicts the others this well
ENOUGH = 0.75  # of the best score: no need to look for a better hypothesis
ASSIGN_PX = 60.0  # far enough for a light with a wrong coordinate to be named as such
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
    pixels: Array
    """(2, 2) measured; NaN if not used"""


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
    lens: LensCheck | None
    """None with too few lights to tell"""
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
    not determine the pose, if a lens was touched since calibration, or if they fit far worse than their sigmas say: the
    calibration is not of these cameras.
    """
    assigned = _assign(pair, T_approx, surveyed_m, spots0, spots1)
    seen = np.all(assigned >= 0, axis=1)
    reasons = [_why_unseen(pair, T_approx, point, spots) for point, spots in zip(surveyed_m, assigned, strict=True)]
    in_cam0 = np.full((len(names), 3), np.nan)
    in_cam0[seen] = triangulate_midpoint(pair, spots0.pixels[assigned[seen, 0]], spots1.pixels[assigned[seen, 1]])
    used = np.isfinite(in_cam0[:, 0])
    for lone in np.flatnonzero(seen & ~used):
        reasons[lone] = "the rays of its two spots do not meet"
    lens = None
    if used.sum() >= MIN_POINTS:
        start = kabsch(in_cam0[used], surveyed_m[used])
        lens = check_lens(pair, start, surveyed_m[used], sigma_m[used], *measured(assigned[used], spots0, spots1))
        _refuse_touched(lens)
    while True:
        if used.sum() < MIN_POINTS:
            detail = "; ".join(f"{name}: {reason}" for name, reason in zip(names, reasons, strict=True) if reason)
            raise ProcessError(
                f"{int(used.sum())} of {len(names)} surveyed lights can be used, {MIN_POINTS} are needed ({detail}); "
                "is the survey right, was a lens touched, and is this not the other side's pair file?"
            )
        problem = PoseProblem(pair, surveyed_m[used], sigma_m[used], *measured(assigned[used], spots0, spots1))
        T, chi2, covariance, residuals, by_calibration = problem.solve()
        worst = int(np.argmax(chi2))
        # measured against the others: with a poor calibration all are beyond their sigmas, and none is the culprit
        if chi2[worst] <= CHI2_LIMIT * max(1.0, float(np.median(chi2)) / MEDIAN_CHI2):
            break
        index = int(np.flatnonzero(used)[worst])
        used[index] = False
        reasons[index] = f"does not fit the others (chi2 {chi2[worst]:.0f} of 4): check its coordinates"
    seen_px = measured(assigned[used], spots0, spots1)[0]
    return _fit(
        names, surveyed_m, T, covariance, by_calibration, chi2, (residuals, seen_px), used, reasons, in_cam0, lens
    )


def _refuse_touched(lens: LensCheck | None) -> None:
    """ProcessError if the lights say what has changed since the calibration, and fit well once it is taken in."""
    if lens is not None and lens.findings() and lens.chi2_ratio <= WARNED_MISFIT**2:
        raise ProcessError(
            f"{' and '.join(lens.findings())}: a lens or a camera was touched after the calibration, or is this the "
            "other side's pair file? Calibrate the pair again"
        )


def _fit(
    names: list[str],
    surveyed_m: Array,
    T: Array,
    covariance: Array,
    by_calibration: Array,
    chi2: Array,
    in_images: tuple[Array, Array],
    used: NDArray[np.bool_],
    reasons: list[str],
    in_cam0: Array,
    lens: LensCheck | None,
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
    pixels = np.full((2, len(names), 2, 2), np.nan)
    pixels[:, used] = in_images
    points = [
        PointFit(name, bool(use), "" if use else reason, error, residual, seen)
        for name, use, reason, error, residual, seen in zip(names, used, reasons, errors, *pixels, strict=True)
    ]
    return PoseFit(T, covariance * max(1.0, ratio), by_calibration, points, ratio, lens, warnings)


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
            for camera_pixels, spots in zip(project(pair, T, surveyed_m), (spots0, spots1), strict=True)
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
            for predicted, spots in zip(project(pair, T, surveyed_m), (spots0, spots1), strict=True)
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
    again0, again1 = project(pair, np.eye(4), points)
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
    return None if flatness[1] < 0.03 * flatness[0] else kabsch(points_cam, points_body)


def _near_mount(T: Array, T_approx: Array) -> bool:
    cosine = 0.5 * (np.trace(T[:3, :3].T @ T_approx[:3, :3]) - 1.0)
    shift = np.linalg.norm(T[:3, 3] - T_approx[:3, 3])
    # three near lights with survey errors leave some play: twice the mount's own tolerance
    return bool(cosine > np.cos(np.radians(2 * MOUNT_ANGLE_DEG)) and shift < 2 * MOUNT_SHIFT_M)


def _why_unseen(pair: StereoPair, T_approx: Array, point: Array, spots: NDArray[np.intp]) -> str:
    missing = [f"cam{camera}" for camera in (0, 1) if spots[camera] < 0]
    if not missing:
        return ""
    size = np.array([pair.cam0.width, pair.cam0.height])
    for camera, pixels in enumerate(project(pair, T_approx, point[None])):
        if f"cam{camera}" in missing and not np.all((pixels > 0) & (pixels < size)):
            return f"outside the view of cam{camera}"
    return f"no light where it should be in {' and '.join(missing)}"
