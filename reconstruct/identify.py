"""A wing's markers and their noise into what they tell of its shape and loads, before anything has been measured.

What they do not tell comes from the prior, hence from stiffness and the loads thought possible. Everything is linear,
about the unloaded wing.
"""

from dataclasses import dataclass

import numpy as np

from reconstruct.fit import marker_problem
from reconstruct.iteration import Problem, linearise, node_motion
from reconstruct.posterior import by_strains
from reconstruct.rotation import Array, hat
from reconstruct.wing import HalfWing
from reconstruct.wing_file import FitSettings

MEASURED = 0.5  # share of the variance that must be the markers' doing for a quantity to count as measured
_NUMBERS_A_STATION = 1.5  # nine pairs at 3 mm tell five, and three stations are what they support


@dataclass(frozen=True)
class Identified:
    """What one instant with all markers would tell. Sigmas are those of the fit with its prior as stated."""

    shape_sigma_mm: float  # RMS over the span of the position's sigma (3-D)
    twist_sigma_deg: float  # RMS over the span
    tip_sigma_mm: float
    tip_twist_sigma_deg: float
    told_twist: float  # share of the prior's variance that differences of fore and aft lights take away, mean over span
    told_out: float  # the same of the vertical position by all markers: 1 all measured, 0 all from stiffness and prior
    told_in: float  # and of the position fore and aft
    numbers_told: float  # how many independent numbers the markers tell
    load_numbers: int  # unknowns of loads at the stations
    condition: float  # of their plain least squares, forces and moments in units of their prior sigmas
    weakest_load: str  # the component of load that is told least

    @property
    def twist_is_measured(self) -> bool:
        """Whether markers, not stiffness, say how far the wing twists."""
        return self.told_twist >= MEASURED

    @property
    def warnings(self) -> list[str]:
        """What a user must know before believing twist or loads, a sentence each."""
        said = []
        if not self.twist_is_measured:
            said.append(
                "Twist is predicted from stiffness, not measured: fore and aft lights are too close together for this "
                f"noise, and tell {100 * self.told_twist:.0f} % of it."
            )
        if self.told_out < MEASURED:
            said.append(f"Bending is hardly measured: the markers tell {100 * self.told_out:.0f} % of it.")
        stations = self.load_numbers // 6
        if stations > self.numbers_told / _NUMBERS_A_STATION:
            said.append(
                f"{stations} load stations are too many: the markers tell about {self.numbers_told:.0f} independent "
                "numbers, so how loads are shared between stations comes from the prior."
            )
        return said


def identify(half: HalfWing, settings: FitSettings, marker_cov_m2: Array) -> Identified:
    """What markers with covariances ``marker_cov_m2`` (M, 3, 3; NaN: not there) tell of a half wing."""
    everywhere = settings.model_copy(update={"loads": "everywhere", "prior_weight": 1.0})
    stations = settings.model_copy(update={"loads": "stations", "prior_weight": 1.0})
    problem = marker_problem(half, half.rest_marker_m, marker_cov_m2, everywhere).problem
    information, position, twist = _linear(half, problem)
    posterior = np.linalg.inv(information + np.eye(len(information)))
    before, after = (
        np.einsum("nau,uv,nav->na", position, spread, position) for spread in (np.eye(len(posterior)), posterior)
    )
    twist_after = np.einsum("nu,uv,nv->n", twist, posterior, twist)
    torsion = _torsion(half, problem)
    by_pairs = np.linalg.inv(_information_of_pairs(half, problem, marker_cov_m2, settings) + np.eye(len(information)))
    torsion_after = np.einsum("nu,uv,nv->n", torsion, by_pairs, torsion)
    k = 6 * len(settings.load_stations_m)
    at_stations = marker_problem(half, half.rest_marker_m, marker_cov_m2, stations).problem
    of_loads = _linear(half, at_stations)[0][:k, :k]
    size, direction = np.linalg.eigh(of_loads)
    return Identified(
        shape_sigma_mm=1e3 * float(np.sqrt(after.sum(axis=1).mean())),
        twist_sigma_deg=float(np.degrees(np.sqrt(twist_after.mean()))),
        tip_sigma_mm=1e3 * float(np.sqrt(after[-1].sum())),
        tip_twist_sigma_deg=float(np.degrees(np.sqrt(twist_after[-1]))),
        told_twist=1 - float(torsion_after.mean() / np.sum(torsion**2, axis=1).mean()),
        told_out=1 - float(after[:, 2].mean() / before[:, 2].mean()),
        told_in=1 - float(after[:, 0].mean() / before[:, 0].mean()),
        numbers_told=float(len(posterior) - np.trace(posterior)),
        load_numbers=k,
        condition=float(np.sqrt(size[-1] / size[0])) if size[0] > 1e-14 * size[-1] else float("inf"),
        weakest_load=_component(direction[:, 0], settings.load_stations_m),
    )


def _linear(half: HalfWing, problem: Problem) -> tuple[Array, Array, Array]:
    """Information (u, u), and derivatives by the unknowns of the nodes (N + 1, 3, u) and of twist (N + 1, u)."""
    linear = linearise(problem, np.zeros((half.beam.elements, 4)), np.zeros(problem.unknowns))
    A = linear.jacobian.reshape(-1, problem.unknowns)
    moved = by_strains(half, linear.shape, linear.response)
    return A.T @ A, moved[:, :3], moved[:, 3]


def _information_of_pairs(half: HalfWing, problem: Problem, cov: Array, settings: FitSettings) -> Array:
    """(u, u) what the differences of fore and aft lights tell: what a twist is measured by, whatever the bending."""
    linear = linearise(problem, np.zeros((half.beam.elements, 4)), np.zeros(problem.unknowns))
    node = half.marker_node[0::2]
    apart = half.rest_marker_m[0::2] - half.rest_marker_m[1::2]
    turns = -hat(apart) @ node_motion(linear.shape, linear.response, np.arange(len(half.node_s_m)))[node, :3]
    spread = cov[0::2] + cov[1::2] + 2 * settings.marker_model_sigma_m**2 * np.eye(3)
    both = np.isfinite(spread).all(axis=(1, 2))
    whiten = np.linalg.inv(np.linalg.cholesky(spread[both]))
    A = (whiten @ turns[both]).reshape(-1, problem.unknowns)
    information: Array = A.T @ A
    return information


def _torsion(half: HalfWing, problem: Problem) -> Array:
    """(N, u) angle by which the unknowns twist the wing up to each element's end; bending has no part in it."""
    assert problem.modes is not None
    twist = problem.modes.reshape(half.beam.elements, 4, -1)[:, 1]
    angle: Array = np.cumsum(twist * half.beam.length_m[:, None], axis=0)
    return angle


def _component(direction: Array, stations_m: tuple[float, ...]) -> str:
    largest = int(np.argmax(np.abs(direction)))
    name = ("force x", "force y", "force z", "moment x", "moment y", "moment z")[largest % 6]
    return f"{name} at {stations_m[largest // 6]:g} m"
