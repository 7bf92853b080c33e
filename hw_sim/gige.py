"""GigE Vision cameras on a trigger line: Aravis' own network camera, fired by the simulated trigger board.

Each camera is a real GigE Vision device as far as the recorder can tell: discovery, control channel with heartbeat,
GenICam file, packets over the loopback interface at 127.0.0.1, .2, …  It belongs into a network namespace of its own,
since discovery broadcasts (``unshare --net``; ``ip link set lo up``; ``ip address add 127.0.0.2/8 dev lo`` …). A frame
is sent when a real camera would have read it out; its first sixteen bytes are the trigger's index and the camera's
number, the rest is the camera's own noise.
"""

import contextlib
import ctypes
import heapq
import os
import selectors
import threading
from collections import deque
from collections.abc import Callable
from ctypes import CFUNCTYPE, POINTER, byref, c_char_p, c_double, c_int, c_size_t, c_uint32, c_uint64, c_void_p
from pathlib import Path
from typing import Any

import numpy as np

from capture.clock import Clock
from capture.errors import SimulationError
from capture.trigger_protocol import Pulse
from hw_sim import link
from hw_sim.trigger_board import SimulatedBoard
from hw_sim.unix_socket import listen

XML = Path(__file__).parent / "gige_camera.xml"
READOUT_NS = 8_000_000
STREAM_START_NS = 150_000_000  # the fake begins to stream up to 100 ms after the acquisition was started
PACKET_BYTES = 8000
FRAME_STORE = 10  # frames that a camera keeps while the wire, or this program, is busy
_ACQUISITION, _TRIGGER_MODE, _EDGE, _READY, _PRIVILEGE = 0x124, 0x300, 0x30C, 0x201C, 0x0A00
_EXPOSURE, _SENSOR_WIDTH, _SENSOR_HEIGHT, _TEMPERATURE, _PACKET_SIZE = 0x120, 0x11C, 0x118, 0x2000, 0x0D04
_TICK_S = 0.01
_Fill = CFUNCTYPE(None, c_void_p, c_void_p, c_uint32, c_uint32, c_uint32)


class _Library:
    """The functions of libaravis that make a camera."""

    def __init__(self) -> None:
        try:
            aravis = ctypes.CDLL("libaravis-0.8.so.0")
            gobject = ctypes.CDLL("libgobject-2.0.so.0")
        except OSError as error:
            raise SimulationError(f"libaravis-0.8.so.0 cannot be loaded ({error}): install libaravis-0.8-0") from error

        def function(library: ctypes.CDLL, name: str, result: Any, *arguments: Any) -> Callable[..., Any]:
            found = getattr(library, name)
            found.restype, found.argtypes = result, arguments
            return found  # type: ignore[no-any-return]

        self.new = function(aravis, "arv_gv_fake_camera_new_full", c_void_p, c_char_p, c_char_p, c_char_p)
        self.is_running = function(aravis, "arv_gv_fake_camera_is_running", c_int, c_void_p)
        self.inner = function(aravis, "arv_gv_fake_camera_get_fake_camera", c_void_p, c_void_p)
        self.write = function(aravis, "arv_fake_camera_write_register", c_int, c_void_p, c_uint32, c_uint32)
        self.read = function(aravis, "arv_fake_camera_read_register", c_int, c_void_p, c_uint32, POINTER(c_uint32))
        self.poll_hz = function(aravis, "arv_fake_camera_set_trigger_frequency", None, c_void_p, c_double)
        self.set_fill = function(aravis, "arv_fake_camera_set_fill_pattern", None, c_void_p, _Fill, c_void_p)
        self.data = function(aravis, "arv_buffer_get_data", c_void_p, c_void_p, POINTER(c_size_t))
        self.set_time = function(aravis, "arv_buffer_set_timestamp", None, c_void_p, c_uint64)
        self.set_double = function(gobject, "g_object_set", None, c_void_p, c_char_p, c_double, c_void_p)
        self.unref = function(gobject, "g_object_unref", None, c_void_p)


class GigeCamera:
    """One camera. ``plug``, ``unplug`` and ``step`` belong to the rig's thread; its frames are filled in its own."""

    def __init__(self, library: _Library, number: int, size: tuple[int, int], seed: int) -> None:
        draw = np.random.default_rng([seed, 0x61, number])
        self.key = ("left_cam0", "left_cam1", "right_cam0", "right_cam1")[number]
        self.address = f"127.0.0.{number + 1}"
        self.exposed = 0
        self.missed = 0  # edges while it was armed, but its store was full
        self._library = library
        self._number = number
        self._width, self._height = size
        self._pixels = draw.integers(0, 256, size[0] * size[1], dtype=np.uint8)
        self._drift = 1.0 + draw.normal(0.0, 20e-6)
        self._offset_ns = int(draw.integers(10**12, 10**15))
        self._begin_ns: int | None = None
        self._fill_callback = _Fill(self._fill)
        self._outer: int | None = None
        self._inner = 0
        self._ready_at_ns: int | None = None  # None: not acquiring
        self._edges: deque[Pulse] = deque()
        self._deed = ""
        self._leaving, self._holding = False, threading.Lock()
        self._runs = threading.Event()  # cleared while its firmware hangs
        self._runs.set()

    def plug(self) -> None:
        """Power up.

        Raises:
            SimulationError: its address is taken, or the loopback interface is down.
        """
        if self._outer is not None:
            return
        self._leaving = False
        library = self._library
        serial = f"GIGE{self._number:04d}"
        self._outer = library.new(self.address.encode(), serial.encode(), str(XML).encode())
        if not self._outer or not library.is_running(self._outer):
            raise SimulationError(
                f"{self.address}: no camera can listen there: run in a network namespace of its own (`unshare --net`), "
                f"with `ip link set lo up` and `ip address add {self.address}/8 dev lo`"
            )
        self._inner = library.inner(self._outer)
        self._begin_ns = None
        library.poll_hz(self._inner, 1000.0)
        library.set_fill(self._inner, self._fill_callback, None)
        for register, value in (
            (_SENSOR_WIDTH, self._width),
            (_SENSOR_HEIGHT, self._height),
            (_TEMPERATURE, 415 + self._number),
            (_PACKET_SIZE, PACKET_BYTES),
        ):
            library.write(self._inner, register, value)

    def unplug(self) -> None:
        """Be gone, in the middle of whatever it does."""
        with self._holding:
            self._leaving = True
        self._runs.set()  # or its thread could not end
        if self._outer is not None:
            self._library.unref(self._outer)  # its thread is joined
        self._outer, self._ready_at_ns = None, None
        self._edges.clear()

    def obey(self, deed: str) -> None:
        """Do what a hand does to the camera."""
        match deed:
            case "plug":
                self.plug()
            case "unplug":
                self.unplug()
            case "freeze":
                self._runs.clear()
            case "thaw":
                self._runs.set()
            case _:
                self._deed = deed

    def step(self, now_ns: int) -> None:
        """Follow what the recorder has done to the camera: ready for edges a while after its acquisition began."""
        if self._outer is None:
            return
        if not self._read(_PRIVILEGE):
            self._library.write(self._inner, _ACQUISITION, 0)
        if not (self._read(_ACQUISITION) and self._read(_TRIGGER_MODE)):
            if self._ready_at_ns is not None:
                self._library.write(self._inner, _READY, 0)
                self._library.write(self._inner, _EDGE, 0)
            self._ready_at_ns = None
            self._edges.clear()
        elif self._ready_at_ns is None:
            self._ready_at_ns = now_ns + STREAM_START_NS
        elif now_ns >= self._ready_at_ns:
            self._library.write(self._inner, _READY, 1)

    def expose(self, pulse: Pulse) -> int | None:
        """An edge: when its frame is to be sent (UTC nanoseconds); None when the camera is not ready for it."""
        if self._outer is None or self._ready_at_ns is None or pulse.actual_ns < self._ready_at_ns:
            return None
        return pulse.actual_ns + self._read(_EXPOSURE) * 1000 + READOUT_NS

    def send(self, pulse: Pulse) -> None:
        """The frame has been read out."""
        if self._outer is None or self._ready_at_ns is None:
            return
        if len(self._edges) >= FRAME_STORE:
            self.missed += 1
            return
        self.exposed += 1
        self._edges.append(pulse)
        self._library.write(self._inner, _EDGE, 1)

    def _read(self, register: int) -> int:
        value = c_uint32()
        self._library.read(self._inner, register, byref(value))
        return value.value

    def _fill(self, buffer: int, _data: None, _exposure_us: int, _gain: int, _pixel_format: int) -> None:
        """Called in the camera's own thread for each frame, before it is sent."""
        self._runs.wait()
        pulse = self._edges.popleft() if self._edges else None
        if self._edges:
            self._library.write(self._inner, _EDGE, 1)  # the next one of its store
        deed, self._deed = self._deed, ""
        lost = {"drop": 1.0, "truncate": 0.5}.get(deed, 0.0)  # of the packets that follow
        with self._holding:
            if not self._leaving:  # what the library is letting go of must not be held on to: it would hang
                self._library.set_double(self._outer, b"gvsp-lost-ratio", lost, None)
        if pulse is None:
            return
        if self._begin_ns is None:
            self._begin_ns = pulse.actual_ns
        ticks = self._offset_ns + round((pulse.actual_ns - self._begin_ns) * self._drift)
        self._library.set_time(buffer, ticks)
        size = c_size_t()
        into = self._library.data(buffer, byref(size))
        ctypes.memmove(into, self._pixels.ctypes.data, min(size.value, self._pixels.size))
        head = np.array([pulse.index, self._number], dtype="<u8").tobytes()
        ctypes.memmove(into, head, len(head))


class GigeRig:
    """Two to four cameras and a trigger board on a pseudo-terminal; a hand's commands come over a Unix socket."""

    def __init__(
        self,
        cameras: int,
        size: tuple[int, int],
        socket_path: Path,
        trigger_port: Path,
        clock: Clock,
        rate_hz: float = 25.0,
        seed: int = 1,
    ) -> None:
        """Everything is in place when this returns; nothing runs before ``start``.

        Raises:
            SimulationError: libaravis is missing, an address is taken, or the socket or port cannot be put there.
        """
        library = _Library()
        self.error: BaseException | None = None
        self.cameras = [GigeCamera(library, number, size, seed) for number in range(cameras)]
        for camera in self.cameras:
            camera.plug()
        self._clock = clock
        self._listener = listen(socket_path)
        self._socket_path = socket_path
        self._edges: deque[Pulse] = deque()
        self._due: list[tuple[int, int, int, Pulse]] = []
        self._stop = threading.Event()
        self._wake_in, self._wake_out = os.pipe()
        os.set_blocking(self._wake_out, False)
        self._thread = threading.Thread(target=self._work, name="line", daemon=True)
        self._board = SimulatedBoard(trigger_port, rate_hz, seed, clock, self.edge)

    def start(self) -> None:
        """Begin to take edges and commands."""
        self._thread.start()
        self._board.start()

    def edge(self, pulse: Pulse) -> None:
        """An edge on the trigger line. From any thread."""
        self._edges.append(pulse)
        with contextlib.suppress(BlockingIOError):  # full: it is awake anyway
            os.write(self._wake_out, b"!")

    def check(self) -> None:
        """Raise ``SimulationError`` when one of the threads has failed."""
        error = self.error or self._board.error
        if error is not None:
            raise SimulationError(f"the GigE rig failed: {error!r}") from error

    def close(self) -> None:
        """Stop the board, then the cameras."""
        self._board.close()
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(5.0)
        for camera in self.cameras:
            camera.unplug()
        self._listener.close()
        self._socket_path.unlink(missing_ok=True)
        for end in (self._wake_in, self._wake_out):
            os.close(end)

    def _work(self) -> None:
        selector = selectors.DefaultSelector()
        selector.register(self._listener, selectors.EVENT_READ)
        selector.register(self._wake_in, selectors.EVENT_READ)
        try:
            while not self._stop.is_set():
                wait_s = _TICK_S
                if self._due:
                    wait_s = min(max((self._due[0][0] - self._clock.utc_ns()) * 1e-9, 0.0), _TICK_S)
                for key, _ in selector.select(wait_s):
                    if key.fileobj == self._wake_in:
                        os.read(self._wake_in, 4096)
                    else:
                        self._command()
                self._turn()
        except BaseException as error:
            self.error = error
        finally:
            selector.close()

    def _turn(self) -> None:
        now_ns = self._clock.utc_ns()
        for camera in self.cameras:
            camera.step(now_ns)
        while self._edges:
            pulse = self._edges.popleft()
            for number, camera in enumerate(self.cameras):
                due_ns = camera.expose(pulse)
                if due_ns is not None:
                    heapq.heappush(self._due, (due_ns, pulse.counter, number, pulse))
        while self._due and self._due[0][0] <= now_ns:
            _, _, number, pulse = heapq.heappop(self._due)
            self.cameras[number].send(pulse)

    def _command(self) -> None:
        connection, _ = self._listener.accept()
        with connection, contextlib.suppress(OSError):
            connection.settimeout(1.0)
            connection.send(self._obeyed(connection.recv(link.MAX_PACKET_BYTES)))

    def _obeyed(self, packet: bytes) -> bytes:
        try:
            command = link.Command.decode(packet)
            camera = next(camera for camera in self.cameras if camera.key == command.camera)
        except (StopIteration, ValueError) as error:
            return f"not a command for this rig: {error}".encode()
        camera.obey(command.deed)
        return link.DONE
