"""The program, the computer and the configuration to what every segment says of its own making."""

import json
import platform
import subprocess
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from capture.camera.base import CameraDescription
from capture.config import LoadedConfig


def describe_host() -> dict[str, str]:
    """Program and computer."""
    return {
        "version": _version(),
        "commit": _commit(),
        "host": platform.node(),
        "kernel": platform.release(),
        "python": platform.python_version(),
    }


def describe_config(loaded: LoadedConfig) -> dict[str, str]:
    """The configuration's own text."""
    return {"config": loaded.text, "config_sha256": loaded.sha256}


def describe_cameras(cameras: Mapping[str, CameraDescription]) -> dict[str, str]:
    """The cameras, by ``side/name``."""
    return {
        "cameras": " ".join(cameras),
        "serials": json.dumps({name: camera.serial for name, camera in cameras.items()}),
        "models": json.dumps({name: camera.model for name, camera in cameras.items()}),
    }


def _version() -> str:
    try:
        return version("wingshape")
    except PackageNotFoundError:
        return "unknown"


def _commit() -> str:
    """The source's commit where it runs from a checkout, else empty."""
    try:
        done = subprocess.run(
            ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"], capture_output=True, text=True, timeout=5
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""
