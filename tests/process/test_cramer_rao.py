"""The bounds against closed forms, brute-force rendering, and what an efficient estimator reaches."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.special import erf

from process.cramer_rao import corner_bound_px, spot_bound_px


def test_a_gaussian_spot_has_its_closed_form():
    """White noise σ under a Gaussian of width s and peak A: σ_u² = 2 σ² / (π A²) (Winick 1986, for s well above a
    pixel), whatever the width."""
    for blur in (1.5, 3.0):
        bound = spot_bound_px(0.05, blur, 100.0, 2.0)
        assert bound == pytest.approx(np.sqrt(2 / np.pi) * 2.0 / 100.0, rel=0.01)


@pytest.mark.parametrize(("radius", "blur"), [(0.7, 0.7), (2.0, 0.7), (6.0, 0.8)])
def test_a_disc_is_as_the_brute_force_rendering_says(painter, radius, blur):
    def picture(shift):
        canvas = painter(61, 61)
        canvas.add(30.0 + shift, 30.0, radius, blur, 157.0)  # on a pixel: its peak is the light's
        return canvas.clean

    slope = (picture(1e-3) - picture(-1e-3)) / 2e-3
    expected = 1 / np.sqrt((slope**2 / (1.5**2 + 0.04 * picture(0.0))).sum())
    # the painter's pixel is a box, here a Gaussian of the same variance; its disc is a grid of points
    found = spot_bound_px(radius, np.hypot(blur, np.sqrt(1 / 12)), 157.0, 1.5, 0.04)
    assert found == pytest.approx(expected, rel=0.05)


def test_a_corner_is_reached_by_least_squares():
    """The maximum-likelihood estimator is efficient: 200 corners fitted with all that is unknown."""
    blur, radius, sigma, contrast = 0.95, 8.0, 2.0, 140.0
    rows, columns = (a[np.hypot(*np.mgrid[-8:9, -8:9]) <= radius].astype(float) for a in np.mgrid[-8:9, -8:9])

    def light(x):
        du, dv = columns - x[0], rows - x[1]
        first = erf((du * np.cos(x[2]) + dv * np.sin(x[2])) / (np.sqrt(2) * x[4]))
        second = erf((dv * np.cos(x[3]) - du * np.sin(x[3])) / (np.sqrt(2) * x[4]))
        return x[5] + (x[6] - x[5]) * (1 + first * second) / 2

    rng, errors = np.random.default_rng(3), []
    for _ in range(200):
        truth = np.array([*rng.uniform(-0.5, 0.5, 2), 0.1, 0.1, blur, 10.0, 10.0 + contrast])
        seen = light(truth) + rng.normal(0, sigma, len(rows))
        errors.append(least_squares(lambda x, seen=seen: light(x) - seen, truth).x[:2] - truth[:2])
    bound = corner_bound_px(contrast, blur, radius, sigma, sigma)
    # 400 coordinates: their RMS is known to 3.5 %
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(bound, rel=0.12)


def test_more_light_is_better_and_more_noise_is_worse():
    assert spot_bound_px(2, 0.9, 200, 1.5) < spot_bound_px(2, 0.9, 100, 1.5) < spot_bound_px(2, 0.9, 100, 3.0)
    assert corner_bound_px(150, 0.9, 10, 2, 2) < corner_bound_px(150, 0.9, 5, 2, 2) < corner_bound_px(150, 0.9, 5, 4, 4)
