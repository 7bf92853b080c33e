"""A recording as the computer's service manager sees it: ready, alive, in a few words, and in the journal."""

from collections.abc import Sequence

from capture.clock import Clock
from capture.config import Config
from capture.console import Narrator
from capture.journal import PROGRESS_PERIOD_S, Changes, Journal
from capture.notify import Notifier
from capture.record import Diagnostic
from capture.watchdog import IDLE, Progress, Watchdog, watchdog_s


class Service:
    """What a recording is given to speak by. On a terminal it speaks to the person there."""

    def __init__(self, config: Config, clock: Clock, voice: Narrator | Journal, notifier: Notifier) -> None:
        self._watchdog_s = watchdog_s(config)
        self._clock = clock
        self._voice = voice
        self._notifier = notifier
        self._watchdog = Watchdog(notifier.alive, clock.monotonic_s)
        self._changes = Changes(clock.monotonic_s)
        self._totals_s = float("-inf")  # when the running totals last went to the journal
        self._ready = False

    def event(self, text: str) -> None:
        """Something that happened once."""
        self._voice(text)

    @property
    def managed(self) -> bool:
        """Whether a service manager has started us: nobody is there to ask."""
        return self._notifier.listening

    def totals(self, line: str) -> None:
        """The running totals, each second."""
        self._notifier.status(line)
        if isinstance(self._voice, Journal):
            now_s = self._clock.monotonic_s()
            if now_s - self._totals_s < PROGRESS_PERIOD_S:
                return
            self._totals_s = now_s
        self._voice(line)

    def statuses(self, statuses: Sequence[Diagnostic]) -> None:
        """How everything is, each second; what has changed is told."""
        for priority, name, text in self._changes.of(statuses):
            if isinstance(self._voice, Journal):
                self._voice.write(priority, text, name)
            else:
                self._voice(text)

    def step(self) -> None:
        """One step of a recording's start is done. Where an earlier one has said that we are ready, that is life."""
        if self._ready:
            self._watchdog.look(IDLE)

    def look(self, progress: Progress) -> None:
        """The recording is at work, or rightly idle. The first time says that the service is ready."""
        if not self._ready:
            self._ready = True
            self._notifier.ready(self._watchdog_s)
        self._watchdog.look(progress)

    def close(self) -> None:
        """The service ends in good order."""
        self._notifier.stopping()
        self._notifier.close()
        self._voice.close()
