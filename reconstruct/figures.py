"""A result → the figures of its report: the wing, its motion, and how well model and markers agree."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from reconstruct.result import Result, SideResult
from reconstruct.shown import DETAIL_S, Heights, highest_ns, leading
from reconstruct.tables import Floats, Ints, rms

COLOURS = {"left": "#2a6496", "right": "#b5502a"}
INSTANT_COLOURS = ("#54709e", "#3d3d3d", "#b5502a")
GREY, DARK = "#a9adb2", "#3d3d3d"
STYLE: dict[str, Any] = {
    "font.size": 9,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelcolor": "#444444",
    "axes.edgecolor": "#888888",
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e6e8",
    "grid.linewidth": 0.7,
    "xtick.color": "#555555",
    "ytick.color": "#555555",
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "lines.linewidth": 1.3,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "figure.facecolor": "white",
    "savefig.dpi": 150,
}
WIDTH_IN = 8.4
DRAWN_SETS = 600  # more in one curve are drawn as mean and range


def wing_3d(result: Result) -> Figure:
    """Both half wings in space at the lowest, the middle and the highest instant; the unloaded wing in grey."""
    height_in, wide = 2.9, 0.9  # the axes are a square as wide as the picture, which shows its middle
    figure = Figure(figsize=(WIDTH_IN, height_in))
    tall = wide * WIDTH_IN / height_in
    axes: Any = figure.add_axes((0.5 - wide / 2, 0.46 - tall / 2, wide, tall), projection="3d", computed_zorder=False)
    first = _first(result)
    for side in result.sides.values():
        axes.plot(*side.unloaded_xyz_m.T, color=GREY, linewidth=2.2, label="unloaded" if side is first else None)
    for (name, triggers), colour in zip(result.shown.instants.items(), INSTANT_COLOURS, strict=False):
        for which, side in result.sides.items():
            shape, row = side.sample.shape, _row(side, triggers[which])
            label = f"{name}, {(shape.timestamp_ns[row] - result.start_ns) * 1e-9:.2f} s" if side is first else None
            axes.plot(*shape.xyz_m[row].T, color=colour, linewidth=1.8, label=label)
            _ribs(axes, side, row, colour)
    _equal_box(axes, result)
    axes.set_xticks([])  # the chord is too short for a scale
    axes.view_init(elev=16, azim=-22)  # from behind and a little to the left
    figure.legend(loc="upper left", bbox_to_anchor=(0.02, 0.98))
    return figure


def is_long(result: Result) -> bool:
    """Whether single oscillations can no longer be told apart in a figure of the whole flight."""
    return (result.end_ns - result.start_ns) * 1e-9 > DETAIL_S


def tip(result: Result) -> Figure:
    """Displacement of the tip and its twist in time, with bands of two sigma; of a long flight around its highest."""
    start = (highest_ns(_heights(result)) - result.start_ns) * 1e-9 - DETAIL_S / 2
    return _tip(result, (start, start + DETAIL_S) if is_long(result) else (-np.inf, np.inf))


def tip_whole(result: Result) -> Figure:
    """The same of the whole flight."""
    return _tip(result, (-np.inf, np.inf))


def _tip(result: Result, between_s: tuple[float, float]) -> Figure:
    figure, axes = panels(3, 1, 5.6)
    for name, side in result.sides.items():
        time = seconds(result, side)
        time = np.where((time >= between_s[0]) & (time <= between_s[1]), time, np.nan)
        for axis, (value, scale) in zip(
            axes, (("tip_dz_m", 1e3), ("tip_dx_m", 1e3), ("tip_twist_deg", 1.0)), strict=True
        ):
            _band(axis, time, scale * side.frames[value], scale * side.frames[f"sigma_{value}"], name)
    axes[0].set(title=f"Tip displacement from the {result.reference}, up", ylabel="mm")
    axes[1].set(title=f"Tip displacement from the {result.reference}, aft", ylabel="mm")
    axes[2].set(title="Tip twist, nose-up", ylabel="deg", xlabel=time_label(result))
    legend(axes[0])
    return figure


def span(result: Result) -> Figure:
    """Vertical displacement and twist along the span: all sets as bands, chosen instants as lines."""
    figure = Figure(figsize=(WIDTH_IN, 4.9), layout="constrained")
    grid = figure.subplots(2, len(result.sides), sharex="col", sharey="row", squeeze=False)
    for column, (name, side) in enumerate(result.sides.items()):
        shape = side.sample.shape
        even = _even_rows(result, side)
        lift = 1e3 * (shape.xyz_m - side.reference_xyz_m)[..., 2]
        twist = shape.twist_deg - side.reference_twist_deg
        lift_range = 1e3 * (side.z_range_m - side.reference_xyz_m[:, 2])
        ranges = (lift_range, side.twist_range_deg - side.reference_twist_deg)
        for axis, values, outer in zip(grid[:, column], (lift, twist), ranges, strict=True):
            _envelope(axis, shape.s_m, values[even], outer)
            for (label, triggers), colour in zip(result.shown.instants.items(), INSTANT_COLOURS, strict=False):
                axis.plot(shape.s_m, values[_row(side, triggers[name])], color=colour, label=label)
            axis.axhline(0.0, color=GREY, linewidth=1.0, zorder=1)
        grid[0, column].set(title=f"{name.capitalize()} wing: displacement, up")
        grid[1, column].set(title=f"{name.capitalize()} wing: twist", xlabel="along the span s, m")
        if name == "left":  # as the wing hangs on the aircraft: tip outside
            grid[1, column].invert_xaxis()
    grid[0, 0].set_ylabel("mm")
    grid[1, 0].set_ylabel("deg")
    grid[0, -1].legend(loc="best")
    return figure


def sigmas(result: Result) -> Figure:
    """What the fit states of its own uncertainty, along the span (median over all sets)."""
    figure, axes = panels(1, 2, 2.7, sharex=False)
    for name, side in result.sides.items():
        shape, even = side.sample.shape, _even_rows(result, side)
        fitted = even[np.isfinite(shape.xyz_m[even]).all(axis=(1, 2))]
        if not fitted.size:
            continue
        distance = np.linalg.norm(shape.sigma_xyz_m[fitted], axis=-1)
        axes[0].plot(shape.s_m, 1e3 * np.median(distance, axis=0), color=COLOURS[name], label=name)
        axes[1].plot(shape.s_m, np.median(shape.sigma_twist_deg[fitted], axis=0), color=COLOURS[name])
    axes[0].set(title="One sigma of the position", xlabel="along the span s, m", ylabel="mm", ylim=(0, None))
    axes[1].set(title="One sigma of the twist", xlabel="along the span s, m", ylabel="deg", ylim=(0, None))
    axes[0].legend(loc="upper left")
    return figure


def residuals_in_time(result: Result) -> Figure:
    """RMS distance between measured and fitted markers, and χ² a degree of freedom, set by set."""
    figure, axes = panels(2, 1, 3.7)
    for name, side in result.sides.items():
        time = seconds(result, side)
        curve(axes[0], time, side.frames["residual_rms_mm"], name)
        curve(axes[1], time, side.frames["chi2_per_dof"], name)
    axes[1].axhline(1.0, color=GREY, linewidth=1.0, linestyle="--")
    axes[0].set(title="Residual of the markers (RMS of the set)", ylabel="mm", ylim=(0, None))
    axes[1].set(title="χ² a degree of freedom (1: as the stated noise)", xlabel=time_label(result), ylim=(0, None))
    legend(axes[0])
    return figure


def loads(result: Result) -> Figure:
    """Sum of the fitted loads and their moment at the root, in time."""
    figure, axes = panels(2, 1, 3.7)
    for name, side in result.sides.items():
        time = seconds(result, side)
        _band(axes[0], time, side.frames["net_fz_n"], side.frames["sigma_net_fz_n"], name)
        tip_up = 1.0 if name == "right" else -1.0
        _band(axes[1], time, tip_up * side.frames["net_mx_nm"], side.frames["sigma_net_mx_nm"], name)
    axes[0].set(title="Sum of the fitted forces, up", ylabel="N")
    axes[1].set(title="Their bending moment at the root, tip up", ylabel="N·m", xlabel=time_label(result))
    legend(axes[0])
    return figure


def error_in_time(result: Result) -> Figure:
    """Error of shape, tip and twist against the reference, set by set."""
    figure, axes = panels(3, 1, 5.2)
    for name, errors in result.errors.items():
        time = np.asarray((errors.timestamp_ns - result.start_ns) * 1e-9, dtype=np.float64)
        curve(axes[0], time, 1e3 * errors.shape_rms_m, name)
        curve(axes[1], time, 1e3 * errors.tip_m, name)
        curve(axes[2], time, errors.twist_rms_deg, name)
    axes[0].set(title="Shape error (RMS over the stations)", ylabel="mm", ylim=(0, None))
    axes[1].set(title="Tip error (3-D distance)", ylabel="mm", ylim=(0, None))
    axes[2].set(title="Twist error (RMS over the stations)", ylabel="deg", ylim=(0, None), xlabel=time_label(result))
    legend(axes[0])
    return figure


def error_along_span(result: Result) -> Figure:
    """RMS error along the span (solid) beside the sigma that the fit states (dashed)."""
    figure, axes = panels(1, 2, 2.9, sharex=False)
    for name, errors in result.errors.items():
        side = result.sides[name]
        shape, even = side.sample.shape, _even_rows(result, side)
        sigma_mm = 1e3 * rms(np.linalg.norm(shape.sigma_xyz_m[even], axis=-1), axis=0)
        stated = (sigma_mm, rms(shape.sigma_twist_deg[even], axis=0))
        found = (1e3 * errors.along_rms_m, errors.along_twist_rms_deg)
        for axis, error, sigma in zip(axes, found, stated, strict=True):
            axis.plot(side.s_m, error, color=COLOURS[name], label=name)
            shown = np.where(np.isfinite(error), sigma, np.nan)
            axis.plot(side.s_m, shown, color=COLOURS[name], linestyle="--", linewidth=1.0)
    axes[0].plot([], [], color="#555555", linestyle="--", linewidth=1.0, label="stated sigma")
    axes[0].set(title="Position error (RMS)", xlabel="along the span s, m", ylabel="mm", ylim=(0, None))
    axes[1].set(title="Twist error (RMS)", xlabel="along the span s, m", ylabel="deg", ylim=(0, None))
    axes[0].legend(loc="upper left")
    return figure


def _row(side: SideResult, trigger: int) -> int:
    """Of the sample, which has it."""
    return int(side.sample.rows(np.array([trigger]))[0])


def _even_rows(result: Result, side: SideResult) -> Ints:
    """Rows of the sample that are evenly spread over the flight."""
    rows = side.sample.rows(result.shown.tracks[0].trigger_index)
    return rows[rows >= 0]


def _heights(result: Result) -> dict[str, Heights]:
    return {
        name: Heights(side.trigger_index, side.timestamp_ns, side.frames["tip_dz_m"])
        for name, side in result.sides.items()
    }


def _first(result: Result) -> SideResult:
    """The side that instants are chosen on."""
    return result.sides[leading(_heights(result))]


def seconds(result: Result, side: SideResult) -> Floats:
    return np.asarray((side.timestamp_ns - result.start_ns) * 1e-9, dtype=np.float64)


def time_label(result: Result) -> str:
    start = np.datetime64(result.start_ns, "ns").astype("datetime64[ms]")
    return f"s since {str(start).replace('T', ' ')} UTC"


def panels(rows: int, columns: int, height_in: float, *, sharex: bool = True) -> tuple[Figure, Any]:
    figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
    return figure, figure.subplots(rows, columns, sharex=sharex)


def curve(axis: Axes, time: Floats, value: Floats, side: str) -> None:
    """A line, or of more sets than can be drawn apart the mean and the range of neighbours; ``side`` may be neither."""
    colour = COLOURS.get(side, DARK)
    if time.size <= DRAWN_SETS:
        axis.plot(time, value, color=colour, label=side, linewidth=1.0)
        return
    chunk = -(-time.size // DRAWN_SETS)
    padded = np.full((2, chunk * DRAWN_SETS), np.nan)
    padded[:, : time.size] = time, value
    when, values = padded.reshape(2, DRAWN_SETS, chunk)
    known = np.isfinite(values).any(axis=1)
    centre, values = np.nanmean(when[known], axis=1), values[known]
    low, high = np.nanmin(values, axis=1), np.nanmax(values, axis=1)
    axis.fill_between(centre, low, high, color=colour, alpha=0.3, linewidth=0)
    axis.plot(centre, np.nanmean(values, axis=1), color=colour, label=side, linewidth=1.0)


def _band(axis: Axes, time: Floats, value: Floats, sigma: Floats, side: str) -> None:
    shown = np.isfinite(time)
    time, value, sigma = time[shown], value[shown], sigma[shown]
    if time.size > DRAWN_SETS:
        curve(axis, time, value, side)
        return
    axis.fill_between(time, value - 2 * sigma, value + 2 * sigma, color=COLOURS[side], alpha=0.22, linewidth=0)
    axis.plot(time, value, color=COLOURS[side], label=side)


def legend(axis: Axes) -> None:
    """On the line of the title, where no curve can run through it."""
    axis.legend(loc="lower right", bbox_to_anchor=(1.0, 0.97), ncols=2, borderaxespad=0.0)


def _envelope(axis: Axes, s_m: Floats, values: Floats, outer: Floats) -> None:
    known = values[np.isfinite(values).all(axis=1)]
    if known.shape[0] == 0:
        return
    q05, q95 = np.percentile(known, (5, 95), axis=0)
    axis.fill_between(s_m, *outer, color="#eceef0", linewidth=0, label="all sets")
    axis.fill_between(s_m, q05, q95, color="#d9dde1", linewidth=0, label="90 % of the sets")


def _ribs(axes: Any, side: SideResult, row: int, colour: str) -> None:
    """Measured markers as dots, joined fore to aft: they show the chord and its twist."""
    markers = side.sample.markers
    xyz = markers.xyz_m[row]
    axes.scatter(*xyz.T, color=colour, s=5, linewidths=0, depthshade=False)
    place = {int(marker): at for at, marker in enumerate(markers.marker)}
    for marker, at in place.items():
        if marker % 2 == 0 and marker + 1 in place:
            axes.plot(*xyz[[at, place[marker + 1]]].T, color=colour, linewidth=0.9)


def _equal_box(axes: Any, result: Result) -> None:
    """One metre is as long on every axis; panes and grid stay in the background."""
    points = np.concatenate(
        [
            np.concatenate(
                [
                    side.sample.shape.xyz_m.reshape(-1, 3),
                    side.unloaded_xyz_m,
                    side.sample.markers.xyz_m.reshape(-1, 3),
                ]
            )
            for side in result.sides.values()
        ]
    )
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    middle, half = (low + high) / 2, np.maximum((high - low) / 2 * 1.05, 0.25)
    axes.set(
        xlim=(middle[0] - half[0], middle[0] + half[0]),
        ylim=(middle[1] - half[1], middle[1] + half[1]),
        zlim=(middle[2] - half[2], middle[2] + half[2]),
    )
    axes.set_box_aspect(half / half.max(), zoom=1.0)
    axes.locator_params(axis="z", nbins=4)
    for pane in (axes.xaxis, axes.yaxis, axes.zaxis):
        pane.set_pane_color((1.0, 1.0, 1.0, 0.0))
