"""A numbered frame of one camera to the instant of its exposure, and how well that is known."""

import math
from collections.abc import Callable
from dataclasses import dataclass

from capture.camera.base import CameraDescription, Grab
from capture.clock_fit import ClockFigures, ClockFit
from capture.numbering import Numbered, Triggers
from capture.ptp import ClockState
from capture.record import PtpState


@dataclass(frozen=True)
class FrameTime:
    """When a frame was exposed."""

    trigger_ns: int  # UTC
    exposure_start_ns: int  # UTC, of row 0
    sigma_ns: int  # one sigma; -1: not known
    ptp_state: PtpState


class FrameClock:
    """The camera's clock fit, and the state of the computer's clock. The read thread's own."""

    def __init__(
        self,
        camera: CameraDescription,
        triggers: Triggers,
        clock_state: Callable[[], ClockState],
        trigger_latency_ns: int,
    ) -> None:
        """``trigger_latency_ns`` passes between a trigger and the start of row 0's exposure."""
        self._fit = ClockFit(camera.tick_hz)
        self._triggers = triggers
        self._clock_state = clock_state
        self._latency_ns = trigger_latency_ns
        self._readout_ns = camera.row_time_ns * camera.height

    def time_of(self, grab: Grab, numbered: Numbered) -> FrameTime:
        """Take each frame once, in order."""
        trigger_ns, reported = self._triggers.time_of(numbered.index, numbered.trigger_ns)
        found = self._fit.feed(
            grab.device_ticks,
            trigger_ns + self._latency_ns,
            reported,
            grab.receive_ns - grab.exposure_us * 1000 - self._readout_ns,
        )
        state = self._clock_state()
        sigma_ns = math.hypot(found.sigma_ns, state.sigma_ns)
        known_ns = -1 if math.isnan(sigma_ns) else math.ceil(sigma_ns)
        return FrameTime(trigger_ns, found.start_ns, known_ns, state.ptp_state)

    @property
    def figures(self) -> ClockFigures:
        """How the camera's fit is doing."""
        return self._fit.figures
