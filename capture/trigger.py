"""The trigger board's driver: a serial port to pulses with index and time."""

import bisect
import queue
import threading
from collections import deque
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
RECONNECT_S = 0.25
WRITE_TIMEOUT_S = 1.0
BOARD_ANSWER_S = 2 * (WRITE_TIMEOUT_S + REPLY_TIMEOUT_S)  # a question is asked twice
REPORTS_COMPARED = 64  # to find the delay that the computer did not add to
_PULSES_KEPT = 4096
_STEPS_KEPT = 64


class ForeignClock:
    """UTC of the pulses of a board whose clock is not on UTC: its clock, and the least delay of its last reports.

    A report is late by what line and computer take, often much, but never early. A step of the board's clock by less
    than 0.4 periods is not noticed: for ``REPORTS_COMPARED`` reports, times may then be early by as much.
    """

    def __init__(self, period_ns: int) -> None:
        self.since_index = 0  # of the pulses whose times rest on the same clocks as the last one's
        self._period_ns = period_ns
        self._last: tuple[Pulse, int] | None = None  # and UTC minus a clock that never steps
        self._offsets_ns: deque[int] = deque(maxlen=REPORTS_COMPARED)

    def utc_ns(self, pulse: Pulse, received_ns: int, monotonic_ns: int) -> tuple[int, int]:
        """When the pulse was given, by this computer's clock; begun with anew where a pulse or a clock has stepped.

        Returns:
            that time, and by how much later than true those told since ``since_index`` were, as is seen now.
        """
        if self._last is None or self._has_stepped(*self._last, pulse, received_ns - monotonic_ns):
            self._offsets_ns.clear()
            self.since_index = pulse.index
        self._last = pulse, received_ns - monotonic_ns
        offset_ns = received_ns - pulse.actual_ns
        before_ns = min(self._offsets_ns, default=offset_ns)
        self._offsets_ns.append(offset_ns)
        return pulse.actual_ns + min(self._offsets_ns), max(0, before_ns - offset_ns)

    def _has_stepped(self, last: Pulse, utc_ns: int, pulse: Pulse, now_utc_ns: int) -> bool:
        """Whether the board's pulse or clock has, or the computer's clock."""
        regular_ns = (pulse.index - last.index) * self._period_ns
        board_ns = pulse.actual_ns - last.actual_ns - regular_ns
        return abs(board_ns) > 0.4 * self._period_ns or abs(now_utc_ns - utc_ns) > self._period_ns / 4


class TriggerLog:
    """Which trigger was given when. Thread-safe; remembers the last few thousand pulses.

    Its times run evenly even where the board's clock steps (a GPS that gets its fix): a step is kept aside, so that
    frames can be counted off across it, and ``time_of`` puts it back.
    """

    def __init__(self, rate_hz: float) -> None:
        self.period_ns = round(1e9 / rate_hz)
        self._report_ns = (
            self.period_ns // 4
        )  # what a report takes at most: no frame may seem to come before its trigger
        self._indices: list[int] = []
        self._times_ns: list[int] = []
        self._untrusted: set[int] = set()
        self._steps: list[tuple[int, int]] = [(0, 0)]  # from an index on, UTC minus our time
        self._silent = False  # a report did not come, and none has since
        self._changed = threading.Condition()

    def add(self, pulse: Pulse, trusted: bool = True, step_ns: int = 0) -> bool:
        """Book a pulse; one that was reported late goes where it belongs.

        Args:
            pulse: its ``actual_ns`` is the time to be told to others.
            trusted: False: it is not the board's own, but reckoned from when its reports came.
            step_ns: what the time has stepped by since the pulse before.

        Returns:
            False for one that contradicts its neighbours in index or time: it is not believed.
        """
        with self._changed:
            if step_ns:
                self._steps.append((pulse.index, self._steps[-1][1] + step_ns))
                del self._steps[1:-_STEPS_KEPT]
            time_ns = pulse.actual_ns - self._offset_ns(pulse.index) - (0 if trusted else self._report_ns)
            at = bisect.bisect_left(self._indices, pulse.index)
            if at < len(self._indices) and (self._indices[at] == pulse.index or self._times_ns[at] <= time_ns):
                return False
            if at > 0 and self._times_ns[at - 1] >= time_ns:
                return False
            self._indices.insert(at, pulse.index)
            self._times_ns.insert(at, time_ns)
            if not trusted:
                self._untrusted.add(pulse.index)
            if len(self._indices) > 2 * _PULSES_KEPT:
                del self._indices[:_PULSES_KEPT], self._times_ns[:_PULSES_KEPT]
                self._untrusted = {index for index in self._untrusted if index >= self._indices[0]}
            self._silent = False
            self._changed.notify_all()
            return True

    def lower(self, since_index: int, late_ns: int) -> None:
        """Pulses from an index on, known by nothing but their reports, were told so much too late."""
        with self._changed:
            for k in range(len(self._indices) - 1, -1, -1):
                if self._indices[k] < since_index or self._indices[k] not in self._untrusted:
                    break
                self._times_ns[k] -= late_ns

    def nearest(self, time_ns: int, wait_s: float) -> tuple[int, int] | None:
        """Index and time of the trigger nearest to ``time_ns``, both in this log's time.

        Waits up to ``wait_s`` for the board's report of it; not again, while none come. A trigger that was not
        reported is reckoned from its neighbour and the period. None when the board has not reported any pulse.
        """
        with self._changed:
            self._silent = not self._changed.wait_for(
                lambda: self._reported_until(time_ns), 0.0 if self._silent else wait_s
            )
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

    def latest_before(self, utc_ns: int, wait_s: float) -> tuple[int, int] | None:
        """Index and time, in this log's, of the last trigger at or before a UTC time; None when none is known."""
        with self._changed:
            time_ns = utc_ns - self._steps[-1][1]
        found = self.nearest(time_ns, wait_s)
        if found is None or found[1] <= time_ns:
            return found
        with self._changed:
            before = bisect.bisect_right(self._times_ns, time_ns) - 1
            if before < 0:
                return None
            steps = found[0] - 1 - self._indices[before]
            return found[0] - 1, self._times_ns[before] + steps * self.period_ns

    def time_of(self, index: int, log_ns: int) -> tuple[int, bool]:
        """UTC of a trigger whose time in this log is ``log_ns``, and whether the board itself has said it."""
        with self._changed:
            k = bisect.bisect_left(self._indices, index)
            known = k < len(self._indices) and self._indices[k] == index
            nearest = index if known else self._indices[max(0, k - 1)] if self._indices else index
            untrusted = nearest in self._untrusted
            return log_ns + self._offset_ns(index) + untrusted * self._report_ns, known and not untrusted

    def _offset_ns(self, index: int) -> int:
        return next(offset_ns for since, offset_ns in reversed(self._steps) if since <= index or since == 0)

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
        self.boots = 0  # how often the board has said that it was powered up
        self.gone = ""  # why the port is gone; empty: it is there
        self._clock = clock
        self._on_pulse = on_pulse
        self._on_sample = on_sample
        self._replies: queue.SimpleQueue[tuple[str, ...]] = queue.SimpleQueue()
        try:
            self._serial = self._open()
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
        """Read lines until asked to stop. A port that goes is opened again as soon as it is back."""
        while not self.stop_requested.is_set():
            try:
                self._read_lines()
            except (serial.SerialException, OSError) as error:
                self.gone = f"{self.port}: the trigger board is gone ({error}): check its cable"
                self._serial.close()
                self._reopen()

    def _open(self) -> serial.Serial:
        return serial.Serial(self.port, baudrate=115200, timeout=0.1, write_timeout=WRITE_TIMEOUT_S, exclusive=True)

    def _reopen(self) -> None:
        while not self.stop_requested.wait(RECONNECT_S):
            try:
                self._serial = self._open()
            except (serial.SerialException, OSError):
                continue
            self.gone = ""
            return

    def _read_lines(self) -> None:
        rest = b""
        while not self.stop_requested.is_set():
            rest += self._serial.read(self._serial.in_waiting or 1)
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
            elif words[0] == "BOOT":
                self.boots += 1
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
        if self.gone:
            raise TriggerBoardError(self.gone)
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


def is_running(port: str, clock: Clock) -> bool:
    """Whether a board there is giving triggers; False too where no board can be asked."""
    try:
        board = TriggerBoard(port, clock, lambda pulse, trigger: None)
    except TriggerBoardError:
        return False
    try:
        board.start()
        return board.status()[0]
    except TriggerBoardError:
        return False
    finally:
        board.close()
