"""The bulb's geometry against the outline of a dome drawn point by point, and its errors by chance."""

import dataclasses

import cv2
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from process.bulb import DOME, bases_m, by_dome, centre_pixels, centres_m, wing_normals
from process.camera_model import Light, MarkerLayout, RigSide
from process.pipeline import markers
from process.shared_error import (
    Surface,
    displacement_covariance_m2,
    light_of,
    point_covariance_m2,
    shared_jacobian,
    with_rig,
)
from process.triangulate import triangulate

LIGHT = Light(standoff_m=0.004, standoff_sigma_m=0.0005, dome_radius_m=0.0015, dome_sigma_m=0.0002)


def outline_centre_px(camera, T_camera_body, centre, normal, radius):
    """Centroid of the picture's outline of a half ball with its flat side down, by OpenCV's projection of its hull."""
    rng = np.random.default_rng(1)
    ball = rng.normal(size=(20_000, 3))
    ball /= np.linalg.norm(ball, axis=1)[:, None]
    height = ball @ normal
    rim = ball - height[:, None] * normal
    rim /= np.linalg.norm(rim, axis=1)[:, None]
    points = centre + radius * np.concatenate([ball[height > 0], rim[:5000]])
    pixels = cv2.projectPoints(
        points, cv2.Rodrigues(T_camera_body[:3, :3])[0], T_camera_body[:3, 3], camera.K, camera.distortion
    )[0].reshape(-1, 2)
    corners = pixels[ConvexHull(pixels).vertices]
    x, y = (corners - corners[0]).T
    cross = x * np.roll(y, -1) - np.roll(x, -1) * y
    area = cross.sum() / 2
    middle = [np.sum((a + np.roll(a, -1)) * cross) / (6 * area) for a in (x, y)]
    return corners[0] + middle


def outlines(world, side_name, centres, normals, radius):
    side = world.rig.side(side_name)
    in_cam0 = np.linalg.inv(side.T_body_cam0)
    poses = (in_cam0, side.pair.T_cam1_cam0 @ in_cam0)
    return [
        np.array([outline_centre_px(c, T, p, n, radius) for p, n in zip(centres, normals, strict=True)])
        for c, T in zip((side.pair.cam0, side.pair.cam1), poses, strict=True)
    ]


def seen(side, pixels):
    eye = np.broadcast_to(np.eye(2), (len(pixels[0]), 2, 2))
    return triangulate(side, *pixels, eye, eye, "default").xyz_m


def test_the_centre_of_a_dome_is_found_from_its_outlines(world):
    side, places = world.rig.right, world.markers_m("right", -0.02, 0.05)[4:8]
    for tilt in ([0.0, 0.0, 1.0], [0.1, -0.5, 0.85], [0.0, -0.98, 0.2]):  # seen along the surface, and from above
        normals = np.tile(np.array(tilt) / np.linalg.norm(tilt), (len(places), 1))
        # a ball of 8 mm: four times a bulb's, so that what perspective leaves out (r²/z) would show
        apparent = seen(side, outlines(world, "right", places, normals, 0.004))
        found = centres_m(side, dataclasses.replace(LIGHT, dome_radius_m=0.004), apparent, normals)
        assert np.linalg.norm(found - places, axis=1).max() < 2e-5
        if tilt[2] == 1.0:
            assert np.linalg.norm(apparent - places, axis=1).min() > 0.8e-3  # what it would be wrong by


def test_the_centres_pixels_are_found_of_a_light_in_one_camera_too(world):
    side, places = world.rig.right, world.markers_m("right", 0.08, 0.05)
    radius = 0.004
    layout = dataclasses.replace(world.rig.markers, light=dataclasses.replace(LIGHT, dome_radius_m=radius))
    normals = wing_normals("right", layout, places)
    apparent = np.stack(outlines(world, "right", places, normals, radius), axis=1)
    apparent[6, 1] = np.nan
    known = np.where(np.arange(18)[:, None] == 6, np.nan, places)
    found = centre_pixels(side, layout, "right", known[None], apparent[None])[0]
    true = np.stack(world.project("right", places), axis=1)
    seen_there = np.isfinite(apparent[:, :, 0])
    assert np.linalg.norm(found - true, axis=2)[seen_there].max() < 0.1  # of 0.2 m away: perspective
    assert np.linalg.norm(apparent - true, axis=2)[:6][seen_there[:6]].min() > 0.3
    assert np.isnan(found[6, 1]).all()


@pytest.mark.parametrize("side_name", ["left", "right"])
def test_normals_are_the_wings(world, side_name):
    layout, flat = world.rig.markers, world.markers_m(side_name, 0.0)
    np.testing.assert_allclose(wing_normals(side_name, layout, flat), np.tile([0.0, 0.0, 1.0], (18, 1)), atol=1e-5)
    bent = world.markers_m(side_name, 0.15)
    angle = 0.15 * np.repeat(layout.pairs_station_m, 2)
    out = 1.0 if side_name == "right" else -1.0
    truth = np.stack([np.zeros(18), -out * np.sin(angle), np.cos(angle)], axis=1)

    def off_rad(normals):
        return np.linalg.norm(np.cross(normals, truth), axis=1).max()

    # a parabola over steps h of an arc of curvature κ: (κ h)² / 3 at its ends
    assert off_rad(wing_normals(side_name, layout, bent)) < (0.15 * 0.4) ** 2 / 2
    holes = np.stack([bent, bent])
    holes[0, [0, 5, 16, 17]] = np.nan
    holes[1, 6:] = np.nan
    holes[1, 0] = np.nan
    found = wing_normals(side_name, layout, holes)
    assert off_rad(found[0]) < 3 * (0.15 * 0.4) ** 2
    assert np.isnan(found[1]).all()  # two lights of the fore row do not make a parabola


def rigid(world):
    known = world.rig.right
    pair = dataclasses.replace(known.pair, covariance=np.eye(24) * 1e-30)
    return RigSide(pair, known.T_body_cam0, "0", "1", 0.0, np.eye(6) * 1e-30)


def test_errors_of_stand_off_and_dome_are_what_they_do(world):
    side = rigid(world)
    centres = world.markers_m("right", 0.1, 0.04)
    normals = wing_normals("right", world.rig.markers, centres)
    apparent = centres + DOME * LIGHT.dome_radius_m * by_dome(side, centres, normals)
    jacobian = shared_jacobian(side, centres, Surface(LIGHT, normals))
    assert jacobian.shape == (18, 3, 32)
    base = bases_m(LIGHT, centres_m(side, LIGHT, apparent, normals), normals)
    np.testing.assert_allclose(base, centres - 0.004 * normals, atol=2e-6)
    for column, changed in (
        (30, dataclasses.replace(LIGHT, standoff_m=0.0045)),
        (31, dataclasses.replace(LIGHT, dome_radius_m=0.0015 + 0.0002 / DOME)),
    ):
        moved = bases_m(changed, centres_m(side, changed, apparent, normals), normals) - base
        step = 0.0005 if column == 30 else 0.0002
        np.testing.assert_allclose(jacobian[:, :, column] * step, moved, atol=1e-6)


def test_a_displacement_feels_a_stand_off_as_the_wing_turns(world):
    side = rigid(world)
    rest, bent = world.markers_m("right", 0.0), world.markers_m("right", 0.15)
    light = Light(0.004, 0.0005)
    surfaces = tuple(Surface(light, wing_normals("right", world.rig.markers, points)) for points in (rest, bent))
    point = point_covariance_m2(side, bent, surfaces[1])[17]
    assert np.sqrt(np.trace(point)) == pytest.approx(0.0005, rel=1e-3)
    moved = displacement_covariance_m2(side, rest, bent, surfaces)[17]
    turn = np.linalg.norm(surfaces[1].normals[17] - surfaces[0].normals[17])
    assert 0.3 < turn < 0.45  # 0.15 · 2.8 m
    assert np.sqrt(np.trace(moved)) == pytest.approx(0.0005 * turn, rel=1e-3)
    np.testing.assert_allclose(displacement_covariance_m2(side, rest, bent)[17], 0.0, atol=1e-20)


def test_the_rig_file_and_the_table_carry_the_light(world, tmp_path):
    layout = dataclasses.replace(world.rig.markers, light=LIGHT)
    rig = dataclasses.replace(world.rig, markers=layout)
    rig.write(tmp_path / "rig.json")
    assert type(rig).read(tmp_path / "rig.json").markers == layout
    import pyarrow as pa

    assert light_of(with_rig(pa.table({"x_m": [0.0]}), rig)) == LIGHT
    assert light_of(pa.table({"x_m": [0.0]})) == Light()
    plain = layout.to_dict()
    del plain["light"]  # files made before
    assert MarkerLayout.from_dict(plain).light == Light()


def test_the_marker_table_has_the_lights_centres(tmp_path, small_world, painter, recording_writer):
    """A flight of domes: their pictures' middles are off by up to 0.6 mm, the table is not."""
    light = dataclasses.replace(LIGHT, dome_radius_m=0.006)
    rig = dataclasses.replace(small_world.rig, markers=dataclasses.replace(small_world.rig.markers, light=light))
    places = small_world.markers_m("right", -0.02)
    normals = wing_normals("right", rig.markers, places)
    writer = recording_writer(tmp_path / "right.mcap")
    for camera, pixels in enumerate(outlines(small_world, "right", places, normals, light.dome_radius_m)):
        canvas = painter(776, 1040, seed=camera)
        for u, v in pixels:
            canvas.add(u, v, 0.6, 0.7, 140)
        writer.frame("right", f"cam{camera}", 0, canvas.image(), 1_700_000_000_000_000_000)
    writer.close()
    table, apparent = (markers([tmp_path], which, workers=1).table for which in (rig, small_world.rig))
    error, raw = (t.column("z_m").to_numpy()[:12] - places[:12, 2] for t in (table, apparent))  # farther ones run into
    # each other in this small picture
    assert np.abs(error).max() < 3e-4  # noise: 0.03 px at 1.8 m and f = 700 px is 0.08 mm
    assert raw.min() > 1.5e-3
