"""MCAP files to the places of their messages, and to the messages themselves: one read a chunk, CRC verified.

Only what is needed to read a recording fast and surely: summary and chunks are walked here by hopping from record to
record, so that indexing never touches a pixel; a summary counts only if its CRC and its number of chunks agree with it.
Format: https://mcap.dev/spec (records and opcodes), version 0.
"""

import hashlib
import os
import struct
from collections.abc import Container, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from isal.isal_zlib import crc32
from mcap.exceptions import McapError
from mcap.records import Chunk
from mcap.stream_reader import get_chunk_data_stream

from process.spans import Range, Spans

MAGIC = b"\x89MCAP0\r\n"
FOOTER, CHANNEL, MESSAGE, CHUNK, CHUNK_INDEX, STATISTICS, DATA_END = 0x02, 0x04, 0x05, 0x06, 0x08, 0x0B, 0x0F

_HEAD = struct.Struct("<BQ")  # opcode and length of every record
_MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_FOOTER = struct.Struct("<BQQQI")  # with opcode and length; summary, summary offsets, CRC of the summary
_CHUNK_INDEX = struct.Struct("<QQQQ")  # start, end, place and size of the chunk; more follows
_STATISTICS = struct.Struct("<Q2x12xI")  # messages, chunks; others between and behind
_CHUNK_HEAD = struct.Struct("<QQQI")  # start, end, uncompressed size, uncompressed CRC
_DATA_END_SIZE = _HEAD.size + 4
_LONGEST_HEAD = 4096  # bytes read to learn a record's head; a channel record fits, too


@dataclass(frozen=True, slots=True)
class Place:
    """Where a message's data lies: ``size`` bytes at ``at`` in the uncompressed records of a chunk of a file."""

    path: str
    chunk_at: int
    chunk_size: int
    at: int
    size: int


@dataclass(frozen=True, slots=True)
class MessageHead:
    """A message without its data."""

    topic: str
    sequence: int
    publish_time_ns: int
    place: Place


@dataclass
class FileIndex:
    """The messages of one file, in file order, and what is wrong with the file."""

    messages: list[MessageHead] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    fingerprint: str = ""
    """SHA-256 over place, size and CRC-32 of every chunk: of all its messages, as far as the CRCs tell"""


@dataclass(frozen=True, slots=True)
class _ChunkHead:
    uncompressed_size: int
    crc: int
    compression: str
    records_at: int  # from the start of the chunk record
    records_size: int


class BadChunk(ValueError):
    """A chunk whose bytes are not what was written."""


def index_file(path: Path, topics: Container[str] | None = None) -> FileIndex:
    """The messages of ``path`` on ``topics``; None: on all.

    A file that ends early is read up to its last complete chunk; nothing is raised.
    """
    index = FileIndex()
    channels: dict[int, str] = {}
    content = hashlib.sha256()
    try:
        with _Descriptor(path) as descriptor:
            chunks = _chunks_of_summary(descriptor, channels)
            if chunks is None:
                chunks = _chunks_by_scanning(path, descriptor, channels, index.problems)
            for at, size in chunks:
                try:
                    head = _chunk_head(os.pread(descriptor, 256, at), size)
                    content.update(struct.pack("<QQI", at, size, head.crc))
                    found = _messages_of_chunk(str(path), descriptor, at, size, head, channels)
                    index.messages.extend(one for one in found if topics is None or one.topic in topics)
                except (BadChunk, McapError) as error:
                    index.problems.append(f"{path}: chunk at byte {at} is not readable ({error})")
    except OSError as error:
        index.problems.append(f"{path}: {error.strerror or error}")
    index.fingerprint = content.hexdigest()
    return index


def stream_messages(
    path: Path, topics: Container[str], problems: list[str]
) -> Iterator[tuple[MessageHead, memoryview]]:
    """Each message of ``path`` on ``topics`` with its data, a chunk in memory at a time; no others are read.

    What cannot be read is said in ``problems`` and left out; nothing is raised.
    """
    channels: dict[int, str] = {}
    try:
        with _Descriptor(path) as descriptor:
            chunks = _chunks_of_summary(descriptor, channels)
            if chunks is None:
                chunks = _chunks_by_scanning(path, descriptor, channels, problems)
            elif not any(topic in topics for topic in channels.values()):
                return
            for at, size in chunks:
                try:
                    head = _chunk_head(os.pread(descriptor, 256, at), size)
                    found = _messages_of_chunk(str(path), descriptor, at, size, head, channels)
                    heads = [one for one in found if one.topic in topics]
                    if not heads:
                        continue
                    chunk = memoryview(bytearray(size))
                    _read_fully(descriptor, chunk, at)
                    records = _records_of_chunk(chunk)
                except (BadChunk, McapError) as error:
                    problems.append(f"{path}: chunk at byte {at} is not readable ({error})")
                    continue
                for one in heads:
                    yield one, records[one.place.at : one.place.at + one.place.size]
    except OSError as error:
        problems.append(f"{path}: {error.strerror or error}")


class ChunkReader:
    """Reads messages; keeps the last chunk, and the files open. Each thread or process needs its own."""

    def __init__(self) -> None:
        self._spans = Spans()
        self._descriptors: dict[str, int] = {}
        self._last: tuple[str, int] | None = None
        self._records = memoryview(b"")

    def load(self, places: Iterable[Place]) -> None:
        """Read the chunks of ``places`` at once, in few large reads, for ``read`` to give out.

        Memory that was given out before is overwritten. What cannot be read now, ``read`` will say.
        """
        self._last = None
        self._spans.load(_chunks(places))

    def cached(self, places: Iterable[Place]) -> bool:
        """Whether loading the chunks of ``places`` need not wait for the disk."""
        return self._spans.cached(_chunks(places))

    def read(self, place: Place) -> memoryview:
        """The message's data. Raises ``BadChunk`` if the chunk fails its CRC or is cut, ``OSError`` from the disk."""
        if self._last != (place.path, place.chunk_at):
            self._last = None
            self._records = _records_of_chunk(self._chunk(place))
            self._last = (place.path, place.chunk_at)
        return self._records[place.at : place.at + place.size]

    def close(self) -> None:
        """Close the files; memory handed out stays valid."""
        for descriptor in self._descriptors.values():
            os.close(descriptor)
        self._descriptors.clear()

    def _chunk(self, place: Place) -> memoryview:
        loaded = self._spans.get(place.path, place.chunk_at, place.chunk_size)
        if loaded is not None:
            return loaded
        descriptor = self._descriptors.get(place.path)
        if descriptor is None:
            while len(self._descriptors) >= 8:  # segments are read in order: the oldest is done with
                os.close(self._descriptors.pop(next(iter(self._descriptors))))
            descriptor = self._descriptors[place.path] = os.open(place.path, os.O_RDONLY)
        chunk = memoryview(bytearray(place.chunk_size))
        _read_fully(descriptor, chunk, place.chunk_at)
        return chunk


def _chunks(places: Iterable[Place]) -> set[Range]:
    return {(place.path, place.chunk_at, place.chunk_size) for place in places}


def _chunks_of_summary(descriptor: int, channels: dict[int, str]) -> list[tuple[int, int]] | None:
    """(offset, size) of the chunks by the summary, ``channels`` filled; None if the file has no usable summary."""
    try:
        summary = _summary(descriptor)
        if summary is None:
            return None
        found: dict[int, str] = {}
        chunks: list[tuple[int, int]] = []
        counts: tuple[int, int] | None = None  # of messages and chunks, by the statistics
        for opcode, record in summary.records():
            if opcode == CHANNEL:
                _add_channel(_HEAD.pack(opcode, len(record)) + record, found)
            elif opcode == CHUNK_INDEX:
                _, _, at, size = _CHUNK_INDEX.unpack_from(record)
                chunks.append((at, size))
            elif opcode == STATISTICS:
                counts = _STATISTICS.unpack_from(record)
    except (OSError, BadChunk, struct.error):
        return None
    if any(at + size > summary.at for at, size in chunks) or (counts is None and not chunks):
        return None
    if counts is not None and (counts[1] != len(chunks) or (counts[0] and not chunks)):
        return None
    channels.update(found)
    return sorted(chunks)


@dataclass(frozen=True)
class _Summary:
    at: int
    """where in the file"""
    data: memoryview

    def records(self) -> Iterator[tuple[int, bytes]]:
        """Opcode and content of each. Raises BadChunk where one is cut."""
        at = 0
        while at < len(self.data):
            if at + _HEAD.size > len(self.data):
                raise BadChunk("a record is cut")
            opcode, length = _HEAD.unpack_from(self.data, at)
            at += _HEAD.size
            if at + length > len(self.data):
                raise BadChunk("a record runs over its end")
            yield opcode, bytes(self.data[at : at + length])
            at += length


def _summary(descriptor: int) -> _Summary | None:
    """A file's summary, verified where it has a CRC; None if there is none.

    Raises BadChunk, struct.error and OSError where the file is cut meanwhile, or the disk fails.
    """
    end = os.fstat(descriptor).st_size - _FOOTER.size - len(MAGIC)
    if end < 0:
        return None
    footer = os.pread(descriptor, _FOOTER.size + len(MAGIC), end)
    opcode, length, at, _, crc = _FOOTER.unpack_from(footer)
    if not footer.endswith(MAGIC) or (opcode, length) != (FOOTER, _FOOTER.size - _HEAD.size):
        return None
    if not len(MAGIC) + _DATA_END_SIZE <= at < end:
        return None
    if _HEAD.unpack(os.pread(descriptor, _HEAD.size, at - _DATA_END_SIZE))[0] != DATA_END:
        return None
    data = memoryview(bytearray(end - at))
    _read_fully(descriptor, data, at)
    if crc and crc32(footer[: _FOOTER.size - 4], crc32(data)) != crc:
        return None
    return _Summary(at, data)


def _chunks_by_scanning(
    path: Path, descriptor: int, channels: dict[int, str], problems: list[str]
) -> list[tuple[int, int]]:
    """(offset, size) of the complete chunks of a file without summary; says in ``problems`` what is wrong with it.

    Channels declared between the chunks are added to ``channels``.
    """
    end = os.fstat(descriptor).st_size
    if os.pread(descriptor, len(MAGIC), 0) != MAGIC:
        problems.append(f"{path}: not an MCAP file")
        return []
    chunks = []
    at = len(MAGIC)
    while at + _HEAD.size <= end:
        opcode, length = _HEAD.unpack(os.pread(descriptor, _HEAD.size, at))
        if opcode in (0, DATA_END) or at + _HEAD.size + length > end:
            break
        if opcode == CHUNK:
            chunks.append((at, _HEAD.size + length))
        elif opcode == CHANNEL:
            _add_channel(os.pread(descriptor, min(_HEAD.size + length, _LONGEST_HEAD), at), channels)
        at += _HEAD.size + length
    problems.append(
        f"{path}: no summary (the recording was cut); read up to byte {at} of {end}, {len(chunks)} chunks"
        " (`wingcap recover` repairs it)"
    )
    return chunks


def _messages_of_chunk(
    path: str, descriptor: int, at: int, size: int, head: _ChunkHead, channels: dict[int, str]
) -> Iterator[MessageHead]:
    """Heads of a chunk's messages; channels that it declares are added to ``channels``."""
    if head.compression:
        chunk = bytearray(size)
        _read_fully(descriptor, memoryview(chunk), at)
        records = _records_of_chunk(memoryview(chunk))
        total = len(records)
    else:
        records = None
        total = head.records_size
    offset = 0
    while offset + _HEAD.size <= total:
        if records is None:
            start = os.pread(descriptor, min(64, total - offset), at + head.records_at + offset)
        else:
            start = bytes(records[offset : offset + 64])
        opcode, length = _HEAD.unpack_from(start)
        if offset + _HEAD.size + length > total:
            raise BadChunk("a record runs over its end")
        if opcode == MESSAGE:
            if length < _MESSAGE_HEAD.size:
                raise BadChunk("a message without its head")
            channel, sequence, _, publish_time_ns = _MESSAGE_HEAD.unpack_from(start, _HEAD.size)
            if channel in channels:
                data_at = offset + _HEAD.size + _MESSAGE_HEAD.size
                place = Place(path, at, size, data_at, length - _MESSAGE_HEAD.size)
                yield MessageHead(channels[channel], sequence, publish_time_ns, place)
        elif opcode == CHANNEL:
            wanted = min(_HEAD.size + length, _LONGEST_HEAD)
            if records is None:
                start = os.pread(descriptor, wanted, at + head.records_at + offset)
            else:
                start = bytes(records[offset : offset + wanted])
            _add_channel(start, channels)
        offset += _HEAD.size + length


def _add_channel(record: bytes, channels: dict[int, str]) -> None:
    if len(record) < _HEAD.size + 8:
        return  # not a channel that a message could be on
    identity, _, name_size = struct.unpack_from("<HHI", record, _HEAD.size)
    name_at = _HEAD.size + 8
    channels[identity] = record[name_at : name_at + name_size].decode(errors="replace")


def _chunk_head(start: bytes | memoryview, size: int) -> _ChunkHead:
    try:
        opcode, length = _HEAD.unpack_from(start)
        _, _, uncompressed_size, crc = _CHUNK_HEAD.unpack_from(start, _HEAD.size)
        name_at = _HEAD.size + _CHUNK_HEAD.size
        (name_size,) = struct.unpack_from("<I", start, name_at)
        compression = bytes(start[name_at + 4 : name_at + 4 + name_size]).decode(errors="replace")
        (records_size,) = struct.unpack_from("<Q", start, name_at + 4 + name_size)
    except struct.error as error:
        raise BadChunk("its head is cut") from error
    records_at = name_at + 4 + name_size + 8
    if opcode != CHUNK or _HEAD.size + length != size or records_at + records_size > size:
        raise BadChunk("its head does not match the file's index")
    return _ChunkHead(uncompressed_size, crc, compression, records_at, records_size)


def _records_of_chunk(chunk: memoryview) -> memoryview:
    """The uncompressed records of a chunk record's bytes, verified."""
    head = _chunk_head(chunk, len(chunk))
    records = chunk[head.records_at : head.records_at + head.records_size]
    if head.compression:
        records = memoryview(_decompress(head, bytes(records)))
    if head.crc and crc32(records) != head.crc:
        raise BadChunk("its CRC does not match")
    return records


def _decompress(head: _ChunkHead, data: bytes) -> bytes:
    if head.compression not in ("lz4", "zstd"):
        raise BadChunk(f"unknown compression {head.compression!r}")
    record: Any = Chunk(head.compression, data, 0, 0, 0, head.uncompressed_size)
    try:
        stream, size = get_chunk_data_stream(record)
        return bytes(stream.read(size))
    except Exception as error:  # the two compression libraries share no error class
        raise BadChunk(f"{head.compression}: {error}") from error


def _read_fully(descriptor: int, buffer: memoryview, at: int) -> None:
    done = 0
    while done < len(buffer):
        count = os.preadv(descriptor, [buffer[done:]], at + done)
        if count == 0:
            raise BadChunk("the file ends within it")
        done += count


class _Descriptor:
    """A file descriptor closed at the end of its ``with``."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._descriptor = -1

    def __enter__(self) -> int:
        self._descriptor = os.open(self._path, os.O_RDONLY)
        os.posix_fadvise(self._descriptor, 0, 0, os.POSIX_FADV_RANDOM)  # heads only: nothing is to be read ahead
        return self._descriptor

    def __exit__(self, *_: object) -> None:
        os.close(self._descriptor)
