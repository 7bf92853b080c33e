"""Where the iteration ended → the fit: shape, twist and loads of the half wing, and how well they are known.

Equation numbers are those of docs/explanation/beam.md.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from reconstruct.beam import Shape
from reconstruct.iteration import Ends, Linear, Problem, linearise, node_motion, stiffness_forces, unit_forces
from reconstruct.rotation import Array, Index, Mask, Words, hat
from reconstruct.wing import HalfWing, twist_gradient, twist_rad

_ENERGY_J = 1e-3  # elastic energy of the strains that point loads at a few stations may leave unexplained
_SURELY = 2.33  # sigmas of χ² above what is expected, from which on it is misfit and not chance (99 %)
_COMMON = ("load_s_m", "prior_scale")  # of all instants


@dataclass(frozen=True, eq=False)
class Fit:
    """The fitted half wing of one instant. When not converged, all numbers are NaN and ``reason`` says why.

    Of F instants every field but ``load_s_m`` and ``prior_scale`` has an axis F in front; their ``reason`` is an array.
    """

    converged: Mask
    reason: Any  # str, or (F,) of them
    iterations: Index
    load_s_m: Array  # (k,) stations of the loads
    unknowns: Array  # (u,) what was solved for, in units of its prior sigma: starts the next fit
    told: Array  # (u,) share of each that the markers told, 0 to 1; the rest is prior
    prior_scale: Array  # (4,) of the prior's variances, as the data chose it; twist, out of plane and in plane last
    stiffness_change: Array  # (4,) relative, as found where loads act only at stations; else zero
    sigma_stiffness: Array  # (4,) one sigma of it
    loads: Array  # (k, 6) net force (N) and moment (N·m), body frame
    load_covariance: Array  # (6k, 6k)
    strain: Array  # (N, 4) extension, twist, out-of-plane, in-plane
    sigma_strain: Array  # (N, 4) one sigma
    position_m: Array  # (N + 1, 3) nodes, body frame
    R_body_section: Array  # (N + 1, 3, 3)
    twist_rad: Array  # (N + 1,) nose-up, against the unloaded wing
    sigma_position_m: Array  # (N + 1, 3) one sigma of what is new in every instant: noise and prior
    sigma_twist_rad: Array  # (N + 1,) the same
    by_told: Array  # (N + 1, 4, u) how nodes (m) and twist (rad) follow what the markers tell,
    told_by: Array  # (u, M, 3) and how that follows, when a marker is measured elsewhere
    residual_m: Array  # (M, 3) measured minus model; NaN where not measured
    distance: Array  # (M,) the residual in sigmas; NaN where not measured
    outlier: Mask  # (M,) bool: measured, but too far off to be believed; not used
    used: Mask  # (M,) bool
    chi2: Array  # over the markers used: N times the paper's J, with full covariances
    dof: Array  # coordinates used minus the effective number of load parameters

    def moved_by(self, markers: Array) -> Array:
        """(N + 1, 4, P) how nodes (m) and twist (rad) follow, when markers are measured elsewhere by (M, 3, P)."""
        return _moved_by(self.by_told, self.told_by, markers)

    def __len__(self) -> int:
        """F."""
        return len(self.converged)

    def __getitem__(self, rows: Any) -> "Fit":
        """One of F instants, or some."""
        return replace(self, **{name: getattr(self, name)[rows] for name in _PER_INSTANT})

    def __iter__(self) -> Iterator["Fit"]:
        return (self[at] for at in range(len(self)))

    @classmethod
    def join(cls, parts: "Sequence[Fit]") -> "Fit":
        """The instants of all ``parts``, at least one, as one; parts are single instants, or several each."""
        together = np.stack if np.ndim(parts[0].converged) == 0 else np.concatenate
        return replace(parts[0], **{name: together([getattr(one, name) for one in parts]) for name in _PER_INSTANT})


_PER_INSTANT = tuple(member.name for member in fields(Fit) if member.name not in _COMMON)


@dataclass(frozen=True, eq=False)
class State:
    """What F instants are known to be, and how well."""

    theta: Array  # (F, u)
    linear: Linear
    weight: Array  # (F, M)
    iterations: Index  # (F,)
    factor: Array  # (F, u, u) factorᵀ · factor is the posterior covariance of theta
    information: Array  # (F, u, u) the markers' share of its inverse

    @property
    def told(self) -> Array:
        """(F, u) share of each unknown that the markers told."""
        told: Array = 1 - np.sum(self.factor**2, axis=1)
        return told


def state_of(problem: Problem, ends: Ends) -> State:
    """What F instants are that have all settled."""
    linear = linearise(problem, ends.strain, ends.theta)
    information = information_of(linear, ends.weight)
    factor = np.linalg.inv(np.linalg.cholesky(information + np.diag(problem.prior)))
    return State(ends.theta, linear, ends.weight, ends.iterations, factor, information)


def information_of(linear: Linear, weight: Array) -> Array:
    """(F, u, u) what markers of ``weight`` (F, M) tell of the unknowns."""
    A = _weighted(linear.jacobian, weight)
    A = A.reshape(len(A), -1, A.shape[-1])
    return np.asarray(A.transpose(0, 2, 1) @ A)


def fit_of(problem: Problem, state: State, stations_m: Array, prior_scale: Array) -> Fit:
    """The fits of F instants; ``residual_m`` is left to the caller, who knows what was measured."""
    half, shape, linear = problem.half, state.linear.shape, state.linear
    used = state.weight > 0
    chi2 = np.sum(np.where(used, linear.distance, 0.0) ** 2, axis=1)
    told = np.sum((state.factor.transpose(0, 2, 1) @ state.factor) * state.information, axis=(1, 2))
    dof = np.maximum(np.sum(np.where(used, problem.coordinates, 0.0), axis=1) - told, 1e-9)
    misfit = chi2 / dof
    # more misfit than chance explains widens the bands (Birge's ratio)
    wider = np.sqrt(np.where(misfit > 1 + _SURELY * np.sqrt(2 / dof), misfit, 1.0))[:, None, None]
    strain_by_told = linear.response @ state.factor.transpose(0, 2, 1)
    by_told = by_strains(half, shape, strain_by_told)
    told_by = _told_by(state)
    variance = np.sum(by_told**2, axis=3)
    if problem.shared is not None:  # what all instants share is not new in each
        following = _moved_by(by_told, told_by, problem.shared)
        variance = np.maximum(variance - np.sum(following**2, axis=3), 0.0)
    sigma = wider * np.sqrt(variance)
    loads, load_covariance = _station_loads(problem, state, wider * state.factor, wider * strain_by_told)
    at_stations = problem.modes is None
    stiffer, softness = np.zeros((len(used), 4)), np.ones((len(used), 4))
    if at_stations:
        k = len(problem.load_sigma)
        stiffer = np.expm1(half.stiffness_sigma * state.theta[:, k:])
        softness = (wider[:, 0] * np.sqrt(np.sum(state.factor**2, axis=1)))[:, k:]
    return Fit(
        converged=np.ones(len(used), dtype=bool),
        reason=np.full(len(used), "", dtype=object),
        iterations=state.iterations,
        load_s_m=stations_m,
        unknowns=state.theta,
        told=state.told,
        prior_scale=prior_scale,
        stiffness_change=stiffer,
        sigma_stiffness=half.stiffness_sigma * softness,
        loads=loads,
        load_covariance=load_covariance,
        strain=shape.strain,
        sigma_strain=(wider[:, 0] * np.sqrt(np.sum(strain_by_told**2, axis=2))).reshape(shape.strain.shape),
        position_m=shape.position_m,
        R_body_section=shape.R_body_section,
        twist_rad=twist_rad(half, shape.R_body_section),
        sigma_position_m=sigma[:, :, :3],
        sigma_twist_rad=sigma[:, :, 3],
        by_told=by_told,
        told_by=told_by,
        residual_m=np.full((*used.shape, 3), np.nan),
        distance=np.where(problem.seen, linear.distance, np.nan),
        outlier=problem.seen & ~used,
        used=used,
        chi2=chi2,
        dof=dof,
    )


def nothing_of(half: HalfWing, unknowns: int, stations_m: Array, prior_scale: Array, reasons: Words) -> Fit:
    """Fits of F instants that could not be fitted, and why."""
    count = len(reasons)

    def nan(*shape: int) -> Array:
        return np.full((count, *shape), np.nan)

    n, k, markers = half.beam.elements, len(stations_m), len(half.marker_ids)
    none = np.zeros((count, markers), dtype=bool)
    return Fit(
        converged=np.zeros(count, dtype=bool),
        reason=reasons,
        iterations=np.zeros(count, dtype=int),
        load_s_m=stations_m,
        unknowns=nan(unknowns),
        told=nan(unknowns),
        prior_scale=prior_scale,
        stiffness_change=nan(4),
        sigma_stiffness=nan(4),
        loads=nan(k, 6),
        load_covariance=nan(6 * k, 6 * k),
        strain=nan(n, 4),
        sigma_strain=nan(n, 4),
        position_m=nan(n + 1, 3),
        R_body_section=nan(n + 1, 3, 3),
        twist_rad=nan(n + 1),
        sigma_position_m=nan(n + 1, 3),
        sigma_twist_rad=nan(n + 1),
        by_told=nan(n + 1, 4, unknowns),
        told_by=nan(unknowns, markers, 3),
        residual_m=nan(markers, 3),
        distance=nan(markers),
        outlier=none,
        used=none.copy(),
        chi2=nan(),
        dof=nan(),
    )


def by_strains(half: HalfWing, shape: Shape, response: Array) -> Array:
    """(…, N + 1, 4, m) how nodes (m) and twist (rad) move when the strains do by columns of ``response`` (…, 4N, m)."""
    motion = node_motion(shape, response, np.arange(half.beam.elements + 1))
    by_motion = np.zeros((*shape.position_m.shape[:-1], 4, 6))
    by_motion[..., :3, :3], by_motion[..., :3, 3:] = -hat(shape.position_m), np.eye(3)
    by_motion[..., 3, :3] = twist_gradient(half, shape.R_body_section)
    return np.asarray(by_motion @ motion)


def with_rows(fit: Fit, rows: Index | Mask, better: Fit) -> Fit:
    """``fit`` of F instants with those of ``better`` at ``rows``."""
    put = {}
    for name in _PER_INSTANT:
        values = getattr(fit, name).copy()
        values[rows] = getattr(better, name)
        put[name] = values
    return replace(fit, **put)


def _weighted(values: Array, weight: Array) -> Array:
    return np.asarray(np.sqrt(weight)[:, :, None, None] * values)


def _moved_by(by_told: Array, told_by: Array, markers: Array) -> Array:
    told = told_by.reshape(*told_by.shape[:-2], -1) @ markers.reshape(*markers.shape[:-3], -1, markers.shape[-1])
    flat = by_told.reshape(*told.shape[:-2], -1, told.shape[-2])
    return np.asarray((flat @ told).reshape(*by_told.shape[:-1], -1))


def _told_by(state: State) -> Array:
    """(F, u, M, 3) the unknowns' independent parts by the markers' measured places (eq. 30)."""
    A, by_point = (_weighted(values, state.weight) for values in (state.linear.jacobian, state.linear.by_point))
    pull = (A.transpose(0, 1, 3, 2) @ by_point).transpose(0, 2, 1, 3)
    found = state.factor @ pull.reshape(*pull.shape[:2], -1)
    return np.asarray(found.reshape(pull.shape))


def _station_loads(problem: Problem, state: State, factor: Array, spread: Array) -> tuple[Array, Array]:
    """Loads (F, k, 6) at the stations and their covariance (F, 6k, 6k).

    ``spread`` (F, 4N, u) is how the strains follow what is known with ``factor``. Where loads act at every node, those
    point loads at the stations whose strains come closest, in elastic energy, to the strains found (eq. 24). What
    strains cannot tell keeps the prior's sigma, and stiffness has its share.
    """
    count = len(factor)
    if problem.modes is None:
        sigma = problem.load_sigma * problem.load_scale
        k = len(sigma)
        covariance = (factor.transpose(0, 2, 1) @ factor)[:, :k, :k]
        return (sigma * state.theta[:, :k]).reshape(count, -1, 6), np.outer(sigma, sigma) * covariance
    beam, shape = problem.half.beam, state.linear.shape
    compliance = np.linalg.inv(beam.stiffness * beam.length_m[:, None, None])

    def softened(generalised: Array) -> Array:
        per_element = generalised.reshape(count, beam.elements, 4, -1)
        return (compliance @ per_element).reshape(generalised.shape)

    unit = unit_forces(problem, shape)
    transposed = unit.transpose(0, 2, 1)
    normal = transposed @ softened(unit) / _ENERGY_J + np.diag(problem.load_sigma**-2.0)
    undetermined = np.linalg.inv(normal)
    gain = undetermined @ transposed / _ENERGY_J
    told = gain @ spread
    stiffer = gain @ softened(stiffness_forces(problem.half, shape.strain))
    loads = (gain @ shape.strain.reshape(count, -1, 1)).reshape(count, -1, 6)
    return loads, told @ told.transpose(0, 2, 1) + stiffer @ stiffer.transpose(0, 2, 1) + undetermined
