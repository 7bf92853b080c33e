"""A flight's marker table → the fitted shape of both half wings at every trigger."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from capture.errors import UsageError
from process.camera_model import RigSide
from process.pipeline import BLOCK_TRIGGERS
from process.reference import Window
from process.workers import Shared, crew, usable_cores
from reconstruct.fit import Fit, Unscaled, fit_each, scale_of, with_residuals
from reconstruct.instants import InstantSettings
from reconstruct.observed import Observed, enough_markers, measured_markers, observe
from reconstruct.reference import Reference, ReferenceShape, mean_of, recorded, unloaded
from reconstruct.root_motion import sigma_by_motion
from reconstruct.rotation import hat
from reconstruct.shared import SharedError, shared_errors, sigma_of
from reconstruct.smooth import smooth_fits
from reconstruct.tables import (
    SHAPE,
    Bools,
    Centroids,
    Floats,
    Ints,
    MarkerSeries,
    SetMotion,
    Words,
    marker_series,
    read_table,
)
from reconstruct.wing import HalfWing, Wing
from reconstruct.wing_file import FitSettings

_Rows = dict[str, Any]  # field of SideFits → array over a block's sets

NOTHING_MEASURED = "no marker was measured in any set; look at the flags column of the marker table"
SCALE_SETS = 60  # of a flight, to choose the prior's scale from
CORRELATION_TIMES = 4.0  # of a stretch's surroundings that smoothing takes into account
MARGIN_S = 0.05  # markers of a set are at most this far from its instant


@dataclass(frozen=True)
class SideFits:
    """One half wing's fits, dense over F sets, N + 1 nodes, M markers and k load stations; NaN where not fitted."""

    side: str
    trigger_index: Ints  # (F,)
    timestamp_ns: Ints  # (F,) the set's common instant
    s_m: Floats  # (N + 1,)
    unloaded_xyz_m: Floats  # (N + 1, 3) body frame
    reference: str  # what displacements are counted from,
    reference_xyz_m: Floats  # (N + 1, 3) where that is, body frame,
    reference_twist_rad: Floats  # (N + 1,) and its twist against the unloaded wing,
    reference_sigma_m: Floats  # (N + 1, 3) one sigma of where it is, with the errors that all frames share
    xyz_m: Floats  # (F, N + 1, 3) body frame
    sigma_xyz_m: Floats  # (F, N + 1, 3) one sigma, of noise and of the errors that all frames share,
    noise_sigma_xyz_m: Floats  # (F, N + 1, 3) of which this is the noise, which is new in every set
    sigma_moved_m: Floats  # (F, N + 1, 3) of the displacement from the reference
    twist_rad: Floats  # (F, N + 1)
    sigma_twist_rad: Floats  # (F, N + 1) as for places
    noise_sigma_twist_rad: Floats  # (F, N + 1)
    sigma_twisted_rad: Floats  # (F, N + 1) of the twist against the reference
    curvature_1pm: Floats  # (F, N + 1, 3) elastic: twist, out-of-plane, in-plane; mean of the elements at a node
    sigma_curvature_1pm: Floats  # (F, N + 1, 3)
    extension: Floats  # (F, N + 1) elastic strain along the axis, mean of the elements at a node
    sigma_extension: Floats  # (F, N + 1)
    stiffness_change: Floats  # (F, 4) relative, as found; zero where loads act everywhere
    sigma_stiffness: Floats  # (F, 4)
    markers: MarkerSeries  # what was fitted: the wing's M markers in its order
    residual_m: Floats  # (F, M, 3) measured minus fitted; NaN where not measured
    used: Bools  # (F, M) False also for outliers
    points: Ints  # (F, M) samples a marker's position at the common instant was made of
    load_s_m: Floats  # (k,)
    loads: Floats  # (F, k, 6) N and N·m, body frame
    sigma_loads: Floats  # (F, k, 6)
    net: Floats  # (F, 6) sum of the forces, and their moment with the moments about the root, body axes
    sigma_net: Floats  # (F, 6)
    chi2: Floats  # (F,)
    dof: Floats  # (F,)
    iterations: Ints  # (F,)
    flags: Words  # (F,) str, empty when good: not_fitted, outlier (markers left out), row_time, bridged, no_lights
    reason: Words  # (F,) str, why a set could not be fitted
    smoothed_s: float  # correlation time of the smoothing; 0: every set by itself

    @property
    def converged(self) -> Bools:
        """(F,) whether the set was fitted."""
        return np.asarray(np.isfinite(self.xyz_m).all(axis=(1, 2)))


_OF_THE_WING = {"side", "s_m", "unloaded_xyz_m", "reference", "reference_xyz_m", "reference_twist_rad"}
_OF_THE_WING |= {"reference_sigma_m", "markers", "load_s_m", "smoothed_s"}


@dataclass(frozen=True, eq=False)
class FitHow:
    """How the sets of one wing are fitted."""

    half: HalfWing
    settings: FitSettings
    instants: InstantSettings = field(default_factory=InstantSettings)
    smooth_s: float = 0.0
    """correlation time; 0: every set by itself"""
    shared: SharedError | None = None
    """that all frames share; None: not known, sigmas hold noise only"""
    prior_scale: Floats | None = None
    """of the prior's groups; None: the sets of a stretch choose their own"""
    reference: ReferenceShape | None = None
    """what displacements are counted from; None: the unloaded wing"""
    rig: RigSide | None = None
    """cameras whose pixels are fitted; None: markers' places are"""
    from_recorded: bool = False
    """displacements are counted from a recorded shape, which has nearly the same shared error"""

    def problem(self, observed: Observed) -> Unscaled:
        """What the sets' fits are to explain.

        Weights know of shared errors unless these cancel in what is asked for, or sets are smoothed in time, which
        takes all errors for new in every set.
        """
        known = None if self.from_recorded or self.smooth_s > 0 else self.shared
        return observed.problem(self.half, self.settings, self.rig, known)

    @property
    def around_s(self) -> float:
        """How far in time from a set others have a say in its fit."""
        return max(self.instants.reach_s + MARGIN_S, CORRELATION_TIMES * self.smooth_s)


@dataclass(frozen=True, eq=False)
class Stretch:
    """Consecutive sets of one wing that are fitted together, and those around them."""

    markers: MarkerSeries
    first: int  # the stretch is markers[first:last],
    last: int  # the others are within FitHow.around_s


@dataclass(frozen=True, eq=False)
class FitJob:
    """A stretch to be fitted."""

    stretch: Stretch
    how: Shared[FitHow]
    window_ns: tuple[int, int] = (0, 0)
    """for ``window_fits``"""


def fit_series(
    markers: Mapping[str, MarkerSeries],
    wing: Wing,
    *,
    instants: InstantSettings | None = None,
    shared: Mapping[str, SharedError] | None = None,
    reference: Reference = None,
    smooth_s: float = 0.0,
    workers: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> dict[str, SideFits]:
    """Fit every set of both sides; ``progress`` is told the number of sets fitted since it was last called.

    Markers are first brought to their set's common instant. Sets are fitted each by itself, those between two trigger
    indices that are multiples of BLOCK_TRIGGERS together, so that the result does not depend on ``workers`` (default:
    one a core this process may use). A set that cannot be fitted is NaN and flagged. With
    ``smooth_s`` the sets are smoothed in time over so many seconds, and sets that could not be fitted are bridged.
    ``shared`` are the errors that all frames share, by side; without, sigmas hold noise only. Displacements are counted
    from ``reference``.

    Raises:
        UsageError: the markers are not those of ``wing``, or none was measured, or ``reference`` does not fit them.
        ProcessError: a worker process died.
    """
    given = instants or InstantSettings()
    whole = {side: as_in(wing.half(side), series) for side, series in markers.items()}
    if not any(measured_markers(series).any() for series in whole.values()):
        raise UsageError(NOTHING_MEASURED)
    start_ns = min(int(series.frame_timestamp_ns.min()) for series in whole.values())
    jobs = []
    for side, series in whole.items():
        known = (shared or {}).get(side)
        how = fit_how(wing, side, given, smooth_s, known, from_recorded=reference is not None)
        picked = np.flatnonzero(enough_markers(series))
        picked = picked[picks(picked.size)]
        how = replace(how, prior_scale=prior_scale(how, observe(series, how.half, how.rig, how.instants)[picked]))
        cut = stretches(series, how.around_s)
        alone = Shared(how)
        window = window_ns(reference, start_ns)
        fits = [window_fits(FitJob(one, alone, window)) for one in cut if window and touches(one, window)]
        common = Shared(replace(how, reference=reference_shape(how, side, reference, fits)))
        jobs += [FitJob(stretch, common) for stretch in cut]
    done: dict[int, SideFits] = {}
    with crew(min(workers or usable_cores(), len(jobs)), modules=(__name__,)) as hands:
        for number, found in hands.results(fit_stretch, jobs):
            done[number] = found
            if progress is not None:
                progress(found.trigger_index.size)
    parts = [done[number] for number in sorted(done)]
    return {side: joined([part for part in parts if part.side == side]) for side in markers}


def fit_how(
    wing: Wing,
    side: str,
    instants: InstantSettings,
    smooth_s: float,
    shared: SharedError | None,
    rig: RigSide | None = None,
    *,
    from_recorded: bool = False,
) -> FitHow:
    """How the sets of one side are fitted, but for the prior's scale and the reference.

    Raises UsageError when the wing file does not say where loads act, or smoothing asks for loads elsewhere.
    """
    if wing.fit is None:
        raise UsageError(f"the wing {wing.name!r} has no [fit] section: say where its loads act (load_stations_m)")
    if smooth_s > 0 and wing.fit.loads != "everywhere":
        raise UsageError('smoothing in time needs loads = "everywhere" in the wing file\'s [fit]')
    return FitHow(wing.half(side), wing.fit, instants, smooth_s, shared, rig=rig, from_recorded=from_recorded)


def stretches(series: MarkerSeries, around_s: float) -> list[Stretch]:
    """``series`` cut at every trigger index that is a multiple of BLOCK_TRIGGERS, each with the sets around it."""
    blocks = series.trigger_index // BLOCK_TRIGGERS
    cuts = [0, *(np.flatnonzero(np.diff(blocks)) + 1).tolist(), series.trigger_index.size]
    return [stretch_of(series, first, last, around_s) for first, last in pairwise(cuts)]


def stretch_of(series: MarkerSeries, first: int, last: int, around_s: float) -> Stretch:
    """The sets [first, last) of ``series``, with those that are within ``around_s`` of its ends without a break."""
    times_ns, reach = series.frame_timestamp_ns, around_s * 1e9
    before = np.abs(times_ns[:first] - times_ns[first]) > reach
    after = np.abs(times_ns[last:] - times_ns[last - 1]) > reach
    begin = int(np.flatnonzero(before)[-1]) + 1 if before.any() else 0
    end = last + int(np.argmax(after)) if after.any() else times_ns.size
    return Stretch(series[begin:end], first - begin, last - begin)


def fit_stretch(job: FitJob) -> SideFits:
    """The fits of a stretch's own sets."""
    how, stretch = job.how.get(), job.stretch
    own = slice(stretch.first, stretch.last)
    points, fits = _fits(how, stretch)
    markers = stretch.markers[own]
    return _gather(how, markers, points, _rows(how, fits, markers.motion))


def window_fits(job: FitJob) -> Fit:
    """The fits of those of a stretch's own sets that lie in a window."""
    stretch = job.stretch
    times_ns = stretch.markers.frame_timestamp_ns[stretch.first : stretch.last]
    _, fits = _fits(job.how.get(), stretch)
    return fits[(job.window_ns[0] <= times_ns) & (times_ns <= job.window_ns[1])]


def window_ns(reference: Reference, start_ns: int) -> tuple[int, int] | None:
    """From when to when a recorded reference's sets are; None when it is no window of this recording."""
    if not isinstance(reference, Window):
        return None
    return start_ns + round(reference.begin_s * 1e9), start_ns + round(reference.end_s * 1e9)


def touches(stretch: Stretch, window: tuple[int, int]) -> bool:
    """Whether any of a stretch's own sets lies in a window."""
    times_ns = stretch.markers.frame_timestamp_ns[stretch.first : stretch.last]
    return bool(((times_ns >= window[0]) & (times_ns <= window[1])).any())


def reference_shape(how: FitHow, side: str, reference: Reference, in_window: Sequence[Fit]) -> ReferenceShape:
    """The shape that displacements of ``side`` are counted from; ``in_window`` are the window's fits, if it is one.

    Raises UsageError when it has no fitted set, or does not fit the wing.
    """
    if reference is None:
        return unloaded(how.half)
    if isinstance(reference, Path):
        return _from_file(how, side, reference / SHAPE if reference.is_dir() else reference)
    fits = Fit.join(in_window) if in_window else None
    found = mean_of(f"mean of {reference.begin_s:g} to {reference.end_s:g} s", how.half, fits, how.shared)
    if found is None:
        raise UsageError(
            f"--reference-window {reference.begin_s:g}:{reference.end_s:g}: no set of the {side} wing was fitted in it"
        )
    return found


def prior_scale(how: FitHow, observed: Observed) -> Floats:
    """The prior's scale that these sets (``picks``) make likeliest, if the data are to choose it."""
    return scale_of(how.problem(observed), how.settings)


def picks(count: int) -> Ints:
    """Which of ``count`` sets with enough markers the prior's scale is chosen from: SCALE_SETS, spread evenly."""
    return np.unique(np.linspace(0, count - 1, SCALE_SETS).round().astype(np.int64)) if count else np.empty(0, np.int64)


def joined(parts: list[SideFits]) -> SideFits:
    """Consecutive parts of one wing's fits as one."""
    per_set: dict[str, Any] = {
        member.name: np.concatenate([getattr(part, member.name) for part in parts])
        for member in fields(SideFits)
        if member.name not in _OF_THE_WING
    }
    return replace(parts[0], markers=MarkerSeries.join([part.markers for part in parts]), **per_set)


def as_in(half: HalfWing, series: MarkerSeries) -> MarkerSeries:
    """``series`` with the wing's markers in the wing's order; those that the table lacks are not seen."""
    unknown = sorted(set(series.marker.tolist()) - set(half.marker_ids.tolist()))
    if unknown:
        raise UsageError(
            f"the marker table has marker {unknown[0]} on the {series.side} wing, the wing file does not "
            f"(it has {half.marker_ids.size}); are both of the same aircraft?"
        )
    sets, markers = series.trigger_index.size, half.marker_ids.size
    column = {int(marker): at for at, marker in enumerate(half.marker_ids)}
    to = np.array([column[int(marker)] for marker in series.marker])
    time = np.repeat(series.frame_timestamp_ns[:, None], markers, axis=1)
    xyz, cov = np.full((sets, markers, 3), np.nan), np.full((sets, markers, 3, 3), np.nan)
    flags = np.full((sets, markers), "not_seen", dtype=object)
    time[:, to], xyz[:, to], cov[:, to], flags[:, to] = series.timestamp_ns, series.xyz_m, series.cov_m2, series.flags
    marker = np.asarray(half.marker_ids, dtype=np.int64)
    centroids = None if series.centroids is None else _centroids_in(series.centroids, to, time)
    return replace(series, marker=marker, timestamp_ns=time, xyz_m=xyz, cov_m2=cov, flags=flags, centroids=centroids)


def _centroids_in(centroids: Centroids, to: Ints, time_ns: Ints) -> Centroids:
    """``centroids`` at the columns ``to`` of as many markers as ``time_ns`` (F, M) has, which is theirs if not seen."""
    pixels, spread = np.full((*time_ns.shape, 2, 2), np.nan), np.full((*time_ns.shape, 2, 2, 2), np.nan)
    own, epipolar = np.repeat(time_ns[:, :, None], 2, axis=2), np.full(time_ns.shape, np.nan)
    pixels[:, to], spread[:, to] = centroids.pixels, centroids.covariance_px2
    own[:, to], epipolar[:, to] = centroids.timestamp_ns, centroids.epipolar_px
    return Centroids(pixels, spread, own, epipolar)


def _fits(how: FitHow, stretch: Stretch) -> tuple[Ints, Fit]:
    """(F, M) samples that the markers of the stretch's own sets are made of, and their fits."""
    series, own = stretch.markers, slice(stretch.first, stretch.last)
    observed = observe(series, how.half, how.rig, how.instants)
    if how.smooth_s == 0:
        observed = observed[own]
        fits = fit_each(how.problem(observed), how.settings, how.prior_scale)
    else:
        fits, observed = _smoothed(how, series, observed)[own], observed[own]
    return observed.points, with_residuals(how.half, fits, observed.xyz_m)


def _smoothed(how: FitHow, series: MarkerSeries, observed: Observed) -> Fit:
    time_s = (series.frame_timestamp_ns - series.frame_timestamp_ns[0]) * 1e-9
    if np.any(np.diff(time_s) <= 0):
        raise UsageError(f"{series.side} wing: times of the sets do not grow; smoothing in time needs that they do")
    assert how.prior_scale is not None
    return smooth_fits(how.problem(observed), how.settings, time_s, how.prior_scale, how.smooth_s)


def _from_file(how: FitHow, side: str, path: Path) -> ReferenceShape:
    table = read_table(path, ())
    if "marker" not in table.column_names:
        return recorded(table, path, side, how.half)
    series = marker_series(table, str(path)).get(side)
    if series is None:
        raise UsageError(f"{path}: has no {side} wing; give a reference with every wing of this recording")
    places = observe(as_in(how.half, series), how.half, None, InstantSettings())
    shared = shared_errors(table).get(side)
    fits = fit_each(places.problem(how.half, how.settings, None), how.settings, how.prior_scale)
    same = shared is not None and how.shared is not None and shared.as_in(how.shared)
    found = mean_of(str(path), how.half, fits, shared, same=same)
    if found is None:
        raise UsageError(f"{path}: the {side} wing at rest could not be fitted ({fits.reason[0]})")
    return found


def _rows(how: FitHow, fits: Fit, motion: SetMotion | None) -> _Rows:
    """What SideFits has of fits; the rest of a fit is dropped here, where it was made."""
    reference = how.reference or unloaded(how.half)
    net, sigma_net = _net(how.half, fits)
    noise = np.concatenate([fits.sigma_position_m, fits.sigma_twist_rad[:, :, None]], axis=2)
    if motion is not None:
        noise = np.hypot(noise, sigma_by_motion(how.half, fits, motion))
    response = np.zeros((*noise.shape, 1)) if how.shared is None else how.shared.of_shapes(how.half, fits)
    change = response if reference.shared is None else response - reference.shared
    sigma = np.hypot(noise, sigma_of(response))
    sigma_change = np.hypot(np.hypot(noise, sigma_of(change)), reference.sigma)
    return {
        "xyz_m": fits.position_m,
        "sigma_xyz_m": sigma[:, :, :3],
        "noise_sigma_xyz_m": noise[:, :, :3],
        "sigma_moved_m": sigma_change[:, :, :3],
        "twist_rad": fits.twist_rad,
        "sigma_twist_rad": sigma[:, :, 3],
        "noise_sigma_twist_rad": noise[:, :, 3],
        "sigma_twisted_rad": sigma_change[:, :, 3],
        "curvature_1pm": _at_nodes(fits.strain[:, :, 1:]),
        "sigma_curvature_1pm": _at_nodes(fits.sigma_strain[:, :, 1:]),
        "extension": _at_nodes(fits.strain[:, :, 0]),
        "sigma_extension": _at_nodes(fits.sigma_strain[:, :, 0]),
        "stiffness_change": fits.stiffness_change,
        "sigma_stiffness": fits.sigma_stiffness,
        "residual_m": fits.residual_m,
        "used": fits.used,
        "loads": fits.loads,
        "sigma_loads": np.sqrt(np.diagonal(fits.load_covariance, axis1=1, axis2=2)).reshape(fits.loads.shape),
        "net": net,
        "sigma_net": sigma_net,
        "chi2": fits.chi2,
        "dof": fits.dof,
        "iterations": fits.iterations,
        "outliers": fits.outlier.sum(axis=1),
        "reason": fits.reason,
    }


def _at_nodes(of_elements: Floats) -> Floats:
    """Values of sets' N elements (F, N, …) at the N + 1 nodes: the mean of a node's two."""
    padded = np.concatenate([of_elements[:, :1], of_elements, of_elements[:, -1:]], axis=1)
    return np.asarray((padded[:, :-1] + padded[:, 1:]) / 2)


def _gather(how: FitHow, series: MarkerSeries, points: Ints, rows: _Rows) -> SideFits:
    half, reference = how.half, how.reference or unloaded(how.half)
    outliers = rows.pop("outliers")
    reason = rows.pop("reason")
    alone = (rows["used"] & (points == 1)).any(axis=1)
    bridged = (reason == "") & ~rows["used"].any(axis=1)
    flagged = {"not_fitted": reason != "", "outlier": outliers > 0, "row_time": alone, "bridged": bridged}
    if series.motion is not None:
        flagged["no_lights"] = series.motion.lights == 0
    return SideFits(
        side=series.side,
        trigger_index=series.trigger_index,
        timestamp_ns=series.frame_timestamp_ns,
        s_m=half.node_s_m,
        unloaded_xyz_m=half.rest_position_m,
        reference=reference.name,
        reference_xyz_m=reference.xyz_m,
        reference_twist_rad=reference.twist_rad,
        reference_sigma_m=reference.sigma_position_m,
        markers=series,
        points=points,
        load_s_m=np.array(how.settings.load_stations_m),
        flags=np.array(
            [
                ",".join(name for name, applies in zip(flagged, row, strict=True) if applies)
                for row in zip(*flagged.values(), strict=True)
            ],
            dtype=object,
        ),
        reason=reason,
        smoothed_s=how.smooth_s,
        **rows,
    )


def _net(half: HalfWing, fits: Fit) -> tuple[Floats, Floats]:
    """Sums (F, 6) of the loads and of their moments about the root, and their sigma (F, 6)."""
    nodes = [half.node_at(station) for station in fits.load_s_m]
    sums = np.zeros((len(fits), 6, len(nodes), 6))
    sums[:] = np.eye(6)[:, None, :]
    sums[:, 3:, :, :3] = hat(fits.position_m[:, nodes] - fits.position_m[:, :1]).swapaxes(1, 2)
    flat = sums.reshape(len(fits), 6, -1)
    net = (flat @ fits.loads.reshape(len(fits), -1, 1))[:, :, 0]
    return net, np.sqrt(np.sum((flat @ fits.load_covariance) * flat, axis=2))
