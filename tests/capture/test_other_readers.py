"""Recordings open in other people's readers: Rerun and @mcap/core (the stock mcap and rosbags: test_recording.py)."""

import json
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from needs import needs_program

from capture.clock import SystemClock
from capture.config import load_config
from capture.daemon import Recording
from capture.disk import SystemDisk
from capture.stop_rule import StopRule

TRIGGERS = 10
SCRIPT = Path(__file__).with_name("read_with_mcap_core.mjs")
pytestmark = pytest.mark.slow


@pytest.fixture
def flight(write_config, rig, tmp_path) -> Path:
    rig.missed = {("left_cam0", 3)}
    stop = StopRule(threading.Event(), TRIGGERS)
    Recording(load_config(write_config()), SystemClock(), SystemDisk(), lambda _: None).run(stop)
    return tmp_path / "ssd_left/test"


def test_mcap_core_reads_every_message(flight, tmp_path):
    needs_program("npm")
    shutil.copy(SCRIPT, tmp_path)
    (tmp_path / "package.json").write_text('{"type": "module"}')
    subprocess.run(["npm", "install", "--no-audit", "--no-fund", "@mcap/core@2"], cwd=tmp_path, check=True, timeout=120)
    for name, topic, count in (
        ("left_0000.mcap", "/left/cam0/image_raw", TRIGGERS - 1),
        ("left_0000.mcap", "/left/cam1/frame", TRIGGERS),
        ("aux_0000.mcap", "/loss", 1),
    ):
        answer = subprocess.run(
            ["node", SCRIPT.name, flight / name], cwd=tmp_path, capture_output=True, text=True, timeout=60
        )
        assert answer.returncode == 0, answer.stderr
        found = json.loads(answer.stdout)
        assert found["indexed"][topic] == count
        assert found["streamed"] == sum(found["indexed"].values())
        assert found["done"]


def test_rerun_finds_nothing_wrong_and_converts(flight, tmp_path):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed (extra `peers`)")
    rerun = Path(sys.executable).with_name("rerun")
    for name in ("left_0000.mcap", "aux_0000.mcap"):
        checked = subprocess.run([rerun, "mcap", "check", flight / name], capture_output=True, text=True, timeout=60)
        assert checked.returncode == 0, checked.stderr
        rows = [line.split() for line in checked.stdout.splitlines() if "/" in line and str(flight) not in line]
        assert rows
        assert {row[0] for row in rows} == {"ok"}
    recording = tmp_path / "flight.rrd"
    words = [rerun, "mcap", "convert", flight / "left_0000.mcap", "-o", recording]
    assert subprocess.run(words, capture_output=True, timeout=60).returncode == 0
    statistics = subprocess.run([rerun, "rrd", "stats", recording], capture_output=True, text=True, timeout=60)
    assert "/left/cam1/image_raw" in statistics.stdout
