"""A flight's folders: one a disk, found from a path, described by the metadata.yaml that rosbag2 expects."""

from collections.abc import Sequence
from pathlib import Path

from capture.disk import Disk
from capture.errors import DiskError, RecordingError
from capture.segment import SegmentWriter


def find_folders(paths: Sequence[Path]) -> list[Path]:
    """The flight folders (those that hold .mcap files) at or up to two levels below the given paths.

    Raises:
        RecordingError: a path does not exist or holds no recording.
    """
    found: list[Path] = []
    for path in paths:
        if not path.exists():
            raise RecordingError(f"{path}: no such folder: give the folder of a flight (on each disk)")
        folders = [
            folder
            for folder in (path, *sorted(path.glob("*/")), *sorted(path.glob("*/*/")))
            if next(folder.glob("*.mcap"), None) is not None
        ]
        if not folders:
            raise RecordingError(
                f"{path}: no recording (*.mcap) in this folder: give the folder of a flight (on each disk)"
            )
        found.extend(folder for folder in folders if folder not in found)
    return found


def free_name(name: str, disks: Sequence[Path]) -> str:
    """``name``, or ``name_2``, ``name_3`` … where a flight of that name is on a disk already.

    A clock that was never set gives the same names after every start.
    """
    free, number = name, 1
    while any((disk / free).exists() for disk in disks):
        number += 1
        free = f"{name}_{number}"
    return free


def make_folder(disk: Disk, parent: Path, flight: str, side: str) -> Path:
    """A new flight's folder on a side's disk.

    Raises:
        DiskError: the disk cannot be written.
    """
    try:
        disk.make_folder(parent / flight)
    except OSError as error:
        raise DiskError(
            f"{parent}: cannot be written ({error.strerror}): mount the disk or make this folder, "
            f"or correct `disks.{side}`"
        ) from error
    return parent / flight


def metadata_yaml(segments: Sequence[SegmentWriter]) -> str:
    """The text of ``metadata.yaml`` (rosbag2's, version 5) for the closed segments of one folder."""
    first = min((s.first_log_ns for s in segments if s.first_log_ns), default=0)
    last = max((s.last_log_ns for s in segments), default=first)
    counts: dict[tuple[str, str], int] = {}
    for segment in segments:
        for topic, type_name, count in segment.topics():
            counts[topic, type_name] = counts.get((topic, type_name), 0) + count
    lines = [
        "rosbag2_bagfile_information:",
        "  version: 5",
        "  storage_identifier: mcap",
        "  duration:",
        f"    nanoseconds: {last - first}",
        "  starting_time:",
        f"    nanoseconds_since_epoch: {first}",
        f"  message_count: {sum(counts.values())}",
        "  topics_with_message_count:",
    ]
    for (topic, type_name), count in sorted(counts.items()):
        lines += [
            "    - topic_metadata:",
            f"        name: {topic}",
            f"        type: {type_name}",
            "        serialization_format: cdr",
            '        offered_qos_profiles: ""',
            f"      message_count: {count}",
        ]
    lines += ['  compression_format: ""', '  compression_mode: ""', "  relative_file_paths:"]
    lines += [f"    - {segment.path.name}" for segment in segments]
    lines += ["  files:"]
    for segment in segments:
        lines += [
            f"    - path: {segment.path.name}",
            "      starting_time:",
            f"        nanoseconds_since_epoch: {segment.first_log_ns}",
            "      duration:",
            f"        nanoseconds: {max(0, segment.last_log_ns - segment.first_log_ns)}",
            f"      message_count: {sum(segment.message_counts.values())}",
        ]
    return "\n".join(lines) + "\n"
