"""Places of frame sets → the frame sets, as fast as page cache or disk give them."""

import threading
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager

from process.recording import FrameSet, FrameSetReader, SetPlaces

READS_AHEAD = 4  # sets: a disk is at its fastest when it has several to read
_kept = threading.local()


def loaded(places: Sequence[SetPlaces]) -> Iterator[FrameSet]:
    """The frame sets, each valid until the next. What has to come from the disk is on its way ahead of its turn.

    What is in the page cache is fetched at its turn, always to the same memory: it never leaves the processor's cache.
    One at a time in each thread: the next call uses the same memory.
    """
    with _readers() as (at_its_turn, *in_turn), ThreadPoolExecutor(READS_AHEAD, "read-ahead") as ahead:
        on_their_way: deque[tuple[FrameSetReader, Future[None] | None]] = deque()
        for number, one in enumerate(places):
            for later in range(number + len(on_their_way), min(len(places), number + len(in_turn))):
                if at_its_turn.cached([places[later]]):
                    on_their_way.append((at_its_turn, None))
                else:
                    reader = in_turn[later % len(in_turn)]
                    on_their_way.append((reader, ahead.submit(reader.load, [places[later]])))
            reader, load = on_their_way.popleft()
            if load is None:
                reader.load([one])
            else:
                load.result()
            yield reader.read(one)


@contextmanager
def _readers() -> Iterator[list[FrameSetReader]]:
    """This thread's, whose memory all its blocks use in turn: new memory costs as much as reading it."""
    if not hasattr(_kept, "readers"):
        _kept.readers = [FrameSetReader() for _ in range(READS_AHEAD + 2)]
    with ExitStack() as files:
        yield [files.enter_context(reader) for reader in _kept.readers]
