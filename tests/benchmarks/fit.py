"""The fit of a flight's marker table, in one process: time a half wing with nothing else, and with bands and tables.

Run: ``python tests/benchmarks/fit.py [--sets 400] [--rounds 5] [--json]``. One half wing of the simulated X-HALE in
motion at 25 Hz, 18 markers with 0.3 mm of noise; the prior's scale is given, as in a flight, where it is chosen once.
Quoted is processor time, the best round's mean.

    in turn     fit_frame, each set from the last one's fit: a caller with one set at a time
    block       the flight's blocks of 50 sets, fitted together
    stage       the same, with the bands of what all frames share, and the result's tables
"""

import argparse
import json
import time
from collections.abc import Callable

import numpy as np
import pyarrow as pa

from hw_sim.wing_motion import LedMotion
from hw_sim.world import World
from process.camera_model import CameraModel, Light, MarkerLayout, Rig, RigSide, StereoPair
from process.rig import approximate_pose
from process.shared_error import with_rig
from process.workers import Shared
from reconstruct.fit import fit_frame
from reconstruct.observed import observe
from reconstruct.result_tables import part_tables
from reconstruct.series import FitHow, FitJob, fit_stretch, prior_scale, stretches, window_fits
from reconstruct.shared import SharedError, shared_errors
from reconstruct.tables import MarkerSeries
from reconstruct.wing import example_path, read_wing

SIGMA_M = 3e-4
ALWAYS_NS = (0, 2**62)


def flight(sets: int) -> MarkerSeries:
    """The right wing's markers, each at the set's instant."""
    world, rng = World.make(seed=3), np.random.default_rng(5)
    motion = LedMotion(world, "right")
    times_ns = world.epoch_ns + (np.arange(sets) * 40_000_000).astype(np.int64)
    places, _ = motion.centres(np.repeat(times_ns[:, None], len(motion), axis=1))
    markers = places.shape[1]
    return MarkerSeries(
        side="right",
        marker=np.arange(markers),
        trigger_index=np.arange(sets),
        frame_timestamp_ns=times_ns,
        timestamp_ns=np.repeat(times_ns[:, None], markers, axis=1),
        xyz_m=places + SIGMA_M * rng.standard_normal(places.shape),
        cov_m2=np.tile(SIGMA_M**2 * np.eye(3), (sets, markers, 1, 1)),
        flags=np.full((sets, markers), "", dtype=object),
        time_sigma_ns=np.full(sets, 1e3),
        ptp_state=np.full(sets, "SLAVE", dtype=object),
    )


def calibration() -> SharedError:
    """What a careful calibration and survey leave, of a pair that looks along the right wing."""
    camera = CameraModel(2080, 1552, np.array([[1400.0, 0, 1040], [0, 1400, 776], [0, 0, 1]]), np.zeros(5))
    lens = [0.06, 0.06, 0.06, 0.06, 8e-5, 1.6e-4, 6e-6, 6e-6, 1e-4]
    sigma = np.array([*lens, *lens, *[2e-5] * 3, *[8e-6] * 3])
    between = np.eye(4)
    between[0, 3] = -0.28
    pair = StereoPair(camera, camera, between, np.diag(sigma**2))
    pose = approximate_pose(pair, np.array([0.03, -0.2, 0.08]), np.array([0.0, 0.99, 0.12]))
    side = RigSide(pair, pose, "0", "1", 0.0, np.diag([4e-5] * 3 + [6e-5] * 3) ** 2, None)
    layout = MarkerLayout((0.2, 0.5, 0.8, 1.2, 1.5, 1.8, 2.2, 2.5, 2.8), (0.04, -0.1), 0.004, Light(0.004, 0.0005))
    return shared_errors(with_rig(pa.table({"x": [1]}), Rig(side, side, layout)))["right"]


def best_ms(sets: int, rounds: int, work: Callable[[], object]) -> float:
    """Processor time a set, of the least disturbed round."""
    taken = []
    for _ in range(rounds):
        begin = time.process_time()
        work()
        taken.append(time.process_time() - begin)
    return 1e3 * min(taken) / sets


def main() -> None:
    """Measure and print."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--sets", type=int, default=400)
    options.add_argument("--rounds", type=int, default=5)
    options.add_argument("--json", action="store_true")
    given = options.parse_args()
    wing, series = read_wing(example_path("xhale.toml")), flight(given.sets)
    how = FitHow(wing.right, wing.fit)
    scale = prior_scale(how, observe(series, how.half, None, how.instants)[:60])
    alone = Shared(FitHow(wing.right, wing.fit, prior_scale=scale))
    whole = Shared(FitHow(wing.right, wing.fit, prior_scale=scale, shared=calibration()))

    def in_turn() -> None:
        fit = None
        for xyz, cov in zip(series.xyz_m, series.cov_m2, strict=True):
            fit = fit_frame(wing.right, xyz, cov, wing.fit, start=fit, prior_scale=scale)
            assert fit.converged

    def block() -> None:
        for one in stretches(series, how.around_s):
            assert all(fit.converged for fit in window_fits(FitJob(one, alone, ALWAYS_NS)))

    def stage() -> None:
        for one in stretches(series, how.around_s):
            part_tables(fit_stretch(FitJob(one, whole)))

    found = {work.__name__: best_ms(given.sets, given.rounds, work) for work in (in_turn, block, stage)}
    if given.json:
        print(json.dumps(found))
        return
    for name, ms in found.items():
        print(f"{name.replace('_', ' '):8s}  {ms:.2f} ms a half wing, {1e3 / ms:.0f} a second")


if __name__ == "__main__":
    main()
