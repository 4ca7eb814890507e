"""Workers that play the chunks of a campaign: this process, processes of this machine, or a cluster of Dask.

Each takes tasks when it has capacity, and yields results in any order. Only the tasks in flight on a killed worker are
given to another. A task that has killed ``MOST_DEATHS`` workers ends the campaign.
"""

from __future__ import annotations

import contextlib
import importlib
import logging
import multiprocessing
import os
import resource
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import connection, forkserver, resource_tracker
from typing import Any, Protocol, TypeVar

from analogrig.errors import ConfigurationError, WorkerError
from analogrig.signals import ENDING, leave_to_parent
from analogrig.wording import number_of

Task = TypeVar("Task")
Result = TypeVar("Result")

_LOADED = ("analogrig.campaigns.trial", "analogrig.campaigns.certificate")
"""Modules that every worker needs. The fork server loads them once, while this process reads its arguments."""

MOST_DEATHS = 3
"""Workers that may be lost over one task."""

_DESCRIPTORS, _DESCRIPTORS_EACH = 48, 8
"""Files that must be allowed to be open at once, and those for each worker."""

_IN_HAND = 2
"""Tasks in flight for each worker of a cluster, so that none waits for a round trip."""

_ANSWER_S = 10
"""Time-out in seconds for an answer of the scheduler."""

_TALKATIVE = ("distributed", "distributed.client", "tornado.application", "asyncio")
"""Loggers that print tracebacks of a lost connection, which the WorkerError reports in one line."""


def prepare() -> None:
    """Preload the modules that workers need, in the process from which they are forked.

    Call it before anything else that takes long.

    :raises ConfigurationError: too few files may be open.
    """
    _check_descriptors(0)
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(_LOADED))
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)  # they are for this process alone
    try:
        resource_tracker.ensure_running()  # which leaves SIGHUP blocked, and unblocks the others here
        signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _check_descriptors(workers: int) -> None:
    """Check the limit on open files in advance: the fork server would report its lack by a traceback of its own.

    :raises ConfigurationError: too few files may be open.
    """
    allowed, needed = resource.getrlimit(resource.RLIMIT_NOFILE)[0], _DESCRIPTORS + _DESCRIPTORS_EACH * workers
    if allowed < needed:
        raise ConfigurationError(
            f"only {allowed} files may be open at once, and workers need {needed}:"
            " raise `ulimit -n`, or pass --workers 1"
        )


class Workers(Protocol):
    """Interface of all workers: play tasks."""

    def play(self, work: Callable[[Task], Result], tasks: Iterator[Task]) -> Iterator[tuple[Task, Result]]:
        """Yield each task with its result. A task is taken only when a worker can start it.

        :raises WorkerError: workers keep dying over a task, or cannot be reached.
        """


class ThisProcess:
    """Worker that plays the tasks one after the other in this process."""

    def play(self, work: Callable[[Task], Result], tasks: Iterator[Task]) -> Iterator[tuple[Task, Result]]:
        for task in tasks:
            yield task, work(task)


class Processes:
    """Worker processes of this machine, each in a pool of its own, so that the end of one does not affect the
    others."""

    def __init__(self, count: int) -> None:
        if count < 1:
            raise ConfigurationError(f"there must be at least one worker, not {count}")
        _check_descriptors(count)
        self._count = count

    def play(self, work: Callable[[Task], Result], tasks: Iterator[Task]) -> Iterator[tuple[Task, Result]]:
        prepare()
        pools = [_pool() for _ in range(self._count)]
        busy: dict[Future[Result], tuple[int, Task, int]] = {}
        try:
            free = list(range(self._count))
            while True:
                while free and (task := next(tasks, None)) is not None:
                    number = free.pop()
                    busy[_submit(pools, number, work, task)] = (number, task, 0)
                if not busy:
                    return
                for future in wait(busy, return_when=FIRST_COMPLETED).done:
                    number, task, deaths = busy.pop(future)
                    try:
                        result = future.result()
                    except BrokenProcessPool as error:
                        _check_deaths(task, deaths + 1, error)
                        busy[_submit(pools, number, work, task)] = (number, task, deaths + 1)
                        continue
                    free.append(number)
                    yield task, result
        finally:
            for pool in pools:
                _end(pool)


class Dask:
    """Workers of a Dask cluster, by the address of its scheduler, such as ``tcp://host:8786``."""

    def __init__(self, address: str) -> None:
        """:raises ConfigurationError: Dask is not installed.
        :raises WorkerError: nobody answers there.
        """
        try:
            self._dask: Any = importlib.import_module("distributed")  # it ships no complete annotations
        except ImportError as error:
            raise ConfigurationError("--cluster needs Dask: pip install 'analogrig[cluster]'") from error
        for name in _TALKATIVE:
            logging.getLogger(name).setLevel(logging.CRITICAL)
        self._address = address
        try:
            self._client = self._dask.Client(address, timeout=_ANSWER_S)
        except (OSError, ValueError) as error:
            raise WorkerError(f"--cluster {address}: no scheduler answers ({error})") from error

    def play(self, work: Callable[[Task], Result], tasks: Iterator[Task]) -> Iterator[tuple[Task, Result]]:
        sent: dict[Any, Task] = {}

        def send() -> Any:
            task = next(tasks, None)
            if task is None:
                return None
            future = self._client.submit(work, task, pure=False)
            sent[future] = task
            return future

        hands = sum(self._client.nthreads().values()) * _IN_HAND
        if not hands:
            raise WorkerError(f"--cluster {self._address}: the scheduler has no workers")
        completed = self._dask.as_completed([future for future in (send() for _ in range(hands)) if future is not None])
        try:
            for future in completed:
                task = sent.pop(future)
                try:
                    result = future.result()
                except self._dask.KilledWorker as error:
                    raise WorkerError(f"{task}: the cluster lost every worker that tried it") from error
                another = send()
                if another is not None:
                    completed.add(another)
                yield task, result
        except (OSError, CancelledError) as error:  # Dask cancels the futures of a client that has lost its scheduler
            raise WorkerError(f"--cluster {self._address}: the connection to the scheduler is lost") from error
        finally:
            with contextlib.suppress(OSError, CancelledError):
                self._client.cancel(list(sent))

    def close(self) -> None:
        with contextlib.suppress(OSError, CancelledError):
            self._client.close()


def _submit(
    pools: list[ProcessPoolExecutor], number: int, work: Callable[[Task], Result], task: Task
) -> Future[Result]:
    """Submit a task to the pool of that number; replace the pool first if its worker has died, even while idle."""
    try:
        return pools[number].submit(work, task)
    except BrokenProcessPool:
        pools[number].shutdown(wait=False)
        pools[number] = _pool()
        return pools[number].submit(work, task)


def _pool() -> ProcessPoolExecutor:
    return ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("forkserver"), initializer=_begin)


def _begin() -> None:
    """Initialise a worker process: leave signals to the parent, and exit when the parent has gone."""
    leave_to_parent()
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    connection.wait([sentinel])
    os._exit(1)


def _end(pool: ProcessPoolExecutor) -> None:
    """End the worker of a pool at once, even in the middle of a task."""
    for process in list((getattr(pool, "_processes", None) or {}).values()):
        with contextlib.suppress(OSError, ValueError):
            process.kill()
    pool.shutdown(wait=True, cancel_futures=True)


def _check_deaths(task: object, deaths: int, error: Exception) -> None:
    if deaths >= MOST_DEATHS:
        raise WorkerError(f"{task}: {number_of(deaths, 'worker')} died over it, one after the other") from error
