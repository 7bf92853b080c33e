"""Whatever was done to a recording, every frame that is whole on the disk comes back, and the copy is certified."""

import os
import threading
from pathlib import Path

import pytest

from capture.clock import SystemClock
from capture.config import load_config
from capture.daemon import Recording
from capture.disk import SystemDisk
from capture.errors import RecordingError, UsageError
from capture.recover import recover_flight
from capture.stop_rule import StopRule
from capture.verify import inspect

SLOT = 8192  # of a 64×48 frame


@pytest.fixture
def flight(write_config, rig, tmp_path) -> Path:
    Recording(load_config(write_config()), SystemClock(), SystemDisk(), lambda _: None).run(
        StopRule(threading.Event(), 8)
    )
    return tmp_path


def damage(path: Path, kind: str) -> int:
    """Damage a file of 16 frames; how many whole frames it still holds."""
    data = bytearray(path.read_bytes())
    first = data.index(b"mono8") // 4096 * 4096  # the first frame's slot
    end = first + 16 * SLOT
    if kind == "torn chunk":
        path.write_bytes(data[: first + 10 * SLOT + 5000])
        return 10
    if kind == "no summary":
        path.write_bytes(data[:end])
        return 16
    if kind == "zero tail":
        path.write_bytes(data[: first + 7 * SLOT] + bytes(100 * 4096))
        return 7
    if kind == "hole":
        data[first + 4 * SLOT + 100 : first + 6 * SLOT + 100] = os.urandom(2 * SLOT)
    elif kind == "zero hole":
        data[first + 4 * SLOT : first + 6 * SLOT] = bytes(2 * SLOT)
    path.write_bytes(data)
    return 14


@pytest.mark.parametrize("kind", ["torn chunk", "no summary", "zero tail", "hole", "zero hole"])
def test_every_whole_frame_comes_back(flight, tmp_path, kind):
    path = flight / "ssd_left/test/left_0000.mcap"
    whole = damage(path, kind)
    before = path.read_bytes()
    result = recover_flight([flight / "ssd_left", flight / "ssd_right"], tmp_path / "copy")
    assert result.frames == whole + 16
    assert result.missing == 16 - whole
    assert not result.clean
    assert path.read_bytes() == before
    copy = inspect([tmp_path / "copy"])
    assert copy.problems == []
    assert (copy.recorded, copy.lost) == (whole + 16, 16 - whole)


def test_a_recording_that_was_never_closed(flight, tmp_path, wingcap):
    """As after a kill: no file has a summary, aux ends early."""
    for side in ("left", "right"):
        damage(flight / f"ssd_{side}/test/{side}_0000.mcap", "torn chunk")
        aux = flight / f"ssd_{side}/test/aux_0000.mcap"
        aux.write_bytes(aux.read_bytes()[:-900])
    answer = wingcap("recover", flight / "ssd_left", flight / "ssd_right", "-o", tmp_path / "copy")
    assert answer.returncode == 3
    assert "20 complete frames recovered" in answer.stdout
    assert wingcap("verify", tmp_path / "copy").returncode == 0


def test_a_whole_recording_is_clean(flight, tmp_path, wingcap):
    answer = wingcap("recover", flight / "ssd_left", flight / "ssd_right", "-o", tmp_path / "copy")
    assert answer.returncode == 0
    assert "32 complete frames recovered" in answer.stdout


def test_nothing_to_give_back(tmp_path, wingcap):
    folder = tmp_path / "flight"
    folder.mkdir()
    with pytest.raises(RecordingError):
        recover_flight([folder], tmp_path / "copy")
    (folder / "left_0000.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(5000))
    assert wingcap("recover", folder, "-o", tmp_path / "copy").returncode == 1


def test_a_copy_is_never_written_over(flight, tmp_path):
    (tmp_path / "copy").mkdir()
    with pytest.raises(UsageError, match="exists already"):
        recover_flight([flight], tmp_path / "copy")


@pytest.mark.parametrize("opcode", [0x80, 0x07, 0x06])
@pytest.mark.parametrize("byte", [1, 2, 3, 8])
def test_a_flipped_bit_in_a_length_costs_one_frame_at_most(flight, tmp_path, opcode, byte):
    """The length of a damaged record leads anywhere; the search goes on right behind its first byte."""
    path = flight / "ssd_left/test/left_0000.mcap"
    data = bytearray(path.read_bytes())
    at, records = 8, []
    while data[at] != 0x0F:
        records.append((data[at], at))
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
    data[[place for kind, place in records if kind == opcode][5] + byte] ^= 1
    path.write_bytes(data)
    result = recover_flight([flight / "ssd_left", flight / "ssd_right"], tmp_path / "copy")
    assert result.frames >= 31
    assert inspect([tmp_path / "copy"]).problems == []
