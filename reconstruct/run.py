"""A flight, or its marker table, and a wing file → a whole result folder: tables, CSV, summary, figures and report."""

import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from capture.errors import ReconstructError, UsageError
from process.camera_model import Rig
from process.json_file import provenance, write_json
from process.pipeline import markers as measure_markers
from process.shared_error import with_rig
from process.tables import write_table
from reconstruct.compare import Comparison, compare
from reconstruct.identify import identify
from reconstruct.iteration import FEWEST_MARKERS
from reconstruct.reference import Reference
from reconstruct.report import write_report
from reconstruct.result import COMPARISON, MARKER_ERRORS, REPORT, SHAPE_ERRORS, SUMMARY, read_result
from reconstruct.result_tables import result_tables
from reconstruct.series import SideFits, fit_series
from reconstruct.shared import shared_errors
from reconstruct.summary import summarise
from reconstruct.tables import MARKERS, UNLOADED, marker_series, read_table, write_csv
from reconstruct.wing import Wing, read_wing

Progress = Callable[[str, int, int], None]
"""told the stage, what is done of it, and how much there is"""


@dataclass(frozen=True)
class Job:
    """What to reconstruct, and where to."""

    flights: tuple[Path, ...]  # folders of one flight; empty when there is a marker table
    rig: Path | None  # needed with flights
    markers: Path | None
    wing: Path
    out: Path
    csv: bool
    workers: int | None  # None: one a core
    command: str  # as it is recorded in the files
    smooth_s: float = 0.0  # correlation time of smoothing; 0: every set by itself
    reference: Reference = None  # what displacements are counted from; None: the unloaded wing


def run_job(job: Job, progress: Progress) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Do ``job``; returns the summary as written, and warnings on the recording.

    Files of an earlier run in the same folder are replaced, its comparison is removed. Raises UsageError when an input
    is missing or cannot be used, ReconstructError when no set could be fitted (the tables, which say why, are written).
    """
    began = time.monotonic()
    wing = read_wing(job.wing)
    table, source, inputs, warnings = _measure(job, progress)
    series = marker_series(table, source)
    measured = time.monotonic()
    total, done = sum(one.trigger_index.size for one in series.values()), 0

    def fitted(count: int) -> None:
        nonlocal done
        done += count
        progress("fit", done, total)

    fits = fit_series(
        series,
        wing,
        shared=shared_errors(table),
        reference=job.reference,
        smooth_s=job.smooth_s,
        workers=job.workers,
        progress=fitted,
    )
    fit_end = time.monotonic()
    _write_tables(job, table, fits, inputs)
    written = time.monotonic()
    how = provenance(job.command, inputs)
    summary = {
        "version": version("wingshape"),
        "wing": wing.name,
        **summarise(fits),
        "warnings": _warnings(wing, fits),
        "timing_s": {"markers": measured - began, "fit": fit_end - measured, "tables": written - fit_end},
        "wall_s": written - began,
        "command": how["command"],
        "inputs": how["inputs"],
        "flights": [str(path) for path in job.flights],
    }
    write_json(job.out / SUMMARY, summary)
    if not any(side.converged.any() for side in fits.values()):
        reason = next(iter(fits.values())).reason[0]
        raise ReconstructError(f"{source}: no set could be fitted ({reason}); see {job.out / 'frames.parquet'}")
    write_report(read_result(job.out), job.out)
    end = time.monotonic()
    summary["timing_s"]["report"] = end - written
    summary["wall_s"] = end - began
    write_json(job.out / SUMMARY, summary)
    return summary, warnings


def run_comparison(result: Path, reference: Path, folder: Path, command: str) -> Comparison:
    """Compare, write comparison.json and the tables of errors into ``folder``, and the report with them.

    Raises UsageError when a folder or table is missing or cannot be used, or nothing of the two overlaps.
    """
    comparison = compare(result, reference)
    folder.mkdir(parents=True, exist_ok=True)
    write_table(comparison.shape_errors, folder / SHAPE_ERRORS, command=command)
    write_table(comparison.marker_errors, folder / MARKER_ERRORS, command=command)
    write_json(folder / COMPARISON, {**comparison.summary, **provenance(command, [])})
    write_report(read_result(result, folder / COMPARISON), folder)
    return comparison


def _measure(job: Job, progress: Progress) -> tuple[pa.Table, str, list[Path], tuple[str, ...]]:
    """The marker table, its name for messages, the input files, and warnings."""
    if job.markers is not None:
        return read_table(job.markers, ()), str(job.markers), [job.wing, job.markers], ()
    if job.rig is None:
        raise UsageError("frames need --rig rig.json (a marker table does not: give it with --markers)")
    rig = Rig.read(job.rig)
    found = measure_markers(
        job.flights, rig, progress=lambda done, total: progress("markers", done, total), workers=job.workers
    )
    return with_rig(found.table, rig), " ".join(str(path) for path in job.flights), [job.wing, job.rig], found.problems


def _warnings(wing: Wing, fits: dict[str, SideFits]) -> list[str]:
    """What the wing's markers, with the noise they had, cannot tell."""
    said: dict[str, None] = {}
    for side, own in fits.items():
        known = np.asarray(np.isfinite(own.markers.cov_m2).all(axis=(-1, -2)))
        cov = np.full(own.markers.cov_m2.shape[1:], np.nan)
        for marker in range(known.shape[1]):
            if known[:, marker].any():
                cov[marker] = np.median(own.markers.cov_m2[:, marker][known[:, marker]], axis=0)
        if np.isfinite(cov[:, 0, 0]).sum() >= FEWEST_MARKERS:
            said.update(dict.fromkeys(identify(wing.half(side), wing.fit, cov).warnings))  # type: ignore[arg-type]
    return list(said)


def _write_tables(job: Job, table: pa.Table, fits: dict[str, SideFits], inputs: Sequence[Path]) -> None:
    job.out.mkdir(parents=True, exist_ok=True)
    tables = result_tables(fits)
    texts = [Path(name).with_suffix(".csv").name for name in (*tables, MARKERS)]
    for stale in (REPORT, SUMMARY, COMPARISON, SHAPE_ERRORS, MARKER_ERRORS, *texts):
        (job.out / stale).unlink(missing_ok=True)  # a run that fails half way must not leave an older one's words
    for name, content in tables.items():
        write_table(content, job.out / name, command=job.command, inputs=inputs)
    if job.markers is None:
        write_table(table, job.out / MARKERS, command=job.command, inputs=inputs)
    elif job.markers.resolve() != (job.out / MARKERS).resolve():
        shutil.copyfile(job.markers, job.out / MARKERS)  # keeps its own note of how it was made
    if job.csv:
        for name, content in {**tables, MARKERS: table}.items():
            if name != UNLOADED:
                write_csv(content, (job.out / name).with_suffix(".csv"))
