"""A frame to its light spots: sub-pixel centres with covariances, and what was turned down and why."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from process.spot_fit import AMPLITUDE, BACKGROUND, BLUR, PARAMETERS, RADIUS, Fit, Patches, U, V, fit_spots, spot_light

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

MAX_BLOBS = 400
"""Beyond these the scene is not a dark one with lights: the largest are kept, the rest counted as rejected."""
_STRIDE = 16  # of the sample that the background is estimated from
_HALF_WIDTHS = (5, 9, 16, 28)  # patches are fitted together by size
_LEVELS = (0.5, 0.7, 0.85)  # of a blob's peak, where two lights that run into each other part
_SHAPE_FLAT_PX2 = 0.15  # added to both second moments: a few pixels do not have a shape


@dataclass(frozen=True)
class DetectSettings:
    """How spots are found. Grey levels are of 255."""

    method: Literal["default", "paper"] = "default"
    contrast: float = 25.0
    """least grey levels above the background"""
    saturation: int = 250
    """a pixel at or above this only says that it was at least so bright"""
    shot_gain: float = 0.03
    """grey levels an electron: what shot noise adds to the variance of a grey level, per grey level"""
    largest_radius_px: float = 24.0
    least_roundness: float = 0.55
    """minor over major axis; a light seen at a slant is not round"""
    reflection_flux: float = 0.35
    """a spot with less than this part of a neighbour's light is taken for its reflection …"""
    reflection_reach_px: float = 6.0
    """… if it is closer than this and, …"""
    reflection_reach_radii: float = 3.0
    """… on top, this times the two spots' radii: the shine of a light is its own stand-off below the surface"""
    paper_threshold: int = 60
    """of the paper's method, absolute"""
    paper_circularity: float = 0.8
    paper_sigma_px: float = 0.12
    """the paper gives its contour centroids no uncertainty: this is the middle of what was measured"""


@dataclass(frozen=True)
class Rejected:
    """A blob that is not taken for a light."""

    u_px: float
    v_px: float
    reason: str


@dataclass(frozen=True, eq=False)
class Detections:
    """N spots of one image."""

    u_px: Array
    v_px: Array
    covariance_px2: Array
    """(N, 2, 2) of (u, v), from the sensor's noise"""
    amplitude: Array
    """grey levels above the background, as fitted: beyond 255 where saturated"""
    area_px: Array
    """pixels above the threshold"""
    circularity: Array
    """4π · area / perimeter² (eq. 3 with its square restored)"""
    flags: tuple[str, ...]
    """empty when good, else comma-separated"""
    rejected: tuple[Rejected, ...] = ()

    @property
    def pixels(self) -> Array:
        """(N, 2) u and v."""
        return np.stack([self.u_px, self.v_px], axis=1)

    def __len__(self) -> int:
        return len(self.u_px)


def detect(image: Pixels, settings: DetectSettings | None = None) -> Detections:
    """Find the lights in ``image`` (H, W).

    ``default``: everything that stands out from the local background, gated by shape with counted pixels, then a
    blurred disc fitted to each (``spot_fit``). ``paper``: fixed threshold, filled contours, C > 0.8 (eq. 3 as
    4π area/perimeter²), centroid of the contour; its gate is known to lose small spots.
    """
    settings = settings or DetectSettings()
    if settings.method == "paper":
        return _detect_paper(image, settings)
    return _detect_default(image, settings)


@dataclass
class _Blob:
    """A connected group of pixels above the threshold."""

    u: float
    v: float
    area: int
    peak: float  # grey levels above the background
    roundness: float
    circularity: float


@dataclass
class _Scene:
    """The image above its background."""

    image: Pixels
    light: Pixels
    """grey levels above the threshold's base"""
    floor: float
    """grey levels that ``light`` still has of background"""
    sigma: float
    """noise of the background"""
    threshold: float
    rejected: list[Rejected] = field(default_factory=list)

    def reject(self, u: float, v: float, reason: str) -> None:
        self.rejected.append(Rejected(float(u), float(v), reason))


def _detect_default(image: Pixels, settings: DetectSettings) -> Detections:
    scene = _scene(image, settings)
    blobs = [spot for blob in _blobs(scene) for spot in _gated(scene, *blob, settings)]
    if not blobs:
        return _detections([], np.empty((0, PARAMETERS)), np.empty((0, 2, 2)), [], scene.rejected)
    fit = _fit_all(scene, blobs, settings)
    keep = _without_bad_fits(scene, blobs, fit)
    keep = _without_reflections(scene, blobs, fit, keep, settings)
    saturated = [blob.peak + scene.floor >= settings.saturation for blob in blobs]
    flags = ["saturated" if saturated[k] else "" for k in keep]
    return _detections([blobs[k] for k in keep], fit.parameters[keep], fit.covariance_px2[keep], flags, scene.rejected)


def _scene(image: Pixels, settings: DetectSettings) -> _Scene:
    """Background and noise from every 16th pixel of every 16th row; a background that varies is subtracted."""
    sample = np.ascontiguousarray(image[_STRIDE // 2 :: _STRIDE, _STRIDE // 2 :: _STRIDE])
    smooth = cv2.medianBlur(sample, 5) if min(sample.shape) >= 5 else np.full_like(sample, int(np.median(sample)))
    # neighbours differ by noise alone wherever the scene is smooth; the clip keeps edges and lights out of it
    steps = np.abs(image[::_STRIDE, :-1:_STRIDE].astype(np.int16) - image[::_STRIDE, 1::_STRIDE])
    bound = max(4.0, 6.0 * float(np.median(steps)))
    sigma = max(0.6, float(np.minimum(steps, bound).mean()) * np.sqrt(np.pi) / 2.0)
    threshold = max(settings.contrast, 6.0 * sigma)
    low, high = np.percentile(smooth, (2.0, 98.0))
    if high - low <= threshold / 3.0:
        floor = float(np.median(sample))
        return _Scene(image, image, floor, sigma, floor + threshold)
    background = cv2.resize(smooth, (image.shape[1], image.shape[0]), interpolation=cv2.INTER_LINEAR)
    return _Scene(image, cv2.subtract(image, background), 0.0, sigma, threshold)


def _blobs(scene: _Scene) -> list[tuple[NDArray[np.int32], tuple[int, int, int, int]]]:
    """Contours of the connected groups above the threshold, with (x, y, width, height); the largest ones if many."""
    _, mask = cv2.threshold(scene.light, int(scene.threshold), 255, cv2.THRESH_BINARY)
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    found = [(contour.reshape(-1, 2), cv2.boundingRect(contour)) for contour in contours]
    if len(found) > MAX_BLOBS:
        found.sort(key=lambda blob: -len(blob[0]))
        scene.reject(np.nan, np.nan, f"crowded: {len(found) - MAX_BLOBS} blobs beyond the {MAX_BLOBS} largest")
        found = found[:MAX_BLOBS]
    return found


def _gated(
    scene: _Scene, contour: NDArray[np.int32], box: tuple[int, int, int, int], settings: DetectSettings
) -> list[_Blob]:
    """The light, or the lights, that a blob is; none with a reason in ``scene`` if it is not one."""
    x, y, width, height = box
    centre = (x + (width - 1) / 2, y + (height - 1) / 2)
    rows, columns = scene.image.shape
    if x == 0 or y == 0 or x + width == columns or y + height == rows:
        scene.reject(*centre, "border")
        return []
    if max(width, height) > 4 * settings.largest_radius_px:
        scene.reject(*centre, "too large")
        return []
    # ROI with a rim of one pixel: never outside, since blobs at the border are gone
    light = scene.light[y - 1 : y + height + 1, x - 1 : x + width + 1]
    mask = np.zeros(light.shape, np.uint8)
    cv2.drawContours(mask, [contour - (x - 1, y - 1)], -1, 1, cv2.FILLED)
    mask[light <= int(scene.threshold)] = 0  # holes
    blob = _measure(scene, light, mask, contour, (x - 1, y - 1))
    if blob.area <= 3 and _is_hot_pixel(scene, light, blob):
        scene.reject(blob.u, blob.v, "hot pixel")
        return []
    if blob.roundness < 0.85 and blob.area >= 6:
        parts = _split(scene, light, mask, blob, (x - 1, y - 1))
        if parts:
            return [part for part in parts if _passes(scene, part, settings)]
    return [blob] if _passes(scene, blob, settings) else []


def _passes(scene: _Scene, blob: _Blob, settings: DetectSettings) -> bool:
    if blob.roundness < settings.least_roundness:
        reason = "elongated"
    elif blob.area > np.pi * settings.largest_radius_px**2:
        reason = "too large"
    elif blob.area > 40 and blob.circularity < 0.6:  # smaller ones have no outline to speak of
        reason = "not round"
    else:
        return True
    scene.reject(blob.u, blob.v, reason)
    return False


def _measure(scene: _Scene, light: Pixels, mask: Pixels, contour: NDArray[np.int32], origin: tuple[int, int]) -> _Blob:
    """Moments of the light above the threshold, over the counted pixels of ``mask``."""
    excess = cv2.subtract(light, int(scene.threshold) - 1) * mask
    m = cv2.moments(excess)
    u, v = m["m10"] / m["m00"], m["m01"] / m["m00"]
    a, b, c = m["mu20"] / m["m00"], m["mu11"] / m["m00"], m["mu02"] / m["m00"]
    middle, half = (a + c) / 2, np.hypot((a - c) / 2, b)
    roundness = float(np.sqrt((middle - half + _SHAPE_FLAT_PX2) / (middle + half + _SHAPE_FLAT_PX2)))
    area = int(cv2.countNonZero(mask))
    perimeter = cv2.arcLength(contour.astype(np.int32), True)
    circularity = 4.0 * np.pi * area / perimeter**2 if perimeter > 0 else 1.0
    peak = float((light * mask).max()) - scene.floor
    return _Blob(u + origin[0], v + origin[1], area, peak, roundness, circularity)


def _is_hot_pixel(scene: _Scene, light: Pixels, blob: _Blob) -> bool:
    """Lenses spread light: around a real spot's brightest pixel there is as much light again."""
    centre = np.unravel_index(int(light.argmax()), light.shape)
    row, column = (int(np.clip(k, 1, n - 2)) for k, n in zip(centre, light.shape, strict=True))
    around = light[row - 1 : row + 2, column - 1 : column + 2].astype(np.float64) - scene.floor
    return bool(around.sum() - blob.peak < 0.4 * blob.peak + 3.0 * scene.sigma)


def _split(scene: _Scene, light: Pixels, mask: Pixels, blob: _Blob, origin: tuple[int, int]) -> list[_Blob]:
    """The lights that a blob falls into at a higher level; none if it is one piece at all of them."""
    for level in _LEVELS:
        upper = ((light > scene.floor + level * blob.peak) * mask).astype(np.uint8)
        contours, _ = cv2.findContours(upper, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        if len(contours) < 2:
            continue
        parts = []
        for contour in contours:
            piece = np.zeros_like(upper)
            cv2.drawContours(piece, [contour], -1, 1, cv2.FILLED)
            part = _measure(scene, light, piece * upper, contour.reshape(-1, 2), origin)
            # a ripple of the noise on a flat top is not a light of its own
            if part.peak > level * blob.peak + 4.0 * scene.sigma + 3.0 or part.area > 4:
                parts.append(part)
        if len(parts) > 1:
            return parts
    return []


def _fit_all(scene: _Scene, blobs: list[_Blob], settings: DetectSettings) -> Fit:
    """Fit the blobs by classes of size; then once more those with a neighbour in reach, its light taken out."""
    start = _start(scene, blobs)
    reach = np.sqrt([blob.area / np.pi for blob in blobs]) + 3.0
    half_widths = np.array([next((h for h in _HALF_WIDTHS if h >= r), _HALF_WIDTHS[-1]) for r in reach])
    turned_down = np.array([(r.u_px, r.v_px) for r in scene.rejected if np.isfinite(r.u_px)]).reshape(-1, 2)
    fit = Fit(
        start.copy(), np.full((len(blobs), 2, 2), np.nan), np.full(len(blobs), np.nan), np.zeros(len(blobs), bool)
    )
    for half_width in np.unique(half_widths):
        members = np.flatnonzero(half_widths == half_width)
        patches = _patches(scene, start, members, int(half_width), turned_down, settings)
        _store(fit, members, fit_spots(patches, start[members]))
    for half_width in np.unique(half_widths):
        near = _chebyshev(fit.parameters[:, :2]) <= half_width + 3.0
        members = np.flatnonzero((half_widths == half_width) & near.any(axis=1) & fit.converged)
        if members.size:
            patches = _patches(scene, start, members, int(half_width), turned_down, settings, apart=False)
            others = _light_of_others(patches, fit.parameters, members, near & fit.converged[None, :])
            _store(fit, members, fit_spots(patches, fit.parameters[members], others))
    return fit


def _start(scene: _Scene, blobs: list[_Blob]) -> Array:
    """(N, 8): a blur of 0.8 px, and the disc that then has the blob's area where it crosses the threshold."""
    start = np.zeros((len(blobs), PARAMETERS))
    contrast = scene.threshold - scene.floor
    for k, blob in enumerate(blobs):
        edge = np.sqrt(blob.area / np.pi)
        start[k, [U, V]] = blob.u, blob.v
        start[k, AMPLITUDE] = max(blob.peak, 1.0)
        start[k, BACKGROUND] = scene.floor if scene.light is scene.image else np.nan
        start[k, RADIUS] = max(0.3, edge + 0.8 * ndtri(min(contrast / max(blob.peak, contrast + 1.0), 0.9)))
        start[k, BLUR] = 0.8
    unknown = np.isnan(start[:, BACKGROUND])
    columns, rows = (np.rint(start[unknown, k]).astype(int) for k in (U, V))
    start[unknown, BACKGROUND] = scene.image[rows, columns].astype(np.float64) - scene.light[rows, columns]
    return start


def _patches(
    scene: _Scene,
    start: Array,
    members: NDArray[np.intp],
    half_width: int,
    turned_down: Array,
    settings: DetectSettings,
    *,
    apart: bool = True,
) -> Patches:
    """Round patches about ``start[members]``, without what is nearer to a rejected blob or, ``apart``, another spot."""
    offsets = np.arange(-half_width, half_width + 1)
    columns = np.rint(start[members, U]).astype(int)[:, None, None] + offsets[None, None, :]
    rows = np.rint(start[members, V]).astype(int)[:, None, None] + offsets[None, :, None]
    height, width = scene.image.shape
    usable = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    values = scene.image[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)].astype(np.float64)
    u, v = (np.broadcast_to(a, usable.shape).astype(np.float64) for a in (columns, rows))
    own = (u - start[members, U, None, None]) ** 2 + (v - start[members, V, None, None]) ** 2
    usable &= own <= (half_width + 0.5) ** 2
    rivals = [*turned_down, *(start[:, :2] if apart else ())]
    for number, place in enumerate(members):
        for rival in rivals:
            gap = np.hypot(*(rival - start[place, :2]))
            if 0.0 < gap < 3.0 * half_width:
                usable[number] &= own[number] <= (u[number] - rival[0]) ** 2 + (v[number] - rival[1]) ** 2
    flat = (len(members), -1)
    return Patches(
        u.reshape(flat),
        v.reshape(flat),
        values.reshape(flat),
        usable.reshape(flat),
        scene.sigma,
        settings.shot_gain,
        float(settings.saturation),
    )


def _light_of_others(patches: Patches, parameters: Array, members: NDArray[np.intp], near: NDArray[np.bool_]) -> Array:
    light = np.zeros_like(patches.values)
    for number, place in enumerate(members):
        others = parameters[near[place]]
        light[number] = spot_light(others, patches.u_px[number], patches.v_px[number]).sum(axis=0)
    return light


def _store(fit: Fit, members: NDArray[np.intp], part: Fit) -> None:
    fit.parameters[members] = part.parameters
    fit.covariance_px2[members] = part.covariance_px2
    fit.chi2_per_dof[members] = part.chi2_per_dof
    fit.converged[members] = part.converged


def _chebyshev(places: Array) -> Array:
    """(N, N) larger coordinate difference; infinite on the diagonal."""
    apart = np.abs(places[:, None, :] - places[None, :, :]).max(axis=2)
    np.fill_diagonal(apart, np.inf)
    return np.asarray(apart)


def _without_bad_fits(scene: _Scene, blobs: list[_Blob], fit: Fit) -> NDArray[np.intp]:
    keep: list[int] = []
    for k, blob in enumerate(blobs):
        if not fit.converged[k] or np.hypot(fit.parameters[k, U] - blob.u, fit.parameters[k, V] - blob.v) > 2.0:
            scene.reject(blob.u, blob.v, "no fit")
        elif fit.parameters[k, BLUR] < 0.3 and fit.parameters[k, RADIUS] < 0.3:
            scene.reject(blob.u, blob.v, "hot pixel")
        elif not keep or np.abs(fit.parameters[np.array(keep), :2] - fit.parameters[k, :2]).max(axis=1).min() > 0.7:
            keep.append(k)
    return np.array(keep, dtype=np.intp)


def _without_reflections(
    scene: _Scene, blobs: list[_Blob], fit: Fit, keep: NDArray[np.intp], settings: DetectSettings
) -> NDArray[np.intp]:
    """Turn down spots that are much weaker than one close by: the shine of that light on the wing."""
    if keep.size < 2:
        return keep
    parameters = fit.parameters[keep]
    size = np.hypot(parameters[:, RADIUS], 1.5 * parameters[:, BLUR])
    flux = parameters[:, AMPLITUDE] * size**2
    apart = np.hypot(*(parameters[:, None, :2] - parameters[None, :, :2]).transpose(2, 0, 1))
    close = apart < settings.reflection_reach_px + settings.reflection_reach_radii * (size[:, None] + size[None, :])
    shine = (close & (flux[:, None] < settings.reflection_flux * flux[None, :])).any(axis=1)
    for k in keep[shine]:
        scene.reject(blobs[k].u, blobs[k].v, "reflection")
    return np.asarray(keep[~shine])


def _detections(
    blobs: list[_Blob], parameters: Array, covariance_px2: Array, flags: list[str], rejected: Sequence[Rejected]
) -> Detections:
    return Detections(
        parameters[:, U].copy(),
        parameters[:, V].copy(),
        covariance_px2,
        parameters[:, AMPLITUDE].copy(),
        np.array([blob.area for blob in blobs], dtype=np.float64),
        np.array([blob.circularity for blob in blobs], dtype=np.float64),
        tuple(flags),
        tuple(rejected),
    )


def _detect_paper(image: Pixels, settings: DetectSettings) -> Detections:
    _, mask = cv2.threshold(image, settings.paper_threshold, 255, cv2.THRESH_BINARY)
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    centres, areas, circularities, peaks, flags = [], [], [], [], []
    rejected = []
    for contour in contours:
        m = cv2.moments(contour)
        perimeter = cv2.arcLength(contour, True)
        circularity = 4.0 * np.pi * m["m00"] / perimeter**2 if perimeter > 0 else 0.0
        x, y, width, height = cv2.boundingRect(contour)
        if circularity > settings.paper_circularity:
            centres.append((m["m10"] / m["m00"], m["m01"] / m["m00"]))
            areas.append(m["m00"])
            circularities.append(circularity)
            peaks.append(float(image[y : y + height, x : x + width].max()))
            flags.append("saturated" if peaks[-1] >= settings.saturation else "")
        else:
            rejected.append(Rejected(x + (width - 1) / 2, y + (height - 1) / 2, "not round"))
    places = np.array(centres, dtype=np.float64).reshape(-1, 2)
    covariance_px2 = np.broadcast_to(np.eye(2) * settings.paper_sigma_px**2, (len(places), 2, 2)).copy()
    return Detections(
        places[:, 0],
        places[:, 1],
        covariance_px2,
        np.array(peaks, dtype=np.float64),
        np.array(areas, dtype=np.float64),
        np.array(circularities, dtype=np.float64),
        tuple(flags),
        tuple(rejected),
    )
