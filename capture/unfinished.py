"""The disks at start to what an earlier recording left unfinished there: looked for beside the new one, left alone.

Nothing is repaired on the aircraft: a repair reads and writes as much as the recording itself, on the same disks, when
those are needed most. A cut file is readable up to its last complete frame and stays where it is; the new flight has
its own folder. See docs/decisions/0004-after-power.md.
"""

import os
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from capture.aux_log import Put
from capture.record import Diagnostic
from capture.segment import MAGIC

NAMED = 5
"""Flights named in a report; of more only the number is told."""
STATUS_NAME = "earlier flights"


@dataclass(frozen=True)
class Unfinished:
    """A flight's folder with files that were never closed."""

    folder: Path
    files: tuple[str, ...]
    size_bytes: int  # of those files


def flights_on(disks: Sequence[Path]) -> list[Path]:
    """Folders directly below ``disks``, by name. A disk that cannot be read has none."""
    return [folder for disk in disks for folder in sorted(disk.glob("*/"))]


def find_unfinished(flights: Sequence[Path]) -> list[Unfinished]:
    """Those of the folders with a recording that was not closed.

    A closed file ends with MCAP's magic; only that end is read.
    """
    found = []
    for folder in flights:
        cut = [path for path in sorted(folder.glob("*.mcap")) if not _closed(path)]
        if cut:
            size_bytes = sum(path.stat().st_size for path in cut)
            found.append(Unfinished(folder, tuple(path.name for path in cut), size_bytes))
    return found


class AfterPower:
    """Companion of a recording: reports what was left unfinished, once it is known.

    It looks at the flights that are there when it is made: before the new one.
    """

    def __init__(self, disks: Sequence[Path]) -> None:
        self._flights = flights_on(disks)
        self._status: Diagnostic | None = None
        self._thread = threading.Thread(target=self._look, name="after-power", daemon=True)

    def start(self, put: Put) -> None:
        """Begin to look, in a thread of its own: a disk full of flights takes its time."""
        self._thread.start()

    def statuses(self) -> list[Diagnostic]:
        """Empty until the look has ended."""
        return [] if self._status is None else [self._status]

    def stop(self) -> None:
        """A look that hangs in a dead disk is left behind."""
        if self._thread.ident is not None:
            self._thread.join(0.5)

    def account(self) -> dict[str, str]:
        """Nothing of its own."""
        return {}

    def _look(self) -> None:
        began_s = time.monotonic()
        try:
            found = find_unfinished(self._flights)
        except OSError as error:
            self._status = Diagnostic(1, STATUS_NAME, f"cannot be looked at ({error}): check the disk")
            return
        values = (("unfinished", str(len(found))), ("look_ms", f"{(time.monotonic() - began_s) * 1e3:.0f}"))
        self._status = Diagnostic(1 if found else 0, STATUS_NAME, report(found), values)


def report(found: Sequence[Unfinished]) -> str:
    """What was found, in one line with what to do."""
    if not found:
        return "all closed"
    named = ", ".join(
        f"{flight.folder} ({len(flight.files)} files, {flight.size_bytes / 1e9:.1f} GB)" for flight in found[:NAMED]
    )
    more = f" and {len(found) - NAMED} more" if len(found) > NAMED else ""
    return (
        f"{len(found)} folders hold a recording that was cut: {named}{more}; they are left as they are: "
        "run `wingcap recover` on them after the flight"
    )


def _closed(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            file.seek(-len(MAGIC), os.SEEK_END)
            return file.read() == MAGIC
    except OSError:  # too short to have an end, or unreadable: for `wingcap recover` to judge
        return False
