"""Loads on a beam's nodes into generalised forces on its strains, with their exact derivative.

Equation numbers are those of docs/explanation/beam.md.
"""

from dataclasses import dataclass, replace

import numpy as np

from reconstruct.beam import Beam, Shape
from reconstruct.rotation import Array, Index, cross, hat, stumpff


@dataclass(frozen=True, eq=False)
class Loads:
    """Point loads. Dead ones keep their direction in the body frame, follower ones theirs in the section's."""

    force_n: Array  # (N + 1, 3) dead, body frame, on the axis
    moment_nm: Array  # (N + 1, 3) dead, body frame
    follower_force_n: Array | None = None  # (N + 1, 3) section frame
    follower_moment_nm: Array | None = None  # (N + 1, 3) section frame
    offset_force_n: Array | None = None  # (P, 3) dead, body frame, at points rigidly attached to nodes
    offset_node: Index | None = None  # (P,) int
    offset_m: Array | None = None  # (P, 3) from the node, section frame

    def scaled(self, factor: float) -> "Loads":
        """The same loads, each ``factor`` times as large."""

        def scale(value: Array | None) -> Array | None:
            return None if value is None else factor * value

        return replace(
            self,
            force_n=factor * self.force_n,
            moment_nm=factor * self.moment_nm,
            follower_force_n=scale(self.follower_force_n),
            follower_moment_nm=scale(self.follower_moment_nm),
            offset_force_n=scale(self.offset_force_n),
        )

    @property
    def conservative(self) -> bool:
        """Whether all loads are dead forces, so that the tangent is symmetric and rest a minimum of energy."""
        return not self.follows and not self.moment_nm.any()

    @property
    def follows(self) -> bool:
        """Whether any load turns with its section."""
        return self.follower_force_n is not None or self.follower_moment_nm is not None


def generalised_force(beam: Beam, shape: Shape, loads: Loads) -> Array:
    """Qⱼ, the work of the loads on a unit of strain j (eq. 8): (4N,)."""
    force, moment, _, _, _, _ = _outboard(shape, loads, need_dyad=False)
    e = beam.element_of
    Q: Array = np.sum(shape.slide * force[e] + shape.spin * moment[e], axis=1)
    return Q


def generalised_force_and_tangent(beam: Beam, shape: Shape, loads: Loads) -> tuple[Array, Array]:
    """Q (4N,) as above and ∂Qⱼ/∂qᵢ (4N, 4N; row j), exact (eqs. 9 to 14)."""
    force, moment, couple, dyad, follower, follower_couple = _outboard(shape, loads, need_dyad=True)
    e = beam.element_of
    spin, slide = shape.spin, shape.slide
    Q = np.sum(slide * force[e] + spin * moment[e], axis=1)
    turned = np.trace(dyad, axis1=1, axis2=2)[:, None, None] * np.eye(3) - dyad
    T = cross(slide, force[e]) - (turned[e] @ spin[:, :, None])[:, :, 0]
    potential = beam.inboard * (spin @ T.T)  # eq. 10
    tangent = potential + potential.T
    if couple.any():
        tangent += (beam.inboard * (spin @ cross(spin, couple[e]).T)).T  # eq. 11
    n = beam.elements
    index = np.arange(n)
    tangent.reshape(n, 4, n, 4)[index, :, index, :] += _own_block(beam, shape, force, moment, dyad)
    if loads.follows:
        tangent += _follower_tangent(beam, shape, follower, follower_couple)
    return Q, tangent


def _outboard(
    shape: Shape, loads: Loads, need_dyad: bool
) -> tuple[Array, Array, Array, Array, tuple[Array, Array] | None, Array | None]:
    """Sums over all nodes outboard of each element: (N, …) each, the first axis the element.

    Force; moment about the body origin; dead couples; Σ p Fᵀ; of the follower forces Σ F and Σ p Fᵀ; follower couples.
    """
    R, r = shape.R_body_section, shape.position_m
    force, couple = loads.force_n, loads.moment_nm
    follower = follower_couple = None
    if loads.follower_force_n is not None:
        turned = (R @ loads.follower_force_n[:, :, None])[:, :, 0]
        force = force + turned
        follower = (_beyond(turned), _beyond(r[:, :, None] * turned[:, None, :]))
    moment = cross(r, force) + couple
    if loads.follower_moment_nm is not None:
        turned = (R @ loads.follower_moment_nm[:, :, None])[:, :, 0]
        moment, couple = moment + turned, couple + turned
        follower_couple = _beyond(turned)
    dyad = r[:, :, None] * force[:, None, :] if need_dyad else np.zeros((len(r), 3, 3))
    if loads.offset_force_n is not None and loads.offset_node is not None and loads.offset_m is not None:
        at, pull = loads.offset_node, loads.offset_force_n
        point = r[at] + (R[at] @ loads.offset_m[:, :, None])[:, :, 0]
        force, moment, dyad = force.astype(r.dtype), moment.astype(r.dtype), dyad.astype(r.dtype)
        np.add.at(force, at, pull)
        np.add.at(moment, at, cross(point, pull))
        np.add.at(dyad, at, point[:, :, None] * pull[:, None, :])
    return _beyond(force), _beyond(moment), _beyond(couple), _beyond(dyad), follower, follower_couple


def _beyond(at_node: Array) -> Array:
    """For every element the sum over the nodes outboard of its start."""
    return np.cumsum(at_node[:0:-1], axis=0)[::-1]


def _own_block(beam: Beam, shape: Shape, force: Array, moment: Array, dyad: Array) -> Array:
    """∂Qⱼ/∂qᵢ for two strains of the same element (eq. 12): (N, 4, 4), row j."""
    w, length, e1 = shape.turn, beam.length_m[:, None, None], np.array([1.0, 0.0, 0.0])
    R, end = shape.R_start, shape.position_m[1:]
    to_local = R.transpose(0, 2, 1)
    f = (to_local @ force[:, :, None])[:, :, 0]
    tau = (to_local @ (moment - cross(end, force))[:, :, None])[:, :, 0]
    D = to_local @ (dyad - end[:, :, None] * force[:, None, :]) @ R

    _, c1, c2, c3, c4, c5, c6, c7 = stumpff(np.sum(w * w, axis=1))
    d1, d2, d3, d4, d5 = (
        (k * b - a) / 2 for k, a, b in ((1, c2, c3), (2, c3, c4), (3, c4, c5), (4, c5, c6), (5, c6, c7))
    )
    dd1, dd2, dd3 = (d3 - d2) / 2, (2 * d4 - d3) / 2, (3 * d5 - d4) / 2
    eye = np.eye(3)
    ww = w[:, :, None] * w[:, None, :]

    def dot(a: Array, b: Array) -> Array:
        product: Array = np.einsum("na,na->n", a, b)
        return product

    def dyadic(a: Array, b: Array) -> Array:
        return a[:, :, None] * b[:, None, :]

    def col(a: Array) -> Array:
        return a[:, None]

    # φ(w) = f·V(w)e1, its gradient and Hessian: the end's position against the force
    g = cross(e1, f)
    u = f * w[:, :1] + col(dot(f, w)) * e1
    gw, h = dot(g, w), dot(f, w) * w[:, 0]
    first = d1 * f[:, 0] + d2 * gw + d3 * h
    second = dd1 * f[:, 0] + dd2 * gw + dd3 * h
    gradient = 2 * col(first) * w + col(c2) * g + col(c3) * u
    mixed = dyadic(w, col(d2) * g + col(d3) * u)
    f_e1 = f[:, :, None] * e1
    hessian = 2 * first[:, None, None] * eye + 4 * second[:, None, None] * ww + 2 * (mixed + mixed.transpose(0, 2, 1))
    hessian = hessian + c3[:, None, None] * (f_e1 + f_e1.transpose(0, 2, 1))
    stretched = ((1 + shape.strain[:, 0]) * beam.length_m)[:, None, None]

    # τ·∂ᵢV eⱼ, indices [j, i]: the end's turn against the moment
    tw = dot(tau, w)
    V = c1[:, None, None] * eye + c2[:, None, None] * hat(w) + c3[:, None, None] * ww
    twist = 2 * dyadic(col(d1) * tau + col(d2) * cross(tau, w) + col(d3 * tw) * w, w)
    twist = twist + c2[:, None, None] * hat(tau) + c3[:, None, None] * (dyadic(w, tau) + tw[:, None, None] * eye)
    turned = D - np.trace(D, axis1=1, axis2=2)[:, None, None] * eye
    rotation = twist + V.transpose(0, 2, 1) @ turned @ V

    block = np.zeros((beam.elements, 4, 4), dtype=w.dtype)
    block[:, 1:, 1:] = hessian * stretched + rotation
    block[:, 0, 1:] = block[:, 1:, 0] = gradient
    return block * length * length


def _follower_tangent(
    beam: Beam, shape: Shape, follower: tuple[Array, Array] | None, follower_couple: Array | None
) -> Array:
    """What turning the follower loads with their sections adds to ∂Qⱼ/∂qᵢ (eqs. 13, 14)."""
    e, spin, slide = beam.element_of, shape.spin, shape.slide
    inner = np.zeros_like(spin)  # strain i at or inboard of j: spinᵢ · innerⱼ
    outer = np.zeros_like(spin)  # strain i outboard of j: spinⱼ · outerᵢ + slideⱼ · pushᵢ
    push = np.zeros_like(spin)
    if follower is not None:
        force, dyad = follower
        turned = np.trace(dyad, axis1=1, axis2=2)[:, None, None] * np.eye(3) - dyad
        inner += cross(force[e], slide) + (turned[e] @ spin[:, :, None])[:, :, 0]
        outer += (turned.transpose(0, 2, 1)[e] @ spin[:, :, None])[:, :, 0]
        push += cross(spin, force[e])
    if follower_couple is not None:
        inner += cross(follower_couple[e], spin)
        outer += cross(spin, follower_couple[e])
    outboard = beam.inboard  # row j inboard of column i
    return (1 - outboard) * (inner @ spin.T) + outboard * (spin @ outer.T + slide @ push.T)
