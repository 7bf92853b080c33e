"""The sets of a flight → those its report shows one by one: extremes, an even sample, and a stretch in full detail."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from reconstruct.tables import Bools, Floats, Ints

DETAIL_S = 20.0  # of a longer flight, so much is shown in detail
FRAMES_SHOWN = 600  # at most, of a track: this bounds a report, whatever the flight's length
_GOLDEN = (5**0.5 - 1) / 2
WHOLE, DETAIL = "whole flight", "around the highest position"


@dataclass(frozen=True)
class Heights:
    """One wing's F sets."""

    trigger_index: Ints  # (F,) ascending
    timestamp_ns: Ints  # (F,)
    tip_dz_m: Floats  # (F,) NaN where not fitted

    @property
    def fitted(self) -> Bools:
        """(F,)"""
        return np.asarray(np.isfinite(self.tip_dz_m))


@dataclass(frozen=True)
class Track:
    """Sets in the order of time, to be shown one after the other."""

    name: str
    trigger_index: Ints  # (n,) of either wing
    timestamp_ns: Ints  # (n,)


@dataclass(frozen=True)
class Shown:
    """What of a flight is shown."""

    instants: Mapping[str, Mapping[str, int]]
    """lowest, middle and highest tip → side → trigger index; fewer when sets are few, none when no set was fitted"""
    tracks: tuple[Track, ...]
    """the whole flight, thinned; of a long one also DETAIL_S around the highest position"""

    @property
    def detail(self) -> Track:
        """The track in which single oscillations can be told apart."""
        return self.tracks[-1]

    def triggers(self, side: str) -> Ints:
        """All trigger indices that are shown of a wing, each once."""
        chosen = [one[side] for one in self.instants.values()]
        return np.unique(
            np.concatenate([np.array(chosen, dtype=np.int64), *(one.trigger_index for one in self.tracks)])
        )


def choose(sides: Mapping[str, Heights]) -> Shown:
    """Choose from the sets of each wing."""
    triggers = np.concatenate([one.trigger_index for one in sides.values()])
    times = np.concatenate([one.timestamp_ns for one in sides.values()])
    triggers, first = np.unique(triggers, return_index=True)
    times = times[first]
    spread = _spread(triggers.size)
    tracks = [Track(WHOLE, triggers[spread], times[spread])]
    if (times[-1] - times[0]) * 1e-9 > DETAIL_S:
        begin_ns = highest_ns(sides) - round(DETAIL_S / 2 * 1e9)
        begin_ns = min(max(begin_ns, int(times[0])), int(times[-1]) - round(DETAIL_S * 1e9))
        inside = (times >= begin_ns) & (times <= begin_ns + round(DETAIL_S * 1e9))
        every = max(1, -(-int(inside.sum()) // FRAMES_SHOWN))
        tracks.append(Track(DETAIL, triggers[inside][::every], times[inside][::every]))
    return Shown(_instants(sides), tuple(track for track in tracks if track.trigger_index.size))


def highest_ns(sides: Mapping[str, Heights]) -> int:
    """When the leading wing's tip is highest; the first set's instant when none was fitted."""
    one = sides[leading(sides)]
    return int(one.timestamp_ns[np.nanargmax(one.tip_dz_m) if one.fitted.any() else 0])


def leading(sides: Mapping[str, Heights]) -> str:
    """The side with the most fitted sets: the one that instants are chosen on."""
    return max(sides, key=lambda side: int(sides[side].fitted.sum()))


def _spread(count: int) -> Ints:
    """At most FRAMES_SHOWN of so many sets: one of each equal stretch, in it by the golden ratio.

    A regular step would see a regular motion always at the same phases.
    """
    if count <= FRAMES_SHOWN:
        return np.arange(count)
    stretch = np.arange(FRAMES_SHOWN)
    return np.unique(((stretch + stretch * _GOLDEN % 1.0) * (count / FRAMES_SHOWN)).astype(np.int64))


def _instants(sides: Mapping[str, Heights]) -> dict[str, dict[str, int]]:
    first = sides[leading(sides)]
    fitted = np.flatnonzero(first.fitted)
    if fitted.size == 0:
        return {}
    order = fitted[np.argsort(first.tip_dz_m[fitted], kind="stable")]
    rows = {"lowest": order[0], "middle": order[order.size // 2], "highest": order[-1]}
    if order.size < 3:
        rows = {"lowest": order[0]} if order.size == 1 else {"lowest": order[0], "highest": order[-1]}
    return {
        name: {side: _nearest_fitted(one, int(first.trigger_index[row])) for side, one in sides.items()}
        for name, row in rows.items()
    }


def _nearest_fitted(one: Heights, trigger: int) -> int:
    known = one.trigger_index[one.fitted] if one.fitted.any() else one.trigger_index
    return int(known[np.argmin(np.abs(known - trigger))])
