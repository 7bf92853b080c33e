"""Pulses of a board whose clock is not on UTC, against edges that are known and reports with delays that are drawn."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from capture.trigger import ForeignClock, TriggerLog
from capture.trigger_protocol import Pulse

PERIOD_NS, START_NS = 40_000_000, 1_800_000_000_000_000_000


@given(
    seed=st.integers(0, 10**6),
    drift_ppm=st.floats(-100, 100),
    step_at=st.integers(60, 79),
    step_ns=st.sampled_from([0, 25_000_000, -25_000_000, 10**9]),
)
def test_times_are_those_of_the_promptest_reports(seed, drift_ppm, step_at, step_ns):
    """One report in ten is prompt (1 ms); the others take up to 500 ms."""
    draw = random.Random(seed)
    clock = ForeignClock(PERIOD_NS)
    for k in range(80):
        edge_ns = START_NS + k * PERIOD_NS + draw.randint(-100_000, 100_000)
        board_ns = round(k * PERIOD_NS * (1 + drift_ppm * 1e-6)) + edge_ns - START_NS - k * PERIOD_NS
        late_ns = 1_000_000 if k % 10 == 0 else draw.randint(1_000_000, 500_000_000)
        pulse = Pulse(k, k, 0, board_ns + (step_ns if k >= step_at else 0))
        told_ns = clock.utc_ns(pulse, edge_ns + late_ns)
        if step_ns and k >= step_at:  # a later promptest report is not yet known
            assert told_ns >= edge_ns
        else:
            assert -1_000_000 <= told_ns - edge_ns <= 1_500_000


def test_a_board_that_stalls_is_believed():
    """Its pulses come 30 ms late from the tenth on, and its own clock says so."""
    clock = ForeignClock(PERIOD_NS)
    for k in range(20):
        edge_ns = START_NS + k * PERIOD_NS + (30_000_000 if k >= 10 else 0)
        assert clock.utc_ns(Pulse(k, k, 0, edge_ns - START_NS), edge_ns + 1_000_000) == edge_ns + 1_000_000


@pytest.mark.parametrize("trusted", [False, True])
def test_first_reports_that_came_late_are_put_right_by_a_prompt_one(trusted):
    log = TriggerLog(1e9 / PERIOD_NS)
    for k, late_ns in enumerate([15_000_000, 12_000_000, 9_000_000, 0]):
        time_ns = START_NS + k * PERIOD_NS + late_ns
        log.add(Pulse(k, k, 0, time_ns), trusted)
    told = [log.time_of(k, found[1])[0] for k in range(4) if (found := log.nearest(START_NS + k * PERIOD_NS, 0.0))]
    late = [15_000_000, 12_000_000, 9_000_000, 0] if trusted else [0] * 4
    assert told == [START_NS + k * PERIOD_NS + late_ns for k, late_ns in enumerate(late)]
