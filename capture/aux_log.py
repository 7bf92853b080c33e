"""The small messages of a flight, from any thread to the aux files of all disks."""

import itertools
import threading
from collections import Counter, defaultdict
from collections.abc import Callable
from typing import Protocol

from capture.clock import Clock
from capture.record import (
    DIAGNOSTICS_TOPIC,
    LOSS_TOPIC,
    TRIGGER_TOPIC,
    Diagnostic,
    Loss,
    Trigger,
    encode_diagnostics,
)
from capture.recorder import AUX_CHANNELS
from capture.segment import SmallMessage

MESSAGES_HELD = 100_000
"""Bound on what waits for the control thread, which comes ten times a second; beyond it, messages of companions are
dropped and counted. Triggers and losses always fit: their number is that of the frames."""

_CHANNEL = {channel.topic: channel.id for channel in AUX_CHANNELS}

Put = Callable[[str, int, bytes], None]
"""Log a message: topic, the UTC nanoseconds it is about, its CDR bytes. From any thread; never blocks."""


class Companion(Protocol):
    """What runs beside a recording with threads of its own and logs small messages: the PTP watch, a CAN bus."""

    def start(self, put: Put) -> None:
        """Begin. A companion that cannot begin says so in its statuses; it never stops a recording."""

    def statuses(self) -> list[Diagnostic]:
        """How it is doing, asked a few times a second by one thread at a time. Must not block."""

    def stop(self) -> None:
        """End; no message after this returns. Safe to call twice."""

    def account(self) -> dict[str, str]:
        """After ``stop``: what it took and lost, for the flight's last Metadata record. Keys begin with its name."""


class AuxLog:
    """Collects small messages until the control thread takes them."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._messages: list[SmallMessage] = []
        self._numbers: defaultdict[str, itertools.count[int]] = defaultdict(lambda: itertools.count(1))
        self.triggers = 0  # pulses reported by the board
        self.dropped: Counter[str] = Counter()  # messages by topic for which there was no room
        self._mutex = threading.Lock()

    def trigger(self, trigger: Trigger) -> None:
        """A pulse of the board."""
        self.triggers += 1
        at_ns = (trigger.receive_time_ns, trigger.reported_time_ns)
        self._add(SmallMessage(_CHANNEL[TRIGGER_TOPIC], trigger.index, *at_ns, trigger.encode()))

    def loss(self, loss: Loss) -> None:
        """A lost frame."""
        at_ns = (loss.time_ns, loss.time_ns)
        self._add(SmallMessage(_CHANNEL[LOSS_TOPIC], loss.trigger_index, *at_ns, loss.encode()))

    def diagnostics(self, statuses: tuple[Diagnostic, ...]) -> None:
        """The state of things."""
        now_ns = self._clock.utc_ns()
        self.put(DIAGNOSTICS_TOPIC, now_ns, encode_diagnostics(now_ns, statuses))

    def put(self, topic: str, time_ns: int, data: bytes) -> None:
        """Any other message; numbered from 1 on its topic. ``time_ns`` is the instant that it is about."""
        with self._mutex:
            if len(self._messages) >= MESSAGES_HELD:
                self.dropped[topic] += 1
                return
            number = next(self._numbers[topic])
            self._messages.append(SmallMessage(_CHANNEL[topic], number, self._clock.utc_ns(), time_ns, data))

    def take(self) -> tuple[SmallMessage, ...]:
        """What has come since the last call."""
        with self._mutex:
            messages, self._messages = tuple(self._messages), []
        return messages

    def _add(self, message: SmallMessage) -> None:
        with self._mutex:
            self._messages.append(message)
