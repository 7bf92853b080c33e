"""Time to what the aircraft's other sensors say: load factor, airspeed, attitude, controls, as the wing's motion asks.

The model is the simplest that ties them together: the wing's symmetric first bending, slow and gust alike, is in
proportion to the load factor and is in the mean what it is at 1 g; the ailerons go with the antisymmetric part; the
elevator leads the load factor. Load factor is positive upward, elevator and right aileron with the trailing edge up,
pitch nose up, roll right wing down.
"""

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from hw_sim.wing_motion import SHAPES, amplitudes
from hw_sim.world import World

AIRSPEED_MPS = 14.0
_AIRSPEED_SWING_MPS = 0.9
_SLOW_HZ = 0.09  # the manoeuvre, that of the world's slowest bending
_ELEVATOR_LEAD_NS = 150_000_000
_ELEVATOR_DEG_PER_G = 12.0
_AILERON_PER_BENDING = 1.5
_ROLL_PER_BENDING = 8.0
_BENDING = SHAPES.index("bending1")
_G_MPS2 = 9.80665


@dataclass(frozen=True)
class AircraftState:
    """What is true of the aircraft, at one instant or (arrays) at several."""

    load_factor: NDArray[np.float64]
    airspeed_mps: NDArray[np.float64]
    elevator_deg: NDArray[np.float64]
    aileron_deg: NDArray[np.float64]  # the right one; the left one is its negative
    roll_rad: NDArray[np.float64]
    pitch_rad: NDArray[np.float64]
    altitude_m: NDArray[np.float64]

    def columns(self) -> dict[str, NDArray[np.float64]]:
        """By name."""
        return {member.name: getattr(self, member.name) for member in fields(self)}


class Aircraft:
    """The aircraft of a world."""

    def __init__(self, world: World) -> None:
        self._world = world

    def at(self, time_ns: int | NDArray[np.int64]) -> AircraftState:
        """Its state at UTC times."""
        times_ns = np.asarray(time_ns, dtype=np.int64)
        with_lead = np.stack([times_ns, times_ns + _ELEVATOR_LEAD_NS])
        right, left = (amplitudes(self._world, sign, with_lead)[..., _BENDING] for sign in (1.0, -1.0))
        symmetric, ahead = (right + left) / 2.0
        antisymmetric = (right - left)[0] / 2.0
        mean = self._world.motion.bending_mean_rad
        swing = _AIRSPEED_SWING_MPS * np.sin(2.0 * math.pi * _SLOW_HZ * (times_ns - self._world.epoch_ns) * 1e-9)
        return AircraftState(
            load_factor=symmetric / mean,
            airspeed_mps=AIRSPEED_MPS + swing,
            elevator_deg=_ELEVATOR_DEG_PER_G * (ahead / mean - 1.0),
            aileron_deg=np.degrees(antisymmetric) * _AILERON_PER_BENDING,
            roll_rad=_ROLL_PER_BENDING * antisymmetric,
            pitch_rad=math.radians(3.0) + 0.2 * (symmetric - mean),
            altitude_m=120.0 - AIRSPEED_MPS / _G_MPS2 * swing,  # speed is bought with height
        )

    def analog_volts(self, time_ns: int) -> tuple[float, float, float]:
        """At the trigger board's inputs: elevator, right and left aileron, 0 … 5 V for ±25°."""
        state = self.at(time_ns)
        elevator, aileron = float(state.elevator_deg) / 10.0, float(state.aileron_deg) / 10.0
        return (2.5 + elevator, 2.5 + aileron, 2.5 - aileron)
