"""A disk that answers no more, on a real kernel: its side is lost with a cause, and the other goes on and says so."""

import pytest
from guest_flight import RATE_HZ, SCALE, SIDES, guest_flight, read_disk

from capture.recover import CAUSE, recover_flight
from capture.verify import inspect
from hw_sim.world import World

pytestmark = pytest.mark.slow
HANGS_S, ENDS_S = 1.5, 10.0
"""of the guest's time since the first frame; the end is a power cut: a process that waits for such a disk never ends"""


def test_a_hung_disk_costs_its_own_side_only(tmp_path):
    with guest_flight(tmp_path, World.make(seed=3, scale=SCALE)) as flight:
        flight.wait(HANGS_S)
        left, right = flight.disks
        left.hang()
        flight.wait(ENDS_S)
        right.cut()
        said = flight.vm.output
    found = [read_disk(tmp_path / f"{side}.img", tmp_path / side) for side in SIDES]
    recover_flight(found, tmp_path / "out")
    report = inspect([tmp_path / "out"])
    assert report.problems == [], said
    for name, camera in report.cameras.items():
        told = {index: loss for index, loss in camera.lost_indices.items() if loss.cause != CAUSE}
        if name.startswith("left"):
            assert camera.recorded <= (HANGS_S + 1.0) * RATE_HZ
            assert len(told) > RATE_HZ, said
            assert {loss.stage for loss in told.values()} == {"ring"}
        else:
            assert camera.recorded >= (ENDS_S - 1.0) * RATE_HZ, said
            assert not told, said
