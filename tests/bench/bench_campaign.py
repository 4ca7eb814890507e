"""Campaigns of many trials: time, memory, sizes, comparison, and the same results after ten kills.

python -m tests.bench campaign [--trials N] [--stored N]

``--trials``: trials of 300 samples that are played three times, once on a Dask cluster of this machine and once killed
ten times on the way. ``--stored``: trials that are stored, counted, shown and compared without being played: copies of
some played ones, with errors and hashes of their own. With 0 the page keeps the figures of the last such run.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from analogrig.campaigns.conduct import Task, conduct
from analogrig.campaigns.plan import Part, Plan
from analogrig.campaigns.plays import PlayedTask, play_part, play_task
from analogrig.campaigns.spec import CampaignSpec
from analogrig.campaigns.trials import Trials, columns_of, encode
from analogrig.campaigns.workers import ThisProcess
from analogrig.reporting.campaign_page import write_json, write_page
from tests import tools

from .figure import Figure

CELLS, KILLS, WORKERS = 25, 10, 2

DEVICE = """\
kind = "inproc"
[estimator]
warm_up_n = 100
"""
"""Device whose trigger is armed before the change."""

SPEC = """\
devices = ["early.toml"]
samples = 300
change_at = 200
trials = {trials}
name = "{name}"
[grid]
stiffness_factor = [0.7, 0.8, 0.9, 0.95, 0.98]
B = [2500.0, 2750.0, 3021.0, 3200.0, 3400.0]
"""

WORKER_TASKS, WORKER_TRIALS = 8, 500

COPIED = 200
"""Trials of each cell that are played for ``--stored``."""

NOTE = f"""\
Played trials have 300 samples, in {CELLS} cells. {WORKERS} local workers play them. A Dask cluster of {WORKERS}
workers on this machine plays them again. A third time, SIGKILL ends the command {KILLS} times. The time
of a worker is that of one process without a command. Stored trials are copies of played ones, which
go through the same store, tally, page and comparison. Memory is the largest resident set of the
command and of any of its workers."""


def figures(*options: str) -> Iterator[Figure]:
    """Figures of campaigns that are played, and of those that are only stored."""
    parser = argparse.ArgumentParser(prog="campaign")
    parser.add_argument("--trials", type=int, default=100_000)
    parser.add_argument("--stored", type=int, default=1_000_000)
    arguments, _ = parser.parse_known_args(options)
    with tempfile.TemporaryDirectory() as folder:
        if arguments.trials:
            yield from _played(Path(folder), arguments.trials)
        if arguments.stored:
            yield from _stored(Path(folder), arguments.stored)


def _played(folder: Path, trials: int) -> Iterator[Figure]:
    spec = _spec(folder, "played", trials)
    whole, killed = folder / "whole.sqlite", folder / "killed.sqlite"
    of = "trials played"
    yield Figure(of, trials, "trials")
    yield Figure(f"{of}: CPU time of a worker", _worker_us(spec), "us a trial")
    wall_s, cpu_s, memory_mb = _measured("campaign", str(spec), "--workers", str(WORKERS), "--out", str(whole))
    yield Figure(f"{of}: time on the wall", wall_s, "s")
    yield Figure(f"{of}: CPU time of the command without its workers", 1e3 * cpu_s / trials, "ms a trial")
    yield Figure(f"{of}: memory", memory_mb, "MB")
    yield from _sizes(of, whole)
    yield from _on_dask(of, spec, whole, wall_s)
    kills = _kill_on_the_way(spec, killed, trials)
    _measured("campaign", str(spec), "--workers", str(WORKERS), "--out", str(killed))
    same = whole.with_suffix(".json").read_bytes() == killed.with_suffix(".json").read_bytes()
    yield Figure(f"{of}: results with the same bytes after {kills} kills", float(same), "of 1")
    yield from _compared(of, whole, killed)


def _worker_us(spec: Path) -> float:
    """CPU time of a worker for each trial: the best of some tasks."""
    plan = Plan.of(CampaignSpec.load(str(spec)))
    text, best_s = plan.as_json(), float("inf")
    for task in range(WORKER_TASKS):
        start_s = time.process_time()
        play_task(text, [Part(task % plan.size, 0, min(WORKER_TRIALS, plan.spec.trials))])
        best_s = min(best_s, time.process_time() - start_s)
    return 1e6 * best_s / min(WORKER_TRIALS, plan.spec.trials)


def _on_dask(of: str, spec: Path, whole: Path, local_s: float) -> Iterator[Figure]:
    """The same campaign on a cluster of this machine, whose start is left out, beside local workers."""
    from distributed import LocalCluster

    out = whole.with_name("dask.sqlite")
    with LocalCluster(  # type: ignore[no-untyped-call]  # Dask is annotated in part
        n_workers=WORKERS, threads_per_worker=1, dashboard_address=None, host="127.0.0.1", silence_logs=logging.CRITICAL
    ) as cluster:
        wall_s, _, _ = _measured("campaign", str(spec), "--cluster", cluster.scheduler_address, "--out", str(out))
    same = whole.with_suffix(".json").read_bytes() == out.with_suffix(".json").read_bytes()
    yield Figure(f"{of} on Dask: time on the wall", wall_s, "s", "local workers", ratio=local_s / wall_s)
    yield Figure(f"{of} on Dask: results with the same bytes", float(same), "of 1")


def _stored(folder: Path, trials: int) -> Iterator[Figure]:
    of = "trials stored"
    yield Figure(of, trials, "trials")
    files = []
    for number, name in enumerate("ab"):
        plan = Plan.of(CampaignSpec.load(str(_spec(folder, f"stored-{name}", trials))))
        files.append(folder / f"{name}.sqlite")
        start_s = time.process_time()
        results = conduct(plan, _Copier(plan, number), files[-1])
        write_json(results, files[-1].with_suffix(".json"))
        write_page(results, files[-1].with_suffix(".html"))
        if not number:
            yield Figure(
                f"{of}: CPU time, copying included", 1e6 * (time.process_time() - start_s) / trials, "us a trial"
            )
    yield from _sizes(of, files[0])
    spec = str(folder / "stored-a.toml")
    wall_s, _, memory_mb = _measured("campaign", spec, "--out", str(files[0]))
    yield Figure(f"{of}: results and page from the store", wall_s, "s on the wall")
    yield Figure(f"{of}: results and page from the store, memory", memory_mb, "MB")
    yield from _compared(of, *files)


class _Copier(ThisProcess):
    """Worker that returns copies of some played trials, with other errors and hashes."""

    def __init__(self, plan: Plan, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        text = plan.as_json()
        self._played = [columns_of(play_part(text, Part(cell, 0, COPIED))) for cell in range(plan.size)]

    def play(  # type: ignore[override]  # narrower than the protocol
        self,
        work: Callable[[Task], PlayedTask],  # noqa: ARG002 - it copies instead
        tasks: Iterator[Task],
    ) -> Iterator[tuple[Task, PlayedTask]]:
        for task in tasks:
            parts = [(part, encode(self._copy(part))) for part in task]
            yield task, PlayedTask(parts, 2e-3 * sum(part.trials for part in task))

    def _copy(self, part: Part) -> Trials:
        places = (part.first + np.arange(part.trials)) % COPIED
        copied = self._played[part.cell][places]
        copied["error"] *= self._rng.normal(1.0, 0.1, copied["error"].shape).astype(np.float32)
        copied["theta"] = self._rng.integers(1, 2**63, part.trials)
        return copied


def _spec(folder: Path, name: str, trials: int) -> Path:
    path = folder / f"{name}.toml"
    (folder / "early.toml").write_text(DEVICE)
    path.write_text(SPEC.format(trials=max(1, trials // CELLS), name=name.partition("-")[0]))
    return path


def _measured(*command: str) -> tuple[float, float, float]:
    """Time on the wall, CPU time and largest memory in MB of a command and its workers."""
    start_s = time.perf_counter()
    # A process starts with the memory of its parent: a small one stands between this one and the command.
    words = [sys.executable, "-S", "-c", _LAUNCHER, sys.executable, "-m", "analogrig.cli", *command]
    told = subprocess.run(words, stdout=subprocess.PIPE, check=True, text=True).stdout
    status, cpu_s, memory_kb = json.loads(told.splitlines()[-1])
    if status not in (0, 1):
        raise RuntimeError(f"{' '.join(command)} ended with {status}")
    return time.perf_counter() - start_s, cpu_s, memory_kb / 1024.0


_LAUNCHER = """
import resource, subprocess, sys
status = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL).returncode
usage = resource.getrusage(resource.RUSAGE_CHILDREN)
print([status, usage.ru_utime + usage.ru_stime, usage.ru_maxrss])
"""


def _kill_on_the_way(spec: Path, out: Path, trials: int) -> int:
    """Kill the command KILLS times, each time after another share of the trials; return the number of kills."""
    command = [
        sys.executable,
        "-m",
        "analogrig.cli",
        "campaign",
        str(spec),
        "--workers",
        str(WORKERS),
        "--out",
        str(out),
    ]
    kills = 0
    for share in range(1, KILLS + 1):
        with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
            while process.poll() is None and _bytes_of(out) < share * 30 * trials / (KILLS + 1):
                time.sleep(0.05)
            kills += process.poll() is None
            process.kill()
    return kills


def _bytes_of(out: Path) -> int:
    """Size of a store and its log."""
    return sum(path.stat().st_size for path in (out, out.with_name(f"{out.name}-wal")) if path.exists())


def _sizes(of: str, out: Path) -> Iterator[Figure]:
    yield Figure(f"{of}: store", out.stat().st_size / 1e6, "MB")
    yield Figure(f"{of}: page", out.with_suffix(".html").stat().st_size / 1e6, "MB")
    yield Figure(f"{of}: page in Chromium, until it is drawn", _opened_s(out.with_suffix(".html")), "s")
    with contextlib.closing(sqlite3.connect(out)) as file:
        (parts,) = file.execute("SELECT count(*) FROM trials").fetchone()
    yield Figure(f"{of}: transactions' parts", parts, "rows")
    json.loads(out.with_suffix(".json").read_text())


def _opened_s(page: Path) -> float:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=tools.found("chromium"), args=["--no-sandbox"])
        shown = browser.new_page()
        start_s = time.perf_counter()
        shown.goto(page.absolute().as_uri())
        shown.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
        opened_s = time.perf_counter() - start_s
        browser.close()
        return opened_s


def _compared(of: str, a: Path, b: Path) -> Iterator[Figure]:
    wall_s, _, memory_mb = _measured("compare", str(a), str(b))
    yield Figure(f"{of}: compare with another such campaign", wall_s, "s on the wall")
    yield Figure(f"{of}: compare, memory", memory_mb, "MB")
