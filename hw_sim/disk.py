"""Simulated disks behind ``capture.disk.Disk``: one with a rate and stalls, for benchmarks.

Fault model of ``StallingDisk``: a sustained rate; and stalls as SSDs have them (garbage collection, write-back of a
full cache), at exponentially distributed intervals, of log-normally distributed length. A write that meets a stall
waits for its end. Nothing is kept.
"""

import random
import threading
import time
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class StallModel:
    """A disk in figures. The defaults show what the paper saw: enough rate on average, but not at every moment."""

    rate_mb_s: float = 520.0  # the paper's SSD: sequential write
    stall_every_s: float = 4.0  # mean interval
    stall_median_s: float = 0.12
    stall_sigma: float = 0.9  # of the logarithm; one in a hundred is 8 × the median
    stall_longest_s: float = 1.8
    seed: int = 1


class StallingDisk:
    """A disk of a stated rate and stalls; what is written is counted and forgotten."""

    def __init__(self, model: StallModel) -> None:
        self._model = model
        self._files = 0

    def make_folder(self, folder: Path) -> None:
        """Nothing to make."""

    def create(self, path: Path, mode: str, preallocate_bytes: int) -> "StallingFile":
        """A new file. The small aux files are written beside the frames and share no stall with them."""
        self._files += 1
        return StallingFile(self._model, self._model.seed * 1000 + self._files)

    def free_bytes(self, folder: Path) -> int:
        """More than enough."""
        return 1 << 50

    def write_text(self, path: Path, text: str) -> None:
        """Forgotten."""


class StallingFile:
    """A file on a stalling disk, as a device of its own."""

    direct = True

    def __init__(self, model: StallModel, seed: int) -> None:
        self._model = model
        self._random = random.Random(seed)
        self._mutex = threading.Lock()
        self._idle_at_s = time.monotonic()
        self._stall_at_s = self._idle_at_s + self._random.expovariate(1 / model.stall_every_s)

    def write(self, data: memoryview) -> int:
        """Take as long as the disk would."""
        with self._mutex:
            begin_s = max(time.monotonic(), self._idle_at_s)
            took_s = len(data) / (self._model.rate_mb_s * 1e6)
            if begin_s >= self._stall_at_s:
                length_s = self._model.stall_median_s * self._random.lognormvariate(0.0, self._model.stall_sigma)
                took_s += min(length_s, self._model.stall_longest_s)
                self._stall_at_s = begin_s + took_s + self._random.expovariate(1 / self._model.stall_every_s)
            self._idle_at_s = begin_s + took_s
        time.sleep(max(0.0, self._idle_at_s - time.monotonic()))
        return len(data)

    def cut(self, size: int) -> None:
        """Nothing is kept anyway."""

    def end_direct(self) -> None:
        """Nothing to end."""

    def sync(self) -> None:
        """Nothing to wait for."""

    def close(self) -> None:
        """Nothing to let go of."""
