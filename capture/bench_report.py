"""Bench rows to a table and to a plot of write latency and ring depth in time."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

from capture.bench import BenchRow

PAPER = {(2080, 1552): 3.83, (1920, 1080): 0.9}
"""Dropped frames in percent, the paper's Table 8: fwrite, no buffer, no threads, 30,000 frames at 25 Hz."""


PLOT_FORMATS = (".png", ".pdf", ".svg")


def table(rows: Sequence[BenchRow]) -> Table:
    """The rows as people read them, the paper's figure beside the monolithic ones."""
    made = Table(
        "mode", "size", "Hz", "MB/s", "frames", "dropped", "% dropped", "paper %", "write p50/p99/max ms", "ring",
        "CPU cores",
    )  # fmt: skip
    for row in rows:
        paper = PAPER.get((row.width, row.height)) if row.mode == "monolithic" and row.rate_hz == 25 else None
        made.add_row(
            row.mode,
            f"{row.width}×{row.height}",
            f"{row.rate_hz:g}",
            f"{row.offered_mb_s:.1f}",
            str(row.frames),
            str(row.dropped),
            f"{row.dropped_percent:.2f}",
            "" if paper is None else f"{paper:g}",
            "/".join(f"{row.write_ms[key]:.1f}" for key in ("p50", "p99", "max")),
            f"{row.ring_high_water} of {row.ring_slots}",
            f"{row.cpu_cores:.2f}",
        )
    return made


def ceiling_line(ceiling: dict[str, Any]) -> str:
    """The ceiling in one line."""
    return (
        f"ceiling without loss: {ceiling['mb_s']:.0f} MB/s; raw O_DIRECT on the same disk: "
        f"{ceiling['raw_direct_mb_s']:.0f} MB/s; ratio {ceiling['ratio']:.3f} (medians, {len(ceiling['pairs'])} pairs)"
    )


def plot(rows: Sequence[BenchRow], path: Path) -> None:
    """Write latency of each frame, and the ring's depth in time, one column a row of the table."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, len(rows), figsize=(5 * len(rows), 6), squeeze=False, layout="constrained")
    for column, row in enumerate(rows):
        latency, depth = axes[0][column], axes[1][column]
        latency.plot(row.latencies_ms, ".", markersize=2)
        latency.set_yscale("log")
        latency.set_title(f"{row.mode}, {row.offered_mb_s:.0f} MB/s: {row.dropped_percent:.2f} % dropped")
        latency.set_xlabel("frame in the order of writing")
        latency.set_ylabel("write latency, ms")
        latency.set_ylim(0.1, 3000)
        if not row.ring_depth:
            depth.set_axis_off()
            depth.text(0.5, 0.5, f"one thread, {row.ring_slots} driver buffers a camera", ha="center", color="grey")
            continue
        depth.axhline(row.ring_slots, color="tab:red", linewidth=1, label="ring full")
        depth.plot(*zip(*row.ring_depth, strict=True))
        depth.set_ylim(0, row.ring_slots * 1.05)
        depth.set_xlabel("time, s")
        depth.set_ylabel("ring slots in use")
        depth.legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)
