"""Cameras of a recording against those of the rig, in files with the recorder's provenance record."""

import json

import numpy as np
import pytest
from mcap.writer import Writer

from capture.errors import ProcessError
from capture.record import PROVENANCE
from process.flight_cameras import check_cameras, recorded_serials
from process.pipeline import markers

SERIALS = {"left/cam0": "left-0", "left/cam1": "left-1", "right/cam0": "right-0", "right/cam1": "right-1"}


def recording(path, serials):
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        writer.add_metadata("other", {"serials": "nonsense"})
        if serials is not None:
            writer.add_metadata(PROVENANCE, {"serials": serials if isinstance(serials, str) else json.dumps(serials)})
        writer.finish()
    return path


def test_the_rigs_cameras_pass(tmp_path, world):
    files = [recording(tmp_path / "left.mcap", SERIALS)]
    assert recorded_serials(files) == SERIALS
    check_cameras(files, world.rig)


@pytest.mark.parametrize("serials", [None, "{", "[1]", "{}", {"left/cam0": ""}, {"tail/cam0": "77"}])
def test_what_is_not_known_passes(tmp_path, world, serials):
    check_cameras([recording(tmp_path / "left.mcap", serials)], world.rig)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes((tmp_path / "left.mcap").read_bytes()[:20])
    check_cameras([cut], world.rig)


def test_swapped_and_foreign_cameras_are_named(tmp_path, world):
    swapped = {**SERIALS, "left/cam0": "left-1", "left/cam1": "left-0", "right/cam1": "new"}
    files = [recording(tmp_path / "left.mcap", swapped)]
    with pytest.raises(ProcessError) as caught:
        check_cameras(files, world.rig)
    said = str(caught.value)
    assert "left/cam0 is left-1, the rig's left/cam1, not left-0" in said
    assert "left/cam1 is left-0, the rig's left/cam0, not left-1" in said
    assert "right/cam1 is new, which the rig does not know, not right-1" in said
    assert "\n" not in said


def test_markers_are_not_measured_with_swapped_cameras(tmp_path, small_world, recording_writer):
    writer = recording_writer(tmp_path / "left.mcap")
    writer.writer.add_metadata(PROVENANCE, {"serials": json.dumps({"left/cam0": "left-1", "left/cam1": "left-0"})})
    for camera in range(2):
        writer.frame("left", f"cam{camera}", 0, np.zeros((776, 1040), np.uint8), 1_700_000_000_000_000_000)
    writer.close()
    with pytest.raises(ProcessError, match="not where the rig has them"):
        markers([tmp_path], small_world.rig, workers=1)
