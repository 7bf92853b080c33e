"""The socket that a simulated rig is reached by: a path to a listening Unix socket."""

import contextlib
import socket
from pathlib import Path

from capture.errors import SimulationError


def listen(path: Path) -> socket.socket:
    """A listening socket at ``path``; one that a rig left behind there is replaced.

    Raises:
        SimulationError: another rig is running there, or the path cannot be used.
    """
    with contextlib.closing(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)) as probe:
        if path.is_socket() and probe.connect_ex(str(path)) == 0:
            raise SimulationError(f"{path}: another simulated rig is running there: stop it or give another path")
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_socket():
            path.unlink()
        listener.bind(str(path))
    except OSError as error:
        listener.close()
        raise SimulationError(
            f"{path}: the rig's socket cannot be put there ({error}): give a short path (under 100 characters) "
            "in a folder that can be written"
        ) from error
    listener.listen()
    return listener
