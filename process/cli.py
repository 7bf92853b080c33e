"""The command ``wingproc``: calibration, the rig, and markers from recordings."""

import typer

from capture.console import run
from process.accuracy_command import accuracy
from process.aim_command import aim
from process.calibrate_command import calibrate
from process.markers_command import markers
from process.monitor_command import monitor
from process.plan_command import plan
from process.reference_command import reference
from process.repose_command import repose
from process.rig_command import rig

app = typer.Typer(no_args_is_help=True, add_completion=False, help="From recorded frames to 3-D markers.")
app.command()(calibrate)
app.command()(rig)
app.command()(repose)
app.command()(reference)
app.command()(markers)
app.command()(accuracy)
app.command()(plan)
app.command()(monitor)
app.command()(aim)


def main() -> None:
    """Entry point of ``wingproc``."""
    run(app)
