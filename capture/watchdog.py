"""Progress of a recording to a sign of life: only frames that reach the disk, or the lack of any that should, count.

A thread that still turns proves nothing: a camera library may hang, a disk may swallow writes for ever. So the sign is
given by what a flight is for. The rule, applied at every look:

- frames were written since the last look: alive;
- none was, and none is due (every trigger of every camera that works is recorded or booked as lost): alive, idle;
- none was, though frames are due: silent. When that lasts longer than ``watchdog_s``, the service manager restarts us.

One camera, or one disk, that hangs while the others go on does not stop the sign: it is reported, and nothing is risked
for it. Docs: docs/explanation/service.md.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from capture.config import Config
from capture.lane import Lane
from capture.ledger import CameraAccount, Place
from capture.numbering import FIRST_REPORT_WAIT_S, MOST_HELD
from capture.trigger import BOARD_ANSWER_S

SIGN_PERIOD_S = 0.5
MARGIN = 1.5
LEAST_S = 5.0


def watchdog_s(config: Config) -> float:
    """How long a silence is not yet a fault: what a healthy recording may be silent for, and half as much again.

    The longest healthy silence: the disk stalls for as long as the ring bridges (``ring.stall_s``), the control
    thread waits for a board that answers at its last chance, and the cameras' first frames are held back until
    there are enough to be numbered. Or, before a recording: the test burst.
    """
    held_back_s = (MOST_HELD + 1 + config.start.burst) / config.trigger.rate_hz + FIRST_REPORT_WAIT_S
    return max(LEAST_S, MARGIN * (config.ring.stall_s + BOARD_ANSWER_S + held_back_s + SIGN_PERIOD_S))


@dataclass(frozen=True)
class Progress:
    """A recording at a glance."""

    written: int  # frames in the files
    due: bool  # a camera that works, on a disk that works, has a trigger that is neither recorded nor lost


IDLE = Progress(0, False)
"""Nothing to record just now."""


def progress(accounts: Mapping[Place, CameraAccount], lanes: Iterable[Lane]) -> Progress:
    """How far a recording is. A camera that is known to be gone, or whose disk is, owes nothing."""
    at_work = [
        accounts[lane.side, name]
        for lane in lanes
        if lane.recorder.failure is None
        for name, grabber in lane.grabbers.items()
        if grabber.error is None and not grabber.is_absent
    ]
    return Progress(
        sum(account.recorded for account in accounts.values()),
        any(account.triggers > account.recorded + account.lost_total for account in at_work),
    )


class Watchdog:
    """Looks at progress and gives the sign, twice a second at most."""

    def __init__(self, sign: Callable[[], None], monotonic_s: Callable[[], float]) -> None:
        self._sign = sign
        self._monotonic_s = monotonic_s
        self._written = -1
        self._signed_s = float("-inf")

    def look(self, progress: Progress) -> bool:
        """Give the sign if it is deserved; whether it was."""
        alive = progress.written != self._written or not progress.due
        if alive:
            now_s = self._monotonic_s()
            if now_s - self._signed_s < SIGN_PERIOD_S:
                return True  # what was written since counts at the next look
            self._signed_s = now_s
            self._written = progress.written
            self._sign()
        return alive
