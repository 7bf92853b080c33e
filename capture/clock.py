"""The only reader of time in capture. Everything that needs the time is given a Clock."""

import time
from typing import Protocol

EARLIEST_NS = 1_735_689_600_000_000_000
"""2025-01-01 UTC: a clock before it was never set."""


class Clock(Protocol):
    """Time as the recorder sees it; simulated in the fault tests."""

    def utc_ns(self) -> int:
        """UTC nanoseconds since 1970 of the PTP-disciplined system clock."""

    def monotonic_s(self) -> float:
        """Seconds that never step, for waits and durations."""

    def sleep(self, seconds: float) -> None:
        """Wait."""


class SystemClock:
    """The computer's own clock."""

    def utc_ns(self) -> int:
        """UTC nanoseconds since 1970."""
        return time.time_ns()

    def monotonic_s(self) -> float:
        """Seconds that never step."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Wait."""
        time.sleep(seconds)
