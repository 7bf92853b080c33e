"""Surveyed lights and a calibrated pair to whether a lens was touched, or a camera turned, since the calibration.

The pose is fitted with five more unknowns: a factor on each camera's focal length, and a turn of cam1 against cam0.
Of a pair that is as calibrated they are zero within their sigmas, to which the lights, the survey and the calibration
itself contribute. A varifocal lens that is touched changes by percents; the lights show a thousandth.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from process.camera_model import StereoPair
from process.pose_fit import CHI2_LIMIT, MEDIAN_CHI2, PoseProblem, moved_pose

Array = NDArray[np.float64]

FEWEST_LIGHTS = 5  # 35 equations for 26 unknowns
SURE = 5.0  # sigmas
LEAST_FOCAL_CHANGE = 1e-3
LEAST_TURN_RAD = 2e-4  # 0.01 deg: 3 mm in depth at 2 m


@dataclass(frozen=True, eq=False)
class LensCheck:
    """What has changed since the calibration, and how well that is known."""

    focal_change: Array
    """(2,) relative, of cam0 and cam1"""
    focal_sigma: Array
    turn_rad: Array
    """(3,) of cam1 against cam0, about cam1's axes"""
    turn_sigma_rad: Array
    chi2_ratio: float
    """χ² a degree of freedom with these changes"""
    lights: int

    def findings(self) -> list[str]:
        """A phrase for each change that is beyond doubt, and beyond what does no harm."""
        found = []
        for camera, (change, sigma) in enumerate(zip(self.focal_change, self.focal_sigma, strict=True)):
            if abs(change) > max(SURE * sigma, LEAST_FOCAL_CHANGE):
                found.append(
                    f"cam{camera}'s focal length is {100 * abs(change):.2f} +- {100 * sigma:.2f} % "
                    f"{'longer' if change > 0 else 'shorter'} than calibrated"
                )
        turned = np.abs(self.turn_rad) > np.maximum(SURE * self.turn_sigma_rad, LEAST_TURN_RAD)
        if turned.any():
            angles = ", ".join(f"{value:.3f}" for value in np.degrees(self.turn_rad))
            sigmas = ", ".join(f"{value:.3f}" for value in np.degrees(self.turn_sigma_rad))
            found.append(f"cam1 has turned against cam0 by {angles} +- {sigmas} deg (x, y, z)")
        return found


def check_lens(
    pair: StereoPair, T_start: Array, surveyed_m: Array, sigma_m: Array, pixels: Array, whitening: Array
) -> LensCheck | None:
    """The changes that fit best to lights at ``surveyed_m`` (N, 3) ± ``sigma_m`` (N,); None with fewer than five.

    ``pixels`` (N, 2, 2) by light and camera, and ``whitening`` (N, 2, 2, 2), the inverse square roots of their
    covariances. Lights that do not fit the others are left out. ``T_start`` is near the pose.
    """
    used = np.arange(len(surveyed_m))
    while len(used) >= FEWEST_LIGHTS:
        problem = _LensProblem(pair, T_start, surveyed_m[used], sigma_m[used], pixels[used], whitening[used])
        found, chi2 = problem.solve()
        worst = int(np.argmax(chi2))
        if chi2[worst] <= CHI2_LIMIT * max(1.0, float(np.median(chi2)) / MEDIAN_CHI2):
            return found
        used = np.delete(used, worst)
    return None


class _LensProblem:
    """Unknowns: the pose's change, each light's offset from its survey, two focal factors, a turn of cam1."""

    def __init__(
        self, pair: StereoPair, T_start: Array, surveyed_m: Array, sigma_m: Array, pixels: Array, whitening: Array
    ) -> None:
        self._pair, self._T = pair, T_start
        self._lights = (surveyed_m, sigma_m, pixels, whitening)
        self._count = len(surveyed_m)

    def solve(self) -> tuple[LensCheck, Array]:
        """The changes, and χ² of each light."""
        first = PoseProblem(self._pair, *self._lights)
        solution = least_squares(
            lambda x: self._at(x)[0],
            np.zeros(6 + 3 * self._count + 5),
            jac=lambda x: self._at(x)[1],
            x_scale="jac",
            xtol=1e-10,
        )
        residuals, jacobian = self._at(solution.x)
        count = self._count
        by_light = np.hstack([residuals[: 4 * count].reshape(count, 4), residuals[4 * count :].reshape(count, 3)])
        chi2 = np.sum(by_light**2, axis=1)
        ratio = float(chi2.sum()) / (4 * count - 11)
        inverse = np.linalg.inv(jacobian.T @ jacobian)
        covariance = inverse[-5:, -5:] * max(1.0, ratio)
        if self._pair.covariance is not None:
            T = moved_pose(self._T, solution.x[:6])
            response = inverse[-5:] @ jacobian.T @ first.by_calibration(T, solution.x[6:-5])
            covariance = covariance + response @ self._pair.covariance @ response.T
        sigma = np.sqrt(np.diag(covariance))
        change = solution.x[-5:]
        return LensCheck(change[:2], sigma[:2], change[2:], sigma[2:], ratio, count), chi2

    def _at(self, x: Array) -> tuple[Array, Array]:
        """Residuals (7N,) and Jacobian (7N, 6 + 3N + 5)."""
        residuals, by_pose = self._changed(x[-5:]).residuals(self._T, x[:-5])
        jacobian = np.empty((len(residuals), len(x)))
        jacobian[:, :-5] = by_pose
        for index in range(5):
            step = 1e-6 * np.eye(5)[index]
            ahead, behind = (self._changed(x[-5:] + sign * step).residuals(self._T, x[:-5])[0] for sign in (1, -1))
            jacobian[:, index - 5] = (ahead - behind) / 2e-6
        return residuals, jacobian

    def _changed(self, change: Array) -> PoseProblem:
        values = self._pair.parameters
        values[0:2] *= 1.0 + change[0]
        values[9:11] *= 1.0 + change[1]
        values[18:21] += change[2:]  # cameras stand nearly parallel: the rotation vector turns about cam1's axes
        return PoseProblem(self._pair.with_parameters(values), *self._lights)
