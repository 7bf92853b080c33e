"""Noisy values in time → the drift and the vibration in them, as strong as the values themselves make likely.

Several independent modes at once. A value is x = c + d + v + e: c what all of a mode's values are wrong by, d a drift
that walks at random from where it was before the first, v a vibration that is new each time, e noise. What is wanted is
d + v. With nothing of either, it is zero and known to be: that is what a mode without motion comes out as.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from reconstruct.tables import Floats

WALKS = (0.0, 1e-3, 1e-2, 0.1, 1.0, 10.0, 1e2, 1e3, 1e4)  # variances a second,
SHAKES = (0.0, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 1e2, 1e3, 1e4)  # of vibration,
STARTS = (0.0, 1.0, 10.0, 1e2, 1e3, 1e4, 1e6)  # of the drift before the first value: all in a usual value's variance
NOTHING = 0.5  # probability beforehand that there is none of one of these
MOST_VALUES = 2000  # that the strengths are judged by
LIKELIEST = 16  # combinations of strengths that are averaged over
NEGLIGIBLE = 1e-3  # probability of a combination that is not worth its time


@dataclass(frozen=True, eq=False)
class Strength:
    """Of J modes, variances in the values' unit squared."""

    walk: Floats  # (J,) of the drift in a second
    shake: Floats  # (J,) of the vibration
    start: Floats  # (J,) of the drift before the first value
    offset: float  # of what all values are wrong by


def likeliest(
    time_s: Floats, values: Floats, variances: Floats, offset: float, *, moved_before: bool
) -> tuple[list[Strength], Floats]:
    """The K likeliest strengths of each mode, and their probabilities (K, J).

    Args:
        time_s: (F,) growing.
        values: (F, J) what was measured.
        variances: (F, J) of the noise, about 1; infinite where nothing was measured.
        offset: variance of what all values are wrong by.
        moved_before: whether there may have been drift before the first value.
    """
    known = np.flatnonzero(np.isfinite(variances).all(axis=1))
    some = known[:: max(1, -(-known.size // MOST_VALUES))]
    starts = STARTS if moved_before else STARTS[:1]
    axes = np.meshgrid(WALKS, SHAKES, starts, indexing="ij")
    walk, shake, start = (axis.ravel()[:, None] for axis in axes)
    likelihood = np.zeros((len(walk), values.shape[1]))
    for axis, count in zip(axes, (len(WALKS), len(SHAKES), len(starts)), strict=True):
        of_some = (1.0 - NOTHING) / max(1, count - 1)
        likelihood += np.log(np.where(axis.ravel() == 0.0, NOTHING, of_some))[:, None]
    mean = np.zeros_like(likelihood)
    spread = np.zeros_like(likelihood) + start + offset
    before_s = time_s[some[0]]
    for at in some:
        spread = spread + walk * (time_s[at] - before_s)
        whole = spread + shake + variances[at]
        off = values[at] - mean
        likelihood -= 0.5 * (np.log(whole) + off * off / whole)
        gain = spread / whole
        mean = mean + gain * off
        spread = spread - gain * spread
        before_s = time_s[at]
    best = np.argsort(-likelihood, axis=0)[:LIKELIEST]
    chosen = np.take_along_axis(likelihood, best, axis=0)
    weights = np.exp(chosen - chosen[0])
    strengths = [Strength(walk[row, 0], shake[row, 0], start[row, 0], offset) for row in best]
    return strengths, weights / weights.sum(axis=0)


def averaged(
    time_s: Floats, values: Floats, variances: Floats, strengths: Sequence[Strength], weights: Floats
) -> tuple[Floats, Floats]:
    """Drift and vibration together (F, J), and their variances (F, J): what each of K strengths says, with its weight.

    How far the strengths disagree is in the variance.
    """
    mean, square = np.zeros_like(values), np.zeros_like(values)
    for strength, weight in zip(strengths, weights, strict=True):
        if weight.max() < NEGLIGIBLE:
            continue
        found, spread = smoothed(time_s, values, variances, strength)
        mean += weight * found
        square += weight * (spread + found**2)
    return mean, np.maximum(square - mean**2, 0.0)


def smoothed(time_s: Floats, values: Floats, variances: Floats, strength: Strength) -> tuple[Floats, Floats]:
    """Drift and vibration together (F, J), and their variances (F, J), by all values (Kalman, Rauch–Tung–Striebel).

    Where nothing was measured, the vibration is not known and its variance is in.
    """
    count = len(values)
    step = np.diff(time_s, prepend=time_s[0])[:, None] * strength.walk
    mean, spread = np.zeros(values.shape[1]), strength.start + strength.offset
    means, spreads = np.empty_like(values), np.empty_like(values)
    for at in range(count):
        spread = spread + step[at]
        gain = spread / (spread + strength.shake + variances[at])
        mean = mean + gain * (values[at] - mean)
        spread = spread - gain * spread
        means[at], spreads[at] = mean, spread
    follow = np.ones_like(values)  # of a mean by the next one
    for at in range(count - 2, -1, -1):
        ahead = spreads[at] + step[at + 1]
        follow[at] = spreads[at] / np.where(ahead > 0.0, ahead, 1.0)
        means[at] += follow[at] * (means[at + 1] - means[at])
        spreads[at] += follow[at] ** 2 * (spreads[at + 1] - ahead)
    with_first = np.concatenate([np.ones((1, values.shape[1])), np.cumprod(follow[:-1], axis=0)]) * spreads
    whole = strength.start + strength.offset
    share = strength.offset / np.where(whole > 0.0, whole, 1.0)  # of where it all began that is error
    shaken = np.where(np.isinf(variances), 0.0, strength.shake / (strength.shake + variances))
    unshaken = np.where(np.isinf(variances), strength.shake, shaken * np.where(shaken > 0.0, variances, 0.0))
    found = (1.0 - shaken) * means + shaken * values - share * means[0]
    spread = (1.0 - shaken) ** 2 * spreads + unshaken + share**2 * spreads[0]
    spread += share * strength.start - 2.0 * (1.0 - shaken) * share * with_first
    return found, np.maximum(spread, 0.0)
