"""The recorder's side of a simulated camera: frames from the rig's shared memory into the recorder's buffers.

Address: ``<socket path>#<side>_<camera>``. A frame is copied once, from shared memory into the buffer that was queued
for it, as a USB driver's DMA would put it there; with no buffer queued, the camera drops it.
"""

import collections
import contextlib
import mmap
import os
import socket

import numpy as np
from numpy.typing import NDArray

from capture.camera.base import Camera, CameraDescription, CameraSettings, FrameStatus, Grab
from capture.clock import SystemClock
from capture.errors import CameraError, CameraLost
from hw_sim import link

_REPLY_TIMEOUT_S = 20.0  # the rig may have to draw its noise frames afresh for this exposure


class SimulatedCamera(Camera):
    """One camera of a running ``wingsim rig``."""

    def __init__(self, address: str, settings: CameraSettings) -> None:
        super().__init__(address, settings)
        self._clock = SystemClock()
        self._socket: socket.socket | None = None
        self._images: NDArray[np.uint8] = np.empty((0, 0), dtype=np.uint8)
        self._queued: collections.deque[tuple[int, memoryview]] = collections.deque()

    def open(self) -> CameraDescription:
        """Connect to the rig and ask for the camera.

        Raises:
            CameraError: no rig there, no such camera, in use, or of another size than the settings'.
        """
        path, _, name = self.address.rpartition("#")
        if not path:
            raise CameraError(f"{self.address}: not an address of a simulated camera: write <rig's socket>#left_cam0")
        self.close()
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        settings = self.settings
        request = link.OpenRequest(name, settings.width, settings.height, settings.exposure_us, settings.gain_db)
        self._socket.settimeout(_REPLY_TIMEOUT_S)
        try:
            self._socket.connect(path)
            self._socket.send(request.encode())
            packet, descriptors, _, _ = socket.recv_fds(self._socket, link.MAX_PACKET_BYTES, 1)
            reply = link.OpenReply.decode(packet)
        except (OSError, ValueError) as error:
            self.close()
            raise CameraError(
                f"{self.address}: no simulated rig answers ({error}): start `wingsim rig --socket {path} …` first"
            ) from error
        if reply.description is None or not descriptors:
            self.close()
            raise CameraError(f"{self.address}: {reply.error}")
        try:
            memory = mmap.mmap(descriptors[0], 0)
        finally:
            os.close(descriptors[0])
        size = reply.description.width * reply.description.height
        self._images = np.frombuffer(memory, dtype=np.uint8).reshape(link.SLOTS, size)
        return reply.description

    def queue(self, slot: int, buffer: memoryview) -> None:
        """Give the camera an empty buffer; on a lost camera it is kept, and ``grab`` tells of the loss."""
        self._queued.append((slot, buffer))
        with contextlib.suppress(OSError):
            self._opened().send(link.WANT)

    def arm(self) -> None:
        """Arm, and wait until the camera says so.

        Raises:
            CameraLost: the rig is gone.
        """
        self._ask(link.ARM)

    def grab(self, timeout_s: float) -> Grab | None:
        """The next frame, or None after ``timeout_s``.

        Raises:
            CameraLost: the rig is gone.
        """
        packet = self._receive(timeout_s)
        if packet is None or packet[:1] != link.FRAME or not self._queued:
            return None
        message = link.FrameMessage.decode(packet)
        slot, buffer = self._queued.popleft()
        image = self._images[message.slot]
        np.copyto(np.frombuffer(buffer, dtype=np.uint8)[: image.size], image)  # lets other threads run
        receive_ns = self._clock.utc_ns()
        with contextlib.suppress(OSError):  # a rig that went just now: this frame is whole, the next grab tells
            self._opened().send(link.encode_free(message.slot))
        return Grab(
            slot,
            message.frame_id,
            message.device_ticks,
            receive_ns,
            message.exposure_us,
            message.gain_db,
            FrameStatus.COMPLETE if message.complete else FrameStatus.INCOMPLETE,
            "" if message.complete else "cut short on the way",
        )

    def disarm(self) -> None:
        """Disarm; frames on their way are thrown away."""
        if self._socket is not None:
            with contextlib.suppress(CameraLost):
                self._ask(link.DISARM)
        self._queued.clear()

    def close(self) -> None:
        """Let go of the camera."""
        if self._socket is not None:
            self._socket.close()
        self._socket = None
        self._queued.clear()
        self._images = np.empty((0, 0), dtype=np.uint8)

    def _opened(self) -> socket.socket:
        if self._socket is None:
            raise CameraLost(f"{self.address}: the camera is not open")
        return self._socket

    def _ask(self, letter: bytes) -> None:
        try:
            self._opened().send(letter)
        except OSError as error:
            raise CameraLost(f"{self.address}: the simulated rig is gone ({error})") from error
        while True:
            packet = self._receive(_REPLY_TIMEOUT_S)
            if packet is None:
                raise CameraLost(f"{self.address}: the simulated rig did not answer in {_REPLY_TIMEOUT_S:g} s")
            if packet == letter:
                return
            if packet[:1] == link.FRAME:  # older than the answer: nobody waits for it any more
                with contextlib.suppress(OSError):
                    self._opened().send(link.encode_free(link.FrameMessage.decode(packet).slot))

    def _receive(self, timeout_s: float) -> bytes | None:
        connection = self._opened()
        connection.settimeout(max(timeout_s, 1e-6))
        try:
            packet = connection.recv(link.MAX_PACKET_BYTES)
        except (TimeoutError, BlockingIOError):
            return None
        except OSError as error:
            raise CameraLost(f"{self.address}: the simulated rig is gone ({error})") from error
        if not packet:
            raise CameraLost(f"{self.address}: the simulated rig is gone: is `wingsim rig` still running?")
        return packet
