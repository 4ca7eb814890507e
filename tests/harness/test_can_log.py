"""CAN logs: read by other tools, imported, judged and replayed, damaged and foreign."""

from __future__ import annotations

import copy
import dataclasses
import io
import random
import struct
import subprocess
import sys
import tracemalloc
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import can
import cantools
import numpy as np
import pytest

from analogrig.bench import Bench
from analogrig.catalogue import LAYOUTS, Command, Controlled, Hello, Key, Result, pack, unpack
from analogrig.cli import main
from analogrig.devices.registry import open_dut
from analogrig.errors import ConfigurationError, RecordingError
from analogrig.estimator_config import EstimatorConfig
from analogrig.judging.verdict import judge
from analogrig.recordings import WRITTEN, CanLog, CapturedFrames, import_run, replace_scenario
from analogrig.reporting.run_summary import summary
from analogrig.rigs.description import open_rig
from analogrig.rigs.recording import RecordingRig
from analogrig.run import LOST, Run
from analogrig.scenario import Scenario
from tests.harness.commands import error_of, output_of
from tests.harness.processes import LONG_S

DBC = Path(__file__).parents[2] / "estimator_c" / "catalogue" / "analogrig.dbc"

SCENARIO = dataclasses.replace(
    Scenario.load("thesis"),
    samples=800,
    changes=tuple(dataclasses.replace(change, sample=650) for change in Scenario.load("thesis").changes[:1]),
)
SEED = 7

DEVICE = "inproc?link=can&bitrate=1000000"


def played(*listeners: Callable[[can.Message], object], device: str = DEVICE, **changes: Any) -> Run:
    def listen(frame: can.Message) -> None:
        for listener in listeners:
            listener(frame)

    with open_rig("emulator") as rig, open_dut(device, listener=listen, **changes) as dut:
        return Bench(rig, dut).play(SCENARIO, SEED)


@pytest.fixture(scope="module")
def traffic() -> tuple[Run, list[can.Message]]:
    """Run, and its frames."""
    frames: list[can.Message] = []
    return played(frames.append), frames


def written(path: Path, frames: Iterable[can.Message]) -> Path:
    log = CanLog(path)
    log.begin()
    for frame in frames:
        log(frame)
    log.close()
    return path


def captured(path: Path, **how: Any) -> Run:
    with open_rig("emulator") as rig:
        return import_run(path, SCENARIO, rig, **how)


def identifier(name: str) -> int:
    return LAYOUTS[name].id


def nth(frames: Sequence[can.Message], name: str, n: int) -> int:
    """Position of the n-th frame of that name."""
    return [i for i, frame in enumerate(frames) if frame.arbitration_id == identifier(name)][n]


def contradicting(frame: can.Message, *, later: int = 0) -> can.Message:
    """Copy of ``frame`` with another value, and a sequence number larger by ``later``."""
    other = copy.copy(frame)
    seq, *between, changed, last = frame.data
    other.data = bytearray(((seq + later) % 256, *between, changed ^ 1, last))
    return other


def without(frames: list[can.Message], *places: int) -> list[can.Message]:
    return [frame for i, frame in enumerate(frames) if i not in places]


# ------------------------------------------------------------------------------------------------- the users' tools


def test_cantools_decodes_a_candump_log_with_our_dbc(
    tmp_path: Path,
    traffic: tuple[Run, list[can.Message]],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run, frames = traffic
    first = nth(frames, "Sample", 0)
    log = written(tmp_path / "can.log", frames[first : first + 9])
    monkeypatch.setattr(sys, "argv", ["cantools", "decode", "--single-line", str(DBC)])
    monkeypatch.setattr(sys, "stdin", io.StringIO(log.read_text()))
    cantools._main()  # type: ignore[no-untyped-call]
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 9
    assert f"Force: {run.codes[0, 0]} code" in lines[0]
    assert f"Displacement: {run.codes[0, 1]} code" in lines[0]
    assert "Element: THETA_0" in lines[1]
    assert "Element: INNOVATION" in lines[7]
    assert "Stepped(" in lines[8]


@pytest.mark.parametrize("suffix", WRITTEN)
def test_readers_of_python_can_get_back_what_was_on_the_bus(
    tmp_path: Path, traffic: tuple[Run, list[can.Message]], suffix: str
) -> None:
    frames = traffic[1][:300]
    with can.LogReader(written(tmp_path / f"can.{suffix}", frames)) as reader:
        read = list(reader)
    assert [frame.arbitration_id for frame in read] == [frame.arbitration_id for frame in frames]
    assert [bytes(frame.data) for frame in read] == [bytes(frame.data) for frame in frames]
    assert [frame.is_rx for frame in read] == [frame.is_rx for frame in frames]


def test_asammdf_decodes_a_measurement_with_our_dbc(tmp_path: Path, traffic: tuple[Run, list[can.Message]]) -> None:
    asammdf = pytest.importorskip("asammdf", reason="asammdf is absent: pip install analogrig[mf4]")
    run, frames = traffic
    log = written(tmp_path / "can.mf4", frames)
    with asammdf.MDF(log) as raw, raw.extract_bus_logging({"CAN": [(str(DBC), 0)]}) as decoded:
        force = decoded.get("Force").samples
    np.testing.assert_array_equal(force, run.codes[:, 0])


# ------------------------------------------------------------------------------------------------------- what it was


@pytest.mark.parametrize("suffix", WRITTEN)
def test_log_holds_the_same_run(tmp_path: Path, traffic: tuple[Run, list[can.Message]], suffix: str) -> None:
    run, frames = traffic
    again = captured(written(tmp_path / f"can.{suffix}", frames))
    assert again.theta_hash() == run.theta_hash()
    np.testing.assert_array_equal(again.codes[:, :2], run.codes[:, :2])
    np.testing.assert_array_equal(again.flags, run.flags)
    np.testing.assert_array_equal(again.alarm_index, run.alarm_index)
    np.testing.assert_array_equal(again.diagnosis_onset, run.diagnosis_onset)
    assert again.conditions.counters == run.conditions.counters
    verdict = judge(run)  # whose ceiling travels in single precision
    assert dataclasses.replace(judge(again), ceiling=verdict.ceiling, arl0=verdict.arl0) == verdict
    assert judge(again).outcome == "passed"


@pytest.mark.parametrize(
    ("device", "changes"),
    [("inproc?link=can&fd=true", {"exchange": "block"}), (DEVICE, {"report_interval_n": 10})],
    ids=["blocks of CAN FD", "every tenth estimate"],
)
def test_log_of_another_exchange_holds_the_same_run(tmp_path: Path, device: str, changes: dict[str, Any]) -> None:
    log = CanLog(tmp_path / "can.log")
    log.begin()
    run = played(log, device=device, **changes)
    log.close()
    again = captured(tmp_path / "can.log")
    assert again.theta_hash() == run.theta_hash()
    np.testing.assert_array_equal(again.flags, run.flags)


def test_estimator_settings_come_from_the_captured_messages(
    tmp_path: Path, traffic: tuple[Run, list[can.Message]]
) -> None:
    run, frames = traffic
    said = captured(written(tmp_path / "can.log", frames)).conditions.dut["estimator"]
    assert singled(said) == singled({**run.conditions.dut["estimator"], "orders": "given"})  # the messages hold numbers


def singled(table: Mapping[str, Any]) -> dict[str, Any]:
    """Settings in single precision, as transmitted."""
    return {key: float(np.float32(value)) if isinstance(value, float) else value for key, value in table.items()}


def test_capture_without_the_handshake_has_a_note(tmp_path: Path, traffic: tuple[Run, list[can.Message]]) -> None:
    frames = traffic[1]
    whole = captured(written(tmp_path / "whole.log", frames))
    assert "not in the log" not in summary(whole, judge(whole))
    later = captured(written(tmp_path / "can.log", frames[nth(frames, "Sample", 0) :]))
    n = len(list(EstimatorConfig().settings()))
    said = f"note: {n} settings of the device are not in the log and were replaced by the default"
    assert said in summary(later, judge(later))


def test_settings_give_the_estimator_back() -> None:
    for estimator in (
        EstimatorConfig(na=1, nb=1, c=(0.5,), trigger="none", offset=False),
        EstimatorConfig(
            trigger="mean-between-faults", ceiling=30.0, reset="all", edge_instants="locked", absolute=True
        ),
    ):
        assert EstimatorConfig.from_settings(dict(estimator.settings()), "here") == estimator


def test_non_finite_setting_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="here: na = nan is no setting of an estimator"):
        EstimatorConfig.from_settings({Key.NA: float("nan")}, "here")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *((Key.NA, value) for value in (0.0, 9.0, 1.5, 1e30)),
        *((Key.NB, value) for value in (-5.0, 0.0, 2e6)),
        *((Key.NC, value) for value in (-1.0, 250.0)),
        *((Key.TRIGGER, value) for value in (-1.0, 99.0)),
        *((Key.FORGETTING, value) for value in (-1.0, 0.0, 1.5)),
        *((key, -1.0) for key in (Key.P0, Key.NOISE_VARIANCE, Key.EDGE_CODES, Key.WARM_UP_N, Key.NK)),
        (Key.OFFSET, 7.0),
        (Key.RESET, 9.0),
        (Key.CODE_LOW, 3e38),
        (Key.C1, 1e38),
    ],
)
def test_setting_out_of_range_is_refused(key: Key, value: float) -> None:
    with pytest.raises(ConfigurationError, match=rf"^here: {key.name.lower()} = .* is no setting of an estimator$"):
        EstimatorConfig.from_settings({key: value}, "here")


def test_more_parameters_than_theta_max_are_refused(tmp_path: Path, traffic: tuple[Run, list[can.Message]]) -> None:
    with pytest.raises(ConfigurationError, match="^here: 19 parameters, of at most 17$"):
        EstimatorConfig.from_settings({Key.NB: 16.0}, "here")
    frames = list(traffic[1])
    at = nth(frames, "Hello", 0)
    hello = unpack(bytes((frames[at].arbitration_id,)) + bytes(frames[at].data))
    assert isinstance(hello, Hello)
    frames[at] = copy.copy(frames[at])
    frames[at].data = bytearray(pack(hello._replace(theta_max=5))[1:])
    with pytest.raises(ConfigurationError, match=r"can\.log: 6 parameters, of at most 5$"):
        captured(written(tmp_path / "can.log", frames))


def test_foreign_frames_and_times_of_others_change_nothing(
    tmp_path: Path, traffic: tuple[Run, list[can.Message]]
) -> None:
    """Import a log with another channel name, absolute times and foreign frames."""
    run, frames = traffic
    rng = random.Random(3)  # noqa: S311
    lines = []
    for i, frame in enumerate(frames):
        lines.append(f"({1.7e9 + i * 1e-3:.6f}) can1 {frame.arbitration_id:03X}#{frame.data.hex()}")
        if i % 5 == 0:
            lines.append(f"({1.7e9 + i * 1e-3:.6f}) can1 {rng.randrange(0x100, 0x800):03X}#{rng.randbytes(4).hex()}")
    lines += ["(1700000001.0) can1 20000080#0000000000000000", "(1700000001.0) can1 00000018#00", "(1.0) can1 018#R"]
    log = tmp_path / "bench.log"
    log.write_text("\n".join(lines))
    again = captured(log)
    assert again.theta_hash() == run.theta_hash()
    assert judge(again).outcome == "passed"
    assert again.conditions.link_counters["frames_foreign"] == -(-len(frames) // 5) + 1
    assert again.conditions.link_counters["error_frames"] == 1
    assert again.conditions.link_counters["frames_dropped"] == 1


def test_log_with_identifiers_of_another_dbc_is_understood(
    tmp_path: Path, traffic: tuple[Run, list[can.Message]]
) -> None:
    """Import a log whose DBC has the same messages under 29-bit identifiers."""
    run, frames = traffic
    text = DBC.read_text()
    for layout in LAYOUTS.values():
        there = str(0x80000000 + 0x18FF0000 + layout.id)
        for word in (
            "BO_",
            "CM_ BO_",
            "CM_ SG_",
            "VAL_",
            "SIG_VALTYPE_",
            'BA_ "VFrameFormat" BO_',
            'BA_ "FrameSeed" BO_',
        ):
            text = text.replace(f"{word} {layout.id} ", f"{word} {there} ")
    dbc = tmp_path / "bench.dbc"
    dbc.write_text(text)
    moved = [
        can.Message(arbitration_id=0x18FF0000 + frame.arbitration_id, data=frame.data, is_rx=frame.is_rx)
        for frame in frames
    ]
    log = written(tmp_path / "can.log", moved)
    assert captured(log, dbc=dbc).theta_hash() == run.theta_hash()
    with pytest.raises(RecordingError, match=r"can\.log: holds no run of a device: \d+ frames have other identifiers"):
        captured(log)


@pytest.mark.parametrize("force", [100_000, -5])
def test_value_that_our_message_cannot_have_counts_as_dropped(
    tmp_path: Path, traffic: tuple[Run, list[can.Message]], force: int
) -> None:
    """Import a log whose DBC has signed 32-bit codes."""
    dbc = tmp_path / "bench.dbc"
    dbc.write_text(
        DBC.read_text()
        .replace("BO_ 24 Sample: 8", "BO_ 24 Sample: 12")
        .replace(" SG_ Force : 32|16@1+", " SG_ Force : 32|32@1-")
        .replace(" SG_ Displacement : 48|16@1+", " SG_ Displacement : 64|32@1+")
    )
    frames = [copy.copy(frame) for frame in traffic[1]]
    for frame in frames:
        if frame.arbitration_id == identifier("Sample"):
            codes = struct.unpack("<HH", frame.data[4:8])
            frame.data, frame.dlc, frame.is_fd = frame.data[:4] + struct.pack("<iI", *codes), 12, True
    assert judge(captured(written(tmp_path / "whole.log", frames), dbc=dbc)).outcome == "passed"
    at = nth(frames, "Sample", 40)
    frames[at].data = frames[at].data[:4] + struct.pack("<i", force) + frames[at].data[8:]
    again = captured(written(tmp_path / "can.log", frames), dbc=dbc)
    assert again.conditions.link_counters["frames_dropped"] == 1
    assert np.flatnonzero(again.lost).tolist() == [40]


# -------------------------------------------------------------------------------------------------------- what lacks


@pytest.mark.parametrize("name", ["Sample", "Estimate", "Stepped", "Alarm"])
def test_frame_that_was_not_captured_makes_the_run_inconclusive(
    tmp_path: Path, traffic: tuple[Run, list[can.Message]], name: str
) -> None:
    run, frames = traffic
    again = captured(written(tmp_path / "can.log", without(frames, nth(frames, name, 0))))
    assert again.samples == run.samples
    assert int(again.lost.sum()) == (1 if name != "Stepped" else int(again.lost.sum()))
    assert 1 <= int(again.lost.sum()) <= 2
    assert judge(again).outcome == "inconclusive"


@pytest.mark.parametrize("name", ["Configured", "Sample", "Estimate", "Stepped", "Alarm", "Status"])
def test_second_sender_makes_the_run_inconclusive(
    tmp_path: Path, traffic: tuple[Run, list[can.Message]], name: str
) -> None:
    frames = list(traffic[1])
    at = nth(frames, name, 0)
    other = contradicting(frames[at])
    twice = written(tmp_path / "twice.log", [*frames[:at], frames[at], *frames[at:]])
    assert judge(captured(twice)).outcome == "passed"
    verdict = judge(captured(written(tmp_path / "can.log", [*frames[:at], other, *frames[at:]])))
    assert verdict.outcome == "inconclusive"
    assert "have the same number: more than one " in verdict.reasons[0]


@pytest.mark.parametrize("name", ["Sample", "Estimate", "Stepped"])
def test_contradictory_messages_make_the_run_inconclusive(
    tmp_path: Path, traffic: tuple[Run, list[can.Message]], name: str
) -> None:
    frames = list(traffic[1])
    at = nth(frames, name, 40)
    other = contradicting(frames[at], later=50)
    verdict = judge(captured(written(tmp_path / "can.log", [*frames[:at], other, *frames[at:]]), most_lost_n=5))
    assert verdict.outcome == "inconclusive"
    assert verdict.reasons[0].endswith((" with two values", " with different values", " with different codes"))


@pytest.mark.parametrize("name", ["Estimate", "Stepped", "Alarm"])
def test_non_finite_number_counts_as_damaged(tmp_path: Path, traffic: tuple[Run, list[can.Message]], name: str) -> None:
    frames = list(traffic[1])
    at = nth(frames, name, 0)
    frames[at] = copy.copy(frames[at])
    frames[at].data = frames[at].data[:-4] + struct.pack("<f", float("nan"))
    again = captured(written(tmp_path / "can.log", frames))
    assert np.isfinite(again.theta).all()
    assert np.isfinite(again.statistic).all()
    assert again.conditions.link_counters["frames_dropped"] == 1
    assert judge(again).outcome == "inconclusive"


def test_gaps_up_to_the_limit_are_allowed(tmp_path: Path, traffic: tuple[Run, list[can.Message]]) -> None:
    run, frames = traffic
    gaps = [nth(frames, "Sample", n) for n in (10, 200, 210)]
    log = written(tmp_path / "can.log", without(frames, *gaps))
    assert judge(captured(log, most_lost_n=3)).outcome == "passed"
    verdict = judge(captured(log, most_lost_n=2))
    assert verdict.outcome == "inconclusive"
    assert verdict.reasons[0] == "3 samples were not or only in part in the log, more than 2"
    assert "missing for the device or not in the log: 3 samples" in summary(captured(log), verdict)
    lost = captured(log)
    assert np.flatnonzero(lost.flags & LOST).tolist() == [10, 200, 210]
    assert lost.missing[[10, 200, 210]].all()
    assert lost.theta_hash() == run.theta_hash()  # the device had them


def test_capture_that_ended_early_is_inconclusive(tmp_path: Path, traffic: tuple[Run, list[can.Message]]) -> None:
    frames = traffic[1]
    verdict = judge(captured(written(tmp_path / "can.log", frames[: nth(frames, "Stepped", 299) + 1])))
    assert verdict.outcome == "inconclusive"
    assert "the run ended after 300 of 800 samples" in verdict.reasons


def test_capture_without_the_counters_of_the_device_is_inconclusive(
    tmp_path: Path, traffic: tuple[Run, list[can.Message]]
) -> None:
    frames = traffic[1]
    silent = [frame for frame in frames if frame.arbitration_id != identifier("Status")]
    for heard in (silent, frames[: nth(frames, "Stepped", -1) + 1]):
        verdict = judge(captured(written(tmp_path / "can.log", heard)))
        assert verdict.outcome == "inconclusive"
        (reason,) = verdict.reasons
        assert reason.startswith("the device's counters updated, refused, alarms, samples_lost after the run are not")


def test_damaged_lines_are_skipped_and_counted(tmp_path: Path, traffic: tuple[Run, list[can.Message]]) -> None:
    run, frames = traffic
    log = written(tmp_path / "can.log", frames)
    lines = log.read_text().splitlines()
    lines[5:5] = [
        "",
        "hello",
        "(1.0) vcan0",
        "(1.0) vcan0 018#0",
        "(x) vcan0 018#00 R",
        "\x00\xff\x7f",
        "(1.0) vcan0 GGG#00 T",
    ]
    log.write_text("\n".join(lines), encoding="latin-1")
    reader = CapturedFrames(log)
    assert len(list(reader)) >= len(frames)
    assert reader.damaged[:2] == [7, 8]
    again = captured(log)
    assert again.theta_hash() == run.theta_hash()
    assert again.conditions.link_counters["lines_damaged"] == len(reader.damaged)


@pytest.mark.filterwarnings("error::pytest.PytestUnraisableExceptionWarning")  # asammdf has a destructor that fails
@pytest.mark.parametrize("suffix", ["blf", "mf4", "asc"])
def test_file_cut_anywhere_is_refused_or_inconclusive(
    tmp_path: Path, traffic: tuple[Run, list[can.Message]], suffix: str
) -> None:
    whole = written(tmp_path / f"whole.{suffix}", traffic[1]).read_bytes()
    cut = tmp_path / f"cut.{suffix}"
    for part in (0.0, 0.3, 0.9):
        cut.write_bytes(whole[: int(part * len(whole))])
        said = outcome_or_error(cut)
        assert said == "inconclusive" or said.startswith(f"{cut}: holds no run of a device"), part
        assert "\n" not in said


def test_measurement_that_is_damaged_is_refused_in_one_line(
    tmp_path: Path, traffic: tuple[Run, list[can.Message]]
) -> None:
    pytest.importorskip("asammdf", reason="asammdf is absent: pip install analogrig[mf4]")
    whole = written(tmp_path / "whole.mf4", traffic[1]).read_bytes()
    cut = tmp_path / "cut.mf4"
    cut.write_bytes(whole[:3000])
    words = ["-m", "analogrig.cli", "judge", str(cut), "--scenario", "thesis", "--out", str(tmp_path)]
    done = subprocess.run([sys.executable, *words], capture_output=True, check=False, timeout=LONG_S)
    assert done.returncode == 2
    assert done.stderr.decode().startswith(f"analogrig: {cut}: holds no run of a device: {cut} is damaged after 0 ")
    assert done.stderr.count(b"\n") == 1


def outcome_or_error(path: Path) -> str:
    try:
        return judge(captured(path)).outcome
    except RecordingError as error:
        return str(error)


def test_runs_without_samples_take_no_memory(tmp_path: Path, traffic: tuple[Run, list[can.Message]]) -> None:
    """A hostile log may start the device hundreds of thousands of times."""
    before = traffic[1][: nth(traffic[1], "Sample", 0)]

    def peak_bytes(starts: int) -> int:
        log = written(tmp_path / "can.log", before)
        with log.open("a") as file:
            for i in range(starts):
                started = pack(Controlled(i % 256, Command.START, 0, Result.APPLIED, i % 8))
                file.write(f"({i}.0) vcan0 {started[0]:03X}#{started[1:].hex()}\n")
        tracemalloc.start()
        with pytest.raises(RecordingError, match="holds no run of a device"):
            captured(log)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak

    peak_bytes(1)  # imports and caches are not counted below
    assert peak_bytes(5001) - peak_bytes(1) < 5000 * 200


def test_runs_of_a_log_are_selected_by_number(tmp_path: Path, traffic: tuple[Run, list[can.Message]]) -> None:
    run, frames = traffic
    twice = written(tmp_path / "can.log", [*frames, *frames])
    with pytest.raises(RecordingError, match=r"can\.log: holds 2 runs: select one with --run 1 to 2"):
        captured(twice)
    for number in (1, 2):
        assert captured(twice, number=number).theta_hash() == run.theta_hash()
    with pytest.raises(RecordingError, match=r"can\.log: has no run 3: there are 2"):
        captured(twice, number=3)


def test_device_of_another_catalogue_is_refused(tmp_path: Path, traffic: tuple[Run, list[can.Message]]) -> None:
    frames = list(traffic[1])
    at = nth(frames, "Hello", 0)
    hello = pack(Hello(0, 18, 0, 0x12345678))
    frames[at] = can.Message(arbitration_id=hello[0], data=hello[1:], is_extended_id=False)
    with pytest.raises(RecordingError, match=r"can\.log: the device uses catalogue 0x12345678, .* with --dbc"):
        captured(written(tmp_path / "can.log", frames))


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("can.log", "", "holds no run of a device"),
        ("can.log", "  can0  018   [8]  00 11 22 33 44 55 66 77\n", "1 line is no frame (at 1); candump -L writes"),
        ("can.csv", "a,b", "not a CAN log: the suffix must be one of .log, .blf, .asc, .mf4, .trc"),
        ("none.log", None, "No such file or directory"),
    ],
)
def test_file_that_is_no_log_is_refused_in_one_line(tmp_path: Path, name: str, text: str | None, said: str) -> None:
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(RecordingError) as error:
        captured(tmp_path / name)
    assert str(error.value).startswith(str(tmp_path / name))
    assert said in str(error.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "No such file or directory"),
        ("BO_ nonsense", "not a DBC"),
        ('VERSION ""\nBU_: A\nBO_ 1 Engine: 8 A\n SG_ Speed : 0|8@1+ (1,0) [0|0] "" A\n', "none of the messages"),
        (
            'VERSION ""\nBU_: A\nBO_ 24 Sample: 8 A\n SG_ Seq : 0|8@1+ (1,0) [0|0] "" A\n',
            "Sample lacks Displacement, F",
        ),
        (
            DBC.read_text().replace(" SG_ Value :", " SG_ Value m1 :").replace(" SG_ Element :", " SG_ Element M :"),
            "Estimate is multiplexed",
        ),
    ],
)
def test_unsuitable_dbc_is_refused_in_one_line(
    tmp_path: Path, traffic: tuple[Run, list[can.Message]], text: str | None, said: str
) -> None:
    if text is not None:
        (tmp_path / "own.dbc").write_text(text)
    with pytest.raises(ConfigurationError) as error:
        captured(written(tmp_path / "can.log", traffic[1][:5]), dbc=tmp_path / "own.dbc")
    assert str(error.value).startswith(f"--dbc {tmp_path / 'own.dbc'}: ")
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_scenario_with_fewer_samples_is_refused(tmp_path: Path, traffic: tuple[Run, list[can.Message]]) -> None:
    shorter = dataclasses.replace(SCENARIO, samples=799)
    with open_rig("emulator") as rig, pytest.raises(ConfigurationError, match="has 800 samples, scenario thesis 799"):
        import_run(written(tmp_path / "can.log", traffic[1]), shorter, rig)
    with pytest.raises(ConfigurationError, match="the recording has 800 samples"):
        replace_scenario(traffic[0], shorter)


def test_full_disk_is_reported_when_the_log_is_closed(traffic: tuple[Run, list[can.Message]], tmp_path: Path) -> None:
    log = CanLog(tmp_path / "gone" / "can.log")  # a folder that is not there
    log.begin()
    for frame in traffic[1][:10]:
        log(frame)
    with pytest.raises(RecordingError, match=r"can\.log: cannot be written: No such file"):
        log.close()


# -------------------------------------------------------------------------------------------------- the command line


def test_command_line_leaves_a_log_that_can_be_judged_and_replayed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    (out / "x").parent.mkdir()
    (out / "can.blf").write_text("of an earlier run")
    first = output_of("run", "--dut", DEVICE, "--out", str(out))
    (digest,) = [line for line in first.splitlines() if "theta hash" in line]
    assert {path.name for path in out.iterdir()} == {"can.log", "run.npz", "report.html", "verdict.json"}
    log = str(out / "can.log")
    for words in (["judge", log], ["judge", str(out / "run.npz")], ["replay", log, "--dut", "inproc"]):
        assert main([*words, "--scenario", "thesis", "--out", str(tmp_path / "again")]) == 0
        assert digest in capsys.readouterr().out
    assert "name one with --scenario" in error_of("judge", log)
    assert "name one with --dut" in error_of("replay", log, "--scenario", "thesis")


def test_log_that_is_played_stays_and_one_of_an_earlier_run_moves_aside(
    tmp_path: Path, traffic: tuple[Run, list[can.Message]], capsys: pytest.CaptureFixture[str]
) -> None:
    out, previous = tmp_path / "out", tmp_path / "out.previous"
    out.mkdir()
    log = written(out / "can.log", traffic[1])
    before = log.read_bytes()
    (out / "can.blf").write_text("of an earlier run")
    replay = ["replay", str(log), "--scenario", "thesis", "--out", str(out)]
    for words in ([*replay, "--dut", "inproc"], [*replay, "--dut", DEVICE, "--can-log", "mf4"]):
        assert main(words) == 2
        assert "would overwrite the CAN log that is played; choose another folder" in capsys.readouterr().err
        assert log.read_bytes() == before
    unreachable = ["--dut", DEVICE, "--wire-faults", "drop@1.0"]
    assert main(["run", *unreachable, "--scenario", "thesis", "--out", str(out)]) == 2
    assert {path.name for path in out.iterdir()} == {"report.html", "verdict.json"}
    assert (previous / "can.log").read_bytes() == before
    assert (previous / "can.blf").read_text() == "of an earlier run"


@pytest.mark.parametrize("option", ["--most-lost", "--run"])
@pytest.mark.parametrize("value", ["-1", "1.5", "many", "9" * 30])
def test_number_of_samples_or_of_a_run_is_a_count(option: str, value: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["judge", "can.log", "--scenario", "thesis", f"{option}={value}"])
    assert end.value.code == 2
    assert f"argument {option}: must be a whole number from 0" in capsys.readouterr().err


def test_serial_run_leaves_no_can_log(tmp_path: Path) -> None:
    words = ["run", "--dut", "inproc", "--scenario", "thesis", "--out", str(tmp_path)]
    assert "--can-log blf: device inproc is not on a CAN bus" in error_of(*words, "--can-log", "blf")
    assert {path.name for path in tmp_path.iterdir()} == {"report.html", "verdict.json"}
    for more in ([], ["--can-log", "none"]):
        assert main([*words, *more]) == 0
        assert {path.name for path in tmp_path.iterdir()} == {"run.npz", "report.html", "verdict.json"}


def test_replay_of_a_log_plays_the_samples_that_it_has(tmp_path: Path, traffic: tuple[Run, list[can.Message]]) -> None:
    run, frames = traffic
    rig = RecordingRig.of(captured(written(tmp_path / "can.log", frames)), tmp_path / "can.log")
    with rig, open_dut("inproc") as dut:
        again = Bench(rig, dut).play(rig.scenario(), rig.run.conditions.seed)
    assert again.theta_hash() == run.theta_hash()
    assert "bus:" not in summary(again, judge(again))
