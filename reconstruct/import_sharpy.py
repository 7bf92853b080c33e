"""A SHARPy beam (``.fem.h5``) into the right half wing as straight pieces.

SHARPy's six strains are three forces' and three moments'; ours have no shear, which is condensed out. Its local frame
is x along the beam, y forward (``frame_of_reference_delta``), z up, its body frame x aft, y right, z up on wings whose
delta points to −x; others are refused. Format: https://ic-sharpy.readthedocs.io (case files, FEM).
"""

import importlib
from pathlib import Path
from typing import Any

import numpy as np

from capture.errors import UsageError
from reconstruct.import_wing import Line, Piece, PointMass, ordered
from reconstruct.rotation import Array

_NEEDED = ("coordinates", "connectivities", "stiffness_db", "elem_stiffness")
_KEPT, _SHEAR = [0, 3, 4, 5], [1, 2]


def read_sharpy(path: Path) -> Line:
    """The right wing in a SHARPy FEM file. Raises UsageError when h5py is not installed or the file is not one."""
    try:
        h5py: Any = importlib.import_module("h5py")
    except ImportError as error:
        raise UsageError(f"{path}: reading it needs h5py, which is not installed: pip install h5py") from error
    try:
        with h5py.File(path, "r") as file:
            data = {name: np.asarray(file[name]) for name in file if hasattr(file[name], "shape")}
    except OSError as error:
        raise UsageError(f"{path}: not an HDF5 file; give SHARPy's .fem.h5") from error
    missing = [name for name in _NEEDED if name not in data]
    if missing:
        raise UsageError(f"{path}: lacks {', '.join(missing)}; give SHARPy's .fem.h5, not another of its files")
    node, elements = data["coordinates"].astype(float), data["connectivities"].astype(int)
    pieces = []
    for element, nodes in enumerate(elements):
        begin, end = node[nodes[0]], node[nodes[1]]
        if min(begin[1], end[1]) < -1e-9 or end[1] + begin[1] < 1e-9:
            continue
        _check_frame(data, element, path)
        stiffness = data["stiffness_db"][int(data["elem_stiffness"][element])]
        per_m, cg = _mass(data, element)
        pieces.append(
            Piece(
                begin_m=begin,
                end_m=end,
                stiffness=without_shear(stiffness),
                twist_deg=_twist_deg(data, element),
                mass_per_m=per_m,
                cg_m=cg,
                elements=max(1, elements.shape[1] - 1),
            )
        )
    return Line(path.name.split(".")[0], f"imported from {path.name} (SHARPy)", ordered(pieces, path), _masses(data))


def without_shear(stiffness: Array) -> Array:
    """(6, 6) forces and moments → (4, 4) of a beam that does not shear under its shear strain's own force."""
    K = np.asarray(stiffness, dtype=np.float64)
    to_shear = K[np.ix_(_SHEAR, _KEPT)]
    condensed: Array = K[np.ix_(_KEPT, _KEPT)] - to_shear.T @ np.linalg.solve(K[np.ix_(_SHEAR, _SHEAR)], to_shear)
    return (condensed + condensed.T) / 2


def _check_frame(data: dict[str, Any], element: int, path: Path) -> None:
    delta = data.get("frame_of_reference_delta")
    if delta is None:
        return
    forward = np.atleast_2d(delta[element])[0]
    if forward[0] > -0.9 * np.linalg.norm(forward):
        raise UsageError(
            f"{path}: element {element}: frame_of_reference_delta is {forward.tolist()}; a wing with x aft and its "
            "local y to the leading edge, [-1, 0, 0], is understood"
        )


def _twist_deg(data: dict[str, Any], element: int) -> float:
    twist = data.get("structural_twist")
    return 0.0 if twist is None else float(np.degrees(np.mean(np.atleast_1d(twist[element]))))


def _mass(data: dict[str, Any], element: int) -> tuple[float, tuple[float, float]]:
    """Mass a metre, and where its centre is (forward, up): the off-diagonal block is −m · skew(centre)."""
    if "mass_db" not in data or "elem_mass" not in data:
        return 0.0, (0.0, 0.0)
    M = data["mass_db"][int(data["elem_mass"][element])]
    if M[0, 0] <= 0:
        return 0.0, (0.0, 0.0)
    return float(M[0, 0]), (float(-M[0, 5] / M[0, 0]), float(M[0, 4] / M[0, 0]))


def _masses(data: dict[str, Any]) -> tuple[PointMass, ...]:
    if "lumped_mass" not in data or "lumped_mass_nodes" not in data:
        return ()
    kg = np.atleast_1d(data["lumped_mass"]).astype(float)
    nodes = np.atleast_1d(data["lumped_mass_nodes"]).astype(int)
    offset = np.atleast_2d(data.get("lumped_mass_position", np.zeros((len(kg), 3)))).astype(float)
    return tuple(
        PointMass(data["coordinates"][at].astype(float), float(mass), (float(arm[0]), float(arm[1]), float(arm[2])))
        for mass, at, arm in zip(kg, nodes, offset, strict=True)
        if mass > 0
    )
