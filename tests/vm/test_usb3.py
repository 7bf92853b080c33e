"""USB3 Vision through kernel, udev, libusb and Aravis into a recording, while things happen to the cameras.

Beside it a CAN bus of the kernel's own (vcan), on which numbered frames go by.
"""

import numpy as np
import pytest
from mcap.reader import make_reader

from capture.record import CAN_TOPIC, CanFrame, Frame, decode_image
from capture.verify import inspect
from hw_sim.u3v_camera import own_exposure_us, own_gain_db

pytestmark = pytest.mark.slow
TRIGGERS = 100
PLACES = ("left/cam0", "left/cam1", "right/cam0", "right/cam1")
PULLED, CUT_SHORT, HELD, LOSING = PLACES


@pytest.fixture(scope="module")
def report(usb_folders):
    return inspect(usb_folders)


def test_the_recording_is_certified(report, usb_flight):
    assert report.problems == []
    assert report.triggers == TRIGGERS
    assert report.recorded + report.lost == 4 * TRIGGERS
    assert (report.recorded, report.lost) == (usb_flight[1]["frames_recorded"], usb_flight[1]["frames_lost"])


def test_what_was_done_to_the_cameras_is_in_the_books(report):
    lost = {place: {i: x.stage for i, x in report.cameras[place].lost_indices.items()} for place in PLACES}
    assert lost[CUT_SHORT] == {8: "usb", 9: "usb"}
    assert lost[HELD] == {34: "usb", 35: "usb"}  # four waited in the camera's buffer, from 30 on
    assert lost[LOSING] == {12: "usb"}


def test_a_pulled_camera_costs_the_others_nothing_and_comes_back(report, usb_flight):
    pulled = report.cameras[PULLED]
    gone = sorted(pulled.lost_indices)
    assert gone == list(range(16, gone[-1] + 1)), "one gap, from the moment it was pulled"
    assert 23 <= gone[-1] < TRIGGERS - 10, "it was put back at 24, and has to start"
    assert {loss.stage for loss in pulled.lost_indices.values()} == {"camera"}
    absences = usb_flight[1]["absences"]
    assert list(absences) == [PULLED]
    assert [absence["end_ns"] > absence["begin_ns"] for absence in absences[PULLED]] == [True]


def test_every_frame_shows_the_trigger_it_is_filed_under(usb_folders):
    """The cameras' pattern holds camera and trigger: also after the one that was pulled has come back."""
    k = np.arange(208 * 156)
    seen = 0
    for path in sorted(path for folder in usb_folders for path in folder.glob("*_*.mcap") if "aux" not in path.name):
        with path.open("rb") as file:
            for _, channel, message in make_reader(file).iter_messages():
                if not channel.topic.endswith("/image_raw"):
                    continue
                number = PLACES.index(channel.topic[1:].removesuffix("/image_raw"))
                expected = (k + 17 * message.sequence + 60 * number) % 251
                pixels = np.frombuffer(message.data, np.uint8)[decode_image(message.data).pixels_at :]
                assert np.array_equal(pixels[: expected.size], expected), (path.name, channel.topic, message.sequence)
                seen += 1
    assert seen > 3 * TRIGGERS


def test_what_the_cameras_say_of_each_frame_is_recorded(usb_folders):
    """In their chunk data: frames since power-up, so the trigger index and one, and from 1 again after the plug was
    pulled; and the frame's own exposure and gain, which these cameras tell from what was set."""
    ids: dict[str, dict[int, int]] = {}
    for path in sorted(path for folder in usb_folders for path in folder.glob("*_*.mcap") if "aux" not in path.name):
        with path.open("rb") as file:
            for _, channel, message in make_reader(file).iter_messages():
                if channel.topic.endswith("/frame"):
                    frame = Frame.decode(message.data)
                    place = channel.topic[1:].removesuffix("/frame")
                    index = frame.trigger_index
                    ids.setdefault(place, {})[index] = frame.device_frame_id
                    assert frame.exposure_us == round(own_exposure_us(2000, index))
                    assert frame.gain_db == pytest.approx(own_gain_db(0.0, index))
    for place in (CUT_SHORT, HELD, LOSING):
        assert all(index + 1 == frame_id for index, frame_id in ids[place].items())
    back = min(index for index in ids[PULLED] if index >= 16)
    assert all(frame_id == 1 + (index if index < 16 else index - back) for index, frame_id in ids[PULLED].items())


def test_the_hardware_counts_the_same(usb_flight, report):
    """What the emulator says it exposed and sent, against what the recorder says it got and lost."""
    counts = {}
    for line in (usb_flight[0].artifacts / "rig").read_text().splitlines():
        serial, _, rest = line.partition(": ")
        if rest:
            counts[PLACES[int(serial[-1])]] = {word.split()[1]: int(word.split()[0]) for word in rest.split(", ")}
    assert counts[LOSING] == {"exposed": TRIGGERS, "sent": TRIGGERS - 1, "lost": 1, "overflowed": 0}
    assert counts[HELD] == {"exposed": TRIGGERS, "sent": TRIGGERS - 2, "lost": 0, "overflowed": 2}
    assert counts[PULLED]["sent"] == report.cameras[PULLED].recorded


def test_every_can_frame_of_the_flight_is_there_in_order(usb_folders):
    for folder in usb_folders:
        frames = []
        with (folder / "aux_0000.mcap").open("rb") as file:
            for _, _, message in make_reader(file, validate_crcs=True).iter_messages(topics=[CAN_TOPIC]):
                frames.append(CanFrame.decode(message.data))
        numbers = [int.from_bytes(frame.data, "little") for frame in frames]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        assert len(numbers) > 100
        assert {(frame.bus, frame.id) for frame in frames} == {("bus", 0x123)}
        times = [frame.stamp_ns for frame in frames]
        assert times == sorted(times)
