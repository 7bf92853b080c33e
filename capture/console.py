"""Runs a Typer application so that a user sees one line and an exit code, never a traceback."""

import contextlib
import json
import os
import queue
import sys
import threading
from typing import Any, NoReturn

import typer

from capture.errors import WingshapeError
from capture.notify import journal_listens


def run(app: typer.Typer) -> NoReturn:
    """Run ``app`` on the process's arguments and exit.

    Exit codes: 0 done; 1 a failure (``WingshapeError``, or the system refused a file); 2 wrong usage;
    130 interrupted. Set ``WINGSHAPE_DEBUG=1`` to see the traceback behind an error line.
    """
    app.pretty_exceptions_enable = False
    try:
        app()  # Typer itself reports wrong usage, with exit code 2
    except KeyboardInterrupt:
        _fail("interrupted", 130)
    except WingshapeError as error:
        _fail(str(error), error.exit_code)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        _fail(f"{place}{error.strerror or error}", 1)
    sys.exit(0)


def _fail(message: str, code: int) -> NoReturn:
    if os.environ.get("WINGSHAPE_DEBUG") and sys.exc_info()[1] is not None:
        raise  # called from an except block only
    priority = "<3>" if journal_listens() else ""  # sd-daemon(3): the journal takes it off, and shows an error
    print(f"{priority}error: {' '.join(message.split())}", file=sys.stderr)  # noqa: T201
    sys.exit(code)


def say(text: str = "") -> None:
    """Print a result line to standard output."""
    print(text, flush=True)  # noqa: T201


def note(text: str) -> None:
    """Print progress or a warning to standard error, so that standard output stays parseable.

    A standard error that is closed is not worth stopping for.
    """
    with contextlib.suppress(OSError, ValueError):
        print(text, file=sys.stderr, flush=True)  # noqa: T201


class Narrator:
    """``note`` from a thread of its own: whoever calls it never waits for a terminal or a pipe that is stuck.

    At most 64 lines wait; further ones are dropped.
    """

    def __init__(self) -> None:
        self._lines: queue.Queue[str | None] = queue.Queue(64)
        self._thread = threading.Thread(target=self._run, name="narrator", daemon=True)
        self._thread.start()

    def __call__(self, text: str) -> None:
        with contextlib.suppress(queue.Full):
            self._lines.put_nowait(text)

    def close(self) -> None:
        """Give what is waiting a second to be printed."""
        with contextlib.suppress(queue.Full):
            self._lines.put_nowait(None)
        self._thread.join(1.0)

    def _run(self) -> None:
        while (text := self._lines.get()) is not None:
            note(text)


def say_json(value: Any) -> None:
    """Print ``value`` as JSON on standard output (NaN becomes null)."""
    say(json.dumps(_without_nan(value), indent=2))


def _without_nan(value: Any) -> Any:
    if isinstance(value, float) and value != value:
        return None
    if isinstance(value, dict):
        return {str(key): _without_nan(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_nan(item) for item in value]
    return value
