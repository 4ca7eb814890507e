"""The plugin as a user's tests see it, each in a pytest of its own."""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast
from xml.etree import ElementTree as ET

import numpy as np
import pytest

import analogrig.reporting  # these two for the runs in this process, which forgets what they import themselves
import analogrig.testing.properties.experiments  # noqa: F401
from analogrig import cli, config
from analogrig.bench import Bench
from analogrig.devices.processes import host_child
from analogrig.devices.registry import open_dut
from analogrig.errors import ConfigurationError
from analogrig.rigs.description import open_rig
from analogrig.scenario import Scenario, Statement
from analogrig.testing.statement import Play, judge_statement
from analogrig_emulator import Excitation
from tests.harness.firmware import needs_firmware
from tests.harness.processes import LONG_S, ends

ROOT = Path(__file__).parents[2]

SHORT = """\
samples = 900
{head}
[excitation]
low_v = 0.1
high_v = 9.9
frequency_hz = 200.0

[[changes]]
sample = 700
stiffness_n_per_m = 18000.0

[expect]
missed = 0
{expect}
"""
PLAYS = """\
def test_it(hil_play):
    played = hil_play("short.toml")
    assert played.run.samples == 900
    {assertion}
"""


@pytest.fixture
def user(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> pytest.Pytester:
    """A user's folder, with a short scenario."""
    for variable in [name for name in os.environ if name.startswith("ANALOGRIG_")]:
        monkeypatch.delenv(variable)
    pytester.path.joinpath("short.toml").write_text(SHORT.format(head="", expect=""))
    return pytester


def run(user: pytest.Pytester, *arguments: str) -> pytest.RunResult:
    """In this process, which has imported what is heavy; most of a second is saved."""
    return user.runpytest_inprocess("-p", "no:cacheprovider", "-p", "no:xdist", *arguments)


def run_apart(user: pytest.Pytester, *arguments: str) -> pytest.RunResult:
    """In a process of its own."""
    return user.runpytest_subprocess("-p", "no:cacheprovider", "-p", "no:xdist", *arguments)


def refused(user: pytest.Pytester, *arguments: str) -> pytest.RunResult:
    """A run that ends before anything heavy is asked for, and so may be one in this process."""
    result = user.runpytest_inprocess("-p", "no:cacheprovider", *arguments)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    return result


def properties(user: pytest.Pytester, file: str = "junit.xml") -> dict[str, str]:
    """Properties of the first test case."""
    case = ET.parse(user.path / file).getroot().find(".//testcase")  # noqa: S314 - written a moment ago
    assert case is not None
    return {each.attrib["name"]: each.attrib["value"] for each in case.iter("property")}


def test_play_of_a_scenario_is_a_test_and_junit_knows_its_figures(user: pytest.Pytester) -> None:
    user.makepyfile(PLAYS.format(assertion="assert played.detects(within=3.0) and played.stays_quiet()"))
    run(user, "--hil-dut", "inproc", "--junitxml", "junit.xml").assert_outcomes(passed=1)
    told = properties(user)
    assert told["dut"] == "inproc"
    assert told["rig"] == "emulator"
    assert told["firmware"] == "LIBRARY"
    assert told["outcome"] == "passed"
    assert int(told["latency_n"]) <= 3 * int(told["bound_n"]) + 1
    assert re.fullmatch("[0-9a-f]{64}", told["theta_hash"])
    assert told["seed"] == "1995"
    assert told["overruns"] == "0"


LEVELS = {
    "default": ("emulator", "host", "None", "build/runs", "ci"),
    "ini": ("emulator-ideal", "inproc", "of_ini", "runs/ini", "soak"),
    "environment": ("emulator-0-10v", "any-edges", "of_ini", "runs/environment", "nightly"),
    "command line": ("emulator-skewed", "inproc?exchange=block", "of_command_line", "runs/command_line", "ci"),
    "indirect": ("emulator-real", "mean-between-faults", "of_indirect", "runs/indirect", "soak"),
}
VARIABLES = {
    "hil_rig": "ANALOGRIG_RIG",
    "hil_dut": "ANALOGRIG_DUT",
    "hil_scenario_dir": "ANALOGRIG_SCENARIO_DIR",  # none: a shell collects nothing in any repository
    "hil_runs_dir": "ANALOGRIG_RUNS_DIR",
    "hil_profile": "ANALOGRIG_HIL_PROFILE",
}
NAMES = ("hil_rig", "hil_dut", "hil_scenario_dir", "hil_runs_dir", "hil_profile")
TELLS_ALL = """
import pytest

def test_it(hil_rig, hil_dut, hil_scenario_dir, hil_runs_dir, hil_profile):
    print("<", hil_rig.description()["name"], hil_dut.name, hil_scenario_dir, hil_runs_dir, hil_profile, ">")
"""


def test_each_option_is_taken_from_parameter_then_command_line_then_environment_then_ini(
    user: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = user.makepyfile(TELLS_ALL)
    told: dict[str, tuple[str, ...]] = {}

    def tell(level: str, *arguments: str) -> None:
        (line,) = [line for line in run(user, "-s", path.name, *arguments).outlines if "<" in line]
        told[level] = tuple(line.partition("< ")[2].removesuffix(" >").split())

    for folder in {level[2] for level in LEVELS.values()}:
        user.mkdir(folder)
    tell("default")
    options = [f"{name} = {value}" for name, value in zip(NAMES, LEVELS["ini"], strict=True)]
    user.makeini("\n".join(["[pytest]", *options]))
    tell("ini")
    for name, value in zip(NAMES, LEVELS["environment"], strict=True):
        monkeypatch.setenv(VARIABLES[name], value if name != "hil_scenario_dir" else "of_indirect")
    tell("environment")
    given = [f"--{name.replace('_', '-')}={value}" for name, value in zip(NAMES, LEVELS["command line"], strict=True)]
    tell("command line", *given)
    of_parameters = [
        f'@pytest.mark.parametrize("{name}", ["{value}"], indirect=True)\n'
        for name, value in zip(NAMES, LEVELS["indirect"], strict=True)
    ]
    path.write_text(TELLS_ALL.replace("def test_it", "".join(of_parameters) + "def test_it"))
    tell("indirect", *given)
    assert told == LEVELS


WRONG = pytest.mark.parametrize(
    ("name", "value", "complaint"),
    [
        ("hil_profile", "tea", "must be one of ci, nightly, soak, not 'tea'"),
        ("hil_scenario_dir", "nowhere", "nowhere is no folder"),
        ("hil_runs_dir", "short.toml/runs", "short.toml is no folder"),
    ],
)


@WRONG
def test_wrong_value_on_the_command_line_ends_the_session_in_one_line(
    user: pytest.Pytester, name: str, value: str, complaint: str
) -> None:
    flag = f"--{name.replace('_', '-')}"
    refused(user, f"{flag}={value}").stderr.fnmatch_lines([f"ERROR: {flag}: {complaint}"])
    refused(user, f"{flag}=").stderr.fnmatch_lines([f"ERROR: {flag}: is empty"])


@WRONG
def test_wrong_value_elsewhere_fails_the_tests_that_ask_for_it_in_one_line_with_its_source(
    user: pytest.Pytester, monkeypatch: pytest.MonkeyPatch, name: str, value: str, complaint: str
) -> None:
    path = user.makepyfile(f"def test_of_ours({name}):\n    pass\n\ndef test_of_theirs():\n    pass\n")
    user.makeini(f"[pytest]\n{name} = {value}")
    result = run(user, path.name)
    result.assert_outcomes(errors=1, passed=1)
    result.stdout.fnmatch_lines([f"*tox.ini: {name}: {complaint}"])
    if name != "hil_scenario_dir":
        monkeypatch.setenv(VARIABLES[name], value)
        result = run(user, path.name)
        result.assert_outcomes(errors=1, passed=1)
        result.stdout.fnmatch_lines([f"{VARIABLES[name]}: {complaint}"])
    path.write_text(
        "import pytest\n\n"
        f"@pytest.mark.parametrize({name!r}, [{value!r}], indirect=True)\ndef test_it({name}):\n    pass\n"
    )
    run(user, path.name).stdout.fnmatch_lines([f"parameter {name} of *::test_it*: {complaint}"])


def test_rig_or_device_that_does_not_exist_fails_in_one_line_with_who_named_it(
    user: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    user.makepyfile("def test_rig(hil_rig):\n    pass\n\ndef test_device(hil_dut):\n    pass\n")
    monkeypatch.setenv("ANALOGRIG_DUT", "no-such")
    result = run(user, "--hil-rig", "none")
    result.assert_outcomes(errors=2)
    result.stdout.fnmatch_lines(
        ["--hil-rig: no rig is called 'none': *", "ANALOGRIG_DUT: no device is called 'no-such': *"]
    )
    assert "Traceback" not in result.stdout.str()
    assert "another exception" not in result.stdout.str()


def test_need_that_the_rig_lacks_skips_with_the_reason(user: pytest.Pytester) -> None:
    user.makepyfile(
        """
        import pytest

        @pytest.mark.hil_needs("excite", "change")
        @pytest.mark.parametrize("hil_rig", ["emulator", "recording:RECORDED"], indirect=True)
        def test_it(hil_rig):
            pass
        """.replace("RECORDED", str(recorded(user.path)))
    )
    result = run(user, "-rs")
    result.assert_outcomes(passed=1, skipped=1)
    result.stdout.fnmatch_lines(["*rig recording:*run.npz cannot change and excite (it can nothing but play)*"])


def recorded(folder: Path) -> Path:
    with open_rig("emulator") as rig, open_dut("inproc") as dut:
        Bench(rig, dut).play(Scenario(10, Excitation(), name="ten"), 1).save(folder / "run.npz")
    return folder / "run.npz"


def test_need_that_no_rig_knows_ends_the_collection_in_one_line_with_those_known(user: pytest.Pytester) -> None:
    user.makepyfile("import pytest\n\n@pytest.mark.hil_needs('twaek')\ndef test_it(hil_rig):\n    pass\n")
    result = refused(user)
    result.stderr.fnmatch_lines(["ERROR: *::test_it: hil_needs: no rig is known to 'twaek': there are excite, change"])
    assert len(result.errlines) <= 2


def test_failure_leaves_a_scenario_a_recording_and_the_line_that_repeats_it(
    user: pytest.Pytester, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    user.path.joinpath("noisy.toml").write_text(
        "[computer]\noffset_v = 0.001\n[card]\nnoise_lsb = 0.5\n[card.range_v]\nforce = [-1.0, 11.0]\n"
        "displacement = [-1.0, 9.0]\nvelocity = [-10.0, 10.0]\nnet_force = [-12.5, 12.5]\n"
    )
    user.makepyfile(
        PLAYS.replace('"short.toml"', '"short.toml", seed=77').format(assertion="assert played.detects(within=0.0)")
    )
    result = run(user, "--hil-dut", "inproc", "--hil-rig", "noisy.toml", "--junitxml", "junit.xml")
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(
        ["E*<no: K at 700: * samples, allowed 1 (0 x bound * + 1)>*", "play it again with: analogrig run --scenario *"]
    )
    (line,) = [line for line in result.outlines if line.startswith("play it again with: ")]
    monkeypatch.chdir(user.path)
    status = cli.main([*line.split()[5:], "--json", "--out", str(user.path / "again")])
    assert status == 0
    assert f'"theta_hash": "{properties(user)["theta_hash"]}"' in capsys.readouterr().out


def imported(*options: str) -> str:
    """Name of the rig of measured data in the working directory."""
    rng = np.random.default_rng(1)
    u, y = np.where(np.arange(900) // 50 % 2, 4.0, 0.0), np.zeros(900)
    for k in range(2, 900):
        y[k] = 1.7 * y[k - 1] - 0.75 * y[k - 2] + 0.1 * u[k - 1]
    np.savez("measured.npz", u=u, y=y + 0.01 * rng.normal(size=900))
    named = ["--input", "u", "--output", "y", "--rate", "20000", *options]
    assert cli.main(["import", "measured.npz", *named, "--out", "recording.npz"]) == 0
    return "recording:recording.npz"


def repeat_command(result: pytest.RunResult, start: str) -> list[str]:
    (line,) = [line for line in result.outlines if line.startswith(f"{start} again with: ")]
    return shlex.split(line.partition(": ")[2])


def test_recording_is_played_without_its_seed_and_a_failure_names_it(
    user: pytest.Pytester, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(user.path)
    units = ["--input-unit", "N", "--output-unit", "m", "--clock", "machine"]
    rig = imported("--scenario", "short.toml", *units)
    user.makepyfile(PLAYS.format(assertion="print(played.repeat); assert played.detects(within=0.0)"))
    result = run(user, "--hil-dut", "inproc", "--hil-rig", rig, "--junitxml", "junit.xml")
    result.assert_outcomes(failed=1)
    found = properties(user)["theta_hash"]
    capsys.readouterr()
    cli.main([*repeat_command(result, "play it")[1:], "--json", "--out", "again"])
    assert f'"theta_hash": "{found}"' in capsys.readouterr().out
    result.stdout.fnmatch_lines([f"analogrig run --seed 0 --scenario short.toml --rig {rig} --dut inproc"])
    judged = run(user, *repeat_command(result, "judge it")[1:], "--junitxml", "judged.xml")
    judged.assert_outcomes(failed=1)
    assert properties(user, "judged.xml")["theta_hash"] == found


def test_recording_of_an_unknown_plant_is_played_by_the_call_of_the_manual(
    user: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(user.path)
    rig = imported()
    page = (ROOT / "harness" / "docs" / "howto" / "import-measured-data.md").read_text(encoding="utf-8")
    example = page.partition("```python\n")[2].partition("```")[0]
    user.makepyfile(f"{example}\ndef test_unjudged(hil_play):\n    hil_play()\n")
    result = run(user, "--hil-dut", "inproc", "--hil-rig", rig)
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.fnmatch_lines(["*UNJUDGED: nothing is known of the plant*"])
    assert cli.main([*repeat_command(result, "play it")[1:], "--out", "again"]) == 3
    result = run(user, "--hil-dut", "inproc", "--hil-rig", "emulator")
    result.assert_outcomes(failed=2)
    result.stdout.fnmatch_lines(["*plays the scenario of a recording: name another for this rig*"])


def test_play_refuses_a_file_that_names_another_rig_or_device_than_plays_it(user: pytest.Pytester) -> None:
    """A play on the session's rig would pass for one on the rig that the file names."""
    text = (user.path / "short.toml").read_text()
    user.path.joinpath("named.toml").write_text(f'rig = "emulator-0-10v"\ndut = "inproc"\n{text}')
    user.makepyfile(PLAYS.replace("short.toml", "named.toml").format(assertion="assert played.passes()"))
    refused = run(user)
    refused.assert_outcomes(failed=1)
    refused.stdout.fnmatch_lines(
        ["*named: names emulator-0-10v, but emulator of the session would play it: pass --hil-*"]
    )
    run(user, "--hil-rig", "emulator-0-10v", "--hil-dut", "inproc").assert_outcomes(passed=1)
    run(user, "--hil-rig", "emulator", "--hil-dut", "inproc").assert_outcomes(passed=1)  # the command line comes first


def test_play_is_neither_true_nor_false(user: pytest.Pytester) -> None:
    """``assert hil_play(...)`` would pass whatever the device does."""
    user.makepyfile(PLAYS.format(assertion="assert played"))
    result = run(user, "--hil-dut", "inproc")
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["E*TypeError: a play is neither true nor false: assert a finding*"])


def test_failure_on_a_device_of_a_file_leaves_that_device_too(
    user: pytest.Pytester, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    user.path.joinpath("mydev.toml").write_text(
        'kind = "inproc"\nexchange = "block"\nwire_faults = "duplicate@0.01,seed=3"\n[estimator]\nwarm_up_n = 150\n'
    )
    user.makepyfile(PLAYS.format(assertion="assert False"))
    result = run(user, "--hil-dut", "./mydev.toml", "--junitxml", "junit.xml")
    (line,) = [line for line in result.outlines if line.startswith("play it again with: ")]
    (user.path / "mydev.toml").unlink()
    monkeypatch.chdir(user.path)
    cli.main([*line.split()[5:], "--json", "--out", str(user.path / "again")])
    assert f'"theta_hash": "{properties(user)["theta_hash"]}"' in capsys.readouterr().out


def test_command_of_a_play_names_files_as_the_user_does_and_says_nothing_when_nothing_does(
    user: pytest.Pytester, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    shipped = Path(__file__).parents[2] / "fixtures" / "rigs" / "emulator-0-10v.toml"
    user.mkdir("own").joinpath("rig.toml").write_text(shipped.read_text())
    user.path.joinpath("own", "dev.toml").write_text('kind = "inproc"\n[estimator]\nwarm_up_n = 150\n')
    user.makepyfile(
        """
        import dataclasses
        from analogrig.scenario import Scenario

        def test_it(hil_play):
            played = hil_play("short.toml", seed=5)
            print(played.repeat, played.verdict.theta_hash, sep="#")
            assert not hil_play(dataclasses.replace(Scenario.load("short.toml"), samples=1000)).repeat
            assert hil_play("thesis").repeat
        """
    )
    result = run(user, "-s", "--hil-dut", "own/dev.toml", "--hil-rig", "own/rig.toml")
    result.assert_outcomes(passed=1)
    (line,) = [line for line in result.outlines if "#" in line]
    command, _, theta = line[line.index("analogrig") :].partition("#")
    monkeypatch.chdir(user.path)
    assert cli.main([*command.split()[1:], "--json", "--out", str(user.path / "again")]) == 0
    assert f'"theta_hash": "{theta}"' in capsys.readouterr().out


def test_folder_of_scenarios_is_a_suite(user: pytest.Pytester) -> None:
    folder = user.mkdir("suite")
    (folder / "good.toml").write_text(SHORT.format(head="seed = 5", expect=""))
    (folder / "impatient.toml").write_text(
        SHORT.format(head='seed = 4\nrig = "rig.toml"', expect="late_slack_n = 0\nlate_information_ratio = 1.0")
    )
    shipped = Path(__file__).parents[2] / "fixtures" / "rigs" / "emulator-0-10v.toml"
    (folder / "rig.toml").write_text(shipped.read_text())
    (folder / "wrong.toml").write_text("samples = -1\n[excitation]\n")
    result = run(user, "--hil-dut", "inproc", "--hil-scenario-dir", "suite", "-v", "-rA")
    result.stdout.fnmatch_lines(["*good*PASSED*"])
    result.stdout.fnmatch_lines(["*wrong.toml*samples must be in 1 .. *"])
    result.assert_outcomes(passed=1, failed=2)
    assert list(user.path.glob("build/runs/*impatient*/scenario.toml"))


def test_folder_of_scenarios_comes_on_top_of_the_tests_and_a_stray_kind_is_told(user: pytest.Pytester) -> None:
    folder = user.mkdir("suite")
    (folder / "stray.toml").write_text('kind = "scenario"\n' + SHORT.format(head="", expect=""))
    user.makepyfile("def test_own():\n    pass\n")
    result = run(user, "--hil-dut", "inproc", "--hil-scenario-dir", "suite")
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.fnmatch_lines(["*stray.toml: unknown key 'kind' *"])
    refused(user, "--hil-scenario-dir", "").stderr.fnmatch_lines(["ERROR: --hil-scenario-dir: is empty"])
    user.mkdir("build")
    refused(user, "--hil-scenario-dir", "build").stderr.fnmatch_lines(["*pytest does not look into build of itself: *"])


def test_inconclusive_play_fails_the_test_with_its_reason(user: pytest.Pytester) -> None:
    user.path.joinpath("deaf.toml").write_text('kind = "inproc"\nwire_faults = "hang@from:150"\n')
    user.makepyfile(PLAYS.format(assertion="pass"))
    result = run(user, "--hil-dut", "deaf.toml")
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*INCONCLUSIVE: device deaf: no estimate for sample *"])


@pytest.mark.parametrize("dut", ["host", pytest.param("qemu-m4", marks=needs_firmware)])
def test_device_that_a_test_has_hung_is_there_again_for_the_next(user: pytest.Pytester, dut: str) -> None:
    user.makepyfile(
        f"""
        import os, signal, sys

        sys.path.append({str(Path(__file__).parents[2])!r})
        from tests.harness.processes import descendants

        def test_first(hil_play, hil_dut):
            hil_dut.configure(warm_up_n=33)
            device = descendants(os.getpid())[-1]
            os.kill(device, signal.SIGSTOP)
            print("<stopped", device, ">")
            hil_dut._talk.timeout_s = 0.1
            hil_play("short.toml")

        def test_second(hil_play, hil_dut):
            assert hil_dut.estimator.warm_up_n != 33
            assert hil_play("short.toml").detects()
        """
    )
    result = run_apart(user, "--hil-dut", f"{dut}?timeout_s={LONG_S}", "-rA")
    result.assert_outcomes(failed=1, passed=1)
    result.stdout.fnmatch_lines([f"device {dut}*: no * within 0.1 s *"])
    (stopped,) = re.findall("<stopped ([0-9]+) >", result.stdout.str())
    assert ends(int(stopped))


SHARED = """
import os, pytest

@pytest.mark.parametrize("n", range(4))
def test_on_the_device(n, hil_dut):
    assert hil_dut.recover()
    print(f"<{os.environ['PYTEST_XDIST_WORKER']}>")

@pytest.mark.parametrize("n", range(4))
def test_without(n):
    pass
"""


def test_device_of_which_there_is_one_belongs_to_one_worker(user: pytest.Pytester) -> None:
    """Tests and scenario files alike."""
    user.makepyfile(SHARED)
    folder = user.mkdir("suite")
    for name in "abcd":
        (folder / f"{name}.toml").write_text(SHORT.format(head="", expect=""))
    with board() as port:
        options = ("-n", "2", "--hil-scenario-dir", "suite", "--hil-dut", f"serial:{port}", "-v", "-rP")
        result = user.runpytest_subprocess(*options)
    result.assert_outcomes(passed=12)
    played = re.findall(r"\[(gw[01])\].* PASSED suite", result.stdout.str())
    assert len(played) == 4
    assert len({*played, *(line[1:-1] for line in result.outlines if re.fullmatch(r"<gw\d>", line))}) == 1


def test_device_of_which_there_is_one_refuses_other_ways_to_share_the_tests_out(user: pytest.Pytester) -> None:
    user.makepyfile(SHARED)
    result = refused(user, "-n", "2", "--dist", "loadfile", "--hil-dut", "serial:/dev/null")
    result.stderr.fnmatch_lines(["ERROR: device serial:/dev/null: one worker owns it, and --dist loadfile may not: *"])


@contextlib.contextmanager
def board() -> Iterator[str]:
    """A board at a serial port."""
    child = host_child()
    try:
        yield child.first_line()
    finally:
        child.end()


# ------------------------------------------------------------------------------------------------ folder of what failed


WRONG_NUMBERS = """\
import pytest
from analogrig import rate_below, with_some_seed

def play(hil_play, **options):
    return hil_play("short.toml", **options)

@pytest.mark.parametrize("within", [1e308, "4", float("nan"), float("inf"), -1, True])
def test_limit(hil_play, within):
    played = play(hil_play)
    assert played.detects(within=within)

@pytest.mark.parametrize("seed", ["4", -1, 1e308, True])
def test_seed(hil_play, seed):
    assert play(hil_play, seed=seed).passes()

def test_rate(hil_play):
    assert rate_below(1e-3, [play(hil_play)], confidence=99)

def test_tries(hil_play):
    assert with_some_seed(hil_play, "short.toml", 1, lambda played: played.passes(), tries=0)
"""


def test_wrong_numbers_in_a_test_are_one_line_each(user: pytest.Pytester) -> None:
    place = user.makepyfile(WRONG_NUMBERS)
    result = run(user, "--hil-dut", "inproc")
    result.assert_outcomes(failed=12)
    text = result.stdout.str()
    assert "Traceback" not in text and "Error" not in text.partition("short test summary")[0]
    for line in (
        f"{place.name}:10: detects: within: must be a number within +-1e+30, not 1e+308",
        f"{place.name}:10: detects: within: must be a number within +-1e+30, not '4'",
        f"{place.name}:10: detects: within: must be 0 or more, not -1",
        "seed must be a whole number from 0 to 2^63 - 1, not '4'",
        f"{place.name}:17: rate_below: confidence: must be between 0 and 1, both excluded, not 99",
        f"{place.name}:20: with_some_seed: tries: must be 1 to 1000, not 0",
    ):
        assert line in result.outlines


DETECTS_SOON = PLAYS.format(assertion="assert played.detects(within={within})")


def again(user: pytest.Pytester, *arguments: str) -> pytest.RunResult:
    """Run the counterexamples of an earlier session as a suite."""
    return run(user, "build/runs", "--hil-scenario-dir", "build/runs", *arguments)


def test_property_that_failed_fails_again_with_its_device_until_it_is_mended(user: pytest.Pytester) -> None:
    user.path.joinpath("deafer.toml").write_text(
        'kind = "inproc"\n[estimator]\nnoise_variance = 400.0\nnoise_estimated = false\n'
    )
    user.makepyfile(DETECTS_SOON.format(within=1.5))
    first = run(user, "--hil-dut", "deafer.toml")
    first.assert_outcomes(failed=1)
    first.stdout.fnmatch_lines(["judge it again with: pytest build/runs/* --hil-scenario-dir build/runs/*"])
    (left,) = user.path.glob("build/runs/*/scenario.toml")
    statement = tomllib.loads(left.read_text())["statement"]
    assert statement["name"] == "detects"
    assert statement["limits"] == {"within": 1.5}
    assert statement["test"].endswith("::test_it")
    result = again(user)  # the scenario's [expect] alone would pass
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*scenario.toml: K at 700: * samples, allowed *"])
    assert len(list(user.path.glob("build/runs/*"))) == 1, "one more of the same"
    again(user, "--hil-dut", "inproc").assert_outcomes(passed=1)


def test_property_that_failed_with_every_seed_is_tried_with_every_seed_again(user: pytest.Pytester) -> None:
    user.makepyfile(
        """
        from analogrig import with_some_seed

        def test_it(hil_play):
            assert with_some_seed(hil_play, "short.toml", 7, lambda played: played.estimates(within=1e-5), tries=3)
        """
    )
    run(user, "--hil-dut", "inproc").assert_outcomes(failed=1)
    (left,) = user.path.glob("build/runs/*/scenario.toml")
    table = tomllib.loads(left.read_text())
    assert (table["seed"], table["statement"]["tries"]) == (7, 3)
    again(user, "--junitxml", "junit.xml").assert_outcomes(failed=1)
    case = ET.parse(user.path / "junit.xml").getroot()  # noqa: S314 - written a moment ago
    seeds = [each.attrib["value"] for each in case.iter("property") if each.attrib["name"] == "seed"]
    assert seeds == ["7", "8", "9"]


KEEPS_HOLD_OFF = """
[statement]
name = "alarms_keep_hold_off_and_warm_up"
limits = {{ hold_off_n = 20, warm_up_n = 40, at_least = {at_least} }}
"""


def test_shipped_property_in_a_file_sets_the_device_itself_and_judges_by_the_limits_of_the_file(
    user: pytest.Pytester,
) -> None:
    folder = user.mkdir("suite")
    for name, at_least in (("good", 3), ("strict", 300)):
        told = SHORT.format(head="", expect="") + KEEPS_HOLD_OFF.format(at_least=at_least)
        (folder / f"{name}.toml").write_text(told)
    ends = '[statement]\nname = "record_may_end_anywhere"\nlimits = { ends = 2 }\n'
    (folder / "ends.toml").write_text(SHORT.format(head="", expect="").replace("900", "60").replace("700", "50") + ends)
    result = run(user, "--hil-dut", "inproc", "--hil-scenario-dir", "suite")
    result.assert_outcomes(passed=2, failed=1)
    result.stdout.fnmatch_lines(["*strict.toml: * alarms, where at least 300 were due"])


@pytest.mark.parametrize(
    ("told", "complaint"),
    [
        ({"name": "no_such"}, "name: there is none that is called 'no_such': there are .*detects"),
        ({"name": "detects", "limits": {"wihtin": 1.0}}, "limits: unknown key 'wihtin' .known: within."),
        ({"name": "estimates"}, "limits: missing key 'within'"),
        ({"name": "estimates", "limits": {"within": "x"}}, "limits: within: must be a number"),
    ],
)
def test_statement_that_says_nothing_is_refused_before_anything_is_played(told: dict[str, Any], complaint: str) -> None:
    statement = config.build(Statement, told, "the file: statement")
    with pytest.raises(ConfigurationError, match=f"the file: statement: {complaint}"):
        judge_statement(statement, cast(Play, None), Scenario.load("thesis"), 1, "the file")


def test_device_elsewhere_is_not_opened_on_the_word_of_a_file(user: pytest.Pytester) -> None:
    folder = user.mkdir("suite")
    (folder / "one.toml").write_text(SHORT.format(head='dut = "inproc:./evil.so"', expect=""))
    result = run(user, "--hil-scenario-dir", "suite")
    result.assert_outcomes(failed=1)
    said = "the device loads the library ./suite/evil.so, which no file may order: pass --hil-allow ./suite/evil.so"
    result.stdout.fnmatch_lines([f"*{said}*"])


FALLS_APART = """
import pathlib, sys

from hypothesis import given

from analogrig.testing.strategies import profile, seeds

@profile()
@given(seed=seeds())
def test_it(hil_play, seed):
    found = hil_play("short.toml", seed).estimates(within=1e-9)
    left = sorted(pathlib.Path("build/runs").glob("*"))
    print("<left", seed, *(path.name for path in left), ">", flush=True)
    if left:
        (folder,) = left
        assert {"run.npz", "scenario.toml"} == {path.name for path in folder.iterdir()}
        STOP
    assert found or seed < 1000
"""


def test_property_that_is_ended_while_it_shrinks_has_left_a_counterexample(user: pytest.Pytester) -> None:
    user.makepyfile(FALLS_APART.replace("STOP", "import os; os.kill(os.getpid(), 9)"))
    result = run_apart(user, "-s", "--hil-dut", "inproc")
    assert result.ret == -9
    again(user).assert_outcomes(failed=1)


def test_counterexample_is_replaced_while_it_shrinks_and_ends_as_the_simplest(user: pytest.Pytester) -> None:
    user.makepyfile(FALLS_APART.replace("STOP", "pass"))
    result = run(user, "-s", "--hil-dut", "inproc")
    result.assert_outcomes(failed=1)
    (left,) = user.path.glob("build/runs/*")
    assert tomllib.loads((left / "scenario.toml").read_text())["seed"] == 1000
    assert (left / "report.html").is_file()
    assert [path.name for path in left.parent.iterdir()] == [left.name], "something is left besides"


def test_workers_pass_on_the_properties_of_a_device_that_a_file_names(user: pytest.Pytester) -> None:
    """The name of a file's device is a str of its own class, which execnet refused: no test had a result."""
    user.makeini("[pytest]\nhil_dut = inproc\n")
    user.makepyfile(PLAYS.format(assertion="assert played.passes()"))
    user.runpytest_subprocess("-n", "2").assert_outcomes(passed=1)


def test_interrupted_play_ends_the_session(user: pytest.Pytester) -> None:
    """A test that allows inconclusive plays passed, and the next ones ran."""
    user.makepyfile("""
        import os, signal, threading

        def test_first(hil_play):
            threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
            while True:
                hil_play("healthy", allow_inconclusive=True)

        def test_second():
            pass
    """)
    result = run_apart(user, "--hil-dut", "inproc")
    assert result.ret == pytest.ExitCode.INTERRUPTED
    assert "passed" not in result.stdout.str().splitlines()[-1]
