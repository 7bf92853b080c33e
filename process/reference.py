"""Markers of a window at rest to one place each: the shape that displacements are measured from, with its covariance.

A place is the mean over the window's sets, those left out that stand out from the others. Its covariance is that of
image noise over their number, enlarged where the means of parts of the window differ by more: what moves slowly, such
as a wing in a breeze, does not average out. What calibration and mount add is shared by all frames of the flight, the
window's too, and mostly cancels in a displacement: it stands apart, see ``shared_error``.
"""

import json
from bisect import bisect_left
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from capture.errors import ProcessError, UsageError
from process.recording import FrameSetReader, Recording, SetPlaces
from process.shared_error import METADATA_KEY, point_covariance_m2, sides_of
from process.tables import DIRECT_COLUMNS, MARKER_SCHEMA

Array = NDArray[np.float64]

REFERENCE_KEY = b"wingshape_reference"
FEWEST_SETS = 5
PARTS = 10  # of the window, whose means are compared
STANDS_OUT = 16.27  # 99.9 % of χ² with three degrees of freedom
MEDIAN_CHI2 = 2.366  # of χ² with three degrees of freedom
_TRIANGLE = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_AXES = tuple("xyz"[i] + "xyz"[j] for i, j in _TRIANGLE)

REFERENCE_SCHEMA: pa.Schema = pa.schema(
    [
        *(member for member in MARKER_SCHEMA if member.name not in DIRECT_COLUMNS),
        ("sets", pa.int32()),
        ("scatter_m", pa.float64()),
        ("moved_m", pa.float64()),
        *((f"shared_{axes}_m2", pa.float64()) for axes in _AXES),
    ]
)
"""columns of ``reference.parquet`` (docs/reference/formats.md)"""


@dataclass(frozen=True)
class Window:
    """Seconds since the first set."""

    begin_s: float
    end_s: float


def parse_window(text: str, option: str) -> Window:
    """``A:B`` in seconds. Raises UsageError, naming ``option``, when it is not that."""
    try:
        begin, end = (float(part) for part in text.split(":"))
    except ValueError:
        raise UsageError(f"{option} {text}: give two times in seconds as A:B, for instance 0:5") from None
    if not 0 <= begin < end < np.inf:
        raise UsageError(f"{option} {text}: A must not be negative, and B later than A")
    return Window(begin, end)


def within(recording: Recording, window: Window) -> Recording:
    """The recording's frame sets of the window. Raises ProcessError when it has none there."""
    with FrameSetReader() as reader:

        def instant_ns(places: SetPlaces) -> int:
            times = [moment for moment in reader.read(places).mid_exposures_ns if moment is not None]
            if not times:
                raise ProcessError(
                    f"{recording.files[0]}: the frames of trigger {places.trigger_index} cannot be read; "
                    "measure the whole flight with `wingproc markers`, and take the reference from its table"
                )
            return min(times)

        start_ns = min(instant_ns(sets[0]) for sets in recording.sides.values())
        begin_ns, end_ns = (start_ns + round(1e9 * edge) for edge in (window.begin_s, window.end_s))
        sides = {
            side: sets[bisect_left(sets, begin_ns, key=instant_ns) : bisect_left(sets, end_ns, key=instant_ns)]
            for side, sets in recording.sides.items()
        }
        last_s = max(instant_ns(sets[-1]) - start_ns for sets in recording.sides.values()) * 1e-9
    for side, sets in sides.items():
        if len(sets) < FEWEST_SETS:
            raise ProcessError(_too_few(side, len(sets), window, last_s))
    return replace(recording, sides=sides)


def rest_shape(markers: pa.Table, window: Window | None, still_m: float) -> pa.Table:
    """One row (``REFERENCE_SCHEMA``) for each side and marker of a marker table's ``window``; all of it if None.

    Raises ProcessError when a side has fewer than five sets there, no marker was seen, or the wing moved by more than
    ``still_m`` between parts of the window.
    """
    if markers.num_rows == 0:
        raise ProcessError("the marker table has no rows: no reference can be taken from it")
    known = [name for name in MARKER_SCHEMA.names if name in markers.column_names]
    columns = {name: markers.column(name).to_numpy(zero_copy_only=False) for name in known}
    since_s = (columns["frame_timestamp_ns"] - columns["frame_timestamp_ns"].min()) * 1e-9
    chosen = (since_s >= window.begin_s) & (since_s < window.end_s) if window else np.ones(len(since_s), bool)
    sides = sides_of(markers)
    rows: list[dict[str, Any]] = []
    for side in sorted(set(columns["side"])):
        mine = chosen & (columns["side"] == side)
        sets = len(np.unique(columns["trigger_index"][mine]))
        if sets < FEWEST_SETS:
            raise ProcessError(_too_few(side, sets, window, float(since_s.max())))
        rests = [
            _rest({name: values[mine] for name, values in columns.items()}, marker)
            for marker in np.unique(columns["marker"][columns["side"] == side])
        ]
        places = np.array([[row[f"{axis}_m"] for axis in "xyz"] for row in rests])
        shared = np.full((len(rests), 3, 3), np.nan)
        if side in sides:
            shared = point_covariance_m2(sides[side], places)
        for row, covariance in zip(rests, shared, strict=True):
            row.update({f"shared_{axes}_m2": covariance[at] for axes, at in zip(_AXES, _TRIANGLE, strict=True)})
        rows += rests
    _refuse_motion(rows, still_m)
    table = pa.Table.from_pylist(rows, schema=REFERENCE_SCHEMA)
    note = {"window_s": None if window is None else [window.begin_s, window.end_s]}
    kept = {key: value for key, value in (markers.schema.metadata or {}).items() if key == METADATA_KEY}
    return table.replace_schema_metadata({**kept, REFERENCE_KEY: json.dumps(note).encode()})


def _rest(rows: dict[str, Any], marker: int) -> dict[str, Any]:
    """The row of one marker, from its rows in the window."""
    first = {name: rows[name][0] for name in ("trigger_index", "side")}
    middle_ns = int(rows["frame_timestamp_ns"].min() // 2 + rows["frame_timestamp_ns"].max() // 2)
    row: dict[str, Any] = dict.fromkeys(REFERENCE_SCHEMA.names, np.nan)
    row |= {**first, "marker": marker, "timestamp_ns": middle_ns, "frame_timestamp_ns": middle_ns, "sets": 0}
    row["ptp_state"] = ""  # a window has none
    xyz, covariance = _places(rows)
    good = (rows["marker"] == marker) & np.isfinite(xyz).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    good &= np.array(["ambiguous" not in flags for flags in rows["flags"]], dtype=bool)
    good[good] = _alike(xyz[good], covariance[good])
    if good.sum() < FEWEST_SETS:
        return {**row, "flags": "not_seen"}
    mean, noise = xyz[good].mean(axis=0), covariance[good].mean(axis=0)
    parts = np.array([part.mean(axis=0) for part in np.array_split(xyz[good], min(PARTS, int(good.sum())))])
    spread = parts - mean
    information = np.linalg.inv(noise / (good.sum() / len(parts)))
    ratio = float(np.einsum("pi,ij,pj->", spread, information, spread)) / (3 * (len(parts) - 1))
    of_mean = noise / good.sum() * max(1.0, ratio)
    row |= {f"{axis}_m": value for axis, value in zip("xyz", mean, strict=True)}
    row |= {f"cov_{axes}_m2": of_mean[at] for axes, at in zip(_AXES, _TRIANGLE, strict=True)}
    row |= {name: float(rows[name][good].mean()) for name in ("u0_px", "v0_px", "u1_px", "v1_px", "epipolar_px")}
    row["time_sigma_ns"] = float(np.max(rows["time_sigma_ns"][good])) if "time_sigma_ns" in rows else np.nan
    scatter_m = float(np.sqrt(np.mean(np.sum((xyz[good] - mean) ** 2, axis=1))))
    # what is left of the parts' spread once noise is taken off
    moved_m2 = float(np.mean(np.sum(spread**2, axis=1))) - float(np.trace(noise)) * len(parts) / int(good.sum())
    return row | {
        "flags": "",
        "sets": int(good.sum()),
        "scatter_m": scatter_m,
        "moved_m": float(np.sqrt(max(0.0, moved_m2))),
    }


def _places(rows: dict[str, Any]) -> tuple[Array, Array]:
    xyz = np.stack([rows[f"{axis}_m"] for axis in "xyz"], axis=1)
    covariance = np.empty((len(xyz), 3, 3))
    for axes, (i, j) in zip(_AXES, _TRIANGLE, strict=True):
        covariance[:, i, j] = covariance[:, j, i] = rows[f"cov_{axes}_m2"]
    return xyz, covariance


def _alike(xyz: Array, covariance: Array) -> NDArray[np.bool_]:
    """Which places (n, 3) do not stand out from the others: by their own noise, enlarged to the usual scatter."""
    alike = np.ones(len(xyz), dtype=bool)
    if len(xyz) < FEWEST_SETS:
        return alike
    centre = np.median(xyz, axis=0)
    for _ in range(3):
        off = xyz - centre
        chi2 = np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariance), off)
        alike = chi2 <= STANDS_OUT * max(1.0, float(np.median(chi2)) / MEDIAN_CHI2)
        centre = xyz[alike].mean(axis=0)
    return alike


def _refuse_motion(rows: list[dict[str, Any]], still_m: float) -> None:
    seen = [row for row in rows if row["sets"]]
    if not seen:
        raise ProcessError("no marker was seen in the window: no reference can be taken from it")
    most = max(seen, key=lambda row: row["moved_m"])
    if most["moved_m"] > still_m:
        raise ProcessError(
            f"the wing was not at rest: marker {most['marker']} of the {most['side']} wing moved by "
            f"{1000 * most['moved_m']:.2f} mm RMS between parts of the window ({1000 * still_m:g} mm are allowed); "
            "take another window, or allow more with --still-mm"
        )


def _too_few(side: str, sets: int, window: Window | None, last_s: float) -> str:
    where = "in all" if window is None else f"from {window.begin_s:g} to {window.end_s:g} s"
    return f"{side}: {sets} sets {where}, {FEWEST_SETS} are needed (the recording has 0 to {last_s:.1f} s)"
