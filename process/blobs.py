"""A frame to its blobs: connected groups of pixels above the background, measured, gated, parted where two meet."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]
Indices = NDArray[np.intp]

MAX_BLOBS = 400
"""Beyond these the scene is not a dark one with lights: the largest are kept, the rest counted as rejected."""
OUTLINE_AREA_PX = 40  # smaller blobs have no outline to speak of
_TILE = 16  # pixels on each side; the background is sampled once in each
_LEVELS = (0.5, 0.7, 0.85)  # of a blob's peak, where two lights that run into each other part
_SHAPE_FLAT_PX2 = 0.15  # added to both second moments: a few pixels do not have a shape


@dataclass(frozen=True)
class Rejected:
    """A blob that is not taken for a light."""

    u_px: float
    v_px: float
    reason: str


@dataclass
class Scene:
    """The image above its background."""

    image: Pixels
    smooth: Pixels | None
    """background (tiles down, tiles across) where it varies: light is counted from it; None: from 0"""
    floor: float
    """grey levels that light still has of background"""
    sigma: float
    """noise of the background"""
    threshold: float
    """grey levels of light"""
    rejected: list[Rejected] = field(default_factory=list)

    def reject(self, u: float, v: float, reason: str) -> None:
        """Note that a blob is turned down."""
        self.rejected.append(Rejected(float(u), float(v), reason))

    def light(self, rows: Indices, columns: Indices) -> NDArray[np.intp]:
        """Grey levels of pixels above the background, where it varies."""
        grey = self.image[rows, columns].astype(np.intp)
        return grey if self.smooth is None else np.maximum(grey - self.background(rows, columns), 0)

    def background(self, rows: Indices, columns: Indices) -> NDArray[np.intp]:
        """Grey levels of background at pixels; ``floor`` where it does not vary."""
        if self.smooth is None:
            return np.full(np.broadcast_shapes(rows.shape, columns.shape), round(self.floor), dtype=np.intp)
        (above, below, down), (left, right, across) = (
            _between(places, size) for places, size in zip((rows, columns), self.smooth.shape, strict=True)
        )
        grid = self.smooth.astype(np.float64)
        upper = grid[above, left] * (1.0 - across) + grid[above, right] * across
        lower = grid[below, left] * (1.0 - across) + grid[below, right] * across
        return np.asarray(np.rint(upper * (1.0 - down) + lower * down).astype(np.intp))


@dataclass(frozen=True, eq=False)
class Blobs:
    """N groups of pixels above the threshold."""

    u_px: Array
    """centre of the light above the threshold"""
    v_px: Array
    area_px: Array
    """pixels, counted"""
    peak: Array
    """grey levels above the background"""
    roundness: Array
    """minor over major axis of the light's second moments"""
    circularity: Array
    """4π · area / perimeter² (eq. 3 with its square restored); 1 for blobs of up to 40 px"""

    def __len__(self) -> int:
        return len(self.u_px)

    def __getitem__(self, chosen: Indices | NDArray[np.bool_] | slice) -> "Blobs":
        return Blobs(*(column[chosen] for column in self._columns))

    @property
    def _columns(self) -> tuple[Array, ...]:
        return self.u_px, self.v_px, self.area_px, self.peak, self.roundness, self.circularity

    @classmethod
    def join(cls, parts: Sequence["Blobs"]) -> "Blobs":
        """All of ``parts``, at least one, in their order."""
        return cls(*(np.concatenate(columns) for columns in zip(*(part._columns for part in parts), strict=True)))


def scene_of(image: Pixels, contrast: float) -> Scene:
    """Background and noise from a few pixels of every tile; a background that varies is subtracted.

    The threshold is ``contrast`` grey levels above the background, or 6 σ of its noise if that is more.
    """
    sample = np.ascontiguousarray(image[_TILE // 2 :: _TILE, _TILE // 2 :: _TILE])
    smooth = cv2.medianBlur(sample, 5) if min(sample.shape) >= 5 else np.full_like(sample, int(np.median(sample)))
    # neighbours differ by noise alone wherever the scene is smooth; the clip keeps edges and lights out of it
    first, second = image[::_TILE, :-1:_TILE], image[::_TILE, 1::_TILE]
    steps = _histogram(cv2.absdiff(np.ascontiguousarray(first), np.ascontiguousarray(second)))
    bound = max(4.0, 6.0 * _quantile(steps, 0.5))
    sigma = max(0.6, float(steps @ np.minimum(np.arange(256.0), bound)) / steps.sum() * np.sqrt(np.pi) / 2.0)
    threshold = max(contrast, 6.0 * sigma)
    levels = _histogram(smooth)
    if _quantile(levels, 0.98) - _quantile(levels, 0.02) <= threshold / 3.0:
        floor = _quantile(_histogram(sample), 0.5)
        return Scene(image, None, floor, sigma, floor + threshold)
    return Scene(image, smooth, 0.0, sigma, threshold)


def find_blobs(scene: Scene, largest_radius_px: float, least_roundness: float) -> Blobs:
    """The blobs that may be lights, in the order of their rows; the others are noted in ``scene`` with a reason."""
    lit_rows, lit_columns = _lit(scene)
    if not len(lit_rows):
        return _nothing()
    rows, v = _without_gaps(lit_rows, scene.image.shape[0])
    columns, u = _without_gaps(lit_columns, scene.image.shape[1])
    mask = np.zeros((len(rows), len(columns)), np.uint8)
    mask[v, u] = 1
    contours = _contours(scene, mask)
    boxes = np.array([cv2.boundingRect(contour) for contour in contours])
    boxes[:, 0], boxes[:, 1] = columns[boxes[:, 0]], rows[boxes[:, 1]]
    bad = _border_or_too_large(scene, boxes, largest_radius_px)
    contours = [contour for contour, out in zip(contours, bad, strict=True) if not out]
    if not contours:
        return _nothing()
    labels = np.zeros(mask.shape, np.int16)
    for number, contour in enumerate(contours):
        cv2.drawContours(labels, [contour], -1, number + 1, cv2.FILLED)
    members = _members(labels[v, u], lit_rows, lit_columns, len(contours))
    blobs = _measured(scene, members, contours)
    return _gated(scene, blobs, members, largest_radius_px, least_roundness)


def _between(places: Indices, size: int) -> tuple[Indices, Indices, Array]:
    """Of pixels along one axis: the two samples of ``size`` they are between, and how far they are to the second."""
    at = (places - _TILE // 2) / _TILE
    first = np.clip(np.floor(at).astype(np.intp), 0, size - 1)
    return first, np.minimum(first + 1, size - 1), np.clip(at - first, 0.0, 1.0)


def _histogram(levels: Pixels) -> Array:
    """(256,)"""
    return np.asarray(cv2.calcHist([levels], [0], None, [256], [0, 256]).ravel(), np.float64)


def _quantile(histogram: Array, part: float) -> float:
    cumulative = np.cumsum(histogram)
    return float(np.searchsorted(cumulative, part * cumulative[-1]))


def _lit(scene: Scene) -> tuple[Indices, Indices]:
    """Rows and columns of the pixels that reach the threshold."""
    if scene.smooth is not None:
        return _lit_before(scene, scene.smooth)
    rows = _lit_rows(scene)
    band = scene.image if len(rows) == len(scene.image) else scene.image[rows]
    row, column = np.divmod(np.flatnonzero(band > int(scene.threshold)), scene.image.shape[1])
    return rows[row], column


def _lit_rows(scene: Scene) -> Indices:
    """Rows that may have lit pixels.

    The bits of all pixels of a row together are never less than its brightest, and take half the time to find.
    """
    image = scene.image
    if image.flags.c_contiguous and image.shape[1] % 8 == 0:
        words = np.bitwise_or.reduce(image.view(np.uint64), axis=1)
        bits = np.bitwise_or.reduce(words[:, None].view(np.uint8), axis=1)
    else:
        bits = image.max(axis=1)
    return np.flatnonzero(bits > int(scene.threshold))


def _lit_before(scene: Scene, smooth: Pixels) -> tuple[Indices, Indices]:
    """``_lit`` before a background that varies: only half tiles that may have lit pixels are looked into."""
    height, width = scene.image.shape
    half = _TILE // 2  # wide: the bytes of a word
    brightest = _brightest(scene.image)
    least = cv2.erode(smooth, np.ones((3, 3), np.uint8))  # between samples it is nowhere less than the least around
    down, across = (
        np.minimum(np.arange(size) // tile, samples - 1)
        for size, tile, samples in zip(brightest.shape, (1, _TILE), least.shape, strict=True)
    )
    brightest = cv2.subtract(brightest, np.ascontiguousarray(least[down][:, across]))
    bright = (brightest > int(scene.threshold)).view(np.uint64) != 0
    row, column = np.divmod(np.flatnonzero(bright), bright.shape[1])
    rows, columns = row[:, None] * _TILE + np.arange(_TILE), column[:, None] * half + np.arange(half)
    inside = np.minimum(rows, height - 1)[:, :, None], np.minimum(columns, width - 1)[:, None, :]
    there = scene.light(*inside) > int(scene.threshold)
    there &= (rows < height)[:, :, None] & (columns < width)[:, None, :]
    tile, down, across = np.nonzero(there)
    return rows[tile, down], columns[tile, across]


def _brightest(image: Pixels) -> Pixels:
    """(rows of tiles, columns) the brightest pixel of each column of each tile; columns filled up to half tiles.

    In halves, so that the image is read from its beginning to its end.
    """
    height, width = image.shape
    brightest = np.zeros((-(-height // _TILE), -(-width // (_TILE // 2)) * (_TILE // 2)), np.uint8)
    whole = height // _TILE
    rows = image[: whole * _TILE].reshape(whole, _TILE, width)
    count = _TILE
    while count > 1:
        count //= 2
        rows = np.maximum(rows[:, :count], rows[:, count:])
    brightest[:whole, :width] = rows[:, 0]
    if whole < len(brightest):
        brightest[whole, :width] = image[whole * _TILE :].max(axis=0)
    return brightest


def _without_gaps(places: Indices, size: int) -> tuple[Indices, Indices]:
    """Rows (or columns) that have lit pixels, and those beside them; and which of these each of ``places`` is.

    Groups that are apart in the frame stay apart.
    """
    near = np.zeros(size + 2, dtype=bool)
    for beside in range(3):
        near[places + beside] = True
    near = near[1:-1]
    return np.flatnonzero(near), (np.cumsum(near) - 1)[places]


def _contours(scene: Scene, mask: Pixels) -> list[NDArray[np.int32]]:
    """Outlines of the connected groups of ``mask``; the largest ones if there are many."""
    found, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    contours = [contour.reshape(-1, 2) for contour in reversed(found)]  # OpenCV begins at the bottom
    if len(contours) > MAX_BLOBS:
        contours.sort(key=lambda contour: -len(contour))
        scene.reject(np.nan, np.nan, f"crowded: {len(contours) - MAX_BLOBS} blobs beyond the {MAX_BLOBS} largest")
        contours = contours[:MAX_BLOBS]
    return contours


def _border_or_too_large(scene: Scene, boxes: NDArray[np.intp], largest_radius_px: float) -> NDArray[np.bool_]:
    """(N,) whether a blob of box (x, y, width, height) is turned down by it."""
    rows, columns = scene.image.shape
    x, y, width, height = boxes.T
    border = (x == 0) | (y == 0) | (x + width == columns) | (y + height == rows)
    large = np.maximum(width, height) > 4 * largest_radius_px
    for number in np.flatnonzero(border | large).tolist():
        reason = "border" if border[number] else "too large"
        scene.reject(x[number] + (width[number] - 1) / 2, y[number] + (height[number] - 1) / 2, reason)
    return np.asarray(border | large)


def _members(label: NDArray[np.int16], rows: Indices, columns: Indices, count: int) -> list[tuple[Indices, Indices]]:
    """Columns and rows of each group's pixels: those labelled 1 to ``count``."""
    order = np.argsort(label, kind="stable")
    u, v = columns[order], rows[order]
    ends = np.cumsum(np.bincount(label, minlength=count + 1)).tolist()  # the first are of groups that are out
    return [(u[begin:end], v[begin:end]) for begin, end in pairwise(ends)]


def _measured(scene: Scene, members: Sequence[tuple[Indices, Indices]], contours: Sequence[NDArray[np.int32]]) -> Blobs:
    """Moments of the light above the threshold over the pixels of each group."""
    counts = np.array([len(columns) for columns, _ in members])
    starts = np.cumsum(counts) - counts
    u, v = (np.concatenate([member[k] for member in members]) for k in (0, 1))
    grey = scene.light(v, u).astype(np.float64)
    light = grey - (int(scene.threshold) - 1)
    # about the first pixel: moments about the frame's corner would lose digits
    first_u, first_v = u[starts], v[starts]
    du, dv = u - np.repeat(first_u, counts), v - np.repeat(first_v, counts)
    lu, lv = light * du, light * dv
    m00, m10, m01, m20, m11, m02 = np.add.reduceat(np.stack([light, lu, lv, lu * du, lu * dv, lv * dv]), starts, axis=1)
    mean_u, mean_v = m10 / m00, m01 / m00
    a, b, c = m20 / m00 - mean_u**2, m11 / m00 - mean_u * mean_v, m02 / m00 - mean_v**2
    middle, half = (a + c) / 2, np.hypot((a - c) / 2, b)
    roundness = np.sqrt((np.maximum(middle - half, 0.0) + _SHAPE_FLAT_PX2) / (middle + half + _SHAPE_FLAT_PX2))
    circularity = np.ones(len(counts))
    for number in np.flatnonzero(counts > OUTLINE_AREA_PX).tolist():
        perimeter = cv2.arcLength(contours[number], True)
        circularity[number] = 4.0 * np.pi * counts[number] / perimeter**2 if perimeter > 0 else 1.0
    peak = np.maximum.reduceat(grey, starts) - scene.floor
    return Blobs(mean_u + first_u, mean_v + first_v, counts.astype(np.float64), peak, roundness, circularity)


def _gated(
    scene: Scene,
    blobs: Blobs,
    members: Sequence[tuple[Indices, Indices]],
    largest_radius_px: float,
    least_roundness: float,
) -> Blobs:
    """The light, or the lights, that each blob is; none with a reason in ``scene`` if it is not one."""
    passed = _passes(blobs, largest_radius_px, least_roundness)
    oblong = (blobs.roundness < 0.85) & (blobs.area_px >= 6)
    unclear = np.flatnonzero((blobs.area_px <= 3) | oblong | (passed != ""))
    if not len(unclear):
        return blobs
    keep = np.ones(len(blobs), dtype=bool)
    parted = []
    for number in unclear.tolist():
        u, v = blobs.u_px[number], blobs.v_px[number]
        keep[number] = False
        if blobs.area_px[number] <= 3 and _is_hot_pixel(scene, members[number], blobs.peak[number]):
            scene.reject(u, v, "hot pixel")
        elif oblong[number] and (parts := _split(scene, members[number], blobs.peak[number])) is not None:
            reasons = _passes(parts, largest_radius_px, least_roundness)
            for part in np.flatnonzero(reasons != "").tolist():
                scene.reject(parts.u_px[part], parts.v_px[part], str(reasons[part]))
            parted.append(parts[reasons == ""])
        elif passed[number] != "":
            scene.reject(u, v, str(passed[number]))
        else:
            keep[number] = True
    return Blobs.join([blobs[keep], *parted])


def _passes(blobs: Blobs, largest_radius_px: float, least_roundness: float) -> NDArray[np.str_]:
    """(N,) why a blob is turned down; empty if it is not."""
    conditions = [
        blobs.roundness < least_roundness,
        blobs.area_px > np.pi * largest_radius_px**2,
        (blobs.area_px > OUTLINE_AREA_PX) & (blobs.circularity < 0.6),
    ]
    return np.select(conditions, ["elongated", "too large", "not round"], "")


def _is_hot_pixel(scene: Scene, member: tuple[Indices, Indices], peak: float) -> bool:
    """Lenses spread light: around a real spot's brightest pixel there is as much light again."""
    columns, rows = member
    brightest = int(np.argmax(scene.light(rows, columns)))
    near = np.arange(-1, 2)
    around = scene.light(rows[brightest] + near[:, None], columns[brightest] + near) - scene.floor
    return bool(around.sum() - peak < 0.4 * peak + 3.0 * scene.sigma)


def _split(scene: Scene, member: tuple[Indices, Indices], peak: float) -> Blobs | None:
    """The lights that a blob falls into at a higher level; None if it is one piece at all of them."""
    columns, rows = member
    left, top = int(columns.min()), int(rows.min())
    own = np.zeros((int(rows.max()) - top + 1, int(columns.max()) - left + 1), np.uint8)
    own[rows - top, columns - left] = scene.light(rows, columns)
    for level in _LEVELS:
        upper = (own > scene.floor + level * peak).astype(np.uint8)
        contours, _ = cv2.findContours(upper, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        if len(contours) < 2:
            continue
        pieces = []
        for contour in contours:
            piece = np.zeros_like(upper)
            cv2.drawContours(piece, [contour], -1, 1, cv2.FILLED)
            down, right = np.nonzero(piece & upper)
            pieces.append((right + left, down + top))
        parts = _measured(scene, pieces, [contour.reshape(-1, 2) for contour in contours])
        # a ripple of the noise on a flat top is not a light of its own
        parts = parts[(parts.peak > level * peak + 4.0 * scene.sigma + 3.0) | (parts.area_px > 4)]
        if len(parts) > 1:
            return parts
    return None


def _nothing() -> Blobs:
    return Blobs(*np.empty((6, 0)))
