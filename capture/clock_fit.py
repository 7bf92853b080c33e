"""One camera's device clock to UTC: a running fit of its ticks to trigger times, and to receive times where those lack.

The state is the clock's error against its nominal rate, and how fast that grows: a Kalman filter (offset, rate) whose
measurements are the trigger times that the board reported. How noisy those are is learned from the innovations. How
much the rate wanders nobody knows beforehand (temperature): four filters run beside each other, each with its own
idea of it, and are weighted by how well they have predicted (Magill, 1965, multiple model estimation).

A receive time is late by what the link took: never less than a floor, often much more. The least of a block of
frames is near the floor. While triggers are reported the floor is learned; while they are not, it carries the fit on.

Plain numbers, no arrays: a frame costs about 10 µs in the read thread, and memory is bounded.
"""

import math
from dataclasses import dataclass

RATE_WALKS_NS = (1.0, 6.0, 32.0, 180.0)
"""How much the rate wanders in a second, one sigma in ns/s, as each filter thinks: 0.001 to 0.18 ppm."""
FIRST_RATE_NS = 1e5  # 100 ppm: what a crystal may be off
FIRST_TRIGGER_NS = 30e3  # a reported trigger time, before its noise is known
FIRST_GUESS_NS = 1e6  # a reckoned one
LEAST_TRIGGER_NS = 100.0
MEMORY = 0.995  # of a filter's merits, a frame
NOISE_FRAMES = 250  # over which the trigger times' noise is averaged
OUTLIER, DOUBTFUL = 6.0, 2.5  # sigmas
STEP_FRAMES = 4  # outliers that agree, in a row, are a step of the clock
BLOCK_FRAMES = 25  # of receive times; the least of them counts
FLOOR_BLOCKS = 20  # over which the floor is averaged


@dataclass(frozen=True)
class Instant:
    """When a frame's exposure began."""

    start_ns: int  # UTC, row 0
    sigma_ns: float  # one sigma, of this fit alone


@dataclass(frozen=True)
class ClockFigures:
    """How the fit is doing."""

    frames: int
    rate_ppm: float  # device seconds are too short by
    sigma_ns: float  # of the last frame
    trigger_sigma_ns: float  # noise of trigger times against this clock
    outliers: int
    steps: int
    floor_us: float  # least time from the end of read-out to the host; NaN: not known
    on_receive_times: bool  # no trigger of late: carried on by receive times


class _Filter:
    """Offset and rate, with one idea of how much the rate wanders."""

    def __init__(self, walk_ns: float) -> None:
        self.walk = walk_ns**2
        self.merit = 0.0

    def begin(self, offset_ns: float, variance: float, rate_ns: float, rate_variance: float) -> None:
        self.offset, self.rate = offset_ns, rate_ns
        self.poo, self.por, self.prr = variance, 0.0, rate_variance

    def predict(self, dt_s: float) -> None:
        self.offset += self.rate * dt_s
        self.poo += dt_s * (2 * self.por + dt_s * self.prr) + self.walk * dt_s**3 / 3
        self.por += dt_s * self.prr + self.walk * dt_s**2 / 2
        self.prr += self.walk * dt_s

    def update(self, offset_ns: float, variance: float) -> None:
        expected = self.poo + variance
        innovation = offset_ns - self.offset
        self.merit = MEMORY * self.merit - 0.5 * (innovation**2 / expected + math.log(expected))
        gain_o, gain_r = self.poo / expected, self.por / expected
        self.offset += gain_o * innovation
        self.rate += gain_r * innovation
        self.prr -= gain_r * self.por
        self.por -= gain_o * self.por
        self.poo -= gain_o * self.poo


class ClockFit:
    """Feed it each frame in order. Not thread-safe: the read thread's own."""

    def __init__(self, tick_hz: float) -> None:
        """``tick_hz`` is the nominal rate of the device's clock."""
        self._ns_per_tick = 1e9 / tick_hz
        self._quantum = (self._ns_per_tick) ** 2 / 12
        self._filters = [_Filter(walk) for walk in RATE_WALKS_NS]
        self._origin: tuple[int, int] | None = None  # ticks and UTC
        self._ticks = 0
        self._frames = self._outliers = self._steps = 0
        self._noise, self._noise_frames = FIRST_TRIGGER_NS**2, 0
        self._astray: list[float] = []  # the outliers in a row just now
        self._guessed = False  # it rests on reckoned times
        self._offset, self._variance = 0.0, FIRST_GUESS_NS**2
        self._floor = _Floor()

    def feed(self, ticks: int, trigger_ns: int, reported: bool, readout_end_ns: int) -> Instant:
        """When this frame's exposure began.

        Args:
            ticks: the device's clock then.
            trigger_ns: UTC of the trigger as the board reported it, trigger latency included.
            reported: False: that time is only reckoned from others.
            readout_end_ns: UTC when the host had the frame, less exposure and read-out: start plus what the link took.
        """
        self._frames += 1
        if self._origin is None or not 0 <= ticks - self._ticks < 1e12 / self._ns_per_tick:
            return self._begin(ticks, trigger_ns, reported)
        dt_s = (ticks - self._ticks) * self._ns_per_tick * 1e-9
        self._ticks = ticks
        for filter in self._filters:
            filter.predict(dt_s)
        self._mix()
        nominal_ns = self._nominal_ns(ticks)
        offset_ns = float(trigger_ns - nominal_ns)
        doubt = self._take_trigger(offset_ns) if reported else self._take_guess(offset_ns)
        late_ns = readout_end_ns - nominal_ns - self._offset
        error_ns = self._floor.feed(late_ns, reported and not doubt)
        if error_ns is not None:
            self._guessed = False
            self._update(self._offset + error_ns, self._floor.variance)
        return self._instant(nominal_ns, doubt)

    @property
    def figures(self) -> ClockFigures:
        """How the fit is doing. From any thread."""
        return ClockFigures(
            self._frames,
            sum(weight * filter.rate for weight, filter in zip(self._weights(), self._filters, strict=True)) * 1e-3
            if self._origin
            else math.nan,
            math.sqrt(self._variance + self._quantum),
            math.sqrt(self._noise),
            self._outliers,
            self._steps,
            self._floor.level_ns * 1e-3,
            self._floor.carrying,
        )

    def _begin(self, ticks: int, trigger_ns: int, reported: bool) -> Instant:
        """The first frame, or the device's clock was set anew."""
        self._steps += self._origin is not None
        self._origin, self._ticks = (ticks, trigger_ns), ticks
        self._guessed = not reported
        variance = self._noise if reported else FIRST_GUESS_NS**2
        for filter in self._filters:
            filter.begin(0.0, variance, 0.0, FIRST_RATE_NS**2)
        self._astray.clear()
        self._mix()
        return self._instant(trigger_ns, 0.0)

    def _take_trigger(self, offset_ns: float) -> float:
        """Use a reported trigger time; how far astray it is, where it is not believed."""
        innovation = offset_ns - self._offset
        expected = self._variance + self._noise
        sigmas = abs(innovation) / math.sqrt(expected)
        if sigmas > OUTLIER:
            return self._doubt(innovation, expected)
        self._astray.clear()
        self._guessed = False
        self._noise_frames = min(self._noise_frames + 1, NOISE_FRAMES)
        seen = min(innovation**2, 9 * expected) - self._variance
        self._noise = max(self._noise + (seen - self._noise) / (self._noise_frames + 4), LEAST_TRIGGER_NS**2)
        self._update(offset_ns, self._noise * max(1.0, sigmas / DOUBTFUL))
        return 0.0

    def _take_guess(self, offset_ns: float) -> float:
        """A reckoned time is better than a fit that runs away.

        How far off the fit may be beyond its own variance, since such times are wrong together: while it rests on them.
        """
        if self._variance < (FIRST_GUESS_NS / 4) ** 2 or self._floor.carrying:
            return FIRST_GUESS_NS if self._guessed else 0.0
        self._guessed = True
        if abs(offset_ns - self._offset) < OUTLIER * math.sqrt(self._variance + FIRST_GUESS_NS**2):
            self._update(offset_ns, FIRST_GUESS_NS**2)
        return FIRST_GUESS_NS

    def _doubt(self, innovation: float, expected: float) -> float:
        """An outlier. Several in a row that agree are a step of the device's clock."""
        self._outliers += 1
        if self._astray and abs(innovation - self._astray[-1]) > OUTLIER * math.sqrt(2 * expected):
            self._astray.clear()
        self._astray.append(innovation)
        if len(self._astray) < STEP_FRAMES:
            return innovation
        step_ns = sum(self._astray) / len(self._astray)
        self._astray.clear()
        self._outliers -= STEP_FRAMES
        self._steps += 1
        for filter in self._filters:
            filter.begin(filter.offset + step_ns, filter.poo + self._noise, filter.rate, filter.prr)
        self._mix()
        return 0.0

    def _update(self, offset_ns: float, variance: float) -> None:
        for filter in self._filters:
            filter.update(offset_ns, variance)
        self._mix()

    def _weights(self) -> list[float]:
        best = max(filter.merit for filter in self._filters)
        merits = [math.exp(max(filter.merit - best, -50.0)) for filter in self._filters]
        total = sum(merits)
        return [merit / total for merit in merits]

    def _mix(self) -> None:
        weights = self._weights()
        mean = sum(weight * filter.offset for weight, filter in zip(weights, self._filters, strict=True))
        self._variance = sum(
            weight * (filter.poo + (filter.offset - mean) ** 2)
            for weight, filter in zip(weights, self._filters, strict=True)
        )
        self._offset = mean

    def _nominal_ns(self, ticks: int) -> int:
        assert self._origin is not None
        return self._origin[1] + round((ticks - self._origin[0]) * self._ns_per_tick)

    def _instant(self, nominal_ns: int, doubt_ns: float) -> Instant:
        """In doubt the clock is believed, but the trigger time lies within a sigma too."""
        variance = self._variance + self._quantum + doubt_ns**2 + self._floor.level_variance
        return Instant(nominal_ns + round(self._offset), math.sqrt(variance))


class _Floor:
    """The least that the link takes, block by block."""

    def __init__(self) -> None:
        self.level_ns = math.nan
        self.variance = 0.0
        self.carrying = False
        self._blocks = 0
        self._least = math.inf
        self._frames = self._believed = 0

    @property
    def level_variance(self) -> float:
        """What every frame has in common while the floor carries the fit: the floor itself is known so well."""
        return self.variance / min(2 * self._blocks, 2 * FLOOR_BLOCKS) if self.carrying else 0.0

    def feed(self, late_ns: float, believed: bool) -> float | None:
        """Take what a frame took by the fit; at the end of a block without triggers, what the fit is in error by."""
        self._least = min(self._least, late_ns)
        self._frames += 1
        self._believed += believed
        if self._frames < BLOCK_FRAMES:
            return None
        least, believed = self._least, 2 * self._believed >= BLOCK_FRAMES
        self._least, self._frames, self._believed = math.inf, 0, 0
        if believed:
            self._learn(least)
            return None
        self.carrying = self._blocks >= 2
        return least - self.level_ns if self.carrying else None

    def _learn(self, least: float) -> None:
        self.carrying = False
        self._blocks += 1
        if self._blocks == 1:
            self.level_ns, self.variance = least, 0.0
            return
        share = 1 / min(self._blocks, FLOOR_BLOCKS)
        off = least - self.level_ns
        self.level_ns += share * off
        self.variance += share * (off**2 - self.variance) if self._blocks > 2 else off**2
