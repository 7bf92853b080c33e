"""What was recorded beside the frames → columns of the frames table: signals, the gaps they bridge, failed gates."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pyarrow as pa

from process.signal_table import GAP, GATES, KEYS, MAX_GAP_S, MISSING, signal_table, signals_path
from process.signals import Signals, read_signals
from reconstruct.tables import read_table

_NOT_THERE = "the set is not in the table of signals"


@dataclass(frozen=True)
class Beside:
    """The other data of one flight: its signals in time, or already at the sets' instants (``table``)."""

    signals: Signals = field(default_factory=Signals)
    max_gap_s: float = MAX_GAP_S
    table: pa.Table | None = None

    @property
    def names(self) -> list[str]:
        """Of the numbers among the signals."""
        if self.table is None:
            return [signal.name for signal in self.signals.signals]
        known = [member.name for member in self.table.schema if pa.types.is_floating(member.type)]
        return [name for name in known if not name.endswith(GAP)]

    def joined(self, frames: pa.Table) -> pa.Table:
        """``frames`` with a column for each signal, its gap, what is missing, and the gates that failed.

        A signal with the name of a column that is there gets ``_signal`` at the end of its own.
        """
        if self.table is None:
            own = signal_table(frames.select(KEYS), self.signals, self.max_gap_s)
        else:
            own = self._rows_of(frames, self.table)
        names = [name for name in own.column_names if name not in KEYS]
        taken = set(frames.column_names)
        for name in names:
            whole = name.removesuffix(GAP) if name.removesuffix(GAP) in names else name
            new = name.replace(whole, f"{whole}_signal", 1) if whole in taken else name
            frames = frames.append_column(own.schema.field(name).with_name(new), own.column(name))
        return frames

    @staticmethod
    def _rows_of(frames: pa.Table, table: pa.Table) -> pa.Table:
        """The sets' rows of ``table``; a set that is not there has no signal, for that reason."""
        places = {key: row for row, key in enumerate(_keys(table))}
        rows = pa.array([places.get(key) for key in _keys(frames)], pa.int64())
        found = table.take(rows)
        for at, member in enumerate(found.schema):
            lacking = math.nan if pa.types.is_floating(member.type) else _NOT_THERE if member.name == MISSING else ""
            if member.name not in KEYS:
                found = found.set_column(at, member, found.column(at).fill_null(lacking))
        return found


def beside_flight(flights: Sequence[Path], dbc: Sequence[Path], max_gap_s: float) -> Beside:
    """Of a recording. Raises ProcessError when there is none, or a DBC file cannot be used."""
    return Beside(read_signals(flights, dbc), max_gap_s)


def beside_markers(markers: Path) -> Beside | None:
    """Of a marker table, from the file that lies beside it; None where there is none."""
    path = signals_path(markers)
    return Beside(table=read_table(path, (*KEYS, MISSING, GATES))) if path.is_file() else None


def _keys(table: pa.Table) -> list[tuple[int, str]]:
    return list(zip(table.column("trigger_index").to_pylist(), table.column("side").to_pylist(), strict=True))
