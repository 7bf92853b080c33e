"""The process that is the hardware: a trigger board on a pseudo-terminal and four cameras behind a socket.

Three threads: the board's (``trigger-board``), the cameras' (``cameras``: client packets, rendering at each edge,
delivery when a real camera would have read the frame out) and the caller's, which waits. The frames of one edge are
rendered one after another well within the read-out time; a rig that is held up delivers late, but drops nothing of
itself.
"""

import contextlib
import heapq
import itertools
import os
import selectors
import socket
import threading
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from capture.clock import Clock
from capture.errors import SimulationError
from capture.trigger_protocol import Pulse
from hw_sim import link
from hw_sim.aircraft import Aircraft
from hw_sim.device import CameraDevice
from hw_sim.render import Pixels, noise_frames
from hw_sim.senders import Sender
from hw_sim.trigger_board import SimulatedBoard
from hw_sim.unix_socket import listen
from hw_sim.world import World

_IDLE_S = 0.2


class Rig:
    """The simulated hardware of one world."""

    def __init__(
        self, world: World, socket_path: Path, trigger_port: Path, clock: Clock, senders: Sequence[Sender] = ()
    ) -> None:
        """Everything is in place when this returns; nothing runs before ``start``. ``senders`` run with the rig.

        Raises:
            SimulationError: the socket or the port cannot be put where asked.
        """
        self._listener = listen(socket_path)
        self.pulses: list[Pulse] = []
        self.error: BaseException | None = None
        self._clock = clock
        self._world = world
        self._socket_path = socket_path
        self._noise: dict[tuple[int, float], list[Pixels]] = {}
        self._devices = {camera.key: CameraDevice(world, camera, self._noise_frames) for camera in world.cameras}
        for camera in world.cameras:
            self._noise_frames(camera.exposure_us, camera.gain_db)
        self._edges: deque[Pulse] = deque()
        self._due: list[tuple[int, int, CameraDevice, link.FrameMessage]] = []
        self._order = itertools.count()
        self._stop = threading.Event()
        self._wake_in, self._wake_out = os.pipe()
        os.set_blocking(self._wake_out, False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ, self._accept)
        self._selector.register(self._wake_in, selectors.EVENT_READ, self._awake)
        self._thread = threading.Thread(target=self._work, name="cameras", daemon=True)
        self._senders = tuple(senders)
        self._board = SimulatedBoard(
            trigger_port, world.trigger_rate_hz, world.seed, clock, self.edge, Aircraft(world).analog_volts
        )

    def start(self) -> None:
        """Begin to take commands and clients."""
        for sender in self._senders:
            sender.start()
        self._thread.start()
        self._board.start()

    def check(self) -> None:
        """Raise ``SimulationError`` when one of the threads has failed."""
        for error in (self.error, self._board.error, *(sender.error for sender in self._senders)):
            if error is not None:
                raise SimulationError(f"the simulated rig failed: {error!r}") from error

    def close(self) -> None:
        """Stop the board, then the cameras; clients see them go."""
        for sender in self._senders:
            sender.close()
        self._board.close()
        self._stop.set()
        self._wake()
        if self._thread.is_alive():
            self._thread.join(5.0)
        for device in self._devices.values():
            device.disconnect()
        self._selector.close()
        self._listener.close()
        self._socket_path.unlink(missing_ok=True)
        for end in (self._wake_in, self._wake_out):
            os.close(end)

    def counts(self) -> dict[str, dict[str, int]]:
        """For each camera, how many edges it exposed, delivered, and dropped because nobody wanted the frame."""
        return {key: dict(vars(device.counts)) for key, device in self._devices.items()}

    def _noise_frames(self, exposure_us: int, gain_db: float) -> list[Pixels]:
        key = (exposure_us, gain_db)
        if key not in self._noise:
            self._noise[key] = noise_frames(self._world, exposure_us, gain_db)
        return self._noise[key]

    def edge(self, pulse: Pulse) -> None:
        """An edge on the trigger line. From any thread; the board's calls it."""
        self.pulses.append(pulse)
        self._edges.append(pulse)
        self._wake()

    def _wake(self) -> None:
        with contextlib.suppress(BlockingIOError):  # full: it is awake anyway
            os.write(self._wake_out, b"!")

    def _work(self) -> None:
        try:
            while not self._stop.is_set():
                wait_s = _IDLE_S
                if self._due:
                    wait_s = min(max((self._due[0][0] - self._clock.utc_ns()) * 1e-9, 0.0), _IDLE_S)
                for key, _ in self._selector.select(wait_s):
                    key.data(key.fileobj)
                while self._edges:
                    self._expose(self._edges.popleft())
                self._deliver()
        except BaseException as error:
            self.error = error

    def _expose(self, pulse: Pulse) -> None:
        for device in self._devices.values():
            taken = device.expose(pulse.actual_ns)
            if taken is not None:
                heapq.heappush(self._due, (taken[0], next(self._order), device, taken[1]))

    def _deliver(self) -> None:
        while self._due and self._due[0][0] <= self._clock.utc_ns():
            _, _, device, message = heapq.heappop(self._due)
            connection = device.connection
            device.deliver(message)
            if connection is not None and device.connection is None:
                self._selector.unregister(connection)

    def _awake(self, wake_in: Any) -> None:
        os.read(wake_in, 4096)

    def _accept(self, _listener: Any) -> None:
        connection, _ = self._listener.accept()
        connection.setblocking(False)
        self._selector.register(connection, selectors.EVENT_READ, self._open)

    def _open(self, connection: Any) -> None:
        """A new client's first packet."""
        self._selector.unregister(connection)
        try:
            packet = connection.recv(link.MAX_PACKET_BYTES)
        except OSError:
            packet = b""
        if b'"deed"' in packet:
            with contextlib.suppress(OSError):
                connection.send(self._obeyed(packet))
            connection.close()
            return
        reply, device = self._opened(connection, packet)
        try:
            if reply.description is None or device is None:
                connection.send(reply.encode())
                connection.close()
            else:
                socket.send_fds(connection, [reply.encode()], [device.memory])
                self._selector.register(connection, selectors.EVENT_READ, lambda _: self._packets(device))
        except OSError:
            connection.close()
            if device is not None and device.connection is connection:
                device.disconnect()

    def _obeyed(self, packet: bytes) -> bytes:
        """Do what a command says; the answer."""
        try:
            command = link.Command.decode(packet)
            device = self._devices[command.camera]
        except (KeyError, ValueError) as error:
            return (
                f"the rig does not understand the command: {error}; its cameras are {', '.join(self._devices)}".encode()
            )
        device.obey(command.deed)
        if command.deed == "unplug" and device.connection is not None:
            self._selector.unregister(device.connection)
            device.disconnect()
        return link.DONE

    def _opened(self, connection: socket.socket, packet: bytes) -> tuple[link.OpenReply, CameraDevice | None]:
        try:
            request = link.OpenRequest.decode(packet)
        except ValueError as error:
            return link.OpenReply(None, f"the rig did not understand the request: {error}"), None
        device = self._devices.get(request.camera)
        if device is None:
            names = ", ".join(self._devices)
            return link.OpenReply(None, f"the rig has no camera {request.camera!r}: its cameras are {names}"), None
        return device.connect(connection, request), device

    def _packets(self, device: CameraDevice) -> None:
        connection = device.connection
        assert connection is not None
        try:
            while packet := connection.recv(link.MAX_PACKET_BYTES):
                answer = device.take(packet)
                if answer:
                    connection.send(answer)
        except BlockingIOError:
            return
        except (OSError, ValueError):
            pass
        self._selector.unregister(connection)
        device.disconnect()
