"""Aravis' cameras without hardware: the one inside the library, and a GigE Vision one on the loopback interface."""

import contextlib
import tempfile
import time
from pathlib import Path

from camera_harness import Harness
from needs import needs_library
from network_namespace import network_namespace

from capture.camera.aravis_library import LIBRARY
from capture.camera.base import CameraSettings
from capture.clock import SystemClock
from capture.trigger_protocol import Pulse
from hw_sim.gige import GigeRig
from hw_sim.hand import do


class AravisFakeHarness(Harness):
    """Runs free at 25 Hz, in this process: no trigger line, no plug, and it loses nothing but what has no buffer."""

    backend = "aravis"
    faults = frozenset()
    exclusive = False
    refused = (
        ({"gain_db": 99.0}, r"gain 99 dB was asked, .* 0 to 10; set `camera.gain_db`"),
        ({"exposure_us": 2}, r"exposure time 2 us was asked, .* 10 to 1e\+07; set `camera.exposure_us`"),
        ({"black_level": 3.0}, "no black level: remove `camera.black_level`"),
        ({"shutter_mode": "Global"}, "no shutter mode: remove `camera.shutter_mode`"),
    )

    def __enter__(self) -> "AravisFakeHarness":
        needs_library(LIBRARY)
        self.address = "fake:CONTRACT"
        self.settings = CameraSettings(640, 480, 2000, 0.0)
        return self

    def __exit__(self, *exception: object) -> None: ...


class GigeHarness(Harness):
    """Discovery, control channel, heartbeat and packets are real. An unplugged one is noticed by its heartbeat."""

    backend = "aravis"
    missing_address = "127.0.0.77"
    loss_within_s = 10.0
    refused = (
        ({"gain_db": 60.0}, r"gain 60 dB was asked, .* 0 to 24; set `camera.gain_db`"),
        ({"exposure_us": 50_000}, r"exposure time 50000 us was asked, .* 19 to 32000; set `camera.exposure_us`"),
        ({"offset_x": 6}, r"OffsetX 6 was asked, the camera has 4.*; set `camera.offset_x`"),
        ({"black_level": 20.0}, r"black level 20 was asked, .* 0 to 12.5; set `camera.black_level`"),
        ({"shutter_mode": "Global"}, r"Global was asked, the camera has Rolling .* set `camera.shutter_mode`"),
        ({"trigger_line": "Line9"}, r"Line9 was asked, the camera has .* set `camera.trigger_line`"),
    )

    def __enter__(self) -> "GigeHarness":
        needs_library(LIBRARY)
        with contextlib.ExitStack() as stack:
            stack.enter_context(network_namespace())
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            self._socket, self._pulses = folder / "rig.sock", 0
            self.address = "127.0.0.1"
            self.settings = CameraSettings(
                640, 480, 2000, 6.0, black_level=1.5, shutter_mode="Rolling", trigger_activation="FallingEdge"
            )
            self._rig = GigeRig(1, (640, 480), self._socket, folder / "board", SystemClock())
            stack.callback(self._rig.close)
            self._rig.start()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *exception: object) -> None:
        with self._stack:
            self._rig.check()

    def trigger(self) -> None:
        now_ns = time.time_ns()
        self._rig.edge(Pulse(self._pulses, self._pulses, now_ns, now_ns))
        self._pulses += 1

    def drop(self) -> None:
        do(self._socket, "drop", "left_cam0")

    def truncate(self) -> None:
        do(self._socket, "truncate", "left_cam0")

    def unplug(self) -> None:
        do(self._socket, "unplug", "left_cam0")

    def plug(self) -> None:
        do(self._socket, "plug", "left_cam0")
