"""Fits of a flight → the shape that displacements and twist are counted from: unloaded, or recorded at rest."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from capture.errors import UsageError
from reconstruct.series import SideFits
from reconstruct.tables import SHAPE, Floats, read_table, shape_series


@dataclass(frozen=True)
class Window:
    """Seconds since the first set, in which the wing is at rest."""

    begin_s: float
    end_s: float


Reference = Window | Path | None
"""a window of this recording, another result (its folder, or its shape table), or the unloaded wing"""


def parse_window(text: str) -> Window:
    """``A:B`` in seconds. Raises UsageError when it is not that."""
    try:
        begin, end = (float(part) for part in text.split(":"))
    except ValueError:
        raise UsageError(f"--reference-window {text}: give two times in seconds as A:B, for instance 0:5") from None
    if not 0 <= begin < end < np.inf:
        raise UsageError(f"--reference-window {text}: A must not be negative, and B later than A")
    return Window(begin, end)


def refer(fits: Mapping[str, SideFits], reference: Reference) -> dict[str, SideFits]:
    """The fits, with the shape their displacements are counted from, and its name.

    A recorded reference is the mean over its fitted sets; its own noise, smaller by the root of their number, is not in
    any sigma. Raises UsageError when it has no fitted set of a side, or other stations.
    """
    if reference is None:
        return dict(fits)
    if isinstance(reference, Window):
        return _from_window(fits, reference)
    return _from_file(fits, reference / SHAPE if reference.is_dir() else reference)


def _from_window(fits: Mapping[str, SideFits], window: Window) -> dict[str, SideFits]:
    start = min(int(side.timestamp_ns.min()) for side in fits.values())
    name = f"mean of {window.begin_s:g} to {window.end_s:g} s"
    referred = {}
    for side, own in fits.items():
        since = (own.timestamp_ns - start) * 1e-9
        chosen = own.converged & (since >= window.begin_s) & (since <= window.end_s)
        if not chosen.any():
            raise UsageError(
                f"--reference-window {window.begin_s:g}:{window.end_s:g}: no set of the {side} wing was fitted in it "
                f"(the recording has {since.min():.1f} to {since.max():.1f} s)"
            )
        referred[side] = _referred(own, own.xyz_m[chosen], own.twist_rad[chosen], name)
    return referred


def _from_file(fits: Mapping[str, SideFits], path: Path) -> dict[str, SideFits]:
    shapes = shape_series(read_table(path, ()), str(path))
    referred = {}
    for side, own in fits.items():
        if side not in shapes:
            raise UsageError(f"{path}: has no {side} wing; give a reference with every wing of this recording")
        there = shapes[side]
        if there.s_m.shape != own.s_m.shape or np.abs(there.s_m - own.s_m).max() > 1e-6:
            raise UsageError(f"{path}: has other stations; fit the reference with the same wing file")
        fitted = np.isfinite(there.xyz_m).all(axis=(1, 2))
        if not fitted.any():
            raise UsageError(f"{path}: no set of the {side} wing was fitted in it")
        referred[side] = _referred(own, there.xyz_m[fitted], np.radians(there.twist_deg[fitted]), f"mean of {path}")
    return referred


def _referred(fits: SideFits, xyz_m: Floats, twist_rad: Floats, name: str) -> SideFits:
    return replace(fits, reference=name, reference_xyz_m=xyz_m.mean(axis=0), reference_twist_rad=twist_rad.mean(axis=0))
