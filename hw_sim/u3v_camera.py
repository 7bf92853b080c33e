"""A USB3 Vision camera behind its plug: register accesses and trigger edges to frames as they go over the wire.

Modelled on the Flea3 FL3-U3-32S2M: its size, clock, frame buffer and the features of ``u3v_camera.xml``, which
describes the registers below to the host. Bootstrap registers, leader and trailer: USB3 Vision 1.0.1 and GenCP 1.1. No
USB here.
"""

import hashlib
import struct
import threading
from collections import deque
from dataclasses import dataclass
from pathlib import Path

XML = Path(__file__).with_name("u3v_camera.xml").read_bytes()
MAKER, MODEL = "Point Grey Research", "Flea3 FL3-U3-32S2M"
SENSOR_WIDTH, SENSOR_HEIGHT = 2080, 1552
MONO8, MONO16 = 0x01080001, 0x01100007
FRAME_BUFFER_BYTES = 32 << 20  # of the camera; what the host does not fetch in time waits in it
PATTERN_PERIOD = 251
CONTROL_BYTES = 1024  # of the largest command and acknowledgement
RESPONSE_MS = 200
"""The longest time to an answer. Aravis gives up a read of the stream after as long, too, and asks again; what arrives
in between is lost. On a wire that takes microseconds, in an emulated kernel milliseconds: frames that come less often
want a longer time there."""

ABRM, SBRM, SIRM, MANIFEST, XML_AT, FEATURES = 0x0, 0x10000, 0x20000, 0x30000, 0x40000, 0x100000
_STREAM_CONTROL, _PAYLOAD_SIZE = 0x4, 0x8
_LEADER = struct.Struct("<IHHQHHQIIIIIHH")
_TRAILER = struct.Struct("<IHHQHHQI")
_CHUNK_TRAILER = struct.Struct("<IHHQHHQII")  # and the number of the chunks' layout
_CHUNK_END = struct.Struct("<II")  # behind each chunk: its id, its length
LEADER_MAGIC, TRAILER_MAGIC = 0x4C563355, 0x54563355
IMAGE, IMAGE_WITH_CHUNKS = 1, 0x4001  # payload types
IMAGE_CHUNK, EXPOSURE_CHUNK, GAIN_CHUNK, COUNTER_CHUNK = 0x1000, 0x1001, 0x1002, 0x1003
_SELECTABLE = ((EXPOSURE_CHUNK, "d"), (GAIN_CHUNK, "d"), (COUNTER_CHUNK, "Q"))  # by ChunkSelector


class AccessError(Exception):
    """An access that the camera refuses; ``status`` is GenCP's code."""

    def __init__(self, status: int) -> None:
        super().__init__(hex(status))
        self.status = status


INVALID_PARAMETER, INVALID_ADDRESS, WRITE_PROTECTED = 0x8002, 0x8003, 0x8004


@dataclass(frozen=True)
class Register:
    """A feature's register: where, what it holds after power-up, and what may be written to it."""

    at: int  # offset from FEATURES
    format: str  # of struct, little-endian
    initial: float
    allowed: tuple[float, float] | None = None  # lowest and highest; None: read only
    step: float = 1  # a value is rounded down to steps, as the device can only do those


REGISTERS = {
    "SensorWidth": Register(0x000, "I", SENSOR_WIDTH),
    "SensorHeight": Register(0x004, "I", SENSOR_HEIGHT),
    "Width": Register(0x008, "I", SENSOR_WIDTH, (16, SENSOR_WIDTH), 16),
    "Height": Register(0x00C, "I", SENSOR_HEIGHT, (2, SENSOR_HEIGHT), 2),
    "OffsetX": Register(0x010, "I", 0, (0, SENSOR_WIDTH - 16), 16),
    "OffsetY": Register(0x014, "I", 0, (0, SENSOR_HEIGHT - 2), 2),
    "PixelFormat": Register(0x018, "I", MONO8, (MONO8, MONO16)),
    "TLParamsLocked": Register(0x01C, "I", 0, (0, 1)),
    "AcquisitionMode": Register(0x020, "I", 0, (0, 2)),
    "AcquisitionStart": Register(0x024, "I", 0, (0, 1)),
    "AcquisitionStop": Register(0x028, "I", 0, (0, 1)),
    "AcquisitionFrameRateAuto": Register(0x02C, "I", 2, (0, 2)),
    "AcquisitionFrameRateEnabled": Register(0x030, "I", 0, (0, 1)),
    "TriggerSelector": Register(0x034, "I", 0, (0, 0)),
    "TriggerMode": Register(0x038, "I", 0, (0, 1)),
    "TriggerSource": Register(0x03C, "I", 0, (0, 7)),
    "TriggerActivation": Register(0x040, "I", 0, (0, 1)),
    "TriggerOverlap": Register(0x044, "I", 0, (0, 1)),
    "TriggerSoftware": Register(0x048, "I", 0, (0, 1)),
    "ExposureMode": Register(0x04C, "I", 0, (0, 1)),
    "ExposureAuto": Register(0x050, "I", 2, (0, 2)),
    "GainAuto": Register(0x054, "I", 2, (0, 2)),
    "BlackLevelEnabled": Register(0x058, "I", 1, (0, 1)),
    "GammaEnabled": Register(0x05C, "I", 1, (0, 1)),
    "SensorShutterMode": Register(0x060, "I", 0, (0, 1)),
    "TimestampLatch": Register(0x064, "I", 0, (0, 1)),
    "ChunkModeActive": Register(0x068, "I", 0, (0, 1)),
    "ChunkSelector": Register(0x06C, "I", 0, (0, len(_SELECTABLE) - 1)),
    "ChunkEnable": Register(0x070, "I", 0, (0, 1)),
    "PayloadSize": Register(0x074, "I", 0),
    "ExposureTime": Register(0x080, "d", 10_000.0, (20.0, 31_900_000.0), 0.5),
    "Gain": Register(0x088, "d", 0.0, (0.0, 24.0), 0.1),
    "BlackLevel": Register(0x090, "d", 1.0, (0.0, 12.5), 0.0125),
    "AcquisitionFrameRate": Register(0x098, "d", 25.0, (1.0, 60.0), 0.001),
    "TriggerDelay": Register(0x0A0, "d", 0.0, (0.0, 1_000_000.0), 1.0),
    "DeviceTemperature": Register(0x0A8, "d", 41.5),
    "Timestamp": Register(0x0B0, "Q", 0),
}
_BY_ADDRESS = {FEATURES + register.at: name for name, register in REGISTERS.items()}
LINE0, SOFTWARE = 0, 7  # of TriggerSource


@dataclass(frozen=True)
class WireFrame:
    """One frame as it goes to the host: three transfers."""

    leader: bytes
    payload: memoryview
    trailer: bytes


@dataclass(frozen=True)
class Kind:
    """In what cameras of this model may differ."""

    buffer_frames: int = 0  # of its memory; 0: as many as it holds
    response_ms: int = RESPONSE_MS


@dataclass
class Counts:
    """What became of the trigger edges while the camera was taking frames."""

    exposed: int = 0
    sent: int = 0
    lost: int = 0  # as asked for
    overflowed: int = 0  # exposed into a full frame buffer: the frame's id is used up, the frame is gone


def pattern(number: int, index: int, size: int) -> memoryview:
    """The pixels that camera ``number`` shows on trigger ``index``: pixel k is (k + 17·index + 60·number) mod 251."""
    begin = (17 * index + 60 * number) % PATTERN_PERIOD
    return memoryview(bytes(range(PATTERN_PERIOD)) * (size // PATTERN_PERIOD + 2))[begin : begin + size]


def own_exposure_us(asked_us: float, index: int) -> float:
    """How long the camera exposes on trigger ``index``: unlike on a real one, told from what was set."""
    return asked_us + index % 8


def own_gain_db(asked_db: float, index: int) -> float:
    """Its gain then."""
    return asked_db + index % 4 / 10


class U3vCamera:
    """One camera since it was powered up. Thread-safe.

    ``edge`` is its trigger line, ``read`` and ``write`` its control channel, ``next_frame`` its stream. Its clock
    began at ``power_up_ns`` and runs ``drift_ppm`` fast.
    """

    def __init__(self, number: int, serial: str, power_up_ns: int, drift_ppm: int, counts: Counts, kind: Kind) -> None:
        self.counts = counts
        self._number = number
        self._power_up_ns = power_up_ns
        self._drift_ppm = drift_ppm
        self._buffer_frames = kind.buffer_frames
        self._values: dict[str, float] = {name: register.initial for name, register in REGISTERS.items()}
        self._bootstrap = _bootstrap(serial, kind.response_ms)
        self._frame_id = 0
        self._acquiring = False
        self._latched = 0
        self._chunks: set[int] = set()  # numbers of ChunkSelector
        self._cut_short: set[int] = set()
        self._to_lose: set[int] = set()
        self._held_until = -1
        self._waiting: deque[WireFrame] = deque()
        self._changed = threading.Condition()

    def cut_short(self, index: int) -> None:
        """Half of this trigger's frame will be missing on the wire."""
        self._cut_short.add(index)

    def lose(self, index: int) -> None:
        """This trigger's frame will be exposed, and never sent."""
        self._to_lose.add(index)

    def hold_until(self, index: int) -> None:
        """From now on nothing leaves the frame buffer, up to and including the edge of this trigger."""
        with self._changed:
            self._held_until = index

    @property
    def streaming(self) -> bool:
        """Whether the host wants frames."""
        return self._acquiring and bool(self._get(SIRM + _STREAM_CONTROL, "I") & 1)

    def edge(self, index: int, time_ns: int) -> None:
        """A rising edge on Line0 (UTC)."""
        if self._values["TriggerMode"] == 1 and self._values["TriggerSource"] == LINE0:
            self._expose(index, time_ns)
        with self._changed:
            if index >= self._held_until:
                self._held_until = -1
                self._changed.notify_all()

    def next_frame(self, timeout_s: float) -> WireFrame | None:
        """The oldest frame that was not sent, or None after ``timeout_s``. It stays in the buffer till ``sent``."""
        with self._changed:
            ready = self._changed.wait_for(lambda: bool(self._waiting) and self._held_until < 0, timeout_s)
            return self._waiting[0] if ready else None

    def sent(self, frame: WireFrame) -> None:
        """The host has taken the frame."""
        with self._changed:
            if self._waiting and self._waiting[0] is frame:
                self._waiting.popleft()
                self.counts.sent += 1

    def read(self, address: int, size: int) -> bytes:
        """Registers or the XML.

        Raises:
            AccessError: there is nothing at this address.
        """
        name = _BY_ADDRESS.get(address)
        if name is not None:
            value = self._read(name)
            data = struct.pack("<" + REGISTERS[name].format, _number_of(REGISTERS[name], value))
            return data.ljust(size, b"\0")[:size]
        if address == SIRM + _PAYLOAD_SIZE:
            self._put(address, "Q", self._payload_bytes)
        for begin, memory in (*self._bootstrap.items(), (XML_AT, XML)):
            if begin <= address < begin + len(memory):
                return bytes(memory[address - begin :][:size]).ljust(size, b"\0")
        raise AccessError(INVALID_ADDRESS)

    def write(self, address: int, data: bytes, now_ns: int) -> None:
        """A register.

        Raises:
            AccessError: no register, read only, or a value that the camera does not take.
        """
        name = _BY_ADDRESS.get(address)
        if name is None:
            begin = SIRM if SIRM <= address < SIRM + 0x30 else SBRM if SBRM <= address < SBRM + 0x48 else ABRM
            memory = self._bootstrap[begin]
            if not 0 <= address - begin <= len(memory) - len(data):
                raise AccessError(INVALID_ADDRESS)
            memory[address - begin : address - begin + len(data)] = data
            if address == SIRM + _STREAM_CONTROL and not data[0] & 1:
                self._forget_frames()
            return
        register = REGISTERS[name]
        (value,) = struct.unpack("<" + register.format, data)
        if register.allowed is None:
            raise AccessError(WRITE_PROTECTED)
        lowest, highest = register.allowed
        if not lowest <= value <= highest or (name == "PixelFormat" and value not in (MONO8, MONO16)):
            raise AccessError(INVALID_PARAMETER)
        self._values[name] = lowest + (value - lowest) // register.step * register.step
        self._act(name, now_ns)

    def _act(self, name: str, now_ns: int) -> None:
        if name == "AcquisitionStart":
            self._acquiring = True
        elif name == "AcquisitionStop":
            self._acquiring = False
            self._forget_frames()
        elif name == "TriggerSoftware" and self._values["TriggerSource"] == SOFTWARE:
            self._expose(self._frame_id, now_ns)
        elif name == "TimestampLatch":
            self._latched = self._clock_ns(now_ns)
        elif name == "ChunkEnable":
            change = self._chunks.add if self._values[name] else self._chunks.discard
            change(int(self._values["ChunkSelector"]))

    def _read(self, name: str) -> float:
        if name == "Timestamp":
            return self._latched
        if name == "PayloadSize":
            return self._payload_bytes
        if name == "ChunkEnable":
            return self._values["ChunkSelector"] in self._chunks
        return self._values[name]

    def _expose(self, index: int, time_ns: int) -> None:
        if not self.streaming:
            return
        size = self._payload_bytes
        with self._changed:
            self.counts.exposed += 1
            frame_id = self._frame_id
            self._frame_id += 1
            if index in self._to_lose:
                self.counts.lost += 1
                return
            if len(self._waiting) >= (self._buffer_frames or FRAME_BUFFER_BYTES // size):
                self.counts.overflowed += 1
                return
            width, height, left, top = (int(self._values[n]) for n in ("Width", "Height", "OffsetX", "OffsetY"))
            pixel_format = int(self._values["PixelFormat"])
            chunks = self._chunk_data(index, frame_id)
            payload = pattern(self._number, index, self._image_bytes)
            payload = memoryview(bytes(payload) + chunks) if chunks else payload
            leader = _LEADER.pack(
                *(LEADER_MAGIC, 0, _LEADER.size, frame_id, 0, IMAGE_WITH_CHUNKS if chunks else IMAGE),
                *(self._clock_ns(time_ns), pixel_format, width, height, left, top, 0, 0),
            )
            layout = (_CHUNK_TRAILER, 1) if chunks else (_TRAILER,)
            trailer = layout[0].pack(TRAILER_MAGIC, 0, layout[0].size, frame_id, 0, 0, size, height, *layout[1:])
            payload = payload[: size // 2] if index in self._cut_short else payload
            self._waiting.append(WireFrame(leader, payload, trailer))
            self._changed.notify_all()

    def _chunk_data(self, index: int, frame_id: int) -> bytes:
        """What follows the pixels: their own end, then each chunk and its end. The frame counter begins at 1."""
        if not self._values["ChunkModeActive"]:
            return b""
        facts = (
            own_exposure_us(self._values["ExposureTime"], index),
            own_gain_db(self._values["Gain"], index),
            frame_id + 1,
        )
        data = _CHUNK_END.pack(IMAGE_CHUNK, self._image_bytes)
        for number in sorted(self._chunks):
            (chunk_id, format), value = _SELECTABLE[number], facts[number]
            data += struct.pack("<" + format, value) + _CHUNK_END.pack(chunk_id, struct.calcsize(format))
        return data

    def _forget_frames(self) -> None:
        with self._changed:
            self._waiting.clear()

    def _clock_ns(self, time_ns: int) -> int:
        since_ns = max(0, time_ns - self._power_up_ns)
        return since_ns + since_ns * self._drift_ppm // 10**6

    @property
    def _payload_bytes(self) -> int:
        return self._image_bytes + len(self._chunk_data(0, 0))

    @property
    def _image_bytes(self) -> int:
        bits = int(self._values["PixelFormat"]) >> 16 & 0xFF
        return int(self._values["Width"] * self._values["Height"]) * bits // 8

    def _get(self, address: int, format: str) -> int:
        return int(struct.unpack_from("<" + format, self._bootstrap[SIRM], address - SIRM)[0])

    def _put(self, address: int, format: str, value: int) -> None:
        struct.pack_into("<" + format, self._bootstrap[SIRM], address - SIRM, value)


def _number_of(register: Register, value: float) -> float | int:
    return value if register.format == "d" else int(value)


def _bootstrap(serial: str, response_ms: int) -> dict[int, bytearray]:
    """The bootstrap registers after power-up: GenCP's, USB3 Vision's, the stream's, and the manifest."""
    abrm, sbrm, sirm, manifest = bytearray(0x1000), bytearray(0x48), bytearray(0x30), bytearray(8 + 64)
    texts = {
        0x04: MAKER,
        0x44: MODEL,
        0x84: "Flea3",
        0xC4: "emulated by wingshape",
        0x144: serial,
    }
    for at, text in texts.items():
        abrm[at : at + len(text)] = text.encode()
    struct.pack_into("<I", abrm, 0x00, 0x00010001)  # GenCP 1.1
    struct.pack_into("<I", abrm, 0x1CC, response_ms)
    struct.pack_into("<QQ", abrm, 0x1D0, MANIFEST, SBRM)
    struct.pack_into("<Q", abrm, 0x1FC, 1)  # ns a tick
    struct.pack_into("<I", sbrm, 0x00, 0x00010000)  # USB3 Vision 1.0
    struct.pack_into("<III", sbrm, 0x14, CONTROL_BYTES, CONTROL_BYTES, 1)
    struct.pack_into("<QI", sbrm, 0x20, SIRM, len(sirm))
    struct.pack_into("<I", sbrm, 0x40, 8)  # SuperSpeed
    struct.pack_into("<II", sirm, 0x10, _LEADER.size, _CHUNK_TRAILER.size)
    struct.pack_into("<Q", manifest, 0, 1)
    struct.pack_into("<HBBIQQ20s", manifest, 8, 0, 0, 1, 0x01010000, XML_AT, len(XML), hashlib.sha1(XML).digest())
    return {ABRM: abrm, SBRM: sbrm, SIRM: sirm, MANIFEST: manifest}
