"""The V4L2 backend against a device made up here: what vivid in the VM suite cannot be (a trigger, another clock …)."""

import errno
import math

import numpy as np
import pytest

from capture.camera.base import CameraSettings, FrameStatus
from capture.camera.v4l2 import V4l2Camera
from capture.camera.v4l2_device import Control, Done, Format, Identity
from capture.errors import CameraError, CameraLost

WIDTH, HEIGHT = 64, 48
CONTROLS = {
    "auto_exposure": (0, 3, ()),
    "exposure_time_absolute": (1, 5000, ()),
    "gain": (16, 255, ()),
    "trigger_mode": (0, 1, ()),
    "trigger_source": (0, 2, ((0, "Line 0"), (2, "Line 2"))),
    "trigger_activation": (0, 1, ((0, "Falling Edge"), (1, "Rising Edge"))),
}


class MadeUpDevice:
    """A driver in figures: what it makes of a wish, and what it delivers."""

    def __init__(self, controls=CONTROLS, stride: int = WIDTH, ours: bool = True) -> None:
        self.known = {n: Control(k, n, low, high, menu) for k, (n, (low, high, menu)) in enumerate(controls.items())}
        self.values = dict.fromkeys(range(len(self.known)), 99)
        self.fourcc, self.stride, self.ours = "GREY", stride, ours
        self.stuck: set[str] = set()
        self.done: list[Done] = []
        self.given: dict[int, object] = {}
        self.gone = False

    def identity(self) -> Identity:
        return Identity("made-up", "Made-up camera", "platform:made-up", "4711")

    def ask_format(self, width: int, height: int) -> Format:
        return Format(self.fourcc, width, height, self.stride, self.stride * height)

    def ask_rate(self, rate_hz: float) -> float:
        return min(rate_hz, 30.0)

    def choose_input(self, number: int) -> int:
        return number

    def controls(self) -> dict[str, Control]:
        return self.known

    def set(self, control: Control, value: int) -> int:
        if control.name not in self.stuck:
            self.values[control.number] = max(control.lowest, min(control.highest, value))
        return self.values[control.number]

    def value(self, name: str) -> int:
        return self.values[self.known[name].number]

    def make_buffers(self, count: int, ours: bool) -> list[np.ndarray]:
        if ours and not self.ours:
            raise OSError(errno.EINVAL, "no user pointers")
        self.maps = [] if ours else [np.zeros(self.stride * HEIGHT, np.uint8) for _ in range(count)]
        return list(self.maps)

    def free_buffers(self) -> None:
        self._alive()
        self.given.clear()

    def give(self, index: int, memory: object) -> None:
        self._alive()
        self.given[index] = memory

    def start(self) -> None: ...

    def stop(self) -> None:
        self._alive()

    def take(self, timeout_s: float) -> Done | None:
        self._alive()
        return self.done.pop(0) if self.done else None

    def close(self) -> None: ...

    def _alive(self) -> None:
        if self.gone:
            raise OSError(errno.ENODEV, "No such device")


class MadeUpCamera(V4l2Camera):
    def make_device(self, path: str) -> MadeUpDevice:
        return self.device


def camera(device: MadeUpDevice, address: str = "/dev/video7", **changes: object) -> MadeUpCamera:
    settings = {"width": WIDTH, "height": HEIGHT, "exposure_us": 2000, "gain_db": 0.0} | changes
    made = MadeUpCamera(address, CameraSettings(**settings))
    made.device = device
    return made


def test_a_driver_with_a_trigger_is_triggered_by_the_line_and_edge_asked_for():
    device = MadeUpDevice()
    description = camera(device, trigger_line="Line2").open()
    assert description.hardware_trigger
    assert description.serial == "4711"
    assert description.exposure_us == 2000
    assert [device.value(name) for name in CONTROLS] == [1, 20, 16, 1, 2, 1]
    assert dict(description.features)["buffers"] == "the recorder's"


def test_a_driver_without_one_says_that_it_runs_free():
    controls = {name: CONTROLS[name] for name in ("exposure_time_absolute", "gain")}
    assert not camera(MadeUpDevice(controls)).open().hardware_trigger


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"trigger_line": "Line1"},
            "trigger_source Line1 was asked, the driver has Line 0, Line 2: set `camera.trigger_",
        ),
        ({"exposure_us": 600_000}, "exposure 600000 us was asked, the driver has 500000: it takes 100 to 500000"),
        ({"exposure_us": 1240}, "exposure 1240 us was asked, the driver has 1200"),
        ({"gain_db": 6.0}, "V4L2 knows no dB"),
        ({"offset_x": 16}, "remove `camera.offset_x`"),
    ],
)
def test_what_the_driver_does_not_take_is_refused(changes, message):
    with pytest.raises(CameraError, match=message):
        camera(MadeUpDevice(), **changes).open()


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("/dev/video7?fps=60", "fps=60 was asked, the driver has 30"),
        ("/dev/video7?no_such=1", "no control no_such: its controls are auto_exposure, "),
        ("/dev/video7?gain=much", "gain=much is not a number"),
        ("/dev/video7?gain=300", "gain=300 was asked, the driver has 255"),
    ],
)
def test_a_wrong_address_is_refused(address, message):
    with pytest.raises(CameraError, match=message):
        camera(MadeUpDevice(), address).open()


def test_a_setting_that_does_not_stick_is_refused():
    device = MadeUpDevice()
    device.stuck = {"trigger_mode"}
    with pytest.raises(CameraError, match="trigger_mode 1 was asked, the driver has 99"):
        camera(device).open()


def test_no_grey_no_recording():
    device = MadeUpDevice()
    device.fourcc = "YUYV"
    with pytest.raises(CameraError, match="the driver gives 64×48 YUYV"):
        camera(device).open()


def test_without_an_exposure_control_it_must_be_said_that_it_is_fixed():
    with pytest.raises(CameraError, match="add `exposure=fixed`"):
        camera(MadeUpDevice({})).open()
    assert camera(MadeUpDevice({}), "/dev/video7?exposure=fixed").open().exposure_us == 2000


def test_a_gain_in_the_drivers_unit_is_not_called_decibels():
    device = MadeUpDevice()
    assert math.isnan(camera(device, "/dev/video7?gain=40").open().gain_db)
    assert device.value("gain") == 40


@pytest.mark.parametrize(("stride", "ours"), [(WIDTH, True), (WIDTH, False), (80, True)])
def test_pixels_arrive_wherever_the_driver_puts_them(stride, ours):
    """Ours, the driver's, and the driver's with padded rows, which ours cannot have."""
    device = MadeUpDevice(stride=stride, ours=ours)
    made = camera(device)
    description = made.open()
    into_ours = ours and stride == WIDTH
    assert ("one copy" in dict(description.features)["buffers"]) == (not into_ours)
    memory = bytearray(WIDTH * HEIGHT)
    made.queue(3, memoryview(memory))
    made.arm()
    image = (np.arange(HEIGHT)[:, None] * 5 + np.arange(WIDTH)).astype(np.uint8)
    if into_ours:
        device.given[0].raw = image.tobytes()
    else:
        assert device.given[0] is None
        device.maps[0].reshape(HEIGHT, stride)[:, :WIDTH] = image
    device.done.append(Done(0, stride * HEIGHT, 5, 7_000_000_000, True, False))
    grab = made.grab(0.0)
    assert (grab.slot, grab.frame_id, grab.device_ticks, grab.status) == (3, 5, 7_000_000_000, FrameStatus.COMPLETE)
    assert np.array_equal(np.frombuffer(memory, np.uint8).reshape(HEIGHT, WIDTH), image)
    made.close()


def test_a_time_at_the_end_of_the_frame_is_taken_back_by_the_exposure():
    device = MadeUpDevice()
    made = camera(device)
    made.open()
    for slot in range(3):
        made.queue(slot, memoryview(bytearray(WIDTH * HEIGHT)))
    made.arm()
    size = WIDTH * HEIGHT
    device.done = [Done(0, size, 0, 10**9, False, False), Done(1, size - 9, 1, 10**9, True, False)]
    device.done.append(Done(2, size, 2, None, True, True))
    whole, short, faulty = (made.grab(0.0) for _ in range(3))
    assert whole.device_ticks == 10**9 - 2_000_000
    assert (short.status, short.detail) == (FrameStatus.INCOMPLETE, "9 bytes missing")
    assert (faulty.status, faulty.detail) == (FrameStatus.INCOMPLETE, "the driver flags an error")
    assert made.grab(0.0) is None


def test_a_device_that_goes_is_lost_and_lets_go_of_our_memory():
    device = MadeUpDevice()
    made = camera(device)
    made.open()
    memory = bytearray(WIDTH * HEIGHT)
    made.queue(0, memoryview(memory))
    made.arm()
    device.gone = True
    with pytest.raises(CameraLost, match="check its cable and power"):
        made.grab(0.0)
    made.disarm()
    made.close()
    device.given.clear()
    memory.append(0)  # raises BufferError while anybody holds it


def test_no_more_buffers_are_queued_than_a_drivers_queue_has():
    """At 100 Hz a driver is given 40, and V4L2's queues have 32: the others follow as those come back."""
    device = MadeUpDevice()
    made = camera(device)
    made.open()
    for slot in range(40):
        made.queue(slot, memoryview(bytearray(WIDTH * HEIGHT)))
    made.arm()
    assert sorted(device.given) == list(range(32))
    device.given.clear()
    device.done.append(Done(0, WIDTH * HEIGHT, 5, 7_000_000_000, True, False))
    grab = made.grab(0.0)
    made.queue(grab.slot, memoryview(bytearray(WIDTH * HEIGHT)))
    assert list(device.given) == [0]
    assert made._stream.slots[0] == 32
    made.close()
