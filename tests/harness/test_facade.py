"""``import analogrig``: a locked list of public names, each documented, none of which costs anything before its use."""

from __future__ import annotations

import doctest
import importlib
import inspect
import re
import subprocess
import sys
from typing import Any

import pytest

import analogrig

PUBLIC = """
    AnalogrigError Bench ChangeVerdict Conditions ConfigurationError Device DeviceError EmulatorError EstimatorConfig
    Excitation Expectations Finding LinkError LinkTimeout Plant Play Played PotChange Program RecordingError Rig
    RigError Run Scenario Verdict __version__ detectable judge open_dut open_rig rate_below strategies with_some_seed
    write_report
""".split()

DEVICES = """
    LOST UNARMED UNREPORTED AdaptedDescription Answers Capability
    CaptureDecoding CapturedRun Cause Change Datasheet Device DeviceDescription DeviceRefused
    Estimator HostDevice LinkClosed ModelOrders RaisedAlarm ReportedDiagnosis
    ReportedMisfit Samples SteppedFlag Thing TimeLimitReached trusted
""".split()

RIGS = """
    BLOCK_SAMPLES CAPABILITIES DEFAULT_RIG WRONG_SAMPLES Block CardDescription Channel
    ComputerDescription EmulatorDescription EmulatorRig Hindsight MeasuredValues Performance
    RecordIncomplete RecordStale Rig RigClosed RigDescription RigRefused RigTimeout Segment
    SetUp Stream Thing channels_of emulator_errors is_emulated lit_lamps sampled
""".split()


NO_BEGINNING = {"What", "Whether", "Of", "As", "How", "Who", "Whatever", "Whoever", "That", "Those"}
"""First words of a docstring that cannot be read alone."""


def documented(name: str) -> Any:
    return getattr(analogrig, name)


def test_public_names_are_these_and_at_most_forty() -> None:
    assert analogrig.__all__ == PUBLIC
    assert len(PUBLIC) <= 40
    assert sorted(PUBLIC) == PUBLIC
    assert set(PUBLIC) <= set(dir(analogrig))


@pytest.mark.parametrize(("package", "names"), [("devices", DEVICES), ("rigs", RIGS)])
def test_interfaces_for_kinds_of_other_packages_are_these(package: str, names: list[str]) -> None:
    module = importlib.import_module(f"analogrig.{package}")
    assert module.__all__ == names
    for name in names:
        assert getattr(module, name) is not None
        assert re.search(rf"\b{name}\b", str(module.__doc__)), name
    with pytest.raises(AttributeError, match=f"no attribute 'no_such'; public names: analogrig.{package}.__all__"):
        module.no_such  # noqa: B018 - what a user writes


def test_star_import_brings_the_public_names() -> None:
    names: dict[str, object] = {}
    exec("from analogrig import *", names)  # noqa: S102 - what a user writes at a prompt
    assert set(names) - {"__builtins__"} == set(PUBLIC)


def test_example_in_the_docstring_runs() -> None:
    result = doctest.testmod(analogrig)
    assert result.attempted >= 6
    assert result.failed == 0


@pytest.mark.parametrize("name", [name for name in PUBLIC if name != "__version__"])
def test_docstring_of_a_public_name_begins_with_what_it_is_or_does(name: str) -> None:
    text = inspect.getdoc(documented(name))
    assert text
    first = text.splitlines()[0]
    assert first.split()[0] not in NO_BEGINNING
    assert first.endswith((".", ":")), "one sentence on the first line"
    assert not text.startswith(f"{name}("), "the signature that dataclass writes is no docstring"


def test_docstrings_of_functions_name_every_error_of_the_tree_that_they_raise() -> None:
    for name, errors in {
        "judge": ("ConfigurationError",),
        "open_dut": ("ConfigurationError", "DeviceError", "LinkError"),
        "open_rig": ("ConfigurationError", "RecordingError"),
        "write_report": ("RecordingError",),
    }.items():
        text = str(inspect.getdoc(documented(name)))
        assert [error for error in errors if f":raises {error}:" not in text] == [], name


def test_private_name_is_refused_with_the_place_of_the_public_ones() -> None:
    with pytest.raises(AttributeError, match=r"no attribute 'no_such'; public names: analogrig.__all__"):
        documented("no_such")


def loaded_after(statement: str) -> set[str]:
    script = f"import sys; {statement}; print(*sorted({{name.partition('.')[0] for name in sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_import_loads_nothing_heavy_and_an_error_neither() -> None:
    heavy = {"numpy", "scipy", "serial", "can", "hypothesis", "pytest"}
    loaded = loaded_after("import analogrig")
    assert "analogrig" in loaded
    assert not loaded & heavy
    assert not loaded_after("from analogrig import AnalogrigError") & heavy
    assert not loaded_after("import analogrig.devices, analogrig.rigs") & heavy
    assert "numpy" in loaded_after("from analogrig import Run")
    assert not loaded_after("from analogrig import Played, Finding, Play, Scenario") & {"hypothesis", "pytest"}


@pytest.mark.heavy
def test_types_of_the_public_names_are_known_to_a_type_checker(tmp_path: Any) -> None:
    user = tmp_path / "user.py"
    user.write_text(
        "from analogrig import Bench, Scenario, judge, open_dut, open_rig\n\n"
        "def outcome(name: str) -> str:\n"
        "    with open_rig(name) as rig, open_dut('inproc') as dut:\n"
        "        return judge(Bench(rig, dut).play(Scenario.load('thesis'), 1)).outcome\n\n"
        "def wrong() -> int:\n"
        "    return judge(outcome('emulator'))\n"
    )
    command = [sys.executable, "-m", "mypy", "--strict", "--no-incremental", "--follow-imports=silent", str(user)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    errors = [line for line in done.stdout.splitlines() if ": error:" in line]
    assert [line.rpartition("[")[2] for line in errors] == ["return-value]", "arg-type]"], done.stdout
    assert all("user.py:8" in line for line in errors)
