"""A shell script to what it does under a Debian kernel in QEMU, on this machine's own files.

The guest's root is ours, read-only over 9p with a tmpfs on top: what the script starts is this checkout in this
environment, and nothing it writes stays, except in the artifacts folder, which is shared. The kernel comes from
Debian's archive once, into ``~/.cache/wingshape``; it has what a container's host may lack: USB, V4L2, CAN, disks.

Emulated (no KVM), and its clock counts instructions: it is a machine of constant speed for whoever is in it, however
busy this one is. Assert counts and ids in it, and times by its own clock, never speed.
"""

import gzip
import lzma
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from needs import needs_program

CHECKOUT = Path(__file__).resolve().parents[2]
CACHE = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "wingshape"
START_UDEV = """
/lib/systemd/systemd-udevd --daemon
udevadm settle
echo 1000 > /sys/module/usbcore/parameters/usbfs_memory_mb
"""
WINGSIM = "python -c 'from hw_sim.cli import main; main()'"
WINGCAP = "python -c 'from capture.cli import main; main()'"
_BOOT_MODULES = ("virtio_pci", "9p", "9pnet_virtio", "overlay")
_ARTIFACTS = "/artifacts"

_INIT = """#!/bin/busybox sh
/bin/busybox --install -s /bin
export PATH=/bin
mount -t proc proc /proc; mount -t sysfs sysfs /sys; mount -t devtmpfs dev /dev
for module in $(cat /modules/order); do insmod /modules/$module; done
share="trans=virtio,version=9p2000.L,msize=512000"
mount -t 9p -o $share,ro,cache=loose root /host || poweroff -f
mount -t tmpfs -o size=70% tmpfs /over; mkdir /over/upper /over/work
mount -t overlay -o lowerdir=/host,upperdir=/over/upper,workdir=/over/work overlay /new
mkdir -p /new/artifacts; mount -t 9p -o $share,cache=none artifacts /new/artifacts
for folder in proc sys dev; do mkdir -p /new/$folder; mount --move /$folder /new/$folder; done
exec switch_root /new /bin/sh /artifacts/.start
"""

_START = """
export PATH={bin}:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin HOME=/root LANG=C.UTF-8
export PYTHONPATH={checkout}:{checkout}/tests/support PYTHONDONTWRITEBYTECODE=1 OPENBLAS_NUM_THREADS=1
mount -t tmpfs tmpfs /run; mkdir -p /dev/shm /dev/pts; mount -t tmpfs tmpfs /dev/shm; mount -t devpts devpts /dev/pts
mkdir -p /run/task; cd /run/task; ip link set lo up
mkdir -p /lib/modules/{release}; mount --bind {modules} /lib/modules/{release}
for module in {wanted}; do modprobe $module; done
sh -e {artifacts}/script > {artifacts}/output 2>&1
echo $? > {artifacts}/exit_code
sync
busybox poweroff -f
"""


@dataclass(frozen=True)
class Kernel:
    """A kernel image and its modules."""

    release: str  # as `uname -r` says it
    image: Path
    modules: Path  # the folder that the guest has at /lib/modules/<release>


@dataclass(frozen=True)
class VmRun:
    """What a script did."""

    exit_code: int | None  # None: it did not come to its end
    output: str
    console: str  # of the kernel
    artifacts: Path  # what the script wrote to /artifacts


class Vm:
    """A guest that is running. Kill it, or wait for its end; it ends with the process that made it."""

    def __init__(
        self,
        script: str,
        artifacts: Path,
        modules: Sequence[str] = (),
        drives: Sequence[str] = (),
        memory_mb: int = 3072,
    ) -> None:
        """Boot. ``modules`` are loaded before the script runs; ``drives`` are QEMU -drive options (/dev/vda, …)."""
        kernel = debian_kernel()
        artifacts.mkdir(parents=True, exist_ok=True)
        self.artifacts = artifacts
        (artifacts / "script").write_text(script)
        (artifacts / ".start").write_text(
            _START.format(
                bin=f"{sys.prefix}/bin",
                checkout=CHECKOUT,
                release=kernel.release,
                modules=kernel.modules,
                wanted=" ".join(modules),
                artifacts=_ARTIFACTS,
            )
        )
        initramfs = artifacts / ".initramfs"
        initramfs.write_bytes(_initramfs(kernel))
        self._console = artifacts / "console"
        command = [
            *(needs_program("qemu-system-x86_64"), "-M", "q35", "-accel", "tcg", "-cpu", "max"),
            *(
                "-icount",
                "shift=0",
                "-rtc",
                "clock=vm",
                "-m",
                str(memory_mb),
                "-nodefaults",
                "-no-reboot",
                "-display",
                "none",
                "-net",
                "none",
            ),
            *("-kernel", str(kernel.image), "-initrd", str(initramfs), "-serial", f"file:{self._console}"),
            *("-append", "console=ttyS0 quiet panic=-1 mitigations=off tsc=reliable no_timer_check"),
            *_share("root", Path("/"), ",readonly=on"),
            *_share("artifacts", artifacts, ""),
            *(word for drive in drives for word in ("-drive", f"if=virtio,{drive}")),
        ]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        self._begin_s, self._worked_s = time.monotonic(), 0.0

    @property
    def output(self) -> str:
        """What the script has said so far."""
        path = self.artifacts / "output"
        return path.read_text(errors="replace") if path.exists() else ""

    @property
    def spent_s(self) -> float:
        """What counts for time limits: the processor time that the guest had, but at least a tenth of the time since.

        A guest that other work leaves no processor is not late; one that sleeps for ever is found out in the end.
        """
        try:
            fields = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()
            self._worked_s = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
        except OSError:  # it has ended: what it had counts
            pass
        return max(self._worked_s, (time.monotonic() - self._begin_s) / 10)

    def wait_for(self, pattern: str, timeout_s: float) -> None:
        """Wait until the script has said what the regular expression ``pattern`` matches.

        Raises:
            TimeoutError: it did not, or ended before; the message has what it said.
        """
        deadline_s = self.spent_s + timeout_s
        while not re.search(pattern, self.output):
            if self.spent_s > deadline_s or self._process.poll() is not None:
                raise TimeoutError(f"the guest never said {pattern!r}:\n{self.output}\n{self._said()}")
            time.sleep(0.05)

    def kill(self) -> None:
        """Power cut. Safe to call twice."""
        self._process.send_signal(signal.SIGKILL)
        self._process.communicate()

    def wait(self, timeout_s: float) -> VmRun:
        """Wait for the guest's end; it is killed when it has spent ``timeout_s``."""
        while self._process.poll() is None:
            try:
                self._process.communicate(timeout=1.0)
            except subprocess.TimeoutExpired:
                if self.spent_s > timeout_s:
                    self.kill()
        code = self.artifacts / "exit_code"
        return VmRun(int(code.read_text()) if code.exists() else None, self.output, self._said(), self.artifacts)

    def _said(self) -> str:
        return self._console.read_text(errors="replace") if self._console.exists() else ""


def run_in_vm(script: str, artifacts: Path, modules: Sequence[str] = (), timeout_s: float = 120.0) -> VmRun:
    """Boot, run ``script`` with ``sh -e`` as root, power off.

    Raises:
        AssertionError: the script did not come to a good end; the message has all that was said.
    """
    vm = Vm(script, artifacts, modules)
    try:
        run = vm.wait(timeout_s)
    finally:
        vm.kill()
    said = f"the guest's script ended with {run.exit_code}:\n{run.output}\n{run.console[-3000:]}"
    assert run.exit_code == 0, said
    return run


def debian_kernel() -> Kernel:
    """The running Debian's standard kernel, fetched at the first call."""
    found = next(iter(sorted(CACHE.glob("linux-*/boot/vmlinuz-*"))), None)
    if found is None:
        found = _fetch_kernel()
    release = found.name.removeprefix("vmlinuz-")
    modules = next(path for path in found.parents[1].glob(f"**/lib/modules/{release}"))
    return Kernel(release, found, modules)


def _fetch_kernel() -> Path:
    for program in ("apt-get", "dpkg", "depmod", "busybox"):
        needs_program(program)
    depends = subprocess.run(
        ["apt-cache", "depends", "linux-image-amd64"], capture_output=True, text=True, check=True
    ).stdout
    package = next(line.split()[-1] for line in depends.splitlines() if line.strip().startswith("Depends:"))
    CACHE.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=CACHE) as scratch:
        subprocess.run(["apt-get", "-qq", "download", package], cwd=scratch, check=True, capture_output=True)
        tree = Path(scratch) / "tree"
        subprocess.run(["dpkg", "-x", next(Path(scratch).glob("*.deb")), tree], check=True)
        release = package.removeprefix("linux-image-")
        subprocess.run([needs_program("depmod"), "-b", tree, release], check=True)
        shutil.move(tree, CACHE / f"linux-{release}")
    return CACHE / f"linux-{release}" / "boot" / f"vmlinuz-{release}"


def _share(tag: str, folder: Path, options: str) -> tuple[str, ...]:
    backend = f"local,id={tag},path={folder},security_model=none,multidevs=remap{options}"
    return ("-fsdev", backend, "-device", f"virtio-9p-pci,fsdev={tag},mount_tag={tag}")


def _initramfs(kernel: Kernel) -> bytes:
    """A newc cpio archive: busybox, the modules that the root needs, and the first program."""
    modules = list(_with_dependencies(kernel.modules, _BOOT_MODULES))
    order = " ".join(path.name.removesuffix(".xz") for path in modules).encode()
    busybox = Path(needs_program("busybox")).read_bytes()
    entries = [
        *((folder, 0o040755, b"") for folder in ("bin", "dev", "proc", "sys", "host", "over", "new", "modules")),
        ("bin/busybox", 0o100755, busybox),
        ("init", 0o100755, _INIT.encode()),
        ("modules/order", 0o100644, order),
        *((f"modules/{path.name.removesuffix('.xz')}", 0o100644, _module(path)) for path in modules),
        ("TRAILER!!!", 0, b""),
    ]
    return gzip.compress(b"".join(_cpio_entry(*entry, number) for number, entry in enumerate(entries, 1)), 1)


def _with_dependencies(modules: Path, wanted: Sequence[str]) -> Iterator[Path]:
    """Module files in the order they must be loaded; those built into the kernel have none."""
    needs = {
        name: rest.split()
        for name, rest in (line.split(":", 1) for line in (modules / "modules.dep").read_text().splitlines())
    }
    files = {Path(name).name.split(".")[0].replace("-", "_"): name for name in needs}
    given: set[str] = set()
    for name in wanted:
        file = files.get(name)
        for path in [*reversed(needs[file]), file] if file else []:
            if path not in given:
                given.add(path)
                yield modules / path


def _module(path: Path) -> bytes:
    content = path.read_bytes()
    return lzma.decompress(content) if path.suffix == ".xz" else content


def _cpio_entry(name: str, mode: int, content: bytes, number: int) -> bytes:
    named = name.encode() + b"\0"
    fields = (number, mode, 0, 0, 1, 0, len(content), 0, 0, 0, 0, len(named), 0)
    head = b"070701" + b"".join(b"%08X" % field for field in fields) + named
    return head + bytes(-len(head) % 4) + content + bytes(-len(content) % 4)
