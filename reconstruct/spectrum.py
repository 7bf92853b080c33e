"""A motion sampled at the sets' instants → its spectrum, and the modes that stand out of it.

Welch's method: the mean over half-overlapping stretches, each without its straight line and under a Hann window. A mode
is a peak PROMINENCE times as high as the lowest point between it and anything higher, and so far above the median
around it as noise hardly gets (χ² of so many stretches: in fewer than 2 of 100 spectra, tested). Its frequency is the
top of the parabola through the logarithms of the peak and its neighbours; its sigma comes from leaving out a tenth of
the stretches at a time (jackknife); its width is where the spectrum falls to half, the window's own taken off.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter
from scipy.signal import find_peaks, get_window, peak_widths
from scipy.stats import chi2

from reconstruct.tables import Floats, Ints

STRETCH_S = 20.0  # the longest: resolves 0.07 Hz
FEWEST_SETS = 64
FEWEST_STRETCHES = 4  # to tell a mode from chance
PROMINENCE = 6.0
CHANCE = 1e-4
MODES = 6  # at most, the highest
LONGEST_GAP = 4  # sets missing in a row that a straight line bridges
GROUPS = 10  # of stretches, left out in turn
_HANN_WIDTH = 1.65  # at half of its height, in steps of the frequency: 1.44, and what straight lines between them add
_PARABOLA = 0.02  # of such a step: how far the parabola's top may be off


@dataclass(frozen=True)
class Mode:
    """A peak of a spectrum."""

    frequency_hz: float
    sigma_hz: float
    width_hz: float  # at half of its height; 0 when not wider than the window's own
    amplitude: float  # root mean square of the motion within twice its width, in the motion's unit


@dataclass(frozen=True)
class Spectrum:
    """Power a hertz of a motion."""

    frequency_hz: Floats  # (n,) from the first above zero
    density: Floats  # (n,) unit² a hertz, one-sided
    stretches: int
    modes: tuple[Mode, ...]  # by frequency; none of fewer than FEWEST_STRETCHES stretches


def spectrum(time_ns: Ints, value: Floats) -> Spectrum | None:
    """Of values at the sets' instants, NaN where not known; None when there are too few without long gaps."""
    rate_hz, pieces = _even(time_ns, value)
    longest = max((piece.size for piece in pieces), default=0)
    size = int(min(STRETCH_S * rate_hz, max(FEWEST_SETS, longest // 3)))
    if longest < max(size, FEWEST_SETS):
        return None
    window = get_window("hann", size)
    stretches = [piece[at : at + size] for piece in pieces for at in range(0, piece.size - size + 1, size // 2)]
    line = np.arange(size) - (size - 1) / 2
    flat = [one - one.mean() - line * (one @ line) / (line @ line) for one in stretches]
    power = np.abs(np.fft.rfft(np.stack(flat) * window, axis=1)) ** 2 * 2 / (rate_hz * np.sum(window**2))
    frequency = np.asarray(np.fft.rfftfreq(size, 1 / rate_hz)[1:], dtype=np.float64)
    power = np.asarray(power[:, 1:], dtype=np.float64)
    return Spectrum(frequency, np.asarray(power.mean(axis=0)), len(stretches), _modes(frequency, power))


def _even(time_ns: Ints, value: Floats) -> tuple[float, list[Floats]]:
    """Rate (Hz), and the motion at even instants, in pieces without longer gaps than a few sets."""
    known = np.isfinite(value)
    time, value = time_ns[known], value[known]
    if time.size < FEWEST_SETS:
        return 1.0, []
    step = float(np.median(np.diff(time)))
    cuts = np.flatnonzero(np.diff(time) > (LONGEST_GAP + 1.5) * step) + 1
    pieces = []
    for own, values in zip(np.split(time, cuts), np.split(value, cuts), strict=True):
        at = np.arange(0.0, float(own[-1] - own[0]) + 0.5 * step, step)
        pieces.append(np.interp(at, (own - own[0]).astype(np.float64), values))
    return 1e9 / step, pieces


def _modes(frequency: Floats, power: Floats) -> tuple[Mode, ...]:
    if len(power) < FEWEST_STRETCHES:
        return ()
    density = power.mean(axis=0)
    level = np.log(np.maximum(density, density.max() * 1e-12))
    freedom = 1.8 * len(power)  # half-overlapping stretches are not quite independent
    by_chance = chi2.ppf(1 - CHANCE / density.size, freedom) / chi2.ppf(0.5, freedom)
    around = median_filter(level, 2 * max(8, density.size // 10) + 1, mode="nearest")
    peaks, _ = find_peaks(level, prominence=np.log(PROMINENCE))
    peaks = peaks[level[peaks] - around[peaks] > np.log(by_chance)]
    highest = peaks[np.argsort(-level[peaks])][:MODES]
    step = frequency[1] - frequency[0]
    modes = []
    for peak in np.sort(highest):
        groups = np.array_split(np.arange(len(power)), min(GROUPS, len(power)))
        without = [_top(frequency, np.delete(power, group, axis=0).mean(axis=0), int(peak)) for group in groups]
        spread = (len(groups) - 1) / len(groups) * np.sum((np.array(without) - np.mean(without)) ** 2)
        full = float(peak_widths(density, [peak], rel_height=0.5)[0][0]) * step
        own = _HANN_WIDTH * step
        reach = max(full, own)
        near = np.abs(frequency - frequency[peak]) <= reach
        modes.append(
            Mode(
                _top(frequency, density, int(peak)),
                float(np.sqrt(spread + (_PARABOLA * step) ** 2)),
                float(np.sqrt(max(0.0, full**2 - own**2))),
                float(np.sqrt(density[near].sum() * step)),
            )
        )
    return tuple(modes)


def _top(frequency: Floats, density: Floats, peak: int) -> float:
    """Frequency of the parabola's top, of the highest point near ``peak``."""
    low, high = max(peak - 1, 0), min(peak + 2, density.size)
    at = low + int(np.argmax(density[low:high]))
    if not 0 < at < density.size - 1:
        return float(frequency[at])
    left, middle, right = np.log(np.maximum(density[at - 1 : at + 2], np.finfo(float).tiny))
    curve = left - 2 * middle + right
    shift = 0.5 * (left - right) / curve if curve < 0 else 0.0
    return float(frequency[at] + np.clip(shift, -0.5, 0.5) * (frequency[1] - frequency[0]))
