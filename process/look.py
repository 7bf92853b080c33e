"""A frame to the figures that tell of aperture, exposure, focus and light: what ``aim`` and the monitor show.

Each spot is measured by its radial profile: brightness over its local background against the distance from its centre.
Radii are where that profile falls to a level: a share of the peak; of a saturated spot, of what is left of it.
"""

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from process.detect import Detections, DetectSettings, detect

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

HALF_WIDTH_PX = 24
_STEP_PX = 0.25  # of the radial profile
_STRIDE = 8  # of the sample of the background
_NEAR_PX = 6.0  # further beyond a spot's edge is background


@dataclass(frozen=True, eq=False)
class Look:
    """One frame. Shares are of 1, brightness is in grey levels of 255; NaN where no spot tells."""

    saturated_share: float
    """of all pixels"""
    background: float
    """median grey level"""
    background_high: float
    """95th percentile: sunlit parts of the scene"""
    detections: Detections
    markers: int
    saturated_markers: int
    amplitude: float
    """median over the spots, above their background, as fitted: beyond 255 where saturated"""
    brightest: float
    """of the spots' amplitudes the highest but one, of three and more; else the highest"""
    diameter_px: float
    """median, at half of the peak"""
    circularity: float
    """least but one, of three and more spots; else least"""
    edge_px: float
    """focus: median distance from 80 % to 20 % of the peak; least when sharp"""
    halo: float
    """median share of a spot's light that lies further out than its own blur explains"""
    rejected: dict[str, int]
    """lights that are none, by reason"""

    @property
    def reflections(self) -> int:
        """Spots that are the shine of another one."""
        return self.rejected.get("reflection", 0)


def look_at(image: Pixels, settings: DetectSettings | None = None) -> Look:
    """Measure ``image`` (H, W)."""
    settings = settings or DetectSettings()
    found = detect(image, settings)
    sample = image[::_STRIDE, ::_STRIDE]
    profiles = [_profile(image, u, v, found.pixels) for u, v in found.pixels]
    radii = np.array([[_radius(profile, level) for level in (0.8, 0.5, 0.2)] for profile in profiles]).reshape(-1, 3)
    saturated = sum("saturated" in flag for flag in found.flags)
    return Look(
        saturated_share=float(np.mean(image >= settings.saturation)),
        background=float(np.median(sample)),
        background_high=float(np.percentile(sample, 95)),
        detections=found,
        markers=len(found),
        saturated_markers=saturated,
        amplitude=_median(found.amplitude),
        brightest=-_low(-found.amplitude),
        diameter_px=_median(2.0 * radii[:, 1]),
        circularity=_low(found.circularity),
        edge_px=_median(radii[:, 2] - radii[:, 0]),
        halo=_median(np.array([_halo(p, r[1], r[2]) for p, r in zip(profiles, radii, strict=True)])),
        rejected=dict(Counter(r.reason.split(":")[0] for r in found.rejected)),
    )


@dataclass(frozen=True, eq=False)
class _Profile:
    radius_px: Array
    light: Array
    """mean at each radius, over the background"""


def _profile(image: Pixels, u: float, v: float, spots: Array) -> _Profile:
    """Of the spot at (u, v), up to half way to the next one."""
    apart = np.hypot(*(spots - (u, v)).T)
    others = apart[apart > 1e-9]
    reach = min(float(HALF_WIDTH_PX), others.min() / 2.0 if others.size else np.inf)
    column, row = round(u), round(v)
    rows = np.arange(max(0, row - HALF_WIDTH_PX), min(image.shape[0], row + HALF_WIDTH_PX + 1))
    columns = np.arange(max(0, column - HALF_WIDTH_PX), min(image.shape[1], column + HALF_WIDTH_PX + 1))
    patch = image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].astype(np.float64)
    distance = np.hypot(columns[None, :] - u, rows[:, None] - v)
    inside = distance <= reach
    far = distance > 0.8 * reach
    background = float(np.median(patch[far & inside])) if (far & inside).any() else float(patch.min())
    radius = np.arange(0.0, reach, _STEP_PX)
    # a pixel counts by its nearness: a mean over a ring of one pixel's width, without empty rings
    order = np.argsort(distance[inside])
    at, light = distance[inside][order], patch[inside][order] - background
    window = 0.6
    low, high = np.searchsorted(at, radius - window), np.searchsorted(at, radius + window)
    sums, centres = (np.concatenate([[0.0], np.cumsum(x)]) for x in (light, at))
    counts = np.maximum(high - low, 1)
    return _Profile((centres[high] - centres[low]) / counts, (sums[high] - sums[low]) / counts)


def _radius(profile: _Profile, level: float) -> float:
    """Where the profile first falls below ``level`` of its peak, pixels; NaN where it never does."""
    light = profile.light
    limit = level * light.max(initial=0.0)
    below = np.flatnonzero(light < limit)
    below = below[below > int(np.argmax(light))] if light.size else below
    if not below.size:
        return float("nan")
    k = int(below[0])
    share = (light[k - 1] - limit) / (light[k - 1] - light[k])
    return float(profile.radius_px[k - 1] + share * (profile.radius_px[k] - profile.radius_px[k - 1]))


def _halo(profile: _Profile, half_px: float, fifth_px: float) -> float:
    """Share of the light beyond where a blurred disc of this edge has ended."""
    end = fifth_px + 2.0 * max(fifth_px - half_px, 0.5)
    weight = profile.radius_px * np.maximum(profile.light, 0.0)
    total = weight.sum()
    if not np.isfinite(end) or total <= 0.0 or profile.radius_px[-1] <= end:
        return float("nan")
    return float(weight[profile.radius_px > end].sum() / total)


def _median(values: Array) -> float:
    good = values[np.isfinite(values)]
    return float(np.median(good)) if good.size else float("nan")


def _low(values: Array) -> float:
    """One bad spot among many is not the picture."""
    if not len(values):
        return float("nan")
    return float(np.sort(values)[1 if len(values) >= 3 else 0])
