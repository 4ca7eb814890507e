"""The example with a text protocol: as a program, and on the emulated STM32F405."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from analogrig.bench import Bench
from analogrig.config import read_toml
from analogrig.devices.library import InprocDevice
from analogrig.devices.processes import QemuF405
from analogrig.devices.registry import from_table
from analogrig.rigs.description import open_rig
from analogrig.run import Run
from analogrig.scenario import Scenario
from analogrig_emulator import CHANNELS
from tests.harness.firmware import FOLDER, needs_firmware
from tests.harness.processes import LONG_S

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "harness" / "examples" / "text_firmware"
BANNER = "text firmware with est"
N = 1300
"""Samples that the board plays: the stiffness falls at 1200."""
IN_FLIGHT = 16
"""Lines on the way to the board, whose buffer holds 4,096 bytes."""


@pytest.fixture(scope="module")
def played() -> Run:
    with open_rig("emulator") as rig, InprocDevice(name="bob").connect() as dut:
        return Bench(rig, dut).play(Scenario.load("thesis"), seed=7)


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("text")
    shutil.copytree(EXAMPLE, folder, dirs_exist_ok=True)
    subprocess.run(["make", "--silent", f"ESTIMATOR={ROOT / 'estimator_c'}"], cwd=folder, check=True)
    return folder / "text_firmware"


def lines(run: Run, samples: int) -> list[str]:
    force, displacement = (run.codes[:samples, CHANNELS.index(name)] for name in CHANNELS[:2])
    return [f"{index},{u},{y}" for index, (u, y) in enumerate(zip(force, displacement, strict=True))]


def answers(program: Path, *asked: str) -> list[str]:
    """Answers of the program, without the banner."""
    done = subprocess.run(
        [program], input="".join(f"{line}\n" for line in asked), capture_output=True, text=True, check=True
    )
    banner, *told = done.stdout.splitlines()
    assert banner == BANNER
    return told


def check(told: list[str], run: Run) -> None:
    """:raises AssertionError: estimates or alarms are not those of the run, bit for bit."""
    fields = [line.split(",") for line in told]
    assert [int(each[0]) for each in fields] == list(range(len(told)))
    assert (bits(fields) == run.theta[: len(told)].view(np.uint32)).all()
    alarms = [index for index, each in enumerate(fields) if each[-1] == "1"]
    assert alarms == [index for index in run.alarm_index if index < len(told)]
    assert alarms


def bits(fields: list[list[str]]) -> NDArray[np.uint32]:
    return np.array([[int(word, 16) for word in each[1:-1]] for each in fields], np.uint32)


def test_program_gives_the_estimates_of_every_device(program: Path, played: Run) -> None:
    check(answers(program, *lines(played, played.samples)), played)


@needs_firmware
def test_emulated_board_gives_the_estimates_of_every_device(played: Run) -> None:
    wire = QemuF405(name="bob", firmware=str(FOLDER / "text_firmware.elf")).wire()
    asked, received = lines(played, N), b""
    try:
        for first in range(-IN_FLIGHT, N, IN_FLIGHT):  # the banner alone at first: until it starts, QEMU drops bytes
            wire.write("".join(f"{line}\n" for line in asked[max(0, first) : first + IN_FLIGHT]).encode())
            while received.count(b"\n") < min(first + IN_FLIGHT, N) + 1:
                came = wire.read(LONG_S)
                assert came, f"silent after {received[-80:]!r}"
                received += came
    finally:
        wire.close()
    banner, *told = received.decode().splitlines()
    assert banner == BANNER
    check(told, played)


@pytest.fixture
def terminal() -> Iterator[str]:
    """The pseudo-terminal of a running board."""
    command = ["qemu-system-arm", "-machine", QemuF405.machine, "-kernel", str(FOLDER / "text_firmware.elf")]
    command += ["-display", "none", "-monitor", "none", "-chardev", "pty,id=line", "-serial", "chardev:line"]
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        (path,) = re.findall(r"/dev/\S+", process.stdout.readline())
        yield path
        process.kill()


@needs_firmware
def test_board_is_played_by_the_device_file_of_the_example(terminal: str, played: Run) -> None:
    table = read_toml(EXAMPLE / "text_firmware.toml") | {"name": "bob", "url": terminal, "timeout_s": LONG_S}
    with open_rig("emulator") as rig, from_table(table, "bob").connect() as dut:
        run = Bench(rig, dut).play(Scenario.load("thesis"), seed=7)
    assert run.conditions.faults == ()
    assert run.theta_hash() == played.theta_hash()
    assert (run.alarm_index == played.alarm_index).all()


def test_sample_without_an_index_has_the_next(program: Path, played: Run) -> None:
    numbered = lines(played, 200)
    assert answers(program, *numbered) == answers(program, *(line.partition(",")[2] for line in numbered))


def test_index_left_out_is_a_missing_sample(program: Path, played: Run) -> None:
    numbered = lines(played, 300)
    dashes = [*numbered[:250], "250,-", "-", *numbered[252:]]
    told = answers(program, *dashes)
    assert answers(program, *numbered[:250], *numbered[252:]) == told[:250] + told[252:]
    assert told[250].split(",")[1:] == told[251].split(",")[1:] == told[249].split(",")[1:]


def test_repeated_index_is_answered_again_and_changes_nothing(program: Path, played: Run) -> None:
    numbered = lines(played, 300)
    twice = answers(program, *numbered[:250], "garbage", numbered[249], *numbered[250:])
    once = answers(program, *numbered)
    assert twice == [*once[:250], "ERROR", once[249], *once[250:]]


def test_reset_begins_anew(program: Path, played: Run) -> None:
    numbered = lines(played, 300)
    once = answers(program, *numbered)
    assert answers(program, *numbered, "R\r", *numbered) == [*once, "OK", *once]


@pytest.mark.parametrize(
    "line",
    [
        *("", "r", "RR", "R,1", "1", "1,", ",1", "1,2,", "1,2,3,4", "-,1", "1,-,2", "-,-", "--,1", "1.5,2", "a,b"),
        *("-1,2,3", "1 ,2", "9999999999,1", "1,9999999999", 60 * "1", f"0,1,{60 * '0'}1", "199,1,2\0"),
    ],
)
def test_malformed_line_is_refused_and_changes_nothing(program: Path, played: Run, line: str) -> None:
    numbered = lines(played, 200)
    assert answers(program, *numbered[:199], line, numbered[199]) == [
        *answers(program, *numbered[:199]),
        "ERROR",
        answers(program, *numbered)[-1],
    ]
