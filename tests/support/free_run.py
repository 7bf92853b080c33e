"""Cameras that run free, recorded by the recorder's own lanes: the clock stands in for the trigger board.

The daemon refuses such cameras, since nothing synchronises them; but driver, ring, books and files can be proven.
"""

import itertools
import time
from collections.abc import Mapping
from pathlib import Path

from capture.aux_log import AuxLog
from capture.bench import ClockedTriggers
from capture.camera import make_camera
from capture.camera.base import CameraSettings
from capture.clock import SystemClock
from capture.config import DRIVER_BUFFERS, DiskConfig
from capture.disk import SystemDisk
from capture.lane import LaneParts, make_lane
from capture.ledger import CameraAccount, Ledger, Place
from capture.record import Trigger


class CountedTriggers(ClockedTriggers):
    """The first ``count`` of them only; a frame after the last is nobody's."""

    def __init__(self, start_ns: int, rate_hz: float, count: int) -> None:
        super().__init__(start_ns, rate_hz)
        self._count = count

    def nearest(self, time_ns: int, wait_s: float) -> tuple[int, int] | None:
        found = super().nearest(time_ns, wait_s)
        return found if found is not None and found[0] < self._count else None


def record_free_running(
    backend: str, addresses: Mapping[Place, str], settings: CameraSettings, rate_hz: float, count: int, folder: Path
) -> dict[Place, CameraAccount]:
    """Record ``count`` periods below ``folder``, a folder a side; the books. ``wingcap verify`` can read it."""
    clock, disk = SystemClock(), SystemDisk()
    aux = AuxLog(clock)
    ledger = Ledger(list(addresses), 0, clock.utc_ns, aux.loss)
    cameras = {place: make_camera(backend, address, settings) for place, address in addresses.items()}
    opened = {place: (camera, camera.open()) for place, camera in cameras.items()}
    period_ns = round(1e9 / rate_hz)
    start_ns = (clock.utc_ns() + 2_000_000_000) // period_ns * period_ns
    parts = LaneParts(
        ledger=ledger,
        triggers=CountedTriggers(start_ns, rate_hz, count),
        clock=clock,
        disk=disk,
        disk_config=DiskConfig(left=folder / "left", right=folder / "right", reserve_mb=1),
        provenance={"flight": "free", "flight_id": "free", "cameras": " ".join(map("/".join, addresses))},
        ring_slots=round(rate_hz) + DRIVER_BUFFERS,
        lock_memory=False,
    )
    lanes = []
    folder.mkdir(parents=True, exist_ok=True)
    for side, group in itertools.groupby(addresses, key=lambda place: place[0]):
        disk.make_folder(folder / side)
        lanes.append(make_lane(side, folder / side, {name: opened[side, name] for _, name in group}, parts))
    for lane in lanes:
        lane.start_writing()
        lane.start()
    for index in range(count):
        edge_ns = start_ns + index * period_ns
        time.sleep(max(0.0, (edge_ns - time.time_ns()) / 1e9))
        ledger.triggered(index + 1)
        aux.trigger(Trigger(index, index + 1, edge_ns, edge_ns, time.time_ns()))
    time.sleep(0.5)
    for lane in lanes:
        assert all(grabber.stop(5.0) and grabber.error is None for grabber in lane.grabbers.values())
    ledger.close(count)
    for camera in cameras.values():
        camera.close()
    end = {
        "first_index": "0",
        "next_index": str(count),
        "counter_begin": "0",
        "counter_end": str(count),
        "board_confirmed": "true",
        "triggers_reported": str(count),
    }
    messages = aux.take()
    for lane in lanes:
        assert lane.recorder.stop(30.0)
        lane.recorder.close(messages, end)
    return ledger.accounts()
