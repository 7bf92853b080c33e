"""``wingproc repose``: a rig and a new look at its surveyed lights to the rig with new poses, lenses checked."""

import shlex
import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from capture.console import note, say, say_json
from capture.errors import ProcessError
from process.camera_model import MarkerLayout, Rig, RigSide
from process.detect import Detections, detect
from process.flight_cameras import check_cameras
from process.json_file import provenance
from process.match import wing_places_m
from process.recording import FrameSetReader, Recording, open_recording
from process.rig import PoseFit
from process.rig_command import fit_pictures, fit_survey, print_fit, references_of, summarise
from process.survey import SurveySide, read_survey

SETS_TRIED = 50


def repose(
    rig: Annotated[Path, typer.Argument(help="rig.json whose poses are to be renewed.")],
    survey: Annotated[Path, typer.Option(help="survey.toml: the lights with known places, and new pictures of them.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="The rig's file to write (JSON).")],
    flight: Annotated[
        list[Path] | None, typer.Option(help="Take the lights from this recording instead of the survey's pictures.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Renew the poses of a rig in the field from its surveyed lights; the calibration stays, and is checked."""
    old, surveyed = Rig.read(rig), read_survey(survey)
    if not output.resolve().parent.is_dir():
        raise ProcessError(f"{output.parent}: no such folder to write to; make it first")
    recording = open_recording(flight) if flight else None
    if recording is not None:
        check_cameras(recording.files, old)
    sides, summary = {}, {}
    for name in ("left", "right"):
        known, side = old.side(name), getattr(surveyed, name)
        _check_serials(rig, survey, name, known, side)
        try:
            fit = _locate(known, side, recording, name)
        except ProcessError as error:
            raise ProcessError(f"{name} side of {rig}: {error}; {output} is not written") from error
        sides[name] = replace(
            known,
            T_body_cam0=fit.T_body_cam0,
            pose_covariance=fit.covariance,
            pose_by_calibration=fit.by_calibration,
            references=references_of(side, fit),
        )
        summary[name] = {**summarise(fit), "moved": _moved(name, old.markers, known, sides[name])}
        for warning in fit.warnings:
            note(f"warning: {name}: {warning}")
    made = provenance(shlex.join(["wingproc", *sys.argv[1:]]), [rig, survey])
    Rig(sides["left"], sides["right"], old.markers, made).write(output, survey=summary)
    if json:
        say_json({**summary, "output": str(output)})
        return
    for name, found in summary.items():
        print_fit(name, found)
        moved = found["moved"]
        say(
            f"         moved since the rig was made: {moved['turn_deg']:.3f} deg, {moved['shift_mm']:.2f} mm; "
            f"{moved['tip_mm']:.2f} mm at the tip"
        )
    say(f"written  {output}")


def _check_serials(rig: Path, survey: Path, name: str, known: RigSide, side: SurveySide) -> None:
    if (known.cam0_serial, known.cam1_serial) != (side.cam0_serial, side.cam1_serial):
        raise ProcessError(
            f"{survey}: its {name} cameras are {side.cam0_serial} and {side.cam1_serial}, those of {rig} "
            f"{known.cam0_serial} and {known.cam1_serial}: other cameras need their own calibration and `wingproc rig`"
        )


def _locate(known: RigSide, side: SurveySide, recording: Recording | None, name: str) -> PoseFit:
    if recording is None:
        return fit_pictures(known.pair, side, known.T_body_cam0)
    return fit_survey(known.pair, side, known.T_body_cam0, _first_spots(recording, name))


def _first_spots(recording: Recording, name: str) -> tuple[Detections, Detections]:
    """Spots of the side's first frame set that both cameras have a frame of."""
    with FrameSetReader() as reader:
        for places in recording.sides.get(name, ())[:SETS_TRIED]:
            first, second = reader.read(places).images
            if first is not None and second is not None:
                return detect(first), detect(second)
    raise ProcessError(f"{recording.files[0].parent}: no frame of both cameras in its first {SETS_TRIED} sets")


def _moved(name: str, layout: MarkerLayout, before: RigSide, after: RigSide) -> dict[str, Any]:
    """How far the pair has moved in the body frame, and what that is at the outermost markers."""
    change = after.T_body_cam0 @ np.linalg.inv(before.T_body_cam0)
    cosine = 0.5 * (np.trace(change[:3, :3]) - 1.0)
    sine = 0.5 * np.linalg.norm(change[:3, :3] - change[:3, :3].T) / np.sqrt(2.0)
    tip = wing_places_m(name, layout, 0.3)[-2:]
    apart = tip @ change[:3, :3].T + change[:3, 3] - tip
    return {
        "turn_deg": float(np.degrees(np.arctan2(2.0 * sine, 2.0 * cosine))),
        "shift_mm": float(1000.0 * np.linalg.norm(after.T_body_cam0[:3, 3] - before.T_body_cam0[:3, 3])),
        "tip_mm": float(1000.0 * np.linalg.norm(apart, axis=1).max()),
    }
