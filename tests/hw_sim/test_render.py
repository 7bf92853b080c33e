"""Spots of light: where they stand, how they look, and what the sensor makes of them."""

import dataclasses

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from hw_sim import optics
from hw_sim.render import LiveRenderer, background_e, expose, noise_frames, render_frame, scene_e
from hw_sim.spots import central_e, facing_spots, halo_e, led_spots, row_times_ns
from hw_sim.wing_motion import LedMotion
from hw_sim.world import World

START_NS = 1_700_000_123_456_789_012


def _patch(image: np.ndarray, centre: np.ndarray, half: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    x, y = np.rint(centre).astype(int)
    rows, columns = np.mgrid[y - half : y + half + 1, x - half : x + half + 1]
    return image[rows, columns].astype(float), columns, rows


def _centroid(image: np.ndarray, centre: np.ndarray, half: int) -> np.ndarray:
    light, columns, rows = _patch(image, centre, half)
    return np.array([np.sum(light * columns), np.sum(light * rows)]) / light.sum()


def _fastest_ns(world: World, leds: LedMotion) -> int:
    """When the outermost light is fastest, in the first half minute: about 1 m/s."""
    times = world.epoch_ns + np.arange(0, 30_000, 10) * 1_000_000
    tip = leds.centres(np.repeat(times[:, None], len(leds), axis=1))[0][:, -1]
    return int(times[np.argmax(np.linalg.norm(np.diff(tip, axis=0), axis=1))])


def _survey_like(world: World) -> np.ndarray:
    rng = np.random.default_rng(5)
    return np.column_stack([np.linspace(-0.25, 0.3, 12), np.linspace(0.35, 3.0, 12), rng.uniform(-0.05, 0.3, 12)])


def test_a_spots_light_is_centred_on_the_projected_point(world: World) -> None:
    camera = world.camera("right", "cam0")
    points = _survey_like(world)
    for point, centre in zip(points, optics.project(camera, points), strict=True):
        light = scene_e(world, facing_spots(world, camera, point[None], None, 2000), 2000)
        # What is cut off beyond the patch is 0.02 grey values, and the table's steps are symmetric about the centre.
        assert _centroid(light, centre, 14) == pytest.approx(centre, abs=2e-3)


def test_noisy_centroids_scatter_about_the_truth_as_photon_noise_says(world: World) -> None:
    camera = world.camera("right", "cam1")
    spots = facing_spots(world, camera, _survey_like(world), None, 2000)
    light = scene_e(world, spots, 2000)
    rng = np.random.default_rng(7)
    for centre in spots.centre_px[2::3]:
        expected, columns, _ = _patch(light, centre, 9)
        variance_e = expected + world.sensor.read_noise_e**2 + world.sensor.e_per_dn**2 / 12
        sigma = np.sqrt(np.sum(variance_e * (columns - centre[0]) ** 2)) / expected.sum()
        found = []
        x, y = np.rint(centre).astype(int)
        cut = np.s_[y - 9 : y + 10, x - 9 : x + 10]
        for _ in range(200):
            image = expose(world, light[cut], 0.0, rng) - world.sensor.black_dn
            found.append(np.sum(image * columns) / image.sum())
        assert np.mean(found) == pytest.approx(centre[0], abs=5 * sigma / 200**0.5)
        assert np.std(found) == pytest.approx(sigma, rel=5 / (2 * 200) ** 0.5)


def test_a_spot_is_its_disc_under_the_point_spread_function(world: World) -> None:
    # Brute force: the disc on a grid of 1/16 px, blurred, summed over pixels. Taking the pixel for a Gaussian of the
    # same variance changes the fourth moment only: under 0.5 % of the peak at sigma 0.9.
    camera = world.camera("right", "cam0")
    distance_m = np.array([0.5, 1.2, 2.8])
    points = optics.position_m(camera) + distance_m[:, None] * optics.rays(camera, np.array([1035.3, 771.8]))
    for point in points:
        spots = facing_spots(world, camera, point[None], None, 2000)
        light = scene_e(world, spots, 2000)
        seen, columns, rows = _patch(light, spots.centre_px[0], 10)
        fine = 16
        steps = (np.arange(21 * fine) + 0.5) / fine - 0.5
        x = columns[0, 0] + steps - spots.centre_px[0, 0]
        y = rows[0, 0] + steps - spots.centre_px[0, 1]
        inside = np.hypot(*np.einsum("ij,jkl->ikl", spots.inverse[0], np.array(np.meshgrid(x, y)))) < 1.0
        blurred = gaussian_filter(inside.astype(float), world.sensor.psf_sigma_px * fine, truncate=6)
        brute = spots.peak_e[0] * blurred.reshape(21, fine, 21, fine).mean(axis=(1, 3))
        assert np.abs(seen - brute).max() < 0.01 * brute.max()
        assert seen.sum() == pytest.approx(brute.sum(), rel=0.01)
        assert seen[10, 10] == pytest.approx(central_e(spots)[0], rel=0.15)


def test_the_size_of_a_spot_is_the_lights(world: World) -> None:
    camera = world.camera("right", "cam0")
    point = optics.position_m(camera) + 0.5 * optics.rays(camera, np.array([1040.0, 776.0]))
    (radius,) = facing_spots(world, camera, point[None], None, 2000).radius_px
    assert radius == pytest.approx(1400 * 0.0015 / 0.5, rel=0.03)  # the focal length's spread and the distortion


@pytest.mark.parametrize("key", ["left_cam0", "right_cam1"])
def test_each_spot_stands_where_the_wing_was_in_its_own_row(world: World, key: str) -> None:
    camera = world.camera(*key.split("_"))
    leds = LedMotion(world, camera.side)
    start_ns = _fastest_ns(world, leds)
    spots = led_spots(world, camera, leds, start_ns, 2000)
    rows = spots.centre_px[:18, 1]
    times = start_ns + np.rint((rows * 10.0 + 1000.0) * 1000.0).astype(np.int64)
    assert np.array_equal(times, row_times_ns(camera, start_ns, 2000, rows))
    there, _ = leds.centres(times)
    assert spots.centre_px[:18] == pytest.approx(optics.project(camera, there), abs=1e-4)
    first_row, _ = leds.centres(np.full(18, start_ns + 1_000_000))
    assert np.abs(optics.project(camera, first_row) - spots.centre_px[:18]).max() > 1.0  # it matters


def test_motion_widens_a_spot_by_a_twelfth_of_its_path_squared(bare: World) -> None:
    camera = bare.camera("right", "cam0")
    leds = LedMotion(bare, "right")
    start_ns = _fastest_ns(bare, leds)
    spots = led_spots(bare, camera, leds, start_ns, 6000)
    fast = 16
    middle = row_times_ns(camera, start_ns, 6000, spots.centre_px[:18, 1])
    ends = [optics.project(camera, leds.centres(middle + off)[0])[fast] for off in (-3_000_000, 3_000_000)]
    path = ends[1] - ends[0]
    assert abs(path[1]) > 1.0
    one = dataclasses.replace(spots, **{n: getattr(spots, n)[fast : fast + 1] for n in vars(spots)})
    at_rest = dataclasses.replace(one, path_px=np.repeat(one.centre_px[:, None], 3, axis=1))
    variances = []
    for version in (at_rest, one):
        light, _, rows = _patch(scene_e(bare, version, 6000), one.centre_px[0], 12)
        variances.append(np.sum(light * (rows - one.centre_px[0, 1]) ** 2) / light.sum())
    # Gauss–Legendre is exact on second moments; speed changes by per cents within the exposure.
    assert variances[1] - variances[0] == pytest.approx(path[1] ** 2 / 12, rel=0.05)


@pytest.mark.parametrize(("level_e", "gain_db"), [(0.0, 0.0), (800.0, 0.0), (5000.0, 0.0), (800.0, 12.0)])
def test_noise_follows_the_mean_variance_law(world: World, level_e: float, gain_db: float) -> None:
    count = 400_000
    image = expose(world, np.full((count,), level_e, dtype=np.float32), gain_db, np.random.default_rng(2)).astype(float)
    sensor = world.sensor
    dn_per_e = 10 ** (gain_db / 20) / sensor.e_per_dn
    mean = sensor.black_dn + level_e * dn_per_e
    variance = (level_e + sensor.read_noise_e**2) * dn_per_e**2 + 1 / 12
    assert image.mean() == pytest.approx(mean, abs=5 * (variance / count) ** 0.5)
    # Five sigma of a variance estimate; a sigma of half a grey value makes quantisation noise 1/12 to a few per cent.
    assert image.var() == pytest.approx(variance, rel=5 * (2 / count) ** 0.5, abs=0.02)


def test_overexposure_saturates_and_makes_a_halo(bare: World) -> None:
    camera = bare.camera("right", "cam1")
    leds = LedMotion(bare, "right")
    good = led_spots(bare, camera, leds, START_NS, 2000)
    assert (halo_e(good, bare) == 0.0).all()
    assert render_frame(bare, camera, START_NS, 0).max() < 255
    over = led_spots(bare, camera, leds, START_NS, 50_000)
    image = render_frame(bare, camera, START_NS, 0, exposure_us=50_000)
    centre = over.centre_px[0]
    x, y = np.rint(centre).astype(int)
    assert image[y, x] == 255
    widths = []
    for exposure_us in (10_000, 50_000):  # the veil grows with the overexposure
        light, columns, rows = _patch(
            scene_e(bare, led_spots(bare, camera, leds, START_NS, exposure_us), exposure_us), centre, 60
        )
        far = np.hypot(columns - centre[0], rows - centre[1]) > over.radius_px[0] + 6 * over.sigma_px[0]
        widths.append(light[far].sum())
    assert widths[1] > 2 * widths[0] > 0


def test_a_clean_wing_mirrors_the_lights_and_a_matt_one_hardly(world: World) -> None:
    camera = world.camera("left", "cam0")
    parts = {}
    for finish in ("clean", "matt"):
        scene = dataclasses.replace(world.scene, finish=finish)
        made = dataclasses.replace(world, scene=scene)
        spots = led_spots(made, camera, LedMotion(made, "left"), START_NS, 2000)
        assert (spots.centre_px[18:36, 1] > spots.centre_px[:18, 1] + 2.0).all()  # below its light
        parts[finish] = central_e(spots)[18] / central_e(spots)[0]
    assert parts["clean"] > 0.1
    assert parts["matt"] < 0.02


def test_a_sunlit_background_is_bright_and_smooth() -> None:
    sunlit = World.make(scale=4, background="sunlit")
    level = background_e(sunlit, 2000) / sunlit.sensor.e_per_dn
    assert 30 < level.min() < level.max() < 90
    assert np.abs(np.diff(level, axis=0)).max() < 0.5
    camera = sunlit.camera("right", "cam0")
    image = render_frame(sunlit, camera, START_NS, 4)
    assert image[:40, :40].mean() == pytest.approx(level[:40, :40].mean() + sunlit.sensor.black_dn, abs=0.2)


def test_the_same_seed_and_time_make_the_same_pixels(small: World) -> None:
    camera = small.camera("right", "cam0")
    assert np.array_equal(render_frame(small, camera, START_NS, 4), render_frame(small, camera, START_NS, 4))
    assert not np.array_equal(render_frame(small, camera, START_NS, 4), render_frame(small, camera, START_NS, 5))
    noise = noise_frames(small, 2000)
    assert all(np.array_equal(a, b) for a, b in zip(noise, noise_frames(small, 2000), strict=True))
    images = [np.empty((small.sensor.height_px, small.sensor.width_px), dtype=np.uint8) for _ in range(3)]
    renderer = LiveRenderer(small, camera, noise, 2000)
    renderer.render(START_NS, images[0])
    renderer.render(START_NS + 40_000_000, images[1])
    renderer.render(START_NS, images[2])
    assert np.array_equal(images[0], images[2])
    assert not np.array_equal(images[0], images[1])


def test_the_real_time_path_has_the_same_light_and_noise_as_the_full_one(small: World) -> None:
    camera = small.camera("left", "cam1")
    noise = noise_frames(small, 2000)
    renderer = LiveRenderer(small, camera, noise, 2000)
    shape = (small.sensor.height_px, small.sensor.width_px)
    rest = dataclasses.replace(small, motion=dataclasses.replace(small.motion, sines=()))
    renderer = LiveRenderer(rest, camera, noise, 2000)
    times = rest.epoch_ns + 6_900_000_000 + np.arange(60) * 1000  # between two gusts nothing moves
    live = np.empty((60, *shape), dtype=np.uint8)
    for time_ns, out in zip(times, live, strict=True):
        renderer.render(int(time_ns), out)
    full = np.array([render_frame(rest, camera, int(times[0]), seed) for seed in range(60)])
    variance = full.astype(float).var(axis=0) + live.astype(float).var(axis=0)
    off = (live.mean(axis=0) - full.mean(axis=0)) / np.sqrt((variance + 0.05) / 60)
    # 200,000 pixels, 59 degrees of freedom: |t| stays under 7; means differ by under a five-sigma of the whole.
    assert np.abs(off).max() < 7.0
    assert abs(off.mean()) < 5 / off.size**0.5 * 2
    assert live.astype(float).var(axis=0).mean() == pytest.approx(full.astype(float).var(axis=0).mean(), rel=0.02)
