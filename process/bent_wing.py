"""A half wing's marker layout to where its markers are when it bends: polynomials in arc length."""

import numpy as np
from numpy.typing import NDArray

from process.camera_model import MarkerLayout

Array = NDArray[np.float64]

_PULL = np.array([0.02, 0.03, 0.05, 0.08, 0.05, 0.05, 0.08])
"""of each column of ``BentWing.basis`` towards not bending"""
_PRIOR = np.diag(_PULL**2)
_FEWEST_FREE = 3.0
"""numbers measured on each axis beyond what bending takes up"""


class BentWing:
    """A half wing's markers in the section's coordinates, and the directions span, chord, normal."""

    def __init__(self, side_name: str, layout: MarkerLayout) -> None:
        self.outboard = 1.0 if side_name == "right" else -1.0
        pairs = np.array(layout.pairs_station_m, dtype=np.float64)
        self.station_m = np.repeat(pairs, 2)
        self.chord_m = np.tile(np.array(layout.chord_m, dtype=np.float64), len(pairs))
        self.height_m = layout.height_m
        self.span_m = float(pairs[-1])
        self.count = len(self.station_m)
        self.offset_m = np.stack([self.station_m, self.chord_m], axis=1)
        # columns of what the wing can be bent by: s … s⁴ along the axis, and c, c s, c s² for its sections
        s, c = self.station_m / self.span_m, self.chord_m / 0.1
        self.basis = np.stack([s, s**2, s**3, s**4, c, c * s, c * s**2], axis=1)

    def bent(self, tip_slope_rad: float) -> Array:
        """(M, 3) markers of a wing whose slope grows to ``tip_slope_rad`` as a cantilever's under an even load."""
        fine = np.linspace(0.0, self.span_m, 200)
        slope = tip_slope_rad * (1.0 - (1.0 - fine / self.span_m) ** 3)
        step = np.diff(fine, prepend=0.0)
        y = np.interp(self.station_m, fine, np.cumsum(np.cos(slope) * step))
        z = np.interp(self.station_m, fine, np.cumsum(np.sin(slope) * step))
        at = np.interp(self.station_m, fine, slope)
        y, z = y - self.height_m * np.sin(at), z + self.height_m * np.cos(at)
        return np.stack([-self.chord_m, self.outboard * y, z], axis=1)

    def directions(self, places_m: Array) -> Array:
        """(M, 3, 3) rows span, chord, normal of a wing whose markers are at ``places_m``."""
        middles = (places_m[0::2] + places_m[1::2]) / 2.0
        along = np.empty_like(middles)
        along[1:-1] = (middles[2:] - middles[:-2]) / 2.0
        along[0], along[-1] = middles[1] - middles[0], middles[-1] - middles[-2]
        x, y, z = (along / np.sqrt(np.sum(along * along, axis=1))[:, None]).T
        # the chord is what of (−1, 0, 0) is across the span, the normal span × chord
        across = np.sqrt(1.0 - x * x)
        rows = np.zeros((len(x), 2, 3, 3))
        for at, column in (((0, 0), x), ((0, 1), y), ((0, 2), z), ((1, 0), -across)):
            rows[:, :, *at] = column[:, None]
        y, z = y / across, z / across
        for at, column in (((1, 1), x * y), ((1, 2), x * z), ((2, 1), -z), ((2, 2), y)):
            rows[:, :, *at] = column[:, None]
        return rows.reshape(-1, 3, 3)

    def bend_to(self, places_m: Array, measured_m: Array, seen: NDArray[np.bool_]) -> Array:
        """``places_m`` moved smoothly to ``measured_m`` where ``seen``; a weak pull keeps it from running off."""
        own = self.basis * seen[:, None]
        apart = np.where(seen[:, None], measured_m - places_m, 0.0)
        bend = np.linalg.solve(own.T @ own + _PRIOR, own.T @ apart)
        return np.asarray(places_m + self.basis @ bend)

    def predicted(
        self, places_m: Array, measured_m: Array, seen: NDArray[np.bool_], least_sigma_m: float
    ) -> tuple[Array, Array] | None:
        """Where the markers are, and with what covariance (M, 3, 3), once ``places_m`` is bent to those measured.

        How well those are met says how well the others are known, which are away from them; None when they are too few
        to say.
        """
        given = self.basis[seen]
        covariance = np.linalg.inv(given.T @ given + _PRIOR)
        free = len(given) - float(np.sum((given @ covariance) * given))
        if free < _FEWEST_FREE:
            return None
        bent = self.bend_to(places_m, measured_m, seen)
        variance = np.sum((measured_m - bent)[seen] ** 2, axis=0) / free + least_sigma_m**2
        share = 1.0 + np.sum((self.basis @ covariance) * self.basis, axis=1)
        return bent, share[:, None, None] * np.diag(variance)
