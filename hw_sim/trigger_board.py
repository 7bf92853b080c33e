"""The trigger board on a pseudo-terminal: commands of capture.trigger_protocol in; edges, samples and reports out.

An edge happens at its exact time in the simulated world, ``commanded + a small seeded delay``, whenever this program
gets to it; late is only its report, as on a busy serial line. The board does not mind the host closing and opening
the port; lines that nobody reads are lost, as on a wire.
"""

import os
import select
import threading
import tty
from collections.abc import Callable
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
START_DELAY_NS = 20_000_000
DELAY_SIGMA_NS = 800.0  # of the output register's write after the due time
_HIGHEST_MILLIHERTZ = 200_000
_IDLE_S = 0.2


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
        self._sample_millihertz = self._sampled = self._sample_first_ns = 0
        self._rng = np.random.default_rng([seed, 0x7B])
        self._millihertz = round(rate_hz * 1000)
        self._running = False
        self._first_ns = self._first_index = self._given = self._count = 0
        self._next_index = self._counter = 0
        self._input = b""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, name="trigger-board", daemon=True)
        # Our own hold on the far end: without it the near end breaks whenever the host closes the port.
        self._board_end, self._host_end = os.openpty()
        tty.setraw(self._host_end)
        os.set_blocking(self._board_end, False)
        try:
            port.parent.mkdir(parents=True, exist_ok=True)
            if port.is_symlink():
                port.unlink()
            port.symlink_to(os.ttyname(self._host_end))
        except OSError as error:
            self._close()
            raise SimulationError(
                f"{port}: the trigger port cannot be put there ({error}): give another path"
            ) from error

    def start(self) -> None:
        """Begin to listen."""
        self._thread.start()

    def close(self) -> None:
        """No pulse after this returns; the port is gone."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(5.0)
        self.port.unlink(missing_ok=True)
        self._close()

    def _close(self) -> None:
        for end in (self._board_end, self._host_end):
            os.close(end)

    def _work(self) -> None:
        try:
            while not self._stop.is_set():
                wait_s = min([_IDLE_S, *(max((due - self._clock.utc_ns()) * 1e-9, 0.0) for due in self._dues_ns())])
                if select.select([self._board_end], [], [], wait_s)[0]:
                    self._read()
                while self._running and self._clock.utc_ns() >= self._due_ns():
                    self._pulse()
                while self._sample_millihertz and self._clock.utc_ns() >= self._sample_due_ns():
                    self._sample()
        except BaseException as error:
            self.error = error

    def _dues_ns(self) -> list[int]:
        dues = [self._due_ns()] if self._running else []
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
        self._send(*pulse.words())  # first: whoever is told of the pulse may keep this program busy
        self._on_pulse(pulse)

    def _read(self) -> None:
        try:
            self._input += os.read(self._board_end, 4096)
        except BlockingIOError:
            return
        *lines, self._input = self._input.split(b"\n")
        if len(self._input) > MAX_LINE_BYTES:
            self._input = b""
            self._send("ERR", "4", "line", "too", "long")
        for line in lines:
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
        line = encode_line(*words)
        try:
            self.lost_lines += os.write(self._board_end, line) != len(line)
        except BlockingIOError:
            self.lost_lines += 1
