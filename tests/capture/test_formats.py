"""Encoders against the stock decoders; the line protocol and the ledger against brute force."""

import contextlib
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory

from capture.ledger import Ledger
from capture.record import (
    SCHEMAS,
    Analog,
    CanFrame,
    Diagnostic,
    Frame,
    Loss,
    LossStage,
    Mavlink,
    Trigger,
    decode_image,
    encode_camera_info,
    encode_diagnostics,
    image_prefix,
)
from capture.trigger_protocol import GarbledLine, Pulse, decode_line, encode_line, parse_pulse

UINT64 = st.integers(0, 2**64 - 1)
INT64 = st.integers(-(2**63), 2**63 - 1)
UINT32 = st.integers(0, 2**32 - 1)
UINT8 = st.integers(0, 255)
FLOAT64 = st.floats(allow_nan=False)
TEXT = st.text(st.characters(codec="utf-8", exclude_characters="\x00"), max_size=30)


def decode(type_name: str, data: bytes):
    """By mcap-ros2-support, which knows nothing of our encoder."""
    schema = Schema(id=1, name=type_name, encoding="ros2msg", data=SCHEMAS[type_name].encode())
    decoder = DecoderFactory().decoder_for("cdr", schema)
    assert decoder is not None
    return decoder(data)


FRAMES = st.builds(
    Frame, UINT64, UINT64, UINT64, INT64, INT64, INT64, INT64, UINT32, UINT32, UINT32, UINT32,
    st.floats(allow_nan=False, width=32), UINT8, UINT8,
)  # fmt: skip
MESSAGES = {
    "Frame": FRAMES,
    "Trigger": st.builds(Trigger, UINT64, UINT64, INT64, INT64, INT64),
    "Loss": st.builds(Loss, UINT64, INT64, TEXT, TEXT, TEXT, TEXT),
    "Analog": st.builds(Analog, INT64, INT64, UINT32, UINT8, TEXT, FLOAT64, FLOAT64),
    "Mavlink": st.builds(
        Mavlink, INT64, UINT8, UINT8, TEXT, st.lists(TEXT, max_size=4).map(tuple),
        st.lists(FLOAT64, max_size=4).map(tuple),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", MESSAGES)
@given(data=st.data())
def test_own_types_decode_as_any_ros2_reader_would(name, data):
    message = data.draw(MESSAGES[name])
    theirs = decode(f"wingshape_msgs/msg/{name}", message.encode())
    for field in message.__dataclass_fields__:
        mine = getattr(message, field)
        assert getattr(theirs, field) == (list(mine) if isinstance(mine, tuple) else mine)
    assert type(message).decode(message.encode()) == message


@given(
    stamp_ns=st.integers(0, 2**31 * 10**9 - 1), bus=TEXT, number=st.integers(0, 2**29 - 1),
    flags=st.tuples(st.booleans(), st.booleans(), st.booleans()), content=st.binary(max_size=8),
)  # fmt: skip
def test_a_can_frame_decodes_as_ros_can_tools_would(stamp_ns, bus, number, flags, content):
    frame = CanFrame(stamp_ns, bus, number, *flags, content)
    theirs = decode("can_msgs/msg/Frame", frame.encode())
    assert theirs.header.stamp.sec * 10**9 + theirs.header.stamp.nanosec == stamp_ns
    assert (theirs.header.frame_id, theirs.id) == (bus, number)
    assert (theirs.is_rtr, theirs.is_extended, theirs.is_error) == flags
    assert bytes(theirs.data)[: theirs.dlc] == content
    assert CanFrame.decode(frame.encode()) == frame


@given(cut=st.integers(0, 80))
def test_a_cut_message_is_refused(cut):
    data = Loss(1, 2, "left", "cam0", "ring", "the disk is behind").encode()
    with pytest.raises((ValueError, struct.error)):
        Loss.decode(data[: min(cut, len(data) - 1)])


@given(stamp_ns=st.integers(0, 2**31 * 10**9 - 1), name=TEXT, width=st.integers(1, 40), height=st.integers(1, 40))
def test_image_prefix_and_pixels_are_an_image(stamp_ns, name, width, height):
    pixels = bytes(range(256)) * 7
    data = image_prefix(stamp_ns, name, height, width) + pixels[: width * height]
    theirs, ours = decode("sensor_msgs/msg/Image", data), decode_image(data)
    assert (theirs.height, theirs.width, theirs.step, theirs.encoding) == (height, width, width, "mono8")
    assert bytes(theirs.data) == data[ours.pixels_at :] == pixels[: width * height]
    assert theirs.header.stamp.sec * 10**9 + theirs.header.stamp.nanosec == ours.stamp_ns == stamp_ns
    assert theirs.header.frame_id == ours.frame_id == name
    with pytest.raises(ValueError, match="image of"):
        decode_image(data[:-1])


def test_camera_info_and_diagnostics_decode():
    info = decode("sensor_msgs/msg/CameraInfo", encode_camera_info(5, "left_cam0", 1552, 2080))
    assert (info.width, info.height, list(info.k), info.roi.do_rectify) == (2080, 1552, [0.0] * 9, False)
    array = decode(
        "diagnostic_msgs/msg/DiagnosticArray",
        encode_diagnostics(7, (Diagnostic(2, "disk left", "full", (("free_mb", "0"),)), Diagnostic(0, "a", "b"))),
    )
    assert [status.name for status in array.status] == ["disk left", "a"]
    assert array.status[0].values[0].value == "0"


@given(UINT64, UINT64, INT64, INT64)
def test_a_pulse_survives_its_line(index, counter, commanded_ns, actual_ns):
    pulse = Pulse(index, counter, commanded_ns, actual_ns)
    assert parse_pulse(decode_line(encode_line(*pulse.words()))) == pulse


@given(position=st.integers(0, 60), bit=st.integers(0, 7))
def test_any_flipped_bit_of_a_line_is_noticed(position, bit):
    words = Pulse(1234, 99, 1_700_000_000_000_000_000, 1_700_000_000_000_010_000).words()
    line = bytearray(encode_line(*words))
    position %= len(line) - 2  # the line end is not part of what is protected
    line[position] ^= 1 << bit
    with contextlib.suppress(GarbledLine):
        assert decode_line(bytes(line)) == words  # only the case of the checksum's digits may change


@pytest.mark.parametrize("line", [b"", b"$", b"PULSE 1", b"$PULSE*12", b"$\xff*0000\r\n", b"$" + b"x" * 200 + b"*0000"])
def test_nonsense_is_garbled(line):
    with pytest.raises(GarbledLine):
        decode_line(line)


EVENTS = st.lists(
    st.tuples(st.integers(1, 4), st.integers(0, 3), st.sampled_from(["record", "lose", "again"])), max_size=30
)


@given(events=EVENTS, extra=st.integers(0, 5), first=st.integers(0, 1000))
def test_the_ledger_always_balances(events, extra, first):
    """Any order of gaps, losses and duplicates: every index ends in exactly one book (checked by brute force)."""
    losses = []
    place = ("left", "cam0")
    ledger = Ledger([place], first, lambda: 0, losses.append)
    index, recorded = first - 1, set()
    for step, delivered_late, event in events:
        index += step
        assert ledger.arrived(place, index, min(delivered_late, step - 1))
        if event == "lose":
            ledger.lost(place, index, LossStage.RING, "full")
        else:
            ledger.recorded(place, index)
            recorded.add(index)
        if event == "again":
            assert not ledger.arrived(place, index)
    end = index + 1 + extra
    ledger.close(end)
    lost = [loss.trigger_index for loss in losses]
    assert sorted([*recorded, *lost]) == list(range(first, end))
    account = ledger.accounts()[place]
    assert account.balanced
    assert (account.recorded, account.lost_total, account.triggers) == (len(recorded), len(lost), end - first)
