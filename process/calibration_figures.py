"""A calibration and its figures of merit to pictures, one function each."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from process.board import Board
from process.bundle import rms_px
from process.calibration_quality import CELLS, Quality, uncertainty_map, working_ranges_m
from process.calibration_session import SessionCalibration
from process.camera_model import StereoPair

BLUE, ORANGE = "#1f4e79", "#c55a11"
NEAREST, FARTHEST = 1 / 2, 4 / 3  # of the nearest and the farthest distance that figures are given for


def residuals(result: SessionCalibration) -> Figure:
    """An arrow for each corner."""
    figure = Figure(figsize=(11, 4.3), layout="constrained")
    calibration = result.calibration
    scale = 60.0 / max(3.0 * calibration.stereo_rms_px, 1e-6)  # a large residual is drawn 60 px long
    for camera, axes in enumerate(figure.subplots(1, 2)):
        places = result.corners_px[camera].reshape(-1, 2)
        arrows = calibration.residuals_px[camera].reshape(-1, 2) * scale
        axes.quiver(*places.T, *arrows.T, angles="xy", scale_units="xy", scale=1.0, width=0.0015, color=BLUE)
        _frame(axes, calibration.pair)
        axes.set_title(f"cam{camera}, {rms_px(calibration.residuals_px[camera]):.4f} px RMS")
    return figure


def pattern(result: SessionCalibration, quality: Quality) -> Figure:
    """Mean residual of each cell."""
    figure = Figure(figsize=(11, 4.3), layout="constrained")
    pair, noise_px = result.calibration.pair, result.calibration.sigma_px
    u, v = _cell_middles(pair)
    for camera, (axes, image) in enumerate(zip(figure.subplots(1, 2), quality.images, strict=True)):
        length = np.linalg.norm(image.mean_px, axis=-1)
        shown = axes.imshow(
            length, extent=_extent(pair), vmin=0.0, vmax=2.0 * max(noise_px, 1e-6), cmap="YlOrRd", interpolation="none"
        )
        arrows = image.mean_px * 0.4 * pair.cam0.width / CELLS[1] / max(noise_px, 1e-6)
        axes.quiver(u, v, arrows[..., 0], arrows[..., 1], angles="xy", scale_units="xy", scale=1.0, width=0.003)
        _frame(axes, pair)
        axes.set_title(f"cam{camera}: pattern {image.pattern_px:.4f} px, noise {noise_px:.4f} px")
        figure.colorbar(shown, ax=axes, label="mean residual, px", shrink=0.7)
    return figure


def coverage(result: SessionCalibration, quality: Quality) -> Figure:
    """Corners in each cell."""
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    pair = result.calibration.pair
    u, v = _cell_middles(pair)
    for camera, (axes, image) in enumerate(zip(figure.subplots(1, 2), quality.images, strict=True)):
        counts = np.where(image.corners > 0, image.corners, np.nan)
        shown = axes.imshow(counts, extent=_extent(pair), cmap="Blues", vmin=0.0, interpolation="none")
        empty = image.common & (image.corners == 0)
        axes.plot(u[empty], v[empty], "x", color=ORANGE, ms=6)
        axes.plot(u[~image.common], v[~image.common], ".", color="0.7", ms=4)
        _frame(axes, pair)
        axes.set_title(f"cam{camera}: {100 * image.covered:.0f} % of what both cameras see")
        figure.colorbar(shown, ax=axes, label="corners", shrink=0.7)
    return figure


def uncertainty_over_image(result: SessionCalibration, quality: Quality) -> Figure:
    """Sigma of a point by its place in cam0's image."""
    figure = Figure(figsize=(11, 3.2), layout="constrained")
    pair = result.calibration.pair
    plots = figure.subplots(1, len(quality.uncertainty), squeeze=False)[0]
    for axes, each in zip(plots, quality.uncertainty, strict=True):
        shown = axes.imshow(each.sigma_mm, extent=_extent(pair), cmap="viridis", vmin=0.0, interpolation="none")
        axes.set(
            title=f"{each.range_m:g} m: {each.median_mm:.2f} mm, worst {each.worst_mm:.2f} mm", xticks=[], yticks=[]
        )
        figure.colorbar(shown, ax=axes, label="mm", orientation="horizontal")
    return figure


def uncertainty_over_range(result: SessionCalibration) -> Figure:
    """Median and worst sigma of a point by its distance."""
    figure = Figure(figsize=(7, 3.5), layout="constrained")
    axes = figure.subplots()
    given_m = working_ranges_m(result.calibration)
    ranges_m = np.linspace(NEAREST * given_m[0], FARTHEST * given_m[-1], 15)
    maps = [uncertainty_map(result.calibration.pair, float(range_m)) for range_m in ranges_m]
    axes.plot(ranges_m, [each.worst_mm for each in maps], "--", color=ORANGE, label="worst place")
    axes.plot(ranges_m, [each.median_mm for each in maps], color=BLUE, label="median")
    axes.set(xlabel="distance, m", ylabel="sigma, mm", ylim=(0.0, None))
    axes.legend()
    axes.grid(alpha=0.3)
    return figure


def views(result: SessionCalibration, quality: Quality) -> Figure:
    """RMS of each view in the fit, and predicted by the others."""
    figure = Figure(figsize=(11, 3.2), layout="constrained")
    axes = figure.subplots()
    fitted_px = np.sqrt(np.nanmean(np.sum(result.calibration.residuals_px**2, axis=-1), axis=2))
    places = np.arange(len(result.used))
    for camera, colour in enumerate((BLUE, "#6fa0cc")):
        axes.bar(places + 0.4 * camera - 0.2, fitted_px[camera], 0.4, label=f"cam{camera}, in the fit", color=colour)
    if quality.cross_validation is not None:
        held_out_px = quality.cross_validation.view_rms_px
        axes.plot(places, held_out_px, "D", color=ORANGE, label="both, predicted by the others")
    axes.set_xticks(places, [path.stem for path, _ in result.used], rotation=90, fontsize=7)
    axes.set(ylabel="RMS, px")
    axes.legend()
    return figure


def board_print(result: SessionCalibration, board: Board) -> Figure:
    """Where the corners are, against where they should be."""
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    places_mm = 1000.0 * board.points_m
    errors_mm = 1000.0 * (result.calibration.board_m - board.points_m)
    largest = max(float(np.linalg.norm(errors_mm, axis=1).max()), 1e-6)
    scale = 800.0 * board.square_m / largest
    axes.quiver(*places_mm.T, *(scale * errors_mm).T, angles="xy", scale_units="xy", scale=1.0, width=0.003)
    axes.plot(*places_mm.T, ".", ms=3, color="0.6")
    axes.set(aspect="equal", xlabel="x, mm", ylabel="y, mm", title=f"longest arrow: {1000 * largest:.0f} um")
    axes.invert_yaxis()
    return figure


def board_height(result: SessionCalibration, board: Board) -> Figure:
    """How the board is bent."""
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    places_mm = 1000.0 * board.points_m
    height_mm = 1000.0 * result.calibration.estimate.corners_m[:, 2]
    shown = axes.scatter(places_mm[:, 0], places_mm[:, 1], c=height_mm, cmap="coolwarm", s=60)
    figure.colorbar(shown, ax=axes, label="away from the cameras, mm")
    axes.set(aspect="equal", xlabel="x, mm", ylabel="y, mm")
    axes.invert_yaxis()
    return figure


def _frame(axes: Axes, pair: StereoPair) -> None:
    axes.set(xlim=(0, pair.cam0.width), ylim=(pair.cam0.height, 0), aspect="equal", xlabel="u, px", ylabel="v, px")


def _extent(pair: StereoPair) -> tuple[float, float, float, float]:
    return -0.5, pair.cam0.width - 0.5, pair.cam0.height - 0.5, -0.5


def _cell_middles(pair: StereoPair) -> tuple[np.ndarray, np.ndarray]:
    """u and v, (rows, columns), pixels."""
    u, v = np.meshgrid(np.arange(CELLS[1]) + 0.5, np.arange(CELLS[0]) + 0.5)
    return u * pair.cam0.width / CELLS[1], v * pair.cam0.height / CELLS[0]
