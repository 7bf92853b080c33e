"""A wing at rest that is softer than its file: what the check finds, against the stiffness it was made with."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from process.reference import Window
from reconstruct.equilibrium import solve
from reconstruct.hang import hang
from reconstruct.loads_file import LoadsFile, loads_on
from reconstruct.run import Job, run_job
from reconstruct.wing import example_path, read_wing

SIGMA_M = 0.2e-3
SIGMA = np.full(3, SIGMA_M)


def at_rest(half, softer: float) -> np.ndarray:
    """The tip of a wing hanging under its weight whose file's stiffness is too high by ``softer``."""
    beam = replace(half.beam, stiffness=half.beam.stiffness / (1 + softer))
    return solve(beam, loads_on(half, LoadsFile(gravity=True))).shape.position_m[-1]


@pytest.fixture(scope="module")
def halves():
    wing = read_wing(example_path("xhale.toml"))
    return wing.left, wing.right


@pytest.mark.parametrize("softer", [-0.1, 0.0, 0.1, 0.3])
def test_it_finds_the_stiffness(halves, softer):
    for half in halves:
        found = hang(half, at_rest(half, softer), SIGMA)
        assert found is not None
        assert found.softer == pytest.approx(softer, abs=1e-4)
        beside = hang(half, at_rest(half, softer + 0.01), SIGMA)
        slope_m = (beside.measured_m - found.measured_m) / 0.01
        assert found.sigma_softer == pytest.approx(SIGMA_M / slope_m, rel=0.03)
        assert (abs(found.misfit) > 2) == (abs(softer) > 2 * found.stated)
        assert half.side in found.sentence()


def test_a_wing_without_masses_says_nothing(halves):
    half = halves[0]
    assert hang(replace(half, mass_kg=0 * half.mass_kg), at_rest(half, 0.1), SIGMA) is None


def test_a_run_says_so(halves, tmp_path):
    """Both wings 20 % softer than their file, at rest for a second."""
    sets, parts = 25, []
    for half in halves:
        beam = replace(half.beam, stiffness=half.beam.stiffness / 1.2)
        shape = solve(beam, loads_on(half, LoadsFile(gravity=True))).shape
        node = half.marker_node
        places = shape.position_m[node] + (shape.R_body_section[node] @ half.marker_offset_m[:, :, None])[:, :, 0]
        count = len(places)
        times = np.repeat(10**18 + np.arange(sets) * 40_000_000, count)
        parts.append(
            pa.table(
                {
                    "trigger_index": np.repeat(np.arange(sets), count),
                    "side": [half.side] * (sets * count),
                    "marker": np.tile(half.marker_ids, sets).astype(np.int32),
                    "timestamp_ns": times,
                    "frame_timestamp_ns": times,
                    **{f"{axis}_m": np.tile(places[:, k], sets) for k, axis in enumerate("xyz")},
                    **{f"cov_{axes}_m2": np.full(sets * count, 1e-8) for axes in ("xx", "yy", "zz")},
                    **{f"cov_{axes}_m2": np.zeros(sets * count) for axes in ("xy", "xz", "yz")},
                    "flags": [""] * (sets * count),
                }
            )
        )
    table = tmp_path / "markers.parquet"
    pq.write_table(pa.concat_tables(parts), table)
    job = Job(
        (), None, table, example_path("xhale.toml"), tmp_path / "out", csv=False, workers=1, reference=Window(0, 1)
    )
    summary, _ = run_job(job)
    for half in halves:
        assert summary["at_rest"][half.side]["softer_percent"] == pytest.approx(20.0, abs=0.5)
    assert sum("softer than its file" in line for line in summary["warnings"]) == 2
    report = (tmp_path / "out" / "report.html").read_text()
    assert "softer at rest" in report
    assert "than its file" in report
