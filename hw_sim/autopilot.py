"""The aircraft's autopilot: its state, to MAVLink 2 messages by UDP (ATTITUDE and VFR_HUD, and a HEARTBEAT).

Packed here by hand (https://mavlink.io/en/guide/serialization.html), so that what decodes is not what encoded.
"""

import contextlib
import socket
import struct

import numpy as np

from capture.clock import Clock
from capture.errors import UsageError
from hw_sim.aircraft import Aircraft
from hw_sim.senders import Sender

RATE_HZ = 20.0
_SYSTEM, _COMPONENT = 1, 1
_HEARTBEAT, _ATTITUDE, _VFR_HUD = (0, 50), (30, 39), (74, 20)  # identifier and CRC_EXTRA of each definition

_ARMED = 128  # MAV_MODE_FLAG_SAFETY_ARMED


class Autopilot(Sender):
    """Sends from a thread of its own, ``autopilot``."""

    def __init__(self, aircraft: Aircraft, where: str, clock: Clock, armed_s: tuple[float, float] = (0.0, 0.0)) -> None:
        """``where`` is ``HOST:PORT``; armed from … to … seconds after it was made, or while ``armed`` is set.

        Raises:
            UsageError: ``where`` is none.
        """
        host, _, port = where.rpartition(":")
        if not host or not port.isdigit():
            raise UsageError(f"--mavlink {where}: give HOST:PORT, such as 127.0.0.1:14550")
        super().__init__("autopilot")
        self.armed = False
        self._to = (host, int(port))
        self._aircraft = aircraft
        self._clock = clock
        self._armed_s = armed_s
        self._number = 0
        self._booted_ns = clock.utc_ns()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def close(self) -> None:
        """No message after this returns."""
        super().close()
        self._socket.close()

    def messages(self, time_ns: int) -> tuple[bytes, bytes]:
        """ATTITUDE and VFR_HUD at a UTC time, numbered on from the last message."""
        state = self._aircraft.at(np.array([time_ns - 1_000_000, time_ns]))
        roll, pitch, altitude = (
            (values[1], (values[1] - values[0]) * 1e3) for values in (state.roll_rad, state.pitch_rad, state.altitude_m)
        )
        boot_ms = (time_ns - self._booted_ns) // 1_000_000 % 2**32
        attitude = struct.pack("<I6f", boot_ms, roll[0], pitch[0], 0.0, roll[1], pitch[1], 0.0)
        speed = state.airspeed_mps[1]
        hud = struct.pack("<4fhH", speed, speed, *altitude, 0, 50)
        return self._packet(_ATTITUDE, attitude), self._packet(_VFR_HUD, hud)

    def heartbeat(self, time_ns: int) -> bytes:
        """HEARTBEAT at a UTC time: a fixed-wing aircraft flown by ArduPilot, armed or not."""
        from_s, to_s = self._armed_s
        armed = self.armed or from_s <= (time_ns - self._booted_ns) * 1e-9 < to_s
        return self._packet(_HEARTBEAT, struct.pack("<I5B", 0, 1, 3, _ARMED if armed else 0, 4, 3))

    def _work(self) -> None:
        number = 0
        while not self._stop.wait(1.0 / RATE_HZ):
            for packet in self.messages(self._clock.utc_ns()):
                self._send(packet)
            if number % round(RATE_HZ) == 0:
                self._send(self.heartbeat(self._clock.utc_ns()))
            number += 1

    def _send(self, packet: bytes) -> None:
        with contextlib.suppress(OSError):  # nobody listens
            self._socket.sendto(packet, self._to)
        self.sent += 1

    def _packet(self, kind: tuple[int, int], payload: bytes) -> bytes:
        identifier, extra = kind
        payload = payload.rstrip(b"\x00") or b"\x00"  # MAVLink 2 leaves trailing zeros out
        head = struct.pack("<BBBBBB", len(payload), 0, 0, self._number, _SYSTEM, _COMPONENT)
        self._number = (self._number + 1) % 256
        body = head + identifier.to_bytes(3, "little") + payload
        return b"\xfd" + body + struct.pack("<H", _crc(body + bytes([extra])))


def _crc(data: bytes) -> int:
    """CRC-16/MCRF4XX, which MAVLink calls X.25."""
    crc = 0xFFFF
    for byte in data:
        byte ^= crc & 0xFF
        byte = (byte ^ (byte << 4)) & 0xFF
        crc = (crc >> 8) ^ (byte << 8) ^ (byte << 3) ^ (byte >> 4)
    return crc
