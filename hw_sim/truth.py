"""The world and the trigger edges of a flight to its truth: markers, shape, triggers and the world itself, as files.

``markers.parquet`` and ``shape.parquet`` have the columns of docs/reference/formats.md that a truth needs, sampled at
200 Hz from 0.2 s before the first edge to 0.2 s after the last; their ``trigger_index`` is −1. Markers are the lights'
centres (of a dome, its base's). ``aircraft.parquet`` has the load factor, airspeed, controls and attitude at the same
times, ``mount.parquet`` how each camera pair has moved against the fuselage, ``fuselage.parquet`` where its lights are.
"""

import csv
import json
import shutil
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from capture.record import SIDES
from capture.trigger_protocol import Pulse
from hw_sim.aircraft import Aircraft
from hw_sim.mount_motion import PairMotion
from hw_sim.wing_motion import LedMotion, WingMotion, twist_rad
from hw_sim.world import World

SAMPLE_NS = 5_000_000
AROUND_NS = 200_000_000
STATION_STEP_M = 0.1


def write_truth(world: World, from_ns: int, to_ns: int, folder: Path, pulses: list[Pulse] | None = None) -> None:
    """Write the truth between two UTC times into ``folder``, which is made when missing."""
    folder.mkdir(parents=True, exist_ok=True)
    times_ns = np.arange(from_ns, to_ns + SAMPLE_NS, SAMPLE_NS, dtype=np.int64)
    _write_table(marker_truth(world, times_ns), world, folder / "markers.parquet")
    _write_table(shape_truth(world, times_ns), world, folder / "shape.parquet")
    aircraft = {"timestamp_ns": times_ns, **Aircraft(world).at(times_ns).columns()}
    _write_table(aircraft, world, folder / "aircraft.parquet")
    _write_table(mount_truth(world, times_ns), world, folder / "mount.parquet")
    _write_table(fuselage_truth(world), world, folder / "fuselage.parquet")
    world.write(folder / "world.toml")
    with (folder / "triggers.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["index", "counter", "commanded_ns", "actual_ns"])
        writer.writerows([p.index, p.counter, p.commanded_ns, p.actual_ns] for p in pulses or [])


def marker_truth(world: World, times_ns: NDArray[np.int64]) -> dict[str, Any]:
    """Columns of ``markers.parquet`` at times (m,): one row for each time, side and light."""
    columns: list[dict[str, Any]] = []
    for side in SIDES:
        leds = LedMotion(world, side)
        centres, _ = leds.centres(np.repeat(times_ns[:, None], len(leds), axis=1))
        times = np.repeat(times_ns, len(leds))
        columns.append(
            {
                "trigger_index": np.full(len(times), -1, dtype=np.int64),
                "side": np.full(len(times), side),
                "marker": np.tile(np.arange(len(leds), dtype=np.int32), len(times_ns)),
                "timestamp_ns": times,
                "frame_timestamp_ns": times,
                **_coordinates(centres),
            }
        )
    return _joined(columns)


def shape_truth(world: World, times_ns: NDArray[np.int64]) -> dict[str, Any]:
    """Columns of ``shape.parquet`` at times (m,): one row for each time, side and station, root to tip."""
    count = round(world.wing.half_span_m / STATION_STEP_M) + 1
    stations_m = np.linspace(0.0, world.wing.half_span_m, count)
    columns: list[dict[str, Any]] = []
    for side in SIDES:
        state = WingMotion(world, side, stations_m).state(times_ns[:, None])
        columns.append(
            {
                "trigger_index": np.full(count * len(times_ns), -1, dtype=np.int64),
                "side": np.full(count * len(times_ns), side),
                "timestamp_ns": np.repeat(times_ns, count),
                "station": np.tile(np.arange(count, dtype=np.int32), len(times_ns)),
                "s_m": np.tile(stations_m, len(times_ns)),
                **_coordinates(state.points_m),
                "twist_deg": np.degrees(twist_rad(world, state.frames, side)).reshape(-1),
            }
        )
    return _joined(columns)


def mount_truth(world: World, times_ns: NDArray[np.int64]) -> dict[str, Any]:
    """Columns of ``mount.parquet`` at times (m,): each pair's turn and shift about cam0, body axes."""
    columns: list[dict[str, Any]] = []
    for side in SIDES:
        moved = PairMotion.of(world, side).at(times_ns)
        columns.append(
            {
                "side": np.full(len(times_ns), side),
                "timestamp_ns": times_ns,
                **{f"turn_{axis}_mrad": 1e3 * moved[:, at] for at, axis in enumerate("xyz")},
                **{f"shift_{axis}_mm": 1e3 * moved[:, 3 + at] for at, axis in enumerate("xyz")},
            }
        )
    return _joined(columns)


def fuselage_truth(world: World) -> dict[str, Any]:
    """Columns of ``fuselage.parquet``: a row for each side and reference light."""
    columns: list[dict[str, Any]] = []
    for side in SIDES:
        lights_m = world.fuselage_lights_m(side)
        names = np.arange(len(lights_m), dtype=np.int32)
        columns.append({"side": np.full(len(lights_m), side), "light": names, **_coordinates(lights_m)})
    return _joined(columns)


def _coordinates(points_m: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    return {name: points_m[..., axis].reshape(-1) for axis, name in enumerate(("x_m", "y_m", "z_m"))}


def _joined(parts: list[dict[str, Any]]) -> dict[str, Any]:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _write_table(columns: dict[str, Any], world: World, path: Path) -> None:
    provenance = {
        "version": version("wingshape"),
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "inputs": {},
        "truth_of_seed": world.seed,
    }
    table = pa.table(columns).replace_schema_metadata({"wingshape": json.dumps(provenance)})
    pq.write_table(table, path)


def clear_truth(folder: Path) -> None:
    """Remove a truth of an earlier flight, so that an old one is never taken for the new one's."""
    if (folder / "triggers.csv").exists():
        shutil.rmtree(folder)
