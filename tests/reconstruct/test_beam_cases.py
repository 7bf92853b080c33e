"""Published cases of geometrically nonlinear beams, by name, at their tolerances."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import ellipeinc, ellipk, ellipkinc

from reconstruct.beam import Beam, Shape
from reconstruct.equilibrium import Equilibrium, solve
from reconstruct.loads import Loads
from reconstruct.loads_file import LoadsFile, loads_on
from reconstruct.wing import HalfWing, example_path, read_wing


def straight(
    elements: int, length_m: float, stiffness: list[float], curvature: tuple[float, float, float] = (0, 0, 0)
) -> Beam:
    """Along body x, sections upright: e1 = x, e2 = y, e3 = z."""
    return Beam(
        length_m=np.full(elements, length_m / elements),
        stiffness=np.tile(np.diag(stiffness), (elements, 1, 1)),
        curvature_1pm=np.tile(curvature, (elements, 1)),
        joint=np.tile(np.eye(3), (elements, 1, 1)),
        root_m=np.zeros(3),
        R_body_root=np.eye(3),
    )


def tip(beam: Beam, force=(0, 0, 0), moment=(0, 0, 0), follower=None) -> Equilibrium:
    n = beam.elements + 1
    F, M, follow = np.zeros((3, n, 3))
    F[-1], M[-1] = force, moment
    if follower is not None:
        follow[-1] = follower
    return solve(beam, Loads(F, M, follow if follower is not None else None))


class TestRollUp:
    """A cantilever under an end moment bends into a circle; constant strain is exact."""

    @pytest.mark.parametrize("turns", [0.4, 0.8, 1.2, 1.6, 2.0])
    def test_end_moment(self, turns: float) -> None:
        length, EI = 12.0, 30e6 / 12
        moment = turns * np.pi * EI / length
        found = tip(straight(10, length, [30e6, EI, EI, EI]), moment=(0, -moment, 0))
        radius = EI / moment
        expected = [radius * np.sin(length / radius), 0, radius * (1 - np.cos(length / radius))]
        assert found.converged
        assert np.abs(found.shape.position_m[-1] - expected).max() / length < 1e-10


class TestElastica:
    """A cantilever under a dead tip force, inextensible; exact by elliptic integrals (Bisshopp & Drucker 1945)."""

    TABLE = (  # PL²/EI, w/L, u/L, slope
        (0.2, 0.06636448, 0.00264655, 0.09963616),
        (1.0, 0.30172077, 0.05643324, 0.46135195),
        (5.0, 0.71379152, 0.38762836, 1.21536812),
        (10.0, 0.81060902, 0.55499560, 1.43028554),
        (16.0, 0.85274698, 0.64677259, 1.51007214),
    )

    @staticmethod
    def exact(load: float) -> tuple[float, float, float]:
        def excess(k: float) -> float:
            return ellipk(k * k) - ellipkinc(np.arcsin(1 / (k * np.sqrt(2))), k * k) - np.sqrt(load)

        k = brentq(excess, np.sqrt(0.5) + 1e-12, 1 - 1e-15, xtol=1e-15)
        phi = np.arcsin(1 / (k * np.sqrt(2)))
        w = 1 - 2 / np.sqrt(load) * (ellipeinc(np.pi / 2, k * k) - ellipeinc(phi, k * k))
        slope = np.arcsin(2 * k * k - 1)
        return w, 1 - np.sqrt(2 * np.sin(slope) / load), slope

    @staticmethod
    def solved(load: float, elements: int) -> tuple[float, float, float]:
        found = tip(straight(elements, 1.0, [1e9, 1.0, 1.0, 1.0]), force=(0, 0, load))
        assert found.converged
        assert found.stable
        R = found.shape.R_body_section[-1]
        return (
            found.shape.position_m[-1, 2],
            1 - found.shape.position_m[-1, 0],
            float(np.arctan2(R[2, 0], R[0, 0])),
        )

    @pytest.mark.parametrize("row", TABLE)
    def test_exact_solution_is_the_published_table(self, row: tuple[float, ...]) -> None:
        assert self.exact(row[0]) == pytest.approx(row[1:], abs=1e-8)

    @pytest.mark.parametrize("row", TABLE)
    def test_tip(self, row: tuple[float, ...]) -> None:
        # second order: 4.64e-5 at 60 elements and load 10, so a quarter and half more at 120 and load 16
        assert self.solved(row[0], 120) == pytest.approx(row[1:], abs=2.5e-5)

    def test_convergence_is_second_order(self) -> None:
        exact = self.exact(10.0)[0]
        errors = [abs(self.solved(10.0, n)[0] - exact) for n in (16, 30, 60)]
        assert errors == pytest.approx([6.55e-4, 1.86e-4, 4.64e-5], rel=0.02)
        assert np.log2(errors[1] / errors[2]) == pytest.approx(2.0, abs=0.05)


class TestBatheBolourchi:
    """A 45° bend of radius 100 in the plane, loaded out of it. Tip by Simo & Vu-Quoc (1986)."""

    @pytest.mark.parametrize(
        ("load", "expected"),
        [(300, (58.84, 22.33, 40.08)), (450, (52.32, 18.62, 48.39)), (600, (47.23, 15.79, 53.37))],
    )
    def test_tip(self, load: float, expected: tuple[float, float, float]) -> None:
        radius, E = 100.0, 1e7
        G, J, inertia = E / 2, 1 / 6, 1 / 12  # ν = 0
        beam = straight(40, radius * np.pi / 4, [E, G * J, E * inertia, E * inertia], curvature=(0, 0, 1 / radius))
        found = tip(beam, force=(0, 0, load))
        assert tuple(found.shape.position_m[-1]) == pytest.approx(
            expected, abs=0.15
        )  # the table gives no more, for another torsion constant


class TestFollowerForce:
    """A cantilever under a tip force that stays normal to it (Simo & Vu-Quoc 1986)."""

    @pytest.mark.parametrize(("load", "expected"), [(50e3, -98.0), (100e3, -50.7)])
    def test_tip(self, load: float, expected: float) -> None:
        EI = 420e6 / 12
        found = tip(straight(60, 100.0, [420e6, EI, EI, EI]), follower=(0, 0, load))
        assert found.converged
        assert found.shape.position_m[-1, 0] - 100.0 == pytest.approx(expected, abs=0.5)


class TestPrinceton:
    """The Princeton beam, a thin strip loaded 45° off its axes (Dowell & Traybar 1975; Bauchau et al. 2016)."""

    @pytest.mark.parametrize(
        ("load", "expected"),
        [(13.345, (-0.0303357, -0.0155488, 0.1565214)), (8.896, (-0.0143664, -0.0089529, 0.1089703))],
    )
    def test_tip(self, load: float, expected: tuple[float, float, float]) -> None:
        length, h, w, E, nu = 0.508, 12.3777e-3, 3.2024e-3, 71.7e9, 0.31
        stiff, soft = w * h**3 / 12, h * w**3 / 12
        J = 0.198 * (stiff + soft)
        beam = straight(40, length, [E * h * w, E / (2 * (1 + nu)) * J, E * soft, E * stiff])
        beta = np.radians(45)
        found = tip(beam, force=(0, -load * np.cos(beta), load * np.sin(beta)))
        moved = found.shape.position_m[-1] - [length, 0, 0]
        within = 0.005 * np.linalg.norm(expected)  # the source model has shear
        assert np.abs(moved - expected).max() < within


class TestPazy:
    """The Pazy wing without skin against UM/NAST itself: every tip mass, and along the span."""

    REFERENCE = json.loads((Path(__file__).parent / "pazy_umnast.json").read_text())
    SEMISPAN_M = 0.549843728
    GRAVITY = 9.807
    MID_CHORD = (0.0, -0.006, 0.0)  # of the axis, section frame: output point, and where the tip mass hangs

    @pytest.fixture
    def half(self) -> HalfWing:
        return read_wing(example_path("pazy.toml")).right

    def hung(self, half: HalfWing, mass_kg: float, chord_m: float) -> Shape:
        tip_mass = {"station_m": half.node_s_m[-1], "force_n": (0, 0, -mass_kg * self.GRAVITY), "chord_m": chord_m}
        described = LoadsFile.model_validate({"gravity": True, "gravity_m_s2": self.GRAVITY, "point": [tip_mass]})
        found = solve(half.beam, loads_on(half, described))
        assert found.converged
        return found.shape

    def mid_chord_percent(self, shape: Shape) -> np.ndarray:
        return 100 * (shape.position_m + shape.R_body_section @ np.array(self.MID_CHORD)) / self.SEMISPAN_M

    def test_it_has_umnasts_elements(self, half: HalfWing) -> None:
        assert half.beam.elements == 15
        assert half.node_s_m[-1] == pytest.approx(self.SEMISPAN_M, abs=1e-12)

    def test_tip_bending(self, half: HalfWing) -> None:
        unloaded = self.mid_chord_percent(self.hung(half, 0, -0.006))[-1]
        for mass, dz, dy in self.REFERENCE["bending_tip_percent_semispan"]["rows"]:
            moved = self.mid_chord_percent(self.hung(half, mass, -0.006))[-1] - unloaded
            assert moved[1:] == pytest.approx((dy, dz), abs=0.001)

    def test_bending_along_the_span(self, half: HalfWing) -> None:
        for name, rows in self.REFERENCE["bending_spanwise"].items():
            reference = np.array(rows)
            at_nodes = np.vstack([reference[:1], reference[2::3]])  # UM/NAST lists an element's ends and middle
            found = self.mid_chord_percent(self.hung(half, float(name.split("_")[2]), -0.006))
            assert found[:, 1] == pytest.approx(100 * at_nodes[:, 0] / self.SEMISPAN_M, abs=0.001)
            assert found[:, 2] == pytest.approx(at_nodes[:, 1], abs=0.001)

    def test_tip_twist(self, half: HalfWing) -> None:
        """UM/NAST's twist is the elevation of the chord line."""

        def elevation_deg(mass_kg: float) -> float:
            return float(np.degrees(np.arcsin(self.hung(half, mass_kg, -0.0953).R_body_section[-1, 2, 1])))

        for mass, twist in self.REFERENCE["torsion_tip_twist_deg"]["rows"]:
            assert elevation_deg(mass) - elevation_deg(0) == pytest.approx(twist, abs=0.002)
