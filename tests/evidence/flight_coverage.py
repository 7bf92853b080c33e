"""Whether bands hold the truth: short flights, each mounted, calibrated and surveyed anew, one draw of each counted.

``python flight_coverage.py FOLDER [--flights 500] [--first 0] [--workers 2]`` prints the figures. What it gets done
is kept in ``FOLDER/flight-coverage.jsonl``, a line a seed: stopped, it goes on where it was.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from scipy.stats import binomtest

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from short_flights import INSIDE_95, WITHIN_95, Drawn, fly


def main() -> None:
    """Fly what has not been flown, and print."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("folder", type=Path)
    options.add_argument("--flights", type=int, default=500)
    options.add_argument("--first", type=int, default=0, help="seed of the first flight")
    options.add_argument("--workers", type=int, default=2)
    given = options.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    kept = given.folder / "flight-coverage.jsonl"
    lines = kept.read_text().splitlines() if kept.exists() else []
    done = {one.seed: one for one in (Drawn(**json.loads(line)) for line in lines)}
    wanted = range(given.first, given.first + given.flights)
    todo = [seed for seed in wanted if seed not in done]
    with ProcessPoolExecutor(given.workers, get_context("spawn")) as pool, kept.open("a") as file:
        for one in pool.map(fly, todo):
            done[one.seed] = one
            file.write(json.dumps(asdict(one)) + "\n")
            file.flush()
    print("\n".join(table([done[seed] for seed in wanted])))


def table(flights: Sequence[Drawn]) -> list[str]:
    """The figures as markdown."""
    count = len(flights)
    rows = [f"Seeds {flights[0].seed} to {flights[-1].seed}, {count} flights.", ""]
    rows += ["| 95 % band of | holds the truth | p | squared error over variance | median error | median sigma |"]
    rows += ["|---|---|---|---|---|---|"]
    for name, inside, squares, error, sigma in (
        (
            "a marker's displacement (ellipsoid)",
            [one.marker_nees < INSIDE_95 for one in flights],
            np.mean([one.all_nees for one in flights]) / 3.0,
            f"{np.median([one.marker_error_mm for one in flights]):.3f} mm",
            f"{np.median([one.marker_sigma_mm for one in flights]):.3f} mm",
        ),
        (
            "the wing's displacement at a marker (one coordinate)",
            [abs(one.band) < WITHIN_95 for one in flights],
            np.mean([one.band_squares for one in flights]),
            f"{np.median([one.shape_error_mm for one in flights]):.3f} mm, 3-D",
            f"{np.median([one.shape_sigma_mm for one in flights]):.3f} mm",
        ),
        (
            "its twist there",
            [abs(one.twist) < WITHIN_95 for one in flights],
            np.mean([one.twist_squares for one in flights]),
            f"{np.median([one.twist_error_deg for one in flights]):.4f}°",
            f"{np.median([one.twist_sigma_deg for one in flights]):.4f}°",
        ),
    ):
        p = binomtest(int(sum(inside)), count, 0.95).pvalue
        rows.append(f"| {name} | {sum(inside)} of {count} | {p:.2g} | {squares:.2f} | {error} | {sigma} |")
    return rows


if __name__ == "__main__":
    main()
