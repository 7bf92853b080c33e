"""``wingproc calibrate``: two sets of board images to pair.json, and a table of how well the calibration fits."""

import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from capture.console import note, say, say_json
from capture.errors import ProcessError, UsageError
from process.board import Board
from process.calibrate import Calibration, CalibrationSettings, Method, calibration_covariance_m2
from process.calibration_quality import Quality, judge, working_ranges_m
from process.calibration_recording import find_in_recording
from process.calibration_report import write_report
from process.calibration_session import (
    Session,
    SessionCalibration,
    calibrate_session,
    find_session,
    finders_of,
    image_pairs,
)
from process.camera_model import write_pair
from process.charuco import dictionary
from process.cross_validation import FOLDS
from process.json_file import finite_or_none, provenance
from process.recording import Recording, open_recording


def calibrate(
    board: Annotated[str, typer.Option(help="Inner corners of the checkerboard, such as 10x7.")],
    square_mm: Annotated[float, typer.Option(help="Side of one square.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="The pair's file to write (JSON).")],
    flight: Annotated[
        list[Path] | None, typer.Argument(help="A recording in which a board is held still in many places, one by one.")
    ] = None,
    side: Annotated[str | None, typer.Option(help="Of a recording: the pair to calibrate, left or right.")] = None,
    cam0: Annotated[
        str | None, typer.Option(help="Images of the left camera: a quoted pattern such as 'A*.png', or a folder.")
    ] = None,
    cam1: Annotated[str | None, typer.Option(help="Images of the right camera, in the same order.")] = None,
    charuco: Annotated[
        str | None, typer.Option(help="The board is a ChArUco one with markers of this dictionary, such as 4X4_50.")
    ] = None,
    marker_mm: Annotated[float | None, typer.Option(help="Side of a ChArUco board's marker.")] = None,
    method: Annotated[
        Method, typer.Option(help="Everything at once, or the paper's way: each camera alone, then the pose between.")
    ] = Method.joint,
    nominal_board: Annotated[
        bool, typer.Option("--nominal-board", help="Trust the print: do not estimate the board's corners.")
    ] = False,
    distortion_terms: Annotated[
        int, typer.Option(help="5 (k1 k2 p1 p2 k3), or 2 (k1 k2) for a board that covers little of the image.")
    ] = 5,
    flatness_mm: Annotated[
        float, typer.Option(help="Also estimate the board's bow, so large at its farthest corner (one sigma); 0: flat.")
    ] = 0.0,
    folds: Annotated[
        int, typer.Option(help="Cross-validation: the views are held out in so many parts, one by one; 0: none.")
    ] = FOLDS,
    report: Annotated[
        Path | None, typer.Option(help="Also write a report (HTML), its figures beside it in NAME_figures.")
    ] = None,
    workers: Annotated[int, typer.Option(min=1, max=2, help="Processes that look for corners.")] = 2,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Calibrate a camera pair from images, or a recording, of a board seen by both cameras at the same time."""
    settings = _settings(method, nominal_board, distortion_terms, flatness_mm)
    if folds < 0 or folds == 1:
        raise UsageError(f"--folds {folds}: 2 or more, or 0 for no cross-validation")
    target = _board(board, square_mm, charuco, marker_mm)
    source = _source(flight or [], side, cam0, cam1)
    for path in filter(None, (output, report)):
        if not path.resolve().parent.is_dir():
            raise ProcessError(f"{path.parent}: no such folder to write to; make it first")
    result = calibrate_session(_session(source, target, method, workers), settings)
    quality = judge(result.calibration, result.corners_px, target, folds)
    summary = summarise(result, target, quality)
    command = shlex.join(["wingproc", *sys.argv[1:]])
    # of a recording the command says which; its files are too large to be hashed here
    made = provenance(command, [path for pair in source for path in pair] if isinstance(source, list) else [])
    calibration = result.calibration
    write_pair(
        output,
        calibration.pair,
        camera_rms_px=calibration.camera_rms_px,
        stereo_rms_px=calibration.stereo_rms_px,
        provenance=made,
        **{key: summary[key] for key in ("calibration", "board", "views", "quality")},
    )
    if report is not None:
        write_report(report, result, quality, target, summary, command)
    for warning in summary["calibration"]["warnings"]:
        note(f"warning: {warning}")
    if json:
        say_json({**summary, "output": str(output)})
    else:
        _print(summary, output, report)


def _settings(method: Method, nominal_board: bool, distortion_terms: int, flatness_mm: float) -> CalibrationSettings:
    if distortion_terms not in (2, 5):
        raise UsageError(f"--distortion-terms {distortion_terms}: 2 or 5")
    if not 0.0 <= flatness_mm <= 100.0 or (flatness_mm and method is Method.paper):
        raise UsageError(f"--flatness-mm {flatness_mm:g}: 0 to 100 mm, and not with --method paper")
    return CalibrationSettings(method, nominal_board, distortion_terms, flatness_mm / 1000.0)


def _session(
    source: list[tuple[Path, Path]] | tuple[Recording, str], board: Board, method: Method, workers: int
) -> Session:
    with _progress() as progress:
        if isinstance(source, list):
            return find_session(source, board, workers, progress, finders_of(method))
        return find_in_recording(*source, board, workers, progress)


def _source(
    flight: list[Path], side: str | None, cam0: str | None, cam1: str | None
) -> list[tuple[Path, Path]] | tuple[Recording, str]:
    """Pairs of image files, or a recording and a side of it. UsageError when it is neither or both."""
    if flight:
        if cam0 or cam1:
            raise UsageError("give a recording, or --cam0 and --cam1, not both")
        if side not in ("left", "right"):
            raise UsageError("a recording needs --side left or --side right: the pair to calibrate")
        return open_recording(flight), side
    if side is not None:
        raise UsageError("--side is of a recording: name its folder")
    if not cam0 or not cam1:
        raise UsageError("give --cam0 and --cam1, images of both cameras, or a recording's folder with --side")
    return image_pairs(cam0, cam1)


def _board(size: str, square_mm: float, charuco: str | None, marker_mm: float | None) -> Board:
    board = Board.parse(size, square_mm)
    if charuco is None:
        if marker_mm is not None:
            raise UsageError("--marker-mm is a ChArUco board's: give its --charuco dictionary, too")
        return board
    if marker_mm is None or not 0.0 < marker_mm < square_mm:
        raise UsageError(f"--charuco {charuco}: give --marker-mm, the side of a marker, smaller than the square's")
    try:
        dictionary(charuco)
    except KeyError:
        raise UsageError(f"--charuco {charuco}: OpenCV has no such dictionary; 4X4_50 or 5X5_100 are some") from None
    return replace(board, charuco=charuco, marker_m=marker_mm / 1000.0)


def summarise(result: SessionCalibration, board: Board, quality: Quality) -> dict[str, Any]:
    """What is printed, and written beside the parameters."""
    calibration = result.calibration
    pair = calibration.pair
    view_rms_px = np.sqrt(np.nanmean(np.sum(calibration.residuals_px**2, axis=-1), axis=2))
    print_error = calibration.board_m - board.points_m
    names = result.seen
    return {
        "cameras": [
            {
                "rms_px": calibration.camera_rms_px[index],
                "alone_rms_px": calibration.alone_rms_px[index],
                "K": camera.K.tolist(),
                "distortion": camera.distortion.tolist(),
            }
            for index, camera in enumerate((pair.cam0, pair.cam1))
        ],
        "stereo": {"rms_px": calibration.stereo_rms_px, "baseline_m": pair.baseline_m},
        "calibration": {
            "method": calibration.settings.method.value,
            "distortion_terms": calibration.settings.distortion_terms,
            "alone_rms_px": list(calibration.alone_rms_px),
            "two_stage_rms_px": calibration.two_stage_rms_px,
            "stereo_to_mono_ratio": calibration.stereo_to_mono_ratio,
            "library_rms_px": list(calibration.library_rms_px),
            "sigma_px": calibration.sigma_px,
            "gradient": calibration.gradient,
            "finders": list(result.finders),
            "finder_rms_px": list(result.finder_rms_px),
            "predicted_sigma_mm": _predicted_sigma_mm(result),
            "odd_corners": [
                {
                    "view": str(names[view][camera]),
                    "column": corner % board.columns + 1,
                    "row": corner // board.columns + 1,
                    "residual_px": off_px,
                }
                for camera, view, corner, off_px in calibration.odd_corners
            ],
            "warnings": [
                *calibration.warnings,
                *quality.warnings(calibration.sigma_px, [path.name for path, _ in result.used]),
            ],
        },
        "quality": quality.to_dict(),
        "board": {
            "columns": board.columns,
            "rows": board.rows,
            "square_m": board.square_m,
            "estimated": bool(np.any(calibration.board_sigma_m > 0.0)),
            "print_error_rms_m": float(np.sqrt(np.mean(print_error**2))),
            "corners_m": calibration.board_m.tolist(),
            **_flatness(calibration),
        },
        "views": [
            {"cam0": str(path0), "cam1": str(path1), "used": True, "rms_px": view_rms_px[:, index].tolist()}
            for index, (path0, path1) in enumerate(result.used)
        ]
        + [
            {"cam0": str(path0), "cam1": str(path1), "used": False, "reason": reason}
            for path0, path1, reason in result.rejected
        ],
    }


def _flatness(calibration: Calibration) -> dict[str, Any]:
    """The board's bow, from the plane that fits it best: peak to valley; None where it was held flat."""
    if not calibration.freedom.bow_prior_px_per_m:
        return {"flatness_mm": None, "flatness_sigma_mm": None, "height_m": None}
    height_m = calibration.estimate.corners_m[:, 2]
    plane = np.column_stack([calibration.board_m, np.ones(len(height_m))])
    bent_m = height_m - plane @ np.linalg.lstsq(plane, height_m, rcond=None)[0]
    return {
        "flatness_mm": float(1000.0 * np.ptp(bent_m)),
        "flatness_sigma_mm": float(1000.0 * calibration.height_sigma_m.max()),
        "height_m": height_m.tolist(),
    }


def _predicted_sigma_mm(result: SessionCalibration) -> list[dict[str, Any]]:
    """Sigma of a point in the middle of the pair's view, from the calibration alone."""
    pair = result.calibration.pair
    if pair.covariance is None:
        return []
    ranges_m = working_ranges_m(result.calibration)
    points = np.array([pair.middle_of_view(range_m) for range_m in ranges_m])
    sigma_mm = 1000.0 * np.sqrt(np.diagonal(calibration_covariance_m2(pair, points), axis1=1, axis2=2))
    return [
        {"range_m": range_m, "sigma_xyz_mm": [finite_or_none(value) for value in sigma]}
        for range_m, sigma in zip(ranges_m, sigma_mm, strict=True)
    ]


def _print(summary: dict[str, Any], output: Path, report: Path | None) -> None:
    detail, used = summary["calibration"], sum(view["used"] for view in summary["views"])
    say(f"views        {used} of {len(summary['views'])} used, corners by {' and '.join(detail['finders'])}")
    for view in summary["views"]:
        if not view["used"]:
            say(f"  left out   {Path(view['cam0']).name}, {Path(view['cam1']).name}: {view['reason']}")
    for odd in detail["odd_corners"]:
        place = f"column {odd['column']}, row {odd['row']}"
        name = Path(odd["view"]).name
        say(f"  left out   {name}, corner at {place}: {odd['residual_px']:.2f} px off, hidden or a gleam")
    say("             RMS px   alone px        fx        fy        cx        cy")
    for name, camera in zip(("cam0", "cam1"), summary["cameras"], strict=True):
        K = camera["K"]
        say(
            f"{name:<12} {camera['rms_px']:6.4f}   {camera['alone_rms_px']:8.4f}  "
            f"{K[0][0]:8.2f}  {K[1][1]:8.2f}  {K[0][2]:8.2f}  {K[1][2]:8.2f}"
        )
    say(
        f"stereo       {summary['stereo']['rms_px']:6.4f}   {detail['two_stage_rms_px']:8.4f}  (the paper's two stages)"
    )
    say(f"baseline     {1000 * summary['stereo']['baseline_m']:.3f} mm")
    if summary["board"]["estimated"]:
        say(f"print        corners off their places by {1e6 * summary['board']['print_error_rms_m']:.0f} um RMS")
    if summary["board"]["flatness_mm"] is not None:
        say(f"flatness     {summary['board']['flatness_mm']:.3f} mm peak to valley")
    for entry in detail["predicted_sigma_mm"]:
        x, y, z = entry["sigma_xyz_mm"]
        say(f"at {entry['range_m']:g} m       sigma {x:.3f} {y:.3f} {z:.3f} mm (x, y, z of cam0), from the calibration")
    _print_quality(summary["quality"])
    say(f"optimum      gradient {detail['gradient']:.1e}")
    say(f"written      {output}" + (f", {report}" if report else ""))


def _print_quality(quality: dict[str, Any]) -> None:
    for camera, image in enumerate(quality["images"]):
        empty = f", no board {', '.join(image['empty'])}" if image["empty"] else ""
        say(f"coverage     cam{camera} {image['covered_percent']:.0f} % of what both cameras see{empty}")
    held_out = quality["cross_validation"]
    if held_out is not None and held_out["rms_px"] is not None:
        say(f"held out     {held_out['rms_px']:6.4f} px, noise {held_out['noise_ratio']:.2f} times that of the fit")
    advice = quality["next_view"]
    if advice is not None:
        change = f"{advice['worst_sigma_mm']:.2f} to {advice['then_worst_sigma_mm']:.2f} mm"
        say(f"next view    {advice['text']} (sigma at the worst place: {change})")


@contextmanager
def _progress() -> Iterator[Callable[[int, int], None]]:
    columns = (TextColumn("corners"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, console=Console(stderr=True), disable=not sys.stderr.isatty()) as bar:
        task = bar.add_task("corners", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
