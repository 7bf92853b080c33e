"""The recorder on simulated time, cameras and disks: a seed decides what goes wrong and replays it.

Fault model
    cameras     do not expose on a trigger; expose and never deliver; deliver in part, twice or late; are unplugged, and
                plugged in again with another frame counter and clock; are armed late; their counter wraps
    board       its report of a pulse is lost
    disks       stall (longer than the ring bridges, or shorter); take a write in part; are full; answer with EIO; fail
                to sync
    process     its write thread dies; it is killed at any write (the kernel keeps what was written); the power is
                cut at any write (only what was synced is sure to survive, any page of the rest may)

The recorder's own logic runs unchanged, one step at a time: read steps when a frame is due, write steps when the
simulated disk is free. Afterwards the files are laid out on a real file system and read back by the same code that a
user would use, and compared with what the cameras showed.
"""

import errno
import heapq
import itertools
import random
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from capture.camera.base import Camera, CameraDescription, CameraSettings, FrameStatus, Grab
from capture.config import DRIVER_BUFFERS, DiskConfig
from capture.daemon import AuxLog
from capture.errors import CameraError, CameraLost
from capture.lane import Lane, LaneParts, make_lane
from capture.ledger import Ledger, Place
from capture.record import CAMERAS, SIDES, Trigger, decode_image
from capture.recover import recover_flight
from capture.scan import scan
from capture.trigger import TriggerLog
from capture.trigger_protocol import Pulse
from capture.verify import inspect

WIDTH, HEIGHT = 16, 8
PERIOD_NS = 40_000_000
EXPOSURE_US, ROW_TIME_NS = 2000, 10_000
START_NS = 1_800_000_000_000_000_000
RING_SLOTS = 2 * DRIVER_BUFFERS + 2
NOTHING = 1 << 60
SEEK_NS = 55_000_000


FAULTS = (
    "missed", "undelivered", "incomplete", "repeated", "late", "unplugged", "replugged", "armed late", "unreported",
    "stall", "long stall", "short write", "full", "EIO", "sync fails", "writer dies", "kill", "power cut",
)  # fmt: skip


class Killed(BaseException):
    """The process or the machine is gone. Not an Exception: nothing may catch it."""


def content(place: Place, index: int) -> bytes:
    """What a camera shows on a trigger."""
    number = 2 * SIDES.index(place[0]) + CAMERAS.index(place[1])
    return random.Random((index << 3) | number).randbytes(WIDTH * HEIGHT)


@dataclass
class Plan:
    """What a seed has decided."""

    seed: int
    triggers: int
    missed: set[tuple[Place, int]] = field(default_factory=set)
    undelivered: set[tuple[Place, int]] = field(default_factory=set)
    incomplete: set[tuple[Place, int]] = field(default_factory=set)
    repeated: set[tuple[Place, int]] = field(default_factory=set)
    late_ns: dict[tuple[Place, int], int] = field(default_factory=dict)
    unplugged_at: dict[Place, int] = field(default_factory=dict)
    replugged_at: dict[Place, int] = field(default_factory=dict)
    armed_at: dict[Place, int] = field(default_factory=dict)
    unreported: set[int] = field(default_factory=set)
    disk_faults: dict[str, dict[int, str]] = field(default_factory=dict)  # side: write number: fault
    writer_dies_at: dict[str, int] = field(default_factory=dict)
    end: str = "stop"  # or kill, power cut
    end_at_write: int = NOTHING
    segment_mb: float = 1e3
    takeover: bool = False

    @classmethod
    def of(cls, seed: int) -> "Plan":
        """The plan of a seed: every fault now and then, often several at once."""
        draw = random.Random(seed)
        plan = cls(seed, draw.randint(15, 40))
        places = list(itertools.product(SIDES, CAMERAS))
        events = [(place, index) for place in places for index in range(plan.triggers)]
        for faults, chance in (
            (plan.missed, 0.3),
            (plan.undelivered, 0.3),
            (plan.incomplete, 0.3),
            (plan.repeated, 0.3),
        ):
            if draw.random() < chance:
                faults.update(draw.sample(events, draw.randint(1, 4)))
        if draw.random() < 0.3:
            plan.late_ns = {event: draw.randint(1, 60_000_000) for event in draw.sample(events, 3)}
        if draw.random() < 0.3:
            place, index = draw.choice(places), draw.randrange(plan.triggers)
            plan.unplugged_at[place] = index
            if draw.random() < 0.7:
                plan.replugged_at[place] = index + draw.randint(1, 20)
        if draw.random() < 0.15:
            plan.armed_at[draw.choice(places)] = draw.randint(1, 5)
        if draw.random() < 0.3:
            plan.unreported = set(draw.sample(range(plan.triggers), 2))
        if draw.random() < 0.8:
            side = draw.choice(SIDES)
            faults_here = plan.disk_faults.setdefault(side, {})
            for _ in range(draw.randint(1, 3)):
                kind = draw.choice(["stall", "long stall", "short write", "full", "EIO", "sync fails"])
                faults_here[draw.randint(4, plan.triggers)] = kind
        if draw.random() < 0.15:
            plan.writer_dies_at[draw.choice(SIDES)] = draw.randint(4, plan.triggers)
        if draw.random() < 0.3:
            plan.end = draw.choice(["kill", "power cut"])
            plan.end_at_write = draw.randint(5, 4 * plan.triggers)
        plan.segment_mb = draw.choice([0.05, 0.1, 1e3])
        plan.takeover = draw.random() < 0.4
        return plan


class SimulatedClock:
    """Virtual time, moved on by the event loop only."""

    def __init__(self) -> None:
        self.now_ns = START_NS

    def utc_ns(self) -> int:
        return self.now_ns

    def monotonic_s(self) -> float:
        return (self.now_ns - START_NS) / 1e9

    def sleep(self, seconds: float) -> None:
        raise AssertionError("nothing in the recorder's own logic sleeps")


class PatientlessLog(TriggerLog):
    """A report that is not there yet will not come while simulated time stands still."""

    def nearest(self, time_ns: int, wait_s: float) -> tuple[int, int] | None:
        return super().nearest(time_ns, 0.0)


class SimulatedCamera(Camera):
    """Delivers what the event loop puts into ``due``."""

    def __init__(self, place: Place, seed: int) -> None:
        super().__init__("/".join(place), CameraSettings(WIDTH, HEIGHT, EXPOSURE_US, 0.0))
        self.place = place
        draw = random.Random(seed * 31 + sum("/".join(place).encode()))
        self.frame_id = 65530 + draw.randrange(6)
        self.drift = 1 + draw.uniform(-50e-6, 50e-6)
        self.zero_ns = START_NS - 10**12  # of its clock
        self.plugged = True
        self.armed = False
        self.buffers: deque[tuple[int, memoryview]] = deque()
        self.due: deque[Grab | CameraLost] = deque()

    def open(self) -> CameraDescription:
        if not self.plugged:
            raise CameraError("no such camera")
        return CameraDescription("sim", "0", WIDTH, HEIGHT, EXPOSURE_US, 0.0, ROW_TIME_NS, 1e9, 16, True)

    def queue(self, slot: int, buffer: memoryview) -> None:
        self.buffers.append((slot, buffer))

    def arm(self) -> None:
        self.armed = True

    def grab(self, timeout_s: float) -> Grab | None:
        if not self.due:
            return None
        found = self.due.popleft()
        if isinstance(found, CameraLost):
            raise found
        return found

    def disarm(self) -> None:
        self.armed = False
        self.buffers.clear()

    def close(self) -> None: ...

    def unplug(self) -> None:
        """Nothing more comes out of it; what the driver already had does."""
        self.plugged = self.armed = False
        self.due.append(CameraLost("unplugged"))

    def plug(self, now_ns: int) -> None:
        """It has forgotten its counter and its time."""
        self.plugged = True
        self.frame_id, self.zero_ns = 0, now_ns

    def deliver(self, index: int, edge_ns: int, ready_ns: int, status: FrameStatus) -> bool:
        """Fill the oldest buffer; False when the driver has none."""
        if not self.buffers:
            return False
        slot, buffer = self.buffers.popleft()
        pixels = content(self.place, index)
        buffer[: len(pixels)] = pixels
        ticks = round((edge_ns - self.zero_ns) * self.drift)
        self.due.append(Grab(slot, self.frame_id, ticks, ready_ns, EXPOSURE_US, 0.0, status))
        return True


class SimulatedDisk:
    """Keeps everything in memory, knows what is synced, fails as planned. Writes are numbered over all its files."""

    def __init__(self, faults: dict[int, str], count_write: Callable[[], None], fired: Counter[str]) -> None:
        self.faults = faults
        self.fired = fired
        self.files: dict[Path, SimulatedFile] = {}
        self.writes = 0
        self.took_ns = 0  # by the writes since it was last set to 0
        self.broken: OSError | None = None
        self.count_write = count_write

    def make_folder(self, folder: Path) -> None: ...

    def create(self, path: Path, mode: str, preallocate_bytes: int) -> "SimulatedFile":
        self.files[path] = SimulatedFile(self, mode != "buffered")
        return self.files[path]

    def free_bytes(self, folder: Path) -> int:
        return 1 << 50

    def write_text(self, path: Path, text: str) -> None: ...


class SimulatedFile:
    def __init__(self, disk: SimulatedDisk, direct: bool) -> None:
        self.disk = disk
        self.direct = direct
        self.data = bytearray()
        self.synced = 0

    def write(self, data: memoryview) -> int:
        disk = self.disk
        disk.writes += 1
        disk.count_write()
        if self.direct:
            assert len(data) % 4096 == len(self.data) % 4096 == 0, "O_DIRECT would refuse this"
        fault = disk.faults.pop(disk.writes, "")
        if fault == "short write" and not self.direct:  # it would be whole at once: wait for a frame
            disk.faults[disk.writes + 1], fault = fault, ""
        elif fault and fault != "sync fails":
            disk.fired[fault] += 1
        disk.took_ns += {"stall": 200_000_000, "long stall": 1_500_000_000}.get(fault, 3_000_000)
        if fault in ("full", "EIO"):
            disk.broken = OSError(errno.ENOSPC if fault == "full" else errno.EIO, fault)
        if fault == "sync fails":
            disk.faults[-1] = fault
        if disk.broken is not None:
            self.data += data[: len(data) // 3 // 4096 * 4096]
            raise disk.broken
        done = len(data) // 2 // 4096 * 4096 if fault == "short write" and self.direct else len(data)
        self.data += data[:done]
        return done

    def cut(self, size: int) -> None:
        del self.data[size:]

    def end_direct(self) -> None:
        self.direct = False

    def sync(self) -> None:
        if self.disk.faults.pop(-1, ""):
            self.disk.fired["sync fails"] += 1
            self.disk.broken = OSError(errno.EIO, "sync fails")
        if self.disk.broken is not None:
            raise self.disk.broken
        self.synced = len(self.data)

    def close(self) -> None: ...

    def survivors(self, end: str, draw: random.Random) -> bytes:
        """What is on the disk when the machine is back."""
        if end != "power cut":
            return bytes(self.data)
        kept = bytearray(self.data[: draw.randint(self.synced, len(self.data))])
        for page in range(-(-self.synced // 4096), len(kept) // 4096):
            if draw.random() < 0.3:
                kept[page * 4096 : (page + 1) * 4096] = bytes(4096)
        return bytes(kept)


@dataclass
class Outcome:
    """What a run came to, for those who count."""

    plan: Plan
    violations: list[str]
    lost: Counter[str]
    recorded: int
    dropped_by_driver: int
    fired: Counter[str]


class Simulation:
    """One seed's run."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.clock = SimulatedClock()
        self.aux = AuxLog(self.clock)
        self.triggers = PatientlessLog(1e9 / PERIOD_NS)
        places = list(itertools.product(SIDES, CAMERAS))
        self.lost: Counter[str] = Counter()
        self.lost_at: dict[tuple[Place, int], str] = {}
        self.fired: Counter[str] = Counter()  # the faults that came to pass
        self.ledger = Ledger(places, 0, self.clock.utc_ns, self._on_loss)
        self.cameras = {place: SimulatedCamera(place, plan.seed) for place in places}
        self.events: list[tuple[int, int, Callable[[], None]]] = []
        self.order = itertools.count()
        self.total_writes = 0
        self.busy_until = dict.fromkeys(SIDES, 0)
        self.items = dict.fromkeys(SIDES, 0)
        self.dead_writers: set[str] = set()
        self.given: set[tuple[Place, int]] = set()  # delivered whole by the driver
        self.dropped_by_driver = 0
        self.disks = {
            side: SimulatedDisk(dict(plan.disk_faults.get(side, {})), self._count_write, self.fired) for side in SIDES
        }
        self.lanes: dict[str, Lane] = {}

    def run(self, folder: Path) -> Outcome:
        """Run the plan, lay the files out below ``folder`` (a real one), and check everything."""
        end = "stop"
        try:
            self._fly()
        except Killed:
            end = self.plan.end
        draw = random.Random(self.plan.seed + 1)
        for side in SIDES:
            for path, file in self.disks[side].files.items():
                real = folder / path.relative_to("/")
                real.parent.mkdir(parents=True, exist_ok=True)
                real.write_bytes(file.survivors(end, draw))
        violations = self._check_stopped(folder) if end == "stop" else self._check_killed(folder, end)
        recorded = sum(account.recorded for account in self.ledger.accounts().values())
        return Outcome(self.plan, violations, self.lost, recorded, self.dropped_by_driver, self.fired)

    def _on_loss(self, loss) -> None:
        self.lost[loss.stage] += 1
        self.lost_at[(loss.side, loss.camera), loss.trigger_index] = loss.stage
        self.aux.loss(loss)

    def _count_write(self) -> None:
        self.total_writes += 1
        if self.total_writes >= self.plan.end_at_write:
            self.fired[self.plan.end] += 1
            raise Killed

    def _at(self, time_ns: int, action: Callable[[], None]) -> None:
        heapq.heappush(self.events, (time_ns, next(self.order), action))

    def _fly(self) -> None:
        for side in SIDES:
            parts = LaneParts(
                disk=self.disks[side],
                disk_config=DiskConfig(left=Path("/"), right=Path("/"), segment_mb=self.plan.segment_mb),
                provenance={
                    "flight_id": f"seed {self.plan.seed}",
                    "cameras": "left/cam0 left/cam1 right/cam0 right/cam1",
                },
                ledger=self.ledger,
                triggers=self.triggers,
                clock=self.clock,
                ring_slots=RING_SLOTS,
                lock_memory=False,
            )
            pair = {name: (self.cameras[side, name], self.cameras[side, name].open()) for name in CAMERAS}
            other = "right" if side == "left" else "left"
            spare = (self.disks[other], Path(f"/{other}")) if self.plan.takeover else None
            self.lanes[side] = make_lane(side, Path(f"/{side}"), pair, parts, spare)
            for grabber in self.lanes[side].grabbers.values():
                grabber.arm()
        for index in range(self.plan.triggers):
            edge_ns = START_NS + 10_000_000 + index * PERIOD_NS
            self._at(edge_ns, lambda i=index, t=edge_ns: self._edge(i, t))
        for side in SIDES:
            self._at(START_NS, lambda s=side: self._write(s))
        self._at(START_NS, self._flush)
        last_ns = START_NS + self.plan.triggers * PERIOD_NS + 3_000_000_000
        while self.events and self.events[0][0] <= last_ns:
            self.clock.now_ns, _, action = heapq.heappop(self.events)
            action()
        self._finish()

    def _edge(self, index: int, edge_ns: int) -> None:
        pulse = Pulse(index, 100 + index, edge_ns, edge_ns)
        self.fired["unreported"] += index in self.plan.unreported
        if index not in self.plan.unreported:
            self.triggers.add(pulse)
            self.ledger.triggered(index + 1)
            self.aux.trigger(Trigger(index, pulse.counter, edge_ns, edge_ns, edge_ns))
        for place, camera in self.cameras.items():
            event = (place, index)
            if not camera.plugged:
                continue
            if index == self.plan.unplugged_at.get(place):
                camera.unplug()
                self.fired["unplugged"] += 1
                self._read(place)
                self._at(edge_ns + SEEK_NS, lambda p=place: self._seek(p))
                back_ns = edge_ns + (self.plan.replugged_at.get(place, NOTHING) - index) * PERIOD_NS + PERIOD_NS // 3
                self._at(back_ns, lambda c=camera: c.plug(self.clock.now_ns))
                continue
            if not camera.armed:
                continue
            if event in self.plan.missed or index < self.plan.armed_at.get(place, 0):
                self.fired["missed" if event in self.plan.missed else "armed late"] += 1
                continue
            self.fired["late"] += event in self.plan.late_ns
            ready_ns = edge_ns + EXPOSURE_US * 1000 + ROW_TIME_NS * HEIGHT + 1_000_000 + self.plan.late_ns.get(event, 0)
            self._at(ready_ns, lambda p=place, i=index, t=edge_ns: self._deliver(p, i, t))

    def _deliver(self, place: Place, index: int, edge_ns: int) -> None:
        camera, event = self.cameras[place], (place, index)
        if not camera.armed or edge_ns < camera.zero_ns:  # exposed, but unplugged before it was read out
            return
        camera.frame_id = (camera.frame_id + 1) % 65536
        for kind in ("undelivered", "incomplete", "repeated"):
            self.fired[kind] += event in getattr(self.plan, kind)
        if event in self.plan.undelivered:
            return
        status = FrameStatus.INCOMPLETE if event in self.plan.incomplete else FrameStatus.COMPLETE
        for _ in range(1 + (event in self.plan.repeated)):
            if not camera.deliver(index, edge_ns, self.clock.now_ns, status):
                self.dropped_by_driver += 1
            elif status is FrameStatus.COMPLETE:
                self.given.add(event)
            self._read(place)

    def _read(self, place: Place) -> None:
        grabber = self.lanes[place[0]].grabbers[place[1]]
        try:
            while grabber.step(0.0):
                pass
        except CameraLost as error:
            grabber.lose(error)

    def _seek(self, place: Place) -> None:
        if self.lanes[place[0]].grabbers[place[1]].seek():
            self.fired["replugged"] += 1
        else:
            self._at(self.clock.now_ns + SEEK_NS, lambda: self._seek(place))

    def _write(self, side: str) -> None:
        if side in self.dead_writers:
            return
        disk, recorder = self.disks[side], self.lanes[side].recorder
        disk.took_ns = 0
        if recorder.queued:
            self.items[side] += 1
            if self.items[side] == self.plan.writer_dies_at.get(side):
                self.dead_writers.add(side)
                self.fired["writer dies"] += 1
                return
            recorder.step(0.0)
        self._at(self.clock.now_ns + max(disk.took_ns, 1_000_000), lambda: self._write(side))

    def _flush(self) -> None:
        messages = self.aux.take()
        if messages:
            for lane in self.lanes.values():
                lane.recorder.put_aux(messages)
        self._at(self.clock.now_ns + 100_000_000, self._flush)

    def _finish(self) -> None:
        """What the daemon does at the end, with the same parts."""
        for lane in self.lanes.values():
            for grabber in lane.grabbers.values():
                grabber.finish()
        self.ledger.close(self.plan.triggers)
        self._flush()
        for side, lane in self.lanes.items():
            while side not in self.dead_writers and lane.recorder.step(0.0):
                pass
        self.ledger.settle("the write thread ended before it came to this frame")
        end = {
            "first_index": "0",
            "next_index": str(self.plan.triggers),
            "counter_begin": "100",
            "counter_end": str(100 + self.plan.triggers),
            "board_confirmed": "true",
            "triggers_reported": str(self.aux.triggers),
        }
        last = self.aux.take()
        for lane in self.lanes.values():
            lane.recorder.close(last, end)

    def _check_stopped(self, folder: Path) -> list[str]:
        found: list[str] = []
        report = inspect([folder])
        if self.broken_disks and not report.whole:
            report = self._recovered(folder, found)
        found += report.problems
        for place, account in self.ledger.accounts().items():
            if not account.balanced:
                found.append(f"{place}: the books do not balance: {account}")
            camera = report.cameras["/".join(place)]
            if camera.recorded < account.recorded or (not self.broken_disks and camera.recorded != account.recorded):
                found.append(f"{place}: {account.recorded} recorded by the books, {camera.recorded} in the files")
            for index in range(self.plan.triggers):
                if index in camera.indices and (place, index) not in self.given:
                    found.append(f"{place} trigger {index} is recorded, but the camera never gave it")
                before = self.lost_at.get((place, index)) in ("camera", "usb")
                if before and (place, index) in self.given and (place, index) not in self.plan.late_ns:
                    found.append(f"{place} trigger {index} was given, but is booked as lost before")
        if self.plan.takeover and self.lost["disk"] and not all(disk.broken for disk in self.disks.values()):
            found.append(f"{self.lost['disk']} frames lost at the disk although the other one could take over")
        if self.lost["ring"] and not any(self.fired[kind] for kind in ("stall", "long stall", "writer dies")):
            found.append(f"{self.lost['ring']} frames lost at the ring although no disk stalled")
        for (place, index), stage in self.lost_at.items():
            partner = (place[0], CAMERAS[1 - CAMERAS.index(place[1])])
            if stage == "ring" and index in report.cameras["/".join(partner)].indices:
                found.append(f"{place} trigger {index} was lost at the ring, its partner's frame was kept")
        return found + self._wrong_contents(folder)

    @property
    def broken_disks(self) -> bool:
        return any(disk.broken for disk in self.disks.values())

    def _check_killed(self, folder: Path, end: str) -> list[str]:
        found = self._wrong_contents(folder)
        report = self._recovered(folder, found)
        found += report.problems
        for place, account in self.ledger.accounts().items():
            recorded = report.cameras["/".join(place)].recorded if "/".join(place) in report.cameras else 0
            if end == "kill" and recorded < account.recorded:
                found.append(f"{place}: {account.recorded} were written, {recorded} came back after a kill")
            if end == "power cut" and not self.broken_disks and recorded < account.recorded - 20:
                found.append(f"{place}: {account.recorded} were written, {recorded} came back after a power cut")
        return found

    def _recovered(self, folder: Path, found: list[str]):
        result = recover_flight([folder], folder.parent / "copy")
        found += self._wrong_contents(folder.parent / "copy")
        del result
        return inspect([folder.parent / "copy"])

    def _wrong_contents(self, folder: Path) -> list[str]:
        """Every image in every file against what its camera showed on its trigger."""
        found = []
        for path in sorted(folder.rglob("*.mcap")):
            if path.stat().st_size < 8 or path.read_bytes()[:1] == b"\0":
                continue
            for message in scan(path)[1]:
                if not message.topic.endswith("/image_raw"):
                    continue
                _, side, name, _ = message.topic.split("/")
                image = decode_image(message.data)
                pixels = bytes(message.data[image.pixels_at :])
                if pixels != content((side, name), message.sequence):
                    found.append(f"{path.name}: {side}/{name} trigger {message.sequence} has a wrong content")
                edge_ns = START_NS + 10_000_000 + message.sequence * PERIOD_NS
                if message.publish_ns != edge_ns:
                    found.append(f"{path.name}: {side}/{name} trigger {message.sequence} has a wrong time")
        return found
