"""A flight, or its marker table, and a wing file → a whole result folder: tables, summary, figures and report."""

import contextlib
import dataclasses
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from capture.errors import ReconstructError, UsageError
from process.camera_model import Rig
from process.flight_cameras import check_cameras
from process.fuselage_lights import LIGHTS_SCHEMA, lights_path
from process.json_file import provenance, write_json
from process.memory import MemoryWatch
from process.parts import PartStore
from process.pipeline import PipelineSettings
from process.read_ahead import READS_AHEAD
from process.recording import Recording, find_files, open_recording, reading_s
from process.reference import Window
from process.shared_error import layout_of, sides_of, with_rig
from process.signal_table import MAX_GAP_S
from process.tables import MARKER_SCHEMA, TableWriter, write_table
from process.workers import Crew, crew, usable_cores
from reconstruct.air_table import AIR, SpecificForce, air_table
from reconstruct.animation import remove_animation, write_animation
from reconstruct.assemble import Assembled, Target, assemble
from reconstruct.beside import Beside, beside_flight, beside_markers
from reconstruct.compare import Comparison, compare
from reconstruct.dense import NETCDF, write_netcdf
from reconstruct.frame_pictures import moments, remove_frame_pictures, write_frame_pictures
from reconstruct.hang import DOUBTFUL_SIGMAS, recorded_hangs
from reconstruct.identify import identify
from reconstruct.iteration import FEWEST_MARKERS
from reconstruct.mat_file import MAT, write_mat
from reconstruct.observed import measured_markers
from reconstruct.reference import Reference
from reconstruct.report import write_report
from reconstruct.result import COMPARISON, MARKER_ERRORS, REPORT, SHAPE_ERRORS, SUMMARY, read_json_object, read_result
from reconstruct.root_motion import RootMotion
from reconstruct.scene import SCENE, write_scene
from reconstruct.series import window_ns
from reconstruct.shared import SharedError, shared_errors
from reconstruct.stages import Cameras, FitPlan, Key, fit, measure, root_motions, sampled, take
from reconstruct.summary import holes, summarise
from reconstruct.tables import FRAMES, LIGHTS, LOADS, MARKERS, RESIDUALS, SHAPE, SIDES, MarkerSeries, read_table
from reconstruct.wing import Wing, read_wing

PARTS = ".parts"
FORMATS = ("mat", "mcap", "netcdf")
MODULES = ("reconstruct.stages",)  # what a worker loads before the clock starts
BYTES_A_SECOND = 500e6  # of frames that one core works off, roughly,
ROWS_A_SECOND = 6000.0  # and of markers
PROBLEMS_LISTED = 100  # in the summary
WORTH_A_WORKER_S = 1.5  # starting one takes a second


@dataclass(frozen=True)
class Step:
    """How far a run has got."""

    stage: str
    done: int  # sets; figures of the report, pictures of the film
    total: int
    flight_s: float  # what they are in all, of flight


Progress = Callable[[Step], None]


@dataclass(frozen=True, kw_only=True)
class Job:
    """What to reconstruct, and where to."""

    wing: Path
    out: Path
    flights: tuple[Path, ...] = ()  # folders of one flight; empty when there is a marker table
    rig: Path | None = None  # needed with flights
    markers: Path | None = None
    csv: bool = True
    workers: int | None = None  # None: one a core
    command: str = ""  # as it is recorded in the files
    smooth_s: float = 0.0  # correlation time of smoothing; 0: every set by itself
    reference: Reference = None  # what displacements are counted from; None: the unloaded wing
    also: tuple[str, ...] = ("mat", "mcap")  # of FORMATS
    report: bool = True
    animation: bool = False  # with the report
    scheduler: str | None = None  # a Dask scheduler's address, or local; None: processes of our own
    settings: PipelineSettings = dataclasses.field(default_factory=PipelineSettings)
    dbc: tuple[Path, ...] = ()  # what the recorded CAN frames mean
    max_gap_s: float = MAX_GAP_S  # that signals are interpolated over
    direct: bool = False  # fit both cameras' pixels, not triangulated places
    specific_force: SpecificForce | None = None  # signals that tell the aircraft's acceleration; None: net loads only
    root_motion: bool = True  # take out the cameras' motion against the fuselage, where lights on it show it


@dataclass
class _Clock:
    """When a run got where, seconds."""

    began: float
    first_byte: float = 0.0
    measured: float = 0.0
    fitted: float = 0.0
    written: float = 0.0


def check_job(job: Job) -> None:
    """Raises UsageError or ProcessError for a wing or rig file that cannot be used, before anything is begun."""
    read_wing(job.wing)
    if job.rig is not None:
        Rig.read(job.rig)


def finished(job: Job) -> dict[str, Any] | None:
    """The summary of an earlier run that did the same to the same inputs, and got to its end; None if there is none.

    Which files to write, signals (``max_gap_s``, ``specific_force``) and the words of the command do not count.
    """
    if (job.out / PARTS).exists() or not (job.out / SUMMARY).is_file():
        return None
    source = _Source(job)
    plan = _plan(job, read_wing(job.wing), source)
    source.open()
    known = read_json_object(job.out / SUMMARY, "remove it, to run again")
    wanted = json.loads(json.dumps(source.note(plan)))
    return known if all(known.get(key) == value for key, value in wanted.items() if key != "command") else None


def run_job(
    job: Job, progress: Progress = lambda _: None, hands: Crew | None = None
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Do ``job``, by ``hands`` if there are any; returns the summary as written, and warnings on the recording.

    Files of an earlier run in the same folder are replaced, its comparison is removed. What a run that was killed had
    got done is taken up. Raises UsageError when an input is missing or cannot be used, ReconstructError when no set
    could be fitted (the tables, which say why, are written), ProcessError when a worker died or a disk refused.
    """
    clock = _Clock(time.monotonic())
    wing = read_wing(job.wing)
    source = _Source(job)
    plan = _plan(job, wing, source)
    own = crew(_workers(job, source), job.scheduler, MODULES) if hands is None else contextlib.nullcontext(hands)
    with MemoryWatch() as memory, own as hands:
        clock.first_byte = time.monotonic()
        source.open()
        if job.specific_force is not None:
            job.specific_force.check(wing, source.beside)
        note = source.note(plan)
        store = PartStore(job.out / PARTS, {key: value for key, value in note.items() if key != "command"})
        resumed = len(store) > 0
        try:
            measured = source.measure(store, hands, progress)
            clock.measured = time.monotonic()
            plan = dataclasses.replace(plan, root=source.root_motions(measured, store))
            fitted = fit(measured, plan, store, hands, _telling(progress, "fit", source.flight_s), source.name)
            clock.fitted = time.monotonic()
        except UsageError:  # nothing that another run could go on with
            store.remove()
            with contextlib.suppress(OSError):
                job.out.rmdir()
            raise
        _remove_stale(job)
        target = Target(job.out, job.csv, note, source.rig, source.beside, source.has_lights)
        found = assemble(store, measured, fitted, target)
        _write_air(job, wing, found.frames, note)
        clock.written = time.monotonic()
    summary = {
        **_figures(job, wing, plan, found, sampled(fitted, wing, store, source.name)),
        **_timing(clock, found.frames, resumed, source.reading_s),
        "peak_mb": memory.peak_bytes / 1e6,
        **note,
        "flights": [str(path) for path in job.flights],
    }
    problems = (*source.problems, *(line for key in measured for line in store.read(key.markers).note["problems"]))
    summary["problems"] = list(problems[:PROBLEMS_LISTED])
    write_json(job.out / SUMMARY, summary)
    if not summary["converged_percent"]:
        reason = found.frames.column("reason")[0].as_py()
        raise ReconstructError(f"{source.name}: no set could be fitted ({reason}); see {job.out / FRAMES}")
    began = time.monotonic()
    _write_also(job, store, fitted, note)
    summary["timing_s"]["formats"] = time.monotonic() - began
    if job.report:
        _report(job, source, summary, found.frames, progress)
    write_json(job.out / SUMMARY, summary)
    store.remove()
    return summary, problems


def run_comparison(
    result: Path, reference: Path, folder: Path, command: str, *, from_start: bool = False, window: Window | None = None
) -> Comparison:
    """Compare, write comparison.json and the tables of errors into ``folder``, and the report with them.

    Raises UsageError when a folder or table is missing or cannot be used, or nothing of the two overlaps.
    """
    comparison = compare(result, reference, from_start=from_start, window=window)
    folder.mkdir(parents=True, exist_ok=True)
    write_table(comparison.shape_errors, folder / SHAPE_ERRORS, command=command)
    write_table(comparison.marker_errors, folder / MARKER_ERRORS, command=command)
    write_json(folder / COMPARISON, {**comparison.summary, **provenance(command, [])})
    write_report(read_result(result, folder / COMPARISON), folder)
    return comparison


class _Source:
    """Where a job's markers come from: a recording and its rig, or a marker table."""

    def __init__(self, job: Job) -> None:
        """Raises UsageError when flights come without a rig, ProcessError when there is no recording."""
        self.problems: tuple[str, ...] = ()
        self.flight_s = 0.0
        self.rig: Rig | None = None
        self.beside: Beside | None = None
        self.shared: dict[str, SharedError]
        self._job = job
        self._recording: Recording | None = None
        self._table: pa.Table | None = None
        self._lights: pa.Table = LIGHTS_SCHEMA.empty_table()
        if job.markers is not None:
            self._table = read_table(job.markers, ())
            if lights_path(job.markers).is_file():
                self._lights = read_table(lights_path(job.markers), LIGHTS_SCHEMA.names)
            self.name = str(job.markers)
            self.beside = beside_markers(job.markers)
            self.shared = shared_errors(self._table)
            self.work_s = self._table.num_rows / ROWS_A_SECOND
            return
        if job.rig is None:
            raise UsageError("frames need --rig rig.json (a marker table does not: give it with --markers)")
        self.rig = Rig.read(job.rig)
        self.shared = shared_errors(with_rig(MARKER_SCHEMA.empty_table(), self.rig))
        self.name = " ".join(str(path) for path in job.flights)
        self.work_s = sum(path.stat().st_size for path in find_files(job.flights)) / BYTES_A_SECOND

    def cameras(self) -> Cameras:
        """Whose pixels there are. Raises UsageError when the marker table does not say."""
        if self.rig is not None:
            return Cameras({side: self.rig.side(side) for side in SIDES}, self.rig.markers)
        assert self._table is not None
        sides, layout = sides_of(self._table), layout_of(self._table)
        if layout is None:
            raise UsageError(f"{self.name}: does not say which cameras saw the markers; leave --direct out")
        return Cameras(sides, layout)

    def open(self) -> None:
        """Index the recording."""
        if self._table is None:
            assert self.rig is not None
            self._recording = open_recording(self._job.flights)
            check_cameras(self._recording.files, self.rig)
            self.beside = beside_flight(self._job.flights, self._job.dbc, self._job.max_gap_s)
            self.problems = tuple(dict.fromkeys((*self._recording.problems, *self.beside.signals.problems)))
            self.flight_s = self._recording.duration_s

    @property
    def has_lights(self) -> bool:
        """Whether lights on the fuselage were looked for."""
        if self.rig is not None:
            return any(self.rig.side(side).references for side in SIDES)
        return bool(self._lights.num_rows)

    def root_motions(self, measured: Sequence[Key], store: PartStore) -> dict[str, RootMotion]:
        """How the cameras have moved, by side, where that is asked for and known."""
        if not self._job.root_motion or not self.has_lights:
            return {}
        sides = sides_of(self._table) if self.rig is None else {side: self.rig.side(side) for side in SIDES}
        return root_motions(measured, store, sides)

    @property
    def recording(self) -> Recording | None:
        """What was opened; None of a marker table."""
        return self._recording

    @property
    def reading_s(self) -> float | None:
        """How long reading the frames takes by itself; None when there were none, or others read them."""
        if self._recording is None or self._job.scheduler is not None:
            return None
        return reading_s(self._recording, usable_cores() * READS_AHEAD)

    def note(self, plan: FitPlan) -> dict[str, Any]:
        """How a result of it is made: all that the result depends on."""
        job = self._job
        lights = lights_path(job.markers) if job.markers is not None and self._lights.num_rows else None
        paths = (job.wing, job.rig, job.markers, lights, _reference_file(job), *job.dbc)
        inputs = [path for path in paths if path is not None]
        config = {
            "measuring": dataclasses.asdict(job.settings),
            "instants": dataclasses.asdict(plan.instants),
            "direct": plan.cameras is not None,
            "smooth_s": plan.smooth_s,
            "root_motion": job.root_motion,
            "reference": None if plan.reference is None else str(plan.reference),
        }
        recording = {} if self._recording is None else self._recording.fingerprints
        return {**provenance(job.command, inputs, config), "recording": recording}

    def measure(self, store: PartStore, hands: Crew, progress: Progress) -> list[Key]:
        """The keys of the blocks that there are, measured."""
        if self._recording is None or self.rig is None:
            return take(self._table, self._lights, self.name, store)
        tell = _telling(progress, "markers", self.flight_s)
        return measure(self._recording, self.rig, self._job.settings, store, hands, tell)


def _plan(job: Job, wing: Wing, source: _Source) -> FitPlan:
    plan = FitPlan(wing, job.smooth_s, source.shared, job.reference, cameras=source.cameras() if job.direct else None)
    plan.of(SIDES[0])  # what cannot be fitted is refused before frames are measured
    return plan


def _write_air(job: Job, wing: Wing, frames: pa.Table, note: Mapping[str, Any]) -> None:
    """Aerodynamic loads, where they are asked for."""
    if job.specific_force is not None:
        air = air_table(wing, job.out / SHAPE, frames, job.specific_force)
        with TableWriter(job.out / AIR, air.schema, note, csv=job.csv) as writer:
            writer.append(air)


def _report(job: Job, source: _Source, summary: dict[str, Any], frames: pa.Table, progress: Progress) -> None:
    """Draw the report, and the film; adds to ``summary`` how long that took."""
    began = time.monotonic()
    if source.recording is not None:
        shown = moments(frames, window_ns(job.reference, int(frames.column("timestamp_ns").to_numpy().min())))
        write_frame_pictures(source.recording, shown, job.out, job.settings.detection)
    result = read_result(job.out)
    write_report(result, job.out, _telling(progress, "report", 0.0))
    summary["timing_s"]["report"] = time.monotonic() - began
    if job.animation:
        write_animation(result, job.out, _telling(progress, "film", 0.0))
        summary["timing_s"]["animation"] = time.monotonic() - began - summary["timing_s"]["report"]


def _figures(
    job: Job, wing: Wing, plan: FitPlan, found: Assembled, sample: Mapping[str, MarkerSeries]
) -> dict[str, Any]:
    """What a summary says of the flight, not of how it was made."""
    hangs = recorded_hangs(wing, found.wings)
    return {
        "version": version("wingshape"),
        "wing": wing.name,
        **summarise(found.tallies, found.frames),
        "reference": found.wings.column("reference")[0].as_py(),
        "at_rest": {one.side: one.as_dict() for one in hangs},
        "direct": job.direct,
        "root_motion": {side: one.figures(wing.half(side).rest_position_m[-1]) for side, one in plan.root.items()},
        "smoothed_s": job.smooth_s,
        "warnings": [
            *_warnings(wing, sample),
            *(one.sentence() for one in hangs if abs(one.misfit) > DOUBTFUL_SIGMAS),
        ],
        **holes(found.frames),
    }


def _write_also(job: Job, store: PartStore, fitted: Sequence[Key], note: Mapping[str, Any]) -> None:
    if "mcap" in job.also:
        write_scene(store, fitted, job.out, note)
    if "mat" in job.also:
        write_mat(job.out)
    if "netcdf" in job.also:
        write_netcdf(job.out)


def _workers(job: Job, source: _Source) -> int:
    return job.workers or max(1, min(usable_cores(), int(source.work_s / WORTH_A_WORKER_S)))


def _telling(progress: Progress, stage: str, flight_s: float) -> Callable[[int, int], None]:
    return lambda done, total: progress(Step(stage, done, total, flight_s))


def _remove_stale(job: Job) -> None:
    """A run that fails half way must not leave an older one's words."""
    remove_frame_pictures(job.out)
    remove_animation(job.out)
    texts = [Path(name).with_suffix(".csv").name for name in (SHAPE, FRAMES, LOADS, RESIDUALS, MARKERS, LIGHTS, AIR)]
    for stale in (LIGHTS, AIR, REPORT, SCENE, MAT, NETCDF, SUMMARY, COMPARISON, SHAPE_ERRORS, MARKER_ERRORS, *texts):
        (job.out / stale).unlink(missing_ok=True)


def _reference_file(job: Job) -> Path | None:
    if not isinstance(job.reference, Path):
        return None
    return job.reference / SHAPE if job.reference.is_dir() else job.reference


def _warnings(wing: Wing, sample: Mapping[str, MarkerSeries]) -> list[str]:
    """What the wing's markers, with the noise they had, cannot tell."""
    said: dict[str, None] = {}
    for side, series in sample.items():
        known = measured_markers(series)  # of a sample without pixels: by both cameras
        cov = np.full(series.cov_m2.shape[1:], np.nan)
        for marker in range(known.shape[1]):
            if known[:, marker].any():
                cov[marker] = np.median(series.cov_m2[:, marker][known[:, marker]], axis=0)
        if np.isfinite(cov[:, 0, 0]).sum() >= FEWEST_MARKERS:
            said.update(dict.fromkeys(identify(wing.half(side), wing.fit, cov).warnings))
    return list(said)


def _timing(clock: _Clock, frames: pa.Table, resumed: bool, reading_s: float | None) -> dict[str, Any]:
    """``flight_s`` over ``wall_s``, from the first byte read to the last row written, is ``times_real_time``."""
    worked_s = clock.written - clock.first_byte
    times = frames.column("timestamp_ns").to_numpy()
    flight_s = float(times.max() - times.min()) * 1e-9
    return {
        "timing_s": {
            "start": clock.first_byte - clock.began,
            "markers": clock.measured - clock.first_byte,
            "fit": clock.fitted - clock.measured,
            "tables": clock.written - clock.fitted,
        },
        "wall_s": worked_s,
        "flight_s": flight_s,
        "times_real_time": None if resumed else flight_s / worked_s,
        "read_ratio": None if resumed or not reading_s else worked_s / reading_s,
    }
