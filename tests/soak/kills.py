"""Commands killed at random instants: what they leave behind, and whether they leave it.

    python -m tests.soak.kills [KILLS] [SEED]     so many of each command by each signal (40)

After every kill there is no process of the command, no result of an earlier command that looks like one of it, and no
part of a result that looks whole.
"""

# ruff: noqa: S311, T201 - the instants are drawn from a seed and are no secret; a program prints

from __future__ import annotations

import contextlib
import itertools
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from websockets import Origin
from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

from analogrig.campaigns.store import Store
from analogrig.campaigns.tally import Results
from analogrig.config import read_toml
from analogrig.judging.verdict import judge
from analogrig.run import Run
from analogrig.scenario import Scenario
from tests.harness.processes import gone, with_default_signals

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL)

AT_WORK_S = 1.0
"""Time of work with a command that does not end."""
LONG_S = 300.0
"""For what takes seconds unless something is broken."""

CAMPAIGN = 'trials = 12\nchunk = 2\nsamples = 700\ndevices = ["host"]\n'


@dataclass(frozen=True)
class Case:
    """A command, and what it may leave in its folder."""

    words: tuple[str, ...]
    check: Callable[[Path, Path], None]
    """Told the folder as it is, and as it was before the command."""
    ends: bool = True
    """True if the command ends by itself."""
    at_work: Callable[[subprocess.Popen[bytes]], object] | None = None
    """Work with a command that does not end, until it does."""


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def check_run(now: Path, before: Path) -> None:
    """Either untouched, or marked, or the whole result of this command."""
    out, older = now / "out", contents(before / "out")
    found = contents(out)
    if found == older:
        return
    verdict = json.loads(found["verdict.json"])
    (outcome,) = re.findall(r'class="outcome (\w+)"', found["report.html"].decode())
    assert verdict["outcome"] == outcome, f"verdict.json: {verdict['outcome']}, page: {outcome}"
    assert found["verdict.json"] != older["verdict.json"], "an older verdict"
    assert set(found) <= set(older), f"unknown files: {set(found) - set(older)}"
    if "run.npz" in found:
        assert found["run.npz"] != older["run.npz"], "an older recording"
        assert judge(Run.load(out / "run.npz")).outcome == outcome
    else:
        assert outcome == "inconclusive"
    assert contents(now / "out.previous") == older, "the older results are lost"


def check_campaign(now: Path, before: Path) -> None:
    """No results, or all of them; never the older page without results."""
    results, page = now / "out.sqlite", now / "out.html"
    is_ended = False
    if results.exists():
        with Store.read(results) as store:
            is_ended = store.is_ended
    if is_ended:
        Results.load(results)  # which has every trial of the plan; under load some may be inconclusive
    elif page.exists():
        assert not results.exists(), "the page of an older campaign beside the store of this one"
        assert page.read_bytes() == (before / "out.html").read_bytes(), "a page without results"
    if page.exists():
        assert page.read_bytes().rstrip().endswith(b"</html>"), "half a page"


def check_twin(now: Path, before: Path) -> None:
    """The older twin where it was or beside; the new one whole."""
    twin, older = now / "twin.toml", (before / "twin.toml").read_bytes()
    if twin.exists() and twin.read_bytes() != older:
        assert read_toml(twin)["kind"] == "emulator"
    if not twin.exists() or twin.read_bytes() != older:
        assert (now / "twin.toml.previous").read_bytes() == older


def check_nothing(_: Path, __: Path) -> None:
    """It writes no files."""


def check_takes(now: Path, _: Path) -> None:
    """Every recording is whole and has its scenario."""
    for path in (now / "takes").glob("*.npz"):
        assert Run.load(path).samples
        assert Scenario.load(str(path.with_suffix(".toml"))).samples


def record_takes(process: subprocess.Popen[bytes]) -> None:
    """Start and end recordings on a bench until it is gone."""
    assert process.stdout is not None
    told = process.stdout.readline().split()
    if told:
        url = told[-1].decode()
        with contextlib.suppress(OSError, WebSocketException), open_page(url) as socket:
            for is_on in itertools.cycle((True, False)):
                socket.send(json.dumps({"do": "record", "on": is_on}))
                while json.loads(socket.recv()).get("state", {}).get("recording") is not is_on:
                    pass


def open_page(url: str) -> ClientConnection:
    """Connection of a page of the bench."""
    address, _, token = url.partition("/?")
    return connect(f"{address.replace('http', 'ws')}/live?{token}", origin=Origin(address), max_size=None)


CASES = {
    "run": Case(("run", "--dut", "host", "--out", "out"), check_run),
    "campaign": Case(("campaign", "spec.toml", "--out", "out.sqlite", "--workers", "2"), check_campaign),
    "certify": Case(
        (
            "certify",
            "--far",
            "2e-3",
            "--bounds",
            "independent",
            "--confidence",
            "0.9",
            "--dut",
            "host",
            "--workers",
            "2",
        ),
        check_nothing,
    ),
    "calibrate": Case(
        ("calibrate", "--components", "nominal", "--pots", "coefficient", "--out", "twin.toml"), check_twin
    ),
    "serve": Case(("serve", "--port", "0"), check_nothing, ends=False),
    "bench": Case(("bench", "--no-open", "--out", "takes"), check_takes, ends=False, at_work=record_takes),
}


def prepared(folder: Path) -> Path:
    """A folder as it is before every command: an earlier run that has passed, a campaign's page, a twin."""
    folder.mkdir(parents=True)
    (folder / "spec.toml").write_text(CAMPAIGN)
    (folder / "twin.toml").write_text("# of an earlier calibration\n")
    for words in (
        ("run", "--dut", "inproc", "--seed", "7", "--out", "out"),
        ("campaign", "spec.toml", "--out", "out.sqlite", "--workers", "1"),
    ):
        command = [sys.executable, "-m", "analogrig.cli", *words]
        subprocess.run(command, cwd=folder, stdout=subprocess.DEVNULL, timeout=LONG_S, check=False)
    outcome = json.loads((folder / "out" / "verdict.json").read_text())["outcome"]
    assert outcome == "passed", outcome
    (folder / "out.sqlite").unlink()
    return folder


@contextmanager
def started(case: Case, folder: Path) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """The command at work, and the mark of all that it starts."""
    mark = str(uuid.uuid4())
    command = with_default_signals(sys.executable, "-m", "analogrig.cli", *case.words)
    environment = {**os.environ, "ANALOGRIG_TEST_MARK": mark}
    with subprocess.Popen(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        try:
            yield process, mark
        finally:
            process.kill()


def duration_s(case: Case, before: Path) -> float:
    """Duration of the command; for a command that does not end, until it is at work."""
    with tempfile.TemporaryDirectory() as folder:
        now = Path(shutil.copytree(before, Path(folder) / "now"))
        start_s = time.monotonic()
        with started(case, now) as (process, _):
            if case.ends:
                process.communicate(timeout=LONG_S)
            elif process.stdout is not None:
                process.stdout.readline()
            return time.monotonic() - start_s + (AT_WORK_S if case.at_work else 0.0)


def kill(case: Case, number: signal.Signals, before: Path, after_s: float) -> str:
    """Kill it once, and check what is left; returns how it ended."""
    with tempfile.TemporaryDirectory() as folder:
        now = Path(shutil.copytree(before, Path(folder) / "now"))
        with started(case, now) as (process, mark):
            work = threading.Thread(target=case.at_work or (lambda _: None), args=(process,))
            work.start()
            try:
                process.wait(after_s)
            except subprocess.TimeoutExpired:
                process.send_signal(number)
            work.join(LONG_S)
            _, said = process.communicate(timeout=LONG_S)
            assert gone(mark), "processes are left"
        # -number: the command does not handle signals yet, or no longer. Status 1: Python itself had not started.
        not_started = process.returncode == 1 and said.startswith(b"Fatal Python error: init_import_site")
        assert not_started or process.returncode in {0, 130, -number}, f"ended with {process.returncode}: {said!r}"
        case.check(now, before)
        if process.returncode == 0 and case.check is check_run:
            assert json.loads((now / "out" / "verdict.json").read_text())["outcome"] == "passed"
        return str(process.returncode)


def instants(name: str, number: signal.Signals, kills: int, seed: int, most_s: float) -> list[float]:
    draw = random.Random(f"{seed} {name} {number.name}")
    return [draw.uniform(0.0, 1.1) * most_s for _ in range(kills)]


def main(kills: int, seed: int) -> int:
    """Kill every command by every signal, and browsers at a bench, so many times; returns the number of faults."""
    from tests.harness.live.browser_kills import kill_browsers  # which imports this module

    faults = 0
    with tempfile.TemporaryDirectory() as folder:
        before = prepared(Path(folder) / "before")
        for (name, case), number in itertools.product(CASES.items(), SIGNALS):
            ended: dict[str, int] = {}
            most_s = duration_s(case, before)
            for after_s in instants(name, number, kills, seed, most_s):
                try:
                    how = kill(case, number, before, after_s)
                except Exception as error:  # noqa: BLE001 - counted and shown, and the others are still tried
                    faults += 1
                    how = "fault"
                    print(f"{name}, {number.name} after {after_s:.3f} s: {type(error).__name__}: {error}")
                ended[how] = ended.get(how, 0) + 1
            print(f"{name:10} {number.name:8} {kills} kills within {most_s:.2f} s; by status {ended}", flush=True)
    kill_browsers(kills, seed)
    print(f"{faults} faults; seed {seed}")
    return faults


if __name__ == "__main__":
    given = [int(word) for word in sys.argv[1:]]
    sys.exit(main(*(given + [40, 1995][len(given) :])) > 0)
