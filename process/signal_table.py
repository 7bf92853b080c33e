"""Signals in time to columns at the frame sets' instants: interpolated, with the gap bridged, or NaN and why not.

The table has a row for each set (``trigger_index``, ``side``, ``timestamp_ns``), for each signal its value and the time
between the two samples that it stands between (``…_gap_s``), what is missing (``signals_missing``), and the gates that
failed at that instant (``gates_failing``).
"""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from process.signals import Outage, Signal, Signals

MAX_GAP_S = 0.5
GAP = "_gap_s"
MISSING, GATES = "signals_missing", "gates_failing"
KEYS = ("trigger_index", "side", "timestamp_ns")


def signals_path(markers: Path) -> Path:
    """Where the signals of a marker table's sets are kept: ``markers.parquet`` → ``markers_signals.parquet``."""
    return markers.with_name(f"{markers.stem}_signals.parquet")


def sets_of(markers: pa.Table) -> pa.Table:
    """Each set of a marker table once: ``trigger_index``, ``side`` and its common instant ``timestamp_ns``."""
    columns = ("trigger_index", "side")
    own = markers.select([*columns, "frame_timestamp_ns"]).group_by(list(columns), use_threads=False)
    first = own.aggregate([("frame_timestamp_ns", "min")])
    return first.select([*columns, "frame_timestamp_ns_min"]).rename_columns(KEYS)


def signal_table(sets: pa.Table, signals: Signals, max_gap_s: float = MAX_GAP_S) -> pa.Table:
    """``sets`` with a column for each signal, and its gap, and the two columns of words.

    A value is NaN before the first sample, after the last, and between two that are more than ``max_gap_s`` apart.
    """
    time_ns = sets.column("timestamp_ns").to_numpy()
    columns: dict[str, pa.Array] = {name: sets.column(name) for name in KEYS}
    missing: list[list[str]] = [[] for _ in time_ns]
    for signal in signals.signals:
        name = signal.name if signal.name not in (*KEYS, MISSING, GATES) else f"{signal.name}_signal"
        value, gap_s, reason = at_instants(signal, time_ns, max_gap_s)
        columns[name], columns[name + GAP] = pa.array(value), pa.array(gap_s)
        for row in np.flatnonzero(reason != ""):
            missing[row].append(f"{name}: {reason[row]}")
    columns[MISSING] = pa.array(["; ".join(words) for words in missing], pa.string())
    columns[GATES] = pa.array(_failing(signals.outages, time_ns), pa.string())
    table = pa.table(columns)
    units = {signal.name: signal for signal in signals.signals}
    members = [_with_note(member, units.get(member.name)) for member in table.schema]
    return table.cast(pa.schema(members))


def at_instants(
    signal: Signal, time_ns: NDArray[np.int64], max_gap_s: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.object_]]:
    """Value, gap in seconds, and reason (empty where there is a value), each (m,), at UTC times (m,).

    The gap is between the samples before and after; 0 at a sample, NaN where one of them does not exist.
    """
    known, value = signal.time_ns, signal.value
    after = np.searchsorted(known, time_ns)  # the first sample not before
    inside = (after < known.size) & ((after > 0) | (known[np.minimum(after, known.size - 1)] == time_ns))
    later = np.minimum(after, known.size - 1)
    earlier = np.where(known[later] == time_ns, later, np.maximum(after - 1, 0))
    gap_s = np.where(inside, (known[later] - known[earlier]) * 1e-9, math.nan)
    part = (time_ns - known[earlier]) / np.maximum(known[later] - known[earlier], 1)
    step = value[later] - value[earlier]
    if signal.held:
        step = np.zeros_like(step)
    elif math.isfinite(signal.period):
        step = step - signal.period * np.round(step / signal.period)
    found = value[earlier] + np.where(part > 0, part * step, 0.0)
    if math.isfinite(signal.period):
        low = 0.0 if value.min() >= 0 else -signal.period / 2
        found = low + np.mod(found - low, signal.period)
    reason = np.full(time_ns.shape, "", dtype=object)
    reason[after >= known.size] = "after the last sample"
    reason[~inside & (after < known.size)] = "before the first sample"
    for row in np.flatnonzero(inside & (gap_s > max_gap_s)):
        reason[row] = f"gap of {gap_s[row]:.2f} s"
    reason[(reason == "") & ~np.isfinite(found)] = "not a number"
    return np.where(reason == "", found, math.nan), gap_s, reason


def _failing(outages: Sequence[Outage], time_ns: NDArray[np.int64]) -> list[str]:
    names: list[set[str]] = [set() for _ in time_ns]
    for outage in outages:
        during = time_ns >= outage.begin_ns
        if outage.end_ns is not None:
            during &= time_ns < outage.end_ns
        for row in np.flatnonzero(during):
            names[row].add(outage.name)
    return [",".join(sorted(found)) for found in names]


def _with_note(member: pa.Field, signal: Signal | None) -> pa.Field:
    if signal is None:
        return member
    note = {"source": signal.source} | ({"unit": signal.unit} if signal.unit else {})
    return member.with_metadata(note)
