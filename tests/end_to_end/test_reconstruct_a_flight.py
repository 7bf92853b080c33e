"""`reconstruct` from frames: the same result whoever does the work and however often it is killed; holes are marked."""

import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from needs import needs_module
from pandas.testing import assert_frame_equal
from rendered_flight import true_rig, write_flight

from hw_sim.demo import executable
from hw_sim.world import World
from reconstruct.wing import example_path

SCALE, SECONDS = 4, 12.0
TABLES = ("markers", "shape", "frames", "loads", "residuals", "unloaded")


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flight at a quarter of the size, its rig as it truly is, and the wing."""
    folder = tmp_path_factory.mktemp("flight")
    world = World.make(5, SCALE)
    write_flight(world, folder, SECONDS)
    true_rig(world).write(folder / "rig.json")
    shutil.copyfile(example_path("xhale.toml"), folder / "wing.toml")
    return folder


def command(flight: Path, *words: object) -> list[str]:
    """Run in the folder of the result, so that the command is the same for each."""
    paths = (flight / "ssd_left", flight / "ssd_right", "--rig", flight / "rig.json", "--wing", flight / "wing.toml")
    return [
        executable("reconstruct"),
        *map(str, paths),
        "-o",
        "out",
        "--no-report",
        "--no-mat",
        "--no-mcap",
        *map(str, words),
    ]


def reconstruct(flight: Path, folder: Path, *words: object) -> Path:
    folder.mkdir(exist_ok=True)
    answer = subprocess.run(command(flight, *words), cwd=folder, capture_output=True, text=True, timeout=200)
    assert answer.returncode == 0, answer.stderr
    return folder / "out"


@pytest.fixture(scope="module")
def alone(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result of one process."""
    return reconstruct(flight, tmp_path_factory.mktemp("alone"), "--workers", 1)


def assert_same_tables(one: Path, other: Path) -> None:
    for name in TABLES:
        mine, others = (pq.read_table(folder / f"{name}.parquet") for folder in (one, other))
        assert mine.schema.equals(others.schema), name
        assert_frame_equal(mine.to_pandas(), others.to_pandas(), check_exact=True, obj=name)  # NaN is NaN


def assert_same_bytes(one: Path, other: Path) -> None:
    for name in TABLES:
        for kind in ("parquet", "csv"):
            if (one / f"{name}.{kind}").exists():
                assert (one / f"{name}.{kind}").read_bytes() == (other / f"{name}.{kind}").read_bytes(), name


def assert_true_shapes(out: Path, flight: Path, scratch: Path) -> None:
    answer = subprocess.run(
        [executable("reconstruct"), "compare", str(out), str(flight / "truth"), "-o", str(scratch), "--json"],
        capture_output=True, text=True, timeout=100,
    )  # fmt: skip
    assert answer.returncode == 0, answer.stderr
    said = json.loads(answer.stdout)
    assert said["frames_compared"] == 2 * SECONDS * 25
    assert said["shape_rms_mm"] < 1.0
    assert said["twist_rms_deg"] < 0.2


def test_the_shapes_are_the_wings(flight, alone, tmp_path):
    assert_true_shapes(alone, flight, tmp_path)


@pytest.mark.slow
def test_by_both_cameras_pixels_too(flight, tmp_path):
    """Killed half way, it goes on."""
    folder = tmp_path / "direct"
    folder.mkdir()
    process = subprocess.Popen(command(flight, "--direct", "--workers", 1), cwd=folder, stderr=subprocess.DEVNULL)
    try:
        process.wait(4.0)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGKILL)
    process.wait()
    out = reconstruct(flight, folder, "--direct", "--workers", 2)
    assert json.loads((out / "summary.json").read_text())["direct"] is True
    assert_true_shapes(out, flight, tmp_path)


def test_the_summary_says_how_fast_and_how_large(alone):
    summary = json.loads((alone / "summary.json").read_text())
    assert summary["flight_s"] == pytest.approx(SECONDS - 0.04)
    worked_s = sum(summary["timing_s"][stage] for stage in ("markers", "fit", "tables"))
    assert summary["times_real_time"] == pytest.approx(summary["flight_s"] / worked_s)
    assert summary["read_ratio"] > 1.0
    assert 50 < summary["peak_mb"] < 1500
    assert summary["sets_without_shape"] == 0
    assert summary["holes"] == []
    assert len(summary["recording"]) == 4
    assert not (alone / ".parts").exists()


@pytest.mark.slow
def test_the_number_of_workers_changes_nothing(flight, alone, tmp_path):
    assert_same_tables(alone, reconstruct(flight, tmp_path / "three", "--workers", 3))


@pytest.mark.slow
def test_a_cluster_here_changes_nothing(flight, alone, tmp_path):
    needs_module("distributed")
    assert_same_tables(alone, reconstruct(flight, tmp_path / "dask", "--scheduler", "local", "--workers", 2))


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A Dask scheduler and two workers, each a process of its own: its address, and the workers."""
    needs_module("distributed")
    contact = tmp_path / "scheduler.json"
    common = ["--scheduler-file", str(contact), "--no-dashboard"]
    with (tmp_path / "dask.log").open("wb") as log, ExitStack() as running:

        def start(*words: str) -> subprocess.Popen[bytes]:
            process = subprocess.Popen([executable("dask"), *words, *common], cwd=tmp_path, stdout=log, stderr=log)
            running.callback(process.wait)
            running.callback(process.kill)
            return process

        start("scheduler", "--port", "0", "--host", "127.0.0.1")
        wait_until(contact.exists)
        workers = [start("worker", "--nthreads", "1", "--no-nanny") for _ in range(2)]
        wait_until(lambda: (tmp_path / "dask.log").read_text().count("Registered to") >= 2)
        yield json.loads(contact.read_text())["address"], workers


def wait_until(holds: Callable[[], bool], limit_s: float = 60.0) -> None:
    end = time.monotonic() + limit_s
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.1)


@pytest.mark.slow
def test_a_worker_killed_midway_changes_nothing(flight, alone, tmp_path, cluster):
    address, (first, _) = cluster
    folder = tmp_path / "result"
    folder.mkdir()
    process = subprocess.Popen(command(flight, "--scheduler", address), cwd=folder, stderr=subprocess.PIPE, text=True)
    parts = folder / "out/.parts"
    wait_until(lambda: len(list(parts.glob("markers-*.part"))) >= 2 or process.poll() is not None)
    assert process.poll() is None
    first.kill()
    assert process.wait(200) == 0, process.stderr and process.stderr.read()
    if process.stderr:
        process.stderr.close()
    assert_same_tables(alone, folder / "out")


@pytest.mark.slow
def test_killed_at_any_moment_it_goes_on(flight, tmp_path):
    """Five times, at random moments of a run that takes a few seconds; the last one is left to end."""
    seed = int(time.time())
    print("seed", seed)
    begin = time.monotonic()
    whole = reconstruct(flight, tmp_path / "whole", "--workers", 2)
    moments = np.random.default_rng(seed).uniform(0.1, 0.6, 5) * (time.monotonic() - begin)
    killed = tmp_path / "killed"
    killed.mkdir()
    for moment in moments:
        process = subprocess.Popen(command(flight, "--workers", 2), cwd=killed, stderr=subprocess.DEVNULL)
        try:
            process.wait(moment)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
        process.wait()
    again = reconstruct(flight, killed, "--workers", 2)
    assert_same_bytes(whole, again)
    assert not (again / ".parts").exists()


def test_what_is_damaged_is_a_hole(flight, tmp_path):
    """Zeros over some frames of one file, and a file that is not there; the rest is as it would be."""
    folder = tmp_path / "damaged"
    shutil.copytree(flight / "ssd_left", folder / "ssd_left")
    shutil.copytree(flight / "ssd_right", folder / "ssd_right")
    for name in ("rig.json", "wing.toml"):
        shutil.copyfile(flight / name, folder / name)
    with (folder / "ssd_left/left_0000.mcap").open("r+b") as file:
        file.seek(40_000_000)
        file.write(bytes(2_000_000))
    (folder / "ssd_right/right_0001.mcap").unlink()
    out = reconstruct(folder, tmp_path / "result", "--workers", 1)
    summary = json.loads((out / "summary.json").read_text())
    *left, right = summary["holes"]
    assert (right["side"], right["first_trigger"], right["last_trigger"]) == ("right", 250, 299)
    assert right["reason"] == "no set recorded, or none readable"
    assert {hole["side"] for hole in left} == {"left"}
    assert {hole["reason"] for hole in left} <= {"not fitted", "no set recorded, or none readable"}  # one camera, both
    lost = sum(hole["last_trigger"] - hole["first_trigger"] + 1 for hole in left)
    assert lost == left[-1]["last_trigger"] - left[0]["first_trigger"] + 1
    assert 4 <= lost <= 8  # a frame is 0.2 MB
    assert summary["sets_without_shape"] == lost + 50
    frames = pq.read_table(out / "frames.parquet").to_pandas()
    fitted = frames[np.isfinite(frames.tip_dz_m)]
    assert len(fitted) == 600 - lost - 50


@pytest.mark.slow
def test_a_full_size_flight_with_gusts_and_sun(tmp_path):
    """15 s, calibrated as a real rig is, cold and from the page cache; speed is for the evidence, not for here."""
    program = Path(__file__).parents[1] / "evidence/reconstruct_speed.py"
    command = [sys.executable, str(program), str(tmp_path), "--seconds", "15", "--repeats", "1"]
    answer = subprocess.run(command, capture_output=True, text=True, timeout=280)
    assert answer.returncode == 0, answer.stderr
    print(answer.stdout)
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in answer.stdout.splitlines()[2:]]
    assert [row[1] for row in rows] == ["the disk", "the page cache"]
    for *_, peak_mb, shape_mm, twist_deg in rows:
        assert float(peak_mb) < 1500
        assert float(shape_mm) < 1.0
        assert float(twist_deg) < 0.2
