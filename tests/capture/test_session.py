"""What starts and ends a recording: power-up, a command, the first trigger; the test burst; the control socket."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time

import pytest

from capture.burst import Burst, CameraBurst
from capture.clock import SystemClock
from capture.config import StartConfig, load_config
from capture.control import Answer, ControlServer, ask
from capture.daemon import Recording
from capture.disk import SystemDisk
from capture.errors import CameraLost, CaptureError
from capture.finding import Situation
from capture.grabber import Grabber
from capture.preflight import check_burst
from capture.record import GATE_TOPIC, Gate
from capture.scan import scan
from capture.session import Session
from capture.stop_rule import StopRule
from capture.trigger import is_running
from capture.verify import inspect

TRIGGERS = 10


def until(condition, seconds: float = 10.0) -> None:
    end_s = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.01)


class Result:
    triggers = recorded = 3
    lost = 0
    again = False

    def __init__(self, flight: str, failures: list[str]) -> None:
        self.flight, self.failures = flight, failures


class Take:
    """A recording that lasts until it is told to stop, or for ``limit`` turns."""

    state = "recording"
    failures: tuple[str, ...] = ()

    def __init__(self, number: int, limit: int | None = None) -> None:
        self.flight = f"flight_{number}"
        self.limit = limit

    def run(self, stop: StopRule) -> Result:
        for _ in range(1000 if self.limit is None else self.limit):
            if stop.requested.wait(0.01):
                break
        return Result(self.flight, list(self.failures))


@contextlib.contextmanager
def running(on: str, **take):
    made: list[Take] = []

    def make() -> Take:
        made.append(Take(len(made), **take))
        return made[-1]

    session = Session(StartConfig(on=on), make, lambda _: None)
    thread = threading.Thread(target=session.run, args=(0, 0.0))
    thread.start()
    try:
        yield session, made, thread
    finally:
        session.quit()
        thread.join(5)
        assert not thread.is_alive()


def test_by_command_it_records_as_often_as_it_is_told():
    with running("command") as (session, made, _):
        assert session.act("stop") == Answer(False, "idle", "", "there is no recording to stop")
        for number in range(3):
            assert session.act("start").ok
            until(lambda: session.state == "recording")
            assert session.act("start") == Answer(
                False, "recording", f"flight_{number}", "there is a recording already"
            )
            assert session.act("status") == Answer(True, "recording", f"flight_{number}", "")
            assert session.act("stop").ok
            until(lambda: session.state == "idle")
    assert [result.flight for result in session.results] == ["flight_0", "flight_1", "flight_2"]
    assert len(made) == 3


def test_at_power_up_it_records_by_itself_and_again_by_command():
    with running("power-up") as (session, made, thread):
        until(lambda: session.state == "recording")
        session.act("stop")
        until(lambda: session.state == "idle")
        assert thread.is_alive()
        session.act("start")
        until(lambda: len(made) == 2 and session.state == "recording")


@pytest.mark.parametrize("on", ["power-up", "first-trigger"])
def test_a_recording_that_ends_by_itself_ends_the_run(on):
    with running(on, limit=3) as (session, _, thread):
        thread.join(5)
        assert not thread.is_alive()
    assert len(session.results) == 1


def test_quitting_while_idle_ends_the_run_without_a_recording():
    with running("command") as (session, made, thread):
        session.quit()
        thread.join(5)
        assert not thread.is_alive()
    assert made == []


def test_with_triggers_still_running_it_records_at_once_whatever_is_configured(rig, write_config):
    assert not is_running(rig.port, SystemClock())
    assert not is_running("/dev/no-such-port", SystemClock())
    rig.board.running, rig.board.last = True, 1 << 60
    assert is_running(rig.port, SystemClock())
    rig.board.running = False
    session = Session(StartConfig(on="command"), lambda: Take(0, limit=3), lambda _: None)
    assert session.run(0, 0.0, in_flight=True).flight == "flight_0"


@pytest.fixture
def server(tmp_path):
    asked = []

    def act(what: str) -> Answer:
        asked.append(what)
        return Answer(True, "idle", "", "starting")

    made = ControlServer(tmp_path / "control.sock", act)
    made.start()
    made.asked = asked
    yield made
    made.close()
    assert not made.path.exists()
    assert made.error is None


def test_the_socket_passes_on_what_it_is_asked(server):
    assert ask(server.path, "start") == Answer(True, "idle", "", "starting")
    assert server.asked == ["start"]
    assert server.path.stat().st_mode & 0o777 == 0o660


@pytest.mark.parametrize("line", [b"hello\n", b'{"do": "explode"}\n', b"[]\n", b"x" * 5000, b"[" * 4000 + b"\n", b""])
def test_nonsense_on_the_socket_is_refused_and_harms_nobody(server, line):
    with socket.socket(socket.AF_UNIX) as client:
        client.settimeout(5)
        client.connect(str(server.path))
        client.sendall(line)
        client.shutdown(socket.SHUT_WR)
        with contextlib.suppress(ConnectionError):
            assert not json.loads(client.recv(4096))["ok"]
    assert ask(server.path, "status").ok
    assert server.asked == ["status"]


def test_a_second_recorder_does_not_take_the_socket_over(server):
    with pytest.raises(CaptureError, match="another recorder listens"):
        ControlServer(server.path, lambda _: Answer(True, "", "", ""))
    assert ask(server.path, "status").ok


def test_a_socket_that_a_dead_recorder_left_is_taken(tmp_path):
    path = tmp_path / "control.sock"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    with pytest.raises(CaptureError, match="no recorder answers"):
        ask(path, "status")
    made = ControlServer(path, lambda _: Answer(True, "idle", "", ""))
    made.start()
    assert ask(path, "status").state == "idle"
    made.close()


def record(config, stop: threading.Event | None = None, triggers: int = TRIGGERS):
    recording = Recording(load_config(config), SystemClock(), SystemDisk(), lambda _: None)
    return recording, lambda: recording.run(StopRule(stop or threading.Event(), triggers))


def marks(folder) -> list[Gate]:
    found = scan(folder / "ssd_left/test/aux_0000.mcap")[1]
    return [Gate.decode(message.data) for message in found if message.topic == GATE_TOPIC]


def test_a_burst_before_the_recording_is_in_nobodys_books(write_config, rig, tmp_path):
    _, run = record(write_config(top="[start]\nburst = 8"))
    result = run()
    assert (result.triggers, result.recorded, result.lost, result.failures) == (TRIGGERS, 4 * TRIGGERS, 0, [])
    assert inspect([tmp_path]).problems == []
    assert rig.counter == 17 + TRIGGERS + 8
    assert [gate.name for gate in marks(tmp_path) if gate.name.startswith("burst")] == []


def test_a_camera_that_misses_a_trigger_of_the_burst_is_marked_and_recorded(write_config, rig, tmp_path, wingcap):
    rig.missed = {("left_cam1", 2**31 + 3)}
    _, run = record(write_config(top="[start]\nburst = 8"))
    result = run()
    assert (result.recorded, result.failures) == (4 * TRIGGERS, [])
    (begin, end) = marks(tmp_path)
    assert (begin.name, begin.cause) == ("burst left/cam1", "the board gave 8 triggers, the camera 7 frames")
    assert end.end_ns > end.begin_ns
    report = inspect([tmp_path])
    assert (report.problems, list(report.marks.values())) == ([], [end])
    said = wingcap("info", tmp_path).stdout
    assert "marked: burst left/cam1" in said
    assert "the board gave 8 triggers, the camera 7 frames" in " ".join(said.split())


def test_it_waits_armed_for_the_first_trigger_of_another_hand(write_config, rig, tmp_path):
    recording, run = record(write_config(top='[start]\non = "first-trigger"'))
    results = []
    thread = threading.Thread(target=lambda: results.append(run()))
    thread.start()
    until(lambda: recording.state == "armed")
    time.sleep(0.3)
    assert recording.state == "armed"
    rig.board.running, rig.board.next_index, rig.board.last = True, 700, 1 << 60
    thread.join(20)
    assert (results[0].triggers, results[0].lost, results[0].failures) == (TRIGGERS, 0, [])
    assert inspect([tmp_path]).problems == []


def test_stopped_while_armed_it_leaves_a_whole_recording_of_nothing(write_config, rig, tmp_path):
    stop = threading.Event()
    _, run = record(write_config(top='[start]\non = "first-trigger"'), stop)
    threading.Timer(0.5, stop.set).start()
    result = run()
    assert (result.triggers, result.failures) == (0, [])
    report = inspect([tmp_path])
    assert (report.problems, report.triggers) == ([], 0)


def test_what_was_said_while_armed_is_in_the_files_although_nothing_began(write_config, rig, tmp_path):
    class Saying:
        def start(self, put) -> None:
            put(GATE_TOPIC, 1, Gate(1, 2, "early", "said while armed").encode())

        def statuses(self) -> list:
            return []

        def stop(self) -> None:
            raise RuntimeError("and it cannot even stop")

        def account(self) -> dict[str, str]:
            return {}

    stop = threading.Event()
    loaded = load_config(write_config(top='[start]\non = "first-trigger"'))
    recording = Recording(loaded, SystemClock(), SystemDisk(), lambda _: None, [Saying()])
    threading.Timer(0.5, stop.set).start()
    result = recording.run(StopRule(stop))
    assert result.failures == ["Saying: RuntimeError('and it cannot even stop')"]
    assert "early" in [gate.name for gate in marks(tmp_path)]
    assert inspect([tmp_path]).problems == []


def test_a_camera_that_goes_while_armed_costs_the_others_nothing(write_config, rig, tmp_path, monkeypatch):
    arm = Grabber.arm

    def arm_or_gone(self) -> None:
        if self.place == ("right", "cam1"):
            rig.cameras["right_cam1"]._gone = True
            raise CameraLost("unplugged: check its cable")
        arm(self)

    monkeypatch.setattr(Grabber, "arm", arm_or_gone)
    _, run = record(write_config())
    result = run()
    assert len(result.failures) == 1
    assert "unplugged" in result.failures[0]
    lost = {place: account.lost_total for place, account in result.accounts.items()}
    assert lost.pop(("right", "cam1")) == TRIGGERS
    assert set(lost.values()) == {0}
    assert inspect([tmp_path]).problems == []


def test_a_start_while_the_recording_is_being_made_does_not_make_another():
    made: list[Take] = []

    def make() -> Take:
        made.append(Take(len(made)))
        if len(made) == 1:
            session.act("start")  # somebody is impatient
        return made[-1]

    session = Session(StartConfig(on="command"), make, lambda _: None)
    thread = threading.Thread(target=session.run, args=(0, 0.0))
    thread.start()
    session.act("start")
    until(lambda: session.state == "recording")
    session.act("stop")
    until(lambda: session.results)
    time.sleep(0.5)
    assert (session.state, len(made)) == ("idle", 1)
    session.quit()
    thread.join(5)


def test_preflight_gives_a_burst_and_compares_the_counts(write_config, rig):
    situation = Situation(load_config(write_config()).config, SystemClock())
    assert all(finding.ok for finding in check_burst(situation))
    rig.missed = {("left_cam1", 2**31 + 3)}
    refused = [finding for finding in check_burst(situation) if not finding.ok]
    assert [(f.name, f.numbers["frames"]) for f in refused] == [("test burst left/cam1", 9)]
    rig.silent_pulses = {2**31 + 5}
    found = {finding.name: finding for finding in check_burst(situation)}
    assert found["test burst"].found == "asked for 10 triggers, the board gave 10 and reported 9"
    rig.board.running, rig.board.last = True, 1 << 60
    (busy,) = check_burst(situation)
    assert "giving triggers already" in busy.found
    rig.board.running = False


def test_a_bursts_verdict_has_its_numbers():
    place = ("left", "cam0")
    assert Burst(10, 10, {place: CameraBurst(10, 0, 12.0)}).trouble(place, 50.0) is None
    assert "9 frames, 1 more cut short" in Burst(10, 10, {place: CameraBurst(9, 1, 12.0)}).trouble(place, 50.0)
    assert "known to 80 us only, not 50 us" in Burst(10, 10, {place: CameraBurst(10, 0, 80.0)}).trouble(place, 50.0)


def test_start_and_stop_from_the_command_line(tmp_path, write_config, rig, wingcap):
    """The whole command; the devices are the simulated rig's in another test, here it stays idle."""
    config = write_config(top=f'[start]\non = "command"\n[health]\nfolder = "{tmp_path}/health"')
    config.write_text(config.read_text().replace('"fake"', '"simulated"'))
    command = [sys.executable, "-c", "from capture.cli import main; main()", "record", "--config", str(config)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process, contextlib.ExitStack() as cleanup:
        cleanup.callback(process.kill)
        path = tmp_path / "health/control.sock"
        until(lambda: path.exists() and (tmp_path / "health/health.json").exists())
        assert ask(path, "status") == Answer(True, "idle", "", "")
        refused = wingcap("stop", "--config", config)
        assert (refused.returncode, refused.stderr) == (1, "error: there is no recording to stop\n")
        until(lambda: json.loads((tmp_path / "health/health.json").read_text())["state"] == "idle")
        health = json.loads((tmp_path / "health/health.json").read_text())
        assert (health["go"], health["control_socket"]) == (False, str(path))
        os.kill(process.pid, signal.SIGTERM)
        assert process.wait(10) == 0
        process.stderr.close()
    assert "no recorder answers" in wingcap("start", "--config", config).stderr
