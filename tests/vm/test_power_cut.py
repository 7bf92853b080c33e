"""A real power cut: QEMU killed while its guest records, on disks that forget what was not flushed.

``WINGSHAPE_CUTS`` of them (5 in CI), at moments that ``WINGSHAPE_SEED`` decides. In every other one an arbitrary part
of what was not flushed survives, as on real disks. What must come back is known from outside: the guest's clock at the
cut says how much may be missing, and each frame is drawn again from its trigger's time.
"""

import itertools
import os
import random
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from guest_flight import RATE_HZ, SCALE, SIDES, guest_flight, read_disk
from mcap.reader import make_reader

from capture.record import Frame, decode_image
from capture.recover import CAUSE, recover_flight
from capture.verify import CameraReport, inspect
from hw_sim.render import LiveRenderer, noise_frames
from hw_sim.world import World

pytestmark = pytest.mark.slow
CUTS = int(os.environ.get("WINGSHAPE_CUTS", "5"))
SEED = int(os.environ.get("WINGSHAPE_SEED", "11"))
MOST_LOST_S = 1.0
GUESTS = 2  # at once: each keeps one processor busy, and its clock does not mind


def cut(folder: Path, world: World, draw: random.Random, keep_some: bool) -> tuple[list[Path], int]:
    """Record in a guest and cut its power; the flight's folders as found, and when it was (the guest's UTC)."""
    with guest_flight(folder, world) as flight:
        cut_ns = flight.wait(draw.uniform(1.0, 4.0))
        for disk in flight.disks:
            disk.cut(draw if keep_some else None)
    assert all(disk.flushes for disk in flight.disks)
    return [read_disk(folder / f"{side}.img", folder / side) for side in SIDES], cut_ns


def check_pixels(folder: Path, world: World) -> int:
    """Every frame is the one that the rig drew at its trigger; how many there are."""
    noise: dict[tuple[int, float], list] = {}
    renderers: dict[str, LiveRenderer] = {}
    drawn = np.empty((world.sensor.height_px, world.sensor.width_px), np.uint8)
    frames: dict[tuple[str, int], Frame] = {}
    images: dict[tuple[str, int], np.ndarray] = {}
    for path in sorted(folder.glob("*/*.mcap")):
        with path.open("rb") as file:
            for _, channel, message in make_reader(file, validate_crcs=True).iter_messages():
                place = "_".join(channel.topic.split("/")[1:3])
                if channel.topic.endswith("/frame"):
                    frames[place, message.sequence] = Frame.decode(message.data)
                elif channel.topic.endswith("/image_raw"):
                    image = decode_image(message.data)
                    pixels = np.frombuffer(message.data, np.uint8)[image.pixels_at :][: image.pixels_size]
                    images[place, message.sequence] = pixels.reshape(image.height, image.width)
    assert frames.keys() == images.keys()
    for (place, index), frame in frames.items():
        if place not in renderers:
            camera = next(camera for camera in world.cameras if camera.key == place)
            key = (frame.exposure_us, frame.gain_db)
            noise.setdefault(key, noise_frames(world, *key))
            renderers[place] = LiveRenderer(world, camera, noise[key], *key)
        renderers[place].render(frame.trigger_time_ns, drawn)
        assert np.array_equal(drawn, images[place, index]), f"{place} trigger {index} shows something else"
    return len(frames)


def lost_before(camera: CameraReport, first_trigger_ns: int, cut_ns: int) -> float:
    """Seconds from the trigger of the first frame that did not survive to the cut; 0 when none was yet due."""
    assert not [loss for loss in camera.lost_indices.values() if loss.cause != CAUSE], "lost before the cut"
    missing = next(index for index in itertools.count() if index not in camera.indices)
    assert missing > max(camera.indices, default=-1), "a frame in the midst is missing"
    return max(0.0, (cut_ns - first_trigger_ns) / 1e9 - missing / RATE_HZ)


def check_cut(number: int, folder: Path, world: World) -> tuple[int, float]:
    """Cut, recover, hold against what was: frames that came back, and the longest time that is missing."""
    draw, said = random.Random(SEED * 1000 + number), f"cut {number}, seed {SEED}"
    folders, cut_ns = cut(folder, world, draw, keep_some=bool(number % 2))
    recover_flight(folders, folder / "recovered")
    report = inspect([folder / "recovered"])
    assert report.problems == [], said
    assert len(report.cameras) == 4, said
    frames = check_pixels(folder / "recovered", world)
    lost_s = max(lost_before(camera, report.first_trigger_ns, cut_ns) for camera in report.cameras.values())
    assert lost_s <= MOST_LOST_S, f"{said}: {lost_s:.2f} s are missing"
    return frames, lost_s


def test_a_power_cut_costs_less_than_a_second_and_nothing_reads_wrong(tmp_path, capsys):
    world = World.make(seed=SEED, scale=SCALE)
    with ThreadPoolExecutor(GUESTS) as guests:
        found = list(guests.map(lambda number: check_cut(number, tmp_path / str(number), world), range(CUTS)))
    frames, lost_s = sum(n for n, _ in found), max(s for _, s in found)
    with capsys.disabled():
        print(f"\n{CUTS} power cuts (seed {SEED}): {frames} frames came back, at most {lost_s:.2f} s were lost")
