"""A result's shapes and markers → an MCAP file with the wing in 3-D, for Foxglove beside the recording's own files.

Every set is a ``foxglove.SceneUpdate`` (JSON) on ``/wing/<side>`` at its common instant: the axis as a line, the
measured markers as balls, the unloaded wing as a thin line. Frame ``body``, metres.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer

from capture.errors import ReconstructError
from process.parts import PartStore
from reconstruct.stages import Key
from reconstruct.tables import MARKERS, SHAPE, UNLOADED, Floats, marker_series, shape_series

SCENE = "wing.mcap"
SCHEMA_NAME = "foxglove.SceneUpdate"
_NUMBER, _TEXT = {"type": "number"}, {"type": "string"}


def _object(**members: Any) -> dict[str, Any]:
    return {"type": "object", "properties": members}


def _list(of: Mapping[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": of}


_POINT = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER)
_COLOR = _object(r=_NUMBER, g=_NUMBER, b=_NUMBER, a=_NUMBER)
_POSE = _object(position=_POINT, orientation=_object(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER))
_TIME = _object(sec={"type": "integer"}, nsec={"type": "integer"})
_LINE = _object(
    type={"type": "integer"}, pose=_POSE, thickness=_NUMBER, scale_invariant={"type": "boolean"}, points=_list(_POINT),
    color=_COLOR, colors=_list(_COLOR), indices=_list({"type": "integer"}),
)  # fmt: skip
_BALL = _object(pose=_POSE, size=_POINT, color=_COLOR)
_ENTITY = _object(
    timestamp=_TIME, frame_id=_TEXT, id=_TEXT, lifetime=_TIME, frame_locked={"type": "boolean"},
    metadata=_list(_object(key=_TEXT, value=_TEXT)), arrows=_list({"type": "object"}), cubes=_list({"type": "object"}),
    spheres=_list(_BALL), cylinders=_list({"type": "object"}), lines=_list(_LINE), triangles=_list({"type": "object"}),
    texts=_list({"type": "object"}), models=_list({"type": "object"}),
)  # fmt: skip
SCENE_SCHEMA = {"title": SCHEMA_NAME, **_object(deletions=_list({"type": "object"}), entities=_list(_ENTITY))}
"""https://docs.foxglove.dev/docs/sdk/schemas/scene-update, as far as it is used"""

_STILL = {"position": {"x": 0, "y": 0, "z": 0}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}
_BALL_SIZE = {"x": 0.03, "y": 0.03, "z": 0.03}
_COLORS = {"left": {"r": 0.85, "g": 0.2, "b": 0.15, "a": 1}, "right": {"r": 0.1, "g": 0.6, "b": 0.25, "a": 1}}
_GREY = {"r": 0.6, "g": 0.6, "b": 0.6, "a": 0.6}
_YELLOW = {"r": 1, "g": 0.8, "b": 0, "a": 1}


def write_scene(store: PartStore, fitted: Sequence[Key], folder: Path, note: Mapping[str, Any]) -> Path:
    """Write ``wing.mcap`` into ``folder`` from the parts of a result, whole or not at all.

    Raises ReconstructError when it cannot be written.
    """
    path = folder / SCENE
    part = path.with_name(f"{SCENE}.part")
    try:
        with part.open("wb") as file:
            writer = Writer(file, compression=CompressionType.ZSTD)
            writer.start(profile="", library="wingshape")
            writer.add_metadata("wingshape", {key: json.dumps(value) for key, value in note.items()})
            schema = writer.register_schema(SCHEMA_NAME, "jsonschema", json.dumps(SCENE_SCHEMA).encode())
            channels = {
                side: writer.register_channel(f"/wing/{side}", "json", schema)
                for side in sorted({key.side for key in fitted})
            }
            for key in sorted(fitted, key=lambda key: (key.number, key.side)):  # in the order of time, nearly
                for time_ns, trigger, scene in _scenes(store, key):
                    data = json.dumps(scene, separators=(",", ":")).encode()
                    writer.add_message(channels[key.side], time_ns, data, time_ns, trigger & 0xFFFFFFFF)
            writer.finish()
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise ReconstructError(f"{path}: cannot be written ({error.strerror or error})") from error
    return path


def _scenes(store: PartStore, key: Key) -> list[tuple[int, int, dict[str, Any]]]:
    """Instant, trigger index and scene of each set of a block."""
    fits = store.read(key.fits).tables
    shape = shape_series(fits[SHAPE], key.fits)[key.side]
    markers = marker_series(store.read(key.markers).tables[MARKERS], key.markers)[key.side]
    rest = np.column_stack([fits[UNLOADED].column(name).to_numpy() for name in ("x_m", "y_m", "z_m")])
    grey = _line(rest, 0.005, _GREY)
    scenes = []
    for row in range(shape.trigger_index.size):
        time_ns = int(shape.timestamp_ns[row])
        fitted = np.isfinite(shape.xyz_m[row]).all()
        axis = [_line(shape.xyz_m[row], 0.02, _COLORS[key.side])] if fitted else []
        seen = markers.xyz_m[row][markers.seen[row]].round(5).tolist()
        entity = {
            "timestamp": {"sec": time_ns // 10**9, "nsec": time_ns % 10**9},
            "frame_id": "body",
            "id": key.side,
            "lifetime": {"sec": 0, "nsec": 0},
            "frame_locked": False,
            "lines": [*axis, grey],
            "spheres": [
                {"pose": {**_STILL, "position": {"x": x, "y": y, "z": z}}, "size": _BALL_SIZE, "color": _YELLOW}
                for x, y, z in seen
            ],
        }
        scenes.append((time_ns, int(shape.trigger_index[row]), {"deletions": [], "entities": [entity]}))
    return scenes


def _line(points_m: Floats, thickness_m: float, color: Mapping[str, float]) -> dict[str, Any]:
    return {
        "type": 0,  # a line strip
        "pose": _STILL,
        "thickness": thickness_m,
        "scale_invariant": False,
        "points": [{"x": x, "y": y, "z": z} for x, y, z in points_m.round(5).tolist()],
        "color": dict(color),
        "colors": [],
        "indices": [],
    }
