"""Pulses of a board whose clock is not on UTC, against edges that are known and reports with delays that are drawn."""

import random

from hypothesis import given
from hypothesis import strategies as st

from capture.trigger import ForeignClock, TriggerLog
from capture.trigger_protocol import Pulse

PERIOD_NS, START_NS, PROMPT_NS = 40_000_000, 1_800_000_000_000_000_000, 1_000_000


class Told:
    """A log that is told of pulses as in a flight."""

    def __init__(self) -> None:
        self.clock, self.log = ForeignClock(PERIOD_NS), TriggerLog(1e9 / PERIOD_NS)
        self.dropped = 0

    def add(self, index: int, board_ns: int, received_ns: int, utc_step_ns: int = 0) -> int:
        """``utc_step_ns``: by which the computer's clock has stepped."""
        pulse = Pulse(index, index, 0, board_ns)
        time_ns, late_ns = self.clock.utc_ns(pulse, received_ns + utc_step_ns, received_ns)
        self.log.lower(self.clock.since_index, late_ns)
        self.dropped += not self.log.add(Pulse(index, index, 0, time_ns), trusted=False)
        return time_ns

    def time_ns(self, index: int, near_ns: int) -> int:
        found = self.log.nearest(near_ns, 0.0)
        assert found is not None
        assert found[0] == index
        return self.log.time_of(index, found[1])[0]


@given(
    seed=st.integers(0, 10**6),
    drift_ppm=st.floats(-100, 100),
    step_at=st.integers(60, 79),
    step_ns=st.sampled_from([0, 25_000_000, -25_000_000, 10**9]),
)
def test_times_are_those_of_the_promptest_reports(seed, drift_ppm, step_at, step_ns):
    """One report in ten is prompt (1 ms); the others take up to 500 ms. Then the board's clock may step."""
    draw, told = random.Random(seed), Told()
    edges = [START_NS + k * PERIOD_NS + draw.randint(-100_000, 100_000) for k in range(100)]
    for k, edge_ns in enumerate(edges):
        board_ns = edge_ns - START_NS + round(k * PERIOD_NS * drift_ppm * 1e-6)
        late_ns = PROMPT_NS if k % 10 == 0 or k == 99 else draw.randint(PROMPT_NS, 500_000_000)
        told.add(k, board_ns + (step_ns if k >= step_at else 0), edge_ns + late_ns)
    assert told.dropped == 0
    for k, edge_ns in enumerate(edges):
        assert -1_000_000 <= told.time_ns(k, edge_ns - PERIOD_NS // 4) - edge_ns <= 1_500_000


@given(late_ms=st.lists(st.integers(1, 500), min_size=1, max_size=12))
def test_first_reports_that_came_late_are_put_right_by_a_prompt_one(late_ms):
    told = Told()
    for k, late in enumerate([*late_ms, 0]):
        told.add(k, k * PERIOD_NS, START_NS + k * PERIOD_NS + late * 1_000_000)
    assert told.dropped == 0
    for k in range(len(late_ms) + 1):
        assert told.time_ns(k, START_NS + k * PERIOD_NS - PERIOD_NS // 4) == START_NS + k * PERIOD_NS


def test_a_step_of_the_computers_clock_is_taken_over_at_once():
    for utc_step_ns in (500_000_000, -500_000_000):
        told = Told()
        for k in range(40):
            edge_ns = START_NS + k * PERIOD_NS
            step_ns = utc_step_ns if k >= 20 else 0
            time_ns = told.add(k, k * PERIOD_NS, edge_ns + PROMPT_NS, step_ns)
            assert time_ns == edge_ns + PROMPT_NS + step_ns


def test_a_board_that_stalls_is_believed():
    """One pulse is 30 ms late; those from the tenth on are, too; and its own clock says so."""
    told = Told()
    given_ns = [k * PERIOD_NS + (30_000_000 if k >= 10 or k == 5 else 0) for k in range(20)]
    for k, board_ns in enumerate(given_ns):
        told.add(k, board_ns, START_NS + board_ns + PROMPT_NS)
    for k, board_ns in enumerate(given_ns):
        assert told.time_ns(k, START_NS + board_ns - PERIOD_NS // 4) == START_NS + board_ns + PROMPT_NS


def test_a_trigger_that_was_not_reported_is_as_far_from_its_edge_as_the_others():
    told = Told()
    for k in (0, 1, 3, 4):
        told.add(k, k * PERIOD_NS, START_NS + k * PERIOD_NS + PROMPT_NS)
    assert told.time_ns(2, START_NS + 2 * PERIOD_NS - PERIOD_NS // 4) == START_NS + 2 * PERIOD_NS + PROMPT_NS
