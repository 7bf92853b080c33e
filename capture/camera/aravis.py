"""GenICam cameras (USB3 Vision, GigE Vision) through Aravis, straight into the recorder's buffers.

Address: what Aravis knows a camera by (its id as ``arv-tool-0.8`` lists it, its serial number, the IP address of a GigE
Vision camera), or ``fake:<serial>`` for Aravis' own camera without hardware, which runs free.

The driver's thread writes into the memory given to ``queue`` from ``arm`` on. That memory is held by this object until
the stream is gone (``disarm``): given back earlier, it would be written to after it was freed.
"""

import ctypes
import time
from dataclasses import dataclass

from capture.camera.aravis_chunks import FrameFacts
from capture.camera.aravis_features import Features
from capture.camera.aravis_library import AravisLibrary, BufferStatus, load_library
from capture.camera.base import Camera, CameraDescription, CameraSettings, FrameStatus, Grab
from capture.clock import SystemClock
from capture.errors import CameraError, CameraLost

FAKE = "fake:"
_WRAP = 65535  # block ids of GigE Vision are 1 … 65535, 0 is never used (GigE Vision 2.0, 23.2.1)
_READY_DEADLINE_S = 2.0


@dataclass
class _Stream:
    """A running acquisition and the memory that its thread may write to."""

    pointer: int
    wraps: bool  # its frame ids
    last_id: int = 0  # as the device counts
    unwrapped_id: int = 0


class AravisCamera(Camera):
    """One GenICam camera."""

    def __init__(self, address: str, settings: CameraSettings) -> None:
        super().__init__(address, settings)
        self._clock = SystemClock()
        self._camera: int | None = None
        self._features: Features | None = None
        self._stream: _Stream | None = None
        self._lost = ctypes.c_int(0)
        self._lost_handler = 0
        self._buffers: dict[int, ctypes.Array[ctypes.c_char]] = {}  # by slot: given to the driver, not back yet

    def open(self) -> CameraDescription:
        """Connect, set every feature, and read it back.

        Raises:
            CameraError: not there, in use, or it did not take a setting; with what it took instead.
        """
        self.close()
        library = load_library()
        try:
            self._camera = self._connect(library)
            self._lost.value = 0
            device = library.call("arv_camera_get_device", self._camera)
            self._lost_handler = library.count_signal(device, "control-lost", self._lost)
            if library.call("arv_camera_is_gv_device", self._camera) and not library.call(
                "arv_gv_device_is_controller", device
            ):
                raise CameraError(
                    f"{self.address}: another program has the camera: close that; of one that was killed, the camera "
                    "lets go after its heartbeat (about 3 s)"
                )
            if library.call("arv_camera_is_uv_device", self._camera):
                library.call("arv_camera_uv_set_usb_mode", self._camera, library.usb_mode)
            self._features = Features(library, self._camera, self.address)
            return self._features.configure(self.settings, is_fake=self.address.startswith(FAKE))
        except CameraError as error:
            self.close()
            if str(error).startswith(self.address):
                raise
            raise CameraError(f"{self.address}: {error}: check its cable and power") from error

    def queue(self, slot: int, buffer: memoryview) -> None:
        """Give the driver an empty buffer, to be filled in place."""
        size = self._features.payload_bytes if self._features else self.settings.width * self.settings.height
        self._buffers[slot] = (ctypes.c_char * size).from_buffer(buffer)
        if self._stream is not None:
            self._push(slot, self._stream)

    def arm(self) -> None:
        """Start the acquisition, and wait until the camera waits for a trigger, where it can tell.

        Raises:
            CameraError: it does not start.
            CameraLost: it is gone.
        """
        library, features = load_library(), self._opened()
        pointer = self._call("arv_camera_create_stream", self._camera, None, None)
        if not pointer:
            raise CameraError(f"{self.address}: Aravis makes no stream: unplug the camera and plug it in again")
        wraps = not library.call("arv_camera_is_uv_device", self._camera)
        self._stream = _Stream(pointer, wraps)
        for slot in self._buffers:
            self._push(slot, self._stream)
        self._call("arv_camera_start_acquisition", self._camera)
        deadline_s = time.monotonic() + _READY_DEADLINE_S
        while not features.waits_for_trigger():
            if self._lost.value:
                raise CameraLost(f"{self.address}: the camera is gone: check its cable and power")
            if time.monotonic() > deadline_s:
                raise CameraError(
                    f"{self.address}: armed, but not ready for triggers after {_READY_DEADLINE_S:g} s "
                    f"(libaravis {'.'.join(map(str, library.version))}): check trigger line and mode"
                )
            time.sleep(0.005)

    def grab(self, timeout_s: float) -> Grab | None:
        """The next buffer, or None after ``timeout_s``.

        Raises:
            CameraLost: the device is gone, and all that it had delivered has been taken.
        """
        library, stream = load_library(), self._stream
        if stream is None:
            raise CameraLost(f"{self.address}: the camera is not armed")
        deadline_s = time.monotonic() + timeout_s
        while True:
            left_us = max(round((deadline_s - time.monotonic()) * 1e6), 0)
            pointer = library.call("arv_stream_timeout_pop_buffer", stream.pointer, left_us)
            if not pointer:
                if self._lost.value:
                    raise CameraLost(f"{self.address}: the camera is gone: check its cable and power")
                return None
            grab = self._taken(library, stream, pointer)
            if grab is not None:
                return grab

    def temperature_c(self) -> float | None:
        """The device's own temperature."""
        try:
            return self._opened().temperature_c()
        except CameraError:
            return None

    def disarm(self) -> None:
        """Stop, and wait until the driver has let go of every buffer."""
        if self._stream is None:
            self._buffers.clear()
            return
        library = load_library()
        if not self._lost.value:
            try:
                library.call("arv_camera_stop_acquisition", self._camera)
            except CameraError:
                self._lost.value = 1
        library.unref(self._stream.pointer)  # joins its thread and frees what was queued
        self._stream = None
        self._buffers.clear()

    def close(self) -> None:
        """Let go of the device."""
        self.disarm()
        if self._features is not None:
            self._features.chunks.close()
        if self._camera is not None:
            library = load_library()
            device = library.call("arv_camera_get_device", self._camera)
            if self._lost_handler:
                library.disconnect(device, self._lost_handler)
            library.unref(self._camera)
        self._camera, self._features, self._lost_handler = None, None, 0

    def _connect(self, library: AravisLibrary) -> int:
        try:
            if self.address.startswith(FAKE):
                device = library.call("arv_fake_device_new", self.address.removeprefix(FAKE).encode())
                camera = library.call("arv_camera_new_with_device", device)
                library.unref(device)
            else:
                camera = library.call("arv_camera_new", self.address.encode())
        except CameraError as error:
            raise CameraError(
                f"{self.address}: the camera does not answer ({error}): check cable, power, `address` (`arv-tool-0.8` "
                "lists the cameras), the udev rule for USB, and that no other program uses it"
            ) from error
        if not camera:
            raise CameraError(f"{self.address}: no such camera: `arv-tool-0.8` lists those that answer")
        pointer: int = camera
        return pointer

    def _taken(self, library: AravisLibrary, stream: _Stream, pointer: int) -> Grab | None:
        """What a buffer from the driver holds. None: nothing that can be told, and it was queued again."""
        receive_ns = self._clock.utc_ns()
        slot = library.call("arv_buffer_get_user_data", pointer) - 1
        status = BufferStatus(library.call("arv_buffer_get_status", pointer))
        ticks = library.call("arv_buffer_get_timestamp", pointer)
        frame_id = library.call("arv_buffer_get_frame_id", pointer)
        complete = status is BufferStatus.SUCCESS
        features = self._opened()
        facts = features.chunks.of(pointer) if complete else FrameFacts()
        library.unref(pointer)
        if not complete and not ticks:
            # Its leader is missing, and with it the time of its exposure: the next frame's id shows that it was lost.
            self._push(slot, stream)
            return None
        del self._buffers[slot]
        return Grab(
            slot,
            _unwrap(stream, frame_id),
            ticks,
            receive_ns,
            features.exposure_us if facts.exposure_us is None else facts.exposure_us,
            features.gain_db if facts.gain_db is None else facts.gain_db,
            FrameStatus.COMPLETE if complete else FrameStatus.INCOMPLETE,
            "" if complete else status.name.lower().replace("_", " "),
            facts.counter,
        )

    def _push(self, slot: int, stream: _Stream) -> None:
        library, memory = load_library(), self._buffers[slot]
        tag = slot + 1  # a null pointer would mean that there is none
        buffer = library.call("arv_buffer_new_full", len(memory), ctypes.addressof(memory), tag, None)
        library.call("arv_stream_push_buffer", stream.pointer, buffer)

    def _opened(self) -> Features:
        if self._features is None:
            raise CameraLost(f"{self.address}: the camera is not open")
        return self._features

    def _call(self, name: str, *arguments: object) -> int | None:
        try:
            result: int | None = load_library().call(name, *arguments)
            return result
        except CameraError as error:
            kind = CameraLost if self._lost.value else CameraError
            raise kind(f"{self.address}: {name}: {error}: check its cable and power") from error


def _unwrap(stream: _Stream, frame_id: int) -> int:
    """A counter that never wraps. A frame that comes after a later one keeps its own, smaller number."""
    if not stream.unwrapped_id:
        stream.last_id = stream.unwrapped_id = frame_id
        return frame_id
    step = frame_id - stream.last_id
    if stream.wraps and frame_id <= _WRAP and stream.last_id <= _WRAP:
        step = (step + _WRAP // 2) % _WRAP - _WRAP // 2
    found = stream.unwrapped_id + step
    if step > 0:
        stream.last_id, stream.unwrapped_id = frame_id, found
    return found
