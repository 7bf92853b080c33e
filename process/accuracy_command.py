"""``wingproc accuracy``: the paper's Tables 5, 6 and 7 on rendered scenes, through the commands a user has."""

import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from capture.console import note, say, say_json
from capture.errors import ProcessError, UsageError
from process.accuracy import BOARD, Calibrated, TargetError, measure_targets, read_calibrated
from process.accuracy_report import markdown, write_plots
from process.json_file import finite_or_none, provenance, write_json

FOCALS_MM = (3.5, 6.75, 10.0)
SOURCES = ("cam0", "cam1", "stereo")
PAPER_PX = {3.5: (0.60, 0.69, 0.70), 6.75: (0.67, 0.72, 0.73), 10.0: (1.13, 1.28, 1.42)}
"""Table 5"""
PAPER_MM = {
    "board": {
        3.5: {750: 0.22, 1000: 0.99, 1250: 1.55, 1500: 2.30, 1750: 2.88, 2000: 3.42},
        6.75: {1250: 0.4, 1500: 1.4, 1750: 2.5, 2000: 4.4},
        10.0: {1750: 0.90, 2000: 1.98, 2250: 2.82},
    },
    "lights": {
        3.5: {750: 3.41, 1000: 3.86, 1250: 4.29, 1500: 4.78, 1750: 5.19, 2000: 5.61, 2250: 6.27},
        6.75: {1250: 4.07, 1500: 4.83, 1750: 5.61, 2000: 6.40, 2250: 7.13},
        10.0: {1750: 4.02, 2000: 4.76, 2250: 5.52},
    },
}
"""Tables 6 and 7, magnitudes"""


def accuracy(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for tables, plots and the calibrations.")],
    focal_mm: Annotated[
        list[float] | None, typer.Option(help="Focal length; may be repeated. 3.5, 6.75 and 10 if not given.")
    ] = None,
    calibrations: Annotated[int, typer.Option(min=1, help="Independent calibrations that figures are medians of.")] = 3,
    seed: Annotated[int, typer.Option(min=0, help="Of the first one; each has the next.")] = 100,
    z_mm: Annotated[str, typer.Option(help="Distances.")] = "750,1000,1250,1500,1750,2000,2250",
    keep: Annotated[bool, typer.Option("--keep", help="Keep the pictures.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the tables as JSON.")] = False,
) -> None:
    """Repeat the paper's accuracy tests (Tables 5, 6, 7) on rendered scenes, the paper's methods beside ours.

    About 30 s a calibration and focal length. Needs `wingsim`, which renders.
    """
    if not output.resolve().parent.is_dir():
        raise ProcessError(f"{output.parent}: no such folder to write to; make it first")
    focals = tuple(focal_mm or FOCALS_MM)
    if len(set(focals)) < len(focals):
        raise UsageError("--focal-mm: each focal length once")
    output.mkdir(exist_ok=True)
    tables: dict[str, list[dict[str, Any]]] = {"table5": [], "table6": [], "table7": [], "figure10": []}
    for focal in focals:
        runs = []
        for number in range(calibrations):
            note(f"F = {focal:g} mm, calibration {number + 1} of {calibrations}")
            runs.append(_run(output / f"f{focal:g}_{seed + number}", focal, seed + number, z_mm, keep))
        tables["table5"] += _table5(focal, [(ours, papers) for ours, papers, _ in runs])
        for table, kind in (("table6", "board"), ("table7", "lights")):
            tables[table] += _rows(focal, kind, [errors for _, _, errors in runs])
        tables["figure10"] += _by_place(focal, runs[0][2])
    result = {
        "calibrations": calibrations,
        "seed": seed,
        **tables,
        "provenance": provenance(shlex.join(["wingproc", *sys.argv[1:]]), []),
    }
    write_json(output / "accuracy.json", result)
    (output / "accuracy.md").write_text(markdown(tables, calibrations), encoding="utf-8")
    write_plots(output / "accuracy.png", tables)
    if json:
        say_json(result)
    else:
        say(markdown(tables, calibrations))
        say(f"written  {output}/accuracy.md, accuracy.json, accuracy.png")


def _run(
    folder: Path, focal_mm: float, seed: int, z_mm: str, keep: bool
) -> tuple[Calibrated, Calibrated, list[TargetError]]:
    """Render, calibrate both ways, measure."""
    _command(
        "wingsim",
        *("accuracy-scenes", "--out", folder, "--focal-mm", f"{focal_mm:g}", "--seed", seed, "--z-mm", z_mm),
    )
    made = []
    for method in ("joint", "paper"):
        pair = folder / f"{method}.json"
        _command(
            "wingproc",
            *("calibrate", "--cam0", folder / "calibration" / "cam0_*.png"),
            *("--cam1", folder / "calibration" / "cam1_*.png", "--board", f"{BOARD.columns}x{BOARD.rows}"),
            *("--square-mm", f"{1000 * BOARD.square_m:g}", "--method", method, "--output", pair),
            *("--folds", 0, "--workers", 1),
        )
        made.append(read_calibrated(pair))
    errors = measure_targets(folder, made[0], made[1], seed)
    if not keep:
        for part in ("calibration", "target"):
            shutil.rmtree(folder / part)
    return made[0], made[1], errors


def _command(name: str, *arguments: object) -> None:
    beside = Path(sys.executable).with_name(name)
    program = str(beside) if beside.exists() else shutil.which(name)
    if program is None:
        raise ProcessError(f"{name}: not installed beside {sys.executable}; install wingshape whole")
    done = subprocess.run([program, *map(str, arguments)], capture_output=True, text=True, check=False)
    if done.returncode:
        last = (done.stderr.strip() or "no message").splitlines()[-1]
        raise ProcessError(f"{name} {arguments[0]} failed: {last.removeprefix('error: ')}")


def _table5(focal_mm: float, pairs: list[tuple[Calibrated, Calibrated]]) -> list[dict[str, Any]]:
    return [
        {
            "focal_mm": focal_mm,
            "source": source,
            "paper_px": PAPER_PX.get(focal_mm, (None,) * 3)[index],
            "baseline_px": float(np.median([papers.rms_px[index] for _, papers in pairs])),
            "ours_px": float(np.median([ours.rms_px[index] for ours, _ in pairs])),
        }
        for index, source in enumerate(SOURCES)
    ]


def _by_place(focal_mm: float, errors: list[TargetError]) -> list[dict[str, Any]]:
    """One row a point of one calibration's targets: its place in cam0's image and what it is wrong by."""
    return [
        {
            "focal_mm": focal_mm,
            "kind": error.kind,
            "z_mm": error.z_mm,
            "uv_px": [finite_or_none(float(value)) for value in pixel],
            "baseline_xyz_mm": [finite_or_none(float(value)) for value in theirs],
            "ours_xyz_mm": [finite_or_none(float(value)) for value in ours],
        }
        for error in errors
        for pixel, theirs, ours in zip(error.pixels, error.papers_errors_mm, error.errors_mm, strict=True)
    ]


def _rows(focal_mm: float, kind: str, runs: list[list[TargetError]]) -> list[dict[str, Any]]:
    """One row a distance at which the target was in view in all runs: medians over the runs."""
    by_distance = [{error.z_mm: error for error in run if error.kind == kind} for run in runs]
    rows = []
    for z_mm in sorted(set.intersection(*(set(run) for run in by_distance))):
        errors = [run[z_mm] for run in by_distance]

        def median(name: str, errors: list[TargetError] = errors) -> float | None:
            return finite_or_none(float(np.median([getattr(error, name) for error in errors])))

        rows.append(
            {
                "focal_mm": focal_mm,
                "z_mm": z_mm,
                "paper_mm": PAPER_MM[kind].get(focal_mm, {}).get(round(z_mm)),
                "baseline_mm": median("baseline_mm"),
                "ours_mm": median("ours_mm"),
                "ours_worst_mm": finite_or_none(max(error.ours_mm for error in errors)),
                "ours_aligned_mm": median("aligned_mm"),
                "ours_z_bias_mm": median("z_bias_mm"),
                "bound95_mm": median("bound95_mm"),
                "within_bound95": sum(error.ours_mm <= error.bound95_mm for error in errors),
                "crlb_mm": median("crlb_mm"),
            }
        )
    return rows
