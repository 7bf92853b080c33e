"""The trigger board on a pseudo-terminal: commands of capture.trigger_protocol in; edges, samples and reports out.

An edge happens at its exact time in the simulated world, ``commanded + a small seeded delay``, whenever this program
gets to it; late is only its report, as on a busy serial line. The board does not mind the host closing and opening
the port; lines that nobody reads are lost, as on a wire.
"""

import os
import queue
import select
import threading
import tty
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from capture.clock import Clock
from capture.errors import SimulationError
from capture.trigger_protocol import (
    MAX_LINE_BYTES,
    PROTOCOL_VERSION,
    GarbledLine,
    Pulse,
    Sample,
    decode_line,
    encode_line,
)

BOARD_NAME = "SimAthena"
BOOT_NS = 150_000_000
START_DELAY_NS = 20_000_000
DELAY_SIGMA_NS = 800.0  # of the output register's write after the due time
_HIGHEST_MILLIHERTZ = 200_000
_IDLE_S = 0.2


@dataclass
class LineFaults:
    """What goes wrong with single pulses, by index. Each happens once: a board that was reset counts anew."""

    unseen: set[int] = field(default_factory=set)  # the edge does not reach the cameras; counted and reported
    lost: set[int] = field(default_factory=set)  # the report does not come
    twice: set[int] = field(default_factory=set)
    garbled: set[int] = field(default_factory=set)
    late_s: dict[int, float] = field(default_factory=dict)  # the report comes so much later, after others
    wrong_counter: dict[int, int] = field(default_factory=dict)  # the report's counter is off by
    wrong_index: dict[int, int] = field(default_factory=dict)
    strange_clock: dict[int, int] = field(default_factory=dict)  # from this pulse on the board's clock is off by, ns


class SimulatedBoard:
    """A board that runs in a thread of its own, ``trigger-board``."""

    def __init__(
        self,
        port: Path,
        rate_hz: float,
        seed: int,
        clock: Clock,
        on_pulse: Callable[[Pulse], None],
        volts_at: Callable[[int], tuple[float, ...]] | None = None,
        faults: LineFaults | None = None,
    ) -> None:
        """Make the pseudo-terminal and put a symbolic link to it at ``port``. ``on_pulse`` is called at each edge.

        ``volts_at`` says what is at the analog inputs at a UTC time in ns; None: a board without inputs.

        Raises:
            SimulationError: the link cannot be made.
        """
        self.port = port
        self.error: BaseException | None = None
        self.lost_lines = 0
        self._clock = clock
        self._on_pulse = on_pulse
        self._volts_at = volts_at
        self._faults = faults or LineFaults()
        self._clock_error_ns = 0
        self._late: list[tuple[int, bytes]] = []  # due, line
        self._orders: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._quiet_until_ns = 0  # it is booting
        self._sample_millihertz = self._sampled = self._sample_first_ns = 0
        self._rng = np.random.default_rng([seed, 0x7B])
        self._millihertz = round(rate_hz * 1000)
        self._running = False
        self._first_ns = self._first_index = self._given = self._count = 0
        self._next_index = self._counter = 0
        self._input = b""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, name="trigger-board", daemon=True)
        self._board_end = self._host_end = -1
        self._plug()

    def start(self) -> None:
        """Begin to listen."""
        self._thread.start()

    def reset(self) -> None:
        """As by its button or a dip of its supply: it forgets everything and boots."""
        self._orders.put(self._reset)

    def unplug(self) -> None:
        """Pull its cable out of the computer; it is powered otherwise, and goes on."""
        self._orders.put(self._unplug)

    def plug(self) -> None:
        """Put the cable back."""
        self._orders.put(self._plug)

    def close(self) -> None:
        """No pulse after this returns; the port is gone."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(5.0)
        self._unplug()

    def _plug(self) -> None:
        # Our own hold on the far end: without it the near end breaks whenever the host closes the port.
        self._board_end, self._host_end = os.openpty()
        tty.setraw(self._host_end)
        os.set_blocking(self._board_end, False)
        port = self.port
        try:
            port.parent.mkdir(parents=True, exist_ok=True)
            if port.is_symlink():
                port.unlink()
            port.symlink_to(os.ttyname(self._host_end))
        except OSError as error:
            self._close_ends()
            raise SimulationError(
                f"{port}: the trigger port cannot be put there ({error}): give another path"
            ) from error

    def _unplug(self) -> None:
        if self._board_end >= 0:
            self.port.unlink(missing_ok=True)
            self._close_ends()

    def _close_ends(self) -> None:
        for end in (self._board_end, self._host_end):
            os.close(end)
        self._board_end = self._host_end = -1

    def _reset(self) -> None:
        self._running = False
        self._next_index = self._counter = 0
        self._sample_millihertz = 0
        self._input = b""
        self._late.clear()
        self._quiet_until_ns = self._clock.utc_ns() + BOOT_NS

    def _work(self) -> None:
        try:
            while not self._stop.is_set():
                wait_s = min([_IDLE_S, *(max((due - self._clock.utc_ns()) * 1e-9, 0.0) for due in self._dues_ns())])
                if select.select([self._board_end] if self._board_end >= 0 else [], [], [], wait_s)[0]:
                    self._read()
                while not self._orders.empty():
                    self._orders.get()()
                if self._quiet_until_ns and self._clock.utc_ns() >= self._quiet_until_ns:
                    self._quiet_until_ns = 0
                    self._send("BOOT", str(PROTOCOL_VERSION), BOARD_NAME)
                while self._late and self._late[0][0] <= self._clock.utc_ns():
                    self._write(self._late.pop(0)[1])
                while self._running and self._clock.utc_ns() >= self._due_ns():
                    self._pulse()
                while self._sample_millihertz and self._clock.utc_ns() >= self._sample_due_ns():
                    self._sample()
        except BaseException as error:
            self.error = error

    def _dues_ns(self) -> list[int]:
        dues = [self._due_ns()] if self._running else []
        dues += [self._quiet_until_ns] if self._quiet_until_ns else []
        dues += [self._late[0][0]] if self._late else []
        return [*dues, self._sample_due_ns()] if self._sample_millihertz else dues

    def _sample_due_ns(self) -> int:
        return self._sample_first_ns + self._sampled * 10**12 // self._sample_millihertz

    def _sample(self) -> None:
        assert self._volts_at is not None
        due_ns = self._sample_due_ns()
        sample = Sample(self._sampled, due_ns, self._volts_at(due_ns))
        self._sampled += 1
        self._send(*sample.words())

    def _due_ns(self) -> int:
        return self._first_ns + self._given * 10**12 // self._millihertz

    def _pulse(self) -> None:
        due_ns = self._due_ns()
        actual_ns = due_ns + int(abs(self._rng.normal(0.0, DELAY_SIGMA_NS)))
        self._counter += 1
        pulse = Pulse(self._next_index, self._counter, due_ns, actual_ns)
        self._next_index += 1
        self._given += 1
        self._running = self._given != self._count
        self._report(pulse)  # first: whoever is told of the pulse may keep this program busy
        if pulse.index in self._faults.unseen:
            self._faults.unseen.remove(pulse.index)
        else:
            self._on_pulse(pulse)

    def _report(self, pulse: Pulse) -> None:
        """Say it, with what goes wrong on the way."""
        faults, index = self._faults, pulse.index
        self._clock_error_ns = faults.strange_clock.pop(index, self._clock_error_ns)
        said = Pulse(
            index + faults.wrong_index.pop(index, 0),
            pulse.counter + faults.wrong_counter.pop(index, 0),
            pulse.commanded_ns + self._clock_error_ns,
            pulse.actual_ns + self._clock_error_ns,
        )
        line = encode_line(*said.words())
        if index in faults.lost:
            faults.lost.remove(index)
        elif index in faults.late_s:
            self._late.append((self._clock.utc_ns() + round(faults.late_s.pop(index) * 1e9), line))
            self._late.sort()
        elif index in faults.garbled:
            faults.garbled.remove(index)
            self._write(line.replace(b" ", b"\x00", 1))
        else:
            self._write(line * (1 + (index in faults.twice)))
            faults.twice.discard(index)

    def _read(self) -> None:
        try:
            self._input += os.read(self._board_end, 4096)
        except BlockingIOError:
            return
        *lines, self._input = self._input.split(b"\n")
        if len(self._input) > MAX_LINE_BYTES:
            self._input = b""
            self._send("ERR", "4", "line", "too", "long")
        for line in () if self._quiet_until_ns else lines:
            try:
                self._send(*self._answer(decode_line(line)))
            except GarbledLine:
                self._send("ERR", "1", "garbled", "line")
            except ValueError:
                self._send("ERR", "2", "bad", "argument")

    def _answer(self, words: tuple[str, ...]) -> tuple[str, ...]:
        match words:
            case ("HELLO",):
                return ("OK", "HELLO", str(PROTOCOL_VERSION), BOARD_NAME)
            case ("RATE", millihertz) if not self._running:
                if not 1 <= int(millihertz) <= _HIGHEST_MILLIHERTZ:
                    raise ValueError(millihertz)
                self._millihertz = int(millihertz)
                return ("OK", "RATE", millihertz)
            case ("START", index, count) if not self._running:
                if int(index) < 0 or int(count) < 0:
                    raise ValueError(index)
                self._next_index, self._count, self._given = int(index), int(count), 0
                self._first_ns = self._clock.utc_ns() + START_DELAY_NS
                self._running = True
                return ("OK", "START", index, count)
            case ("ANALOG", millihertz) if self._volts_at is not None:
                if not 0 <= int(millihertz) <= _HIGHEST_MILLIHERTZ:
                    raise ValueError(millihertz)
                self._sample_millihertz, self._sampled = int(millihertz), 0
                self._sample_first_ns = self._clock.utc_ns()
                return ("OK", "ANALOG", millihertz)
            case ("STOP",):
                self._running = False
                return ("OK", "STOP", str(self._next_index), str(self._counter))
            case ("STATUS",):
                return ("OK", "STATUS", str(int(self._running)), str(self._next_index), str(self._counter))
            case ("RATE" | "START", *_) if self._running:
                return ("ERR", "3", "running")
        return ("ERR", "1", "unknown", "command")

    def _send(self, *words: str) -> None:
        self._write(encode_line(*words))

    def _write(self, line: bytes) -> None:
        try:
            self.lost_lines += os.write(self._board_end, line) != len(line)
        except OSError:  # its buffer is full, or the cable is out
            self.lost_lines += 1
