"""The report in a real browser: every figure is there, slider and hand move the wing, nothing is complained of."""

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from needs import needs_module, needs_program
from rendered_flight import true_rig, write_flight

from hw_sim.world import World
from reconstruct.report import PLATES
from reconstruct.run import Job, run_job
from reconstruct.wing import example_path

pytestmark = pytest.mark.slow
ARGUMENTS = ["--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking", "--disable-sync"]
SHOTS = os.environ.get("WINGSHAPE_SCREENSHOTS")  # a folder that the documents' pictures are written to
SECONDS = 4.0


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a flight at a quarter of the size, with film."""
    folder = tmp_path_factory.mktemp("flight")
    world = World.make(5, 4)
    disks = write_flight(world, folder, SECONDS)
    true_rig(world).write(folder / "rig.json")
    out = folder / "out"
    wing = example_path("xhale.toml")
    run_job(Job(flights=disks, rig=folder / "rig.json", wing=wing, out=out, csv=False, also=(), animation=True))
    return out


@pytest.fixture
def page(result: Path) -> Iterator[Any]:
    """The report, open; ``page.complaints`` has what the browser complains of, ``page.fetched`` what it asked for."""
    needs_module("playwright")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=needs_program("chromium"), args=ARGUMENTS)
        page: Any = browser.new_page(viewport={"width": 1100, "height": 1000})
        page.complaints, page.fetched = [], []
        page.on("console", lambda message: page.complaints.append(message.text))
        page.on("pageerror", lambda error: page.complaints.append(str(error)))
        page.on("request", lambda request: page.fetched.append(request.url))
        page.goto((result / "report.html").as_uri())
        page.locator("#wing-canvas[data-frame]").wait_for()
        yield page
        browser.close()


def drawn(page: Any) -> str:
    """The wing as it is on the canvas."""
    page.wait_for_timeout(100)
    return str(page.evaluate("document.getElementById('wing-canvas').toDataURL()"))


def test_every_figure_is_there_and_nothing_is_fetched(page: Any, result: Path) -> None:
    assert page.complaints == []
    assert [url for url in page.fetched if not url.startswith("data:")] == [(result / "report.html").as_uri()]
    figures = page.locator("figure").evaluate_all("all => all.map(one => one.id)")
    assert {"wing-view", *(plate.name for plate in PLATES)} - {"tip-whole", "signals"} <= set(figures)
    frames = [name for name in figures if name.startswith("frame-")]
    assert len({name.rsplit("-", 1)[0] for name in frames}) == 4
    assert 4 <= len(frames) <= 12
    sizes = page.locator("figure img").evaluate_all("all => all.map(one => one.complete && one.naturalWidth)")
    assert min(sizes) > 400
    if SHOTS:
        page.screenshot(path=Path(SHOTS) / "report-page.png", full_page=True)


def test_slider_hand_wheel_and_choices_move_the_wing(page: Any) -> None:
    before = drawn(page)
    frame = page.locator("#wing-canvas").get_attribute("data-frame")
    slider = page.locator("#wing-time")
    count = int(slider.get_attribute("max")) + 1
    assert count == round(SECONDS * 25)
    slider.fill("3" if frame != "3" else "60")
    moved = drawn(page)
    assert moved != before
    assert page.locator("#wing-canvas").get_attribute("data-frame") in ("3", "60")
    page.locator("#wing-exaggeration").select_option("5")
    exaggerated = drawn(page)
    assert exaggerated != moved
    box = page.locator("#wing-canvas").bounding_box()
    page.mouse.move(box["x"] + 400, box["y"] + 150)
    page.mouse.down()
    page.mouse.move(box["x"] + 520, box["y"] + 190, steps=4)
    page.mouse.up()
    turned = drawn(page)
    assert turned != exaggerated
    page.mouse.wheel(0, -400)
    assert drawn(page) != turned
    page.locator("#wing-views button", has_text="behind").click()
    page.locator("#wing-canvas").dblclick()
    page.locator("#wing-exaggeration").select_option("1")
    assert drawn(page) == moved  # back where it was
    assert page.complaints == []


def test_it_plays_and_tells_the_tip(page: Any, result: Path) -> None:
    page.locator("#wing-time").fill("0")
    page.locator("#wing-play").click()
    for _ in range(200):
        if int(page.locator("#wing-time").input_value()) > 10:
            break
        page.wait_for_timeout(100)
    page.locator("#wing-play").click()
    row = int(page.locator("#wing-time").input_value())
    assert row > 10
    page.wait_for_timeout(300)
    assert int(page.locator("#wing-time").input_value()) == row  # it stopped
    frames = pq.read_table(result / "frames.parquet", filters=[("side", "=", "right")])
    cells = page.locator("#wing-readings tr", has_text="right").locator("td").all_inner_texts()
    told_mm = float(cells[1].removesuffix(" mm").replace("−", "-"))
    assert told_mm == pytest.approx(1e3 * frames.column("tip_dz_m")[row].as_py(), abs=0.051)
    assert page.complaints == []
    if SHOTS:
        page.locator("#wing-view").screenshot(path=Path(SHOTS) / "wing-view.png")


def test_the_film_shows_what_was_flown(result: Path) -> None:
    film = cv2.VideoCapture(str(result / "wing.mp4"))
    count, rate_hz = (film.get(key) for key in (cv2.CAP_PROP_FRAME_COUNT, cv2.CAP_PROP_FPS))
    assert count / rate_hz == pytest.approx(SECONDS, rel=0.02)
    pictures = [film.read()[1] for _ in range(int(count))]
    film.release()
    assert all(picture.shape == (720, 1280, 3) for picture in pictures)
    changes = [np.abs(a.astype(int) - b).mean() for a, b in zip(pictures, pictures[5:], strict=False)]
    assert min(changes) > 0.01


def test_time_for_report_and_film_stands_apart(result: Path) -> None:
    summary = json.loads((result / "summary.json").read_text())
    timing = summary["timing_s"]
    assert timing["report"] > 0
    assert timing["animation"] > 0
    assert summary["wall_s"] == pytest.approx(timing["markers"] + timing["fit"] + timing["tables"], abs=1e-6)
    assert summary["times_real_time"] == pytest.approx(summary["flight_s"] / summary["wall_s"])
