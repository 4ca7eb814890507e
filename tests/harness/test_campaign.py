"""Campaigns: the same file whatever happens on the way, and what it says."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import os
import re
import signal
import sqlite3
import subprocess
import sys
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from analogrig.bench import Bench
from analogrig.campaigns import builds
from analogrig.campaigns.aggregates import Aggregate, Summary
from analogrig.campaigns.conduct import TASK_S, Task, Tasks, conduct
from analogrig.campaigns.plan import Part, Plan, device_files, device_of, one_worker_only, rig_table
from analogrig.campaigns.plays import PlayedTask, close_devices, play_part, play_task
from analogrig.campaigns.spec import CampaignSpec
from analogrig.campaigns.store import Store
from analogrig.campaigns.tally import Results, Tally
from analogrig.campaigns.trials import COLUMNS, Change, Trial, Trials, columns_of, decode, encode, join
from analogrig.campaigns.workers import MOST_DEATHS, Processes, ThisProcess
from analogrig.cli import main
from analogrig.devices.device import Device, DeviceDescription
from analogrig.devices.library import LIBRARY
from analogrig.devices.registry import describe, open_dut
from analogrig.errors import AnalogrigError, ConfigurationError, LinkClosed, RecordingError, WorkerError
from analogrig.judging.betting import BettingSequence
from analogrig.judging.verdict import judge
from analogrig.reporting.campaign_page import as_json, text
from analogrig.rigs.description import open_rig
from analogrig.rigs.emulator import EmulatorRig
from analogrig.run import Run
from analogrig.scenario import PotChange, Scenario
from tests.harness.processes import LONG_S

SPEC = """
trials = 6
chunk = 2
samples = 1300
change_at = 1200
[grid]
stiffness_factor = [0.8, 0.9]
[draw]
damping_n_s_per_m = [2500.0, 3021.0]
"""


def planned(tmp_path: Path, spec: str = SPEC, allow: Sequence[str] = ()) -> Plan:
    path = tmp_path / "spec.toml"
    path.write_text(spec)
    return Plan.of(CampaignSpec.load(str(path)), allow)


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The store of SPEC, played here, without interruption."""
    folder = tmp_path_factory.mktemp("reference")
    conduct(planned(folder), ThisProcess(), folder / "reference.sqlite")
    return folder / "reference.sqlite"


def command(folder: Path, *more: str | Path, workers: int | None = 1) -> int:
    """Status of ``analogrig campaign`` with spec.toml and out.sqlite of a folder."""
    words = ["campaign", folder / "spec.toml", "--out", folder / "out.sqlite", *more]
    return main([*map(str, words), *([] if workers is None else ["--workers", str(workers)])])


def exported(results: Results | Path) -> bytes:
    """The aggregated results as their file has them."""
    found = Results.load(results) if isinstance(results, Path) else results
    return json.dumps(as_json(found)).encode()


def stored(out: Path) -> dict[int, Trials]:
    """All trials of a store, by cell."""
    with Store.read(out) as store:
        found: dict[int, list[Trials]] = {}
        for part, trials in store.parts():
            found.setdefault(part.cell, []).append(trials)
    return {cell: join(parts) for cell, parts in found.items()}


def stored_trials(path: Path) -> int:
    """Number of trials that an unfinished store holds; 0 while its command has it."""
    with Store.read(path) as store:
        return sum(part.trials for part, _ in store.parts())


# ------------------------------------------------------------------------------------------------------- what is played


def test_trial_is_the_run_of_its_values_and_seed(tmp_path: Path) -> None:
    spec = SPEC.replace("[draw]", "noise_lsb = [0.5]\n[draw]")
    plan = planned(tmp_path, spec)
    damping = plan.draw(4)["damping_n_s_per_m"]
    assert 2500.0 < damping < 3021.0
    base = dataclasses.replace(Scenario.load("healthy"), samples=1300)
    scenario = dataclasses.replace(base, set={"B": damping}, changes=(PotChange(1200, {"K": 0.9 * 24500.0}),))
    rig_file = tmp_path / "emulator.toml"
    rig_file.write_text((Path("fixtures/rigs/emulator.toml")).read_text().replace("noise_lsb = 1.0", "noise_lsb = 0.5"))
    with open_rig(str(rig_file)) as rig, open_dut("inproc", exchange="block") as dut:
        run = Bench(rig, dut).play(scenario, 4)
    played = play_part(plan.as_json(), Part(1, 4, 2))
    assert [each.seed for each in played] == [4, 5]
    assert played[0] == Trial.of(run, judge(run), plan.draw(4))


def test_plan_reads_the_same_after_a_journey_as_text(tmp_path: Path) -> None:
    plan = planned(tmp_path)
    assert Plan.from_json(plan.as_json()) == plan
    assert Plan.from_json(plan.as_json()).as_json() == plan.as_json()


def test_order_of_the_axes_in_a_file_gives_no_cell_and_no_draw_the_values_of_another(tmp_path: Path) -> None:
    grid = "[grid]\nstiffness_factor = [0.9, 0.8]\nB = [2500.0, 3021.0]\n"
    draw = "[draw]\nnoise_lsb = [0.5, 1.0]\nM = [100.0, 115.0]\n"
    plan = planned(tmp_path, f"trials = 2\nsamples = 1300\n{grid}{draw}")
    worker = Plan.from_json(plan.as_json())
    assert worker.cells() == plan.cells() and worker.draw(3) == plan.draw(3)
    assert plan.cells()[1].values == {"B": 2500.0, "stiffness_factor": 0.8}


def test_device_on_a_line_gives_the_same_rows(tmp_path: Path) -> None:
    spec = "trials = 1\nsamples = 400\ndevices = {}\n"
    rows = [
        play_part(planned(tmp_path, spec.format(names)).as_json(), Part(0, 0, 1))
        for names in ('["inproc"]', '["host"]')
    ]
    close_devices()
    assert rows[0] == rows[1]


@pytest.mark.parametrize(
    ("spec", "complaint"),
    [
        ("trails = 3", "unknown key 'trails'"),
        ("[grid]\nmass = [1.0]", "unknown axis 'mass'"),
        ("[grid]\nmass_kg = [100.0, 100.0]", "grid: mass_kg has a value twice"),
        ("[draw]\nmass_kg = [100.0, 90.0]", r"draw: mass_kg must be \(low, high\)"),
        ("[grid]\nmass_kg = [90.0]\n[draw]\nmass_kg = [80.0, 90.0]", "mass_kg: in the grid and drawn as well"),
        ("trials = 0", "trials must be 1 to"),
        ("devices = []", "devices must name at least one"),
        ("name = '../../elsewhere'", "name must be one that a file can have, not '../../elsewhere'"),
        ('name = "two\\nlines"', r"name must be one that a file can have, not 'two\\nlines'"),
        ("[grid]\nmass_kg = [10.0]", "M = 10 cannot be set .*at least 29.4: pot M"),
        ("scenario = 'thesis'\n[grid]\nmass_factor = [0.5]", "has changes of its own"),
        ("[grid]\nmass_factor = [0.5]\n", None),
        ("[stop]\nquantity = 'late'\nrate = 0.1", "quantity: must be one of"),
        ("samples = 1100\n[grid]\nmass_factor = [0.5]\nchange_at = 3", "grid.change_at: must be an array, not 3"),
        ("false_alarms = -1\n[grid]\nmass_factor = [0.5]", "false_alarms must not be negative, not -1"),
        (
            "samples = 500\n[grid]\nmass_factor = [0.5]",
            "mass_factor = 0.5: the change at sample 1000 is beyond the last",
        ),
        ("rigs = ['recording:x.npz']", "x.npz"),
        ("[draw]\nnoise_lsb = [-0.05, 1.0]", "campaign spec: draw: noise_lsb = -0.05: .*noise_lsb must be 0 to"),
        (
            "[draw]\nnoise_lsb = [0.5, 1.0]\nmass_kg = [10.0, 300.0]",
            "draw: mass_kg = 10: .*M = 10 cannot be set .*: pot M",
        ),
        ("samples = 1300\n[draw]\nmass_factor = [-0.1, 0.9]", "draw: mass_factor = -0.1: .*must be"),
        (
            "samples = 1300\n[draw]\nmass_kg = [50.0, 300.0]\nmass_factor = [0.4, 0.9]",
            "mass_factor = 0.4, mass_kg = 50: .*pot M",
        ),
    ],
)
def test_wrong_campaign_is_one_line_that_names_the_key(tmp_path: Path, spec: str, complaint: str | None) -> None:
    if complaint is None:
        planned(tmp_path, spec)
        return
    with pytest.raises(AnalogrigError, match=complaint) as error:
        planned(tmp_path, spec)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("value", "last", "refused"), [(0.099942, 8, True), (0.099942, 4, False), (0.0999, 8, False)])
def test_value_that_the_parts_of_a_later_trial_cannot_set_is_refused_before_the_first(
    tmp_path: Path,
    value: float,
    last: int,
    refused: bool,  # noqa: FBT001
) -> None:
    """Seed 5 draws a pot that ends just below k = 0.099942."""
    spec = f'scenario = "dc-motor"\nrigs = ["emulator-real"]\nfirst_seed = 1\ntrials = {last}\n[grid]\nk = [{value}]\n'
    with (
        pytest.raises(ConfigurationError, match="trial of seed 5: .*k = 0.099942 cannot be set")
        if refused
        else contextlib.nullcontext()
    ):
        planned(tmp_path, spec)


# ------------------------------------------------------------------------------------------------ the same file always


def test_two_processes_give_the_results_of_one(tmp_path: Path, reference: Path) -> None:
    conduct(planned(tmp_path), Processes(2), tmp_path / "two.sqlite")
    assert exported(tmp_path / "two.sqlite") == exported(reference)


class Backwards(ThisProcess):
    """Plays all tasks, and returns the last one first."""

    slots = 3

    def play(self, work: Callable[[Task], PlayedTask], tasks: Iterator[Task]) -> Iterator[tuple[Task, PlayedTask]]:  # type: ignore[override]
        return iter([(task, work(task)) for task in tasks][::-1])


def test_order_in_which_parts_come_changes_nothing(tmp_path: Path, reference: Path) -> None:
    conduct(planned(tmp_path), Backwards(), tmp_path / "back.sqlite")
    assert exported(tmp_path / "back.sqlite") == exported(reference)


@pytest.mark.parametrize("count", [1, 5])
def test_division_into_parts_changes_nothing(tmp_path: Path, reference: Path, count: int) -> None:
    plan, out = planned(tmp_path), tmp_path / "out.sqlite"
    with Store.write(out, plan) as store:
        for cell in range(plan.size):
            for first in range(0, 6, count):
                store.add(play_task(plan.as_json(), (Part(cell, first, min(count, 6 - first)),)).parts)
    assert exported(conduct(plan, ThisProcess(), out)) == exported(reference)


def test_trials_played_together_are_those_played_alone_in_any_order(tmp_path: Path) -> None:
    """Without drawn values the trials of a cell differ in the seed alone, and are played and judged together."""
    text = planned(tmp_path, SPEC.partition("[draw]")[0]).as_json()
    for cell in (1, 0):
        alone = {place: play_part(text, Part(cell, place, 1)) for place in (3, 5, 0, 4, 2, 1)}
        assert play_part(text, Part(cell, 0, 6)) == [trial for place in range(6) for trial in alone[place]]


@pytest.mark.parametrize("parts", [[], [Part(0, 0, 6)], [Part(1, 2, 3)], [Part(0, 1, 2), Part(0, 4, 2), Part(1, 0, 5)]])
def test_campaign_goes_on_from_any_parts(tmp_path: Path, reference: Path, parts: list[Part]) -> None:
    plan, out = planned(tmp_path), tmp_path / "out.sqlite"
    with Store.write(out, plan) as store:
        store.add(play_task(plan.as_json(), tuple(parts)).parts)
    assert exported(conduct(plan, ThisProcess(), out)) == exported(reference)
    assert exported(out) == exported(reference)
    assert [path.name for path in tmp_path.glob("out.sqlite*")] == ["out.sqlite"]


def test_campaign_goes_on_after_a_cut_at_any_byte_of_the_log(tmp_path: Path, reference: Path) -> None:
    """The store with its log, as the end of the power would leave them after so many bytes of the log."""
    plan, out = planned(tmp_path), tmp_path / "out.sqlite"
    left: list[tuple[bytes, bytes]] = []
    with Store.write(out, plan) as store:
        for cell in range(plan.size):
            store.add(play_task(plan.as_json(), (Part(cell, 0, 3),)).parts)
            left.append((out.read_bytes(), out.with_name("out.sqlite-wal").read_bytes()))
    whole, log = left[-1]
    for length in (0, 7, 33, len(left[0][1]), len(left[0][1]) + 500, len(log) - 1, len(log)):
        out.write_bytes(whole)
        out.with_name("out.sqlite-wal").write_bytes(log[:length])
        assert exported(conduct(plan, ThisProcess(), out)) == exported(reference)


def test_tasks_take_seconds_whatever_a_trial_takes(tmp_path: Path) -> None:
    spec = SPEC.replace("trials = 6", "trials = 1000000").split("[draw]")[0]
    plan = planned(tmp_path, spec)
    for trial_s in (1e-4, 3e-3, 0.4, 3.0, 60.0):
        tasks = Tasks(plan, Tally(plan), slots=2)
        given = iter(tasks)
        next(given)
        tasks.note(10, 10 * trial_s)
        parts = next(given)
        assert sum(part.trials for part in parts) == max(1, min(int(TASK_S / trial_s), 20_000))


def test_tasks_cover_every_trial_once(tmp_path: Path) -> None:
    plan = planned(tmp_path, SPEC.replace("trials = 6", "trials = 1007"))
    tasks, seen = Tasks(plan, Tally(plan), slots=3), []
    for task in tasks:
        seen += [(part.cell, part.first + i) for part in task for i in range(part.trials)]
        tasks.note(1, 3e-3)
    assert sorted(seen) == [(cell, i) for cell in range(2) for i in range(1007)]


MANY = SPEC.replace("trials = 6", "trials = 60")
"""Campaign that takes about a second."""


@pytest.fixture(scope="module")
def many(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Results of MANY, played here without interruption."""
    folder = tmp_path_factory.mktemp("many")
    return exported(conduct(planned(folder, MANY), ThisProcess(), folder / "many.sqlite"))


def command_of(spec: Path, out: Path, workers: int) -> list[str]:
    command = [sys.executable, "-m", "analogrig.cli", "campaign", str(spec), "--out", str(out)]
    return [*command, "--workers", str(workers)]


@pytest.mark.parametrize(
    ("ended_by", "status"),
    [(signal.SIGKILL, -signal.SIGKILL), pytest.param(signal.SIGINT, 130, marks=pytest.mark.heavy)],
)
def test_campaign_that_was_ended_in_the_middle_gives_the_same_file(
    tmp_path: Path, many: bytes, ended_by: signal.Signals, status: int
) -> None:
    plan, out = planned(tmp_path, MANY), tmp_path / "out.sqlite"
    process = subprocess.Popen(
        command_of(tmp_path / "spec.toml", out, 2), stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    deadline_s, log = time.monotonic() + LONG_S, out.with_name("out.sqlite-wal")
    while not log.exists() or log.stat().st_size < 7_000:
        assert process.poll() is None and time.monotonic() < deadline_s
        time.sleep(0.01)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    assert len(children) >= 2
    process.send_signal(ended_by)
    _, complaint = process.communicate(timeout=LONG_S)
    assert process.returncode == status
    while any(Path(f"/proc/{child}/cmdline").exists() for child in children):
        assert time.monotonic() < deadline_s
        time.sleep(0.01)
    assert not out.with_suffix(".json").exists() and not out.with_suffix(".html").exists()
    assert 0 < stored_trials(out) < 120
    with pytest.raises(RecordingError, match="a campaign that has not ended"):
        Results.load(out)
    if ended_by == signal.SIGINT:
        assert complaint.decode().startswith("analogrig: interrupted: what is done is kept in ")
        assert complaint.count(b"\n") == 1
    assert exported(conduct(plan, ThisProcess(), out)) == many == exported(out)


def _die_once(marks: str, task: int) -> int:
    """Ends its process the first time that it is given 3; each call leaves a mark."""
    mark = Path(marks) / f"{task}.{os.getpid()}"
    mark.touch()
    if task == 3 and len(list(Path(marks).glob("3.*"))) == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return task * task


def _die(_: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    raise AssertionError


def _own_pid(_: int) -> int:
    return os.getpid()


class DyingOnce:
    """``_die_once`` with its folder, as it crosses the border between processes."""

    def __init__(self, marks: Path) -> None:
        self.marks = str(marks)

    def __call__(self, task: int) -> int:
        return _die_once(self.marks, task)


def test_only_the_task_of_a_killed_worker_is_played_again(tmp_path: Path) -> None:
    results = dict(Processes(2).play(DyingOnce(tmp_path), iter(range(8))))
    assert results == {task: task * task for task in range(8)}
    times = {task: len(list(tmp_path.glob(f"{task}.*"))) for task in range(8)}
    assert times == {task: 2 if task == 3 else 1 for task in range(8)}


def test_task_that_kills_every_worker_ends_the_campaign() -> None:
    with pytest.raises(WorkerError, match=f"7: {MOST_DEATHS} workers died over it"):
        list(Processes(1).play(_die, iter([7])))


@pytest.mark.parametrize(
    ("name", "only_one"),
    [
        ("inproc", ""),
        ("inproc:./own.so", ""),
        ("host", ""),
        ("qemu-m4:own.elf", ""),
        ("can:virtual", ""),
        ("serial:/dev/ttyACM0", "port:/dev/ttyACM0"),
        ("lines:/dev/ttyACM0", "port:/dev/ttyACM0"),
        ("can:socketcan/can0", "can:socketcan/can0"),
    ],
)
def test_device_of_which_there_is_only_one_takes_one_worker(name: str, only_one: str) -> None:
    assert describe(name).only_one == one_worker_only([], [describe(name).as_table()]) == only_one


@pytest.mark.parametrize("device", ["inproc", "host"])
def test_rig_of_a_trial_is_left_as_it_was_entered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, device: str) -> None:
    close_devices()
    happened: list[str] = []

    def enter(rig: EmulatorRig) -> EmulatorRig:
        happened.append("entered")
        return rig

    monkeypatch.setattr(EmulatorRig, "__enter__", enter)
    monkeypatch.setattr(EmulatorRig, "__exit__", lambda *_: happened.append("left"))
    plan = planned(tmp_path, f'devices = ["{device}"]\n{SPEC}')
    happened.clear()
    play_part(plan.as_json(), Part(0, 0, 1))
    assert happened == ["entered"]
    close_devices()
    assert happened == ["entered", "left"]


def test_worker_that_is_killed_while_it_has_no_task_is_replaced() -> None:
    workers = []
    for _, pid in Processes(1).play(_own_pid, iter(range(MOST_DEATHS + 1))):
        workers.append(pid)
        os.kill(pid, signal.SIGKILL)
        deadline_s = time.monotonic() + LONG_S
        while Path(f"/proc/{pid}").exists() and time.monotonic() < deadline_s:
            time.sleep(0.01)  # until the pool has noticed, and buried it
    assert len(set(workers)) == MOST_DEATHS + 1


@pytest.mark.heavy
def test_campaign_on_dask_with_a_worker_killed_gives_the_file_of_one_process(tmp_path: Path, reference: Path) -> None:
    script = Path(__file__).with_name("campaign_on_dask.py")
    planned(tmp_path)
    command: list[str | Path] = [sys.executable, script, tmp_path / "spec.toml", tmp_path / "dask.sqlite"]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=LONG_S, check=False)
    assert ran.returncode == 0, ran.stderr
    assert "killed a worker" in ran.stdout
    assert exported(tmp_path / "dask.sqlite") == exported(reference)


# --------------------------------------------------------------------------------------------------------- early end


def test_cell_ends_when_it_is_certain_whatever_the_order(tmp_path: Path) -> None:
    """A change of 0.5 % is missed nearly always, and one of 20 % never; each is certain long before 40 trials."""
    spec = SPEC.replace("trials = 6", "trials = 40").replace("[0.8, 0.9]", "[0.8, 0.999]").split("[draw]")[0]
    stop = '[stop]\nquantity = "missed"\nrate = 0.5\nconfidence = 0.95\n'
    plan = planned(tmp_path, spec.replace("samples = 1300", "samples = 1290") + stop)
    results = conduct(plan, ThisProcess(), tmp_path / "a.sqlite")
    quick = results.cells[0][1]
    assert quick.missed == 0
    assert quick.miss_rate[1] < 0.5
    assert quick.trials < 20
    again = conduct(plan, Backwards(), tmp_path / "b.sqlite")
    assert exported(again) == exported(results) == exported(tmp_path / "a.sqlite") == exported(tmp_path / "b.sqlite")
    assert len(stored(tmp_path / "b.sqlite")[0]) == quick.trials


def test_samples_of_the_warm_up_do_not_end_a_cell(tmp_path: Path) -> None:
    """At most 0.01 a sample at 90 % takes some 1800 without an alarm; of 600 samples at most 50 are armed."""
    stop = '[stop]\nquantity = "false_alarms"\nrate = 0.01\nconfidence = 0.9\n'
    plan = planned(tmp_path, f"trials = 20\nchunk = 1\nsamples = 600\n{stop}")
    summary = conduct(plan, ThisProcess(), tmp_path / "out.sqlite").total
    assert (summary.trials, summary.samples) == (20, 12_000)
    assert summary.armed <= 1000


@pytest.mark.parametrize(
    ("spec", "why"),
    [("samples = 540", "its warm-up takes 550"), ("samples = 900\nscenario = '{still}'", "in 900 it was not excited")],
)
def test_trial_in_which_the_trigger_was_never_armed_is_inconclusive(tmp_path: Path, spec: str, why: str) -> None:
    still = tmp_path / "still.toml"
    still.write_text("samples = 2000\n[excitation]\nlow_v = 1.0\nhigh_v = 1.0001\n")
    plan = planned(tmp_path, f"trials = 1\n{spec.format(still=still)}\n")
    (played,) = play_part(plan.as_json(), Part(0, 0, 1))
    assert (played.outcome, played.armed) == ("inconclusive", 0)
    assert why in played.why


# ------------------------------------------------------------------------------------------------------------ results


class Nobody(ThisProcess):
    """Is never asked."""

    play = None  # type: ignore[assignment]


def test_results_that_are_there_are_not_played_again(tmp_path: Path, reference: Path) -> None:
    before = reference.read_bytes()
    again = conduct(planned(tmp_path), Nobody(), reference)
    assert exported(again) == exported(reference)
    assert reference.read_bytes() == before


@pytest.mark.parametrize("has_ended", [True, False])
def test_another_campaign_is_not_overwritten(tmp_path: Path, has_ended: bool) -> None:  # noqa: FBT001 - a parameter
    out = tmp_path / "out.sqlite"
    plan = planned(tmp_path)
    if has_ended:
        conduct(plan, ThisProcess(), out)
    else:
        Store.write(out, plan).close()
    before = out.read_bytes()
    with pytest.raises(
        ConfigurationError, match=r"out\.sqlite: holds another campaign \(spec\.chunk is 2 there and 3 here"
    ):
        conduct(planned(tmp_path, SPEC.replace("chunk = 2", "chunk = 3")), ThisProcess(), out)
    assert out.read_bytes() == before


def test_two_campaigns_do_not_share_a_store(tmp_path: Path) -> None:
    plan, out = planned(tmp_path), tmp_path / "out.sqlite"
    with Store.write(out, plan), pytest.raises(ConfigurationError, match="another campaign is writing to it"):
        conduct(plan, ThisProcess(), out)


def test_trials_survive_their_encoding(tmp_path: Path) -> None:
    plan = planned(tmp_path)
    trials = columns_of(play_part(plan.as_json(), Part(0, 0, 4)), list(plan.spec.draw))
    again = decode(4, encode(trials), 1)
    for name in COLUMNS:
        assert np.array_equal(again[name], trials[name], equal_nan=name == "error")


DAMAGES: dict[str, str] = {
    "a text for a blob": "UPDATE trials SET theta = 'x'",
    "no zlib": "UPDATE trials SET theta = x'00'",
    "an outcome": f"UPDATE trials SET outcome = x'{zlib.compress(bytes([9] * 6)).hex()}'",  # noqa: S608
    "a bomb": f"UPDATE trials SET armed = x'{zlib.compress(bytes(40_000_000)).hex()}'",  # noqa: S608
    "more armed than played": "UPDATE trials SET armed = (SELECT theta FROM trials LIMIT 1)",
    "a count": "UPDATE trials SET count = 1000000000",
    "a place": "UPDATE trials SET first = first + 100",
    "a negative place": "UPDATE trials SET first = -first - 1",
    "no trials": "DELETE FROM trials",
    "one part less": "DELETE FROM trials WHERE first = (SELECT max(first) FROM trials)",
    "one summary less": "DELETE FROM cells WHERE cell = 0",
    "no plan": "DELETE FROM campaign",
    "another plan": "UPDATE campaign SET plan = '[]'",
    "a deep plan": "UPDATE campaign SET plan = '" + "[" * 100_000 + "'",
    "a large plan": "UPDATE campaign SET plan = '" + "x" * 5_000_000 + "'",
    "a command": "UPDATE commands SET identity = '[]'; INSERT INTO commands (identity) VALUES ('{')",
    "a trigger": "CREATE TRIGGER t AFTER INSERT ON trials BEGIN DELETE FROM trials; END",
    "a view": "DROP TABLE commands; CREATE VIEW commands AS SELECT 1 AS number, load_extension('x') AS identity",
    "an index": "CREATE INDEX i ON trials (count)",
    "another version": "PRAGMA user_version = 2",
}


@pytest.mark.parametrize("damage", [*DAMAGES, "half", "bytes", "empty", "text"])
def test_damaged_results_are_one_line(
    tmp_path: Path, reference: Path, damage: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path, whole = tmp_path / "damaged.sqlite", reference.read_bytes()
    path.write_bytes(whole)
    if damage in DAMAGES:
        with contextlib.closing(sqlite3.connect(path)) as file:
            file.executescript(DAMAGES[damage])
            file.commit()
    else:
        changed = {"half": whole[: len(whole) // 2], "bytes": whole[:1024] + whole[5000:4000:-1] + whole[2048:]}
        path.write_bytes(changed.get(damage, b"" if damage == "empty" else b"my own"))
    with pytest.raises(RecordingError, match=r"damaged\.sqlite: ") as error:
        Results.load(path)
    assert "\n" not in str(error.value)
    if damage != "a command":  # of which a comparison asks nothing
        assert main(["compare", str(path), str(path)]) == 2
        said = capsys.readouterr().err
        assert "damaged.sqlite: " in said
        assert said.count("\n") == 1
        assert not re.search("malformed|not a database|sqlite3", said)


def trial(
    outcome: str = "passed", false_alarms: int = 0, changes: Sequence[tuple[int | None, int | None, bool, bool]] = ()
) -> Trial:
    found = tuple(Change(*each) for each in changes)
    return Trial(0, outcome, "", 1000, 850, false_alarms, found, (0.03, -0.04, 0.0))


def test_summary_counts_what_is_valid_and_nothing_else() -> None:
    rows = [
        trial(changes=[(4, 3, False, False)]),
        trial("failed", 2, [(None, 5, True, False), (8, 5, False, True)]),
        trial(changes=[(None, None, False, False)]),
        trial("inconclusive", 9, [(None, 1, True, False)]),
    ]
    aggregate = Aggregate()
    aggregate.add(columns_of(rows), 0)
    found = Summary.of(aggregate, ("M", "B", "K"))
    assert (found.trials, found.passed, found.failed, found.inconclusive) == (4, 2, 1, 1)
    assert (found.samples, found.false_alarms, found.visible, found.missed, found.late) == (3000, 2, 3, 1, 1)
    assert found.armed == 3 * 850
    plays = Counter({(0, 850): 2, (2, 850): 1})
    assert found.false_alarm_rate == BettingSequence(0.975, most=1000, longest=1000, plays=plays).bounds
    assert (found.latency_n, found.latency_p95_n, found.bound_n) == (6.0, 8.0, 4.0)
    assert found.error["M"] == pytest.approx(0.03)
    assert found.miss_rate[0] < 1 / 3 < found.miss_rate[1]


def test_table_has_a_line_for_each_cell_and_one_for_all(reference: Path) -> None:
    lines = text(Results.load(reference)).splitlines()
    assert lines[0] == "campaign spec: 2 cells, 12 trials, 15600 samples: PASSED"
    assert [line.split()[0] for line in lines[3:6]] == ["0.8", "0.9", "all"]


def test_command_says_what_came_out_and_writes_the_page(
    tmp_path: Path, reference: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    planned(tmp_path)
    out = tmp_path / "out.sqlite"
    assert command(tmp_path, "--json") == 0
    said = json.loads(capsys.readouterr().out)
    assert said["total"]["trials"] == 12
    assert [cell["stiffness_factor"] for cell in said["cells"]] == ["0.8", "0.9"]
    assert exported(out) == exported(reference)
    before = Path(said["files"]["results"]).read_bytes()
    assert json.loads(before) == json.loads(exported(reference))
    assert Path(said["files"]["page"]).read_text().startswith("<!doctype html>")
    assert command(tmp_path, workers=None) == 0
    assert Path(said["files"]["results"]).read_bytes() == before


def test_parquet_file_has_a_row_for_each_trial_of_the_store(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is absent: pip install analogrig[parquet]")
    spec, out, to = tmp_path / "spec.toml", tmp_path / "x.sqlite", tmp_path / "x.parquet"
    spec.write_text(SPEC + "[stop]\nquantity = 'missed'\nrate = 0.5\n")
    command = ["campaign", str(spec), "--out", str(out), "--workers", "1", "--parquet"]
    assert main([*command, str(out)]) == 2
    assert "is a file of --out" in capsys.readouterr().err
    monkeypatch.setattr("analogrig.campaigns.parquet.GROUP_ROWS", 4)
    main([*command, str(to)])
    file = parquet.ParquetFile(to)
    assert 1 < file.num_row_groups < 12
    rows = file.read().to_pylist()
    with Store.read(out) as store:
        plan, parts = store.plan, list(store.parts())
    assert [(row["cell"], row["seed"]) for row in rows] == [
        (part.cell, seed) for part, _ in parts for seed in plan.seeds(part)
    ]
    trials = join([trials for _, trials in parts])
    assert [row["theta"] for row in rows] == trials["theta"].tolist()
    assert [row["latency_n"] for row in rows] == [
        [None if n < 0 else n for n in latencies] for latencies in trials["latency_n"].tolist()
    ]
    assert [row["error_K"] for row in rows] == trials["error"][:, 2].tolist()
    assert [row["damping_n_s_per_m"] for row in rows] == trials["drawn"][:, 0].tolist()
    assert {row["stiffness_factor"] for row in rows} == {0.8, 0.9}
    assert {row["outcome"] for row in rows} <= {"passed", "failed"}


def test_parquet_without_pyarrow_is_one_line_before_anything_is_played(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    out = tmp_path / "x.sqlite"
    assert main(["campaign", "pot-plane", "--out", str(out), "--parquet", str(tmp_path / "x.parquet")]) == 2
    assert capsys.readouterr().err.endswith("--parquet needs pyarrow: pip install 'analogrig[parquet]'\n")
    assert not out.exists()


def test_campaign_whose_devices_cannot_be_had_ends_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ports = ("/dev/absent", "/dev/missing")
    planned(tmp_path, "trials = 2\nsamples = 300\ndevices = ['serial:/dev/absent', 'serial:/dev/missing']\n", ports)
    assert command(tmp_path, "--allow", ports[0], "--allow", ports[1], workers=None) == 3
    complaint = capsys.readouterr().err
    assert "INCONCLUSIVE: no device can be had: device serial:/dev/absent: cannot open /dev/absent" in complaint
    assert complaint.count("\n") == 1
    assert not (tmp_path / "out.sqlite").exists()


def test_device_that_does_not_answer_leaves_the_others_their_results(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    master, slave = os.openpty()
    (tmp_path / "mute.toml").write_text(f"kind = 'serial'\nurl = '{os.ttyname(slave)}'\ntimeout_s = 0.05\n")
    spec = f"trials = 3\nsamples = 700\ndevices = ['{tmp_path / 'mute.toml'}', 'inproc']\n"
    planned(tmp_path, spec, [os.ttyname(slave)])
    assert command(tmp_path, "--allow", os.ttyname(slave), workers=None) == 3
    os.close(master)
    os.close(slave)
    said = capsys.readouterr()
    assert "mute cannot be had, and its trials are INCONCLUSIVE: device mute: no Hello" in said.err
    assert "3 trials inconclusive, such as seed 0: device mute: no Hello" in said.out
    mute, others = (stored(tmp_path / "out.sqlite")[cell] for cell in range(2))
    assert (mute["outcome"].tolist(), mute["samples"].tolist()) == ([2] * 3, [0] * 3)
    assert (others["outcome"].tolist(), others["samples"].tolist()) == ([0] * 3, [700] * 3)


@pytest.mark.parametrize("failing", [{1, 2}, set(range(4))])
def test_trial_whose_device_fails_is_inconclusive_and_the_next_is_played(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: set[int]
) -> None:
    real = Bench.play

    def play(bench: Bench, scenario: Scenario, seed: int) -> Run:
        if seed in failing:
            raise LinkClosed("the device\nis gone")
        return real(bench, scenario, seed)

    monkeypatch.setattr(Bench, "play", play)
    planned(tmp_path, "trials = 4\nsamples = 700\ndevices = ['host?exchange=block']\n")
    assert command(tmp_path) == 3
    trials = stored(tmp_path / "out.sqlite")[0]
    assert set(np.flatnonzero(trials["outcome"] == 2).tolist()) == failing
    assert {trials["why"][seed] for seed in failing} == {"the device is gone"}


def test_device_of_several_cells_is_opened_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A serial port cannot be opened twice."""
    close_devices()
    opened = []

    connect = DeviceDescription.connect

    def connected(description: DeviceDescription) -> Device:
        opened.append(description.name)
        return connect(description)

    monkeypatch.setattr(DeviceDescription, "connect", connected)
    spec = "trials = 1\nsamples = 300\ndevices = ['host?exchange=block']\n[grid]\nnoise_lsb = [0.5, 1.0]\n"
    plan = planned(tmp_path, spec)
    for cell in range(2):
        play_part(plan.as_json(), Part(cell, 0, 1))
    close_devices()
    assert len(opened) == 1


def test_rig_that_is_not_emulated_takes_one_worker() -> None:
    assert one_worker_only([rig_table("red-pitaya")], [describe("host").as_table()]) == "red-pitaya"
    assert one_worker_only([rig_table("emulator")], [describe("host").as_table()]) == ""


# ---------------------------------------------------------------------------------------------------- builds and files


def changed_library(tmp_path: Path) -> Path:
    library = tmp_path / "own.so"
    library.write_bytes(LIBRARY.read_bytes() + b" ")
    return library


def test_campaign_does_not_go_on_with_another_build_of_its_device(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    library, out = changed_library(tmp_path), tmp_path / "out.sqlite"
    spec = f"trials = 2\nsamples = 300\ndevices = ['inproc:{library}']\n"
    plan = planned(tmp_path, spec, [str(library)])
    with Store.write(out, plan) as store:
        store.add(play_task(plan.as_json(), (Part(0, 0, 1),)).parts)
    kept = out.read_bytes()
    library.unlink()  # as a linker does: it is still loaded
    library.write_bytes(LIBRARY.read_bytes())
    close_devices()
    with pytest.raises(ConfigurationError, match=r"own\.so is another build than the one that the campaign was begun"):
        play_part(plan.as_json(), Part(0, 0, 1))
    assert command(tmp_path, "--allow", library, workers=None) == 2
    complaint = capsys.readouterr().err
    before, after = plan.devices[0]["build"], planned(tmp_path, spec, [str(library)]).devices[0]["build"]
    assert f"devices[0].build is '{before}' there and '{after}' here" in complaint
    assert complaint.count("\n") == 1
    assert out.read_bytes() == kept


def test_library_that_came_with_the_campaign_is_used_where_its_hash_is_the_planned_one(tmp_path: Path) -> None:
    library = changed_library(tmp_path)
    plan = planned(tmp_path, f"trials = 1\nsamples = 300\ndevices = ['inproc:{library}']\n", [str(library)])
    files = device_files(plan.devices)
    library.unlink()
    with pytest.raises(ConfigurationError, match=r"own\.so"):
        device_of(plan.devices[0])
    builds.supply(dict.fromkeys(files, b"another"), tmp_path / "worker")
    with pytest.raises(ConfigurationError, match=r"own\.so"):
        device_of(plan.devices[0])
    builds.supply(files, tmp_path / "worker")
    program = device_of(plan.devices[0]).program
    assert program is not None
    assert (program.parent, program.read_bytes()) == (tmp_path / "worker", LIBRARY.read_bytes() + b" ")


@pytest.mark.parametrize("device", ["qemu-m4:{file}", "inproc:{file}"])
def test_contents_of_what_a_device_runs_are_part_of_the_campaign(tmp_path: Path, device: str) -> None:
    file = tmp_path / "own"
    builds = []
    for content in (b"one", b"two"):
        file.write_bytes(content)
        builds.append(Plan.of(CampaignSpec(devices=(device.format(file=file),), trials=1)).devices[0]["build"])
    assert builds == [hashlib.sha256(content).hexdigest()[:16] for content in (b"one", b"two")]


def test_another_version_of_analogrig_plays_nothing_of_a_campaign(tmp_path: Path) -> None:
    plan, out = planned(tmp_path), tmp_path / "out.sqlite"
    older = dataclasses.replace(plan, analogrig="0.0.7 0123456789abcdef")
    with pytest.raises(ConfigurationError, match=r"has analogrig 0\.1\.0, the campaign was begun by 0\.0\.7$"):
        play_part(older.as_json(), Part(0, 0, 1))
    Store.write(out, older).close()
    with pytest.raises(ConfigurationError, match=r"analogrig is '0\.0\.7 0123456789abcdef' there and '0\.1\.0 "):
        conduct(plan, ThisProcess(), out)


@pytest.mark.parametrize(
    ("out", "standing", "said"),
    [
        ("out.sqlite", "out.html", "out.html: is no page of a campaign"),
        ("out.sqlite", "out.json", "out.json: is no results of a campaign"),
        ("out.html", "other", "the page of the campaign is to be called so"),
        ("out.json", "other", "the results of the campaign is to be called so"),
        ("out.sqlite", "out.sqlite", "out.sqlite: not the results of a campaign: choose another --out"),
        ("", "other", "is no file that results could be written to"),
        ("/dev/full", "other", "--out /dev/full: is no file that results could be written to"),
    ],
)
def test_file_of_somebody_else_in_the_place_of_results_or_page_is_left_alone(
    tmp_path: Path, out: str, standing: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    planned(tmp_path)
    (tmp_path / standing).write_text("my own")
    assert main(["campaign", str(tmp_path / "spec.toml"), "--out", str(tmp_path / out), "--workers", "1"]) == 2
    assert said in capsys.readouterr().err
    assert (tmp_path / standing).read_text() == "my own"


def test_campaign_goes_on_when_there_is_room_again(tmp_path: Path, many: bytes) -> None:
    """A limit on the size of files stands for a disk that is full."""
    plan, out = planned(tmp_path, MANY), tmp_path / "out.sqlite"
    limit = "import os, resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (7_500, 7_500))"
    command = [sys.executable, "-c", f"{limit}; os.execv(sys.argv[1], sys.argv[1:])"]
    command += command_of(tmp_path / "spec.toml", out, 1)
    ended = subprocess.run(command, capture_output=True, text=True, timeout=LONG_S, check=False)
    assert ended.returncode == 2, ended
    assert ended.stderr.startswith(f"analogrig: {out}: ")
    assert ended.stderr.count("\n") == 1
    assert exported(conduct(plan, ThisProcess(), out)) == many


def test_campaign_that_another_process_has_ended_meanwhile_is_not_played_again(
    tmp_path: Path, reference: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out.sqlite"
    out.write_bytes(reference.read_bytes())
    monkeypatch.setattr("analogrig.campaigns.conduct.ended_results", lambda *_: None)
    results = conduct(planned(tmp_path), Nobody(), out)
    assert exported(results) == exported(reference)


def test_trial_that_the_user_interrupts_on_a_line_is_no_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    planned(tmp_path, "trials = 1\nsamples = 600\ndevices = ['host']\n")

    def interrupted(*_: object) -> Iterator[object]:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("analogrig.devices.catalogue_device.CatalogueDevice.play", interrupted)
        assert command(tmp_path) == 130
    assert "interrupted: what is done is kept in" in capsys.readouterr().err
    assert stored_trials(tmp_path / "out.sqlite") == 0
    assert command(tmp_path) == 0


def test_one_device_is_not_shared_by_two_workers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    planned(tmp_path, "devices = ['serial:/dev/absent']\n", ["/dev/absent"])
    assert command(tmp_path, "--allow", "/dev/absent", workers=2) == 2
    assert "port:/dev/absent is one device" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["samples = 0", "samples = 2000000000"])
def test_samples_that_cannot_be_are_refused_in_one_line(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "wrong.toml"
    file.write_text(text)
    assert main(["campaign", str(file), "--out", str(tmp_path / "x.json")]) == 2
    assert "samples must be 1 to" in capsys.readouterr().err
