"""Corners seen in many views to cameras, poses and the board itself: one least-squares adjustment of everything.

Minimises the pixel residuals of all corners in all views of one or two cameras over any of: the intrinsics, the pose
between the cameras, the board's pose in each view, the board's own printed corners in its plane, and its bow out of
it. With equal independent noise this is maximum likelihood, and its covariance is s² (JᵀJ)⁻¹ (Hartley & Zisserman,
Multiple View Geometry, 2nd ed., §5.2 and app. 6).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space, solve

from capture.errors import ProcessError
from process.camera_model import INTRINSIC_NAMES, distort, pose_matrix

Array = NDArray[np.float64]

INTRINSICS = len(INTRINSIC_NAMES)
TERMS = {2: [4, 5], 5: [4, 5, 6, 7, 8]}  # which of the intrinsics are distortion terms that may move
MAX_EVALUATIONS = 200
LEAST_DAMPING, MOST_DAMPING = 1e-12, 1e10
LEAST_COSINE = 1e-9  # between the residuals and a column of the Jacobian, where the adjustment ends
WEAK = 1e-10  # squared ratio of the scaled Jacobian's singular values below which a parameter is undetermined


@dataclass(frozen=True, eq=False)
class Estimate:
    """Values of everything the adjustment may move. Rotations are rotation vectors (rad), lengths metres."""

    intrinsics: Array
    """(C, 9) for C = 1 or 2 cameras, in the order of INTRINSIC_NAMES"""
    stereo: Array
    """(6,) rotation and translation of T_cam1_cam0; not used with one camera"""
    views: Array
    """(V, 6) rotation and translation of T_cam0_board"""
    board_m: Array
    """(N, 2) corners in the board's plane"""
    height_m: Array | float = 0.0
    """(N,) of the corners along the board's z axis, or 0: flat"""

    @property
    def corners_m(self) -> Array:
        """(N, 3) corners in the board's frame."""
        return np.column_stack([self.board_m, np.zeros(len(self.board_m)) + self.height_m])


@dataclass(frozen=True)
class Freedom:
    """What may move, besides the board's pose in each view."""

    intrinsics: bool = True
    distortion_terms: int = 5
    stereo: bool = True
    board: bool = False
    """The printed corners: 2N − 4 numbers, since the frame and the mean scale stay the nominal board's."""
    bow_prior_px_per_m: float = 0.0
    """The board's bow, a quadratic with 3 coefficients, each its height where the board's farthest corner is: the
    pixels that weigh as much as a metre of one, that is a corner's noise by the prior sigma. 0: flat."""


@dataclass(frozen=True, eq=False)
class Adjustment:
    """Where the adjustment ended."""

    estimate: Estimate
    residuals_px: Array
    """(C, V, N, 2) projected minus measured"""
    covariance: Array
    """(9C + 6, 9C + 6) of intrinsics and stereo pose; zero for what was held"""
    board_covariance_m2: Array
    """(2N, 2N) of the printed corners; zero if they were held"""
    height_sigma_m: Array
    """(N,) of the corners' heights; zero if the board was held flat"""
    sigma_px: float
    """noise of one coordinate, from the residuals"""
    gradient: float
    """largest cosine between the residuals and a column of the Jacobian: 0 at an optimum"""
    evaluations: int

    @property
    def rms_px(self) -> float:
        """Root mean square distance over all corners, OpenCV's measure."""
        return rms_px(self.residuals_px)


def rms_px(residuals_px: Array) -> float:
    """Root mean square length of residuals (…, 2), those that are NaN left out."""
    return float(np.sqrt(np.nanmean(np.sum(residuals_px**2, axis=-1))))


def adjust(corners_px: Array, start: Estimate, freedom: Freedom) -> Adjustment:
    """Adjust ``start`` to ``corners_px`` (C, V, N, 2), NaN where a corner was not seen.

    Raises ProcessError if the views do not determine what is asked for, or the optimum is not reached.
    """
    seen = np.isfinite(corners_px)
    space = _Space(start, freedom, np.asarray(seen.any(axis=(0, 1, 3))))
    freedoms = int(seen.sum()) + len(space.prior) - space.zero.size
    if freedoms <= 0:
        raise ProcessError("too few corners for this many unknowns; take more views of the board")
    x, evaluations = _minimised(space, corners_px)
    estimate = space.estimate(x)
    whole = residuals_of(estimate, corners_px)
    residuals = np.concatenate([whole[seen], space.prior @ x])
    jacobian = np.vstack([space.jacobian(x, seen), space.prior])
    if not np.all(np.isfinite(residuals)):
        raise ProcessError("the adjustment diverged; take more views of the board, tilted in different directions")
    columns = np.linalg.norm(jacobian, axis=0)
    length = np.linalg.norm(residuals)
    cosine = np.abs(jacobian.T @ residuals) / np.maximum(columns * length, 1e-300)
    gradient = float(cosine.max()) if length > 1e-9 else 0.0  # without residuals it is rounding alone
    scaled = jacobian / columns
    eigenvalues, vectors = np.linalg.eigh(scaled.T @ scaled)
    if eigenvalues[0] < WEAK * eigenvalues[-1]:
        raise ProcessError(
            "the views do not determine the cameras: take views with the board tilted in different directions, at "
            "different distances, and all over the image"
        )
    variance = float(length**2 / freedoms)
    half = vectors / np.sqrt(eigenvalues) / columns[:, None]
    covariance = space.to_parameters @ half
    board, height = space.to_board @ half, space.to_height @ half
    return Adjustment(
        estimate,
        whole,
        variance * covariance @ covariance.T,
        variance * board @ board.T,
        np.sqrt(variance * np.sum(height**2, axis=1)),
        float(np.sqrt(variance)),
        gradient,
        evaluations,
    )


def _minimised(space: "_Space", corners_px: Array) -> tuple[Array, int]:
    """The x with the least squared residuals, and how often these were computed (Levenberg and Marquardt).

    By the normal equations of columns scaled to one: a fraction of the time of a QR factorisation, and as exact where
    it ends, since what ends it is the gradient itself.
    """
    x, damping, seen = space.zero.copy(), 1e-4, np.isfinite(corners_px)

    def residuals_at(x: Array) -> Array:
        return np.concatenate([residuals_of(space.estimate(x), corners_px)[seen], space.prior @ x])

    residuals = residuals_at(x)
    for evaluation in range(1, MAX_EVALUATIONS):
        jacobian = np.vstack([space.jacobian(x, seen), space.prior])
        if not np.all(np.isfinite(jacobian)):
            return x, evaluation
        columns = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
        scaled = jacobian / columns
        normal, gradient = scaled.T @ scaled, scaled.T @ residuals
        while True:
            damped = normal + damping * np.eye(len(x))
            step = -np.asarray(solve(damped, gradient, assume_a="pos", check_finite=False)) / columns
            trial = residuals_at(x + step)
            if trial @ trial <= residuals @ residuals:
                break
            damping *= 10.0
            if damping > MOST_DAMPING:  # no step is downhill: this is the optimum, to rounding
                return x, evaluation
        gain = residuals @ residuals - trial @ trial
        x, residuals, damping = x + step, trial, max(0.1 * damping, LEAST_DAMPING)
        length = np.linalg.norm(residuals)
        if gain <= 1e-15 * length**2 or length < 1e-9 or np.abs(gradient).max() < LEAST_COSINE * length:
            return x, evaluation
    return x, MAX_EVALUATIONS


class _Space:
    """The numbers that move, x, and the estimate they stand for: start + a linear map of x."""

    def __init__(self, start: Estimate, freedom: Freedom, seen: NDArray[np.bool_] | None = None) -> None:
        cameras = len(start.intrinsics)
        moving = [0, 1, 2, 3, *TERMS[freedom.distortion_terms]] if freedom.intrinsics else []
        chosen = [INTRINSICS * camera + index for camera in range(cameras) for index in moving]
        if cameras == 2 and freedom.stereo:
            chosen += range(2 * INTRINSICS, 2 * INTRINSICS + 6)
        self._start = start
        self._shape = (cameras, len(start.views), len(start.board_m))
        self._parameters = np.eye(INTRINSICS * cameras + 6)[:, chosen]
        seen = np.ones(len(start.board_m), bool) if seen is None else seen
        self._board = _board_freedom(start.board_m, seen) if freedom.board else np.zeros((start.board_m.size, 0))
        self._bow = _bow_shapes(start.board_m)[:, : 3 if freedom.bow_prior_px_per_m else 0]
        self._sizes = np.cumsum([len(chosen), start.views.size, self._board.shape[1], self._bow.shape[1]])
        self.zero = np.zeros(self._sizes[-1])
        first, second, third, end = self._sizes
        self.to_parameters = np.zeros((len(self._parameters), end))
        """(9C + 6, len(x)) the cameras' parameters by x"""
        self.to_parameters[:, :first] = self._parameters
        self.to_board = np.zeros((start.board_m.size, end))
        """(2N, len(x)) the printed corners by x"""
        self.to_board[:, second:third] = self._board
        self.to_height = np.zeros((len(start.board_m), end))
        """(N, len(x)) the corners' heights by x"""
        self.to_height[:, third:] = self._bow
        self.prior = freedom.bow_prior_px_per_m * np.eye(end)[third:]
        """(·, len(x)) x to further residuals, in px: none, or the bow's"""
        self.shared = np.r_[:first, second:end]
        """which of x all views have in common"""

    def estimate(self, x: Array) -> Estimate:
        cameras = self._shape[0]
        change, views, board, bow = np.split(x, self._sizes[:3])
        parameters = self._parameters @ change
        return Estimate(
            self._start.intrinsics + parameters[: INTRINSICS * cameras].reshape(cameras, INTRINSICS),
            self._start.stereo + parameters[INTRINSICS * cameras :],
            self._start.views + views.reshape(-1, 6),
            self._start.board_m + (self._board @ board).reshape(-1, 2),
            self._start.height_m + self._bow @ bow,
        )

    def jacobian(self, x: Array, seen: NDArray[np.bool_] | None = None) -> Array:
        """(residuals, len(x)) of the residuals, in px, by x; of those (C, V, N, 2) that were ``seen``, or of all."""
        cameras, views, corners = self._shape
        estimate = self.estimate(x)
        by_all = np.zeros((cameras, views, corners, 2, len(x)))
        first, second, third, _ = self._sizes
        for camera in range(cameras):
            by_parameters, by_view, by_board = _camera_jacobian(estimate, camera)
            by_all[camera, ..., :first] = by_parameters @ self._parameters
            for view in range(views):
                by_all[camera, view, ..., first + 6 * view : first + 6 * view + 6] = by_view[view]
            per_corner = self._board.reshape(corners, 2, -1)
            by_all[camera, ..., second:third] = np.einsum("vnij,njk->vnik", by_board[..., :2], per_corner)
            by_all[camera, ..., third:] = by_board[..., 2:] * self._bow[:, None]
        return by_all.reshape(-1, len(x)) if seen is None or seen.all() else by_all[seen]


def _board_freedom(board_m: Array, seen: NDArray[np.bool_]) -> Array:
    """(2N, 2S − 4) changes of the S corners ``seen`` that keep their mean, their mean turn and their mean scale."""
    x, y = (board_m[seen] - board_m[seen].mean(axis=0)).T
    one, zero = np.ones_like(x), np.zeros_like(x)
    held = [np.stack(pair, axis=1).ravel() for pair in ((one, zero), (zero, one), (-y, x), (x, y))]
    free = null_space(np.array(held))
    whole = np.zeros((board_m.size, free.shape[1]))
    whole[np.repeat(seen, 2)] = free
    return whole


def _bow_shapes(board_m: Array) -> Array:
    """(N, 3) heights of a board bent along x, along y and twisted, 1 at the farthest corner's distance."""
    x, y = (board_m / np.linalg.norm(board_m, axis=1).max()).T
    return np.stack([x * x, y * y, x * y], axis=1)


def view_information(
    estimate: Estimate, freedom: Freedom, seen: NDArray[np.bool_], board_seen: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """What one view tells of all but its own pose: (S, S) for noise of one pixel, and (9C + 6, S) to parameters.

    ``estimate`` holds that view alone, ``seen`` (C, N) its corners, ``board_seen`` (N,) those of the whole session. The
    view's pose is eliminated (Schur's complement), so that views add, and ``prior_information`` to them.
    """
    space = _Space(estimate, freedom, board_seen)
    mask = np.repeat(seen[:, None, :, None], 2, axis=-1)
    jacobian = space.jacobian(space.zero, mask)
    shared, own = jacobian[:, space.shared], np.delete(jacobian, space.shared, axis=1)
    cross = own.T @ shared
    return shared.T @ shared - cross.T @ np.linalg.solve(own.T @ own, cross), space.to_parameters[:, space.shared]


def prior_information(estimate: Estimate, freedom: Freedom, board_seen: NDArray[np.bool_]) -> Array:
    """(S, S) what is known without any view: of the bow only."""
    space = _Space(estimate, freedom, board_seen)
    prior = space.prior[:, space.shared]
    return np.asarray(prior.T @ prior)


def residuals_of(estimate: Estimate, corners_px: Array) -> Array:
    """Projected minus measured pixels, (C, V, N, 2) as ``corners_px``."""
    return np.stack([_project(estimate, camera) for camera in range(len(corners_px))]) - corners_px


def _project(estimate: Estimate, camera: int) -> Array:
    """Pixels (V, N, 2) of the board's corners in one camera."""
    points = _points(estimate, camera)[-1].reshape(-1, 3)
    fx, fy, cx, cy, *distortion = estimate.intrinsics[camera]
    distorted, _ = distort(points[:, :2] / points[:, 2:], np.array(distortion))
    return np.asarray(distorted * [fx, fy] + [cx, cy]).reshape(len(estimate.views), -1, 2)


def _points(estimate: Estimate, camera: int) -> list[Array]:
    """Corners (V, N, 3): turned into cam0's axes, in cam0; for cam1 also turned into its axes, in cam1."""
    corners = estimate.corners_m
    turned = np.stack([corners @ rotation_matrix(view[:3]).T for view in estimate.views])
    chain = [turned, turned + estimate.views[:, None, 3:]]
    if camera == 1:
        turned = chain[-1] @ rotation_matrix(estimate.stereo[:3]).T
        chain += [turned, turned + estimate.stereo[3:]]
    return chain


def _camera_jacobian(estimate: Estimate, camera: int) -> tuple[Array, Array, Array]:
    """Derivatives of one camera's pixels, (V, N, 2, ·), by all cameras' parameters, the view's pose and the corners."""
    chain = _points(estimate, camera)
    points = chain[-1]
    by_intrinsics, by_point = lens_jacobian(points.reshape(-1, 3), estimate.intrinsics[camera])
    by_point = by_point.reshape(*points.shape[:2], 2, 3)
    cameras = len(estimate.intrinsics)
    by_parameters = np.zeros((*points.shape[:2], 2, INTRINSICS * cameras + 6))
    own = slice(INTRINSICS * camera, INTRINSICS * (camera + 1))
    by_parameters[..., own] = by_intrinsics.reshape(*points.shape[:2], 2, INTRINSICS)
    if camera == 1:
        by_parameters[..., -6:-3] = by_point @ turn_jacobian(chain[2], estimate.stereo[:3])
        by_parameters[..., -3:] = by_point
        by_point = by_point @ rotation_matrix(estimate.stereo[:3])
    turns = [turn_jacobian(chain[0][i], view[:3]) for i, view in enumerate(estimate.views)]
    by_view = np.concatenate([by_point @ np.stack(turns), by_point], axis=-1)
    axes = np.stack([rotation_matrix(view[:3]) for view in estimate.views])
    return by_parameters, by_view, by_point @ axes[:, None]


def lens_jacobian(points: Array, intrinsics: Array) -> tuple[Array, Array]:
    """Derivatives of the pixels by the intrinsics (M, 2, 9) and by the point in the camera's frame (M, 2, 3)."""
    focal = intrinsics[:2]
    ideal = points[:, :2] / points[:, 2:]
    distorted, slope = distort(ideal, intrinsics[4:])
    x, y = ideal.T
    r2 = x * x + y * y
    by_intrinsics = np.zeros((len(points), 2, INTRINSICS))
    by_intrinsics[:, 0, 0], by_intrinsics[:, 1, 1] = distorted.T
    by_intrinsics[:, 0, 2] = by_intrinsics[:, 1, 3] = 1.0
    for index, power in ((4, r2), (5, r2**2), (8, r2**3)):
        by_intrinsics[:, :, index] = focal * ideal * power[:, None]
    by_intrinsics[:, :, 6] = focal * np.stack([2.0 * x * y, r2 + 2.0 * y * y], axis=1)
    by_intrinsics[:, :, 7] = focal * np.stack([r2 + 2.0 * x * x, 2.0 * x * y], axis=1)
    by_point = np.zeros((len(points), 2, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = 1.0
    by_point[:, :, 2] = -ideal
    return by_intrinsics, focal[:, None] * (slope @ by_point) / points[:, 2, None, None]


def rotation_matrix(rotation_rad: Array) -> Array:
    """Rotation (3, 3) of a rotation vector (3,)."""
    return pose_matrix(rotation_rad, np.zeros(3))[:3, :3]


def cross_matrix(vectors: Array) -> Array:
    """(…, 3, 3) matrices that take the cross product of ``vectors`` (…, 3) with what they multiply."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*vectors.shape, 3)


def turn_jacobian(turned: Array, rotation_rad: Array) -> Array:
    """Derivative (…, 3, 3) of R(w) p by the rotation vector w, where ``turned`` (…, 3) is R(w) p.

    −[R p]× J, with J the left Jacobian of SO(3) (Barfoot, State Estimation for Robotics, eq. 7.77).
    """
    angle = float(np.linalg.norm(rotation_rad))
    w = cross_matrix(rotation_rad)
    if angle < 1e-4:  # the closed form loses digits here; the next terms are of order angle² and angle³
        left = np.eye(3) + 0.5 * w + w @ w / 6.0
    else:
        left = np.eye(3) + (1.0 - np.cos(angle)) / angle**2 * w + (angle - np.sin(angle)) / angle**3 * (w @ w)
    return np.asarray(-cross_matrix(turned) @ left)
