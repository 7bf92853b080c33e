"""A checkerboard at a pose, to one camera's image of it at full resolution, true to a hundredth of a pixel.

Every pixel is mapped back through the true lens onto the board's plane, and from there to the nominal grid through
the displaced corners (bilinear within a square). The print is then known by its distance, in pixels, from the nearest
edges, and the blur across an edge is the Gaussian of the point-spread function and the pixel, in closed form. At a
corner the two edges' profiles are multiplied: that is exact where they cross at right angles and point-symmetric
always, so that a corner stays in its place. Left out: vignetting, uneven light, defocus, and the perspective within
one blur width.

What is stated: the board is exactly flat; each corner, of the squares at the border too, is printed off its
place by a normal error of ``world.board.print_sigma_m`` per axis, drawn once from the world's seed, so that it is the
same board in every image; noise and quantisation are the sensor's, each image with a seed of its own.
"""

import math

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from scipy.special import erf

from capture.errors import SimulationError
from hw_sim import optics
from hw_sim.render import Pixels, expose
from hw_sim.world import CameraTruth, World, nominal_pose, rotation

Array = NDArray[np.float64]
Singles = NDArray[np.float32]

_DEGREE = 27  # of the polynomials that map pixels to the board; their error is tested
_ROWS = 64  # rows worked on at a time, so that they stay in the processor's cache
_SURROUND_E = 250.0  # of what is around the sheet


def corners_m(world: World) -> Array:
    """True inner corners (rows, columns, 3) in the board frame: x along the columns, y along the rows, z away from
    the viewer, origin at the middle of the nominal board."""
    board = world.board
    offsets = _print_errors(world)[1:-1, 1:-1]
    points = np.zeros((board.rows, board.columns, 3))
    points[..., 0] = (np.arange(board.columns) - (board.columns - 1) / 2) * board.square_m + offsets[..., 0]
    points[..., 1] = (np.arange(board.rows) - (board.rows - 1) / 2)[:, None] * board.square_m + offsets[..., 1]
    return points


def render_board(world: World, camera: CameraTruth, T_body_board: Array, seed: int) -> Pixels:
    """Image (height, width) of the board at ``T_body_board`` (4, 4), with noise of ``seed``."""
    light = board_light_e(world, camera, T_body_board)
    return expose(world, light, 0.0, np.random.default_rng([world.seed, 0xB0, seed]))


def board_light_e(world: World, camera: CameraTruth, T_body_board: Array) -> Singles:
    """Expected electrons (height, width) of the board at ``T_body_board`` (4, 4): the image before any noise."""
    board = world.board
    light = np.full((world.sensor.height_px, world.sensor.width_px), _SURROUND_E, dtype=np.float32)
    outline = _outline_px(world, camera, T_body_board)
    if np.isfinite(outline).all():
        left, top = np.maximum(np.floor(outline.min(axis=0)).astype(int) - 6, 0)
        right, bottom = np.minimum(np.ceil(outline.max(axis=0)).astype(int) + 7, light.shape[::-1])
        if left < right and top < bottom:
            box = light[top:bottom, left:right]
            fields = _grid_fields(world, camera, T_body_board, (left, right - 1), (top, bottom - 1))
            offsets = (_print_errors(world) / board.square_m).astype(np.float32)
            for start in range(0, box.shape[0], _ROWS):
                rows = slice(start, start + _ROWS)
                columns, lines, dot_x, dot_y = (down[rows] @ right_ for down, right_ in fields)
                box[rows] = _print_e(world, offsets, columns, lines, dot_x, dot_y)
    return light


def board_poses(world: World, side: str) -> Array:
    """Poses ``T_body_board`` (n, 4, 4) of one pair's session: near to far, tilted, wholly in view of both cameras.

    Each pose is the one of many random ones that covers most of the images that no earlier pose has covered.

    Raises:
        SimulationError: the board is too large to be in view of both.
    """
    rng = np.random.default_rng([world.seed, 0xB05E, *side.encode()])
    pair = [world.camera(side, name) for name in ("cam0", "cam1")]
    nominal = nominal_pose(world.mount, side, "cam0")[:3, :3]
    nearest = 0.45
    farthest = max(min(1.6, pair[0].fx * world.board.square_m / 10.0), 1.05 * nearest)  # squares of 10 px
    covered = np.zeros((2, 24, 32), dtype=bool)
    poses = []
    for distance in np.geomspace(nearest, farthest, world.board.poses):
        found: tuple[int, Array, NDArray[np.bool_]] | None = None
        reach = float(distance)
        while found is None:
            for _ in range(120):
                pose = _random_pose(rng, pair, nominal, reach)
                cover = _coverage(world, pair, pose)
                if cover is not None:
                    gain = int((cover & ~covered).sum())
                    if found is None or gain > found[0]:
                        found = (gain, pose, cover)
            reach *= 1.05
            if found is None and reach > 4.0:
                raise SimulationError(f"no pose shows the whole board to both {side} cameras: use a smaller board")
        covered |= found[2]
        poses.append(found[1])
    return np.array(poses)


def _random_pose(rng: np.random.Generator, pair: list[CameraTruth], nominal: Array, distance: float) -> Array:
    camera = pair[rng.integers(2)]
    pixel = rng.uniform((0.0, 0.0), (2.0 * camera.cx, 2.0 * camera.cy))
    direction = rng.uniform(0.0, 2.0 * math.pi)
    tilt = math.radians(rng.uniform(12.0, 40.0))
    roll = math.radians(rng.uniform(-20.0, 20.0))
    turn = rotation(np.array([math.cos(direction), math.sin(direction), 0.0]) * tilt)
    pose = np.eye(4)
    pose[:3, :3] = nominal @ turn @ rotation(np.array([0.0, 0.0, roll]))
    pose[:3, 3] = optics.position_m(camera) + distance * optics.rays(camera, pixel)
    return pose


def _coverage(world: World, pair: list[CameraTruth], pose: Array) -> NDArray[np.bool_] | None:
    """Which cells (2, 24, 32) of both images the inner corners fall in; None unless all squares are in view of both."""
    size = np.array([world.sensor.width_px, world.sensor.height_px])
    cover = np.zeros((2, 24, 32), dtype=bool)
    inner = corners_m(world).reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3]
    for image, camera in enumerate(pair):
        outline = _outline_px(world, camera, pose, with_margin=False)
        if not (np.all(outline > 5.0) and np.all(outline < size - 6.0)):  # NaN is not in view
            return None
        sides = np.linalg.norm(np.roll(outline[:4], -1, axis=0) - outline[:4], axis=1)
        squares = np.tile((world.board.columns + 1, world.board.rows + 1), 2)
        facing = camera.fx * world.board.square_m / np.linalg.norm(pose[:3, 3] - optics.position_m(camera))
        if np.min(sides / squares) < 0.6 * facing:  # too oblique to be told by anyone
            return None
        cells = (optics.project(camera, inner) / size * (32, 24)).astype(int)
        cover[image, cells[:, 1], cells[:, 0]] = True
    return cover


def _outline_px(world: World, camera: CameraTruth, pose: Array, with_margin: bool = True) -> Array:
    """The corners, then points along the edges, of the sheet (or of its squares) in the image (n, 2)."""
    board = world.board
    margin = board.margin_m if with_margin else 0.0
    half = np.array([(board.columns + 1) * board.square_m, (board.rows + 1) * board.square_m]) / 2 + margin
    ends = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    part = np.linspace(0.0, 1.0, 12, endpoint=False)[1:, None, None]
    edge = np.concatenate([ends, (ends + part * (np.roll(ends, -1, axis=0) - ends)).reshape(-1, 2)]) * half
    points = np.column_stack([edge, np.zeros(len(edge))])
    return optics.project(camera, points @ pose[:3, :3].T + pose[:3, 3])


def _print_errors(world: World) -> Array:
    """Offsets (rows + 2, columns + 2, 2) in metres of all corners of the squares, those at the border included."""
    rng = np.random.default_rng([world.seed, 0xB0A7])
    return rng.normal(0.0, world.board.print_sigma_m, (world.board.rows + 2, world.board.columns + 2, 2))


def _grid_fields(
    world: World, camera: CameraTruth, pose: Array, columns_px: tuple[int, int], rows_px: tuple[int, int]
) -> list[tuple[Singles, Singles]]:
    """Four smooth fields over a box of pixels, each as a product (rows, k) · (k, columns) of Chebyshev polynomials.

    Column and line in squares from the first square's corner, and pixels per square along the gradient of each.
    """
    board = world.board
    nodes = np.cos(math.pi * (np.arange(_DEGREE + 1) + 0.5) / (_DEGREE + 1))
    half_x, half_y = (columns_px[1] - columns_px[0]) / 2 + 0.5, (rows_px[1] - rows_px[0]) / 2 + 0.5
    middle = np.array([sum(columns_px) / 2, sum(rows_px) / 2])
    grid_x, grid_y = np.meshgrid(nodes, nodes)
    toward = optics.rays(camera, middle + np.stack([grid_x * half_x, grid_y * half_y], axis=-1)) @ pose[:3, :3]
    start = (optics.position_m(camera) - pose[:3, 3]) @ pose[:3, :3]
    on_board = start[:2] - toward[..., :2] * (start[2] / toward[..., 2])[..., None]
    across = on_board[..., 0] / board.square_m + (board.columns + 1) / 2
    along = on_board[..., 1] / board.square_m + (board.rows + 1) / 2
    to_coefficients = np.linalg.inv(chebyshev.chebvander(nodes, _DEGREE))
    at_columns = (np.arange(columns_px[0], columns_px[1] + 1) - middle[0]) / half_x
    at_rows = (np.arange(rows_px[0], rows_px[1] + 1) - middle[1]) / half_y
    vander_x, vander_y = chebyshev.chebvander(at_columns, _DEGREE), chebyshev.chebvander(at_rows, _DEGREE)
    node_vander = chebyshev.chebvander(nodes, _DEGREE)
    fields = []
    for field in (across, along):
        coefficients = to_coefficients @ field @ to_coefficients.T
        slope_x = chebyshev.chebder(coefficients, axis=1) / half_x
        slope_y = chebyshev.chebder(coefficients, axis=0) / half_y
        slope = np.hypot(node_vander @ slope_x @ node_vander[:, :-1].T, node_vander[:, :-1] @ slope_y @ node_vander.T)
        for part in (coefficients, to_coefficients @ (1.0 / slope) @ to_coefficients.T):
            fields.append(((vander_y @ part).astype(np.float32), vander_x.T.astype(np.float32)))
    return [fields[0], fields[2], fields[1], fields[3]]


def _print_e(
    world: World, offsets: Singles, columns: Singles, lines: Singles, dot_x: Singles, dot_y: Singles
) -> Singles:
    """Electrons of pixels at grid coordinates (columns, lines) in squares, ``dot`` pixels per square across each."""
    board = world.board
    wide, tall = board.columns + 1, board.rows + 1
    columns, lines = _undisplaced(offsets, columns, lines)
    sharp = np.float32(1.0 / math.sqrt(2.0 * (world.sensor.psf_sigma_px**2 + 1.0 / 12.0)))
    dot_x, dot_y = dot_x * sharp, dot_y * sharp
    margin = board.margin_m / board.square_m
    black = (1.0 + _wave(columns, wide, dot_x) * _wave(lines, tall, dot_y)) * 0.5
    black *= _inside(columns, 0.0, wide, dot_x) * _inside(lines, 0.0, tall, dot_y)
    sheet = _inside(columns, -margin, wide + margin, dot_x) * _inside(lines, -margin, tall + margin, dot_y)
    print_e = np.float32(board.white_e) - np.float32(board.white_e - board.black_e) * black
    light: Singles = np.float32(_SURROUND_E) + (print_e - np.float32(_SURROUND_E)) * sheet
    return light


def _undisplaced(offsets: Singles, columns: Singles, lines: Singles) -> tuple[Singles, Singles]:
    """Nominal grid coordinates of printed ones, to second order in the displacement (under 1e-3 px)."""
    i = np.clip(columns, 0, offsets.shape[1] - 2).astype(np.int32)
    j = np.clip(lines, 0, offsets.shape[0] - 2).astype(np.int32)
    a, b = np.clip(columns - i, 0, 1, dtype=np.float32), np.clip(lines - j, 0, 1, dtype=np.float32)
    flat = offsets.reshape(-1, 2)
    at = j * offsets.shape[1] + i
    out = []
    for axis, nominal in ((0, columns), (1, lines)):
        table = np.ascontiguousarray(flat[:, axis])
        first, second = table[at], table[at + offsets.shape[1]]
        upper = first + a * (table[at + 1] - first)
        lower = second + a * (table[at + offsets.shape[1] + 1] - second)
        out.append(nominal - (upper + b * (lower - upper)))
    return out[0], out[1]


def _wave(place: Singles, count: int, dot: Singles) -> Singles:
    """+1 in even squares, −1 in odd ones, blurred at the inner edges."""
    edge = np.clip(np.rint(place), 1, count - 1)
    sign = 1.0 - 2.0 * np.mod(edge, 2.0, dtype=np.float32)
    wave: Singles = sign * erf((place - edge) * dot)
    return wave


def _inside(place: Singles, first: float, last: float, dot: Singles) -> Singles:
    """1 between ``first`` and ``last``, 0 outside, blurred at both."""
    depth = np.minimum(place - np.float32(first), np.float32(last) - place)
    inside: Singles = 0.5 + 0.5 * erf(depth * dot)
    return inside
