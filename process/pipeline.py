"""A recording to the marker table: frame sets are read, detected, matched and triangulated, by several processes.

The work is cut at every 50th trigger of each side, and matching starts afresh at each cut, so that the table does not
depend on how many processes made it.
"""

import os
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import pyarrow as pa

from capture.errors import ProcessError
from process.bulb import centres_m, wing_normals
from process.camera_model import MarkerLayout, Rig, RigSide
from process.detect import Detections, DetectSettings, detect
from process.flight_cameras import check_cameras
from process.fuselage_lights import without_lights
from process.match import UNSEEN, Matches, MatchSettings, Track, match
from process.recording import FrameSet, FrameSetReader, Recording, SetPlaces, open_recording
from process.set_time import marker_instants_ns, ptp_state, set_instant_ns, time_sigma_ns
from process.tables import MARKER_SCHEMA
from process.triangulate import triangulate_as
from process.workers import one_blas_thread

BLOCK_TRIGGERS = 50
BLOCKS_WORTH_A_PROCESS = 4  # starting one costs as much as processing a block or two
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class PipelineSettings:
    """The methods in use."""

    detection: DetectSettings = field(default_factory=DetectSettings)
    matching: MatchSettings = field(default_factory=MatchSettings)
    triangulation: Literal["default", "paper"] = "default"


@dataclass(frozen=True, eq=False)
class MarkersResult:
    """The marker table of a flight, and what there is to say about it."""

    table: pa.Table
    frame_sets: int
    seconds: float
    problems: tuple[str, ...]
    rejected: dict[str, int]
    """blobs turned down in detection, by reason"""


@dataclass
class _Block:
    """The rows that one block of triggers gave: a list of arrays a column."""

    columns: dict[str, list[Any]] = field(default_factory=lambda: {name: [] for name in MARKER_SCHEMA.names})
    frame_sets: int = 0
    problems: list[str] = field(default_factory=list)
    rejected: dict[str, int] = field(default_factory=dict)


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
    recording = open_recording(flight_paths)
    return markers_of_recording(recording, rig, settings or PipelineSettings(), progress, workers)


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
    blocks = list(_blocks(recording))
    total = sum(len(block) for block in blocks)
    workers = workers or min(os.cpu_count() or 1, len(blocks) // BLOCKS_WORTH_A_PROCESS)
    whole = _Block()
    for block in _run(blocks, rig, settings, workers):
        for name, parts in block.columns.items():
            whole.columns[name].extend(parts)
        whole.frame_sets += block.frame_sets
        whole.problems.extend(block.problems)
        for reason, count in block.rejected.items():
            whole.rejected[reason] = whole.rejected.get(reason, 0) + count
        if progress is not None:
            progress(whole.frame_sets, total)
    table = _table(whole)
    problems = (*recording.problems, *whole.problems)
    return MarkersResult(table, whole.frame_sets, time.monotonic() - began, problems, whole.rejected)


def _blocks(recording: Recording) -> Iterator[list[SetPlaces]]:
    """The recording's frame sets cut at multiples of ``BLOCK_TRIGGERS``, whichever of them are there."""
    for sets in recording.sides.values():
        block: list[SetPlaces] = []
        for places in sets:
            if block and places.trigger_index // BLOCK_TRIGGERS != block[0].trigger_index // BLOCK_TRIGGERS:
                yield block
                block = []
            block.append(places)
        yield block


def _run(blocks: list[list[SetPlaces]], rig: Rig, settings: PipelineSettings, workers: int) -> Iterator[_Block]:
    """The blocks' results, in order."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield from _run_here_and_there(blocks, rig, settings, workers)
    finally:
        cv2.setNumThreads(threads)


def _run_here_and_there(
    blocks: list[list[SetPlaces]], rig: Rig, settings: PipelineSettings, workers: int
) -> Iterator[_Block]:
    if workers <= 1:
        for block in blocks:
            yield _process_block(block, rig, settings)
        return
    with (
        one_blas_thread(),
        # spawned, not forked: a forked child inherits locks of the parent's threads
        ProcessPoolExecutor(workers - 1, get_context("spawn"), _set_up_worker, (rig, settings)) as pool,
    ):
        yield from _shared_out(blocks, rig, settings, pool, 2 * (workers - 1))


def _shared_out(
    blocks: list[list[SetPlaces]], rig: Rig, settings: PipelineSettings, pool: ProcessPoolExecutor, ahead: int
) -> Iterator[_Block]:
    """The blocks' results, in order; this process works, too, above all while the others are still starting.

    ``ahead`` blocks at most are handed to the pool at a time.
    """
    waiting = deque(enumerate(blocks))
    running: dict[Future[_Block], int] = {}
    done: dict[int, _Block] = {}
    for number in range(len(blocks)):
        while number not in done:
            while waiting and len(running) < ahead:
                place, block = waiting.popleft()
                running[pool.submit(_process_block_of_worker, block)] = place
            if waiting:
                place, block = waiting.popleft()
                done[place] = _process_block(block, rig, settings)
            else:
                wait(running, return_when=FIRST_COMPLETED)
            for future in [future for future in running if future.done()]:
                done[running.pop(future)] = future.result()
        yield done.pop(number)


_worker: tuple[Rig, PipelineSettings] | None = None


def _set_up_worker(rig: Rig, settings: PipelineSettings) -> None:
    global _worker
    cv2.setNumThreads(1)
    _worker = (rig, settings)


def _process_block_of_worker(block: list[SetPlaces]) -> _Block:
    assert _worker is not None
    return _process_block(block, *_worker)


def _process_block(places: list[SetPlaces], rig: Rig, settings: PipelineSettings) -> _Block:
    block = _Block()
    track: Track | None = None
    with FrameSetReader(reuse=True) as reader:
        for where in places:
            frames = reader.read(where)
            block.problems.extend(frames.problems)
            block.frame_sets += 1
            if all(moment is None for moment in frames.mid_exposures_ns):
                continue  # no frame could be read, so there is no time either: it is in the problems
            track = _process_set(block, frames, rig, settings, track)
    return block


def _process_set(
    block: _Block, frames: FrameSet, rig: Rig, settings: PipelineSettings, track: Track | None
) -> Track | None:
    side = rig.side(frames.side)
    _check_size(frames, side)
    if frames.images[0] is None or frames.images[1] is None:
        count = 2 * len(rig.markers.pairs_station_m)
        _append(block, frames, side, _unseen(count), None, settings, rig.markers)
        return track
    found = (detect(frames.images[0], settings.detection), detect(frames.images[1], settings.detection))
    for spots in found:
        for rejected in spots.rejected:
            reason = rejected.reason.split(":")[0]
            block.rejected[reason] = block.rejected.get(reason, 0) + 1
    found = without_lights(side, found)
    matched = match(frames.side, side, rig.markers, found, frames.trigger_index, track, settings.matching)
    _append(block, frames, side, matched, found, settings, rig.markers)
    return matched.track or track


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
    block: _Block,
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
    pixels = np.full((2, count, 2), np.nan)
    numbers = {"xyz": np.full((count, 3), np.nan), "cov": np.full((count, 3, 3), np.nan)}
    epipolar_px = np.full(count, np.nan)
    flags = ["no_frame" if found is None else "not_seen"] * count
    frame_ns = set_instant_ns(frames, side)
    timestamps_ns = np.full(count, frame_ns, dtype=np.int64)
    if found is not None and rows.size:
        spots = matched.spot0[rows], matched.spot1[rows]
        pixels[0, rows], pixels[1, rows] = found[0].pixels[spots[0]], found[1].pixels[spots[1]]
        assert matched.rays is not None
        points = triangulate_as(settings.triangulation, side, matched.rays[0][spots[0]], matched.rays[1][spots[1]])
        numbers["xyz"][rows], numbers["cov"][rows] = points.xyz_m, points.covariance_m2
        if layout.light.dome_radius_m > 0.0:
            normals = wing_normals(frames.side, layout, numbers["xyz"])
            numbers["xyz"][rows] = centres_m(side, layout.light, points.xyz_m, normals[rows])
        epipolar_px[rows] = points.epipolar_px
        timestamps_ns[rows] = marker_instants_ns(frames, side, pixels[0, rows, 1], pixels[1, rows, 1])
        for row, spot0, spot1, reason in zip(rows, *spots, points.reasons, strict=True):
            said = {reason, *found[0].flags[spot0].split(","), *found[1].flags[spot1].split(",")}
            said |= {"ambiguous"} if matched.ambiguous[row] else set()
            flags[row] = ",".join(sorted(said - {""}))
    columns = block.columns
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
        columns[f"u{camera}_px"].append(pixels[camera, :, 0])
        columns[f"v{camera}_px"].append(pixels[camera, :, 1])
    columns["epipolar_px"].append(epipolar_px)
    columns["flags"].append(np.array(flags, dtype=object))


def _table(whole: _Block) -> pa.Table:
    arrays = []
    for member in MARKER_SCHEMA:
        parts = whole.columns[member.name]
        arrays.append(pa.array(np.concatenate(parts) if parts else [], type=member.type))
    return pa.Table.from_arrays(arrays, schema=MARKER_SCHEMA)
