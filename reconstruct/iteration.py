"""What was measured of a half wing, and what is believed of its loads, into the strains that agree with both.

The Gauss–Newton iteration under the fit. Equation numbers are those of docs/explanation/beam.md.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from reconstruct.beam import Shape, shape_of
from reconstruct.loads import Loads, generalised_force_and_tangent
from reconstruct.rotation import Array, Index, Mask, cross, hat
from reconstruct.wing import HalfWing

FEWEST_MARKERS = 3
ITERATIONS = 80
_FULL_STEPS = 15
_LAST_UNDECIDED = 45  # then the place is taken that came closest to most markers
_LARGEST_TURN_RAD = 0.3  # of an element in one step
_SETTLED_SIGMA = 1e-3  # the last step in units of the loads' posterior sigma
_NEARLY_SIGMA = 0.1  # the same, to judge which markers to believe
_SETTLED_TURN_RAD = 1e-6  # what is missing to equilibrium in any element
_LARGEST_LOG = 3.0  # of a stiffness against the stated one
_HUBER = 3.0  # sigmas
_ROUNDS = 10  # changes of which markers are in
_MEDIAN_DISTANCE = 1.538  # median length of a standard normal 3-vector

Measure = Callable[[Array], tuple[Array, Array]]
"""Markers' places (M, 3) to model minus measured, in sigmas (M, d), and its derivative (M, d, 3); zero if not seen."""


@dataclass(frozen=True, eq=False)
class Problem:
    """One instant of one half wing. Unknowns are in units of their prior sigma."""

    half: HalfWing
    load_nodes: Index
    modes: Array | None  # (4N, m) strains of a unit of each unknown where loads act at every node
    load_sigma: Array  # (6k,) prior at the stations: the unknowns, where loads act only there, are in units of it
    load_scale: Array  # (6k,) what the data made of it, sigmas
    prior: Array  # (u,) 1, or 0 for an unknown that has none
    measure: Measure
    seen: Mask  # (M,) bool
    coordinates: Array  # (M,) numbers measured of each marker
    outlier_sigma: float

    @property
    def unknowns(self) -> int:
        """u: the modes, or the loads at the stations and the stiffness's four logarithms."""
        return len(self.prior)


@dataclass(frozen=True, eq=False)
class Linear:
    """The problem linearised at some strains and unknowns."""

    shape: Shape
    correction: Array  # (4N,) what Newton would add to the strains under the present loads,
    response: Array  # (4N, u) and under a unit more of each unknown
    spin: Array  # (N + 1, 3, u) how the unknowns turn the nodes,
    slide: Array  # and move them: a point p of node n moves by slide[n] + spin[n] × p
    distance: Array  # (M,) sigmas between measured and model
    jacobian: Array  # (M, d, u) of the markers, in sigmas
    by_point: Array  # (M, d, 3) the same by where the markers are
    predicted: Array  # (M, d) residual after the correction, in sigmas


@dataclass(frozen=True, eq=False)
class State:
    """Where the iteration ended."""

    settled: bool
    iterations: int
    theta: Array  # (u,)
    linear: Linear
    weight: Array  # (M,)
    factor: Array  # (u, u) factorᵀ · factor is the posterior covariance of theta
    information: Array  # (u, u) the markers' share of its inverse
    reason: str


def iterate(problem: Problem, strain: Array, theta: Array) -> State:
    """Gauss–Newton on loads and equilibrium at once: one Newton correction of the strains a step (eqs. 18 to 20).

    While the iteration runs a marker's pull is bounded (Huber; the scale is the median's, so that a wing far from its
    start is not taken for outliers). That cost has one minimum, so no start can lock the wrong markers in. Then each
    marker is in or out.
    """
    length = np.repeat(problem.half.beam.length_m, 4)
    decided: Array | None = None
    visited: list[tuple[float, Array, Array, Array]] = []
    rounds = 0
    reason = f"did not settle in {ITERATIONS} iterations"
    for iteration in range(1, ITERATIONS + 1):
        linear = linearise(problem, strain, theta)
        weight = _weight(problem, linear.distance) if decided is None else decided
        root = np.sqrt(weight)[:, None]
        A = (root[:, :, None] * linear.jacobian).reshape(-1, len(theta))
        if decided is None and problem.modes is None:
            A[:, len(problem.load_sigma) :] = 0.0  # stiffness is judged by markers that are believed
        information = A.T @ A
        normal = information + np.diag(problem.prior)
        try:
            factor = np.linalg.inv(np.linalg.cholesky(normal))
        except np.linalg.LinAlgError:
            reason = "the markers do not tell the loads apart (a singular problem)"
            break
        change = -factor.T @ (factor @ (A.T @ (root * linear.predicted).ravel() + problem.prior * theta))
        step = linear.correction + linear.response @ change
        turn = float(np.abs(step * length).max())
        if not np.isfinite(turn):
            reason = "diverged"
            break
        imbalance = float(np.abs(linear.correction * length).max())
        enough = _NEARLY_SIGMA if decided is None else _SETTLED_SIGMA
        if np.sqrt(change @ normal @ change) < enough and imbalance < _SETTLED_TURN_RAD:
            verdict = _verdict(problem, linear.distance)
            if decided is not None and (np.array_equal(verdict, weight) or rounds == _ROUNDS):
                return State(True, iteration, theta, linear, weight, factor, information, "")
            decided = verdict
            rounds += 1
        damping = min(1.0, _LARGEST_TURN_RAD / max(turn, 1e-300))
        if decided is None and iteration > _FULL_STEPS:
            damping *= 0.5  # gross outliers can make full steps go in circles
            if iteration == _LAST_UNDECIDED:
                _, strain, theta, decided = min(visited, key=lambda place: place[0])
                continue
            pull = float(np.minimum(linear.distance, _HUBER)[problem.seen].sum())
            visited.append((pull, strain, theta, _verdict(problem, linear.distance)))
        strain = strain + damping * step.reshape(-1, 4)
        theta = theta + damping * change
    return State(False, iteration, theta, linear, weight, information, information, reason)


def objection(problem: Problem, state: State) -> str:
    """Why a state is not the wing's shape; empty when it is."""
    if not state.settled:
        return state.reason
    agree, seen = int(np.sum(state.weight > 0)), int(problem.seen.sum())
    if agree < max(FEWEST_MARKERS, seen / 2):
        return f"only {agree} of {seen} markers agree on one shape of the wing"
    return ""


def linearise(problem: Problem, strain: Array, theta: Array) -> Linear:
    """The markers and the equilibrium, linear in the unknowns (eqs. 17, 18)."""
    half, beam = problem.half, problem.half.beam
    shape = shape_of(beam, strain)
    if problem.modes is not None:
        both = np.column_stack([problem.modes, np.zeros(4 * beam.elements)])
    else:
        both = _of_stations(problem, shape, theta)
    spin, slide = _node_motion(shape, both)
    node, point = half.marker_node, marker_points(half, shape)
    residual, by_point = problem.measure(point)
    motion = by_point @ (slide[node] + hat(point).transpose(0, 2, 1) @ spin[node])
    return Linear(
        shape=shape,
        correction=both[:, -1],
        response=both[:, :-1],
        spin=spin[:, :, :-1],
        slide=slide[:, :, :-1],
        distance=np.sqrt(np.sum(residual**2, axis=1)),
        jacobian=motion[:, :, :-1],
        by_point=by_point,
        predicted=residual + motion[:, :, -1],
    )


def marker_points(half: HalfWing, shape: Shape) -> Array:
    """(M, 3) where the markers of a wing of this shape are, body frame."""
    node = half.marker_node
    offset = (shape.R_body_section[node] @ half.marker_offset_m[:, :, None])[:, :, 0]
    points: Array = shape.position_m[node] + offset
    return points


def unit_forces(problem: Problem, shape: Shape) -> Array:
    """Generalised forces of a unit of each load component at the stations (eq. 17): (4N, 6k)."""
    nodes = problem.load_nodes
    reach = shape.position_m[nodes]
    moves = shape.slide[:, None, :] + cross(shape.spin[:, None, :], reach[None])
    both = np.concatenate([moves, np.broadcast_to(shape.spin[:, None, :], moves.shape)], axis=2)
    inboard = problem.half.beam.element_of[:, None] < nodes[None, :]
    return (both * inboard[:, :, None]).reshape(len(shape.spin), -1)


def stiffness_forces(half: HalfWing, strain: Array) -> Array:
    """By how much K·q grows with each stiffness's logarithm (eq. 26), one sigma: (4N, 4); couplings grow with both."""
    K, q = half.beam.stiffness * half.beam.length_m[:, None, None], strain
    pull = (K @ q[:, :, None])[:, :, 0]
    grows = (np.eye(4) * pull[:, :, None] + K * q[:, None, :]) / 2
    return (grows * half.stiffness_sigma).reshape(-1, 4)


def _of_stations(problem: Problem, shape: Shape, theta: Array) -> Array:
    """Strains (4N, u + 1) by the unknowns, and Newton's correction, with loads at the stations only."""
    half, beam, k = problem.half, problem.half.beam, len(problem.load_sigma)
    sigma = problem.load_sigma * problem.load_scale
    root = np.exp(np.clip(half.stiffness_sigma * theta[k:], -_LARGEST_LOG, _LARGEST_LOG) / 2)
    K = beam.stiffness_matrix * np.outer(np.tile(root, beam.elements), np.tile(root, beam.elements))
    Q, H = generalised_force_and_tangent(beam, shape, _loads(problem, sigma * theta[:k]))
    pull = K @ shape.strain.ravel()
    stiffer = (K * shape.strain.ravel()).reshape(-1, beam.elements, 4).sum(axis=1)
    stiffer = (stiffer + np.tile(np.eye(4), (beam.elements, 1)) * pull[:, None]) / 2 * half.stiffness_sigma
    columns = np.column_stack([unit_forces(problem, shape) * sigma, -stiffer, Q - pull])
    try:
        return np.linalg.solve(K - H, columns)
    except np.linalg.LinAlgError:
        return np.full_like(columns, np.nan)


def _scale(problem: Problem, distance: Array) -> float:
    return max(1.0, float(np.median(distance[problem.seen])) / _MEDIAN_DISTANCE)


def _weight(problem: Problem, distance: Array) -> Array:
    limit = _HUBER * _scale(problem, distance)
    return np.where(problem.seen, limit / np.maximum(distance, limit), 0.0)


def _verdict(problem: Problem, distance: Array) -> Array:
    believed = distance <= problem.outlier_sigma * _scale(problem, distance)
    return np.where(problem.seen & believed, 1.0, 0.0)


def _loads(problem: Problem, load: Array) -> Loads:
    force, moment = np.zeros((2, problem.half.beam.elements + 1, 3))
    per_station = load.reshape(-1, 6)
    force[problem.load_nodes], moment[problem.load_nodes] = per_station[:, :3], per_station[:, 3:]
    return Loads(force, moment)


def _node_motion(shape: Shape, response: Array) -> tuple[Array, Array]:
    """Spin and slide (N + 1, 3, m) of the nodes when the strains change by the columns of ``response`` (4N, m)."""
    n, m = len(shape.turn), response.shape[1]
    per_element = response.reshape(n, 4, m)
    out = np.zeros((2, n + 1, 3, m))
    for total, per_strain in zip(out, (shape.spin, shape.slide), strict=True):
        np.cumsum(per_strain.reshape(n, 4, 3).transpose(0, 2, 1) @ per_element, axis=0, out=total[1:])
    return out[0], out[1]
