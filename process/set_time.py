"""A frame set to its times: the set's common instant, each marker's own by its row, and how well they are known.

A rolling shutter exposes row r ``r · row_time`` after row 0; of a global one the row time is 0, in the recording and in
the rig. What the recording does not know of the row time is taken from the rig.
"""

import math

import numpy as np
from numpy.typing import NDArray

from capture.record import PtpState
from process.camera_model import RigSide
from process.recording import FrameSet


def set_instant_ns(frames: FrameSet, side: RigSide) -> int:
    """Mid-exposure of the middle row, UTC, mean of the cameras that have a frame."""
    moments = [
        moment + round((camera.height - 1) / 2 * row_time)
        for moment, camera, row_time in zip(
            frames.mid_exposures_ns, (side.pair.cam0, side.pair.cam1), row_times_ns(frames, side), strict=True
        )
        if moment is not None
    ]
    return sum(moments) // len(moments)


def marker_instants_ns(
    frames: FrameSet, side: RigSide, v0_px: NDArray[np.float64], v1_px: NDArray[np.float64]
) -> NDArray[np.int64]:
    """(n,) mid-exposure of each marker's own row, UTC, mean of both cameras; rows (n,) in cam0 and cam1.

    Whole nanoseconds: UTC does not fit a float64.
    """
    moment0, moment1 = frames.mid_exposures_ns
    assert moment0 is not None
    assert moment1 is not None
    row_time0, row_time1 = row_times_ns(frames, side)
    rows_ns = (v0_px * row_time0 + v1_px * row_time1) / 2.0
    apart_ns = moment1 - moment0
    return np.rint(rows_ns + apart_ns / 2.0).astype(np.int64) + moment0


def camera_instants_ns(frames: FrameSet, side: RigSide, pixels: NDArray[np.float64]) -> NDArray[np.int64]:
    """(2, n) mid-exposure, UTC, of the rows of ``pixels`` (2, n, 2) in cam0 and cam1; the set's instant where NaN."""
    instants = np.full(pixels.shape[:2], set_instant_ns(frames, side), dtype=np.int64)
    for own, moment, row_time, rows in zip(
        instants, frames.mid_exposures_ns, row_times_ns(frames, side), pixels[:, :, 1], strict=True
    ):
        there = np.isfinite(rows)
        if moment is not None:
            own[there] = moment + np.rint(rows[there] * row_time).astype(np.int64)
    return instants


def row_times_ns(frames: FrameSet, side: RigSide) -> tuple[float, float]:
    """Of each camera: as recorded, or the rig's where the recording does not say (0: few cameras know their own)."""
    frame0, frame1 = (0.0 if frame is None else float(frame.row_time_ns) for frame in frames.frames)
    return frame0 or side.row_time_ns, frame1 or side.row_time_ns


def time_sigma_ns(frames: FrameSet) -> float:
    """One sigma of the set's instant: the mean of its cameras', whose errors may be one and the same; NaN: unknown."""
    sigmas = [float(frame.time_sigma_ns) for frame in frames.frames if frame is not None]
    return sum(sigmas) / len(sigmas) if sigmas and min(sigmas) >= 0 else math.nan


def ptp_state(frames: FrameSet) -> str:
    """State of the computer's PTP port when the set was taken; UNKNOWN where the recording does not say, or not one."""
    states = {frame.ptp_state for frame in frames.frames if frame is not None}
    try:
        return PtpState(states.pop()).name if len(states) == 1 else PtpState.UNKNOWN.name
    except ValueError:  # a number that the standard does not have
        return PtpState.UNKNOWN.name
