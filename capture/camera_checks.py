"""The configured cameras to findings: each opened and set up as for a flight, its link, its calibration."""

import contextlib
import json
from typing import Any

from capture.camera.base import CameraDescription
from capture.camera_place import camera_at, open_at
from capture.config import CameraPlace
from capture.errors import CameraError
from capture.finding import Finding, Situation
from capture.usb import UsbTree, read_usb
from capture.usb_checks import Asked, WantedCamera, usb_findings

ROW_TIME_TOLERANCE = 0.01


def check_usb(situation: Situation, tree: UsbTree | None = None) -> list[Finding]:
    """Links, permissions, power, memory and bandwidth of the cameras that are USB3 Vision."""
    tree = tree or read_usb()
    config = situation.config
    wanted = []
    for place in config.cameras:
        serial = place.serial or _serial_in(place.address, tree)
        if config.camera.backend == "aravis" and serial is not None and not _has_other_link(place.address):
            wanted.append(WantedCamera(_name(place), serial))
    if not wanted:
        why = "no camera with a known serial number is on USB"
        return [Finding("usb", True, f"nothing to check: {why}")]
    asked = Asked(config.camera.width, config.camera.height, config.trigger.rate_hz)
    return usb_findings(tree, wanted, asked)


def check_cameras(situation: Situation) -> list[Finding]:
    """Each camera is there, is the right one, takes its settings, and can follow the triggers."""
    findings = []
    for place in situation.config.cameras:
        camera = camera_at(situation.config, place)
        with contextlib.closing(camera):
            try:
                description = open_at(camera, situation.config, place)
            except CameraError as error:
                found, _, remedy = str(error).rpartition(": ")
                findings.append(Finding(f"camera {_name(place)}", False, found or remedy, remedy if found else ""))
                continue
            findings.append(_identity(place, description, camera.temperature_c()))
            findings.append(_rate(place, description, situation.config.trigger.rate_hz))
    return findings


def check_calibration(situation: Situation) -> list[Finding]:
    """The calibration that goes into the recording is that of these cameras."""
    path = situation.config.calibration
    if path is None:
        return [Finding("calibration", True, "none goes into the recording (`calibration` is not set)")]
    try:
        rig: Any = json.loads(path.read_text(encoding="utf-8"))
        sides = {side: rig[side] for side in ("left", "right") if side in rig}
        serials = {f"{side}/{name}": str(sides[side][f"{name}_serial"]) for side in sides for name in ("cam0", "cam1")}
        if not sides:
            raise ValueError("it has no side")
        row_times_ns = {side: float(sides[side]["row_time_ns"]) for side in sides}
    except (OSError, ValueError, KeyError, TypeError) as error:
        return [Finding("calibration", False, f"{path} is not a rig file ({error})", "make it with `wingproc rig`")]
    wrong = [
        f"{_name(place)} is {place.serial}, was calibrated as {serials[_name(place)]}"
        for place in situation.config.cameras
        if place.serial is not None and serials.get(_name(place), place.serial) != place.serial
    ]
    asked_us = situation.config.camera.row_time_us
    wrong += [
        f"row_time_us is {asked_us:g}, the {side} side was calibrated with {row_time_ns / 1e3:g}"
        for side, row_time_ns in row_times_ns.items()
        if asked_us is not None and abs(1e3 * asked_us - row_time_ns) > ROW_TIME_TOLERANCE * row_time_ns
    ]
    if wrong:
        remedy = "put the cameras back where they were, correct the configuration, or calibrate anew"
        return [Finding("calibration", False, f"{path}: {'; '.join(wrong)}", remedy, {"serials": serials})]
    return [Finding("calibration", True, f"{path}: of these cameras", numbers={"serials": serials})]


def _identity(place: CameraPlace, description: CameraDescription, temperature_c: float | None) -> Finding:
    said = [f"{description.model}, serial {description.serial}"]
    said += [f"firmware {description.firmware}"] if description.firmware else []
    said += [f"{temperature_c:.0f} °C"] if temperature_c is not None else []
    said += [f"{description.width}×{description.height}, {description.exposure_us} us, {description.gain_db:g} dB"]
    numbers = {
        "model": description.model,
        "serial": description.serial,
        "firmware": description.firmware,
        "temperature_c": temperature_c,
        "exposure_us": description.exposure_us,
        "gain_db": description.gain_db,
        "row_time_ns": description.row_time_ns,
        "features": dict(description.features),
    }
    return Finding(f"camera {_name(place)}", True, ", ".join(said), numbers=numbers)


def _rate(place: CameraPlace, description: CameraDescription, rate_hz: float) -> Finding:
    """A sensor that is exposed only after it was read out takes a trigger every exposure and read-out."""
    exposure_ms, readout_ms = description.exposure_us / 1e3, description.row_time_ns * description.height / 1e6
    most_hz = 1e3 / (exposure_ms + readout_ms)
    found = (
        f"exposure {exposure_ms:.1f} ms and read-out {readout_ms:.1f} ms: at most {most_hz:.1f} triggers a second, "
        f"{rate_hz:g} are asked"
    )
    ok = rate_hz <= most_hz
    remedy = "" if ok else f"lower `trigger.rate_hz` to {most_hz:.1f}, or `camera.exposure_us` or `camera.height`"
    return Finding(f"trigger rate {_name(place)}", ok, found, remedy, {"rate_limit_hz": most_hz, "rate_hz": rate_hz})


def _name(place: CameraPlace) -> str:
    return f"{place.side}/{place.name}"


def _serial_in(address: str, tree: UsbTree) -> str | None:
    """The serial number that an address ends in, as Aravis' own names do, if a device has it."""
    return next((device.serial for device in tree.devices if device.serial and address.endswith(device.serial)), None)


def _has_other_link(address: str) -> bool:
    """A GigE Vision camera by its IP address, or Aravis' own without hardware."""
    return address.startswith("fake:") or address.count(".") == 3
