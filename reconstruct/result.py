"""A result folder, as `reconstruct run` leaves it → what a report is made from, in bounded memory.

Tables with several rows a set are read a row group at a time: summed up over the flight, and kept of the sets shown.
"""

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from capture.errors import UsageError
from process.signal_table import GAP
from reconstruct.shown import Heights, Shown, choose
from reconstruct.tables import (
    FRAMES,
    MARKERS,
    NET_COLUMNS,
    POSITION,
    REFERENCE_POSITION,
    RESIDUAL,
    RESIDUALS,
    SHAPE,
    TIP_COLUMNS,
    UNLOADED,
    Floats,
    Ints,
    MarkerSeries,
    ShapeSeries,
    marker_series,
    read_table,
    shape_series,
)

SUMMARY = "summary.json"
COMPARISON = "comparison.json"
SHAPE_ERRORS = "shape_errors.parquet"
MARKER_ERRORS = "marker_errors.parquet"
REPORT = "report.html"
FIGURES = "figures"
PARTS_OF_FLIGHT = 160  # at most, that health is told of, equally long

_FRAME_NUMBERS = (
    *TIP_COLUMNS,
    *(f"sigma_{name}" for name in TIP_COLUMNS),
    *NET_COLUMNS,
    *(f"sigma_{name}" for name in NET_COLUMNS),
    "residual_rms_mm",
    "chi2_per_dof",
    "markers_used",
    "iterations",
    "time_sigma_ns",
)
_FRAME_WORDS = ("flags", "reason", "ptp_state", "gates_failing", "signals_missing")
_KEYS = ("trigger_index", "side")
_ERROR = ("error_x_m", "error_y_m", "error_z_m")


@dataclass(frozen=True)
class MarkerHealth:
    """How M markers were measured, over all sets of one wing and in P equal parts of the flight."""

    marker: Ints  # (M,) identities, ascending
    seen_percent: Floats  # (M,)
    seen_in_time_percent: Floats  # (P, M) NaN where there are no sets
    flags: Mapping[str, int]  # flag → rows
    rows: int


@dataclass(frozen=True)
class Residuals:
    """How R markers agree with the wing fitted to them: RMS distance, NaN where none was used."""

    marker: Ints  # (R,) the wing file's markers
    rms_m: Floats  # (R,)
    in_time_m: Floats  # (P, R)


@dataclass(frozen=True)
class SideSample:
    """The K sets of one wing that are shown; the rows of all arrays belong together."""

    shape: ShapeSeries
    markers: MarkerSeries
    residual_m: Floats  # (K, R, 3) measured minus fitted at the set's common instant; NaN where not used

    def rows(self, trigger_index: Ints) -> Ints:
        """(n,) the rows of some triggers; −1 where this wing has no set of one."""
        own = self.shape.trigger_index
        at = np.clip(np.searchsorted(own, trigger_index), 0, own.size - 1)
        return np.where(own[at] == trigger_index, at, -1)


@dataclass(frozen=True)
class SideResult:
    """One half wing's result of F sets; single shapes only of those that are shown."""

    trigger_index: Ints  # (F,) ascending
    timestamp_ns: Ints  # (F,)
    s_m: Floats  # (S,)
    unloaded_xyz_m: Floats  # (S, 3) body frame
    reference_xyz_m: Floats  # (S, 3) what displacements are counted from, body frame
    reference_twist_deg: Floats  # (S,) its twist against the unloaded wing
    frames: Mapping[str, Floats]  # column of frames.parquet → (F,)
    signals: Mapping[str, Floats]  # what was recorded beside the frames, by its column of frames.parquet → (F,)
    words: Mapping[str, Mapping[str, int]]  # flags, reason, ptp_state, … of frames.parquet → word → sets
    z_range_m: Floats  # (2, S) lowest and highest of all fitted sets
    twist_range_deg: Floats  # (2, S)
    health: MarkerHealth
    residuals: Residuals
    sample: SideSample


@dataclass(frozen=True)
class SideErrors:
    """One half wing's errors against a reference, result minus reference; NaN where not comparable."""

    timestamp_ns: Ints  # (F,)
    shape_rms_m: Floats  # (F,) over the stations, 3-D
    tip_m: Floats  # (F,)
    twist_rms_deg: Floats  # (F,)
    along_rms_m: Floats  # (S,) over the sets, 3-D
    along_twist_rms_deg: Floats  # (S,)
    marker: Ints  # (M,)
    marker_rms_m: Floats  # (M,)


@dataclass(frozen=True)
class Result:
    """What a report is made from."""

    folder: Path
    summary: Mapping[str, Any]
    sides: Mapping[str, SideResult]
    shown: Shown
    comparison: Mapping[str, Any] | None = None
    errors: Mapping[str, SideErrors] = field(default_factory=dict)

    @property
    def reference(self) -> str:
        """What displacements are counted from."""
        return str(self.summary.get("reference", "unloaded wing"))

    @property
    def start_ns(self) -> int:
        """The first set's instant."""
        return min(int(side.timestamp_ns[0]) for side in self.sides.values())

    @property
    def end_ns(self) -> int:
        """The last set's instant."""
        return max(int(side.timestamp_ns[-1]) for side in self.sides.values())


def read_result(folder: Path, comparison: Path | None = None) -> Result:
    """The result in ``folder``; with ``comparison`` (a comparison.json) also the errors that lie beside that file.

    Raises UsageError naming the file that is missing, not whole, or does not belong to this result.
    """
    if not folder.is_dir():
        raise UsageError(f"{folder}: no such folder; give a result of `reconstruct run`")
    summary = read_json_object(folder / SUMMARY, "give a result of `reconstruct run`")
    frames = read_table(folder / FRAMES, (*_KEYS, "timestamp_ns", *_FRAME_NUMBERS, *_FRAME_WORDS[:3]))
    unloaded = read_table(folder / UNLOADED, ("side", "s_m", *POSITION, *REFERENCE_POSITION, "reference_twist_deg"))
    found = [side for side in ("left", "right") if side in pc.unique(frames.column("side")).to_pylist()]
    own = {side: _of_side(frames, side) for side in found}
    shown = choose({side: Heights(*_columns(table, *_HEIGHTS)) for side, table in own.items()})
    cut = _Cut.of(frames)
    sides = {side: _side(folder, side, table, _of_side(unloaded, side), shown, cut) for side, table in own.items()}
    if comparison is None:
        return Result(folder, summary, sides, shown)
    compared = read_json_object(comparison, "run `reconstruct compare` first")
    return Result(folder, summary, sides, shown, compared, _read_errors(comparison.parent, sides))


def read_json_object(path: Path, remedy: str) -> dict[str, Any]:
    """The object in a JSON file. Raises UsageError, ending in ``remedy``, when there is none."""
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}; {remedy}") from error
    except ValueError as error:
        raise UsageError(f"{path}: not a whole JSON file; {remedy}") from error
    if not isinstance(value, dict):
        raise UsageError(f"{path}: not a JSON object; {remedy}")
    return value


def signal_names(frames: pa.Table) -> list[str]:
    """The signals in a frames table: the columns that state the gap they were interpolated over in another."""
    return [name for name in frames.column_names if name + GAP in frames.column_names]


def pieces(path: Path, columns: Sequence[str] | None, side: str | None = None) -> Iterator[pa.Table]:
    """The rows of a table, of one wing if ``side`` is given, a row group at a time.

    Raises UsageError when it is missing, unreadable, or lacks one of ``columns`` (None: all).
    """
    if not path.is_file():
        raise UsageError(f"{path}: no such table")
    try:
        with pq.ParquetFile(path) as file:
            for column in columns or ():
                if column not in file.schema_arrow.names:
                    raise UsageError(f"{path}: lacks the column {column} (see docs/reference/formats.md)")
            for number in range(file.num_row_groups):
                wanted = None if columns is None else [*dict.fromkeys((*columns, "side"))]
                piece = file.read_row_group(number, columns=wanted)
                yield piece if side is None else _of_side(piece, side)
    except (pa.ArrowException, OSError) as error:
        raise UsageError(f"{path}: not a readable Parquet file ({str(error).splitlines()[0]})") from error


_HEIGHTS = ("trigger_index", "timestamp_ns", "tip_dz_m")


def _side(folder: Path, side: str, frames: pa.Table, unloaded: pa.Table, shown: Shown, cut: "_Cut") -> SideResult:
    trigger, time_ns = _columns(frames, "trigger_index", "timestamp_ns")
    sample = _sample(folder, side, shown.triggers(side))
    parts = _Parts(trigger, time_ns, cut)
    low, high = _ranges(folder / SHAPE, side, unloaded.num_rows)
    reference_twist = _columns(unloaded, "reference_twist_deg")[0]
    s_m = _columns(unloaded, "s_m")[0]
    if s_m.size != sample.shape.s_m.size:
        raise UsageError(f"{folder / UNLOADED}: does not have the {side} wing's stations of {SHAPE}")
    return SideResult(
        trigger,
        time_ns,
        s_m,
        np.stack(_columns(unloaded, *POSITION), axis=-1),
        np.stack(_columns(unloaded, *REFERENCE_POSITION), axis=-1),
        reference_twist,
        {name: _columns(frames, name)[0].astype(np.float64) for name in _FRAME_NUMBERS},
        {name: _columns(frames, name)[0].astype(np.float64) for name in signal_names(frames)},
        {
            name: counted(frames.column(name), listed=name != "reason")
            for name in _FRAME_WORDS
            if name in frames.column_names
        },
        np.stack([low[0], high[0]]),
        np.stack([low[1], high[1]]),
        _health(folder / MARKERS, side, parts),
        _residuals(folder / RESIDUALS, side, parts),
        sample,
    )


@dataclass(frozen=True)
class _Cut:
    """How a flight is cut into equal parts."""

    begin_ns: int
    length_ns: int
    count: int

    @classmethod
    def of(cls, frames: pa.Table) -> "_Cut":
        """A part has two sets at least, if none are missing."""
        times = frames.column("timestamp_ns").to_numpy()
        count = max(1, min(PARTS_OF_FLIGHT, np.unique(times).size // 2))
        return cls(int(times.min()), max(1, int(np.ptp(times))), count)


class _Parts:
    """Which part of the flight each set of a wing belongs to."""

    def __init__(self, trigger: Ints, time_ns: Ints, cut: _Cut) -> None:
        self.trigger = trigger
        self._of_set = np.minimum((time_ns - cut.begin_ns) * cut.count // cut.length_ns, cut.count - 1)
        self.sets = np.bincount(self._of_set, minlength=cut.count)

    def of(self, triggers: Ints) -> Ints:
        """(n,) of some triggers' sets."""
        return np.asarray(self._of_set[np.clip(np.searchsorted(self.trigger, triggers), 0, self.trigger.size - 1)])


def _sample(folder: Path, side: str, triggers: Ints) -> SideSample:
    """The sets shown, read whole."""
    tables = {}
    for name in (SHAPE, MARKERS, RESIDUALS):
        kept = [_rows_of(piece, triggers) for piece in pieces(folder / name, None, side)]
        if not kept or not sum(piece.num_rows for piece in kept):
            raise UsageError(f"{folder / name}: has no {side} wing, {FRAMES} has")
        tables[name] = pa.concat_tables(kept)
    shape = shape_series(tables[SHAPE], str(folder / SHAPE))[side]
    markers = marker_series(tables[MARKERS], str(folder / MARKERS))[side]
    if not np.array_equal(markers.trigger_index, shape.trigger_index):
        raise UsageError(f"{folder / MARKERS}: does not have the triggers of {SHAPE}")
    trigger, marker, used, *xyz = _columns(tables[RESIDUALS], "trigger_index", "marker", "used", *RESIDUAL)
    known = np.unique(marker)
    residual = np.full((shape.trigger_index.size, known.size, 3), np.nan)
    place = np.searchsorted(shape.trigger_index, trigger), np.searchsorted(known, marker)
    residual[place] = np.where(used[:, None] > 0, np.stack(xyz, axis=-1), np.nan)
    return SideSample(shape, markers, residual)


def _rows_of(piece: pa.Table, triggers: Ints) -> pa.Table:
    return piece.filter(pc.is_in(piece.column("trigger_index"), pa.array(triggers)))


def _ranges(path: Path, side: str, stations: int) -> tuple[Floats, Floats]:
    """Lowest and highest z (m) and twist (degrees) of every station: (2, S) each; NaN where no set was fitted."""
    low, high = np.full((2, stations), np.inf), np.full((2, stations), -np.inf)
    for piece in pieces(path, ("station", "z_m", "twist_deg"), side):
        station, *values = _columns(piece, "station", "z_m", "twist_deg")
        if station.size and int(station.max()) >= stations:
            raise UsageError(f"{path}: has more stations of the {side} wing than {UNLOADED}")
        for row, value in enumerate(values):
            np.fmin.at(low[row], station, value)
            np.fmax.at(high[row], station, value)
    return np.where(np.isfinite(low), low, np.nan), np.where(np.isfinite(high), high, np.nan)


def _health(path: Path, side: str, parts: _Parts) -> MarkerHealth:
    sums = _MarkerSums(parts.sets.size)
    flags: Counter[str] = Counter()
    rows = 0
    for piece in pieces(path, ("trigger_index", "marker", *POSITION, "flags"), side):
        trigger, marker, *xyz = _columns(piece, "trigger_index", "marker", *POSITION)
        sums.add(marker, parts.of(trigger), np.isfinite(np.stack(xyz)).all(axis=0).astype(np.float64))
        flags.update(counted(piece.column("flags")))
        rows += piece.num_rows
    marker, seen = sums.whole()
    whole = parts.trigger.size * marker.size
    flags["not_seen"] += whole - rows  # a set without a row for a marker did not see it either
    with np.errstate(invalid="ignore"):
        in_time = 100.0 * seen / np.where(parts.sets > 0, parts.sets, np.nan)[:, None]
    return MarkerHealth(marker, 100.0 * seen.sum(axis=0) / parts.trigger.size, in_time, +flags, whole)


def _residuals(path: Path, side: str, parts: _Parts) -> Residuals:
    squares, counts = (_MarkerSums(parts.sets.size) for _ in range(2))
    for piece in pieces(path, ("trigger_index", "marker", "used", *RESIDUAL), side):
        trigger, marker, used, *xyz = _columns(piece, "trigger_index", "marker", "used", *RESIDUAL)
        distance2 = np.sum(np.square(np.stack(xyz)), axis=0)
        known = np.isfinite(distance2) & (used > 0)
        part = parts.of(trigger)
        squares.add(marker, part, np.where(known, distance2, 0.0))
        counts.add(marker, part, known.astype(np.float64))
    marker, total = squares.whole()
    count = counts.whole()[1]
    return Residuals(marker, _root(total.sum(axis=0), count.sum(axis=0)), _root(total, count))


class _MarkerSums:
    """Sums by marker and part of the flight."""

    def __init__(self, parts: int) -> None:
        self._parts = parts
        self._sums: dict[int, Any] = {}

    def add(self, marker: Ints, part: Ints, value: Floats) -> None:
        for one in np.unique(marker).tolist():
            own = marker == one
            self._sums[one] = self._sums.get(one, 0.0) + np.bincount(part[own], value[own], self._parts)

    def whole(self) -> tuple[Ints, Floats]:
        """Markers (M,), and sums (P, M)."""
        markers = sorted(self._sums)
        return np.array(markers, dtype=np.int64), np.stack([self._sums[one] for one in markers], axis=-1)


def _read_errors(folder: Path, sides: Mapping[str, SideResult]) -> dict[str, SideErrors]:
    errors = {}
    for name, side in sides.items():
        trigger, stations = side.trigger_index, side.s_m.size
        sums = np.zeros((2, 2, trigger.size)), np.zeros((2, 2, stations))  # of position and twist: squares, count
        tip = np.full(trigger.size, np.nan)
        for piece in pieces(folder / SHAPE_ERRORS, ("trigger_index", "station", *_ERROR, "error_twist_deg"), name):
            index, station, *xyz, twist = _columns(piece, "trigger_index", "station", *_ERROR, "error_twist_deg")
            at = np.searchsorted(trigger, index)
            distance2 = np.sum(np.square(np.stack(xyz)), axis=0)
            tip[at[station == stations - 1]] = np.sqrt(distance2[station == stations - 1])
            for row, square in enumerate((distance2, twist**2)):
                known = np.isfinite(square)
                for total, place in zip(sums, (at, station), strict=True):
                    total[row, 0] += np.bincount(place[known], square[known], total.shape[2])
                    total[row, 1] += np.bincount(place[known], minlength=total.shape[2])
        if not sums[0].any():
            continue  # the reference has not got this wing
        squares, counts = _MarkerSums(1), _MarkerSums(1)
        for piece in pieces(folder / MARKER_ERRORS, ("trigger_index", "marker", *_ERROR), name):
            marker, *xyz = _columns(piece, "marker", *_ERROR)
            distance2 = np.sum(np.square(np.stack(xyz)), axis=0)
            known = np.isfinite(distance2)
            squares.add(marker, np.zeros_like(marker), np.where(known, distance2, 0.0))
            counts.add(marker, np.zeros_like(marker), known.astype(np.float64))
        marker, total = squares.whole()
        marker_rms = _root(total.sum(axis=0), counts.whole()[1].sum(axis=0))
        (shape, twist), (along, along_twist) = (_root(total[:, 0], total[:, 1]) for total in sums)
        errors[name] = SideErrors(side.timestamp_ns, shape, tip, twist, along, along_twist, marker, marker_rms)
    return errors


def counted(words: pa.ChunkedArray, *, listed: bool = True) -> Counter[str]:
    """How often each word occurs, not counting empty ones; ``listed``: there may be several, with commas between."""
    found: Counter[str] = Counter()
    for entry in pc.value_counts(words.combine_chunks()).to_pylist():
        text = entry["values"] or ""
        for word in text.split(",") if listed else [text]:
            if word:
                found[word] += entry["counts"]
    return found


def _of_side(table: pa.Table, side: str) -> pa.Table:
    return table.filter(pc.equal(table.column("side"), side))


def _columns(table: pa.Table, *names: str) -> list[Any]:
    return [table.column(name).to_numpy() for name in names]


def _root(squares: Floats, count: Floats) -> Floats:
    return np.asarray(np.sqrt(np.where(count > 0, squares / np.maximum(count, 1), np.nan)))
