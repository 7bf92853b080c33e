"""Spots of a frame set to the lights on the fuselage among them: where they are, and the others without them."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from process.camera_model import RigSide
from process.detect import Detections
from process.pose_fit import project

Array = NDArray[np.float64]

REACH_PX = 15.0
"""a spot this close to where a light should be is the light: survey, calibration and what the mount may have moved"""


def lights_px(side: RigSide, spots: tuple[Detections, Detections]) -> Array:
    """(L, 2, 2) centres, by light and camera, of the rig's references; NaN where there is no spot in reach."""
    found = np.full((len(side.references), 2, 2), np.nan)
    for camera, (numbers, own) in enumerate(zip(_numbers(side, spots), spots, strict=True)):
        found[numbers >= 0, camera] = own.pixels[numbers[numbers >= 0]]
    return found


def without_lights(side: RigSide, spots: tuple[Detections, Detections]) -> tuple[Detections, Detections]:
    """The spots without those of the rig's references, which are no markers."""
    if not side.references:
        return spots
    first, second = (_without(own, numbers) for own, numbers in zip(spots, _numbers(side, spots), strict=True))
    return first, second


def _numbers(side: RigSide, spots: tuple[Detections, Detections]) -> list[NDArray[np.intp]]:
    """For each camera the number of each light's spot, −1 where there is none; of two lights in reach the nearer."""
    places = np.array([light.xyz_m for light in side.references]).reshape(-1, 3)
    numbers = []
    for expected, own in zip(project(side.pair, side.T_body_cam0, places), spots, strict=True):
        chosen = np.full(len(places), -1, dtype=np.intp)
        if len(own):
            apart = np.nan_to_num(np.linalg.norm(expected[:, None] - own.pixels, axis=2), nan=np.inf)
            nearest = apart.argmin(axis=1)
            near = (apart.min(axis=1) < REACH_PX) & (apart[:, nearest].argmin(axis=0) == np.arange(len(places)))
            chosen[near] = nearest[near]
        numbers.append(chosen)
    return numbers


def _without(spots: Detections, numbers: NDArray[np.intp]) -> Detections:
    keep = np.setdiff1d(np.arange(len(spots)), numbers)
    columns = ("u_px", "v_px", "covariance_px2", "amplitude", "area_px", "circularity")
    arrays = {name: getattr(spots, name)[keep] for name in columns}
    return replace(spots, flags=tuple(spots.flags[k] for k in keep), **arrays)
