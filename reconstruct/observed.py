"""Marker series → what each set's fit is to explain: markers' places (eq. 7), or both cameras' pixels (direct mode)."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import pyarrow as pa

from process.bulb import centre_pixels
from process.camera_model import MarkerLayout, RigSide
from reconstruct.fit import Unscaled, marker_problem
from reconstruct.instants import InstantSettings, at_common_instant, pixels_at_common_instant
from reconstruct.iteration import FEWEST_MARKERS
from reconstruct.pixels import pixel_problem, px_per_m
from reconstruct.shared import SharedError
from reconstruct.tables import Bools, Floats, Ints, MarkerSeries, centroid_series
from reconstruct.wing import HalfWing
from reconstruct.wing_file import FitSettings

_NORMAL = 1.4826  # sigma by the median of absolute values


@dataclass(frozen=True, eq=False)
class Observed:
    """F sets at their common instants; pixels are None where places are fitted."""

    xyz_m: Floats  # (F, M, 3) body frame, NaN where not both cameras saw a marker
    cov_m2: Floats  # (F, M, 3, 3)
    points: Ints  # (F, M) samples that each is made of; in pixels the fewer of both cameras'
    pixels: Floats | None = None  # (F, M, 2, 2)
    covariance_px2: Floats | None = None  # (F, M, 2, 2, 2)
    epipolar_px: Floats | None = None  # (F,) one sigma of what calibration adds across epipolar lines

    def __getitem__(self, rows: slice | Ints) -> "Observed":
        """Some of the sets."""
        known = {member.name: getattr(self, member.name) for member in fields(self)}
        return replace(self, **{name: values[rows] for name, values in known.items() if values is not None})

    @classmethod
    def join(cls, parts: Sequence["Observed"]) -> "Observed":
        """The sets of all ``parts``, at least one, which are all of one kind."""
        known = [member.name for member in fields(cls) if getattr(parts[0], member.name) is not None]
        return cls(**{name: np.concatenate([getattr(one, name) for one in parts]) for name in known})

    def problem(
        self, half: HalfWing, settings: FitSettings, rig: RigSide | None, shared: SharedError | None = None
    ) -> Unscaled:
        """What the fit of each set is to explain; ``rig`` is needed for pixels.

        Places are weighed with the errors that they share, where loads act everywhere.
        """
        if rig is None or self.pixels is None or self.covariance_px2 is None or self.epipolar_px is None:
            weighed = shared is not None and settings.loads == "everywhere"
            moved = shared.of_markers(half, self.xyz_m) if shared is not None and weighed else None
            return marker_problem(half, self.xyz_m, self.cov_m2, settings, moved)
        return pixel_problem(half, rig, self.pixels, self.covariance_px2, settings, self.epipolar_px)


def observe(series: MarkerSeries, half: HalfWing, rig: RigSide | None, instants: InstantSettings) -> Observed:
    """The sets of ``series`` (the wing's markers in its order) at their common instants; with ``rig`` as pixels."""
    moved = at_common_instant(series, instants)
    if rig is None or series.centroids is None:
        return Observed(moved.xyz_m, moved.cov_m2, moved.points)
    seen = pixels_at_common_instant(series, px_per_m(half, rig), instants)
    fewest = np.where(seen.points > 0, seen.points, np.iinfo(np.int64).max).min(axis=2)
    points = np.where((seen.points > 0).any(axis=2), fewest, 0)
    return Observed(moved.xyz_m, moved.cov_m2, points, seen.pixels, seen.covariance_px2, calibration_px(series))


def calibration_px(series: MarkerSeries) -> Floats:
    """(F,) one sigma of the markers' distances from the epipolar condition that centroids' noise does not explain."""
    assert series.centroids is not None
    found = np.zeros(series.trigger_index.size)
    for at, (distance, spread) in enumerate(
        zip(series.centroids.epipolar_px, series.centroids.covariance_px2, strict=True)
    ):
        both = np.isfinite(distance) & np.isfinite(spread).all(axis=(1, 2, 3))
        if both.any():
            noise_px2 = np.trace(spread[both], axis1=2, axis2=3).mean() / 2
            found[at] = np.sqrt(max(0.0, (_NORMAL * np.median(np.abs(distance[both]))) ** 2 - noise_px2))
    return found


def with_centroids(
    series: MarkerSeries, table: pa.Table, rig: RigSide, layout: MarkerLayout, name: str
) -> MarkerSeries:
    """``series``, a side of the marker table, with the pixels of its lights' centres.

    Raises UsageError when the table does not have what that needs.
    """
    centroids = centroid_series(table, series, name)
    count = max(2 * len(layout.pairs_station_m), int(series.marker.max()) + 1)
    lights = np.full((series.trigger_index.size, count, 3), np.nan)
    pixels = np.full((series.trigger_index.size, count, 2, 2), np.nan)
    lights[:, series.marker], pixels[:, series.marker] = series.xyz_m, centroids.pixels
    centred = centre_pixels(rig, layout, series.side, lights, pixels)[:, series.marker]
    return replace(series, centroids=replace(centroids, pixels=centred))


def measured_markers(series: MarkerSeries) -> Bools:
    """(F, M) whether a marker was measured, with a covariance: by one camera at least where pixels are fitted."""
    if series.centroids is not None:
        return np.asarray(series.centroids.seen.any(axis=2))
    return np.asarray(series.seen & np.isfinite(series.cov_m2).all(axis=(-1, -2)))


def enough_markers(series: MarkerSeries) -> Bools:
    """(F,) whether enough markers were measured to fit a set."""
    return np.asarray(measured_markers(series).sum(axis=1) >= FEWEST_MARKERS)
