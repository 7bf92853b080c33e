"""The recording daemon: cameras, trigger board and disks wired together, from start to a closed flight."""

import contextlib
import datetime
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from capture.analog import AnalogLog
from capture.aux_log import AuxLog, Companion
from capture.burst import give_burst, judge_burst
from capture.camera.base import Camera, CameraDescription
from capture.camera_place import camera_at, expected_at, open_at
from capture.clock import Clock
from capture.companions import defect_booked
from capture.config import Config, LoadedConfig, driver_buffers
from capture.disk import Disk
from capture.errors import CameraError, DiskError
from capture.flight import free_name, make_folder, metadata_yaml
from capture.gates import Gates, judge_cameras, judge_clock
from capture.grabber import STOP_DEADLINE_S, Absence, Grabber
from capture.health_writer import HealthWriter
from capture.lane import Lane, LaneParts, check_ring_memory, make_lane
from capture.ledger import CameraAccount, Ledger, Place
from capture.provenance import describe_cameras, describe_config, describe_host, describe_time
from capture.ptp import FREE_RUNNING, PtpWatch
from capture.record import SIDES, Diagnostic
from capture.recorder import Recorder
from capture.service import Service
from capture.start_signal import StartSignal
from capture.stop_rule import StopRule
from capture.trigger import BoardCount, TriggerLog
from capture.trigger_run import TriggerRun
from capture.vitals import ARMED, Vitals
from capture.watchdog import IDLE, progress
from capture.worker import Worker, share_interpreter

CONTROL_PERIOD_S = 0.1
DIAGNOSTICS_PERIOD_S = 1.0
DRAIN_DEADLINE_S = 2.0  # how long frames of the last triggers may take to arrive
FLUSH_DEADLINE_S = 60.0  # how long the disks may take to write what is in the rings


@dataclass
class RecordingResult:
    """What ``record`` did."""

    flight: str
    folders: list[Path]
    triggers: int
    accounts: dict[Place, CameraAccount]
    write_modes: dict[str, str]
    ring_high_water: dict[Place, int]
    ring_slots: int
    ring_locked: bool
    seconds: float
    discarded: dict[Place, int]  # frames that were nobody's: duplicates, and some that no trigger asked for
    garbled_lines: int  # of the board
    aux_dropped: int  # small messages that one of the disks did not take
    absences: dict[Place, list[Absence]] = field(default_factory=dict)  # of cameras that were gone for a time
    failures: list[str] = field(default_factory=list)
    again: bool = False  # what began it has ended it; the next one waits for it

    @property
    def recorded(self) -> int:
        """Frames in the files."""
        return sum(account.recorded for account in self.accounts.values())

    @property
    def lost(self) -> int:
        """Frames that are booked as lost."""
        return sum(account.lost_total for account in self.accounts.values())

    def as_dict(self) -> dict[str, Any]:
        """For ``--json``."""
        return {
            "flight": self.flight,
            "folders": [str(folder) for folder in self.folders],
            "triggers": self.triggers,
            "frames_recorded": self.recorded,
            "frames_lost": self.lost,
            "cameras": {
                "/".join(place): {"recorded": account.recorded, "lost": account.lost}
                for place, account in self.accounts.items()
            },
            "write_modes": self.write_modes,
            "ring_slots": self.ring_slots,
            "ring_locked": self.ring_locked,
            "ring_high_water": {"/".join(place): n for place, n in self.ring_high_water.items()},
            "frames_discarded": {"/".join(place): n for place, n in self.discarded.items()},
            "board_lines_garbled": self.garbled_lines,
            "aux_messages_dropped": self.aux_dropped,
            "seconds": self.seconds,
            "absences": {"/".join(place): [asdict(a) for a in found] for place, found in self.absences.items()},
            "failures": self.failures,
        }


class Recording:
    """One flight being recorded. Owns every thread and device; ``run`` leaves all of them closed."""

    def __init__(
        self,
        loaded: LoadedConfig,
        clock: Clock,
        disk: Disk,
        progress: Callable[[str], None],
        companions: Sequence[Companion] = (),
        health: HealthWriter | None = None,
        service: Service | None = None,
        signal: StartSignal | None = None,
    ) -> None:
        self._disk = disk
        self._signal = signal
        self._loaded = loaded
        self._config: Config = loaded.config
        self._clock = clock
        self._progress = progress
        self._unattended = service is not None and service.managed
        started = datetime.datetime.fromtimestamp(clock.utc_ns() / 1e9, datetime.UTC)
        self.flight = self._config.flight or f"flight_{started:%Y%m%dT%H%M%SZ}"
        if self._config.flight is None or self._unattended or self._config.start.disarm_ends_after_s is not None:
            self.flight = free_name(self.flight, (self._config.disks.left, self._config.disks.right))
        self._aux = AuxLog(clock)
        self._triggers = TriggerLog(self._config.trigger.rate_hz)
        self._cameras: dict[Place, tuple[Camera, CameraDescription]] = {}
        self._lanes: dict[str, Lane] = {}
        ptp = self._config.ptp
        self._ptp = PtpWatch(ptp, clock) if ptp is not None and ptp.role != "none" else None
        self._analog = AnalogLog(self._config.analog, clock) if self._config.analog is not None else None
        self._gates = Gates(clock)
        own = [companion for companion in (self._ptp, self._analog) if companion is not None]
        self._companions = (*own, *companions, self._gates)
        self._service = service
        self._missing: dict[Place, CameraError] = {}  # cameras that were not there at the start
        self._failures: list[str] = []
        self._flight_id = f"{self.flight}-{clock.utc_ns():x}"
        places = [(camera.side, camera.name) for camera in self._config.cameras]
        self._ledger = Ledger(places, self._config.trigger.first_index, clock.utc_ns, self._aux.loss)
        self._vitals = Vitals(self.flight, self._config, self._ledger, clock, self._companions, self._failures)
        self._health = health

    def run(self, stop: StopRule) -> RecordingResult:
        """Record until told to stop, then account for everything and close.

        Raises:
            CaptureError: something needed at the start is not there: a camera, the board, a disk. What goes wrong
                later ends only the side it concerns and stands in the result's ``failures``.
        """
        share_interpreter()
        with contextlib.ExitStack() as cleanup:
            cleanup.enter_context(self._watched())
            if self._config.exposure_warning is not None:
                self._progress(self._config.exposure_warning)
            self._open_cameras(cleanup)
            run = self._make_run()
            cleanup.callback(run.board.close)
            run.board.placement = self._config.threads.control
            self._make_lanes(run.open())
            self._show_frames()
            self._step()
            started_s = self._clock.monotonic_s()
            try:
                for lane in self._lanes.values():
                    lane.start_writing()
                for companion in self._companions:
                    with defect_booked(companion, self._failures):
                        companion.start(self._aux.put)
                if self._analog is not None:
                    self._analog.begin(run.board)
                if self._may_begin(run, stop):
                    for lane in self._lanes.values():
                        lane.start()
                    started_s = self._clock.monotonic_s()
                    run.begin(stop.triggers)
                    self._vitals.begin(self._lanes)
                    self._control(run, stop, started_s)
            except Exception as error:  # whatever it is: what was recorded is closed and accounted for
                self._failures.append(f"{type(error).__name__}: {error}")
            self._vitals.state = "stopping"
            count = run.end()
            self._failures += [run.trouble] if run.trouble else []
            for companion in self._companions:
                with defect_booked(companion, self._failures):
                    companion.stop()
            seconds = self._clock.monotonic_s() - started_s
            return self._finish(count, seconds, run)

    @property
    def state(self) -> str:
        """``starting``, ``armed``, ``test burst``, ``recording``, ``stopping`` or ``ended``."""
        return self._vitals.state

    def _may_begin(self, run: TriggerRun, stop: StopRule) -> bool:
        """Wait, armed, for what starts the recording, and try the triggers; False: told to stop before."""
        start = self._config.start
        self._vitals.state = ARMED
        while not (run.in_flight or stop.begin.is_set() or self._is_told(run)):
            if stop.requested.wait(CONTROL_PERIOD_S):
                return False
            self._flush_aux()
            if self._service is not None:
                self._service.look(IDLE)
        if start.burst and not run.in_flight:
            self._vitals.state = "test burst"
            rate_hz = self._config.trigger.rate_hz
            there = {place: camera for place, camera in self._cameras.items() if place not in self._missing}
            judge_burst(
                self._gates,
                lambda: give_burst(there, run.board, run.strays, start.burst, rate_hz, self._clock),
                list(there),
                self._config.camera.time_sigma_limit_us,
            )
        return not stop.requested.is_set()

    def _is_told(self, run: TriggerRun) -> bool:
        if self._signal is not None:
            return self._signal.begun
        return self._config.start.on != "first-trigger" or bool(run.strays)

    def _make_run(self) -> TriggerRun:
        return TriggerRun(
            self._config.trigger,
            self._clock,
            self._triggers,
            self._ledger,
            self._aux,
            self._gates,
            on_sample=self._analog.take if self._analog else None,
            on_restart=self._analog.begin if self._analog else None,
        )

    @contextlib.contextmanager
    def _watched(self) -> Iterator[None]:
        """Share the health of all that is done within."""
        if self._health is None:
            yield
            return
        self._health.source = self._vitals.snapshot
        try:
            yield
        except Exception as error:
            self._failures.append(str(error))
            raise
        finally:
            self._vitals.state = "ended"
            self._health.hide()

    def _show_frames(self) -> None:
        previews = self._health.show(self._cameras) if self._health is not None else None
        if previews is not None:
            for recorder in self._recorders.values():
                recorder.tap = previews.offer

    @property
    def _grabbers(self) -> dict[Place, Grabber]:
        return {(lane.side, name): g for lane in self._lanes.values() for name, g in lane.grabbers.items()}

    @property
    def _recorders(self) -> dict[str, Recorder]:
        return {side: lane.recorder for side, lane in self._lanes.items()}

    def _open_cameras(self, cleanup: contextlib.ExitStack) -> None:
        """Open them. Without a person there, one that is missing is looked for during the recording instead."""
        for place in self._config.cameras:
            camera = camera_at(self._config, place)
            cleanup.callback(camera.close)
            try:
                description = open_at(camera, self._config, place)
            except CameraError as error:
                if not self._unattended:
                    raise
                camera.close()
                self._progress(f"{error}; the recording begins without it, and looks for it")
                self._missing[place.side, place.name] = error
                description = expected_at(self._config, place)
            self._cameras[place.side, place.name] = (camera, description)
            self._step()
        if len(self._missing) == len(self._cameras):
            raise next(iter(self._missing.values()))

    def _make_folders(self) -> dict[str, Path]:
        """The flight's folder on each side's disk. Without a person there, a side whose disk is dead is left out."""
        folders = {}
        dead: list[DiskError] = []
        for side in [side for side in SIDES if any(place[0] == side for place in self._cameras)]:
            try:
                folders[side] = make_folder(self._disk, getattr(self._config.disks, side), self.flight, side)
            except DiskError as error:
                if not self._unattended:
                    raise
                dead.append(error)
                self._gates.judge(f"disk {side}", f"{error}; its cameras are left out")
                for place in [place for place in self._cameras if place[0] == side]:
                    self._cameras.pop(place)[0].close()
                    self._ledger.leave_out(place)
        if not folders:
            raise dead[0]
        self._failures += map(str, dead)
        return folders

    def _make_lanes(self, board_name: str) -> None:
        folders = self._make_folders()
        parts = LaneParts(
            disk=self._disk,
            disk_config=self._config.disks,
            provenance=self._provenance(board_name),
            ledger=self._ledger,
            triggers=self._triggers,
            clock=self._clock,
            ring_slots=self._config.ring_slots,
            driver_buffers=driver_buffers(self._config.trigger.rate_hz),
            lock_memory=self._config.ring.lock_memory,
            threads=self._config.threads,
            calibration=self._calibration(),
            clock_state=self._ptp.now if self._ptp else lambda: FREE_RUNNING,
            trigger_latency_ns=round(self._config.camera.trigger_latency_us * 1e3),
            judge=self._gates.judge,
        )
        camera = self._config.camera
        check_ring_memory(len(self._cameras), self._config.ring_slots, camera.width, camera.height)
        for side in folders:
            cameras = {name: camera for (camera_side, name), camera in self._cameras.items() if camera_side == side}
            other = next((folder for s, folder in folders.items() if s != side), None)
            spare = (self._disk, other) if self._config.disks.takeover and other is not None else None
            self._lanes[side] = make_lane(side, folders[side], cameras, parts, spare)
        for place, error in self._missing.items():
            if place in self._cameras:
                self._grabbers[place].begin_absent(error)
        rings = [grabber.ring for grabber in self._grabbers.values()]
        total_mb = sum(ring.slots * ring.slot_bytes for ring in rings) / 1e6
        locked = all(ring.locked for ring in rings)
        self._progress(
            f"ring: {self._config.ring_slots} slots a camera, {total_mb:.0f} MB in all, "
            f"{'locked in memory' if locked else 'not locked in memory (RLIMIT_MEMLOCK)'}: "
            f"bridges a disk stall of {self._config.ring.stall_s:g} s"
        )

    def _provenance(self, board_name: str) -> dict[str, str]:
        descriptions = {"/".join(place): description for place, (_, description) in self._cameras.items()}
        return {
            "flight": self.flight,
            "flight_id": self._flight_id,
            **describe_host(),
            **describe_config(self._loaded),
            "trigger_board": board_name,
            **describe_cameras(descriptions),
            **describe_time(self._config.ptp),
        }

    def _calibration(self) -> tuple[str, bytes] | None:
        path, content = self._config.calibration, self._loaded.calibration
        return None if path is None or content is None else (path.name, content)

    def _control(self, run: TriggerRun, stop: StopRule, started_s: float) -> None:
        next_report_s = started_s + DIAGNOSTICS_PERIOD_S
        self._place_threads()
        while not stop.requested.wait(CONTROL_PERIOD_S):
            now_s = self._clock.monotonic_s()
            self._flush_aux()
            self._look()
            if now_s >= next_report_s:
                next_report_s += DIAGNOSTICS_PERIOD_S
                self._report()
            if stop.reached(self._triggers_so_far(), now_s - started_s):
                return
            if self._signal is not None and self._signal.ended:
                return
            over = run.watch()
            if over is not None:
                self._failures += [over] if over else []
                return
            if all(recorder.failure is not None for recorder in self._recorders.values()):
                return
            if not any(grabber.running for grabber in self._grabbers.values()):
                return

    def _finish(self, count: BoardCount | None, seconds: float, run: TriggerRun) -> RecordingResult:
        next_index = count.next_index if count else self._ledger.next_index
        self._ledger.triggered(next_index)
        deadline_s = self._clock.monotonic_s() + DRAIN_DEADLINE_S
        while self._clock.monotonic_s() < deadline_s and not all(
            self._ledger.complete(place, next_index) or not grabber.present for place, grabber in self._grabbers.items()
        ):
            self._clock.sleep(0.005)
        for place, grabber in self._grabbers.items():
            if not self._end(grabber, STOP_DEADLINE_S):
                self._failures.append(f"{'/'.join(place)}: its read thread hangs in the camera driver")
            if grabber.error is not None:
                self._failures.append(str(grabber.error))
        next_index = next_index if count else self._ledger.next_index
        self._ledger.close(next_index)
        self._report()
        self._flush_aux()
        for side, recorder in self._recorders.items():
            if not self._end(recorder, FLUSH_DEADLINE_S):
                self._failures.append(f"{side}: the disk did not take its last frames in {FLUSH_DEADLINE_S:g} s")
            if recorder.error is not None:
                self._failures.append(f"{recorder.name}: {recorder.error}")
        self._ledger.settle("the write thread ended before it came to this frame")
        end = {**run.account(count), "aux_dropped": json.dumps(self._aux.dropped)}
        for companion in self._companions:
            with defect_booked(companion, self._failures):
                end |= companion.account()
        last = self._aux.take()  # booked while the write threads ended
        for recorder in self._recorders.values():
            if recorder.running:  # hung in a write: its files stay as they are, for `wingcap recover`
                continue
            recorder.close(last, end)
            if recorder.moved is not None:
                self._failures.append(f"{recorder.moved}; {recorder.side} went on in {recorder.folder}")
            if recorder.failure is not None:
                self._failures.append(str(recorder.failure))
        for place, account in self._ledger.accounts().items():
            if not account.balanced:
                self._failures.append(f"{'/'.join(place)}: the books do not balance: {account}")
        self._write_metadata()
        return self._result(next_index - self._config.trigger.first_index, seconds, run.board.garbled_lines)

    def _step(self) -> None:
        if self._service is not None:
            self._service.step()

    def _look(self) -> None:
        if self._service is not None:
            self._service.look(progress(self._ledger.accounts(), self._lanes.values()))

    def _end(self, worker: Worker, deadline_s: float) -> bool:
        """Ask a thread to end and wait. Bounded by itself, so the service's watchdog rests."""
        until_s = self._clock.monotonic_s() + deadline_s
        while not worker.stop(CONTROL_PERIOD_S):
            if self._service is not None:
                self._service.look(IDLE)
            if self._clock.monotonic_s() > until_s:
                return False
        return True

    def _place_threads(self) -> None:
        """Take the control thread's placement, last of all, and say which thread could not have its own."""
        refused = {worker.misplaced for worker in (*self._grabbers.values(), *self._recorders.values())}
        refused.add(self._config.threads.control.take())
        for problem in refused - {None}:
            self._progress(f"threads: {problem}")

    def _write_metadata(self) -> None:
        writers = [writer for r in self._recorders.values() for writer in (*r.segments, r.aux)]
        for folder in {writer.path.parent for writer in writers}:
            here = [writer for writer in writers if writer.path.parent == folder]
            with contextlib.suppress(OSError):  # a disk that has failed; its files are readable without
                self._disk.write_text(folder / "metadata.yaml", metadata_yaml(here))

    def _result(self, triggers: int, seconds: float, garbled_lines: int) -> RecordingResult:
        return RecordingResult(
            flight=self.flight,
            folders=[recorder.aux.path.parent for recorder in self._recorders.values()],
            triggers=triggers,
            accounts=self._ledger.accounts(),
            write_modes={side: recorder.write_mode for side, recorder in self._recorders.items()},
            ring_high_water={place: grabber.ring.high_water for place, grabber in self._grabbers.items()},
            ring_slots=self._config.ring_slots,
            ring_locked=all(grabber.ring.locked for grabber in self._grabbers.values()),
            seconds=seconds,
            discarded={place: grabber.discarded for place, grabber in self._grabbers.items()},
            garbled_lines=garbled_lines,
            aux_dropped=sum(recorder.aux_dropped for recorder in self._recorders.values()),
            absences={place: grabber.absences for place, grabber in self._grabbers.items() if grabber.absences},
            failures=self._failures,
            again=self._signal is not None and self._signal.ended,
        )

    def _triggers_so_far(self) -> int:
        return next(iter(self._ledger.accounts().values())).triggers

    def _flush_aux(self) -> None:
        messages = self._aux.take()
        if messages:
            for recorder in self._recorders.values():
                recorder.put_aux(messages)

    def _report(self) -> None:
        judge_clock(self._gates, self._clock)
        clocks = {"/".join(place): grabber.clock for place, grabber in self._grabbers.items()}
        judge_cameras(self._gates, clocks, self._config.camera.time_sigma_limit_us, 1e6 / self._config.trigger.rate_hz)
        health = self._vitals.snapshot()
        statuses = tuple(Diagnostic(n.level, n.name, n.message, tuple(n.values.items())) for n in health.diagnostics)
        self._aux.diagnostics(statuses)
        recorded = sum(camera.recorded for camera in health.cameras)
        lost = sum(camera.lost_total for camera in health.cameras)
        depth = max((camera.ring_in_use for camera in health.cameras), default=0)
        if self._service is not None and self.state != "stopping":  # whose statuses are no news
            self._service.statuses(statuses)
        totals = self._progress if self._service is None else self._service.totals
        totals(
            f"triggers {self._triggers_so_far()}  recorded {recorded}  lost {lost}  "
            f"ring {depth}/{self._config.ring_slots}"
        )
