"""The board on its pseudo-terminal, spoken to with pyserial as the recorder does."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import serial

from capture.clock import SystemClock
from capture.errors import SimulationError
from capture.trigger_protocol import Pulse, decode_line, encode_line, parse_pulse, parse_sample
from hw_sim.trigger_board import SimulatedBoard


class Host:
    """The other end of the line."""

    def __init__(self, port: Path) -> None:
        self.serial = serial.Serial(str(port), timeout=2.0)
        self.pulses: list[Pulse] = []

    def read(self) -> tuple[str, ...]:
        words = decode_line(self.serial.readline())
        if words[0] == "PULSE":
            self.pulses.append(parse_pulse(words))
        return words

    def ask(self, *words: str) -> tuple[str, ...]:
        self.serial.write(encode_line(*words))
        while (reply := self.read())[0] == "PULSE":
            pass
        return reply


@pytest.fixture
def edges() -> list[Pulse]:
    return []


@pytest.fixture
def board(tmp_path: Path, edges: list[Pulse]) -> Iterator[SimulatedBoard]:
    made = SimulatedBoard(tmp_path / "trigger", 25.0, 7, SystemClock(), edges.append)
    made.start()
    yield made
    made.close()
    assert made.error is None


@pytest.fixture
def host(board: SimulatedBoard) -> Iterator[Host]:
    made = Host(board.port)
    yield made
    made.serial.close()


def test_hello_rate_status(host: Host) -> None:
    assert host.ask("HELLO") == ("OK", "HELLO", "1", "SimAthena")
    assert host.ask("RATE", "50000") == ("OK", "RATE", "50000")
    assert host.ask("STATUS") == ("OK", "STATUS", "0", "0", "0")


def test_pulses_are_reported_once_each_and_at_their_absolute_times(host: Host, edges: list[Pulse]) -> None:
    assert host.ask("RATE", "90000") == ("OK", "RATE", "90000")
    assert host.ask("START", "40", "20") == ("OK", "START", "40", "20")
    while len(host.pulses) < 20:
        host.read()
    assert host.ask("STATUS") == ("OK", "STATUS", "0", "60", "20")  # it stopped by itself
    assert [pulse.index for pulse in host.pulses] == list(range(40, 60))
    assert [pulse.counter for pulse in host.pulses] == list(range(1, 21))
    assert host.pulses == edges
    due = np.array([pulse.commanded_ns for pulse in host.pulses])
    assert np.array_equal(due - due[0], np.arange(20) * 10**12 // 90_000)  # no rounding adds up
    late = np.array([pulse.actual_ns - pulse.commanded_ns for pulse in host.pulses])
    assert (late >= 0).all()
    assert late.max() < 5000


def test_stop_is_the_last_word_and_the_counter_is_never_set_back(host: Host, edges: list[Pulse]) -> None:
    host.ask("RATE", "100000")
    host.ask("START", "0", "0")
    while len(host.pulses) < 3:
        host.read()
    ok, stop, next_index, counter = host.ask("STOP")
    assert (ok, stop) == ("OK", "STOP")
    assert int(next_index) == int(counter) == len(host.pulses) == len(edges)
    host.serial.timeout = 0.1
    assert host.serial.readline() == b""
    host.serial.timeout = 2.0
    host.ask("START", "500", "1")
    while host.pulses[-1].index != 500:
        host.read()
    assert host.pulses[-1].counter == int(counter) + 1


def test_what_it_cannot_do_is_refused(host: Host) -> None:
    assert host.ask("FROB")[:2] == ("ERR", "1")
    assert host.ask("RATE", "0")[:2] == ("ERR", "2")
    assert host.ask("RATE", "fast")[:2] == ("ERR", "2")
    assert host.ask("START", "-1", "0")[:2] == ("ERR", "2")
    host.serial.write(b"$HELLO*0000\r\n")
    assert host.read()[:2] == ("ERR", "1")
    host.serial.write(b"x" * 300)
    assert host.read()[:2] == ("ERR", "4")
    host.ask("START", "0", "0")
    assert host.ask("START", "0", "0")[:2] == ("ERR", "3")
    assert host.ask("STOP")[0] == "OK"


def test_the_port_can_be_closed_and_opened_again(board: SimulatedBoard, edges: list[Pulse]) -> None:
    first = Host(board.port)
    first.ask("RATE", "100000")
    first.ask("START", "0", "40")
    first.serial.close()
    second = Host(board.port)
    while len(edges) < 40:
        second.read()
    assert second.ask("STATUS") == ("OK", "STATUS", "0", "40", "40")
    second.serial.close()


def test_an_unread_line_never_blocks_the_board(tmp_path: Path, edges: list[Pulse]) -> None:
    board = SimulatedBoard(tmp_path / "deep" / "trigger", 200.0, 7, SystemClock(), edges.append)
    for _ in range(50_000):  # over a megabyte; the terminal holds a few kilobytes
        board._send("PULSE", "1", "1", "1", "1")
    assert board.lost_lines > 0
    assert board.port.is_symlink()
    board.close()
    assert not board.port.is_symlink()


def test_a_port_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "trigger").write_text("someone else's file")
    with pytest.raises(SimulationError, match="trigger"):
        SimulatedBoard(tmp_path / "trigger", 25.0, 7, SystemClock(), lambda _: None)


def test_analog_samples_until_told_to_stop(tmp_path: Path) -> None:
    volts = [1.5, -2.25]
    made = SimulatedBoard(tmp_path / "analog", 25.0, 7, SystemClock(), lambda _: None, lambda _: tuple(volts))
    made.start()
    line = Host(made.port)
    try:
        assert line.ask("ANALOG", "200000") == ("OK", "ANALOG", "200000")
        samples = [parse_sample(line.read()) for _ in range(20)]
        assert [sample.number for sample in samples] == list(range(20))
        assert {sample.volts for sample in samples} == {(1.5, -2.25)}
        assert np.ptp(np.diff([sample.time_ns for sample in samples])) == 0
        line.serial.write(encode_line("ANALOG", "0"))
        while line.read()[0] == "SAMPLE":
            pass
        line.serial.timeout = 0.1
        assert line.serial.readline() == b""
        assert line.ask("ANALOG", "999999999") == ("ERR", "2", "bad", "argument")
    finally:
        line.serial.close()
        made.close()


def test_a_board_without_inputs_does_not_know_the_command(host: Host) -> None:
    assert host.ask("ANALOG", "1000") == ("ERR", "1", "unknown", "command")
