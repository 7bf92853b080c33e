"""A GenICam camera's features: settings to what the camera took of them, read back one by one."""

import ctypes
from collections.abc import Callable
from typing import Any

from capture.camera.aravis_chunks import Chunks
from capture.camera.aravis_library import AravisLibrary
from capture.camera.base import CameraDescription, CameraSettings
from capture.errors import CameraError

EXPOSURE_TOLERANCE = 0.02  # of what was asked: a camera counts exposure in rows or clock ticks
EXPOSURE_STEP_US = 20.0
GAIN_TOLERANCE_DB = 0.1
BLACK_LEVEL_TOLERANCE = 0.1
_ROUNDING = 1e-6  # of a bound that was converted

_SHUTTER = ("SensorShutterMode", "ShutterMode")
_FIRMWARE = ("DeviceFirmwareVersion", "DeviceVersion")
_TEMPERATURE = "DeviceTemperature"
_READY_SELECTOR, _READY = "AcquisitionStatusSelector", "AcquisitionStatus"
_OFF = (  # what would change a setting by itself, or hold the rate below the trigger's
    ("TriggerMode", "Off"),
    ("ExposureAuto", "Off"),
    ("GainAuto", "Off"),
    ("BlackLevelAuto", "Off"),
    ("ExposureMode", "Timed"),
    ("AcquisitionFrameRateAuto", "Off"),
)
_FRAME_RATE_LIMITS = ("AcquisitionFrameRateEnable", "AcquisitionFrameRateEnabled")


class Features:
    """The features of one open camera. Errors name camera, feature, what was asked and what the camera has."""

    def __init__(self, library: AravisLibrary, camera: int, address: str) -> None:
        self.exposure_us = 0
        self.gain_db = 0.0
        self.payload_bytes = 0  # of a frame: the pixels, and its chunk data behind them
        self.chunks = Chunks(library, camera)
        self._library = library
        self._camera = camera
        self._address = address
        self._taken: dict[str, str] = {}
        self._tells_ready = False

    def configure(self, settings: CameraSettings, is_fake: bool) -> CameraDescription:
        """Set everything and read it back. Aravis' own fake takes a trigger's settings but runs free.

        Raises:
            CameraError: a feature is missing, refused, or was not taken.
        """
        self._call("arv_camera_stop_acquisition")  # a recorder that was killed may have left it running
        self._enumeration_if_there("TriggerSelector", "FrameStart")
        for name, value in _OFF:
            self._enumeration_if_there(name, value)
        for name in _FRAME_RATE_LIMITS:
            if self._has(name):
                self._call("arv_camera_set_boolean", name.encode(), 0)
        self._enumeration("AcquisitionMode", "Continuous", "this camera cannot run without end")
        self._enumeration("PixelFormat", "Mono8", "this camera gives no 8 bit grey images: it cannot be used")
        self._shutter(settings.shutter_mode)
        self._region(settings)
        self._exposure(settings.exposure_us)
        self._gain(settings.gain_db)
        if settings.black_level is not None:
            self._black_level(settings.black_level)
        triggered = not is_fake and self._has("TriggerMode")
        if triggered:
            self._trigger(settings)
        return self._description(settings, triggered, is_fake)

    def waits_for_trigger(self) -> bool:
        """Whether the armed camera waits for its trigger; True for one that cannot tell."""
        if not self._tells_ready:
            return True
        return bool(self._call("arv_camera_get_boolean", _READY.encode()))

    def temperature_c(self) -> float | None:
        """The device's own temperature; None where it has none.

        Raises:
            CameraError: it does not answer.
        """
        if not self._has(_TEMPERATURE):
            return None
        try:
            return float(self._call("arv_camera_get_float", _TEMPERATURE.encode()))
        except CameraError:  # some count whole degrees
            return float(self._call("arv_camera_get_integer", _TEMPERATURE.encode()))

    def _description(self, settings: CameraSettings, triggered: bool, is_fake: bool) -> CameraDescription:
        size = settings.width * settings.height
        chunks = self.chunks.turn_on(size)
        if chunks:
            self._taken["chunks"] = chunks
        self.payload_bytes = self._call("arv_camera_get_payload")
        if self.payload_bytes != size and not self.chunks.active:
            raise CameraError(
                f"{self._address}: the camera wants to send {self.payload_bytes} bytes a frame, not {settings.width}×"
                f"{settings.height} = {size}: turn off chunk data and padding in its own settings"
            )
        firmware = next((self._string(name) for name in _FIRMWARE if self._has(name)), "")
        maker, model = self._name("vendor_name"), self._name("model_name")
        return CameraDescription(
            model=f"{maker} {model}".strip(),
            serial=self._name("device_serial_number"),
            width=settings.width,
            height=settings.height,
            exposure_us=self.exposure_us,
            gain_db=self.gain_db,
            row_time_ns=0,
            tick_hz=1e9,  # Aravis gives every clock in nanoseconds
            frame_id_bits=64,
            hardware_trigger=triggered,
            frame_counter=not is_fake,
            tells_unplug=not is_fake,
            firmware=firmware,
            features=tuple(self._taken.items()),
        )

    def _trigger(self, settings: CameraSettings) -> None:
        self._enumeration("TriggerSource", settings.trigger_line, "set `camera.trigger_line` to a line that it has")
        self._enumeration(
            "TriggerActivation", settings.trigger_activation, "set `camera.trigger_activation` to an edge that it has"
        )
        self._enumeration("TriggerMode", "On", "this camera cannot be triggered")
        if self._has(_READY):
            self._enumeration_if_there(_READY_SELECTOR, "FrameTriggerWait")
            self._tells_ready = True

    def _shutter(self, mode: str | None) -> None:
        name = next((name for name in _SHUTTER if self._has(name)), None)
        if mode is None:
            if name is not None:
                self._taken[name] = self._string(name)
        elif name is None:
            raise CameraError(f"{self._address}: the camera has no shutter mode: remove `camera.shutter_mode`")
        else:
            self._enumeration(name, mode, "set `camera.shutter_mode` to a mode that it has, or remove it")

    def _region(self, settings: CameraSettings) -> None:
        for name in ("OffsetX", "OffsetY"):  # else an old offset would limit the new size
            if self._has(name):
                self._call("arv_camera_set_integer", name.encode(), 0)
        for name, asked in (
            ("Width", settings.width),
            ("Height", settings.height),
            ("OffsetX", settings.offset_x),
            ("OffsetY", settings.offset_y),
        ):
            if not self._has(name):
                if asked and name.startswith("Offset"):
                    raise CameraError(f"{self._address}: the camera has no {name}: remove `camera.offset_{name[-1:]}`")
                continue
            self._integer(name, asked)

    def _integer(self, name: str, asked: int) -> None:
        key = f"camera.{name.lower() if not name.startswith('Offset') else 'offset_' + name[-1].lower()}"
        refusal = self._refusal("arv_camera_set_integer", name.encode(), asked)
        got = self._call("arv_camera_get_integer", name.encode())
        if got != asked:
            low, high = ctypes.c_int64(), ctypes.c_int64()
            self._call("arv_camera_get_integer_bounds", name.encode(), ctypes.byref(low), ctypes.byref(high))
            raise CameraError(
                f"{self._address}: {name} {asked} was asked, the camera has {got}{refusal}: "
                f"it takes {low.value} to {high.value}; set `{key}`"
            )
        self._taken[name] = str(got)

    def _exposure(self, asked_us: int) -> None:
        got_us = self._number(
            "exposure_time", float(asked_us), max(EXPOSURE_STEP_US, EXPOSURE_TOLERANCE * asked_us), "us", "exposure_us"
        )
        self.exposure_us = round(got_us)

    def _gain(self, asked_db: float) -> None:
        self.gain_db = self._number("gain", asked_db, GAIN_TOLERANCE_DB, "dB", "gain_db")

    def _black_level(self, asked: float) -> None:
        if not self._call("arv_camera_is_black_level_available"):
            raise CameraError(f"{self._address}: the camera has no black level: remove `camera.black_level`")
        self._number("black_level", asked, BLACK_LEVEL_TOLERANCE, "", "black_level")

    def _number(self, what: str, asked: float, tolerance: float, unit: str, key: str) -> float:
        """Set one of the numbers that go by several names, which the library knows."""
        low, high = ctypes.c_double(), ctypes.c_double()
        self._call(f"arv_camera_get_{what}_bounds", ctypes.byref(low), ctypes.byref(high))
        possible = low.value - _ROUNDING <= asked <= high.value + _ROUNDING
        refusal = self._refusal(f"arv_camera_set_{what}", asked) if possible else ""
        got: float = self._call(f"arv_camera_get_{what}")
        if not possible or abs(got - asked) > tolerance:
            name = f"{what.replace('_', ' ')} {asked:g} {unit}".strip()
            raise CameraError(
                f"{self._address}: {name} was asked, the camera has {got:g}{refusal}: "
                f"it takes {low.value:g} to {high.value:g}; set `camera.{key}`"
            )
        self._taken[what] = f"{got:g}"
        return got

    def _enumeration(self, name: str, asked: str, remedy: str) -> None:
        if not self._has(name):
            raise CameraError(f"{self._address}: the camera has no feature {name} ({asked} is needed): {remedy}")
        refusal = self._refusal("arv_camera_set_string", name.encode(), asked.encode())
        got = self._string(name)
        if got != asked:
            raise CameraError(f"{self._address}: {name} {asked} was asked, the camera has {got}{refusal}: {remedy}")
        self._taken[name] = got

    def _enumeration_if_there(self, name: str, asked: str) -> None:
        if self._has(name):
            self._enumeration(name, asked, "set it by hand (`arv-tool-0.8`) and try again")

    def _refusal(self, name: str, *arguments: object) -> str:
        """Set a feature; the camera's own words when it refuses, for the message that the read-back leads to."""
        try:
            self._call(name, *arguments)
        except CameraError as error:
            return f" ({error})"
        return ""

    def _has(self, name: str) -> bool:
        return bool(self._call("arv_camera_is_feature_available", name.encode()))

    def _string(self, name: str) -> str:
        return self._text(lambda: self._call("arv_camera_get_string", name.encode()))

    def _name(self, what: str) -> str:
        return self._text(lambda: self._call(f"arv_camera_get_{what}"))

    def _text(self, read: Callable[[], bytes | None]) -> str:
        try:
            return (read() or b"").decode(errors="replace").strip()
        except CameraError:
            return ""

    def _call(self, name: str, *arguments: object) -> Any:
        return self._library.call(name, self._camera, *arguments)
