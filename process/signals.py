"""A flight's CAN, analog and MAVLink messages to named signals in time, and its gates to spans in which they failed."""

import math
from array import array
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cantools
import numpy as np
from numpy.typing import NDArray

from capture.errors import ProcessError
from capture.record import ANALOG_TOPIC, CAN_TOPIC, GATE_TOPIC, MAVLINK_TOPIC, Analog, CanFrame, Gate, Mavlink
from process.mcap_file import stream_messages
from process.recording import find_files

_TOPICS = frozenset((CAN_TOPIC, ANALOG_TOPIC, MAVLINK_TOPIC, GATE_TOPIC))
_CLOCKS = frozenset(("time_boot_ms", "time_usec"))  # of the autopilot: when, not what
_PERIODS = {
    ("ATTITUDE", "roll"): 2 * math.pi,
    ("ATTITUDE", "yaw"): 2 * math.pi,
    ("VFR_HUD", "heading"): 360.0,
}
"""MAVLink fields that come back to where they were: neighbours across the seam are near each other"""


@dataclass(frozen=True, eq=False)
class Signal:
    """One quantity in time."""

    name: str
    source: str
    """topic, and where in it"""
    unit: str
    """as the DBC says; empty: not known"""
    time_ns: NDArray[np.int64]
    """(n,) UTC, growing"""
    value: NDArray[np.float64]
    """(n,)"""
    held: bool = False
    """a state, which stays until the next sample; else it is interpolated"""
    period: float = math.nan
    """of an angle: where it starts again"""


@dataclass(frozen=True)
class Outage:
    """A gate that failed during a recording."""

    name: str
    cause: str
    begin_ns: int
    end_ns: int | None
    """None: until the end of the recording"""


@dataclass(frozen=True)
class Signals:
    """What a flight has beside its frames."""

    signals: tuple[Signal, ...] = ()
    """by name"""
    outages: tuple[Outage, ...] = ()
    """by begin"""
    problems: tuple[str, ...] = ()


@dataclass
class _Series:
    """Samples of one signal as they come; ``key`` is its full name in parts, of which the last ``least`` stay."""

    key: tuple[str, ...]
    least: int
    topic: str
    unit: str = ""
    held: bool = False
    period: float = math.nan
    time_ns: "array[int]" = field(default_factory=lambda: array("q"))
    value: "array[float]" = field(default_factory=lambda: array("d"))

    def add(self, time_ns: int, value: float) -> None:
        self.time_ns.append(time_ns)
        self.value.append(value)


_All = dict[tuple[str, ...], _Series]
_Meaning = dict[tuple[int, bool], Any]  # identifier, whether it is extended → cantools' message


def read_signals(flight_paths: Sequence[Path | str], dbc: Sequence[Path] = ()) -> Signals:
    """Everything that was recorded beside the frames; the two disks' copies are one.

    A signal is named by what its source calls it: the DBC's signal, the configured analog name, MAVLink message and
    field in lower case. Where two would have the same name, message and bus (or system) come before it.

    Args:
        flight_paths: the flight's folders.
        dbc: files that say what CAN frames mean; a frame is decoded by the first that knows its identifier.

    Raises:
        ProcessError: no recording is there, or a DBC file cannot be used.
    """
    meaning: _Meaning = {}
    for path in reversed(dbc):
        meaning |= _read_dbc(path)
    files = find_files(flight_paths)
    files = tuple(path for path in files if path.name.startswith("aux_")) or files
    problems: list[str] = []
    found: _All = {}
    outages: dict[tuple[str, int], Outage] = {}
    unknown: Counter[int] = Counter()
    seen: set[tuple[str, int, int]] = set()  # the other disk has a copy
    for head, data in (one for path in files for one in stream_messages(path, _TOPICS, problems)):
        identity = (head.topic, head.sequence, head.publish_time_ns)
        if identity in seen:
            continue
        seen.add(identity)
        try:
            if head.topic == CAN_TOPIC:
                _take_can(found, CanFrame.decode(data), meaning, unknown)
            elif head.topic == ANALOG_TOPIC:
                _take_analog(found, Analog.decode(data))
            elif head.topic == MAVLINK_TOPIC:
                _take_mavlink(found, Mavlink.decode(data))
            else:
                gate = Gate.decode(data)
                end_ns = gate.end_ns or None
                outages[gate.name, gate.begin_ns] = Outage(gate.name, gate.cause, gate.begin_ns, end_ns)
        except ValueError as error:
            problems.append(f"{head.place.path}: a message on {head.topic} is not readable ({error})")
    if unknown:
        said = f"{unknown.total()} CAN frames of {len(unknown)} identifiers"
        problems.append(f"{said} are in no DBC file" if dbc else f"{said} are recorded: --dbc FILE names their signals")
    by_begin = sorted(outages.values(), key=lambda outage: outage.begin_ns)
    return Signals(_named(found), tuple(by_begin), tuple(problems))


def _read_dbc(path: Path) -> _Meaning:
    try:
        database: Any = cantools.database.load_file(path)
    except OSError as error:
        raise ProcessError(f"{path}: {error.strerror}; give --dbc an existing file") from error
    except Exception as error:  # cantools' parsers share no error class
        raise ProcessError(f"{path}: not a DBC file ({' '.join(str(error).split())[:200]})") from error
    return {(message.frame_id, message.is_extended_frame): message for message in database.messages}


def _take_can(found: _All, frame: CanFrame, meaning: _Meaning, unknown: Counter[int]) -> None:
    if frame.is_error or frame.is_rtr:
        return
    message = meaning.get((frame.id, frame.is_extended))
    if message is None:
        unknown[frame.id] += 1
        return
    try:
        values = message.decode(frame.data, decode_choices=False, allow_truncated=True)
    except Exception as error:  # cantools' own errors, and bitstruct's
        raise ValueError(f"{message.name}: {error}") from error
    for name, value in values.items():
        key = (frame.bus, message.name, name)
        if key not in found:
            signal = message.get_signal_by_name(name)
            held = bool(signal.choices) or signal.length == 1
            found[key] = _Series(key, 1, CAN_TOPIC, signal.unit or "", held)
        found[key].add(frame.stamp_ns, float(value))


def _take_analog(found: _All, sample: Analog) -> None:
    key = ("analog", sample.name)
    found.setdefault(key, _Series(key, 1, ANALOG_TOPIC)).add(sample.time_ns, sample.value)


def _take_mavlink(found: _All, message: Mavlink) -> None:
    system = f"mavlink_{message.system}_{message.component}"
    for name, value in zip(message.fields, message.values, strict=True):
        if name in _CLOCKS:
            continue
        key = (system, message.message.lower(), name)
        period = _PERIODS.get((message.message, name), math.nan)
        found.setdefault(key, _Series(key, 2, MAVLINK_TOPIC, period=period)).add(message.time_ns, value)


def _named(found: _All) -> tuple[Signal, ...]:
    names = _short_names([(series.key, series.least) for series in found.values()])
    signals = []
    for series in found.values():
        time_ns, value = np.array(series.time_ns, dtype=np.int64), np.array(series.value, dtype=np.float64)
        order = np.argsort(time_ns, kind="stable")
        time_ns, value = time_ns[order], value[order]
        last = np.append(np.diff(time_ns) > 0, True)  # of two at the same instant the later one
        source = f"{series.topic} {'.'.join(series.key)}"
        times = (time_ns[last], value[last])
        signals.append(Signal(names[series.key], source, series.unit, *times, series.held, series.period))
    return tuple(sorted(signals, key=lambda signal: signal.name))


def _short_names(keys: Iterable[tuple[tuple[str, ...], int]]) -> dict[tuple[str, ...], str]:
    """The last parts of each key, as many as it takes to be the only one of that name."""
    lengths = dict(keys)

    def name(key: tuple[str, ...]) -> str:
        return "_".join(key[-lengths[key] :])

    while True:
        same: defaultdict[str, list[tuple[str, ...]]] = defaultdict(list)
        for key in lengths:
            same[name(key)].append(key)
        longer = [key for keys in same.values() if len(keys) > 1 for key in keys if lengths[key] < len(key)]
        if not longer:
            return {key: name(key) for key in lengths}
        for key in longer:
            lengths[key] += 1
