"""A field for the tests of the monitor."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from field import Field, field_in
from needs import needs_module


@pytest.fixture
def field(tmp_path: Path) -> Iterator[Field]:
    """Rig, recorder and monitor; nothing is started yet."""
    for module in ("starlette", "uvicorn"):
        needs_module(module)
    with field_in(tmp_path) as made:
        yield made
