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
    assert service.show("ActiveState", "NRestarts") == {"ActiveState": "active", "NRestarts": "0"}
    service.machine.ask("rm", "/mnt/ssd_left/ballast")
    service.machine.run("systemctl", "stop", "wingcap")
    flight = service.flights()[0]
    assert service.verify(flight) == 0


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
    assert files.pop(f"/{CONFIG}") == "kept"
    assert set(files.values()) == {"unchanged"}
    assert installed.ask("systemctl", "is-enabled", "wingcap", "wingcap-monitor").split() == ["enabled", "enabled"]
    assert installed.ask("stat", "-c", "%a %U", "/etc/wingshape/monitor.token") == "600 root"
