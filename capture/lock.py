"""One recorder at a time on a disk: an advisory lock on the disk's folder, which ends with its process."""

import contextlib
import fcntl
import os
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from capture.errors import CaptureError

_PATIENCE_S = 1.0  # somebody may just be looking whether it is free


@contextlib.contextmanager
def sole_recorder(disks: Sequence[Path]) -> Iterator[None]:
    """Hold every disk's folder as its only recorder.

    A folder that is not there, or whose file system knows no locks, is passed over: what is wrong with it is said
    by whoever writes there.

    Raises:
        CaptureError: another process records there; the message has its number.
    """
    with contextlib.ExitStack() as held:
        for disk in disks:
            with contextlib.suppress(FileNotFoundError, NotADirectoryError, PermissionError):
                held.enter_context(_held(disk))
        yield


def recorder_at(disk: Path) -> int | None:
    """The process that records to ``disk`` now; 0: one that cannot be seen; None: nobody does."""
    try:
        folder = os.open(disk, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError:
        return None
    try:
        fcntl.flock(folder, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return _holder(folder)
    except OSError:  # a file system without locks
        return None
    finally:
        os.close(folder)
    return None


@contextlib.contextmanager
def _held(disk: Path) -> Iterator[None]:
    folder = os.open(disk, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        deadline_s = time.monotonic() + _PATIENCE_S
        while not _locked(folder):
            if time.monotonic() > deadline_s:
                who = _holder(folder)
                raise CaptureError(
                    f"{disk}: another recorder is writing there{f' (process {who})' if who else ''}: "
                    "stop it first (`systemctl stop wingcap`), or give this one other disks"
                )
            time.sleep(0.05)
        yield
    finally:
        os.close(folder)


def _locked(folder: int) -> bool:
    try:
        fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return True
    return True


def _holder(folder: int) -> int:
    """The process that holds the lock, from /proc/locks; 0 when it cannot be told (in another namespace)."""
    status = os.fstat(folder)
    file = f"{os.major(status.st_dev):02x}:{os.minor(status.st_dev):02x}:{status.st_ino}"
    with contextlib.suppress(OSError, ValueError):
        for line in Path("/proc/locks").read_text(encoding="ascii").splitlines():
            words = line.split()
            if "FLOCK" in words and "WRITE" in words and file in words:
                return max(0, int(words[words.index(file) - 1]))
    return 0
