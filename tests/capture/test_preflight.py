"""Preflight: go on a rig that is in order; each thing that is not is refused with its figures and a remedy."""

import json

from capture.clock import SystemClock
from capture.config import load_config
from capture.errors import DiskError
from capture.finding import Finding, Situation
from capture.preflight import CHECKS, check_clock, preflight


class ClockOf1970(SystemClock):
    def utc_ns(self) -> int:
        return 3_600_000_000_000


def test_a_clock_that_was_never_set_is_refused(write_config):
    (found,) = check_clock(Situation(load_config(write_config()).config, ClockOf1970()))
    assert not found.ok
    assert "1970-01-01 01:00:00" in found.found
    assert found.remedy


def test_what_a_check_raises_is_a_finding_and_the_others_still_run(write_config):
    def broken(situation):
        raise DiskError("/mnt/ssd_left: 3 MB free: free space on this disk")

    situation = Situation(load_config(write_config()).config, SystemClock())
    found = list(preflight(situation, {"disk": broken, "clock": CHECKS["clock"]}))
    assert found[0] == Finding("disk", False, "/mnt/ssd_left: 3 MB free", "free space on this disk")
    assert found[1].ok


def test_a_silent_board_is_no_go(write_config, rig, wingcap):
    config = write_config()
    config.write_text(config.read_text().replace(rig.port, "/dev/no-such-port").replace('"fake"', '"simulated"'))
    done = wingcap("preflight", "--config", config, "--json")
    assert done.returncode == 1
    assert "/dev/no-such-port" in done.stderr
    report = json.loads(done.stdout)
    assert not report["go"]
    (board,) = [finding for finding in report["findings"] if finding["name"] == "trigger board"]
    assert not board["ok"]
    assert "`trigger.port`" in board["remedy"]
