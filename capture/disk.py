"""The disk as the recorder sees it: files written once, in order, by O_DIRECT where the file system can.

The recorder is given a ``Disk``; the system's is here, simulated ones (rates, stalls, faults) are in ``hw_sim.disk``.
"""

import ctypes
import errno
import fcntl
import os
from collections import deque
from pathlib import Path
from typing import Protocol

from capture.errors import UsageError

_KEEP_SIZE = 1  # FALLOC_FL_KEEP_SIZE, linux/falloc.h
_SYNC_WAIT_BEFORE, _SYNC_WRITE, _SYNC_WAIT_AFTER = 1, 2, 4  # sync_file_range(2)
_WRITE_BACK_BEHIND = 8  # writes that may be dirty in the page cache before the oldest is waited for
_LIBC = ctypes.CDLL(None, use_errno=True)


class DiskFile(Protocol):
    """A file being written. One thread. Methods raise ``OSError`` as the system does."""

    direct: bool  # every write's address, offset and length must be whole pages

    def write(self, data: memoryview) -> int:
        """Append; how many bytes were taken (fewer: a short write)."""

    def cut(self, size: int) -> None:
        """Forget everything from ``size`` on; writing goes on there."""

    def end_direct(self) -> None:
        """From here on writes need not be whole pages."""

    def sync(self) -> None:
        """Wait until everything written is on the disk and would survive a power cut."""

    def close(self) -> None:
        """Let go. Safe to call twice."""


class Disk(Protocol):
    """Where a side's files go."""

    def make_folder(self, folder: Path) -> None:
        """Make a new folder in an existing one. ``UsageError`` when it exists, ``OSError`` when the disk refuses."""

    def create(self, path: Path, mode: str, preallocate_bytes: int) -> DiskFile:
        """A new file, for which space is taken ``preallocate_bytes`` at a time (0: as it comes).

        ``mode`` is ``direct``, ``buffered`` (page cache, write-back bounded), ``auto`` (direct where the file system
        can), or ``plain`` (page cache, as it comes: for comparison).
        """

    def free_bytes(self, folder: Path) -> int:
        """Room left for us."""

    def write_text(self, path: Path, text: str) -> None:
        """Write a small file, whole or not at all."""


class SystemDisk:
    """The operating system's file systems."""

    def make_folder(self, folder: Path) -> None:
        """Make a new folder; recordings are never written over."""
        if folder.exists():
            raise UsageError(f"{folder}: exists already and is not written over: choose another flight name")
        folder.mkdir()  # not its parents: a disk that is not mounted must not be recorded beside

    def create(self, path: Path, mode: str, preallocate_bytes: int) -> DiskFile:
        """A new file. Preallocation is asked for, not demanded: not every file system can."""
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
        file: PlainFile
        if mode == "plain":
            file = PlainFile(os.open(path, flags, 0o644))
        elif mode == "buffered":
            file = BufferedFile(os.open(path, flags, 0o644))
        else:
            try:
                file = DirectFile(os.open(path, flags | os.O_DIRECT, 0o644))
            except OSError as error:
                if mode == "direct" or error.errno != errno.EINVAL:
                    raise
                path.unlink(missing_ok=True)
                file = BufferedFile(os.open(path, flags, 0o644))
        file.preallocate_bytes = preallocate_bytes
        return file

    def free_bytes(self, folder: Path) -> int:
        """Bytes free to an unprivileged user."""
        space = os.statvfs(folder)
        return space.f_bavail * space.f_frsize

    def write_text(self, path: Path, text: str) -> None:
        """Write beside, sync, rename."""
        beside = path.with_suffix(".tmp")
        with beside.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)


class PlainFile:
    """Through the page cache as the kernel likes. Blocks preallocated beyond the end are given back at close."""

    direct = False

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        self.preallocate_bytes = 0
        self._size = 0
        self._allocated = 0

    def write(self, data: memoryview) -> int:
        """Append."""
        if self.preallocate_bytes and self._size + len(data) > self._allocated:
            length = max(self.preallocate_bytes, len(data))
            _LIBC.fallocate(self.descriptor, _KEEP_SIZE, ctypes.c_long(self._allocated), ctypes.c_long(length))
            self._allocated += length
        done = os.write(self.descriptor, data)
        self._size += done
        return done

    def cut(self, size: int) -> None:
        """ftruncate(2) and seek."""
        os.ftruncate(self.descriptor, size)
        os.lseek(self.descriptor, size, os.SEEK_SET)
        self._size = size

    def end_direct(self) -> None:
        """Nothing to end."""

    def sync(self) -> None:
        """fdatasync(2)."""
        os.fdatasync(self.descriptor)

    def close(self) -> None:
        """Give back what was preallocated and close."""
        if self.descriptor >= 0:
            descriptor, self.descriptor = self.descriptor, -1
            try:
                os.ftruncate(descriptor, self._size)
            finally:
                os.close(descriptor)


class DirectFile(PlainFile):
    """By O_DIRECT: from the caller's memory to the device, past the page cache."""

    direct = True

    def end_direct(self) -> None:
        """Drop O_DIRECT for a tail that is no multiple of a page."""
        flags = fcntl.fcntl(self.descriptor, fcntl.F_GETFL)
        fcntl.fcntl(self.descriptor, fcntl.F_SETFL, flags & ~os.O_DIRECT)
        self.direct = False


class BufferedFile(PlainFile):
    """Through the page cache, with bounded write-back.

    The kernel would collect gigabytes of dirty pages and then stall every writer at once; instead each write is started
    towards the disk at once, and the one ``_WRITE_BACK_BEHIND`` before it is waited for and dropped from the cache.
    """

    def __init__(self, descriptor: int) -> None:
        super().__init__(descriptor)
        self._dirty: deque[tuple[int, int]] = deque()

    def write(self, data: memoryview) -> int:
        """Append, start write-back, and wait for an older write."""
        at = self._size
        done = super().write(data)
        _sync_range(self.descriptor, at, done, _SYNC_WRITE)
        self._dirty.append((at, done))
        if len(self._dirty) > _WRITE_BACK_BEHIND:
            at, length = self._dirty.popleft()
            _sync_range(self.descriptor, at, length, _SYNC_WAIT_BEFORE | _SYNC_WRITE | _SYNC_WAIT_AFTER)
            os.posix_fadvise(self.descriptor, at, length, os.POSIX_FADV_DONTNEED)
        return done


def _sync_range(descriptor: int, at: int, length: int, flags: int) -> None:
    """sync_file_range(2). A file system that has none (EINVAL, ENOSYS) is left to the kernel's own write-back."""
    failed = _LIBC.sync_file_range(descriptor, ctypes.c_long(at), ctypes.c_long(length), ctypes.c_uint(flags))
    code = ctypes.get_errno() if failed else 0
    if code not in (0, errno.EINVAL, errno.ENOSYS, errno.ESPIPE):
        raise OSError(code, os.strerror(code))
