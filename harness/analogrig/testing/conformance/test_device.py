"""The contract of a device, one test a clause."""

from __future__ import annotations

import contextlib
import functools
import itertools
import json
import typing
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pytest

from analogrig.answers import Samples
from analogrig.catalogue import SteppedFlag
from analogrig.datasheet import Datasheet
from analogrig.devices.device import Capability, Device, DeviceDescription
from analogrig.devices.registry import recorded, trusted
from analogrig.errors import AnalogrigError, ConfigurationError, DeviceRefused, TimeLimitReached
from analogrig.run import LOST, UNARMED
from analogrig.testing.conformance.alone import Alone, play_alone
from analogrig.testing.conformance.stimulus import SAMPLES_N, Answered, Stimulus, begin, finish, play, settle
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
def stimulus() -> Stimulus:
    """The usual record."""
    return stimulus_of(1)


@pytest.fixture
def description(request: pytest.FixtureRequest) -> DeviceDescription:
    """Description of the device of --hil-dut."""
    return trusted(DUT.of(request.node).value, trust_of(request.config))


class DeviceResults:
    """Results of one device that several tests read."""

    alone: Alone | None = None
    reference: Answered | None = None
    extremes: Mapping[str, Answered] | None = None


_RESULTS = pytest.StashKey[dict[str, DeviceResults]]()


@pytest.fixture
def results(request: pytest.FixtureRequest) -> DeviceResults:
    """Results of the device so far."""
    return request.config.stash.setdefault(_RESULTS, {}).setdefault(DUT.of(request.node).value, DeviceResults())


@pytest.fixture(autouse=True)
def alone(request: pytest.FixtureRequest, results: DeviceResults, stimulus: Stimulus) -> Alone | None:
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
        results.alone = play_alone(described.as_table(), stimulus.as_table(), limit_s)
    if results.alone.failure:
        pytest.fail(f"device {name}: in a process of its own it {results.alone.failure}", pytrace=False)
    return results.alone


@pytest.fixture
def dut(request: pytest.FixtureRequest, alone: Alone | None, hil_dut: Device) -> Device:  # noqa: ARG001
    """The device of --hil-dut, within the time limit."""
    hil_dut.limit(time_limit_s(request.config) or LIMIT_S)
    return hil_dut


@pytest.fixture
def reference(results: DeviceResults, dut: Device, stimulus: Stimulus) -> Answered:
    """Answers to the usual record, the first time that it was played."""
    results.reference = results.reference or play(dut, stimulus)
    return results.reference


@pytest.fixture
def extremes(results: DeviceResults, dut: Device, stimulus: Stimulus) -> Mapping[str, Answered]:
    """Answers to records that no plant gives, by name."""
    if results.extremes is None:
        results.extremes = {name: play(dut, extreme) for name, extreme in extreme_stimuli(stimulus)}
    return results.extremes


def check_same(found: Answered, expected: Answered, *, without: tuple[str, ...] = ()) -> None:
    """Fail unless the answers are the same to the bit."""
    pairs = found.digests(), expected.digests()
    different = [name for name in pairs[0] if pairs[0][name] != pairs[1][name] and name not in without]
    assert not different, f"other {' and '.join(different)} than before"


def check_complete(answered: Answered, stimulus: Stimulus) -> None:
    """Fail unless every sample has one answer of finite numbers, as the data sheet states."""
    n, sheet = len(stimulus.u), answered.sheet
    flags = answered.array("flags")
    assert flags is not None
    assert flags.dtype == np.uint8, f"flags are {flags.dtype}"
    assert flags.shape == (n,), f"{n} samples have {len(flags)} answers"
    shapes = {"theta": (n, sheet.theta_n), "innovation": (n,), "statistic": (n,)}
    stated = {"theta": sheet.theta_n > 0, "innovation": sheet.innovation, "statistic": sheet.statistic}
    for name, shape in shapes.items():
        array = answered.array(name)
        if not stated[name]:
            assert array is None, f"reports {name}, which the data sheet does not state"
            continue
        assert array is not None, f"reports no {name}, which the data sheet states"
        assert array.dtype == np.float32, f"{name} is {array.dtype}"
        assert array.shape == shape, f"{name} is {array.shape}, not {shape}"
        bad = np.flatnonzero(~np.isfinite(array.reshape(n, -1)).all(axis=1))
        assert not len(bad), f"{name} is non-finite at sample {bad[0]}"
    assert sheet.diagnoses or not answered.diagnoses, "reports diagnoses, which the data sheet does not state"
    assert sheet.misfits or not answered.misfits, "reports misfits, which the data sheet does not state"
    assert sheet.alarms or not answered.alarms, "raises alarms, and the data sheet states that it has no trigger"


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


def test_description_is_plain_and_opens_the_same_device(
    dut: Device, description: DeviceDescription, stimulus: Stimulus, reference: Answered
) -> None:
    table = json.loads(json.dumps(dut.description(), allow_nan=False))
    assert table["name"] == dut.name
    assert table["kind"] == description.kind
    again = recorded(table)
    plain = json.loads(json.dumps(again.as_table()))
    assert {name: table[name] for name in plain} == plain
    skip_if_single(description)
    with again.connect() as device:
        check_same(play(device, stimulus), reference)


def test_data_sheet_is_final_and_recorded(dut: Device, stimulus: Stimulus) -> None:
    before = dut.datasheet
    assert Datasheet.recorded(dut.description()) == before
    play(dut, stimulus)
    assert dut.datasheet == before
    assert Datasheet.recorded(dut.description()) == before


def test_capabilities_are_known(dut: Device, description: DeviceDescription) -> None:
    assert dut.name == description.name
    assert set(description.capabilities) <= set(typing.get_args(Capability))


def test_unknown_setting_is_refused_by_name(dut: Device) -> None:
    with pytest.raises((DeviceRefused, ConfigurationError), match=NO_SUCH):
        dut.configure(**{NO_SUCH: 1})


def test_settings_are_applied_all_or_none(
    dut: Device, description: DeviceDescription, stimulus: Stimulus, reference: Answered
) -> None:
    changed: dict[str, Any] = {}
    for name, value in settings_of(description).items():
        if isinstance(value, int | float):
            with contextlib.suppress(DeviceRefused, ConfigurationError):
                dut.configure(**changed, **{name: other(value)})
                changed[name] = other(value)
    dut.configure()
    check_same(play(dut, stimulus), reference)
    with pytest.raises((DeviceRefused, ConfigurationError), match=NO_SUCH):
        dut.configure(**changed, **{NO_SUCH: 1})
    check_same(play(dut, stimulus), reference)


def settings_of(description: DeviceDescription) -> Mapping[str, Any]:
    """Settings that the description states, if it can be configured."""
    if "configure" not in description.capabilities:
        return {}
    table = description.as_table()
    return dict(table.get("estimator") or table.get("settings") or {})


def other(value: float) -> float | bool:
    """Another value of a setting."""
    return not value if isinstance(value, bool) else 2 * value + 1


# -------------------------------------------------------------------------------------------------------- its answers


def test_every_sample_has_one_answer_of_finite_numbers(reference: Answered, stimulus: Stimulus) -> None:
    check_complete(reference, stimulus)


def test_alarms_and_diagnoses_come_in_order_with_their_samples(reference: Answered) -> None:
    check_order(reference)


def test_counters_are_whole_numbers(dut: Device, reference: Answered) -> None:
    for counters in (reference.counters, dut.link_counters, dut.line):
        assert all(type(value) is int and value >= 0 for value in counters.values()), counters
    assert dut.line_s >= 0.0


def test_answers_do_not_depend_on_the_record_before(dut: Device, stimulus: Stimulus, reference: Answered) -> None:
    check_same(play(dut, stimulus), reference)
    play(dut, stimulus_of(2))
    check_same(play(dut, stimulus), reference)
    settle(dut)
    check_same(play(dut, stimulus), reference)


def test_answers_are_the_same_in_a_new_process(
    alone: Alone | None, description: DeviceDescription, reference: Answered
) -> None:
    skip_if_single(description)
    assert alone is not None
    for digests in alone.digests:
        different = [name for name, digest in reference.digests().items() if digests[name] != digest]
        assert not different, f"other {' and '.join(different)} in a new process"


@pytest.mark.parametrize("lengths", BLOCKS.values(), ids=BLOCKS)
def test_answers_do_not_depend_on_the_blocks(
    dut: Device, stimulus: Stimulus, reference: Answered, lengths: tuple[int, ...]
) -> None:
    found = play(dut, stimulus, *lengths)
    check_complete(found, stimulus)
    check_order(found)
    check_same(found, reference)


def test_answers_without_messages_are_those_over_the_line(
    description: DeviceDescription, stimulus: Stimulus, reference: Answered
) -> None:
    if "blocks" not in description.capabilities:
        pytest.skip("has not the capability blocks")
    with description.direct() as device:
        found = play(device, stimulus)
    check_same(found, reference, without=("flags", "diagnoses", "misfits"))
    with description.direct(alarms_only=True) as device:
        assert play(device, stimulus).alarm_indices == reference.alarm_indices


def test_missing_samples_are_ignored(dut: Device, stimulus: Stimulus) -> None:
    index = np.arange(len(stimulus.u))
    valid = (index % 7 != 3) & ~((index >= 100) & (index < 140)) & (index >= 5)
    found = []
    for code in (0, stimulus.full_scale):
        u, y = (np.where(valid, codes, np.uint16(code)) for codes in (stimulus.u, stimulus.y))
        found.append(play(dut, stimulus.replaced(u=u, y=y, valid=valid)))
    check_complete(found[0], stimulus)
    check_same(found[1], found[0])
    flags = found[0].array("flags")
    assert flags is not None
    assert np.array_equal((flags & SteppedFlag.MISSING) != 0, ~valid), "the flag MISSING is not at the missing samples"
    assert not (flags & LOST).any(), "samples were lost"


def test_skipped_samples_are_missing_ones(dut: Device, stimulus: Stimulus) -> None:
    index = np.arange(len(stimulus.u))
    first, end = SAMPLES_N // 3, SAMPLES_N // 2
    expected = play(dut, stimulus.replaced(valid=(index < first) | (index >= end)), first, end - first, SAMPLES_N)
    begin(dut, stimulus)
    blocks = [
        Samples(at.start, stimulus.u[at], stimulus.y[at], stimulus.valid[at])
        for at in (slice(0, first), slice(end, None))
    ]
    found = finish(dut, dut.play(blocks))
    assert [len(part) for part in found.parts] == [first, SAMPLES_N - end]
    assert found.alarms == tuple(alarm for alarm in expected.alarms if not first <= alarm.index < end)
    for name in ("theta", "statistic"):
        ours, theirs = found.array(name), expected.array(name)
        if ours is not None and theirs is not None:
            assert np.array_equal(ours, np.delete(theirs, np.arange(first, end), axis=0)), f"other {name}"


def extreme_stimuli(stimulus: Stimulus) -> Iterator[tuple[str, Stimulus]]:
    """Records that no plant gives."""
    n, top = len(stimulus.u), stimulus.full_scale
    few = n // 3
    every = np.ones(n, np.bool_)
    rest, low, high = (np.full(n, code, np.uint16) for code in (top // 2, 0, top))
    square = np.where(np.arange(n) // 10 % 2, high, low)
    noise = np.random.default_rng(0).integers(0, top + 1, (2, n), np.uint16)
    for name, same in (("rest", rest[:few]), ("lowest codes", low[:few]), ("highest codes", high[:few])):
        yield name, stimulus.replaced(u=same, y=same, valid=every[:few])
    yield "full scale", stimulus.replaced(u=square, y=square[::-1].copy(), valid=every)
    yield "noise", stimulus.replaced(u=noise[0], y=noise[1], valid=every)
    yield "nothing but missing samples", stimulus.replaced(u=low[:few], y=low[:few], valid=~every[:few])
    yield "one sample", stimulus.replaced(u=rest[:1], y=rest[:1], valid=every[:1])


def test_extreme_samples_give_numbers(
    dut: Device, stimulus: Stimulus, extremes: Mapping[str, Answered], reference: Answered
) -> None:
    for name, extreme in extreme_stimuli(stimulus):
        try:
            check_complete(extremes[name], extreme)
            check_order(extremes[name])
        except AssertionError as error:
            pytest.fail(f"{name}: {error}", pytrace=False)
    check_same(play(dut, stimulus), reference)


def test_no_alarm_while_the_trigger_is_not_armed(extremes: Mapping[str, Answered], reference: Answered) -> None:
    every = {"plant": reference, **extremes}
    for name, found in every.items():
        flags, indices, sheet = found.array("flags"), found.alarm_indices, found.sheet
        assert flags is not None
        unarmed = [k for k in indices if flags[k] & UNARMED]
        assert not unarmed, f"{name}: an alarm at {unarmed[0]}, where the device reports that it is not armed"
        if sheet.armed:
            continue
        assert not (flags & UNARMED).any(), "UNARMED, which the data sheet does not state"
        early = [k for k in indices if k < sheet.warm_up_n]
        assert not early, f"{name}: an alarm at {early[0]}, in the warm-up of {sheet.warm_up_n} samples"
        soon = [after for before, after in itertools.pairwise(indices) if after - before < sheet.hold_off_n]
        assert not soon, f"{name}: an alarm at {soon[0]}, in the hold-off of {sheet.hold_off_n} samples"
    if not any(found.alarms for found in every.values()):
        pytest.skip("raised no alarm, also where the plant changes")


# ----------------------------------------------------------------------------------------------------------- its life


def test_two_side_by_side_do_not_disturb_each_other(
    dut: Device, description: DeviceDescription, stimulus: Stimulus, reference: Answered
) -> None:
    skip_if_single(description)
    second = stimulus_of(2)
    expected = play(dut, second)
    with description.connect() as other_device:
        begin(dut, stimulus)
        begin(other_device, second)
        parts = itertools.zip_longest(dut.play(stimulus.blocks()), other_device.play(second.blocks()))
        ours, theirs = zip(*parts, strict=True)
        check_same(finish(dut, [part for part in ours if part is not None]), reference)
        check_same(finish(other_device, [part for part in theirs if part is not None]), expected)


class RigFailed(Exception):  # noqa: N818 - stands for what the rig may raise
    """The rig failed in the middle of a record."""


def failing(blocks: Iterator[Samples]) -> Iterator[Samples]:
    yield from itertools.islice(blocks, 3)
    raise RigFailed


def test_play_after_a_failed_play_is_as_the_first(dut: Device, stimulus: Stimulus, reference: Answered) -> None:
    begin(dut, stimulus)
    with pytest.raises(RigFailed):
        list(dut.play(failing(stimulus.blocks())))
    settle(dut)
    check_same(play(dut, stimulus), reference)
    begin(dut, stimulus)
    left = iter(dut.play(stimulus.blocks()))
    next(left)
    del left
    settle(dut)
    check_same(play(dut, stimulus), reference)


def test_time_limit_is_kept(dut: Device, stimulus: Stimulus, reference: Answered) -> None:
    begin(dut, stimulus)
    dut.limit(0.0)
    answered_n = 0
    with contextlib.suppress(TimeLimitReached):
        for part in dut.play(stimulus.blocks()):
            answered_n += len(part)
    assert answered_n <= len(stimulus.u)
    dut.limit(LIMIT_S)
    settle(dut)
    check_same(play(dut, stimulus), reference)


def test_record_without_samples_and_stop_twice_do_no_harm(dut: Device, stimulus: Stimulus, reference: Answered) -> None:
    begin(dut, stimulus)
    assert list(dut.play(())) == []
    dut.stop()
    dut.stop()
    check_same(play(dut, stimulus), reference)


def test_device_can_be_closed_twice(
    request: pytest.FixtureRequest,
    dut: Device,  # noqa: ARG001
    description: DeviceDescription,
    stimulus: Stimulus,
) -> None:
    if description.only_one:
        request.config.stash[DEVICES].release(DUT.of(request.node).value)
    for is_played in (False, True):
        device = description.connect()
        if is_played:
            begin(device, stimulus)
        device.close()
        device.close()


def test_closed_device_leaves_nothing_behind(
    alone: Alone | None,
    dut: Device,  # noqa: ARG001
    description: DeviceDescription,
) -> None:
    skip_if_single(description)
    assert alone is not None
    assert not alone.left, f"left behind: {', '.join(alone.left)}"
