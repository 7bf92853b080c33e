"""A calibration to the view of the board that would improve it most.

A grid of poses is tried: the board at several distances, in the middle of what both cameras see and as far to each side
as it fits, facing the pair (half way between its axes: they may be turned in) and turned each way. A view adds
information (Fisher's, ``bundle.view_information``) that does not depend on what is measured in it: the covariance with
it is known before it is taken.
"""

from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve

from process.board import Board
from process.bundle import prior_information, rotation_matrix, view_information
from process.calibrate import Calibration, Method, print_scale_covariance
from process.camera_model import StereoPair, pose_matrix
from process.shared_error import triangulated_by_calibration

Array = NDArray[np.float64]

SHARES = (0.85, 0.6, 0.4, 0.25)  # of the image's width that the board takes: distances
TILT_DEG = 35.0
MARGIN_PX = 10.0  # of the whole board from the images' rims
LEAST_SPACING_PX = 8.0  # of corners: the finder needs it
HORIZONTAL = {-1: "left", 0: "", 1: "right"}
VERTICAL = {-1: "top", 0: "", 1: "bottom"}
TILTS = {
    (0, 0): "facing the cameras",
    (1, 0): "turned by {:.0f} deg about the horizontal so that its top comes nearer",
    (-1, 0): "turned by {:.0f} deg about the horizontal so that its bottom comes nearer",
    (0, 1): "turned by {:.0f} deg about the vertical so that its right side comes nearer",
    (0, -1): "turned by {:.0f} deg about the vertical so that its left side comes nearer",
}


@dataclass(frozen=True, eq=False)
class NextView:
    """Where to hold the board next, and what it will give."""

    T_cam0_board: Array
    """(4, 4) metres"""
    range_m: float
    tilt_deg: tuple[float, float]
    """about the horizontal and the vertical of the pair's middle, from facing it"""
    place: str
    """part of the image"""
    text: str
    worst_sigma_mm: float
    """of a point, the largest over the places asked for: now"""
    then_worst_sigma_mm: float
    """with the view added"""

    def to_dict(self) -> dict[str, Any]:
        return {
            "T_cam0_board": self.T_cam0_board.tolist(),
            "range_m": self.range_m,
            "tilt_deg": list(self.tilt_deg),
            "place": self.place,
            "text": self.text,
            "worst_sigma_mm": self.worst_sigma_mm,
            "then_worst_sigma_mm": self.then_worst_sigma_mm,
        }


def advise(calibration: Calibration, board: Board, points_cam0: Array) -> NextView | None:
    """The pose that lowers most the largest uncertainty of ``points_cam0`` (N, 3), metres.

    None with method ``paper``, which knows no uncertainty, without points, and where no pose is in both images whole.
    """
    candidates = _candidates(calibration.pair, board) if calibration.settings.method is Method.joint else []
    if not candidates or not len(points_cam0):
        return None
    worst = _Prediction(calibration, board, points_cam0)
    now_mm = worst.sigma_mm(None)
    scored = [(worst.sigma_mm(pose), pose, words) for pose, words in candidates]
    then_mm, pose, (range_m, place, tilt) = min(scored, key=lambda each: each[0])
    turned = TILTS[tilt].format(TILT_DEG)
    at_m = f"{range_m:.1f}" if range_m >= 1.0 else f"{range_m:.2f}"
    text = f"hold the board at {at_m} m in the {place} of the left camera's image, {turned}"
    T_cam0_board = pose_matrix(pose[:3], pose[3:])
    return NextView(T_cam0_board, range_m, (TILT_DEG * tilt[0], TILT_DEG * tilt[1]), place, text, now_mm, then_mm)


class _Prediction:
    """Worst uncertainty of some points, with and without one more view."""

    def __init__(self, calibration: Calibration, board: Board, points_cam0: Array) -> None:
        self._calibration = calibration
        seen = np.asarray(np.isfinite(calibration.residuals_px[..., 0]))
        self._board_seen = np.asarray(seen.any(axis=(0, 1)))
        self._information = prior_information(calibration.estimate, calibration.freedom, self._board_seen)
        for index, view in enumerate(calibration.estimate.views):
            information, to_parameters = self._of(view, seen[:, index])
            self._information = self._information + information
        response = triangulated_by_calibration(calibration.pair, points_cam0)
        response = response[np.isfinite(response).all(axis=(1, 2))]
        scale = response @ print_scale_covariance(calibration.estimate, board) @ response.transpose(0, 2, 1)
        self._scale_m2 = np.trace(scale, axis1=1, axis2=2)
        self._by_shared = response @ to_parameters

    def _of(self, view: Array, seen: NDArray[np.bool_]) -> tuple[Array, Array]:
        """``view_information`` of the board at ``view`` (6,), its corners ``seen`` (2, N)."""
        estimate = replace(self._calibration.estimate, views=view[None])
        return view_information(estimate, self._calibration.freedom, seen, self._board_seen)

    def sigma_mm(self, pose: Array | None) -> float:
        """Largest sigma (length of the three axes') with a view at ``pose`` (6,) added."""
        information = self._information
        if pose is not None:
            information = information + self._of(pose, np.stack([self._board_seen, self._board_seen]))[0]
        size = 1.0 / np.sqrt(np.diag(information))
        scaled = self._by_shared.reshape(-1, len(size)) * size
        solved = solve(information * np.outer(size, size), scaled.T, assume_a="pos").T
        noise_px2 = self._calibration.sigma_px**2
        variance = noise_px2 * np.sum((scaled * solved).reshape(self._by_shared.shape), axis=(1, 2)) + self._scale_m2
        return float(1000.0 * np.sqrt(variance.max()))


def _candidates(pair: StereoPair, board: Board) -> list[tuple[Array, tuple[float, str, tuple[int, int]]]]:
    """Poses (6,) of the whole board in both images, with range, part of the image and direction of the tilt."""
    corners = np.column_stack([board.points_m, np.zeros(board.corners)])
    width_m = (board.columns - 1) * board.square_m
    found: dict[tuple[float, ...], tuple[Array, tuple[float, str, tuple[int, int]]]] = {}
    for share in SHARES:
        range_m = float(pair.cam0.K[0, 0] * width_m / (share * pair.cam0.width))
        if share * pair.cam0.width / (board.columns - 1) < LEAST_SPACING_PX:
            continue
        for tilt, (down, right) in product(TILTS, product(VERTICAL, HORIZONTAL)):
            tilted = pose_matrix(np.radians(TILT_DEG) * np.array([*tilt, 0.0]), np.zeros(3))[:3, :3]
            turn = cv2.Rodrigues(pair.middle_axes @ tilted)[0].ravel()
            turned = corners @ rotation_matrix(turn).T
            place = _farthest(pair, turned, range_m, np.array([right, down], np.float64))
            if place is not None:
                words = (range_m, _place_name(pair, place), tilt)
                found.setdefault(tuple(np.round([*turn, *place], 3)), (np.concatenate([turn, place]), words))
    return list(found.values())


def _farthest(pair: StereoPair, turned: Array, range_m: float, direction: Array) -> Array | None:
    """Centre (3,) of a board ``turned``, moved in ``direction`` as far as both cameras see it whole; None: nowhere."""
    R, t = pair.T_cam1_cam0[:3, :3], pair.T_cam1_cam0[:3, 3]
    start = pair.middle_of_view(range_m)
    reach = 0.5 * np.array([pair.cam0.width, pair.cam0.height]) / np.diag(pair.cam0.K)[:2] * range_m

    def fits(centre: Array) -> bool:
        points = turned + centre
        seen = ((pair.cam0, points), (pair.cam1, points @ R.T + t))
        return all(_inside(camera.project(own), camera.width, camera.height) for camera, own in seen)

    if not fits(start):
        return None
    least, most = 0.0, 1.0
    for _ in range(8 if direction.any() else 0):
        share = 0.5 * (least + most)
        if fits(start + np.append(share * reach * direction, 0.0)):
            least = share
        else:
            most = share
    return np.asarray(start + np.append(least * reach * direction, 0.0))


def _inside(pixels: Array, width: int, height: int) -> bool:
    with np.errstate(invalid="ignore"):
        return bool(np.all((pixels >= MARGIN_PX) & (pixels <= [width - 1 - MARGIN_PX, height - 1 - MARGIN_PX])))


def _place_name(pair: StereoPair, centre: Array) -> str:
    """Part of cam0's image, by ninths, that a point (3,) falls into."""
    u, v = pair.cam0.project(centre)[0] / [pair.cam0.width, pair.cam0.height]
    return region_name(int(np.clip(3.0 * v, 0, 2)), int(np.clip(3.0 * u, 0, 2)))


def region_name(row: int, column: int) -> str:
    """Words for one of the 3 × 3 parts of an image."""
    return " ".join(filter(None, (VERTICAL[row - 1], HORIZONTAL[column - 1]))) or "middle"
