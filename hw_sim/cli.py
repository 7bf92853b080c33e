"""``wingsim``: worlds, calibration sessions, the rig that stands in for the hardware, truth and the demonstration."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import Progress

from capture.console import run, say
from hw_sim.demo import demo
from hw_sim.world import World

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
) -> None:
    """Write a world: cameras, lights, sensor, wing motion. It is the truth; keep it from the measuring commands."""
    made = World.make(seed, scale, background, finish)
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


app.command("demo")(demo)
