"""The camera contract: what a backend must do between a hardware trigger and a filled buffer.

A camera is opened, given empty buffers, armed, grabbed from, disarmed and closed, by one thread at a time.
The backend fills the buffers it was given, in place: a frame lands once.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import IntEnum

CHUNK_BYTES = 160
"""Room behind the pixels of a driver's buffer for what a camera says of the frame itself (GenICam chunk data)."""


def buffer_bytes(width: int, height: int) -> int:
    """How large a buffer must be that a camera is given."""
    return width * height + CHUNK_BYTES


@dataclass(frozen=True)
class CameraSettings:
    """What a camera is asked to be. A backend that cannot comply raises CameraError when opened."""

    width: int
    height: int
    exposure_us: int
    gain_db: float
    offset_x: int = 0  # of the region on the sensor
    offset_y: int = 0
    black_level: float | None = None  # in the camera's own unit; None: left as it is
    shutter_mode: str | None = None  # by the camera's own name for it; None: left as it is
    trigger_line: str = "Line0"
    trigger_activation: str = "RisingEdge"


@dataclass(frozen=True)
class CameraDescription:
    """What a camera says it is, read back from the device, and what it can do."""

    model: str
    serial: str
    width: int
    height: int
    exposure_us: int
    gain_db: float
    row_time_ns: int  # rolling shutter: time from one row's start of exposure to the next row's; 0 = global
    tick_hz: float  # nominal rate of the device clock
    frame_id_bits: int  # the frame counter wraps at 2**frame_id_bits
    hardware_trigger: bool  # False: the device runs free
    frame_counter: bool = True  # frame_id counts exposures: one that was never delivered leaves a gap
    tells_unplug: bool = True  # grab raises CameraLost when the device is gone
    firmware: str = ""
    features: tuple[tuple[str, str], ...] = ()  # what else was set and read back, by the device's own names


class FrameStatus(IntEnum):
    """What the driver says of a delivered buffer."""

    COMPLETE = 0
    INCOMPLETE = 1  # bytes are missing: the content must not be trusted


@dataclass(frozen=True)
class Grab:
    """One buffer back from the driver."""

    slot: int  # which buffer
    frame_id: int  # the frame counter of the transport, wraps
    device_ticks: int  # the device's clock at start of exposure of row 0
    receive_ns: int  # host UTC when the whole frame was there
    exposure_us: int  # the frame's own where the camera says it, else as read back when it was set; so the gain
    gain_db: float
    status: FrameStatus
    detail: str = ""  # why it is incomplete, in the driver's words
    counter: int | None = None  # the device's own frame counter, where the frame holds it


class Camera(ABC):
    """One camera. Not thread-safe: its read thread owns it."""

    def __init__(self, address: str, settings: CameraSettings) -> None:
        self.address = address
        self.settings = settings

    @abstractmethod
    def open(self) -> CameraDescription:
        """Connect, configure and read back.

        Raises:
            CameraError: not there, in use, or it did not take the settings.
        """

    @abstractmethod
    def queue(self, slot: int, buffer: memoryview) -> None:
        """Give the driver an empty buffer of at least ``buffer_bytes``, to be filled in place.

        The pixels come first. What is behind them may be written to as well, until the buffer is grabbed.

        Never raises on a camera that is gone: ``grab`` tells.
        """

    @abstractmethod
    def arm(self) -> None:
        """Be ready for triggers when this returns."""

    @abstractmethod
    def grab(self, timeout_s: float) -> Grab | None:
        """The next buffer that the driver is done with, or None after ``timeout_s``.

        Raises:
            CameraLost: the device is gone.
        """

    def temperature_c(self) -> float | None:
        """The device's own temperature; None where it has none or does not answer."""
        return None

    @abstractmethod
    def disarm(self) -> None:
        """Stop taking triggers and forget the queued buffers. Safe to call twice, and on a lost camera."""

    @abstractmethod
    def close(self) -> None:
        """Let go of the device. Safe to call twice."""
