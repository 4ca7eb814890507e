"""Signals that end a command: SIGINT, SIGTERM and SIGHUP are all handled like Ctrl-C.

Only the command line installs handlers (``raise_signals``). As a library, analogrig leaves the signals of its host
alone.
"""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Iterator
from types import FrameType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import asyncio

__all__ = ["signal_future"]
"""Names for packages beside the core."""

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

AGAIN_S = 1.0
"""Time within which a signal repeats the first one: ``timeout`` and shells send the same request twice."""


class Interrupted(KeyboardInterrupt):
    """A signal that ends the command; its text is the name of the signal.

    A subclass, because a plain KeyboardInterrupt can make Python end itself by SIGINT, regardless of the exit status.
    It does so once the exception has passed through code compiled from text, such as a dataclass being defined.
    """


class _Handler:
    """Raise Interrupted at the first signal; end the process at a later one."""

    def __init__(self) -> None:
        self._first_s: float | None = None
        self._holds = 0
        self._held = ""
        """Name of the signal that waits for the end of ``hold_signals``."""
        self.first = ""
        """Name of the first signal."""

    def __call__(self, number: int, _: FrameType | None) -> None:
        now_s = time.monotonic()
        if self._first_s is None:
            self._first_s = now_s
            self._held = self.first = signal.Signals(number).name
            self._raise()
        elif now_s - self._first_s >= AGAIN_S:
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)

    def hold(self) -> None:
        self._holds += 1

    def release(self) -> None:
        self._holds -= 1
        self._raise()

    def _raise(self) -> None:
        if self._held and not self._holds:
            name, self._held = self._held, ""
            raise Interrupted(name)


_handlers: list[_Handler] = []
"""Handler installed by ``raise_signals``, while it is in force."""


@contextlib.contextmanager
def raise_signals() -> Iterator[None]:
    """Raise Interrupted in the block at the first of ``ENDING``, and end the process at a later one.

    A signal that the parent has set to be ignored (``nohup``) stays ignored; one that has a handler keeps it.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handler = _Handler()
    before = {number: signal.getsignal(number) for number in ENDING}
    taken = [number for number, each in before.items() if each in (signal.SIG_DFL, signal.default_int_handler)]
    _handlers.append(handler)
    for number in taken:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number in taken:
            signal.signal(number, before[number])
        _handlers.remove(handler)


def interruption(error: BaseException | None) -> KeyboardInterrupt | None:
    """Interruption that is or caused ``error``; None if there is none.

    A module in C that is interrupted while it is imported raises an ImportError, caused by the interruption. A pool of
    workers that is interrupted while it starts raises a RuntimeError as it joins a thread that has not begun.
    """
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or (error.__context__ if isinstance(error, ImportError | RuntimeError) else None)
    return error


@contextlib.contextmanager
def hold_signals() -> Iterator[None]:
    """Delay a first signal until the block ends, so that a file being written is written in full."""
    handler = _handlers[-1] if _handlers and threading.current_thread() is threading.main_thread() else None
    if handler is None:
        yield
        return
    handler.hold()
    try:
        yield
    finally:
        handler.release()


def signal_future() -> asyncio.Future[int]:
    """In a running event loop: a future that raises Interrupted at a signal that ends the command.

    A later signal ends the process. There, a handler that raises would end the task that happens to run at that moment.
    """
    import asyncio

    loop = asyncio.get_running_loop()
    ended: asyncio.Future[int] = loop.create_future()

    def end(name: str) -> None:
        if not ended.done():
            ended.set_exception(Interrupted(name))
            loop.call_later(AGAIN_S, obey)

    def obey() -> None:
        for number in ENDING:
            if loop.remove_signal_handler(number):
                signal.signal(number, signal.SIG_DFL)

    for number in ENDING:
        if signal.getsignal(number) is not signal.SIG_IGN:
            loop.add_signal_handler(number, end, number.name)
    if _handlers and _handlers[-1].first:  # what Interrupted is raised in may swallow it, such as a finalizer
        end(_handlers[-1].first)
    return ended


def leave_to_parent() -> None:
    """In a worker process: ignore the signals that end the command, which its parent answers.

    A handler, and not SIG_IGN: programs that the worker starts must not inherit it.
    """
    for number in ENDING:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, lambda *_: None)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING)
