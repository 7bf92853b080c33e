"""Versioned JSON files: a dictionary to a file and back, with errors that name the file and the remedy."""

import hashlib
import json
import math
import platform
from collections.abc import Callable, Iterable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
import scipy

from capture.errors import ProcessError

T = TypeVar("T")


def read_json(
    path: Path | str, file_format: str, file_version: int, build: Callable[[dict[str, Any]], T], remedy: str
) -> T:
    """What ``build`` makes of the file's dictionary.

    Raises ProcessError, ending in ``remedy``, if the file is missing, is not whole, or is of another format or version.
    """
    path = Path(path)
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ProcessError(f"{path}: no such file; {remedy}") from error
    except OSError as error:
        raise ProcessError(f"{path}: {error.strerror}; {remedy}") from error
    except ValueError as error:  # not JSON, or not UTF-8
        raise ProcessError(f"{path}: not a whole JSON file ({error}); {remedy}") from error
    if not isinstance(value, dict) or value.get("format") != file_format:
        raise ProcessError(f'{path}: not a "{file_format}" file; {remedy}')
    if value.get("version") != file_version:
        raise ProcessError(
            f"{path}: version {value.get('version')} of the format, this program reads {file_version}; {remedy}"
        )
    try:
        return build(value)
    except KeyError as error:
        raise ProcessError(f"{path}: {error} is missing; {remedy}") from error
    except (TypeError, ValueError, AttributeError) as error:
        raise ProcessError(f"{path}: {error}; {remedy}") from error


def write_json(path: Path | str, value: dict[str, Any]) -> None:
    """Write ``value`` whole or not at all; ValueError for numbers that JSON does not have."""
    path = Path(path)
    text = json.dumps(value, indent=1, allow_nan=False)
    part = path.with_name(path.name + ".part")
    try:
        part.write_text(text + "\n", encoding="utf-8")
        part.replace(path)
    except OSError as error:
        raise ProcessError(f"{path}: cannot be written ({error.strerror})") from error


def finite_or_none(number: float) -> float | None:
    """JSON has no NaN: what is not known is null."""
    return float(number) if math.isfinite(number) else None


def provenance(command: str, inputs: Iterable[Path], config: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """How a file was made: command line, versions, the SHA-256 of each input, and what was configured."""
    return {
        "command": command,
        "versions": {
            "wingshape": version("wingshape"),
            "python": platform.python_version(),
            "numpy": np.__version__,
            "scipy": scipy.__version__,
            "opencv": cv2.__version__,
        },
        "inputs": {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in inputs},
        **({"config": dict(config)} if config else {}),
    }
