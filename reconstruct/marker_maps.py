"""A result → the figures that tell of each marker: how it was measured and how it agrees, on the wing and in time."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.colors import Colormap, LinearSegmentedColormap
from matplotlib.figure import Figure

from reconstruct.figures import WIDTH_IN, time_label
from reconstruct.result import Result
from reconstruct.tables import Floats, Ints

_PALE_BLUES = LinearSegmentedColormap.from_list("pale blues", ["#ffffff", "#7db8da"])


def residuals_by_marker(result: Result) -> Figure:
    """RMS residual of each marker over all sets, on the wing's plan."""
    values = {name: 1e3 * side.residuals.rms_m for name, side in result.sides.items()}
    markers = {name: side.residuals.marker for name, side in result.sides.items()}
    return marker_map(markers, values, "RMS residual, mm", "{:.2f}", "YlOrBr")


def residuals_map(result: Result) -> Figure:
    """RMS residual of each marker in time."""
    values = {name: (side.residuals.marker, 1e3 * side.residuals.in_time_m) for name, side in result.sides.items()}
    known = np.concatenate([one[np.isfinite(one)] for _, one in values.values()])
    top = float(np.percentile(known, 99)) if known.size else 1.0
    return time_map(result, values, "RMS residual, mm", "YlOrBr", (0.0, max(top, 1e-9)))


def markers_seen(result: Result) -> Figure:
    """Share of the sets in which each marker was measured, on the wing's plan."""
    values = {name: side.health.seen_percent for name, side in result.sides.items()}
    markers = {name: side.health.marker for name, side in result.sides.items()}
    return marker_map(markers, values, "measured in … % of the sets", "{:.0f}", "Blues", limits=(0.0, 220.0))


def markers_map(result: Result) -> Figure:
    """Share of the sets in which each marker was measured, in time."""
    values = {name: (side.health.marker, side.health.seen_in_time_percent) for name, side in result.sides.items()}
    return time_map(result, values, "measured in … % of the sets", _PALE_BLUES, (0.0, 100.0))


def error_by_marker(result: Result) -> Figure:
    """RMS 3-D error of each measured marker against the reference, on the wing's plan."""
    values = {name: 1e3 * errors.marker_rms_m for name, errors in result.errors.items()}
    markers = {name: errors.marker for name, errors in result.errors.items()}
    return marker_map(markers, values, "RMS 3-D error, mm", "{:.2f}", "YlOrBr")


def marker_map(
    markers: Mapping[str, Ints],
    values: Mapping[str, Floats],
    label: str,
    text: str,
    colours: str,
    limits: tuple[float, float] | None = None,
) -> Figure:
    """A number a marker on the plan of the wing: left tip … root … right tip, fore row above aft row."""
    pairs = 1 + max(int(own.max()) // 2 for own in markers.values())
    plan = np.full((2, 2 * pairs), np.nan)
    for name in values:
        for marker, value in zip(markers[name], values[name], strict=True):
            pair, row = divmod(int(marker), 2)
            plan[row, pairs + pair if name == "right" else pairs - 1 - pair] = value
    figure = Figure(figsize=(WIDTH_IN, 1.75), layout="constrained")
    axes = figure.subplots()
    top = np.nanmax(plan) if np.isfinite(plan).any() else 1.0
    low, high = limits or (0.0, 2.2 * max(float(top), 1e-9))
    axes.imshow(plan, cmap=colours, vmin=low, vmax=high, aspect="auto")
    for (row, column), value in np.ndenumerate(plan):
        shown = text.format(value) if np.isfinite(value) else "–"
        axes.text(column, row, shown, ha="center", va="center", fontsize=8, color="#222222")
    axes.axvline(pairs - 0.5, color="white", linewidth=5)
    axes.set_xticks(range(2 * pairs), [str(pair) for pair in (*range(pairs - 1, -1, -1), *range(pairs))])
    axes.set_yticks([0, 1], ["fore", "aft"])
    axes.set_xlabel("left wing ←      pair, 0 at the root      → right wing")
    axes.set_title(label)
    axes.grid(False)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    return figure


def time_map(
    result: Result,
    values: Mapping[str, tuple[Ints, Floats]],
    label: str,
    colours: str | Colormap,
    limits: tuple[float, float],
) -> Figure:
    """A number a marker and part of the flight (P, M), as colour: time to the right, tips outside."""
    figure = Figure(figsize=(WIDTH_IN, 0.7 + 0.085 * sum(marker.size for marker, _ in values.values())))
    figure.set_layout_engine("constrained")
    grid = figure.subplots(len(values), 1, sharex=True, squeeze=False)[:, 0]
    length_s = max((result.end_ns - result.start_ns) * 1e-9, 1e-3)
    picture: Any = None
    for axis, (name, (marker, own)) in zip(grid, values.items(), strict=True):
        extent = (0.0, length_s, -0.5, marker.size - 0.5)
        picture = axis.imshow(
            own.T, cmap=colours, vmin=limits[0], vmax=limits[1], aspect="auto", origin="lower", extent=extent,
            interpolation="nearest",
        )  # fmt: skip
        if name == "right" and len(values) > 1:
            axis.invert_yaxis()
        ticks = np.flatnonzero(marker % 6 == 0)
        axis.set_yticks(ticks, [str(marker[at]) for at in ticks])
        axis.set(ylabel=f"{name}, marker", facecolor="#f1f2f4")
        axis.grid(False)
    grid[-1].set_xlabel(time_label(result))
    figure.colorbar(picture, ax=list(grid), label=label, fraction=0.03, pad=0.01)
    return figure
