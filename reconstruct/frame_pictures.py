"""A few sets of a recording, and the rows of the marker table they gave → pictures of the frames, with what was seen.

At rest, at the tip's largest displacement and at the largest residual, of each camera: the markers by their numbers,
the lights that are none of the wing's, and the spots that were turned down, with the reason.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray

from capture.errors import ProcessError, ReconstructError
from capture.record import CAMERAS
from process.detect import Detections, DetectSettings, detect
from process.json_file import write_json
from process.recording import FrameSetReader, Recording
from reconstruct.result import FIGURES, pieces, read_json_object
from reconstruct.tables import MARKERS, PIXELS, TIP_COLUMNS, Floats

INDEX = "frames.json"
WIDTH_PX, QUALITY = 1100, 80  # these bound a picture to some 0.2 MB
_GAMMA = 0.45  # dark parts of the scene are drawn brighter
_MARGIN = 0.08  # of the frame's width, around what is drawn
_TEXT_PX = 15.0
_SAME_PX = 1.5  # a spot so near to a marker is the marker
_BOTH, _ONE, _OTHER, _REJECTED = "#6fd3ff", "#ffc24a", "#c9ced3", "#ff6a5e"


@dataclass(frozen=True)
class Moment:
    """A set to be shown."""

    side: str
    trigger_index: int
    time_s: float  # since the first set
    why: str


@dataclass(frozen=True)
class FramePicture:
    """One picture; its file is beside the report's figures."""

    file: str
    side: str
    camera: str
    trigger_index: int
    time_s: float
    why: str
    markers: int  # drawn, of which …
    one_camera: int  # … the other camera did not see
    other_lights: int
    rejected: Mapping[str, int]  # reason → spots

    @property
    def caption(self) -> str:
        """What it shows."""
        parts = [f"{self.markers} markers"]
        if self.one_camera:
            parts.append(f"{self.one_camera} of them not seen by the other camera")
        if self.other_lights:
            parts.append(f"{self.other_lights} other lights")
        parts += [f"{count} turned down ({reason})" for reason, count in self.rejected.items()]
        where = f"{self.side}/{self.camera}, {self.why}: {self.time_s:.2f} s, trigger {self.trigger_index}"
        return f"{where}. {', '.join(parts)}."


def moments(frames: pa.Table, at_rest_ns: tuple[int, int] | None) -> list[Moment]:
    """The sets to show of each wing in frames.parquet; ``at_rest_ns`` is a window at rest, if one is known."""
    start_ns = int(frames.column("timestamp_ns").to_numpy().min())
    found = []
    for side in sorted(set(frames.column("side").to_pylist())):
        own = frames.filter(pc.equal(frames.column("side"), side))
        time_ns = own.column("timestamp_ns").to_numpy()
        moved = np.linalg.norm(np.stack([own.column(name).to_numpy() for name in TIP_COLUMNS[:3]]), axis=0)
        residual = own.column("residual_rms_mm").to_numpy()
        if at_rest_ns is None:
            rows = {"the first set": 0}
        else:
            rows = {"at rest": int(np.argmin(np.abs(time_ns - sum(at_rest_ns) / 2)))}
        if np.isfinite(moved).any():
            rows["tip furthest away"] = int(np.nanargmax(moved))
            rows["largest residual"] = int(np.nanargmax(residual))
        whys: dict[int, list[str]] = {}
        for why, row in rows.items():
            whys.setdefault(row, []).append(why)
        trigger = own.column("trigger_index").to_numpy()
        found += [
            Moment(side, int(trigger[row]), float(time_ns[row] - start_ns) * 1e-9, " and ".join(why))
            for row, why in whys.items()
        ]
    return found


def write_frame_pictures(
    recording: Recording, shown: Sequence[Moment], folder: Path, settings: DetectSettings
) -> list[FramePicture]:
    """Draw the moments' frames into ``folder/figures``, found again as they were when measured; a lost one is left out.

    Raises ReconstructError when they cannot be written.
    """
    made = []
    with FrameSetReader() as reader:
        for moment in shown:
            own = recording.sides.get(moment.side, ())
            places = next((one for one in own if one.trigger_index == moment.trigger_index), None)
            if places is None:
                continue
            try:
                images = reader.read(places).images
            except ProcessError:
                continue  # not one of ours; the markers say so
            rows = _rows(folder / MARKERS, moment)
            for camera, image in enumerate(images):
                if image is not None:
                    made.append(_draw(image, camera, moment, rows, folder / FIGURES, settings))
    write_json(folder / FIGURES / INDEX, {"frames": [asdict(one) for one in made]})
    return made


def read_frame_pictures(folder: Path) -> list[FramePicture] | None:
    """The pictures that a run left in a result's folder; None when it had no frames."""
    path = folder / FIGURES / INDEX
    if not path.is_file():
        return None
    entries = read_json_object(path, "run `reconstruct` again")["frames"]
    return [FramePicture(**entry) for entry in entries if (path.parent / entry["file"]).is_file()]


def remove_frame_pictures(folder: Path) -> None:
    """Those of an earlier run."""
    for old in (*(folder / FIGURES).glob("frame-*.jpg"), folder / FIGURES / INDEX):
        old.unlink(missing_ok=True)


def _rows(path: Path, moment: Moment) -> pa.Table:
    columns = ("trigger_index", "marker", "flags", *PIXELS)
    own = [
        piece.filter(pc.equal(piece.column("trigger_index"), moment.trigger_index))
        for piece in pieces(path, columns, moment.side)
    ]
    return pa.concat_tables(own)


def _draw(
    image: NDArray[np.uint8], camera: int, moment: Moment, rows: pa.Table, folder: Path, settings: DetectSettings
) -> FramePicture:
    found = detect(np.ascontiguousarray(image), settings)
    pixels = np.stack([rows.column(name).to_numpy() for name in PIXELS[2 * camera : 2 * camera + 2]], axis=-1)
    seen = np.isfinite(pixels).all(axis=1)
    alone = np.array(["one_camera" in flags for flags in rows.column("flags").to_pylist()], dtype=bool)
    others = _others(found, pixels[seen])
    rejected: dict[str, int] = {}
    for spot in found.rejected:
        reason = spot.reason.split(":")[0]
        rejected[reason] = rejected.get(reason, 0) + 1
    name = f"frame-{moment.side}-{CAMERAS[camera]}-{moment.trigger_index:06d}.jpg"
    turned_down = np.array([(spot.u_px, spot.v_px) for spot in found.rejected]).reshape(-1, 2)
    canvas = _Canvas(image, np.concatenate([pixels[seen], others, turned_down]))
    numbers = rows.column("marker").to_numpy()
    for at in np.flatnonzero(seen):
        pair = seen & (numbers // 2 == numbers[at] // 2)  # numbers stand away from the other one of the pair
        away = pixels[at] - pixels[pair].mean(axis=0)
        colour = _ONE if alone[at] else _BOTH
        canvas.circle(pixels[at], _radius_px(found, pixels[at]), colour)
        canvas.number(pixels[at], _radius_px(found, pixels[at]), colour, str(numbers[at]), away)
    for at in others:
        canvas.circle(at, _radius_px(found, at), _OTHER)
    for spot in found.rejected:
        canvas.cross((spot.u_px, spot.v_px), spot.reason.split(":")[0])
    canvas.write(folder / name)
    return FramePicture(
        name, moment.side, CAMERAS[camera], moment.trigger_index, moment.time_s, moment.why,
        int(seen.sum()), int((seen & alone).sum()), len(others), rejected,
    )  # fmt: skip


def _others(found: Detections, markers: Floats) -> Floats:
    """(n, 2) of the spots found those that are no marker."""
    spots = found.pixels
    if not len(spots) or not len(markers):
        return spots
    near = np.linalg.norm(spots[:, None] - markers[None], axis=-1).min(axis=1)
    return np.asarray(spots[near > _SAME_PX])


def _radius_px(found: Detections, pixel: Any) -> float:
    """Of the spot at ``pixel``; 0 when it was not found again."""
    if not len(found):
        return 0.0
    apart = np.linalg.norm(found.pixels - pixel, axis=1)
    nearest = int(np.argmin(apart))
    return float(np.sqrt(found.area_px[nearest] / np.pi)) if apart[nearest] <= _SAME_PX else 0.0


class _Canvas:
    """The part of a frame where there is something, brightened, to draw on in the frame's own pixels."""

    def __init__(self, image: NDArray[np.uint8], spots: Floats) -> None:
        (left, top, width, height) = _part(image, spots)
        part = image[top : top + height, left : left + width]
        self._corner, self._scale = (left, top), WIDTH_PX / width
        size = WIDTH_PX, round(height * self._scale)
        sized = cv2.resize(part, size, interpolation=cv2.INTER_AREA if self._scale < 1 else cv2.INTER_CUBIC)
        dark = min(float(np.percentile(part[::4, ::4], 1)), 200.0)
        levels = np.clip((np.arange(256) - dark) / (255.0 - dark), 0.0, 1.0)
        bright = np.rint(255.0 * levels**_GAMMA).astype(np.uint8)
        self._figure = Figure(figsize=(size[0] / 100, size[1] / 100), dpi=100)
        FigureCanvasAgg(self._figure)
        self._axes: Any = self._figure.add_axes((0.0, 0.0, 1.0, 1.0))
        self._axes.imshow(bright[sized], cmap="gray", vmin=0, vmax=255, aspect="auto", interpolation="nearest")
        self._axes.set(xlim=(-0.5, size[0] - 0.5), ylim=(size[1] - 0.5, -0.5))
        self._axes.axis("off")

    def circle(self, pixel: Any, radius_px: float, colour: str) -> None:
        """Around a spot of this radius."""
        self._axes.add_patch(
            Circle(self._at(pixel), self._around(radius_px), fill=False, edgecolor=colour, linewidth=1.2)
        )

    def number(self, pixel: Any, radius_px: float, colour: str, text: str, away: Any) -> None:
        """Beside the circle, towards ``away``; above it where that is nowhere."""
        length = float(np.linalg.norm(away))
        to = np.asarray(away) / length if length else np.array([0.0, -1.0])
        place = np.array(self._at(pixel)) + (self._around(radius_px) + _TEXT_PX) * to
        self._axes.text(*place, text, color=colour, fontsize=14, ha="center", va="center")

    def cross(self, pixel: Any, text: str) -> None:
        u, v = self._at(pixel)
        self._axes.plot(u, v, "x", markersize=10, color=_REJECTED, markeredgewidth=1.3)
        self._axes.annotate(text, (u, v), (8, 0), textcoords="offset points", color=_REJECTED, fontsize=13, va="center")

    def _around(self, radius_px: float) -> float:
        return max(10.0, 1.5 * radius_px * self._scale)

    def write(self, path: Path) -> None:
        canvas: Any = self._figure.canvas
        canvas.draw()
        colours = cv2.cvtColor(np.asarray(canvas.buffer_rgba()), cv2.COLOR_RGBA2BGR)
        whole, data = cv2.imencode(".jpg", colours, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        assert whole
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data.tobytes())
        except OSError as error:
            raise ReconstructError(f"{path}: cannot be written ({error.strerror or error})") from error

    def _at(self, pixel: Any) -> tuple[float, float]:
        u, v = (pixel[axis] - self._corner[axis] for axis in (0, 1))
        return (u + 0.5) * self._scale - 0.5, (v + 0.5) * self._scale - 0.5


def _part(image: NDArray[np.uint8], spots: Floats) -> tuple[int, int, int, int]:
    """Left, top, width and height of what holds all ``spots`` with a margin, in the frame's proportions."""
    size = np.array(image.shape[::-1])
    if not len(spots):
        return 0, 0, int(size[0]), int(size[1])
    low, high = spots.min(axis=0) - _MARGIN * size[0], spots.max(axis=0) + _MARGIN * size[0]
    share = min(1.0, float(np.max((high - low) / size)))
    part = np.ceil(share * size).astype(int)
    corner = np.clip(np.rint((low + high - part) / 2).astype(int), 0, size - part)
    return int(corner[0]), int(corner[1]), int(part[0]), int(part[1])
