"""The simulated rig's camera, with the test's hand on its trigger line and its plug."""

import tempfile
import time
from pathlib import Path

from camera_harness import Harness

from capture.camera.base import CameraSettings
from capture.clock import SystemClock
from capture.trigger_protocol import Pulse
from hw_sim.hand import do
from hw_sim.rig import Rig
from hw_sim.world import World

CAMERA = "left_cam0"


class SimulatedHarness(Harness):
    backend = "simulated"
    refused = (
        ({"width": 2080}, "is 260×194, not 2080×194"),
        ({"exposure_us": 50_000}, r"50000 us .* 1 … 30000 us"),
        ({"gain_db": 60.0}, r"60 dB .* 24 dB"),
    )

    def __enter__(self) -> "SimulatedHarness":
        self._folder = tempfile.TemporaryDirectory()
        folder = Path(self._folder.name)
        self._socket, self._pulses = folder / "rig.sock", 0
        self.address = f"{self._socket}#{CAMERA}"
        self.settings = CameraSettings(260, 194, 2000, 0.0)
        self._rig = Rig(World.make(scale=8), self._socket, folder / "board", SystemClock())
        self._rig.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._rig.check()
        self._rig.close()
        self._folder.cleanup()

    def trigger(self) -> None:
        now_ns = time.time_ns()
        self._rig.edge(Pulse(self._pulses, self._pulses, now_ns, now_ns))
        self._pulses += 1

    def drop(self) -> None:
        do(self._socket, "drop", CAMERA)

    def truncate(self) -> None:
        do(self._socket, "truncate", CAMERA)

    def unplug(self) -> None:
        do(self._socket, "unplug", CAMERA)

    def plug(self) -> None:
        do(self._socket, "plug", CAMERA)
