"""The recorded format: topics, message types and their CDR bytes. The only thing that crosses to the ground.

Messages are ROS 2 types in little-endian XCDR1. Images are encoded as a prefix (``image_prefix``) that is
followed by the pixels, so that no pixel is copied; the small types are encoded and decoded whole.
"""

import struct
from dataclasses import dataclass, fields
from enum import IntEnum
from typing import Any, Self

SIDES = ("left", "right")
CAMERAS = ("cam0", "cam1")  # cam0 is the left one as the pair looks outboard

TRIGGER_TOPIC = "/trigger"
LOSS_TOPIC = "/loss"
DIAGNOSTICS_TOPIC = "/diagnostics"
PTP_TOPIC = "/ptp"
GATE_TOPIC = "/gate"
CAN_TOPIC = "/can"
ANALOG_TOPIC = "/analog"
MAVLINK_TOPIC = "/mavlink"
PROVENANCE = "wingshape"  # name of the Metadata record that every segment begins with
FORMAT_VERSION = 1


def image_topic(side: str, camera: str) -> str:
    """Topic of a camera's frames, sensor_msgs/msg/Image."""
    return f"/{side}/{camera}/image_raw"


def frame_topic(side: str, camera: str) -> str:
    """Topic of what is known of each frame, wingshape_msgs/msg/Frame."""
    return f"/{side}/{camera}/frame"


def camera_info_topic(side: str, camera: str) -> str:
    """Topic of a camera's sensor_msgs/msg/CameraInfo, once at the start of each segment."""
    return f"/{side}/{camera}/camera_info"


class LossStage(IntEnum):
    """Where a triggered frame was lost, along its way."""

    CAMERA = 0  # not exposed, or the camera was not armed, or is gone
    USB = 1  # exposed, but not or not wholly delivered
    RING = 2  # delivered, but no room until the disk catches up
    WRITER = 3  # in the ring, but never handed to the disk
    DISK = 4  # the disk refused or lost it


class PtpState(IntEnum):
    """PTP port state as recorded with every frame (IEEE 1588-2008, table 8); 0: not known."""

    UNKNOWN = 0
    INITIALIZING = 1
    FAULTY = 2
    DISABLED = 3
    LISTENING = 4
    PRE_MASTER = 5
    MASTER = 6
    PASSIVE = 7
    UNCALIBRATED = 8
    SLAVE = 9


class CdrWriter:
    """Little-endian XCDR1 encoder for the few primitive types in use."""

    def __init__(self) -> None:
        self._out = bytearray(b"\x00\x01\x00\x00")

    def put(self, code: str, value: Any) -> Self:
        """Append a primitive by its ``struct`` code, or ``s`` for a string."""
        if code == "s":
            raw = value.encode() + b"\x00"
            self.put("I", len(raw))
            self._out += raw
        else:
            size = struct.calcsize(code)
            self._out += bytes(-(len(self._out) - 4) % size)
            self._out += struct.pack("<" + code, value)
        return self

    def done(self) -> bytes:
        """The encoded message."""
        return bytes(self._out)


class CdrReader:
    """Little-endian XCDR1 decoder for the few primitive types in use.

    Raises ``ValueError`` on a message that ends early or is not little-endian XCDR1.
    """

    def __init__(self, data: bytes | memoryview) -> None:
        self._data = memoryview(data)
        self._at = 4
        if bytes(self._data[:2]) != b"\x00\x01":
            raise ValueError("not a little-endian CDR message")

    def get(self, code: str) -> Any:
        """The next primitive by its ``struct`` code, or ``s`` for a string."""
        if code == "s":
            length = self.get("I")
            raw = bytes(self._data[self._at : self._at + length])
            if len(raw) != length or not raw:
                raise ValueError("CDR message ends early")
            self._at += length
            return raw[:-1].decode("utf-8", errors="replace")
        size = struct.calcsize(code)
        self._at += -(self._at - 4) % size
        if self._at + size > len(self._data):
            raise ValueError("CDR message ends early")
        (value,) = struct.unpack_from("<" + code, self._data, self._at)
        self._at += size
        return value

    @property
    def position(self) -> int:
        """Offset of the next byte from the start of the message."""
        return self._at


_CODE_OF_TYPE = {
    "Q": "uint64",
    "q": "int64",
    "I": "uint32",
    "i": "int32",
    "f": "float32",
    "d": "float64",
    "B": "uint8",
    "s": "string",
}


@dataclass(frozen=True)
class _Message:
    """A flat message whose dataclass fields, in order, are its CDR members."""

    def encode(self) -> bytes:
        """CDR bytes."""
        out = CdrWriter()
        for member in fields(self):
            out.put(member.metadata["cdr"], getattr(self, member.name))
        return out.done()

    @classmethod
    def decode(cls, data: bytes | memoryview) -> Self:
        """The message of CDR bytes. Raises ``ValueError`` when they are not such a message."""
        reader = CdrReader(data)
        return cls(*(reader.get(member.metadata["cdr"]) for member in fields(cls)))

    @classmethod
    def definition(cls) -> str:
        """The ROS 2 message definition."""
        return "".join(f"{_CODE_OF_TYPE[member.metadata['cdr']]} {member.name}\n" for member in fields(cls))


def _cdr(code: str) -> Any:
    import dataclasses

    return dataclasses.field(metadata={"cdr": code})


@dataclass(frozen=True)
class Frame(_Message):
    """wingshape_msgs/msg/Frame: what is known of one recorded frame. Times are UTC nanoseconds."""

    trigger_index: int = _cdr("Q")
    device_frame_id: int = _cdr("Q")
    device_ticks: int = _cdr("Q")
    trigger_time_ns: int = _cdr("q")
    exposure_start_ns: int = _cdr("q")  # of row 0
    receive_time_ns: int = _cdr("q")
    time_sigma_ns: int = _cdr("q")  # one sigma of exposure_start_ns; -1: not known
    exposure_us: int = _cdr("I")
    row_time_ns: int = _cdr("I")
    ring_depth: int = _cdr("I")  # slots in use when this frame was queued for the disk
    previous_write_us: int = _cdr("I")  # how long the previous frame's write took on this disk
    gain_db: float = _cdr("f")
    ptp_state: int = _cdr("B")
    status: int = _cdr("B")  # FrameStatus of the driver

    @property
    def mid_exposure_ns(self) -> int:
        """Middle of row 0's exposure; row r is ``r * row_time_ns`` later."""
        return self.exposure_start_ns + self.exposure_us * 500


@dataclass(frozen=True)
class Trigger(_Message):
    """wingshape_msgs/msg/Trigger: one edge as the trigger board reported it."""

    index: int = _cdr("Q")
    counter: int = _cdr("Q")
    commanded_time_ns: int = _cdr("q")
    reported_time_ns: int = _cdr("q")
    receive_time_ns: int = _cdr("q")


@dataclass(frozen=True)
class Loss(_Message):
    """wingshape_msgs/msg/Loss: one camera's frame of one trigger that is not in the recording, and why."""

    trigger_index: int = _cdr("Q")
    time_ns: int = _cdr("q")
    side: str = _cdr("s")
    camera: str = _cdr("s")
    stage: str = _cdr("s")
    cause: str = _cdr("s")


@dataclass(frozen=True)
class Analog(_Message):
    """wingshape_msgs/msg/Analog: one channel of one sample of the trigger board. Times are UTC nanoseconds."""

    time_ns: int = _cdr("q")  # the board's own
    receive_time_ns: int = _cdr("q")
    sample: int = _cdr("I")  # the board's number of it
    channel: int = _cdr("B")
    name: str = _cdr("s")
    volts: float = _cdr("d")
    value: float = _cdr("d")  # scale · volts + offset, as configured


@dataclass(frozen=True)
class CanFrame:
    """can_msgs/msg/Frame: one frame of a CAN bus."""

    stamp_ns: int  # UTC
    bus: str  # header.frame_id: the bus's name in the configuration
    id: int
    is_rtr: bool
    is_extended: bool
    is_error: bool
    data: bytes  # at most 8

    def encode(self) -> bytes:
        """CDR bytes."""
        out = _header(CdrWriter(), self.stamp_ns, self.bus).put("I", self.id)
        for value in (self.is_rtr, self.is_extended, self.is_error, len(self.data), *self.data.ljust(8, b"\x00")):
            out.put("B", value)
        return out.done()

    @classmethod
    def decode(cls, data: bytes | memoryview) -> Self:
        """The frame of CDR bytes. Raises ``ValueError`` when they are not such a message."""
        reader = CdrReader(data)
        seconds, nanoseconds = reader.get("i"), reader.get("I")
        bus, number = reader.get("s"), reader.get("I")
        is_rtr, is_extended, is_error, dlc = (reader.get("B") for _ in range(4))
        content = bytes(reader.get("B") for _ in range(8))
        stamp_ns = seconds * 10**9 + nanoseconds
        return cls(stamp_ns, bus, number, bool(is_rtr), bool(is_extended), bool(is_error), content[:dlc])


@dataclass(frozen=True)
class Mavlink:
    """wingshape_msgs/msg/Mavlink: the numbers of one MAVLink message."""

    time_ns: int  # UTC, when it was received
    system: int
    component: int
    message: str  # ATTITUDE, VFR_HUD, …
    fields: tuple[str, ...]
    values: tuple[float, ...]  # of the fields, as sent: in the units of the MAVLink definitions

    def encode(self) -> bytes:
        """CDR bytes."""
        out = CdrWriter().put("q", self.time_ns).put("B", self.system).put("B", self.component).put("s", self.message)
        out.put("I", len(self.fields))
        for field_name in self.fields:
            out.put("s", field_name)
        out.put("I", len(self.values))
        for value in self.values:
            out.put("d", value)
        return out.done()

    @classmethod
    def decode(cls, data: bytes | memoryview) -> Self:
        """The message of CDR bytes. Raises ``ValueError`` when they are not such a message."""
        reader = CdrReader(data)
        head = (reader.get("q"), reader.get("B"), reader.get("B"), reader.get("s"))
        names = tuple(reader.get("s") for _ in range(reader.get("I")))
        return cls(*head, names, tuple(reader.get("d") for _ in range(reader.get("I"))))


@dataclass(frozen=True)
class Ptp(_Message):
    """wingshape_msgs/msg/Ptp: what this computer's PTP clock is doing."""

    time_ns: int = _cdr("q")
    offset_ns: int = _cdr("q")  # own clock minus master's, at the last Sync; stale when no more come
    path_delay_ns: int = _cdr("q")
    sync_time_ns: int = _cdr("q")  # own clock when the last Sync came
    phc_offset_ns: int = _cdr("q")  # network card's clock minus system clock, UTC offset taken off; 0 without phc_valid
    time_sigma_ns: int = _cdr("q")  # one sigma of this computer's UTC; -1: not known
    utc_offset_s: int = _cdr("i")  # TAI - UTC as the grandmaster says
    steps_removed: int = _cdr("I")
    port_state: int = _cdr("B")  # PtpState
    answers: int = _cdr("B")  # 0: ptp4l does not answer, and nothing above means anything
    sync_fresh: int = _cdr("B")  # Sync messages are coming
    utc_offset_valid: int = _cdr("B")
    gm_present: int = _cdr("B")  # as ptp4l says: stays 1 after the master has died
    gm_clock_class: int = _cdr("B")
    phc_valid: int = _cdr("B")
    grandmaster: str = _cdr("s")
    clock: str = _cdr("s")  # own identity


@dataclass(frozen=True)
class Gate(_Message):
    """wingshape_msgs/msg/Gate: something that should be in order was not, from ``begin_ns`` on.

    One message when it begins, with ``end_ns`` 0, and one when it ends.
    """

    begin_ns: int = _cdr("q")
    end_ns: int = _cdr("q")  # 0: not yet
    name: str = _cdr("s")
    cause: str = _cdr("s")


@dataclass(frozen=True)
class Image:
    """A decoded sensor_msgs/msg/Image header; the pixels are ``data[pixels_at:]`` of its message."""

    stamp_ns: int
    frame_id: str
    height: int
    width: int
    encoding: str
    step: int
    pixels_at: int
    pixels_size: int


def image_prefix(stamp_ns: int, frame_id: str, height: int, width: int) -> bytes:
    """CDR bytes of a mono8 sensor_msgs/msg/Image up to its pixels; ``height * width`` bytes must follow."""
    out = _header(CdrWriter(), stamp_ns, frame_id)
    out.put("I", height).put("I", width).put("s", "mono8").put("B", 0).put("I", width).put("I", height * width)
    return out.done()


def decode_image(data: bytes | memoryview) -> Image:
    """Header of a sensor_msgs/msg/Image message.

    Raises:
        ValueError: not such a message, or its pixels end early.
    """
    reader = CdrReader(data)
    seconds, nanoseconds = reader.get("i"), reader.get("I")
    frame_id, height, width = reader.get("s"), reader.get("I"), reader.get("I")
    encoding, _, step, size = reader.get("s"), reader.get("B"), reader.get("I"), reader.get("I")
    if reader.position + size > len(data) or step * height != size or step < width:
        raise ValueError(f"image of {width}×{height} ({encoding}) does not match its {size} bytes")
    return Image(seconds * 10**9 + nanoseconds, frame_id, height, width, encoding, step, reader.position, size)


def encode_camera_info(stamp_ns: int, frame_id: str, height: int, width: int) -> bytes:
    """CDR bytes of a sensor_msgs/msg/CameraInfo without a calibration (zero K, as ROS says "uncalibrated")."""
    out = _header(CdrWriter(), stamp_ns, frame_id)
    out.put("I", height).put("I", width).put("s", "").put("I", 0)
    for _ in range(9 + 9 + 12):
        out.put("d", 0.0)
    out.put("I", 0).put("I", 0)
    for _ in range(4):
        out.put("I", 0)
    return out.put("B", 0).done()


@dataclass(frozen=True)
class Diagnostic:
    """One diagnostic_msgs/msg/DiagnosticStatus."""

    level: int  # 0 ok, 1 warning, 2 error, 3 stale
    name: str
    message: str
    values: tuple[tuple[str, str], ...] = ()


def encode_diagnostics(stamp_ns: int, statuses: tuple[Diagnostic, ...]) -> bytes:
    """CDR bytes of a diagnostic_msgs/msg/DiagnosticArray."""
    out = _header(CdrWriter(), stamp_ns, "")
    out.put("I", len(statuses))
    for status in statuses:
        out.put("B", status.level).put("s", status.name).put("s", status.message).put("s", "wingcap")
        out.put("I", len(status.values))
        for key, value in status.values:
            out.put("s", key).put("s", value)
    return out.done()


def _header(out: CdrWriter, stamp_ns: int, frame_id: str) -> CdrWriter:
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    return out.put("i", seconds).put("I", nanoseconds).put("s", frame_id)


_SEPARATOR = "=" * 80 + "\n"
_TIME = "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
_HEADER = "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"

SCHEMAS: dict[str, str] = {
    "sensor_msgs/msg/Image": _SEPARATOR.join(
        (
            "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\n"
            "uint32 step\nuint8[] data\n",
            _HEADER,
            _TIME,
        )
    ),
    "sensor_msgs/msg/CameraInfo": _SEPARATOR.join(
        (
            "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\n"
            "float64[9] k\nfloat64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\n"
            "sensor_msgs/RegionOfInterest roi\n",
            "MSG: sensor_msgs/RegionOfInterest\nuint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\n"
            "bool do_rectify\n",
            _HEADER,
            _TIME,
        )
    ),
    "diagnostic_msgs/msg/DiagnosticArray": _SEPARATOR.join(
        (
            "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status\n",
            "MSG: diagnostic_msgs/DiagnosticStatus\nbyte level\nstring name\nstring message\nstring hardware_id\n"
            "diagnostic_msgs/KeyValue[] values\n",
            "MSG: diagnostic_msgs/KeyValue\nstring key\nstring value\n",
            _HEADER,
            _TIME,
        )
    ),
    "wingshape_msgs/msg/Frame": Frame.definition(),
    "wingshape_msgs/msg/Trigger": Trigger.definition(),
    "wingshape_msgs/msg/Loss": Loss.definition(),
    "wingshape_msgs/msg/Ptp": Ptp.definition(),
    "wingshape_msgs/msg/Gate": Gate.definition(),
    "wingshape_msgs/msg/Analog": Analog.definition(),
    "wingshape_msgs/msg/Mavlink": (
        "int64 time_ns\nuint8 system\nuint8 component\nstring message\nstring[] fields\nfloat64[] values\n"
    ),
    "can_msgs/msg/Frame": _SEPARATOR.join(
        (
            "std_msgs/Header header\nuint32 id\nbool is_rtr\nbool is_extended\nbool is_error\nuint8 dlc\n"
            "uint8[8] data\n",
            _HEADER,
            _TIME,
        )
    ),
}
"""ROS 2 definitions of every type in a recording, by type name."""
