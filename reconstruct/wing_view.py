"""A result → the report's view of the wing in 3-D: a canvas with its controls, the sets shown, and the program.

Places are whole numbers of 16 bits times one step, and at most FRAMES_SHOWN sets a track are embedded, so that the
report's size does not grow with the flight.
"""

import base64
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from reconstruct.figures import COLOURS
from reconstruct.page import asset
from reconstruct.result import Result, SideResult
from reconstruct.ribbon import Ribbon, ribbon, side_sign
from reconstruct.shown import Track
from reconstruct.signal_figure import shown_signals
from reconstruct.tables import Floats

LOAD_FACTOR = "load_factor"
_UNKNOWN = -32768  # in place of a number
_LARGEST = 32767


@dataclass(frozen=True)
class View:
    """What goes into the page."""

    html: str
    script: str


def wing_view(result: Result) -> View:
    """The view of a result in which at least one set was fitted."""
    data = json.dumps(_data(result), separators=(",", ":")).replace("<", "\\u003c")
    return View(asset("wing_view.html").replace("{data}", data), asset("wing_view.js"))


def _data(result: Result) -> dict[str, Any]:
    ribbons = {name: ribbon(name, side) for name, side in result.sides.items()}
    known = [np.abs(side.sample.shape.xyz_m) for side in result.sides.values()]
    known += [np.abs(side.sample.markers.xyz_m) for side in result.sides.values()]
    step_m = 1.25 * max(float(np.nanmax(one)) for one in known if np.isfinite(one).any()) / _LARGEST
    distances = [1e3 * np.linalg.norm(side.sample.residual_m, axis=-1) for side in result.sides.values()]
    every = np.concatenate([one[np.isfinite(one)] for one in distances])
    top_mm = max(float(np.percentile(every, 98)) if every.size else 1.0, 1e-3)
    return {
        "reference": result.reference,
        "step_m": step_m,
        "residual_step_mm": top_mm / 1000,
        "residual_top_mm": top_mm,
        "sides": [_side(name, side, ribbons[name], step_m) for name, side in result.sides.items()],
        "tracks": [_track(track, result, ribbons, step_m, top_mm / 1000) for track in result.shown.tracks],
    }


def _side(name: str, side: SideResult, own: Ribbon, step_m: float) -> dict[str, Any]:
    """What does not change in time."""
    station = np.interp(own.marker_s_m, side.s_m, np.arange(side.s_m.size))
    rest = own.edges(side_sign(name), side.reference_xyz_m[None], side.reference_twist_deg[None])
    return {
        "name": name,
        "colour": COLOURS[name],
        "stations": int(side.s_m.size),
        "rest": _whole(rest, step_m),
        "markers": side.sample.markers.marker.tolist(),
        "marker_station": _floats(station),
        "marker_across": _floats(own.marker_across),
    }


def _track(
    track: Track, result: Result, ribbons: Mapping[str, Ribbon], step_m: float, residual_step_mm: float
) -> dict[str, Any]:
    sides = {}
    for name, side in result.sides.items():
        rows = side.sample.rows(track.trigger_index)
        edges = ribbons[name].edges(side_sign(name), side.sample.shape.xyz_m, side.sample.shape.twist_deg)
        sides[name] = {
            "edges": _whole(_picked(edges, rows), step_m),
            "markers": _whole(_picked(side.sample.markers.xyz_m, rows), step_m),
            "residual": _whole(_picked(_residual_mm(side), rows), residual_step_mm),
            **{key: _floats(_picked_frames(side, values, track)) for key, values in _readings(side).items()},
        }
    return {
        "name": track.name,
        "time_s": _floats((track.timestamp_ns - result.start_ns) * 1e-9),
        "sides": sides,
        "signals": _signals(result, track),
    }


def _readings(side: SideResult) -> dict[str, Floats]:
    """What is told of each set, by its name in the program."""
    frames = side.frames
    return {
        "tip_mm": 1e3 * frames["tip_dz_m"],
        "tip_sigma_mm": 1e3 * frames["sigma_tip_dz_m"],
        "twist_deg": frames["tip_twist_deg"],
        "twist_sigma_deg": frames["sigma_tip_twist_deg"],
        "rms_mm": frames["residual_rms_mm"],
    }


def _residual_mm(side: SideResult) -> Floats:
    """(K, M) of the marker table's markers: length of the residual, NaN where not used."""
    distance = 1e3 * np.linalg.norm(side.sample.residual_m, axis=-1)
    column = {int(marker): at for at, marker in enumerate(side.residuals.marker)}
    found = np.full(side.sample.markers.seen.shape, np.nan)
    for at, marker in enumerate(side.sample.markers.marker.tolist()):
        if marker in column:
            found[:, at] = distance[:, column[marker]]
    return found


def _signals(result: Result, track: Track) -> dict[str, str]:
    """The load factor, where there is one, and the signals that go with the tip most."""
    names = [LOAD_FACTOR, *(name for name, _ in shown_signals(result))]
    found = {}
    for name in dict.fromkeys(names):
        for side in result.sides.values():
            if name in side.signals:
                found[name] = _floats(_picked_frames(side, side.signals[name], track))
                break
    return found


def _picked(values: Floats, rows: Any) -> Floats:
    """The sample's ``rows``, NaN where there is none (−1)."""
    there = (rows >= 0).reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray(np.where(there, values[rows], np.nan))


def _picked_frames(side: SideResult, values: Floats, track: Track) -> Floats:
    at = np.clip(np.searchsorted(side.trigger_index, track.trigger_index), 0, side.trigger_index.size - 1)
    return np.asarray(np.where(side.trigger_index[at] == track.trigger_index, values[at], np.nan))


def _whole(values: Floats, step: float) -> str:
    """Whole numbers of 16 bits, of ``step`` each; what is larger is as large as they get."""
    known = np.isfinite(values)
    scaled = np.clip(np.rint(np.where(known, values, 0.0) / step), -_LARGEST, _LARGEST)
    return _encoded(np.where(known, scaled, _UNKNOWN).astype("<i2"))


def _floats(values: np.ndarray[Any, Any]) -> str:
    return _encoded(values.astype("<f4"))


def _encoded(values: np.ndarray[Any, Any]) -> str:
    return base64.b64encode(values.tobytes()).decode("ascii")
