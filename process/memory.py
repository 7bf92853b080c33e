"""This process and those it started to the memory they take together, proportionally shared (PSS)."""

import contextlib
import os
import threading
from pathlib import Path
from typing import Self

PERIOD_S = 0.5


class MemoryWatch:
    """Samples the memory of this process and its children, and theirs, while it is entered."""

    def __init__(self) -> None:
        self.peak_bytes = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="memory-watch", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while True:
            self.peak_bytes = max(self.peak_bytes, memory_bytes(os.getpid()))
            if self._stop.wait(PERIOD_S):
                return


def memory_bytes(process: int) -> int:
    """Proportional set size of a process and its descendants; 0 of one that has ended, or is not ours to see."""
    children: dict[int, list[int]] = {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            with contextlib.suppress(OSError):
                fields = (folder / "stat").read_text().rpartition(")")[2].split()  # the name may hold spaces
                children.setdefault(int(fields[1]), []).append(int(folder.name))
    total, family = 0, [process]
    while family:
        one = family.pop()
        total += _own_bytes(one)
        family += children.get(one, [])
    return total


def _own_bytes(process: int) -> int:
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{process}/smaps_rollup").read_text().splitlines():
            if line.startswith("Pss:"):
                return 1024 * int(line.split()[1])
    return 0
