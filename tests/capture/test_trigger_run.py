"""Whatever happens to the trigger board and its line, the ledger is right at the end, and the files prove it.

The board is the simulated one, on a pseudo-terminal; the cameras show their own content on each edge, so that a frame
that was tied to another trigger's index is found by its pixels.
"""

import threading
import time
from pathlib import Path

import pytest
from mcap.reader import make_reader

from capture.aux_log import AuxLog
from capture.clock import SystemClock
from capture.config import TriggerConfig, load_config
from capture.daemon import Recording, RecordingResult
from capture.disk import SystemDisk
from capture.gates import Gates
from capture.ledger import Ledger
from capture.record import GATE_TOPIC, Frame, Gate, Trigger, decode_image
from capture.scan import scan
from capture.stop_rule import StopRule
from capture.trigger import TriggerLog
from capture.trigger_protocol import Pulse
from capture.trigger_run import TriggerRun
from capture.verify import inspect
from hw_sim.trigger_board import LineFaults, SimulatedBoard

RATE_HZ = 50.0
TRIGGERS = 100


class Flight:
    """A simulated board that fires the fake cameras."""

    def __init__(self, tmp_path: Path, rig, write_config) -> None:
        self.faults = LineFaults()
        self.folder = tmp_path
        self.shown: list[tuple[int, int]] = []  # what the cameras were shown, in order, and when
        self.rig = rig
        self.at: dict[int, object] = {}  # pulse number: what to do then
        rig.port = str(tmp_path / "trigger")
        self.board = SimulatedBoard(Path(rig.port), RATE_HZ, 3, SystemClock(), self._edge, faults=self.faults)
        self.board.start()
        self.config = write_config(rate_hz=RATE_HZ)

    def _edge(self, pulse: Pulse) -> None:
        self.shown.append((pulse.index, pulse.actual_ns))
        self.rig.edge(pulse.index, pulse.actual_ns)
        action = self.at.pop(len(self.shown), None)
        if action is not None:
            action()

    def fly(self, triggers: int = TRIGGERS) -> RecordingResult:
        try:
            rule = StopRule(threading.Event(), triggers, 60.0)
            return Recording(load_config(self.config), SystemClock(), SystemDisk(), lambda _: None).run(rule)
        finally:
            self.board.close()

    def certified(self, pixels_of):
        """The report of ``verify``; every frame's content and time are its trigger's."""
        report = inspect([self.folder])
        assert report.problems == []
        times = dict(self.shown)
        for path in sorted(self.folder.glob("ssd_*/test/*.mcap")):
            for message in scan(path)[1]:
                if message.topic.endswith("/image_raw"):
                    image = decode_image(message.data)
                    assert (
                        bytes(message.data[image.pixels_at :]) == pixels_of(image.frame_id, message.sequence).tobytes()
                    )
                elif message.topic.endswith("/frame"):
                    frame = Frame.decode(message.data)
                    error_ns = frame.exposure_start_ns - times[frame.trigger_index]
                    assert abs(error_ns) < max(5 * frame.time_sigma_ns, 50_000)
        return report

    def messages(self, topic: str):
        return [m.data for m in scan(self.folder / "ssd_left/test/aux_0000.mcap")[1] if m.topic == topic]

    def end(self) -> dict[str, str]:
        with (self.folder / "ssd_left/test/aux_0000.mcap").open("rb") as file:
            return next(m.metadata for m in make_reader(file).iter_metadata() if m.name == "wingshape_end")

    def marks(self) -> list[Gate]:
        return [Gate.decode(data) for data in self.messages(GATE_TOPIC)]


@pytest.fixture
def flight(tmp_path, rig, write_config):
    return Flight(tmp_path, rig, write_config)


def test_an_edge_that_no_camera_sees_is_lost_at_the_cameras(flight, pixels_of):
    flight.faults.unseen = {30}
    result = flight.fly()
    assert (result.triggers, result.failures) == (TRIGGERS, [])
    assert [account.lost for account in result.accounts.values()] == [{"camera": 1}] * 4
    report = flight.certified(pixels_of)
    assert all(set(camera.lost_indices) == {30} for camera in report.cameras.values())


def test_lines_that_are_lost_late_twice_garbled_or_wrong(flight, pixels_of):
    faults = flight.faults
    faults.lost, faults.twice, faults.garbled = {20, 21, 22}, {10, 40}, {55}
    faults.late_s = {60: 0.1}
    faults.wrong_counter, faults.wrong_index = {70: 1000, 71: -3}, {80: 5}
    result = flight.fly()
    assert (result.triggers, result.lost, result.failures) == (TRIGGERS, 0, [])
    report = flight.certified(pixels_of)
    assert report.recorded == 4 * TRIGGERS
    assert report.notes == ["4 triggers were not reported by the board: their times are interpolated"]
    end = flight.end()
    assert (end["reports_twice"], end["reports_contradictory"], end["lines_garbled"]) == ("2", "3", "1")
    indices = [Trigger.decode(data).index for data in flight.messages("/trigger")]
    assert sorted(indices) == sorted(set(range(TRIGGERS)) - {20, 21, 22, 55})


def test_a_reset_board_goes_on_from_the_next_index(flight, pixels_of):
    flight.at = {30: flight.board.reset, 60: flight.board.reset}
    result = flight.fly()
    assert (result.triggers, result.lost, result.failures) == (TRIGGERS, 0, [])
    report = flight.certified(pixels_of)
    assert report.triggers == TRIGGERS
    assert "was reset 2 times" in report.notes[-1]
    assert [index for index, _ in flight.shown] == list(range(TRIGGERS))
    marks = [gate for gate in flight.marks() if gate.name == "trigger board"]
    assert [gate.end_ns == 0 for gate in marks] == [True, False, True, False]
    assert marks[0].cause.endswith("it was reset after trigger 29")
    assert 0.1e9 < marks[1].end_ns - marks[1].begin_ns < 5e9


def test_a_pulled_serial_cable_costs_no_frame(flight, pixels_of):
    flight.at = {30: flight.board.unplug, 75: flight.board.plug}
    result = flight.fly()
    assert (result.triggers, result.lost, result.failures) == (TRIGGERS, 0, [])
    report = flight.certified(pixels_of)
    assert "not reported by the board" in report.notes[0]
    (begin, end) = [gate for gate in flight.marks() if gate.name == "trigger board"]
    assert "gone" in begin.cause
    assert end.end_ns - begin.begin_ns > 0.5e9


def test_a_board_that_loses_power_with_its_cable_goes_on_when_both_are_back(flight, pixels_of):
    def pull() -> None:
        flight.board.unplug()
        flight.board.reset()
        threading.Timer(1.0, flight.board.plug).start()

    flight.at = {30: pull}
    result = flight.fly()
    assert (result.triggers, result.lost, result.failures) == (TRIGGERS, 0, [])
    flight.certified(pixels_of)
    assert [index for index, _ in flight.shown] == list(range(TRIGGERS))


@pytest.mark.parametrize("step_ns", [300_000_000, -300_000_000, 90_000_000])
def test_a_step_of_the_boards_clock_moves_no_frame_to_another_trigger(flight, pixels_of, step_ns):
    flight.faults.strange_clock = {40: step_ns}
    result = flight.fly()
    assert (result.triggers, result.lost, result.failures) == (TRIGGERS, 0, [])
    flight.shown = [(index, time_ns + (step_ns if index >= 40 else 0)) for index, time_ns in flight.shown]
    flight.certified(pixels_of)


def test_a_board_of_1970_is_marked_and_recorded_by_the_computers_time(flight, pixels_of):
    flight.faults.strange_clock = {0: -time.time_ns()}
    result = flight.fly()
    assert (result.triggers, result.lost, result.failures) == (TRIGGERS, 0, [])
    assert "trigger board clock" in {gate.name for gate in flight.marks()}
    for path in sorted(flight.folder.glob("ssd_*/test/*.mcap")):
        for message in scan(path)[1]:
            if message.topic.endswith("/image_raw"):
                image = decode_image(message.data)
                assert bytes(message.data[image.pixels_at :]) == pixels_of(image.frame_id, message.sequence).tobytes()


class SetClock:
    """A clock that stands where it is put."""

    def __init__(self) -> None:
        self.now_ns = 1_790_000_000_000_000_000

    def utc_ns(self) -> int:
        return self.now_ns

    def monotonic_s(self) -> float:
        return self.now_ns / 1e9

    def sleep(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9)


@pytest.mark.parametrize(
    ("index", "counter", "at_period", "believed"),
    [
        (10, 110, 10, 10),
        (10, 999, 10, 10),  # index and time
        (99, 110, 10, 10),  # counter and time
        (10, 110, 12, 10),  # index and counter: the pulse itself was late
        (99, 999, 10, None),
        (5, 106, 10, None),
    ],
)
def test_two_of_index_counter_and_time_are_believed(tmp_path, rig, index, counter, at_period, believed):
    clock = SetClock()
    aux, triggers = AuxLog(clock), TriggerLog(25)
    ledger = Ledger([("left", "cam0")], 0, clock.utc_ns, aux.loss)
    config = TriggerConfig(port=rig.port, rate_hz=25)
    run = TriggerRun(config, SystemClock(), triggers, ledger, aux, Gates(clock))
    try:
        run.open()
        run._clock = clock
        run._start = lambda first, before: None
        rig.counter = 100
        run._epoch = type(run)._start.__globals__["_Epoch"](0, 99)
        begin_ns = clock.now_ns
        for k in [*range(10), None]:
            now_ns = clock.now_ns = begin_ns + (at_period if k is None else k) * 40_000_000
            told = Pulse(index, counter, now_ns, now_ns) if k is None else Pulse(k, 100 + k, now_ns, now_ns)
            run._on_pulse(told, Trigger(told.index, told.counter, now_ns, now_ns, now_ns))
        assert aux.triggers == 10 + (believed is not None)
        assert ledger.next_index == (10 if believed is None else believed + 1)
    finally:
        run.board.close()


@pytest.mark.parametrize(
    ("given_ms", "said_ms", "late_ms"),
    [
        ((0, 65, 105), (0, 65, 105), (20, 1, 1)),  # a stall just after a report that came late
        ((0, 40, 80, 120), (0, 40, 160, 200), (1, 2, 1, 1)),  # a clock that steps by two periods, soon after the start,
        ((0, 40, 80, 120), (0, 40, 580, 1120), (1, 2, 1, 1)),  # and one that steps twice
    ],
)
def test_a_stall_is_told_from_a_step_of_the_clock(tmp_path, rig, given_ms, said_ms, late_ms):
    """A step is kept aside: the log's times run on evenly; a stall is in them."""
    clock = SetClock()
    aux, triggers = AuxLog(clock), TriggerLog(25)
    ledger = Ledger([("left", "cam0")], 0, clock.utc_ns, aux.loss)
    run = TriggerRun(TriggerConfig(port=rig.port, rate_hz=25), SystemClock(), triggers, ledger, aux, Gates(clock))
    try:
        run.open()
        run._clock = clock
        run._epoch = type(run)._start.__globals__["_Epoch"](0, 99)
        begin_ns = clock.now_ns
        for k, (given, said, late) in enumerate(zip(given_ms, said_ms, late_ms, strict=True)):
            now_ns = clock.now_ns = begin_ns + (given + late) * 1_000_000
            told_ns = begin_ns + said * 1_000_000
            run._on_pulse(Pulse(k, 100 + k, told_ns, told_ns), Trigger(k, 100 + k, told_ns, told_ns, now_ns))
        for k, (given, said) in enumerate(zip(given_ms, said_ms, strict=True)):
            assert triggers.nearest(begin_ns + given * 1_000_000, 0.0) == (k, begin_ns + given * 1_000_000)
            assert triggers.time_of(k, begin_ns + given * 1_000_000)[0] == begin_ns + said * 1_000_000
    finally:
        run.board.close()
