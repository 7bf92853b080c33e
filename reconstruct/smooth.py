"""Markers of consecutive sets into fits that know of each other: a Kalman filter and smoother on the fit's unknowns.

Each unknown is a Matérn 3/2 process in time of the prior's variance (twice integrable noise: wings do not jump). Sets
without enough markers are bridged, with bands as wide as the neighbours allow. Equation numbers are those of
docs/explanation/beam.md.
"""

import numpy as np

from reconstruct.fit import SETS_AT_ONCE, Fit, Unscaled, fit_each, fit_from, scaled
from reconstruct.iteration import linearise
from reconstruct.posterior import information_of, with_rows
from reconstruct.rotation import Array, Mask
from reconstruct.wing_file import FitSettings

_TOLD = 1e-3  # an unknown's direction of which no set tells more is left to the prior
_FARTHEST = 3.0  # correlation times: what lies farther from the next fitted set is not bridged


def smooth_fits(posed: Unscaled, settings: FitSettings, time_s: Array, prior_scale: Array, correlation_s: float) -> Fit:
    """Fit F sets by themselves, then smooth what they tell (Rauch, Tung & Striebel 1965; eqs. 28 and 29).

    Args:
        posed: what each set, at its common instant, is to explain.
        settings: from the wing file; loads must act everywhere.
        time_s: (F,) ascending.
        prior_scale: (4,) one for all.
        correlation_s: over which the wing's motion is alike.

    Returns:
        F fits; ``residual_m`` is left to the caller. One whose set could not be fitted has no marker in use; it is not
        bridged, but NaN with its own reason, where no fitted set lies within three correlation times on both sides.
    """
    if settings.loads != "everywhere":
        raise ValueError('smoothing needs loads = "everywhere"')
    single = fit_each(posed, settings, prior_scale)
    good = np.flatnonzero(single.converged)
    if good.size < 2:
        return single
    information, product = _told(posed[good], single[good], prior_scale)
    size, direction = np.linalg.eigh(information.mean(axis=0))
    kept = direction[:, size > _TOLD]
    told: list[tuple[Array, Array] | None] = [None] * len(posed)
    for at, one, other in zip(good.tolist(), kept.T @ information @ kept, product @ kept, strict=True):
        told[at] = one, other
    mean, spread = _rts(time_s, told, kept.shape[1], correlation_s)
    near = np.flatnonzero(_reachable(time_s, single.converged, _FARTHEST * correlation_s))
    left = np.eye(len(kept)) - kept @ kept.T
    means, spreads = mean[near] @ kept.T, kept @ spread[near] @ kept.T + left
    parts = []
    for first in range(0, near.size, SETS_AT_ONCE):
        some = slice(first, first + SETS_AT_ONCE)
        rows = near[some]
        parts.append(fit_from(posed[rows], settings, single[rows], means[some], spreads[some], prior_scale))
    return with_rows(single, near, Fit.join(parts))


def _told(posed: Unscaled, fits: Fit, scale: Array) -> tuple[Array, Array]:
    """Sets' own information (F, u, u) and its product with the likeliest unknowns (F, u), the prior taken out."""
    linear = linearise(scaled(posed, scale), fits.strain, fits.unknowns)
    information = information_of(linear, fits.used.astype(np.float64))
    return information, (information @ fits.unknowns[:, :, None])[:, :, 0] + fits.unknowns


def _rts(
    time_s: Array, told: list[tuple[Array, Array] | None], unknowns: int, correlation_s: float
) -> tuple[Array, Array]:
    """Smoothed means (F, r) and covariances (F, r, r) of r unknowns with unit variance, and their rates."""
    rate = np.sqrt(3) / correlation_s
    r = unknowns
    still = np.kron(np.diag([1.0, rate**2]), np.eye(r))
    mean, P = np.zeros(2 * r), still
    predicted, filtered, moves = [], [], []
    for i, known in enumerate(told):
        if i > 0:
            step = rate * (time_s[i] - time_s[i - 1])
            pair = np.exp(-step) * np.array([[1 + step, step / rate], [-rate * step, 1 - step]])
            move = np.kron(pair, np.eye(r))
            mean = move @ mean
            P = move @ (P - still) @ move.T + still
            moves.append(move)
        predicted.append((mean, P))
        if known is not None:
            information, product = known
            gain = np.linalg.solve(np.eye(r) + information @ P[:r, :r], information)
            P = P - P[:, :r] @ gain @ P[:r]
            P = (P + P.T) / 2
            mean = mean + P[:, :r] @ (product - information @ mean[:r])
        filtered.append((mean, P))
    means, spreads = np.empty((len(told), r)), np.empty((len(told), r, r))
    for i in range(len(told) - 1, -1, -1):
        if i < len(told) - 1:
            ahead_mean, ahead_P = predicted[i + 1]
            here_mean, here_P = filtered[i]
            back = np.linalg.solve(ahead_P, moves[i] @ here_P).T
            mean = here_mean + back @ (mean - ahead_mean)
            P = here_P + back @ (P - ahead_P) @ back.T
        means[i], spreads[i] = mean[:r], (P[:r, :r] + P[:r, :r].T) / 2
    return means, spreads


def _reachable(time_s: Array, good: Mask, reach_s: float) -> Mask:
    """Which sets were fitted, or have fitted ones before and after them within reach."""
    at = time_s[good]
    after = np.searchsorted(at, time_s)
    since = time_s - at[np.clip(after - 1, 0, None)]
    until = at[np.clip(after, None, len(at) - 1)] - time_s
    inside = (after > 0) & (after < len(at)) & (since <= reach_s) & (until <= reach_s)
    reachable: Mask = np.logical_or(good, inside)
    return reachable
