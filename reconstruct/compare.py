"""A result folder and a reference folder (truth, simulation, another result) → the errors of the result."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from scipy.interpolate import CubicSpline

from capture.errors import UsageError
from process.json_file import finite_or_none
from process.reference import Window
from reconstruct.tables import (
    FRAMES,
    MARKER_COLUMNS,
    MARKERS,
    SHAPE,
    SHAPE_COLUMNS,
    Bools,
    Floats,
    Ints,
    MarkerSeries,
    ShapeSeries,
    marker_series,
    marker_tracks,
    read_table,
    shape_series,
)

WITHIN_95 = 1.959964  # a normal error is within this many sigmas 95 times in 100
REFERENCE_GAP = 4.0  # a step this many times the median step is a hole in the reference, not to be interpolated across
SPAN_TOLERANCE = 1e-6  # of the span: stations this far beyond the reference's last one still lie on it


@dataclass(frozen=True)
class Comparison:
    """Errors are result minus reference, body frame."""

    summary: dict[str, Any]  # what comparison.json holds; docs/explanation/errors-defined.md defines each key
    shape_errors: pa.Table  # one row a trigger, side and station
    marker_errors: pa.Table  # one row a trigger, side and marker


@dataclass(frozen=True)
class _ShapeErrors:
    series: ShapeSeries
    inside: Bools  # (F,) the set's instant lies in the reference's time
    xyz_m: Floats  # (F, S, 3)
    twist_deg: Floats  # (F, S)


@dataclass(frozen=True)
class _MarkerErrors:
    series: MarkerSeries
    inside: Bools  # (F, M)
    xyz_m: Floats  # (F, M, 3)


def compare(result: Path, reference: Path, *, from_start: bool = False, window: Window | None = None) -> Comparison:
    """Compare the folder ``result`` with the folder ``reference``.

    The reference is interpolated by cubic splines: in time to the result's instants (each marker's own, and each
    set's common one), and along the span to the result's stations. Instants before, after or in a gap of the
    reference and stations beyond its end are counted and left out. A reference without markers is compared by its
    shape.

    Args:
        result: of `reconstruct run`.
        reference: truth, simulation or another result.
        from_start: each counts time from its first set: two flights, or a simulation with a time of its own.
        window: seconds of the result in which the wing is at rest: what its displacements from there are off by too.

    Raises:
        UsageError: a folder or table is missing or cannot be used, the two are in the wrong order, or nothing of them
            overlaps.
    """
    _check_folders(result, reference)
    shape_file, marker_file = str(reference / SHAPE), str(reference / MARKERS)
    shapes = shape_series(read_table(result / SHAPE, (), SHAPE_COLUMNS), str(result / SHAPE))
    true_shapes = shape_series(read_table(reference / SHAPE, (), SHAPE_COLUMNS), shape_file, reference=True)
    start_ns = min(int(one.timestamp_ns[0]) for one in shapes.values())
    later_ns = start_ns - min(int(one.timestamp_ns[0]) for one in true_shapes.values()) if from_start else 0
    true_shapes = {side: replace(one, timestamp_ns=one.timestamp_ns + later_ns) for side, one in true_shapes.items()}
    shape = [_shape_errors(shapes[side], true_shapes[side], shape_file) for side in shapes if side in true_shapes]
    markers = marker_series(read_table(result / MARKERS, (), MARKER_COLUMNS), str(result / MARKERS))
    tracks = _tracks(reference / MARKERS, later_ns)
    marker = [_marker_errors(markers[side], tracks.get(side, {}), marker_file) for side in markers]
    if not any(np.isfinite(errors.xyz_m).any() for errors in shape):
        raise UsageError(
            f"{reference}: has no set at the time of a fitted set of {result}; are both of the same flight? If not, "
            "--from-start counts both times from their first sets"
        )
    summary = {
        "result": str(result),
        "reference": str(reference),
        **_shape_summary(shape),
        **_displacement_summary(shape, window, start_ns),
        **_marker_summary(marker),
        "sides": {errors.series.side: _shape_summary([errors]) for errors in shape},
    }
    return Comparison(summary, _shape_table(shape), _marker_table(marker))


def _check_folders(result: Path, reference: Path) -> None:
    for folder in (result, reference):
        if not folder.is_dir():
            raise UsageError(f"{folder}: no such folder; give a result of `reconstruct run` and a reference like it")
    if (reference / FRAMES).is_file() and not (result / FRAMES).is_file():
        raise UsageError(
            f"{result}: is no result of `reconstruct run`, {reference} is one: the result comes first "
            "(reconstruct compare RESULT REFERENCE)"
        )


def _tracks(path: Path, later_ns: int) -> dict[str, dict[int, tuple[Ints, Floats]]]:
    if not path.is_file():
        return {}  # a simulation's shapes alone
    found = marker_tracks(read_table(path, (), MARKER_COLUMNS), str(path))
    return {
        side: {marker: (times_ns + later_ns, xyz_m) for marker, (times_ns, xyz_m) in tracks.items()}
        for side, tracks in found.items()
    }


def _displacement_summary(shape: list[_ShapeErrors], window: Window | None, start_ns: int) -> dict[str, Any]:
    """Errors of displacements from the mean over ``window``: what is the same there and later cancels."""
    if window is None:
        return {}
    xyz, twist = [], []
    for one in shape:
        since_s = (one.series.timestamp_ns - start_ns) * 1e-9
        chosen = (since_s >= window.begin_s) & (since_s <= window.end_s) & np.isfinite(one.xyz_m[:, 0, 0])
        if not chosen.any():
            raise UsageError(
                f"--reference-window {window.begin_s:g}:{window.end_s:g}: no set of the {one.series.side} wing can be "
                "compared in it"
            )
        xyz.append((one.xyz_m - one.xyz_m[chosen].mean(axis=0)).reshape(-1, 3))
        twist.append((one.twist_deg - one.twist_deg[chosen].mean(axis=0)).ravel())
    return {
        "displacement_rms_mm": _rms_mm(np.concatenate(xyz)),
        "displacement_twist_rms_deg": _rms(np.concatenate(twist)),
    }


def interpolate_shape(series: ShapeSeries, timestamp_ns: Ints, s_m: Floats, name: str) -> tuple[Floats, Floats]:
    """Positions (F, S, 3) in m and twist (F, S) in degrees of ``series`` at other instants and stations.

    Cubic splines in time, then along the span; NaN outside of either, and in gaps of the time. ``name`` is for
    UsageError, raised when the series has fewer than two sets.
    """
    state = np.concatenate([series.xyz_m, series.twist_deg[..., None]], axis=-1)
    whole = np.isfinite(state).all(axis=(1, 2))
    moved = _in_time(series.timestamp_ns[whole], state[whole], timestamp_ns, f"{name}: {series.side} wing")
    along = np.full((timestamp_ns.size, s_m.size, 4), np.nan)
    slack = SPAN_TOLERANCE * series.s_m[-1]
    covered = (s_m >= series.s_m[0] - slack) & (s_m <= series.s_m[-1] + slack)
    known = np.isfinite(moved).all(axis=(1, 2))
    if known.any() and covered.any():
        spline = CubicSpline(series.s_m, moved[known], axis=1)
        along[np.ix_(known, covered)] = spline(np.clip(s_m[covered], series.s_m[0], series.s_m[-1]))
    return along[..., :3], along[..., 3]


def _in_time(sample_ns: Ints, samples: Floats, wanted_ns: Ints, name: str) -> Floats:
    """Cubic spline through ``samples`` (n, …) at ``wanted_ns``; NaN outside of the samples and in their gaps."""
    if sample_ns.size < 2:
        raise UsageError(f"{name}: needs at least two sets in time (write a wing at rest twice)")
    step = np.diff(sample_ns)
    inside = (wanted_ns >= sample_ns[0]) & (wanted_ns <= sample_ns[-1])
    interval = np.clip(np.searchsorted(sample_ns, wanted_ns, side="right") - 1, 0, step.size - 1)
    inside &= step[interval] <= REFERENCE_GAP * np.median(step)
    values = np.full((wanted_ns.size, *samples.shape[1:]), np.nan)
    if inside.any():
        spline = CubicSpline((sample_ns - sample_ns[0]) * 1e-9, samples, axis=0)
        values[inside] = spline((wanted_ns[inside] - sample_ns[0]) * 1e-9)
    return values


def _shape_errors(result: ShapeSeries, reference: ShapeSeries, name: str) -> _ShapeErrors:
    xyz, twist = interpolate_shape(reference, result.timestamp_ns, result.s_m, name)
    inside = np.isfinite(xyz).all(axis=-1).any(axis=-1)
    return _ShapeErrors(result, np.asarray(inside), result.xyz_m - xyz, result.twist_deg - twist)


def _marker_errors(result: MarkerSeries, tracks: Mapping[int, tuple[Ints, Floats]], name: str) -> _MarkerErrors:
    true = np.full_like(result.xyz_m, np.nan)
    for column, marker in enumerate(result.marker):
        if int(marker) in tracks:
            place = f"{name}: {result.side} wing, marker {marker}"
            true[:, column] = _in_time(*tracks[int(marker)], result.timestamp_ns[:, column], place)
    return _MarkerErrors(result, np.asarray(np.isfinite(true).all(axis=-1)), result.xyz_m - true)


def _shape_summary(errors: list[_ShapeErrors]) -> dict[str, Any]:
    """Figures over the sets of all sides in ``errors``; see docs/explanation/errors-defined.md."""
    fitted = [np.isfinite(one.series.xyz_m).all(axis=(1, 2)) for one in errors]
    xyz = np.concatenate([one.xyz_m.reshape(-1, 3) for one in errors])
    tip = np.concatenate([one.xyz_m[:, -1] for one in errors])
    twist = np.concatenate([one.twist_deg.reshape(-1) for one in errors])
    tip_twist = np.concatenate([one.twist_deg[:, -1] for one in errors])
    sigma = np.concatenate([one.series.sigma_xyz_m.reshape(-1, 3) for one in errors])
    tip_sigma = np.concatenate([one.series.sigma_xyz_m[:, -1] for one in errors])
    twist_sigma = np.concatenate([one.series.sigma_twist_deg.reshape(-1) for one in errors])
    tip_twist_sigma = np.concatenate([one.series.sigma_twist_deg[:, -1] for one in errors])
    return {
        "frames_compared": sum(int((one.inside & ok).sum()) for one, ok in zip(errors, fitted, strict=True)),
        "frames_outside_reference": sum(int((~one.inside).sum()) for one in errors),
        "frames_not_fitted": sum(int((one.inside & ~ok).sum()) for one, ok in zip(errors, fitted, strict=True)),
        "shape_rms_mm": _rms_mm(xyz),
        "shape_p95_mm": _p95_mm(xyz),
        "shape_max_mm": _max_mm(xyz),
        "shape_bias_mm": _bias_mm(xyz),
        "shape_within_95_percent": _within(xyz, sigma),
        "tip_error_mm": _rms_mm(tip),
        "tip_p95_mm": _p95_mm(tip),
        "tip_max_mm": _max_mm(tip),
        "tip_bias_mm": _bias_mm(tip),
        "tip_within_95_percent": _within(tip, tip_sigma),
        "twist_rms_deg": _rms(twist),
        "twist_bias_deg": _mean(twist),
        "twist_within_95_percent": _within(twist, twist_sigma),
        "tip_twist_rms_deg": _rms(tip_twist),
        "tip_twist_bias_deg": _mean(tip_twist),
        "tip_twist_within_95_percent": _within(tip_twist, tip_twist_sigma),
    }


def _marker_summary(errors: list[_MarkerErrors]) -> dict[str, Any]:
    xyz = np.concatenate([one.xyz_m.reshape(-1, 3) for one in errors]) if errors else np.empty((0, 3))
    sigma = [np.sqrt(np.diagonal(one.series.cov_m2, axis1=-2, axis2=-1)).reshape(-1, 3) for one in errors]
    per_marker = [
        {
            "side": one.series.side,
            "marker": int(marker),
            "compared": int(np.isfinite(one.xyz_m[:, column]).all(axis=-1).sum()),
            "rms_mm": _rms_mm(one.xyz_m[:, column]),
            "bias_mm": _bias_mm(one.xyz_m[:, column]),
            "spread_mm": _spread_mm(one.xyz_m[:, column]),
        }
        for one in errors
        for column, marker in enumerate(one.series.marker)
    ]
    return {
        "markers_compared": int(np.isfinite(xyz).all(axis=-1).sum()),
        "markers_outside_reference": sum(int((one.series.seen & ~one.inside).sum()) for one in errors),
        "marker_rms_mm": _rms_mm(xyz),
        "marker_mean_mm": _mean(1e3 * np.linalg.norm(xyz, axis=-1)),
        "marker_p95_mm": _p95_mm(xyz),
        "marker_max_mm": _max_mm(xyz),
        "marker_bias_mm": _bias_mm(xyz),
        "marker_within_95_percent": _within(xyz, np.concatenate(sigma)) if errors else None,
        "markers": per_marker,
    }


def _rms(values: Floats) -> float | None:
    values = values[np.isfinite(values)]
    return finite_or_none(float(np.sqrt(np.mean(values**2)))) if values.size else None


def _mean(values: Floats) -> float | None:
    values = values[np.isfinite(values)]
    return finite_or_none(values.mean()) if values.size else None


def _distance_mm(xyz_m: Floats) -> Floats:
    return np.asarray(1e3 * np.linalg.norm(xyz_m[np.isfinite(xyz_m).all(axis=-1)], axis=-1))


def _rms_mm(xyz_m: Floats) -> float | None:
    return _rms(_distance_mm(xyz_m))


def _p95_mm(xyz_m: Floats) -> float | None:
    distance = _distance_mm(xyz_m)
    return finite_or_none(float(np.percentile(distance, 95))) if distance.size else None


def _max_mm(xyz_m: Floats) -> float | None:
    distance = _distance_mm(xyz_m)
    return finite_or_none(distance.max()) if distance.size else None


def _bias_mm(xyz_m: Floats) -> dict[str, float | None]:
    return {axis: _mean(1e3 * xyz_m[:, at]) for at, axis in enumerate("xyz")}


def _spread_mm(xyz_m: Floats) -> float | None:
    """RMS of the 3-D distance from the mean error: what is left when the bias is taken away."""
    known = xyz_m[np.isfinite(xyz_m).all(axis=-1)]
    return _rms_mm(known - known.mean(axis=0)) if known.size else None


def _within(errors: Floats, sigmas: Floats) -> float | None:
    """Per cent of the errors (each axis counted) within 1.96 of their own sigma; a sigma of zero states nothing."""
    stated = np.isfinite(errors) & np.isfinite(sigmas) & (sigmas > 0)
    if not stated.any():
        return None
    return float(100 * np.mean(np.abs(errors[stated]) <= WITHIN_95 * sigmas[stated]))


def _shape_table(errors: list[_ShapeErrors]) -> pa.Table:
    parts = []
    for one in errors:
        series, stations = one.series, one.series.s_m.size
        parts.append(
            pa.table(
                {
                    "trigger_index": np.repeat(series.trigger_index, stations),
                    "side": pa.array([series.side] * one.twist_deg.size, pa.string()),
                    "timestamp_ns": np.repeat(series.timestamp_ns, stations),
                    "station": np.tile(np.arange(stations, dtype=np.int32), series.trigger_index.size),
                    "s_m": np.tile(series.s_m, series.trigger_index.size),
                    **{f"error_{axis}_m": one.xyz_m[..., at].reshape(-1) for at, axis in enumerate("xyz")},
                    "error_twist_deg": one.twist_deg.reshape(-1),
                }
            )
        )
    return pa.concat_tables(parts)


def _marker_table(errors: list[_MarkerErrors]) -> pa.Table:
    parts = []
    for one in errors:
        series, markers = one.series, one.series.marker.size
        parts.append(
            pa.table(
                {
                    "trigger_index": np.repeat(series.trigger_index, markers),
                    "side": pa.array([series.side] * one.inside.size, pa.string()),
                    "marker": np.tile(series.marker, series.trigger_index.size).astype(np.int32),
                    "timestamp_ns": series.timestamp_ns.reshape(-1),
                    **{f"error_{axis}_m": one.xyz_m[..., at].reshape(-1) for at, axis in enumerate("xyz")},
                }
            )
        )
    return pa.concat_tables(parts)
