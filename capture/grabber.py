"""The read thread of one camera: filled buffers to numbered, sealed frames in the write queue."""

import threading

from capture.camera.base import Camera, CameraDescription, FrameStatus, Grab
from capture.clock_fit import ClockFigures
from capture.config import DRIVER_BUFFERS
from capture.errors import CameraLost
from capture.frame_clock import FrameClock
from capture.ledger import Ledger, Place
from capture.numbering import FrameNumbering, Numbered, Triggers
from capture.record import Frame, LossStage
from capture.recorder import FrameItem, Recorder
from capture.ring import Ring
from capture.segment import FrameLayout
from capture.worker import Worker

GRAB_TIMEOUT_S = 0.1


class SideGate:
    """Keeps stereo sets whole: the first camera of a side to get a trigger's frame decides for both.

    A set is let in when every ring of the side has a slot that is not promised yet; one is then promised to each
    camera. Otherwise both frames are lost at the ring. A promise ends when its camera takes the slot, shows a later
    frame, or can no longer have the frame: a driver holds no more than ``DRIVER_BUFFERS``.
    """

    _REMEMBERED = 64

    def __init__(self, rings: list[Ring]) -> None:
        self._rings = rings
        self._promised: dict[int, set[int]] = {id(ring): set() for ring in rings}
        self._decisions: dict[int, bool] = {}
        self._mutex = threading.Lock()

    def take(self, index: int, ring: Ring) -> int | None:
        """A fresh slot of ``ring`` for the driver, in exchange for this trigger's frame; None: the frame is lost."""
        with self._mutex:
            promised = self._promised[id(ring)]
            promised -= {old for old in promised if old < index}
            if index not in self._decisions:
                self._decide(index)
            if not self._decisions[index]:
                return None
            promised.discard(index)
            return ring.take()

    def _decide(self, index: int) -> None:
        for promised in self._promised.values():  # a camera that is gone must not starve the other
            promised -= {old for old in promised if old < index - DRIVER_BUFFERS}
        room = all(ring.free > len(self._promised[id(ring)]) for ring in self._rings)
        self._decisions[index] = room
        if room:
            for promised in self._promised.values():
                promised.add(index)
        while len(self._decisions) > self._REMEMBERED:
            del self._decisions[next(iter(self._decisions))]


class Grabber(Worker):
    """Owns one camera from ``start`` on. Keeps the driver supplied with empty slots."""

    def __init__(
        self,
        place: Place,
        camera: Camera,
        description: CameraDescription,
        ring: Ring,
        layout: FrameLayout,
        gate: SideGate,
        triggers: Triggers,
        ledger: Ledger,
        recorder: Recorder,
        frame_clock: FrameClock,
    ) -> None:
        super().__init__(f"read-{place[0]}-{place[1]}")
        self.place = place
        self.ring = ring
        self.discarded = 0  # duplicates, and frames that no trigger asked for
        self._camera = camera
        self._description = description
        self._layout = layout
        self._gate = gate
        self._ledger = ledger
        self._recorder = recorder
        self._frame_clock = frame_clock
        self._numbering = FrameNumbering(description, triggers)

    @property
    def clock(self) -> ClockFigures:
        """How well the camera's clock is known."""
        return self._frame_clock.figures

    def arm(self) -> None:
        """Give the driver its buffers and make the camera ready for triggers. Before ``start``."""
        for _ in range(DRIVER_BUFFERS):
            slot = self.ring.take()
            if slot is not None:
                self._queue(slot)
        self._camera.arm()

    def work(self) -> None:
        """Grab until asked to stop.

        Raises:
            CameraLost: the camera is gone. Its further triggers are booked when the ledger is closed.
        """
        try:
            while not self.stop_requested.is_set():
                self.step(GRAB_TIMEOUT_S)
        except CameraLost as error:
            raise CameraLost(f"{'/'.join(self.place)}: {error}") from error
        finally:
            self.finish()
            self._camera.disarm()

    def step(self, timeout_s: float) -> bool:
        """Take one frame on its way, when there is one within ``timeout_s``."""
        grab = self._camera.grab(timeout_s)
        if grab is None:
            return False
        for told, numbered in self._numbering.feed(grab):
            self._take(told, numbered)
        return True

    def finish(self) -> None:
        """No more frames will come: take those that waited to be numbered."""
        for grab, numbered in self._numbering.flush():
            self._take(grab, numbered)

    def _take(self, grab: Grab, numbered: Numbered | None) -> None:
        if numbered is None or not self._ledger.arrived(self.place, numbered.index, numbered.lost_in_delivery):
            self.discarded += 1
            self._queue(grab.slot)
            return
        if grab.status is not FrameStatus.COMPLETE:
            self._lose(grab, numbered, LossStage.USB, "the driver delivered an incomplete buffer")
            return
        fresh = self._gate.take(numbered.index, self.ring)
        if fresh is None:
            self._lose(grab, numbered, LossStage.RING, "ring full: the disk is behind by more than ring.stall_s")
            return
        self._queue(fresh)
        self._hand_over(grab, numbered)

    def _hand_over(self, grab: Grab, numbered: Numbered) -> None:
        row_time_ns = self._description.row_time_ns
        time = self._frame_clock.time_of(grab, numbered)
        frame = Frame(
            trigger_index=numbered.index,
            device_frame_id=grab.frame_id,
            device_ticks=grab.device_ticks,
            trigger_time_ns=numbered.trigger_ns,
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
        self._queue(grab.slot)

    def _queue(self, slot: int) -> None:
        self._camera.queue(slot, self._layout.pixels(self.ring.slot(slot)))
