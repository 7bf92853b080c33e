"""`wingcap`: the commands of the recording side."""

import faulthandler
import shutil
import signal
import threading
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from capture import bench_report
from capture.bench import CEILING_PAIRS, MODES, bench_cases, bench_target, ceiling, run_case
from capture.clock import SystemClock
from capture.companions import make_companions, make_signal
from capture.config import load_config
from capture.console import Narrator, run, say, say_json
from capture.control_command import controlled, start, stop
from capture.daemon import Recording, RecordingResult
from capture.devices_command import devices
from capture.disk import SystemDisk
from capture.errors import CaptureError, UsageError
from capture.export_command import export
from capture.finding import Finding, Situation
from capture.health_writer import HealthWriter
from capture.install_command import install, uninstall
from capture.journal import Journal
from capture.lock import sole_recorder
from capture.notify import Notifier, journal_listens
from capture.preflight import preflight as run_checks
from capture.recover import recover_flight
from capture.service import Service
from capture.session import Session
from capture.trigger import is_running
from capture.unfinished import AfterPower
from capture.verify import FlightReport, inspect
from capture.vitals import idle_health
from capture.watchdog import IDLE

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    help="Record a flight, and say what is in a recording and whether it is whole.",
)
PROBLEMS_SHOWN = 50
TABLE_COLUMNS = 130
FlightFolders = Annotated[list[Path], typer.Argument(help="the flight's folder on each disk, or a folder above them")]
Json = Annotated[bool, typer.Option("--json", help="print the result as JSON")]


@app.command()
def record(
    config: Annotated[Path, typer.Option("--config", help="the recorder's TOML file")],
    triggers: Annotated[int, typer.Option(min=0, help="end after this many triggers (0: no limit)")] = 0,
    duration: Annotated[float, typer.Option(min=0, help="end after this many seconds (0: no limit)")] = 0.0,
    json: Json = False,
) -> None:
    """Record until SIGTERM, Ctrl-C, or the given number of triggers or seconds.

    What begins a recording is `start.on` of the configuration. After `wingcap stop` it waits for `wingcap start`.
    """
    loaded, clock = load_config(config), SystemClock()
    disks = (loaded.config.disks.left, loaded.config.disks.right)
    service = Service(loaded.config, clock, Journal() if journal_listens() else Narrator(), Notifier())
    if service.managed:  # the watchdog's SIGABRT then says where each thread stood
        faulthandler.enable()
    with sole_recorder(disks), HealthWriter(loaded.config, clock, service.event) as health:

        def make() -> Recording:
            begins = make_signal(loaded.config, clock)
            companions = [*make_companions(loaded.config, clock, begins), AfterPower(disks)]
            return Recording(loaded, clock, SystemDisk(), service.event, companions, health, service, begins)

        def idle() -> None:
            health.source = idle_health
            service.look(IDLE)

        session = Session(loaded.config.start, make, service.event, idle)
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, lambda *_: threading.Thread(target=session.quit).start())  # it may wait for a lock
        with controlled(session.act, health, service.event):
            in_flight = loaded.config.start.on == "command" and is_running(loaded.config.trigger.port, clock)
            result = session.run(triggers, duration, in_flight)
    service.close()
    if result is None:
        return
    if json:
        say_json(result.as_dict())
    elif service.managed:
        say(_summary(result))
    else:
        _print_result(result)
    if result.failures:
        raise CaptureError("; ".join(result.failures))


@app.command()
def preflight(
    config: Annotated[Path, typer.Option("--config", help="the recorder's TOML file")],
    json: Json = False,
) -> None:
    """Check, with numbers, what a flight needs: clock, trigger board, cameras, USB, disks. Nothing is recorded.

    Exit code 0: go. 1: no go, with each reason and what to do.
    """
    findings: list[Finding] = []
    for finding in run_checks(Situation(load_config(config).config, SystemClock())):
        findings.append(finding)
        if not json:
            say(f"{'ok     ' if finding.ok else 'REFUSED'} {finding.name}: {finding.found}")
            if finding.remedy:
                say(f"        {finding.remedy}")
    refused = [finding for finding in findings if not finding.ok]
    if json:
        say_json({"go": not refused, "findings": [finding.as_dict() for finding in findings]})
    if refused:
        reasons = "; ".join(f"{finding.name}: {finding.found}" for finding in refused)
        raise CaptureError(f"NO GO, {len(refused)} of {len(findings)} checks refuse: {reasons}")
    if not json:
        say(f"GO: {len(findings)} checks")


app.command()(devices)
app.command()(start)
app.command()(stop)


@app.command()
def info(flight: FlightFolders, json: Json = False) -> None:
    """Say what is in a recording, whole or not."""
    report = inspect(flight)
    if json:
        say_json(report.as_dict())
    else:
        _print_report(report)


@app.command()
def verify(flight: FlightFolders, json: Json = False) -> None:
    """Read every byte and check that every trigger of every camera is recorded, or lost with a cause.

    Exit code 0: whole. 1: not whole, with each problem named.
    """
    report = inspect(flight)
    if json:
        say_json(report.as_dict())
    else:
        _print_report(report)
        if report.whole:
            say(
                f"WHOLE: {report.triggers} triggers × {len(report.cameras)} cameras = "
                f"{report.recorded} recorded + {report.lost} lost; every byte of every chunk agrees with its CRC"
            )
    if not report.whole:
        raise CaptureError(
            f"the recording is not whole: {len(report.problems)} problems, the first: {report.problems[0]}"
        )


@app.command()
def recover(
    flight: FlightFolders,
    out: Annotated[Path, typer.Option("--out", "-o", help="a new folder for the recovered copy")],
    json: Json = False,
) -> None:
    """Give back every complete frame of a damaged or unfinished recording, as a copy that `wingcap verify` certifies.

    The original is never touched. Exit code 0: nothing was missing. 3: partial. 1: nothing to give back.
    """
    result = recover_flight(flight, out)
    if json:
        say_json(result.as_dict())
    else:
        say(f"{result.frames} complete frames recovered into {out}, {result.missing} missing")
        for problem in result.problems:
            say(f"  {problem}")
    if not result.frames:
        raise CaptureError(f"{flight[0]}: no complete frame to give back")
    if not result.clean:
        raise typer.Exit(3)


@app.command()
def bench(
    target: Annotated[
        str, typer.Option(help="a folder on the disk to try, `memory`, or `model`: a simulated SSD with stalls")
    ] = ".",
    mode: Annotated[str, typer.Option(help=f"{', '.join(MODES)} or all")] = "all",
    size: Annotated[str, typer.Option(help="image size WxH, or `paper`: 2080x1552 and 1920x1080")] = "2080x1552",
    rate: Annotated[float, typer.Option(min=0.1, max=1000, help="triggers a second")] = 25.0,
    frames: Annotated[int, typer.Option(min=0, help="frames a camera (0: 20 s; the paper's run: 30000)")] = 0,
    find_ceiling: Annotated[bool, typer.Option("--ceiling", help="find the highest rate without loss too")] = False,
    plot: Annotated[Path | None, typer.Option(help="write latency and ring depth in time, to this image")] = None,
    json: Json = False,
) -> None:
    """Dropped frames, write latency and CPU of the recording path: the paper's Table 8, and ours beside it.

    At most 8 GB of the target's space are used, and freed at the end.
    """
    cases = bench_cases(mode, size, rate, frames)
    if target == "model" and find_ceiling:
        raise UsageError("--ceiling measures a real disk: give its folder with --target, not `model`")
    if plot is not None and plot.suffix not in bench_report.PLOT_FORMATS:
        raise UsageError(f"--plot {plot}: give a file that ends in {', '.join(bench_report.PLOT_FORMATS)}")
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that the target's space is freed
    with bench_target(target) as (folder, disk), Progress(console=Console(stderr=True), transient=True) as bar:
        rows = []
        for number, case in enumerate(cases):
            task = bar.add_task(f"{case.mode} {case.width}×{case.height} {case.rate_hz:g} Hz", total=1.0)
            rows.append(run_case(case, folder / str(number), disk(), lambda x, t=task: bar.update(t, completed=x)))  # type: ignore[misc]
            shutil.rmtree(folder / str(number), ignore_errors=True)
        found = None
        if find_ceiling:
            task = bar.add_task("ceiling", total=1.0)
            found = ceiling(cases[-1], folder, CEILING_PAIRS, lambda x: bar.update(task, completed=x))
    if plot is not None:
        bench_report.plot(rows, plot)
    if json:
        say_json({"rows": [row.as_dict() for row in rows], "ceiling": found})
        return
    console = Console()
    Console(width=max(console.width, TABLE_COLUMNS)).print(bench_report.table(rows))
    if found is not None:
        say(bench_report.ceiling_line(found))


app.command()(export)
app.command()(install)
app.command()(uninstall)


def main() -> None:
    """Entry point."""
    run(app)


def _summary(result: RecordingResult) -> str:
    return (
        f"{result.flight}: {result.triggers} triggers in {result.seconds:.1f} s, "
        f"{result.recorded} frames recorded, {result.lost} lost"
    )


def _print_result(result: RecordingResult) -> None:
    say(_summary(result))
    table = Table("camera", "recorded", "lost", "ring high water", title=None)
    for place, account in result.accounts.items():
        lost = ", ".join(f"{n} at {stage}" for stage, n in account.lost.items()) or "0"
        water = f"{result.ring_high_water[place]} of {result.ring_slots}"
        table.add_row("/".join(place), str(account.recorded), lost, water)
    Console().print(table)
    for folder in result.folders:
        say(f"  {folder}")


def _print_report(report: FlightReport) -> None:
    size_gb = report.size_bytes / 1e9
    seconds = (report.last_trigger_ns - report.first_trigger_ns) / 1e9
    flight = report.provenance.get("flight", "unnamed")
    say(f"{flight}: {report.triggers} triggers over {seconds:.2f} s, {size_gb:.2f} GB in {len(report.files)} files")
    modes = ", ".join(report.write_modes)
    say(f"recorded by wingshape {report.provenance.get('version', 'unknown')}, write mode {modes}")
    table = Table("camera", "size", "recorded", "lost")
    for name, camera in sorted(report.cameras.items()):
        lost = ", ".join(f"{n} at {stage}" for stage, n in camera.lost.items()) or "0"
        table.add_row(name, f"{camera.width}×{camera.height}", str(camera.recorded), lost)
    Console().print(table)
    for remark in report.notes:
        say(f"note: {remark}")
    for gate in sorted(report.marks.values(), key=lambda gate: gate.begin_ns)[:PROBLEMS_SHOWN]:
        lasted = f"for {(gate.end_ns - gate.begin_ns) / 1e9:.1f} s" if gate.end_ns else "from then on"
        after_s = (gate.begin_ns - report.first_trigger_ns) / 1e9
        say(f"marked: {gate.name}, {after_s:.1f} s after the first trigger, {lasted}: {gate.cause}")
    for problem in report.problems[:PROBLEMS_SHOWN]:
        say(f"PROBLEM: {problem}")
    if len(report.problems) > PROBLEMS_SHOWN:
        say(f"… and {len(report.problems) - PROBLEMS_SHOWN} more: `--json` lists them all")
