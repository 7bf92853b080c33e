"""A recording to the marker table: frame sets are read, detected, matched and triangulated, by several processes.

The work is cut at every 50th trigger of each side, and matching starts afresh at each cut, so that the table does not
depend on how many processes made it.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby, islice
from pathlib import Path

import pyarrow as pa

from capture.errors import ProcessError
from process.camera_model import Rig, RigSide
from process.detect import Detections, DetectSettings, Pixels, detect_all
from process.flight_cameras import check_cameras
from process.fuselage_lights import LIGHTS_SCHEMA, light_spots, lights_table
from process.marker_rows import SeenSet, marker_rows
from process.match import MatchSettings, Track, match_sighting, sightings
from process.read_ahead import loaded
from process.recording import FrameSet, Recording, SetPlaces, open_recording
from process.set_time import set_instant_ns
from process.triangulate import Method
from process.workers import Shared, crew, usable_cores

BLOCK_TRIGGERS = 50
GROUP_SETS = 10  # measured together: what a call costs is shared
BLOCKS_WORTH_A_PROCESS = 4  # starting one costs as much as processing a block or two
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
    problems: list[str] = []
    sets = []
    frame_sets = loaded(job.block.places)
    for _ in range(0, len(job.block.places), GROUP_SETS):
        sets += _detected(islice(frame_sets, GROUP_SETS), problems, rig, settings.detection)
    seen, rejected = _seen(job.block.side, sets, rig, settings)
    side = rig.side(job.block.side)
    table = marker_rows(seen, side, rig.markers, settings.matching, settings.triangulation)
    lit = [(one.frames.trigger_index, set_instant_ns(one.frames, side), one.lights) for one in seen if one.lights]
    lights = lights_table(job.block.side, side, lit if side.references else ())
    return BlockResult(table, len(job.block.places), tuple(problems), dict(rejected), lights)


def _detected(
    some: Iterator[FrameSet], problems: list[str], rig: Rig, settings: DetectSettings
) -> list[tuple[FrameSet, tuple[Detections, Detections] | None]]:
    """Sets without their images, and what was found in these; None if one is missing.

    Raises ProcessError when they do not fit the rig.
    """
    sets = []

    def images() -> Iterator[Pixels]:
        for frames in some:
            problems.extend(frames.problems)
            # without any frame there is no time either: it is in the problems
            if any(moment is not None for moment in frames.mid_exposures_ns):
                _check_size(frames, rig.side(frames.side))
                image0, image1 = frames.images
                whole = image0 is not None and image1 is not None
                sets.append((replace(frames, images=(None, None)), whole))
                if image0 is not None and image1 is not None:
                    yield from (image0, image1)

    spots = iter(detect_all(images(), settings))
    return [(frames, (next(spots), next(spots)) if whole else None) for frames, whole in sets]


def _seen(
    side_name: str,
    sets: Sequence[tuple[FrameSet, tuple[Detections, Detections] | None]],
    rig: Rig,
    settings: PipelineSettings,
) -> tuple[list[SeenSet], Counter[str]]:
    """Sets of a side, matched one after the other; and the blobs that were turned down, by reason."""
    side = rig.side(side_name)
    pairs = [pair for _, pair in sets if pair is not None]
    rejected = Counter(one.reason.split(":")[0] for pair in pairs for spots in pair for one in spots.rejected)
    parted = [light_spots(side, pair) for pair in pairs]
    others = [own for _, own in parted]
    sighted = iter(sightings(side_name, side, rig.markers, others, settings.matching) if others else ())
    lights = iter(own for own, _ in parted)
    seen = []
    track: Track | None = None
    for frames, found in sets:
        if found is None:
            seen.append(SeenSet(frames))
            continue
        one = next(sighted)
        matched = match_sighting(side_name, side, rig.markers, one, frames.trigger_index, track, settings.matching)
        track = matched.track or track
        seen.append(SeenSet(frames, one.detections, matched, next(lights)))
    return seen, rejected


def _check_size(frames: FrameSet, side: RigSide) -> None:
    for image, camera, name in zip(frames.images, (side.pair.cam0, side.pair.cam1), ("cam0", "cam1"), strict=True):
        if image is not None and image.shape != (camera.height, camera.width):
            raise ProcessError(
                f"{frames.side}/{name}: images are {image.shape[1]} × {image.shape[0]}, the rig was calibrated at"
                f" {camera.width} × {camera.height}; use the rig file of this flight"
            )
