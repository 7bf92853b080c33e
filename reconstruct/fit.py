"""One instant's marker positions into the loads, shape and twist of the half wing that explain them (paper, eq. 7).

Equation numbers are those of docs/explanation/beam.md. The loads found are net: air, inertia and weight together.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from reconstruct.iteration import (
    FEWEST_MARKERS,
    Measure,
    Problem,
    State,
    iterate,
    linearise,
    objection,
    stiffness_forces,
    unit_forces,
)
from reconstruct.prior import FREE, GROUPS, STATED, STATIONS_GROUP, rescaled, strain_prior
from reconstruct.rotation import Array, Index, Mask, hat
from reconstruct.wing import HalfWing, twist_gradient, twist_rad
from reconstruct.wing_file import FitSettings

_ENERGY_J = 1e-3  # elastic energy of the strains that point loads at a few stations may leave unexplained
_SCALE_ROUNDS = 6  # of choosing the prior's scale
_SCALE_SETS = 60  # of a flight, to choose it from
_SAME_SCALE = 0.05  # relative
_SURELY = 2.33  # sigmas of χ² above what is expected, from which on it is misfit and not chance (99 %)


@dataclass(frozen=True, eq=False)
class Fit:
    """The fitted half wing of one instant. When not converged, all numbers are NaN and ``reason`` says why."""

    converged: bool
    reason: str
    iterations: int
    load_s_m: Array  # (k,) stations of the loads
    unknowns: Array  # what was solved for, in units of its prior sigma: starts the next fit
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
    by_marker: Array  # (N + 1, 4, M, 3) how nodes (m) and twist (rad) follow, when a marker is measured elsewhere
    residual_m: Array  # (M, 3) measured minus model; NaN where not measured
    distance: Array  # (M,) the residual in sigmas; NaN where not measured
    outlier: Mask  # (M,) bool: measured, but too far off to be believed; not used
    used: Mask  # (M,) bool
    chi2: float  # over the markers used: N times the paper's J, with full covariances
    dof: float  # coordinates used minus the effective number of load parameters


@dataclass(frozen=True, eq=False)
class Unscaled:
    """A problem before the data have chosen how large its prior is."""

    problem: Problem
    group: Index  # (u,) of each unknown


def fit_frame(
    half: HalfWing,
    marker_xyz_m: Array,
    marker_cov_m2: Array,
    settings: FitSettings,
    start: Fit | None = None,
    prior_scale: Array | None = None,
) -> Fit:
    """Fit net loads, and with them the shape, to one instant's markers (eqs. 16 to 26).

    Args:
        half: the half wing.
        marker_xyz_m: (M, 3) body frame, in the order of ``half.marker_ids``; NaN rows for markers not measured.
        marker_cov_m2: (M, 3, 3); a marker whose covariance is NaN or not positive definite counts as not measured.
        settings: load stations, prior and marker model, from the wing file.
        start: the fit of a neighbouring instant. One that did not converge is ignored, and when the iteration does not
            settle from it, it begins again from the unloaded wing: divergence cannot travel from frame to frame.
        prior_scale: (4,) as another fit, or all fits of a flight, chose it; None: chosen by this instant's markers.

    Returns:
        the fit; with NaN and a reason when fewer than three markers were measured, the iteration does not settle, or
        less than half of the markers agree with it.
    """
    posed = marker_problem(half, marker_xyz_m, marker_cov_m2, settings)
    fit = fit_measured(posed, settings, start, prior_scale)
    return with_residuals(half, fit, marker_xyz_m)


def with_residuals(half: HalfWing, fit: Fit, marker_xyz_m: Array) -> Fit:
    """The fit with measured minus fitted places of the markers that were measured."""
    if not fit.converged:
        return fit
    measured = (fit.used | fit.outlier)[:, None]
    return replace(fit, residual_m=np.where(measured, marker_xyz_m - marker_places(half, fit), np.nan))


def fit_from(
    posed: Unscaled, settings: FitSettings, single: Fit, theta: Array, covariance: Array, prior_scale: Array
) -> Fit:
    """The fit at unknowns (u,) with covariance (u, u) that were found elsewhere, from more than this set's markers.

    ``single`` is the set's own fit, whose verdict on the markers stays; where there was none, no marker is in use.
    Loads must act everywhere.
    """
    problem = scaled(posed, prior_scale)
    assert problem.modes is not None
    linear = linearise(problem, (problem.modes @ theta).reshape(-1, 4), theta)
    A = linear.jacobian[single.used].reshape(-1, len(theta))
    factor = np.asarray(np.linalg.cholesky(covariance + 1e-12 * np.eye(len(theta))).T, dtype=np.float64)
    weight = single.used.astype(np.float64)
    state = State(True, single.iterations, theta, linear, weight, factor, A.T @ A, "")
    found = _result(problem, state, np.array(settings.load_stations_m), prior_scale)
    if single.converged:
        return found
    return replace(found, outlier=single.outlier, distance=single.distance, chi2=float("nan"), dof=float("nan"))


def marker_problem(half: HalfWing, marker_xyz_m: Array, marker_cov_m2: Array, settings: FitSettings) -> Unscaled:
    """The problem of markers at known places (M, 3), with covariances (M, 3, 3); NaN where not measured."""
    markers = len(half.marker_ids)
    if marker_xyz_m.shape != (markers, 3) or marker_cov_m2.shape != (markers, 3, 3):
        raise ValueError(f"expected {markers} markers, got shapes {marker_xyz_m.shape} and {marker_cov_m2.shape}")
    seen: Mask = np.isfinite(np.concatenate([marker_xyz_m[:, :, None], marker_cov_m2], axis=2)).all(axis=(1, 2))
    safe = np.where(seen[:, None, None], marker_cov_m2, np.eye(3))
    seen = np.logical_and(seen, np.linalg.eigvalsh(safe)[:, 0] > 0)
    full = np.where(seen[:, None, None], safe, np.eye(3)) + settings.marker_model_sigma_m**2 * np.eye(3)
    whiten = np.linalg.inv(np.linalg.cholesky(full)) * seen[:, None, None]
    xyz = np.where(seen[:, None], marker_xyz_m, 0.0)

    def measure(point: Array) -> tuple[Array, Array]:
        return (whiten @ (point - xyz)[:, :, None])[:, :, 0], whiten

    return pose(half, settings, measure, seen, 3.0 * seen.astype(np.float64))


def common_scale(half: HalfWing, marker_xyz_m: Array, marker_cov_m2: Array, settings: FitSettings) -> Array:
    """``scale_of`` sets of markers (F, M, 3) with covariances (F, M, 3, 3)."""
    sets = zip(marker_xyz_m, marker_cov_m2, strict=True)
    return scale_of([marker_problem(half, xyz, cov, settings) for xyz, cov in sets], settings)


def scale_of(posed: Sequence[Unscaled], settings: FitSettings) -> Array:
    """The prior's scale (4,) that many instants together make likeliest (eq. 25).

    At most sixty are used, spread evenly. All instants share it: what one set's markers tell of how much the wing
    twists at all is little.
    """
    enough = np.flatnonzero([one.problem.seen.sum() >= FEWEST_MARKERS for one in posed])
    if not len(enough):
        return STATED
    picked = [posed[i] for i in enough[np.unique(np.linspace(0, len(enough) - 1, _SCALE_SETS).round().astype(int))]]
    group = picked[0].group
    scale = STATED
    fits: list[Fit | None] = [None] * len(picked)
    for _ in range(_SCALE_ROUNDS):
        fits = [fit_measured(one, settings, before, scale) for one, before in zip(picked, fits, strict=True)]
        good = [fit for fit in fits if fit is not None and fit.converged]
        if not good:
            break
        found, told = np.array([fit.unknowns for fit in good]), np.array([fit.told for fit in good])
        before_scale, scale = scale, rescaled(scale, group, found, told, settings.prior_weight)
        if np.abs(np.log(scale / before_scale)).max() < _SAME_SCALE:
            break
    return scale


def marker_places(half: HalfWing, fit: Fit) -> Array:
    """(M, 3) where the fit has the markers, body frame."""
    node = half.marker_node
    places: Array = fit.position_m[node] + (fit.R_body_section[node] @ half.marker_offset_m[:, :, None])[:, :, 0]
    return places


def pose(half: HalfWing, settings: FitSettings, measure: Measure, seen: Mask, coordinates: Array) -> Unscaled:
    """The problem of finding the half wing that ``measure`` was taken of (eq. 16).

    Args:
        half: the half wing.
        settings: from the wing file.
        measure: how far any markers are from those measured.
        seen: (M,) which were.
        coordinates: (M,) numbers measured of each.
    """
    stations = settings.load_stations_m
    sigma = np.tile(np.repeat([settings.force_sigma_n, settings.moment_sigma_nm], 3), len(stations))
    group = _group(half, settings)
    prior = np.ones(len(group))
    modes = None
    if settings.loads == "everywhere":
        modes = strain_prior(half, settings).modes
    else:
        prior[: len(sigma)] = settings.prior_weight != 0
    problem = Problem(
        half=half,
        load_nodes=np.array([half.node_at(station) for station in stations]),
        modes=modes,
        load_sigma=sigma,
        load_scale=np.ones(len(sigma)),
        prior=prior,
        measure=measure,
        seen=seen,
        coordinates=coordinates,
        outlier_sigma=settings.outlier_sigma,
    )
    return Unscaled(problem, group)


def fit_measured(
    posed: Unscaled, settings: FitSettings, start: Fit | None = None, prior_scale: Array | None = None
) -> Fit:
    """Solve what ``pose`` made; ``residual_m`` is left to the caller, who knows what was measured."""
    problem = posed.problem
    stations = np.array(settings.load_stations_m)
    count = int(problem.seen.sum())
    if count < FEWEST_MARKERS:
        return _failed(
            problem.half, stations, 0, f"{count} of {len(problem.seen)} markers measured, {FEWEST_MARKERS} needed"
        )
    nothing = np.zeros((problem.half.beam.elements, 4)), np.zeros(problem.unknowns)
    state = None
    if start is not None and start.converged and len(start.unknowns) == problem.unknowns:
        state, scale = _solve(posed, settings, start.strain, start.unknowns, start.prior_scale, prior_scale)
    if state is None or objection(problem, state):
        state, scale = _solve(posed, settings, *nothing, STATED, prior_scale)
        against = objection(problem, state)
        if against and settings.loads == "stations" and settings.prior_weight != 0:
            state, scale = _solve(posed, settings, *_from_loads_everywhere(posed, settings), STATED, prior_scale)
            against = objection(problem, state)
        if against:
            return _failed(problem.half, stations, state.iterations, against)
    return _result(scaled(posed, scale), state, stations, scale)


def _from_loads_everywhere(posed: Unscaled, settings: FitSettings) -> tuple[Array, Array]:
    """Strains and unknowns to begin from where loads at stations do not find the wing from its unloaded shape."""
    problem = posed.problem
    elsewhere = settings.model_copy(update={"loads": "everywhere"})
    found = fit_measured(pose(problem.half, elsewhere, problem.measure, problem.seen, problem.coordinates), elsewhere)
    theta = np.zeros(problem.unknowns)
    if not found.converged:
        return np.zeros((problem.half.beam.elements, 4)), theta
    theta[: len(problem.load_sigma)] = found.loads.ravel() / problem.load_sigma
    return found.strain, theta


def _solve(
    posed: Unscaled, settings: FitSettings, strain: Array, theta: Array, begin: Array, given: Array | None
) -> tuple[State, Array]:
    """The iteration's end, and the prior's scale: as given, or in turn with the loads until it settles (eq. 25)."""
    weight, group = settings.prior_weight, posed.group
    fixed = given if given is not None else None if weight == "data" else rescaled(begin, group, theta, theta, weight)
    scale = begin if fixed is None else fixed
    theta = theta * np.sqrt(begin[group] / scale[group])
    iterations = 0
    for _ in range(_SCALE_ROUNDS):
        state = iterate(scaled(posed, scale), strain, theta)
        iterations += state.iterations
        if fixed is not None or objection(posed.problem, state):
            break
        better = rescaled(scale, group, state.theta, _told(state), weight)
        if np.abs(np.log(better / scale)).max() < _SAME_SCALE:
            break
        strain, theta = state.linear.shape.strain, state.theta * np.sqrt(scale[group] / better[group])
        scale = better
    return replace(state, iterations=iterations), scale


def _group(half: HalfWing, settings: FitSettings) -> Index:
    """(u,) what each unknown is scaled with."""
    if settings.loads == "everywhere":
        return strain_prior(half, settings).group
    return np.concatenate([np.tile(STATIONS_GROUP, len(settings.load_stations_m)), np.full(4, FREE)])


def _told(state: State) -> Array:
    told: Array = 1 - np.sum(state.factor**2, axis=0)
    return told


def scaled(posed: Unscaled, scale: Array) -> Problem:
    """The problem with its prior's groups as large as ``scale`` (4,) says."""
    root = np.sqrt(scale[posed.group])
    problem = posed.problem
    if problem.modes is not None:
        return replace(problem, modes=problem.modes * root)
    return replace(problem, load_scale=root[: len(problem.load_sigma)])


def _result(problem: Problem, state: State, stations: Array, scale: Array) -> Fit:
    half, shape = problem.half, state.linear.shape
    used = state.weight > 0
    chi2 = float(np.sum(state.linear.distance[used] ** 2))
    told = float(np.sum((state.factor.T @ state.factor) * state.information))
    dof = max(float(problem.coordinates[used].sum()) - told, 1e-9)
    misfit = chi2 / dof
    # more misfit than chance explains widens the bands (Birge's ratio)
    factor = state.factor * np.sqrt(misfit if misfit > 1 + _SURELY * np.sqrt(2 / dof) else 1.0)
    moves = state.linear.slide + hat(shape.position_m).transpose(0, 2, 1) @ state.linear.spin
    twists = twist_gradient(half, shape.R_body_section)[:, None, :] @ state.linear.spin
    by_unknown = np.concatenate([moves, twists], axis=1)
    sigma = np.sqrt(np.sum((by_unknown @ factor.T) ** 2, axis=2))
    loads, load_covariance = _station_loads(problem, state, factor)
    k = len(problem.load_sigma)
    at_stations = problem.modes is None
    return Fit(
        converged=True,
        reason="",
        iterations=state.iterations,
        load_s_m=stations,
        unknowns=state.theta,
        told=_told(state),
        prior_scale=scale,
        stiffness_change=np.expm1(half.stiffness_sigma * state.theta[k:]) if at_stations else np.zeros(4),
        sigma_stiffness=half.stiffness_sigma * (np.sqrt(np.sum(factor**2, axis=0))[k:] if at_stations else np.ones(4)),
        loads=loads,
        load_covariance=load_covariance,
        strain=shape.strain,
        sigma_strain=np.sqrt(np.sum((state.linear.response @ factor.T) ** 2, axis=1)).reshape(-1, 4),
        position_m=shape.position_m,
        R_body_section=shape.R_body_section,
        twist_rad=twist_rad(half, shape.R_body_section),
        sigma_position_m=sigma[:, :3],
        sigma_twist_rad=sigma[:, 3],
        by_marker=_by_marker(problem, state, by_unknown),
        residual_m=np.full((len(problem.seen), 3), np.nan),
        distance=np.where(problem.seen, state.linear.distance, np.nan),
        outlier=problem.seen & ~used,
        used=used,
        chi2=chi2,
        dof=dof,
    )


def _by_marker(problem: Problem, state: State, by_unknown: Array) -> Array:
    """(N + 1, 4, M, 3) of nodes and twist by the markers' measured places (eq. 21a)."""
    believed = state.weight[:, None, None]
    A = np.sqrt(believed) * state.linear.jacobian
    pull = (A.transpose(0, 2, 1) @ (np.sqrt(believed) * state.linear.by_point)).transpose(1, 0, 2)
    normal = A.reshape(-1, A.shape[2]).T @ A.reshape(-1, A.shape[2]) + np.diag(problem.prior)
    follows = np.linalg.solve(normal, pull.reshape(len(pull), -1))
    return (by_unknown @ follows).reshape(*by_unknown.shape[:2], *pull.shape[1:])


def _station_loads(problem: Problem, state: State, factor: Array) -> tuple[Array, Array]:
    """Loads (k, 6) at the stations and their covariance (6k, 6k).

    Where loads act at every node, those point loads at the stations whose strains come closest, in elastic energy, to
    the strains found (eq. 24). What strains cannot tell keeps the prior's sigma, and stiffness has its share.
    """
    if problem.modes is None:
        sigma = problem.load_sigma * problem.load_scale
        k = len(sigma)
        covariance = (factor.T @ factor)[:k, :k]
        return (sigma * state.theta[:k]).reshape(-1, 6), np.outer(sigma, sigma) * covariance
    beam, shape = problem.half.beam, state.linear.shape
    stiffness = beam.stiffness * beam.length_m[:, None, None]
    unit = unit_forces(problem, shape)
    flexible = np.linalg.solve(stiffness, unit.reshape(beam.elements, 4, -1))
    normal = unit.T @ flexible.reshape(unit.shape) / _ENERGY_J + np.diag(problem.load_sigma**-2.0)
    undetermined = np.linalg.inv(normal)
    gain = undetermined @ unit.T / _ENERGY_J
    spread = gain @ problem.modes @ factor.T
    pull = stiffness_forces(problem.half, shape.strain)
    stiffer = gain @ np.linalg.solve(stiffness, pull.reshape(beam.elements, 4, 4)).reshape(pull.shape)
    loads = (gain @ shape.strain.ravel()).reshape(-1, 6)
    return loads, spread @ spread.T + stiffer @ stiffer.T + undetermined


def _failed(half: HalfWing, stations: Array, iterations: int, reason: str) -> Fit:
    def nan(*shape: int) -> Array:
        return np.full(shape, np.nan)

    n, k, markers = half.beam.elements, len(stations), len(half.marker_ids)
    none = np.zeros(markers, dtype=bool)
    return Fit(
        converged=False,
        reason=reason,
        iterations=iterations,
        load_s_m=stations,
        unknowns=np.empty(0),
        told=np.empty(0),
        prior_scale=nan(GROUPS),
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
        by_marker=nan(n + 1, 4, markers, 3),
        residual_m=nan(markers, 3),
        distance=nan(markers),
        outlier=none,
        used=none,
        chi2=float("nan"),
        dof=float("nan"),
    )
