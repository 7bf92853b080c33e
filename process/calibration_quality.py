"""A calibration to figures of merit: residuals and coverage by place in the image, uncertainty by place and range.

Maps are grids of ``CELLS`` over the image, row by row from the top left.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from process.board import Board
from process.calibrate import Calibration, calibration_covariance_m2
from process.camera_model import StereoPair
from process.cross_validation import CrossValidation, cross_validate
from process.json_file import finite_or_none
from process.next_view import NextView, advise, region_name

Array = NDArray[np.float64]

CELLS = (9, 12)  # rows and columns: whole parts of the 3 × 3 regions that are named
RANGES_M = (1.0, 2.0, 3.0)
LEAST_COMMON = 0.25  # of cam0's image, that the other camera sees too: with less the pair is not for that distance
EMPTY_SHARE = 0.5  # of a region's cells without a corner, from which on it is called empty
PATTERN_ALARM = 0.4  # of the residuals' pattern by the corners' noise


@dataclass(frozen=True, eq=False)
class ImageMap:
    """One camera's residuals and corners by cell of its image."""

    corners: NDArray[np.intp]
    """(rows, columns) corners measured in the cell, over all views"""
    common: NDArray[np.bool_]
    """(rows, columns) whether the other camera sees the cell too, at the farthest range that figures are given for"""
    mean_px: Array
    """(rows, columns, 2) mean residual, projected minus measured; NaN without corners"""
    pattern_px: float
    """RMS of a coordinate's mean residual beyond what noise leaves in it: 0 if the lens model is right"""
    empty: list[str]
    """parts of the image, by ninths, that both cameras see and where no board was"""

    @property
    def covered(self) -> float:
        """Share of the cells common to both cameras in which there was a corner."""
        return float(np.mean(self.corners[self.common] > 0)) if self.common.any() else 0.0


@dataclass(frozen=True, eq=False)
class UncertaintyMap:
    """What the calibration's covariance makes of a point seen at each place of cam0's image."""

    range_m: float
    sigma_mm: Array
    """(rows, columns) length of the three axes' sigmas, at the cells' middles; NaN where cam1 does not look"""

    @property
    def worst_mm(self) -> float:
        return _largest(self.sigma_mm)

    @property
    def median_mm(self) -> float:
        return float(np.nanmedian(self.sigma_mm)) if np.isfinite(self.sigma_mm).any() else np.nan

    @property
    def worst_place(self) -> str | None:
        """Part of the image, by ninths; None if nothing is known."""
        if not np.isfinite(self.sigma_mm).any():
            return None
        row, column = np.unravel_index(int(np.nanargmax(self.sigma_mm)), CELLS)
        return region_name(3 * int(row) // CELLS[0], 3 * int(column) // CELLS[1])


@dataclass(frozen=True, eq=False)
class Quality:
    """All of it."""

    images: tuple[ImageMap, ImageMap]
    uncertainty: list[UncertaintyMap]
    """at each of ``working_ranges_m``; empty with method ``paper``"""
    cross_validation: CrossValidation | None
    next_view: NextView | None

    def warnings(self, sigma_px: float, names: list[str]) -> list[str]:
        """What a person should know; the corners' noise ``sigma_px`` is the measure, ``names`` are the views'."""
        found = [
            f"cam{camera}: residuals have a pattern of {image.pattern_px:.3f} px over the image, noise is "
            f"{sigma_px:.3f}: the lens model is too simple, or the board is not flat"
            for camera, image in enumerate(self.images)
            if image.pattern_px > PATTERN_ALARM * sigma_px
        ]
        return found + (self.cross_validation.warnings(names) if self.cross_validation else [])

    def to_dict(self) -> dict[str, Any]:
        return {
            "images": [
                {"pattern_px": image.pattern_px, "covered_percent": 100.0 * image.covered, "empty": image.empty}
                for image in self.images
            ],
            "uncertainty": [
                {
                    "range_m": each.range_m,
                    "median_sigma_mm": finite_or_none(each.median_mm),
                    "worst_sigma_mm": finite_or_none(each.worst_mm),
                    "worst_place": each.worst_place,
                }
                for each in self.uncertainty
            ],
            "cross_validation": self.cross_validation and self.cross_validation.to_dict(),
            "next_view": self.next_view and self.next_view.to_dict(),
        }


def judge(calibration: Calibration, corners_px: Array, board: Board, folds: int) -> Quality:
    """Figures of merit of a calibration from ``corners_px`` (2, V, N, 2) of the views used; ``folds`` 0: no
    cross-validation."""
    first, second = (image_map(calibration, corners_px, camera) for camera in (0, 1))
    ranges_m = working_ranges_m(calibration)
    uncertainty = [uncertainty_map(calibration.pair, range_m) for range_m in ranges_m]
    known = calibration.pair.covariance is not None
    points = np.concatenate([common_points(calibration.pair, range_m) for range_m in ranges_m])
    return Quality(
        (first, second),
        uncertainty if known else [],
        cross_validate(calibration, corners_px, folds) if folds else None,
        advise(calibration, board, points[np.isfinite(points).all(axis=1)]),
    )


def working_ranges_m(calibration: Calibration) -> tuple[float, ...]:
    """Distances that figures are given for: those of ``RANGES_M`` at which the cameras see enough in common.

    Those of a pair that is turned in part again: if they do before the farthest of ``RANGES_M``, it is meant for where
    the board was, and the figures are for its nearest, median and farthest place.
    """
    pair = calibration.pair
    usual = tuple(range_m for range_m in RANGES_M if np.mean(_common(pair, 0, range_m)) >= LEAST_COMMON)
    if usual[-1:] == RANGES_M[-1:]:
        return usual
    board_m = np.percentile(calibration.estimate.views[:, 5], [0.0, 50.0, 100.0])
    return tuple(sorted({float(f"{range_m:.2g}") for range_m in board_m}))


def image_map(calibration: Calibration, corners_px: Array, camera: int) -> ImageMap:
    """Residuals and coverage of ``camera`` 0 or 1; a corner that was left out counts for neither."""
    residuals = calibration.residuals_px[camera].reshape(-1, 2)
    good = np.isfinite(residuals).all(axis=1)
    residuals, places = residuals[good], corners_px[camera].reshape(-1, 2)[good]
    own = (calibration.pair.cam0, calibration.pair.cam1)[camera]
    rows, columns = CELLS
    row, column = ((places[:, 1] + 0.5) * rows / own.height, (places[:, 0] + 0.5) * columns / own.width)
    cell = np.clip(row, 0, rows - 1).astype(int) * columns + np.clip(column, 0, columns - 1).astype(int)
    count = np.bincount(cell, minlength=rows * columns)
    sums = np.stack([np.bincount(cell, residuals[:, axis], rows * columns) for axis in (0, 1)], axis=1)
    mean = sums / np.where(count, count, np.nan)[:, None]
    corners = count.reshape(CELLS)
    common = _common(calibration.pair, camera, working_ranges_m(calibration)[-1])
    return ImageMap(
        corners,
        common,
        mean.reshape(*CELLS, 2),
        _pattern_px(mean, count, calibration.sigma_px),
        _empty(corners, common),
    )


def _pattern_px(mean_px: Array, count: NDArray[np.intp], sigma_px: float) -> float:
    """RMS over all corners of their cell's mean residual, less the variance that noise gives a mean."""
    used = count > 0
    squares = np.mean(mean_px[used] ** 2, axis=1) - sigma_px**2 / count[used]
    return float(np.sqrt(max(0.0, np.sum(count[used] * squares) / count.sum())))


def _empty(corners: NDArray[np.intp], common: NDArray[np.bool_]) -> list[str]:
    rows, columns = CELLS[0] // 3, CELLS[1] // 3
    names = []
    for row in range(3):
        for column in range(3):
            part = np.s_[row * rows : (row + 1) * rows, column * columns : (column + 1) * columns]
            wanted = common[part]
            if wanted.any() and np.mean(corners[part][wanted] == 0) > EMPTY_SHARE:
                names.append(region_name(row, column))
    return names


def uncertainty_map(pair: StereoPair, range_m: float) -> UncertaintyMap:
    """From the calibration alone: a bias that all frames share, beside which each frame's noise is to be seen."""
    covariance = calibration_covariance_m2(pair, common_points(pair, range_m))
    return UncertaintyMap(range_m, 1000.0 * np.sqrt(np.trace(covariance, axis1=1, axis2=2)).reshape(CELLS))


def common_points(pair: StereoPair, range_m: float) -> Array:
    """(rows · columns, 3) points, cam0's frame, at depth ``range_m`` in the middle of cam0's cells; NaN where cam1 does
    not look."""
    points = np.column_stack([pair.cam0.undistort(_cell_middles(pair, 0)), np.ones(CELLS[0] * CELLS[1])]) * range_m
    points[~_common(pair, 0, range_m).ravel()] = np.nan
    return points


def _common(pair: StereoPair, camera: int, range_m: float) -> NDArray[np.bool_]:
    """(rows, columns) whether the other camera sees the middle of the cell at ``range_m``."""
    own, other = (pair.cam0, pair.cam1)[:: 1 - 2 * camera]
    T = pair.T_cam1_cam0 if camera == 0 else np.linalg.inv(pair.T_cam1_cam0)
    ideal = own.undistort(_cell_middles(pair, camera))
    points = np.column_stack([ideal, np.ones(len(ideal))]) * range_m
    pixels = other.project(points @ T[:3, :3].T + T[:3, 3])
    with np.errstate(invalid="ignore"):
        return np.asarray(
            np.all((pixels >= -0.5) & (pixels <= [other.width - 0.5, other.height - 0.5]), axis=1).reshape(CELLS)
        )


def _cell_middles(pair: StereoPair, camera: int) -> Array:
    """(rows · columns, 2) pixels."""
    own = (pair.cam0, pair.cam1)[camera]
    v, u = np.meshgrid(*((np.arange(count) + 0.5) / count for count in CELLS), indexing="ij")
    return np.column_stack([u.ravel() * own.width, v.ravel() * own.height]) - 0.5


def _largest(values: Array) -> float:
    return float(np.nanmax(values)) if np.isfinite(values).any() else np.nan
