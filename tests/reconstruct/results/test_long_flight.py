"""Report, film and MATLAB file of twenty minutes: bounded in memory and size."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from long_result import repeat
from scipy.io import loadmat, whosmat

from reconstruct.run import Job, run_job

SETS = 30_000  # of each wing: 20 minutes at 25 Hz


@pytest.mark.slow
def test_twenty_minutes_are_drawn_in_bounded_memory(bending_wing: Any, wing_file: Path, tmp_path: Path) -> None:
    table = bending_wing().marker_table(np.arange(50) * 0.04, sigma_m=1e-3, missing=0.02)
    pq.write_table(table, tmp_path / "markers.parquet")
    short, long = tmp_path / "short", tmp_path / "long"
    run_job(Job(markers=tmp_path / "markers.parquet", wing=wing_file, out=short, csv=False, also=(), report=False))
    repeat(short, long, SETS)
    program = Path(__file__).parents[2] / "support/long_result.py"
    done = subprocess.run([sys.executable, program, "--draw", long], capture_output=True, text=True, timeout=250)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    print(found)
    assert found["peak_mb_after_film"] < 1500
    assert found["report_mb"] < 8
    assert found["film_mb"] < 20
    assert {name for name, _, _ in whosmat(long / "result.mat")} == {"left", "right", "wingshape"}
    right = loadmat(long / "result.mat", variable_names=["right"], simplify_cells=True)["right"]
    once = pq.read_table(short / "shape.parquet", filters=[("side", "=", "right")]).column("z_m").to_numpy()
    np.testing.assert_array_equal(right["shape"]["z_m"], np.tile(once.reshape(50, -1), (SETS // 50, 1)))
