"""Signals beside the tip: the frames table gets them at its own instants, from a flight or a marker table's file."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from process.signal_table import signal_table
from process.signals import Outage, Signal, Signals
from reconstruct.beside import Beside, beside_markers

START_NS = 1_800_000_000_000_000_000
MS = 1_000_000
LOAD = Signal(
    "load_factor", "/can", "g", START_NS + np.arange(100, dtype=np.int64) * 10 * MS, 1.0 + 0.01 * np.arange(100)
)
CLASH = Signal("iterations", "/can", "", LOAD.time_ns, LOAD.value)
SIGNALS = Signals((CLASH, LOAD), (Outage("ptp.state", "no master", START_NS + 46 * MS, None),))


def frames(sets: int = 4) -> pa.Table:
    return pa.table(
        {
            "trigger_index": [*range(sets), *range(sets)],
            "side": ["left"] * sets + ["right"] * sets,
            "timestamp_ns": START_NS + np.tile(np.arange(sets, dtype=np.int64), 2) * 40 * MS + 5 * MS,
            "tip_dz_m": np.arange(2.0 * sets),
            "iterations": np.arange(2 * sets),
        }
    )


def test_signals_stand_beside_the_tip():
    table = Beside(SIGNALS).joined(frames())
    assert table.column_names[:5] == frames().column_names
    assert table.column("load_factor").to_pylist() == pytest.approx([1.005, 1.045, 1.085, 1.125] * 2)
    assert table.column("load_factor_gap_s").to_pylist() == pytest.approx([0.01] * 8)
    assert table.column("gates_failing").to_pylist() == ["", "", "ptp.state", "ptp.state"] * 2
    assert table.column("iterations").to_pylist() == list(range(8))
    assert table.column("iterations_signal").to_pylist() == pytest.approx([1.005, 1.045, 1.085, 1.125] * 2)
    assert "iterations_signal_gap_s" in table.column_names


def test_the_file_beside_a_marker_table_gives_the_same(tmp_path):
    markers = tmp_path / "markers.parquet"
    assert beside_markers(markers) is None
    whole = frames(6)
    kept = signal_table(whole.select(["trigger_index", "side", "timestamp_ns"]), SIGNALS).slice(0, 9)
    shuffled = kept.take(np.random.default_rng(1).permutation(9))
    pq.write_table(shuffled, tmp_path / "markers_signals.parquet")
    beside = beside_markers(markers)
    assert beside is not None
    joined, expected = beside.joined(whole), Beside(SIGNALS).joined(whole)
    assert joined.slice(0, 9).equals(expected.slice(0, 9))
    assert np.isnan(joined.column("load_factor").to_pylist()[9:]).all()
    assert set(joined.column("signals_missing").to_pylist()[9:]) == {"the set is not in the table of signals"}
