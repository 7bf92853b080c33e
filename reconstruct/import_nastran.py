"""A Nastran deck with a line of CBAR or CBEAM elements into the right half wing as straight pieces.

Read are GRID, CBAR, CBEAM, PBAR, PBEAM (end A), MAT1 and CONM2, in small, large and free field format, in the basic
coordinate system x aft, y right, z up, in SI units. The reader is our own: the deck's few cards are simple, and the
open reader of all of Nastran does not run with every NumPy we support. What it does not understand on these cards
(other coordinate systems, offsets) is an error, never guessed.
"""

import re
from pathlib import Path

import numpy as np

from capture.errors import UsageError
from reconstruct.import_wing import Line, Piece, PointMass, ordered
from reconstruct.rotation import Array

_READ = ("GRID", "CBAR", "CBEAM", "PBAR", "PBEAM", "MAT1", "CONM2")
_AFT = np.array([1.0, 0.0, 0.0])

Card = list[str]


def read_nastran(path: Path) -> Line:
    """The right wing in a Nastran bulk data file. Raises UsageError: one line with file, card and reason."""
    try:
        cards = _cards(path.read_text(encoding="latin-1"))
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror or error}") from error
    try:
        return _line(cards, path)
    except (ValueError, IndexError, KeyError) as error:
        raise UsageError(f"{path}: not a line of CBAR or CBEAM elements with their cards: {error!r}") from error


def _line(cards: dict[str, list[Card]], path: Path) -> Line:
    for card in cards["GRID"]:
        if _integer(card, 2) != 0:
            raise UsageError(f"{path}: GRID {card[1]} is in coordinate system {card[2]}; give the basic one (0)")
    grid = {_integer(card, 1): np.array([_number(card, at) for at in (3, 4, 5)]) for card in cards["GRID"]}
    section = {_integer(card, 1): card for card in cards["PBAR"] + cards["PBEAM"]}
    material = {_integer(card, 1): card for card in cards["MAT1"]}
    pieces = []
    for card in cards["CBAR"] + cards["CBEAM"]:
        begin, end = (grid[_integer(card, at)] for at in (3, 4))
        if min(begin[1], end[1]) < -1e-9 or begin[1] + end[1] < 1e-9:
            continue
        if end[1] < begin[1]:
            begin, end = end, begin
        if any(_number(card, at) for at in range(11, 17)):
            raise UsageError(f"{path}: {card[0]} {card[1]} has end offsets, which are not understood; move its grids")
        stiffness, per_m = _section(section[_integer(card, 2)], material)
        towards = _orientation(card, grid, begin)
        pieces.append(Piece(begin, end, _turned(stiffness, end - begin, towards), mass_per_m=per_m, elements=2))
    masses = tuple(_mass(card, grid, path) for card in cards["CONM2"])
    return Line(path.stem, f"imported from {path.name} (Nastran)", ordered(pieces, path), masses)


def _section(card: Card, material: dict[int, Card]) -> tuple[Array, float]:
    """EA, GJ, E·I1, E·I2, E·I12 of a PBAR or of end A of a PBEAM; mass a metre."""
    made_of = material[_integer(card, 2)]
    E, G, nu, rho = (_number(made_of, at) for at in (2, 3, 4, 5))
    G = G or E / (2 * (1 + nu))
    if card[0] == "PBAR":
        area, I1, I2, J, per_m = (_number(card, at) for at in (3, 4, 5, 6, 7))
        I12 = _number(card, 19)
    else:
        area, I1, I2, I12, J, per_m = (_number(card, at) for at in (3, 4, 5, 6, 7, 8))
    return np.array([E * area, G * J, E * I1, E * I2, E * I12]), rho * area + per_m


def _orientation(card: Card, grid: dict[int, Array], begin: Array) -> Array:
    """Vector in plane 1: given, or towards a grid."""
    if card[5] and "." not in card[5] and not card[6]:
        return grid[int(card[5])] - begin
    return np.array([_number(card, at) for at in (5, 6, 7)])


def _turned(stiffness: Array, along: Array, towards: Array) -> Array:
    """(4, 4) about our section's axes. I1 resists bending in plane 1 (of the beam and ``towards``), I2 across it."""
    e1 = along / np.linalg.norm(along)
    y = towards - (towards @ e1) * e1
    y /= np.linalg.norm(y)
    z = np.cross(e1, y)
    e2 = -_AFT + (_AFT @ e1) * e1
    e2 /= np.linalg.norm(e2)
    e3 = np.cross(e1, e2)
    EA, GJ, EI1, EI2, EI12 = stiffness
    about = EI2 * np.outer(y, y) + EI1 * np.outer(z, z) - EI12 * (np.outer(y, z) + np.outer(z, y))
    bending = np.array([[e2 @ about @ e2, e2 @ about @ e3], [e3 @ about @ e2, e3 @ about @ e3]])
    K = np.zeros((4, 4))
    K[0, 0], K[1, 1], K[2:, 2:] = EA, GJ, bending
    return K


def _mass(card: Card, grid: dict[int, Array], path: Path) -> PointMass:
    if _integer(card, 3) != 0:
        raise UsageError(f"{path}: CONM2 {card[1]} is in coordinate system {card[3]}; give the basic one (0)")
    x, y, z = (_number(card, at) for at in (5, 6, 7))
    return PointMass(grid[_integer(card, 2)], _number(card, 4), (y, -x, z))


def _cards(text: str) -> dict[str, list[Card]]:
    """The cards of the kinds we read: name, then fields, continuations joined (their own first fields left out)."""
    found: dict[str, list[Card]] = {name: [] for name in _READ}
    card: Card | None = None
    for raw in text.splitlines():
        line = raw.split("$")[0].rstrip().expandtabs(8)
        if not line:
            continue
        fields = _fields(line)
        name = fields[0].rstrip("*").upper()
        if name == "" or name.startswith(("+", "*")):
            if card is not None:
                card += fields[1:]
            continue
        card = [name, *fields[1:]] if name in found else None
        if card is not None:
            found[name].append(card)
    for cards in found.values():
        for one in cards:
            one += [""] * max(0, 24 - len(one))
    return found


def _fields(line: str) -> list[str]:
    """The line's own name (blank or + for a continuation) and its data fields: eight, or four wide ones."""
    if "," in line:
        parts = [part.strip() for part in line.split(",")]
        parts += [""] * (9 - len(parts))
        return parts[:9]
    wide = "*" in line[:8]
    width, count = (16, 4) if wide else (8, 8)
    fields = [line[8 + width * i : 8 + width * (i + 1)].strip() for i in range(count)]
    return [line[:8].strip(), *fields]


def _integer(card: Card, at: int) -> int:
    return int(card[at]) if card[at] else 0


def _number(card: Card, at: int) -> float:
    """Nastran's numbers may leave the E of their exponent out: 7.1+10."""
    text = card[at].upper().replace("D", "E")
    return float(re.sub(r"(?<=[0-9.])([+-])", r"E\1", text)) if text else 0.0
