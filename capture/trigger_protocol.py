r"""The trigger board's serial line protocol, version 1: lines to values and back. No I/O.

Each line is ``$<body>*<crc>\r\n``: ASCII, at most 120 bytes, crc = CRC-16/XMODEM of the body as four hex digits.
The body is words separated by one space.

Host to board              board answers
``HELLO``                  ``OK HELLO <protocol version> <board name>``
``RATE <millihertz>``      ``OK RATE <millihertz>``
``START <index> <count>``  ``OK START <index> <count>``: pulses follow, the first one has this index; the board
                           stops by itself after ``count`` pulses (0: runs until STOP)
``STOP``                   ``OK STOP <next index> <counter>``: no pulse after this line
``STATUS``                 ``OK STATUS <running 0|1> <next index> <counter>``
``ANALOG <millihertz>``    ``OK ANALOG <millihertz>``: from now on samples all analog inputs at this rate, 0: not.
                           A board without inputs does not know this command

Anything else is answered by ``ERR <code> <words>``. A running board reports each pulse, once, after its edge:
``PULSE <index> <counter> <commanded_ns> <actual_ns>``. ``index`` counts from START's argument; ``counter`` counts
all edges since power-up and is never set back; both times are UTC nanoseconds of the board's PTP clock: when
the edge was due and when the output register was written.

A board that has been powered up or reset says so once, by itself: ``BOOT <protocol version> <board name>``. It does
not run, and its counter begins at 0.

A board that samples its inputs, be it running or not, reports each sample, once:
``SAMPLE <number> <time_ns> <volts of channel 0> <of channel 1> …``, at most 8 channels, volts with at most 4 decimals.
``number`` counts from 0 at each ``ANALOG``; the time is that of the PTP clock.
"""

import binascii
import math
from dataclasses import dataclass

PROTOCOL_VERSION = 1
MAX_LINE_BYTES = 120
MAX_CHANNELS = 8


class GarbledLine(ValueError):
    """A line whose frame or checksum is wrong. Count it; never act on it."""


@dataclass(frozen=True)
class Pulse:
    """One trigger edge as the board reports it."""

    index: int
    counter: int
    commanded_ns: int
    actual_ns: int

    def words(self) -> tuple[str, ...]:
        """The body's words, for the board's side."""
        return ("PULSE", str(self.index), str(self.counter), str(self.commanded_ns), str(self.actual_ns))


@dataclass(frozen=True)
class Sample:
    """All analog inputs at one instant, as the board reports them."""

    number: int
    time_ns: int
    volts: tuple[float, ...]

    def words(self) -> tuple[str, ...]:
        """The body's words, for the board's side."""
        return ("SAMPLE", str(self.number), str(self.time_ns), *(f"{value:.4f}" for value in self.volts))


def encode_line(*words: str) -> bytes:
    """The line whose body is ``words``."""
    body = " ".join(words).encode("ascii")
    return b"$%s*%04X\r\n" % (body, binascii.crc_hqx(body, 0))


def decode_line(line: bytes) -> tuple[str, ...]:
    """The words of a line.

    Raises:
        GarbledLine: too long, not framed, not ASCII, or the checksum differs.
    """
    text = line.strip(b"\r\n")
    if len(line) > MAX_LINE_BYTES or not text.startswith(b"$") or text[-5:-4] != b"*":
        raise GarbledLine(f"not a protocol line: {line[:40]!r}")
    body, crc = text[1:-5], text[-4:]
    if b"%04X" % binascii.crc_hqx(body, 0) != crc.upper():
        raise GarbledLine(f"checksum differs: {line[:40]!r}")
    try:
        return tuple(body.decode("ascii").split(" "))
    except UnicodeDecodeError as error:
        raise GarbledLine(f"not ASCII: {line[:40]!r}") from error


def parse_pulse(words: tuple[str, ...]) -> Pulse:
    """The pulse of a ``PULSE`` line's words.

    Raises:
        GarbledLine: the words do not make a pulse.
    """
    try:
        name, index, counter, commanded_ns, actual_ns = words
        if name != "PULSE":
            raise ValueError(name)
        return Pulse(int(index), int(counter), int(commanded_ns), int(actual_ns))
    except ValueError as error:
        raise GarbledLine(f"not a pulse: {' '.join(words)[:40]!r}") from error


def parse_sample(words: tuple[str, ...]) -> Sample:
    """The sample of a ``SAMPLE`` line's words.

    Raises:
        GarbledLine: the words do not make a sample.
    """
    try:
        name, number, time_ns, *volts = words
        sample = Sample(int(number), int(time_ns), tuple(float(value) for value in volts))
        if name != "SAMPLE" or not 1 <= len(volts) <= MAX_CHANNELS or not all(map(math.isfinite, sample.volts)):
            raise ValueError(name)
    except ValueError as error:
        raise GarbledLine(f"not a sample: {' '.join(words)[:40]!r}") from error
    return sample
