"""A calibration day on disk: complete, repeatable, and silent about the truth."""

import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.errors import SimulationError
from hw_sim import optics
from hw_sim.sessions import render_survey, survey_points, survey_toml, write_sessions
from hw_sim.world import World


def test_a_session_is_complete_and_repeats_exactly(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    tiny = World.make(seed=3, scale=8)
    count = write_sessions(tiny, tmp_path / "a", 1, lambda done, total: seen.append((done, total)))
    assert count == 64
    assert seen[-1] == (64, 64)
    names = sorted(str(p.relative_to(tmp_path / "a")) for p in (tmp_path / "a").rglob("*") if p.is_file())
    assert len(names) == 65
    assert "board_left/cam0_00.png" in names
    assert "board_right/cam1_14.png" in names
    assert "survey/right_cam0.png" in names
    image = cv2.imread(str(tmp_path / "a/board_left/cam0_00.png"), cv2.IMREAD_UNCHANGED)
    assert image.shape == (194, 260)
    assert image.dtype == np.uint8
    write_sessions(tiny, tmp_path / "b", 2)
    assert all((tmp_path / "a" / n).read_bytes() == (tmp_path / "b" / n).read_bytes() for n in names)


def test_the_survey_names_images_cameras_and_points_but_no_truth(world: World) -> None:
    text = survey_toml(world)
    survey = tomllib.loads(text)
    assert survey["row_time_us"] == 10.0
    assert survey["markers"]["pairs_station_m"] == list(world.leds.pairs_station_m)
    assert survey["markers"]["chord_m"] == [0.04, -0.10]
    for side in ("left", "right"):
        part = survey[side]
        assert part["cam0_image"] == f"survey/{side}_cam0.png"
        assert part["cam1_serial"] == world.camera(side, "cam1").serial
        assert np.linalg.norm(part["approx_outboard"]) == pytest.approx(1.0, abs=1e-5)
        written = np.array([point["xyz_m"] for point in part["points"]])
        error = written - survey_points(world, side)
        assert error.std() == pytest.approx(3e-4, rel=5 / (2 * error.size) ** 0.5)
        assert all(point["sigma_mm"] == 0.3 for point in part["points"])
    for camera in world.cameras:
        for value in (camera.fx, camera.cx, camera.k1, camera.T_body_cam[0][3]):
            assert f"{value:.6f}"[:8] not in text


def test_the_survey_image_shows_each_light_at_its_true_place(world: World) -> None:
    camera = world.camera("left", "cam1")
    image = render_survey(world, camera).astype(float) - world.sensor.black_dn
    for u, v in optics.project(camera, survey_points(world, "left")):
        x, y = round(u), round(v)
        rows, columns = np.mgrid[y - 9 : y + 10, x - 9 : x + 10]
        light = image[rows, columns]
        centroid = [np.sum(light * columns) / light.sum(), np.sum(light * rows) / light.sum()]
        # Rounding after the mean of 8 leaves up to half a grey value of offset over the patch, which is symmetric.
        assert centroid == pytest.approx([u, v], abs=0.25)
        assert image[y, x] > 25


def test_a_folder_that_cannot_be_written_is_named(
    small: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cv2, "imwrite", lambda *_: False)
    with pytest.raises(SimulationError, match=r"cam0_00\.png"):
        write_sessions(World.make(seed=3, scale=8), tmp_path, 1)
