"""What was measured of a half wing, and what is believed of its loads, into the strains that agree with both.

The Gauss–Newton iteration under the fit, many instants at a time. Equation numbers are those of
docs/explanation/beam.md.
"""

from dataclasses import dataclass, fields, replace
from typing import Protocol

import numpy as np

from reconstruct.beam import Shape, shape_of
from reconstruct.loads import Loads, generalised_force_and_tangent
from reconstruct.rotation import Array, Index, Mask, Words, cross, hat
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


class Measure(Protocol):
    """How far markers are from those measured, at one instant or at F."""

    def __call__(self, point: Array) -> tuple[Array, Array]:
        """Of places (…, M, 3): model minus measured in sigmas (…, M, d), its derivative (…, M, d, 3); 0 if not seen."""

    def __getitem__(self, rows: Index) -> "Measure":
        """Some of the F instants."""


@dataclass(frozen=True, eq=False)
class Problem:
    """One instant of one half wing, or F (then F is the first axis). Unknowns are in units of their prior sigma."""

    half: HalfWing
    load_nodes: Index
    modes: Array | None  # (4N, m) strains of a unit of each unknown where loads act at every node
    load_sigma: Array  # (6k,) prior at the stations: the unknowns, where loads act only there, are in units of it
    load_scale: Array  # (6k,) what the data made of it, sigmas
    prior: Array  # (u,) 1, or 0 for an unknown that has none
    measure: Measure
    seen: Mask  # (…, M) bool
    coordinates: Array  # (…, M) numbers measured of each marker
    outlier_sigma: float
    shared: Array | None = None  # (…, M, 3, P) how unit errors that all markers share move them; P unknowns more

    @property
    def unknowns(self) -> int:
        """u: the modes and the shared errors, or the loads at the stations and the stiffness's four logarithms."""
        return len(self.prior)

    def __getitem__(self, rows: Index | slice) -> "Problem":
        """Some of the F instants."""
        rows = np.arange(len(self.seen))[rows]
        shared = None if self.shared is None else self.shared[rows]
        seen, coordinates = self.seen[rows], self.coordinates[rows]
        return replace(self, measure=self.measure[rows], seen=seen, coordinates=coordinates, shared=shared)


@dataclass(frozen=True, eq=False)
class Linear:
    """The problem linearised at some strains and unknowns, at one instant or at F."""

    shape: Shape
    correction: Array  # (…, 4N) what Newton would add to the strains under the present loads,
    response: Array  # (…, 4N, u) and under a unit more of each unknown; (4N, u) where that is the same everywhere
    distance: Array  # (…, M) sigmas between measured and model
    jacobian: Array  # (…, M, d, u) of the markers, in sigmas
    by_point: Array  # (…, M, d, 3) the same by where the markers are
    predicted: Array  # (…, M, d) residual after the correction, in sigmas


@dataclass(frozen=True, eq=False)
class Ends:
    """Where the iteration of F instants ended."""

    settled: Mask  # (F,)
    iterations: Index  # (F,)
    strain: Array  # (F, N, 4)
    theta: Array  # (F, u)
    weight: Array  # (F, M)
    reason: Words  # (F,) str, why it did not settle

    def __getitem__(self, rows: Index) -> "Ends":
        """Some of the instants."""
        return Ends(*(getattr(self, member.name)[rows] for member in fields(self)))


@dataclass(frozen=True, eq=False)
class _Search:
    """What F instants remember on their way."""

    decided: Mask  # (F,) whether each marker is in or out
    rounds: Index  # (F,) changes of that
    pull: Array  # (F,) the least that undecided markers came to,
    strain: Array  # (F, N, 4) where that was,
    theta: Array  # (F, u)
    verdict: Array  # (F, M) and which markers would have been in there


def iterate(problem: Problem, strain: Array, theta: Array) -> Ends:
    """Gauss–Newton on loads and equilibrium at once: one Newton correction of the strains a step (eqs. 18 to 20).

    ``problem`` has F instants, each with its own strains (F, N, 4) and unknowns (F, u) to begin from. They go the same
    way together, and none has a part in another's.

    While the iteration runs a marker's pull is bounded (Huber; the scale is the median's, so that a wing far from its
    start is not taken for outliers). That cost has one minimum, so no start can lock the wrong markers in. Then each
    marker is in or out.
    """
    count, strain, theta = len(theta), strain.copy(), theta.copy()
    weight = np.zeros(problem.seen.shape)
    reason = np.full(count, f"did not settle in {ITERATIONS} iterations", dtype=object)
    ends = Ends(np.zeros(count, bool), np.zeros(count, int), strain, theta, weight, reason)
    nearest = strain.copy(), theta.copy(), weight.copy()
    search = _Search(np.zeros(count, bool), np.zeros(count, int), np.full(count, np.inf), *nearest)
    live = np.arange(count)
    for iteration in range(1, ITERATIONS + 1):
        if not live.size:
            break
        live = live[_advance(problem if live.size == count else problem[live], ends, search, live, iteration)]
    return ends


def _advance(problem: Problem, ends: Ends, search: _Search, live: Index, iteration: int) -> Mask:
    """One iteration of the instants ``live``, which ``problem`` is of; returns which of them are to go on."""
    strain, theta, undecided = ends.strain[live], ends.theta[live], ~search.decided[live]
    at_rest = not (strain.any() or theta.any())  # where all begin, it is the same for all
    linear = linearise(problem, strain[:1], theta[:1]) if at_rest else linearise(problem, strain, theta)
    usual = _usual(problem, linear.distance)
    limit = _HUBER * usual
    huber = np.where(problem.seen, limit / np.maximum(linear.distance, limit), 0.0)
    verdict = np.where(problem.seen & (linear.distance <= problem.outlier_sigma * usual), 1.0, 0.0)
    weight = np.where(undecided[:, None], huber, ends.weight[live])
    change, size, regular = _gauss_newton(problem, linear, theta, weight, undecided)
    step = (linear.correction + (linear.response @ change[:, :, None])[:, :, 0]).reshape(strain.shape)
    length = problem.half.beam.length_m[:, None]
    turn = np.abs(step * length).max(axis=(1, 2))
    imbalance = np.abs(linear.correction.reshape(-1, *strain.shape[1:]) * length).max(axis=(1, 2))
    ends.iterations[live], ends.weight[live] = iteration, weight
    ends.reason[live[~regular]] = "the markers do not tell the loads apart (a singular problem)"
    ends.reason[live[regular & ~np.isfinite(turn)]] = "diverged"
    sound = regular & np.isfinite(turn)

    near = sound & (size < np.where(undecided, _NEARLY_SIGMA, _SETTLED_SIGMA)) & (imbalance < _SETTLED_TURN_RAD)
    final = (verdict == weight).all(axis=1) | (search.rounds[live] == _ROUNDS)
    settled = near & ~undecided & final
    judged = near & ~settled
    ends.settled[live[settled]], ends.reason[live[settled]] = True, ""
    _decide(ends, search, live[judged], verdict[judged])
    search.rounds[live[judged]] += 1

    damping = np.minimum(1.0, _LARGEST_TURN_RAD / np.maximum(turn, 1e-300))
    moving = sound & ~settled
    if iteration > _FULL_STEPS:  # gross outliers can make full steps go in circles
        astray = moving & undecided & ~judged
        damping[astray] *= 0.5
        if iteration == _LAST_UNDECIDED:
            back = live[astray]
            ends.strain[back], ends.theta[back] = search.strain[back], search.theta[back]
            _decide(ends, search, back, search.verdict[back])
            moving &= ~astray
        else:
            pull = np.where(problem.seen, np.minimum(linear.distance, _HUBER), 0.0).sum(axis=1)
            better = astray & (pull < search.pull[live])
            at = live[better]
            search.pull[at], search.verdict[at] = pull[better], verdict[better]
            search.strain[at], search.theta[at] = strain[better], theta[better]
    ends.strain[live[moving]] += damping[moving, None, None] * step[moving]
    ends.theta[live[moving]] += damping[moving, None] * change[moving]
    return np.asarray(sound & ~settled)


def _decide(ends: Ends, search: _Search, at: Index, verdict: Array) -> None:
    ends.weight[at], search.decided[at] = verdict, True


def _gauss_newton(
    problem: Problem, linear: Linear, theta: Array, weight: Array, undecided: Mask
) -> tuple[Array, Array, Mask]:
    """The step of the unknowns (F, u), its length in posterior sigmas (F,), and whether the markers determine it."""
    root = np.sqrt(weight)[:, :, None]
    A = (root[..., None] * linear.jacobian).reshape(len(theta), -1, problem.unknowns)
    if problem.modes is None:
        A[undecided, :, len(problem.load_sigma) :] = 0.0  # stiffness is judged by markers that are believed
    transposed = A.transpose(0, 2, 1)
    normal = transposed @ A + np.diag(problem.prior)
    slope = (transposed @ (root * linear.predicted).reshape(len(theta), -1, 1))[:, :, 0] + problem.prior * theta
    regular = _positive(normal)
    normal[~regular] = np.eye(problem.unknowns)
    change: Array = -np.linalg.solve(normal, slope[:, :, None])[:, :, 0].astype(np.float64, copy=False)
    size: Array = np.sqrt(np.maximum(0.0, -np.sum(change * slope, axis=1)))
    return change, size, regular


def _positive(matrix: Array) -> Mask:
    """(F,) which of the matrices (F, u, u) are positive definite."""
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        if len(matrix) == 1:
            return np.zeros(1, dtype=bool)
        return np.concatenate([_positive(one[None]) for one in matrix])
    return np.ones(len(matrix), dtype=bool)


def objections(problem: Problem, ends: Ends) -> Words:
    """(F,) why an instant's end is not the wing's shape; empty when it is."""
    agree, seen = np.sum(ends.weight > 0, axis=1), problem.seen.sum(axis=1)
    against = ends.reason.copy()
    for at in np.flatnonzero(ends.settled & (agree < np.maximum(FEWEST_MARKERS, seen / 2))):
        against[at] = f"only {agree[at]} of {seen[at]} markers agree on one shape of the wing"
    return against


def linearise(problem: Problem, strain: Array, theta: Array) -> Linear:
    """The markers and the equilibrium, linear in the unknowns, at strains (…, N, 4), unknowns (…, u) (eqs. 17, 18)."""
    half, beam, u = problem.half, problem.half.beam, problem.unknowns
    shape = shape_of(beam, strain)
    if problem.modes is not None:
        both = problem.modes
    elif theta.ndim == 1:
        both = _of_stations(problem, shape, theta)
    else:
        both = np.stack([_of_stations(problem, shape[at], one) for at, one in enumerate(theta)])
    point = marker_points(half, shape)
    residual, by_point = problem.measure(point)
    nodes, which = half.marked_nodes
    by_motion = np.concatenate([-by_point @ hat(point), by_point], axis=-1)
    motion = by_motion @ node_motion(shape, both, nodes)[..., which, :, :]
    if problem.shared is not None:
        by_shared = by_point @ problem.shared
        residual = residual + (by_shared @ theta[..., None, both.shape[-1] :, None])[..., 0]
        motion = np.concatenate([motion, by_shared], axis=-1)
        both = np.pad(both, ((0, 0), (0, by_shared.shape[-1])))
    corrects = problem.modes is None  # loads everywhere are in equilibrium with any strains
    return Linear(
        shape=shape,
        correction=both[..., u] if corrects else np.zeros((*theta.shape[:-1], 4 * beam.elements)),
        response=both[..., :u],
        distance=np.sqrt(np.sum(residual**2, axis=-1)),
        jacobian=motion[..., :u],
        by_point=by_point,
        predicted=residual + motion[..., u] if corrects else residual,
    )


def node_motion(shape: Shape, response: Array, nodes: Index) -> Array:
    """Spin and slide (…, n, 6, m) of ascending ``nodes`` when the strains change by columns of ``response`` (…, 4N, m).

    A point p of a node moves by slide + spin × p.
    """
    by_strain = np.swapaxes(np.concatenate([shape.spin, shape.slide], axis=-1), -1, -2)
    several = np.broadcast_shapes(by_strain.shape[:-2], response.shape[:-2])
    out = np.empty((*several, len(nodes), 6, response.shape[-1]))
    total, before = np.zeros((*several, 6, response.shape[-1])), 0
    for at, node in enumerate(nodes):
        between = slice(4 * before, 4 * node)
        total += by_strain[..., between] @ response[..., between, :]
        out[..., at, :, :], before = total, node
    return out


def marker_points(half: HalfWing, shape: Shape) -> Array:
    """(…, M, 3) where the markers of a wing of this shape are, body frame."""
    node = half.marker_node
    offset = (shape.R_body_section[..., node, :, :] @ half.marker_offset_m[:, :, None])[..., 0]
    points: Array = shape.position_m[..., node, :] + offset
    return points


def unit_forces(problem: Problem, shape: Shape) -> Array:
    """Generalised forces of a unit of each load component at the stations (eq. 17): (…, 4N, 6k)."""
    nodes = problem.load_nodes
    spin = shape.spin[..., :, None, :]
    moves = shape.slide[..., :, None, :] + cross(spin, shape.position_m[..., None, nodes, :])
    both = np.concatenate([moves, np.broadcast_to(spin, moves.shape)], axis=-1)
    inboard = problem.half.beam.element_of[:, None] < nodes[None, :]
    return (both * inboard[:, :, None]).reshape(*shape.spin.shape[:-1], -1)


def stiffness_forces(half: HalfWing, strain: Array) -> Array:
    """By how much K·q grows with each stiffness's logarithm (eq. 26), one sigma: (…, 4N, 4).

    Couplings grow with both.
    """
    K, q = half.beam.stiffness * half.beam.length_m[:, None, None], strain
    pull = (K @ q[..., None])[..., 0]
    grows = (np.eye(4) * pull[..., None] + K * q[..., None, :]) / 2
    return (grows * half.stiffness_sigma).reshape(*q.shape[:-2], -1, 4)


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


def _usual(problem: Problem, distance: Array) -> Array:
    """(F, 1) how much farther markers are than their sigmas say, by the median of those seen."""
    ordered = np.sort(np.where(problem.seen, distance, np.inf), axis=1)
    count = problem.seen.sum(axis=1, keepdims=True)
    middle = np.concatenate([(count - 1) // 2, count // 2], axis=1)
    median = np.take_along_axis(ordered, middle, axis=1).mean(axis=1, keepdims=True)
    return np.asarray(np.maximum(1.0, median / _MEDIAN_DISTANCE))


def _loads(problem: Problem, load: Array) -> Loads:
    force, moment = np.zeros((2, problem.half.beam.elements + 1, 3))
    per_station = load.reshape(-1, 6)
    force[problem.load_nodes], moment[problem.load_nodes] = per_station[:, :3], per_station[:, 3:]
    return Loads(force, moment)
