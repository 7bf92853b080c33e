"""A recorded window, another result, or the unloaded wing → the shape that displacements and twist are counted from."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from capture.errors import UsageError
from process.reference import Window
from reconstruct.fit import Fit
from reconstruct.rotation import Array
from reconstruct.shared import SharedError, sigma_of
from reconstruct.tables import shape_series
from reconstruct.wing import HalfWing

UNLOADED_WING = "unloaded wing"


Reference = Window | Path | None
"""a window of this recording, markers at rest, another result (its folder, its shape table), or the unloaded wing"""


@dataclass(frozen=True, eq=False)
class ReferenceShape:
    """One side's shape that displacements are counted from, and how well it is known."""

    name: str
    xyz_m: Array  # (N + 1, 3) body frame
    twist_rad: Array  # (N + 1,) against the unloaded wing
    sigma: Array  # (N + 1, 4) one sigma of nodes (m) and twist (rad) that displacements from it have from it
    shared: Array | None  # (N + 1, 4, P) its answer to the errors that all frames share; None: it has not that of ours

    @property
    def sigma_position_m(self) -> Array:
        """(N + 1, 3) one sigma of where it is: its own, and what all frames share."""
        own = self.sigma[:, :3]
        return own if self.shared is None else np.hypot(own, sigma_of(self.shared)[:, :3])


def unloaded(half: HalfWing) -> ReferenceShape:
    """The wing file's wing without loads: exact by definition."""
    nodes = len(half.rest_position_m)
    return ReferenceShape(UNLOADED_WING, half.rest_position_m, np.zeros(nodes), np.zeros((nodes, 4)), None)


def mean_of(
    name: str, half: HalfWing, fits: Fit | None, shared: SharedError | None, *, same: bool = True
) -> ReferenceShape | None:
    """The mean of the fits that converged, its noise smaller by the root of their number; None where there is none.

    ``shared`` are the errors that its frames share; ``same`` says that they are the flight's own, and cancel.
    """
    if fits is None or not fits.converged.any():
        return None
    good = fits[fits.converged]
    noise = np.concatenate([good.sigma_position_m, good.sigma_twist_rad[:, :, None]], axis=2)
    sigma = np.sqrt(np.mean(noise**2, axis=0) / len(good))
    response = None if shared is None else shared.of_shapes(half, good).mean(axis=0)
    if response is not None and not same:
        sigma, response = np.hypot(sigma, sigma_of(response)), None
    return ReferenceShape(name, good.position_m.mean(axis=0), good.twist_rad.mean(axis=0), sigma, response)


def recorded(table: pa.Table, path: Path, side: str, half: HalfWing) -> ReferenceShape:
    """The mean of another result's shape table, read from ``path``.

    What errors it shares with the recording at hand is not known, so its sigma counts as the mean's own, in full.
    Raises UsageError when it has no fitted set of this side, or other stations.
    """
    shapes = shape_series(table, str(path))
    if side not in shapes:
        raise UsageError(f"{path}: has no {side} wing; give a reference with every wing of this recording")
    there = shapes[side]
    if there.s_m.shape != half.node_s_m.shape or np.abs(there.s_m - half.node_s_m).max() > 1e-6:
        raise UsageError(f"{path}: has other stations; fit the reference with the same wing file")
    fitted = np.isfinite(there.xyz_m).all(axis=(1, 2))
    if not fitted.any():
        raise UsageError(f"{path}: no set of the {side} wing was fitted in it")
    sigma = np.concatenate([there.sigma_xyz_m, np.radians(there.sigma_twist_deg)[:, :, None]], axis=2)[fitted]
    known = np.sqrt(np.mean(np.where(np.isfinite(sigma), sigma, 0.0) ** 2, axis=0))
    mean_twist = np.radians(there.twist_deg[fitted].mean(axis=0))
    return ReferenceShape(f"mean of {path}", there.xyz_m[fitted].mean(axis=0), mean_twist, known, None)
