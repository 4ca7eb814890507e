"""Runs of several records: the device restarts in each, and the verdict treats each as a run of its own."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pytest

from analogrig.bench import Bench
from analogrig.devices.registry import open_dut
from analogrig.judging.verdict import judge
from analogrig.plant import Segment
from analogrig.rigs.description import open_rig
from analogrig.rigs.recording import RecordingRig
from analogrig.rigs.rig import Block, Hindsight, Performance, Rig
from analogrig.run import Run
from analogrig.scenario import PotChange, Scenario

RECORD_N, CHANGE_AT = 1100, 800
"""Samples of a record, and the one of its change: after the warm-up of the device."""


class Recorder(Rig):
    """Rig that plays the scenario on the emulated computer once for each record, from rest."""

    capabilities = frozenset({"change"})

    def __init__(self, rig: Rig, records: int) -> None:
        self._rig = rig
        self._records = records

    def perform(self, scenario: Scenario, seed: int) -> Performance:
        whole = self._rig.perform(dataclasses.replace(scenario, samples=RECORD_N), seed)
        segments = tuple(
            Segment(record * RECORD_N + segment.start, segment.plant)
            for record in range(self._records)
            for segment in whole.hindsight().segments
        )
        return dataclasses.replace(whole, blocks=self._blocks(scenario), hindsight=lambda: Hindsight(segments))

    def _blocks(self, scenario: Scenario) -> Iterator[Block]:
        for record in range(self._records):
            once = self._rig.perform(dataclasses.replace(scenario, samples=RECORD_N), record)
            for block in once.blocks:
                yield dataclasses.replace(block, first=record * RECORD_N + block.first, record=record)

    def description(self) -> Mapping[str, Any]:
        return self._rig.description()


SCENARIO = dataclasses.replace(
    Scenario.load("thesis"), samples=2 * RECORD_N, changes=(PotChange(sample=CHANGE_AT, set={"K": 16000.0}),)
)


@pytest.fixture(scope="module")
def run() -> Run:
    with open_rig("emulator") as rig, open_dut("inproc") as dut:
        return Bench(Recorder(rig, 2), dut).play(SCENARIO, 0)


def single(seed: int) -> Run:
    with open_rig("emulator") as rig, open_dut("inproc") as dut:
        return Bench(rig, dut).play(dataclasses.replace(SCENARIO, samples=RECORD_N), seed)


def test_device_restarts_with_each_record(run: Run) -> None:
    first, second = single(0), single(1)
    assert run.conditions.records == (0, RECORD_N)
    np.testing.assert_array_equal(run.theta, np.concatenate((first.theta, second.theta)))
    assert run.alarm_index.tolist() == [*first.alarm_index, *(RECORD_N + second.alarm_index)]
    assert run.diagnosis_onset.tolist() == [*first.diagnosis_onset, *(RECORD_N + second.diagnosis_onset)]
    for name, count in run.conditions.counters.items():
        assert count == first.conditions.counters[name] + second.conditions.counters[name]


def test_each_record_is_judged_as_a_separate_run(run: Run) -> None:
    whole, parts = judge(run), [judge(single(seed)) for seed in (0, 1)]
    assert whole.outcome == "passed"
    assert [change.sample for change in whole.changes] == [CHANGE_AT, RECORD_N + CHANGE_AT]
    for change, part in zip(whole.changes, parts, strict=True):
        assert (change.latency_n, change.bound_n) == (part.changes[0].latency_n, part.changes[0].bound_n)
    bounds = [0, CHANGE_AT, RECORD_N, RECORD_N + CHANGE_AT, 2 * RECORD_N]
    assert [(each.start, each.end) for each in whole.estimates] == list(itertools.pairwise(bounds))


def test_alarm_detects_no_change_of_an_earlier_record(run: Run) -> None:
    late = dataclasses.replace(run, alarm_index=np.array([RECORD_N + 5, RECORD_N + CHANGE_AT + 5]))
    verdict = judge(dataclasses.replace(late, alarm_kind=run.alarm_kind[:2], alarm_statistic=run.alarm_statistic[:2]))
    assert verdict.changes[0].missed
    assert verdict.false_alarms == (RECORD_N + 5,)


def test_records_are_saved_and_replayed(run: Run, tmp_path: Any) -> None:
    run.save(tmp_path / "run.npz")
    with RecordingRig.open(tmp_path / "run.npz") as rig, open_dut("inproc") as dut:
        again = Bench(rig, dut).play(rig.scenario(), 0)
    assert again.conditions.records == (0, RECORD_N)
    assert again.theta_hash() == run.theta_hash()


def test_velocity_and_net_force_need_not_be_measured(run: Run, tmp_path: Any) -> None:
    channels = {name: run.conditions.channels[name] for name in ("force", "displacement")}
    poor = dataclasses.replace(run, conditions=dataclasses.replace(run.conditions, channels=channels))
    poor.save(tmp_path / "run.npz")
    with RecordingRig.open(tmp_path / "run.npz") as rig:
        volts = np.concatenate([block.volts for block in rig.perform(rig.scenario(), 0).blocks])
    assert np.isnan(volts[:, 2:]).all()
    assert np.isfinite(volts[:, :2]).all()
    assert judge(Run.load(tmp_path / "run.npz")).outcome == "passed"
