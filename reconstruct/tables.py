"""Tables of a result folder: Parquet (and CSV) on disk ⇄ dense arrays, one set of arrays a side."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from capture.errors import UsageError
from capture.record import PtpState
from process.tables import DIRECT_COLUMNS, PIXEL_COVARIANCES, ROW_TIMES

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]
Words = npt.NDArray[np.object_]

SIDES = ("left", "right")
MARKERS = "markers.parquet"
LIGHTS = "markers_lights.parquet"
SHAPE = "shape.parquet"
FRAMES = "frames.parquet"
LOADS = "loads.parquet"
RESIDUALS = "residuals.parquet"
UNLOADED = "unloaded.parquet"

POSITION = ("x_m", "y_m", "z_m")
COVARIANCE = ("cov_xx_m2", "cov_xy_m2", "cov_xz_m2", "cov_yy_m2", "cov_yz_m2", "cov_zz_m2")
PIXELS = ("u0_px", "v0_px", "u1_px", "v1_px")
SIGMA = ("sigma_x_m", "sigma_y_m", "sigma_z_m")
MOVED = ("dx_m", "dy_m", "dz_m")
TIP_COLUMNS = ("tip_dx_m", "tip_dy_m", "tip_dz_m", "tip_twist_deg")
CURVATURE = ("curvature_twist_1pm", "curvature_out_1pm", "curvature_in_1pm")
STIFFNESS_COLUMNS = ("stiffness_ea", "stiffness_gj", "stiffness_ei_out", "stiffness_ei_in")
REFERENCE_POSITION = ("reference_x_m", "reference_y_m", "reference_z_m")
RESIDUAL = ("residual_x_m", "residual_y_m", "residual_z_m")
LOAD_COLUMNS = ("fx_n", "fy_n", "fz_n", "mx_nm", "my_nm", "mz_nm")
ROOT_COLUMNS = ("root_turn_x_rad", "root_turn_y_rad", "root_turn_z_rad", "root_dx_m", "root_dy_m", "root_dz_m")
NET_COLUMNS = tuple(f"net_{name}" for name in LOAD_COLUMNS)
TIME_COLUMNS = ("time_sigma_ns", "ptp_state")
SHAPE_COLUMNS = (
    *("trigger_index", "side", "timestamp_ns", "station", "s_m", *POSITION, "twist_deg"),
    *(*SIGMA, "sigma_twist_deg", "flags"),
)
"""all that ``shape_series`` looks at"""
MARKER_COLUMNS = (
    *("trigger_index", "side", "marker", "timestamp_ns", "frame_timestamp_ns", *POSITION),
    *(*COVARIANCE, "flags", *TIME_COLUMNS),
)
"""all that ``marker_series`` and ``marker_tracks`` look at"""
_PER_SET = (  # of MarkerSeries
    *("trigger_index", "frame_timestamp_ns", "timestamp_ns", "xyz_m", "cov_m2", "flags"),
    *TIME_COLUMNS,
)
_TRIANGLE = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


@dataclass(frozen=True, eq=False)
class Centroids:
    """Both cameras' pixels of F sets and M markers; NaN where a camera did not see one."""

    pixels: Floats  # (F, M, 2, 2) of marker, camera, (u, v)
    covariance_px2: Floats  # (F, M, 2, 2, 2)
    timestamp_ns: Ints  # (F, M, 2) each one's own instant
    epipolar_px: Floats  # (F, M) signed distance from the epipolar condition; NaN where not seen by both

    @property
    def seen(self) -> Bools:
        """(F, M, 2) whether a camera saw a marker."""
        return np.asarray(np.isfinite(self.pixels).all(axis=-1) & np.isfinite(self.covariance_px2).all(axis=(-1, -2)))

    def __getitem__(self, rows: slice) -> "Centroids":
        """Some of the sets."""
        return Centroids(*(getattr(self, member.name)[rows] for member in fields(self)))

    @classmethod
    def join(cls, parts: Sequence["Centroids"]) -> "Centroids":
        """The sets of all ``parts``, at least one, which have the same markers."""
        return cls(*(np.concatenate([getattr(one, member.name) for one in parts]) for member in fields(cls)))


@dataclass(frozen=True, eq=False)
class SetMotion:
    """How a camera pair has moved against the fuselage, in F sets: x → exp(ω) (x − c) + c + δ, body frame."""

    change: Floats  # (F, 6) turn ω (rad) and shift δ (m)
    covariance: Floats  # (F, 6, 6)
    lights: Ints  # (F,) on the fuselage, that told; 0: it is what other sets make likely
    centre_m: Floats  # (3,) c, the centre of cam0 at rest

    def __getitem__(self, rows: slice | Ints) -> "SetMotion":
        """Some of the sets."""
        return replace(self, change=self.change[rows], covariance=self.covariance[rows], lights=self.lights[rows])

    @classmethod
    def join(cls, parts: Sequence["SetMotion"]) -> "SetMotion":
        """The sets of all ``parts``, at least one, which are of one pair."""
        names = ("change", "covariance", "lights")
        return replace(parts[0], **{name: np.concatenate([getattr(one, name) for one in parts]) for name in names})


@dataclass(frozen=True)
class MarkerSeries:
    """One side's markers, dense over F sets and M markers; what was not measured is NaN."""

    side: str
    marker: Ints  # (M,) identities, ascending
    trigger_index: Ints  # (F,) ascending
    frame_timestamp_ns: Ints  # (F,) the set's common instant
    timestamp_ns: Ints  # (F, M) the marker's own instant
    xyz_m: Floats  # (F, M, 3) body frame
    cov_m2: Floats  # (F, M, 3, 3); NaN where the table has none
    flags: Words  # (F, M) str, empty when good
    time_sigma_ns: Floats  # (F,) one sigma of the common instant; NaN: not known
    ptp_state: Words  # (F,) str, of the recorder's PTP port; UNKNOWN where the table does not say
    centroids: Centroids | None = None  # for direct mode
    motion: SetMotion | None = None  # of the cameras, that places and pixels are free of; None: they were at rest

    @property
    def seen(self) -> Bools:
        """(F, M) whether the marker has a position."""
        return np.asarray(np.isfinite(self.xyz_m).all(axis=-1))

    def __getitem__(self, rows: slice) -> "MarkerSeries":
        """Some of the sets."""
        centroids = None if self.centroids is None else self.centroids[rows]
        motion = None if self.motion is None else self.motion[rows]
        return replace(
            self, centroids=centroids, motion=motion, **{name: getattr(self, name)[rows] for name in _PER_SET}
        )

    @classmethod
    def join(cls, parts: Sequence["MarkerSeries"]) -> "MarkerSeries":
        """The sets of all ``parts``, at least one, which have the same markers."""
        whole: dict[str, Any] = {name: np.concatenate([getattr(one, name) for one in parts]) for name in _PER_SET}
        centroids = [one.centroids for one in parts if one.centroids is not None]
        motions = [one.motion for one in parts if one.motion is not None]
        return replace(
            parts[0],
            centroids=Centroids.join(centroids) if centroids else None,
            motion=SetMotion.join(motions) if motions else None,
            **whole,
        )


@dataclass(frozen=True)
class ShapeSeries:
    """One side's shape, dense over F sets and S stations; a set that could not be fitted is NaN."""

    side: str
    trigger_index: Ints  # (F,) ascending
    timestamp_ns: Ints  # (F,)
    s_m: Floats  # (S,) arc length from the root
    xyz_m: Floats  # (F, S, 3) body frame
    twist_deg: Floats  # (F, S) nose-up, against the unloaded wing
    sigma_xyz_m: Floats  # (F, S, 3); NaN where the table has none
    sigma_twist_deg: Floats  # (F, S)
    flags: Words  # (F,) str, empty when good


def read_table(path: Path, required: Sequence[str], columns: Sequence[str] | None = None) -> pa.Table:
    """The table at ``path``, checked to be Parquet, to have rows and the ``required`` columns.

    With ``columns``, of these only, as far as it has them: a long flight's tables are large.

    Raises UsageError when it is missing, unreadable, empty or lacks a column.
    """
    if not path.is_file():
        raise UsageError(f"{path}: no such table")
    try:
        if columns is not None:
            columns = [name for name in columns if name in pyarrow.parquet.read_schema(path).names]
        table = pyarrow.parquet.read_table(path, memory_map=False, columns=columns)
    except (pa.ArrowException, OSError) as error:
        raise UsageError(f"{path}: not a readable Parquet file ({str(error).splitlines()[0]})") from error
    check_columns(table, required, str(path))
    return table


def check_columns(table: pa.Table, required: Sequence[str], name: str) -> None:
    """Raises UsageError when ``table`` lacks a ``required`` column or has no rows; ``name`` is used in the message."""
    missing = [column for column in required if column not in table.column_names]
    if missing:
        raise UsageError(f"{name}: lacks the columns {', '.join(missing)} (see docs/reference/formats.md)")
    if table.num_rows == 0:
        raise UsageError(f"{name}: has no rows")


def marker_series(table: pa.Table, name: str) -> dict[str, MarkerSeries]:
    """A measurement's marker table as dense arrays by side, sides without rows left out.

    Raises UsageError when columns are missing, a side is neither left nor right, a marker occurs twice in a set, or the
    markers of one set do not agree on their common instant.
    """
    required = ("trigger_index", "side", "marker", "timestamp_ns", "frame_timestamp_ns", *POSITION, *COVARIANCE)
    check_columns(table, required, name)
    rows = {
        "marker": _ints(table, "marker", name),
        "time": _ints(table, "timestamp_ns", name),
        "frame_time": _ints(table, "frame_timestamp_ns", name),
        "xyz": _stack(table, POSITION, name),
        "cov": _stack(table, COVARIANCE, name),
        "flags": _words(table, "flags"),
        "time_sigma_ns": _stack(table, ("time_sigma_ns",), name)[:, 0],
        "ptp_state": _words(table, "ptp_state"),
    }
    series = {}
    for side, pick in _by_side(table, name):
        triggers, frame_of = np.unique(_ints(table, "trigger_index", name)[pick], return_inverse=True)
        own = {key: values[pick] for key, values in rows.items()}
        series[side] = _dense_markers(side, triggers, frame_of, own, name)
    return series


def centroid_series(table: pa.Table, series: MarkerSeries, name: str) -> Centroids:
    """The pixels of ``series``, which is a side of the marker table.

    Those that one camera saw and that may be something else (``ambiguous``) are left out. Raises UsageError when the
    table does not have the columns.
    """
    columns = (*DIRECT_COLUMNS, *PIXELS, "epipolar_px")
    missing = [column for column in columns if column not in table.column_names]
    if missing:
        raise UsageError(
            f"{name}: has no {missing[0]}, which a fit to pixels needs; make the table again with `wingproc markers`, "
            "or leave --direct out"
        )
    pick = np.flatnonzero(_words(table, "side") == series.side)
    frame_of = np.searchsorted(series.trigger_index, _ints(table, "trigger_index", name)[pick])
    marker_of = np.searchsorted(series.marker, _ints(table, "marker", name)[pick])
    shape = (series.trigger_index.size, series.marker.size)
    pixels, spread = np.full((*shape, 2, 2), np.nan), np.full((*shape, 2, 2, 2), np.nan)
    time = np.repeat(series.frame_timestamp_ns, shape[1] * 2).reshape(*shape, 2)
    epipolar = np.full(shape, np.nan)
    pixels[frame_of, marker_of] = _stack(table, PIXELS, name)[pick].reshape(-1, 2, 2)
    uu, uv, vv = np.moveaxis(_stack(table, PIXEL_COVARIANCES, name)[pick].reshape(-1, 2, 3), 2, 0)
    spread[frame_of, marker_of] = np.stack([uu, uv, uv, vv], axis=-1).reshape(-1, 2, 2, 2)
    for camera, column in enumerate(ROW_TIMES):
        time[frame_of, marker_of, camera] = _ints(table, column, name)[pick]
    epipolar[frame_of, marker_of] = _stack(table, ("epipolar_px",), name)[pick, 0]
    doubtful = [("one_camera" in flags and "ambiguous" in flags) for flags in series.flags.ravel()]
    pixels[np.array(doubtful, dtype=bool).reshape(shape)] = np.nan
    return Centroids(pixels, spread, time, epipolar)


def marker_tracks(table: pa.Table, name: str) -> dict[str, dict[int, tuple[Ints, Floats]]]:
    """A reference's marker table as the path of each marker: side → marker → times (n,) in ns, growing, and (n, 3).

    Sets and measurement columns are not needed, unknown positions are left out. Raises UsageError when columns are
    missing, a side is neither left nor right, or a marker is twice at one time.
    """
    check_columns(table, ("side", "marker", "timestamp_ns", *POSITION), name)
    marker, time = _ints(table, "marker", name), _ints(table, "timestamp_ns", name)
    xyz = _stack(table, POSITION, name)
    known = np.asarray(np.isfinite(xyz).all(axis=1))
    tracks: dict[str, dict[int, tuple[Ints, Floats]]] = {}
    for side, pick in _by_side(table, name):
        rows = pick[known[pick]]
        rows = rows[np.lexsort((time[rows], marker[rows]))]
        tracks[side] = {}
        for own in np.split(rows, np.flatnonzero(np.diff(marker[rows])) + 1) if rows.size else []:
            if np.any(np.diff(time[own]) == 0):
                raise UsageError(f"{name}: {side} wing: marker {marker[own[0]]} is twice at one timestamp_ns")
            tracks[side][int(marker[own[0]])] = (time[own], xyz[own])
    return tracks


def shape_series(table: pa.Table, name: str, *, reference: bool = False) -> dict[str, ShapeSeries]:
    """The shape table as dense arrays by side, sides without rows left out; sigmas and flags may be missing.

    With ``reference`` the rows of one time are a set, whatever their trigger index, which is then the set's number.
    Raises UsageError when columns are missing, a station is missing or occurs twice in a set, or the arc length of a
    station or the time of a set is not the same in all of its rows.
    """
    required = ("side", "timestamp_ns", "station", "s_m", *POSITION, "twist_deg")
    check_columns(table, required if reference else ("trigger_index", *required), name)
    station, time = _ints(table, "station", name), _ints(table, "timestamp_ns", name)
    s_m, xyz = _stack(table, ("s_m",), name)[:, 0], _stack(table, POSITION, name)
    sigmas = _stack(table, (*SIGMA, "sigma_twist_deg"), name)
    twist, flags = _stack(table, ("twist_deg",), name)[:, 0], _words(table, "flags")
    series = {}
    for side, pick in _by_side(table, name):
        key = time if reference else _ints(table, "trigger_index", name)
        sets, frame_of = np.unique(key[pick], return_inverse=True)
        triggers = np.arange(sets.size) if reference else sets
        stations, station_of = np.unique(station[pick], return_inverse=True)
        shape = (triggers.size, stations.size)
        order = _positions(frame_of, station_of, shape, f"{name}: {side} wing", "station")
        if order.size != triggers.size * stations.size:
            raise UsageError(f"{name}: the {side} wing has sets without all of its {stations.size} stations")
        row = pick[np.argsort(order)].reshape(shape)
        if np.ptp(s_m[row], axis=0).max() > 1e-9 or np.any(np.diff(s_m[row[0]]) <= 0):
            raise UsageError(f"{name}: {side} wing: s_m must grow with the station and be the same in every set")
        if np.any(np.ptp(time[row], axis=1) != 0):
            raise UsageError(f"{name}: {side} wing: the stations of a set must share one timestamp_ns")
        series[side] = ShapeSeries(
            side,
            triggers,
            time[row[:, 0]],
            s_m[row[0]],
            xyz[row],
            twist[row],
            sigmas[row][..., :3],
            sigmas[row][..., 3],
            flags[row[:, 0]],
        )
    return series


def rms(values: Floats, axis: int) -> Floats:
    """Root mean square of the finite values along ``axis``, NaN where there are none."""
    known = np.isfinite(values)
    count = known.sum(axis=axis)
    total = np.sum(np.where(known, values, 0.0) ** 2, axis=axis)
    return np.asarray(np.sqrt(np.where(count > 0, total / np.maximum(count, 1), np.nan)))


def write_csv(table: pa.Table, path: Path) -> None:
    """``table`` as comma-separated text with a header line; NaN is written as ``nan``."""
    pyarrow.csv.write_csv(table, path)


def _by_side(table: pa.Table, name: str) -> list[tuple[str, npt.NDArray[np.intp]]]:
    """(side, its row numbers) for each side present."""
    side = _words(table, "side")
    strange = sorted(set(side) - set(SIDES))
    if strange:
        raise UsageError(f"{name}: side is {strange[0]!r}, not left or right")
    rows = [(which, np.flatnonzero(side == which)) for which in SIDES]
    return [(which, pick) for which, pick in rows if pick.size]


def _dense_markers(side: str, triggers: Ints, frame_of: Ints, rows: Mapping[str, Any], name: str) -> MarkerSeries:
    markers, marker_of = np.unique(rows["marker"], return_inverse=True)
    shape = (triggers.size, markers.size)
    _positions(frame_of, marker_of, shape, f"{name}: {side} wing", "marker")
    last = np.full(triggers.size, np.iinfo(np.int64).min)
    np.maximum.at(last, frame_of, rows["frame_time"])
    if np.any(rows["frame_time"] != last[frame_of]):
        raise UsageError(f"{name}: {side} wing: the markers of a set must share one frame_timestamp_ns")
    time = np.repeat(last[:, None], markers.size, axis=1)
    xyz = np.full((*shape, 3), np.nan)
    cov = np.full((*shape, 3, 3), np.nan)
    flags = np.full(shape, "not_seen", dtype=object)
    time[frame_of, marker_of] = rows["time"]
    xyz[frame_of, marker_of] = rows["xyz"]
    flags[frame_of, marker_of] = rows["flags"]
    for column, (i, j) in enumerate(_TRIANGLE):
        cov[frame_of, marker_of, i, j] = cov[frame_of, marker_of, j, i] = rows["cov"][:, column]
    xyz[~np.isfinite(xyz).all(axis=-1)] = np.nan
    sigma_ns, state = np.full(triggers.size, np.nan), np.full(triggers.size, PtpState.UNKNOWN.name, dtype=object)
    sigma_ns[frame_of], state[frame_of] = rows["time_sigma_ns"], rows["ptp_state"]  # the same for a whole set
    state[state == ""] = PtpState.UNKNOWN.name
    return MarkerSeries(side, markers, triggers, last, time, xyz, cov, flags, sigma_ns, state)


def _positions(frame_of: Ints, item_of: Ints, shape: tuple[int, int], name: str, what: str) -> Ints:
    """Flat positions of the rows in a dense array of ``shape``; raises UsageError when two rows share one."""
    order = frame_of * shape[1] + item_of
    if np.bincount(order).max() > 1:
        raise UsageError(f"{name}: a {what} occurs twice in one set")
    return np.asarray(order, dtype=np.int64)


def _ints(table: pa.Table, column: str, name: str) -> Ints:
    values = table.column(column)
    if not pa.types.is_integer(values.type) or values.null_count:
        raise UsageError(f"{name}: the column {column} must be whole numbers without gaps")
    return np.asarray(values.to_numpy(), dtype=np.int64)


def _stack(table: pa.Table, names: Sequence[str], name: str) -> Floats:
    """(rows, len(names)) numbers, NaN where the table has no such column."""
    stacked = np.full((table.num_rows, len(names)), np.nan)
    for at, column in enumerate(names):
        if column not in table.column_names:
            continue
        values = table.column(column)
        if not (pa.types.is_floating(values.type) or pa.types.is_integer(values.type)):
            raise UsageError(f"{name}: the column {column} must be numbers")
        stacked[:, at] = values.to_numpy(zero_copy_only=False)
    return stacked


def _words(table: pa.Table, column: str) -> Words:
    if column not in table.column_names:
        return np.full(table.num_rows, "", dtype=object)
    values = table.column(column).cast(pa.string()).fill_null("")
    return np.asarray(values.to_numpy(zero_copy_only=False), dtype=object)
