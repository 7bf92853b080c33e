"""Spots of a frame set to the lights on the fuselage among them, and those to a table; and the others without them."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from process.camera_model import RigSide
from process.detect import Detections
from process.pose_fit import project
from process.tables import PIXEL_COVARIANCES

Array = NDArray[np.float64]

REACH_PX = 15.0
"""a spot this close to where a light should be is the light: survey, calibration and what the mount may have moved"""

LIGHTS_SCHEMA: pa.Schema = pa.schema(
    [
        ("trigger_index", pa.int64()),
        ("side", pa.string()),
        ("light", pa.string()),
        ("frame_timestamp_ns", pa.int64()),
        *((name, pa.float64()) for name in ("u0_px", "v0_px", "u1_px", "v1_px")),
        *((name, pa.float64()) for name in PIXEL_COVARIANCES),
    ]
)
"""columns of ``…_lights.parquet`` (docs/reference/formats.md)"""


def lights_path(markers: Path) -> Path:
    """Where a marker table's fuselage lights are kept: ``markers.parquet`` → ``markers_lights.parquet``."""
    return markers.with_name(f"{markers.stem}_lights.parquet")


@dataclass(frozen=True, eq=False)
class LightSpots:
    """Spots of a side's L lights, by both cameras; NaN where there was none."""

    pixels: Array
    """(L, 2, 2) of light, camera, (u, v)"""
    covariance_px2: Array
    """(L, 2, 2, 2)"""


@dataclass(frozen=True, eq=False)
class LightSets:
    """F sets of a side's L lights, as a table has them."""

    trigger_index: NDArray[np.int64]
    """(F,) growing"""
    timestamp_ns: NDArray[np.int64]
    """(F,) the sets' common instants"""
    spots: LightSpots
    """with F in front"""


def light_spots(
    side: RigSide, spots: tuple[Detections, Detections]
) -> tuple[LightSpots, tuple[Detections, Detections]]:
    """The spots of the rig's reference lights, and the others: those of the markers."""
    lights = LightSpots(np.full((len(side.references), 2, 2), np.nan), np.full((len(side.references), 2, 2, 2), np.nan))
    if not side.references:
        return lights, spots
    numbers = _numbers(side, spots)
    for camera, (chosen, own) in enumerate(zip(numbers, spots, strict=True)):
        lights.pixels[chosen >= 0, camera] = own.pixels[chosen[chosen >= 0]]
        lights.covariance_px2[chosen >= 0, camera] = own.covariance_px2[chosen[chosen >= 0]]
    first, second = (_without(own, chosen) for own, chosen in zip(spots, numbers, strict=True))
    return lights, (first, second)


def lights_table(name: str, side: RigSide, seen: Iterable[tuple[int, int, LightSpots]]) -> pa.Table:
    """A row for each set, given as trigger index, common instant and spots, and light of the side called ``name``."""
    sets = list(seen)
    if not sets:
        return LIGHTS_SCHEMA.empty_table()
    pixels = np.concatenate([spots.pixels for *_, spots in sets])
    spread = np.concatenate([spots.covariance_px2 for *_, spots in sets])
    columns = {
        "trigger_index": np.repeat([trigger for trigger, *_ in sets], len(side.references)),
        "frame_timestamp_ns": np.repeat([instant for _, instant, _ in sets], len(side.references)),
        "side": np.full(len(pixels), name, dtype=object),
        "light": np.tile(np.array([light.name for light in side.references], dtype=object), len(sets)),
    }
    for camera in (0, 1):
        for at, axis in enumerate("uv"):
            columns[f"{axis}{camera}_px"] = pixels[:, camera, at]
        for at, axes in enumerate(((0, 0), (0, 1), (1, 1))):
            columns[PIXEL_COVARIANCES[3 * camera + at]] = spread[:, camera, *axes]
    return pa.table([pa.array(columns[one.name], one.type) for one in LIGHTS_SCHEMA], schema=LIGHTS_SCHEMA)


def lights_seen(table: pa.Table, name: str, side: RigSide) -> LightSets:
    """A lights table's sets of the side called ``name``; lights that the rig does not know are left out."""
    number = {light.name: at for at, light in enumerate(side.references)}
    light = np.array([number.get(one, -1) for one in table.column("light").to_pylist()], dtype=np.intp)
    rows = np.flatnonzero((np.array(table.column("side").to_pylist(), dtype=object) == name) & (light >= 0))
    triggers, first, at = np.unique(
        table.column("trigger_index").to_numpy()[rows], return_index=True, return_inverse=True
    )
    times = table.column("frame_timestamp_ns").to_numpy()[rows][first]
    shape = (len(triggers), len(side.references), 2)
    pixels, spread = np.full((*shape, 2), np.nan), np.full((*shape, 2, 2), np.nan)
    for camera in (0, 1):
        for axis, letter in enumerate("uv"):
            pixels[at, light[rows], camera, axis] = table.column(f"{letter}{camera}_px").to_numpy()[rows]
        for column, (i, j) in enumerate(((0, 0), (0, 1), (1, 1))):
            values = table.column(PIXEL_COVARIANCES[3 * camera + column]).to_numpy()[rows]
            spread[at, light[rows], camera, i, j] = spread[at, light[rows], camera, j, i] = values
    return LightSets(triggers, times, LightSpots(pixels, spread))


def _numbers(side: RigSide, spots: tuple[Detections, Detections]) -> list[NDArray[np.intp]]:
    """For each camera the number of each light's spot, −1 where there is none; of two lights in reach the nearer."""
    places = np.array([light.xyz_m for light in side.references]).reshape(-1, 3)
    numbers = []
    for expected, own in zip(project(side.pair, side.T_body_cam0, places), spots, strict=True):
        chosen = np.full(len(places), -1, dtype=np.intp)
        if len(own):
            apart = np.nan_to_num(np.linalg.norm(expected[:, None] - own.pixels, axis=2), nan=np.inf)
            nearest = apart.argmin(axis=1)
            near = (apart.min(axis=1) < REACH_PX) & (apart[:, nearest].argmin(axis=0) == np.arange(len(places)))
            chosen[near] = nearest[near]
        numbers.append(chosen)
    return numbers


def _without(spots: Detections, numbers: NDArray[np.intp]) -> Detections:
    keep = np.setdiff1d(np.arange(len(spots)), numbers)
    columns = ("u_px", "v_px", "covariance_px2", "amplitude", "area_px", "circularity")
    arrays = {name: getattr(spots, name)[keep] for name in columns}
    return replace(spots, flags=tuple(spots.flags[k] for k in keep), **arrays)
