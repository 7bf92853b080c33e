"""The recording reader against the stock ``mcap`` writer and reader, whole, cut and corrupted."""

import errno
import os
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Header, Message, Schema
from mcap.writer import CompressionType

from capture.errors import ProcessError
from capture.record import LOSS_TOPIC, SCHEMAS, Frame, Loss, decode_image, image_prefix
from process.mcap_file import MAGIC, index_file
from process.recording import open_recording

START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 40_000_000


def picture(trigger: int, camera: int) -> np.ndarray:
    return np.random.default_rng([trigger, camera]).integers(0, 256, (24, 32), dtype=np.uint8)


def write_side(writer, side: str, triggers, *, skip=(), meta=True):
    frames = {}
    for trigger in triggers:
        for camera, name in enumerate(("cam0", "cam1")):
            if (trigger, camera) not in skip:
                at_ns = START_NS + trigger * PERIOD_NS + camera * 1000
                frames[trigger, camera] = writer.frame(side, name, trigger, picture(trigger, camera), at_ns, meta=meta)
    return frames


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD])
@pytest.mark.parametrize("chunk_size", [1, 10_000])  # a message a chunk, and many
def test_every_frame_comes_back_in_trigger_order(tmp_path, recording_writer, compression, chunk_size):
    writer = recording_writer(tmp_path / "disk" / "left_0000.mcap", compression=compression, chunk_size=chunk_size)
    order = [3, 1, 2, 0, 4]
    frames = write_side(writer, "left", order)
    writer.close()
    recording = open_recording([tmp_path])
    assert recording.problems == ()
    sets = list(recording.frame_sets("left"))
    assert [s.trigger_index for s in sets] == sorted(order)
    for frame_set in sets:
        for camera in range(2):
            expected = frames[frame_set.trigger_index, camera]
            assert frame_set.frames[camera] == expected
            assert frame_set.mid_exposures_ns[camera] == expected.exposure_start_ns + 1_000_000
            np.testing.assert_array_equal(frame_set.images[camera], picture(frame_set.trigger_index, camera))


def test_index_agrees_with_the_stock_reader(tmp_path, recording_writer):
    path = tmp_path / "left_0000.mcap"
    writer = recording_writer(path, chunk_size=5000)
    write_side(writer, "left", range(7))
    writer.close()
    with path.open("rb") as stream:
        stock = [(c.topic, m.sequence, m.publish_time, len(m.data)) for _, c, m in make_reader(stream).iter_messages()]
    ours = [(h.topic, h.sequence, h.publish_time_ns, h.place.size) for h in index_file(path).messages]
    assert sorted(ours) == sorted(stock)


def test_segments_and_disks_are_one_flight(tmp_path, recording_writer):
    for name, side, triggers in (
        ("ssd0/left_0000", "left", range(3)),
        ("ssd0/left_0001", "left", range(3, 5)),
        ("ssd1/right_0000", "right", range(5)),
    ):
        writer = recording_writer(tmp_path / f"{name}.mcap")
        write_side(writer, side, triggers)
        writer.close()
    for paths in ([tmp_path], [tmp_path / "ssd0", tmp_path / "ssd1"], [tmp_path, tmp_path / "ssd1"]):
        recording = open_recording(paths)
        assert {side: len(sets) for side, sets in recording.sides.items()} == {"left": 5, "right": 5}
        assert recording.problems == ()


def test_lost_frames_are_told_with_their_stage(tmp_path, recording_writer):
    writer = recording_writer(tmp_path / "left_0000.mcap")
    write_side(writer, "left", range(5), skip={(1, 0), (3, 0)})
    writer.close()
    for disk in ("a", "b"):  # the aux file is on both disks
        aux = recording_writer(tmp_path / disk / "aux_0000.mcap")
        aux.add(LOSS_TOPIC, "wingshape_msgs/msg/Loss", Loss(1, 0, "left", "cam0", "ring", "full").encode(), 0, 0)
        aux.close()
    recording = open_recording([tmp_path])
    assert recording.problems == ("left/cam0: 2 of 5 frames are missing (1 at ring; 1 without a reason)",)
    lost = list(recording.frame_sets("left"))[1]
    assert lost.images[0] is None
    assert lost.mid_exposures_ns[0] is None
    assert lost.images[1] is not None


@pytest.mark.parametrize("cut", [0.97, 0.6, 0.31])
def test_a_cut_file_is_read_to_its_last_whole_chunk(tmp_path, recording_writer, cut):
    path = tmp_path / "left_0000.mcap"
    writer = recording_writer(path)
    write_side(writer, "left", range(20))
    writer.close()
    data = path.read_bytes()
    path.write_bytes(data[: int(cut * len(data))])
    recording = open_recording([path])
    count = len(recording.sides["left"])
    # the summary is a small part of these few-kilobyte frames: the share of frames is about the share of bytes
    assert abs(count - 20 * cut) <= 5
    assert any(str(path) in p and "no summary" in p for p in recording.problems)
    for frame_set in recording.frame_sets("left"):
        for camera in range(2):
            if frame_set.images[camera] is not None:
                np.testing.assert_array_equal(frame_set.images[camera], picture(frame_set.trigger_index, camera))


def test_every_cut_gives_a_result_or_a_reason(tmp_path, recording_writer):
    path = tmp_path / "left_0000.mcap"
    writer = recording_writer(path)
    write_side(writer, "left", range(2))
    writer.close()
    data = path.read_bytes()
    for size in range(0, len(data), 37):
        path.write_bytes(data[:size])
        index = index_file(path)
        assert index.problems
        try:
            open_recording([path])
        except ProcessError as error:
            assert str(path) in str(error)  # noqa: PT017


@pytest.mark.parametrize("with_crc", [True, False])
@given(data=st.data())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=150)
def test_a_damaged_summary_is_not_believed(tmp_path, recording_writer, with_crc, data):
    """Its CRC tells, or, where the writer gave none, what follows from it is checked: no error, no other frame."""
    path = tmp_path / f"left_{with_crc}.mcap"
    if not path.exists():
        writer = recording_writer(path)
        write_side(writer, "left", range(6))
        writer.close()
    whole = path.read_bytes()
    summary_at = int.from_bytes(whole[-28:-20], "little")
    damaged = bytearray(whole)
    if not with_crc:
        damaged[-12:-8] = bytes(4)
    for _ in range(data.draw(st.integers(1, 3))):
        damaged[data.draw(st.integers(summary_at, len(whole) - 1))] = data.draw(st.integers(0, 255))
    other = tmp_path / "left_0000.mcap"
    other.write_bytes(damaged)
    path.write_bytes(whole)
    index, truth = index_file(other), index_file(path)
    assert truth.problems == []
    places = {(head.sequence, head.place.chunk_at, head.place.at) for head in truth.messages}
    found = {(head.sequence, head.place.chunk_at, head.place.at) for head in index.messages}
    assert found <= places
    if with_crc or not index.problems:
        assert found == places


def test_a_disk_that_fails_at_the_summary_costs_no_frame(tmp_path, recording_writer, monkeypatch):
    path = tmp_path / "left_0000.mcap"
    writer = recording_writer(path)
    write_side(writer, "left", range(5))
    writer.close()
    summary_at = int.from_bytes(path.read_bytes()[-28:-20], "little")
    count = len(index_file(path).messages)
    whole, whole_v = os.pread, os.preadv

    def failing(descriptor, size, at):
        if at >= summary_at:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return whole(descriptor, size, at)

    def failing_v(descriptor, buffers, at):
        if at >= summary_at:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return whole_v(descriptor, buffers, at)

    monkeypatch.setattr(os, "pread", failing)
    monkeypatch.setattr(os, "preadv", failing_v)
    index = index_file(path)
    assert len(index.messages) == count
    assert "no summary" in index.problems[0]


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.ZSTD])
def test_chunks_are_where_the_stock_reader_finds_them(tmp_path, recording_writer, compression):
    path = tmp_path / "left_0000.mcap"
    writer = recording_writer(path, compression=compression, chunk_size=3000)
    write_side(writer, "left", range(50))
    writer.close()
    with path.open("rb") as file:
        chunks = make_reader(file).get_summary().chunk_indexes
    index = index_file(path)
    assert index.problems == []
    found = {(head.place.chunk_at, head.place.chunk_size) for head in index.messages}
    assert found == {(chunk.chunk_start_offset, chunk.chunk_length) for chunk in chunks}


def test_zeros_after_the_last_chunk_end_the_file(tmp_path, recording_writer):
    """A preallocated file after a power cut."""
    path = tmp_path / "left_0000.mcap"
    writer = recording_writer(path)
    write_side(writer, "left", range(3))
    writer.abandon()
    path.write_bytes(path.read_bytes() + bytes(100_000))
    assert len(open_recording([path]).sides["left"]) == 3


def test_a_flipped_bit_costs_its_frame_only(tmp_path, recording_writer):
    path = tmp_path / "left_0000.mcap"
    writer = recording_writer(path)
    write_side(writer, "left", range(4))
    writer.close()
    data = bytearray(path.read_bytes())
    at = bytes(data).find(picture(2, 1).tobytes())
    data[at + 100] ^= 4
    path.write_bytes(data)
    sets = list(open_recording([path]).frame_sets("left"))
    assert [s.images[1] is None for s in sets] == [False, False, True, False]
    assert sets[2].images[0] is not None
    assert "CRC" in sets[2].problems[0]
    assert "trigger 2" in sets[2].problems[0]


def test_padding_records_between_chunks_are_skipped(tmp_path, recording_writer):
    """Private records (opcode 0x80 and up) align the chunks on disk; here in a file without summary."""
    path = tmp_path / "left_0000.mcap"
    writer = recording_writer(path)
    write_side(writer, "left", range(2))
    writer.abandon()
    data = path.read_bytes()
    padding = b"\x80" + (500).to_bytes(8, "little") + bytes(500)
    header_end = 8 + 9 + int.from_bytes(data[9:17], "little")
    path.write_bytes(data[:header_end] + padding + data[header_end:] + padding)
    assert len(open_recording([path]).sides["left"]) == 2


@pytest.mark.parametrize("share", [0.97, 0.5])
def test_the_recorders_own_file_cut_short(tmp_path, recording_writer, share):
    """Its channels are declared before the chunks, not in them; each chunk holds an image and what is known of it."""
    path = tmp_path / "right_0000.mcap"
    out = RecordBuilder()
    out.write(MAGIC)
    Header("ros2", "test").write(out)
    for identity, schema in ((1, "sensor_msgs/msg/Image"), (2, "wingshape_msgs/msg/Frame")):
        Schema(identity, SCHEMAS[schema].encode(), "ros2msg", schema).write(out)
    Channel(1, "/right/cam1/image_raw", "cdr", {}, 1).write(out)
    Channel(2, "/right/cam1/frame", "cdr", {}, 2).write(out)
    for trigger in range(10):
        image = image_prefix(START_NS, "cam1", 24, 32) + picture(trigger, 1).tobytes()
        frame = Frame(trigger, 0, 0, 0, START_NS, 0, 0, 2000, 10_000, 0, 0, 0.0, 0, 0).encode()
        records = RecordBuilder()
        for channel, data in ((1, image), (2, frame)):
            Message(channel, 0, data, START_NS, trigger).write(records)
        inside = records.end()
        Chunk("", inside, 0, 0, zlib.crc32(inside), len(inside)).write(out)
    data = out.end()
    path.write_bytes(data[: int(share * len(data))])
    sets = list(open_recording([path]).frame_sets("right"))
    assert abs(len(sets) - 10 * share) <= 1
    for frame_set in sets:
        np.testing.assert_array_equal(frame_set.images[1], picture(frame_set.trigger_index, 1))
        assert frame_set.frames[1].trigger_index == frame_set.trigger_index


def test_images_of_another_recorder_are_grouped_by_stamp(tmp_path, recording_writer):
    writer = recording_writer(tmp_path / "bag_0.mcap", compression=CompressionType.ZSTD, chunk_size=4000)
    write_side(writer, "left", range(6), meta=False, skip={(2, 1)})
    write_side(writer, "right", range(6), meta=False, skip={(0, 0), (0, 1)})
    writer.close()
    recording = open_recording([tmp_path])
    assert "only image topics" in recording.problems[0]
    left, right = (list(recording.frame_sets(side)) for side in ("left", "right"))
    assert [s.trigger_index for s in left] == list(range(6))
    assert [s.trigger_index for s in right] == list(range(1, 6))
    assert left[2].images[1] is None
    assert left[4].frames == (None, None)
    assert left[4].mid_exposures_ns[0] == START_NS + 4 * PERIOD_NS + 1_000_000
    np.testing.assert_array_equal(right[3].images[1], picture(4, 1))


def test_the_images_are_views_not_copies(tmp_path, recording_writer):
    writer = recording_writer(tmp_path / "left_0000.mcap")
    write_side(writer, "left", range(1))
    writer.close()
    (frame_set,) = open_recording([tmp_path]).frame_sets("left")
    assert frame_set.images[0] is not None
    assert not frame_set.images[0].flags.owndata


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda folder: None, "no recording"),
        (lambda folder: (folder / "left_0000.mcap").write_bytes(b"not one"), "not an MCAP file"),
        (lambda folder: (folder / "left_0000.mcap").write_bytes(b""), "not an MCAP file"),
    ],
)
def test_nothing_to_read_is_one_line_with_the_folder(tmp_path: Path, make, says):
    make(tmp_path)
    with pytest.raises(ProcessError, match=says) as caught:
        open_recording([tmp_path])
    assert str(tmp_path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(ProcessError, match="nowhere"):
        open_recording([tmp_path / "nowhere"])


def test_decoded_header_matches(tmp_path, recording_writer):
    """The header stamp is what stands in for the frame message."""
    path = tmp_path / "left_0000.mcap"
    writer = recording_writer(path)
    frame = writer.frame("left", "cam0", 9, picture(9, 0), START_NS)
    writer.close()
    with path.open("rb") as stream:
        data = next(m.data for _, c, m in make_reader(stream).iter_messages() if c.topic.endswith("image_raw"))
    assert decode_image(data).stamp_ns == frame.mid_exposure_ns
