"""A picture of a ChArUco board to the places of those of its inner corners that are in view, by their own numbers.

Its markers say which corner is which, so that a part of the board is enough: corners may be near the rim of the image,
where a whole checkerboard does not fit.
"""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from process.board import Board, View
from process.corner_fit import refine_edges

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

LEAST_CORNERS = 8
LEAST_PART = 0.2  # of the board's corners
LEAST_RADIUS_PX = 3.0
MOST_RADIUS_PX = 10.0
CLEAR_PART = 0.9  # of the way from a corner to the nearest marker
_VERSION = tuple(int(part) for part in cv2.__version__.split(".")[:2])
LIBRARY_SHIFT_PX = 0.5 if _VERSION < (4, 14) else 0.0  # to the right and down, of the corners of OpenCV's detector


def find_charuco(path: Path, image: Image, board: Board) -> View:
    """Corners of ``board`` (N, 2) by each way that succeeded, NaN where not in view.

    ``subpix`` is OpenCV's own, ``edges`` the maximum-likelihood fit in a window that ends before the markers.
    """
    found = _by_opencv(image, board)
    seen = np.asarray(np.isfinite(found).all(axis=1))
    if seen.sum() < max(LEAST_CORNERS, LEAST_PART * board.corners) or _in_a_line(board.points_m[seen]):
        return View(
            path, {}, f"{int(seen.sum())} corners of the {board.columns}x{board.rows} ChArUco board found, too few"
        )
    corners = {"subpix": found}
    refined = _by_edges(image, found, seen, board)
    if refined is not None:
        corners["edges"] = refined
    return View(path, corners, "")


def _by_opencv(image: Image, board: Board) -> Array:
    """(N, 2), NaN where not found; the arrangement of markers that OpenCV had before 4.6 is tried, too."""
    assert board.charuco is not None
    best = np.full((board.corners, 2), np.nan)
    for legacy in (False, True):
        squares = cv2.aruco.CharucoBoard(
            (board.columns + 1, board.rows + 1), board.square_m, board.marker_m, dictionary(board.charuco)
        )
        squares.setLegacyPattern(legacy)
        corners, numbers, _, _ = cv2.aruco.CharucoDetector(squares).detectBoard(image)
        if numbers is None:
            continue
        places = np.full((board.corners, 2), np.nan)
        places[np.asarray(numbers).ravel()] = np.asarray(corners, np.float64).reshape(-1, 2) - LIBRARY_SHIFT_PX
        if np.isfinite(places).sum() > np.isfinite(best).sum():
            best = places
    return best


def dictionary(name: str) -> "cv2.aruco.Dictionary":
    """OpenCV's dictionary such as ``4X4_50``; KeyError if there is none."""
    number = vars(cv2.aruco).get(f"DICT_{name.upper().removeprefix('DICT_')}")
    if number is None:
        raise KeyError(name)
    return cv2.aruco.getPredefinedDictionary(number)


def _by_edges(image: Image, corners: Array, seen: NDArray[np.bool_], board: Board) -> Array | None:
    """Maximum-likelihood corners, NaN where the fit failed; None if the markers are too near for it."""
    plane, pixels = board.points_m[seen], corners[seen]
    fit, _ = cv2.findHomography(plane, pixels)
    if fit is None:
        return None
    # along the board's row and column, a tenth of a square each way
    steps = 0.1 * board.square_m * np.eye(2)
    ends = [cv2.perspectiveTransform((plane + step).reshape(1, -1, 2), fit).reshape(-1, 2) for step in steps]
    middle = cv2.perspectiveTransform(plane.reshape(1, -1, 2), fit).reshape(-1, 2)
    along = np.stack([end - middle for end in ends], axis=1)
    px_per_m = float(np.linalg.norm(along, axis=2).min() / (0.1 * board.square_m))
    radius = min(MOST_RADIUS_PX, CLEAR_PART * (board.square_m - board.marker_m) / 2.0 * np.sqrt(2.0) * px_per_m)
    if radius < LEAST_RADIUS_PX:
        return None
    refined = np.full_like(corners, np.nan)
    refined[seen] = refine_edges(image, pixels, np.arctan2(along[..., 1], along[..., 0]), radius)
    return refined


def _in_a_line(points: Array) -> bool:
    return bool(len(points) < 3 or np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1] < 1e-6)
