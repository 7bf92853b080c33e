"""A V4L2 device of a real kernel: its test driver vivid. For the guest of the VM suite."""

import contextlib
import subprocess
import time
from pathlib import Path

from camera_harness import Harness

from capture.camera.base import CameraSettings
from capture.camera.v4l2_device import V4l2Device

DEVICE = "/dev/video0"
MODULE = ("vivid", "n_devs=1", "node_types=0x1", "num_inputs=1", "input_types=0x0")
"""One capture node with a webcam as input."""
_DROPPING_S = 0.5
_BOUND_S = 20.0


class VividHarness(Harness):
    """Runs free. Buffers are dropped, and the device unplugged, by controls of vivid's own."""

    backend = "v4l2"
    faults = frozenset({"drop", "unplug"})
    missing_address = "/dev/video99"
    refused = (
        ({"width": 333}, r"333×180 GREY \(8 bit\) was asked, the driver gives \d+×\d+ GREY: set `camera.width`"),
        ({"gain_db": 3.0}, "V4L2 knows no dB: set `camera.gain_db` = 0"),
        ({"black_level": 3.0}, "remove `camera.black_level`"),
        ({"shutter_mode": "Rolling"}, "remove `camera.shutter_mode`"),
    )
    frame_within_s = 10.0
    loss_within_s = 20.0
    back_within_s = 30.0

    def __enter__(self) -> "VividHarness":
        subprocess.run(["modprobe", *MODULE], check=True)
        self._held: V4l2Device | None = None
        self.address = f"{DEVICE}?exposure=fixed&fps=10"
        self.settings = CameraSettings(320, 180, 2000, 0.0)
        self._wait_for_device()
        return self

    def __exit__(self, *exception: object) -> None:
        if self._held is not None:
            self._held.close()
        subprocess.run(["rmmod", "vivid"], check=False)

    def drop(self) -> None:
        self._set("percentage_of_dropped_buffers", 100)
        time.sleep(_DROPPING_S)
        self._set("percentage_of_dropped_buffers", 0)

    def unplug(self) -> None:
        """It would come back when its last user lets go, so we hold on to it."""
        self._held = V4l2Device(DEVICE)
        control = self._held.controls()["disconnect"]
        with contextlib.suppress(OSError):  # it is gone before it can say that it went
            self._held.set(control, 1)

    def plug(self) -> None:
        assert self._held is not None
        self._held.close()
        self._held = None
        self._wait_for_device()

    def _set(self, name: str, value: int) -> None:
        with contextlib.closing(V4l2Device(DEVICE)) as device:
            device.set(device.controls()[name], value)

    def _wait_for_device(self) -> None:
        deadline_s = time.monotonic() + _BOUND_S
        while not Path(DEVICE).exists():
            assert time.monotonic() < deadline_s, f"no {DEVICE}"
            time.sleep(0.05)
