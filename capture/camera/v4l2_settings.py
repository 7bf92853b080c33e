"""What a V4L2 device is asked to be, to what its driver took of it: format, controls, trigger, read back one by one."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from urllib.parse import parse_qsl

from capture.camera.base import CameraSettings
from capture.camera.v4l2_device import Control, Format, V4l2Device
from capture.errors import CameraError

TRIGGER_MODES = ("trigger_mode", "external_trigger", "trigger_enable")
"""What drivers with a hardware trigger call the control that turns it on."""
TRIGGER_SOURCE, TRIGGER_ACTIVATION = "trigger_source", "trigger_activation"
FIXED_EXPOSURE = ("exposure", "fixed")
_MANUAL = {  # what would change a setting by itself: the value that stops it. Names before and after Linux 5.18
    "auto_exposure": 1,
    "exposure_auto": 1,
    "exposure_dynamic_framerate": 0,
    "exposure_auto_priority": 0,
    "gain_automatic": 0,
    "autogain": 0,
}
_EXPOSURES = ("exposure_time_absolute", "exposure_absolute")
_EXPOSURE_UNIT_US = 100
_EXPOSURE_TOLERANCE = 0.02
_EXPOSURE_STEP_US = 20
_GAINS = ("analogue_gain", "gain")


@dataclass(frozen=True)
class Wishes:
    """An address taken apart: ``/dev/video0?input=3&fps=10``."""

    path: str
    others: dict[str, str]

    @classmethod
    def parse(cls, address: str) -> "Wishes":
        """The device file and what else is to be set."""
        path, _, query = address.partition("?")
        return cls(path, dict(parse_qsl(query, keep_blank_values=True)))


class V4l2Settings:
    """The settings of one open device. Errors name device, setting, what was asked and what it has."""

    def __init__(self, device: V4l2Device, address: str, settings: CameraSettings) -> None:
        self.taken: dict[str, str] = {}
        self._device = device
        self._address = address
        self._asked = settings
        self._controls: dict[str, Control] = {}

    def configure(self, wishes: dict[str, str]) -> tuple[Format, int, float, bool]:
        """Set everything; format, exposure in µs, gain in dB, and whether a hardware trigger is on.

        The gain is 0 where it is the lowest that the driver has, NaN where it was given in the driver's own unit.

        Raises:
            CameraError: a setting is missing, refused, or was not taken.
        """
        left = dict(wishes)
        if "input" in left:
            self._number("input", left.pop("input"), lambda x: self._device.choose_input(round(x)))
        agreed = self._format()
        if "fps" in left:
            self._number("fps", left.pop("fps"), self._device.ask_rate)
        self._controls = self._device.controls()
        for name, value in _MANUAL.items():
            if name in self._controls and name not in left:
                self._set(name, value, "it must not change by itself: set it by hand (`v4l2-ctl`) and try again")
        exposure_us = self._exposure(left)
        gain_db = self._gain(left)
        self._refuse_what_there_is_not()
        triggered = self._trigger()
        for name, text in left.items():
            if name not in self._controls:
                known = ", ".join(sorted(self._controls)) or "none"
                raise CameraError(f"{self._address}: the driver has no control {name}: its controls are {known}")
            self._number(name, text, lambda x, n=name: self._device.set(self._controls[n], round(x)))  # type: ignore[misc]
        return agreed, exposure_us, gain_db, triggered

    def _format(self) -> Format:
        asked = self._asked
        got = self._device.ask_format(asked.width, asked.height)
        if (got.fourcc, got.width, got.height) != ("GREY", asked.width, asked.height):
            raise CameraError(
                f"{self._address}: {asked.width}×{asked.height} GREY (8 bit) was asked, the driver gives {got.width}×"
                f"{got.height} {got.fourcc}: set `camera.width` and `camera.height` to what `v4l2-ctl "
                "--list-formats-ext` lists for GREY; a device without GREY cannot be used"
            )
        return got

    def _exposure(self, wishes: dict[str, str]) -> int:
        name = next((name for name in _EXPOSURES if name in self._controls), None)
        asked_us = self._asked.exposure_us
        if name is None:
            key, value = FIXED_EXPOSURE
            if wishes.pop(key, None) != value:
                raise CameraError(
                    f"{self._address}: the driver cannot set the exposure ({asked_us} us was asked): add "
                    f"`{key}={value}` to the address when the device is known to expose so long"
                )
            self.taken[key] = "fixed: as configured, not told by the driver"
            return asked_us
        got_us = _EXPOSURE_UNIT_US * self._device.set(self._controls[name], round(asked_us / _EXPOSURE_UNIT_US))
        if abs(got_us - asked_us) > max(_EXPOSURE_STEP_US, _EXPOSURE_TOLERANCE * asked_us):
            control = self._controls[name]
            low, high = _EXPOSURE_UNIT_US * control.lowest, _EXPOSURE_UNIT_US * control.highest
            raise CameraError(
                f"{self._address}: exposure {asked_us} us was asked, the driver has {got_us}: it takes {low} to {high} "
                f"in steps of {_EXPOSURE_UNIT_US}; set `camera.exposure_us`"
            )
        self.taken[name] = str(got_us // _EXPOSURE_UNIT_US)
        return got_us

    def _gain(self, wishes: dict[str, str]) -> float:
        name = next((name for name in _GAINS if name in self._controls), None)
        if name is not None and name in wishes:
            return math.nan
        if self._asked.gain_db != 0.0:
            raise CameraError(
                f"{self._address}: gain {self._asked.gain_db:g} dB was asked, V4L2 knows no dB: set `camera.gain_db` "
                f"= 0 for the lowest gain, or add `{name or 'gain'}=…` in the driver's unit to the address"
            )
        if name is not None:
            self._set(name, self._controls[name].lowest, "set `camera.gain_db` by the address")
        return 0.0

    def _refuse_what_there_is_not(self) -> None:
        asked = self._asked
        for key, given in (
            ("offset_x", asked.offset_x),
            ("offset_y", asked.offset_y),
            ("black_level", asked.black_level),
            ("shutter_mode", asked.shutter_mode),
        ):
            if given:
                raise CameraError(
                    f"{self._address}: {key} {given} was asked, V4L2 has no common setting for it: remove "
                    f"`camera.{key}`; a control of the driver's own goes into the address"
                )

    def _trigger(self) -> bool:
        mode = next((name for name in TRIGGER_MODES if name in self._controls), None)
        if mode is None:
            return False
        self._choose(TRIGGER_SOURCE, self._asked.trigger_line, "camera.trigger_line")
        self._choose(TRIGGER_ACTIVATION, self._asked.trigger_activation, "camera.trigger_activation")
        self._set(mode, 1, "the trigger cannot be turned on")
        return True

    def _choose(self, name: str, asked: str, key: str) -> None:
        """An entry of a menu by its name, however the driver spells it; nothing where there is no such menu."""
        control = self._controls.get(name)
        if control is None or not control.menu:
            return
        value = next((value for value, entry in control.menu if _letters(entry) == _letters(asked)), None)
        if value is None:
            entries = ", ".join(entry for _, entry in control.menu)
            raise CameraError(f"{self._address}: {name} {asked} was asked, the driver has {entries}: set `{key}`")
        self._set(name, value, f"set `{key}`")

    def _number(self, name: str, text: str, ask: Callable[[float], float]) -> None:
        try:
            asked = float(text)
        except ValueError as error:
            raise CameraError(f"{self._address}: {name}={text} is not a number: correct the address") from error
        try:
            got = ask(asked)
        except OSError as error:
            raise CameraError(
                f"{self._address}: the driver refuses {name}={text} ({error.strerror}): correct the address"
            ) from error
        if not math.isclose(got, asked, rel_tol=1e-3):
            raise CameraError(f"{self._address}: {name}={text} was asked, the driver has {got:g}: correct the address")
        self.taken[name] = f"{got:g}"

    def _set(self, name: str, value: int, remedy: str) -> None:
        try:
            got = self._device.set(self._controls[name], value)
        except OSError as error:
            raise CameraError(
                f"{self._address}: the driver refuses {name} = {value} ({error.strerror}): {remedy}"
            ) from error
        if got != value:
            raise CameraError(f"{self._address}: {name} {value} was asked, the driver has {got}: {remedy}")
        self.taken[name] = str(got)


def _letters(text: str) -> str:
    return "".join(letter.lower() for letter in text if letter.isalnum())
