"""Two recorders never share a disk, and a lock never outlives its process."""

import os
import subprocess
import sys

import pytest

from capture.errors import CaptureError
from capture.lock import recorder_at, sole_recorder

HOLD = """
import sys, time
from pathlib import Path
from capture.lock import sole_recorder
with sole_recorder([Path(word) for word in sys.argv[1:]]):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def disks(tmp_path):
    for name in ("left", "right"):
        (tmp_path / name).mkdir()
    return [tmp_path / "left", tmp_path / "right"]


@pytest.fixture
def other(disks):
    """Another process that records to the left disk."""
    process = subprocess.Popen([sys.executable, "-c", HOLD, disks[0]], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.communicate()


def test_the_second_is_refused_and_told_who_holds_it(disks, other):
    assert recorder_at(disks[0]) == other.pid
    assert recorder_at(disks[1]) is None
    with (
        pytest.raises(CaptureError, match=rf"left: another recorder is writing there \(process {other.pid}\)"),
        sole_recorder(disks),
    ):
        pass
    assert recorder_at(disks[1]) is None  # what it had got it has given back


def test_a_killed_holder_holds_nothing(disks, other):
    other.kill()
    other.wait()
    with sole_recorder(disks):
        assert recorder_at(disks[0]) == os.getpid()


def test_a_disk_that_is_not_there_is_passed_over(tmp_path):
    with sole_recorder([tmp_path / "nowhere"]):
        pass
    assert recorder_at(tmp_path / "nowhere") is None
