"""Programs as devices: samples on standard input, answers on standard output."""

from __future__ import annotations

import dataclasses
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from analogrig.answers import Answers, Samples
from analogrig.bench import Bench
from analogrig.catalogue import SteppedFlag
from analogrig.devices import child
from analogrig.devices.device import Device
from analogrig.devices.registry import describe
from analogrig.errors import AnalogrigError, LinkError, LinkTimeout
from analogrig.rigs.description import open_rig
from analogrig.run import Run
from analogrig.scenario import Scenario
from analogrig_lines.lines import ProgramDevice
from tests.harness.processes import LONG_S, descendants, ends

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "harness" / "examples" / "program"
THESIS_7 = "54f04f72e4f6d22a"
"""First digits of the hash of every device of ours: the scenario thesis, seed 7."""

ECHO = """\
import sys
k = 0
for line in sys.stdin:
    u, y = map(int, line.split(","))
    {fault}
    k += 1
    print(u + y, int(u == 105), flush=True)
"""
"""A program in Python whose estimate is the sum of u and y."""


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("program")
    shutil.copytree(EXAMPLE, folder, dirs_exist_ok=True)
    subprocess.run(["make", "--silent", f"ESTIMATOR={ROOT / 'estimator_c'}"], cwd=folder, check=True)
    return folder


def scripted(tmp_path: Path, fault: str = "pass", timeout_s: float = LONG_S) -> ProgramDevice:
    script = tmp_path / "program.py"
    script.write_text(ECHO.format(fault=fault))
    return ProgramDevice(
        name="bob", arguments=(sys.executable, str(script)), receive="{a1:g} {alarm:d}\n", timeout_s=timeout_s
    )


def samples(n: int, missing: Sequence[int] = ()) -> Samples:
    index = np.arange(n)
    return Samples(0, (100 + index).astype(np.uint16), index.astype(np.uint16), ~np.isin(index, missing))


def play(device: Device, n: int, missing: Sequence[int] = ()) -> Answers:
    device.start()
    (answers,) = device.play([samples(n, missing)])
    device.stop()
    return answers


def play_impatiently(device: Device, patient_n: int, n: int) -> None:
    """Play with a short time-out after the first samples: only starting the program takes long."""
    everything = samples(n)

    def blocks() -> Iterator[Samples]:
        for cut, timeout_s in ((slice(patient_n), LONG_S), (slice(patient_n, n), 0.1)):
            device._description = dataclasses.replace(device._description, timeout_s=timeout_s)
            yield Samples(cut.start or 0, everything.u[cut], everything.y[cut], everything.valid[cut])

    device.start()
    list(device.play(blocks()))


def thesis(description: ProgramDevice) -> Run:
    with open_rig("emulator") as rig, description.connect() as dut:
        return Bench(rig, dut).play(Scenario.load("thesis"), seed=7)


def described(folder: Path) -> ProgramDevice:
    description = describe(str(folder / "my_program.toml"))
    assert isinstance(description, ProgramDevice)
    return description


@pytest.mark.parametrize(("window", "pty"), [(1, False), (16, False), (1, True), (16, True)])
def test_program_around_our_estimator_gives_the_estimates_of_every_device(
    example: Path, window: int, *, pty: bool
) -> None:
    run = thesis(dataclasses.replace(described(example), window=window, pty=pty))
    assert run.theta_hash().startswith(THESIS_7)
    assert not run.conditions.faults


def test_each_record_begins_anew(tmp_path: Path, example: Path) -> None:
    for description in (scripted(tmp_path), described(example)):
        with description.connect() as device:
            first, second = play(device, 40), play(device, 40)
            assert first.theta is not None
            assert second.theta is not None
            assert (first.theta == second.theta).all()


def test_alarms_and_missing_samples_have_their_places(tmp_path: Path) -> None:
    with scripted(tmp_path).connect() as device:
        answers = play(device, 8, missing=[0, 3, 7])
    assert [alarm.index for alarm in answers.alarms] == [5]
    assert answers.theta is not None
    assert answers.theta.ravel().tolist() == [0, 102, 104, 104, 108, 110, 112, 112]
    assert np.flatnonzero(answers.flags == SteppedFlag.MISSING).tolist() == [0, 3, 7]
    assert np.count_nonzero(answers.flags) == 3


@pytest.mark.parametrize("window", [1, 4])
@pytest.mark.parametrize("step", [0, 2])
@pytest.mark.parametrize(
    ("fault", "told"),
    [
        ("import os; os.kill(os.getpid(), 11)", "program {0} ended with status -11 (SIGSEGV) {1}"),
        ("os = __import__('os'); os.abort()", "program {0} ended with status -6 (SIGABRT) {1}"),
        ("sys.exit(0)", "program {0} ended with status 0 {1}"),
        ("sys.exit('bad: no luck')", "program {0} ended with status 1: bad: no luck {1}"),
        (
            "print('nan 0', flush=True); continue",
            "a1 = nan for sample {2}, which is not finite or too large for a float",
        ),
        ("print('1e999 0', flush=True); continue", "a1 = inf for sample {2}, which is not finite or too large"),
        ("print('x' * 5000, end='', flush=True); sys.stdin.read()", "of a line for sample {2}"),
    ],
    ids=["segv", "abort", "exit(0)", "exit(1)", "nan", "1e999", "long line"],
)
def test_fault_of_a_program_is_told_with_its_sample(
    tmp_path: Path, fault: str, told: str, step: int, window: int
) -> None:
    description = dataclasses.replace(scripted(tmp_path, f"if k == {step}: {fault}"), window=window)
    place = f"after sample {step - 1}" if step else "before the first answer"
    with description.connect() as device, pytest.raises(AnalogrigError) as raised:
        play(device, 4)
    assert str(raised.value).startswith("device bob: ")
    if window == 1 or "{2}" not in told:
        assert told.format(sys.executable, place, step) in str(raised.value)


@pytest.mark.parametrize("pty", [False, True])
def test_program_that_hangs_is_told_with_its_sample_and_started_anew(tmp_path: Path, *, pty: bool) -> None:
    hanging = dataclasses.replace(scripted(tmp_path, "if k == 3: sys.stdin.read(); break"), pty=pty)
    with hanging.connect() as device:
        for _ in range(2):
            with pytest.raises(LinkTimeout, match=r"^device bob: no answer to sample 3 within 0\.1 s$"):
                play_impatiently(device, 3, 8)


def test_program_that_does_not_flush_is_told_the_cure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PYTHONUNBUFFERED", raising=False)
    script = tmp_path / "program.py"
    script.write_text("import sys\nfor line in sys.stdin: print(0)\n")
    with (
        ProgramDevice(name="bob", arguments=(sys.executable, str(script)), timeout_s=0.2).connect() as device,
        pytest.raises(LinkTimeout, match=r"no answer to sample 0 within 0\.2 s; .* buffered: call fflush\(stdout\)"),
    ):
        play(device, 8)


def test_program_ends_with_its_device(tmp_path: Path) -> None:
    before = set(descendants(os.getpid()))
    device = scripted(tmp_path).connect()
    play(device, 4)
    (tether, program) = set(descendants(os.getpid())) - before
    device.close()
    device.close()
    assert ends(tether)
    assert ends(program)


def test_program_that_is_not_there_is_told() -> None:
    with pytest.raises(LinkError, match=r"^device exec:\./none: there is no program /.*/none$"):
        describe("exec:./none").connect()


BINARY = """\
import struct, sys
k = 0
while record := sys.stdin.buffer.read1(9 * {chunk}):
    for u, y, valid in struct.iter_unpack("<ffB", record):
        if k == {fault_at}:
            {fault}
        k += 1
        sys.stdout.buffer.write(struct.pack("<Bfd", u == 105, u + y, k))
    sys.stdout.buffer.flush()
"""


def binary(tmp_path: Path, fault: str = "pass", fault_at: int = -1, **changes: Any) -> ProgramDevice:
    script = tmp_path / "program.py"
    script.write_text(BINARY.format(chunk=64, fault=fault, fault_at=fault_at))
    description = ProgramDevice(
        name="bob", arguments=(sys.executable, str(script)), format="binary", window=64, timeout_s=LONG_S,
        send="{u:f32}{y:f32}{valid:u8}", receive="{alarm:u8}{a1:f32}{statistic:f64}",
    )  # fmt: skip
    return dataclasses.replace(description, **changes)


@pytest.mark.parametrize("window", [1, 7, 64])
def test_records_of_a_binary_program(tmp_path: Path, window: int) -> None:
    with binary(tmp_path, window=window).connect() as device:
        for _ in range(2):
            answers = play(device, 150, missing=[3])
            assert answers.theta is not None
            assert answers.statistic is not None
            assert answers.statistic.tolist() == list(range(1, 151))
            assert answers.theta[:3].ravel().tolist() == [100, 102, 104]
            assert [(alarm.index, alarm.statistic) for alarm in answers.alarms] == [(5, 6.0)]
            assert np.flatnonzero(answers.flags).tolist() == [3]


def test_missing_samples_are_left_out_of_records_without_valid(tmp_path: Path) -> None:
    description = dataclasses.replace(binary(tmp_path), send="{u:f32}{y:f32}")
    script = tmp_path / "program.py"
    text = script.read_text(encoding="utf-8")
    script.write_text(text.replace("<ffB", "<ff").replace("u, y, valid", "u, y").replace("9 *", "8 *"))
    with description.connect() as device:
        answers = play(device, 6, missing=[0, 3])
    assert answers.theta is not None
    assert answers.theta.ravel().tolist() == [0, 102, 104, 104, 108, 110]
    assert answers.flags.tolist() == [SteppedFlag.MISSING, 0, 0, SteppedFlag.MISSING, 0, 0]


@pytest.mark.parametrize(
    ("fault", "told"),
    [
        (
            "sys.stdout.buffer.flush(); import os; os.kill(os.getpid(), 11)",
            "ended with status -11 (SIGSEGV) after sample 4",
        ),
        ("sys.stdout.buffer.flush(); sys.exit(0)", "ended with status 0 after sample 4"),
        ("u = float('nan')", "a1 = nan for sample 5, which is not finite"),
        ("sys.stdout.buffer.write(bytes(13))", "sent more answers than samples"),
    ],
)
def test_fault_of_a_binary_program_is_told_with_its_sample(tmp_path: Path, fault: str, told: str) -> None:
    with binary(tmp_path, fault, 5).connect() as device, pytest.raises(AnalogrigError, match=re.escape(told)):
        play(device, 256)


@pytest.mark.parametrize("text", [False, True])
def test_answers_before_the_end_of_a_program_count(tmp_path: Path, *, text: bool) -> None:
    end = "sys.stdout.flush(); sys.exit(0)"
    program = scripted(tmp_path, f"if k == 400: {end}") if text else binary(tmp_path, end, 400)
    with program.connect() as device, open_rig("emulator") as rig:
        run = Bench(rig, device).play(Scenario.load("healthy"), seed=7)
    assert run.samples == 400
    assert "ended with status 0 after sample 399" in run.conditions.faults[0]
    assert np.array_equal(run.theta[:, 0], run.codes[:, :2].sum(axis=1))


def test_program_that_closes_its_output_is_ended_and_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(child, "END_TIMEOUT_S", LONG_S)
    monkeypatch.setattr(child, "CLOSED_TIMEOUT_S", 0.0)
    device = scripted(tmp_path, "if k == 2: import os; os.close(1); sys.stdin.read()").connect()
    with device, pytest.raises(LinkError, match="program .* closed its line after sample 1$"):
        play(device, 4)


def test_binary_program_that_hangs_is_told_with_its_sample(tmp_path: Path) -> None:
    hanging = binary(tmp_path, "sys.stdout.buffer.flush(); sys.stdin.read()", 5)
    with (
        hanging.connect() as device,
        pytest.raises(LinkTimeout, match=r"^device bob: no answer to sample 5 within 0\.1 s$"),
    ):
        play_impatiently(device, 5, 64)


FIRMWARE = """\
import sys
out = lambda text: print(text, end="\\r\\n", flush=True)
out("MYFW 0.3 of today")
for k, line in enumerate(sys.stdin):
    if line == "R\\n":
        out("DONE")
    elif {reboots} and k == 4:
        out("MYFW 0.3 of today")
    else:
        out("0")
"""
"""A firmware whose lines end with a carriage return too."""


@pytest.mark.parametrize("reboots", [False, True])
def test_carriage_returns_are_ignored_and_the_banner_is_a_beginning(tmp_path: Path, *, reboots: bool) -> None:
    script = tmp_path / "firmware.py"
    script.write_text(FIRMWARE.format(reboots=reboots))
    described = ProgramDevice(
        name="bob",
        arguments=(sys.executable, str(script)),
        receive="{alarm:d}\n",
        reset="R\n",
        reset_answer="DONE",
        banner="MYFW",
    )
    five = Samples(0, np.zeros(5, np.uint16), np.zeros(5, np.uint16), np.ones(5, np.bool_))
    with described.connect() as device:
        device.start()
        if reboots:
            with pytest.raises(AnalogrigError, match="was reset before the answer to sample"):
                list(device.play([five]))
        else:
            assert sum(map(len, device.play([five]))) == 5
            device.stop()


TWICE = """\
import sys
for k, line in enumerate(sys.stdin):
    print("OK" if line == "R\\n" else "0\\n0" if k == 5 else "0", flush=True)
"""


def test_answer_that_comes_twice_is_not_the_answer_to_the_next_sample(tmp_path: Path) -> None:
    script = tmp_path / "twice.py"
    script.write_text(TWICE)
    ten = Samples(0, np.zeros(10, np.uint16), np.zeros(10, np.uint16), np.ones(10, np.bool_))
    described = ProgramDevice(
        name="bob",
        arguments=(sys.executable, str(script)),
        receive="{alarm:d}\n",
        reset="R\n",
        reset_answer="OK",
    )
    with described.connect() as device:
        device.start()
        with pytest.raises(AnalogrigError, match="sent more answers than samples, the first after sample"):
            _ = [*device.play([ten]), device.stop()]


def test_what_is_sent_must_hold_a_signal() -> None:
    with pytest.raises(ValueError, match="^send must hold"):
        ProgramDevice(name="bob", arguments=("p",), send="\n", receive="{alarm:d}\n")
