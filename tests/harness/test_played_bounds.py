"""Bounds from plays of the machine, beside the exact simulation of a mass, a damper and a spring."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from analogrig import config
from analogrig.bench import Bench
from analogrig.campaigns.together import direct_bench
from analogrig.devices.library import InprocDevice
from analogrig.devices.registry import open_dut
from analogrig.judging import information
from analogrig.judging.courses import first_at_level
from analogrig.judging.verdict import BOUNDS, judge
from analogrig.program import Program
from analogrig.rigs.description import open_rig
from analogrig.rigs.emulator import EmulatorRig
from analogrig.rigs.recording import RecordingRig
from analogrig.run import Run
from analogrig.scenario import PotChange, Scenario
from analogrig_emulator import Excitation

WAVE = Excitation(low_v=0.1, high_v=9.9)
LEVEL = math.log(1e5)


def bench(rig: str) -> Bench:
    opened = open_rig(rig)
    assert isinstance(opened, EmulatorRig)
    return direct_bench(opened, InprocDevice(name="inproc"), alarms_only=True)


def without_machine(run: Run) -> Run:
    """The same run of a rig that states no machine: its bounds are those of the exact simulation."""
    return dataclasses.replace(run, conditions=dataclasses.replace(run.conditions, rig={"name": "by hand"}))


def one_change(program: str, name: str, factor: float, sample: int) -> Scenario:
    wired = Program.load(program)
    change = PotChange(sample, {name: wired.parameters[name].value * factor})
    return Scenario(sample + 350, WAVE, wired, changes=(change,), random_phase=True)


def test_played_detection_bound_is_the_closed_one_in_99_of_100_changes_on_ideal_amplifiers() -> None:
    rng, ideal = np.random.default_rng(22), bench("emulator-ideal")
    names = ("M", "B", "K")
    same = 0
    for i in range(100):
        name = names[i % 3]
        factor = rng.uniform(0.75, 0.95) if i % 2 or name != "M" else rng.uniform(1.05, 1.3)
        scenario = one_change(("front", "shock")[i // 3 % 2], name, factor, int(rng.integers(420, 520)))
        run = ideal.play(scenario, i)
        (played,), (closed,) = (information.change_information(each) for each in (run, without_machine(run)))
        assert played == pytest.approx(closed, rel=0.2, abs=0.5)
        same += first_at_level(played, LEVEL) == first_at_level(closed, LEVEL)
    assert same >= 99


@pytest.mark.parametrize(
    ("program", "name", "factor"),
    [
        ("front", "M", 0.8),
        ("front", "K", 0.8),
        ("front", "B", 1.2),
        ("shock", "B", 0.8),
    ],
)
def test_played_isolation_bound_is_the_closed_one_but_for_a_sample(program: str, name: str, factor: float) -> None:
    run = bench("emulator-ideal").play(one_change(program, name, factor, 450), 3)
    (played,), (closed,) = (information.isolation_bounds(each) for each in (run, without_machine(run)))
    assert played is not None
    assert closed is not None
    assert abs(played - closed) <= 1


def information_of_whole_plays(run: Run, rig: str, scenario: Scenario) -> NDArray[np.float64]:
    """I of the only change, from two plays of the machine from the start of the run, pots turning tick by tick."""
    opened, channel = open_rig(rig), run.conditions.output
    assert isinstance(opened, EmulatorRig)
    courses = []
    for is_changed in (True, False):
        computer, excitation, changes = opened.set_up(scenario, run.conditions.seed)
        (volts,) = computer.play(excitation, scenario.samples, changes if is_changed else ())
        courses.append(volts[scenario.changes[0].sample + 1 :, 1] / channel.lsb_v)
    return np.cumsum((courses[0] - courses[1]) ** 2) / (2.0 * (channel.noise_lsb**2 + 1.0 / 12.0))


@pytest.mark.parametrize(
    ("rig", "ramp_n", "tolerance"),
    [
        ("emulator", 0, 1e-3),
        ("emulator-real", 0, 0.02),
        ("emulator", 100, 0.03),
        ("emulator-real", 100, 0.03),
    ],
)
def test_information_is_that_of_whole_plays(rig: str, ramp_n: int, tolerance: float) -> None:
    """Left out are the windings of real pots, and the motion of a pot within a sample of its ramp."""
    scenario = Scenario(800, WAVE, changes=(PotChange(450, {"K": 18000.0}, ramp_n=ramp_n),))
    run = bench(rig).play(scenario, 3)
    (played,) = information.change_information(run)
    assert played == pytest.approx(information_of_whole_plays(run, rig, scenario), rel=tolerance, abs=0.2)


@pytest.mark.parametrize(
    "excitation",
    [
        Excitation("sine", 0.1, 7.0, 150.0),
        Excitation("sweep", 0.1, 7.0, 20.0, end_hz=600.0, sweep_s=0.01),
        Excitation("multisine", 0.1, 7.0, 50.0, harmonics=(1, 2, 3, 5, 8, 13)),
        Excitation("recorded", samples_v=tuple((3.5 + 3.0 * np.sin(np.arange(850) ** 1.5 / 50)).tolist())),
    ],
    ids=lambda each: each.shape,
)
@pytest.mark.parametrize("rig", ["emulator-skewed", "emulator-real"])
def test_smooth_excitation_is_played_judged_and_replayed(excitation: Excitation, rig: str, tmp_path: Path) -> None:
    scenario = Scenario(850, excitation, changes=(PotChange(600, {"K": 18000.0}),))
    with open_rig(rig) as opened, open_dut("inproc") as device:
        run = Bench(opened, device).play(scenario, 3)
    (played,) = information.change_information(run)
    if rig == "emulator-real":  # its card has one probe a sample, as a play of the machine alone has
        assert played == pytest.approx(information_of_whole_plays(run, rig, scenario), rel=0.05, abs=0.2)
    verdict = judge(run)
    assert verdict.outcome == "passed", verdict.reasons
    run.save(tmp_path / "run.npz")
    with RecordingRig.open(tmp_path / "run.npz") as recorded, open_dut("inproc") as device:
        again = Bench(recorded, device).play(recorded.scenario(), 3)
    assert again.theta_hash() == run.theta_hash()
    assert judge(again).changes == verdict.changes


def test_two_changes_are_each_judged_from_the_state_at_the_change() -> None:
    changes = (PotChange(450, {"K": 20000.0}), PotChange(630, {"B": 3600.0}))
    run = bench("emulator-ideal").play(Scenario(900, WAVE, changes=changes), 3)
    for played, closed in zip(*map(information.change_information, (run, without_machine(run))), strict=True):
        assert first_at_level(played, LEVEL) == first_at_level(closed, LEVEL)


def test_skewed_channel_is_played_at_its_own_instants() -> None:
    """The displacement is taken 10 us after the force, a fifth of a sample, so that a change shows earlier.

    A stiffness that changes is a step of acceleration: the displacement differs by the square of the time, the
    information by its fourth power.
    """
    scenario = one_change("front", "K", 0.8, 450)
    skewed, straight = (
        information.change_information(bench(rig).play(scenario, 3))[0] for rig in ("emulator-skewed", "emulator")
    )
    assert (skewed[:10] > straight[:10]).all()
    assert skewed[0] / straight[0] == pytest.approx(1.2**4, rel=0.05)


@pytest.mark.parametrize(
    ("name", "rig", "tolerance"),
    [
        *((name, "emulator-ideal", 0.05) for name in config.names("programs")),
        *((name, "emulator-real", 0.25) for name in ("dc-motor", "duffing", "rc-battery", "two-tanks")),
    ],
)
def test_change_on_any_program_has_the_bound_of_whole_plays(name: str, rig: str, tolerance: float) -> None:
    """The windings of real pots, which the bound leaves out, decide a tenth of a change by a fifth."""
    scenario = dataclasses.replace(Scenario.of_program(Program.load(name)), samples=1100)
    run = bench(rig).play(scenario, 3)
    (played,) = information.change_information(run)
    assert played == pytest.approx(information_of_whole_plays(run, rig, scenario), rel=tolerance, abs=0.2)
    if not scenario.program.is_linear:
        assert len(information.change_information(without_machine(run))[0]) == 0
        assert BOUNDS in judge(without_machine(run)).not_judged
