"""One instant's marker positions into the loads, shape and twist of the half wing that explain them (paper, eq. 7).

Equation numbers are those of docs/explanation/beam.md. The loads found are net: air, inertia and weight together.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from reconstruct.beam import Shape, shape_of
from reconstruct.loads import Loads, generalised_force_and_tangent
from reconstruct.rotation import Array, Index, Mask, cross, hat
from reconstruct.wing import HalfWing, twist_gradient, twist_rad
from reconstruct.wing_file import FitSettings

FEWEST_MARKERS = 3
_ITERATIONS = 50
_LARGEST_TURN_RAD = 0.3  # of an element in one step
_SETTLED_SIGMA = 1e-3  # the last step in units of the loads' posterior sigma
_NEARLY_SIGMA = 0.1  # the same, to judge which markers to believe
_SETTLED_TURN_RAD = 1e-6  # what is missing to equilibrium in any element
_SMALLEST_MODE = 1e-5  # of the largest mode's variance
_ENERGY_J = 1e-3  # elastic energy of the strains that point loads at a few stations may leave unexplained
_HUBER = 3.0  # sigmas
_ROUNDS = 10  # changes of which markers are in
_MEDIAN_DISTANCE = 1.538  # median length of a standard normal 3-vector


@dataclass(frozen=True, eq=False)
class Fit:
    """The fitted half wing of one instant. When not converged, all numbers are NaN and ``reason`` says why."""

    converged: bool
    reason: str
    iterations: int
    load_s_m: Array  # (k,) stations of the loads
    unknowns: Array  # what was solved for, in units of its prior sigma: starts the next fit
    loads: Array  # (k, 6) net force (N) and moment (N·m), body frame
    load_covariance: Array  # (6k, 6k)
    strain: Array  # (N, 4) extension, twist, out-of-plane, in-plane
    position_m: Array  # (N + 1, 3) nodes, body frame
    R_body_section: Array  # (N + 1, 3, 3)
    twist_rad: Array  # (N + 1,) nose-up, against the unloaded wing
    sigma_position_m: Array  # (N + 1, 3) one sigma
    sigma_twist_rad: Array  # (N + 1,) one sigma
    residual_m: Array  # (M, 3) measured minus model; NaN where not measured
    distance: Array  # (M,) the residual in sigmas; NaN where not measured
    outlier: Mask  # (M,) bool: measured, but too far off to be believed; not used
    used: Mask  # (M,) bool
    chi2: float  # over the markers used: N times the paper's J, with full covariances
    dof: float  # coordinates used minus the effective number of load parameters


@dataclass(frozen=True, eq=False)
class _Problem:
    half: HalfWing
    load_nodes: Index
    modes: Array | None  # (4N, m) strains of a unit of each unknown where loads act at every node
    load_sigma: Array  # (6k,) prior; the unknowns are the loads in units of it
    xyz: Array  # (M, 3), zero where not measured
    whiten: Array  # (M, 3, 3) inverse Cholesky factors, zero where not measured
    seen: Mask  # (M,) bool
    outlier_sigma: float

    @property
    def unknowns(self) -> int:
        return len(self.load_sigma) if self.modes is None else self.modes.shape[1]


@dataclass(frozen=True, eq=False)
class _Linear:
    """The problem linearised at some strains and loads; theta counts the loads in units of their prior sigma."""

    shape: Shape
    correction: Array  # (4N,) what Newton would add to the strains under the present loads,
    response: Array  # (4N, 6k) and under a unit more of each load
    spin: Array  # (N + 1, 3, 6k) how the loads turn the nodes,
    slide: Array  # and move them: a point p of node n moves by slide[n] + spin[n] × p
    distance: Array  # (M,) sigmas between measured and model
    jacobian: Array  # (M, 3, 6k) of the markers, in sigmas
    predicted: Array  # (M, 3) residual after the correction, in sigmas


@dataclass(frozen=True, eq=False)
class _State:
    settled: bool
    iterations: int
    theta: Array  # (6k,)
    linear: _Linear
    weight: Array  # (M,)
    factor: Array  # (6k, 6k) factorᵀ · factor is the posterior covariance of theta
    information: Array  # (6k, 6k) the markers' share of its inverse


def fit_frame(
    half: HalfWing,
    marker_xyz_m: Array,
    marker_cov_m2: Array,
    settings: FitSettings,
    start: Fit | None = None,
) -> Fit:
    """Fit net loads at a few stations, and with them the shape, to one instant's markers (eqs. 16 to 24).

    Args:
        half: the half wing.
        marker_xyz_m: (M, 3) body frame, in the order of ``half.marker_ids``; NaN rows for markers not measured.
        marker_cov_m2: (M, 3, 3); a marker whose covariance is NaN or not positive definite counts as not measured.
        settings: load stations, prior and marker model, from the wing file.
        start: the fit of a neighbouring instant. One that did not converge is ignored, and when the iteration does not
            settle from it, it begins again from the unloaded wing: divergence cannot travel from frame to frame.

    Returns:
        the fit; with NaN and a reason when fewer than three markers were measured, the iteration does not settle, or
        less than half of the markers agree with it.
    """
    problem = _pose(half, marker_xyz_m, marker_cov_m2, settings)
    stations = np.array(settings.load_stations_m)
    count = int(problem.seen.sum())
    if count < FEWEST_MARKERS:
        return _failed(half, stations, 0, f"{count} of {len(problem.seen)} markers measured, {FEWEST_MARKERS} needed")
    state = None
    if start is not None and start.converged and len(start.unknowns) == problem.unknowns:
        state = _iterate(problem, start.strain, start.unknowns)
    if state is None or _objection(problem, state):
        state = _iterate(problem, np.zeros((half.beam.elements, 4)), np.zeros(problem.unknowns))
        objection = _objection(problem, state)
        if objection:
            return _failed(half, stations, state.iterations, objection)
    return _result(problem, state, stations)


def _pose(half: HalfWing, xyz: Array, cov: Array, settings: FitSettings) -> _Problem:
    markers = len(half.marker_ids)
    if xyz.shape != (markers, 3) or cov.shape != (markers, 3, 3):
        raise ValueError(f"expected {markers} markers, got shapes {xyz.shape} and {cov.shape}")
    seen: Mask = np.isfinite(np.concatenate([xyz[:, :, None], cov], axis=2)).all(axis=(1, 2))
    safe = np.where(seen[:, None, None], cov, np.eye(3))
    seen = np.logical_and(seen, np.linalg.eigvalsh(safe)[:, 0] > 0)
    full = np.where(seen[:, None, None], safe, np.eye(3)) + settings.marker_model_sigma_m**2 * np.eye(3)
    whiten = np.linalg.inv(np.linalg.cholesky(full)) * seen[:, None, None]
    sigma = np.repeat([settings.force_sigma_n, settings.moment_sigma_nm], 3)
    return _Problem(
        half=half,
        load_nodes=np.array([half.node_at(station) for station in settings.load_stations_m]),
        modes=_strain_modes(half, settings) if settings.loads == "everywhere" else None,
        load_sigma=np.tile(sigma, len(settings.load_stations_m)),
        xyz=np.where(seen[:, None], xyz, 0.0),
        whiten=whiten,
        seen=seen,
        outlier_sigma=settings.outlier_sigma,
    )


@lru_cache(maxsize=16)
def _strain_modes(half: HalfWing, settings: FitSettings) -> Array:
    """The strains' prior as independent modes of unit variance (eqs. 21 to 23): (4N, m).

    Along the span a Matérn 5/2 process, as moments under distributed loads are smooth; times a taper, as a free end
    carries no moment (a tenth is left there for loads on the tip).
    """
    stiffness, span = half.beam.stiffness, half.node_s_m[-1]
    x = (half.node_s_m[:-1] + half.node_s_m[1:]) / (2 * span)
    apart = np.sqrt(5) * np.abs(x[:, None] - x[None, :]) / settings.correlation
    variance, shapes = np.linalg.eigh((1 + apart + apart**2 / 3) * np.exp(-apart))
    kept = variance > _SMALLEST_MODE * variance[-1]
    shapes = shapes[:, kept] * np.sqrt(variance[kept])
    to_free_end = 1 - 0.9 * x
    twist, out = np.radians([settings.twist_sigma_deg, settings.bend_out_sigma_deg]) / span
    if settings.bend_in_sigma_deg is None:
        into = out * np.sqrt(stiffness[:, 2, 2] / stiffness[:, 3, 3])
    else:
        into = np.radians(settings.bend_in_sigma_deg) / span
    sigma = (np.full(len(x), settings.extension_sigma), twist * to_free_end, out * to_free_end, into * to_free_end)
    modes = np.zeros((len(x), 4, 4, shapes.shape[1]))
    for i in range(4):
        modes[:, i, i] = sigma[i][:, None] * shapes
    return modes.reshape(4 * len(x), -1)


def _iterate(problem: _Problem, strain: Array, theta: Array) -> _State:
    """Gauss–Newton on loads and equilibrium at once: one Newton correction of the strains a step (eqs. 18 to 20).

    While the iteration runs a marker's pull is bounded (Huber; the scale is the median's, so that a wing far from its
    start is not taken for outliers). That cost has one minimum, so no start can lock the wrong markers in. Then each
    marker is in or out.
    """
    length = np.repeat(problem.half.beam.length_m, 4)
    decided: Array | None = None
    rounds = 0
    for iteration in range(1, _ITERATIONS + 1):
        linear = _linearise(problem, strain, theta)
        weight = _weight(problem, linear.distance) if decided is None else decided
        root = np.sqrt(weight)[:, None]
        A = (root[:, :, None] * linear.jacobian).reshape(-1, len(theta))
        information = A.T @ A
        normal = information + np.eye(len(theta))
        try:
            factor = np.linalg.inv(np.linalg.cholesky(normal))
        except np.linalg.LinAlgError:
            break
        change = -factor.T @ (factor @ (A.T @ (root * linear.predicted).ravel() + theta))
        step = linear.correction + linear.response @ change
        turn = float(np.abs(step * length).max())
        if not np.isfinite(turn):
            break
        imbalance = float(np.abs(linear.correction * length).max())
        enough = _NEARLY_SIGMA if decided is None else _SETTLED_SIGMA
        if np.sqrt(change @ normal @ change) < enough and imbalance < _SETTLED_TURN_RAD:
            verdict = _verdict(problem, linear.distance)
            if decided is not None and (np.array_equal(verdict, weight) or rounds == _ROUNDS):
                return _State(True, iteration, theta, linear, weight, factor, information)
            decided = verdict
            rounds += 1
        damping = min(1.0, _LARGEST_TURN_RAD / max(turn, 1e-300))
        strain = strain + damping * step.reshape(-1, 4)
        theta = theta + damping * change
    return _State(False, iteration, theta, linear, weight, information, information)


def _objection(problem: _Problem, state: _State) -> str:
    """Why a state is not the wing's shape; empty when it is."""
    if not state.settled:
        return f"did not settle in {_ITERATIONS} iterations"
    agree, seen = int(np.sum(state.weight > 0)), int(problem.seen.sum())
    if agree < max(FEWEST_MARKERS, seen / 2):
        return f"only {agree} of {seen} markers agree on one shape of the wing"
    return ""


def _linearise(problem: _Problem, strain: Array, theta: Array) -> _Linear:
    half, beam = problem.half, problem.half.beam
    shape = shape_of(beam, strain)
    if problem.modes is not None:
        both = np.column_stack([problem.modes, np.zeros(4 * beam.elements)])
    else:
        unit = _unit_forces(problem, shape) * problem.load_sigma
        Q, H = generalised_force_and_tangent(beam, shape, _loads(problem, theta))
        K = beam.stiffness_matrix
        both = np.linalg.solve(K - H, np.column_stack([unit, Q - K @ strain.ravel()]))
    spin, slide = _node_motion(shape, both)
    node, point = half.marker_node, _marker_points(half, shape)
    motion = problem.whiten @ (slide[node] + hat(point).transpose(0, 2, 1) @ spin[node])
    residual = (problem.whiten @ (point - problem.xyz)[:, :, None])[:, :, 0]
    return _Linear(
        shape=shape,
        correction=both[:, -1],
        response=both[:, :-1],
        spin=spin[:, :, :-1],
        slide=slide[:, :, :-1],
        distance=np.sqrt(np.sum(residual**2, axis=1)),
        jacobian=motion[:, :, :-1],
        predicted=residual + motion[:, :, -1],
    )


def _scale(problem: _Problem, distance: Array) -> float:
    return max(1.0, float(np.median(distance[problem.seen])) / _MEDIAN_DISTANCE)


def _weight(problem: _Problem, distance: Array) -> Array:
    limit = _HUBER * _scale(problem, distance)
    return np.where(problem.seen, limit / np.maximum(distance, limit), 0.0)


def _verdict(problem: _Problem, distance: Array) -> Array:
    believed = distance <= problem.outlier_sigma * _scale(problem, distance)
    return np.where(problem.seen & believed, 1.0, 0.0)


def _loads(problem: _Problem, theta: Array) -> Loads:
    force, moment = np.zeros((2, problem.half.beam.elements + 1, 3))
    per_station = (problem.load_sigma * theta).reshape(-1, 6)
    force[problem.load_nodes], moment[problem.load_nodes] = per_station[:, :3], per_station[:, 3:]
    return Loads(force, moment)


def _unit_forces(problem: _Problem, shape: Shape) -> Array:
    """Generalised forces of a unit of each load component (eq. 17): (4N, 6k)."""
    nodes = problem.load_nodes
    reach = shape.position_m[nodes]
    moves = shape.slide[:, None, :] + cross(shape.spin[:, None, :], reach[None])
    both = np.concatenate([moves, np.broadcast_to(shape.spin[:, None, :], moves.shape)], axis=2)
    inboard = problem.half.beam.element_of[:, None] < nodes[None, :]
    return (both * inboard[:, :, None]).reshape(len(shape.spin), -1)


def _node_motion(shape: Shape, response: Array) -> tuple[Array, Array]:
    """Spin and slide (N + 1, 3, m) of the nodes when the strains change by the columns of ``response`` (4N, m)."""
    n, m = len(shape.turn), response.shape[1]
    per_element = response.reshape(n, 4, m)
    out = np.zeros((2, n + 1, 3, m))
    for total, per_strain in zip(out, (shape.spin, shape.slide), strict=True):
        np.cumsum(per_strain.reshape(n, 4, 3).transpose(0, 2, 1) @ per_element, axis=0, out=total[1:])
    return out[0], out[1]


def _marker_points(half: HalfWing, shape: Shape) -> Array:
    node = half.marker_node
    return shape.position_m[node] + (shape.R_body_section[node] @ half.marker_offset_m[:, :, None])[:, :, 0]


def _result(problem: _Problem, state: _State, stations: Array) -> Fit:
    half, shape = problem.half, state.linear.shape
    used = state.weight > 0
    chi2 = float(np.sum(state.linear.distance[used] ** 2))
    dof = float(3 * used.sum() - np.sum((state.factor.T @ state.factor) * state.information))
    factor = state.factor * np.sqrt(max(1.0, chi2 / dof))  # a misfit widens the bands (Birge's ratio)
    spin, slide = state.linear.spin @ factor.T, state.linear.slide @ factor.T
    moves = slide + hat(shape.position_m).transpose(0, 2, 1) @ spin
    twists = (twist_gradient(half, shape.R_body_section)[:, None, :] @ spin)[:, 0, :]
    loads, load_covariance = _station_loads(problem, state, factor)
    measured = problem.seen[:, None]
    return Fit(
        converged=True,
        reason="",
        iterations=state.iterations,
        load_s_m=stations,
        unknowns=state.theta,
        loads=loads,
        load_covariance=load_covariance,
        strain=shape.strain,
        position_m=shape.position_m,
        R_body_section=shape.R_body_section,
        twist_rad=twist_rad(half, shape.R_body_section),
        sigma_position_m=np.sqrt(np.sum(moves**2, axis=2)),
        sigma_twist_rad=np.sqrt(np.sum(twists**2, axis=1)),
        residual_m=np.where(measured, problem.xyz - _marker_points(half, shape), np.nan),
        distance=np.where(problem.seen, state.linear.distance, np.nan),
        outlier=problem.seen & ~used,
        used=used,
        chi2=chi2,
        dof=dof,
    )


def _station_loads(problem: _Problem, state: _State, factor: Array) -> tuple[Array, Array]:
    """Loads (k, 6) at the stations and their covariance (6k, 6k).

    Where loads act at every node, those point loads at the stations whose strains come closest, in elastic energy, to
    the strains found (eq. 24). What strains cannot tell keeps the prior's sigma.
    """
    sigma = problem.load_sigma
    if problem.modes is None:
        covariance = factor.T @ factor
        return (sigma * state.theta).reshape(-1, 6), np.outer(sigma, sigma) * covariance
    beam, shape = problem.half.beam, state.linear.shape
    unit = _unit_forces(problem, shape)
    flexible = np.linalg.solve(beam.stiffness * beam.length_m[:, None, None], unit.reshape(beam.elements, 4, -1))
    normal = unit.T @ flexible.reshape(unit.shape) / _ENERGY_J + np.diag(sigma**-2.0)
    undetermined = np.linalg.inv(normal)
    gain = undetermined @ unit.T / _ENERGY_J
    spread = gain @ problem.modes @ factor.T
    return (gain @ shape.strain.ravel()).reshape(-1, 6), spread @ spread.T + undetermined


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
        loads=nan(k, 6),
        load_covariance=nan(6 * k, 6 * k),
        strain=nan(n, 4),
        position_m=nan(n + 1, 3),
        R_body_section=nan(n + 1, 3, 3),
        twist_rad=nan(n + 1),
        sigma_position_m=nan(n + 1, 3),
        sigma_twist_rad=nan(n + 1),
        residual_m=nan(markers, 3),
        distance=nan(markers),
        outlier=none,
        used=none,
        chi2=float("nan"),
        dof=float("nan"),
    )
