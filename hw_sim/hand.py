"""A hand at the simulated rig: a cable pulled or put back, a frame spoilt, by a command to its socket."""

import socket
from pathlib import Path

from capture.errors import SimulationError
from hw_sim import link

_REPLY_TIMEOUT_S = 10.0


def do(socket_path: Path, deed: str, camera: str) -> None:
    """Do ``deed`` (one of ``link.DEEDS``) to ``camera`` (``left_cam0`` …) of the rig behind ``socket_path``.

    Raises:
        SimulationError: no rig is there, or it does not know the camera or the deed.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as connection:
        connection.settimeout(_REPLY_TIMEOUT_S)
        try:
            connection.connect(str(socket_path))
            connection.send(link.Command(deed, camera).encode())
            answer = connection.recv(link.MAX_PACKET_BYTES)
        except OSError as error:
            raise SimulationError(
                f"{socket_path}: no simulated rig answers ({error}): start `wingsim rig` first"
            ) from error
    if answer != link.DONE:
        raise SimulationError(f"{socket_path}: {answer.decode(errors='replace') or 'the rig went away'}")
