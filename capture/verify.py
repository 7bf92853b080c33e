"""A flight's folders to a certificate: is every trigger of every camera recorded once, or lost with a cause?"""

import contextlib
import struct
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from capture.errors import RecordingError, UsageError
from capture.flight import find_folders
from capture.other_books import OtherBooks
from capture.record import GATE_TOPIC, LOSS_TOPIC, SIDES, TRIGGER_TOPIC, Frame, Gate, Loss, Trigger, decode_image
from capture.scan import Scan, ScannedMessage, scan


@dataclass
class CameraReport:
    """What the files say of one camera."""

    recorded: int = 0
    lost: dict[str, int] = field(default_factory=dict)
    width: int = 0
    height: int = 0
    indices: set[int] = field(default_factory=set)
    lost_indices: dict[int, Loss] = field(default_factory=dict)


@dataclass
class FlightReport:
    """What is in a flight's folders, and everything that is wrong with it."""

    folders: list[Path]
    files: list[Scan] = field(default_factory=list)
    cameras: dict[str, CameraReport] = field(default_factory=dict)
    triggers: int = 0
    triggers_reported: int = 0  # by the board, one by one
    first_trigger_ns: int = 0
    last_trigger_ns: int = 0
    first_index: int = 0
    next_index: int = 0  # one past the last trigger
    provenance: dict[str, str] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)  # any of them: not whole
    notes: list[str] = field(default_factory=list)  # accounted for, but worth knowing
    marks: dict[tuple[str, int], Gate] = field(default_factory=dict)  # what was not in order, by name and begin

    @property
    def whole(self) -> bool:
        """Whether nothing is wrong."""
        return not self.problems

    @property
    def sides(self) -> set[str]:
        """The sides whose disk's folder was given, readable or not."""
        named = {path.name.split("_")[0] for folder in self.folders for path in folder.glob("*.mcap")}
        return (named | {file.provenance.get("side", "") for file in self.files}) & set(SIDES)

    @property
    def recorded(self) -> int:
        """Frames in the files."""
        return sum(camera.recorded for camera in self.cameras.values())

    @property
    def lost(self) -> int:
        """Frames that are booked as lost."""
        return sum(len(camera.lost_indices) for camera in self.cameras.values())

    @property
    def write_modes(self) -> list[str]:
        """How the frames went to the disk: direct, buffered, or both."""
        segments = [file for file in self.files if not file.path.name.startswith("aux")]
        return sorted({file.provenance.get("write_mode", "unknown") for file in segments})

    @property
    def size_bytes(self) -> int:
        """Size of all files."""
        return sum(file.size for file in self.files)

    def as_dict(self) -> dict[str, Any]:
        """For ``--json``."""
        return {
            "folders": [str(folder) for folder in self.folders],
            "whole": self.whole,
            "triggers": self.triggers,
            "frames_recorded": self.recorded,
            "frames_lost": self.lost,
            "first_trigger_ns": self.first_trigger_ns,
            "last_trigger_ns": self.last_trigger_ns,
            "bytes": self.size_bytes,
            "cameras": {
                name: {
                    "recorded": camera.recorded,
                    "lost": camera.lost,
                    "width": camera.width,
                    "height": camera.height,
                }
                for name, camera in sorted(self.cameras.items())
            },
            "files": [
                {"path": str(file.path), "bytes": file.size, "chunks": file.chunks, "closed": file.closed}
                for file in self.files
            ],
            "write_modes": self.write_modes,
            "flight": self.provenance.get("flight", ""),
            "version": self.provenance.get("version", ""),
            "problems": self.problems,
            "notes": self.notes,
            "marks": [vars(gate) for _, gate in sorted(self.marks.items(), key=lambda item: item[1].begin_ns)],
        }


def inspect(paths: Sequence[Path]) -> FlightReport:
    """Read every byte of a flight, on all the disks given, and check it.

    Every chunk's CRC, every summary, each frame's identity (sequence, Frame and Image agree), and the books: for each
    camera each trigger index of the board's range is recorded once or lost once, never both, never neither.

    Raises:
        RecordingError: there is nothing to read.
        UsageError: the folders hold more than one flight.
    """
    report = FlightReport(find_folders(paths))
    _demand_one_flight(report.folders)
    pulses: dict[int, Trigger] = {}
    ends: list[dict[str, str]] = []
    books = OtherBooks()
    for folder in report.folders:
        for path in sorted(folder.glob("*.mcap")):
            try:
                found, messages = scan(path)
            except RecordingError as error:
                report.problems.append(str(error))
                continue
            for message in messages:
                _take(report, path, message, pulses)
                books.take(path, message.topic)
            report.files.append(found)
            report.problems += [f"{path}: {problem}" for problem in found.problems]
            if "wingshape_end" in found.metadata:
                ends.append(found.metadata["wingshape_end"])
                books.close(path, found.metadata["wingshape_end"])
            report.provenance = report.provenance or found.provenance
    _check_sides(report)
    _check_books(report, pulses, ends)
    report.problems += books.problems
    report.notes += books.notes
    return report


def _take(report: FlightReport, path: Path, message: ScannedMessage, pulses: dict[int, Trigger]) -> None:
    try:
        if message.topic == TRIGGER_TOPIC:
            pulse = Trigger.decode(message.data)
            pulses[pulse.index] = pulse
        elif message.topic == GATE_TOPIC:
            gate = Gate.decode(message.data)
            if gate.end_ns or (gate.name, gate.begin_ns) not in report.marks:
                report.marks[gate.name, gate.begin_ns] = gate
        elif message.topic == LOSS_TOPIC:
            loss = Loss.decode(message.data)
            _camera(report, loss.side, loss.camera).lost_indices[loss.trigger_index] = loss
        elif message.topic.endswith("/image_raw"):
            _, side, name, _ = message.topic.split("/")
            image = decode_image(message.data)
            camera = _camera(report, side, name)
            camera.width, camera.height = image.width, image.height
            if message.sequence in camera.indices:
                report.problems.append(f"{path}: {side}/{name} trigger {message.sequence} is recorded twice")
            camera.indices.add(message.sequence)
            camera.recorded += 1
        elif message.topic.endswith("/frame"):
            frame = Frame.decode(message.data)
            if frame.trigger_index & 0xFFFFFFFF != message.sequence or frame.trigger_time_ns != message.publish_ns:
                report.problems.append(
                    f"{path}: {message.topic} trigger {message.sequence}: Frame and Message disagree"
                )
    except (ValueError, struct.error) as error:
        report.problems.append(f"{path}: {message.topic} sequence {message.sequence} cannot be decoded: {error}")


def _camera(report: FlightReport, side: str, name: str) -> CameraReport:
    return report.cameras.setdefault(f"{side}/{name}", CameraReport())


def _demand_one_flight(folders: Sequence[Path]) -> None:
    flights: dict[str, Path] = {}
    for path in (path for folder in folders for path in sorted(folder.glob("*.mcap"))):
        with contextlib.suppress(RecordingError):
            found, messages = scan(path)
            next(messages, None)  # the provenance stands before the first message
            if "flight_id" in found.provenance:
                flights.setdefault(found.provenance["flight_id"], path.parent)
    if len(flights) > 1:
        where = ", ".join(str(folder) for folder in flights.values())
        raise UsageError(f"these folders hold {len(flights)} different flights ({where}): name those of one flight")


def _check_sides(report: FlightReport) -> None:
    expected = set(report.provenance.get("cameras", "").split())
    for name in sorted(expected):
        if name.split("/")[0] not in report.sides:
            report.problems.append(f"{name}: the folder of its disk was not given: name it too")
        else:
            report.cameras.setdefault(name, CameraReport())


def _check_books(report: FlightReport, pulses: dict[int, Trigger], ends: list[dict[str, str]]) -> None:
    report.triggers_reported = len(pulses)
    if pulses:
        report.first_trigger_ns = pulses[min(pulses)].reported_time_ns
        report.last_trigger_ns = pulses[max(pulses)].reported_time_ns
    first, after = _board_range(report, pulses, ends)
    report.first_index, report.next_index, report.triggers = first, after, after - first
    unreported = report.triggers - sum(1 for index in pulses if first <= index < after)
    if unreported:
        report.notes.append(f"{unreported} triggers were not reported by the board: their times are interpolated")
    for name, camera in sorted(report.cameras.items()):
        camera.lost = dict(Counter(loss.stage for loss in camera.lost_indices.values()))
        for index in range(first, after):
            if (index in camera.indices) + (index in camera.lost_indices) != 1:
                state = "both recorded and lost" if index in camera.indices else "neither recorded nor booked as lost"
                report.problems.append(f"{name} trigger {index} is {state}")
        strays = [index for index in camera.indices if not first <= index < after]
        if strays:
            report.problems.append(f"{name}: {len(strays)} frames of triggers that the board never gave")


def _board_range(report: FlightReport, pulses: dict[int, Trigger], ends: list[dict[str, str]]) -> tuple[int, int]:
    """First and one-past-last trigger index by the board's final count, else by its reports."""
    try:
        first, after = int(ends[0]["first_index"]), int(ends[0]["next_index"])
        counted_from = int(ends[0].get("counted_from", first))
        resets = int(ends[0].get("board_resets", 0))
        edges = int(ends[0]["counter_end"]) - int(ends[0]["counter_begin"])
        reported = int(ends[0]["triggers_reported"])
    except (IndexError, KeyError, ValueError):
        report.problems.append("no file has the board's final count: the recording was not closed")
        seen = {*pulses, *(index for camera in report.cameras.values() for index in camera.indices)}
        return min(seen, default=0), max(seen, default=-1) + 1
    if edges != after - counted_from:
        report.problems.append(
            f"since trigger {counted_from} the board's counter went on by {edges}, its index by {after - counted_from}"
        )
    if resets:
        report.notes.append(
            f"the board was reset {resets} times, the last time before trigger {counted_from}: of the triggers before, "
            "those are counted that it had reported or that frames have shown"
        )
    if reported != len(pulses):
        report.problems.append(f"{reported} /trigger messages were recorded, {len(pulses)} are in the files")
    if ends[0].get("board_confirmed") != "true":
        report.notes.append("the board could not be asked for its final count: the last triggers may be missing")
    return first, after
