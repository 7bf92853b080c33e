"""The trigger board's driver: a serial port to pulses with index and time."""

import bisect
import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass

import serial

from capture.clock import Clock
from capture.errors import TriggerBoardError
from capture.record import Trigger
from capture.trigger_protocol import (
    PROTOCOL_VERSION,
    GarbledLine,
    Pulse,
    Sample,
    decode_line,
    encode_line,
    parse_pulse,
    parse_sample,
)
from capture.worker import Worker

REPLY_TIMEOUT_S = 1.0
_PULSES_KEPT = 4096


class TriggerLog:
    """Which trigger was given when. Thread-safe; remembers the last few thousand pulses."""

    def __init__(self, rate_hz: float) -> None:
        self.period_ns = round(1e9 / rate_hz)
        self._indices: list[int] = []
        self._times_ns: list[int] = []
        self._changed = threading.Condition()

    def add(self, pulse: Pulse) -> None:
        """Book a pulse. One that is not later than the last in index and time (a garbled report) is not believed."""
        with self._changed:
            if self._indices and (pulse.index <= self._indices[-1] or pulse.actual_ns <= self._times_ns[-1]):
                return
            self._indices.append(pulse.index)
            self._times_ns.append(pulse.actual_ns)
            if len(self._indices) > 2 * _PULSES_KEPT:
                del self._indices[:_PULSES_KEPT], self._times_ns[:_PULSES_KEPT]
            self._changed.notify_all()

    def nearest(self, time_ns: int, wait_s: float) -> tuple[int, int] | None:
        """Index and time of the trigger nearest to ``time_ns``.

        Waits up to ``wait_s`` for the board's report of it. A trigger that was not reported is reckoned from its
        neighbour and the period. None when the board has not reported any pulse.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._reported_until(time_ns), wait_s)
            if not self._indices:
                return None
            after = bisect.bisect_left(self._times_ns, time_ns)
            beside = [k for k in (after - 1, after) if 0 <= k < len(self._indices)]
            k = min(beside, key=lambda k: abs(self._times_ns[k] - time_ns))
            steps = round((time_ns - self._times_ns[k]) / self.period_ns)
            if len(beside) == 2:  # between two reports: no further than the other one
                other = beside[1 - beside.index(k)]
                between = abs(self._indices[other] - self._indices[k]) - 1
                steps = max(-between, min(between, steps))
            return self._indices[k] + steps, self._times_ns[k] + steps * self.period_ns

    def latest_before(self, time_ns: int, wait_s: float) -> tuple[int, int] | None:
        """Index and time of the last trigger at or before ``time_ns``; None when none is known."""
        found = self.nearest(time_ns, wait_s)
        if found is None or found[1] <= time_ns:
            return found
        with self._changed:
            before = bisect.bisect_right(self._times_ns, time_ns) - 1
            if before < 0:
                return None
            steps = found[0] - 1 - self._indices[before]
            return found[0] - 1, self._times_ns[before] + steps * self.period_ns

    def reported(self, index: int) -> bool:
        """Whether the board itself has said when it gave this trigger."""
        with self._changed:
            k = bisect.bisect_left(self._indices, index)
            return k < len(self._indices) and self._indices[k] == index

    def _reported_until(self, time_ns: int) -> bool:
        return bool(self._times_ns) and self._times_ns[-1] > time_ns - self.period_ns // 2


@dataclass(frozen=True)
class BoardCount:
    """What the board says it has done: the next pulse's index, and its own counter of edges."""

    next_index: int
    counter: int


class TriggerBoard(Worker):
    """The board behind a serial port. ``on_pulse`` and ``on_sample`` are called from the reading thread."""

    def __init__(
        self,
        port: str,
        clock: Clock,
        on_pulse: Callable[[Pulse, Trigger], None],
        on_sample: Callable[[Sample], None] | None = None,
    ) -> None:
        super().__init__("trigger-board")
        self.port = port
        self.garbled_lines = 0
        self._clock = clock
        self._on_pulse = on_pulse
        self._on_sample = on_sample
        self._replies: queue.SimpleQueue[tuple[str, ...]] = queue.SimpleQueue()
        try:
            self._serial = serial.Serial(port, baudrate=115200, timeout=0.1, write_timeout=1.0, exclusive=True)
        except (serial.SerialException, OSError) as error:
            raise TriggerBoardError(
                f"{port}: the trigger board's port cannot be opened ({error}): check `trigger.port`, the cable, "
                "and that no other recorder is running"
            ) from error

    def hello(self) -> str:
        """Check the protocol version; the board's name."""
        words = self._ask("HELLO")
        if len(words) < 2 or words[0] != str(PROTOCOL_VERSION):
            raise TriggerBoardError(
                f"{self.port}: the board speaks protocol {words[:1]}, not {PROTOCOL_VERSION}: update its firmware"
            )
        return " ".join(words[1:])

    def set_rate(self, rate_hz: float) -> None:
        """Set the pulse rate."""
        self._ask("RATE", str(round(rate_hz * 1000)))

    def sample(self, rate_hz: float) -> None:
        """Sample the analog inputs at this rate from now on; 0: not."""
        self._ask("ANALOG", str(round(rate_hz * 1000)))

    def begin(self, first_index: int, count: int = 0) -> None:
        """Give pulses from ``first_index`` on; ``count`` of them, or without end."""
        words = ("START", str(first_index), str(count))
        if self._ask_once(words) is None and not self.status()[0]:  # START itself must not be repeated
            raise TriggerBoardError(f"{self.port}: the trigger board does not start: check that it is powered")

    def end(self) -> BoardCount:
        """No pulse after this returns."""
        words = self._ask("STOP")
        return self._count(words)

    def status(self) -> tuple[bool, BoardCount]:
        """Whether the board is running, and its counts."""
        words = self._ask("STATUS")
        return words[:1] == ("1",), self._count(words[1:])

    def close(self) -> None:
        """Let go of the port. Safe to call twice."""
        self.stop(deadline_s=1.0)
        self._serial.close()

    def work(self) -> None:
        """Read lines until asked to stop.

        Raises:
            TriggerBoardError: the port is gone.
        """
        rest = b""
        while not self.stop_requested.is_set():
            try:
                rest += self._serial.read(self._serial.in_waiting or 1)
            except (serial.SerialException, OSError) as error:
                raise TriggerBoardError(f"{self.port}: the trigger board is gone ({error}): check its cable") from error
            *lines, rest = rest.split(b"\n")
            for line in lines:
                self._take(line)
            if len(rest) > 4096:  # no line end for far too long: not our protocol
                self.garbled_lines += 1
                rest = b""

    def _take(self, line: bytes) -> None:
        try:
            words = decode_line(line)
            if words[0] == "PULSE":
                pulse = parse_pulse(words)
                self._on_pulse(
                    pulse,
                    Trigger(pulse.index, pulse.counter, pulse.commanded_ns, pulse.actual_ns, self._clock.utc_ns()),
                )
            elif words[0] == "SAMPLE":
                sample = parse_sample(words)
                if self._on_sample is not None:
                    self._on_sample(sample)
            else:
                self._replies.put(words)
        except GarbledLine:
            self.garbled_lines += 1

    def _ask(self, *words: str) -> tuple[str, ...]:
        """The answer's words; asked twice, since an answer may be garbled."""
        reply = self._ask_once(words)
        if reply is None:
            reply = self._ask_once(words)
        if reply is None:
            raise TriggerBoardError(
                f"{self.port}: the trigger board did not answer {words[0]} within {2 * REPLY_TIMEOUT_S:g} s: "
                "check that it is powered and that no other program has its port"
            )
        return reply

    def _ask_once(self, words: tuple[str, ...]) -> tuple[str, ...] | None:
        while not self._replies.empty():  # late answers to questions that were given up
            self._replies.get()
        try:
            self._serial.write(encode_line(*words))
        except (serial.SerialException, OSError) as error:
            raise TriggerBoardError(f"{self.port}: the trigger board is gone ({error}): check its cable") from error
        deadline = self._clock.monotonic_s() + REPLY_TIMEOUT_S
        while (left := deadline - self._clock.monotonic_s()) > 0:
            try:
                reply = self._replies.get(timeout=left)
            except queue.Empty:
                break
            if reply[:2] == ("OK", words[0]):
                return reply[2:]
            if reply[0] == "ERR":
                raise TriggerBoardError(f"{self.port}: the board refuses {' '.join(words)}: {' '.join(reply[1:])}")
        return None

    def _count(self, words: tuple[str, ...]) -> BoardCount:
        try:
            next_index, counter = (int(word) for word in words)
        except ValueError as error:
            raise TriggerBoardError(f"{self.port}: the board's counts are no numbers: {' '.join(words)}") from error
        return BoardCount(next_index, counter)
