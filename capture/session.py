"""What starts and ends recordings in one run of the recorder: idle, then a recording, then idle again.

While idle no device is open, so that other commands can use the cameras. Within a recording the states go on:
``armed``, ``test burst``, ``recording``, ``stopping`` (capture.daemon).
"""

import threading
from collections.abc import Callable
from typing import Protocol

from capture.config import StartConfig
from capture.control import Answer
from capture.daemon import RecordingResult
from capture.stop_rule import StopRule
from capture.vitals import ARMED, IDLE


class Recordable(Protocol):
    """A recording that has not begun; capture.daemon.Recording."""

    flight: str

    @property
    def state(self) -> str:
        """In a word."""

    def run(self, stop: StopRule) -> RecordingResult:
        """Record until told to stop."""


class Session:
    """Recordings one after another. ``act`` and ``quit`` may come from any thread, ``quit`` from a signal handler."""

    def __init__(
        self,
        config: StartConfig,
        make: Callable[[], Recordable],
        tell: Callable[[str], None],
        on_idle: Callable[[], None] = lambda: None,
    ) -> None:
        """``make`` makes the next recording; ``on_idle`` is called about five times a second while there is none."""
        self.results: list[RecordingResult] = []
        self._by_itself = config.on != "command"
        self._make = make
        self._tell = tell
        self._on_idle = on_idle
        self._wanted = threading.Event()
        self._quit = threading.Event()
        self._stop = threading.Event()  # of the recording that runs
        self._begin = threading.Event()  # it waits no longer for what starts it
        self._current: Recordable | None = None

    @property
    def state(self) -> str:
        """``idle``, or that of the recording."""
        current = self._current
        return IDLE if current is None else current.state

    def quit(self) -> None:
        """End the recording, and the run."""
        self._quit.set()
        self._stop.set()
        self._wanted.set()

    def act(self, action: str) -> Answer:
        """Do what the control socket was asked for. It is begun when this returns, not done."""
        current = self._current
        flight = "" if current is None else current.flight
        if action == "start" and self.state == ARMED:
            self._begin.set()
            return Answer(True, ARMED, flight, "starting without what it waits for")
        if action == "start" and current is not None:
            return Answer(False, self.state, flight, "there is a recording already")
        if action == "stop" and current is None:
            return Answer(False, IDLE, "", "there is no recording to stop")
        if action == "start":
            self._wanted.set()
            return Answer(True, self.state, "", "starting")
        if action == "stop":
            self._stop.set()
            return Answer(True, self.state, flight, "stopping: the last frames are being written")
        return Answer(True, self.state, flight, "")

    def run(self, triggers: int, duration_s: float, in_flight: bool = False) -> RecordingResult | None:
        """Record as configured and told, until ``quit``, or until a recording ends without having been stopped.

        Args:
            triggers: after how many each recording ends by itself; 0: no limit.
            duration_s: after how long; 0: no limit.
            in_flight: triggers are still running for a recorder that is gone: record at once, whatever is configured.

        Returns:
            the last recording's result; None: there was none.

        Raises:
            CaptureError: a recording could not begin.
        """
        if self._by_itself or in_flight:
            self._wanted.set()
        while not self._quit.is_set():
            if not self._wanted.is_set():
                self._tell("idle: `wingcap start` begins a recording")
            while not self._wanted.wait(0.2):
                self._on_idle()
            if self._quit.is_set():
                break
            if not self._record(triggers, duration_s):
                break
        return self.results[-1] if self.results else None

    def _record(self, triggers: int, duration_s: float) -> bool:
        """One recording; whether another may follow: it was ended by command or as it began, and has not failed."""
        self._stop, self._begin = threading.Event(), threading.Event()
        if self._quit.is_set():  # it came just before
            self._stop.set()
        current = self._make()
        self._current = current
        self._wanted.clear()  # a start that came meanwhile meant this one
        self._tell(f"recording {current.flight}")
        try:
            result = current.run(StopRule(self._stop, triggers, duration_s, self._begin))
        finally:
            self._current = None
        self.results.append(result)
        self._tell(
            f"{result.flight}: {result.triggers} triggers, {result.recorded} frames recorded, {result.lost} lost"
        )
        if result.again and not self._stop.is_set():
            self._wanted.set()
        return (self._stop.is_set() or result.again) and not result.failures
