"""A recording to the marker table: frame sets are read, detected, matched and triangulated, by several processes.

The work is cut at every 50th trigger of each side, and matching starts afresh at each cut, so that the table does not
depend on how many processes made it.
"""

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from capture.errors import ProcessError
from process.bulb import centres_m, wing_normals
from process.camera_model import MarkerLayout, Rig, RigSide
from process.detect import Detections, DetectSettings, detect_all
from process.flight_cameras import check_cameras
from process.fuselage_lights import LIGHTS_SCHEMA, LightSpots, light_spots, lights_table
from process.lone_spots import lone_spots
from process.match import UNSEEN, Matches, MatchSettings, Sighting, Track, match_sighting, sightings
from process.recording import FrameSet, FrameSetReader, Recording, SetPlaces, open_recording
from process.set_time import camera_instants_ns, marker_instants_ns, ptp_state, set_instant_ns, time_sigma_ns
from process.tables import MARKER_SCHEMA, PIXEL_COVARIANCES, ROW_TIMES
from process.triangulate import Method, triangulate_as
from process.workers import Shared, crew, usable_cores

BLOCK_TRIGGERS = 50
GROUP_SETS = 5  # measured together: reads are large, and what a call costs is shared
BLOCKS_WORTH_A_PROCESS = 4  # starting one costs as much as processing a block or two
_kept = threading.local()
Array = NDArray[np.float64]
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class PipelineSettings:
    """The methods in use."""

    detection: DetectSettings = field(default_factory=DetectSettings)
    matching: MatchSettings = field(default_factory=MatchSettings)
    triangulation: Method = "default"


@dataclass(frozen=True, eq=False)
class MarkersResult:
    """The marker table of a flight, and what there is to say about it."""

    table: pa.Table
    frame_sets: int
    seconds: float
    problems: tuple[str, ...]
    rejected: dict[str, int]
    """blobs turned down in detection, by reason"""
    lights: pa.Table = field(default_factory=LIGHTS_SCHEMA.empty_table)
    """spots of the lights on the fuselage (``LIGHTS_SCHEMA``)"""


@dataclass(frozen=True)
class Block:
    """The frame sets of one side that are measured one after the other."""

    side: str
    number: int
    places: tuple[SetPlaces, ...]

    @property
    def name(self) -> str:
        """Of what it gives."""
        return f"{self.side}-{self.number:06d}"


@dataclass(frozen=True)
class BlockJob:
    """A block, and how it is measured."""

    block: Block
    how: Shared[tuple[Rig, PipelineSettings]]


@dataclass(frozen=True, eq=False)
class BlockResult:
    """A block's rows of the marker table."""

    table: pa.Table
    frame_sets: int
    problems: tuple[str, ...]
    rejected: dict[str, int]
    lights: pa.Table


@dataclass
class _Rows:
    """Rows as they come: a list of arrays a column."""

    columns: dict[str, list[Any]] = field(default_factory=lambda: {name: [] for name in MARKER_SCHEMA.names})
    problems: list[str] = field(default_factory=list)
    rejected: Counter[str] = field(default_factory=Counter)
    lights: list[tuple[int, int, LightSpots]] = field(default_factory=list)


def markers(
    flight_paths: Sequence[Path | str],
    rig: Rig,
    settings: PipelineSettings | None = None,
    progress: Progress | None = None,
    workers: int | None = None,
) -> MarkersResult:
    """The marker table (``MARKER_SCHEMA``) of a flight.

    For every trigger and side with at least one frame, one row for each marker of the rig's layout.

    Args:
        flight_paths: the flight's folders.
        rig: cameras and layout.
        settings: the methods; None for the defaults.
        progress: called with (frame sets done, frame sets in all).
        workers: processes; None for as many as there are cores, or fewer for a short flight.

    Raises:
        ProcessError: no recording, or it does not fit the rig (image size).
    """
    return markers_of_recording(open_recording(flight_paths), rig, settings or PipelineSettings(), progress, workers)


def markers_of_recording(
    recording: Recording,
    rig: Rig,
    settings: PipelineSettings,
    progress: Progress | None = None,
    workers: int | None = None,
) -> MarkersResult:
    """``markers`` of a recording that is open already."""
    check_cameras(recording.files, rig)
    began = time.monotonic()
    todo = blocks(recording)
    total = sum(len(block.places) for block in todo)
    how = Shared((rig, settings))
    workers = workers or min(usable_cores(), len(todo) // BLOCKS_WORTH_A_PROCESS)
    found: dict[tuple[str, int], BlockResult] = {}
    done = 0
    with crew(workers, modules=(__name__,)) as hands:
        for number, result in hands.results(measure_block, (BlockJob(block, how) for block in todo)):
            found[todo[number].side, todo[number].number] = result
            done += result.frame_sets
            if progress is not None:
                progress(done, total)
    results = [found[key] for key in sorted(found)]
    rejected: Counter[str] = Counter()
    for result in results:
        rejected.update(result.rejected)
    problems = (*recording.problems, *(problem for result in results for problem in result.problems))
    table = pa.concat_tables([result.table for result in results])
    lights = pa.concat_tables([result.lights for result in results])
    return MarkersResult(table, done, time.monotonic() - began, problems, dict(rejected), lights)


def blocks(recording: Recording) -> list[Block]:
    """The recording's frame sets cut at multiples of ``BLOCK_TRIGGERS``, whichever of them are there; sides in turn."""
    found = []
    for side, sets in recording.sides.items():
        for number, members in groupby(sets, lambda places: places.trigger_index // BLOCK_TRIGGERS):
            found.append(Block(side, number, tuple(members)))
    return sorted(found, key=lambda block: (block.number, block.side))


def measure_block(job: BlockJob) -> BlockResult:
    """The rows of one block. Raises ProcessError when its images do not fit the rig."""
    rig, settings = job.how.get()
    into = _Rows()
    track: Track | None = None
    for some in _loaded(job.block.places):
        into.problems.extend(problem for frames in some for problem in frames.problems)
        # without any frame there is no time either: it is in the problems
        timed = [frames for frames in some if any(moment is not None for moment in frames.mid_exposures_ns)]
        track = _process_sets(into, timed, rig, settings, track)
    lights = lights_table(job.block.side, rig.side(job.block.side), into.lights)
    return BlockResult(_table(into), len(job.block.places), tuple(into.problems), dict(into.rejected), lights)


def _loaded(places: Sequence[SetPlaces]) -> Iterator[list[FrameSet]]:
    """The frame sets, GROUP_SETS at a time, valid until the next; the next ones' bytes are on their way meanwhile."""
    groups = [places[begin : begin + GROUP_SETS] for begin in range(0, len(places), GROUP_SETS)]
    with _reader("even") as one, _reader("odd") as other, ThreadPoolExecutor(1, "read-ahead") as ahead:
        waiting = ahead.submit(one.load, groups[0])
        for number, group in enumerate(groups):
            reader, following = (one, other) if number % 2 == 0 else (other, one)
            waiting.result()
            if number + 1 < len(groups):
                waiting = ahead.submit(following.load, groups[number + 1])
            yield [reader.read(where) for where in group]


def _reader(name: str) -> FrameSetReader:
    """A reader of this thread's, whose memory all its blocks use in turn: new memory costs as much as reading it."""
    if not hasattr(_kept, name):
        setattr(_kept, name, FrameSetReader())
    reader: FrameSetReader = getattr(_kept, name)
    return reader


def _process_sets(
    into: _Rows, sets: Sequence[FrameSet], rig: Rig, settings: PipelineSettings, track: Track | None
) -> Track | None:
    """Add the rows of some sets of one side; returns what the next ones' matching starts from."""
    whole = []
    images = []
    for frames in sets:
        _check_size(frames, rig.side(frames.side))
        image0, image1 = frames.images
        if image0 is not None and image1 is not None:
            whole.append(frames)
            images += [image0, image1]
    spots = detect_all(images, settings.detection)
    for found in spots:
        into.rejected.update(rejected.reason.split(":")[0] for rejected in found.rejected)
    seen = _sightings(into, whole, spots, rig, settings)
    for frames in sets:
        side = rig.side(frames.side)
        sighting = seen.get(frames.trigger_index)
        if sighting is None:
            count = 2 * len(rig.markers.pairs_station_m)
            _append(into, frames, side, _unseen(count), None, settings, rig.markers)
            continue
        matched = match_sighting(
            frames.side, side, rig.markers, sighting, frames.trigger_index, track, settings.matching
        )
        _append(into, frames, side, matched, sighting.detections, settings, rig.markers)
        track = matched.track or track
    return track


def _sightings(
    into: _Rows, whole: Sequence[FrameSet], spots: Sequence[Detections], rig: Rig, settings: PipelineSettings
) -> dict[int, Sighting]:
    """By trigger index, of sets with both frames, of which ``spots`` were found in turn; takes note of the fuselage."""
    if not whole:
        return {}
    name = whole[0].side
    side = rig.side(name)
    pairs = []
    for frames, pair in zip(whole, zip(spots[0::2], spots[1::2], strict=True), strict=True):
        lights, others = light_spots(side, pair)
        pairs.append(others)
        if side.references:
            into.lights.append((frames.trigger_index, set_instant_ns(frames, side), lights))
    found = sightings(name, side, rig.markers, pairs, settings.matching)
    return {frames.trigger_index: one for frames, one in zip(whole, found, strict=True)}


def _check_size(frames: FrameSet, side: RigSide) -> None:
    for image, camera, name in zip(frames.images, (side.pair.cam0, side.pair.cam1), ("cam0", "cam1"), strict=True):
        if image is not None and image.shape != (camera.height, camera.width):
            raise ProcessError(
                f"{frames.side}/{name}: images are {image.shape[1]} × {image.shape[0]}, the rig was calibrated at"
                f" {camera.width} × {camera.height}; use the rig file of this flight"
            )


def _unseen(count: int) -> Matches:
    nobody = np.full(count, UNSEEN, dtype=np.intp)
    return Matches(nobody, nobody, np.full(count, np.nan), np.zeros(count, dtype=bool), None)


def _append(
    into: _Rows,
    frames: FrameSet,
    side: RigSide,
    matched: Matches,
    found: tuple[Detections, Detections] | None,
    settings: PipelineSettings,
    layout: MarkerLayout,
) -> None:
    """Add a row for each marker of a frame set."""
    count = len(matched.spot0)
    rows = np.flatnonzero(matched.seen)
    spots = np.stack([matched.spot0, matched.spot1])
    numbers = {"xyz": np.full((count, 3), np.nan), "cov": np.full((count, 3, 3), np.nan)}
    epipolar_px = np.full(count, np.nan)
    flags = ["no_frame" if found is None else "not_seen"] * count
    frame_ns = set_instant_ns(frames, side)
    timestamps_ns = np.full(count, frame_ns, dtype=np.int64)
    if found is not None:
        lone = lone_spots(frames.side, side, layout, found, matched, settings.matching)
        spots = np.where(lone.seen, lone.spot, spots)
        for row in np.flatnonzero(lone.seen):
            flags[row] = _flag("one_camera", "ambiguous" if lone.ambiguous[row] else "", *_said(found, spots[:, row]))
    pixels, spread = _centroids(found, spots)
    own_ns = camera_instants_ns(frames, side, pixels)
    if found is not None and rows.size:
        assert matched.rays is not None
        points = matched.points
        if points is None or settings.triangulation != "default":
            rays = matched.rays[0][spots[0, rows]], matched.rays[1][spots[1, rows]]
            points = triangulate_as(settings.triangulation, side, *rays)
        numbers["xyz"][rows], numbers["cov"][rows] = points.xyz_m, points.covariance_m2
        if layout.light.dome_radius_m > 0.0:
            normals = wing_normals(frames.side, layout, numbers["xyz"])
            numbers["xyz"][rows] = centres_m(side, layout.light, points.xyz_m, normals[rows])
        epipolar_px[rows] = points.epipolar_px
        timestamps_ns[rows] = marker_instants_ns(frames, side, pixels[0, rows, 1], pixels[1, rows, 1])
        for row, reason in zip(rows, points.reasons, strict=True):
            flags[row] = _flag(reason, "ambiguous" if matched.ambiguous[row] else "", *_said(found, spots[:, row]))
    alone = (spots != UNSEEN).sum(axis=0) == 1
    timestamps_ns[alone] = np.where(spots[0] != UNSEEN, *own_ns)[alone]
    columns = into.columns
    columns["trigger_index"].append(np.full(count, frames.trigger_index, dtype=np.int64))
    columns["side"].append(np.full(count, frames.side))
    columns["marker"].append(np.arange(count, dtype=np.int32))
    columns["timestamp_ns"].append(timestamps_ns)
    columns["frame_timestamp_ns"].append(np.full(count, frame_ns, dtype=np.int64))
    columns["time_sigma_ns"].append(np.full(count, time_sigma_ns(frames)))
    columns["ptp_state"].append(np.full(count, ptp_state(frames)))
    for k, axis in enumerate("xyz"):
        columns[f"{axis}_m"].append(numbers["xyz"][:, k])
        for m in range(k, 3):
            columns[f"cov_{axis}{'xyz'[m]}_m2"].append(numbers["cov"][:, k, m])
    for camera in range(2):
        columns[ROW_TIMES[camera]].append(own_ns[camera])
        for at, axis in enumerate("uv"):
            columns[f"{axis}{camera}_px"].append(pixels[camera, :, at])
        for at, axes in enumerate(((0, 0), (0, 1), (1, 1))):
            columns[PIXEL_COVARIANCES[3 * camera + at]].append(spread[camera, :, *axes])
    columns["epipolar_px"].append(epipolar_px)
    columns["flags"].append(np.array(flags, dtype=object))


def _centroids(found: tuple[Detections, Detections] | None, spots: NDArray[np.intp]) -> tuple[Array, Array]:
    """Pixels (2, M, 2) and covariances (2, M, 2, 2) of the spots (2, M); NaN where there is none."""
    pixels, spread = np.full((*spots.shape, 2), np.nan), np.full((*spots.shape, 2, 2), np.nan)
    for camera in range(2 if found is not None else 0):
        assert found is not None
        there = spots[camera] != UNSEEN
        pixels[camera, there] = found[camera].pixels[spots[camera, there]]
        spread[camera, there] = found[camera].covariance_px2[spots[camera, there]]
    return pixels, spread


def _said(found: tuple[Detections, Detections], spots: NDArray[np.intp]) -> list[str]:
    """What detection has to say of a marker's spots (2,)."""
    return [
        flag for camera, spot in enumerate(spots) if spot != UNSEEN for flag in found[camera].flags[spot].split(",")
    ]


def _flag(*reasons: str) -> str:
    return ",".join(sorted({*reasons} - {""}))


def _table(into: _Rows) -> pa.Table:
    arrays = []
    for member in MARKER_SCHEMA:
        parts = into.columns[member.name]
        arrays.append(pa.array(np.concatenate(parts) if parts else [], type=member.type))
    return pa.Table.from_arrays(arrays, schema=MARKER_SCHEMA)
