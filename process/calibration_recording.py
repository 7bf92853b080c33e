"""A recording in which a board was held before a pair to a session of views: sets looked at, still ones, far apart."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.errors import ProcessError
from process.board import Board, View
from process.calibration_session import Session, find_board
from process.recording import FrameSetReader, Recording, SetPlaces
from process.workers import in_order

Array = NDArray[np.float64]

LOOKED_AT = 120
"""sets, evenly over the recording: finding a board takes a good part of a second"""
MOST_VIEWS = 40
STILL_PX = 0.3
"""a board that moves by more from one frame to the next is bent by the rolling shutter, and blurred"""
ALIKE = 0.9  # correlation of a corner's neighbourhood with itself a frame later

_Job = tuple[SetPlaces, SetPlaces | None, Board]


def find_in_recording(
    recording: Recording,
    side: str,
    board: Board,
    workers: int = 2,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Session:
    """Views of the board by one side's pair; each is named after its file and trigger.

    Raises ProcessError if the side has no frame sets, or fewer than three show the board to both cameras, at rest.
    """
    sets = [places for places in recording.sides.get(side, ()) if None not in places.images]
    if not sets:
        there = ", ".join(recording.sides) or "none"
        raise ProcessError(f"{recording.files[0]}: no frame sets of the {side} pair (sides recorded: {there})")
    chosen = np.unique(np.linspace(0, len(sets) - 1, LOOKED_AT).astype(int)).tolist()
    jobs = [(sets[k], sets[k + 1] if k + 1 < len(sets) else None, board) for k in chosen]
    views: list[tuple[View, View]] = []
    size_px = (0, 0)
    for done, (first, second, size) in enumerate(in_order(_find_set, jobs, workers), 1):
        size_px = size
        if first.corners and second.corners:
            views.append((first, second))
        progress(done, len(jobs))
    if len(views) < 3:
        raise ProcessError(
            f"{recording.files[0]}: {len(views)} of {len(jobs)} sets looked at show the whole "
            f"{board.columns}x{board.rows} board at rest to both {side} cameras, 3 are needed; hold it still for a "
            "second in each of fifteen places"
        )
    return Session(board, size_px, [views[k] for k in _far_apart(views)])


def _find_set(job: _Job) -> tuple[View, View, tuple[int, int]]:
    places, next_places, board = job
    cv2.setNumThreads(1)
    with FrameSetReader() as reader:
        images = reader.read(places).images
        later = reader.read(next_places).images[0] if next_places is not None else None
    name = [Path(f"{place.path}#{places.trigger_index}") for place in places.images if place is not None]
    first_image, second_image = images
    if first_image is None or second_image is None:
        nothing = View(name[0], {}, "the frame cannot be read")
        return nothing, nothing, (0, 0)
    size = (first_image.shape[1], first_image.shape[0])
    first = find_board(name[0], first_image, board)
    if not first.corners:
        return first, View(name[1], {}, "not looked at"), size
    if later is not None:
        moved_px = _moved_px(first_image, later, next(iter(first.corners.values())))
        if moved_px > STILL_PX:
            return View(name[0], {}, "the board moves"), first, size
    return first, find_board(name[1], second_image, board), size


def _moved_px(now: NDArray[np.uint8], later: NDArray[np.uint8], corners: Array) -> float:
    """Median distance of the board's corners from where they were; infinite if they are no longer around there."""
    start = corners[np.isfinite(corners).all(axis=1)]
    windows = np.rint(start).astype(int)[:, None] + np.indices((11, 11)).reshape(2, -1).T - 5
    columns, rows = np.clip(windows, 0, [now.shape[1] - 1, now.shape[0] - 1]).transpose(2, 0, 1)
    before, after = (image[rows, columns].astype(np.float64) for image in (now, later))
    before, after = (grey - grey.mean(axis=1, keepdims=True) for grey in (before, after))
    alike = np.sum(before * after, axis=1) / (np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1) + 1e-9)
    if np.median(alike) < ALIKE:
        return float("inf")
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 1e-3)
    places = start.astype(np.float32).reshape(-1, 1, 2)
    found, again = (
        cv2.cornerSubPix(np.ascontiguousarray(image), places.copy(), (5, 5), (-1, -1), criteria)
        for image in (later, now)
    )
    return float(np.median(np.linalg.norm((found - again).reshape(-1, 2), axis=1)))


def _far_apart(views: list[tuple[View, View]]) -> list[int]:
    """Up to MOST_VIEWS of the views, each the one whose corners are farthest from those of all chosen before."""
    places = np.array(
        [np.concatenate([next(iter(v.corners.values())) for v in pair]).ravel() for pair in views], np.float64
    )
    known = np.nan_to_num(places, nan=-1e3)  # a corner that is out of one view and in another sets them apart
    chosen = [0]
    distance = np.linalg.norm(known - known[0], axis=1)
    while len(chosen) < min(MOST_VIEWS, len(views)) and distance.max() > 1.0:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(known - known[chosen[-1]], axis=1))
    return sorted(chosen)
