"""The service on a real systemd as PID 1: installed by our command, watched, visible, and found again after a fault."""

import json
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from nspawn import PREFIX, Machine, wait_for

from capture.config import load_config
from capture.watchdog import watchdog_s

pytestmark = pytest.mark.slow
WINGCAP = PREFIX / "bin/wingcap"
CONFIG = "etc/wingshape/wingcap.toml"
ACTIVE_DEADLINE_S = 5.0


class Service:
    """The recorder's unit in a container."""

    def __init__(self, machine: Machine) -> None:
        self.machine = machine
        began_s = time.monotonic()
        machine.ask("systemctl", "start", "wingcap")
        self.active_after_s = time.monotonic() - began_s
        self.watchdog_s = watchdog_s(load_config(machine.root / CONFIG).config)

    def totals(self) -> dict[str, int]:
        """The running totals that `systemctl status` shows."""
        words = self.show("StatusText")["StatusText"].split()
        return {name: int(words[words.index(name) + 1]) if name in words else 0 for name in ("recorded", "lost")}

    def records(self, frames: int) -> None:
        """Wait until there are so many more."""
        before = self.totals()["recorded"]
        wait_for(lambda: self.totals()["recorded"] >= before + frames, 15.0, lambda: "\n".join(self.messages()))

    def show(self, *properties: str) -> dict[str, str]:
        return self.machine.show("wingcap", *properties)

    def stop(self) -> None:
        self.machine.ask("systemctl", "stop", "wingcap")

    def flights(self) -> list[str]:
        return self.machine.ask("ls", "/mnt/ssd_left").split()

    def messages(self) -> list[str]:
        return [str(entry["MESSAGE"]) for entry in self.machine.journal("wingcap")]

    def verify(self, flight: str) -> int:
        """The exit code of `wingcap verify`."""
        return self.machine.run(WINGCAP, "verify", *folders(flight)).returncode

    def health(self) -> dict:
        """What is shared with those who watch, as their user reads it."""
        reader = ("runuser", "-u", "wingshape-monitor", "-g", "wingshape", "--", "cat", "/run/wingshape/health.json")
        return json.loads(self.machine.ask(*reader))

    def reasons(self) -> dict[str, str]:
        """What stands against flying, by name."""
        return {notice["name"]: notice["message"] for notice in self.health()["diagnostics"] if notice["level"] == 2}


def folders(flight: str) -> list[str]:
    return [f"/mnt/ssd_{side}/{flight}" for side in ("left", "right")]


@pytest.fixture
def service(installed: Machine) -> Iterator[Service]:
    """Started on empty disks."""
    installed.ask("sh", "-c", "rm -rf /mnt/ssd_*/*")
    yield Service(installed)
    installed.run("systemctl", "stop", "wingcap")


def test_it_is_active_in_seconds_records_and_stops_clean(service, capsys):
    assert service.active_after_s < ACTIVE_DEADLINE_S
    assert service.show("ActiveState", "SubState", "NRestarts", "User") == {
        "ActiveState": "active",
        "SubState": "running",
        "NRestarts": "0",
        "User": "wingshape",
    }
    service.records(100)
    began_s = time.monotonic()
    service.stop()
    stopped_after_s = time.monotonic() - began_s
    assert service.show("ActiveState", "Result") == {"ActiveState": "inactive", "Result": "success"}
    (flight,) = service.flights()
    assert service.verify(flight) == 0
    with capsys.disabled():
        print(f"\nactive after {service.active_after_s:.2f} s, stopped after {stopped_after_s:.2f} s")


def test_its_threads_have_the_rights_that_they_ask_for(service):
    service.records(4)
    pid = service.machine.host_pid("wingcap")
    threads = [int(folder.name) for folder in Path(f"/proc/{pid}/task").iterdir()]
    fifo = [
        os.sched_getparam(thread).sched_priority
        for thread in threads
        if os.sched_getscheduler(thread) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
    ]
    assert sorted(fifo) == [20, 20, 30, 30, 40, 40, 40, 40]  # control and board, two disks, four cameras
    on_one_cpu = [thread for thread in threads if len(os.sched_getaffinity(thread)) == 1]
    assert [os.sched_getparam(thread).sched_priority for thread in on_one_cpu] == [30, 30]
    locked_kb = int(Path(f"/proc/{pid}/status").read_text().split("VmLck:")[1].split()[0])
    assert locked_kb * 1024 > 4 * 10 * 260 * 194


def test_a_second_recorder_is_refused(service):
    command = (WINGCAP, "record", "--config", f"/{CONFIG}")
    second = service.machine.run("runuser", "-u", "wingshape", "--", *command)
    assert second.returncode == 1
    assert "another recorder is writing there" in second.stderr
    service.records(50)
    assert len(service.flights()) == 1


def test_a_stopped_daemon_is_restarted_and_its_flight_recovered(service, capsys):
    service.records(100)
    os.kill(service.machine.host_pid("wingcap"), signal.SIGSTOP)
    took_s = wait_for(lambda: service.show("NRestarts")["NRestarts"] == "1", service.watchdog_s + 15.0)
    service.records(100)
    cut, current = service.flights()
    said = "\n".join(service.messages())
    assert "Watchdog timeout" in said
    assert f"/mnt/ssd_left/{cut}" in said
    assert "run `wingcap recover`" in said
    service.stop()
    recover = (WINGCAP, "recover", *folders(cut), "--out", "/var/tmp/copy", "--json")
    recovered = service.machine.run(*recover)
    assert recovered.returncode in (0, 3), recovered.stderr  # 3: the trigger that was under way
    assert json.loads(recovered.stdout)["frames_recovered"] >= 100
    assert service.machine.run(WINGCAP, "verify", "/var/tmp/copy").returncode == 0
    assert service.verify(current) == 0
    with capsys.disabled():
        print(f"\nrestarted {took_s:.1f} s after it was stopped (watchdog {service.watchdog_s:.1f} s)")


def test_a_full_disk_degrades_and_is_told(service):
    service.records(20)
    service.machine.run("sh", "-c", "head -c 1000M /dev/zero > /mnt/ssd_left/ballast")
    wait_for(
        lambda: any(
            entry.get("WINGSHAPE_ABOUT") == "disk left" and entry["PRIORITY"] == "3"
            for entry in service.machine.journal("wingcap")
        ),
        15.0,
        lambda: "\n".join(service.messages()),
    )
    assert "free space on this disk" in "\n".join(service.messages())
    service.records(50)  # the right side goes on
    assert service.totals()["lost"] > 0
    assert "disk left" in service.reasons()
    assert service.show("ActiveState", "NRestarts") == {"ActiveState": "active", "NRestarts": "0"}
    service.machine.ask("rm", "/mnt/ssd_left/ballast")
    service.machine.run("systemctl", "stop", "wingcap")
    flight = service.flights()[0]
    assert service.verify(flight) == 0


def test_without_a_master_clock_it_records_and_shows_no_go(service):
    service.records(50)  # no ptp4l at all
    assert service.health()["go"] is False
    assert "ptp.answers" in " ".join(service.reasons())
    service.machine.ask("systemctl", "start", "wingshape-ptp4l")  # one that hears no master
    try:
        wait_for(lambda: "ptp.state" in " ".join(service.reasons()), 20.0, lambda: str(service.reasons()))
        assert "ptp.answers" not in " ".join(service.reasons())
        assert service.machine.show("wingshape-ptp4l", "User") == {"User": "wingshape-ptp"}
        service.records(50)
    finally:
        service.machine.run("systemctl", "stop", "wingshape-ptp4l")
    assert set(service.reasons()) <= {name for name in service.reasons() if "ptp" in name}
    service.stop()
    assert service.verify(service.flights()[0]) == 0


def test_the_monitor_tells_no_go_to_who_has_the_token(service):
    service.records(20)
    service.machine.ask("systemctl", "start", "wingcap-monitor")
    ask = (
        "import json, sys, urllib.error, urllib.request as u\n"
        "head = {'Authorization': 'Bearer ' + sys.argv[1]} if sys.argv[1:] else {}\n"
        "try:\n"
        "    print(u.urlopen(u.Request('http://127.0.0.1:8080/api/status', headers=head), timeout=5).read().decode())\n"
        "except urllib.error.HTTPError as error:\n"
        "    print(json.dumps(error.code))\n"
    )
    python = PREFIX / "bin/python"
    token = service.machine.ask("cat", "/etc/wingshape/monitor.token")
    wait_for(lambda: service.machine.run(python, "-c", ask).returncode == 0, 20.0)
    assert json.loads(service.machine.ask(python, "-c", ask)) == 401
    told = json.loads(service.machine.ask(python, "-c", ask, token))
    assert told["go"] is False
    assert any("ptp" in reason["name"] for reason in told["reasons"])
    assert told["health"]["state"] == "recording"
    assert service.machine.show("wingcap-monitor", "User", "NRestarts") == {
        "User": "wingshape-monitor",
        "NRestarts": "0",
    }
    service.machine.ask("systemctl", "stop", "wingcap-monitor")


def test_a_word_stops_and_starts_it_and_idleness_is_no_fault(service):
    service.records(20)
    service.machine.ask(WINGCAP, "stop")
    wait_for(lambda: service.health()["state"] == "idle", 15.0)
    time.sleep(service.watchdog_s + 2.0)
    assert service.show("ActiveState", "NRestarts") == {"ActiveState": "active", "NRestarts": "0"}
    service.machine.ask(WINGCAP, "start")
    wait_for(lambda: service.health()["state"] == "recording", 15.0)
    service.stop()
    assert [service.verify(flight) for flight in service.flights()] == [0, 0]


def test_units_verify_and_are_confined(installed):
    units = ("wingcap.service", "wingcap-monitor.service", "wingshape-ptp4l.service", "wingshape-phc2sys.service")
    paths = [f"/etc/systemd/system/{unit}" for unit in (*units, "mnt-ssd_left.mount", "mnt-ssd_right.mount")]
    checked = installed.run("systemd-analyze", "verify", "--recursive-errors=yes", *paths)
    assert checked.returncode == 0, checked.stderr
    for path, tenths in zip(paths, (20, 20, 30, 30), strict=False):
        judged = installed.run("systemd-analyze", "security", "--offline=true", f"--threshold={tenths}", path)
        assert judged.returncode == 0, judged.stdout[-300:]


def test_install_is_idempotent_and_keeps_what_was_edited(installed):
    again = json.loads(installed.ask(WINGCAP, "install", "--json"))
    files = {action["target"]: action["what"] for action in again["actions"] if action["target"].startswith("/")}
    edited = {f"/{CONFIG}", "/etc/wingshape/ptp4l.conf", "/etc/wingshape/ptp.env"}
    assert {path for path, what in files.items() if what == "kept"} == edited
    assert {files[path] for path in files.keys() - edited} == {"unchanged"}
    assert installed.ask("systemctl", "is-enabled", "wingcap", "wingcap-monitor").split() == ["enabled", "enabled"]
    assert installed.ask("stat", "-c", "%a %U", "/etc/wingshape/monitor.token") == "600 root"
