"""Two sets of board images to the views both cameras measured well: files in, corners and reasons out."""

import glob
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.errors import ProcessError, UsageError
from process.board import FINDERS, Board, View, find_corners, read_grey, refuse_blank
from process.bundle import Freedom, adjust
from process.calibrate import (
    MIN_VIEWS,
    MIN_VIEWS_FOR_PRINT,
    Calibration,
    CalibrationSettings,
    Method,
    calibrate,
    check_poses_differ,
    start_alone,
)
from process.charuco import find_charuco
from process.workers import in_order

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".tif", ".tiff")
WORKERS = 2
CAMERAS = ("cam0", "cam1")


@dataclass(frozen=True, eq=False)
class Session:
    """The views of one board session, as found."""

    board: Board
    size_px: tuple[int, int]
    views: list[tuple[View, View]]
    """of cam0 and cam1"""


@dataclass(frozen=True, eq=False)
class SessionCalibration:
    """What a session's images gave."""

    calibration: Calibration
    finders: tuple[str, str]
    """the way the corners were measured that had the smaller residuals, for each camera"""
    finder_rms_px: tuple[dict[str, float], dict[str, float]]
    used: list[tuple[Path, Path]]
    rejected: list[tuple[Path, Path, str]]
    seen: list[tuple[Path, Path]]
    """views in which the board was found: what ``calibration.used`` and ``odd_corners`` count"""
    corners_px: Array
    """(2, views used, N, 2)"""


def image_pairs(cam0: str, cam1: str) -> list[tuple[Path, Path]]:
    """Pairs of files that belong together: both lists in the order of their names (numbers count as numbers).

    ``cam0`` and ``cam1`` are patterns such as "A*.png", or folders. Raises UsageError if there are no files, or if one
    camera's are missing.
    """
    first, second = (_image_files(pattern, name) for pattern, name in ((cam0, "--cam0"), (cam1, "--cam1")))
    if set(first) & set(second):
        raise UsageError(
            f"--cam0 and --cam1 both name {sorted(set(first) & set(second))[0]}: give each camera's own files"
        )
    lone = _without_partner(first, second)
    if lone:
        names = ", ".join(str(path) for path in lone[:5]) + (" …" if len(lone) > 5 else "")
        raise UsageError(f"the other camera's picture is missing for {names}: add it or take these out")
    if len(first) != len(second):
        raise UsageError(f"--cam0 has {len(first)} pictures and --cam1 {len(second)}: each view needs both")
    return list(zip(first, second, strict=True))


def _image_files(pattern: str, option: str) -> list[Path]:
    folder = Path(pattern)
    if folder.is_dir():
        found = [path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES]
    else:
        found = [Path(name) for name in glob.glob(pattern) if Path(name).is_file()]  # noqa: PTH207
    if not found:
        raise UsageError(
            f"{option} {pattern}: no pictures there; give a folder or a quoted pattern such as 'left/*.png'"
        )
    return sorted(found, key=_natural)


def _natural(path: Path) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdigit() else (0, part) for part in re.split(r"(\d+)", str(path))]


def _without_partner(first: Sequence[Path], second: Sequence[Path]) -> list[Path]:
    """Files whose number, the last in the name, the other camera lacks; none if the numbers have nothing in common."""
    numbers = [{_number(path): path for path in files} for files in (first, second)]
    common = numbers[0].keys() & numbers[1].keys()
    if len(common) <= 0.5 * max(len(first), len(second)):
        return []
    return [path for files in numbers for number, path in files.items() if number not in common]


def _number(path: Path) -> str:
    found = re.findall(r"\d+", path.stem)
    return str(int(found[-1])) if found else path.stem


def find_session(
    pairs: Sequence[tuple[Path, Path]],
    board: Board,
    workers: int = WORKERS,
    progress: Callable[[int, int], None] = lambda done, total: None,
    finders: Sequence[str] = FINDERS,
) -> Session:
    """Find the board in all images, its corners by each of ``finders``.

    ProcessError for a file that cannot be used, or of another size than the first.
    """
    jobs = [(path, board, tuple(finders)) for pair in pairs for path in pair]
    found: list[tuple[View, tuple[int, int]]] = []
    for done, result in enumerate(in_order(_find_one, jobs, workers), 1):
        found.append(result)
        progress(done, len(jobs))
    width, height = found[0][1]
    for view, size in found:
        if size != (width, height):
            raise ProcessError(
                f"{view.path}: {size[0]}x{size[1]} pixels, but {found[0][0].path} has {width}x{height}; "
                "all pictures of a pair must be of one size"
            )
    views = [view for view, _ in found]
    return Session(board, (width, height), list(zip(views[0::2], views[1::2], strict=True)))


def _find_one(job: tuple[Path, Board, tuple[str, ...]]) -> tuple[View, tuple[int, int]]:
    path, board, finders = job
    image = read_grey(path)
    refuse_blank(path, image)
    cv2.setNumThreads(1)
    return find_board(path, image, board, finders), (image.shape[1], image.shape[0])


def find_board(path: Path, image: Image, board: Board, finders: Sequence[str] = FINDERS) -> View:
    """Corners of the board in ``image``, a plain one or a ChArUco one."""
    return find_corners(path, image, board, finders) if board.charuco is None else find_charuco(path, image, board)


def finders_of(method: Method) -> tuple[str, ...]:
    """The ways to measure corners that a calibration chooses from: the paper's has cornerSubPix alone."""
    return ("subpix",) if method is Method.paper else FINDERS


def calibrate_session(session: Session, settings: CalibrationSettings) -> SessionCalibration:
    """Choose the better corners, calibrate, and name the views left out.

    Raises ProcessError if fewer than three views show the whole board in both cameras, and what ``calibrate`` raises.
    """
    seen, rejected = [], []
    for view0, view1 in session.views:
        missing = [f"{view.path.name}: {view.reason}" for view in (view0, view1) if not view.corners]
        if missing:
            rejected.append((view0.path, view1.path, "; ".join(missing)))
        else:
            seen.append((view0, view1))
    if len(seen) < MIN_VIEWS:
        raise ProcessError(_too_few(session, len(seen), rejected))
    chosen = [_choose_finder([pair[camera] for pair in seen], session, settings) for camera in (0, 1)]
    corners = np.stack([corners for corners, _, _ in chosen])
    if session.board.looks_the_same_upside_down:
        corners[1] = _same_way_up(corners)
    result = calibrate(corners, session.board, session.size_px, settings)
    for view, reason in result.rejected.items():
        rejected.append((seen[view][0].path, seen[view][1].path, reason))
    return SessionCalibration(
        replace(result, warnings=[*result.warnings, *_session_warnings(session, settings, len(rejected))]),
        (chosen[0][1], chosen[1][1]),
        (chosen[0][2], chosen[1][2]),
        [(seen[view][0].path, seen[view][1].path) for view in result.used],
        rejected,
        [(first.path, second.path) for first, second in seen],
        corners[:, result.used],
    )


def _too_few(session: Session, seen: int, rejected: list[tuple[Path, Path, str]]) -> str:
    board = session.board
    message = f"{seen} of {len(session.views)} views show the whole board in both cameras, {MIN_VIEWS} are needed"
    if rejected:
        message += f" ({rejected[0][2]}"
        message += ", and so on)" if len(rejected) > 1 else ")"
    return message + f"; is {board.columns}x{board.rows} the number of inner corners, one less than squares each way?"


def _choose_finder(
    views: Sequence[View], session: Session, settings: CalibrationSettings
) -> tuple[Array, str, dict[str, float]]:
    """Corners (V, N, 2) by the finder with the smallest residual of this camera alone, where all finders succeeded."""
    finders = [name for name in finders_of(settings.method) if any(name in view.corners for view in views)]
    complete = [view for view in views if all(name in view.corners for name in finders)]
    rms: dict[str, float] = {}
    board_moves = not settings.nominal_board and len(complete) >= MIN_VIEWS_FOR_PRINT
    if len(complete) >= MIN_VIEWS:
        for name in finders:
            corners = np.stack([view.corners[name] for view in complete])
            check_poses_differ(corners, session.board, session.size_px)
            start, _ = start_alone(corners, session.board, session.size_px, settings.distortion_terms)
            freedom = Freedom(distortion_terms=settings.distortion_terms, board=board_moves)
            rms[name] = adjust(corners[None], start, freedom).rms_px
    # stable: without residuals, FINDERS' order
    order = sorted(FINDERS, key=lambda name: (name not in finders, rms.get(name, np.inf)))
    corners = np.stack([next(view.corners[name] for name in order if name in view.corners) for view in views])
    return corners, order[0], rms


def _same_way_up(corners_px: Array) -> Array:
    """cam1's corners (V, N, 2), read from the other end where their first row runs against cam0's."""
    rows = corners_px[..., -1, :] - corners_px[..., 0, :]
    turned = np.sum(rows[0] * rows[1], axis=1) < 0.0
    return np.asarray(np.where(turned[:, None, None], corners_px[1][:, ::-1], corners_px[1]))


def _session_warnings(session: Session, settings: CalibrationSettings, rejected: int) -> list[str]:
    board, found = session.board, []
    if rejected > 0.3 * len(session.views):
        found.append(f"{rejected} of {len(session.views)} views were left out")
    if board.looks_the_same_upside_down and not settings.nominal_board:
        found.append(
            f"a {board.columns}x{board.rows} board looks the same upside down: its printed corners are only estimated "
            "rightly if it was the same way up in all views (else use --nominal-board)"
        )
    return found
