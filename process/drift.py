"""A flight to how far its cameras have moved since it began, and what that costs at the tip: two witnesses.

The *epipolar residual* of the markers shows cam1 turning against cam0; a turn about the vertical, which changes the
depth, it hardly shows. The *lights on the fuselage* show that, too, and the whole pair moving against the aircraft.
Both are compared with the flight's first block of time, so that errors of calibration and survey cancel.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from process.camera_model import Rig, RigSide
from process.fuselage_lights import lights_seen
from process.pose_fit import moved_pose, project
from process.shared_error import shared_jacobian
from process.triangulate import epipolar_distance_px

Array = NDArray[np.float64]

BLOCK_S, MOST_BLOCKS = 10.0, 300
SETS_A_BLOCK = 50  # of the markers' that are looked at
FLOOR_PX = 0.01  # of a mean: what lens and spot models leave
TURN_PRIOR_RAD = 1e-3  # of a camera against the other: what a mount may do
MOVED_PRIOR = np.array([5e-3] * 3 + [5e-3] * 3)  # of the pair against the fuselage, rad and m
FEWEST = 4  # markers or lights
TURN = slice(18, 21)  # of the pair's parameters: the rotation vector from cam0 to cam1

DRIFT_SCHEMA: pa.Schema = pa.schema(
    [
        ("side", pa.string()),
        ("time_s", pa.float64()),
        ("epipolar_px", pa.float64()),
        ("epipolar_tip_mm", pa.float64()),
        ("epipolar_tip_sigma_mm", pa.float64()),
        ("lights", pa.int32()),
        ("lights_px", pa.float64()),
        ("lights_tip_mm", pa.float64()),
        ("lights_tip_sigma_mm", pa.float64()),
    ]
)
"""columns of ``…_drift.parquet`` (docs/reference/formats.md)"""


def drift_path(markers: Path) -> Path:
    """Where the drift during a marker table's flight is kept: ``markers.parquet`` → ``markers_drift.parquet``."""
    return markers.with_name(f"{markers.stem}_drift.parquet")


@dataclass(frozen=True, eq=False)
class _Block:
    """What was seen in a part of the flight."""

    time_s: float
    tip_m: Array  # (3,) the outermost markers' mean; NaN if none was seen
    markers: dict[int, Array]  # mean (5,) of u0, v0, u1, v1 and the epipolar residual


def drift(markers: pa.Table, lights: pa.Table, rig: Rig) -> pa.Table:
    """A row (``DRIFT_SCHEMA``) for each side and block of time of a marker table and its table of fuselage lights.

    NaN where fewer than four markers, or lights, were seen both then and at first.
    """
    rows: list[dict[str, Any]] = []
    for name in ("left", "right") if markers.num_rows else ():
        columns, edges = _columns(markers, name), _edges(markers)
        if not len(columns["trigger_index"]):
            continue
        side = rig.side(name)
        blocks = [_block(columns, begin, end) for begin, end in edges]
        found = list(_lights(lights, name, side, columns, edges))
        first = next((block for block in blocks if len(block.markers) >= FEWEST), blocks[0])
        first_lights = next((seen for seen in found if np.isfinite(seen).all(axis=(1, 2)).sum() >= FEWEST), found[0])
        for block, seen in zip(blocks, found, strict=True):
            row: dict[str, Any] = {"side": name, "time_s": block.time_s}
            row |= _by_epipolar(side, first, block)
            rows.append(row | _by_lights(side, first_lights, seen, block.tip_m))
    return pa.Table.from_pylist(rows, schema=DRIFT_SCHEMA)


def worst(table: pa.Table) -> dict[str, dict[str, float]]:
    """For each side the largest drift: residual and lights in pixels, their costs at the tip in millimetres."""
    found: dict[str, dict[str, float]] = {}
    for side in dict.fromkeys(table.column("side").to_pylist()):
        rows = [row for row in table.to_pylist() if row["side"] == side]
        found[side] = {}
        for name in ("epipolar", "lights"):
            known = [row for row in rows if np.isfinite(row[f"{name}_tip_mm"])]
            if known:
                most = max(known, key=lambda row: row[f"{name}_tip_mm"])
                found[side][f"{name}_px"] = max((row[f"{name}_px"] for row in known), key=abs)
                found[side][f"{name}_tip_mm"] = most[f"{name}_tip_mm"]
                found[side][f"{name}_tip_sigma_mm"] = most[f"{name}_tip_sigma_mm"]
    return found


def _columns(markers: pa.Table, side: str) -> dict[str, NDArray[Any]]:
    """Columns of the rows that count: of a side, seen and not ambiguous."""
    names = ("trigger_index", "marker", "x_m", "y_m", "z_m", "u0_px", "v0_px", "u1_px", "v1_px", "epipolar_px")
    mine = np.array(markers.column("side").to_pylist(), dtype=object) == side
    good = mine & np.isfinite(markers.column("x_m").to_numpy())
    good &= np.array(["ambiguous" not in flags for flags in markers.column("flags").to_pylist()], dtype=bool)
    chosen = {name: markers.column(name).to_numpy()[good] for name in names}
    return chosen | {"time_s": _since_s(markers)[good]}


def _since_s(markers: pa.Table) -> Array:
    times_ns = markers.column("frame_timestamp_ns").to_numpy()
    return np.asarray((times_ns - times_ns.min()) * 1e-9)


def _edges(markers: pa.Table) -> list[tuple[float, float]]:
    whole_s = float(_since_s(markers).max()) + 1e-6
    count = int(np.clip(np.ceil(whole_s / BLOCK_S), 1, MOST_BLOCKS))
    edges = np.linspace(0.0, whole_s, count + 1)
    return [(float(begin), float(end)) for begin, end in pairwise(edges)]


def _block(columns: dict[str, NDArray[Any]], begin_s: float, end_s: float) -> _Block:
    rows = _during(columns, begin_s, end_s)
    triggers = np.unique(columns["trigger_index"][rows])
    looked_at = triggers[:: max(1, len(triggers) // SETS_A_BLOCK)]
    rows = rows[np.isin(columns["trigger_index"][rows], looked_at)]
    number = columns["marker"][rows]
    seen = np.stack([columns[name][rows] for name in ("u0_px", "v0_px", "u1_px", "v1_px", "epipolar_px")], axis=1)
    xyz = np.stack([columns[f"{axis}_m"][rows] for axis in "xyz"], axis=1)
    tip = xyz[number >= number.max() - 1].mean(axis=0) if len(rows) else np.full(3, np.nan)
    means = {int(marker): np.median(seen[number == marker], axis=0) for marker in np.unique(number)}
    return _Block((begin_s + end_s) / 2.0, tip, means)


def _during(columns: dict[str, NDArray[Any]], begin_s: float, end_s: float) -> NDArray[np.intp]:
    return np.flatnonzero((columns["time_s"] >= begin_s) & (columns["time_s"] < end_s))


def _by_epipolar(side: RigSide, first: _Block, now: _Block) -> dict[str, float]:
    both = sorted(first.markers.keys() & now.markers.keys())
    if len(both) < FEWEST:
        return dict.fromkeys(("epipolar_px", "epipolar_tip_mm", "epipolar_tip_sigma_mm"), np.nan)
    seen = np.array([now.markers[marker] for marker in both])
    change = seen[:, 4] - np.array([first.markers[marker][4] for marker in both])
    slope = -_epipolar_by_turn(side, seen[:, :4])  # measured with the old rotation: the residual is minus the turn's
    turn, covariance = _solved(slope, change, np.full(3, TURN_PRIOR_RAD))
    tip_mm, sigma_mm = _at_tip(side, now.tip_m, turn, covariance)
    return {
        "epipolar_px": float(np.median(change)),
        "epipolar_tip_mm": tip_mm,
        "epipolar_tip_sigma_mm": sigma_mm,
    }


def _epipolar_by_turn(side: RigSide, pixels: Array) -> Array:
    """(n, 3) epipolar residuals by the rotation vector between the cameras, of pixels (n, 4)."""
    xy0, xy1 = side.pair.cam0.undistort(pixels[:, :2]), side.pair.cam1.undistort(pixels[:, 2:])
    slope = np.empty((len(pixels), 3))
    for axis in range(3):
        step = np.zeros(24)
        step[TURN][axis] = 1e-5
        ahead, behind = (
            epipolar_distance_px(side.pair.with_parameters(side.pair.parameters + sign * step), xy0, xy1)
            for sign in (1, -1)
        )
        slope[:, axis] = (ahead - behind) / 2e-5
    return slope


def _by_lights(side: RigSide, first_px: Array, now_px: Array, tip_m: Array) -> dict[str, float]:
    both = np.isfinite(first_px).all(axis=(1, 2)) & np.isfinite(now_px).all(axis=(1, 2))
    if both.sum() < FEWEST:
        nothing = dict.fromkeys(("lights_px", "lights_tip_mm", "lights_tip_sigma_mm"), np.nan)
        return {"lights": int(both.sum()), **nothing}
    change = (now_px - first_px)[both]
    slope = _lights_by_motion(side)[both].reshape(-1, 9)
    motion, covariance = _solved(slope, change.ravel(), np.concatenate([np.full(3, TURN_PRIOR_RAD), MOVED_PRIOR]))
    tip_mm, sigma_mm = _at_tip(side, tip_m, motion, covariance)
    return {
        "lights": int(both.sum()),
        "lights_px": float(np.sqrt(np.mean(np.sum(change**2, axis=2)))),
        "lights_tip_mm": tip_mm,
        "lights_tip_sigma_mm": sigma_mm,
    }


def _lights_by_motion(side: RigSide) -> Array:
    """(L, 2, 2, 9) the lights' pixels by the turn between the cameras, and by the pair's turn and shift."""
    places = np.array([light.xyz_m for light in side.references])
    slope = np.empty((len(places), 2, 2, 9))
    for index in range(9):
        moved = []
        for sign in (1e-6, -1e-6):
            step = np.zeros(9)
            step[index] = sign
            values = side.pair.parameters
            values[TURN] += step[:3]
            T = moved_pose(side.T_body_cam0, step[3:])
            moved.append(np.stack(project(side.pair.with_parameters(values), T, places), axis=1))
        slope[..., index] = (moved[0] - moved[1]) / 2e-6
    return slope


def _solved(slope: Array, change: Array, prior: Array) -> tuple[Array, Array]:
    """Least squares with a prior about zero: the solution, and its covariance by what the residuals leave."""
    information, held = slope.T @ slope, np.diag(prior**-2.0)
    sigma = FLOOR_PX
    for _ in range(3):  # the noise is not known beforehand, and decides how much the prior pulls
        covariance = np.linalg.inv(information / sigma**2 + held)
        solution = covariance @ (slope.T @ change) / sigma**2
        left = change - slope @ solution
        sigma = max(FLOOR_PX, float(np.sqrt(np.sum(left**2) / max(1, len(change) - len(prior)))))
    return np.asarray(solution), np.asarray(covariance, np.float64)


def _at_tip(side: RigSide, tip_m: Array, motion: Array, covariance: Array) -> tuple[float, float]:
    """Millimetres that ``motion`` (3, or 9), not known of, moves what is measured at the tip, and one sigma."""
    fixed = replace(side, pose_by_calibration=None)  # the pose was fitted before all this
    by_all = shared_jacobian(fixed, tip_m[None])[0]
    jacobian = by_all[:, TURN] if len(motion) == 3 else np.concatenate([by_all[:, TURN], by_all[:, 24:]], axis=1)
    spread = jacobian @ covariance @ jacobian.T
    return 1000.0 * float(np.linalg.norm(jacobian @ motion)), 1000.0 * float(np.sqrt(np.trace(spread)))


def _lights(
    lights: pa.Table, name: str, side: RigSide, columns: dict[str, NDArray[Any]], edges: Sequence[tuple[float, float]]
) -> Iterator[Array]:
    """(L, 2, 2) means of the lights' pixels in each block."""
    sets = lights_seen(lights, name, side)
    for begin, end in edges:
        own = np.isin(sets.trigger_index, columns["trigger_index"][_during(columns, begin, end)])
        seen = sets.spots.pixels[own]
        count = np.isfinite(seen).sum(axis=0)
        yield np.where(count > 0, np.nansum(seen, axis=0) / np.maximum(count, 1), np.nan)
