"""A named thread that hands its exception to its owner and is joined under a deadline."""

import sys
import threading
import time
from abc import ABC, abstractmethod

from capture.placement import Placement

GIL_SWITCH_S = 0.0005


def share_interpreter() -> None:
    """Let threads take turns every half millisecond: with the usual 5 ms one busy thread would hold up a write."""
    sys.setswitchinterval(GIL_SWITCH_S)


class Worker(ABC):
    """One job in one thread. The owner starts it, watches ``error``, and joins it."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.error: BaseException | None = None
        self.stop_requested = threading.Event()
        self.placement = Placement()  # the owner may give another before the start
        self.misplaced: str | None = None  # why the thread could not have its placement
        self._turned_s = time.monotonic()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    @abstractmethod
    def work(self) -> None:
        """The job. Returns soon after ``stop_requested`` is set, or raises."""

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self, deadline_s: float) -> bool:
        """Ask the job to end, wait for it, and say whether it ended in time."""
        self.stop_requested.set()
        if self._thread.ident is not None:
            self._thread.join(deadline_s)
        return not self._thread.is_alive()

    @property
    def running(self) -> bool:
        """Whether the job is still going on."""
        return self._thread.is_alive()

    def turn(self) -> None:
        """The job says that it has come round."""
        self._turned_s = time.monotonic()

    @property
    def still_s(self) -> float:
        """For how long the job has not come round. One that hangs does not."""
        return time.monotonic() - self._turned_s

    def _run(self) -> None:
        try:
            self.misplaced = self.placement.take()
            self.turn()
            self.work()
        except BaseException as error:  # the owner decides what it means
            self.error = error
