"""How long the recorder keeps other threads from Python: a probe thread beside it, and the same beside another process.

Run: ``python tests/benchmarks/interpreter_lock.py [FOLDER] [--seconds 20]``. The probe sleeps for half a ms over
and over; by how much it wakes too late is what the system's scheduler takes, and, in the recorder's own process, the
time that somebody holds the interpreter's lock. The recorder runs at 322.8 MB/s both times, in turn, three rounds.
"""

import argparse
import multiprocessing
import statistics
import tempfile
import threading
import time
from pathlib import Path

from capture.bench import BoundedDisk, run_case
from capture.bench_rig import BenchCase

PAUSE_S = 0.0005


def record(folder: str, seconds: float) -> None:
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        case = BenchCase("threaded", 2080, 1552, 25.0, round(25 * seconds))
        row = run_case(case, Path(scratch) / "flight", BoundedDisk(), lambda _: None)
    assert row.dropped == 0, f"{row.dropped} frames dropped: this machine is too busy to measure"


def probe(stop: threading.Event, late_ms: list[float]) -> None:
    while not stop.is_set():
        before_s = time.perf_counter()
        time.sleep(PAUSE_S)
        late_ms.append(1e3 * (time.perf_counter() - before_s - PAUSE_S))


def beside(runner: threading.Thread | multiprocessing.Process, seconds: float) -> list[float]:
    """How late the probe was while ``runner`` was recording, its start and end (allocating, closing) left out."""
    late_ms: list[float] = []
    stop = threading.Event()
    thread = threading.Thread(target=probe, args=(stop, late_ms))
    runner.start()
    time.sleep(3.0)  # rings are allocated and touched
    thread.start()
    time.sleep(seconds - 4.0)
    stop.set()
    thread.join()
    runner.join()
    return sorted(late_ms)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("folder", nargs="?", default="/tmp")
    options.add_argument("--seconds", type=float, default=20.0)
    given = options.parse_args()
    spawn = multiprocessing.get_context("spawn")
    found: dict[str, list[list[float]]] = {"same process": [], "another process": []}
    for _ in range(3):
        inside = threading.Thread(target=record, args=(given.folder, given.seconds))
        outside = spawn.Process(target=record, args=(given.folder, given.seconds))
        found["same process"].append(beside(inside, given.seconds))
        found["another process"].append(beside(outside, given.seconds))  # type: ignore[arg-type]
    print(
        "| recorder in | p50 ms | p99 ms | p99.9 ms | longest ms | over 1 ms, per million |\n|---|---|---|---|---|---|"
    )
    for name, rounds in found.items():
        figures = [[late[int(len(late) * part)] for late in rounds] for part in (0.5, 0.99, 0.999)]
        longest = statistics.median(late[-1] for late in rounds)
        over = statistics.median(1e6 * sum(x > 1.0 for x in late) / len(late) for late in rounds)
        quoted = " | ".join(f"{statistics.median(values):.3f}" for values in figures)
        print(f"| {name} | {quoted} | {longest:.2f} | {over:.0f} |")


if __name__ == "__main__":
    main()
