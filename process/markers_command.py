"""``wingproc markers``: a flight's frames to its marker table, and a summary of how that went."""

import math
import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pyarrow.compute as pc
import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from capture.console import note, say, say_json
from capture.errors import ProcessError, UsageError
from process.camera_model import Rig
from process.detect import DetectSettings
from process.drift import drift, drift_path, worst
from process.fuselage_lights import lights_path
from process.match import MatchSettings
from process.pipeline import MarkersResult, PipelineSettings
from process.pipeline import markers as run_pipeline
from process.shared_error import with_rig
from process.signal_options import DbcOption, MaxGapOption
from process.signal_table import MAX_GAP_S, sets_of, signal_table, signals_path
from process.signals import read_signals
from process.tables import write_table

SHOWN_PROBLEMS = 20


class Detection(StrEnum):
    """Choices of ``--detection``."""

    default = "default"
    fast = "fast"
    paper = "paper"


class Matching(StrEnum):
    """Choices of ``--matching``."""

    default = "default"
    paper = "paper"


class Triangulation(StrEnum):
    """Choices of ``--triangulation``."""

    default = "default"
    linear = "linear"
    paper = "paper"


def markers(
    flight: Annotated[list[Path], typer.Argument(help="The flight's folders; each is searched two levels deep.")],
    rig: Annotated[Path, typer.Option(help="rig.json of this flight's cameras.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="The table to write (Parquet).")],
    detection: Annotated[
        Detection, typer.Option(help="Fit each spot, windowed centroids (fast), or the paper's contour centroids.")
    ] = Detection.default,
    matching: Annotated[
        Matching, typer.Option(help="Epipolar geometry and the wing's layout, or the paper's sorting by rows.")
    ] = Matching.default,
    triangulation: Annotated[
        Triangulation,
        typer.Option(help="Least reprojection error, least algebraic one (MATLAB's), or the paper's matrix Q."),
    ] = Triangulation.default,
    dbc: DbcOption = None,
    max_gap: MaxGapOption = MAX_GAP_S,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; up to one a core if not given.")] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
) -> None:
    """Measure the markers: frames to 3-D positions in the body frame, with covariances and times.

    What was recorded beside the frames (CAN, analog, MAVLink) goes to OUTPUT_signals.parquet, at the frames' instants.
    """
    if output.resolve() == rig.resolve():
        raise UsageError(f"{output}: the table would overwrite the rig file; name another output")
    if not output.resolve().parent.is_dir():
        raise ProcessError(f"{output.parent}: no such folder for the table; make it first")
    settings = PipelineSettings(
        DetectSettings(method=detection.value),
        MatchSettings(method="rows" if matching is Matching.paper else "default"),
        triangulation.value,
    )
    cameras = Rig.read(rig)
    signals = read_signals(flight, dbc or ())
    with _progress() as progress:
        result = run_pipeline(flight, cameras, settings, progress, workers)
    command = shlex.join(["wingproc", *sys.argv[1:]])
    write_table(with_rig(result.table, cameras), output, command=command, inputs=[rig])
    beside = signal_table(sets_of(result.table), signals, max_gap)
    write_table(beside, signals_path(output), command=command, inputs=dbc or ())
    if result.lights.num_rows:
        write_table(result.lights, lights_path(output), command=command, inputs=[rig])
    moved = drift(result.table, result.lights, cameras)
    write_table(moved, drift_path(output), command=command, inputs=[rig])
    summary = summarise(result) | {"drift": worst(moved), "signals": [signal.name for signal in signals.signals]}
    problems = tuple(dict.fromkeys((*result.problems, *signals.problems)))  # both have read the aux files
    if json:
        say_json(
            {**summary, "problems": list(problems), "output": str(output), "output_signals": str(signals_path(output))}
        )
        return
    for problem in problems[:SHOWN_PROBLEMS]:
        note(f"warning: {problem}")
    if len(problems) > SHOWN_PROBLEMS:
        note(f"warning: and {len(problems) - SHOWN_PROBLEMS} more")
    _print(summary, output)


def summarise(result: MarkersResult) -> dict[str, Any]:
    """The figures that tell how a run went."""
    table = result.table
    x_m, epipolar_px = (table.column(name).to_numpy() for name in ("x_m", "epipolar_px"))
    seen = np.isfinite(x_m)
    flags = table.column("flags").to_pylist()
    reasons: dict[str, int] = {}
    for entry in flags:
        for flag in filter(None, entry.split(",")):
            reasons[flag] = reasons.get(flag, 0) + 1
    return {
        "triggers": len(pc.unique(table.column("trigger_index"))),
        "frame_sets": result.frame_sets,
        "marker_rows": table.num_rows,
        "markers_seen": int(seen.sum()),
        "seen_percent": 100.0 * float(seen.mean()) if len(seen) else math.nan,
        "epipolar_rms_px": float(np.sqrt(np.mean(epipolar_px[seen] ** 2))) if seen.any() else math.nan,
        "flags": dict(sorted(reasons.items())),
        "rejected_blobs": dict(sorted(result.rejected.items())),
        "seconds": result.seconds,
        "frame_sets_per_s": result.frame_sets / result.seconds if result.seconds > 0 else math.nan,
    }


def _print(summary: dict[str, Any], output: Path) -> None:
    say(f"frame sets      {summary['frame_sets']} of {summary['triggers']} triggers")
    say(f"markers seen    {summary['seen_percent']:.2f} % ({summary['markers_seen']} of {summary['marker_rows']})")
    say(f"epipolar RMS    {summary['epipolar_rms_px']:.3f} px")
    for title, counts in (("flags", summary["flags"]), ("turned down", summary["rejected_blobs"])):
        if counts:
            say(f"{title:<15} " + ", ".join(f"{reason} {count}" for reason, count in counts.items()))
    for side, found in summary["drift"].items():
        _print_drift(side, found)
    if summary["signals"]:
        say(f"signals         {len(summary['signals'])}: {', '.join(summary['signals'])}")
    say(f"rate            {summary['frame_sets_per_s']:.1f} frame sets/s ({summary['seconds']:.1f} s)")
    say(f"written         {output}")


def _print_drift(side: str, found: dict[str, float]) -> None:
    for name, what in (("epipolar", "epipolar residual"), ("lights", "fuselage lights")):
        if f"{name}_px" in found:
            tip, sigma = found[f"{name}_tip_mm"], found[f"{name}_tip_sigma_mm"]
            say(f"{'drift ' + side:<15} {what} {found[f'{name}_px']:+.3f} px: {tip:.2f} +- {sigma:.2f} mm at the tip")


@contextmanager
def _progress() -> Iterator[Callable[[int, int], None]]:
    """A bar with the rate on standard error, if that is a terminal."""
    columns = (
        TextColumn("markers"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), disable=not sys.stderr.isatty()) as bar:
        task = bar.add_task("markers", total=None, rate="")

        def update(done: int, total: int) -> None:
            speed = bar.tasks[task].speed
            bar.update(task, completed=done, total=total, rate=f"{speed:.0f} frame sets/s" if speed else "")

        yield update
