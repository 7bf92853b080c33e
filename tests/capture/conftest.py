"""A rig of fakes for the recorder: cameras in memory and a trigger board on a pty, both told what to do wrong."""

import contextlib
import os
import queue
import subprocess
import sys
import threading
import time
import tty
import types
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

import capture.camera
from capture.camera.base import Camera, CameraDescription, CameraSettings, FrameStatus, Grab
from capture.errors import CameraError, CameraLost
from capture.trigger_protocol import Pulse, decode_line, encode_line

WIDTH, HEIGHT = 64, 48
ROW_TIME_NS = 1000


def pixels_of(camera: str, index: int) -> np.ndarray:
    """The content that a camera shows on a trigger: its own for each camera and index."""
    seed = (sum(camera.encode()) << 32) | index
    return np.random.default_rng(seed).integers(0, 256, WIDTH * HEIGHT, dtype=np.uint8)


@dataclass
class FakeRig:
    """The faults are sets of (camera, trigger index)."""

    port: str = ""
    missed: set[tuple[str, int]] = field(default_factory=set)  # the camera does not expose
    undelivered: set[tuple[str, int]] = field(default_factory=set)  # exposed, never delivered
    incomplete: set[tuple[str, int]] = field(default_factory=set)
    repeated: set[tuple[str, int]] = field(default_factory=set)  # delivered twice
    unplugged_at: dict[str, int] = field(default_factory=dict)
    replugged_at: dict[str, int] = field(default_factory=dict)
    silent_pulses: set[int] = field(default_factory=set)  # the board does not report them
    garbled_pulses: set[int] = field(default_factory=set)
    cameras: dict[str, "FakeCamera"] = field(default_factory=dict)
    board: "FakeBoard | None" = None
    pulse_before_stop: bool = False
    rate_hz: float = 25.0
    counter: int = 17

    def edge(self, index: int, now_ns: int) -> None:
        for camera in self.cameras.values():
            camera.edge(index, now_ns)


class FakeCamera(Camera):
    rig: FakeRig

    def __init__(self, address: str, settings: CameraSettings) -> None:
        super().__init__(address, settings)
        self._buffers: queue.SimpleQueue = queue.SimpleQueue()
        self._done: queue.SimpleQueue = queue.SimpleQueue()
        self._frame_id = 65530 + len(address)  # soon wraps
        self._armed = False
        self._gone = False
        self._zero_ns = -5_000_000_000  # of its clock

    def open(self) -> CameraDescription:
        if self._gone:
            raise CameraError("no such camera: plug it in")
        self.rig.cameras[self.address] = self
        return CameraDescription(
            "fake", f"serial-{self.address}", WIDTH, HEIGHT, self.settings.exposure_us, 0.0, ROW_TIME_NS, 1e9, 16, True
        )

    def queue(self, slot: int, buffer: memoryview) -> None:
        self._buffers.put((slot, buffer))

    def arm(self) -> None:
        self._armed = True

    def edge(self, index: int, now_ns: int) -> None:
        key = (self.address, index)
        if self.rig.unplugged_at.get(self.address) == index:
            self._gone, self._armed = True, False
            self._done.put(CameraLost("unplugged: check its cable"))
        if self.rig.replugged_at.get(self.address) == index:
            self._gone, self._frame_id, self._zero_ns = False, 0, now_ns
            self._buffers, self._done = queue.SimpleQueue(), queue.SimpleQueue()
        if not self._armed or key in self.rig.missed:
            return
        self._frame_id = (self._frame_id + 1) % 65536
        if key in self.rig.undelivered:
            return
        for _ in range(1 + (key in self.rig.repeated)):
            try:
                slot, buffer = self._buffers.get(timeout=0.1)
            except queue.Empty:  # its read thread hangs: the driver has nowhere to put the frame
                return
            pixels = pixels_of(self.address, index)
            buffer[: len(pixels)] = memoryview(pixels)
            ready_ns = now_ns + self.settings.exposure_us * 1000 + ROW_TIME_NS * HEIGHT
            status = FrameStatus.INCOMPLETE if key in self.rig.incomplete else FrameStatus.COMPLETE
            ticks = now_ns - self._zero_ns
            self._done.put(Grab(slot, self._frame_id, ticks, ready_ns, self.settings.exposure_us, 0.0, status))

    def grab(self, timeout_s: float) -> Grab | None:
        with contextlib.suppress(queue.Empty):
            found = self._done.get(timeout=timeout_s)
            if isinstance(found, CameraLost):
                raise found
            return found
        return None

    def disarm(self) -> None:
        self._armed = False

    def close(self) -> None:
        self._armed = False


class FakeBoard:
    """Speaks the line protocol on a pty, in its own words: not the simulator's code."""

    def __init__(self, rig: FakeRig) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.master)
        tty.setraw(self.slave)
        rig.port = os.ttyname(self.slave)
        self.rig = rig
        self.running = False
        self.next_index, self.last = 0, 1 << 60
        self._stop = threading.Event()
        self._mutex = threading.Lock()
        self.threads = [threading.Thread(target=self._listen), threading.Thread(target=self._pulse)]
        for thread in self.threads:
            thread.start()

    def close(self) -> None:
        self._stop.set()
        for thread in self.threads:
            thread.join()
        os.close(self.master)
        os.close(self.slave)

    def _say(self, *words: object) -> None:
        os.write(self.master, encode_line(*map(str, words)))

    def _listen(self) -> None:
        rest = b""
        os.set_blocking(self.master, False)
        while not self._stop.wait(0.002):
            with contextlib.suppress(BlockingIOError):
                rest += os.read(self.master, 1000)
            *lines, rest = rest.split(b"\n")
            for line in lines:
                self._answer(decode_line(line))

    def _answer(self, words: tuple[str, ...]) -> None:
        with self._mutex:
            if words[0] == "HELLO":
                self._say("OK", "HELLO", 1, "fake-board")
            elif words[0] == "RATE":
                self.rig.rate_hz = int(words[1]) / 1000
                self._say("OK", *words)
            elif words[0] == "START":
                self.next_index, count = int(words[1]), int(words[2])
                self.last = self.next_index + count if count else 1 << 60
                self._say("OK", *words)
                self.running = True
            elif words[0] == "STOP":
                self.running = False
                if self.rig.pulse_before_stop:  # one was on the line when STOP came
                    self.rig.pulse_before_stop = False
                    self._say(*Pulse(self.next_index, self.rig.counter, time.time_ns(), time.time_ns()).words())
                self._say("OK", "STOP", self.next_index, self.rig.counter)
            else:
                self._say("OK", "STATUS", int(self.running), self.next_index, self.rig.counter)

    def _pulse(self) -> None:
        while not self._stop.wait(1 / self.rig.rate_hz):
            with self._mutex:
                self.running = self.running and self.next_index < self.last
                if not self.running:
                    continue
                now_ns = time.time_ns()
                index = self.next_index
                self.next_index += 1
                self.rig.counter += 1
                if index in self.rig.garbled_pulses:
                    os.write(self.master, b"$PULSE 1 2*0000\r\n")
                elif index not in self.rig.silent_pulses:
                    self._say(*Pulse(index, self.rig.counter, now_ns, now_ns).words())
                self.rig.edge(index, now_ns)


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeRig]:
    """A running board and the backend ``fake``."""
    rig = FakeRig()
    board = FakeBoard(rig)
    module = types.ModuleType("fake_camera_backend")
    module.FakeCamera = type("FakeCamera", (FakeCamera,), {"rig": rig})
    monkeypatch.setitem(sys.modules, "fake_camera_backend", module)
    monkeypatch.setitem(capture.camera.BACKENDS, "fake", ("fake_camera_backend", "FakeCamera"))
    rig.board = board
    yield rig
    board.close()


@pytest.fixture
def write_config(tmp_path: Path, rig: FakeRig) -> Callable[..., Path]:
    """Writes a configuration for the fake rig; ``extra`` lines are appended to its tables."""

    def write(rate_hz: float = 100.0, disks: str = "", ring: str = "", top: str = "") -> Path:
        cameras = "".join(
            f'[[cameras]]\nside = "{side}"\nname = "{name}"\naddress = "{side}_{name}"\n'
            for side in ("left", "right")
            for name in ("cam0", "cam1")
        )
        path = tmp_path / "wingcap.toml"
        for disk_folder in ("ssd_left", "ssd_right"):
            (tmp_path / disk_folder).mkdir(exist_ok=True)
        path.write_text(
            f'flight = "test"\n{top}\n'
            f'[trigger]\nport = "{rig.port}"\nrate_hz = {rate_hz}\n'
            f'[disks]\nleft = "ssd_left"\nright = "ssd_right"\nreserve_mb = 1\n{disks}\n'
            f"[ring]\nstall_s = 0.5\n{ring}\n"
            f'[camera]\nbackend = "fake"\nwidth = {WIDTH}\nheight = {HEIGHT}\nexposure_us = 1000\n'
            f"{cameras}"
        )
        return path

    return write


@pytest.fixture(name="pixels_of")
def _pixels_of() -> Callable[[str, int], np.ndarray]:
    return pixels_of


@pytest.fixture
def wingcap() -> Callable[..., subprocess.CompletedProcess[str]]:
    """Runs the command as a user would."""

    def call(*words: object, timeout: float = 60.0) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", "from capture.cli import main; main()", *map(str, words)]
        return subprocess.run(command, capture_output=True, text=True, timeout=timeout)

    return call
