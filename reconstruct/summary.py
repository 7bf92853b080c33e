"""Fits of a flight → the figures of summary.json, and the same in words."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from process.json_file import finite_or_none
from reconstruct.series import SideFits
from reconstruct.tables import STIFFNESS_COLUMNS, TIP_COLUMNS, Floats

HOLES_LISTED = 100
_FITTED, _NOT_FITTED, _ABSENT = range(3)


def tally(fits: SideFits) -> dict[str, float]:
    """What of some sets adds up to the figures of a flight."""
    seen, residual = fits.markers.seen, np.linalg.norm(fits.residual_m, axis=-1)
    known = np.isfinite(residual)
    fitted = fits.converged
    return {
        "sets": fitted.size,
        "fitted": int(fitted.sum()),
        "markers": seen.size,
        "seen": int(seen.sum()),
        "left_out": int((known & ~fits.used).sum()),
        "used": int((known & fits.used).sum()),
        "residual_mm2": float(np.sum((1e3 * residual[known & fits.used]) ** 2)),
        "chi2": float(np.nansum(fits.chi2[fitted])),
        "dof": float(np.nansum(fits.dof[fitted])),
    }


def summarise(tallies: Mapping[str, Sequence[Mapping[str, float]]], frames: pa.Table) -> dict[str, Any]:
    """Counts and figures over all sides, and the same by side under ``by_side``.

    Each key is defined in docs/explanation/errors-defined.md.

    Args:
        tallies: of each side's parts.
        frames: frames.parquet.
    """
    triggers = np.unique(frames.column("trigger_index").to_numpy())
    times = frames.column("timestamp_ns").to_numpy()
    return {
        "triggers": int(triggers.size),
        "triggers_missing": int(triggers[-1] - triggers[0] + 1 - triggers.size),
        "start_utc": str(np.datetime64(int(times.min()), "ns")) + "Z",
        "duration_s": float((times.max() - times.min()) * 1e-9),
        "sides": sorted(tallies),
        **_figures([one for parts in tallies.values() for one in parts], frames),
        "by_side": {
            side: _figures(tallies[side], frames.filter(pc.equal(frames.column("side"), side)))
            for side in sorted(tallies)
        },
    }


def holes(frames: pa.Table) -> dict[str, Any]:
    """Where a wing has no shape, between the first and the last trigger of the flight: runs of consecutive triggers.

    ``holes`` lists the first HOLES_LISTED, ``sets_without_shape`` counts all.
    """
    trigger, side = frames.column("trigger_index").to_numpy(), frames.column("side").to_numpy(zero_copy_only=False)
    fitted = np.isfinite(frames.column(TIP_COLUMNS[2]).to_numpy())
    first, count = int(trigger.min()), int(np.ptp(trigger)) + 1
    listed: list[dict[str, Any]] = []
    missing = 0
    for one in sorted(set(side)):
        state = np.full(count + 2, _FITTED)
        state[1:-1] = _ABSENT
        own = side == one
        state[trigger[own] - first + 1] = np.where(fitted[own], _FITTED, _NOT_FITTED)
        missing += int((state != _FITTED).sum())
        for begin, end in pairwise((np.flatnonzero(np.diff(state)) + 1).tolist()):
            if state[begin] != _FITTED:
                why = "no set recorded, or none readable" if state[begin] == _ABSENT else "not fitted"
                run = {"first_trigger": first + begin - 1, "last_trigger": first + end - 2, "reason": why}
                listed.append({"side": one, **run})
    return {"sets_without_shape": missing, "holes": listed[:HOLES_LISTED]}


def _figures(parts: Sequence[Mapping[str, float]], frames: pa.Table) -> dict[str, Any]:
    sums = {key: sum(part[key] for part in parts) for key in parts[0]}
    tip_m = np.linalg.norm(_columns(frames, [f"sigma_{name}" for name in TIP_COLUMNS[:3]]), axis=0)
    twist_deg = _columns(frames, [f"sigma_{TIP_COLUMNS[3]}"])[0]
    return {
        "sets": sums["sets"],
        "converged_percent": 100 * sums["fitted"] / sums["sets"],
        "markers_seen_percent": 100 * sums["seen"] / sums["markers"],
        "markers_left_out_percent": 100 * sums["left_out"] / max(1, sums["seen"]),
        "residual_rms_mm": float(np.sqrt(sums["residual_mm2"] / sums["used"])) if sums["used"] else None,
        "chi2_per_dof": finite_or_none(sums["chi2"] / sums["dof"]) if sums["fitted"] else None,
        "stiffness_change_percent": _stiffness(frames, ""),
        "sigma_stiffness_percent": _stiffness(frames, "sigma_"),
        "sigma_tip_mm": _median(1e3 * tip_m),
        "sigma_tip_twist_deg": _median(twist_deg),
    }


def _stiffness(frames: pa.Table, prefix: str) -> dict[str, float | None]:
    percent = 100 * _columns(frames, [prefix + name for name in STIFFNESS_COLUMNS])
    return {key: _median(values) for key, values in zip(("EA", "GJ", "EI_out", "EI_in"), percent, strict=True)}


def _columns(frames: pa.Table, names: Sequence[str]) -> Floats:
    return np.stack([frames.column(name).to_numpy() for name in names])


def _median(values: Floats) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else None


def verdict(summary: Mapping[str, Any]) -> list[str]:
    """What a reader should know of the data's quality, most important first; starts with one word."""
    seen, fitted = summary["markers_seen_percent"], summary["converged_percent"]
    left_out, ratio = summary["markers_left_out_percent"], summary["chi2_per_dof"]
    grave = fitted < 90 or seen < 50
    doubtful = grave or fitted < 99.5 or seen < 90 or left_out > 2 or ratio is None or not 0.3 < ratio < 3
    doubtful = doubtful or bool(summary.get("warnings"))
    lines = ["Poor." if grave else "Usable with care." if doubtful else "Good."]
    lines.append(
        "Every set was fitted."
        if fitted == 100
        else f"{fitted:.1f} % of the sets were fitted; the others are NaN and flagged."
    )
    amount = "Practically all markers" if seen >= 99 else "Most markers" if seen >= 90 else "Only some of the markers"
    lines.append(f"{amount} were measured ({seen:.1f} %).")
    if left_out > 2:
        lines.append(f"{left_out:.1f} % of them did not fit the wing and were left out: reflections or mix-ups?")
    if ratio is not None:
        lines.append(_agreement(ratio))
    lines += summary.get("warnings", [])
    lines += [_moved(side, found) for side, found in summary.get("root_motion", {}).items()]
    if summary["triggers_missing"]:
        lines.append(f"{summary['triggers_missing']} triggers between the first and the last have no set at all.")
    return lines


def _moved(side: str, found: Mapping[str, Any]) -> str:
    """What the cameras' motion against the fuselage was, by a side's figures under ``root_motion``."""
    return (
        f"The {side} cameras moved by up to {found['turn_mrad']:.2f} mrad and {found['shift_mm']:.2f} mm since the "
        f"{found['since']}, {found['tip_rms_mm']:.2f} ± {found['sigma_tip_mm']:.2f} mm RMS at the tip: taken out."
    )


def _agreement(ratio: float) -> str:
    if ratio > 3:
        return (
            f"Residuals are {np.sqrt(ratio):.1f} times what the stated noise explains: calibration, survey or wing "
            "file are off, and so are the stated sigmas."
        )
    if ratio < 0.3:
        return f"Residuals are {np.sqrt(ratio):.2f} times the stated noise: the stated sigmas are too large."
    return f"Residuals agree with the stated noise (χ² a degree of freedom {ratio:.2f})."
