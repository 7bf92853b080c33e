"""A beam and its loads into the strains at rest: damped Newton, and load stepping only where Newton does not do.

Equation numbers are those of docs/explanation/beam.md.
"""

from dataclasses import dataclass

import numpy as np

from reconstruct.beam import Beam, Shape, shape_of
from reconstruct.loads import Loads, generalised_force, generalised_force_and_tangent
from reconstruct.rotation import Array

_CONVERGED = 1e-10  # change of an element's turn (rad) and stretch in the last Newton step
_LARGEST_TURN_RAD = 1.5  # of any node in one step
_NEAR_RAD = 0.05  # a step that turns no node more than this may go where the tangent is not positive
_ITERATIONS = 60
_HALVINGS = 12
_LARGEST_SHIFT = 1e4  # of the stiffness
_SMALLEST_LOAD_STEP = 1 / 4096
_SMALLEST_STABLE_STEP = 1 / 128  # of the load, taken once more before a beam is believed to have become unstable


@dataclass(frozen=True, eq=False)
class Equilibrium:
    """A static solution. When not converged, shape and residual are NaN and ``reason`` says why."""

    converged: bool
    shape: Shape
    iterations: int  # Newton steps, all load steps together
    load_steps: int  # 1: the full load at once
    stable: bool  # the tangent's symmetric part is positive definite
    residual: float  # energy norm of K q − Q against that of Q
    reason: str


def solve(beam: Beam, loads: Loads, start: Array | None = None) -> Equilibrium:
    """K·q = Q(q) (eqs. 7 and 15).

    Args:
        beam: the structure.
        loads: what acts on it.
        start: (N, 4) strains to begin from; the unstrained beam when None.

    Newton starts with the full load. If that does not converge, or ends where a beam under dead forces would not stay
    (several equilibria exist under large loads), the load is raised in steps from the unstrained beam instead, which
    follows the path a real wing takes.
    """
    begin = np.zeros((beam.elements, 4)) if start is None else start
    direct = _newton(beam, loads, begin)
    if direct.converged and (direct.stable or not loads.conservative):
        return direct
    stepped = _in_load_steps(beam, loads, direct.iterations)
    return stepped if stepped.converged or not direct.converged else direct


def _in_load_steps(beam: Beam, loads: Loads, iterations: int) -> Equilibrium:
    strain = np.zeros((beam.elements, 4))
    before, before_level = strain, 0.0
    level, increment, steps, stable = 0.0, 0.25, 0, True
    while True:
        target = min(1.0, level + increment)
        rate = (target - level) / (level - before_level) if level > before_level else 0.0
        found = _newton(beam, loads.scaled(target), strain + min(rate, 1.0) * (strain - before))
        iterations += found.iterations
        # an unstable answer next to a stable one is another branch, unless small steps lead there too
        jumped = loads.conservative and stable and not found.stable and increment > _SMALLEST_STABLE_STEP
        if found.converged and not jumped:
            steps += 1
            stable = found.stable
            before, before_level = strain, level
            strain, level = found.shape.strain, target
            increment *= 1.5 if found.iterations <= 8 else 1.0
            if level >= 1.0:
                return Equilibrium(True, found.shape, iterations, steps, found.stable, found.residual, "")
        else:
            increment /= 2
            if increment < _SMALLEST_LOAD_STEP:
                reason = f"no equilibrium found beyond {100 * level:.1f} % of the load"
                return _failed(beam, iterations, steps, reason)


def _newton(beam: Beam, loads: Loads, strain: Array) -> Equilibrium:
    K, compliance = beam.stiffness_matrix, np.linalg.inv(beam.stiffness)
    length = beam.length_m[:, None]

    def norm(generalised: Array) -> float:
        per_element = generalised.reshape(-1, 4)
        return float(np.sqrt(np.einsum("ni,nij,nj,n->", per_element, compliance, per_element, 1 / beam.length_m)))

    shape = shape_of(beam, strain)
    Q, H = generalised_force_and_tangent(beam, shape, loads)
    residual = norm(K @ strain.ravel() - Q)
    for iteration in range(1, _ITERATIONS + 1):
        step = _step(K, H, K @ shape.strain.ravel() - Q, length, loads.conservative)
        if step is None:
            return _failed(beam, iteration, 1, "the loads are not finite, or the tangent is singular")
        largest = float(np.abs(step * length).max())
        turn = _largest_turn(step, length)
        factor = min(1.0, _LARGEST_TURN_RAD / max(turn, 1e-300))
        for _ in range(_HALVINGS):
            trial = shape_of(beam, shape.strain + factor * step)
            trial_residual = norm(K @ trial.strain.ravel() - generalised_force(beam, trial, loads))
            # far from the solution the residual may pass over a hump: only a clear rise shortens the step
            if trial_residual <= 2 * residual or largest < 1e-6:
                break
            factor /= 2
        shape, residual = trial, trial_residual
        Q, H = generalised_force_and_tangent(beam, shape, loads)
        if factor == 1.0 and largest < _CONVERGED:
            relative = residual / max(norm(Q), norm(K @ shape.strain.ravel()), 1e-300)
            return Equilibrium(True, shape, iteration, 1, _positive(K - H), relative if residual > 0 else 0.0, "")
    return _failed(beam, _ITERATIONS, 1, f"Newton's method did not settle in {_ITERATIONS} steps")


def _step(K: Array, H: Array, excess: Array, length: Array, conservative: bool) -> Array | None:
    """Newton's step (N, 4); far from an energy minimum with as much more stiffness as makes the tangent positive."""
    tangent = K - H
    if not (np.isfinite(tangent).all() and np.isfinite(excess).all()):
        return None
    shift = 0.0
    while True:
        try:
            step: Array = -np.linalg.solve(tangent + shift * K, excess).astype(np.float64).reshape(-1, 4)
        except np.linalg.LinAlgError:
            return None
        if (
            not conservative
            or _largest_turn(step, length) < _NEAR_RAD
            or shift > _LARGEST_SHIFT
            or _positive(tangent + shift * K)
        ):
            return step
        shift = max(0.25, 2 * shift)


def _largest_turn(step: Array, length: Array) -> float:
    """By how much the step turns any node, about (rad)."""
    return float(np.abs(np.cumsum(step[:, 1:] * length, axis=0)).max())


def _positive(tangent: Array) -> bool:
    try:
        np.linalg.cholesky((tangent + tangent.T) / 2)
    except np.linalg.LinAlgError:
        return False
    return True


def _failed(beam: Beam, iterations: int, steps: int, reason: str) -> Equilibrium:
    nowhere = shape_of(beam, np.full((beam.elements, 4), np.nan))
    return Equilibrium(False, nowhere, iterations, steps, False, float("nan"), reason)
