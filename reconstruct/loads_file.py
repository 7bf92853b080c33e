"""loads.toml into loads on the nodes of a half wing.

Loads are written as for the right wing; the left one gets their mirror image. The keys are in
docs/reference/wing-file.md.
"""

import tomllib
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import ValidationError, model_validator

from capture.errors import UsageError
from reconstruct.loads import Loads
from reconstruct.rotation import Array, cross
from reconstruct.wing import HalfWing
from reconstruct.wing_file import Finite, NotNegative, Positive, Strict, Vector, first_error

_GAUSS = ((0.5 - 0.5 / np.sqrt(3), 0.5), (0.5 + 0.5 / np.sqrt(3), 0.5))
_NO_VECTOR: Vector = (0.0, 0.0, 0.0)


class PointLoad(Strict):
    """A force and a moment at one station. Dead: body axes. Follower: [outboard, forward, up] of the section."""

    station_m: NotNegative
    kind: Literal["dead", "follower"] = "dead"
    force_n: Vector = _NO_VECTOR
    moment_nm: Vector = _NO_VECTOR
    span_m: Finite = 0.0  # where the force acts, from the axis: outboard,
    chord_m: Finite = 0.0  # forward,
    height_m: Finite = 0.0  # up
    side: Literal["both", "left", "right"] = "both"


class DistributedLoad(Strict):
    """A force and a moment a metre of arc, on the axis, between two stations; linear when an end value is given."""

    from_m: NotNegative = 0.0
    to_m: Positive
    kind: Literal["dead", "follower"] = "dead"
    force_n_m: Vector = _NO_VECTOR
    force_end_n_m: Vector | None = None
    moment_nm_m: Vector = _NO_VECTOR
    moment_end_nm_m: Vector | None = None
    side: Literal["both", "left", "right"] = "both"

    @model_validator(mode="after")
    def _outward(self) -> "DistributedLoad":
        if self.to_m <= self.from_m:
            raise ValueError("to_m must lie outboard of from_m")
        return self


class LoadsFile(Strict):
    """A whole loads.toml."""

    gravity: bool = False  # weight of the wing's masses
    gravity_m_s2: Positive = 9.80665
    point: tuple[PointLoad, ...] = ()
    distributed: tuple[DistributedLoad, ...] = ()

    @property
    def stations_m(self) -> tuple[float, ...]:
        """Where a wing needs nodes to carry these loads."""
        ends = [station for load in self.distributed for station in (load.from_m, load.to_m)]
        return tuple(sorted({*ends, *(load.station_m for load in self.point)}))


def read_loads(path: Path) -> LoadsFile:
    """Read and check a loads file. Raises UsageError: one line with file, key and reason."""
    try:
        with Path(path).open("rb") as file:
            return LoadsFile.model_validate(tomllib.load(file))
    except OSError as error:
        raise UsageError(
            f"{path}: {error.strerror or error}; give a loads file (see docs/reference/wing-file.md)"
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: not TOML: {error}") from error
    except ValidationError as error:
        raise UsageError(f"{path}: {first_error(error)}") from error


def loads_on(half: HalfWing, described: LoadsFile) -> Loads:
    """The loads on a half wing that has nodes at ``described.stations_m``. Raises ValueError where one is missing."""
    nodes = half.beam.elements + 1
    dead_force, dead_moment, follower_force, follower_moment = np.zeros((4, nodes, 3))
    offset_force: list[Array] = []
    offset_node: list[int] = []
    offset: list[Array] = []
    if described.gravity:
        for kg, node, arm in zip(half.mass_kg, half.mass_node, half.mass_offset_m, strict=True):
            offset_force.append(np.array([0.0, 0.0, -kg * described.gravity_m_s2]))
            offset_node.append(int(node))
            offset.append(arm)
    for point in described.point:
        if point.side not in ("both", half.side):
            continue
        node = half.node_at(point.station_m)
        force, moment = _sided(half, point.kind, point.force_n, point.moment_nm)
        arm = np.array([point.span_m, half.sign * point.chord_m, point.height_m])
        if point.kind == "follower":
            follower_force[node] += force
            follower_moment[node] += moment + cross(arm, force)
        else:
            dead_moment[node] += moment
            offset_force.append(force)
            offset_node.append(node)
            offset.append(arm)
    for load in described.distributed:
        if load.side not in ("both", half.side):
            continue
        force, moment = _spread(half, load)
        into = (follower_force, follower_moment) if load.kind == "follower" else (dead_force, dead_moment)
        into[0][:] += force
        into[1][:] += moment
    follows = bool(follower_force.any() or follower_moment.any())
    return Loads(
        force_n=dead_force,
        moment_nm=dead_moment,
        follower_force_n=follower_force if follows else None,
        follower_moment_nm=follower_moment if follows else None,
        offset_force_n=np.array(offset_force) if offset_force else None,
        offset_node=np.array(offset_node) if offset_force else None,
        offset_m=np.array(offset) if offset_force else None,
    )


def _sided(half: HalfWing, kind: str, force: Vector, moment: Vector) -> tuple[Array, Array]:
    """A right wing's force and moment on this half: a mirror turns a moment's other two components round."""
    if half.side == "right":
        return np.array(force), np.array(moment)
    mirrored = np.array([1.0, -1.0, 1.0])  # y in body axes as e2 in the section's
    return np.array(force) * mirrored, -np.array(moment) * mirrored


def _spread(half: HalfWing, load: DistributedLoad) -> tuple[Array, Array]:
    """Nodal forces and moments (N + 1, 3) of a distributed load, by two-point Gauss quadrature in each element."""
    s = half.node_s_m
    begin = _sided(half, load.kind, load.force_n_m, load.moment_nm_m)
    end = _sided(half, load.kind, load.force_end_n_m or load.force_n_m, load.moment_end_nm_m or load.moment_nm_m)
    force, moment = np.zeros((2, len(s), 3))
    for element in range(half.node_at(load.from_m), half.node_at(load.to_m)):
        length = s[element + 1] - s[element]
        for place, weight in _GAUSS:
            along = (s[element] + place * length - load.from_m) / (load.to_m - load.from_m)
            for out, a, b in ((force, begin[0], end[0]), (moment, begin[1], end[1])):
                here = ((1 - along) * a + along * b) * weight * length
                out[element] += (1 - place) * here
                out[element + 1] += place * here
    return force, moment
