"""Workers that play the tasks of a campaign: this process, processes of this machine, or a cluster of Dask.

Each takes tasks when it has capacity, and yields results in any order. Processes and cluster are executors of
concurrent.futures. Only the tasks in flight on a killed worker are given to another. A task that has killed
``MOST_DEATHS`` workers ends the campaign.
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
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import connection, forkserver, resource_tracker
from pathlib import Path
from typing import Any, Protocol, TypeVar

from analogrig.errors import ConfigurationError, WorkerError
from analogrig.signals import ENDING, leave_to_parent
from analogrig.wording import number_of

Task = TypeVar("Task")
Result = TypeVar("Result")

_LOADED = ("analogrig.campaigns.plays", "analogrig.campaigns.certificate")
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


class CampaignWorkers(ABC):
    """Workers that a campaign can use."""

    @property
    @abstractmethod
    def slots(self) -> int:
        """Number of tasks that can be in flight."""

    @abstractmethod
    def play(self, work: Callable[[Task], Result], tasks: Iterator[Task]) -> Iterator[tuple[Task, Result]]:
        """Yield each task with its result, as ``Workers.play``."""

    def supply(self, files: Mapping[str, bytes]) -> None:  # noqa: B027 - workers of this machine need nothing
        """Bring the files that devices run to workers on other machines; ``files``: contents by hash."""


class ThisProcess(CampaignWorkers):
    """Worker that plays the tasks one after the other in this process."""

    slots = 1

    def play(self, work: Callable[[Task], Result], tasks: Iterator[Task]) -> Iterator[tuple[Task, Result]]:
        for task in tasks:
            yield task, work(task)


class _Executors(CampaignWorkers):
    """Workers behind executors of concurrent.futures."""

    _broken: type[Exception] = BrokenProcessPool
    """Error of a task whose worker has died."""
    _most_deaths = MOST_DEATHS
    _complaint = f"{number_of(MOST_DEATHS, 'worker')} died over it, one after the other"

    def play(self, work: Callable[[Task], Result], tasks: Iterator[Task]) -> Iterator[tuple[Task, Result]]:
        busy: dict[Future[Result], tuple[int, Task, int]] = {}
        try:
            self._start()
            free = list(range(self.slots))
            while True:
                while free and (task := next(tasks, None)) is not None:
                    slot = free.pop()
                    busy[self._submit(slot, work, task)] = (slot, task, 0)
                if not busy:
                    return
                for future in wait(busy, return_when=FIRST_COMPLETED).done:
                    slot, task, deaths = busy.pop(future)
                    try:
                        result = future.result()
                    except self._broken as error:
                        if deaths + 1 >= self._most_deaths:
                            raise WorkerError(f"{task}: {self._complaint}") from error
                        busy[self._submit(slot, work, task)] = (slot, task, deaths + 1)
                        continue
                    free.append(slot)
                    yield task, result
        finally:
            self._end()

    @abstractmethod
    def _start(self) -> None:
        """Prepare for the first task."""

    @abstractmethod
    def _submit(self, slot: int, work: Callable[[Task], Result], task: Task) -> Future[Result]:
        """Start a task in a slot."""

    @abstractmethod
    def _end(self) -> None:
        """End all tasks at once, even in the middle of one."""


class Processes(_Executors):
    """Worker processes of this machine, each in a pool of its own, so that the end of one does not affect the
    others."""

    def __init__(self, count: int) -> None:
        if count < 1:
            raise ConfigurationError(f"there must be at least one worker, not {count}")
        _check_descriptors(count)
        self._slots = count
        self._pools: list[ProcessPoolExecutor] = []

    @property
    def slots(self) -> int:
        return self._slots

    def _start(self) -> None:
        prepare()
        self._pools = [_pool() for _ in range(self.slots)]

    def _submit(self, slot: int, work: Callable[[Task], Result], task: Task) -> Future[Result]:
        try:
            return self._pools[slot].submit(work, task)
        except BrokenProcessPool:  # its worker has died while it had no task
            self._pools[slot].shutdown(wait=False)
            self._pools[slot] = _pool()
            return self._pools[slot].submit(work, task)

    def _end(self) -> None:
        for pool in self._pools:
            for process in list((getattr(pool, "_processes", None) or {}).values()):
                with contextlib.suppress(OSError, ValueError):
                    process.kill()
            pool.shutdown(wait=True, cancel_futures=True)


class _FileSupply:
    """Start of a worker of a cluster, also of one that joins later: it keeps the files of the campaign's devices."""

    def __init__(self, files: Mapping[str, bytes]) -> None:
        self._files = dict(files)

    def __call__(self, worker: Any) -> None:
        from analogrig.campaigns.builds import supply

        supply(self._files, Path(worker.local_directory))


class Dask(_Executors):
    """Workers of a Dask cluster, by the address of its scheduler, such as ``tcp://host:8786``."""

    _most_deaths = 1  # the scheduler has tried several by then
    _complaint = "the cluster lost every worker that tried it"

    def __init__(self, address: str) -> None:
        """:raises ConfigurationError: Dask is not installed.
        :raises WorkerError: nobody answers there.
        """
        try:
            dask: Any = importlib.import_module("distributed")  # it ships no complete annotations
        except ImportError as error:
            raise ConfigurationError("--cluster needs Dask: pip install 'analogrig[cluster]'") from error
        for name in _TALKATIVE:
            logging.getLogger(name).setLevel(logging.CRITICAL)
        self._address, self._broken = address, dask.KilledWorker
        try:
            self._client = dask.Client(address, timeout=_ANSWER_S)
        except (OSError, ValueError) as error:
            raise WorkerError(f"--cluster {address}: no scheduler answers ({error})") from error

    def supply(self, files: Mapping[str, bytes]) -> None:
        if files:
            plugin: Any = type(
                "Files", (importlib.import_module("distributed").WorkerPlugin,), {"setup": _FileSupply(files)}
            )
            try:
                self._client.register_plugin(plugin(), name="analogrig-files")
            except (OSError, CancelledError) as error:
                raise WorkerError(f"--cluster {self._address}: the connection to the scheduler is lost") from error

    def play(self, work: Callable[[Task], Result], tasks: Iterator[Task]) -> Iterator[tuple[Task, Result]]:
        try:
            yield from super().play(work, tasks)
        except (OSError, CancelledError) as error:  # Dask cancels the futures of a client that has lost its scheduler
            raise WorkerError(f"--cluster {self._address}: the connection to the scheduler is lost") from error

    @property
    def slots(self) -> int:
        threads: int = sum(self._client.nthreads().values())
        return threads * _IN_HAND

    def _start(self) -> None:
        if not self.slots:
            raise WorkerError(f"--cluster {self._address}: the scheduler has no workers")
        self._executor = self._client.get_executor(pure=False)

    def _submit(self, slot: int, work: Callable[[Task], Result], task: Task) -> Future[Result]:  # noqa: ARG002
        future: Future[Result] = self._executor.submit(work, task)
        return future

    def _end(self) -> None:
        with contextlib.suppress(OSError, CancelledError, AttributeError):
            self._executor.shutdown(wait=False)

    def close(self) -> None:
        with contextlib.suppress(OSError, CancelledError):
            self._client.close()


def _pool() -> ProcessPoolExecutor:
    return ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("forkserver"), initializer=_begin)


def _begin() -> None:
    """Initialise a worker process: leave signals to the parent, and exit when the parent has gone."""
    leave_to_parent()
    if (parent := multiprocessing.parent_process()) is not None:

        def end_with_parent() -> None:
            connection.wait([parent.sentinel])
            os._exit(1)

        threading.Thread(target=end_with_parent, daemon=True).start()
