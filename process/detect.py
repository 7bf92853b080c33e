"""A frame to its light spots: sub-pixel centres with covariances, and what was turned down and why."""

import threading
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from process.blobs import Blobs, Groups, Rejected, Scene, find_blobs, lit_groups, scene_of
from process.spot_fit import (
    AMPLITUDE,
    BACKGROUND,
    CURVE_UU,
    CURVE_VV,
    EDGE,
    PARAMETERS,
    Fit,
    Patches,
    U,
    V,
    fit_spots,
    spot_light,
    spot_size_px,
    start_shape,
)
from process.window import windowed_centres

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

_LEAST_HALF_WIDTH, _MOST_HALF_WIDTH = 4, 28  # of the round patches, pixels
_RIM_PX = 3.0  # a patch reaches this far beyond the blob
_memory = threading.local()
_HOT_SIZE_PX = 0.5  # no lens draws a smaller spot


@dataclass(frozen=True)
class DetectSettings:
    """How spots are found. Grey levels are of 255."""

    method: Literal["default", "fast", "paper"] = "default"
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
    """4π · area / perimeter² (eq. 3 with its square restored); ``default`` and ``fast``: 1 for up to 40 px"""
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
    soft-edged ellipse fitted to each (``spot_fit``). ``fast``: the same, but a centroid under a Gaussian window instead
    (``window``), 1.5 to 3 times less exact. ``paper``: fixed threshold, filled contours, C > 0.8 (eq. 3 as
    4π area/perimeter²), centroid of the contour; its gate is known to lose small spots.
    """
    return detect_all([image], settings or DetectSettings())[0]


def detect_all(images: Iterable[Pixels], settings: DetectSettings) -> list[Detections]:
    """``detect`` for several images, faster than one by one.

    Each is looked at when it is its turn, and not again: it need not be valid any longer than until the next.
    """
    if settings.method == "paper":
        return [_detect_paper(image, settings) for image in images]
    scenes, groups = [], []
    for number, image in enumerate(images):
        scene = scene_of(image, settings.contrast)
        lit = lit_groups(scene)
        scene.image = _kept(image, lit, number)
        scenes.append(scene)
        groups.append(lit)
    if not scenes:
        return []
    blobs, counts = find_blobs(scenes, groups, settings.largest_radius_px, settings.least_roundness)
    sight = _sight(scenes, blobs, counts, settings)
    return _judged(sight, _fitted(sight, settings), settings)


def _kept(image: Pixels, lit: Groups, number: int) -> Pixels:
    """The pixels around lit groups, at their places in an image whose other pixels are anything.

    It is of memory that stays with this thread, and valid until the next that is kept as this ``number``. Where nothing
    is lit there is nothing to keep: then it is ``image`` itself.
    """
    if not lit.counts.size:
        return image
    canvases: list[Pixels] = vars(_memory).setdefault("canvases", [])
    if number == len(canvases):
        canvases.append(np.empty_like(image))
    if canvases[number].shape != image.shape:
        canvases[number] = np.empty_like(image)
    canvas = canvases[number]
    margin = _half_widths(lit.counts) + 1  # a blob has no more pixels than its group
    low, high = (
        np.stack([extreme.reduceat(places, lit.begins) for places in (lit.rows, lit.columns)])
        for extreme in (np.minimum, np.maximum)
    )
    low, high = np.maximum(low - margin, 0), high + margin + 1
    if np.prod(high - low, axis=0).sum() > image.size:
        canvas[:] = image
        return canvas
    for top, left, bottom, right in zip(*low.tolist(), *high.tolist(), strict=True):
        canvas[top:bottom, left:right] = image[top:bottom, left:right]
    return canvas


@dataclass(eq=False)
class _Sight:
    """The candidates of several images, before anything is fitted to them."""

    scenes: Sequence[Scene]
    parts: Sequence[slice]
    """of the N candidates, for each image"""
    blobs: Blobs
    start: Array
    """(N, 8)"""
    half_widths: NDArray[np.intp]
    """(N,) of the patches, pixels"""
    patches: Patches
    """round ones about the candidates, without what is nearer to a rejected blob"""
    apart: Array
    """(K,) their usable pixels, without those nearer to another candidate, too"""

    def reject(self, scene: Scene, candidate: int, reason: str) -> None:
        """Note that a candidate is turned down."""
        scene.reject(self.blobs.u_px[candidate], self.blobs.v_px[candidate], reason)


def _sight(scenes: Sequence[Scene], blobs: Blobs, counts: NDArray[np.intp], settings: DetectSettings) -> _Sight:
    half_widths = _half_widths(blobs.area_px)
    parts = [slice(begin, end) for begin, end in pairwise([0, *np.cumsum(counts).tolist()])]
    start = np.zeros((len(blobs), PARAMETERS))
    start[:, U], start[:, V] = blobs.u_px, blobs.v_px
    start[:, AMPLITUDE] = np.maximum(blobs.peak, 1.0)
    rows, columns = np.rint(blobs.v_px).astype(np.intp), np.rint(blobs.u_px).astype(np.intp)
    for scene, part in zip(scenes, parts, strict=True):
        start[part, BACKGROUND] = scene.background(rows[part], columns[part])
    patches, apart = _patches(scenes, parts, start[:, :2], half_widths, settings)
    return _Sight(scenes, parts, blobs, start, half_widths, patches, apart)


def _half_widths(area_px: Array | NDArray[np.intp]) -> NDArray[np.intp]:
    """(N,) of the patches about spots of N areas, pixels."""
    wide = np.ceil(np.sqrt(area_px / np.pi) + _RIM_PX)
    return np.clip(wide, _LEAST_HALF_WIDTH, _MOST_HALF_WIDTH).astype(np.intp)


def _fitted(sight: _Sight, settings: DetectSettings) -> Fit:
    """What was fitted; the shapes of the start need the patches."""
    patches, start = replace(sight.patches, usable=sight.apart), sight.start
    if not len(start):
        return Fit(start, np.empty((0, 2, 2)), np.empty(0), np.empty(0, dtype=bool))
    curve, start[:, EDGE] = start_shape(patches, start, sight.blobs.area_px)
    start[:, CURVE_UU] = start[:, CURVE_VV] = curve
    if settings.method == "fast":
        centres = windowed_centres(patches, start)
        fit = Fit(start, centres.covariance_px2, np.ones(len(start)), centres.converged)
        fit.parameters[:, :2] = centres.centres_px
        return fit
    fit = fit_spots(patches, start)
    _fit_neighbours_again(sight, fit)
    return fit


def _fit_neighbours_again(sight: _Sight, fit: Fit) -> None:
    """Fit those once more, in place, that have a neighbour in reach, its light taken out."""
    reach = sight.half_widths + _RIM_PX
    members, rivals = [], []
    for part in sight.parts:
        near = _chebyshev(fit.parameters[part, :2]) <= reach[part, None]
        near &= fit.converged[part]
        for number in np.flatnonzero(near.any(axis=1) & fit.converged[part]).tolist():
            members.append(part.start + number)
            rivals.append(part.start + np.flatnonzero(near[number]))
    if not members:
        return
    own = np.array(members)
    patches = sight.patches[own]
    others = np.concatenate(
        [
            spot_light(
                fit.parameters[near], patches.u_px[begin : begin + count], patches.v_px[begin : begin + count]
            ).sum(axis=0)
            for near, begin, count in zip(rivals, patches.begins.tolist(), patches.counts.tolist(), strict=True)
        ]
    )
    again = fit_spots(patches, fit.parameters[own], others)
    fit.parameters[own], fit.covariance_px2[own] = again.parameters, again.covariance_px2
    fit.chi2_per_dof[own], fit.converged[own] = again.chi2_per_dof, again.converged


def _judged(sight: _Sight, fit: Fit, settings: DetectSettings) -> list[Detections]:
    """The spots of each image that are lights; why the others are not is noted."""
    good = _good_fits(sight, fit)
    size_px = spot_size_px(fit.parameters)
    found = []
    for scene, part in zip(sight.scenes, sight.parts, strict=True):
        keep = part.start + np.flatnonzero(good[part])
        double = np.tril(_chebyshev(fit.parameters[keep, :2]) <= 0.7).any(axis=1)  # two parts that became one
        keep = _without_reflections(sight, scene, fit, size_px, keep[~double], settings)
        blobs, parameters = sight.blobs[keep], fit.parameters[keep]
        saturated = blobs.peak + scene.floor >= settings.saturation
        found.append(
            Detections(
                parameters[:, U].copy(),
                parameters[:, V].copy(),
                fit.covariance_px2[keep],
                parameters[:, AMPLITUDE].copy(),
                blobs.area_px,
                blobs.circularity,
                tuple("saturated" if yes else "" for yes in saturated.tolist()),
                tuple(scene.rejected),
            )
        )
    return found


@cache
def _disc(half_width: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Columns and rows of a round patch about (0, 0)."""
    rows, columns = np.mgrid[-half_width : half_width + 1, -half_width : half_width + 1]
    inside = rows**2 + columns**2 <= (half_width + 0.5) ** 2
    return columns[inside], rows[inside]


def _patches(
    scenes: Sequence[Scene],
    parts: Sequence[slice],
    centres_px: Array,
    half_widths: NDArray[np.intp],
    settings: DetectSettings,
) -> tuple[Patches, Array]:
    """Round patches about centres (N, 2), usable but for what is nearer to a rejected blob; and (K,) to each other."""
    nothing = np.empty(0, dtype=np.intp)
    discs = [_disc(half_width) for half_width in half_widths.tolist()]
    counts = np.array([len(disc[0]) for disc in discs], dtype=np.intp)
    corner = np.repeat(np.rint(centres_px).astype(np.intp).T, counts, axis=1)
    columns, rows = (np.concatenate([nothing, *(disc[k] for disc in discs)]) + corner[k] for k in (0, 1))
    ends = [0, *np.cumsum(counts).tolist()]
    values, usable = np.empty(len(rows)), np.ones(len(rows))
    for scene, part in zip(scenes, parts, strict=True):
        pixels = slice(ends[part.start], ends[part.stop])
        inside = [
            np.clip(own[pixels], 0, size - 1) for own, size in zip((rows, columns), scene.image.shape, strict=True)
        ]
        values[pixels] = scene.image[inside[0], inside[1]]
        usable[pixels] = (inside[0] == rows[pixels]) & (inside[1] == columns[pixels])
    apart = usable.copy()
    patches = Patches(
        columns.astype(np.float64),
        rows.astype(np.float64),
        values,
        usable,
        counts,
        np.concatenate(
            [np.full(part.stop - part.start, scene.sigma) for scene, part in zip(scenes, parts, strict=True)]
        ),
        settings.shot_gain,
        float(settings.saturation),
    )
    for scene, part in zip(scenes, parts, strict=True):
        rejected = np.array([(r.u_px, r.v_px) for r in scene.rejected if np.isfinite(r.u_px)]).reshape(-1, 2)
        rivals = np.concatenate([rejected, centres_px[part]])
        gap = np.hypot(*(centres_px[part, None] - rivals).transpose(2, 0, 1))
        for number, rival in np.argwhere((gap > 0.0) & (gap < 3.0 * half_widths[part, None])).tolist():
            spot = part.start + number
            pixels = slice(ends[spot], ends[spot + 1])
            # nearer to the spot than to its rival: on the near side of the line half way between them
            towards, middle = rivals[rival] - centres_px[spot], (rivals[rival] + centres_px[spot]) / 2.0
            along = (patches.u_px[pixels] - middle[0]) * towards[0] + (patches.v_px[pixels] - middle[1]) * towards[1]
            apart[pixels] *= along <= 0.0
            if rival < len(rejected):
                usable[pixels] *= along <= 0.0
    return patches, apart


def _chebyshev(places: Array) -> Array:
    """(N, N) larger coordinate difference; infinite on the diagonal."""
    apart = np.abs(places[:, None, :] - places[None, :, :]).max(axis=2)
    np.fill_diagonal(apart, np.inf)
    return np.asarray(apart)


def _good_fits(sight: _Sight, fit: Fit) -> NDArray[np.bool_]:
    """(N,) candidates that were fitted well."""
    parameters, blobs = fit.parameters, sight.blobs
    moved = np.hypot(parameters[:, U] - blobs.u_px, parameters[:, V] - blobs.v_px)
    lost = ~(fit.converged & (moved <= 2.0))
    hot = ~lost & (spot_size_px(parameters) < _HOT_SIZE_PX)
    if (lost | hot).any():
        for scene, part in zip(sight.scenes, sight.parts, strict=True):
            for k in (part.start + np.flatnonzero((lost | hot)[part])).tolist():
                sight.reject(scene, k, "no fit" if lost[k] else "hot pixel")
    return np.asarray(~(lost | hot))


def _without_reflections(
    sight: _Sight, scene: Scene, fit: Fit, size_px: Array, keep: NDArray[np.intp], settings: DetectSettings
) -> NDArray[np.intp]:
    """Turn down spots that are much weaker than one close by: the shine of that light on the wing."""
    if keep.size < 2:
        return keep
    parameters, size = fit.parameters[keep], size_px[keep]
    flux = parameters[:, AMPLITUDE] * size**2
    apart = np.hypot(*(parameters[:, None, :2] - parameters[None, :, :2]).transpose(2, 0, 1))
    close = apart < settings.reflection_reach_px + settings.reflection_reach_radii * (size[:, None] + size[None, :])
    shine = (close & (flux[:, None] < settings.reflection_flux * flux[None, :])).any(axis=1)
    for k in keep[shine].tolist():
        sight.reject(scene, k, "reflection")
    return np.asarray(keep[~shine])


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
