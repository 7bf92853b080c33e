"""A camera under test, and what a person's hands would do to it: pull the trigger line, the plug, a packet.

A backend joins the contract suite (tests/capture/camera_contract) with one subclass of ``Harness`` and a line in
``HARNESSES``. Nothing else is needed. What a harness or a device cannot do it says, and the suite demands that the
backend says the same; nothing is skipped.
"""

import importlib
import os
from abc import ABC, abstractmethod
from typing import ClassVar

from capture.camera.base import CameraSettings

HARNESSES = {
    "simulated": "camera_harness_simulated:SimulatedHarness",
    "aravis-fake": "camera_harness_aravis:AravisFakeHarness",
    "aravis-gige": "camera_harness_aravis:GigeHarness",
    "usb3": "camera_harness_usb:UsbHarness",
    "v4l2": "camera_harness_v4l2:VividHarness",
}
"""By name: module in tests/support and class."""
IN_THE_VM = ("usb3", "v4l2")
"""Those that need a kernel of their own: run in the guest of tests/vm, by WINGSHAPE_HARNESSES=usb3,v4l2."""
SLOW = ("aravis-gige",)
"""Those with timeouts of seconds: run with the slow tests."""


class Harness(ABC):
    """One camera that nobody has opened yet. Entering it starts the hardware, leaving it ends it."""

    backend: ClassVar[str]
    """Its name in capture.camera.BACKENDS."""
    faults: ClassVar[frozenset[str]] = frozenset({"drop", "truncate", "unplug"})
    """What this harness can do to the camera."""
    exclusive: ClassVar[bool] = True
    """Whether a second program is refused the camera."""
    refused: ClassVar[tuple[tuple[dict[str, object], str], ...]] = ()
    """Settings that the camera must refuse (changes to ``settings``), and what the message must hold (a regex)."""
    chunk_bytes: ClassVar[int] = 0
    """How much the camera sends behind the pixels."""
    missing_address: ClassVar[str] = "no-such-camera"
    """An address where no camera is."""
    frame_within_s: float = 2.0
    """A frame is there so soon after its trigger."""
    loss_within_s: float = 2.0
    """A pulled plug is noticed so soon."""
    back_within_s: float = 5.0
    """A camera can be opened so soon after it was plugged in again."""
    address: str
    settings: CameraSettings

    @abstractmethod
    def __enter__(self) -> "Harness":
        """Start. Skips, with ``needs``, where the machine lacks something."""

    @abstractmethod
    def __exit__(self, *exception: object) -> None:
        """End."""

    def facts(self, index: int) -> tuple[int, float, int] | None:
        """Exposure in us, gain in dB and the camera's own count of the frame of trigger ``index``, if it tells them."""
        return None

    def trigger(self) -> None:
        """One edge on the trigger line. Never called on a camera that runs free."""
        raise NotImplementedError

    def drop(self) -> None:
        """The next frame is exposed, and lost on its way."""
        raise NotImplementedError

    def truncate(self) -> None:
        """The next frame is exposed, and delivered in part."""
        raise NotImplementedError

    def unplug(self) -> None:
        """Pull the plug."""
        raise NotImplementedError

    def plug(self) -> None:
        """Put it back."""
        raise NotImplementedError


def wanted_harnesses() -> list[str]:
    """The names that this machine is to run."""
    asked = os.environ.get("WINGSHAPE_HARNESSES")
    return asked.split(",") if asked else [name for name in HARNESSES if name not in IN_THE_VM]


def make_harness(name: str) -> Harness:
    """The harness of a name."""
    module, class_name = HARNESSES[name].split(":")
    harness: Harness = getattr(importlib.import_module(module), class_name)()
    return harness
