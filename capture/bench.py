"""The recording path under load: the paper's Table 8 and beyond, as rows of dropped frames and write latencies.

The cameras of the bench cost nothing: their frames lie in the buffers already, as if a USB controller had put them
there, and come due by the clock. So what is measured is the recorder.

Modes
    ``monolithic``  the paper's: one thread, capture and write one after the other, no buffer but the driver's own two
    ``ring``        one thread as before, but the driver has the whole ring to fill
    ``threaded``    ours: a read thread a camera, a write thread a disk, ring, CRC, index, ledger
"""

import contextlib
import importlib
import itertools
import mmap
import shutil
import statistics
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from capture.bench_rig import BenchCase, ClockedCamera, ClockedTriggers
from capture.clock import Clock, SystemClock
from capture.config import DiskConfig, driver_buffers
from capture.disk import Disk, DiskFile, SystemDisk
from capture.errors import DiskError, UsageError
from capture.grabber import GRAB_TIMEOUT_S
from capture.lane import Lane, LaneParts, check_ring_memory, make_lane
from capture.ledger import Ledger
from capture.record import CAMERAS, SIDES
from capture.recorder import PREALLOCATE_BYTES
from capture.worker import share_interpreter

MONOLITHIC_BUFFERS = 2
SEGMENT_MB = 900.0
SEGMENTS_KEPT = 3  # a side; the oldest are removed, so that no run needs more than 8 GB
DEFAULT_SECONDS = 20.0
CEILING_PAIRS = 16  # even: what runs second in a pair finds the disk in another state
START_AFTER_NS = 300_000_000
MODES = ("monolithic", "ring", "threaded")


@dataclass
class BenchRow:
    """What one run gave."""

    mode: str
    width: int
    height: int
    rate_hz: float
    offered_mb_s: float
    frames: int
    dropped: int
    dropped_percent: float
    write_ms: dict[str, float]
    ring_high_water: int
    ring_slots: int
    cpu_cores: float
    seconds: float
    latencies_ms: list[float] = field(default_factory=list)
    ring_depth: list[tuple[float, int]] = field(default_factory=list)  # (seconds, slots in use)

    def as_dict(self) -> dict[str, Any]:
        """For ``--json``, without the traces."""
        row = asdict(self)
        del row["latencies_ms"], row["ring_depth"]
        return row


class BoundedDisk(SystemDisk):
    """The system's disk, on which only the newest segments of a side are kept."""

    def __init__(self) -> None:
        self._segments: dict[str, deque[Path]] = {}

    def create(self, path: Path, mode: str, preallocate_bytes: int) -> DiskFile:
        """A new file; the oldest of its kind gives way."""
        kept = self._segments.setdefault(f"{path.parent}/{path.name.rsplit('_', 1)[0]}", deque())
        kept.append(path)
        if len(kept) > SEGMENTS_KEPT:
            kept.popleft().unlink(missing_ok=True)
        return super().create(path, mode, preallocate_bytes)


def bench_cases(mode: str, size: str, rate_hz: float, frames: int) -> list[BenchCase]:
    """The cases that a user's words ask for.

    Raises:
        UsageError: an unknown mode or a size that is none.
    """
    modes = MODES if mode == "all" else (mode,)
    if not set(modes) <= set(MODES):
        raise UsageError(f"--mode {mode}: use one of {', '.join(MODES)} or all")
    cases = []
    for text in ("2080x1552", "1920x1080") if size == "paper" else (size,):
        try:
            width, height = (int(part) for part in text.lower().split("x"))
        except ValueError:
            raise UsageError(f"--size {text}: give width and height, such as 2080x1552") from None
        if not (16 <= width <= 16384 and 16 <= height <= 16384):
            raise UsageError(f"--size {text}: width and height must be 16 to 16384 px")
        cases += [BenchCase(m, width, height, rate_hz, frames or round(DEFAULT_SECONDS * rate_hz)) for m in modes]
    return cases


@contextlib.contextmanager
def bench_target(target: str) -> Iterator[tuple[Path, Callable[[], Disk]]]:
    """A new folder on the target, removed at the end, and a maker of the disk behind it.

    Raises:
        UsageError: the folder does not exist.
    """
    if target == "model":  # loaded by name: the recorder does not know the simulation
        module: Any = importlib.import_module("hw_sim.disk")
        yield Path("model"), lambda: module.StallingDisk(module.StallModel())
        return
    parent = Path("/dev/shm") if target == "memory" else Path(target)
    if not parent.is_dir():
        raise UsageError(f"--target {target}: no such folder; give one on the disk to try, `memory` or `model`")
    with tempfile.TemporaryDirectory(prefix="wingcap-bench-", dir=parent) as folder:
        yield Path(folder), BoundedDisk


def run_case(case: BenchCase, folder: Path, disk: Disk, progress: Callable[[float], None]) -> BenchRow:
    """One row of the table.

    Args:
        case: what to offer.
        folder: where the files go; a new one for each run.
        disk: a real disk or a model of one.
        progress: called with the part done, 0 … 1, about ten times a second.

    Raises:
        DiskError: the disk refuses.
    """
    share_interpreter()
    if case.mode == "threaded":
        return _run_threaded(case, folder, disk, progress)
    return _run_monolithic(case, folder, disk, progress)


def ceiling(case: BenchCase, folder: Path, pairs: int, progress: Callable[[float], None]) -> dict[str, Any]:
    """The highest rate without loss against the raw O_DIRECT rate of the same disk, in alternated pairs.

    Our path gets a frame whenever it has a slot for it; raw is one thread a disk that writes the same number of
    bytes in the same pieces. Both preallocate, pre-touch, and end with fdatasync.

    Returns:
        ``mb_s``, ``raw_direct_mb_s`` (medians), ``ratio`` (median of the pairs' ratios; half of the pairs begin with
        either) and the pairs.
    """
    share_interpreter()
    measured: list[tuple[float, float]] = []
    for number in range(pairs):
        if number % 2:
            raw, ours = _ceiling_raw(case, folder / f"raw_{number}"), _ceiling_ours(case, folder / f"ours_{number}")
        else:
            ours, raw = _ceiling_ours(case, folder / f"ours_{number}"), _ceiling_raw(case, folder / f"raw_{number}")
        measured.append((ours, raw))
        progress((number + 1) / pairs)
    return {
        "mb_s": statistics.median(ours for ours, _ in measured),
        "raw_direct_mb_s": statistics.median(raw for _, raw in measured),
        "ratio": statistics.median(ours / raw for ours, raw in measured),
        "pairs": [{"mb_s": ours, "raw_direct_mb_s": raw} for ours, raw in measured],
    }


def _lanes(case: BenchCase, folder: Path, disk: Disk, clock: Clock) -> tuple[Ledger, list[Lane], list[ClockedCamera]]:
    triggers = ClockedTriggers(0, case.rate_hz)
    places = list(itertools.product(SIDES, CAMERAS))
    ledger = Ledger(places, 0, clock.utc_ns, lambda _: None)
    parts = LaneParts(
        disk=disk,
        disk_config=DiskConfig(left=folder, right=folder, segment_mb=SEGMENT_MB, segment_s=1e9, reserve_mb=100),
        provenance={"flight": "bench"},
        ledger=ledger,
        triggers=triggers,
        clock=clock,
        ring_slots=case.ring_slots,
        driver_buffers=driver_buffers(case.rate_hz),
        lock_memory=True,
    )
    cameras = [ClockedCamera(case, triggers) for _ in places]
    check_ring_memory(len(places), parts.ring_slots, case.width, case.height)
    disk.make_folder(folder)
    lanes = []
    for number, side in enumerate(SIDES):
        disk.make_folder(folder / side)
        pair = {name: (cameras[2 * number + k], cameras[2 * number + k].open()) for k, name in enumerate(CAMERAS)}
        lanes.append(make_lane(side, folder / side, pair, parts))
    triggers.start_ns = clock.utc_ns() + START_AFTER_NS  # now that all memory has been touched
    return ledger, lanes, cameras


def _run_threaded(case: BenchCase, folder: Path, disk: Disk, progress: Callable[[float], None]) -> BenchRow:
    clock = SystemClock()
    ledger, lanes, cameras = _lanes(case, folder, disk, clock)
    cpu_s, begin_s = time.process_time(), time.monotonic()
    for lane in lanes:
        lane.start_writing()
        lane.start()
    depth: list[tuple[float, int]] = []
    while not all(camera.finished for camera in cameras) and not _broken(lanes):
        clock.sleep(0.1)
        depth.append((time.monotonic() - begin_s, max(g.ring.in_use for ln in lanes for g in ln.grabbers.values())))
        done = max(account.recorded for account in ledger.accounts().values())
        progress(done / case.frames)
    seconds = time.monotonic() - begin_s
    _stop(lanes)
    cpu_cores = (time.process_time() - cpu_s) / seconds
    ledger.close(case.frames)
    dropped = sum(account.lost_total for account in ledger.accounts().values())
    latencies = [us / 1000 for lane in lanes for us in lane.recorder.statistics.latencies_us]
    rings = [grabber.ring for lane in lanes for grabber in lane.grabbers.values()]
    return _row(case, dropped, latencies, max(r.high_water for r in rings), rings[0].slots, cpu_cores, seconds, depth)


def _broken(lanes: Sequence[Lane]) -> bool:
    recorders = [lane.recorder for lane in lanes]
    workers = [*recorders, *(grabber for lane in lanes for grabber in lane.grabbers.values())]
    return any(recorder.failure for recorder in recorders) or any(worker.error for worker in workers)


def _stop(lanes: Sequence[Lane]) -> float:
    """End all threads and close all files; the seconds that closing took."""
    for lane in lanes:
        for grabber in lane.grabbers.values():
            grabber.stop(deadline_s=10 * GRAB_TIMEOUT_S)
    for lane in lanes:
        lane.recorder.stop(deadline_s=60.0)
    begin_s = time.monotonic()
    for lane in lanes:
        lane.recorder.close((), {})
    closing_s = time.monotonic() - begin_s
    for lane in lanes:
        for worker in (lane.recorder, *lane.grabbers.values()):
            if worker.error is not None:
                raise worker.error
        if lane.recorder.failure is not None:
            raise lane.recorder.failure
    return closing_s


def _run_monolithic(case: BenchCase, folder: Path, disk: Disk, progress: Callable[[float], None]) -> BenchRow:
    """The paper's program: grab a frame from each camera, then write them, in one loop."""
    triggers = ClockedTriggers(0, case.rate_hz)
    buffers = MONOLITHIC_BUFFERS if case.mode == "monolithic" else case.ring_slots
    size = -(-case.width * case.height // mmap.PAGESIZE) * mmap.PAGESIZE
    cameras = [ClockedCamera(case, triggers) for _ in range(4)]
    memory = [mmap.mmap(-1, size * buffers) for _ in cameras]
    for camera, area in zip(cameras, memory, strict=True):
        area[:] = b"\x07" * len(area)
        for slot in range(buffers):
            camera.queue(slot, memoryview(area)[:size])
    disk.make_folder(folder)
    files = [_OverwrittenFile(disk, folder / side, side) for side in SIDES]
    latencies: list[float] = []
    triggers.start_ns = time.time_ns() + START_AFTER_NS
    written, cpu_s, begin_s = 0, time.process_time(), time.monotonic()
    while not all(camera.finished for camera in cameras):
        for number, camera in enumerate(cameras):
            grab = camera.grab(0.0) if camera.finished else camera.grab(GRAB_TIMEOUT_S)
            if grab is None:
                continue
            view = memoryview(memory[number])[grab.slot * size : (grab.slot + 1) * size]
            before_s = time.monotonic()
            files[number // 2].write(view)
            latencies.append((time.monotonic() - before_s) * 1e3)
            camera.queue(grab.slot, view)
            written += 1
        progress(written / (4 * case.frames))
    seconds = time.monotonic() - begin_s
    cpu_cores = (time.process_time() - cpu_s) / seconds
    for file in files:
        file.close()
    dropped = 4 * case.frames - written
    return _row(case, dropped, latencies, buffers, buffers, cpu_cores, seconds, [])


class _OverwrittenFile:
    """Through the page cache, as fwrite would; a new file when one is full."""

    def __init__(self, disk: Disk, folder: Path, side: str) -> None:
        disk.make_folder(folder)
        self._disk, self._folder, self._side = disk, folder, side
        self._number, self._size = 0, 0
        self._file = disk.create(folder / f"{side}_0000.raw", "plain", 0)

    def write(self, view: memoryview) -> None:
        if self._size > SEGMENT_MB * 1e6:
            self.close()
            self._number, self._size = self._number + 1, 0
            self._file = self._disk.create(self._folder / f"{self._side}_{self._number:04d}.raw", "plain", 0)
        self._size += self._file.write(view)

    def close(self) -> None:
        self._file.close()


def _ceiling_ours(case: BenchCase, folder: Path) -> float:
    clock = SystemClock()
    ledger, lanes, cameras = _lanes(case, folder, BoundedDisk(), clock)
    for number, lane in enumerate(lanes):
        pair = cameras[2 * number : 2 * number + 2]
        for camera, beside, grabber in zip(pair, reversed(pair), lane.grabbers.values(), strict=True):
            camera.follow(grabber.ring, beside)
    begin_s = time.monotonic()
    for lane in lanes:
        lane.start_writing()
        lane.start()
    while not all(a.recorded + a.lost_total >= case.frames for a in ledger.accounts().values()):
        clock.sleep(0.002)
        if _broken(lanes):
            break
    seconds = time.monotonic() - begin_s + _stop(lanes)
    lost = sum(account.lost_total for account in ledger.accounts().values())
    if lost:
        raise DiskError(
            f"{folder}: {lost} frames were lost at the ceiling: the disk or this machine cannot be measured"
        )
    _remove(folder)
    return 4 * case.frames * case.width * case.height / seconds / 1e6


def _ceiling_raw(case: BenchCase, folder: Path) -> float:
    size = -(-(case.width * case.height + 4096) // mmap.PAGESIZE) * mmap.PAGESIZE
    # As much memory as the rings have: one buffer over and over would come out of the processor's cache.
    slots = case.ring_slots
    memory = {side: mmap.mmap(-1, size * slots * len(CAMERAS)) for side in SIDES}
    for area in memory.values():
        for at in range(0, len(area), mmap.PAGESIZE):
            area[at] = 7
    disk = BoundedDisk()
    disk.make_folder(folder)

    def write(side: str) -> None:
        disk.make_folder(folder / side)
        per_file = int(SEGMENT_MB * 1e6 / size) + 1
        left, number = 2 * case.frames, 0
        while left > 0:
            file = disk.create(folder / side / f"raw_{number:04d}", "direct", int(PREALLOCATE_BYTES))
            for frame in range(min(left, per_file)):
                at = frame % (slots * len(CAMERAS)) * size
                file.write(memoryview(memory[side])[at : at + size])
            file.sync()
            file.close()
            left, number = left - per_file, number + 1

    begin_s = time.monotonic()
    with ThreadPoolExecutor(len(SIDES)) as threads:
        list(threads.map(write, SIDES))  # and raise what they raise
    seconds = time.monotonic() - begin_s
    _remove(folder)
    return 4 * case.frames * case.width * case.height / seconds / 1e6


def _remove(folder: Path) -> None:
    shutil.rmtree(folder)


def _row(
    case: BenchCase,
    dropped: int,
    latencies: list[float],
    high_water: int,
    slots: int,
    cpu_cores: float,
    seconds: float,
    depth: list[tuple[float, int]],
) -> BenchRow:
    ordered = sorted(latencies) or [0.0]
    return BenchRow(
        mode=case.mode,
        width=case.width,
        height=case.height,
        rate_hz=case.rate_hz,
        offered_mb_s=4 * case.width * case.height * case.rate_hz / 1e6,
        frames=4 * case.frames,
        dropped=dropped,
        dropped_percent=100 * dropped / (4 * case.frames),
        write_ms={
            "p50": ordered[len(ordered) // 2],
            "p99": ordered[int(len(ordered) * 0.99)],
            "max": ordered[-1],
        },
        ring_high_water=high_water,
        ring_slots=slots,
        cpu_cores=cpu_cores,
        seconds=seconds,
        latencies_ms=latencies,
        ring_depth=depth,
    )
