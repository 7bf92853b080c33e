"""`wingcap start` and `wingcap stop`: a word to the recorder that is running."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import typer

from capture.config import load_config
from capture.console import say, say_json
from capture.control import SOCKET_NAME, Answer, ControlServer, ask
from capture.errors import CaptureError
from capture.health import default_folder, make_folder
from capture.health_writer import HealthWriter

_Config = Annotated[
    Path | None, typer.Option("--config", help="the recorder's TOML file, where it names health.folder")
]
_Json = Annotated[bool, typer.Option("--json", help="print the answer as JSON")]


@contextlib.contextmanager
def controlled(act: Callable[[str], Answer], health: HealthWriter, tell: Callable[[str], None]) -> Iterator[None]:
    """Listen on the control socket, beside the health, within. A recorder that cannot says so, and records."""
    try:
        make_folder(health.folder)
        server = ControlServer(health.folder / SOCKET_NAME, act)
    except CaptureError as error:
        tell(f"no `wingcap start` and `stop`: {error}")
        yield
        return
    server.start()
    health.control_socket = server.path
    try:
        yield
    finally:
        server.close()


def start(config: _Config = None, json: _Json = False) -> None:
    """Begin a recording, in the recorder that is running and idle. Returns as soon as it begins."""
    _tell("start", config, json)


def stop(config: _Config = None, json: _Json = False) -> None:
    """End the recording that is running. The recorder goes back to idle when its files are closed."""
    _tell("stop", config, json)


def _tell(action: str, config: Path | None, json: bool) -> None:
    folder = load_config(config).config.health.folder if config is not None else None
    answer = ask((folder or default_folder()) / SOCKET_NAME, action)
    if json:
        say_json(vars(answer))
    if not answer.ok:
        raise CaptureError(answer.message)
    if not json:
        say(f"{answer.flight}: {answer.message}" if answer.flight else answer.message)
