"""The lights at an instant, to spots in one camera's image: place, size, brightness, halo and reflections.

A light is a disc that faces the camera, or a dome whose outline, and with it its image's centre, depends on where it
is seen from. Its image is the affine projection of the disc, or of the ellipse with the outline's centroid and moments;
the difference between a disc's centre and its image's centre (perspective; under 0.02 px at the nearest pair) is left
out, so that a disc's ``centre_px`` is exactly the projected centre. Each spot stands where the light was in the
exposure of the spot's own row, seen from where the camera was then.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hw_sim import optics
from hw_sim.mount_motion import PairMotion
from hw_sim.wing_motion import LedMotion
from hw_sim.world import CameraTruth, World

Array = NDArray[np.float64]
Times = NDArray[np.int64]

_BLUR_NODES, _BLUR_WEIGHTS = np.polynomial.legendre.leggauss(3)  # instants of the exposure that make the motion blur
_FINISHES = {"matt": (0.015, 0.0015), "clean": (0.30, 0.0002)}  # part mirrored, one sigma of its spread on the wing (m)


@dataclass(frozen=True)
class Spots:
    """n spots of light in one image."""

    centre_px: Array  # (n, 2) at mid-exposure of the spot's row
    path_px: Array  # (n, 3, 2) at the Gauss–Legendre instants of the exposure
    inverse: Array  # (n, 2, 2) pixels off the centre to disc radii
    radius_px: Array  # (n,) √|det|: the mean one
    sigma_px: Array  # (n,) of the Gaussian that the disc is convolved with, the pixel included
    peak_e: Array  # (n,) electrons of a pixel well inside a large disc

    def __len__(self) -> int:
        return len(self.peak_e)


BLUR_WEIGHTS: Array = _BLUR_WEIGHTS / 2.0
"""(3,) weights of ``Spots.path_px``; they add up to one."""


def row_times_ns(camera: CameraTruth, start_ns: int, exposure_us: int, rows_px: Array) -> Times:
    """Mid-exposure, UTC, of rows: row r starts ``r · row_time`` after row 0 at ``start_ns``."""
    after_us = rows_px * camera.row_time_us + exposure_us / 2.0
    times: Times = start_ns + np.rint(after_us * 1000.0).astype(np.int64)
    return times


def led_spots(world: World, camera: CameraTruth, leds: LedMotion, start_ns: int, exposure_us: int) -> Spots:
    """Spots in the frame whose row 0 opens at ``start_ns`` (UTC): wing's lights, their reflections, the fuselage's."""
    pair = PairMotion.of(world, camera.side)

    def wing(times_ns: Times) -> tuple[Array, Array]:
        centres, frames = leds.centres(times_ns)
        return pair.as_at_rest(times_ns, centres), pair.axes_as_at_rest(times_ns, frames)

    moved, frames = _exposed(world, camera, wing, len(leds), start_ns, exposure_us)
    centres, frame = moved[1], frames[1]  # the middle node is mid-exposure
    beams, e3 = leds.beams(frame), frame[:, :, 2]
    dome = world.leds.form == "dome"
    direct = facing_spots(world, camera, centres, beams, exposure_us, normals=e3 if dome else None)
    direct = _with_path(direct, optics.project(camera, moved))
    part, spread_m = _FINISHES[world.scene.finish]
    depth = 2.0 * world.leds.height_m * e3
    mirrored_beams = beams - 2.0 * e3 * np.sum(beams * e3, axis=1, keepdims=True)
    mirrored_up = -e3 if dome else None
    mirror = facing_spots(world, camera, centres - depth, mirrored_beams, exposure_us, part, spread_m, mirrored_up)
    mirror = _with_path(mirror, optics.project(camera, moved - depth))
    found = [direct, mirror]
    fixed = world.fuselage_lights_m(camera.side)
    if len(fixed):

        def fuselage(times_ns: Times) -> tuple[Array, Array]:
            return pair.as_at_rest(times_ns, np.broadcast_to(fixed, (*times_ns.shape, 3))), fixed

        moved, _ = _exposed(world, camera, fuselage, len(fixed), start_ns, exposure_us)
        still = facing_spots(world, camera, moved[1], None, exposure_us)
        found.append(_with_path(still, optics.project(camera, moved)))
    return _visible(_join(found), world)


def _exposed(
    world: World,
    camera: CameraTruth,
    places: Callable[[Times], tuple[Array, Array]],
    count: int,
    start_ns: int,
    exposure_us: int,
) -> tuple[Array, Array]:
    """What ``places`` says at the three instants of each light's own exposure: (3, n, 3), and the rest of it.

    A light's place and the row it is seen in depend on each other; iterating from the middle row gains a factor
    of over 100 a step at the wing's speeds, so that the third is exact to 1e-5 px.
    """
    rows = np.full(count, world.sensor.height_px / 2.0)
    for _ in range(3):
        rows = optics.project(camera, places(row_times_ns(camera, start_ns, exposure_us, rows))[0])[:, 1]
    off_ns = np.rint(_BLUR_NODES * exposure_us * 500.0).astype(np.int64)
    return places(row_times_ns(camera, start_ns, exposure_us, rows) + off_ns[:, None])


def facing_spots(
    world: World,
    camera: CameraTruth,
    centres_m: Array,
    beams: Array | None,
    exposure_us: int,
    part: float = 1.0,
    spread_m: float = 0.0,
    normals: Array | None = None,
) -> Spots:
    """Spots of lights at rest at ``centres_m`` (n, 3), body frame.

    Args:
        world: sizes, brightness and sensor.
        camera: who looks.
        centres_m: light centres.
        beams: (n, 3) unit vectors that the lights shine along, or None when each shines straight at the camera.
        exposure_us: exposure.
        part: of the light that arrives.
        spread_m: one sigma of a diffuse spread at the light's place.
        normals: (n, 3) of the surface that each stands on as a dome; None: discs that face the camera.
    """
    sight = optics.position_m(camera) - centres_m
    distance_m = np.linalg.norm(sight, axis=1)
    sight = sight / distance_m[:, None]
    across = np.cross(sight, np.array([0.0, 0.0, 1.0]) if normals is None else normals)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    upward = np.cross(across, sight)
    radius_m = world.leds.diameter_m / 2.0
    flat = np.ones(len(centres_m))
    if normals is not None:
        flat, lift = _dome(np.abs(np.sum(sight * normals, axis=1)))
        centres_m = centres_m + (lift * radius_m)[:, None] * upward
    steps = np.stack([across, -across, flat[:, None] * upward, -flat[:, None] * upward]) * radius_m
    ends = optics.project(camera, centres_m + steps)
    axes: Array = np.stack([ends[0] - ends[1], ends[2] - ends[3]], axis=-1) / 2.0
    radius_px = np.sqrt(np.abs(np.linalg.det(axes)))
    spread_px = spread_m / radius_m * radius_px
    psf = world.sensor.psf_sigma_px
    facing = np.ones(len(centres_m)) if beams is None else np.clip(np.sum(beams * sight, axis=1), 0.0, None)
    brightness = world.leds.radiance_e_per_ms * exposure_us / 1000.0
    centre = optics.project(camera, centres_m)
    return Spots(
        centre_px=centre,
        path_px=np.repeat(centre[:, None], 3, axis=1),
        inverse=np.linalg.inv(axes).astype(np.float64),
        radius_px=radius_px,
        sigma_px=np.sqrt(psf**2 + 1.0 / 12.0 + spread_px**2),
        peak_e=part * brightness * facing**world.leds.beam_exponent,
    )


def _dome(cosine: Array) -> tuple[Array, Array]:
    """The outline of half a ball on a flat base, seen at ``cosine`` (n,) of the angle from its axis, as an ellipse.

    Half a disc above the base's centre and half an ellipse, ``cosine`` high, below. By area, centroid and second moment
    along the axis' image: half height (n,) of the ellipse that has the same centroid and moments, and that centroid's
    height (n,) above the base's centre; both in radii.
    """
    area = np.pi / 2.0 * (1.0 + cosine)
    lift = 2.0 / 3.0 * (1.0 - cosine**2) / area
    second = np.pi / 8.0 * (1.0 + cosine**3) / area - lift**2
    return 2.0 * np.sqrt(second), lift


def central_e(spots: Spots) -> Array:
    """Electrons (n,) at the centre of each spot: a disc of radius a under a Gaussian reaches 1 − exp(−a²/2σ²)."""
    central: Array = -spots.peak_e * np.expm1(-0.5 * (spots.radius_px / spots.sigma_px) ** 2)
    return central


def _visible(spots: Spots, world: World) -> Spots:
    """Without those that are off the image, behind the camera or too faint to change a grey value."""
    size = np.array([world.sensor.width_px, world.sensor.height_px])
    inside = np.all((spots.centre_px > -20.0) & (spots.centre_px < size + 19.0), axis=1)
    keep = inside & (central_e(spots) > 0.1 * world.sensor.e_per_dn)
    if keep.all():
        return spots
    return Spots(*(getattr(spots, name)[keep] for name in Spots.__dataclass_fields__))


def _with_path(spots: Spots, path_px: Array) -> Spots:
    """With the path (3, n, 2) of the lights; a dome's image is beside its light, and keeps that distance."""
    path = path_px.transpose(1, 0, 2) + (spots.centre_px - path_px[1])[:, None]
    return dataclasses.replace(spots, path_px=path)


def _join(parts: list[Spots]) -> Spots:
    return Spots(*(np.concatenate([getattr(one, name) for one in parts]) for name in Spots.__dataclass_fields__))


def patch_half_px(spots: Spots, world: World) -> NDArray[np.int64]:
    """Half width (n,) of the square that holds each spot down to 0.02 grey values, its motion and its halo."""
    swept = np.max(np.abs(spots.path_px - spots.centre_px[:, None]), axis=(1, 2))
    tail = np.sqrt(2.0 * np.log(np.maximum(central_e(spots) / (0.02 * world.sensor.e_per_dn), 2.0)))
    half = np.ceil(1.3 * spots.radius_px + tail * spots.sigma_px + swept)
    halo = halo_e(spots, world)
    over = halo > 0.0
    if over.any():
        reach = spots.radius_px + halo_length_px(spots, world) * np.log(
            np.maximum(4.0 * halo, 1.0) / world.sensor.e_per_dn
        )
        half = np.where(over, np.minimum(np.maximum(half, np.ceil(reach)), 120), half)
    whole: NDArray[np.int64] = half.astype(np.int64)
    return whole


def halo_e(spots: Spots, world: World) -> Array:
    """Electrons (n,) of the veil at the disc's edge: a part of what exceeds the full well; 0 for a unsaturated spot."""
    veil: Array = world.sensor.veil * np.maximum(central_e(spots) - world.sensor.full_well_e, 0.0)
    return veil


def halo_length_px(spots: Spots, world: World) -> Array:
    """Length (n,) over which the veil falls to 1/e: it grows with the logarithm of the overexposure."""
    over = np.maximum(central_e(spots) / world.sensor.full_well_e, 1.0)
    return (2.0 + spots.radius_px) * (1.0 + np.log(over))
