"""Lights as triangulated to their centres and to the wing's surface below them: the bulb's geometry, and its errors.

A bulb stands off the surface that it is fixed to, and is round: its image is not a flat disc's. With n the surface's
normal at the light, d the direction to a camera and c = n·d = cos θ, the middle of its image is that of the point

    centre + b sin θ (n − c d) / (1 + c),        centre = base + s n,

with s the stand-off of its centre. The second part, b (1 − cos θ) across the line of sight, is exact for the outline of
a dome of radius r on a flat base, half a disc above the middle and half an ellipse below: b = 4 r / 3π. What grows with
sin θ instead cannot be told from stand-off, and is in s.
"""

import numpy as np
from numpy.typing import NDArray

from process.camera_model import Light, MarkerLayout, RigSide

Array = NDArray[np.float64]

LEAST_PAIRS = 3
DOME = 4.0 / (3.0 * np.pi)
"""b by r: the distance of a half disc's centroid from its middle"""


def wing_normals(side_name: str, layout: MarkerLayout, lights_m: Array) -> Array:
    """Unit normals (…, M, 3), towards the wing's upper side, at its markers (…, M, 3), body frame.

    Of the plane through a pair's chord and the parabola through its own and both next stations. A light that was not
    seen (NaN) is made up for by the three nearest of its row; NaN where a row has fewer, or the wing a single pair.
    """
    stations = np.array(layout.pairs_station_m)
    if len(stations) < LEAST_PAIRS:
        return np.full(lights_m.shape, np.nan)
    fore, aft = (_completed(lights_m[..., row::2, :], stations) for row in (0, 1))
    outboard = np.gradient(fore + aft, stations, axis=-2, edge_order=2)
    up = np.cross(outboard, fore - aft) if side_name == "right" else np.cross(fore - aft, outboard)
    return np.repeat(up / np.linalg.norm(up, axis=-1, keepdims=True), 2, axis=-2)


def by_dome(side: RigSide, points_m: Array, normals: Array) -> Array:
    """(N, 3) what a triangulated point moves by a metre of b; NaN where a point or a normal is NaN, or out of view.

    Each camera sees the light elsewhere; the point nearest to both in pixels is what triangulation makes of it.
    """
    slopes, moved = _dome_in_images(side, points_m, normals)
    by_point, by_b = slopes.reshape(-1, 4, 3), moved.reshape(-1, 4)
    good = np.isfinite(by_point).all(axis=(1, 2)) & np.isfinite(by_b).all(axis=1)
    response = np.full((len(by_point), 3), np.nan)
    transposed = by_point[good].transpose(0, 2, 1)
    response[good] = np.linalg.solve(transposed @ by_point[good], transposed @ by_b[good, :, None])[:, :, 0]
    return response


def centres_m(side: RigSide, light: Light, points_m: Array, normals: Array) -> Array:
    """(N, 3) the centres of lights that were triangulated at ``points_m``; as they are where no normal is known."""
    if light.dome_radius_m == 0.0:
        return points_m
    shift = DOME * light.dome_radius_m * by_dome(side, points_m, normals)
    return np.asarray(points_m - np.where(np.isfinite(shift), shift, 0.0))


def centre_pixels(side: RigSide, layout: MarkerLayout, side_name: str, lights_m: Array, pixels: Array) -> Array:
    """Pixels (F, M, 2, 2) of marker, camera, (u, v), as they would be of the lights' centres.

    Args:
        side: the cameras.
        layout: of the M markers.
        side_name: left or right.
        lights_m: (F, M, 3) their places, body frame; NaN where not both cameras saw one: made up for by its row.
        pixels: as seen; what no place or normal is known of stays as it is.
    """
    if layout.light.dome_radius_m == 0.0 or len(layout.pairs_station_m) < LEAST_PAIRS:
        return pixels
    whole = all_places(layout, lights_m)
    normals = wing_normals(side_name, layout, whole)
    _, by_b = _dome_in_images(side, whole.reshape(-1, 3), normals.reshape(-1, 3))
    shift = DOME * layout.light.dome_radius_m * by_b.reshape(pixels.shape)
    return np.asarray(pixels - np.where(np.isfinite(shift), shift, 0.0))


def all_places(layout: MarkerLayout, lights_m: Array) -> Array:
    """(F, M, 3) of lights; those that are NaN are made up for by the three nearest of their row, if it has three."""
    stations = np.array(layout.pairs_station_m)
    rows = [_completed(lights_m[:, row::2], stations) for row in (0, 1)]
    return np.stack(rows, axis=2).reshape(lights_m.shape)


def bases_m(light: Light, centres: Array, normals: Array) -> Array:
    """(…, 3) places on the surface below light ``centres`` (…, 3)."""
    return np.asarray(centres - light.standoff_m * normals)


def light_covariance(light: Light) -> Array:
    """(2, 2) of the errors of stand-off and b: the same for all lights of a side, which are of one kind."""
    return np.diag([light.standoff_sigma_m**2, (DOME * light.dome_sigma_m) ** 2])


def by_light(side: RigSide, points_m: Array, normals: Array) -> Array:
    """(N, 3, 2) places on the surface by the errors of stand-off and b."""
    return np.stack([-normals, -by_dome(side, points_m, normals)], axis=2)


def _dome_in_images(side: RigSide, points_m: Array, normals: Array) -> tuple[Array, Array]:
    """(N, 2, 2, 3) pixels in both cameras by the place of lights (N, 3), and (N, 2, 2) by a metre of b."""
    T = side.T_body_cam0
    points = np.asarray(points_m, np.float64).reshape(-1, 3)
    in_cam0 = (points - T[:3, 3]) @ T[:3, :3]
    T10 = side.pair.T_cam1_cam0
    in_cam1 = in_cam0 @ T10[:3, :3].T + T10[:3, 3]
    R1 = T[:3, :3] @ T10[:3, :3].T  # cam1's axes in the body frame
    slopes, moved = [], []
    for camera, seen, R in ((side.pair.cam0, in_cam0, T[:3, :3]), (side.pair.cam1, in_cam1, R1)):
        slope = camera.project_with_jacobian(seen)[1] @ R.T
        towards = -(seen / np.linalg.norm(seen, axis=1, keepdims=True)) @ R.T
        cosine = np.sum(towards * normals, axis=1, keepdims=True)
        across = normals - cosine * towards
        offset = across * np.linalg.norm(across, axis=1, keepdims=True) / (1.0 + cosine)
        slopes.append(slope)
        moved.append((slope @ offset[:, :, None])[:, :, 0])
    return np.stack(slopes, axis=1), np.stack(moved, axis=1)


def _completed(row_m: Array, stations: Array) -> Array:
    """Lights (…, P, 3) of a row, those that are NaN on the parabola through the three nearest known ones."""
    known = np.asarray(np.isfinite(row_m).all(axis=-1))
    whole = row_m.copy()
    for place in zip(*np.nonzero(~known), strict=True):
        frame = place[:-1]
        there = np.flatnonzero(known[frame])
        if len(there) >= LEAST_PAIRS:
            near = there[np.argsort(np.abs(stations[there] - stations[place[-1]]), kind="stable")[:LEAST_PAIRS]]
            along = stations[near] - stations[place[-1]]
            whole[place] = np.linalg.solve(np.vander(along), row_m[frame][near])[-1]
    return whole
