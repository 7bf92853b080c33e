"""The aircraft's CAN bus: its state, to frames as ``xhale.dbc`` describes them, on a bus that python-can can hear.

``slcan:PATH`` is a serial CAN adapter (the LAWICEL protocol of CANable and the like) on a pseudo-terminal at PATH;
anything else is ``INTERFACE:CHANNEL`` of python-can, such as ``socketcan:vcan0`` or ``udp_multicast:239.74.163.2``. The
frames are packed here by hand, so that what decodes them is not what encoded them.
"""

import contextlib
import os
import struct
import tty
from importlib.resources import files
from pathlib import Path
from typing import Protocol

import can

from capture.clock import Clock
from capture.errors import SimulationError, UsageError
from hw_sim.aircraft import Aircraft, AircraftState
from hw_sim.senders import Sender

BITRATE = 500_000
_PERIODS_NS = {256: 10_000_000, 257: 40_000_000, 258: 20_000_000}  # by identifier


def dbc_text() -> str:
    """The DBC file that describes the frames."""
    return files("hw_sim").joinpath("xhale.dbc").read_text(encoding="utf-8")


class CanNode(Sender):
    """Sends from a thread of its own, ``can-node``."""

    def __init__(self, aircraft: Aircraft, where: str, clock: Clock) -> None:
        """``where`` as this module's first lines say.

        Raises:
            UsageError: ``where`` is not such a place. SimulationError: the bus cannot be opened.
        """
        interface, colon, channel = where.partition(":")
        if not colon or not channel:
            raise UsageError(f"--can {where}: give INTERFACE:CHANNEL, such as slcan:/tmp/can or socketcan:vcan0")
        super().__init__("can-node")
        self._aircraft = aircraft
        self._clock = clock
        self._counter = 0
        self._bus: _Bus = _SerialAdapter(Path(channel)) if interface == "slcan" else _PythonCan(interface, channel)

    def close(self) -> None:
        """No frame after this returns; the bus is gone."""
        super().close()
        self._bus.close()

    def _work(self) -> None:
        due_ns = dict.fromkeys(_PERIODS_NS, self._clock.utc_ns())
        while not self._stop.wait(max((min(due_ns.values()) - self._clock.utc_ns()) * 1e-9, 0.0)):
            for number in [number for number, due in due_ns.items() if due <= self._clock.utc_ns()]:
                self._bus.send(number, self._content(number, self._aircraft.at(self._clock.utc_ns())))
                self.sent += 1
                due_ns[number] += _PERIODS_NS[number]

    def _content(self, number: int, state: AircraftState) -> bytes:
        if number == 256:
            self._counter = (self._counter + 1) % 256
            angles = (round(float(state.roll_rad) * 1e4), round(float(state.pitch_rad) * 1e4))
            return struct.pack("<hhhBx", round(float(state.load_factor) * 1e3), *angles, self._counter)
        if number == 257:
            return struct.pack("<Hh", round(float(state.airspeed_mps) * 1e2), round(float(state.altitude_m) * 10))
        aileron = round(float(state.aileron_deg) * 1e2)
        return struct.pack("<hhh", round(float(state.elevator_deg) * 1e2), aileron, -aileron)


class _Bus(Protocol):
    def send(self, number: int, data: bytes) -> None: ...

    def close(self) -> None: ...


class _PythonCan:
    def __init__(self, interface: str, channel: str) -> None:
        try:
            self._bus = can.Bus(channel=channel, interface=interface)
        except (can.CanError, OSError, ValueError, TypeError) as error:
            raise SimulationError(
                f"{interface}:{channel}: the CAN bus cannot be opened ({error}): bring it up"
            ) from error

    def send(self, number: int, data: bytes) -> None:
        self._bus.send(can.Message(arbitration_id=number, data=data, is_extended_id=False))

    def close(self) -> None:
        self._bus.shutdown()


class _SerialAdapter:
    """Passes frames on while a host has opened the channel (``O``), as such an adapter does."""

    def __init__(self, port: Path) -> None:
        self._port = port
        self._open = False
        self._own_end, self._host_end = os.openpty()
        tty.setraw(self._host_end)
        os.set_blocking(self._own_end, False)
        try:
            port.parent.mkdir(parents=True, exist_ok=True)
            port.unlink(missing_ok=True)
            port.symlink_to(os.ttyname(self._host_end))
        except OSError as error:
            self._release()
            raise SimulationError(
                f"{port}: the CAN adapter cannot be put there ({error}): give another path"
            ) from error

    def send(self, number: int, data: bytes) -> None:
        with contextlib.suppress(BlockingIOError):
            for command in os.read(self._own_end, 4096).split(b"\r"):
                if command[:1] in (b"O", b"L", b"C"):
                    self._open = command[:1] != b"C"
        if self._open:
            with contextlib.suppress(BlockingIOError):  # nobody reads: as on a wire, it is gone
                os.write(self._own_end, b"t%03X%d%s\r" % (number, len(data), data.hex().upper().encode()))

    def close(self) -> None:
        self._port.unlink(missing_ok=True)
        self._release()

    def _release(self) -> None:
        for end in (self._own_end, self._host_end):
            os.close(end)
