"""Frames to triggers, against a board and a camera whose truth is known."""

import random
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from capture.camera.base import CameraDescription, FrameStatus, Grab
from capture.clock import SystemClock
from capture.frame_clock import FrameClock
from capture.gates import Gates, judge_cameras
from capture.numbering import CONFIRMING, FrameNumbering
from capture.ptp import FREE_RUNNING
from capture.trigger import TriggerLog
from capture.trigger_protocol import Pulse

PERIOD_NS, EXPOSURE_US, ROW_NS, HEIGHT = 40_000_000, 2000, 10_000, 1552
CAMERA = CameraDescription("x", "1", 2080, HEIGHT, EXPOSURE_US, 0.0, ROW_NS, 1e9, 16, True)
START_NS = 1_800_000_000_000_000_000


@given(
    seed=st.integers(0, 10**6),
    missed=st.sets(st.integers(0, 59), max_size=20),
    undelivered=st.sets(st.integers(0, 59), max_size=10),
    unreported=st.sets(st.integers(1, 59), max_size=10),
    drift_ppm=st.floats(-100, 100),
)
def test_every_frame_gets_its_own_trigger(seed, missed, undelivered, unreported, drift_ppm):
    """Trigger jitter, latency with tails (one of the first frames is prompt), gaps of all kinds, a wrapping counter."""
    draw = random.Random(seed)
    edges = [START_NS + k * PERIOD_NS + draw.randint(-100_000, 100_000) for k in range(60)]
    log = TriggerLog(1e9 / PERIOD_NS)
    for index, edge_ns in enumerate(edges):
        if index not in unreported:
            log.add(Pulse(index, index, edge_ns, edge_ns))
    # The report of the very last triggers may be missing for good; what comes before must not wait for it.
    frame_id, frames, truth = 65520, [], []
    for index, edge_ns in enumerate(edges):
        if index in missed:
            continue
        frame_id = (frame_id + 1) % 65536
        if index in undelivered:
            continue
        late_ns = 500_000 if len(frames) % CONFIRMING == 2 else draw.randint(0, 100_000_000)
        ticks = round((edge_ns - START_NS) * (1 + drift_ppm * 1e-6)) + 77
        receive_ns = edge_ns + EXPOSURE_US * 1000 + ROW_NS * HEIGHT + late_ns
        frames.append(Grab(0, frame_id, ticks, receive_ns, EXPOSURE_US, 0.0, FrameStatus.COMPLETE))
        truth.append(index)
    numbering = FrameNumbering(CAMERA, log)
    told = [pair for grab in frames for pair in numbering.feed(grab)] + numbering.flush()
    assert [grab for grab, _ in told] == frames
    if len(frames) >= CONFIRMING:
        assert [numbered.index for _, numbered in told] == truth


def test_a_repeated_frame_and_one_without_a_trigger_are_nobodys():
    log = TriggerLog(25)
    numbering = FrameNumbering(CAMERA, log)
    stray = Grab(0, 1, 0, START_NS, EXPOSURE_US, 0.0, FrameStatus.COMPLETE)
    assert numbering.feed(stray) == []
    assert numbering.flush() == [(stray, None)]
    for index in range(10):
        log.add(Pulse(index, index, START_NS + index * PERIOD_NS, START_NS + index * PERIOD_NS))
    frames = [
        Grab(0, 5 + k, k * PERIOD_NS, START_NS + k * PERIOD_NS + 20_000_000, EXPOSURE_US, 0.0, FrameStatus.COMPLETE)
        for k in range(5)
    ]
    told = [pair for grab in [*frames, frames[-1]] for pair in numbering.feed(grab)]
    assert [numbered and numbered.index for _, numbered in told] == [0, 1, 2, 3, 4, None]


def test_a_clock_that_jumps_costs_a_few_frames_and_no_wrong_one():
    log = TriggerLog(25)
    for index in range(40):
        log.add(Pulse(index, index, START_NS + index * PERIOD_NS, START_NS + index * PERIOD_NS))
    numbering, told = FrameNumbering(CAMERA, log), []
    for index in range(40):
        ticks = index * PERIOD_NS + (10**15 if index < 10 else 0)
        receive_ns = START_NS + index * PERIOD_NS + EXPOSURE_US * 1000 + ROW_NS * HEIGHT + 1_000_000
        told += numbering.feed(Grab(0, index, ticks, receive_ns, EXPOSURE_US, 0.0, FrameStatus.COMPLETE))
    numbers = [(grab.frame_id, numbered and numbered.index) for grab, numbered in told]
    assert numbers == [(k, None if 10 <= k < 10 + CONFIRMING else k) for k in range(40)]


@pytest.mark.parametrize(
    ("ticks_at_return", "late_ns"),
    [
        (0, 45_000_000),  # its clock ran on: every frame may be late
        (-(10**12), 1_000_000),  # powered anew: as at the start, one of the first must be in time
        (3 * PERIOD_NS + 7_000_000, 1_000_000),  # set anew to nearly what it was
    ],
)
def test_a_camera_that_comes_back_is_known_by_its_clock_if_that_ran_on(ticks_at_return, late_ns):
    log, told = TriggerLog(25), []
    for index in range(120):
        log.add(Pulse(index, index, START_NS + index * PERIOD_NS, START_NS + index * PERIOD_NS))

    def frame(k: int, more_ticks: int, late_ns: int) -> Grab:
        receive_ns = START_NS + k * PERIOD_NS + EXPOSURE_US * 1000 + ROW_NS * HEIGHT + late_ns
        ticks = 10**13 + round(k * PERIOD_NS * (1 + 80e-6)) + more_ticks
        return Grab(0, k, ticks, receive_ns, EXPOSURE_US, 0.0, FrameStatus.COMPLETE)

    first = FrameNumbering(CAMERA, log)
    for k in range(10):
        first.feed(frame(k, 0, 1_000_000))
    absent = FrameNumbering(CAMERA, log, 10, first.last)  # it came, and went before it gave a frame
    back = FrameNumbering(CAMERA, log, 60, absent.last)
    for k in range(80, 100):
        told += back.feed(frame(k, ticks_at_return, late_ns if k < 90 else 1_000_000))
    assert [numbered.index for _, numbered in told] == list(range(80, 100))


@pytest.mark.parametrize(
    "late_ms", [(150, 110, 70, 45, 5, 4), (60, 90, 48, 71, 80, 55, 3), (210, 170, 130, 90, 50, 10)]
)
def test_first_frames_that_come_by_fits_and_starts_are_waited_out(late_ms):
    """The first four are all late by more than a period, as after a stall of the computer, or while it is busy."""
    log, told = TriggerLog(25), []
    for index in range(20):
        log.add(Pulse(index, index, START_NS + index * PERIOD_NS, START_NS + index * PERIOD_NS))
    numbering = FrameNumbering(CAMERA, log)
    for k in range(20):
        late_ns = (late_ms[k] if k < len(late_ms) else 2) * 1_000_000
        receive_ns = START_NS + k * PERIOD_NS + EXPOSURE_US * 1000 + ROW_NS * HEIGHT + late_ns
        told += numbering.feed(Grab(0, k, k * PERIOD_NS, receive_ns, EXPOSURE_US, 0.0, FrameStatus.COMPLETE))
    assert [numbered.index for _, numbered in told] == list(range(20))


def test_no_frame_is_of_a_trigger_before_the_first():
    """The board pauses and its last report is late: reckoned by the period, the first frame would be of trigger 6."""
    edges = [START_NS + k * PERIOD_NS for k in (0, 1, 2)] + [START_NS + round(4.6 * PERIOD_NS)]
    log = TriggerLog(25)
    for index, edge_ns in enumerate(edges[:3]):
        log.add(Pulse(7 + index, index, edge_ns, edge_ns))
    frames = [
        Grab(0, k, edge_ns, edge_ns + EXPOSURE_US * 1000 + ROW_NS * HEIGHT, EXPOSURE_US, 0.0, FrameStatus.COMPLETE)
        for k, edge_ns in enumerate(edges)
    ]
    told = {}
    for earliest in (0, 7):
        numbering = FrameNumbering(CAMERA, log, earliest)
        told[earliest] = [numbered and numbered.index for k in frames for _, numbered in numbering.feed(k)]
    assert told[7][:3] == [7, 8, 9]
    assert told[0][0] == 6  # what the bound is for


def test_frames_of_another_hands_triggers_do_not_take_ours_with_them():
    """The camera was armed while the board still gave triggers that were none of this recording's."""
    log, told = TriggerLog(25), []
    for index in range(10):
        log.add(Pulse(index, index, START_NS + index * PERIOD_NS, START_NS + index * PERIOD_NS))
    numbering = FrameNumbering(CAMERA, log)
    for k in range(-3, 10):  # before 0: not reported to us
        receive_ns = START_NS + k * PERIOD_NS + EXPOSURE_US * 1000 + ROW_NS * HEIGHT + 1_000_000
        told += numbering.feed(Grab(0, 5 + k, k * PERIOD_NS, receive_ns, EXPOSURE_US, 0.0, FrameStatus.COMPLETE))
    assert [numbered and numbered.index for _, numbered in told] == [None, None, None, *range(10)]


def test_frames_are_not_held_up_by_a_board_that_is_gone():
    """One wait, not one a frame: at 50 Hz, 30 ms a frame would be more than there is."""
    log = TriggerLog(50)
    log.add(Pulse(0, 1, START_NS, START_NS))
    begin_s = time.monotonic()
    for index in range(1, 50):
        assert log.nearest(START_NS + index * 20_000_000, 0.2)[0] == index
    assert time.monotonic() - begin_s < 2.0  # 49 waits would be 9.8 s
    log.add(Pulse(50, 51, START_NS + 10**9, START_NS + 10**9))
    assert log.nearest(START_NS + 10**9, 0.2) == (50, START_NS + 10**9)


def test_the_log_believes_no_pulse_that_goes_back():
    log = TriggerLog(25)
    for index, time_ns in ((5, 1_000_000_000), (5, 1_000_000_001), (4, 2_000_000_000), (6, 999_999_999)):
        log.add(Pulse(index, 1, time_ns, time_ns))
    assert log.nearest(1_000_000_300, 0.0) == (5, 1_000_000_000)
    assert log.nearest(1_000_000_000 + 3 * PERIOD_NS, 0.0) == (8, 1_000_000_000 + 3 * PERIOD_NS)


def test_a_clock_that_is_set_years_ahead_costs_a_few_frames_and_no_wrong_one():
    """A network camera that has found its PTP master: its clock goes from time since power-up to time since 1970."""
    log = TriggerLog(25)
    for index in range(40):
        log.add(Pulse(index, index, START_NS + index * PERIOD_NS, START_NS + index * PERIOD_NS))
    numbering, told = FrameNumbering(CAMERA, log), []
    for index in range(40):
        ticks = index * PERIOD_NS + (START_NS if index >= 10 else 0)
        receive_ns = START_NS + index * PERIOD_NS + EXPOSURE_US * 1000 + ROW_NS * HEIGHT + 1_000_000
        told += numbering.feed(Grab(0, index, ticks, receive_ns, EXPOSURE_US, 0.0, FrameStatus.COMPLETE))
    numbers = [(grab.frame_id, numbered and numbered.index) for grab, numbered in told]
    assert numbers == [(k, None if 10 <= k < 10 + CONFIRMING else k) for k in range(40)]


@pytest.mark.parametrize(("late_ns", "marked"), [(PERIOD_NS + 3_000_000, True), (3_000_000, False)])
def test_frames_numbered_too_high_are_marked_once_the_computer_is_less_busy(late_ns, marked):
    """The first frames are all late by more than a period, so every frame counts from one too high."""
    log, seen = TriggerLog(25), {}
    for index in range(120):
        log.add(Pulse(index, index, START_NS + index * PERIOD_NS, START_NS + index * PERIOD_NS))
    numbering, clock = FrameNumbering(CAMERA, log), FrameClock(CAMERA, log, lambda: FREE_RUNNING, 0)
    for k in range(100):
        receive_ns = START_NS + k * PERIOD_NS + EXPOSURE_US * 1000 + ROW_NS * HEIGHT
        receive_ns += late_ns if k < CONFIRMING else 3_000_000
        for grab, numbered in numbering.feed(
            Grab(0, k, k * PERIOD_NS, receive_ns, EXPOSURE_US, 0.0, FrameStatus.COMPLETE)
        ):
            seen[grab.frame_id] = numbered.index
            clock.time_of(grab, numbered)
    assert seen == {k: k + marked for k in range(100)}
    gates = Gates(SystemClock())
    judge_cameras(gates, {"left/cam0": clock.figures}, 100.0, PERIOD_NS * 1e-3)
    assert list(gates.failing) == (["numbering left/cam0"] if marked else [])
    if marked:
        assert "come 37.0 ms before their exposure can have ended" in gates.failing["numbering left/cam0"]
