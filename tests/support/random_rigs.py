"""A seed to a rig that nobody has seen: mounted, calibrated and surveyed by chance, and a wing measured with it.

What is true is drawn here and projected by OpenCV; corners and spots get noise instead of being rendered. Calibration,
survey, triangulation and covariances are the program's own.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from process.board import Board
from process.bulb import DOME, bases_m, centres_m, wing_normals
from process.calibrate import calibrate
from process.camera_model import CameraModel, Light, MarkerLayout, RigSide, StereoPair, pose_matrix
from process.detect import Detections
from process.rig import approximate_pose, solve_pose
from process.shared_error import Surface, displacement_covariance_m2, point_covariance_m2
from process.triangulate import triangulate

BOARD = Board(10, 7, 0.03)
SIZE = (2080, 1552)
VIEWS, LIGHTS = 15, 10
PRINT_SIGMA_M, SURVEY_SIGMA_M, SPOT_SIGMA_PX = 5e-5, 3e-4, 0.03
LIGHT = Light(standoff_m=0.004, standoff_sigma_m=0.0005, dome_radius_m=0.0015, dome_sigma_m=0.0002)
STATIONS_M = (0.2, 0.5, 0.8, 1.2, 1.5, 1.8, 2.2, 2.5, 2.8)


@dataclass(frozen=True)
class Errors:
    """Of one rig: errors (M, 3) of places on the wing and of displacements, and their stated covariances (M, 3, 3)."""

    point_m: np.ndarray
    point_covariance_m2: np.ndarray
    displacement_m: np.ndarray
    displacement_covariance_m2: np.ndarray

    def nees(self, kind: str) -> np.ndarray:
        """(M,) errors squared in their covariances: χ² with three degrees of freedom, if these are right."""
        error, covariance = getattr(self, f"{kind}_m"), getattr(self, f"{kind}_covariance_m2")
        return np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)


def random_rig(seed: int) -> Errors:
    """Errors of the markers that both cameras see, at rest and bent."""
    rng = np.random.default_rng([seed, 0xC0])
    pair, T_body_cam0 = _true_pair(rng)
    side = measured_side(rng, pair, T_body_cam0)
    layout = MarkerLayout(STATIONS_M, (0.04, -0.10), 0.004, LIGHT)
    true_light = (
        rng.normal(LIGHT.standoff_m, LIGHT.standoff_sigma_m),
        rng.normal(LIGHT.dome_radius_m, LIGHT.dome_sigma_m),
    )
    sigma_px = rng.uniform(0.01, 0.05)
    shapes = (
        _wing(layout, rng.uniform(-0.02, 0.05), rng.uniform(-0.03, 0.03)),
        _wing(layout, rng.uniform(0.06, 0.18), rng.uniform(-0.10, 0.10)),
    )
    truth, found, noise, surfaces, lights = [], [], [], [], []
    for bases, normals in shapes:
        pixels = [
            _project(camera, T, _seen_at(bases, normals, T, *true_light))
            + rng.normal(0.0, sigma_px, bases.shape)[:, :2]
            for camera, T in _views(pair, T_body_cam0)
        ]
        spread = np.broadcast_to(np.eye(2) * sigma_px**2, (len(bases), 2, 2))
        points = triangulate(side, *pixels, spread, spread, "default")
        up = wing_normals("right", layout, points.xyz_m)
        centres = centres_m(side, LIGHT, points.xyz_m, up)
        truth.append(bases)
        found.append(bases_m(LIGHT, centres, up))
        noise.append(points.covariance_m2)
        surfaces.append(Surface(LIGHT, up))
        lights.append(centres)
    seen = np.all([_in_view(pair, T_body_cam0, bases) for bases in truth], axis=0)
    point = noise[1] + point_covariance_m2(side, lights[1], surfaces[1])
    moved = noise[0] + noise[1] + displacement_covariance_m2(side, lights[0], lights[1], (surfaces[0], surfaces[1]))
    error = [there - true for there, true in zip(found, truth, strict=True)]
    return Errors(error[1][seen], point[seen], (error[1] - error[0])[seen], moved[seen])


def measured_side(rng: np.random.Generator, pair: StereoPair, T_body_cam0: np.ndarray) -> RigSide:
    """The rig's side as `wingproc calibrate` and `wingproc rig` make it, of a pair that truly is as given."""
    printed = BOARD.points_m + rng.normal(0.0, PRINT_SIGMA_M, BOARD.points_m.shape)
    corners = np.array([_board_view(rng, pair, printed) for _ in range(VIEWS)]).transpose(1, 0, 2, 3)
    corners += rng.normal(0.0, rng.uniform(0.01, 0.05), corners.shape)
    calibrated = calibrate(corners, BOARD, SIZE).pair
    places = _survey_lights(rng, pair, T_body_cam0)
    spots = []
    for camera, T in _views(pair, T_body_cam0):
        pixels = _project(camera, T, places) + rng.normal(0.0, SPOT_SIGMA_PX, (len(places), 2))
        ones = np.ones(len(places))
        # the solver adds 0.03 px for what the models leave: no noise of the spot's own here
        nothing = np.zeros((len(places), 2, 2))
        spots.append(Detections(*pixels.T, nothing, 100 * ones, 9 * ones, ones, ("",) * len(places)))
    surveyed = places + rng.normal(0.0, SURVEY_SIGMA_M, places.shape)
    near = T_body_cam0 @ pose_matrix(rng.normal(0.0, 0.02, 3), rng.normal(0.0, 0.01, 3))
    names, sigma = [f"P{k}" for k in range(len(places))], np.full(len(places), SURVEY_SIGMA_M)
    fit = solve_pose(calibrated, near, names, surveyed, sigma, *spots)
    return RigSide(calibrated, fit.T_body_cam0, "0", "1", 0.0, fit.covariance, fit.by_calibration)


def _true_pair(rng):
    focal = rng.uniform(1300.0, 2000.0)
    cameras = []
    for _ in range(2):
        fx, (cx, cy) = focal * (1 + rng.normal(0.0, 0.005)), np.array([1039.5, 775.5]) + rng.normal(0.0, 8.0, 2)
        lens = [-0.1 + rng.normal(0, 0.01), 0.02 + rng.normal(0, 0.005), *rng.normal(0, 3e-4, 2), rng.normal(0, 5e-4)]
        cameras.append(CameraModel(*SIZE, [[fx, 0, cx], [0, fx * (1 + rng.normal(0, 5e-4)), cy], [0, 0, 1]], lens))
    between = pose_matrix(rng.normal(0.0, 0.01, 3), [-rng.uniform(0.2, 0.4), *rng.normal(0.0, 0.002, 2)])
    pair = StereoPair(*cameras, between)
    nominal = approximate_pose(pair, np.array([0.03, -0.2, 0.08]), np.array([0.0, 0.99, 0.12]))
    return pair, nominal @ pose_matrix(rng.normal(0.0, 0.01, 3), rng.normal(0.0, 0.005, 3))


def _board_view(rng, pair, printed):
    """(2, N, 2) corners of a board that both cameras see whole, tilted by 0.2 to 0.7 rad."""
    flat = np.column_stack([printed, np.zeros(len(printed))])
    while True:
        z, direction, tilt = (
            np.exp(rng.uniform(np.log(0.4), np.log(1.5))),
            rng.uniform(0, 2 * np.pi),
            rng.uniform(0.2, 0.7),
        )
        ray = (rng.uniform(0, 1, 2) * SIZE - pair.cam0.K[:2, 2]) / pair.cam0.K[0, 0]
        turn = [np.cos(direction) * tilt, np.sin(direction) * tilt, rng.uniform(-0.35, 0.35)]
        pose = pose_matrix(turn, z * np.array([*ray, 1.0]))
        pixels = [_project(c, T @ pose, flat) for c, T in ((pair.cam0, np.eye(4)), (pair.cam1, pair.T_cam1_cam0))]
        if all(np.all((p > 5) & (p < np.array(SIZE) - 6)) for p in pixels):
            return np.array(pixels)


def _survey_lights(rng, pair, T_body_cam0):
    """(LIGHTS, 3) places, body frame, in view and well apart."""
    found = []
    while len(found) < LIGHTS:
        z = rng.uniform(0.6, 3.0)
        ray = (rng.uniform(0, 1, 2) * SIZE - pair.cam0.K[:2, 2]) / pair.cam0.K[0, 0]
        trial = T_body_cam0[:3, :3] @ (z * np.array([*ray, 1.0])) + T_body_cam0[:3, 3]
        pixels = np.array(
            [[_project(c, T, np.array([p]))[0] for p in [*found, trial]] for c, T in _views(pair, T_body_cam0)]
        )
        inside = np.all((pixels[:, -1] > 20) & (pixels[:, -1] < np.array(SIZE) - 21))
        apart = np.linalg.norm(pixels[:, :-1] - pixels[:, -1:], axis=2)
        if inside and (not found or apart.min() > 60):
            found.append(trial)
    return np.array(found)


def _wing(layout, curvature, twist_rad):
    """Surface places and normals (18, 3) of a right wing on an arc, twisted in proportion to the arc length."""
    s = np.repeat(layout.pairs_station_m, 2)
    chord = np.tile(layout.chord_m, len(s) // 2)
    angle, twist = curvature * s, twist_rad * s / s[-1]
    bend = curvature if abs(curvature) > 1e-9 else 1e-9
    axis = np.stack([0 * s, np.sin(angle) / bend, (1 - np.cos(angle)) / bend], axis=1)
    up = np.stack([0 * s, -np.sin(angle), np.cos(angle)], axis=1)
    forward = np.array([-1.0, 0.0, 0.0]) * np.cos(twist)[:, None] + up * np.sin(twist)[:, None]
    normal = up * np.cos(twist)[:, None] + np.array([1.0, 0.0, 0.0]) * np.sin(twist)[:, None]
    return axis + chord[:, None] * forward, normal


def _seen_at(bases, normals, T_camera_body, standoff_m, dome_radius_m):
    """(M, 3) where a camera sees bulbs: half a disc above and half an ellipse below the dome's middle."""
    centres = bases + standoff_m * normals
    towards = -T_camera_body[:3, :3].T @ T_camera_body[:3, 3] - centres
    towards /= np.linalg.norm(towards, axis=1)[:, None]
    cosine = np.sum(normals * towards, axis=1)[:, None]
    across = normals - cosine * towards
    across /= np.linalg.norm(across, axis=1)[:, None]
    return centres + DOME * dome_radius_m * (1.0 - cosine) * across


def _views(pair, T_body_cam0):
    from_body = np.linalg.inv(T_body_cam0)
    return (pair.cam0, from_body), (pair.cam1, pair.T_cam1_cam0 @ from_body)


def _project(camera, T, points):
    turn = cv2.Rodrigues(T[:3, :3])[0]
    return cv2.projectPoints(points, turn, T[:3, 3], camera.K, camera.distortion)[0].reshape(-1, 2)


def _in_view(pair, T_body_cam0, points):
    seen = [_project(camera, T, points) for camera, T in _views(pair, T_body_cam0)]
    return np.all([np.all((p > 0) & (p < np.array(SIZE) - 1), axis=1) for p in seen], axis=0)
