"""The recorder's health in shared memory: a snapshot and the latest frame of each camera, for whoever watches.

The recorder writes, others read; nobody waits for anybody. In the folder are

``health.json``            a ``Health``, replaced as a whole about every 0.4 s
``preview_left_cam0`` …    ``PREVIEW_HEADER``, then the pixels, row by row; ``sequence`` is odd while they change
"""

import json
import os
import stat
import struct
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from capture.errors import CaptureError

FORMAT, VERSION = "wingshape health", 1
HEALTH_FILE = "health.json"
WRITE_PERIOD_S = 0.4
STALE_S = 1.5
"""A snapshot older than this is a dead recorder's: with a page that asks twice a second NO-GO is shown within 3 s."""
OK, WARNING, ERROR, STALE = range(4)
"""Levels of a diagnostic, as in diagnostic_msgs/msg/DiagnosticStatus."""
PREVIEW_MAGIC = b"WSPREV01"
PREVIEW_HEADER = struct.Struct("<8sQIIQqq16x")
"""magic, sequence, width, height, trigger index, trigger time (UTC ns), written at (CLOCK_MONOTONIC ns)"""
_READ_TRIES = 3
_SERVICE_FOLDER = Path("/run/wingshape")


@dataclass(frozen=True)
class Notice:
    """How one part of the recorder is doing: a diagnostic."""

    level: int
    name: str
    message: str
    values: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class CameraHealth:
    """One camera."""

    side: str
    name: str
    recorded: int
    lost: dict[str, int]  # by stage
    rate_hz: float  # frames that arrived, over the last two seconds
    silent_s: float | None  # since the last frame; None: there was none yet
    ring_in_use: int
    ring_slots: int
    ring_high_water: int
    exposure_us: int
    temperature_c: float | None = None  # None: the camera does not tell

    @property
    def place(self) -> str:
        """As people write it: left/cam0."""
        return f"{self.side}/{self.name}"

    @property
    def lost_total(self) -> int:
        """Frames lost at any stage."""
        return sum(self.lost.values())


@dataclass(frozen=True)
class DiskHealth:
    """One side's disk."""

    side: str
    folder: str
    free_bytes: int | None  # None: not known yet
    minutes_left: float | None  # at the configured rate, down to the reserve
    write_mode: str
    queued: int  # items that wait for the disk
    last_write_us: int
    failure: str | None


@dataclass(frozen=True)
class Health:
    """The whole recorder at one instant."""

    flight: str
    state: str
    """``idle``, ``starting``, ``armed``, ``test burst``, ``recording``, ``stopping``, ``ended``"""
    recording_s: float
    triggers: int
    trigger_rate_hz: float
    cameras: tuple[CameraHealth, ...]
    disks: tuple[DiskHealth, ...]
    diagnostics: tuple[Notice, ...]
    failures: tuple[str, ...] = ()
    temperatures_c: dict[str, float] = field(default_factory=dict)
    previews: tuple[str, ...] = ()  # places, as left/cam0
    control_socket: str | None = None  # where start and stop are taken; None: nowhere
    pid: int = 0
    software: str = ""
    written_utc_ns: int = 0
    written_monotonic_s: float = 0.0  # CLOCK_MONOTONIC: a step of the clock makes nobody look dead

    @property
    def reasons(self) -> tuple[Notice, ...]:
        """What stands against flying; GO when there is nothing."""
        return tuple(notice for notice in self.diagnostics if notice.level >= ERROR)

    @property
    def cautions(self) -> tuple[Notice, ...]:
        """What a person should know, and may fly with."""
        return tuple(notice for notice in self.diagnostics if notice.level == WARNING)

    def as_dict(self) -> dict[str, Any]:
        """For the file and for ``--json``."""
        return {"format": FORMAT, "version": VERSION, "go": not self.reasons, **asdict(self)}


@dataclass(frozen=True)
class Verdict:
    """GO or NO-GO."""

    reasons: tuple[Notice, ...]  # none: GO
    cautions: tuple[Notice, ...]
    age_s: float | None  # of the snapshot; None: there is none

    @property
    def go(self) -> bool:
        """Whether nothing stands against flying."""
        return not self.reasons


def judge(health: Health | None, monotonic_s: float) -> Verdict:
    """GO or NO-GO at ``monotonic_s`` (CLOCK_MONOTONIC): a snapshot that has grown old speaks for nobody."""
    if health is None:
        message = "no recorder has shared its health here: start it, or look in its `health.folder`"
        return Verdict((Notice(STALE, "recorder", message),), (), None)
    age_s = monotonic_s - health.written_monotonic_s
    if 0.0 <= age_s <= STALE_S:
        return Verdict(health.reasons, health.cautions, age_s)
    if health.state == "ended":
        return Verdict(health.reasons, (), age_s)
    message = "silent: it is dead or hangs; see `journalctl -u wingcap`"
    if age_s > 0.0:  # else it is of before the last boot
        message = f"silent for {age_s:.0f} s: it is dead or hangs; see `journalctl -u wingcap`"
    return Verdict((Notice(STALE, "recorder", message),), (), age_s)


@dataclass(frozen=True)
class Preview:
    """The latest frame of a camera."""

    width: int
    height: int
    trigger_index: int
    trigger_time_ns: int
    written_monotonic_s: float
    pixels: bytes
    """mono8, row by row"""


def default_folder() -> Path:
    """Where health is shared when the configuration does not say: /run/wingshape where the service has made it, else
    the user's own runtime folder, else a private one in /dev/shm."""
    if _SERVICE_FOLDER.is_dir():
        return _SERVICE_FOLDER
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if runtime and Path(runtime).is_dir():
        return Path(runtime) / "wingshape"
    memory = Path("/dev/shm")
    return (memory if memory.is_dir() else Path(tempfile.gettempdir())) / f"wingshape-{os.geteuid()}"


def make_folder(folder: Path) -> None:
    """Make the folder where there is none.

    Raises:
        CaptureError: it cannot be made, or it is somebody else's who could feed us links.
    """
    try:
        folder.mkdir(mode=0o755, exist_ok=True)
        found = folder.lstat()
    except OSError as error:
        raise CaptureError(
            f"{folder}: health cannot be shared there ({error.strerror}): give another `health.folder`"
        ) from error
    if not stat.S_ISDIR(found.st_mode) or (found.st_mode & stat.S_IWOTH and not found.st_mode & stat.S_ISVTX):
        raise CaptureError(
            f"{folder}: health is not shared in a link, a file or a folder that everybody may write to: "
            "give another `health.folder`"
        )
    if not os.access(folder, os.W_OK):
        raise CaptureError(f"{folder}: health cannot be shared there (not writable): give another `health.folder`")


def write_health(folder: Path, health: Health) -> None:
    """Replace the snapshot. Raises ``OSError`` as the system does."""
    text = json.dumps(health.as_dict(), allow_nan=False)
    beside = folder / f".{HEALTH_FILE}.{os.getpid()}"
    descriptor = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
    with os.fdopen(descriptor, "wb") as file:  # all of it, or an error: a full tmpfs takes a part
        file.write(text.encode())
    beside.replace(folder / HEALTH_FILE)


def read_health(folder: Path) -> Health | None:
    """The latest snapshot, however old; None: no recorder has written one here.

    Raises:
        CaptureError: the file is another program's or version's.
    """
    path = folder / HEALTH_FILE
    try:
        value = json.loads(path.read_bytes())
    except FileNotFoundError:
        return None
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror}): run as a user of its group") from error
    except ValueError as error:
        raise CaptureError(f"{path}: not a recorder's health ({error}): give the recorder's `health.folder`") from error
    try:
        return _health(value)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise CaptureError(
            f"{path}: not health of version {VERSION} ({error!r}): recorder and reader must be of the same version"
        ) from error


def _health(value: Mapping[str, Any]) -> Health:
    if (value["format"], value["version"]) != (FORMAT, VERSION):
        raise ValueError(f"{value['format']} {value['version']}")
    rest = {key: item for key, item in value.items() if key not in ("format", "version", "go")}
    for key, kind in (("cameras", CameraHealth), ("disks", DiskHealth), ("diagnostics", Notice)):
        rest[key] = tuple(kind(**item) for item in value[key])
    for key in ("failures", "previews"):
        rest[key] = tuple(value[key])
    return Health(**rest)


def preview_path(folder: Path, place: str) -> Path:
    """Where the latest frame of ``left/cam0`` is."""
    return folder / f"preview_{place.replace('/', '_')}"


def read_preview(folder: Path, place: str) -> Preview | None:
    """The latest frame of a camera, whole; None: there is none, or it keeps changing."""
    try:
        descriptor = os.open(preview_path(folder, place), os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:
        return None
    try:
        for _ in range(_READ_TRIES):
            head = os.pread(descriptor, PREVIEW_HEADER.size, 0)
            if len(head) < PREVIEW_HEADER.size:
                return None
            magic, sequence, width, height, index, time_ns, written_ns = PREVIEW_HEADER.unpack(head)
            if magic != PREVIEW_MAGIC:
                return None
            pixels = os.pread(descriptor, width * height, PREVIEW_HEADER.size)
            unchanged = os.pread(descriptor, PREVIEW_HEADER.size, 0) == head
            if unchanged and sequence % 2 == 0 and len(pixels) == width * height:
                return Preview(width, height, index, time_ns, written_ns / 1e9, pixels)
        return None
    finally:
        os.close(descriptor)
