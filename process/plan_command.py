"""``wingproc plan``: field of view, and predicted error of each marker, of a mount before it is built."""

import re
from typing import Annotated, Any

import numpy as np
import typer

from capture.console import say, say_json
from capture.errors import UsageError
from process.board import Board
from process.camera_model import MarkerLayout
from process.json_file import finite_or_none
from process.plan import Mount, Prediction, calibrated, ideal_pair, predict

FOCALS_MM = (3.5, 6.75, 10.0)


def plan(
    focal_mm: Annotated[
        list[float] | None, typer.Option(help="Focal length; may be repeated. 3.5, 6.75 and 10 if not given.")
    ] = None,
    baseline_mm: Annotated[float, typer.Option(min=10.0, max=5000.0, help="Between the cameras.")] = 279.4,
    position_m: Annotated[
        str, typer.Option(help="Middle between the cameras, body frame (x aft, y right, z up).")
    ] = "0.03,-0.2,0.08",
    pitch_deg: Annotated[float, typer.Option(min=-45.0, max=45.0, help="How far up the pair looks.")] = 8.0,
    size_px: Annotated[str, typer.Option(help="Of the sensor.")] = "2080x1552",
    pixel_um: Annotated[float, typer.Option(min=0.5, max=20.0, help="Side of a pixel.")] = 2.5,
    pairs_m: Annotated[
        str, typer.Option(help="Stations of the marker pairs from the root.")
    ] = "0.2,0.5,0.8,1.2,1.5,1.8,2.2,2.5,2.8",
    chord_m: Annotated[str, typer.Option(help="Fore and aft light, positive forward of the axis.")] = "0.04,-0.10",
    light_mm: Annotated[float, typer.Option(min=0.1, max=50.0, help="Diameter of a light.")] = 3.0,
    tip_slope_deg: Annotated[float, typer.Option(min=-60.0, max=85.0, help="Of the bent wing.")] = 11.0,
    board: Annotated[str, typer.Option(help="Inner corners of the calibration board.")] = "10x7",
    square_mm: Annotated[float, typer.Option(help="Side of one square.")] = 30.0,
    views: Annotated[int, typer.Option(min=6, max=200, help="Of the board, for the calibration.")] = 15,
    json: Annotated[bool, typer.Option("--json", help="Print the prediction as JSON.")] = False,
) -> None:
    """Predict what a mount on the right wing will see, and how well it will place each marker."""
    position, stations, chord = (
        _numbers(text, name)
        for text, name in ((position_m, "--position-m"), (pairs_m, "--pairs-m"), (chord_m, "--chord-m"))
    )
    if len(position) != 3 or len(chord) != 2 or chord[0] <= chord[1]:
        raise UsageError("--position-m has three numbers, --chord-m two, the fore light's (the larger one) first")
    if list(stations) != sorted(set(stations)) or stations[0] <= 0.0 or len(stations) < 2:
        raise UsageError("--pairs-m: two stations at least, growing outboard")
    size = re.fullmatch(r"(\d+)[x×](\d+)", size_px)
    if size is None:
        raise UsageError(f"--size-px {size_px}: give WIDTHxHEIGHT")
    layout = MarkerLayout(stations, (chord[0], chord[1]), 0.004)
    target, pitch = Board.parse(board, square_mm), np.radians(pitch_deg)
    found = []
    for focal in focal_mm or FOCALS_MM:
        mount = Mount(
            focal,
            pixel_um,
            (int(size[1]), int(size[2])),
            baseline_mm / 1000.0,
            (position[0], position[1], position[2]),
            (0.0, float(np.cos(pitch)), float(np.sin(pitch))),
        )
        pair = calibrated(ideal_pair(mount), target, views)
        prediction = predict(mount, pair, layout, float(np.radians(tip_slope_deg)), light_mm / 1000.0)
        found.append(_summary(focal, prediction))
    if json:
        say_json({"mounts": found})
        return
    for summary in found:
        _print(summary)


def _numbers(text: str, name: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError as error:
        raise UsageError(f"{name} {text}: give numbers with commas between") from error


def _summary(focal_mm: float, prediction: Prediction) -> dict[str, Any]:
    return {
        "focal_mm": focal_mm,
        "field_of_view_deg": list(prediction.field_of_view_deg),
        "markers_in_view": int(prediction.in_view.sum()),
        "markers": [
            {
                "marker": number,
                "xyz_m": place.tolist(),
                "in_view": bool(seen),
                "noise_sigma_mm": [finite_or_none(value) for value in noise],
                "calibration_sigma_mm": [finite_or_none(value) for value in shared],
            }
            for number, (place, seen, noise, shared) in enumerate(
                zip(
                    prediction.places_m,
                    prediction.in_view,
                    prediction.noise_mm,
                    prediction.calibration_mm,
                    strict=True,
                )
            )
        ],
    }


def _print(summary: dict[str, Any]) -> None:
    wide, tall = summary["field_of_view_deg"]
    say(
        f"F {summary['focal_mm']:g} mm   field of view {wide:.1f} by {tall:.1f} deg, "
        f"{summary['markers_in_view']} of {len(summary['markers'])} markers in view of both cameras"
    )
    say("  marker       y m   noise x     y     z mm   calibration x     y     z mm")
    for marker in summary["markers"]:
        if not marker["in_view"]:
            say(f"  {marker['marker']:>6}  {marker['xyz_m'][1]:8.3f}   not in view")
            continue
        noise = " ".join(f"{value:5.3f}" for value in marker["noise_sigma_mm"])
        shared = " ".join(f"{value:5.3f}" for value in marker["calibration_sigma_mm"])
        say(f"  {marker['marker']:>6}  {marker['xyz_m'][1]:8.3f}     {noise}              {shared}")
