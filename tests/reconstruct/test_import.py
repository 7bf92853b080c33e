"""Beam models of other programs as wing files."""

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from capture.errors import UsageError
from reconstruct.cli import app
from reconstruct.equilibrium import solve
from reconstruct.import_nastran import read_nastran
from reconstruct.import_sharpy import read_sharpy, without_shear
from reconstruct.import_wing import as_wing_file, toml_of
from reconstruct.loads_file import LoadsFile, loads_on
from reconstruct.wing import read_wing

# Two metres along y, then one with 10° dihedral; plane 1 is vertical: I1 resists bending up, I2 fore and aft.
DECK = """$ a wing and its mirror image, of which the right one is read
CEND
BEGIN BULK
GRID,1,,0.,0.,0.
GRID,2,,0.,1.,0.
GRID    3               0.      2.      0.
GRID*   4                               0.              2.984807753
*       .17364817767
GRID,12,,0.,-1.,0.
CBAR,1,7,1,2,0.,0.,1.
CBAR,2,7,2,3,0.,0.,1.
CBAR,3,8,3,4,0.,0.,1.
CBAR,4,7,12,1,0.,0.,1.
PBAR,7,1,1.-4,1.6-9,9.0-8,2.2-9,0.1
PBAR,8,1,1.-4,1.6-9,9.0-8,2.2-9,0.1
MAT1,1,7.+10,2.7+10,,2700.
CONM2,50,3,,1.52,-.02,0.1,-.05
ENDDATA
"""


@pytest.fixture
def deck(tmp_path: Path) -> Path:
    path = tmp_path / "wing.bdf"
    path.write_text(DECK)
    return path


def written(line: Any, source: Path, tmp_path: Path) -> Any:
    (tmp_path / "wing.toml").write_text(toml_of(as_wing_file(line, source)))
    return read_wing(tmp_path / "wing.toml")


class TestNastran:
    def test_a_line_of_bars(self, deck: Path, tmp_path: Path) -> None:
        result = CliRunner().invoke(app, ["import", str(deck), "-o", str(tmp_path / "wing.toml")])
        assert result.exit_code == 0, result.output
        right = read_wing(tmp_path / "wing.toml").right
        K = right.beam.stiffness[0]
        assert np.diag(K) == pytest.approx([7e6, 59.4, 112.0, 6300.0])
        assert K - np.diag(np.diag(K)) == pytest.approx(np.zeros((4, 4)), abs=1e-6)
        assert right.rest_position_m[-1] == pytest.approx([0, 2.984807753, 0.17364817767], abs=1e-6)
        assert right.mass_kg.sum() == pytest.approx(3 * (2700e-4 + 0.1) + 1.52)
        assert right.mass_offset_m[-1] == pytest.approx([0.1, 0.02, -0.05])

    def test_it_bends_as_a_cantilever(self, deck: Path, tmp_path: Path) -> None:
        straight = DECK.replace("2.984807753", "3.0").replace(".17364817767", "0.")
        deck.write_text(straight)
        right = written(read_nastran(deck), deck, tmp_path).right
        for axis, EI in ((2, 112.0), (0, 6300.0)):
            force = [0.0, 0.0, 0.0]
            force[axis] = 0.01
            loads = LoadsFile.model_validate({"point": [{"station_m": 3.0, "force_n": force}]})
            tip = solve(right.beam, loads_on(right, loads)).shape.position_m[-1]
            # P L³ / 3EI; six elements of constant curvature: 1/(4 · 6²) less
            assert tip[axis] == pytest.approx(0.01 * 27 / (3 * EI), rel=0.01)

    def test_a_section_turned_by_45_degrees_couples(self, deck: Path) -> None:
        deck.write_text(DECK.replace("0.,0.,1.", "-1.,0.,1."))
        K = read_nastran(deck).pieces[0].stiffness
        assert K[2, 2] == pytest.approx((112 + 6300) / 2)
        assert K[3, 3] == pytest.approx((112 + 6300) / 2)
        # plane 1 is up and forward: soft about the axis that points up and aft
        assert K[2, 3] == pytest.approx((6300 - 112) / 2)

    @pytest.mark.parametrize(
        ("change", "said"),
        [
            (("GRID,2,,", "GRID,2,5,"), "GRID 2 is in coordinate system 5"),
            (("CBAR,2,7,2,3", "CBAR,2,7,2,4"), "branches|gap|runs inboard"),
            (("PBAR,8", "PBAR,9"), "not a line of CBAR"),
            (("1.6-9", "zero"), "not a line of CBAR"),
            (("CBAR,1,7,1,2,0.,0.,1.", "CBAR,1,7,1,2,0.,0.,1.\n,,,.1"), "end offsets"),
            ((",1.6-9,9.0-8", ",0.,9.0-8"), "EI_out"),
        ],
    )
    def test_what_is_not_understood_is_an_error(self, deck: Path, change: tuple[str, str], said: str) -> None:
        deck.write_text(DECK.replace(*change))
        with pytest.raises(UsageError, match=said) as caught:
            as_wing_file(read_nastran(deck), deck)
        assert str(deck) in str(caught.value)
        assert "\n" not in str(caught.value)


def sharpy_file(path: Path, **changes: Any) -> Path:
    """Two SHARPy elements of three nodes a side: x aft, local y forward, one lumped mass."""
    h5py = pytest.importorskip("h5py")
    y = np.array([0, 0.5, 1.0, 1.5, 2.0])
    right = np.stack([0 * y, y, 0.1 * y], axis=1)
    left = (right * [1, -1, 1])[1:]
    stiffness = np.diag([2.14e6, 5e5, 6e5, 59.3, 112.0, 6350.0])
    stiffness[4, 5] = stiffness[5, 4] = 46.3
    m, forward, up = 0.394, 0.01, 0.002
    mass = np.diag([m, m, m, 1e-3, 1e-4, 1e-3])
    mass[0, 4], mass[0, 5], mass[1, 3], mass[2, 3] = m * up, -m * forward, -m * up, m * forward
    content = {
        "coordinates": np.concatenate([right, left]),
        "connectivities": np.array([[0, 2, 1], [2, 4, 3], [0, 6, 5], [6, 8, 7]]),
        "stiffness_db": stiffness[None],
        "elem_stiffness": np.zeros(4, dtype=int),
        "mass_db": mass[None],
        "elem_mass": np.zeros(4, dtype=int),
        "frame_of_reference_delta": np.tile([-1.0, 0.0, 0.0], (4, 3, 1)),
        "structural_twist": np.full((4, 3), np.radians(3.0)),
        "lumped_mass": np.array([1.5]),
        "lumped_mass_nodes": np.array([2]),
        "lumped_mass_position": np.array([[0.0, -0.02, 0.0]]),
        **changes,
    }
    with h5py.File(path, "w") as file:
        for name, value in content.items():
            if value is not None:
                file[name] = value
    return path


class TestSharpy:
    def test_the_right_wing(self, tmp_path: Path) -> None:
        source = sharpy_file(tmp_path / "hale.fem.h5")
        right = written(read_sharpy(source), source, tmp_path).right
        K = right.beam.stiffness[0]
        assert np.diag(K) == pytest.approx([2.14e6, 59.3, 112.0, 6350.0])
        assert K[2, 3] == pytest.approx(46.3)
        assert right.beam.elements == 4
        assert right.rest_position_m[-1] == pytest.approx([0, 2.0, 0.2], abs=1e-9)
        assert np.degrees(right.rest_incidence_rad[0]) == pytest.approx(3.0, abs=1e-6)
        assert right.mass_offset_m[0] == pytest.approx([0, 0.01, 0.002])
        assert right.mass_kg[-1] == 1.5
        assert right.mass_offset_m[-1] == pytest.approx([0, -0.02, 0])

    @pytest.mark.parametrize(
        ("changes", "said"),
        [
            ({"stiffness_db": None}, "lacks stiffness_db"),
            ({"frame_of_reference_delta": np.tile([1.0, 0, 0], (4, 3, 1))}, "frame_of_reference_delta"),
            ({"connectivities": np.array([[0, 2, 1], [8, 7, 7], [0, 6, 5], [6, 8, 7]])}, ""),
        ],
    )
    def test_others_are_refused_or_read_as_far_as_they_go(self, tmp_path: Path, changes: Any, said: str) -> None:
        source = sharpy_file(tmp_path / "hale.fem.h5", **changes)
        if not said:
            assert len(read_sharpy(source).pieces) == 1
            return
        with pytest.raises(UsageError, match=said):
            read_sharpy(source)

    def test_shear_is_condensed_out(self) -> None:
        """A beam loaded by a moment only: flexibility without the shear rows is that of the condensed stiffness."""
        rng = np.random.default_rng(1)
        A = rng.standard_normal((6, 6))
        K = A @ A.T + 6 * np.eye(6)
        flexible = np.linalg.inv(K)[np.ix_([0, 3, 4, 5], [0, 3, 4, 5])]
        assert np.linalg.inv(without_shear(K)) == pytest.approx(flexible)

    def test_without_its_reader(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def absent(name: str) -> Any:
            raise ImportError(name)

        monkeypatch.setattr(importlib, "import_module", absent)
        (tmp_path / "a.h5").write_bytes(b"")
        with pytest.raises(UsageError, match=r"a\.h5: reading it needs h5py, which is not installed: pip install h5py"):
            read_sharpy(tmp_path / "a.h5")


@pytest.mark.parametrize("name", ["none.h5", "wing.step"])
def test_no_such_file_or_kind(tmp_path: Path, name: str) -> None:
    if name == "wing.step":
        (tmp_path / name).write_text("")
    result = CliRunner().invoke(app, ["import", str(tmp_path / name), "-o", str(tmp_path / "w.toml")])
    assert isinstance(result.exception, UsageError)
