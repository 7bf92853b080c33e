"""Frames that have been written, to the preview files that others look at: at most a few a second, never in the way.

A frame's slot goes from the write thread to this one, and from here back to its ring. So a frame is copied once, by
pwrite(2) without the GIL, and the driver waits for nothing: a slot is only borrowed while the ring is mostly empty,
one a camera at a time. A frame that cannot be had is not shown.
"""

import contextlib
import os
import queue
from collections.abc import Iterable
from pathlib import Path

from capture.clock import Clock
from capture.health import PREVIEW_HEADER, PREVIEW_MAGIC, preview_path
from capture.ledger import Place
from capture.recorder import FrameItem
from capture.worker import Worker

_SPARE_SHARE = 0.5  # of a ring's slots that must be free before one is borrowed


class PreviewWriter(Worker):
    """The thread that writes previews. ``offer`` is called by write threads."""

    def __init__(
        self, folder: Path, places: Iterable[Place], size: tuple[int, int], rate_hz: float, clock: Clock
    ) -> None:
        """Make the files.

        Args:
            folder: where they go; on a tmpfs.
            places: the cameras.
            size: height and width.
            rate_hz: previews a second and camera.
            clock: for when the next is due.

        Raises:
            OSError: the files cannot be made.
        """
        super().__init__("preview")
        self.skipped = 0  # borrowed, but the file did not take it
        self._height, self._width = size
        self._period_s = 1.0 / rate_hz
        self._clock = clock
        self._items: queue.SimpleQueue[FrameItem] = queue.SimpleQueue()
        self._sequence = 0
        self._due_s: dict[Place, float] = {}
        self._borrowed: set[Place] = set()
        self._files: dict[Place, int] = {}
        flags = os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC
        try:
            for place in places:
                self._files[place] = os.open(preview_path(folder, "/".join(place)), flags, 0o644)
                self._due_s[place] = 0.0
        except OSError:
            self._close()
            raise

    def offer(self, item: FrameItem) -> bool:
        """Take over the slot of a frame that the disk is done with; False: the caller keeps it. Never blocks."""
        place, now_s = item.place, self._clock.monotonic_s()
        if now_s < self._due_s[place] or place in self._borrowed or self.stop_requested.is_set():
            return False
        if item.ring.free < _SPARE_SHARE * item.ring.slots:
            return False
        self._due_s[place] = now_s + self._period_s
        self._borrowed.add(place)
        self._items.put(item)
        return True

    def work(self) -> None:
        """Write until asked to stop; every borrowed slot is given back."""
        try:
            while not self.stop_requested.is_set():
                with contextlib.suppress(queue.Empty):
                    self._show(self._items.get(timeout=0.1))
        finally:
            while not self._items.empty():
                self._give_back(self._items.get())
            self._close()

    def _show(self, item: FrameItem) -> None:
        try:
            self._write(item)
        except OSError:
            self.skipped += 1
        finally:
            self._give_back(item)

    def _give_back(self, item: FrameItem) -> None:
        item.ring.give_back(item.slot)
        self._borrowed.discard(item.place)

    def _write(self, item: FrameItem) -> None:
        file = self._files[item.place]
        head = (
            self._width,
            self._height,
            item.index,
            item.sealed.publish_ns,
            round(self._clock.monotonic_s() * 1e9),
        )
        self._sequence += 2
        os.pwrite(file, PREVIEW_HEADER.pack(PREVIEW_MAGIC, self._sequence - 1, *head), 0)
        done = os.pwrite(file, item.sealed.pixels, PREVIEW_HEADER.size)
        if done == len(item.sealed.pixels):
            os.pwrite(file, PREVIEW_HEADER.pack(PREVIEW_MAGIC, self._sequence, *head), 0)
        else:
            self.skipped += 1

    def _close(self) -> None:
        while self._files:
            os.close(self._files.popitem()[1])
