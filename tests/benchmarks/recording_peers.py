"""Throughput and CPU of ways to write frames to disk: ours, and peers, in turn, on the same disk, in one process each.

Run: ``python tests/benchmarks/recording_peers.py [FOLDER] [--rounds 5]``. Every writer writes the same frames (of
one camera, 2080×1552, mono8) and ends with its data on the disk (fsync). Memory is touched before. Quoted: medians.

    ours          as the recorder does it: one thread seals frames (CRC, records), one writes slots by O_DIRECT, indexed
    raw write     os.write to a plain file
    mcap          mcap.writer.Writer as it comes: 1 MB chunks, zstd off (frames do not compress), CRC on
    foxglove-sdk  chunks and CRC on, no compression
    gstreamer     fakesrc (which fills nothing) into filesink: bare bytes, no CRC, no index; where it is installed
"""

import argparse
import itertools
import json
import mmap
import os
import queue
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

WIDTH, HEIGHT = 2080, 1552
SIZE = WIDTH * HEIGHT
FRAMES = 300


def pixels() -> list[mmap.mmap]:
    """Eight different frames, touched."""
    frames = []
    for _ in range(8):
        area = mmap.mmap(-1, SIZE)
        area[:] = os.urandom(SIZE)
        frames.append(area)
    return frames


def ours(folder: Path) -> Callable[[], None]:
    from capture.disk import SystemDisk
    from capture.record import Frame
    from capture.recorder import PREALLOCATE_BYTES, camera_channels
    from capture.segment import FrameLayout, SealedFrame, SegmentWriter

    layout = FrameLayout(1, 2, "left_cam0", WIDTH, HEIGHT)
    slots = [memoryview(mmap.mmap(-1, layout.slot_bytes)) for _ in range(8)]
    for slot, frame in zip(slots, pixels(), strict=True):
        layout.pixels(slot)[:] = frame

    def run() -> None:
        sealed: queue.Queue[SealedFrame] = queue.Queue(6)  # of eight slots: one being sealed, one being written

        def seal() -> None:
            for index in range(FRAMES):
                frame = Frame(index, index, 0, index, index, index, -1, 2000, 10000, 0, 0, 0.0, 0, 0)
                sealed.put(layout.seal(slots[index % 8], frame, index))

        path, channels = folder / "left_0000.mcap", camera_channels(["cam0"], "left")
        writer = SegmentWriter(SystemDisk(), path, channels, {}, "auto", round(PREALLOCATE_BYTES))
        sealer = threading.Thread(target=seal)
        sealer.start()
        for _ in range(FRAMES):
            writer.write_frame(sealed.get())
        sealer.join()
        writer.close()

    return run


def raw_write(folder: Path) -> Callable[[], None]:
    frames = pixels()

    def run() -> None:
        file = os.open(folder / "raw", os.O_WRONLY | os.O_CREAT)
        for index in range(FRAMES):
            os.write(file, frames[index % 8])
        os.fsync(file)
        os.close(file)

    return run


def mcap_writer(folder: Path) -> Callable[[], None]:
    from mcap.writer import CompressionType, Writer

    frames = [bytes(frame) for frame in pixels()]

    def run() -> None:
        with (folder / "peer.mcap").open("wb") as file:
            writer = Writer(file, compression=CompressionType.NONE)
            writer.start()
            channel = writer.register_channel("/cam0", "cdr", writer.register_schema("x", "ros2msg", b"uint8[] data"))
            for index in range(FRAMES):
                writer.add_message(channel, index, frames[index % 8], index)
            writer.finish()
            file.flush()
            os.fsync(file.fileno())

    return run


def foxglove_sdk(folder: Path) -> Callable[[], None]:
    import foxglove
    from foxglove.mcap import MCAPWriteOptions

    frames = [bytes(frame) for frame in pixels()]

    def run() -> None:
        context = foxglove.Context()
        options = MCAPWriteOptions(compression=None, use_chunks=True, calculate_chunk_crcs=True)
        path = folder / "peer.mcap"
        writer = foxglove.open_mcap(path, allow_overwrite=True, context=context, writer_options=options)
        schema = foxglove.Schema(name="x", encoding="ros2msg", data=b"uint8[] data")
        channel = foxglove.Channel("/cam0", message_encoding="cdr", schema=schema, context=context)
        for index in range(FRAMES):
            channel.log(frames[index % 8], log_time=index)
        writer.close()
        descriptor = os.open(path, os.O_RDONLY)
        os.fsync(descriptor)
        os.close(descriptor)

    return run


def gstreamer(folder: Path) -> Callable[[], None]:
    source = f"fakesrc num-buffers={FRAMES} sizetype=fixed sizemax={SIZE} filltype=nothing"

    def run() -> None:
        pipeline = f"{source} ! filesink location={folder / 'gst'} buffer-mode=unbuffered o-sync=false".split()
        subprocess.run(["gst-launch-1.0", "-q", *pipeline], check=True)
        descriptor = os.open(folder / "gst", os.O_RDONLY)
        os.fsync(descriptor)
        os.close(descriptor)

    return run


WRITERS = {
    "ours": ours,
    "raw write": raw_write,
    "mcap": mcap_writer,
    "foxglove-sdk": foxglove_sdk,
    "gstreamer": gstreamer,
}


def child(name: str, parent: Path) -> None:
    """One measurement, in this process: MB/s and CPU seconds a GB, on standard output."""
    with tempfile.TemporaryDirectory(dir=parent) as folder:
        run = WRITERS[name](Path(folder))
        before = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
        begin = time.perf_counter()
        run()
        seconds = time.perf_counter() - begin
        after = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
        cpu = sum(a.ru_utime + a.ru_stime - b.ru_utime - b.ru_stime for a, b in zip(after, before, strict=True))
    print(json.dumps({"mb_s": FRAMES * SIZE / seconds / 1e6, "cpu_s_gb": cpu / (FRAMES * SIZE / 1e9)}))


def main() -> None:
    """Print the table."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("folder", nargs="?", type=Path, default=Path())
    arguments.add_argument("--rounds", type=int, default=5)
    arguments.add_argument("--child")
    given = arguments.parse_args()
    if given.child:
        child(given.child, given.folder)
        return
    names = [name for name in WRITERS if name != "gstreamer" or shutil.which("gst-launch-1.0")]
    found: dict[str, list[dict[str, float]]] = {name: [] for name in names}
    for _, name in itertools.product(range(given.rounds), names):
        command = [sys.executable, __file__, str(given.folder), "--child", name]
        found[name].append(json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout))
    print("| writer | MB/s | ours / it | CPU s a GB | it / ours |\n|---|---|---|---|---|")
    for name in names:
        rate, cpu = (statistics.median(one[key] for one in found[name]) for key in ("mb_s", "cpu_s_gb"))
        faster = statistics.median(a["mb_s"] / b["mb_s"] for a, b in zip(found["ours"], found[name], strict=True))
        leaner = statistics.median(
            b["cpu_s_gb"] / a["cpu_s_gb"] for a, b in zip(found["ours"], found[name], strict=True)
        )
        print(f"| {name} | {rate:.0f} | {faster:.2f} | {cpu:.2f} | {leaner:.2f} |")
    missing = set(WRITERS) - set(names)
    if missing:
        print(f"\nnot installed here: {', '.join(sorted(missing))}")


if __name__ == "__main__":
    main()
