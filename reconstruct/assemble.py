"""The parts of a result → its tables on disk, a part at a time, and what sums up over them."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from process.camera_model import Rig
from process.fuselage_lights import LIGHTS_SCHEMA
from process.parts import PartStore
from process.shared_error import with_rig
from process.tables import TableWriter
from reconstruct.beside import Beside
from reconstruct.stages import Key
from reconstruct.tables import FRAMES, LIGHTS, MARKERS, UNLOADED


@dataclass(frozen=True)
class Target:
    """Where to write the tables, and how."""

    out: Path
    csv: bool
    note: Mapping[str, Any]  # how they were made
    rig: Rig | None  # of the markers; None when they were given, and say themselves how they were made
    beside: Beside | None = None  # what was recorded beside the frames
    lights: bool = False  # whether there are any on the fuselage


@dataclass(frozen=True)
class Assembled:
    """What the summary needs to know of the tables."""

    frames: pa.Table
    tallies: Mapping[str, Sequence[Mapping[str, float]]]  # by side, of each part
    wings: pa.Table  # unloaded.parquet


def assemble(store: PartStore, measured: Sequence[Key], fitted: Sequence[Key], target: Target) -> Assembled:
    """Write all tables of a result. ``measured`` and ``fitted`` are the blocks with a part of that kind, in order.

    Raises ProcessError when a file cannot be written.
    """
    tallies: dict[str, list[Mapping[str, float]]] = {}
    frames, unloaded = [], {}
    with ExitStack() as open_files:
        writers: dict[str, TableWriter] = {}
        for key in fitted:
            part = store.read(key.fits)
            tables = dict(part.tables)
            unloaded[key.side] = tables.pop(UNLOADED)  # the same in all parts of a side
            tallies.setdefault(key.side, []).append(part.note)
            if target.beside is not None:
                tables[FRAMES] = target.beside.joined(tables[FRAMES])
            frames.append(tables[FRAMES])
            for name, table in tables.items():
                if name not in writers:
                    made = TableWriter(target.out / name, table.schema, target.note, csv=target.csv)
                    writers[name] = open_files.enter_context(made)
                writers[name].append(table)
    wings = pa.concat_tables([unloaded[side] for side in sorted(unloaded)])
    with TableWriter(target.out / UNLOADED, wings.schema, target.note) as writer:
        writer.append(wings)
    _write_markers(store, measured, target)
    return Assembled(pa.concat_tables(frames), tallies, wings)


def _write_markers(store: PartStore, measured: Sequence[Key], target: Target) -> None:
    schema = store.read(measured[0].markers).tables[MARKERS].schema
    note: Mapping[str, Any] | None = None  # a given table keeps its own
    if target.rig is not None:
        schema, note = with_rig(schema.empty_table(), target.rig).schema, target.note
    with TableWriter(target.out / MARKERS, schema, note, csv=target.csv) as writer:
        for key in measured:
            writer.append(store.read(key.markers).tables[MARKERS])
    if target.lights:
        with TableWriter(target.out / LIGHTS, LIGHTS_SCHEMA, target.note, csv=target.csv) as writer:
            for key in measured:
                writer.append(store.read(key.markers).tables[LIGHTS])
