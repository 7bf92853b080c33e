"""What all frames share (calibration, mount, lights) → the errors it gives fitted shapes and their displacements.

The markers' error is J δ (``process.shared_error``), δ one draw for the whole flight. A fit follows its markers, so
that nodes and twist have the error R δ' with R the fit's response times J times a root of δ's covariance, and δ' a
vector of independent unit errors. A displacement between two sets has (R₂ − R₁) δ', mostly far less than either.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from process.camera_model import Light, RigSide
from process.shared_error import Surface, light_of, shared_covariance, shared_jacobian, sides_of
from reconstruct.fit import Fit, marker_places
from reconstruct.rotation import Array
from reconstruct.wing import HalfWing


@dataclass(frozen=True, eq=False)
class SharedError:
    """A side's, as the marker table states it."""

    rig: RigSide
    light: Light
    root: Array  # (P, P) root · rootᵀ is the covariance of δ

    def as_in(self, other: "SharedError") -> bool:
        """Whether both are the errors of one calibration, mount and kind of light, so that one draw is in both."""
        return self.light == other.light and self.rig.to_dict() == other.rig.to_dict()

    def of_shapes(self, half: HalfWing, fits: Sequence[Fit]) -> Array:
        """R (F, N + 1, 4, P): the shift of the nodes (m, body frame) and of their twist (rad) by each unit error.

        NaN where a fit did not converge.
        """
        nodes, markers = len(half.node_s_m), len(half.marker_ids)
        R = np.full((len(fits), nodes, 4, self.root.shape[1]), np.nan)
        good = [k for k, fit in enumerate(fits) if fit.converged]
        if not good:
            return R
        points = np.concatenate([marker_places(half, fits[k]) for k in good])
        up = np.concatenate([fits[k].R_body_section[half.marker_node][:, :, 2] for k in good])
        of_markers = shared_jacobian(self.rig, points, Surface(self.light, up)) @ self.root
        of_markers = np.where(np.isfinite(of_markers), of_markers, 0.0)  # out of view, and so not in use
        for k, own in zip(good, of_markers.reshape(len(good), 3 * markers, -1), strict=True):
            R[k] = fits[k].by_marker.reshape(nodes, 4, 3 * markers) @ own
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
