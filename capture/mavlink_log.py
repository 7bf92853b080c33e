"""An autopilot's MAVLink stream to ``/mavlink``: the numbers of the messages asked for, with the time of receipt.

The recorder listens only: how often the autopilot sends what is the autopilot's configuration.
"""

import importlib
import select
import socket
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import serial

from capture.clock import Clock
from capture.config import MavlinkConfig
from capture.errors import LinkError
from capture.listener import Heard
from capture.record import MAVLINK_TOPIC, Mavlink

DIALECT = "pymavlink.dialects.v20.ardupilotmega"  # has all of `common`; understands MAVLink 1, too
_PACKET_BYTES = 65536
_SAFETY_ARMED = 128  # MAV_MODE_FLAG of a HEARTBEAT's base_mode
_NO_AUTOPILOT = 8  # MAV_AUTOPILOT_INVALID: a ground station, a gimbal, whose base_mode says nothing


class MavlinkLink:
    """An open port with a decoder behind it."""

    def __init__(
        self, config: MavlinkConfig, clock: Clock, on_heartbeat: Callable[[bool, int], None] | None = None
    ) -> None:
        """Open it. ``on_heartbeat`` is told whether an autopilot is armed, and its system's number.

        Raises:
            LinkError: it is not there or pymavlink is not installed.
        """
        self.lost: Counter[str] = Counter()
        self._clock = clock
        self._config = config
        self._on_heartbeat = on_heartbeat
        self._wanted = frozenset(config.messages)
        self._sequence: dict[tuple[int, int], int] = {}
        try:
            dialect: Any = importlib.import_module(DIALECT)
        except ImportError as error:
            raise LinkError(
                "mavlink: pymavlink is not installed: `pip install 'wingshape[mavlink]'`, or remove the table [mavlink]"
            ) from error
        self._decoder: Any = dialect.MAVLink(None)
        self._decoder.robust_parsing = True  # nonsense on the wire is a BAD_DATA message, not an exception
        self._port: _UdpPort | _SerialPort
        try:
            if config.address.startswith("udp:"):
                _, host, port = config.address.split(":")
                self._port = _UdpPort(host, int(port))
            else:
                self._port = _SerialPort(config.address, config.baud)
        except (OSError, OverflowError) as error:  # SerialException is an OSError
            raise LinkError(
                f"mavlink {config.address}: cannot be opened ({error}): check the cable and the table [mavlink]"
            ) from error

    def hear(self, wait_s: float) -> Sequence[Heard]:
        """The messages that have come. Raises ``LinkError`` when the port is gone."""
        try:
            data = self._port.read(wait_s)
        except OSError as error:
            raise LinkError(
                f"mavlink {self._config.address}: is gone ({error}): check its cable; it is tried again"
            ) from error
        now_ns = self._clock.utc_ns()
        heard = []
        for message in (self._decoder.parse_buffer(data) or ()) if data else ():
            if message.get_type() == "BAD_DATA":
                self.lost["garbled"] += 1
                continue
            self._count_gap(message)
            if self._on_heartbeat and message.get_type() == "HEARTBEAT" and message.autopilot != _NO_AUTOPILOT:
                self._on_heartbeat(bool(message.base_mode & _SAFETY_ARMED), message.get_srcSystem())
            if message.get_type() in self._wanted:
                heard.append(Heard(MAVLINK_TOPIC, now_ns, _numbers(message, now_ns).encode()))
        return heard

    def close(self) -> None:
        """Let go of the port."""
        self._port.close()

    def _count_gap(self, message: Any) -> None:
        sender = (message.get_srcSystem(), message.get_srcComponent())
        number = message.get_seq()
        if sender in self._sequence:
            missing = (number - self._sequence[sender] - 1) % 256
            if missing:
                self.lost["missing in the sender's numbering"] += missing
        self._sequence[sender] = number


class _UdpPort:
    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((host, port))
        except OSError:
            self._socket.close()
            raise
        self._socket.setblocking(False)

    def read(self, wait_s: float) -> bytes:
        if not select.select([self._socket], [], [], wait_s)[0]:
            return b""
        return self._socket.recv(_PACKET_BYTES)

    def close(self) -> None:
        self._socket.close()


class _SerialPort:
    def __init__(self, path: str, baud: int) -> None:
        self._serial = serial.Serial(path, baudrate=baud, exclusive=True)

    def read(self, wait_s: float) -> bytes:
        self._serial.timeout = wait_s
        data: bytes = self._serial.read(self._serial.in_waiting or 1)
        return data

    def close(self) -> None:
        self._serial.close()


def _numbers(message: Any, now_ns: int) -> Mavlink:
    """Its numeric fields; texts and arrays are left out."""
    numbers = {
        name: float(getattr(message, name))
        for name in message.get_fieldnames()
        if isinstance(getattr(message, name), (int, float))
    }
    return Mavlink(
        now_ns,
        message.get_srcSystem(),
        message.get_srcComponent(),
        message.get_type(),
        tuple(numbers),
        tuple(numbers.values()),
    )
