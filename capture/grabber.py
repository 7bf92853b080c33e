"""The read thread of one camera: filled buffers to numbered, sealed frames in the write queue."""

import dataclasses
import threading
from collections.abc import Callable
from dataclasses import dataclass

from capture.camera.base import Camera, CameraDescription, FrameStatus, Grab
from capture.clock import Clock
from capture.clock_fit import ClockFigures
from capture.config import DRIVER_BUFFERS
from capture.errors import CameraError, CameraLost
from capture.frame_clock import FrameClock
from capture.ledger import NOT_EXPOSED, Ledger, Place
from capture.numbering import FrameNumbering, Numbered, Triggers
from capture.ptp import FREE_RUNNING, ClockState
from capture.record import Frame, LossStage
from capture.recorder import FrameItem, Recorder
from capture.ring import Ring
from capture.segment import FrameLayout
from capture.worker import Worker

GRAB_TIMEOUT_S = 0.1
SEEK_PERIOD_S = 0.5
STOP_DEADLINE_S = 15.0  # how long a driver may take to let go: a network camera is asked several times
TEMPERATURE_PERIOD_S = 10.0


class SideGate:
    """Keeps stereo sets whole: the first camera of a side to get a trigger's frame decides for both.

    A set is let in when every ring of the side has a slot that is not promised yet; one is then promised to each
    camera. Otherwise both frames are lost at the ring. A promise ends when its camera takes the slot, or shows a later
    frame. Of a camera that is behind, no more promises count than its driver has buffers: more frames it cannot hold,
    so that one that is silent or gone (which never shows a later frame) leaves the other its room.
    """

    _REMEMBERED = 64

    def __init__(self, rings: list[Ring], driver_buffers: int = DRIVER_BUFFERS) -> None:
        self._rings = rings
        self._driver_buffers = driver_buffers
        self._promised: dict[int, set[int]] = {id(ring): set() for ring in rings}
        self._decisions: dict[int, bool] = {}
        self._mutex = threading.Lock()

    def take(self, index: int, ring: Ring) -> int | None:
        """A fresh slot of ``ring`` for the driver, in exchange for this trigger's frame; None: the frame is lost."""
        with self._mutex:
            promised = self._promised[id(ring)]
            promised -= {old for old in promised if old < index}  # in place: it is the ring's
            if index not in self._decisions:
                self._decide(index)
            if not self._decisions[index]:
                return None
            promised.discard(index)
            return ring.take()

    def _decide(self, index: int) -> None:
        room = all(ring.free > min(len(self._promised[id(ring)]), self._driver_buffers) for ring in self._rings)
        self._decisions[index] = room
        if room:
            for promised in self._promised.values():
                promised.add(index)
        while len(self._decisions) > self._REMEMBERED:
            forgotten = next(iter(self._decisions))
            del self._decisions[forgotten]
            for promised in self._promised.values():
                promised.discard(forgotten)


@dataclass(frozen=True, kw_only=True)
class ReadParts:
    """What all read threads of a recording share."""

    ledger: Ledger
    triggers: Triggers
    clock: Clock
    driver_buffers: int = DRIVER_BUFFERS
    clock_state: Callable[[], ClockState] = lambda: FREE_RUNNING  # of this computer, asked for each frame
    trigger_latency_ns: int = 0  # from a trigger to the start of row 0's exposure
    judge: Callable[[str, str | None], None] = lambda name, cause: None  # marks what is not in order: capture.gates


@dataclass(frozen=True)
class Absence:
    """A time for which a camera was gone."""

    begin_ns: int  # when that was noticed
    end_ns: int  # when it was armed again; 0: it is still gone
    cause: str


class Grabber(Worker):
    """Owns one camera from ``start`` on. Keeps the driver supplied with empty slots.

    A camera that goes is looked for once a ``SEEK_PERIOD_S`` until it is back or the recording ends. It comes back with
    another frame counter and another clock, so its frames are tied to triggers anew, by the board's times.
    """

    def __init__(
        self,
        place: Place,
        camera: Camera,
        description: CameraDescription,
        ring: Ring,
        layout: FrameLayout,
        gate: SideGate,
        recorder: Recorder,
        parts: ReadParts,
    ) -> None:
        super().__init__(f"read-{place[0]}-{place[1]}")
        self.place = place
        self.ring = ring
        self.discarded = 0  # duplicates, and frames that no trigger asked for
        self.absences: list[Absence] = []
        self.seek_error = ""  # why the last try to have the camera back failed
        self.temperature_c: float | None = None
        self._camera = camera
        self._driver_buffers = parts.driver_buffers
        self._description = description
        self._layout = layout
        self._gate = gate
        self._recorder = recorder
        self._parts = parts
        self._ledger = parts.ledger
        self._numbering, self._frame_clock = self._aligned(description)
        self._slots: set[int] = set()  # in the driver's hands, or kept for it while there is no camera
        self._not_exposed = NOT_EXPOSED  # why, up to the next frame
        self._last_index = -1
        self._refusal: CameraError | None = None  # of a buffer: told when the frames at hand are safe
        self._asked_s = -TEMPERATURE_PERIOD_S

    @property
    def clock(self) -> ClockFigures:
        """How well the camera's clock is known."""
        return self._frame_clock.figures

    def arm(self) -> None:
        """Give the driver its buffers and make the camera ready for triggers. Before ``start``."""
        while len(self._slots) < self._driver_buffers and (slot := self.ring.take()) is not None:
            self._slots.add(slot)
        for slot in sorted(self._slots):
            self._queue(slot)
        self._camera.arm()

    @property
    def present(self) -> bool:
        """Whether frames may still come."""
        return self.running and not self.is_absent

    @property
    def is_absent(self) -> bool:
        """Whether the camera is gone."""
        return bool(self.absences) and not self.absences[-1].end_ns

    def work(self) -> None:
        """Grab until asked to stop, and look for a camera that goes.

        Raises:
            CameraLost: the camera is gone at the end.
        """
        try:
            while not self.stop_requested.is_set():
                self.turn()
                if self.is_absent:
                    if not self.stop_requested.wait(SEEK_PERIOD_S):
                        self.seek()
                    continue
                try:
                    self.step(GRAB_TIMEOUT_S)
                    self._take_temperature()
                except CameraError as error:  # also one that is there, but whose driver will not go on
                    self.lose(error)
        finally:
            self.finish()
            self._camera.disarm()
        if self.is_absent:
            raise CameraLost(f"{'/'.join(self.place)}: {self.absences[-1].cause}")

    def begin_absent(self, error: CameraError) -> None:
        """The camera is not there from the beginning: it is looked for as one that goes. Instead of ``arm``."""
        self._go(f"{error}; it was not there at the start")

    def lose(self, error: CameraError) -> None:
        """The camera is gone: take what it had delivered; from here on its triggers are lost."""
        self._flush()
        last = f"its last frame was of trigger {self._last_index}" if self._last_index >= 0 else "it gave no frame"
        self._go(f"{error}; {last}")
        self._camera.disarm()
        self._camera.close()

    def _go(self, cause: str) -> None:
        self.absences.append(Absence(self._parts.clock.utc_ns(), 0, cause))
        self._parts.judge(self._gate_name, cause)
        self._ledger.absent(self.place, cause)
        self._refusal = None  # its cause is known

    def seek(self) -> bool:
        """Book the triggers that went by, and try once to have the camera back; whether it is."""
        absence = self.absences[-1]
        self._ledger.absent(self.place, absence.cause)
        try:
            self._recognise(self._camera.open())
            self._numbering, self._frame_clock = self._aligned(self._description, self._numbering.last)
            self._ledger.absent(self.place, absence.cause)
            self.arm()
        except CameraError as error:
            self._camera.disarm()
            self._camera.close()
            self.seek_error = str(error)
            return False
        self._not_exposed = absence.cause
        self.absences[-1] = dataclasses.replace(absence, end_ns=self._parts.clock.utc_ns())
        self._parts.judge(self._gate_name, None)
        return True

    def _recognise(self, found: CameraDescription) -> None:
        """See that this is the camera that belongs here. One that was not there at the start is known from now on."""
        known = self._description
        if known.serial and found.serial != known.serial:
            raise CameraError(f"serial {found.serial} answers, not {known.serial}: swap the cables")
        if not found.hardware_trigger:
            raise CameraError(f"{found.model} has no hardware trigger: it cannot be synchronised")
        if not known.model:
            self._description = dataclasses.replace(found, row_time_ns=known.row_time_ns or found.row_time_ns)

    def step(self, timeout_s: float) -> bool:
        """Take one frame on its way, when there is one within ``timeout_s``."""
        refusal, self._refusal = self._refusal, None
        if refusal is not None:
            raise refusal
        grab = self._camera.grab(timeout_s)
        if grab is None:
            return False
        self._slots.discard(grab.slot)
        for told, numbered in self._numbering.feed(grab):
            self._take(told, numbered)
        return True

    def finish(self) -> None:
        """No more frames will come: take those that waited to be numbered, and book what a camera that is gone lost."""
        self._flush()
        if self.is_absent:
            self._ledger.absent(self.place, self.absences[-1].cause)

    def _flush(self) -> None:
        for grab, numbered in self._numbering.flush():
            self._take(grab, numbered)

    def _take(self, grab: Grab, numbered: Numbered | None) -> None:
        if numbered is None or not self._ledger.arrived(
            self.place, numbered.index, numbered.lost_in_delivery, self._not_exposed
        ):
            self.discarded += 1
            self._requeue(grab.slot)
            return
        self._not_exposed, self._last_index = NOT_EXPOSED, numbered.index
        if grab.status is not FrameStatus.COMPLETE:
            why = f" ({grab.detail})" if grab.detail else ""
            self._lose(grab, numbered, LossStage.USB, f"the driver delivered an incomplete buffer{why}")
            return
        fresh = self._gate.take(numbered.index, self.ring)
        if fresh is None:
            self._lose(grab, numbered, LossStage.RING, "ring full: the disk is behind by more than ring.stall_s")
            return
        self._requeue(fresh)
        self._hand_over(grab, numbered)

    def _hand_over(self, grab: Grab, numbered: Numbered) -> None:
        row_time_ns = self._description.row_time_ns
        time = self._frame_clock.time_of(grab, numbered)
        frame = Frame(
            trigger_index=numbered.index,
            device_frame_id=grab.frame_id if grab.counter is None else grab.counter,
            device_ticks=grab.device_ticks,
            trigger_time_ns=time.trigger_ns,
            exposure_start_ns=time.exposure_start_ns,
            receive_time_ns=grab.receive_ns,
            time_sigma_ns=time.sigma_ns,
            exposure_us=grab.exposure_us,
            row_time_ns=row_time_ns,
            ring_depth=self.ring.in_use,
            previous_write_us=self._recorder.statistics.last_us,
            gain_db=grab.gain_db,
            ptp_state=time.ptp_state,
            status=grab.status,
        )
        middle_ns = frame.mid_exposure_ns + row_time_ns * (self._description.height - 1) // 2
        sealed = self._layout.seal(self.ring.slot(grab.slot), frame, middle_ns)
        self._recorder.put(FrameItem(self.place, numbered.index, self.ring, grab.slot, sealed))

    def _lose(self, grab: Grab, numbered: Numbered, stage: LossStage, cause: str) -> None:
        self._ledger.lost(self.place, numbered.index, stage, cause)
        self._requeue(grab.slot)

    def _aligned(
        self, description: CameraDescription, before: tuple[Grab, Numbered] | None = None
    ) -> tuple[FrameNumbering, FrameClock]:
        """A camera's counter and clock, of which nothing is known yet, or only what was its last frame ``before``."""
        parts = self._parts
        clock = FrameClock(description, parts.triggers, parts.clock_state, parts.trigger_latency_ns)
        return FrameNumbering(description, parts.triggers, parts.ledger.decided_below(self.place), before), clock

    @property
    def _gate_name(self) -> str:
        return f"camera {'/'.join(self.place)}"

    def _take_temperature(self) -> None:
        now_s = self._parts.clock.monotonic_s()
        if now_s - self._asked_s >= TEMPERATURE_PERIOD_S:
            self._asked_s = now_s
            self.temperature_c = self._camera.temperature_c()

    def _requeue(self, slot: int) -> None:
        try:
            self._queue(slot)
        except CameraError as error:
            self._refusal = error

    def _queue(self, slot: int) -> None:
        self._slots.add(slot)
        self._camera.queue(slot, self._layout.buffer(self.ring.slot(slot)))
