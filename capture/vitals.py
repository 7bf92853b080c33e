"""The parts of a recording at work, to diagnostics and a health snapshot: what is wrong, where, and what to do.

Everything here is read from counters; nothing waits for a device, a disk or a thread. What each notice means for the
crew is in docs/reference/health.md.
"""

import contextlib
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from capture.clock import Clock
from capture.config import Config
from capture.grabber import Grabber
from capture.health import ERROR, OK, WARNING, CameraHealth, DiskHealth, Health, Notice
from capture.lane import Lane
from capture.ledger import CameraAccount, Ledger, Place
from capture.record import Diagnostic, LossStage
from capture.recorder import Recorder

WINDOW_S = 10.0  # losses are judged over this
RATE_WINDOW_S = 2.0
SILENT_S = 1.0  # a part that has given nothing for so long, while it should have, is silent
HUNG_DISK_S = 2.0
HUNG_DRIVER_S = 2.0
LOSING_SHARE = 0.01  # of a camera's triggers within the window
RING_BEHIND_SHARE = 0.5
MINUTES_LOW, MINUTES_LEAST = 10.0, 2.0
IDLE, ARMED = "idle", "armed"
RUNNING = (ARMED, "test burst", "recording")
_AFTER_ARRIVAL = tuple(stage.name.lower() for stage in (LossStage.RING, LossStage.WRITER, LossStage.DISK))


class Reporter(Protocol):
    """A companion, as far as it concerns us."""

    def statuses(self) -> list[Diagnostic]:
        """How it is doing. Must not block."""


@dataclass(frozen=True)
class _Sample:
    """Counts at one instant."""

    at_s: float
    triggers: int
    arrived: Mapping[Place, int]
    lost: Mapping[Place, int]
    written: Mapping[str, int]

    @property
    def counts(self) -> dict[object, int]:
        """What rises while all is well."""
        return dict([("triggers", self.triggers), *self.arrived.items(), *self.written.items()])


def idle_health() -> Health:
    """Of a recorder that waits to be told to record."""
    notice = Notice(ERROR, "recorder", f"not recording, {IDLE}: `wingcap start` begins")
    return Health("", IDLE, 0.0, 0, 0.0, (), (), (notice,))


class Vitals:
    """Watches one recording. Thread-safe."""

    def __init__(
        self,
        flight: str,
        config: Config,
        ledger: Ledger,
        clock: Clock,
        companions: Sequence[Reporter] = (),
        failures: Sequence[str] = (),
    ) -> None:
        self.state = "starting"
        self._flight = flight
        self._config = config
        self._ledger = ledger
        self._clock = clock
        self._companions = companions
        self._failures = failures
        self._lanes: Mapping[str, Lane] = {}
        self._samples: deque[_Sample] = deque()
        self._changed: dict[object, tuple[float, int]] = {}  # when a count last rose, and the triggers by then
        self._started_s: float | None = None
        self._devices: dict[Path, int] = {}  # file systems of the disks
        self._mutex = threading.Lock()

    def begin(self, lanes: Mapping[str, Lane]) -> None:
        """The lanes are made and the triggers begin."""
        disks = {lane.recorder.folder.parent for lane in lanes.values()}
        with contextlib.suppress(OSError):  # of a disk that is gone already
            self._devices = {disk: disk.stat().st_dev for disk in disks}
        with self._mutex:
            self._lanes = lanes
            self._started_s = self._clock.monotonic_s()
        self.state = "recording"

    def snapshot(self) -> Health:
        """How everything is now."""
        with self._mutex:
            accounts = self._ledger.accounts()
            sample = self._sample(accounts)
            cameras = [self._camera(place, grabber, accounts[place], sample) for place, grabber in self._grabbers()]
            disks = [self._disk(lane.recorder, sample) for lane in self._lanes.values()]
            notices = [self._recorder_notice(), self._board_notice(sample)]
            notices += [notice for _, notice in (*cameras, *disks)]
            for companion in self._companions:
                notices += _notices_of(companion)
            started_s = sample.at_s if self._started_s is None else self._started_s
            return Health(
                flight=self._flight,
                state=self.state,
                recording_s=sample.at_s - started_s,
                triggers=sample.triggers,
                trigger_rate_hz=self._rate_hz(lambda sample: sample.triggers),
                cameras=tuple(camera for camera, _ in cameras),
                disks=tuple(disk for disk, _ in disks),
                diagnostics=tuple(notices),
                failures=tuple(self._failures),
            )

    def _grabbers(self) -> list[tuple[Place, Grabber]]:
        return [((lane.side, name), g) for lane in self._lanes.values() for name, g in lane.grabbers.items()]

    def _sample(self, accounts: Mapping[Place, CameraAccount]) -> _Sample:
        sample = _Sample(
            self._clock.monotonic_s(),
            max(account.triggers for account in accounts.values()),
            {place: _arrived(account) for place, account in accounts.items()},
            {place: account.lost_total for place, account in accounts.items()},
            {side: lane.recorder.statistics.frames for side, lane in self._lanes.items()},
        )
        if self._lanes:
            self._note_changes(sample)
        self._samples.append(sample)
        while sample.at_s - self._samples[0].at_s > WINDOW_S:
            self._samples.popleft()
        return sample

    def _note_changes(self, sample: _Sample) -> None:
        last = self._samples[-1] if self._samples else None
        before = {} if last is None else last.counts
        for key, count in sample.counts.items():
            if key not in self._changed or count != before.get(key):
                self._changed[key] = (sample.at_s, sample.triggers)

    def _rate_hz(self, count: Callable[[_Sample], int]) -> float:
        last = self._samples[-1]
        first = next(sample for sample in self._samples if last.at_s - sample.at_s <= RATE_WINDOW_S)
        seconds = last.at_s - first.at_s
        return round((count(last) - count(first)) / seconds, 2) if seconds > 0.0 else 0.0

    def _recorder_notice(self) -> Notice:
        failure = "; ".join(self._failures[-1:])
        if self.state not in RUNNING:
            return Notice(ERROR, "recorder", f"not recording, {self.state}" + (f": {failure}" if failure else ""))
        if failure:
            return Notice(ERROR, "recorder", failure)
        return Notice(OK, "recorder", self.state)

    def _board_notice(self, sample: _Sample) -> Notice:
        values = {"triggers": str(sample.triggers)}
        if self.state != "recording":
            return Notice(OK, "trigger board", self.state, values)
        silent_s = sample.at_s - self._changed["triggers"][0]
        if silent_s > max(SILENT_S, 3.0 / self._config.trigger.rate_hz):
            message = f"no trigger reported for {silent_s:.1f} s: check the board's power and its serial cable"
            return Notice(ERROR, "trigger board", message, values)
        return Notice(OK, "trigger board", "triggering", values)

    def _camera(
        self, place: Place, grabber: Grabber, account: CameraAccount, sample: _Sample
    ) -> tuple[CameraHealth, Notice]:
        changed_s, triggers_then = self._changed[place]
        health = CameraHealth(
            side=place[0],
            name=place[1],
            recorded=account.recorded,
            lost=dict(account.lost),
            rate_hz=self._rate_hz(lambda sample: sample.arrived[place]),
            silent_s=round(sample.at_s - changed_s, 2) if sample.arrived[place] else None,
            ring_in_use=grabber.ring.in_use,
            ring_slots=grabber.ring.slots,
            ring_high_water=grabber.ring.high_water,
            exposure_us=self._config.camera.exposure_us,
            temperature_c=grabber.temperature_c,
        )
        level, message = self._judge_camera(health, grabber, sample, sample.triggers - triggers_then)
        values = {
            "recorded": str(health.recorded),
            "lost": str(health.lost_total),
            **{f"lost_{stage}": str(count) for stage, count in health.lost.items()},
            "rate_hz": str(health.rate_hz),
            "ring_in_use": str(health.ring_in_use),
            **{f"clock_{key}": str(value) for key, value in vars(grabber.clock).items()},
        }
        return health, Notice(level, health.place, message, values)

    def _judge_camera(
        self, health: CameraHealth, grabber: Grabber, sample: _Sample, unanswered: int
    ) -> tuple[int, str]:
        rate_hz = self._config.trigger.rate_hz
        if self.state != "recording":
            return OK, self.state
        if not grabber.running:
            return ERROR, str(grabber.error or "its read thread has ended").removeprefix(f"{health.place}: ")
        if grabber.is_absent:
            return ERROR, f"{grabber.absences[-1].cause}; looked for: {grabber.seek_error or 'not yet'}"
        if grabber.still_s > HUNG_DRIVER_S:
            return ERROR, f"the camera driver has not answered for {grabber.still_s:.0f} s: unplug and replug it"
        if unanswered > max(3.0, SILENT_S * rate_hz):
            return ERROR, f"no frame on the last {unanswered} triggers: check its cable and its power"
        place = grabber.place
        first = self._samples[0]
        lost = sample.lost[place] - first.lost[place]
        triggers = max(1, sample.triggers - first.triggers)
        if lost > LOSING_SHARE * triggers:
            return (
                ERROR,
                f"{lost} of the last {triggers} frames lost ({_stages(health.lost)} in all): see `wingcap info`",
            )
        if health.ring_in_use > RING_BEHIND_SHARE * health.ring_slots:
            return WARNING, f"the disk is behind: ring {health.ring_in_use} of {health.ring_slots}"
        if health.lost_total:
            return WARNING, f"recording; {health.lost_total} frames lost so far ({_stages(health.lost)})"
        return OK, "recording"

    def _disk(self, recorder: Recorder, sample: _Sample) -> tuple[DiskHealth, Notice]:
        failure = recorder.failure or recorder.moved
        free = recorder.statistics.free_bytes
        minutes = None
        rate = self._bytes_per_second(recorder)
        if free is not None and rate:
            room = max(0.0, free - self._config.disks.reserve_mb * 1e6)
            minutes = round(room / rate / 60.0, 1)
        health = DiskHealth(
            side=recorder.side,
            folder=str(recorder.folder),
            free_bytes=free,
            minutes_left=minutes,
            write_mode=recorder.write_mode,
            queued=recorder.queued,
            last_write_us=recorder.statistics.last_us,
            failure=None if failure is None else str(failure),
        )
        level, message = self._judge_disk(health, recorder, sample)
        values = {
            "queued": str(health.queued),
            "last_write_us": str(health.last_write_us),
            "minutes_left": "unknown" if minutes is None else str(minutes),
        }
        return health, Notice(level, f"disk {recorder.side}", message, values)

    def _judge_disk(self, health: DiskHealth, recorder: Recorder, sample: _Sample) -> tuple[int, str]:
        if health.failure is not None:
            return ERROR, health.failure + (f"; going on in {health.folder}" if recorder.failure is None else "")
        if self.state != "recording":
            return OK, self.state
        if not recorder.running:
            return ERROR, f"{health.folder}: {recorder.error or 'its write thread has ended'}"
        hung_s = sample.at_s - self._changed[recorder.side][0]
        if health.queued and hung_s > HUNG_DISK_S:
            return ERROR, f"{health.folder}: nothing was written for {hung_s:.1f} s: check the disk's connection"
        if health.minutes_left is not None and health.minutes_left < MINUTES_LOW:
            level = ERROR if health.minutes_left < MINUTES_LEAST else WARNING
            return level, f"{health.folder}: {health.minutes_left:g} minutes left: free space on this disk"
        return OK, health.write_mode

    def _bytes_per_second(self, recorder: Recorder) -> float:
        """What its disk is asked to take, by both sides where they share it; nothing after a failure."""

        def device(recorder: Recorder) -> object:
            return self._devices.get(recorder.folder.parent, recorder.folder.parent)

        here = [
            lane
            for lane in self._lanes.values()
            if device(lane.recorder) == device(recorder) and not lane.recorder.failure
        ]
        rings = [grabber.ring for lane in here for grabber in lane.grabbers.values()]
        return sum(ring.slot_bytes for ring in rings) * self._config.trigger.rate_hz


def _notices_of(companion: Reporter) -> list[Notice]:
    try:
        return [Notice(d.level, d.name, d.message, dict(d.values)) for d in companion.statuses()]
    except Exception as error:  # its defect must not end the recording
        return [Notice(ERROR, type(companion).__name__, f"cannot say how it is doing: {error!r}")]


def _arrived(account: CameraAccount) -> int:
    return account.recorded + account.pending + sum(account.lost.get(stage, 0) for stage in _AFTER_ARRIVAL)


def _stages(lost: Mapping[str, int]) -> str:
    return ", ".join(f"{count} at {stage}" for stage, count in lost.items())
