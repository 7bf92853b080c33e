"""wing.toml into the two half wings the solver works on: beams, markers, masses and what the fit may assume.

A wing file describes the right half; the left one is its mirror image. Frames, signs and the meaning of incidence are
in docs/ARCHITECTURE.md; the file's keys are in docs/reference/wing-file.md.
"""

import itertools
import math
import tomllib
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import ValidationError

from capture.errors import UsageError
from reconstruct.beam import Beam
from reconstruct.rotation import Array, Index, about_axis, cross
from reconstruct.wing_file import FitSettings, SegmentSection, WingFile, first_error

__all__ = [
    "FitSettings",
    "HalfWing",
    "Wing",
    "example_path",
    "read_wing",
    "read_wing_file",
    "twist_gradient",
    "twist_rad",
]

Side = Literal["left", "right"]
_R_SIDE = {
    "right": np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),  # e1 = +y, e2 = −x, e3 = +z
    "left": np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),  # e1 = −y, e2 = +x, e3 = +z
}
_MIRROR = np.array([1.0, -1.0, 1.0, -1.0])  # (extension, twist, out-of-plane, in-plane) seen in a mirror
_SAME_STATION_M = 1e-9


@dataclass(frozen=True, eq=False)
class HalfWing:
    """One half wing, unloaded. Node i ends element i − 1; at a joint its frame is that of the inboard side."""

    side: Side
    beam: Beam
    node_s_m: Array  # (N + 1,) arc length from the root
    marker_ids: Index  # (M,) int: 2 · pair + (0 fore, 1 aft), pair 0 innermost
    marker_s_m: Array  # (M,)
    marker_node: Index  # (M,) int: the node at the marker's station
    marker_offset_m: Array  # (M, 3) in the section frame
    mass_kg: Array  # (P,) lumped: the structure's and what is mounted on it
    mass_node: Index  # (P,) int
    mass_offset_m: Array  # (P, 3) in the section frame
    stiffness_sigma: Array  # (4,) relative: EA, GJ, EI_out, EI_in

    @property
    def sign(self) -> float:
        """+1 on the right wing, −1 on the left: the sense of nose-up about e1, and of e2 as forward."""
        return 1.0 if self.side == "right" else -1.0

    @cached_property
    def rest_position_m(self) -> Array:
        """(N + 1, 3) nodes of the unloaded wing, body frame."""
        return self.beam.rest.position_m

    @cached_property
    def rest_marker_m(self) -> Array:
        """(M, 3) markers of the unloaded wing, body frame."""
        node, rest = self.marker_node, self.beam.rest
        points: Array = rest.position_m[node] + (rest.R_body_section[node] @ self.marker_offset_m[:, :, None])[:, :, 0]
        return points

    @cached_property
    def marked_nodes(self) -> tuple[Index, Index]:
        """The nodes that have markers, ascending, and (M,) which of these each marker is at."""
        nodes, which = np.unique(self.marker_node, return_inverse=True)
        return nodes, which

    @cached_property
    def rest_incidence_rad(self) -> Array:
        """(N + 1,) incidence of the unloaded wing."""
        return incidence_rad(self, self.beam.rest.R_body_section)

    def node_at(self, station_m: float) -> int:
        """The node at arc length ``station_m``. Raises ValueError when no node lies there."""
        node = int(np.argmin(np.abs(self.node_s_m - station_m)))
        if abs(self.node_s_m[node] - station_m) > 10 * _SAME_STATION_M:
            raise ValueError(f"no node at s = {station_m} m")
        return node


@dataclass(frozen=True, eq=False)
class Wing:
    """Both half wings of one symmetric description."""

    name: str
    left: HalfWing
    right: HalfWing
    fit: FitSettings

    def half(self, side: str) -> HalfWing:
        """The half wing of that name."""
        return self.left if side == "left" else self.right


def example_path(name: str) -> Path:
    """Where a shipped example lies (``xhale.toml``, ``pazy.toml``)."""
    return Path(str(resources.files("reconstruct") / "examples" / name))


def read_wing(path: Path, nodes_at_m: tuple[float, ...] = ()) -> Wing:
    """Read and check a wing file.

    Args:
        path: the wing.toml.
        nodes_at_m: stations that must be nodes besides those the file asks for (where loads are applied).

    Raises:
        UsageError: the file cannot be read, has an unknown or missing key, or describes what cannot be (stiffness that
            is not positive definite, a marker off the wing); one line with file, key and reason.
    """
    described = read_wing_file(path)
    for station in nodes_at_m:
        if not 0 <= station <= described.semispan_m + _SAME_STATION_M:
            raise UsageError(
                f"{path}: station {station} m is off the wing (its half span is {described.semispan_m:g} m)"
            )
    return build_wing(described, nodes_at_m)


def read_wing_file(path: Path) -> WingFile:
    """What a wing file says, checked. Raises UsageError as ``read_wing``."""
    try:
        with Path(path).open("rb") as file:
            content = tomllib.load(file)
        return WingFile.model_validate(content)
    except OSError as error:
        raise UsageError(
            f"{path}: {error.strerror or error}; give a wing file (see docs/reference/wing-file.md)"
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: not TOML: {error}") from error
    except ValidationError as error:
        raise UsageError(f"{path}: {first_error(error)}") from error


def build_wing(described: WingFile, nodes_at_m: tuple[float, ...] = ()) -> Wing:
    """The two half wings of a checked description."""
    stations = [pair.station_m for pair in described.markers.pairs] + [mass.station_m for mass in described.mass]
    stations += [*(described.fit.load_stations_m if described.fit else ()), *nodes_at_m]
    segments, lengths = _mesh(described.segment, stations)
    return Wing(
        name=described.name,
        left=_half(described, segments, lengths, "left"),
        right=_half(described, segments, lengths, "right"),
        fit=described.fit or FitSettings(load_stations_m=_thirds(lengths)),
    )


def incidence_rad(half: HalfWing, R_body_section: Array) -> Array:
    """Incidence of sections ``R_body_section`` (…, 3, 3), nose-up positive, (…): see docs/ARCHITECTURE.md."""
    _, f0, u0, _ = _level(half, R_body_section)
    forward = half.sign * R_body_section[..., 1]
    incidence: Array = np.arctan2(np.sum(forward * u0, axis=-1), np.sum(forward * f0, axis=-1))
    return incidence


def twist_rad(half: HalfWing, R_body_section: Array) -> Array:
    """Incidence at the nodes (…, N + 1, 3, 3) minus the unloaded wing's at the same arc length: (…, N + 1)."""
    difference = incidence_rad(half, R_body_section) - half.rest_incidence_rad
    return (difference + np.pi) % (2 * np.pi) - np.pi


def twist_gradient(half: HalfWing, R_body_section: Array) -> Array:
    """d twist / d (small rotation vector of the section, body frame): (…, 3) of sections (…, 3, 3).

    Turning a section about its axis changes incidence one to one; turning the axis itself also turns the level
    direction f0 about it, by (x·t)/|f0| of the turn, which is taken off.
    """
    t, _, u0, length = _level(half, R_body_section)
    return half.sign * t - (t[..., 0] / length)[..., None] * cross(t, u0)


def _level(half: HalfWing, R_body_section: Array) -> tuple[Array, Array, Array, Array]:
    t = R_body_section[..., 0]
    level = t[..., :1] * t - np.array([1.0, 0.0, 0.0])
    length = np.linalg.norm(level, axis=-1)
    f0 = level / length[..., None]
    return t, f0, half.sign * cross(t, f0), length


def _half(described: WingFile, segments: list[SegmentSection], lengths: Array, side: Side) -> HalfWing:
    sign = 1.0 if side == "right" else -1.0
    mirror = np.ones(4) if side == "right" else _MIRROR
    node_s = np.concatenate([[0.0], np.cumsum(lengths)])
    beam = Beam(
        length_m=lengths,
        stiffness=np.array([segment.stiffness for segment in segments]) * np.outer(mirror, mirror),
        curvature_1pm=np.array([segment.curvature_1pm for segment in segments]) * mirror[1:],
        joint=_joints(described, segments, side),
        root_m=np.array(described.root.position_m) * [1.0, sign, 1.0],
        R_body_root=_orientation(described, described.segment[0], side),
    )
    pairs = described.markers.pairs
    marker_s = np.repeat([pair.station_m for pair in pairs], 2)
    marker_offset = np.array([[0.0, sign * chord, pair.height_m] for pair in pairs for chord in pair.chord_m]).reshape(
        -1, 3
    )
    masses = _masses(described, segments, node_s, side)
    sigma = described.stiffness_sigma
    return HalfWing(
        side=side,
        beam=beam,
        node_s_m=node_s,
        marker_ids=np.arange(len(marker_s)),
        marker_s_m=marker_s,
        marker_node=_nearest(node_s, marker_s),
        marker_offset_m=marker_offset,
        mass_kg=masses[0],
        mass_node=masses[1],
        mass_offset_m=masses[2],
        stiffness_sigma=np.array([sigma.EA, sigma.GJ, sigma.EI_out, sigma.EI_in]),
    )


def _mesh(described: tuple[SegmentSection, ...], stations_m: list[float]) -> tuple[list[SegmentSection], Array]:
    """Each element's segment and length: a node at every station, no element longer than its segment allows."""
    segments: list[SegmentSection] = []
    lengths: list[float] = []
    start = 0.0
    for segment in described:
        end = start + segment.length_m
        inner = sorted({s for s in stations_m if start + _SAME_STATION_M < s < end - _SAME_STATION_M})
        inner = [s for s, before in zip(inner, [start, *inner], strict=False) if s - before > _SAME_STATION_M]
        longest = segment.length_m / segment.elements
        for a, b in itertools.pairwise([start, *inner, end]):
            count = math.ceil((b - a) / longest - 1e-9)
            segments += [segment] * count
            lengths += [(b - a) / count] * count
        start = end
    return segments, np.array(lengths)


def _thirds(lengths: Array) -> tuple[float, ...]:
    """The nodes nearest to the thirds of the half span: where loads are reported when the file does not say."""
    outboard = np.cumsum(lengths)
    return tuple(sorted({float(outboard[np.argmin(np.abs(outboard - outboard[-1] * i / 3))]) for i in (1, 2, 3)}))


def _orientation(described: WingFile, segment: SegmentSection, side: Side) -> Array:
    """R_body_section at a segment's inboard end, were all before it straight."""
    sign = 1.0 if side == "right" else -1.0
    dihedral = about_axis(0, sign * math.radians(segment.dihedral_deg))
    sweep = about_axis(2, -sign * math.radians(segment.sweep_deg))
    nose_up = about_axis(0, sign * math.radians(described.root.incidence_deg + segment.twist_deg))
    R: Array = dihedral @ sweep @ _R_SIDE[side] @ nose_up
    return R


def _joints(described: WingFile, segments: list[SegmentSection], side: Side) -> Array:
    """(N, 3, 3): the turn before each element, from the frame its inboard neighbour ends in."""
    joint = np.tile(np.eye(3), (len(segments), 1, 1))
    for i, (inboard, outboard) in enumerate(itertools.pairwise(segments), start=1):
        if inboard is not outboard:
            joint[i] = _orientation(described, inboard, side).T @ _orientation(described, outboard, side)
    return joint


def _masses(
    described: WingFile, segments: list[SegmentSection], node_s_m: Array, side: Side
) -> tuple[Array, Index, Array]:
    """Every mass lumped to a node: half of each element's at either end, and what is mounted at its own station."""
    sign = 1.0 if side == "right" else -1.0
    kg: list[float] = []
    node: list[int] = []
    offset: list[tuple[float, float, float]] = []
    for i, segment in enumerate(segments):
        half = segment.mass_per_m * (node_s_m[i + 1] - node_s_m[i]) / 2
        if half > 0:
            kg += [half, half]
            node += [i, i + 1]
            offset += [(0.0, sign * segment.cg_chord_m, segment.cg_height_m)] * 2
    for mass in described.mass:
        if mass.side in ("both", side):
            kg.append(mass.mass_kg)
            node.append(int(_nearest(node_s_m, np.array([mass.station_m]))[0]))
            offset.append((mass.span_m, sign * mass.chord_m, mass.height_m))
    return np.array(kg), np.array(node, dtype=int), np.array(offset).reshape(-1, 3)


def _nearest(node_s_m: Array, station_m: Array) -> Index:
    nearest: Index = np.argmin(np.abs(node_s_m[None, :] - station_m[:, None]), axis=1)
    return nearest
