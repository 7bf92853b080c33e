"""A mount that is not built yet to what its cameras will see, and how well they will place each marker (Fig. 9).

The calibration is not there yet either: one is made from simulated corners of as many views of a board as will be
taken, with the noise that corners are measured with, and its covariance is carried to the markers.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capture.errors import ProcessError
from process.board import Board
from process.bundle import rotation_matrix
from process.calibrate import calibrate
from process.camera_model import CameraModel, MarkerLayout, RigSide, StereoPair, pose_matrix
from process.cramer_rao import spot_bound_px
from process.match import wing_places_m
from process.rig import approximate_pose
from process.shared_error import triangulated_by_calibration
from process.triangulate import triangulate

Array = NDArray[np.float64]

CORNER_SIGMA_PX = 0.0075  # of a coordinate, as our corners are measured
PRINT_SIGMA_M = 5e-5
BLUR_PX = 0.95  # of a light, the pixel included
PEAK, BACKGROUND_SIGMA, SHOT_GAIN = 150.0, 0.6, 0.026  # grey levels: a light that is exposed well
TILT_RAD, NEAREST_M, FARTHEST_M = (0.2, 0.7), 0.45, 1.6  # of the board's views


@dataclass(frozen=True)
class Mount:
    """One side's pair as it is meant to be."""

    focal_mm: float
    pixel_um: float
    size_px: tuple[int, int]
    baseline_m: float
    position_m: tuple[float, float, float]
    """middle between the cameras, body frame"""
    outboard: tuple[float, float, float]
    """direction in which the pair looks"""


@dataclass(frozen=True, eq=False)
class Prediction:
    """What a mount gives for the M markers of a wing of one bend."""

    places_m: Array
    """(M, 3) body frame"""
    in_view: NDArray[np.bool_]
    """(M,) of both cameras"""
    noise_mm: Array
    """(M, 3) sigma of x, y, z from image noise; NaN out of view"""
    calibration_mm: Array
    """(M, 3) sigma from the calibration"""
    field_of_view_deg: tuple[float, float]
    """horizontal and vertical, of one camera"""


def ideal_pair(mount: Mount) -> StereoPair:
    """The pair without mounting errors and distortion."""
    focal_px = 1000.0 * mount.focal_mm / mount.pixel_um
    width, height = mount.size_px
    K = np.array([[focal_px, 0.0, (width - 1) / 2], [0.0, focal_px, (height - 1) / 2], [0.0, 0.0, 1.0]])
    camera = CameraModel(width, height, K, np.zeros(5))
    return StereoPair(camera, camera, pose_matrix([0.0, 0.0, 0.0], [-mount.baseline_m, 0.0, 0.0]))


def calibrated(pair: StereoPair, board: Board, views: int, seed: int = 0) -> StereoPair:
    """``pair`` with the covariance that a calibration from ``views`` views of ``board`` would have.

    ProcessError if the board cannot be held so that both cameras see it whole.
    """
    rng = np.random.default_rng(seed)
    printed = np.column_stack(
        [board.points_m + rng.normal(0.0, PRINT_SIGMA_M, board.points_m.shape), np.zeros(board.corners)]
    )
    corners = np.empty((2, views, board.corners, 2))
    for view, distance_m in enumerate(np.geomspace(NEAREST_M, FARTHEST_M, views)):
        corners[:, view] = _view(pair, printed, float(distance_m), rng)
    corners += rng.normal(0.0, CORNER_SIGMA_PX, corners.shape)
    covariance = calibrate(corners, board, (pair.cam0.width, pair.cam0.height)).pair.covariance
    return StereoPair(pair.cam0, pair.cam1, pair.T_cam1_cam0, covariance)


def predict(mount: Mount, pair: StereoPair, layout: MarkerLayout, tip_slope_rad: float, light_m: float) -> Prediction:
    """Errors of the markers of a wing bent to ``tip_slope_rad``, with lights of diameter ``light_m``."""
    side_name = "right" if mount.outboard[1] > 0 else "left"
    places = wing_places_m(side_name, layout, tip_slope_rad)
    T = approximate_pose(pair, np.array(mount.position_m), np.array(mount.outboard))
    in_cam0 = (places - T[:3, 3]) @ T[:3, :3]
    pixels = pair.cam0.project(in_cam0), pair.cam1.project(in_cam0 + pair.T_cam1_cam0[:3, 3])
    size = np.array(mount.size_px)
    in_view = np.all([np.all((seen > 0) & (seen < size - 1), axis=1) for seen in pixels], axis=0)
    focal_px = pair.cam0.K[0, 0]
    sigma_px = np.full(len(places), np.nan)
    for marker in np.flatnonzero(in_view).tolist():
        radius_px = focal_px * light_m / 2 / in_cam0[marker, 2]
        sigma_px[marker] = spot_bound_px(radius_px, BLUR_PX, PEAK, BACKGROUND_SIGMA, SHOT_GAIN)
    covariance_px2 = sigma_px[:, None, None] ** 2 * np.eye(2)
    side = RigSide(pair, T, "", "", 0.0)
    noise = np.full((len(places), 3, 3), np.nan)
    spread = covariance_px2[in_view]
    seen0, seen1 = (seen[in_view] for seen in pixels)
    noise[in_view] = triangulate(side, seen0, seen1, spread, spread, "default").covariance_m2
    response = T[:3, :3] @ triangulated_by_calibration(pair, in_cam0)
    covariance = np.full((24, 24), np.nan) if pair.covariance is None else pair.covariance
    shared = response @ covariance @ response.transpose(0, 2, 1)
    shared[~in_view] = np.nan
    width_deg, height_deg = (float(np.degrees(2 * np.arctan(extent / 2 / focal_px))) for extent in mount.size_px)
    return Prediction(places, in_view, _sigmas_mm(noise), _sigmas_mm(shared), (width_deg, height_deg))


def _sigmas_mm(covariance_m2: Array) -> Array:
    return np.asarray(1000.0 * np.sqrt(np.diagonal(covariance_m2, axis1=1, axis2=2)))


def _view(pair: StereoPair, printed: Array, distance_m: float, rng: np.random.Generator) -> Array:
    """(2, N, 2) corners of a board somewhere in view of both cameras, tilted; farther away if it does not fit."""
    size = np.array([pair.cam0.width, pair.cam0.height])
    while distance_m < 8.0:
        for _ in range(300):
            ray = (rng.uniform(0.0, 1.0, 2) * size - pair.cam0.K[:2, 2]) / pair.cam0.K[0, 0]
            direction, tilt = rng.uniform(0.0, 2 * np.pi), rng.uniform(*TILT_RAD)
            turn = rotation_matrix(np.array([np.cos(direction) * tilt, np.sin(direction) * tilt, 0.0]))
            roll = rotation_matrix(np.array([0.0, 0.0, rng.uniform(-0.35, 0.35)]))
            points = printed @ (turn @ roll).T + distance_m * np.array([*ray, 1.0])
            seen = np.stack([pair.cam0.project(points), pair.cam1.project(points + pair.T_cam1_cam0[:3, 3])])
            if np.all((seen > 5.0) & (seen < size - 6.0)):
                return np.asarray(seen)
        distance_m *= 1.1
    raise ProcessError("no place shows the whole board to both cameras: plan with a smaller board or a shorter lens")
