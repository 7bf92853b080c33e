"""Rotation vectors into finite rotations and their tangent maps, exact at any angle.

Everything follows from the Stumpff functions c_k(t) = Σ (−t)^i / (k + 2i)!, t = |w|², which obey
c_k + t·c_{k+2} = 1/k! and dc_k/dt = (k·c_{k+2} − c_{k+1})/2: no division, so no small-angle branch in any derivative.
All functions take real or complex arrays (complex-step differentiation is used in the tests).
"""

from math import factorial

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]
Words = NDArray[np.object_]

_SERIES_LIMIT = 9.0  # |w|² up to which 15 terms of c6 and c7 are exact to rounding
_SERIES_6 = tuple((-1.0) ** i / factorial(6 + 2 * i) for i in range(15))[::-1]
_SERIES_7 = tuple((-1.0) ** i / factorial(7 + 2 * i) for i in range(15))[::-1]


def stumpff(t: Array) -> tuple[Array, ...]:
    """c_0 … c_7 at ``t`` (any shape, rad²): c_0 = cos √t, c_1 = sin √t / √t, and so on.

    Source: K. Stumpff, Himmelsmechanik I (1959), §41; recurrences in the module's head.
    """
    small = np.abs(t) <= _SERIES_LIMIT
    if np.all(small):
        return _by_series(t)
    series = _by_series(np.where(small, t, 0.0))
    closed = _by_trigonometry(np.where(small, 1.0, t))
    return tuple(np.where(small, one, other) for one, other in zip(series, closed, strict=True))


def _by_series(t: Array) -> tuple[Array, ...]:
    c6 = np.full_like(t, _SERIES_6[0])
    c7 = np.full_like(t, _SERIES_7[0])
    for a, b in zip(_SERIES_6[1:], _SERIES_7[1:], strict=True):
        c6 = c6 * t + a
        c7 = c7 * t + b
    c5 = 1 / 120 - t * c7
    c4 = 1 / 24 - t * c6
    c3 = 1 / 6 - t * c5
    c2 = 1 / 2 - t * c4
    return 1 - t * c2, 1 - t * c3, c2, c3, c4, c5, c6, c7


def _by_trigonometry(t: Array) -> tuple[Array, ...]:
    angle = np.sqrt(t)
    c = [np.cos(angle), np.sin(angle) / angle]
    for k in range(6):
        c.append((1 / factorial(k) - c[k]) / t)
    return tuple(c)


def cross(a: Array, b: Array) -> Array:
    """a × b over the last axis, broadcasting (several times faster than np.cross on small arrays)."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return np.stack((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx), axis=-1)


def hat(w: Array) -> Array:
    """The matrix of w ×: (..., 3) to (..., 3, 3)."""
    out = np.zeros((*w.shape, 3), dtype=w.dtype)
    out[..., 0, 1], out[..., 0, 2] = -w[..., 2], w[..., 1]
    out[..., 1, 0], out[..., 1, 2] = w[..., 2], -w[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -w[..., 1], w[..., 0]
    return out


def exponential(w: Array) -> Array:
    """The rotation matrix of the rotation vector ``w`` (..., 3) rad: (..., 3, 3)."""
    c0, c1, c2, *_ = stumpff(np.sum(w * w, axis=-1))
    outer = w[..., :, None] * w[..., None, :]
    return c0[..., None, None] * np.eye(3) + c1[..., None, None] * hat(w) + c2[..., None, None] * outer


def about_axis(axis: int, angle_rad: float) -> Array:
    """Rotation by ``angle_rad`` about coordinate axis 0, 1 or 2: (3, 3)."""
    return exponential(angle_rad * np.eye(3)[axis])
