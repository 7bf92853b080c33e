"""Time to the true shape of the wing: closed-form angles, integrated along the arc so that its length is kept.

The field of rotations from the unloaded to the deformed wing is, in body axes and smooth in s,
``D(s, t) = Ry(i) · Rx(bending) · Rz(in-plane) · Ry(twist) · Ry(−i)`` with the incidence i: the wing bends about its
chord line, as one does whose spar is fifty times stiffer in its plane. The section frame is ``D(s, t) · R_jig(s)`` with
``R_jig(s) = Rx(dihedral(s)) · R_root · rot_e1(i)``. Being smooth across the dihedral break, this is a field that a beam
under forces and moments can follow. The axis is the integral of the frames' e1. No beam solver is involved. Everything
is worked out for the right wing; the left one is the mirror image.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from hw_sim.world import World

Array = NDArray[np.float64]
Times = NDArray[np.int64]

_SLOPE = Polynomial([0.0, 3.0, -3.0, 1.0])  # of a clamped beam under an even load
_SLOPE2 = Polynomial([0.0, 1.0, -3.25, 10.0 / 3.0, -1.125])  # curvature (1−x)²(1−4.5 x): changes sign, free at the tip
_TWIST = Polynomial([0.0, 1.5, 0.0, -0.5])
SHAPES = ("bending1", "bending2", "twist", "inplane")
_POLYNOMIALS = (_SLOPE, _SLOPE2, _TWIST, _SLOPE)
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)  # exact to 1e-13 m for the angles in question


@dataclass(frozen=True)
class WingState:
    """Sections of one half wing, body frame."""

    points_m: Array  # (..., 3) of the reference axis
    frames: Array  # (..., 3, 3) R_body_section, columns e1 outboard, e2, e3 up


class WingMotion:
    """The motion of one half wing at chosen arc stations, for many times."""

    def __init__(self, world: World, side: str, stations_m: Array) -> None:
        """``stations_m`` (n,) are arc lengths from the root."""
        self.world = world
        self.side = side
        self.stations_m = np.asarray(stations_m, dtype=np.float64)
        self._incidence = math.radians(world.wing.incidence_deg)
        self._sign = 1.0 if side == "right" else -1.0
        wing = world.wing
        inner = np.minimum(self.stations_m, wing.break_m)
        outer = self.stations_m - inner
        nodes = (_NODES + 1.0) / 2.0
        at = np.concatenate([inner[:, None] * nodes, wing.break_m + outer[:, None] * nodes], axis=1)
        self._weights = np.concatenate([inner[:, None] * _WEIGHTS, outer[:, None] * _WEIGHTS], axis=1) / 2.0
        dihedral = math.radians(wing.dihedral_deg)
        self._node_shapes = self._shapes(at)
        self._node_dihedral = np.concatenate([np.zeros_like(nodes), np.full_like(nodes, dihedral)])
        self._section_shapes = self._shapes(self.stations_m)
        self._section_dihedral = np.where(
            self.stations_m > wing.break_m, dihedral, 0.0
        )  # at the break: the inboard one

    def points(self, times_ns: Times) -> Array:
        """The reference axis (..., n, 3) in metres, body frame; ``times_ns`` (..., n) or (..., 1), UTC."""
        return self._integrate(amplitudes(self.world, self._sign, times_ns))

    def state(self, times_ns: Times) -> WingState:
        """Axis points and section frames; ``times_ns`` (..., n) or (..., 1), UTC."""
        angles = amplitudes(self.world, self._sign, times_ns)
        return WingState(self._integrate(angles), self._frames(angles))

    def _integrate(self, angles: Array) -> Array:
        d = self._node_dihedral
        turns = _angles_at(angles[..., None, :], self._node_shapes)
        tangent = _deform(turns, self._incidence, (np.zeros_like(d), np.cos(d), np.sin(d)))
        points = np.stack([np.sum(part * self._weights, axis=-1) for part in tangent], axis=-1)
        points[..., 1] *= self._sign
        return points

    def _frames(self, angles: Array) -> Array:
        turns = _angles_at(angles, self._section_shapes)
        c, s = np.cos(self._section_dihedral), np.sin(self._section_dihedral)
        ci, si = math.cos(self._incidence), math.sin(self._incidence)
        along = _deform(turns, self._incidence, (np.zeros_like(c), c, s))
        forward = _deform(turns, self._incidence, (np.full_like(c, -ci), -s * si, c * si))
        up = _deform(turns, self._incidence, (np.full_like(c, si), -s * ci, c * ci))
        frames = np.stack([np.stack(np.broadcast_arrays(*column), axis=-1) for column in (along, forward, up)], axis=-1)
        if self._sign < 0:
            frames[..., 1, :] *= -1.0  # mirrored …
            frames[..., :, 1] *= -1.0  # … and e2 = e3 × e1 points aft there
        return frames

    def _shapes(self, stations_m: Array) -> Array:
        x = stations_m / self.world.wing.half_span_m
        shapes: Array = np.stack([polynomial(x) for polynomial in _POLYNOMIALS], axis=-1)
        return shapes


class LedMotion:
    """The lights of one half wing in motion, each at its own time."""

    def __init__(self, world: World, side: str) -> None:
        leds = world.leds
        pairs = len(leds.pairs_station_m)
        self._wing = WingMotion(world, side, np.repeat(leds.pairs_station_m, len(leds.chord_m)))
        forward = 1.0 if side == "right" else -1.0
        across = forward * np.tile(leds.chord_m, pairs)
        drawn = np.stack([np.zeros(len(across)), across, np.full(len(across), leds.height_m)], axis=1)
        rng = np.random.default_rng([world.seed, 0x91ACE, *side.encode()])
        self._offset_m = drawn + leds.placement_sigma_m * rng.standard_normal(drawn.shape)
        elevation = math.radians(leds.elevation_deg)
        self._beam = np.array([-math.cos(elevation), 0.0, math.sin(elevation)])

    def __len__(self) -> int:
        return len(self._offset_m)

    def centres(self, times_ns: Times) -> tuple[Array, Array]:
        """Light centres (..., n, 3) in the body frame, and section frames (..., n, 3, 3); ``times_ns`` (..., n)."""
        state = self._wing.state(times_ns)
        return state.points_m + (state.frames @ self._offset_m[:, :, None])[..., 0], state.frames

    def beams(self, frames: Array) -> Array:
        """The beams' axes (..., n, 3), unit vectors in the body frame, of section frames (..., n, 3, 3)."""
        axes: Array = frames @ self._beam
        return axes


def amplitudes(world: World, sign: float, times_ns: Times) -> Array:
    """Amplitudes (..., 4) of ``SHAPES`` in radians at UTC times (...); ``sign`` is +1 on the right, −1 on the left."""
    motion = world.motion
    seconds = (np.asarray(times_ns, dtype=np.int64) - world.epoch_ns) * 1e-9
    out = np.empty((*seconds.shape, 4))
    out[...] = (motion.bending_mean_rad, 0.0, motion.twist_mean_rad, motion.inplane_mean_rad)
    for sine in motion.sines:
        amplitude = sine.symmetric_rad + sign * sine.antisymmetric_rad
        if amplitude:
            wave = np.sin(2.0 * math.pi * sine.frequency_hz * seconds + sine.phase_rad)
            out[..., SHAPES.index(sine.shape)] += amplitude * wave
    gust = motion.gust
    since = np.mod(seconds, gust.period_s)
    onset = (since / gust.rise_s) ** 2
    pulse = onset / (1.0 + onset) * np.exp(-since / gust.decay_s) * np.sin(2.0 * math.pi * gust.frequency_hz * since)
    out[..., 0] += (gust.bending_symmetric_rad + sign * gust.bending_antisymmetric_rad) * pulse
    out[..., 1] += gust.bending2_rad * pulse
    out[..., 2] += gust.twist_rad * pulse
    return out


def incidence_rad(frames: Array, side: str) -> Array:
    """Incidence (...) of section frames (..., 3, 3), by the definition in docs/ARCHITECTURE.md; nose-up positive."""
    along = frames[..., :, 0]
    forward = frames[..., :, 1] * (1.0 if side == "right" else -1.0)
    ahead = np.array([-1.0, 0.0, 0.0])
    level = ahead - along * along[..., :1] * ahead[0]
    level /= np.linalg.norm(level, axis=-1, keepdims=True)
    up = np.cross(along, level) * (1.0 if side == "right" else -1.0)
    incidence: Array = np.arctan2(np.sum(forward * up, axis=-1), np.sum(forward * level, axis=-1))
    return incidence


def twist_rad(world: World, frames: Array, side: str) -> Array:
    """Twist (...) of section frames: incidence less that of the unloaded wing, which is the same all along."""
    return incidence_rad(frames, side) - math.radians(world.wing.incidence_deg)


_Vector = tuple[Array, Array, Array]


def _angles_at(amplitude: Array, shapes: Array) -> _Vector:
    """Bending, twist and in-plane angle where the shapes (..., 4) were evaluated."""
    bending = amplitude[..., 0] * shapes[..., 0] + amplitude[..., 1] * shapes[..., 1]
    return bending, amplitude[..., 2] * shapes[..., 2], amplitude[..., 3] * shapes[..., 3]


def _deform(turns: _Vector, incidence: float, vector: _Vector) -> _Vector:
    """``D`` times a vector given by its components."""
    bending, twist, inplane = turns
    x, y, z = vector
    cos, sin = np.cos(twist - incidence), np.sin(twist - incidence)
    x, z = x * cos + z * sin, z * cos - x * sin
    cos, sin = np.cos(inplane), np.sin(inplane)
    x, y = x * cos - y * sin, x * sin + y * cos
    cos, sin = np.cos(bending), np.sin(bending)
    y, z = y * cos - z * sin, y * sin + z * cos
    tilt, rise = math.cos(incidence), math.sin(incidence)
    return x * tilt + z * rise, y, z * tilt - x * rise
