"""Time to how a camera pair has moved against the fuselage, and to where it then sees what stands or moves there.

Each pair drifts slowly, as a bracket that bends, and vibrates: x → exp(ω) (x − c) + c + δ in body axes, with c the
centre of cam0 at rest. Directions and phases follow from the world's seed and the side. Pictures of the calibration
day are taken at rest.
"""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from hw_sim.world import World

Array = NDArray[np.float64]
Times = NDArray[np.int64]


class PairMotion:
    """The motion of one side's camera pair."""

    def __init__(self, world: World, side: str) -> None:
        moves = world.mount_motion
        rng = np.random.default_rng([world.seed, 0x30, *side.encode()])
        self._epoch_ns = world.epoch_ns
        self._centre_m = np.array(world.camera(side, "cam0").T_body_cam)[:3, 3]
        self._waves: list[tuple[float, float, Array]] = []  # rad/s, phase, amplitudes of (turn, shift)
        for frequency_hz, turn_mrad, shift_mm in (
            (moves.drift_hz, moves.drift_mrad, moves.drift_mm),
            (moves.vibration_hz, moves.vibration_mrad, moves.vibration_mm),
        ):
            turn, shift = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
            phase = rng.uniform(0.0, 2.0 * math.pi)
            if turn_mrad or shift_mm:
                size = np.concatenate([turn_mrad * turn, shift_mm * shift]) * 1e-3
                self._waves.append((2.0 * math.pi * frequency_hz, phase, size))

    @classmethod
    @lru_cache(maxsize=16)
    def of(cls, world: World, side: str) -> "PairMotion":
        """Of a world: made once."""
        return cls(world, side)

    @property
    def at_rest(self) -> bool:
        """Whether the pair never moves."""
        return not self._waves

    def at(self, times_ns: Times) -> Array:
        """Turn ω (rad) and shift δ (m), (..., 6), body axes, at UTC times (...)."""
        seconds = (np.asarray(times_ns, dtype=np.int64) - self._epoch_ns) * 1e-9
        moved: Array = np.zeros((*seconds.shape, 6))
        for rate, phase, size in self._waves:
            moved += np.sin(rate * seconds + phase)[..., None] * size
        return moved

    def as_at_rest(self, times_ns: Times, points_m: Array) -> Array:
        """Where points (..., 3) seem to be at times (...), body frame, to who takes the pair to be at rest."""
        if self.at_rest:
            return points_m
        moved = self.at(times_ns)
        from_pair = points_m - self._centre_m - moved[..., 3:]
        return np.asarray(turned(from_pair, -moved[..., :3]) + self._centre_m)

    def axes_as_at_rest(self, times_ns: Times, frames: Array) -> Array:
        """The same of section frames (..., 3, 3), whose columns are axes."""
        if self.at_rest:
            return frames
        turn = -self.at(times_ns)[..., None, :3]
        return np.swapaxes(turned(np.swapaxes(frames, -1, -2), turn), -1, -2)


def turned(vectors: Array, turn_rad: Array) -> Array:
    """Vectors (..., 3) turned by rotation vectors (..., 3), by Rodrigues' formula."""
    angle = np.linalg.norm(turn_rad, axis=-1, keepdims=True)
    sine = np.sinc(angle / math.pi)  # sin(a) / a
    versine = 0.5 * np.sinc(angle / (2.0 * math.pi)) ** 2  # (1 − cos(a)) / a²
    across = np.cross(turn_rad, vectors)
    return np.asarray(vectors + sine * across + versine * np.cross(turn_rad, across))
