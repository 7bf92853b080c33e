"""One MCAP file to its chunks and messages, record by record; what is wrong is listed, and what follows it is found."""

import io
import mmap
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from isal.isal_zlib import crc32
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from capture.errors import RecordingError
from capture.record import PROVENANCE
from capture.segment import GUARD, GUARD_OPCODE, MAGIC, PADDING_OPCODE

_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQIIQ")
_SEARCH_BYTES = 1 << 20
_READ_AHEAD_BYTES = 16 << 20
_KNOWN = frozenset({*Opcode, PADDING_OPCODE, GUARD_OPCODE})
FOOTER_BYTES = 9 + 20 + len(MAGIC)
_FOOTER_HEAD = _RECORD.pack(Opcode.FOOTER, 20)


@dataclass(frozen=True)
class ScannedMessage:
    """A message as it lies in the file. ``data`` is only valid while the scan goes on."""

    topic: str
    sequence: int
    log_ns: int
    publish_ns: int
    data: memoryview
    chunk_at: int  # where its chunk begins: frames and their metadata share one


@dataclass
class Scan:
    """What a pass over a file found, complete once ``messages`` is exhausted."""

    path: Path
    size: int
    provenance: dict[str, str] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    topics: dict[int, str] = field(default_factory=dict)  # by channel id
    types: dict[str, str] = field(default_factory=dict)  # by topic
    attachments: list[tuple[str, bytes]] = field(default_factory=list)
    schemas: dict[int, str] = field(default_factory=dict)
    chunks: int = 0
    closed: bool = False  # has DataEnd, summary and footer
    problems: list[str] = field(default_factory=list)


def scan(path: Path) -> tuple[Scan, Iterator[ScannedMessage]]:
    """Begin a pass over ``path``. Iterate the messages to the end, then read the ``Scan``.

    Raises:
        RecordingError: the file cannot be opened, or is not MCAP from its first bytes on.
    """
    try:
        with path.open("rb") as file:
            size = path.stat().st_size
            data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) if size else None
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror})") from error
    if data is not None:
        data.madvise(mmap.MADV_SEQUENTIAL)
    if data is None or data[: len(MAGIC)] != MAGIC:
        raise RecordingError(f"{path}: not an MCAP file (or its beginning is damaged): restore it from a copy")
    found = Scan(path, size)
    return found, _messages(found, memoryview(data))


def _messages(found: Scan, data: memoryview) -> Iterator[ScannedMessage]:
    at = len(MAGIC)
    open_from: int | None = 0  # first byte of the records outside chunks that no guard has covered yet
    index: dict[int, list[tuple[int, int]]] = {}
    while at + _RECORD.size <= found.size:
        opcode, length = _RECORD.unpack_from(data, at)
        end = at + _RECORD.size + length
        known = opcode in _KNOWN and end <= found.size
        if not known or _is_damaged(found, opcode, data[at + _RECORD.size : end], at, index):
            after = _next_chunk(data, at)  # the length of a damaged record is not to be believed
            if after is None:
                break
            if not known:
                found.problems.append(f"bytes {at} to {after} are damaged: a hole")
            at, open_from = after, None
            continue
        body = data[at + _RECORD.size : end]
        if opcode in (Opcode.CHUNK, Opcode.DATA_END):
            _demand(found, at, open_from is None, "records before this that no checksum covers")
            open_from = None
        if opcode == Opcode.CHUNK:
            _read_ahead(data, end)
            index = {}
            yield from _chunk(found, body, at, index)
        elif opcode == GUARD_OPCODE:
            covered_from, crc = GUARD.unpack(body) if length == GUARD.size else (None, 0)
            good = covered_from == open_from and covered_from is not None and crc32(data[covered_from:at]) == crc
            _demand(found, at, good, "header, channels or metadata that differ from their CRC")
            open_from = None
        elif opcode == Opcode.DATA_END:
            _demand(found, at, body == bytes(4), "a closing record that was altered")
            found.closed = _check_summary(found, data, end)
            return
        elif opcode not in (Opcode.MESSAGE_INDEX, PADDING_OPCODE):
            open_from = at if open_from is None else open_from
            _take_record(found, opcode, body, at)
        at = end
    found.problems.append(
        f"ends at byte {at} of {found.size} without its closing records: it was not closed, or was cut"
    )


def _read_ahead(data: memoryview, at: int) -> None:
    """Ask for what comes next, or each page would be waited for as it is touched: slower by half from disk."""
    start = at // mmap.PAGESIZE * mmap.PAGESIZE
    if isinstance(data.obj, mmap.mmap) and start < len(data):
        data.obj.madvise(mmap.MADV_WILLNEED, start, min(_READ_AHEAD_BYTES, len(data) - start))


def _is_damaged(found: Scan, opcode: int, body: memoryview, at: int, index: dict[int, list[tuple[int, int]]]) -> bool:
    """Whether a chunk, an index or a padding is not what it must be; what is wrong goes to the problems."""
    wrong = ""
    if opcode == Opcode.CHUNK:
        wrong = _what_is_wrong_with_chunk(body)
    elif opcode == Opcode.MESSAGE_INDEX and not _agrees(body, index):
        wrong = "a message index that does not agree with its chunk"
    elif opcode == PADDING_OPCODE and any(body):
        wrong = "padding that is not empty"
    _demand(found, at, not wrong, wrong)
    return bool(wrong)


def _what_is_wrong_with_chunk(body: memoryview) -> str:
    if len(body) <= _CHUNK.size:
        return "a chunk too short for its own header"
    _, _, size, crc, compression, stored = _CHUNK.unpack_from(body)
    content = body[_CHUNK.size :]
    if compression or size != stored or len(content) != size:
        return "a chunk whose lengths do not agree"
    return "" if crc32(content) == crc else "a chunk whose content differs from its CRC"


def _next_chunk(data: memoryview, at: int) -> int | None:
    """Where the next chunk with a good CRC begins after the damaged byte ``at``; None when there is none."""
    begins = bytes([Opcode.CHUNK])
    searched = at + 1
    while searched < len(data):
        window = bytes(data[searched : searched + _SEARCH_BYTES])
        offset = window.find(begins)
        while offset >= 0:
            start = searched + offset
            if _good_chunk(data, start):
                return start
            offset = window.find(begins, offset + 1)
        searched += _SEARCH_BYTES
    return None


def _good_chunk(data: memoryview, at: int) -> bool:
    body_at = at + _RECORD.size
    if body_at + _CHUNK.size > len(data):
        return False
    _, length = _RECORD.unpack_from(data, at)
    size: int
    crc: int
    _, _, size, crc, compression, stored = _CHUNK.unpack_from(data, body_at)
    content_at = body_at + _CHUNK.size
    if compression or size != stored or length != _CHUNK.size + size or not size or content_at + size > len(data):
        return False
    return crc32(data[content_at : content_at + size]) == crc


def _demand(found: Scan, at: int, fulfilled: bool, otherwise: str) -> None:
    if not fulfilled:
        found.problems.append(f"byte {at}: {otherwise}")


def _take_record(found: Scan, opcode: int, body: memoryview, at: int) -> None:
    try:
        if opcode == Opcode.METADATA:
            record = records.Metadata.read(_stream(body))
            found.metadata[record.name] = record.metadata
            if record.name == PROVENANCE:
                found.provenance = record.metadata
        elif opcode == Opcode.CHANNEL:
            channel = records.Channel.read(_stream(body))
            found.topics[channel.id] = channel.topic
            found.types[channel.topic] = found.schemas.get(channel.schema_id, "")
        elif opcode == Opcode.SCHEMA:
            schema = records.Schema.read(_stream(body))
            found.schemas[schema.id] = schema.name
        elif opcode == Opcode.ATTACHMENT:
            attachment = records.Attachment.read(_stream(body))
            found.attachments.append((attachment.name, attachment.data))
        elif opcode != Opcode.HEADER:
            found.problems.append(f"byte {at}: a record of kind {opcode:#x} that does not belong here")
    except (McapError, ValueError, struct.error) as error:
        found.problems.append(f"byte {at}: a record that cannot be read ({error})")


def _chunk(found: Scan, body: memoryview, at: int, index: dict[int, list[tuple[int, int]]]) -> Iterator[ScannedMessage]:
    """The messages of a good chunk; ``index`` is filled with what its MessageIndex records must say."""
    first_ns, last_ns, size, *_ = _CHUNK.unpack_from(body)
    content = body[_CHUNK.size :]
    found.chunks += 1
    inner = 0
    while inner + _RECORD.size <= size:
        opcode, length = _RECORD.unpack_from(content, inner)
        start = inner + _RECORD.size
        if opcode == Opcode.MESSAGE:
            channel, sequence, log_ns, publish_ns = _MESSAGE.unpack_from(content, start)
            index.setdefault(channel, []).append((log_ns, inner))
            yield ScannedMessage(
                found.topics.get(channel, f"channel {channel}"),
                sequence,
                log_ns,
                publish_ns,
                content[start + _MESSAGE.size : start + length],
                at,
            )
        inner = start + length
    times = [log_ns for entries in index.values() for log_ns, _ in entries]
    agree = bool(times) and (min(times), max(times)) == (first_ns, last_ns)
    _demand(found, at, agree, "a chunk whose header has the wrong times")


def _agrees(body: memoryview, index: dict[int, list[tuple[int, int]]]) -> bool:
    """Whether a MessageIndex says what its chunk holds."""
    count = max(0, len(body) - 6) // 16
    channel, size = struct.unpack_from("<HI", body) if len(body) >= 6 else (0, 0)
    entries = [struct.unpack_from("<QQ", body, 6 + 16 * k) for k in range(count)]
    return size == 16 * count and len(body) == 6 + size and entries == index.get(channel)


def _check_summary(found: Scan, data: memoryview, at: int) -> bool:
    """Whether the summary and footer that begin at ``at`` are whole; what is wrong goes to the problems."""
    footer_at = found.size - FOOTER_BYTES
    if footer_at < at or bytes(data[found.size - len(MAGIC) :]) != MAGIC:
        found.problems.append(f"byte {at}: the summary is cut short")
        return False
    head, summary_at, _, crc = struct.unpack_from("<9sQQI", data, footer_at)
    if summary_at != at or crc32(data[at : footer_at + 25]) != crc or bytes(head) != _FOOTER_HEAD:
        found.problems.append(f"byte {at}: the summary differs from its CRC")
        return False
    indexed = sum(1 for opcode in _opcodes(data, at, footer_at) if opcode == Opcode.CHUNK_INDEX)
    if indexed != found.chunks:
        found.problems.append(f"the summary names {indexed} chunks, the file holds {found.chunks} good ones")
        return False
    return True


def _opcodes(data: memoryview, at: int, end: int) -> Iterator[int]:
    while at + _RECORD.size <= end:
        opcode, length = _RECORD.unpack_from(data, at)
        yield opcode
        at += _RECORD.size + length


def _stream(body: memoryview) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(bytes(body)))
