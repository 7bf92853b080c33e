"""Which chunk data a camera is asked for, and when none. Reading it through libaravis: the VM suite (usb3)."""

import ctypes
from dataclasses import dataclass, field

import pytest

from capture.camera.aravis_chunks import Chunks, FrameFacts
from capture.camera.base import CHUNK_BYTES
from capture.errors import CameraError

IMAGE_BYTES = 64 * 48
FACTS = {"ChunkExposureTime": 1999.6, "ChunkGain": 2.5, "ChunkFrameID": 70_000, "ChunkFrameCounter": 70_001}


@dataclass
class MadeUpLibrary:
    """Answers as libaravis would for a camera whose chunks are ``enabled``, each of ``chunk_bytes``."""

    enabled: dict[str, bool]
    features: set[str] = field(default_factory=lambda: {"ChunkModeActive", "ExposureTime", "Gain"})
    chunk_bytes: int = 16
    stuck: tuple[str, ...] = ()  # what cannot be switched
    unreadable: tuple[str, ...] = ()
    active: bool = True  # somebody left it on
    selected: str = ""
    freed: int = 0
    unrefs: int = 0

    def call(self, name: str, *arguments: object) -> object:
        return getattr(self, "_" + name.removeprefix("arv_"))(*arguments)

    def free(self, array: object) -> None:
        self.freed += 1

    def unref(self, instance: int) -> None:
        self.unrefs += 1

    def _camera_is_feature_available(self, camera, name):
        return int(name.decode() in self.features)

    def _camera_set_boolean(self, camera, name, value):
        if name == b"ChunkModeActive":
            self.active = bool(value)
        elif self.selected in self.stuck:
            raise CameraError(f"{self.selected} is locked")
        else:
            self.enabled[self.selected] = bool(value)

    def _camera_get_boolean(self, camera, name):
        return int(self.enabled[self.selected])

    def _camera_set_string(self, camera, name, value):
        self.selected = value.decode()

    def _camera_dup_available_enumerations_as_strings(self, camera, name, count):
        count._obj.value = len(self.enabled)
        return (ctypes.c_char_p * len(self.enabled))(*(chunk.encode() for chunk in self.enabled))

    def _camera_get_payload(self, camera):
        return IMAGE_BYTES + self.active * (
            8 + self.chunk_bytes * sum(on for name, on in self.enabled.items() if name != "Image")
        )

    def _camera_create_chunk_parser(self, camera):
        return 77

    def _buffer_has_chunks(self, buffer):
        return 1

    def _chunk_parser_get_float_value(self, parser, buffer, name):
        chunk = name.decode()
        if chunk in self.unreadable:
            raise CameraError(f"[{chunk}] not found")
        return FACTS[chunk]

    _chunk_parser_get_integer_value = _chunk_parser_get_float_value


def test_what_is_of_use_is_turned_on_and_all_else_off():
    library = MadeUpLibrary({"Image": True, "Timestamp": True, "FrameID": False, "Gain": False, "ExposureTime": False})
    chunks = Chunks(library, 1)
    assert chunks.turn_on(IMAGE_BYTES) == "FrameID Gain ExposureTime"
    assert [name for name, enabled in library.enabled.items() if enabled] == [
        "Image",
        "FrameID",
        "Gain",
        "ExposureTime",
    ]
    assert library.active
    assert chunks.active
    assert library.freed == 1
    assert chunks.of(5) == FrameFacts(2000, 2.5, 70_000)
    chunks.close()
    chunks.close()
    assert library.unrefs == 1
    assert not chunks.active


def test_a_maker_s_own_name_for_the_counter_and_a_feature_in_other_units():
    library = MadeUpLibrary({"FrameCounter": False, "ExposureTime": False}, features={"ChunkModeActive", "Gain"})
    chunks = Chunks(library, 1)
    assert chunks.turn_on(IMAGE_BYTES) == "FrameCounter"
    assert chunks.of(5) == FrameFacts(counter=70_001)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"chunk_bytes": CHUNK_BYTES}, f"off ({8 + 2 * CHUNK_BYTES} bytes behind the image, room for {CHUNK_BYTES})"),
        ({"stuck": ("Gain", "ExposureTime")}, "off (nothing of use in it)"),
    ],
)
def test_what_does_not_fit_or_says_nothing_is_turned_off(changes, why):
    library = MadeUpLibrary({"Gain": False, "ExposureTime": False}, **changes)
    chunks = Chunks(library, 1)
    assert chunks.turn_on(IMAGE_BYTES) == why
    assert not library.active
    assert not chunks.active
    assert chunks.of(5) == FrameFacts()


def test_one_that_is_always_on_is_used():
    chunks = Chunks(MadeUpLibrary({"FrameID": True, "Gain": False}, stuck=("FrameID",)), 1)
    assert chunks.turn_on(IMAGE_BYTES) == "FrameID Gain"


def test_a_camera_without_chunk_data_is_left_alone():
    library = MadeUpLibrary({}, features={"ExposureTime", "Gain"})
    chunks = Chunks(library, 1)
    assert chunks.turn_on(IMAGE_BYTES) == ""
    assert chunks.of(5) == FrameFacts()


def test_a_chunk_that_is_not_there_leaves_what_was_set():
    library = MadeUpLibrary({"Gain": False, "FrameID": False}, unreadable=("ChunkGain",))
    chunks = Chunks(library, 1)
    assert chunks.turn_on(IMAGE_BYTES) == "Gain FrameID"
    assert chunks.of(5) == FrameFacts(counter=70_000)
