"""What a simulated camera and its client say to each other on the rig's socket. No I/O, no simulation.

The socket is a Unix one of type SEQPACKET: a message is a packet. The client begins with ``OpenRequest``; the rig
answers with ``OpenReply``, and with it passes a file descriptor of shared memory that holds ``SLOTS`` images. A client
that begins with ``Command`` instead is a hand at the rig's cables; it is answered ``K`` or in words. After an open:

``Q``           client: one more frame is wanted; a frame that nobody wants is dropped in the camera
``A`` / ``D``   client: arm / disarm, answered by the same letter; disarming also takes back what was wanted
``F`` slot      client: the image in this shared slot has been copied
``G`` …         rig: a frame is in a shared slot (``FrameMessage``)
"""

import json
import struct
from dataclasses import asdict, astuple, dataclass

from capture.camera.base import CameraDescription

SLOTS = 12
WANT, ARM, DISARM, FREE, FRAME = b"Q", b"A", b"D", b"F", b"G"
DONE = b"K"
DEEDS = ("unplug", "plug", "freeze", "thaw", "drop", "truncate")
_FRAME = struct.Struct("<cIQQIf?")
_FREE = struct.Struct("<cI")
MAX_PACKET_BYTES = 4096


@dataclass(frozen=True)
class OpenRequest:
    """Which camera, and what it is to be."""

    camera: str
    width: int
    height: int
    exposure_us: int
    gain_db: float

    def encode(self) -> bytes:
        """The packet."""
        return json.dumps(asdict(self)).encode()

    @classmethod
    def decode(cls, packet: bytes) -> "OpenRequest":
        """The request of a packet. Raises ``ValueError`` when it is none."""
        try:
            return cls(**json.loads(packet))
        except (TypeError, UnicodeDecodeError) as error:
            raise ValueError(f"not a request: {packet[:40]!r}") from error


@dataclass(frozen=True)
class OpenReply:
    """The camera's description, or why there is none."""

    description: CameraDescription | None
    error: str

    def encode(self) -> bytes:
        """The packet."""
        return json.dumps(asdict(self)).encode()

    @classmethod
    def decode(cls, packet: bytes) -> "OpenReply":
        """The reply of a packet. Raises ``ValueError`` when it is none."""
        try:
            table = json.loads(packet)
            description = table["description"]
            return cls(None if description is None else CameraDescription(**description), table["error"])
        except (TypeError, KeyError, UnicodeDecodeError) as error:
            raise ValueError(f"not a reply: {packet[:40]!r}") from error


@dataclass(frozen=True)
class Command:
    """What is done to a camera: ``unplug`` and ``plug`` its cable, ``freeze`` and ``thaw`` its firmware (it no longer
    exposes nor answers), ``drop`` or ``truncate`` its next frame."""

    deed: str
    camera: str

    def encode(self) -> bytes:
        """The packet."""
        return json.dumps(asdict(self)).encode()

    @classmethod
    def decode(cls, packet: bytes) -> "Command":
        """The command of a packet. Raises ``ValueError`` when it is none."""
        try:
            command = cls(**json.loads(packet))
        except (TypeError, UnicodeDecodeError) as error:
            raise ValueError(f"not a command: {packet[:40]!r}") from error
        if command.deed not in DEEDS:
            raise ValueError(f"{command.deed!r} is not one of {', '.join(DEEDS)}")
        return command


@dataclass(frozen=True)
class FrameMessage:
    """A frame that waits in shared memory."""

    slot: int
    frame_id: int
    device_ticks: int
    exposure_us: int
    gain_db: float
    complete: bool

    def encode(self) -> bytes:
        """The packet."""
        return _FRAME.pack(FRAME, *astuple(self))

    @classmethod
    def decode(cls, packet: bytes) -> "FrameMessage":
        """The frame of a packet. Raises ``ValueError`` when it is none."""
        if len(packet) != _FRAME.size:
            raise ValueError(f"not a frame: {packet[:40]!r}")
        return cls(*_FRAME.unpack(packet)[1:])


def encode_free(slot: int) -> bytes:
    """The packet that gives a shared slot back."""
    return _FREE.pack(FREE, slot)


def decode_free(packet: bytes) -> int:
    """The slot that a packet gives back. Raises ``ValueError`` when it is no such packet."""
    if len(packet) != _FREE.size:
        raise ValueError(f"not a slot: {packet[:40]!r}")
    slot: int = _FREE.unpack(packet)[1]
    return slot
