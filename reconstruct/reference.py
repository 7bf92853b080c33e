"""Fits of a flight → the shape that displacements and twist are counted from: unloaded, or recorded at rest."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from capture.errors import UsageError
from process.reference import Window
from reconstruct.series import SideFits, fit_series
from reconstruct.tables import SHAPE, Floats, marker_series, read_table, shape_series
from reconstruct.wing import Wing

Reference = Window | Path | None
"""a window of this recording, markers at rest, another result (its folder, its shape table), or the unloaded wing"""


def refer(fits: Mapping[str, SideFits], reference: Reference, wing: Wing) -> dict[str, SideFits]:
    """The fits, with the shape their displacements are counted from, and its name.

    Markers at rest (``wingproc reference``) are fitted with ``wing``, as the flight's were. Of a window or a result it
    is the mean over the fitted sets. Its own noise, smaller by the root of their number, is not in any sigma. Raises
    UsageError when it has no fitted set of a side, or other stations.
    """
    if reference is None:
        return dict(fits)
    if isinstance(reference, Window):
        return _from_window(fits, reference)
    path = reference / SHAPE if reference.is_dir() else reference
    table = read_table(path, ())
    if "marker" in table.column_names:
        return _from_markers(fits, table, path, wing)
    return _from_shapes(fits, table, path)


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


def _from_markers(fits: Mapping[str, SideFits], table: pa.Table, path: Path, wing: Wing) -> dict[str, SideFits]:
    at_rest = fit_series(marker_series(table, str(path)), wing, workers=1)
    referred = {}
    for side, own in fits.items():
        if side not in at_rest or not at_rest[side].converged.any():
            reason = at_rest[side].reason[0] if side in at_rest else "it has none of its markers"
            raise UsageError(f"{path}: the {side} wing at rest could not be fitted ({reason})")
        there = at_rest[side]
        referred[side] = _referred(own, there.xyz_m[there.converged], there.twist_rad[there.converged], f"{path}")
    return referred


def _from_shapes(fits: Mapping[str, SideFits], table: pa.Table, path: Path) -> dict[str, SideFits]:
    shapes = shape_series(table, str(path))
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
