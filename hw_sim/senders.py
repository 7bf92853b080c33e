"""A world to what sends beside the cameras: the CAN node and the autopilot, as far as they are asked for."""

import threading
from abc import ABC, abstractmethod

from capture.clock import Clock
from hw_sim.aircraft import Aircraft
from hw_sim.world import World


class Sender(ABC):
    """Sends from a thread of its own, between ``start`` and ``close``."""

    def __init__(self, name: str) -> None:
        self.error: BaseException | None = None
        self.sent = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Begin to send."""
        self._thread.start()

    def close(self) -> None:
        """Nothing is sent after this returns. Makers of more let go of it then."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(5.0)

    @abstractmethod
    def _work(self) -> None:
        """Send until ``_stop`` is set."""

    def _run(self) -> None:
        try:
            self._work()
        except BaseException as error:
            self.error = error


def make_senders(
    world: World, clock: Clock, can: str | None, mavlink: str | None, armed_s: tuple[float, float] = (0.0, 0.0)
) -> list[Sender]:
    """A CAN node on the bus ``can`` and an autopilot that sends to ``mavlink``; None: without.

    ``armed_s``: the autopilot is armed from … to … seconds from now.
    """
    aircraft = Aircraft(world)
    senders: list[Sender] = []
    if can is not None:
        from hw_sim.can_node import CanNode

        senders.append(CanNode(aircraft, can, clock))
    if mavlink is not None:
        from hw_sim.autopilot import Autopilot

        senders.append(Autopilot(aircraft, mavlink, clock, armed_s))
    return senders
