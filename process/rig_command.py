"""``wingproc rig``: two calibrated pairs and a survey to rig.json, and a table of how well the survey fits."""

import shlex
import sys
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from capture.console import note, say, say_json
from capture.errors import ProcessError
from process.board import read_grey
from process.camera_model import Light, MarkerLayout, ReferenceLight, Rig, RigSide, StereoPair, read_pair
from process.detect import Detections, detect
from process.json_file import finite_or_none, provenance
from process.rig import PoseFit, approximate_pose, solve_pose
from process.survey import Survey, SurveySide, read_survey

Array = NDArray[np.float64]


def rig(
    left: Annotated[Path, typer.Argument(help="The left wing's pair, from wingproc calibrate.")],
    right: Annotated[Path, typer.Argument(help="The right wing's pair.")],
    survey: Annotated[Path, typer.Option(help="survey.toml: lights with known places, and the marker layout.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="The rig's file to write (JSON).")],
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Put both camera pairs into the body frame, from pictures of surveyed lights."""
    pairs = {"left": read_pair(left), "right": read_pair(right)}
    surveyed = read_survey(survey)
    if not output.resolve().parent.is_dir():
        raise ProcessError(f"{output.parent}: no such folder to write to; make it first")
    fits = {}
    for side, file in (("left", left), ("right", right)):
        try:
            fits[side] = locate(pairs[side], getattr(surveyed, side))
        except ProcessError as error:
            raise ProcessError(f"{side} side with {file}: {error}; {output} is not written") from error
    inputs = [left, right, survey, *(path for side in pairs for path in _images(getattr(surveyed, side)))]
    made = provenance(shlex.join(["wingproc", *sys.argv[1:]]), inputs)
    summary = {side: summarise(fit) for side, fit in fits.items()}
    build_rig(pairs, surveyed, fits, made).write(output, survey=summary)
    for side, fit in fits.items():
        for warning in fit.warnings:
            note(f"warning: {side}: {warning}")
    if json:
        say_json({**summary, "output": str(output)})
        return
    for side in fits:
        print_fit(side, summary[side])
    say(f"written  {output}")


def locate(pair: StereoPair, side: SurveySide) -> PoseFit:
    """Pose of one pair. ProcessError, naming the picture, if one cannot be used or shows too few of the lights."""
    T_approx = approximate_pose(pair, np.array(side.approx_position_m), np.array(side.approx_outboard))
    return fit_pictures(pair, side, T_approx)


def fit_pictures(pair: StereoPair, side: SurveySide, T_approx: Array) -> PoseFit:
    """Pose of one pair near ``T_approx`` from the survey's pictures. ProcessError names the picture."""
    spots = (_spots(side.cam0_image, pair), _spots(side.cam1_image, pair))
    try:
        return fit_survey(pair, side, T_approx, spots)
    except ProcessError as error:
        raise ProcessError(f"{side.cam0_image}, {side.cam1_image.name}: {error}") from error


def fit_survey(pair: StereoPair, side: SurveySide, T_approx: Array, spots: tuple[Detections, Detections]) -> PoseFit:
    """Pose of one pair near ``T_approx`` from spots in both cameras. Raises what ``solve_pose`` raises."""
    return solve_pose(
        pair,
        T_approx,
        [point.name for point in side.points],
        np.array([point.xyz_m for point in side.points]).reshape(-1, 3),
        np.array([point.sigma_mm / 1000.0 for point in side.points]),
        *spots,
    )


def build_rig(pairs: dict[str, StereoPair], survey: Survey, fits: dict[str, PoseFit], made: dict[str, Any]) -> Rig:
    """The rig's file from its parts."""
    sides = {
        name: RigSide(
            pairs[name],
            fits[name].T_body_cam0,
            getattr(survey, name).cam0_serial,
            getattr(survey, name).cam1_serial,
            1000.0 * survey.row_time_us,
            fits[name].covariance,
            fits[name].by_calibration,
            references_of(getattr(survey, name), fits[name]),
        )
        for name in ("left", "right")
    }
    markers = survey.markers
    millimetres = (markers.standoff_mm, markers.standoff_sigma_mm, markers.dome_radius_mm, markers.dome_sigma_mm)
    light = Light(*(value / 1000.0 for value in millimetres))
    layout = MarkerLayout(markers.pairs_station_m, markers.chord_m, markers.height_m, light)
    return Rig(sides["left"], sides["right"], layout, made)


def references_of(side: SurveySide, fit: PoseFit) -> tuple[ReferenceLight, ...]:
    """The surveyed lights that are seen in flight, too, and where ``fit``'s pictures have them."""
    lights = []
    for point, found in zip(side.points, fit.points, strict=True):
        if point.on_fuselage:
            (u0, v0), (u1, v1) = found.pixels.tolist()
            seen = ((u0, v0), (u1, v1)) if found.used else None
            lights.append(ReferenceLight(point.name, point.xyz_m, point.sigma_mm / 1000.0, seen))
    return tuple(lights)


def _images(side: SurveySide) -> tuple[Path, Path]:
    return side.cam0_image, side.cam1_image


def _spots(path: Path, pair: StereoPair) -> Detections:
    image = read_grey(path)
    if image.shape != (pair.cam0.height, pair.cam0.width):
        raise ProcessError(
            f"{path}: {image.shape[1]}x{image.shape[0]} pixels, but the pair was calibrated at "
            f"{pair.cam0.width}x{pair.cam0.height}; use pictures of the same cameras and mode"
        )
    return detect(image)


def summarise(fit: PoseFit) -> dict[str, Any]:
    """What is printed, and written beside the pose."""
    used = [point for point in fit.points if point.used]
    sigma = np.sqrt(np.diag(fit.covariance))
    return {
        "points": [
            {
                "name": point.name,
                "used": point.used,
                "reason": point.reason,
                "error_mm": [finite_or_none(1000.0 * value) for value in point.error_body_m],
                "residual_px": [finite_or_none(float(np.linalg.norm(pixel))) for pixel in point.residuals_px],
            }
            for point in fit.points
        ],
        "points_used": len(used),
        "rms_mm": 1000.0 * float(np.sqrt(np.mean([np.sum(point.error_body_m**2) for point in used]))),
        "rms_px": float(np.sqrt(np.mean([np.sum(point.residuals_px**2, axis=1) for point in used]))),
        "chi2_ratio": fit.chi2_ratio,
        "sigma_rotation_deg": [float(value) for value in np.degrees(sigma[:3])],
        "sigma_position_mm": [float(1000.0 * value) for value in sigma[3:]],
        "lens": None
        if fit.lens is None
        else {
            "focal_change_percent": [100.0 * float(value) for value in fit.lens.focal_change],
            "focal_sigma_percent": [100.0 * float(value) for value in fit.lens.focal_sigma],
            "turn_deg": [float(value) for value in np.degrees(fit.lens.turn_rad)],
            "turn_sigma_deg": [float(value) for value in np.degrees(fit.lens.turn_sigma_rad)],
        },
        "warnings": fit.warnings,
    }


def print_fit(side: str, summary: dict[str, Any]) -> None:
    say(f"{side:<6}   light        dx      dy      dz mm   cam0    cam1 px")
    for point in summary["points"]:
        if not point["used"]:
            say(f"         {point['name']:<8} left out: {point['reason']}")
            continue
        x, y, z = point["error_mm"]
        first, second = point["residual_px"]
        say(f"         {point['name']:<8} {x:7.2f} {y:7.2f} {z:7.2f}    {first:6.3f}  {second:6.3f}")
    say(
        f"         {summary['points_used']} of {len(summary['points'])} lights, {summary['rms_mm']:.2f} mm and "
        f"{summary['rms_px']:.3f} px RMS, chi2 ratio {summary['chi2_ratio']:.2f}"
    )
    position = " ".join(f"{value:.2f}" for value in summary["sigma_position_mm"])
    rotation = " ".join(f"{value:.4f}" for value in summary["sigma_rotation_deg"])
    say(f"         sigma of the pose: {position} mm, {rotation} deg (x, y, z)")
    lens = summary["lens"]
    if lens is None:
        say("         lenses not checked: too few lights")
        return
    focal = ", ".join(
        f"cam{camera} {change:+.2f} +- {sigma:.2f} %"
        for camera, (change, sigma) in enumerate(
            zip(lens["focal_change_percent"], lens["focal_sigma_percent"], strict=True)
        )
    )
    say(f"         as calibrated: focal lengths {focal}")
