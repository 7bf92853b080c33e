"""world.toml keeps everything, refuses what it does not know, and follows from its seed."""

from pathlib import Path

import numpy as np
import pytest

from capture.errors import UsageError
from hw_sim.world import World, nominal_pose, rotation


def test_the_file_keeps_everything(world: World, tmp_path: Path) -> None:
    world.write(tmp_path / "world.toml")
    assert World.read(tmp_path / "world.toml") == world


def test_a_seed_makes_the_same_world_and_another_seed_another() -> None:
    assert World.make(5) == World.make(5)
    assert World.make(5).cameras != World.make(6).cameras


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("seed = 3", "seed = 3\nsede = 4", "unknown key sede"),
        ("read_noise_e = ", "red_noise_e = ", "unknown key sensor.red_noise_e"),
        ("seed = 3\n", "", "key seed is missing"),
        ("seed = 3", "seed = 'three'", "seed must be of type int"),
        ('background = "dark"', 'background = "night"', "background 'night' is unknown"),
        ("[sensor]", "[sensor", "cannot be read as TOML"),
    ],
)
def test_a_file_with_a_mistake_is_refused_by_name(world: World, tmp_path: Path, old: str, new: str, says: str) -> None:
    path = tmp_path / "world.toml"
    world.write(path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(UsageError, match=says) as caught:
        World.read(path)
    assert str(path) in str(caught.value)


def test_a_missing_file_is_a_usage_error(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such file"):
        World.read(tmp_path / "none.toml")


@pytest.mark.parametrize("side", ["left", "right"])
def test_cam0_is_the_left_one_as_the_pair_looks_outboard(side: str) -> None:
    mount = World.make().mount
    poses = [nominal_pose(mount, side, name) for name in ("cam0", "cam1")]
    right, down, forward = poses[0][:3, :3].T
    assert (poses[1][:3, 3] - poses[0][:3, 3]) @ right == pytest.approx(mount.baseline_m)
    assert forward[1] * (1 if side == "right" else -1) > 0.9  # outboard
    assert forward[2] > 0 > down[2]  # pitched up, the right way round
    assert np.linalg.det(poses[0][:3, :3]) == pytest.approx(1.0)
    assert poses[0][1, 3] * forward[1] < 0  # stands across the centre line


def test_mounting_errors_are_there_and_small(world: World) -> None:
    for camera in world.cameras:
        true, nominal = np.array(camera.T_body_cam), nominal_pose(world.mount, camera.side, camera.name)
        assert 0 < np.linalg.norm(true[:3, 3] - nominal[:3, 3]) < 5 * 3**0.5 * world.mount.position_sigma_m
        angle = np.degrees(np.arccos((np.trace(true[:3, :3].T @ nominal[:3, :3]) - 1) / 2))
        assert 0 < angle < 5 * 3**0.5 * world.mount.angle_sigma_deg


def test_rotation_turns_by_the_right_hand() -> None:
    assert rotation(np.array([0.0, 0.0, np.pi / 2])) @ [1, 0, 0] == pytest.approx([0, 1, 0])
    assert np.array_equal(rotation(np.zeros(3)), np.eye(3))
