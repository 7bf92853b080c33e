"""A side's lane: its cameras, their rings and read threads, and the write thread of its disk, wired together."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from capture.camera.base import Camera, CameraDescription
from capture.config import DiskConfig, ThreadsConfig
from capture.disk import Disk
from capture.errors import CameraLost
from capture.grabber import Grabber, ReadParts, SideGate
from capture.record import frame_topic, image_topic
from capture.recorder import Recorder, camera_channels
from capture.ring import Ring, check_memory
from capture.segment import FrameLayout


@dataclass(frozen=True, kw_only=True)
class LaneParts(ReadParts):
    """What all lanes of a recording share."""

    disk: Disk
    disk_config: DiskConfig
    provenance: dict[str, str]
    ring_slots: int
    lock_memory: bool
    threads: ThreadsConfig = field(default_factory=ThreadsConfig)
    calibration: tuple[str, bytes] | None = None  # name and content


@dataclass(frozen=True)
class Lane:
    """One side."""

    side: str
    recorder: Recorder
    grabbers: dict[str, Grabber]  # by camera name

    def start_writing(self) -> None:
        """Start the write thread, which takes small messages from then on."""
        self.recorder.start()

    def start(self) -> None:
        """Arm the cameras and start the read threads. A camera that went since it was opened is looked for.

        Raises:
            CameraError: a camera that is there cannot be armed.
        """
        for grabber in self.grabbers.values():
            try:
                if not grabber.is_absent:
                    grabber.arm()
            except CameraLost as error:
                grabber.lose(error)
            grabber.start()


def check_ring_memory(cameras: int, ring_slots: int, width: int, height: int) -> None:
    """Refuse rings for which there is not enough memory, before any of it is touched.

    Raises:
        UsageError: the message has both figures.
    """
    check_memory(cameras * ring_slots * FrameLayout(1, 2, "left_cam0", width, height).slot_bytes)


def make_lane(
    side: str,
    folder: Path,
    cameras: Mapping[str, tuple[Camera, CameraDescription]],
    parts: LaneParts,
    spare: tuple[Disk, Path] | None = None,
) -> Lane:
    """Rings, read threads and the write thread of one side; nothing is started yet.

    ``spare`` is the folder on the other disk where this side goes on when its own fails; None: it ends.

    Raises:
        DiskError: the first files cannot be made in ``folder``.
    """
    names = list(cameras)
    first = cameras[names[0]][1]
    recorder = Recorder(
        side,
        folder,
        names,
        (first.height, first.width),
        parts.disk_config,
        parts.disk,
        parts.provenance,
        parts.ledger,
        parts.clock,
        queue_bound=len(names) * parts.ring_slots,
        calibration=parts.calibration,
        spare=spare,
    )
    ids = {channel.topic: channel.id for channel in camera_channels(names, side)}
    layouts = {
        name: FrameLayout(
            ids[image_topic(side, name)], ids[frame_topic(side, name)], f"{side}_{name}", first.width, first.height
        )
        for name in names
    }
    rings = {name: Ring(parts.ring_slots, layouts[name].slot_bytes, parts.lock_memory) for name in names}
    gate = SideGate(list(rings.values()), parts.driver_buffers)
    grabbers = {
        name: Grabber((side, name), camera, description, rings[name], layouts[name], gate, recorder, parts)
        for name, (camera, description) in cameras.items()
    }
    recorder.placement = parts.threads.write
    for grabber in grabbers.values():
        grabber.placement = parts.threads.read
    return Lane(side, recorder, grabbers)
