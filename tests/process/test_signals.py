"""Signals from a recording's messages, and their values at the frames' instants, against what was put in."""

import math
import tracemalloc
from pathlib import Path

import cantools
import numpy as np
import pyarrow as pa
import pytest
from mcap.writer import Writer

from capture.errors import ProcessError
from capture.record import SCHEMAS, Analog, CanFrame, Gate, Mavlink
from process.signal_table import at_instants, sets_of, signal_table, signals_path
from process.signals import Outage, Signal, Signals, read_signals

START_NS = 1_800_000_000_000_000_000
MS = 1_000_000
DBC = """VERSION ""
NS_ :
BS_:
BU_: X
BO_ 256 Inertial: 4 X
 SG_ load_factor : 0|16@1- (0.001,0) [0|0] "g" X
 SG_ mode : 16|8@1+ (1,0) [0|0] "" X
BO_ 2147483905 Far: 2 X
 SG_ load_factor : 0|16@1- (0.001,0) [0|0] "g" X
VAL_ 256 mode 0 "off" 1 "on" ;
"""
TYPES = {
    "/can": "can_msgs/msg/Frame",
    "/analog": "wingshape_msgs/msg/Analog",
    "/mavlink": "wingshape_msgs/msg/Mavlink",
    "/gate": "wingshape_msgs/msg/Gate",
}


def write_aux(path: Path, messages: list[tuple[str, int, bytes]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=2000)
        writer.start(profile="ros2")
        channels = {
            topic: writer.register_channel(
                topic, "cdr", writer.register_schema(name, "ros2msg", SCHEMAS[name].encode())
            )
            for topic, name in TYPES.items()
        }
        for number, (topic, time_ns, data) in enumerate(messages):
            writer.add_message(channels[topic], time_ns, data, time_ns, number)
        writer.finish()


@pytest.fixture
def dbc(tmp_path: Path) -> Path:
    path = tmp_path / "aircraft.dbc"
    path.write_text(DBC)
    return path


def inertial(time_ns: int, load_factor: float, mode: int, bus: str = "a") -> tuple[str, int, bytes]:
    data = cantools.database.load_string(DBC, "dbc").encode_message(
        "Inertial", {"load_factor": load_factor, "mode": mode}
    )
    return "/can", time_ns, CanFrame(time_ns, bus, 256, False, False, False, data).encode()


def test_signals_have_their_names_units_and_samples(tmp_path, dbc):
    messages = [inertial(START_NS + k * 10 * MS, 1 + 0.1 * k, k % 2) for k in range(20)]
    for k in range(5):
        time_ns = START_NS + k * 20 * MS
        messages.append(("/analog", time_ns, Analog(time_ns, time_ns, k, 0, "elevator_deg", 1.0, 2.0 * k).encode()))
        mavlink = Mavlink(time_ns, 1, 1, "ATTITUDE", ("time_boot_ms", "roll"), (1.0 * k, 0.1 * k))
        messages.append(("/mavlink", time_ns, mavlink.encode()))
    messages.append(("/can", START_NS, CanFrame(START_NS, "a", 5, False, False, False, b"").encode()))  # in no DBC
    messages.append(("/can", START_NS, CanFrame(START_NS, "a", 256, True, False, False, b"").encode()))  # remote
    for side in ("left", "right"):
        write_aux(tmp_path / f"ssd_{side}/flight/aux_0000.mcap", messages)
    found = read_signals([tmp_path / "ssd_left", tmp_path / "ssd_right"], [dbc])
    by_name = {signal.name: signal for signal in found.signals}
    assert list(by_name) == ["attitude_roll", "elevator_deg", "load_factor", "mode"]
    load = by_name["load_factor"]
    assert (load.unit, load.source, load.held) == ("g", "/can a.Inertial.load_factor", False)
    assert load.time_ns.tolist() == [START_NS + k * 10 * MS for k in range(20)]  # once, though on both disks
    assert load.value == pytest.approx([1 + 0.1 * k for k in range(20)])
    assert by_name["mode"].held
    assert by_name["elevator_deg"].value.tolist() == [0, 2, 4, 6, 8]
    assert found.problems == ("1 CAN frames of 1 identifiers are in no DBC file",)


def test_the_same_name_twice_takes_message_and_bus_in(tmp_path, dbc):
    far = CanFrame(START_NS, "a", 257, False, True, False, b"\x00\x00")
    messages = [inertial(START_NS, 1.0, 0, "a"), inertial(START_NS, 1.0, 0, "b"), ("/can", START_NS, far.encode())]
    write_aux(tmp_path / "f/aux_0000.mcap", messages)
    names = [signal.name for signal in read_signals([tmp_path / "f"], [dbc]).signals]
    assert names == ["Far_load_factor", "a_Inertial_load_factor", "a_Inertial_mode", "b_Inertial_load_factor",
                     "b_Inertial_mode"]  # fmt: skip


def test_without_a_dbc_it_is_said_what_is_lacking(tmp_path):
    write_aux(tmp_path / "f/aux_0000.mcap", [inertial(START_NS, 1.0, 0)])
    found = read_signals([tmp_path / "f"])
    assert found.signals == ()
    assert "--dbc FILE" in found.problems[0]


def test_a_damaged_copy_is_made_good_by_the_other(tmp_path, dbc):
    messages = [inertial(START_NS + k * MS, 1 + 0.01 * k, 0) for k in range(200)]
    for side in ("left", "right"):
        write_aux(tmp_path / side / "aux_0000.mcap", messages)
    bad = tmp_path / "left/aux_0000.mcap"
    content = bytearray(bad.read_bytes())
    content[len(content) // 3] ^= 0xFF
    bad.write_bytes(content)
    load = next(s for s in read_signals([tmp_path], [dbc]).signals if s.name == "load_factor")
    assert load.value == pytest.approx([1 + 0.01 * k for k in range(200)])


def test_gates_are_spans(tmp_path):
    begin, end = Gate(START_NS, 0, "ptp", "no master"), Gate(START_NS, START_NS + 5 * MS, "ptp", "no master")
    still = Gate(START_NS + 9 * MS, 0, "clock fit", "residual")
    write_aux(
        tmp_path / "f/aux_0000.mcap", [("/gate", g.begin_ns + g.end_ns % 10, g.encode()) for g in (begin, end, still)]
    )
    assert read_signals([tmp_path / "f"]).outages == (
        Outage("ptp", "no master", START_NS, START_NS + 5 * MS),
        Outage("clock fit", "residual", START_NS + 9 * MS, None),
    )


@pytest.mark.parametrize(("content", "words"), [(None, "No such file"), ("BO_ nonsense", "not a DBC file")])
def test_a_dbc_that_cannot_be_used_is_named(tmp_path, content, words):
    write_aux(tmp_path / "f/aux_0000.mcap", [])
    path = tmp_path / "bad.dbc"
    if content is not None:
        path.write_text(content)
    with pytest.raises(ProcessError, match=f"bad.dbc.*{words}"):
        read_signals([tmp_path / "f"], [path])


def signal(times_ms: list[float], values: list[float], **changes: object) -> Signal:
    times_ns = START_NS + np.round(np.array(times_ms) * MS).astype(np.int64)
    return Signal("s", "/can", "", times_ns, np.array(values, dtype=float), **changes)  # type: ignore[arg-type]


def at(one: Signal, times_ms: list[float], max_gap_s: float = 0.5) -> tuple[list[float], list[float], list[str]]:
    times_ns = START_NS + np.round(np.array(times_ms) * MS).astype(np.int64)
    value, gap_s, reason = at_instants(one, times_ns, max_gap_s)
    return value.tolist(), gap_s.tolist(), reason.tolist()


def test_values_between_samples_and_the_gap_they_bridge():
    value, gap_s, reason = at(signal([0, 10, 40], [0, 1, 4]), [0, 2.5, 10, 25, 40])
    assert value == pytest.approx([0, 0.25, 1, 2.5, 4])
    assert gap_s == pytest.approx([0, 0.01, 0, 0.03, 0])
    assert reason == [""] * 5


def test_beyond_the_limit_there_is_a_reason_and_no_number():
    value, gap_s, reason = at(signal([0, 10, 800], [0, 1, 4]), [-1, 5, 300, 801])
    assert np.isnan([value[0], value[2], value[3]]).all()
    assert value[1] == pytest.approx(0.5)
    assert reason == ["before the first sample", "", "gap of 0.79 s", "after the last sample"]
    assert gap_s[2] == pytest.approx(0.79)
    assert np.isnan([gap_s[0], gap_s[3]]).all()


def test_states_are_held_and_angles_take_the_short_way():
    assert at(signal([0, 10], [1, 3], held=True), [4, 9.9, 10])[0] == [1, 1, 3]
    assert at(signal([0, 10], [350, 20], period=360.0), [0, 5, 10])[0] == pytest.approx([350, 5, 20])
    near_pi = math.pi - 0.1
    assert at(signal([0, 10], [near_pi, -near_pi], period=2 * math.pi), [2.5])[0] == pytest.approx([math.pi - 0.05])


def test_nanoseconds_are_not_lost_in_floats():
    """At 1.8e18 ns a float64 has steps of 256 ns: a signal that rises by 1 in 100 ns tells."""
    times = np.array([START_NS + 1, START_NS + 101], dtype=np.int64)
    value, _, _ = at_instants(Signal("s", "", "", times, np.array([0.0, 1.0])), np.array([START_NS + 26]), 1.0)
    assert value.tolist() == [0.25]


def test_the_table_has_a_row_a_set_and_says_what_is_missing():
    markers = pa.table(
        {
            "trigger_index": [0, 0, 1, 1, 0],
            "side": ["left", "left", "left", "left", "right"],
            "frame_timestamp_ns": [START_NS, START_NS, START_NS + 40 * MS, START_NS + 40 * MS, START_NS + 1],
        }
    )
    sets = sets_of(markers)
    load = signal([-10, 10], [0, 2])
    load = Signal("load_factor", "/can a", "g", load.time_ns, load.value)
    outages = (Outage("ptp", "", START_NS + MS, None), Outage("board", "", START_NS, START_NS + 1))
    table = signal_table(sets, Signals((load,), outages))
    assert table.column_names == [
        "trigger_index", "side", "timestamp_ns", "load_factor", "load_factor_gap_s", "signals_missing", "gates_failing",
    ]  # fmt: skip
    rows = {(row["trigger_index"], row["side"]): row for row in table.to_pylist()}
    assert rows[0, "left"]["load_factor"] == pytest.approx(1.0)
    assert rows[0, "left"]["gates_failing"] == "board"
    assert rows[0, "right"]["gates_failing"] == ""
    assert math.isnan(rows[1, "left"]["load_factor"])
    assert rows[1, "left"]["signals_missing"] == "load_factor: after the last sample"
    assert rows[1, "left"]["gates_failing"] == "ptp"
    assert table.schema.field("load_factor").metadata == {b"source": b"/can a", b"unit": b"g"}
    assert signals_path(Path("a/markers.parquet")) == Path("a/markers_signals.parquet")


def test_a_long_flight_is_read_in_little_memory(tmp_path, dbc):
    """For each message of two signals 32 bytes of samples and what tells it from its copy: 11 million fit in 4 GB."""
    count = 20_000
    content = inertial(START_NS, 1.0, 0)[2]
    for side in ("left", "right"):
        write_aux(tmp_path / side / "aux_0000.mcap", [("/can", START_NS + k * MS, content) for k in range(count)])
    read_signals([tmp_path], [dbc])  # what is loaded once is not counted
    tracemalloc.start()
    found = read_signals([tmp_path], [dbc])
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(found.signals) == 2
    assert peak / count < 350, peak / count
