"""Camera models: points in front of the cameras to pixels and back, for one camera, a pair and the whole rig.

Lens: the Brown-Conrady polynomial in OpenCV's order k1, k2, p1, p2, k3 (the paper's eq. 2 read as mapping ideal to
distorted coordinates). Pixel (0, 0) is the centre of the top-left pixel, u right, v down.
"""

from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from process.json_file import read_json, write_json

Array = NDArray[np.float64]

PAIR_FORMAT = "wingshape pair"
RIG_FORMAT = "wingshape rig"
FORMAT_VERSION = 1

INTRINSIC_NAMES = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3")
PAIR_PARAMETER_NAMES = (
    *(f"cam0.{name}" for name in INTRINSIC_NAMES),
    *(f"cam1.{name}" for name in INTRINSIC_NAMES),
    *(f"T_cam1_cam0.{name}" for name in ("rx_rad", "ry_rad", "rz_rad", "tx_m", "ty_m", "tz_m")),
)


@dataclass(frozen=True, eq=False)
class CameraModel:
    """A pinhole camera with a distorting lens (the paper's eqs. 1 and 2).

    ``K`` (3, 3) in pixels, without skew; ``distortion`` (5,) = k1, k2, p1, p2, k3.
    """

    width: int
    height: int
    K: Array
    distortion: Array

    def __post_init__(self) -> None:
        _freeze(self, "K", self.K, (3, 3))
        _freeze(self, "distortion", self.distortion, (5,))
        if self.K[0, 1] != 0.0 or not (self.K[0, 0] > 0.0 and self.K[1, 1] > 0.0):
            raise ValueError(f"K must have positive focal lengths and no skew, got {self.K.tolist()}")

    def project(self, points_cam: ArrayLike) -> Array:
        """Pixels (N, 2) of ``points_cam`` (N, 3), metres in the camera's frame.

        NaN where a point is not in front of the camera, or so far off axis that the lens polynomial has folded back.
        """
        return self.project_with_jacobian(points_cam)[0]

    def project_with_jacobian(self, points_cam: ArrayLike) -> tuple[Array, Array]:
        """Pixels (N, 2), and their derivatives (N, 2, 3) by the points, pixels per metre."""
        points = np.asarray(points_cam, np.float64).reshape(-1, 3)
        depth = np.where(points[:, 2] > 0.0, points[:, 2], np.nan)
        ideal = points[:, :2] / depth[:, None]
        ideal[np.sum(ideal**2, axis=1) >= self.fold_radius**2] = np.nan
        distorted, by_ideal = distort(ideal, self.distortion)
        by_point = np.zeros((len(points), 2, 3))
        by_point[:, 0, 0] = by_point[:, 1, 1] = 1.0 / depth
        by_point[:, :, 2] = -ideal / depth[:, None]
        return distorted * self._focal + self._centre, self._focal[:, None] * (by_ideal @ by_point)

    def undistort(self, pixels: ArrayLike) -> Array:
        """Ideal normalised coordinates (N, 2) = (X/Z, Y/Z) that project to ``pixels`` (N, 2).

        Newton's iteration on eq. 2 until the residual is below 1e-12; NaN where it does not get there, or only on
        the far side of the polynomial's fold.
        """
        distorted = (np.asarray(pixels, np.float64).reshape(-1, 2) - self._centre) / self._focal
        ideal = distorted.copy()
        radius = np.hypot(ideal[:, 0], ideal[:, 1])
        beyond = radius > 0.9 * self.fold_radius
        ideal[beyond] *= (0.9 * self.fold_radius / radius[beyond])[:, None]
        with np.errstate(all="ignore"):  # a diverging pixel may overflow before it is rejected
            for _ in range(50):
                reached, slope = distort(ideal, self.distortion)
                error = reached - distorted
                if not np.any(np.abs(error) > 1e-13):
                    break
                ideal -= _solve_2x2(slope, error)
            error = np.abs(distort(ideal, self.distortion)[0] - distorted).max(axis=1)
            good = (error < 1e-12) & (np.sum(ideal**2, axis=1) < self.fold_radius**2)
        ideal[~good] = np.nan
        return ideal

    @cached_property
    def fold_radius(self) -> float:
        """Normalised radius where the radial polynomial stops growing; infinite if it never does."""
        k1, k2, _, _, k3 = self.distortion
        roots = np.roots(np.trim_zeros(np.array([7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0]), "f"))
        real = roots[np.abs(roots.imag) < 1e-9 * np.maximum(1.0, np.abs(roots))].real
        positive = real[real > 0.0]
        return float(np.sqrt(positive.min())) if positive.size else float("inf")

    @property
    def intrinsics(self) -> Array:
        """(9,) in the order of ``INTRINSIC_NAMES``."""
        return np.concatenate([self._focal, self._centre, self.distortion])

    @classmethod
    def from_intrinsics(cls, width: int, height: int, intrinsics: ArrayLike) -> Self:
        """Inverse of ``intrinsics``."""
        fx, fy, cx, cy, *distortion = np.asarray(intrinsics, np.float64)
        return cls(width, height, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), np.array(distortion))

    @property
    def _focal(self) -> Array:
        return np.array([self.K[0, 0], self.K[1, 1]])

    @property
    def _centre(self) -> Array:
        return self.K[:2, 2].copy()

    def to_dict(self) -> dict[str, Any]:
        return {
            "width": self.width,
            "height": self.height,
            "K": self.K.tolist(),
            "distortion": self.distortion.tolist(),
        }

    @classmethod
    def from_dict(cls, value: dict[str, Any]) -> Self:
        return cls(int(value["width"]), int(value["height"]), value["K"], value["distortion"])


@dataclass(frozen=True, eq=False)
class Rectification:
    """Bouguet's rectification: rotations into the common frame, new projections (3, 4), and Q of eq. 4 (4, 4)."""

    R0: Array
    R1: Array
    P0: Array
    P1: Array
    Q: Array


@dataclass(frozen=True, eq=False)
class StereoPair:
    """Two cameras and the pose between them.

    ``T_cam1_cam0`` (4, 4), metres, maps coordinates of cam0 into cam1; its x translation is negative, since cam1 is
    to the right of cam0. ``covariance`` (24, 24) of the parameters ``PAIR_PARAMETER_NAMES``, where the rotation is a
    rotation vector; None if the calibration did not estimate it.
    """

    cam0: CameraModel
    cam1: CameraModel
    T_cam1_cam0: Array
    covariance: Array | None = None

    def __post_init__(self) -> None:
        _freeze(self, "T_cam1_cam0", self.T_cam1_cam0, (4, 4))
        _check_pose("T_cam1_cam0", self.T_cam1_cam0)
        if self.covariance is not None:
            _freeze(self, "covariance", self.covariance, (24, 24))

    @property
    def baseline_m(self) -> float:
        """Distance between the cameras' centres."""
        return float(np.linalg.norm(self.T_cam1_cam0[:3, 3]))

    @property
    def parameters(self) -> Array:
        """(24,) in the order of ``PAIR_PARAMETER_NAMES``."""
        rotation = cv2.Rodrigues(self.T_cam1_cam0[:3, :3])[0].reshape(3)
        return np.concatenate([self.cam0.intrinsics, self.cam1.intrinsics, rotation, self.T_cam1_cam0[:3, 3]])

    @property
    def middle_axes(self) -> Array:
        """(3, 3) axes half way between cam0's and cam1's, in cam0's frame: of a board that faces the pair."""
        return pose_matrix(-0.5 * self.parameters[18:21], np.zeros(3))[:3, :3]

    def middle_of_view(self, depth_m: float) -> Array:
        """(3,) cam0's frame: half way between where the rays of both images' middles are at ``depth_m``."""
        R, t = self.T_cam1_cam0[:3, :3], self.T_cam1_cam0[:3, 3]
        ray0, ray1 = (
            np.append(own.undistort([(own.width - 1) / 2, (own.height - 1) / 2])[0], 1.0)
            for own in (self.cam0, self.cam1)
        )
        centre1, ray1 = -R.T @ t, R.T @ ray1
        at_depth1 = centre1 + ray1 * (depth_m - centre1[2]) / ray1[2]
        return np.asarray(0.5 * (ray0 * depth_m + at_depth1))

    def with_parameters(self, parameters: ArrayLike) -> "StereoPair":
        """The pair with other values of ``parameters``: what the propagation of its covariance needs."""
        values = np.asarray(parameters, np.float64)
        return StereoPair(
            CameraModel.from_intrinsics(self.cam0.width, self.cam0.height, values[:9]),
            CameraModel.from_intrinsics(self.cam1.width, self.cam1.height, values[9:18]),
            pose_matrix(values[18:21], values[21:24]),
            self.covariance,
        )

    @cached_property
    def rectification(self) -> Rectification:
        """Bouguet's rectification and the Q of the paper's eq. 4 (errata: its last row has −1/T_x)."""
        R0, R1, P0, P1, Q, *_ = cv2.stereoRectify(
            self.cam0.K,
            self.cam0.distortion,
            self.cam1.K,
            self.cam1.distortion,
            (self.cam0.width, self.cam0.height),
            self.T_cam1_cam0[:3, :3],
            self.T_cam1_cam0[:3, 3].reshape(3, 1),
            flags=0,  # not CALIB_ZERO_DISPARITY: eq. 4 keeps the two principal points apart
            alpha=-1,
        )
        return Rectification(R0, R1, P0, P1, Q)

    def to_dict(self) -> dict[str, Any]:
        rectification = self.rectification
        return {
            "cameras": [self.cam0.to_dict(), self.cam1.to_dict()],
            "stereo": {"T_cam1_cam0": self.T_cam1_cam0.tolist(), "baseline_m": self.baseline_m},
            "covariance": None
            if self.covariance is None
            else {"parameters": list(PAIR_PARAMETER_NAMES), "matrix": self.covariance.tolist()},
            "rectification": {name: getattr(rectification, name).tolist() for name in ("R0", "R1", "P0", "P1", "Q")},
        }

    @classmethod
    def from_dict(cls, value: dict[str, Any]) -> Self:
        """Inverse of ``to_dict``; the rectification, written for other programs, is computed afresh."""
        cam0, cam1 = (CameraModel.from_dict(camera) for camera in value["cameras"])
        covariance = value.get("covariance")
        return cls(cam0, cam1, value["stereo"]["T_cam1_cam0"], covariance and covariance["matrix"])


@dataclass(frozen=True)
class Light:
    """The bulb of a marker: see ``bulb``. Zeros: a point whose centre is on the surface."""

    standoff_m: float = 0.0
    """of the light's centre, above the surface that it is fixed to"""
    standoff_sigma_m: float = 0.0
    dome_radius_m: float = 0.0
    """of its round top; 0: flat"""
    dome_sigma_m: float = 0.0


@dataclass(frozen=True)
class MarkerLayout:
    """Where the markers sit on each wing: a fore and an aft light at each station of the reference axis.

    Marker numbers are 2 · pair + (0 fore, 1 aft), pair 0 innermost.
    """

    pairs_station_m: tuple[float, ...]
    """arc length of each pair from the root"""
    chord_m: tuple[float, float]
    """offset of the fore and the aft light, positive forward of the axis"""
    height_m: float
    """offset of the light's centre above the axis, along the section's e3"""
    light: Light = field(default_factory=Light)

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_dict(cls, value: dict[str, Any]) -> Self:
        fore_m, aft_m = (float(offset) for offset in value["chord_m"])
        return cls(
            tuple(float(station) for station in value["pairs_station_m"]),
            (fore_m, aft_m),
            float(value["height_m"]),
            Light(**value.get("light", {})),
        )


@dataclass(frozen=True)
class ReferenceLight:
    """A light on the fuselage, seen in flight too: it tells whether the cameras stay where they are."""

    name: str
    xyz_m: tuple[float, float, float]
    """surveyed, body frame"""
    sigma_m: float
    """of each coordinate"""
    survey_px: tuple[tuple[float, float], tuple[float, float]] | None = None
    """where cam0 and cam1 saw it in the survey's pictures: motion since is counted from there; None if not known"""


@dataclass(frozen=True, eq=False)
class RigSide:
    """One wing's camera pair as mounted.

    ``T_body_cam0`` (4, 4), metres. ``pose_covariance`` (6, 6) is of a small rotation ω (rad, R = exp(ω) R̂) and
    shift of the translation (m), both in body axes; None if unknown. ``pose_by_calibration`` (6, 24) is how the fitted
    pose moves with the pair's parameters; None is taken for not at all.
    """

    pair: StereoPair
    T_body_cam0: Array
    cam0_serial: str
    cam1_serial: str
    row_time_ns: float
    pose_covariance: Array | None = None
    pose_by_calibration: Array | None = None
    references: tuple[ReferenceLight, ...] = ()

    def __post_init__(self) -> None:
        _freeze(self, "T_body_cam0", self.T_body_cam0, (4, 4))
        _check_pose("T_body_cam0", self.T_body_cam0)
        if self.pose_covariance is not None:
            _freeze(self, "pose_covariance", self.pose_covariance, (6, 6))
        if self.pose_by_calibration is not None:
            _freeze(self, "pose_by_calibration", self.pose_by_calibration, (6, 24))

    def to_dict(self) -> dict[str, Any]:
        return {
            "T_body_cam0": self.T_body_cam0.tolist(),
            "pose_covariance": None if self.pose_covariance is None else self.pose_covariance.tolist(),
            "pose_by_calibration": None if self.pose_by_calibration is None else self.pose_by_calibration.tolist(),
            "cam0_serial": self.cam0_serial,
            "cam1_serial": self.cam1_serial,
            "row_time_ns": self.row_time_ns,
            "references": [asdict(light) for light in self.references],
            "pair": self.pair.to_dict(),
        }

    @classmethod
    def from_dict(cls, value: dict[str, Any]) -> Self:
        return cls(
            StereoPair.from_dict(value["pair"]),
            value["T_body_cam0"],
            str(value["cam0_serial"]),
            str(value["cam1_serial"]),
            float(value["row_time_ns"]),
            value["pose_covariance"],
            value.get("pose_by_calibration"),
            tuple(
                ReferenceLight(
                    str(light["name"]), tuple(light["xyz_m"]), float(light["sigma_m"]), _pixels(light.get("survey_px"))
                )
                for light in value.get("references", [])
            ),
        )


@dataclass(frozen=True, eq=False)
class Rig:
    """Both sides' cameras in the body frame, and the markers they look at."""

    left: RigSide
    right: RigSide
    markers: MarkerLayout
    provenance: dict[str, Any] = field(default_factory=dict)
    """how the file was made: command, versions, hashes of the inputs"""

    def side(self, name: str) -> RigSide:
        """``left`` or ``right``; KeyError for another name."""
        return {"left": self.left, "right": self.right}[name]

    def write(self, path: Path | str, **report: Any) -> None:
        """Write rig.json; ``report`` holds further top-level entries, such as residuals."""
        write_json(
            path,
            {
                "format": RIG_FORMAT,
                "version": FORMAT_VERSION,
                "provenance": self.provenance,
                "markers": self.markers.to_dict(),
                "left": self.left.to_dict(),
                "right": self.right.to_dict(),
                **report,
            },
        )

    @classmethod
    def read(cls, path: Path | str) -> "Rig":
        """Read rig.json; ProcessError naming the file and the remedy if it cannot be used."""

        def build(value: dict[str, Any]) -> "Rig":
            left, right = (RigSide.from_dict(value[side]) for side in ("left", "right"))
            return cls(left, right, MarkerLayout.from_dict(value["markers"]), value.get("provenance", {}))

        return read_json(path, RIG_FORMAT, FORMAT_VERSION, build, remedy="make it with `wingproc rig`")


def read_pair(path: Path | str) -> StereoPair:
    """Read pair.json; ProcessError naming the file and the remedy if it cannot be used."""
    return read_json(
        path, PAIR_FORMAT, FORMAT_VERSION, StereoPair.from_dict, remedy="make it with `wingproc calibrate`"
    )


def write_pair(
    path: Path | str,
    pair: StereoPair,
    *,
    camera_rms_px: tuple[float, float],
    stereo_rms_px: float,
    provenance: dict[str, Any],
    **report: Any,
) -> None:
    """Write pair.json; ``report`` holds further top-level entries, such as the views rejected."""
    value = pair.to_dict()
    for camera, rms_px in zip(value["cameras"], camera_rms_px, strict=True):
        camera["rms_px"] = rms_px
    value["stereo"]["rms_px"] = stereo_rms_px
    write_json(path, {"format": PAIR_FORMAT, "version": FORMAT_VERSION, "provenance": provenance, **value, **report})


def distort(ideal: Array, distortion: Array) -> tuple[Array, Array]:
    """Eq. 2: distorted normalised coordinates (N, 2) of ``ideal`` (N, 2), and their derivatives (N, 2, 2) by it."""
    k1, k2, p1, p2, k3 = distortion
    x, y = ideal[:, 0], ideal[:, 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    growth = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3)  # of radial, by r²
    distorted = np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=1,
    )
    slope = np.empty((len(ideal), 2, 2))
    slope[:, 0, 0] = radial + 2.0 * x * x * growth + 2.0 * p1 * y + 6.0 * p2 * x
    slope[:, 1, 1] = radial + 2.0 * y * y * growth + 6.0 * p1 * y + 2.0 * p2 * x
    slope[:, 0, 1] = slope[:, 1, 0] = 2.0 * (x * y * growth + p1 * x + p2 * y)
    return distorted, slope


def pose_matrix(rotation_rad: ArrayLike, translation: ArrayLike) -> Array:
    """Pose (4, 4) of a rotation vector (3,) and a translation (3,)."""
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(np.asarray(rotation_rad, np.float64).reshape(3, 1))[0]
    T[:3, 3] = np.asarray(translation, np.float64).reshape(3)
    return T


def _solve_2x2(matrix: Array, right: Array) -> Array:
    """Solve N systems of two equations; infinite where singular (numpy's solver would raise for all of them)."""
    a, b, c, d = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 0], matrix[:, 1, 1]
    solution = np.stack([d * right[:, 0] - b * right[:, 1], a * right[:, 1] - c * right[:, 0]], axis=1)
    return np.asarray(solution / (a * d - b * c)[:, None])


def _pixels(value: list[list[float]] | None) -> tuple[tuple[float, float], tuple[float, float]] | None:
    if value is None:
        return None
    (u0, v0), (u1, v1) = value
    return (float(u0), float(v0)), (float(u1), float(v1))


def _freeze(owner: object, name: str, value: ArrayLike, shape: tuple[int, ...]) -> None:
    array = np.array(value, np.float64)
    if array.shape != shape or not np.all(np.isfinite(array)):
        raise ValueError(f"{name} must be finite numbers of shape {shape}")
    array.setflags(write=False)
    object.__setattr__(owner, name, array)


def _check_pose(name: str, T: Array) -> None:
    R = T[:3, :3]
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-6) or np.linalg.det(R) < 0.0 or T[3].tolist() != [0, 0, 0, 1]:
        raise ValueError(f"{name} is not a rotation and a translation")
