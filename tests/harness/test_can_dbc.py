"""Devices with messages of their own: an ECU that reads and writes frames by cantools, on a bus and in logs."""

from __future__ import annotations

import contextlib
import dataclasses
import random
import re
import struct
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import can
import cantools
import numpy as np
import pytest

from analogrig.answers import Samples
from analogrig.bench import Bench
from analogrig.cli import main
from analogrig.devices.registry import describe, open_dut
from analogrig.errors import ConfigurationError, LinkError, LinkTimeout, RecordingError
from analogrig.estimator_config import EstimatorConfig
from analogrig.judging.verdict import judge
from analogrig.links.dbc import MAX_DBC_BYTES
from analogrig.recordings import WRITTEN, CanLog, import_run
from analogrig.rigs.description import open_rig
from analogrig.run import LOST, UNARMED, UNREPORTED, Run
from analogrig.scenario import Scenario
from analogrig.testing.counterexample import Counterexample
from analogrig_ecu.can_dbc import CanDbcDevice
from tests.harness.commands import error_of
from tests.harness.scripted_ecu import DBC, Answer, ScriptedEcu, write

THESIS_HASH = "54f04f72e4f6d22a"
SEED = 7
MISSING = 0x01
SHORT = dataclasses.replace(Scenario.load("healthy"), samples=12)
AT = 5
"""Sample of a fault."""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """Device file on a virtual bus of its own."""
    return write(tmp_path, str(tmp_path))


def loaded(dbc: str) -> Any:
    """Database of cantools."""
    return cantools.database.load_string(dbc, "dbc")


def config() -> EstimatorConfig:
    """Configuration of the core as a device of our catalogue has it."""
    with open_rig("emulator") as rig:
        return EstimatorConfig(force_zero=rig.perform(SHORT, SEED).channels["force"].zero)


def changed(file: Path, *pairs: tuple[str, str]) -> Path:
    """The device file with texts replaced; each must be there."""
    text = file.read_text(encoding="utf-8")
    for old, new in pairs:
        assert old in text, old
        text = text.replace(old, new)
    file.write_text(text, encoding="utf-8")
    return file


def played(
    file: Path,
    scenario: Scenario = SHORT,
    *,
    listener: Callable[[can.Message], object] = lambda _: None,
    answering: Callable[[int, Answer], Iterable[can.Message]] = lambda _, frames: frames,
    hearing: Callable[[int, can.Message], Iterable[can.Message]] = lambda _, frame: (frame,),
) -> Run:
    with (
        ScriptedEcu(str(file.parent), config(), answering=answering, hearing=hearing),
        open_rig("emulator") as rig,
        open_dut(str(file), listener=listener) as dut,
    ):
        return Bench(rig, dut).play(scenario, SEED)


def captured(path: Path, frames: Iterable[can.Message], file: Path, scenario: Scenario = SHORT) -> Run:
    """Run of a log of these frames."""
    log = CanLog(path)
    log.begin()
    for frame in frames:
        log(frame)
    log.close()
    device = describe(str(file))
    assert isinstance(device, CanDbcDevice)
    with open_rig("emulator") as rig:
        return import_run(path, scenario, rig, device=device, most_lost_n=device.most_lost_n)


def counts(run: Run) -> dict[str, int]:
    return {name: n for name, n in run.conditions.link_counters.items() if n}


def assert_same(one: Run, other: Run) -> None:
    """Check that two runs have the same answers."""
    np.testing.assert_array_equal(one.theta, other.theta)
    np.testing.assert_array_equal(one.flags, other.flags)
    np.testing.assert_array_equal(one.statistic, other.statistic)
    np.testing.assert_array_equal(one.alarm_index, other.alarm_index)
    np.testing.assert_array_equal(one.codes[:, :2], other.codes[:, :2])


# ---------------------------------------------------------------------------------------------- on a bus, in a log


def test_core_behind_float_signals_has_the_hash_of_the_catalogue_live_and_in_a_log(file: Path, tmp_path: Path) -> None:
    frames: list[can.Message] = []
    scenario = Scenario.load("thesis")
    live = played(file, scenario, listener=frames.append)
    assert live.theta_hash().startswith(THESIS_HASH)
    assert live.conditions.faults == () and counts(live) == {}
    logged = captured(tmp_path / "can.blf", frames, file, scenario)
    assert_same(live, logged)
    assert judge(logged).outcome == judge(live).outcome == "passed"


def test_every_format_of_a_log_holds_the_run(file: Path, tmp_path: Path) -> None:
    frames: list[can.Message] = []
    live = played(file, listener=frames.append)
    for suffix in WRITTEN:
        assert_same(live, captured(tmp_path / f"can.{suffix}", frames, file))


def test_judge_takes_the_device_file_of_a_log(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frames: list[can.Message] = []
    scenario = tmp_path / "short.toml"
    scenario.write_text('name = "short"\nsamples = 12\n', encoding="utf-8")
    played(file, listener=frames.append)
    captured(tmp_path / "can.asc", frames, file)
    command = ["judge", str(tmp_path / "can.asc"), "--scenario", "healthy", "--out", str(tmp_path / "out")]
    assert main([*command, "--dut", str(file)]) in {0, 3}
    assert main([*command, "--dut", "inproc"]) == 2
    assert "needs no device file" in capsys.readouterr().err


def test_two_records_are_two_runs_of_the_log(file: Path, tmp_path: Path) -> None:
    frames: list[can.Message] = []
    for _ in range(2):
        played(file, listener=frames.append)
    with pytest.raises(RecordingError, match="holds 2 runs: select one with --run 1 to 2"):
        captured(tmp_path / "can.log", frames, file)


# --------------------------------------------------------------------------------------------------------------- faults


def replacing(position: int, change: Callable[[can.Message], Iterable[can.Message]]) -> Callable[[int, Answer], Answer]:
    """Answers to sample AT with one of their frames changed."""

    def answering(k: int, frames: Answer) -> Answer:
        return [
            new for i, frame in enumerate(frames) for new in (change(frame) if (k, i) == (AT, position) else (frame,))
        ]

    return answering


def with_data(frame: can.Message, data: bytes) -> can.Message:
    return can.Message(arbitration_id=frame.arbitration_id, is_extended_id=frame.is_extended_id, data=data)


def cut(frame: can.Message) -> tuple[can.Message, ...]:
    """The counter is in byte 1."""
    return (with_data(frame, bytes(frame.data[:1])),)


def recounted(frame: can.Message) -> tuple[can.Message, ...]:
    return (with_data(frame, bytes((frame.data[0], (frame.data[1] + 1) % 256, *frame.data[2:]))),)


def not_a_number(frame: can.Message) -> tuple[can.Message, ...]:
    return (with_data(frame, bytes((*frame.data[:2], *struct.pack("<f", np.nan), *frame.data[6:]))),)


def garbled(frame: can.Message) -> tuple[can.Message, ...]:
    """No multiplexer of EST_Par is 15."""
    return (with_data(frame, bytes((15, *frame.data[1:]))),)


def twice(frame: can.Message) -> tuple[can.Message, ...]:
    return frame, frame


def contradicting(frame: can.Message) -> tuple[can.Message, ...]:
    return frame, with_data(frame, bytes((*frame.data[:2], frame.data[2] ^ 1, *frame.data[3:])))


def foreign(frame: can.Message) -> tuple[can.Message, ...]:
    others = (
        can.Message(arbitration_id=0x7FF, is_extended_id=False, data=bytes(8)),
        can.Message(arbitration_id=frame.arbitration_id, is_extended_id=not frame.is_extended_id, data=frame.data),
        can.Message(arbitration_id=frame.arbitration_id, is_extended_id=frame.is_extended_id, is_remote_frame=True),
    )
    return *others, frame


PART, STATUS = 2, 6
"""Positions of a frame EST_Par and of EST_Status in an answer."""
LACKING_PART = {"answers_incomplete": 1}
LACKING_STATUS = {"samples_unanswered": 1}


@pytest.mark.parametrize(
    ("position", "change", "flags", "counted"),
    [
        (PART, lambda _: (), UNREPORTED, LACKING_PART),
        (STATUS, lambda _: (), LOST | MISSING, LACKING_STATUS),
        (PART, cut, UNREPORTED, LACKING_PART | {"frames_dropped": 1}),
        (STATUS, cut, LOST | MISSING, LACKING_STATUS | {"frames_dropped": 1}),
        (PART, garbled, UNREPORTED, LACKING_PART | {"frames_dropped": 1}),
        (PART, recounted, UNREPORTED, LACKING_PART | {"answers_late": 1}),
        (STATUS, recounted, LOST | MISSING, LACKING_STATUS | {"answers_late": 1}),
        (PART, twice, 0, {"answers_repeated": 1}),
        (STATUS, twice, 0, {"answers_repeated": 1}),
        (PART, foreign, 0, {"frames_foreign": 3}),
    ],
)
def test_fault_of_one_frame_marks_its_sample_alone_live_and_in_a_log(
    file: Path,
    tmp_path: Path,
    position: int,
    change: Callable[[can.Message], Iterable[can.Message]],
    flags: int,
    counted: dict[str, int],
) -> None:
    changed(file, ("timeout_s = 5.0", "timeout_s = 0.2\nmost_lost_n = 1"))
    frames: list[can.Message] = []
    run = played(file, listener=frames.append, answering=replacing(position, change))
    assert run.conditions.faults == ()
    assert counts(run) == counted
    assert [int(flag) for flag in run.flags] == [flags if k == AT else 0 for k in range(SHORT.samples)]
    if flags:
        np.testing.assert_array_equal(run.theta[AT], run.theta[AT - 1])
    logged = captured(tmp_path / "can.log", frames, file)
    assert_same(run, logged)
    assert counts(logged) == counted


def test_number_that_is_not_finite_ends_the_run(file: Path, tmp_path: Path) -> None:
    frames: list[can.Message] = []
    run = played(file, listener=frames.append, answering=replacing(PART, not_a_number))
    told = f"device ecu: EST_Par.V2 = nan for sample {AT}, which is not finite or too large for a float"
    assert told in run.conditions.faults[0]
    assert judge(run).outcome == "inconclusive"
    assert told in captured(tmp_path / "can.log", frames, file).conditions.faults[0]


def test_largest_float_is_an_estimate(file: Path) -> None:
    largest = struct.pack("<f", np.finfo(np.float32).max)

    def with_largest(frame: can.Message) -> tuple[can.Message, ...]:
        return (with_data(frame, bytes((*frame.data[:2], *largest, *frame.data[6:]))),)

    run = played(file, answering=replacing(PART, with_largest))
    assert run.conditions.faults == ()
    assert run.theta[AT, PART] == np.finfo(np.float32).max


def test_two_answers_to_one_sample_end_the_run(file: Path) -> None:
    run = played(file, answering=replacing(PART, contradicting))
    assert run.samples < SHORT.samples
    assert "answers sample 5 a second time with other values" in run.conditions.faults[0]


@pytest.mark.parametrize("heard", [(), "twice"])
@pytest.mark.parametrize("part", [0, 1])
def test_frame_lost_or_doubled_on_the_way_to_the_device_is_noticed_by_the_answers(
    file: Path, heard: object, part: int
) -> None:
    """The ECU steps whenever HIL_Travel comes; a lost HIL_Force leaves it with the force before."""

    def hearing(number: int, frame: can.Message) -> Iterable[can.Message]:
        if number == 2 * AT + part:
            return (frame, frame) if heard else ()
        return (frame,)

    changed(file, ("timeout_s = 5.0", "timeout_s = 0.2\nmost_lost_n = 1"))
    run = played(file, hearing=hearing)
    if part == 0:
        assert counts(run) == {}  # an ECU that does not check its counters
    elif heard:
        assert "a second time with other values" in run.conditions.faults[0]
    else:
        assert counts(run) == {"samples_unanswered": 1}
        assert run.flags[AT] == LOST | MISSING


def test_silent_device_makes_the_run_inconclusive(file: Path) -> None:
    changed(file, ("timeout_s = 5.0", "timeout_s = 0.02"))
    run = played(file, answering=lambda k, frames: frames if k < 1 else [])
    (fault,) = run.conditions.faults
    assert re.search(r"device ecu: sample 11: no complete answer within 0.02 s, for the 11th time \(the bus was", fault)
    assert run.samples == 12
    assert judge(run).outcome == "inconclusive"


def test_device_that_does_not_confirm_its_start_is_named(file: Path) -> None:
    changed(file, ("timeout_s = 5.0", "timeout_s = 0.02"))
    with (
        open_rig("emulator") as rig,
        open_dut(str(file)) as dut,
        pytest.raises(LinkTimeout, match=r"device ecu: no answer EST_State to \[start\] HIL_Control within 0.02 s"),
    ):
        Bench(rig, dut).play(SHORT, SEED)


def test_late_answers_are_passed_over_by_their_counter(file: Path) -> None:
    """The ECU sends the status of sample AT only with the answer to the next one."""
    held: list[can.Message] = []

    def answering(k: int, frames: Answer) -> Iterable[can.Message]:
        if k == AT:
            held.append(frames[-1])
            return frames[:-1]
        return [*held, *frames] if k == AT + 1 else frames

    changed(file, ("timeout_s = 5.0", "timeout_s = 0.2\nmost_lost_n = 1"))
    run = played(file, answering=answering)
    assert counts(run) == {"samples_unanswered": 1, "answers_late": 1}
    assert [k for k in range(SHORT.samples) if run.flags[k]] == [AT]


WITHOUT_COUNTER = ('counter = ["EST_Par.Ctr", "EST_Status.Ctr"]', "")
OWN_COUNTER = ('counter = ["EST_Par.Ctr", "EST_Status.Ctr"]', 'counter = ["EST_Status.Ctr"]\ncounter_is = "own"')
"""The ECU of the tests counts its status frames as it counts samples."""


@pytest.mark.parametrize("position", [PART, STATUS])
def test_without_a_counter_a_repeated_frame_makes_the_run_inconclusive(
    file: Path, tmp_path: Path, position: int
) -> None:
    frames: list[can.Message] = []
    changed(file, WITHOUT_COUNTER)
    run = played(file, listener=frames.append, answering=replacing(position, twice))
    assert any("came after the answer to sample" in fault for fault in run.conditions.faults)
    assert "a lost answer together with a repeated one" in run.datasheet.cannot_tell
    logged = captured(tmp_path / "can.log", frames, file)
    assert any("came after the answer to sample 5" in fault for fault in logged.conditions.faults)


def test_repeated_frame_is_passed_over_by_the_devices_own_count(file: Path) -> None:
    changed(file, OWN_COUNTER)
    run = played(file, answering=replacing(STATUS, twice))
    assert run.conditions.faults == ()
    assert counts(run) == {"answers_repeated": 1}
    assert not run.flags.any()


def test_answer_is_complete_without_a_closing_message_in_any_order(file: Path) -> None:
    changed(file, ('complete = "EST_Status"\n', ""))
    run = played(file, answering=lambda k, frames: frames[k % 7 :] + frames[: k % 7])
    assert not run.flags.any() and run.conditions.faults == ()


def test_latched_fault_is_one_alarm(file: Path) -> None:
    """The ECU of this test holds the bit for three samples."""

    def answering(k: int, frames: Answer) -> Answer:
        data = bytearray(frames[-1].data)
        data[0] = int(AT <= k < AT + 3)
        return [*frames[:-1], with_data(frames[-1], bytes(data))]

    assert played(file, answering=answering).alarm_index.tolist() == [AT, AT + 1, AT + 2]
    described = file.read_text()
    for level in ("[start]", 'alarm_is = "level"\n[start]'), ("[start]", "alarm_is = [1, 7]\n[start]"):
        changed(file, level)
        assert played(file, answering=answering).alarm_index.tolist() == [AT]
        file.write_text(described)
    file.write_text(f'alarm_is = "level"\n{described}')
    assert played(file, answering=answering).alarm_index.tolist() == [AT]
    file.write_text(f"alarm_is = [7]\n{described}")
    assert played(file, answering=answering).alarm_index.tolist() == []


def test_armed_and_missing_samples_travel(file: Path) -> None:
    """Sample 3 is outside the card's range, and the ECU is armed from AT on."""
    seen: list[float] = []
    database = loaded(DBC)

    def hearing(_: int, frame: can.Message) -> Iterable[can.Message]:
        values = database.decode_message(frame.arbitration_id, frame.data)
        seen.extend([values["Valid"]] if "Valid" in values else [])
        return (frame,)

    def answering(k: int, frames: Answer) -> Answer:
        data = bytes((2 * (k >= AT), *frames[-1].data[1:]))
        return [*frames[:-1], with_data(frames[-1], data)]

    changed(file, ("alarm =", 'armed = "EST_Status.Armed"\nalarm ='))
    with ScriptedEcu(str(file.parent), config(), answering=answering, hearing=hearing), open_dut(str(file)) as dut:
        dut.start()
        valid = np.arange(8) != 3
        codes = np.arange(8, dtype=np.uint16)
        (answers,) = dut.play([Samples(0, codes, codes, valid)])
        dut.stop()
    assert seen == valid.tolist()
    assert answers.flags.tolist() == [UNARMED * (k < AT) | MISSING * (k == 3) for k in range(8)]


def test_closed_bus_names_device_and_sample(file: Path) -> None:
    with ScriptedEcu(str(file.parent), config()), open_dut(str(file)) as dut:
        dut.start()
        codes = np.arange(8, dtype=np.uint16)
        blocks = iter([Samples(0, codes, codes, np.ones(8, bool)), Samples(8, codes, codes, np.ones(8, bool))])
        answers = dut.play(blocks)
        next(answers)
        dut.close()
        with pytest.raises(LinkError, match="^device ecu: sample 8: virtual/"):
            list(answers)


def test_sample_that_comes_again_is_refused(file: Path) -> None:
    changed(file, ("timeout_s = 5.0", "timeout_s = 30.0"))
    codes = np.zeros(2, dtype=np.uint16)
    with ScriptedEcu(str(file.parent), config()), open_dut(str(file)) as dut:
        dut.start()
        with pytest.raises(ValueError, match="^sample 1 comes again: the next one is 2$"):
            list(dut.play([Samples(0, codes, codes, np.ones(2, bool)), Samples(1, codes, codes, np.ones(2, bool))]))


def test_bus_off_is_named_in_the_time_out(file: Path) -> None:
    off = can.Message(arbitration_id=0x40, is_extended_id=False, is_error_frame=True, data=bytes(8))
    changed(file, ("timeout_s = 5.0", "timeout_s = 0.02"))
    run = played(file, answering=lambda k, frames: frames if k < 1 else [off])
    assert "the bus is bus-off" in run.conditions.faults[0]


def test_another_harness_on_the_bus_ends_the_run(file: Path) -> None:
    stranger = can.Message(arbitration_id=0x100, is_extended_id=False, data=b"\1\2\3\4")
    run = played(file, answering=lambda k, frames: [stranger, *frames] if k == AT else frames)
    assert "sample 5: virtual/" in run.conditions.faults[0] and "another harness" in run.conditions.faults[0]


# ------------------------------------------------------------------------------------------------------------- in a log


@pytest.mark.parametrize(
    ("lost", "flagged", "counted"),
    [
        ({0x100}, {AT}, {"samples_missing": 1}),
        ({0x101}, {AT}, {"samples_missing": 1}),
        ({0x100, 0x101}, {AT}, {}),
    ],
)
def test_sample_that_the_log_lacks_is_lost(
    file: Path, tmp_path: Path, lost: set[int], flagged: set[int], counted: dict[str, int]
) -> None:
    frames: list[can.Message] = []
    played(file, listener=frames.append)
    sent = [i for i, frame in enumerate(frames) if frame.arbitration_id in {0x100, 0x101}]
    drop = {i for i in sent[2 * AT : 2 * AT + 2] if frames[i].arbitration_id in lost}
    run = captured(tmp_path / "can.log", [frame for i, frame in enumerate(frames) if i not in drop], file)
    assert {k for k in range(run.samples) if run.flags[k]} == flagged
    assert run.lost.sum() == 1
    assert counts(run).items() >= counted.items()


def test_repeated_sample_of_a_log_is_one(file: Path, tmp_path: Path) -> None:
    frames: list[can.Message] = []
    run = played(file, listener=frames.append)
    sent = next(i for i, frame in enumerate(frames) if frame.arbitration_id == 0x101)
    logged = captured(tmp_path / "can.log", [*frames[: sent + 1], *frames[sent - 1 :]], file)
    assert_same(run, logged)
    assert counts(logged) == {"samples_repeated": 1}


def test_jump_of_a_counter_costs_no_memory(file: Path, tmp_path: Path) -> None:
    """Each frame alone claims that 255 samples are missing before it."""
    frames: list[can.Message] = []
    played(file, listener=frames.append)
    sent = [frame for frame in frames if frame.arbitration_id in {0x100, 0x101}]
    backwards = [frame for i in range(len(sent) - 2, -2, -2) for frame in sent[i : i + 2]]
    with pytest.raises(ConfigurationError, match="pass the scenario that was played"):
        captured(tmp_path / "can.log", backwards, file)


# --------------------------------------------------------------------------------------------------- refused when read


START = 'message = "HIL_Control"\nsignals = { Restart = 1 }'


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('u = "HIL_Force.Force"', 'u = "HIL_Forse.Force"', r"\[send\] u: .*ecu.dbc has no message 'HIL_Forse': d"),
        ('u = "HIL_Force.Force"', 'u = "HIL_Force.Forse"', r"\[send\] u: message HIL_Force has no signal 'Forse': did"),
        ('u = "HIL_Force.Force"', 'u = "Force"', r"\[send\] u: must be Message.Signal, not 'Force'"),
        ('u = "HIL_Force.Force"', 'u = "HIL_Travel.Valid"', "one signal carries two quantities"),
        ('u = "HIL_Force.Force"', 'u = "HIL_Force.Ctr"', "one signal carries two quantities"),
        ("u = [0.25, -100.0]", "u = [2.5, 0.0]", r"code 4095 is 10237.5 N, raw 41350; 16 bits hold -32768 to 32767"),
        ("u = [0.25, -100.0]", "u = [0.0, 0.0]", r"\[send\] units.u: the scale is 0"),
        ('"HIL_Travel.Mode" = 3', '"HIL_Travel.Mode" = 2', "HIL_Travel.Travel is not in the frame unless HIL_Tr"),
        ('[send.constant]\n"HIL_Travel.Mode" = 3\n', "", "HIL_Travel.Travel is not in the frame unless HIL_Trav"),
        ('"HIL_Travel.Mode" = 3', '"HIL_Travel.Mode" = 16', r"\[send\] constant: HIL_Travel.Mode is 16"),
        ('"HIL_Travel.Mode" = 3', '"HIL_Travel.Mode" = 3\n"HIL_Travel.Valid" = 1', "carries a quantity of the sample"),
        ('order = ["HIL_Force", "HIL_Travel"]', 'order = ["HIL_Force"]', r"\[send\] order: must name each of HIL_"),
        ('alarm = "EST_Status.Fault"', 'alarm = "HIL_Force.Force"', "message HIL_Force is sent to the device as well"),
        ('alarm = "EST_Status.Fault"', 'alarm = "EST_Status.Stat"', r"statistic: .* carries two quantities"),
        ('complete = "EST_Status"', 'complete = "EST_Statu"', r"\[receive\] complete: .* did you mean 'EST_Status'"),
        ('counter = ["EST_Par.Ctr", ', 'counter = ["EST_Par.V0", ', "EST_Par.V0 is not an unsigned number"),
        ('counter = ["HIL_Force.Ctr", "HIL_Travel.Ctr"]\n', "", r"\[receive\] counter: an echo needs send.counter"),
        ("signals = { Restart = 1 }", "signals = { Restart = 2 }", r"\[start\] signals: HIL_Control.Restart is 2"),
        ("signals = { Restart = 1 }", "signals = { Resart = 1 }", r"\[start\] signals: .* did you mean 'Restart'"),
        (START, 'message = "HIL_Force"', r"\[start\] message: message HIL_Force is used twice"),
        ("offset = true", "offset = false", "model has 5 parameters, theta 6"),
        ('dbc = "ecu.dbc"', 'dbc = "absent.dbc"', "absent.dbc: No such file"),
        ('dbc = "ecu.dbc"', 'dbc = "ecu.toml"', "ecu.toml: not a DBC"),
        ("[receive]", "[recieve]", "unknown key 'recieve'"),
    ],
)  # fmt: skip
def test_device_file_that_does_not_fit_its_dbc_is_refused_in_one_line(
    file: Path, old: str, new: str, message: str
) -> None:
    with pytest.raises(ConfigurationError, match=message) as caught:
        describe(str(changed(file, (old, new))))
    assert str(caught.value).startswith(f"{file}: ")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("SG_ Valid : 4|1@1+", "SG_ Valid : 3|1@1+", "overlapping"),
        ("SG_ Force : 7|16@0-", "SG_ Force : 7|8@0-", "8 bits hold -128 to 127"),
        (
            "(0.25,-100) [0|0]",
            "(0.25,-100) [-100|500]",
            r"outside \[-100\|500\] of the DBC: set send.units.[uy], or correct",
        ),
        (
            "BO_ 257 HIL_Travel: 8",
            "BO_ 257 HIL_Travel: 64",
            "HIL_Travel has 64 bytes, a frame at most 8: set fd = true",
        ),
        ("BO_ 258 HIL_Control: 1", "BO_ 256 HIL_Control: 1", "HIL_Force and HIL_Control have the same identifier"),
        ("BO_ 258 HIL_Control: 1", "BO_ 258 HIL_Control: 999999999", "longer than 1785 bytes"),
        ("SG_ Restart : 0|1@1+", "SG_\nRestart\n:\n0|999999999@1+", "longer than 1785 bytes"),
        ("SIG_VALTYPE_ 257", "SG_MUL_VAL_ 257 Speed Mode 0-4000000000;\nSIG_VALTYPE_ 257", "more than 65536 values"),
    ],
)
def test_dbc_that_cannot_be_used_is_refused_in_one_line(file: Path, old: str, new: str, message: str) -> None:
    assert old in DBC
    (file.parent / "ecu.dbc").write_text(DBC.replace(old, new), encoding="utf-8")
    with pytest.raises(ConfigurationError, match=message):
        describe(str(file))


def test_huge_dbc_is_refused_before_it_is_parsed(file: Path) -> None:
    (file.parent / "ecu.dbc").write_text(DBC + "\n" * MAX_DBC_BYTES)
    with pytest.raises(ConfigurationError, match="ecu.dbc: larger than 4000000 bytes$"):
        describe(str(file))


def test_damaged_dbc_is_refused_in_one_line(file: Path) -> None:
    """Cut at random, with random bytes: seed 3."""
    random_bytes = random.Random(3)  # noqa: S311 - a test
    for _ in range(60):
        text = bytearray(DBC.encode())
        del text[random_bytes.randrange(len(text)) :]
        for _ in range(random_bytes.randrange(4)):
            text[random_bytes.randrange(len(text) or 1) :][:1] = random_bytes.randbytes(1)
        (file.parent / "ecu.dbc").write_bytes(bytes(text))
        with contextlib.suppress(ConfigurationError):
            describe(str(file))


def test_real_time_implies_no_exchange_for_a_device_without_one(file: Path, tmp_path: Path) -> None:
    with open_dut(str(file), in_real_time=True) as dut, open_dut("inproc", in_real_time=True) as ours:
        assert "exchange" not in dut.description()
        assert ours.description()["exchange"] == "stream"
    run = ["run", "--dut", str(file), "--real-time", "--exchange", "stream", "--out", str(tmp_path / "out")]
    assert "a device of the kind can-dbc has no exchange" in error_of(*run)


def test_kind_needs_a_device_file() -> None:
    with pytest.raises(ConfigurationError, match=r"need a device file \(.toml\)"):
        describe("can-dbc:ecu.dbc")


def test_file_may_not_open_a_real_bus_unless_allowed(file: Path) -> None:
    changed(
        file,
        ('interface = "virtual"', 'interface = "udp_multicast"'),
        (f'channel = "{file.parent}"', 'channel = "239.74.163.2"'),
    )
    with pytest.raises(ConfigurationError, match="--allow|allow="):
        open_dut(str(file))


def test_only_the_tests_can_play_again_through_a_device_in_their_process(file: Path) -> None:
    run = played(file)
    scenario = Path("runs/it/scenario.toml")
    assert Counterexample(run).command(scenario) == "pytest runs/it/scenario.toml --hil-scenario-dir runs/it"
    conditions = dataclasses.replace(run.conditions, dut={**run.conditions.dut, "interface": "slcan"})
    elsewhere = Counterexample(dataclasses.replace(run, conditions=conditions))
    assert elsewhere.command(scenario).startswith("analogrig run --scenario runs/it/scenario.toml --dut runs/it/dut")


def test_units_of_the_channel_are_checked_against_the_rig(file: Path) -> None:
    changed(file, ("u = [0.25, -100.0]", 'u = "physical"\ny = "volts"'))
    with ScriptedEcu(str(file.parent)) as ecu, open_rig("emulator") as rig, open_dut(str(file)) as dut:
        run = Bench(rig, dut).play(SHORT, SEED)
        channel = rig.perform(SHORT, SEED).channels["force"]
        assert ecu.forces[: SHORT.samples] == pytest.approx(channel.physical(run.codes[:, 0]).tolist(), abs=0.13)
    (file.parent / "ecu.dbc").write_text(DBC.replace("7|16@0- (0.25,-100)", "7|8@0- (0.25,-100)"), encoding="utf-8")
    with (
        open_rig("emulator") as rig,
        open_dut(str(file)) as dut,
        pytest.raises(ConfigurationError, match="8 bits hold"),
    ):
        dut.prepare(rig.perform(SHORT, SEED).of_device, 5e-5)


def test_frame_of_can_fd_carries_all_in_one(tmp_path: Path) -> None:
    """Sample and answer in one frame of 20 bytes each, which CAN FD pads to its own lengths."""
    (tmp_path / "ecu.dbc").write_text(FD_DBC, encoding="utf-8")
    file = tmp_path / "fd.toml"
    file.write_text(FD_TOML.replace("CHANNEL", str(tmp_path)), encoding="utf-8")
    description = describe(str(file))
    assert isinstance(description, CanDbcDevice)
    messages = description.messages()
    (frame,) = messages.encoder()(3, 100, 200, True)  # noqa: FBT003
    assert (frame.is_fd, len(frame.data)) == (True, 20)
    database = loaded(FD_DBC)
    assert database.decode_message(0x10, frame.data[:18]) == {"U": 100, "Y": 200, "N": 3}
    data = database.encode_message(0x11, {"A": -1.25, "F": 1, "N": 3})
    answer = messages.answer(
        can.Message(arbitration_id=0x11, is_extended_id=False, is_fd=True, data=data.ljust(20, b"\0"))
    )
    assert answer is not None
    assert (answer.values, answer.counter) == ({"O.A": -1.25, "O.F": 1}, 3)


FD_DBC = """VERSION ""
NS_ :
BS_:
BU_: A B
BO_ 16 I: 18 A
 SG_ U : 7|16@0+ (1,0) [0|0] "" B
 SG_ Y : 112|16@1+ (1,0) [0|0] "" B
 SG_ N : 128|16@1+ (1,0) [0|0] "" B
BO_ 17 O: 18 B
 SG_ A : 64|64@1- (1,0) [0|0] "" A
 SG_ F : 0|1@1+ (1,0) [0|0] "" A
 SG_ N : 128|16@1+ (1,0) [0|0] "" A
SIG_VALTYPE_ 17 A : 2;
"""
FD_TOML = """kind = "can-dbc"
dbc = "ecu.dbc"
interface = "virtual"
channel = "CHANNEL"
fd = true
send = { u = "I.U", y = "I.Y", counter = ["I.N"] }
receive = { theta = ["O.A"], alarm = "O.F", counter = ["O.N"] }
"""
