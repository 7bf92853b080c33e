"""A result's shapes, net loads and the recorded specific force → the table of aerodynamic loads."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from capture.errors import UsageError
from reconstruct.aerodynamic import aerodynamic, upwards
from reconstruct.beside import Beside
from reconstruct.rotation import Array
from reconstruct.tables import LOAD_COLUMNS, NET_COLUMNS, POSITION, SIDES, SIGMA, read_table
from reconstruct.wing import Wing

AIR = "aerodynamic.parquet"
AIR_COLUMNS = tuple(f"air_{name}" for name in LOAD_COLUMNS)
NAMES = "one load factor (g, positive up), or three accelerations (m/s², body axes: aft, right, up) as X,Y,Z"


@dataclass(frozen=True)
class SpecificForce:
    """Which of the recorded signals tell how the aircraft is accelerated, at the body frame's origin."""

    names: tuple[str, ...]

    def check(self, wing: Wing, beside: Beside | None) -> None:
        """Raises UsageError when a signal was not recorded, or the wing file has no masses."""
        names = [] if beside is None else beside.names
        missing = [name for name in self.names if name not in names]
        if missing:
            raise UsageError(
                f"--specific-force {missing[0]}: no such signal was recorded beside the frames; "
                + (f"there are {', '.join(names)}" if names else "there is none (CAN needs --dbc)")
            )
        if not np.sum(wing.left.mass_kg) + np.sum(wing.right.mass_kg) > 0:
            raise UsageError(
                f"--specific-force: the wing {wing.name!r} has no masses; give mass_per_m or [[mass]] in its file"
            )

    def of(self, frames: pa.Table) -> Array:
        """(F, 3) m/s², body axes, of the sets of frames.parquet."""
        values = [frames.column(name).to_numpy() for name in self.names]
        return upwards(values[0]) if len(values) == 1 else np.column_stack(values)


def parse_specific_force(text: str) -> SpecificForce:
    """Names from ``NAME`` or ``X,Y,Z``. Raises UsageError for another number of them."""
    names = tuple(part.strip() for part in text.split(","))
    if len(names) not in (1, 3) or not all(names):
        raise UsageError(f"--specific-force {text}: name {NAMES}")
    return SpecificForce(names)


def air_table(wing: Wing, shape_path: Path, frames: pa.Table, force: SpecificForce) -> pa.Table:
    """One row a trigger and wing: force (N) and moment about the root (N·m) of the air, and their sigmas.

    Args:
        wing: with the masses that weigh.
        shape_path: shape.parquet; its columns are read a wing at a time.
        frames: frames.parquet, with what was recorded beside the frames.
        force: which signals to take; checked.
    """
    specific_force = force.of(frames)
    noise = [f"noise_{name}" for name in SIGMA]
    shape = read_table(shape_path, ("trigger_index", "side", *POSITION, *noise))
    parts = []
    for side in SIDES:
        own = np.asarray(pc.equal(frames.column("side"), side).to_numpy(zero_copy_only=False))
        if not own.any():
            continue
        half = wing.half(side)
        sets = frames.filter(pa.array(own))
        nodes = len(half.node_s_m)
        places = shape.filter(pc.equal(shape.column("side"), side))
        times_ns = sets.column("timestamp_ns").to_numpy()
        found = aerodynamic(
            half,
            (times_ns - times_ns[0]) * 1e-9,
            _numbers(places, POSITION).reshape(-1, nodes, 3),
            _numbers(places, noise).reshape(-1, nodes, 3),
            _numbers(sets, NET_COLUMNS),
            _numbers(sets, [f"sigma_{name}" for name in NET_COLUMNS]),
            specific_force[own],
        )
        air = np.concatenate([found.force_n, found.moment_nm], axis=1)
        columns = {name: air[:, k] for k, name in enumerate(AIR_COLUMNS)}
        columns |= {f"sigma_{name}": found.sigma[:, k] for k, name in enumerate(AIR_COLUMNS)}
        parts.append(
            pa.table({**{key: sets.column(key) for key in ("trigger_index", "side", "timestamp_ns")}, **columns})
        )
    return pa.concat_tables(parts)


def _numbers(table: pa.Table, names: Sequence[str]) -> Array:
    return np.column_stack([table.column(name).to_numpy() for name in names])
