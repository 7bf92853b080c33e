"""A calibration to a page a person can judge it by: residuals, coverage, uncertainty, held-out views, the next view."""

import base64
import html
import io
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from capture.errors import ProcessError
from process import calibration_figures as figures
from process.board import Board
from process.calibration_quality import Quality
from process.calibration_session import SessionCalibration

_STYLE = """body{font:15px/1.45 system-ui,sans-serif;max-width:62rem;margin:2rem auto;padding:0 1rem;color:#222}
table{border-collapse:collapse}td,th{padding:.2rem .8rem;text-align:right;border-bottom:1px solid #ddd}
td:first-child,th:first-child{text-align:left}img{max-width:100%}code{background:#f3f3f3}"""


def write_report(
    path: Path, result: SessionCalibration, quality: Quality, board: Board, summary: dict[str, Any], command: str
) -> None:
    """Write the HTML page, which needs nothing beside it, and its figures as PNG files into ``<name>_figures``.

    ProcessError if they cannot be written.
    """
    folder = path.with_name(f"{path.stem}_figures")
    warnings = summary["calibration"]["warnings"]
    try:
        folder.mkdir(exist_ok=True)
        parts = [
            "<!doctype html><meta charset='utf-8'><title>Stereo calibration</title>",
            f"<style>{_STYLE}</style><h1>Stereo calibration</h1><p><code>{html.escape(command)}</code></p>",
            _figures_table(summary),
            "".join(f"<p><b>Warning:</b> {html.escape(text)}</p>" for text in warnings),
            _next_view(quality),
        ]
        for name, title, caption, figure in _plates(result, quality, board):
            png = _png(figure)
            (folder / f"{name}.png").write_bytes(png)
            image = f"<img alt='{name}' src='data:image/png;base64,{base64.b64encode(png).decode()}'>"
            parts.append(f"<h2>{html.escape(title)}</h2><p>{html.escape(caption)}</p>{image}")
        parts.append(_left_out(summary))
        path.write_text("\n".join(parts) + "\n", encoding="utf-8")
    except OSError as error:
        raise ProcessError(f"{error.filename or path}: cannot be written ({error.strerror})") from error


def _plates(result: SessionCalibration, quality: Quality, board: Board) -> list[tuple[str, str, str, Figure]]:
    """Name, title, caption and figure of each section."""
    images = [f"cam{camera}: {', '.join(image.empty) or 'none'}" for camera, image in enumerate(quality.images)]
    plates = [
        (
            "residuals",
            "Residuals over the images",
            "Each arrow is a corner's residual (projected minus measured). A view that swings as a whole was not taken "
            "at the same instant by both cameras.",
            figures.residuals(result),
        ),
        (
            "pattern",
            "Mean residual by place",
            "Noise averages out, what the lens model lacks does not: a pattern as large as the noise means that the "
            "lens model is too simple, the board is not flat, or the corners are biased.",
            figures.pattern(result, quality),
        ),
        (
            "coverage",
            "Where the board was",
            "Crosses are parts of the image without a corner, where the lens is extrapolated; grey dots what the other "
            f"camera does not see. Empty parts: {'; '.join(images)}.",
            figures.coverage(result, quality),
        ),
    ]
    if quality.uncertainty:
        plates += [
            (
                "uncertainty-image",
                "Uncertainty over the image",
                "One sigma of a point (length of the three axes' sigmas) from the calibration alone, by its place in "
                "cam0's image: a bias that all frames share.",
                figures.uncertainty_over_image(result, quality),
            ),
            (
                "uncertainty-range",
                "Uncertainty over range",
                "The same by distance, over all that both cameras see.",
                figures.uncertainty_over_range(result),
            ),
        ]
    plates.append(
        (
            "views",
            "Views",
            "Bars: residual in the fit. Diamonds: the view predicted by a calibration without it. A diamond far above "
            "its bars means that the calibration bends to this view: it is wrong, or the only one of its kind.",
            figures.views(result, quality),
        )
    )
    if result.calibration.freedom.board:
        caption = "The corners off their nominal places, as estimated."
        plates.append(("print", "The board as printed", caption, figures.board_print(result, board)))
    if result.calibration.freedom.bow_prior_px_per_m:
        caption = "The board's bow, as estimated."
        plates.append(("flatness", "The board's flatness", caption, figures.board_height(result, board)))
    return plates


def _next_view(quality: Quality) -> str:
    advice = quality.next_view
    if advice is None:
        return ""
    return (
        f"<p><b>To improve it most, add a view:</b> {html.escape(advice.text)}. The worst place's sigma goes from "
        f"{advice.worst_sigma_mm:.2f} to {advice.then_worst_sigma_mm:.2f} mm.</p>"
    )


def _left_out(summary: dict[str, Any]) -> str:
    rows = "".join(
        f"<tr><td>{html.escape(view['cam0'])}</td><td>{html.escape(view['cam1'])}</td>"
        f"<td>{html.escape(view['reason'])}</td></tr>"
        for view in summary["views"]
        if not view["used"]
    )
    return f"<h2>Left out</h2><table>{rows}</table>" if rows else ""


def _figures_table(summary: dict[str, Any]) -> str:
    detail, quality = summary["calibration"], summary["quality"]
    rows = [
        ("RMS, cam0 / cam1", " / ".join(f"{camera['rms_px']:.4f}" for camera in summary["cameras"]) + " px"),
        ("RMS, cameras alone on the nominal board", " / ".join(f"{rms:.4f}" for rms in detail["alone_rms_px"]) + " px"),
        ("RMS, stereo", f"{summary['stereo']['rms_px']:.4f} px"),
        ("RMS, stereo in the paper's two stages", f"{detail['two_stage_rms_px']:.4f} px"),
        ("Two stages by the cameras alone (alarm: 1.5)", f"{detail['stereo_to_mono_ratio']:.2f}"),
        ("Baseline", f"{1000 * summary['stereo']['baseline_m']:.3f} mm"),
        ("Noise of a corner's coordinate", f"{detail['sigma_px']:.4f} px"),
        ("Gradient at the end (0: optimum)", f"{detail['gradient']:.1e}"),
    ]
    held_out = quality["cross_validation"]
    if held_out is not None and held_out["rms_px"] is not None:
        board = "" if held_out["board_rms_mm"] is None else f"; the board's shape to {held_out['board_rms_mm']:.3f} mm"
        rows.append((f"RMS of held-out views, {held_out['folds']} folds", f"{held_out['rms_px']:.4f} px{board}"))
        rows.append(("Noise, held out by in the fit (alarm: 1.5)", f"{held_out['noise_ratio']:.2f}"))
    if summary["board"]["flatness_mm"] is not None:
        sigma_mm = summary["board"]["flatness_sigma_mm"]
        rows.append(("Board out of flat, peak to valley", f"{summary['board']['flatness_mm']:.3f} ± {sigma_mm:.3f} mm"))
    for entry in detail["predicted_sigma_mm"]:
        sigma = " / ".join(f"{value:.3f}" for value in entry["sigma_xyz_mm"])
        rows.append((f"Sigma x / y / z at {entry['range_m']:g} m, from the calibration", f"{sigma} mm"))
    return "<table>" + "".join(f"<tr><td>{name}</td><td>{value}</td></tr>" for name, value in rows) + "</table>"


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    with matplotlib.rc_context({"savefig.dpi": 110}):
        figure.savefig(buffer, format="png")
    return buffer.getvalue()
