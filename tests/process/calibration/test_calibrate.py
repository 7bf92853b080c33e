"""Calibration against known cameras, finite differences and MATLAB's solution of real corners."""

import html
import json
import os
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from capture.errors import ProcessError, UsageError
from process.board import Board
from process.bundle import Estimate, Freedom, _Space, adjust
from process.calibrate import CalibrationSettings, Method, calibrate, calibration_covariance_m2
from process.calibration_session import image_pairs
from process.camera_model import CameraModel, RigSide, StereoPair, pose_matrix, read_pair
from process.cli import app
from process.pose_fit import triangulate_midpoint
from process.triangulate import triangulate

BOARD = Board(10, 7, 0.03)
SIZE = (2080, 1552)
PAIR = StereoPair(
    CameraModel(*SIZE, [[2701.0, 0, 1041.7], [0, 2703.5, 771.3], [0, 0, 1]], [-0.11, 0.14, -3e-4, 6e-4, 0.02]),
    CameraModel(*SIZE, [[2695.0, 0, 1030.1], [0, 2693.5, 781.9], [0, 0, 1]], [-0.10, 0.12, 4e-4, -2e-4, 0.01]),
    pose_matrix([0.004, -0.05, 0.003], [-0.2794, 0.001, -0.0005]),
)
DATA = Path(os.environ.get("WINGSHAPE_REFERENCE_DATA", Path(__file__).parents[4] / "shared/data"))


def board_poses(count, seed):
    """Board poses in front of both cameras, tilted every way."""
    rng = np.random.default_rng(seed)
    poses = []
    for _ in range(count):
        tilt = rng.uniform(0.2, 0.6) * np.exp(1j * rng.uniform(0, 2 * np.pi))
        z = rng.uniform(0.9, 1.7)
        place = [0.14 + rng.uniform(-0.12, 0.12) * z, rng.uniform(-0.14, 0.14) * z, z]
        poses.append(pose_matrix([tilt.real, tilt.imag, rng.uniform(-0.4, 0.4)], place))
    return poses


def see(points, poses, noise_px, seed):
    """Corners (2, V, N, 2) by OpenCV's own projection."""
    flat = np.column_stack([points, np.zeros(len(points))])
    rng = np.random.default_rng(seed)
    corners = [
        [
            cv2.projectPoints(flat, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], camera.K, camera.distortion)[0].reshape(
                -1, 2
            )
            for T in (from_cam0 @ pose for pose in poses)
        ]
        for camera, from_cam0 in ((PAIR.cam0, np.eye(4)), (PAIR.cam1, PAIR.T_cam1_cam0))
    ]
    return np.array(corners) + rng.normal(0.0, noise_px, (2, len(poses), len(points), 2))


def printed(seed, sigma_m=5e-5):
    """The board with print errors; its mean scale is part of them."""
    return BOARD.points_m + np.random.default_rng(seed).normal(0.0, sigma_m, BOARD.points_m.shape)


def test_the_bundles_jacobian_agrees_with_finite_differences():
    poses = board_poses(3, 1)
    views = np.array([np.concatenate([cv2.Rodrigues(T[:3, :3])[0].ravel(), T[:3, 3]]) for T in poses])
    views[0, :3] = 1e-6  # the series for small angles
    intrinsics = np.stack([PAIR.cam0.intrinsics, PAIR.cam1.intrinsics])
    start = Estimate(intrinsics, PAIR.parameters[18:], views, BOARD.points_m)
    corners = see(BOARD.points_m, poses, 0.5, 2)
    for freedom in (Freedom(board=True), Freedom(distortion_terms=2), Freedom(intrinsics=False)):
        space = _Space(start, freedom)
        x = np.random.default_rng(3).normal(0.0, 1e-4, space.zero.shape)
        jacobian = space.jacobian(x)
        for index in range(len(x)):
            step = np.zeros(len(x))
            step[index] = 1e-6
            ahead, behind = (projected(space.estimate(x + sign * step)) for sign in (1, -1))
            numeric = ((ahead - behind) / 2e-6).ravel()
            # rounding of 2000 px · 1e-16 · some operations over 2e-6: 1e-6; truncation is relative
            np.testing.assert_allclose(jacobian[:, index], numeric, rtol=1e-6, atol=2e-5 * max(1, abs(numeric).max()))
    assert corners.shape == projected(start).shape


def projected(estimate):
    """By OpenCV: independent of the bundle's projection."""
    flat = np.column_stack([estimate.board_m, np.zeros(len(estimate.board_m))])
    between = pose_matrix(estimate.stereo[:3], estimate.stereo[3:])
    pixels = []
    for values, from_cam0 in zip(estimate.intrinsics, (np.eye(4), between), strict=True):
        fx, fy, cx, cy, *distortion = values
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        poses = [from_cam0 @ pose_matrix(view[:3], view[3:]) for view in estimate.views]
        pixels.append(
            [
                cv2.projectPoints(flat, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], K, np.array(distortion))[0].reshape(
                    -1, 2
                )
                for T in poses
            ]
        )
    return np.array(pixels)


def test_known_cameras_are_recovered_within_the_predicted_covariance():
    """χ² of all 24 parameters over several sessions, print errors and their unknown mean scale included."""
    poses = board_poses(15, 4)
    total = 0.0
    sessions = 4
    for seed in range(sessions):
        result = calibrate(see(printed(seed), poses, 0.05, 100 + seed), BOARD, SIZE)
        error = result.pair.parameters - PAIR.parameters
        total += error @ np.linalg.solve(result.pair.covariance, error)
        assert result.gradient < 1e-6
        assert result.sigma_px == pytest.approx(0.05, rel=0.06)  # 4200 − 250 freedoms: 1.1 %, five sigma
    # χ² with 24 · 4 degrees of freedom: 96 ± 14; four sigma, and the covariance is itself estimated
    assert 50 < total < 160


def test_points_are_recovered_within_the_calibrations_own_covariance():
    result = calibrate(see(printed(8), board_poses(15, 4), 0.05, 9), BOARD, SIZE)
    points = np.array([[0.1, 0.1, 1.0], [0.2, -0.2, 2.0], [0.1, 0.0, 3.0]])
    in_cam1 = points @ PAIR.T_cam1_cam0[:3, :3].T + PAIR.T_cam1_cam0[:3, 3]
    found = triangulate_midpoint(result.pair, PAIR.cam0.project(points), PAIR.cam1.project(in_cam1))
    error = found - points
    covariance = calibration_covariance_m2(result.pair, points)
    for e, C in zip(error, covariance, strict=True):
        assert e @ np.linalg.solve(C, e) < 16.3  # χ² with 3 degrees of freedom, 0.1 %
    assert np.all(np.isnan(calibration_covariance_m2(PAIR, points)))


@pytest.mark.slow
def test_estimating_the_print_beats_trusting_it_and_both_beat_two_stages():
    """What print errors of 0.05 mm leave in the focal lengths and the principal point, RMS over sessions."""
    errors = {name: [] for name in ("joint", "nominal", "paper")}
    for seed in range(4):
        corners = see(printed(20 + seed), board_poses(15, 30 + seed), 0.03, 40 + seed)
        for name, settings in (
            ("joint", CalibrationSettings()),
            ("nominal", CalibrationSettings(nominal_board=True)),
            ("paper", CalibrationSettings(Method.paper)),
        ):
            result = calibrate(corners, BOARD, SIZE, settings)
            errors[name].append(np.linalg.norm(result.pair.cam0.K - PAIR.cam0.K))
    joint, nominal, paper = (np.sqrt(np.mean(np.square(errors[name]))) for name in ("joint", "nominal", "paper"))
    assert joint < 0.5 * nominal
    assert joint < 0.5 * paper


def test_paper_method_reaches_the_optimum_of_both_stages():
    corners = see(BOARD.points_m, board_poses(12, 5), 0.1, 6)
    result = calibrate(corners, BOARD, SIZE, CalibrationSettings(Method.paper))
    assert result.pair.covariance is None
    assert result.camera_rms_px == result.alone_rms_px
    # OpenCV's optimum on single-precision corners: 2000 px · 2⁻²⁴ = 1e-4 px on some 0.14
    assert result.alone_rms_px[0] == pytest.approx(result.library_rms_px[0], abs=1e-4)
    assert result.stereo_rms_px <= result.library_rms_px[2] + 1e-5
    # noise of 0.1 px an axis is 0.1414 px a corner, less the freedoms used: sqrt(1 − 81 / 1680) for one camera
    assert result.alone_rms_px[0] == pytest.approx(0.1414 * np.sqrt(1 - 81 / 1680), rel=0.07)


def test_a_library_that_stops_early_is_told_in_pixels_and_millimetres(monkeypatch):
    """As some versions' stereoCalibrate does; what it costs by OpenCV's own triangulation."""
    to_the_end, found = cv2.stereoCalibrate, []

    def stop_early(*given, **options):
        rms, *others = to_the_end(*given, **options)
        others[5] = others[5] + [[1e-3], [0.0], [2e-3]]
        found.extend([1.5 * rms, others[4], others[5]])
        return 1.5 * rms, *others

    monkeypatch.setattr(cv2, "stereoCalibrate", stop_early)
    result = calibrate(see(printed(4), board_poses(12, 5), 0.05, 6), BOARD, SIZE, CalibrationSettings(Method.paper))
    (said,) = result.warnings
    assert said.startswith(f"cv2.stereoCalibrate stopped early at {found[0]:.4f} px; the optimum used here has")
    farthest_m = float(result.estimate.views[:, 5].max())
    own, point = result.pair, result.pair.middle_of_view(farthest_m)
    seen = own.cam0.project(point), own.cam1.project(own.T_cam1_cam0[:3, :3] @ point + own.T_cam1_cam0[:3, 3])
    ideal = [camera.undistort(pixel).T for camera, pixel in zip((own.cam0, own.cam1), seen, strict=True)]
    placed = cv2.triangulatePoints(np.eye(3, 4), np.column_stack(found[1:]), *ideal).ravel()
    off_mm = 1000.0 * np.linalg.norm(placed[:3] / placed[3] - point)
    assert float(re.search(rf"{farthest_m:.2g} m away ([\d.]+) mm elsewhere", said)[1]) == pytest.approx(
        off_mm, rel=0.05
    )


def test_a_view_of_another_instant_is_left_out_and_named():
    poses = board_poses(7, 7)
    corners = see(BOARD.points_m, poses, 0.05, 8)
    moved = [pose @ pose_matrix([0, 0, 0], [0.004, 0, 0]) for pose in poses]
    corners[1, 5] = see(BOARD.points_m, moved, 0.05, 8)[1, 5]
    result = calibrate(corners, BOARD, SIZE)
    assert list(result.rejected) == [5]
    assert "moved" in result.rejected[5]
    assert 5 not in result.used
    assert abs(result.pair.baseline_m - PAIR.baseline_m) < 1e-4


def test_corners_that_were_not_seen_are_not_needed():
    corners = see(printed(3), board_poses(12, 4), 0.03, 5)
    rng = np.random.default_rng(6)
    for camera in (0, 1):
        for view in range(12):  # up to half of the board out of the picture, not the same half in both
            hidden = BOARD.points_m[:, rng.integers(2)] * rng.choice([-1, 1]) > rng.uniform(0.01, 0.2)
            corners[camera, view, hidden] = np.nan
    result = calibrate(corners, BOARD, SIZE)
    assert result.odd_corners == []
    assert result.sigma_px == pytest.approx(0.03, rel=0.1)
    error = result.pair.parameters - PAIR.parameters
    assert error @ np.linalg.solve(result.pair.covariance, error) < 60  # χ² with 24
    never = corners.copy()
    never[:, :, 12] = np.nan
    result = calibrate(never, BOARD, SIZE)
    assert (result.board_m[12] == BOARD.points_m[12]).all()
    assert (result.board_sigma_m[12] == 0.0).all()
    assert (result.board_sigma_m[13] > 0.0).all()


def test_a_blunder_costs_its_corner_and_is_named():
    corners = see(printed(3), board_poses(12, 4), 0.03, 5)
    corners[1, 4, 20] += [2.0, -1.0]
    corners[0, 7, 3] += [0.0, 0.5]
    result = calibrate(corners, BOARD, SIZE)
    assert result.rejected == {}
    assert {odd[:3] for odd in result.odd_corners} == {(1, 4, 20), (0, 7, 3)}
    by_place = {odd[:3]: odd[3] for odd in result.odd_corners}
    assert by_place[1, 4, 20] == pytest.approx(5**0.5, abs=0.3)
    assert np.isnan(result.residuals_px[1, 4, 20]).all()
    assert result.sigma_px == pytest.approx(0.03, rel=0.1)


def test_swapped_cameras_are_refused():
    corners = see(BOARD.points_m, board_poses(8, 9), 0.05, 10)
    with pytest.raises(ProcessError, match="swapped"):
        calibrate(corners[::-1].copy(), BOARD, SIZE)


def test_views_of_one_attitude_are_refused():
    poses = [pose_matrix([0.3, 0.1, 0], [0.14 + 0.01 * i, 0.0, 1.2]) for i in range(6)]
    with pytest.raises(ProcessError, match="same way"):
        calibrate(see(BOARD.points_m, poses, 0.05, 11), BOARD, SIZE)


def test_too_few_views_are_refused():
    with pytest.raises(ProcessError, match="2 usable views"):
        calibrate(see(BOARD.points_m, board_poses(2, 12), 0.05, 13), BOARD, SIZE)


def test_few_views_fall_back_to_the_nominal_board_and_say_so():
    result = calibrate(see(BOARD.points_m, board_poses(4, 14), 0.05, 15), BOARD, SIZE)
    assert np.all(result.board_sigma_m == 0.0)
    assert any("nominal board" in warning for warning in result.warnings)


@pytest.fixture(scope="module")
def duodic():
    path = DATA / "duodic_stereo.npz"
    if not path.exists():
        pytest.skip(f"reference data absent: {path}")
    with np.load(path) as data:
        return {name: data[name] for name in data.files}


@pytest.fixture(scope="module")
def duodic_calibration(duodic):
    corners = np.ascontiguousarray(np.transpose(duodic["board_points"], (3, 2, 0, 1)), dtype=np.float64)
    places = duodic["world_points"].astype(np.float64) / 1000.0
    step_x, step_y = (np.unique(np.round(places[:, axis], 6)).size for axis in (0, 1))
    # MATLAB lists its corners column by column: put them in the board's order
    order = np.lexsort((places[:, 0], places[:, 1]))
    board = Board(step_x, step_y, 0.01)
    height, width = (int(value) for value in duodic["image_size_hw"].ravel())
    settings = CalibrationSettings(nominal_board=True, distortion_terms=2)
    return calibrate(corners[:, :, order], board, (width, height), settings)


@pytest.mark.slow
def test_matlabs_stereo_calibration_is_reproduced(duodic, duodic_calibration):
    """SolavLab/DuoDIC, MATLAB R2021 stereo calibration of the same corners."""
    result = duodic_calibration
    assert result.rejected == {}
    assert result.stereo_rms_px == pytest.approx(0.5870, abs=5e-5)
    assert 1000 * result.pair.baseline_m == pytest.approx(160.426, abs=5e-4)
    assert result.pair.cam0.K[0, 0] == pytest.approx(float(duodic["K1"].ravel()[0]), rel=1e-5)
    # MATLAB's solver stops a little before the optimum: within 3 % of its own standard errors (0.8 mrad, 0.3 mm)
    np.testing.assert_allclose(result.pair.T_cam1_cam0[:3, :3], duodic["R12_matlab_rowvec"].T, atol=2.4e-5)
    np.testing.assert_allclose(1000 * result.pair.T_cam1_cam0[:3, 3], duodic["T12"].ravel(), atol=1e-2)
    assert result.gradient < 1e-6


@pytest.mark.slow
def test_matlabs_standard_errors_are_reproduced(duodic_calibration):
    sigma = np.sqrt(np.diag(duodic_calibration.pair.covariance))
    np.testing.assert_allclose(1000 * sigma[21:], [0.0838, 0.0285, 0.3094], rtol=0.02)
    np.testing.assert_allclose(1000 * sigma[18:21], [0.78, 0.73, 0.15], rtol=0.03)  # published to two digits
    assert sigma[0] == pytest.approx(4.875, rel=0.02)


@pytest.mark.slow
def test_matlabs_points_are_reproduced(duodic):
    """Twenty frames of 435 points, triangulated with MATLAB's own parameters."""
    width, height = (int(value) for value in duodic["image_size_hw"].ravel()[::-1])
    cameras = [
        CameraModel(width, height, duodic[f"K{k}"], np.concatenate([duodic[f"D{k}"].ravel(), np.zeros(5)])[:5])
        for k in (1, 2)
    ]
    T_cam1_cam0 = np.eye(4)
    T_cam1_cam0[:3, :3], T_cam1_cam0[:3, 3] = duodic["R12_matlab_rowvec"].T, duodic["T12"].ravel() / 1000.0
    side = RigSide(StereoPair(*cameras, T_cam1_cam0), np.eye(4), "", "", 0.0)
    worst_m = {"linear": 0.0, "default": 0.0}
    seen = duodic["uni_points2d"].reshape(2, 20, -1, 2).transpose(1, 0, 2, 3)  # all frames of cam0, then of cam1
    for pixels, points in zip(seen, duodic["uni_points3d"], strict=True):
        tracked = np.isfinite(points).all(axis=1)
        eye = np.broadcast_to(np.eye(2), (tracked.sum(), 2, 2))
        for method, known in worst_m.items():
            found = triangulate(side, *pixels[:, tracked], eye, eye, method).xyz_m
            worst_m[method] = max(known, np.abs(found - points[tracked] / 1000.0).max())
    assert worst_m["linear"] < 2e-7
    assert worst_m["default"] < 3e-6  # another optimum: rays that pass each other by up to 1.4 px


def test_a_bundle_whose_views_do_not_determine_it_says_so():
    pose = board_poses(1, 1)[0]
    view = np.concatenate([cv2.Rodrigues(pose[:3, :3])[0].ravel(), pose[:3, 3]])
    start = Estimate(PAIR.cam0.intrinsics[None], np.zeros(6), view[None], BOARD.points_m)
    corners = see(BOARD.points_m, [pose], 0.05, 3)[:1]
    with pytest.raises(ProcessError, match="views"):
        adjust(corners, start, Freedom(board=True))


def write_session(folder, render_board, count=6):
    """Pictures at a quarter of the size, of poses that show the whole board to both cameras."""
    scale = np.diag([0.25, 0.25, 1])
    cameras = [CameraModel(520, 388, scale @ camera.K, camera.distortion) for camera in (PAIR.cam0, PAIR.cam1)]
    margin = Board(BOARD.columns + 4, BOARD.rows + 4, BOARD.square_m).points_m
    written = 0
    for pose in board_poses(50, 21):
        pose = pose_matrix([0, 0, 0], [0, 0, -0.2]) @ pose
        outline = see(margin, [pose], 0.0, 0) / 4
        if written == count or np.any(outline < 0) or np.any(outline > [519, 387]):
            continue
        for name, camera, from_cam0 in zip("AB", cameras, (np.eye(4), PAIR.T_cam1_cam0), strict=True):
            cv2.imwrite(str(folder / f"{name}{written}.png"), render_board(camera, BOARD, from_cam0 @ pose))
        written += 1
    assert written == count


@pytest.fixture(scope="module")
def session_folder(tmp_path_factory, render_board):
    folder = tmp_path_factory.mktemp("session")
    write_session(folder, render_board)
    return folder


def arguments(folder, output, **changed):
    options = {"--cam0": folder / "A*.png", "--cam1": folder / "B*.png", "--board": "10x7", "--square-mm": 30}
    options |= {"--output": output, "--workers": 1} | {f"--{name}": value for name, value in changed.items()}
    return ["calibrate", *(str(word) for pair in options.items() for word in pair)]


def test_the_command_calibrates_rendered_images(session_folder, tmp_path):
    output, report = tmp_path / "pair.json", tmp_path / "report.html"
    done = CliRunner().invoke(
        app, [*arguments(session_folder, output, report=report), "--json"], catch_exceptions=False
    )
    assert done.exit_code == 0
    summary = json.loads(done.stdout)
    written = json.loads(output.read_text())
    assert summary["stereo"]["rms_px"] == written["stereo"]["rms_px"] < 0.1
    assert len(written["provenance"]["inputs"]) == 12
    pair = read_pair(output)
    sigma_m = np.sqrt(pair.covariance[21, 21])
    assert abs(pair.T_cam1_cam0[0, 3] - PAIR.T_cam1_cam0[0, 3]) < 5 * sigma_m
    assert sigma_m < 2e-3
    check_report(summary, report)
    assert [view["used"] for view in written["views"]] == [True] * 6


def check_report(summary, report):
    """The page, its figures, and its figures of merit."""
    page = report.read_text()
    assert "<table>" in page
    assert "http" not in page  # nothing is loaded from elsewhere
    figures = {path.stem for path in (report.parent / "report_figures").iterdir()}
    assert figures == {"residuals", "pattern", "coverage", "uncertainty-image", "uncertainty-range", "views", "print"}
    assert page.count("data:image/png;base64,") == len(figures)
    quality = summary["quality"]
    assert html.escape(quality["next_view"]["text"]) in page
    assert quality["next_view"]["then_worst_sigma_mm"] < quality["next_view"]["worst_sigma_mm"]
    assert [entry["range_m"] for entry in quality["uncertainty"]] == [1.0, 2.0, 3.0]
    assert quality["cross_validation"]["folds"] == 6
    assert len(quality["cross_validation"]["views"]) == 6
    assert all(0 < image["covered_percent"] <= 100 for image in quality["images"])
    assert 0.9 < summary["calibration"]["stereo_to_mono_ratio"] < 1.5


def test_the_boards_flatness_and_no_cross_validation_can_be_asked_for(session_folder, tmp_path):
    output = tmp_path / "pair.json"
    words = [*arguments(session_folder, output, folds=0, report=tmp_path / "r.html"), "--json"]
    done = CliRunner().invoke(app, [*words, "--flatness-mm", "0.5"], catch_exceptions=False)
    assert done.exit_code == 0
    summary = json.loads(done.stdout)
    assert summary["quality"]["cross_validation"] is None
    board = summary["board"]
    assert 0.0 <= board["flatness_mm"] < 5 * board["flatness_sigma_mm"]  # it was drawn flat
    assert (tmp_path / "r_figures/flatness.png").stat().st_size > 1000
    with pytest.raises(UsageError, match="flatness-mm"):
        CliRunner().invoke(app, [*words, "--flatness-mm", "1", "--method", "paper"], catch_exceptions=False)
    with pytest.raises(UsageError, match="--folds 1"):
        CliRunner().invoke(app, arguments(session_folder, output, folds=1), catch_exceptions=False)


def test_wrong_board_and_missing_pictures_are_refused(session_folder, tmp_path):
    output = tmp_path / "pair.json"
    with pytest.raises(ProcessError, match=r"0 of 6 views.*inner corners") as caught:
        CliRunner().invoke(app, arguments(session_folder, output, board="9x6"), catch_exceptions=False)
    assert "\n" not in str(caught.value)
    assert not output.exists()
    with pytest.raises(UsageError, match="no pictures there"):
        CliRunner().invoke(app, arguments(session_folder, output, cam1=tmp_path), catch_exceptions=False)
    with pytest.raises(ProcessError, match="no such folder"):
        CliRunner().invoke(app, arguments(session_folder, tmp_path / "none/pair.json"), catch_exceptions=False)


def test_images_are_paired_by_name_with_numbers_as_numbers(tmp_path):
    for name in ("A2", "A10", "A1", "B10", "B2", "B1"):
        (tmp_path / f"{name}.png").touch()
    pairs = image_pairs(str(tmp_path / "A*.png"), str(tmp_path / "B*.png"))
    assert [(a.stem, b.stem) for a, b in pairs] == [("A1", "B1"), ("A2", "B2"), ("A10", "B10")]
    (tmp_path / "B2.png").unlink()
    with pytest.raises(UsageError, match=r"missing for .*A2\.png"):
        image_pairs(str(tmp_path / "A*.png"), str(tmp_path / "B*.png"))
    with pytest.raises(UsageError, match="both name"):
        image_pairs(str(tmp_path), str(tmp_path))
