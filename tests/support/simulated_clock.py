"""A camera's clock and link with everything known: what a clock fit is held against. Shares no code with it."""

from dataclasses import dataclass

import numpy as np

START_NS = 1_790_000_000_000_000_000


@dataclass(frozen=True)
class Clockwork:
    """What is wrong with a simulated camera's clock, its trigger and its link."""

    rate_hz: float = 25.0
    drift_ppm: float = 50.0
    walk_ppm: float = 0.02  # the rate wanders so much in a second, one sigma (temperature)
    swing_ppm: float = 2.0  # and swings slowly, over ten minutes
    tick_hz: float = 1e9
    jitter_us: float = 12.0  # of the board's report, one sigma
    latency_floor_us: float = 400.0
    latency_tail_us: float = 500.0  # mean of the exponential tail
    hiccup: float = 0.01  # chance of a frame that the host gets up to 30 ms late
    exposure_us: int = 2000
    readout_us: int = 16000


@dataclass(frozen=True)
class Run:
    """What the fit is given, and the truth."""

    start_ns: np.ndarray  # truth: exposure start
    ticks: np.ndarray
    trigger_ns: np.ndarray  # as reported
    receive_ns: np.ndarray


def simulate(clockwork: Clockwork, frames: int, seed: int) -> Run:
    """``frames`` frames of one camera."""
    rng = np.random.default_rng(seed)
    period_s = 1 / clockwork.rate_hz
    start_s = np.arange(frames) * period_s
    walk = np.cumsum(rng.normal(0, clockwork.walk_ppm * np.sqrt(period_s), frames))
    swing = clockwork.swing_ppm * np.sin(2 * np.pi * start_s / 600 + rng.uniform(0, 6))
    rate = 1 + (clockwork.drift_ppm * rng.choice([-1, 1]) + walk + swing) * 1e-6
    device_s = np.concatenate([[0.0], np.cumsum(rate[:-1] * period_s)])
    ticks = np.floor((device_s + rng.uniform(0, 100)) * clockwork.tick_hz).astype(np.int64)
    latency_s = clockwork.latency_floor_us * 1e-6 + rng.exponential(clockwork.latency_tail_us * 1e-6, frames)
    latency_s += (rng.random(frames) < clockwork.hiccup) * rng.uniform(0, 0.03, frames)
    start_ns = START_NS + np.round(start_s * 1e9).astype(np.int64)
    trigger_ns = start_ns + np.round(rng.normal(0, clockwork.jitter_us * 1e3, frames)).astype(np.int64)
    taken_ns = np.round(latency_s * 1e9).astype(np.int64) + (clockwork.exposure_us + clockwork.readout_us) * 1000
    return Run(start_ns, ticks, trigger_ns, start_ns + taken_ns)
