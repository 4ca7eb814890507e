"""Live benches: on a simulated clock, whose hand acts at set times; and served in real time."""

from __future__ import annotations

import asyncio
import dataclasses
import json
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from analogrig.devices.device import Device
from analogrig.devices.registry import describe, open_dut
from analogrig.rigs.description import open_rig
from analogrig.rigs.rig import Block, Performance, Rig
from analogrig.scenario import Scenario
from analogrig_live.bench_command import NO_FAULTS, REPORT_INTERVAL_N
from analogrig_live.bench_server import BenchServer
from analogrig_live.commands import Command
from analogrig_live.live_session import LiveSession, Saved

SEED = 7

Action = Command | Callable[[LiveSession], None]


def linked() -> Device:
    """Device behind a line into which a hand can inject faults, as the command opens it."""
    return open_dut("inproc", exchange="block", report_interval_n=REPORT_INTERVAL_N, wire_faults=NO_FAULTS)


class RecordsRig(Rig):
    """Rig that plays whole records, as a real one does; calls ``begun`` with the scenario of each."""

    def __init__(self, begun: Callable[[Scenario], None]) -> None:
        self._begun = begun
        self._inner = open_rig("emulator")
        self.capabilities = self._inner.capabilities

    def perform(self, scenario: Scenario, seed: int) -> Performance:
        performance = self._inner.perform(scenario, seed)

        def blocks() -> Iterator[Block]:
            self._begun(scenario)
            yield from performance.blocks

        return dataclasses.replace(performance, blocks=blocks())

    def description(self) -> Mapping[str, Any]:
        return self._inner.description()


class ScriptedClock:
    """Clock that stands still but in waits, and acts when its time has come. The session ends after the last action."""

    def __init__(self, script: Sequence[tuple[float, Action]]) -> None:
        self.session: LiveSession | None = None
        self.now_s = 0.0
        self._script = list(script)

    def __call__(self) -> float:
        return self.now_s

    def wait(self, woken: threading.Event, seconds: float | None) -> None:
        """Advance to the next action, or by ``seconds``."""
        assert self.session is not None
        if woken.is_set():
            return
        until_s = self.now_s + (1e9 if seconds is None else seconds)
        if not self._script:
            self.session.close()
        elif self._script[0][0] <= until_s:
            at_s, action = self._script.pop(0)
            self.now_s = max(at_s, self.now_s)
            if callable(action):
                action(self.session)
            else:
                self.session.do(action)
        else:
            self.now_s = until_s


def scripted_session(
    script: Sequence[tuple[float, Action]],
    folder: Path,
    *,
    scenario: Scenario | None = None,
    rig: str | Rig = "emulator",
    dut: Device | None = None,
    on_saved: Callable[[Saved], None] | None = None,
) -> LiveSession:
    """Session that has played a script to its end; time is that of the machine. The device is closed."""
    clock = ScriptedClock(script)
    with open_rig(rig) if isinstance(rig, str) else rig as opened, dut or describe("inproc").direct() as device:
        played = scenario or Scenario.load("thesis")
        session = LiveSession(opened, played, device, SEED, folder=folder, clock=clock, on_saved=on_saved)
        clock.session = session
        session.run()
    return session


class LiveBench:
    """Bench that is served from a thread of its own, in real time: what ``analogrig bench`` does, without a process.

    It sends few frames a second, since drawing them is most of the work of a test in a browser.
    """

    def __init__(
        self,
        folder: Path,
        *,
        token: str = "",
        port: int = 0,
        device: Callable[[], Device] = lambda: describe("inproc").direct(),
        scenario: str | Scenario = "thesis",
        slow_s: float = 10.0,
        silent_s: float = 600.0,
    ) -> None:
        self._folder, self._device = folder, device
        self._scenario = Scenario.load(scenario) if isinstance(scenario, str) else scenario
        self._settings: dict[str, Any] = {"token": token, "slow_s": slow_s, "silent_s": silent_s, "frame_s": 0.1}
        self._port = port
        self._ready: Future[BenchServer] = Future()
        self._stop: asyncio.Event | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()))

    def __enter__(self) -> BenchServer:
        self._thread.start()
        return self._ready.result(60)

    def __exit__(self, *_: object) -> None:
        assert self._loop is not None
        assert self._stop is not None
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join()

    async def _serve(self) -> None:
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        with open_rig("emulator") as rig, self._device() as device:
            session = LiveSession(rig, self._scenario, device, SEED, folder=self._folder)
            playing = asyncio.create_task(asyncio.to_thread(session.run))
            try:
                server = BenchServer(session, **self._settings)
                await server.listen(port=self._port)
                self._ready.set_result(server)
                await self._stop.wait()
                await server.close()
            except BaseException as error:
                self._ready.set_exception(error)
                raise
            finally:
                session.close()
                await playing


@contextmanager
def benched(*options: str, folder: Path) -> Iterator[Any]:
    """Address and token of a running command. It is ended by SIGTERM; ``output`` is what it has printed until then."""
    command = [sys.executable, "-m", "analogrig.cli", "bench", "--no-open", "--json", "--out", str(folder), *options]
    bench = SimpleNamespace()
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            address = json.loads(process.stdout.readline())["address"]
            bench.address, bench.token = address, address.rpartition("=")[2]
            yield bench
        finally:
            process.send_signal(signal.SIGTERM)
            bench.output, errors = process.communicate()
    assert (process.returncode, errors) == (130, "analogrig: interrupted\n")
