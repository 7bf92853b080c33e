"""What should be in order during a recording, to marks with begin and end where it is not."""

import threading
from collections.abc import Mapping
from dataclasses import dataclass

from capture.aux_log import Put
from capture.clock import EARLIEST_NS, Clock
from capture.clock_fit import ClockFigures
from capture.record import GATE_TOPIC, Diagnostic, Gate

EARLY_PERIODS = 0.25  # more than board and computer may disagree by, less than a frame numbered one too high does


@dataclass(frozen=True)
class _Open:
    begin_ns: int
    cause: str


class Gates:
    """Judges by name, from any thread. A gate that fails never stops a recording: it is marked."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._put: Put | None = None
        self._failing: dict[str, _Open] = {}
        self._marked = 0
        self._mutex = threading.Lock()

    def start(self, put: Put) -> None:
        """Write marks from now on; those of what fails already come at once."""
        with self._mutex:
            self._put = put
            for name, found in self._failing.items():
                self._mark(name, found, 0)

    def judge(self, name: str, cause: str | None) -> None:
        """The gate ``name`` fails for ``cause``; None: it is in order. What it began with stays its cause."""
        with self._mutex:
            found = self._failing.get(name)
            if cause is not None and found is None:
                self._failing[name] = _Open(self._clock.utc_ns(), cause)
                self._marked += 1
                self._mark(name, self._failing[name], 0)
            elif cause is None and found is not None:
                del self._failing[name]
                self._mark(name, found, self._clock.utc_ns())

    @property
    def failing(self) -> dict[str, str]:
        """Cause by name of what fails now."""
        with self._mutex:
            return {name: found.cause for name, found in self._failing.items()}

    def statuses(self) -> list[Diagnostic]:
        """One for each gate that fails."""
        with self._mutex:
            return [
                Diagnostic(2, f"gate {name}", found.cause, (("begin_ns", str(found.begin_ns)),))
                for name, found in self._failing.items()
            ]

    def account(self) -> dict[str, str]:
        """How often something began to fail."""
        return {"gates_marked": str(self._marked)}

    def stop(self) -> None:
        """The recording ends, and with it every mark. Safe to call twice."""
        for name in self.failing:
            self.judge(name, None)
        with self._mutex:
            self._put = None

    def _mark(self, name: str, found: _Open, end_ns: int) -> None:
        if self._put is not None:
            at_ns = end_ns or found.begin_ns
            self._put(GATE_TOPIC, at_ns, Gate(found.begin_ns, end_ns, name, found.cause).encode())


def judge_clock(gates: Gates, clock: Clock) -> None:
    """The computer's clock has been set."""
    gates.judge("clock", None if clock.utc_ns() >= EARLIEST_NS else "the computer's clock was never set: it says 1970")


def judge_cameras(gates: Gates, clocks: Mapping[str, ClockFigures], limit_us: float, period_us: float) -> None:
    """Each camera's instants are known within the limit, and no frame comes before its exposure can have ended.

    The latter is what frames do that are numbered too high: a camera's first ones were all late by more than a period.

    Args:
        gates: where it is marked.
        clocks: by ``side/name``.
        limit_us: one sigma.
        period_us: from trigger to trigger.
    """
    for name, figures in clocks.items():
        sigma_us = figures.sigma_ns * 1e-3
        wide = figures.frames > 0 and sigma_us > limit_us
        cause = f"its frames' instants are known to {sigma_us:.0f} us only, not {limit_us:g} us"
        gates.judge(f"clock {name}", cause if wide else None)
        early = figures.floor_us < -EARLY_PERIODS * period_us  # False while the floor is not known
        cause = (
            f"its frames come {-figures.floor_us * 1e-3:.1f} ms before their exposure can have ended: they may be "
            "numbered too high, or the clocks of trigger board and computer disagree"
        )
        gates.judge(f"numbering {name}", cause if early else None)
