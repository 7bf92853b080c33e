"""CAN, MAVLink and analog into the aux log: what is said is there once, with its time; what is missing does no harm."""

import itertools
import json
import os
import socket
import subprocess
import sys
import threading
import time
import tty
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import can
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from needs import needs_module, needs_program, needs_root
from rosbags.highlevel import AnyReader

from capture.analog import AnalogLog
from capture.aux_log import MESSAGES_HELD, AuxLog
from capture.can_log import CanLink
from capture.clock import SystemClock
from capture.companions import make_companions
from capture.config import AnalogChannel, AnalogConfig, CanConfig, MavlinkConfig, load_config
from capture.daemon import Recording
from capture.disk import SystemDisk
from capture.errors import ConfigError, LinkError
from capture.listener import Heard, Listener
from capture.mavlink_log import MavlinkLink
from capture.record import ANALOG_TOPIC, CAN_TOPIC, MAVLINK_TOPIC, Analog, CanFrame, Mavlink
from capture.stop_rule import StopRule
from capture.trigger import TriggerBoard
from capture.trigger_protocol import GarbledLine, Sample, decode_line, encode_line, parse_sample
from capture.verify import inspect
from hw_sim.trigger_board import SimulatedBoard

CLOCK = SystemClock()
DEADLINE_S = 20.0


class Log:
    """Stands in for the aux log."""

    def __init__(self) -> None:
        self.messages: list[tuple[str, int, bytes]] = []

    def put(self, topic: str, time_ns: int, data: bytes) -> None:
        self.messages.append((topic, time_ns, data))


def wait_until(condition: Callable[[], bool], what: str) -> None:
    deadline_s = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline_s, f"not within {DEADLINE_S} s: {what}"
        time.sleep(0.01)


@contextmanager
def listening(name: str, connect: Callable[[], object]) -> Iterator[tuple[Listener, Log]]:
    log, listener = Log(), Listener(name, connect, CLOCK)
    listener.start(log.put)
    try:
        yield listener, log
    finally:
        listener.stop()


def bus_config(**changes: object) -> CanConfig:
    return CanConfig.model_validate({"name": "bus", "interface": "virtual", "channel": "test", **changes})


def test_every_can_frame_is_logged_once_with_its_time():
    with (
        listening("can.bus", lambda: CanLink(bus_config(), CLOCK)) as (listener, log),
        can.Bus(interface="virtual", channel="test") as sender,
    ):
        wait_until(lambda: listener.statuses()[0].level < 2, "opened")
        begin_ns = time.time_ns()
        for number in range(300):
            sender.send(can.Message(arbitration_id=number, data=[number % 256] * (number % 9), is_extended_id=False))
        sender.send(can.Message(arbitration_id=0x1ABCDEF0, data=b"12345678", is_extended_id=True))
        sender.send(can.Message(arbitration_id=5, is_remote_frame=True, is_extended_id=False))
        sender.send(can.Message(arbitration_id=6, data=bytes(12), is_fd=True, is_extended_id=False))
        wait_until(lambda: len(log.messages) == 302 and bool(listener.lost), "heard")
        end_ns = time.time_ns()
    frames = [CanFrame.decode(data) for _, _, data in log.messages]
    assert {topic for topic, _, _ in log.messages} == {CAN_TOPIC}
    assert [(frame.id, frame.data) for frame in frames[:300]] == [
        (number, bytes([number % 256] * (number % 9))) for number in range(300)
    ]
    assert (frames[300].id, frames[300].is_extended, frames[300].data) == (0x1ABCDEF0, True, b"12345678")
    assert frames[301].is_rtr
    assert all(begin_ns - 1000 <= frame.stamp_ns <= end_ns for frame in frames)  # python-can's floats: 0.24 us
    assert [time_ns for _, time_ns, _ in log.messages] == [frame.stamp_ns for frame in frames]
    account = listener.account()
    assert account["can.bus.messages"] == "302"
    assert json.loads(account["can.bus.lost"]) == {"longer than 8 bytes (CAN FD)": 1}


def test_a_device_clock_is_not_taken_for_utc():
    with can.Bus(interface="virtual", channel="ticks") as sender:
        link = CanLink(bus_config(channel="ticks"), CLOCK)
        sender.send(can.Message(arbitration_id=1, timestamp=12.5), timeout=None)
        (heard,) = link.hear(1.0)
        link.close()
    assert abs(heard.time_ns - time.time_ns()) < 5e9


def test_frames_that_the_socket_had_no_room_for_are_counted(tmp_path, monkeypatch):
    """The interface counts 10 frames, three of which never came to be read. A count that is still rising is not one."""
    counter = tmp_path / "can0/statistics/rx_packets"
    counter.parent.mkdir(parents=True)
    counter.write_text("100\n")
    real = can.Bus

    def virtual(channel: object, interface: str, **options: object) -> object:
        bus = real(channel=channel, interface="virtual")
        bus.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        return bus

    monkeypatch.setattr("capture.can_log.can.Bus", virtual)
    link = CanLink(bus_config(interface="socketcan", channel="can0"), CLOCK, statistics=tmp_path)
    with real(channel="can0", interface="virtual") as sender:
        for number in range(7):
            sender.send(can.Message(arbitration_id=number))
        counter.write_text("110\n")
        heard = [message for _ in range(7) for message in link.hear(1.0)]
        assert len(heard) == 7
        assert link.hear(0.0) == ()
        counter.write_text("111\n")  # one has just come in
        assert link.hear(0.0) == ()
    assert link.lost == {"socket full": 3}
    link._bus.socket.close()
    link.close()


def test_a_bus_that_is_missing_is_said_and_found_when_it_comes(tmp_path):
    port = tmp_path / "can"
    config = bus_config(interface="slcan", channel=str(port), options={"bitrate": 500000, "sleep_after_open": 0.0})
    with listening("can.bus", lambda: CanLink(config, CLOCK)) as (listener, log):
        wait_until(lambda: "cannot be opened" in listener.statuses()[0].message, "said to be missing")
        assert listener.statuses()[0].level == 2
        for _ in range(2):  # there, gone, and there again
            before = len(log.messages)
            master, slave = os.openpty()
            tty.setraw(master)
            tty.setraw(slave)
            port.unlink(missing_ok=True)
            port.symlink_to(os.ttyname(slave))
            wait_until(lambda: listener.statuses()[0].level < 2, "opened")
            os.write(master, b"t1232AABB\rt12zz\rt1231CC\r")
            wait_until(lambda before=before: len(log.messages) == before + 2, "heard")
            port.unlink()
            os.close(slave)
            os.close(master)
            wait_until(lambda: listener.statuses()[0].level == 2, "said to be gone")
    account = listener.account()
    assert account["can.bus.messages"] == "4"
    assert json.loads(account["can.bus.lost"]) == {"garbled": 2}
    outages = json.loads(account["can.bus.outages"])
    assert len(outages) == 3  # before, between and after
    assert all(begin_ns < end_ns for begin_ns, end_ns in outages)
    assert [CanFrame.decode(data).data for _, _, data in log.messages] == [b"\xaa\xbb", b"\xcc"] * 2


def test_an_unknown_interface_names_bus_and_table():
    with pytest.raises(LinkError, match=r"CAN bus bus \(nonsense test\).*\[\[can\]\]"):
        CanLink(bus_config(interface="nonsense"), CLOCK)


def test_a_silent_bus_is_a_warning(monkeypatch):
    monkeypatch.setattr("capture.listener.SILENT_S", 0.05)
    with listening("can.bus", lambda: CanLink(bus_config(channel="silent"), CLOCK)) as (listener, _):
        wait_until(lambda: listener.statuses()[0].message.startswith("silent for"), "silence noticed")
        assert listener.statuses()[0].level == 1


def test_across_processes_in_a_network_of_its_own():
    needs_root()
    unshare = needs_program("unshare")
    needs_program("ip")
    program = Path(__file__).parents[1] / "support/udp_multicast_bus.py"
    done = subprocess.run([unshare, "-n", sys.executable, str(program)], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == list(range(200))


def test_whatever_a_driver_raises_the_link_is_opened_anew():
    attempts = []

    class Broken:
        lost: Counter[str] = Counter()  # noqa: RUF012

        def hear(self, wait_s: float) -> tuple[Heard, ...]:
            raise RuntimeError("firmware bug")

        def close(self) -> None:
            raise RuntimeError("and another")

    def connect() -> Broken:
        attempts.append(1)
        return Broken()

    with listening("odd", connect) as (listener, _):
        wait_until(lambda: len(attempts) > 2, "opened anew")
    assert "firmware bug" in listener.statuses()[0].message


def test_whatever_opening_raises_it_is_tried_again():
    attempts = []

    def connect() -> object:
        attempts.append(1)
        raise KeyError("bitrate")

    with listening("odd", connect) as (listener, _):
        wait_until(lambda: len(attempts) > 1, "tried again")
    assert "bitrate" in listener.statuses()[0].message


def test_what_a_link_counts_when_it_is_closed_is_in_the_account():
    class Counting:
        def __init__(self) -> None:
            self.lost: Counter[str] = Counter()

        def hear(self, wait_s: float) -> tuple[Heard, ...]:
            time.sleep(wait_s)
            return ()

        def close(self) -> None:
            self.lost["socket full"] = 7

    with listening("bus", Counting) as (listener, _):
        wait_until(lambda: listener.statuses()[0].level < 2, "opened")
    assert json.loads(listener.account()["bus.lost"]) == {"socket full": 7}


def test_after_stop_nothing_is_put():
    release = threading.Event()

    class Slow:
        lost: Counter[str] = Counter()  # noqa: RUF012
        asked = False

        def hear(self, wait_s: float) -> tuple[Heard, ...]:
            if not self.asked:
                self.asked = True
                return ()
            release.wait(DEADLINE_S)
            return (Heard(CAN_TOPIC, 1, b""),)

        def close(self) -> None:
            pass

    with listening("slow", Slow) as (listener, log):
        wait_until(lambda: listener.statuses()[0].level < 2, "opened")
        threading.Timer(0.2, release.set).start()
        listener.stop()
        assert log.messages == []


def test_the_aux_log_is_bounded_and_counts_what_it_drops():
    log = AuxLog(CLOCK)
    for number in range(MESSAGES_HELD + 5):
        log.put(CAN_TOPIC, number, b"")
    assert log.dropped == {CAN_TOPIC: 5}
    assert len(log.take()) == MESSAGES_HELD
    log.put(CAN_TOPIC, 0, b"")
    assert len(log.take()) == 1


def packets(count: int, first: int = 0) -> list[bytes]:
    """ATTITUDE messages by pymavlink's own encoder, numbered from ``first``."""
    from pymavlink.dialects.v20 import common

    sender = common.MAVLink(None, srcSystem=7, srcComponent=1)
    sender.seq = first
    made = []
    for number in range(count):
        made.append(sender.attitude_encode(1000 + number, 0.1 * number, -0.2, 3.0, 0.0, 0.0, 0.5).pack(sender))
        sender.seq = (sender.seq + 1) % 256
    return made


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def test_mavlink_by_udp_with_gaps_and_nonsense():
    needs_module("pymavlink")
    config = MavlinkConfig(address=f"udp:127.0.0.1:{free_port()}", messages=["ATTITUDE"])
    link = MavlinkLink(config, CLOCK)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        target = ("127.0.0.1", int(config.address.rsplit(":", 1)[1]))
        for packet in [*packets(10, first=250)[:5], b"nonsense", *packets(10, first=250)[8:]]:
            sender.sendto(packet, target)
        heard = []
        while len(heard) < 7:
            got = link.hear(1.0)
            heard += got
    link.close()
    messages = [Mavlink.decode(one.data) for one in heard]
    assert {one.topic for one in heard} == {MAVLINK_TOPIC}
    assert [(m.system, m.component, m.message) for m in messages] == [(7, 1, "ATTITUDE")] * 7
    rolls = [dict(zip(m.fields, m.values, strict=True))["roll"] for m in messages]
    assert rolls == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4, 0.8, 0.9])
    assert link.lost["missing in the sender's numbering"] == 3
    assert link.lost["garbled"] >= 1


def test_mavlink_by_serial_port_until_it_is_pulled():
    needs_module("pymavlink")
    master, slave = os.openpty()
    tty.setraw(master)
    tty.setraw(slave)
    config = MavlinkConfig(address=os.ttyname(slave), messages=["ATTITUDE"])
    with listening("mavlink", lambda: MavlinkLink(config, CLOCK)) as (listener, log):
        wait_until(lambda: listener.statuses()[0].level < 2, "opened")
        os.write(master, b"".join(packets(5)))
        wait_until(lambda: len(log.messages) == 5, "heard")
        os.close(slave)
        os.close(master)
        wait_until(lambda: listener.statuses()[0].level == 2, "said to be gone")
    assert "check its cable" in listener.statuses()[0].message or "cannot be opened" in listener.statuses()[0].message


def test_without_pymavlink_the_remedy_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pymavlink.dialects.v20.ardupilotmega", None)
    with pytest.raises(LinkError, match=r"wingshape\[mavlink\]"):
        MavlinkLink(MavlinkConfig(address="udp:127.0.0.1:0"), CLOCK)


def test_a_sample_line_is_read_back_and_nonsense_is_not():
    sample = Sample(7, 1_700_000_000_000_000_000, (0.0, -9.9999, 4.25))
    line = encode_line(*Sample(2**32 - 1, 2**62, (-10.0,) * 8).words())
    assert len(line) <= 120
    assert parse_sample(sample.words()) == sample
    for words in (
        ("SAMPLE", "1", "2"),
        ("SAMPLE", "1", "x", "0"),
        ("SAMPLE", "1", "2", "nan"),
        ("PULSE", "1", "2", "3"),
    ):
        with pytest.raises(GarbledLine):
            parse_sample(words)


@pytest.fixture
def sampling_board(tmp_path: Path) -> Iterator[SimulatedBoard]:
    board = SimulatedBoard(
        tmp_path / "trigger", 25.0, 1, CLOCK, lambda pulse: None, lambda time_ns: (time_ns % 1000 / 1000, 1.0)
    )
    board.start()
    yield board
    board.close()


def test_analog_samples_have_the_boards_time_and_the_configured_value(sampling_board):
    config = AnalogConfig(
        rate_hz=200.0,
        channels=[
            AnalogChannel(channel=1, name="flap_deg", scale=4.0, offset=-1.0),
            AnalogChannel(channel=0, name="a"),
        ],
    )
    log, analog = Log(), AnalogLog(config, CLOCK)
    board = TriggerBoard(str(sampling_board.port), CLOCK, lambda *_: None, analog.take)
    board.start()
    analog.start(log.put)
    analog.begin(board)
    wait_until(lambda: analog.samples >= 20, "sampled")
    assert analog.statuses()[0].level == 0
    analog.stop()
    count = len(log.messages)
    analog.take(Sample(99, 0, (1.0, 2.0)))
    assert len(log.messages) == count
    board.close()
    messages = [Analog.decode(data) for topic, _, data in log.messages if topic == ANALOG_TOPIC]
    flap, a = messages[0::2], messages[1::2]
    assert {(m.name, m.channel, m.volts, m.value) for m in flap} == {("flap_deg", 1, 1.0, 3.0)}
    assert [m.volts for m in a] == pytest.approx([m.time_ns % 1000 / 1000 for m in a], abs=1e-4)
    assert [m.sample for m in a] == list(range(len(a)))
    times_ns = [m.time_ns for m in a]
    assert {later - earlier for earlier, later in itertools.pairwise(times_ns)} == {5_000_000}
    assert all(m.receive_time_ns >= m.time_ns for m in messages)


def test_lost_samples_are_counted_and_a_missing_channel_is_said():
    config = AnalogConfig(channels=[AnalogChannel(channel=3, name="a")])
    analog = AnalogLog(config, CLOCK)
    analog.start(Log().put)
    for number in (0, 1, 4, 5, 0, 1):  # two lines lost; then the board was set up anew
        analog.take(Sample(number, 0, (0.0,)))
    assert analog.account() == {"analog.samples": "6", "analog.messages": "0", "analog.lost": "2"}
    analog._trouble = ""
    assert "no channel 3" in analog.statuses()[0].message


def other_data(tmp_path: Path, port: int) -> str:
    return (
        '[[can]]\nname = "aircraft"\ninterface = "virtual"\nchannel = "in a recording"\n'
        f'[[can]]\nname = "missing"\ninterface = "slcan"\nchannel = "{tmp_path / "nowhere"}"\n'
        '[analog]\nchannels = [{ channel = 0, name = "elevator_deg" }]\n'
        f'[mavlink]\naddress = "udp:127.0.0.1:{port}"\nmessages = ["ATTITUDE"]\n'
    )


def test_a_recording_has_them_and_goes_on_without_those_that_are_missing(write_config, rig, tmp_path):
    needs_module("pymavlink")
    port = free_port()
    path = write_config(rate_hz=20.0)
    path.write_text(path.read_text() + other_data(tmp_path, port))
    loaded = load_config(path)
    done = threading.Event()

    def speak() -> None:
        with (
            can.Bus(interface="virtual", channel="in a recording") as bus,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot,
        ):
            for number, packet in enumerate(packets(10_000)):
                bus.send(can.Message(arbitration_id=0x100, data=number.to_bytes(8, "little"), is_extended_id=False))
                autopilot.sendto(packet, ("127.0.0.1", port))
                if done.wait(0.02):
                    return

    speaking = threading.Thread(target=speak)
    speaking.start()
    companions = make_companions(loaded.config, CLOCK)
    result = Recording(loaded, CLOCK, SystemDisk(), lambda _: None, companions).run(StopRule(threading.Event(), 25))
    done.set()
    speaking.join()
    assert (result.lost, result.failures) == (0, []), result.as_dict()
    report = inspect([tmp_path])
    assert report.problems == []
    assert [note for note in report.notes if note.startswith("can.missing: was gone 1 times")] != []
    aux = tmp_path / "ssd_left/test/aux_0000.mcap"
    with aux.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        numbers = [
            int.from_bytes(bytes(message.data), "little")
            for _, _, _, message in reader.iter_decoded_messages(topics=[CAN_TOPIC])
        ]
        said = [
            (status.name, status.level, status.message)
            for _, _, _, message in reader.iter_decoded_messages(topics=["/diagnostics"])
            for status in message.status
        ]
        end = next(record.metadata for record in reader.iter_metadata() if record.name == "wingshape_end")
    assert len(numbers) > 20
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert any(name == "can.missing" and level == 2 and "cannot be opened" in words for name, level, words in said)
    assert any(name == "analog" and level == 2 and "no analog samples" in words for name, level, words in said)
    assert end["can.aircraft.messages"] == str(len(numbers))
    assert len(json.loads(end["can.missing.outages"])) == 1
    assert int(end["mavlink.messages"]) > 20
    assert aux.read_bytes()[:8] == (tmp_path / "ssd_right/test/aux_0000.mcap").read_bytes()[:8]
    with AnyReader([tmp_path / "ssd_right/test"]) as bag:
        counts = {connection.topic: connection.msgcount for connection in bag.connections}
    assert counts[CAN_TOPIC] == len(numbers)
    assert counts[MAVLINK_TOPIC] == int(end["mavlink.messages"])


def test_messages_that_are_not_there_are_a_problem_of_the_recording(write_config, rig, tmp_path, monkeypatch):
    """One in ten is dropped on the way to the disk, behind the recorder's back."""
    path = write_config(rate_hz=50.0)
    path.write_text(path.read_text() + '[[can]]\nname = "bus"\ninterface = "virtual"\nchannel = "leaky"\n')
    real, calls = AuxLog.put, itertools.count()

    def leaky(self: AuxLog, topic: str, time_ns: int, data: bytes) -> None:
        if topic != CAN_TOPIC or next(calls) % 10:
            real(self, topic, time_ns, data)

    monkeypatch.setattr(AuxLog, "put", leaky)
    loaded = load_config(path)
    done = threading.Event()

    def speak() -> None:
        with can.Bus(interface="virtual", channel="leaky") as bus:
            while not done.wait(0.005):
                bus.send(can.Message(arbitration_id=1, is_extended_id=False))

    speaking = threading.Thread(target=speak)
    speaking.start()
    Recording(loaded, CLOCK, SystemDisk(), lambda _: None, make_companions(loaded.config, CLOCK)).run(
        StopRule(threading.Event(), 25)
    )
    done.set()
    speaking.join()
    problems = inspect([tmp_path]).problems
    assert len(problems) == 2  # on each disk
    assert all("messages on /can, the recorder counted" in problem for problem in problems)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ('[[can]]\nname = "a"\ninterface = "virtual"\nchannel = "1"\n' * 2, "the bus a is there twice"),
        ('[[can]]\nname = "a"\ninterface = "virtual"\n', "can.0.channel"),
        (
            '[analog]\nchannels = [{ channel = 0, name = "a" }, { channel = 0, name = "b" }]\n',
            "channel 0 is there twice",
        ),
        ("[analog]\nchannels = []\n", "analog.channels"),
        ('[mavlink]\naddress = "tcp:1"\n', "mavlink.address"),
    ],
)
def test_a_wrong_table_is_refused(write_config, rig, table, words):
    path = write_config()
    path.write_text(path.read_text() + table)
    with pytest.raises(ConfigError) as refused:
        load_config(path)
    assert words in str(refused.value)


def test_nothing_here_warns():
    """python-can and pymavlink announce deprecations by warnings: what we use of them must not be among them."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        CanLink(bus_config(channel="quiet"), CLOCK).close()
    assert decode_line(encode_line("ANALOG", "0")) == ("ANALOG", "0")
