"""The clock fit against simulated clocks of which everything is known.

The normalised error squared, (error / stated sigma)², is 1 on average when the stated uncertainty is right. One run's
frames share their errors, so its mean scatters; over 24 runs the mean's own standard deviation is below 0.05 (seen),
and the limits 0.8 and 1.2 are four of them.
"""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from simulated_clock import Clockwork, Run, simulate

from capture.camera.base import CameraDescription, FrameStatus, Grab
from capture.clock_fit import ClockFit
from capture.frame_clock import FrameClock
from capture.numbering import Numbered
from capture.ptp import FREE_RUNNING, ClockState
from capture.record import PtpState

WITHIN_NS = 50e3  # at 95 %


def follow(fit: ClockFit, run: Run, clockwork: Clockwork, reported: np.ndarray | None = None):
    """Errors and stated sigmas of all frames, in ns."""
    reported = np.ones(len(run.ticks), dtype=bool) if reported is None else reported
    start_ns = run.receive_ns - (clockwork.exposure_us + clockwork.readout_us) * 1000
    frames = zip(run.ticks, run.trigger_ns, reported, start_ns, strict=True)
    told = [fit.feed(int(t), int(trigger), bool(known), int(r)) for t, trigger, known, r in frames]
    errors = np.array([instant.start_ns for instant in told]) - run.start_ns
    return errors.astype(float), np.array([instant.sigma_ns for instant in told])


def nees_and_error95(clockwork: Clockwork, frames: int, seeds: range, part: slice, reported=None):
    nees, error95 = [], []
    for seed in seeds:
        errors, sigmas = follow(ClockFit(clockwork.tick_hz), simulate(clockwork, frames, seed), clockwork, reported)
        nees.append(np.mean((errors[part] / sigmas[part]) ** 2))
        error95.append(np.quantile(abs(errors[part]), 0.95))
    print(f"normalised error squared {np.mean(nees):.2f}, 95 % of errors within {np.max(error95) / 1e3:.1f} us")
    return np.mean(nees), np.max(error95)


@pytest.mark.parametrize(
    "clockwork",
    [
        Clockwork(),
        Clockwork(drift_ppm=-50.0, walk_ppm=0.1),
        Clockwork(tick_hz=1e6),
        Clockwork(jitter_us=40.0, rate_hz=30.0),
    ],
    ids=["50 ppm and walk", "much walk", "ticks of 1 us", "a board with much jitter"],
)
def test_instants_are_right_and_as_well_known_as_stated(clockwork):
    nees, error95_ns = nees_and_error95(clockwork, 1500, range(24), slice(None))
    assert error95_ns < WITHIN_NS
    assert 0.8 < nees < 1.2


def test_a_calm_clock_is_better_than_stated_but_not_by_far():
    """Its rate wanders less than the least that any of the filters thinks possible after a short time."""
    nees, error95_ns = nees_and_error95(Clockwork(walk_ppm=0.001, swing_ppm=0.1), 1500, range(24), slice(None))
    assert error95_ns < WITHIN_NS
    assert 0.5 < nees < 1.2


def test_while_the_board_is_silent_receive_times_carry_it_on():
    """80 s without a report, a tail of 0.5 ms on every receive time; then the errors of a run have much in common."""
    reported = np.ones(4000, dtype=bool)
    reported[1500:3500] = False
    nees, error95_ns = nees_and_error95(Clockwork(), 4000, range(16), slice(1500, 3500), reported)
    assert error95_ns < WITHIN_NS
    assert 0.5 < nees < 2.0


def test_drift_and_noise_are_found():
    clockwork = Clockwork(walk_ppm=0.001, swing_ppm=0.0)
    fit = ClockFit(clockwork.tick_hz)
    follow(fit, simulate(clockwork, 2000, 3), clockwork)
    figures = fit.figures
    assert abs(abs(figures.rate_ppm) - 50) < 0.5
    assert figures.trigger_sigma_ns == pytest.approx(12e3, rel=0.2)
    assert figures.floor_us == pytest.approx(400 + 500 / 25, abs=30)  # the least of 25 from an exponential
    assert (figures.outliers, figures.steps) == (0, 0)


def test_without_any_report_a_frame_is_as_well_known_as_a_guess():
    """The board's clock is not on our time: triggers have the time of their report's receipt, up to 1 ms late."""
    clockwork = Clockwork(walk_ppm=0.1)
    run = simulate(clockwork, 5000, 9)
    run.trigger_ns[:] = run.start_ns + np.random.default_rng(1).uniform(0, 1e6, 5000).astype(np.int64)
    errors, sigmas = follow(ClockFit(clockwork.tick_hz), run, clockwork, np.zeros(5000, dtype=bool))
    assert abs(errors).max() < 1.5e6
    assert (sigmas[100:] < 1.5e6).all()
    assert (abs(errors) < 2 * sigmas).all()


def test_wrong_trigger_times_are_not_believed_and_widen_their_frame():
    clockwork = Clockwork()
    run = simulate(clockwork, 1000, 5)
    wrong = [300, 301, 555, 800]
    for k, by_ns in zip(wrong, (3e6, -2e6, 0.5e6, -4e6), strict=True):
        run.trigger_ns[k] += int(by_ns)
    fit = ClockFit(clockwork.tick_hz)
    errors, sigmas = follow(fit, run, clockwork)
    assert abs(errors[100:]).max() < 20e3
    assert (sigmas[wrong] > 0.3e6).all()
    assert (fit.figures.outliers, fit.figures.steps) == (4, 0)


def test_a_step_of_the_devices_clock_is_found_within_four_frames():
    clockwork = Clockwork()
    run = simulate(clockwork, 1000, 6)
    run.ticks[600:] += 1_500_000  # 1.5 ms
    fit = ClockFit(clockwork.tick_hz)
    errors, sigmas = follow(fit, run, clockwork)
    assert fit.figures.steps == 1
    assert (abs(errors[600:603]) < 2 * sigmas[600:603]).all()  # in doubt, and said so
    assert abs(errors[604:]).max() < 60e3
    assert (abs(errors[604:]) / sigmas[604:]).max() < 4.5


@pytest.mark.parametrize("jump", [-(10**9), 10**15])
def test_a_device_that_starts_anew_is_fitted_anew(jump):
    clockwork = Clockwork()
    run = simulate(clockwork, 600, 7)
    run.ticks[300:] += jump
    fit = ClockFit(clockwork.tick_hz)
    errors, sigmas = follow(fit, run, clockwork)
    assert fit.figures.steps == 1
    assert (abs(errors[300:]) / sigmas[300:]).max() < 4.5


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 2**32), st.floats(0.1, 100), st.floats(-80, 80), st.floats(0, 0.3), st.lists(st.integers(20, 399))
)
def test_whatever_comes_figures_stay_finite(seed, jitter_us, drift_ppm, walk_ppm, unreported):
    clockwork = Clockwork(jitter_us=jitter_us, drift_ppm=drift_ppm, walk_ppm=walk_ppm)
    reported = np.ones(400, dtype=bool)
    reported[unreported] = False
    errors, sigmas = follow(ClockFit(clockwork.tick_hz), simulate(clockwork, 400, seed), clockwork, reported)
    assert np.isfinite(sigmas).all()
    assert (sigmas > 0).all()
    known = np.maximum(sigmas, np.where(np.arange(400) < 20, 1e3 * jitter_us, 0.0))  # before, the jitter is not known
    assert (abs(errors) / known).max() < 8


CAMERA = CameraDescription("fake", "1", 64, 48, 2000, 0.0, 10_000, 1e9, 16, True)


class AllReported:
    def time_of(self, index: int, log_ns: int) -> tuple[int, bool]:
        return log_ns, True


@pytest.mark.parametrize(
    ("state", "sigma"),
    [
        (FREE_RUNNING, "fit"),
        (ClockState(PtpState.SLAVE, 40_000.0), "both"),
        (ClockState(PtpState.LISTENING, math.nan), -1),
    ],
)
def test_a_frames_uncertainty_is_the_fits_and_the_computers_clocks_together(state, sigma):
    clock = FrameClock(CAMERA, AllReported(), lambda: state, trigger_latency_ns=7_000)
    clockwork = dataclasses.replace(Clockwork(), readout_us=480)
    run = simulate(clockwork, 500, 1)
    for index in range(500):
        grab = Grab(0, index, int(run.ticks[index]), int(run.receive_ns[index]), 2000, 0.0, FrameStatus.COMPLETE)
        found = clock.time_of(grab, Numbered(index, int(run.trigger_ns[index]), 0))
    assert abs(found.exposure_start_ns - run.start_ns[-1] - 7_000) < 10_000
    assert found.ptp_state is state.ptp_state
    fit_ns = clock.figures.sigma_ns
    assert found.sigma_ns == {"fit": math.ceil(fit_ns), "both": math.ceil(math.hypot(fit_ns, 40_000)), -1: -1}[sigma]
