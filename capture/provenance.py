"""The program, the computer and the configuration to what every segment says of its own making."""

import json
import platform
import subprocess
import time
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from capture.camera.base import CameraDescription
from capture.config import LoadedConfig, PtpConfig
from capture.errors import PtpError
from capture.ptp import read_ptp
from capture.ptp_protocol import identity_text


def describe_host() -> dict[str, str]:
    """Program and computer."""
    return {
        "version": software_version(),
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
        "firmware": json.dumps({name: camera.firmware for name, camera in cameras.items()}),
        "camera_features": json.dumps({name: dict(camera.features) for name, camera in cameras.items()}),
    }


def describe_time(config: PtpConfig | None) -> dict[str, str]:
    """What the times in the recording are, and what TAI - UTC is held to be."""
    if config is None or config.role == "none":
        return {"time_base": "UTC of the host's system clock, free running", **_kernel_tai()}
    try:
        status = read_ptp(config)
    except PtpError as error:
        return {"time_base": "UTC of the host's system clock; ptp4l did not answer", "ptp": str(error), **_kernel_tai()}
    master = identity_text(status.gm_identity)
    found = {
        "time_base": f"UTC by PTP: port {status.port_state.name}, grandmaster {master}",
        "ptp_timescale": "PTP" if status.ptp_timescale else "arbitrary",
    }
    if not status.utc_offset_valid:
        return {**found, **_kernel_tai()}
    return {**found, "tai_offset_s": str(status.utc_offset_s), "tai_offset_source": f"grandmaster {master}"}


def _kernel_tai() -> dict[str, str]:
    """TAI - UTC as the kernel was told by whoever sets its clock."""
    offset_s = round((time.clock_gettime_ns(time.CLOCK_TAI) - time.clock_gettime_ns(time.CLOCK_REALTIME)) / 1e9)
    if offset_s == 0:
        return {"tai_offset_s": "unknown", "tai_offset_source": "nobody has said"}
    return {"tai_offset_s": str(offset_s), "tai_offset_source": "kernel"}


def software_version() -> str:
    """The distribution's version."""
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
