"""A result → a short film of both wings and their tips: MP4, or GIF where no MP4 can be written."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from numpy.typing import NDArray

from capture.errors import ReconstructError
from reconstruct.figures import COLOURS, DARK, GREY, STYLE
from reconstruct.result import Result
from reconstruct.ribbon import ribbon, side_sign
from reconstruct.shown import Track
from reconstruct.tables import Floats

FILMS = ("wing.mp4", "wing.gif")
SIZE_PX = (1280, 720)
GIF_SIZE_PX = (640, 360)
MOST_RATE_HZ = 30.0
LEAST_BYTES = 1000  # one picture has more
_YAW_RAD, _PITCH_RAD = np.radians(-22.0), np.radians(16.0)  # as the report's view begins
Pixels = NDArray[np.uint8]
Tell = Callable[[int, int], None]


def write_animation(result: Result, folder: Path, tell: Tell = lambda _done, _all: None) -> Path:
    """Film the stretch that the report shows in detail, at the speed it was flown; returns the file's path.

    At most FRAMES_SHOWN pictures, of 20 s of flight at most. Raises ReconstructError when it cannot be written.
    """
    remove_animation(folder)
    track = result.shown.detail
    steps = np.diff(track.timestamp_ns) * 1e-9
    rate_hz = 1.0 / float(np.median(steps)) if steps.size else 1.0
    every = max(1, round(rate_hz / MOST_RATE_HZ))
    with mpl.rc_context(STYLE):
        frames = _Stage(result, track).frames(every, tell)
        for write, name in zip((_write_mp4, _write_gif), FILMS, strict=True):
            path = folder / name
            part = path.with_name(f"part-{name}")
            try:
                if write(part, frames, rate_hz / every):
                    part.replace(path)
                    return path
            except OSError as error:
                part.unlink(missing_ok=True)
                raise ReconstructError(f"{path}: cannot be written ({error.strerror or error})") from error
    raise ReconstructError(f"{folder}: no film could be written, neither MP4 nor GIF; leave it out: --no-animation")


def remove_animation(folder: Path) -> None:
    """That of an earlier run."""
    for name in FILMS:
        (folder / name).unlink(missing_ok=True)


def _write_mp4(path: Path, frames: Iterator[Pixels], rate_hz: float) -> bool:
    """False, and no frame taken, when there is no encoder, or the file cannot be made."""
    fourcc: int = cv2.VideoWriter.fourcc(*"mp4v")
    writer = cv2.VideoWriter(str(path), fourcc, rate_hz, SIZE_PX)
    try:
        if not writer.isOpened():
            path.unlink(missing_ok=True)
            return False
        for frame in frames:
            writer.write(cv2.cvtColor(frame, cv2.COLOR_RGBA2BGR))
    finally:
        writer.release()
    if not path.is_file() or path.stat().st_size < LEAST_BYTES:  # OpenCV does not tell of a full disk
        raise OSError("the encoder left nothing; is the disk full?")
    return True


def _write_gif(path: Path, frames: Iterator[Pixels], rate_hz: float) -> bool:
    from PIL import Image  # comes with matplotlib

    small = (cv2.resize(frame, GIF_SIZE_PX, interpolation=cv2.INTER_AREA) for frame in frames)
    pictures = (Image.fromarray(frame[..., :3]).quantize(64) for frame in small)
    first = next(pictures, None)
    if first is None:
        return False
    first.save(path, save_all=True, append_images=pictures, duration=round(1000 / rate_hz), loop=0)
    return True


class _Stage:
    """What stays, drawn once, and what moves, drawn over it for each frame."""

    def __init__(self, result: Result, track: Track) -> None:
        self._result, self._track = result, track
        self._time_s = (track.timestamp_ns - result.start_ns) * 1e-9
        self._edges, self._markers, self._tips = self._moving()
        self._figure = Figure(figsize=(SIZE_PX[0] / 100, SIZE_PX[1] / 100), dpi=100)
        self._canvas: Any = FigureCanvasAgg(self._figure)
        self._view: Any = self._figure.add_axes((0.02, 0.34, 0.96, 0.64))
        self._trace: Any = self._figure.add_axes((0.07, 0.09, 0.91, 0.2))
        self._still()
        self._canvas.draw()
        self._background = self._canvas.copy_from_bbox(self._figure.bbox)

    def frames(self, every: int, tell: Tell) -> Iterator[Pixels]:
        """(H, W, 4) of every so many sets."""
        strips = {
            name: self._view.add_collection(PolyCollection([], linewidths=0.6, color=_light(COLOURS[name])))
            for name in self._edges
        }
        dots = {name: self._view.plot([], [], "o", color=DARK, markersize=3.5)[0] for name in self._edges}
        tips = {name: self._trace.plot([], [], "o", color=COLOURS[name], markersize=5)[0] for name in self._edges}
        cursor = self._trace.axvline(self._time_s[0], color=DARK, linewidth=0.9)
        words = self._view.text(0.985, 0.96, "", transform=self._view.transAxes, ha="right", va="top", fontsize=12)
        rows = range(0, self._time_s.size, every)
        for number, row in enumerate(rows):
            self._canvas.restore_region(self._background)
            cursor.set_xdata([self._time_s[row]] * 2)
            words.set_text(self._words(row))
            for name, edges in self._edges.items():
                strips[name].set_verts(_quads(edges[row]))
                dots[name].set_data(*self._markers[name][row].T)
                tips[name].set_data([self._time_s[row]], [self._tips[name][row]])
            for artist in (*strips.values(), *dots.values(), cursor, *tips.values(), words):
                artist.axes.draw_artist(artist)
            yield np.asarray(self._canvas.buffer_rgba())
            tell(number + 1, len(rows))

    def _moving(self) -> tuple[dict[str, Floats], dict[str, Floats], dict[str, Floats]]:
        """Edges (n, S, 2, 2) and markers (n, M, 2) in the picture, and tips' heights (n,) in mm; NaN: not known."""
        edges, markers, tips = {}, {}, {}
        for name, side in self._result.sides.items():
            rows = side.sample.rows(self._track.trigger_index)
            gone = (rows < 0)[:, None, None]
            shape = side.sample.shape
            strip = ribbon(name, side).edges(side_sign(name), shape.xyz_m[rows], shape.twist_deg[rows])
            edges[name] = np.where(gone[..., None], np.nan, _flat(strip))
            markers[name] = np.where(gone, np.nan, _flat(side.sample.markers.xyz_m[rows]))
            lift = 1e3 * (shape.xyz_m[rows, -1, 2] - side.reference_xyz_m[-1, 2])
            tips[name] = np.where(rows < 0, np.nan, lift)
        return edges, markers, tips

    def _still(self) -> None:
        result = self._result
        corners = []
        for name, side in result.sides.items():
            rest = ribbon(name, side).edges(side_sign(name), side.reference_xyz_m, side.reference_twist_deg)
            flat = _flat(rest)
            corners += [flat.reshape(-1, 2), self._edges[name].reshape(-1, 2)]
            around = np.concatenate([flat[:, 0], flat[::-1, 1], flat[:1, 0]])
            self._view.plot(*around.T, color=GREY, linewidth=1.0, linestyle="--")
            self._trace.plot(self._time_s, self._tips[name], color=COLOURS[name], label=f"{name} wing")
        points = np.concatenate(corners)
        low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
        room = np.array([self._view.bbox.width, self._view.bbox.height])
        half = 0.55 * float(np.max((high - low) / room)) * room
        (left, bottom), (right, top) = (low + high) / 2 - half, (low + high) / 2 + half
        self._view.set(xlim=(left, right), ylim=(bottom, top))
        self._view.axis("off")
        name = result.summary.get("wing", "")
        self._view.text(0.015, 0.96, name, transform=self._view.transAxes, va="top", fontsize=15, fontweight="bold")
        self._view.text(
            0.015, 0.89, f"dashed: the {result.reference}", transform=self._view.transAxes, va="top", color="#667079"
        )
        self._trace.set(ylabel="tip up, mm", xlabel="s since the first set")
        self._trace.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=2)

    def _words(self, row: int) -> str:
        lines = [f"{self._time_s[row]:.2f} s"]
        for name, heights in self._tips.items():
            height = heights[row]
            lines.append(f"{name} tip " + (f"{height:+.0f} mm" if np.isfinite(height) else "not known"))
        return "\n".join(lines)


def _light(colour: str) -> Any:
    return 0.7 * np.array(to_rgb(colour)) + 0.3


def _flat(xyz_m: Floats) -> Floats:
    """(…, 2) in the picture, of places (…, 3): seen from behind, above and a little to the left."""
    across = np.array([-np.sin(_YAW_RAD), np.cos(_YAW_RAD), 0.0])
    behind = np.array([np.cos(_YAW_RAD), np.sin(_YAW_RAD), 0.0])
    up = np.cos(_PITCH_RAD) * np.array([0.0, 0.0, 1.0]) - np.sin(_PITCH_RAD) * behind
    return np.stack([xyz_m @ across, xyz_m @ up], axis=-1)


def _quads(edges: Floats) -> Floats:
    """(S − 1, 4, 2) of a strip's edges (S, 2, 2); none when they are not known."""
    if not np.isfinite(edges).all():
        return np.empty((0, 4, 2))
    return np.stack([edges[:-1, 0], edges[1:, 0], edges[1:, 1], edges[:-1, 1]], axis=1)
