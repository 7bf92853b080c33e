"""A flight's marker table → the fitted shape of both half wings at every trigger."""

import multiprocessing
import os
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any

import numpy as np

from capture.errors import ReconstructError, UsageError
from process.workers import one_blas_thread
from reconstruct.fit import Fit, common_scale, fit_frame
from reconstruct.instants import InstantMarkers, InstantSettings, at_common_instant
from reconstruct.smooth import smooth_fits
from reconstruct.tables import Bools, Floats, Ints, MarkerSeries, Words
from reconstruct.wing import HalfWing, Wing
from reconstruct.wing_file import FitSettings

_Rows = dict[str, Any]  # field of SideFits → array over a block's sets

BLOCK_SETS = 20  # sets fitted one after the other with warm starts; fixed, so that workers do not change results
UNLOADED_WING = "unloaded wing"


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
    sigma_xyz_m: Floats  # (F, N + 1, 3)
    twist_rad: Floats  # (F, N + 1)
    sigma_twist_rad: Floats  # (F, N + 1)
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


@dataclass(frozen=True)
class _Block:
    side: str
    first: int
    xyz_m: Floats
    cov_m2: Floats
    prior_scale: Floats | None


def fit_series(
    markers: Mapping[str, MarkerSeries],
    wing: Wing,
    *,
    instants: InstantSettings | None = None,
    smooth_s: float = 0.0,
    workers: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> dict[str, SideFits]:
    """Fit every set of both sides; ``progress`` is told the number of sets fitted since it was last called.

    Markers are first brought to their set's common instant. Sets are fitted in blocks of BLOCK_SETS, each from the
    last one's fit; blocks start from the unloaded wing, so the result does not depend on ``workers`` (default: one a
    core this process may use). A set that cannot be fitted is NaN and flagged. With ``smooth_s`` the sets of a side are
    smoothed in time over so many seconds instead, one after the other, and sets that could not be fitted are bridged.
    Raises UsageError when the markers are not those of ``wing`` or none was measured, ReconstructError when a worker
    process dies.
    """
    settings = _settings(wing)
    measured = {}
    for side, series in markers.items():
        half = _half(wing, side)
        series = _as_in(half, series)
        measured[side] = (series, at_common_instant(series, instants))
    if not any(moved.points.any() for _, moved in measured.values()):
        raise UsageError("no marker was measured in any set; look at the flags column of the marker table")
    if smooth_s > 0:
        return {side: _smoothed(wing, *both, smooth_s, progress) for side, both in measured.items()}
    blocks = [block for side, (_, moved) in measured.items() for block in _blocks(wing, side, moved)]
    done: dict[str, dict[int, _Rows]] = {side: {} for side in measured}
    for block, rows in _fit_blocks(blocks, wing, workers or len(os.sched_getaffinity(0))):
        done[block.side][block.first] = rows
        if progress is not None:
            progress(len(block.xyz_m))
    load_s_m = np.array(settings.load_stations_m)
    return {
        side: _gather(_half(wing, side), *measured[side], load_s_m, [done[side][first] for first in sorted(done[side])])
        for side in measured
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


def _blocks(wing: Wing, side: str, moved: InstantMarkers) -> list[_Block]:
    sets, settings = moved.points.shape[0], _settings(wing)
    scale = None
    if settings.prior_weight == "data":
        scale = common_scale(_half(wing, side), moved.xyz_m, moved.cov_m2, settings)
    return [
        _Block(side, first, moved.xyz_m[first : first + BLOCK_SETS], moved.cov_m2[first : first + BLOCK_SETS], scale)
        for first in range(0, sets, BLOCK_SETS)
    ]


def _smoothed(
    wing: Wing, series: MarkerSeries, moved: InstantMarkers, smooth_s: float, progress: Callable[[int], None] | None
) -> SideFits:
    half, settings = _half(wing, series.side), _settings(wing)
    if settings.loads != "everywhere":
        raise UsageError('smoothing in time needs loads = "everywhere" in the wing file\'s [fit]')
    time_s = (series.frame_timestamp_ns - series.frame_timestamp_ns[0]) * 1e-9
    if np.any(np.diff(time_s) <= 0):
        raise UsageError(f"{series.side} wing: times of the sets do not grow; smoothing in time needs that they do")
    scale = common_scale(half, moved.xyz_m, moved.cov_m2, settings)
    fits = smooth_fits(half, settings, moved.xyz_m, moved.cov_m2, time_s, scale, smooth_s, progress or (lambda _: None))
    rows = [_row(half, fit) for fit in fits]
    block = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return _gather(half, series, moved, np.array(settings.load_stations_m), [block], smooth_s)


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
    return fit_block(half, _settings(wing), block.xyz_m, block.cov_m2, block.prior_scale)


def fit_block(
    half: HalfWing, settings: FitSettings, xyz_m: Floats, cov_m2: Floats, prior_scale: Floats | None = None
) -> dict[str, Any]:
    """Fit consecutive sets, each from the last one's fit (one that did not converge starts nothing).

    The prior's scale is that given, or each set chooses its own.

    Returns what SideFits has of them, an array a field; the rest of a fit is dropped here, where it was made.
    """
    rows = []
    fit: Fit | None = None
    for xyz, cov in zip(xyz_m, cov_m2, strict=True):
        fit = fit_frame(half, xyz, cov, settings, start=fit, prior_scale=prior_scale)
        rows.append(_row(half, fit))
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def _row(half: HalfWing, fit: Fit) -> dict[str, Any]:
    net, sigma_net = _net(half, fit)
    return {
        "xyz_m": fit.position_m,
        "sigma_xyz_m": fit.sigma_position_m,
        "twist_rad": fit.twist_rad,
        "sigma_twist_rad": fit.sigma_twist_rad,
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


def _gather(
    half: HalfWing,
    series: MarkerSeries,
    moved: InstantMarkers,
    load_s_m: Floats,
    blocks: list[_Rows],
    smoothed_s: float = 0.0,
) -> SideFits:
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
        reference=UNLOADED_WING,
        reference_xyz_m=half.rest_position_m,
        reference_twist_rad=np.zeros(half.node_s_m.size),
        markers=series,
        points=moved.points,
        load_s_m=load_s_m,
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
