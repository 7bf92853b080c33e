"""A few triggers before a recording: do board and cameras count the same, and are the cameras' clocks known?"""

import contextlib
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

from capture.camera.base import Camera, CameraDescription, FrameStatus, Grab, buffer_bytes
from capture.clock import Clock
from capture.clock_fit import ClockFit
from capture.config import DRIVER_BUFFERS
from capture.errors import CaptureError
from capture.gates import Gates
from capture.ledger import Place
from capture.trigger import TriggerBoard
from capture.trigger_protocol import Pulse

LATE_S = 1.0  # how long the last frames may take
FIRST_INDEX = 2**31  # no recording's: a burst's pulses are told from its own


@dataclass(frozen=True)
class CameraBurst:
    """What came of the burst at one camera."""

    frames: int  # whole ones
    incomplete: int
    sigma_us: float  # of the last frame's instant; infinite: it could not be told


@dataclass(frozen=True)
class Burst:
    """What came of it."""

    given: int  # by the board's own counter
    reported: int
    cameras: Mapping[Place, CameraBurst]

    def trouble(self, place: Place, sigma_limit_us: float) -> str | None:
        """What is wrong at a camera; None: nothing."""
        found = self.cameras[place]
        if found.frames != self.given:
            more = f", {found.incomplete} more cut short" if found.incomplete else ""
            return f"the board gave {self.given} triggers, the camera {found.frames} frames{more}"
        if found.sigma_us > sigma_limit_us:
            return f"its frames' instants are known to {found.sigma_us:.0f} us only, not {sigma_limit_us:g} us"
        return None


def give_burst(
    cameras: Mapping[Place, tuple[Camera, CameraDescription]],
    board: TriggerBoard,
    pulses: Collection[Pulse],
    count: int,
    rate_hz: float,
    clock: Clock,
) -> Burst:
    """Arm the cameras, which are open, give ``count`` triggers, take the frames, disarm.

    ``pulses`` is where the board's reports arrive.

    Raises:
        CaptureError: the board or a camera did not do what it was asked to.
    """
    before = board.end().counter
    pulses_before = len(pulses)
    board.set_rate(rate_hz)
    frames: dict[Place, list[Grab]] = {place: [] for place in cameras}
    with contextlib.ExitStack() as cleanup:
        buffers = {place: _arm(camera, description) for place, (camera, description) in cameras.items()}
        for camera, _ in cameras.values():
            cleanup.callback(camera.disarm)
        board.begin(FIRST_INDEX, count)
        deadline_s = clock.monotonic_s() + count / rate_hz + LATE_S
        while clock.monotonic_s() < deadline_s and any(len(found) < count for found in frames.values()):
            for place, (camera, _) in cameras.items():
                grab = camera.grab(0.005)
                if grab is not None:
                    frames[place].append(grab)
                    camera.queue(grab.slot, buffers[place][grab.slot])
        for place, (camera, _) in cameras.items():  # one that has given more than it should
            while len(frames[place]) < 2 * count + 1 and (grab := camera.grab(0.02)) is not None:
                frames[place].append(grab)
                camera.queue(grab.slot, buffers[place][grab.slot])
        after = board.end().counter
    reports = list(pulses)[pulses_before:]
    told = {place: _result(frames[place], reports, description) for place, (_, description) in cameras.items()}
    return Burst(after - before, len(reports), told)


def judge_burst(gates: Gates, burst: Callable[[], Burst], cameras: Sequence[Place], sigma_limit_us: float) -> None:
    """Give a burst and mark what is wrong; it stays marked, and the recording goes on."""
    try:
        found = burst()
    except CaptureError as error:
        gates.judge("burst", str(error))
        return
    gates.judge("burst", None if found.reported == found.given else _unreported(found))
    for place in cameras:
        gates.judge(f"burst {'/'.join(place)}", found.trouble(place, sigma_limit_us))


def _unreported(burst: Burst) -> str:
    return f"the board gave {burst.given} triggers and reported {burst.reported}"


def _arm(camera: Camera, description: CameraDescription) -> list[memoryview]:
    size = buffer_bytes(description.width, description.height)
    buffers = [memoryview(bytearray(size)) for _ in range(DRIVER_BUFFERS)]
    for slot, buffer in enumerate(buffers):
        camera.queue(slot, buffer)
    camera.arm()
    return buffers


def _result(grabs: Sequence[Grab], pulses: Sequence[Pulse], camera: CameraDescription) -> CameraBurst:
    whole = [grab for grab in grabs if grab.status is FrameStatus.COMPLETE]
    sigma_us = float("inf")
    if len(grabs) == len(pulses):  # else it cannot be told which belongs to which
        fit = ClockFit(camera.tick_hz)
        readout_ns = camera.row_time_ns * camera.height
        for grab, pulse in zip(grabs, pulses, strict=True):
            end_ns = grab.receive_ns - grab.exposure_us * 1000 - readout_ns
            sigma_us = fit.feed(grab.device_ticks, pulse.actual_ns, True, end_ns).sigma_ns * 1e-3
    return CameraBurst(len(whole), len(grabs) - len(whole), sigma_us)
