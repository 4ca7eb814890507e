"""Pots set by a user's command while a record is taken, up to the verdict; the harness dates the changes."""

from __future__ import annotations

import dataclasses
import stat
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from analogrig import config
from analogrig.bench import Bench
from analogrig.devices.registry import open_dut
from analogrig.estimator_config import EstimatorConfig
from analogrig.judging.verdict import judge
from analogrig.run import Run
from analogrig.scenario import PotChange as Asked
from analogrig.scenario import Scenario
from analogrig_emulator import COMPONENTS, Excitation, SuspensionComputer
from analogrig_instruments.instrument import InputRecord, Instrument
from analogrig_instruments.ni_daqmx import NiDaqmx
from analogrig_instruments.real import RealRig
from analogrig_instruments.rig_wiring import RealDescription
from tests.harness.allowed import open_allowed
from tests.served.serving import serving

SAMPLES, ASKED_AT = 10_000, 3000
INSTANTS = (3215, 3311)
"""Samples of a record after which the first and the second pot move; the force is high then. They do not depend on the
duration of the process, so that results are reproducible."""

BLOCK_N = 16
"""Samples of a block; pots of the computer move between blocks."""


class CardAndComputer(NiDaqmx):
    """Card of 16 bits at a computer of real components, whose pots the command sets."""

    def __init__(self, said: Path) -> None:
        Instrument.__init__(self, "card")
        self._said = said
        self._computer = SuspensionComputer(
            "front", rng=np.random.default_rng(1), components=dataclasses.replace(COMPONENTS["polyester"], seed=1)
        )
        self._noise = np.random.default_rng(2)

    def set_inputs(self, ranges: Sequence[tuple[int, str]]) -> None:
        assert [word for _, word in ranges] == ["10V", "10V"]

    def set_excitation(self, excitation: Excitation) -> None:
        self._excitation = excitation

    def _take(self, samples: int, while_recording: Callable[[], None] | None) -> InputRecord:
        assert while_recording is not None
        standing = len(self._heard())
        while_recording()
        self._computer.machine.turn(dict(self._heard()[:standing]))
        due = dict(zip(INSTANTS, self._heard()[standing:], strict=False))
        taken = []
        for block in self._computer.play(self._excitation, samples, block_samples=BLOCK_N):
            taken.append(block)
            if (turned := due.get(len(taken) * BLOCK_N - 1)) is not None:
                self._computer.machine.turn(dict([turned]))
        volts = np.concatenate(taken)[:, :2]
        lsb_v = 20.0 / (1 << self.datasheet.bits)
        codes = np.rint(volts / lsb_v + self._noise.normal(size=volts.shape)).astype(np.int64)
        return InputRecord(np.asarray(codes * lsb_v, np.float64), codes, self.datasheet.bits)

    def _heard(self) -> list[tuple[str, float]]:
        """Arguments of the calls of the command, in order."""
        lines = self._said.read_text().splitlines() if self._said.exists() else []
        return [(pot, float(dial)) for pot, dial in map(str.split, lines)]

    def rest(self, settle_s: float) -> None:
        pass

    def make_safe(self) -> None:
        pass

    def close(self) -> None:
        pass


def described(program: Path) -> RealDescription:
    table: dict[str, Any] = {
        "kind": "real",
        "instrument": "nidaqmx://Dev1",
        "name": "bench",
        "self_test": False,
        "inputs": {
            "force": {"input": 0, "range": "10V"},
            "displacement": {"input": 1, "range": "10V"},
        },
        "pots": {"kind": "command", "arguments": [str(program), "{pot}", "{dial}"], "timeout_s": 60.0},
    }
    return config.build(RealDescription, table, "rigs.toml: rig.bench")


@pytest.fixture
def program(tmp_path: Path) -> Path:
    """Program that records the pot and its dial."""
    out = tmp_path / "set-pot"
    out.write_text(f'#!/bin/sh\necho "$1 $2" >> {tmp_path / "said"}\n')
    out.chmod(out.stat().st_mode | stat.S_IXUSR)
    return out


def played(program: Path, change: Asked) -> Run:
    scenario = Scenario(
        samples=SAMPLES, excitation=Excitation(low_v=0.1, high_v=9.9), changes=(change,), name="by command"
    )
    card = CardAndComputer(program.parent / "said")
    with RealRig(described(program), connect=lambda *_: card) as rig, open_dut("inproc") as dut:
        return Bench(rig, dut).play(scenario, seed=1)


def test_instant_of_a_command_is_dated_and_the_device_is_judged_by_it(program: Path) -> None:
    run = played(program, Asked(ASKED_AT, {"K": 18000.0}))
    (change,) = judge(run).changes
    assert change.between[0] <= INSTANTS[0] <= change.between[1]
    assert change.between[1] - change.between[0] < 60
    assert change.result == "detected"


def test_two_pots_of_a_command_are_one_change_from_the_first_to_the_second(program: Path) -> None:
    run = played(program, Asked(ASKED_AT, {"B": 2123.0, "K": 20000.0}))
    (_, segment) = run.conditions.segments
    assert not segment.unseen, segment.unseen
    earliest, latest = segment.earliest(), segment.latest()
    assert earliest.start <= INSTANTS[0] <= latest.start
    assert earliest.start + earliest.ramp_n <= INSTANTS[1] <= latest.start + latest.ramp_n
    assert judge(run).changes[0].result == "detected"


def test_change_that_a_command_did_not_make_is_not_judged(program: Path) -> None:
    program.write_text("#!/bin/sh\nexit 0\n")
    verdict = judge(played(program, Asked(ASKED_AT, {"K": 18000.0})))
    assert verdict.changes[0].result == "not judged"
    assert verdict.outcome != "passed"
    assert "shows that the plant has changed" in verdict.reasons[-1]


def test_command_that_fails_makes_the_run_inconclusive(program: Path) -> None:
    program.write_text("#!/bin/sh\necho no box at this address\nexit 1\n")
    verdict = judge(played(program, Asked(ASKED_AT, {"K": 18000.0})))
    assert verdict.outcome == "inconclusive"
    assert "ended with status 1, output: no box at this address" in verdict.reasons[0]


# ---- in real time, on a box of pots in the network


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


MOST_PLAYS = 10


ARL0_1E5 = EstimatorConfig(orders="program", arl0=1e5)


def played_in_time(file: Path, scenario: Scenario) -> Run:
    """Run whose pots were turned before its end. A loaded machine may start their program 0.2 s late."""
    for _ in range(MOST_PLAYS):
        with open_allowed(str(file)) as rig, open_dut("inproc", estimator=ARL0_1E5) as dut:
            run = Bench(rig, dut).play(scenario, 1)
        if all(change.start_low is not None for change in run.conditions.segments[1:]):
            break
    return run


def test_instants_of_a_users_command_are_dated_in_real_time(tmp_path: Path) -> None:
    asked = (Asked(4000, {"K": 18000.0}), Asked(11_000, {"B": 2200.0}))
    scenario = Scenario.load("thesis")
    expect = dataclasses.replace(scenario.expect, false_alarms=1)  # at ARL0 1e5 one run of six has one
    scenario = dataclasses.replace(scenario, samples=16_000, changes=asked, expect=expect)
    script = tmp_path / "turn.py"
    script.write_text(PROGRAM)
    with serving("--rig", "emulator-real", "--real-time") as instrument:
        file = instrument.rigs_file(tmp_path)
        arguments = [sys.executable, str(script), instrument.address, "{pot}", "{dial}"]
        pots = f'pots.kind = "command"\npots.arguments = {arguments}'
        file.write_text(file.read_text().replace('pots.kind = "instrument"', pots))
        run = played_in_time(file, scenario)
    changes = run.conditions.segments[1:]
    assert [change.plant for change in changes] == [each.plant for each in scenario.segments()[1:]]
    for each, change in zip(asked, changes, strict=True):
        assert change.start_low is not None
        assert change.start_high is not None
        assert each.sample < change.start_low <= change.start <= change.start_high  # the program takes its time
        assert change.start_high - change.start_low < 100
        noticed = run.alarm_index[run.alarm_index >= change.start_low]
        assert noticed[0] - change.start < 100, "the device has noticed another change than the harness has"
    assert judge(run).outcome == "passed", judge(run).reasons
