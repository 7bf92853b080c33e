"""A camera's frame counter and clock to trigger indices."""

from dataclasses import dataclass
from typing import Protocol

from capture.camera.base import CameraDescription, Grab

REPORT_WAIT_S = 0.03
"""How long a frame waits for the board's report of its trigger; the report normally came long before."""
FIRST_REPORT_WAIT_S = 0.12
"""The same for a camera's first frame, which nothing but the report can number. The driver's buffers bridge it."""


LEAP_NS = 10_000_000_000
"""What a device's clock may pass between two frames without the computer's clock having noticed."""
KNOWN_FOR_NS = 60_000_000_000
"""What may pass of a lost camera's own clock for it to tell a trigger from the next when the camera is back."""
CLOCK_ERROR = 1e-4
"""Of a camera's clock, by which it may have gone wrong since; relative."""
EDGE_ERROR_NS = 1_000_000
"""By which a trigger may be off its regular time."""
LATEST_TRIGGERS = 10
"""By which the first frames may have been late: more is another clock than the one known before."""


class Triggers(Protocol):
    """Which trigger was given when; capture.trigger.TriggerLog in a flight."""

    def nearest(self, time_ns: int, wait_s: float) -> tuple[int, int] | None:
        """Index and time of the trigger nearest to ``time_ns``."""

    def latest_before(self, time_ns: int, wait_s: float) -> tuple[int, int] | None:
        """Index and time of the last trigger at or before the UTC time ``time_ns``."""

    def time_of(self, index: int, log_ns: int) -> tuple[int, bool]:
        """UTC of the trigger whose time was told as ``log_ns``, and whether the board itself has said it."""


CONFIRMING = 4
"""Frames there must be before the first one is believed to know its trigger; and …"""
MOST_HELD = 7
"""… so many where no two of them came equally promptly: then all may have been late, and the next one less."""
PROMPT_SHARE = 1 / 8
"""Of the time between frames, by which those that came promptly differ."""


@dataclass(frozen=True)
class Numbered:
    """A frame with its trigger."""

    index: int
    trigger_ns: int
    lost_in_delivery: int  # frames that the camera exposed just before this one, and that never came


class FrameNumbering:
    """Ties one camera's frames to triggers by counter and time together.

    The first frames are held back until there are ``CONFIRMING`` of them, and more where they came by fits and starts:
    the computer was busy just then. By host time each belongs to the last trigger
    before its exposure can have begun, or, when it was delivered late, to an earlier one; so the earliest of what
    they say about the first frame is believed. From then on the *device's* clock says how many periods have passed
    since the last frame (host time is late when the host is busy, the device's is not), and its frame counter says
    how many of the skipped triggers were exposed. A device whose clock jumps is noticed by frames that fit no trigger,
    or come long before the time that it says has passed: after ``CONFIRMING`` of them in a row it is begun with anew.

    When a camera that was lost comes back and its clock has run on, that clock says which trigger the first frame is
    of, even if all of the first frames are late.
    """

    def __init__(
        self,
        camera: CameraDescription,
        triggers: Triggers,
        earliest_index: int = 0,
        before: tuple[Grab, Numbered] | None = None,
    ) -> None:
        """``earliest_index``: the first trigger that a frame can be of; ``before``: the ``last`` of the lost camera."""
        self._earliest = earliest_index
        self._before = before
        self._camera = camera
        self._triggers = triggers
        self._held: list[Grab] = []
        self._last: tuple[Grab, Numbered] | None = None
        self._strays = 0  # frames in a row that were nobody's

    @property
    def last(self) -> tuple[Grab, Numbered] | None:
        """The last frame that was numbered, also before the camera was lost."""
        return self._last or self._before

    def feed(self, grab: Grab) -> list[tuple[Grab, Numbered | None]]:
        """Take a frame; the frames that can be told now, in order.

        A frame is None when it is none of a trigger's: a duplicate, or one that no trigger asked for.
        """
        if self._last is not None:
            numbered = self._next(grab, self._last)
            self._strays = 0 if numbered else self._strays + 1
            if self._strays >= CONFIRMING:  # its clock has begun anew
                self._earliest = self._last[1].index + 1
                self._last, self._before, self._strays = None, None, 0
            return [(grab, numbered)]
        self._held.append(grab)
        return self._settle() if self._enough() else []

    def flush(self) -> list[tuple[Grab, Numbered | None]]:
        """Number what is held back, because no more will come."""
        told: list[tuple[Grab, Numbered | None]] = []
        while self._held:
            told += self._settle()
        return told

    def _enough(self) -> bool:
        """Whether the held frames can be taken to have one among them that came without delay."""
        if not CONFIRMING <= len(self._held) < MOST_HELD:
            return len(self._held) >= MOST_HELD
        between_ns = self._device_ns(self._held[-1].device_ticks - self._held[0].device_ticks) / (len(self._held) - 1)
        late_ns = sorted(grab.receive_ns - self._device_ns(grab.device_ticks) for grab in self._held)
        return late_ns[1] - late_ns[0] <= PROMPT_SHARE * between_ns

    def _settle(self) -> list[tuple[Grab, Numbered | None]]:
        """Number what is held back. When the first of it is none of a trigger's, only that one is told.

        Those after it may be: the camera was armed while somebody else's triggers were still coming.
        """
        first = self._first(self._held)
        if first is None:
            return [(self._held.pop(0), None)]
        held, self._held = self._held, []
        self._last = (held[0], first)
        return [(held[0], first), *(told for grab in held[1:] for told in self.feed(grab))]

    def _first(self, held: list[Grab]) -> Numbered | None:
        """The trigger of the first of ``held``; None when the board has given none."""
        readout_ns = self._camera.row_time_ns * self._camera.height
        found: list[tuple[int, int]] = []
        for grab in held:
            later_ns = self._device_ns(grab.device_ticks - held[0].device_ticks)
            latest_ns = grab.receive_ns - grab.exposure_us * 1000 - readout_ns
            trigger = self._triggers.latest_before(latest_ns, FIRST_REPORT_WAIT_S)
            first = trigger and self._triggers.nearest(trigger[1] - later_ns, FIRST_REPORT_WAIT_S)
            if first and first[0] >= self._earliest:  # what was reckoned beyond it is wrong
                found.append(first)
        if not found:
            return None
        latest = min(found)
        return Numbered(*(self._by_clock_before(held[0], latest[0]) or latest), 0)

    def _by_clock_before(self, first: Grab, latest_index: int) -> tuple[int, int] | None:
        """The trigger of ``first``, not above ``latest_index``, by the clock of before; None when it has not run on."""
        if self._before is None:
            return None
        grab, numbered = self._before
        passed_ns = self._device_ns(first.device_ticks - grab.device_ticks)
        if not 0 < passed_ns < KNOWN_FOR_NS:
            return None
        expected_ns = numbered.trigger_ns + passed_ns
        found = self._triggers.nearest(expected_ns, FIRST_REPORT_WAIT_S)
        if found is None or abs(found[1] - expected_ns) > passed_ns * CLOCK_ERROR + EDGE_ERROR_NS:
            return None
        lowest = max(self._earliest, latest_index - LATEST_TRIGGERS)
        return found if lowest <= found[0] <= latest_index else None

    def _next(self, grab: Grab, last: tuple[Grab, Numbered]) -> Numbered | None:
        last_grab, before = last
        steps = (grab.frame_id - last_grab.frame_id) % (1 << self._camera.frame_id_bits)
        passed_ns = self._device_ns(grab.device_ticks - last_grab.device_ticks)
        if passed_ns > LEAP_NS and grab.receive_ns - last_grab.receive_ns < passed_ns // 2:
            return None  # no time that passed: its clock was set
        found = self._triggers.nearest(before.trigger_ns + passed_ns, REPORT_WAIT_S)
        if steps == 0 or found is None or found[0] <= before.index:
            return None
        numbered = Numbered(found[0], found[1], min(steps, found[0] - before.index) - 1)
        self._last = (grab, numbered)
        return numbered

    def _device_ns(self, ticks: int) -> int:
        return round(ticks * 1e9 / self._camera.tick_hz)
