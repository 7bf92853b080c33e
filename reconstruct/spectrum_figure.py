"""A result → the spectra of its tips, as a figure and as a table of their modes."""

import numpy as np
from matplotlib.figure import Figure

from reconstruct.figures import COLOURS, WIDTH_IN
from reconstruct.page import number, table
from reconstruct.result import Result
from reconstruct.spectrum import Spectrum, spectrum

MOTIONS = (("bending", "tip_dz_m", 1e3, "mm"), ("twist", "tip_twist_deg", 1.0, "deg"))


def has_spectrum(result: Result) -> bool:
    """Whether a wing has enough sets."""
    return bool(_spectra(result))


def spectra(result: Result) -> Figure:
    """Spectrum of each tip's height and twist, and the frequencies that stand out."""
    figure = Figure(figsize=(WIDTH_IN, 4.4), layout="constrained")
    axes = figure.subplots(2, 1, sharex=True)
    found = _spectra(result)
    for axis, (motion, _, _, unit) in zip(axes, MOTIONS, strict=True):
        for (side, which), one in found.items():
            if which != motion:
                continue
            axis.semilogy(one.frequency_hz, one.density, color=COLOURS[side], label=side, linewidth=1.1)
            for mode in one.modes:
                height = np.interp(mode.frequency_hz, one.frequency_hz, one.density)
                axis.plot(mode.frequency_hz, height, "v", color=COLOURS[side], markersize=5)
                to = -1 if side == "left" else 1  # the two wings' are often the same
                axis.annotate(
                    f"{mode.frequency_hz:.2f}", (mode.frequency_hz, height), (4 * to, 4), textcoords="offset points",
                    ha="right" if to < 0 else "left", fontsize=8, color=COLOURS[side],
                )  # fmt: skip
        axis.margins(y=0.15)
        top = axis.get_ylim()[1]
        axis.set_ylim(max(axis.get_ylim()[0], 1e-10 * top), top)
        axis.set(title=f"Tip {motion}", ylabel=f"{unit}²/Hz")
    axes[0].legend(loc="upper right", ncols=2)
    axes[1].set(xlabel="frequency, Hz", xlim=(0, None))
    return figure


def mode_table(result: Result) -> str:
    """The modes of both wings as HTML, or that there are none."""
    rows = []
    for (side, motion), one in _spectra(result).items():
        unit = {name: unit for name, _, _, unit in MOTIONS}[motion]
        for mode in one.modes:
            width = f"{mode.width_hz:.3f} Hz" if mode.width_hz > 0 else "not resolved"
            rows.append(
                (
                    side,
                    motion,
                    f"{mode.frequency_hz:.3f} Hz",
                    f"± {mode.sigma_hz:.3f} Hz",
                    width,
                    number(mode.amplitude, unit),
                )
            )
    if not rows:
        return "<p>No mode stands out; a flight of a few seconds is too short to tell one from chance.</p>"
    return table(("wing", "tip", "frequency", "one sigma", "width at half height", "RMS"), rows)


def _spectra(result: Result) -> dict[tuple[str, str], Spectrum]:
    found = {}
    for name, side in result.sides.items():
        for motion, column, scale, _ in MOTIONS:
            one = spectrum(side.timestamp_ns, scale * side.frames[column])
            if one is not None:
                found[name, motion] = one
    return found
