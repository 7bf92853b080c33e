"""Wing files: geometry in closed form, mirror symmetry, and what is refused."""

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from capture.errors import UsageError
from reconstruct.rotation import about_axis, exponential
from reconstruct.wing import build_wing, example_path, incidence_rad, read_wing, twist_gradient, twist_rad
from reconstruct.wing_file import WingFile

XHALE = example_path("xhale.toml")


def description() -> dict[str, Any]:
    return tomllib.loads(XHALE.read_text())


@pytest.fixture(scope="module")
def xhale():
    return read_wing(XHALE)


class TestGeometry:
    def test_xhale_at_rest(self, xhale) -> None:
        right, left = xhale.right, xhale.left
        ten = np.radians(10)
        assert right.beam.elements == 30
        assert right.rest_position_m[-1] == pytest.approx([0, 2 + np.cos(ten), np.sin(ten)])
        assert left.rest_position_m == pytest.approx(right.rest_position_m * [1, -1, 1])
        for half in (right, left):
            assert np.degrees(half.rest_incidence_rad) == pytest.approx(np.full(31, 5.0))

    def test_section_frames_point_where_the_architecture_says(self, xhale) -> None:
        for half, e1, e2 in ((xhale.right, [0, 1, 0], [-1, 0, 0]), (xhale.left, [0, -1, 0], [1, 0, 0])):
            flat = half.beam.R_body_root @ about_axis(0, -half.sign * np.radians(5))
            assert flat == pytest.approx(np.column_stack([e1, e2, [0, 0, 1]]))

    def test_markers_stand_fore_and_aft_above_the_axis(self, xhale) -> None:
        """At s = 0.5 m: 5° nose-up, 0.04 m forward or 0.10 m aft, 4 mm up."""
        c, s = np.cos(np.radians(5)), np.sin(np.radians(5))
        for half in (xhale.right, xhale.left):
            node = half.marker_node[2:4]
            R = half.beam.rest.R_body_section[node]
            p = half.rest_position_m[node] + (R @ half.marker_offset_m[2:4, :, None])[:, :, 0]
            y = half.sign * 0.5
            assert p[0] == pytest.approx([-0.04 * c + 0.004 * s, y, 0.04 * s + 0.004 * c])
            assert p[1] == pytest.approx([0.10 * c + 0.004 * s, y, -0.10 * s + 0.004 * c])
        assert xhale.right.marker_ids.tolist() == list(range(18))
        assert xhale.right.marker_s_m[::2].tolist() == [0.2, 0.5, 0.8, 1.2, 1.5, 1.8, 2.2, 2.5, 2.8]

    def test_mass_of_a_half_wing(self, xhale) -> None:
        assert xhale.right.mass_kg.sum() == pytest.approx(2 * 0.394 + 0.5 + 1.44 + 1.52)

    def test_stiffness_is_mirrored(self, xhale) -> None:
        right, left = xhale.right.beam.stiffness[0], xhale.left.beam.stiffness[0]
        assert right[2, 3] == 46.3
        assert left[2, 3] == -46.3
        assert np.diag(left) == pytest.approx(np.diag(right))

    def test_sweep_points_the_tip_aft_and_twist_the_nose_up_on_both_sides(self) -> None:
        described = description()
        described["segment"][1] |= {"sweep_deg": 20.0, "twist_deg": -2.0, "dihedral_deg": 0.0}
        wing = build_wing(WingFile.model_validate(described))
        for half in (wing.right, wing.left):
            assert half.rest_position_m[-1, 0] == pytest.approx(np.sin(np.radians(20)))
            assert half.sign * half.rest_position_m[-1, 1] == pytest.approx(2 + np.cos(np.radians(20)))
        assert wing.left.rest_incidence_rad == pytest.approx(wing.right.rest_incidence_rad)
        assert np.degrees(wing.right.rest_incidence_rad[-1]) < 4

    def test_built_in_curvature_makes_an_arc(self) -> None:
        described = {
            "name": "arc",
            "segment": [
                {"length_m": 1.0, "elements": n, "EA": 1.0, "GJ": 1.0, "EI_out": 1.0, "EI_in": 1.0}
                | {"curvature_1pm": (0, -0.5, 0)}
                for n in (3, 4)
            ],
        }
        wing = build_wing(WingFile.model_validate(described))
        for half in (wing.right, wing.left):
            expected = [0, half.sign * 2 * np.sin(1.0), 2 * (1 - np.cos(1.0))]
            assert half.rest_position_m[-1] == pytest.approx(expected)

    def test_nodes_lie_where_something_is(self) -> None:
        described = description()
        described["markers"]["pairs"][0]["station_m"] = 0.2345
        wing = build_wing(WingFile.model_validate(described), nodes_at_m=(1.03,))
        for station in (0.2345, 1.03):
            assert wing.right.node_s_m[wing.right.node_at(station)] == pytest.approx(station)
        assert wing.right.beam.length_m.max() <= 0.1 + 1e-12
        with pytest.raises(ValueError, match="no node"):
            wing.right.node_at(1.04)


class TestIncidence:
    @pytest.mark.parametrize("nose_up_deg", [-30.0, 0.0, 3.0, 60.0])
    def test_turning_about_the_axis_is_twist_on_both_sides(self, xhale, nose_up_deg: float) -> None:
        for half in (xhale.right, xhale.left):
            R = half.beam.rest.R_body_section @ about_axis(0, half.sign * np.radians(nose_up_deg))
            assert np.degrees(twist_rad(half, R)) == pytest.approx(np.full(len(R), nose_up_deg))

    @pytest.mark.parametrize("bend_deg", [-40.0, 20.0, 80.0])
    def test_bending_about_the_body_axis_is_no_twist(self, xhale, bend_deg: float) -> None:
        for half in (xhale.right, xhale.left):
            R = about_axis(0, np.radians(bend_deg)) @ half.beam.rest.R_body_section
            assert twist_rad(half, R) == pytest.approx(np.zeros(len(R)), abs=1e-12)

    def test_gradient(self, xhale) -> None:
        """Central differences: error h² ≈ 1e-10."""
        rng = np.random.default_rng(1)
        for half in (xhale.right, xhale.left):
            R = exponential(0.5 * rng.standard_normal((31, 3))) @ half.beam.rest.R_body_section
            for axis in range(3):
                ahead, behind = (incidence_rad(half, about_axis(axis, h) @ R) for h in (1e-5, -1e-5))
                assert twist_gradient(half, R)[:, axis] == pytest.approx((ahead - behind) / 2e-5, abs=1e-8)


class TestRefusal:
    """One line with the file, the key and what is wrong with it."""

    @staticmethod
    def refused(tmp_path: Path, text: str) -> str:
        path = tmp_path / "wing.toml"
        path.write_text(text)
        with pytest.raises(UsageError) as caught:
            read_wing(path)
        message = str(caught.value)
        assert message.startswith(str(path))
        assert "\n" not in message
        assert caught.value.exit_code == 2
        return message

    @pytest.mark.parametrize(
        ("old", "new", "says"),
        [
            ("k34 = 46.3", "k34 = 4630.0", "segment[0]: the stiffness is not positive definite"),
            ("GJ = 59.3", "GJ = -59.3", "segment[0].GJ: "),
            ("GJ = 59.3", "GJ = nan", "segment[0].GJ: "),
            ("GJ = 59.3", "", "segment[0].GJ: missing"),
            ("elements = 20", "elements = 20\nflaps = 2", "segment[0].flaps: unknown key"),
            ("station_m = 2.8,", "station_m = 3.2,", "markers.pairs[8].station_m: station 3.2 m is off the wing"),
            ("station_m = 2.8,", "station_m = 0.3,", "markers: pairs must be listed from the root outward"),
            ("[0.04, -0.10]", "[0.06, -0.10]", "markers.pairs[0].chord_m: off the chord"),
            ("[0.04, -0.10]", "[-0.10, 0.04]", "markers.pairs[0]: chord_m is [fore, aft]"),
            ("mass_kg = 1.52", "mass_kg = 0", "mass[1].mass_kg: "),
            ("station_m = 2.0", "station_m = 9.0", "mass[1].station_m: station 9 m is off the wing"),
            ("[1.0, 2.0, 3.0]", "[1.0, 2.0, 3.5]", "fit.load_stations_m: station 3.5 m is off the wing"),
            ('name = "X-HALE"', "name = ", "not TOML"),
        ],
    )
    def test_broken_key(self, tmp_path: Path, old: str, new: str, says: str) -> None:
        text = XHALE.read_text()
        assert old in text
        assert says in self.refused(tmp_path, text.replace(old, new))

    def test_no_file(self, tmp_path: Path) -> None:
        with pytest.raises(UsageError, match=r"none\.toml: No such file"):
            read_wing(tmp_path / "none.toml")

    def test_bytes(self, tmp_path: Path) -> None:
        path = tmp_path / "wing.toml"
        path.write_bytes(b"\xff\xfe\x00")
        with pytest.raises(UsageError, match="not TOML"):
            read_wing(path)
