"""The accuracy tables: one calibration through the commands, and the parts against known errors."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from capture.errors import ProcessError, UsageError
from process.accuracy import BOARD, TargetError, _aligned, _drawn_mm
from process.accuracy_command import _rows
from process.accuracy_report import markdown
from process.camera_model import StereoPair
from process.cli import app
from process.plan import CORNER_SIGMA_PX, Mount, calibrated, ideal_pair
from process.shared_error import triangulated_by_calibration


def error(z_mm: float, ours_mm: float, baseline_mm: float = 5.0) -> TargetError:
    nothing = np.empty((0, 2)), np.empty((0, 3)), np.empty((0, 3))
    return TargetError("board", z_mm, baseline_mm, ours_mm, 0.05, 0.1, 0.3, 0.2, *nothing)


def test_rows_are_medians_over_runs_of_what_all_of_them_saw():
    runs = [[error(1000, 0.1), error(2000, 0.2)], [error(2000, 0.5, np.nan)], [error(1000, 0.2), error(2000, 0.1)]]
    (row,) = _rows(6.75, "board", runs)
    assert (row["z_mm"], row["paper_mm"]) == (2000, 4.4)
    assert (row["ours_mm"], row["ours_worst_mm"], row["within_bound95"]) == (0.2, 0.5, 2)
    assert row["baseline_mm"] is None  # one run did not find it
    assert "| 6.75 | 2000 | 4.40 | – | 0.200 | 0.500 | 0.050 | 0.100 | 0.300 | 2 | 0.200 |" in markdown(
        {"table5": [], "table6": [row], "table7": []}, calibrations=3
    )


def test_alignment_takes_a_rigid_motion_out_and_nothing_else():
    truth = np.random.default_rng(1).normal(size=(20, 3))
    angle = 0.1
    R = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    np.testing.assert_allclose(_aligned(truth @ R.T + [1, 2, 3], truth), truth, atol=1e-12)
    stretched = _aligned(1.01 * truth, truth) - truth
    np.testing.assert_allclose(stretched, 0.01 * (truth - truth.mean(axis=0)), atol=1e-9)


def test_a_prediction_is_what_the_covariances_say(world):
    """One point, no noise to speak of: the errors drawn have the covariance J C Jᵀ."""
    known = world.rig.right.pair
    pair = StereoPair(known.cam0, known.cam1, known.T_cam1_cam0, np.diag(np.full(24, 1e-10)))
    point = np.array([[0.14, 0.0, 2.0]])
    none = [np.full((1, 2, 2), 0.0) + 1e-12 * np.eye(2)] * 2
    drawn_mm = _drawn_mm(pair, 4.0, point, none, np.random.default_rng(2))
    jacobian = triangulated_by_calibration(pair, point)[0]
    expected_mm = 1000 * np.sqrt(4.0 * 1e-10 * np.trace(jacobian @ jacobian.T))
    assert np.sqrt(np.mean(drawn_mm**2)) == pytest.approx(expected_mm, rel=0.15)  # 400 draws: 5 %


@pytest.mark.slow
def test_the_papers_table_at_two_metres(tmp_path):
    """F = 6.75 mm: the paper has 4.4 mm (board) and 6.40 mm (LED)."""
    out = tmp_path / "out"
    options = ["accuracy", "-o", str(out), "--focal-mm", "6.75", "--calibrations", "1", "--z-mm", "2000", "--json"]
    done = CliRunner().invoke(app, options, catch_exceptions=False)
    assert done.exit_code == 0
    tables = json.loads((out / "accuracy.json").read_text())
    assert [row["source"] for row in tables["table5"]] == ["cam0", "cam1", "stereo"]
    for table in ("table6", "table7"):
        (row,) = tables[table]
        assert row["ours_mm"] < 0.6
        assert row["ours_mm"] < 1.5 * row["bound95_mm"]  # one in 20 is beyond the bound, few far
        assert row["ours_aligned_mm"] < 0.1
        assert 0.5 < row["baseline_mm"] < 30.0
        assert row["crlb_mm"] < row["bound95_mm"]
        assert row["bound95_mm"] == pytest.approx(
            planned_bound95_mm(table == "table6"), rel=0.5
        )  # its views are others
    by_place = [row for row in tables["figure10"] if row["kind"] == "board"]
    assert len(by_place) == 70
    mean_mm = np.linalg.norm([row["ours_xyz_mm"] for row in by_place], axis=1).mean()
    assert mean_mm == pytest.approx(tables["table6"][0]["ours_mm"])
    assert (out / "accuracy.png").stat().st_size > 10_000
    assert not (out / "f6.75_100" / "target").exists()


def planned_bound95_mm(board: bool) -> float:
    """What `wingproc plan` makes of the same: 15 views of the same board, before there is a camera."""
    planned = Mount(6.75, 2.5, (2080, 1552), 0.2794, (0.03, -0.2, 0.08), (0.0, 0.99, 0.14))
    pair = calibrated(ideal_pair(planned), BOARD, 15)
    flat = BOARD.points_m if board else np.array([[0.12, 0.12], [0.0, 0.0], [-0.12, -0.12]])
    points = np.column_stack([flat[:, 0] + 0.14, flat[:, 1], np.full(len(flat), 2.0)])
    noise = np.broadcast_to(np.eye(2) * CORNER_SIGMA_PX**2, (len(points), 2, 2))
    return float(np.percentile(_drawn_mm(pair, 1.0, points, [noise, noise], np.random.default_rng(1)), 95))


def test_wrong_options_are_refused(tmp_path):
    twice = ["accuracy", "-o", str(tmp_path / "x"), "--focal-mm", "6.75", "--focal-mm", "6.75"]
    with pytest.raises(UsageError, match="each focal length once"):
        CliRunner().invoke(app, twice, catch_exceptions=False)
    with pytest.raises(ProcessError, match="no such folder"):
        CliRunner().invoke(app, ["accuracy", "-o", str(tmp_path / "no" / "x")], catch_exceptions=False)
    assert not (tmp_path / "x").exists()
