"""The write thread of one disk: sealed frames and aux batches to segments, with rotation and a guard of free space."""

import queue
import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from capture.clock import Clock
from capture.config import DiskConfig
from capture.disk import Disk
from capture.errors import DiskError
from capture.ledger import Ledger, Place
from capture.record import (
    ANALOG_TOPIC,
    CAN_TOPIC,
    DIAGNOSTICS_TOPIC,
    GATE_TOPIC,
    LOSS_TOPIC,
    MAVLINK_TOPIC,
    PTP_TOPIC,
    TRIGGER_TOPIC,
    LossStage,
    camera_info_topic,
    encode_camera_info,
    frame_topic,
    image_topic,
)
from capture.ring import Ring
from capture.segment import Channel, SealedFrame, SegmentWriter, SmallMessage
from capture.worker import Worker

AUX_CHANNELS = (
    Channel(1, TRIGGER_TOPIC, "wingshape_msgs/msg/Trigger"),
    Channel(2, LOSS_TOPIC, "wingshape_msgs/msg/Loss"),
    Channel(3, DIAGNOSTICS_TOPIC, "diagnostic_msgs/msg/DiagnosticArray"),
    Channel(4, PTP_TOPIC, "wingshape_msgs/msg/Ptp"),
    Channel(5, GATE_TOPIC, "wingshape_msgs/msg/Gate"),
    Channel(11, CAN_TOPIC, "can_msgs/msg/Frame"),
    Channel(12, ANALOG_TOPIC, "wingshape_msgs/msg/Analog"),
    Channel(13, MAVLINK_TOPIC, "wingshape_msgs/msg/Mavlink"),
)
AUX_QUEUE = 1024
SYNC_PERIOD_S = 0.5  # what a power cut may take with it, while the disk keeps up
PREALLOCATE_BYTES = 128e6  # at a time: little of it is left behind by a kill, or missing from the reserve
_SPACE_CHECK_EVERY = 32  # frames


@dataclass(frozen=True)
class FrameItem:
    """A frame on its way to the disk."""

    place: Place
    index: int
    ring: Ring
    slot: int
    sealed: SealedFrame


@dataclass(frozen=True)
class AuxItem:
    """Small messages on their way to the disk."""

    messages: tuple[SmallMessage, ...]


def camera_channels(names: Sequence[str], side: str) -> tuple[Channel, ...]:
    """Channels of a side's segment: image, frame and camera_info of each camera, ids 1, 2, 3, …"""
    channels: list[Channel] = []
    for name in names:
        for topic, type_name in (
            (image_topic(side, name), "sensor_msgs/msg/Image"),
            (frame_topic(side, name), "wingshape_msgs/msg/Frame"),
            (camera_info_topic(side, name), "sensor_msgs/msg/CameraInfo"),
        ):
            channels.append(Channel(len(channels) + 1, topic, type_name))
    return tuple(channels)


@dataclass
class WriteStatistics:
    """How the disk is doing."""

    frames: int = 0
    last_us: int = 0
    free_bytes: int | None = None  # of the disk, when last asked
    latencies_us: deque[int] = field(default_factory=lambda: deque(maxlen=100_000))


class Recorder(Worker):
    """One disk's writer. Frames are handed to it with ``put``, which never blocks."""

    def __init__(
        self,
        side: str,
        folder: Path,
        cameras: Sequence[str],
        size: tuple[int, int],
        config: DiskConfig,
        disk: Disk,
        provenance: dict[str, str],
        ledger: Ledger,
        clock: Clock,
        queue_bound: int,
        calibration: tuple[str, bytes] | None = None,
        spare: tuple[Disk, Path] | None = None,
    ) -> None:
        super().__init__(f"write-{side}")
        self.side = side
        self.folder = folder
        self.failure: DiskError | None = None  # this side has ended
        self.moved: DiskError | None = None  # its own disk has failed, and it went on on the other
        self.statistics = WriteStatistics()
        self.segments: list[SegmentWriter] = []
        self.aux_dropped = 0
        self.write_mode: str = config.write
        self.tap: Callable[[FrameItem], bool] | None = None  # may take over the slot of a frame that is done with
        self._cameras = tuple(cameras)
        self._size = size
        self._config = config
        self._disk = disk
        self._provenance = provenance
        self._ledger = ledger
        self._clock = clock
        self._calibration = calibration
        self._spare = spare
        self._queue: queue.Queue[FrameItem | AuxItem] = queue.Queue(queue_bound + AUX_QUEUE)
        self._aux_room = threading.Semaphore(AUX_QUEUE)  # of the queue: the rest of it is the frames'
        self._segment_started_s = 0.0
        self._current: SegmentWriter | None = None
        self._synced_s = clock.monotonic_s()
        self.aux = SegmentWriter(
            disk, folder / "aux_0000.mcap", AUX_CHANNELS, {**provenance, "side": side, "segment": "0"}, "buffered"
        )
        self._open_segment()

    def put(self, item: FrameItem) -> None:
        """Hand a frame over. There is always room: every item owns a ring slot."""
        self._queue.put_nowait(item)

    def put_aux(self, messages: tuple[SmallMessage, ...]) -> None:
        """Hand small messages over; counted as dropped when the disk has been stuck for very long."""
        if self._aux_room.acquire(blocking=False):
            self._queue.put_nowait(AuxItem(messages))
        else:
            self.aux_dropped += len(messages)

    @property
    def queued(self) -> int:
        """Items waiting for the disk."""
        return self._queue.qsize()

    def work(self) -> None:
        """Write until asked to stop and nothing is left."""
        while self.step(wait_s=0.1) or not self.stop_requested.is_set():
            self.turn()

    def step(self, wait_s: float) -> bool:
        """Write one item, when there is one within ``wait_s``."""
        try:
            item = self._queue.get(timeout=wait_s) if wait_s else self._queue.get_nowait()
        except queue.Empty:
            return False
        if isinstance(item, FrameItem):
            self._take_frame(item)
        else:
            self._aux_room.release()
            self._take_aux(item)
        return True

    def close(self, messages: Sequence[SmallMessage], end: dict[str, str]) -> None:
        """Write the last small messages and ``end``, and close both files. After the write thread has ended.

        A disk that fails here is kept in ``failure``.
        """
        try:
            if self._current is not None:
                self._current.close()
        except DiskError as error:
            self._fail(error)
        try:
            self.aux.write_batch(messages)
            self.aux.write_metadata("wingshape_end", end)
            self.aux.close()
        except DiskError as error:
            self._fail_aux(error)
            self.aux.close_cut()

    def _take_frame(self, item: FrameItem) -> None:
        if self._write_somewhere(item):
            self._ledger.recorded(item.place, item.index)
        else:
            self._ledger.lost(item.place, item.index, LossStage.DISK, str(self.failure))
        if self.tap is None or not self.tap(item):
            item.ring.give_back(item.slot)

    def _write_somewhere(self, item: FrameItem) -> bool:
        """On this side's disk, or once more on the other where that one takes over."""
        for _ in range(2):
            if self.failure is not None:
                return False
            try:
                self._write(item)
                return True
            except DiskError as error:
                self._fail(error)
        return False

    def _write(self, item: FrameItem) -> None:
        segment = self._segment_with_room()
        if self._clock.monotonic_s() - self._synced_s > SYNC_PERIOD_S:
            segment.sync()
            if self.moved is None:  # else the aux file is on the disk that has failed
                self.aux.sync()
            self._synced_s = self._clock.monotonic_s()
        begin_s = self._clock.monotonic_s()
        segment.write_frame(item.sealed)
        took_us = int((self._clock.monotonic_s() - begin_s) * 1e6)
        done = self.statistics
        done.frames += 1
        done.last_us = took_us
        done.latencies_us.append(took_us)

    def _take_aux(self, item: AuxItem) -> None:
        try:
            self.aux.write_batch(item.messages)
        except DiskError as error:
            self.aux_dropped += len(item.messages)
            self._fail_aux(error)

    def _segment_with_room(self) -> SegmentWriter:
        if self.statistics.frames % _SPACE_CHECK_EVERY == 0:
            self._guard_space()
        segment = self._current
        old = self._clock.monotonic_s() - self._segment_started_s > self._config.segment_s
        if segment is None or old or segment.bytes_written > self._config.segment_mb * 1e6:
            if segment is not None:
                segment.close()
            segment = self._open_segment()
        return segment

    def _open_segment(self) -> SegmentWriter:
        number = len(self.segments)
        channels = camera_channels(self._cameras, self.side)
        segment = SegmentWriter(
            self._disk,
            self.folder / f"{self.side}_{number:04d}.mcap",
            channels,
            {**self._provenance, "side": self.side, "segment": str(number)},
            self._config.write,
            preallocate_bytes=round(min(self._config.segment_mb * 1e6, PREALLOCATE_BYTES)),
        )
        self.write_mode = segment.write_mode
        now_ns = self._clock.utc_ns()
        if self._calibration is not None:
            segment.attach(*self._calibration, now_ns)
        height, width = self._size
        segment.write_batch(
            [
                SmallMessage(
                    3 * number_of_camera + 3,
                    number,
                    now_ns,
                    now_ns,
                    encode_camera_info(now_ns, f"{self.side}_{name}", height, width),
                )
                for number_of_camera, name in enumerate(self._cameras)
            ]
        )
        self.segments.append(segment)
        self._current = segment
        self._segment_started_s = self._clock.monotonic_s()
        return segment

    def _guard_space(self) -> None:
        try:
            free_bytes = self._disk.free_bytes(self.folder)
        except OSError as error:
            raise DiskError(f"{self.folder}: the disk is gone ({error.strerror}): check its connection") from error
        self.statistics.free_bytes = free_bytes
        free_mb = free_bytes / 1e6
        if free_mb < self._config.reserve_mb:
            raise DiskError(
                f"{self.folder}: {free_mb:.0f} MB free is less than the reserve of {self._config.reserve_mb:.0f} MB: "
                "free space on this disk"
            )

    def _fail(self, error: DiskError) -> None:
        """The disk has failed: what is on it stays readable. Go on on the other disk where there is a spare folder,
        else this side is over."""
        if self._current is not None:
            self._current.close_cut()
            self._current = None
        if self._spare is not None:
            (self._disk, self.folder), self._spare = self._spare, None
            self.moved = error
        elif self.failure is None:
            self.failure = error

    def _fail_aux(self, error: DiskError) -> None:
        """The small messages are on the other disk too; a side that has moved there needs its own no more."""
        if self.moved is None:
            self._fail(error)
