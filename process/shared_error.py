"""Points in the body frame to the error that calibration and mount give them all: the same in every frame.

A point's error is J δ, with δ the errors of the pair's 24 parameters (``camera_model.PAIR_PARAMETER_NAMES``) and of
its pose's 6 in the body frame. δ is one draw for a whole flight, so that errors of two points, or of a marker at
two times, go together, and a displacement has the error (J₁ − J₂) δ: mostly far less than either.

The pose was fitted with the calibration at hand, and makes up for part of its errors where the surveyed lights were:
``RigSide.pose_by_calibration`` says how, and J holds it.

A place on the wing's surface is reached from the light above it. The errors of the lights' stand-off and roundness
(``bulb``) are shared, too: two more in δ for who asks with ``surface``.
"""

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import ArrayLike, NDArray

from process.bulb import by_light, light_covariance
from process.bundle import cross_matrix, lens_jacobian, turn_jacobian
from process.camera_model import PAIR_PARAMETER_NAMES, Light, MarkerLayout, Rig, RigSide, StereoPair

Array = NDArray[np.float64]

PARAMETERS = len(PAIR_PARAMETER_NAMES) + 6
METADATA_KEY = b"wingshape_rig"


@dataclass(frozen=True, eq=False)
class Surface:
    """What leads from N lights to the surface below them."""

    light: Light
    normals: Array
    """(N, 3) of the surface at the lights, see ``bulb.wing_normals``"""


def shared_covariance(side: RigSide, light: Light | None = None) -> Array:
    """Covariance (30, 30) of δ, (32, 32) with ``light``; NaN where calibration or survey did not estimate theirs."""
    covariance = np.zeros((PARAMETERS + 2, PARAMETERS + 2))
    covariance[:24, :24] = np.nan if side.pair.covariance is None else side.pair.covariance
    covariance[24:PARAMETERS, 24:PARAMETERS] = np.nan if side.pose_covariance is None else side.pose_covariance
    if light is None:
        return covariance[:PARAMETERS, :PARAMETERS]
    covariance[PARAMETERS:, PARAMETERS:] = light_covariance(light)
    return covariance


def shared_jacobian(side: RigSide, points_m: ArrayLike, surface: Surface | None = None) -> Array:
    """J (N, 3, 30), or (N, 3, 32) with ``surface``: metres of ``points_m`` (N, 3), body frame, by δ.

    ``points_m`` are the lights; with ``surface``, J is that of the places below them. NaN where a point is NaN or out
    of view. To first order, for triangulation with the same pixels by least reprojection errors: by the pair's
    parameters θ, dX/dθ = −A⁺ B with A, B the pixels' derivatives by the point and by θ.
    """
    points = np.asarray(points_m, np.float64).reshape(-1, 3)
    R, t = side.T_body_cam0[:3, :3], side.T_body_cam0[:3, 3]
    from_pair = points - t
    by_pair, by_pose = R @ triangulated_by_calibration(side.pair, from_pair @ R), np.zeros((len(points), 3, 6))
    by_pose[:, :, :3] = -cross_matrix(from_pair)
    by_pose[:, :, 3:] = np.eye(3)
    if side.pose_by_calibration is not None:
        by_pair = by_pair + by_pose @ side.pose_by_calibration
    parts = [by_pair, by_pose]
    if surface is not None:
        parts.append(by_light(side, points, surface.normals))
    return np.concatenate(parts, axis=2)


def point_covariance_m2(side: RigSide, points_m: ArrayLike, surface: Surface | None = None) -> Array:
    """Covariance (N, 3, 3) that lights (N, 3), or the places below them, have from what all frames share."""
    return _carried(side, shared_jacobian(side, points_m, surface), surface)


def displacement_covariance_m2(
    side: RigSide, from_m: ArrayLike, to_m: ArrayLike, surfaces: tuple[Surface, Surface] | None = None
) -> Array:
    """Covariance (N, 3, 3) of ``to_m`` − ``from_m`` (N, 3) from what all frames share; the noise of both adds to it.

    With ``surfaces``, at both, of the places below the lights: a stand-off's error moves them as the wing turns.
    """
    before, after = surfaces or (None, None)
    change = shared_jacobian(side, to_m, after) - shared_jacobian(side, from_m, before)
    return _carried(side, change, after)


def triangulated_by_calibration(pair: StereoPair, points_cam0: Array) -> Array:
    """(N, 3, 24) by the pair's parameters of points (N, 3), cam0's frame, triangulated from the same pixels.

    NaN where a point is NaN or not in front of both cameras.
    """
    R, t = pair.T_cam1_cam0[:3, :3], pair.T_cam1_cam0[:3, 3]
    turned = points_cam0 @ R.T
    slope0, slope1 = (
        camera.project_with_jacobian(seen)[1] for camera, seen in ((pair.cam0, points_cam0), (pair.cam1, turned + t))
    )
    by_point = np.concatenate([slope0, slope1 @ R], axis=1)
    good = np.isfinite(by_point).all(axis=(1, 2))
    parameters, by_parameters = pair.parameters, np.zeros((int(good.sum()), 4, 24))
    by_parameters[:, :2, :9] = lens_jacobian(points_cam0[good], parameters[:9])[0]
    by_parameters[:, 2:, 9:18] = lens_jacobian((turned + t)[good], parameters[9:18])[0]
    by_parameters[:, 2:, 18:21] = slope1[good] @ turn_jacobian(turned[good], parameters[18:21])
    by_parameters[:, 2:, 21:] = slope1[good]
    transposed = by_point[good].transpose(0, 2, 1)
    response = np.full((len(points_cam0), 3, 24), np.nan)
    response[good] = -np.linalg.solve(transposed @ by_point[good], transposed @ by_parameters)
    return response


def with_rig(table: pa.Table, rig: Rig) -> pa.Table:
    """The marker table with what the functions here need in its schema metadata, once a side."""
    sides = {side: rig.side(side).to_dict() for side in ("left", "right")}
    note = json.dumps({**sides, "markers": rig.markers.to_dict()}).encode()
    return table.replace_schema_metadata({**(table.schema.metadata or {}), METADATA_KEY: note})


def sides_of(table: pa.Table) -> dict[str, RigSide]:
    """``left`` and ``right`` that the marker table was measured with; empty for tables without (a truth's)."""
    note: dict[str, Any] = json.loads((table.schema.metadata or {}).get(METADATA_KEY, b"{}"))
    return {name: RigSide.from_dict(note[name]) for name in ("left", "right") if name in note}


def layout_of(table: pa.Table) -> MarkerLayout | None:
    """The markers that the marker table was measured with; None for tables that do not say (a truth's)."""
    note: dict[str, Any] = json.loads((table.schema.metadata or {}).get(METADATA_KEY, b"{}"))
    return MarkerLayout.from_dict(note["markers"]) if "markers" in note else None


def light_of(table: pa.Table) -> Light:
    """The lights that the marker table was measured from; without errors for tables that do not say (a truth's)."""
    layout = layout_of(table)
    return Light() if layout is None else layout.light


def _carried(side: RigSide, jacobian: Array, surface: Surface | None) -> Array:
    covariance = shared_covariance(side, None if surface is None else surface.light)
    return np.asarray(jacobian @ covariance @ jacobian.transpose(0, 2, 1))
