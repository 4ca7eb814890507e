"""Twin of measured data: parameters of a program from a recording, and what a user may get wrong."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from analogrig.cli import main, terminal
from analogrig.config import fixtures
from analogrig.rigs.emulator import ComputerDescription
from analogrig.run import Run
from analogrig_emulator import Excitation, Multiplier, RecordedExcitation, SuspensionComputer, load_patch
from analogrig_instruments.calibration.recorded_plant import SETTLING_N, RecordedPlant, _determined
from tests.harness.commands import error_of, output_of

RATES_HZ = {"silverbox": 10e6 / 2**14, "front": 100.0, "dc-motor": 2000.0, "rc-battery": 1.0}
SAMPLES = 2000
TRUE = {"rate": 410.0, "gain": 470.0, "damping": 35.0, "square": 60.0, "cube": 1400.0, "offset": 4e-3}


def multisine(samples: int = SAMPLES) -> NDArray[np.float64]:
    """Random phases up to 0.15 of the sample rate, 0.05 rms."""
    rng = np.random.default_rng(3)
    spectrum = np.where(
        np.arange(samples // 2 + 1) < 0.3 * samples, np.exp(2j * np.pi * rng.random(samples // 2 + 1)), 0
    )
    u = np.fft.irfft(spectrum)
    return np.asarray(u * (0.05 / u.std()))


def record(
    folder: Path, name: str, values: dict[str, float], played: RecordedExcitation | Excitation, *, noise_v: float = 5e-4
) -> Path:
    """Recording of the first two channels of a program, with noise of 5e-5 of the output's full scale."""
    rate_hz = RATES_HZ[name]
    program = load_patch(fixtures() / "programs" / f"{name}.toml")
    computer = SuspensionComputer(program, opamp="ideal", sample_rate_hz=rate_hz * program.equations.speed)
    computer.set(**values)
    volts = np.concatenate([block[:, :2] for block in computer.play(played, SAMPLES)])
    volts[:, 1] += noise_v * np.random.default_rng(3).normal(size=SAMPLES)
    u, y = (volts[:, at] * program.scales.full(each) / 10.0 for at, each in enumerate(program.channels[:2]))
    np.savez(folder / "measured.npz", u=u, y=y)
    command = ["import", str(folder / "measured.npz"), "--input", "u", "--output", "y", "--rate", str(rate_hz)]
    units = [program.equations.quantities[each].unit for each in program.channels[:2]]
    for side, unit in zip(("input", "output"), units, strict=True):
        command += [f"--{side}-unit", unit.text if unit else "V"]
    assert main([*command, "--out", str(folder / "recording.npz")]) == 0
    return folder / "recording.npz"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recording of a silverbox with other values than the program file's."""
    played = RecordedExcitation(multisine() * 10.0 / 0.2)
    return record(tmp_path_factory.mktemp("measured"), "silverbox", TRUE, played)


def fit(recording: Path, program: str, capsys: pytest.CaptureFixture[str], *options: str) -> dict[str, Any]:
    """Fit a program to a recording by the command, and return its JSON."""
    command = ["calibrate", "--recording", str(recording), "--program", program, "--json", *options]
    capsys.readouterr()
    told: dict[str, Any] = json.loads(output_of(*command, "--out", str(recording.parent / "fitted.toml")))
    return told


def test_a_fit_finds_the_values_of_the_machine_and_keeps_them(recording: Path, tmp_path: Path) -> None:
    twin = tmp_path / "twin.toml"
    command = ["calibrate", "--recording", str(recording), "--program", "silverbox", "--settle", "400", "--json"]
    spans = ["--span", "0:1200", "--check", "1200:2000"]
    told = json.loads(output_of(*command, *spans, "--most-rms", "4e-5", "--out", str(twin)))
    for parameter in told["parameters"]:
        error = abs(parameter["value"] - TRUE[parameter["name"]])
        assert error < 5.0 * parameter["standard_error"] < 0.05 * parameter["value"]
    assert told["reconstruction"] == "band-limited" and told["other_rms"] > 5.0 * told["fit"]["rms"]
    assert told["fit"]["rms"] == pytest.approx(2e-5, rel=0.2)
    assert told["check"]["rms"] == pytest.approx(2e-5, rel=0.3)
    assert told["fit"]["noise"] == pytest.approx(2e-5, rel=0.2) and not told["caveats"] and told["rig"] is None
    kept = load_patch(twin)
    assert kept.values == {each["name"]: each["value"] for each in told["parameters"]}
    assert kept.equations.channels == ("u", "y")


FRONT = {"M": 105.0, "B": 2800.0, "K": 23000.0}
MOTOR = {"R": 1.3, "L": 4.4e-3, "k": 0.075, "J": 9e-5, "d": 2.3e-4}


@pytest.mark.parametrize("kind", ["held", "square"])
def test_an_input_that_is_held_between_samples_gives_no_bias(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    levels_v = 5.0 + 60.0 * multisine()
    if kind == "square":
        levels_v = np.where(np.arange(SAMPLES) % 100 < 50, 9.0, 1.0)
    measured = record(tmp_path, "front", FRONT, RecordedExcitation(levels_v, is_held=True))
    told = fit(measured, "front", capsys)
    assert told["reconstruction"] == "held" and not told["may_jump_between_samples"]
    for each in told["parameters"]:
        assert each["value"] == pytest.approx(FRONT[each["name"]], rel=2e-3)
    (mass, *_) = fit(measured, "front", capsys, "--reconstruction", "band-limited")["parameters"]
    assert abs(mass["value"] / FRONT["M"] - 1.0) > 0.02


def test_noise_hides_no_course_of_a_held_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    levels_v = np.where(np.arange(SAMPLES) % 100 < 50, 9.0, 1.0)
    measured = record(tmp_path, "front", FRONT, RecordedExcitation(levels_v, is_held=True), noise_v=0.2)
    told = fit(measured, "front", capsys, "--fix", "K=23000")
    assert told["reconstruction"] == "held" and told["other_is_fitted"]
    assert told["fit"]["rms"] < told["other_rms"] < 1.5 * told["fit"]["rms"] and not told["caveats"]


def test_edges_between_the_samples_are_a_caveat(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    square = Excitation(low_v=1.0, high_v=9.0, frequency_hz=20e3 / 97.3, clock="free")
    told = fit(record(tmp_path, "front", FRONT, square), "front", capsys)
    assert told["may_jump_between_samples"]


def test_parameters_that_act_alike_are_named_until_enough_are_fixed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    measured = record(tmp_path, "dc-motor", MOTOR, RecordedExcitation(4.0 + 60.0 * multisine()))
    told = fit(measured, "dc-motor", capsys)
    assert told["inseparable"] == ["R", "L", "k", "J", "d"] and told["surplus"] == 2 and not told["unseen"]
    assert all(each["standard_error"] is None for each in told["parameters"])
    told = fit(measured, "dc-motor", capsys, "--fix", "R=1.3", "--fix", "d=2.3e-4")
    assert not told["inseparable"] and len(told["parameters"]) == 3
    for each in told["parameters"]:
        assert abs(each["value"] - MOTOR[each["name"]]) < 5.0 * each["standard_error"] < 0.05 * each["value"]
    assert load_patch(tmp_path / "fitted.toml").values["R"] == 1.3


def test_a_parameter_that_the_excitation_does_not_show_is_named(tmp_path: Path) -> None:
    measured = record(tmp_path, "silverbox", TRUE, RecordedExcitation(0.5 * multisine()))
    command = ["calibrate", "--recording", str(measured), "--program", "silverbox"]
    told = output_of(*command, "--out", str(tmp_path / "twin.toml"))
    assert "square, cube: hardly act on the output here" in told
    assert "cube" in (line := next(line for line in told.splitlines() if "not determined" in line and "cube" in line))
    assert "+-" not in line


def test_a_twin_of_another_plant_is_kept_on_demand_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.savez(tmp_path / "a.npz", u=multisine(800), y=1e-3 * np.cos(np.arange(800.0)))
    command = ["import", str(tmp_path / "a.npz"), "--input", "u", "--output", "y", "--rate", "610"]
    assert main([*command, "--out", str(tmp_path / "r.npz")]) == 0
    command = ["calibrate", "--recording", str(tmp_path / "r.npz"), "--program", "silverbox"]
    assert main([*command, "--out", str(tmp_path / "twin.toml")]) == 1
    told = capsys.readouterr().out
    assert "caveat: the machine differs by more than half of what the output moves" in told
    assert "nothing kept" in told and not (tmp_path / "twin.toml").exists()
    assert main([*command, "--most-rms", "1", "--out", str(tmp_path / "twin.toml")]) == 0


def test_a_beginning_that_does_not_fit_names_the_cure(recording: Path, tmp_path: Path) -> None:
    command = ["calibrate", "--recording", str(recording), "--program", "silverbox", "--span", "700:2000"]
    assert "the recording did not begin at rest; pass a --settle above 0" in output_of(
        *command, "--settle", "0", "--out", str(tmp_path / "twin.toml")
    )
    assert "--settle" not in output_of(*command, "--settle", "300", "--out", str(tmp_path / "twin.toml"))


def test_a_plant_that_changes_unknown_to_the_recording_has_no_twin(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    levels_v = np.where(np.arange(SAMPLES) % 100 < 50, 9.0, 1.0)
    parts = []
    for stiffness in (18e3, 26e3):
        played = RecordedExcitation(levels_v, is_held=True)
        measured = np.load(record(tmp_path, "front", FRONT | {"K": stiffness}, played).parent / "measured.npz")
        parts.append({name: measured[name] for name in ("u", "y")})
    u, y = (np.concatenate([part[name] for part in parts]) for name in ("u", "y"))
    np.savez(tmp_path / "both.npz", u=u, y=y)
    command = ["import", str(tmp_path / "both.npz"), "--input", "u", "--output", "y", "--rate", "100"]
    assert main([*command, "--input-unit", "N", "--output-unit", "m", "--out", str(tmp_path / "r.npz")]) == 0
    capsys.readouterr()
    out = tmp_path / "fitted.toml"
    command = ["calibrate", "--recording", str(tmp_path / "r.npz"), "--program", "front", "--json", "--out", str(out)]
    told = json.loads(output_of(*command, "--fix", "B", "--fix", "M", status=1))
    (caveat,) = told["caveats"]
    assert "times the noise of the output: the plant changed" in caveat
    assert told["file"] is None and not out.exists()


def test_a_perfect_fit_of_an_output_that_nothing_moves_has_finite_errors() -> None:
    found = _determined(np.stack([np.zeros(9), np.arange(9.0)], axis=1), 0.0)
    assert found.is_unseen.tolist() == [True, False] and np.isfinite(found.errors).all()
    assert np.isfinite(_determined(np.zeros((9, 2)), 0.0).errors).all()


def test_a_program_is_fitted_to_a_rig(tmp_path: Path) -> None:
    twin = tmp_path / "twin.toml"
    told = json.loads(
        output_of("calibrate", "--rig", "emulator-real", "--program", "pendulum", "--json", "--out", str(twin))
    )
    assert told["reconstruction"] == "held" and told["check"]["rms"] < 2.0 * told["fit"]["rms"] < 0.04
    true = load_patch(fixtures() / "programs" / "pendulum.toml").values
    assert load_patch(twin).values == pytest.approx(true, rel=0.04)


def test_twin_with_the_real_parts_of_the_rig_follows_it(tmp_path: Path) -> None:
    """Multipliers included: nominal parts leave 0.016."""
    command = ["calibrate", "--rig", "emulator-real", "--program", "pendulum", "--components", "polypropylene"]
    assert json.loads(output_of(*command, "--json", "--out", str(tmp_path / "twin.toml")))["check"]["rms"] < 1e-3


def test_multipliers_of_a_real_twin_have_the_pole_of_the_data_sheet(recording: Path) -> None:
    program = load_patch(fixtures() / "programs" / "silverbox.toml")
    for computer, bandwidth_hz in (
        (ComputerDescription(), math.inf),
        (ComputerDescription(components="polyester"), 1e6),
    ):
        plant = RecordedPlant(program, Run.load(recording), computer)
        assert {each.model.bandwidth_hz for each in plant._computer.circuit.of(Multiplier)} == {bandwidth_hz}


def test_a_plant_that_changes_in_the_recording_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--scenario", "pendulum", "--dut", "inproc", "--out", str(tmp_path / "run")]) in {0, 1}
    command = ["calibrate", "--recording", str(tmp_path / "run" / "run.npz"), "--program", "pendulum"]
    assert main([*command, "--out", str(tmp_path / "twin.toml")]) == 2
    assert "sample 1000: the plant changes in the recording; pass a span" in capsys.readouterr().err
    assert main([*command, "--span", "0:1000", "--out", str(tmp_path / "twin.toml")]) == 0


def test_a_poor_twin_is_not_kept(recording: Path, tmp_path: Path) -> None:
    linear = tmp_path / "linear.toml"
    text = (fixtures() / "programs" / "silverbox.toml").read_text()
    text = "\n".join(line for line in text.splitlines() if not line.startswith(("square =", "cube =")))
    linear.write_text(text.replace(" + square*x**2 - cube*x**3", ""))
    twin = tmp_path / "twin.toml"
    command = ["calibrate", "--recording", str(recording), "--program", str(linear), "--out", str(twin)]
    assert "no twin: more than 4e-05 V; nothing kept" in output_of(*command, "--most-rms", "4e-5", status=1)
    assert not twin.exists()


def test_a_program_that_a_run_refuses_is_refused(recording: Path, tmp_path: Path) -> None:
    program, text = tmp_path / "box.toml", (fixtures() / "programs" / "silverbox.toml").read_text()
    program.write_text(text.replace("gain = {", 'gain = { alias = "sample",'))
    command = ["calibrate", "--recording", str(recording), "--program", str(program)]
    assert "box.toml: parameters.gain.alias: sample is a key of scenarios' changes" in error_of(
        *command, "--out", str(tmp_path / "twin.toml")
    )


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--span", "100"], "'100' is no span: write FIRST:END"),
        (["--span", "0:9000"], "samples 0 to 9000 are not within the 2000"),
        (["--span", "0:100"], "a span needs 400: 200 settle the machine"),
        (["--program", "nosuch"], "no program is called 'nosuch'"),
        (["--program", "dc-motor"], "omega of program dc-motor is in rad/s"),
        (["--program", "pendulum"], "of program pendulum is in"),
        (["--pots", "dial"], "--pots is for a rig with front or shock"),
        (["--fix", "mass"], "program silverbox has no parameter 'mass' on a pot; there are rate, gain"),
        (["--fix", "gain=much"], "--fix gain=much: 'much' is no number"),
        (["--fix", "gain=4"], "gain = 4: must be within its range, 300 to 800"),
        (["--out", "twin.npz"], "must be a .toml file"),
        (["--check", "0:1000"], "--check 0:1000: samples 0 to 999 are fitted, too: end --span or begin --check"),
        (["--span", "0:1500", "--check", "1400:2000"], "--check 1400:2000: samples 1400 to 1499 are fitted, too"),
        ([f"--fix={name}" for name in TRUE], "every parameter with a range is fixed; leave one to fit"),
        (["--rig", "emulator-real"], "--rig emulator-real: is not played with --recording; leave out one of them"),
        (["--recording", __file__], "not a recording of analogrig; analogrig import makes one of measured data"),
    ],
)
def test_wrong_options_are_one_line(
    options: list[str], complaint: str, recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["calibrate", "--recording", str(recording), "--program", "silverbox", "--out", str(tmp_path / "t.toml")]
    status = main([*command, *options])
    told = capsys.readouterr().err
    assert status == 2 and complaint in told and told.count("\n") == 1


@pytest.mark.parametrize("options", [["--span", "0:9"], ["--check", "0:9"], ["--most-rms", "1"], ["--fix", "M"]])
def test_options_of_recordings_are_refused_for_rigs(options: list[str]) -> None:
    assert f"{options[0]} is for --recording" in error_of("calibrate", *options)


def test_a_missing_input_cannot_be_played(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    u = np.sin(np.arange(600.0))
    u[300] = np.nan
    np.savez(tmp_path / "a.npz", u=u, y=np.cos(np.arange(600.0)))
    command = ["import", str(tmp_path / "a.npz"), "--input", "u", "--output", "y", "--rate", "1000"]
    assert main([*command, "--out", str(tmp_path / "r.npz")]) == 0
    assert main(["calibrate", "--recording", str(tmp_path / "r.npz"), "--program", "silverbox"]) == 2
    assert "sample 300: the input is missing or clipped" in capsys.readouterr().err


def test_the_check_of_a_plant_that_integrates_begins_with_its_state(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    current_v = 1.5 + 3.0 * np.random.default_rng(5).normal(size=SAMPLES // 10).repeat(10).clip(-2.0, 2.0)
    measured = record(tmp_path, "rc-battery", {"R0": 0.012}, RecordedExcitation(current_v, is_held=True))
    fixed = [f"--fix={name}" for name in ("R1", "C1", "R2", "C2", "slope", "capacity")]
    told = fit(measured, "rc-battery", capsys, "--span", "0:1400", "--check", "1400:2000", *fixed)
    assert told["check"]["rms"] == pytest.approx(told["fit"]["rms"], rel=0.1) and not told["caveats"]


def test_a_check_far_from_the_fit_is_a_caveat(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    signals = dict(np.load(recording.parent / "measured.npz"))
    signals["y"][1400:] *= 1.02
    np.savez(tmp_path / "a.npz", **signals)
    command = ["import", str(tmp_path / "a.npz"), "--input", "u", "--output", "y", "--rate", str(RATES_HZ["silverbox"])]
    assert main([*command, "--out", str(tmp_path / "r.npz")]) == 0
    told = fit(tmp_path / "r.npz", "silverbox", capsys, "--span", "0:1400", "--check", "1400:2000")
    (caveat,) = told["caveats"]
    assert (
        caveat.startswith("caveat: samples that were not fitted differ ") and "the twin holds for those alone" in caveat
    )


def test_a_fit_counts_its_plays_on_a_terminal(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(terminal, "_is_terminal", lambda stream: True)  # noqa: ARG005
    monkeypatch.setattr(terminal, "_PROGRESS_S", 0.01)
    command = ["calibrate", "--recording", str(recording), "--program", "silverbox"]
    assert re.search(
        r"fitting: \d+ s, \d+ plays", error_of(*command, "--out", str(recording.parent / "fitted.toml"), status=0)
    )


def test_the_help_states_the_settling_time(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["calibrate", "--help"])
    assert f"not compared (default: {SETTLING_N})" in " ".join(capsys.readouterr().out.split())


def test_a_fit_begun_at_the_ends_of_the_ranges_finds_the_machine(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Beside a bound scipy's steps hardly move."""
    text = """
name = "reaction"
speed = 500
channels = ["u", "y"]
equations = '''
x' = a*u - x
y' = x/(0.3 + x*x) - e*y
'''
[inputs]
u = { full = 1.0, trial = [-1.0, 1.0] }
[states]
x = { full = 3.0 }
y = { full = 3.0 }
[parameters]
a = { value = 0.5, range = [0.5, 1.5] }
e = { value = 2.0, range = [0.5, 2.0] }
"""
    path = tmp_path / "reaction.toml"
    path.write_text(text)
    computer = SuspensionComputer(load_patch(path), opamp="ideal")
    computer.set(a=0.7, e=1.4)
    volts = np.concatenate(list(computer.play(RecordedExcitation(multisine() * 8.0), SAMPLES)))
    np.save(tmp_path / "measured.npy", volts / [10.0, 10.0 / 3.0])
    columns = ["--input", "0", "--output", "1", "--rate", "40", "--bits", "16"]
    measured = str(tmp_path / "measured.npz")
    assert main(["import", str(tmp_path / "measured.npy"), *columns, "--out", measured]) == 0
    told = fit(Path(measured), str(path), capsys)
    assert {row["name"]: row["value"] for row in told["parameters"]} == pytest.approx({"a": 0.7, "e": 1.4}, rel=0.01)
