"""``analogrig patch``."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from analogrig.cli import main
from tests.harness.commands import called, error_of, output_of

MOTOR = Path(__file__).parents[2] / "fixtures" / "programs" / "dc-motor.toml"


def test_sheet_drawing_and_deck_are_written(tmp_path: Path) -> None:
    drawing, deck = tmp_path / "motor.svg", tmp_path / "motor.cir"
    assert "dc-motor: DC motor with load" in output_of(
        "patch", str(MOTOR), "--drawing", str(drawing), "--netlist", str(deck)
    )
    assert drawing.read_text().startswith("<svg")
    assert deck.read_text().startswith("* program dc-motor") and ".tran" in deck.read_text()


def test_shipped_program_goes_by_its_name() -> None:
    assert "pendulum with damping" in output_of("patch", "pendulum")
    assert "no program is called 'pendolum': there are bump-stop, dc-motor" in error_of("patch", "pendolum")


def test_sheet_for_the_analog_thing_or_the_reason_against_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drawing = tmp_path / "front.svg"
    assert main(["patch", "front", "--machine", "that", "--drawing", str(drawing)]) == 0
    assert "<title>front on THE ANALOG THING</title>" in drawing.read_text()
    assert "front on THE ANALOG THING" in capsys.readouterr().out
    found = json.loads(output_of("patch", "front", "--machine", "that", "--json"))
    assert found["speed"] == pytest.approx(20.0) and len(found["cables"]) == 6
    assert "program two-mass: needs 5 summers, and THE ANALOG THING has 4" in error_of(
        "patch", "two-mass", "--machine", "that"
    )


def test_a_program_with_a_diagram_says_that_a_run_plays_another_circuit(tmp_path: Path) -> None:
    deck, told = tmp_path / "front.cir", "This patch is compiled from the equations; a run plays the diagram front."
    assert told in output_of("patch", "front", "--netlist", str(deck)).splitlines()
    assert deck.read_text().startswith(f"* program front. {told}\n")


def test_json_has_scales_and_dials() -> None:
    found = json.loads(output_of("patch", str(MOTOR), "--json"))
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
def test_bad_use_is_one_line(text: str, arguments: list[str], message: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(text)
    captured = called("patch", str(path), *arguments)
    assert captured.status == 2, captured.out + captured.err
    assert message in captured.err and captured.err.count("\n") == 1 and not captured.out


def test_file_that_is_read_is_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "motor.toml"
    path.write_text(MOTOR.read_text())
    assert str(path) in error_of("patch", str(path), "--netlist", str(path))
    assert path.read_text() == MOTOR.read_text()


def test_program_that_no_run_could_play_is_refused(tmp_path: Path) -> None:
    """A chain of 25 first-order lags has 100 states: integrators, inverters, and a pole in each amplifier of both."""
    lags = range(1, 26)
    path = tmp_path / "chain.toml"
    path.write_text(
        'name = "chain"\ndescription = "lags"\nspeed = 10\nchannels = ["u", "x1"]\nequations = """\n'
        + "".join(f"x{k}' = ({f'x{k - 1}' if k > 1 else 'u'} - x{k}) / T\n" for k in lags)
        + '"""\n[inputs]\nu = { unit = "V", full = 5.0, trial = [0.0, 4.0] }\n[states]\n'
        + "".join(f'x{k} = {{ unit = "V" }}\n' for k in lags)
        + '[parameters]\nT = { value = 1e-2, unit = "s" }\n'
    )
    captured = called("patch", str(path))
    assert captured.status == 2, captured.out + captured.err
    assert captured.err == f"analogrig: {path}: the circuit has 100 states; the engine takes at most 96\n"
    assert not captured.out


@pytest.mark.parametrize(("speed", "told"), [(10, False), (0.5, True), (95, True)])
def test_a_speed_at_which_the_plant_hardly_moves_or_settles_at_once_is_noted(
    speed: float,
    told: bool,  # noqa: FBT001
    tmp_path: Path,
) -> None:
    text = MOTOR.read_text()
    assert text.count("speed = 10") == 1
    (tmp_path / "motor.toml").write_text(text.replace("speed = 10", f"speed = {speed}\nperiod_s = 0.05"))
    notes = [
        line
        for line in output_of("patch", str(tmp_path / "motor.toml")).splitlines()
        if line.startswith("note: the plant settles in")
    ]
    assert len(notes) == told and all("write speed = 8.8 for 100" in line for line in notes)


@pytest.mark.parametrize(
    ("program", "named"),
    [
        ("dc-motor", ["k = 0.1", "J = 5e-05"]),
        ("silverbox", ["square = 1"]),
        ("rc-battery", ["R2 = 0.008"]),
        ("duffing", []),
    ],
)
def test_values_that_not_every_draw_of_real_parts_reaches_are_noted(program: str, named: list[str]) -> None:
    notes = [line for line in output_of("patch", program).splitlines() if "emulator-real may refuse it" in line]
    assert [note.partition("note: ")[2].partition(" turns pot")[0] for note in notes] == named


FLOW = """name = "flow"
channels = ["u", "x", "z"]
speed = 800
period_s = 20.0
equations = '''
x' = -y - z + u
y' = x + 0.15*y
z' = {constant} + z*(x - 5)
'''
[inputs]
u = {{ full = 1.5, trial = [-0.75, 1.5] }}
[states]
x = {{}}
y = {{}}
z = {{}}
"""


@pytest.mark.parametrize(("constant", "status"), [(0.2, 2), (0.1, 2), (2.0, 0), (3.0, 0)])
def test_a_flow_that_offsets_drive_to_infinity_is_refused(constant: float, status: int, tmp_path: Path) -> None:
    """A negative z grows without end: offsets of real parts exceed a small constant, not a large one."""
    file = tmp_path / "flow.toml"
    file.write_text(FLOW.format(constant=constant))
    shown = called("patch", str(file))
    assert shown.status == status, shown.out + shown.err
    assert ("real parts drive the program to infinity" in shown.err) == (status == 2)
    assert "note: a run on emulator-real overloads" not in shown.out


@pytest.mark.parametrize("program", ["duffing", "pendulum", "van-der-pol", "two-tanks", "bump-stop", "silverbox"])
def test_no_machine_of_real_parts_is_overloaded_by_a_shipped_program(program: str) -> None:
    assert "emulator-real overloads" not in output_of("patch", program)


def test_the_deck_is_named_with_the_command_that_runs_it(tmp_path: Path) -> None:
    deck = tmp_path / "motor.cir"
    assert output_of("patch", str(MOTOR), "--netlist", str(deck)).endswith(
        f"written: {deck}; run it with: ngspice -b -r out.raw {deck}\n"
    )


@pytest.mark.parametrize(("first", "notes"), [(-20.0, []), (12.0, ["note: friction: omega is 0 to "])])
def test_a_table_that_the_trial_play_leaves_is_noted(first: float, notes: list[str], tmp_path: Path) -> None:
    file = tmp_path / "brake.toml"
    file.write_text(
        'name = "brake"\nspeed = 10\nchannels = ["u", "omega"]\nequations = "omega\' = (u - friction(omega)) / T"\n'
        f"[functions.friction]\npoints = [[{first}, {first}], [14.0, 14.0], [30.0, 30.0]]\n"
        "[inputs]\nu = { full = 20.0, trial = [0.0, 18.0] }\n[states]\nomega = {}\n[parameters]\nT = { value = 0.1 }\n"
    )
    told = [line for line in output_of("patch", str(file)).splitlines() if line.startswith("note: friction")]
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
    assert "note: load: moves in the trial play; a run holds it at 0 V and drives u" in output_of("patch", str(file))
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


def test_a_parameter_without_a_pot_is_no_unknown_one(tmp_path: Path) -> None:
    scenario = tmp_path / "moon.toml"
    scenario.write_text('program = "two-tanks"\nsamples = 60\nset = { g = 16.2 }\n[excitation]\nhigh_v = 8.0\n')
    assert "program two-tanks: g is on no pot (pot = false), so a scenario cannot set it" in error_of(
        "run", "--scenario", str(scenario), "--dut", "inproc", "--out", str(tmp_path / "run")
    )


def test_model_of_a_linear_program_is_printed_sampled() -> None:
    found = json.loads(output_of("patch", "dc-motor", "--json"))
    model, period_s = found["model"], found["sample_period_s"] * found["time_scale"]
    assert (model["states"], found["amplifier_offset_v"]) == (["i", "omega"], 0.003)
    assert model["A"] == [pytest.approx([-1.2 / 4e-3, -0.08 / 4e-3]), pytest.approx([0.08 / 8e-5, -2e-4 / 8e-5])]
    assert (model["B"], model["C"]) == (pytest.approx([1 / 4e-3, 0.0]), [0.0, 1.0])
    state, steps = np.zeros(2), 10_000  # Euler, whose error is of first order in the step
    for _ in range(steps):
        state = state + period_s / steps * (np.array(model["A"]) @ state + model["B"])
    assert model["G"] == pytest.approx(state.tolist(), rel=1e-4)
    rest = np.linalg.solve(np.array(model["A"]), -np.array(model["B"]))  # stays under a held input of 1
    assert np.array(model["F"]) @ rest + model["G"] == pytest.approx(rest)


@pytest.mark.parametrize(
    ("program", "lines", "has_matrices"),
    [
        ("dc-motor", ["i' = (u - R*i - k*omega) / L", "J = 8e-05 kg m^2"], True),
        ("front", ["velocity' = net_force / M", "K = 24500 N/m", "x = (displacement, velocity), u = force"], True),
        ("two-mass", ["K2"], True),
        ("shock", ["K = "], True),
        ("pendulum", ["'"], False),
        ("two-tanks", ["level1' = (inflow - flow1) / A1", "g = 98.1 dm/s^2"], False),
        ("van-der-pol", ["'"], False),
        ("duffing", ["'"], False),
        ("bump-stop", ["K = "], False),
        ("rc-battery", ["voltage = slope*charge", "capacity = 3600 A s"], False),  # its input reaches y at once
    ],
)
def test_sheet_states_the_model(program: str, lines: list[str], *, has_matrices: bool) -> None:
    model = output_of("patch", program).partition("Model, in units and seconds of the plant\n")[2].partition("\n\n")[0]
    assert [line for line in lines if line not in model] == []
    assert ("  F = { { " in model) == has_matrices


@pytest.mark.parametrize(
    ("program", "lines"),
    [
        (
            "front",
            [
                "5e-05 s of the machine, 0.01 s of the plant",
                "force: -1 V + code * 0.00292969 V",
                "1 V is 294 N; noise 1 LSB rms",
            ],
        ),
        ("dc-motor", ["5e-05 s of the machine, 0.0005 s of the plant", "u: -12.5 V + code * 0.00610352 V"]),
    ],
)
def test_sheet_states_the_sample_period_and_the_codes(program: str, lines: list[str]) -> None:
    told = output_of("patch", program)
    assert [line for line in lines if line not in told] == []
    assert "samples of the rig emulator-slow: 0.001 s of the machine" in output_of(
        "patch", program, "--rig", "emulator-slow"
    )
    assert "no rig is called 'no-such-rig'" in error_of("patch", program, "--rig", "no-such-rig")
