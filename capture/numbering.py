"""A camera's frame counter and clock to trigger indices."""

from dataclasses import dataclass
from typing import Protocol

from capture.camera.base import CameraDescription, Grab

REPORT_WAIT_S = 0.03
"""How long a frame waits for the board's report of its trigger; the report normally came long before."""
FIRST_REPORT_WAIT_S = 0.2
"""The same for a camera's first frame, which nothing but the report can number. The driver's buffers bridge it."""


class Triggers(Protocol):
    """Which trigger was given when; capture.trigger.TriggerLog in a flight."""

    def nearest(self, time_ns: int, wait_s: float) -> tuple[int, int] | None:
        """Index and time of the trigger nearest to ``time_ns``."""

    def latest_before(self, time_ns: int, wait_s: float) -> tuple[int, int] | None:
        """Index and time of the last trigger at or before ``time_ns``."""


@dataclass(frozen=True)
class Numbered:
    """A frame with its trigger."""

    index: int
    trigger_ns: int
    lost_in_delivery: int  # frames that the camera exposed just before this one, and that never came


class FrameNumbering:
    """Ties one camera's frames to triggers by counter and time together.

    The first frame belongs to the last trigger before its exposure can have begun, by host time. From then on the
    *device's* clock says how many periods have passed since the last frame (host time is late when the host is busy,
    the device's is not), and its frame counter says how many of the skipped triggers were exposed.
    """

    def __init__(self, camera: CameraDescription, triggers: Triggers) -> None:
        self._camera = camera
        self._triggers = triggers
        self._last: tuple[Grab, Numbered] | None = None
        self.duplicates = 0
        self.unsolicited = 0

    def number(self, grab: Grab) -> Numbered | None:
        """The frame's trigger; None for a frame that no trigger asked for or that came before (both counted)."""
        if self._last is None:
            found = self._by_host_time(grab)
            lost_in_delivery = 0
        else:
            last_grab, last = self._last
            steps = (grab.frame_id - last_grab.frame_id) % (1 << self._camera.frame_id_bits)
            if steps == 0:
                self.duplicates += 1
                return None
            passed_ns = round((grab.device_ticks - last_grab.device_ticks) * 1e9 / self._camera.tick_hz)
            found = self._triggers.nearest(last.trigger_ns + passed_ns, REPORT_WAIT_S)
            if found is not None and found[0] <= last.index:
                self.unsolicited += 1
                return None
            lost_in_delivery = min(steps, found[0] - last.index) - 1 if found else 0
        if found is None:
            self.unsolicited += 1
            return None
        numbered = Numbered(found[0], found[1], lost_in_delivery)
        self._last = (grab, numbered)
        return numbered

    def _by_host_time(self, grab: Grab) -> tuple[int, int] | None:
        readout_ns = self._camera.row_time_ns * self._camera.height
        latest_ns = grab.receive_ns - grab.exposure_us * 1000 - readout_ns
        return self._triggers.latest_before(latest_ns, FIRST_REPORT_WAIT_S)
