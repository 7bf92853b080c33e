"""What the bench offers, and cameras and triggers that cost nothing: frames come due by the clock."""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from capture.camera.base import Camera, CameraDescription, CameraSettings, FrameStatus, Grab
from capture.config import driver_buffers
from capture.ring import Ring

FOLLOWERS_SPARE_SLOTS = 4  # a camera that follows the disk leaves so many free: the sets that are under way need them
FOLLOWERS_POLL_S = 0.002  # a fraction of the ring


@dataclass(frozen=True)
class BenchCase:
    """What one run offers."""

    mode: str
    width: int
    height: int
    rate_hz: float
    frames: int  # a camera
    stall_s: float = 2.0  # the ring bridges so long a stall

    @property
    def ring_slots(self) -> int:
        """Slots of each camera's ring."""
        return round(self.stall_s * self.rate_hz) + driver_buffers(self.rate_hz)


class ClockedTriggers:
    """Triggers by the clock: number k at ``start_ns + k · period``."""

    def __init__(self, start_ns: int, rate_hz: float) -> None:
        self.start_ns = start_ns
        self.period_ns = round(1e9 / rate_hz)

    def nearest(self, time_ns: int, wait_s: float) -> tuple[int, int] | None:
        """Index and time of the trigger nearest to ``time_ns``."""
        index = round((time_ns - self.start_ns) / self.period_ns)
        return index, self.start_ns + index * self.period_ns

    def latest_before(self, time_ns: int, wait_s: float) -> tuple[int, int] | None:
        """Index and time of the last trigger at or before ``time_ns``."""
        index = (time_ns - self.start_ns) // self.period_ns
        return index, self.start_ns + index * self.period_ns

    def time_of(self, index: int, log_ns: int) -> tuple[int, bool]:
        """As it was told."""
        return log_ns, True


class ClockedCamera(Camera):
    """Frames come due by the clock; each takes the oldest buffer that was queued by then, or is gone."""

    def __init__(self, case: BenchCase, triggers: ClockedTriggers) -> None:
        super().__init__("bench", CameraSettings(case.width, case.height, 0, 0.0))
        self._triggers = triggers
        self._frames = case.frames
        self._room: Callable[[], bool] | None = None
        self._next = 0
        self._buffers: deque[tuple[int, int]] = deque()  # slot, queued at

    def open(self) -> CameraDescription:
        """A camera without exposure or readout time."""
        return CameraDescription("bench", "0", self.settings.width, self.settings.height, 0, 0.0, 0, 1e9, 32, True)

    def queue(self, slot: int, buffer: memoryview) -> None:
        """An empty buffer."""
        self._buffers.append((slot, time.time_ns()))

    def arm(self) -> None:
        """Nothing to do."""

    def follow(self, ring: Ring, beside: "ClockedCamera") -> None:
        """From here on frames come as fast as there is room for them, not by the clock.

        As triggered cameras are, the two of a side are never more than one frame apart.
        """
        self._room = lambda: ring.free > FOLLOWERS_SPARE_SLOTS and self._next <= beside._next

    def grab(self, timeout_s: float) -> Grab | None:
        """The next frame that found a buffer."""
        if self._room is not None:
            return self._grab_followed(self._room, timeout_s)
        give_up_ns = time.time_ns() + int(timeout_s * 1e9)
        while self._next < self._frames:
            due_ns = self._triggers.start_ns + self._next * self._triggers.period_ns
            if due_ns > give_up_ns:
                time.sleep(timeout_s)
                return None
            if (wait_ns := due_ns - time.time_ns()) > 0:
                time.sleep(wait_ns / 1e9)
            self._next += 1
            if self._buffers and self._buffers[0][1] <= due_ns:
                slot, _ = self._buffers.popleft()
                return Grab(slot, self._next, due_ns, due_ns + 1, 0, 0.0, FrameStatus.COMPLETE)
        time.sleep(timeout_s)
        return None

    def _grab_followed(self, room: Callable[[], bool], timeout_s: float) -> Grab | None:
        give_up_s = time.monotonic() + timeout_s
        while self._next >= self._frames or not room():
            if time.monotonic() > give_up_s:
                return None
            time.sleep(FOLLOWERS_POLL_S)
        due_ns = self._triggers.start_ns + self._next * self._triggers.period_ns
        self._next += 1
        slot, _ = self._buffers.popleft()
        return Grab(slot, self._next, due_ns, due_ns + 1, 0, 0.0, FrameStatus.COMPLETE)

    def disarm(self) -> None:
        """Nothing to do."""

    def close(self) -> None:
        """Nothing to do."""

    @property
    def finished(self) -> bool:
        """Whether every frame has come due."""
        return self._next >= self._frames
