"""Net loads of a half wing, its masses' motion and the aircraft's acceleration → aerodynamic loads.

The fit finds the net of air, inertia and weight. Inertia and weight of a mass m at r (body frame) are

    −m (f + r̈ + ω̇ × r + ω × (ω × r) + 2 ω × ṙ),

f the specific force at the body frame's origin, as an accelerometer there reads it (at rest: g, upwards), ω the body's
rates. r̈ and ṙ come from the shapes themselves. What is left of the net loads when that is taken off is the air's.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from reconstruct.rotation import Array
from reconstruct.wing import HalfWing

STANDARD_GRAVITY_M_S2 = 9.80665
REACH_SETS = 4  # before and after, for the polynomial that is differentiated
DEGREE = 4
FEWEST = 7  # of the nine sets
_LONGEST_GAP = 1.5  # median steps; across a longer one nothing is differentiated


@dataclass(frozen=True, eq=False)
class Aerodynamic:
    """The air's loads on one half wing; NaN where a set was not fitted or has too few neighbours."""

    force_n: Array  # (F, 3) body frame
    moment_nm: Array  # (F, 3) about the wing's root, body axes
    sigma: Array  # (F, 6) one sigma of both


def aerodynamic(
    half: HalfWing,
    time_s: Array,
    position_m: Array,
    sigma_position_m: Array,
    net: Array,
    sigma_net: Array,
    specific_force_m_s2: Array,
    rates_rad_s: Array | None = None,
) -> Aerodynamic:
    """The air's loads at F sets.

    Args:
        half: the half wing, whose masses count; each moves with its node, its own arm from the axis turning with the
            unloaded wing's sections.
        time_s: (F,) growing.
        position_m: (F, N + 1, 3) nodes, body frame; NaN where not fitted.
        sigma_position_m: (F, N + 1, 3) their noise. It is taken to be alike along the span, which makes sigmas larger.
        net: (F, 6) net force (N) and moment (N·m) about the root.
        sigma_net: (F, 6) one sigma.
        specific_force_m_s2: (F, 3) at the body frame's origin, body axes; NaN where not recorded.
        rates_rad_s: (F, 3) of the body, body axes; None: does not turn.
    """
    mass, nodes = half.mass_kg, half.mass_node
    arm = (half.beam.rest.R_body_section[nodes] @ half.mass_offset_m[:, :, None])[:, :, 0]
    place = position_m[:, nodes] + arm
    by_velocity, by_acceleration = _derivative_weights(time_s, np.asarray(np.isfinite(position_m).all(axis=(1, 2))))
    velocity, acceleration = (_apply(weights, place) for weights in (by_velocity, by_acceleration))
    total = specific_force_m_s2[:, None, :] + acceleration
    if rates_rad_s is not None:
        w, turning = rates_rad_s[:, None, :], _apply(by_velocity, rates_rad_s)[:, None, :]
        total = total + np.cross(turning, place) + np.cross(w, np.cross(w, place)) + 2 * np.cross(w, velocity)
    each = -mass[:, None] * total
    inertia = np.concatenate([each.sum(axis=1), np.cross(place - half.rest_position_m[0], each).sum(axis=1)], axis=1)
    spread = np.sqrt(np.sum(by_acceleration.weights**2, axis=1))[:, None, None] * sigma_position_m[:, nodes]
    of_force = (mass[:, None] * spread).sum(axis=1)
    reach = np.linalg.norm(place - half.rest_position_m[0], axis=2)[:, :, None]
    of_moment = (mass[:, None] * reach * np.linalg.norm(spread, axis=2)[:, :, None]).sum(axis=1).repeat(3, axis=1)
    sigma = np.hypot(sigma_net, np.concatenate([of_force, of_moment], axis=1))
    air = net - inertia
    sigma[~np.isfinite(air)] = np.nan
    return Aerodynamic(air[:, :3], air[:, 3:], sigma)


def upwards(load_factor: Array) -> Array:
    """Specific force (F, 3) of a load factor (F,) in g, positive upwards, and nothing along the other axes."""
    force = np.zeros((len(load_factor), 3))
    force[:, 2] = STANDARD_GRAVITY_M_S2 * load_factor
    return force


@dataclass(frozen=True, eq=False)
class _Weights:
    near: npt.NDArray[np.intp]  # (F, K) sets
    weights: Array  # (F, K); NaN where there are too few


def _derivative_weights(time_s: Array, known: npt.NDArray[np.bool_]) -> tuple[_Weights, _Weights]:
    """First and second derivative of the polynomial of degree four through up to nine sets, by least squares."""
    count = len(time_s)
    offsets = np.arange(-REACH_SETS, REACH_SETS + 1)
    near = np.arange(count)[:, None] + offsets
    inside = (near >= 0) & (near < count)
    near = np.clip(near, 0, count - 1)
    step = float(np.median(np.diff(time_s))) if count > 1 else 1.0
    since = (time_s[near] - time_s[:, None]) / step
    usable = inside & known[near] & (np.abs(since) <= _LONGEST_GAP * REACH_SETS)
    powers = since[:, :, None] ** np.arange(DEGREE + 1) * usable[:, :, None]
    enough = usable.sum(axis=1) >= FEWEST
    normal = powers.transpose(0, 2, 1) @ powers
    normal[~enough] = np.eye(DEGREE + 1)
    solved = np.linalg.solve(normal, powers.transpose(0, 2, 1))
    solved[~enough] = np.nan
    return _Weights(near, solved[:, 1] / step), _Weights(near, 2 * solved[:, 2] / step**2)


def _apply(derivative: _Weights, values: Array) -> Array:
    """Derivative of ``values`` (F, …) in time; what has no weight may be NaN."""
    out = np.zeros(values.shape)
    for k in range(derivative.near.shape[1]):
        weight = derivative.weights[:, k].reshape(-1, *[1] * (values.ndim - 1))
        there = values[derivative.near[:, k]]
        out += weight * np.where(np.isfinite(there) | (weight != 0), there, 0.0)
    return out
