"""A V4L2 device file: format, controls and buffer queue, by linuxpy's structures. What it means is decided elsewhere.

Every method raises OSError as the driver gives it; ENODEV is a device that is gone.
"""

import contextlib
import ctypes
import errno
import mmap
import os
import select
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
from linuxpy.video import device as calls
from linuxpy.video import raw
from numpy.typing import NDArray

_CAPTURE = calls.BufferType.VIDEO_CAPTURE
_NEEDED = raw.Capability.VIDEO_CAPTURE | raw.Capability.STREAMING
_DEVICE_CAPS_VALID = 0x80000000
_MENUS = (calls.ControlType.MENU, calls.ControlType.INTEGER_MENU)
MOST_BUFFERS = 32  # of a queue, in every driver


@dataclass(frozen=True)
class Identity:
    """Who answers."""

    driver: str
    card: str
    bus: str
    serial: str  # of the USB device behind it; else the bus


@dataclass(frozen=True)
class Format:
    """What the driver will deliver."""

    fourcc: str
    width: int
    height: int
    bytes_per_line: int
    image_bytes: int


@dataclass(frozen=True)
class Control:
    """A setting of the driver, by the name it has in tools: lower case, underscores."""

    number: int
    name: str
    lowest: int
    highest: int
    menu: tuple[tuple[int, str], ...]  # value and name of each entry; empty: a number


@dataclass(frozen=True)
class Done:
    """A buffer that the driver is done with."""

    index: int
    used_bytes: int
    sequence: int
    timestamp_ns: int | None  # of CLOCK_MONOTONIC; None: the driver does not say which clock it is
    start_of_exposure: bool  # what the timestamp tells; else the end of the frame
    faulty: bool


class V4l2Device:
    """An open device. One thread at a time."""

    def __init__(self, path: str) -> None:
        self.path = path
        self._fd = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        self._memory = raw.Memory.USERPTR
        self._poll = select.poll()
        self._poll.register(self._fd, select.POLLIN)

    def close(self) -> None:
        """Let go of it; a stream ends."""
        os.close(self._fd)

    def identity(self) -> Identity:
        """Who answers. Raises OSError when it is nothing that streams images."""
        found = calls.read_capabilities(self._fd)
        capabilities = found.device_caps if found.capabilities & _DEVICE_CAPS_VALID else found.capabilities
        if capabilities & _NEEDED != _NEEDED:
            raise OSError(errno.ENOTTY, "not a device that streams images")
        bus = found.bus_info.decode(errors="replace")
        serial = _usb_serial(self.path) or bus
        return Identity(found.driver.decode(errors="replace"), found.card.decode(errors="replace"), bus, serial)

    def choose_input(self, number: int) -> int:
        """Select an input; the one that is selected now."""
        calls.set_input(self._fd, number)
        return int(calls.get_input(self._fd))

    def ask_format(self, width: int, height: int) -> Format:
        """Ask for 8 bit grey; what the driver makes of it."""
        calls.set_format(self._fd, _CAPTURE, width, height, "GREY")
        pixels = calls.get_raw_format(self._fd, _CAPTURE).fmt.pix
        fourcc = int(pixels.pixelformat).to_bytes(4, "little").decode(errors="replace")
        return Format(fourcc, pixels.width, pixels.height, pixels.bytesperline, pixels.sizeimage)

    def ask_rate(self, rate_hz: float) -> float:
        """Ask a device that runs free for a rate; the one that it has now."""
        calls.set_fps(self._fd, _CAPTURE, Fraction(rate_hz).limit_denominator(1000))
        return float(calls.get_fps(self._fd, _CAPTURE))

    def controls(self) -> dict[str, Control]:
        """What can be set."""
        found = {}
        for control in calls.iter_read_controls(self._fd):
            kind = control.type
            if kind == calls.ControlType.CTRL_CLASS or control.flags & raw.ControlFlag.DISABLED:
                continue
            name = _tool_name(control.name.decode(errors="replace"))
            menu = tuple(self._menu(control)) if kind in _MENUS else ()
            found[name] = Control(control.id, name, control.minimum, control.maximum, menu)
        return found

    def set(self, control: Control, value: int) -> int:
        """Set a control; the value that it has now."""
        calls.set_control(self._fd, control.number, value)
        return self.get(control)

    def get(self, control: Control) -> int:
        """A control's value."""
        return int(calls.get_control(self._fd, control.number))

    def make_buffers(self, count: int, ours: bool) -> list[NDArray[np.uint8]]:
        """Make the queue: of the caller's memory (``ours``), or of the driver's, which comes back mapped."""
        self._memory = raw.Memory.USERPTR if ours else raw.Memory.MMAP
        made = calls.request_buffers(self._fd, _CAPTURE, self._memory, min(count, MOST_BUFFERS)).count
        if ours:
            return []
        found = (calls.query_buffer(self._fd, _CAPTURE, self._memory, index) for index in range(made))
        return [
            np.frombuffer(mmap.mmap(self._fd, buffer.length, offset=buffer.m.offset), dtype=np.uint8)
            for buffer in found
        ]

    def free_buffers(self) -> None:
        """End the queue; what was mapped must not be used any more."""
        calls.free_buffers(self._fd, _CAPTURE, self._memory)

    def give(self, index: int, memory: ctypes.Array[ctypes.c_char] | None) -> None:
        """Queue a buffer; ``memory`` is where the driver shall write, None for its own."""
        buffer = raw.v4l2_buffer()
        buffer.type, buffer.memory, buffer.index = _CAPTURE, self._memory, index
        if memory is not None:
            buffer.m.userptr, buffer.length = ctypes.addressof(memory), len(memory)
        calls.ioctl(self._fd, raw.IOC.QBUF, buffer)

    def start(self) -> None:
        """Let the driver fill buffers."""
        calls.stream_on(self._fd, _CAPTURE)

    def stop(self) -> None:
        """The driver writes to no buffer after this."""
        calls.stream_off(self._fd, _CAPTURE)

    def take(self, timeout_s: float) -> Done | None:
        """The next buffer that the driver is done with, or None after ``timeout_s``."""
        if not self._poll.poll(timeout_s * 1000):
            return None
        buffer = raw.v4l2_buffer()
        buffer.type, buffer.memory = _CAPTURE, self._memory
        try:
            calls.ioctl(self._fd, raw.IOC.DQBUF, buffer)
        except BlockingIOError:
            return None
        flags = buffer.flags
        timestamp_ns = None
        if flags & raw.BufferFlag.TIMESTAMP_MASK == raw.BufferFlag.TIMESTAMP_MONOTONIC:
            timestamp_ns = buffer.timestamp.secs * 10**9 + buffer.timestamp.usecs * 1000
        return Done(
            index=buffer.index,
            used_bytes=buffer.bytesused,
            sequence=buffer.sequence,
            timestamp_ns=timestamp_ns,
            start_of_exposure=flags & raw.BufferFlag.TSTAMP_SRC_MASK == raw.BufferFlag.TSTAMP_SRC_SOE,
            faulty=bool(flags & raw.BufferFlag.ERROR),
        )

    def _menu(self, control: raw.v4l2_query_ext_ctrl) -> list[tuple[int, str]]:
        entries = []
        for value in range(control.minimum, control.maximum + 1):
            entry = raw.v4l2_querymenu()
            entry.id, entry.index = control.id, value
            with contextlib.suppress(OSError):  # a menu may have holes
                calls.ioctl(self._fd, raw.IOC.QUERYMENU, entry)
                entries.append((value, entry.name.decode(errors="replace")))
        return entries


def _tool_name(text: str) -> str:
    """``Exposure Time, Absolute`` → ``exposure_time_absolute``, as v4l2-ctl has it."""
    words = "".join(letter.lower() if letter.isalnum() else " " for letter in text).split()
    return "_".join(words)


def _usb_serial(path: str) -> str:
    """The serial number of the USB device that a device file belongs to; empty where there is none."""
    folder = Path("/sys/class/video4linux", Path(path).resolve().name, "device")
    with contextlib.suppress(OSError):
        folder = folder.resolve()
        for above in (folder, *folder.parents[:4]):
            if (above / "idVendor").exists():
                return (above / "serial").read_text().strip()
    return ""
