"""Direct bench: the same runs as over a line, to the bit."""

from __future__ import annotations

import dataclasses
import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from analogrig.answers import Samples
from analogrig.bench import Bench
from analogrig.campaigns.together import DIRECT_BLOCK_SAMPLES, can_be_direct, direct_bench, judge_all, models_of
from analogrig.devices.library import (
    FIXED_LIBRARY,
    LIBRARY,
    WIDE_LIBRARY,
    Estimator,
    InprocDevice,
    estimator_library_for,
)
from analogrig.devices.registry import describe, open_dut
from analogrig.estimator_config import EstimatorConfig
from analogrig.judging import information
from analogrig.judging.verdict import judge
from analogrig.program import Program
from analogrig.rigs.description import open_rig
from analogrig.rigs.emulator import EmulatorRig
from analogrig.run import Run
from analogrig.scenario import Scenario
from analogrig_emulator import EmulatorError, Sampler

ROOT = Path(__file__).parents[2]
SHORT = dataclasses.replace(Scenario.load("healthy"), samples=500)


def emulator(name: str) -> EmulatorRig:
    rig = open_rig(name)
    assert isinstance(rig, EmulatorRig)
    return rig


@pytest.mark.parametrize(
    ("scenario_name", "rig_name"),
    [("thesis", "emulator"), ("thesis", "emulator-0-10v"), ("shock", "emulator-skewed"), ("slow", "emulator-real")],
)
def test_run_without_a_line_is_that_over_a_line_to_the_bit(scenario_name: str, rig_name: str) -> None:
    scenario, rig = Scenario.load(scenario_name), emulator(rig_name)
    scenario = dataclasses.replace(scenario, samples=min(scenario.samples, 2000))
    trial = direct_bench(rig, describe("inproc")).play(scenario, 7)
    with open_dut("inproc", exchange="block") as dut:
        run = Bench(rig, dut).play(scenario, 7)
    assert trial.codes.tobytes() == run.codes.tobytes()
    assert trial.clipped.tobytes() == run.clipped.tobytes()
    assert trial.theta_hash() == run.theta_hash()
    assert trial.alarm_index.tolist() == run.alarm_index.tolist()
    assert trial.alarm_statistic.tobytes() == run.alarm_statistic.tobytes()
    assert trial.conditions.segments == run.conditions.segments
    assert trial.conditions.overloads == run.conditions.overloads
    assert dict(trial.conditions.counters).items() <= dict(run.conditions.counters).items()
    ours, theirs = (dataclasses.replace(judge(each), changes=()) for each in (trial, run))
    assert ours == dataclasses.replace(theirs, fit=None, channel_faults=())
    for mine, other in zip(judge(trial).changes, judge(run).changes, strict=True):
        assert mine == dataclasses.replace(other, diagnosis=None)


def test_alarms_alone_are_those_of_the_run_across_blocks() -> None:
    thesis = Scenario.load("thesis")
    late = tuple(dataclasses.replace(change, sample=change.sample + DIRECT_BLOCK_SAMPLES) for change in thesis.changes)
    scenario = dataclasses.replace(thesis, samples=thesis.samples + DIRECT_BLOCK_SAMPLES, changes=late)
    rig, device = emulator("emulator"), describe("inproc")
    whole, bench = direct_bench(rig, device).play(scenario, 3), direct_bench(rig, device, alarms_only=True)
    for _ in range(2):  # a play leaves nothing behind
        run = bench.play(scenario, 3)
        assert run.theta.shape == (scenario.samples, 0)
        assert len(run.alarm_index) >= len(late)
        for name in ("alarm_index", "alarm_kind", "alarm_statistic", "codes", "statistic", "innovation", "flags"):
            assert getattr(run, name).tobytes() == getattr(whole, name).tobytes()


def test_skipped_indices_are_missing_samples_as_over_a_line() -> None:
    draw = np.random.default_rng(5)
    u, y = (draw.integers(1000, 3000, 400).astype(np.uint16) for _ in range(2))
    blocks = [
        Samples(first, u[first:to], y[first:to], np.ones(to - first, np.bool_)) for first, to in ((0, 100), (130, 400))
    ]
    description = describe("inproc?exchange=block")
    with description.connect() as line, description.direct() as direct:
        for device in (line, direct):
            device.start()
        for theirs, ours in zip(line.play(blocks), direct.play(blocks), strict=True):
            for name in ("theta", "innovation", "statistic"):
                assert np.array_equal(getattr(ours, name), getattr(theirs, name))
        assert direct.stop()["missing"] == line.stop()["missing"] == 30
        direct.start()
        with pytest.raises(ValueError, match="sample 99 comes again: the next one is 100"):
            list(direct.play([blocks[0], dataclasses.replace(blocks[1], first=99)]))


def test_rig_that_fails_within_a_play_ends_the_run_and_not_the_bench(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = dataclasses.replace(Scenario.load("healthy"), samples=2 * DIRECT_BLOCK_SAMPLES)
    bench = direct_bench(emulator("emulator"), describe("inproc"))
    whole, sample = bench.play(scenario, 1), Sampler.sample
    blocks: list[int] = []

    def fail_in_second_block(sampler: Sampler, volts: NDArray[np.float64]) -> tuple[NDArray[Any], NDArray[Any]]:
        blocks.append(len(volts))
        if len(blocks) == 2:
            raise EmulatorError("the voltage must be finite")
        return sample(sampler, volts)

    with monkeypatch.context() as patched:
        patched.setattr(Sampler, "sample", fail_in_second_block)
        run = bench.play(scenario, 1)
    assert run.conditions.faults == ("the voltage must be finite",)
    assert run.theta.tobytes() == whole.theta[:DIRECT_BLOCK_SAMPLES].tobytes()
    assert judge(run).outcome == "inconclusive"
    assert bench.play(scenario, 1).theta_hash() == whole.theta_hash()


def test_length_of_blocks_changes_no_code() -> None:
    rig, scenario = emulator("emulator-real"), Scenario.load("thesis")
    parts = [[block.codes for block in EmulatorRig(rig.described, n).perform(scenario, 5).blocks] for n in (64, 5000)]
    assert np.concatenate(parts[0]).tobytes() == np.concatenate(parts[1]).tobytes()


@pytest.mark.parametrize("rig_name", ["emulator", "emulator-0-10v", "emulator-ideal", "emulator-real"])
def test_plays_of_one_scenario_are_each_those_of_a_rig_of_its_own(rig_name: str) -> None:
    bench, thesis = direct_bench(emulator(rig_name), describe("inproc")), Scenario.load("thesis")
    other = dataclasses.replace(thesis, changes=thesis.changes[:2], samples=1500)
    for scenario, seed in ((thesis, 3), (thesis, 1), (other, 1), (thesis, 4)):
        trial = bench.play(scenario, seed)
        own = list(emulator(rig_name).perform(scenario, seed).blocks)
        assert trial.codes.tobytes() == np.concatenate([block.codes for block in own]).tobytes()
        assert trial.conditions.segments == scenario.segments()
        assert trial.conditions.scenario == scenario.as_table()


@pytest.mark.parametrize(
    ("rig_name", "shape"),
    [("emulator", "square"), ("emulator-0-10v", "square"), ("emulator-real", "square"), ("emulator", "sine")],
)
@pytest.mark.parametrize("alarms_only", [False, True])
def test_runs_played_and_judged_together_are_those_played_alone_to_the_bit(
    rig_name: str, shape: str, *, alarms_only: bool
) -> None:
    """The ranges of 0 to 10 V clip; with real components each seed has a machine of its own; a sine has no edges."""
    thesis = Scenario.load("thesis")
    excitation = dataclasses.replace(thesis.excitation, shape=shape)
    scenario = dataclasses.replace(thesis, samples=1500, changes=thesis.changes[:2], excitation=excitation)
    bench = direct_bench(emulator(rig_name), describe("inproc"), alarms_only=alarms_only)
    together, alone = bench.play_all(scenario, range(5)), [bench.play(scenario, seed) for seed in range(5)]
    for one, other in zip(together, alone, strict=True):
        for field in dataclasses.fields(Run):
            mine, its = getattr(one, field.name), getattr(other, field.name)
            assert mine.tobytes() == its.tobytes() if isinstance(mine, np.ndarray) else mine == its, field.name
    assert any(len(run.alarm_index) for run in together)
    assert judge_all(together) == [judge(run) for run in alone]


@pytest.mark.parametrize(
    ("program", "rig_name"),
    [("dc-motor", "emulator"), ("dc-motor", "emulator-0-10v"), ("two-mass", "emulator"), ("duffing", "emulator")],
)
def test_runs_of_any_program_are_judged_together_by_the_courses_of_each_to_the_bit(program: str, rig_name: str) -> None:
    """The multipliers of a Duffing oscillator leave nothing to share."""
    scenario = dataclasses.replace(Scenario.of_program(Program.load(program)), samples=1100)
    bench = direct_bench(emulator(rig_name), describe("inproc"))
    runs = bench.play_all(scenario, range(3))
    assert [run.theta_hash() for run in runs] == [bench.play(scenario, seed).theta_hash() for seed in range(3)]
    assert judge_all(runs) == [judge(run) for run in runs]
    for run, model in zip(runs, models_of(runs), strict=True):
        shared, alone = (information.change_information(run, each) for each in (model, None))
        assert len(shared) == len(scenario.changes)
        assert [each.tobytes() for each in shared] == [each.tobytes() for each in alone]
        assert information.isolation_bounds(run, model) == information.isolation_bounds(run)


def test_long_runs_are_played_one_by_one() -> None:
    scenario = dataclasses.replace(Scenario.load("healthy"), samples=DIRECT_BLOCK_SAMPLES + 100)
    bench = direct_bench(emulator("emulator"), describe("inproc"), alarms_only=True)
    (run,) = bench.play_all(scenario, [4])
    assert run.codes.tobytes() == bench.play(scenario, 4).codes.tobytes()


def test_runs_of_several_kinds_are_judged_each_by_its_own_conditions() -> None:
    bench, thesis = direct_bench(emulator("emulator"), describe("inproc")), Scenario.load("thesis")
    shorter = dataclasses.replace(thesis, samples=1500, changes=thesis.changes[:2])
    runs = [bench.play(scenario, seed) for scenario in (thesis, shorter, thesis) for seed in (1, 2)]
    assert judge_all(runs) == [judge(run) for run in runs]


def test_any_device_answers_whole_records_as_in_plays_of_their_own() -> None:
    rig = EmulatorRig(emulator("emulator").described, 500)
    blocks = [block for seed in (1, 2) for block in rig.perform(SHORT, seed).blocks]
    records = [block.samples() for block in blocks]
    with open_dut("inproc", exchange="block") as line, describe("inproc").direct() as direct:
        for (ours, counted), (theirs, its) in zip(
            direct.play_records(records), line.play_records(records), strict=True
        ):
            assert ours.theta is not None and theirs.theta is not None
            assert ours.theta.tobytes() == theirs.theta.tobytes()
            assert counted.items() <= its.items()


def test_device_whose_line_matters_is_not_played_without_it() -> None:
    rig, device = emulator("emulator"), InprocDevice(name="bob")
    assert can_be_direct(rig, device)
    assert not can_be_direct(rig, dataclasses.replace(device, wire_faults="flip@0.001"))
    assert not can_be_direct(rig, dataclasses.replace(device, report_interval_n=10))
    assert not can_be_direct(rig, describe("inproc?link=can"))
    assert not can_be_direct(rig, describe("host"))


@pytest.mark.parametrize(
    "settings",
    [{}, {"trigger": "prediction-error", "ceiling": 9.0, "reset": "all", "c": ()}, {"edge_instants": "anywhere"}],
    ids=["default", "prediction error", "edges anywhere"],
)
def test_estimator_of_fixed_orders_is_that_of_any_orders_to_the_bit(settings: dict[str, Any]) -> None:
    config, rng = EstimatorConfig(**settings), np.random.default_rng(23)
    run = direct_bench(emulator("emulator"), describe("inproc")).play(Scenario.load("thesis"), 7)
    u, y = run.codes[:, 0], run.codes[:, 1]
    valid = rng.random(len(u)) > 0.01
    ours, others = (Estimator(config, library=library) for library in (estimator_library_for(config), LIBRARY))
    for name in ("theta", "innovation", "statistic", "status", "alarms"):
        assert getattr(ours.run(u, y, valid), name).tobytes() == getattr(others.run(u, y, valid), name).tobytes()
        assert ours.counters == others.counters


@pytest.mark.parametrize(
    "options",
    [
        pytest.param(("-O1", "-DLIBRARY_NARROW"), id="narrow"),
        pytest.param(("-O2", "-fno-semantic-interposition"), id="as shipped", marks=pytest.mark.heavy),
    ],
)
def test_estimator_inside_the_loop_over_samples_is_the_one_that_is_called_to_the_bit(
    options: tuple[str, ...], tmp_path: Path
) -> None:
    parts = [ROOT / "estimator_c" / part for part in ("core", "isolation", "fit", "device")]
    sources = [ROOT / "estimator_c/ports/library/library.c", ROOT / "estimator_c/device/settings.c"]
    sources += sorted((ROOT / "build/generated").glob("*.c"))
    flags = ["-std=c99", "-shared", "-fPIC", "-ffp-contract=off", "-DEST_NC_MAX=2U", "-DLIBRARY_FLAT"]
    include = [f"-I{folder}" for folder in (*parts, ROOT / "build/generated")]
    subprocess.run(["cc", *options, *flags, *include, "-o", tmp_path / "flat.so", *sources], check=True)
    run = direct_bench(emulator("emulator"), describe("inproc")).play(Scenario.load("thesis"), 7)
    u, y = (np.ascontiguousarray(run.codes[:, channel].reshape(3, -1)) for channel in (0, 1))
    valid = np.ones(u.shape, np.bool_)
    ours, others = (Estimator(library=path).run_records(u, y, valid) for path in (tmp_path / "flat.so", LIBRARY))
    for (our, our_counters), (other, other_counters) in zip(ours, others, strict=True):
        assert our.theta.tobytes() == other.theta.tobytes()
        assert our.statistic.tobytes() == other.statistic.tobytes()
        assert our_counters == other_counters


def test_estimator_of_fixed_orders_is_for_the_default_orders_alone() -> None:
    assert estimator_library_for(EstimatorConfig()) == FIXED_LIBRARY
    assert estimator_library_for(EstimatorConfig(offset=False)) == LIBRARY
    assert estimator_library_for(EstimatorConfig.of_poles([0.8] * 4)) == WIDE_LIBRARY
    assert InprocDevice(name="mine", library="mine.so").estimator_library.name == "mine.so"


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="mallopt() is of glibc")
@pytest.mark.parametrize("variables", [{}, {"MALLOC_TRIM_THRESHOLD_": "65536"}], ids=["by default", "as Dask sets it"])
def test_plays_take_their_memory_from_the_plays_before(variables: dict[str, str]) -> None:
    """With the allocator's own thresholds each batch of 100 plays faults in 1,000 to 2,000 pages."""
    child = [sys.executable, "-c", _PAGES_OF_FIVE_BATCHES]
    printed = subprocess.run(child, env=os.environ | variables, capture_output=True, text=True, check=True).stdout
    assert int(printed) < 1000


_PAGES_OF_FIVE_BATCHES = """
import dataclasses, resource
from analogrig.campaigns.together import direct_bench
from analogrig.devices.registry import describe
from analogrig.rigs.description import open_rig
from analogrig.scenario import Scenario

bench = direct_bench(open_rig("emulator"), describe("inproc"))
scenario = dataclasses.replace(Scenario.load("healthy"), samples=600)

def pages():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

for batch in range(10):
    if batch == 5:
        before = pages()
    bench.play_all(scenario, range(100 * batch, 100 * (batch + 1)))
print(pages() - before)
"""
