"""The accuracy test's pictures: what is promised is there, and stands where it is said to."""

import json

import cv2
import numpy as np
import pytest

from hw_sim import optics
from hw_sim.accuracy_scenes import SIDE, accuracy_world, write_accuracy_scenes


def test_a_longer_lens_distorts_each_place_of_the_image_alike():
    wide, long = (accuracy_world(3, focal).camera(SIDE, "cam0") for focal in (3.5, 7.0))
    body = np.array(wide.T_body_cam)
    point = np.array([[0.2, -0.1, 1.0]])
    near, far = (
        optics.project(camera, p @ body[:3, :3].T + body[:3, 3])
        for camera, p in ((wide, point), (long, point * (1, 1, 2)))
    )
    np.testing.assert_allclose(near, far, atol=1e-9)


@pytest.mark.slow
def test_targets_that_are_in_view_are_written_with_their_places(tmp_path):
    count = write_accuracy_scenes(5, 6.75, (0.75, 2.0), tmp_path)
    stated = json.loads((tmp_path / "truth.json").read_text())
    # at 0.75 m the board of 0.33 m is wider than what both lenses of 6.75 mm see
    assert [(t["kind"], t["z_mm"]) for t in stated["targets"]] == [("lights", 750), ("board", 2000), ("lights", 2000)]
    assert count == len(list(tmp_path.rglob("*.png"))) == 2 * (15 + 3)
    camera = accuracy_world(5, 6.75).camera(SIDE, "cam0")
    body = np.array(camera.T_body_cam)
    lights = np.array(stated["targets"][2]["points_m"])
    image = cv2.imread(str(tmp_path / "target" / "lights_2000_cam0.png"), cv2.IMREAD_GRAYSCALE)
    for u, v in optics.project(camera, lights @ body[:3, :3].T + body[:3, 3]):
        assert image[round(v), round(u)] > 60
