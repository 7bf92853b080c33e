"""Rolling shutter: markers at their rows' instants → markers at the one instant of their set."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from reconstruct.tables import Bools, Floats, Ints, MarkerSeries


@dataclass(frozen=True)
class InstantSettings:
    """What is assumed of the motion between two sets, for the error of the interpolation."""

    reach_s: float = 0.13  # sets further away than this say nothing about a marker's path now: three periods at 25 Hz
    motion_m: float = 0.15  # amplitude and frequency of the motion that the interpolation must follow
    motion_hz: float = 1.5


@dataclass(frozen=True)
class InstantMarkers:
    """Markers of F sets brought to their sets' common instants."""

    xyz_m: Floats  # (F, M, 3) body frame, NaN where not measured
    cov_m2: Floats  # (F, M, 3, 3)
    points: Ints  # (F, M) samples that went into the position: 0 not measured, 1 taken as it is, 5 at best


@dataclass(frozen=True)
class InstantCentroids:
    """Centroids of F sets brought to their sets' common instants."""

    pixels: Floats  # (F, M, 2, 2) of marker, camera, (u, v); NaN where not seen
    covariance_px2: Floats  # (F, M, 2, 2, 2)
    points: Ints  # (F, M, 2) samples, as for markers


def at_common_instant(series: MarkerSeries, settings: InstantSettings | None = None) -> InstantMarkers:
    """Interpolate every marker's own track from its row's instant to ``series.frame_timestamp_ns``.

    A marker is interpolated through its own samples up to two sets before and after (Lagrange's polynomial through
    n ≤ 5 points), never filled in where it was not seen. With weights w the covariance is Σ w² C (image noise is
    independent from set to set) plus the square of the polynomial's remainder |Π(T − tⱼ)| / n! · a ωⁿ for a motion of
    amplitude a and frequency ω (Abramowitz & Stegun 25.2.3): below 0.1 mm for five points at 25 Hz and 1.5 Hz, about
    1 cm for a lone sample 8 ms off. A marker without a finite covariance is not used.
    """
    settings = settings or InstantSettings()
    usable = series.seen & np.isfinite(series.cov_m2).all(axis=(-1, -2))
    xyz = np.full_like(series.xyz_m, np.nan)
    cov = np.full_like(series.cov_m2, np.nan)
    points = np.zeros(usable.shape, dtype=np.int64)
    for marker in range(usable.shape[1]):
        rows = np.flatnonzero(usable[:, marker])
        own = slice(None), marker
        times = series.timestamp_ns[rows, marker], series.frame_timestamp_ns[rows]
        known = series.xyz_m[own][rows], series.cov_m2[own][rows]
        xyz[rows, marker], cov[rows, marker], points[rows, marker] = _moved(*times, *known, settings.motion_m, settings)
    return InstantMarkers(xyz, cov, points)


def pixels_at_common_instant(
    series: MarkerSeries, px_per_m: Floats, settings: InstantSettings | None = None
) -> InstantCentroids:
    """``at_common_instant`` of the markers' paths in the images, each camera's by its own rows' instants.

    ``px_per_m`` (M, 2) is by how much a marker's motion shows in each camera at most, for the remainder.
    """
    settings = settings or InstantSettings()
    centroids = series.centroids
    assert centroids is not None
    usable = centroids.seen
    pixels = np.full_like(centroids.pixels, np.nan)
    covariance = np.full_like(centroids.covariance_px2, np.nan)
    points = np.zeros(usable.shape, dtype=np.int64)
    for marker, camera in np.ndindex(*usable.shape[1:]):
        rows = np.flatnonzero(usable[:, marker, camera])
        at = rows, marker, camera
        moved = _moved(
            centroids.timestamp_ns[at],
            series.frame_timestamp_ns[rows],
            centroids.pixels[at],
            centroids.covariance_px2[at],
            settings.motion_m * float(px_per_m[marker, camera]),
            settings,
        )
        pixels[at], covariance[at], points[at] = moved
    return InstantCentroids(pixels, covariance, points)


def _moved(
    time_ns: Ints, target_ns: Ints, values: Floats, covariance: Floats, motion: float, settings: InstantSettings
) -> tuple[Floats, Floats, Ints]:
    """A path's samples (n, d) at their own times brought to ``target_ns``, covariances (n, d, d), samples used (n,)."""
    if not len(time_ns):
        return values, covariance, np.empty(0, np.int64)
    near, valid = _neighbours(time_ns, target_ns, settings.reach_s)
    since = np.asarray((time_ns[near] - target_ns[:, None]) * 1e-9, dtype=np.float64)
    weights = _lagrange(since, valid)
    count = valid.sum(axis=1)
    omega = 2 * math.pi * settings.motion_hz
    factorial = np.array([math.factorial(int(n)) for n in range(6)], dtype=np.float64)[count]
    remainder = np.prod(np.where(valid, np.abs(since), 1.0), axis=1) / factorial * motion * omega**count
    moved = np.einsum("fn,fni->fi", weights, values[near])
    spread = np.einsum("fn,fnij->fij", weights**2, covariance[near])
    return moved, spread + remainder[:, None, None] ** 2 * np.eye(values.shape[1]), count


def _neighbours(time_ns: Ints, target_ns: Ints, reach_s: float) -> tuple[npt.NDArray[np.intp], Bools]:
    """(n, 5) numbers of the samples around each sample, and which of them count.

    A sample counts when it exists, lies within reach, and no clock step stands between it and the middle one.
    """
    near = np.arange(time_ns.size)[:, None] + np.arange(-2, 3)
    exists = (near >= 0) & (near < time_ns.size)
    near = np.clip(near, 0, time_ns.size - 1)
    valid = exists & (np.abs(time_ns[near] - target_ns[:, None]) <= reach_s * 1e9)
    later = np.diff(time_ns[near], axis=1) > 0
    valid[:, 2] = True
    for inner, outer, step in ((2, 1, 1), (1, 0, 0), (2, 3, 2), (3, 4, 3)):
        valid[:, outer] &= valid[:, inner] & later[:, step]
    return near, valid


def _lagrange(since_s: Floats, valid: Bools) -> Floats:
    """(n, 5) weights of the polynomial through the valid points, evaluated at time 0."""
    difference = since_s[:, :, None] - since_s[:, None, :]
    pairs = valid[:, :, None] & valid[:, None, :] & ~np.eye(since_s.shape[1], dtype=bool)
    factors = np.where(pairs, -since_s[:, None, :] / np.where(pairs, difference, 1.0), 1.0)
    return np.asarray(np.where(valid, factors.prod(axis=2), 0.0))
