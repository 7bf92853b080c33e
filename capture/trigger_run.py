"""The board's pulses of one recording, from START to the final count, whatever happens to the board and its line.

Three things say which trigger a report is about: its index, the board's counter of edges, and its time. Two that
agree are believed. The counter begins again when the board is reset; then the pulses go on from the next index, and
a new *epoch* of the counter begins.
"""

from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass, replace

from capture.aux_log import AuxLog
from capture.clock import Clock
from capture.config import TriggerConfig
from capture.errors import TriggerBoardError
from capture.gates import Gates
from capture.ledger import Ledger
from capture.record import Trigger
from capture.trigger import BoardCount, ForeignClock, TriggerBoard, TriggerLog
from capture.trigger_protocol import Pulse, Sample

SILENT_S = 2.0  # a running board that has reported no pulse for so long is asked
RETRY_S = 1.0  # between tries to have a reset board give pulses again
DRAIN_S = 0.2  # how long frames of a reset board's last pulses may be on their way
STRANGE_NS = 1_000_000_000  # a board whose clock is further from the computer's is not on its time
GATE = "trigger board"
LATE_KEPT = 64
LATE_KNOWN = 8  # reports among which one can be taken to have come without delay
STRAYS_KEPT = 256
_SEEN_KEPT = 4096


@dataclass(frozen=True)
class _Epoch:
    """A stretch of the board's counter without a reset."""

    first_index: int
    counter_before: int  # its first pulse's counter is one more

    def index_of(self, counter: int) -> int:
        """What the counter says of a pulse's index."""
        return self.first_index + counter - self.counter_before - 1

    def holds(self, count: BoardCount) -> bool:
        """Whether index and counter have gone on together since it began."""
        return self.index_of(count.counter) + 1 == count.next_index and count.counter >= self.counter_before


@dataclass(frozen=True)
class _Report:
    """The last believed one."""

    index: int
    time_ns: int  # UTC as told to others


class TriggerRun:
    """Owns the board from ``open`` on. ``watch`` and ``end`` belong to the control thread."""

    def __init__(
        self,
        config: TriggerConfig,
        clock: Clock,
        triggers: TriggerLog,
        ledger: Ledger,
        aux: AuxLog,
        gates: Gates,
        on_sample: Callable[[Sample], None] | None = None,
        on_restart: Callable[[TriggerBoard], None] | None = None,
    ) -> None:
        """``on_restart`` is called when the board has been reset and runs again: it has forgotten all it was told.

        Raises:
            TriggerBoardError: the port cannot be opened.
        """
        self.trouble = ""  # why the final count is not confirmed
        self.resets = 0
        self.strays: deque[Pulse] = deque(maxlen=STRAYS_KEPT)  # pulses that are none of this recording's
        self.in_flight = False  # the board was running when we came: for a recorder that was killed
        self.duplicates = 0  # reports that came twice
        self.contradictions = 0  # reports of which one of index, counter and time was wrong
        self.unbelieved = 0  # reports that no two of them agreed on
        self._config = config
        self._clock = clock
        self._triggers = triggers
        self._ledger = ledger
        self._aux = aux
        self._gates = gates
        self._on_restart = on_restart
        self.board = TriggerBoard(config.port, clock, self._on_pulse, on_sample)
        self._foreign = ForeignClock(triggers.period_ns)
        self._epoch: _Epoch | None = None
        self._count, self._begun = 0, False
        self._last: _Report | None = None
        self._fresh_epoch = False  # no pulse of it yet: the time since the last one is no step of a clock
        self._late_ns: deque[int] = deque(maxlen=LATE_KEPT)
        self._seen: OrderedDict[int, None] = OrderedDict()
        self._heard_s = 0.0
        self._retry_s = 0.0
        self._boots = 0

    def open(self) -> str:
        """Talk to the board, which may still be running for a recorder that was killed; its name."""
        self.board.start()
        name = self.board.hello()
        self.in_flight = self.board.status()[0]
        self._stop_and_count()
        self.board.set_rate(self._config.rate_hz)
        self.strays.clear()
        return name

    def begin(self, count: int) -> None:
        """Give pulses from the configured index on, ``count`` of them or without end."""
        self._count, self._begun = count, True
        self._heard_s = self._clock.monotonic_s()
        self._boots = self.board.boots
        self._start(self._config.first_index, self._stop_and_count())

    def watch(self) -> str | None:
        """See that pulses come; bring a board back that was gone or reset. To be called ten times a second.

        Returns:
            None: go on. Else the run is over: why, empty when the board has given all it was asked for.
        """
        now_s = self._clock.monotonic_s()
        if self.board.error is not None:
            return f"{self.board.port}: the board's thread has failed: {self.board.error!r}"
        if self.board.gone:
            self._gates.judge(GATE, self.board.gone)
            self._retry_s = 0.0
            self._heard_s = -float("inf")  # ask as soon as it is back
            return None
        if self.board.boots != self._boots:
            self._heard_s = -float("inf")
        if now_s - self._heard_s <= max(SILENT_S, 10 / self._config.rate_hz) or now_s < self._retry_s:
            return None
        self._retry_s = now_s + RETRY_S
        try:
            return self._ask()
        except TriggerBoardError as error:
            self._gates.judge(GATE, str(error))
            return None

    def end(self) -> BoardCount | None:
        """No pulse after this; None: the board could not confirm its count."""
        try:
            count = self.board.end()
        except TriggerBoardError as error:
            self.trouble = str(error)
            return None
        if not self._begun:
            self._epoch = _Epoch(self._config.first_index, count.counter)
            return BoardCount(self._config.first_index, count.counter)
        if self._goes_on(count):
            return count
        self.trouble = f"{self.board.port}: the board's last count ({count.counter}) is not that of its pulses"
        return None

    def account(self, count: BoardCount | None) -> dict[str, str]:
        """The board's books, for the recording's last Metadata record; ``count`` as ``end`` said."""
        epoch = self._epoch or _Epoch(self._config.first_index, 0)
        next_index = count.next_index if count else self._ledger.next_index
        return {
            "first_index": str(self._config.first_index),
            "next_index": str(next_index),
            "counted_from": str(epoch.first_index),
            "counter_begin": str(epoch.counter_before),
            "counter_end": str(count.counter if count else epoch.counter_before + next_index - epoch.first_index),
            "board_confirmed": str(count is not None).lower(),
            "board_resets": str(self.resets),
            "triggers_reported": str(self._aux.triggers),
            "reports_twice": str(self.duplicates),
            "reports_contradictory": str(self.contradictions),
            "reports_unbelieved": str(self.unbelieved),
            "lines_garbled": str(self.board.garbled_lines),
        }

    def _ask(self) -> str | None:
        running, count = self.board.status()
        if not self._goes_on(count):
            return self._restart()
        self._heard_s = self._clock.monotonic_s()
        self._ledger.triggered(count.next_index)  # also those whose reports were lost
        given = count.next_index - self._config.first_index
        if self._count and given >= self._count:
            return ""
        if not running:
            return f"{self.board.port}: the trigger board has stopped by itself after {given} triggers"
        if self._last is not None and count.next_index > self._last.index + 1:
            self._gates.judge(GATE, f"{self.board.port}: it runs, but its reports do not come")
        return None

    def _goes_on(self, count: BoardCount) -> bool:
        """Whether this is the count of a board that has not been reset since START."""
        after_last = self._last is None or count.next_index > self._last.index
        return self.board.boots == self._boots and self._epoch is not None and self._epoch.holds(count) and after_last

    def _restart(self) -> str | None:
        """The board was reset: go on from the next index. What it gave before is on its way, or has arrived."""
        last = self._last.index if self._last else self._config.first_index - 1
        self._gates.judge(GATE, f"{self.board.port}: it was reset after trigger {last}")
        self._clock.sleep(DRAIN_S)
        index = max(self._ledger.next_index, last + 1)
        if self._count and index - self._config.first_index >= self._count:
            return ""
        self.board.hello()
        counter_before = self._stop_and_count()
        self.board.set_rate(self._config.rate_hz)
        self.resets += 1
        self._boots = self.board.boots
        self._start(index, counter_before)
        self._heard_s = self._clock.monotonic_s()
        if self._on_restart is not None:
            self._on_restart(self.board)
        return None

    def _stop_and_count(self) -> int:
        """The board's counter, with no pulse to come."""
        self._epoch = None
        return self.board.end().counter

    def _start(self, index: int, counter_before: int) -> None:
        self._epoch, self._fresh_epoch = _Epoch(index, counter_before), True
        left = self._count - (index - self._config.first_index) if self._count else 0
        self.board.begin(index, left)

    def _on_pulse(self, pulse: Pulse, trigger: Trigger) -> None:
        """A report, in the board's reading thread."""
        epoch = self._epoch
        if epoch is None:
            self.strays.append(pulse)
            return
        now_s = self._clock.monotonic_s()
        trusted = abs(pulse.actual_ns - trigger.receive_time_ns) < STRANGE_NS
        time_ns, late_ns = pulse.actual_ns, 0
        if not trusted:
            time_ns, late_ns = self._foreign.utc_ns(pulse, trigger.receive_time_ns, round(now_s * 1e9))
        index = self._believed(pulse, epoch, time_ns)
        if index is None:
            self.unbelieved += 1
            return
        if index in self._seen:
            self.duplicates += 1
            return
        self._heard_s = now_s
        self._gates.judge(GATE, None)
        strange = f"its clock is {(pulse.actual_ns - trigger.receive_time_ns) / 1e9:.0f} s off this computer's"
        self._gates.judge("trigger board clock", None if trusted else strange)
        self._see(index)
        if late_ns:
            self._triggers.lower(self._foreign.since_index, late_ns)
        step_ns = self._step_ns(index, time_ns, now_s)
        self._triggers.add(replace(pulse, index=index, actual_ns=time_ns), trusted, step_ns)
        self._ledger.triggered(index + 1)
        self._aux.trigger(replace(trigger, index=index))
        if self._last is None or index > self._last.index:
            self._last, self._fresh_epoch = _Report(index, time_ns), False

    def _believed(self, pulse: Pulse, epoch: _Epoch, time_ns: int) -> int | None:
        """The index that two of the report's own, its counter's and its time's agree on."""
        by_counter = epoch.index_of(pulse.counter)
        if pulse.index == by_counter:
            return pulse.index if pulse.index >= epoch.first_index else None
        if self._last is None or self._fresh_epoch:
            return None
        by_time = self._last.index + round((time_ns - self._last.time_ns) / self._triggers.period_ns)
        if by_time not in (pulse.index, by_counter) or by_time < epoch.first_index:
            return None
        self.contradictions += 1
        return by_time

    def _see(self, index: int) -> None:
        self._seen[index] = None
        if len(self._seen) > _SEEN_KEPT:
            self._seen.popitem(last=False)

    def _step_ns(self, index: int, time_ns: int, now_s: float) -> int:
        """What the board's clock has stepped by since the last report; 0 when something else explains its times.

        A stalled board's pulses come later than their period says, and are reported later too. A clock that steps on
        says they come later, and yet they are reported before that; one that steps back, the opposite. A report is
        late by what line and computer take, often much, but never early: so it is the earliest ones that count. Of the
        first few all may have been late: then a step must be what the report came earlier by.
        """
        late_ns = round(now_s * 1e9) - time_ns  # by a clock that never steps, from any zero
        last, known, floor_ns = self._last, len(self._late_ns), min(self._late_ns, default=late_ns)
        self._late_ns.append(late_ns)
        if last is None or index <= last.index or self._fresh_epoch:
            return 0
        off_ns = time_ns - last.time_ns - (index - last.index) * self._triggers.period_ns
        much_ns = 0.4 * self._triggers.period_ns
        earlier_ns = floor_ns - late_ns
        if off_ns > 0:
            told = known >= LATE_KNOWN or abs(earlier_ns - off_ns) < 0.1 * self._triggers.period_ns
            stepped = off_ns > much_ns and earlier_ns > much_ns and told
        else:
            stepped = off_ns < -much_ns and earlier_ns < -much_ns
        if not stepped:
            return 0
        self._late_ns = deque((*(one_ns - off_ns for one_ns in [*self._late_ns][:-1]), late_ns), LATE_KEPT)
        return off_ns
