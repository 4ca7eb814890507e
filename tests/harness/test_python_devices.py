"""Devices of the kind ``python``: answers, settings and errors of an object."""

from __future__ import annotations

import hashlib
import re
import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from analogrig.answers import Answers, Samples
from analogrig.bench import Bench
from analogrig.catalogue import Cause, Change, SteppedFlag
from analogrig.datasheet import Datasheet, ModelOrders
from analogrig.devices.device import Device, DeviceDescription
from analogrig.devices.python import PythonDescription
from analogrig.devices.registry import open_dut, reopen_dut
from analogrig.errors import ConfigurationError, DeviceError, DeviceRefused, TimeLimitReached
from analogrig.judging.verdict import judge
from analogrig.rigs.description import open_rig
from analogrig.run import UNARMED, UNREPORTED
from analogrig.scenario import Scenario
from tests.harness.commands import error_of

ESTIMATORS = "tests.harness.python_estimators"
THESIS_HASH, HEALTHY_HASH = "54f04f72e4f6d22a", "50312902f3570e68"

pytestmark = pytest.mark.usefixtures("_own_path")


@pytest.fixture
def _own_path(monkeypatch: pytest.MonkeyPatch) -> None:
    """Paths that a device adds are removed after the test."""
    monkeypatch.setattr(sys, "path", [*sys.path])


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def module(folder: Path, text: str) -> str:
    """Name of a new module in the folder."""
    name = f"written_{folder.name}_{len(list(folder.glob('*.py')))}"
    (folder / f"{name}.py").write_text(textwrap.dedent(text))
    return name


def samples(n: int, first: int = 0, missing: Sequence[int] = ()) -> Samples:
    valid = ~np.isin(np.arange(n), missing)
    return Samples(first, np.full(n, 5, np.uint16), np.full(n, 7, np.uint16), valid)


def made(factory: str, **settings: Any) -> Device:
    """Device in this process, which takes a hundredth of the time of a child."""
    return PythonDescription(name="it", factory=f"{ESTIMATORS}:{factory}", settings=settings, in_process=True).connect()


def answered(device: Device, *blocks: Samples) -> list[Answers]:
    device.start()
    return list(device.play(blocks))


@pytest.mark.parametrize(("scenario", "start"), [("thesis", THESIS_HASH), ("healthy", HEALTHY_HASH)])
@pytest.mark.parametrize("factory", ["Core", "CoreInBlocks"])
def test_our_core_as_a_python_object_gives_its_estimates_to_the_bit(factory: str, scenario: str, start: str) -> None:
    with open_rig("emulator") as rig, open_dut(f"python:{ESTIMATORS}:{factory}") as dut:
        run = Bench(rig, dut).play(Scenario.load(scenario), 7)
    assert run.theta_hash().startswith(start)
    assert judge(run).valid


def test_every_quantity_arrives_at_its_sample() -> None:
    device = made("Counting", period=3)
    (first, second) = answered(device, samples(4, missing=[2]), samples(2, 4))
    assert first.theta is not None and first.innovation is not None and first.statistic is not None
    assert first.theta.tolist() == [[0, 0], [1, -1], [1, -1], [3, -3]], "a missing sample repeats the estimate"
    assert first.innovation.tolist() == first.statistic.tolist() == [0, 1, 2, 3]
    assert first.flags.tolist() == [UNARMED, UNARMED, UNARMED | SteppedFlag.MISSING, 0]
    assert first.alarms.tolist() == [(0, 0, 0.0), (3, 0, 3.0)]
    assert first.diagnoses.tolist()[1] == (3, Change.MASS, 3, 0.5)
    assert first.misfits.tolist()[1] == (3, Cause.HUM, 0.25, 0.0)
    assert second.theta is not None
    assert second.theta.tolist() == [[4, -4], [5, -5]]
    assert (len(second), len(second.alarms)) == (2, 0)


def test_sample_without_an_estimate_is_unreported() -> None:
    device = made("Answering", answer=False, sheet={"theta_n": 1})
    (answers,) = answered(device, samples(2, missing=[1]))
    assert answers.flags.tolist() == [UNREPORTED, SteppedFlag.MISSING]


def test_skipped_samples_are_missing_ones() -> None:
    (answers,) = answered(made("Counting"), samples(2, 7))
    assert answers.statistic is not None
    assert answers.statistic.tolist() == [7, 8]


def test_sample_that_comes_again_is_refused() -> None:
    with pytest.raises(ValueError, match="^sample 1 comes again: the next one is 2$"):
        answered(made("Counting"), samples(2), samples(2, 1))


def test_quantity_that_is_not_reported_is_absent() -> None:
    (answers,) = answered(made("Answering", answer=np.True_), samples(2))
    assert [alarm.index for alarm in answers.alarms] == [0, 1]
    assert answers.theta is answers.innovation is answers.statistic is None


def test_each_record_has_a_new_object(folder: Path) -> None:
    name = module(
        folder,
        """
        made = []
        class New:
            n = 0
            def __init__(self): made.append(self)
            def step(self, u, y, valid):
                self.n += 1
                return self.n == 2
        """,
    )
    device = open_dut(f"python:{name}:New?in_process=true")
    assert [[a.index for a in answered(device, samples(4))[0].alarms] for _ in range(3)] == [[1]] * 3
    assert len(sys.modules[name].made) == 3, "the one of the handshake is that of the first record"


def test_data_sheet_of_the_object_replaces_what_the_file_states() -> None:
    stated = Datasheet(theta_n=9, hold_off_n=60)
    settings: dict[str, Any] = {
        "answer": False,
        "sheet": {"theta_n": 3, "model": {"na": 2, "nb": 1}, "cannot_tell": ["a hang"]},
    }
    device = PythonDescription(
        name="it", factory=f"{ESTIMATORS}:Answering", settings=settings, datasheet=stated
    ).connect()
    with device:
        sheet = Datasheet(theta_n=3, model=ModelOrders(2, 1), hold_off_n=60, cannot_tell=("a hang",))
        assert device.datasheet == sheet
        assert Datasheet.recorded(device.description()) == device.datasheet


def test_settings_come_from_file_and_command_line_and_are_recorded(folder: Path) -> None:
    name = module(
        folder,
        """
        class It:
            def __init__(self, *, threshold=1.0, kind="plain"): self.answer = (threshold, kind) == (4, "3d")
            def step(self, u, y, valid): return self.answer
        """,
    )
    (folder / "it.toml").write_text(
        f'kind = "python"\nfactory = "{name}:It"\nsettings = {{ threshold = 4, kind = "3d" }}'
    )
    for opened in (
        open_dut(f"python:{name}:It?threshold=4&kind=3d"),
        open_dut("it.toml", allow=f"python:{name}:It"),
    ):
        with opened as device, reopen_dut(device.description(), "run.npz", allow=[f"python:{name}:It"]) as again:
            assert len(answered(device, samples(1))[0].alarms) == 1
            assert again.description() == device.description()
            assert len(answered(again, samples(1))[0].alarms) == 1
            device.configure(threshold=5)
            assert len(answered(device, samples(1))[0].alarms) == 0
            with pytest.raises(DeviceRefused, match="has no setting thershold; it has threshold, kind"):
                device.configure(threshold=4, thershold=4)
            assert len(answered(device, samples(1))[0].alarms) == 0, "all or none"


def test_file_may_not_import_a_module_of_itself(folder: Path) -> None:
    name = module(folder, "raise SystemExit('was imported')")
    (folder / "it.toml").write_text(f'kind = "python"\nfactory = "{name}:It"')
    error = error_of("run", "--dut", "it.toml")
    assert error == (
        f"analogrig: it.toml: the device imports python:{name}:It, which no file may order:"
        f" pass --allow python:{name}:It\n"
    )
    assert "was imported" in error_of("run", "--dut", "it.toml", "--allow", f"python:{name}:It")


WRONG_NAMES = {
    "python": "device 'python': names no factory: pass python:package.module:name",
    "python:lonely": "factory must be package.module:name, not 'lonely'",
    "python:no_such_module:It": "there is no module no_such_module, neither in {folder} nor installed",
    f"python:{ESTIMATORS}.more:It": f"there is no module {ESTIMATORS}.more",
    f"python:{ESTIMATORS}:It": "python_estimators.py has no It",
    f"python:{ESTIMATORS}:SHEET": "python_estimators:SHEET is a dict, which cannot be called",
    f"python:{ESTIMATORS}:Core?arl=3": "Core has no setting arl; it has arl0",
    f"python:{ESTIMATORS}:Answering": "Answering needs the setting answer",
    f"python:{ESTIMATORS}:Core?arl0=-1": "Core raised ValueError: arl0 must be",
    "python:builtins:str": "str made a str, which has no method step(u, y, valid)",
}


@pytest.mark.parametrize("name", WRONG_NAMES)
def test_wrong_name_is_one_line(name: str, folder: Path) -> None:
    error = error_of("run", "--dut", name)
    assert error.startswith("analogrig: ") and error.count("\n") == 1
    assert WRONG_NAMES[name].format(folder=folder) in error


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("import no_such_module", r"cannot be imported: ModuleNotFoundError: .*written_.*\.py:1"),
        ("def step(:", r"cannot be imported: SyntaxError: .*written_.*\.py, line 1"),
        ("\nx = 1 / 0", r"cannot be imported: ZeroDivisionError: division by zero \(.*written_.*\.py:2\)"),
    ],
)
def test_module_that_cannot_be_imported_is_one_line(folder: Path, text: str, error: str) -> None:
    with pytest.raises(ConfigurationError, match=error):
        open_dut(f"python:{module(folder, text)}:It")


@pytest.mark.parametrize("way", ["step", "step_block"])
def test_exception_names_sample_type_and_line_and_ends_the_run(way: str, folder: Path) -> None:
    quiet = "False" if way == "step" else "np.zeros(len(u), bool)"
    name = module(
        folder,
        f"""
        import numpy as np
        class It:
            n = 0
            def {way}(self, u, y, valid):
                self.n += np.size(u)
                return self.fail() if self.n > 300 else {quiet}
            def fail(self):
                return np.ones(2) @ np.ones(3)
        """,
    )
    with open_rig("emulator") as rig, open_dut(f"python:{name}:It") as dut:
        run = Bench(rig, dut).play(Scenario.load("healthy"), 1)
    where = "step of sample 300" if way == "step" else "step_block of the samples 256 to 511"
    assert run.samples == (300 if way == "step" else 256), "the answers before it hold"
    (fault,) = run.conditions.faults
    assert re.fullmatch(rf"device .*: {where} raised ValueError: matmul.* \(.*{name}\.py:9\)", fault)
    assert judge(run).outcome == "inconclusive"


@pytest.mark.parametrize(
    ("part", "status", "error"),
    [
        ("def step(self, u, y, valid): raise Odd('no')", 3, "step of sample 0 raised Odd: no ({file}:7)"),
        ("def step(self, u, y, valid): raise Mute()", 3, "step of sample 0 raised Mute ({file}:7)"),
        (
            "def step(self, u, y, valid): raise KeyboardInterrupt",
            3,
            "step of sample 0 raised KeyboardInterrupt ({file}",
        ),
        ("def __init__(self): raise KeyboardInterrupt", 2, "{name}:It raised KeyboardInterrupt ({file}:7)"),
        ("step = property(lambda self: 1 / 0)", 2, "step of {name}:It raised ZeroDivisionError: division by zero ("),
        ("datasheet = property(lambda self: 1 / 0)", 2, "datasheet of {name}:It raised ZeroDivisionError: division"),
    ],
    ids=["BaseException", "__str__", "KeyboardInterrupt", "in factory", "step", "datasheet"],
)
def test_odd_failure_of_the_object_is_one_line(folder: Path, part: str, status: int, error: str) -> None:
    odd = "class Odd(BaseException): pass\nclass Mute(Exception):\n    def __str__(self): return 1 / 0\n"
    name = module(folder, f"{odd}class It:\n    def step(self, u, y, valid): return False\n\n    {part}\n")
    (line,) = error_of("run", "--dut", f"python:{name}:It", status=status).splitlines()
    assert f"device python:{name}:It: {error.format(name=name, file=folder / f'{name}.py')}" in line


WRONG_ANSWERS: dict[str, tuple[object, object, str]] = {
    "text": ("no", None, r"must return True, False or an object with such an alarm, not 'no' \(str\)"),
    "nothing": (None, None, r"not None \(NoneType\)"),
    "number": (1, None, r"not 1 \(int\)"),
    "alarm": ({"alarm": 1}, None, r"not \{'alarm': 1\} \(dict\)"),
    "key": ({"alarm": False, "thetta": [1]}, None, "unknown key 'thetta'"),
    "nan": (
        {"alarm": False, "statistic": float("nan")},
        {"statistic": True},
        r"statistic is nan \(float\): non-finite",
    ),
    "far": ({"alarm": False, "innovation": 1e39}, {"innovation": True}, "innovation is 1e\\+39 .*beyond float32"),
    "theta": ({"alarm": False, "theta": [1.0]}, {"theta_n": 2}, "theta must be 2 numbers, as the data sheet states"),
    "words": ({"alarm": False, "theta": ["1", "2"]}, {"theta_n": 2}, "theta must be 2 numbers"),
    "unstated": ({"alarm": False, "theta": [1.0]}, None, "returned theta, which the data sheet does not state"),
    "change": ({"alarm": False, "diagnosis": {"change": "age"}}, {"diagnoses": True}, "change must be one of mass, "),
    "onset": (
        {"alarm": False, "diagnosis": {"change": "mass", "onset": 9, "extent": 1.0}},
        {"diagnoses": True},
        "onset must be a sample from 0 to 0, not 9",
    ),
    "cause": ({"alarm": False, "misfit": {"cause": "age"}}, {"misfits": True}, "cause must be one of none, drift, "),
    "frequency": (
        {"alarm": False, "misfit": {"cause": "hum", "frequency": 50.0}},
        {"misfits": True},
        "frequency must be 0 to 0.5 cycles per sample, not 50.0",
    ),
}


@pytest.mark.parametrize("wrong", WRONG_ANSWERS)
def test_wrong_answer_is_one_line(wrong: str) -> None:
    answer, sheet, error = WRONG_ANSWERS[wrong]
    with pytest.raises(DeviceError, match=f"device it: step of sample 0: .*{error}"):
        answered(made("Answering", answer=answer, sheet=sheet or {}), samples(2))


WRONG_BLOCKS: dict[str, tuple[object, object, str]] = {
    "alarm": ({"alarm": [0, 1]}, None, "alarm must be an array of 2 truth values"),
    "length": (np.zeros(3, np.bool_), None, "alarm must be an array of 2 truth values"),
    "theta": ({"alarm": [False] * 2, "theta": np.zeros((3, 1))}, {"theta_n": 1}, "theta must be 2 x 1 numbers"),
    "nan": ({"alarm": [False] * 2, "theta": [[1.0], [np.nan]]}, {"theta_n": 1}, "theta is .*: non-finite"),
    "armed": ({"alarm": [False] * 2}, {"armed": True}, "armed must be an array of 2 truth values, not None"),
    "diagnosis": ({"alarm": [False] * 2, "diagnosis": [None]}, {"diagnoses": True}, "diagnosis must be a list of 2"),
    "misfit": ({"alarm": [False] * 2, "misfit": [None]}, {"misfits": True}, "misfit must be a list of 2"),
}


@pytest.mark.parametrize("wrong", WRONG_BLOCKS)
def test_wrong_answer_to_a_block_is_one_line(wrong: str) -> None:
    answer, sheet, error = WRONG_BLOCKS[wrong]
    with pytest.raises(DeviceError, match=f"device it: step_block of the samples 0 to 1: {error}"):
        answered(made("Answering", answer=answer, sheet=sheet or {}, block=True), samples(2))


@pytest.mark.parametrize("sheet", [3, {"theta": 3}, {"theta_n": -1}])
def test_wrong_data_sheet_is_one_line(sheet: object) -> None:
    with pytest.raises(ConfigurationError, match=f"device it: datasheet of {ESTIMATORS}:Answering: "):
        made("Answering", answer=False, sheet=sheet)


def test_time_limit_ends_the_play_after_the_answers_in_time() -> None:
    device = made("Counting")
    device.limit(0.0)
    with pytest.raises(TimeLimitReached):
        answered(device, samples(2))
    device.limit(float("inf"))
    assert len(answered(device, samples(2))[0]) == 2


def test_file_of_the_module_is_recorded_as_it_was_imported(folder: Path) -> None:
    name = module(folder, "class It:\n    def step(self, u, y, valid): return False\n")
    with open_dut(f"python:{name}:It") as device:
        (folder / f"{name}.py").write_text("")
        (file,) = device.files()
    assert Path(file.path).name == f"{name}.py"
    assert file.sha256 == hashlib.sha256(b"class It:\n    def step(self, u, y, valid): return False\n").hexdigest()


@pytest.mark.parametrize("in_process", [False, True])
def test_device_takes_blocks(*, in_process: bool) -> None:
    description: DeviceDescription = PythonDescription(name="it", factory=f"{ESTIMATORS}:Core", in_process=in_process)
    here = {"in-process"} if in_process else set()
    assert description.capabilities == {"blocks", "configure", *here}
    assert description.known_datasheet().cannot_tell == (("a state left from before the record",) if in_process else ())
    assert description.only_one == "" and description.program is None
