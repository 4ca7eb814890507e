"""The emulator against ngspice on the exported circuit, and the text of its decks."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from analogrig.cli import main
from analogrig.rigs.description import open_rig
from analogrig.scenario import Scenario
from analogrig_circuits import netlist
from analogrig_emulator import (
    FRONT,
    SHOCK,
    TICKS_PER_SAMPLE,
    Capacitor,
    Circuit,
    CircuitError,
    Components,
    CurrentSource,
    Deck,
    Edges,
    Engine,
    Excitation,
    OpAmp,
    OpAmpModel,
    PotTurn,
    Resistor,
    SuspensionComputer,
    piecewise_linear,
    to_spice,
)
from tests.bench import bench_engine
from tests.bench.bench_engine import (
    METHODS,
    SETTINGS,
    TOLERATED_LSB,
    Setting,
    Simulated,
    deck,
    exact_v,
    fastest,
    simulate,
)
from tests.emulator.plays import AMPLIFIERS, LSB_V, SAMPLE_RATE_HZ, THESIS_CHANGES, NgSpice, Volts
from tests.emulator.programs import program_of

LINEAR_PLAYS = pytest.mark.parametrize(
    ("program", "changes", "samples"),
    [
        ("front", THESIS_CHANGES, 800),
        ("shock", (), 200),
        pytest.param("front", (), 800, marks=pytest.mark.heavy),
        pytest.param("shock", (), 800, marks=pytest.mark.heavy),
    ],
)


def deck_of(
    computer: SuspensionComputer,
    excitation: Excitation,
    samples: int,
    changes: Sequence[PotTurn] = (),
) -> str:
    return to_spice(
        computer.circuit,
        samples=samples,
        edges={"F": excitation.edges(0, samples * TICKS_PER_SAMPLE, SAMPLE_RATE_HZ)},
        turns=[PotTurn(change.sample, computer.dials_for(**change.values)) for change in changes],
    )


def every_amplifier(computer: SuspensionComputer, excitation: Excitation, samples: int) -> Volts:
    engine = Engine(piecewise_linear(computer.circuit), AMPLIFIERS)
    return engine.run(samples, {"F": excitation.edges(*engine.window(samples), SAMPLE_RATE_HZ)})


@LINEAR_PLAYS
def test_displacement_and_velocity_agree_with_ngspice_at_every_sample(
    ngspice: NgSpice, program: str, changes: Sequence[PotTurn], samples: int
) -> None:
    computer = SuspensionComputer(program)
    reference = ngspice(deck_of(computer, Excitation(), samples, changes), ("u5", "u2"), samples)
    volts = np.concatenate(list(computer.play(Excitation(), samples, changes)))
    assert np.abs(volts[:, 1:3] - reference).max() < 0.05 * LSB_V


@LINEAR_PLAYS
def test_every_amplifier_agrees_with_ngspice_at_every_sample(
    ngspice: NgSpice, program: str, changes: Sequence[PotTurn], samples: int
) -> None:
    """The edges come between samples: at an edge's own instant ngspice still shows the level before it."""
    computer, excitation = SuspensionComputer(program), Excitation(clock="free", phase=0.637)
    reference = ngspice(deck_of(computer, excitation, samples, changes), AMPLIFIERS, samples)
    turns = [PotTurn(change.sample, computer.dials_for(**change.values)) for change in changes]
    volts = played_with_turns(computer.circuit, excitation, samples, turns)
    assert np.abs(volts - reference).max() < 0.05 * LSB_V


def test_a_generator_with_a_clock_of_its_own_agrees_with_ngspice_at_every_amplifier(ngspice: NgSpice) -> None:
    computer = SuspensionComputer("front", rng=np.random.default_rng(1), offset_v=3e-3)
    excitation = Excitation(clock="free", drift_ppm=200.0, phase=0.637, frequency_hz=317.0)
    reference = ngspice(deck_of(computer, excitation, 400), AMPLIFIERS, 400)
    assert np.abs(every_amplifier(computer, excitation, 400) - reference).max() < 0.05 * LSB_V


def test_slewing_and_clamping_amplifiers_agree_with_ngspice(ngspice: NgSpice) -> None:
    # 741s slew for 40 us at each edge of this drive, and twice the summer's gain drives U1 into its clamp.
    computer = SuspensionComputer("front", opamp="741", components=Components(given={"RFB": 1.0}))
    excitation = Excitation(low_v=-10.0, high_v=10.0, frequency_hz=400.0, clock="free", phase=0.237)
    reference = ngspice(deck_of(computer, excitation, 300), AMPLIFIERS, 300)
    volts = every_amplifier(computer, excitation, 300)
    assert np.abs(volts[:, 0]).max() > 13.3
    assert np.abs(volts - reference).max() < 0.05 * LSB_V


@pytest.mark.parametrize("seed", [*range(12), *(pytest.param(seed, marks=pytest.mark.heavy) for seed in range(12, 50))])
def test_random_machines_agree_with_ngspice_at_every_amplifier(ngspice: NgSpice, seed: int) -> None:
    """Parts, op-amps, pots turned, edges at any instant: all drawn from the seed in the test's name."""
    rng = np.random.default_rng(seed)
    computer = random_machine(rng)
    excitation = random_excitation(rng)
    samples = 70
    # Not right after sample 0: ngspice has no time point between the two.
    instants = np.sort(rng.choice(np.arange(1, samples - 10), 3, replace=False)).tolist()
    turns = [PotTurn(int(instant), {str(rng.choice(["M", "B", "K"])): rng.uniform(0.1, 1.0)}) for instant in instants]
    edges = excitation.edges(0, samples * TICKS_PER_SAMPLE, SAMPLE_RATE_HZ)
    deck = to_spice(computer.circuit, samples=samples, edges={"F": edges}, turns=turns)
    reference = ngspice(deck, AMPLIFIERS, samples)
    volts = played_with_turns(computer.circuit, excitation, samples, turns)
    assert np.abs(volts - reference).max() < 0.05 * LSB_V


def random_machine(rng: np.random.Generator) -> SuspensionComputer:
    program = (FRONT, SHOCK)[rng.integers(2)]
    given = {_element(field.name): rng.uniform(0.7, 1.4) - 1.0 for field in fields(program.parts)}
    model = OpAmpModel(
        avol=10 ** rng.uniform(4, 6),
        gbw_hz=10 ** rng.uniform(5.7, 7.3),
        slew_v_per_s=10 ** rng.uniform(5.5, 7.5),
        swing_v=(-rng.uniform(8, 14), rng.uniform(8, 14)),
        rout_ohm=rng.uniform(10, 300),
    )
    # Pots are set from the program's nominal parts, whatever these are.
    for pot in ("M", "B", "K"):
        del given[pot]
    return SuspensionComputer(program, opamp=model, components=Components(given=given), rng=rng, offset_v=5e-3)


def _element(part: str) -> str:
    """The element that has the value of a field of SuspensionParts: RFB for rfb_ohm, R4 for r4_in_ohm."""
    return "".join(word for word in part.split("_") if word not in ("pot", "in", "ohm", "farad")).upper()


def random_excitation(rng: np.random.Generator) -> Excitation:
    return Excitation(
        shape=str(rng.choice(["square", "prbs"])),
        low_v=rng.uniform(-10, 0),
        high_v=rng.uniform(0, 10),
        frequency_hz=rng.uniform(100, 900),
        clock="free",
        phase=rng.uniform(),
    )


def played_with_turns(circuit: Circuit, excitation: Excitation, samples: int, turns: Sequence[PotTurn]) -> Volts:
    engine = Engine(piecewise_linear(circuit), AMPLIFIERS)
    blocks = []
    for sample, dials, _ in [*turns, PotTurn(samples - 1, {})]:
        count = sample + 1 - engine.recorded
        blocks.append(engine.run(count, {"F": excitation.edges(*engine.window(count), SAMPLE_RATE_HZ)}))
        circuit = circuit.with_dials(dials)
        engine.set_system(piecewise_linear(circuit))
    return np.concatenate(blocks)


def test_ideal_amplifiers_can_be_exported(ngspice: NgSpice) -> None:
    computer = SuspensionComputer("shock", opamp="ideal")
    excitation = Excitation()
    reference = ngspice(deck_of(computer, excitation, 120), ("u5", "u2"), 120)
    volts = np.concatenate(list(computer.play(excitation, 120)))
    assert np.abs(volts[:, 1:3] - reference).max() < 0.05 * LSB_V


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"nodes": ["nowhere"]}, "no node is called 'nowhere'"),
        ({"edges": {"G": Excitation().edges(0, 1, SAMPLE_RATE_HZ)}}, "no input is called 'G'; there are F"),
        ({"turns": [PotTurn(3, {"Q": 0.5})]}, "no pot is called 'Q'; there are B, K, M"),
    ],
)
def test_what_the_circuit_does_not_have_is_refused_by_name(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(CircuitError, match=message):
        to_spice(SuspensionComputer().circuit, samples=10, **arguments)  # type: ignore[arg-type]


# ---- analogrig netlist: the deck that leaves the house is the machine that is played in it


SAMPLES = 150
SCENARIO = """
samples = 150
random_phase = true
[excitation]
clock = "free"
drift_ppm = 30.0
[[changes]]
sample = 60
stiffness_n_per_m = 18000.0
[[changes]]
sample = 100
mass_kg = 60.0
damping_n_s_per_m = 2500.0
"""


@pytest.fixture
def scenario(tmp_path: Path) -> str:
    (tmp_path / "short.toml").write_text(SCENARIO)
    return str(tmp_path / "short.toml")


def test_ngspice_runs_the_deck_of_a_scenario_and_agrees_at_every_sample(
    ngspice: NgSpice, scenario: str, tmp_path: Path
) -> None:
    what = ["--scenario", scenario, "--rig", "emulator", "--seed", "7"]
    assert main(["netlist", *what, "--out", str(tmp_path / "machine.cir")]) == 0
    assert main(["emulate", *what, "--out", str(tmp_path / "machine.npz")]) == 0
    reference = ngspice((tmp_path / "machine.cir").read_text(), ("in", "u5", "u2", "u1"), SAMPLES)
    volts = np.load(tmp_path / "machine.npz")["volts"]
    # The card reads the net force with its input turned round.
    assert np.abs(volts * (1, 1, 1, -1) - reference).max() < 0.05 * LSB_V


def test_engine_plays_the_deck_to_the_bit_as_the_rig_does(scenario: str, tmp_path: Path) -> None:
    assert main(["emulate", "--scenario", scenario, "--seed", "7", "--out", str(tmp_path / "machine.npz")]) == 0
    with open_rig("emulator") as rig:
        deck = netlist(rig, Scenario.load(scenario), 7)
    volts = np.load(tmp_path / "machine.npz")["volts"]
    assert np.array_equal(deck.volts(["in", "u5", "u2", "u1"]) * (1, 1, 1, -1), volts)


def test_json_names_the_file_or_holds_the_deck(
    scenario: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = str(tmp_path / "machine.cir")
    assert main(["netlist", "--scenario", scenario, "--json", "--out", out]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told.pop("identity")["command"].startswith("analogrig netlist --scenario")
    assert told == {"file": out, "samples": SAMPLES, "seed": 1995}
    assert main(["netlist", "--scenario", scenario, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["deck"] == Path(out).read_text()


def test_a_scenario_that_the_machine_cannot_show_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "light.toml").write_text("samples = 10\n[excitation]\n[plant]\nmass_kg = 3.0\n")
    assert main(["netlist", "--scenario", str(tmp_path / "light.toml")]) == 2
    assert "pot M: coefficient" in capsys.readouterr().err


# ---- circuits played by the engine and, as their deck, by ngspice


RATE_HZ = 20e3
TL07X = OpAmpModel(avol=2e5, gbw_hz=3e6, slew_v_per_s=13e6, swing_v=(-13.5, 13.5), rout_ohm=100.0)


def test_machine_with_offsets_turned_pots_and_initial_conditions_agrees_with_ngspice(ngspice: NgSpice) -> None:
    computer = SuspensionComputer("front", rng=np.random.default_rng(1), offset_v=3e-3)
    excitation = Excitation(clock="free", drift_ppm=200.0, phase=0.637, frequency_hz=317.0)
    changes = (PotTurn(60, {"K": 18000.0}), PotTurn(90, {"B": 2123.0, "K": 20000.0}))
    deck = Deck(
        computer.circuit,
        samples=120,
        edges={"F": excitation.edges(0, 120 * TICKS_PER_SAMPLE, RATE_HZ)},
        turns=[PotTurn(change.sample, computer.dials_for(**change.values)) for change in changes],
        initial_v={"C2": 1.5, "U3": -1.5, "U5": 1.5},
    )
    nodes = ("u1", "u2", "u3", "u4", "u5")
    assert np.abs(deck.volts(nodes) - ngspice(deck.text(), nodes, deck.samples)).max() < 0.05 * LSB_V


def test_current_sources_agree_with_ngspice(ngspice: NgSpice) -> None:
    circuit = Circuit(
        [
            CurrentSource("I1", "0", "a"),
            CurrentSource("I2", "b", "a", 0.1e-3),
            Resistor("R1", "a", "0", 2e3),
            Resistor("R2", "a", "b", 1e3),
            Capacitor("C1", "b", "0", 100e-9),
            OpAmp("U1", "0", "m", "out", TL07X),
            Resistor("R3", "b", "m", 10e3),
            Resistor("R4", "m", "out", 10e3),
        ]
    )
    ticks = np.rint(np.array([0.0, 20.26, 40.48]) * TICKS_PER_SAMPLE).astype(np.int64)
    edges = {"I1": Edges(ticks, np.array([0.0, 2e-3, 0.0]))}
    deck = Deck(circuit, samples=101, edges=edges, initial_v={"C1": 0.5})
    nodes = ("a", "b", "out")
    assert np.abs(deck.volts(nodes) - ngspice(deck.text(nodes), nodes, deck.samples)).max() < 0.05 * LSB_V


def test_current_comes_out_of_a_sources_second_node() -> None:
    """1 mA into 2 kOhm and 1 nF: 2 V (1 - exp(-t / 2 us)), at rest by the first sample."""
    circuit = Circuit(
        [CurrentSource("I", "0", "a", 1e-3), Resistor("R", "a", "0", 2e3), Capacitor("C", "a", "0", 1e-9)]
    )
    assert Deck(circuit, samples=5).volts(["a"])[1:, 0] == pytest.approx(2.0, abs=1e-9)


# ---- the suspension with a bump stop, against its equation


TIME_SCALE = 200.0
PROGRAM = program_of("bump-stop")
STOP_M, STOP_N_PER_M = PROGRAM.values["x_stop"], PROGRAM.values["K_stop"]


def played(opamp: str, samples: int) -> NDArray[np.float64]:
    """Channels in V under a step of the force."""
    return np.concatenate(list(SuspensionComputer(PROGRAM, opamp=opamp).play(Excitation(frequency_hz=1.0), samples)))


def by_equation(force_n: float, samples: int) -> NDArray[np.float64]:
    """X in m and x' in m/s at the samples after a step of the force, from rest."""

    def slope(_: float, state: NDArray[np.float64]) -> list[float]:
        x, v = state
        spring_n = 24500.0 * x + STOP_N_PER_M * max(0.0, x - STOP_M)
        return [v, (force_n - 3021.0 * v - spring_n) / 115.0]

    instants_s = np.arange(samples) * TIME_SCALE / RATE_HZ
    solved = solve_ivp(
        slope, (0.0, instants_s[-1]), [0.0, 0.0], "DOP853", instants_s, rtol=1e-11, atol=1e-13, max_step=1e-3
    )
    states: NDArray[np.float64] = solved.y.T
    return states


def test_with_ideal_amplifiers_it_solves_its_equation() -> None:
    volts = played("ideal", 60)[:, 1:3]
    expected = by_equation(2940.0, 60) * [PROGRAM.scales.volts("displacement"), PROGRAM.scales.volts("velocity")]
    assert np.abs(volts - expected).max() < 0.05 * LSB_V
    assert expected[:, 0].max() > STOP_M * PROGRAM.scales.volts("displacement")


def test_at_rest_on_the_stop_both_springs_carry_the_force() -> None:
    expected_m = (2940.0 + STOP_N_PER_M * STOP_M) / (24500.0 + STOP_N_PER_M)
    found_m = played("tl07x", 100)[-1, 1] / PROGRAM.scales.volts("displacement")
    np.testing.assert_allclose(found_m, expected_m, rtol=2e-4)


# ---- the decks by which `make bench ARGS=engine` measures ngspice differ as the benchmark says


DECK_N = 800
GENERAL = Setting("trap", "lean", "start", 1e-3, 1.0, 8e-6)


def test_settings_reach_the_deck() -> None:
    texts = {setting: deck(setting, 5, ()) for setting in SETTINGS}
    assert len(set(texts.values())) == len(SETTINGS)
    for setting, text in texts.items():
        given = re.findall(r"(method|reltol|trtol)=(\S+)", text)
        # The last of two would count.
        assert sorted(given) == [
            ("method", setting.method),
            ("reltol", f"{setting.reltol:g}"),
            ("trtol", f"{setting.trtol:g}"),
        ]
        assert re.findall(r"^X\S* clock \S+ period=(\S+)$", text, re.MULTILINE) == [
            "5e-05" if setting.points == "every sample" else "1"
        ]
        assert ("Einner" in text) == (setting.op_amps == "exported")
    assert " klu" in deck(replace(GENERAL, solver="klu"), 5, ())


def test_knowing_deck_limits_the_summer_alone() -> None:
    text = deck(replace(GENERAL, op_amps="knowing"), 5, ())
    assert re.findall(r"^X_(U\d) .* (opamp|linear) ", text, re.MULTILINE) == [
        ("U1", "opamp"),
        *((f"U{i}", "linear") for i in range(2, 6)),
    ]


def test_deck_that_is_written_otherwise_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        bench_engine, "to_spice", lambda *args, **kinds: to_spice(*args, **kinds).replace("Xclock", "Vtimepoints")
    )
    with pytest.raises(ValueError, match="0 matches"):
        deck(GENERAL, 5, ())


def test_fastest_setting_is_one_that_is_accurate() -> None:
    settings = SETTINGS[:3]
    runs = [Simulated(1.0, 2 * TOLERATED_LSB), Simulated(3.0, 0.0), Simulated(2.0, TOLERATED_LSB)]
    assert fastest(dict(zip(settings, runs, strict=True))) == [settings[2], settings[1]]


@pytest.mark.tools("ngspice")
def test_ngspice_integrates_by_the_method_of_the_setting() -> None:
    exact = exact_v(DECK_N, ())
    errors_lsb = [simulate(deck(replace(GENERAL, method=method), DECK_N, ()), exact).error_lsb for method in METHODS]
    assert len(set(errors_lsb)) == len(METHODS)


@pytest.mark.tools("ngspice")
@pytest.mark.parametrize(
    "setting",
    [
        replace(GENERAL, op_amps="exported"),
        GENERAL,
        replace(GENERAL, op_amps="knowing"),
        replace(GENERAL, op_amps="knowing", pots="altered", reltol=1e-5),
    ],
    ids=str,
)
def test_decks_without_time_points_on_the_samples_compute_the_same_signals(setting: Setting) -> None:
    run = simulate(deck(setting, DECK_N, THESIS_CHANGES), exact_v(DECK_N, THESIS_CHANGES))
    assert run.error_lsb <= TOLERATED_LSB
    assert run.spent_s > 0.0
