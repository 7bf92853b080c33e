"""Started by power or by the watchdog, with nobody there: what is there is recorded, what is missing is told."""

import socket
import sys
import threading

import pytest

from capture.clock import SystemClock
from capture.config import load_config
from capture.daemon import Recording
from capture.disk import SystemDisk
from capture.errors import CameraError, DiskError, UsageError
from capture.notify import Notifier
from capture.service import Service
from capture.stop_rule import StopRule
from capture.verify import inspect

TRIGGERS = 150


@pytest.fixture
def fly(rig, write_config, tmp_path):
    """Record so many triggers, managed by somebody or not."""

    def record(triggers: int = TRIGGERS, managed: bool = True, left: str = "ssd_left"):
        path = write_config(rate_hz=50.0)
        path.write_text(path.read_text().replace('left = "ssd_left"', f'left = "{left}"'))
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
            (tmp_path / "notify").unlink(missing_ok=True)
            manager.bind(str(tmp_path / "notify"))
            loaded, clock = load_config(path), SystemClock()
            told: list[str] = []
            notifier = Notifier({"NOTIFY_SOCKET": str(tmp_path / "notify")} if managed else {})
            service = Service(loaded.config, clock, told.append, notifier)
            recording = Recording(loaded, clock, SystemDisk(), told.append, service=service)
            try:
                return recording.run(StopRule(threading.Event(), triggers)), told
            finally:
                notifier.close()

    return record


def unplug(rig, monkeypatch, *addresses: str, back_at: int = 1 << 60) -> None:
    """These cameras do not answer until the board has given so many triggers."""
    made = sys.modules["fake_camera_backend"].FakeCamera
    opened = made.open

    def open_if_there(camera):
        if camera.address in addresses and rig.board.next_index < back_at:
            raise CameraError("no such camera: plug it in")
        return opened(camera)

    monkeypatch.setattr(made, "open", open_if_there)


def test_a_camera_that_is_missing_at_the_start_is_taken_in_when_it_comes(fly, rig, monkeypatch, tmp_path):
    unplug(rig, monkeypatch, "left_cam1", back_at=40)
    result, told = fly()
    (absence,) = result.absences["left", "cam1"]
    assert absence.end_ns > absence.begin_ns
    assert "not there at the start" in absence.cause
    late = result.accounts["left", "cam1"]
    assert 40 <= late.lost["camera"] < TRIGGERS
    assert late.recorded == TRIGGERS - late.lost_total
    assert (
        result.accounts["left", "cam0"].recorded >= TRIGGERS - 5
    )  # made of threads, the fakes stumble on a busy machine
    assert any("left/cam1: no such camera" in line for line in told)
    report = inspect([tmp_path / "ssd_left", tmp_path / "ssd_right"])
    assert report.problems == []
    assert report.cameras["left/cam1"].recorded == late.recorded


def test_a_camera_that_never_comes_is_lost_with_its_cause(fly, rig, monkeypatch, tmp_path):
    unplug(rig, monkeypatch, "right_cam0")
    result, _ = fly(60)
    assert result.accounts["right", "cam0"].lost == {"camera": 60}
    assert result.accounts["right", "cam1"].recorded == 60
    assert inspect([tmp_path / "ssd_left", tmp_path / "ssd_right"]).problems == []


def test_with_no_camera_at_all_there_is_no_recording(fly, rig, monkeypatch):
    unplug(rig, monkeypatch, *(f"{side}_{name}" for side in ("left", "right") for name in ("cam0", "cam1")))
    with pytest.raises(CameraError, match="no such camera"):
        fly()


def test_a_dead_disk_at_the_start_costs_its_side_only(fly, tmp_path):
    result, told = fly(60, left="nowhere")
    assert set(result.accounts) == {("right", "cam0"), ("right", "cam1")}
    assert result.recorded == 120
    assert any("nowhere: cannot be written" in failure for failure in result.failures)
    assert any("disk left" in line for line in told)
    report = inspect([tmp_path / "ssd_right"])
    assert report.problems == []
    assert report.recorded == 120


def test_with_a_person_there_both_are_refused(fly, rig, monkeypatch):
    with pytest.raises(DiskError, match="nowhere: cannot be written"):
        fly(managed=False, left="nowhere")
    unplug(rig, monkeypatch, "left_cam1")
    with pytest.raises(CameraError, match="left/cam1: no such camera"):
        fly(managed=False)


def test_a_second_flight_of_the_same_name_gets_a_number(fly, rig, tmp_path):
    assert fly(20)[0].flight == "test"
    assert fly(20)[0].flight == "test_2"
    with pytest.raises(UsageError, match="exists already"):
        fly(20, managed=False)
