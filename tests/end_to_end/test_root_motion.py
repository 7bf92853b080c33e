"""A flight whose camera pairs move against the fuselage, with its lights in view: the shape does not move with them."""

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from rendered_flight import true_rig, write_flight

from hw_sim.world import FUSELAGE_LIGHTS, MountMotion, World
from reconstruct.compare import compare
from reconstruct.run import Job, run_job
from reconstruct.wing import example_path

SECONDS = 4.0
MOVING = MountMotion(drift_mm=1.0, drift_mrad=1.0, vibration_mm=0.2, vibration_mrad=0.2)


def reconstruct(folder: Path, name: str, **options) -> dict:
    source = {"flights": (folder / "ssd_left", folder / "ssd_right"), "rig": folder / "rig.json", "markers": None}
    given = {**source, "wing": example_path("xhale.toml"), "out": folder / name, "workers": 1, "report": False}
    summary, _ = run_job(Job(**{**given, "csv": False, "also": (), **options}))
    return summary


@pytest.fixture(scope="module")
def flight(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("moving")
    world = World.make(5, 4, fuselage=FUSELAGE_LIGHTS, mount_motion=MOVING)
    write_flight(world, folder, SECONDS)
    true_rig(world).write(folder / "rig.json")
    return folder


def tip_error_mm(folder: Path, name: str) -> float:
    return float(compare(folder / name, folder / "truth").summary["tip_error_mm"])


@pytest.mark.slow
def test_a_moving_mount_is_taken_out_of_the_shape(flight):
    moved = reconstruct(flight, "with")
    assert set(moved["root_motion"]) == {"left", "right"}
    for found in moved["root_motion"].values():
        assert found["since"] == "survey"
        assert found["sets_with_lights_percent"] == 100.0
        assert 0.5 < found["turn_mrad"] < 1.5
    kept = reconstruct(flight, "without", root_motion=False)
    assert kept["root_motion"] == {}
    assert tip_error_mm(flight, "with") < 0.6  # of a quarter of the pixels; 0.3 mm for a mount at rest
    assert tip_error_mm(flight, "without") > 3 * tip_error_mm(flight, "with")
    frames = pq.read_table(flight / "with/frames.parquet").to_pandas()
    truth = pq.read_table(flight / "truth/mount.parquet").to_pandas()
    for side in ("left", "right"):
        own, known = frames[frames.side == side], truth[truth.side == side]
        for axis in "xyz":
            for ours, theirs, unit in ((f"root_turn_{axis}_rad", f"turn_{axis}_mrad", 1e-3),):
                at = np.interp(own.timestamp_ns, known.timestamp_ns, unit * known[theirs])
                assert np.abs(own[ours] - at).max() < 0.3e-3
                assert own[f"sigma_{ours}"].between(0.0, 0.2e-3).all()
    assert (frames.root_lights == 6).all()
    at_rest = pq.read_table(flight / "without/frames.parquet").to_pandas()
    assert at_rest.root_dx_m.isna().all()
    assert (at_rest.root_lights == 0).all()


@pytest.mark.slow
def test_a_results_own_markers_say_the_same(flight):
    """Its table is of markers as the pair at rest would have them, with the lights beside it."""
    if not (flight / "with/markers.parquet").is_file():
        reconstruct(flight, "with")
    again = reconstruct(flight, "again", flights=(), rig=None, markers=flight / "with/markers.parquet")
    assert str(flight / "with/markers_lights.parquet") in json.dumps(again["inputs"])
    one, other = (pq.read_table(flight / name / "shape.parquet") for name in ("with", "again"))
    np.testing.assert_allclose(one.column("z_m").to_numpy(), other.column("z_m").to_numpy(), atol=1e-9)


@pytest.mark.slow
def test_pixels_are_freed_of_the_motion_too(flight):
    reconstruct(flight, "direct", direct=True)
    assert tip_error_mm(flight, "direct") < 0.6
