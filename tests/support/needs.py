"""What a test needs of the machine: absent, it skips and says so; in CI, where everything is installed, it fails."""

import ctypes
import importlib
import os
import shutil
from typing import NoReturn

import pytest

NO_SKIP = "WINGSHAPE_NO_SKIP"
"""Set to 1 where a skipped test would be a defect (.ci/run)."""


def needs_program(name: str) -> str:
    """Path of a program."""
    return shutil.which(name, path=os.environ.get("PATH", "") + ":/usr/sbin:/sbin") or _lacking(f"the program {name}")


def needs_library(name: str) -> ctypes.CDLL:
    """A shared library, loaded."""
    try:
        return ctypes.CDLL(name)
    except OSError:
        _lacking(f"the library {name}")


def needs_module(name: str) -> None:
    """A Python module that only an extra installs."""
    try:
        importlib.import_module(name)
    except ImportError:
        _lacking(f"the Python module {name}")


def needs_root() -> None:
    """Root, for network namespaces, mounts and containers."""
    if os.geteuid() != 0:
        _lacking("root")


def _lacking(what: str) -> NoReturn:
    message = f"needs {what}, which is not here"
    if os.environ.get(NO_SKIP) == "1":
        pytest.fail(message)
    pytest.skip(message)
