"""One function over many items: in this process, in several, or on a Dask cluster, always with the same outcome.

Our own code unpickles nothing. joblib's processes and dask's workers do hand each other pickled work, as those libraries
are made; a scheduler can therefore run code as the user who connects to it: connect only to one that you trust.
"""

from __future__ import annotations

import logging
import os
import signal
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent import futures
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar
from urllib.parse import urlsplit

from . import InputError, __version__

if TYPE_CHECKING:
    from distributed import Client, Future

Item = TypeVar("Item")
Result = TypeVar("Result")
Progress = Callable[[int, int], None]
"""Told how many items of how many are finished, first of all 0."""

UNDER_WAY = 2
"""So many items for each worker are handed out at a time. (loky's own queue takes them all, so that it can be ended at
once.)"""
AT_HAND = 8
"""So many items for each worker may be under way or finished but not yet taken, while the first of them is slow."""
CONNECT_S = 10.0
PARENT_WATCHED_EVERY_S = 1.0
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

    where: for people; submit: begins function(*arguments) in a worker, None = there is none but this process;
    workers: how many there are now.
    """

    where: str
    submit: Callable[..., futures.Future[Any]] | None
    workers: Callable[[], int]

    def run(
        self, function: Callable[[Item], Result], items: Sequence[Item], progress: Progress | None = None
    ) -> Iterator[Result | Failed]:
        """function(item) of every item, in the items' order, each as soon as it and all before it are there.

        function and items: what pickle can send, such as a module's own function (or functools.partial of one, whose
        arguments travel with every item: paths rather than arrays). Only a few items are under way at a time.
        An InputError becomes that item's Failed and the rest goes on. Any other error passes through with a note that
        names the item. Where this iterator is given up, the few items under way may still run.
        Raises InputError where a worker process or the cluster itself is lost.
        """
        progress = progress or (lambda finished, total: None)
        progress(0, len(items))
        if self.submit is not None:
            yield from _run_in_workers(self.submit, self.workers, function, items, progress)
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
    pool = ProcessPoolExecutor(max_workers=count, env=one_thread, initializer=_depend_on_the_parent)
    try:
        yield Executor(f"in {count} processes", pool.submit, lambda: count)
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
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # a lost connection is told below
    try:
        _knock(address)
        client = Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:  # its TimeoutError is an OSError
        raise InputError(
            f"{address}: no Dask scheduler answers here; expected an address such as tcp://192.168.0.7:8786, which "
            "'dask scheduler' prints when it starts."
        ) from error
    try:
        yield Executor(
            _described(address, client.nthreads()), partial(_submit, client), lambda: len(client.nthreads())
        )
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


def _submit(client: Client, *call: Any) -> futures.Future[Any]:
    """As an Executor's submit. dask's own (client.get_executor) waits for ever for a scheduler that is gone."""
    promise: futures.Future[Any] = futures.Future()

    def keep(done: Future) -> None:
        try:
            promise.set_result(done.result())
        except BaseException as error:  # noqa: BLE001 - whatever it is, it is raised where the result is taken
            promise.set_exception(error)

    client.submit(*call, pure=False).add_done_callback(keep)
    return promise


def _run_in_workers(
    submit: Callable[..., futures.Future[Any]],
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
            count = max(workers(), 1)  # a cluster that grows with its work has to see some
            room = min(UNDER_WAY * count - len(running), AT_HAND * count - len(at_hand))
            for _ in range(min(room, len(items) - handed_out)):
                item = next(waiting)
                future = submit(_attempt_elsewhere, __version__, function, item)
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


def _depend_on_the_parent() -> None:
    """In a local worker: Ctrl-C, which reaches every process of a terminal, is the parent's; the worker ends with it.

    A parent that is killed has no time to end its workers, so they look whether it is still there.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(PARENT_WATCHED_EVERY_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
