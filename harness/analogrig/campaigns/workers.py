"""Who plays the chunks of a campaign: this process, processes of this machine, or a cluster of Dask.

Each takes tasks as it has hands free and yields what came of them, in whatever order. What a worker that was killed had
in hand is given to another, nothing else; a task that is the end of ``MOST_DEATHS`` workers ends the campaign.
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
"""What a worker is made of. The process that they are forked from loads it once, while this one reads its orders."""

MOST_DEATHS = 3
"""Workers that may be lost over one task."""

_DESCRIPTORS, _DESCRIPTORS_EACH = 48, 8
"""Files that must be allowed to be open at once, and those for each worker."""

_IN_HAND = 2
"""Tasks for each worker of a cluster, so that none waits for the way there and back."""

_ANSWER_S = 10
"""A scheduler that does not answer within so long is not there."""

_TALKATIVE = ("distributed", "distributed.client", "tornado.application", "asyncio")
"""Loggers that print tracebacks of a connection that is lost, which the WorkerError reports in one line."""


def prepare() -> None:
    """Begin to load, in the process that the workers of this machine are forked from, what they need.

    Worth a call before all else that takes long.

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
    """Refuse what would end halfway: the processes that fork workers report it by a traceback of their own.

    :raises ConfigurationError: too few files may be open.
    """
    allowed, needed = resource.getrlimit(resource.RLIMIT_NOFILE)[0], _DESCRIPTORS + _DESCRIPTORS_EACH * workers
    if allowed < needed:
        raise ConfigurationError(
            f"only {allowed} files may be open at once, and workers need {needed}:"
            " raise `ulimit -n`, or pass --workers 1"
        )


class Workers(Protocol):
    """Play tasks."""

    def play(self, work: Callable[[Task], Result], tasks: Iterator[Task]) -> Iterator[tuple[Task, Result]]:
        """Each task with its result. Tasks are taken one by one, when somebody can begin with them.

        :raises WorkerError: workers keep dying over a task, or cannot be reached.
        """


class ThisProcess:
    """One after the other, here."""

    def play(self, work: Callable[[Task], Result], tasks: Iterator[Task]) -> Iterator[tuple[Task, Result]]:
        for task in tasks:
            yield task, work(task)


class Processes:
    """Worker processes of this machine, each in a pool of its own: the end of one is not that of the others."""

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
    """The workers of a cluster, by the address of its scheduler, such as ``tcp://host:8786``."""

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
    """To the pool of that number, or to a new one in its place if its worker has died, be it while it had no task."""
    try:
        return pools[number].submit(work, task)
    except BrokenProcessPool:
        pools[number].shutdown(wait=False)
        pools[number] = _pool()
        return pools[number].submit(work, task)


def _pool() -> ProcessPoolExecutor:
    return ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("forkserver"), initializer=_begin)


def _begin() -> None:
    """In a worker: signals are for the parent, and without a parent there is nothing to do."""
    leave_to_parent()
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    connection.wait([sentinel])
    os._exit(1)


def _end(pool: ProcessPoolExecutor) -> None:
    """At once, whatever it is doing."""
    for process in list((getattr(pool, "_processes", None) or {}).values()):
        with contextlib.suppress(OSError, ValueError):
            process.kill()
    pool.shutdown(wait=True, cancel_futures=True)


def _check_deaths(task: object, deaths: int, error: Exception) -> None:
    if deaths >= MOST_DEATHS:
        raise WorkerError(f"{task}: {number_of(deaths, 'worker')} died over it, one after the other") from error
