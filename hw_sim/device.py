"""One simulated camera inside the rig: trigger edges and a client's packets, to frames in shared memory."""

import mmap
import os
import socket
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capture.camera.base import CameraDescription
from hw_sim import link
from hw_sim.render import LiveRenderer, Pixels
from hw_sim.world import CameraTruth, World

NoiseSource = Callable[[int, float], list[Pixels]]
"""Exposure in microseconds and gain in dB to the pre-drawn noise frames for them."""


@dataclass
class DeviceCounts:
    """What became of the trigger edges while the camera was armed."""

    exposed: int = 0
    delivered: int = 0
    unwanted: int = 0  # dropped in the camera: no frame was asked for, or no shared slot was free
    spoilt: int = 0  # dropped or cut short on the way, as a command asked


class CameraDevice:
    """One camera of the rig. All methods but ``__init__`` belong to the rig's camera thread."""

    def __init__(self, world: World, camera: CameraTruth, noise: NoiseSource) -> None:
        self.camera = camera
        self.counts = DeviceCounts()
        self.connection: socket.socket | None = None
        self._world = world
        self._noise = noise
        sensor = world.sensor
        self._frame_ids = 1 << sensor.frame_id_bits
        self._frame_id = int(np.random.default_rng([world.seed, 0xF1, *camera.key.encode()]).integers(self._frame_ids))
        size = sensor.height_px * sensor.width_px
        self.memory = os.memfd_create(f"wingsim-{camera.key}")
        os.ftruncate(self.memory, link.SLOTS * size)
        shared = np.frombuffer(mmap.mmap(self.memory, link.SLOTS * size), dtype=np.uint8)
        shared[:] = 0  # touch every page now, not in the first frames
        self._slots: NDArray[np.uint8] = shared.reshape(link.SLOTS, sensor.height_px, sensor.width_px)
        self._renderer: LiveRenderer | None = None
        self._exposure_us, self._gain_db = camera.exposure_us, camera.gain_db
        self._armed = False
        self._wanted = 0
        self._free: list[int] = []
        self._plugged = True
        self._frozen = False
        self._deed = ""  # what happens to the next frame

    def connect(self, connection: socket.socket, request: link.OpenRequest) -> link.OpenReply:
        """Give the camera to a client, configured as it asks; the reply says why not."""
        sensor = self._world.sensor
        if not self._plugged:
            return link.OpenReply(None, "no such camera: it is unplugged; plug it in")
        if self.connection is not None:
            return link.OpenReply(None, "the camera is in use by another program: close that first")
        if (request.width, request.height) != (sensor.width_px, sensor.height_px):
            return link.OpenReply(
                None,
                f"the simulated camera is {sensor.width_px}×{sensor.height_px}, not {request.width}×{request.height}: "
                "set width and height in the configuration, or make another world",
            )
        if not 1 <= request.exposure_us <= 30_000 or not 0.0 <= request.gain_db <= 24.0:
            return link.OpenReply(
                None,
                f"exposure {request.exposure_us} us or gain {request.gain_db:g} dB is out of range: "
                "the simulated camera takes 1 … 30000 us and 0 … 24 dB",
            )
        self.connection = connection
        self._exposure_us, self._gain_db = request.exposure_us, request.gain_db
        noise = self._noise(request.exposure_us, request.gain_db)
        self._renderer = LiveRenderer(self._world, self.camera, noise, request.exposure_us, request.gain_db)
        self._renderer.render(self._world.epoch_ns, self._slots[0])  # fills its caches, so that no first frame is late
        self._armed, self._wanted, self._free = False, 0, list(range(link.SLOTS))
        return link.OpenReply(self._description(), "")

    def obey(self, deed: str) -> None:
        """Do what a hand does to the camera. The caller closes the connection of one that is unplugged."""
        match deed:
            case "unplug" | "plug":
                self._plugged = deed == "plug"
            case "freeze" | "thaw":
                self._frozen = deed == "freeze"
            case _:
                self._deed = deed

    def disconnect(self) -> None:
        """The client is gone."""
        if self.connection is not None:
            self.connection.close()
        self.connection, self._armed, self._wanted = None, False, 0

    def take(self, packet: bytes) -> bytes:
        """Act on a client's packet; the answer, empty for none. Raises ``ValueError`` on nonsense."""
        match packet[:1]:
            case link.WANT:
                self._wanted += 1
            case link.FREE:
                self._free.append(link.decode_free(packet))
            case link.ARM:
                self._armed = True
                return link.ARM
            case link.DISARM:
                self._armed, self._wanted = False, 0
                return link.DISARM
            case _:
                raise ValueError(f"not a packet of this link: {packet[:40]!r}")
        return b""

    def expose(self, edge_ns: int) -> tuple[int, link.FrameMessage] | None:
        """Take a frame at a trigger edge: when it is wholly read out (UTC), and its message; None: no frame."""
        if not self._armed or self._frozen or self._renderer is None:
            return None
        self.counts.exposed += 1
        frame_id = self._frame_id
        self._frame_id = (frame_id + 1) % self._frame_ids
        deed, self._deed = self._deed, ""
        self.counts.spoilt += bool(deed)
        if deed == "drop":
            return None
        if self._wanted == 0 or not self._free:
            self.counts.unwanted += 1
            return None
        self._wanted -= 1
        slot = self._free.pop(0)
        self._renderer.render(edge_ns, self._slots[slot])
        readout_us = self._world.sensor.height_px * self.camera.row_time_us
        ready_ns = edge_ns + round((self._exposure_us + readout_us) * 1000.0)
        ticks, complete = self._ticks(edge_ns), deed != "truncate"
        return ready_ns, link.FrameMessage(slot, frame_id, ticks, self._exposure_us, self._gain_db, complete)

    def deliver(self, message: link.FrameMessage) -> None:
        """Send a frame that has been read out, unless the client disarmed or went in between."""
        if self.connection is None or not self._armed:
            self._free.append(message.slot)
            return
        try:
            self.connection.send(message.encode())
            self.counts.delivered += 1
        except BlockingIOError:
            self._free.append(message.slot)
            self.counts.unwanted += 1
        except OSError:
            self.disconnect()

    def _ticks(self, time_ns: int) -> int:
        since_ns = time_ns - self._world.epoch_ns
        drift_e12 = round(self.camera.clock_drift_ppm * 1e6)  # integers: a float of today's nanoseconds has steps of 16
        ticks_e12 = since_ns * round(self._world.sensor.tick_hz) * (10**12 + drift_e12) // 10**9
        return self.camera.clock_offset_ticks + ticks_e12 // 10**12

    def _description(self) -> CameraDescription:
        sensor = self._world.sensor
        return CameraDescription(
            model=self.camera.model,
            serial=self.camera.serial,
            width=sensor.width_px,
            height=sensor.height_px,
            exposure_us=self._exposure_us,
            gain_db=self._gain_db,
            row_time_ns=round(self.camera.row_time_us * 1000.0),
            tick_hz=sensor.tick_hz,
            frame_id_bits=sensor.frame_id_bits,
            hardware_trigger=True,
        )
