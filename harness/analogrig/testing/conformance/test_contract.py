"""The contract of a device, one test a clause."""

from __future__ import annotations

import contextlib
import functools
import itertools
import json
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from analogrig.answers import Answers, Samples
from analogrig.catalogue import SteppedFlag
from analogrig.datasheet import Datasheet
from analogrig.devices.device import Capability, Device, DeviceDescription
from analogrig.devices.registry import recorded, trusted
from analogrig.errors import AnalogrigError, ConfigurationError, DeviceRefused, TimeLimitReached
from analogrig.run import LOST, UNARMED
from analogrig.testing.conformance.alone import Alone, play_alone
from analogrig.testing.conformance.stimulus import SAMPLES_N, Answered, Stimulus, begin, finish, play
from analogrig.testing.plugin.devices import DEVICES
from analogrig.testing.plugin.hil_options import DUT, time_limit_s, trust_of

LIMIT_S = 60.0
"""Longest time of one play, by default."""

BLOCKS = {"one": (1,), "irregular": (1, 7, 64, 3), "whole": (SAMPLES_N,), "empty": (0, 50)}

NO_SUCH = "no_such_setting"


# ------------------------------------------------------------------------------------------------------------ fixtures


@functools.cache
def stimulus_of(seed: int) -> Stimulus:
    return Stimulus.of_plant(seed)


@pytest.fixture
def description(request: pytest.FixtureRequest) -> DeviceDescription:
    """Description of the device of --hil-dut."""
    return trusted(DUT.of(request.node).value, trust_of(request.config))


class DeviceResults:
    """Results of one device that several tests read."""

    alone: Alone | None = None
    first_sheet: Datasheet | None = None
    reference: Answered | None = None
    extremes: Mapping[str, Answered] | None = None


_RESULTS = pytest.StashKey[dict[str, DeviceResults]]()


@pytest.fixture
def results(request: pytest.FixtureRequest) -> DeviceResults:
    """Results of the device so far."""
    return request.config.stash.setdefault(_RESULTS, {}).setdefault(DUT.of(request.node).value, DeviceResults())


@pytest.fixture(autouse=True)
def alone(request: pytest.FixtureRequest, results: DeviceResults) -> Alone | None:
    """Results of the device in a process of its own; None if only one process can use it.

    A device that crashes or hangs fails every test here, and harms no other.
    """
    name = DUT.of(request.node).value
    if results.alone is None:
        try:
            described = trusted(name, trust_of(request.config))
        except AnalogrigError as error:
            pytest.fail(str(error), pytrace=False)
        if described.only_one:
            return None
        limit_s = time_limit_s(request.config) or LIMIT_S
        results.alone = play_alone(described.as_table(), stimulus_of(1), limit_s)
    if results.alone.failure:
        pytest.fail(f"device {name}: in a process of its own it {results.alone.failure}", pytrace=False)
    return results.alone


@dataclass(frozen=True)
class DeviceOnTrial:
    """The device of --hil-dut, its data sheet before the first play, the usual record and the first answers to it."""

    dut: Device
    first_sheet: Datasheet
    stimulus: Stimulus
    reference: Answered

    def check_as_first(self, device: Device | None = None) -> None:
        """Fail unless the device, or another, answers the usual record as the first time."""
        check_same(play(device or self.dut, self.stimulus), self.reference)

    def check_settled(self) -> None:
        """Fail unless the device, left in the middle of a record, answers as the first time."""
        self.dut.recover()
        self.dut.configure()
        self.check_as_first()

    def begin(self) -> Iterator[Answers]:
        """Start the usual record."""
        begin(self.dut, self.stimulus)
        return iter(self.dut.play(self.stimulus.blocks()))


@pytest.fixture
def trial(request: pytest.FixtureRequest, results: DeviceResults, hil_dut: Device) -> DeviceOnTrial:
    """The device, within the time limit."""
    hil_dut.limit(time_limit_s(request.config) or LIMIT_S)
    results.first_sheet = results.first_sheet or hil_dut.datasheet
    results.reference = results.reference or play(hil_dut, stimulus_of(1))
    return DeviceOnTrial(hil_dut, results.first_sheet, stimulus_of(1), results.reference)


@pytest.fixture
def extremes(results: DeviceResults, trial: DeviceOnTrial) -> Mapping[str, Answered]:
    """Answers to records that no plant gives, by name."""
    if results.extremes is None:
        extreme = extreme_stimuli(trial.stimulus)
        results.extremes = {name: play(trial.dut, stimulus) for name, stimulus in extreme.items()}
    return results.extremes


def check_same(found: Answered, expected: Answered, *, without: tuple[str, ...] = ()) -> None:
    """Fail unless the answers are the same to the bit."""
    pairs = found.digests, expected.digests
    different = [name for name in pairs[0] if pairs[0][name] != pairs[1][name] and name not in without]
    assert not different, f"other {' and '.join(different)} than before"


def check_complete(answered: Answered, stimulus: Stimulus) -> None:
    """Fail unless every sample has one answer of finite numbers, as the data sheet states."""
    n, sheet, whole = len(stimulus.u), answered.sheet, answered.whole
    assert whole.flags.dtype == np.uint8, f"flags are {whole.flags.dtype}"
    assert whole.flags.shape == (n,), f"{n} samples have {len(whole.flags)} answers"
    shapes = {"theta": (n, sheet.theta_n), "innovation": (n,), "statistic": (n,)}
    stated = {"theta": sheet.theta_n > 0, "innovation": sheet.innovation, "statistic": sheet.statistic}
    for name, shape in shapes.items():
        array = getattr(whole, name)
        if not stated[name]:
            assert array is None, f"reports {name}, which the data sheet does not state"
            continue
        assert array is not None, f"reports no {name}, which the data sheet states"
        assert array.dtype == np.float32, f"{name} is {array.dtype}"
        assert array.shape == shape, f"{name} is {array.shape}, not {shape}"
        bad = np.flatnonzero(~np.isfinite(array.reshape(n, -1)).all(axis=1))
        assert not len(bad), f"{name} is non-finite at sample {bad[0]}"
    for name in ("diagnoses", "misfits"):
        assert getattr(sheet, name) or not len(getattr(whole, name)), (
            f"reports {name}, which the data sheet does not state"
        )
    assert sheet.alarms or not len(whole.alarms), "raises alarms, and the data sheet states that it has no trigger"


def check_order(answered: Answered) -> None:
    """Fail unless alarms, diagnoses and misfits ascend, and each comes with the answer to its sample."""
    first = 0
    for part in answered.parts:
        for found in (part.alarms, part.diagnoses, part.misfits):
            indices = found.index.tolist()
            assert indices == sorted(indices), f"{indices} are out of order"
            assert all(first <= each < first + len(part) for each in indices), (
                f"{indices} are not within the samples {first} to {first + len(part) - 1} answered with them"
            )
        first += len(part)


def skip_if_single(description: DeviceDescription) -> None:
    if description.only_one:
        pytest.skip(f"only one process at a time can use {description.only_one}")


# ------------------------------------------------------------------------------------------------------- what it states


def test_description_is_plain_and_opens_the_same_device(trial: DeviceOnTrial, description: DeviceDescription) -> None:
    table = json.loads(json.dumps(trial.dut.description(), allow_nan=False))
    assert table["name"] == trial.dut.name
    assert table["kind"] == description.kind
    again = recorded(table)
    plain = json.loads(json.dumps(again.as_table()))
    assert {name: table[name] for name in plain} == plain
    skip_if_single(description)
    with again.connect() as device:
        trial.check_as_first(device)


def test_data_sheet_is_final_and_recorded(trial: DeviceOnTrial) -> None:
    for _ in range(2):
        assert trial.dut.datasheet == trial.first_sheet
        assert Datasheet.recorded(trial.dut.description()) == trial.first_sheet
        play(trial.dut, trial.stimulus)


def test_capabilities_are_known(trial: DeviceOnTrial, description: DeviceDescription) -> None:
    assert trial.dut.name == description.name
    assert set(description.capabilities) <= set(typing.get_args(Capability))


def test_unknown_setting_is_refused_by_name(trial: DeviceOnTrial) -> None:
    with pytest.raises((DeviceRefused, ConfigurationError), match=NO_SUCH):
        trial.dut.configure(**{NO_SUCH: 1})


def test_settings_are_applied_all_or_none(trial: DeviceOnTrial, description: DeviceDescription) -> None:
    table = description.as_table() if "configure" in description.capabilities else {}
    changed: dict[str, Any] = {}
    for name, value in dict(table.get("estimator") or table.get("settings") or {}).items():
        if isinstance(value, int | float):
            other = not value if isinstance(value, bool) else 2 * value + 1
            with contextlib.suppress(DeviceRefused, ConfigurationError):
                trial.dut.configure(**changed, **{name: other})
                changed[name] = other
    trial.dut.configure()
    trial.check_as_first()
    with pytest.raises((DeviceRefused, ConfigurationError), match=NO_SUCH):
        trial.dut.configure(**changed, **{NO_SUCH: 1})
    trial.check_as_first()


# -------------------------------------------------------------------------------------------------------- its answers


def test_every_sample_has_one_answer_of_finite_numbers(trial: DeviceOnTrial) -> None:
    check_complete(trial.reference, trial.stimulus)


def test_alarms_and_diagnoses_come_in_order_with_their_samples(trial: DeviceOnTrial) -> None:
    check_order(trial.reference)


def test_counters_are_whole_numbers(trial: DeviceOnTrial) -> None:
    for counters in (trial.reference.counters, trial.dut.link_counters, trial.dut.line):
        assert all(type(value) is int and value >= 0 for value in counters.values()), counters
    assert trial.dut.line_s >= 0.0


def test_answers_do_not_depend_on_the_record_before(trial: DeviceOnTrial) -> None:
    trial.check_as_first()
    play(trial.dut, stimulus_of(2))
    trial.check_as_first()
    trial.check_settled()


def test_answers_are_the_same_in_a_new_process(
    alone: Alone | None, description: DeviceDescription, trial: DeviceOnTrial
) -> None:
    skip_if_single(description)
    assert alone is not None
    for digests in alone.digests:
        different = [name for name, digest in trial.reference.digests.items() if digests[name] != digest]
        assert not different, f"other {' and '.join(different)} in a new process"


@pytest.mark.parametrize("lengths", BLOCKS.values(), ids=BLOCKS)
def test_answers_do_not_depend_on_the_blocks(trial: DeviceOnTrial, lengths: tuple[int, ...]) -> None:
    found = play(trial.dut, trial.stimulus, *lengths)
    check_complete(found, trial.stimulus)
    check_order(found)
    check_same(found, trial.reference)


def test_answers_without_messages_are_those_over_the_line(description: DeviceDescription, trial: DeviceOnTrial) -> None:
    if "blocks" not in description.capabilities:
        pytest.skip("has not the capability blocks")
    with description.direct() as device:
        check_same(play(device, trial.stimulus), trial.reference, without=("flags", "diagnoses", "misfits"))
    with description.direct(alarms_only=True) as device:
        alarms = play(device, trial.stimulus).whole.alarms
    assert alarms.index.tolist() == trial.reference.whole.alarms.index.tolist()


def test_missing_samples_are_ignored(trial: DeviceOnTrial) -> None:
    stimulus, index = trial.stimulus, np.arange(SAMPLES_N)
    valid = (index % 7 != 3) & ~((index >= 100) & (index < 140)) & (index >= 5)
    found = []
    for code in (0, stimulus.full_scale):
        u, y = (np.where(valid, codes, np.uint16(code)) for codes in (stimulus.u, stimulus.y))
        found.append(play(trial.dut, stimulus.replaced(u=u, y=y, valid=valid)))
    check_complete(found[0], stimulus)
    check_same(found[1], found[0])
    flags = found[0].whole.flags
    assert np.array_equal((flags & SteppedFlag.MISSING) != 0, ~valid), "the flag MISSING is not at the missing samples"
    assert not (flags & LOST).any(), "samples were lost"


def test_skipped_samples_are_missing_ones(trial: DeviceOnTrial) -> None:
    stimulus, index = trial.stimulus, np.arange(SAMPLES_N)
    first, end = SAMPLES_N // 3, SAMPLES_N // 2
    is_there = (index < first) | (index >= end)
    expected = play(trial.dut, stimulus.replaced(valid=is_there), first, end - first, SAMPLES_N).whole
    begin(trial.dut, stimulus)
    blocks = [Samples(at.start, stimulus.u[at], stimulus.y[at], stimulus.valid[at])
              for at in (slice(0, first), slice(end, None))]  # fmt: skip
    found = finish(trial.dut, trial.dut.play(blocks))
    assert [len(part) for part in found.parts] == [first, SAMPLES_N - end]
    assert found.whole.alarms.tolist() == expected.alarms[is_there[expected.alarms.index]].tolist()
    for name in ("theta", "statistic"):
        ours, theirs = getattr(found.whole, name), getattr(expected, name)
        assert ours is None or theirs is None or np.array_equal(ours, theirs[is_there]), f"other {name}"


def extreme_stimuli(stimulus: Stimulus) -> Mapping[str, Stimulus]:
    """Records that no plant gives."""
    n, top = len(stimulus.u), stimulus.full_scale
    few, every = n // 3, np.ones(n, np.bool_)
    rest, low, high = (np.full(n, code, np.uint16) for code in (top // 2, 0, top))
    square = np.where(np.arange(n) // 10 % 2, high, low)
    noise = np.random.default_rng(0).integers(0, top + 1, (2, n), np.uint16)
    records = {
        "rest": (rest[:few], rest[:few], every[:few]),
        "lowest codes": (low[:few], low[:few], every[:few]),
        "highest codes": (high[:few], high[:few], every[:few]),
        "full scale": (square, square[::-1].copy(), every),
        "noise": (*noise, every),
        "nothing but missing samples": (low[:few], low[:few], ~every[:few]),
        "one sample": (rest[:1], rest[:1], every[:1]),
    }
    return {name: stimulus.replaced(u=u, y=y, valid=valid) for name, (u, y, valid) in records.items()}


def test_extreme_samples_give_numbers(trial: DeviceOnTrial, extremes: Mapping[str, Answered]) -> None:
    for name, extreme in extreme_stimuli(trial.stimulus).items():
        try:
            check_complete(extremes[name], extreme)
            check_order(extremes[name])
        except AssertionError as error:
            pytest.fail(f"{name}: {error}", pytrace=False)
    trial.check_as_first()


def test_no_alarm_while_the_trigger_is_not_armed(trial: DeviceOnTrial, extremes: Mapping[str, Answered]) -> None:
    every = {"plant": trial.reference, **extremes}
    for name, found in every.items():
        flags, indices, sheet = found.whole.flags, found.whole.alarms.index.tolist(), found.sheet
        unarmed = [k for k in indices if flags[k] & UNARMED]
        assert not unarmed, f"{name}: an alarm at {unarmed[0]}, where the device reports that it is not armed"
        if sheet.armed:
            continue
        assert not (flags & UNARMED).any(), "UNARMED, which the data sheet does not state"
        early = [k for k in indices if k < sheet.warm_up_n]
        assert not early, f"{name}: an alarm at {early[0]}, in the warm-up of {sheet.warm_up_n} samples"
        soon = [after for before, after in itertools.pairwise(indices) if after - before < sheet.hold_off_n]
        assert not soon, f"{name}: an alarm at {soon[0]}, in the hold-off of {sheet.hold_off_n} samples"
    if not any(len(found.whole.alarms) for found in every.values()):
        pytest.skip("raised no alarm, also where the plant changes")


# ----------------------------------------------------------------------------------------------------------- its life


def test_two_side_by_side_do_not_disturb_each_other(trial: DeviceOnTrial, description: DeviceDescription) -> None:
    skip_if_single(description)
    second = stimulus_of(2)
    expected = play(trial.dut, second)
    with description.connect() as other:
        ours = trial.begin()
        begin(other, second)
        pairs = list(itertools.zip_longest(ours, other.play(second.blocks())))
        check_same(finish(trial.dut, [part for part, _ in pairs if part is not None]), trial.reference)
        check_same(finish(other, [part for _, part in pairs if part is not None]), expected)


class RigFailed(Exception):  # noqa: N818 - stands for what the rig may raise
    """The rig failed in the middle of a record."""


def failing(blocks: Iterator[Samples]) -> Iterator[Samples]:
    yield from itertools.islice(blocks, 3)
    raise RigFailed


def test_play_after_a_failed_play_is_as_the_first(trial: DeviceOnTrial) -> None:
    begin(trial.dut, trial.stimulus)
    with pytest.raises(RigFailed):
        list(trial.dut.play(failing(trial.stimulus.blocks())))
    trial.check_settled()
    left = trial.begin()
    next(left)
    del left
    trial.check_settled()


def test_time_limit_is_kept(trial: DeviceOnTrial) -> None:
    begin(trial.dut, trial.stimulus)
    trial.dut.limit(0.0)
    answered_n = 0
    with contextlib.suppress(TimeLimitReached):
        for part in trial.dut.play(trial.stimulus.blocks()):
            answered_n += len(part)
    assert answered_n <= SAMPLES_N
    trial.dut.limit(LIMIT_S)
    trial.check_settled()


def test_record_without_samples_and_stop_twice_do_no_harm(trial: DeviceOnTrial) -> None:
    begin(trial.dut, trial.stimulus)
    assert list(trial.dut.play(())) == []
    trial.dut.stop()
    trial.dut.stop()
    trial.check_as_first()


def test_device_can_be_closed_twice(
    request: pytest.FixtureRequest, trial: DeviceOnTrial, description: DeviceDescription
) -> None:
    if description.only_one:
        request.config.stash[DEVICES].release(DUT.of(request.node).value)
    for is_played in (False, True):
        device = description.connect()
        if is_played:
            begin(device, trial.stimulus)
        device.close()
        device.close()


@pytest.mark.usefixtures("trial")
def test_closed_device_leaves_nothing_behind(alone: Alone | None, description: DeviceDescription) -> None:
    skip_if_single(description)
    assert alone is not None
    assert not alone.left, f"left behind: {', '.join(alone.left)}"
