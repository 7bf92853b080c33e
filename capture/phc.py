"""A network card's PTP hardware clock to its offset from the system clock: how well phc2sys does its work."""

import fcntl
import os
import struct
from pathlib import Path

SAMPLES = 5
_MAX_SAMPLES = 25  # linux/ptp_clock.h
_TIME = struct.Struct("=qII")  # struct ptp_clock_time
_REQUEST = struct.Struct("=I3I")
_SIZE = _REQUEST.size + (2 * _MAX_SAMPLES + 1) * _TIME.size
PTP_SYS_OFFSET = (1 << 30) | (_SIZE << 16) | (ord("=") << 8) | 5  # _IOW('=', 5, struct ptp_sys_offset)


def read_phc_offset_ns(device: Path) -> int | None:
    """Hardware clock minus system clock in nanoseconds, each on its own time scale; None: it cannot be read."""
    request = bytearray(_REQUEST.pack(SAMPLES, 0, 0, 0) + bytes(_SIZE - _REQUEST.size))
    try:
        descriptor = os.open(device, os.O_RDONLY | os.O_CLOEXEC)
        try:
            fcntl.ioctl(descriptor, PTP_SYS_OFFSET, request, True)
        finally:
            os.close(descriptor)
    except OSError:
        return None
    return offset_of(request)


def offset_of(answer: bytes | bytearray) -> int:
    """The offset in a ``struct ptp_sys_offset``: of the hardware reading with the least time around it."""
    times = [_TIME.unpack_from(answer, _REQUEST.size + k * _TIME.size) for k in range(2 * SAMPLES + 1)]
    ns: list[int] = [seconds * 10**9 + nanoseconds for seconds, nanoseconds, _ in times]
    around = [(ns[k + 2] - ns[k], ns[k + 1] - (ns[k] + ns[k + 2]) // 2) for k in range(0, 2 * SAMPLES, 2)]
    _, offset_ns = min(around)
    return offset_ns
