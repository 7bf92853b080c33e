"""A damaged or unfinished recording to a whole copy: every complete frame, a loss record for each missing one."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from capture.disk import SystemDisk
from capture.errors import RecordingError
from capture.flight import metadata_yaml
from capture.record import LOSS_TOPIC, Loss, LossStage
from capture.recorder import AUX_CHANNELS
from capture.scan import ScannedMessage, scan
from capture.segment import Channel, SegmentWriter, SmallMessage
from capture.verify import FlightReport, inspect

CAUSE = "not on the disk when the recording was cut or damaged (found by wingcap recover)"


@dataclass
class Recovery:
    """What came back."""

    frames: int = 0
    missing: int = 0
    folders: list[Path] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)  # of the original

    @property
    def clean(self) -> bool:
        """Whether the original was whole."""
        return not self.problems

    def as_dict(self) -> dict[str, Any]:
        """For ``--json``."""
        return {
            "frames_recovered": self.frames,
            "frames_missing": self.missing,
            "clean": self.clean,
            "folders": [str(folder) for folder in self.folders],
            "problems": self.problems,
        }


def recover_flight(paths: Sequence[Path], out: Path) -> Recovery:
    """Copy every complete frame of a flight into ``out``, one folder for each of the original's.

    A frame is complete when its chunk's CRC agrees. Frames of triggers in the board's range that are neither recorded
    nor booked are booked as lost, so that the copy balances; their causes say so.

    Raises:
        RecordingError: there is no recording at all.
        UsageError: ``out`` exists already.
    """
    report = inspect(paths)
    disk = SystemDisk()
    disk.make_folder(out)
    result = Recovery(problems=report.problems)
    losses = _missing(report)
    result.missing = len(losses)
    for number, folder in enumerate(report.folders):
        copy = out / f"{number}_{folder.name}"
        disk.make_folder(copy)
        writers = [
            writer
            for path in sorted(folder.glob("*.mcap"))
            if not path.name.startswith("aux")
            if (writer := _copy_segment(disk, path, copy / path.name)) is not None
        ]
        result.frames += sum(count for w in writers for topic, _, count in w.topics() if topic.endswith("/image_raw"))
        aux = _copy_aux(disk, folder, copy, report, losses)
        disk.write_text(copy / "metadata.yaml", metadata_yaml([*writers, aux]))
        result.folders.append(copy)
    return result


def _missing(report: FlightReport) -> list[Loss]:
    return [
        Loss(index, report.last_trigger_ns, side, camera_name, LossStage.DISK.name.lower(), CAUSE)
        for name, camera in sorted(report.cameras.items())
        for side, camera_name in [name.split("/")]
        if side in report.sides
        for index in range(report.first_index, report.next_index)
        if index not in camera.indices and index not in camera.lost_indices
    ]


def _copy_segment(disk: SystemDisk, path: Path, copy: Path) -> SegmentWriter | None:
    """A closed copy of a segment's good chunks; None when nothing of the file can be read."""
    try:
        found, messages = scan(path)
    except RecordingError:
        return None
    writer: SegmentWriter | None = None
    for _, group in itertools.groupby(messages, key=lambda message: message.chunk_at):
        batch = list(group)
        if writer is None:  # provenance and channels stand before the first chunk
            channels = [Channel(number, topic, found.types[topic]) for number, topic in sorted(found.topics.items())]
            writer = SegmentWriter(disk, copy, channels, _provenance(found.provenance, path), "buffered")
            for name, data in found.attachments:
                writer.attach(name, data, batch[0].log_ns)
        numbers = {topic: number for number, topic in found.topics.items()}
        writer.write_batch([_small(message, numbers[message.topic]) for message in batch if message.topic in numbers])
    if writer is not None:
        writer.close()
    return writer


def _copy_aux(disk: SystemDisk, folder: Path, copy: Path, report: FlightReport, losses: list[Loss]) -> SegmentWriter:
    """A closed aux file with what can be read of the original's, the new losses, and a final count."""
    side = next(iter({path.name.split("_")[0] for path in folder.glob("*.mcap")} & report.sides), "")
    provenance, batches = {**report.provenance, "side": side}, []
    numbers = {channel.topic: channel.id for channel in AUX_CHANNELS}
    for path in sorted(folder.glob("aux_*.mcap")):
        try:
            found, messages = scan(path)
        except RecordingError:
            continue
        for _, group in itertools.groupby(messages, key=lambda message: message.chunk_at):
            batches.append([_small(m, numbers[m.topic]) for m in group if m.topic in numbers and not _back(m, report)])
        provenance = found.provenance or provenance
    writer = SegmentWriter(disk, copy / "aux_0000.mcap", AUX_CHANNELS, _provenance(provenance, folder), "buffered")
    for batch in batches:
        writer.write_batch(batch)
    writer.write_batch(
        [SmallMessage(numbers[LOSS_TOPIC], x.trigger_index, x.time_ns, x.time_ns, x.encode()) for x in losses]
    )
    writer.write_metadata(
        "wingshape_end",
        {
            "first_index": str(report.first_index),
            "next_index": str(report.next_index),
            "counter_begin": "0",
            "counter_end": str(report.next_index - report.first_index),
            "board_confirmed": "false",
            "triggers_reported": str(report.triggers_reported),
        },
    )
    writer.close()
    return writer


def _provenance(original: dict[str, str], path: Path) -> dict[str, str]:
    return {**original, "recovered_from": str(path), "write_mode": "buffered"}


def _back(message: ScannedMessage, report: FlightReport) -> bool:
    """Whether this is the loss record of a frame that is on the disk after all."""
    if message.topic != LOSS_TOPIC:
        return False
    loss = Loss.decode(message.data)
    camera = report.cameras.get(f"{loss.side}/{loss.camera}")
    return camera is not None and loss.trigger_index in camera.indices


def _small(message: ScannedMessage, channel: int) -> SmallMessage:
    return SmallMessage(channel, message.sequence, message.log_ns, message.publish_ns, bytes(message.data))
