"""What ptp4l says to gates and an uncertainty, from made-up answers; the bytes, against linuxptp's own layout."""

import contextlib
import dataclasses
import math
import socket
import struct
import threading
from pathlib import Path

import pytest

from capture import phc, ptp
from capture.clock import SystemClock
from capture.config import PtpConfig
from capture.errors import PtpError
from capture.ptp_judge import HOLDOVER_PPM, SETTLE_S, PtpJudge
from capture.ptp_protocol import (
    Action,
    Id,
    NotManagement,
    PtpStatus,
    decode_reply,
    decode_status,
    encode_request,
    identity_text,
)
from capture.record import PtpState

GOOD = PtpStatus(
    port_state=PtpState.SLAVE,
    offset_ns=300,
    path_delay_ns=2500,
    ingress_ns=0,
    gm_present=True,
    gm_identity=0xF6A30AFFFE0232CA,
    gm_clock_class=6,
    clock_identity=0x4EEF84FFFEA9D7B7,
    steps_removed=1,
    utc_offset_s=37,
    utc_offset_valid=True,
    ptp_timescale=True,
    time_traceable=True,
)


class Story:
    """A judge that is asked four times a second, with a Sync a second."""

    def __init__(self, **config) -> None:
        self.judge = PtpJudge(PtpConfig(**config))
        self.now_s = 100.0

    def go(self, seconds: float, status: PtpStatus | None = GOOD, syncs: bool = True):
        for _ in range(round(seconds * 4)):
            self.now_s += 0.25
            if status is not None and syncs:
                status = dataclasses.replace(status, ingress_ns=math.floor(self.now_s) * 10**9)
            judged = self.judge.feed(status, "" if status else "no answer", None, self.now_s)
        self.last = status
        return judged, {name for name, cause in judged.causes.items() if cause}


def test_a_slave_in_order_fails_no_gate():
    judged, failing = Story().go(5)
    assert failing == set()
    assert judged.sigma_ns(100.0) == pytest.approx(300)


def test_a_dead_master_is_noticed_although_everything_stale_says_all_is_well():
    story = Story()
    story.go(5)
    stale = dataclasses.replace(story.last, gm_present=True)
    died_s = story.now_s
    while "ptp.sync" not in story.go(0.25, stale, syncs=False)[1]:
        assert story.now_s - died_s < 2.0
    judged, _ = story.go(10, stale, syncs=False)
    away_s = story.now_s - judged.good_s
    assert away_s > 9
    assert judged.sigma_ns(story.now_s) == pytest.approx(HOLDOVER_PPM * 1e3 * away_s, rel=0.01)


def test_what_was_never_followed_is_not_known():
    judged, failing = Story().go(3, dataclasses.replace(GOOD, port_state=PtpState.LISTENING))
    assert "ptp.state" in failing
    assert math.isnan(judged.sigma_ns(105.0))


def test_another_grandmaster_is_marked_until_it_has_been_followed_for_a_while():
    story = Story()
    story.go(5)
    other = dataclasses.replace(GOOD, gm_identity=7, offset_ns=250_000)
    assert story.go(1, other)[1] == {"ptp.grandmaster", "ptp.offset"}
    settled = dataclasses.replace(other, offset_ns=100)
    assert story.go(SETTLE_S - 0.5, settled)[1] == {"ptp.grandmaster"}
    assert story.go(1, settled)[1] == set()


@pytest.mark.parametrize(
    ("change", "gate"),
    [
        ({"offset_ns": -100_001}, "ptp.offset"),
        ({"utc_offset_valid": False}, "ptp.utc"),
        ({"port_state": PtpState.UNCALIBRATED}, "ptp.state"),
    ],
)
def test_each_gate(change, gate):
    assert Story().go(3, dataclasses.replace(GOOD, **change))[1] == {gate}


def test_a_silent_ptp4l_is_one_gate_and_the_uncertainty_grows():
    story = Story()
    story.go(5)
    judged, failing = story.go(20, None)
    assert failing == {"ptp.answers"}
    assert judged.port_state is PtpState.UNKNOWN
    assert judged.sigma_ns(story.now_s) > 150_000


def test_a_master_defines_the_time():
    judged, failing = Story(role="master").go(5, dataclasses.replace(GOOD, port_state=PtpState.MASTER, offset_ns=0))
    assert failing == set()
    assert judged.sigma_ns(105.0) == 0


def test_the_system_clock_must_follow_the_network_cards():
    judge = PtpJudge(PtpConfig(phc=Path("/dev/ptp0")))
    for offset_ns, wrong in ((20_000, False), (-300_000, True), (None, True)):
        judged = judge.feed(GOOD, "", offset_ns, 1.0)
        assert bool(judged.causes["ptp.phc"]) is wrong


def test_the_hardware_clocks_offset_is_that_of_its_quickest_reading():
    answer = bytearray(phc._SIZE)
    struct.pack_into("=I", answer, 0, phc.SAMPLES)
    now_ns = 1_700_000_000_000_000_000
    for k in range(2 * phc.SAMPLES + 1):
        after = now_ns + k * 5_000 + (k > 4) * 40_000  # the third reading was held up
        value = after + 1234 if k % 2 else after
        struct.pack_into("=qI", answer, 16 + 16 * k, *divmod(value, 10**9))
    assert phc.offset_of(answer) == 1234
    assert phc.PTP_SYS_OFFSET == 0x43403D05  # as linux/ptp_clock.h expands it
    assert phc.read_phc_offset_ns(Path("/dev/no-such-clock")) is None


def test_a_request_has_the_bytes_that_linuxptp_takes():
    request = encode_request(Action.GET, Id.TIME_STATUS_NP, 0x0102, 3)
    assert request[:4] == bytes.fromhex("0d020036")
    assert request[4] == 3
    assert request[30:34] == bytes.fromhex("0102047f")
    assert request[34:] == b"\xff" * 10 + bytes(4) + bytes.fromhex("00010002c000")


@pytest.mark.parametrize("cut", [0, 20, 40, 53])
def test_a_message_that_ends_early_is_refused(cut):
    with pytest.raises(NotManagement):
        decode_reply(encode_request(Action.GET, Id.PORT_DATA_SET, 1, 0)[:cut])
    with pytest.raises(NotManagement):
        decode_status(b"", b"", b"", b"", b"", [])


def test_an_identity_reads_as_linuxptp_writes_it():
    assert identity_text(0xF6A30AFFFE0232CA) == "f6a30a.fffe.0232ca"


def test_a_ptp4l_that_hangs_holds_up_neither_the_watch_nor_its_end(tmp_path, monkeypatch):
    """It takes nothing from its socket any more, which is full after a few questions."""
    monkeypatch.setattr(ptp, "REPLY_TIMEOUT_S", 0.01)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as hung:
        hung.bind(str(tmp_path / "ptp4l"))
        watch = ptp.PtpWatch(PtpConfig(role="slave", socket=tmp_path / "ptp4l"), SystemClock())
        asking = threading.Thread(target=lambda: [watch.step() for _ in range(600)], daemon=True)
        asking.start()
        asking.join(60)
        assert not asking.is_alive()
    assert watch.account() == {"ptp_asked": "600", "ptp_unanswered": "600"}


def test_an_answer_that_makes_no_sense_is_one_line_whenever_it_comes(tmp_path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as server:
        server.bind(str(tmp_path / "ptp4l"))

        def answer() -> None:
            _, client = server.recvfrom(1500)
            server.sendto(b"nonsense", client)

        threading.Thread(target=answer).start()
        connection = ptp.PtpSocket(tmp_path / "ptp4l", 0)
        with contextlib.closing(connection), pytest.raises(PtpError, match="makes no sense"):
            connection.subscribe()
