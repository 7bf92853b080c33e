"""Shared health: what the recorder says of itself is so, whoever reads it, and costs it no frame."""

import dataclasses
import json
import os
import resource
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from capture.clock import SystemClock
from capture.config import load_config
from capture.daemon import Recording, RecordingResult
from capture.disk import SystemDisk
from capture.errors import CaptureError
from capture.health import (
    ERROR,
    HEALTH_FILE,
    OK,
    PREVIEW_HEADER,
    STALE_S,
    WARNING,
    Health,
    Notice,
    default_folder,
    judge,
    preview_path,
    read_health,
    read_preview,
    write_health,
)
from capture.health_writer import HealthWriter
from capture.preview import PreviewWriter
from capture.record import Diagnostic
from capture.recorder import FrameItem
from capture.ring import PAGE, Ring
from capture.segment import SealedFrame
from capture.stop_rule import StopRule
from capture.temperatures import host_temperatures_c

PLACES = ["left/cam0", "left/cam1", "right/cam0", "right/cam1"]
DEADLINE_S = 10.0


class Companion:
    """Says what it is told to."""

    def __init__(self) -> None:
        self.said = [Diagnostic(OK, "ptp", "SLAVE", (("offset_ns", "120"),))]

    def start(self, put: object) -> None: ...

    def statuses(self) -> list[Diagnostic]:
        return self.said

    def account(self) -> dict[str, str]:
        return {}

    def stop(self) -> None: ...


class Flight:
    """A recording in a thread, with its health looked at from outside."""

    def __init__(self, config: Path) -> None:
        self.folder = config.parent / "health"
        self.said: list[str] = []
        self.companion = Companion()
        self.stop = StopRule(threading.Event())
        self.result: RecordingResult | None = None
        self._config = config
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        loaded, clock = load_config(self._config), SystemClock()
        with HealthWriter(loaded.config, clock, self.said.append) as health:
            recording = Recording(loaded, clock, SystemDisk(), lambda _: None, [self.companion], health)
            self.result = recording.run(self.stop)

    def wait_for(self, condition: Callable[[Health], bool]) -> Health:
        deadline_s = time.monotonic() + DEADLINE_S
        health = None
        while time.monotonic() < deadline_s:
            health = read_health(self.folder)
            if health is not None and condition(health):
                return health
            time.sleep(0.02)
        raise AssertionError(f"not within {DEADLINE_S} s: {health}")

    def end(self) -> RecordingResult:
        self.stop.requested.set()
        self._thread.join(20)
        assert self.result is not None
        return self.result


@pytest.fixture
def fly(write_config, rig, request):
    flights = []

    def start(**options: str) -> Flight:
        options["top"] = options.get("top", "") + "\nhealth.folder = 'health'"
        flights.append(Flight(write_config(rate_hz=50, **options)))
        return flights[-1]

    yield start
    for flight in flights:
        flight.stop.requested.set()
        flight._thread.join(20)


def test_a_healthy_recording_is_go_and_its_figures_are_the_results(fly, pixels_of):
    flight = fly()
    health = flight.wait_for(lambda h: h.state == "recording" and h.triggers > 100)
    assert judge(health, time.monotonic()).go
    assert [camera.place for camera in health.cameras] == PLACES
    assert health.trigger_rate_hz == pytest.approx(50, rel=0.3)
    for camera in health.cameras:
        assert camera.rate_hz == pytest.approx(50, rel=0.3)
        assert camera.silent_s < 1.0
    for disk in health.disks:
        free = os.statvfs(disk.folder)
        assert disk.free_bytes == pytest.approx(free.f_bavail * free.f_frsize, rel=0.1)
        assert disk.minutes_left > 1.0
    assert [n.values["offset_ns"] for n in health.diagnostics if n.name == "ptp"] == ["120"]
    assert health.pid == os.getpid()
    for place in PLACES:
        preview = read_preview(flight.folder, place)
        assert preview is not None
        assert preview.pixels == pixels_of(place.replace("/", "_"), preview.trigger_index).tobytes()
    result = flight.end()
    assert (result.lost, result.failures) == (0, [])
    last = read_health(flight.folder)
    assert (last.state, last.triggers) == ("ended", result.triggers)
    assert {c.place: c.recorded for c in last.cameras} == dict.fromkeys(PLACES, result.triggers)
    assert [reason.message for reason in judge(last, time.monotonic() + 60).reasons] == ["not recording, ended"]


def test_an_unplugged_camera_is_a_reason_within_two_seconds(fly, rig):
    flight = fly()
    index = flight.wait_for(lambda h: h.triggers > 50).triggers + 50
    rig.unplugged_at = {"right_cam1": index}
    flight.wait_for(lambda h: h.triggers >= index - 5)
    pulled_s = time.monotonic()
    reasons = flight.wait_for(lambda h: h.reasons).reasons
    assert time.monotonic() - pulled_s < 2.0
    assert {reason.name for reason in reasons} == {"right/cam1", "gate camera right/cam1"}, reasons
    assert "check its cable" in reasons[0].message


def test_a_silent_camera_and_a_silent_board_are_told_apart(fly, rig):
    flight = fly()
    index = flight.wait_for(lambda h: h.triggers > 50).triggers
    rig.missed = {("left_cam0", k) for k in range(index, index + 5000)}
    reasons = flight.wait_for(lambda h: h.reasons).reasons
    assert [(reason.name, reason.message[:24]) for reason in reasons] == [
        ("left/cam0", "no frame on the last 51 ")
    ] or (reasons[0].message.startswith("no frame on the last"))
    rig.missed = set()
    flight.wait_for(lambda h: not any("no frame" in reason.message for reason in h.reasons))
    rig.silent_pulses = set(range(100_000))
    flight.wait_for(lambda h: [r.name for r in h.reasons if "no trigger" in r.message] == ["trigger board"])


def test_a_full_disk_is_a_reason(fly, monkeypatch):
    real = os.statvfs
    full = threading.Event()

    def statvfs(path):
        space = real(path)
        if full.is_set() and "ssd_left" in str(path):
            values = list(space)
            values[4] = 0
            return os.statvfs_result(values)
        return space

    monkeypatch.setattr(os, "statvfs", statvfs)
    flight = fly()
    flight.wait_for(lambda h: h.triggers > 10)
    full.set()
    health = flight.wait_for(lambda h: h.reasons)
    assert "disk left" in [reason.name for reason in health.reasons]
    assert "free space on this disk" in health.reasons[-1].message or "free space" in health.disks[0].failure


def test_a_companion_that_reports_an_error_is_a_reason(fly):
    flight = fly()
    flight.wait_for(lambda h: h.state == "recording")
    flight.companion.said = [Diagnostic(ERROR, "ptp", "no master")]
    assert flight.wait_for(lambda h: h.reasons).reasons == (Notice(ERROR, "ptp", "no master"),)
    flight.companion.said = [Diagnostic(WARNING, "ptp", "holdover")]
    health = flight.wait_for(lambda h: not h.reasons)
    assert [caution.message for caution in health.cautions] == ["holdover"]


def test_a_folder_that_cannot_be_used_is_told_once_and_stops_nothing(write_config, rig, tmp_path):
    (tmp_path / "health").write_text("a file")
    flight = Flight(write_config(rate_hz=50, top="health.folder = 'health'"))
    time.sleep(1.5)
    result = flight.end()
    assert (result.lost, result.failures) == (0, [])
    assert len(flight.said) == 1
    assert "health.folder" in flight.said[0]


def test_a_recording_that_cannot_start_says_why(write_config, rig, tmp_path):
    config = write_config(top="health.folder = 'health'")
    config.write_text(config.read_text().replace("ssd_left", "not_mounted"))
    loaded = load_config(config)
    with HealthWriter(loaded.config, SystemClock(), lambda _: None) as health:
        recording = Recording(loaded, SystemClock(), SystemDisk(), lambda _: None, health=health)
        with pytest.raises(CaptureError):
            recording.run(StopRule(threading.Event()))
    assert "mount the disk" in read_health(tmp_path / "health").reasons[0].message


def blank(**changes: object) -> Health:
    health = Health("f", "recording", 1.0, 25, 25.0, (), (), (), written_monotonic_s=100.0)
    return dataclasses.replace(health, **changes)


def test_an_old_snapshot_speaks_for_nobody():
    assert judge(blank(), 100.0 + STALE_S).go
    silent = judge(blank(), 100.1 + STALE_S)
    assert not silent.go
    assert "silent for 2 s" in silent.reasons[0].message
    assert not judge(blank(), 50.0).go  # written before the last boot
    assert not judge(None, 0.0).go


def test_a_snapshot_comes_back_as_it_was(tmp_path):
    health = blank(diagnostics=(Notice(2, "ptp", "no master", {"state": "LISTENING"}),), temperatures_c={"cpu": 54.5})
    write_health(tmp_path, health)
    assert read_health(tmp_path) == health
    assert json.loads((tmp_path / HEALTH_FILE).read_text())["go"] is False
    assert [path.name for path in tmp_path.iterdir()] == [HEALTH_FILE]


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "7", '{"format": "other"}', '{"format": "wingshape health", "version": 9}']
)
def test_what_is_no_health_is_refused_with_its_name(tmp_path, text):
    (tmp_path / HEALTH_FILE).write_text(text)
    with pytest.raises(CaptureError, match=str(tmp_path)):
        read_health(tmp_path)


def test_a_full_tmpfs_keeps_the_last_whole_snapshot(tmp_path):
    """A file that may not grow past 4096 bytes takes a part of a write, as a full tmpfs does."""
    write_health(tmp_path, blank())
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        with pytest.raises(OSError, match="large"):
            write_health(tmp_path, blank(failures=("x" * 5000,)))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert read_health(tmp_path) == blank()


def test_a_snapshot_that_fails_is_not_the_last(tmp_path, write_config, rig):
    said: list[str] = []
    writer = HealthWriter(load_config(write_config(top="health.folder = 'health'")).config, SystemClock(), said.append)
    bad = [ZeroDivisionError("a defect")]

    def source() -> Health:
        if bad:
            raise bad.pop()
        return blank()

    writer.source = source
    with writer:
        end_s = time.monotonic() + DEADLINE_S
        while read_health(writer.folder) is None and time.monotonic() < end_s:
            time.sleep(0.05)
    assert read_health(writer.folder) is not None
    assert "a defect" in said[0]


def test_no_health_yet_is_no_error(tmp_path):
    assert read_health(tmp_path) is None
    assert read_preview(tmp_path, "left/cam0") is None


def test_a_link_or_a_folder_open_to_all_is_not_trusted(tmp_path, write_config, rig):
    from capture.health import make_folder

    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    (tmp_path / "link").symlink_to(tmp_path)
    for name in ("open", "link", "none/such"):
        with pytest.raises(CaptureError, match=r"health\.folder"):
            make_folder(tmp_path / name)


def test_the_default_folder_is_in_memory_and_private(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert default_folder() in (tmp_path / "wingshape", Path("/run/wingshape"))


def item_of(ring: Ring, slot: int, value: int, index: int) -> FrameItem:
    pixels = ring.slot(slot)[: 64 * 48]
    pixels[:] = bytes([value]) * len(pixels)
    sealed = SealedFrame(ring.slot(slot), pixels, 0, 1000 + index, 0, 0, 0, 0, ())
    return FrameItem(("left", "cam0"), index, ring, slot, sealed)


def test_a_preview_is_whole_or_not_seen(tmp_path):
    """One writes as fast as it can; what a reader gets is one frame's."""
    ring = Ring(8, PAGE, lock_memory=False)
    writer = PreviewWriter(tmp_path, [("left", "cam0")], (48, 64), 1e9, SystemClock())
    writer.start()
    stop = threading.Event()

    def feed() -> None:
        index = 0
        while not stop.is_set():
            slot = ring.take()
            if slot is None:
                continue
            index += 1
            if not writer.offer(item_of(ring, slot, index % 256, index)):
                ring.give_back(slot)

    thread = threading.Thread(target=feed)
    thread.start()
    seen = set()
    deadline_s = time.monotonic() + 20
    while len(seen) < 200 and time.monotonic() < deadline_s:
        preview = read_preview(tmp_path, "left/cam0")
        if preview is not None:
            assert set(preview.pixels) == {preview.trigger_index % 256}
            assert preview.trigger_time_ns == 1000 + preview.trigger_index
            seen.add(preview.trigger_index)
    stop.set()
    thread.join()
    writer.stop(5)
    assert len(seen) == 200
    assert ring.free == 8


def test_a_frame_half_written_by_one_that_died_is_not_seen(tmp_path):
    path = preview_path(tmp_path, "left/cam0")
    path.write_bytes(PREVIEW_HEADER.pack(b"WSPREV01", 3, 4, 2, 0, 0, 0) + bytes(8))
    assert read_preview(tmp_path, "left/cam0") is None
    path.write_bytes(PREVIEW_HEADER.pack(b"WSPREV01", 4, 4, 2, 0, 0, 0) + bytes(7))
    assert read_preview(tmp_path, "left/cam0") is None
    path.write_bytes(PREVIEW_HEADER.pack(b"WSPREV01", 4, 4, 2, 0, 0, 0) + bytes(8))
    assert read_preview(tmp_path, "left/cam0").pixels == bytes(8)


def test_no_slot_is_borrowed_while_the_ring_fills(tmp_path):
    ring = Ring(8, PAGE, lock_memory=False)
    writer = PreviewWriter(tmp_path, [("left", "cam0")], (48, 64), 2.0, SystemClock())
    slots = [ring.take() for _ in range(5)]
    assert not writer.offer(item_of(ring, slots[0], 1, 1))
    ring.give_back(slots.pop())
    assert writer.offer(item_of(ring, slots[0], 1, 1))
    assert not writer.offer(item_of(ring, slots[1], 1, 2)), "one a camera at a time"
    writer.start()
    writer.stop(5)
    assert ring.free == 5


def test_temperatures_are_read_as_the_kernel_shows_them(tmp_path):
    for folder, name, value in (
        ("thermal/thermal_zone0", "type cpu-thermal", "temp 51234"),
        ("thermal/thermal_zone1", "type cpu-thermal", "temp 48000"),
        ("thermal/thermal_zone2", "type dead", "temp nonsense"),
        ("hwmon/hwmon0", "name nvme", "temp1_input 38850"),
        ("hwmon/hwmon1", "name broken", "temp1_input -273000"),
    ):
        (tmp_path / folder).mkdir(parents=True)
        for text in (name, value):
            file, content = text.split()
            (tmp_path / folder / file).write_text(content + "\n")
    assert host_temperatures_c(tmp_path) == {"cpu-thermal": 51.234, "cpu-thermal 2": 48.0, "nvme": 38.85}
    assert np.isfinite(list(host_temperatures_c().values())).all()
