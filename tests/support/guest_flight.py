"""A flight recorded in a guest, on two disks of ours: what happens to them is decided from outside, by its clock."""

import itertools
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from forgetful_disk import ForgetfulDisk
from needs import needs_program
from vm import WINGCAP, WINGSIM, Vm

from hw_sim.world import World

RATE_HZ = 8
SCALE = 16  # of the image: 130×97
DISK_MB = 96
BOOT_S = 120.0
SIDES = ("left", "right")

CONFIG = f"""
flight = "cut"
[trigger]
port = "trigger"
rate_hz = {RATE_HZ}
[disks]
left = "/disks/left"
right = "/disks/right"
segment_s = 1.5
segment_mb = 10
reserve_mb = 1
[camera]
backend = "simulated"
width = 130
height = 97
""" + "".join(
    f'[[cameras]]\nside = "{side}"\nname = "{name}"\naddress = "rig.sock#{side}_{name}"\n'
    for side, name in itertools.product(SIDES, ("cam0", "cam1"))
)
SCRIPT = f"""
mkdir -p /disks/left /disks/right
mount /dev/vda /disks/left; mount /dev/vdb /disks/right
mkfifo never; bash -c 'exec 3<> never; while :; do echo $EPOCHREALTIME > /artifacts/clock; read -t 0.05 -u 3; done' &
cp /artifacts/wingcap.toml .
{WINGSIM} rig --world /artifacts/world.toml --socket rig.sock --trigger-port trigger > rig 2>&1 & rig=$!
until grep -q ready rig; do kill -0 $rig; sleep 0.1; done
{WINGCAP} record --config wingcap.toml
"""


@dataclass(frozen=True)
class GuestFlight:
    """A recorder at work in a guest."""

    vm: Vm
    disks: list[ForgetfulDisk]
    folder: Path
    begin_ns: int
    """of the guest's UTC: some frame has been recorded"""

    def wait(self, seconds: float) -> int:
        """Wait until so much time has passed in the guest since ``begin_ns``; its UTC nanoseconds."""
        return _wait(self.vm, self.begin_ns, seconds)


@contextmanager
def guest_flight(folder: Path, world: World) -> Iterator[GuestFlight]:
    """Boot and record; the guest is killed, and the disks are closed, at the end of the context."""
    artifacts = folder / "artifacts"
    artifacts.mkdir(parents=True)
    world.write(artifacts / "world.toml")
    (artifacts / "wingcap.toml").write_text(CONFIG)
    for side in SIDES:
        _make_disk(folder / f"{side}.img")
    disks = [ForgetfulDisk(folder / f"{side}.img", folder / f"{side}.sock") for side in SIDES]
    vm = Vm(SCRIPT, artifacts, ["virtio_blk", "ext4"], [disk.drive for disk in disks])
    try:
        vm.wait_for("recorded [1-9]", BOOT_S)
        yield GuestFlight(vm, disks, folder, _wait(vm, 0, 0.0))
    finally:
        vm.kill()
        for disk in disks:
            disk.close()


def _make_disk(image: Path) -> None:
    """An empty file system in a file."""
    with image.open("wb") as file:
        file.truncate(DISK_MB << 20)
    subprocess.run([needs_program("mkfs.ext4"), "-q", "-F", "-E", "lazy_itable_init=0", image], check=True)


def read_disk(image: Path, folder: Path) -> Path:
    """What a computer would find on it: the journal is replayed, then everything copied out."""
    checked = subprocess.run([needs_program("e2fsck"), "-f", "-y", image], capture_output=True, text=True)
    assert checked.returncode in (0, 1), checked.stdout  # 1: mended, as at every mount after a cut
    folder.mkdir()
    subprocess.run([needs_program("debugfs"), "-R", f"rdump /cut {folder}", image], check=True, capture_output=True)
    return folder / "cut"


def _wait(vm: Vm, since_ns: int, seconds: float) -> int:
    """Wait until so much time has passed in the guest; its UTC nanoseconds, which it has just written down."""
    clock, deadline_s = vm.artifacts / "clock", vm.spent_s + BOOT_S
    now_ns = 0
    while not now_ns or now_ns < since_ns + seconds * 1e9:
        assert vm.spent_s < deadline_s, "the guest's clock stands still"
        time.sleep(0.002)
        text = clock.read_text() if clock.exists() else ""
        if text.endswith("\n"):  # else it is just being written
            now_ns = int(text.replace(".", "")) * 1000
    return now_ns
