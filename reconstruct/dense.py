"""A result folder's tables → dense arrays by side, and those to NetCDF files, pandas and xarray."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from capture.errors import UsageError
from reconstruct.result import SUMMARY, read_json_object
from reconstruct.tables import FRAMES, LOADS, MARKERS, RESIDUALS, SHAPE, SIDES, UNLOADED, read_table

NETCDF = "result.nc"
ITEMS = {SHAPE: "station", FRAMES: "", LOADS: "load_station", RESIDUALS: "marker", MARKERS: "marker"}
"""of each table, what a set has several of"""

Arrays = Mapping[str, np.ndarray[Any, Any]]


@dataclass(frozen=True)
class ResultFolder:
    """What ``reconstruct run`` left in a folder, for a notebook."""

    folder: Path

    @property
    def summary(self) -> dict[str, Any]:
        """summary.json."""
        return read_json_object(self.folder / SUMMARY, "give a result of `reconstruct run`")

    def to_arrow(self, table: str = "frames") -> pa.Table:
        """A table by its name: frames, shape, loads, residuals, markers, unloaded. UsageError when there is none."""
        path = self.folder / f"{table}.parquet"
        if path.name not in (*ITEMS, UNLOADED):
            raise UsageError(f"{table!r} is no table of a result; there are frames, shape, loads, residuals, markers")
        return read_table(path, ())

    def to_pandas(self, table: str = "frames") -> Any:
        """A table as a DataFrame, with a ``time`` column (UTC) beside ``timestamp_ns``."""
        frame = self.to_arrow(table).to_pandas()
        if "timestamp_ns" in frame:
            frame["time"] = frame["timestamp_ns"].astype("datetime64[ns]")
        return frame

    def to_xarray(self) -> Any:
        """Shapes, tips and loads as a Dataset with the dimensions side, trigger, station and load_station.

        A set that one wing lacks is NaN. Needs xarray.
        """
        import xarray

        sides = []
        for side, tables in dense_tables(self.folder, (SHAPE, FRAMES, LOADS)).items():
            variables: dict[str, Any] = {}
            for table, arrays in tables.items():
                item = ITEMS[table]
                for name, values in arrays.items():
                    if name in ("trigger_index", "timestamp_ns", item, "s_m", "flags", "reason"):
                        continue
                    label = f"load_{name}" if table == LOADS else name
                    variables[label] = (("trigger", item) if item else ("trigger",), values)
            shape, loads = tables[SHAPE], tables[LOADS]
            variables["time_s"] = ("trigger", shape["timestamp_ns"] * 1e-9)
            coordinates = {
                "trigger": shape["trigger_index"],
                "station": shape["station"],
                "s_m": ("station", shape["s_m"][0]),
                "load_station": loads["load_station"],
                "load_s_m": ("load_station", loads["s_m"][0]),
            }
            sides.append(xarray.Dataset(variables, coordinates).assign_coords(side=side))
        whole = xarray.concat(sides, "side", join="outer", coords="different", compat="equals")
        whole.attrs["wingshape"] = json.dumps(how_made(self.summary))
        return whole


def dense_tables(folder: Path, tables: tuple[str, ...]) -> dict[str, dict[str, dict[str, Any]]]:
    """side → table → column → (F,) or (F, items) array; trigger_index, timestamp_ns and the items (n,) once.

    Raises UsageError when a table is missing or is not whole.
    """
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for name in tables:
        table = read_table(folder / name, ("trigger_index", "side"))
        for side in SIDES:
            own = table.filter(pc.equal(table.column("side"), side))
            if own.num_rows:
                found.setdefault(side, {})[name] = _dense(own, ITEMS[name], str(folder / name))
    return found


def write_netcdf(folder: Path) -> Path:
    """``result.nc`` in the result's folder: ``ResultFolder.to_xarray`` as NetCDF 3. UsageError when xarray is missing.

    NetCDF 3 has no 64-bit integers: ``trigger`` is 32 bits wide, the time is ``time_s``.
    """
    try:
        dataset = ResultFolder(folder).to_xarray()
    except ImportError as error:
        raise UsageError("NetCDF needs xarray: pip install 'wingshape[notebook]'") from error
    path = folder / NETCDF
    for name in ("trigger", "station", "load_station"):
        dataset[name] = dataset[name].astype("int32")
    dataset.to_netcdf(path, engine="scipy")
    return path


def _dense(table: pa.Table, item: str, name: str) -> dict[str, Any]:
    trigger = table.column("trigger_index").to_numpy()
    triggers, row = np.unique(trigger, return_inverse=True)
    arrays: dict[str, Any] = {"trigger_index": triggers}
    place, shape = row, [triggers.size]
    if item:
        items, column = np.unique(table.column(item).to_numpy(), return_inverse=True)
        arrays[item] = items
        place, shape = row * items.size + column, [triggers.size, items.size]
    if place.size != np.prod(shape) or np.bincount(place).max() > 1:
        raise UsageError(f"{name}: has sets that are not whole")
    order = np.argsort(place)
    for field in table.schema:
        if field.name in ("trigger_index", "side", item):
            continue
        values = table.column(field.name).to_numpy(zero_copy_only=False)[order].reshape(shape)
        per_set = field.name == "frame_timestamp_ns" or (field.name == "timestamp_ns" and name.endswith(SHAPE))
        arrays[field.name] = values[:, 0] if per_set and item else values
    return arrays


def how_made(summary: Mapping[str, Any]) -> dict[str, Any]:
    """What a file says of how it was made."""
    return {key: summary.get(key) for key in ("version", "command", "versions", "inputs", "recording", "config")}
