"""Cameras: one contract, a table of backends by name, each loaded only when a configuration names it."""

import importlib
from collections.abc import Mapping
from typing import Any, cast

from capture.camera.base import Camera, CameraSettings
from capture.errors import ConfigError

BACKENDS: Mapping[str, tuple[str, str]] = {
    "aravis": ("capture.camera.aravis", "AravisCamera"),
    "v4l2": ("capture.camera.v4l2", "V4l2Camera"),
    "simulated": ("hw_sim.camera", "SimulatedCamera"),
}


def make_camera(backend: str, address: str, settings: CameraSettings) -> Camera:
    """The camera of ``backend`` at ``address``, not opened yet.

    Raises:
        ConfigError: no such backend, or what it needs is not installed.
    """
    if backend not in BACKENDS:
        raise ConfigError(f"camera backend {backend!r} is unknown: use one of {', '.join(sorted(BACKENDS))}")
    module_name, class_name = BACKENDS[backend]
    try:
        module: Any = importlib.import_module(module_name)
    except ImportError as error:
        raise ConfigError(f"camera backend {backend!r} cannot be loaded ({error}): install what it needs") from error
    return cast(Camera, getattr(module, class_name)(address, settings))
