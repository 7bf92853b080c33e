"""What a plan promises, against closed forms and against what a rendered calibration then has."""

import functools
import json

import numpy as np
import pytest
from typer.testing import CliRunner

from capture.errors import UsageError
from capture.record import CAMERAS
from hw_sim import optics
from hw_sim.accuracy_scenes import SIDE, accuracy_world
from hw_sim.board import board_poses, corners_m
from process.board import Board
from process.calibrate import calibrate, calibration_covariance_m2
from process.camera_model import MarkerLayout, RigSide
from process.cli import app
from process.plan import CORNER_SIGMA_PX, Mount, calibrated, ideal_pair, predict
from process.rig import approximate_pose
from process.triangulate import triangulate

BOARD = Board(10, 7, 0.030)
LAYOUT = MarkerLayout((0.5, 1.5, 2.8), (0.04, -0.10), 0.004)


def mount(focal_mm: float) -> Mount:
    return Mount(focal_mm, 2.5, (2080, 1552), 0.2794, (0.03, -0.2, 0.08), (0.0, 0.99, 0.14))


def test_noise_follows_the_textbook():
    """Range error Z² σ √2 / (B f), across it Z σ / (√2 f) or so: along the wing 2 Z / B times as much."""
    ahead = MarkerLayout(LAYOUT.pairs_station_m, (-0.02, -0.04), 0.004)  # near the axis: x is across the view
    prediction = predict(mount(3.5), ideal_pair(mount(3.5)), ahead, 0.0, 0.003)
    assert prediction.in_view.all()
    assert prediction.field_of_view_deg[0] == pytest.approx(2 * np.degrees(np.arctan(1040 / 1400)))
    distance_m = prediction.places_m[-1, 1] + 0.2
    ratio = prediction.noise_mm[-1, 1] / prediction.noise_mm[-1, 0]
    assert ratio == pytest.approx(2 * distance_m / 0.2794, rel=0.1)
    assert np.isnan(prediction.calibration_mm).all()  # no calibration was planned


def test_a_longer_lens_sees_less_and_measures_better():
    wide, long = (predict(mount(f), ideal_pair(mount(f)), LAYOUT, 0.0, 0.003) for f in (3.5, 10.0))
    assert wide.in_view.all()
    assert not long.in_view[:2].any()
    assert np.isnan(long.noise_mm[~long.in_view]).all()
    assert np.all(long.noise_mm[-1] < 0.5 * wide.noise_mm[-1])


def test_the_planned_calibration_is_like_a_rendered_one():
    """15 rendered views at F = 6.75 mm were calibrated to sigmas of 0.076, 0.032, 0.111 mm at 2 m; views differ."""
    planned = mount(6.75)
    pair = calibrated(ideal_pair(planned), BOARD, 15)
    covariance = calibration_covariance_m2(pair, np.array([[0.14, 0.0, 2.0]]))[0]
    np.testing.assert_allclose(1000 * np.sqrt(np.diag(covariance)), [0.076, 0.032, 0.111], rtol=0.6)


@pytest.mark.slow
@pytest.mark.parametrize("focal_mm", [3.5, 6.75, 10.0])
def test_the_plan_agrees_with_the_calibrations_of_the_accuracy_test(focal_mm):
    """Errors of markers over eight sessions of `wingproc accuracy`, corners by the simulation's own optics."""
    planned = mount(focal_mm)
    pair = calibrated(ideal_pair(planned), BOARD, 15)
    prediction = predict(planned, pair, LAYOUT, 0.2, 0.003)
    seen = prediction.in_view
    pose = approximate_pose(pair, np.array(planned.position_m), np.array(planned.outboard))
    points = (prediction.places_m[seen] - pose[:3, 3]) @ pose[:3, :3]
    squares = np.mean([np.sum(errors_mm(seed, focal_mm, points) ** 2, axis=1) for seed in range(100, 108)], axis=0)
    ratio = np.sqrt(squares / np.sum(prediction.calibration_mm[seen] ** 2, axis=1))
    # eight draws of about two numbers each, shared by all markers: 1 ± 0.18; and the sessions' views are not the plan's
    assert np.all((ratio > 0.5) & (ratio < 1.7)), ratio


@pytest.mark.slow
def test_calibration_costs_a_displacement_next_to_nothing():
    """60 mm up at 2 m, as a tip that bends; F = 6.75 mm."""
    y, x = np.meshgrid([-0.2, 0.0, 0.2], [0.0, 0.14, 0.28])
    before = np.column_stack([x.ravel(), y.ravel(), np.full(9, 2.0)])
    both = np.concatenate([before, before - [0.0, 0.06, 0.0]])
    for seed in range(100, 104):
        first, second = np.split(errors_mm(seed, 6.75, both), 2)
        wrong_mm = np.linalg.norm(second - first, axis=1)
        assert np.median(wrong_mm) < 0.01, seed
        assert wrong_mm.max() < 0.02, seed


@functools.cache
def session(seed, focal_mm):
    """The cameras of one session of `wingproc accuracy`, and its calibration."""
    world = accuracy_world(seed, focal_mm)
    cameras = [world.camera(SIDE, name) for name in CAMERAS]
    printed = corners_m(world).reshape(-1, 3)
    shown = [printed @ pose[:3, :3].T + pose[:3, 3] for pose in board_poses(world, SIDE)]
    corners = np.array([[optics.project(camera, points) for points in shown] for camera in cameras])
    corners += np.random.default_rng(seed).normal(0.0, CORNER_SIGMA_PX, corners.shape)
    return cameras, calibrate(corners, BOARD, (world.sensor.width_px, world.sensor.height_px)).pair


def errors_mm(seed, focal_mm, points_cam0):
    """(N, 3) of points that are seen without noise by the cameras of one calibrated session."""
    cameras, found = session(seed, focal_mm)
    body = np.array(cameras[0].T_body_cam)
    pixels = [optics.project(camera, points_cam0 @ body[:3, :3].T + body[:3, 3]) for camera in cameras]
    alike = np.broadcast_to(np.eye(2), (len(points_cam0), 2, 2))
    placed = triangulate(RigSide(found, np.eye(4), "", "", 0.0), *pixels, alike, alike, "default").xyz_m
    return 1000.0 * (placed - points_cam0)


def test_the_command():
    options = ["plan", "--focal-mm", "3.5", "--pairs-m", "0.5,1.5,2.8", "--views", "8"]
    done = CliRunner().invoke(app, [*options, "--json"], catch_exceptions=False)
    (found,) = json.loads(done.stdout)["mounts"]
    assert found["markers_in_view"] == 6
    assert all(0.01 < sigma < 5.0 for sigma in found["markers"][5]["calibration_sigma_mm"])
    assert "6 of 6 markers in view" in CliRunner().invoke(app, options, catch_exceptions=False).stdout


@pytest.mark.parametrize(
    "wrong", [["--pairs-m", "1,a"], ["--pairs-m", "2,1"], ["--position-m", "1,2"], ["--size-px", "9"]]
)
def test_wrong_options_are_refused(wrong):
    with pytest.raises(UsageError, match=wrong[0]):
        CliRunner().invoke(app, ["plan", *wrong], catch_exceptions=False)
