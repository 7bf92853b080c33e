"""Every backend's camera in turn, opened by the tests themselves."""

import dataclasses
import time
from collections.abc import Iterator

import pytest
from camera_harness import SLOW, Harness, make_harness, wanted_harnesses

from capture.camera import make_camera
from capture.camera.base import Camera, CameraDescription, Grab, buffer_bytes
from capture.errors import CameraError
from capture.ring import PAGE, Ring

SLOTS = 8
EMPTY = 0xA5


class Bench:
    """A camera on the bench: its harness, and memory for it to fill, each buffer between pages that must not change."""

    def __init__(self, harness: Harness) -> None:
        self.harness = harness
        self.size = harness.settings.width * harness.settings.height
        self.buffer_bytes = buffer_bytes(harness.settings.width, harness.settings.height)
        self.ring = Ring(SLOTS, PAGE + -(-self.buffer_bytes // PAGE) * PAGE + PAGE, lock_memory=False)
        self.camera = self.make()
        for slot in range(SLOTS):
            self.wipe(slot)

    def make(self, **changes: object) -> Camera:
        settings = dataclasses.replace(self.harness.settings, **changes)
        return make_camera(self.harness.backend, self.harness.address, settings)

    def wipe(self, slot: int) -> None:
        self.ring.slot(slot)[:] = bytes([EMPTY]) * self.ring.slot_bytes

    def pixels(self, slot: int) -> memoryview:
        return self.ring.slot(slot)[PAGE : PAGE + self.size]

    def buffer(self, slot: int) -> memoryview:
        return self.ring.slot(slot)[PAGE : PAGE + self.buffer_bytes]

    def intact(self, slot: int) -> bool:
        """Whether nothing was touched outside the pixels and what the camera sends behind them."""
        whole, end = self.ring.slot(slot), PAGE + self.size + self.harness.chunk_bytes
        return set(whole[:PAGE]) == {EMPTY} == set(whole[end:])

    def open(self) -> CameraDescription:
        """Open, patiently: after an unplug a device needs its time."""
        deadline_s = time.monotonic() + self.harness.back_within_s
        while True:
            try:
                return self.camera.open()
            except CameraError:
                if time.monotonic() > deadline_s:
                    raise
                time.sleep(0.1)

    def start(self, slots: int = SLOTS) -> CameraDescription:
        """Open, queue, arm."""
        description = self.open()
        for slot in range(slots):
            self.camera.queue(slot, self.buffer(slot))
        self.camera.arm()
        return description

    def expose(self, description: CameraDescription) -> None:
        """Have one frame taken; one that runs free needs no help."""
        if description.hardware_trigger:
            self.harness.trigger()

    def frame(self, description: CameraDescription) -> Grab:
        """Trigger, and wait for the frame."""
        self.expose(description)
        grab = self.camera.grab(self.harness.frame_within_s)
        assert grab is not None, f"no frame within {self.harness.frame_within_s:g} s"
        return grab

    def ids_of(self, count: int) -> list[int]:
        """The ids of the next frames of a camera that runs free, each buffer given back at once."""
        ids = []
        while len(ids) < count:
            grab = self.camera.grab(self.harness.frame_within_s)
            assert grab is not None
            ids.append(grab.frame_id)
            self.camera.queue(grab.slot, self.buffer(grab.slot))
        return ids

    def grab_until_lost(self) -> None:
        """Grab until the camera is lost, or until it should have been."""
        deadline_s = time.monotonic() + self.harness.loss_within_s
        while time.monotonic() < deadline_s:
            self.camera.grab(0.1)


@pytest.fixture(
    params=[pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in wanted_harnesses()]
)
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    with make_harness(request.param) as harness:
        bench = Bench(harness)
        yield bench
        bench.camera.close()
