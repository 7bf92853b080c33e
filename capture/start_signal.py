"""What others say of a switch (the autopilot's arming, a GPIO line) to when a recording begins and ends.

Only what is said counts: silence, a link that is gone or a line that cannot be read begins nothing and ends nothing.
"""

import threading

from capture.clock import Clock

SILENT_S = 5.0
"""Longer between two words, and nobody knows that the switch was off all the while: the wait for the end begins anew.
MAVLink takes a system as gone after so long (four or five heartbeats, mavlink.io/en/services/heartbeat.html)."""


class StartSignal:
    """One for each recording. ``tell`` may come from any thread."""

    def __init__(self, clock: Clock, ends_after_s: float | None = None) -> None:
        """``ends_after_s``: so long off, without a break, ends the recording; None: nothing does."""
        self._clock = clock
        self._ends_after_s = ends_after_s
        self._teller: int | None = None  # who began it: only that one ends it
        self._begun = False
        self._ended = False
        self._off_since_s: float | None = None
        self._told_s = 0.0
        self._mutex = threading.Lock()

    @property
    def begun(self) -> bool:
        """It is on, or has been."""
        return self._begun

    @property
    def ended(self) -> bool:
        """It was on, and then off for long enough."""
        return self._ended

    def tell(self, on: bool, teller: int = 0) -> None:
        """It is on or off now. ``teller`` says so: among several aircraft on one link, its MAVLink system."""
        with self._mutex:
            if on and not self._begun:
                self._begun, self._teller = True, teller
            if not self._begun or teller != self._teller:
                return
            now_s = self._clock.monotonic_s()
            silent = now_s - self._told_s > SILENT_S
            self._told_s = now_s
            if on:
                self._off_since_s = None
                return
            if self._off_since_s is None or silent:
                self._off_since_s = now_s
            if self._ends_after_s is not None and now_s - self._off_since_s >= self._ends_after_s:
                self._ended = True
