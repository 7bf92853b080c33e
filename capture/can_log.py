"""A CAN bus to ``/can``: every frame that python-can hears, as can_msgs/msg/Frame with its time.

The recorder listens only. Time is that of the frame's receipt by the kernel where the interface gives it in UTC
(socketcan does), else of its receipt here.
"""

import socket
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import can

from capture.clock import Clock
from capture.config import CanConfig
from capture.errors import LinkError
from capture.listener import Heard
from capture.record import CAN_TOPIC, CanFrame

BELIEVED_NS = 1_000_000_000  # a timestamp further than this from now is a device's own clock, not UTC
CLASSIC_BYTES = 8
RECEIVE_BUFFER_BYTES = 4 << 20  # asked of the kernel; it gives up to net.core.rmem_max
NETWORK_STATISTICS = Path("/sys/class/net")


class CanLink:
    """An open bus."""

    def __init__(self, config: CanConfig, clock: Clock, statistics: Path = NETWORK_STATISTICS) -> None:
        """Open it. Raises ``LinkError`` when it is not there or python-can does not know it."""
        self.lost: Counter[str] = Counter()
        self._config = config
        self._clock = clock
        self._where = f"CAN bus {config.name} ({config.interface} {config.channel})"
        try:
            self._bus = can.Bus(channel=config.channel, interface=config.interface, **config.options)
        except (can.CanError, OSError, ValueError, TypeError, ImportError) as error:
            raise LinkError(
                f"{self._where}: cannot be opened ({error}): bring it up, or correct the table [[can]]"
            ) from error
        self._overflow = None
        if config.interface == "socketcan":
            self._bus.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
            if "can_filters" not in config.options:
                self._overflow = _SocketOverflow(statistics / str(config.channel) / "statistics/rx_packets")

    def hear(self, wait_s: float) -> Sequence[Heard]:
        """The next frame, if one comes. Raises ``LinkError`` when the bus is gone."""
        try:
            message = self._bus.recv(wait_s)
        except ValueError:  # a serial adapter's line that is no frame
            self.lost["garbled"] += 1
            return ()
        except (can.CanError, OSError) as error:
            raise LinkError(f"{self._where}: is gone ({error}): check its cable; it is tried again") from error
        if message is None:
            self._count_overflow()
            return ()
        if self._overflow is not None and not message.is_error_frame:
            self._overflow.read += 1
        if len(message.data) > CLASSIC_BYTES:
            self.lost["longer than 8 bytes (CAN FD)"] += 1
            return ()
        frame = CanFrame(
            self._time_ns(message.timestamp),
            self._config.name,
            message.arbitration_id,
            message.is_remote_frame,
            message.is_extended_id,
            message.is_error_frame,
            bytes(message.data),
        )
        return (Heard(CAN_TOPIC, frame.stamp_ns, frame.encode()),)

    def close(self) -> None:
        """Let go of the bus."""
        self._count_overflow()
        self._bus.shutdown()

    def _time_ns(self, timestamp_s: float) -> int:
        now_ns = self._clock.utc_ns()
        stamp_ns = round(timestamp_s * 1e9)
        return stamp_ns if abs(now_ns - stamp_ns) < BELIEVED_NS else now_ns

    def _count_overflow(self) -> None:
        if self._overflow is not None:
            missed = self._overflow.missed()
            if missed:
                self.lost["socket full"] = missed


class _SocketOverflow:
    """Frames that the interface received and our socket had no room for: the interface's own count less what was read.

    At least so many: what other programs of this computer send is heard, but not counted by every driver.
    """

    def __init__(self, counter: Path) -> None:
        self.read = 0
        self._counter = counter
        self._begin = self._received()
        self._last: int | None = None

    def missed(self) -> int:
        """To be asked when nothing is left to be read. A frame just coming in is not missed: two counts must agree."""
        received = self._received()
        if received is None or self._begin is None:
            return 0
        now = max(received - self._begin - self.read, 0)
        missed = now if self._last is None else min(now, self._last)
        self._last = now
        return missed

    def _received(self) -> int | None:
        try:
            return int(self._counter.read_text())
        except (OSError, ValueError):
            return None
