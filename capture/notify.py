"""What the daemon tells its service manager: sd_notify(3) datagrams, without a library; and whether one listens."""

import contextlib
import os
import socket
from collections.abc import Mapping


class Notifier:
    """Tells systemd how the service is. Does nothing where there is no systemd; never blocks, never raises."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._address = _address(environment.get("NOTIFY_SOCKET", ""))
        self._socket: socket.socket | None = None
        if self._address:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.setblocking(False)

    @property
    def listening(self) -> bool:
        """Whether somebody wants to know."""
        return self._socket is not None

    def ready(self, watchdog_s: float) -> None:
        """The service does its job from now on; a silence longer than ``watchdog_s`` means that it does not."""
        self._send(f"READY=1\nWATCHDOG_USEC={round(watchdog_s * 1e6)}")

    def alive(self) -> None:
        """Feed the watchdog."""
        self._send("WATCHDOG=1")

    def status(self, text: str) -> None:
        """One line for ``systemctl status``."""
        self._send(f"STATUS={' '.join(text.split())}")

    def stopping(self) -> None:
        """The service is ending in good order; the watchdog rests."""
        self._send("STOPPING=1")

    def close(self) -> None:
        """Say no more."""
        if self._socket is not None:
            self._socket.close()

    def _send(self, message: str) -> None:
        if self._socket is not None:
            with contextlib.suppress(OSError):  # the manager is busy or gone: the recording is worth more
                self._socket.sendto(message.encode(), self._address)


def journal_listens(environment: Mapping[str, str] = os.environ, descriptor: int = 2) -> bool:
    """Whether standard error is the journal's, as systemd says it in JOURNAL_STREAM."""
    with contextlib.suppress(OSError, ValueError):
        device, inode = (int(word) for word in environment.get("JOURNAL_STREAM", "").split(":"))
        status = os.fstat(descriptor)
        return (status.st_dev, status.st_ino) == (device, inode)
    return False


def _address(path: str) -> str:
    """A socket's address; a name that begins with @ is in the abstract namespace."""
    return "\0" + path[1:] if path.startswith("@") else path
