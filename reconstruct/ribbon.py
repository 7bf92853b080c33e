"""Axis and twist of a wing, and its markers → the strip between its fore and its aft markers, to draw.

The tables have no chord: where the markers sit on it is found from the markers themselves, as seen from the axis in the
sets shown (medians). The strip is for looking at; nothing is measured from it.
"""

from dataclasses import dataclass

import numpy as np

from reconstruct.result import SideResult
from reconstruct.tables import Floats

SETS_LOOKED_AT = 60


@dataclass(frozen=True)
class Ribbon:
    """One wing's strip over S stations and where its M markers are on it; of zero width where no pair was seen."""

    fore_m: Floats  # (S,) from the axis, forward
    aft_m: Floats  # (S,) from the axis, forward: negative
    incidence_rad: float  # of the strip, unloaded
    marker_s_m: Floats  # (M,) NaN: never seen
    marker_across: Floats  # (M,) 0 at the strip's fore edge, 1 at its aft edge

    def edges(self, sign: float, xyz_m: Floats, twist_deg: Floats) -> Floats:
        """(K, S, 2, 3) fore and aft edge of wings with the axis (K, S, 3) and the twist (K, S)."""
        forward = _turned(*_level(xyz_m, sign), np.radians(twist_deg) + self.incidence_rad)
        return xyz_m[..., None, :] + np.stack([self.fore_m, self.aft_m], axis=-1)[..., None] * forward[..., None, :]


def ribbon(name: str, side: SideResult) -> Ribbon:
    """The strip of a result's left or right wing."""
    along, forward, up = _markers_from_axis(side_sign(name), side)
    ids = side.sample.markers.marker
    fore, aft = ids % 2 == 0, ids % 2 == 1
    pairs = [(at, np.flatnonzero(ids == ids[at] + 1)) for at in np.flatnonzero(fore)]
    angles = [
        np.arctan2(up[at] - up[other[0]], forward[at] - forward[other[0]])
        for at, other in pairs
        if other.size and np.isfinite(forward[at] + forward[other[0]])
    ]
    incidence = float(np.median(angles)) if angles else 0.0
    across = forward * np.cos(incidence) + up * np.sin(incidence)
    s_m = side.s_m
    edges = [_edge(s_m, along[own], across[own]) if angles else np.zeros_like(s_m) for own in (fore, aft)]
    here = [np.interp(along, s_m, edge) for edge in edges]
    width = np.where(here[0] - here[1] > 0, here[0] - here[1], 1.0)
    return Ribbon(edges[0], edges[1], incidence, along, (here[0] - across) / width)


def side_sign(name: str) -> float:
    """+1 of the right wing, −1 of the left."""
    return 1.0 if name == "right" else -1.0


def _markers_from_axis(sign: float, side: SideResult) -> tuple[Floats, Floats, Floats]:
    """Station (M,), and offset forward and up from the axis with the twist taken off, of each marker: medians."""
    shape, xyz = side.sample.shape, side.sample.markers.xyz_m
    fitted = np.flatnonzero(np.isfinite(shape.xyz_m).all(axis=(1, 2)))
    rows = fitted[np.unique(np.linspace(0, max(fitted.size - 1, 0), SETS_LOOKED_AT).astype(int))] if fitted.size else []
    found = np.full((3, len(rows), xyz.shape[1]), np.nan)
    fine = np.linspace(0.0, shape.s_m[-1], 20 * shape.s_m.size)
    for number, row in enumerate(rows):
        axis = np.stack([np.interp(fine, shape.s_m, shape.xyz_m[row, :, k]) for k in range(3)], axis=-1)
        forward, up = _level(axis, sign)
        twist = np.radians(np.interp(fine, shape.s_m, shape.twist_deg[row]))
        forward, up = _turned(forward, up, twist), _turned(up, -forward, twist)
        away = xyz[row][:, None] - axis[None]  # (M, fine, 3)
        distance = np.linalg.norm(away, axis=-1)
        seen = np.flatnonzero(np.isfinite(distance).all(axis=1))
        foot = np.argmin(distance[seen], axis=1)
        offset = away[seen, foot]
        found[0, number, seen] = fine[foot]
        found[1, number, seen] = np.sum(offset * forward[foot], axis=-1)
        found[2, number, seen] = np.sum(offset * up[foot], axis=-1)
    return _median(found[0]), _median(found[1]), _median(found[2])


def _median(values: Floats) -> Floats:
    """(M,) over the first axis, NaN where nothing is known."""
    columns = [column[np.isfinite(column)] for column in values.T]
    return np.array([np.median(column) if column.size else np.nan for column in columns])


def _edge(s_m: Floats, along: Floats, across: Floats) -> Floats:
    """(S,) the markers' distance from the axis, interpolated along the span."""
    known = np.flatnonzero(np.isfinite(along + across))
    order = known[np.argsort(along[known])]
    return np.interp(s_m, along[order], across[order]) if order.size else np.zeros_like(s_m)


def _level(xyz_m: Floats, sign: float) -> tuple[Floats, Floats]:
    """Unit vectors (…, S, 3) across the axis (…, S, 3): level and forward, and up."""
    tangent = np.gradient(xyz_m, axis=-2)
    tangent = tangent / np.linalg.norm(tangent, axis=-1, keepdims=True)
    forward = tangent[..., :1] * tangent - np.array([1.0, 0.0, 0.0])
    forward = forward / np.linalg.norm(forward, axis=-1, keepdims=True)
    return forward, sign * np.cross(tangent, forward)


def _turned(one: Floats, other: Floats, angle_rad: Floats) -> Floats:
    return np.asarray(np.cos(angle_rad)[..., None] * one + np.sin(angle_rad)[..., None] * other)
