"""``wingsim``: worlds, calibration sessions, the rig that stands in for the hardware, truth and the demonstration."""

import contextlib
import os
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Protocol, TypeVar

import typer
from rich.console import Console
from rich.progress import Progress

from capture.clock import SystemClock
from capture.console import note, run, say
from capture.errors import UsageError
from hw_sim.demo import demo
from hw_sim.world import FUSELAGE_LIGHTS, MountMotion, World

app = typer.Typer(no_args_is_help=True, add_completion=False, help="Simulated cameras, trigger board and wing.")

WorldOption = Annotated[Path, typer.Option("--world", help="world.toml as `wingsim world` writes it.")]
OutOption = Annotated[Path, typer.Option("--out", "-o", help="Folder to write to.")]


def main() -> None:
    """Entry point of ``wingsim``."""
    run(app)


@app.command()
def world(
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write.")],
    seed: Annotated[int, typer.Option(min=0, help="Everything random follows from it.")] = 1,
    scale: Annotated[int, typer.Option(help="Divides the image size: 1, 2, 4, 8, 16.")] = 1,
    background: Annotated[str, typer.Option(help="dark or sunlit.")] = "dark",
    finish: Annotated[str, typer.Option(help="Of the wing: matt or clean.")] = "matt",
    leds: Annotated[str, typer.Option(help="On the wing: disc, or dome (bulbs that stand off the wing).")] = "disc",
    placement_mm: Annotated[
        float, typer.Option(min=0.0, help="One sigma by which they are off their places on the wing, each axis.")
    ] = 0.0,
    fuselage_lights: Annotated[
        bool, typer.Option("--fuselage-lights", help="Six reference lights a side, on in the survey and in flight.")
    ] = False,
    mount_drift: Annotated[
        tuple[float, float], typer.Option(help="Amplitudes of the camera pairs' slow motion, mm and mrad.")
    ] = (0.0, 0.0),
    mount_vibration: Annotated[
        tuple[float, float], typer.Option(help="Amplitudes of the camera pairs' vibration, mm and mrad.")
    ] = (0.0, 0.0),
) -> None:
    """Write a world: cameras, lights, sensor, wing motion. It is the truth; keep it from the measuring commands."""
    made = World.make(
        seed,
        scale,
        background,
        finish,
        form=leds,
        placement_sigma_m=placement_mm / 1000.0,
        fuselage=FUSELAGE_LIGHTS if fuselage_lights else None,
        mount_motion=MountMotion(
            drift_mm=mount_drift[0],
            drift_mrad=mount_drift[1],
            vibration_mm=mount_vibration[0],
            vibration_mrad=mount_vibration[1],
        ),
    )
    made.write(out)
    say(f"{out}: seed {seed}, {made.sensor.width_px}×{made.sensor.height_px}, {background}, {finish}")


@app.command()
def sessions(
    world: WorldOption,
    out: OutOption,
    workers: Annotated[int, typer.Option(min=1, help="Processes that render.")] = 2,
) -> None:
    """Render the board and survey images that the cameras would have taken, and write survey.toml."""
    from hw_sim.sessions import write_sessions

    known = World.read(world)
    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("images", total=None)
        count = write_sessions(known, out, workers, lambda done, total: bar.update(task, completed=done, total=total))
    say(f"{out}: {count} images and survey.toml")


@app.command()
def rig(
    world: WorldOption,
    socket: Annotated[Path, typer.Option(help="Unix socket to put the four cameras behind.")],
    trigger_port: Annotated[
        Path, typer.Option(help="Where the trigger board's serial port appears (a symbolic link).")
    ],
    truth: Annotated[Path | None, typer.Option(help="Folder for the truth of the flight, written at the end.")] = None,
    can: Annotated[
        str | None,
        typer.Option(
            help="Where the aircraft's CAN bus appears: slcan:PATH (a serial adapter on a pseudo-terminal), or a bus "
            "that python-can opens, such as socketcan:vcan0."
        ),
    ] = None,
    mavlink: Annotated[str | None, typer.Option(help="HOST:PORT that the autopilot sends MAVLink to, by UDP.")] = None,
    armed: Annotated[
        tuple[float, float], typer.Option(help="The autopilot is armed from … to … seconds after the start.")
    ] = (0.0, 0.0),
) -> None:
    """Be the hardware, in real time, until SIGTERM or SIGINT. Says `ready` on standard output when usable.

    At the end the truth from the first to the last trigger is written, 0.2 s more at both ends.
    """
    from hw_sim.rig import Rig
    from hw_sim.senders import make_senders
    from hw_sim.truth import AROUND_NS, clear_truth, write_truth

    known = World.read(world)
    if truth is not None:
        clear_truth(truth)
    with contextlib.suppress(OSError):  # real hardware does not wait for the host's other work; take what is allowed
        os.nice(-10)
    clock = SystemClock()
    hardware = _be(lambda: Rig(known, socket, trigger_port, clock, make_senders(known, clock, can, mavlink, armed)))
    for name, counts in hardware.counts().items():
        note(f"{name}: " + ", ".join(f"{count} {what}" for what, count in counts.items()))
    pulses = hardware.pulses
    if truth is not None and pulses:
        write_truth(known, pulses[0].actual_ns - AROUND_NS, pulses[-1].actual_ns + AROUND_NS, truth, pulses)
        note(f"{truth}: truth of {len(pulses)} triggers")


@app.command()
def gige(
    socket: Annotated[Path, typer.Option(help="Unix socket for `wingsim unplug` and `plug`.")],
    trigger_port: Annotated[
        Path, typer.Option(help="Where the trigger board's serial port appears (a symbolic link).")
    ],
    cameras: Annotated[int, typer.Option(min=1, max=4, help="How many, at 127.0.0.1, .2, …")] = 2,
    width: Annotated[int, typer.Option(min=16, help="Of the sensor, pixels.")] = 2080,
    height: Annotated[int, typer.Option(min=2, help="Of the sensor, pixels.")] = 1552,
) -> None:
    """Be GigE Vision cameras on a trigger line until SIGTERM or SIGINT. Says `ready` on standard output when usable.

    For a network namespace of its own, recorder included: see docs/how-to/cameras.md.
    """
    from hw_sim.gige import GigeRig

    _be(lambda: GigeRig(cameras, (width, height), socket, trigger_port, SystemClock()))


SocketOption = Annotated[Path, typer.Option("--socket", help="The rig's socket.")]
CameraArgument = Annotated[str, typer.Argument(help="left_cam0, left_cam1, right_cam0 or right_cam1.")]


@app.command()
def unplug(camera: CameraArgument, socket: SocketOption) -> None:
    """Pull the plug of one camera of a running rig."""
    from hw_sim.hand import do

    do(socket, "unplug", camera)


@app.command()
def plug(camera: CameraArgument, socket: SocketOption) -> None:
    """Put the plug of an unplugged camera back."""
    from hw_sim.hand import do

    do(socket, "plug", camera)


@app.command("usb-rig")
def usb_rig(
    trigger_port: Annotated[
        Path, typer.Option(help="Where the trigger board's serial port appears (a symbolic link).")
    ],
    cameras: Annotated[int, typer.Option(min=1, max=4, help="How many cameras to plug in.")] = 4,
    buffer_frames: Annotated[int, typer.Option(min=0, help="Frames a camera can hold back (0: 32 MB of them).")] = 0,
    response_ms: Annotated[
        int, typer.Option(min=1, help="The longest time to an answer; also how long Aravis waits for a frame.")
    ] = 200,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            help="What goes wrong, as 0:unplug@40, 0:plug@60, 1:truncate@20 or 2:hold@30-39; can be repeated."
        ),
    ] = None,
) -> None:
    """Plug USB3 Vision cameras into this kernel (module vhci-hcd, root), until SIGTERM. Says `ready` when plugged in.

    They show a pattern that depends on camera and trigger. A fault is told by camera and trigger index.
    """
    from hw_sim.u3v_camera import Kind
    from hw_sim.u3v_rig import U3vRig, UsbFault

    faults = [UsbFault.parse(text) for text in fault or []]
    hardware = _be(lambda: U3vRig(cameras, trigger_port, SystemClock(), Kind(buffer_frames, response_ms), faults))
    for plugged in hardware.plugs:
        counts = vars(plugged.counts).items()
        note(f"{plugged.serial}: " + ", ".join(f"{count} {what}" for what, count in counts))


@app.command()
def dbc(out: Annotated[Path, typer.Option("--out", "-o", help="File to write.")]) -> None:
    """Write the DBC file of the simulated aircraft's CAN bus."""
    from hw_sim.can_node import dbc_text

    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(dbc_text(), encoding="utf-8")
    say(f"{out}: load factor, airspeed, attitude and control surfaces")


@app.command()
def truth(
    world: WorldOption,
    from_ns: Annotated[int, typer.Option("--from-ns", help="UTC nanoseconds.")],
    to_ns: Annotated[int, typer.Option("--to-ns", help="UTC nanoseconds.")],
    out: OutOption,
) -> None:
    """Write the true markers and shapes between two times."""
    from hw_sim.truth import write_truth

    if to_ns <= from_ns:
        raise UsageError(f"--to-ns {to_ns} is not after --from-ns {from_ns}")
    write_truth(World.read(world), from_ns, to_ns, out)
    say(f"{out}: truth of {(to_ns - from_ns) * 1e-9:.3f} s")


@app.command("accuracy-scenes")
def accuracy_scenes(
    out: OutOption,
    focal_mm: Annotated[float, typer.Option(min=2.0, max=50.0, help="Focal length of both lenses.")] = 6.75,
    seed: Annotated[int, typer.Option(min=0, help="Everything random follows from it.")] = 1,
    z_mm: Annotated[str, typer.Option(help="Distances of the targets.")] = "750,1000,1250,1500,1750,2000,2250",
) -> None:
    """Render what an accuracy test looks at: a calibration session, then boards and light pairs at known distances."""
    from hw_sim.accuracy_scenes import write_accuracy_scenes

    try:
        distances_m = tuple(float(value) / 1000.0 for value in z_mm.split(","))
    except ValueError as error:
        raise UsageError(f"--z-mm {z_mm}: give distances such as 1000,2000") from error
    if not all(0.2 <= distance <= 20.0 for distance in distances_m):
        raise UsageError(f"--z-mm {z_mm}: distances are 200 to 20000 mm")
    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("images", total=None)
        count = write_accuracy_scenes(
            seed, focal_mm, distances_m, out, lambda done, total: bar.update(task, completed=done, total=total)
        )
    say(f"{out}: {count} images and truth.json")


app.command("demo")(demo)


class _Hardware(Protocol):
    def start(self) -> None: ...

    def check(self) -> None: ...

    def close(self) -> None: ...


H = TypeVar("H", bound=_Hardware)


def _be(make: Callable[[], H]) -> H:
    """Be the hardware that ``make`` makes, until SIGTERM or SIGINT, or until a part of it fails."""
    asked = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: asked.set())
    hardware = make()
    try:
        hardware.start()
        say("ready")
        while not asked.wait(0.2):
            hardware.check()
    finally:
        hardware.close()
    hardware.check()
    return hardware
