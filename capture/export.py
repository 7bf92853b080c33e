"""A flight on the aircraft's disks to a checked copy elsewhere: every file hashed, read back from the disk, listed.

The copy of each of the flight's folders is ``DEST/<flight>/<name of its disk>/``; ``SHA256SUMS`` beside them is what
``sha256sum --check`` reads. A file is listed only once its copy has been read back and agrees. An interrupted export
goes on where it stopped. The source is only read.
"""

import hashlib
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from capture.errors import CaptureError, DiskError, RecordingError, UsageError
from capture.flight import find_folders
from capture.lock import recorder_at

SUMS = "SHA256SUMS"
PART = ".part"
_BLOCK_BYTES = 8 << 20
_ROOM_BYTES = 64 << 20  # left free beyond the copy

Progress = Callable[[int], None]
"""Called with the bytes newly copied and checked."""


@dataclass
class Export:
    """What was copied."""

    folder: Path
    files: int = 0  # copied and read back now
    bytes: int = 0
    kept: int = 0  # were there already, from an earlier export
    names: list[str] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        """For ``--json``."""
        return {
            "folder": str(self.folder),
            "files_copied": self.files,
            "bytes_copied": self.bytes,
            "files_already_there": self.kept,
            "files": self.names,
        }


@dataclass(frozen=True)
class _Item:
    source: Path
    name: str  # below the export's folder


def export_flight(paths: Sequence[Path], destination: Path, progress: Progress = lambda _: None) -> Export:
    """Copy a flight's folders to ``destination`` (an existing folder) and check the copy.

    Raises:
        RecordingError: there is no recording, or the folders are of different flights.
        UsageError: no such destination, or it lies within the flight.
        CaptureError: a recorder is writing to one of these disks: it must not be slowed down.
        DiskError: not enough room, or a copy that does not read back as it was written.
    """
    folders = find_folders([path.resolve() for path in paths])
    if len({folder.name for folder in folders}) > 1:
        names = ", ".join(sorted({folder.name for folder in folders}))
        raise RecordingError(f"these are different flights ({names}): export one at a time")
    destination = destination.resolve()
    if not destination.is_dir():
        raise UsageError(f"{destination}: no such folder: mount the disk to copy to, and name a folder on it")
    if any(destination.is_relative_to(folder) for folder in folders):
        raise UsageError(f"{destination}: lies within the flight itself: give another folder")
    out = destination / folders[0].name
    items = list(_items(folders))
    if out in folders:
        raise UsageError(f"{out}: is the flight itself: give another folder")
    out.mkdir(exist_ok=True)
    sums = _read_sums(out / SUMS)
    result = Export(out, names=[item.name for item in items])
    missing = [item for item in items if not _there(item, out, sums)]
    result.kept = len(items) - len(missing)
    _check_room(missing, out)
    for item in missing:
        _refuse_beside_recorder(folders)
        sums[item.name] = _copy(item, out, progress)
        _write_sums(out / SUMS, sums)
        result.files += 1
        result.bytes += item.source.stat().st_size
    return result


def export_bytes(paths: Sequence[Path]) -> int:
    """Bytes that an export of these folders has to copy and read back, for a progress bar."""
    return 2 * sum(path.stat().st_size for folder in find_folders(paths) for path in folder.iterdir() if path.is_file())


def _items(folders: Sequence[Path]) -> Iterator[_Item]:
    """Every file of the flight, each folder under its disk's name."""
    taken: set[str] = set()
    for folder in folders:
        place = folder.parent.name or "disk"
        while place in taken:
            place += "_2"
        taken.add(place)
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                yield _Item(path, f"{place}/{path.relative_to(folder)}")


def _there(item: _Item, out: Path, sums: dict[str, str]) -> bool:
    """Whether an earlier export has copied and checked this file, and the source is still the same."""
    copy = out / item.name
    if item.name not in sums or not copy.is_file():
        return False
    source, there = item.source.stat(), copy.stat()
    return (source.st_size, source.st_mtime_ns) == (there.st_size, there.st_mtime_ns)


def _check_room(items: Sequence[_Item], out: Path) -> None:
    begun = sum(path.stat().st_size for path in out.rglob(f"*{PART}"))
    needed = sum(item.source.stat().st_size for item in items) - begun + _ROOM_BYTES * bool(items)
    free = shutil.disk_usage(out).free
    if needed > free:
        raise DiskError(
            f"{out}: the copy needs {needed / 1e9:.2f} GB, {free / 1e9:.2f} GB are free: make room or use another disk",
        )


def _refuse_beside_recorder(folders: Sequence[Path]) -> None:
    for folder in folders:
        if recorder_at(folder.parent) is not None:
            raise CaptureError(
                f"{folder.parent}: a recorder is writing to this disk and must not be slowed down: stop it "
                "(`systemctl stop wingcap`) and run this again; what is copied so far is kept"
            )


def _copy(item: _Item, out: Path, progress: Progress) -> str:
    """Copy one file, or the rest of it, and read it back; its SHA-256."""
    copy = out / item.name
    copy.parent.mkdir(parents=True, exist_ok=True)
    part = copy.with_name(copy.name + PART)
    before = item.source.stat()
    with item.source.open("rb") as source, part.open("a+b") as target:
        digest = _already(source, target, progress)
        while block := source.read(_BLOCK_BYTES):
            target.write(block)
            digest.update(block)
            progress(len(block))
        target.flush()
        os.fsync(target.fileno())
        os.posix_fadvise(target.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)  # so that the disk is read, not memory
        read_back = _digest(target, progress)
    if (item.source.stat().st_size, item.source.stat().st_mtime_ns) != (before.st_size, before.st_mtime_ns):
        raise CaptureError(f"{item.source}: has changed while it was copied: end the recording, then run this again")
    if read_back != digest.hexdigest():
        part.unlink()
        raise DiskError(f"{copy}: does not read back as it was written: do not trust this disk; use another")
    os.utime(part, ns=(before.st_atime_ns, before.st_mtime_ns))
    part.replace(copy)
    _sync_folder(copy.parent)
    return read_back


def _already(source: BinaryIO, target: BinaryIO, progress: Progress) -> "hashlib._Hash":
    """Compare what an interrupted copy left with the source, cut it off where they differ, and hash what agrees."""
    digest = hashlib.sha256()
    target.seek(0)
    agreed = 0
    while block := target.read(_BLOCK_BYTES):
        original = source.read(len(block))
        if original != block:
            break
        digest.update(block)
        agreed += len(block)
        progress(len(block))
    target.truncate(agreed)
    source.seek(agreed)
    target.seek(agreed)
    return digest


def _digest(file: BinaryIO, progress: Progress) -> str:
    digest = hashlib.sha256()
    file.seek(0)
    while block := file.read(_BLOCK_BYTES):
        digest.update(block)
        progress(len(block))
    return digest.hexdigest()


def _read_sums(path: Path) -> dict[str, str]:
    if not path.exists():
        return {}
    sums = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        digest, _, name = line.partition("  ")
        if len(digest) != 64 or not name:
            raise RecordingError(f"{path}: not a list of checksums: remove it, and everything is copied anew")
        sums[name] = digest
    return sums


def _write_sums(path: Path, sums: dict[str, str]) -> None:
    beside = path.with_name(path.name + PART)
    with beside.open("w", encoding="utf-8") as file:
        file.writelines(f"{digest}  {name}\n" for name, digest in sorted(sums.items()))
        file.flush()
        os.fsync(file.fileno())
    beside.replace(path)
    _sync_folder(path.parent)


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
