"""A flight's marker table → the fitted shape of both half wings at every trigger."""

import itertools
import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from capture.errors import ReconstructError, UsageError
from process.reference import Window
from process.workers import one_blas_thread
from reconstruct.fit import Fit, common_scale, fit_frame
from reconstruct.instants import InstantMarkers, InstantSettings, at_common_instant
from reconstruct.reference import Reference, ReferenceShape, mean_of, recorded, unloaded
from reconstruct.shared import SharedError, shared_errors, sigma_of
from reconstruct.smooth import smooth_fits
from reconstruct.tables import SHAPE, Bools, Floats, Ints, MarkerSeries, Words, marker_series, read_table
from reconstruct.wing import HalfWing, Wing
from reconstruct.wing_file import FitSettings

_Rows = dict[str, Any]  # field of SideFits → array over a block's sets

BLOCK_SETS = 20  # sets fitted one after the other with warm starts; fixed, so that workers do not change results


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
    reference_twist_rad: Floats  # (N + 1,) and its twist against the unloaded wing
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
    flags: Words  # (F,) str, empty when good: not_fitted, outlier (markers left out), row_time, bridged
    reason: Words  # (F,) str, why a set could not be fitted
    smoothed_s: float  # correlation time of the smoothing; 0: every set by itself

    @property
    def converged(self) -> Bools:
        """(F,) whether the set was fitted."""
        return np.asarray(np.isfinite(self.xyz_m).all(axis=(1, 2)))


@dataclass(frozen=True, eq=False)
class _Side:
    """One side, ready to be fitted."""

    half: HalfWing
    settings: FitSettings
    series: MarkerSeries
    moved: InstantMarkers
    prior_scale: Floats | None
    shared: SharedError | None


@dataclass(frozen=True, eq=False)
class _Block:
    side: str
    first: int
    xyz_m: Floats
    cov_m2: Floats
    prior_scale: Floats | None
    shared: SharedError | None
    reference: ReferenceShape


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

    Markers are first brought to their set's common instant. Sets are fitted in blocks of BLOCK_SETS, each from the
    last one's fit; blocks start from the unloaded wing, so the result does not depend on ``workers`` (default: one a
    core this process may use). A set that cannot be fitted is NaN and flagged. With ``smooth_s`` the sets of a side are
    smoothed in time over so many seconds instead, one after the other, and sets that could not be fitted are bridged.
    ``shared`` are the errors that all frames share, by side; without, sigmas hold noise only. Displacements are counted
    from ``reference``.

    Raises:
        UsageError: the markers are not those of ``wing``, or none was measured, or ``reference`` does not fit them.
        ReconstructError: a worker process died.
    """
    sides = {
        side: _side(wing, _as_in(_half(wing, side), series), instants, (shared or {}).get(side))
        for side, series in markers.items()
    }
    if not any(own.moved.points.any() for own in sides.values()):
        raise UsageError("no marker was measured in any set; look at the flags column of the marker table")
    start_ns = min(int(own.series.frame_timestamp_ns.min()) for own in sides.values())
    if smooth_s > 0:
        return {side: _smoothed(own, reference, start_ns, smooth_s, progress) for side, own in sides.items()}
    references = {side: _reference(own, reference, start_ns) for side, own in sides.items()}
    blocks = [block for side, own in sides.items() for block in _blocks(own, references[side])]
    done: dict[str, dict[int, _Rows]] = {side: {} for side in sides}
    for block, rows in _fit_blocks(blocks, wing, workers or len(os.sched_getaffinity(0))):
        done[block.side][block.first] = rows
        if progress is not None:
            progress(len(block.xyz_m))
    return {
        side: _gather(own, references[side], [done[side][first] for first in sorted(done[side])])
        for side, own in sides.items()
    }


def _half(wing: Wing, side: str) -> HalfWing:
    return wing.left if side == "left" else wing.right


def _settings(wing: Wing) -> FitSettings:
    if wing.fit is None:
        raise UsageError(f"the wing {wing.name!r} has no [fit] section: say where its loads act (load_stations_m)")
    return wing.fit


def _as_in(half: HalfWing, series: MarkerSeries) -> MarkerSeries:
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
    return MarkerSeries(
        series.side,
        np.asarray(half.marker_ids, dtype=np.int64),
        series.trigger_index,
        series.frame_timestamp_ns,
        time,
        xyz,
        cov,
        flags,
    )


def _side(wing: Wing, series: MarkerSeries, instants: InstantSettings | None, shared: SharedError | None) -> _Side:
    half, settings, moved = _half(wing, series.side), _settings(wing), at_common_instant(series, instants)
    scale = None
    if settings.prior_weight == "data":
        scale = common_scale(half, moved.xyz_m, moved.cov_m2, settings)
    return _Side(half, settings, series, moved, scale, shared)


def _blocks(own: _Side, reference: ReferenceShape) -> list[_Block]:
    xyz, cov = own.moved.xyz_m, own.moved.cov_m2
    return [
        _Block(
            own.series.side,
            first,
            xyz[first : first + BLOCK_SETS],
            cov[first : first + BLOCK_SETS],
            own.prior_scale,
            own.shared,
            reference,
        )
        for first in range(0, len(xyz), BLOCK_SETS)
    ]


def _reference(own: _Side, reference: Reference, start_ns: int) -> ReferenceShape:
    """The side's shape that displacements are counted from; a window's sets are fitted for it first."""
    if reference is None:
        return unloaded(own.half)
    if isinstance(reference, Path):
        return _from_file(own, reference / SHAPE if reference.is_dir() else reference)
    chosen = _in_window(own, reference, start_ns)
    fits: list[Fit] = []
    for block in _blocks(own, unloaded(own.half)):
        inside = chosen[block.first : block.first + BLOCK_SETS]
        if inside.any():
            found = fits_in_turn(own.half, own.settings, block.xyz_m, block.cov_m2, block.prior_scale)
            fits += [fit for fit, wanted in zip(found, inside, strict=True) if wanted]
    return _mean_in_window(own, reference, start_ns, fits)


def _from_file(own: _Side, path: Path) -> ReferenceShape:
    table, side = read_table(path, ()), own.series.side
    if "marker" not in table.column_names:
        return recorded(table, path, side, own.half)
    series = marker_series(table, str(path)).get(side)
    if series is None:
        raise UsageError(f"{path}: has no {side} wing; give a reference with every wing of this recording")
    moved = at_common_instant(_as_in(own.half, series))
    fits = list(fits_in_turn(own.half, own.settings, moved.xyz_m, moved.cov_m2, own.prior_scale))
    shared = shared_errors(table).get(side)
    same = shared is not None and own.shared is not None and shared.as_in(own.shared)
    found = mean_of(str(path), own.half, fits, shared, same=same)
    if found is None:
        raise UsageError(f"{path}: the {side} wing at rest could not be fitted ({fits[0].reason})")
    return found


def _in_window(own: _Side, window: Window, start_ns: int) -> Bools:
    since_s = (own.series.frame_timestamp_ns - start_ns) * 1e-9
    return np.asarray((since_s >= window.begin_s) & (since_s <= window.end_s))


def _mean_in_window(own: _Side, window: Window, start_ns: int, fits: Iterable[Fit]) -> ReferenceShape:
    found = mean_of(f"mean of {window.begin_s:g} to {window.end_s:g} s", own.half, fits, own.shared)
    if found is None:
        since_s = (own.series.frame_timestamp_ns - start_ns) * 1e-9
        raise UsageError(
            f"--reference-window {window.begin_s:g}:{window.end_s:g}: no set of the {own.series.side} wing was fitted "
            f"in it (the recording has {since_s.min():.1f} to {since_s.max():.1f} s)"
        )
    return found


def _smoothed(
    own: _Side, reference: Reference, start_ns: int, smooth_s: float, progress: Callable[[int], None] | None
) -> SideFits:
    series, moved = own.series, own.moved
    if own.settings.loads != "everywhere":
        raise UsageError('smoothing in time needs loads = "everywhere" in the wing file\'s [fit]')
    time_s = (series.frame_timestamp_ns - series.frame_timestamp_ns[0]) * 1e-9
    if np.any(np.diff(time_s) <= 0):
        raise UsageError(f"{series.side} wing: times of the sets do not grow; smoothing in time needs that they do")
    scale = common_scale(own.half, moved.xyz_m, moved.cov_m2, own.settings)
    told = progress or (lambda _: None)
    fits = smooth_fits(own.half, own.settings, moved.xyz_m, moved.cov_m2, time_s, scale, smooth_s, told)
    if isinstance(reference, Window):
        inside = _in_window(own, reference, start_ns)
        shape = _mean_in_window(own, reference, start_ns, (fits[k] for k in np.flatnonzero(inside)))
    else:
        shape = _reference(own, reference, start_ns)
    return _gather(own, shape, [_rows(own.half, fits, own.shared, shape)], smooth_s)


def _fit_blocks(blocks: list[_Block], wing: Wing, workers: int) -> Iterator[tuple[_Block, _Rows]]:
    """Blocks with their fits, in the order they get done."""
    workers = min(workers, len(blocks))
    if workers <= 1:
        for block in blocks:
            yield block, _fit_block(wing, block)
        return
    spawn = multiprocessing.get_context("spawn")
    with (
        one_blas_thread(),
        ProcessPoolExecutor(workers, mp_context=spawn, initializer=_set_wing, initargs=(wing,)) as pool,
    ):
        pending = {pool.submit(_fit_block_here, block): block for block in blocks}
        try:
            for done in as_completed(list(pending)):
                yield pending.pop(done), done.result()
        except BrokenProcessPool as error:
            raise ReconstructError("a worker process died while fitting (out of memory?); try --workers 1") from error
        finally:
            for future in pending:
                future.cancel()


_wing: Wing | None = None  # of a worker process, set once when it starts


def _set_wing(wing: Wing) -> None:
    global _wing
    _wing = wing


def _fit_block_here(block: _Block) -> _Rows:
    assert _wing is not None
    return _fit_block(_wing, block)


def _fit_block(wing: Wing, block: _Block) -> _Rows:
    half = _half(wing, block.side)
    fits = fits_in_turn(half, _settings(wing), block.xyz_m, block.cov_m2, block.prior_scale)
    return _rows(half, fits, block.shared, block.reference)


def fits_in_turn(
    half: HalfWing, settings: FitSettings, xyz_m: Floats, cov_m2: Floats, prior_scale: Floats | None = None
) -> Iterator[Fit]:
    """Fit consecutive sets (F, M, 3), each from the last one's fit (one that did not converge starts nothing).

    The prior's scale is that given, or each set chooses its own.
    """
    fit: Fit | None = None
    for xyz, cov in zip(xyz_m, cov_m2, strict=True):
        fit = fit_frame(half, xyz, cov, settings, start=fit, prior_scale=prior_scale)
        yield fit


def _rows(half: HalfWing, fits: Iterable[Fit], shared: SharedError | None, reference: ReferenceShape) -> _Rows:
    """What SideFits has of fits, an array a field; the rest of a fit is dropped here, where it was made."""
    rows = []
    waiting = iter(fits)
    while block := list(itertools.islice(waiting, BLOCK_SETS)):
        responses = None if shared is None else shared.of_shapes(half, block)
        for k, fit in enumerate(block):
            rows.append(_row(half, fit, None if responses is None else responses[k], reference))
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def _row(half: HalfWing, fit: Fit, shared: Floats | None, reference: ReferenceShape) -> dict[str, Any]:
    net, sigma_net = _net(half, fit)
    noise = np.column_stack([fit.sigma_position_m, fit.sigma_twist_rad])
    response = np.zeros((*noise.shape, 1)) if shared is None else shared
    change = response if reference.shared is None else response - reference.shared
    sigma = np.hypot(noise, sigma_of(response))
    sigma_change = np.hypot(np.hypot(noise, sigma_of(change)), reference.sigma)
    return {
        "xyz_m": fit.position_m,
        "sigma_xyz_m": sigma[:, :3],
        "noise_sigma_xyz_m": noise[:, :3],
        "sigma_moved_m": sigma_change[:, :3],
        "twist_rad": fit.twist_rad,
        "sigma_twist_rad": sigma[:, 3],
        "noise_sigma_twist_rad": noise[:, 3],
        "sigma_twisted_rad": sigma_change[:, 3],
        "curvature_1pm": _at_nodes(fit.strain[:, 1:]),
        "sigma_curvature_1pm": _at_nodes(fit.sigma_strain[:, 1:]),
        "stiffness_change": fit.stiffness_change,
        "sigma_stiffness": fit.sigma_stiffness,
        "residual_m": fit.residual_m,
        "used": fit.used,
        "loads": fit.loads,
        "sigma_loads": np.sqrt(np.diag(fit.load_covariance)).reshape(-1, 6),
        "net": net,
        "sigma_net": sigma_net,
        "chi2": fit.chi2,
        "dof": fit.dof,
        "iterations": fit.iterations,
        "outliers": int(fit.outlier.sum()),
        "reason": fit.reason,
    }


def _at_nodes(of_elements: Floats) -> Floats:
    """Values of N elements at the N + 1 nodes: the mean of a node's two."""
    padded = np.concatenate([of_elements[:1], of_elements, of_elements[-1:]])
    return np.asarray((padded[:-1] + padded[1:]) / 2)


def _gather(own: _Side, reference: ReferenceShape, blocks: list[_Rows], smoothed_s: float = 0.0) -> SideFits:
    half, series, moved = own.half, own.series, own.moved
    rows = {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}
    outliers = rows.pop("outliers")
    reason = rows.pop("reason").astype(object)
    alone = (rows["used"] & (moved.points == 1)).any(axis=1)
    bridged = (reason == "") & ~rows["used"].any(axis=1)
    flagged = {"not_fitted": reason != "", "outlier": outliers > 0, "row_time": alone, "bridged": bridged}
    return SideFits(
        side=series.side,
        trigger_index=series.trigger_index,
        timestamp_ns=series.frame_timestamp_ns,
        s_m=half.node_s_m,
        unloaded_xyz_m=half.rest_position_m,
        reference=reference.name,
        reference_xyz_m=reference.xyz_m,
        reference_twist_rad=reference.twist_rad,
        markers=series,
        points=moved.points,
        load_s_m=np.array(own.settings.load_stations_m),
        flags=np.array(
            [
                ",".join(name for name, applies in zip(flagged, row, strict=True) if applies)
                for row in zip(*flagged.values(), strict=True)
            ],
            dtype=object,
        ),
        reason=reason,
        smoothed_s=smoothed_s,
        **rows,
    )


def _net(half: HalfWing, fit: Fit) -> tuple[Floats, Floats]:
    """Sum of the loads and of their moments about the root, (6,), and its sigma (6,)."""
    nodes = [half.node_at(station) for station in fit.load_s_m]
    sums = np.zeros((6, len(nodes), 6))
    for at, (x, y, z) in enumerate(fit.position_m[nodes] - fit.position_m[0]):
        sums[:, at] = np.eye(6)
        sums[3:, at, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    flat = sums.reshape(6, -1)
    return flat @ fit.loads.ravel(), np.sqrt(np.einsum("ia,ab,ib->i", flat, fit.load_covariance, flat))
