"""``wingproc monitor``: the status page, metrics and, if asked, a Foxglove bridge, until it is stopped."""

import contextlib
import ipaddress
import os
import socket
import stat
from pathlib import Path
from typing import Annotated, Any

import cv2
import typer

from capture.console import note
from capture.errors import ProcessError, UsageError
from capture.health import default_folder
from capture.worker import Worker

LEAST_TOKEN = 16  # characters
_NICE = 10
_STOP_S = 5.0
_BACKLOG = 128


def monitor(
    folder: Annotated[
        Path | None, typer.Option("--health", help="The recorder's `health.folder`; its default if not given.")
    ] = None,
    host: Annotated[
        str, typer.Option(help="Address to listen at. Beyond this computer only with a token.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any that is free.")] = 8080,
    token_file: Annotated[
        Path | None,
        typer.Option(help="File with the token that is asked for; $CREDENTIALS_DIRECTORY/token if there is one."),
    ] = None,
    control: Annotated[
        bool, typer.Option("--control", help="Allow to start and stop recordings from the page.")
    ] = False,
    certificate: Annotated[Path | None, typer.Option(help="PEM certificate: the page is then https.")] = None,
    key: Annotated[Path | None, typer.Option(help="PEM key of the certificate.")] = None,
    foxglove: Annotated[
        int | None,
        typer.Option(min=0, max=65535, help="Port of a live server for the Foxglove app, on this computer only."),
    ] = None,
) -> None:
    """Show the recorder's health as a page, and as metrics at /metrics, until stopped.

    Reads shared memory only: it cannot slow the recorder. Needs the extra `monitor`.
    """
    try:
        from process.monitor.app import Status, make_app
        from process.monitor.control import Control
        from process.monitor.gallery import Gallery
        from process.monitor.guard import Guard
        from process.monitor.server import make_server
    except ImportError as error:
        raise ProcessError(f"{error.name} is not installed: pip install 'wingshape[monitor]'") from error
    token = _token(token_file)
    if token is None and not _is_loopback(host):
        raise UsageError(f"--host {host} is beyond this computer: give a --token-file, or leave the host at 127.0.0.1")
    if (certificate is None) != (key is None):
        raise UsageError("--certificate and --key go together")
    listener = _listen(host, port)
    with contextlib.suppress(OSError):
        os.nice(_NICE)
    cv2.setNumThreads(1)
    gallery = Gallery(folder or default_folder())
    status = Status(folder or default_folder(), gallery, Control(control))
    guard = Guard(make_app(status), token, own_hosts(host))
    server = make_server(guard, certificate, key)
    gallery.start()
    scheme = "http" if certificate is None else "https"
    shown = f"[{host}]" if ":" in host else host
    bridge = None if foxglove is None else _bridge(foxglove, status, gallery)
    note(f"monitor: {scheme}://{shown}:{listener.getsockname()[1]}/ of {folder or default_folder()}")
    try:
        server.run(sockets=[listener])
    finally:
        if bridge is not None:
            bridge.stop(_STOP_S)
        gallery.stop(_STOP_S)


def _bridge(port: int, status: Any, gallery: Any) -> Worker:
    try:
        from process.monitor.bridge import Bridge
    except ImportError as error:
        raise ProcessError(f"{error.name} is not installed: pip install 'wingshape[foxglove]'") from error
    bridge = Bridge(port, status, gallery)
    bridge.start()
    note(f"foxglove: ws://127.0.0.1:{bridge.port}")
    return bridge


def own_hosts(host: str) -> frozenset[str]:
    """Names that a browser on this computer may call us by."""
    return frozenset({"127.0.0.1", "localhost", "[::1]", f"[{host}]" if ":" in host else host})


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _token(path: Path | None) -> str | None:
    credentials = os.environ.get("CREDENTIALS_DIRECTORY")
    if path is None and credentials and (Path(credentials) / "token").is_file():
        path = Path(credentials) / "token"
    if path is None:
        return None
    try:
        mode = path.stat().st_mode
        token = path.read_text(encoding="ascii").strip()
    except OSError as error:
        raise UsageError(f"{path}: the token cannot be read ({error.strerror}): give another --token-file") from error
    except UnicodeDecodeError as error:
        raise UsageError(f"{path}: not a token of plain characters: make one with `openssl rand -hex 16`") from error
    if mode & (stat.S_IROTH | stat.S_IWOTH):
        raise UsageError(f"{path}: everybody can read or change the token: chmod 600 {path}")
    if len(token) < LEAST_TOKEN:
        raise UsageError(f"{path}: a token has {LEAST_TOKEN} characters at least: make one with `openssl rand -hex 16`")
    return token


def _listen(host: str, port: int) -> socket.socket:
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listener = socket.socket(family, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen(_BACKLOG)  # who asks from now on is answered, if a little later
    except OSError as error:
        raise UsageError(
            f"--host {host} --port {port}: cannot listen there ({error.strerror}): give another"
        ) from error
    return listener
