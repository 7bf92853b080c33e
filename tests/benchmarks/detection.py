"""Detection on rendered full frames: time a frame, and error of the centres, beside other programs on the same frames.

Run: ``python tests/benchmarks/detection.py [--frames 8] [--rounds 5] [--json]``. Frames are 2080×1552 with 18 lights
as a right-hand camera sees them. The methods take turns, round by round, in one process on one core; quoted is the best
round's mean (the least disturbed one) and the ratio of each method's time to SimpleBlobDetector's in the same run.
Errors are of the lights that a method finds within 1.5 px of the truth.

    default, fast, paper   ours, process.detect
    SimpleBlobDetector     OpenCV, bright blobs, its own threshold steps
    trackpy, photutils     where installed: locate(diameter 9, separation 5), the most exact of those tried;
                           DAOStarFinder(fwhm 2.5) with a given threshold. They take seconds: once, four frames
"""

import argparse
import importlib
import json
import time
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from hw_sim.render import render_frame
from hw_sim.spots import led_spots
from hw_sim.wing_motion import LedMotion
from hw_sim.world import World
from process.detect import DetectSettings, detect

Array = NDArray[np.float64]
Frame = NDArray[np.uint8]
LIGHTS = 18
SLOW = ("trackpy", "photutils")


def scenes(count: int) -> list[tuple[Frame, Array]]:
    """Frames 0.37 s apart, and the true centres (18, 2) of their lights."""
    world = World.make(seed=3)
    camera = world.camera("right", "cam0")
    made = []
    for number in range(count):
        start_ns = world.epoch_ns + 400_000_000 + number * 370_000_000
        truth = led_spots(world, camera, LedMotion(world, "right"), start_ns, camera.exposure_us).centre_px[:LIGHTS]
        made.append((render_frame(world, camera, start_ns, seed=number), truth))
    return made


def methods() -> dict[str, Callable[[Frame], Array]]:
    """Each maps a frame to centres (N, 2)."""

    def ours(method: str) -> Callable[[Frame], Array]:
        settings = DetectSettings(method=method)  # type: ignore[arg-type]
        return lambda frame: detect(frame, settings).pixels

    parameters = cv2.SimpleBlobDetector_Params()
    parameters.filterByColor, parameters.blobColor = True, 255
    parameters.filterByArea, parameters.minArea = True, 3.0
    parameters.filterByConvexity = parameters.filterByInertia = False
    parameters.minThreshold, parameters.maxThreshold, parameters.thresholdStep = 30.0, 220.0, 10.0
    parameters.minDistBetweenBlobs = 5.0
    simple = cv2.SimpleBlobDetector_create(parameters)
    table = {name: ours(name) for name in ("default", "fast", "paper")}
    table["SimpleBlobDetector"] = lambda frame: np.array([k.pt for k in simple.detect(frame)]).reshape(-1, 2)
    trackpy, photutils = present("trackpy"), present("photutils.detection")
    if trackpy is not None:
        trackpy.quiet()
        table["trackpy"] = lambda frame: trackpy.locate(frame, 9, minmass=200, separation=5)[["x", "y"]].to_numpy()
    if photutils is not None:
        finder = photutils.DAOStarFinder(threshold=25.0, fwhm=2.5)

        def dao(frame: Frame) -> Array:
            found = finder(frame.astype(np.float64) - np.median(frame[::16, ::16]))
            names = ("x_centroid", "y_centroid") if "x_centroid" in found.colnames else ("xcentroid", "ycentroid")
            return np.stack([found[name] for name in names], axis=1)

        table["photutils"] = dao
    return table


def present(module: str):
    """The module, or None where it is not installed."""
    try:
        return importlib.import_module(module)
    except ImportError:
        return None


def errors_px(found: Array, truth: Array) -> Array:
    """(n, 2) errors of the true lights that have a centre within 1.5 px."""
    if not len(found):
        return np.empty((0, 2))
    apart = found[None] - truth[:, None]
    nearest = np.linalg.norm(apart, axis=2).argmin(axis=1)
    error = apart[np.arange(len(truth)), nearest]
    return error[np.linalg.norm(error, axis=1) < 1.5]


def main() -> None:
    """Measure and print."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--frames", type=int, default=8)
    options.add_argument("--rounds", type=int, default=5)
    options.add_argument("--json", action="store_true")
    wanted = options.parse_args()
    cv2.setNumThreads(1)
    made, table = scenes(wanted.frames), methods()
    seconds: dict[str, list[float]] = {name: [] for name in table}
    for number in range(wanted.rounds):
        for name, method in table.items():
            frames = made[:4] if name in SLOW else made
            if name in SLOW and number > 0:
                continue
            began = time.perf_counter()
            for frame, _ in frames:
                method(frame)
            seconds[name].append((time.perf_counter() - began) / len(frames))
    rows = {}
    for name, method in table.items():
        frames = made[:4] if name in SLOW else made
        errors = [errors_px(method(frame), truth) for frame, truth in frames]
        best = min(seconds[name])
        rows[name] = {
            "ms": 1000.0 * best,
            "median_ms": 1000.0 * float(np.median(seconds[name])),
            "frames_per_s": 1.0 / best,
            "times_faster_than_simple_blob": min(seconds["SimpleBlobDetector"]) / best,
            "found_of": [sum(map(len, errors)), LIGHTS * len(frames)],
            "rms_px": float(np.sqrt(np.mean(np.concatenate(errors) ** 2))),
        }
    if wanted.json:
        print(json.dumps(rows, indent=1))
        return
    print(f"{'':<20} {'ms/frame':>9} {'median':>8} {'ratio':>7} {'found':>9} {'RMS px':>8}")
    for name, row in rows.items():
        found = f"{row['found_of'][0]}/{row['found_of'][1]}"
        ratio = row["times_faster_than_simple_blob"]
        print(f"{name:<20} {row['ms']:9.2f} {row['median_ms']:8.2f} {ratio:7.1f} {found:>9} {row['rms_px']:8.4f}")


if __name__ == "__main__":
    main()
