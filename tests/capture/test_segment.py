"""One file: the stock reader finds by index and by streaming what was written, direct and buffered."""

import errno
import os

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import NonSeekingReader, SeekingReader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader

from capture.camera.base import buffer_bytes
from capture.disk import SystemDisk
from capture.errors import DiskError
from capture.record import Frame, image_prefix
from capture.recorder import camera_channels
from capture.ring import PAGE, Ring
from capture.segment import FrameLayout, SegmentWriter, SmallMessage


def frame_of(index: int) -> Frame:
    return Frame(index, 1, 2, 1000 + index, 4, 2000 + index, -1, 5, 6, 7, 8, 0.0, 0, 0)


def write(path, layout, ring, count, mode):
    writer = SegmentWriter(SystemDisk(), path, camera_channels(["cam0"], "left"), {"flight": "x"}, mode)
    for index in range(count):
        slot = ring.slot(ring.take())
        layout.pixels(slot)[:] = bytes([index]) * layout.pixels_size
        writer.write_frame(layout.seal(slot, frame_of(index), 10**18 + index))
    writer.close()
    return writer


@pytest.mark.parametrize("mode", ["direct", "buffered"])
@pytest.mark.parametrize(("width", "height"), [(64, 48), (2080, 1552), (61, 37)])
def test_stock_readers_find_every_frame(tmp_path, mode, width, height):
    layout = FrameLayout(1, 2, "left_cam0", width, height)
    ring = Ring(4, layout.slot_bytes, lock_memory=False)
    path = tmp_path / "left_0000.mcap"
    assert write(path, layout, ring, 4, mode).path == path
    for reader_type in (SeekingReader, NonSeekingReader):
        with path.open("rb") as file:
            reader = reader_type(file, validate_crcs=True)
            images = list(reader.iter_messages(topics=["/left/cam0/image_raw"]))
            assert [m.sequence for _, _, m in images] == [0, 1, 2, 3]
            for _, _, message in images:
                prefix = image_prefix(10**18 + message.sequence, "left_cam0", height, width)
                assert message.data == prefix + bytes([message.sequence]) * (width * height)
    with path.open("rb") as file:
        summary = SeekingReader(file, validate_crcs=True).get_summary()
    assert summary.statistics.message_count == 8
    assert all(index.chunk_start_offset for index in summary.chunk_indexes)
    with path.open("rb") as file:
        chunks = [r for r in StreamReader(file, validate_crcs=True, emit_chunks=True).records if isinstance(r, Chunk)]
    assert len(chunks) == 4


@given(width=st.integers(1, 300), height=st.integers(1, 300), name=st.text("abc", min_size=1, max_size=40))
def test_layout_is_aligned_for_any_size(width, height, name):
    layout = FrameLayout(1, 2, name, width, height)
    assert layout.pixels_at % PAGE == layout.slot_bytes % PAGE == 0
    slot = memoryview(bytearray(layout.slot_bytes))
    buffer = layout.buffer(slot)
    assert len(buffer) >= buffer_bytes(width, height)
    buffer[:] = b"\xff" * len(buffer)  # as a camera with chunk data does
    sealed = layout.seal(slot, frame_of(3), 5)
    assert len(sealed.slot) == layout.slot_bytes
    # The records tile the slot exactly, whatever the size.
    at, opcodes = 0, []
    while at < layout.slot_bytes:
        opcodes.append(slot[at])
        last = int.from_bytes(slot[at + 1 : at + 9], "little")
        at += 9 + last
    assert at == layout.slot_bytes
    assert opcodes == [0x80, 6, 7, 7, 0x80]
    assert set(slot[layout.pixels_at : layout.pixels_at + layout.pixels_size]) == {0xFF}
    assert not any(slot[len(slot) - last :]), "verify wants padding to be empty"


def test_a_short_write_and_a_full_disk_name_the_file(tmp_path, monkeypatch):
    layout = FrameLayout(1, 2, "left_cam0", 64, 48)
    ring = Ring(2, layout.slot_bytes, lock_memory=False)
    writer = SegmentWriter(SystemDisk(), tmp_path / "left_0000.mcap", camera_channels(["cam0"], "left"), {}, "buffered")
    slot = ring.slot(ring.take())
    real_write, calls = os.write, []

    def short_then_full(file, data):
        calls.append(len(data))
        if len(calls) == 1:
            return real_write(file, data[:100])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("capture.disk.os.write", short_then_full)
    with pytest.raises(DiskError, match=r"left_0000\.mcap.*No space left"):
        writer.write_frame(layout.seal(slot, frame_of(0), 5))
    assert calls == [layout.slot_bytes, layout.slot_bytes - 100]


def test_the_ring_hands_out_each_slot_once():
    ring = Ring(3, PAGE, lock_memory=True)
    slots = [ring.take() for _ in range(4)]
    assert slots == [0, 1, 2, None]
    ring.slot(1)[:] = b"\x07" * PAGE
    assert bytes(ring.slot(0)) == bytes(PAGE)
    ring.give_back(1)
    assert (ring.free, ring.in_use, ring.high_water, ring.take()) == (1, 2, 3, 1)
    address = np.frombuffer(ring.slot(2), np.uint8).__array_interface__["data"][0]
    assert address % PAGE == 0
    with pytest.raises(ValueError, match="whole pages"):
        Ring(3, 100, lock_memory=False)


def test_messages_of_a_refused_batch_are_not_counted(tmp_path, monkeypatch):
    writer = SegmentWriter(SystemDisk(), tmp_path / "left_0000.mcap", camera_channels(["cam0"], "left"), {}, "buffered")
    batch = [SmallMessage(2, number, 5, 5, b"x") for number in range(3)]
    with monkeypatch.context() as patch:
        patch.setattr("capture.disk.PlainFile.write", lambda file, data: os.fsync(1 << 20))
        with pytest.raises(DiskError):
            writer.write_batch(batch)
    writer.write_batch(batch)
    writer.close()
    with (tmp_path / "left_0000.mcap").open("rb") as file:
        assert SeekingReader(file).get_summary().statistics.message_count == 3
