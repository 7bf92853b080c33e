"""Byte ranges of files to memory in few large reads: from the page cache where they are in it, else by O_DIRECT.

A read through the cache that has to come from the disk costs ten times the processor time of one past it.
"""

import contextlib
import ctypes
import mmap
import os
from bisect import bisect_right
from collections.abc import Iterable
from pathlib import Path

import numpy as np

PAGE = mmap.PAGESIZE
HUGE_PAGE = 2 * 1024 * 1024
GAP_BYTES = 256 * 1024  # less between two ranges is read with them
MOST_BYTES = 64 * 1024 * 1024  # of one read
ASKED = 5  # pages of a range, to know whether it is in the cache,
CACHED = 0.8  # and the share of them that are where it is
_LIBC = ctypes.CDLL(None, use_errno=True)
_LIBC.mincore.argtypes = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_char_p

Range = tuple[str, int, int]
"""path, first byte, number of bytes"""


class Spans:
    """Holds the ranges that were loaded last. Each thread needs its own."""

    def __init__(self) -> None:
        self._memory = _memory(PAGE)
        self._held: dict[
            str, list[tuple[int, int, int]]
        ] = {}  # path → (first byte, end, place in memory), by the first

    def load(self, ranges: Iterable[Range]) -> None:
        """Read ``ranges``, forgetting the last ones. What cannot be read is not held; nothing is raised."""
        wanted = _merged(ranges)
        needed = sum(_pages(at, end)[1] for _, at, end in wanted)
        self._held = {}
        if needed > len(self._memory):
            self._memory = _memory(needed)  # views of the old one stay valid
        view = memoryview(self._memory)
        place = 0
        for path, at, end in wanted:
            first, size = _pages(at, end)
            count = _read(Path(path), view[place : place + size], first)
            if count > 0:
                self._held.setdefault(path, []).append((first, min(first + count, end), place))
                place += size

    def cached(self, ranges: Iterable[Range]) -> bool:
        """Whether loading ``ranges`` need not wait for the disk."""
        return all(_in_cache(Path(path), *_pages(at, end)) for path, at, end in _merged(ranges))

    def get(self, path: str, at: int, size: int) -> memoryview | None:
        """The bytes of a range that is held, valid until the next ``load``; None if it is not."""
        held = self._held.get(path, [])
        number = bisect_right(held, at, key=lambda span: span[0]) - 1
        if number < 0:
            return None
        first, end, place = held[number]
        if at + size > end:
            return None
        begin = place + at - first
        return memoryview(self._memory)[begin : begin + size]


def _memory(size: int) -> mmap.mmap:
    """Page-aligned, as O_DIRECT wants; in huge pages where the system has them: the processor finds these faster."""
    memory = mmap.mmap(-1, -(-size // HUGE_PAGE) * HUGE_PAGE, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    with contextlib.suppress(OSError):
        memory.madvise(mmap.MADV_HUGEPAGE)
    with contextlib.suppress(OSError):
        memory.madvise(mmap.MADV_DONTFORK)  # a fork during a read by O_DIRECT could lose what is read (open(2))
    return memory


def _merged(ranges: Iterable[Range]) -> list[Range]:
    """(path, first byte, end) of what to read at once, in order."""
    spans: list[Range] = []
    for path, at, size in sorted(ranges):
        if spans:
            last_path, first, end = spans[-1]
            if path == last_path and at - end < GAP_BYTES and at + size - first <= MOST_BYTES:
                spans[-1] = (path, first, max(end, at + size))
                continue
        spans.append((path, at, at + size))
    return spans


def _pages(at: int, end: int) -> tuple[int, int]:
    """First byte and size of the whole pages around a range."""
    first = at // PAGE * PAGE
    return first, -(-(end - first) // PAGE) * PAGE


def _read(path: Path, buffer: memoryview, at: int) -> int:
    """Bytes read at ``at``, fewer at the file's end or where the disk fails."""
    try:
        plain = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return 0
    descriptor = plain
    done = 0
    try:
        if not _is_cached(plain, at, len(buffer)):
            try:
                descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_DIRECT)
            except OSError:  # not every file system can
                os.posix_fadvise(plain, at, len(buffer), os.POSIX_FADV_WILLNEED)
        while done < len(buffer):
            count = os.preadv(descriptor, [buffer[done:]], at + done)
            done += count
            if count == 0 or done % PAGE:  # the file's end
                break
    except OSError:
        pass  # whoever wants those bytes reads them again, and says what is wrong
    finally:
        os.close(plain)
        if descriptor != plain:
            os.close(descriptor)
    return done


def _in_cache(path: Path, at: int, size: int) -> bool:
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return True  # nothing to wait for
    try:
        return _is_cached(descriptor, at, size)
    except OSError:
        return False
    finally:
        os.close(descriptor)


def _is_cached(descriptor: int, at: int, size: int) -> bool:
    """Whether a range is in the page cache, by mincore(2) of a few pages spread over it.

    Of files that are not ours, nor ours to write, it cannot be known: they count as not cached.
    """
    status = os.fstat(descriptor)
    size = min(size, status.st_size - at)
    if size <= 0:
        return True
    if status.st_uid != os.geteuid() and not os.access(f"/proc/self/fd/{descriptor}", os.W_OK):
        return False
    with mmap.mmap(descriptor, size, access=mmap.ACCESS_READ, offset=at) as mapped:
        begin = np.frombuffer(mapped, np.uint8).ctypes.data
        resident = ctypes.create_string_buffer(1)
        places = range(0, size, max(PAGE, -(-size // ASKED) // PAGE * PAGE))
        there = 0
        for place in places:
            failed = _LIBC.mincore(begin + place, 1, resident)
            there += not failed and resident.raw[0] & 1
    return there >= CACHED * len(places)
