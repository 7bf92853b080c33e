"""What is too long for CI: runs each section's commands and writes a dated page with machine, command and figures.

Run by ``make evidence``; ``--only NAME`` runs one section, ``--target DIR`` is the disk to measure.
"""

import argparse
import datetime
import os
import platform
import shlex
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
BIN = Path(sys.executable).parent


@dataclass(frozen=True)
class Step:
    """One command, and what it is to show."""

    shows: str
    command: str  # {target} is the folder on the disk to measure
    environment: tuple[tuple[str, str], ...] = ()


SECTIONS: dict[str, tuple[Step, ...]] = {
    "table8": (
        Step(
            "the paper's full run, ours: 30,000 frames a camera at 322.8 MB/s",
            "wingcap bench --target {target} --mode threaded --frames 30000",
        ),
        Step("the paper's way on the same disk", "wingcap bench --target {target} --mode monolithic --frames 3000"),
        Step("both of the paper's sizes", "wingcap bench --target {target} --size paper --frames 1000"),
        Step("2080×1552 at 60 Hz", "wingcap bench --target {target} --mode threaded --rate 60 --frames 3600"),
        Step("a modelled SSD with stalls, side by side", "wingcap bench --target model --frames 3000"),
        Step(
            "the ceiling against raw O_DIRECT",
            "wingcap bench --target {target} --mode threaded --rate 60 --frames 600 --ceiling",
        ),
    ),
    "peers": (
        Step(
            "peers, same frames, same disk, in turn", "python tests/benchmarks/recording_peers.py {target} --rounds 9"
        ),
    ),
    "faults": (
        Step(
            "200 kills at random moments",
            "pytest -q -s -m slow tests/capture/test_kill.py",
            (("WINGSHAPE_KILLS", "200"),),
        ),
        Step("2,000 simulated flights with faults", "pytest -q -s -m slow tests/capture/test_fault_simulation.py"),
    ),
    "metrology": (
        Step(
            "coverage over 500 independently calibrated rigs",
            "pytest -q -s tests/process/test_coverage.py",
            (("WINGSHAPE_RIGS", "500"),),
        ),
        Step(
            "accuracy over 20 calibrations a focal length: the paper's Tables 5 to 7",
            "wingproc accuracy -o {target}/accuracy --calibrations 20",
        ),
        Step(
            "centroid noise beside the Cramér-Rao bound, and 300,000 identities",
            "pytest -q -s -m slow tests/process/test_detect.py tests/process/test_match.py",
        ),
        Step(
            "detection: time a frame, errors, beside SimpleBlobDetector, trackpy and photutils",
            "python tests/benchmarks/detection.py --frames 16 --rounds 9",
        ),
        Step("MATLAB's calibration of a public rig", "pytest -q -s tests/process/calibration/test_calibrate.py"),
    ),
    "power": (
        Step(
            "20 power cuts of a recording guest",
            "pytest -q -s tests/vm/test_power_cut.py",
            (("WINGSHAPE_CUTS", "20"),),
        ),
    ),
    "beam": (
        Step(
            "the beam's slow tests: coverage, 5,000 frames, the paper's way",
            "pytest -q -s -m slow tests/reconstruct/test_fit_accuracy.py --durations=0",
        ),
        Step(
            "time of a fit: a set at a time, a block of sets, with bands and tables", "python tests/benchmarks/fit.py"
        ),
        Step(
            "forward solve beside OpenSees (`pip install openseespy`), same case, same run",
            "python tests/reconstruct/beside_opensees.py",
        ),
    ),
    "reconstruct": (
        Step(
            "speed, memory and accuracy of full-size flights of 15, 30 and 60 s; they take 19 GB",
            "python tests/evidence/reconstruct_speed.py {target}",
        ),
        Step(
            "95 % bands over 1,000 short flights, each with a calibration of its own",
            "python tests/evidence/flight_coverage.py {target} --flights 1000",
        ),
        Step(
            "killed and resumed, one process or several or Dask: the same",
            "pytest -q tests/end_to_end/test_reconstruct_a_flight.py",
        ),
    ),
    "chain": (Step("a full-size minute through the whole chain", "wingsim demo -o {target}/demo --seconds 60"),),
}


def machine() -> str:
    """The machine in one line."""
    model = next(
        (
            line.split(":", 1)[1].strip()
            for line in Path("/proc/cpuinfo").read_text().splitlines()
            if "model name" in line
        ),
        platform.machine(),
    )
    memory_gb = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    system = f"Linux {platform.release()}, Python {platform.python_version()}"
    return f"{model}, {os.cpu_count()} cores, {memory_gb:.0f} GB, {system}"


def run(step: Step, target: Path) -> tuple[bool, str]:
    """Whether a step succeeded, and its markdown."""
    command = step.command.format(target=target)
    words = shlex.split(command)
    beside = BIN / words[0]
    words[0] = str(beside) if beside.exists() else words[0]
    load = os.getloadavg()[0]
    begin = time.monotonic()
    environment = {**os.environ, "COLUMNS": "140", **dict(step.environment)}
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, env=environment)
    seconds = time.monotonic() - begin
    shown = " ".join([*(f"{key}={value}" for key, value in step.environment), step.command.format(target="DIR")])
    output = done.stdout.rstrip() if done.returncode == 0 else f"FAILED ({done.returncode})\n{done.stdout}{done.stderr}"
    return done.returncode == 0, (
        f"### {step.shows[0].upper()}{step.shows[1:]}\n\n`{shown}` ({seconds:.0f} s; load before: {load:.1f})\n\n"
        f"```\n{output}\n```\n"
    )


def main() -> None:
    """Write the pages."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--only", choices=sorted(SECTIONS))
    options.add_argument("--target", type=Path, default=Path("evidence-scratch"))
    given = options.parse_args()
    given.target.mkdir(parents=True, exist_ok=True)
    today = datetime.datetime.now(datetime.UTC).date().isoformat()
    failed: list[str] = []
    for name in [given.only] if given.only else SECTIONS:
        page = ROOT / "docs/evidence" / f"{today}-{name}.md"
        describe = ["git", "describe", "--always", "--dirty"]
        commit = subprocess.run(describe, cwd=ROOT, capture_output=True, text=True)
        page.write_text(f"# Evidence: {name}, {today}\n\nCommit {commit.stdout.strip()}. {machine()}.\n")
        for step in SECTIONS[name]:
            print(f"{name}: {step.shows}", flush=True)
            succeeded, text = run(step, given.target.resolve())
            failed += [] if succeeded else [step.shows]
            with page.open("a") as file:
                file.write(f"\n{text}")
        print(page, flush=True)
    if failed:
        sys.exit(f"failed: {'; '.join(failed)}")


if __name__ == "__main__":
    main()
