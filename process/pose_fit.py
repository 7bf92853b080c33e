"""Spots of surveyed lights to the pose that fits them best: the least-squares problem, and the geometry it needs."""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from process.bundle import cross_matrix, rotation_matrix
from process.camera_model import StereoPair
from process.detect import Detections

Array = NDArray[np.float64]

MODEL_SIGMA_PX = 0.03  # what the lens model and the spot model leave, added to each centroid's own noise
CHI2_LIMIT = 25.0  # of a light's 4 degrees of freedom: one good light in 20 000 is beyond
MEDIAN_CHI2 = 3.36  # of χ² with 4


class PoseProblem:
    """Unknowns: the pose's change (rotation vector, shift; body axes), then each light's offset from its survey."""

    def __init__(self, pair: StereoPair, surveyed_m: Array, sigma_m: Array, pixels: Array, whitening: Array) -> None:
        self._pair, self._surveyed, self._sigma = pair, surveyed_m, sigma_m
        self._pixels, self._whitening = pixels, whitening

    def solve(self) -> tuple[Array, Array, Array, Array, Array]:
        """T_body_cam0, χ² of each light, the pose's covariance, residuals in pixels (N, 2, 2), pose by calibration."""
        points = triangulate_midpoint(self._pair, self._pixels[:, 0], self._pixels[:, 1])
        T = kabsch(points, self._surveyed)
        count = len(self._surveyed)
        solution = least_squares(
            lambda x: self.residuals(T, x)[0],
            np.zeros(6 + 3 * count),
            jac=lambda x: self.residuals(T, x)[1],
            x_scale="jac",
            xtol=1e-12,
            ftol=1e-14,
            gtol=1e-12,
        )
        moved = moved_pose(T, solution.x[:6])
        residuals, jacobian = self.residuals(moved, np.concatenate([np.zeros(6), solution.x[6:]]))
        by_light = np.hstack([residuals[: 4 * count].reshape(count, 4), residuals[4 * count :].reshape(count, 3)])
        chi2: Array = np.sum(by_light**2, axis=1)
        inverse = np.linalg.inv(jacobian.T @ jacobian)
        covariance = np.asarray(inverse[:6, :6], np.float64)
        # the optimum stays one when θ changes: Jᵀ J dx + Jᵀ (∂r/∂θ) dθ = 0, to first order
        by_calibration = -inverse[:6] @ jacobian.T @ self.by_calibration(moved, solution.x[6:])
        projected = np.stack(project(self._pair, moved, self._surveyed + solution.x[6:].reshape(-1, 3)), axis=1)
        return moved, chi2, covariance, np.asarray(self._pixels - projected), np.asarray(by_calibration)

    def by_calibration(self, T: Array, offsets: Array) -> Array:
        """Derivative (7N, 24) of the residuals by the pair's parameters."""
        values, x = self._pair.parameters, np.concatenate([np.zeros(6), offsets])
        slope = np.empty((7 * len(self._surveyed), len(values)))
        for index, value in enumerate(values):
            step = np.zeros(len(values))
            step[index] = 1e-6 * max(1.0, abs(value))
            ahead, behind = (
                PoseProblem(
                    self._pair.with_parameters(values + sign * step),
                    self._surveyed,
                    self._sigma,
                    self._pixels,
                    self._whitening,
                ).residuals(T, x)[0]
                for sign in (1, -1)
            )
            slope[:, index] = (ahead - behind) / (2 * step[index])
        return slope

    def residuals(self, T_start: Array, x: Array) -> tuple[Array, Array]:
        """Whitened residuals (7N,), pixels then survey, and their Jacobian (7N, 6 + 3N)."""
        count = len(self._surveyed)
        offsets = x[6:].reshape(-1, 3)
        T = moved_pose(T_start, x[:6])
        R = T[:3, :3]
        from_pair = self._surveyed + offsets - T[:3, 3]
        in_cam0 = from_pair @ R
        R10, t10 = self._pair.T_cam1_cam0[:3, :3], self._pair.T_cam1_cam0[:3, 3]
        pixels0, by_cam0 = self._pair.cam0.project_with_jacobian(in_cam0)
        pixels1, by_cam1 = self._pair.cam1.project_with_jacobian(in_cam0 @ R10.T + t10)
        by_point = self._whitening @ (np.stack([by_cam0, by_cam1 @ R10], axis=1) @ R.T)  # (N, 2, 2, 3), body axes
        error = (self._whitening @ (np.stack([pixels0, pixels1], axis=1) - self._pixels)[..., None])[..., 0]
        jacobian = np.zeros((7 * count, len(x)))
        # R = exp(ω) R0: d(Rᵀ v)/dω = Rᵀ [v]× J(ω), with J(ω) = I at the solution, where it is used for covariances
        by_turn = cross_matrix(from_pair) @ _left_jacobian(x[:3])
        jacobian[: 4 * count, :3] = (by_point @ by_turn[:, None]).reshape(-1, 3)
        jacobian[: 4 * count, 3:6] = -by_point.reshape(-1, 3)
        for light in range(count):
            jacobian[4 * light : 4 * light + 4, 6 + 3 * light : 9 + 3 * light] = by_point[light].reshape(4, 3)
        jacobian[4 * count :, 6:] = np.diag(np.repeat(1.0 / self._sigma, 3))
        return np.concatenate([error.ravel(), (offsets / self._sigma[:, None]).ravel()]), jacobian


def _left_jacobian(rotation_rad: Array) -> Array:
    """To second order: the change from the aligned start is some milliradians."""
    w = cross_matrix(rotation_rad)
    return np.asarray(np.eye(3) + 0.5 * w + w @ w / 6.0)


def moved_pose(T: Array, change: Array) -> Array:
    """``T`` (4, 4) turned by a rotation vector and shifted, ``change`` (6,), in the outer frame's axes."""
    moved = T.copy()
    moved[:3, :3] = rotation_matrix(change[:3]) @ T[:3, :3]
    moved[:3, 3] += change[3:6]
    return moved


def triangulate_midpoint(pair: StereoPair, pixels0: Array, pixels1: Array) -> Array:
    """Points (N, 3), cam0's frame, half way between the rays of ``pixels0`` and ``pixels1`` (N, 2); NaN if parallel."""
    R, t = pair.T_cam1_cam0[:3, :3], pair.T_cam1_cam0[:3, 3]
    ray0, ray1 = (
        np.column_stack([camera.undistort(pixels), np.ones(len(pixels))])
        for camera, pixels in ((pair.cam0, pixels0), (pair.cam1, pixels1))
    )
    ray1, centre1 = ray1 @ R, -R.T @ t
    a, b, c = (np.sum(x * y, axis=1) for x, y in ((ray0, ray0), (ray0, ray1), (ray1, ray1)))
    d, e = ray0 @ centre1, ray1 @ centre1
    with np.errstate(all="ignore"):  # parallel rays divide by zero: inf is set to NaN
        denominator = a * c - b * b
        s, u = (c * d - b * e) / denominator, (b * d - a * e) / denominator
        points = 0.5 * (s[:, None] * ray0 + centre1 + u[:, None] * ray1)
        ahead = (s > 0.0) & (u > 0.0) & np.all(np.isfinite(points), axis=1)
    points[~ahead] = np.nan
    return np.asarray(points)


def kabsch(points_cam: Array, points_body: Array) -> Array:
    """Pose (4, 4) that takes ``points_cam`` (N, 3) to ``points_body`` with least squares (Kabsch, 1976)."""
    centre_cam, centre_body = points_cam.mean(axis=0), points_body.mean(axis=0)
    U, _, Vt = np.linalg.svd((points_body - centre_body).T @ (points_cam - centre_cam))
    T = np.eye(4)
    T[:3, :3] = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    T[:3, 3] = centre_body - T[:3, :3] @ centre_cam
    return T


def project(pair: StereoPair, T_body_cam0: Array, points_body: Array) -> tuple[Array, Array]:
    """Pixels (N, 2) in cam0 and cam1 of ``points_body`` (N, 3); NaN where out of view."""
    in_cam0 = (points_body - T_body_cam0[:3, 3]) @ T_body_cam0[:3, :3]
    in_cam1 = in_cam0 @ pair.T_cam1_cam0[:3, :3].T + pair.T_cam1_cam0[:3, 3]
    return pair.cam0.project(in_cam0), pair.cam1.project(in_cam1)


def measured(assigned: NDArray[np.intp], spots0: Detections, spots1: Detections) -> tuple[Array, Array]:
    """Pixels (N, 2, 2) by light and camera, and the inverse square roots (N, 2, 2, 2) of their covariances."""
    pixels = np.stack([spots0.pixels[assigned[:, 0]], spots1.pixels[assigned[:, 1]]], axis=1)
    covariance = np.stack([spots0.covariance_px2[assigned[:, 0]], spots1.covariance_px2[assigned[:, 1]]], axis=1)
    covariance = np.nan_to_num(covariance, nan=0.0) + MODEL_SIGMA_PX**2 * np.eye(2)
    return pixels, np.linalg.inv(np.linalg.cholesky(covariance))
