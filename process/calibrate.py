"""Corners of a board in many views of two cameras to the calibrated pair, with its uncertainty.

Two methods. ``paper``: each camera alone (Zhang), then the pose between them with the intrinsics held, as the paper's
§II.B and D. ``joint``: everything together, and by default the board's own printed corners too, which removes most of
the error that a nominal board leaves in the absolute position.
"""

from dataclasses import dataclass, field, replace
from enum import StrEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.errors import ProcessError
from process.board import Board
from process.bundle import INTRINSICS, Adjustment, Estimate, Freedom, adjust, residuals_of, rms_px, rotation_matrix
from process.camera_model import CameraModel, StereoPair, pose_matrix
from process.shared_error import triangulated_by_calibration

Array = NDArray[np.float64]

MIN_VIEWS = 3
MIN_VIEWS_FOR_PRINT = 6  # below it, the printed corners are not told from the lens: the nominal board is used
MIN_TILT_DEG = 5.0
OUTLIER_RATIO = 3.0
CORNER_RATIO = 10.0  # times its view's median: a normal error gets there once in 10^30
LEAST_BLUNDER_PX = 0.2
LEAST_CORNERS = 8  # of a view in each camera
DISAGREEMENT_RATIO = 6.0  # each camera alone is less sure of a view's distance: they disagree more than they fit
MOST_STEREO_TO_MONO = 1.5
SAME_OPTIMUM = 1.0 + 1e-4
CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 1000, 1e-12)


class Method(StrEnum):
    """Choices of ``--method``."""

    joint = "joint"
    paper = "paper"


@dataclass(frozen=True)
class CalibrationSettings:
    """How to calibrate."""

    method: Method = Method.joint
    nominal_board: bool = False
    distortion_terms: int = 5
    flatness_m: float = 0.0
    """how far the board may be bowed at its farthest corner, one sigma; 0: it is flat"""


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibrated pair and how well it fits."""

    pair: StereoPair
    settings: CalibrationSettings
    camera_rms_px: tuple[float, float]
    """method paper: of each camera alone (the paper's Table 5); joint: of each camera in the joint solution"""
    alone_rms_px: tuple[float, float]
    """of each camera calibrated alone on the nominal board"""
    stereo_rms_px: float
    two_stage_rms_px: float
    """of the paper's way: intrinsics held, nominal board"""
    stereo_to_mono_ratio: float
    """of that to the cameras alone: near 1 unless the pair moved, or the pictures are not of the same instant"""
    library_rms_px: tuple[float, float, float]
    """where OpenCV's own solvers ended: camera 0, camera 1, stereo with the intrinsics held"""
    sigma_px: float
    """noise of one coordinate, from the residuals"""
    gradient: float
    """0 at the optimum; see bundle.Adjustment"""
    board_m: Array
    """(N, 2) printed corners, estimated or nominal"""
    board_sigma_m: Array
    """(N, 2), zero for the nominal board"""
    estimate: Estimate
    """all that was found, the views used in their order"""
    freedom: Freedom
    """what was free in the last adjustment"""
    height_sigma_m: Array
    """(N,) of the corners out of the board's plane, zero for a flat board"""
    residuals_px: Array
    """(2, views, N, 2) of the views used; NaN where a corner was not seen, or left out"""
    used: NDArray[np.intp]
    """indices of the views used"""
    rejected: dict[int, str]
    """index of each view left out: why"""
    odd_corners: list[tuple[int, int, int, float]] = field(default_factory=list)
    """camera, view, corner and residual in pixels of corners that were left out alone"""
    warnings: list[str] = field(default_factory=list)


def calibrate(
    corners_px: Array, board: Board, size_px: tuple[int, int], settings: CalibrationSettings | None = None
) -> Calibration:
    """Calibrate a pair from ``corners_px`` (2, V, N, 2) of both cameras, in the board's order; NaN: not seen.

    ``size_px`` is the images' width and height. Views whose residuals stand out are left out and said, and so are
    single corners. Raises ProcessError, with the remedy, if fewer than three usable views remain, if they do not
    determine the cameras, or if the cameras are swapped.
    """
    settings = settings or CalibrationSettings()
    corners_px = np.array(corners_px, np.float64)
    used = np.arange(corners_px.shape[1])
    rejected: dict[int, str] = {}
    odd_corners: list[tuple[int, int, int, float]] = []
    while True:
        if len(used) < MIN_VIEWS:
            reasons = "; ".join(f"view {view + 1}: {reason}" for view, reason in rejected.items())
            raise ProcessError(
                f"{len(used)} usable views, at least {MIN_VIEWS} are needed" + (reasons and f" ({reasons})")
            )
        seen = np.ascontiguousarray(corners_px[:, used], np.float64)  # OpenCV takes no other layout
        check_poses_differ(seen[0], board, size_px)
        alone = _alone(seen, board, size_px, settings)
        blunders = _odd_corners(np.concatenate([adjustment.residuals_px for adjustment, _ in alone]))
        if not blunders:
            start = _join([adjustment for adjustment, _ in alone])
            if start.stereo[3] > 0.0:
                raise ProcessError(
                    "cam0 and cam1 are swapped: cam1 must be the right one as the pair looks at the board; "
                    "exchange --cam0 and --cam1"
                )
            # first where the views disagree on the pose between the cameras: an adjustment of few views bends to fit
            odd = _odd_view(residuals_of(start, seen)[1:], DISAGREEMENT_RATIO)
            if odd is None:
                stages = _solve(seen, alone, start, size_px, settings)
                blunders = _odd_corners(stages.final.residuals_px)
                odd = None if blunders else _odd_view(stages.final.residuals_px, OUTLIER_RATIO)
                if not blunders and odd is None:
                    return _result(stages, board, size_px, settings, used, rejected, odd_corners)
        for (camera, view, corner), off_px in blunders.items():
            odd_corners.append((camera, int(used[view]), corner, off_px))
            corners_px[camera, used[view], corner] = np.nan
        if not blunders and odd is not None:
            worst, reason = odd
            rejected[int(used[worst])] = reason
            used = np.delete(used, worst)


def _odd_view(residuals_px: Array, ratio: float) -> tuple[int, str] | None:
    """The view with the largest residuals (C, V, N, 2), and what is odd about it; None if none stands out."""
    view_rms = np.sqrt(np.nanmean(np.sum(residuals_px**2, axis=-1), axis=(0, 2)))
    worst, median = int(np.argmax(view_rms)), float(np.median(view_rms))
    if view_rms[worst] <= max(ratio * median, 1e-6):
        return None
    return worst, (
        f"residual {view_rms[worst]:.2f} px, the views' median is {median:.2f} px: the board moved between the two "
        "pictures, or they are not of the same instant"
    )


def _odd_corners(residuals_px: Array) -> dict[tuple[int, int, int], float]:
    """Camera, view and corner of residuals (C, V, N, 2) that are blunders, and their length: noise explains none.

    Against the view's own corners: a view that is wrong as a whole has none.
    """
    off_px = np.linalg.norm(residuals_px, axis=-1)
    usual_px = np.nanmedian(off_px, axis=2, keepdims=True)
    with np.errstate(invalid="ignore"):
        odd = np.argwhere(off_px > np.maximum(CORNER_RATIO * usual_px, LEAST_BLUNDER_PX))
    return {(int(c), int(v), int(n)): float(off_px[c, v, n]) for c, v, n in odd}


@dataclass(frozen=True, eq=False)
class _Library:
    """Where one of OpenCV's own solvers ended."""

    rms_px: float
    off_mm: float
    """what it places elsewhere than the optimum of its stage does: of a camera alone the farthest board, of the pose
    between them a point as far away"""


@dataclass(frozen=True, eq=False)
class _Stages:
    alone: list[Adjustment]
    two_stage: Adjustment
    final: Adjustment
    freedom: Freedom
    library: tuple[_Library, _Library, _Library]
    """cam0 alone, cam1 alone, the pose between"""


def _alone(
    corners_px: Array, board: Board, size_px: tuple[int, int], settings: CalibrationSettings
) -> list[tuple[Adjustment, _Library]]:
    """Each camera alone on the nominal board, and where OpenCV's own solver ended."""
    freedom = Freedom(distortion_terms=settings.distortion_terms)
    starts = [start_alone(corners, board, size_px, settings.distortion_terms) for corners in corners_px]
    found = []
    for corners, (start, ended_px) in zip(corners_px, starts, strict=True):
        own = adjust(corners[None], start, freedom)
        farthest = own.estimate.views[:, 5].argmax()
        moved_m = (start.views - own.estimate.views)[farthest, 3:]
        found.append((own, _Library(ended_px, 1000.0 * float(np.linalg.norm(moved_m)))))
    return found


def _solve(
    corners_px: Array,
    alone: list[tuple[Adjustment, _Library]],
    start: Estimate,
    size_px: tuple[int, int],
    settings: CalibrationSettings,
) -> _Stages:
    freedom = Freedom(intrinsics=False)
    two_stage = final = adjust(corners_px, start, freedom)
    stereo = _library_stereo(corners_px, start, two_stage.estimate, size_px)
    if settings.method is Method.joint:
        board_moves = not settings.nominal_board and corners_px.shape[1] >= MIN_VIEWS_FOR_PRINT
        freedom = Freedom(distortion_terms=settings.distortion_terms, board=board_moves)
        final = adjust(corners_px, two_stage.estimate, freedom)
        if settings.flatness_m > 0.0:
            for _ in range(2):  # the noise that the prior is weighed against is that of a board that may bow
                freedom = replace(freedom, bow_prior_px_per_m=final.sigma_px / settings.flatness_m)
                final = adjust(corners_px, two_stage.estimate, freedom)
    return _Stages([one for one, _ in alone], two_stage, final, freedom, (alone[0][1], alone[1][1], stereo))


def refit(corners_px: Array, start: Estimate, calibration: Calibration) -> Adjustment:
    """The calibration's own method once more, with other corners (2, V, N, 2), from ``start``, near its end.

    Outliers are not looked for. Raises what ``adjust`` does.
    """
    start = replace(start, height_m=0.0)  # its prior counts from there
    if calibration.settings.method is Method.joint:
        return adjust(corners_px, start, calibration.freedom)
    freedom = Freedom(distortion_terms=calibration.settings.distortion_terms)
    between = pose_matrix(start.stereo[:3], start.stereo[3:])
    from_cam1 = [between @ pose_matrix(view[:3], view[3:]) for view in start.views]
    views1 = np.array([np.concatenate([cv2.Rodrigues(T[:3, :3])[0].ravel(), T[:3, 3]]) for T in from_cam1])
    alone = [
        adjust(corners[None], replace(start, intrinsics=own[None], views=views), freedom)
        for corners, own, views in zip(corners_px, start.intrinsics, (start.views, views1), strict=True)
    ]
    return adjust(corners_px, _join(alone), calibration.freedom)


def start_alone(
    corners_px: Array, board: Board, size_px: tuple[int, int], distortion_terms: int
) -> tuple[Estimate, float]:
    """OpenCV's calibration (Zhang) of one camera from ``corners_px`` (V, N, 2), and its RMS in pixels."""
    plane = np.column_stack([board.points_m, np.zeros(board.corners)]).astype(np.float32)
    seen = [np.isfinite(view).all(axis=1) for view in corners_px]
    views = [view[own].astype(np.float32).reshape(-1, 1, 2) for view, own in zip(corners_px, seen, strict=True)]
    flags = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3 if distortion_terms == 2 else 0
    try:
        rms, K, distortion, rotations, translations = cv2.calibrateCamera(
            [plane[own] for own in seen], views, size_px, None, None, flags=flags, criteria=CRITERIA
        )
    except cv2.error as error:
        raise ProcessError("the views do not determine the camera: take views with the board tilted") from error
    poses = [np.concatenate([r.ravel(), t.ravel()]) for r, t in zip(rotations, translations, strict=True)]
    intrinsics = np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], distortion.ravel()[:5]])
    return Estimate(intrinsics[None], np.zeros(6), np.array(poses), board.points_m), float(rms)


def _join(alone: list[Adjustment]) -> Estimate:
    """Both cameras' estimates, and the pose between them that most views agree on."""
    poses = np.array(
        [
            pose_matrix(seen1[:3], seen1[3:]) @ np.linalg.inv(pose_matrix(seen0[:3], seen0[3:]))
            for seen0, seen1 in zip(*(one.estimate.views for one in alone), strict=True)
        ]
    )
    middle = np.median(poses[:, :3, 3], axis=0)
    U, _, Vt = np.linalg.svd(np.median(poses[:, :3, :3], axis=0))
    rotation = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    stereo = np.concatenate([cv2.Rodrigues(rotation)[0].ravel(), middle])
    intrinsics = np.vstack([one.estimate.intrinsics for one in alone])
    return Estimate(intrinsics, stereo, alone[0].estimate.views, alone[0].estimate.board_m)


def _library_stereo(corners_px: Array, start: Estimate, own: Estimate, size_px: tuple[int, int]) -> _Library:
    """Where cv2.stereoCalibrate ends with the intrinsics held: some versions stop early."""
    plane = np.column_stack([start.board_m, np.zeros(len(start.board_m))]).astype(np.float32)
    both = np.asarray(np.isfinite(corners_px).all(axis=(0, 3)))
    enough = np.flatnonzero(both.sum(axis=1) >= LEAST_CORNERS)
    if not len(enough):
        return _Library(np.nan, np.nan)
    views = [
        [camera[view, both[view]].astype(np.float32).reshape(-1, 1, 2) for view in enough] for camera in corners_px
    ]
    cameras = [CameraModel.from_intrinsics(*size_px, values) for values in start.intrinsics]
    rms, _, _, _, _, R, t, *_ = cv2.stereoCalibrate(
        [plane[both[view]] for view in enough],
        views[0],
        views[1],
        cameras[0].K.copy(),
        cameras[0].distortion.copy(),
        cameras[1].K.copy(),
        cameras[1].distortion.copy(),
        size_px,
        flags=cv2.CALIB_FIX_INTRINSIC,
        criteria=CRITERIA,
    )
    pair = StereoPair(cameras[0], cameras[1], pose_matrix(own.stereo[:3], own.stereo[3:]))
    response = triangulated_by_calibration(pair, pair.middle_of_view(float(own.views[:, 5].max()))[None])[0]
    moved = np.concatenate([cv2.Rodrigues(R)[0].ravel(), t.ravel()]) - own.stereo
    return _Library(float(rms), 1000.0 * float(np.linalg.norm(response[:, 2 * INTRINSICS :] @ moved)))


def _result(
    stages: _Stages,
    board: Board,
    size_px: tuple[int, int],
    settings: CalibrationSettings,
    used: NDArray[np.intp],
    rejected: dict[int, str],
    odd_corners: list[tuple[int, int, int, float]],
) -> Calibration:
    final, estimate = stages.final, stages.final.estimate
    joint = settings.method is Method.joint
    # the paper's way leaves the intrinsics out of its last step: that step's covariance alone would be far too small
    covariance = final.covariance + print_scale_covariance(estimate, board) if joint else None
    cam0, cam1 = (CameraModel.from_intrinsics(*size_px, values) for values in estimate.intrinsics)
    alone = (stages.alone[0].rms_px, stages.alone[1].rms_px)
    in_joint = (rms_px(final.residuals_px[0]), rms_px(final.residuals_px[1]))
    return Calibration(
        pair=StereoPair(cam0, cam1, pose_matrix(estimate.stereo[:3], estimate.stereo[3:]), covariance),
        settings=settings,
        camera_rms_px=in_joint if joint else alone,
        alone_rms_px=alone,
        stereo_rms_px=final.rms_px,
        two_stage_rms_px=stages.two_stage.rms_px,
        stereo_to_mono_ratio=_stereo_to_mono(stages),
        library_rms_px=(stages.library[0].rms_px, stages.library[1].rms_px, stages.library[2].rms_px),
        sigma_px=final.sigma_px,
        gradient=final.gradient,
        board_m=estimate.board_m,
        board_sigma_m=np.sqrt(np.diag(final.board_covariance_m2)).reshape(-1, 2),
        estimate=estimate,
        freedom=stages.freedom,
        height_sigma_m=final.height_sigma_m,
        residuals_px=final.residuals_px,
        used=used,
        rejected=rejected,
        odd_corners=odd_corners,
        warnings=_warnings(stages, settings, size_px, len(used)),
    )


def print_scale_covariance(estimate: Estimate, board: Board) -> Array:
    """(24, 24) what the corners cannot show: the mean scale of a board whose corners are printed with random errors."""
    errors = estimate.board_m - board.points_m
    moved = np.any(errors != 0.0, axis=1)
    print_variance = float(np.sum(errors**2)) / max(1, 2 * int(moved.sum()) - 4)
    scale_variance = print_variance / float(np.sum(board.points_m[moved] ** 2)) if moved.any() else 0.0
    translation = np.concatenate([np.zeros(estimate.intrinsics.size + 3), estimate.stereo[3:]])
    return scale_variance * np.outer(translation, translation)


def _stereo_to_mono(stages: _Stages) -> float:
    return stages.two_stage.rms_px / max(float(np.mean([one.rms_px for one in stages.alone])), 1e-9)


def _warnings(stages: _Stages, settings: CalibrationSettings, size_px: tuple[int, int], views: int) -> list[str]:
    found = []
    farthest_m = float(stages.two_stage.estimate.views[:, 5].max())
    for name, library, own in zip(
        ("cv2.calibrateCamera of cam0", "cv2.calibrateCamera of cam1", "cv2.stereoCalibrate"),
        stages.library,
        (*stages.alone, stages.two_stage),
        strict=True,
    ):
        if library.rms_px > own.rms_px * SAME_OPTIMUM + 1e-5:  # OpenCV's corners are single precision
            found.append(
                f"{name} stopped early at {library.rms_px:.4f} px; the optimum used here has {own.rms_px:.4f} px, and "
                f"places what is {farthest_m:.2g} m away {library.off_mm:.2f} mm elsewhere"
            )
    ratio = _stereo_to_mono(stages)
    if ratio > MOST_STEREO_TO_MONO:
        found.append(
            f"the stereo residual is {ratio:.1f} times that of the cameras alone: the pair moved, or the pictures "
            "were not taken at the same instant"
        )
    if settings.method is Method.joint and not settings.nominal_board and views < MIN_VIEWS_FOR_PRINT:
        found.append(f"{views} views are too few to estimate the printed corners: the nominal board was used")
    for camera, (fx, fy, cx, cy, *_) in enumerate(stages.final.estimate.intrinsics):
        if not (0 < cx < size_px[0] and 0 < cy < size_px[1]) or not 0.9 < fx / fy < 1.1:
            found.append(
                f"cam{camera} is implausible (fx {fx:.0f}, fy {fy:.0f}, cx {cx:.0f}, cy {cy:.0f} px): more views needed"
            )
    if stages.final.gradient > 1e-5:
        found.append(f"the optimum was not reached to full precision (gradient {stages.final.gradient:.1e})")
    return found


def check_poses_differ(corners_px: Array, board: Board, size_px: tuple[int, int]) -> None:
    """ProcessError unless the board is tilted differently in the views (V, N, 2): Zhang's method needs it."""
    focal = 1.2 * max(size_px)  # a guess is enough: equal views stay equal with any focal length
    K = np.array([[focal, 0, size_px[0] / 2], [0, focal, size_px[1] / 2], [0, 0, 1.0]])
    plane = np.column_stack([board.points_m, np.zeros(board.corners)])
    seen = [np.isfinite(view).all(axis=1) for view in corners_px]
    turns = [
        cv2.solvePnP(plane[own], view[own], K, None)[1].ravel() for view, own in zip(corners_px, seen, strict=True)
    ]
    normals = np.array([rotation_matrix(turn)[:, 2] for turn in turns])
    spread_deg = float(np.degrees(np.arccos(np.clip(normals @ normals.T, -1.0, 1.0)).max()))
    if spread_deg < MIN_TILT_DEG:
        raise ProcessError(
            f"the board is held the same way in all {len(corners_px)} views (normals within {spread_deg:.1f} deg): "
            "take views with the board tilted by 20 to 40 deg in different directions"
        )


def calibration_covariance_m2(pair: StereoPair, points_cam0: Array) -> Array:
    """Covariance (N, 3, 3) of triangulated points (N, 3), cam0's frame, from the calibration's own uncertainty.

    NaN if the pair has no covariance. See ``shared_error`` for points in the body frame, and for displacements.
    """
    points = np.asarray(points_cam0, np.float64).reshape(-1, 3)
    if pair.covariance is None:
        return np.full((len(points), 3, 3), np.nan)
    response = triangulated_by_calibration(pair, points)
    return np.asarray(response @ pair.covariance @ response.transpose(0, 2, 1))
