"""A configuration to a verdict: numeric checks of what a flight needs, each with its figures and what to do.

A check changes nothing for good and takes seconds. The table ``CHECKS`` is the order in which they run.
"""

import contextlib
import datetime
from collections.abc import Iterator, Mapping

from capture.burst import give_burst
from capture.camera.base import Camera, CameraDescription
from capture.camera_checks import check_calibration, check_cameras, check_usb
from capture.camera_place import camera_at, open_at
from capture.clock import EARLIEST_NS
from capture.errors import CaptureError
from capture.finding import Check, Finding, Situation
from capture.ledger import Place
from capture.ptp import POLL_S, PtpWatch
from capture.trigger import TriggerBoard
from capture.trigger_protocol import Pulse

BURST = 10  # triggers, where the configuration does not say

PTP_REMEDIES = {
    "ptp.answers": "see `journalctl -u ptp4l`",
    "ptp.state": "wait for ptp4l to reach it, or check the network and that the master runs",
    "ptp.sync": "check the network and that the master runs",
    "ptp.offset": "wait until ptp4l has settled; a constant offset means that nothing steers this clock",
    "ptp.grandmaster": "see which clock took over, and why",
    "ptp.utc": "give the grandmaster a time source, or tell it: pmc 'SET GRANDMASTER_SETTINGS_NP …'",
    "ptp.phc": "see `journalctl -u phc2sys`",
}


def check_clock(situation: Situation) -> list[Finding]:
    """The computer's clock has been set."""
    now_ns = situation.clock.utc_ns()
    said = f"{datetime.datetime.fromtimestamp(now_ns / 1e9, datetime.UTC):%Y-%m-%d %H:%M:%S} UTC"
    ok = now_ns >= EARLIEST_NS
    remedy = "" if ok else "set the clock: start PTP or NTP and wait until it has, or `date -u -s …`"
    return [Finding("clock", ok, f"the computer's clock says {said}", remedy, {"utc_ns": now_ns})]


def check_ptp(situation: Situation) -> list[Finding]:
    """The clock follows its master, closely, and knows UTC."""
    config = situation.config.ptp
    if config is None:
        remedy = 'add the table `[ptp]`; role = "none" in it says that the clock shall run free'
        return [Finding("ptp", False, "the configuration does not say what disciplines the computer's clock", remedy)]
    if config.role == "none":
        return [Finding("ptp", True, "not used: the clock runs free, as configured")]
    watch = PtpWatch(config, situation.clock)
    try:
        watch.start()
        situation.clock.sleep(config.silence_s + 2 * POLL_S)  # to see whether Syncs are coming
        failing, figures, said = watch.failing, watch.figures(), watch.statuses()[0].message
    finally:
        watch.stop()
    if not failing:
        return [Finding("ptp", True, said, numbers=figures)]
    return [Finding(name, False, cause, PTP_REMEDIES[name], figures) for name, cause in failing.items()]


def check_board(situation: Situation) -> list[Finding]:
    """The trigger board answers, and its protocol is ours."""
    board = TriggerBoard(situation.config.trigger.port, situation.clock, lambda pulse, trigger: None)
    try:
        board.start()
        name = board.hello()
        running, count = board.status()
    finally:
        board.close()
    numbers = {"running": running, "next_index": count.next_index, "counter": count.counter}
    found = f"{name} at {board.port}, {'running' if running else 'stopped'}, counter {count.counter}"
    return [Finding("trigger board", True, found, numbers=numbers)]


def check_burst(situation: Situation) -> list[Finding]:
    """A few triggers: board and cameras count the same, and each frame's instant can be told well enough."""
    config = situation.config
    pulses: list[Pulse] = []
    with contextlib.ExitStack() as cleanup:
        board = TriggerBoard(config.trigger.port, situation.clock, lambda pulse, trigger: pulses.append(pulse))
        cleanup.callback(board.close)
        board.start()
        if board.status()[0]:
            remedy = "stop whoever started it; a board that was left running stops at the next recording"
            return [Finding("test burst", False, f"{board.port}: the board is giving triggers already", remedy)]
        cameras: dict[Place, tuple[Camera, CameraDescription]] = {}
        for place in config.cameras:
            camera = camera_at(config, place)
            cleanup.callback(camera.close)
            cameras[place.side, place.name] = (camera, open_at(camera, config, place))
        count = config.start.burst or BURST
        found = give_burst(cameras, board, pulses, count, config.trigger.rate_hz, situation.clock)
    told = found.given == found.reported == count
    findings = [
        Finding(
            "test burst",
            told,
            f"asked for {count} triggers, the board gave {found.given} and reported {found.reported}",
            "" if told else "check the board's firmware and its serial line",
            {"asked": count, "given": found.given, "reported": found.reported},
        )
    ]
    for key, seen in found.cameras.items():
        trouble = found.trouble(key, config.camera.time_sigma_limit_us)
        good = f"{seen.frames} frames of {found.given} triggers, instants known to {seen.sigma_us:.1f} us"
        remedy = "check its trigger cable, exposure and rate" if trouble else ""
        findings.append(Finding(f"test burst {'/'.join(key)}", trouble is None, trouble or good, remedy, vars(seen)))
    return findings


CHECKS: Mapping[str, Check] = {
    "clock": check_clock,
    "ptp": check_ptp,
    "trigger board": check_board,
    "usb": check_usb,
    "cameras": check_cameras,
    "calibration": check_calibration,
    "test burst": check_burst,
}


def preflight(situation: Situation, checks: Mapping[str, Check] = CHECKS) -> Iterator[Finding]:
    """Run the checks one after another; each finding as it is found."""
    for name, check in checks.items():
        try:
            yield from check(situation)
        except CaptureError as error:
            found, _, remedy = str(error).rpartition(": ")
            yield Finding(name, False, found or remedy, remedy if found else "")
