"""A rendered flight of any length, written by the recorder's own segment writer as fast as the frames can be drawn.

``python rendered_flight.py WORLD OUT SECONDS [--sunlit A:B]`` writes ``OUT/ssd_left``, ``…_right`` and ``OUT/truth``.
What it draws is what ``wingsim rig`` would have delivered; only the waiting is left out.
"""

import argparse
import multiprocessing
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from capture.disk import SystemDisk
from capture.record import SIDES, Frame
from capture.recorder import camera_channels
from capture.ring import Ring
from capture.segment import FrameLayout, SegmentWriter
from capture.trigger_protocol import Pulse
from hw_sim import optics
from hw_sim.render import LiveRenderer, Pixels, noise_frames
from hw_sim.truth import AROUND_NS, write_truth
from hw_sim.world import World
from process.camera_model import CameraModel, MarkerLayout, ReferenceLight, Rig, RigSide, StereoPair

SEGMENT_S = 10
CAMERAS = ("cam0", "cam1")
Stretch = tuple[float, float]  # from, to, seconds after the first trigger


def write_flight(world: World, folder: Path, seconds: float, sunlit: Stretch = (0.0, 0.0)) -> tuple[Path, Path]:
    """Write a flight, in the sun during ``sunlit``, and its truth; returns the folders of its two disks."""
    spawn = multiprocessing.get_context("spawn")
    folders = tuple(folder / f"ssd_{side}" for side in SIDES)
    for own in folders:
        own.mkdir(parents=True)
    with spawn.Pool(len(SIDES)) as pool:
        pool.starmap(
            _write_side, [(world, side, own, seconds, sunlit) for side, own in zip(SIDES, folders, strict=True)]
        )
    edges = [edge_ns(world, trigger) for trigger in range(_triggers(world, seconds))]
    pulses = [Pulse(index, index, edge, edge) for index, edge in enumerate(edges)]
    write_truth(world, edges[0] - AROUND_NS, edges[-1] + AROUND_NS, folder / "truth", pulses)
    return folders[0], folders[1]


def true_rig(world: World) -> Rig:
    """The rig file that a calibration without any error would give."""
    leds = world.leds
    layout = MarkerLayout(leds.pairs_station_m, leds.chord_m, leds.height_m)
    return Rig(true_side(world, "left"), true_side(world, "right"), layout)


def true_side(world: World, side: str) -> RigSide:
    """One side of it."""
    cam0, cam1 = (camera for camera in world.cameras if camera.side == side)
    poses = [np.array(camera.T_body_cam) for camera in (cam0, cam1)]
    models = [
        CameraModel.from_intrinsics(
            world.sensor.width_px,
            world.sensor.height_px,
            [one.fx, one.fy, one.cx, one.cy, one.k1, one.k2, one.p1, one.p2, one.k3],
        )
        for one in (cam0, cam1)
    ]
    pair = StereoPair(models[0], models[1], np.linalg.inv(poses[1]) @ poses[0])
    places = world.fuselage_lights_m(side)
    pixels = np.stack([optics.project(camera, places) for camera in (cam0, cam1)], axis=1)
    lights = tuple(
        ReferenceLight(f"F{number}", tuple(place), world.survey.sigma_m, tuple(map(tuple, seen)))
        for number, (place, seen) in enumerate(zip(places.tolist(), pixels.tolist(), strict=True))
    )
    return RigSide(pair, poses[0], cam0.serial, cam1.serial, cam0.row_time_us * 1e3, references=lights)


def _triggers(world: World, seconds: float) -> int:
    return round(seconds * world.trigger_rate_hz)


def edge_ns(world: World, trigger: int) -> int:
    """When a trigger comes, and row 0 of its frames opens."""
    return world.epoch_ns + round((trigger + 1) * 1e9 / world.trigger_rate_hz)


def _write_side(world: World, side: str, folder: Path, seconds: float, sunlit: Stretch) -> None:
    scenes = (world, replace(world, scene=replace(world.scene, background="sunlit")))
    artists: list[dict[str, LiveRenderer]] = []
    for scene in scenes:
        cameras = [camera for camera in world.cameras if camera.side == side]
        noise = noise_frames(scene, cameras[0].exposure_us, cameras[0].gain_db)
        artists.append({one.name: LiveRenderer(scene, one, noise, one.exposure_us, one.gain_db) for one in cameras})

    def draw(camera: str, trigger: int, pixels: Pixels) -> None:
        in_sun = sunlit[0] <= trigger / world.trigger_rate_hz < sunlit[1]
        artists[in_sun][camera].render(edge_ns(world, trigger), pixels)

    write_side(world, side, folder, range(_triggers(world, seconds)), draw)


def write_side(
    world: World, side: str, folder: Path, triggers: Sequence[int], draw: Callable[[str, int, Pixels], None]
) -> None:
    """Write one side's recording of these triggers; ``draw`` gets a camera, a trigger, and the pixels to fill."""
    cameras = [camera for camera in world.cameras if camera.side == side]
    width, height = world.sensor.width_px, world.sensor.height_px
    layouts = [FrameLayout(3 * at + 1, 3 * at + 2, f"{side}_{name}", width, height) for at, name in enumerate(CAMERAS)]
    ring = Ring(1, layouts[0].slot_bytes, lock_memory=False)
    slot = ring.slot(0)
    name = folder.parent.name
    provenance = {"side": side, "flight": name, "flight_id": f"{name}-{world.epoch_ns:x}"}
    writer = None
    for count, trigger in enumerate(triggers):
        if count % round(SEGMENT_S * world.trigger_rate_hz) == 0:
            if writer is not None:
                writer.close()
            path = folder / f"{side}_{count // round(SEGMENT_S * world.trigger_rate_hz):04d}.mcap"
            writer = SegmentWriter(SystemDisk(), path, camera_channels(CAMERAS, side), provenance)
        assert writer is not None
        for camera, layout in zip(cameras, layouts, strict=True):
            start_ns = edge_ns(world, trigger)
            draw(camera.name, trigger, np.frombuffer(layout.pixels(slot), np.uint8).reshape(height, width))
            row_time_ns = round(camera.row_time_us * 1000)
            frame = Frame(
                trigger, trigger, start_ns, start_ns, start_ns, start_ns + 25_000_000, 1000, camera.exposure_us,
                row_time_ns, 1, 1000, camera.gain_db, 9, 0,
            )  # fmt: skip
            middle_ns = frame.mid_exposure_ns + (height - 1) * row_time_ns // 2
            writer.write_frame(layout.seal(slot, frame, middle_ns))
    if writer is not None:
        writer.close()


def main() -> None:
    """Write a flight."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("world", type=Path)
    options.add_argument("out", type=Path)
    options.add_argument("seconds", type=float)
    options.add_argument("--sunlit", default="0:0")
    given = options.parse_args()
    begin, end = (float(part) for part in given.sunlit.split(":"))
    write_flight(World.read(given.world), given.out, given.seconds, (begin, end))


if __name__ == "__main__":
    main()
