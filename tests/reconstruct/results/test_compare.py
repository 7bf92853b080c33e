"""Comparison of two tables whose difference is known in closed form."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from capture.errors import UsageError
from process.reference import Window
from reconstruct.compare import compare, interpolate_shape
from reconstruct.tables import shape_series

SHIFT_M = (0.001, -0.002, 0.002)  # 3 mm long
TWIST_DEG = 0.25
REFERENCE_TIMES = np.arange(-0.2, 2.3, 0.011)  # denser than the sets, and never at the same instants


def write_result(folder: Path, wing: Any, times: np.ndarray, **markers: Any) -> Path:
    """Tables of a result: the wing's shape at 31 stations, with sigmas."""
    folder.mkdir()
    shape = wing.shape_table(times, stations=31)
    for name in ("x_m", "y_m", "z_m"):
        shape = shape.append_column(f"sigma_{name}", pa.array(np.full(shape.num_rows, 0.0015)))
    shape = shape.append_column("sigma_twist_deg", pa.array(np.full(shape.num_rows, 0.1)))
    pq.write_table(shape, folder / "shape.parquet")
    pq.write_table(wing.marker_table(times, **markers), folder / "markers.parquet")
    return folder


@pytest.fixture(scope="module")
def reference(bending_wing: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bending_wing().reference(tmp_path_factory.mktemp("compare") / "reference", REFERENCE_TIMES)


@pytest.fixture
def shifted(bending_wing: Any, frame_times: np.ndarray, tmp_path: Path) -> Path:
    wing = bending_wing(shift_m=SHIFT_M, extra_twist_deg=TWIST_DEG)
    return write_result(tmp_path / "result", wing, frame_times)


def test_a_known_shift_is_found(shifted: Path, reference: Path) -> None:
    found = compare(shifted, reference).summary
    # Splines of a 1.7 Hz motion sampled every 11 ms: (2π · 1.7 · 0.011)⁴ · 5/384 · 0.25 m < 1 µm; every 50 mm along
    # the span less. What is left of the known error's figures is below 10 µm.
    assert found["frames_compared"] == 100
    for key in ("shape_rms_mm", "tip_error_mm", "shape_max_mm", "marker_rms_mm", "marker_mean_mm"):
        assert found[key] == pytest.approx(3.0, abs=0.01), key
    for key in ("shape_bias_mm", "tip_bias_mm", "marker_bias_mm"):
        assert [found[key][axis] for axis in "xyz"] == pytest.approx([1.0, -2.0, 2.0], abs=0.01), key
    assert found["twist_rms_deg"] == pytest.approx(TWIST_DEG, abs=1e-3)
    assert found["tip_twist_bias_deg"] == pytest.approx(TWIST_DEG, abs=1e-3)
    assert found["markers_compared"] == 50 * 36
    assert all(one["spread_mm"] < 0.01 for one in found["markers"])
    # x is 1.0 mm off: within 1.96 · 1.5 mm, as are 2.0 mm; the twist is 2.5 sigmas off
    assert found["shape_within_95_percent"] == 100.0
    assert found["twist_within_95_percent"] == 0.0


def test_a_perfect_result_has_no_error(
    bending_wing: Any, frame_times: np.ndarray, reference: Path, tmp_path: Path
) -> None:
    found = compare(write_result(tmp_path / "result", bending_wing(), frame_times), reference)
    assert found.summary["shape_rms_mm"] < 0.01
    assert found.summary["marker_rms_mm"] < 0.01  # though every marker has its own instant, 8 ms off at most
    assert found.summary["twist_rms_deg"] < 1e-3
    assert found.shape_errors.num_rows == 2 * 50 * 31
    assert found.marker_errors.num_rows == 2 * 50 * 18


def test_noise_comes_out_as_rms_and_coverage(bending_wing: Any, reference: Path, tmp_path: Path) -> None:
    result = write_result(tmp_path / "result", bending_wing(), np.arange(50) * 0.04, sigma_m=0.002, missing=0.1)
    found = compare(result, reference).summary
    # about 1620 markers of 3 axes: RMS √3 · 2 mm to 1 / √(2 · 4860) = 1 %, coverage 95 ± 0.3 %
    assert found["marker_rms_mm"] == pytest.approx(2 * np.sqrt(3), rel=0.04)
    assert found["marker_within_95_percent"] == pytest.approx(95.0, abs=1.2)
    assert found["markers_compared"] == sum(one["compared"] for one in found["markers"])


def test_sets_outside_of_the_reference_are_counted_and_left_out(
    bending_wing: Any, reference: Path, tmp_path: Path
) -> None:
    wing = bending_wing(shift_m=SHIFT_M)
    result = write_result(tmp_path / "result", wing, 1.0 + np.arange(50) * 0.04)  # to 2.96 s; the reference to 2.297
    comparison = compare(result, reference)
    found = comparison.summary
    assert found["frames_outside_reference"] == 2 * 17
    assert found["frames_compared"] == 2 * 33
    assert found["shape_rms_mm"] == pytest.approx(3.0, abs=0.01)
    assert found["markers_outside_reference"] > 0
    lost = np.isnan(np.asarray(comparison.shape_errors.column("error_x_m")))
    assert lost.sum() == 2 * 17 * 31


def test_a_gap_in_the_reference_is_not_interpolated_across(
    bending_wing: Any, frame_times: np.ndarray, tmp_path: Path
) -> None:
    times = REFERENCE_TIMES[(REFERENCE_TIMES < 0.5) | (REFERENCE_TIMES > 0.9)]
    reference = bending_wing().reference(tmp_path / "reference", times)
    found = compare(write_result(tmp_path / "result", bending_wing(), frame_times), reference).summary
    assert found["frames_outside_reference"] == 2 * int(
        np.sum((frame_times > times[times < 0.5][-1]) & (frame_times < 0.9))
    )
    assert found["shape_rms_mm"] < 0.01


def test_sets_that_were_not_fitted(shifted: Path, reference: Path) -> None:
    table = pq.read_table(shifted / "shape.parquet")
    z = np.asarray(table.column("z_m")).copy()
    z[:31] = np.nan
    pq.write_table(table.set_column(table.column_names.index("z_m"), "z_m", pa.array(z)), shifted / "shape.parquet")
    found = compare(shifted, reference).summary
    assert (found["frames_compared"], found["frames_not_fitted"]) == (99, 1)
    assert found["sides"]["left"]["frames_not_fitted"] == 1


def test_stations_beyond_the_reference_leave_the_tip_unknown(shifted: Path, reference: Path, tmp_path: Path) -> None:
    short = tmp_path / "short"
    shutil.copytree(reference, short)
    table = pq.read_table(short / "shape.parquet")
    pq.write_table(table.filter(np.asarray(table.column("s_m")) < 2.75), short / "shape.parquet")
    found = compare(shifted, short).summary
    assert found["tip_error_mm"] is None
    assert found["shape_rms_mm"] == pytest.approx(3.0, abs=0.01)


def test_interpolation_along_the_span_keeps_the_curve(bending_wing: Any) -> None:
    wing = bending_wing()
    series = shape_series(wing.shape_table(REFERENCE_TIMES, stations=31), "made")["left"]
    s, wanted = np.linspace(0.03, 2.97, 17), np.array([0.123, 1.777])
    xyz, twist = interpolate_shape(
        series, series.timestamp_ns[0] + np.rint((wanted + 0.2) * 1e9).astype(np.int64), s, "made"
    )
    axis, _, turned = wing.section("left", *np.broadcast_arrays(s[None, :], wanted[:, None]))
    assert np.abs(xyz - axis).max() < 1e-5
    assert np.abs(twist - np.degrees(turned)).max() < 1e-3


@pytest.mark.parametrize("missing", ["shape.parquet", "markers.parquet"])
def test_a_missing_table_is_named(shifted: Path, reference: Path, missing: str) -> None:
    (shifted / missing).unlink()
    with pytest.raises(UsageError, match=f"{missing}: no such table"):
        compare(shifted, reference)


def test_another_flight(bending_wing: Any, reference: Path, tmp_path: Path) -> None:
    result = write_result(tmp_path / "result", bending_wing(), 1000 + np.arange(5) * 0.04)
    with pytest.raises(UsageError, match="same flight"):
        compare(result, reference)


def test_a_reference_of_one_set(shifted: Path, bending_wing: Any, tmp_path: Path) -> None:
    lone = bending_wing().reference(tmp_path / "lone", np.array([0.5]))
    with pytest.raises(UsageError, match="at least two sets"):
        compare(shifted, lone)


def test_a_folder_that_is_not_there(tmp_path: Path, reference: Path) -> None:
    with pytest.raises(UsageError, match="no such folder"):
        compare(tmp_path / "nothing", reference)


def test_displacements_from_a_window_do_not_have_what_is_always_off(shifted: Path, reference: Path) -> None:
    found = compare(shifted, reference, window=Window(0.0, 0.5)).summary
    assert found["displacement_rms_mm"] < 0.01
    assert found["displacement_twist_rms_deg"] < 1e-3
    assert "displacement_rms_mm" not in compare(shifted, reference).summary
    with pytest.raises(UsageError, match="--reference-window 50:60: no set of the left wing"):
        compare(shifted, reference, window=Window(50.0, 60.0))


def test_a_simulation_has_shapes_only_and_a_time_of_its_own(
    bending_wing: Any, frame_times: np.ndarray, tmp_path: Path
) -> None:
    result = write_result(tmp_path / "result", bending_wing(shift_m=SHIFT_M), frame_times)
    simulated = bending_wing().reference(tmp_path / "simulated", frame_times[0] + np.arange(0.0, 2.3, 0.011))
    (simulated / "markers.parquet").unlink()
    table = pq.read_table(simulated / "shape.parquet")
    own_ns = np.asarray(table.column("timestamp_ns"))
    place = table.column_names.index("timestamp_ns")
    table = table.set_column(place, "timestamp_ns", pa.array(own_ns - own_ns.min()))
    pq.write_table(table, simulated / "shape.parquet")
    with pytest.raises(UsageError, match="--from-start"):
        compare(result, simulated)
    found = compare(result, simulated, from_start=True).summary
    assert found["shape_rms_mm"] == pytest.approx(3.0, abs=0.01)
    assert found["markers_compared"] == 0
    assert found["marker_rms_mm"] is None


def test_arguments_in_the_wrong_order_are_told_so(shifted: Path, reference: Path) -> None:
    (shifted / "frames.parquet").touch()  # what a truth does not have
    with pytest.raises(UsageError, match=r"is no result of `reconstruct run`, .* is one: the result comes first"):
        compare(reference, shifted)
