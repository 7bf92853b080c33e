"""A beam model of another program into a wing file: the ``reconstruct import`` command.

Readers give the right half wing as straight pieces in a frame x aft, y right, z up, in SI units; here they become
segments. What the other file has not (markers, chords, the fit's prior) is left to the user.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from pydantic import ValidationError

from capture.console import note, say
from capture.errors import UsageError
from reconstruct.rotation import Array
from reconstruct.wing_file import WingFile, first_error

_SAME = 1e-9
_COUPLINGS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
_NO_OFFSET = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Piece:
    """One straight beam element of the right half wing."""

    begin_m: Array  # (3,) x aft, y right, z up
    end_m: Array  # (3,)
    stiffness: Array  # (4, 4) extension, twist, out-of-plane (about forward), in-plane (about up)
    twist_deg: float = 0.0  # nose-up
    mass_per_m: float = 0.0
    cg_m: tuple[float, float] = (0.0, 0.0)  # of that mass: forward of the axis, above it
    elements: int = 1


@dataclass(frozen=True, eq=False)
class PointMass:
    """A lumped mass."""

    at_m: Array  # (3,) the node it is fixed to
    mass_kg: float
    offset_m: tuple[float, float, float] = _NO_OFFSET  # of its centre: outboard, forward, up


@dataclass(frozen=True, eq=False)
class Line:
    """A right half wing, pieces from the root outward."""

    name: str
    source: str
    pieces: tuple[Piece, ...]
    masses: tuple[PointMass, ...] = ()


def import_wing(
    file: Annotated[Path, typer.Argument(help="A SHARPy beam (.fem.h5, .h5) or a Nastran deck (.bdf, .dat, .nas).")],
    out: Annotated[Path, typer.Option("--output", "-o", help="The wing file to write.")],
) -> None:
    """Make a wing file of a SHARPy beam or of a Nastran line of CBAR or CBEAM elements."""
    if not file.is_file():
        raise UsageError(f"{file}: no such file; give a SHARPy beam (.fem.h5) or a Nastran deck (.bdf)")
    if file.suffix.lower() in (".h5", ".hdf5"):
        from reconstruct.import_sharpy import read_sharpy

        line = read_sharpy(file)
    elif file.suffix.lower() in (".bdf", ".dat", ".nas"):
        from reconstruct.import_nastran import read_nastran

        line = read_nastran(file)
    else:
        raise UsageError(f"{file}: neither a SHARPy beam (.h5) nor a Nastran deck (.bdf, .dat, .nas)")
    content = as_wing_file(line, file)
    try:
        out.write_text(toml_of(content), encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{out}: {error.strerror or error}; give a file that can be written") from error
    span = sum(segment["length_m"] for segment in content["segment"])
    say(f"{out}: {len(content['segment'])} segments, half span {span:.4g} m, {len(content.get('mass', ()))} masses")
    note("add [markers], and [stiffness_sigma]; see docs/reference/wing-file.md")


def as_wing_file(line: Line, file: Path) -> dict[str, Any]:
    """The contents of a wing file, checked; equal neighbours become one segment. Raises UsageError naming ``file``."""
    if not line.pieces:
        raise UsageError(f"{file}: has no beam element on the right wing (y > 0)")
    segments: list[dict[str, Any]] = []
    for piece in line.pieces:
        segment = _segment(piece)
        same = segments and all(
            np.allclose(segments[-1].get(key, 0.0), segment.get(key, 0.0), rtol=_SAME, atol=_SAME)
            for key in {*segments[-1], *segment} - {"length_m", "elements"}
        )
        if same:
            segments[-1]["length_m"] += segment["length_m"]
            segments[-1]["elements"] += segment["elements"]
        else:
            segments.append(segment)
    root = line.pieces[0].begin_m
    content: dict[str, Any] = {
        "name": line.name,
        "source": line.source,
        "root": {"position_m": [float(value) for value in root]},
        "segment": segments,
    }
    masses = [entry for mass in line.masses if (entry := _mass(mass, line.pieces)) is not None]
    if masses:
        content["mass"] = masses
    try:
        WingFile.model_validate(content)
    except ValidationError as error:
        raise UsageError(f"{file}: {first_error(error)}") from error
    return content


def ordered(pieces: Sequence[Piece], file: Path) -> tuple[Piece, ...]:
    """The pieces from the root outward, turned round where needed. Raises UsageError when they are not one line."""
    ends = [(piece.begin_m, piece.end_m) for piece in pieces]
    flat = np.array([point for pair in ends for point in pair])
    if not len(flat):
        return ()
    at = flat[np.argmin(flat[:, 1])]
    left = list(pieces)
    line: list[Piece] = []
    while left:
        touching = [p for p in left if min(np.linalg.norm(p.begin_m - at), np.linalg.norm(p.end_m - at)) < 1e-6]
        if len(touching) != 1:
            what = "branches" if touching else "has a gap"
            raise UsageError(f"{file}: the right wing's beam {what} at {_place(at)}; give one line of elements")
        piece = touching[0]
        left.remove(piece)
        if np.linalg.norm(piece.end_m - at) < 1e-6:
            raise UsageError(f"{file}: an element at {_place(at)} runs inboard; let all run from the root outward")
        line.append(piece)
        at = piece.end_m
    return tuple(line)


def toml_of(content: dict[str, Any]) -> str:
    """A wing file's text."""
    lines = ["# Right half wing; the left one is its mirror image. SI units. Markers are still to be added."]
    for key in ("name", "source"):
        lines.append(f"{key} = {_value(content[key])}")
    for table in ("root",):
        lines += ["", f"[{table}]", *(f"{key} = {_value(value)}" for key, value in content[table].items())]
    for table in ("segment", "mass"):
        for entry in content.get(table, ()):
            lines += ["", f"[[{table}]]", *(f"{key} = {_value(value)}" for key, value in entry.items())]
    return "\n".join(lines) + "\n"


def _place(point: Array) -> str:
    return "({:.4g}, {:.4g}, {:.4g}) m".format(*point)


def _segment(piece: Piece) -> dict[str, Any]:
    along = piece.end_m - piece.begin_m
    K = piece.stiffness
    segment: dict[str, Any] = {
        "length_m": float(np.linalg.norm(along)),
        "elements": piece.elements,
        **{key: float(K[i, i]) for i, key in enumerate(("EA", "GJ", "EI_out", "EI_in"))},
    }
    for i, j in _COUPLINGS:
        if abs(K[i, j]) > 1e-12 * np.sqrt(K[i, i] * K[j, j]):
            segment[f"k{i + 1}{j + 1}"] = float(K[i, j])
    angles = {
        "dihedral_deg": float(np.degrees(np.arctan2(along[2], along[1]))),
        "sweep_deg": float(np.degrees(np.arctan2(along[0], np.hypot(along[1], along[2])))),
        "twist_deg": piece.twist_deg,
        "mass_per_m": piece.mass_per_m,
        "cg_chord_m": piece.cg_m[0],
        "cg_height_m": piece.cg_m[1],
    }
    segment.update({key: value for key, value in angles.items() if abs(value) > _SAME})
    return segment


def _mass(mass: PointMass, pieces: Sequence[Piece]) -> dict[str, Any] | None:
    """A mass at its arc length; None when its node is not one of the right wing's."""
    arc = 0.0
    for piece in pieces:
        length = float(np.linalg.norm(piece.end_m - piece.begin_m))
        for at, station in ((piece.begin_m, arc), (piece.end_m, arc + length)):
            if np.linalg.norm(at - mass.at_m) < 1e-6:
                span, chord, height = mass.offset_m
                return {
                    "station_m": station,
                    "mass_kg": mass.mass_kg,
                    "span_m": span,
                    "chord_m": chord,
                    "height_m": height,
                }
        arc += length
    return None


def _value(value: Any) -> str:
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return f'"{escaped}"'
    if isinstance(value, list):
        return f"[{', '.join(_value(item) for item in value)}]"
    return repr(value)
