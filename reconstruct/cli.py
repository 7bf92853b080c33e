"""The ``reconstruct`` command: flights and marker tables to wing shapes, and results to reports."""

import shlex
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar
from rich.text import Text
from typer.core import TyperGroup

from capture.console import note, run, say, say_json
from capture.errors import ReconstructError, UsageError
from process.flights import Flight, find_flights
from process.reference import parse_window
from process.signal_options import DbcOption, MaxGapOption
from process.signal_table import MAX_GAP_S
from reconstruct import options
from reconstruct.air_table import parse_specific_force
from reconstruct.batch import FLIGHTS, outcome_lines, run_flights
from reconstruct.import_wing import import_wing
from reconstruct.plan import plan
from reconstruct.reference import Reference
from reconstruct.report import write_report
from reconstruct.result import COMPARISON, REPORT, SUMMARY, read_json_object, read_result
from reconstruct.run import Job, Progress, Step, run_comparison, run_job
from reconstruct.static import static
from reconstruct.summary import verdict
from reconstruct.wing import example_path

SHOWN_WARNINGS = 20
PICTURES = ("report", "film")  # stages that do not count sets


class _RunByDefault(TyperGroup):
    """``reconstruct FLIGHT … `` is short for ``reconstruct run FLIGHT …``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0] not in self.commands and args[0] not in ctx.help_option_names:
            args = ["run", *args]
        return super().parse_args(ctx, args)


app = typer.Typer(
    cls=_RunByDefault,
    no_args_is_help=True,
    add_completion=False,
    help="From frames or markers to the shape, twist and loads of the wing. `reconstruct FLIGHT …` is short for "
    "`reconstruct run FLIGHT …`.",
)


@app.command("run")
def run_command(
    wing: options.Wing,
    out: options.Out,
    flight: options.Flights = None,
    rig: options.Rig = None,
    markers: options.Markers = None,
    smooth: options.Smooth = 0.0,
    reference: options.ReferenceFile = None,
    reference_window: options.ReferenceWindow = None,
    direct: options.Direct = False,
    root_motion: options.RootMotion = True,
    dbc: DbcOption = None,
    max_gap: MaxGapOption = MAX_GAP_S,
    specific_force: options.Force = None,
    csv: options.Csv = True,
    mat: options.Mat = True,
    mcap: options.Mcap = True,
    netcdf: options.Netcdf = False,
    report: options.Report = True,
    animation: options.Animation = True,
    workers: options.Workers = None,
    scheduler: options.Scheduler = None,
    json: options.Json = False,
) -> None:
    """Reconstruct a flight: markers (from frames, or a table), shapes, loads, summary and report.

    Of several flights, each gets a folder of its name in the output folder, beside flights.json, which says what
    became of each; one that fails does not stop the others. Run again, the command keeps what it had got done.
    """
    flights, table = _sources(list(flight or []), markers)
    _check_files({"--rig": rig, "--wing": wing, "--markers": table})
    if out.exists() and not out.is_dir():
        raise UsageError(f"{out}: is a file; give a folder for the result")
    if dbc and table is not None:
        raise UsageError(
            "--dbc is for a flight: a marker table has its signals beside it, from `wingproc markers --dbc`"
        )
    job = Job(
        flights=tuple(flights),
        rig=rig,
        markers=table,
        wing=wing,
        out=out,
        csv=csv,
        workers=workers,
        command=_command(),
        smooth_s=smooth,
        reference=_reference(reference, reference_window),
        also=tuple(name for name, wanted in (("mat", mat), ("mcap", mcap), ("netcdf", netcdf)) if wanted),
        report=report,
        animation=animation,
        scheduler=scheduler,
        dbc=tuple(dbc or ()),
        max_gap_s=max_gap,
        direct=direct,
        root_motion=root_motion,
        specific_force=None if specific_force is None else parse_specific_force(specific_force),
    )
    several = find_flights(flights)
    if len(several) > 1:
        _run_several(job, several, json=json)
    else:
        _run_one(job, json=json)


def _run_one(job: Job, *, json: bool) -> None:
    with _progress() as progress:
        summary, warnings = run_job(job, progress)
    page = job.out / REPORT
    if json:
        say_json({**summary, "warnings": list(warnings), "report": str(page) if job.report else None})
        return
    for warning in warnings[:SHOWN_WARNINGS]:
        note(f"warning: {warning}")
    if len(warnings) > SHOWN_WARNINGS:
        note(f"warning: and {len(warnings) - SHOWN_WARNINGS} more")
    say(f"sets            {summary['sets']}, fitted {summary['converged_percent']:.2f} %")
    say(f"markers seen    {summary['markers_seen_percent']:.2f} %")
    say(f"residual RMS    {summary['residual_rms_mm']:.3f} mm")
    say(f"tip sigma       {summary['sigma_tip_mm']:.2f} mm, {summary['sigma_tip_twist_deg']:.3f} deg (median)")
    say(f"verdict         {' '.join(verdict(summary))}")
    say(f"time            {summary['wall_s']:.1f} s{_speed(summary)}, {summary['peak_mb']:.0f} MB")
    if summary["sets_without_shape"]:
        say(f"holes           {summary['sets_without_shape']} sets without a shape (see {job.out / SUMMARY})")
    say(f"report          {page}" if job.report else f"written         {job.out}")


def _run_several(job: Job, flights: Sequence[Flight], *, json: bool) -> None:
    outcomes = []
    with _progress() as progress:
        for outcome in run_flights(job, flights, progress):
            outcomes.append(outcome)
            note(f"{outcome.flight.name}: {outcome.state} ({len(outcomes)} of {len(flights)})")
            for warning in outcome.warnings[:SHOWN_WARNINGS]:
                note(f"warning: {outcome.flight.name}: {warning}")
    if json:
        say_json(read_json_object(job.out / FLIGHTS, "run again"))
    else:
        for line in outcome_lines(outcomes):
            say(line)
        say(f"written         {job.out / FLIGHTS}")
    failed = [outcome.flight.name for outcome in outcomes if outcome.state == "failed"]
    if failed:
        raise ReconstructError(
            f"{len(failed)} of {len(flights)} flights failed ({', '.join(failed)}): see {job.out / FLIGHTS}, mend or "
            "leave them out, and run again; what is done is kept"
        )


@app.command("compare")
def compare_command(
    result: Annotated[Path, typer.Argument(help="Folder of `reconstruct run`.")],
    reference: Annotated[Path, typer.Argument(help="Truth, a simulation or another result: same tables.")],
    out: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder for comparison and report; RESULT if not given.")
    ] = None,
    from_start: Annotated[
        bool, typer.Option("--from-start", help="Two flights, or a simulation's own time: count both from their start.")
    ] = False,
    reference_window: Annotated[
        str | None, typer.Option(help="Compare displacements from the mean of these seconds of RESULT too, A:B.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the comparison as JSON.")] = False,
) -> None:
    """Compare a result with a reference, and add the errors to the report."""
    folder = out or result
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder}: is a file; give a folder for the comparison")
    window = None if reference_window is None else parse_window(reference_window, "--reference-window")
    found = run_comparison(result, reference, folder, _command(), from_start=from_start, window=window).summary
    if json:
        say_json(found)
        return
    say(f"sets compared   {found['frames_compared']}, outside of the reference {found['frames_outside_reference']}")
    for name, key, unit in (
        ("marker error", "marker_rms_mm", "mm RMS, 3-D"),
        ("shape error", "shape_rms_mm", "mm RMS, 3-D, all stations"),
        ("tip error", "tip_error_mm", "mm RMS, 3-D"),
        ("twist error", "twist_rms_deg", "deg RMS, all stations"),
        ("moved", "displacement_rms_mm", "mm RMS, 3-D, displacements from the window"),
        ("twisted", "displacement_twist_rms_deg", "deg RMS, from the window"),
        ("within 95 %", "shape_within_95_percent", "% of the position errors are within 1.96 sigma"),
    ):
        if key in found:
            say(f"{name:<15} {'not known' if found[key] is None else f'{found[key]:.3f} {unit}'}")
    say(f"report          {folder / REPORT}")


@app.command("report")
def report_command(
    result: Annotated[Path, typer.Argument(help="Folder of `reconstruct run`.")],
    comparison: Annotated[
        Path | None, typer.Option("--compare", help="comparison.json to include; the result's own if not given.")
    ] = None,
) -> None:
    """Draw a result's report again."""
    own = result / COMPARISON
    chosen = comparison or (own if own.is_file() else None)
    say(str(write_report(read_result(result, chosen), result)))


app.command("static")(static)
app.command("plan")(plan)
app.command("import")(import_wing)


@app.command("example")
def example_command(
    name: Annotated[str, typer.Argument(help="xhale or pazy.")],
    out: Annotated[Path, typer.Option("--output", "-o", help="The wing file to write.")],
) -> None:
    """Write a shipped wing file, to start your own from."""
    source = example_path(f"{name}.toml")
    if not source.is_file():
        known = ", ".join(sorted(path.stem for path in source.parent.glob("*.toml")))
        raise UsageError(f"no example {name!r}; there are {known}")
    shutil.copyfile(source, out)
    say(str(out))


def main() -> None:
    """Entry point of ``reconstruct``."""
    run(app)


def _sources(flights: list[Path], markers: Path | None) -> tuple[list[Path], Path | None]:
    """Flight folders and marker table, one of which is empty. Raises UsageError when neither or both are given."""
    tables = [path for path in flights if path.suffix == ".parquet"]
    if markers is None and len(flights) == 1 and tables:
        return [], tables[0]
    if tables:
        raise UsageError(f"{tables[0]}: a marker table stands alone; give one table, or folders of flights")
    if markers is not None and flights:
        raise UsageError("give a flight or --markers, not both")
    if markers is None and not flights:
        raise UsageError("nothing to reconstruct: give a flight's folders, or --markers markers.parquet")
    for path in flights:
        if not path.exists():
            raise UsageError(f"{path}: no such flight folder (nor a command; see reconstruct --help)")
    return flights, markers


def _reference(result: Path | None, window: str | None) -> Reference:
    if result is not None and window is not None:
        raise UsageError("give --reference or --reference-window, not both")
    return result if window is None else parse_window(window, "--reference-window")


def _check_files(files: dict[str, Path | None]) -> None:
    for option, path in files.items():
        if path is not None and not path.is_file():
            raise UsageError(f"{path}: no such file; give {option} the right one")


def _speed(summary: dict[str, Any]) -> str:
    times = summary["times_real_time"]
    if times is None:
        return ""
    ratio = summary["read_ratio"]
    reading = "" if ratio is None else f", {ratio:.1f} × the time of reading alone"
    return f" ({times:.1f} × real time{reading}; start, report and film apart)"


def _command() -> str:
    return shlex.join(["reconstruct", *sys.argv[1:]])


class _Rate(ProgressColumn):
    """Sets a second, and how much faster than they were flown that is."""

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        if not speed or task.description in PICTURES:
            return Text("")
        flight_s = task.fields["flight_s"]
        return Text(f"{speed:.0f} sets/s" + (f", {speed * flight_s / task.total:.1f} × real time" if flight_s else ""))


@contextmanager
def _progress() -> Iterator[Progress]:
    """A bar a stage on standard error, if that is a terminal."""
    columns = (TextColumn("{task.description:<8}"), BarColumn(), MofNCompleteColumn(), _Rate(), TimeRemainingColumn())
    with Bar(*columns, console=Console(stderr=True), disable=not sys.stderr.isatty()) as bar:
        tasks: dict[str, Any] = {}

        def update(step: Step) -> None:
            if step.stage not in tasks:
                tasks[step.stage] = bar.add_task(step.stage, total=step.total, flight_s=step.flight_s)
            bar.update(tasks[step.stage], completed=step.done)

        yield update
