"""The world to what a person brings back from a calibration day: board images, survey images and ``survey.toml``.

Nothing written here holds a true pose or lens: only pictures, and coordinates as a survey with errors would give them.
"""

import multiprocessing
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.errors import SimulationError
from capture.record import CAMERAS, SIDES
from hw_sim import optics
from hw_sim.board import board_poses, render_board
from hw_sim.render import Pixels, render_spots
from hw_sim.spots import facing_spots
from hw_sim.world import CameraTruth, World, nominal_pose

Array = NDArray[np.float64]


@dataclass(frozen=True)
class _Job:
    path: Path
    camera: CameraTruth
    pose: Array | None  # of the board; None: the survey's lights
    seed: int


def write_sessions(
    world: World, folder: Path, workers: int = 2, progress: Callable[[int, int], None] = lambda done, total: None
) -> int:
    """Write ``board_left``, ``board_right`` and ``survey`` with ``survey.toml`` into ``folder``.

    Args:
        world: the world.
        folder: made when missing; images of an earlier session of the same world are replaced.
        workers: processes that render; 1 stays in this one.
        progress: called with the number of images written and of all.

    Returns:
        The number of images.

    Raises:
        SimulationError: an image cannot be written.
    """
    jobs = list(_jobs(world, folder))
    for place in {job.path.parent for job in jobs}:
        place.mkdir(parents=True, exist_ok=True)
    (folder / "survey.toml").write_text(survey_toml(world), encoding="utf-8")
    if workers == 1:
        for done, job in enumerate(jobs, 1):
            _write_image(world, job)
            progress(done, len(jobs))
        return len(jobs)
    # The workers' products are small: a BLAS that spreads them over threads spends its time waiting.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        for done, _ in enumerate(pool.map(_write_image, [world] * len(jobs), jobs, chunksize=4), 1):
            progress(done, len(jobs))
    return len(jobs)


def survey_points(world: World, side: str) -> Array:
    """True places (n, 3) of one side's surveyed lights, body frame: those of the fuselage, then others on stands.

    The latter are spread from 0.5 to 3 m outboard, fore and aft of the pair's middle, −0.1 to 0.7 m high, in view of
    both cameras and well apart in both images.
    """
    rng = np.random.default_rng([world.seed, 0x5E, *side.encode()])
    pair = [world.camera(side, name) for name in CAMERAS]
    outboard = 1.0 if side == "right" else -1.0
    size = np.array([world.sensor.width_px, world.sensor.height_px])
    apart = 0.03 * world.sensor.width_px
    points: list[Array] = list(world.fuselage_lights_m(side))
    seen = [np.array([optics.project(camera, point) for camera in pair]) for point in points]
    for number, out in enumerate(np.linspace(0.5, 3.0, world.survey.points)):
        while True:
            x = world.mount.centre_x_m + (1 if number % 2 else -1) * rng.uniform(0.05, 0.35)
            point = np.array([x, outboard * out, rng.uniform(-0.1, 0.7)])
            pixels = np.array([optics.project(camera, point) for camera in pair])
            if not (np.all(pixels > 12.0) and np.all(pixels < size - 13.0)):  # NaN is not in view
                continue
            if all(np.linalg.norm(pixels - other, axis=1).min() > apart for other in seen):
                break
        points.append(point)
        seen.append(pixels)
    return np.array(points)


def survey_toml(world: World) -> str:
    """The text of ``survey.toml``: the coordinates are disturbed by the survey's error."""
    sigma_mm = world.survey.sigma_m * 1000.0
    leds = world.leds
    lines = [
        "# Survey of the camera pairs. Coordinates in the body frame (x aft, y right, z up, metres), of each light's",
        f"# centre, with a survey error of {sigma_mm:g} mm (one sigma, per axis). Each image is the mean of",
        f"# {world.survey.frames} frames.",
        f"row_time_us = {world.cameras[0].row_time_us!r}",
        "",
        "[markers]",
        f"pairs_station_m = {list(leds.pairs_station_m)}",
        f"chord_m = {list(leds.chord_m)}",
        f"height_m = {leds.height_m!r}",
    ]
    if leds.form == "dome":
        sizes = {"standoff": leds.height_m, "dome_radius": leds.diameter_m / 2.0}
        lines += [f"{name}_mm = {1000.0 * size:g}" for name, size in sizes.items()]
        lines += ["standoff_sigma_mm = 0.2", "dome_sigma_mm = 0.1"]
    for side in SIDES:
        middle = np.mean([nominal_pose(world.mount, side, name)[:3, 3] for name in CAMERAS], axis=0)
        look = nominal_pose(world.mount, side, "cam0")[:3, 2]
        lines += ["", f"[{side}]"]
        lines += [f'{name}_image = "survey/{side}_{name}.png"' for name in CAMERAS]
        lines += [f'{name}_serial = "{world.camera(side, name).serial}"' for name in CAMERAS]
        lines += [f"approx_position_m = {_numbers(middle)}", f"approx_outboard = {_numbers(look)}"]
        rng = np.random.default_rng([world.seed, 0x5E77, *side.encode()])
        points = survey_points(world, side)
        on_fuselage = len(world.fuselage.lights_m)
        for number, point in enumerate(points + rng.normal(0.0, world.survey.sigma_m, points.shape)):
            fixed = number < on_fuselage
            name = f"F{number + 1}" if fixed else f"{number - on_fuselage + 1:02d}"
            lines += ["", f"[[{side}.points]]", f'name = "{side[0].upper()}{name}"']
            lines += [f"xyz_m = {_numbers(point)}", f"sigma_mm = {sigma_mm:g}"]
            lines += ["on_fuselage = true"] if fixed else []
    return "\n".join(lines) + "\n"


def render_survey(world: World, camera: CameraTruth) -> Pixels:
    """The survey image (height, width) of one camera: the side's lights, each shining straight at the camera."""
    spots = facing_spots(world, camera, survey_points(world, camera.side), None, camera.exposure_us)
    rng = np.random.default_rng([world.seed, 0x5E1F, *camera.key.encode()])
    return render_spots(world, spots, camera.exposure_us, 0.0, rng, frames=world.survey.frames)


def _jobs(world: World, folder: Path) -> Iterator[_Job]:
    for side in SIDES:
        for number, pose in enumerate(board_poses(world, side)):
            for name in CAMERAS:
                camera = world.camera(side, name)
                seed = 1000 * world.cameras.index(camera) + number
                yield _Job(folder / f"board_{side}" / f"{name}_{number:02d}.png", camera, pose, seed)
        for name in CAMERAS:
            yield _Job(folder / "survey" / f"{side}_{name}.png", world.camera(side, name), None, 0)


def _write_image(world: World, job: _Job) -> None:
    if job.pose is None:
        image = render_survey(world, job.camera)
    else:
        image = render_board(world, job.camera, job.pose, job.seed)
    if not cv2.imwrite(str(job.path), image, [cv2.IMWRITE_PNG_COMPRESSION, 1]):
        raise SimulationError(f"{job.path}: the image cannot be written; check the folder and the disk's space")


def _numbers(vector: Array) -> str:
    return "[" + ", ".join(f"{value:.6f}" for value in vector) + "]"
