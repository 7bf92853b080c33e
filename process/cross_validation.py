"""A calibration and its corners to how well it predicts views that it has not seen.

The views are dealt into folds. For each, the cameras and the board are calibrated without its views, and these are then
fitted by the pose of the board alone. What was only bent to fit shows: in the pixels, and in millimetres of the board's
own shape, triangulated.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.errors import ProcessError
from process.bundle import Adjustment, Freedom, adjust, rms_px
from process.calibrate import MIN_VIEWS, Calibration, refit
from process.camera_model import CameraModel, StereoPair, pose_matrix
from process.json_file import finite_or_none
from process.pose_fit import kabsch, triangulate_midpoint

Array = NDArray[np.float64]

FOLDS = 5
LEANING_RATIO = 2.0  # of a view's residual held out by that in the fit
ODD_RATIO = 2.0  # of a view's residual held out by the views' median
ALARM_RATIO = 1.5  # of the noise that held-out views show by the calibration's


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Residuals of the V views used, each predicted by the views of the other folds."""

    folds: int
    view_rms_px: Array
    """(V,) of both cameras, held out; NaN where the other views do not determine the cameras"""
    fitted_view_rms_px: Array
    """(V,) in the calibration"""
    board_rms_mm: Array
    """(V,) from the triangulated corners to the calibrated board, moved rigidly to fit"""
    rms_px: float
    fitted_rms_px: float
    noise_ratio: float
    """noise of a coordinate, as the held-out views have it, by the calibration's; freedoms counted: 1 if all is well"""
    leaning: NDArray[np.intp]
    """views that fit only because the calibration was made with them: blundered, or the only ones of their kind"""

    def warnings(self, names: list[str]) -> list[str]:
        """What a person should know, views by their ``names``."""
        found = []
        if self.noise_ratio > ALARM_RATIO:
            found.append(
                f"views that the calibration has not seen fit {self.noise_ratio:.1f} times worse than those that it "
                "was made with: more views are needed, or some are wrong"
            )
        if lost := int(np.isnan(self.view_rms_px).sum()):
            found.append(f"without {lost} of the views the others do not determine the cameras: more views are needed")
        found += [
            f"{names[view]}: {self.view_rms_px[view]:.2f} px when predicted by the other views, "
            f"{self.fitted_view_rms_px[view]:.2f} px in the fit: it is wrong, or the only one of "
            "its kind; take it again, and one more like it"
            for view in self.leaning
        ]
        return found

    def to_dict(self) -> dict[str, Any]:
        return {
            "folds": self.folds,
            "rms_px": finite_or_none(self.rms_px),
            "in_sample_rms_px": self.fitted_rms_px,
            "noise_ratio": finite_or_none(self.noise_ratio),
            "board_rms_mm": finite_or_none(float(np.sqrt(np.mean(self.board_rms_mm**2)))),
            "views": [
                {"rms_px": finite_or_none(held), "in_sample_rms_px": float(own), "board_rms_mm": finite_or_none(board)}
                for held, own, board in zip(self.view_rms_px, self.fitted_view_rms_px, self.board_rms_mm, strict=True)
            ],
            "leaning_views": self.leaning.tolist(),
        }


def cross_validate(calibration: Calibration, corners_px: Array, folds: int = FOLDS) -> CrossValidation | None:
    """Calibrate without the views of each fold, and predict them from ``corners_px`` (2, V, N, 2) of the views used.

    Of fewer than ten views each is a fold. None if there are too few views to do without any.
    """
    corners = np.where(np.isfinite(calibration.residuals_px), corners_px, np.nan)
    views = corners.shape[1]
    if views <= MIN_VIEWS:
        return None
    folds = views if views < 10 else min(folds, views)
    residuals, board_mm = np.full_like(corners, np.nan), np.full(views, np.nan)
    for fold in range(folds):
        held = np.arange(views) % folds == fold
        try:
            trained, predicted = _fold(calibration, corners, held)
        except ProcessError:  # the other views are too few, or too much alike: what is NaN here says so
            continue
        residuals[:, held] = predicted.residuals_px
        board_mm[held] = [_board_rms_mm(calibration, trained, corners[:, view]) for view in np.flatnonzero(held)]
    return _judged(calibration, folds, residuals, board_mm)


def _fold(calibration: Calibration, corners_px: Array, held: NDArray[np.bool_]) -> tuple[Adjustment, Adjustment]:
    """The calibration without the views ``held``, and these fitted by the board's pose alone."""
    estimate = calibration.estimate
    trained = refit(corners_px[:, ~held], replace(estimate, views=estimate.views[~held]), calibration)
    start = replace(trained.estimate, views=estimate.views[held])
    return trained, adjust(corners_px[:, held], start, Freedom(intrinsics=False, stereo=False))


def _board_rms_mm(calibration: Calibration, trained: Adjustment, corners_px: Array) -> float:
    """RMS distance of a view's corners (2, N, 2), triangulated by ``trained``, from the calibrated board."""
    both = np.isfinite(corners_px).all(axis=(0, 2))
    size = calibration.pair.cam0.width, calibration.pair.cam0.height
    cam0, cam1 = (CameraModel.from_intrinsics(*size, values) for values in trained.estimate.intrinsics)
    stereo = trained.estimate.stereo
    pair = StereoPair(cam0, cam1, pose_matrix(stereo[:3], stereo[3:]))
    points, board = triangulate_midpoint(pair, *corners_px[:, both]), calibration.estimate.corners_m[both]
    if len(points) < 3 or not np.isfinite(points).all():
        return np.nan
    T = kabsch(points, board)
    return float(1000.0 * np.sqrt(np.mean(np.sum((points @ T[:3, :3].T + T[:3, 3] - board) ** 2, axis=1))))


def _judged(calibration: Calibration, folds: int, residuals_px: Array, board_mm: Array) -> CrossValidation:
    held, own = (_view_rms_px(residuals) for residuals in (residuals_px, calibration.residuals_px))
    known = np.isfinite(held)
    counted = int(np.isfinite(residuals_px).sum()) - 6 * int(known.sum())
    if counted <= 0:
        whole, ratio, leaning = np.nan, np.nan, np.zeros(0, np.intp)
    else:
        whole = rms_px(residuals_px[:, known])
        ratio = float(np.sqrt(np.nansum(residuals_px**2) / counted)) / max(calibration.sigma_px, 1e-9)
        leaning = np.flatnonzero(known & (held > LEANING_RATIO * own) & (held > ODD_RATIO * np.nanmedian(held)))
    return CrossValidation(
        folds, held, own, board_mm, whole, rms_px(calibration.residuals_px), ratio, leaning.astype(np.intp)
    )


def _view_rms_px(residuals_px: Array) -> Array:
    """(V,) of residuals (2, V, N, 2); NaN where a view has none."""
    squares = np.sum(residuals_px**2, axis=-1)
    count = np.isfinite(squares).sum(axis=(0, 2))
    return np.asarray(np.sqrt(np.nansum(squares, axis=(0, 2)) / np.where(count, count, np.nan)))
