"""A network namespace for the calling thread and all that it starts: only a loopback interface, at 127.0.0.1 to .4."""

import contextlib
import ctypes
import os
import subprocess
from collections.abc import Iterator

from needs import needs_program, needs_root

_CLONE_NEWNET = 0x40000000


@contextlib.contextmanager
def network_namespace() -> Iterator[None]:
    """Sockets, threads and processes made inside belong to the namespace; the rest of this process does not."""
    needs_root()
    ip = needs_program("ip")
    libc = ctypes.CDLL(None, use_errno=True)
    before = os.open("/proc/thread-self/ns/net", os.O_RDONLY)
    try:
        _check(libc.unshare(_CLONE_NEWNET))
        subprocess.run([ip, "link", "set", "lo", "up"], check=True)
        for number in (2, 3, 4):
            subprocess.run([ip, "address", "add", f"127.0.0.{number}/8", "dev", "lo"], check=True)
        yield
    finally:
        _check(libc.setns(before, _CLONE_NEWNET))
        os.close(before)


def _check(result: int) -> None:
    if result:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
