"""One camera of the configuration to the device that stands there, opened: the right one, and with a trigger."""

import dataclasses

from capture.camera import make_camera
from capture.camera.base import Camera, CameraDescription
from capture.config import CameraPlace, Config
from capture.errors import CameraError


def camera_at(config: Config, place: CameraPlace) -> Camera:
    """The camera, not opened yet."""
    return make_camera(config.camera.backend, place.address, config.settings)


def expected_at(config: Config, place: CameraPlace) -> CameraDescription:
    """What a camera that is not there is taken for until it is: what the configuration says. Its model is unnamed."""
    asked = config.settings
    return CameraDescription(
        model="",
        serial=place.serial or "",
        width=asked.width,
        height=asked.height,
        exposure_us=asked.exposure_us,
        gain_db=asked.gain_db,
        row_time_ns=round((config.camera.row_time_us or 0.0) * 1000.0),
        tick_hz=1e9,
        frame_id_bits=16,
        hardware_trigger=True,
    )


def open_at(camera: Camera, config: Config, place: CameraPlace) -> CameraDescription:
    """Open it and check that it is the one that belongs here. Closing it is the caller's, whatever is raised.

    Raises:
        CameraError: not there, it did not take the settings, another serial number answers, or it has no trigger.
    """
    name = f"{place.side}/{place.name}"
    try:
        description = camera.open()
    except CameraError as error:
        raise CameraError(f"{name}: {error}") from error
    if place.serial is not None and place.serial != description.serial:
        raise CameraError(
            f"{name}: serial {description.serial} answers at {place.address}, not {place.serial}: "
            "swap the cables, or the serials in the configuration"
        )
    if not description.hardware_trigger:
        raise CameraError(f"{name}: {description.model} has no hardware trigger: it cannot be synchronised")
    if config.camera.row_time_us is not None:
        return dataclasses.replace(description, row_time_ns=round(config.camera.row_time_us * 1000.0))
    return description
