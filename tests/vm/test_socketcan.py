"""A CAN bus of a real kernel (vcan): heard to the last frame, what was lost counted, when it was gone noted."""

import json

import pytest
from vm import CHECKOUT, run_in_vm

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> dict:
    program = CHECKOUT / "tests/support/socketcan_bus.py"
    script = f"python {program} /artifacts/can.json"
    run = run_in_vm(script, tmp_path_factory.mktemp("can"), ["can-raw", "vcan"], timeout_s=150)
    if run.exit_code != 0:
        pytest.fail(f"the guest's script ended with {run.exit_code}:\n{run.output}\n{run.console[-3000:]}")
    return json.loads((run.artifacts / "can.json").read_text())


def test_every_frame_of_the_aircraft_is_heard_in_order(told):
    assert told["heard"] == told["sent"] >= 300
    assert set(told["by_identifier"]) == {"256", "257", "258"}
    assert told["counter_steps"] == [1]
    assert told["stamps_grow"]


def test_stamps_are_the_kernels_in_utc(told):
    """None is from the future, and a slow guest reads none of them a second late (then ours would be taken)."""
    assert 0 <= told["earliest_after_stamp_s"] < told["latest_after_stamp_s"] < 1.0


def test_a_flood_is_heard_or_counted_as_lost(told):
    flood = told["flood"]
    assert flood["heard"] + sum(flood["lost"].values()) == flood["sent"]
    assert set(flood["lost"]) <= {"socket full"}


def test_a_bus_taken_down_is_an_outage_and_comes_back(told):
    account = told["account"]
    assert account["can.bus.outages_in_all"] == "2"  # before it was made, and while it was down
    assert all(begin_ns < end_ns for begin_ns, end_ns in json.loads(account["can.bus.outages"]))
