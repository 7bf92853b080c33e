"""Preview frames to thumbnails with the found markers drawn in, made while somebody looks, however many look."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.health import Preview, read_health, read_preview
from capture.worker import Worker
from process.detect import DetectSettings
from process.json_file import finite_or_none
from process.look import Look, look_at

Pixels = NDArray[np.uint8]
THUMBNAIL_PX = 520  # width, about; a phone shows two side by side
WATCHED_S = 5.0  # without a question for so long nobody looks, and nothing is done
_PERIOD_S = 0.25
_REST_SHARE = 1.0  # rest as long as was worked: at most half a core
_GREEN, _RED = (80, 220, 60), (60, 60, 230)  # BGR


@dataclass(frozen=True, eq=False)
class Picture:
    """A camera's latest frame, looked at."""

    place: str
    trigger_index: int
    written_monotonic_s: float
    look: Look
    jpeg: bytes

    def figures(self, monotonic_s: float) -> dict[str, Any]:
        """For JSON."""
        look = self.look
        return {
            "trigger_index": self.trigger_index,
            "age_s": round(monotonic_s - self.written_monotonic_s, 2),
            "markers": look.markers,
            "saturated_markers": look.saturated_markers,
            "saturated_share": look.saturated_share,
            "background": look.background,
            "amplitude": finite_or_none(look.amplitude),
            "edge_px": finite_or_none(look.edge_px),
            "reflections": look.reflections,
        }


class Gallery(Worker):
    """The thread that looks at pictures. ``pictures`` may be asked from any thread."""

    def __init__(self, folder: Path) -> None:
        super().__init__("gallery")
        self._folder = folder
        self._settings = DetectSettings(method="fast")
        self._pictures: dict[str, Picture] = {}
        self._asked_s = float("-inf")

    def pictures(self) -> dict[str, Picture]:
        """The latest of each camera, by place; asking keeps them coming."""
        self._asked_s = time.monotonic()
        return self._pictures

    def work(self) -> None:
        """Look at what is new until asked to stop."""
        wait_s = _PERIOD_S
        while not self.stop_requested.wait(wait_s):
            begin_s = time.monotonic()
            if begin_s - self._asked_s < WATCHED_S:
                self.look()
            wait_s = max(_PERIOD_S, _REST_SHARE * (time.monotonic() - begin_s))

    def look(self) -> None:
        """Look at each camera's frame, when it is another one than before."""
        health = read_health(self._folder)
        places = health.previews if health is not None else ()
        found = {}
        for place in places:
            known = self._pictures.get(place)
            preview = read_preview(self._folder, place)
            if preview is None or (known is not None and known.written_monotonic_s == preview.written_monotonic_s):
                if known is not None:
                    found[place] = known
                continue
            found[place] = picture_of(place, preview, self._settings)
        self._pictures = found


def picture_of(place: str, preview: Preview, settings: DetectSettings) -> Picture:
    """Find the markers of a preview and draw them."""
    image = np.frombuffer(preview.pixels, np.uint8).reshape(preview.height, preview.width)
    look = look_at(image, settings)
    return Picture(place, preview.trigger_index, preview.written_monotonic_s, look, thumbnail(image, look))


def thumbnail(image: Pixels, look: Look) -> bytes:
    """JPEG with accepted markers ringed, rejected lights crossed out.

    Each of its pixels is the brightest of those it stands for: a marker of two pixels must not fade away.
    """
    factor = max(1, round(image.shape[1] / THUMBNAIL_PX))
    height, width = (size // factor for size in image.shape)
    blocks = image[: height * factor, : width * factor].reshape(height, factor, width, factor)
    canvas = cv2.cvtColor(np.ascontiguousarray(blocks.max(axis=(1, 3))), cv2.COLOR_GRAY2BGR)
    for u, v in look.detections.pixels:
        cv2.circle(canvas, (round(u / factor), round(v / factor)), 7, _GREEN, 2, cv2.LINE_AA)
    for light in look.detections.rejected:
        if np.isfinite(light.u_px):
            at = (round(light.u_px / factor), round(light.v_px / factor))
            cv2.drawMarker(canvas, at, _RED, cv2.MARKER_TILTED_CROSS, 9, 1, cv2.LINE_AA)
    done, data = cv2.imencode(".jpg", canvas, [cv2.IMWRITE_JPEG_QUALITY, 80])
    return data.tobytes() if done else b""
