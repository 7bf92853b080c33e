"""95 % bands of rendered flights against the truth, each flight with a calibration of its own; evidence flies 1,000.

A flight's bands share one calibration's error: only over many flights do 95 % of them hold the truth.
"""

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest
from scipy.stats import binomtest
from short_flights import INSIDE_95, WITHIN_95, Drawn, fly

FLIGHTS = 40


@pytest.fixture(scope="module")
def flights() -> list[Drawn]:
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        return list(pool.map(fly, range(1000, 1000 + FLIGHTS), chunksize=5))


@pytest.mark.slow
def test_markers_are_as_far_off_as_stated(flights):
    inside = sum(one.marker_nees < INSIDE_95 for one in flights)
    assert binomtest(inside, FLIGHTS, 0.95).pvalue > 0.01
    # not wide either: a flight's 18 markers have at least 3 degrees of freedom together, and so a mean of 1 with a
    # standard deviation of at most √(2/3) / √40 = 0.13
    assert np.mean([one.all_nees for one in flights]) / 3.0 == pytest.approx(1.0, abs=0.4)


@pytest.mark.slow
def test_the_wings_bands_hold_the_truth(flights):
    for score in ("band", "twist"):
        inside = sum(abs(getattr(one, score)) < WITHIN_95 for one in flights)
        assert binomtest(inside, FLIGHTS, 0.95, "less").pvalue > 0.01
