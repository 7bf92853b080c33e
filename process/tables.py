"""Marker and shape tables to Parquet files and back, each with a note of how it was made."""

import json
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq

from capture.errors import ProcessError
from process.json_file import provenance

PROVENANCE_KEY = b"wingshape"
ROW_GROUP_ROWS = 131_072

ROW_TIMES = ("timestamp0_ns", "timestamp1_ns")
PIXEL_COVARIANCES = tuple(f"cov_{axes}{camera}_px2" for camera in (0, 1) for axes in ("uu", "uv", "vv"))
DIRECT_COLUMNS = (*ROW_TIMES, *PIXEL_COVARIANCES)
"""what only a fit to pixels needs"""
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
        *((name, pa.int64()) for name in ROW_TIMES),
        *((name, pa.float64()) for name in PIXEL_COVARIANCES),
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
    with TableWriter(Path(path), table.schema, provenance(command, inputs)) as writer:
        writer.append(table)


class TableWriter:
    """A table to a Parquet file, and the same as CSV beside it, a piece at a time; whole or not at all.

    The files are there when the ``with`` ends without an error.

    Raises:
        ProcessError: from every method, when a file cannot be written.
    """

    def __init__(self, path: Path, schema: pa.Schema, note: Mapping[str, Any] | None, *, csv: bool = False) -> None:
        """``note`` is how it was made, kept in the schema's metadata; None: ``schema`` has it already."""
        self._path = path
        self._schema = schema
        if note is not None:
            self._schema = schema.with_metadata({**(schema.metadata or {}), PROVENANCE_KEY: json.dumps(note).encode()})
        self._waiting: list[pa.Table] = []
        self._rows = 0
        self._files = [path, path.with_suffix(".csv")] if csv else [path]
        self._writers: list[Any] = []
        with self._errors():
            path.parent.mkdir(parents=True, exist_ok=True)
            self._writers.append(pq.ParquetWriter(_part(path), self._schema, compression="zstd"))
            if csv:
                self._writers.append(pyarrow.csv.CSVWriter(_part(self._files[1]), schema))

    def append(self, table: pa.Table) -> None:
        """Write some more rows; the columns are taken by their names."""
        self._waiting.append(table.select(self._schema.names).cast(self._schema))
        self._rows += table.num_rows
        if self._rows >= ROW_GROUP_ROWS:
            self._flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, failed: type[BaseException] | None, *_: object) -> None:
        with self._errors():
            if failed is None:
                self._flush()
            for writer in self._writers:
                writer.close()
            for path in self._files:
                if failed is None:
                    _part(path).replace(path)
                else:
                    _part(path).unlink(missing_ok=True)

    def _flush(self) -> None:
        if self._waiting:
            table = pa.concat_tables(self._waiting)
            with self._errors(), ThreadPoolExecutor(len(self._writers), "table") as threads:
                list(threads.map(lambda writer: writer.write_table(table), self._writers))
        self._waiting, self._rows = [], 0

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            for path in self._files:
                _part(path).unlink(missing_ok=True)
            raise ProcessError(f"{self._path}: cannot be written ({error.strerror or error})") from error


def _part(path: Path) -> Path:
    return path.with_name(path.name + ".part")


def read_table(
    path: Path | str, schema: pa.Schema, *, truth: bool = False, remedy: str = "make it with `wingproc markers`"
) -> pa.Table:
    """The table of ``path`` in the types and order of ``schema``; columns beyond these are left out.

    What only direct mode needs may be missing from the file, and is then missing from what is returned.

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
        elif not (member.name in DIRECT_COLUMNS or (truth and member.name.startswith(_TRUTH_MAY_LACK))):
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
