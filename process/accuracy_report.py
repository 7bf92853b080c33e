"""Accuracy tables to Markdown and a picture."""

from pathlib import Path
from typing import Any

import numpy as np

_COLUMNS = {
    "paper_mm": "paper",
    "baseline_mm": "its method",
    "ours_mm": "ours",
    "ours_worst_mm": "worst",
    "ours_aligned_mm": "aligned",
    "ours_z_bias_mm": "z bias",
    "bound95_mm": "predicted 95 %",
    "within_bound95": "within it",
    "crlb_mm": "Cramér–Rao",
}
DIGITS = {"paper_mm": 2, "within_bound95": 0}


def markdown(tables: dict[str, list[dict[str, Any]]], calibrations: int) -> str:
    """Tables 5, 6 and 7."""
    lines = [
        f"Medians over {calibrations} independent calibrations. Errors are the mean distance of a target's points from",
        "their true places in the first camera's frame (eq. 8), in mm; *aligned*: after a rigid motion of the target.",
        "*Its method*: the paper's, on the same pictures. *Within it*: calibrations that err by less than their own",
        "predicted 95 %. *Cramér–Rao*: for measurements at the limit of noise.",
        "",
        "**Reprojection error, px (Table 5)**",
        "",
        "| F mm | source | paper | its method | ours |",
        "|---|---|---|---|---|",
    ]
    for row in tables["table5"]:
        values = " | ".join(_number(row[name], 3) for name in ("paper_px", "baseline_px", "ours_px"))
        lines.append(f"| {row['focal_mm']:g} | {row['source']} | {values} |")
    for table, title in (("table6", "Boards (Table 6)"), ("table7", "Pairs of lights 10.16 mm apart (Table 7)")):
        names = " | ".join(_COLUMNS.values())
        lines += ["", f"**{title}**", "", f"| F mm | Z mm | {names} |", "|---" * (len(_COLUMNS) + 2) + "|"]
        for row in tables[table]:
            values = " | ".join(_number(row[name], DIGITS.get(name, 3)) for name in _COLUMNS)
            lines.append(f"| {row['focal_mm']:g} | {row['z_mm']:g} | {values} |")
    return "\n".join(lines) + "\n"


def write_plots(path: Path, tables: dict[str, list[dict[str, Any]]]) -> None:
    """Error against distance, and against the place in the image for one calibration (the paper's Fig. 10)."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 3, figsize=(15, 4.5), layout="constrained")
    for axis, table, title in ((axes[0], "table6", "boards"), (axes[1], "table7", "lights")):
        for number, focal in enumerate(dict.fromkeys(row["focal_mm"] for row in tables[table])):
            rows = [row for row in tables[table] if row["focal_mm"] == focal]
            for name, style in (("paper_mm", ":"), ("baseline_mm", "--"), ("ours_mm", "-")):
                values = [np.nan if row[name] is None else row[name] for row in rows]
                label = f"F {focal:g} mm" if name == "ours_mm" else None
                axis.plot([row["z_mm"] for row in rows], values, style, marker=".", color=f"C{number}", label=label)
        axis.set(xlabel="Z (mm)", ylabel="error (mm)", yscale="log", title=f"{title}: paper :, its method --, ours –")
        axis.legend()
    boards = [row for row in tables["figure10"] if row["kind"] == "board"]
    for number, focal in enumerate(dict.fromkeys(row["focal_mm"] for row in boards)):
        own = [row for row in boards if row["focal_mm"] == focal]
        own = [row for row in own if row["z_mm"] == own[-1]["z_mm"]]
        for name, mark in (("baseline_xyz_mm", "x"), ("ours_xyz_mm", ".")):
            errors = np.linalg.norm(np.array([row[name] for row in own], np.float64), axis=1)
            label = f"F {focal:g} mm, Z {own[0]['z_mm']:g} mm" if mark == "." else None
            axes[2].plot([row["uv_px"][0] for row in own], errors, mark, ms=4, color=f"C{number}", label=label)
    axes[2].set(
        xlabel="u in cam0 (px)", ylabel="error (mm)", yscale="log", title="corners by place: its method x, ours ."
    )
    axes[2].legend()
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"
