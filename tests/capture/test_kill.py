"""``kill -9`` at random moments of a real recording: every frame that was complete on the disk comes back."""

import itertools
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from mcap.exceptions import McapError
from mcap.records import Chunk, Message
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk

from capture.recover import recover_flight
from capture.verify import inspect

KILLS = int(os.environ.get("WINGSHAPE_KILLS", "40"))
SEED = int(os.environ.get("WINGSHAPE_SEED", "3"))
RECORD = "from capture.cli import main; main()"
RIG = "from hw_sim.cli import main; main()"


@pytest.fixture
def hardware(tmp_path) -> Path:
    """A simulated rig of small images, running; the recorder's configuration for it."""
    world = tmp_path / "truth/world.toml"
    subprocess.run([sys.executable, "-c", RIG, "world", "-o", world, "--scale", "8"], check=True, capture_output=True)
    words = ["rig", "--world", world, "--socket", "rig.sock", "--trigger-port", "trigger", "--truth", "truth"]
    rig = subprocess.Popen([sys.executable, "-c", RIG, *words], cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    assert rig.stdout.readline().strip() == "ready"
    cameras = "".join(
        f'[[cameras]]\nside = "{side}"\nname = "{name}"\naddress = "rig.sock#{side}_{name}"\n'
        for side, name in itertools.product(("left", "right"), ("cam0", "cam1"))
    )
    config = tmp_path / "wingcap.toml"
    for side in ("left", "right"):
        (tmp_path / f"ssd_{side}").mkdir()
    config.write_text(
        '[trigger]\nport = "trigger"\n'
        '[disks]\nleft = "ssd_left"\nright = "ssd_right"\nsegment_s = 0.7\nsegment_mb = 20\n'
        f'[camera]\nbackend = "simulated"\nwidth = 260\nheight = 194\n{cameras}'
    )
    yield config
    rig.kill()  # its truth is not asked for
    rig.communicate(timeout=60)


def whole_images(folder: Path) -> int:
    """Images in chunks that the stock reader finds whole, up to the first it does not."""
    count = 0
    for path in folder.glob("*.mcap"):
        if path.name.startswith("aux"):
            continue
        with path.open("rb") as file:
            try:
                for record in StreamReader(file, emit_chunks=True).records:
                    if isinstance(record, Chunk):
                        messages = breakup_chunk(record, validate_crc=True)
                        count += sum(isinstance(m, Message) and len(m.data) > 260 * 194 for m in messages)
            except (McapError, CRCValidationError, ValueError, OSError):
                continue
    return count


@pytest.mark.slow
def test_sigterm_loses_nothing(hardware):
    draw = random.Random(SEED + 1)
    for number in range(3):
        config = hardware.with_name(f"term_{number}.toml")
        config.write_text(f'flight = "term_{number}"\n' + hardware.read_text())
        command = [sys.executable, "-c", RECORD, "record", "--config", config, "--json"]
        recorder = subprocess.Popen(
            command, cwd=hardware.parent, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        for line in recorder.stderr:
            if line.startswith("triggers"):
                break
        time.sleep(draw.uniform(0.0, 1.0))
        recorder.send_signal(signal.SIGTERM)
        output, errors = recorder.communicate(timeout=30)
        assert recorder.returncode == 0, errors
        result = json.loads(output)
        report = inspect([hardware.parent / f"ssd_{side}/term_{number}" for side in ("left", "right")])
        assert report.problems == []
        assert report.recorded == result["frames_recorded"] == 4 * report.triggers > 0
        assert report.lost == result["frames_lost"] == 0


@pytest.mark.slow
def test_killed_at_random_moments(hardware, capsys):
    draw = random.Random(SEED)
    with_frames = recovered = 0
    for number in range(KILLS):
        text = f'flight = "kill_{number}"\n' + hardware.read_text()
        config = hardware.with_name(f"kill_{number}.toml")
        config.write_text(text)
        command = [sys.executable, "-c", RECORD, "record", "--config", config]
        recorder = subprocess.Popen(command, cwd=hardware.parent, stderr=subprocess.PIPE, text=True)
        for line in recorder.stderr:
            if line.startswith("ring:"):
                break
        time.sleep(draw.uniform(0.25, 2.0))
        recorder.kill()
        recorder.communicate()
        folders = [hardware.parent / f"ssd_{side}/kill_{number}" for side in ("left", "right")]
        expected = sum(whole_images(folder) for folder in folders)
        copy = hardware.parent / f"copy_{number}"
        result = recover_flight(folders, copy)
        report = inspect([copy])
        assert result.frames == report.recorded == expected, f"kill {number}, seed {SEED}"
        assert report.problems == [], f"kill {number}, seed {SEED}"
        with_frames += expected > 0
        recovered += expected
    with capsys.disabled():
        print(f"\n{KILLS} kills (seed {SEED}): {with_frames} with frames, {recovered} frames, all came back")
    assert with_frames >= 0.95 * KILLS
