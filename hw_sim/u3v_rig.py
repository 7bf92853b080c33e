"""USB3 Vision cameras and a trigger board, plugged into this kernel; what goes wrong is told in triggers.

A fault is ``<camera>:<what>@<trigger index>``, so that what it must lead to can be counted:

``unplug@i``     the cable is pulled just before trigger i
``plug@i``       it is put back just before trigger i
``lose@i``       trigger i's frame is exposed and never sent
``truncate@i``   half of trigger i's frame is missing on the wire
``hold@i-j``     the host's controller is not ready from trigger i to j: the camera's frame buffer fills, then overflows
"""

import queue
import re
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from capture.clock import Clock
from capture.errors import SimulationError, UsageError
from capture.trigger_protocol import Pulse
from hw_sim.trigger_board import SimulatedBoard
from hw_sim.u3v import U3vPlug
from hw_sim.u3v_camera import Kind

_FAULT = re.compile(r"(\d):(unplug|plug|lose|truncate|hold)@(\d+)(?:-(\d+))?")
_CLOSE_S = 5.0


@dataclass(frozen=True)
class UsbFault:
    """One thing that goes wrong with one camera."""

    camera: int
    what: str
    index: int  # trigger
    until: int  # of ``hold``: the last trigger of it

    @classmethod
    def parse(cls, text: str) -> "UsbFault":
        """The fault that ``text`` names.

        Raises:
            UsageError: it names none.
        """
        found = _FAULT.fullmatch(text)
        if found is None or (found[2] == "hold") != (found[4] is not None):
            raise UsageError(f"--fault {text}: write 0:unplug@40, 0:plug@60, 1:truncate@20 or 2:hold@30-39")
        return cls(int(found[1]), found[2], int(found[3]), int(found[4] or found[3]))


class U3vRig:
    """``cameras`` cameras on one trigger line."""

    def __init__(
        self,
        cameras: int,
        trigger_port: Path,
        clock: Clock,
        kind: Kind | None = None,
        faults: Sequence[UsbFault] = (),
    ) -> None:
        """The port is there when this returns; nothing is plugged in before ``start``.

        Raises:
            SimulationError: the port cannot be put where asked.
            UsageError: a fault of a camera that is not there.
        """
        for fault in faults:
            if fault.camera >= cameras:
                raise UsageError(f"--fault {fault.camera}:{fault.what}: there are only {cameras} cameras, from 0 on")
        self.plugs = [U3vPlug(number, clock, kind) for number in range(cameras)]
        self.pulses: list[Pulse] = []
        self.error: BaseException | None = None
        self._faults = list(faults)
        # Plugging takes the kernel's time; the board's pulses must not wait for it.
        self._plugging: queue.SimpleQueue[U3vPlug | None] = queue.SimpleQueue()
        self._hand = threading.Thread(target=self._plug_in, name="hand-at-the-plug", daemon=True)
        self._board = SimulatedBoard(trigger_port, 25.0, 1, clock, self._edge)

    def start(self) -> None:
        """Plug all cameras in and begin to take commands.

        Raises:
            SimulationError: the kernel does not take them.
        """
        for plug in self.plugs:
            plug.plug_in()
        self._hand.start()
        self._board.start()

    def check(self) -> None:
        """Raise ``SimulationError`` when one of the threads has failed."""
        error = self.error or self._board.error
        if error is not None:
            raise SimulationError(f"the USB rig failed: {error!r}") from error

    def close(self) -> None:
        """Stop the board, then pull all cables."""
        self._board.close()
        self._plugging.put(None)
        if self._hand.is_alive():
            self._hand.join(_CLOSE_S)
        for plug in self.plugs:
            plug.unplug()

    def _edge(self, pulse: Pulse) -> None:
        """Called by the board's thread."""
        self.pulses.append(pulse)
        for fault in self._faults:
            if fault.index == pulse.index:
                self._befall(fault)
        for plug in self.plugs:
            camera = plug.camera
            if camera is not None:
                camera.edge(pulse.index, pulse.actual_ns)

    def _befall(self, fault: UsbFault) -> None:
        plug = self.plugs[fault.camera]
        camera = plug.camera
        if fault.what == "plug":
            self._plugging.put(plug)
        elif camera is None:
            return
        elif fault.what == "unplug":
            plug.unplug()
        elif fault.what == "lose":
            camera.lose(fault.index)
        elif fault.what == "truncate":
            camera.cut_short(fault.index)
        else:
            camera.hold_until(fault.until)

    def _plug_in(self) -> None:
        try:
            while (plug := self._plugging.get()) is not None:
                plug.plug_in()
        except BaseException as error:
            self.error = error
