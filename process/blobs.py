"""Frames to their blobs: connected groups of pixels above the background, measured, gated, parted where two meet."""

from collections.abc import Sequence
from dataclasses import dataclass, field

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
    """once the lit groups are known, only what is around them need still be there"""
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
class Groups:
    """N connected groups of lit pixels, K in all, group by group."""

    rows: Indices
    """(K,)"""
    columns: Indices
    """(K,)"""
    grey: NDArray[np.intp]
    """(K,) grey levels of light"""
    counts: Indices
    """(N,) pixels of each"""
    perimeter_px: Array
    """(N,) of the outline; NaN for those that have none to speak of"""

    @property
    def begins(self) -> Indices:
        """(N,) each group's first pixel."""
        return np.cumsum(self.counts) - self.counts

    @classmethod
    def join(cls, parts: Sequence["Groups"]) -> "Groups":
        """All of ``parts``, at least one, in their order."""
        names = ("rows", "columns", "grey", "counts", "perimeter_px")
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


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


def lit_groups(scene: Scene) -> Groups:
    """The connected groups of pixels that reach the threshold, by their rows; the largest ones if there are many."""
    rows, columns = _lit(scene)
    place_v, v = _without_gaps(rows, scene.image.shape[0])
    place_u, u = _without_gaps(columns, scene.image.shape[1])
    mask = np.zeros((max(1, place_v), max(1, place_u)), np.uint8)
    mask[v, u] = 1
    _, labels = cv2.connectedComponents(mask, connectivity=8, ltype=cv2.CV_32S)
    label = labels[v, u] - 1
    counts = np.bincount(label)
    if len(counts) > MAX_BLOBS:
        beyond = len(counts) - MAX_BLOBS
        scene.reject(np.nan, np.nan, f"crowded: {beyond} blobs beyond the {MAX_BLOBS} largest")
        largest = np.sort(np.argsort(-counts, kind="stable")[:MAX_BLOBS])
        renumbered = np.full(len(counts), MAX_BLOBS)
        renumbered[largest] = np.arange(MAX_BLOBS)
        label, counts = renumbered[label], counts[largest]
    order = np.argsort(label, kind="stable")[: counts.sum()]
    rows, columns = rows[order], columns[order]
    groups = Groups(rows, columns, scene.light(rows, columns), counts, np.full(len(counts), np.nan))
    if (counts > OUTLINE_AREA_PX).any():
        number_of = np.full(labels.shape, -1)
        number_of[v[order], u[order]] = label[order]
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        for contour in contours:
            number = number_of[contour[0, 0, 1], contour[0, 0, 0]]
            if number >= 0 and counts[number] > OUTLINE_AREA_PX:
                groups.perimeter_px[number] = cv2.arcLength(contour, True)
    return groups


def find_blobs(
    scenes: Sequence[Scene], found: Sequence[Groups], largest_radius_px: float, least_roundness: float
) -> tuple[Blobs, Indices]:
    """The blobs that may be lights, and how many in each scene; the others are noted in theirs with a reason.

    ``found`` are the groups of each scene. All are measured together, which is faster than one by one.
    """
    groups = Groups.join(found)
    of_scene = np.repeat(np.arange(len(scenes)), [len(own.counts) for own in found])
    if not len(of_scene):
        return _nothing(), np.zeros(len(scenes), dtype=np.intp)
    blobs = _measured(
        groups,
        np.array([int(scene.threshold) - 1 for scene in scenes])[of_scene],
        np.array([scene.floor for scene in scenes])[of_scene],
    )
    out = _border_or_too_large(scenes, of_scene, groups, largest_radius_px)
    passed = _passes(blobs, largest_radius_px, least_roundness)
    oblong = (blobs.roundness < 0.85) & (blobs.area_px >= 6)
    keep = ~out
    parted, parted_of = [], []
    for number in np.flatnonzero(keep & ((blobs.area_px <= 3) | oblong | (passed != ""))).tolist():
        scene, own = (
            scenes[of_scene[number]],
            slice(groups.begins[number], groups.begins[number] + groups.counts[number]),
        )
        one = groups.rows[own], groups.columns[own], groups.grey[own]
        u, v, peak = blobs.u_px[number], blobs.v_px[number], blobs.peak[number]
        keep[number] = False
        if blobs.area_px[number] <= 3 and _is_hot_pixel(scene, *one, peak):
            scene.reject(u, v, "hot pixel")
        elif oblong[number] and (parts := _split(scene, *one, peak)) is not None:
            reasons = _passes(parts, largest_radius_px, least_roundness)
            for part in np.flatnonzero(reasons != "").tolist():
                scene.reject(parts.u_px[part], parts.v_px[part], str(reasons[part]))
            parted.append(parts[reasons == ""])
            parted_of += [of_scene[number]] * len(parted[-1])
        elif passed[number] != "":
            scene.reject(u, v, str(passed[number]))
        else:
            keep[number] = True
    of_scene = np.array([*of_scene[keep], *parted_of], dtype=np.intp)
    order = np.argsort(of_scene, kind="stable")
    return Blobs.join([blobs[keep], *parted])[order], np.bincount(of_scene, minlength=len(scenes))


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
    tiles, columns = brightest.shape
    least = least[np.minimum(np.arange(tiles), len(least) - 1)]  # a last tile that is cut has no sample of its own
    least = np.pad(least, ((0, 0), (0, max(0, -(-columns // _TILE) - least.shape[1]))), "edge")
    least = cv2.resize(least, (least.shape[1] * _TILE, tiles), interpolation=cv2.INTER_NEAREST)[:, :columns]
    bright = (cv2.subtract(brightest, least) > int(scene.threshold)).view(np.uint64) != 0
    row, column = np.divmod(np.flatnonzero(bright), bright.shape[1])
    rows, columns = row[:, None] * _TILE + np.arange(_TILE), column[:, None] * half + np.arange(half)
    grey = scene.image[np.minimum(rows, height - 1)[:, :, None], np.minimum(columns, width - 1)[:, None, :]]
    lowest = least[row, column * half].astype(np.intp) + int(scene.threshold)
    there = grey > lowest[:, None, None]
    there &= (rows < height)[:, :, None] & (columns < width)[:, None, :]
    tile, down, across = np.nonzero(there)
    rows, columns = rows[tile, down], columns[tile, across]
    lit = scene.light(rows, columns) > int(scene.threshold)
    return rows[lit], columns[lit]


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


def _without_gaps(places: Indices, size: int) -> tuple[int, Indices]:
    """How many rows (or columns) have lit pixels, or are beside such, and which of these each of ``places`` is.

    Groups that are apart in the frame stay apart.
    """
    near = np.zeros(size + 2, dtype=bool)
    for beside in range(3):
        near[places + beside] = True
    numbers = np.cumsum(near[1:-1])
    return int(numbers[-1]), numbers[places] - 1


def _border_or_too_large(
    scenes: Sequence[Scene], of_scene: Indices, groups: Groups, largest_radius_px: float
) -> NDArray[np.bool_]:
    """(N,) whether a group is turned down by its extent."""
    top, left = (np.minimum.reduceat(places, groups.begins) for places in (groups.rows, groups.columns))
    bottom, right = (np.maximum.reduceat(places, groups.begins) for places in (groups.rows, groups.columns))
    rows, columns = np.array([scene.image.shape for scene in scenes])[of_scene].T
    border = (left == 0) | (top == 0) | (right + 1 == columns) | (bottom + 1 == rows)
    large = np.maximum(right - left, bottom - top) + 1 > 4 * largest_radius_px
    for number in np.flatnonzero(border | large).tolist():
        reason = "border" if border[number] else "too large"
        scenes[of_scene[number]].reject((left + right)[number] / 2, (top + bottom)[number] / 2, reason)
    return np.asarray(border | large)


def _measured(groups: Groups, base: NDArray[np.intp], floor: Array) -> Blobs:
    """Moments of the light above ``base`` over the pixels of each group; ``floor`` (N,) is its background."""
    counts, starts = groups.counts, groups.begins
    light = (groups.grey - np.repeat(base, counts)).astype(np.float64)
    # about the first pixel: moments about the frame's corner would lose digits
    first_u, first_v = groups.columns[starts], groups.rows[starts]
    du, dv = groups.columns - np.repeat(first_u, counts), groups.rows - np.repeat(first_v, counts)
    lu, lv = light * du, light * dv
    m00, m10, m01, m20, m11, m02 = np.add.reduceat(np.stack([light, lu, lv, lu * du, lu * dv, lv * dv]), starts, axis=1)
    mean_u, mean_v = m10 / m00, m01 / m00
    a, b, c = m20 / m00 - mean_u**2, m11 / m00 - mean_u * mean_v, m02 / m00 - mean_v**2
    middle, half = (a + c) / 2, np.hypot((a - c) / 2, b)
    roundness = np.sqrt((np.maximum(middle - half, 0.0) + _SHAPE_FLAT_PX2) / (middle + half + _SHAPE_FLAT_PX2))
    outlined = groups.perimeter_px > 0.0
    perimeter_px = np.where(outlined, groups.perimeter_px, 1.0)
    circularity = np.where(outlined, 4.0 * np.pi * counts / perimeter_px**2, 1.0)
    peak = np.maximum.reduceat(groups.grey, starts) - floor
    return Blobs(mean_u + first_u, mean_v + first_v, counts.astype(np.float64), peak, roundness, circularity)


def _passes(blobs: Blobs, largest_radius_px: float, least_roundness: float) -> NDArray[np.str_]:
    """(N,) why a blob is turned down; empty if it is not."""
    conditions = [
        blobs.roundness < least_roundness,
        blobs.area_px > np.pi * largest_radius_px**2,
        (blobs.area_px > OUTLINE_AREA_PX) & (blobs.circularity < 0.6),
    ]
    return np.select(conditions, ["elongated", "too large", "not round"], "")


def _is_hot_pixel(scene: Scene, rows: Indices, columns: Indices, grey: NDArray[np.intp], peak: float) -> bool:
    """Lenses spread light: around a real spot's brightest pixel there is as much light again."""
    brightest = int(np.argmax(grey))
    near = np.arange(-1, 2)
    around = scene.light(rows[brightest] + near[:, None], columns[brightest] + near) - scene.floor
    return bool(around.sum() - peak < 0.4 * peak + 3.0 * scene.sigma)


def _split(scene: Scene, rows: Indices, columns: Indices, grey: NDArray[np.intp], peak: float) -> Blobs | None:
    """The lights that a blob falls into at a higher level; None if it is one piece at all of them."""
    left, top = int(columns.min()), int(rows.min())
    own = np.zeros((int(rows.max()) - top + 1, int(columns.max()) - left + 1), np.uint8)
    own[rows - top, columns - left] = grey
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
            outline_px = cv2.arcLength(contour, True) if len(down) > OUTLINE_AREA_PX else np.nan
            size, outline = np.array([len(down)]), np.array([outline_px])
            pieces.append(Groups(down + top, right + left, own[down, right].astype(np.intp), size, outline))
        base, floor = np.full(len(pieces), int(scene.threshold) - 1), np.full(len(pieces), scene.floor)
        parts = _measured(Groups.join(pieces), base, floor)
        # a ripple of the noise on a flat top is not a light of its own
        parts = parts[(parts.peak > level * peak + 4.0 * scene.sigma + 3.0) | (parts.area_px > 4)]
        if len(parts) > 1:
            return parts
    return None


def _nothing() -> Blobs:
    return Blobs(*np.empty((6, 0)))
