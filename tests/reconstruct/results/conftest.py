"""A wing whose shape is known in closed form, as the tables a flight of it would give."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from scipy.special import fresnel

SPAN_M = 3.0
STATIONS_M = (0.2, 0.5, 0.8, 1.2, 1.5, 1.8, 2.2, 2.5, 2.8)
CHORD_M = (0.04, -0.10)
START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 40_000_000

# Equal bending stiffnesses: a twisted section bent in a vertical plane then needs no in-plane moment.
WING_TOML = """
name = "Straight test wing"

[[segment]]
length_m = 3.0
elements = 30
EA = 2.14e6
GJ = 59.3
EI_out = 112.0
EI_in = 112.0

[markers]
pairs = [
{pairs}
]

[fit]
load_stations_m = [1.0, 2.0, 3.0]
"""


@dataclass(frozen=True)
class BendingWing:
    """A straight wing of 3 m that bends and twists as under loads that vanish at the tip; its axis keeps its length.

    Curvature falls linearly to zero at the tip, so that the axis is a clothoid (Fresnel's integrals). It stays in the
    plane x = 0, so its level direction is −x and incidence is the chord's turn about the axis.
    """

    bend_rad: Callable[[np.ndarray], np.ndarray] = field(  # slope of the tip, up
        default=lambda t: 0.35 + 0.12 * np.sin(2 * np.pi * 1.1 * t)
    )
    twist_rad: Callable[[np.ndarray], np.ndarray] = field(  # of the tip, nose-up
        default=lambda t: 0.05 + 0.03 * np.cos(2 * np.pi * 1.7 * t)
    )
    shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # a known error of the whole wing
    extra_twist_deg: float = 0.0

    def section(self, side: str, s_m: np.ndarray, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Axis positions (…, 3), rotations (…, 3, 3) with columns e1, e2, e3, and twist (…) at matching s and times."""
        beyond = 1 - s_m / SPAN_M  # what is left to the tip
        bend, slope = self.bend_rad(time_s), self.bend_rad(time_s) * (1 - beyond**2)
        twist = self.twist_rad(time_s) * (1 - beyond**2)
        scale = np.sqrt(2 * bend / np.pi)  # ∫ cos(b v²) dv = C(√(2b/π) v) / √(2b/π), and so for sin
        sines, cosines = (a - b for a, b in zip(fresnel(scale), fresnel(scale * beyond), strict=True))
        along = SPAN_M / scale * (np.cos(bend) * cosines + np.sin(bend) * sines)
        up = SPAN_M / scale * (np.sin(bend) * cosines - np.cos(bend) * sines)
        out = 1.0 if side == "right" else -1.0
        axis = np.stack([0 * slope, out * along, up], axis=-1) + np.array(self.shift_m)
        e1 = np.stack([0 * slope, out * np.cos(slope), np.sin(slope)], axis=-1)
        level = np.stack([-1.0 + 0 * slope, 0 * slope, 0 * slope], axis=-1)
        upper = np.stack([0 * slope, -out * np.sin(slope), np.cos(slope)], axis=-1)
        forward = np.cos(twist)[..., None] * level + np.sin(twist)[..., None] * upper
        e3 = np.cos(twist)[..., None] * upper - np.sin(twist)[..., None] * level
        return axis, np.stack([e1, out * forward, e3], axis=-1), twist

    def shape_table(self, times_s: np.ndarray, stations: int = 61) -> pa.Table:
        """The shape table of a reference sampled at ``times_s``."""
        parts = []
        s = np.linspace(0, SPAN_M, stations)
        for side in ("left", "right"):
            s_all, time = np.tile(s, times_s.size), np.repeat(times_s, stations)
            axis, _, twist = self.section(side, s_all, time)
            parts.append(
                pa.table(
                    {
                        "trigger_index": np.repeat(np.arange(times_s.size), stations),
                        "side": [side] * s_all.size,
                        "timestamp_ns": START_NS + np.rint(time * 1e9).astype(np.int64),
                        "station": np.tile(np.arange(stations, dtype=np.int32), times_s.size),
                        "s_m": s_all,
                        **{f"{name}_m": axis[:, at] for at, name in enumerate("xyz")},
                        "twist_deg": np.degrees(twist) + self.extra_twist_deg,
                    }
                )
            )
        return pa.concat_tables(parts)

    def marker_table(
        self,
        times_s: np.ndarray,
        *,
        row_offset_s: float = 0.008,
        sigma_m: float = 0.0,
        missing: float = 0.0,
        seed: int = 1,
    ) -> pa.Table:
        """The marker table: outer pairs are read out before the frame's middle row, inner ones after it."""
        rng = np.random.default_rng(seed)
        marker = np.arange(18)
        s = np.repeat(STATIONS_M, 2)
        late_s = row_offset_s * np.linspace(1, -1, 18)
        parts = []
        for side in ("left", "right"):
            time = times_s[:, None] + late_s
            axis, R, _ = self.section(side, np.broadcast_to(s, time.shape), time)
            forward = np.tile(CHORD_M, 9) * (1.0 if side == "right" else -1.0)
            xyz = axis + R[..., 1] * forward[:, None]
            lost = rng.random(time.shape) < missing
            xyz = np.where(lost[..., None], np.nan, xyz + sigma_m * rng.standard_normal(xyz.shape))
            variance = np.where(lost, np.nan, max(sigma_m, 1e-4) ** 2).ravel()
            frame_ns = START_NS + np.rint(times_s * 1e9).astype(np.int64)
            own_ns = START_NS + np.rint(time * 1e9).astype(np.int64)
            parts.append(
                pa.table(
                    {
                        "trigger_index": np.repeat(np.arange(times_s.size), 18),
                        "side": [side] * xyz[..., 0].size,
                        "marker": np.tile(marker, times_s.size).astype(np.int32),
                        "timestamp_ns": np.where(lost, frame_ns[:, None], own_ns).ravel(),
                        "frame_timestamp_ns": np.repeat(frame_ns, 18),
                        **{f"{name}_m": xyz[..., at].ravel() for at, name in enumerate("xyz")},
                        **{f"cov_{name}_m2": variance for name in ("xx", "yy", "zz")},
                        **{f"cov_{name}_m2": np.where(lost.ravel(), np.nan, 0.0) for name in ("xy", "xz", "yz")},
                        "flags": np.where(lost, "not_seen", "").ravel().tolist(),
                    }
                )
            )
        return pa.concat_tables(parts)

    def reference(self, folder: Path, times_s: np.ndarray) -> Path:
        """A reference folder, densely sampled at ``times_s``; every marker at the common instant."""
        folder.mkdir(parents=True, exist_ok=True)
        markers = self.marker_table(times_s, row_offset_s=0.0)
        for name, table in (("shape", self.shape_table(times_s)), ("markers", markers)):
            untriggered = table.set_column(0, "trigger_index", pa.array(np.full(table.num_rows, -1)))
            pyarrow.parquet.write_table(untriggered, folder / f"{name}.parquet")
        return folder


@pytest.fixture(scope="session")
def bending_wing() -> type[BendingWing]:
    return BendingWing


@pytest.fixture(scope="session")
def wing_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("wing") / "wing.toml"
    pairs = "\n".join(f"  {{ station_m = {s}, chord_m = [{CHORD_M[0]}, {CHORD_M[1]}] }}," for s in STATIONS_M)
    path.write_text(WING_TOML.format(pairs=pairs))
    return path


@pytest.fixture(scope="session")
def frame_times() -> np.ndarray:
    """50 sets at 25 Hz."""
    return np.arange(50) * PERIOD_NS * 1e-9
