"""Patches of light spots to their centres and covariances: a soft-edged ellipse fitted with the noise as weights.

The profile is a Fermi function of the elliptic distance squared, scaled to 1 at the centre,

    f(t) = exp k / (exp k − 1 + exp t),        t = a Δu² + c Δv² + 2 d Δu Δv,

which is a Gaussian for k = 0 and a disc with a soft edge at t = k for large k: it follows a blurred disc closely at the
price of one exponential a pixel. A prior keeps the ellipse near a circle where a spot is too small to tell, and holds k
where it is not determined. A spot is b + A f(t). Weights are the inverse variances of the
sensor, σ_b² + g A f: background noise and shot noise (g grey levels an electron). All spots are fitted together, by
Levenberg–Marquardt on their pixels laid end to end.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

U, V, AMPLITUDE, BACKGROUND, CURVE_UU, CURVE_VV, CURVE_UV, EDGE = range(8)
PARAMETERS = 8
ITERATIONS = 14
REWEIGHTED_AT = 2
CONVERGED_PX = 4e-3  # of the last step: what is left after it is a small part of it
SETTLED_CHI2 = 2.0  # and of χ²: a shape that still improves would pass for noise
LEAST_CHI2 = 0.3  # a patch of a few pixels may fit by luck
LEAST_EDGE, MOST_EDGE = -0.3, 40.0  # of k: a little more peaked than a Gaussian; a disc without blur
USUAL_BLUR_PX = 0.9
_LARGEST_T = 80.0  # exp(80) is far beyond every edge, and finite
_SHAPE_WEIGHT = 25.0  # 1/σ² of the ellipse's (a − c)/(a + c) and 2d/(a + c) about zero: σ = 0.2
_EDGE_WEIGHT = 1e-2  # 1/σ² of k about its start
_EYE = np.eye(PARAMETERS)


@dataclass(frozen=True, eq=False)
class Patches:
    """The pixels around each of N spots, laid end to end: K in all."""

    u_px: Array
    """(K,) columns"""
    v_px: Array
    """(K,) rows"""
    values: Array
    """(K,) grey levels"""
    counts: NDArray[np.intp]
    """(N,) pixels of each spot, none zero"""
    background_sigma: Array
    """(N,) standard deviation of the background of each spot's image, grey levels"""
    shot_gain: float
    """grey levels an electron"""
    saturation: float
    """grey level from which a value only says "at least this much" """

    @cached_property
    def background_variance(self) -> Array:
        """(K,) of each pixel, but for the light."""
        return self.spread(self.background_sigma**2)

    def spread(self, per_spot: Array) -> Array:
        """Values (..., N) of the spots to their pixels (..., K)."""
        return np.repeat(per_spot, self.counts, axis=-1)

    def sums(self, per_pixel: Array) -> Array:
        """Sums (..., N) of values (..., K) over each spot."""
        return np.asarray(np.add.reduceat(per_pixel, np.cumsum(self.counts) - self.counts, axis=-1))

    def __getitem__(self, chosen: NDArray[np.bool_]) -> "Patches":
        """The patches of some spots (N,)."""
        pixels = np.repeat(chosen, self.counts)
        return replace(
            self,
            u_px=self.u_px[pixels],
            v_px=self.v_px[pixels],
            values=self.values[pixels],
            counts=self.counts[chosen],
            background_sigma=self.background_sigma[chosen],
        )

    @classmethod
    def join(cls, parts: Sequence["Patches"]) -> "Patches":
        """The patches of several images, at least one, in their order."""
        arrays = {
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in ("u_px", "v_px", "values", "counts", "background_sigma")
        }
        return cls(**arrays, shot_gain=parts[0].shot_gain, saturation=parts[0].saturation)


@dataclass(frozen=True, eq=False)
class Fit:
    """What was fitted to N spots."""

    parameters: Array
    """(N, 8) u, v, A, b, a, c, d, k"""
    covariance_px2: Array
    """(N, 2, 2) of (u, v): inverse Fisher information times χ² a degree of freedom: that makes up for a wrong gain"""
    chi2_per_dof: Array
    converged: NDArray[np.bool_]

    def __getitem__(self, chosen: slice) -> "Fit":
        """Some of the spots."""
        return Fit(
            self.parameters[chosen], self.covariance_px2[chosen], self.chi2_per_dof[chosen], self.converged[chosen]
        )


@dataclass(eq=False)
class _Evaluation:
    """The model at some parameters."""

    light: Array  # (K,) A f
    jacobian: Array  # (9, K): by the parameters, and the residual
    chi2: Array  # (N,)

    def of(self, spots: NDArray[np.bool_], pixels: NDArray[np.bool_]) -> "_Evaluation":
        """Of some spots (N,), and their pixels (K,)."""
        return _Evaluation(self.light[pixels], self.jacobian[:, pixels], self.chi2[spots])


def spot_light(parameters: Array, u_px: Array, v_px: Array) -> Array:
    """A f(t) (N, P) of spots (N, 8) at pixels (P,)."""
    u, v, amplitude, _, uu, vv, uv, edge = (parameters[:, k, None] for k in range(PARAMETERS))
    du, dv = u_px - u, v_px - v
    t = np.minimum(uu * du * du + vv * dv * dv + 2.0 * uv * du * dv, _LARGEST_T)
    return np.asarray(amplitude * np.exp(edge) / (np.expm1(edge) + np.exp(t)))


def spot_size_px(parameters: Array) -> Array:
    """(N,) radius of the evenly bright disc that has a spot's light and brightness."""
    determinant = parameters[:, CURVE_UU] * parameters[:, CURVE_VV] - parameters[:, CURVE_UV] ** 2
    return np.sqrt(_content(parameters[:, EDGE]) / np.sqrt(determinant))


def _content(edge: Array) -> Array:
    """∫ f dt = k / (1 − exp −k); 1 for a Gaussian."""
    safe = np.where(np.abs(edge) < 1e-6, 1e-6, edge)
    return np.asarray(safe / -np.expm1(-safe))


def start_shape(patches: Patches, start: Array, area_px: Array) -> tuple[Array, Array]:
    """Curvature a = c and edge k (N,) of round spots with the patches' light, blurred as lenses blur.

    Discs of radius R under a Gaussian blur s are fitted best with k = R/s − 1.8, or by a Gaussian if that is negative.
    """
    amplitude, background = start[:, AMPLITUDE], start[:, BACKGROUND]
    size2 = patches.sums(patches.values - patches.spread(background)) / (np.pi * amplitude)
    size2 = np.clip(size2, 0.3 * area_px / np.pi, 2.0 * area_px / np.pi + 1.0)
    edge = np.clip(np.sqrt(size2) / USUAL_BLUR_PX - 1.8, 0.1, 20.0)
    return np.asarray(_content(edge) / size2), edge


def fit_spots(patches: Patches, start: Array, others: Array | None = None) -> Fit:
    """Fit every spot from ``start`` (N, 8).

    ``others`` (K,) is light of other spots, to be added to the model. Saturated pixels are censored: they pull only
    while the model is below saturation. Spots that do not converge say so; nothing is raised. A spot's fit does not
    depend on which others are fitted with it.
    """
    others = np.zeros(len(patches.values)) if others is None else others
    fitted = Fit(start.copy(), np.full((len(start), 2, 2), np.nan), np.full(len(start), np.nan), start[:, 0] < -np.inf)
    left = np.arange(len(start))  # the spots that are not settled yet: others no longer take part
    parameters = start.copy()
    prior = _prior(start)
    kept = np.ones(len(patches.values))
    here = _evaluate(patches, parameters, others)
    weights = _weights(patches, here.light, others, kept)
    here.chi2 = _chi2(patches, here, weights)
    damping = np.full(len(start), 1e-3)
    moved = np.full(len(start), np.inf)
    for iteration in range(ITERATIONS):
        if iteration == REWEIGHTED_AT:  # by now the model is a better guess of the pixels' variance than the start was
            kept = _own_light(patches, parameters, here, others)
            weights = _weights(patches, here.light, others, kept)
            here.chi2 = _chi2(patches, here, weights)
        information, gradient = _normal_equations(patches, here, weights)
        information += prior
        gradient -= (prior @ (parameters - start)[:, :, None])[:, :, 0]
        ridge = (_diagonal(information) * damping[:, None] + 1e-12)[:, None, :] * _EYE
        trial = _bounded(parameters + np.linalg.solve(information + ridge, gradient[:, :, None])[:, :, 0], parameters)
        there = _evaluate(patches, trial, others)
        there.chi2 = _chi2(patches, there, weights)
        drop = here.chi2 + _pull(prior, parameters - start) - there.chi2 - _pull(prior, trial - start)
        better = drop >= -1e-9 * here.chi2
        moved = np.where(better, np.abs(trial - parameters)[:, :2].max(axis=1), moved)
        settled = (moved < CONVERGED_PX) & (np.abs(drop) < SETTLED_CHI2)
        if better.all():
            parameters, here = trial, there
        else:
            parameters = np.where(better[:, None], trial, parameters)
            here = _chosen(patches, better, there, here)
        damping = np.clip(np.where(better, damping * 0.1, damping * 30.0), 1e-6, 1e6)
        if iteration < REWEIGHTED_AT:
            continue
        if iteration == ITERATIONS - 1:
            settled[:] = True
        if settled.any():
            pixels = np.repeat(settled, patches.counts)
            own = patches[settled], parameters[settled], here.of(settled, pixels), weights[pixels]
            _finish(fitted, left[settled], *own, prior[settled], moved[settled])
            if settled.all():
                break
            stay, pixels = ~settled, ~pixels
            patches, here = patches[stay], here.of(stay, pixels)
            others, kept, weights = others[pixels], kept[pixels], weights[pixels]
            left, start, parameters, prior = left[stay], start[stay], parameters[stay], prior[stay]
            damping, moved = damping[stay], moved[stay]
    return fitted


def _finish(
    fitted: Fit,
    spots: NDArray[np.intp],
    patches: Patches,
    parameters: Array,
    here: _Evaluation,
    weights: Array,
    prior: Array,
    moved: Array,
) -> None:
    """Fill in what was ``fitted`` to some spots."""
    information, _ = _normal_equations(patches, here, weights)
    information += prior
    ridge = (1e-9 * _diagonal(information) + 1e-12)[:, None, :] * _EYE
    covariance = np.asarray(np.linalg.inv(information + ridge)[:, :2, :2], np.float64)
    dof = np.maximum(patches.sums((weights > 0).astype(np.float64)) - PARAMETERS, 1.0)
    chi2_per_dof = here.chi2 / dof
    covariance = covariance * np.maximum(chi2_per_dof, LEAST_CHI2)[:, None, None]
    finite = np.isfinite(parameters).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    fitted.parameters[spots] = parameters
    fitted.covariance_px2[spots] = covariance
    fitted.chi2_per_dof[spots] = chi2_per_dof
    fitted.converged[spots] = finite & (moved < 10 * CONVERGED_PX)


def _evaluate(patches: Patches, parameters: Array, others: Array) -> _Evaluation:
    table = parameters.T.copy()
    table[EDGE] = np.expm1(table[EDGE])
    u, v, amplitude, background, uu, vv, uv, beta = patches.spread(table)
    du, dv = patches.u_px - u, patches.v_px - v
    towards_u, towards_v = uu * du + uv * dv, vv * dv + uv * du
    rise = np.exp(np.minimum(du * towards_u + dv * towards_v, _LARGEST_T))
    below = 1.0 / (beta + rise)
    profile = (1.0 + beta) * below
    light = amplitude * profile
    fall = light * rise * below  # −A f'(t)
    jacobian = np.empty((PARAMETERS + 1, len(du)))
    np.multiply(2.0 * fall, towards_u, out=jacobian[U])
    np.multiply(2.0 * fall, towards_v, out=jacobian[V])
    jacobian[AMPLITUDE] = profile
    jacobian[BACKGROUND] = 1.0
    np.multiply(-fall * du, du, out=jacobian[CURVE_UU])
    np.multiply(-fall * dv, dv, out=jacobian[CURVE_VV])
    np.multiply(-2.0 * fall * du, dv, out=jacobian[CURVE_UV])
    np.multiply(light, 1.0 - profile, out=jacobian[EDGE])
    residual = patches.values - background - light - others
    # a saturated pixel has nothing to say once the model is beyond it
    residual[(patches.values >= patches.saturation) & (residual < 0.0)] = 0.0
    jacobian[PARAMETERS] = residual
    return _Evaluation(light, jacobian, np.empty(0))


def _chosen(patches: Patches, better: NDArray[np.bool_], there: _Evaluation, here: _Evaluation) -> _Evaluation:
    """``there`` for the spots that are better off there, ``here`` for the others."""
    go = np.repeat(better, patches.counts)
    jacobian = np.where(go, there.jacobian, here.jacobian)
    return _Evaluation(np.where(go, there.light, here.light), jacobian, np.where(better, there.chi2, here.chi2))


def _weights(patches: Patches, light: Array, others: Array, kept: Array) -> Array:
    """Inverse variances (K,); 0 for pixels that are not to be used."""
    return kept / (patches.background_variance + patches.shot_gain * np.maximum(light + others, 0.0))


def _chi2(patches: Patches, there: _Evaluation, weights: Array) -> Array:
    residual = there.jacobian[PARAMETERS]
    return patches.sums(residual * residual * weights)


def _own_light(patches: Patches, parameters: Array, here: _Evaluation, others: Array) -> Array:
    """(K,) 0 for pixels beside the spot that are 3 σ brighter than it makes them: shine too faint to be a spot."""
    variance = patches.background_variance + patches.shot_gain * np.maximum(here.light + others, 0.0)
    beside = here.light < 0.25 * patches.spread(parameters[:, AMPLITUDE])
    foreign = beside & (here.jacobian[PARAMETERS] > 3.0 * np.sqrt(variance))
    return np.asarray(1.0 - foreign, np.float64)


def _normal_equations(patches: Patches, here: _Evaluation, weights: Array) -> tuple[Array, Array]:
    """Fisher information (N, 8, 8) and gradient (N, 8); saturated pixels that the model saturates carry none."""
    censored = (patches.values >= patches.saturation) & (here.jacobian[PARAMETERS] == 0.0)
    weighted = here.jacobian[:PARAMETERS] * np.where(censored, 0.0, weights)
    both = np.empty((len(patches.counts), PARAMETERS, PARAMETERS + 1))
    begin = 0
    for spot, count in enumerate(patches.counts.tolist()):
        own = slice(begin, begin + count)
        np.matmul(weighted[:, own], here.jacobian[:, own].T, out=both[spot])
        begin += count
    return both[:, :, :PARAMETERS].copy(), both[:, :, PARAMETERS].copy()


def _prior(start: Array) -> Array:
    """(N, 8, 8) information about the shape, pulling towards the start's circle."""
    total = start[:, CURVE_UU] + start[:, CURVE_VV]
    prior = np.zeros((len(start), PARAMETERS, PARAMETERS))
    shape = _SHAPE_WEIGHT / total**2
    prior[:, CURVE_UU, CURVE_UU] = prior[:, CURVE_VV, CURVE_VV] = shape
    prior[:, CURVE_UU, CURVE_VV] = prior[:, CURVE_VV, CURVE_UU] = -shape
    prior[:, CURVE_UV, CURVE_UV] = 4.0 * shape
    prior[:, EDGE, EDGE] = _EDGE_WEIGHT
    return prior


def _pull(prior: Array, change: Array) -> Array:
    return np.asarray(np.sum((prior @ change[:, :, None])[:, :, 0] * change, axis=1))


def _diagonal(matrices: Array) -> Array:
    return np.asarray(np.diagonal(matrices, axis1=1, axis2=2))


def _bounded(trial: Array, parameters: Array) -> Array:
    """Steps kept sane: 1 px for the centre, a factor of two for amplitude and size; still an ellipse."""
    bounded = trial.copy()
    bounded[:, :2] = np.clip(trial[:, :2], parameters[:, :2] - 1.0, parameters[:, :2] + 1.0)
    bounded[:, AMPLITUDE] = np.clip(trial[:, AMPLITUDE], parameters[:, AMPLITUDE] / 2, parameters[:, AMPLITUDE] * 2 + 1)
    before = parameters[:, CURVE_UU] + parameters[:, CURVE_VV]
    after = trial[:, CURVE_UU] + trial[:, CURVE_VV]
    total = np.clip(after, before / 2.0, np.minimum(before * 2.0, 16.0))
    shape = trial[:, CURVE_UU : CURVE_UV + 1] * (total / np.where(after > 0.0, after, 1.0))[:, None]
    bounded[:, CURVE_UU] = np.clip(shape[:, 0], 0.25 * total, 0.75 * total)
    bounded[:, CURVE_VV] = total - bounded[:, CURVE_UU]
    bounded[:, CURVE_UV] = np.clip(shape[:, 2], -0.25 * total, 0.25 * total)
    step = np.clip(trial[:, EDGE] - parameters[:, EDGE], -1.5, 1.5)
    bounded[:, EDGE] = np.clip(parameters[:, EDGE] + step, LEAST_EDGE, MOST_EDGE)
    return bounded
