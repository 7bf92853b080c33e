"""Frame sets read ahead: the right pixels in order, from page cache, disk, or both in turn."""

import numpy as np
import pytest

from process.read_ahead import loaded
from process.recording import FrameSetReader, open_recording

SETS = 23


def picture(trigger: int, camera: int) -> np.ndarray:
    return np.random.default_rng([trigger, camera]).integers(0, 256, (24, 32), dtype=np.uint8)


@pytest.fixture
def places(tmp_path, recording_writer):
    writer = recording_writer(tmp_path / "left_0000.mcap")
    for trigger in range(SETS):
        for camera in range(2):
            if (trigger, camera) != (7, 1):
                writer.frame(
                    "left", f"cam{camera}", trigger, picture(trigger, camera), 1_700_000_000_000_000_000 + trigger
                )
    writer.close()
    return open_recording([tmp_path]).sides["left"]


@pytest.mark.parametrize("cached", ["all", "none", "in turn", "the first half", "as the system says"])
def test_every_set_has_its_own_pixels(places, cached, monkeypatch):
    def answer(_: FrameSetReader, sets) -> bool:
        (one,) = sets
        number = one.trigger_index
        return {"all": True, "none": False, "in turn": number % 2 == 0, "the first half": number < SETS / 2}[cached]

    if cached != "as the system says":
        monkeypatch.setattr(FrameSetReader, "cached", answer)
    seen = []
    for frame_set in loaded(places):
        seen.append(frame_set.trigger_index)
        for camera, image in enumerate(frame_set.images):
            if (frame_set.trigger_index, camera) == (7, 1):
                assert image is None
            else:
                np.testing.assert_array_equal(image, picture(frame_set.trigger_index, camera))
    assert seen == list(range(SETS))


def test_whoever_stops_half_way_can_begin_anew(places):
    for _, frame_set in zip(range(3), loaded(places), strict=False):
        assert frame_set.problems == ()
    assert [frame_set.trigger_index for frame_set in loaded(places)] == list(range(SETS))
