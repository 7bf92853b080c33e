"""`reconstruct run --direct` beside eq. 7 on the same centroids of a moving wing; what it needs, and refuses."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from mounted_pair import mounted

from capture.errors import UsageError
from process.camera_model import Light, MarkerLayout, Rig, RigSide, StereoPair
from process.shared_error import with_rig
from process.tables import DIRECT_COLUMNS, MARKER_SCHEMA
from process.triangulate import triangulate
from reconstruct.run import Job, run_job

SIGMA_PX = 0.2  # far above a centroid's, so that errors are of millimetres
ROW_TIME_NS = 10_000.0
SETS = 60  # over a cut between blocks


def image_of(side: RigSide, camera: int, points_m: np.ndarray) -> np.ndarray:
    """(N, 2) pixels of body points, by OpenCV."""
    T = np.linalg.inv(side.T_body_cam0)
    T = side.pair.T_cam1_cam0 @ T if camera else T
    model = (side.pair.cam0, side.pair.cam1)[camera]
    return cv2.projectPoints(points_m, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], model.K, model.distortion)[0][:, 0]


class Flight:
    """Centroids of a wing at their rows' instants, as a marker table; some are hidden from one camera."""

    def __init__(self, wing: Any, hidden: float, seed: int, stations_m: tuple[float, ...], chord_m: tuple) -> None:
        self.wing, self.times_s = wing, np.arange(SETS) * 0.04
        self.start_ns = 1_700_000_000_000_000_000
        layout = MarkerLayout(stations_m, chord_m, 0.0, Light())
        self.rig = Rig(mounted(-1.0, ROW_TIME_NS), mounted(1.0, ROW_TIME_NS), layout)
        rng = np.random.default_rng(seed)
        parts = [self._side("right", rng, hidden)]
        self.table = with_rig(pa.concat_tables(parts), self.rig)

    def _side(self, name: str, rng: np.random.Generator, hidden: float) -> pa.Table:
        side, layout = self.rig.side(name), self.rig.markers
        s, count = np.repeat(layout.pairs_station_m, 2), 2 * len(layout.pairs_station_m)
        forward = np.tile(layout.chord_m, count // 2) * (1.0 if name == "right" else -1.0)
        middle_s = (side.pair.cam0.height - 1) / 2 * ROW_TIME_NS * 1e-9
        rows = []
        for trigger, time_s in enumerate(self.times_s):
            pixels, instants = np.empty((2, count, 2)), np.full((2, count), time_s)
            for camera in range(2):
                for _ in range(3):  # the row says when, and when says the row
                    axis, R, _ = self.wing.section(name, s, instants[camera])
                    pixels[camera] = image_of(side, camera, axis + R[..., 1] * forward[:, None])
                    instants[camera] = time_s - middle_s + pixels[camera, :, 1] * ROW_TIME_NS * 1e-9
            pixels += SIGMA_PX * rng.standard_normal(pixels.shape)
            lost = rng.random(count) < hidden
            pixels[rng.integers(0, 2, count)[lost], np.flatnonzero(lost)] = np.nan
            rows.append(self._rows(name, trigger, pixels, instants))
        return pa.concat_tables(rows)

    def _rows(self, name: str, trigger: int, pixels: np.ndarray, instants_s: np.ndarray) -> pa.Table:
        count = pixels.shape[1]
        spread = np.where(np.isnan(pixels)[..., None], np.nan, SIGMA_PX**2 * np.eye(2))
        points = triangulate(self.rig.side(name), *pixels, *spread, "default")
        own_ns = self.start_ns + np.rint(instants_s * 1e9).astype(np.int64)
        frame_ns = self.start_ns + round(self.times_s[trigger] * 1e9)
        own_ns = np.where(np.isnan(pixels[:, :, 0]), frame_ns, own_ns)
        both = np.isfinite(points.xyz_m[:, 0])
        columns = {
            "trigger_index": np.full(count, trigger),
            "side": [name] * count,
            "marker": np.arange(count),
            "timestamp_ns": np.where(both, own_ns[0] + (own_ns[1] - own_ns[0]) // 2, frame_ns),
            "frame_timestamp_ns": np.full(count, frame_ns),
            "time_sigma_ns": np.zeros(count),
            "ptp_state": ["SLAVE"] * count,
            **{f"{axis}_m": points.xyz_m[:, k] for k, axis in enumerate("xyz")},
            **{f"cov_{'xyz'[i]}{'xyz'[j]}_m2": points.covariance_m2[:, i, j] for i in range(3) for j in range(i, 3)},
            **{f"{axis}{k}_px": pixels[k, :, at] for k in range(2) for at, axis in enumerate("uv")},
            "epipolar_px": points.epipolar_px,
            "flags": np.where(both, "", "one_camera"),
            **{f"timestamp{k}_ns": own_ns[k] for k in range(2)},
            **{
                f"cov_{'uv'[i]}{'uv'[j]}{k}_px2": spread[k, :, i, j]
                for k in range(2)
                for i, j in ((0, 0), (0, 1), (1, 1))
            },
        }
        return pa.table({m.name: pa.array(columns[m.name], m.type) for m in MARKER_SCHEMA}, schema=MARKER_SCHEMA)

    def errors(self, out: Path) -> tuple[float, float, float]:
        """RMS of the shape (mm) and twist (deg), and how many sigmas² the shape's are (1 if they are honest)."""
        shape = pq.read_table(out / "shape.parquet").to_pandas()
        axis, _, twist = self.wing.section(
            "right", shape.s_m.to_numpy(), (shape.timestamp_ns.to_numpy() - self.start_ns) * 1e-9
        )
        off = shape[["x_m", "y_m", "z_m"]].to_numpy() - axis
        sigma = shape[["sigma_x_m", "sigma_y_m", "sigma_z_m"]].to_numpy()
        outer = shape.s_m.to_numpy() > 0.5
        return (
            1e3 * float(np.sqrt(np.nanmean(np.sum(off**2, axis=1)))),
            float(np.sqrt(np.nanmean((shape.twist_deg.to_numpy() - np.degrees(twist)) ** 2))),
            float(np.nanmean((off[outer, 2] / sigma[outer, 2]) ** 2)),
        )


def job(flight: Flight, wing_file: Path, folder: Path, **how: Any) -> tuple[Path, dict[str, Any]]:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "markers.parquet"
    pq.write_table(flight.table, path)
    out = folder / "out"
    given = {"csv": False, "report": False, "workers": 1} | how
    summary, _ = run_job(Job(markers=path, wing=wing_file, out=out, **given))
    return out, summary


@pytest.fixture(scope="module")
def make(bending_wing: Any) -> Any:
    stations, chord = (0.2, 0.5, 0.8, 1.2, 1.5, 1.8, 2.2, 2.5, 2.8), (0.04, -0.10)
    return lambda hidden, seed=5: Flight(bending_wing(), hidden, seed, stations, chord)


@pytest.fixture(scope="module")
def compared(make: Any, wing_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Hidden share → errors by eq. 7 and in direct mode."""
    folder = tmp_path_factory.mktemp("direct")
    found = {}
    for hidden in (0.0, 0.3, 0.6):
        flight = make(hidden)
        for direct in (False, True):
            out, summary = job(flight, wing_file, folder / f"{hidden}-{direct}", direct=direct)
            assert summary["direct"] is direct
            found[hidden, direct] = (*flight.errors(out), summary)
            print(hidden, direct, *np.round(found[hidden, direct][:3], 4), summary["chi2_per_dof"])
    return found


def test_with_every_light_in_both_cameras_it_is_as_good(compared: Any) -> None:
    by_places, by_pixels = compared[0.0, False], compared[0.0, True]
    assert by_pixels[0] == pytest.approx(by_places[0], rel=0.03)
    assert by_pixels[1] == pytest.approx(by_places[1], rel=0.03)
    assert by_pixels[3]["chi2_per_dof"] == pytest.approx(by_places[3]["chi2_per_dof"], rel=0.15)


def test_lights_that_one_camera_saw_make_it_better(compared: Any) -> None:
    for hidden, shape, twist in ((0.3, 0.6, 0.9), (0.6, 0.2, 0.5)):
        by_places, by_pixels = compared[hidden, False], compared[hidden, True]
        assert by_pixels[0] < shape * by_places[0]
        assert by_pixels[1] < twist * by_places[1]
        assert by_pixels[2] < 1.6
        assert by_pixels[3]["converged_percent"] == 100.0


@pytest.mark.parametrize("smooth_s", [0.0, 0.2])
def test_the_number_of_workers_changes_nothing(make: Any, wing_file: Path, tmp_path: Path, smooth_s: float) -> None:
    flight = make(0.3)
    one, _ = job(flight, wing_file, tmp_path / "one", direct=True, smooth_s=smooth_s)
    two, _ = job(flight, wing_file, tmp_path / "two", direct=True, smooth_s=smooth_s, workers=2)
    for name in ("shape", "frames", "loads", "residuals"):
        tables = [pq.read_table(out / f"{name}.parquet").to_pandas() for out in (one, two)]
        assert tables[0].equals(tables[1]), name  # NaN being equal to NaN


def test_cameras_that_disagree_do_not_lose_the_lights(make: Any, wing_file: Path, tmp_path: Path) -> None:
    """A calibration that is off by 1 px across the epipolar lines: neither mode leaves markers out."""
    flight = make(0.2)
    right = flight.rig.right
    turned = right.pair.T_cam1_cam0.copy()
    turned[:3, :3] = cv2.Rodrigues(np.array([1.0 / 1400.0, 0.0, 0.0]))[0] @ turned[:3, :3]
    wrong = replace(right, pair=StereoPair(right.pair.cam0, right.pair.cam1, turned))
    flight.table = with_rig(flight.table, Rig(flight.rig.left, wrong, flight.rig.markers))
    shifted = flight.table.column("epipolar_px").to_numpy() + 1.0 / np.sqrt(2)
    at = flight.table.column_names.index("epipolar_px")
    flight.table = flight.table.set_column(at, "epipolar_px", pa.array(shifted))
    out, summary = job(flight, wing_file, tmp_path, direct=True)
    assert summary["converged_percent"] == 100.0
    assert pq.read_table(out / "residuals.parquet").column("used").to_numpy(zero_copy_only=False).mean() > 0.99
    assert flight.errors(out)[0] < 6.0


def test_a_table_without_what_it_needs_is_refused(make: Any, wing_file: Path, tmp_path: Path) -> None:
    flight = make(0.0)
    whole = flight.table
    for table, says in (
        (whole.drop_columns(list(DIRECT_COLUMNS)), "make the table again with `wingproc markers`"),
        (whole.replace_schema_metadata({}), "does not say which cameras saw the markers"),
    ):
        flight.table = table
        with pytest.raises(UsageError, match=says):
            job(flight, wing_file, tmp_path, direct=True)
        assert not (tmp_path / "out").exists()
        job(flight, wing_file, tmp_path / "plain")
