"""Estimators in plain C libraries: the same answers wherever they run, and every fault named with its sample."""

from __future__ import annotations

import dataclasses
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from enum import IntEnum
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from analogrig import Bench, Run, Scenario, judge, open_dut, open_rig
from analogrig.answers import Answers, Samples
from analogrig.campaigns.together import direct_bench
from analogrig.catalogue import SteppedFlag
from analogrig.cli import main
from analogrig.datasheet import Datasheet
from analogrig.devices import registry
from analogrig.devices.device import Device
from analogrig.devices.estimator_library import EstimatorLibrary, EstimatorLibraryDevice
from analogrig.errors import ConfigurationError, DeviceError, DeviceRefused, TimeLimitReached
from analogrig.rigs.emulator import is_emulated
from tests.harness.commands import error_of, output_of
from tests.harness.library_builds import FAULTY, OWN, build, build_est
from tests.harness.processes import children, ends

HANG_S = 0.2
N = 1000


class Fault(IntEnum):
    """Faults of faulty_library.c."""

    NONE = 0
    SEGV = 1
    ABORT = 2
    EXIT_0 = 3
    STACK = 4
    HANG = 5
    CLOSE = 6
    INPUT = 7
    STATE = 8
    RECORD = 9
    UNDONE = 10
    NOT_A_NUMBER = 11
    PRINT = 12
    NEXT_BYTE = 13
    EXTRA = 14
    FORK = 15
    INIT = 16


ENDS = {
    Fault.SEGV: r"status -11 \(SIGSEGV\)",
    Fault.ABORT: r"status -6 \(SIGABRT\)",
    Fault.EXIT_0: "status 0",
    Fault.STACK: r"status -11 \(SIGSEGV\)",
    Fault.INPUT: r"status -11 \(SIGSEGV\)",
    Fault.STATE: r"status -11 \(SIGSEGV\)",
}
"""Ends of the child process by fault."""


@pytest.fixture(scope="module")
def faulty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("faulty") / "faulty.so", FAULTY)


@pytest.fixture(scope="module")
def est(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_est(tmp_path_factory.mktemp("est"))


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("own") / "own.so", OWN)


@pytest.fixture
def opened(faulty: Path) -> Iterator[Callable[..., EstimatorLibraryDevice]]:
    """Opens the faulty library with a fault at a sample."""
    devices: list[Device] = []

    def open_faulty(fault: Fault = Fault.NONE, at: int = 0, *, timeout_s: float = 60.0) -> EstimatorLibraryDevice:
        settings = {"fault": int(fault), "at": at}
        description = EstimatorLibrary(name="bob", library=str(faulty), timeout_s=timeout_s, settings=settings)
        devices.append(description.connect())
        return cast(EstimatorLibraryDevice, devices[-1])

    yield open_faulty
    for device in devices:
        device.close()


def samples(n: int = N, *, first: int = 0, seed: int = 1) -> Samples:
    """Samples of which every seventh is missing."""
    draw = np.random.default_rng(seed)
    u, y = (draw.integers(0, 4096, n).astype(np.uint16) for _ in range(2))
    return Samples(first, u, y, np.arange(first, first + n) % 7 != 6)


def cut(whole: Samples, n: int) -> Iterator[Samples]:
    """The same samples in blocks of ``n``."""
    for start in range(0, len(whole), n):
        rows = slice(start, start + n)
        yield Samples(whole.first + start, whole.u[rows], whole.y[rows], whole.valid[rows])


def joined(answers: list[Answers]) -> tuple[list[int], bytes]:
    """Alarms, and the bits of all else."""
    alarms = [alarm.index for each in answers for alarm in each.alarms]
    arrays = [getattr(each, name) for name in ("flags", "theta", "statistic") for each in answers]
    return alarms, b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)


def played(device: Device, *blocks: Samples) -> tuple[list[int], bytes]:
    device.start()
    return joined(list(device.play(blocks)))


def pids(device: EstimatorLibraryDevice) -> tuple[int, int]:
    """The tether and the child."""
    host = device._host
    (pid,) = children(host._child.tether_pid)
    return host._child.tether_pid, pid


def run_of(device: Device, scenario: str = "thesis", seed: int = 7) -> Run:
    with open_rig("emulator") as rig:
        return Bench(rig, device).play(Scenario.load(scenario), seed=seed)


# ---- answers


@pytest.mark.tools("g++", "clang")
@pytest.mark.parametrize("compiler", ["gcc", "clang", "g++", "clang++"])
@pytest.mark.parametrize("macro", ["ESTIMATOR", "ESTIMATOR_WITH_SETTINGS"])
def test_header_compiles_without_a_warning(compiler: str, macro: str, tmp_path: Path) -> None:
    is_cpp = compiler.endswith("++")
    takes = "set, " if macro.endswith("SETTINGS") else ""
    source = tmp_path / ("mine.cpp" if is_cpp else "mine.c")
    text = """
    #include "analogrig_estimator.h"
    typedef struct { float y; } mine_t;
    static int init(mine_t* self) { self->y = 1.0F; return 0; }
    SET
    static void step(mine_t* self, const analogrig_in_t* in, analogrig_out_t* out) { out->theta[0] = self->y += in->y; }
    """
    setter = "static int set(mine_t* self, const char* name, double value) { self->y = (float)value; return *name; }"
    text = text.replace("SET", setter if takes else "")
    source.write_text(f'{text}ANALOGRIG_{macro}(mine_t, init, {takes}step, "mine", 1, ANALOGRIG_ARMED);\n')
    flags = ("-Wpedantic", "-Wconversion", "-Wshadow", f"-std={'c++11' if is_cpp else 'c99'}")
    library = build(tmp_path / "mine.so", source, flags=flags, compiler=compiler)
    with EstimatorLibrary(name="mine", library=str(library)).connect() as device:
        assert device.datasheet == Datasheet(theta_n=1, armed=True)


def test_our_estimator_has_the_estimates_and_alarms_of_our_device(est: Path) -> None:
    with EstimatorLibrary(name="est", library=str(est)).connect() as device:
        run = run_of(device)
    with open_dut("inproc") as ours:
        expected = run_of(ours)
    assert run.theta_hash() == expected.theta_hash()
    assert run.theta_hash().startswith("54f04f72e4f6d22a")
    assert run.alarm_hash() == expected.alarm_hash()
    assert np.array_equal(run.innovation, expected.innovation)
    assert np.array_equal(run.statistic, expected.statistic)


def test_any_blocks_have_the_same_answers(opened: Callable[..., EstimatorLibraryDevice]) -> None:
    device, whole = opened(), samples(40_000)
    expected = played(device, whole)
    assert expected[0] == list(range(99, 40_000, 100))
    for n in (1000, 16_384, 16_385, 33_000):
        assert played(device, *cut(whole, n)) == expected, n
    short = samples(50)
    assert played(device, *cut(short, 1)) == played(device, short)


def test_missing_samples_repeat_the_last_valid_one(opened: Callable[..., EstimatorLibraryDevice]) -> None:
    device = opened()
    device.start()
    valid = np.array([0, 1, 0, 0, 1, 0], np.bool_)
    y = np.arange(10, 16, dtype=np.uint16)
    blocks = cut(Samples(0, y + np.uint16(90), y, valid), 3)
    answers = list(device.play(blocks))
    theta = np.concatenate([cast(np.ndarray, each.theta) for each in answers])
    assert theta.T.tolist() == [[0, 1, 1, 1, 2, 2], [0, 11, 11, 11, 14, 14]]
    assert [flag for each in answers for flag in each.flags.tolist()] == [0 if each else 1 for each in valid]


def test_skipped_samples_are_missing_ones(opened: Callable[..., EstimatorLibraryDevice]) -> None:
    device = opened()
    device.start()
    first, second = device.play([samples(90), samples(60, first=20_140)])
    assert [alarm.index for alarm in second.alarms] == [20_199]  # none in a skipped sample
    assert first.theta is not None and second.theta is not None
    assert len(second) == len(second.theta) == 60
    assert second.theta[0, 0] == first.theta[-1, 0] + (20_140 % 7 != 6)
    with pytest.raises(ValueError, match="sample 20199 comes again: the next one is 20200"):
        list(device.play([samples(1, first=20_199)]))


def test_two_devices_side_by_side_do_not_disturb_each_other(opened: Callable[..., EstimatorLibraryDevice]) -> None:
    one, other = opened(), opened()
    alone = [played(one, samples(seed=seed)) for seed in (1, 2)]
    one.start()
    other.start()
    turns = zip(one.play(cut(samples(seed=1), 50)), other.play(cut(samples(seed=2), 50)), strict=True)
    assert [joined(list(each)) for each in zip(*turns, strict=True)] == alone


def test_direct_device_omits_estimates_on_request(faulty: Path) -> None:
    description = EstimatorLibrary(name="bob", library=str(faulty))
    with open_rig("emulator") as rig:
        assert is_emulated(rig)
        bench = direct_bench(rig, description, alarms_only=True)
        with bench.dut:
            run = bench.play(dataclasses.replace(Scenario.load("healthy"), samples=500), seed=1)
    assert run.theta.shape == (500, 0)
    assert run.alarm_index.tolist() == [99, 199, 299, 399, 499]
    assert run.conditions.dut["datasheet"] == {"statistic": True}


def test_recorded_device_opens_again(opened: Callable[..., EstimatorLibraryDevice]) -> None:
    table = opened().description()
    assert table["identity"] == {"firmware": "faulty 1.0"}
    description = registry.recorded(table)
    assert description == dataclasses.replace(opened()._description, datasheet=opened().datasheet)
    assert registry.describe("library:./a.so?ceiling=3") == EstimatorLibrary(
        name="library:./a.so?ceiling=3",
        library=str(Path("a.so").absolute()),
        settings={"ceiling": 3},
    )


def test_own_estimator_is_judged_with_its_masses_and_dampings(own: Path) -> None:
    description = EstimatorLibrary(
        name="own",
        library=str(own),
        datasheet=Datasheet.recorded({"datasheet": {"model": {"na": 2, "nb": 3, "offset": True}}}),
    )
    with description.connect() as device:
        verdict = judge(run_of(device))
    assert [change.latency_n is None for change in verdict.changes] == [False, True, False, False]
    assert not verdict.false_alarms
    assert verdict.not_judged == ("diagnoses",)


# ---- settings


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"at": 5, "speed": 1.5}, "the library refuses the setting speed = 1.5"),
        ({"at": -1}, "the library refuses the setting at = -1"),
        ({"at": float("nan")}, "settings: at must be a finite number, not nan"),
        ({"at": "soon"}, "settings: at must be a finite number, not 'soon'"),
    ],
)
def test_refused_setting_is_named(
    opened: Callable[..., EstimatorLibraryDevice], settings: dict[str, float], message: str
) -> None:
    device = opened()
    with pytest.raises(DeviceRefused, match=f"^device bob: {message}$"):
        device.configure(**settings)
    device.configure()
    assert played(device, samples()) == played(opened(), samples())


def test_estimator_without_settings_refuses_each(est: Path) -> None:
    with pytest.raises(DeviceRefused, match="the library refuses the setting p0 = 1$"):
        registry.describe(f"library:{est}?p0=1").connect()


# ---- faults


@pytest.mark.parametrize("fault", ENDS)
def test_end_of_the_child_is_told_with_its_signal_and_its_sample(
    opened: Callable[..., EstimatorLibraryDevice], fault: Fault
) -> None:
    for at in (0, 1, 99, 100, 250, 999) if fault is Fault.SEGV else (150,):
        device = opened(fault, at)
        device.start()
        answers = device.play(cut(samples(), 100))
        for _ in range(at // 100):
            assert len(next(answers)) == 100
        end = f"the process of the library ended with {ENDS[fault]}"
        with pytest.raises(DeviceError, match=f"^device bob: sample {at}: analogrig_step: {end}$"):
            next(answers)


def test_hang_is_told_with_its_sample_and_ended(opened: Callable[..., EstimatorLibraryDevice]) -> None:
    device = opened(Fault.HANG, 150, timeout_s=HANG_S)
    pid = pids(device)[1]
    device.start()
    with pytest.raises(
        DeviceError, match=f"^device bob: sample 150: analogrig_step has not returned for {HANG_S:g} s$"
    ):
        list(device.play(cut(samples(), 100)))
    device.configure(at=N)
    assert ends(pid)
    assert played(device, samples()) == played(opened(), samples())


def test_slow_library_that_makes_progress_may_take_longer_than_its_time_out(tmp_path: Path) -> None:
    source = tmp_path / "slow.c"
    source.write_text(
        '#include "analogrig_estimator.h"\n#include <time.h>\ntypedef struct { int none; } slow_t;\n'
        "static int init(slow_t* self) { return self->none; }\n"
        "static void step(slow_t* self, const analogrig_in_t* in, analogrig_out_t* out) {\n"
        "    const struct timespec some = { .tv_nsec = 10000000 };\n"
        "    nanosleep(&some, 0);\n    out->alarm = (uint8_t)(self->none != 0 || in->u > 1e9F);\n}\n"
        'ANALOGRIG_ESTIMATOR(slow_t, init, step, "slow", 0, 0);\n'
    )
    library = build(tmp_path / "slow.so", source, flags=("-D_POSIX_C_SOURCE=199309L",))
    with EstimatorLibrary(name="slow", library=str(library), timeout_s=0.4).connect() as device:
        device.start()
        assert len(next(iter(device.play([samples(60)])))) == 60
        device.start()
        device.limit(0.2)
        answers = device.play([samples(60)])
        assert 0 < len(next(answers)) < 60
        with pytest.raises(TimeLimitReached):
            next(answers)
        device.limit(1e9)
        device.start()
        assert len(next(iter(device.play([samples(5)])))) == 5


def test_closed_descriptors_are_told(opened: Callable[..., EstimatorLibraryDevice]) -> None:
    device = opened(Fault.CLOSE, 150)
    device.start()
    with pytest.raises(DeviceError, match="sample 199: .* the library closed a descriptor that it did not open$"):
        list(device.play(cut(samples(), 100)))


def test_output_of_the_library_does_no_harm(
    opened: Callable[..., EstimatorLibraryDevice], capfd: pytest.CaptureFixture[str]
) -> None:
    assert played(opened(Fault.PRINT, 150), samples()) == played(opened(), samples())
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (Fault.RECORD, "wrote beyond the end of its record, which holds theta_n = 2 elements of theta"),
        (Fault.UNDONE, "returned without an answer"),
    ],
)
def test_broken_record_is_told_with_its_sample(
    opened: Callable[..., EstimatorLibraryDevice], fault: Fault, message: str
) -> None:
    for at in (0, 150, N - 1):
        device = opened(fault, at)
        device.start()
        with pytest.raises(DeviceError, match=f"^device bob: sample {at}: analogrig_step {message}"):
            list(device.play(cut(samples(), 100)))


@pytest.mark.parametrize(
    ("fault", "what"),
    [(Fault.NEXT_BYTE, "its state, which has state_bytes = 24"), (Fault.EXTRA, "the last of 100 records")],
)
def test_write_behind_state_or_records_is_told_with_its_block(
    opened: Callable[..., EstimatorLibraryDevice], fault: Fault, what: str
) -> None:
    device = opened(fault, 150)
    device.start()
    answers = device.play(cut(samples(), 100))
    assert len(next(answers)) == 100
    place = "samples 100 to 199: analogrig_step"
    with pytest.raises(DeviceError, match=f"^device bob: {place} wrote beyond the end of {what}$"):
        next(answers)
    device.configure(at=N)
    assert played(device, samples()) == played(opened(), samples())


def test_child_of_the_library_ends_with_it(opened: Callable[..., EstimatorLibraryDevice]) -> None:
    device = opened(Fault.FORK, 150)
    device.start()
    with pytest.raises(DeviceError, match=r"sample 150: analogrig_step: .* status -6 \(SIGABRT\)$"):
        list(device.play(cut(samples(), 100)))  # its end closes the socket that both hold


def test_crash_makes_the_run_inconclusive_and_the_next_one_is_whole(faulty: Path) -> None:
    with EstimatorLibrary(name="bob", library=str(faulty), settings={"fault": 1, "at": 1000}).connect() as device:
        verdict = judge(run_of(device))
        assert verdict.outcome == "inconclusive"
        assert "sample 1000: analogrig_step" in " ".join(verdict.reasons)
        device.recover()
        device.configure(at=10_000)
        assert run_of(device).samples == 1800


def test_non_finite_answer_is_told_with_its_sample(opened: Callable[..., EstimatorLibraryDevice]) -> None:
    device = opened(Fault.NOT_A_NUMBER, 199)
    device.start()
    with pytest.raises(DeviceError, match=r"^device bob: sample 199: theta is non-finite: \[ +nan 1?\d+\.\]$"):
        list(device.play(cut(samples(), 64)))
    device.start()
    whole = samples()
    without = Samples(0, whole.u, whole.y, np.arange(len(whole)) != 199)
    with pytest.raises(DeviceError, match=r"\]; the sample is missing: report the last value, or 0$"):
        list(device.play([without]))


@pytest.mark.parametrize(
    ("settings", "error"),
    [
        (
            f"fault={Fault.EXIT_0:d}&at=1000",
            "device {name}: sample 1000: analogrig_step: the process of the library ended with",
        ),
        (f"fault={Fault.INIT:d}", "device {name}: analogrig_init: the process of the library ended with status -6"),
    ],
    ids=["exit(0)", "crash in analogrig_init"],
)
def test_command_is_inconclusive_after_a_crash(faulty: Path, tmp_path: Path, settings: str, error: str) -> None:
    name = f"library:{faulty}?{settings}"
    command = [sys.executable, "-m", "analogrig.cli", "run", "--dut", name, "--out", str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 3
    assert f"analogrig: INCONCLUSIVE: {error.format(library=faulty, name=name)}" in done.stderr
    assert done.stderr.endswith("\n") and done.stderr.count("analogrig: ") == 1


def test_killed_child_is_told_and_recovered(opened: Callable[..., EstimatorLibraryDevice]) -> None:
    device = opened()
    played(device, samples())
    os.kill(pids(device)[1], signal.SIGKILL)
    with pytest.raises(DeviceError, match=r"^device bob: analogrig_init: .* ended with status -9 \(SIGKILL\)$"):
        device.start()
    device.recover()
    assert played(device, samples()) == played(opened(), samples())


def test_child_is_gone_after_close_which_may_come_twice(opened: Callable[..., EstimatorLibraryDevice]) -> None:
    device = opened()
    both = pids(device)
    device.close()
    assert all(ends(pid, 0.0) for pid in both)
    device.close()
    with pytest.raises(DeviceError, match="^device bob: is closed$"):
        device.start()


def test_child_does_not_outlive_a_killed_parent(faulty: Path) -> None:
    parent = (
        "import os, signal; from analogrig.devices.registry import describe;"
        " from tests.harness.processes import descendants;"
        f" device = describe('library:{faulty}').connect(); print(*descendants(os.getpid()), flush=True);"
        " os.kill(os.getpid(), signal.SIGKILL)"
    )
    out = subprocess.run([sys.executable, "-c", parent], stdout=subprocess.PIPE, text=True, check=False)
    assert out.returncode == -signal.SIGKILL
    started = [int(pid) for pid in out.stdout.split()]
    assert len(started) == 3, "the tether, the process that loaded the library, and that of the record"
    assert all(map(ends, started))


def test_replaced_file_is_not_loaded(faulty: Path, est: Path, tmp_path: Path) -> None:
    library = tmp_path / "mine.so"
    library.write_bytes(faulty.read_bytes())
    with EstimatorLibrary(name="bob", library=str(library)).connect() as device:
        library.unlink()
        library.write_bytes(est.read_bytes())
        with pytest.raises(DeviceError, match="its file was replaced since it was opened"):
            device.recover()


# ---- files that are no such library


def not_a_library(folder: Path) -> Path:
    (folder / "text.so").write_text("text")
    return folder / "text.so"


def of_another_machine(folder: Path) -> Path:
    library = build(folder / "i386.so", FAULTY)
    library.write_bytes(b"\x7fELF\x01" + library.read_bytes()[5:])
    return library


def without_step(folder: Path) -> Path:
    return build(folder / "missing.so", FAULTY, flags=("-DNO_STEP", "-Wno-unused"))


def of_another_abi(folder: Path) -> Path:
    return build(folder / "abi.so", FAULTY, flags=('-DABOUT={ 7U, 99U, 1U, 0U, "x" }',))


def with_too_much_theta(folder: Path) -> Path:
    return build(folder / "theta.so", FAULTY, flags=('-DABOUT={ 1U, 99U, 1U, 0U, "x" }',))


def with_too_much_state(folder: Path) -> Path:
    return build(folder / "state.so", FAULTY, flags=('-DABOUT={ 1U, 1U, 1ULL << 40, 0U, "x" }',))


def with_unknown_reports(folder: Path) -> Path:
    return build(folder / "reports.so", FAULTY, flags=("-DABOUT={ 1U, 1U, 1U, 64U, 0 }",))


def absent(folder: Path) -> Path:
    return folder / "absent.so"


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (not_a_library, "text.so: .*file too short"),
        (of_another_machine, "i386.so: .*wrong ELF class: ELFCLASS32"),
        (without_step, "missing.so: .*analogrig_step"),
        (of_another_abi, "abi.so: was built for ABI 7 of analogrig_estimator.h, and this analogrig has 1: compile it"),
        (with_too_much_theta, "theta.so: analogrig_about gives theta_n = 99, and the largest is 64"),
        (with_too_much_state, f"state.so: analogrig_about gives state_bytes = {1 << 40}, and the largest is {1 << 28}"),
        (with_unknown_reports, "reports.so: analogrig_about gives reports = 64, and the largest is 7"),
        (absent, "there is no file .*absent.so"),
    ],
)
def test_file_that_is_no_such_library_is_refused_in_one_line(
    make: Callable[[Path], Path], message: str, tmp_path: Path
) -> None:
    description = EstimatorLibrary(name="bob", library=str(make(tmp_path)))
    with pytest.raises(ConfigurationError, match=f"^device bob: .*{message}") as raised:
        description.connect()
    assert "\n" not in str(raised.value)


def test_library_that_crashes_when_it_is_loaded_harms_nobody(tmp_path: Path) -> None:
    library = build(tmp_path / "crash.so", FAULTY, flags=("-DFAULT_AT_LOAD",))
    with pytest.raises(DeviceError, match=r"^device bob: loading the library: .* ended with status -6 \(SIGABRT\)"):
        EstimatorLibrary(name="bob", library=str(library)).connect()


def test_model_that_contradicts_the_library_is_refused(faulty: Path) -> None:
    stated = Datasheet.recorded({"datasheet": {"model": {"na": 2, "nb": 3}}})
    with pytest.raises(ConfigurationError, match="^device bob: datasheet: model has 5 parameters, theta 2$"):
        EstimatorLibrary(name="bob", library=str(faulty), datasheet=stated).connect()


@pytest.mark.parametrize("name", ["library", "library:", "library:?ceiling=3"])
def test_name_without_a_library_is_refused(name: str) -> None:
    with pytest.raises(ConfigurationError, match="names no library: use library:./my_estimator.so"):
        registry.describe(name)


def test_library_that_a_file_names_is_loaded_only_if_allowed(faulty: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.so").write_bytes(faulty.read_bytes())
    file = tmp_path / "device.toml"
    file.write_text('kind = "library"\nlibrary = "mine.so"\n')
    command = ["run", "--dut", str(file), "--out", str(tmp_path / "out")]
    assert "the device loads the library" in error_of(*command)
    assert main([*command, "--allow", str(tmp_path / "mine.so")]) == 1


# ---- the commands


def test_campaign_and_certificate_of_a_library(own: Path, tmp_path: Path) -> None:
    plan = tmp_path / "plan.toml"
    plan.write_text(
        f'scenario = "healthy"\nrigs = ["emulator"]\ndevices = ["library:{own}"]\ntrials = 2\nsamples = 1600\n'
        "change_at = 1200\n[grid]\nstiffness_factor = [0.7]\n"
    )
    command = ["campaign", str(plan), "--allow", str(own), "--workers", "2", "--out", str(tmp_path / "campaign")]
    assert "campaign plan: 1 cell, 2 trials, 3200 samples: FAILED" in output_of(*command, status=1)
    allowed = ["--far", "1e-2", "--confidence", "0.9", "--bounds", "bursts", "--allowed", "10"]
    command = ["certify", *allowed, "--dut", f"library:{own}", "--workers", "2"]
    assert "CERTIFIED\n  0 alarms in " in output_of(*command)


REFUSING = """
#include "analogrig_estimator.h"
typedef struct { int unused; } refusing_t;
static int init(refusing_t* self) { self->unused = 0; return 0; }
static void step(refusing_t* self, const analogrig_in_t* in, analogrig_out_t* out) {
    (void)self;
    out->refused = in->y > 2000.0F;
}
ANALOGRIG_ESTIMATOR(refusing_t, init, step, "refusing", 0, 0);
"""


def test_sample_that_a_library_refuses_has_the_flag(tmp_path: Path) -> None:
    source = tmp_path / "refusing.c"
    source.write_text(REFUSING)
    library = build(tmp_path / "refusing.so", source)
    y, valid = np.array([1, 3000, 3000, 1], np.uint16), np.array([True, True, False, True])
    with EstimatorLibrary(name="bob", library=str(library)).connect() as device:
        device.start()
        (answers,) = device.play([Samples(0, y, y, valid)])
    assert answers.flags.tolist() == [0, SteppedFlag.REFUSED, SteppedFlag.MISSING, 0]
