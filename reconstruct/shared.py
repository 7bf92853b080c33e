"""What all frames share (calibration, mount, lights) → the errors it gives fitted shapes and their displacements.

The markers' error is J δ (``process.shared_error``), δ one draw for the whole flight. A fit follows its markers, so
that nodes and twist have the error R δ' with R the fit's response times J times a root of δ's covariance, and δ' a
vector of independent unit errors. A displacement between two sets has (R₂ − R₁) δ', mostly far less than either.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from process.camera_model import Light, RigSide
from process.shared_error import Surface, light_of, shared_covariance, shared_jacobian, sides_of
from reconstruct.fit import Fit, marker_places
from reconstruct.rotation import Array
from reconstruct.wing import HalfWing

_WEIGHTED = 1e-3  # of the largest direction: smaller ones are left out of the fit's weights


@dataclass(frozen=True, eq=False)
class SharedError:
    """A side's, as the marker table states it."""

    rig: RigSide
    light: Light
    root: Array  # (P, P) root · rootᵀ is the covariance of δ

    def as_in(self, other: "SharedError") -> bool:
        """Whether both are the errors of one calibration, mount and kind of light, so that one draw is in both."""
        return self.light == other.light and self.rig.to_dict() == other.rig.to_dict()

    def of_markers(self, half: HalfWing, xyz_m: Array) -> Array:
        """(F, M, 3, r) how markers measured at ``xyz_m`` (F, M, 3) move with independent unit errors; 0 where NaN.

        The r directions are those that move the unloaded wing's markers, for the fit's weights; the rest is left out.
        """
        up = half.beam.rest.R_body_section[half.marker_node][:, :, 2]
        at_rest = self._moved(half.rest_marker_m, up)
        _, size, direction = np.linalg.svd(at_rest.reshape(-1, at_rest.shape[2]), full_matrices=False)
        kept = direction[size > _WEIGHTED * size[0]].T
        moved = self._moved(xyz_m.reshape(-1, 3), np.tile(up, (len(xyz_m), 1))) @ kept
        return np.asarray(moved.reshape(*xyz_m.shape, -1))

    def _moved(self, points_m: Array, up: Array) -> Array:
        """(n, 3, P) how points (n, 3) of a surface with normals ``up`` move by unit errors; 0 out of view."""
        moved = shared_jacobian(self.rig, points_m, Surface(self.light, up)) @ self.root
        return np.asarray(np.where(np.isfinite(moved), moved, 0.0))

    def of_shapes(self, half: HalfWing, fits: Fit) -> Array:
        """R (F, N + 1, 4, P) of F fits: the shift of the nodes (m, body frame) and of twist (rad) by each unit error.

        NaN where a fit did not converge.
        """
        R = np.full((*fits.by_told.shape[:3], self.root.shape[1]), np.nan)
        if not fits.converged.any():
            return R
        good = fits if fits.converged.all() else fits[fits.converged]
        places = marker_places(half, good)
        up = good.R_body_section[:, half.marker_node, :, 2]
        moved = self._moved(places.reshape(-1, 3), up.reshape(-1, 3))
        R[fits.converged] = good.moved_by(moved.reshape(*places.shape, -1))
        return R


def shared_errors(table: pa.Table) -> dict[str, SharedError]:
    """By side; a side is left out of which the table, its calibration or its survey does not state the errors."""
    found: Mapping[str, RigSide] = sides_of(table)
    light = light_of(table)
    errors = {}
    for name, rig in found.items():
        covariance = shared_covariance(rig, light)
        if np.isfinite(covariance).all():
            size, direction = np.linalg.eigh(covariance)
            errors[name] = SharedError(rig, light, direction * np.sqrt(np.maximum(size, 0.0)))
    return errors


def sigma_of(response: Array) -> Array:
    """One sigma (…) of what answers with ``response`` (…, P) to unit errors."""
    return np.asarray(np.sqrt(np.sum(response**2, axis=-1)))
