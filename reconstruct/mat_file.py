"""A result folder's tables → result.mat for MATLAB, a column at a time, so that memory does not grow with the columns.

MATLAB's format 5 allows 2 GB a variable. A longer flight is cut: ``left`` and ``right`` have its first sets, ``left_2``
and ``right_2`` those after, and so on.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from scipy.io import savemat

from capture.errors import ReconstructError, UsageError
from reconstruct.dense import ITEMS, ResultFolder, how_made
from reconstruct.result import pieces
from reconstruct.tables import FRAMES, SHAPE, SIDES, Ints

MAT = "result.mat"
LARGEST_BYTES = 1_500_000_000  # of a variable: MATLAB allows 2 GB
_NAME = 63  # characters that MATLAB allows
_PER_SET = ("timestamp_ns", "flags")  # of the shape table
Array = np.ndarray[Any, Any]


@dataclass(frozen=True, slots=True)
class _Column:
    """A column of one wing, read when it is written: (F,) or (F, items)."""

    table: "_Table"
    name: str
    sets: slice

    def __array__(self, dtype: Any = None, copy: Any = None) -> Array:
        values = self.table.column(self.name, self.sets)
        return values if dtype is None else values.astype(dtype)


@dataclass(frozen=True)
class _Table:
    """One wing's rows of one table."""

    path: Path
    side: str
    item: str  # what a set has several of; empty: nothing
    trigger: Ints  # (F,)
    items: Ints  # (n,)
    row: Ints  # (F · n,) of the wing's, in the order of sets and items; −1 where there is none

    def column(self, name: str, sets: slice) -> Array:
        """Some sets of a column, NaN or 0 where there is no row; words as numbers that count from 1 in ``words``."""
        values = self._read(name)
        if pa.types.is_string(values.type):
            codes = pc.index_in(values, pa.array(self.words(name), pa.string())).fill_null(-1)
            whole = (codes.to_numpy() + 1).astype(np.uint16)
        else:
            whole = values.to_numpy(zero_copy_only=False)
        lacking = np.nan if whole.dtype.kind == "f" else 0
        whole = np.where(self.row >= 0, whole[self.row], np.array(lacking, whole.dtype))
        whole = whole.reshape(self.trigger.size, -1)[sets]
        if name == "frame_timestamp_ns":
            return np.asarray(whole.max(axis=1))
        per_set = not self.item or (name in _PER_SET and self.path.name == SHAPE)
        return np.asarray(whole[:, 0] if per_set else whole)

    def words(self, name: str) -> list[str]:
        """The different words of a column, without the empty one."""
        return sorted(word for word in pc.unique(self._read(name)).to_pylist() if word)

    def _read(self, name: str) -> Any:
        own = [piece.column(name) for piece in pieces(self.path, (name,), self.side)]
        return pa.concat_tables([pa.table({name: one}) for one in own]).column(name).combine_chunks()


def write_mat(folder: Path) -> Path:
    """``result.mat`` in the result's folder: a struct a side, in it one a table, and how the result was made.

    Raises ReconstructError when it cannot be written, UsageError when a table is missing or not whole.
    """
    summary = ResultFolder(folder).summary
    made = {"made": json.dumps(how_made(summary)), "reference": summary.get("reference", "")}
    path = folder / MAT
    part = path.with_name(f"{MAT}.part")
    try:
        with part.open("wb") as file:
            for side in SIDES:
                for name, content in _variables(folder, side):
                    savemat(file, {name: content}, long_field_names=True)
            savemat(file, {"wingshape": made}, long_field_names=True)
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise ReconstructError(f"{path}: cannot be written ({error.strerror or error})") from error
    return path


def _variables(folder: Path, side: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """A wing's variables: one, or more of a long flight."""
    tables = {name: _open(folder / name, side) for name in ITEMS}
    sets = tables[FRAMES].trigger.size
    if not sets:
        return
    row_bytes = sum(8 * max(1, one.items.size) * len(_names(one)) for one in tables.values())
    length = max(1, LARGEST_BYTES // row_bytes)
    for number, begin in enumerate(range(0, sets, length)):
        some = slice(begin, begin + length)
        content = {Path(name).stem: _struct(one, some) for name, one in tables.items()}
        yield (side if number == 0 else f"{side}_{number + 1}"), content


def _struct(table: _Table, sets: slice) -> dict[str, Any]:
    found: dict[str, Any] = {"trigger_index": table.trigger[sets]}
    if table.item:
        found[table.item] = table.items
    for name, kind in _names(table).items():
        found[name[:_NAME]] = _Column(table, name, sets)
        if pa.types.is_string(kind):
            words = np.array(table.words(name), dtype=object)
            found[f"{name}_words"[:_NAME]] = words
    return found


def _names(table: _Table) -> dict[str, pa.DataType]:
    """The columns that are written as they are, and their types."""
    schema = pq.read_schema(table.path)
    return {field.name: field.type for field in schema if field.name not in ("trigger_index", "side", table.item)}


def _open(path: Path, side: str) -> _Table:
    item = ITEMS[path.name]
    columns = ("trigger_index", item) if item else ("trigger_index",)
    keys = pa.concat_tables(pieces(path, columns, side))
    triggers, row = np.unique(keys.column("trigger_index").to_numpy(), return_inverse=True)
    items, place = np.empty(0, dtype=np.int64), row
    if item:
        items, column = np.unique(keys.column(item).to_numpy(), return_inverse=True)
        place = row * items.size + column
    known = np.full(triggers.size * max(1, items.size), -1)
    if place.size and np.bincount(place).max() > 1:
        raise UsageError(f"{path}: has a {item or 'set'} twice")
    known[place] = np.arange(place.size)
    return _Table(path, side, item, triggers, items, known)
