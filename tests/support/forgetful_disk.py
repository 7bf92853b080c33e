"""A disk for a guest that forgets what was not flushed when its power is cut: an NBD server over an image file.

A write is answered at once and kept aside; a flush moves all that was answered before it into the image file. ``cut``
is the power cut: from then on nothing is taken, and of what was kept aside nothing survives, or, as real disks have it,
an arbitrary part, sector by sector. The protocol: https://github.com/NetworkBlockDevice/nbd/blob/master/doc/proto.md
(fixed newstyle, simple replies).
"""

import contextlib
import mmap
import random
import socket
import struct
import threading
from pathlib import Path

SECTOR = 512
_OLD_MAGIC, _NEW_MAGIC, _OPTION_REPLY = 0x4E42444D41474943, 0x49484156454F5054, 0x3E889045565A9
_REQUEST, _SIMPLE_REPLY = 0x25609513, 0x67446698
_FIXED_NEWSTYLE, _NO_ZEROES = 1, 2
_EXPORT_NAME, _ABORT, _GO = 1, 2, 7
_ACK, _INFO, _UNSUPPORTED = 1, 3, 0x80000001
_HAS_FLAGS, _SENDS_FLUSH = 1, 4
_READ, _WRITE, _DISCONNECT, _FLUSH = 0, 1, 2, 3
_EINVAL = 22


class ForgetfulDisk:
    """One disk, served on a Unix socket to one guest."""

    def __init__(self, image: Path, address: Path) -> None:
        """Serve ``image`` (whole sectors) at ``address``."""
        self.flushes = 0
        self.forgotten = 0  # sectors that were kept aside at the cut and did not survive
        self._address = address
        with image.open("r+b") as file:
            self._image = mmap.mmap(file.fileno(), 0)
        self._aside: dict[int, bytes] = {}  # by sector
        self._alive = True
        self._answers = threading.Event()
        self._answers.set()
        self._mutex = threading.Lock()
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(address))
        self._listener.listen(1)
        self._thread = threading.Thread(target=self._serve, name=f"nbd-{address.name}", daemon=True)
        self._thread.start()

    @property
    def drive(self) -> str:
        """QEMU's -drive option for it: the guest's flushes arrive here, and nothing is cached on the way."""
        return f"file=nbd+unix:///?socket={self._address},format=raw,cache=writeback"

    def cut(self, survives: random.Random | None = None) -> None:
        """Cut the power. With ``survives``, each sector that was kept aside is on the disk or not, as it decides."""
        with self._mutex:
            self._alive = False
            for sector, data in self._aside.items():
                if survives is not None and survives.random() < 0.5:
                    self._image[sector * SECTOR : (sector + 1) * SECTOR] = data
                else:
                    self.forgotten += 1
            self._aside.clear()

    def hang(self) -> None:
        """Answer nothing more: whoever in the guest waits for this disk can not even be killed."""
        self._answers.clear()

    def close(self) -> None:
        """End; the image file holds what survived."""
        self.cut()
        self._answers.set()
        self._listener.close()
        self._thread.join(10.0)
        self._image.flush()
        self._image.close()

    def _serve(self) -> None:
        try:
            connection, _ = self._listener.accept()
            with connection:
                if self._agree(connection):
                    while self._obey(connection):
                        pass
        except (EOFError, OSError):  # the guest is gone
            return

    def _agree(self, connection: socket.socket) -> bool:
        """The handshake; whether requests follow."""
        connection.sendall(struct.pack(">QQH", _OLD_MAGIC, _NEW_MAGIC, _FIXED_NEWSTYLE | _NO_ZEROES))
        _read(connection, 4)
        export = struct.pack(">QH", len(self._image), _HAS_FLAGS | _SENDS_FLUSH)
        while True:
            _, option, length = struct.unpack(">QII", _read(connection, 16))
            _read(connection, length)

            def reply(kind: int, body: bytes = b"", option: int = option) -> None:
                connection.sendall(struct.pack(">QIII", _OPTION_REPLY, option, kind, len(body)) + body)

            if option == _EXPORT_NAME:
                connection.sendall(export)
                return True
            if option == _GO:
                reply(_INFO, struct.pack(">H", 0) + export)
                reply(_ACK)
                return True
            reply(_ACK if option == _ABORT else _UNSUPPORTED)
            if option == _ABORT:
                return False

    def _obey(self, connection: socket.socket) -> bool:
        """One request; whether more may follow."""
        magic, _, kind, handle, offset, length = struct.unpack(">IHHQQI", _read(connection, 28))
        if magic != _REQUEST or kind == _DISCONNECT:
            return False
        data = _read(connection, length) if kind == _WRITE else b""
        self._answers.wait()
        with self._mutex:
            if not self._alive:
                return False
            error, answer = self._done(kind, offset, length, data)
        connection.sendall(struct.pack(">IIQ", _SIMPLE_REPLY, error, handle) + answer)
        return True

    def _done(self, kind: int, offset: int, length: int, data: bytes) -> tuple[int, bytes]:
        if offset % SECTOR or length % SECTOR or offset + length > len(self._image):
            return _EINVAL, b""
        first, count = offset // SECTOR, length // SECTOR
        if kind == _READ:
            found = bytearray(self._image[offset : offset + length])
            for number in range(count):
                if first + number in self._aside:
                    found[number * SECTOR : (number + 1) * SECTOR] = self._aside[first + number]
            return 0, bytes(found)
        if kind == _WRITE:
            for number in range(count):
                self._aside[first + number] = data[number * SECTOR : (number + 1) * SECTOR]
            return 0, b""
        if kind == _FLUSH:
            self.flushes += 1
            for sector, kept in self._aside.items():
                self._image[sector * SECTOR : (sector + 1) * SECTOR] = kept
            self._aside.clear()
            return 0, b""
        return _EINVAL, b""


def _read(connection: socket.socket, size: int) -> bytes:
    data = bytearray()
    while len(data) < size:
        with contextlib.suppress(InterruptedError):
            part = connection.recv(size - len(data))
            if not part:
                raise EOFError
            data += part
    return bytes(data)
