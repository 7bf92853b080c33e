"""Patches of light spots to their centres and covariances: a soft-edged ellipse fitted with the noise as weights.

The profile is a Fermi function of the elliptic distance squared, scaled to 1 at the centre,

    f(t) = exp k / (exp k − 1 + exp t),        t = a Δu² + c Δv² + 2 d Δu Δv,

which is a Gaussian for k = 0 and a disc with a soft edge at t = k for large k: it follows a blurred disc closely at the
price of one exponential a pixel. A prior keeps the ellipse near a circle where a spot is too small to tell, and holds k
where it is not determined. A spot is b + A f(t). Weights are the inverse variances of the
sensor, σ_b² + g A f: background noise and shot noise (g grey levels an electron). Spots are fitted together, by
Levenberg–Marquardt on their pixels laid end to end, in single precision about each spot's own pixel: a rounding of 1e-6
px beside a noise of 1e-2.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

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
_ROUNDING = 1e-5  # of χ², in single precision
_WORTH_KEEPING = 0.6  # share of spots that are not settled below which the others' pixels are dropped


@dataclass(frozen=True, eq=False)
class Patches:
    """The pixels around each of N spots, laid end to end: K in all."""

    u_px: Array
    """(K,) columns"""
    v_px: Array
    """(K,) rows"""
    values: Array
    """(K,) grey levels"""
    usable: Array
    """(K,) 1; 0 for pixels that are not to be used"""
    counts: NDArray[np.intp]
    """(N,) pixels of each spot, none zero"""
    background_sigma: Array
    """(N,) standard deviation of the background of each spot's image, grey levels"""
    shot_gain: float
    """grey levels an electron"""
    saturation: float
    """grey level from which a value only says "at least this much" """

    def spread(self, per_spot: Array) -> Array:
        """Values (..., N) of the spots to their pixels (..., K)."""
        return np.repeat(per_spot, self.counts, axis=-1)

    def sums(self, per_pixel: Array) -> Array:
        """Sums (..., N) of values (..., K) over each spot."""
        return np.asarray(np.add.reduceat(per_pixel, self.begins, axis=-1))

    def variance(self, light: Array) -> Array:
        """(K,) of each pixel, with so much ``light``."""
        return self._background_variance + self.shot_gain * np.maximum(light, 0.0)

    def about(self, origin_px: Array) -> "Patches":
        """The same, columns and rows counted from each spot's origin (N, 2), in single precision."""
        u_px, v_px = self.spread(origin_px.T)
        return replace(
            self,
            u_px=(self.u_px - u_px).astype(np.float32),
            v_px=(self.v_px - v_px).astype(np.float32),
            values=self.values.astype(np.float32),
            usable=self.usable.astype(np.float32),
            background_sigma=self.background_sigma.astype(np.float32),
        )

    @cached_property
    def begins(self) -> NDArray[np.intp]:
        """(N,) each spot's first pixel."""
        return np.cumsum(self.counts) - self.counts

    @cached_property
    def alike(self) -> list[tuple[slice, slice]]:
        """Spots in turn that have equally many pixels, and those pixels."""
        edges = [0, *(np.flatnonzero(np.diff(self.counts)) + 1).tolist(), len(self.counts)]
        ends = np.append(self.begins, len(self.values)).tolist()
        return [(slice(first, last), slice(ends[first], ends[last])) for first, last in pairwise(edges)]

    @cached_property
    def saturated(self) -> NDArray[np.bool_] | None:
        """(K,); None if none is."""
        saturated = self.values >= self.saturation
        return saturated if saturated.any() else None

    @cached_property
    def _background_variance(self) -> Array:
        return self.spread(self.background_sigma**2)

    def pixels(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> NDArray[np.intp]:
        """Places in (K,) of some spots' pixels."""
        counts = self.counts[chosen]
        return np.repeat(self.begins[chosen] - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())

    def __getitem__(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> "Patches":
        """The patches of some spots, by mask or number."""
        pixels = self.pixels(chosen)
        return replace(
            self,
            u_px=self.u_px[pixels],
            v_px=self.v_px[pixels],
            values=self.values[pixels],
            usable=self.usable[pixels],
            counts=self.counts[chosen],
            background_sigma=self.background_sigma[chosen],
        )

    @classmethod
    def join(cls, parts: Sequence["Patches"]) -> "Patches":
        """The patches of several images, at least one, in their order."""
        arrays = {
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in ("u_px", "v_px", "values", "usable", "counts", "background_sigma")
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
class _Equations:
    """Least squares about some parameters."""

    sums: Array  # (N, 9, 9) of weighted products of the model's slopes by the parameters, and of the residual

    @property
    def information(self) -> Array:
        """(N, 8, 8) Fisher's."""
        return self.sums[:, :PARAMETERS, :PARAMETERS]

    @property
    def gradient(self) -> Array:
        """(N, 8)"""
        return self.sums[:, :PARAMETERS, PARAMETERS]

    @property
    def chi2(self) -> Array:
        """(N,)"""
        return self.sums[:, PARAMETERS, PARAMETERS]


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
    size2 = patches.sums(patches.usable * (patches.values - patches.spread(background))) / (np.pi * amplitude)
    size2 = np.clip(size2, 0.3 * area_px / np.pi, 2.0 * area_px / np.pi + 1.0)
    edge = np.clip(np.sqrt(size2) / USUAL_BLUR_PX - 1.8, 0.1, 20.0)
    return np.asarray(_content(edge) / size2), edge


def fit_spots(patches: Patches, start: Array, others: Array | None = None) -> Fit:
    """Fit every spot from ``start`` (N, 8).

    ``others`` (K,) is light of other spots, to be added to the model. Saturated pixels are censored: they pull only
    while the model is below saturation. Spots that do not converge say so; nothing is raised. A spot's fit does not
    depend on which others are fitted with it.
    """
    fitted = Fit(start.copy(), np.full((len(start), 2, 2), np.nan), np.full(len(start), np.nan), start[:, 0] < -np.inf)
    spots = np.argsort(patches.counts, kind="stable")  # those with equally many pixels beside each other
    origin = np.rint(start[:, :2])
    others = np.zeros(len(patches.values), np.float32) if others is None else others[patches.pixels(spots)]
    patches, start = patches[spots].about(origin[spots]), start[spots] - _at(origin[spots])
    parameters = start.copy()
    prior = _prior(start)
    slopes, light = _evaluate(patches, parameters, others)
    kept = patches.usable
    weights = kept / patches.variance(light + others)
    here = _equations(patches, slopes, weights)
    damping = np.full(len(start), 1e-3)
    moved = np.full(len(start), np.inf)
    open_ = np.ones(len(start), dtype=bool)  # spots that are not settled yet
    at_best = True
    for iteration in range(ITERATIONS):
        if iteration == REWEIGHTED_AT:  # by now the model is a better guess of the pixels' variance than the start was
            if not at_best:
                slopes, light = _evaluate(patches, parameters, others)
            kept = _own_light(patches, parameters, slopes[PARAMETERS], light, others)
            weights = kept / patches.variance(light + others)
            here = _equations(patches, slopes, weights)
        pull = _times(prior, parameters - start)
        information = here.information + prior
        ridge = (_diagonal(information) * damping[:, None] + 1e-12)[:, None, :] * _EYE
        step = np.linalg.solve(information + ridge, (here.gradient - pull)[:, :, None])[:, :, 0]
        trial = _bounded(parameters + step, parameters)
        slopes, light = _evaluate(patches, trial, others)
        there = _equations(patches, slopes, weights)
        drop = here.chi2 + _pull(prior, parameters - start) - there.chi2 - _pull(prior, trial - start)
        better = drop >= -_ROUNDING * here.chi2
        moved = np.where(better, np.abs(trial - parameters)[:, :2].max(axis=1), moved)
        settled = (moved < CONVERGED_PX) & (np.abs(drop) < SETTLED_CHI2)
        at_best = bool(better.all())
        if at_best:
            parameters, here = trial, there
        else:
            parameters = np.where(better[:, None], trial, parameters)
            here = _Equations(np.where(better[:, None, None], there.sums, here.sums))
        damping = np.clip(np.where(better, damping * 0.1, damping * 30.0), 1e-6, 1e6)
        if iteration < REWEIGHTED_AT:
            continue
        done = open_ & (settled | (iteration == ITERATIONS - 1))
        if done.any():
            pixels = patches.sums((kept > 0).astype(np.float64))
            _finish(fitted, spots, done, parameters + _at(origin[spots]), here, prior, pixels, moved)
            open_ &= ~done
            left = np.count_nonzero(open_)
            if not left:
                break
            if left < _WORTH_KEEPING * len(open_):
                own = patches.pixels(open_)
                others, kept, weights = others[own], kept[own], weights[own]
                patches, here = patches[open_], _Equations(here.sums[open_])
                spots, start, parameters, prior = spots[open_], start[open_], parameters[open_], prior[open_]
                damping, moved, open_ = damping[open_], moved[open_], open_[open_]
    return fitted


def _finish(
    fitted: Fit,
    spots: NDArray[np.intp],
    done: NDArray[np.bool_],
    parameters: Array,
    here: _Equations,
    prior: Array,
    pixels: Array,
    moved: Array,
) -> None:
    """Fill in what was ``fitted`` to the ``done`` ones of some spots, which have so many ``pixels``."""
    parameters = parameters[done]
    information = here.information[done] + prior[done]
    ridge = (1e-9 * _diagonal(information) + 1e-12)[:, None, :] * _EYE
    covariance = np.asarray(np.linalg.inv(information + ridge)[:, :2, :2], np.float64)
    chi2_per_dof = here.chi2[done] / np.maximum(pixels[done] - PARAMETERS, 1.0)
    covariance = covariance * np.maximum(chi2_per_dof, LEAST_CHI2)[:, None, None]
    finite = np.isfinite(parameters).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    own = spots[done]
    fitted.parameters[own] = parameters
    fitted.covariance_px2[own] = covariance
    fitted.chi2_per_dof[own] = chi2_per_dof
    fitted.converged[own] = finite & (moved[done] < 10 * CONVERGED_PX)


def _evaluate(patches: Patches, parameters: Array, others: Array) -> tuple[Array, Array]:
    """The model's slopes by the parameters, and the residual (9, K), and the spots' own light A f (K,)."""
    table = parameters.T.copy()
    table[EDGE] = np.expm1(table[EDGE])
    u, v, amplitude, background, uu, vv, uv, beta = patches.spread(table.astype(patches.values.dtype))
    slopes = np.empty((PARAMETERS + 1, len(u)), patches.values.dtype)
    du, dv = np.subtract(patches.u_px, u, out=u), np.subtract(patches.v_px, v, out=v)
    towards_u, towards_v = uu * du, vv * dv
    towards_u += uv * dv
    towards_v += uv * du
    rise = du * towards_u
    rise += dv * towards_v
    np.exp(np.minimum(rise, _LARGEST_T, out=rise), out=rise)
    below = 1.0 / (beta + rise)
    beta += 1.0
    profile = np.multiply(beta, below, out=slopes[AMPLITUDE])
    light = amplitude * profile
    rise *= below
    fall = np.multiply(light, rise, out=rise)  # −A f'(t)
    towards_u *= 2.0
    towards_v *= 2.0
    np.multiply(fall, towards_u, out=slopes[U])
    np.multiply(fall, towards_v, out=slopes[V])
    slopes[BACKGROUND] = 1.0
    fall_u, fall_v = np.multiply(fall, du, out=towards_u), np.multiply(fall, dv, out=towards_v)
    np.multiply(fall_u, -du, out=slopes[CURVE_UU])
    np.multiply(fall_v, -dv, out=slopes[CURVE_VV])
    np.multiply(fall_u, -2.0 * dv, out=slopes[CURVE_UV])
    np.multiply(light, 1.0 - profile, out=slopes[EDGE])
    residual = np.subtract(patches.values, background, out=slopes[PARAMETERS])
    residual -= light
    residual -= others
    if patches.saturated is not None:  # such a pixel has nothing to say once the model is beyond it
        residual[patches.saturated & (residual < 0.0)] = 0.0
    return slopes, light


def _equations(patches: Patches, slopes: Array, weights: Array) -> _Equations:
    """Of weighted least squares; saturated pixels that the model saturates carry nothing."""
    if patches.saturated is not None:
        weights = np.where(patches.saturated & (slopes[PARAMETERS] == 0.0), 0.0, weights)
    weighted = slopes * weights
    sums = np.empty((len(patches.counts), PARAMETERS + 1, PARAMETERS + 1), slopes.dtype)
    for spots, pixels in patches.alike:
        shape = (PARAMETERS + 1, spots.stop - spots.start, -1)
        left, right = weighted[:, pixels].reshape(shape), slopes[:, pixels].reshape(shape)
        np.matmul(left.transpose(1, 0, 2), right.transpose(1, 2, 0), out=sums[spots])
    return _Equations(sums.astype(np.float64))


def _own_light(patches: Patches, parameters: Array, residual: Array, light: Array, others: Array) -> Array:
    """(K,) usable pixels but those beside the spot that are 3 σ brighter than it makes them: faint shine."""
    beside = light < 0.25 * patches.spread(parameters[:, AMPLITUDE])
    foreign = beside & (residual > 3.0 * np.sqrt(patches.variance(light + others)))
    return np.where(foreign, np.float32(0.0), patches.usable)


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
    return np.asarray(np.sum(_times(prior, change) * change, axis=1))


def _at(origin_px: Array) -> Array:
    """(N, 8) what places (N, 2) are of parameters."""
    return np.pad(origin_px, ((0, 0), (0, PARAMETERS - 2)))


def _times(matrices: Array, vectors: Array) -> Array:
    return np.asarray((matrices @ vectors[:, :, None])[:, :, 0])


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
