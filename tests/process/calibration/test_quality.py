"""Figures of merit of a calibration against corners made by OpenCV: planted faults, and what really comes of advice."""

import cv2
import numpy as np
import pytest

from process.board import Board
from process.bundle import prior_information, view_information
from process.calibrate import CalibrationSettings, Method, calibrate
from process.calibration_quality import (
    RANGES_M,
    common_points,
    image_map,
    judge,
    uncertainty_map,
    working_ranges_m,
)
from process.camera_model import CameraModel, StereoPair, pose_matrix
from process.cross_validation import cross_validate
from process.next_view import SHARES, TILTS, advise

BOARD = Board(10, 7, 0.03)
SIZE = (2080, 1552)
PAIR = StereoPair(
    CameraModel(*SIZE, [[2701.0, 0, 1041.7], [0, 2703.5, 771.3], [0, 0, 1]], [-0.11, 0.14, -3e-4, 6e-4, 0.02]),
    CameraModel(*SIZE, [[2695.0, 0, 1030.1], [0, 2693.5, 781.9], [0, 0, 1]], [-0.10, 0.12, 4e-4, -2e-4, 0.01]),
    pose_matrix([0.004, -0.05, 0.003], [-0.2794, 0.001, -0.0005]),
)
NOISE_PX = 0.05


def poses(count, seed, right=(-0.15, 0.15)):
    """Of the board in front of both cameras; ``right``: its place there, by the distance."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        tilt = rng.uniform(0.2, 0.6) * np.exp(1j * rng.uniform(0, 2 * np.pi))
        z = rng.uniform(0.9, 1.7)
        place = [0.14 + rng.uniform(*right) * z, rng.uniform(-0.16, 0.16) * z, z]
        found.append(pose_matrix([tilt.real, tilt.imag, rng.uniform(-0.4, 0.4)], place))
    return found


def see(board_poses, seed, height_m=0.0, print_m=5e-5, pair=PAIR, board=BOARD):
    """Corners (2, V, N, 2), printed with errors, by OpenCV's own projection."""
    rng = np.random.default_rng(seed)
    flat = board.points_m + np.random.default_rng(3).normal(0.0, print_m, board.points_m.shape)
    corners = np.column_stack([flat, np.zeros(len(flat)) + height_m])
    pixels = [
        [
            cv2.projectPoints(corners, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], own.K, own.distortion)[0].reshape(-1, 2)
            for T in (from_cam0 @ pose for pose in board_poses)
        ]
        for own, from_cam0 in ((pair.cam0, np.eye(4)), (pair.cam1, pair.T_cam1_cam0))
    ]
    return np.array(pixels) + rng.normal(0.0, NOISE_PX, (2, len(board_poses), len(corners), 2))


def grid_points():
    points = np.concatenate([common_points(PAIR, range_m) for range_m in RANGES_M])
    return points[np.isfinite(points).all(axis=1)]


def test_a_planted_dent_of_the_lens_shows_where_it_is():
    corners = see(poses(15, 4), 5)
    clean = calibrate(corners, BOARD, SIZE)
    # cells' mean squares less what noise leaves: 0 ± sqrt(2 · 80 means) / 2100 numbers = (0.08 · noise)²; four sigma
    assert image_map(clean, corners, 0).pattern_px < 0.16 * NOISE_PX
    dent = np.array([1400.0, 500.0])
    off = corners[0] - dent
    corners[0] += 0.4 * np.exp(-np.sum(off**2, axis=-1, keepdims=True) / (2 * 150.0**2)) * [1.0, 0.0]
    bent = calibrate(corners, BOARD, SIZE)
    assert not bent.rejected
    quality = judge(bent, corners, BOARD, 0)
    image = quality.images[0]
    assert image.pattern_px > 0.5 * NOISE_PX
    assert image.pattern_px > 2.0 * quality.images[1].pattern_px
    warnings = quality.warnings(bent.sigma_px, [])
    assert len(warnings) == 1
    assert warnings[0].startswith("cam0: residuals have a pattern")
    row, column = np.unravel_index(np.nanargmax(np.where(image.corners > 10, -image.mean_px[..., 0], -1)), (9, 12))
    assert abs((column + 0.5) / 12 * SIZE[0] - dent[0]) < 1.5 * SIZE[0] / 12
    assert abs((row + 0.5) / 9 * SIZE[1] - dent[1]) < 1.5 * SIZE[1] / 9


def test_parts_of_the_image_without_a_board_are_named():
    corners = see(poses(12, 6, right=(-0.14, -0.06)), 7)
    result = calibrate(corners, BOARD, SIZE)
    image = image_map(result, corners, 0)
    assert "right" in image.empty
    assert "middle" not in image.empty
    assert image.covered == pytest.approx(np.mean((image.corners > 0)[image.common]))
    assert image.corners.sum() == 12 * BOARD.corners
    # the pair's own geometry: 0.2794 m at 3 m and 2701 px, and a turn of 0.05: cam0's left rim is not seen by cam1
    assert not image.common[:, 0].any()
    assert image.common[4, 6]


def test_held_out_views_of_a_good_session_fit_as_well():
    corners = see(poses(15, 4), 5)
    found = cross_validate(calibrate(corners, BOARD, SIZE), corners)
    assert found.folds == 5
    assert 1.0 < found.noise_ratio < 1.15
    assert found.leaning.size == 0
    # triangulation at about 1.3 m: z²/(f·b) · √2 · 0.05 px = 0.16 mm, mostly along the ray
    assert np.median(found.board_rms_mm) == pytest.approx(0.17, rel=0.4)
    assert found.warnings([]) == []


def test_cross_validation_exposes_a_view_that_the_fit_bent_to():
    """Half a millimetre of movement between the two pictures: too little to stand out in the fit."""
    good, moved = poses(15, 7), pose_matrix([0, 0, 0], [0.0005, 0, 0])
    corners = see(good, 8)
    corners[1, 5] = see([pose @ moved for pose in good], 8)[1, 5]
    result = calibrate(corners, BOARD, SIZE)
    assert not result.rejected
    found = cross_validate(result, corners)
    assert found.leaning.tolist() == [5]
    assert found.view_rms_px[5] > 2 * found.fitted_view_rms_px[5]
    assert any("view 5" in text for text in found.warnings([f"view {i}" for i in range(15)]))


def test_cross_validation_exposes_too_few_views():
    corners = see(poses(4, 15), 16)
    found = cross_validate(calibrate(corners, BOARD, SIZE, CalibrationSettings(nominal_board=True)), corners)
    assert found.noise_ratio > 1.5
    assert found.rms_px > 1.5 * found.fitted_rms_px
    assert any("more views" in text for text in found.warnings([""] * 4))
    few = corners[:, :3]
    assert cross_validate(calibrate(few, BOARD, SIZE, CalibrationSettings(nominal_board=True)), few) is None


def test_cross_validation_holds_out_from_both_stages_of_the_papers_way():
    corners = see(poses(12, 4), 5, print_m=0.0)
    result = calibrate(corners, BOARD, SIZE, CalibrationSettings(Method.paper))
    quality = judge(result, corners, BOARD, 4)
    assert quality.cross_validation.folds == 4
    # a camera alone is weaker than the pair: the held-out views show it, mildly
    assert 0.95 < quality.cross_validation.noise_ratio < 1.4
    assert quality.next_view is None
    assert quality.uncertainty == []


def test_views_add_up_to_the_calibrations_covariance():
    corners = see(poses(8, 4), 5)
    corners[0, 2, :20] = np.nan
    result = calibrate(corners, BOARD, SIZE, CalibrationSettings(nominal_board=True, flatness_m=5e-4))
    seen = np.isfinite(corners[..., 0])
    everywhere = np.ones(BOARD.corners, bool)
    total = prior_information(result.estimate, result.freedom, everywhere)
    for index, view in enumerate(result.estimate.views):
        alone = type(result.estimate)(
            result.estimate.intrinsics, result.estimate.stereo, view[None], result.board_m, result.estimate.height_m
        )
        information, to_parameters = view_information(alone, result.freedom, seen[:, index], everywhere)
        total = total + information
    size = 1 / np.sqrt(np.diag(total))
    inverse = size[:, None] * np.linalg.inv(total * np.outer(size, size)) * size
    np.testing.assert_allclose(
        np.diag(result.sigma_px**2 * to_parameters @ inverse @ to_parameters.T),
        np.diag(result.pair.covariance),
        rtol=1e-5,  # condition 1e8 of the scaled matrix
    )


def test_advice_names_the_side_that_is_missing_and_keeps_its_promise():
    seen = poses(12, 9, right=(-0.14, 0.0))
    result = calibrate(see(seen, 10), BOARD, SIZE)
    points = grid_points()
    advice = advise(result, BOARD, points)
    assert advise(result, BOARD, points[:0]) is None
    assert "right" in advice.place
    assert "right" in advice.text
    assert f"{advice.range_m:.1f} m" in advice.text
    nearest_m, farthest_m = (2701.0 * 0.27 / (share * SIZE[0]) for share in (max(SHARES), min(SHARES)))
    assert nearest_m - 0.01 < advice.range_m < farthest_m + 0.01
    worst_mm = max(uncertainty_map(result.pair, range_m).worst_mm for range_m in RANGES_M)
    assert advice.worst_sigma_mm == pytest.approx(worst_mm, rel=0.02)  # its own grid is by the calibrated cameras
    assert advice.then_worst_sigma_mm < 0.6 * advice.worst_sigma_mm
    assert advice.T_cam0_board[2, 3] == pytest.approx(advice.range_m)
    after = calibrate(see([*seen, advice.T_cam0_board], 10), BOARD, SIZE)
    now_mm = max(uncertainty_map(after.pair, range_m).worst_mm for range_m in RANGES_M)
    # the noise found is 1.5 % off, and the curvature is that at another estimate
    assert now_mm == pytest.approx(advice.then_worst_sigma_mm, rel=0.1)


def test_advice_for_a_pair_that_is_turned_in_keeps_its_promise():
    """Axes that meet at 0.45 m, as for a specimen on a table; at 3 m nothing is seen by both cameras."""
    K = [[7000.0, 0, 1223.5], [0, 7000.0, 1023.5], [0, 0, 1]]
    camera = CameraModel(2448, 2048, K, [-0.1, 0.2, 0, 0, 0])
    turn = pose_matrix([0.0, np.radians(20.0), 0.0], [0, 0, 0])
    centre1 = pose_matrix([0, 0, 0], [-0.45 * np.tan(np.radians(20.0)), 0, 0])
    pair, board = StereoPair(camera, camera, turn @ centre1), Board(10, 7, 0.01)
    np.testing.assert_allclose(pair.middle_of_view(0.45), [0, 0, 0.45], atol=1e-9)
    rng = np.random.default_rng(11)
    seen = []
    for _ in range(12):  # none nearer than 0.43 m
        tilt = rng.uniform(0.2, 0.5) * np.exp(1j * rng.uniform(0, 2 * np.pi))
        facing = pose_matrix([tilt.real, tilt.imag - np.radians(10.0), rng.uniform(-0.3, 0.3)], [0, 0, 0])
        seen.append(pose_matrix([0, 0, 0], [*rng.uniform(-0.01, 0.01, 2), rng.uniform(0.43, 0.47)]) @ facing)
    result = calibrate(see(seen, 12, print_m=1e-5, pair=pair, board=board), board, (2448, 2048))
    ranges_m = working_ranges_m(result)
    assert all(0.42 < range_m < 0.48 for range_m in ranges_m)
    quality = judge(result, see(seen, 12, print_m=1e-5, pair=pair, board=board), board, 0)
    assert quality.images[0].common.mean() > 0.5
    assert [each.range_m for each in quality.uncertainty] == list(ranges_m)
    advice = quality.next_view
    assert advice.worst_sigma_mm == pytest.approx(max(each.worst_mm for each in quality.uncertainty), rel=1e-6)
    assert advice.then_worst_sigma_mm < 0.9 * advice.worst_sigma_mm
    after = calibrate(see([*seen, advice.T_cam0_board], 12, print_m=1e-5, pair=pair, board=board), board, (2448, 2048))
    now_mm = max(uncertainty_map(after.pair, range_m).worst_mm for range_m in ranges_m)
    assert now_mm == pytest.approx(advice.then_worst_sigma_mm, rel=0.1)  # as above


def test_the_board_comes_nearer_with_the_edge_that_the_advice_names():
    corners = np.column_stack([BOARD.points_m, np.zeros(BOARD.corners)])
    for tilt, words in TILTS.items():
        depth = (corners @ pose_matrix([*(0.5 * np.array(tilt)), 0.0], np.zeros(3))[:3, :3].T)[:, 2]
        x, y = BOARD.points_m.T
        nearer = {
            "top comes": depth[y < 0].mean() < -0.01,
            "bottom comes": depth[y > 0].mean() < -0.01,
            "right side comes": depth[x > 0].mean() < -0.01,
            "left side comes": depth[x < 0].mean() < -0.01,
        }
        assert [edge for edge, near in nearer.items() if near] == [edge for edge in nearer if edge in words]


@pytest.mark.parametrize("seed", [1, 2])
def test_a_bow_is_found_and_costs_a_flat_board_its_accuracy(seed):
    x, y = (BOARD.points_m / np.linalg.norm(BOARD.points_m, axis=1).max()).T
    height_m = 3e-4 * (x * x + 0.3 * y * y - 0.4 * x * y)
    corners = see(poses(15, 4), seed, height_m=height_m)
    flat = calibrate(corners, BOARD, SIZE)
    bowed = calibrate(corners, BOARD, SIZE, CalibrationSettings(flatness_m=5e-4))
    assert bowed.gradient < 1e-6
    assert bowed.sigma_px == pytest.approx(NOISE_PX, rel=0.06)
    assert flat.sigma_px > 1.2 * bowed.sigma_px
    # five sigma; the sigma itself is to be of use
    assert np.all(np.abs(bowed.estimate.height_m - height_m) < 5 * bowed.height_sigma_m + 1e-12)
    assert bowed.height_sigma_m.max() < 2e-5
    error = bowed.pair.parameters - PAIR.parameters
    assert error @ np.linalg.solve(bowed.pair.covariance, error) < 60  # χ² with 24, 1e-4
    error = flat.pair.parameters - PAIR.parameters
    assert error @ np.linalg.solve(flat.pair.covariance, error) > 60


def test_a_flat_board_is_found_flat_and_stays_so_by_default():
    corners = see(poses(15, 4), 5)
    free = calibrate(corners, BOARD, SIZE, CalibrationSettings(flatness_m=5e-4))
    assert np.all(np.abs(free.estimate.height_m) < 4 * free.height_sigma_m + 1e-12)
    held = calibrate(corners, BOARD, SIZE)
    assert np.all(held.estimate.corners_m[:, 2] == 0.0)
    assert np.all(held.height_sigma_m == 0.0)
    # a prior far tighter than the corners decides
    tight = calibrate(corners, BOARD, SIZE, CalibrationSettings(flatness_m=1e-8))
    assert np.all(np.abs(tight.estimate.height_m) < 5e-8)
