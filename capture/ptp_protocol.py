"""PTP management messages to values and back: IEEE 1588-2008, clause 15, and linuxptp's own (NP). No I/O."""

import struct
from dataclasses import dataclass
from enum import IntEnum

from capture.record import PtpState

_HEADER = struct.Struct(">BBHBBHqI8sHHBb")
_BODY = struct.Struct(">10sBBBB")  # target, starting hops, hops, action, reserved
_TLV = struct.Struct(">HHH")  # type, length, management id
_MANAGEMENT, _MANAGEMENT_ERROR = 1, 2
_EVERYONE = b"\xff" * 10
_RESPONSE = 2
_MESSAGE_TYPE = 0x0D
MAX_MESSAGE_BYTES = 1500


class Action(IntEnum):
    """What a request wants."""

    GET = 0
    SET = 1


class Id(IntEnum):
    """The management ids in use."""

    DEFAULT_DATA_SET = 0x2000
    CURRENT_DATA_SET = 0x2001
    PARENT_DATA_SET = 0x2002
    TIME_PROPERTIES_DATA_SET = 0x2003
    PORT_DATA_SET = 0x2004
    TIME_STATUS_NP = 0xC000
    SUBSCRIBE_EVENTS_NP = 0xC003


NOTIFY_PORT_STATE, NOTIFY_TIME_SYNC = 0, 1


class NotManagement(ValueError):
    """Bytes that are no management message, or one that ends early."""


@dataclass(frozen=True)
class Reply:
    """A management message from ptp4l: an answer, or one that it sends because an event was subscribed to."""

    sequence: int
    id: int  # 0 where it is an error that names none
    data: bytes
    refused: bool = False


@dataclass(frozen=True)
class PtpStatus:
    """What ptp4l says of its clock, at one instant."""

    port_state: PtpState  # of the port that follows a master, where there is one
    offset_ns: int  # own clock minus master's, at the last Sync; goes stale when the master is gone
    path_delay_ns: int
    ingress_ns: int  # own clock when the last Sync was received: stands still when no more come
    gm_present: bool  # stays true after the master has died
    gm_identity: int
    gm_clock_class: int
    clock_identity: int  # own
    steps_removed: int
    utc_offset_s: int  # TAI - UTC
    utc_offset_valid: bool
    ptp_timescale: bool
    time_traceable: bool


def encode_request(action: Action, id: Id, sequence: int, domain: int, data: bytes = b"") -> bytes:
    """A request to all ports of the clock behind the socket."""
    tlv = _TLV.pack(_MANAGEMENT, 2 + len(data), id) + data
    length = _HEADER.size + _BODY.size + len(tlv)
    header = _HEADER.pack(_MESSAGE_TYPE, 2, length, domain, 0, 0, 0, 0, bytes(8), 1, sequence, 4, 0x7F)
    return header + _BODY.pack(_EVERYONE, 0, 0, action, 0) + tlv


def encode_subscription(events: tuple[int, ...], seconds: int) -> bytes:
    """Data of SUBSCRIBE_EVENTS_NP: which events shall be told, for how long."""
    mask = bytearray(64)
    for event in events:
        mask[event // 8] |= 1 << event % 8
    return struct.pack(">H", seconds) + bytes(mask)


def decode_reply(message: bytes) -> Reply:
    """A message that came from ptp4l.

    Raises:
        NotManagement: it is none, or ends early.
    """
    try:
        kind, _, length, *_, sequence, _, _ = _HEADER.unpack_from(message)
        *_, action, _ = _BODY.unpack_from(message, _HEADER.size)
        at = _HEADER.size + _BODY.size
        tlv, size, id = _TLV.unpack_from(message, at)
    except struct.error as error:
        raise NotManagement(f"a message of {len(message)} bytes ends early") from error
    if kind & 0x0F != _MESSAGE_TYPE or action & 0x0F != _RESPONSE or length > len(message):
        raise NotManagement(f"message of type {kind & 0x0F}, action {action & 0x0F}, {length} of {len(message)} bytes")
    if tlv == _MANAGEMENT_ERROR:
        named = struct.unpack_from(">H", message, at + _TLV.size)[0] if len(message) >= at + _TLV.size + 2 else 0
        return Reply(sequence, named, b"", refused=True)
    if tlv != _MANAGEMENT:
        raise NotManagement(f"TLV of type {tlv}")
    return Reply(sequence, id, message[at + _TLV.size : at + 4 + size])


def number_of_ports(default_data_set: bytes) -> int:
    """How many ports the clock has."""
    return int(_unpack(">xxH", default_data_set)[0])


def decode_status(
    default: bytes, current: bytes, parent: bytes, time_properties: bytes, time_status: bytes, ports: list[bytes]
) -> PtpStatus:
    """The data sets of one clock, put together.

    Raises:
        NotManagement: one of them ends early.
    """
    (clock_identity,) = _unpack(">10xQ", default)
    steps_removed, _, delay = _unpack(">Hqq", current)
    gm_class, gm_identity = _unpack(">19xB4xQ", parent)
    utc_offset_s, flags = _unpack(">hB", time_properties)
    offset_ns, ingress_ns, gm_present = _unpack(">qq22xi", time_status)
    states = [_port_state(_unpack(">10xB", port)[0]) for port in ports]
    return PtpStatus(
        port_state=max(states, default=PtpState.UNKNOWN),  # SLAVE is the highest
        offset_ns=offset_ns,
        path_delay_ns=round(delay / 65536),
        ingress_ns=ingress_ns,
        gm_present=bool(gm_present),
        gm_identity=gm_identity,
        gm_clock_class=gm_class,
        clock_identity=clock_identity,
        steps_removed=steps_removed,
        utc_offset_s=utc_offset_s,
        utc_offset_valid=bool(flags & 0x04),
        ptp_timescale=bool(flags & 0x08),
        time_traceable=bool(flags & 0x10),
    )


def identity_text(identity: int) -> str:
    """A clock identity as linuxptp writes it: ``aabbcc.ddee.ff0011``."""
    text = f"{identity:016x}"
    return f"{text[:6]}.{text[6:10]}.{text[10:]}"


def _port_state(code: int) -> PtpState:
    """linuxptp has one state of its own, GRAND_MASTER (10)."""
    if code == 10:
        return PtpState.MASTER
    return PtpState(code) if code in PtpState._value2member_map_ else PtpState.UNKNOWN


def _unpack(layout: str, data: bytes) -> tuple[int, ...]:
    try:
        return struct.unpack_from(layout, data)
    except struct.error as error:
        raise NotManagement(f"a data set of {len(data)} bytes ends early") from error
