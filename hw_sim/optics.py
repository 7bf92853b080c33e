"""Points of the world to pixels and pixels to rays, for a camera whose lens and pose are known exactly.

Brown–Conrady as in OpenCV's documentation: ideal normalised coordinates to distorted ones (the paper's eq. 2 read
that way). Written out here on purpose and not shared with ``process``, so that a mistake there cannot cancel.
Pixel (0, 0) is the centre of the top-left pixel.
"""

import numpy as np
from numpy.typing import NDArray

from hw_sim.world import CameraTruth

Array = NDArray[np.float64]


def project(camera: CameraTruth, points_body_m: Array) -> Array:
    """Pixels (..., 2) of points (..., 3) in the body frame; NaN where a point is not in front of the camera."""
    pose = np.array(camera.T_body_cam)
    local = (points_body_m - pose[:3, 3]) @ pose[:3, :3]
    depth = np.where(local[..., 2] > 0.0, local[..., 2], np.nan)
    x, y = _distort(camera, local[..., 0] / depth, local[..., 1] / depth)
    return np.stack([camera.fx * x + camera.cx, camera.fy * y + camera.cy], axis=-1)


def rays(camera: CameraTruth, pixels: Array) -> Array:
    """Directions (..., 3) in the body frame, not normalised (depth 1), of pixels (..., 2), by Newton's method."""
    goal_x = (pixels[..., 0] - camera.cx) / camera.fx
    goal_y = (pixels[..., 1] - camera.cy) / camera.fy
    x, y = goal_x.copy(), goal_y.copy()
    step = 1e-6
    for _ in range(12):
        at_x, at_y = _distort(camera, x, y)
        xx, yx = _distort(camera, x + step, y)
        xy, yy = _distort(camera, x, y + step)
        a, b, c, d = (xx - at_x) / step, (xy - at_x) / step, (yx - at_y) / step, (yy - at_y) / step
        off_x, off_y = goal_x - at_x, goal_y - at_y
        determinant = a * d - b * c
        x = x + (d * off_x - b * off_y) / determinant
        y = y + (a * off_y - c * off_x) / determinant
    local = np.stack([x, y, np.ones_like(x)], axis=-1)
    turned: Array = local @ np.array(camera.T_body_cam)[:3, :3].T
    return turned


def position_m(camera: CameraTruth) -> Array:
    """The camera's centre (3,) in the body frame."""
    return np.array(camera.T_body_cam)[:3, 3]


def _distort(camera: CameraTruth, x: Array, y: Array) -> tuple[Array, Array]:
    r2 = x * x + y * y
    radial = 1.0 + r2 * (camera.k1 + r2 * (camera.k2 + r2 * camera.k3))
    return (
        x * radial + 2.0 * camera.p1 * x * y + camera.p2 * (r2 + 2.0 * x * x),
        y * radial + camera.p1 * (r2 + 2.0 * y * y) + 2.0 * camera.p2 * x * y,
    )
