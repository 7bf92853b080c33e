"""What ptp4l says, in the order it says it, to what may be believed: gates and the clock's uncertainty. No I/O."""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from capture.config import PtpConfig
from capture.ptp_protocol import PtpStatus, identity_text
from capture.record import PtpState

HOLDOVER_PPM = 10.0  # how fast a clock that has lost its master is taken to run away
SETTLE_S = 2.0  # how long a new grandmaster must be followed within the limit before its change is over
OFFSETS_KEPT = 16
_FOLLOWING = {"slave": PtpState.SLAVE, "master": PtpState.MASTER}


@dataclass(frozen=True)
class Judgement:
    """What holds since the last question."""

    status: PtpStatus | None  # None: ptp4l does not answer
    causes: Mapping[str, str | None]  # of each gate; None: in order
    sync_fresh: bool
    phc_offset_ns: int | None
    good_s: float  # monotonic time when the clock was last known to follow
    good_sigma_ns: float  # its uncertainty then; NaN: never followed

    @property
    def port_state(self) -> PtpState:
        """UNKNOWN when ptp4l does not answer."""
        return self.status.port_state if self.status else PtpState.UNKNOWN

    @property
    def said(self) -> str:
        """One line."""
        if self.status is None:
            return "ptp4l does not answer"
        return (
            f"{self.port_state.name}, offset {self.status.offset_ns / 1e3:.1f} us, "
            f"path delay {self.status.path_delay_ns / 1e3:.1f} us, master {identity_text(self.status.gm_identity)}"
        )

    def sigma_ns(self, now_s: float) -> float:
        """One sigma of this computer's UTC, running away since the clock last followed; NaN: not known."""
        return math.hypot(self.good_sigma_ns, HOLDOVER_PPM * 1e3 * max(now_s - self.good_s, 0.0))

    def figures(self) -> dict[str, Any]:
        """For diagnostics and ``--json``."""
        if self.status is None:
            return {"answers": False}
        status = self.status
        return {
            "answers": True,
            "port_state": self.port_state.name,
            "offset_ns": status.offset_ns,
            "path_delay_ns": status.path_delay_ns,
            "sync_fresh": self.sync_fresh,
            "grandmaster": identity_text(status.gm_identity),
            "gm_present": status.gm_present,
            "gm_clock_class": status.gm_clock_class,
            "utc_offset_s": status.utc_offset_s,
            "utc_offset_valid": status.utc_offset_valid,
            "phc_offset_ns": self.phc_offset_ns,
        }


class PtpJudge:
    """Keeps what a single answer cannot tell: whether Syncs still come, and whether the master is another one."""

    def __init__(self, config: PtpConfig) -> None:
        self._config = config
        self._ingress_ns: int | None = None
        self._ingress_s = -math.inf  # when a new Sync was last seen
        self._offsets_ns: deque[int] = deque(maxlen=OFFSETS_KEPT)
        self._grandmaster: int | None = None
        self._change: str | None = None  # of the grandmaster, not over yet
        self._settled_s = -math.inf  # since when everything has been in order after it
        self._good_s, self._good_sigma_ns = 0.0, math.nan

    def feed(self, status: PtpStatus | None, why: str, phc_offset_ns: int | None, now_s: float) -> Judgement:
        """Take an answer; None is none, and ``why`` says the reason."""
        causes: dict[str, str | None] = {"ptp.answers": why if status is None else None}
        fresh = self._is_fresh(status, now_s)
        if status is not None:
            causes |= self._causes(status, fresh, phc_offset_ns)
            causes["ptp.grandmaster"] = self._changed_grandmaster(status, causes, now_s)
        follows = status is not None and fresh and status.port_state is _FOLLOWING.get(self._config.role)
        if follows:
            self._good_s = now_s
            self._good_sigma_ns = self._rms_ns(phc_offset_ns)
        return Judgement(status, causes, fresh, phc_offset_ns, self._good_s, self._good_sigma_ns)

    def _is_fresh(self, status: PtpStatus | None, now_s: float) -> bool:
        """Whether Syncs are coming: the offset alone says all is well long after the master is dead."""
        if self._config.role == "master":
            return status is not None
        if status is not None and status.ingress_ns != self._ingress_ns:
            first = self._ingress_ns is None and status.port_state is not PtpState.SLAVE
            self._ingress_ns = status.ingress_ns
            self._ingress_s = -math.inf if first else now_s  # an old one, of a master that was there before us
            if status.port_state is PtpState.SLAVE:
                self._offsets_ns.append(status.offset_ns)
        return now_s - self._ingress_s <= self._config.silence_s

    def _causes(self, status: PtpStatus, fresh: bool, phc_offset_ns: int | None) -> dict[str, str | None]:
        config = self._config
        wanted = _FOLLOWING.get(config.role, status.port_state)
        limit_ns = config.offset_limit_us * 1e3
        follows = status.port_state is wanted
        causes: dict[str, str | None] = {
            "ptp.state": None if follows else f"the port is {status.port_state.name}, not {wanted.name}",
            "ptp.utc": None
            if status.utc_offset_valid
            else f"the grandmaster does not vouch for its UTC offset (it says {status.utc_offset_s} s)",
        }
        if config.role == "slave":
            causes["ptp.sync"] = None if fresh else f"no Sync from the master for over {config.silence_s:g} s"
            causes["ptp.offset"] = (
                f"{status.offset_ns / 1e3:.1f} us off the master, more than {config.offset_limit_us:g} us"
                if abs(status.offset_ns) > limit_ns
                else None
            )
        if config.phc is not None:
            causes["ptp.phc"] = (
                f"{config.phc}: cannot be read: give this user the right to"
                if phc_offset_ns is None
                else f"system clock {-phc_offset_ns / 1e3:.1f} us off {config.phc}: check phc2sys"
                if abs(phc_offset_ns) > limit_ns
                else None
            )
        return causes

    def _changed_grandmaster(self, status: PtpStatus, causes: Mapping[str, str | None], now_s: float) -> str | None:
        """From the change until the new one has been followed in order for SETTLE_S."""
        if status.port_state is PtpState.SLAVE:
            before = self._grandmaster
            if before is not None and status.gm_identity != before:
                self._change = f"from {identity_text(before)} to {identity_text(status.gm_identity)}"
                self._settled_s = now_s
                self._offsets_ns.clear()
                self._offsets_ns.append(status.offset_ns)
            self._grandmaster = status.gm_identity
        if any(causes.get(name) for name in ("ptp.state", "ptp.sync", "ptp.offset")):
            self._settled_s = now_s
        if now_s - self._settled_s >= SETTLE_S:
            self._change = None
        return self._change

    def _rms_ns(self, phc_offset_ns: int | None) -> float:
        """How far the clock has been off its master of late; 0 for the master, who defines the time."""
        offsets = self._offsets_ns
        squares = sum(offset**2 for offset in offsets) / len(offsets) if offsets else 0.0
        return math.sqrt(squares + (phc_offset_ns or 0) ** 2)
