"""Marker and shape tables to Parquet files and back, each with a note of how it was made."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from capture.errors import ProcessError
from process.json_file import provenance

PROVENANCE_KEY = b"wingshape"

MARKER_SCHEMA: pa.Schema = pa.schema(
    [
        ("trigger_index", pa.int64()),
        ("side", pa.string()),
        ("marker", pa.int32()),
        ("timestamp_ns", pa.int64()),
        ("frame_timestamp_ns", pa.int64()),
        ("time_sigma_ns", pa.float64()),
        ("ptp_state", pa.string()),
        *((f"{axis}_m", pa.float64()) for axis in "xyz"),
        *((f"cov_{axes}_m2", pa.float64()) for axes in ("xx", "xy", "xz", "yy", "yz", "zz")),
        *((name, pa.float64()) for name in ("u0_px", "v0_px", "u1_px", "v1_px", "epipolar_px")),
        ("flags", pa.string()),
    ]
)
"""columns of ``markers.parquet`` (docs/reference/formats.md)"""

SHAPE_SCHEMA: pa.Schema = pa.schema(
    [
        ("trigger_index", pa.int64()),
        ("side", pa.string()),
        ("timestamp_ns", pa.int64()),
        ("station", pa.int32()),
        ("s_m", pa.float64()),
        *((f"{axis}_m", pa.float64()) for axis in "xyz"),
        ("twist_deg", pa.float64()),
        *((f"sigma_{name}", pa.float64()) for name in ("x_m", "y_m", "z_m", "twist_deg")),
        ("flags", pa.string()),
    ]
)
"""columns of ``shape.parquet``"""

_TRUTH_MAY_LACK = ("time_sigma_", "ptp_", "cov_", "sigma_", "u0_", "v0_", "u1_", "v1_", "epipolar_", "flags")


def write_table(table: pa.Table, path: Path | str, *, command: str, inputs: Iterable[Path] = ()) -> None:
    """Write ``table`` with the command line, the versions and the SHA-256 of ``inputs``; whole or not at all.

    Raises:
        ProcessError: the file cannot be written.
    """
    path = Path(path)
    note = json.dumps(provenance(command, inputs)).encode()
    table = table.replace_schema_metadata({**(table.schema.metadata or {}), PROVENANCE_KEY: note})
    part = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, part, compression="zstd")
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise ProcessError(f"{path}: cannot be written ({error.strerror or error})") from error


def read_table(
    path: Path | str, schema: pa.Schema, *, truth: bool = False, remedy: str = "make it with `wingproc markers`"
) -> pa.Table:
    """The table of ``path`` in the types and order of ``schema``; columns beyond these are left out.

    With ``truth``, columns that only a measurement has (covariances, pixels, flags) may be missing from the file, and
    are then missing from what is returned.

    Raises:
        ProcessError: the file is missing, is not whole, or does not have the columns.
    """
    path = Path(path)
    if not path.is_file():
        raise ProcessError(f"{path}: no such file; {remedy}")
    try:
        table = pq.read_table(path)
    except (pa.ArrowException, OSError, ValueError) as error:
        raise ProcessError(f"{path}: not a whole Parquet file ({_one_line(error)}); {remedy}") from error
    wanted = []
    for member in schema:
        if member.name in table.column_names:
            wanted.append(member)
        elif not (truth and member.name.startswith(_TRUTH_MAY_LACK)):
            raise ProcessError(f"{path}: column {member.name} is missing; {remedy}")
    try:
        return table.select([member.name for member in wanted]).cast(pa.schema(wanted, table.schema.metadata))
    except (pa.ArrowException, ValueError) as error:
        raise ProcessError(f"{path}: {_one_line(error)}; {remedy}") from error


def table_provenance(table: pa.Table) -> dict[str, Any]:
    """How the table was made, as its file says; empty if it does not."""
    note = (table.schema.metadata or {}).get(PROVENANCE_KEY, b"{}")
    try:
        value = json.loads(note)
    except ValueError:
        return {}
    return value if isinstance(value, dict) else {}


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
