"""The page in a real browser, on a real recorder: GO when all is well, NO-GO with the reason within three seconds."""

import os
import shutil
import subprocess
import time
from pathlib import Path

import pytest
from field import Field
from needs import needs_module, needs_program, needs_root

pytestmark = pytest.mark.slow
DEADLINE_S = 3.0
PHONE = {"width": 412, "height": 915}
ARGUMENTS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
SHOTS = os.environ.get("WINGSHAPE_SCREENSHOTS")  # a folder that the documents' pictures are written to


@pytest.fixture
def page(field):
    """An empty page; what the browser complains of is in ``page.complaints``."""
    needs_module("playwright")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=needs_program("chromium"), args=ARGUMENTS)
        page = browser.new_page(viewport=PHONE)
        page.complaints = []
        page.on("console", lambda message: page.complaints.append(message.text))
        page.on("pageerror", lambda error: page.complaints.append(str(error)))
        yield page
        browser.close()


def open_page(field: Field, page, scale: int = 8) -> None:
    """Rig, recorder and monitor, all well, and shown so."""
    field.scale = scale
    field.start_rig()
    field.start_recorder()
    field.start_monitor()
    page.goto(field.address)
    page.locator("header.go").wait_for(timeout=30_000)


def no_go(page, since_s: float, *words: str) -> float:
    """Wait for NO-GO for this reason; seconds since."""
    for word in words:
        page.locator("header.nogo #reasons li", has_text=word).first.wait_for(timeout=10_000)
    took_s = time.monotonic() - since_s
    assert page.title() == "NO-GO"
    assert took_s < DEADLINE_S
    return took_s


def shot(page, name: str) -> None:
    if SHOTS:
        page.screenshot(path=Path(SHOTS) / name)


def test_go_with_a_healthy_rig_then_no_go_for_an_unplugged_camera(field, page):
    open_page(field, page, scale=2 if SHOTS else 4)
    assert page.locator("#word").inner_text() == "✔ GO"
    page.locator("article").nth(3).wait_for()
    assert page.locator("article h2").all_inner_texts() == ["left/cam0", "left/cam1", "right/cam0", "right/cam1"]
    page.locator("article img[src]").nth(3).wait_for()  # live pictures have come
    time.sleep(3.0)
    markers = [int(text.split(",")[0]) for text in page.locator("dd.markers").all_inner_texts()]
    assert min(markers) >= 16  # of 18: at this size two may run into each other
    rates = [float(text.split()[0]) for text in page.locator("dd.rate").all_inner_texts()]
    assert rates == pytest.approx([25.0] * 4, abs=2.0)
    sizes = page.locator("article img").evaluate_all("images => images.map(image => image.naturalWidth)")
    assert all(size > 200 for size in sizes)
    assert page.locator("#start").is_disabled()
    assert page.complaints == []
    shot(page, "monitor-go.png")
    index = page.locator("article img").first.get_attribute("data-index")
    page.locator(f"article:first-child img:not([data-index='{index}'])").wait_for(timeout=5_000)  # and go on
    since_s = time.monotonic()
    field.hand("unplug", "left_cam1")
    no_go(page, since_s, "left/cam1")
    page.locator("article.bad h2", has_text="left/cam1").wait_for()
    page.locator(".old", has_text="s old").wait_for(timeout=10_000)
    assert page.locator("article.bad").count() == 1
    shot(page, "monitor-nogo.png")


def test_no_go_when_the_recorder_dies_and_when_the_monitor_does(field, page):
    open_page(field, page)
    since_s = time.monotonic()
    field.processes["recorder"].kill()
    no_go(page, since_s, "silent")
    field.processes["recorder"].wait()
    since_s = time.monotonic()
    field.processes["monitor"].kill()
    no_go(page, since_s, "not heard for")


def test_no_go_when_a_disk_is_full(field, page, tmp_path):
    needs_root()
    disk = tmp_path / "ssd_left"
    disk.mkdir()
    subprocess.run([needs_program("mount"), "-t", "tmpfs", "-o", "size=2g", "tmpfs", disk], check=True)
    try:
        open_page(field, page)
        since_s = time.monotonic()
        room_mb = shutil.disk_usage(disk).used // 2**20 + 4
        subprocess.run(["mount", "-o", f"remount,size={room_mb}m", disk], check=True)
        no_go(page, since_s, "disk left")
        field.end("recorder")
    finally:
        subprocess.run(["umount", "--lazy", disk], check=True)


def test_no_go_when_the_master_clock_is_lost(field, page, tmp_path):
    needs_root()
    from ptp_pair import PtpPair

    (tmp_path / "ptp").mkdir()
    with PtpPair(tmp_path / "ptp") as pair:
        pair.start_master()
        pair.start_slave()
        pair.wait_for_slave()
        pair.vouch_for_utc()
        time.sleep(1.0)  # until the slave has heard of it
        field.extra = f'[ptp]\nsocket = "{pair.slave_socket}"\noffset_limit_us = 1000'
        open_page(field, page)
        assert page.locator("#ptp").inner_text().split()[1] in ("ns", "µs")
        since_s = time.monotonic()
        pair.kill("master")
        no_go(page, since_s, "ptp")


def test_start_and_stop_ask_first(field, page):
    field.extra = '[start]\non = "command"'
    field.start_rig()
    field.start_recorder()
    field.start_monitor("--control")
    page.goto(field.address)
    page.locator("header.nogo #reasons li", has_text="idle").wait_for(timeout=30_000)
    assert page.locator("#stop").is_disabled()
    page.locator("#start").click()
    page.locator("#question", has_text="Start recording?").wait_for()
    page.locator("#yes").click()
    page.locator("header.go").wait_for(timeout=30_000)
    page.locator("#stop").click()
    page.locator("#question", has_text="Stop recording test_07?").wait_for()
    page.keyboard.press("Enter")  # No is what a slip of the finger gets
    page.locator("#confirm").wait_for(state="hidden")
    time.sleep(1.5)
    assert field.status()["health"]["state"] == "recording"
    page.locator("#stop").click()
    page.locator("#yes").click()
    page.locator("header.nogo #reasons li", has_text="idle").wait_for(timeout=30_000)
    assert "stopping" in page.locator("#control-note").inner_text()
    result = field.recorded()
    assert result["failures"] == []
    assert result["frames_recorded"] + result["frames_lost"] == 4 * result["triggers"]
    assert page.complaints == []


def test_a_browser_is_asked_for_the_token_and_then_shows_the_page(field, tmp_path):
    needs_module("playwright")
    from playwright.sync_api import Error, sync_playwright

    token = tmp_path / "token"
    token.write_text("0123456789abcdef0123456789abcdef\n")
    token.chmod(0o600)
    field.start_monitor("--token-file", token)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=needs_program("chromium"), args=ARGUMENTS)
        refused = browser.new_context().new_page()
        with pytest.raises(Error, match="ERR_INVALID_AUTH_CREDENTIALS"):  # the answer to an empty password
            refused.goto(field.address)
        login = {"username": "crew", "password": token.read_text().strip()}
        context = browser.new_context(http_credentials=login)
        page = context.new_page()
        page.goto(field.address)
        page.locator("header.nogo #reasons li", has_text="no recorder").wait_for(timeout=10_000)
        assert context.cookies() == []
        browser.close()
