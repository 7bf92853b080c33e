"""A configuration to what runs beside its recording. What a table names is loaded only when the table is there."""

import contextlib
import importlib
from collections.abc import Iterator
from functools import partial

from capture.aux_log import Companion
from capture.clock import Clock
from capture.config import Config
from capture.listener import Listener


def make_companions(config: Config, clock: Clock) -> list[Companion]:
    """A listener for each CAN bus, and one for the autopilot."""
    companions: list[Companion] = []
    if config.can:
        from capture.can_log import CanLink

        companions += [Listener(f"can.{bus.name}", partial(CanLink, bus, clock), clock) for bus in config.can]
    if config.mavlink is not None:
        from capture.mavlink_log import DIALECT, MavlinkLink

        with contextlib.suppress(ImportError):  # is said when the link is opened
            importlib.import_module(DIALECT)  # large: loaded now, and not while the first frames come
        companions.append(Listener("mavlink", partial(MavlinkLink, config.mavlink, clock), clock))
    return companions


@contextlib.contextmanager
def defect_booked(companion: object, failures: list[str]) -> Iterator[None]:
    """A companion's defect is one of the recording's ``failures``, and does not end it."""
    try:
        yield
    except Exception as error:
        failures.append(f"{type(companion).__name__}: {error!r}")
