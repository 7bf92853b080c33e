"""GenICam chunk data: what a camera sends behind a frame's pixels to that frame's own exposure, gain and counter.

Names as the GenICam Standard Features Naming Convention has them under "Chunk Data Control".
"""

import contextlib
import ctypes
import math
from dataclasses import dataclass
from typing import Any

from capture.camera.aravis_library import AravisLibrary
from capture.camera.base import CHUNK_BYTES
from capture.errors import CameraError

_EXPOSURE, _GAIN = "ExposureTime", "Gain"  # as a feature and, with Chunk before it, as a chunk: in the same unit
_IMAGE = "Image"  # the pixels are a chunk too
_COUNTERS = ("FrameID", "FrameCounter")  # the first that a camera has; makers' names for the same


@dataclass(frozen=True)
class FrameFacts:
    """What a camera says of one frame; None: it does not."""

    exposure_us: int | None = None
    gain_db: float | None = None
    counter: int | None = None


class Chunks:
    """The chunk data of one open camera."""

    def __init__(self, library: AravisLibrary, camera: int) -> None:
        self._library = library
        self._camera = camera
        self._on: frozenset[str] = frozenset()
        self._parser: int | None = None

    def turn_on(self, image_bytes: int) -> str:
        """Have the camera send what it can and what there is room for; what that is, or why it is off.

        Empty for a camera without chunk data. Everything else that it could send is turned off: the room is small.

        Raises:
            CameraError: it has chunk data and does not turn it off.
        """
        if not self._has("ChunkModeActive"):
            return ""
        try:
            found = self._choose()
            behind = self._call("arv_camera_get_payload") - image_bytes
            if found and 0 < behind <= CHUNK_BYTES:
                self._parser = self._call("arv_camera_create_chunk_parser")
                self._on = frozenset(found)
                return " ".join(found)
            why = f"{behind} bytes behind the image, room for {CHUNK_BYTES}" if found else "nothing of use in it"
        except CameraError as error:
            why = str(error)
        self._call("arv_camera_set_boolean", b"ChunkModeActive", 0)
        return f"off ({why})"

    @property
    def active(self) -> bool:
        """Whether frames come with chunk data."""
        return self._parser is not None

    def of(self, buffer: int) -> FrameFacts:
        """What the camera says of the complete frame in ``buffer``. What cannot be read is None."""
        if self._parser is None or not self._library.call("arv_buffer_has_chunks", buffer):
            return FrameFacts()
        exposure_us = self._read("float", buffer, _EXPOSURE)
        gain_db = self._read("float", buffer, _GAIN)
        counter = next((self._read("integer", buffer, name) for name in _COUNTERS if name in self._on), None)
        return FrameFacts(
            exposure_us=round(exposure_us) if exposure_us is not None and 0 < exposure_us < math.inf else None,
            gain_db=gain_db if gain_db is not None and math.isfinite(gain_db) else None,
            counter=int(counter) if counter is not None and counter >= 0 else None,
        )

    def close(self) -> None:
        """Let go of what reads them. Safe to call twice."""
        if self._parser is not None:
            self._library.unref(self._parser)
        self._parser = None

    def _choose(self) -> list[str]:
        """Turn on what is of use, and all else off; what is on."""
        self._call("arv_camera_set_boolean", b"ChunkModeActive", 1)
        there = self._selectable()
        counter = next((name for name in _COUNTERS if name in there), None)
        wanted = [name for name in (_EXPOSURE, _GAIN) if name in there and self._has(name)] + [counter or ""]
        on = []
        for name in there:
            if name == _IMAGE:
                continue
            self._call("arv_camera_set_string", b"ChunkSelector", name.encode())
            with contextlib.suppress(CameraError):  # it may be one that is always on, or always off
                self._call("arv_camera_set_boolean", b"ChunkEnable", int(name in wanted))
            if name in wanted and self._call("arv_camera_get_boolean", b"ChunkEnable"):
                on.append(name)
        return on

    def _selectable(self) -> list[str]:
        count = ctypes.c_uint()
        names = self._call("arv_camera_dup_available_enumerations_as_strings", b"ChunkSelector", ctypes.byref(count))
        try:
            return [names[number].decode() for number in range(count.value)]
        finally:
            self._library.free(names)

    def _read(self, kind: str, buffer: int, name: str) -> float | None:
        if name not in self._on:
            return None
        try:
            value: float = self._library.call(
                f"arv_chunk_parser_get_{kind}_value", self._parser, buffer, f"Chunk{name}".encode()
            )
        except CameraError:  # not in this buffer, or not of this kind
            return None
        return value

    def _has(self, name: str) -> bool:
        return bool(self._call("arv_camera_is_feature_available", name.encode()))

    def _call(self, name: str, *arguments: object) -> Any:
        return self._library.call(name, self._camera, *arguments)
