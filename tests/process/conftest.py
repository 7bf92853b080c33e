"""Synthetic spots, rigs and recordings with known truth, made without the code under test."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray
from scipy.special import erf

from capture.record import SCHEMAS, Frame, frame_topic, image_prefix, image_topic
from process.camera_model import CameraModel, MarkerLayout, Rig, RigSide, StereoPair

Array = NDArray[np.float64]


class SpotPainter:
    """Renders blurred discs by brute force: the disc's points, each an integrated Gaussian over the pixels."""

    def __init__(self, height: int, width: int, seed: int = 1) -> None:
        self.clean = np.zeros((height, width))
        self.rng = np.random.default_rng(seed)

    def add(self, u: float, v: float, radius: float, blur: float, amplitude: float) -> None:
        """A disc of ``radius`` px (0: a point) blurred by ``blur`` px, ``amplitude`` the peak of the blurred disc."""
        if radius > 0:
            step = max(0.05, radius / 20)
            grid = np.arange(-radius, radius + step, step)
            x, y = (a.ravel() for a in np.meshgrid(grid, grid))
            inside = x**2 + y**2 <= radius**2
            points = np.stack([x[inside], y[inside]], axis=1)
            points -= points.mean(axis=0)
        else:
            points = np.zeros((1, 2))
        reach = int(np.ceil(radius + 6 * blur)) + 1
        columns = np.arange(round(u) - reach, round(u) + reach + 1)
        rows = np.arange(round(v) - reach, round(v) + reach + 1)
        light = (
            _integrated(rows[:, None] - v - points[:, 1], blur)
            @ _integrated(columns[:, None] - u - points[:, 0], blur).T
        )
        inside = np.ix_((rows >= 0) & (rows < len(self.clean)), (columns >= 0) & (columns < self.clean.shape[1]))
        place = np.ix_(rows[inside[0].ravel()], columns[inside[1].ravel()])
        self.clean[place] += light[inside] * (amplitude / light.max())

    def image(self, background: float = 8.0, read_sigma: float = 1.5, shot_gain: float = 0.04) -> NDArray[np.uint8]:
        """The picture with shot noise, read noise, quantisation and clipping."""
        light = self.clean + background
        noisy = light + self.rng.normal(size=light.shape) * np.sqrt(read_sigma**2 + shot_gain * self.clean)
        return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def _integrated(distance: NDArray[np.float64], blur: float) -> NDArray[np.float64]:
    """Gaussian of ``blur`` over a pixel of width 1 at ``distance``."""
    scale = np.sqrt(2) * blur
    return (erf((distance + 0.5) / scale) - erf((distance - 0.5) / scale)) / 2


@pytest.fixture
def painter() -> type[SpotPainter]:
    return SpotPainter


@dataclass(frozen=True)
class World:
    """A rig, and wings on circular arcs seen by it: closed-form truth, projected by OpenCV."""

    rig: Rig
    scale: int

    def markers_m(self, side: str, curvature_per_m: float, twist_rad: float = 0.0, sweep_m: float = 0.0) -> Array:
        """(18, 3) lights of a wing bent to a circle (arc length kept), twisted and swept in proportion to s²."""
        stations = np.repeat(self.rig.markers.pairs_station_m, 2)
        chord = np.tile(self.rig.markers.chord_m, len(stations) // 2)
        bend = curvature_per_m if abs(curvature_per_m) > 1e-6 else 1e-6
        angle = bend * stations
        twist = twist_rad * stations / stations[-1]
        y = np.sin(angle) / bend
        z = (1 - np.cos(angle)) / bend
        nose = chord * np.sin(twist) + self.rig.markers.height_m
        x = -chord * np.cos(twist) + sweep_m * (stations / stations[-1]) ** 2
        y, z = y - nose * np.sin(angle), z + nose * np.cos(angle)
        return np.stack([x, y if side == "right" else -y, z], axis=1)

    def project(self, side: str, points_m: Array) -> tuple[Array, Array]:
        """(N, 2) pixels of body points in cam0 and cam1."""
        rig_side = self.rig.side(side)
        in_cam0 = np.linalg.inv(rig_side.T_body_cam0)
        in_cam1 = rig_side.pair.T_cam1_cam0 @ in_cam0
        return tuple(  # type: ignore[return-value]
            cv2.projectPoints(points_m, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], camera.K, camera.distortion)[0].reshape(
                -1, 2
            )
            for T, camera in ((in_cam0, rig_side.pair.cam0), (in_cam1, rig_side.pair.cam1))
        )


def make_world(scale: int = 1) -> World:
    """X-HALE's proportions: cameras 279.4 mm apart, 80 mm up, 200 mm across the centre line, pitched 8° up."""
    layout = MarkerLayout((0.2, 0.5, 0.8, 1.2, 1.5, 1.8, 2.2, 2.5, 2.8), (0.04, -0.10), 0.004)
    sides = {}
    for name, out in (("left", -1.0), ("right", 1.0)):
        pitch = np.radians(8.0)
        forward = np.array([0.0, out * np.cos(pitch), np.sin(pitch)])
        right = np.array([out, 0.0, 0.0])
        T_body_cam0 = np.eye(4)
        T_body_cam0[:3, :3] = (
            np.column_stack([right, np.cross(forward, right), forward])
            @ cv2.Rodrigues(np.array([0.004, -0.006, 0.003]))[0]
        )
        T_body_cam0[:3, 3] = np.array([0.03, -out * 0.2, 0.08]) - 0.1397 * right
        T_cam1_cam0 = np.eye(4)
        T_cam1_cam0[:3, :3] = cv2.Rodrigues(np.array([0.003, 0.008, -0.005]))[0]
        T_cam1_cam0[:3, 3] = [-0.2794, 0.002, -0.001]
        cameras = [
            CameraModel(
                2080 // scale,
                1552 // scale,
                np.array([[f / scale, 0, 1040 / scale], [0, f / scale, 776 / scale], [0, 0, 1]]),
                np.array([-0.1, 0.02, 3e-4, -2e-4, -0.002]),
            )
            for f in (1400.0, 1408.0)
        ]
        pair = StereoPair(cameras[0], cameras[1], T_cam1_cam0)
        sides[name] = RigSide(pair, T_body_cam0, f"{name}-0", f"{name}-1", 10_000.0 * scale)
    return World(Rig(sides["left"], sides["right"], layout), scale)


@pytest.fixture(scope="session")
def world() -> World:
    return make_world()


@pytest.fixture(scope="session")
def small_world() -> World:
    return make_world(2)


class RecordingWriter:
    """Recordings by the stock ``mcap`` writer: independent of the recorder's own."""

    def __init__(self, path: Path, *, compression: CompressionType = CompressionType.NONE, chunk_size: int = 1) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("wb")
        # a chunk size of one byte closes the chunk after every message
        self.writer = Writer(self._file, compression=compression, chunk_size=chunk_size)
        self.writer.start(profile="ros2")
        self._channels: dict[str, int] = {}

    def add(self, topic: str, schema: str, data: bytes, sequence: int, time_ns: int) -> None:
        if topic not in self._channels:
            schema_id = self.writer.register_schema(schema, "ros2msg", SCHEMAS[schema].encode())
            self._channels[topic] = self.writer.register_channel(topic, "cdr", schema_id)
        self.writer.add_message(self._channels[topic], time_ns, data, time_ns, sequence)

    def frame(
        self, side: str, camera: str, trigger: int, image: NDArray[np.uint8], start_ns: int, *, meta: bool = True
    ) -> Frame:
        """An image and, unless it is another recorder's, what is known of it; exposed for 2 ms."""
        frame = Frame(trigger, trigger, 0, start_ns - 1000, start_ns, start_ns, 100, 2000, 10_000, 0, 0, 0.0, 0, 0)
        data = image_prefix(frame.mid_exposure_ns, camera, *image.shape) + image.tobytes()
        sequence = trigger if meta else 0
        self.add(image_topic(side, camera), "sensor_msgs/msg/Image", data, sequence, start_ns)
        if meta:
            self.add(frame_topic(side, camera), "wingshape_msgs/msg/Frame", frame.encode(), sequence, start_ns)
        return frame

    def close(self) -> None:
        self.writer.finish()
        self._file.close()

    def abandon(self) -> None:
        """As if the power had gone: no summary, no footer."""
        self._file.close()


@pytest.fixture
def recording_writer() -> type[RecordingWriter]:
    return RecordingWriter
