"""The truth's files against the motion itself, and the commands that write them."""

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from hw_sim.cli import app
from hw_sim.truth import write_truth
from hw_sim.wing_motion import LedMotion, WingMotion, twist_rad
from hw_sim.world import World

FROM_NS, TO_NS = 1_700_000_500_000_000_000, 1_700_000_500_100_000_000


def test_truth_is_the_motion_sampled(world: World, tmp_path: Path) -> None:
    write_truth(world, FROM_NS, TO_NS, tmp_path)
    table = pq.read_table(tmp_path / "markers.parquet")
    assert json.loads(table.schema.metadata[b"wingshape"])["truth_of_seed"] == world.seed
    markers = table.to_pydict()
    assert len(markers["side"]) == 21 * 2 * 18
    row = 18 * 7 + 5  # the eighth instant of the left wing, marker 5
    assert (markers["side"][row], markers["marker"][row], markers["trigger_index"][row]) == ("left", 5, -1)
    assert markers["timestamp_ns"][row] == FROM_NS + 7 * 5_000_000
    centres, _ = LedMotion(world, "left").centres(np.full(18, FROM_NS + 35_000_000))
    assert [markers[n][row] for n in ("x_m", "y_m", "z_m")] == pytest.approx(centres[5], abs=1e-15)
    shape = pq.read_table(tmp_path / "shape.parquet").to_pydict()
    assert len(shape["side"]) == 21 * 2 * 31
    row = 21 * 31 + 31 * 3 + 25  # right wing, fourth instant, s = 2.5 m
    assert (shape["side"][row], shape["station"][row], shape["s_m"][row]) == ("right", 25, pytest.approx(2.5))
    state = WingMotion(world, "right", np.array([2.5])).state(np.array([FROM_NS + 15_000_000]))
    assert [shape[n][row] for n in ("x_m", "y_m", "z_m")] == pytest.approx(state.points_m[0], abs=1e-15)
    assert shape["twist_deg"][row] == pytest.approx(np.degrees(twist_rad(world, state.frames, "right")[0]))


def test_commands_write_worlds_and_truth(tmp_path: Path) -> None:
    runner = CliRunner()
    path = tmp_path / "world.toml"
    made = runner.invoke(app, ["world", "-o", str(path), "--seed", "9", "--scale", "4", "--background", "sunlit"])
    assert made.exit_code == 0
    assert World.read(path) == World.make(9, 4, "sunlit")
    span = ["--from-ns", str(FROM_NS), "--to-ns", str(TO_NS)]
    done = runner.invoke(app, ["truth", "--world", str(path), *span, "-o", str(tmp_path / "truth")])
    assert done.exit_code == 0
    assert (tmp_path / "truth" / "shape.parquet").exists()
    backwards = ["--from-ns", str(TO_NS), "--to-ns", str(FROM_NS)]
    assert runner.invoke(app, ["truth", "--world", str(path), *backwards, "-o", str(tmp_path / "no")]).exit_code != 0
    assert runner.invoke(app, ["world", "-o", str(path), "--scale", "3"]).exit_code != 0
    assert not (tmp_path / "no").exists()
