"""One checkerboard image to the sub-pixel places of the board's inner corners, in a fixed order."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.errors import ProcessError, UsageError
from process.corner_fit import refine_edges

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

FINDERS = ("edges", "subpix", "sb")  # how a corner's place can be measured; see find_corners
SEARCH_WIDTH_PX = 1100  # the plain finder looks at the picture at about this width first: it is much faster there
MIN_SPACING_PX = 5.0
REFINE_RADIUS_PX = 10.0  # of the window around a corner; beyond it, lens distortion bends the edges


@dataclass(frozen=True)
class Board:
    """A checkerboard: inner corners in a row, rows, and the side of a square; a ChArUco board with its markers."""

    columns: int
    rows: int
    square_m: float
    charuco: str | None = None
    """OpenCV's name of the markers' dictionary; None: a plain checkerboard"""
    marker_m: float = 0.0
    """side of a marker"""

    @classmethod
    def parse(cls, size: str, square_mm: float) -> Self:
        """Board of ``size`` such as "10x7" inner corners; UsageError if it is none."""
        match = re.fullmatch(r"(\d+)[x×](\d+)", size.strip())
        if match is None:
            raise UsageError(f'--board {size}: give the inner corners as COLUMNSxROWS, such as "10x7"')
        columns, rows = int(match[1]), int(match[2])
        if not (3 <= columns <= 100 and 3 <= rows <= 100):
            raise UsageError(f"--board {size}: each side needs 3 to 100 inner corners")
        if not 0.1 <= square_mm <= 1000.0:
            raise UsageError(f"--square-mm {square_mm:g}: give the side of one square, 0.1 to 1000 mm")
        return cls(columns, rows, square_mm / 1000.0)

    @property
    def corners(self) -> int:
        return self.columns * self.rows

    @property
    def points_m(self) -> Array:
        """Nominal corners (N, 2), metres, row by row; their centroid is the origin."""
        x, y = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        grid = np.stack([x.ravel() - (self.columns - 1) / 2, y.ravel() - (self.rows - 1) / 2], axis=1)
        return np.asarray(grid * self.square_m, np.float64)

    @property
    def looks_the_same_upside_down(self) -> bool:
        """Whether half a turn maps black squares on black squares, so that corners cannot be told apart."""
        return self.charuco is None and (self.columns + self.rows) % 2 == 0


@dataclass(frozen=True, eq=False)
class View:
    """What was found in one image: for each of ``FINDERS`` that succeeded, corners (N, 2) in pixels."""

    path: Path
    corners: dict[str, Array]
    reason: str
    """why there are none; empty if there are"""


def read_grey(path: Path) -> Image:
    """The image (H, W) of an 8-bit grey file. ProcessError if it is of another kind or truncated."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ProcessError(f"{path}: {error.strerror}") from error
    if not _is_whole(data):
        raise ProcessError(f"{path}: the file is truncated; copy it again or leave it out")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    if image is None:
        raise ProcessError(f"{path}: not a picture that can be read; give 8-bit grey PNG files")
    if image.dtype != np.uint8 or image.ndim != 2:
        kind = f"{image.dtype.itemsize * 8}-bit, {1 if image.ndim == 2 else image.shape[2]} channels"
        raise ProcessError(f"{path}: {kind}; give 8-bit grey images, as the cameras record them")
    return np.asarray(image, np.uint8)


def refuse_blank(path: Path, image: Image) -> None:
    """ProcessError if nothing is to be seen in ``image``: the lens cap was on, or the exposure was far off."""
    if float(image.std()) < 1.0:
        raise ProcessError(f"{path}: blank, every pixel is about {image.mean():.0f}; leave this view out")


def _is_whole(data: bytes) -> bool:
    """Whether the file's own end marker is there: the decoders fill what is missing with grey and stay silent."""
    if data.startswith(b"\x89PNG"):
        return b"IEND" in data[-16:]
    if data.startswith(b"\xff\xd8"):
        return b"\xff\xd9" in data[-64:]
    if data.startswith(b"BM"):
        return len(data) >= int.from_bytes(data[2:6], "little")
    header = re.match(rb"P5\s+(?:#[^\n]*\s+)*(\d+)\s+(\d+)\s+(\d+)\s", data)
    if header:
        return len(data) >= header.end() + int(header[1]) * int(header[2]) * (2 if int(header[3]) > 255 else 1)
    return True


def find_corners(path: Path, image: Image, board: Board, finders: Sequence[str] = FINDERS) -> View:
    """Corners of the one board in ``image``, by each of the ways in ``finders``, of ``FINDERS``.

    ``subpix`` is the plain finder with cornerSubPix, ``sb`` the sector-based finder, and ``edges`` fits blurred
    edges to the grey values around each corner. No one of them is best on every board: the caller chooses by the
    residuals of a calibration.
    """
    coarse = _find_plain(image, board)
    sector_based = _find_sector_based(image, board, coarse) if coarse is None or "sb" in finders else None
    start = coarse if coarse is not None else sector_based
    if start is None:
        return View(path, {}, f"no board of {board.columns}x{board.rows} inner corners found")
    start = in_board_order(image, start, board)
    reason = _why_unusable(image, start, board)
    if reason:
        return View(path, {}, reason)
    radius = refinement_radius_px(start, board)
    found = {}
    if "edges" in finders:
        found["edges"] = refine_edges(image, start, edge_directions_rad(start, board), radius)
    if "subpix" in finders:
        found["subpix"] = _refine_subpix(image, start, radius)
    if "sb" in finders and sector_based is not None:
        found["sb"] = in_board_order(image, sector_based, board)
    limit = 0.25 * corner_spacing_px(start, board)
    good = {
        name: corners for name, corners in found.items() if np.abs(corners - start).max() < limit
    }  # also false for NaN: a corner that could not be refined
    return View(path, good, "" if good else "the corners could not be measured: the picture is blurred or noisy")


def _find_plain(image: Image, board: Board) -> Array | None:
    # no CALIB_CB_NORMALIZE_IMAGE: it spreads the noise of a dark surround over all grey values, misses boards there
    # and takes half a minute over it
    shape, flags = (board.columns, board.rows), cv2.CALIB_CB_ADAPTIVE_THRESH
    factor = SEARCH_WIDTH_PX / max(image.shape)
    if factor < 0.8:
        small = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        found, corners = cv2.findChessboardCorners(small, shape, flags=flags)
        if found:
            scale = np.array([image.shape[1] / small.shape[1], image.shape[0] / small.shape[0]])
            corners = (np.asarray(corners, np.float64).reshape(-1, 2) + 0.5) * scale - 0.5
            reach = max(2, round(1.5 / factor))
            return _subpix(image, corners, min(reach, int(0.4 * corner_spacing_px(corners, board))))
    for picture in (image, cv2.GaussianBlur(image, (0, 0), 1.0)):
        found, corners = cv2.findChessboardCorners(picture, shape, flags=flags)
        if found:
            return np.asarray(corners, np.float64).reshape(-1, 2)
    return None


def _find_sector_based(image: Image, board: Board, near: Array | None) -> Array | None:
    """The sector-based finder, on the part of the picture where the board is known to be."""
    left, top, right, bottom = 0, 0, image.shape[1], image.shape[0]
    if near is not None:
        margin = 2.5 * corner_spacing_px(near, board, longest=True)
        left, top = (int(max(0.0, low)) for low in near.min(axis=0) - margin)
        right, bottom = (int(high) for high in near.max(axis=0) + margin)
    part = np.ascontiguousarray(image[top:bottom, left:right])
    found, corners = cv2.findChessboardCornersSB(part, (board.columns, board.rows), flags=cv2.CALIB_CB_ACCURACY)
    return np.asarray(corners, np.float64).reshape(-1, 2) + np.array([left, top]) if found else None


def corner_spacing_px(corners: Array, board: Board, longest: bool = False) -> float:
    """Shortest (or longest) distance between neighbouring corners."""
    grid = corners.reshape(board.rows, board.columns, 2)
    steps = np.concatenate([np.linalg.norm(np.diff(grid, axis=axis), axis=2).ravel() for axis in (0, 1)])
    return float(steps.max() if longest else steps.min())


def refinement_radius_px(corners: Array, board: Board) -> float:
    """Radius of a window around each corner that holds its own edges only."""
    return float(np.clip(0.4 * corner_spacing_px(corners, board), 3.0, REFINE_RADIUS_PX))


def _refine_subpix(image: Image, corners: Array, radius: float) -> Array:
    return _subpix(image, corners, max(2, int(radius)))


def _subpix(image: Image, corners: Array, half_window: int) -> Array:
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-4)
    start = corners.astype(np.float32).reshape(-1, 1, 2)
    half_window = max(2, half_window)
    refined = cv2.cornerSubPix(image, start, (half_window, half_window), (-1, -1), criteria)
    return np.asarray(refined, np.float64).reshape(-1, 2)


def edge_directions_rad(corners: Array, board: Board) -> Array:
    """Directions (N, 2) in the image of the board's row and of its column at each corner."""
    grid = corners.reshape(board.rows, board.columns, 2)
    along_row, along_column = _gradient(grid, axis=1), _gradient(grid, axis=0)
    return np.stack([np.arctan2(step[..., 1], step[..., 0]).ravel() for step in (along_row, along_column)], axis=1)


def _gradient(grid: Array, axis: int) -> Array:
    return np.asarray(np.gradient(grid, axis=axis))


def in_board_order(image: Image, corners: Array, board: Board) -> Array:
    """The same corners, row by row from the one whose inner square is dark, x to the right of y as seen.

    The finders may begin at either end. Where both ends look the same (``looks_the_same_upside_down``), the first
    row is taken to run towards the right of the picture.
    """
    orders = _orders(corners, board)
    if board.looks_the_same_upside_down:
        rightward = [(order[board.columns - 1] - order[0]) @ [1.0, 0.0] for order in orders]
        return orders[int(np.argmax(rightward))]
    brightness = [_square_brightness(image, order, board) for order in orders]
    return orders[int(np.argmin(brightness))]


def _orders(corners: Array, board: Board) -> list[Array]:
    """All readings of the grid that keep its shape and are not mirrored."""
    grid = corners.reshape(board.rows, board.columns, 2)
    readings = [grid, grid[::-1, ::-1]]
    if board.rows == board.columns:
        turned = grid.transpose(1, 0, 2)
        readings += [turned[::-1], turned[:, ::-1]]
    across, down = _gradient(grid, axis=1).mean(axis=(0, 1)), _gradient(grid, axis=0).mean(axis=(0, 1))
    if across[0] * down[1] - across[1] * down[0] < 0.0:
        readings = [reading[::-1] for reading in readings]
    return [np.ascontiguousarray(reading).reshape(-1, 2) for reading in readings]


def _square_brightness(image: Image, corners: Array, board: Board) -> float:
    """Mean grey value of the squares that are dark in the right order, minus that of the others."""
    grey = _inside_squares(image, corners, board).mean(axis=0)
    dark = np.add.outer(np.arange(board.rows - 1), np.arange(board.columns - 1)) % 2 == 0
    return float(grey[dark].mean() - grey[~dark].mean())


def _inside_squares(image: Image, corners: Array, board: Board) -> Array:
    """Grey values (5, rows - 1, columns - 1) at five places inside each square between the corners."""
    grid = corners.reshape(board.rows, board.columns, 2)
    upper_left, upper_right, lower_left, lower_right = grid[:-1, :-1], grid[:-1, 1:], grid[1:, :-1], grid[1:, 1:]
    grey = []
    for x, y in ((0.5, 0.5), (0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75)):
        place = (1 - y) * ((1 - x) * upper_left + x * upper_right) + y * ((1 - x) * lower_left + x * lower_right)
        pixels = np.clip(np.rint(place).astype(int), 0, [image.shape[1] - 1, image.shape[0] - 1])
        grey.append(image[pixels[..., 1], pixels[..., 0]].astype(np.float64))
    return np.array(grey)


def _why_unusable(image: Image, corners: Array, board: Board) -> str:
    """Why these corners are not this board's; empty if they are."""
    spacing = corner_spacing_px(corners, board)
    if spacing < MIN_SPACING_PX:
        return f"the board is too small in the picture: {spacing:.1f} px between corners, {MIN_SPACING_PX:g} are needed"
    not_a_grid = f"the corners found do not form a grid of {board.columns}x{board.rows} in a plane"
    fit, _ = cv2.findHomography(board.points_m, corners)
    if fit is None:
        return not_a_grid
    plane = cv2.perspectiveTransform(board.points_m.reshape(1, -1, 2), fit).reshape(-1, 2)
    if np.linalg.norm(plane - corners, axis=1).max() > 0.5 * spacing:  # lens distortion bends it far less
        return not_a_grid
    inside = _inside_squares(image, corners, board)
    contrast = abs(_square_brightness(image, corners, board))
    if np.mean(np.ptp(inside, axis=0) < 0.5 * contrast) < 0.8 or _goes_on(image, corners, board):
        # the sector-based finder also returns parts of a larger board, and grids across its squares
        return f"not a board of {board.columns}x{board.rows} inner corners, but another or a part of a larger one"
    return ""


def _goes_on(image: Image, corners: Array, board: Board) -> bool:
    """Whether the pattern of squares continues beyond the corners: then only a part of the board was found."""
    all_steps = _steps(corners, board)
    contrast = np.median(np.abs(_saddle(image, corners, all_steps)))
    grid, steps = corners.reshape(board.rows, board.columns, 2), all_steps.reshape(board.rows, board.columns, 2, 2)
    for line, step, before in (
        (grid[0], steps[0], grid[1]),
        (grid[-1], steps[-1], grid[-2]),
        (grid[:, 0], steps[:, 0], grid[:, 1]),
        (grid[:, -1], steps[:, -1], grid[:, -2]),
    ):
        beyond = np.abs(_saddle(image, 2.0 * line - before, step))
        # at the board's rim only one of two dark squares meets a point: half of an inner corner's value
        if np.mean(beyond > 0.75 * contrast) > 0.7:
            return True
    return False


def _steps(corners: Array, board: Board) -> Array:
    grid = corners.reshape(board.rows, board.columns, 2)
    return np.stack([_gradient(grid, axis=1), _gradient(grid, axis=0)], axis=2).reshape(-1, 2, 2)


def _saddle(image: Image, points: Array, steps: Array) -> Array:
    """Sum of two opposite squares' grey values around each point, minus the other two's; 0 outside the picture."""
    value = np.zeros(len(points))
    for along, across, sign in ((0.3, 0.3, 1), (-0.3, -0.3, 1), (0.3, -0.3, -1), (-0.3, 0.3, -1)):
        pixels = np.rint(points + along * steps[:, 0] + across * steps[:, 1]).astype(int)
        inside = np.all((pixels >= 0) & (pixels < [image.shape[1], image.shape[0]]), axis=1)
        pixels[~inside] = 0
        value += np.where(inside, sign * image[pixels[:, 1], pixels[:, 0]].astype(np.float64), np.nan)
    return np.nan_to_num(value)
