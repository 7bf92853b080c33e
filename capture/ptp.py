"""ptp4l's management socket to the state of this computer's clock: for frames, for gates, and logged to ``/ptp``."""

import contextlib
import os
import select
import socket
import tempfile
import threading
import uuid
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from capture.aux_log import Put
from capture.clock import Clock
from capture.config import PtpConfig
from capture.errors import PtpError
from capture.gates import Gates
from capture.phc import read_phc_offset_ns
from capture.ptp_judge import Judgement, PtpJudge
from capture.ptp_protocol import (
    MAX_MESSAGE_BYTES,
    NOTIFY_PORT_STATE,
    NOTIFY_TIME_SYNC,
    Action,
    Id,
    NotManagement,
    PtpStatus,
    Reply,
    decode_reply,
    decode_status,
    encode_request,
    encode_subscription,
    identity_text,
    number_of_ports,
)
from capture.record import PTP_TOPIC, Diagnostic, Ptp, PtpState
from capture.worker import Worker

POLL_S = 0.25
REPLY_TIMEOUT_S = 0.5
LOG_S = 1.0  # /ptp has a message whenever a Sync came or the state changed, at most each POLL_S, and at least so often
SUBSCRIBED_S = 60
_CLOCK_DATA = (
    Id.DEFAULT_DATA_SET,
    Id.CURRENT_DATA_SET,
    Id.PARENT_DATA_SET,
    Id.TIME_PROPERTIES_DATA_SET,
    Id.TIME_STATUS_NP,
)


class PtpSocket:
    """A connection to one ptp4l. Not thread-safe."""

    def __init__(self, server: Path, domain: int) -> None:
        """Connect.

        Raises:
            PtpError: nothing is there, or we may not talk to it.
        """
        self._server = str(server)
        self._domain = domain
        self._sequence = 0
        # ptp4l answers to a path: one that it sees too, so not in a private /tmp where there is a better place.
        folder = os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0] or tempfile.gettempdir()
        self._own = f"{folder}/wingcap-ptp-{uuid.uuid4().hex[:12]}"
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            self._socket.bind(self._own)
            self._socket.connect(self._server)
        except OSError as error:
            self.close()
            raise PtpError(
                f"{server}: ptp4l cannot be reached ({error.strerror}): start ptp4l, check `ptp.socket` against its "
                "uds_address, and that this user may write to it"
            ) from error

    def fileno(self) -> int:
        """For select."""
        return self._socket.fileno()

    def close(self) -> None:
        """Let go. Safe to call twice."""
        self._socket.close()
        Path(self._own).unlink(missing_ok=True)

    def subscribe(self) -> bool:
        """Ask to be told of events for SUBSCRIBED_S; False when this ptp4l does not do that."""
        data = encode_subscription((NOTIFY_PORT_STATE, NOTIFY_TIME_SYNC), SUBSCRIBED_S)
        try:
            return not self._ask(Action.SET, Id.SUBSCRIBE_EVENTS_NP, data)[0].refused
        except NotManagement as error:
            raise self._senseless(error) from error

    def drain(self) -> None:
        """Forget what was told: the caller asks for everything anyway."""
        with contextlib.suppress(BlockingIOError):
            for _ in range(64):
                self._socket.recv(MAX_MESSAGE_BYTES, socket.MSG_DONTWAIT)

    def read(self) -> PtpStatus:
        """Everything of interest, now.

        Raises:
            PtpError: ptp4l does not answer, or refuses.
        """
        try:
            default, current, parent, properties, status = (self._ask(Action.GET, id)[0].data for id in _CLOCK_DATA)
            ports = self._ask(Action.GET, Id.PORT_DATA_SET, answers=number_of_ports(default))
            return decode_status(default, current, parent, properties, status, [port.data for port in ports])
        except NotManagement as error:
            raise self._senseless(error) from error

    def _senseless(self, error: NotManagement) -> PtpError:
        return PtpError(f"{self._server}: ptp4l's answer makes no sense ({error}): check its version")

    def _ask(self, action: Action, id: Id, data: bytes = b"", answers: int = 1) -> list[Reply]:
        self._sequence = self._sequence % 0xFFFF + 1
        found: list[Reply] = []
        try:
            # Not to be waited for: a ptp4l that hangs takes nothing from its socket, which is soon full.
            self._socket.send(encode_request(action, id, self._sequence, self._domain, data), socket.MSG_DONTWAIT)
            for _ in range(64):
                if len(found) == answers:
                    return found
                if not select.select([self._socket], [], [], REPLY_TIMEOUT_S)[0]:
                    break
                reply = decode_reply(self._socket.recv(MAX_MESSAGE_BYTES))
                if reply.sequence == self._sequence and (reply.id == id or reply.refused):
                    found.append(reply)
        except OSError as error:
            raise PtpError(f"{self._server}: ptp4l is gone ({error.strerror}): start it again") from error
        raise PtpError(
            f"{self._server}: ptp4l does not answer {id.name} within {REPLY_TIMEOUT_S:g} s: check that it runs, "
            "and `ptp.domain`"
        )


def read_ptp(config: PtpConfig) -> PtpStatus:
    """The state of the clock, once.

    Raises:
        PtpError: ptp4l does not answer.
    """
    with contextlib.closing(PtpSocket(config.socket, config.domain)) as connection:
        return connection.read()


@dataclass(frozen=True)
class ClockState:
    """What is known of this computer's clock at an instant."""

    ptp_state: PtpState
    sigma_ns: float  # one sigma of UTC; NaN: not known


FREE_RUNNING = ClockState(PtpState.UNKNOWN, 0.0)
"""No PTP: times are those of the system clock by definition, and provenance says so."""


class PtpWatch(Worker):
    """Asks ptp4l four times a second, and at each event that it tells of. A Companion of a recording."""

    def __init__(self, config: PtpConfig, clock: Clock) -> None:
        super().__init__("ptp")
        self._config = config
        self._clock = clock
        self._judge = PtpJudge(config)
        self._gates = Gates(clock)
        self._put: Put | None = None
        self._connection: PtpSocket | None = None
        self._subscribed_s = -float("inf")
        self._logged: tuple[object, ...] = ()
        self._logged_s = -float("inf")
        self._asked = self._unanswered = 0
        self._mutex = threading.Lock()
        self._last: Judgement | None = None

    def start(self, put: Put | None = None) -> None:
        """Begin to watch, and to log where ``put`` is given."""
        self._put = put
        if put is not None:
            self._gates.start(put)
        self.step()  # so that the first frame has a state
        super().start()

    def statuses(self) -> list[Diagnostic]:
        """The clock's state, and each gate that fails."""
        if self.error is not None:
            return [Diagnostic(2, "ptp", f"the watch has failed: {self.error!r}")]
        judged = self._last
        if judged is None:
            return []
        values = tuple((key, str(value)) for key, value in judged.figures().items())
        failing = self._gates.statuses()
        message = failing[0].message if failing else judged.said
        return [Diagnostic(2 if failing else 0, "ptp", message, values), *failing]

    def figures(self) -> dict[str, Any]:
        """What ptp4l said last, by name."""
        return self._last.figures() if self._last else {}

    @property
    def failing(self) -> dict[str, str]:
        """Cause by name of each gate that fails now."""
        return self._gates.failing

    def now(self) -> ClockState:
        """State and uncertainty of the clock at this moment. From any thread; cheap."""
        judged = self._last
        if judged is None:
            return ClockState(PtpState.UNKNOWN, float("nan"))
        return ClockState(judged.port_state, judged.sigma_ns(self._clock.monotonic_s()))

    def work(self) -> None:
        """Watch until asked to stop."""
        while not self.stop_requested.is_set():
            self._wait()
            self.step()

    def stop(self, deadline_s: float = 2.0) -> bool:
        """End the watch; no message after this returns."""
        ended = super().stop(deadline_s)
        self._gates.stop()
        with self._mutex:
            self._put = None
            self._disconnect()
        return ended

    def account(self) -> dict[str, str]:
        """How often ptp4l was asked, and how often it did not answer."""
        return {"ptp_asked": str(self._asked), "ptp_unanswered": str(self._unanswered)}

    def step(self) -> None:
        """Ask once, judge, log."""
        with self._mutex:
            status, why = self._read()
            self._asked += 1
            self._unanswered += status is None
            judged = self._judge.feed(status, why, self._read_phc_ns(status), self._clock.monotonic_s())
            self._last = judged
            for name, cause in judged.causes.items():
                self._gates.judge(name, cause)
            self._log(judged)

    def _wait(self) -> None:
        connection = self._connection
        if connection is None:
            self.stop_requested.wait(POLL_S)
        elif select.select([connection], [], [], POLL_S)[0]:
            connection.drain()

    def _read(self) -> tuple[PtpStatus | None, str]:
        try:
            if self._connection is None:
                self._connection = PtpSocket(self._config.socket, self._config.domain)
                self._subscribed_s = -float("inf")
            if self._clock.monotonic_s() - self._subscribed_s > SUBSCRIBED_S / 3:
                self._connection.subscribe()  # where it is refused, asking is enough
                self._subscribed_s = self._clock.monotonic_s()
            return self._connection.read(), ""
        except PtpError as error:
            self._disconnect()  # a ptp4l that was started anew has another socket at the same path
            return None, str(error)

    def _read_phc_ns(self, status: PtpStatus | None) -> int | None:
        """Network card's clock minus system clock, both as UTC."""
        if self._config.phc is None or status is None:
            return None
        offset_ns = read_phc_offset_ns(self._config.phc)
        ahead_s = status.utc_offset_s if status.ptp_timescale else 0  # a PTP clock runs on TAI
        return None if offset_ns is None else offset_ns - ahead_s * 10**9

    def _disconnect(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def _log(self, judged: Judgement) -> None:
        status = judged.status
        seen = (status.ingress_ns if status else None, judged.port_state, tuple(judged.causes.items()))
        now_s = self._clock.monotonic_s()
        if self._put is None or (seen == self._logged and now_s - self._logged_s < LOG_S):
            return
        self._logged, self._logged_s = seen, now_s
        now_ns = self._clock.utc_ns()
        self._put(PTP_TOPIC, now_ns, ptp_message(now_ns, judged, now_s).encode())


def ptp_message(now_ns: int, judged: Judgement, now_s: float) -> Ptp:
    """The message of ``/ptp``."""
    status, phc = judged.status, judged.phc_offset_ns
    sigma_ns = judged.sigma_ns(now_s)
    return Ptp(
        time_ns=now_ns,
        offset_ns=status.offset_ns if status else 0,
        path_delay_ns=status.path_delay_ns if status else 0,
        sync_time_ns=status.ingress_ns if status else 0,
        phc_offset_ns=phc or 0,
        time_sigma_ns=-1 if sigma_ns != sigma_ns else round(sigma_ns),
        utc_offset_s=status.utc_offset_s if status else 0,
        steps_removed=status.steps_removed if status else 0,
        port_state=judged.port_state,
        answers=status is not None,
        sync_fresh=judged.sync_fresh,
        utc_offset_valid=bool(status and status.utc_offset_valid),
        gm_present=bool(status and status.gm_present),
        gm_clock_class=status.gm_clock_class if status else 0,
        phc_valid=phc is not None,
        grandmaster=identity_text(status.gm_identity) if status else "",
        clock=identity_text(status.clock_identity) if status else "",
    )
