"""The frames shown in a report: which sets, what is drawn where, and what a lost frame does."""

from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest

from process.detect import DetectSettings
from process.recording import FrameSet, FrameSetReader, Recording, SetPlaces
from reconstruct.frame_pictures import WIDTH_PX, Moment, moments, read_frame_pictures, write_frame_pictures
from reconstruct.tables import MARKERS

START_NS = 1_700_000_000_000_000_000
SIZE = (300, 400)


def frames(dz_mm: list[float], residual_mm: list[float]) -> pa.Table:
    sets = len(dz_mm)
    return pa.table(
        {
            "trigger_index": np.arange(10, 10 + sets),
            "side": ["right"] * sets,
            "timestamp_ns": START_NS + np.arange(sets) * 40_000_000,
            "tip_dx_m": np.zeros(sets),
            "tip_dy_m": np.zeros(sets),
            "tip_dz_m": np.array(dz_mm) * 1e-3,
            "residual_rms_mm": np.array(residual_mm),
        }
    )


def test_moments_are_at_rest_furthest_and_worst() -> None:
    table = frames([5, 1, 0, 300, -400, np.nan], [0.1, 0.1, 0.1, 0.9, 0.2, np.nan])
    found = moments(table, (START_NS + 40_000_000, START_NS + 120_000_000))
    assert [(one.trigger_index, one.why) for one in found] == [
        (12, "at rest"),
        (14, "tip furthest away"),
        (13, "largest residual"),
    ]
    assert found[1].time_s == pytest.approx(0.16)


def test_one_set_that_is_all_of_it_is_shown_once() -> None:
    (only,) = moments(frames([7.0], [0.3]), None)
    assert only.why == "the first set and tip furthest away and largest residual"
    (blind,) = moments(frames([np.nan], [np.nan]), None)
    assert blind.why == "the first set"


@pytest.fixture
def recording(monkeypatch: pytest.MonkeyPatch) -> Recording:
    """Two lights, of which one is a marker, and a streak; cam1's frame is lost."""
    image = np.full(SIZE, 8, np.uint8)
    for at in ((120, 90), (200, 160)):
        cv2.circle(image, at, 5, 220, -1)
    cv2.line(image, (300, 60), (345, 70), 230, 3)
    image = cv2.GaussianBlur(image, (0, 0), 1.5)
    places = SetPlaces("right", 10, (None, None), (None, None))

    def read(_reader: FrameSetReader, _places: SetPlaces) -> FrameSet:
        return FrameSet("right", 10, (image, None), (None, None), (None, None))

    monkeypatch.setattr(FrameSetReader, "read", read)
    return Recording({"right": (places,)}, (), ())


def test_markers_other_lights_and_rejected_spots_are_told_apart(recording: Recording, tmp_path: Path) -> None:
    nowhere = float("nan")
    pa.parquet.write_table(
        pa.table(
            {
                "trigger_index": [10, 10],
                "side": ["right", "right"],
                "marker": pa.array([4, 5], pa.int32()),
                "flags": ["", "not_seen"],
                "u0_px": [120.0, nowhere],
                "v0_px": [90.0, nowhere],
                "u1_px": [100.0, nowhere],
                "v1_px": [90.0, nowhere],
            }
        ),
        tmp_path / MARKERS,
    )
    (tmp_path / "figures").mkdir()
    shown = [
        Moment("right", 10, 1.5, "at rest"),
        Moment("right", 99, 2.5, "largest residual"),
        Moment("left", 1, 0, ""),
    ]
    (made,) = write_frame_pictures(recording, shown, tmp_path, DetectSettings())
    assert (made.side, made.camera, made.markers, made.one_camera, made.other_lights) == ("right", "cam0", 1, 0, 1)
    assert sum(made.rejected.values()) == 1
    assert "1.50 s, trigger 10" in made.caption
    assert read_frame_pictures(tmp_path) == [made]
    picture = cv2.imread(str(tmp_path / "figures" / made.file))
    assert picture.shape[1] == WIDTH_PX
    assert picture.shape[0] == pytest.approx(WIDTH_PX * SIZE[0] / SIZE[1], abs=2)
    blue, green, red = (picture[..., at].astype(int) for at in range(3))
    assert ((blue - red > 60) & (green - red > 30)).sum() > 50  # the marker's circle and number
    assert (red - blue > 60).sum() > 30  # the streak's cross and reason
    assert (tmp_path / "figures" / made.file).stat().st_size < 400_000


def test_a_result_without_frames(tmp_path: Path) -> None:
    assert read_frame_pictures(tmp_path) is None
