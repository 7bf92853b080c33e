"""The aiming aid beside a recorder at work."""

import json
import signal
import subprocess
import time
from pathlib import Path

import pytest
from field import command, field_in

from capture.health import read_health


def aim(*words: object) -> str:
    answer = subprocess.run(command("process", "aim", *words), capture_output=True, text=True, timeout=60)
    assert answer.returncode == 0, answer.stderr
    return answer.stdout


def takes(process: subprocess.Popen[str], number: signal.Signals) -> bool:
    """Whether a process has a handler of its own for a signal."""
    status = Path(f"/proc/{process.pid}/status").read_text()
    (caught,) = (int(line.split()[1], 16) for line in status.splitlines() if line.startswith("SigCgt:"))
    return bool(caught >> (number - 1) & 1)


@pytest.mark.slow
def test_live_beside_a_recorder_and_then_from_its_flight(tmp_path):
    with field_in(tmp_path, scale=4) as field:
        field.start_rig()
        field.start_recorder()
        deadline_s = time.monotonic() + 30
        while (health := read_health(field.health)) is None or health.triggers < 25:
            assert time.monotonic() < deadline_s
            time.sleep(0.1)
        live = subprocess.Popen(
            command("process", "aim", "--health", field.health),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        while not takes(live, signal.SIGTERM):  # it has started, however long that took
            assert live.poll() is None
            time.sleep(0.1)
        time.sleep(4)
        live.send_signal(signal.SIGINT)
        shown, complained = live.communicate(timeout=20)
        assert (live.returncode, complained) == (0, "")
        assert "right/cam1" in shown
        seen = json.loads(aim("--health", field.health, "--json"))
        assert field.recorded()["failures"] == []
    flight = json.loads(aim(tmp_path / "ssd_left/test_07", tmp_path / "ssd_right/test_07", "--at", 0.8, "--json"))
    for found in (seen, flight):
        assert [camera["camera"] for camera in found] == ["left/cam0", "left/cam1", "right/cam0", "right/cam1"]
        assert {camera["exposure_us"] for camera in found} == {2000}
        assert min(camera["markers"] for camera in found) >= 16  # of 18: at this size two may run into each other
