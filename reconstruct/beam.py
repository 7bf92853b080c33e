"""Strains into the shape of a very flexible beam, and loads on that shape into generalised forces and their tangent.

The strain-based beam of Su & Cesnik: in every element extension and the three curvatures (twist, out-of-plane,
in-plane bending) are constant, so that an element is one exact screw motion. Equation numbers are those of
docs/explanation/beam.md. Arrays in, arrays out; nothing here knows of wings or files.

Source: W. Su and C. E. S. Cesnik, "Strain-based geometrically nonlinear beam formulation for modeling very flexible
aircraft", International Journal of Solids and Structures 48 (2011), doi:10.1016/j.ijsolstr.2011.04.012.
"""

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from reconstruct.rotation import Array, cross, hat, stumpff

_E1 = np.array([1.0, 0.0, 0.0])


@dataclass(frozen=True, eq=False)
class Beam:
    """A cantilever of N elements. Strain order: extension, twist, out-of-plane (e2), in-plane (e3) bending."""

    length_m: Array  # (N,)
    stiffness: Array  # (N, 4, 4) N, N·m, N·m²
    curvature_1pm: Array  # (N, 3) built-in, about e1, e2, e3
    joint: Array  # (N, 3, 3) turn before each element, from the frame its inboard neighbour ends in
    root_m: Array  # (3,) body frame
    R_body_root: Array  # (3, 3)

    @property
    def elements(self) -> int:
        """N."""
        return len(self.length_m)

    @cached_property
    def stiffness_matrix(self) -> Array:
        """(4N, 4N): the strain energy is ½ qᵀ·this·q (eq. 7)."""
        n = self.elements
        out = np.zeros((n, 4, n, 4))
        index = np.arange(n)
        out[index, :, index, :] = self.stiffness * self.length_m[:, None, None]
        return out.reshape(4 * n, 4 * n)

    @cached_property
    def element_of(self) -> Array:
        """(4N,) the element each strain belongs to."""
        return np.repeat(np.arange(self.elements), 4)

    @cached_property
    def inboard(self) -> Array:
        """(4N, 4N) 1 where the row's element lies strictly inboard of the column's."""
        return (self.element_of[:, None] < self.element_of[None, :]).astype(float)

    @cached_property
    def rest(self) -> "Shape":
        """The unstrained shape."""
        return shape_of(self, np.zeros((self.elements, 4)))


@dataclass(frozen=True, eq=False)
class Shape:
    """A strained beam, body frame. A strain j moves a point p outboard of it by slide[j] + spin[j] × p.

    Of several strained beams every field has their axes in front.
    """

    strain: Array  # (N, 4)
    position_m: Array  # (N + 1, 3) nodes
    R_body_section: Array  # (N + 1, 3, 3) at the nodes; at a joint the inboard side's
    R_start: Array  # (N, 3, 3) frame each element starts in, outboard of its joint
    turn: Array  # (N, 3) rotation vector of each element
    spin: Array  # (4N, 3)
    slide: Array  # (4N, 3)

    def __getitem__(self, at: int) -> "Shape":
        """One of several."""
        return Shape(*(getattr(self, member.name)[at] for member in fields(self)))


def shape_of(beam: Beam, strain: Array) -> Shape:
    """The shape of a beam with ``strain`` (…, N, 4): eqs. 1 to 6, exact for any strain."""
    length = beam.length_m
    w = (beam.curvature_1pm + strain[..., 1:]) * length[:, None]
    stretched = (1 + strain[..., 0]) * length
    c0, c1, c2, c3, c4, c5, _, _ = (c[..., None, None] for c in stumpff(np.sum(w * w, axis=-1)))
    W, outer, eye = hat(w), w[..., :, None] * w[..., None, :], np.eye(3)
    V = c1 * eye + c2 * W + c3 * outer  # the left Jacobian of the turn
    several, n = w.shape[:-2], len(length)
    frame = np.zeros((*several, n + 1, 4, 4), dtype=w.dtype)
    frame[..., 0, :3, :3], frame[..., 0, :3, 3] = beam.R_body_root, beam.root_m
    frame[..., 1:, :3, :3] = beam.joint @ (c0 * eye + c1 * W + c2 * outer)
    frame[..., 1:, :3, 3] = (beam.joint @ V[..., :1])[..., 0] * stretched[..., None]
    frame[..., 3, 3] = 1
    _multiply_outboard(frame)
    R, r = frame[..., :3, :3], frame[..., :3, 3]
    R_start = R[..., :-1, :, :] @ beam.joint

    # Columns: how the element's end moves (eq. 5) and turns (eq. 4) with its own four strains, in its starting frame.
    d1, d2, d3 = (c3 - c2) / 2, (2 * c4 - c3) / 2, (3 * c5 - c4) / 2  # derivatives of c1, c2, c3 by |w|²
    along = d1 * _E1[:, None] + d2 * W[..., :1] + d3 * outer[..., :1]
    bend = 2 * along * w[..., None, :] + c2 * _E1_CROSS + c3 * (eye * w[..., :1, None] + w[..., :, None] * _E1)
    own = np.zeros((*several, n, 3, 8), dtype=w.dtype)
    own[..., 1:4] = V * length[:, None, None]
    own[..., 4:5] = V[..., :1] * length[:, None, None]
    own[..., 5:] = bend * (stretched * length)[..., None, None]
    moved = np.swapaxes(R_start @ own, -1, -2)
    spin = moved[..., :4, :]
    slide = moved[..., 4:, :] - cross(spin, r[..., 1:, None, :])
    return Shape(strain, r, R, R_start, w, spin.reshape(*several, -1, 3), slide.reshape(*several, -1, 3))


# ∂(w × e1)/∂w: column j is e_j × e1
_E1_CROSS = -hat(_E1)


def _multiply_outboard(frame: Array) -> None:
    """Each of ``frame`` (…, n, 4, 4) into the product of all up to it, by doubling: log₂ n batched steps, no loop."""
    reach = 1
    while reach < frame.shape[-3]:
        frame[..., reach:, :, :] = frame[..., :-reach, :, :] @ frame[..., reach:, :, :]
        reach *= 2
