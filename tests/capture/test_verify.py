"""A recording that is not whole is never certified, and every tool says so in one line."""

import json
import os
import random
import shutil
import threading
from pathlib import Path

import pytest

from capture.clock import SystemClock
from capture.config import load_config
from capture.daemon import Recording
from capture.disk import SystemDisk
from capture.errors import RecordingError, UsageError
from capture.stop_rule import StopRule
from capture.verify import inspect


@pytest.fixture
def flight(write_config, rig, tmp_path) -> Path:
    rig.missed = {("left_cam1", 2)}
    Recording(load_config(write_config()), SystemClock(), SystemDisk(), lambda _: None).run(
        StopRule(threading.Event(), 6)
    )
    assert inspect([tmp_path]).problems == []
    return tmp_path


def test_one_flipped_bit_anywhere_is_found(flight):
    for name in ("left_0000.mcap", "aux_0000.mcap"):
        path = flight / "ssd_left/test" / name
        clean = path.read_bytes()
        sites = random.Random(7).sample(range(len(clean)), 150)
        for at in [*sites, *range(len(clean) - 60, len(clean))]:
            broken = bytearray(clean)
            broken[at] ^= 1 << at % 8
            path.write_bytes(broken)
            assert inspect([flight / "ssd_left"]).problems[0].startswith(str(path)), (
                f"{name}: bit {at % 8} of byte {at}"
            )
        path.write_bytes(clean)


def test_a_flipped_pixel_is_named_with_its_trigger(flight):
    path = flight / "ssd_left/test/left_0000.mcap"
    data = bytearray(path.read_bytes())
    data[data.rindex(b"mono8") + 500] ^= 1
    path.write_bytes(data)
    problems = inspect([flight]).problems
    assert "differs from its CRC" in problems[0]
    assert any("neither recorded nor booked as lost" in problem for problem in problems)


@pytest.mark.parametrize("keep", [0, 5, 100, 5000, 20000, -1, -40, -3000])
def test_a_truncated_file_is_not_whole_and_gives_what_it_has(flight, keep):
    path = flight / "ssd_left/test/left_0000.mcap"
    data = path.read_bytes()
    path.write_bytes(data[:keep] if keep else b"")
    report = inspect([flight])
    assert not report.whole
    assert str(path) in report.problems[0]
    assert report.cameras["right/cam0"].recorded == 6


def test_a_zero_tail_is_not_whole(flight):
    path = flight / "ssd_left/test/left_0000.mcap"
    os.truncate(path, path.stat().st_size // 2 // 4096 * 4096)
    os.truncate(path, path.stat().st_size + 100_000)
    report = inspect([flight])
    assert "without its closing records" in report.problems[0]
    assert report.cameras["left/cam0"].recorded > 0


def test_a_missing_loss_record_is_found(flight):
    for side in ("left", "right"):
        (flight / f"ssd_{side}/test/aux_0000.mcap").unlink()
    assert any("board's final count" in problem for problem in inspect([flight]).problems)


def test_one_disk_alone_says_that_the_other_is_missing(flight):
    problems = inspect([flight / "ssd_left"]).problems
    assert problems == [f"right/cam{n}: the folder of its disk was not given: name it too" for n in (0, 1)]


def test_two_flights_are_not_taken_for_one(flight, tmp_path_factory):
    other = tmp_path_factory.mktemp("other")
    shutil.copytree(flight / "ssd_left/test", other / "x")
    aux = other / "x/aux_0000.mcap"
    aux.write_bytes(aux.read_bytes().replace(b"test-", b"tesu-"))
    for path in (other / "x").glob("left_*.mcap"):
        path.unlink()
    with pytest.raises(UsageError, match="2 different flights"):
        inspect([flight, other])


def test_nothing_to_read_is_an_error(tmp_path):
    with pytest.raises(RecordingError, match="no recording"):
        inspect([tmp_path])
    with pytest.raises(RecordingError, match="no such folder"):
        inspect([tmp_path / "none"])


def test_verify_and_info_as_a_user_sees_them(flight, wingcap):
    good = wingcap("verify", flight)
    assert good.returncode == 0
    assert "WHOLE: 6 triggers × 4 cameras = 23 recorded + 1 lost" in good.stdout
    figures = json.loads(wingcap("info", flight, "--json").stdout)
    assert (figures["triggers"], figures["frames_recorded"], figures["frames_lost"]) == (6, 23, 1)
    os.truncate(flight / "ssd_left/test/left_0000.mcap", 30_000)
    bad = wingcap("verify", flight)
    assert bad.returncode == 1
    assert bad.stderr.startswith("error: the recording is not whole")
    assert "Traceback" not in bad.stderr
    empty = flight / "empty"
    empty.mkdir()
    for command in ("verify", "info"):
        answer = wingcap(command, empty)
        assert (answer.returncode, answer.stderr.count("\n")) == (1, 1)
        assert str(empty) in answer.stderr
