"""The package's systemd files to a computer, or an image of one: units, users, rules, a configuration to start from.

What was put in place is remembered by checksum in ``RECORD``. A file that somebody has edited since is never written
over and never removed; ours then goes beside it, as ``<name>.new``.
"""

import hashlib
import importlib.resources
import json
import os
import secrets
import subprocess
import sysconfig
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from capture.errors import CaptureError, UsageError

RECORD = "etc/wingshape/.installed.json"
TOKEN = "etc/wingshape/monitor.token"
SERVICES = ("mnt-ssd_left.mount", "mnt-ssd_right.mount", "wingcap.service", "wingcap-monitor.service")
"""What ``--enable`` starts at every boot."""
PTP_SERVICES = ("wingshape-ptp4l.service", "wingshape-phc2sys.service")
"""Enabled by hand where the computer follows a PTP master."""
_UNITS = "etc/systemd/system"
FILES = (  # of capture/systemd, where they go, and their mode
    *((unit, f"{_UNITS}/{unit}", 0o644) for unit in (*SERVICES, *PTP_SERVICES)),
    ("disk-wait.conf", rf"{_UNITS}/dev-disk-by\x2dlabel-wing_left.device.d/wingshape.conf", 0o644),
    ("disk-wait.conf", rf"{_UNITS}/dev-disk-by\x2dlabel-wing_right.device.d/wingshape.conf", 0o644),
    ("wingshape.sysusers", "etc/sysusers.d/wingshape.conf", 0o644),
    ("wingshape.tmpfiles", "etc/tmpfiles.d/wingshape.conf", 0o644),
    ("wingshape.sysctl", "etc/sysctl.d/70-wingshape.conf", 0o644),
    ("wingshape.modprobe", "etc/modprobe.d/wingshape.conf", 0o644),
    ("70-wingshape.rules", "etc/udev/rules.d/70-wingshape.rules", 0o644),
    ("wingcap.toml", "etc/wingshape/wingcap.toml", 0o644),
    ("monitor.env", "etc/wingshape/monitor.env", 0o644),
    ("ptp4l.conf", "etc/wingshape/ptp4l.conf", 0o644),
    ("ptp.env", "etc/wingshape/ptp.env", 0o644),
)
_HIDDEN_FROM_SERVICES = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")  # by ProtectHome and PrivateTmp
_COMMAND_TIMEOUT_S = 60.0


@dataclass(frozen=True)
class Action:
    """One thing that was done, or would be."""

    what: str  # installed, updated, unchanged, kept, removed, ran, failed
    target: str  # a file, or a command
    remark: str = ""

    def __str__(self) -> str:
        return f"{self.what:<9} {self.target}" + (f" ({self.remark})" if self.remark else "")


def install(root: Path, programs: Path, enable: bool, dry_run: bool) -> list[Action]:
    """Put everything in place below ``root``; a second time changes nothing.

    Args:
        root: ``/``, where the running system is told too; or an image's folder, which is only written.
        programs: the folder of ``wingcap`` and ``wingproc``, as seen from within ``root``.
        enable: start the services at every boot.
        dry_run: only say what would be done.

    Raises:
        UsageError: the programs are not there, or where services cannot see them.
        CaptureError: a command that is needed fails.
    """
    _check_root(root, dry_run)
    _check_programs(root, programs)
    recorded = _read_record(root)
    actions = []
    for source, target, mode in FILES:
        content = _content(source, programs)
        action = _put(root, target, content, mode, recorded.get(target), dry_run)
        if action.what != "kept":
            recorded[target] = _sha256(content)
        actions.append(action)
    actions.append(_put_token(root, dry_run))
    if not dry_run:
        _write(root / RECORD, json.dumps(recorded, indent=1).encode(), 0o644)
    actions += [_run(command, needed, dry_run) for command, needed in _commands(root)]
    if enable:
        actions.append(_run([*_systemctl(root), "enable", *SERVICES], True, dry_run))
    return actions


def uninstall(root: Path, dry_run: bool) -> list[Action]:
    """Take away what ``install`` has put below ``root``, but for what was edited. Recordings and users stay.

    Raises:
        UsageError: not permitted.
        CaptureError: a service cannot be stopped.
    """
    _check_root(root, dry_run)
    recorded = _read_record(root)
    units = [unit for unit in (*SERVICES, *PTP_SERVICES) if (root / _UNITS / unit).exists()]
    actions = []
    if units:
        stop = ["--now"] if _live(root) else []
        services = [unit for unit in units if unit.endswith(".service")]  # a mounted disk stays mounted
        actions.append(_run([*_systemctl(root), "disable", *stop, *services], True, dry_run))
        actions.append(_run([*_systemctl(root), "disable", *[u for u in units if u not in services]], True, dry_run))
    for _, target, _ in FILES:
        actions += _take_away(root, target, recorded.get(target), dry_run)
    if (root / TOKEN).exists():
        actions.append(Action("removed", f"/{TOKEN}"))
        if not dry_run:
            (root / TOKEN).unlink()
    if not dry_run:
        (root / RECORD).unlink(missing_ok=True)
        for folder in {(root / target).parent for _, target, _ in FILES}:
            if folder.name.endswith(".device.d") or folder.name == "wingshape":
                _remove_if_empty(folder)
    if _live(root):
        actions.append(_run(["systemctl", "daemon-reload"], True, dry_run))
    return actions


def own_programs() -> Path:
    """The folder of this installation's commands."""
    return Path(sysconfig.get_path("scripts"))


def _check_root(root: Path, dry_run: bool) -> None:
    if not (root / "etc").is_dir():
        raise UsageError(f"{root}: not a system's root folder (it has no etc): give an image's with --root")
    if root == Path("/") and os.geteuid() != 0 and not dry_run:
        raise UsageError("/etc: only root may write there: run it with sudo, or see what it would do with --dry-run")


def _check_programs(root: Path, programs: Path) -> None:
    for hidden in _HIDDEN_FROM_SERVICES:
        if programs.is_relative_to(hidden):
            raise UsageError(
                f"{programs}: services do not see {hidden}: install wingshape elsewhere "
                "(`python3 -m venv /opt/wingshape`), or name that place with --programs"
            )
    inside = root / programs.relative_to("/")
    if not (inside / "wingcap").exists():
        raise UsageError(f"{inside}: the program wingcap is not there: install wingshape first, or give --programs")


def _content(source: str, programs: Path) -> bytes:
    text = (importlib.resources.files("capture") / "systemd" / source).read_text(encoding="utf-8")
    return text.replace("@BIN@", str(programs)).encode()


def _put(root: Path, target: str, content: bytes, mode: int, recorded: str | None, dry_run: bool) -> Action:
    path, shown = root / target, f"/{target}"
    now = path.read_bytes() if path.exists() else None
    if now == content:
        return Action("unchanged", shown)
    edited = now is not None and _sha256(now) != recorded
    if not dry_run:
        _write(path.with_name(path.name + ".new") if edited else path, content, mode)
    if edited:
        return Action("kept", shown, f"it was edited; ours is {shown}.new")
    return Action("installed" if now is None else "updated", shown)


def _put_token(root: Path, dry_run: bool) -> Action:
    path, shown = root / TOKEN, f"/{TOKEN}"
    if path.exists():
        return Action("unchanged", shown)
    if not dry_run:
        _write(path, secrets.token_urlsafe(32).encode() + b"\n", 0o600)
    return Action("installed", shown, "a new secret, for who may see the monitor from another computer")


def _take_away(root: Path, target: str, recorded: str | None, dry_run: bool) -> list[Action]:
    path, shown = root / target, f"/{target}"
    beside = path.with_name(path.name + ".new")
    if beside.exists() and not dry_run:
        beside.unlink()
    if not path.exists():
        return []
    if _sha256(path.read_bytes()) != recorded:
        return [Action("kept", shown, "it was edited")]
    if not dry_run:
        path.unlink()
    return [Action("removed", shown)]


def _commands(root: Path) -> list[tuple[list[str], bool]]:
    """What makes the files take effect, and whether it must succeed."""
    if not _live(root):
        return [(["systemd-sysusers", f"--root={root}", "wingshape.conf"], True)]
    return [
        (["systemd-sysusers", "/etc/sysusers.d/wingshape.conf"], True),
        (["systemd-tmpfiles", "--create", "/etc/tmpfiles.d/wingshape.conf"], False),  # there may be no USB
        (["sysctl", "--quiet", "--load=/etc/sysctl.d/70-wingshape.conf"], False),
        (["udevadm", "control", "--reload"], False),
        (["udevadm", "trigger", "--subsystem-match=usb", "--subsystem-match=ptp"], False),
        (["systemctl", "daemon-reload"], True),
    ]


def _live(root: Path) -> bool:
    return root == Path("/") and Path("/run/systemd/system").is_dir()


def _systemctl(root: Path) -> list[str]:
    return ["systemctl"] if _live(root) else ["systemctl", f"--root={root}"]


def _run(command: Sequence[str], needed: bool, dry_run: bool) -> Action:
    shown = " ".join(command)
    if dry_run:
        return Action("ran", shown)
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_COMMAND_TIMEOUT_S)
        problem = " ".join(done.stderr.split()) if done.returncode else ""
        failed = done.returncode != 0
    except (OSError, subprocess.TimeoutExpired) as error:
        problem, failed = str(error), True
    if failed and needed:
        raise CaptureError(f"`{shown}` failed: {problem}: mend that and run it again")
    return Action("failed" if failed else "ran", shown, problem and f"{problem}; takes effect at the next boot")


def _read_record(root: Path) -> dict[str, str]:
    try:
        return {str(k): str(v) for k, v in json.loads((root / RECORD).read_bytes()).items()}
    except FileNotFoundError:
        return {}
    except (ValueError, AttributeError) as error:
        raise CaptureError(f"{root / RECORD}: not what wingcap wrote ({error}): remove it") from error


def _write(path: Path, content: bytes, mode: int) -> None:
    """Whole or not at all, and on the disk when this returns."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(path.name + ".part")
    beside.unlink(missing_ok=True)
    with os.fdopen(os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
        os.fchmod(file.fileno(), mode)  # whatever the umask
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    beside.replace(path)


def _remove_if_empty(folder: Path) -> None:
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
