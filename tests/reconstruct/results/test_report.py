"""The report: every figure is in it, nothing is fetched from elsewhere, and its words agree with its numbers."""

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from capture.errors import ReconstructError, UsageError
from process.signal_table import sets_of, signal_table, signals_path
from process.signals import Signal, Signals
from reconstruct import figures
from reconstruct.report import COMPARED_PLATES, PLATES, Plate, write_report
from reconstruct.result import read_result
from reconstruct.run import Job, run_comparison, run_job
from reconstruct.summary import verdict


class Page(HTMLParser):
    """What a browser would fetch, and whether all tags are closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.sources: list[str] = []
        self.figures: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.sources += [found[name] or "" for name in ("src", "href", "data", "poster") if name in found]
        if tag == "figure":
            self.figures.append(found["id"] or "")
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


@pytest.fixture(scope="module")
def result(bending_wing: Any, wing_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result of 12 sets a wing, one of them blind, with a signal beside them, compared with its truth."""
    folder = tmp_path_factory.mktemp("report")
    table = bending_wing().marker_table(np.arange(12) * 0.04, sigma_m=0.001, missing=0.05)
    x = np.asarray(table.column("x_m")).copy()
    x[18 * 4 : 18 * 5] = np.nan
    pq.write_table(table.set_column(table.column_names.index("x_m"), "x_m", [x]), folder / "table.parquet")
    sets = sets_of(table)
    time_ns = np.unique(sets.column("timestamp_ns").to_numpy())
    load_factor = Signal("load_factor", "/can", "g", time_ns, np.sin(np.arange(time_ns.size)))
    pq.write_table(signal_table(sets, Signals((load_factor,))), signals_path(folder / "table.parquet"))
    truth = bending_wing().reference(folder / "truth <&>", np.arange(-0.1, 0.6, 0.01))
    out = folder / "out"
    run_job(Job((), None, folder / "table.parquet", wing_file, out, True, 1, "made by a test"), lambda *_: None)
    run_comparison(out, truth, out, "compared by a test")
    return out


def names(*plates: Plate) -> list[str]:
    """The figures of a short flight."""
    return sorted(plate.name for plate in plates if plate.name != "tip-whole")


def test_every_figure_is_embedded_and_nothing_is_external(result: Path) -> None:
    text = (result / "report.html").read_text(encoding="utf-8")
    page = Page(text)
    assert page.open == []
    assert sorted(page.figures) == names(*PLATES, *COMPARED_PLATES)
    assert len(page.sources) == len(page.figures)
    assert all(source.startswith("data:image/png;base64,") for source in page.sources)
    assert not re.search(r"(https?:)?//[a-z]|@import|url\(|<script|<link|<iframe", re.sub(r"base64,[^\"]*", "", text))
    for name in names(*PLATES, *COMPARED_PLATES):
        assert (result / "figures" / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    assert "truth &lt;&amp;&gt;" in text  # names of files are text, not tags


def test_words_and_ledger_tell_what_is_missing(result: Path) -> None:
    text = (result / "report.html").read_text(encoding="utf-8")
    assert "Usable with care." in text
    assert "95.8 % of the sets were fitted" in text
    assert "set: not_fitted" in text
    assert "set not fitted: 0 of 18 markers measured" in text
    assert "marker: not_seen" in text
    assert "Error against the reference" in text


def test_without_a_comparison(result: Path, tmp_path: Path) -> None:
    page = write_report(read_result(result), tmp_path).read_text(encoding="utf-8")
    assert sorted(Page(page).figures) == names(*PLATES)
    assert "reference" not in re.sub(r"base64,[^\"]*|reference axis", "", page)


def test_chosen_instants_are_the_extremes(result: Path) -> None:
    read = read_result(result)
    first = read.sides["right"]
    row = {int(trigger): at for at, trigger in enumerate(first.shape.trigger_index)}
    lift = first.frames["tip_dz_m"]
    chosen = figures.chosen_sets(read)
    assert list(chosen) == ["lowest", "middle", "highest"]
    assert lift[row[chosen["lowest"]["right"]]] == lift.min()
    assert lift[row[chosen["highest"]["right"]]] == lift.max()
    assert all(np.isfinite(read.sides["left"].frames["tip_dz_m"][names["left"]]) for names in chosen.values())


def test_a_long_flight_is_drawn_as_range_and_in_detail(result: Path) -> None:
    short = read_result(result)
    sets = figures.DRAWN_SETS * 2 + 1
    row = np.arange(sets) % 12
    sides = {}
    for name, side in short.sides.items():
        time = short.start_ns + np.arange(sets) * 40_000_000
        shape = replace(side.shape, trigger_index=np.arange(sets), timestamp_ns=time, flags=side.shape.flags[row])
        sides[name] = replace(side, shape=shape, frames={key: value[row] for key, value in side.frames.items()})
    long = replace(short, sides=sides)
    assert figures.is_long(long)
    assert not figures.is_long(short)
    detail, whole = figures.tip(long).axes[0], figures.tip_whole(long).axes[0]
    shown = np.asarray(detail.lines[0].get_xdata())
    highest = np.nanargmax(sides["right"].frames["tip_dz_m"]) * 0.04
    assert np.ptp(shown) <= figures.DETAIL_S
    assert shown.min() <= highest <= shown.max()
    assert len(np.asarray(whole.lines[0].get_xdata())) <= figures.DRAWN_SETS
    assert np.nanmax(np.asarray(whole.lines[0].get_xdata())) > 40.0


@pytest.mark.slow
def test_one_wing_and_one_set_are_enough(bending_wing: Any, wing_file: Path, tmp_path: Path) -> None:
    table = bending_wing().marker_table(np.array([0.0]), sigma_m=0.001)
    pq.write_table(table.filter(np.asarray(table.column("side")) == "right"), tmp_path / "right.parquet")
    job = Job((), None, tmp_path / "right.parquet", wing_file, tmp_path / "out", False, 1, "")
    summary, _ = run_job(job, lambda *_: None)
    assert summary["sides"] == ["right"]
    assert not list((tmp_path / "out").glob("*.csv"))
    assert "Set" not in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")[:200]


def test_nothing_fitted_is_an_error_that_says_why(bending_wing: Any, wing_file: Path, tmp_path: Path) -> None:
    table = bending_wing().marker_table(np.arange(4) * 0.04)
    few = np.asarray(table.column("marker")) < 2
    pq.write_table(table.filter(few), tmp_path / "few.parquet")
    with pytest.raises(ReconstructError, match=r"no set could be fitted \(2 of 18 markers measured"):
        run_job(Job((), None, tmp_path / "few.parquet", wing_file, tmp_path / "out", True, 1, ""), lambda *_: None)
    assert (tmp_path / "out" / "frames.csv").is_file()
    with pytest.raises(ReconstructError, match="nothing to report"):
        write_report(read_result(tmp_path / "out"), tmp_path / "out")


@pytest.mark.slow
def test_a_new_run_removes_the_old_comparison(bending_wing: Any, wing_file: Path, tmp_path: Path) -> None:
    pq.write_table(bending_wing().marker_table(np.arange(3) * 0.04), tmp_path / "table.parquet")
    (tmp_path / "out").mkdir()
    for old in ("comparison.json", "shape.csv", "figures/error-in-time.png"):
        (tmp_path / "out" / old).parent.mkdir(exist_ok=True)
        (tmp_path / "out" / old).write_text("{}")
    run_job(Job((), None, tmp_path / "table.parquet", wing_file, tmp_path / "out", False, 1, ""), lambda *_: None)
    for old in ("comparison.json", "shape.csv", "figures/error-in-time.png"):
        assert not (tmp_path / "out" / old).exists()


def test_a_folder_without_a_result(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"summary\.json"):
        read_result(tmp_path)


@pytest.mark.parametrize(
    ("changed", "word", "reason"),
    [
        ({}, "Good.", "agree with the stated noise"),
        ({"converged_percent": 80.0}, "Poor.", "80.0 % of the sets"),
        ({"markers_seen_percent": 85.0}, "Usable with care.", "Only some of the markers"),
        ({"markers_left_out_percent": 3.0}, "Usable with care.", "left out"),
        ({"chi2_per_dof": 16.0}, "Usable with care.", "4.0 times what the stated noise explains"),
        ({"chi2_per_dof": 0.04}, "Usable with care.", "0.20 times the stated noise"),
        ({"triggers_missing": 7}, "Good.", "7 triggers"),
    ],
)
def test_verdict(changed: dict[str, float], word: str, reason: str) -> None:
    good = {
        "markers_seen_percent": 100.0,
        "converged_percent": 100.0,
        "markers_left_out_percent": 0.0,
        "chi2_per_dof": 1.0,
        "triggers_missing": 0,
    }
    lines = verdict({**good, **changed})
    assert lines[0] == word
    assert reason in " ".join(lines)
