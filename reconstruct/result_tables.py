"""Fits of both half wings → the tables of a result folder (docs/reference/result-files.md)."""

from collections.abc import Mapping

import numpy as np
import pyarrow as pa

from reconstruct.series import SideFits
from reconstruct.tables import (
    CURVATURE,
    FRAMES,
    LOAD_COLUMNS,
    LOADS,
    MOVED,
    NET_COLUMNS,
    POSITION,
    REFERENCE_POSITION,
    RESIDUAL,
    RESIDUALS,
    ROOT_COLUMNS,
    SHAPE,
    SIGMA,
    STIFFNESS_COLUMNS,
    TIP_COLUMNS,
    UNLOADED,
    Floats,
    Ints,
    Words,
    rms,
)


def result_tables(fits: Mapping[str, SideFits]) -> dict[str, pa.Table]:
    """File name → table, for shape, frames, loads, residuals and the unloaded wing; the left side's rows come first."""
    parts = [part_tables(fits[side]) for side in sorted(fits)]
    return {name: pa.concat_tables([part[name] for part in parts]) for name in parts[0]}


def part_tables(fits: SideFits) -> dict[str, pa.Table]:
    """File name → table, of some sets of one wing."""
    makers = {
        SHAPE: shape_table,
        FRAMES: frames_table,
        LOADS: loads_table,
        RESIDUALS: residuals_table,
        UNLOADED: unloaded_table,
    }
    return {name: make(fits) for name, make in makers.items()}


def shape_table(fits: SideFits) -> pa.Table:
    """One row a trigger and station."""
    return pa.table(
        {
            **_keys(fits, "station", fits.s_m.size),
            "s_m": np.tile(fits.s_m, fits.trigger_index.size),
            **_flat(POSITION, fits.xyz_m),
            "twist_deg": np.degrees(fits.twist_rad).ravel(),
            **_flat(SIGMA, fits.sigma_xyz_m),
            "sigma_twist_deg": np.degrees(fits.sigma_twist_rad).ravel(),
            **_flat([f"noise_{name}" for name in SIGMA], fits.noise_sigma_xyz_m),
            "noise_sigma_twist_deg": np.degrees(fits.noise_sigma_twist_rad).ravel(),
            **_flat(MOVED, fits.xyz_m - fits.reference_xyz_m),
            "twisted_deg": np.degrees(fits.twist_rad - fits.reference_twist_rad).ravel(),
            **_flat([f"sigma_{name}" for name in MOVED], fits.sigma_moved_m),
            "sigma_twisted_deg": np.degrees(fits.sigma_twisted_rad).ravel(),
            **_flat(CURVATURE, fits.curvature_1pm),
            **_flat([f"sigma_{name}" for name in CURVATURE], fits.sigma_curvature_1pm),
            "extension": fits.extension.ravel(),
            "sigma_extension": fits.sigma_extension.ravel(),
            "flags": _text(np.repeat(fits.flags, fits.s_m.size)),
        }
    )


def frames_table(fits: SideFits) -> pa.Table:
    """One row a trigger: the tip, the net load, how well the fit agrees with its markers."""
    twist = np.degrees((fits.twist_rad - fits.reference_twist_rad)[:, -1])
    tip = np.column_stack([(fits.xyz_m - fits.reference_xyz_m)[:, -1], twist])
    sigma_tip = np.column_stack([fits.sigma_moved_m[:, -1], np.degrees(fits.sigma_twisted_rad[:, -1])])
    residual = np.where(fits.used, np.linalg.norm(fits.residual_m, axis=-1), np.nan)
    return pa.table(
        {
            "trigger_index": fits.trigger_index,
            "side": _text([fits.side] * fits.trigger_index.size),
            "timestamp_ns": fits.timestamp_ns,
            "time_sigma_ns": fits.markers.time_sigma_ns,
            "ptp_state": _text(fits.markers.ptp_state),
            **_flat(TIP_COLUMNS, tip),
            **_flat([f"sigma_{name}" for name in TIP_COLUMNS], sigma_tip),
            **_flat(NET_COLUMNS, fits.net),
            **_flat([f"sigma_{name}" for name in NET_COLUMNS], fits.sigma_net),
            "residual_rms_mm": 1e3 * rms(residual, axis=1),
            "chi2_per_dof": fits.chi2 / fits.dof,
            "dof": fits.dof,
            **_flat(STIFFNESS_COLUMNS, fits.stiffness_change),
            **_flat([f"sigma_{name}" for name in STIFFNESS_COLUMNS], fits.sigma_stiffness),
            **_root(fits),
            "markers_used": fits.used.sum(axis=1).astype(np.int32),
            "iterations": fits.iterations.astype(np.int32),
            "flags": _text(fits.flags),
            "reason": _text(fits.reason),
        }
    )


def _root(fits: SideFits) -> dict[str, Floats | Ints]:
    """How the cameras had moved against the fuselage; NaN where they were taken to be at rest."""
    motion = fits.markers.motion
    count = fits.trigger_index.size
    change, sigma, lights = np.full((count, 6), np.nan), np.full((count, 6), np.nan), np.zeros(count, np.int64)
    if motion is not None:
        change, lights = motion.change, motion.lights
        sigma = np.sqrt(np.diagonal(motion.covariance, axis1=1, axis2=2))
    named = _flat(ROOT_COLUMNS, change) | _flat([f"sigma_{name}" for name in ROOT_COLUMNS], sigma)
    return {**named, "root_lights": lights}


def loads_table(fits: SideFits) -> pa.Table:
    """One row a trigger and load station."""
    return pa.table(
        {
            **_keys(fits, "load_station", fits.load_s_m.size),
            "s_m": np.tile(fits.load_s_m, fits.trigger_index.size),
            **_flat(LOAD_COLUMNS, fits.loads),
            **_flat([f"sigma_{name}" for name in LOAD_COLUMNS], fits.sigma_loads),
        }
    )


def residuals_table(fits: SideFits) -> pa.Table:
    """One row a trigger and marker: measured minus fitted."""
    sets, markers = fits.used.shape
    return pa.table(
        {
            "trigger_index": np.repeat(fits.trigger_index, markers),
            "side": _text([fits.side] * fits.used.size),
            "marker": np.tile(fits.markers.marker, sets).astype(np.int32),
            **_flat(RESIDUAL, fits.residual_m),
            "used": fits.used.ravel(),
            "points": fits.points.ravel().astype(np.int32),
        }
    )


def unloaded_table(fits: SideFits) -> pa.Table:
    """One row a station."""
    return pa.table(
        {
            "side": _text([fits.side] * fits.s_m.size),
            "station": np.arange(fits.s_m.size, dtype=np.int32),
            "s_m": fits.s_m,
            **_flat(POSITION, fits.unloaded_xyz_m),
            **_flat(REFERENCE_POSITION, fits.reference_xyz_m),
            "reference_twist_deg": np.degrees(fits.reference_twist_rad),
            **_flat([f"sigma_{name}" for name in REFERENCE_POSITION], fits.reference_sigma_m),
            "reference": _text([fits.reference] * fits.s_m.size),
        }
    )


def _keys(fits: SideFits, item: str, count: int) -> dict[str, object]:
    sets = fits.trigger_index.size
    return {
        "trigger_index": np.repeat(fits.trigger_index, count),
        "side": _text([fits.side] * (sets * count)),
        "timestamp_ns": np.repeat(fits.timestamp_ns, count),
        item: np.tile(np.arange(count, dtype=np.int32), sets),
    }


def _flat(names: list[str] | tuple[str, ...], values: Floats) -> dict[str, Floats]:
    """The last axis of ``values`` as one flat column a name."""
    return {name: values[..., at].ravel() for at, name in enumerate(names)}


def _text(values: list[str] | Words) -> pa.Array:
    return pa.array(values, pa.string())
