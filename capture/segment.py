"""One MCAP file: frames that leave their ring slots by O_DIRECT, and batches of small messages.

Layout of a frame's slot, which is what goes to disk, byte for byte (p = start of pixels, page-aligned):

    0    private record 0x80 that fills up to the chunk
    p-n  Chunk header · Message header of the image · CDR prefix of the image
    p    pixels
         Message of the Frame · [end of chunk] · two MessageIndex records · private record 0x80 up to the page's end

What lies outside chunks (header, schemas, channels, provenance) is followed by a private record 0x81: offset of the
first byte it covers and their CRC. So every byte of a closed file is checked by ``wingcap verify``.

Readers skip private records (MCAP specification, opcodes 0x80–0xFF); offsets, lengths and addresses of every write are
multiples of the page size, as O_DIRECT wants.
"""

import contextlib
import mmap
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from isal.isal_zlib import crc32
from mcap import records
from mcap.data_stream import RecordBuilder

from capture.disk import Disk, DiskFile
from capture.errors import DiskError
from capture.record import FORMAT_VERSION, PROVENANCE, SCHEMAS, Frame, image_prefix
from capture.ring import PAGE

MAGIC = b"\x89MCAP0\r\n"
LIBRARY = "wingshape"
PADDING_OPCODE = 0x80
GUARD_OPCODE = 0x81
GUARD = struct.Struct("<QI")
_RECORD = struct.Struct("<BQ")
_CHUNK_FIELDS = struct.Struct("<QQQIIQ")  # start, end, size, crc, length of "" (no compression), size
_MESSAGE_FIELDS = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_INDEX_FIELDS = struct.Struct("<HIQQ")  # channel, 16 bytes of entries, log time, offset


@dataclass(frozen=True)
class Channel:
    """A topic of a file. Channel ids start at 1."""

    id: int
    topic: str
    type_name: str


@dataclass(frozen=True)
class SmallMessage:
    """An encoded message of an aux batch."""

    channel: int
    sequence: int
    log_ns: int
    publish_ns: int
    data: bytes


@dataclass(frozen=True)
class SealedFrame:
    """A slot that is ready for the disk, and what the file's index needs to know of it."""

    slot: memoryview
    pixels: memoryview
    log_ns: int
    publish_ns: int
    chunk_at: int
    chunk_length: int
    index_length: int
    records_length: int
    index_at: tuple[tuple[int, int], ...]  # channel, offset in the slot


class FrameLayout:
    """Where everything of one camera's frame lies in its ring slot; all but the pixels is written by ``seal``."""

    def __init__(self, image_channel: int, frame_channel: int, frame_id: str, width: int, height: int) -> None:
        self._channels = (image_channel, frame_channel)
        self._frame_id = frame_id
        self._size = (height, width)
        prefix = len(image_prefix(0, frame_id, height, width))
        frame_message = len(Frame(*([0] * 14)).encode())
        head = _RECORD.size + _CHUNK_FIELDS.size + _RECORD.size + _MESSAGE_FIELDS.size + prefix
        self.pixels_at = _round_up(head + _RECORD.size, PAGE)
        self.pixels_size = width * height
        self._chunk_at = self.pixels_at - head
        self._records_at = self._chunk_at + _RECORD.size + _CHUNK_FIELDS.size
        self._frame_at = self.pixels_at + self.pixels_size
        self._records_end = self._frame_at + _RECORD.size + _MESSAGE_FIELDS.size + frame_message
        index = _RECORD.size + _INDEX_FIELDS.size
        self._index_at = (self._records_end, self._records_end + index)
        self._tail_at = self._records_end + 2 * index
        self.slot_bytes = _round_up(self._tail_at + _RECORD.size, PAGE)
        self._image_length = _MESSAGE_FIELDS.size + prefix + self.pixels_size
        self._frame_length = _MESSAGE_FIELDS.size + frame_message

    def pixels(self, slot: memoryview) -> memoryview:
        """The part of a slot that holds the image."""
        return slot[self.pixels_at : self.pixels_at + self.pixels_size]

    def buffer(self, slot: memoryview) -> memoryview:
        """The part of a slot that the camera may fill: the pixels, and behind them what ``seal`` writes in any case."""
        return slot[self.pixels_at : self._tail_at + _RECORD.size]

    def seal(self, slot: memoryview, frame: Frame, stamp_ns: int) -> SealedFrame:
        """Write all records around the pixels of ``slot``, CRC included. The slot must not change afterwards.

        Args:
            slot: the camera's slot, pixels in place.
            frame: what is known of it; its trigger index is the sequence, its receive time the log time.
            stamp_ns: header.stamp of the image, UTC.
        """
        image_channel, frame_channel = self._channels
        log_ns, publish_ns, sequence = frame.receive_time_ns, frame.trigger_time_ns, frame.trigger_index & 0xFFFFFFFF
        records_length = self._records_end - self._records_at
        _pad(slot, 0, self._chunk_at)
        at = self._records_at
        at = _put_message(slot, at, self._image_length, image_channel, sequence, log_ns, publish_ns)
        slot[at : self.pixels_at] = image_prefix(stamp_ns, self._frame_id, *self._size)
        at = _put_message(slot, self._frame_at, self._frame_length, frame_channel, sequence, log_ns, publish_ns)
        slot[at : self._records_end] = frame.encode()
        crc = crc32(slot[self._records_at : self._records_end])
        _RECORD.pack_into(slot, self._chunk_at, records.Opcode.CHUNK, _CHUNK_FIELDS.size + records_length)
        _CHUNK_FIELDS.pack_into(
            slot, self._chunk_at + _RECORD.size, log_ns, log_ns, records_length, crc, 0, records_length
        )
        for at, channel, offset in zip(
            self._index_at, self._channels, (0, self._frame_at - self._records_at), strict=True
        ):
            _RECORD.pack_into(slot, at, records.Opcode.MESSAGE_INDEX, _INDEX_FIELDS.size)
            _INDEX_FIELDS.pack_into(slot, at + _RECORD.size, channel, 16, log_ns, offset)
        _pad(slot, self._tail_at, self.slot_bytes)
        return SealedFrame(
            slot=slot[: self.slot_bytes],
            pixels=self.pixels(slot),
            log_ns=log_ns,
            publish_ns=publish_ns,
            chunk_at=self._chunk_at,
            chunk_length=_RECORD.size + _CHUNK_FIELDS.size + records_length,
            index_length=self._tail_at - self._records_end,
            records_length=records_length,
            index_at=tuple(zip(self._channels, self._index_at, strict=True)),
        )


class SegmentWriter:
    """Writes one MCAP file. One thread; every failure of the disk is a DiskError that names the file."""

    def __init__(
        self,
        disk: Disk,
        path: Path,
        channels: Sequence[Channel],
        provenance: dict[str, str],
        write_mode: str = "auto",
        preallocate_bytes: int = 0,
    ) -> None:
        self.path = path
        self.bytes_written = 0
        self.message_counts = {channel.id: 0 for channel in channels}
        self.first_log_ns = 0
        self.last_log_ns = 0
        self._chunk_indexes: list[records.ChunkIndex] = []
        self._attachment_indexes: list[records.AttachmentIndex] = []
        self._metadata_indexes: list[records.MetadataIndex] = []
        self._channels = tuple(channels)
        names = sorted({channel.type_name for channel in channels})
        self._schema_ids = {name: number for number, name in enumerate(names, start=1)}
        try:
            self._file: DiskFile | None = disk.create(path, write_mode, preallocate_bytes)
        except OSError as error:
            raise self._disk_error(error) from error
        self.write_mode = "direct" if self._file.direct else "buffered"
        self._start({"format_version": str(FORMAT_VERSION), "write_mode": self.write_mode, **provenance})

    def topics(self) -> list[tuple[str, str, int]]:
        """Topic, type and number of messages of each channel."""
        return [(channel.topic, channel.type_name, self.message_counts[channel.id]) for channel in self._channels]

    def write_frame(self, sealed: SealedFrame) -> None:
        """Write a slot as it is."""
        base = self.bytes_written
        self._write(sealed.slot)
        self._index_chunk(
            sealed.log_ns,
            sealed.log_ns,
            base + sealed.chunk_at,
            sealed.chunk_length,
            {channel: base + at for channel, at in sealed.index_at},
            sealed.index_length,
            sealed.records_length,
        )
        for channel, _ in sealed.index_at:
            self.message_counts[channel] += 1

    def write_batch(self, messages: Sequence[SmallMessage]) -> None:
        """Write small messages as one chunk with its own index."""
        if not messages:
            return
        body = RecordBuilder()
        index: dict[int, list[tuple[int, int]]] = {}
        for message in messages:
            index.setdefault(message.channel, []).append((message.log_ns, body.count))
            records.Message(
                channel_id=message.channel,
                sequence=message.sequence & 0xFFFFFFFF,
                log_time=message.log_ns,
                publish_time=message.publish_ns,
                data=message.data,
            ).write(body)
        content = body.end()
        first, last = min(m.log_ns for m in messages), max(m.log_ns for m in messages)
        out = RecordBuilder()
        records.Chunk(
            message_start_time=first,
            message_end_time=last,
            uncompressed_size=len(content),
            uncompressed_crc=crc32(content),
            compression="",
            data=content,
        ).write(out)
        chunk_length, index_at = out.count, {}
        for channel, entries in index.items():
            index_at[channel] = self.bytes_written + out.count
            records.MessageIndex(channel_id=channel, records=entries).write(out)
        base = self.bytes_written
        index_length = out.count - chunk_length
        self._write_block(out.end())
        self._index_chunk(first, last, base, chunk_length, index_at, index_length, len(content))
        for channel, entries in index.items():
            self.message_counts[channel] += len(entries)

    def write_metadata(self, name: str, values: dict[str, str]) -> None:
        """Write a Metadata record, outside chunks."""
        out = RecordBuilder()
        records.Metadata(name=name, metadata=values).write(out)
        block = out.end()
        self._metadata_indexes.append(records.MetadataIndex(self.bytes_written, len(block), name))
        self._write_block(block + self._guard(block))

    def attach(self, name: str, data: bytes, log_ns: int) -> None:
        """Carry a small file along (a calibration)."""
        out = RecordBuilder()
        attachment = records.Attachment(
            create_time=log_ns, log_time=log_ns, name=name, media_type="application/json", data=data
        )
        attachment.write(out)
        block = out.end()
        self._attachment_indexes.append(
            records.AttachmentIndex(
                offset=self.bytes_written,
                length=len(block),
                log_time=log_ns,
                create_time=log_ns,
                data_size=len(attachment.data),
                name=name,
                media_type="application/json",
            )
        )
        self._write_block(block + self._guard(block))

    def sync(self) -> None:
        """Wait until what was written would survive a power cut."""
        try:
            self._open_file().sync()
        except OSError as error:
            raise self._disk_error(error) from error

    def close(self) -> None:
        """Write the summary, and wait until all of the file is on the disk. Safe to call twice."""
        if self._file is None:
            return
        try:
            self._file.end_direct()  # the summary is no multiple of a page
            end = RecordBuilder()
            records.DataEnd(data_section_crc=0).write(end)
            self._write(memoryview(end.end()))
            self._write(memoryview(self._summary(self.bytes_written)))
            self._file.sync()
        except OSError as error:
            raise self._disk_error(error) from error
        finally:
            self.abandon()

    def close_cut(self) -> None:
        """Close after a failed write: cut off what was written in part. What the disk refuses now is left as it is,
        readable up to its last complete chunk."""
        with contextlib.suppress(OSError):
            if self._file is not None:
                self._file.cut(self.bytes_written)
                self.close()
        self.abandon()

    def abandon(self) -> None:
        """Let go of the file as it is: readable up to its last complete chunk."""
        if self._file is not None:
            file, self._file = self._file, None
            with contextlib.suppress(OSError):  # the disk has failed, or everything was synced before
                file.close()

    def _open_file(self) -> DiskFile:
        if self._file is None:
            raise ValueError(f"{self.path} is closed")
        return self._file

    def _start(self, provenance: dict[str, str]) -> None:
        out = RecordBuilder()
        records.Header(profile="ros2", library=LIBRARY).write(out)
        start = len(MAGIC) + out.count
        records.Metadata(name=PROVENANCE, metadata=provenance).write(out)
        self._metadata_indexes.append(records.MetadataIndex(start, len(MAGIC) + out.count - start, PROVENANCE))
        self._put_schemas_and_channels(out)
        block = MAGIC + out.end()
        self._write_block(block + self._guard(block))

    def _guard(self, block: bytes) -> bytes:
        return _RECORD.pack(GUARD_OPCODE, GUARD.size) + GUARD.pack(self.bytes_written, crc32(block))

    def _put_schemas_and_channels(self, out: RecordBuilder) -> None:
        for name, number in self._schema_ids.items():
            records.Schema(id=number, name=name, encoding="ros2msg", data=SCHEMAS[name].encode()).write(out)
        for channel in self._channels:
            records.Channel(
                id=channel.id,
                schema_id=self._schema_ids[channel.type_name],
                topic=channel.topic,
                message_encoding="cdr",
                metadata={},
            ).write(out)

    def _write_block(self, block: bytes) -> None:
        """Write records that do not come from a slot, filled up to a page where the file is direct."""
        if not self._open_file().direct:
            self._write(memoryview(block))
            return
        length = _round_up(len(block) + _RECORD.size, PAGE)
        view = memoryview(mmap.mmap(-1, length))  # freed with its last user: a failed write may still hold a part of it
        view[: len(block)] = block
        _pad(view, len(block), length)
        self._write(view)

    def _write(self, view: memoryview) -> None:
        file = self._open_file()
        try:
            done = file.write(view)
            while done < len(view):  # a short write: what comes of the rest says why
                done += file.write(view[done:])
        except OSError as error:
            with contextlib.suppress(OSError):  # leave no torn record behind, where the disk still can
                file.cut(self.bytes_written)
            raise self._disk_error(error) from error
        self.bytes_written += len(view)

    def _index_chunk(
        self, first: int, last: int, at: int, length: int, index_at: dict[int, int], index_length: int, size: int
    ) -> None:
        self.first_log_ns = min(self.first_log_ns or first, first)
        self.last_log_ns = max(self.last_log_ns, last)
        self._chunk_indexes.append(
            records.ChunkIndex(
                message_start_time=first,
                message_end_time=last,
                chunk_start_offset=at,
                chunk_length=length,
                message_index_offsets=index_at,
                message_index_length=index_length,
                compression="",
                compressed_size=size,
                uncompressed_size=size,
            )
        )

    def _summary(self, summary_at: int) -> bytes:
        out = RecordBuilder()
        groups: list[tuple[int, int, int]] = []

        def group(opcode: int, items: Sequence[Any]) -> None:
            start = out.count
            for item in items:
                item.write(out)
            if out.count > start:
                groups.append((opcode, summary_at + start, out.count - start))

        self._put_schemas_and_channels(out)
        group(
            records.Opcode.STATISTICS,
            [
                records.Statistics(
                    message_count=sum(self.message_counts.values()),
                    schema_count=len(self._schema_ids),
                    channel_count=len(self._channels),
                    attachment_count=len(self._attachment_indexes),
                    metadata_count=len(self._metadata_indexes),
                    chunk_count=len(self._chunk_indexes),
                    message_start_time=self.first_log_ns,
                    message_end_time=self.last_log_ns,
                    channel_message_counts={k: n for k, n in self.message_counts.items() if n},
                )
            ],
        )
        group(records.Opcode.CHUNK_INDEX, self._chunk_indexes)
        group(records.Opcode.ATTACHMENT_INDEX, self._attachment_indexes)
        group(records.Opcode.METADATA_INDEX, self._metadata_indexes)
        offsets_at = summary_at + out.count
        for opcode, start, length in groups:
            records.SummaryOffset(group_opcode=opcode, group_start=start, group_length=length).write(out)
        body: bytes = out.end()
        footer = _RECORD.pack(records.Opcode.FOOTER, 20) + struct.pack("<QQ", summary_at, offsets_at)
        return body + footer + struct.pack("<I", crc32(body + footer)) + MAGIC

    def _disk_error(self, error: OSError) -> DiskError:
        return DiskError(
            f"{self.path}: the disk refused a write ({error.strerror or error}): free space on it or replace it"
        )


def _put_message(slot: memoryview, at: int, length: int, channel: int, sequence: int, log: int, publish: int) -> int:
    _RECORD.pack_into(slot, at, records.Opcode.MESSAGE, length)
    _MESSAGE_FIELDS.pack_into(slot, at + _RECORD.size, channel, sequence, log, publish)
    return at + _RECORD.size + _MESSAGE_FIELDS.size


def _pad(view: memoryview, at: int, end: int) -> None:
    """Fill [at, end) with one private record. There must be room for its 9 bytes."""
    _RECORD.pack_into(view, at, PADDING_OPCODE, end - at - _RECORD.size)


def _round_up(value: int, multiple: int) -> int:
    return -(-value // multiple) * multiple
