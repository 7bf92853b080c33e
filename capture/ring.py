"""The ring: preallocated, page-aligned, pre-touched slots that a frame lands in once and leaves once."""

import ctypes
import mmap
import threading
from collections import deque
from pathlib import Path

from capture.errors import UsageError

PAGE = mmap.PAGESIZE


class Ring:
    """``slots`` buffers of ``slot_bytes`` for one camera. Thread-safe; never blocks.

    A slot is free, or owned by exactly one of driver, read thread and write thread.
    """

    def __init__(self, slots: int, slot_bytes: int, lock_memory: bool) -> None:
        if slots < 1 or slot_bytes < 1 or slot_bytes % PAGE:
            raise ValueError(f"a ring needs slots of whole pages, not {slots} of {slot_bytes} bytes")
        self.slots = slots
        self.slot_bytes = slot_bytes
        self._memory = mmap.mmap(-1, slots * slot_bytes)
        self._view = memoryview(self._memory)
        self.locked = lock_memory and _lock(self._memory)
        for at in range(0, len(self._memory), PAGE):  # touch every page now, not when a frame arrives
            self._memory[at] = 0
        self._free = deque(range(slots))
        self._mutex = threading.Lock()
        self.high_water = 0

    def slot(self, index: int) -> memoryview:
        """The memory of a slot."""
        return self._view[index * self.slot_bytes : (index + 1) * self.slot_bytes]

    def take(self) -> int | None:
        """A free slot, or None when there is none."""
        with self._mutex:
            if not self._free:
                return None
            slot = self._free.popleft()
            self.high_water = max(self.high_water, self.slots - len(self._free))
            return slot

    def give_back(self, slot: int) -> None:
        """The slot is free again."""
        with self._mutex:
            self._free.append(slot)

    @property
    def free(self) -> int:
        """How many slots are free now."""
        return len(self._free)

    @property
    def in_use(self) -> int:
        """How many slots are not free now, the driver's included."""
        return self.slots - len(self._free)


def check_memory(need_bytes: int) -> None:
    """Refuse to allocate what is not there, before the system kills somebody for it.

    Raises:
        UsageError: more than the memory that is available; the message has both figures.
    """
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        free_bytes = next(1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable"))
    except (OSError, StopIteration):
        return
    if need_bytes > free_bytes:
        raise UsageError(
            f"the rings need {need_bytes / 1e9:.1f} GB, {free_bytes / 1e9:.1f} GB of memory are available: "
            "lower ring.stall_s, the rate or the image size"
        )


def _lock(memory: mmap.mmap) -> bool:
    """Keep the pages in RAM where the system allows it; False where RLIMIT_MEMLOCK forbids."""
    libc = ctypes.CDLL(None, use_errno=True)
    anchor = ctypes.c_char.from_buffer(memory)
    try:
        done: int = libc.mlock(ctypes.c_void_p(ctypes.addressof(anchor)), ctypes.c_size_t(len(memory)))
    finally:
        del anchor  # or the map can never be closed
    return done == 0
