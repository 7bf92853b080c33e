"""A wing file and a loads file into the wing's static shape: the ``reconstruct static`` command."""

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from capture.console import say, say_json
from capture.errors import ReconstructError
from reconstruct.equilibrium import Equilibrium, solve
from reconstruct.loads_file import loads_on, read_loads
from reconstruct.wing import HalfWing, read_wing, twist_rad

_ROWS = 12  # of the table on the screen, at most


def static(
    wing: Annotated[Path, typer.Option(help="wing.toml: structure and masses.")],
    loads: Annotated[Path, typer.Option(help="loads.toml: forces, moments, gravity.")],
    side: Annotated[str, typer.Option(help="Which half: right or left.")] = "right",
    json: Annotated[bool, typer.Option("--json", help="Print every node as JSON.")] = False,
    plot: Annotated[Path | None, typer.Option(help="Draw shape and twist into this file (png, pdf, svg).")] = None,
) -> None:
    """Solve a forward case: displacement and twist along a half wing under given loads.

    Displacement and twist are counted from the unloaded, weightless shape.
    """
    if side not in ("left", "right"):
        raise typer.BadParameter("give left or right", param_hint="--side")
    described = read_loads(loads)
    half = read_wing(wing, described.stations_m).half(side)
    acting = loads_on(half, described)
    found = solve(half.beam, acting)
    if not found.converged:
        raise ReconstructError(
            f"{loads}: no static shape: {found.reason}; check the loads against the wing's stiffness"
        )
    result = _result(half, found, acting.conservative)
    if plot is not None:
        _draw(half, found, plot)
    if json:
        say_json({"wing": str(wing), "loads": str(loads), **result})
    else:
        _print(result)


def _result(half: HalfWing, found: Equilibrium, conservative: bool) -> dict[str, Any]:
    position = found.shape.position_m
    moved = position - half.rest_position_m
    twist = np.degrees(twist_rad(half, found.shape.R_body_section))
    nodes = [
        {
            "s_m": float(half.node_s_m[i]),
            "position_m": position[i].tolist(),
            "displacement_m": moved[i].tolist(),
            "twist_deg": float(twist[i]),
        }
        for i in range(len(position))
    ]
    return {
        "side": half.side,
        "converged": found.converged,
        "stable": found.stable if conservative else None,  # an energy tells for dead forces only
        "iterations": found.iterations,
        "load_steps": found.load_steps,
        "residual": found.residual,
        "tip": nodes[-1],
        "nodes": nodes,
    }


def _print(result: dict[str, Any]) -> None:
    say(f"{result['side']} half wing, displacement from the unloaded shape (x aft, y right, z up)")
    say(f"{'s m':>9} {'dx mm':>10} {'dy mm':>10} {'dz mm':>10} {'twist deg':>10}")
    nodes = result["nodes"]
    shown = sorted({round(i) for i in np.linspace(0, len(nodes) - 1, min(_ROWS, len(nodes)))})
    for node in (nodes[i] for i in shown):
        x, y, z = (1e3 * value for value in node["displacement_m"])
        say(f"{node['s_m']:9.4f} {x:10.3f} {y:10.3f} {z:10.3f} {node['twist_deg']:10.4f}")
    steps = f"{result['iterations']} iterations, {result['load_steps']} load steps"
    kept = "stability is not judged for moments and follower loads"
    if result["stable"] is not None:
        kept = "stable" if result["stable"] else "not a minimum of the energy: the wing will not stay in this shape"
    say(f"converged in {steps}, residual {result['residual']:.1e}; {kept}")


def _draw(half: HalfWing, found: Equilibrium, path: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 6), layout="constrained")
    FigureCanvasAgg(figure)
    above, below = figure.subplots(2, 1)
    for shape, style, label in ((half.rest_position_m, "k--", "unloaded"), (found.shape.position_m, "C0-", "loaded")):
        above.plot(shape[:, 1], shape[:, 2], style, label=label)
    above.set(xlabel="y, m", ylabel="z, m", aspect="equal", title=f"{half.side} half wing, seen from behind")
    above.legend()
    below.plot(half.node_s_m, np.degrees(twist_rad(half, found.shape.R_body_section)))
    below.set(xlabel="s, m", ylabel="twist, deg (nose-up)")
    below.grid(alpha=0.3)
    try:
        figure.savefig(path)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--plot") from error
