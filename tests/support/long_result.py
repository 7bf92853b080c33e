"""A short result → one as of a long flight, by repeating it; and what drawing its report takes.

``python long_result.py SHORT LONG SETS`` repeats; ``python long_result.py --draw LONG`` writes MATLAB file, report and
film, and prints this process's largest memory (MB) and the seconds of each as JSON.
"""

import json
import resource
import shutil
import sys
import time
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from process.tables import TableWriter
from reconstruct.tables import FRAMES, LOADS, MARKERS, RESIDUALS, SHAPE, UNLOADED

STEP_NS = 40_000_000
TIMES = ("timestamp_ns", "frame_timestamp_ns", "timestamp0_ns", "timestamp1_ns")


def repeat(short: Path, long: Path, sets: int) -> None:
    """Write ``long``, with so many sets of each wing."""
    long.mkdir(parents=True)
    shutil.copyfile(short / UNLOADED, long / UNLOADED)
    frames = pq.read_table(short / FRAMES)
    once = np.unique(frames.column("trigger_index").to_numpy()).size
    for name in (SHAPE, FRAMES, LOADS, RESIDUALS, MARKERS):
        table = pq.read_table(short / name)
        with TableWriter(long / name, table.schema, {}) as writer:
            for side in ("left", "right"):
                own = table.filter(pc.equal(table.column("side"), side))
                for tile in range(sets // once):
                    writer.append(_later(own, tile * once))
    summary = json.loads((short / "summary.json").read_text())
    summary |= {"triggers": sets // once * once, "sets": 2 * (sets // once) * once, "duration_s": sets * STEP_NS * 1e-9}
    (long / "summary.json").write_text(json.dumps(summary))


def _later(table: pa.Table, triggers: int) -> pa.Table:
    for at, name in enumerate(table.column_names):
        if name == "trigger_index":
            table = table.set_column(at, name, pc.add(table.column(name), triggers))
        elif name in TIMES:
            table = table.set_column(at, name, pc.add(table.column(name), triggers * STEP_NS))
    return table


def draw(long: Path) -> dict[str, float]:
    """Everything that is made from a result's tables."""
    from reconstruct.animation import write_animation
    from reconstruct.mat_file import write_mat
    from reconstruct.report import write_report
    from reconstruct.result import read_result

    found: dict[str, float] = {}
    began = time.monotonic()
    for name, make in (
        ("mat", lambda: write_mat(long)),
        ("report", lambda: write_report(read_result(long), long)),
        ("film", lambda: write_animation(read_result(long), long)),
    ):
        path = make()
        found |= {f"{name}_s": time.monotonic() - began, f"{name}_mb": path.stat().st_size / 1e6}
        found[f"peak_mb_after_{name}"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
        began = time.monotonic()
    return found


if __name__ == "__main__":
    if sys.argv[1] == "--draw":
        print(json.dumps(draw(Path(sys.argv[2]))))
    else:
        repeat(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]))
