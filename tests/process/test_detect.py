"""Detection of rendered spots: centres against the Cramér–Rao bound, and what must be turned down."""

import cv2
import numpy as np
import pytest
from scipy.stats import chi2

from hw_sim.render import render_frame
from hw_sim.spots import led_spots
from hw_sim.wing_motion import LedMotion
from hw_sim.world import World
from process.detect import DetectSettings, detect, detect_all

READ_SIGMA, SHOT_GAIN, AMPLITUDE = 1.5, 0.04, 157.0


def crlb_px(painter, radius: float, blur: float) -> float:
    """Least possible standard deviation of a coordinate, by finite differences of the brute-force rendering."""

    def picture(shift: float) -> np.ndarray:
        canvas = painter(81, 81)
        canvas.add(40.3 + shift, 40.2, radius, blur, AMPLITUDE)
        return canvas.clean

    step = 1e-3
    slope = (picture(step) - picture(-step)) / (2 * step)
    variance = READ_SIGMA**2 + 1 / 12 + SHOT_GAIN * picture(0.0)
    return 1.0 / np.sqrt((slope**2 / variance).sum())


def errors_and_nees(painter, radius: float, blur: float, settings: DetectSettings, pictures: int):
    errors, nees, lost = [], [], 0
    for seed in range(pictures):
        rng = np.random.default_rng(seed)
        canvas = painter(400, 400, seed)
        truth = np.array([(40 + 64 * i, 40 + 64 * j) for i in range(6) for j in range(6)]) + rng.uniform(
            -0.5, 0.5, (36, 2)
        )
        for u, v in truth:
            canvas.add(u, v, radius, blur, AMPLITUDE)
        found = detect(canvas.image(read_sigma=READ_SIGMA, shot_gain=SHOT_GAIN), settings)
        for place in truth:
            apart = found.pixels - place
            nearest = int(np.argmin((apart**2).sum(axis=1))) if len(found) else -1
            if nearest < 0 or np.abs(apart[nearest]).max() > 1:
                lost += 1
                continue
            errors.append(apart[nearest])
            nees.append(apart[nearest] @ np.linalg.inv(found.covariance_px2[nearest]) @ apart[nearest])
    return np.array(errors), np.array(nees), lost


@pytest.mark.parametrize(("radius", "blur"), [(0.3, 0.7), (0.7, 0.7), (2.0, 0.7), (6.0, 0.9)])
def test_centres_are_near_the_bound_and_know_it(painter, radius, blur):
    errors, nees, lost = errors_and_nees(painter, radius, blur, DetectSettings(shot_gain=SHOT_GAIN), 6)
    assert lost == 0
    bound = crlb_px(painter, radius, blur)
    n = errors.size  # 432 coordinates: their RMS is known to 1/√(2n) = 3.4 %, so 1.25 leaves 4 sigmas over 1.1
    assert np.sqrt((errors**2).mean()) < 1.25 * bound
    # no bias beyond chance: 4.5 standard errors
    assert np.all(np.abs(errors.mean(axis=0)) < 4.5 * 1.25 * bound / np.sqrt(n / 2))
    # the covariance says so, too; χ² at 1e-4, widened by 15 % for the pixel integration that the model lacks
    low, high = chi2.ppf([5e-5, 1 - 5e-5], n)
    assert 0.85 * low < nees.sum() < 1.15 * high


@pytest.mark.slow
@pytest.mark.parametrize(("radius", "blur"), [(0.7, 0.7), (1.0, 1.0), (2.0, 0.7), (4.0, 0.8), (6.0, 0.9)])
def test_centres_are_within_a_fifth_of_the_bound(painter, radius, blur):
    errors, _, lost = errors_and_nees(painter, radius, blur, DetectSettings(shot_gain=SHOT_GAIN), 20)
    ratio = np.sqrt((errors**2).mean()) / crlb_px(painter, radius, blur)
    print(
        f"radius {radius} px, blur {blur} px: RMS {np.sqrt((errors**2).mean()):.4f} px = {ratio:.3f} of the bound, "
        f"mean {errors.mean(axis=0).round(4)} px, {errors.size} coordinates"
    )
    assert lost == 0
    assert ratio <= 1.2  # known to 1.9 %


@pytest.mark.parametrize(("radius", "blur"), [(0.7, 0.7), (2.0, 0.7), (6.0, 0.9)])
def test_the_fast_way_is_within_its_stated_factor(painter, radius, blur):
    """1.1 to 1.6 of the bound was measured; windowed centroids have 1.5 to 3 elsewhere."""
    errors, nees, lost = errors_and_nees(painter, radius, blur, DetectSettings(method="fast", shot_gain=SHOT_GAIN), 3)
    assert lost == 0
    assert np.sqrt((errors**2).mean()) < 1.9 * crlb_px(painter, radius, blur)
    assert 0.6 < nees.mean() / 2 < 1.4  # 216 coordinates: one sigma is 10 %


def test_the_covariance_forgives_a_wrong_gain(painter):
    """A quarter less shot noise assumed than there is; most of that comes back through χ²."""
    errors, nees, _ = errors_and_nees(painter, 1.5, 0.8, DetectSettings(shot_gain=0.03), 4)
    assert 0.75 < nees.sum() / errors.size < 1.3  # 288 coordinates: 8 % is one sigma


def test_the_papers_way_works_on_large_spots_and_loses_small_ones(painter):
    """Errata of eq. 3: with the contour's polygon area, discs of radius 1 px do not pass C > 0.8."""
    paper = DetectSettings(method="paper")
    errors, _, lost = errors_and_nees(painter, 6.0, 0.7, paper, 1)
    assert lost == 0
    assert 0.02 < np.sqrt((errors**2).mean()) < 0.25
    small = np.zeros((60, 60), np.uint8)
    small[30, 29:32] = small[29:32, 30] = 200
    assert len(detect(small, paper)) == 0
    assert [r.reason for r in detect(small, paper).rejected] == ["not round"]


@pytest.mark.parametrize("radius", [0.3, 1.0, 1.5, 2.0, 3.0, 6.0])
def test_no_round_spot_is_lost_to_the_shape_gate(painter, radius):
    _, _, lost = errors_and_nees(painter, radius, 0.7, DetectSettings(), 2)
    assert lost == 0


def reasons(image, **options) -> list[str]:
    return sorted(r.reason for r in detect(image, DetectSettings(**options)).rejected)


def test_hot_pixels_streaks_and_the_border_are_turned_down(painter):
    canvas = painter(300, 300)
    canvas.add(150, 150, 2, 0.8, 150)
    canvas.add(298.5, 60, 2, 0.8, 150)  # runs over the border
    for k in range(24):
        canvas.clean[220, 40 + k] += 120  # a streak
    image = canvas.image()
    image[60, 60] = 255  # a hot pixel
    image[61, 200] = 90
    found = detect(image)
    assert len(found) == 1
    assert reasons(image) == ["border", "elongated", "hot pixel", "hot pixel"]


def test_a_reflection_beside_its_light_is_turned_down(painter):
    canvas = painter(200, 200)
    canvas.add(80.0, 80.0, 2, 0.8, 170)
    canvas.add(81.0, 92.0, 2, 0.8, 40)  # weaker, below its light
    canvas.add(150.0, 80.0, 2, 0.8, 40)  # as weak, but on its own
    found = detect(canvas.image())
    assert np.allclose(np.sort(found.u_px), [80, 150], atol=0.2)
    assert [r.reason for r in found.rejected] == ["reflection"]


def test_two_lights_that_run_into_each_other_are_two(painter):
    errors = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        canvas = painter(80, 80, seed)
        truth = np.array([[40.0, 40.0], [44.6, 41.5]]) + rng.uniform(-0.5, 0.5, 2)
        for u, v in truth:
            canvas.add(u, v, 0.8, 0.9, 150)
        found = detect(canvas.image())
        assert len(found) == 2
        errors.append(found.pixels[np.argsort(found.u_px)] - truth)
    # single spots of this size have 0.01 px; the light of the neighbour costs a little
    assert np.sqrt(np.mean(np.square(errors))) < 0.02
    assert np.abs(np.mean(errors, axis=0)).max() < 0.012


def test_saturated_cores_are_flagged_and_still_centred(painter):
    errors = []
    for seed in range(20):
        canvas = painter(80, 80, seed)
        u, v = 40 + np.random.default_rng(seed).uniform(-0.5, 0.5, 2)
        canvas.add(u, v, 3, 0.9, 600)
        found = detect(canvas.image())
        assert found.flags == ("saturated",)
        errors.append(found.pixels[0] - (u, v))
    assert np.sqrt(np.mean(np.square(errors))) < 0.02


def test_a_sunlit_background_is_taken_off(painter):
    canvas = painter(600, 600, 3)
    truth = np.array([[100.2, 100.3], [300.4, 480.1], [520.3, 200.8]])
    for u, v in truth:
        canvas.add(u, v, 1.5, 0.8, 110)
    ramp = np.linspace(0, 110, 600)[None, :] + 12 * np.sin(np.arange(600) / 60)[:, None] + 12
    canvas.clean += ramp
    found = detect(canvas.image(background=0))
    assert len(found) == 3
    order = np.argsort(found.u_px)
    np.testing.assert_allclose(found.pixels[order], truth, atol=0.12)  # 4 sigma with the background's shot noise


@pytest.mark.parametrize("method", ["default", "paper"])
@pytest.mark.parametrize("image", [np.zeros((40, 50), np.uint8), np.full((40, 50), 255, np.uint8)])
def test_an_empty_or_white_frame_has_no_lights(image, method):
    assert len(detect(image, DetectSettings(method=method))) == 0


def test_a_frame_of_noise_is_bounded():
    image = np.random.default_rng(1).integers(0, 256, (800, 800), dtype=np.uint8)
    found = detect(image)
    assert len(found) + len(found.rejected) < 3000


def test_rows_that_are_not_contiguous(painter):
    """Images of another recorder may have a stride."""
    canvas = painter(64, 64)
    canvas.add(30, 31, 2, 0.8, 150)
    image = np.zeros((64, 80), np.uint8)
    image[:, :64] = canvas.image()
    np.testing.assert_allclose(detect(image[:, :64]).pixels, [[30, 31]], atol=0.05)


def test_an_image_need_not_outlive_its_turn(painter):
    """All in one memory, each overwritten by the next: pairs, hot pixels, large ones, and lights at the border."""
    images = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        canvas = painter(400, 500, seed)
        for u, v, radius in rng.uniform((-5, -5, 0.3), (505, 405, 9.0), (30, 3)):
            canvas.add(u, v, radius, 0.8, rng.uniform(60, 400))
        if seed % 2:
            canvas.clean += np.linspace(0, 110, 500)[None, :]
        image = canvas.image(read_sigma=READ_SIGMA)
        image[rng.integers(0, 400, 5), rng.integers(0, 500, 5)] = 255
        images.append(image)
    memory = np.empty_like(images[0])

    def given():
        for image in images:
            memory[:] = image
            yield memory
            memory[:] = 255

    found = detect_all(given(), DetectSettings())
    for one, image in zip(found, images, strict=True):
        alone = detect(image)
        assert len(alone) > 5
        assert one.rejected == alone.rejected
        np.testing.assert_array_equal(one.pixels, alone.pixels)
        np.testing.assert_array_equal(one.covariance_px2, alone.covariance_px2)


def test_opencv_agrees_on_the_pixel_origin(painter):
    """(0, 0) is the centre of the top-left pixel: a symmetric spot's moments say the same."""
    canvas = painter(41, 41)
    canvas.add(20.0, 22.0, 2, 0.8, 150)
    image = np.rint(canvas.clean).astype(np.uint8)
    moments = cv2.moments(image)
    centre = [moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]]
    np.testing.assert_allclose(detect(image).pixels[0], centre, atol=1e-3)


@pytest.mark.parametrize("finish", ["matt", "clean"])
@pytest.mark.parametrize("background", ["dark", "sunlit"])
def test_the_simulated_cameras_lights_are_all_found(finish, background):
    """Another renderer, with elliptic spots, motion blur and mirror images under the lights: all 18, no more."""
    world = World.make(seed=3, finish=finish, background=background)
    camera = world.camera("right", "cam0")
    start_ns = world.epoch_ns + 400_000_000
    truth = led_spots(world, camera, LedMotion(world, "right"), start_ns, camera.exposure_us).centre_px[:18]
    found = detect(render_frame(world, camera, start_ns, seed=1))
    assert len(found) == 18
    nearest = np.argmin(np.linalg.norm(found.pixels[None] - truth[:, None], axis=2), axis=1)
    error = found.pixels[nearest] - truth
    sigma = np.sqrt(np.trace(found.covariance_px2[nearest], axis1=1, axis2=2) / 2)
    # 5 sigmas, and what a mirror image 4 px below a far light, as bright as a third of it, pulls that light down
    assert np.all(np.abs(error) < 5 * sigma[:, None] + (0.06 if finish == "clean" else 0.0))
    assert np.median(sigma) < 0.03
