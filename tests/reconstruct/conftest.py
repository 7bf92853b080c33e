"""True wing shapes for the inverse: closed-form angles, and distributed loads on another, finer mesh."""

import tomllib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.polynomial import Polynomial

from reconstruct.equilibrium import solve
from reconstruct.loads_file import LoadsFile, loads_on
from reconstruct.rotation import exponential
from reconstruct.wing import HalfWing, Wing, build_wing, example_path, read_wing, twist_rad
from reconstruct.wing_file import WingFile

BEND = Polynomial([0, 3, -3, 1])  # slope of a clamped beam under an even load
TWIST = Polynomial([0, 1.5, 0, -0.5])


@dataclass(frozen=True)
class Truth:
    """A half wing's true state at the nodes of the wing that is fitted."""

    half: HalfWing
    position_m: np.ndarray  # (N + 1, 3)
    R_body_section: np.ndarray  # (N + 1, 3, 3)

    @property
    def twist_rad(self) -> np.ndarray:
        return twist_rad(self.half, self.R_body_section)

    @property
    def markers_m(self) -> np.ndarray:
        node = self.half.marker_node
        return self.position_m[node] + np.einsum("mab,mb->ma", self.R_body_section[node], self.half.marker_offset_m)


@pytest.fixture(scope="session")
def xhale() -> Wing:
    return read_wing(example_path("xhale.toml"))


@pytest.fixture(scope="session")
def closed_form() -> Callable[..., Truth]:
    """Sections turned by Rx(bending)·Rz(in-plane)·Ry(twist) from the unloaded ones; the axis is the integral of e1.

    It knows nothing of stiffness: holding X-HALE so takes 100 N·m in its plane.
    """

    def make(half: HalfWing, bend_rad: float, twist_deg: float, in_plane_rad: float) -> Truth:
        axes = np.eye(3)

        def sections(s: np.ndarray) -> np.ndarray:
            x = s / 3.0
            dihedral = np.where(s > 2 + 1e-9, np.radians(10), 0.0)
            turn = exponential(half.sign * bend_rad * BEND(x)[:, None] * axes[0])
            turn = turn @ exponential(half.sign * in_plane_rad * BEND(x)[:, None] * axes[2])
            turn = turn @ exponential(np.radians(twist_deg) * TWIST(x)[:, None] * axes[1])
            return turn @ exponential(half.sign * dihedral[:, None] * axes[0]) @ half.beam.R_body_root

        step = 3.0 / 1200  # midpoint rule: error below 1e-6 m; nodes fall on steps
        tangents = sections((np.arange(1200) + 0.5) * step)[:, :, 0]
        axis = np.concatenate([np.zeros((1, 3)), np.cumsum(tangents * step, axis=0)])
        return Truth(half, axis[np.rint(half.node_s_m / step).astype(int)], sections(half.node_s_m - 1e-9))

    return make


@pytest.fixture(scope="session")
def fine_xhale(xhale: Wing) -> Wing:
    described = tomllib.loads(example_path("xhale.toml").read_text())
    described["segment"][0]["elements"], described["segment"][1]["elements"] = 57, 31
    return build_wing(WingFile.model_validate(described), tuple(xhale.right.node_s_m))


@pytest.fixture(scope="session")
def loaded(fine_xhale: Wing) -> Callable[..., Truth]:
    """Lift that falls to nothing at the tip, a gust, drag, pitching moment and weight, on three times the elements."""

    def make(half: HalfWing, lift_n_m: float, gust_n_m: float, pitch_nm_m: float, drag_n_m: float) -> Truth:
        fine = fine_xhale.half(half.side)
        described = LoadsFile.model_validate(
            {
                "gravity": True,
                "distributed": [
                    {"kind": "follower", "to_m": 3.0, "force_n_m": (0, 0, 1.2 * lift_n_m)}
                    | {"force_end_n_m": (0, 0, 0.2 * lift_n_m)},
                    {"kind": "follower", "from_m": 1.0, "to_m": 2.5, "force_n_m": (0, 0, gust_n_m)},
                    {"kind": "follower", "to_m": 3.0, "moment_nm_m": (pitch_nm_m, 0, 0), "moment_end_nm_m": (0, 0, 0)},
                    {"to_m": 3.0, "force_n_m": (drag_n_m, 0, 0)},
                ],
            }
        )
        found = solve(fine.beam, loads_on(fine, described))
        assert found.converged
        at = [fine.node_at(s) for s in half.node_s_m]
        return Truth(half, found.shape.position_m[at], found.shape.R_body_section[at])

    return make


@pytest.fixture(scope="session")
def random_states(closed_form: Callable[..., Truth], loaded: Callable[..., Truth]) -> Callable[..., list[Truth]]:
    """``count`` true states of one kind, alternating sides: tip bending 0.2 to 0.7 m, twist within ±3°."""

    def make(wing: Wing, kind: str, count: int, rng: np.random.Generator) -> list[Truth]:
        states = []
        for i in range(count):
            half = (wing.right, wing.left)[i % 2]
            if kind == "closed form":
                numbers = rng.uniform([0.1, -3.0, -0.006], [0.28, 3.0, 0.006])
                states.append(closed_form(half, *numbers))
            else:
                numbers = rng.uniform([14.0, -5.0, -0.8, 0.0], [20.0, 12.0, 0.8, 1.5])
                states.append(loaded(half, *numbers))
        return states

    return make
