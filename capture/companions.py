"""A configuration to what runs beside its recording. What a table names is loaded only when the table is there."""

import contextlib
import importlib
from collections.abc import Iterator
from functools import partial

from capture.aux_log import Companion
from capture.clock import Clock
from capture.config import Config
from capture.errors import ConfigError
from capture.listener import Listener
from capture.start_signal import StartSignal


def make_companions(config: Config, clock: Clock, signal: StartSignal | None = None) -> list[Companion]:
    """A listener for each CAN bus, one for the autopilot, and one for the GPIO line. They tell ``signal``, if theirs.

    Raises:
        ConfigError: arming shall begin the recording, and what understands the autopilot is not installed.
    """
    companions: list[Companion] = []
    if config.can:
        from capture.can_log import CanLink

        companions += [Listener(f"can.{bus.name}", partial(CanLink, bus, clock), clock) for bus in config.can]
    if config.mavlink is not None:
        from capture.mavlink_log import DIALECT, MavlinkLink

        arming = signal.tell if signal is not None and config.start.on == "mavlink-arm" else None
        try:
            importlib.import_module(DIALECT)  # large: loaded now, and not while the first frames come
        except ImportError as error:  # else it is said when the link is opened
            if arming is not None:
                raise ConfigError(
                    "start.on = \"mavlink-arm\" needs pymavlink: `pip install 'wingshape[mavlink]'`"
                ) from error
        companions.append(Listener("mavlink", partial(MavlinkLink, config.mavlink, clock, arming), clock))
    if config.start.gpio is not None and signal is not None:
        from capture.gpio import GpioLine

        connect = partial(GpioLine, config.start.gpio, signal)
        companions.append(Listener("gpio", connect, clock, may_be_silent=True))
    return companions


@contextlib.contextmanager
def defect_booked(companion: object, failures: list[str]) -> Iterator[None]:
    """A companion's defect is one of the recording's ``failures``, and does not end it."""
    try:
        yield
    except Exception as error:
        failures.append(f"{type(companion).__name__}: {error!r}")


def make_signal(config: Config, clock: Clock) -> StartSignal | None:
    """For the next recording; None: something else begins it."""
    if config.start.on in ("mavlink-arm", "gpio"):
        return StartSignal(clock, config.start.disarm_ends_after_s)
    return None
