"""Light and noise to the least error that any unbiased measurement of an image can have: the Cramér–Rao bound.

What is unknown is stated with each function; what is not named is known. A bound is for the noise of one image: the
errors that a calibration adds are bounded by its own covariance with the bound's noise in the corners.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.special import chndtr, erf

Array = NDArray[np.float64]

_PHASES = np.array([0.0, 0.25, 0.5])  # places within a pixel that a bound is averaged over
_STEP = 1e-4


def spot_bound_px(
    radius_px: float, blur_px: float, peak: float, background_sigma: float, shot_gain: float = 0.0
) -> float:
    """Least standard deviation of a coordinate of a round light's centre, pixels.

    The light is an even disc of ``radius_px`` under a Gaussian of ``blur_px`` (point spread and pixel together), of
    ``peak`` grey levels at its centre. Unknown: position, amplitude, background, and width (the disc's radius).
    The variance of a pixel is ``background_sigma``² and ``shot_gain`` grey levels an electron times the light.
    """
    reach = int(np.ceil(radius_px + 6.0 * blur_px)) + 1
    rows, columns = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1).astype(np.float64)

    def light(values: Array) -> Array:
        u, v, amplitude, background, radius = values
        # a disc blurred by a unit Gaussian: P(|Z + δ| < α), noncentral χ² with two degrees of freedom
        alpha2 = max(radius, 1e-3) ** 2 / blur_px**2
        distance2 = ((columns - u) ** 2 + (rows - v) ** 2) / blur_px**2
        return np.asarray(amplitude * chndtr(alpha2, 2.0, distance2) + background)

    full = float(chndtr(max(radius_px, 1e-3) ** 2 / blur_px**2, 2.0, 0.0))
    variances = []
    for phase in _PHASES:
        values = np.array([phase, 0.5 * phase, peak / full, 0.0, max(radius_px, 0.05)])
        # a point's width is its disc's in name only: below half the blur the radius is not told from the amplitude
        free = 5 if radius_px > 0.5 * blur_px else 4
        variance = background_sigma**2 + shot_gain * light(values)
        variances.append(np.trace(_inverse_information(light, values, free, variance)[:2, :2]) / 2.0)
    return float(np.sqrt(np.mean(variances)))


def corner_bound_px(contrast: float, blur_px: float, radius_px: float, sigma_black: float, sigma_white: float) -> float:
    """Least standard deviation of a coordinate of a checkerboard's corner, pixels.

    Two straight edges cross at right angles; ``contrast`` grey levels between black and white, with noise of
    ``sigma_black`` and ``sigma_white``; pixels within ``radius_px`` are used. Unknown: position, both edges'
    directions, blur, black and white.
    """
    reach = int(np.ceil(radius_px))
    rows, columns = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1).astype(np.float64)
    inside = rows**2 + columns**2 <= radius_px**2
    rows, columns = rows[inside], columns[inside]

    def light(values: Array) -> Array:
        u, v, first, second, blur, black, white = values
        du, dv = columns - u, rows - v
        across = erf((du * np.cos(first) + dv * np.sin(first)) / (np.sqrt(2.0) * blur))
        along = erf((dv * np.cos(second) - du * np.sin(second)) / (np.sqrt(2.0) * blur))
        return np.asarray(black + (white - black) * (1.0 + across * along) / 2.0)

    variances = []
    for phase in _PHASES:
        values = np.array([phase, 0.5 * phase, 0.1, 0.1, blur_px, 0.0, contrast])
        share = light(values) / contrast
        variance = sigma_black**2 + (sigma_white**2 - sigma_black**2) * share
        variances.append(np.trace(_inverse_information(light, values, 7, variance)[:2, :2]) / 2.0)
    return float(np.sqrt(np.mean(variances)))


def _inverse_information(light: Callable[[Array], Array], values: Array, free: int, variance: Array) -> Array:
    """Covariance bound of the first ``free`` of ``values``, for Gaussian noise of ``variance`` at each pixel."""
    steps = _STEP * np.maximum(np.abs(values), 1.0)
    slopes = np.array(
        [
            (light(values + step * unit) - light(values - step * unit)) / (2.0 * step)
            for step, unit in zip(steps[:free], np.eye(len(values)), strict=False)
        ]
    )
    return np.asarray(np.linalg.inv((slopes / variance) @ slopes.T))
