"""A result → one self-contained HTML page: verdict, figures with captions, tables; nothing is loaded from elsewhere."""

import io
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from capture.errors import ReconstructError
from reconstruct import figures, marker_maps, page, signal_figure, spectrum_figure
from reconstruct.frame_pictures import read_frame_pictures
from reconstruct.page import number, table, text
from reconstruct.result import FIGURES, REPORT, Result
from reconstruct.summary import verdict
from reconstruct.wing_view import wing_view

Tell = Callable[[int, int], None]
"""told how many figures are done, and how many there are"""


@dataclass(frozen=True)
class Plate:
    """A figure of the report; its file is ``figures/<name>.png``."""

    name: str
    section: str
    caption: str
    draw: Callable[[Result], Figure]
    applies: Callable[[Result], bool] = lambda _: True


PLATES = (
    Plate(
        "wing-3d",
        "The wing",
        "Both half wings at the lowest, the middle and the highest position of the tip, to one scale, in metres. Lines "
        "are the fitted reference axis, dots the measured markers, joined fore to aft; the unloaded wing is grey.",
        figures.wing_3d,
    ),
    Plate(
        "tip",
        "The wing",
        "The outermost station in time. Bands are two sigma, as the fit states them. Of a "
        "long flight, this is the part around the highest position.",
        figures.tip,
    ),
    Plate(
        "tip-whole",
        "The wing",
        "The same over the whole flight: mean and range of neighbouring sets.",
        figures.tip_whole,
        figures.is_long,
    ),
    Plate(
        "signals",
        "The wing",
        "The tip beside what was recorded with it, at the same instants: of the signals those that go with the tip's "
        "height most (r, their correlation with it). All are in frames.parquet.",
        signal_figure.signals,
        signal_figure.has_signals,
    ),
    Plate(
        "span",
        "The wing",
        "Displacement and twist along the span at the same three instants; grey bands hold all sets and 90 % of them.",
        figures.span,
    ),
    Plate(
        "loads",
        "The wing",
        "The loads that explain the shape (the paper's eq. 7): air, inertia and weight together, with two-sigma bands "
        "(of a long flight: mean and range). "
        "How they are spread along the span is much less certain than their sum.",
        figures.loads,
    ),
    Plate(
        "spectrum",
        "Spectrum and modes",
        "Power of the tips' motion by frequency (Welch's method), and what stands out of it. In flight this is the "
        "wing with its air and its aircraft, not the wing by itself; slow manoeuvres are at the left end.",
        spectrum_figure.spectra,
        spectrum_figure.has_spectrum,
    ),
    Plate(
        "residuals-in-time",
        "How well the model agrees with the markers",
        "Distance between measured and fitted markers, RMS over the markers of a set, and the same weighed with the "
        "stated covariances.",
        figures.residuals_in_time,
    ),
    Plate(
        "residuals-by-marker",
        "How well the model agrees with the markers",
        "The same, marker by marker. A marker that stands out is mounted, matched or calibrated differently from what "
        "the wing file says.",
        marker_maps.residuals_by_marker,
    ),
    Plate(
        "residuals-map",
        "How well the model agrees with the markers",
        "The same in time: a column that stands out is a moment, a row a marker.",
        marker_maps.residuals_map,
    ),
    Plate(
        "sigmas",
        "How well the model agrees with the markers",
        "One sigma of position (length of the three axes' sigmas) and twist: image noise, the prior on the loads, "
        "and what all frames share (calibration, mount, lights), as far as the marker table states it.",
        figures.sigmas,
    ),
    Plate(
        "markers-seen",
        "What was measured",
        "Share of the sets in which a marker was found in both cameras and triangulated.",
        marker_maps.markers_seen,
    ),
    Plate(
        "markers-map",
        "What was measured",
        "The same in time. White is a marker, or a moment, that the cameras did not see.",
        marker_maps.markers_map,
    ),
)
COMPARED_PLATES = (
    Plate(
        "error-in-time",
        "Error against the reference",
        "Errors set by set, the reference interpolated to each set's instant and station.",
        figures.error_in_time,
    ),
    Plate(
        "error-along-span",
        "Error against the reference",
        "RMS error along the span, and what the fit stated (dashed). Where solid lies above dashed, something other "
        "than image noise is at work: calibration, survey, stiffness.",
        figures.error_along_span,
    ),
    Plate(
        "error-by-marker",
        "Error against the reference",
        "RMS distance of the measured markers from the reference's, each at its own instant.",
        marker_maps.error_by_marker,
    ),
)


def write_report(result: Result, folder: Path, tell: Tell = lambda _done, _all: None) -> Path:
    """Draw all figures into ``folder/figures`` and write ``folder/report.html``; returns its path.

    With ``result.comparison`` it has a section on the errors against the reference. Raises ReconstructError when no
    set was fitted: there is nothing to draw.
    """
    if not any(np.isfinite(side.frames["tip_dz_m"]).any() for side in result.sides.values()):
        raise ReconstructError(f"{result.folder}: no set was fitted, there is nothing to report; see frames.parquet")
    (folder / FIGURES).mkdir(parents=True, exist_ok=True)
    view = wing_view(result)
    sections: dict[str, list[str]] = {"The wing": [view.html], "Error against the reference": []}
    plates = (*COMPARED_PLATES, *PLATES)
    for done, plate in enumerate(plates):
        tell(done, len(plates))
        file = folder / FIGURES / f"{plate.name}.png"
        file.unlink(missing_ok=True)
        if not plate.applies(result) or (plate in COMPARED_PLATES and result.comparison is None):
            continue
        png = _draw(plate, result)
        file.write_bytes(png)
        sections.setdefault(plate.section, []).append(page.picture(plate.name, plate.caption, png))
    if result.comparison is not None:
        sections["Error against the reference"].append(_marker_table(result.comparison))
    if "Spectrum and modes" in sections:
        sections["Spectrum and modes"].append(spectrum_figure.mode_table(result))
    sections["What was measured"] += [_ledger(result), _timing(result)]
    sections["What the cameras saw"] = [_frames(result)]
    body = [_head(result)]
    body += [f"<section><h2>{text(title)}</h2>{''.join(parts)}</section>" for title, parts in sections.items() if parts]
    body.append(_made_from(result))
    tell(len(plates), len(plates))
    path = folder / REPORT
    path.write_text(page.page(_title(result), body, view.script), encoding="utf-8")
    return path


def _draw(plate: Plate, result: Result) -> bytes:
    with mpl.rc_context(figures.STYLE):
        figure = plate.draw(result)
        FigureCanvasAgg(figure)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", metadata={"Title": plate.name})
    return buffer.getvalue()


def _title(result: Result) -> str:
    return f"Wing shape in flight: {result.summary.get('wing', result.folder.name)}"


def _head(result: Result) -> str:
    summary = result.summary
    words = verdict(summary)
    grade = {"Good.": "good", "Poor.": "poor"}.get(words[0], "care")
    when = str(summary["start_utc"])[:19].replace("T", " ")
    amount = f"{summary['duration_s']:.1f} s, {summary['triggers']} triggers, {' and '.join(summary['sides'])} wing"
    sub = f"{when} UTC, {amount}; displacements are from the {result.reference}"
    cards = [
        ("sets fitted", f"{summary['converged_percent']:.1f} %", f"of {summary['sets']}"),
        ("markers measured", f"{summary['markers_seen_percent']:.1f} %", "of all markers in all sets"),
        ("residual", number(summary["residual_rms_mm"], "mm"), "RMS, measured to fitted"),
        ("tip known to", number(summary["sigma_tip_mm"], "mm"), "one sigma, median"),
        ("tip twist known to", number(summary["sigma_tip_twist_deg"], "°"), "one sigma, median"),
    ]
    parts = [
        f"<header><h1>{text(_title(result))}</h1><p class='sub'>{text(sub)}</p></header>",
        f"<p class='verdict {grade}'><strong>{text(words[0])}</strong> {text(' '.join(words[1:]))}</p>",
        page.cards(cards),
    ]
    if result.comparison is not None:
        parts.append(_compared_head(result.comparison))
    columns = ("", *result.summary["sides"])
    rows = [
        (label, *(number(summary["by_side"][side][key], unit) for side in summary["sides"]))
        for label, key, unit in (
            ("sets fitted", "converged_percent", "%"),
            ("markers measured", "markers_seen_percent", "%"),
            ("markers left out as outliers", "markers_left_out_percent", "%"),
            ("residual, RMS", "residual_rms_mm", "mm"),
            ("χ² a degree of freedom", "chi2_per_dof", ""),
            ("sigma of the tip, median", "sigma_tip_mm", "mm"),
            ("sigma of the tip's twist, median", "sigma_tip_twist_deg", "°"),
        )
    ]
    parts.append(table(columns, [*rows, *_stiffness_rows(summary), *_rest_rows(summary)]))
    return "".join(parts)


def _stiffness_rows(summary: Any) -> list[tuple[str, ...]]:
    """How far the stiffness found lies from the wing file's, where loads at stations let it be found."""
    rows = []
    for key in ("GJ", "EI_out", "EI_in"):
        cells = []
        for side in summary["sides"]:
            change = summary["by_side"][side].get("stiffness_change_percent", {}).get(key)
            sigma = summary["by_side"][side].get("sigma_stiffness_percent", {}).get(key)
            cells.append(f"{number(change, '%', sign=True)} ± {number(sigma, '%')}" if change and sigma else "–")
        if any(cell != "–" for cell in cells):
            rows.append((f"{key} found, against the wing file", *cells))
    return rows


def _rest_rows(summary: Any) -> list[tuple[str, ...]]:
    """What the recorded shape at rest says of the wing's stiffness."""
    found = summary.get("at_rest", {})
    if not found:
        return []
    cells = []
    for side in summary["sides"]:
        here = found.get(side)
        sigma = here and number(here["sigma_softer_percent"], "%")
        cells.append(f"{number(here['softer_percent'], '%', sign=True)} ± {sigma}" if here else "–")
    return [("softer at rest, under its weight, than the wing file", *cells)]


def _compared_head(comparison: Any) -> str:
    cards = [
        ("marker error", number(comparison["marker_rms_mm"], "mm"), "3-D, RMS"),
        ("shape error", number(comparison["shape_rms_mm"], "mm"), "3-D, RMS over all stations"),
        ("tip error", number(comparison["tip_error_mm"], "mm"), "3-D, RMS"),
        ("twist error", number(comparison["twist_rms_deg"], "°"), "RMS over all stations"),
        ("within 95 % bounds", number(comparison["shape_within_95_percent"], "%"), "of the position errors"),
    ]
    compared = comparison["frames_compared"]
    outside = comparison["frames_outside_reference"]
    line = f"Compared with {comparison['reference']}: {compared} sets; {outside} outside of the reference's time."
    return f"<p class='sub'>{text(line)}</p>{page.cards(cards)}"


def _marker_table(comparison: Any) -> str:
    rows = [
        (
            one["side"],
            one["marker"],
            one["compared"],
            number(one["rms_mm"], ""),
            *(number(one["bias_mm"][axis], "", sign=True) for axis in "xyz"),
            number(one["spread_mm"], ""),
        )
        for one in comparison["markers"]
    ]
    columns = ("wing", "marker", "compared", "RMS, mm", "bias x", "bias y", "bias z, mm", "spread, mm")
    return f"<details><summary>Error of every marker</summary>{table(columns, rows)}</details>"


def _ledger(result: Result) -> str:
    """What is missing or flagged, and how often."""
    rows: list[Sequence[object]] = []
    missing = result.summary["triggers_missing"]
    rows.append(("triggers without any set", "all", missing, result.summary["triggers"] + missing))
    for name, side in result.sides.items():
        sets = side.trigger_index.size
        absent = result.summary["triggers"] - sets
        rows.append(("triggers without this wing's set", name, absent, result.summary["triggers"]))
        for flag, count in _most(side.health.flags):
            rows.append((f"marker: {flag}", name, count, side.health.rows))
        for kind, words in (("set", "flags"), ("set not fitted", "reason"), ("gate failing", "gates_failing")):
            for word, count in _most(side.words.get(words, {})):
                rows.append((f"{kind}: {word}", name, count, sets))
    shown = [(what, name, count, total, f"{100 * count / total:.2f} %") for what, name, count, total in rows]  # type: ignore[operator]
    return table(("missing or flagged", "wing", "count", "of", "share"), shown)


def _timing(result: Result) -> str:
    """How well the instants are known, and what the recording says of its own losses."""
    rows = []
    for name, side in result.sides.items():
        sigma_us = 1e-3 * side.frames["time_sigma_ns"]
        known = sigma_us[np.isfinite(sigma_us)]
        said = f"{np.median(known):.1f} µs median, {known.max():.1f} µs at worst" if known.size else "not known"
        clock = ", ".join(f"{state} {count}" for state, count in _most(side.words["ptp_state"]))
        steps = np.diff(side.timestamp_ns) * 1e-6
        pace = f"{np.median(steps):.3f} ms apart, at most {steps.max():.3f} ms" if steps.size else "one"
        rows.append((name, side.trigger_index.size, pace, said, clock))
    parts = [table(("wing", "sets", "their instants", "one sigma of an instant", "PTP: sets"), rows)]
    problems = result.summary.get("problems", [])
    parts += [table(("what the recording lacks",), [(line,) for line in problems])] if problems else []
    return "".join(parts)


def _frames(result: Result) -> str:
    pictures = read_frame_pictures(result.folder)
    if pictures is None:
        return (
            "<p>This result was made from a marker table, so that there are no frames to show: they are shown when "
            "<code>reconstruct</code> is given the flight.</p>"
        )
    shown = [
        page.picture(
            Path(one.file).stem, one.caption, (result.folder / FIGURES / one.file).read_bytes(), "jpeg"
        ).replace("<figure ", '<figure tabindex="0" ')
        for one in pictures
    ]
    said = (
        "Parts of frames, brightened: markers in blue by their numbers, in yellow where only this camera saw one, "
        "other lights in white, spots that were turned down in red with the reason. Select one to enlarge it."
    )
    return f"<p class='sub'>{said}</p><div class='frames'>{''.join(shown)}</div>"


def _most(counts: Mapping[str, int]) -> list[tuple[str, int]]:
    return Counter(counts).most_common()


def _made_from(result: Result) -> str:
    timing = result.summary.get("timing_s", {})
    rows = [(f"{name}", f"{seconds:.1f} s") for name, seconds in timing.items()]
    inputs = [(name, digest) for name, digest in result.summary.get("inputs", {}).items()]
    made = text(f"wingshape {result.summary.get('version', '')}: {result.summary.get('command', '')}")
    return (
        f"<section><h2>How it was made</h2><p class='mono'>{made}</p>"
        f"{table(('stage', 'time'), rows)}{table(('input', 'SHA-256'), inputs)}</section>"
    )
