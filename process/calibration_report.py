"""A calibration to a page a person can judge it by: residuals, coverage of the images, the board's print."""

import base64
import html
import io
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from capture.errors import ProcessError
from process.board import Board
from process.calibration_session import SessionCalibration

_STYLE = """body{font:15px/1.45 system-ui,sans-serif;max-width:62rem;margin:2rem auto;padding:0 1rem;color:#222}
table{border-collapse:collapse}td,th{padding:.2rem .8rem;text-align:right;border-bottom:1px solid #ddd}
td:first-child,th:first-child{text-align:left}img{max-width:100%}code{background:#f3f3f3}"""


def write_report(path: Path, result: SessionCalibration, board: Board, summary: dict[str, Any], command: str) -> None:
    """Write the HTML page; ProcessError if it cannot be written."""
    parts = [
        "<!doctype html><meta charset='utf-8'><title>Stereo calibration</title>",
        f"<style>{_STYLE}</style><h1>Stereo calibration</h1><p><code>{html.escape(command)}</code></p>",
        _figures_table(summary),
        "".join(f"<p><b>Warning:</b> {html.escape(text)}</p>" for text in result.calibration.warnings),
        "<h2>Residuals over the images</h2><p>Each arrow is a corner's residual (projected minus measured). A pattern "
        "means that the lens model or the board is wrong; empty regions of the image are extrapolated.</p>",
        _image(_residual_figure(result)),
        "<h2>Views</h2><p>A view that stands out was not taken at the same instant by both cameras, or is blurred.</p>",
        _image(_views_figure(result)),
    ]
    if summary["board"]["estimated"]:
        parts += ["<h2>The board as printed</h2>", _image(_board_figure(result, board))]
    left_out = [view for view in summary["views"] if not view["used"]]
    if left_out:
        rows = "".join(
            f"<tr><td>{html.escape(view['cam0'])}</td><td>{html.escape(view['cam1'])}</td>"
            f"<td>{html.escape(view['reason'])}</td></tr>"
            for view in left_out
        )
        parts.append(f"<h2>Left out</h2><table>{rows}</table>")
    try:
        path.write_text("\n".join(parts) + "\n", encoding="utf-8")
    except OSError as error:
        raise ProcessError(f"{path}: cannot be written ({error.strerror})") from error


def _figures_table(summary: dict[str, Any]) -> str:
    detail = summary["calibration"]
    rows = [
        ("RMS, cam0 / cam1", " / ".join(f"{camera['rms_px']:.4f}" for camera in summary["cameras"]) + " px"),
        ("RMS, cameras alone on the nominal board", " / ".join(f"{rms:.4f}" for rms in detail["alone_rms_px"]) + " px"),
        ("RMS, stereo", f"{summary['stereo']['rms_px']:.4f} px"),
        ("RMS, stereo in the paper's two stages", f"{detail['two_stage_rms_px']:.4f} px"),
        ("Baseline", f"{1000 * summary['stereo']['baseline_m']:.3f} mm"),
        ("Noise of a corner's coordinate", f"{detail['sigma_px']:.4f} px"),
        ("Gradient at the end (0: optimum)", f"{detail['gradient']:.1e}"),
    ]
    for entry in detail["predicted_sigma_mm"]:
        sigma = " / ".join(f"{value:.3f}" for value in entry["sigma_xyz_mm"])
        rows.append((f"Sigma x / y / z at {entry['range_m']:g} m, from the calibration", f"{sigma} mm"))
    return "<table>" + "".join(f"<tr><td>{name}</td><td>{value}</td></tr>" for name, value in rows) + "</table>"


def _residual_figure(result: SessionCalibration) -> Figure:
    figure = Figure(figsize=(11, 4.3), layout="constrained")
    calibration = result.calibration
    scale = 60.0 / max(3.0 * calibration.stereo_rms_px, 1e-6)  # a large residual is drawn 60 px long
    for camera, axes in enumerate(figure.subplots(1, 2)):
        places = result.corners_px[camera].reshape(-1, 2)
        arrows = calibration.residuals_px[camera].reshape(-1, 2) * scale
        axes.quiver(*places.T, *arrows.T, angles="xy", scale_units="xy", scale=1.0, width=0.0015, color="#1f4e79")
        axes.set(xlim=(0, calibration.pair.cam0.width), ylim=(calibration.pair.cam0.height, 0), aspect="equal")
        axes.set(title=f"cam{camera}, {camera_rms(result, camera):.4f} px RMS", xlabel="u, px", ylabel="v, px")
    return figure


def camera_rms(result: SessionCalibration, camera: int) -> float:
    """RMS in pixels of one camera's residuals as drawn."""
    return float(np.sqrt(np.nanmean(np.sum(result.calibration.residuals_px[camera] ** 2, axis=-1))))


def _views_figure(result: SessionCalibration) -> Figure:
    figure = Figure(figsize=(11, 3), layout="constrained")
    axes = figure.subplots()
    rms_px = np.sqrt(np.nanmean(np.sum(result.calibration.residuals_px**2, axis=-1), axis=2))
    places = np.arange(len(result.used))
    for camera in (0, 1):
        axes.bar(places + 0.4 * camera - 0.2, rms_px[camera], 0.4, label=f"cam{camera}")
    names = [path.stem for path, _ in result.used]
    axes.set_xticks(places, names, rotation=90, fontsize=7)
    axes.set(ylabel="RMS, px")
    axes.legend()
    return figure


def _board_figure(result: SessionCalibration, board: Board) -> Figure:
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    places_mm = 1000.0 * board.points_m
    errors_mm = 1000.0 * (result.calibration.board_m - board.points_m)
    largest = max(float(np.linalg.norm(errors_mm, axis=1).max()), 1e-6)
    scale = 800.0 * board.square_m / largest
    axes.quiver(*places_mm.T, *(scale * errors_mm).T, angles="xy", scale_units="xy", scale=1.0, width=0.003)
    axes.plot(*places_mm.T, ".", ms=3, color="0.6")
    axes.set(aspect="equal", xlabel="x, mm", ylabel="y, mm", title=f"longest arrow: {1000 * largest:.0f} um")
    axes.invert_yaxis()
    return figure


def _image(figure: Figure) -> str:
    buffer = io.BytesIO()
    with matplotlib.rc_context({"savefig.dpi": 110}):
        figure.savefig(buffer, format="png")
    return f"<img alt='' src='data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}'>"
