"""Fits of a flight → the figures of summary.json, and the same in words."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from process.json_file import finite_or_none
from reconstruct.series import SideFits
from reconstruct.tables import Floats


def summarise(fits: Mapping[str, SideFits]) -> dict[str, Any]:
    """Counts and figures over all sides, and the same by side under ``by_side``.

    Each key is defined in docs/explanation/errors-defined.md.
    """
    sides = [fits[side] for side in sorted(fits)]
    triggers = np.unique(np.concatenate([side.trigger_index for side in sides]))
    times = np.concatenate([side.timestamp_ns for side in sides])
    return {
        "triggers": int(triggers.size),
        "triggers_missing": int(triggers[-1] - triggers[0] + 1 - triggers.size),
        "start_utc": str(np.datetime64(int(times.min()), "ns")) + "Z",
        "duration_s": float((times.max() - times.min()) * 1e-9),
        "sides": [side.side for side in sides],
        "reference": sides[0].reference,
        "smoothed_s": sides[0].smoothed_s,
        **_figures(sides),
        "by_side": {side.side: _figures([side]) for side in sides},
    }


def _figures(sides: list[SideFits]) -> dict[str, Any]:
    seen = np.concatenate([side.markers.seen.ravel() for side in sides])
    used = np.concatenate([side.used.ravel() for side in sides])
    residual = np.concatenate([np.linalg.norm(side.residual_m, axis=-1).ravel() for side in sides])
    fitted = np.concatenate([side.converged for side in sides])
    chi2, dof = (np.concatenate([getattr(side, name) for side in sides]) for name in ("chi2", "dof"))
    outlier = np.isfinite(residual) & ~used
    tip = np.concatenate([np.linalg.norm(side.sigma_moved_m[:, -1], axis=-1) for side in sides])
    twist = np.degrees(np.concatenate([side.sigma_twisted_rad[:, -1] for side in sides]))
    return {
        "sets": int(fitted.size),
        "converged_percent": float(100 * fitted.mean()),
        "markers_seen_percent": float(100 * seen.mean()),
        "markers_left_out_percent": float(100 * outlier.sum() / max(1, int(seen.sum()))),
        "residual_rms_mm": _rms(1e3 * residual[used & np.isfinite(residual)]),
        "chi2_per_dof": finite_or_none(np.nansum(chi2[fitted]) / np.nansum(dof[fitted])) if fitted.any() else None,
        "stiffness_change_percent": _stiffness(sides, "stiffness_change"),
        "sigma_stiffness_percent": _stiffness(sides, "sigma_stiffness"),
        "sigma_tip_mm": _median(1e3 * tip),
        "sigma_tip_twist_deg": _median(twist),
    }


def _stiffness(sides: list[SideFits], name: str) -> dict[str, float | None]:
    percent = 100 * np.concatenate([getattr(side, name) for side in sides])
    return {key: _median(percent[:, at]) for at, key in enumerate(("EA", "GJ", "EI_out", "EI_in"))}


def _rms(values: Floats) -> float | None:
    return float(np.sqrt(np.mean(values**2))) if values.size else None


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
    if summary["triggers_missing"]:
        lines.append(f"{summary['triggers_missing']} triggers between the first and the last have no set at all.")
    return lines


def _agreement(ratio: float) -> str:
    if ratio > 3:
        return (
            f"Residuals are {np.sqrt(ratio):.1f} times what the stated noise explains: calibration, survey or wing "
            "file are off, and so are the stated sigmas."
        )
    if ratio < 0.3:
        return f"Residuals are {np.sqrt(ratio):.2f} times the stated noise: the stated sigmas are too large."
    return f"Residuals agree with the stated noise (χ² a degree of freedom {ratio:.2f})."
