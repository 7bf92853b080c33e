"""A line of a Linux GPIO chip to a start signal, by the kernel's character device (uAPI version 2, linux/gpio.h).

Structures: https://docs.kernel.org/userspace-api/gpio/chardev.html. They are the same on every architecture.
"""

import fcntl
import os
import select
import struct
from collections import Counter
from collections.abc import Sequence

from capture.config import GpioConfig
from capture.errors import LinkError
from capture.listener import Heard
from capture.start_signal import StartSignal

REQUEST = struct.Struct("=64I32s Q I20x 240s I I20x i")
"""gpio_v2_line_request: offsets, consumer; of its configuration the flags, the number of attributes and the
attributes; the number of lines, the size of the event buffer, and the descriptor that the kernel gives."""
ATTRIBUTE = struct.Struct("=I4x I4x Q")  # gpio_v2_line_config_attribute: id, debounce_period_us, mask of lines
EVENT = struct.Struct("=Q I I I I 24x")  # gpio_v2_line_event: time, id, offset, two sequence numbers
VALUES = struct.Struct("=Q Q")  # gpio_v2_line_values: bits, mask


def _read_write(number: int, size: int) -> int:
    """_IOWR(0xB4, number, size), as asm-generic/ioctl.h has it."""
    return 3 << 30 | size << 16 | 0xB4 << 8 | number


GET_LINE = _read_write(0x07, REQUEST.size)
GET_VALUES = _read_write(0x0E, VALUES.size)
ACTIVE_LOW, INPUT, BOTH_EDGES = 1 << 1, 1 << 2, 1 << 4 | 1 << 5
DEBOUNCE = 3  # id of the attribute
RISING = 1  # id of the event: to active, whatever level that is
_EVENTS = 16


def line_request(config: GpioConfig) -> bytes:
    """What the kernel is asked for: the line as an input with both edges, debounced."""
    flags = INPUT | BOTH_EDGES | (ACTIVE_LOW if config.active == "low" else 0)
    debounce_us = round(config.debounce_ms * 1e3)
    attributes = ATTRIBUTE.pack(DEBOUNCE, debounce_us, 1) if debounce_us else b""
    offsets = (config.line, *[0] * 63)
    return REQUEST.pack(*offsets, b"wingcap", flags, int(debounce_us > 0), attributes, 1, _EVENTS, 0)


class GpioLine:
    """A requested line; a link for capture.listener."""

    def __init__(self, config: GpioConfig, signal: StartSignal) -> None:
        """Request it, and tell its level. Raises ``LinkError`` when chip or line cannot be had."""
        self.lost: Counter[str] = Counter()
        self._signal = signal
        self._where = f"gpio {config.chip} line {config.line}"
        request = bytearray(line_request(config))
        try:
            chip = os.open(config.chip, os.O_RDWR | os.O_CLOEXEC)
            try:
                fcntl.ioctl(chip, GET_LINE, request)
            finally:
                os.close(chip)
        except OSError as error:
            raise LinkError(
                f"{self._where}: cannot be watched ({error.strerror}): check the table [start.gpio], that nothing else "
                "uses the line, that its chip can report edges, and that this user may open the chip"
            ) from error
        self._descriptor: int = REQUEST.unpack(request)[-1]
        try:
            self._tell_level()
        except LinkError:
            self.close()
            raise

    def hear(self, wait_s: float) -> Sequence[Heard]:
        """Tell the edges that have come; nothing is logged. Raises ``LinkError`` when the chip is gone."""
        poll = select.poll()
        poll.register(self._descriptor, select.POLLIN)
        for _, what in poll.poll(wait_s * 1e3):
            if not what & select.POLLIN:
                raise self._gone("hung up")
            try:
                events = os.read(self._descriptor, _EVENTS * EVENT.size)
            except OSError as error:
                raise self._gone(error.strerror) from error
            for _, event, *_ in EVENT.iter_unpack(events):
                self._signal.tell(event == RISING)
        return ()

    def close(self) -> None:
        """Let go of the line."""
        os.close(self._descriptor)

    def _tell_level(self) -> None:
        values = bytearray(VALUES.pack(0, 1))
        try:
            fcntl.ioctl(self._descriptor, GET_VALUES, values)
        except OSError as error:
            raise self._gone(error.strerror) from error
        self._signal.tell(bool(VALUES.unpack(values)[0] & 1))

    def _gone(self, why: str | None) -> LinkError:
        return LinkError(f"{self._where}: is gone ({why}): check its chip; it is tried again")
