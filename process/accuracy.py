"""Pictures of targets at known places, and a calibration, to what the measured places are wrong by: Tables 6 and 7.

The error of a target is the paper's eq. 8, the mean distance of its N measured points from the true ones, in the first
camera's frame. Predictions are of the same quantity: the median and the 95 % point of its distribution when calibration
and noise are drawn from their covariances.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.errors import ProcessError
from process.board import Board, find_corners, read_grey
from process.camera_model import RigSide, StereoPair, read_pair
from process.cramer_rao import corner_bound_px, spot_bound_px
from process.detect import Detections, DetectSettings, detect
from process.shared_error import triangulated_by_calibration
from process.triangulate import triangulate

Array = NDArray[np.float64]

BOARD = Board(10, 7, 0.030)
CORNER_WINDOW_PX = 10.0
DRAWS = 400
PAPERS_CENTROIDS = DetectSettings(method="paper", paper_circularity=0.0)
"""without its gate, which loses small spots: here every spot is a light"""
NEAR_PX = 5.0  # a spot this close to where a light is, is the light's


@dataclass(frozen=True, eq=False)
class Calibrated:
    """A pair as calibrated, and what its corners were measured with."""

    pair: StereoPair
    finders: tuple[str, str]
    sigma_px: float
    rms_px: tuple[float, float, float]
    """cam0, cam1, stereo"""


@dataclass(frozen=True, eq=False)
class TargetError:
    """One target, measured."""

    kind: str
    """``board`` or ``lights``"""
    z_mm: float
    baseline_mm: float
    """the paper's method; NaN where it does not find the target"""
    ours_mm: float
    aligned_mm: float
    """after the rigid motion that brings the target nearest to its true place"""
    z_bias_mm: float
    bound95_mm: float
    """predicted"""
    crlb_mm: float
    """median for an unbiased way that measures corners and lights at the Cramér–Rao bound"""
    pixels: Array
    """(N, 2) in cam0"""
    errors_mm: Array
    """(N, 3) in cam0's frame"""
    papers_errors_mm: Array
    """(N, 3) by the paper's method; NaN where it has none"""


def read_calibrated(path: Path) -> Calibrated:
    """What ``wingproc calibrate`` wrote."""
    pair = read_pair(path)
    value = json.loads(path.read_text(encoding="utf-8"))
    found = value["calibration"]
    rms = (value["cameras"][0]["rms_px"], value["cameras"][1]["rms_px"], value["stereo"]["rms_px"])
    return Calibrated(pair, (found["finders"][0], found["finders"][1]), found["sigma_px"], rms)


def measure_targets(folder: Path, ours: Calibrated, papers: Calibrated, seed: int = 0) -> list[TargetError]:
    """Errors of all targets of ``folder``, as `wingsim accuracy-scenes` writes it."""
    stated = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    return [_measure(folder, target, stated["sensor"], ours, papers, seed) for target in stated["targets"]]


def _measure(
    folder: Path, target: dict[str, Any], sensor: dict[str, float], ours: Calibrated, papers: Calibrated, seed: int
) -> TargetError:
    kind, z_mm, truth = target["kind"], float(target["z_mm"]), np.array(target["points_m"])
    paths = [folder / "target" / f"{kind}_{round(z_mm):04d}_cam{camera}.png" for camera in (0, 1)]
    corner_px = corner_bound_px(
        sensor["contrast"], sensor["blur_px"], CORNER_WINDOW_PX, sensor["sigma_black"], sensor["sigma_white"]
    )
    if kind == "board":
        mine, theirs = (_corners(paths, names) for names in (ours.finders, ("subpix", "subpix")))
        covariance = [np.broadcast_to(np.eye(2) * ours.sigma_px**2, (len(truth), 2, 2))] * 2
        least_px = corner_px
    else:
        (mine, covariance), (theirs, _) = (
            _lights(paths, truth, ours.pair, method) for method in (DetectSettings(), PAPERS_CENTROIDS)
        )
        least_px = spot_bound_px(
            target["radius_px"], sensor["blur_px"], target["peak"], sensor["sigma_background"], sensor["shot_gain"]
        )
    errors = triangulate(_at_cam0(ours.pair), mine[0], mine[1], covariance[0], covariance[1], "default").xyz_m - truth
    alike = np.broadcast_to(np.eye(2), (len(truth), 2, 2))
    papers_errors = triangulate(_at_cam0(papers.pair), theirs[0], theirs[1], alike, alike, "paper").xyz_m - truth
    least = np.broadcast_to(np.eye(2) * least_px**2, (len(truth), 2, 2))
    rng = np.random.default_rng([seed, round(z_mm)])
    predicted = _drawn_mm(ours.pair, 1.0, truth, covariance, rng)
    limit = _drawn_mm(ours.pair, (corner_px / ours.sigma_px) ** 2, truth, [least, least], rng)
    return TargetError(
        kind,
        z_mm,
        _mean_mm(papers_errors),
        _mean_mm(errors),
        _mean_mm(_aligned(truth + errors, truth) - truth),
        1000.0 * float(errors[:, 2].mean()),
        float(np.percentile(predicted, 95.0)),
        float(np.median(limit)),
        mine[0],
        1000.0 * errors,
        1000.0 * papers_errors,
    )


def _mean_mm(errors_m: Array) -> float:
    """Eq. 8; NaN if a point was not measured."""
    return 1000.0 * float(np.linalg.norm(errors_m, axis=1).mean())


def _at_cam0(pair: StereoPair) -> RigSide:
    return RigSide(pair, np.eye(4), "", "", 0.0)


def _corners(paths: list[Path], finders: tuple[str, str]) -> list[Array]:
    found = []
    for path, finder in zip(paths, finders, strict=True):
        view = find_corners(path, read_grey(path), BOARD, (finder,))
        if finder not in view.corners:
            raise ProcessError(f"{path}: the target is not found ({view.reason or finder}); take this distance out")
        found.append(view.corners[finder])
    return found


def _lights(
    paths: list[Path], truth: Array, pair: StereoPair, settings: DetectSettings
) -> tuple[list[Array], list[Array]]:
    """Centroids (N, 2) and covariances (N, 2, 2) of the lights in both pictures; NaN where there is none.

    ``pair`` says only which spot is which.
    """
    pixels, covariance = [], []
    in_cam1 = truth @ pair.T_cam1_cam0[:3, :3].T + pair.T_cam1_cam0[:3, 3]
    for path, camera, points in zip(paths, (pair.cam0, pair.cam1), (truth, in_cam1), strict=True):
        found: Detections = detect(read_grey(path), settings)
        expected = camera.project(points)
        pixels.append(np.full((len(truth), 2), np.nan))
        covariance.append(np.full((len(truth), 2, 2), np.nan))
        if not len(found):
            continue
        apart = np.linalg.norm(expected[:, None] - found.pixels, axis=2)
        nearest = apart.argmin(axis=1)
        good = apart.min(axis=1) < NEAR_PX
        pixels[-1][good] = found.pixels[nearest[good]]
        covariance[-1][good] = found.covariance_px2[nearest[good]]
    return pixels, covariance


def _aligned(points: Array, truth: Array) -> Array:
    """``points`` moved rigidly to ``truth`` (N, 3) with least squares (Kabsch, 1976)."""
    from_, to = points.mean(axis=0), truth.mean(axis=0)
    U, _, Vt = np.linalg.svd((truth - to).T @ (points - from_)) if np.isfinite(points).all() else (np.eye(3),) * 3
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return np.asarray((points - from_) @ R.T + to)


def _drawn_mm(
    pair: StereoPair, part: float, truth: Array, covariance_px2: list[Array], rng: np.random.Generator
) -> Array:
    """(DRAWS,) errors by eq. 8, with ``part`` of the calibration's covariance and centroids of ``covariance_px2``."""
    if pair.covariance is None:
        return np.full(DRAWS, np.nan)
    values, vectors = np.linalg.eigh(pair.covariance * part)
    shared = rng.normal(size=(DRAWS, 24)) * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
    errors = np.einsum("nij,dj->dni", triangulated_by_calibration(pair, truth), shared)
    side = _at_cam0(pair)
    in_cam1 = truth @ pair.T_cam1_cam0[:3, :3].T + pair.T_cam1_cam0[:3, 3]
    seen = pair.cam0.project(truth), pair.cam1.project(in_cam1)
    noise = triangulate(side, *seen, covariance_px2[0], covariance_px2[1], "default").covariance_m2
    errors = errors + np.einsum("nij,dnj->dni", np.linalg.cholesky(noise), rng.normal(size=errors.shape))
    return np.asarray(1000.0 * np.linalg.norm(errors, axis=2).mean(axis=1))
