"""Patches of light spots to centroids under a Gaussian window that follows the spot: the fast way."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from process.spot_fit import AMPLITUDE, BACKGROUND, Patches, spot_size_px

Array = NDArray[np.float64]

STEPS = 3
"""from moments good to a tenth of a pixel; for a spot of the window's own size the first step is exact"""
CONVERGED_PX = 0.05
LEAST_SIGMA_PX = 0.9


@dataclass(frozen=True, eq=False)
class Centres:
    """N centroids."""

    centres_px: Array
    """(N, 2)"""
    covariance_px2: Array
    """(N, 2, 2), from the sensor's noise"""
    converged: NDArray[np.bool_]


def windowed_centres(patches: Patches, start: Array) -> Centres:
    """Windowed centroids of spots that start at ``start`` (N, 8), as for ``fit_spots``.

    The window is a Gaussian of the standard deviation of a disc of the spot's size, moved by twice the weighted mean
    offset until it rests (Bertin, SExtractor's XWIN_IMAGE).
    """
    sigma = np.maximum(spot_size_px(start) / np.sqrt(2.0), LEAST_SIGMA_PX)
    scale, background = patches.spread(np.stack([-0.5 / sigma**2, start[:, BACKGROUND]]))
    light = patches.usable * (patches.values - background)
    centres = start[:, :2].copy()
    moments = np.empty((3, len(light)))
    step = np.zeros_like(centres)
    for _ in range(STEPS):
        du, dv = np.stack([patches.u_px, patches.v_px]) - patches.spread(centres.T)
        window = np.exp(scale * (du * du + dv * dv))
        np.multiply(window, light, out=moments[0])
        np.multiply(moments[0], du, out=moments[1])
        np.multiply(moments[0], dv, out=moments[2])
        total, first_u, first_v = patches.sums(moments)
        with np.errstate(all="ignore"):  # a patch without light: NaN, which does not count as converged
            step = np.clip(2.0 * np.stack([first_u, first_v], axis=1) / total[:, None], -1.0, 1.0)
        centres += step
    spread = patches.usable * window * window * patches.variance(light)
    uu, vv, uv = patches.sums(np.stack([spread * du * du, spread * dv * dv, spread * du * dv]))
    covariance = np.empty((len(start), 2, 2))
    with np.errstate(all="ignore"):
        covariance[:, 0, 0], covariance[:, 1, 1] = 4.0 * uu / total**2, 4.0 * vv / total**2
        covariance[:, 0, 1] = covariance[:, 1, 0] = 4.0 * uv / total**2
    good = np.isfinite(centres).all(axis=1) & (total > 0.0) & (np.abs(step).max(axis=1) < CONVERGED_PX)
    return Centres(centres, covariance, good & (start[:, AMPLITUDE] > 0.0))
