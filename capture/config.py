"""The recorder's configuration: a TOML file to checked values."""

import hashlib
import math
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from capture.camera import BACKENDS
from capture.camera.base import CameraSettings
from capture.errors import ConfigError
from capture.placement import Placement
from capture.trigger_protocol import MAX_CHANNELS

MAX_PREVIEW_HZ = 2.0  # a preview is a copy of a whole frame


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class TriggerConfig(_Table):
    """The trigger board: where it is and how fast it shall run."""

    port: str
    rate_hz: Annotated[float, Field(gt=0, le=200)] = 25.0
    first_index: Annotated[int, Field(ge=0, lt=2**31)] = 0


class PtpConfig(_Table):
    """How this computer's clock is disciplined, and what is demanded of it."""

    role: Literal["slave", "master", "none"] = "slave"  # none: the clock runs free, and that is intended
    socket: Path = Path("/var/run/ptp4l")  # ptp4l's uds_address
    domain: Annotated[int, Field(ge=0, le=127)] = 0
    offset_limit_us: Annotated[float, Field(gt=0)] = 100.0
    silence_s: Annotated[float, Field(gt=0)] = 1.5  # without a Sync for so long, the master counts as lost
    phc: Path | None = None  # the network card's clock, where phc2sys moves the system clock after it


class DiskConfig(_Table):
    """The two disks, one for each side's pair of cameras."""

    left: Path
    right: Path
    segment_s: Annotated[float, Field(gt=0)] = 60.0
    segment_mb: Annotated[float, Field(gt=0)] = 8000.0
    reserve_mb: Annotated[float, Field(ge=0)] = 500.0
    write: Literal["auto", "direct", "buffered"] = "auto"
    takeover: bool = False  # when a disk fails, its side goes on on the other one


class GpioConfig(_Table):
    """An input line of a GPIO chip of this computer."""

    chip: Annotated[str, Field(pattern=r"^/.+$")]
    line: Annotated[int, Field(ge=0, lt=2**32)]
    active: Literal["high", "low"] = "high"
    debounce_ms: Annotated[float, Field(ge=0, le=1000)] = 10.0  # a level counts when it has lasted so long; 0: at once


class StartConfig(_Table):
    """What starts a recording, and what is tried just before it."""

    on: Literal["power-up", "command", "first-trigger", "mavlink-arm", "gpio"] = "power-up"
    burst: Annotated[int, Field(ge=0, le=100)] = 0  # triggers of the test burst; 0: none
    disarm_ends_after_s: Annotated[float | None, Field(ge=0)] = None  # of `mavlink-arm`; None: disarming ends nothing
    gpio: GpioConfig | None = None

    @model_validator(mode="after")
    def _has_what_it_needs(self) -> "StartConfig":
        if self.on == "gpio" and self.gpio is None:
            raise ValueError('on = "gpio" needs the table [start.gpio] with `chip` and `line`: add it')
        if self.on != "gpio" and self.gpio is not None:
            raise ValueError(f'the table [start.gpio] does nothing with on = "{self.on}": remove one of them')
        if self.on != "mavlink-arm" and self.disarm_ends_after_s is not None:
            raise ValueError(f'disarm_ends_after_s does nothing with on = "{self.on}": remove one of them')
        return self


class RingConfig(_Table):
    """How long a disk may stall before a frame is lost for want of room."""

    stall_s: Annotated[float, Field(gt=0, le=60)] = 2.0
    lock_memory: bool = True


class HealthConfig(_Table):
    """Where the recorder's health is shared with those who watch, and how often frames are shown."""

    folder: Path | None = None  # None: capture.health.default_folder
    preview_hz: Annotated[float, Field(ge=0, le=MAX_PREVIEW_HZ)] = MAX_PREVIEW_HZ  # a camera; 0: none


_Priority = Annotated[int, Field(ge=0, le=99)]
_Cpus = list[Annotated[int, Field(ge=0, lt=1024)]]


class ThreadsConfig(_Table):
    """Real-time priorities (SCHED_FIFO, 0: none) and processors ([]: any) of the recorder's threads."""

    read_priority: _Priority = 0  # one read thread a camera
    write_priority: _Priority = 0  # one write thread a disk
    control_priority: _Priority = 0  # the control thread and the trigger board's
    read_cpus: _Cpus = []
    write_cpus: _Cpus = []

    @property
    def read(self) -> Placement:
        """Of the read threads."""
        return Placement(self.read_priority, tuple(self.read_cpus))

    @property
    def write(self) -> Placement:
        """Of the write threads."""
        return Placement(self.write_priority, tuple(self.write_cpus))

    @property
    def control(self) -> Placement:
        """Of what else must keep up."""
        return Placement(self.control_priority)


class CameraDefaults(_Table):
    """What all cameras have in common."""

    backend: str
    width: Annotated[int, Field(gt=0, le=16384)] = 2080
    height: Annotated[int, Field(gt=0, le=16384)] = 1552
    exposure_us: Annotated[int, Field(gt=0, le=1_000_000)] = 2000
    gain_db: float = 0.0
    row_time_us: Annotated[float | None, Field(ge=0, le=1000)] = None  # None: as the camera says, if it does
    black_level: float | None = None  # in the camera's own unit; None: left as it is
    shutter_mode: str | None = None  # by the camera's own name; None: left as it is
    offset_x: Annotated[int, Field(ge=0)] = 0  # of the image on the sensor
    offset_y: Annotated[int, Field(ge=0)] = 0
    trigger_line: str = "Line0"
    trigger_activation: Literal["RisingEdge", "FallingEdge"] = "RisingEdge"
    trigger_latency_us: Annotated[float, Field(ge=0)] = 0.0  # from trigger to exposure, by the camera's data sheet
    time_sigma_limit_us: Annotated[float, Field(gt=0)] = 50.0  # of a frame's instant; beyond it, a gate fails

    @model_validator(mode="after")
    def _known_backend(self) -> "CameraDefaults":
        if self.backend not in BACKENDS:
            raise ValueError(f"backend {self.backend!r} is unknown: use one of {', '.join(sorted(BACKENDS))}")
        return self


class CameraPlace(_Table):
    """One camera: where it stands and how to reach it. ``serial`` binds a device to its place."""

    side: Literal["left", "right"]
    name: Literal["cam0", "cam1"]
    address: str
    serial: str | None = None


class CanConfig(_Table):
    """One CAN bus: ``interface``, ``channel`` and ``options`` are python-can's."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]
    interface: str
    channel: str | int
    options: dict[str, Any] = {}


class AnalogChannel(_Table):
    """One input of the trigger board: value = scale · volts + offset, in the unit that its name says."""

    channel: Annotated[int, Field(ge=0, lt=MAX_CHANNELS)]
    name: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]
    scale: float = 1.0
    offset: float = 0.0


class AnalogConfig(_Table):
    """The trigger board's analog inputs: how often they are sampled, and which are recorded."""

    rate_hz: Annotated[float, Field(gt=0, le=200)] = 50.0
    channels: Annotated[list[AnalogChannel], Field(min_length=1, max_length=MAX_CHANNELS)]

    @model_validator(mode="after")
    def _channels_differ(self) -> "AnalogConfig":
        for what, values in (
            ("channel", [str(channel.channel) for channel in self.channels]),
            ("name", [channel.name for channel in self.channels]),
        ):
            for value in values:
                if values.count(value) > 1:
                    raise ValueError(f"{what} {value} is there twice")
        return self


class MavlinkConfig(_Table):
    """The autopilot's MAVLink stream, which is listened to only."""

    address: Annotated[str, Field(pattern=r"^(udp:[^:]*:\d+|/.+)$")]  # udp:<own address>:<port>, or a serial port
    baud: Annotated[int, Field(gt=0)] = 57600
    messages: Annotated[list[str], Field(min_length=1)] = ["ATTITUDE", "VFR_HUD"]


class Config(_Table):
    """Everything that ``wingcap record`` needs to know."""

    trigger: TriggerConfig
    disks: DiskConfig
    camera: CameraDefaults
    cameras: Annotated[list[CameraPlace], Field(min_length=1, max_length=4)]
    ring: RingConfig = RingConfig()
    health: HealthConfig = HealthConfig()
    ptp: PtpConfig | None = None
    threads: ThreadsConfig = ThreadsConfig()
    start: StartConfig = StartConfig()
    flight: str | None = Field(default=None, pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")
    calibration: Path | None = None
    can: list[CanConfig] = []
    analog: AnalogConfig | None = None
    mavlink: MavlinkConfig | None = None

    @model_validator(mode="after")
    def _places_differ(self) -> "Config":
        places = [(camera.side, camera.name) for camera in self.cameras]
        for place in places:
            if places.count(place) > 1:
                raise ValueError(f"cameras: {place[0]} {place[1]} is named twice")
        buses = [bus.name for bus in self.can]
        for bus in buses:
            if buses.count(bus) > 1:
                raise ValueError(f"can: the bus {bus} is there twice")
        return self

    @model_validator(mode="after")
    def _autopilot_is_heard(self) -> "Config":
        if self.start.on == "mavlink-arm" and self.mavlink is None:
            raise ValueError(
                'start.on = "mavlink-arm" needs the table [mavlink] with the autopilot\'s `address`: add it'
            )
        return self

    @property
    def settings(self) -> CameraSettings:
        """What every camera is asked to be."""
        camera = self.camera
        return CameraSettings(
            width=camera.width,
            height=camera.height,
            exposure_us=camera.exposure_us,
            gain_db=camera.gain_db,
            offset_x=camera.offset_x,
            offset_y=camera.offset_y,
            black_level=camera.black_level,
            shutter_mode=camera.shutter_mode,
            trigger_line=camera.trigger_line,
            trigger_activation=camera.trigger_activation,
        )

    @property
    def exposure_warning(self) -> str | None:
        """What speaks against the exposure, with the figures; None: nothing does."""
        low_us, high_us = GOOD_EXPOSURE_US
        exposure_us = self.camera.exposure_us
        if low_us <= exposure_us <= high_us:
            return None
        effect = "lights may be too faint" if exposure_us < low_us else "lights saturate, grow halos and smear"
        return (
            f"exposure {exposure_us} us is outside {low_us} to {high_us} us: {effect}; "
            "set `camera.exposure_us`, and close the aperture rather than going below"
        )

    @property
    def ring_slots(self) -> int:
        """Slots of each camera's ring: the stall it must bridge (at least what a silent camera may claim of its
        partner's room, see capture.grabber.SideGate), and what the driver always holds."""
        buffers = driver_buffers(self.trigger.rate_hz)
        return max(math.ceil(self.ring.stall_s * self.trigger.rate_hz), buffers + 1) + buffers


GOOD_EXPOSURE_US = (1000, 5000)
"""Within it the paper's lights were found to be neither faint nor saturated (section on exposure, Figs. 11 to 13)."""

DRIVER_BUFFERS = 10
"""Buffers that a driver is given at least, so that a full ring is met by us, with a cause, and not by the driver. At
the start some of them are held back until the first frames are numbered (capture.numbering.MOST_HELD)."""
STARVED_S = 0.4
"""How long a busy machine may keep the read threads waiting before the driver has no buffer left."""


def driver_buffers(rate_hz: float) -> int:
    """Buffers a driver is given."""
    return max(DRIVER_BUFFERS, math.ceil(STARVED_S * rate_hz))


@dataclass(frozen=True)
class LoadedConfig:
    """A configuration with the text it came from, which every segment carries."""

    config: Config
    text: str
    sha256: str
    calibration: bytes | None = None  # read once, so that every segment carries the same


def load_config(path: Path) -> LoadedConfig:
    """Read and check a configuration file. Relative paths in it are relative to its folder.

    Raises:
        ConfigError: missing, not TOML, an unknown key or a value out of range; the message names the file and the key.
    """
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}): give an existing file with --config") from error
    try:
        text = raw.decode()
        config = Config.model_validate(tomllib.loads(text))
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"{path}: not a TOML file ({error}): mend that line") from error
    except ValidationError as error:
        raise ConfigError(f"{path}: {_first_problem(error)}") from error
    folder = path.parent
    left, right = (folder / disk.expanduser() for disk in (config.disks.left, config.disks.right))
    if left.resolve() == right.resolve():
        raise ConfigError(f"{path}: `disks.left` and `disks.right` are the same folder: give each side one of its own")
    health = config.health
    if health.folder is not None:
        health = health.model_copy(update={"folder": folder / health.folder.expanduser()})
    disks = config.disks.model_copy(update={"left": left, "right": right})
    calibration = folder / config.calibration if config.calibration else None
    if calibration is not None and not calibration.is_file():
        raise ConfigError(
            f"{calibration}: the calibration named in {path} is missing: make it with `wingproc rig`, "
            "or remove the key `calibration`"
        )
    carried = calibration.read_bytes() if calibration else None
    config = config.model_copy(update={"disks": disks, "calibration": calibration, "health": health})
    return LoadedConfig(config, text, hashlib.sha256(raw).hexdigest(), carried)


def _first_problem(error: ValidationError) -> str:
    problem = error.errors()[0]
    key = ".".join(str(part) for part in problem["loc"])
    if problem["type"] == "extra_forbidden":
        return f"unknown key `{key}`: remove it or correct its spelling (docs/reference/config.md lists the keys)"
    if problem["type"] == "missing":
        return f"key `{key}` is missing: add it (docs/reference/config.md lists the keys)"
    message = problem["msg"].removeprefix("Value error, ")
    return f"`{key}`: {message}" if key else message
