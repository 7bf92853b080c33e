"""Spots of light to grey values: point-spread function, exposure, halo, noise and quantisation of one camera.

Two paths share the light and the noise law. ``render_frame`` draws every pixel afresh. ``LiveRenderer`` is for real
time: it copies one of 16 pre-drawn noise frames at a random offset and draws afresh, with its own noise, every patch
in which there is light.
"""

import functools

import numpy as np
from numpy.typing import NDArray
from scipy.special import chndtr

from hw_sim import spots as spot_model
from hw_sim.spots import BLUR_WEIGHTS, Spots
from hw_sim.wing_motion import LedMotion
from hw_sim.world import CameraTruth, World

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]
Light = NDArray[np.float32]

_NOISE_FRAMES = 16
_MARGIN_PX = 64  # the noise frames are larger by this, for the offsets


def render_frame(
    world: World, camera: CameraTruth, start_ns: int, seed: int, exposure_us: int | None = None, gain_db: float = 0.0
) -> Pixels:
    """The whole image (height, width) of the frame whose row 0 opens at ``start_ns`` (UTC), all of it drawn afresh."""
    exposure = camera.exposure_us if exposure_us is None else exposure_us
    spots = spot_model.led_spots(world, camera, LedMotion(world, camera.side), start_ns, exposure)
    return render_spots(world, spots, exposure, gain_db, np.random.default_rng([world.seed, seed]))


def render_spots(
    world: World, spots: Spots, exposure_us: int, gain_db: float, rng: np.random.Generator, frames: int = 1
) -> Pixels:
    """Image (height, width) of ``spots`` before the world's background; the rounded mean of ``frames`` images."""
    light = scene_e(world, spots, exposure_us)
    if frames == 1:
        return expose(world, light, gain_db, rng)
    total = np.zeros(light.shape, dtype=np.uint32)
    for _ in range(frames):
        total += expose(world, light, gain_db, rng)
    mean: Pixels = np.rint(total / frames).astype(np.uint8)
    return mean


def scene_e(world: World, spots: Spots, exposure_us: int) -> Light:
    """Expected electrons (height, width) of ``spots`` before the world's background: the image before any noise."""
    light = background_e(world, exposure_us)
    patches = _Patches(world, spots)
    np.add.at(light.reshape(-1), patches.index, patches.light_e)
    return light


def background_e(world: World, exposure_us: int, margin_px: int = 0) -> Light:
    """Electrons (height + margin, width + margin) without the lights: none when dark, a smooth gradient in the sun."""
    shape = (world.sensor.height_px + margin_px, world.sensor.width_px + margin_px)
    if world.scene.background == "dark":
        return np.zeros(shape, dtype=np.float32)
    down, right = np.linspace(-1.0, 1.0, shape[0]), np.linspace(-1.0, 1.0, shape[1])
    level = world.scene.sunlit_e_per_ms * exposure_us / 1000.0
    sky = 1.0 - 0.25 * down[:, None] + 0.10 * right + 0.08 * np.sin(2.5 * right + 1.0) * np.cos(1.5 * down[:, None])
    light: Light = (level * sky).astype(np.float32)
    return light


def expose(world: World, light_e: Light, gain_db: float, rng: np.random.Generator) -> Pixels:
    """Grey values of expected electrons (0 dB): full well, shot and read noise, gain, black level, 0 … 255.

    The shot noise is Gaussian with the Poisson's variance; beside the read noise the difference does not show.
    """
    sensor = world.sensor
    held = np.minimum(light_e, np.float32(sensor.full_well_e))
    noise = rng.standard_normal(light_e.shape, dtype=np.float32)
    noise *= np.sqrt(held + np.float32(sensor.read_noise_e**2))
    held += noise
    held *= np.float32(10.0 ** (gain_db / 20.0) / sensor.e_per_dn)
    held += np.float32(sensor.black_dn + 0.5)
    return np.clip(held, 0.0, 255.0, out=held).astype(np.uint8)


class LiveRenderer:
    """Frames of one camera in real time."""

    def __init__(
        self, world: World, camera: CameraTruth, noise: list[Pixels], exposure_us: int, gain_db: float = 0.0
    ) -> None:
        """``noise`` comes from ``noise_frames`` for the same exposure and gain; many cameras can share it."""
        self._world, self._camera, self._noise = world, camera, noise
        self._exposure_us, self._gain_db = exposure_us, gain_db
        self._leds = LedMotion(world, camera.side)
        self._background = background_e(world, exposure_us)
        self._light = self._background.copy()
        self._seed = [world.seed, *camera.key.encode()]

    def render(self, start_ns: int, out: Pixels) -> None:
        """Fill ``out`` (height, width) with the frame whose row 0 opens at ``start_ns``; one time, one frame."""
        world = self._world
        rng = np.random.Generator(np.random.SFC64([*self._seed, start_ns]))
        height, width = out.shape
        frame, down, right = rng.integers(0, (_NOISE_FRAMES, _MARGIN_PX + 1, _MARGIN_PX + 1))
        np.copyto(out, self._noise[frame][down : down + height, right : right + width])
        spots = spot_model.led_spots(world, self._camera, self._leds, start_ns, self._exposure_us)
        patches = _Patches(world, spots)
        light, flat = self._light.reshape(-1), out.reshape(-1)
        np.add.at(light, patches.index, patches.light_e)
        flat[patches.index] = expose(world, light[patches.index], self._gain_db, rng)
        light[patches.index] = self._background.reshape(-1)[patches.index]


def noise_frames(world: World, exposure_us: int, gain_db: float = 0.0) -> list[Pixels]:
    """The pre-drawn frames of ``LiveRenderer``: the world's background with noise, larger than the image.

    Under a sunlit background the gradient moves with the random offset, by at most 64 pixels, as a sky does.
    """
    rng = np.random.default_rng([world.seed, 0xB6])
    light = background_e(world, exposure_us, _MARGIN_PX)
    return [expose(world, light, gain_db, rng) for _ in range(_NOISE_FRAMES)]


class _Patches:
    """The pixels of an image that spots shine on: flat indices, with repeats where patches overlap, and electrons."""

    def __init__(self, world: World, spots: Spots) -> None:
        width, height = world.sensor.width_px, world.sensor.height_px
        half = spot_model.patch_half_px(spots, world)
        which, right, down = _offsets(tuple(half.tolist()))
        corner = np.rint(spots.centre_px).astype(np.int64)
        column, row = corner[which, 0] + right, corner[which, 1] + down
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        if not inside.all():
            which, column, row = which[inside], column[inside], row[inside]
        self.index: NDArray[np.int64] = row * width + column
        light = np.zeros(len(which), dtype=np.float64)
        sigma, inverse = spots.sigma_px, spots.inverse
        scale = inverse * (spots.radius_px / sigma)[:, None, None]
        alpha = spots.radius_px / sigma
        tables, reach = _profiles(alpha)
        to_entry = ((_ENTRIES - 1) / reach)[which]
        a, b, c, d = (scale[which, i, j] * to_entry for i in (0, 1) for j in (0, 1))
        first = which * _ENTRIES
        for step, weight in enumerate(BLUR_WEIGHTS):
            x, y = column - spots.path_px[which, step, 0], row - spots.path_px[which, step, 1]
            entry = np.sqrt((a * x + b * y) ** 2 + (c * x + d * y) ** 2)
            np.minimum(entry, _ENTRIES - 1.001, out=entry)
            whole = entry.astype(np.int64)
            entry -= whole
            whole += first
            low = tables[whole]
            light += weight * (low + entry * (tables[whole + 1] - low))
        light *= spots.peak_e[which]
        halo = spot_model.halo_e(spots, world)
        if halo.any():
            off = np.hypot(column - spots.centre_px[which, 0], row - spots.centre_px[which, 1])
            off = np.maximum(off - spots.radius_px[which], 0.0)
            light += halo[which] * np.exp(-off / spot_model.halo_length_px(spots, world)[which])
        self.light_e: Light = light.astype(np.float32)


@functools.lru_cache(maxsize=64)
def _offsets(half: tuple[int, ...]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """For squares of these half widths, of each pixel: whose it is, and its offset right and down."""
    which, right, down = [], [], []
    for spot, size in enumerate(half):
        steps = np.arange(-size, size + 1)
        which.append(np.full(steps.size**2, spot))
        right.append(np.tile(steps, steps.size))
        down.append(np.repeat(steps, steps.size))
    empty = [np.zeros(0, dtype=np.int64)]
    return np.concatenate(which or empty), np.concatenate(right or empty), np.concatenate(down or empty)


_ENTRIES = 192
_ALPHAS = np.geomspace(0.05, 40.0, 320)


def _profiles(alpha: Array) -> tuple[Array, Array]:
    """Blurred discs' radial profiles: flat table (n · entries), and the distance (n,) in sigmas of its last entry."""
    place = np.interp(np.log(alpha), np.log(_ALPHAS), np.arange(len(_ALPHAS)))
    low = np.minimum(place.astype(np.int64), len(_ALPHAS) - 2)
    part = (place - low)[:, None]
    table = _profile_table()
    reach = _reach(_ALPHAS[low]) * (1.0 - part[:, 0]) + _reach(_ALPHAS[low + 1]) * part[:, 0]
    return (table[low] * (1.0 - part) + table[low + 1] * part).reshape(-1), reach


def _reach(alpha: Array) -> Array:
    return alpha + 4.5


@functools.cache
def _profile_table() -> Array:
    """A disc of radius α under a unit Gaussian, at distances 0 … α + 4.5: P(|Z + δ| < α), Z normal in the plane.

    That is the distribution function of the noncentral χ² with two degrees of freedom (one less Marcum's Q).
    """
    fraction = np.linspace(0.0, 1.0, _ENTRIES)
    distance = _reach(_ALPHAS)[:, None] * fraction
    table: Array = chndtr(np.broadcast_to(_ALPHAS[:, None] ** 2, distance.shape), 2.0, distance**2)
    table[:, -1] = 0.0
    return table
