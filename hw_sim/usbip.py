"""A USB device written in Python to a device that this kernel has: USB/IP on a socket pair into vhci_hcd.

The kernel's side (module ``vhci-hcd``, root needed) enumerates it at SuperSpeed like one on a cable. Protocol: the
kernel's Documentation/usb/usbip_protocol.rst.
"""

import contextlib
import os
import socket
import struct
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from capture.errors import SimulationError

_HUB = Path("/sys/devices/platform/vhci_hcd.0")
_SUPER_SPEED = 5
_FREE_PORT = "004"
_SUBMIT, _UNLINK, _RET_SUBMIT, _RET_UNLINK = 1, 2, 3, 4
_HEAD = struct.Struct(">IIIII")
_HEAD_BYTES = 48
_EPIPE, _ECONNRESET = 32, 104
_IN = 0x80
_GET_STATUS, _GET_DESCRIPTOR, _GET_CONFIGURATION, _GET_INTERFACE = 0, 6, 8, 10
_DEVICE, _CONFIGURATION, _STRING, _BOS = 1, 2, 3, 15
_ENGLISH = b"\x04\x03\x09\x04"


@dataclass(frozen=True)
class Descriptors:
    """What a USB device says of itself."""

    device: bytes
    configuration: bytes  # with its interfaces and endpoints
    bos: bytes
    strings: tuple[str, ...]  # from index 1 on

    def answer(self, kind: int, index: int) -> bytes | None:
        """The descriptor asked for; None: there is none."""
        if kind == _STRING:
            if index == 0:
                return _ENGLISH
            if index > len(self.strings):
                return None
            text = self.strings[index - 1].encode("utf-16-le")
            return bytes([len(text) + 2, _STRING]) + text
        return {_DEVICE: self.device, _CONFIGURATION: self.configuration, _BOS: self.bos}.get(kind)


class UsbDevice(ABC):
    """What is behind the plug: descriptors, and what is done with data that comes in."""

    descriptors: Descriptors

    @abstractmethod
    def received(self, endpoint: int, data: bytes) -> None:
        """The host has written ``data`` to a bulk endpoint. From the plug's thread; must not block."""


class Plug:
    """One cable between a device and the kernel. ``send`` may be called from any thread."""

    def __init__(self, device: UsbDevice, name: str) -> None:
        self._device = device
        self._name = name
        self._connection: socket.socket | None = None
        self._port = -1
        self._asked: dict[int, deque[tuple[int, int]]] = {}  # by endpoint: number and size of the host's requests
        self._changed = threading.Condition()
        self._writing = threading.Lock()

    def plug_in(self) -> None:
        """Attach to the first free SuperSpeed port; the kernel begins to enumerate.

        Raises:
            SimulationError: no vhci_hcd, no free port, or not allowed.
        """
        ours, kernels = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            port = _free_port()
            (_HUB / "attach").write_text(f"{port} {kernels.fileno()} {(1 << 16) | (port + 1)} {_SUPER_SPEED}")
        except OSError as error:
            ours.close()
            raise SimulationError(
                f"{self._name}: cannot be plugged in ({error}): load the kernel module vhci-hcd, and be root"
            ) from error
        finally:
            kernels.close()
        with self._changed:
            self._connection, self._port = ours, port
            self._asked = {}
        threading.Thread(target=self._serve, args=(ours,), name=f"usb-{self._name}", daemon=True).start()

    def unplug(self) -> None:
        """Pull the cable. Safe to call twice."""
        with self._changed:
            connection, self._connection = self._connection, None
            self._changed.notify_all()
        if connection is None:
            return
        with contextlib.suppress(OSError):
            (_HUB / "detach").write_text(str(self._port))
        with contextlib.suppress(OSError):
            connection.shutdown(socket.SHUT_RDWR)
        connection.close()

    def send(self, endpoint: int, data: memoryview, wanted: Callable[[], bool]) -> bool:
        """Give the host ``data`` from a bulk endpoint, as it asks for it, ended by a short packet or a full request.

        Waits for the host's requests; False when unplugged, or when no longer ``wanted``, before all of it was taken.
        """
        at = 0
        while at < len(data) or not at:
            with self._changed:
                connection = self._connection
                asked = self._asked.setdefault(endpoint, deque())
                self._changed.wait_for(
                    lambda: bool(asked) or not wanted() or self._connection is not connection  # noqa: B023
                )
                if not wanted() or connection is None or self._connection is not connection:
                    return False
                number, size = asked.popleft()
                part = data[at : at + size]
                self._reply(connection, number, 0, len(part), part)  # before the host can take its request back
            at += max(len(part), 1)
        return True

    def wake(self) -> None:
        """Let every waiting ``send`` ask again whether it is wanted."""
        with self._changed:
            self._changed.notify_all()

    def _serve(self, connection: socket.socket) -> None:
        try:
            while True:
                head = _read(connection, _HEAD_BYTES)
                command, number, _, is_in, endpoint = _HEAD.unpack_from(head)
                if command == _SUBMIT:
                    self._submitted(connection, number, endpoint | (_IN if is_in else 0), head)
                elif command == _UNLINK:
                    self._unlinked(connection, number, int.from_bytes(head[20:24], "big"))
        except (EOFError, OSError):  # unplugged, by us or by the kernel
            with self._changed:
                if self._connection is connection:
                    self._connection = None
                self._changed.notify_all()

    def _submitted(self, connection: socket.socket, number: int, endpoint: int, head: bytes) -> None:
        size = int.from_bytes(head[24:28], "big")
        data = b"" if endpoint & _IN else _read(connection, size)
        if endpoint & ~_IN == 0:
            answer = self._control(head[40:48])
            if answer is None:
                self._reply(connection, number, -_EPIPE, 0)
            else:
                taken = size if endpoint == 0 else len(answer)
                self._reply(connection, number, 0, taken, b"" if endpoint == 0 else answer)
        elif endpoint & _IN:
            with self._changed:
                self._asked.setdefault(endpoint, deque()).append((number, size))
                self._changed.notify_all()
        else:
            self._reply(connection, number, 0, size)
            self._device.received(endpoint, data)

    def _unlinked(self, connection: socket.socket, number: int, victim: int) -> None:
        """The host takes a request back; one that was answered already is answered by status 0."""
        found = False
        with self._changed:
            for asked in self._asked.values():
                for request in [request for request in asked if request[0] == victim]:
                    asked.remove(request)
                    found = True
        packet = struct.pack(">IIIIIi24x", _RET_UNLINK, number, 0, 0, 0, -_ECONNRESET if found else 0)
        with self._writing:
            connection.sendall(packet)

    def _control(self, setup: bytes) -> bytes | None:
        """The answer to a request on endpoint 0; None stalls it."""
        kind, request, value, _, size = struct.unpack("<BBHHH", setup)
        if not kind & _IN:
            return b""  # SET_CONFIGURATION, CLEAR_FEATURE …: nothing to do
        if request == _GET_DESCRIPTOR:
            found = self._device.descriptors.answer(value >> 8, value & 0xFF)
        else:
            found = {_GET_STATUS: b"\0\0", _GET_CONFIGURATION: b"\1", _GET_INTERFACE: b"\0"}.get(request)
        return None if found is None else found[:size]

    def _reply(
        self, connection: socket.socket, number: int, status: int, size: int, data: bytes | memoryview = b""
    ) -> None:
        head = struct.pack(">IIIIIiI20x", _RET_SUBMIT, number, 0, 0, 0, status, size)
        with self._writing, contextlib.suppress(OSError):  # unplugged meanwhile: `_serve` tells
            connection.sendall(head)
            connection.sendall(data)


def _free_port() -> int:
    for path in sorted(_HUB.glob("status*")):
        for line in path.read_text().splitlines():
            words = line.split()
            if words[:1] == ["ss"] and words[2] == _FREE_PORT:
                return int(words[1])
    raise OSError(os.strerror(19))


def _read(connection: socket.socket, size: int) -> bytes:
    data = bytearray(size)
    view = memoryview(data)
    while view:
        got = connection.recv_into(view)
        if not got:
            raise EOFError
        view = view[got:]
    return bytes(data)
