"""The inverse against truths it did not make: closed-form shapes, and distributed loads on a finer mesh."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest

from reconstruct.fit import Fit, fit_frame, pose
from reconstruct.iteration import linearise
from reconstruct.wing import build_wing, example_path
from reconstruct.wing_file import WingFile


def isotropic(sigma_m: float, markers: int = 18) -> np.ndarray:
    return np.tile(sigma_m**2 * np.eye(3), (markers, 1, 1))


def fit_noisy(wing, truth, sigma_m: float, rng: np.random.Generator, settings=None, **options) -> Fit:
    measured = truth.markers_m + sigma_m * rng.standard_normal((18, 3))
    return fit_frame(truth.half, measured, isotropic(sigma_m), settings or wing.fit, **options)


def rms_errors(fits: list[Fit], truths) -> tuple[float, float]:
    """Root mean square over states and nodes: distance of the axis, mm; twist, degrees."""
    distance = [
        np.sum((fit.position_m - truth.position_m) ** 2, axis=1) for fit, truth in zip(fits, truths, strict=True)
    ]
    twist = [(fit.twist_rad - truth.twist_rad) ** 2 for fit, truth in zip(fits, truths, strict=True)]
    return 1e3 * float(np.sqrt(np.mean(distance))), float(np.degrees(np.sqrt(np.mean(twist))))


class TestAccuracy:
    @pytest.mark.parametrize("kind", ["closed form", "loads"])
    @pytest.mark.parametrize(
        ("sigma_mm", "shape_mm", "twist_deg"),
        # A pair gives twist to σ√2 / 140 mm (1.7° at 3 mm); nine pairs and the prior leave a third of that at best.
        [(0.3, 0.3, 0.12), (1.0, 0.65, 0.27), (3.0, 1.7, 0.58)],
    )
    def test_random_states(self, xhale, random_states, kind, sigma_mm, shape_mm, twist_deg) -> None:
        rng = np.random.default_rng(11)
        truths = random_states(xhale, kind, 16, rng)
        fits = [fit_noisy(xhale, truth, 1e-3 * sigma_mm, rng) for truth in truths]
        assert all(fit.converged for fit in fits)
        assert not any(fit.outlier.any() for fit in fits)
        shape, twist = rms_errors(fits, truths)
        assert shape < shape_mm
        assert twist < twist_deg

    def test_without_noise_what_is_left_is_the_prior_and_the_mesh(self, xhale, closed_form) -> None:
        for half in (xhale.right, xhale.left):
            truth = closed_form(half, 0.25, 2.0, 0.004)
            fit = fit_frame(half, truth.markers_m, isotropic(1e-5), xhale.fit)
            shape, twist = rms_errors([fit], [truth])
            assert shape < 0.15
            assert twist < 0.05
            assert fit.position_m[-1] == pytest.approx(truth.position_m[-1], abs=5e-4)

    def test_mirrored_markers_give_a_mirrored_wing(self, xhale, closed_form) -> None:
        truth = closed_form(xhale.right, 0.2, -2.0, 0.003)
        noisy = truth.markers_m + 1e-3 * np.random.default_rng(3).standard_normal((18, 3))
        right = fit_frame(xhale.right, noisy, isotropic(1e-3), xhale.fit)
        left = fit_frame(xhale.left, noisy * [1, -1, 1], isotropic(1e-3), xhale.fit)
        assert left.position_m == pytest.approx(right.position_m * [1, -1, 1], abs=1e-9)
        assert left.twist_rad == pytest.approx(right.twist_rad, abs=1e-9)
        assert left.loads[:, :3] == pytest.approx(right.loads[:, :3] * [1, -1, 1], abs=1e-5)

    def test_loads_at_a_few_stations(self, xhale, random_states) -> None:
        """The paper's way, with its prior: good where a few loads did act like the truth, worse in twist."""
        rng = np.random.default_rng(12)
        settings = xhale.fit.model_copy(update={"loads": "stations"})
        truths = random_states(xhale, "loads", 20, rng)
        fits = [fit_noisy(xhale, truth, 1e-3, rng, settings) for truth in truths]
        assert all(fit.converged for fit in fits)
        shape, twist = rms_errors(fits, truths)
        assert shape < 1.0
        assert twist < 0.5


class TestCovariance:
    @pytest.mark.parametrize("mode", ["everywhere", "stations"])
    def test_marker_jacobian(self, xhale, closed_form, mode) -> None:
        """Central differences along the unknowns; at stations through the solved equilibrium."""
        half, rng = xhale.right, np.random.default_rng(5)
        settings = xhale.fit.model_copy(update={"loads": mode})
        measured = closed_form(half, 0.2, 1.0, 0.0).markers_m

        def measure(point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return 1e3 * (point - measured), np.tile(1e3 * np.eye(3), (18, 1, 1))

        problem = pose(half, settings, measure, np.ones(18, dtype=bool), np.full(18, 3.0)).problem
        theta = 0.1 * rng.standard_normal(problem.unknowns)

        def balanced(unknowns: np.ndarray):
            strain = np.zeros((half.beam.elements, 4))
            if problem.modes is not None:
                return linearise(problem, (problem.modes @ unknowns).reshape(-1, 4), unknowns)
            for _ in range(20):
                linear = linearise(problem, strain, unknowns)
                strain = strain + linear.correction.reshape(-1, 4)
            return linear

        here = balanced(theta)
        assert np.abs(here.correction).max() < 1e-10
        for j in rng.choice(problem.unknowns, 6, replace=False):
            h = 1e-5 * np.eye(problem.unknowns)[j]
            numeric = (balanced(theta + h).predicted - balanced(theta - h).predicted) / 2e-5
            scale = np.abs(numeric).max()
            assert here.jacobian[:, :, j] == pytest.approx(numeric, abs=1e-6 * scale + 1e-6)

    @pytest.mark.parametrize("kind", ["closed form", "loads"])
    def test_errors_are_as_large_as_their_sigmas_say(self, xhale, random_states, kind) -> None:
        """Squared errors over variances average to about one; below, as the marker model's σ is not in this noise."""
        rng = np.random.default_rng(13)
        truths = random_states(xhale, kind, 30, rng)
        fits = [fit_noisy(xhale, truth, 3e-3, rng) for truth in truths]
        pairs = list(zip(fits, truths, strict=True))
        shape = np.mean([((f.position_m - t.position_m)[3:] / f.sigma_position_m[3:]) ** 2 for f, t in pairs])
        twist = np.mean([((f.twist_rad - t.twist_rad)[3:] / f.sigma_twist_rad[3:]) ** 2 for f, t in pairs])
        # neighbouring nodes err together: 30 states × some 10 independent numbers, so ±25 % at two sigma, and the
        # prior is wider than these states are
        assert 0.6 < shape < 1.25
        assert 0.6 < twist < 1.25
        assert np.mean([f.chi2 / f.dof for f in fits]) == pytest.approx(1.0, abs=0.12)

    def test_a_full_covariance_is_used(self, xhale, closed_form) -> None:
        """Markers ten times worse along their line of sight: the 3 × 3 covariance keeps the good axes."""
        rng = np.random.default_rng(6)
        truth = closed_form(xhale.right, 0.2, 1.0, 0.0)
        spread = np.diag([5e-4, 5e-4, 5e-4]) ** 2 + np.outer([0, 0.8, 0.6], [0, 0.8, 0.6]) * 5e-3**2
        factor = np.linalg.cholesky(spread)
        full, flat = [], []
        for _ in range(15):
            measured = truth.markers_m + rng.standard_normal((18, 3)) @ factor.T
            full.append(fit_frame(truth.half, measured, np.tile(spread, (18, 1, 1)), xhale.fit))
            flat.append(fit_frame(truth.half, measured, isotropic(np.sqrt(np.trace(spread) / 3)), xhale.fit))
        assert rms_errors(full, [truth] * 15)[0] < 0.6 * rms_errors(flat, [truth] * 15)[0]

    def test_what_is_not_measured_is_uncertain(self, xhale, closed_form) -> None:
        truth = closed_form(xhale.right, 0.2, 1.0, 0.0)
        whole = fit_frame(truth.half, truth.markers_m, isotropic(1e-3), xhale.fit)
        inner = truth.markers_m.copy()
        inner[10:] = np.nan
        part = fit_frame(truth.half, inner, isotropic(1e-3), xhale.fit)
        assert part.sigma_position_m[-1, 2] > 5 * whole.sigma_position_m[-1, 2]
        assert abs(part.position_m[-1, 2] - truth.position_m[-1, 2]) < 3 * part.sigma_position_m[-1, 2]
        assert part.sigma_position_m[8, 2] < 2 * whole.sigma_position_m[8, 2]

    def test_pairs_too_close_cannot_tell_twist(self, closed_form) -> None:
        described = tomllib.loads(example_path("xhale.toml").read_text())
        for pair in described["markers"]["pairs"]:
            pair["chord_m"] = [0.005, -0.005]
        wing = build_wing(WingFile.model_validate(described))
        truth = closed_form(wing.right, 0.2, 2.0, 0.0)
        fit = fit_noisy(wing, truth, 3e-3, np.random.default_rng(7))
        assert np.degrees(fit.sigma_twist_rad[-1]) > 1.2


class TestRobustness:
    @pytest.mark.parametrize("mode", ["everywhere", "stations"])
    def test_gross_outliers_are_found_and_left_out(self, xhale, random_states, mode) -> None:
        rng = np.random.default_rng(15)
        settings = xhale.fit.model_copy(update={"loads": mode})
        truths = random_states(xhale, "loads", 20, rng)
        fits = []
        for truth in truths:
            wrong = rng.choice(18, 3, replace=False)
            measured = truth.markers_m + 1e-3 * rng.standard_normal((18, 3))
            measured[wrong] += rng.choice([0.03, 0.3, 3.0], (3, 1)) * rng.choice([-1.0, 1.0], (3, 3))
            fit = fit_frame(truth.half, measured, isotropic(1e-3), settings)
            assert fit.converged
            assert sorted(wrong) == np.flatnonzero(fit.outlier).tolist()
            assert not fit.used[wrong].any()
            assert np.isfinite(fit.residual_m).all()
            fits.append(fit)
        shape, _ = rms_errors(fits, truths)
        assert shape < 1.2

    def test_three_exchanged_markers(self, xhale, closed_form) -> None:
        truth = closed_form(xhale.right, 0.25, 1.0, 0.0)
        measured = truth.markers_m.copy()
        measured[[4, 6, 8]] = measured[[6, 8, 4]]
        fit = fit_frame(truth.half, measured, isotropic(1e-3), xhale.fit)
        assert np.flatnonzero(fit.outlier).tolist() == [4, 6, 8]

    @pytest.mark.parametrize("seen", [0, 1, 2])
    def test_too_few_markers_are_nan_with_a_reason(self, xhale, closed_form, seen) -> None:
        truth = closed_form(xhale.right, 0.2, 1.0, 0.0)
        measured = truth.markers_m.copy()
        measured[seen:] = np.nan
        fit = fit_frame(truth.half, measured, isotropic(1e-3), xhale.fit)
        assert not fit.converged
        assert fit.reason == f"{seen} of 18 markers measured, 3 needed"
        assert np.isnan(fit.position_m).all()
        assert np.isnan(fit.sigma_twist_rad).all()

    def test_a_covariance_that_is_none_counts_as_not_measured(self, xhale, closed_form) -> None:
        truth = closed_form(xhale.right, 0.2, 1.0, 0.0)
        cov = isotropic(1e-3)
        cov[2] = np.nan
        cov[3] = -np.eye(3)
        fit = fit_frame(truth.half, truth.markers_m, cov, xhale.fit)
        assert fit.converged
        assert np.flatnonzero(~fit.used).tolist() == [2, 3]
        assert np.isnan(fit.residual_m[[2, 3]]).all()
        assert not fit.outlier.any()

    @pytest.mark.parametrize("mode", ["everywhere", "stations"])
    def test_a_bad_start_does_not_change_the_answer(self, xhale, closed_form, mode) -> None:
        settings = xhale.fit.model_copy(update={"loads": mode})
        truth = closed_form(xhale.right, 0.25, 1.0, 0.003)
        cold = fit_frame(truth.half, truth.markers_m, isotropic(1e-3), settings)
        wild = replace(cold, strain=1e3 * cold.strain, unknowns=1e43 * cold.unknowns)
        warm = fit_frame(truth.half, truth.markers_m, isotropic(1e-3), settings, start=wild)
        assert warm.converged
        assert warm.position_m == pytest.approx(cold.position_m, abs=1e-5)
        lost = replace(cold, converged=False, strain=cold.strain * np.nan, unknowns=np.empty(0))
        assert fit_frame(truth.half, truth.markers_m, isotropic(1e-3), settings, start=lost).converged

    def test_a_warm_start_gives_the_cold_answer_sooner(self, xhale, closed_form) -> None:
        before, after = (closed_form(xhale.right, bend, 1.0, 0.0).markers_m for bend in (0.24, 0.25))
        first = fit_frame(xhale.right, before, isotropic(1e-3), xhale.fit)
        warm = fit_frame(xhale.right, after, isotropic(1e-3), xhale.fit, start=first)
        cold = fit_frame(xhale.right, after, isotropic(1e-3), xhale.fit)
        assert warm.iterations < cold.iterations
        assert warm.position_m == pytest.approx(cold.position_m, abs=2e-5)

    def test_random_points_are_not_a_wing(self, xhale) -> None:
        """Nothing plausible may come of nonsense: either a reason, or a misfit nobody can overlook."""
        rng = np.random.default_rng(16)
        for _ in range(10):
            fit = fit_frame(xhale.right, rng.uniform(-2, 2, (18, 3)), isotropic(1e-3), xhale.fit)
            assert not fit.converged or fit.chi2 / fit.dof > 100
            if fit.converged:
                assert fit.sigma_position_m[-1].max() > 0.01


class TestModelError:
    @pytest.mark.parametrize("factor", [0.9, 1.1])
    def test_stiffness_off_by_a_tenth_hardly_moves_the_shape(self, xhale, random_states, factor) -> None:
        """The shape is measured: with loads everywhere it does not lean on stiffness; the loads do."""
        rng = np.random.default_rng(18)
        described = tomllib.loads(example_path("xhale.toml").read_text())
        for segment in described["segment"]:
            for key in ("EA", "GJ", "EI_out", "EI_in", "k34"):
                segment[key] *= factor
        wrong = build_wing(WingFile.model_validate(described))
        for truth in random_states(xhale, "loads", 6, rng):
            measured = truth.markers_m + 1e-3 * rng.standard_normal((18, 3))
            right, off = (
                fit_frame(wing.half(truth.half.side), measured, isotropic(1e-3), xhale.fit) for wing in (xhale, wrong)
            )
            # the prior does, through the weights' share: by a hundredth of the noise
            assert off.position_m == pytest.approx(right.position_m, abs=3e-5)
            assert off.loads[:, 2].sum() == pytest.approx(factor * right.loads[:, 2].sum(), rel=0.05)

    @pytest.mark.parametrize(("mass_kg", "percent"), [(1.0, -22.097), (2.0, -38.829)])
    @pytest.mark.parametrize("mode", ["everywhere", "stations"])
    def test_measured_pazy_tip_is_followed_where_the_model_is_six_percent_off(self, mode, mass_kg, percent) -> None:
        """The Technion's measured tip: a softer wing reaches it, and the fit of the model's stiffness follows it."""
        described = tomllib.loads(example_path("pazy.toml").read_text())
        described["markers"] = {
            "pairs": [{"station_m": s, "chord_m": [0.03, -0.04]} for s in np.arange(0.05, 0.55, 0.06)]
        }
        described["fit"] = {"load_stations_m": [0.191249995, 0.382499992, 0.549843728], "loads": mode}
        wing = build_wing(WingFile.model_validate(described))
        truth, tip = pazy_bent_to(described, percent, mass_kg)
        fit = fit_frame(wing.right, truth, isotropic(5e-4, len(truth)), wing.fit)
        assert fit.converged
        assert 100 * fit.position_m[-1, 2] / 0.549843728 == pytest.approx(100 * tip / 0.549843728, abs=0.3)
        assert 100 * tip / 0.549843728 == pytest.approx(percent, abs=1e-3)


def pazy_bent_to(described: dict, percent: float, mass_kg: float) -> tuple[np.ndarray, float]:
    """Markers and tip of a Pazy wing softened until its tip mass bends it as far as measured."""
    from scipy.optimize import brentq

    from reconstruct.equilibrium import solve
    from reconstruct.loads_file import LoadsFile, loads_on

    def bent(factor: float):
        softer = {**described, "segment": [{**s, "EI_out": s["EI_out"] * factor} for s in described["segment"]]}
        half = build_wing(WingFile.model_validate(softer)).right
        load = {"station_m": half.node_s_m[-1], "force_n": (0, 0, -9.807 * mass_kg), "chord_m": -0.006}
        found = solve(half.beam, loads_on(half, LoadsFile.model_validate({"point": [load]})))
        return half, found.shape

    factor = brentq(lambda f: 100 * bent(f)[1].position_m[-1, 2] / 0.549843728 - percent, 0.7, 1.2)
    half, shape = bent(factor)
    R = shape.R_body_section[half.marker_node]
    points = shape.position_m[half.marker_node] + np.einsum("mab,mb->ma", R, half.marker_offset_m)
    return points, float(shape.position_m[-1, 2])
