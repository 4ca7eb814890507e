"""``analogrig patch``."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from analogrig.cli import main

MOTOR = Path(__file__).parents[2] / "fixtures" / "programs" / "dc-motor.toml"


def test_sheet_drawing_and_deck_are_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drawing, deck = tmp_path / "motor.svg", tmp_path / "motor.cir"
    assert main(["patch", str(MOTOR), "--drawing", str(drawing), "--netlist", str(deck)]) == 0
    assert "dc-motor: DC motor with load" in capsys.readouterr().out
    assert drawing.read_text().startswith("<svg")
    assert deck.read_text().startswith("* program dc-motor") and ".tran" in deck.read_text()


def test_shipped_program_goes_by_its_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["patch", "pendulum"]) == 0
    assert "pendulum with damping" in capsys.readouterr().out
    assert main(["patch", "pendolum"]) == 2
    assert "no program is called 'pendolum': there are bump-stop, dc-motor" in capsys.readouterr().err


def test_sheet_for_the_analog_thing_or_the_reason_against_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drawing = tmp_path / "front.svg"
    assert main(["patch", "front", "--machine", "that", "--drawing", str(drawing)]) == 0
    assert "<title>front on THE ANALOG THING</title>" in drawing.read_text()
    assert "front on THE ANALOG THING" in capsys.readouterr().out
    assert main(["patch", "front", "--machine", "that", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["speed"] == pytest.approx(20.0) and len(found["cables"]) == 6
    assert main(["patch", "two-mass", "--machine", "that"]) == 2
    assert "program two-mass: needs 5 summers, and THE ANALOG THING has 4" in capsys.readouterr().err


def test_a_program_with_a_diagram_says_that_a_run_plays_another_circuit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    deck, told = tmp_path / "front.cir", "This patch is compiled from the equations; a run plays the diagram front."
    assert main(["patch", "front", "--netlist", str(deck)]) == 0
    assert told in capsys.readouterr().out.splitlines()
    assert deck.read_text().startswith(f"* program front. {told}\n")


def test_json_has_scales_and_dials(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["patch", str(MOTOR), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["full"] == {"u": 24.0, "i": 20.0, "omega": 300.0}
    assert found["dials"]["J"] == pytest.approx(0.6394, abs=1e-4)


@pytest.mark.parametrize(
    ("text", "arguments", "message"),
    [
        ("name = 3", [], "bad.toml: "),
        (MOTOR.read_text().replace("k*omega", "k*omga"), [], "bad.toml: equations, line 1: unknown name 'omga'; did"),
        (
            MOTOR.read_text(),
            ["--netlist", "motor.cir", "--machine", "that"],
            "--netlist: there is no deck of",
        ),
        (MOTOR.read_text(), ["--drawing", "motor.png"], "motor.png: the file's name must end with .svg"),
    ],
)
def test_bad_use_is_one_line(
    text: str, arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(text)
    assert main(["patch", str(path), *arguments]) == 2
    captured = capsys.readouterr()
    assert message in captured.err and captured.err.count("\n") == 1 and not captured.out


def test_file_that_is_read_is_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "motor.toml"
    path.write_text(MOTOR.read_text())
    assert main(["patch", str(path), "--netlist", str(path)]) == 2
    assert str(path) in capsys.readouterr().err
    assert path.read_text() == MOTOR.read_text()


def test_program_that_no_run_could_play_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A chain of 17 first-order lags has 68 states: integrators, inverters, and a pole in each amplifier of both."""
    lags = range(1, 18)
    path = tmp_path / "chain.toml"
    path.write_text(
        'name = "chain"\ndescription = "lags"\nspeed = 10\nchannels = ["u", "x1"]\nequations = """\n'
        + "".join(f"x{k}' = ({f'x{k - 1}' if k > 1 else 'u'} - x{k}) / T\n" for k in lags)
        + '"""\n[inputs]\nu = { unit = "V", full = 5.0, trial = [0.0, 4.0] }\n[states]\n'
        + "".join(f'x{k} = {{ unit = "V" }}\n' for k in lags)
        + '[parameters]\nT = { value = 1e-2, unit = "s" }\n'
    )
    assert main(["patch", str(path)]) == 2
    captured = capsys.readouterr()
    assert captured.err == f"analogrig: {path}: the circuit has 68 states; the engine takes at most 64\n"
    assert not captured.out


@pytest.mark.parametrize(("speed", "told"), [(10, False), (0.5, True), (95, True)])
def test_a_speed_at_which_the_plant_hardly_moves_or_settles_at_once_is_noted(
    speed: float,
    told: bool,  # noqa: FBT001
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    text = MOTOR.read_text()
    assert text.count("speed = 10") == 1
    (tmp_path / "motor.toml").write_text(text.replace("speed = 10", f"speed = {speed}\nperiod_s = 0.05"))
    assert main(["patch", str(tmp_path / "motor.toml")]) == 0
    notes = [line for line in capsys.readouterr().out.splitlines() if line.startswith("note: the plant settles in")]
    assert len(notes) == told and all("write speed = 8.8 for 100" in line for line in notes)


def test_the_deck_is_named_with_the_command_that_runs_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    deck = tmp_path / "motor.cir"
    assert main(["patch", str(MOTOR), "--netlist", str(deck)]) == 0
    assert capsys.readouterr().out.endswith(f"written: {deck}; run it with: ngspice -b -r out.raw {deck}\n")


@pytest.mark.parametrize(("first", "notes"), [(-20.0, []), (12.0, ["note: friction: omega is 0 to "])])
def test_a_table_that_the_trial_play_leaves_is_noted(
    first: float, notes: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "brake.toml"
    file.write_text(
        'name = "brake"\nspeed = 10\nchannels = ["u", "omega"]\nequations = "omega\' = (u - friction(omega)) / T"\n'
        f"[functions.friction]\npoints = [[{first}, {first}], [14.0, 14.0], [30.0, 30.0]]\n"
        "[inputs]\nu = { full = 20.0, trial = [0.0, 18.0] }\n[states]\nomega = {}\n[parameters]\nT = { value = 0.1 }\n"
    )
    assert main(["patch", str(file)]) == 0
    told = [line for line in capsys.readouterr().out.splitlines() if line.startswith("note: friction")]
    assert len(told) == len(notes) and all(line.startswith(note) for line, note in zip(told, notes, strict=True))


def test_an_input_that_no_generator_drives_is_noted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "loaded.toml"
    file.write_text(
        MOTOR.read_text()
        .replace("- d*omega)", "- d*omega - load)")
        .replace("[inputs]", '[inputs]\nload = { unit = "N m", full = 1.0, trial = [0.0, 0.1] }')
    )
    text = file.read_text()
    (line,) = (each for each in text.splitlines() if each.startswith("load = "))
    file.write_text(text.replace(line + "\n", "").replace("\n[states]", f"{line}\n\n[states]"))
    assert main(["patch", str(file)]) == 0
    assert "note: load: moves in the trial play; a run holds it at 0 V and drives u" in capsys.readouterr().out
    command = ["run", "--program", str(file), "--dut", "inproc", "--seed", "1", "--out", str(tmp_path / "run")]
    assert main(command) in {0, 1, 3}
    assert "note: load: held at 0 V, the generator drives u alone" in capsys.readouterr().out


def test_an_excitation_beyond_the_trial_levels_is_named_for_clipped_samples(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scenario = tmp_path / "high.toml"
    scenario.write_text('program = "dc-motor"\nsamples = 700\n[excitation]\nhigh_v = 14.0\n')
    main(["run", "--scenario", str(scenario), "--dut", "inproc", "--out", str(tmp_path / "run")])
    assert "the excitation goes from 0 to 14 V: the program dc-motor is scaled for its trial levels, 0 to 8.333 V" in (
        capsys.readouterr().out
    )


def test_a_parameter_without_a_pot_is_no_unknown_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scenario = tmp_path / "moon.toml"
    scenario.write_text('program = "two-tanks"\nsamples = 60\nset = { g = 16.2 }\n[excitation]\nhigh_v = 8.0\n')
    assert main(["run", "--scenario", str(scenario), "--dut", "inproc", "--out", str(tmp_path / "run")]) == 2
    assert "program two-tanks: g is on no pot (pot = false), so a scenario cannot set it" in capsys.readouterr().err
