"""A wing at rest: what it tells of a stiffness that is known here, and that the air has no part in it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from capture.errors import UsageError
from process.reference import Window
from process.signal_table import signal_table, signals_path
from process.signals import Signal, Signals
from reconstruct.air_table import parse_specific_force
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


def rest_table(halves, softer: float, path: Path, sets: int = 25) -> Path:
    """Markers of both wings hanging under their weight for a second, ``softer`` than their file."""
    parts = []
    for half in halves:
        beam = replace(half.beam, stiffness=half.beam.stiffness / (1 + softer))
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
    pq.write_table(pa.concat_tables(parts), path)
    return path


def test_a_run_says_so(halves, tmp_path):
    """Both wings 20 % softer than their file."""
    table, wing = rest_table(halves, 0.2, tmp_path / "markers.parquet"), example_path("xhale.toml")
    summary, _ = run_job(
        Job(markers=table, wing=wing, out=tmp_path / "out", csv=False, workers=1, reference=Window(0, 1))
    )
    for half in halves:
        assert summary["at_rest"][half.side]["softer_percent"] == pytest.approx(20.0, abs=0.5)
    assert sum("softer than its file" in line for line in summary["warnings"]) == 2
    report = (tmp_path / "out" / "report.html").read_text()
    assert "softer at rest" in report
    assert "than its file" in report


def test_at_rest_the_air_does_nothing(halves, tmp_path):
    """The net loads found are the weight; with a load factor of 1 beside the frames, nothing is left for the air."""
    table, wing = rest_table(halves, 0.0, tmp_path / "markers.parquet"), example_path("xhale.toml")
    sets = pq.read_table(table).group_by(["trigger_index", "side", "frame_timestamp_ns"]).aggregate([])
    keys = sets.rename_columns(["trigger_index", "side", "timestamp_ns"])
    gravity = Signal("nz", "/can", "g", 10**18 + np.arange(-10, 300) * 10_000_000, np.ones(310))
    pq.write_table(signal_table(keys, Signals((gravity,))), signals_path(table))
    job = Job(markers=table, wing=wing, out=tmp_path / "out", report=False, workers=1)
    run_job(replace(job, specific_force=parse_specific_force("nz")))
    air = pq.read_table(tmp_path / "out" / "aerodynamic.parquet").to_pandas()
    frames = pq.read_table(tmp_path / "out" / "frames.parquet").to_pandas()
    weight = 9.80665 * np.sum(halves[0].mass_kg)
    assert frames.net_fz_n.mean() == pytest.approx(-weight, rel=0.05)
    known = air.dropna()
    assert len(known) == 2 * (25 - 4)  # two sets at either end have too few neighbours
    assert (known.air_fz_n.abs() < 3 * known.sigma_air_fz_n).all()
    assert known.air_fz_n.abs().max() < 0.05 * weight
    with pytest.raises(
        UsageError, match="--specific-force az: no such signal was recorded beside the frames; there are nz"
    ):
        run_job(replace(job, specific_force=parse_specific_force("az")))
    with pytest.raises(UsageError, match="--specific-force a,b: name one load factor"):
        parse_specific_force("a,b")
