"""Partial results of a long job in a folder: each is there whole or not at all, and the next run finds it."""

import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from capture.errors import ProcessError

IDENTITY = "identity.json"


@dataclass(frozen=True)
class Part:
    """What one partition gave."""

    tables: Mapping[str, pa.Table]
    note: Mapping[str, Any]  # JSON


class PartStore:
    """The parts of one job. A folder that holds another job's parts is emptied first."""

    def __init__(self, folder: Path, identity: Mapping[str, Any]) -> None:
        """``identity`` is all that the parts depend on, as JSON.

        Raises:
            ProcessError: the folder cannot be made, or written to.
        """
        self.folder = folder
        text = json.dumps(identity, sort_keys=True)
        try:
            known = (folder / IDENTITY).read_text(encoding="utf-8") if (folder / IDENTITY).is_file() else None
            if known != text:
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir(parents=True)
                _put(folder / IDENTITY, [text.encode()])
        except OSError as error:
            raise ProcessError(f"{folder}: cannot be written ({error.strerror})") from error
        self._names = {path.stem for path in folder.glob("*.part")}

    def __contains__(self, name: str) -> bool:
        return name in self._names

    def __len__(self) -> int:
        return len(self._names)

    def write(self, name: str, part: Part) -> None:
        """Keep a part, whole or not at all."""
        head = json.dumps({"tables": list(part.tables), "note": part.note}).encode() + b"\n"
        sink = pa.BufferOutputStream()
        for table in part.tables.values():
            with pa.ipc.new_stream(sink, table.schema) as stream:
                stream.write_table(table)
        try:
            _put(self.folder / f"{name}.part", [head, sink.getvalue()])
        except OSError as error:
            raise ProcessError(f"{self.folder}: cannot be written ({error.strerror})") from error
        self._names.add(name)

    def read(self, name: str) -> Part:
        """A part that is there."""
        path = self.folder / f"{name}.part"
        try:
            with path.open("rb") as file:
                head = json.loads(file.readline())
                source = pa.PythonFile(file, mode="r")
                tables = {}
                for table in head["tables"]:
                    with pa.ipc.open_stream(source) as stream:
                        tables[table] = stream.read_all()
        except (OSError, ValueError) as error:
            raise ProcessError(f"{path}: cannot be read ({error}); remove {self.folder} and run again") from error
        return Part(tables, head["note"])

    def remove(self) -> None:
        """Everything is written elsewhere: the parts are no longer needed."""
        shutil.rmtree(self.folder, ignore_errors=True)


def _put(path: Path, pieces: list[Any]) -> None:
    beside = path.with_suffix(".tmp")
    with beside.open("wb") as file:
        for piece in pieces:
            file.write(piece)
    beside.replace(path)
