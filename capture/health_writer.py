"""A recorder's health, written to shared memory by a thread of its own, with the previews beside it."""

import dataclasses
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Self

from capture.clock import Clock
from capture.config import Config
from capture.errors import CaptureError
from capture.health import WRITE_PERIOD_S, Health, default_folder, make_folder, write_health
from capture.ledger import Place
from capture.preview import PreviewWriter
from capture.provenance import software_version
from capture.temperatures import host_temperatures_c
from capture.worker import Worker

STOP_DEADLINE_S = 2.0
TEMPERATURE_PERIOD_S = 5.0


class HealthWriter(Worker):
    """Asks ``source`` for a snapshot twice a second and more, and writes it. One a process.

    Health is a service to those who watch: whatever goes wrong with it is told by ``progress`` and stops nothing.
    """

    def __init__(self, config: Config, clock: Clock, progress: Callable[[str], None]) -> None:
        super().__init__("health")
        self.folder = config.health.folder or default_folder()
        self.source: Callable[[], Health] | None = None
        self.control_socket: Path | None = None
        self._preview_hz = config.health.preview_hz
        self._size = (config.camera.height, config.camera.width)
        self._clock = clock
        self._progress = progress
        self._previews: PreviewWriter | None = None
        self._places: tuple[str, ...] = ()
        self._complained = ""
        self._software = software_version()
        self._temperatures_c: dict[str, float] = {}
        self._temperatures_due_s = 0.0

    def show(self, places: Iterable[Place]) -> PreviewWriter | None:
        """Begin to show frames of these cameras; None: previews are off, or their files cannot be made."""
        places = tuple(places)
        if not self._preview_hz:
            return None
        try:
            make_folder(self.folder)
            self._previews = PreviewWriter(self.folder, places, self._size, self._preview_hz, self._clock)
        except (CaptureError, OSError) as error:
            self._complain(error)
            return None
        self._previews.start()
        self._places = tuple("/".join(place) for place in places)
        return self._previews

    def hide(self) -> None:
        """End the previews. After the write threads have ended."""
        if self._previews is not None:
            self._previews.stop(STOP_DEADLINE_S)
            self._previews = None

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop(STOP_DEADLINE_S)

    def work(self) -> None:
        """Write until asked to stop, and once more then."""
        while True:
            last = self.stop_requested.wait(WRITE_PERIOD_S)
            self._write()
            if last:
                return

    def _write(self) -> None:
        if self.source is None:
            return
        try:
            make_folder(self.folder)
            write_health(self.folder, self._complete(self.source()))
        except Exception as error:  # a snapshot that fails is one that is missing
            self._complain(error)

    def _complete(self, health: Health) -> Health:
        now_s = self._clock.monotonic_s()
        if now_s >= self._temperatures_due_s:
            self._temperatures_due_s = now_s + TEMPERATURE_PERIOD_S
            self._temperatures_c = host_temperatures_c()
        return dataclasses.replace(
            health,
            temperatures_c=self._temperatures_c,
            previews=self._places,
            control_socket=None if self.control_socket is None else str(self.control_socket),
            pid=os.getpid(),
            software=self._software,
            written_utc_ns=self._clock.utc_ns(),
            written_monotonic_s=now_s,
        )

    def _complain(self, error: Exception) -> None:
        if str(error) != self._complained:  # once, not twice a second
            self._complained = str(error)
            self._progress(f"health is not shared: {error}")
