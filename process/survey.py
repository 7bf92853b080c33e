"""survey.toml to what was surveyed on the aircraft: lights with known places, and about where each pair is mounted."""

import math
import tomllib
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from capture.errors import ProcessError, UsageError

Metres = Annotated[float, Field(ge=-100.0, le=100.0, allow_inf_nan=False)]
Millimetres = Annotated[float, Field(ge=0.0, le=100.0, allow_inf_nan=False)]
Vector = tuple[Metres, Metres, Metres]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class SurveyPoint(_Strict):
    """A light whose centre was surveyed."""

    name: str = Field(min_length=1)
    xyz_m: Vector
    """body frame"""
    sigma_mm: float = Field(gt=0.0, le=100.0, allow_inf_nan=False)
    """of each coordinate"""
    on_fuselage: bool = False
    """it stays on the aircraft, and is seen in flight"""


class SurveySide(_Strict):
    """One pair: its pictures of the lights, its cameras, and about where it is."""

    cam0_image: Path
    cam1_image: Path
    cam0_serial: str = Field(min_length=1)
    cam1_serial: str = Field(min_length=1)
    approx_position_m: Vector
    """middle between the cameras, body frame"""
    approx_outboard: Vector
    """direction in which the pair looks, body frame"""
    points: tuple[SurveyPoint, ...]

    @model_validator(mode="after")
    def _makes_sense(self) -> "SurveySide":
        if math.hypot(*self.approx_outboard) < 1e-6:
            raise ValueError("approx_outboard is zero: give the direction in which the pair looks")
        if math.hypot(*self.approx_outboard[:2]) < 1e-3 * math.hypot(*self.approx_outboard):
            raise ValueError("approx_outboard is vertical: which way is up in the pictures cannot be told")
        names = [point.name for point in self.points]
        twice = {name for name in names if names.count(name) > 1}
        if twice:
            raise ValueError(f"points named twice: {', '.join(sorted(twice))}")
        return self


class SurveyMarkers(_Strict):
    """Where the markers sit on each wing."""

    pairs_station_m: tuple[Annotated[float, Field(ge=0.0, le=100.0)], ...] = Field(min_length=1)
    chord_m: tuple[Metres, Metres]
    height_m: Metres
    standoff_mm: Millimetres = 0.0
    """of the light's centre above the surface that it is fixed to"""
    standoff_sigma_mm: Millimetres = 0.0
    dome_radius_mm: Millimetres = 0.0
    """of the bulb's round top; 0: flat"""
    dome_sigma_mm: Millimetres = 0.0

    @model_validator(mode="after")
    def _makes_sense(self) -> "SurveyMarkers":
        if list(self.pairs_station_m) != sorted(set(self.pairs_station_m)):
            raise ValueError("pairs_station_m must grow from the root outboard")
        if self.chord_m[0] <= self.chord_m[1]:
            raise ValueError("chord_m is (fore, aft), positive forward: the first must be larger")
        return self


class Survey(_Strict):
    """All of survey.toml; its picture paths are absolute or relative to the working directory once read."""

    row_time_us: float = Field(ge=0.0, le=1000.0, allow_inf_nan=False)
    """time from one sensor row's exposure to the next; 0 for a global shutter"""
    markers: SurveyMarkers
    left: SurveySide
    right: SurveySide

    @model_validator(mode="after")
    def _makes_sense(self) -> "Survey":
        if self.left.approx_outboard[1] >= 0.0 or self.right.approx_outboard[1] <= 0.0:
            raise ValueError("the left pair looks towards -y and the right pair towards +y: left and right are swapped")
        serials = [serial for side in (self.left, self.right) for serial in (side.cam0_serial, side.cam1_serial)]
        if len(set(serials)) < len(serials):
            raise ValueError(f"each camera has its own serial number, got {', '.join(serials)}")
        return self


def read_survey(path: Path) -> Survey:
    """Read survey.toml.

    Raises ProcessError if it is missing or not TOML, UsageError naming the file and the key for what is wrong in it.
    """
    try:
        with path.open("rb") as file:
            value = tomllib.load(file)
    except FileNotFoundError as error:
        raise ProcessError(f"{path}: no such file; write it as docs/reference/calibration-files.md shows") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ProcessError(f"{path}: not a TOML file ({error})") from error
    try:
        survey = Survey.model_validate(value)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        known = "unknown key" if first["type"] == "extra_forbidden" else str(first["msg"]).removeprefix("Value error, ")
        raise UsageError(f"{path}: {f'{key}: ' if key else ''}{known}") from error
    return survey.model_copy(
        update={side: _with_paths(getattr(survey, side), path.parent) for side in ("left", "right")}
    )


def _with_paths(side: SurveySide, folder: Path) -> SurveySide:
    return side.model_copy(update={"cam0_image": folder / side.cam0_image, "cam1_image": folder / side.cam1_image})
