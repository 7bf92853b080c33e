"""A container with the real systemd as PID 1, on a throw-away overlay of this machine's root file system.

What happens in it stays in memory; its network is private. wingshape is installed in it from a wheel of this checkout.
"""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import sysconfig
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

from needs import needs_program, needs_root

ROOT = Path(__file__).parents[2]
PREFIX = Path("/opt/wingshape")
_DEPENDENCIES = "/opt/wingshape-dependencies"
_PYTHON = Path("/opt/wingshape-python")  # wherever it lies here, perhaps in a home that services do not see
_TARGET = "wingshape-test.target"
_BOOT_DEADLINE_S = 40.0


class Machine:
    """A running container, or (before ``boot``) its root folder."""

    def __init__(self, root: Path, log: Path) -> None:
        self.root = root
        self._log = log
        self._nspawn: subprocess.Popen[bytes] | None = None
        self._leader = 0

    def boot(self) -> None:
        """Start it, up to its basic target."""
        command = [
            needs_program("systemd-nspawn"),
            *("--quiet", "--register=no", "--keep-unit", "--boot", f"--directory={self.root}", "--private-network"),
            "--capability=CAP_SYS_RESOURCE,CAP_IPC_LOCK",  # to raise the limits that a unit asks for, and lock memory
            *("--console=pipe", "--kill-signal=SIGRTMIN+3", f"--machine=wingshape-{os.getpid()}"),
            f"--bind-ro={sysconfig.get_path('purelib')}:{_DEPENDENCIES}",
            f"--bind-ro={sys.base_prefix}:{_PYTHON}",
            f"systemd.unit={_TARGET}",
        ]
        environment = {**os.environ, "SYSTEMD_NSPAWN_UNIFIED_HIERARCHY": "1"}
        with self._log.open("wb") as log:
            self._nspawn = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment)
        wait_for(
            lambda: self._find_leader() and self.run("systemctl", "is-active", _TARGET).returncode == 0,
            _BOOT_DEADLINE_S,
            lambda: self._log.read_text(errors="replace"),
        )
        self.ask("ldconfig")

    def run(self, *words: object, timeout: float = 60.0) -> subprocess.CompletedProcess[str]:
        """A command inside, as root."""
        command = ["nsenter", f"--target={self._leader}", "--all", "--wdns=/", *map(str, words)]
        return subprocess.run(command, capture_output=True, text=True, timeout=timeout)

    def ask(self, *words: object, timeout: float = 60.0) -> str:
        """Standard output of a command that must succeed."""
        done = self.run(*words, timeout=timeout)
        assert done.returncode == 0, f"{words}: {done.stdout}{done.stderr}"
        return done.stdout.strip()

    def show(self, unit: str, *properties: str) -> dict[str, str]:
        """Properties of a unit."""
        lines = self.ask("systemctl", "show", unit, "-p", ",".join(properties)).splitlines()
        return dict(line.split("=", 1) for line in lines)

    def journal(self, unit: str) -> list[dict[str, str]]:
        """The unit's entries."""
        lines = self.ask("journalctl", "--no-pager", "-o", "json", "-u", unit).splitlines()
        return [json.loads(line) for line in lines]

    def host_pid(self, unit: str) -> int:
        """The main process of a unit, as this machine numbers it."""
        inside = self.show(unit, "MainPID")["MainPID"]
        for status in Path("/proc").glob("[0-9]*/status"):
            with contextlib.suppress(OSError):
                words = status.read_text().split("NSpid:")[1].splitlines()[0].split()
                if len(words) > 1 and words[-1] == inside and self._is_inside(int(words[0])):
                    return int(words[0])
        raise AssertionError(f"{unit}: its main process {inside} is not to be found")

    def close(self) -> None:
        """End it at once; its files are in memory and go with it."""
        if self._nspawn is None:
            return
        if self._leader:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._leader, signal.SIGKILL)  # of PID 1: the kernel ends everything in there
        else:
            self._nspawn.kill()
        self._nspawn.wait(20)

    def _find_leader(self) -> bool:
        assert self._nspawn is not None
        assert self._nspawn.poll() is None, self._log.read_text(errors="replace")
        children = Path(f"/proc/{self._nspawn.pid}/task/{self._nspawn.pid}/children").read_text().split()
        for child in children:
            with contextlib.suppress(OSError):
                if Path(f"/proc/{child}/comm").read_text().strip() == "systemd":
                    self._leader = int(child)
        return self._leader != 0

    def _is_inside(self, pid: int) -> bool:
        return Path(f"/proc/{pid}/ns/pid").readlink() == Path(f"/proc/{self._leader}/ns/pid").readlink()


def wait_for(condition, deadline_s: float, explain=lambda: "") -> float:
    """Seconds until ``condition()`` was true; fails at the deadline with what ``explain()`` says."""
    began_s = time.monotonic()
    while not condition():
        assert time.monotonic() - began_s < deadline_s, f"not within {deadline_s:g} s: {explain()}"
        time.sleep(0.05)
    return time.monotonic() - began_s


@contextlib.contextmanager
def machine(scratch: Path, size: str = "3g") -> Iterator[Machine]:
    """A container's root folder with wingshape under ``PREFIX``, not booted yet. ``scratch`` is a new folder."""
    needs_root()
    needs_program("systemd-nspawn")
    wheel = build_wheel(scratch)
    layers = scratch / "layers"
    layers.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", layers], check=True)
    root = layers / "root"
    try:
        for name in ("upper", "work", "root"):
            (layers / name).mkdir()
        options = f"lowerdir=/,upperdir={layers / 'upper'},workdir={layers / 'work'}"
        subprocess.run(["mount", "-t", "overlay", "overlay", "-o", options, root], check=True)
        found = Machine(root, scratch / "nspawn.log")
        try:
            _furnish(root, wheel)
            yield found
        finally:
            found.close()
    finally:
        subprocess.run(["umount", root], check=False)
        subprocess.run(["umount", "--lazy", layers], check=True)


def build_wheel(scratch: Path) -> Path:
    """This checkout's wheel."""
    build = ["-m", "pip", "wheel", "--quiet", "--disable-pip-version-check", "--no-deps", f"--wheel-dir={scratch}"]
    subprocess.run([sys.executable, *build, ROOT], check=True, capture_output=True, timeout=300)
    return next(scratch.glob("*.whl"))


def _furnish(root: Path, wheel: Path) -> None:
    """A machine of its own name, a target to boot to, and wingshape beside this environment's dependencies."""
    (root / "etc/machine-id").write_text(uuid.uuid4().hex + "\n")
    (root / "etc/hostname").write_text("wingshape-test\n")
    target = "[Unit]\nRequires=basic.target\nWants=systemd-journald.service\nAfter=basic.target\nAllowIsolate=yes\n"
    (root / f"etc/systemd/system/{_TARGET}").write_text(target)
    (root / f"etc/systemd/system/{_TARGET}.wants").mkdir()
    prefix = root / PREFIX.relative_to("/")
    packages = prefix / f"lib/python{sys.version_info.major}.{sys.version_info.minor}/site-packages"
    packages.mkdir(parents=True)
    (prefix / "bin").mkdir()
    shutil.unpack_archive(wheel, packages, "zip")
    (packages / "dependencies.pth").write_text(_DEPENDENCIES + "\n")
    (prefix / "bin/python").symlink_to(_PYTHON / f"bin/python{sys.version_info.major}.{sys.version_info.minor}")
    (root / "etc/ld.so.conf.d/wingshape-python.conf").write_text(f"{_PYTHON}/lib\n")
    (prefix / "pyvenv.cfg").write_text(f"home = {_PYTHON}/bin\ninclude-system-site-packages = false\n")
    for command, package in (("wingcap", "capture"), ("wingproc", "process"), ("wingsim", "hw_sim")):
        script = prefix / "bin" / command
        script.write_text(f"#!{PREFIX}/bin/python\nfrom {package}.cli import main\n\nmain()\n")
        script.chmod(0o755)
