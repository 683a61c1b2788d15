"""One function over many items: in this process, in several, or on a Dask cluster, always with the same outcome.

Our own code unpickles nothing. joblib's processes and dask's workers do hand each other pickled work, as those libraries
are made; a scheduler can therefore run code as the user who connects to it: connect only to one that you trust.
"""

from __future__ import annotations

import signal
import socket
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent import futures
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import TypeVar
from urllib.parse import urlsplit

from . import InputError, __version__

Item = TypeVar("Item")
Result = TypeVar("Result")
Progress = Callable[[int, int], None]
"""Told how many items of how many are finished, first of all 0."""

AT_HAND = 3
"""So many items for each worker are handed out ahead of the results that were taken: never idle, never all in memory."""
FEWEST_AT_HAND = 8
"""Also where a cluster has no worker yet; one that grows with its work has to see some."""
CONNECT_S = 10.0
THREADS = ("OMP", "OPENBLAS", "MKL", "BLIS", "NUMEXPR", "NUMBA")
"""Libraries whose threads are counted in NAME_NUM_THREADS. The items share the cores, so each item gets one."""
_ONE_AT_A_TIME = threading.Lock()
"""In a worker: a Dask worker may have several threads, and not every library can be called from two at once."""


@dataclass(frozen=True)
class Failed:
    """In place of an item's result: the sentence of the InputError that it ended with."""

    reason: str


@dataclass(frozen=True)
class Executor:
    """Where work runs; made by `local` and `cluster`.

    where: for people; pool: None = in this process; workers: how many there are now.
    """

    where: str
    pool: futures.Executor | None
    workers: Callable[[], int]

    def run(
        self, function: Callable[[Item], Result], items: Sequence[Item], progress: Progress | None = None
    ) -> Iterator[Result | Failed]:
        """function(item) of every item, in the items' order, each as soon as it and all before it are there.

        function and items: what pickle can send, such as a module's own function (or functools.partial of one, whose
        arguments travel with every item: paths rather than arrays). Only a few items are under way at a time.
        An InputError becomes that item's Failed and the rest goes on. Any other error passes through with a note that
        names the item. Where this iterator is given up, what has not begun is not begun.
        Raises InputError where a worker process or the cluster itself is lost.
        """
        progress = progress or (lambda finished, total: None)
        progress(0, len(items))
        if self.pool is not None:
            yield from _run_in_pool(self.pool, self.workers, function, items, progress)
            return
        for finished, item in enumerate(items, 1):
            try:
                outcome = _attempt(function, item)
            except Exception as error:
                _name_item(error, item)
                raise
            progress(finished, len(items))
            yield outcome


def executor(jobs: int | None, scheduler: str | None) -> AbstractContextManager[Executor]:
    """On the cluster at this address, or without one (None) on this machine as `local` does."""
    if scheduler is None:
        return local(jobs)
    if jobs is not None:
        raise InputError(
            f"{jobs} jobs and the scheduler {scheduler}: a cluster has its own number of workers; give one of the two."
        )
    return cluster(scheduler)


@contextmanager
def local(jobs: int | None = None) -> Iterator[Executor]:
    """So many processes on this machine (None: one for each core), each with one thread; 1: in this process.

    They end with the `with` block: at once where it is left by an error or Ctrl-C. Raises InputError for jobs < 1.
    """
    import joblib  # type: ignore[import-untyped]
    from joblib.externals.loky import ProcessPoolExecutor  # type: ignore[import-untyped]

    if jobs is not None and jobs < 1:
        raise InputError(f"{jobs} jobs cannot do anything; expected 1 or more.")
    count: int = joblib.cpu_count() if jobs is None else jobs
    if count == 1:
        yield Executor("in this process", None, lambda: 1)
        return
    one_thread = {f"{name}_NUM_THREADS": "1" for name in THREADS}
    pool = ProcessPoolExecutor(max_workers=count, env=one_thread, initializer=_leave_interrupts_to_the_parent)
    try:
        yield Executor(f"in {count} processes", pool, lambda: count)
    except BaseException:
        pool.shutdown(wait=True, kill_workers=True)
        raise
    pool.shutdown(wait=True)


@contextmanager
def cluster(address: str) -> Iterator[Executor]:
    """The Dask cluster whose scheduler listens at `address`, such as tcp://192.168.0.7:8786.

    Its workers need this version of tonguetrack, and every file under the same path as here. They stay when the `with`
    block ends; items under way on them are finished or dropped by the cluster. Raises InputError where the extra
    'cluster' is not installed or nothing answers.
    """
    try:
        from distributed import Client, KilledWorker
        from distributed.comm import CommClosedError
    except ModuleNotFoundError as error:
        raise InputError(
            "working on a Dask cluster needs the extra 'cluster': pip install 'tonguetrack[cluster]'."
        ) from error
    try:
        _knock(address)
        client = Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:  # its TimeoutError is an OSError
        raise InputError(
            f"{address}: no Dask scheduler answers here; expected an address such as tcp://192.168.0.7:8786, which "
            "'dask scheduler' prints when it starts."
        ) from error
    try:
        pool = client.get_executor(pure=False)
        yield Executor(_described(address, client.nthreads()), pool, lambda: len(client.nthreads()))
    except KilledWorker as error:
        raise InputError(
            f"{address}: several workers in a row ended while working on the same item, most likely for want of memory."
        ) from error
    except (CommClosedError, futures.CancelledError) as error:
        raise InputError(
            f"{address}: the connection to the scheduler was lost; start it and try again."
        ) from error
    finally:
        client.close()


def _knock(address: str) -> None:
    """OSError or ValueError where nothing listens: dask's client would try for long, and complain once more when it ends."""
    parts = urlsplit(address)
    if parts.scheme not in ("tcp", "tls") or parts.hostname is None or parts.port is None:
        raise ValueError(address)
    socket.create_connection((parts.hostname, parts.port), timeout=CONNECT_S).close()


def _described(address: str, threads: dict[str, int]) -> str:
    if not threads:
        return f"on the cluster {address}, which has no worker yet"
    text = f"on {len(threads)} workers of the cluster {address}"
    if (most := max(threads.values())) > 1:
        text += f" (of up to {most} threads, of which one is used; start workers with --nthreads 1)"
    return text


def _run_in_pool(
    pool: futures.Executor,
    workers: Callable[[], int],
    function: Callable[[Item], Result],
    items: Sequence[Item],
    progress: Progress,
) -> Iterator[Result | Failed]:
    waiting = iter(items)
    at_hand: deque[tuple[Item, futures.Future[Result | Failed]]] = deque()
    running: set[futures.Future[Result | Failed]] = set()
    handed_out = 0
    try:
        while handed_out < len(items) or at_hand:
            room = max(AT_HAND * workers(), FEWEST_AT_HAND) - len(at_hand)
            for _ in range(min(room, len(items) - handed_out)):
                item = next(waiting)
                future = pool.submit(_attempt_elsewhere, __version__, function, item)
                at_hand.append((item, future))
                running.add(future)
                handed_out += 1
            _, running = futures.wait(running, return_when=futures.FIRST_COMPLETED)
            progress(handed_out - len(running), len(items))
            while at_hand and at_hand[0][1].done():
                item, future = at_hand.popleft()
                yield _outcome(item, future)
    except futures.BrokenExecutor as error:
        raise InputError(
            "a worker process was ended from outside, most likely for want of memory; try again with fewer jobs."
        ) from error
    finally:
        for future in running:
            future.cancel()


def _outcome(item: Item, future: futures.Future[Result | Failed]) -> Result | Failed:
    try:
        return future.result()
    except (InputError, futures.BrokenExecutor):
        raise
    except ModuleNotFoundError as error:
        raise InputError(
            f"a worker has no module '{error.name}'; install tonguetrack {__version__} with the same extras there."
        ) from error
    except Exception as error:
        _name_item(error, item)
        raise


def _attempt(function: Callable[[Item], Result], item: Item) -> Result | Failed:
    try:
        return function(item)
    except InputError as reason:
        return Failed(str(reason))


def _attempt_elsewhere(version: str, function: Callable[[Item], Result], item: Item) -> Result | Failed:
    """As _attempt, in a worker, which may have been installed by somebody else at another time."""
    if version != __version__:
        raise InputError(
            f"a worker has tonguetrack {__version__}, this is {version}; install the same version there."
        )
    with _ONE_AT_A_TIME:
        return _attempt(function, item)


def _name_item(error: Exception, item: object) -> None:
    error.add_note(f"This happened while working on {repr(item)[:300]}.")


def _leave_interrupts_to_the_parent() -> None:
    """Ctrl-C reaches every process of the terminal; the workers are ended by the one that started them."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
