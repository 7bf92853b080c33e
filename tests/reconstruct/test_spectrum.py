"""Spectra of motions that are known: Parseval's sum, frequencies and their sigmas, gaps."""

import numpy as np
import pytest
from scipy.signal import lfilter

from reconstruct.spectrum import spectrum

RATE_HZ = 25.0
STEP_NS = round(1e9 / RATE_HZ)


def times(count: int) -> np.ndarray:
    return 1_700_000_000_000_000_000 + np.arange(count) * STEP_NS


def shaken(frequencies: tuple[float, ...], damping: float, seconds: float, seed: int) -> np.ndarray:
    """The sum of oscillators, each shaken by white noise of its own: exact at the instants of the sampling."""
    rng = np.random.default_rng(seed)
    total = np.zeros(round(seconds * RATE_HZ))
    for frequency in frequencies:
        omega = 2 * np.pi * frequency / RATE_HZ
        decay = np.exp(-damping * omega)
        poles = [1.0, -2 * decay * np.cos(omega * np.sqrt(1 - damping**2)), decay**2]
        total += lfilter([omega**2], poles, rng.standard_normal(total.size))
    return total


def test_the_sum_over_the_spectrum_is_the_variance():
    """Parseval: white noise of sigma 3 spreads 9 over 12.5 Hz."""
    found = spectrum(times(20_000), 3.0 * np.random.default_rng(1).standard_normal(20_000))
    assert found is not None
    step = found.frequency_hz[1] - found.frequency_hz[0]
    # √(2 / degrees of freedom) with some 40 stretches of 250 frequencies
    assert found.density.sum() * step == pytest.approx(9.0, rel=0.03)
    assert np.median(found.density) == pytest.approx(9.0 / 12.5, rel=0.05)
    assert found.modes == ()


def test_a_sine_is_one_narrow_mode():
    value = 5.0 * np.sin(2 * np.pi * 1.337 * np.arange(1500) / RATE_HZ) + 40.0
    found = spectrum(times(1500), value + 1e-3 * np.random.default_rng(2).standard_normal(1500))
    assert found is not None
    mode = max(found.modes, key=lambda one: one.amplitude)
    # the parabola through a Hann window's logarithms is off by at most 2 % of a step of 0.05 Hz
    assert mode.frequency_hz == pytest.approx(1.337, abs=0.02 * 0.05)
    assert mode.amplitude == pytest.approx(5.0 / np.sqrt(2.0), rel=0.05)
    assert mode.width_hz < 0.02


@pytest.mark.parametrize("seed", range(4))
def test_modes_of_shaken_oscillators_are_found_within_their_sigmas(seed: int):
    found = spectrum(times(15_000), shaken((1.1, 3.4), 0.02, 600.0, seed))
    assert found is not None
    assert len(found.modes) == 2
    for mode, truth in zip(found.modes, (1.1, 3.4), strict=True):
        assert mode.sigma_hz < 0.02 * truth
        assert abs(mode.frequency_hz - truth) < 4 * mode.sigma_hz + 0.002 * truth
        # at half of its height a resonance is 2 ζ f wide; the estimate of 30 stretches is rough
        assert 0.3 * 0.04 * truth < mode.width_hz < 2.5 * 0.04 * truth


def test_gaps_are_bridged_or_cut():
    value = np.sin(2 * np.pi * 2.0 * np.arange(3000) / RATE_HZ)
    value += 0.01 * np.random.default_rng(3).standard_normal(3000)
    holes = value.copy()
    holes[500:503] = holes[900:902] = np.nan
    holes[1500:1700] = np.nan
    found = spectrum(times(3000), holes)
    assert found is not None
    mode = max(found.modes, key=lambda one: one.amplitude)
    assert mode.frequency_hz == pytest.approx(2.0, abs=0.005)


@pytest.mark.parametrize("sets", [75, 375, 1500])
def test_noise_has_hardly_any_modes(sets: int):
    rng = np.random.default_rng(sets)
    found = [spectrum(times(sets), rng.standard_normal(sets)) for _ in range(100)]
    assert sum(bool(one and one.modes) for one in found) <= 2
    assert all(found)


@pytest.mark.parametrize("count", [0, 1, 30, 63])
def test_too_few_sets_have_none(count: int):
    assert spectrum(times(count), np.arange(count, dtype=float)) is None
    assert spectrum(times(200), np.where(np.arange(200) % 8 == 0, 1.0, np.nan)) is None
