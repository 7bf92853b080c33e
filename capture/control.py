"""The recorder's control socket: ``start``, ``stop`` and ``status`` from a command or a page, one line each way.

A UNIX stream socket for the recorder's user and group. The client sends one JSON object, ``{"do": "start"}``, and a
line end; the recorder answers with one, ``{"ok": true, "state": "idle", "flight": "", "message": "…"}``, and closes.
"""

import contextlib
import json
import os
import socket
import stat
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from capture.errors import CaptureError
from capture.worker import Worker

SOCKET_NAME = "control.sock"
ACTIONS = ("start", "stop", "status")
TIMEOUT_S = 2.0
_MOST_BYTES = 4096
_ACCEPT_S = 0.2


@dataclass(frozen=True)
class Answer:
    """What the recorder says."""

    ok: bool  # False: it did not do it; the message says why
    state: str
    flight: str  # the one being recorded, or empty
    message: str


class ControlServer(Worker):
    """Listens in a thread of its own. One client at a time; a slow one is cut off."""

    def __init__(self, path: Path, act: Callable[[str], Answer]) -> None:
        """``act`` is called with one of ACTIONS, from this thread, and must not block for long.

        Raises:
            CaptureError: another recorder listens there, or the socket cannot be made.
        """
        super().__init__("control-socket")
        self.path = path
        self._act = act
        self._socket = _listen(path)

    def work(self) -> None:
        """Answer until asked to stop."""
        while not self.stop_requested.is_set():
            with contextlib.suppress(TimeoutError, OSError):
                client, _ = self._socket.accept()
                with client:
                    client.settimeout(TIMEOUT_S)
                    client.sendall(_line(asdict(self._answer(_read_line(client)))))

    def close(self) -> None:
        """Listen no more. Safe to call twice."""
        self.stop(2 * TIMEOUT_S)
        self._socket.close()
        self.path.unlink(missing_ok=True)

    def _answer(self, line: bytes) -> Answer:
        try:
            asked = json.loads(line)["do"]
        except (ValueError, KeyError, TypeError, RecursionError):
            asked = None
        if asked not in ACTIONS:
            return Answer(False, "", "", f'not understood: send {{"do": …}} with one of {", ".join(ACTIONS)}')
        return self._act(asked)


def ask(path: Path, action: str) -> Answer:
    """Ask the recorder whose socket is at ``path``.

    Raises:
        CaptureError: nobody answers there, or we may not ask.
    """
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
            connection.settimeout(TIMEOUT_S)
            connection.connect(str(path))
            connection.sendall(_line({"do": action}))
            found = json.loads(_read_line(connection))
        return Answer(bool(found["ok"]), str(found["state"]), str(found["flight"]), str(found["message"]))
    except PermissionError as error:
        raise CaptureError(f"{path}: you may not control this recorder: join the group that owns the socket") from error
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CaptureError(
            f"{path}: no recorder answers ({error}): start one with `wingcap record` or `systemctl start wingcap`, "
            "and give the same --config"
        ) from error


def _listen(path: Path) -> socket.socket:
    with contextlib.closing(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)) as probe:
        probe.settimeout(TIMEOUT_S)
        if path.is_socket() and probe.connect_ex(str(path)) == 0:
            raise CaptureError(f"{path}: another recorder listens there: give one of them another `health.folder`")
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        with contextlib.suppress(FileNotFoundError):
            if stat.S_ISSOCK(os.lstat(path).st_mode):
                path.unlink()
        listener.bind(str(path))
        path.chmod(0o660)
    except OSError as error:
        listener.close()
        raise CaptureError(f"{path}: the control socket cannot be put there ({error}): check its folder") from error
    listener.listen(4)
    listener.settimeout(_ACCEPT_S)
    return listener


def _read_line(connection: socket.socket) -> bytes:
    data = b""
    while not data.endswith(b"\n") and len(data) < _MOST_BYTES:
        more = connection.recv(_MOST_BYTES)
        if not more:
            break
        data += more
    return data


def _line(value: dict[str, Any]) -> bytes:
    return json.dumps(value, ensure_ascii=False).encode() + b"\n"
