"""Patches of light spots to their centres and covariances: a blurred disc fitted with the sensor's noise as weights.

The profile is a slab of half width R blurred by a Gaussian of standard deviation s, taken along the radius ρ and
scaled to 1 at the centre,

    f(ρ) = [erf((R + ρ) / √2 s) + erf((R − ρ) / √2 s)] / (2 erf(R / √2 s)),

which is a Gaussian for R → 0 and the blurred edge of a disc for R ≫ s. The radius is that of an ellipse,

    ρ² = (1 + e) Δu² + (1 − e) Δv² + 2 h Δu Δv,

since lights off the optical axis, and moving ones, are not round; a prior keeps e and h small where a spot is too
small to tell. A spot is b + A f(ρ). Weights are the inverse variances of the sensor, σ_b² + g A f: background noise
and shot noise (g grey levels an electron). All spots are fitted together, by Levenberg–Marquardt on stacked systems.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

Array = NDArray[np.float64]

U, V, AMPLITUDE, BACKGROUND, RADIUS, BLUR, STRETCH, SHEAR = range(8)
PARAMETERS = 8
_PRIOR = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 25.0, 25.0])  # 1/σ² about zero: σ = 0.2 for e and h
ITERATIONS = 12
REWEIGHTED_AT = 3
CONVERGED_PX = 3e-3  # of the last step: what is left after it is a small part of it
LEAST_CHI2 = 0.3  # a patch of a few pixels may fit by luck
_EYE = np.eye(PARAMETERS)
_ROOT_2 = np.sqrt(2.0)
_ROOT_2PI = np.sqrt(2.0 * np.pi)


@dataclass(frozen=True, eq=False)
class Patches:
    """P pixels around each of N spots."""

    u_px: Array
    """(N, P) columns"""
    v_px: Array
    """(N, P) rows"""
    values: Array
    """(N, P) grey levels"""
    usable: NDArray[np.bool_]
    """(N, P) False for pixels outside of the image, or another spot's"""
    background_sigma: float
    """standard deviation of the background, grey levels"""
    shot_gain: float
    """grey levels an electron"""
    saturation: float
    """grey level from which a value only says "at least this much" """


@dataclass(frozen=True, eq=False)
class Fit:
    """What was fitted to N patches."""

    parameters: Array
    """(N, 8) u, v, A, b, R, s, e, h"""
    covariance_px2: Array
    """(N, 2, 2) of (u, v): inverse Fisher information times χ² a degree of freedom: that makes up for a wrong gain"""
    chi2_per_dof: Array
    converged: NDArray[np.bool_]


def spot_light(parameters: Array, u_px: Array, v_px: Array) -> Array:
    """A f(ρ) (N, P) of spots (N, 8) at pixels (N, P)."""
    u, v, amplitude, _, radius, blur, stretch, shear = (parameters[:, k, None] for k in range(PARAMETERS))
    du, dv = u_px - u, v_px - v
    rho = np.sqrt((1.0 + stretch) * du * du + (1.0 - stretch) * dv * dv + 2.0 * shear * du * dv)
    scale = _ROOT_2 * blur
    total = erf((radius + rho) / scale) + erf((radius - rho) / scale)
    return np.asarray(amplitude * total / (2.0 * erf(radius / scale)))


def fit_spots(patches: Patches, start: Array, others: Array | None = None) -> Fit:
    """Fit every patch from ``start`` (N, 8).

    ``others`` (N, P) is light of other spots in the patch, to be added to the model. Saturated pixels are censored:
    they pull only while the model is below saturation. Spots that do not converge say so; nothing is raised.
    """
    parameters = start.copy()
    others = np.zeros(1) if others is None else others
    kept = patches.usable
    weights = _weights(patches, parameters, others, kept)
    model, jacobian = _model(patches, parameters, others)
    residual, chi2 = _residuals(patches, model, weights)
    damping = np.full(len(start), 1e-3)
    moved = np.full(len(start), np.inf)
    for iteration in range(ITERATIONS):
        if iteration == REWEIGHTED_AT:  # by now the model is a better guess of the pixels' variance than the start was
            kept = kept & ~_foreign_light(patches, parameters, others, residual)
            weights = _weights(patches, parameters, others, kept)
            residual, chi2 = _residuals(patches, model, weights)
        information, gradient = _normal_equations(patches, model, jacobian, residual, weights)
        information += np.diag(_PRIOR)
        gradient -= parameters * _PRIOR
        scaled = information + np.einsum("nii,ij,n->nij", information, _EYE, damping) + 1e-12 * _EYE
        step = np.linalg.solve(scaled, gradient[:, :, None])[:, :, 0]
        trial = _bounded(parameters + step, parameters, start)
        trial_model, trial_jacobian = _model(patches, trial, others)
        trial_residual, trial_chi2 = _residuals(patches, trial_model, weights)
        rise = (trial**2 - parameters**2) @ _PRIOR
        better = trial_chi2 + rise <= chi2 * (1.0 + 1e-9)
        moved = np.where(better, np.abs(trial - parameters)[:, :2].max(axis=1), moved)
        keep = better[:, None]
        parameters = np.where(keep, trial, parameters)
        model, residual = np.where(keep, trial_model, model), np.where(keep, trial_residual, residual)
        jacobian = np.where(better[:, None, None], trial_jacobian, jacobian)
        chi2 = np.where(better, trial_chi2, chi2)
        damping = np.clip(np.where(better, damping * 0.2, damping * 20.0), 1e-6, 1e6)
        if iteration > REWEIGHTED_AT and np.all(moved < CONVERGED_PX):
            break
    return _finish(patches, parameters, others, kept, moved)


def _finish(patches: Patches, parameters: Array, others: Array, kept: NDArray[np.bool_], moved: Array) -> Fit:
    weights = _weights(patches, parameters, others, kept)
    model, jacobian = _model(patches, parameters, others)
    residual, chi2 = _residuals(patches, model, weights)
    information, _ = _normal_equations(patches, model, jacobian, residual, weights)
    information += np.diag(_PRIOR)
    ridge = 1e-9 * np.einsum("nii,ij->nij", information, _EYE) + 1e-12 * _EYE
    covariance = np.linalg.inv(information + ridge)[:, :2, :2]
    dof = np.maximum((weights > 0).sum(axis=1) - PARAMETERS, 1)
    chi2_per_dof = chi2 / dof
    covariance *= np.maximum(chi2_per_dof, LEAST_CHI2)[:, None, None]
    finite = np.isfinite(parameters).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    return Fit(parameters, covariance, chi2_per_dof, finite & (moved < 10 * CONVERGED_PX))


def _model(patches: Patches, parameters: Array, others: Array) -> tuple[Array, Array]:
    """Grey levels (N, P), and their derivatives (N, 8, P)."""
    u, v, amplitude, background, radius, blur, stretch, shear = (parameters[:, k, None] for k in range(PARAMETERS))
    du, dv = patches.u_px - u, patches.v_px - v
    towards_u, towards_v = (1.0 + stretch) * du + shear * dv, (1.0 - stretch) * dv + shear * du
    rho = np.sqrt(du * towards_u + dv * towards_v) + 1e-9
    outer, inner = (radius + rho) / blur, (radius - rho) / blur
    norm = 2.0 * erf(radius / (_ROOT_2 * blur))
    profile = (erf(outer / _ROOT_2) + erf(inner / _ROOT_2)) / norm
    scale = 2.0 / (_ROOT_2PI * blur * norm)
    g_outer, g_inner = scale * np.exp(-0.5 * outer * outer), scale * np.exp(-0.5 * inner * inner)
    g_centre = 2.0 * scale * np.exp(-0.5 * (radius / blur) ** 2)
    jacobian = np.empty((len(parameters), PARAMETERS, rho.shape[1]))
    slope = amplitude * (g_inner - g_outer) / rho  # −A f'(ρ) / ρ
    jacobian[:, U] = slope * towards_u
    jacobian[:, V] = slope * towards_v
    jacobian[:, STRETCH] = slope * (dv * dv - du * du) / 2.0
    jacobian[:, SHEAR] = -slope * du * dv
    jacobian[:, AMPLITUDE] = profile
    jacobian[:, BACKGROUND] = 1.0
    jacobian[:, RADIUS] = amplitude * (g_outer + g_inner - profile * g_centre)
    jacobian[:, BLUR] = -amplitude * (outer * g_outer + inner * g_inner - profile * g_centre * radius / blur)
    return background + amplitude * profile + others, jacobian


def _weights(patches: Patches, parameters: Array, others: Array, kept: NDArray[np.bool_]) -> Array:
    """Inverse variances (N, P); 0 for pixels that are not to be used."""
    light = spot_light(parameters, patches.u_px, patches.v_px) + others
    return kept / (patches.background_sigma**2 + patches.shot_gain * np.maximum(light, 0.0))


def _foreign_light(patches: Patches, parameters: Array, others: Array, residual: Array) -> NDArray[np.bool_]:
    """(N, P) pixels beside the spot that are 3 σ brighter than it makes them: shine too faint to be a spot."""
    light = spot_light(parameters, patches.u_px, patches.v_px)
    variance = patches.background_sigma**2 + patches.shot_gain * np.maximum(light + others, 0.0)
    beside = light < 0.25 * parameters[:, AMPLITUDE, None]
    return np.asarray(beside & (residual > 3.0 * np.sqrt(variance)))


def _residuals(patches: Patches, model: Array, weights: Array) -> tuple[Array, Array]:
    """Measured minus model (N, P), 0 where a saturated pixel has nothing to say; and χ² (N,)."""
    residual = patches.values - model
    residual[(patches.values >= patches.saturation) & (residual < 0.0)] = 0.0
    return residual, np.einsum("np,np,np->n", residual, residual, weights)


def _normal_equations(
    patches: Patches, model: Array, jacobian: Array, residual: Array, weights: Array
) -> tuple[Array, Array]:
    """Fisher information (N, 8, 8) and gradient (N, 8) of the pixels; censored ones carry none."""
    active = weights * ~((patches.values >= patches.saturation) & (model >= patches.saturation))
    weighted = jacobian * active[:, None, :]
    return weighted @ jacobian.transpose(0, 2, 1), np.einsum("nkp,np->nk", weighted, residual)


def _bounded(trial: Array, parameters: Array, start: Array) -> Array:
    """Steps kept sane: 1 px for the centre, a factor of two for amplitude, disc and blur."""
    bounded = trial.copy()
    bounded[:, :2] = np.clip(trial[:, :2], parameters[:, :2] - 1.0, parameters[:, :2] + 1.0)
    for k, least in ((AMPLITUDE, 1.0), (RADIUS, 0.05), (BLUR, 0.25)):
        bounded[:, k] = np.clip(trial[:, k], np.maximum(parameters[:, k] / 2, least), parameters[:, k] * 2 + least)
    bounded[:, STRETCH:] = np.clip(trial[:, STRETCH:], -0.5, 0.5)  # still an ellipse
    bounded[:, RADIUS] = np.minimum(bounded[:, RADIUS], 4.0 * start[:, RADIUS] + 4.0)
    return bounded
