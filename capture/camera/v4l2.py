"""V4L2 devices (Linux video capture), straight into the recorder's buffers where the driver can.

Address: the device file, and what else is to be set: ``/dev/video0``, ``/dev/video0?input=3&fps=10&exposure=fixed``.
``input`` and ``fps`` select an input, and the rate of a device that runs free; ``exposure=fixed`` says that the driver
cannot set the exposure and that the configured one is right; any other name is a control of the driver (as ``v4l2-ctl
-l`` lists them) with its number.

V4L2 itself knows no trigger: a driver that has one has controls of its own for it, of which the usual names are known
(``v4l2_settings.TRIGGER_MODES``). A device without one runs free.
"""

import ctypes
import errno
import os
import time
from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from capture.camera.base import Camera, CameraDescription, CameraSettings, FrameStatus, Grab
from capture.camera.v4l2_device import MOST_BUFFERS, Done, Format, V4l2Device
from capture.camera.v4l2_settings import V4l2Settings, Wishes
from capture.clock import SystemClock
from capture.errors import CameraError, CameraLost
from capture.ring import PAGE, Ring

_BUFFERS = 16  # of the driver's queue: more than are ever given
_SEQUENCE_BITS = 32
_BUSY = "another program uses the device: close that first"
_REMEDIES = {
    errno.ENOENT: "check `address` (`v4l2-ctl --list-devices`), cable and power",
    errno.ENODEV: "check its cable and power",
    errno.EACCES: "put this user into the group `video`",
    errno.EBUSY: _BUSY,
    errno.ENOTTY: "give the device file of a camera",
}


@dataclass
class _Stream:
    """A running acquisition: which of the driver's buffers stands for which slot."""

    maps: list[NDArray[np.uint8]]  # the driver's own memory, by index; empty: it writes to ours
    free: deque[int]
    slots: dict[int, int] = field(default_factory=dict)  # by index


class V4l2Camera(Camera):
    """One V4L2 capture device."""

    def __init__(self, address: str, settings: CameraSettings) -> None:
        super().__init__(address, settings)
        self._clock = SystemClock()
        self._device: V4l2Device | None = None
        self._format: Format | None = None
        self._ours = False  # the driver writes to our memory
        self._exposure_us, self._gain_db = settings.exposure_us, settings.gain_db
        self._stream: _Stream | None = None
        self._buffers: dict[int, ctypes.Array[ctypes.c_char]] = {}  # by slot, until the driver is done with it
        self._waiting: deque[int] = deque()  # slots that no buffer of the driver stands for yet

    def open(self) -> CameraDescription:
        """Connect, set, and read back.

        Raises:
            CameraError: not there, in use, or the driver did not take a setting; with what it took instead.
        """
        self.close()
        wishes = Wishes.parse(self.address)
        try:
            self._device = self.make_device(wishes.path)
            identity = self._device.identity()
            settings = V4l2Settings(self._device, self.address, self.settings)
            self._format, self._exposure_us, self._gain_db, triggered = settings.configure(wishes.others)
            self._ours = self._takes_our_memory(self._device, self._format)
        except OSError as error:
            self.close()
            raise CameraError(f"{self.address}: {error.strerror}: {_remedy(error)}") from error
        except CameraError:
            self.close()
            raise
        buffers = "the recorder's" if self._ours else "the driver's, and one copy a frame"
        return CameraDescription(
            model=identity.card,
            serial=identity.serial,
            width=self._format.width,
            height=self._format.height,
            exposure_us=self._exposure_us,
            gain_db=self._gain_db,
            row_time_ns=0,
            tick_hz=1e9,  # timestamps are nanoseconds of the host's monotonic clock
            frame_id_bits=_SEQUENCE_BITS,
            hardware_trigger=triggered,
            firmware=f"driver {identity.driver}",
            features=(*settings.taken.items(), ("buffers", buffers)),
        )

    def make_device(self, path: str) -> V4l2Device:
        """The device at ``path``. Raises OSError."""
        return V4l2Device(path)

    def queue(self, slot: int, buffer: memoryview) -> None:
        """Give the driver an empty buffer; on a lost camera it is kept, and ``grab`` tells of the loss."""
        size = self.settings.width * self.settings.height
        self._buffers[slot] = (ctypes.c_char * size).from_buffer(buffer)
        self._waiting.append(slot)
        if self._stream is not None:
            try:
                self._give(self._opened(), self._stream)
            except OSError as error:
                if error.errno != errno.ENODEV:
                    raise CameraError(f"{self.address}: the driver refuses a buffer ({error.strerror})") from error

    def arm(self) -> None:
        """Make the driver's queue and start.

        Raises:
            CameraError: the driver takes no buffers, or does not start.
            CameraLost: the device is gone.
        """
        device = self._opened()
        count = min(max(len(self._waiting), _BUFFERS), MOST_BUFFERS)  # of slots beyond that, some wait for a free one
        try:
            maps = device.make_buffers(count, self._ours)
            self._stream = _Stream(maps, deque(range(len(maps) or count)))
            self._give(device, self._stream)
            device.start()
        except OSError as error:
            self.disarm()
            kind = CameraLost if error.errno == errno.ENODEV else CameraError
            raise kind(f"{self.address}: the driver does not start ({error.strerror}): {_remedy(error)}") from error

    def grab(self, timeout_s: float) -> Grab | None:
        """The next buffer, or None after ``timeout_s``.

        Raises:
            CameraLost: the device is gone.
        """
        device, stream = self._opened(), self._stream
        if stream is None:
            raise CameraLost(f"{self.address}: the camera is not armed")
        try:
            done = device.take(timeout_s)
        except OSError as error:
            raise CameraLost(f"{self.address}: the camera is gone ({error.strerror}): {_remedy(error)}") from error
        if done is None:
            return None
        slot = stream.slots.pop(done.index)
        memory = self._buffers.pop(slot)
        if stream.maps:
            self._copy(stream.maps[done.index], memory)
        stream.free.append(done.index)
        return self._told(done, slot)

    def disarm(self) -> None:
        """Stop; the driver has let go of every buffer when this returns."""
        stream, self._stream = self._stream, None
        if stream is not None and self._device is not None:
            stream.maps.clear()
            try:
                self._device.stop()
                self._device.free_buffers()
            except OSError:  # gone: only closing it makes the driver let go
                self._device.close()
                self._device = None
        self._buffers.clear()
        self._waiting.clear()

    def close(self) -> None:
        """Let go of the device."""
        self.disarm()
        if self._device is not None:
            self._device.close()
        self._device = None

    def _opened(self) -> V4l2Device:
        if self._device is None:
            raise CameraLost(f"{self.address}: the camera is not open")
        return self._device

    def _takes_our_memory(self, device: V4l2Device, agreed: Format) -> bool:
        """Whether the driver fills memory like that of a ring; tried with a page-aligned buffer of a frame's size."""
        if agreed.bytes_per_line != agreed.width:
            return False
        size = agreed.width * agreed.height
        trial = (ctypes.c_char * size).from_buffer(Ring(1, -(-size // PAGE) * PAGE, lock_memory=False).slot(0))
        try:
            device.make_buffers(1, ours=True)
            device.give(0, trial)
        except OSError as error:
            if error.errno in (errno.EBUSY, errno.ENODEV):
                raise
            return False
        finally:
            device.stop()
            device.free_buffers()
        return True

    def _give(self, device: V4l2Device, stream: _Stream) -> None:
        while self._waiting and stream.free:
            index, slot = stream.free[0], self._waiting[0]
            stream.slots[index] = slot
            device.give(index, None if stream.maps else self._buffers[slot])
            stream.free.popleft()
            self._waiting.popleft()

    def _copy(self, source: NDArray[np.uint8], memory: ctypes.Array[ctypes.c_char]) -> None:
        assert self._format is not None
        height, width, stride = self._format.height, self._format.width, self._format.bytes_per_line
        rows = source[: height * stride].reshape(height, stride)[:, :width]
        np.copyto(
            np.frombuffer(memoryview(memory).cast("B"), dtype=np.uint8).reshape(height, width), rows
        )  # lets other threads run

    def _told(self, done: Done, slot: int) -> Grab:
        receive_ns = self._clock.utc_ns()
        ticks = done.timestamp_ns
        if ticks is None:  # its clock is unknown: when the frame came is all that can be said
            ticks = time.monotonic_ns()
        if done.timestamp_ns is None or not done.start_of_exposure:
            ticks -= self._exposure_us * 1000
        missing = self.settings.height * (self._format.bytes_per_line if self._format else 0) - done.used_bytes
        detail = "the driver flags an error" if done.faulty else f"{missing} bytes missing" if missing > 0 else ""
        status = FrameStatus.INCOMPLETE if detail else FrameStatus.COMPLETE
        return Grab(slot, done.sequence, ticks, receive_ns, self._exposure_us, self._gain_db, status, detail)


def _remedy(error: OSError) -> str:
    return _REMEDIES.get(error.errno or 0, f"see the kernel's log for what {os.strerror(error.errno or 0)} means here")
