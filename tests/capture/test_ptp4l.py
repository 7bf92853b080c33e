"""Against real ptp4l, master and slave, in two network namespaces. No clock is steered."""

import re
import subprocess
import threading
import time
from pathlib import Path

import pytest
from needs import needs_program
from ptp_pair import PtpPair, ptp_pair

from capture.clock import SystemClock
from capture.config import PtpConfig, load_config
from capture.daemon import Recording
from capture.disk import SystemDisk
from capture.finding import Situation
from capture.preflight import check_ptp
from capture.ptp import PtpWatch, read_ptp
from capture.record import GATE_TOPIC, PTP_TOPIC, Frame, Gate, Ptp, PtpState
from capture.scan import scan
from capture.stop_rule import StopRule
from capture.verify import inspect

pytestmark = pytest.mark.slow


@pytest.fixture
def pair(tmp_path):
    with ptp_pair(tmp_path) as made:
        made.start_master()
        made.start_slave()
        made.wait_for_slave()
        yield made


class Log:
    """Collects what a watch writes."""

    def __init__(self) -> None:
        self.ptp: list[Ptp] = []
        self.gates: list[Gate] = []

    def put(self, topic: str, time_ns: int, data: bytes) -> None:
        if topic == PTP_TOPIC:
            self.ptp.append(Ptp.decode(data))
        else:
            assert topic == GATE_TOPIC
            self.gates.append(Gate.decode(data))


def until(condition, seconds: float) -> float:
    """Seconds until ``condition`` holds."""
    start_s = time.monotonic()
    while not condition():
        assert time.monotonic() - start_s < seconds
        time.sleep(0.02)
    return time.monotonic() - start_s


def watch_of(pair: PtpPair, log: Log) -> PtpWatch:
    watch = PtpWatch(PtpConfig(socket=pair.slave_socket, offset_limit_us=1000.0), SystemClock())
    watch.start(log.put)
    return watch


def test_what_we_read_is_what_pmc_reads(pair):
    ours = read_ptp(PtpConfig(socket=pair.slave_socket))
    sets = ("TIME_STATUS_NP", "PORT_DATA_SET", "CURRENT_DATA_SET", "PARENT_DATA_SET", "TIME_PROPERTIES_DATA_SET")
    own = str(pair.folder / "pmc")
    command = [needs_program("pmc"), "-u", "-b", "0", "-i", own, "-s", str(pair.slave_socket)]
    said = subprocess.run([*command, *(f"GET {name}" for name in sets)], capture_output=True, text=True).stdout
    theirs = dict(re.findall(r"^\s+([\w.]+)\s+(\S+)$", said, re.MULTILINE))
    assert theirs["portState"] == ours.port_state.name == "SLAVE"
    assert theirs["gmIdentity"].replace(".", "") == f"{ours.gm_identity:016x}"
    assert theirs["portIdentity"].split("-")[0].replace(".", "") == f"{ours.clock_identity:016x}"
    assert (theirs["gmPresent"], theirs["stepsRemoved"], theirs["gm.ClockClass"]) == ("true", "1", "6")
    assert ours.gm_present
    assert (ours.steps_removed, ours.gm_clock_class) == (1, 6)
    assert int(theirs["currentUtcOffset"]) == ours.utc_offset_s
    assert theirs["currentUtcOffsetValid"] == str(int(ours.utc_offset_valid)) == "0"
    assert abs(int(theirs["ingress_time"]) - ours.ingress_ns) < 2e9
    # Both clocks are this computer's own: what is measured is the time stamps' noise.
    assert abs(ours.offset_ns) < 1e6
    assert 0 < ours.path_delay_ns < 1e6


def test_a_slave_is_logged_and_a_killed_master_is_marked_within_two_seconds(pair):
    pair.vouch_for_utc()
    log = Log()
    watch = watch_of(pair, log)
    until(lambda: len(log.ptp) > 8 and not watch.failing, 10)
    assert watch.now().ptp_state is PtpState.SLAVE
    assert watch.now().sigma_ns < 1e6
    assert log.ptp[-1].utc_offset_s == 37
    before = len(log.gates)
    pair.kill("master")
    until(lambda: len(log.gates) > before, 2.0)
    assert {gate.name for gate in log.gates[before:]} <= {"ptp.sync", "ptp.state"}
    until(lambda: {"ptp.state", "ptp.sync"} <= set(watch.failing), 5)
    stale = log.ptp[-1]
    assert (stale.gm_present, stale.sync_fresh) == (1, 0)  # what ptp4l still says
    sigma_ns = watch.now().sigma_ns
    pair.start_master()
    pair.vouch_for_utc()
    until(lambda: not watch.failing, 15)
    assert watch.now().sigma_ns < sigma_ns + 1e6
    watch.stop()
    marks = [gate for gate in log.gates[before:] if gate.name == "ptp.state"]
    assert (len(marks), marks[0].end_ns) == (2, 0)
    assert marks[1].end_ns - marks[1].begin_ns > 0


def test_a_dead_master_is_marked_long_before_the_port_notices(tmp_path):
    with ptp_pair(tmp_path, announce=1) as pair:  # an Announce each 2 s, three may be missing: linuxptp's defaults
        pair.start_master()
        pair.start_slave()
        pair.wait_for_slave(30)
        log = Log()
        watch = watch_of(pair, log)
        until(lambda: "ptp.sync" not in watch.failing, 5)
        pair.kill("master")
        until(lambda: "ptp.sync" in watch.failing, 2.0)
        assert watch.now().ptp_state is PtpState.SLAVE  # so it says
        watch.stop()


def test_two_milliseconds_of_asymmetry_are_seen_as_such(pair):
    symmetric_ns = read_ptp(PtpConfig(socket=pair.slave_socket)).offset_ns
    pair.kill("slave")
    pair.start_slave(asymmetry_ns=2_000_000)
    pair.wait_for_slave()
    log = Log()
    watch = watch_of(pair, log)
    until(lambda: "ptp.offset" in watch.failing, 5)
    watch.stop()
    moved_ns = log.ptp[-1].offset_ns - symmetric_ns
    assert abs(abs(moved_ns) - 2e6) < 0.3e6  # software time stamps of a busy machine
    found = check_ptp(Situation(config_of(pair), SystemClock()))
    assert "ptp.offset" in {finding.name for finding in found if not finding.ok}


def test_another_grandmaster_and_a_ptp4l_that_dies(pair):
    log = Log()
    watch = watch_of(pair, log)
    first = log.ptp[-1].grandmaster
    pair.kill("master")
    pair.start_master(identity="aabbcc.fffe.ddeeff")
    until(lambda: "ptp.grandmaster" in watch.failing, 20)
    assert watch.failing["ptp.grandmaster"] == f"from {first} to aabbcc.fffe.ddeeff"
    until(lambda: "ptp.grandmaster" not in watch.failing, 20)
    pair.kill("slave")
    until(lambda: "ptp.answers" in watch.failing, 2.0)
    pair.start_slave()
    until(lambda: "ptp.answers" not in watch.failing, 5)
    watch.stop()


def config_of(pair: PtpPair):
    """A whole configuration that names this slave."""
    path = pair.folder / "check.toml"
    path.write_text(
        f'[ptp]\nsocket = "{pair.slave_socket}"\n[trigger]\nport = "none"\n[disks]\nleft = "a"\nright = "b"\n'
        '[camera]\nbackend = "simulated"\n[[cameras]]\nside = "left"\nname = "cam0"\naddress = "none"\n'
    )
    return load_config(path).config


def test_a_recording_carries_the_state_in_each_frame_and_the_loss_of_the_master(pair, write_config, rig, tmp_path):
    pair.vouch_for_utc()
    time.sleep(1.0)  # until the slave has heard of it
    config = load_config(write_config(top=f'[ptp]\nsocket = "{pair.slave_socket}"\noffset_limit_us = 1000'))
    stop = threading.Event()
    killer = threading.Timer(2.0, lambda: pair.kill("master"))
    ender = threading.Timer(5.0, stop.set)
    killer.start()
    ender.start()
    result = Recording(config, SystemClock(), SystemDisk(), lambda _: None).run(StopRule(stop))
    killer.join()
    ender.join()
    assert result.failures == []
    assert inspect([tmp_path / "ssd_left", tmp_path / "ssd_right"]).problems == []
    states, gates, statuses, provenance = read(tmp_path / "ssd_left/test")
    assert states[0] is PtpState.SLAVE
    assert PtpState.SLAVE is not states[-1]
    assert {"ptp.sync", "ptp.state"} & {gate.name for gate in gates if gate.end_ns == 0}
    assert all(any(g.begin_ns == gate.begin_ns and g.end_ns for g in gates) for gate in gates)
    assert len(statuses) > 10
    assert provenance["tai_offset_s"] == "37"
    assert provenance["time_base"].startswith("UTC by PTP: port SLAVE, grandmaster ")


def read(folder: Path):
    states, gates, statuses, provenance = [], [], [], {}
    for path in sorted(folder.glob("*.mcap")):
        found, messages = scan(path)
        for message in messages:
            if message.topic == "/left/cam0/frame":
                states.append(PtpState(Frame.decode(message.data).ptp_state))
            elif message.topic == GATE_TOPIC:
                gates.append(Gate.decode(message.data))
            elif message.topic == PTP_TOPIC:
                statuses.append(Ptp.decode(message.data))
        provenance = found.provenance
    return states, gates, statuses, provenance
