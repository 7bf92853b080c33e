"""What the service manager is told: notifications, signs of life only for progress, changes in the journal."""

import os
import socket
import threading
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from capture.clock import SystemClock
from capture.config import Config, load_config
from capture.daemon import Recording
from capture.disk import SystemDisk
from capture.journal import REPEAT_PERIOD_S, Changes, Journal, Priority
from capture.notify import Notifier, journal_listens
from capture.record import Diagnostic
from capture.service import Service
from capture.stop_rule import StopRule
from capture.watchdog import IDLE, Progress, Watchdog, watchdog_s


@pytest.fixture
def manager(tmp_path):
    """A socket that listens as systemd does."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        listening.settimeout(5.0)
        yield listening


def heard(listening: socket.socket) -> list[str]:
    """Everything said so far."""
    listening.setblocking(False)
    said = []
    try:
        while True:
            said.append(listening.recv(4096).decode())
    except BlockingIOError:
        return said


def test_what_is_sent_is_what_sd_notify_specifies(manager, tmp_path):
    notifier = Notifier({"NOTIFY_SOCKET": str(tmp_path / "notify")})
    notifier.ready(8.1)
    notifier.alive()
    notifier.status("triggers 25\n recorded 100")
    notifier.stopping()
    notifier.close()
    assert heard(manager) == [
        "READY=1\nWATCHDOG_USEC=8100000",
        "WATCHDOG=1",
        "STATUS=triggers 25 recorded 100",
        "STOPPING=1",
    ]


def test_an_abstract_socket_is_reached():
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind("\0wingshape-test-" + str(os.getpid()))
        listening.settimeout(5.0)
        notifier = Notifier({"NOTIFY_SOCKET": f"@wingshape-test-{os.getpid()}"})
        notifier.alive()
        notifier.close()
        assert listening.recv(100) == b"WATCHDOG=1"


def test_without_a_manager_nothing_happens(tmp_path):
    assert not Notifier({}).listening
    Notifier({}).ready(1.0)
    notifier = Notifier({"NOTIFY_SOCKET": str(tmp_path / "gone")})
    notifier.alive()
    notifier.close()


class Hand:
    """A watchdog under a clock that a test moves."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.signs: list[float] = []
        self.watchdog = Watchdog(lambda: self.signs.append(self.now_s), lambda: self.now_s)

    def look(self, at_s: float, progress: Progress) -> bool:
        self.now_s = at_s
        return self.watchdog.look(progress)


def test_frames_on_the_disk_are_life():
    hand = Hand()
    for k in range(50):
        assert hand.look(k * 0.1, Progress(4 * k, True))
    assert max(b - a for a, b in zip(hand.signs, hand.signs[1:], strict=False)) < 0.61


def test_frames_that_are_due_and_do_not_come_are_silence():
    hand = Hand()
    hand.look(0.0, Progress(40, True))
    last_s = 0.0
    for k in range(1, 100):
        if hand.look(k * 0.1, Progress(40, True)):
            last_s = k * 0.1
    assert last_s < 1.0
    assert hand.signs[-1] < 1.0


def test_nothing_due_is_idleness():
    hand = Hand()
    hand.look(0.0, Progress(40, True))
    assert all(hand.look(1.0 + k, Progress(40, False)) for k in range(20))
    assert hand.look(30.0, IDLE)
    assert len(hand.signs) == 22


@given(
    rate_hz=st.floats(0.05, 200.0),
    stall_s=st.floats(0.01, 60.0),
)
def test_the_period_outlasts_every_healthy_silence(rate_hz, stall_s):
    places = [{"side": "left", "name": "cam0", "address": "a"}]
    config = Config.model_validate(
        {
            "trigger": {"port": "p", "rate_hz": rate_hz},
            "disks": {"left": "l", "right": "r"},
            "ring": {"stall_s": stall_s},
            "camera": {"backend": "simulated"},
            "cameras": places,
        }
    )
    # The first frames are held back, up to seven, then the disk stalls, while the control thread waits for the board's
    # answer (two questions, a second each to write and to be answered) and has just missed the last look.
    silence_s = 7.0 / rate_hz + stall_s + 2 * (1.0 + 1.0) + 0.5
    assert watchdog_s(config) > 1.2 * silence_s
    assert watchdog_s(config) < 2.0 * (8.0 / rate_hz + stall_s + 6.0)


class Voice:
    def __init__(self) -> None:
        self.said: list[str] = []

    def __call__(self, text: str) -> None:
        self.said.append(text)

    def close(self) -> None:
        pass


def record(write_config, tmp_path, during, during_stop=lambda: None, seconds: float = 3.0):
    """Record on the fake rig, ``during`` after a second: what the manager heard from then on, and the person in all."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        listening.setblocking(False)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        loaded, clock = load_config(write_config(rate_hz=25.0)), SystemClock()
        voice = Voice()
        service = Service(loaded.config, clock, voice, Notifier({"NOTIFY_SOCKET": str(tmp_path / "notify")}))
        requested = threading.Event()
        recording = Recording(loaded, clock, SystemDisk(), service.event, service=service)
        thread = threading.Thread(target=lambda: recording.run(StopRule(requested)))
        thread.start()
        time.sleep(1.0)
        heard(listening)
        during()
        time.sleep(seconds)
        said = heard(listening)
        requested.set()
        during_stop()
        thread.join(30.0)
        service.close()
        assert not thread.is_alive()
        return said, voice.said


def test_a_recording_gives_signs_of_life(rig, write_config, tmp_path):
    said, _ = record(write_config, tmp_path, lambda: None)
    assert said.count("WATCHDOG=1") >= 4
    assert any(line.startswith("STATUS=triggers") for line in said)


@pytest.mark.slow
def test_a_camera_library_that_hangs_for_all_cameras_ends_the_signs(rig, write_config, tmp_path):
    release = threading.Event()

    def hang() -> None:
        for camera in rig.cameras.values():
            camera.grab = lambda timeout_s: release.wait(20.0) and None

    said, _ = record(write_config, tmp_path, hang, release.set)
    # What was on its way when it hung still counts once.
    assert said.count("WATCHDOG=1") <= 2


@pytest.mark.slow
def test_one_camera_that_hangs_is_told_and_does_not_end_the_signs(rig, write_config, tmp_path):
    release = threading.Event()

    def hang() -> None:
        rig.cameras["left_cam0"].grab = lambda timeout_s: release.wait(20.0) and None

    said, told = record(write_config, tmp_path, hang, release.set, seconds=3.5)
    assert said.count("WATCHDOG=1") >= 5
    assert any("left/cam0: the camera driver has not answered" in line for line in told)


def test_the_journal_gets_fields_in_its_native_form(tmp_path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "journal"))
        journal = Journal(tmp_path / "journal")
        journal.write(Priority.ERROR, "disk left: full:\nfree space", "disk left")
        journal.close()
        data = listening.recv(4096)
    text = b"disk left: full:\nfree space"
    assert data.startswith(b"MESSAGE\n" + len(text).to_bytes(8, "little") + text + b"\n")
    fields = data.split(text + b"\n")[1].decode().splitlines()
    assert fields == ["PRIORITY=3", "SYSLOG_IDENTIFIER=wingcap", "WINGSHAPE_ABOUT=disk left"]


def test_a_journal_that_takes_nothing_stops_nobody(tmp_path):
    journal = Journal(tmp_path / "nobody")
    journal("hello")
    journal.close()
    assert journal.dropped == 1


def test_whether_the_journal_listens_is_told_by_its_stream(tmp_path):
    with (tmp_path / "stream").open("w") as file:
        status = os.fstat(file.fileno())
        right = {"JOURNAL_STREAM": f"{status.st_dev}:{status.st_ino}"}
        assert journal_listens(right, file.fileno())
        assert not journal_listens({"JOURNAL_STREAM": f"{status.st_dev}:{status.st_ino + 1}"}, file.fileno())
    for other in ({}, {"JOURNAL_STREAM": "nonsense"}):
        assert not journal_listens(other, 2)


def test_changes_are_told_once_and_repetition_is_bounded():
    now_s = 0.0
    changes = Changes(lambda: now_s)
    fine, bad = Diagnostic(0, "disk left", "direct"), Diagnostic(2, "disk left", "full: free space")
    assert changes.of([fine]) == []
    assert changes.of([bad]) == [(Priority.ERROR, "disk left", "disk left: full: free space")]
    assert changes.of([bad]) == []
    told = 0
    for k in range(100):  # it flickers ten times a second
        now_s = 0.1 * k
        told += len(changes.of([fine if k % 2 else bad]))
    assert told == 0
    now_s = REPEAT_PERIOD_S + 1.0
    ((priority, _, text),) = changes.of([fine])
    assert priority is Priority.NOTICE
    assert "were not told" in text
    assert changes.of([]) == []


def test_what_is_only_named_while_it_is_wrong_is_told_when_it_is_over():
    changes = Changes(lambda: 0.0)
    changes.of([Diagnostic(2, "gate clock", "no master")])
    assert changes.of([]) == [(Priority.NOTICE, "gate clock", "gate clock: in order again")]
    assert changes.of([]) == []


def test_the_example_configuration_is_one():
    config = load_config(Path(__file__).parents[2] / "systemd/wingcap.toml").config
    assert config.threads.read.priority > config.threads.write.priority > config.threads.control.priority
