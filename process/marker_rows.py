"""Frame sets of one side, detected and matched, to their rows of the marker table: one for each marker."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from process.bulb import centres_m, wing_normals
from process.camera_model import MarkerLayout, RigSide
from process.detect import Detections
from process.fuselage_lights import LightSpots
from process.lone_spots import lone_spots
from process.match import UNSEEN, Indices, Matches, MatchSettings
from process.recording import FrameSet
from process.set_time import camera_instants_ns, marker_instants_ns, ptp_state, set_instant_ns, time_sigma_ns
from process.tables import MARKER_SCHEMA, PIXEL_COVARIANCES, ROW_TIMES
from process.triangulate import Method, Points, Rays, triangulate_as

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SeenSet:
    """A frame set, and what was found in it; its images are no longer needed."""

    frames: FrameSet
    detections: tuple[Detections, Detections] | None = None
    """None when it lacks a frame"""
    matches: Matches | None = None
    """of the detections, None when there are none"""
    lights: LightSpots | None = None
    """on the fuselage, which are not among the detections"""


def marker_rows(
    sets: Sequence[SeenSet], side: RigSide, layout: MarkerLayout, matching: MatchSettings, method: Method
) -> pa.Table:
    """``MARKER_SCHEMA`` rows of ``sets``, which all are of one side, in their order."""
    if not sets:
        return MARKER_SCHEMA.empty_table()
    count = 2 * len(layout.pairs_station_m)
    spots, doubtful = np.full((2, len(sets), count), UNSEEN, dtype=np.intp), np.zeros((len(sets), count), dtype=bool)
    both = np.zeros((len(sets), count), dtype=bool)
    for number, one in enumerate(sets):
        if one.detections is not None and one.matches is not None:
            both[number] = one.matches.seen
            lone = lone_spots(one.frames.side, side, layout, one.detections, one.matches, matching)
            for camera, matched in enumerate((one.matches.spot0, one.matches.spot1)):
                spots[camera, number] = np.where(lone.seen, lone.spot[camera], matched)
            doubtful[number] = np.where(lone.seen, lone.ambiguous, one.matches.ambiguous)
    found = _Spots(sets, spots)
    points = _points(sets, side, method)
    xyz_m, covariance_m2 = np.full((len(sets), count, 3), np.nan), np.full((len(sets), count, 3, 3), np.nan)
    epipolar_px = np.full((len(sets), count), np.nan)
    if points is not None:
        xyz_m[both], covariance_m2[both], epipolar_px[both] = points.xyz_m, points.covariance_m2, points.epipolar_px
        if layout.light.dome_radius_m > 0.0:
            normals = wing_normals(sets[0].frames.side, layout, xyz_m)
            xyz_m[both] = centres_m(side, layout.light, points.xyz_m, normals[both])
    return _table(
        {
            **_times(sets, side, found.pixels, both),
            **{f"{axis}_m": xyz_m[:, :, k] for k, axis in enumerate("xyz")},
            **{f"cov_{'xyz'[k]}{'xyz'[m]}_m2": covariance_m2[:, :, k, m] for k in range(3) for m in range(k, 3)},
            **{f"{axis}{camera}_px": found.pixels[camera, :, :, k] for camera in (0, 1) for k, axis in enumerate("uv")},
            **{
                PIXEL_COVARIANCES[3 * camera + at]: found.covariance_px2[camera, :, :, k, m]
                for camera in (0, 1)
                for at, (k, m) in enumerate(((0, 0), (0, 1), (1, 1)))
            },
            "epipolar_px": epipolar_px,
            "flags": _flags(sets, both, doubtful, found, points),
        },
        len(sets) * count,
    )


class _Spots:
    """What detection has to say of the markers' spots (2, S, M), by camera, set and marker."""

    def __init__(self, sets: Sequence[SeenSet], spots: Indices) -> None:
        shape = spots.shape
        self.there = spots != UNSEEN
        self.pixels, self.covariance_px2 = np.full((*shape, 2), np.nan), np.full((*shape, 2, 2), np.nan)
        self.flags = np.full(shape, "", dtype=object)
        for camera in (0, 1):
            own = [one.detections[camera] for one in sets if one.detections is not None]
            counts = [0 if one.detections is None else len(one.detections[camera]) for one in sets]
            there = self.there[camera]
            if there.any():
                at = (spots[camera] + (np.cumsum(counts) - counts)[:, None])[there]
                self.pixels[camera, there] = np.concatenate([one.pixels for one in own])[at]
                self.covariance_px2[camera, there] = np.concatenate([one.covariance_px2 for one in own])[at]
                self.flags[camera, there] = np.array([flag for one in own for flag in one.flags], dtype=object)[at]


def _points(sets: Sequence[SeenSet], side: RigSide, method: Method) -> Points | None:
    """Of all markers that both cameras saw, set by set; None if there is no such marker."""
    pieces = [one.matches for one in sets if one.matches is not None and one.matches.seen.any()]
    if not pieces:
        return None
    if method == "default" and all(one.points is not None for one in pieces):
        return Points.join([one.points for one in pieces if one.points is not None])
    seen: tuple[list[Rays], list[Rays]] = ([], [])
    for one in pieces:
        assert one.rays is not None
        for own, through, spot in zip(seen, one.rays, (one.spot0, one.spot1), strict=True):
            own.append(through[spot[one.seen]])
    return triangulate_as(method, side, Rays.join(seen[0]), Rays.join(seen[1]))


def _times(
    sets: Sequence[SeenSet], side: RigSide, pixels: Array, both: NDArray[np.bool_]
) -> dict[str, NDArray[Any] | list[str]]:
    """The columns that say which set a row is of, and when it was."""
    shape = both.shape
    frame_ns = np.array([set_instant_ns(one.frames, side) for one in sets], dtype=np.int64)
    own_ns = np.stack([camera_instants_ns(one.frames, side, pixels[:, k]) for k, one in enumerate(sets)], axis=1)
    timestamps_ns = np.broadcast_to(frame_ns[:, None], shape).copy()
    one_camera = np.isfinite(pixels[..., 0]) & ~both
    for camera in (0, 1):
        timestamps_ns[one_camera[camera]] = own_ns[camera, one_camera[camera]]
    for number in np.flatnonzero(both.any(axis=1)).tolist():
        rows = both[number]
        v0_px, v1_px = pixels[:, number, rows, 1]
        timestamps_ns[number, rows] = marker_instants_ns(sets[number].frames, side, v0_px, v1_px)
    count = shape[1]
    return {
        "trigger_index": np.repeat(np.array([one.frames.trigger_index for one in sets], dtype=np.int64), count),
        "side": [sets[0].frames.side] * (len(sets) * count),
        "marker": np.tile(np.arange(count, dtype=np.int32), len(sets)),
        "timestamp_ns": timestamps_ns,
        "frame_timestamp_ns": np.repeat(frame_ns, count),
        "time_sigma_ns": np.repeat([time_sigma_ns(one.frames) for one in sets], count),
        "ptp_state": [state for one in sets for state in [ptp_state(one.frames)] * count],
        **dict(zip(ROW_TIMES, own_ns, strict=True)),
    }


def _flags(
    sets: Sequence[SeenSet],
    both: NDArray[np.bool_],
    doubtful: NDArray[np.bool_],
    found: _Spots,
    points: Points | None,
) -> list[str]:
    """(S · M)"""
    flags = np.full(both.shape, "", dtype=object)
    flags[np.array([one.detections is None for one in sets])] = "no_frame"
    flags[np.array([one.detections is not None for one in sets])[:, None] & ~found.there.any(axis=0)] = "not_seen"
    flags[found.there.any(axis=0) & ~both] = "one_camera"
    if points is not None:
        flags[both] = points.reasons
    said = [flags, np.where(doubtful, "ambiguous", ""), *found.flags]
    several = doubtful | (found.flags != "").any(axis=0)
    for place in zip(*np.nonzero(several), strict=True):
        reasons = {reason for one in said for reason in one[place].split(",")}
        flags[place] = ",".join(sorted(reasons - {""}))
    return flags.ravel().tolist()


def _table(columns: dict[str, NDArray[Any] | list[str]], rows: int) -> pa.Table:
    arrays = []
    for member in MARKER_SCHEMA:
        values = columns[member.name]
        values = values if isinstance(values, list) else np.ascontiguousarray(values).reshape(rows)
        arrays.append(pa.array(values, type=member.type))
    return pa.Table.from_arrays(arrays, schema=MARKER_SCHEMA)
