"""Pots set by a user's command while a record is taken; the harness dates the change, and judges with its interval."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from analogrig.bench import Bench
from analogrig.devices.dut import open_dut
from analogrig.judging.verdict import judge
from analogrig.run import Run
from analogrig.scenario import PotChange, Scenario
from tests.harness.allowed import open_allowed
from tests.harness.served import Served, served

PROGRAM = """\
import socket, sys
address, pot, dial = sys.argv[1:]
host, _, port = address.rpartition(":")
with socket.create_connection((host, int(port))) as connection:
    lines = connection.makefile("rwb")
    lines.write(b"POT:CATalog?\\r\\n"); lines.flush()
    number = lines.readline().decode().strip().split(",").index(pot) + 1
    lines.write(f"POT{number}:DIAL {dial}\\r\\nPOT{number}:DIAL?\\r\\n".encode()); lines.flush()
    assert abs(float(lines.readline()) - float(dial)) < 1e-3
"""
"""Program of a user with a box of digital pots on the network."""

SCENARIO = dataclasses.replace(
    Scenario.load("thesis"),
    samples=16_000,
    tweaks=(PotChange(4000, stiffness_n_per_m=18000.0), PotChange(11_000, damping_n_s_per_m=2200.0)),
)


@pytest.fixture(scope="module")
def clocked() -> Iterator[Served]:
    with served("--rig", "emulator-real", "--real-time") as instrument:
        yield instrument


def rig(instrument: Served, folder: Path, program: str) -> str:
    script = folder / "turn.py"
    script.write_text(program)
    file = instrument.rigs_file(folder)
    arguments = [sys.executable, str(script), instrument.address, "{pot}", "{dial}"]
    quoted = ", ".join(f"'{each}'" for each in arguments)
    pots = f'pots.kind = "command"\npots.arguments = [{quoted}]'
    file.write_text(file.read_text().replace('pots.kind = "instrument"', pots))
    return str(file)


def played(name: str) -> Run:
    with open_allowed(name) as opened, open_dut("inproc") as dut:
        return Bench(opened, dut).play(SCENARIO, 1)


def test_instants_of_a_users_command_are_dated_and_the_run_is_judged(clocked: Served, tmp_path: Path) -> None:
    run = played(rig(clocked, tmp_path, PROGRAM))
    assert run.samples == SCENARIO.samples
    changes = run.conditions.segments[1:]
    assert [change.plant for change in changes] == [each.plant for each in SCENARIO.segments()[1:]]
    for tweak, change in zip(SCENARIO.tweaks, changes, strict=True):
        assert change.start_low is not None
        assert change.start_high is not None
        assert tweak.sample < change.start_low <= change.start <= change.start_high  # the program takes its time
        assert change.start_high - change.start_low < 100
        noticed = run.alarm_index[run.alarm_index >= change.start_low]
        assert noticed[0] - change.start < 100, "the device has noticed another change than the harness has"
    verdict = judge(run)
    assert verdict.outcome == "passed", verdict.reasons


def test_pots_that_did_not_move_are_detected(clocked: Served, tmp_path: Path) -> None:
    name = rig(clocked, tmp_path, PROGRAM)
    with open_allowed(name) as opened, open_dut("inproc") as dut:
        bench = Bench(opened, dut)
        bench.play(dataclasses.replace(SCENARIO, tweaks=(), samples=500), 1)
        (tmp_path / "turn.py").write_text("")  # ends with status 0, and does nothing
        run = bench.play(SCENARIO, 1)
    verdict = judge(run)
    assert verdict.outcome == "inconclusive"
    assert all(change.unseen for change in run.conditions.segments[1:])


def test_command_that_fails_makes_the_run_inconclusive(clocked: Served, tmp_path: Path) -> None:
    verdict = judge(played(rig(clocked, tmp_path, "raise SystemExit('no box at this address')")))
    assert verdict.outcome == "inconclusive"
    assert "no box at this address" in verdict.reasons[0]
