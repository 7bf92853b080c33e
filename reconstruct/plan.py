"""A wing file and a noise into what error which marker layout buys: the ``reconstruct plan`` command."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from capture.console import say, say_json
from capture.errors import UsageError
from reconstruct.identify import Identified, identify
from reconstruct.wing import build_wing, read_wing_file
from reconstruct.wing_file import FitSettings, Markers, Pair, WingFile

PAIRS = (3, 5, 7, 9, 12)
SPACINGS_MM = (10.0, 30.0, 60.0, 100.0, 140.0, 180.0)
STATIONS = (1, 2, 3, 4, 6)
_PAIRS_WITHOUT_FILE = 9


def plan(
    wing: Annotated[Path, typer.Option(help="wing.toml: structure, markers and prior.")],
    noise_mm: Annotated[float, typer.Option(help="One sigma of each coordinate of a marker, mm.", min=1e-4)] = 1.0,
    json: Annotated[bool, typer.Option("--json", help="Print the table as JSON.")] = False,
    plot: Annotated[Path | None, typer.Option(help="Draw the errors into this file (png, pdf, svg).")] = None,
) -> None:
    """What error which marker layout buys: number of pairs, distance of fore and aft light, load stations."""
    described = read_wing_file(wing)
    table = plan_table(described, 1e-3 * noise_mm)
    if plot is not None:
        _draw(table, noise_mm, plot)
    if json:
        say_json({"wing": str(wing), "noise_mm": noise_mm, **table})
        return
    _print(table, noise_mm)


def plan_table(described: WingFile, noise_m: float) -> dict[str, Any]:
    """The file's own layout, and others: rows of ``Identified``, with the layout's numbers.

    Args:
        described: the wing; without markers, nine pairs a little in from the chord's ends stand for its own.
        noise_m: one sigma of each coordinate of a marker.
    """
    own = described.markers.pairs or _even(described, _PAIRS_WITHOUT_FILE, None)
    spacing = float(np.median([pair.chord_m[0] - pair.chord_m[1] for pair in own]))
    fit = described.fit or build_wing(described).fit
    rows = [_row(described, own, fit, noise_m, "as in the file" if described.markers.pairs else "assumed")]
    rows += [_row(described, _even(described, count, spacing), fit, noise_m, f"{count} pairs") for count in PAIRS]
    rows += [
        _row(described, _respaced(own, 1e-3 * apart), fit, noise_m, f"{apart:g} mm apart")
        for apart in SPACINGS_MM
        if 1e-3 * apart <= _widest(described, own)
    ]
    span = described.semispan_m
    for k in STATIONS:
        stations = tuple(span * (i + 1) / k for i in range(k))
        chosen = fit.model_copy(update={"load_stations_m": stations})
        rows.append(_row(described, own, chosen, noise_m, f"{k} load station{'s' if k > 1 else ''}"))
    return {"rows": rows, "warnings": rows[0].pop("warnings")}


def _row(described: WingFile, pairs: tuple[Pair, ...], fit: FitSettings, noise_m: float, layout: str) -> dict[str, Any]:
    changed = described.model_copy(update={"markers": Markers(pairs=pairs), "fit": fit})
    found: Identified = identify(
        build_wing(changed).right, fit, np.tile(noise_m**2 * np.eye(3), (2 * len(pairs), 1, 1))
    )
    spacing = float(np.median([pair.chord_m[0] - pair.chord_m[1] for pair in pairs]))
    numbers = asdict(found)
    if not np.isfinite(found.condition):
        numbers["condition"] = None
    return {
        "layout": layout,
        "pairs": len(pairs),
        "spacing_mm": 1e3 * spacing,
        "load_stations": len(fit.load_stations_m),
        **numbers,
        "twist_is_measured": found.twist_is_measured,
        **({"warnings": found.warnings} if layout in ("as in the file", "assumed") else {}),
    }


def _even(described: WingFile, count: int, spacing_m: float | None) -> tuple[Pair, ...]:
    """``count`` pairs evenly along the span, the last a thirtieth of it inboard of the tip."""
    span = described.semispan_m
    pairs = []
    for station in np.linspace(span / count, span * 29 / 30, count) if count > 1 else [span * 29 / 30]:
        segment = described.segment_at(float(station))
        chord = segment.chord_m or 0.1 * span
        middle = (segment.axis - 0.5) * chord
        apart = 0.8 * chord if spacing_m is None else spacing_m
        pairs.append(Pair(station_m=float(station), chord_m=(middle + apart / 2, middle - apart / 2)))
    return tuple(pairs)


def _respaced(pairs: tuple[Pair, ...], apart_m: float) -> tuple[Pair, ...]:
    return tuple(
        pair.model_copy(update={"chord_m": (sum(pair.chord_m) / 2 + apart_m / 2, sum(pair.chord_m) / 2 - apart_m / 2)})
        for pair in pairs
    )


def _widest(described: WingFile, pairs: tuple[Pair, ...]) -> float:
    """How far apart fore and aft light may be on every pair's chord."""
    chords = [described.segment_at(pair.station_m).chord_m for pair in pairs]
    known = [chord for chord in chords if chord is not None]
    return min(known) if known else float("inf")


def _print(table: dict[str, Any], noise_mm: float) -> None:
    say(f"one instant, all markers, {noise_mm:g} mm sigma a coordinate; RMS over the span, as the fit would state it")
    heads = ("shape mm", "twist deg", "tip mm", "tip deg", "twist is", "condition")
    say(f"{'layout':<18}" + "".join(f"{head:>11}" for head in heads))
    for row in table["rows"]:
        cells = (
            f"{row['shape_sigma_mm']:.2f}",
            f"{row['twist_sigma_deg']:.3f}",
            f"{row['tip_sigma_mm']:.2f}",
            f"{row['tip_twist_sigma_deg']:.3f}",
            "measured" if row["twist_is_measured"] else "predicted",
            "singular" if row["condition"] is None else f"{row['condition']:.1e}",
        )
        say(f"{row['layout']:<18}" + "".join(f"{cell:>11}" for cell in cells))
    say(f"told least: {table['rows'][0]['weakest_load']}; condition is that of plain least squares on the loads")
    for warning in table["warnings"]:
        say(f"warning: {warning}")


def _draw(table: dict[str, Any], noise_mm: float, path: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 2, sharey="row")
    by_count = [row for row in table["rows"] if row["layout"].endswith(" pairs")]
    by_spacing = [row for row in table["rows"] if row["layout"].endswith(" apart")]
    for column, (rows, key, label) in enumerate(
        ((by_count, "pairs", "pairs on a half wing"), (by_spacing, "spacing_mm", "fore to aft light, mm"))
    ):
        for line, (value, name) in enumerate((("shape_sigma_mm", "shape, mm"), ("twist_sigma_deg", "twist, deg"))):
            axes[line, column].plot([row[key] for row in rows], [row[value] for row in rows], "o-")
            axes[line, column].set(ylim=(0, None), ylabel=name if column == 0 else "", xlabel=label if line else "")
            axes[line, column].grid(alpha=0.3)
    figure.suptitle(f"RMS over the span, one instant, {noise_mm:g} mm sigma a coordinate")
    try:
        figure.savefig(path)
    except (ValueError, OSError) as error:
        raise UsageError(f"{path}: {error}; give a .png, .pdf or .svg in a folder that exists") from error
