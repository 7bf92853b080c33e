"""Jobs to results by other processes: a crew on this machine, or a Dask cluster's.

A job is a small picklable value, what to do with it a function of a module. Results come as they get done; which
process made one, and how many there are, is not to be seen in it.
"""

import gc
import os
import pickle
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import lru_cache
from importlib import import_module
from multiprocessing import get_context, parent_process
from multiprocessing.connection import wait as wait_for
from threading import BrokenBarrierError
from typing import Any, Generic, Protocol, TypeVar

import cv2
import pyarrow as pa

from capture.errors import ProcessError, UsageError

J = TypeVar("J")
R = TypeVar("R")
T = TypeVar("T")

AHEAD = 2  # jobs a process has been given: one in work, one waiting
START_S = 120.0  # a crew that has not started by then will not
RETRIES = 3  # of a job whose Dask worker died
_ENVIRONMENT = {
    **dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"),
    # images come and go: memory given back to the system would be cleared for each anew (mallopt(3))
    "MALLOC_MMAP_THRESHOLD_": "67108864",
    "MALLOC_TRIM_THRESHOLD_": "134217728",
}


class Crew(Protocol):
    """Processes that do jobs."""

    count: int
    """how many"""

    def results(self, function: Callable[[J], R], jobs: Iterable[J]) -> Iterator[tuple[int, R]]:
        """(number of the job, its result), as they get done; ``jobs`` is drawn from as there is room.

        Raises:
            ProcessError: a process died; also whatever ``function`` raises.
        """


class Shared(Generic[T]):
    """A value that many jobs have in common: pickled once, and unpickled once in each process."""

    def __init__(self, value: T) -> None:
        self._pickled = pickle.dumps(value)

    def get(self) -> T:
        """The value; not to be changed."""
        value: T = _unpickled(self._pickled)
        return value


def usable_cores() -> int:
    """Cores that this process may run on."""
    return len(os.sched_getaffinity(0))


@contextmanager
def worker_environment() -> Iterator[None]:
    """Processes started inside use one BLAS thread each, since more would only compete, and keep memory they free."""
    before = {name: os.environ.get(name) for name in _ENVIRONMENT}
    os.environ.update(_ENVIRONMENT)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def in_order(function: Callable[[J], R], jobs: Iterable[J], workers: int) -> Iterator[R]:
    """Results in the order of the jobs, by so many processes; with 1 in this one. Raises what ``function`` raises."""
    if workers == 1:
        yield from map(function, jobs)
        return
    with worker_environment(), ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        yield from pool.map(function, jobs)


@contextmanager
def crew(workers: int, scheduler: str | None = None, modules: tuple[str, ...] = ()) -> Iterator[Crew]:
    """A crew, ready to work: ``modules`` are loaded.

    Args:
        workers: processes; 1 is this one. Of a cluster at an address, what it has counts instead.
        scheduler: None for processes of our own, ``local`` for a Dask cluster on this machine, or a Dask address.
        modules: what their jobs will need.

    Raises:
        UsageError: there is no Dask, or none answers at that address.
        ProcessError: the processes do not start.
    """
    ours = not gc.get_freeze_count()
    if ours:
        gc.freeze()  # what is loaded stays: looking it through again and again would hold everybody up
    try:
        with _crew(workers, scheduler, modules) as hands:
            yield hands
    finally:
        if ours:
            gc.unfreeze()


@contextmanager
def _crew(workers: int, scheduler: str | None, modules: tuple[str, ...]) -> Iterator[Crew]:
    if scheduler is not None:
        with _dask(workers, scheduler, modules) as cluster:
            yield cluster
    elif workers <= 1:
        threads = cv2.getNumThreads()
        cv2.setNumThreads(1)
        try:
            yield _Alone()
        finally:
            cv2.setNumThreads(threads)
    else:
        # spawned, not forked: a forked child inherits locks of the parent's threads
        context = get_context("spawn")
        ready = context.Barrier(workers + 1)
        with (
            worker_environment(),
            ProcessPoolExecutor(workers, context, _start, (ready, modules)) as pool,
        ):
            started = [pool.submit(_nothing) for _ in range(workers)]
            try:
                ready.wait(START_S)
                wait(started)
            except BrokenBarrierError as error:
                raise ProcessError(
                    f"{workers} worker processes did not start in {START_S:g} s; try --workers 1"
                ) from error
            try:
                yield _Pool(pool, workers)
            finally:
                pool.shutdown(wait=False, cancel_futures=True)


class _Alone:
    """This process."""

    count = 1

    def results(self, function: Callable[[J], R], jobs: Iterable[J]) -> Iterator[tuple[int, R]]:
        for number, job in enumerate(jobs):
            yield number, function(job)


class _Pool:
    """Processes of our own."""

    def __init__(self, pool: ProcessPoolExecutor, count: int) -> None:
        self.count = count
        self._pool = pool

    def results(self, function: Callable[[J], R], jobs: Iterable[J]) -> Iterator[tuple[int, R]]:
        waiting = enumerate(jobs)
        running: dict[Future[R], int] = {}
        try:
            while True:
                while len(running) < AHEAD * self.count and (following := next(waiting, None)) is not None:
                    number, job = following
                    running[self._pool.submit(function, job)] = number
                if not running:
                    return
                done, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    yield running.pop(future), future.result()
        except BrokenProcessPool as error:
            raise ProcessError(
                "a worker process died (out of memory?): run the same command again, it goes on; or try --workers 1"
            ) from error
        finally:
            for future in running:
                future.cancel()


class _Cluster:
    """A Dask cluster."""

    def __init__(self, client: Any, count: int) -> None:
        self.count = count
        self._client = client

    def results(self, function: Callable[[J], R], jobs: Iterable[J]) -> Iterator[tuple[int, R]]:
        from distributed import as_completed

        waiting = enumerate(jobs)
        running: dict[str, int] = {}
        done = as_completed()

        def give() -> None:
            while len(running) < AHEAD * self.count and (following := next(waiting, None)) is not None:
                number, job = following
                future = self._client.submit(_in_one_thread, function, job, pure=False, retries=RETRIES)
                running[future.key] = number
                done.add(future)

        give()
        while running:
            future = next(done)
            number = running.pop(future.key)
            result = self._result(future)
            future.release()
            give()
            yield number, result

    def _result(self, future: Any) -> Any:
        from distributed import CancelledError, KilledWorker

        try:
            return future.result()
        except (KilledWorker, CancelledError) as error:
            raise ProcessError(
                f"the Dask cluster lost a job ({' '.join(str(error).split())[:120]}): run the same command again,"
                " it goes on"
            ) from error


@contextmanager
def _dask(workers: int, scheduler: str, modules: tuple[str, ...]) -> Iterator[_Cluster]:
    try:
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise UsageError("--scheduler needs Dask: pip install 'wingshape[dask]'") from error
    with worker_environment():
        if scheduler == "local":
            place: Any = LocalCluster(
                n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=None, memory_limit=0
            )
        else:
            place = scheduler
        try:
            client = Client(place, timeout="10s")
        except (OSError, ValueError) as error:
            raise UsageError(
                f"--scheduler {scheduler}: no Dask scheduler answers there; is its address right?"
            ) from error
    try:
        threads = sum(worker["nthreads"] for worker in client.scheduler_info(-1)["workers"].values())
        if not threads:
            raise UsageError(f"--scheduler {scheduler}: the cluster has no workers; start some with `dask worker`")
        client.run(_load, modules)
        yield _Cluster(client, threads)
    finally:
        client.close()
        if scheduler == "local":
            place.close()


def _in_one_thread(function: Callable[[J], R], job: J) -> R:
    cv2.setNumThreads(1)
    return function(job)


def _start(ready: Any, modules: tuple[str, ...]) -> None:
    """Of a process of our own: load what is needed, end with the parent, and tell that all is ready."""
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is interrupted, too, and ends this process
    threading.Thread(target=_end_with_parent, name="end-with-parent", daemon=True).start()
    cv2.setNumThreads(1)
    _load(modules)
    gc.freeze()  # as in the parent
    ready.wait(START_S)


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        wait_for([parent.sentinel])
        os._exit(1)


def _load(modules: tuple[str, ...]) -> None:
    for name in modules:
        import_module(name)
    pa.array([""])  # Arrow looks for pandas when it makes its first array, and that takes a while


def _nothing() -> None:
    """Makes the pool start a process."""


@lru_cache(maxsize=8)
def _unpickled(pickled: bytes) -> Any:
    return pickle.loads(pickled)
