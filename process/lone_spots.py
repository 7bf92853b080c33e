"""Spots without a partner to the markers that one camera saw: each where the rest of the wing says it must be.

Without the other camera a spot has a place in the image only, so that much else could pass for it. A marker is looked
for only where the wing was followed from the last set, and as closely as it meets the markers that both cameras saw.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from process.bent_wing import BentWing
from process.camera_model import CameraModel, MarkerLayout, RigSide
from process.detect import Detections
from process.match import UNSEEN, Indices, Matches, MatchSettings

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LoneSpots:
    """Of M markers, those that one camera saw."""

    spot: Indices
    """(2, M) index into cam0's and cam1's detections, ``UNSEEN`` where none"""
    ambiguous: NDArray[np.bool_]
    """(M,) another explanation is nearly as good"""

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(M,)"""
        return np.asarray((self.spot != UNSEEN).any(axis=0))


def lone_spots(
    side_name: str,
    side: RigSide,
    layout: MarkerLayout,
    detections: tuple[Detections, Detections],
    matched: Matches,
    settings: MatchSettings,
) -> LoneSpots:
    """Identify spots that ``matched`` left over. A marker with a spot in both images that are no pair gets neither."""
    count = len(matched.spot0)
    spot, ambiguous = np.full((2, count), UNSEEN, dtype=np.intp), np.zeros(count, dtype=bool)
    wanted = np.flatnonzero(~matched.seen)
    if matched.followed_m is None or matched.points is None or not wanted.size:
        return LoneSpots(spot, ambiguous)
    measured_m = np.full((count, 3), np.nan)
    measured_m[matched.seen] = matched.points.xyz_m
    sure = np.asarray(matched.seen & ~matched.ambiguous & np.isfinite(measured_m).all(axis=1))
    known = BentWing(side_name, layout).predicted(matched.followed_m, measured_m, sure, settings.lone_sigma_m)
    if known is None:
        return LoneSpots(spot, ambiguous)
    T_cam0_body = np.linalg.inv(side.T_body_cam0)
    poses = (T_cam0_body, side.pair.T_cam1_cam0 @ T_cam0_body)
    for at, (camera, T, taken) in enumerate(
        zip((side.pair.cam0, side.pair.cam1), poses, (matched.spot0, matched.spot1), strict=True)
    ):
        free = np.setdiff1d(np.arange(len(detections[at])), taken)
        cost = _cost(camera, T, known[0][wanted], known[1][wanted], detections[at], settings)[:, free]
        best, margin = _best(cost, settings.none_cost)
        found = best != UNSEEN
        spot[at, wanted[found]] = free[best[found]]
        ambiguous[wanted[found]] = ~(margin[found] >= settings.least_margin)
    spot[:, (spot != UNSEEN).all(axis=0)] = UNSEEN
    return LoneSpots(spot, ambiguous & (spot != UNSEEN).any(axis=0))


def _cost(
    camera: CameraModel,
    T_camera_body: Array,
    places_m: Array,
    covariance_m2: Array,
    spots: Detections,
    settings: MatchSettings,
) -> Array:
    """(n, S) squared Mahalanobis distances, in the image, of S spots from n predicted places; infinite out of view."""
    image, slope = camera.project_with_jacobian(places_m @ T_camera_body[:3, :3].T + T_camera_body[:3, 3])
    slope = slope @ T_camera_body[:3, :3]
    spread = slope @ covariance_m2 @ slope.transpose(0, 2, 1) + settings.epipolar_allowance_px**2 * np.eye(2)
    visible = np.asarray(np.isfinite(image).all(axis=1) & np.isfinite(spread).all(axis=(1, 2)))
    spread[~visible] = np.eye(2)
    apart = spots.pixels[None, :, :] - np.where(visible[:, None], image, 0.0)[:, None, :]
    both = spread[:, None] + spots.covariance_px2[None, :]
    cost = np.einsum("nsi,nsij,nsj->ns", apart, np.linalg.inv(both), apart)
    cost[~visible] = np.inf
    return np.asarray(cost)


def _best(cost: Array, none_cost: float) -> tuple[Indices, Array]:
    """(n,) column of each row's best spot that is no other row's, and how much worse the best other explanation is."""
    best, margin = np.full(len(cost), UNSEEN, dtype=np.intp), np.full(len(cost), np.nan)
    for row in range(len(cost)):
        if not cost.shape[1] or cost[row].min() >= none_cost:
            continue
        column = int(np.argmin(cost[row]))
        if np.argmin(cost[:, column]) != row:
            continue
        own = cost[row, column]
        rivals = (np.delete(cost[row], column), np.delete(cost[:, column], row), [none_cost])
        best[row], margin[row] = column, np.concatenate(rivals).min() - own
    return best, margin
