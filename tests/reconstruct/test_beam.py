"""The beam's kinematics and tangent against complex-step derivatives, and its exponential against series and limits."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from reconstruct.beam import Beam, shape_of
from reconstruct.equilibrium import solve
from reconstruct.loads import Loads, generalised_force, generalised_force_and_tangent
from reconstruct.rotation import exponential, hat, stumpff

STEP = 1e-30  # complex step: no cancellation, exact to rounding


def random_beam(rng: np.random.Generator, elements: int = 6) -> Beam:
    factor = rng.standard_normal((elements, 4, 4))
    return Beam(
        length_m=rng.uniform(0.3, 0.6, elements),
        stiffness=factor @ factor.transpose(0, 2, 1) + np.eye(4),
        curvature_1pm=0.3 * rng.standard_normal((elements, 3)),
        joint=exponential(0.3 * rng.standard_normal((elements, 3))),
        root_m=rng.standard_normal(3),
        R_body_root=exponential(rng.standard_normal(3)),
    )


def random_loads(rng: np.random.Generator, nodes: int) -> dict[str, Loads]:
    nothing = np.zeros((nodes, 3))
    a, b, c, d = rng.standard_normal((4, nodes, 3))
    at, arm, pull = np.array([2, 6, 6]), rng.standard_normal((3, 3)), rng.standard_normal((3, 3))
    return {
        "dead forces": Loads(a, nothing),
        "dead moments": Loads(nothing, b),
        "follower forces": Loads(nothing, nothing, c),
        "follower moments": Loads(nothing, nothing, None, d),
        "dead forces off the axis": Loads(nothing, nothing, None, None, pull, at, arm),
        "all": Loads(a, b, c, d, pull, at, arm),
    }


def complex_step(function, strain: np.ndarray) -> np.ndarray:
    """Derivatives of ``function`` by the strains, along the last axis."""
    columns = []
    for j in range(strain.size):
        change = np.zeros(strain.size, dtype=complex)
        change[j] = 1j * STEP
        columns.append(function(strain + change.reshape(strain.shape)).imag / STEP)
    return np.stack(columns, axis=-1)


@given(st.floats(0, 40))
def test_stumpff_functions_obey_their_recurrence(t: float) -> None:
    c = [float(value) for value in stumpff(np.array(t))]
    assert c[0] == pytest.approx(np.cos(np.sqrt(t)), abs=1e-13)
    factorial = 1.0
    for k in range(6):
        assert c[k] + t * c[k + 2] == pytest.approx(1 / factorial, abs=1e-12)
        factorial *= k + 1


@given(st.tuples(*[st.floats(-3, 3)] * 3))
def test_exponential_is_the_matrix_exponential(w: tuple[float, float, float]) -> None:
    assert np.allclose(exponential(np.array(w)), expm(hat(np.array(w))), atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 1e-3, 1.0, 3.0, 3.1, 6.0])
def test_an_element_is_an_exact_screw_at_any_angle(angle: float) -> None:
    """Against the 4×4 matrix exponential of the element's twist."""
    strain = np.array([[0.02, 0.6 * angle, -0.64 * angle, 0.48 * angle]])
    beam = Beam(np.ones(1), np.eye(4)[None], np.zeros((1, 3)), np.eye(3)[None], np.zeros(3), np.eye(3))
    twist = np.zeros((4, 4))
    twist[:3, :3] = hat(strain[0, 1:])
    twist[0, 3] = 1 + strain[0, 0]
    expected = expm(twist)
    shape = shape_of(beam, strain)
    assert np.allclose(shape.R_body_section[1], expected[:3, :3], atol=1e-13)
    assert np.allclose(shape.position_m[1], expected[:3, 3], atol=1e-13)


@pytest.mark.parametrize("size", [1e-9, 0.02, 0.8, 8.0])
def test_spin_and_slide_are_the_derivatives_of_the_shape(size: float) -> None:
    """``size`` 8 turns an element by more than π, where the closed trigonometric branch takes over."""
    rng = np.random.default_rng(1)
    beam = random_beam(rng)
    strain = size * rng.standard_normal((beam.elements, 4))
    shape = shape_of(beam, strain)
    outboard = beam.element_of[None, :] < np.arange(beam.elements + 1)[:, None]
    moves = shape.slide[None] + np.cross(shape.spin[None], shape.position_m[:, None])
    exact = complex_step(lambda q: shape_of(beam, q).position_m, strain)
    scale = 1 + np.abs(exact).max()
    assert np.allclose((moves * outboard[:, :, None]).transpose(0, 2, 1), exact, rtol=0, atol=1e-11 * scale)

    turns = complex_step(lambda q: shape_of(beam, q).R_body_section, strain)
    spun = np.einsum("jab,nbc->nacj", hat(shape.spin), shape.R_body_section) * outboard[:, None, None, :]
    assert np.allclose(spun, turns, rtol=0, atol=1e-11)


@pytest.mark.parametrize("size", [1e-9, 0.8, 5.0])
@pytest.mark.parametrize("kind", list(random_loads(np.random.default_rng(0), 7)))
def test_the_tangent_is_exact(kind: str, size: float) -> None:
    rng = np.random.default_rng(2)
    beam = random_beam(rng)
    strain = size * rng.standard_normal((beam.elements, 4))
    loads = random_loads(rng, beam.elements + 1)[kind]
    shape = shape_of(beam, strain)
    Q, tangent = generalised_force_and_tangent(beam, shape, loads)
    exact = complex_step(lambda q: generalised_force(beam, shape_of(beam, q), loads), strain)
    scale = 1 + np.abs(exact).max()
    assert np.allclose(Q, generalised_force(beam, shape, loads), rtol=0, atol=1e-12 * scale)
    assert np.allclose(tangent, exact, rtol=0, atol=1e-11 * scale)


def test_generalised_force_is_virtual_work() -> None:
    """Of dead forces on and off the axis: the derivative of Σ F · p."""
    rng = np.random.default_rng(3)
    beam = random_beam(rng)
    strain = 0.5 * rng.standard_normal((beam.elements, 4))
    loads = random_loads(rng, beam.elements + 1)
    on, off = loads["dead forces"], loads["dead forces off the axis"]

    def work(q: np.ndarray) -> np.ndarray:
        shape = shape_of(beam, q)
        arm = (shape.R_body_section[off.offset_node] @ off.offset_m[:, :, None])[:, :, 0]
        points = shape.position_m[off.offset_node] + arm
        return np.sum(on.force_n * shape.position_m) + np.sum(off.offset_force_n * points)

    both = generalised_force(beam, shape_of(beam, strain), on) + generalised_force(beam, shape_of(beam, strain), off)
    assert np.allclose(both, complex_step(work, strain), rtol=0, atol=1e-12)


def test_equilibrium_balances_every_kind_of_load() -> None:
    """At the answer both are balanced: K q = Q to rounding."""
    rng = np.random.default_rng(4)
    beam = random_beam(rng, 8)
    loads = random_loads(rng, 9)["all"]
    found = solve(beam, loads)
    assert found.converged
    K, Q = beam.stiffness_matrix, generalised_force(beam, found.shape, loads)
    assert np.allclose(K @ found.shape.strain.ravel(), Q, rtol=0, atol=1e-9)
    assert found.residual < 1e-9


def test_loads_that_are_not_numbers_are_a_verdict_not_a_shape() -> None:
    beam = random_beam(np.random.default_rng(5))
    force = np.full((beam.elements + 1, 3), np.nan)
    found = solve(beam, Loads(force, np.zeros_like(force)))
    assert not found.converged
    assert np.isnan(found.shape.position_m[1:]).all()
    assert "finite" in found.reason or "equilibrium" in found.reason
