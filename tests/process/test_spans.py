"""Byte ranges read past the page cache and through it, against the file's own bytes."""

import os

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from process.spans import PAGE, Spans

SIZE = 3 * 1024 * 1024 + 1234


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("spans") / "file"
    path.write_bytes(np.random.default_rng(1).bytes(SIZE))
    return path


def evict(path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    os.fsync(descriptor)
    os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
    os.close(descriptor)


@given(
    ranges=st.lists(st.tuples(st.integers(0, SIZE), st.integers(1, 400_000)), min_size=1, max_size=8),
    cold=st.booleans(),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40)
def test_what_is_held_is_what_the_file_has(file, ranges, cold):
    data = file.read_bytes()
    if cold:
        evict(file)
    spans = Spans()
    spans.load((str(file), at, size) for at, size in ranges)
    for at, size in ranges:
        held = spans.get(str(file), at, size)
        if at + size <= SIZE:
            assert held == data[at : at + size]
        else:
            assert held is None


def test_what_was_just_read_is_in_the_cache(file):
    file.read_bytes()
    assert Spans().cached([(str(file), 5 * PAGE, SIZE - 5 * PAGE)])


def test_what_was_evicted_is_not(file):
    evict(file)
    spans = Spans()
    if spans.cached([(str(file), 0, SIZE)]):
        pytest.skip("needs a file system whose pages can be evicted")
    assert not spans.cached([(str(file), PAGE, SIZE // 2)])


def test_a_missing_file_holds_nothing_and_is_nothing_to_wait_for(tmp_path):
    spans, wanted = Spans(), (str(tmp_path / "none"), 0, 100)
    assert spans.cached([wanted])
    spans.load([wanted])
    assert spans.get(*wanted) is None
