"""Everything that is true of the simulated world, and its file ``world.toml``: a seed in, one aircraft out.

The file is the truth: it holds the cameras' real poses and lenses, so it never goes where the measuring commands can
read it. The defaults are X-HALE's (half span 3 m, 36 LEDs, four cameras with F = 3.5 mm).
"""

import dataclasses
import math
import tomllib
import types
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from capture.errors import UsageError

Matrix = tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Wing:
    """One half wing as built; the other is its mirror image."""

    half_span_m: float = 3.0
    break_m: float = 2.0  # arc station from which the dihedral holds
    dihedral_deg: float = 10.0
    incidence_deg: float = 5.0
    chord_m: float = 0.2
    axis_chord: float = 0.288  # the beam's reference axis, in chords aft of the leading edge


@dataclass(frozen=True)
class Leds:
    """The lights on a half wing, in the section frame of docs/ARCHITECTURE.md; marker = 2 · pair + (0 fore, 1 aft)."""

    pairs_station_m: tuple[float, ...] = (0.2, 0.5, 0.8, 1.2, 1.5, 1.8, 2.2, 2.5, 2.8)
    chord_m: tuple[float, ...] = (0.04, -0.10)  # forward of the axis
    height_m: float = 0.004  # of the light's centre above the axis plane
    placement_sigma_m: float = 0.0  # by which a light is off its place, along each axis of its section
    diameter_m: float = 0.003
    form: str = "disc"  # disc: flat, it faces every camera | dome: a bulb, half a ball of this diameter on the wing
    elevation_deg: float = 10.0  # of the beam's axis above the section plane; it points inboard
    beam_exponent: float = 6.0  # radiance falls with cos^n of the angle off the beam's axis
    radiance_e_per_ms: float = 3500.0  # electrons a pixel and millisecond, on the axis of a resolved light, at 0 dB


@dataclass(frozen=True)
class Sensor:
    """What the four sensors have in common."""

    width_px: int = 2080
    height_px: int = 1552
    psf_sigma_px: float = 0.9
    full_well_e: float = 10000.0
    e_per_dn: float = 38.0  # at 0 dB
    read_noise_e: float = 20.0
    black_dn: float = 4.0
    veil: float = 0.02  # part of the light above the full well that comes back as a halo
    frame_id_bits: int = 16
    tick_hz: float = 1.0e9


@dataclass(frozen=True)
class Scene:
    """What is seen besides the lights."""

    background: str = "dark"  # dark | sunlit
    finish: str = "matt"  # matt | clean: how much of a light the wing's upper side mirrors
    sunlit_e_per_ms: float = 1000.0  # at the middle of the image


@dataclass(frozen=True)
class Mount:
    """Where the camera pairs were meant to be; mirrored for the left wing's pair."""

    baseline_m: float = 0.2794
    centre_x_m: float = 0.03
    across_m: float = 0.2  # behind the centre line, as the pair looks
    height_m: float = 0.08
    pitch_deg: float = 8.0  # up
    position_sigma_m: float = 0.002
    angle_sigma_deg: float = 0.3


@dataclass(frozen=True)
class Fuselage:
    """Reference lights on rigid brackets of the fuselage, which face the cameras: on in the survey and in flight."""

    lights_m: Matrix = ()  # (x, y, z) each, body frame, for the right pair; mirrored for the left one


FUSELAGE_LIGHTS = Fuselage(
    (  # beside the wing and above it, so that no marker comes near them in either image
        (-0.26, 0.42, 0.22),
        (0.30, 0.46, 0.10),
        (-0.22, 0.62, -0.10),
        (0.24, 0.66, 0.36),
        (-0.20, 0.80, 0.40),
        (0.26, 0.84, -0.12),
    )
)
"""six a side, 0.6 to 1.1 m from the cameras"""


@dataclass(frozen=True)
class MountMotion:
    """Amplitudes of each pair's motion against the fuselage, see mount_motion; as calibrated and surveyed it stands."""

    drift_mm: float = 0.0
    drift_mrad: float = 0.0
    drift_hz: float = 0.03
    vibration_mm: float = 0.0
    vibration_mrad: float = 0.0
    vibration_hz: float = 7.3


@dataclass(frozen=True)
class CameraTruth:
    """One camera as it really is."""

    side: str
    name: str
    model: str
    serial: str
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float
    k2: float
    p1: float
    p2: float
    k3: float
    T_body_cam: Matrix
    exposure_us: int
    gain_db: float
    row_time_us: float
    clock_drift_ppm: float
    clock_offset_ticks: int

    @property
    def key(self) -> str:
        """``left_cam0`` …: its name on the rig's socket."""
        return f"{self.side}_{self.name}"


@dataclass(frozen=True)
class Sine:
    """One steady oscillation of one shape; ``antisymmetric_rad`` adds on the right wing, is taken off on the left."""

    shape: str  # bending1 | bending2 | twist | inplane
    frequency_hz: float
    symmetric_rad: float
    antisymmetric_rad: float
    phase_rad: float


@dataclass(frozen=True)
class Gust:
    """A pulse that comes back every ``period_s``: (τ/rise)² / (1 + (τ/rise)²) · exp(−τ/decay) · sin(2π f τ)."""

    period_s: float = 7.0
    rise_s: float = 0.1
    decay_s: float = 0.6
    frequency_hz: float = 1.1
    bending_symmetric_rad: float = 0.075
    bending_antisymmetric_rad: float = 0.008
    bending2_rad: float = 0.004
    twist_rad: float = 0.02


def _default_sines() -> tuple[Sine, ...]:
    return (
        Sine("bending1", 0.09, 0.012, 0.004, 0.3),  # slow manoeuvre
        Sine("bending1", 0.23, 0.006, 0.010, 1.9),
        Sine("bending1", 0.9, 0.022, 0.003, 0.0),  # first bending, a few centimetres at the tip
        Sine("bending2", 3.1, 0.002, 0.001, 0.7),
        Sine("twist", 0.17, 0.012, 0.008, 2.4),
        Sine("twist", 1.4, 0.012, 0.004, 0.5),
        Sine("inplane", 0.21, 0.0008, 0.0003, 1.1),
        Sine("inplane", 1.7, 0.0003, 0.0001, 0.2),
    )


@dataclass(frozen=True)
class Motion:
    """The wing's angles in time: means, oscillations and a gust. Angles are those of the shapes in wing_motion."""

    bending_mean_rad: float = 0.19
    twist_mean_rad: float = 0.02
    inplane_mean_rad: float = -0.0030
    sines: tuple[Sine, ...] = field(default_factory=_default_sines)
    gust: Gust = Gust()


@dataclass(frozen=True)
class Board:
    """The checkerboard; flat, but printed with an error of its own at each corner (drawn once from the seed)."""

    columns: int = 10  # inner corners
    rows: int = 7
    square_m: float = 0.030
    margin_m: float = 0.030  # white
    print_sigma_m: float = 5e-5  # per corner and axis
    white_e: float = 6000.0
    black_e: float = 450.0
    poses: int = 15


@dataclass(frozen=True)
class Survey:
    """The surveyed lights that tie each pair to the body frame."""

    points: int = 12  # a side
    sigma_m: float = 3e-4  # per axis, of the coordinates in survey.toml
    frames: int = 8  # averaged into one image


@dataclass(frozen=True)
class World:
    """The simulated world."""

    seed: int
    epoch_ns: int  # UTC; the wing's motion is a function of the time since
    trigger_rate_hz: float
    wing: Wing
    leds: Leds
    sensor: Sensor
    scene: Scene
    mount: Mount
    mount_motion: MountMotion
    fuselage: Fuselage
    motion: Motion
    board: Board
    survey: Survey
    cameras: tuple[CameraTruth, ...]

    @classmethod
    def make(
        cls,
        seed: int = 1,
        scale: int = 1,
        background: str = "dark",
        finish: str = "matt",
        *,
        form: str = "disc",
        placement_sigma_m: float = 0.0,
        fuselage: Fuselage | None = None,
        mount_motion: MountMotion | None = None,
    ) -> Self:
        """The X-HALE world of ``seed``.

        Args:
            seed: everything random in this world follows from it.
            scale: divides the image's size and focal length; the lights grow with it so that they stay visible.
            background: ``dark`` or ``sunlit``.
            finish: of the wing, ``matt`` or ``clean``.
            form: of the wing's lights, ``disc`` or ``dome``.
            placement_sigma_m: by which they are off their places, each axis.
            fuselage: reference lights; None for none.
            mount_motion: of the camera pairs; None for none.

        Raises:
            UsageError: a value that is not offered.
        """
        if scale < 1 or 2080 % scale or 1552 % scale:
            raise UsageError(f"scale {scale}: it must divide the image of 2080 × 1552 (1, 2, 4, 8, 16)")
        sensor = Sensor(width_px=2080 // scale, height_px=1552 // scale, psf_sigma_px=0.9 if scale == 1 else 0.75)
        diameter_m = 0.004 if form == "dome" else 0.003  # at a low angle half of a dome is seen
        world = cls(
            seed=seed,
            epoch_ns=1_700_000_000_000_000_000,
            trigger_rate_hz=25.0,
            wing=Wing(),
            leds=Leds(diameter_m=diameter_m * (1 + 0.75 * (scale - 1)), form=form, placement_sigma_m=placement_sigma_m),
            sensor=sensor,
            scene=Scene(background=background, finish=finish),
            mount=Mount(),
            mount_motion=mount_motion or MountMotion(),
            fuselage=fuselage or Fuselage(),
            motion=Motion(),
            board=Board(),
            survey=Survey(),
            cameras=(),
        )
        rng = np.random.default_rng([seed, 0xCA])
        cameras = tuple(
            _make_camera(world, side, name, scale, rng) for side in ("left", "right") for name in ("cam0", "cam1")
        )
        return dataclasses.replace(world, cameras=cameras)._checked("the world's options")

    @classmethod
    def read(cls, path: Path) -> Self:
        """The world of a ``world.toml``.

        Raises:
            UsageError: the file is missing, is not TOML, or a key of it is unknown, missing or of the wrong type.
        """
        try:
            table = tomllib.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError as error:
            raise UsageError(f"{path}: no such file; make one with `wingsim world -o {path}`") from error
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
            raise UsageError(f"{path}: cannot be read as TOML ({error})") from error
        world: Self = _from_table(cls, table, str(path), "")
        return world._checked(str(path))

    def write(self, path: Path) -> None:
        """Write the world as TOML."""
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(_to_toml(self, "")) + "\n", encoding="utf-8")

    def camera(self, side: str, name: str) -> CameraTruth:
        """The camera of a side and a name; ``KeyError`` when there is none."""
        for camera in self.cameras:
            if (camera.side, camera.name) == (side, name):
                return camera
        raise KeyError(f"{side}_{name}")

    def fuselage_lights_m(self, side: str) -> NDArray[np.float64]:
        """(n, 3) places of a side's reference lights, body frame."""
        out = 1.0 if side == "right" else -1.0
        right: NDArray[np.float64] = np.array(self.fuselage.lights_m, dtype=np.float64).reshape(-1, 3)
        return np.asarray(right * np.array([1.0, out, 1.0]))

    def _checked(self, where: str) -> Self:
        if self.scene.background not in ("dark", "sunlit"):
            raise UsageError(f"{where}: background {self.scene.background!r} is unknown: use dark or sunlit")
        if self.scene.finish not in ("matt", "clean"):
            raise UsageError(f"{where}: finish {self.scene.finish!r} is unknown: use matt or clean")
        if self.leds.form not in ("disc", "dome"):
            raise UsageError(f"{where}: form {self.leds.form!r} of the lights is unknown: use disc or dome")
        if any(len(place) != 3 for place in self.fuselage.lights_m):
            raise UsageError(f"{where}: fuselage.lights_m: each light has x, y and z, in metres")
        for sine in self.motion.sines:
            if sine.shape not in ("bending1", "bending2", "twist", "inplane"):
                raise UsageError(f"{where}: shape {sine.shape!r} is unknown: use bending1, bending2, twist or inplane")
        return self


def nominal_pose(mount: Mount, side: str, name: str) -> NDArray[np.float64]:
    """``T_body_cam`` (4, 4) as drawn, before mounting errors: cam0 is the left one as the pair looks outboard."""
    out = 1.0 if side == "right" else -1.0
    pitch = math.radians(mount.pitch_deg)
    forward = np.array([0.0, out * math.cos(pitch), math.sin(pitch)])
    right = np.array([out, 0.0, 0.0])  # forward × up: aft on the right wing's pair, forward on the left wing's
    half = mount.baseline_m / 2 * (-1.0 if name == "cam0" else 1.0)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = np.array([mount.centre_x_m, -out * mount.across_m, mount.height_m]) + half * right
    return pose


def _make_camera(world: World, side: str, name: str, scale: int, rng: np.random.Generator) -> CameraTruth:
    pose = nominal_pose(world.mount, side, name)
    axis = rng.normal(0.0, math.radians(world.mount.angle_sigma_deg), 3)
    pose[:3, :3] = pose[:3, :3] @ rotation(axis)
    pose[:3, 3] += rng.normal(0.0, world.mount.position_sigma_m, 3)
    focal = 1400.0 * (1.0 + rng.normal(0.0, 0.005)) / scale
    centre = rng.normal(0.0, 8.0, 2) / scale
    return CameraTruth(
        side=side,
        name=name,
        model="FL3-U3-32S2M (simulated)",
        serial=f"SIM{world.seed % 10000:04d}-{side[0].upper()}{name[-1]}",
        fx=focal,
        fy=focal * (1.0 + rng.normal(0.0, 0.0005)),
        cx=(world.sensor.width_px - 1) / 2 + centre[0],
        cy=(world.sensor.height_px - 1) / 2 + centre[1],
        k1=-0.1 + rng.normal(0.0, 0.006),
        k2=0.02 + rng.normal(0.0, 0.002),
        p1=rng.normal(0.0, 3e-4),
        p2=rng.normal(0.0, 3e-4),
        k3=-0.002 + rng.normal(0.0, 3e-4),
        T_body_cam=tuple(tuple(float(value) for value in row) for row in pose),
        exposure_us=2000,
        gain_db=0.0,
        row_time_us=10.0,
        clock_drift_ppm=rng.normal(0.0, 20.0),
        clock_offset_ticks=int(rng.integers(0, 10**15)),
    )


def rotation(vector_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation matrix (3, 3) of a rotation vector (3,), by Rodrigues' formula."""
    angle = float(np.linalg.norm(vector_rad))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector_rad / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turned: NDArray[np.float64] = np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross
    return turned


def _to_toml(value: Any, name: str) -> list[str]:
    """Lines of a dataclass: its plain values first, then its tables, then its arrays of tables."""
    lines, tables = [], []
    for member in dataclasses.fields(value):
        item = getattr(value, member.name)
        inner = f"{name}.{member.name}" if name else member.name
        if dataclasses.is_dataclass(item):
            tables += ["", f"[{inner}]", *_to_toml(item, inner)]
        elif isinstance(item, tuple) and item and dataclasses.is_dataclass(item[0]):
            for entry in item:
                tables += ["", f"[[{inner}]]", *_to_toml(entry, inner)]
        else:
            lines.append(f"{member.name} = {_toml_value(item)}")
    return lines + tables


def _toml_value(item: Any) -> str:
    if isinstance(item, str):
        return '"' + item.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(item, (tuple, list)):
        return "[" + ", ".join(_toml_value(part) for part in item) + "]"
    if isinstance(item, (int, np.integer)):
        return str(int(item))
    return repr(float(item))


def _from_table(kind: Any, table: Any, where: str, place: str) -> Any:
    """A dataclass from a TOML table; every key must be there and known, so that a typing error cannot pass."""
    if not isinstance(table, dict):
        raise UsageError(f"{where}: {place or 'the file'} must be a table")
    hints = typing.get_type_hints(kind)
    members = [member.name for member in dataclasses.fields(kind)]
    prefix = f"{place}." if place else ""
    for key in table:
        if key not in members:
            raise UsageError(f"{where}: unknown key {prefix}{key}; known are {', '.join(members)}")
    for name in members:
        if name not in table:
            raise UsageError(f"{where}: key {prefix}{name} is missing; `wingsim world` writes a complete file")
    return kind(**{name: _value(hints[name], table[name], where, prefix + name) for name in members})


def _value(hint: Any, item: Any, where: str, place: str) -> Any:
    if dataclasses.is_dataclass(hint):
        return _from_table(hint, item, where, place)
    if isinstance(hint, types.GenericAlias):
        inner = typing.get_args(hint)[0]
        if not isinstance(item, list):
            raise UsageError(f"{where}: {place} must be a list")
        return tuple(_value(inner, part, where, place) for part in item)
    if hint is float and isinstance(item, (int, float)) and not isinstance(item, bool):
        return float(item)
    if isinstance(item, hint) and not isinstance(item, bool):
        return item
    raise UsageError(f"{where}: {place} must be of type {hint.__name__}, not {item!r}")
