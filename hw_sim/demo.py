"""The demonstration: a simulated flight through every command of the chain, run and printed as a user would run them.

What is true of the simulated world stays in a private folder until everything is measured; only the last, comparing
command gets to see it, as ``OUT/truth``.
"""

import importlib.util
import json
import os
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from capture.console import say, say_json
from capture.errors import SimulationError, UsageError
from capture.record import SIDES
from hw_sim.world import World

RIG_READY_S = 60.0
RIG_STOP_S = 60.0
_MARK = ".wingshape-demo"  # says that a folder may be replaced by the next demonstration
BOARD = "10x7"  # inner corners
SQUARE_MM = "30"
PLACEMENT_MM = "0.2"  # of the lights: what the wing file says (marker_model_sigma_m)


def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="folder for everything; an earlier demo in it is replaced")],
    seconds: Annotated[float, typer.Option(min=1.0, max=3600.0, help="length of the flight")] = 10.0,
    seed: Annotated[int, typer.Option(min=0, help="everything random follows from it")] = 1,
    scale: Annotated[int, typer.Option(min=1, max=8, help="divides the image size: 1, 2, 4 (quick) or 8")] = 1,
    json_output: Annotated[bool, typer.Option("--json", help="print the summary as JSON too")] = False,
) -> None:
    """A simulated flight: calibrate, record in real time, reconstruct, compare with the truth."""
    started_s = time.monotonic()
    world = World.make(seed, scale)
    triggers = round(seconds * world.trigger_rate_hz)
    _clear(out)
    _check_space(out, world, triggers)
    with tempfile.TemporaryDirectory(prefix="wingsim-", dir=_short_folder()) as private:
        hidden = Path(private)
        steps = Steps(out)
        _prepare(steps, hidden, seed, scale)
        _record(steps, hidden, world, triggers)
        _measure(steps)
        shutil.move(hidden / "truth", out / "truth")
    steps.run("reconstruct", "compare", "result", "truth")
    summary = _summary(out, started_s, seconds)
    (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    _print_summary(summary, steps)
    if json_output:
        say_json(summary)
    say(f"report: {(out / 'result/report.html').resolve()}")


class Steps:
    """Runs commands in the demo's folder, prints each, and keeps how long it took."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.seconds: dict[str, float] = {}

    def run(self, command: str, *words: str) -> None:
        """Run one command to its end.

        Raises:
            SimulationError: it failed; what it said has been printed.
        """
        say(f"\n$ {shlex.join([command, *words])}")
        begin_s = time.monotonic()
        done = subprocess.run([executable(command), *words], cwd=self.folder)
        name = f"{command} {words[0]}"
        self.seconds[name] = self.seconds.get(name, 0.0) + time.monotonic() - begin_s
        if done.returncode != 0:
            raise SimulationError(
                f"`{command} {words[0]}` failed with exit code {done.returncode}: see its message above"
            )


def executable(command: str) -> str:
    """The path of one of our commands: beside this Python, else on the PATH."""
    beside = Path(sys.executable).parent / command
    found = str(beside) if beside.exists() else shutil.which(command)
    if found is None:
        raise SimulationError(f"the command {command} is not installed: run `pip install -e .` in the checkout")
    return found


def _clear(out: Path) -> None:
    if out.exists() and any(out.iterdir()):
        if not (out / _MARK).exists():
            raise UsageError(f"{out}: is not empty and is no earlier demo: give an empty or a new folder")
        shutil.rmtree(out)
    out.mkdir(parents=True, exist_ok=True)
    (out / _MARK).touch()


def _short_folder() -> str | None:
    """A socket's path may not be longer than about 100 bytes; some temporary folders are."""
    return "/tmp" if len(tempfile.gettempdir()) > 60 and os.access("/tmp", os.W_OK) else None


def _check_space(out: Path, world: World, triggers: int) -> None:
    need = 1.1 * triggers * len(world.cameras) * world.sensor.width_px * world.sensor.height_px + 1e9
    free = shutil.disk_usage(out).free
    if free < need:
        raise UsageError(
            f"{out}: {free / 1e9:.1f} GB free, {need / 1e9:.1f} GB needed: give another folder or fewer --seconds"
        )


def _prepare(steps: Steps, hidden: Path, seed: int, scale: int) -> None:
    """What happens before the flight: the world, the calibration day, the rig's and the wing's files."""
    world_path = hidden / "world.toml"
    steps.run(
        "wingsim", "world", "-o", str(world_path), "--seed", str(seed), "--scale", str(scale),
        "--fuselage-lights", "--placement-mm", PLACEMENT_MM,
    )  # fmt: skip
    steps.run("wingsim", "sessions", "--world", str(world_path), "-o", "ground")
    for side in SIDES:
        images = f"ground/board_{side}/cam"
        steps.run(
            "wingproc", "calibrate", "--cam0", f"{images}0_*.png", "--cam1", f"{images}1_*.png",
            "--board", BOARD, "--square-mm", SQUARE_MM, "-o", f"ground/{side}.json",
        )  # fmt: skip
    steps.run(
        "wingproc", "rig", "ground/left.json", "ground/right.json", "--survey", "ground/survey.toml",
        "-o", "ground/rig.json",
    )  # fmt: skip
    steps.run("reconstruct", "example", "xhale", "-o", "ground/wing.toml")
    steps.run("wingsim", "dbc", "-o", "ground/aircraft.dbc")


def _record(steps: Steps, hidden: Path, world: World, triggers: int) -> None:
    rig = RigAddresses(hidden / "rig.sock", hidden / "trigger", hidden / "can", _mavlink_port())
    config = steps.folder / "wingcap.toml"
    config.write_text(recorder_config(world, rig), encoding="utf-8")
    for side in SIDES:
        (steps.folder / f"ssd_{side}").mkdir()
    with _hardware(hidden / "world.toml", rig, hidden / "truth"):
        steps.run("wingcap", "record", "--config", "wingcap.toml", "--triggers", str(triggers))
    steps.run("wingcap", "verify", "ssd_left/demo", "ssd_right/demo")


def _measure(steps: Steps) -> None:
    steps.run(
        "wingproc", "markers", "ssd_left/demo", "ssd_right/demo", "--rig", "ground/rig.json",
        "--dbc", "ground/aircraft.dbc", "-o", "markers.parquet",
    )  # fmt: skip
    steps.run(
        "reconstruct", "run", "--markers", "markers.parquet", "--rig", "ground/rig.json", "--wing", "ground/wing.toml",
        "-o", "result",
    )  # fmt: skip


@dataclass(frozen=True)
class RigAddresses:
    """Where the simulated hardware is to be found."""

    socket: Path
    trigger_port: Path
    can_port: Path
    mavlink_port: int | None  # None: there is no pymavlink to hear it with


def _mavlink_port() -> int | None:
    """A UDP port that is free."""
    if importlib.util.find_spec("pymavlink") is None:
        return None
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def recorder_config(world: World, rig: RigAddresses) -> str:
    """The recorder's configuration for a simulated rig; both disks are folders beside it."""
    lines = [
        'flight = "demo"',
        'calibration = "ground/rig.json"',
        "",
        "[trigger]",
        f'port = "{rig.trigger_port}"',
        f"rate_hz = {world.trigger_rate_hz}",
        "",
        "[disks]",
        'left = "ssd_left"',
        'right = "ssd_right"',
        "",
        "[camera]",
        'backend = "simulated"',
        f"width = {world.sensor.width_px}",
        f"height = {world.sensor.height_px}",
        f"exposure_us = {world.cameras[0].exposure_us}",
        f"gain_db = {world.cameras[0].gain_db}",
    ]
    for camera in world.cameras:
        lines += [
            "",
            "[[cameras]]",
            f'side = "{camera.side}"',
            f'name = "{camera.name}"',
            f'address = "{rig.socket}#{camera.key}"',
            f'serial = "{camera.serial}"',
        ]
    lines += [
        "",
        "[[can]]",
        'name = "aircraft"',
        'interface = "slcan"',
        f'channel = "{rig.can_port}"',
        "options = { bitrate = 500000, sleep_after_open = 0.0 }",
        "",
        "[analog]",
        "channels = [",
        '    { channel = 0, name = "elevator_analog_deg", scale = 10.0, offset = -25.0 },',
        '    { channel = 1, name = "aileron_analog_deg", scale = 10.0, offset = -25.0 },',
        "]",
    ]
    if rig.mavlink_port is not None:
        lines += ["", "[mavlink]", f'address = "udp:127.0.0.1:{rig.mavlink_port}"']
    return "\n".join(lines) + "\n"


@contextmanager
def _hardware(world: Path, rig: RigAddresses, truth: Path) -> Iterator[None]:
    """The simulated hardware, running as a process of its own; it writes the truth when it is switched off."""
    words = ["rig", "--world", str(world), "--socket", str(rig.socket), "--trigger-port", str(rig.trigger_port)]
    words += ["--truth", str(truth), "--can", f"slcan:{rig.can_port}"]
    if rig.mavlink_port is not None:
        words += ["--mavlink", f"127.0.0.1:{rig.mavlink_port}"]
    say(f"\n$ {shlex.join(['wingsim', *words])} &")
    process = subprocess.Popen([executable("wingsim"), *words], stdout=subprocess.PIPE, text=True)
    try:
        _await_ready(process)
        yield
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            code = process.wait(RIG_STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            code = -1
        if process.stdout is not None:
            process.stdout.close()
    if code != 0:
        raise SimulationError(f"the simulated hardware ended with exit code {code}: its truth is not to be trusted")


def _await_ready(process: subprocess.Popen[str]) -> None:
    assert process.stdout is not None
    os.set_blocking(process.stdout.fileno(), False)
    deadline_s = time.monotonic() + RIG_READY_S
    while time.monotonic() < deadline_s and process.poll() is None:
        if "ready" in (process.stdout.readline() or ""):
            return
        time.sleep(0.02)
    how = "ended at once" if process.poll() is not None else f"was not ready within {RIG_READY_S:g} s"
    raise SimulationError(f"the simulated hardware {how}: see its message above")


def _summary(out: Path, started_s: float, flight_s: float) -> dict[str, Any]:
    answer = subprocess.run(
        [executable("wingcap"), "info", "ssd_left/demo", "ssd_right/demo", "--json"],
        cwd=out,
        capture_output=True,
        text=True,
        check=True,
    )
    recording = json.loads(answer.stdout)
    comparison = json.loads((out / "result/comparison.json").read_text(encoding="utf-8"))
    pairs = {side: json.loads((out / f"ground/{side}.json").read_text(encoding="utf-8")) for side in SIDES}
    return {
        "triggers": recording["triggers"],
        "frames_recorded": recording["frames_recorded"],
        "frames_lost": recording["frames_lost"],
        "reprojection_rms_px": max(pair["stereo"]["rms_px"] for pair in pairs.values()),
        **{key: comparison[key] for key in ("marker_rms_mm", "shape_rms_mm", "tip_error_mm", "twist_rms_deg")},
        "flight_s": flight_s,
        "wall_s": time.monotonic() - started_s,
    }


def _print_summary(summary: dict[str, Any], steps: Steps) -> None:
    table = Table("figure", "value", title="The flight, against the truth")
    for label, key, form in (
        ("triggers", "triggers", "{}"),
        ("frames recorded", "frames_recorded", "{}"),
        ("frames lost", "frames_lost", "{}"),
        ("calibration: reprojection error, px RMS", "reprojection_rms_px", "{:.3f}"),
        ("marker error, mm RMS", "marker_rms_mm", "{:.2f}"),
        ("shape error, mm RMS", "shape_rms_mm", "{:.2f}"),
        ("shape error at the tip, mm RMS", "tip_error_mm", "{:.2f}"),
        ("twist error, degrees RMS", "twist_rms_deg", "{:.3f}"),
    ):
        table.add_row(label, form.format(summary[key]))
    for name, seconds in steps.seconds.items():
        table.add_row(f"time of {name}, s", f"{seconds:.1f}")
    table.add_row("time in all, s", f"{summary['wall_s']:.1f}")
    say()
    Console().print(table)
