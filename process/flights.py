"""Folders that a user names → flights: which of them were recorded together, and what to call each."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from capture.errors import ProcessError
from process.provenance import recorded_provenance
from process.recording import find_files


@dataclass(frozen=True)
class Flight:
    """What was recorded together."""

    name: str
    """fit for a folder, and like no other's of the same call"""
    paths: tuple[Path, ...]


@dataclass(frozen=True)
class _Folder:
    path: Path
    flight_id: str
    """empty: its files do not tell"""
    flight: str
    """as recorded; the folder's own name where its files do not tell"""
    names: tuple[str, str]
    """its own, and that of the folder it is in"""


def find_flights(paths: Sequence[Path]) -> list[Flight]:
    """The flights in ``paths`` (MCAP files, or folders that are searched for them two levels deep), in that order.

    The recorder notes in each file which flight it is of. Folders whose files do not tell (damaged, or by another
    recorder) belong to the flight that they, or the folder they are in, have the name of; where there is none they
    are a flight of their own, and all one when no folder tells. A path without a recording counts as such
    a folder: who opens it will be told.
    """
    folders = [_folder(path, files) for path, files in _by_folder(paths).items()]
    told = {folder.flight: folder.flight_id for folder in reversed(folders) if folder.flight_id}
    members: dict[str, list[_Folder]] = {}
    for folder in folders:
        alike = [told[name] for name in folder.names if name in told]
        key = folder.flight_id or (alike[0] if alike else f"folder {folder.flight}" if told else "all")
        members.setdefault(key, []).append(folder)
    if len(members) == 1:
        return [Flight(_fit(folders[0].flight), tuple(paths))]
    flights: dict[str, Flight] = {}
    for key, own in members.items():
        name = next((folder.flight for folder in own if folder.flight_id), own[0].flight)
        name = _fit(key if _fit(name) in flights else name)
        flights[name] = Flight(name, tuple(folder.path for folder in own))
    return list(flights.values())


def _by_folder(paths: Sequence[Path]) -> dict[Path, list[Path]]:
    """Folder → its MCAP files; a file that was named itself stands for itself."""
    found: dict[Path, list[Path]] = {}
    for path in paths:
        try:
            files = find_files([path])
        except ProcessError:
            files = ()
        if path.is_file() or not files:
            found.setdefault(path, []).extend(files)
        else:
            for file in files:
                found.setdefault(file.parent, []).append(file)
    return found


def _folder(path: Path, files: Sequence[Path]) -> _Folder:
    own = (path.parent if path.is_file() else path).resolve()
    names = (own.name, own.parent.name)
    for file in files:
        note = recorded_provenance(file)
        if note.get("flight_id"):
            return _Folder(path, note["flight_id"], note.get("flight") or own.name, names)
    return _Folder(path, "", own.name, names)


def _fit(name: str) -> str:
    return re.sub(r"[^\w.+-]", "_", name).lstrip(".") or "flight"
