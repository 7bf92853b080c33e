"""A configuration that cannot be used is refused in one line that names the file and the key."""

import threading

import pytest

from capture.clock import SystemClock
from capture.config import DRIVER_BUFFERS, load_config
from capture.daemon import Recording
from capture.disk import SystemDisk
from capture.errors import ConfigError, DiskError, UsageError
from capture.stop_rule import StopRule


def test_defaults_and_relative_paths(write_config, tmp_path):
    config = load_config(write_config(rate_hz=25)).config
    assert config.disks.left == tmp_path / "ssd_left"
    assert config.ring_slots == 13 + DRIVER_BUFFERS  # 0.5 s of stall at 25 Hz, and what the driver holds


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("[ring]", "[ring]\ncolour = 3", "unknown key `ring.colour`"),
        ("rate_hz = 100.0", "rate_hz = -1", "`trigger.rate_hz`"),
        ("rate_hz = 100.0", "", ""),
        ('backend = "fake"', 'backend = "film"', "backend 'film' is unknown"),
        ('backend = "fake"', "", "key `camera.backend` is missing"),
        ('side = "right"', 'side = "left"', "named twice"),
        ("[trigger]", "[trigger", "not a TOML file"),
        ('flight = "test"', 'flight = "../up"', "`flight`"),
        ('flight = "test"', 'calibration = "rig.json"', "the calibration named in"),
        ('right = "ssd_right"', 'right = "./ssd_left"', "are the same folder"),
        ("rate_hz = 100.0", "first_index = 4294967290", "`trigger.first_index`"),
    ],
)
def test_refusals(write_config, wingcap, old, new, says):
    path = write_config()
    path.write_text(path.read_text().replace(old, new))
    if not says:
        assert load_config(path).config.trigger.rate_hz == 25.0
        return
    with pytest.raises(ConfigError) as refusal:
        load_config(path)
    assert str(path) in str(refusal.value)
    assert says in str(refusal.value)
    answer = wingcap("record", "--config", path)
    assert (answer.returncode, answer.stderr.count("\n")) == (2, 1)


def test_a_missing_file(tmp_path, wingcap):
    answer = wingcap("record", "--config", tmp_path / "none.toml")
    assert answer.returncode == 2
    assert answer.stderr.startswith(f"error: {tmp_path}/none.toml: cannot be read (No such file or directory)")
    assert answer.stderr.count("\n") == 1
    assert wingcap("record").returncode == 2
    assert wingcap("nonsense").returncode == 2


def test_rings_that_do_not_fit_into_memory_are_refused_before_they_are_touched(write_config, wingcap):
    path = write_config(rate_hz=200)
    text = path.read_text().replace("stall_s = 0.5", "stall_s = 60").replace("width = 64", "width = 16000")
    path.write_text(text.replace("height = 48", "height = 16000"))
    with pytest.raises(UsageError, match=r"the rings need \d+\.\d GB"):
        Recording(load_config(path), SystemClock(), SystemDisk(), lambda _: None).run(StopRule(threading.Event()))


def test_a_disk_that_is_not_mounted_is_not_recorded_beside(write_config, tmp_path):
    path = write_config()
    (tmp_path / "ssd_right").rmdir()
    with pytest.raises(DiskError, match=r"ssd_right.*mount the disk or make this folder"):
        Recording(load_config(path), SystemClock(), SystemDisk(), lambda _: None).run(StopRule(threading.Event()))


@pytest.mark.parametrize(("exposure_us", "warning"), [(999, "faint"), (1000, None), (5000, None), (5001, "saturate")])
def test_an_exposure_that_does_not_suit_lights_is_told(write_config, rig, exposure_us, warning):
    path = write_config()
    path.write_text(path.read_text().replace("exposure_us = 1000", f"exposure_us = {exposure_us}"))
    found = load_config(path).config.exposure_warning
    assert (found is None) == (warning is None)
    if warning is not None:
        assert warning in found
        assert f"{exposure_us} us" in found


def test_what_a_camera_is_asked_to_be_comes_from_the_configuration(write_config, rig):
    path = write_config()
    keys = 'black_level = 1.5\nshutter_mode = "Rolling"\noffset_y = 8\n'
    keys += 'trigger_line = "Line2"\ntrigger_activation = "FallingEdge"'
    path.write_text(path.read_text().replace("exposure_us = 1000", f"exposure_us = 1000\n{keys}"))
    settings = load_config(path).config.settings
    assert (settings.black_level, settings.shutter_mode, settings.offset_y) == (1.5, "Rolling", 8)
    assert (settings.trigger_line, settings.trigger_activation) == ("Line2", "FallingEdge")
