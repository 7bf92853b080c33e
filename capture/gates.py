"""What should be in order during a recording, to marks with begin and end where it is not."""

import threading
from dataclasses import dataclass

from capture.aux_log import Put
from capture.clock import Clock
from capture.record import GATE_TOPIC, Diagnostic, Gate


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
