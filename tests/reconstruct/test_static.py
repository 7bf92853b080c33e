"""``reconstruct static`` as a user runs it, against closed forms."""

import json
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from capture.errors import ReconstructError, UsageError
from reconstruct.loads_file import LoadsFile, loads_on, read_loads
from reconstruct.static import static
from reconstruct.wing import example_path, read_wing

APP = typer.Typer()
APP.command()(static)
STRIP = """
name = "strip"
[[segment]]
length_m = 2.0
elements = 40
EA = 1e8
GJ = 40.0
EI_out = 100.0
EI_in = 4000.0
mass_per_m = 0.3
"""


def run(tmp_path: Path, loads: str, *options: str, wing: str = STRIP):
    (tmp_path / "wing.toml").write_text(wing)
    (tmp_path / "loads.toml").write_text(loads)
    files = ["--wing", str(tmp_path / "wing.toml"), "--loads", str(tmp_path / "loads.toml")]
    return CliRunner().invoke(APP, [*files, *options])


def solved(tmp_path: Path, loads: str, *options: str) -> dict:
    answer = run(tmp_path, loads, "--json", *options)
    assert answer.exit_code == 0, answer.output
    return json.loads(answer.stdout)


@pytest.mark.parametrize("side", ["right", "left"])
class TestClosedForm:
    """Small loads, so that linear beam theory holds to its square: displacements of about 1 mm in 2 m."""

    def test_tip_force(self, tmp_path: Path, side: str) -> None:
        tip = solved(tmp_path, "[[point]]\nstation_m = 2.0\nforce_n = [0, 0, 0.05]", "--side", side)["tip"]
        assert tip["displacement_m"][2] == pytest.approx(0.05 * 2**3 / 300, rel=1e-3)
        assert tip["twist_deg"] == pytest.approx(0, abs=1e-9)

    def test_tip_couple_turns_the_nose_up(self, tmp_path: Path, side: str) -> None:
        loads = '[[point]]\nstation_m = 2.0\nkind = "follower"\nmoment_nm = [0.1, 0, 0]'
        found = solved(tmp_path, loads, "--side", side)
        for node in found["nodes"]:
            assert node["twist_deg"] == pytest.approx(np.degrees(0.1 * node["s_m"] / 40), abs=1e-9)

    def test_force_ahead_of_the_axis_turns_the_nose_up(self, tmp_path: Path, side: str) -> None:
        loads = "[[point]]\nstation_m = 1.0\nforce_n = [0, 0, 0.1]\nchord_m = 0.05"
        tip = solved(tmp_path, loads, "--side", side)["tip"]
        assert tip["twist_deg"] == pytest.approx(np.degrees(0.1 * 0.05 / 40), rel=1e-3)

    def test_weight(self, tmp_path: Path, side: str) -> None:
        tip = solved(tmp_path, "gravity = true\ngravity_m_s2 = 0.01", "--side", side)["tip"]
        assert tip["displacement_m"][2] == pytest.approx(-0.3 * 0.01 * 2**4 / 800, rel=1e-3)

    def test_triangular_load(self, tmp_path: Path, side: str) -> None:
        """q(s) = q0 (1 − s/L): the tip rises q0 L⁴ / (30 EI)."""
        loads = "[[distributed]]\nto_m = 2.0\nforce_n_m = [0, 0, 0.1]\nforce_end_n_m = [0, 0, 0]"
        tip = solved(tmp_path, loads, "--side", side)["tip"]
        assert tip["displacement_m"][2] == pytest.approx(0.1 * 2**4 / 3000, rel=2e-3)

    def test_evenly_distributed_torque(self, tmp_path: Path, side: str) -> None:
        loads = '[[distributed]]\nfrom_m = 0.53\nto_m = 2.0\nkind = "follower"\nmoment_nm_m = [0.1, 0, 0]'
        tip = solved(tmp_path, loads, "--side", side)["tip"]
        arm = 0.1 * (2.0 - 0.53) * (2.0 + 0.53) / 2
        assert tip["twist_deg"] == pytest.approx(np.degrees(arm / 40), rel=1e-6)


class TestSides:
    def test_the_left_wing_mirrors_the_right_one(self, tmp_path: Path) -> None:
        loads = (
            "gravity = true\n[[point]]\nstation_m = 1.55\nforce_n = [3, 4, 20]\nmoment_nm = [1, 2, 3]\nchord_m = 0.03\n"
            '[[distributed]]\nfrom_m = 0.3\nto_m = 1.7\nkind = "follower"\n'
            "force_n_m = [1, 2, 9]\nmoment_nm_m = [2, 1, 1]"
        )
        right, left = (solved(tmp_path, loads, "--side", side)["nodes"] for side in ("right", "left"))
        for a, b in zip(right, left, strict=True):
            assert b["displacement_m"] == pytest.approx(np.array(a["displacement_m"]) * [1, -1, 1], abs=1e-12)
            assert b["twist_deg"] == pytest.approx(a["twist_deg"], abs=1e-9)

    def test_a_load_on_one_side(self) -> None:
        described = LoadsFile.model_validate({"point": [{"station_m": 3.0, "force_n": (0, 0, 1), "side": "left"}]})
        wing = read_wing(example_path("xhale.toml"))
        assert loads_on(wing.right, described).offset_force_n is None
        assert loads_on(wing.left, described).offset_force_n is not None


class TestSpeech:
    def test_table_and_plot(self, tmp_path: Path) -> None:
        answer = run(tmp_path, "gravity = true", "--plot", str(tmp_path / "shape.png"))
        assert answer.exit_code == 0
        assert "converged in" in answer.stdout
        assert "stable" in answer.stdout
        assert (tmp_path / "shape.png").stat().st_size > 10_000

    def test_a_picture_of_no_kind(self, tmp_path: Path) -> None:
        answer = run(tmp_path, "gravity = true", "--plot", str(tmp_path / "shape.txt.zip"))
        assert answer.exit_code == 2

    def test_no_such_side(self, tmp_path: Path) -> None:
        assert run(tmp_path, "gravity = true", "--side", "top").exit_code == 2

    def test_a_load_off_the_wing(self, tmp_path: Path) -> None:
        answer = run(tmp_path, "[[point]]\nstation_m = 2.5")
        assert isinstance(answer.exception, UsageError)
        assert "station 2.5 m is off the wing" in str(answer.exception)

    @pytest.mark.parametrize(
        ("text", "says"),
        [
            ("grav = 1", "grav: unknown key"),
            ("[[point]]\nforce_n = [0, 0, 1]", "point[0].station_m: missing"),
            ("[[point]]\nstation_m = 1\nforce_n = [0, 0, nan]", "point[0].force_n[2]: "),
            ("[[distributed]]\nfrom_m = 1.0\nto_m = 0.5", "distributed[0]: to_m must lie outboard"),
            ("[[point]]\nstation_m = 1\nkind = 'dad'", "point[0].kind: "),
        ],
    )
    def test_a_broken_file(self, tmp_path: Path, text: str, says: str) -> None:
        path = tmp_path / "loads.toml"
        path.write_text(text)
        with pytest.raises(UsageError) as caught:
            read_loads(path)
        assert says in str(caught.value)
        assert str(caught.value).startswith(str(path))

    def test_no_equilibrium_is_an_error_not_a_shape(self, tmp_path: Path) -> None:
        loads = '[[point]]\nstation_m = 2.0\nkind = "follower"\nforce_n = [-1e7, 1e7, 1e7]'
        answer = run(tmp_path, loads)
        assert isinstance(answer.exception, ReconstructError)
        assert "no static shape" in str(answer.exception)
        assert answer.stdout == ""
