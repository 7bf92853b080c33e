"""A recording or a marker table → the parts of a result: measured blocks, then fitted ones, kept as they get done."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from capture.errors import UsageError
from process.camera_model import MarkerLayout, Rig, RigSide
from process.parts import Part, PartStore
from process.pipeline import BLOCK_TRIGGERS, BlockJob, PipelineSettings, blocks, measure_block
from process.recording import Recording
from process.workers import Crew, Shared
from reconstruct.fit import Fit
from reconstruct.instants import InstantSettings
from reconstruct.observed import Observed, enough_markers, measured_markers, observe, with_centroids
from reconstruct.reference import Reference
from reconstruct.result_tables import part_tables
from reconstruct.root_motion import RootMotion, root_motion, with_motion
from reconstruct.series import (
    NOTHING_MEASURED,
    FitHow,
    FitJob,
    Stretch,
    as_in,
    fit_how,
    fit_stretch,
    picks,
    prior_scale,
    reference_shape,
    stretch_of,
    touches,
    window_fits,
    window_ns,
)
from reconstruct.shared import SharedError
from reconstruct.summary import tally
from reconstruct.tables import LIGHTS, MARKERS, Floats, MarkerSeries, marker_series
from reconstruct.wing import Wing

CACHED_BLOCKS = 16
SAMPLED_BLOCKS = 30
Tell = Callable[[int, int], None]
"""told what is done, and how much there is"""


@dataclass(frozen=True, order=True)
class Key:
    """A block: the triggers of one wing from ``number`` times BLOCK_TRIGGERS on."""

    side: str
    number: int

    @property
    def markers(self) -> str:
        """Name of the part with its markers."""
        return f"markers-{self.side}-{self.number:06d}"

    @property
    def fits(self) -> str:
        """Name of the part with its fits."""
        return f"fits-{self.side}-{self.number:06d}"


@dataclass(frozen=True, eq=False)
class Cameras:
    """What fits to pixels need to know of those who took them."""

    sides: Mapping[str, RigSide]
    layout: MarkerLayout


@dataclass(frozen=True, eq=False)
class FitPlan:
    """How a flight is fitted."""

    wing: Wing
    smooth_s: float  # correlation time; 0: every set by itself
    shared: Mapping[str, SharedError]  # by side
    reference: Reference
    instants: InstantSettings = field(default_factory=InstantSettings)
    cameras: Cameras | None = None  # whose pixels are fitted; None: markers' places are
    root: Mapping[str, RootMotion] = field(default_factory=dict)  # by side; of others the cameras are at rest

    def of(self, side: str) -> FitHow:
        """How its sets of one side are fitted, but for the prior's scale and the reference."""
        rig = None if self.cameras is None else self.cameras.sides.get(side)
        recorded = self.reference is not None
        return fit_how(
            self.wing, side, self.instants, self.smooth_s, self.shared.get(side), rig, from_recorded=recorded
        )


@dataclass(frozen=True, eq=False)
class _ScaleJob:
    how: Shared[FitHow]
    observed: Observed


def measure(
    recording: Recording, rig: Rig, settings: PipelineSettings, store: PartStore, hands: Crew, tell: Tell
) -> list[Key]:
    """Measure the blocks of a recording that ``store`` does not have; returns all blocks' keys.

    Raises ProcessError when the images do not fit the rig, or a worker dies.
    """
    keys = {Key(block.side, block.number): block for block in blocks(recording)}
    todo = [(key, block) for key, block in keys.items() if key.markers not in store]
    total = sum(len(block.places) for block in keys.values())
    done = total - sum(len(block.places) for _, block in todo)
    how = Shared((rig, settings))
    tell(done, total)
    for number, found in hands.results(measure_block, (BlockJob(block, how) for _, block in todo)):
        note = {"problems": list(found.problems), "rejected": found.rejected}
        store.write(todo[number][0].markers, Part({MARKERS: found.table, LIGHTS: found.lights}, note))
        done += len(todo[number][1].places)
        tell(done, total)
    return sorted(keys)


def take(table: pa.Table, lights: pa.Table, name: str, store: PartStore) -> list[Key]:
    """Cut a marker table and its fuselage lights into blocks, instead of measuring them.

    Raises UsageError when it is not a marker table.
    """
    series = marker_series(table, name)  # checks it whole, before it is cut
    side = np.asarray(table.column("side").to_numpy(zero_copy_only=False))
    block = np.asarray(table.column("trigger_index").to_numpy()) // BLOCK_TRIGGERS
    lights_block = lights.column("trigger_index").to_numpy() // BLOCK_TRIGGERS
    lights_side = np.asarray(lights.column("side").to_numpy(zero_copy_only=False))
    keys = []
    for one in sorted(series):
        own = np.flatnonzero(side == one)
        for number in np.unique(block[own]).tolist():
            key = Key(one, int(number))
            keys.append(key)
            if key.markers not in store:
                rows = table.take(pa.array(own[block[own] == number]))
                beside = lights.filter(pa.array((lights_side == one) & (lights_block == number)))
                store.write(key.markers, Part({MARKERS: rows, LIGHTS: beside}, {"problems": [], "rejected": {}}))
    return sorted(keys)


def root_motions(keys: Sequence[Key], store: PartStore, sides: Mapping[str, RigSide]) -> dict[str, RootMotion]:
    """How the pairs have moved, by the lights of the measured blocks; a side whose lights do not show it is left out.

    ``sides`` are the pairs as surveyed, by name.
    """
    found = {}
    for name, side in sides.items():
        own = [key for key in keys if key.side == name]
        if own and side.references:
            lights = pa.concat_tables([store.read(key.markers).tables[LIGHTS] for key in own])
            motion = root_motion(lights, name, side)
            if motion is not None:
                found[name] = motion
    return found


def fit(keys: Sequence[Key], plan: FitPlan, store: PartStore, hands: Crew, tell: Tell, name: str) -> list[Key]:
    """Fit the measured blocks that ``store`` does not have fits of; returns the keys of all that have sets.

    ``name`` of the recording is for messages. Raises UsageError when no marker was measured, the markers are not those
    of the wing, or the reference does not fit them.
    """
    source = _Markers(keys, plan, store, name)
    todo = [key for key in source.sets if key.fits not in store]
    total = sum(source.sets.values())
    done = total - sum(source.sets[key] for key in todo)
    tell(done, total)
    if todo:
        common = _common(source, plan, hands)
        jobs = (FitJob(source.stretch(key), common[key.side]) for key in todo)
        for number, part in hands.results(_fit, jobs):
            store.write(todo[number].fits, part)
            done += source.sets[todo[number]]
            tell(done, total)
    return list(source.sets)


def _common(source: "_Markers", plan: FitPlan, hands: Crew) -> dict[str, Shared[FitHow]]:
    """What all blocks of a side have in common: the prior's scale, and what displacements are counted from."""
    hows = {side: plan.of(side) for side in source.sides}
    scale_jobs = [source.scale_job(side, hows[side]) for side in source.sides]
    for number, scale in hands.results(_scale, scale_jobs):
        side = source.sides[number]
        hows[side] = replace(hows[side], prior_scale=scale)
    in_window: dict[str, dict[int, Fit]] = {side: {} for side in source.sides}
    window = window_ns(plan.reference, source.start_ns)
    if window is not None:
        alone = {side: Shared(how) for side, how in hows.items()}
        inside = [key for key in source.sets if touches(source.stretch(key), window)]
        jobs = (FitJob(source.stretch(key), alone[key.side], window) for key in inside)
        for number, found in hands.results(window_fits, jobs):
            in_window[inside[number].side][number] = found
    common = {}
    for side, how in hows.items():
        fits = [part for _, part in sorted(in_window[side].items())]
        common[side] = Shared(replace(how, reference=reference_shape(how, side, plan.reference, fits)))
    return common


def sampled(keys: Sequence[Key], wing: Wing, store: PartStore, name: str) -> dict[str, MarkerSeries]:
    """Some of the measured sets of each wing: SAMPLED_BLOCKS blocks of those that have sets, spread evenly."""
    sides: dict[str, list[Key]] = {}
    for key in keys:
        sides.setdefault(key.side, []).append(key)
    return {
        side: MarkerSeries.join(
            [
                series
                for at in np.unique(np.linspace(0, len(own) - 1, SAMPLED_BLOCKS).round().astype(int)).tolist()
                if (series := _series(own[at], wing, store, name)) is not None
            ]
        )
        for side, own in sides.items()
    }


class _Markers:
    """The measured blocks of a flight, as the fit wants them."""

    def __init__(self, keys: Sequence[Key], plan: FitPlan, store: PartStore, name: str) -> None:
        self.sets: dict[Key, int] = {}
        self._around_s = plan.of("left").around_s
        self._plan = plan
        self._enough: dict[Key, NDArray[np.intp]] = {}
        self._series = lru_cache(maxsize=CACHED_BLOCKS)(
            lambda key: _series(key, plan.wing, store, name, plan.cameras, plan.root.get(key.side))
        )
        anything = False
        starts_ns = []
        for key in keys:
            series = self._series(key)
            if series is not None:
                self.sets[key] = series.trigger_index.size
                self._enough[key] = np.flatnonzero(enough_markers(series))
                starts_ns.append(int(series.frame_timestamp_ns.min()))
                anything = anything or bool(measured_markers(series).any())
        if not anything:
            raise UsageError(NOTHING_MEASURED)
        self.start_ns = min(starts_ns)
        self.sides = sorted({key.side for key in self.sets})
        self._order = {side: [key for key in self.sets if key.side == side] for side in self.sides}
        self._place = {key: at for order in self._order.values() for at, key in enumerate(order)}

    def stretch(self, key: Key) -> Stretch:
        """A block's sets, and those around them."""
        order, at = self._order[key.side], self._place[key]
        own = self._own(key)
        reach_ns = self._around_s * 1e9
        pieces, first = [own], 0
        for other in reversed(order[:at]):
            piece = self._own(other)
            pieces.insert(0, piece)
            first += piece.trigger_index.size
            if abs(int(piece.frame_timestamp_ns[0]) - int(own.frame_timestamp_ns[0])) > reach_ns:
                break
        for other in order[at + 1 :]:
            piece = self._own(other)
            pieces.append(piece)
            if abs(int(piece.frame_timestamp_ns[-1]) - int(own.frame_timestamp_ns[-1])) > reach_ns:
                break
        whole = MarkerSeries.join(pieces)
        last = first + own.trigger_index.size
        return stretch_of(whole, first, last, self._around_s)

    def scale_job(self, side: str, how: FitHow) -> _ScaleJob:
        """The sets that the prior's scale of a wing is chosen from."""
        order = self._order[side]
        ends = np.cumsum([self._enough[key].size for key in order])
        picked = picks(int(ends[-1]))
        some: list[Observed] = []
        for key, end in zip(order, ends.tolist(), strict=True):
            begin = end - self._enough[key].size
            rows = self._enough[key][picked[(picked >= begin) & (picked < end)] - begin]
            if rows.size or not some:
                stretch = self.stretch(key)
                some.append(observe(stretch.markers, how.half, how.rig, how.instants)[stretch.first + rows])
        return _ScaleJob(Shared(how), Observed.join(some))

    def _own(self, key: Key) -> MarkerSeries:
        series = self._series(key)
        assert series is not None
        return series


def _series(
    key: Key, wing: Wing, store: PartStore, name: str, cameras: Cameras | None = None, root: RootMotion | None = None
) -> MarkerSeries | None:
    """A measured block, with pixels if ``cameras`` are given; None when none of its frames could be read.

    ``root`` is the motion of its cameras, that markers are to be free of.
    """
    table = store.read(key.markers).tables[MARKERS]
    if not table.num_rows:
        return None
    series = marker_series(table, name)[key.side]
    if cameras is not None:
        if key.side not in cameras.sides:
            raise UsageError(f"{name}: does not say which cameras saw the {key.side} wing; leave --direct out")
        series = with_centroids(series, table, cameras.sides[key.side], cameras.layout, name)
    if root is not None:
        own = (None, None) if cameras is None else (cameras.sides[key.side], cameras.layout)
        series = with_motion(series, root, *own)
    return as_in(wing.half(key.side), series)


def _scale(job: _ScaleJob) -> Floats:
    return prior_scale(job.how.get(), job.observed)


def _fit(job: FitJob) -> Part:
    fits = fit_stretch(job)
    return Part(part_tables(fits), tally(fits))
