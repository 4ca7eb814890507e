"""A device in a process of its own: what it answers there, what it leaves behind, and whether it hangs or crashes.

``python -m analogrig.testing.conformance.alone`` is that process. It reads the device and the record from its standard
input, and writes one line of JSON for each step to the descriptor that its argument names.
"""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from analogrig.errors import AnalogrigError

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


def play_alone(device: Mapping[str, Any], stimulus: Mapping[str, Any], limit_s: float) -> Alone:
    """Play a record on a device in a process of its own.

    :param device: description of the device in plain values.
    :param stimulus: table of a ``Stimulus``.
    :param limit_s: longest time of one play.
    """
    readable, writable = os.pipe()
    order = {"device": device, "stimulus": stimulus, "limit_s": limit_s, "path": sys.path}
    with subprocess.Popen(
        [sys.executable, "-m", __name__, str(writable)],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        pass_fds=(writable,),
        env={**os.environ, _MARK: uuid.uuid4().hex, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    ) as process:
        os.close(writable)
        stderr: list[bytes] = []
        drain = threading.Thread(target=lambda: stderr.append(process.stderr.read() if process.stderr else b""))
        drain.start()
        try:
            if process.stdin is not None:
                process.stdin.write(json.dumps(order).encode())
                process.stdin.close()
            return _follow(readable, process, limit_s, stderr)
        finally:
            os.close(readable)
            process.kill()
            drain.join(START_S)


def _follow(readable: int, process: subprocess.Popen[bytes], limit_s: float, stderr: list[bytes]) -> Alone:
    """Results from the lines of the process."""
    digests: list[Mapping[str, str]] = []
    step, wait_s, buffer = "starting", START_S, b""
    while True:
        if not select.select([readable], [], [], wait_s)[0]:
            return Alone(failure=f"hangs: {step} took longer than {wait_s:g} s")
        received = os.read(readable, 1 << 16)
        if not received:
            status = process.wait()
            how = signal.Signals(-status).name if status < 0 else f"status {status}"
            last = b"".join(stderr).decode(errors="replace").strip().splitlines()[-1:]
            return Alone(failure=f"ends its process with {how} while {step}{''.join(f': {each}' for each in last)}")
        *lines, buffer = (buffer + received).split(b"\n")
        for line in lines:
            match json.loads(line):
                case {"failure": failure}:
                    return Alone(failure=f"fails while {step}: {failure}")
                case {"left": left}:
                    return Alone(tuple(digests), tuple(left))
                case {"digests": played}:
                    digests.append(played)
                case {"step": step}:
                    wait_s = START_S if step == "connecting" else 2.0 * limit_s


# ------------------------------------------------------------------------------------------------- the process itself


def _main(fd: int) -> None:
    order = json.load(sys.stdin)
    sys.path[:] = order["path"]
    os.set_inheritable(fd, False)  # noqa: FBT003 - Python's name is a positional parameter

    def tell(**line: Any) -> None:
        os.write(fd, json.dumps(line).encode() + b"\n")

    try:
        tell(left=_left_after_rounds(order, tell))
    except AnalogrigError as error:
        tell(failure=str(error))


def _left_after_rounds(order: Mapping[str, Any], tell: Any) -> list[str]:
    """Open, play and close until a round leaves nothing; the first round, which may fill caches, does not count."""
    left: dict[str, set[str]] = {}
    for number in range(_MOST_ROUNDS):
        before = _resources()
        _play(order, tell)
        left = {kind: held - before[kind] for kind, held in _resources().items() if number < 2 or left.get(kind)}
        if number and not any(left.values()):
            break
    tell(step="ending the device's processes")
    names = [f"{kind} {name}" for kind, held in left.items() for name in sorted(held)]
    return [*names, *_processes_left(order["limit_s"])]


def _play(order: Mapping[str, Any], tell: Any) -> None:
    from analogrig.devices.registry import recorded
    from analogrig.testing.conformance.stimulus import Stimulus, play

    tell(step="connecting")
    with recorded(order["device"]).connect() as device:
        tell(step="playing")
        device.limit(order["limit_s"])
        tell(digests=play(device, Stimulus.from_table(order["stimulus"])).digests())
        tell(step="closing")


def _resources() -> dict[str, set[str]]:
    """Resources that this process holds, and names of shared memory on this machine, by kind."""
    return {
        "descriptor": {f"{path.name} ({os.path.realpath(path)})" for path in Path("/proc/self/fd").iterdir()},
        "thread": {thread.name for thread in threading.enumerate()},
        "shared memory": {path.name for path in _SHARED_MEMORY.glob("*")},
    }


def _processes_left(limit_s: float) -> list[str]:
    """Marked processes that do not end in time, beside this one."""
    until_s = time.monotonic() + limit_s
    left = {pid: name for pid, name in _marked().items() if not _ends(pid, until_s)}
    return [f"process {pid} ({name})" for pid, name in left.items()]


def _marked() -> dict[int, str]:
    """Names of the marked processes beside this one, by number."""
    mark = f"{_MARK}={os.environ[_MARK]}".encode()
    found = {}
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if int(process.name) != os.getpid() and mark in (process / "environ").read_bytes():
                found[int(process.name)] = (process / "comm").read_text().strip()
        except OSError:  # it has just ended, or belongs to somebody else
            continue
    return found


def _ends(pid: int, until_s: float) -> bool:
    """True if a process ends in time, or has ended."""
    try:
        fd = os.pidfd_open(pid)
    except ProcessLookupError:
        return True
    try:
        return bool(select.select([fd], [], [], max(0.0, until_s - time.monotonic()))[0])
    finally:
        os.close(fd)


if __name__ == "__main__":
    _main(int(sys.argv[1]))
