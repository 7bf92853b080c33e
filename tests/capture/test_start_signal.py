"""What begins a recording: the autopilot's arming and a GPIO line, heard right, and through a recording to its end."""

import errno
import os
import socket
import struct
import subprocess
import sys
import threading
import time
import types
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from needs import needs_module, needs_program

from capture import gpio
from capture.clock import SystemClock
from capture.companions import make_companions, make_signal
from capture.config import GpioConfig, MavlinkConfig, load_config
from capture.daemon import Recording
from capture.disk import SystemDisk
from capture.errors import ConfigError, LinkError
from capture.mavlink_log import MavlinkLink
from capture.session import Session
from capture.start_signal import SILENT_S, StartSignal
from capture.verify import inspect
from hw_sim.aircraft import Aircraft
from hw_sim.autopilot import Autopilot
from hw_sim.rig import Rig
from hw_sim.world import World

CLOCK = SystemClock()
WORLD = World.make(1, scale=8)
DEADLINE_S = 30.0


class Hand(SystemClock):
    """A clock that the test moves on."""

    now_s = 100.0

    def monotonic_s(self) -> float:
        return self.now_s


def until(condition: Callable[[], bool], what: str) -> None:
    deadline_s = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline_s, f"not within {DEADLINE_S} s: {what}"
        time.sleep(0.02)


def told(words: list[tuple[float, bool]], ends_after_s: float | None) -> tuple[bool, bool]:
    """Whether a signal has begun and ended after it was told, second by second."""
    clock = Hand()
    signal = StartSignal(clock, ends_after_s)
    for at_s, on in words:
        clock.now_s = 100.0 + at_s
        signal.tell(on)
    return signal.begun, signal.ended


@pytest.mark.parametrize(
    ("words", "ends_after_s", "begun", "ended"),
    [
        ([], 0.0, False, False),
        ([(0, False), (9, False)], 0.0, False, False),  # never on: nothing to end
        ([(0, True)], 0.0, True, False),
        ([(0, True), (1, False)], None, True, False),  # not configured
        ([(0, True), (1, False)], 0.0, True, True),
        ([(0, True), (1, False), (2, False), (3, False)], 3.0, True, False),
        ([(0, True), (1, False), (2, False), (3, False), (4, False)], 3.0, True, True),
        ([(0, True), (1, False), (3, True), (4, False), (6, False)], 3.0, True, False),  # armed again between
        ([(0, True), (1, False), (2 + SILENT_S, False)], 3.0, True, False),  # who knows what was between
        ([(0, True), (1, False), (2 + SILENT_S, False), (5 + SILENT_S, False)], 3.0, True, True),
        ([(0, True), (1000, True)], 0.0, True, False),  # silence says nothing
    ],
)
def test_only_words_begin_and_end(words, ends_after_s, begun, ended):
    assert told(words, ends_after_s) == (begun, ended)


def test_another_aircraft_on_the_link_ends_nothing():
    signal = StartSignal(Hand(), 0.0)
    signal.tell(True, teller=1)
    signal.tell(False, teller=2)
    assert not signal.ended
    signal.tell(False, teller=1)
    assert signal.ended


def test_only_an_autopilots_heartbeat_says_armed(monkeypatch):
    """By pymavlink's own encoder; a ground station may set whatever bits it likes."""
    needs_module("pymavlink")
    from pymavlink.dialects.v20 import common

    words = []
    link = MavlinkLink(MavlinkConfig(address="udp:127.0.0.1:0"), CLOCK, lambda *said: words.append(said))
    sent = []
    for system, kind, autopilot, mode in (
        (255, common.MAV_TYPE_GCS, common.MAV_AUTOPILOT_INVALID, common.MAV_MODE_FLAG_SAFETY_ARMED),
        (1, common.MAV_TYPE_FIXED_WING, common.MAV_AUTOPILOT_ARDUPILOTMEGA, common.MAV_MODE_FLAG_AUTO_ENABLED),
        (1, common.MAV_TYPE_FIXED_WING, common.MAV_AUTOPILOT_PX4, common.MAV_MODE_FLAG_SAFETY_ARMED),
    ):
        sender = common.MAVLink(None, srcSystem=system, srcComponent=1)
        sent.append(sender.heartbeat_encode(kind, autopilot, mode, 0, 4).pack(sender))
    monkeypatch.setattr(link._port, "read", lambda _: b"".join(sent))
    assert link.hear(0.0) == []
    link.close()
    assert words == [(False, 1), (True, 1)]


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Field:
    """A simulated rig, an autopilot and a recorder that has been switched on."""

    def __init__(self, folder: Path, start: str) -> None:
        needs_module("pymavlink")
        self.port = free_port()
        self.rig = Rig(WORLD, folder / "rig.sock", folder / "trigger", CLOCK)
        self.rig.start()
        self.pilot = self.new_pilot()
        cameras = "".join(
            f'[[cameras]]\nside = "{side}"\nname = "cam0"\naddress = "{folder}/rig.sock#{side}_cam0"\n'
            for side in ("left", "right")
        )
        config = folder / "wingcap.toml"
        config.write_text(
            f'flight = "test"\n[start]\non = "mavlink-arm"\n{start}'
            f'[trigger]\nport = "{folder}/trigger"\n[disks]\nleft = "left"\nright = "right"\nreserve_mb = 1\n'
            f'[ptp]\nsocket = "{folder}/no-ptp4l"\n'  # a gate that fails: it must not matter
            f'[camera]\nbackend = "simulated"\nwidth = 260\nheight = 194\n{cameras}'
            f'[mavlink]\naddress = "udp:127.0.0.1:{self.port}"\n'
        )
        for disk in ("left", "right"):
            (folder / disk).mkdir()
        loaded = load_config(config)
        self.said: list[str] = []
        self.listeners = []

        def make() -> Recording:
            signal = make_signal(loaded.config, CLOCK)
            companions = make_companions(loaded.config, CLOCK, signal)
            self.listeners.append(companions[0])
            return Recording(loaded, CLOCK, SystemDisk(), self.said.append, companions, signal=signal)

        self.session = Session(loaded.config.start, make, self.said.append)
        self.thread = threading.Thread(target=self.session.run, args=(0, 0.0))
        self.thread.start()

    def new_pilot(self, armed: bool = False) -> Autopilot:
        pilot = Autopilot(Aircraft(WORLD), f"127.0.0.1:{self.port}", CLOCK)
        pilot.armed = armed
        pilot.start()
        return pilot

    def reaches(self, state: str) -> None:
        until(lambda: self.session.state == state, state)

    def hears_for(self, seconds: float) -> None:
        """Let the autopilot's heartbeats come, one a second."""
        before = self.listeners[-1].messages
        until(lambda: self.listeners[-1].messages - before > 40 * seconds, "heard")

    def close(self) -> None:
        self.session.quit()
        self.thread.join(20)
        self.pilot.close()
        self.rig.close()
        assert not self.thread.is_alive()


@pytest.fixture
def field(tmp_path) -> Iterator[Callable[[str], Field]]:
    made: list[Field] = []

    def make(start: str) -> Field:
        made.append(Field(tmp_path, start))
        return made[-1]

    yield make
    for one in made:
        one.close()


def whole(folder: Path, flight: str) -> None:
    report = inspect([folder / "left" / flight, folder / "right" / flight])
    assert (report.problems, report.lost) == ([], 0)
    assert report.recorded == 2 * report.triggers > 0
    assert "ptp.answers" in {mark.name for mark in report.marks.values()}


@pytest.mark.slow
def test_arming_records_disarming_ends_and_a_lost_link_does_neither(field, tmp_path):
    here = field("disarm_ends_after_s = 1.5\n")
    here.reaches("armed")
    here.hears_for(1.5)
    assert here.session.state == "armed"
    here.pilot.armed = True
    here.reaches("recording")
    here.pilot.close()  # the link is lost …
    time.sleep(3.0)
    assert here.session.state == "recording"
    here.pilot = here.new_pilot(armed=True)  # … and comes back
    here.hears_for(1.5)
    assert here.session.state == "recording"
    here.pilot.armed = False
    until(lambda: len(here.session.results) == 1, "ended by disarming")
    here.reaches("armed")  # for the next flight
    assert here.session.results[0].failures == []
    whole(tmp_path, "test")
    here.pilot.armed = True
    here.reaches("recording")
    here.session.act("stop")
    here.reaches("idle")
    assert [result.flight for result in here.session.results] == ["test", "test_2"]


@pytest.mark.slow
def test_unless_configured_disarming_ends_nothing(field, tmp_path):
    here = field("")
    here.pilot.armed = True
    here.reaches("recording")
    here.pilot.armed = False
    here.hears_for(3)
    assert here.session.state == "recording"
    here.session.act("stop")
    here.reaches("idle")
    whole(tmp_path, "test")


def test_a_person_need_not_wait_for_an_autopilot_that_is_silent(field, tmp_path):
    here = field("")
    here.pilot.close()
    here.reaches("armed")
    answer = here.session.act("start")
    assert (answer.ok, answer.message) == (True, "starting without what it waits for")
    here.reaches("recording")
    assert not here.session.act("start").ok
    here.session.act("stop")
    here.reaches("idle")


GPIO_TABLE = '[start]\non = "gpio"\n[start.gpio]\nchip = "/dev/gpiochip0"\nline = 17\n'


@pytest.mark.parametrize(
    ("top", "words"),
    [
        ('[start]\non = "mavlink-arm"', "needs the table [mavlink]"),
        ('[start]\non = "gpio"', "needs the table [start.gpio]"),
        (GPIO_TABLE.replace('"gpio"', '"command"'), 'does nothing with on = "command"'),
        (GPIO_TABLE.replace("line = 17\n", ""), "`start.gpio.line` is missing"),
        (GPIO_TABLE + 'active = "maybe"', "start.gpio.active"),
        ("[start]\ndisarm_ends_after_s = 3", 'does nothing with on = "power-up"'),
    ],
)
def test_what_lacks_what_it_needs_is_refused_in_a_line(write_config, top, words):
    with pytest.raises(ConfigError) as refused:
        load_config(write_config(top=top))
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)


def test_without_pymavlink_arming_cannot_be_waited_for(write_config, monkeypatch):
    path = write_config(top='[start]\non = "mavlink-arm"\n[mavlink]\naddress = "udp::14550"')
    config = load_config(path).config
    monkeypatch.setitem(sys.modules, "pymavlink.dialects.v20.ardupilotmega", None)
    with pytest.raises(ConfigError, match=r"wingshape\[mavlink\]"):
        make_companions(config, CLOCK, make_signal(config, CLOCK))


KERNEL_SAYS = """
#include <linux/gpio.h>
#include <stddef.h>
#include <stdio.h>
#include <string.h>
int main(void) {
    struct gpio_v2_line_request r;
    memset(&r, 0, sizeof r);
    r.offsets[0] = 17;
    strcpy(r.consumer, "wingcap");
    r.config.flags = GPIO_V2_LINE_FLAG_INPUT | GPIO_V2_LINE_FLAG_ACTIVE_LOW
        | GPIO_V2_LINE_FLAG_EDGE_RISING | GPIO_V2_LINE_FLAG_EDGE_FALLING;
    r.config.num_attrs = 1;
    r.config.attrs[0].attr.id = GPIO_V2_LINE_ATTR_ID_DEBOUNCE;
    r.config.attrs[0].attr.debounce_period_us = 2500;
    r.config.attrs[0].mask = 1;
    r.num_lines = 1;
    r.event_buffer_size = 16;
    fwrite(&r, sizeof r, 1, stdout);
    struct gpio_v2_line_event e = {.timestamp_ns = 5, .id = GPIO_V2_LINE_EVENT_RISING_EDGE, .offset = 17, .seqno = 3};
    fwrite(&e, sizeof e, 1, stdout);
    unsigned long long says[] = {GPIO_V2_GET_LINE_IOCTL, GPIO_V2_LINE_GET_VALUES_IOCTL,
        sizeof(struct gpio_v2_line_values), offsetof(struct gpio_v2_line_request, fd)};
    fwrite(says, sizeof says, 1, stdout);
    return 0;
}
"""


def test_the_structures_are_those_of_the_kernels_header(tmp_path):
    """Byte for byte as a C compiler lays them out."""
    compiler = needs_program("cc")
    (tmp_path / "says.c").write_text(KERNEL_SAYS)
    subprocess.run([compiler, "-o", tmp_path / "says", tmp_path / "says.c"], check=True)
    said = subprocess.run([tmp_path / "says"], check=True, capture_output=True).stdout
    request, event, rest = said[:592], said[592:640], struct.unpack("4Q", said[640:])
    assert gpio.line_request(GpioConfig(chip="/dev/x", line=17, active="low", debounce_ms=2.5)) == request
    assert gpio.EVENT.unpack(event) == (5, gpio.RISING, 17, 3, 0)
    assert rest == (gpio.GET_LINE, gpio.GET_VALUES, gpio.VALUES.size, gpio.REQUEST.size - 4)


@pytest.fixture
def kernel(monkeypatch, tmp_path):
    """Answers as the kernel does for a chip of which one line is asked for."""

    class Kernel:
        level = 0
        error = 0
        chip = tmp_path / "gpiochip0"

        def __init__(self) -> None:
            self.chip.touch()
            self.line, self.edges = os.pipe()

        def ioctl(self, _descriptor: int, what: int, structure: bytearray) -> None:
            if self.error:
                raise OSError(self.error, os.strerror(self.error))
            if what == 0xC250B407:
                structure[588:592] = struct.pack("=i", self.line)
            else:
                assert what == 0xC010B40E
                structure[:8] = struct.pack("=Q", self.level)

        def edge(self, kind: int) -> None:
            os.write(self.edges, struct.pack("=QIIII24x", 1, kind, 4, 1, 1))

    made = Kernel()
    monkeypatch.setattr(gpio, "fcntl", types.SimpleNamespace(ioctl=made.ioctl))
    return made


def test_a_line_that_is_active_or_becomes_so_begins(kernel):
    config = GpioConfig(chip=str(kernel.chip), line=4)
    signal = StartSignal(CLOCK)
    line = gpio.GpioLine(config, signal)
    line.hear(0.0)
    kernel.edge(2)
    line.hear(1.0)
    assert not signal.begun
    kernel.edge(1)
    kernel.edge(2)  # a button, let go at once
    line.hear(1.0)
    assert signal.begun
    os.close(kernel.edges)
    with pytest.raises(LinkError, match=r"gpiochip0 line 4: is gone"):
        line.hear(1.0)
    line.close()
    kernel.line, kernel.edges = os.pipe()
    kernel.level = 1
    at_once = StartSignal(CLOCK)
    gpio.GpioLine(config, at_once).close()
    assert at_once.begun
    os.close(kernel.edges)


def test_a_line_that_cannot_be_had_is_said_so(kernel):
    kernel.error = errno.EBUSY
    with pytest.raises(LinkError, match=r"line 4: cannot be watched \(Device or resource busy\): check .*start.gpio"):
        gpio.GpioLine(GpioConfig(chip=str(kernel.chip), line=4), StartSignal(CLOCK))
    with pytest.raises(LinkError, match="No such file"):
        gpio.GpioLine(GpioConfig(chip="/dev/no-such-chip", line=4), StartSignal(CLOCK))
    os.close(kernel.line)
    os.close(kernel.edges)


def test_a_line_records_and_its_chip_may_come_late(kernel, write_config, rig, tmp_path):
    table = GPIO_TABLE.replace("/dev/gpiochip0", str(kernel.chip))
    loaded = load_config(write_config(top=table))
    kernel.chip.unlink()
    signal = make_signal(loaded.config, CLOCK)
    companions = make_companions(loaded.config, CLOCK, signal)

    def make() -> Recording:
        return Recording(loaded, CLOCK, SystemDisk(), lambda _: None, companions, signal=signal)

    session = Session(loaded.config.start, make, lambda _: None)
    thread = threading.Thread(target=session.run, args=(10, 0.0))
    thread.start()
    until(lambda: session.state == "armed", "armed")
    until(lambda: "cannot be watched" in companions[0].statuses()[0].message, "missed")
    kernel.chip.touch()
    until(lambda: companions[0].statuses()[0].level == 0, "found")
    assert session.state == "armed"
    kernel.edge(1)
    thread.join(20)
    assert (session.results[0].triggers, session.results[0].failures) == (10, [])
    assert inspect([tmp_path]).problems == []
    os.close(kernel.edges)
