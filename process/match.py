"""Spots of a pair's two images to the wing's numbered markers: which belong together, and which light they are.

Candidates are all pairs of spots that satisfy the epipolar condition. They become markers by an assignment to
predicted places with a "none" class. Without a previous frame, the places are those of a wing of the layout's arc
lengths bent to several degrees; whatever fits best is bent on, as polynomials in arc length, to what was matched, and
matched again more tightly. With one, they are the previous places, moved on.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from statistics import median
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from process.bent_wing import BentWing
from process.camera_model import MarkerLayout, RigSide
from process.detect import Detections
from process.triangulate import Points, Rays, epipolar_distance_px, rays, rectified_pixels, triangulate_rays

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
T = TypeVar("T", bound=np.generic)

UNSEEN = -1
_TIP_SLOPES_RAD = np.linspace(-0.5, 1.2, 18)
_CONFLICT_ROUNDS = 40


@dataclass(frozen=True)
class MatchSettings:
    """How spots are matched. Standard deviations are of the predicted places, along the wing's directions."""

    method: Literal["default", "rows"] = "default"
    epipolar_allowance_px: float = 0.5
    """calibration's part of the epipolar distance, one sigma"""
    epipolar_gate: float = 3.0
    """sigmas"""
    none_cost: float = 16.0
    """squared Mahalanobis distance from which "not seen" is the better explanation"""
    least_margin: float = 6.0
    """a runner-up closer than this, in squared Mahalanobis distance, makes a marker ``ambiguous``"""
    lone_sigma_m: float = 0.002
    """least sigma of the place, along each axis, where a light that one camera saw is looked for"""
    stretch_m: float = 0.002
    """one sigma of the distance between neighbouring lights, besides the spots' noise: a wing bends, it does not …"""
    stretch: float = 0.004
    """… stretch; and of the part that calibration adds in proportion to the distance"""
    epipolar_spread_px: float = 0.05
    """least sigma of a light's epipolar distance about the others' of its frame set, which share the calibration"""
    least_likeness: float = 4.5
    """sigmas from its neighbours' distances, or from the others' epipolar distance, that make a marker ``ambiguous``"""
    start_sigma_m: tuple[float, float, float] = (0.06, 0.035, 0.20)
    """span, chord and normal, without a previous frame"""
    track_sigma_m: tuple[float, float, float] = (0.015, 0.015, 0.05)
    """with one; the normal one also takes the motion of a frame without known velocity"""
    final_sigma_m: tuple[float, float, float] = (0.012, 0.012, 0.018)
    """after the wing has been bent to what was matched"""


@dataclass(frozen=True, eq=False)
class Track:
    """Where the markers were: what the next frame's matching starts from."""

    trigger_index: int
    places_m: Array
    """(M, 3) body frame; those not seen are interpolated"""
    velocity_m: Array | None
    """(M, 3) metres a trigger; None after a single frame"""


@dataclass(frozen=True, eq=False)
class Matches:
    """The M markers of a layout in one frame set."""

    spot0: Indices
    """(M,) index into cam0's detections, ``UNSEEN`` where the marker is not seen"""
    spot1: Indices
    margin: Array
    """(M,) squared Mahalanobis distance to the runner-up, which may be "not seen"; NaN where not seen"""
    ambiguous: NDArray[np.bool_]
    track: Track | None
    """for the next frame; None if there was too little to follow"""
    rays: tuple[Rays, Rays] | None = None
    """all spots of cam0 and cam1, taken through the lens; None where nothing was matched"""
    points: Points | None = None
    """of the seen markers, in their order, by least reprojection error; None where matching did not need them"""
    followed_m: Array | None = None
    """(M, 3) where the track, bent to what was seen, has the markers, body frame; None where no track was followed"""

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(M,)"""
        return np.asarray(self.spot0 != UNSEEN)


@dataclass(frozen=True, eq=False)
class _Candidates:
    spot0: Indices
    spot1: Indices
    xyz_m: Array
    covariance_m2: Array
    epipolar_px: Array  # signed
    epipolar_d2: Array


@dataclass(frozen=True, eq=False)
class Sighting:
    """The spots of one frame set, through the lenses, and which of them may belong together."""

    detections: tuple[Detections, Detections]
    rays: tuple[Rays, Rays]
    candidates: _Candidates | None
    """None for the paper's way, which needs none"""


def match(
    side_name: str,
    side: RigSide,
    layout: MarkerLayout,
    detections: tuple[Detections, Detections],
    trigger_index: int,
    track: Track | None = None,
    settings: MatchSettings | None = None,
) -> Matches:
    """Match and identify the spots of a frame set.

    ``track`` is the previous frame's; without it, or when following it fails, the matching starts afresh. ``rows`` is
    the paper's way: spots of both images sorted by rectified row, identity by distance; it needs every marker seen
    and nothing else.
    """
    settings = settings or MatchSettings()
    return match_sighting(
        side_name,
        side,
        layout,
        sightings(side_name, side, layout, [detections], settings)[0],
        trigger_index,
        track,
        settings,
    )


def sightings(
    side_name: str,
    side: RigSide,
    layout: MarkerLayout,
    found: Sequence[tuple[Detections, Detections]],
    settings: MatchSettings,
) -> list[Sighting]:
    """What ``match_sighting`` needs of frame sets, at least one: all of them together, which is faster than each."""
    counts = np.array([[len(one) for one in detections] for detections in found]).T
    through = [
        rays(
            camera,
            np.concatenate([detections[number].pixels for detections in found]),
            np.concatenate([detections[number].covariance_px2 for detections in found]),
        )
        for number, camera in enumerate((side.pair.cam0, side.pair.cam1))
    ]
    both = list(zip(*(_split(whole, own) for whole, own in zip(through, counts, strict=True)), strict=True))
    if settings.method == "rows":
        return [Sighting(detections, pair, None) for detections, pair in zip(found, both, strict=True)]
    noise_px2 = [
        np.concatenate([np.trace(detections[number].covariance_px2, axis1=1, axis2=2) for detections in found]) / 2.0
        for number in (0, 1)
    ]
    candidates = _candidates(side_name, side, layout, counts, through, noise_px2, settings)
    return [Sighting(*one) for one in zip(found, both, candidates, strict=True)]


def match_sighting(
    side_name: str,
    side: RigSide,
    layout: MarkerLayout,
    sighting: Sighting,
    trigger_index: int,
    track: Track | None,
    settings: MatchSettings,
) -> Matches:
    """``match`` of a frame set that has been through ``sightings``."""
    detections, candidates = sighting.detections, sighting.candidates
    if candidates is None:
        return _match_by_rows(side, layout, *sighting.rays)
    wing = _wing(side_name, layout)
    followed = None if track is None else _follow(wing, candidates, track, trigger_index, settings)
    result = followed
    if result is None or _leaves_spots(result[0], detections):
        fresh = _start(wing, candidates, settings)
        if result is None or _total(fresh[0], fresh[2], settings) < _total(result[0], result[2], settings):
            result = fresh
    chosen, places, cost = result
    margin = _margins(candidates, chosen, cost, settings.none_cost)
    seen = chosen != UNSEEN
    odd = _odd_ones(wing, candidates, chosen, settings)
    ambiguous = seen & (odd | ~(margin >= settings.least_margin))
    next_track = _next_track(candidates, np.where(odd, UNSEEN, chosen), places, trigger_index, track)
    return Matches(
        np.where(seen, _picked(candidates.spot0, chosen), UNSEEN),
        np.where(seen, _picked(candidates.spot1, chosen), UNSEEN),
        margin,
        ambiguous,
        next_track,
        sighting.rays,
        _points(candidates, chosen[seen]),
        None if followed is None or not np.array_equal(followed[0], chosen) else followed[1],
    )


def _points(candidates: _Candidates, chosen: Indices) -> Points:
    xyz_m, covariance_m2 = candidates.xyz_m[chosen], candidates.covariance_m2[chosen]
    return Points(xyz_m, covariance_m2, candidates.epipolar_px[chosen], ("",) * len(chosen))


def _split(whole: Rays, counts: Indices) -> list[Rays]:
    ends = np.cumsum(counts).tolist()
    return [whole[slice(begin, end)] for begin, end in pairwise([0, *ends])]


def wing_places_m(side_name: str, layout: MarkerLayout, tip_slope_rad: float) -> Array:
    """(M, 3) markers, body frame, of a wing bent like a cantilever under an even load to a slope at the tip."""
    return BentWing(side_name, layout).bent(tip_slope_rad)


@lru_cache(maxsize=8)
def _wing(side_name: str, layout: MarkerLayout) -> BentWing:
    return BentWing(side_name, layout)


_Result = tuple[Indices, Array, Array]  # chosen candidate, predicted places, cost matrix (markers × candidates)


def _candidates(
    side_name: str,
    side: RigSide,
    layout: MarkerLayout,
    counts: Indices,
    through: Sequence[Rays],
    noise_px2: Sequence[Array],
    settings: MatchSettings,
) -> list[_Candidates]:
    """Of each set: spots on each other's epipolar lines that meet in front of the cameras, where a wing can be.

    ``counts`` (2, S) are the spots of each set, of which cam0's and cam1's lie end to end.
    """
    of_set, spot0, spot1 = _pairs(counts)
    first0, first1 = np.cumsum(counts, axis=1) - counts
    at0, at1 = first0[of_set] + spot0, first1[of_set] + spot1
    distance_px = epipolar_distance_px(side.pair, through[0].xy[at0], through[1].xy[at1])
    d2 = distance_px**2 / ((noise_px2[0][at0] + noise_px2[1][at1]) / 2.0 + settings.epipolar_allowance_px**2)
    near = np.flatnonzero(d2 < settings.epipolar_gate**2)
    points = triangulate_rays(side, through[0][at0[near]], through[1][at1[near]])
    outboard_m = points.xyz_m[:, 1] * (1.0 if side_name == "right" else -1.0)
    reach_m = 1.1 * layout.pairs_station_m[-1] + 0.2
    with np.errstate(invalid="ignore"):
        inside = (np.linalg.norm(points.xyz_m, axis=1) < reach_m) & (outboard_m > -0.1)
    near = near[inside]
    columns = (
        spot0[near],
        spot1[near],
        points.xyz_m[inside],
        points.covariance_m2[inside],
        distance_px[near],
        d2[near],
    )
    ends = np.searchsorted(of_set[near], np.arange(counts.shape[1] + 1)).tolist()
    return [_Candidates(*(column[begin:end] for column in columns)) for begin, end in pairwise(ends)]


def _pairs(counts: Indices) -> tuple[Indices, Indices, Indices]:
    """All pairs of spots of sets with ``counts`` (2, S): of which set, cam0's, cam1's."""
    pairs = counts[0] * counts[1]
    of_set = np.repeat(np.arange(counts.shape[1]), pairs)
    number = np.arange(len(of_set)) - np.repeat(np.cumsum(pairs) - pairs, pairs)
    return of_set, *np.divmod(number, counts[1][of_set])


def _start(wing: BentWing, candidates: _Candidates, settings: MatchSettings) -> _Result:
    """The best of several bends, each assigned loosely; the three best are refined."""
    tried = []
    for slope in _TIP_SLOPES_RAD:
        places = wing.bent(float(slope))
        chosen, cost = _assigned(wing, candidates, places, settings.start_sigma_m, settings.none_cost)
        tried.append((_total(chosen, cost, settings), places, chosen))
    tried.sort(key=lambda trial: trial[0])
    refined = []
    for _, places, chosen in tried[:3]:
        result = _refined(wing, candidates, places, chosen, (settings.start_sigma_m, settings.track_sigma_m), settings)
        refined.append((_total(result[0], result[2], settings), result))
    return min(refined, key=lambda trial: trial[0])[1]


def _follow(
    wing: BentWing, candidates: _Candidates, track: Track, trigger_index: int, settings: MatchSettings
) -> _Result | None:
    """Assignment to the track moved on; None if it explains less than half of the wing."""
    gap = trigger_index - track.trigger_index
    if not 0 < gap <= 10:
        return None
    span, chord, normal = settings.track_sigma_m
    if track.velocity_m is None:
        places, normal = track.places_m, 1.6 * normal
    else:
        places = track.places_m + track.velocity_m * gap
    sigma_m = (span * np.sqrt(gap), chord * np.sqrt(gap), normal * np.sqrt(gap))
    chosen, _ = _assigned(wing, candidates, places, sigma_m, settings.none_cost)
    result = _refined(wing, candidates, places, chosen, (), settings)
    return result if np.count_nonzero(result[0] != UNSEEN) >= wing.count / 2 else None


def _refined(
    wing: BentWing,
    candidates: _Candidates,
    places: Array,
    chosen: Indices,
    sigmas_m: Sequence[tuple[float, float, float]],
    settings: MatchSettings,
) -> _Result:
    """Bend the wing to what was chosen and choose again, ending with the final sigmas."""
    cost = np.empty((wing.count, len(candidates.spot0)))
    for sigma_m in (*sigmas_m, settings.final_sigma_m, settings.final_sigma_m):
        seen = chosen != UNSEEN
        if seen.any():
            places = wing.bend_to(places, _picked(candidates.xyz_m, chosen), seen)
        chosen, cost = _assigned(wing, candidates, places, sigma_m, settings.none_cost)
    return chosen, places, cost


def _assigned(
    wing: BentWing, candidates: _Candidates, places: Array, sigma_m: Sequence[float], none_cost: float
) -> tuple[Indices, Array]:
    """(M,) candidate of each marker and the costs (M, C); every spot is used at most once in each image."""
    apart = candidates.xyz_m - places[:, None, :]
    scaled = apart @ (wing.directions(places) / np.asarray(sigma_m)[:, None]).transpose(0, 2, 1)
    cost = np.einsum("mci,mci->mc", scaled, scaled)
    cost += candidates.epipolar_d2
    chosen = _nearest(candidates, cost, none_cost)
    if chosen is not None:
        return chosen, cost
    chosen = np.full(wing.count, UNSEEN, dtype=np.intp)
    worth = np.flatnonzero((cost < none_cost).any(axis=0))
    allowed = np.ones(len(worth), dtype=bool)
    for _ in range(_CONFLICT_ROUNDS):
        open_ = worth[allowed]
        padded = np.concatenate([cost[:, open_], np.full((wing.count, wing.count), none_cost)], axis=1)
        markers, columns = linear_sum_assignment(padded)
        real = columns < len(open_)
        chosen[:] = UNSEEN
        chosen[markers[real]] = open_[columns[real]]
        loser = _conflict(candidates, chosen, cost)
        if loser == UNSEEN:
            return chosen, cost
        allowed[worth == loser] = False
    for marker in range(wing.count):  # bounded: what is still in conflict counts as not seen
        rivals = [m for m in range(marker) if chosen[m] != UNSEEN and _share(candidates, chosen[m], chosen[marker])]
        if chosen[marker] != UNSEEN and rivals:
            chosen[marker] = UNSEEN
    return chosen, cost


def _nearest(candidates: _Candidates, cost: Array, none_cost: float) -> Indices | None:
    """The assignment, when each marker's cheapest candidate is nobody else's: none can be better."""
    if not cost.shape[1]:
        return np.full(len(cost), UNSEEN, dtype=np.intp)
    best = cost.argmin(axis=1)
    near = cost[np.arange(len(cost)), best] < none_cost
    taken = best[near]
    for spots in (candidates.spot0[taken], candidates.spot1[taken]):
        if spots.size and np.bincount(spots).max() > 1:
            return None
    return np.where(near, best, UNSEEN)


def _conflict(candidates: _Candidates, chosen: Indices, cost: Array) -> int:
    """The dearest chosen candidate that shares a spot with another chosen one; ``UNSEEN`` if there is none."""
    markers = np.flatnonzero(chosen != UNSEEN)
    taken = chosen[markers]
    shared = np.zeros(len(taken), dtype=bool)
    for spots in (candidates.spot0[taken], candidates.spot1[taken]):
        shared |= (spots[:, None] == spots[None, :]).sum(axis=1) > 1
    if not shared.any():
        return UNSEEN
    return int(taken[shared][np.argmax(cost[markers, taken][shared])])


def _share(candidates: _Candidates, a: int, b: int) -> bool:
    return bool(candidates.spot0[a] == candidates.spot0[b] or candidates.spot1[a] == candidates.spot1[b])


def _total(chosen: Indices, cost: Array, settings: MatchSettings) -> float:
    seen = chosen != UNSEEN
    return float(cost[np.flatnonzero(seen), chosen[seen]].sum() + settings.none_cost * np.count_nonzero(~seen))


def _leaves_spots(chosen: Indices, detections: tuple[Detections, Detections]) -> bool:
    """Three markers are missing though there are as many spots without one in both images: the track may be lost."""
    seen = np.count_nonzero(chosen != UNSEEN)
    spare = min(len(spots) for spots in detections) - seen
    return bool(min(len(chosen) - seen, spare) >= 3)


def _margins(candidates: _Candidates, chosen: Indices, cost: Array, none_cost: float) -> Array:
    """(M,) how much worse the best other explanation of each seen marker is: a free candidate, a swap, or none."""
    margin = np.full(len(chosen), np.nan)
    seen = np.flatnonzero(chosen != UNSEEN)
    own = cost[seen, chosen[seen]]
    swapped = cost[np.ix_(seen, chosen[seen])]
    swap = swapped + swapped.T - own[:, None] - own[None, :]
    np.fill_diagonal(swap, np.inf)
    taken = candidates.spot0[chosen[seen]], candidates.spot1[chosen[seen]]
    # (seen, C): which of them have the candidate's spot in either image
    rivals = (taken[0][:, None] == candidates.spot0) | (taken[1][:, None] == candidates.spot1)
    free = np.where(rivals.sum(axis=0) == rivals, cost[seen], np.inf)
    free[np.arange(len(seen)), chosen[seen]] = np.inf
    best = np.minimum(free.min(axis=1, initial=np.inf), swap.min(axis=1, initial=np.inf) + own)
    margin[seen] = np.minimum(best, none_cost) - own
    return margin


def _odd_ones(wing: BentWing, candidates: _Candidates, chosen: Indices, settings: MatchSettings) -> NDArray[np.bool_]:
    """(M,) seen markers that are unlike the rest, as a false pair of spots in a missing marker's place is.

    A false pair has any place along a ray, and any epipolar distance within the gate. True lights keep their distances
    from their neighbours, however the wing bends (0.4 m bent to a radius of 3 m shorten by 0.3 mm), and share the
    calibration's epipolar error.
    """
    odd = np.zeros(wing.count, dtype=bool)
    seen = np.flatnonzero(chosen != UNSEEN)
    if len(seen) < 4:
        return odd
    epipolar_px = candidates.epipolar_px[chosen[seen]]
    off_px = np.abs(epipolar_px - median(epipolar_px.tolist()))  # NumPy's own takes ten times as long
    odd[seen] = off_px > settings.least_likeness * max(settings.epipolar_spread_px, 1.4826 * median(off_px.tolist()))
    edges = _edges(seen)
    first, second = edges.T
    apart = _picked(candidates.xyz_m, chosen)[first] - _picked(candidates.xyz_m, chosen)[second]
    length_m = np.linalg.norm(apart, axis=1)
    rest_m = np.linalg.norm(wing.offset_m[first] - wing.offset_m[second], axis=1)
    covariance = _picked(candidates.covariance_m2, chosen)
    along = apart / length_m[:, None]
    noise_m2 = np.einsum("ni,nij,nj->n", along, covariance[first] + covariance[second], along)
    sigma_m = np.sqrt(noise_m2 + settings.stretch_m**2 + (settings.stretch * rest_m) ** 2)
    bad = ~(np.abs(length_m - rest_m) <= settings.least_likeness * sigma_m)
    odd[edges[bad].ravel()] = True  # both ends: which one is wrong is not known, and false pairs are rare
    return odd


def _edges(seen: Indices) -> Indices:
    """(E, 2) markers that are neighbours among ``seen``: the two of a pair, and the next one outboard of each row."""
    there = set(seen.tolist())
    edges = [(marker, marker + 1) for marker in seen.tolist() if marker % 2 == 0 and marker + 1 in there]
    for row in (0, 1):
        members = [marker for marker in seen.tolist() if marker % 2 == row]
        edges += list(pairwise(members))
    return np.array(edges, dtype=np.intp).reshape(-1, 2)


def _next_track(
    candidates: _Candidates, chosen: Indices, places: Array, trigger_index: int, track: Track | None
) -> Track | None:
    seen = chosen != UNSEEN
    if np.count_nonzero(seen) < len(chosen) / 2:
        return None
    measured = np.where(seen[:, None], _picked(candidates.xyz_m, chosen), places)
    if track is None or not 0 < trigger_index - track.trigger_index <= 10:
        return Track(trigger_index, measured, None)
    return Track(trigger_index, measured, (measured - track.places_m) / (trigger_index - track.trigger_index))


def _picked(values: NDArray[T], chosen: Indices) -> NDArray[T]:
    """``values`` of the chosen candidates; whatever where there is none."""
    if len(values) == 0:
        return np.zeros((len(chosen), *values.shape[1:]), dtype=values.dtype)
    return values[np.maximum(chosen, 0)]


def _match_by_rows(side: RigSide, layout: MarkerLayout, rays0: Rays, rays1: Rays) -> Matches:
    """The paper's correspondence: n-th lowest row with n-th lowest row, then markers by distance from the cameras."""
    count = 2 * len(layout.pairs_station_m)
    spot0, spot1 = np.full(count, UNSEEN, dtype=np.intp), np.full(count, UNSEEN, dtype=np.intp)
    order0 = np.argsort(rectified_pixels(side.pair, 0, rays0.xy)[:, 1], kind="stable")
    order1 = np.argsort(rectified_pixels(side.pair, 1, rays1.xy)[:, 1], kind="stable")
    paired = min(len(order0), len(order1), count)
    order0, order1 = order0[:paired], order1[:paired]
    points = triangulate_rays(side, rays0[order0], rays1[order1])
    distance_m = np.abs(points.xyz_m[:, 1])
    outward = np.argsort(distance_m, kind="stable")
    for pair in range(paired // 2):
        two = outward[2 * pair : 2 * pair + 2]
        fore_aft = two[np.argsort(points.xyz_m[two, 0], kind="stable")]  # x is aft
        spot0[2 * pair : 2 * pair + 2] = order0[fore_aft]
        spot1[2 * pair : 2 * pair + 2] = order1[fore_aft]
    seen = spot0 != UNSEEN
    whole = len(rays0.xy) == len(rays1.xy) == count
    return Matches(spot0, spot1, np.where(seen, np.inf, np.nan), seen & (not whole), None, (rays0, rays1))
