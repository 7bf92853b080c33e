"""Series of fits against a wing known in closed form."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet
import pytest

from capture.errors import UsageError
from process.pipeline import BLOCK_TRIGGERS
from process.reference import Window, rest_shape
from process.tables import MARKER_SCHEMA
from reconstruct.instants import InstantSettings, at_common_instant
from reconstruct.result_tables import frames_table, result_tables
from reconstruct.series import fit_series
from reconstruct.tables import marker_series
from reconstruct.wing import read_wing

SIGMA_M = 0.001


def truth(wing: Any, side: str, s_m: np.ndarray, times_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Axis (F, S, 3) and twist (F, S)."""
    s, t = np.broadcast_arrays(s_m[None, :], times_s[:, None])
    axis, _, twist = wing.section(side, s, t)
    return axis, twist


@pytest.fixture(scope="module")
def noisy(bending_wing: Any, frame_times: np.ndarray) -> pa.Table:
    return bending_wing().marker_table(frame_times, sigma_m=SIGMA_M, missing=0.05)


class TestCommonInstant:
    def markers_at_instant(self, wing: Any, times: np.ndarray, **kwargs: Any) -> tuple[Any, np.ndarray]:
        """Right wing's markers brought to the common instants, and where they truly were then."""
        moved = at_common_instant(marker_series(wing.marker_table(times, **kwargs), "made")["right"])
        still = wing.marker_table(times, row_offset_s=0.0)
        return moved, marker_series(still, "made")["right"].xyz_m

    def test_the_motion_within_a_frame_is_taken_out(self, bending_wing: Any, frame_times: np.ndarray) -> None:
        moved, true = self.markers_at_instant(bending_wing(), frame_times)
        distance = np.linalg.norm(moved.xyz_m - true, axis=-1)
        raw = marker_series(bending_wing().marker_table(frame_times), "made")["right"].xyz_m
        # The tip swings at 1.1 Hz with 0.23 m: 1.6 m/s, so rows 8 ms off are up to 13 mm off before.
        assert np.linalg.norm(raw - true, axis=-1).max() > 0.008
        # Five points: |Π(T − tⱼ)|/5! · a ω⁵ = 8·32·48·72·88e-15/120 · 0.23 · 6.9⁵ = 0.02 mm; sets at the ends have
        # three points outside of which they lie: 8·48·88e-9/6 · 0.23 · 6.9³ = 0.4 mm.
        assert distance[2:-2].max() < 5e-5
        assert distance.max() < 1e-3

    def test_the_stated_covariance_holds_the_noise(self, bending_wing: Any) -> None:
        times = np.arange(400) * 0.04
        moved, true = self.markers_at_instant(bending_wing(), times, sigma_m=SIGMA_M, missing=0.1)
        known = moved.points > 0
        z = (moved.xyz_m - true)[known] / np.sqrt(np.diagonal(moved.cov_m2, axis1=-2, axis2=-1))[known]
        # 400 · 18 · 0.9 · 3 values, not independent between neighbours: their RMS is within 3 % of one.
        assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=0.03)

    def test_lone_sample_is_kept_where_it_is_and_doubted(self, bending_wing: Any) -> None:
        settings = InstantSettings(motion_m=0.2, motion_hz=1.0)
        table = bending_wing().marker_table(np.array([0.0, 5.0]), sigma_m=SIGMA_M)
        series = marker_series(table, "made")["left"]
        moved = at_common_instant(series, settings)
        assert np.array_equal(moved.points, np.ones((2, 18)))
        assert np.array_equal(moved.xyz_m, series.xyz_m)
        late_s = (series.timestamp_ns - series.frame_timestamp_ns[:, None]) * 1e-9
        expected = SIGMA_M**2 + (late_s * 0.2 * 2 * np.pi) ** 2
        assert np.allclose(moved.cov_m2[..., 2, 2], expected, rtol=1e-9)

    def test_missing_markers_stay_missing(self, noisy: pa.Table) -> None:
        series = marker_series(noisy, "made")["left"]
        moved = at_common_instant(series)
        assert np.array_equal(np.isfinite(moved.xyz_m).all(axis=-1), series.seen)
        assert np.array_equal(moved.points > 0, series.seen)

    def test_a_clock_step_is_not_interpolated_across(self, bending_wing: Any, frame_times: np.ndarray) -> None:
        series = marker_series(bending_wing().marker_table(frame_times), "made")["left"]
        stepped = series.timestamp_ns.copy()
        stepped[25:] -= 60_000_000  # the clock was set back by a set and a half
        frames = series.frame_timestamp_ns.copy()
        frames[25:] -= 60_000_000
        moved = at_common_instant(replace(series, timestamp_ns=stepped, frame_timestamp_ns=frames))
        plain = at_common_instant(series)
        assert moved.points[24].max() == 3
        assert moved.points[25].max() == 3
        assert np.abs(moved.xyz_m - plain.xyz_m).max() < 1e-3


class TestSeries:
    def test_shape_and_twist_are_found_within_their_sigmas(
        self, noisy: pa.Table, wing_file: Path, bending_wing: Any, frame_times: np.ndarray
    ) -> None:
        fits = fit_series(marker_series(noisy, "made"), read_wing(wing_file), workers=1)
        assert set(fits) == {"left", "right"}
        for side, found in fits.items():
            axis, twist = truth(bending_wing(), side, found.s_m, frame_times)
            assert found.converged.all()
            distance_mm = 1e3 * np.linalg.norm(found.xyz_m - axis, axis=-1)
            # 18 markers of 1 mm on a shape of some 5 parameters a direction: below 1 mm each along the span.
            assert np.sqrt(np.mean(distance_mm**2)) < 1.0
            # A pair 140 mm apart gives 1 mm · √2 / 140 mm = 0.6° of twist, nine of them less; the twist's shape
            # between three load stations adds some tenths.
            assert np.degrees(np.sqrt(np.mean((found.twist_rad - twist) ** 2))) < 0.6
            # the vertical bending is well covered by three loads: the errors of z are normal with the stated sigmas
            z = (found.xyz_m - axis)[:, 5:, 2] / found.sigma_xyz_m[:, 5:, 2]
            assert np.mean(np.abs(z) < 1.96) > 0.9
            assert np.mean(found.chi2 / found.dof) == pytest.approx(1.0, abs=0.3)

    @pytest.mark.slow
    def test_the_number_of_workers_changes_nothing(self, bending_wing: Any, wing_file: Path) -> None:
        table = bending_wing().marker_table(np.arange(BLOCK_TRIGGERS + 3) * 0.04, sigma_m=SIGMA_M)
        series, wing = marker_series(table, "made"), read_wing(wing_file)
        told: list[int] = []
        one = fit_series(series, wing, workers=1, progress=told.append)
        two = fit_series(series, wing, workers=2)
        assert sum(told) == 2 * (BLOCK_TRIGGERS + 3)
        for side in one:
            # to rounding: a worker process runs its linear algebra on one thread, this one may run it on several
            assert np.allclose(one[side].xyz_m, two[side].xyz_m, rtol=0, atol=1e-9)
            assert np.allclose(one[side].loads, two[side].loads, rtol=0, atol=1e-6)

    def test_sets_without_enough_markers_are_nan_and_say_why(self, bending_wing: Any, wing_file: Path) -> None:
        series = marker_series(bending_wing().marker_table(np.arange(8) * 0.04), "made")
        blind = series["left"].xyz_m.copy()
        blind[3, 2:] = np.nan
        blind[4] = np.nan
        fits = fit_series({"left": replace(series["left"], xyz_m=blind)}, read_wing(wing_file), workers=1)["left"]
        assert fits.converged.tolist() == [True] * 3 + [False] * 2 + [True] * 3
        assert np.isnan(fits.xyz_m[3:5]).all()
        assert np.isnan(fits.net[3:5]).all()
        assert [fits.flags[row] for row in (3, 4)] == ["not_fitted", "not_fitted"]
        assert "2 of 18 markers" in fits.reason[3]
        assert fits.flags[0] == ""

    def test_a_wing_that_misses_a_marker_in_the_table(self, bending_wing: Any, wing_file: Path) -> None:
        table = bending_wing().marker_table(np.arange(2) * 0.04)
        strange = table.set_column(2, "marker", pa.array(np.asarray(table.column("marker")) + 1, pa.int32()))
        with pytest.raises(UsageError, match="marker 18 on the left wing"):
            fit_series(marker_series(strange, "made"), read_wing(wing_file), workers=1)

    def test_no_marker_at_all(self, bending_wing: Any, wing_file: Path) -> None:
        table = bending_wing().marker_table(np.arange(3) * 0.04, missing=1.0)
        with pytest.raises(UsageError, match="no marker was measured"):
            fit_series(marker_series(table, "made"), read_wing(wing_file), workers=1)

    def test_net_load_is_the_sum_of_the_loads(self, bending_wing: Any, wing_file: Path) -> None:
        series = marker_series(bending_wing().marker_table(np.arange(3) * 0.04), "made")
        fits = fit_series(series, read_wing(wing_file), workers=1)["right"]
        nodes = [int(np.argmin(np.abs(fits.s_m - s))) for s in fits.load_s_m]
        arm = fits.xyz_m[:, nodes] - fits.xyz_m[:, :1]
        force, moment = fits.loads[..., :3], fits.loads[..., 3:]
        assert np.allclose(fits.net[:, :3], force.sum(axis=1))
        assert np.allclose(fits.net[:, 3:], (np.cross(arm, force) + moment).sum(axis=1))
        # In equilibrium the root carries EI times its curvature: 2 · slope of the tip / span, eq. of a clothoid.
        curvature = 2 * bending_wing().bend_rad(np.arange(3) * 0.04) / 3.0
        assert np.allclose(fits.net[:, 3], 112.0 * curvature, rtol=0.1)


class TestTables:
    @pytest.mark.parametrize("column", ["trigger_index", "x_m", "cov_yz_m2", "frame_timestamp_ns"])
    def test_a_missing_column_is_named(self, noisy: pa.Table, column: str) -> None:
        with pytest.raises(UsageError, match=f"made: lacks the columns {column}"):
            marker_series(noisy.drop_columns([column]), "made")

    def test_a_marker_twice(self, noisy: pa.Table) -> None:
        with pytest.raises(UsageError, match="a marker occurs twice"):
            marker_series(pa.concat_tables([noisy, noisy.slice(0, 1)]), "made")

    def test_a_third_side(self, noisy: pa.Table) -> None:
        middle = noisy.set_column(1, "side", pa.array(["middle"] * noisy.num_rows))
        with pytest.raises(UsageError, match="side is 'middle'"):
            marker_series(middle, "made")

    def test_markers_that_disagree_on_the_instant(self, noisy: pa.Table) -> None:
        times = np.asarray(noisy.column("frame_timestamp_ns")).copy()
        times[0] += 1
        place = noisy.column_names.index("frame_timestamp_ns")
        with pytest.raises(UsageError, match="must share one frame_timestamp_ns"):
            marker_series(noisy.set_column(place, "frame_timestamp_ns", pa.array(times)), "made")

    def test_row_order_does_not_matter(self, noisy: pa.Table) -> None:
        shuffled = noisy.take(np.random.default_rng(0).permutation(noisy.num_rows))
        for side, series in marker_series(noisy, "made").items():
            assert np.array_equal(series.xyz_m, marker_series(shuffled, "made")[side].xyz_m, equal_nan=True)


@pytest.fixture(scope="module")
def still(bending_wing: Any, wing_file: Path) -> Any:
    """At rest, bent by 0.2 rad and twisted by 1°, for a second; then 0.1 rad more."""
    wing = bending_wing(bend_rad=lambda t: np.where(t < 0.99, 0.2, 0.3), twist_rad=lambda t: np.radians(1.0) + 0 * t)
    table = wing.marker_table(np.arange(50) * 0.04, row_offset_s=0.0)
    markers = marker_series(table, "made")
    return wing, lambda reference: fit_series(markers, read_wing(wing_file), reference=reference, workers=1)


class TestReference:
    """Displacements are counted from what the user says, and say so."""

    def test_a_window_at_rest(self, still: Any) -> None:
        wing, fitted = still
        referred = fitted(Window(0.0, 0.9))
        tip = frames_table(referred["right"])
        assert referred["right"].reference == "mean of 0 to 0.9 s"
        assert np.abs(tip.column("tip_dz_m").to_numpy()[:20]).max() < 1e-4
        assert np.abs(tip.column("tip_twist_deg").to_numpy()).max() < 0.05
        bent, _ = truth(wing, "right", np.array([3.0]), np.array([0.0, 1.9]))
        assert tip.column("tip_dz_m").to_numpy()[-3] == pytest.approx(bent[1, 0, 2] - bent[0, 0, 2], abs=1e-3)

    def test_another_result(self, still: Any, tmp_path: Path) -> None:
        _, fitted = still
        fits = fitted(None)
        pyarrow.parquet.write_table(result_tables(fits)["shape.parquet"], tmp_path / "shape.parquet")
        referred = fitted(tmp_path)
        assert referred["left"].reference == f"mean of {tmp_path / 'shape.parquet'}"
        assert referred["left"].reference_xyz_m == pytest.approx(fits["left"].xyz_m.mean(axis=0))

    def test_markers_at_rest(self, still: Any, tmp_path: Path) -> None:
        wing, fitted = still
        path = tmp_path / "reference.parquet"
        table = wing.marker_table(np.arange(20) * 0.04, row_offset_s=0.0)
        for missing in MARKER_SCHEMA:
            if missing.name not in table.column_names:
                table = table.append_column(missing, pa.array(np.zeros(table.num_rows, int)).cast(missing.type))
        pyarrow.parquet.write_table(rest_shape(table, None, 1e-3), path)
        referred = fitted(path)
        assert referred["left"].reference == str(path)
        tip = frames_table(referred["right"])
        assert np.abs(tip.column("tip_dz_m").to_numpy()[:20]).max() < 1e-4
        lone = rest_shape(table.filter(pc.equal(table.column("side"), "left")), None, 1e-3)
        pyarrow.parquet.write_table(lone, path)
        with pytest.raises(UsageError, match="has no right wing"):
            fitted(path)

    def test_a_window_without_sets(self, still: Any) -> None:
        with pytest.raises(UsageError, match=r"no set of the (left|right) wing was fitted in it"):
            still[1](Window(10.0, 12.0))


class TestSmoothing:
    """Kalman and RTS on the unknowns: what neighbours tell, gaps bridged and marked, bands honest."""

    @pytest.fixture
    def gappy(self, bending_wing: Any, wing_file: Path) -> Any:
        """Three seconds with 3 mm noise; six sets see one marker, and half a second at the end sees none."""
        times = np.arange(75) * 0.04
        wing = bending_wing()
        table = wing.marker_table(times, sigma_m=3e-3, row_offset_s=0.0)
        trigger, marker = (table.column(name).to_numpy() for name in ("trigger_index", "marker"))
        number = trigger - trigger.min()
        keep = ~((number >= 30) & (number < 36) & (marker > 0)) & ~((number >= 62) & (marker > 0))
        series = marker_series(table.filter(pa.array(keep)), "made")
        return wing, times, {side: series[side] for side in ("right",)}, read_wing(wing_file)

    def test_better_than_each_set_by_itself(self, gappy: Any) -> None:
        wing, times, series, described = gappy
        single = fit_series(series, described, workers=1)["right"]
        smooth = fit_series(series, described, smooth_s=0.3, workers=1)["right"]
        axis, twist = truth(wing, "right", single.s_m, times)
        good = single.converged
        errors = [np.linalg.norm(fits.xyz_m - axis, axis=-1)[good] for fits in (single, smooth)]
        assert np.sqrt(np.mean(errors[1] ** 2)) < 0.8 * np.sqrt(np.mean(errors[0] ** 2))
        turned = [np.sqrt(np.mean((fits.twist_rad - twist)[good] ** 2)) for fits in (single, smooth)]
        assert turned[1] < 0.8 * turned[0]
        ratio = (smooth.xyz_m - axis)[good][:, 5:, 2] / smooth.sigma_xyz_m[good][:, 5:, 2]
        assert 0.4 < np.mean(ratio**2) < 1.5

    def test_gaps_are_bridged_and_marked(self, gappy: Any) -> None:
        wing, times, series, described = gappy
        smooth = fit_series(series, described, smooth_s=0.3, workers=1)["right"]
        axis, _ = truth(wing, "right", smooth.s_m, times)
        bridged = np.array(["bridged" in flags for flags in smooth.flags])
        assert np.flatnonzero(bridged).tolist() == list(range(30, 36))
        error = np.abs(smooth.xyz_m - axis)[bridged][:, -1, 2]
        assert np.all(error < 3 * smooth.sigma_xyz_m[bridged][:, -1, 2])
        assert smooth.sigma_xyz_m[33, -1, 2] > 2 * smooth.sigma_xyz_m[20, -1, 2]
        assert np.isnan(smooth.xyz_m[62:]).all()  # nothing after it: extrapolation is not a bridge
        assert all(flags == "not_fitted" for flags in smooth.flags[62:])
        assert smooth.reason[70] == "1 of 18 markers measured, 3 needed"
