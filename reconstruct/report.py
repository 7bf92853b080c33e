"""A result → one self-contained HTML page: verdict, figures with captions, tables; nothing is loaded from elsewhere."""

import base64
import html
import io
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from capture.errors import ReconstructError
from reconstruct import figures, signal_figure
from reconstruct.result import FIGURES, REPORT, Result
from reconstruct.summary import verdict


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
        "The loads that explain the shape (the paper's eq. 7): air, inertia and weight together, with two-sigma bands. "
        "How they are spread along the span is much less certain than their sum.",
        figures.loads,
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
        figures.residuals_by_marker,
    ),
    Plate(
        "sigmas",
        "How well the model agrees with the markers",
        "One sigma of position (length of the three axes' sigmas) and twist, from image noise and the prior on the "
        "loads. Errors of calibration and survey are not in it.",
        figures.sigmas,
    ),
    Plate(
        "markers-seen",
        "What was measured",
        "Share of the sets in which a marker was found in both cameras and triangulated.",
        figures.markers_seen,
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
        figures.error_by_marker,
    ),
)


def write_report(result: Result, folder: Path) -> Path:
    """Draw all figures into ``folder/figures`` and write ``folder/report.html``; returns its path.

    With ``result.comparison`` it has a section on the errors against the reference. Raises ReconstructError when no
    set was fitted: there is nothing to draw.
    """
    if not any(np.isfinite(side.frames["tip_dz_m"]).any() for side in result.sides.values()):
        raise ReconstructError(f"{result.folder}: no set was fitted, there is nothing to report; see frames.parquet")
    (folder / FIGURES).mkdir(parents=True, exist_ok=True)
    sections: dict[str, list[str]] = {}
    for plate in (*COMPARED_PLATES, *PLATES):
        file = folder / FIGURES / f"{plate.name}.png"
        file.unlink(missing_ok=True)
        if not plate.applies(result) or (plate in COMPARED_PLATES and result.comparison is None):
            continue
        png = _draw(plate, result)
        file.write_bytes(png)
        sections.setdefault(plate.section, []).append(_figure(plate, png))
    if result.comparison is not None:
        sections["Error against the reference"].append(_marker_table(result.comparison))
    sections["What was measured"].append(_ledger(result))
    body = [_head(result)]
    body += [f"<section><h2>{_text(title)}</h2>{''.join(parts)}</section>" for title, parts in sections.items()]
    body.append(_made_from(result))
    path = folder / REPORT
    path.write_text(_PAGE.format(title=_text(_title(result)), style=_STYLE, body="\n".join(body)), encoding="utf-8")
    return path


def _draw(plate: Plate, result: Result) -> bytes:
    with mpl.rc_context(figures.STYLE):
        figure = plate.draw(result)
        FigureCanvasAgg(figure)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", metadata={"Title": plate.name})
    return buffer.getvalue()


def _figure(plate: Plate, png: bytes) -> str:
    data = base64.b64encode(png).decode("ascii")
    alt = _text(plate.name.replace("-", " "))
    return (
        f'<figure id="{plate.name}"><img alt="{alt}" src="data:image/png;base64,{data}">'
        f"<figcaption>{_text(plate.caption)}</figcaption></figure>"
    )


def _title(result: Result) -> str:
    return f"Wing shape in flight: {result.summary.get('wing', result.folder.name)}"


def _head(result: Result) -> str:
    summary = result.summary
    words = verdict(summary)
    grade = {"Good.": "good", "Poor.": "poor"}.get(words[0], "care")
    when = str(summary["start_utc"])[:19].replace("T", " ")
    amount = f"{summary['duration_s']:.1f} s, {summary['triggers']} triggers, {_and(summary['sides'])} wing"
    sub = f"{when} UTC, {amount}; displacements are from the {result.reference}"
    cards = [
        ("sets fitted", f"{summary['converged_percent']:.1f} %", f"of {summary['sets']}"),
        ("markers measured", f"{summary['markers_seen_percent']:.1f} %", "of all markers in all sets"),
        ("residual", _number(summary["residual_rms_mm"], "mm"), "RMS, measured to fitted"),
        ("tip known to", _number(summary["sigma_tip_mm"], "mm"), "one sigma, median"),
        ("tip twist known to", _number(summary["sigma_tip_twist_deg"], "°"), "one sigma, median"),
    ]
    parts = [
        f"<header><h1>{_text(_title(result))}</h1><p class='sub'>{_text(sub)}</p></header>",
        f"<p class='verdict {grade}'><strong>{_text(words[0])}</strong> {_text(' '.join(words[1:]))}</p>",
        _cards(cards),
    ]
    if result.comparison is not None:
        parts.append(_compared_head(result.comparison))
    columns = ("", *result.summary["sides"])
    rows = [
        (label, *(_number(summary["by_side"][side][key], unit) for side in summary["sides"]))
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
    parts.append(_table(columns, [*rows, *_stiffness_rows(summary), *_rest_rows(summary)]))
    return "".join(parts)


def _stiffness_rows(summary: Any) -> list[tuple[str, ...]]:
    """How far the stiffness found lies from the wing file's, where loads at stations let it be found."""
    rows = []
    for key in ("GJ", "EI_out", "EI_in"):
        cells = []
        for side in summary["sides"]:
            change = summary["by_side"][side].get("stiffness_change_percent", {}).get(key)
            sigma = summary["by_side"][side].get("sigma_stiffness_percent", {}).get(key)
            cells.append(f"{_number(change, '%', sign=True)} ± {_number(sigma, '%')}" if change and sigma else "–")
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
        sigma = here and _number(here["sigma_softer_percent"], "%")
        cells.append(f"{_number(here['softer_percent'], '%', sign=True)} ± {sigma}" if here else "–")
    return [("softer at rest, under its weight, than the wing file", *cells)]


def _compared_head(comparison: Any) -> str:
    cards = [
        ("marker error", _number(comparison["marker_rms_mm"], "mm"), "3-D, RMS"),
        ("shape error", _number(comparison["shape_rms_mm"], "mm"), "3-D, RMS over all stations"),
        ("tip error", _number(comparison["tip_error_mm"], "mm"), "3-D, RMS"),
        ("twist error", _number(comparison["twist_rms_deg"], "°"), "RMS over all stations"),
        ("within 95 % bounds", _number(comparison["shape_within_95_percent"], "%"), "of the position errors"),
    ]
    compared = comparison["frames_compared"]
    outside = comparison["frames_outside_reference"]
    text = f"Compared with {comparison['reference']}: {compared} sets; {outside} outside of the reference's time."
    return f"<p class='sub'>{_text(text)}</p>{_cards(cards)}"


def _marker_table(comparison: Any) -> str:
    rows = [
        (
            one["side"],
            one["marker"],
            one["compared"],
            _number(one["rms_mm"], ""),
            *(_number(one["bias_mm"][axis], "", sign=True) for axis in "xyz"),
            _number(one["spread_mm"], ""),
        )
        for one in comparison["markers"]
    ]
    columns = ("wing", "marker", "compared", "RMS, mm", "bias x", "bias y", "bias z, mm", "spread, mm")
    return f"<details><summary>Error of every marker</summary>{_table(columns, rows)}</details>"


def _ledger(result: Result) -> str:
    """What is missing or flagged, and how often."""
    rows: list[Sequence[object]] = []
    missing = result.summary["triggers_missing"]
    rows.append(("triggers without any set", "all", missing, result.summary["triggers"] + missing))
    for name, side in result.sides.items():
        absent = result.summary["triggers"] - side.shape.trigger_index.size
        rows.append(("triggers without this wing's set", name, absent, result.summary["triggers"]))
        total = side.markers.flags.size
        for flag, count in _counted(side.markers.flags.ravel()):
            rows.append((f"marker: {flag}", name, count, total))
        for flag, count in _counted(side.shape.flags):
            rows.append((f"set: {flag}", name, count, side.shape.flags.size))
        for reason, count in Counter(reason for reason in side.reasons if reason).most_common():
            rows.append((f"set not fitted: {reason}", name, count, side.shape.flags.size))
    shown = [(what, name, count, total, f"{100 * count / total:.2f} %") for what, name, count, total in rows]  # type: ignore[operator]
    return _table(("missing or flagged", "wing", "count", "of", "share"), shown)


def _counted(flags: Iterable[str]) -> list[tuple[str, int]]:
    return Counter(flag for joined in flags if joined for flag in joined.split(",")).most_common()


def _made_from(result: Result) -> str:
    timing = result.summary.get("timing_s", {})
    rows = [(f"{name}", f"{seconds:.1f} s") for name, seconds in timing.items()]
    inputs = [(name, digest) for name, digest in result.summary.get("inputs", {}).items()]
    made = _text(f"wingshape {result.summary.get('version', '')}: {result.summary.get('command', '')}")
    return (
        f"<section><h2>How it was made</h2><p class='mono'>{made}</p>"
        f"{_table(('stage', 'time'), rows)}{_table(('input', 'SHA-256'), inputs)}</section>"
    )


def _cards(cards: Sequence[tuple[str, str, str]]) -> str:
    inner = "".join(
        f"<div><span>{_text(label)}</span><b>{_text(value)}</b><small>{_text(note)}</small></div>"
        for label, value, note in cards
    )
    return f"<div class='cards'>{inner}</div>"


def _table(columns: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    if not rows:
        return ""
    head = "".join(f"<th>{_text(column)}</th>" for column in columns)
    body = "".join("<tr>" + "".join(f"<td>{_text(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _number(value: float | None, unit: str, *, sign: bool = False) -> str:
    """Three figures and the unit; a dash for what is not known."""
    if value is None:
        return "–"
    decimals = 1 if abs(value) >= 100 or unit == "%" else 2 if abs(value) >= 0.1 or sign else 3
    space = "" if unit in ("", "°") else " "
    return f"{round(value, decimals) + 0.0:{'+' if sign else ''}.{decimals}f}{space}{unit}"


def _and(words: Sequence[str]) -> str:
    return " and ".join(words)


def _text(value: object) -> str:
    return html.escape(str(value))


_STYLE = """
:root { color-scheme: light; }
body { margin: 0; background: #f6f7f8; color: #23272b;
  font: 16px/1.55 "Iowan Old Style", "Palatino Linotype", Palatino, Georgia, "DejaVu Serif", serif; }
main { max-width: 60rem; margin: 0 auto; padding: 2.5rem 2.5rem 4rem; background: #fff; box-shadow: 0 0 0 1px #e5e7ea; }
h1 { font-size: 1.75rem; line-height: 1.2; margin: 0; font-weight: 600; }
h2 { font-size: 1.2rem; margin: 2.8rem 0 .6rem; padding-top: .9rem; border-top: 1px solid #e0e3e6; font-weight: 600; }
.sub { color: #667079; margin: .3rem 0 0; }
.verdict { margin: 1.6rem 0; padding: .9rem 1.1rem; border-left: 5px solid; background: #f7f8f9; }
.good { border-color: #3d7a4e; } .care { border-color: #c08a1e; } .poor { border-color: #a8362a; }
.cards { display: flex; flex-wrap: wrap; gap: .8rem; margin: 1.2rem 0; }
.cards div { flex: 1 1 9rem; border: 1px solid #e0e3e6; padding: .7rem .9rem; }
.cards span, .cards small, table, figcaption, summary, .mono {
  font-family: "Helvetica Neue", Arial, "DejaVu Sans", sans-serif; }
.cards span { display: block; font-size: .78rem; color: #667079; }
.cards b { display: block; font-size: 1.45rem; font-weight: 600; font-variant-numeric: tabular-nums; }
.cards small { font-size: .74rem; color: #8a939b; }
figure { margin: 1.4rem 0 2rem; } img { width: 100%; height: auto; display: block; }
figcaption { font-size: .84rem; color: #56606a; margin-top: .4rem; max-width: 50rem; }
table { border-collapse: collapse; width: 100%; font-size: .84rem; margin: 1rem 0;
  font-variant-numeric: tabular-nums; }
th { text-align: left; font-weight: 600; color: #56606a;
  border-bottom: 1px solid #b9c0c6; padding: .3rem .6rem .3rem 0; }
td { border-bottom: 1px solid #eceef0; padding: .28rem .6rem .28rem 0; overflow-wrap: anywhere; }
summary { cursor: pointer; font-size: .9rem; }
.mono { font-size: .8rem; overflow-wrap: anywhere; }
@media print { body { background: #fff; } main { box-shadow: none; padding: 0; } figure { break-inside: avoid; } }
"""

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{style}</style>
</head>
<body><main>
{body}
</main></body>
</html>
"""
