"""A device in a process of its own: what it answers there, what it leaves behind, and whether it hangs or crashes.

``python -m analogrig.testing.conformance.alone`` is that process. It reads the device and the record from its standard
input, and writes one line of JSON for each step to the descriptor that its argument names.
"""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import select
import signal
import subprocess
import sys
import tempfile
import threading
import time
import uuid
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from analogrig.errors import AnalogrigError
from analogrig.testing.conformance.stimulus import Stimulus, play

START_S = 60.0
"""Longest time to start Python and to connect to the device."""

_MARK = "ANALOGRIG_CONFORMANCE"
"""Environment variable that marks the process and all that it starts."""

_MOST_ROUNDS = 5
_SHARED_MEMORY = Path("/dev/shm")  # noqa: S108 - looked at, not written


@dataclass(frozen=True)
class Alone:
    """Results of a device in a process of its own."""

    digests: tuple[Mapping[str, str], ...] = ()
    """Digests of the answers, of one device after another."""
    left: tuple[str, ...] = ()
    """Things that the closed devices left behind."""
    failure: str = ""
    """Reason why there are no results; empty if there are."""


def play_alone(device: Mapping[str, Any], stimulus: Stimulus, limit_s: float) -> Alone:
    """Play a record on a device in a process of its own.

    :param device: description of the device in plain values.
    :param limit_s: longest time of one play.
    """
    readable, writable = os.pipe()
    with tempfile.TemporaryFile() as order, tempfile.TemporaryFile() as stderr:
        pickle.dump((json.dumps(device), stimulus, limit_s), order)
        order.seek(0)
        with subprocess.Popen(
            [sys.executable, "-P", "-m", __name__, str(writable)],
            stdin=order,
            stdout=subprocess.DEVNULL,
            stderr=stderr,
            pass_fds=(writable,),
            env={**os.environ, _MARK: uuid.uuid4().hex, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        ) as process:
            os.close(writable)
            try:
                found, step = _follow(readable, limit_s)
                if found is not None:
                    return found
                status = process.wait()
            finally:
                os.close(readable)
                process.kill()
        stderr.seek(0)
        last = stderr.read().decode(errors="replace").strip().splitlines()[-1:]
    how = signal.Signals(-status).name if status < 0 else f"status {status}"
    return Alone(failure=f"ends its process with {how} while {step}{''.join(f': {each}' for each in last)}")


def _follow(readable: int, limit_s: float) -> tuple[Alone | None, str]:
    """Results from the lines of the process, None if it has ended before; and its last step."""
    digests: list[Mapping[str, str]] = []
    step, wait_s, buffer = "starting", START_S, b""
    while select.select([readable], [], [], wait_s)[0]:
        if not (received := os.read(readable, 1 << 16)):
            return None, step
        *lines, buffer = (buffer + received).split(b"\n")
        for line in lines:
            match json.loads(line):
                case {"failure": failure}:
                    return Alone(failure=f"fails while {step}: {failure}"), step
                case {"left": left}:
                    return Alone(tuple(digests), tuple(left)), step
                case {"digests": played}:
                    digests.append(played)
                case {"step": step}:
                    wait_s = START_S if step == "connecting" else 2.0 * limit_s
    return Alone(failure=f"hangs: {step} took longer than {wait_s:g} s"), step


# ------------------------------------------------------------------------------------------------- the process itself


def _main(fd: int) -> None:
    device, stimulus, limit_s = pickle.load(sys.stdin.buffer)  # noqa: S301 - written by play_alone
    os.set_inheritable(fd, False)  # noqa: FBT003 - Python's name is a positional parameter

    def tell(**line: Any) -> None:
        os.write(fd, json.dumps(line).encode() + b"\n")

    try:
        left = _left_after_rounds(lambda: _play(json.loads(device), stimulus, limit_s, tell))
        tell(step="ending the device's processes")
        tell(left=[*left, *_processes_left(limit_s)])
    except AnalogrigError as error:
        tell(failure=str(error))


def _left_after_rounds(play_round: Callable[[], None]) -> list[str]:
    """Open, play and close until a round leaves nothing; the first round, which may fill caches, does not count."""
    left: dict[str, set[str]] = {}
    for number in range(_MOST_ROUNDS):
        before = _resources()
        play_round()
        left = {kind: held - before[kind] for kind, held in _resources().items() if number < 2 or left.get(kind)}
        if number and not any(left.values()):
            break
    return [f"{kind} {name}" for kind, held in left.items() for name in sorted(held)]


def _play(description: Mapping[str, Any], stimulus: Stimulus, limit_s: float, tell: Callable[..., None]) -> None:
    from analogrig.devices.registry import recorded

    tell(step="connecting")
    with recorded(description).connect() as device:
        tell(step="playing")
        device.limit(limit_s)
        tell(digests=play(device, stimulus).digests)
        tell(step="closing")


def _resources() -> dict[str, set[str]]:
    """Resources that this process holds, and names of shared memory on this machine, by kind."""
    return {
        "descriptor": {f"{path.name} ({os.path.realpath(path)})" for path in Path("/proc/self/fd").iterdir()},
        "thread": {thread.name for thread in threading.enumerate()},
        "shared memory": {path.name for path in _SHARED_MEMORY.glob("*")},
    }


def _processes_left(limit_s: float) -> list[str]:
    """Marked processes beside this one that do not end in time."""
    mark = f"{_MARK}={os.environ[_MARK]}".encode()
    until_s = time.monotonic() + limit_s
    left = []
    for process in Path("/proc").glob("[0-9]*"):
        pid = int(process.name)
        with contextlib.suppress(OSError):  # it has just ended, or belongs to somebody else
            if pid != os.getpid() and mark in (process / "environ").read_bytes():
                name = (process / "comm").read_text().strip()
                fd = os.pidfd_open(pid)
                if not select.select([fd], [], [], max(0.0, until_s - time.monotonic()))[0]:
                    left.append(f"process {pid} ({name})")
                os.close(fd)
    return left


if __name__ == "__main__":
    _main(int(sys.argv[1]))
