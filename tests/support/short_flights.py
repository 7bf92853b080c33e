"""A seed to a short flight that nobody has seen: mounted, calibrated and surveyed by chance, its frames rendered.

The frames are full size, drawn by the simulation's own projection and written by the recorder; reading, detection,
matching, triangulation, fit and covariances are the program's. The calibration is the program's, too, from corners and
spots with noise instead of rendered boards (``random_rigs``): those would take a hundred times as long.
"""

import functools
import math
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from random_rigs import measured_side
from rendered_flight import edge_ns, true_side, write_side

from hw_sim.render import LiveRenderer, Pixels, noise_frames
from hw_sim.wing_motion import LedMotion, WingMotion, twist_rad
from hw_sim.world import Sine, World
from process.camera_model import Light, MarkerLayout, Rig
from process.pipeline import PipelineSettings, markers_of_recording
from process.recording import open_recording
from process.reference import Window
from process.shared_error import displacement_covariance_m2, with_rig
from reconstruct.series import SideFits, fit_series
from reconstruct.shared import shared_errors
from reconstruct.tables import MarkerSeries, marker_series
from reconstruct.wing import example_path, read_wing

SETS, APART = 4, 100  # sets at either time, and triggers between the two: half a period of the slow motion
SLOW_HZ = 0.125
HEIGHT_M, HEIGHT_SIGMA_M = 0.004, 0.0005  # of the lights above the axis, as the wing file says
INSIDE_95 = 7.815  # of χ² with three degrees of freedom
WITHIN_95 = 1.959964  # sigmas of a normal error


@dataclass(frozen=True)
class Drawn:
    """Of one flight: displacements between its two times, of one marker and of one station, drawn by lot."""

    seed: int
    marker_nees: float
    """squared error in its covariance: χ² with three degrees of freedom, if that is right"""
    marker_error_mm: float
    marker_sigma_mm: float
    all_nees: float
    """mean of ``marker_nees`` over all markers"""
    band: float
    """error over sigma of one coordinate of the fitted wing's displacement at a marker's station"""
    band_squares: float
    """mean of its square over all stations and coordinates"""
    shape_error_mm: float
    shape_sigma_mm: float
    twist: float
    """error over sigma of its twist there"""
    twist_squares: float
    twist_error_deg: float
    twist_sigma_deg: float


def fly(seed: int) -> Drawn:
    """Mount, calibrate, fly, measure and compare."""
    rng = np.random.default_rng([seed, 0x5F])
    side = ("left", "right")[seed % 2]
    world = _world(seed, rng)
    true = true_side(world, side)
    own = replace(measured_side(rng, true.pair, true.T_body_cam0), row_time_ns=true.row_time_ns)
    light = Light(standoff_m=HEIGHT_M, standoff_sigma_m=HEIGHT_SIGMA_M)
    rig = Rig(own, own, MarkerLayout(world.leds.pairs_station_m, world.leds.chord_m, HEIGHT_M, light))
    first = int(rng.integers(0, 1000))
    triggers = [first + after + number for after in (0, APART) for number in range(SETS)]
    with tempfile.TemporaryDirectory() as folder:
        write_side(world, side, Path(folder), triggers, _artist(world, side))
        found = markers_of_recording(open_recording([folder]), rig, PipelineSettings(), workers=1)
    table = with_rig(found.table, rig)
    series = marker_series(table, "flight")
    rest = Window(0.0, (SETS - 0.5) / world.trigger_rate_hz)
    wing = read_wing(example_path("xhale.toml"))
    fits = fit_series(series, wing, shared=shared_errors(table), reference=rest, workers=1)[side]
    error, covariance = _markers_moved(world, rig, series[side], rng)
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
    marker = int(rng.integers(len(nees)))
    scores, off, sigma = _wing_moved(world, fits, rng)
    station, axis = int(rng.integers(len(scores))), int(rng.integers(3))
    return Drawn(
        seed,
        float(nees[marker]),
        1e3 * float(np.linalg.norm(error[marker])),
        1e3 * float(np.sqrt(np.trace(covariance[marker]))),
        float(nees.mean()),
        float(scores[station, axis]),
        float(np.mean(scores[:, :3] ** 2)),
        1e3 * float(np.linalg.norm(off[station, :3])),
        1e3 * float(np.linalg.norm(sigma[station, :3])),
        float(scores[station, 3]),
        float(np.mean(scores[:, 3] ** 2)),
        math.degrees(abs(off[station, 3])),
        math.degrees(sigma[station, 3]),
    )


def _world(seed: int, rng: np.random.Generator) -> World:
    """The wing moves slowly by up to half a metre between the two times, besides its gusts; lights off by a draw."""
    world = World.make(seed)
    slow = [
        Sine(shape, SLOW_HZ, rng.uniform(*between), 0.0, rng.uniform(0.0, 2.0 * math.pi))
        for shape, between in (("bending1", (0.02, 0.10)), ("twist", (0.005, 0.03)))
    ]
    motion = replace(world.motion, sines=(*world.motion.sines, *slow))
    return replace(world, motion=motion, leds=replace(world.leds, height_m=rng.normal(HEIGHT_M, HEIGHT_SIGMA_M)))


@functools.cache
def _noise() -> list[Pixels]:
    """Of a dark sky: alike in all flights, shifted by lot in each frame."""
    world = World.make(0)
    return noise_frames(world, world.cameras[0].exposure_us, world.cameras[0].gain_db)


def _artist(world, side):
    artists = {
        camera.name: LiveRenderer(world, camera, _noise(), camera.exposure_us, camera.gain_db)
        for camera in world.cameras
        if camera.side == side
    }
    return lambda camera, trigger, pixels: artists[camera].render(edge_ns(world, trigger), pixels)


def _markers_moved(
    world: World, rig: Rig, series: MarkerSeries, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Errors (n, 3) of displacements of the lights seen in two sets, one of either time, and their covariances."""
    leds = LedMotion(world, series.side)
    places = [int(rng.integers(SETS)), SETS + int(rng.integers(SETS))]
    seen = np.isfinite(series.xyz_m[places]).all(axis=(0, 2))
    before, after = (series.xyz_m[place][seen] for place in places)
    true = [leds.centres(series.timestamp_ns[place])[0][series.marker][seen] for place in places]
    noise = sum(series.cov_m2[place][seen] for place in places)
    shared = displacement_covariance_m2(rig.side(series.side), before, after)
    return (after - before) - (true[1] - true[0]), noise + shared


def _wing_moved(world: World, fits: SideFits, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """At the markers' stations: errors over sigmas, errors and sigmas (n, 4) of displacement (m) and twist (rad)."""
    stations = np.array(world.leds.pairs_station_m)
    nodes = [int(np.argmin(np.abs(fits.s_m - station))) for station in stations]
    motion = WingMotion(world, fits.side, fits.s_m[nodes])
    state = motion.state(fits.timestamp_ns[:, None])
    truth = np.concatenate([state.points_m, twist_rad(world, state.frames, fits.side)[..., None]], axis=-1)
    moved = truth - truth[:SETS].mean(axis=0)
    found_m = fits.xyz_m[:, nodes] - fits.reference_xyz_m[nodes]
    found_rad = fits.twist_rad[:, nodes] - fits.reference_twist_rad[nodes]
    off = np.concatenate([found_m, found_rad[..., None]], axis=-1) - moved
    sigma = np.concatenate([fits.sigma_moved_m, fits.sigma_twisted_rad[..., None]], axis=-1)[:, nodes]
    chosen = SETS + int(rng.integers(SETS))
    return off[chosen] / sigma[chosen], off[chosen], sigma[chosen]
