"""Cameras that move against the fuselage: found from its lights, and taken out of the markers, against known motion."""

import dataclasses

import cv2
import numpy as np
import pytest
from mounted_pair import mounted

from process.camera_model import MarkerLayout, ReferenceLight
from process.fuselage_lights import LightSpots, lights_table
from process.triangulate import triangulate
from reconstruct.fit import fit_each, marker_problem
from reconstruct.prior import STATED
from reconstruct.random_walk import Strength, likeliest, smoothed
from reconstruct.root_motion import RootMotion, root_motion, sigma_by_motion, with_motion
from reconstruct.tables import Centroids, MarkerSeries, SetMotion

SIGMA_PX = 0.02
STEP_NS = 40_000_000
LIGHTS_M = np.array(
    [[-0.26, 0.42, 0.22], [0.3, 0.46, 0.1], [-0.22, 0.62, -0.1], [0.24, 0.66, 0.36], [-0.2, 0.8, 0.4], [0.26, 0.84, 0]]
)
TIP_M = np.array([0.0, 2.9, 0.5])


def seen_px(side, points_m, change):
    """(N, 2, 2) pixels, by OpenCV, of body points in both cameras of a pair that has turned and shifted."""
    pose = side.T_body_cam0.copy()
    pose[:3, :3] = cv2.Rodrigues(np.asarray(change[:3]))[0] @ pose[:3, :3]
    pose[:3, 3] += change[3:]
    pixels = []
    for camera, T in ((side.pair.cam0, np.eye(4)), (side.pair.cam1, side.pair.T_cam1_cam0)):
        at = T @ np.linalg.inv(pose)
        pixels.append(cv2.projectPoints(points_m, cv2.Rodrigues(at[:3, :3])[0], at[:3, 3], camera.K, camera.distortion))
    return np.stack([found[0][:, 0] for found in pixels], axis=1)


def referenced(rng=None, *, survey=True):
    """A right pair with lights on the fuselage; the survey's pictures have the noise of one frame."""
    side = mounted(1.0)
    pixels = seen_px(side, LIGHTS_M, np.zeros(6))
    if rng is not None:
        pixels = pixels + rng.normal(0.0, SIGMA_PX, pixels.shape)
    lights = tuple(
        ReferenceLight(f"F{k}", tuple(place), 3e-4, tuple(map(tuple, seen)) if survey else None)
        for k, (place, seen) in enumerate(zip(LIGHTS_M.tolist(), pixels.tolist(), strict=True))
    )
    return dataclasses.replace(side, references=lights)


def flight(side, changes, rng, spoil=lambda trigger, pixels: None):
    sets = []
    for trigger, change in enumerate(changes):
        pixels = seen_px(side, LIGHTS_M, change) + rng.normal(0.0, SIGMA_PX, (len(LIGHTS_M), 2, 2))
        spoil(trigger, pixels)
        spread = np.tile(SIGMA_PX**2 * np.eye(2), (len(LIGHTS_M), 2, 1, 1))
        sets.append((trigger, trigger * STEP_NS, LightSpots(pixels, spread)))
    return lights_table("right", side, sets)


def motions(count, rng):
    """Drift of 1 mm and 1 mrad, vibration of a fifth of that."""
    time_s = np.arange(count) * STEP_NS * 1e-9
    size = 1e-3 * rng.normal(size=(2, 6))
    return np.sin(0.4 * time_s + 1.0)[:, None] * size[0] + 0.2 * np.sin(46.0 * time_s)[:, None] * size[1]


def at_tip(side, change):
    """(F, 3) what is measured there is wrong by."""
    return np.cross(change[:, :3], TIP_M - side.T_body_cam0[:3, 3]) + change[:, 3:]


def lever(side):
    x, y, z = TIP_M - side.T_body_cam0[:3, 3]
    return np.concatenate([[[0, z, -y], [-z, 0, x], [y, -x, 0]], np.eye(3)], axis=1)


def test_a_moving_mount_is_followed_within_its_sigmas():
    rng = np.random.default_rng(11)
    ratios = []
    for _ in range(8):
        side = referenced(rng)
        truth = motions(200, rng)
        found = root_motion(flight(side, truth, rng), "right", side)
        assert found.since == "survey"
        assert (found.motion.lights == 6).all()
        error = at_tip(side, found.motion.change - truth)
        spread = lever(side) @ found.motion.covariance @ lever(side).T
        assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 0.15e-3 < 0.5e-3 < np.linalg.norm(at_tip(side, truth)[:, 0])
        ratios.append(np.mean(np.einsum("fi,fij,fj->f", error, np.linalg.inv(spread), error)) / 3.0)
    # a sine is no random walk, and errors of one flight go together
    assert 0.5 < np.mean(ratios) < 1.6


def test_a_mount_that_stands_still_costs_nothing():
    rng = np.random.default_rng(12)
    errors, sigmas = [], []
    for _ in range(10):
        side = referenced(rng)
        motion = root_motion(flight(side, np.zeros((250, 6)), rng), "right", side).motion
        errors.append(np.linalg.norm(at_tip(side, motion.change), axis=1).max())
        sigmas.append(np.sqrt(np.trace(lever(side) @ motion.covariance @ lever(side).T, axis1=1, axis2=2)).max())
    # one set by itself would be 0.08 mm wrong
    assert np.median(errors) < 0.04e-3
    assert max(errors) < 0.1e-3
    assert np.median(sigmas) < 0.06e-3


def test_knocked_hidden_and_mistaken_lights():
    """One light is not where it was, another is a reflection now and then, and for ten sets all but two are hidden."""
    rng = np.random.default_rng(13)
    side = referenced(rng)
    truth = motions(200, rng)

    def spoil(trigger, pixels):
        pixels[1] += 4.0
        if trigger % 9 == 0:
            pixels[4, 0] += (3.0, -5.0)
        if 100 <= trigger < 110:
            pixels[:4] = np.nan

    found = root_motion(flight(side, truth, rng, spoil), "right", side).motion
    assert (found.lights[100:110] == 0).all()
    assert found.lights[99] == 4
    assert found.lights[50] == 5
    error = at_tip(side, found.change - truth)
    assert np.linalg.norm(np.delete(error, range(100, 110), axis=0), axis=1).max() < 0.5e-3
    sigma = np.sqrt(np.trace(lever(side) @ found.covariance @ lever(side).T, axis1=1, axis2=2))
    assert sigma[105] > 2 * sigma[50]  # vibration is not known there
    assert np.linalg.norm(error[100:110], axis=1).max() < 4 * sigma[105]


def test_without_the_surveys_pictures_motion_counts_from_the_flights_first_sets():
    rng = np.random.default_rng(14)
    side = referenced(survey=False)
    truth = motions(200, rng) + 1e-3  # it has moved before, by what nobody knows
    found = root_motion(flight(side, truth, rng), "right", side)
    assert found.since == "first sets"
    error = at_tip(side, found.motion.change - (truth - np.median(truth[:50], axis=0)))
    assert np.sqrt(np.mean(error**2)) < 0.1e-3


def test_too_few_lights_say_nothing():
    rng = np.random.default_rng(15)
    side = referenced(rng)

    def spoil(trigger, pixels):
        pixels[2:] = np.nan

    assert root_motion(flight(side, np.zeros((20, 6)), rng, spoil), "right", side) is None
    assert root_motion(flight(side, np.zeros((20, 6)), rng), "left", side) is None


def test_markers_and_pixels_are_put_where_they_are(xhale):
    """Seen by a pair that has turned by some milliradians, and by one camera only."""
    side, half = referenced(), xhale.half("right")
    layout = MarkerLayout((0.2, 0.5, 0.8, 1.2, 1.5, 1.8, 2.2, 2.5, 2.8), (0.04, -0.1), 0.0)
    node = half.marker_node
    truth = half.rest_position_m[node] + np.einsum(
        "mab,mb->ma", half.beam.R_body_root[None].repeat(len(node), 0), half.marker_offset_m
    )
    change = np.array([[3e-3, -2e-3, 4e-3, 1e-3, -2e-3, 1.5e-3]])
    pixels = seen_px(side, truth, change[0])
    eye = np.broadcast_to(np.eye(2), (len(node), 2, 2))
    points = triangulate(side, pixels[:, 0], pixels[:, 1], eye, eye, "default")
    centroids = Centroids(pixels[None], np.ones((1, 18, 2, 2, 2)), np.zeros((1, 18, 2), int), np.zeros((1, 18)))
    series = MarkerSeries(
        "right", np.arange(18), np.array([7]), np.zeros(1, int), np.zeros((1, 18), int), points.xyz_m[None],
        points.covariance_m2[None], np.full((1, 18), "", object), np.zeros(1), np.full(1, "", object), centroids,
    )  # fmt: skip
    series.xyz_m[0, 5] = np.nan
    root = RootMotion(
        np.array([7]), SetMotion(change, np.zeros((1, 6, 6)), np.array([6]), side.T_body_cam0[:3, 3]), "survey"
    )
    moved = with_motion(series, root, side, layout)
    seen = np.arange(18) != 5
    assert np.abs(series.xyz_m[0, seen] - truth[seen]).max() > 5e-3
    np.testing.assert_allclose(moved.xyz_m[0, seen], truth[seen], atol=1e-8)
    assert moved.motion.lights.tolist() == [6]
    at_rest = seen_px(side, truth, np.zeros(6))
    off = np.abs(moved.centroids.pixels[0] - at_rest).max(axis=(1, 2))
    assert np.abs(pixels - at_rest).max() > 4.0
    assert off[seen].max() < 1e-5
    assert off[5] < 0.01  # its distance is known by its neighbours only


def test_a_set_without_frames_of_both_cameras_has_its_neighbours_motion():
    change = np.arange(12.0).reshape(2, 6)
    motion = SetMotion(change, np.zeros((2, 6, 6)), np.array([6, 5]), np.zeros(3))
    found = RootMotion(np.array([10, 14]), motion, "survey").of(np.array([3, 10, 11, 13, 14, 20]))
    np.testing.assert_array_equal(found.change, change[[0, 0, 0, 1, 1, 1]])
    assert found.lights.tolist() == [0, 6, 0, 0, 5, 0]


def test_the_shape_follows_a_motion_that_was_not_known_as_its_sigma_says(xhale, closed_form):
    half = xhale.half("right")
    truth = closed_form(half, 0.2, 1.0, 0.0)
    changes = np.concatenate([np.zeros((1, 6)), 1e-4 * np.eye(6)])
    centre = np.array([-0.1, -0.2, 0.08])
    turned = np.cross(changes[:, None, :3], truth.markers_m - centre) + changes[:, None, 3:]
    cov = np.broadcast_to(0.5e-3**2 * np.eye(3), (7, 18, 3, 3))
    fits = fit_each(marker_problem(half, truth.markers_m + turned, cov, xhale.fit), xhale.fit, STATED)
    motion = SetMotion(np.zeros((7, 6)), changes[:, :, None] * changes[:, None], np.full(7, 6), centre)
    sigma = sigma_by_motion(half, fits, motion)
    assert sigma[1:, -1, :3].max() > 1e-4
    np.testing.assert_allclose(sigma[..., :3], np.abs(fits.position_m - fits.position_m[0]), atol=3e-6)
    np.testing.assert_allclose(sigma[..., 3], np.abs(fits.twist_rad - fits.twist_rad[0]), atol=3e-6)


@pytest.mark.parametrize("shake", [0.0, 2.0])
@pytest.mark.parametrize("walk", [0.0, 5.0])
@pytest.mark.parametrize("start", [0.0, 30.0])
def test_smoothing_is_the_gaussian_conditional(shake, walk, start):
    """All values at once, by their covariance matrices; two were not measured."""
    rng = np.random.default_rng(16)
    time_s = np.cumsum(rng.uniform(0.05, 0.5, 12))
    variances = rng.uniform(0.5, 2.0, 12)
    variances[[4, 5]] = np.inf
    values = rng.normal(0.0, 3.0, 12)
    strength = Strength(np.array([walk]), np.array([shake]), np.array([start]), 0.7)
    mean, spread = smoothed(time_s, values[:, None], variances[:, None], strength)
    walked = walk * (np.minimum.outer(time_s, time_s) - time_s[0])
    wanted = walked + start + shake * np.eye(12)
    known = np.isfinite(variances)
    whole = (wanted + 0.7)[np.ix_(known, known)] + np.diag(variances[known])
    gain = wanted[:, known] @ np.linalg.inv(whole)
    np.testing.assert_allclose(mean[:, 0], gain @ values[known], atol=1e-9)
    np.testing.assert_allclose(spread[:, 0], np.diag(wanted - gain @ wanted[known]), atol=1e-9)


def test_strengths_are_found_to_an_order_of_magnitude():
    rng = np.random.default_rng(17)
    time_s = np.arange(1500) * 0.04
    walk, shake = np.array([0.0, 10.0, 0.0]), np.array([0.0, 0.0, 10.0])
    drift = np.cumsum(rng.normal(size=(1500, 3)) * np.sqrt(walk * 0.04), axis=0)
    values = drift + rng.normal(size=(1500, 3)) * np.sqrt(shake + 1.0)
    strengths, weights = likeliest(time_s, values, np.ones((1500, 3)), 1.0, moved_before=False)
    np.testing.assert_allclose(weights.sum(axis=0), 1.0)
    found = strengths[0]
    assert found.walk[0] <= 1e-3
    assert found.shake[0] <= 0.03
    assert 1.0 <= found.walk[1] <= 100.0
    assert found.shake[1] <= 0.3
    assert 3.0 <= found.shake[2] <= 100.0
