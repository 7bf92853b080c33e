"""A result folder, as `reconstruct run` leaves it → the arrays a report is made from."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute

from capture.errors import UsageError
from process.signal_table import GAP
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
    Words,
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

_FRAME_NUMBERS = (
    *TIP_COLUMNS,
    *(f"sigma_{name}" for name in TIP_COLUMNS),
    *NET_COLUMNS,
    *(f"sigma_{name}" for name in NET_COLUMNS),
    "residual_rms_mm",
    "chi2_per_dof",
    "markers_used",
    "iterations",
)


@dataclass(frozen=True)
class SideResult:
    """One half wing's result, dense over F sets; the rows of all arrays belong together."""

    shape: ShapeSeries
    unloaded_xyz_m: Floats  # (S, 3) body frame
    reference_xyz_m: Floats  # (S, 3) what displacements are counted from, body frame
    reference_twist_deg: Floats  # (S,) its twist against the unloaded wing
    markers: MarkerSeries
    frames: Mapping[str, Floats]  # column of frames.parquet → (F,)
    reasons: Words  # (F,) str, why a set could not be fitted
    residual_marker: Ints  # (R,) the wing file's markers; ``markers`` has those of the marker table
    residual_m: Floats  # (F, R, 3) measured minus fitted at the set's common instant; NaN where not used
    signals: Mapping[str, Floats]  # what was recorded beside the frames, by its column of frames.parquet → (F,)


@dataclass(frozen=True)
class SideErrors:
    """One half wing's errors against a reference, result minus reference, body frame; NaN where not comparable."""

    timestamp_ns: Ints  # (F,)
    shape_m: Floats  # (F, S, 3)
    twist_deg: Floats  # (F, S)
    marker_m: Floats  # (F, M, 3)


@dataclass(frozen=True)
class Result:
    """What a report is made from."""

    folder: Path
    summary: Mapping[str, Any]
    sides: Mapping[str, SideResult]
    comparison: Mapping[str, Any] | None = None
    errors: Mapping[str, SideErrors] = field(default_factory=dict)

    @property
    def reference(self) -> str:
        """What displacements are counted from."""
        return str(self.summary.get("reference", "unloaded wing"))

    @property
    def start_ns(self) -> int:
        """The first set's instant."""
        return min(int(side.shape.timestamp_ns[0]) for side in self.sides.values())


def read_result(folder: Path, comparison: Path | None = None) -> Result:
    """The result in ``folder``; with ``comparison`` (a comparison.json) also the errors that lie beside that file.

    Raises UsageError naming the file that is missing, not whole, or does not belong to this result.
    """
    if not folder.is_dir():
        raise UsageError(f"{folder}: no such folder; give a result of `reconstruct run`")
    summary = read_json_object(folder / SUMMARY, "give a result of `reconstruct run`")
    markers = marker_series(read_table(folder / MARKERS, ()), str(folder / MARKERS))
    shapes = shape_series(read_table(folder / SHAPE, ()), str(folder / SHAPE))
    frames = read_table(folder / FRAMES, ("trigger_index", "side", "reason", *_FRAME_NUMBERS))
    residuals = read_table(folder / RESIDUALS, ("trigger_index", "side", "marker", "used", *RESIDUAL))
    unloaded = read_table(folder / UNLOADED, ("side", *POSITION, *REFERENCE_POSITION, "reference_twist_deg"))
    sides = {}
    for side, shape in shapes.items():
        if side not in markers:
            raise UsageError(f"{folder / MARKERS}: has no {side} wing, {SHAPE} has")
        sides[side] = _side(folder, shape, markers[side], frames, residuals, unloaded)
    if comparison is None:
        return Result(folder, summary, sides)
    compared = read_json_object(comparison, "run `reconstruct compare` first")
    errors = _read_errors(comparison.parent, sides)
    return Result(folder, summary, sides, compared, errors)


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


def _side(
    folder: Path, shape: ShapeSeries, markers: MarkerSeries, frames: pa.Table, residuals: pa.Table, unloaded: pa.Table
) -> SideResult:
    side, sets = shape.side, shape.trigger_index.size
    if not np.array_equal(markers.trigger_index, shape.trigger_index):
        raise UsageError(f"{folder / MARKERS}: does not have the triggers of {SHAPE}")
    per_set = np.unique(_of_side(residuals, side).column("marker").to_numpy())
    residual = _dense(residuals, side, (*RESIDUAL, "used"), (sets, per_set.size, 4), folder / RESIDUALS)
    return SideResult(
        shape,
        _dense(unloaded, side, POSITION, (shape.s_m.size, 3), folder / UNLOADED),
        _dense(unloaded, side, REFERENCE_POSITION, (shape.s_m.size, 3), folder / UNLOADED),
        _dense(unloaded, side, ("reference_twist_deg",), (shape.s_m.size,), folder / UNLOADED),
        markers,
        {name: _dense(frames, side, (name,), (sets,), folder / FRAMES) for name in _FRAME_NUMBERS},
        np.array(_of_side(frames, side).column("reason").to_pylist(), dtype=object),
        per_set.astype(np.int64),
        np.where(residual[..., 3:] > 0, residual[..., :3], np.nan),
        {name: _dense(frames, side, (name,), (sets,), folder / FRAMES) for name in signal_names(frames)},
    )


def _of_side(table: pa.Table, side: str) -> pa.Table:
    return table.filter(pyarrow.compute.equal(table.column("side"), side))


def _dense(table: pa.Table, side: str, names: tuple[str, ...], shape: tuple[int, ...], path: Path) -> Floats:
    """The side's rows, in the order they were written in, as an array of ``shape``."""
    mine = _of_side(table, side)
    values = np.stack(
        [np.asarray(mine.column(name).to_numpy(zero_copy_only=False), dtype=np.float64) for name in names], axis=-1
    )
    if values.size != int(np.prod(shape)):
        raise UsageError(f"{path}: does not have the {side} wing's rows that {SHAPE} and {MARKERS} ask for")
    return values.reshape(shape)


def _read_errors(folder: Path, sides: Mapping[str, SideResult]) -> dict[str, SideErrors]:
    xyz = ("error_x_m", "error_y_m", "error_z_m")
    shape_errors = read_table(folder / SHAPE_ERRORS, ("side", *xyz, "error_twist_deg"))
    marker_errors = read_table(folder / MARKER_ERRORS, ("side", *xyz))
    errors = {}
    for side, result in sides.items():
        if side not in shape_errors.column("side").to_pylist():
            continue
        shape = result.shape.twist_deg.shape
        errors[side] = SideErrors(
            result.shape.timestamp_ns,
            _dense(shape_errors, side, xyz, (*shape, 3), folder / SHAPE_ERRORS),
            _dense(shape_errors, side, ("error_twist_deg",), shape, folder / SHAPE_ERRORS),
            _dense(marker_errors, side, xyz, (*result.markers.seen.shape, 3), folder / MARKER_ERRORS),
        )
    return errors
