"""A USB3 Vision camera on a plug: descriptors, control commands and the image stream, for the kernel to find.

Two interfaces as the standard has them: control on the bulk endpoints 1, stream on the bulk endpoint 0x82.
"""

import struct
import threading
from collections import deque

from capture.clock import Clock
from hw_sim.u3v_camera import CONTROL_BYTES, INVALID_ADDRESS, MAKER, MODEL, AccessError, Counts, Kind, U3vCamera
from hw_sim.usbip import Descriptors, Plug, UsbDevice

VENDOR_ID, PRODUCT_ID = 0x1E10, 0x300A
CONTROL_IN, STREAM_IN = 0x81, 0x82
_MAGIC = 0x43563355
_READ, _READ_DONE, _WRITE, _WRITE_DONE = 0x0800, 0x0801, 0x0802, 0x0803
_NOT_IMPLEMENTED = 0x8001
_HEAD = struct.Struct("<IHHHH")
_MISC, _VISION, _ASSOCIATED = 0xEF, 0x05, 0x02
_FRAME_WAIT_S = 0.1
POWER_UP_DRIFT_PPM = 7  # of camera 1 against camera 0, of camera 2 against camera 1 …


class U3vPlug(UsbDevice):
    """A camera that can be plugged in and pulled, any number of times. Each time it powers up afresh."""

    def __init__(self, number: int, clock: Clock, kind: Kind | None = None) -> None:
        self.serial = f"1749{number:04d}"
        self.guid = f"0A1B{number:08X}"  # as the standard has it: the maker's four digits, then eight of the device
        self.device_id = f"{MAKER}-{self.guid}-{self.serial}"  # by which hosts tell cameras apart
        self.camera: U3vCamera | None = None  # None: unplugged
        self.counts = Counts()  # since the beginning, over all power-ups
        self.descriptors = _descriptors(self.serial, self.guid)
        self._number = number
        self._clock = clock
        self._kind = kind or Kind()
        self._plug = Plug(self, self.serial)
        self._answers: deque[bytes] = deque()
        self._answered = threading.Condition()

    def plug_in(self) -> None:
        """Power up and attach.

        Raises:
            SimulationError: the kernel does not take it.
        """
        drift_ppm = 20 + POWER_UP_DRIFT_PPM * self._number
        camera = U3vCamera(self._number, self.serial, self._clock.utc_ns(), drift_ppm, self.counts, self._kind)
        self._answers.clear()
        self._plug.plug_in()
        self.camera = camera
        for work, what in ((self._answer, "control"), (self._stream, "stream")):
            threading.Thread(target=work, args=(camera,), name=f"{what}-{self.serial}", daemon=True).start()

    def unplug(self) -> None:
        """Pull the cable. Safe to call twice."""
        self.camera = None
        with self._answered:
            self._answered.notify_all()
        self._plug.unplug()

    def received(self, endpoint: int, data: bytes) -> None:
        """A control command; its acknowledgement is queued."""
        camera = self.camera
        if camera is None:
            return
        magic, _, command, _, request = _HEAD.unpack_from(data)
        if magic != _MAGIC:
            return
        try:
            kind, body = self._obey(camera, command, data[_HEAD.size :])
            answer = _HEAD.pack(_MAGIC, 0, kind, len(body), request) + body
        except AccessError as error:
            answer = _HEAD.pack(_MAGIC, error.status, command + 1, 0, request)
        self._plug.wake()  # a stream that was stopped just now waits in vain
        with self._answered:
            self._answers.append(answer)
            self._answered.notify_all()

    def _obey(self, camera: U3vCamera, command: int, body: bytes) -> tuple[int, bytes]:
        if len(body) < 8:
            raise AccessError(INVALID_ADDRESS)
        (address,) = struct.unpack_from("<Q", body)
        if command == _READ:
            _, size = struct.unpack_from("<HH", body, 8)
            if size > CONTROL_BYTES - _HEAD.size:
                raise AccessError(INVALID_ADDRESS)
            return _READ_DONE, camera.read(address, size)
        if command == _WRITE:
            camera.write(address, body[8:], self._clock.utc_ns())
            return _WRITE_DONE, struct.pack("<HH", 0, len(body) - 8)
        raise AccessError(_NOT_IMPLEMENTED)

    def _answer(self, camera: U3vCamera) -> None:
        while True:
            with self._answered:
                self._answered.wait_for(lambda: bool(self._answers) or self.camera is not camera)
                if self.camera is not camera:
                    return
                answer = self._answers.popleft()
            self._plug.send(CONTROL_IN, memoryview(answer), lambda: self.camera is camera)

    def _stream(self, camera: U3vCamera) -> None:
        while self.camera is camera:
            frame = camera.next_frame(_FRAME_WAIT_S)
            if frame is None:
                continue
            parts = (memoryview(frame.leader), frame.payload, memoryview(frame.trailer))
            if all(self._plug.send(STREAM_IN, part, lambda: self._wanted(camera)) for part in parts):
                camera.sent(frame)

    def _wanted(self, camera: U3vCamera) -> bool:
        return self.camera is camera and camera.streaming


def _descriptors(serial: str, guid: str) -> Descriptors:
    device = struct.pack(
        *("<BBHBBBBHHHBBBB", 18, 1, 0x0300, _MISC, 2, 1, 9, VENDOR_ID, PRODUCT_ID, 0x0100, 1, 2, 3, 1),
    )
    control = struct.pack("<BBBBBBBBB", 9, 4, 0, 0, 2, _MISC, _VISION, 0, 0)
    info = struct.pack("<BBBIIBBBBBBBBB", 20, 0x24, 1, 0x00010000, 0x00010000, 4, 1, 2, 0, 0, 0, 3, 0, 8)
    stream = struct.pack("<BBBBBBBBB", 9, 4, 1, 0, 1, _MISC, _VISION, _ASSOCIATED, 0)
    association = struct.pack("<BBBBBBBB", 8, 11, 0, 2, _MISC, _VISION, 0, 0)
    body = association + control + info + _endpoint(CONTROL_IN) + _endpoint(0x01) + stream + _endpoint(STREAM_IN)
    configuration = struct.pack("<BBHBBBBB", 9, 2, 9 + len(body), 2, 1, 0, 0x80, 100) + body
    capabilities = struct.pack("<BBBI", 7, 16, 2, 0) + struct.pack("<BBBBHBBH", 10, 16, 3, 0, 0x0E, 3, 10, 100)
    bos = struct.pack("<BBHB", 5, 15, 5 + len(capabilities), 2) + capabilities
    return Descriptors(device, configuration, bos, (MAKER, MODEL, serial, guid))


def _endpoint(address: int) -> bytes:
    """A SuperSpeed bulk endpoint and its companion."""
    return struct.pack("<BBBBHB", 7, 5, address, 2, 1024, 0) + struct.pack("<BBBBH", 6, 0x30, 15, 0, 0)
