"""``wingproc aim``: live help with aperture, exposure, focus and aim, from previews, a flight or pictures."""

import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from numpy.typing import NDArray
from rich import box
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from capture.console import note, say, say_json
from capture.errors import ProcessError
from capture.health import default_folder, judge, read_health, read_preview
from capture.record import CAMERAS
from process.aim import Aim, judge_look
from process.look import look_at
from process.recording import FrameSetReader, open_recording

Pixels = NDArray[np.uint8]
MARKERS = 18  # of a wing
PERIOD_S = 0.5
FIRST_FRAME_S = 5.0
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm")


def aim(
    sources: Annotated[
        list[Path] | None, typer.Argument(help="Pictures, or a flight's folders. None: the running recorder, live.")
    ] = None,
    folder: Annotated[
        Path | None, typer.Option("--health", help="The recorder's `health.folder`; its default if not given.")
    ] = None,
    expected: Annotated[int, typer.Option(min=1, help="Markers that each camera should see.")] = MARKERS,
    at: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Which frame of a flight: 0 its first, 1 its last.")
    ] = 0.5,
    json: Annotated[bool, typer.Option("--json", help="Print one look as JSON.")] = False,
) -> None:
    """Help to set aperture, exposure, focus and aim: what each camera sees of the markers, and what to do.

    Live it goes on until Ctrl-C. Exit code 0 either way: it advises, `wingcap preflight` refuses.
    """
    if not sources:
        folder = folder or default_folder()
        if json:
            say_json([found.as_dict() for found in _first(folder, expected)])
        else:
            _live(folder, expected)
        return
    frames = (
        _pictures(sources) if all(path.suffix.lower() in IMAGE_SUFFIXES for path in sources) else _flight(sources, at)
    )
    aims = [judge_look(place, look_at(image), expected, exposure_us) for place, image, exposure_us in frames]
    if json:
        say_json([found.as_dict() for found in aims])
    else:
        Console().print(_shown(aims))


def _pictures(paths: list[Path]) -> Iterator[tuple[str, Pixels, int | None]]:
    for path in paths:
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise ProcessError(f"{path}: not a picture that can be read: give PNG, JPEG, TIFF or BMP")
        yield path.name, np.asarray(image, np.uint8), None


def _flight(folders: list[Path], at: float) -> Iterator[tuple[str, Pixels, int | None]]:
    recording = open_recording(folders)
    for problem in recording.problems[:3]:
        note(problem)
    for side, places in recording.sides.items():
        with FrameSetReader() as reader:
            sets = reader.read(places[round(at * (len(places) - 1))])
        for camera, image, frame in zip(CAMERAS, sets.images, sets.frames, strict=True):
            if image is None:
                note(f"{side}/{camera}: no frame there; try another --at")
            else:
                yield f"{side}/{camera}", image, None if frame is None else frame.exposure_us


def _looks(folder: Path, expected: int, known: dict[str, tuple[float, Aim]]) -> list[Aim]:
    """Look at each camera's latest preview, where it is another one than that in ``known``."""
    health = read_health(folder)
    verdict = judge(health, time.monotonic())
    if health is None or (not verdict.go and verdict.reasons[0].level == 3):
        raise ProcessError(f"{folder}: {verdict.reasons[0].message}")
    exposures_us = {camera.place: camera.exposure_us for camera in health.cameras}
    for place in health.previews:
        preview = read_preview(folder, place)
        if preview is not None and known.get(place, (None,))[0] != preview.written_monotonic_s:
            image = np.frombuffer(preview.pixels, np.uint8).reshape(preview.height, preview.width)
            found = judge_look(place, look_at(image), expected, exposures_us.get(place))
            known[place] = preview.written_monotonic_s, found
    return [known[place][1] for place in health.previews if place in known]


def _first(folder: Path, expected: int) -> list[Aim]:
    """A look at every camera, as soon as each has given a frame."""
    known: dict[str, tuple[float, Aim]] = {}
    deadline_s = time.monotonic() + FIRST_FRAME_S
    while True:
        aims = _looks(folder, expected, known)
        health = read_health(folder)
        if aims and health is not None and len(aims) == len(health.cameras):
            return aims
        if time.monotonic() > deadline_s:
            if aims:
                return aims
            raise ProcessError(
                f"{folder}: the recorder shows no frame: does it record, and is health.preview_hz above 0?"
            )
        time.sleep(0.1)


def _live(folder: Path, expected: int) -> None:
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    known: dict[str, tuple[float, Aim]] = {}
    try:
        aims = _first(folder, expected)
        with Live(_shown(aims), auto_refresh=False, screen=Console().is_terminal) as live:
            while True:
                time.sleep(PERIOD_S)
                live.update(_shown(_looks(folder, expected, known)), refresh=True)
    except KeyboardInterrupt:
        say("")


def _shown(aims: list[Aim]) -> Group:
    table = Table(box=box.SIMPLE_HEAD)
    for title in ("camera", "markers", "saturated", "level", "scene", "width", "edge", "round", "halo"):
        table.add_column(title, no_wrap=True)
    for found in aims:
        look = found.look
        table.add_row(
            found.place,
            f"{look.markers}/{found.expected}",
            f"{look.saturated_markers}, {100 * look.saturated_share:.1f}%",
            f"{_figure(look.amplitude, 0)}…{_figure(look.brightest, 0)}",
            f"{look.background:.0f}…{look.background_high:.0f}",
            _figure(look.diameter_px, 1),
            _figure(look.edge_px, 2),
            _figure(look.circularity, 2),
            "–" if look.halo != look.halo else f"{100 * look.halo:.0f}%",
            style="green" if found.good else "bold red",
        )
    lines = [Text(f"{found.place}: {advice.text}") for found in aims for advice in found.advice]
    return Group(table, *(lines or [Text("nothing to do")] if aims else [Text("no frame yet")]))


def _figure(value: float, digits: int) -> str:
    return "–" if value != value else f"{value:.{digits}f}"
