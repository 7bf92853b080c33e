"""A recorded flight to frame sets: the frames of a side's two cameras that one trigger exposed."""

import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from capture.errors import ProcessError
from capture.record import CAMERAS, LOSS_TOPIC, SIDES, Frame, Loss, decode_image, frame_topic, image_topic
from process.mcap_file import BadChunk, ChunkReader, MessageHead, Place, index_file

Pixels = NDArray[np.uint8]
SAMPLE_BYTES = 1e9
INDEXED_AT_ONCE = 4  # files
SEARCH_DEPTH = 2  # folders below the one named


@dataclass(frozen=True, eq=False)
class FrameSet:
    """What one trigger gave on one side. A frame that is lost, or cannot be read, is None in each pair."""

    side: str
    trigger_index: int
    images: tuple[Pixels | None, Pixels | None]
    """(H, W) of cam0 and cam1, views of the bytes read"""
    frames: tuple[Frame | None, Frame | None]
    """what the recorder knew of them; None in recordings of images only"""
    mid_exposures_ns: tuple[int | None, int | None]
    """middle of row 0's exposure, UTC"""
    problems: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class SetPlaces:
    """Where a frame set lies on disk: small, so that it can be handed to another process."""

    side: str
    trigger_index: int
    images: tuple[Place | None, Place | None]
    frames: tuple[Place | None, Place | None]


@dataclass(frozen=True)
class Recording:
    """An indexed flight."""

    sides: dict[str, tuple[SetPlaces, ...]]
    """frame sets of each recorded side, by trigger index"""
    problems: tuple[str, ...]
    """what is missing or unreadable, one line each"""
    files: tuple[Path, ...]
    fingerprints: dict[str, str] = field(default_factory=dict)
    """of each file: SHA-256 over the CRCs of its chunks, which reading verifies"""
    duration_s: float = 0.0
    """from the first trigger to the last"""

    def frame_sets(self, side: str) -> Iterator[FrameSet]:
        """The side's frame sets in trigger order, read from disk as they are asked for."""
        with FrameSetReader() as reader:
            for places in self.sides[side]:
                yield reader.read(places)


class FrameSetReader:
    """Reads frame sets from their places."""

    def __init__(self) -> None:
        self._reader = ChunkReader()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._reader.close()

    def load(self, sets: Sequence[SetPlaces]) -> None:
        """Read the bytes of several sets at once; images of the sets loaded before are no longer valid."""
        self._reader.load(_places(sets))

    def cached(self, sets: Sequence[SetPlaces]) -> bool:
        """Whether loading several sets need not wait for the disk."""
        return self._reader.cached(_places(sets))

    def read(self, places: SetPlaces) -> FrameSet:
        """The frame set; a frame that fails its CRC is None, and told in ``problems``.

        Raises:
            ProcessError: an image is not 8-bit greyscale.
        """
        images: list[Pixels | None] = [None, None]
        frames: list[Frame | None] = [None, None]
        times_ns: list[int | None] = [None, None]
        problems = []
        for camera in range(len(CAMERAS)):
            image_place, frame_place = places.images[camera], places.frames[camera]
            if image_place is None:
                continue
            try:
                if frame_place is not None:
                    frames[camera] = Frame.decode(self._reader.read(frame_place))
                images[camera], stamp_ns = _read_image(self._reader, image_place)
                frame = frames[camera]
                times_ns[camera] = stamp_ns if frame is None else frame.mid_exposure_ns
            except (ValueError, OSError) as error:
                images[camera] = frames[camera] = times_ns[camera] = None
                problems.append(
                    f"{image_place.path}: the frame of trigger {places.trigger_index} at byte {image_place.chunk_at}"
                    f" is not readable ({error})"
                )
        return FrameSet(
            places.side,
            places.trigger_index,
            (images[0], images[1]),
            (frames[0], frames[1]),
            (times_ns[0], times_ns[1]),
            tuple(problems),
        )


def open_recording(paths: Sequence[Path | str]) -> Recording:
    """Index a flight: MCAP files, or folders that are searched for them two levels deep.

    The trigger index is the messages' sequence number. In a recording of images only, by another recorder, it is the
    rank of the instant: images whose header stamps are within half a frame period belong together.

    Raises:
        ProcessError: nothing is there, or nothing of it is a recording.
    """
    files = find_files(paths)
    places: dict[tuple[str, int], _CameraPlaces] = {
        (side, camera): _CameraPlaces() for side in SIDES for camera in range(len(CAMERAS))
    }
    losses: set[tuple[int, str, str, str]] = set()
    problems: list[str] = []
    fingerprints: dict[str, str] = {}
    owner = {image_topic(s, CAMERAS[c]): places[s, c].images for s, c in places}
    owner |= {frame_topic(s, CAMERAS[c]): places[s, c].frames for s, c in places}
    with ThreadPoolExecutor(INDEXED_AT_ONCE) as pool:  # from the disk it is waiting, mostly
        indexes = list(pool.map(lambda path: index_file(path, {*owner, LOSS_TOPIC}), files))
    for path, index in zip(files, indexes, strict=True):
        problems.extend(index.problems)
        fingerprints[str(path)] = index.fingerprint
        losses |= _losses([head for head in index.messages if head.topic == LOSS_TOPIC])
        for head in index.messages:
            if head.topic in owner:
                owner[head.topic].append(head)
    if not any(camera.images for camera in places.values()):
        reasons = f" ({problems[0]})" if problems else ""
        where = ", ".join(str(path) for path in paths)
        raise ProcessError(f"{where}: no camera's images in its recording{reasons}; name the folder of a flight")
    if any(camera.frames for camera in places.values()):
        numbered = {key: _by_sequence(key, camera, problems) for key, camera in places.items()}
    else:
        numbered = _by_stamp(places, problems)
        problems.append("only image topics: triggers numbered by time, exposure unknown, times from the header stamps")
    times_ns = [head.publish_time_ns for camera in places.values() for head in camera.images]
    sides = _frame_sets(numbered)
    problems.extend(_missing_frames(sides, losses))
    return Recording(sides, tuple(problems), files, fingerprints, (max(times_ns) - min(times_ns)) * 1e-9)


def reading_s(recording: Recording, threads: int) -> float:
    """Seconds that reading all of the recording's frames takes, and nothing else, by so many threads.

    Scaled up from SAMPLE_BYTES spread over it; as they are now, in the page cache or not.
    """
    sets = [places for own in recording.sides.values() for places in own]
    sizes = [sum(place.chunk_size for place in one.images if place is not None) for one in sets]
    wanted = max(threads, round(len(sets) * min(1.0, SAMPLE_BYTES / max(1, sum(sizes)))))
    picked = np.unique(np.linspace(0, len(sets) - 1, wanted).round().astype(int)).tolist()

    def read(share: list[int]) -> None:
        with FrameSetReader() as reader:
            for number in share:
                reader.load([sets[number]])

    began = time.monotonic()
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(read, [picked[first::threads] for first in range(threads)]))
    part = sum(sizes[number] for number in picked) / max(1, sum(sizes))
    return float((time.monotonic() - began) / part)


def find_files(paths: Sequence[Path | str]) -> tuple[Path, ...]:
    """The MCAP files among and under ``paths``, in order, each once. ProcessError where there is none."""
    found: dict[Path, Path] = {}
    for given in paths:
        path = Path(given)
        if path.is_file():
            here = [path]
        elif path.is_dir():
            patterns = ["/".join(["*"] * depth + ["*.mcap"]) for depth in range(SEARCH_DEPTH + 1)]
            here = [file for pattern in patterns for file in sorted(path.glob(pattern)) if file.is_file()]
        else:
            raise ProcessError(f"{path}: no such file or folder; name the folder of a flight")
        if not here:
            raise ProcessError(f"{path}: no recording (*.mcap) here or two folders below; name the folder of a flight")
        for file in here:
            found.setdefault(file.resolve(), file)
    return tuple(found.values())


@dataclass
class _CameraPlaces:
    """One camera's messages."""

    images: list[MessageHead] = field(default_factory=list)
    frames: list[MessageHead] = field(default_factory=list)


_Numbered = dict[int, tuple[Place, Place | None]]


def _places(sets: Sequence[SetPlaces]) -> Iterator[Place]:
    return (place for one in sets for place in (*one.images, *one.frames) if place is not None)


def _read_image(reader: ChunkReader, place: Place) -> tuple[Pixels, int]:
    data = reader.read(place)
    image = decode_image(data)
    if image.encoding not in ("mono8", "8UC1"):
        raise ProcessError(f"{place.path}: images are {image.encoding}, not mono8; record them as 8-bit greyscale")
    rows = np.frombuffer(data, np.uint8, image.height * image.step, image.pixels_at)
    return rows.reshape(image.height, image.step)[:, : image.width], image.stamp_ns


def _by_sequence(key: tuple[str, int], camera: _CameraPlaces, problems: list[str]) -> _Numbered:
    """The camera's frames by trigger index = sequence; of two with the same index the first is kept."""
    metas = {head.sequence: head.place for head in reversed(camera.frames)}
    numbered: _Numbered = {}
    repeated = 0
    for head in camera.images:
        if head.sequence in numbered:
            repeated += 1
        else:
            numbered[head.sequence] = (head.place, metas.get(head.sequence))
    if repeated:
        problems.append(
            f"{key[0]}/{CAMERAS[key[1]]}: {repeated} trigger numbers occur twice, the first is kept;"
            " name one flight at a time"
        )
    return numbered


def _by_stamp(places: dict[tuple[str, int], _CameraPlaces], problems: list[str]) -> dict[tuple[str, int], _Numbered]:
    """Frames of a recording of images only, numbered by the rank of their instant over all cameras."""
    stamped: list[tuple[int, tuple[str, int], Place]] = []
    period_ns = float("inf")
    reader = ChunkReader()
    for key, camera in places.items():
        stamps = []
        for head in camera.images:
            try:
                stamps.append(decode_image(reader.read(head.place)).stamp_ns)
            except (ValueError, OSError) as error:
                problems.append(f"{head.place.path}: the image at byte {head.place.chunk_at} is not readable ({error})")
                continue
            stamped.append((stamps[-1], key, head.place))
        if len(stamps) > 1:
            period_ns = min(period_ns, float(np.median(np.diff(np.sort(stamps)))))
    reader.close()
    numbered: dict[tuple[str, int], _Numbered] = {key: {} for key in places}
    rank, began_ns = -1, 0
    seen: set[tuple[str, int]] = set()
    for stamp_ns, key, place in sorted(stamped, key=lambda item: item[:2]):
        if rank < 0 or key in seen or stamp_ns - began_ns > period_ns / 2:
            rank, began_ns, seen = rank + 1, stamp_ns, set()
        seen.add(key)
        numbered[key][rank] = (place, None)
    return numbered


def _frame_sets(numbered: dict[tuple[str, int], _Numbered]) -> dict[str, tuple[SetPlaces, ...]]:
    sides = {}
    for side in SIDES:
        cam0, cam1 = numbered[side, 0], numbered[side, 1]
        nothing: tuple[None, None] = (None, None)
        sets = []
        for trigger in sorted(cam0.keys() | cam1.keys()):
            (image0, frame0), (image1, frame1) = cam0.get(trigger, nothing), cam1.get(trigger, nothing)
            sets.append(SetPlaces(side, trigger, (image0, image1), (frame0, frame1)))
        if sets:
            sides[side] = tuple(sets)
    return sides


def _losses(heads: list[MessageHead]) -> set[tuple[int, str, str, str]]:
    """(trigger, side, camera, stage) of each recorded loss; the two disks' copies are one."""
    reader = ChunkReader()
    losses = set()
    for head in heads:
        try:
            loss = Loss.decode(reader.read(head.place))
        except (BadChunk, ValueError, OSError):
            continue  # the other disk has a copy
        losses.add((loss.trigger_index, loss.side, loss.camera, loss.stage))
    reader.close()
    return losses


def _missing_frames(sides: dict[str, tuple[SetPlaces, ...]], losses: set[tuple[int, str, str, str]]) -> list[str]:
    """A line for each camera that lacks frames of triggers that others have, or that the recorder booked as lost."""
    triggers = {places.trigger_index for sets in sides.values() for places in sets}
    triggers |= {trigger for trigger, side, _, _ in losses if side in sides}
    problems: list[str] = []
    for side, sets in sides.items():
        for camera, name in enumerate(CAMERAS):
            there = {places.trigger_index for places in sets if places.images[camera] is not None}
            missing = triggers - there
            if missing:
                booked: Counter[Any] = Counter(
                    stage for trigger, s, c, stage in losses if (s, c) == (side, name) and trigger in missing
                )
                stages = ", ".join(f"{count} at {stage}" for stage, count in sorted(booked.items()))
                unbooked = len(missing) - sum(booked.values())
                reason = "; ".join(filter(None, [stages, f"{unbooked} without a reason" if unbooked > 0 else ""]))
                problems.append(f"{side}/{name}: {len(missing)} of {len(triggers)} frames are missing ({reason})")
    return problems
