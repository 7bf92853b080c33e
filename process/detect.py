"""A frame to its light spots: sub-pixel centres with covariances, and what was turned down and why."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from process.blobs import Blobs, Rejected, Scene, find_blobs, scene_of
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
_FITTED_TOGETHER = 10  # images: more share what a call costs, fewer stay in a core's own cache
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


def detect_all(images: Sequence[Pixels], settings: DetectSettings) -> list[Detections]:
    """``detect`` for several images, faster than one by one."""
    return detections([sight(image, settings) for image in images], settings)


@dataclass(eq=False)
class Sight:
    """One image's candidates, before anything is fitted to them, and all that is needed of the image for that."""

    blobs: Blobs
    start: Array
    """(N, 8)"""
    patches: Patches
    """round ones about the candidates, without what is nearer to a rejected blob"""
    apart: Array
    """(K,) their usable pixels, without those nearer to another candidate, too"""
    half_widths: NDArray[np.intp]
    """(N,) of the patches, pixels"""
    floor: float
    """grey levels of background that the blobs' peaks are counted from"""
    rejected: list[Rejected]

    def __len__(self) -> int:
        return len(self.blobs)

    def reject(self, candidate: int, reason: str) -> None:
        """Note that a candidate is turned down."""
        blobs = self.blobs
        self.rejected.append(Rejected(float(blobs.u_px[candidate]), float(blobs.v_px[candidate]), reason))


def sight(image: Pixels, settings: DetectSettings) -> Sight | Detections:
    """What ``detections`` needs of an image, which is not looked at again; without candidates, or by ``paper``, all."""
    if settings.method == "paper":
        return _detect_paper(image, settings)
    scene = scene_of(image, settings.contrast)
    blobs = find_blobs(scene, settings.largest_radius_px, settings.least_roundness)
    if not len(blobs):
        return _nothing(scene.rejected)
    half_widths = np.clip(
        np.ceil(np.sqrt(blobs.area_px / np.pi) + _RIM_PX), _LEAST_HALF_WIDTH, _MOST_HALF_WIDTH
    ).astype(np.intp)
    start = _start(scene, blobs)
    patches, apart = _patches(scene, start[:, :2], half_widths, settings)
    return Sight(blobs, start, patches, apart, half_widths, scene.floor, scene.rejected)


def detections(sights: Sequence[Sight | Detections], settings: DetectSettings) -> list[Detections]:
    """The lights of each image; candidates of several images are fitted together."""
    found = []
    for begin in range(0, len(sights), _FITTED_TOGETHER):
        some = sights[begin : begin + _FITTED_TOGETHER]
        candidates = [one for one in some if isinstance(one, Sight)]
        fits = iter(_fit_sights(candidates, settings) if candidates else ())
        found += [_judged(one, next(fits), settings) if isinstance(one, Sight) else one for one in some]
    return found


def _fit_sights(sights: Sequence[Sight], settings: DetectSettings) -> list[Fit]:
    """What was fitted in each image."""
    patches = Patches.join([one.patches for one in sights])
    patches = replace(patches, usable=np.concatenate([one.apart for one in sights]))
    start = np.concatenate([one.start for one in sights])
    curve, start[:, EDGE] = start_shape(patches, start, np.concatenate([one.blobs.area_px for one in sights]))
    start[:, CURVE_UU] = start[:, CURVE_VV] = curve
    ends = np.cumsum([len(one) for one in sights]).tolist()
    parts = [slice(begin, end) for begin, end in pairwise([0, *ends])]
    if settings.method == "fast":
        centres = windowed_centres(patches, start)
        fit = Fit(start, centres.covariance_px2, np.ones(len(start)), centres.converged)
        fit.parameters[:, :2] = centres.centres_px
    else:
        fit = fit_spots(patches, start)
        _fit_neighbours_again(sights, [fit[part] for part in parts])
    return [fit[part] for part in parts]


def _fit_neighbours_again(sights: Sequence[Sight], fits: Sequence[Fit]) -> None:
    """Fit those once more, in place, that have a neighbour in reach, its light taken out."""
    members, patches, others, start = [], [], [], []
    for one, fit in zip(sights, fits, strict=True):
        near = _chebyshev(fit.parameters[:, :2]) <= one.half_widths[:, None] + _RIM_PX
        near &= fit.converged[None, :]
        own = np.flatnonzero(near.any(axis=1) & fit.converged)
        members.append(own)
        if own.size:
            around = one.patches[own]
            patches.append(around)
            others.append(_light_of_others(around, fit.parameters, own, near))
            start.append(fit.parameters[own])
    if not patches:
        return
    again = fit_spots(Patches.join(patches), np.concatenate(start), np.concatenate(others))
    begin = 0
    for fit, own in zip(fits, members, strict=True):
        part = again[begin : begin + own.size]
        begin += own.size
        fit.parameters[own], fit.covariance_px2[own] = part.parameters, part.covariance_px2
        fit.chi2_per_dof[own], fit.converged[own] = part.chi2_per_dof, part.converged


def _judged(sight: Sight, fit: Fit, settings: DetectSettings) -> Detections:
    """The spots that are lights; why the others are not is noted."""
    keep = _without_bad_fits(sight, fit)
    keep = _without_reflections(sight, fit, keep, settings)
    blobs = sight.blobs[keep]
    saturated = blobs.peak + sight.floor >= settings.saturation
    parameters = fit.parameters[keep]
    return Detections(
        parameters[:, U].copy(),
        parameters[:, V].copy(),
        fit.covariance_px2[keep],
        parameters[:, AMPLITUDE].copy(),
        blobs.area_px,
        blobs.circularity,
        tuple("saturated" if yes else "" for yes in saturated.tolist()),
        tuple(sight.rejected),
    )


def _nothing(rejected: Sequence[Rejected]) -> Detections:
    empty = np.empty(0)
    return Detections(empty, empty, np.empty((0, 2, 2)), empty, empty, empty, (), tuple(rejected))


def _start(scene: Scene, blobs: Blobs) -> Array:
    """(N, 8) places, amplitudes and backgrounds; the shapes need the patches."""
    start = np.zeros((len(blobs), PARAMETERS))
    start[:, U], start[:, V] = blobs.u_px, blobs.v_px
    start[:, AMPLITUDE] = np.maximum(blobs.peak, 1.0)
    rows, columns = np.rint(blobs.v_px).astype(np.intp), np.rint(blobs.u_px).astype(np.intp)
    start[:, BACKGROUND] = scene.background(rows, columns)
    return start


@cache
def _disc(half_width: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Columns and rows of a round patch about (0, 0)."""
    rows, columns = np.mgrid[-half_width : half_width + 1, -half_width : half_width + 1]
    inside = rows**2 + columns**2 <= (half_width + 0.5) ** 2
    return columns[inside], rows[inside]


def _patches(
    scene: Scene, centres_px: Array, half_widths: NDArray[np.intp], settings: DetectSettings
) -> tuple[Patches, Array]:
    """Round patches about centres (N, 2), usable but for what is nearer to a rejected blob; and (K,) to each other."""
    discs = [_disc(half_width) for half_width in half_widths.tolist()]
    counts = np.array([len(disc[0]) for disc in discs], dtype=np.intp)
    corner = np.repeat(np.rint(centres_px).astype(np.intp).T, counts, axis=1)
    columns, rows = (np.concatenate([disc[k] for disc in discs]) + corner[k] for k in (0, 1))
    height, width = scene.image.shape
    usable = ((columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)).astype(np.float64)
    np.clip(columns, 0, width - 1, out=columns)
    np.clip(rows, 0, height - 1, out=rows)
    patches = Patches(
        columns.astype(np.float64),
        rows.astype(np.float64),
        scene.image[rows, columns].astype(np.float64),
        usable,
        counts,
        np.full(len(counts), scene.sigma),
        settings.shot_gain,
        float(settings.saturation),
    )
    rejected = np.array([(r.u_px, r.v_px) for r in scene.rejected if np.isfinite(r.u_px)]).reshape(-1, 2)
    apart = usable.copy()
    rivals = np.concatenate([rejected, centres_px])
    gap = np.hypot(*(centres_px[:, None] - rivals).transpose(2, 0, 1))
    for number, rival in np.argwhere((gap > 0.0) & (gap < 3.0 * half_widths[:, None])).tolist():
        pixels = slice(patches.begins[number], patches.begins[number] + patches.counts[number])
        # nearer to the spot than to its rival: on the near side of the line half way between them
        towards, middle = rivals[rival] - centres_px[number], (rivals[rival] + centres_px[number]) / 2.0
        along = (patches.u_px[pixels] - middle[0]) * towards[0] + (patches.v_px[pixels] - middle[1]) * towards[1]
        apart[pixels] *= along <= 0.0
        if rival < len(rejected):
            usable[pixels] *= along <= 0.0
    return patches, apart


def _light_of_others(patches: Patches, parameters: Array, members: NDArray[np.intp], near: NDArray[np.bool_]) -> Array:
    light = np.zeros_like(patches.values)
    begin = 0
    for place, count in zip(members, patches.counts.tolist(), strict=True):
        own = slice(begin, begin + count)
        light[own] = spot_light(parameters[near[place]], patches.u_px[own], patches.v_px[own]).sum(axis=0)
        begin += count
    return light


def _chebyshev(places: Array) -> Array:
    """(N, N) larger coordinate difference; infinite on the diagonal."""
    apart = np.abs(places[:, None, :] - places[None, :, :]).max(axis=2)
    np.fill_diagonal(apart, np.inf)
    return np.asarray(apart)


def _without_bad_fits(sight: Sight, fit: Fit) -> NDArray[np.intp]:
    parameters, blobs = fit.parameters, sight.blobs
    moved = np.hypot(parameters[:, U] - blobs.u_px, parameters[:, V] - blobs.v_px)
    lost = ~(fit.converged & (moved <= 2.0))
    hot = ~lost & (spot_size_px(parameters) < _HOT_SIZE_PX)
    for k in np.flatnonzero(lost | hot).tolist():
        sight.reject(k, "no fit" if lost[k] else "hot pixel")
    keep = np.flatnonzero(~(lost | hot))
    double = np.tril(_chebyshev(parameters[keep, :2]) <= 0.7).any(axis=1)  # two parts that became one
    return np.asarray(keep[~double])


def _without_reflections(sight: Sight, fit: Fit, keep: NDArray[np.intp], settings: DetectSettings) -> NDArray[np.intp]:
    """Turn down spots that are much weaker than one close by: the shine of that light on the wing."""
    if keep.size < 2:
        return keep
    parameters = fit.parameters[keep]
    size = spot_size_px(parameters)
    flux = parameters[:, AMPLITUDE] * size**2
    apart = np.hypot(*(parameters[:, None, :2] - parameters[None, :, :2]).transpose(2, 0, 1))
    close = apart < settings.reflection_reach_px + settings.reflection_reach_radii * (size[:, None] + size[None, :])
    shine = (close & (flux[:, None] < settings.reflection_flux * flux[None, :])).any(axis=1)
    for k in keep[shine].tolist():
        sight.reject(k, "reflection")
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
