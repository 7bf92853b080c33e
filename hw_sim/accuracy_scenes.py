"""A lens and a seed to the pictures of an accuracy test: a calibration session, then targets at known distances.

Into the folder go ``calibration/cam0_00.png`` … of the board, ``target/board_0750_cam0.png`` … and
``target/lights_0750_cam0.png`` …, and ``truth.json``: the targets' true points in cam0's frame. The pair is the world's
right one with its focal lengths scaled; lenses, poses, print errors and noise all follow from the seed.
"""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.errors import SimulationError
from capture.record import CAMERAS
from hw_sim import optics
from hw_sim.board import board_poses, corners_m, render_board
from hw_sim.render import Pixels, render_spots
from hw_sim.spots import central_e, facing_spots
from hw_sim.world import CameraTruth, World

Array = NDArray[np.float64]

FOCAL_MM = 3.5  # of the world's lenses
PAIR_M = 0.01016  # between the two lights of a pair (the paper's Table 7)
PAIRS_ACROSS = (0.0, -0.06, 0.06)  # places of the pairs in the view, in parts of the distance
PAIRS_DOWN = (0.0, -0.09, 0.09)
SIDE = "right"


def accuracy_world(seed: int, focal_mm: float) -> World:
    """The world of ``seed`` with other lenses: focal lengths scaled, each place of the image as distorted as before."""
    world = World.make(seed)
    part = focal_mm / FOCAL_MM
    cameras = tuple(
        dataclasses.replace(
            camera,
            fx=camera.fx * part,
            fy=camera.fy * part,
            k1=camera.k1 * part**2,
            k2=camera.k2 * part**4,
            p1=camera.p1 * part,
            p2=camera.p2 * part,
            k3=camera.k3 * part**6,
        )
        for camera in world.cameras
    )
    return dataclasses.replace(world, cameras=cameras)


def write_accuracy_scenes(
    seed: int,
    focal_mm: float,
    distances_m: tuple[float, ...],
    folder: Path,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> int:
    """Write the pictures and ``truth.json``; targets that are not wholly in view of both cameras are left out.

    Returns the number of pictures. Raises SimulationError if one cannot be written.
    """
    world = accuracy_world(seed, focal_mm)
    pair = [world.camera(SIDE, name) for name in CAMERAS]
    poses = board_poses(world, SIDE)
    total = 2 * (len(poses) + 2 * len(distances_m))
    for part in ("calibration", "target"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    done = 0
    for number, pose in enumerate(poses):
        for index, camera in enumerate(pair):
            image = render_board(world, camera, pose, 1000 * index + number)
            _write(folder / "calibration" / f"{CAMERAS[index]}_{number:02d}.png", image)
            progress(done := done + 1, total)
    truth = []
    for number, distance_m in enumerate(distances_m):
        name = f"{round(1000 * distance_m):04d}"
        for kind, points in (("board", _board_points(world, distance_m)), ("lights", _light_points(world, distance_m))):
            if not _in_view(world, pair, points, margin_m=world.board.square_m if kind == "board" else 0.0):
                continue
            for index, camera in enumerate(pair):
                seed_of_image = 5000 + 100 * number + index
                if kind == "board":
                    image = render_board(world, camera, _target_pose(world, distance_m), seed_of_image)
                else:
                    image = _render_lights(world, camera, points, seed_of_image)
                _write(folder / "target" / f"{kind}_{name}_{CAMERAS[index]}.png", image)
                progress(done := done + 1, total)
            truth.append({"kind": kind, "z_mm": 1000 * distance_m, "points_m": points.tolist()})
            if kind == "lights":
                truth[-1].update(_light_facts(world, pair[0], points))
    stated = {"focal_mm": focal_mm, "seed": seed, "sensor": _sensor_facts(world), "targets": truth}
    (folder / "truth.json").write_text(json.dumps(stated, indent=1))
    return done


def _sensor_facts(world: World) -> dict[str, float]:
    """What decides how well corners and lights can be measured, in pixels and grey levels."""
    sensor, board = world.sensor, world.board
    rounding = 1.0 / 12.0
    black, white = (
        float(np.sqrt((light_e + sensor.read_noise_e**2) / sensor.e_per_dn**2 + rounding))
        for light_e in (board.black_e, board.white_e)
    )
    return {
        "blur_px": float(np.hypot(sensor.psf_sigma_px, np.sqrt(1.0 / 12.0))),
        "contrast": (board.white_e - board.black_e) / sensor.e_per_dn,
        "sigma_black": black,
        "sigma_white": white,
        "sigma_background": float(np.sqrt((sensor.read_noise_e / sensor.e_per_dn) ** 2 + rounding)),
        "shot_gain": 1.0 / sensor.e_per_dn,
    }


def _light_facts(world: World, camera: CameraTruth, points_cam0: Array) -> dict[str, float]:
    body = np.array(camera.T_body_cam)
    spots = facing_spots(world, camera, points_cam0 @ body[:3, :3].T + body[:3, 3], None, camera.exposure_us)
    return {
        "radius_px": float(spots.radius_px.mean()),
        "peak": float(central_e(spots).mean()) / world.sensor.e_per_dn,
    }


def _middle_m(world: World) -> float:
    return world.mount.baseline_m / 2.0


def _target_pose(world: World, distance_m: float) -> Array:
    """``T_body_board`` of a board that faces the pair at ``distance_m`` along cam0's axis."""
    pose = np.eye(4)
    pose[:3, 3] = (_middle_m(world), 0.0, distance_m)
    return np.array(world.camera(SIDE, "cam0").T_body_cam) @ pose


def _board_points(world: World, distance_m: float) -> Array:
    """(N, 3) printed inner corners in cam0's frame, row by row."""
    placed: Array = corners_m(world).reshape(-1, 3) + np.array([_middle_m(world), 0.0, distance_m])
    return placed


def _light_points(world: World, distance_m: float) -> Array:
    """(18, 3) lights in cam0's frame: nine pairs."""
    places = [
        (_middle_m(world) + x * distance_m + end * PAIR_M / 2.0, y * distance_m, distance_m)
        for y in PAIRS_DOWN
        for x in PAIRS_ACROSS
        for end in (-1.0, 1.0)
    ]
    return np.array(places)


def _in_view(world: World, pair: list[CameraTruth], points: Array, margin_m: float) -> bool:
    body = np.array(pair[0].T_body_cam)
    rim = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]]) * margin_m
    around = (points[:, None] + rim).reshape(-1, 3) @ body[:3, :3].T + body[:3, 3]
    size = np.array([world.sensor.width_px, world.sensor.height_px])
    seen = np.array([optics.project(camera, around) for camera in pair])
    return bool(np.all((seen > 12.0) & (seen < size - 13.0)))


def _render_lights(world: World, camera: CameraTruth, points_cam0: Array, seed: int) -> Pixels:
    body = np.array(world.camera(SIDE, "cam0").T_body_cam)
    spots = facing_spots(world, camera, points_cam0 @ body[:3, :3].T + body[:3, 3], None, camera.exposure_us)
    return render_spots(world, spots, camera.exposure_us, 0.0, np.random.default_rng([world.seed, 0xACC, seed]))


def _write(path: Path, image: Pixels) -> None:
    if not cv2.imwrite(str(path), image, [cv2.IMWRITE_PNG_COMPRESSION, 1]):
        raise SimulationError(f"{path}: the image cannot be written; check the folder and the disk's space")
