"""``wingproc reference``: a window at rest of a flight, or of its marker table, to reference.parquet."""

import shlex
import sys
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pyarrow as pa
import typer

from capture.console import note, say, say_json
from capture.errors import ProcessError, UsageError
from process.camera_model import Rig
from process.json_file import finite_or_none
from process.pipeline import PipelineSettings, markers_of_recording
from process.recording import open_recording
from process.reference import Window, parse_window, rest_shape, within
from process.shared_error import with_rig
from process.tables import MARKER_SCHEMA, read_table, write_table


def reference(
    flight: Annotated[list[Path], typer.Argument(help="The flight's folders, or its marker table (a .parquet file).")],
    window: Annotated[str, typer.Option(help="Seconds of the recording in which the wing is at rest, A:B.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="The reference to write (Parquet).")],
    rig: Annotated[Path | None, typer.Option(help="rig.json of this flight's cameras; needed for frames.")] = None,
    still_mm: Annotated[float, typer.Option(min=0.0, help="The wing may move by this between parts of it.")] = 1.0,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; as many as cores if not given.")] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Take the at-rest shape: each marker's mean place over a window, with its covariance."""
    seconds = parse_window(window, "--window")
    if not output.resolve().parent.is_dir():
        raise ProcessError(f"{output.parent}: no such folder for the reference; make it first")
    if output.resolve() in {path.resolve() for path in [*flight, *([rig] if rig else [])]}:
        raise UsageError(f"{output}: the reference would overwrite an input; name another output")
    table, inputs = _markers(flight, rig, seconds, workers)
    is_table = flight[0].suffix == ".parquet"
    at_rest = rest_shape(table, seconds if is_table else None, still_mm / 1000.0)
    write_table(at_rest, output, command=shlex.join(["wingproc", *sys.argv[1:]]), inputs=inputs)
    summary = summarise(at_rest)
    if json:
        say_json({**summary, "output": str(output)})
        return
    _print(summary)
    say(f"written  {output}")


def _markers(flight: list[Path], rig: Path | None, window: Window, workers: int | None) -> tuple[pa.Table, list[Path]]:
    """The marker table of the window, or a whole one as given; and the input files."""
    tables = [path for path in flight if path.suffix == ".parquet"]
    if tables:
        if len(flight) > 1:
            raise UsageError(f"{tables[0]}: a marker table stands alone; give one table, or folders of one flight")
        return read_table(tables[0], MARKER_SCHEMA), tables
    if rig is None:
        raise UsageError("frames need --rig rig.json (a marker table does not)")
    cameras = Rig.read(rig)
    result = markers_of_recording(within(open_recording(flight), window), cameras, PipelineSettings(), None, workers)
    for problem in result.problems[:5]:
        note(f"warning: {problem}")
    return with_rig(result.table, cameras), [rig]


def summarise(table: pa.Table) -> dict[str, Any]:
    """What is printed: for each side its sets, markers and the sigmas of their places, millimetres, medians."""
    summary: dict[str, Any] = {}
    for side in sorted(set(table.column("side").to_pylist())):
        rows = [row for row in table.to_pylist() if row["side"] == side]
        seen = [row for row in rows if row["sets"]]

        def median_mm(prefix: str, seen: list[dict[str, Any]] = seen) -> float | None:
            variances = [sum(row[f"{prefix}_{axis}{axis}_m2"] for axis in "xyz") for row in seen]
            return finite_or_none(float(1000.0 * np.sqrt(np.median(variances)))) if variances else None

        summary[side] = {
            "sets": max(row["sets"] for row in rows),
            "markers": len(seen),
            "missing": [row["marker"] for row in rows if not row["sets"]],
            "scatter_mm": 1000.0 * max((row["scatter_m"] for row in seen), default=float("nan")),
            "moved_mm": 1000.0 * max((row["moved_m"] for row in seen), default=float("nan")),
            "sigma_noise_mm": median_mm("cov"),
            "sigma_shared_mm": median_mm("shared"),
        }
    return summary


def _print(summary: dict[str, Any]) -> None:
    for side, found in summary.items():
        say(f"{side:<6} {found['markers']} markers, mean of up to {found['sets']} sets")
        if found["missing"]:
            say(f"       not seen: {', '.join(map(str, found['missing']))}")
        say(f"       largest scatter {found['scatter_mm']:.3f} mm, largest motion {found['moved_mm']:.3f} mm")
        shared = found["sigma_shared_mm"]
        said = "not known" if shared is None else f"{shared:.3f} mm, the same in all frames"
        say(f"       sigma of a place, 3-D: {found['sigma_noise_mm'] or 0.0:.4f} mm from noise; from the rig: {said}")
