"""The rig as a process of its own, with the camera backend and the board's port as the recorder uses them."""

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import serial

from capture.camera import make_camera
from capture.camera.base import Camera, CameraSettings, FrameStatus, Grab
from capture.clock import SystemClock
from capture.errors import CameraError, CameraLost, SimulationError
from capture.trigger_protocol import Pulse, decode_line, encode_line, parse_pulse
from hw_sim.render import noise_frames
from hw_sim.rig import Rig
from hw_sim.spots import led_spots
from hw_sim.wing_motion import LedMotion
from hw_sim.world import World

SETTINGS = CameraSettings(width=260, height=194, exposure_us=2000, gain_db=0.0)


@dataclass
class RunningRig:
    world: World
    folder: Path
    process: subprocess.Popen[str]

    def camera(self, name: str, settings: CameraSettings = SETTINGS) -> Camera:
        return make_camera("simulated", f"{self.folder / 'rig.sock'}#{name}", settings)

    def pulse(self, count: int, first: int = 0) -> list[Pulse]:
        """Let the board give ``count`` pulses at 50 Hz; all of them when this returns."""
        with serial.Serial(str(self.folder / "trigger"), timeout=5.0) as port:
            for words in (("RATE", "50000"), ("START", str(first), str(count))):
                port.write(encode_line(*words))
                assert decode_line(port.readline())[0] == "OK"
            return [parse_pulse(decode_line(port.readline())) for _ in range(count)]

    def stop(self) -> tuple[int, str]:
        self.process.send_signal(signal.SIGTERM)
        _, said = self.process.communicate(timeout=30)
        return self.process.returncode, said


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[RunningRig]:
    world = World.make(seed=4, scale=8)
    world.write(tmp_path / "world.toml")
    words = ["--world", "world.toml", "--socket", "rig.sock", "--trigger-port", "trigger", "--truth", "truth"]
    process = subprocess.Popen(
        [sys.executable, "-c", "from hw_sim.cli import main; main()", "rig", *words],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stderr is not None
    assert process.stdout.readline() == "ready\n"
    yield RunningRig(world, tmp_path, process)
    if process.poll() is None:
        process.kill()
    process.wait()
    process.stdout.close()
    process.stderr.close()


def _buffers(count: int) -> list[memoryview]:
    return [memoryview(bytearray(SETTINGS.width * SETTINGS.height)) for _ in range(count)]


def _grab_all(camera: Camera) -> list[Grab]:
    grabs = []
    while (grab := camera.grab(0.3)) is not None:
        grabs.append(grab)
    return grabs


def test_frames_arrive_in_order_with_counter_clock_and_content(rig: RunningRig) -> None:
    camera = rig.camera("left_cam0")
    description = camera.open()
    truth = rig.world.camera("left", "cam0")
    assert (description.width, description.height, description.row_time_ns) == (260, 194, 10_000)
    assert (description.serial, description.frame_id_bits, description.hardware_trigger) == (truth.serial, 16, True)
    buffers = _buffers(8)
    for slot, buffer in enumerate(buffers):
        camera.queue(slot, buffer)
    camera.arm()
    pulses = rig.pulse(6)
    grabs = _grab_all(camera)
    assert [grab.slot for grab in grabs] == list(range(6))
    assert np.array_equal(np.diff([grab.frame_id for grab in grabs]) % 2**16, np.ones(5))
    assert all(grab.status is FrameStatus.COMPLETE for grab in grabs)
    edges = np.array([pulse.actual_ns for pulse in pulses])
    ticks = np.array([grab.device_ticks for grab in grabs])
    # Its own clock: nominal 1 GHz with the world's drift, to the rounding of a tick.
    assert np.diff(ticks) == pytest.approx(np.diff(edges) * (1 + truth.clock_drift_ppm * 1e-6), abs=1.01)
    read_out_ns = 2_000_000 + 194 * 10_000
    assert all(grab.receive_ns - edge >= read_out_ns for grab, edge in zip(grabs, edges, strict=True))
    for grab, edge in zip(grabs, edges, strict=True):
        image = np.frombuffer(buffers[grab.slot], dtype=np.uint8).reshape(194, 260)
        spots = led_spots(rig.world, truth, LedMotion(rig.world, "left"), int(edge), 2000)
        columns, rows = np.rint(spots.centre_px[:18]).astype(int).T
        assert (image[rows, columns] > 20).all()  # the wing is where it was at this edge
    assert buffers[6][:1000] == bytes(1000)
    camera.disarm()
    camera.close()
    camera.close()
    code, said = rig.stop()
    assert code == 0, said


def test_a_frame_without_a_buffer_is_dropped_and_leaves_a_gap(rig: RunningRig) -> None:
    camera = rig.camera("right_cam1")
    camera.open()
    buffers = _buffers(3)
    for slot in (0, 1):
        camera.queue(slot, buffers[slot])
    camera.arm()
    rig.pulse(5)
    first = _grab_all(camera)
    assert [grab.slot for grab in first] == [0, 1]
    camera.queue(2, buffers[2])
    rig.pulse(1)
    (last,) = _grab_all(camera)
    assert (last.frame_id - first[0].frame_id) % 2**16 == 5  # 2 delivered, 3 dropped, then this one
    camera.disarm()
    rig.pulse(2)
    camera.queue(0, buffers[0])
    camera.arm()  # the two pulses between were not exposed
    rig.pulse(1)
    (after,) = _grab_all(camera)
    assert (after.frame_id - last.frame_id) % 2**16 == 1
    camera.close()


def test_a_rig_that_dies_is_a_lost_camera(rig: RunningRig) -> None:
    camera = rig.camera("left_cam1")
    camera.open()
    buffer = _buffers(1)[0]
    camera.queue(0, buffer)
    camera.arm()
    rig.process.kill()
    rig.process.wait()
    with pytest.raises(CameraLost, match=r"rig\.sock#left_cam1"):
        camera.grab(5.0)
    camera.queue(0, buffer)
    camera.disarm()
    camera.close()
    with pytest.raises(CameraError, match="wingsim rig"):
        rig.camera("left_cam1").open()


def test_what_cannot_be_opened_says_why(rig: RunningRig) -> None:
    with pytest.raises(CameraError, match=r"260×194, not 640×480"):
        rig.camera("left_cam0", CameraSettings(640, 480, 2000, 0.0)).open()
    with pytest.raises(CameraError, match="its cameras are left_cam0, left_cam1"):
        rig.camera("top_cam0").open()
    with pytest.raises(CameraError, match="exposure 90000 us"):
        rig.camera("left_cam0", CameraSettings(260, 194, 90_000, 0.0)).open()
    with pytest.raises(CameraError, match="not an address"):
        make_camera("simulated", "left_cam0", SETTINGS).open()
    camera = rig.camera("left_cam0")
    camera.open()
    with pytest.raises(CameraError, match="in use"):
        rig.camera("left_cam0").open()
    camera.close()
    again = rig.camera("left_cam0", CameraSettings(260, 194, 4000, 6.0))
    for _ in range(50):  # the rig hears of the closing a moment later
        try:
            description = again.open()
            break
        except CameraError:
            time.sleep(0.02)
    assert (description.exposure_us, description.gain_db) == (4000, 6.0)
    again.close()


def test_the_truth_is_written_at_the_end(rig: RunningRig) -> None:
    pulses = rig.pulse(5)
    code, said = rig.stop()
    assert code == 0, said
    assert not (rig.folder / "trigger").is_symlink()
    assert not (rig.folder / "rig.sock").exists()
    truth = rig.folder / "truth"
    assert World.read(truth / "world.toml") == rig.world
    assert len((truth / "triggers.csv").read_text().splitlines()) == 6
    times = pq.read_table(truth / "markers.parquet")["timestamp_ns"].to_numpy()
    assert times.min() == pulses[0].actual_ns - 200_000_000
    assert 0 <= times.max() - pulses[-1].actual_ns - 200_000_000 < 5_000_000


def test_a_second_rig_does_not_take_the_place_of_a_running_one(rig: RunningRig) -> None:
    with pytest.raises(SimulationError, match="another simulated rig is running"):
        Rig(rig.world, rig.folder / "rig.sock", rig.folder / "trigger2", SystemClock())
    camera = rig.camera("left_cam0")
    camera.open()
    camera.close()


def test_noise_frames_are_drawn_per_exposure_and_gain() -> None:
    small = World.make(seed=4, scale=16)
    low, high = (np.array(noise_frames(small, 2000, gain_db)).std() for gain_db in (0.0, 12.0))
    assert high > 3 * low
