"""A world to what sends beside the cameras: the CAN node and the autopilot, as far as they are asked for."""

from typing import Protocol

from capture.clock import Clock
from hw_sim.aircraft import Aircraft
from hw_sim.world import World


class Sender(Protocol):
    """Sends from a thread of its own, between ``start`` and ``close``."""

    error: BaseException | None

    def start(self) -> None:
        """Begin."""

    def close(self) -> None:
        """End."""


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
