"""``wingcap export``: a flight off the aircraft's disks, by command."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import DownloadColumn, Progress, TimeRemainingColumn, TransferSpeedColumn

from capture.console import say, say_json
from capture.export import SUMS, export_bytes, export_flight


def export(
    flight: Annotated[list[Path], typer.Argument(help="the flight's folder on each disk")],
    out: Annotated[Path, typer.Option("--out", "-o", help="an existing folder on the disk to copy to")],
    json: Annotated[bool, typer.Option("--json", help="print the result as JSON")] = False,
) -> None:
    """Copy a flight off the aircraft's disks, read the copy back, and list its checksums. The source is only read.

    Interrupted, it goes on where it stopped when run again. `sha256sum --check SHA256SUMS` repeats the check anywhere.
    """
    columns = (*Progress.get_default_columns()[:3], DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("copy and read back", total=export_bytes(flight))
        result = export_flight(flight, out, lambda done: bar.advance(task, done))
    if json:
        say_json(result.as_dict())
        return
    say(f"{result.folder}: {result.files} files, {result.bytes / 1e9:.2f} GB copied and read back without a difference")
    if result.kept:
        say(f"  {result.kept} files were there already, from an earlier export")
    say(f"  checksums: {result.folder / SUMS}")
