"""The pose in the body frame against lights and mounts that are known."""

import json

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from capture.errors import ProcessError, UsageError
from process.camera_model import CameraModel, Rig, StereoPair, pose_matrix, write_pair
from process.cli import app
from process.detect import Detections
from process.pose_fit import triangulate_midpoint
from process.rig import approximate_pose, solve_pose
from process.survey import read_survey

CAMERA = CameraModel(
    2080, 1552, [[1403.0, 0, 1033.2], [0, 1401.5, 779.9], [0, 0, 1]], [-0.28, 0.12, 7e-4, -4e-4, -0.025]
)
PAIR = StereoPair(CAMERA, CAMERA, pose_matrix([0.004, -0.02, 0.003], [-0.2794, 0.001, -0.0005]))
MIDDLE_M, OUTBOARD = np.array([0.03, -0.2, 0.08]), np.array([0.0, 0.99, 0.14])
T_NOMINAL = approximate_pose(PAIR, MIDDLE_M, OUTBOARD)
T_TRUE = T_NOMINAL @ pose_matrix([0.012, -0.015, 0.010], [0.008, -0.006, 0.007])  # 1.2 deg, 12 mm off
SURVEY_SIGMA_M, SPOT_SIGMA_PX = 0.3e-3, 0.03


def lights(count, seed):
    """True places, body frame, in view of both cameras and apart in the pictures."""
    rng = np.random.default_rng(seed)
    found = np.empty((0, 3))
    while len(found) < count:
        z = rng.uniform(0.6, 3.0)
        point = (
            np.array([rng.uniform(-0.3, 0.45) * z, rng.uniform(-0.3, 0.3) * z, z]) @ T_TRUE[:3, :3].T + T_TRUE[:3, 3]
        )
        trial = np.vstack([found, point])
        pixels = [in_pixels(trial, camera) for camera in (0, 1)]
        apart = all(len(trial) == 1 or np.linalg.norm(p[-1] - p[:-1], axis=1).min() > 60 for p in pixels)
        if apart and all(np.all((p > 20) & (p < [2059, 1531])) for p in pixels):
            found = trial
    return found


def in_pixels(points, camera):
    """By OpenCV."""
    T = np.linalg.inv(T_TRUE) if camera == 0 else PAIR.T_cam1_cam0 @ np.linalg.inv(T_TRUE)
    return cv2.projectPoints(points, T[:3, :3], T[:3, 3], CAMERA.K, CAMERA.distortion)[0].reshape(-1, 2)


def spots(points, camera, rng, extra=0):
    """Detections in any order, with ``extra`` reflections anywhere."""
    pixels = in_pixels(points, camera) + rng.normal(0.0, SPOT_SIGMA_PX, (len(points), 2))
    pixels = np.vstack([pixels, rng.uniform([0, 0], [2080, 1552], (extra, 2))])
    pixels = rng.permutation(pixels)
    ones = np.ones(len(pixels))
    # the solver adds its own floor of 0.03 px for what the models leave: no noise of the spot's own here
    return Detections(*pixels.T, np.zeros((len(pixels), 2, 2)), 100 * ones, 9 * ones, ones, ("",) * len(pixels))


def solve(points, seed=1, missing=(), extra=0, moved=None, surveyed=None):
    rng = np.random.default_rng(seed)
    places = points + rng.normal(0.0, SURVEY_SIGMA_M, points.shape) if surveyed is None else surveyed
    if moved is not None:
        places[moved] += [0.0, 0.0, 0.02]
    seen = np.delete(points, missing, axis=0)
    names = [f"P{number}" for number in range(len(points))]
    sigma = np.full(len(points), SURVEY_SIGMA_M)
    return solve_pose(PAIR, T_NOMINAL, names, places, sigma, spots(seen, 0, rng, extra), spots(points, 1, rng, extra))


def pose_error(T):
    """(6,) as camera_model.RigSide defines it: T_true = exp(ω) R, t + shift."""
    turn = cv2.Rodrigues(T_TRUE[:3, :3] @ T[:3, :3].T)[0].ravel()
    return np.concatenate([turn, T_TRUE[:3, 3] - T[:3, 3]])


def test_poses_are_recovered_within_their_covariance():
    points, total, runs = lights(10, 3), 0.0, 15
    for seed in range(runs):
        fit = solve(points, seed)
        assert all(point.used for point in fit.points)
        error = pose_error(fit.T_body_cam0)
        total += error @ np.linalg.solve(fit.covariance, error)
    # χ² with 6 · 15 degrees of freedom is 90 ± 13: four sigma; less where the covariance was enlarged by χ²/ν > 1
    assert 38 < total < 144


def test_reflections_and_hidden_lights_do_not_matter():
    points = lights(10, 4)
    fit = solve(points, 5, missing=[2, 7], extra=6)
    assert [point.name for point in fit.points if not point.used] == ["P2", "P7"]
    assert "no light where it should be in cam0" in fit.points[2].reason
    assert np.isnan(fit.points[2].error_body_m).all()
    assert np.linalg.norm(pose_error(fit.T_body_cam0)[3:]) < 2e-3


def test_a_wrongly_surveyed_light_is_left_out_and_its_error_shown():
    points = lights(10, 6)
    fit = solve(points, 7, moved=4)
    assert [point.name for point in fit.points if not point.used] == ["P4"]
    assert "check its coordinates" in fit.points[4].reason
    assert fit.points[4].error_body_m[2] == pytest.approx(-0.02, abs=0.002)


def test_too_few_lights_are_refused_with_the_reasons():
    points = lights(6, 8)
    with pytest.raises(ProcessError, match=r"3 of 6 .* needed .*P0: no light"):
        solve(points, 9, missing=[0, 1, 2])


def test_a_mount_far_from_the_survey_is_refused():
    points = lights(8, 10)
    with pytest.raises(ProcessError, match="0 of 8"):
        solve(points, 11, surveyed=points + np.array([0.5, 0.0, 0.3]))


def test_lights_in_a_line_do_not_give_a_pose():
    start = np.array([0.0, 0.8, 0.1])
    points = start + np.linspace(0, 1, 6)[:, None] * np.array([0.2, 1.8, 0.1])
    with pytest.raises(ProcessError, match=r"line|0 of 6"):
        solve(points, 12)


def test_midpoint_triangulation_is_exact_without_noise():
    points = np.array([[0.1, 0.2, 0.8], [-0.3, 0.1, 3.0]])
    in_cam1 = points @ PAIR.T_cam1_cam0[:3, :3].T + PAIR.T_cam1_cam0[:3, 3]
    found = triangulate_midpoint(PAIR, CAMERA.project(points), CAMERA.project(in_cam1))
    np.testing.assert_allclose(found, points, atol=1e-9)
    assert np.isnan(triangulate_midpoint(PAIR, [[1000, 700]], [[1700, 700]])).all()  # the rays meet behind


def side_toml(side, outboard_y):
    return f"""
[{side}]
cam0_image = "{side}0.png"
cam1_image = "{side}1.png"
cam0_serial = "{side}-0"
cam1_serial = "{side}-1"
approx_position_m = [0.03, {-0.2 if side == "right" else 0.2}, 0.08]
approx_outboard = [0.0, {outboard_y}, 0.14]
"""


def survey_toml(points):
    text = "row_time_us = 10.0\n[markers]\npairs_station_m = [0.2, 0.5]\nchord_m = [0.04, -0.10]\nheight_m = 0.004\n"
    for side, sign in (("left", -1), ("right", 1)):
        text += side_toml(side, 0.99 * sign)
        for number, point in enumerate(points):
            x, y, z = point if side == "right" else mirrored(point)
            text += f'[[{side}.points]]\nname = "{side}{number}"\nxyz_m = [{x}, {y}, {z}]\nsigma_mm = 0.3\n'
    return text


def mirrored(point):
    """Half a turn about z: the left pair then sees what the right pair sees (its x is mirrored with its y)."""
    return np.array([0.06 - point[0], -point[1], point[2]])


def draw(pixels):
    image = np.full((1552, 2080), 8.0)
    v, u = np.mgrid[-12:13, -12:13]
    for x, y in pixels:
        column, row = round(x), round(y)
        spot = 180 * np.exp(-((u + column - x) ** 2 + (v + row - y) ** 2) / (2 * 1.5**2))
        image[row - 12 : row + 13, column - 12 : column + 13] += spot
    return np.rint(image + np.random.default_rng(1).normal(0, 1, image.shape)).clip(0, 255).astype(np.uint8)


@pytest.fixture
def survey_folder(tmp_path):
    points = lights(8, 13)
    (tmp_path / "survey.toml").write_text(survey_toml(points))
    for camera in (0, 1):
        image = draw(in_pixels(points, camera))
        for side in ("left", "right"):
            cv2.imwrite(str(tmp_path / f"{side}{camera}.png"), image)
    write_pair(tmp_path / "pair.json", PAIR, camera_rms_px=(0.1, 0.1), stereo_rms_px=0.1, provenance={})
    return tmp_path


def command(folder):
    pair, survey, output = (str(folder / name) for name in ("pair.json", "survey.toml", "rig.json"))
    return CliRunner().invoke(
        app, ["rig", pair, pair, "--survey", survey, "-o", output, "--json"], catch_exceptions=False
    )


def test_the_command_writes_both_sides(survey_folder):
    done = command(survey_folder)
    assert done.exit_code == 0
    summary = json.loads(done.stdout)
    assert summary["left"]["points_used"] == summary["right"]["points_used"] == 8
    rig = Rig.read(survey_folder / "rig.json")
    assert rig.markers.chord_m == (0.04, -0.10)
    assert rig.left.row_time_ns == 10_000.0
    assert rig.left.cam1_serial == "left-1"
    # spots on noise of 1 grey at 180: 0.01 px, 0.1 mm at 2 m; the survey here is exact
    np.testing.assert_allclose(rig.right.T_body_cam0[:3, 3], T_TRUE[:3, 3], atol=5e-4)
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    half_turn[0, 3] = 0.06
    np.testing.assert_allclose(rig.left.T_body_cam0, half_turn @ T_TRUE, atol=5e-4)
    again = json.loads((survey_folder / "rig.json").read_text())
    assert "wingproc" in again["provenance"]["command"]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("height_m", "heigth_m", "markers.heigth_m: unknown key|markers.height_m"),
        ("row_time_us = 10.0", "row_time_us = 10.0\nshutter = 1", "shutter: unknown key"),
        ("sigma_mm = 0.3", "sigma_mm = -1", "left.points.0.sigma_mm"),
        ('"left1"', '"left0"', "points named twice: left0"),
        ('"left-1"', '"left-0"', "serial"),
        ("[0.0, 0.99, 0.14]", "[0.0, -0.99, 0.14]", "swapped"),
        ("[0.04, -0.10]", "[-0.10, 0.04]", "fore"),
        ("[0.2, 0.5]", "[0.5, 0.2]", "grow"),
        ("[markers]", "[markers", "not a TOML file"),
    ],
)
def test_a_wrong_survey_is_refused_by_file_and_key(survey_folder, old, new, message):
    path = survey_folder / "survey.toml"
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises((UsageError, ProcessError), match=message) as caught:
        read_survey(path)
    assert str(path) in str(caught.value)


def test_the_other_sides_pair_file_is_refused(survey_folder):
    """A pair that is alike but not the same: focal length 1 px, principal point 8 px, pose 0.2 deg away."""
    other = CameraModel(2080, 1552, CAMERA.K + np.array([[1.0, 0, 8.0], [0, 1.0, 0.5], [0, 0, 0]]), CAMERA.distortion)
    turned = PAIR.T_cam1_cam0 @ pose_matrix([0.0002, -0.004, -0.0005], [0.002, 0.0003, -0.0003])
    write_pair(
        survey_folder / "pair.json",
        StereoPair(CAMERA, other, turned),
        camera_rms_px=(0.1, 0.1),
        stereo_rms_px=0.1,
        provenance={},
    )
    causes = r"times worse than their sigmas.*other side's pair.*survey.*lens was touched"
    with pytest.raises(ProcessError, match=causes):
        command(survey_folder)
    assert not (survey_folder / "rig.json").exists()


def test_missing_files_are_named(survey_folder):
    (survey_folder / "right1.png").unlink()
    with pytest.raises(ProcessError, match=r"right1\.png"):
        command(survey_folder)
    (survey_folder / "survey.toml").unlink()
    with pytest.raises(ProcessError, match=r"survey\.toml: no such file"):
        command(survey_folder)
    (survey_folder / "pair.json").unlink()
    with pytest.raises(ProcessError, match=r"pair\.json: no such file; make it with `wingproc calibrate`"):
        command(survey_folder)


def test_pictures_of_another_size_are_refused(survey_folder):
    cv2.imwrite(str(survey_folder / "left0.png"), np.zeros((100, 100), np.uint8))
    with pytest.raises(ProcessError, match=r"left0\.png: 100x100 pixels, but the pair was calibrated at 2080x1552"):
        command(survey_folder)


def test_a_dark_picture_is_refused_with_its_name(survey_folder):
    cv2.imwrite(str(survey_folder / "left0.png"), np.zeros((1552, 2080), np.uint8))
    with pytest.raises(ProcessError, match=r"left0\.png.*0 of 8 surveyed lights.*other side's pair"):
        command(survey_folder)


def test_how_the_pose_moves_with_the_calibration():
    """Against fits of the same spots with other parameters."""
    points = lights(10, 21)
    rng = np.random.default_rng(2)
    places = points + rng.normal(0.0, SURVEY_SIGMA_M, points.shape)
    seen = spots(points, 0, rng), spots(points, 1, rng)
    names, sigma = [f"P{number}" for number in range(len(points))], np.full(len(points), SURVEY_SIGMA_M)
    fit = solve_pose(PAIR, T_NOMINAL, names, places, sigma, *seen)
    values = PAIR.parameters
    for index, step in ((0, 0.03), (2, 0.03), (4, 1e-5), (12, 0.03), (19, 1e-5), (21, 1e-5)):
        moved = np.empty((2, 4, 4))
        for k, sign in enumerate((1, -1)):
            pair = PAIR.with_parameters(values + sign * step * np.eye(24)[index])
            moved[k] = solve_pose(pair, T_NOMINAL, names, places, sigma, *seen).T_body_cam0
        between = moved[0, :3, :3] @ moved[1, :3, :3].T
        turn = (between - between.T)[[2, 0, 1], [1, 2, 0]] / 2.0  # micro-radians, which OpenCV rounds to none
        slope = np.concatenate([turn, moved[0, :3, 3] - moved[1, :3, 3]]) / (2 * step)
        scale = np.linalg.norm(fit.by_calibration[:3, index]), np.linalg.norm(fit.by_calibration[3:, index])
        # the second derivatives of the residuals are left out (Gauss and Newton): they are small beside the first
        np.testing.assert_allclose(fit.by_calibration[:3, index], slope[:3], atol=0.05 * scale[0])
        np.testing.assert_allclose(fit.by_calibration[3:, index], slope[3:], atol=0.05 * scale[1])


def solve_with(pair, points, seed, moved=None):
    rng = np.random.default_rng(seed)
    places = points + rng.normal(0.0, SURVEY_SIGMA_M, points.shape)
    if moved is not None:
        places[moved] += [0.0, 0.0, 0.02]
    names, sigma = [f"P{number}" for number in range(len(points))], np.full(len(points), SURVEY_SIGMA_M)
    return solve_pose(pair, T_NOMINAL, names, places, sigma, spots(points, 0, rng), spots(points, 1, rng))


def calibrated_before(focal0, focal1, turn_rad=(0.0, 0.0, 0.0)):
    """The pair as it was before its lenses grew longer by these parts and cam1 turned: what the file has."""
    values = PAIR.parameters
    values[:2] /= 1.0 + focal0
    values[9:11] /= 1.0 + focal1
    values[18:21] -= turn_rad
    return PAIR.with_parameters(values)


def test_untouched_lenses_are_known_to_be():
    chi2 = []
    for seed in range(12):
        lens = solve_with(PAIR, lights(10, 40 + seed), seed, moved=3 if seed % 2 else None).lens
        assert lens.findings() == []
        assert lens.lights == (9 if seed % 2 else 10)  # a light with a wrong coordinate does not matter
        assert lens.focal_sigma.max() < 1.5e-3
        changes = np.concatenate([lens.focal_change, lens.turn_rad])
        chi2.append((changes / np.concatenate([lens.focal_sigma, lens.turn_sigma_rad])) ** 2)
    # five changes, twelve times: each about 1 ± 0.4, and correlated
    assert 0.3 < np.mean(chi2) < 2.0


@pytest.mark.parametrize(
    ("focal0", "focal1", "turn", "says"),
    [
        (0.01, 0.0, 0.0, r"cam0's focal length is (1\.0\d|0\.9\d) \+- 0\.\d\d % longer than calibrated: a lens"),
        (0.0, -0.005, 0.0, r"cam1's focal length is 0\.(4|5)\d \+- 0\.\d\d % shorter"),
        (0.03, 0.03, 0.0, r"cam0's focal length is .* longer than calibrated and cam1's focal length is .* longer"),
        (0.0, 0.0, 0.002, r"cam1 has turned against cam0 by 0\.11\d, "),
        (0.08, 0.0, 0.0, r"0 of 10 surveyed lights can be used.*was a lens touched"),  # beyond what can be put together
    ],
)
def test_a_touched_lens_is_refused_with_numbers(focal0, focal1, turn, says):
    with pytest.raises(ProcessError, match=says):
        solve_with(calibrated_before(focal0, focal1, (turn, 0.0, 0.0)), lights(10, 33), 4)


def test_too_few_lights_leave_the_lenses_unchecked():
    assert solve_with(PAIR, lights(4, 33), 4).lens is None


def repose(folder, *more):
    rig, survey, output = (str(folder / name) for name in ("rig.json", "survey.toml", "new.json"))
    arguments = ["repose", rig, "--survey", survey, "-o", output, "--json", *map(str, more)]
    return CliRunner().invoke(app, arguments, catch_exceptions=False)


def test_a_pose_is_renewed_in_the_field(survey_folder, tmp_path, recording_writer):
    assert command(survey_folder).exit_code == 0
    survey = survey_folder / "survey.toml"
    survey.write_text(survey.read_text().replace("sigma_mm = 0.3", "sigma_mm = 0.3\non_fuselage = true"))
    before = Rig.read(survey_folder / "rig.json")
    knocked = pose_matrix([0.002, 0.0, -0.001], [0.001, 0.0, 0.002])
    points = lights(8, 13)
    writer = recording_writer(tmp_path / "flight" / "burst.mcap")
    for camera in (0, 1):
        # the same lights seen by a pair that was knocked: it sees them where the old one would, were they moved back
        image = draw(in_pixels(points @ knocked[:3, :3] - knocked[:3, 3] @ knocked[:3, :3], camera))
        for side in ("left", "right"):
            cv2.imwrite(str(survey_folder / f"{side}{camera}.png"), image)
            writer.frame(side, f"cam{camera}", 0, image, 1_700_000_000_000_000_000)
    writer.close()
    for more in ((), ("--flight", tmp_path / "flight")):
        done = repose(survey_folder, *more)
        assert done.exit_code == 0
        after = Rig.read(survey_folder / "new.json")
        np.testing.assert_allclose(after.right.T_body_cam0, knocked @ before.right.T_body_cam0, atol=3e-4)
        np.testing.assert_array_equal(after.right.pair.T_cam1_cam0, before.right.pair.T_cam1_cam0)
        assert after.markers == before.markers
        assert [light.name for light in after.left.references] == [f"left{number}" for number in range(8)]
        moved = json.loads(done.stdout)["right"]["moved"]
        assert moved["turn_deg"] == pytest.approx(np.degrees(np.hypot(0.002, 0.001)), abs=0.01)
        assert moved["shift_mm"] > 1.0
        assert moved["tip_mm"] > 0.5


def test_other_cameras_than_the_rigs_are_not_reposed(survey_folder):
    assert command(survey_folder).exit_code == 0
    survey = survey_folder / "survey.toml"
    survey.write_text(survey.read_text().replace('"left-0"', '"left-9"'))
    with pytest.raises(ProcessError, match=r"left cameras are left-9 and left-1, those of .* left-0 and left-1"):
        repose(survey_folder)
    assert not (survey_folder / "new.json").exists()
