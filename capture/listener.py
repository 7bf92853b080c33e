"""What speaks beside the cameras (a CAN bus, an autopilot) to messages in the aux log, found again when it goes away.

The bound on what waits is the link's own (a socket's or a serial port's buffer in the kernel) and that of the aux log;
what either of them had no room for is counted, with its cause.
"""

import json
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from capture.aux_log import Put
from capture.clock import Clock
from capture.errors import LinkError
from capture.record import Diagnostic
from capture.worker import Worker

READ_S = 0.1  # a link is asked for so long before the listener looks around
RETRY_S = 1.0  # between attempts to open a link that is missing
SILENT_S = 2.0  # a link that is there and says nothing for so long is worth a warning
STOP_S = 5.0
OUTAGES_KEPT = 100


@dataclass(frozen=True)
class Heard:
    """One message, ready for the aux log."""

    topic: str
    time_ns: int  # UTC, of what it is about
    data: bytes  # CDR


class Link(Protocol):
    """An open connection. One thread uses it."""

    def hear(self, wait_s: float) -> Sequence[Heard]:
        """What has come, waiting up to ``wait_s`` for the first of it. Raises ``LinkError`` when the link is gone."""

    @property
    def lost(self) -> Counter[str]:
        """Messages lost since it was opened, by cause, as far as can be known."""

    def close(self) -> None:
        """Let go of it."""


class Listener:
    """A companion that keeps a link open in a thread of its own. It never stops a recording."""

    def __init__(self, name: str, connect: Callable[[], Link], clock: Clock, may_be_silent: bool = False) -> None:
        """``connect`` opens the link and raises ``LinkError`` when it cannot."""
        self.name = name
        self.messages = 0
        self.outages: list[tuple[int, int]] = []  # UTC nanoseconds, the first OUTAGES_KEPT
        self.outages_in_all = 0
        self._connect = connect
        self._clock = clock
        self._may_be_silent = may_be_silent
        self._put: Put | None = None
        self._lost: Counter[str] = Counter()  # on links that are closed
        self._link: Link | None = None
        self._sound = False  # the link has been heard without an error: one that opens may be dead all the same
        self._trouble = "not opened yet"
        self._gone_ns: int | None = None  # since when
        self._heard_s = 0.0
        self._reported = (0.0, 0)  # when, and how many messages
        self._thread = _Listening(name, self._listen)

    def start(self, put: Put) -> None:
        """Begin to listen."""
        self._put = put
        self._reported = (self._clock.monotonic_s(), 0)
        self._thread.start()

    def statuses(self) -> list[Diagnostic]:
        """One line: missing, silent, losing, or how many messages a second."""
        now_s = self._clock.monotonic_s()
        (then_s, then), self._reported = self._reported, (now_s, self.messages)
        rate = (self.messages - then) / max(now_s - then_s, 1e-3)
        lost = self.lost
        values = (("messages", str(self.messages)), ("lost", json.dumps(lost)), ("outages", str(self.outages_in_all)))
        if not self._sound:
            return [Diagnostic(2, self.name, self._trouble, values)]
        if now_s - self._heard_s > SILENT_S and not self._may_be_silent:
            return [Diagnostic(1, self.name, f"silent for {now_s - self._heard_s:.0f} s", values)]
        said = f"{rate:.0f} messages/s"
        return [Diagnostic(1 if lost else 0, self.name, f"{said}, some are lost" if lost else said, values)]

    def stop(self) -> None:
        """End; no message after this returns. Safe to call twice."""
        self._put = None
        self._thread.stop(STOP_S)

    def account(self) -> dict[str, str]:
        """What was heard and lost, and when the link was gone."""
        return {
            f"{self.name}.messages": str(self.messages),
            f"{self.name}.lost": json.dumps(self.lost),
            f"{self.name}.outages": json.dumps(self.outages),
            f"{self.name}.outages_in_all": str(self.outages_in_all),
        }

    @property
    def lost(self) -> Counter[str]:
        """Messages lost so far, by cause."""
        link = self._link
        return self._lost + (link.lost if link is not None else Counter())

    def _listen(self, stop: threading.Event) -> None:
        try:
            while not stop.is_set():
                if not (self._hear(self._link) if self._link is not None else self._open()):
                    stop.wait(RETRY_S)
        finally:
            self._book_outage()
            self._close()

    def _open(self) -> bool:
        try:
            self._link = self._connect()
        except Exception as error:  # as below: it is tried again
            self._is_gone(self._why(error))
            return False
        self._heard_s = self._clock.monotonic_s()
        return True

    def _hear(self, link: Link) -> bool:
        try:
            heard = link.hear(READ_S)
        except Exception as error:  # drivers raise what they like; whatever it is, the link is opened anew
            self._is_gone(self._why(error))
            self._close()
            return False
        self._sound = True
        self._book_outage()
        for message in heard:
            put = self._put
            if put is None:
                break
            put(message.topic, message.time_ns, message.data)
            self.messages += 1
        if heard:
            self._heard_s = self._clock.monotonic_s()
        return True

    def _why(self, error: Exception) -> str:
        return str(error) if isinstance(error, LinkError) else f"{self.name}: {error!r}"

    def _is_gone(self, why: str) -> None:
        self._sound = False
        self._trouble = why
        self._gone_ns = self._gone_ns or self._clock.utc_ns()

    def _close(self) -> None:
        link, self._link = self._link, None
        if link is None:
            return
        try:
            link.close()
        except Exception as error:  # the device is gone already
            self._trouble = self._trouble or repr(error)
        self._lost += link.lost  # with what it counted last

    def _book_outage(self) -> None:
        """One that has gone on until now, if one has."""
        begin_ns, self._gone_ns = self._gone_ns, None
        if begin_ns is None:
            return
        self.outages_in_all += 1
        if len(self.outages) < OUTAGES_KEPT:
            self.outages.append((begin_ns, self._clock.utc_ns()))


class _Listening(Worker):
    """The thread of a listener."""

    def __init__(self, name: str, job: Callable[[threading.Event], None]) -> None:
        super().__init__(name)
        self._job = job

    def work(self) -> None:
        self._job(self.stop_requested)
