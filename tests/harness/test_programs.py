"""Programs beyond one mass, damper and spring, and changes that last: from scenario to verdict, deck and signals."""

from __future__ import annotations

import dataclasses
import json
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

from analogrig import cli, config
from analogrig.bench import Bench
from analogrig.datasheet import ModelOrders
from analogrig.devices.registry import open_dut
from analogrig.errors import ConfigurationError
from analogrig.judging import information
from analogrig.judging.verdict import BOUNDS, ESTIMATES, as_json, judge
from analogrig.plant import SampledPlant, Segment, estimated_parameters
from analogrig.program import Program
from analogrig.rigs.description import open_rig
from analogrig.rigs.emulator import EmulatorRig
from analogrig.rigs.recording import RecordingRig
from analogrig.run import Run
from analogrig.scenario import DEFAULT_SEED, PotChange, Scenario
from analogrig_circuits import netlist
from analogrig_emulator import SuspensionComputer
from tests.harness.runs import made_run

from .plants import front

FRONT, SOFT = front(115.0, 3021.0, 24500.0), front(115.0, 3021.0, 18000.0)
SQUARE_N = np.where(np.arange(900) % 100 < 50, 2900.0, 30.0)

CHANGE_AT = 700
"""Beginning of the ramp: after the warm-up of the device."""

RAMPED = f"""
samples = 1100
[excitation]
low_v = 0.1
high_v = 9.9
[[changes]]
sample = {CHANGE_AT}
stiffness_n_per_m = 18000.0
ramp_n = 60
"""


@pytest.fixture(scope="module")
def ramped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("ramped") / "ramped.toml"
    path.write_text(RAMPED)
    return path


def played(scenario: Scenario) -> Run:
    with open_rig("emulator") as rig, open_dut("host") as dut:
        return Bench(rig, dut).play(scenario, 1)


# ---- programs


@pytest.mark.parametrize("program", ["front", "dc-motor", "duffing"])
def test_any_program_is_played_and_judged(program: str) -> None:
    """Linear or not, the one change of ``of_program`` has a bound and is seen, though the device's model is linear."""
    scenario = Scenario.of_program(Program.load(program))
    run = played(scenario)
    verdict = judge(run)
    assert run.samples == scenario.samples
    assert (verdict.outcome, verdict.reasons) == ("passed", ())
    (change,) = verdict.changes
    assert change.latency_n is not None and change.deadline_n is not None and change.latency_n <= change.deadline_n
    assert change.before == {name: scenario.program.parameters[name].value for name in change.after}
    assert change.is_bounded and change.bound_n is not None
    assert BOUNDS not in verdict.not_judged
    assert scenario.program.is_linear == (program != "duffing")
    assert (ESTIMATES in verdict.not_judged) == (program != "front")


@pytest.mark.parametrize(
    ("flow", "linear", "outcome"),
    [
        ("q - l*p", True, "passed"),
        ("max(q - 2e-3, 0) - l*p", False, "passed"),
        ("q - l*p - n*p**2", False, "failed"),
    ],
)
def test_program_is_linear_by_its_elements_whatever_its_scales(flow: str, linear: bool, outcome: str) -> None:  # noqa: FBT001
    """A vessel in Pa and m^3/s: between some Pa all three are straight, and between two levels of q the second is."""
    parameters = {"l": {"value": 2e-8, "range": [1e-8, 4e-8]}, "V": {"value": 1e-8, "range": [8e-9, 2e-8]}}
    tables = {
        "name": "vessel",
        "speed": 100.0,
        "channels": ["q", "p"],
        "equations": f"p' = ({flow}) / V",
        "inputs": {"q": {"full": 0.01, "trial": [0.0, 0.005]}},
        "states": {"p": {}},
        "parameters": parameters | ({"n": {"value": 2e-12}} if "n*" in flow else {}),
    }
    program = Program.of(tables, "here")
    assert program.is_linear == linear
    assert judge(played(Scenario.of_program(program))).outcome == outcome


def powers(equations: str) -> Program:
    """Program with the parameters w, d and s."""
    full = "{ full = 12.0 }"
    return Program.from_table(
        tomllib.loads(f"""
name = "powers"
speed = 100
channels = ["u", "x"]
equations = '''{equations}'''
inputs = {{ u = {{ full = 1.0 }} }}
states = {{ {", ".join(f"{line[0]} = {full}" for line in equations.splitlines())} }}
[parameters]
w = {{ value = 2.0, range = [1.0, 3.0] }}
d = {{ value = 1.0, range = [0.5, 2.0] }}
s = {{ value = 1.0, range = [0.9, 1.1] }}
"""),
        "powers",
    )


@pytest.mark.parametrize(
    "equations",
    ["x' = w**2*u*s - d*x*s\nv' = d*x - v", "x' = s*u - x/w\nv' = w*x - d*v", "x' = u*sqrt(w) - d*x*s\nv' = d*x - v"],
)
def test_pots_show_the_values_that_turned_them(equations: str) -> None:
    """Squares, a parameter on two pots, and products of parameters on one."""
    program = powers(equations)
    computer = SuspensionComputer(program.circuit)
    values = {"w": 2.5, "d": 0.8, "s": 0.95}
    computer.set(**values)
    assert program.values_at(computer.coefficients) == pytest.approx(values, rel=1e-9)


@pytest.mark.parametrize(
    ("equations", "message"),
    [
        ("x' = w*d*s*u - x", "powers: its pots show only products of the parameters d, s, w: write one"),
        ("x' = (w + 1)*u*s - d*x", "powers: the coefficient of pot P1 is no power of w, whose value it cannot show"),
        ("x' = (5 - w)*u*s - d*x", "powers: the coefficient of pot P1 is no power of w"),
    ],
)
def test_pots_that_do_not_determine_the_parameters_are_refused(equations: str, message: str) -> None:
    program = powers(equations)
    with pytest.raises(ConfigurationError, match=re.escape(message)):
        program.values_at(SuspensionComputer(program.circuit).coefficients)


@pytest.mark.parametrize("name", sorted({*config.names("programs")} - {"silverbox"}))  # measured data stand for it
def test_example_scenario_of_every_program_is_judged(name: str) -> None:
    scenario = Scenario.load({"front": "thesis"}.get(name, name))
    assert scenario.program == Program.load(name)
    with open_rig(scenario.rig or "emulator") as rig, open_dut("inproc") as dut:
        verdict = judge(Bench(rig, dut).play(scenario, scenario.seed or DEFAULT_SEED))
    assert verdict.outcome == "passed", verdict.reasons
    assert verdict.changes and all(change.result == "detected" for change in verdict.changes)


def test_scenario_names_a_program_beside_it_and_its_run_holds_it(tmp_path: Path) -> None:
    """The recording is judged and played again without the file."""
    file, scenario = tmp_path / "motor.toml", tmp_path / "heavy.toml"
    file.write_text(config.locate("programs", "dc-motor").read_text().replace("8e-5", "9e-5"))
    text = config.locate("scenarios", "dc-motor").read_text()
    scenario.write_text(text.replace('"dc-motor"', '"motor.toml"'))
    run = played(Scenario.load(str(scenario)))
    file.unlink()
    run.save(tmp_path / "run.npz")
    loaded = Run.load(tmp_path / "run.npz")
    assert loaded.conditions.program.parameters["J"].value == 9e-5
    assert judge(loaded) == judge(run)
    with open_rig(f"recording:{tmp_path / 'run.npz'}") as rig:
        again, seed = rig.recorded or (Scenario.load("thesis"), 0)
        assert Scenario.from_table(again.as_table(), "again") == again
        assert np.array_equal(np.concatenate([block.codes for block in rig.perform(again, seed).blocks]), run.codes)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('program = "mottor"', "no program is called 'mottor'"),
        ('program = "absent.toml"', "absent.toml: no such file"),
        ("program = 3", "program: must be a name, a .toml file, or a table, not 3"),
        ("[program]\nname = 3", "program: "),
        ("set = { L = 1.0 }", "program front: unknown parameter 'L' (known: M, B, K)"),
        (
            "[[changes]]\nsample = 5\nset = { stifness = 1.0 }",
            "changes[0]: program front: unknown parameter 'stifness'",
        ),
        ("[[changes]]\nsample = 5\nstifness_n_per_m = 1.0", "changes[0]: unknown key 'stifness_n_per_m'"),
        ('program = "front"\n[plant]\nset = "front"', "plant: write program = ... and set = { ... } instead"),
        ('program = "friction.toml"', "M.diagnosis: no device names 'friction'; there are mass, damping, stiffness"),
        ('program = "sample.toml"', "parameters.M.alias: sample is a key of scenarios' changes; choose another"),
        ('[plant]\nset = "rear"', "no program is called 'rear'"),
    ],
)
def test_wrong_program_or_parameter_is_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "mine.toml"
    front = config.locate("programs", "front").read_text()
    (tmp_path / "friction.toml").write_text(front.replace('diagnosis = "mass"', 'diagnosis = "friction"'))
    (tmp_path / "sample.toml").write_text(front.replace('alias = "mass_kg"', 'alias = "sample"'))
    path.write_text(f"samples = 100\n{text}\n[excitation]\n")
    with pytest.raises(ConfigurationError) as caught:
        Scenario.load(str(path))
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_scenario_with_the_keys_of_earlier_versions_is_the_same() -> None:
    old = """
    samples = 300
    [excitation]
    [plant]
    set = "shock"
    mass_kg = 1.8
    [[changes]]
    sample = 200
    damping_n_s_per_m = 950.0
    """
    new = """
    samples = 300
    program = "shock"
    set = { M = 1.8 }
    [excitation]
    [[changes]]
    sample = 200
    set = { B = 950.0 }
    """
    one, other = (Scenario.from_table(tomllib.loads(text), "file") for text in (old, new))
    assert one == other


def test_estimates_of_any_order_follow_from_the_formulas_of_the_file() -> None:
    """Three poles, and the gain of the first RC element: numpy makes the model, the formulas give the values back."""
    table = tomllib.loads(config.locate("programs", "rc-battery").read_text())
    table |= {"channels": ["current", "fast"], "estimates": {"R1": "gain", "C2": "C1", "C1": "1 / (s2*R1)"}}
    with pytest.raises(ConfigurationError, match="battery: estimates.C2: unknown name 'C1'"):
        Program.from_table(table, "battery")
    del table["estimates"]["C2"]
    program, poles = Program.from_table(table, "battery"), np.array([-0.2, -0.05, -0.001])
    a = np.poly(np.exp(poles))
    theta = np.array([[*a[1:], 0.006 * a.sum(), 0.0], [np.nan] * 5])
    found = estimated_parameters(program, theta, ModelOrders(3, 1), 1.0, 1.0, 1.0)
    assert program.estimates == ("R1", "C1")
    assert found[0] == pytest.approx([0.006, 1.0 / (0.251 * 0.006)])
    assert np.isnan(found[1]).all()
    assert np.isnan(estimated_parameters(program, theta, ModelOrders(2, 2), 1.0, 1.0, 1.0)).all()


def test_two_masses_sit_where_their_springs_in_series_say() -> None:
    """2910.6 N on 24500 N/m and 180 kN/m in series."""
    scenario = Scenario.load("healthy")
    still = dataclasses.replace(scenario.excitation, frequency_hz=10.0)
    scenario = dataclasses.replace(
        scenario, samples=400, excitation=still, random_phase=False, program=Program.load("two-mass")
    )
    with open_rig("emulator") as rig:
        performance = rig.perform(scenario, 3)
        codes = np.concatenate([block.codes for block in performance.blocks])[-50:, 1]
    assert performance.channels["displacement"].physical(codes).mean() == pytest.approx(
        2910.6 / 24500.0 + 2910.6 / 180e3, rel=1e-2
    )


@pytest.mark.parametrize("program", config.names("programs"))
def test_every_program_can_be_written_as_a_deck_and_as_signals(
    program: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    common = ["--program", program, *(["--scenario", "slow"] if program == "bump-stop" else [])]
    assert cli.main(["netlist", *common, "--out", str(tmp_path / "deck.cir")]) == 0
    amplifiers = Program.load(program).circuit.amplifiers
    deck = (tmp_path / "deck.cir").read_text().lower()
    assert f"u{amplifiers}" in deck
    assert f"u{amplifiers + 1}" not in deck
    capsys.readouterr()
    assert cli.main(["emulate", *common, "--out", str(tmp_path / "signals.npz"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["overloads"] == {}


def test_program_that_is_none_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["emulate", "--program", "rear"]) == 2
    assert "no program is called 'rear': there are bump-stop, dc-motor" in capsys.readouterr().err


# ---- ramps


def test_latency_of_a_ramp_counts_from_its_start(ramped: Path) -> None:
    verdict = judge(played(Scenario.load(str(ramped))))
    (change,) = verdict.changes
    assert verdict.outcome == "passed"
    assert change.sample == CHANGE_AT
    assert change.bound_n is not None
    assert change.latency_n is not None
    assert 0.5 * change.bound_n < change.latency_n < 60
    jump = dataclasses.replace(Scenario.load(str(ramped)), changes=(PotChange(CHANGE_AT, {"K": 18000.0}),))
    assert as_json(judge(played(jump)))["changes"][0]["bound"] < change.bound_n


@pytest.mark.parametrize("seed", range(1, 5))
def test_latencies_of_ramps_are_near_their_bounds(seed: int) -> None:
    """The trigger comes near the bound for jumps; if it does for ramps, too, their bound is right."""
    with open_rig("emulator") as rig, open_dut("host") as dut:
        verdict = judge(Bench(rig, dut).play(Scenario.load("slow"), seed))
    assert verdict.outcome == "passed"
    for change in verdict.changes:
        assert change.bound_n is not None
        assert change.latency_n is not None
        assert change.bound_n <= change.latency_n < 2 * change.bound_n


def test_alarms_while_a_change_lasts_and_the_first_after_it_are_not_false() -> None:
    run = with_ramp(60)
    alarmed = dataclasses.replace(
        run,
        alarm_index=np.array([100, 420, 450, 500, 600], np.int64),
        alarm_kind=np.full(5, 3, np.uint8),
        alarm_statistic=np.full(5, 12.0, np.float32),
    )
    verdict = judge(alarmed)
    assert verdict.changes[0].latency_n == 10
    assert verdict.false_alarms == (100, 600)


def test_ramp_is_in_the_recording(ramped: Path, tmp_path: Path) -> None:
    run = played(Scenario.load(str(ramped)))
    run.save(tmp_path / "run.npz")
    assert Run.load(tmp_path / "run.npz").conditions.segments[1] == Segment(CHANGE_AT, SOFT, 60)
    assert RecordingRig.open(tmp_path / "run.npz").scenario().changes[0].ramp_n == 60
    assert judge(Run.load(tmp_path / "run.npz")) == judge(run)


def with_ramp(ramp_n: int) -> Run:
    run = made_run(SQUARE_N, [(0, FRONT), (410, SOFT)])
    segments = (Segment(0, FRONT), Segment(410, SOFT, ramp_n))
    return dataclasses.replace(run, conditions=dataclasses.replace(run.conditions, segments=segments))


def test_information_on_a_ramp_is_that_of_a_plant_that_changes_a_little_every_sample() -> None:
    """Against a staircase of jumps of a sixtieth each, whose plants this test makes by itself."""
    (ramped_information,) = information.change_information(with_ramp(60))
    period_s = 5e-5 * 200.0
    force_n = np.round(SQUARE_N / (2940.0 / 4096)) * (2940.0 / 4096)
    before = SampledPlant.from_plant(FRONT, period_s)
    unchanged = before.at_rest
    for force in force_n[:410]:
        unchanged = before.next(unchanged, force)
    changed, total = unchanged, 0.0
    for k, force in enumerate(force_n[410:480]):
        stiffness = 24500.0 - 6500.0 * min((k + 0.5) / 60, 1.0)
        now = SampledPlant.from_plant(front(115.0, 3021.0, stiffness), period_s)
        unchanged, changed = before.next(unchanged, force), now.next(changed, force)
        total += ((changed[0] - unchanged[0]) / (0.1996 / 4096)) ** 2 / (2 * (1 + 1 / 12))
        assert ramped_information[k] == pytest.approx(total, rel=1e-9)


def test_information_of_a_jump_is_that_of_a_ramp_of_no_length() -> None:
    (jump,) = information.change_information(made_run(SQUARE_N, [(0, FRONT), (410, SOFT)]))
    (ramp,) = information.change_information(with_ramp(0))
    assert np.array_equal(jump, ramp)
    longer = information.change_information(with_ramp(2000))[0]
    assert len(longer) == len(jump)
    assert (longer <= jump).all()


@pytest.mark.parametrize(("given", "limit_lsb"), [({"K": 18000.0}, 10.0), ({"M": 40.0}, 3.0)], ids=str)
def test_plant_of_the_truth_follows_the_emulated_machine_through_a_ramp(
    ramped: Path, given: dict[str, float], limit_lsb: float
) -> None:
    """1/M, B and K change evenly in the harness, dials in the machine, which the load of the pots tells apart."""
    scenario = dataclasses.replace(Scenario.load(str(ramped)), changes=(PotChange(CHANGE_AT, given, 60),))
    after = FRONT.changed(given)
    with open_rig("emulator-ideal") as rig:
        volts = np.concatenate([block.volts for block in rig.perform(scenario, 1).blocks])
    state, plants = SampledPlant.from_plant(FRONT, 0.01).at_rest, [FRONT] * CHANGE_AT
    plants += [FRONT.interpolate(after, (k + 0.5) / 60) for k in range(60)] + [after] * 340
    seen = []
    for plant, force_v in zip(plants, volts[:, 0], strict=True):
        seen.append(state[0] / 0.01996)
        state = SampledPlant.from_plant(plant, 0.01).next(state, force_v * 294.0)
    error_lsb = np.abs(np.array(seen) - volts[:, 1]) / (10.0 / 4096)
    assert error_lsb[:CHANGE_AT].max() < 0.01
    assert error_lsb[CHANGE_AT:].max() < limit_lsb


def test_deck_of_a_ramp_plays_what_the_rig_plays(ramped: Path) -> None:
    """A step of the dial a sample: at most 2 LSB beside the engine's finer pieces."""
    scenario = Scenario.load(str(ramped))
    with open_rig("emulator-ideal") as rig:
        assert isinstance(rig, EmulatorRig)
        deck = netlist(rig, scenario, 1)
        volts = np.concatenate([block.volts for block in rig.perform(scenario, 1).blocks])
    assert np.abs(deck.volts(["u5"])[:, 0] - volts[:, 1]).max() < 2.0 * 10.0 / 4096
    assert deck.turns[-1][0] == CHANGE_AT + 60


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            (PotChange(300, {"M": 60.0}, ramp_n=60), PotChange(350, {"M": 70.0})),
            "at sample 300 lasts 60 samples, beyond",
        ),
        ((PotChange(1099, {"M": 60.0}), PotChange(1100, {"M": 70.0})), "beyond the last of 1100 samples"),
    ],
)
def test_ramps_that_cannot_be_are_refused(ramped: Path, changes: tuple[PotChange, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(Scenario.load(str(ramped)), changes=changes)


def test_ramp_of_no_whole_number_is_refused_naming_the_key(tmp_path: Path) -> None:
    (tmp_path / "wrong.toml").write_text(RAMPED.replace("ramp_n = 60", "ramp_n = -1"))
    with pytest.raises(ConfigurationError, match=r"wrong.toml: changes\[0\]: ramp_n must be in 0 .. 100000, not -1"):
        Scenario.load(str(tmp_path / "wrong.toml"))


def test_wiper_noise_is_off_until_the_rig_asks_for_it(ramped: Path, tmp_path: Path) -> None:
    text = Path("fixtures/rigs/emulator-ideal.toml").read_text()
    (tmp_path / "noisy.toml").write_text(text.replace("[card]", "wiper_noise_ohm = 100.0\n\n[card]", 1))
    codes = {}
    for name in ("emulator-ideal", str(tmp_path / "noisy.toml")):
        with open_rig(name) as rig:
            codes[name] = np.concatenate([b.codes for b in rig.perform(Scenario.load(str(ramped)), 1).blocks])
    silent, noisy = codes.values()
    moved = np.abs(silent.astype(int) - noisy.astype(int)).max(axis=1)
    assert moved[: CHANGE_AT + 1].max() == 0
    assert moved[CHANGE_AT + 1 : CHANGE_AT + 60].max() > 0
