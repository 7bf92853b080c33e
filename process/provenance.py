"""A recorded file to what the recorder noted of it: flight, versions, configuration, cameras."""

import struct
from pathlib import Path

from mcap.exceptions import McapError
from mcap.records import Chunk, Metadata
from mcap.stream_reader import StreamReader

from capture.record import PROVENANCE


def recorded_provenance(path: Path) -> dict[str, str]:
    """The note at a file's start, before its first chunk; empty where it is missing or cannot be read."""
    try:
        with path.open("rb") as stream:
            for record in StreamReader(stream, emit_chunks=True).records:
                if isinstance(record, Metadata) and record.name == PROVENANCE:
                    return dict(record.metadata)
                if isinstance(record, Chunk):
                    break
    except (McapError, struct.error, ValueError, AttributeError, OverflowError, MemoryError, EOFError, OSError):
        pass  # what is wrong with a file, reading its frames will tell
    return {}
