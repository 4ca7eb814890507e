"""The live bench in real time: samples, frames, processor time, memory, and hostile clients.

python -m tests.bench live [--parts PART ...] [--seconds S] [--hostile S] [--minutes M]

``--parts``: ``real-time`` (a recording, without a browser), ``screen`` (frames that a browser draws), ``hostile``
(hostile clients at each endpoint), ``memory``; all by default. ``--seconds``: length of the recording, and of the time
in the browser. ``--hostile``: time for hostile clients at each endpoint. ``--minutes``: machine time over which memory
is compared.
"""

# ruff: noqa: S311 - input drawn from a seed is no secret

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import random
import statistics
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

from playwright.sync_api import Page, sync_playwright
from websockets.asyncio.client import connect
from websockets.exceptions import WebSocketException

from analogrig.run import Run
from analogrig_live.commands import Tempo, Turn
from analogrig_live.foxglove import SUBPROTOCOL
from analogrig_live.live_session import LiveSession
from tests import tools
from tests.harness.live.benches import Action, scripted_session
from tests.harness.processes import descendants, marked

from .figure import Figure

SIGNALS = ("force", "displacement", "velocity", "net_force", "estimate K", "statistic")
PARTS = ("memory", "real-time", "screen", "hostile")
SCREEN_HZ = 30
"""Frames per second that one core must manage."""
TURN_S = 0.5
"""Time between two turns of a pot."""
_TICK_HZ = os.sysconf("SC_CLK_TCK")

NOTE = """\
The emulator plays 20,000 samples/s into the in-process device, an estimate every 64 samples.
One client shows four channels, an estimate and the statistic, and turns a pot twice a second.
Frames are drawn by Chromium without a graphics processor, at 1280 by 900 pixels. All
its processes share one core, and the server runs on the others.
Processor time and memory are those of the process `analogrig bench`. A turn is felt when the
first sample after it has been answered. Hostile clients send random and almost valid messages,
wrong tokens and origins, and read nothing; a driver works beside them."""


def figures(*options: str) -> Iterator[Figure]:
    """Figures of a bench in real time, under hostile clients, and over a long time."""
    parser = argparse.ArgumentParser(prog="live")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--hostile", type=float, default=60.0)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--quick", action="store_true")
    given = parser.parse_args(options)
    if "memory" in given.parts:  # first: it measures this process, in which the others leave their marks
        _announce(f"{given.minutes:g} minutes of machine time")
        yield from _memory(given.minutes)
    if "real-time" in given.parts:
        _announce(f"a recording of {given.seconds:g} s")
        yield from asyncio.run(_real_time(given.seconds))
    if "screen" in given.parts:
        _announce(f"a browser for {given.seconds:g} s")
        yield from _screen(given.seconds)
    for path in ("live", "foxglove") if "hostile" in given.parts else ():
        _announce(f"hostile clients at /{path} for {given.hostile:g} s")
        yield from asyncio.run(_hostile(path, given.hostile))


def _announce(text: str) -> None:
    print(f"live: {text}", file=sys.stderr, flush=True)


def cpu_s(*pids: int) -> float:
    """Processor time of processes so far."""
    stats = [Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split() for pid in pids]
    return sum(int(words[11]) + int(words[12]) for words in stats) / _TICK_HZ


def keep_on_one_core(*pids: int) -> None:
    """Let all threads of processes share one processor."""
    core = {max(os.sched_getaffinity(0))}
    for pid in pids:
        for thread in Path(f"/proc/{pid}/task").iterdir():
            with contextlib.suppress(ProcessLookupError):
                os.sched_setaffinity(int(thread.name), core)


class _Process:
    """Process ``analogrig bench``."""

    def __init__(self, folder: Path) -> None:
        command = [sys.executable, "-m", "analogrig.cli", "bench", "--no-open", "--json", "--out", str(folder)]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        self.address = json.loads(self._process.stdout.readline())["address"]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        self._process.wait()

    def socket(self, path: str = "live", **more: Any) -> Any:
        """Connection to an endpoint."""
        url, _, token = self.address.replace("http:", "ws:").replace("/?", f"/{path}?").partition("=")
        url = f"{url}={more.pop('token', token)}"
        more.setdefault("origin", self.address.partition("/?")[0])
        more.setdefault("subprotocols", [SUBPROTOCOL] if path == "foxglove" else None)
        return connect(url, max_size=None, **more)

    def cpu_s(self) -> float:
        """Processor time so far."""
        return cpu_s(self._process.pid)

    def memory_mb(self, key: str = "VmHWM") -> float:
        """Largest resident set so far, or the present one (VmRSS)."""
        lines = Path(f"/proc/{self._process.pid}/status").read_text().splitlines()
        return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(f"{key}:"))


async def _real_time(seconds: float) -> list[Figure]:
    with tempfile.TemporaryDirectory() as folder, _Process(Path(folder)) as bench:
        async with bench.socket() as socket:
            await _tell(socket, "view", signals=SIGNALS, samples=2000, trigger={"source": SIGNALS[0], "level": 5.0})
            await _tell(socket, "record", on=True)
            began_s, cpu_s = time.monotonic(), bench.cpu_s()
            frames, felt_ms, state = await _watch(socket, seconds)
            spent_s, used_s = time.monotonic() - began_s, bench.cpu_s() - cpu_s
            await _tell(socket, "record", on=False)
            while not state["saved"]:
                state = await _state(socket)
            run = Run.load(Path(state["saved"][0]["run"]))
            memory_mb = bench.memory_mb()
    lost = int(run.lost.sum()) + int(run.conditions.counters.get("samples_lost", 0))
    behind = f"{state['overruns']} behind real time"
    return [
        Figure(f"samples recorded in {seconds:g} s", run.samples, "samples", compared_with=behind),
        Figure("samples lost in the recording", lost, "samples"),
        Figure("changes in the recording", len(run.conditions.scenario["changes"]), "changes"),
        Figure("frames", frames / spent_s, "Hz"),
        Figure("processor time of the server", 100 * used_s / spent_s, "% of a core"),
        Figure("memory of the server", memory_mb, "MB"),
        Figure("pot to sample, median", statistics.median(felt_ms), "ms", bounds=(min(felt_ms), max(felt_ms))),
    ]


def _screen(seconds: float) -> Iterator[Figure]:
    """Frames that a browser draws without a graphics processor, and its processor time for each."""
    mark = str(uuid.uuid4())
    with tempfile.TemporaryDirectory() as folder, _Process(Path(folder)) as bench, sync_playwright() as playwright:
        environment: dict[str, str | float | bool] = {**os.environ, "ANALOGRIG_TEST_MARK": mark}
        path = tools.found("chromium")
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"], env=environment)
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.goto(bench.address)
        page.wait_for_selector("html[data-drawn]")
        for signal in SIGNALS[2:]:
            page.get_by_label("Add a signal").select_option(signal)
        page.get_by_label("Time base").select_option("0.1")
        page.wait_for_function("(rows) => document.querySelectorAll('#signals tbody tr').length === rows", arg=6)
        processes = {pid for parent in marked(mark) for pid in (parent, *descendants(parent))}
        keep_on_one_core(*processes)
        began_s, server_s, browser_s, frames = time.monotonic(), bench.cpu_s(), cpu_s(*processes), _drawn(page)
        page.wait_for_timeout(1000 * seconds)
        spent_s, server_s = time.monotonic() - began_s, bench.cpu_s() - server_s
        browser_s, frames = cpu_s(*processes) - browser_s, _drawn(page) - frames
        browser.close()
    browser_part, server_part = browser_s / frames * SCREEN_HZ, server_s / spent_s
    yield Figure("frames drawn by the browser on one core", frames / spent_s, "Hz")
    yield Figure("processor time of the browser for a frame", 1000 * browser_s / frames, "ms")
    yield Figure("processor time of the server beside it", 100 * server_part, "% of a core")
    yield Figure(f"browser and server at {SCREEN_HZ} Hz", 100 * (browser_part + server_part), "% of a core")


def _drawn(page: Page) -> int:
    return int(page.evaluate("document.documentElement.dataset.frames"))


async def _watch(socket: Any, seconds: float) -> tuple[int, list[float], dict[str, Any]]:
    """Turn a pot for so long; return the number of frames, the times until turns were felt, and the last state."""
    frames, felt_ms, state, turned = 0, [], {"felt_ms": None}, 0
    until_s = time.monotonic() + seconds
    next_s = time.monotonic() + 1.0
    while time.monotonic() < until_s:
        if time.monotonic() >= next_s:
            next_s += TURN_S
            turned += 1
            await _tell(socket, "turn", name="K", value=24500.0 if turned % 2 else 22000.0)
        message = await socket.recv()
        if isinstance(message, bytes):
            frames += 1
        elif "state" in (table := json.loads(message)):
            felt = table["state"]["felt_ms"]
            if felt is not None and felt != state["felt_ms"]:
                felt_ms.append(felt)
            state = table["state"]
    return frames, felt_ms, state


async def _tell(socket: Any, name: str, /, **table: Any) -> None:
    await socket.send(json.dumps({"do": name, **table}))


async def _state(socket: Any) -> dict[str, Any]:
    while True:
        message = await socket.recv()
        if isinstance(message, str) and "state" in (table := json.loads(message)):
            state: dict[str, Any] = table["state"]
            return state


WORDS: tuple[Any, ...] = (
    *("view", "turn", "generate", "record", "drive", "step", "tempo", "subscribe", "setParameters", "K"),
    *(0, 1, -1, 1e9, 2**70, 1e308, True, None, "", [], {}, [[]], {"id": 1, "channelId": 1}, "\x00", "é" * 100),
)
KEYS = ("do", "op", "id", "name", "value", "signals", "samples", "trigger", "on", "subscriptions", "parameters")


def hostile_message(draw: random.Random) -> str | bytes:
    """Random message, some almost valid."""
    kind = draw.randrange(8)
    if kind == 0:
        return draw.randbytes(draw.randrange(9000))
    if kind == 1:
        return "".join(chr(draw.randrange(1, 0xD7FF)) for _ in range(draw.randrange(2000)))
    if kind == 2:
        return "[" * draw.randrange(8000)
    return json.dumps({draw.choice(KEYS): draw.choice(WORDS) for _ in range(draw.randrange(6))})


async def _hostile(path: str, seconds: float) -> list[Figure]:
    """Hostile clients at an endpoint, beside a driver."""
    with tempfile.TemporaryDirectory() as folder, _Process(Path(folder)) as bench:
        async with bench.socket() as socket:
            await _state(socket)
            before_mb = bench.memory_mb("VmRSS")
            until_s = time.monotonic() + seconds
            attacks = [asyncio.create_task(_attack(bench, path, seed, until_s)) for seed in range(6)]
            answers_ms: list[float] = []
            while time.monotonic() < until_s:
                began_s = time.monotonic()
                await _tell(socket, "turn", name="K", value=20000.0, id=len(answers_ms))
                await _answer(socket, len(answers_ms))
                answers_ms.append(1000 * (time.monotonic() - began_s))
            sent = sum(await asyncio.gather(*attacks))
            state = await _state(socket)
            growth_mb = bench.memory_mb() - before_mb
    if not sent:
        raise RuntimeError("no hostile client got in")
    if not state["drives"] or state["values"]["K"] != 20000.0:
        raise RuntimeError(f"the driver was harmed: {state}")
    return [
        Figure(f"hostile messages at /{path} in {seconds:g} s", sent, "messages"),
        Figure(f"growth of memory, /{path}", growth_mb, "MB"),
        Figure(f"answers to the driver beside /{path}, median", statistics.median(answers_ms), "ms"),
    ]


async def _answer(socket: Any, number: int) -> None:
    while True:
        message = await socket.recv()
        if isinstance(message, str) and json.loads(message).get("re") == number:
            return


async def _attack(bench: _Process, path: str, seed: int, until_s: float) -> int:
    draw, sent = random.Random(seed), 0
    while time.monotonic() < until_s:
        with contextlib.suppress(OSError, WebSocketException, TimeoutError):
            if draw.random() < 0.2:
                async with bench.socket(path, origin=draw.choice(("http://evil.example", "null", None))):
                    pass
            if draw.random() < 0.2:
                async with bench.socket(path, token=draw.choice(("", "no", "x" * 1000))):
                    pass
            async with bench.socket(path, close_timeout=0.1) as socket:
                for _ in range(draw.randrange(1, 200)):
                    await socket.send(hostile_message(draw))
                    sent += 1
                    await asyncio.sleep(0)
    return sent


def _memory(minutes: float) -> Iterator[Figure]:
    """Growth of this process while a session plays so many minutes of machine time, after the first.

    A hand turns a pot in every second.
    """
    seen: list[float] = []

    def note(_: LiveSession) -> None:
        lines = Path("/proc/self/status").read_text().splitlines()
        seen.append(next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmRSS:")))

    fast = 1e-3
    turns = [(fast * s, Turn("K", 22000.0 + 500.0 * (s % 2))) for s in range(1, int(60.0 * minutes))]
    script: list[tuple[float, Action]] = [
        (60.0 * fast, note),
        (60.0 * minutes * fast, note),
        (0.0, Tempo(fast)),
        *turns,
    ]
    script.sort(key=lambda each: each[0])
    with tempfile.TemporaryDirectory() as folder:
        scripted_session(script, Path(folder))
    yield Figure(f"growth of memory from 1 to {minutes:g} minutes of machine time", seen[1] - seen[0], "MB")
