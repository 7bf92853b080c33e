"""A wing at rest that is softer than its file: what the check finds, against the stiffness it was made with."""

from dataclasses import replace

import numpy as np
import pytest

from reconstruct.equilibrium import solve
from reconstruct.hang import hang
from reconstruct.loads_file import LoadsFile, loads_on
from reconstruct.reference import ReferenceShape
from reconstruct.wing import example_path, read_wing

SIGMA_M = 0.2e-3


def at_rest(half, softer: float) -> ReferenceShape:
    """The wing of a file whose stiffness is too high by ``softer``, hanging under its weight."""
    beam = replace(half.beam, stiffness=half.beam.stiffness / (1 + softer))
    shape = solve(beam, loads_on(half, LoadsFile(gravity=True))).shape
    nodes = len(half.node_s_m)
    return ReferenceShape("rest", shape.position_m, np.zeros(nodes), np.full((nodes, 4), SIGMA_M), None)


@pytest.fixture(scope="module")
def halves():
    wing = read_wing(example_path("xhale.toml"))
    return wing.left, wing.right


@pytest.mark.parametrize("softer", [-0.1, 0.0, 0.1, 0.3])
def test_it_finds_the_stiffness(halves, softer):
    for half in halves:
        found = hang(half, at_rest(half, softer))
        assert found is not None
        assert found.softer == pytest.approx(softer, abs=1e-4)
        beside = hang(half, at_rest(half, softer + 0.01))
        slope_m = (beside.measured_m - found.measured_m) / 0.01
        assert found.sigma_softer == pytest.approx(SIGMA_M / slope_m, rel=0.03)
        assert (abs(found.misfit) > 2) == (abs(softer) > 2 * found.stated)
        assert half.side in found.sentence()


def test_what_frames_share_counts_in_full(halves):
    half = halves[0]
    rest = at_rest(half, 0.1)
    shared = np.zeros((len(half.node_s_m), 4, 2))
    shared[-1, 2] = [3e-3, 4e-3]  # 5 mm up or down
    found = hang(half, ReferenceShape(rest.name, rest.xyz_m, rest.twist_rad, rest.sigma, shared))
    assert found is not None
    assert found.sigma_m == pytest.approx(5e-3, rel=0.02)


def test_a_wing_without_masses_says_nothing(halves):
    half = halves[0]
    assert hang(replace(half, mass_kg=0 * half.mass_kg), at_rest(half, 0.1)) is None
