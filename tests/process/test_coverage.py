"""Stated covariances against what happens, over rigs that are drawn, calibrated, surveyed and used independently.

WINGSHAPE_RIGS says over how many (100); evidence takes 500.
"""

import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest
from random_rigs import random_rig
from scipy.stats import binomtest

RIGS = int(os.environ.get("WINGSHAPE_RIGS", "100"))
INSIDE_95 = 7.815  # of χ² with three degrees of freedom


@pytest.fixture(scope="module")
def rigs():
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        return list(pool.map(random_rig, range(RIGS), chunksize=5))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["point", "displacement"])
def test_95_percent_ellipsoids_hold_the_truth(rigs, kind):
    """Places on the wing's surface, stand-off and bulb wrong by their sigmas; one marker of each rig is counted."""
    rng = np.random.default_rng(1)
    nees = [rig.nees(kind) for rig in rigs]
    counted = np.array([rng.choice(own) for own in nees])
    inside = int(np.sum(counted < INSIDE_95))
    ratio = float(np.mean([own.mean() for own in nees])) / 3.0
    sigma_mm = 1000.0 * np.median([np.sqrt(np.trace(c)) for rig in rigs for c in getattr(rig, f"{kind}_covariance_m2")])
    error_mm = 1000.0 * np.median([np.linalg.norm(e) for rig in rigs for e in getattr(rig, f"{kind}_m")])
    p = binomtest(inside, RIGS, 0.95).pvalue
    print(
        f"{kind}: {inside} of {RIGS} ellipsoids hold the truth (p = {p:.2f}); error squared {ratio:.3f} a degree of "
        f"freedom; median error {error_mm:.3f} mm, stated sigma {sigma_mm:.3f} mm"
    )
    assert p > 0.01
    # honest, not wide. All markers of a rig share its errors: 3 degrees of freedom a rig, 1 ± 0.08 for 100
    assert ratio >= 0.8
    assert ratio < 1.0 + 4.0 * np.sqrt(2.0 / (3.0 * RIGS))
