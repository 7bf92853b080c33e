"""Lights on the fuselage → how each camera pair has moved against it, set by set, and the markers where they then are.

A set's lights give the pair's pose by least squares, against where the survey's pictures had them. That is taken apart
into six directions of which each has the noise of one in a single set, and in which the motion is a drift (a random
walk) and a vibration (new in every set), as strong as makes the flight likeliest: none at all for a mount that stands
still. The equations are in docs/explanation/root-motion.md.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa

from process.bulb import all_places
from process.bundle import cross_matrix
from process.camera_model import MarkerLayout, RigSide
from process.fuselage_lights import LightSpots, lights_seen
from process.pose_fit import CHI2_LIMIT, project
from reconstruct.fit import Fit, marker_places
from reconstruct.random_walk import averaged, likeliest
from reconstruct.rotation import exponential
from reconstruct.tables import Bools, Floats, Ints, MarkerSeries, SetMotion
from reconstruct.wing import HalfWing

FEWEST_LIGHTS = 3  # by both cameras
FIRST_SETS = 50  # that motion is counted from where the rig does not say what the survey saw
FLOOR_PX = 0.01  # of a spot's place: what the model of spots leaves
CULPRIT = 3.0  # times the χ² a degree of freedom of the others, of a light that is to be left out; two at a time: 3.5
STEPS = 3  # of solving for the pose: turns of some milliradians are not quite linear


@dataclass(frozen=True, eq=False)
class RootMotion:
    """Of one side's pair, over F sets."""

    trigger_index: Ints  # (F,) growing
    motion: SetMotion
    since: str  # what motion is counted from: survey, or the flight's first sets

    def of(self, triggers: Ints) -> SetMotion:
        """That of sets; one whose frames of both cameras could not be read has that of the nearest."""
        after = np.clip(np.searchsorted(self.trigger_index, triggers), 0, self.trigger_index.size - 1)
        before = np.maximum(after - 1, 0)
        nearer = np.abs(self.trigger_index[before] - triggers) < np.abs(self.trigger_index[after] - triggers)
        at = np.where(nearer, before, after)
        found = self.motion[at]
        return replace(found, lights=np.where(self.trigger_index[at] == triggers, found.lights, 0))

    def figures(self, tip_m: Floats) -> dict[str, Any]:
        """For the summary; ``tip_m`` (3,) is where its effect is stated."""
        motion = self.motion
        tip = tip_m - motion.centre_m
        lever = np.concatenate([-cross_matrix(tip), np.eye(3)], axis=1)
        spread = np.trace(lever @ motion.covariance @ lever.T, axis1=1, axis2=2)
        return {
            "since": self.since,
            "sets_with_lights_percent": 100.0 * float(np.mean(motion.lights >= FEWEST_LIGHTS)),
            "turn_mrad": 1e3 * float(np.linalg.norm(motion.change[:, :3], axis=1).max()),
            "shift_mm": 1e3 * float(np.linalg.norm(motion.change[:, 3:], axis=1).max()),
            "tip_rms_mm": 1e3 * float(np.sqrt(np.mean(np.sum((motion.change @ lever.T) ** 2, axis=1)))),
            "sigma_tip_mm": 1e3 * float(np.sqrt(np.median(spread))),
        }


def root_motion(lights: pa.Table, name: str, side: RigSide) -> RootMotion | None:
    """The motion of the pair called ``name``, surveyed as ``side``; None when its lights never showed it.

    ``lights`` are the flight's (``fuselage_lights.LIGHTS_SCHEMA``).
    """
    sets = lights_seen(lights, name, side)
    spots = sets.spots
    seen: Bools = np.asarray(np.isfinite(spots.pixels).all(axis=(-2, -1)))
    enough = np.asarray(seen.sum(axis=1) >= FEWEST_LIGHTS)
    if not enough.any():
        return None
    base, since = _base(side, spots, enough)
    posed = _poses(side, spots, base)
    modes = _Modes(posed)
    times = (sets.timestamp_ns - sets.timestamp_ns[0]) * 1e-9
    values, variances = modes.of(posed)
    base_variance = 1.0 if since == "survey" else 1.0 / min(FIRST_SETS, int(enough.sum()))
    strengths, weights = likeliest(times, values, variances, base_variance, moved_before=since == "survey")
    centre = side.T_body_cam0[:3, 3]
    change, covariance = modes.back(*averaged(times, values, variances, strengths, weights))
    return RootMotion(sets.trigger_index, SetMotion(change, covariance, posed.lights, centre), since)


def with_motion(
    series: MarkerSeries, root: RootMotion, side: RigSide | None = None, layout: MarkerLayout | None = None
) -> MarkerSeries:
    """``series`` with its markers where they are in the body frame, the pair being where the lights show it.

    Pixels, which need ``side`` and ``layout``, are moved to where the pair at rest would have seen the markers.
    """
    motion = root.of(series.trigger_index)
    R = exponential(motion.change[:, :3])[:, None]
    cov = R @ series.cov_m2 @ np.swapaxes(R, -1, -2)
    moved = replace(series, xyz_m=_as_moved(series.xyz_m, motion), cov_m2=cov, motion=motion)
    if series.centroids is None or side is None or layout is None:
        return moved
    count = max(2 * len(layout.pairs_station_m), int(series.marker.max()) + 1)
    lights = np.full((series.trigger_index.size, count, 3), np.nan)
    lights[:, series.marker] = series.xyz_m
    seen = all_places(layout, lights)[:, series.marker]
    shift = _pixels(side, _as_moved(seen, motion)) - _pixels(side, seen)
    return replace(moved, centroids=replace(series.centroids, pixels=series.centroids.pixels + shift))


def sigma_by_motion(half: HalfWing, fits: Fit, motion: SetMotion) -> Floats:
    """(F, N + 1, 4) one sigma of nodes (m) and twist (rad) by the error of a set's motion, which all markers share."""
    places = marker_places(half, fits) - motion.centre_m
    by_motion = np.concatenate([-cross_matrix(places), np.broadcast_to(np.eye(3), (*places.shape, 3))], axis=3)
    response = fits.moved_by(by_motion)
    variance = np.sum((response @ motion.covariance[:, None]) * response, axis=3)
    return np.asarray(np.sqrt(np.where(variance < 0.0, 0.0, variance)))  # rounding; NaN, of no fit, stays


@dataclass(frozen=True, eq=False)
class _Poses:
    """Of F sets, each by itself."""

    change: Floats  # (F, 6) turn (rad) and shift (m), body axes; NaN with too few lights
    covariance: Floats  # (F, 6, 6)
    lights: Ints  # (F,) in use, by both cameras


class _Modes:
    """The six directions: whitened by a usual set's noise, and turned to those that motion and noise are alike in."""

    def __init__(self, posed: _Poses) -> None:
        known = np.isfinite(posed.change).all(axis=1)
        root = np.linalg.cholesky(np.median(posed.covariance[known], axis=0))
        whitened = np.linalg.solve(root, posed.change[known].T)
        _, direction = np.linalg.eigh(whitened @ whitened.T)
        self._back = root @ direction
        self._forth = np.linalg.inv(self._back)

    def of(self, posed: _Poses) -> tuple[Floats, Floats]:
        """Values (F, 6) and variances (F, 6) along the modes; infinite where nothing was measured."""
        known = np.isfinite(posed.change).all(axis=1, keepdims=True)
        values = np.where(known, posed.change @ self._forth.T, 0.0)
        variances = np.einsum("ij,fjk,ik->fi", self._forth, posed.covariance, self._forth)
        return values, np.where(known, variances, np.inf)

    def back(self, values: Floats, variances: Floats) -> tuple[Floats, Floats]:
        """Turn and shift (F, 6), and their covariance (F, 6, 6)."""
        return values @ self._back.T, np.einsum("ij,fj,kj->fik", self._back, variances, self._back)


def _base(side: RigSide, spots: LightSpots, enough: Bools) -> tuple[Floats, str]:
    """(L, 2, 2) pixels that motion is counted from, NaN for lights that do not count, and what they are."""
    surveyed = np.array([light.survey_px or np.full((2, 2), np.nan) for light in side.references])
    if np.isfinite(surveyed).all(axis=(1, 2)).sum() >= FEWEST_LIGHTS:
        return surveyed, "survey"
    first = spots.pixels[enough][:FIRST_SETS]
    base = np.array([[_median(first[:, light, camera]) for camera in (0, 1)] for light in range(first.shape[1])])
    return base, "first sets"


def _median(pixels: Floats) -> Floats:
    known = pixels[np.isfinite(pixels).all(axis=1)]
    return np.median(known, axis=0) if len(known) else np.full(2, np.nan)


def _poses(side: RigSide, spots: LightSpots, base: Floats) -> _Poses:
    """Each set's pose by least squares; of lights that do not fit the others, the culprit is left out."""
    slope, moved_px = _by_pose(side)
    change_px = (spots.pixels - base).reshape(*spots.pixels.shape[:2], 4)
    good: Bools = np.asarray(np.isfinite(change_px).all(axis=2))
    spread = np.zeros((*good.shape, 4, 4))
    for camera in (0, 1):
        own = np.s_[2 * camera : 2 * camera + 2]
        spread[:, :, own, own] = np.where(good[..., None, None], spots.covariance_px2[:, :, camera], np.eye(2))
    spread += FLOOR_PX**2 * np.eye(4)
    change_px = np.where(good[..., None], change_px, 0.0)
    weight = np.linalg.inv(spread)
    while True:
        enough = np.asarray(good.sum(axis=1) >= FEWEST_LIGHTS)
        W = weight * (good & enough[:, None])[..., None, None]
        information = np.einsum("lpi,flpq,lqj->fij", slope, W, slope, optimize=True)
        covariance = np.linalg.inv(np.where(enough[:, None, None], information, np.eye(6)))
        change = np.zeros((len(good), 6))
        for _ in range(STEPS):
            left = change_px - moved_px(change)
            change = change + np.einsum("fij,lpj,flpq,flq->fi", covariance, slope, W, left, optimize=True)
        left = change_px - moved_px(change)
        chi2 = np.einsum("flp,flpq,flq->fl", left, W, left, optimize=True)
        culprit = _culprits(left, spread - slope @ covariance[:, None] @ slope.transpose(0, 2, 1), chi2, good)
        if not (culprit >= 0).any():
            break
        good[np.flatnonzero(culprit >= 0), culprit[culprit >= 0]] = False
    lights = np.where(enough, good.sum(axis=1), 0)
    scale = _scale(left[enough], W[enough], good[enough])
    return _Poses(np.where(enough[:, None], change, np.nan), scale * covariance, lights)


def _scale(left: Floats, weight: Floats, good: Bools) -> float:
    """By how much χ² a degree of freedom exceeds 1, if it does; what is the same in all sets, the base's, left out."""
    count = np.maximum(good.sum(axis=0), 1)[:, None]
    left = left - np.where(good[..., None], left, 0.0).sum(axis=0) / count
    chi2 = np.einsum("flp,flpq,flq->f", left, weight, left, optimize=True)
    return max(1.0, float(np.median(chi2 / (4.0 * good.sum(axis=1) - 6.0)))) if len(left) else 1.0


def _culprits(left: Floats, own_spread: Floats, chi2: Floats, good: Bools) -> Ints:
    """(F,) the light of each set that does not fit, and far less so than the others; −1 where there is none.

    Leaving a light out lessens χ² by its residual in the covariance that a residual has, measurement less fit. The
    survey's picture may have as much noise as the set's: χ² of both is allowed.
    """
    count, whole = good.sum(axis=1), chi2.sum(axis=1)
    doubtful = (chi2.max(axis=1) > 2.0 * CHI2_LIMIT) & (count > FEWEST_LIGHTS)
    found = np.full(len(good), -1)
    rows = np.flatnonzero(doubtful)
    if rows.size:
        less = np.einsum("flp,flpq,flq->fl", left[rows], np.linalg.inv(own_spread[rows]), left[rows])
        less[~good[rows]] = -np.inf
        worst = less.argmax(axis=1)
        of_others = (whole[rows] - less.max(axis=1)) / (4.0 * count[rows] - 10.0)
        found[rows] = np.where(less.max(axis=1) / 4.0 > CULPRIT * of_others, worst, -1)
    return found


def _by_pose(side: RigSide) -> tuple[Floats, Callable[[Floats], Floats]]:
    """Pixels u0, v0, u1, v1 by the pair's motion: (L, 4, 6) at rest; and what (F, 6) changes them by, (F, L, 4)."""
    places = np.array([light.xyz_m for light in side.references])
    T = side.T_body_cam0
    T10 = side.pair.T_cam1_cam0
    in_cam0 = (places - T[:3, 3]) @ T[:3, :3]
    by_cam0 = side.pair.cam0.project_with_jacobian(in_cam0)[1]
    by_cam1 = side.pair.cam1.project_with_jacobian(in_cam0 @ T10[:3, :3].T + T10[:3, 3])[1] @ T10[:3, :3]
    by_point = np.stack([by_cam0, by_cam1], axis=1) @ T[:3, :3].T
    slope = np.concatenate([by_point @ cross_matrix(places - T[:3, 3])[:, None], -by_point], axis=3).reshape(-1, 4, 6)
    at_rest = _pixels(side, places)

    def change(motion: Floats) -> Floats:
        turn, shift = motion[:, None, :3], motion[:, None, 3:]
        seen = (exponential(-turn) @ (places - T[:3, 3] - shift)[..., None])[..., 0] + T[:3, 3]
        return (_pixels(side, seen) - at_rest).reshape(*seen.shape[:2], 4)

    return slope, change


def _as_moved(points_m: Floats, motion: SetMotion) -> Floats:
    """Where points (F, M, 3) are that were measured by a pair which took itself to be at rest."""
    turned = (points_m - motion.centre_m) @ exponential(motion.change[:, :3]).transpose(0, 2, 1)
    return np.asarray(turned + (motion.centre_m + motion.change[:, 3:])[:, None])


def _pixels(side: RigSide, points_m: Floats) -> Floats:
    """(…, 2, 2) of points (…, 3) in both cameras of the pair at rest."""
    pixels = np.stack(project(side.pair, side.T_body_cam0, points_m.reshape(-1, 3)), axis=1)
    return pixels.reshape(*points_m.shape[:-1], 2, 2)
