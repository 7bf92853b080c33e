"""Real ptp4l, master and slave, in two network namespaces that a veth joins. No clock is steered: the slave may not."""

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

from needs import needs_program, needs_root

from capture.errors import PtpError
from capture.ptp import PtpSocket
from capture.record import PtpState

_COMMON = """[global]
time_stamping software
network_transport L2
logSyncInterval -3
logMinDelayReqInterval -3
logAnnounceInterval {announce}
announceReceiptTimeout 3
tx_timestamp_timeout 100
uds_address {socket}
use_syslog 0
verbose 1
{role}
[{port}]
{per_port}
"""
_MASTER = "masterOnly 1\nfree_running 1\nclockClass 6\npriority1 {priority}"
# A servo that is quick to believe in its estimate: else the port stays UNCALIBRATED for 16 s.
_SLAVE = "slaveOnly 1\nfirst_step_threshold 0\nstep_threshold 0\npi_proportional_const 0.7\npi_integral_const 0.3"


class PtpPair:
    """Two clocks. ``asymmetry_ns``: the slave is told that its path is so much longer one way, which it is not."""

    def __init__(self, folder: Path, announce: int = -2) -> None:
        self.folder = folder
        self.announce = announce
        self.slave_socket, self.master_socket = folder / "slave", folder / "master"
        self._ptp4l, self._ip = needs_program("ptp4l"), needs_program("ip")
        self._names = [f"ptp{role}{os.getpid()}" for role in "ms"]
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> "PtpPair":
        master, slave = self._names
        for name in self._names:
            self._run("netns", "add", name)
        self._run("link", "add", "pm", "netns", master, "type", "veth", "peer", "name", "ps", "netns", slave)
        for name, port in ((master, "pm"), (slave, "ps")):
            self._run("-n", name, "link", "set", port, "up")
        return self

    def __exit__(self, *_: object) -> None:
        for role in list(self._running):
            self.kill(role)
        for name in self._names:
            subprocess.run([self._ip, "netns", "del", name], check=False)

    def start_master(self, priority: int = 10, identity: str = "") -> None:
        """A master; ``identity`` is another clock's than the port's own."""
        role = _MASTER.format(priority=priority) + (f"\nclockIdentity {identity}" if identity else "")
        self._start("master", "pm", self.master_socket, role, "", [])

    def start_slave(self, asymmetry_ns: int = 0) -> None:
        """A slave without the right to set any clock."""
        forbid = [needs_program("setpriv"), "--bounding-set", "-sys_time", "--inh-caps", "-sys_time"]
        self._start("slave", "ps", self.slave_socket, _SLAVE, f"delayAsymmetry {asymmetry_ns}", forbid)

    def wait_for_slave(self, seconds: float = 15.0) -> None:
        """Until the slave's port says SLAVE."""
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            with contextlib.suppress(PtpError), contextlib.closing(PtpSocket(self.slave_socket, 0)) as connection:
                if connection.read().port_state is PtpState.SLAVE:
                    return
            time.sleep(0.1)
        raise AssertionError(f"no SLAVE after {seconds} s: {self.log('slave')}")

    def kill(self, role: str) -> None:
        """SIGKILL: no farewell."""
        process = self._running.pop(role)
        process.send_signal(signal.SIGKILL)
        process.wait()
        (self.folder / role).unlink(missing_ok=True)

    def vouch_for_utc(self) -> None:
        """The master knows UTC from now on. Its time stamps are those of a clock on UTC: the scale stays arbitrary."""
        words = (
            "SET GRANDMASTER_SETTINGS_NP clockClass 6 clockAccuracy 0x21 offsetScaledLogVariance 0x4e5d "
            "currentUtcOffset 37 leap61 0 leap59 0 currentUtcOffsetValid 1 ptpTimescale 0 timeTraceable 1 "
            "frequencyTraceable 0 timeSource 0x20"
        )
        own = self.folder / "pmc"
        command = [needs_program("pmc"), "-u", "-b", "0", "-i", str(own), "-s", str(self.master_socket), words]
        for _ in range(20):  # one that has just been started is not listening yet
            answer = subprocess.run(command, check=False, capture_output=True, text=True)
            if "RESPONSE" in answer.stdout:
                return
            time.sleep(0.1)
        raise AssertionError(answer.stdout + answer.stderr)

    def log(self, role: str) -> str:
        """What that ptp4l said."""
        return (self.folder / f"{role}.log").read_text()

    def _start(self, role: str, port: str, socket: Path, lines: str, per_port: str, before: list[str]) -> None:
        config = self.folder / f"{role}.cfg"
        config.write_text(
            _COMMON.format(announce=self.announce, socket=socket, role=lines, port=port, per_port=per_port)
        )
        namespace = self._names[0 if role == "master" else 1]
        command = [self._ip, "netns", "exec", namespace, *before, self._ptp4l, "-f", str(config)]
        with (self.folder / f"{role}.log").open("wb") as log:
            self._running[role] = subprocess.Popen(command, stdout=log, stderr=log)

    def _run(self, *words: str) -> None:
        subprocess.run([self._ip, *words], check=True, capture_output=True)


@contextlib.contextmanager
def ptp_pair(folder: Path, announce: int = -2) -> Iterator[PtpPair]:
    """A pair with nothing running yet; gone, and all that it started, afterwards."""
    needs_root()
    pair = PtpPair(folder, announce)
    try:
        pair.__enter__()
    except subprocess.CalledProcessError as error:
        raise AssertionError(f"no network namespaces: {error.stderr!r}") from error
    try:
        yield pair
    finally:
        pair.__exit__()
