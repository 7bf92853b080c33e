"""A result with signals beside its frames → the figure of the tip beside them."""

import numpy as np
from matplotlib.figure import Figure

from reconstruct.figures import curve, legend, panels, seconds, time_label
from reconstruct.result import Result
from reconstruct.tables import Floats

SHOWN = 4
FEWEST_SETS = 8  # for a correlation


def has_signals(result: Result) -> bool:
    """Whether there is one to show."""
    return bool(shown_signals(result))


def signals(result: Result) -> Figure:
    """The tip's height in time, and below it the signals that go with it most, at the same instants."""
    shown = shown_signals(result)
    figure, axes = panels(1 + len(shown), 1, 1.6 + 1.25 * len(shown))
    for name, side in result.sides.items():
        curve(axes[0], seconds(result, side), 1e3 * side.frames["tip_dz_m"], name)
    axes[0].set(title=f"Tip displacement from the {result.reference}, up", ylabel="mm")
    legend(axes[0])
    for axis, (signal, correlation) in zip(axes[1:], shown, strict=True):
        side = next(side for side in result.sides.values() if signal in side.signals)  # the same for both wings
        curve(axis, seconds(result, side), side.signals[signal], "aircraft")
        axis.set(title=f"{signal} (r = {correlation:+.2f})")
    axes[-1].set(xlabel=time_label(result))
    return figure


def shown_signals(result: Result) -> list[tuple[str, float]]:
    """Signals that vary, and their correlation with the tip's height over both wings; the strongest first."""
    names = {name: None for side in result.sides.values() for name in side.signals}
    found = []
    for name in names:
        tips, values = (
            np.concatenate(parts)
            for parts in zip(
                *(
                    (side.frames["tip_dz_m"] - np.nanmean(side.frames["tip_dz_m"]), side.signals[name])
                    for side in result.sides.values()
                    if name in side.signals and np.isfinite(side.frames["tip_dz_m"]).any()
                ),
                strict=True,
            )
        )
        correlation = _correlation(tips, values)
        if np.isfinite(correlation):
            found.append((name, correlation))
    return sorted(found, key=lambda entry: -abs(entry[1]))[:SHOWN]


def _correlation(a: Floats, b: Floats) -> float:
    """Pearson's, of the sets that have both; NaN where one of them does not vary, or these are too few."""
    both = np.isfinite(a) & np.isfinite(b)
    if both.sum() < FEWEST_SETS or np.ptp(a[both]) == 0 or np.ptp(b[both]) == 0:
        return float("nan")
    return float(np.corrcoef(a[both], b[both])[0, 1])
