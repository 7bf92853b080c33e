"""The report: every figure is in it, nothing is fetched from elsewhere, and its words agree with its numbers."""

import base64
import hashlib
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from PIL import Image

from capture.errors import ReconstructError, UsageError
from process.signal_table import sets_of, signal_table, signals_path
from process.signals import Signal, Signals
from reconstruct import figures
from reconstruct.animation import write_animation
from reconstruct.page import asset
from reconstruct.report import COMPARED_PLATES, PLATES, Plate, write_report
from reconstruct.result import read_result
from reconstruct.run import Job, run_comparison, run_job
from reconstruct.shown import DETAIL_S, FRAMES_SHOWN, Heights, choose, highest_ns
from reconstruct.summary import verdict

START_NS = 1_700_000_000_000_000_000


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
        if tag not in ("meta", "img", "input"):
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
    run_job(
        Job(markers=folder / "table.parquet", wing=wing_file, out=out, workers=1, command="made by a test"),
        lambda *_: None,
    )
    run_comparison(out, truth, out, "compared by a test")
    return out


def names(*plates: Plate) -> list[str]:
    """The figures of a short flight, and the view."""
    return sorted(["wing-view", *(plate.name for plate in plates if plate.name not in ("tip-whole", "spectrum"))])


def without_data(text: str) -> str:
    """The page without what is encoded, and without its program."""
    return re.sub(r"base64,[^\"]*|<script.*?</script>", "", text, flags=re.DOTALL)


def test_every_figure_is_embedded_and_nothing_is_external(result: Path) -> None:
    text = (result / "report.html").read_text(encoding="utf-8")
    page = Page(text)
    assert page.open == []
    assert sorted(page.figures) == names(*PLATES, *COMPARED_PLATES)
    assert len(page.sources) == len(page.figures) - 1
    assert all(source.startswith("data:image/png;base64,") for source in page.sources)
    assert not re.search(r"(https?:)?//[a-z]|@import|url\(|<link|<iframe", without_data(text))
    assert not re.search(r"https?:|import|fetch|XMLHttpRequest|eval", asset("wing_view.js"))
    for name in names(*PLATES, *COMPARED_PLATES):
        assert name == "wing-view" or (result / "figures" / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    assert "truth &lt;&amp;&gt;" in text  # names of files are text, not tags


def test_the_policy_names_style_and_program_and_nothing_else(result: Path) -> None:
    text = (result / "report.html").read_text(encoding="utf-8")
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)
    assert policy
    for kind, tag in (("style-src", "style"), ("script-src", "script")):
        content = re.search(rf"<{tag}>(.*?)</{tag}>", text, flags=re.DOTALL)
        assert content
        digest = base64.b64encode(hashlib.sha256(content[1].encode()).digest()).decode()
        assert f"{kind} 'sha256-{digest}'" in policy[1]
    assert "default-src 'none'" in policy[1]
    assert "unsafe" not in policy[1]
    assert " style=" not in without_data(text)


def test_the_view_holds_the_result(result: Path) -> None:
    """Decoded by hand: the strip's middle follows the fitted axis, markers are where they were measured."""
    text = (result / "report.html").read_text(encoding="utf-8")
    found = re.search(r'id="wing-data">(.*?)</script>', text, flags=re.DOTALL)
    assert found
    data = json.loads(found[1])
    (track,) = data["tracks"]
    shape, markers = pq.read_table(result / "shape.parquet"), pq.read_table(result / "markers.parquet")
    for side in ("left", "right"):
        own = track["sides"][side]
        edges = whole(own["edges"]).reshape(12, -1, 2, 3) * data["step_m"]
        mine = shape.filter(np.asarray(shape.column("side")) == side)
        axis = np.stack([mine.column(f"{x}_m").to_numpy() for x in "xyz"], axis=-1).reshape(12, -1, 3)
        width = np.linalg.norm(edges[:, :, 0] - edges[:, :, 1], axis=-1)
        fitted = np.isfinite(axis[:, 0, 0])
        assert np.array_equal(np.isfinite(edges[:, 0, 0, 0]), fitted)
        assert width[fitted] == pytest.approx(0.14, abs=0.002)  # CHORD_M of the wing, from markers of 1 mm noise
        fore = edges[:, :, 0] + (edges[:, :, 1] - edges[:, :, 0]) * 0.04 / 0.14
        assert np.abs(fore - axis)[fitted].max() < 0.002
        seen = markers.filter(np.asarray(markers.column("side")) == side)
        xyz = np.stack([seen.column(f"{x}_m").to_numpy() for x in "xyz"], axis=-1).reshape(12, 18, 3)
        xyz[np.isnan(xyz).any(axis=-1)] = np.nan
        drawn = whole(own["markers"]).reshape(12, 18, 3) * data["step_m"]
        np.testing.assert_allclose(drawn, xyz, atol=data["step_m"])
        tip_mm = np.frombuffer(base64.b64decode(own["tip_mm"]), "<f4")
        frames = pq.read_table(result / "frames.parquet", filters=[("side", "=", side)])
        np.testing.assert_allclose(tip_mm, 1e3 * frames.column("tip_dz_m").to_numpy(), rtol=1e-6)
    assert "load_factor" in track["signals"]


def whole(text: str) -> np.ndarray:
    """Numbers of 16 bits, NaN where unknown."""
    numbers = np.frombuffer(base64.b64decode(text), "<i2").astype(float)
    return np.where(numbers == -32768, np.nan, numbers)


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
    assert "reference" not in re.sub("reference axis", "", without_data(page))


def heights(sets: int) -> dict[str, Heights]:
    """The right wing was fitted in all but the first set and oscillates at 1 Hz; the left one lacks every tenth set."""
    trigger = np.arange(100, 100 + sets)
    time_ns = START_NS + np.arange(sets) * 40_000_000
    dz = np.sin(2 * np.pi * np.arange(sets) * 0.04) * np.linspace(0.5, 1.0, sets)
    dz[0] = np.nan
    kept = np.arange(sets) % 10 != 3
    return {"left": Heights(trigger[kept], time_ns[kept], -dz[kept]), "right": Heights(trigger, time_ns, dz)}


def test_instants_shown_are_the_extremes() -> None:
    sides = heights(100)
    dz = sides["right"].tip_dz_m
    found = choose(sides)
    assert list(found.instants) == ["lowest", "middle", "highest"]
    assert dz[found.instants["lowest"]["right"] - 100] == np.nanmin(dz)
    assert dz[found.instants["highest"]["right"] - 100] == np.nanmax(dz)
    for chosen in found.instants.values():
        assert chosen["left"] in sides["left"].trigger_index
        assert abs(chosen["left"] - chosen["right"]) <= 1
    assert len(found.tracks) == 1
    np.testing.assert_array_equal(found.tracks[0].trigger_index, sides["right"].trigger_index)


@pytest.mark.parametrize("sets", [501, 1000, 30_000, 100_001])
def test_what_is_shown_of_a_long_flight_is_bounded(sets: int) -> None:
    sides = heights(sets)
    whole_flight, detail = choose(sides).tracks if sets > 501 else (*choose(sides).tracks, None)
    assert whole_flight.trigger_index.size <= FRAMES_SHOWN
    assert whole_flight.timestamp_ns[0] == START_NS
    if detail is None:  # just 20 s
        return
    assert detail.trigger_index.size == 501
    assert np.ptp(detail.timestamp_ns) == 20_000_000_000
    assert highest_ns(sides) in detail.timestamp_ns
    phase = (whole_flight.trigger_index - 100) % 25  # of the motion, which is periodic
    assert np.bincount(phase, minlength=25).min() > 0.5 * whole_flight.trigger_index.size / 25
    assert np.diff(whole_flight.trigger_index).max() <= 2 * np.ceil(sets / FRAMES_SHOWN)
    assert choose(sides).triggers("left").size <= 2 * FRAMES_SHOWN + 3


def test_a_long_flight_is_drawn_as_range_and_in_detail(result: Path) -> None:
    short = read_result(result)
    sets = figures.DRAWN_SETS * 2 + 1
    row = np.arange(sets) % 12
    sides = {}
    for name, side in short.sides.items():
        time = short.start_ns + np.arange(sets) * 40_000_000
        frames = {key: value[row] for key, value in side.frames.items()}
        sides[name] = replace(side, trigger_index=np.arange(sets), timestamp_ns=time, frames=frames)
    long = replace(short, sides=sides)
    assert figures.is_long(long)
    assert not figures.is_long(short)
    detail, all_of_it = figures.tip(long).axes[0], figures.tip_whole(long).axes[0]
    shown = np.asarray(detail.lines[0].get_xdata())
    highest = np.nanargmax(sides["right"].frames["tip_dz_m"]) * 0.04
    assert np.ptp(shown) <= DETAIL_S
    assert shown.min() <= highest <= shown.max()
    assert len(np.asarray(all_of_it.lines[0].get_xdata())) <= figures.DRAWN_SETS
    assert np.nanmax(np.asarray(all_of_it.lines[0].get_xdata())) > 40.0


def test_sums_over_the_flight_are_those_of_the_tables(result: Path) -> None:
    """By pandas, from the whole tables at once."""
    markers, residuals, shape, errors = (
        pq.read_table(result / f"{name}.parquet").to_pandas()
        for name in ("markers", "residuals", "shape", "shape_errors")
    )
    found = read_result(result, result / "comparison.json")
    for name, side in found.sides.items():
        mine = markers[markers.side == name]
        np.testing.assert_allclose(side.health.seen_percent, 100 * mine.x_m.notna().groupby(mine.marker).mean())
        assert side.health.flags.get("not_seen", 0) == (mine["flags"] == "not_seen").sum()
        assert np.nansum(side.health.seen_in_time_percent) > 0
        own = residuals[(residuals.side == name) & residuals.used]
        square = own.residual_x_m**2 + own.residual_y_m**2 + own.residual_z_m**2
        np.testing.assert_allclose(side.residuals.rms_m, np.sqrt(square.groupby(own.marker).mean()))
        wing = shape[shape.side == name]
        np.testing.assert_array_equal(side.z_range_m[1], wing.groupby("station").z_m.max())
        np.testing.assert_array_equal(side.twist_range_deg[0], wing.groupby("station").twist_deg.min())
        error = errors[errors.side == name]
        square = error.error_x_m**2 + error.error_y_m**2 + error.error_z_m**2
        np.testing.assert_allclose(found.errors[name].along_rms_m, np.sqrt(square.groupby(error.station).mean()))
        np.testing.assert_allclose(found.errors[name].shape_rms_m, np.sqrt(square.groupby(error.trigger_index).mean()))


def test_a_film_is_a_gif_where_no_mp4_can_be_written(
    result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("reconstruct.animation._write_mp4", lambda *_: False)
    told: list[tuple[int, int]] = []
    path = write_animation(read_result(result), tmp_path, lambda *how_far: told.append(how_far))
    assert [one.name for one in tmp_path.iterdir()] == ["wing.gif"]
    with Image.open(path) as film:
        assert film.size == (640, 360)
        assert film.n_frames >= 10  # of 12; those that look the same are one
        assert film.info["duration"] == 40
    assert told == [(done + 1, 12) for done in range(12)]


@pytest.mark.slow
def test_one_wing_and_one_set_are_enough(bending_wing: Any, wing_file: Path, tmp_path: Path) -> None:
    table = bending_wing().marker_table(np.array([0.0]), sigma_m=0.001)
    pq.write_table(table.filter(np.asarray(table.column("side")) == "right"), tmp_path / "right.parquet")
    job = Job(
        markers=tmp_path / "right.parquet", wing=wing_file, out=tmp_path / "out", workers=1, command="", csv=False
    )
    summary, _ = run_job(job, lambda *_: None)
    assert summary["sides"] == ["right"]
    assert not list((tmp_path / "out").glob("*.csv"))
    assert "Set" not in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")[:200]


def test_nothing_fitted_is_an_error_that_says_why(bending_wing: Any, wing_file: Path, tmp_path: Path) -> None:
    table = bending_wing().marker_table(np.arange(4) * 0.04)
    few = np.asarray(table.column("marker")) < 2
    pq.write_table(table.filter(few), tmp_path / "few.parquet")
    with pytest.raises(ReconstructError, match=r"no set could be fitted \(2 of 18 markers measured"):
        run_job(
            Job(markers=tmp_path / "few.parquet", wing=wing_file, out=tmp_path / "out", workers=1, command=""),
            lambda *_: None,
        )
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
    run_job(
        Job(markers=tmp_path / "table.parquet", wing=wing_file, out=tmp_path / "out", workers=1, command="", csv=False),
        lambda *_: None,
    )
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
