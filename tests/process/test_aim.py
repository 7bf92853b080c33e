"""The aiming aid against pictures whose blur, brightness and light are known from how they were made.

Blurred discs are integrated here by brute force; whole wings come from the simulation's renderer.
"""

import json
import subprocess
import threading
import time

import cv2
import numpy as np
import pytest
from field import command
from scipy.ndimage import gaussian_filter

from capture.clock import SystemClock
from capture.health import CameraHealth, Health, read_health, write_health
from capture.preview import PreviewWriter
from capture.recorder import FrameItem
from capture.ring import Ring
from capture.segment import SealedFrame
from hw_sim.render import LiveRenderer, noise_frames
from hw_sim.world import World
from process.aim import judge_look
from process.look import look_at

FINE = 8  # subpixels a side of the brute-force rendering


def disc_profile(radius_px: float, blur_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Brightness of a blurred disc along a line through its centre, on a fine grid."""
    half = int((radius_px + 6 * blur_px + 4) * FINE)
    y, x = np.mgrid[-half : half + 1, -half : half + 1] / FINE
    disc = (np.hypot(x, y) <= radius_px).astype(float)
    blurred = gaussian_filter(disc, blur_px * FINE)
    line = blurred[half, half:]
    return np.arange(len(line)) / FINE, line / line[0]


def true_radius_px(radius_px: float, blur_px: float, level: float) -> float:
    r, light = disc_profile(radius_px, blur_px)
    return float(np.interp(-level, -light, r))


def scene(radius_px: float, blur_px: float, amplitude: float, background: float = 5.0, seed: int = 0) -> np.ndarray:
    """Twelve discs at odd places, with read-out noise."""
    rng = np.random.default_rng(seed)
    size = (240, 320)
    fine = np.zeros((size[0] * FINE, size[1] * FINE), np.float32)
    for i in range(4):
        for j in range(3):
            u, v = 40 + 80 * i + rng.uniform(-0.5, 0.5), 40 + 80 * j + rng.uniform(-0.5, 0.5)
            cv2.circle(fine, (round((u + 0.5) * FINE), round((v + 0.5) * FINE)), round(radius_px * FINE), 1.0, -1)
    fine = gaussian_filter(fine, blur_px * FINE)
    mean = fine.reshape(size[0], FINE, size[1], FINE).mean(axis=(1, 3))
    mean *= amplitude / mean.max()
    return np.clip(mean + background + rng.normal(0, 1.0, size), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("radius", "blur"), [(3.0, 0.8), (4.0, 1.5), (3.0, 3.0), (6.0, 1.0)])
def test_size_and_edge_are_those_of_the_blurred_disc(radius, blur):
    look = look_at(scene(radius, blur, 160.0))
    assert look.markers == 12
    pixel = 0.35  # a pixel is a mean over its square and over the ring around it
    assert look.diameter_px == pytest.approx(2 * true_radius_px(radius, blur, 0.5), abs=2 * pixel)
    edge = true_radius_px(radius, blur, 0.2) - true_radius_px(radius, blur, 0.8)
    assert edge - 0.1 < look.edge_px < np.hypot(edge, 2 * pixel) + 0.1
    assert look.circularity > 0.85
    assert look.halo < 0.05


def test_the_edge_is_least_in_focus_and_grows_with_every_turn_away():
    edges = [look_at(scene(3.0, blur, 160.0)).edge_px for blur in (0.6, 1.0, 1.6, 2.4, 3.5)]
    assert edges == sorted(edges)
    blurred = judge_look("c", look_at(scene(3.0, 3.5, 160.0)), 12)
    assert [advice.what for advice in blurred.advice] == ["blurred"]
    assert judge_look("c", look_at(scene(3.0, 0.8, 160.0)), 12).good


def test_saturation_is_counted_and_the_exposure_that_cures_it_is_told():
    """Twice as bright as the sensor holds: what the fit sees behind the clipped tops leads back below it."""
    image = scene(3.0, 1.0, 420.0)
    look = look_at(image)
    assert look.saturated_share == np.mean(image >= 250)
    assert look.saturated_markers == 12
    found = judge_look("c", look, 12, exposure_us=4000)
    assert found.advice[0].what == "over_exposed"
    told_us = int(found.advice[0].text.split("exposure_us to ")[1].split()[0])
    assert look_at(scene(3.0, 1.0, 420.0 * told_us / 4000)).saturated_markers == 0


def test_at_the_shortest_exposure_the_aperture_is_to_be_closed():
    found = judge_look("c", look_at(scene(3.0, 1.0, 420.0)), 12, exposure_us=1000)
    assert "close the aperture by" in found.advice[0].text
    assert "exposure_us" not in found.advice[0].text


def test_dim_markers_want_light():
    found = judge_look("c", look_at(scene(3.0, 1.0, 45.0)), 12, exposure_us=1500)
    assert [advice.what for advice in found.advice] == ["dim"]
    assert "set exposure_us to 5" in found.advice[0].text


def test_what_is_missing_and_what_shines_besides():
    look = look_at(scene(3.0, 1.0, 160.0))
    assert judge_look("c", look, 18).advice[0].what == "missing"
    assert judge_look("c", look, 10).advice[0].what == "extra"
    dark = np.full((240, 320), 5, np.uint8)
    assert [advice.what for advice in judge_look("c", look_at(dark), 18).advice] == ["no_markers"]


def frame(exposure_us: int, background: str = "dark", finish: str = "matt") -> np.ndarray:
    world = World.make(seed=3, scale=2, background=background, finish=finish)
    renderer = LiveRenderer(world, world.cameras[0], noise_frames(world, exposure_us, 0.0), exposure_us, 0.0)
    image = np.zeros((world.sensor.height_px, world.sensor.width_px), np.uint8)
    renderer.render(world.epoch_ns + 10**9, image)
    return image


@pytest.mark.parametrize(
    ("exposure_us", "background", "finish", "told"),
    [
        (2000, "dark", "matt", []),
        (10_000, "dark", "matt", ["over_exposed"]),  # Fig. 11
        (400, "dark", "matt", ["dim", "missing"]),
        (2000, "sunlit", "matt", ["sunlit"]),  # Fig. 12, 5 ms
        (10_000, "sunlit", "matt", ["sunlit", "no_markers"]),  # Fig. 12, 10 ms
        (2000, "dark", "clean", ["reflections"]),  # Fig. 13
    ],
)
def test_the_papers_pictures_get_the_papers_advice(exposure_us, background, finish, told):
    found = judge_look("c", look_at(frame(exposure_us, background, finish)), 18, exposure_us)
    assert [advice.what for advice in found.advice] == told


def aim(*words: object, **options: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command("process", "aim", *words), capture_output=True, text=True, timeout=60, **options)


def test_pictures_from_the_command_line(tmp_path):
    cv2.imwrite(str(tmp_path / "good.png"), scene(3.0, 0.8, 160.0))
    cv2.imwrite(str(tmp_path / "dim.png"), scene(3.0, 0.8, 40.0))
    answer = aim(tmp_path / "good.png", tmp_path / "dim.png", "--expected", 12, "--json")
    good, dim = json.loads(answer.stdout)
    assert (good["camera"], good["good"], good["markers"]) == ("good.png", True, 12)
    assert [advice["what"] for advice in dim["advice"]] == ["dim"]
    shown = aim(tmp_path / "dim.png", "--expected", 12).stdout
    assert "dim.png: markers reach" in shown
    (tmp_path / "no.png").write_text("no picture")
    answer = aim(tmp_path / "no.png")
    assert answer.returncode == 1
    assert answer.stderr.startswith("error: ")


def test_no_recorder_is_one_line(tmp_path):
    answer = aim("--health", tmp_path)
    assert (answer.returncode, answer.stdout) == (1, "")
    assert "no recorder has shared its health here" in answer.stderr


def test_previews_of_a_recorder(tmp_path):
    """The shared pictures, by the writer itself, as a recorder would give them."""
    image = scene(3.0, 0.8, 160.0)
    ring = Ring(2, 81920, lock_memory=False)
    writer = PreviewWriter(tmp_path, [("left", "cam0")], image.shape, 2.0, SystemClock())
    slot = ring.take()
    pixels = ring.slot(slot)[: image.size]
    pixels[:] = image.tobytes()
    assert writer.offer(
        FrameItem(("left", "cam0"), 7, ring, slot, SealedFrame(ring.slot(slot), pixels, 0, 0, 0, 0, 0, 0, ()))
    )
    writer.start()
    while ring.free < 2:
        time.sleep(0.01)
    camera = CameraHealth("left", "cam0", 8, {}, 25.0, 0.0, 2, 2, 2, exposure_us=2500)
    ended = threading.Event()

    def write_healths():
        while not ended.wait(0.2):  # as a recorder does: one that is old counts for nothing
            written_s = time.monotonic()
            write_health(
                tmp_path,
                Health(
                    "f", "recording", 1.0, 8, 25.0, (camera,), (), (), previews=("left/cam0",),
                    written_monotonic_s=written_s,
                ),
            )  # fmt: skip

    recorder = threading.Thread(target=write_healths)
    recorder.start()
    while read_health(tmp_path) is None:
        time.sleep(0.01)
    answer = aim("--health", tmp_path, "--expected", 12, "--json")
    ended.set()
    recorder.join()
    writer.stop(5)
    (found,) = json.loads(answer.stdout)
    assert (found["camera"], found["markers"], found["exposure_us"], found["good"]) == ("left/cam0", 12, 2500, True)
