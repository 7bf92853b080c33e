"""What the daemon says to the system's journal: structured entries of bounded rate, by the native protocol.

Each entry has MESSAGE, PRIORITY and, where it is about one thing, WINGSHAPE_ABOUT (a camera, a disk, the clock) and
WINGSHAPE_FLIGHT: ``journalctl -u wingcap WINGSHAPE_ABOUT=left/cam0``. Format: systemd.io/JOURNAL_NATIVE_PROTOCOL.
"""

import socket
import struct
from collections.abc import Callable, Sequence
from enum import IntEnum
from pathlib import Path

from capture.record import Diagnostic

SOCKET = Path("/run/systemd/journal/socket")
PROGRESS_PERIOD_S = 60.0
"""The running totals go to the journal so often; ``systemctl status`` shows them each second."""
REPEAT_PERIOD_S = 30.0
"""A thing that changes its mind all the time is heard so often; what it said meanwhile is counted."""


class Priority(IntEnum):
    """syslog(3)'s."""

    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6


_OF_LEVEL = {0: Priority.NOTICE, 1: Priority.WARNING, 2: Priority.ERROR, 3: Priority.WARNING}


class Journal:
    """Entries to journald. Never blocks: what it does not take at once is dropped and counted."""

    def __init__(self, path: Path = SOCKET) -> None:
        self.dropped = 0
        self.fields: dict[str, str] = {}  # that every entry carries
        self._path = path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._socket.setblocking(False)

    def __call__(self, text: str) -> None:
        """An entry that is about nothing in particular."""
        self.write(Priority.INFO, text)

    def write(self, priority: Priority, text: str, about: str = "") -> None:
        """An entry."""
        fields = {
            "MESSAGE": text,
            "PRIORITY": str(int(priority)),
            "SYSLOG_IDENTIFIER": "wingcap",
            **({"WINGSHAPE_ABOUT": about} if about else {}),
            **self.fields,
        }
        try:
            self._socket.sendto(b"".join(_field(name, value) for name, value in fields.items()), str(self._path))
        except OSError:
            self.dropped += 1

    def close(self) -> None:
        """Let go of the socket."""
        self._socket.close()


class Changes:
    """Statuses, seen each second, to what is worth an entry: a status that got better or worse, or says something else.

    What was in order from the beginning is not worth one.
    """

    def __init__(self, monotonic_s: Callable[[], float]) -> None:
        self._monotonic_s = monotonic_s
        self._said: dict[str, tuple[int, str]] = {}
        self._at_s: dict[str, float] = {}
        self._unsaid: dict[str, int] = {}

    def of(self, statuses: Sequence[Diagnostic]) -> list[tuple[Priority, str, str]]:
        """Priority, name and text of each entry now due."""
        now_s = self._monotonic_s()
        due = []
        for status in statuses:
            name, now = status.name, (status.level, status.message)
            before = self._said.get(name, (0, status.message))
            if now == before:
                continue
            if status.level <= before[0] and now_s - self._at_s.get(name, -REPEAT_PERIOD_S) < REPEAT_PERIOD_S:
                self._unsaid[name] = self._unsaid.get(name, 0) + 1
                continue  # what gets worse is said at once
            self._said[name], self._at_s[name] = now, now_s
            unsaid = self._unsaid.pop(name, 0)
            suffix = f" ({unsaid} changes before this were not told)" if unsaid else ""
            due.append((_OF_LEVEL[status.level], name, f"{name}: {status.message}{suffix}"))
        for name in self._said.keys() - {status.name for status in statuses}:  # what is only named while it is wrong
            if self._said.pop(name)[0]:
                due.append((Priority.NOTICE, name, f"{name}: in order again"))
        return due


def _field(name: str, value: str) -> bytes:
    data = value.encode()
    if b"\n" in data:
        return name.encode() + b"\n" + struct.pack("<Q", len(data)) + data + b"\n"
    return name.encode() + b"=" + data + b"\n"
