"""How fast and how large `reconstruct` is: rendered full-size flights, cold and from the page cache.

``python reconstruct_speed.py FOLDER [--seconds 15,30,60] [--repeats 3]`` calibrates as for a real rig, renders each
flight, evicts it from the page cache, reconstructs it, the first one again from the cache, and prints a table with the
accuracy: medians of the runs, with the range of the speed.
"""

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
from dataclasses import dataclass, fields
from pathlib import Path
from statistics import median

BIN = Path(sys.executable).parent
SUPPORT = Path(__file__).parents[1] / "support"
PIECE_BYTES = 1 << 24


def main() -> None:
    """Measure."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("folder", type=Path)
    options.add_argument("--seconds", default="15,30,60")
    options.add_argument("--repeats", type=int, default=3)
    given = options.parse_args()
    folder: Path = given.folder / "reconstruct-speed"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    calibrate(folder)
    print("| flight | frames from | × real time | × reading alone | CPU s a second | peak MB | shape mm | twist ° |")
    print("|---|---|---|---|---|---|---|---|")
    for number, seconds in enumerate(float(text) for text in given.seconds.split(",")):
        flight = folder / "flight"
        sunlit = f"{0.4 * seconds:g}:{0.6 * seconds:g}"
        run(folder, sys.executable, SUPPORT / "rendered_flight.py", "world.toml", "flight", seconds, "--sunlit", sunlit)
        sources = {"the disk": evict, "the page cache": warm} if number == 0 else {"the disk": evict}
        for source, prepare in sources.items():
            runs = []
            for _ in range(given.repeats):
                prepare(flight)
                runs.append(reconstructed(folder, seconds))
            report(seconds, source, runs)
        shutil.rmtree(flight)
    shutil.rmtree(folder)


def calibrate(folder: Path) -> None:
    """World, pairs, rig and wing, by the commands a user types."""
    run(folder, "wingsim", "world", "-o", "world.toml", "--seed", 3)
    run(folder, "wingsim", "sessions", "--world", "world.toml", "-o", "ground")
    for side in ("left", "right"):
        images = [f"ground/board_{side}/cam{number}_*.png" for number in (0, 1)]
        pattern = ("--board", "10x7", "--square-mm", 30, "-o", f"{side}.json")
        run(folder, "wingproc", "calibrate", "--cam0", images[0], "--cam1", images[1], *pattern)
    run(folder, "wingproc", "rig", "left.json", "right.json", "--survey", "ground/survey.toml", "-o", "rig.json")
    run(folder, "reconstruct", "example", "xhale", "-o", "wing.toml")


@dataclass(frozen=True)
class Run:
    """What one run of ``reconstruct`` came to."""

    times_real_time: float
    read_ratio: float
    cpu_s: float
    peak_mb: float
    shape_mm: float
    twist_deg: float


def reconstructed(folder: Path, seconds: float) -> Run:
    """Reconstruct the flight, and compare it with its truth."""
    disks = ("flight/ssd_left", "flight/ssd_right")
    shutil.rmtree(folder / "out", ignore_errors=True)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    run(folder, "reconstruct", *disks, "--rig", "rig.json", "--wing", "wing.toml", "-o", "out", "--no-report")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    summary = json.loads((folder / "out/summary.json").read_text())
    compared = json.loads(
        run(folder, "reconstruct", "compare", "out", "flight/truth", "--reference-window", "0:2", "--json")
    )
    return Run(
        summary["times_real_time"],
        summary["read_ratio"],
        cpu_s / seconds,
        summary["peak_mb"],
        compared["displacement_rms_mm"],
        compared["displacement_twist_rms_deg"],
    )


def report(seconds: float, source: str, runs: list[Run]) -> None:
    """Print a row."""
    middle = Run(*(median(getattr(one, member.name) for one in runs) for member in fields(Run)))
    speeds = [one.times_real_time for one in runs]
    print(
        f"| {seconds:g} s | {source} | {middle.times_real_time:.2f} ({min(speeds):.2f} to {max(speeds):.2f}) | "
        f"{middle.read_ratio:.1f} | {middle.cpu_s:.3f} | {middle.peak_mb:.0f} | {middle.shape_mm:.2f} | "
        f"{middle.twist_deg:.3f} |",
        flush=True,
    )


def warm(flight: Path) -> None:
    """Into the page cache."""
    for path in flight.rglob("*.mcap"):
        with path.open("rb", buffering=0) as file:
            while file.read(PIECE_BYTES):
                pass


def evict(flight: Path) -> None:
    """Out of the page cache."""
    for path in flight.rglob("*.mcap"):
        descriptor = os.open(path, os.O_RDONLY)
        os.fsync(descriptor)
        os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
        os.close(descriptor)


def run(folder: Path, *words: object) -> str:
    """What a command says; its own folder is the working one."""
    command = [str(word) for word in words]
    beside = BIN / command[0]
    command[0] = str(beside) if beside.exists() else command[0]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{' '.join(command)} failed ({done.returncode}): {done.stderr}")
    return done.stdout


if __name__ == "__main__":
    main()
