"""Cortex-M firmware under QEMU: the same bits as everywhere, and every way to fail has its name."""

from __future__ import annotations

import dataclasses
import functools
import os
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from analogrig.bench import Bench
from analogrig.config import names
from analogrig.devices.device import Device, DeviceDescription
from analogrig.devices.library import InprocDevice
from analogrig.devices.processes import HostDevice, QemuDevice, QemuF405, QemuM4
from analogrig.devices.registry import KINDS, describe, from_table, reopen_dut
from analogrig.errors import ConfigurationError, LinkClosed, LinkError, LinkTimeout
from analogrig.estimator_config import EstimatorConfig
from analogrig.rigs.description import open_rig
from analogrig.run import Run
from analogrig.scenario import Scenario
from tests.harness.fed import catalogue
from tests.harness.firmware import CORES, FIRMWARE_IDS, FOLDER, needs_firmware
from tests.harness.processes import LONG_S, descendants

pytestmark = needs_firmware

GCC = "arm-none-eabi-gcc"

TIMEOUT_S = 0.1
"""Time-out of an answer of a QEMU that is stopped. Any other has LONG_S: on a busy machine it may wait for seconds."""
LONGEST = 750
"""Samples of a scenario that a test plays under QEMU, at a thousand a second: more than the trigger's warm-up."""
CHANGE_AT = 600
"""Sample of the first change: the trigger is armed by then."""


def play(description: DeviceDescription, scenario: Scenario) -> Run:
    with open_rig("emulator") as rig, description.connect() as dut:
        return Bench(rig, dut).play(scenario, seed=11)


def shortened(name: str) -> Scenario:
    """The first samples of a shipped scenario; its changes come nearer, so that some are among them."""
    scenario = Scenario.load(name)
    if scenario.samples <= LONGEST:
        return scenario
    at = scenario.changes[0].sample - CHANGE_AT if scenario.changes else 0
    changes = [dataclasses.replace(change, sample=change.sample - at) for change in scenario.changes]
    return dataclasses.replace(
        scenario,
        samples=LONGEST,
        changes=tuple(change for change in changes if change.sample + change.ramp_n < LONGEST),
    )


@functools.cache
def reference(name: str) -> tuple[Scenario, Run]:
    """A scenario, and its run with the device in this process."""
    scenario = shortened(name)
    return scenario, play(InprocDevice(name="bob", estimator=EstimatorConfig(**SETTINGS)), scenario)


SETTINGS: dict[str, Any] = {"orders": "given"}
"""Boards have room for two poles; a scenario's program may want more."""

DEVICES: dict[str, dict[str, str]] = {
    **{kind: {"kind": kind} for kind in ("qemu-m3", "qemu-m4", "qemu-m7", "host")},
    "m0": {"kind": "qemu-m3", "firmware": str(FOLDER / "analogrig-m0.elf")},
}
EXCHANGES = ("sample", "stream")


def combinations() -> Iterator[Any]:
    """Thesis profile on every device with both exchanges; each other scenario with one, by turns, on three devices.

    ``make test`` plays one of the three.
    """
    yield from (pytest.param("thesis", device, exchange) for device in DEVICES for exchange in EXCHANGES)
    for i, scenario in enumerate(name for name in names("scenarios") if name != "thesis"):
        for j, device in enumerate(DEVICES):
            if (turn := (i + j) % len(DEVICES)) in {0, 1, 3}:
                yield pytest.param(scenario, device, EXCHANGES[(i + j) % 2], marks=pytest.mark.heavy if turn else ())


@pytest.mark.parametrize(("scenario", "device", "exchange"), list(combinations()))
def test_every_scenario_gives_the_same_bits_on_every_device(scenario: str, device: str, exchange: str) -> None:
    """The M0 image runs on an M3, since QEMU has no M0 board."""
    played, expected = reference(scenario)
    table = {"name": "bob", "exchange": exchange, "timeout_s": LONG_S, "estimator": SETTINGS, **DEVICES[device]}
    run = play(from_table(table, "bob"), played)
    assert run.conditions.faults == ()
    assert run.theta_hash() == expected.theta_hash()
    assert (run.statistic == expected.statistic).all()
    assert (run.flags == expected.flags).all()
    assert run.alarm_index.tolist() == expected.alarm_index.tolist()


@pytest.mark.parametrize("options", ["exchange=sample", "exchange=stream"])
def test_stm32_gives_the_same_bits(options: str) -> None:
    """The port is the same as that of the other boards, but for the registers of its UARTs."""
    scenario = shortened("thesis")
    played = play(describe(f"qemu-f405?{options}&timeout_s={LONG_S}"), scenario)
    assert played.conditions.faults == ()
    assert played.theta_hash() == play(InprocDevice(name="bob"), scenario).theta_hash()


def test_shortened_scenarios_still_have_alarms() -> None:
    assert len(play(HostDevice(name="bob"), shortened("thesis")).alarm_index) > 0


@pytest.mark.parametrize("core", CORES)
def test_firmware_says_which_it_is_and_every_boot_has_its_number(core: str) -> None:
    nonces = set()
    for _ in range(2):
        with describe(f"qemu-{core}?timeout_s={LONG_S}").connect() as dut:
            identity = dut.description()["identity"]
            assert identity["firmware"] == FIRMWARE_IDS[core]
            nonces.add(identity["boot_nonce"])
    assert len(nonces) == 2


# ---- failures


def new_qemu(before: set[int]) -> int:
    """The one that we have started since; the tether takes a moment to become it."""
    deadline_s = time.monotonic() + LONG_S
    while time.monotonic() < deadline_s:
        for pid in set(descendants(os.getpid())) - before:
            if Path(f"/proc/{pid}/comm").read_text().startswith("qemu"):
                return pid
    raise AssertionError("no QEMU has been started")


@pytest.fixture
def started() -> Iterator[tuple[Device, int]]:
    """A device that is about to run, and the number of the QEMU that it runs in."""
    before = set(descendants(os.getpid()))
    with QemuM4(name="bob", timeout_s=LONG_S).connect() as dut:
        pid = new_qemu(before)
        dut.start()
        yield dut, pid
        dut.close()
        assert not Path(f"/proc/{pid}").exists()


def run(dut: Device) -> Run:
    with open_rig("emulator") as rig:
        return Bench(rig, dut).play(shortened("healthy"), seed=1)


def test_qemu_that_is_killed_is_told_with_its_status(started: tuple[Device, int]) -> None:
    dut, pid = started
    os.kill(pid, signal.SIGKILL)
    with pytest.raises(LinkClosed, match=r"^device bob: QEMU \(mps2-an386\) ended with status -9"):
        catalogue(dut).status()


def test_qemu_that_takes_its_time_to_start_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy machine; here it is stopped for longer than the time-out of any answer."""
    monkeypatch.setattr(QemuM4, "starting_s", LONG_S)
    before = set(descendants(os.getpid()))
    dut = catalogue(QemuM4(name="bob", timeout_s=TIMEOUT_S).open())
    pid = new_qemu(before)
    os.kill(pid, signal.SIGSTOP)

    def go_on() -> None:
        dut._talk.timeout_s = LONG_S
        os.kill(pid, signal.SIGCONT)

    timer = threading.Timer(5.0 * TIMEOUT_S, go_on)
    timer.start()
    with dut:
        assert dut.recover().firmware == "QEMU_M4"
    timer.join()


def test_qemu_that_hangs_is_told_and_ended(started: tuple[Device, int]) -> None:
    dut, pid = started
    os.kill(pid, signal.SIGSTOP)
    catalogue(dut)._talk.timeout_s = TIMEOUT_S
    with pytest.raises(LinkTimeout, match=r"^device bob: no .* within 0\.1 s"):
        catalogue(dut).status()


def test_what_is_no_firmware_is_told_in_the_words_of_qemu(tmp_path: Path) -> None:
    """Without a vector table the processor locks up."""
    (tmp_path / "nothing.elf").write_bytes(b"")
    with pytest.raises(LinkError, match=r"QEMU \(mps2-an386\) ended with status -6 \(SIGABRT\): qemu: fatal: Lockup"):
        describe(f"qemu-m4:{tmp_path}/nothing.elf").connect()


FAULT = "*(volatile int*)0xE0200000 = 1;"
"""A write where nothing is."""


def image(folder: Path, board: str, main: str) -> Path:
    """An image of the project's start-up code, a board, and a program of the test."""
    ports = Path(__file__).parents[2] / "estimator_c" / "ports"
    (folder / "main.c").write_text(main)
    options = ["-std=c99", "-mcpu=cortex-m4", "-mthumb", "-ffreestanding", "-nostdlib", "-nostartfiles"]
    paths = [f"-I{ports}/cortex_m", f"-I{ports}/loop/include", f"-L{ports}/{board}", f"-T{ports}/cortex_m/image.ld"]
    shared = [*(ports / part for part in ("cortex_m/start.c", "cortex_m/uart.c", "loop/memory.c"))]
    shared += (ports / board).glob("*.c")
    product = folder / "program.elf"
    subprocess.run([GCC, *options, *paths, folder / "main.c", *shared, "-lgcc", "-o", product], check=True)
    return product


@pytest.mark.tools(GCC)
def test_hard_fault_is_told_in_the_words_of_the_firmware(tmp_path: Path) -> None:
    faulty = image(tmp_path, "mps2", f"int main(void) {{ {FAULT} return 0; }}\n")
    with pytest.raises(LinkClosed, match=r"QEMU \(mps2-an386\) ended with status \d+: analogrig: hard fault"):
        describe(f"qemu-m4:{faulty}").connect()


@pytest.mark.tools(GCC)
def test_hard_fault_resets_an_stm32(tmp_path: Path) -> None:
    """It prints a line after each reset, and faults at the first byte that it receives."""
    main = f"""#include "uart.h"
int main(void) {{
    board_start();
    for (unsigned i = 0U; i < 5U; i++) {{ board_send(0U, (uint8_t)"boot\\n"[i]); }}
    while (!uart_has_input(0U)) {{ }}
    {FAULT}
    return 0;
}}
"""
    faulty = image(tmp_path, "stm32f405", main)
    wire = QemuF405(name="bob", firmware=str(faulty)).wire()
    for _ in range(3):
        printed = b""
        while not printed.endswith(b"\n"):
            printed += wire.read(LONG_S)
        assert printed == b"boot\n"
        wire.write(b"x")
    wire.close()


def test_absent_firmware_is_named_with_the_cure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ANALOGRIG_FIRMWARE", str(tmp_path))
    with pytest.raises(LinkError, match=f"there is no firmware {tmp_path}/analogrig-m4.elf: run `make firmware`"):
        describe("qemu-m4").connect()
    with pytest.raises(LinkError, match=f"^there is no firmware {Path('my.elf').absolute()}$"):
        describe("qemu-m4:my.elf").connect()


def test_absent_qemu_is_named_with_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(LinkError, match="qemu-system-arm is not installed: apt-get install qemu-system-arm"):
        describe("qemu-m4").connect()


def test_own_firmware_is_named_by_its_path_and_not_run_on_the_word_of_a_recording(tmp_path: Path) -> None:
    """It may ask QEMU for any file of this computer."""
    image = tmp_path / "my.elf"
    shutil.copyfile(FOLDER / "analogrig-m4.elf", image)
    with describe(f"qemu-m4:{image}").connect() as dut:
        record = dict(dut.description())
    with pytest.raises(ConfigurationError, match=f"run.npz: the device boots the firmware {image}, which no file may "):
        reopen_dut(record, "run.npz")
    own = {**record, "firmware": None}
    with reopen_dut({key: value for key, value in own.items() if value is not None}, "run.npz") as dut:
        assert dut.description()["kind"] == "qemu-m4"


def test_every_kind_of_qemu_is_in_the_registry() -> None:
    kinds = {f"qemu-{core}" for core in CORES}
    assert {kind for kind, cls in KINDS.items() if issubclass(cls, QemuDevice)} == kinds
