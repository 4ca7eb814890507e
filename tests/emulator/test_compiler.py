"""The compiler: patches solve the equations of their files."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from analogrig_emulator import (
    COMPONENTS,
    MULTIPLIERS,
    PROGRAMS,
    TICKS_PER_SAMPLE,
    Deck,
    Engine,
    Excitation,
    Mode,
    OpAmp,
    PotError,
    PotTurn,
    SuspensionComputer,
)
from analogrig_emulator.circuit.nodal import piecewise_linear
from analogrig_emulator.exceptions import ProgramError
from analogrig_emulator.machine.compiler import INPUT_OHM
from analogrig_emulator.machine.patched_program import MACHINE_V, PatchedProgram
from analogrig_emulator.machine.program_loader import compile_program, parse_program
from analogrig_emulator.machine.sheet import dials
from analogrig_emulator.machine.stages import StageKind, stages_of
from analogrig_emulator.machine.trial import reaches, settings
from tests.emulator.ideal_patch import IdealPatch
from tests.emulator.plays import LSB_V, NgSpice, Volts
from tests.emulator.programs import FILES, program_of
from tests.emulator.random_programs import REFUSED, random_program
from tests.emulator.test_tried_advice import advised

RATE_HZ = 20e3
SAMPLES = 300
SEEDS = [seed for seed in range(7) if seed not in REFUSED]
"""Seeds of the random programs: one of each family."""


# ---- any program, at one instant


@pytest.mark.parametrize("name", FILES)
def test_netlist_has_the_slopes_of_the_equations(name: str) -> None:
    assert_slopes(program_of(name), np.random.default_rng(1))


@pytest.mark.parametrize("seed", [*SEEDS[:3], *(pytest.param(seed, marks=pytest.mark.heavy) for seed in SEEDS[3:])])
def test_random_programs_have_the_slopes_of_their_equations(seed: int) -> None:
    assert_slopes(compiled_random(seed), np.random.default_rng(seed))


def compiled_random(seed: int) -> PatchedProgram:
    """Random program of a seed, with all advice followed."""
    return advised(random_program(seed))[1]


def assert_slopes(program: PatchedProgram, rng: np.random.Generator) -> None:
    """Slopes at a random place of the trial play's range, for two settings of it, against the file's equations."""
    equations, full = program.equations, program.fulls
    nodes = {each.stage.name: (each.node, each.sign) for each in program.patch}
    rates = {each.node: MACHINE_V / (INPUT_OHM * each.farad) for each in program.patch if each.farad}
    slopes = equations.slopes()
    every = list(settings(equations))
    for values in (every[0], every[int(rng.integers(len(every)))]):
        patch = IdealPatch(program.elements, dials(program, values))
        quantities = {
            name: np.float64(rng.uniform(0.1 * reach.low + 0.9 * middle, 0.9 * middle + 0.1 * reach.high))
            for name, reach in program.reach.items()
            if name in equations.states or name in equations.inputs
            for middle in [0.5 * (reach.low + reach.high)]
        }
        states = np.array([quantities[name] for name in equations.states])
        inputs = {name: float(quantities[name]) for name in equations.inputs}
        expected = slopes({**values, **inputs}, states) * equations.speed
        program.stages.add_signals(quantities, values)
        volts = {node: sign * float(quantities[name]) * MACHINE_V / full[name] for name, (node, sign) in nodes.items()}
        known = {nodes[name][0]: volts[nodes[name][0]] for name in equations.states}
        known |= {node: inputs[name] * MACHINE_V / full[name] for name, node in program.input_nodes.items()}
        outputs = outputs_of(program)
        guess = {node: volts.get(node, 0.0) + 1e-3 for node in outputs if node not in known}
        found = patch.slopes(known, guess)
        for name, slope in zip(equations.states, expected, strict=True):
            node, sign = nodes[name]
            scale = MACHINE_V / full[name]
            assert sign * found[node] == pytest.approx(slope * scale, rel=1e-6, abs=1e-6 * rates[node]), (name, values)


def outputs_of(program: PatchedProgram) -> list[str]:
    return [each.out for each in program.elements if hasattr(each, "out")]


# ---- programs, played


@pytest.mark.parametrize("name", FILES)
def test_ideal_parts_play_the_equations(name: str) -> None:
    program = program_of(name)
    assert off_equations_lsb(program, changes_of(program)) < 0.05


def off_equations_lsb(
    program: PatchedProgram, changes: Sequence[PotTurn] = (), sample_rate_hz: float = RATE_HZ, rtol: float = 1e-9
) -> float:
    """Largest difference of ideal parts from the equations, as scipy solves them to rtol, at any channel, in LSB."""
    low_v, high_v = levels_v(program)
    excitation = Excitation(low_v=low_v, high_v=high_v, frequency_hz=sample_rate_hz / 100.0)
    computer = SuspensionComputer(program, opamp="ideal", sample_rate_hz=sample_rate_hz)
    volts = np.concatenate(list(computer.play(excitation, SAMPLES, changes)))
    return float(np.abs(volts - by_scipy(program, excitation, changes, sample_rate_hz, rtol)).max() / LSB_V)


DIVIDING = {
    "a divisor near zero": """x' = -1.5*x + u
y' = -y + 0.1*x/(0.02 + x**2)
z' = -z + 0.1*y/(0.03 + abs(x))""",
    "a tank that empties": """x' = 0.5*max(0, u) - 0.8*sqrt(max(0, x))
y' = 0.8*sqrt(max(0, x)) - 0.7*sqrt(max(0, y))
z' = -z + x""",
    "roots of both signs": """x' = y
y' = -4*x - 0.3*y*abs(y) + u
z' = -z + sqrt(max(0, x)) - sqrt(max(0, -x)) + 0.2*y/(0.05 + abs(x))""",
    "a root of the input": """w = sqrt(0.004 + (u - x)**2)
x' = 0.5*(u - x) / (0.05 + w)
y' = -y + sqrt(abs(x)) + 0.3*sqrt(max(0, u))
z' = -z + y/(0.05 + x*x)""",
    "a divisor with a root": """x' = -2*x + u/(0.1 + sqrt(abs(y)))
y' = -y + x/(0.2 + abs(x))
z' = -z + 0.05*y*y/(0.03 + sqrt(0.01 + x*x))""",
    "a divisor that is a root": """r = sqrt(0.02 + x*x + y*y)
x' = -x + u - 0.3*y/r
y' = -y + 0.5*x/r
z' = -z - 0.5*sqrt(0.05 + x*x)/sqrt(0.3 + abs(y))""",
}


DEAR = ("a root of the input", "a divisor with a root", "a fast quotient")
"""Programs of a kind that others show too, and that take seconds to compile or to solve."""


def sampled(names: Iterable[str]) -> list[Any]:
    """Parameters with these names; the dear ones are heavy."""
    return [pytest.param(name, marks=pytest.mark.heavy) if name in DEAR else name for name in names]


def compiled(equations: str) -> PatchedProgram:
    states = "".join(f"{state} = {{}}\n" for state in "xyz")
    return compile_program(
        parse_program(
            f"name = 'dividing'\nspeed = 500\nperiod_s = 20.0\nequations = '''\n{equations}\n'''\n"
            f"[inputs]\nu = {{ full = 1.0, trial = [-1.0, 1.0] }}\n[states]\n{states}",
            "dividing",
        )
    )


BROADBAND = Excitation(shape="recorded", samples_v=tuple(np.random.default_rng(1).uniform(-9.0, 9.0, 300).tolist()))
SWEEP = Excitation(shape="sweep", low_v=-10.0, frequency_hz=20.0, end_hz=1500.0, sweep_s=SAMPLES / RATE_HZ)
MOVED = {
    "a divisor near zero": (DIVIDING["a divisor near zero"], Excitation(low_v=-10.0, shape="sine")),
    "roots in a row": (
        "x' = 0.3 + 0.25*u - 0.4*sqrt(x)\ny' = 0.4*sqrt(x) - 0.4*sqrt(y)\nz' = 0.4*sqrt(y) - 0.6*z",
        SWEEP,
    ),
    "a fast square": ("x' = -x + u\ny' = 150*(x**2 - y)\nz' = -z + y*x", BROADBAND),
    "a fast quotient": ("x' = -x + u\ny' = 100*(x/(0.2 + x**2) - y)\nz' = -z + y*x", SWEEP),
}


@pytest.mark.parametrize("name", sampled(MOVED))
def test_ideal_parts_play_the_equations_under_an_input_that_moves_all_the_time(name: str) -> None:
    equations, excitation = MOVED[name]
    program = compiled(equations)
    computer = SuspensionComputer(program, opamp="ideal")
    volts = np.concatenate(list(computer.play(excitation, SAMPLES)))
    drive, slopes = excitation.drive(0, SAMPLES * TICKS_PER_SAMPLE, RATE_HZ), program.equations.slopes()

    def flow(sample: float, state: Volts) -> Volts:
        level = float(drive.volts(np.array([sample]))[0]) / MACHINE_V
        return slopes({"u": level}, state) * program.equations.speed / RATE_HZ

    # Neighbouring samples meet with a bend, where steps must end.
    state, rows = np.zeros(3), [np.zeros(3)]
    for sample in range(SAMPLES - 1):
        state = solve_ivp(flow, (sample, sample + 1), state, "DOP853", rtol=1e-9, atol=1e-11).y[:, -1]
        rows.append(state)
    fulls = [program.fulls[name] / MACHINE_V for name in program.equations.states]
    assert np.abs(volts[:, 1:] - np.array(rows) / fulls).max() < 0.05 * LSB_V


@pytest.mark.parametrize("sample_rate_hz", [500.0, 100e3, pytest.param(RATE_HZ, marks=pytest.mark.heavy)])
@pytest.mark.parametrize("name", sampled(DIVIDING))
def test_dividers_and_roots_play_the_equations_at_any_rate(name: str, sample_rate_hz: float) -> None:
    assert off_equations_lsb(compiled(DIVIDING[name]), sample_rate_hz=sample_rate_hz) < 0.05


@pytest.mark.parametrize("sample_rate_hz", [100.0, 500.0])
@pytest.mark.parametrize("name", sampled([*DIVIDING, "two-tanks"]))
def test_offsets_of_ideal_amplifiers_leave_dividers_a_solution(name: str, sample_rate_hz: float) -> None:
    program = compiled(DIVIDING[name]) if name in DIVIDING else program_of(name)
    low_v, high_v = levels_v(program)
    excitation = Excitation(low_v=low_v, high_v=high_v, frequency_hz=sample_rate_hz / 100.0)
    exact, *others = (
        SuspensionComputer(program, opamp="ideal", rng=rng, offset_v=1e-7, sample_rate_hz=sample_rate_hz)
        for rng in (None, *map(np.random.default_rng, range(3)))
    )
    volts = np.concatenate(list(exact.play(excitation, 150)))
    for other in others:
        assert np.sqrt(np.mean((np.concatenate(list(other.play(excitation, 150))) - volts) ** 2)) < 0.5


def test_dividers_stand_idle_in_pot_set() -> None:
    machine = SuspensionComputer(compiled(DIVIDING["a divisor near zero"]), opamp="ideal").machine
    machine.switch(Mode.POT_SET)
    pot = next(iter(machine.dials))
    machine.set_coefficient(pot, 0.3)
    assert machine.coefficient(pot) == pytest.approx(0.3)
    assert not np.abs(machine.run(5)).any()


def test_a_rest_waits_for_a_divisor_that_is_a_root() -> None:
    circuit = SuspensionComputer(compiled(DIVIDING["a divisor that is a root"]), opamp="ideal").circuit
    rest = piecewise_linear(circuit).rest(np.zeros(1))
    assert np.isfinite(list(rest.volts.values())).all()


def test_a_loop_costs_steps_where_it_moves_and_not_all_the_time() -> None:
    program = program_of("two-tanks")
    engine = Engine(piecewise_linear(SuspensionComputer(program).circuit), program.channel_nodes, RATE_HZ)
    low_v, high_v = levels_v(program)
    edges = Excitation(low_v=low_v, high_v=high_v).edges(0, 4000 * TICKS_PER_SAMPLE, RATE_HZ)
    engine.run(4000, {"F": edges})
    assert engine.counts.steps < 4 * 4000


@pytest.mark.parametrize("name", FILES)
def test_every_amplifier_agrees_with_ngspice(ngspice: NgSpice, name: str) -> None:
    program = program_of(name)
    computer = SuspensionComputer(program, rng=np.random.default_rng(3))
    low_v, high_v = levels_v(program)
    # At an edge's own instant ngspice still shows the level before it, so no edge is to fall on a sample.
    excitation = Excitation(low_v=low_v, high_v=high_v, clock="free", phase=0.637)
    samples = 120
    deck = Deck(
        computer.circuit,
        samples,
        RATE_HZ,
        {"F": excitation.edges(0, samples * TICKS_PER_SAMPLE, RATE_HZ)},
        computer.plan([PotTurn(60, dict(changes_of(program)[0].values))], samples),
    )
    outputs = [amp.out for amp in deck.circuit.of(OpAmp)]
    assert np.abs(deck.volts(outputs) - ngspice(deck.text(outputs), outputs, samples)).max() < 0.05 * LSB_V


@pytest.mark.parametrize("name", PROGRAMS)
def test_file_of_a_program_wired_by_hand_plays_the_program(name: str) -> None:
    program = program_of(name)
    changes = [turn for turn in changes_of(program) if set(turn.values) <= set(SuspensionComputer(name).program.values)]
    one, other = SuspensionComputer(program, opamp="ideal"), SuspensionComputer(name, opamp="ideal")
    volts = [np.concatenate(list(computer.play(Excitation(), SAMPLES, changes))) for computer in (one, other)]
    assert np.abs(volts[0] - volts[1]).max() < 0.05 * LSB_V
    for quantity in program.channels:
        assert program.scales.full(quantity) == pytest.approx(other.scales.full(quantity))


def changes_of(program: PatchedProgram) -> list[PotTurn]:
    """Every parameter to an end of its range, one after the other, from sample 60 on."""
    rows = [(name, row) for name, row in program.equations.parameters.items() if row.pot]
    return [PotTurn(60 + 25 * i, {name: row.low if i % 2 else row.high}) for i, (name, row) in enumerate(rows)]


def levels_v(program: PatchedProgram) -> tuple[float, float]:
    (quantity,) = program.equations.inputs.values()
    low, high = (level * MACHINE_V / (quantity.full or 0.0) for level in quantity.trial)
    return low, high


def by_scipy(
    program: PatchedProgram, excitation: Excitation, changes: Sequence[PotTurn], sample_rate_hz: float, rtol: float
) -> Volts:
    """Channels as the equations of the file have them: (samples, channels), in V."""
    equations = program.equations
    edges = excitation.edges(0, SAMPLES * TICKS_PER_SAMPLE, sample_rate_hz)
    input_v = edges.levels_v[np.searchsorted(edges.ticks, np.arange(SAMPLES) * TICKS_PER_SAMPLE, side="right") - 1]
    (name, quantity), *_ = equations.inputs.items()
    slopes, signals = equations.slopes(), equations.signal_laws()
    turned = {change.sample: change.values for change in changes}
    values, state, rows = dict(equations.values), np.zeros(len(equations.states)), []
    for k in range(SAMPLES):
        known = values | {name: float(input_v[k]) * (quantity.full or 0.0) / MACHINE_V}
        found = known | dict(zip(equations.states, state.tolist(), strict=True))
        for signal, law in signals:
            found[signal] = float(law(found))
        rows.append([found[channel] for channel in equations.channels])
        values |= turned.get(k, {})
        known |= values
        span = (0.0, equations.speed / sample_rate_hz)
        done = solve_ivp(lambda _, x: slopes(known, x), span, state, method="DOP853", rtol=rtol, atol=1e-3 * rtol)  # noqa: B023
        state = done.y[:, -1]
    return np.array(rows) * [program.scales.volts(channel) for channel in program.channels]


# ---- pots


def test_parameter_in_two_terms_turns_both_pots() -> None:
    motor = SuspensionComputer(program_of("dc-motor"), opamp="ideal")
    before = motor.coefficients
    motor.set(k=0.1)
    turned = {pot for pot, coefficient in motor.coefficients.items() if coefficient != before[pot]}
    assert len(turned) == 2
    for pot in turned:
        assert motor.coefficients[pot] == pytest.approx(before[pot] * 0.1 / 0.08)


def test_pot_of_two_parameters_keeps_the_other() -> None:
    """1/(R1 C1): R1 is set first, C1 second; both count."""
    battery = SuspensionComputer(program_of("rc-battery"), opamp="ideal")
    before = battery.coefficients
    battery.set(R1=0.01)
    battery.set(C1=1000.0)
    once = SuspensionComputer(program_of("rc-battery"), opamp="ideal")
    once.set(R1=0.01, C1=1000.0)
    assert battery.coefficients == once.coefficients != before


def test_sums_that_differ_in_the_sixth_digit_are_two_stages() -> None:
    text = """
name = "alike"
speed = 100
channels = ["u", "y"]
equations = "y' = max(0, 1.0000050*u - y) - max(0, 1.0000149*u - y) - max(0, 1.0000050*u - y)*y"
inputs.u = { full = 10.0 }
states.y = { full = 10.0 }
"""
    stages = stages_of(parse_program(text, "alike.toml"))
    sums = {stage.name: stage.cords[0].number for stage in stages.stages if stage.kind is StageKind.SUMMER}
    assert sums == {"1.00001*u - y": 1.000005, "1.0000149*u - y": 1.0000149}


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5])
def test_the_trial_play_combines_every_level_of_the_inputs(count: int) -> None:
    names = [f"u{i}" for i in range(count)]
    tables = "".join(f"inputs.{name} = {{ full = 10.0, trial = [-10.0, 1.0] }}\n" for name in names)
    text = f"""
name = "inputs"
speed = 100
channels = ["u0", "y"]
equations = "y' = ({" + ".join(names)})/{count} - y"
states.y = {{ full = 12.0 }}
{tables}"""
    stages = stages_of(parse_program(text, "inputs.toml"))
    if count > 4:
        with pytest.raises(ProgramError, match="inputs: 5 of them; the trial play combines the levels of at most 4"):
            reaches(stages)
        return
    found = reaches(stages)
    assert all((found[name].low, found[name].high) == (-10.0, 1.0) for name in names)


@pytest.mark.parametrize(
    ("equations", "is_stable"),
    [("v' = u\nx' = v", True), ("v' = u - x\nx' = v", True), ("v' = u - x + 0.01*v\nx' = v", False)],
)
def test_a_slow_growth_is_refused_and_an_integrator_is_not(equations: str, is_stable: bool) -> None:  # noqa: FBT001
    text = f"""
name = "slow"
speed = 1
period_s = 1.0
channels = ["u", "x"]
equations = '''
{equations}
'''
inputs.u = {{ full = 10.0 }}
states.v = {{ full = 100.0 }}
states.x = {{ full = 100.0 }}
"""
    stages = stages_of(parse_program(text, "slow.toml"))
    if is_stable:
        assert reaches(stages)["x"].peak > 1.0
        return
    with pytest.raises(ProgramError, match=r"the trial play grows without end: state [vx] reaches .* is unstable"):
        reaches(stages)


def test_plan_adds_up_changes_of_parameters_that_share_a_pot() -> None:
    battery = SuspensionComputer(program_of("rc-battery"), opamp="ideal")
    first, second = battery.plan([PotTurn(5, {"R1": 0.01}), PotTurn(9, {"C1": 1000.0})], 20)
    battery.set(R1=0.01, C1=1000.0)
    assert {**first.values, **second.values}.items() <= battery.dials.items()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"J": 1e-6},
            "J = 1e-06 cannot be set on program dc-motor, whose J is at least 5e-05: pot J: coefficient .* is beyond",
        ),
        ({"J": -1.0}, "pot J: J is -1 .*positive"),
        ({"J": float("nan")}, "pot J: J is nan .*positive"),
        ({"Q": 1.0}, "unknown setting 'Q'; there are R, L, k, J, d, P1_dial"),
        ({"J": 1e-4, "J_dial": 0.5}, "pot J: set twice at the same time"),
    ],
)
def test_setting_that_no_pot_shows_is_refused(settings: dict[str, float], message: str) -> None:
    motor = SuspensionComputer(program_of("dc-motor"))
    before = motor.dials
    with pytest.raises(PotError, match=message):
        motor.set(**settings)
    assert motor.dials == before


def test_parameter_without_pot_cannot_be_set() -> None:
    with pytest.raises(PotError, match=re.escape("unknown setting 'leak'")):
        SuspensionComputer(program_of("rc-battery")).set(leak=100.0)


@pytest.mark.parametrize("name", FILES)
def test_pots_reach_the_ends_of_every_range(name: str) -> None:
    program = program_of(name)
    for values in settings(program.equations):
        assert all(0 <= dial <= 1 for dial in dials(program, values).values())


# ---- pots of compiled programs stay away from the ends of their tracks, so that real parts of any draw can play them


TRACK_ENDS_SEEDS = 4

CASES = {
    "a value at the upper stop": ("y' = a*u - y", "a = { value = 1.0 }"),
    "a value just below the upper stop": ("y' = a*u - y", "a = { value = 0.9999 }"),
    "a range up to the upper stop": ("y' = a*u - y", "a = { value = 0.8, range = [0.5, 1.0] }"),
    "a reciprocal at the upper stop": ("y' = (u - y)/T", "T = { value = 1.0 }"),
    "a reciprocal whose least value is at the stop": ("y' = (u - y)/T", "T = { value = 2.0, range = [1.0, 4.0] }"),
    "two parameters at the upper stop": ("y' = a*c*u - y", "a = { value = 0.5 }\nc = { value = 2.0 }"),
    "corners of two ranges": (
        "y' = a*c*u - y",
        "a = { value = 0.5, range = [0.4, 0.625] }\nc = { value = 1.5, range = [1.0, 1.6] }",
    ),
    "a value at the lower stop": ("y' = u - y - b*y", "b = { value = 4e-4 }"),
    "a range down to the lower stop": ("y' = u - y - b*y", "b = { value = 0.01, range = [3e-4, 0.02] }"),
    "a constant at the lower stop": ("y' = u - y + b", "b = { value = 4e-3 }"),
    "a number at the lower stop": ("y' = u - y - 0.00045*y", ""),
    "a wide range": ("y' = u - y - b*y", "b = { value = 0.05, range = [4e-4, 0.1] }"),
    "a summer at the upper stop": ("S = g*u - 0.5*y\ny' = S - y", "g = { value = 1.0 }"),
    "a summer at the upper stop of gain 10": ("S = g*u - 0.5*y\ny' = 0.1*S - y", "g = { value = 10.0 }"),
    "a product at the upper stop": ("y' = a*u*y/10 - y + u", "a = { value = 1.0 }"),
}


def program(equations: str, parameters: str, speed: float = 10.0) -> PatchedProgram:
    signals = "[signals]\nS = { full = 10.0 }\n" if "S = " in equations else ""
    return compile_program(
        parse_program(
            f"name = 'ends'\nspeed = {speed}\nperiod_s = 20.0\nequations = '''\n{equations}\n'''\n"
            "[inputs]\nu = { full = 10.0, trial = [0.0, 1.0] }\n[states]\ny = { full = 10.0 }\n"
            f"{signals}[parameters]\n{parameters}",
            "ends",
        )
    )


@pytest.mark.parametrize("name", CASES)
def test_real_parts_set_every_value_of_a_range(name: str) -> None:
    assert_settable(program(*CASES[name]))


def test_a_fast_integrator_at_the_upper_stop_of_gain_10() -> None:
    assert_settable(program("y' = a*u - 0.5*y", "a = { value = 0.999 }", 1e5))


def assert_settable(patched: PatchedProgram) -> None:
    """Machines of drawn parts set every end of a range; the slopes are those of the equations."""
    assert_slopes(patched, np.random.default_rng(1))
    for seed in range(TRACK_ENDS_SEEDS):
        machine = real_machine(patched, seed)
        assert all(0.0 < dial < 1.0 for dial in machine.dials.values())
        for name, row in patched.equations.parameters.items():
            for value in (row.low, row.high):
                assert all(0.0 < dial < 1.0 for dial in machine.dials_for(**{name: value}).values())


def real_machine(patched: PatchedProgram, seed: int) -> SuspensionComputer:
    components = replace(COMPONENTS["polypropylene"], seed=seed, temperature_c=40.0)
    return SuspensionComputer(patched, components=components, multiplier=MULTIPLIERS["ad633"])


@pytest.mark.parametrize(("name", "asked"), [("dc-motor", "k"), ("dc-motor", "J"), ("rc-battery", "R2")])
def test_the_limit_in_an_error_is_one_that_can_be_set(name: str, asked: str) -> None:
    """The stated limit is set, and a value beyond the next digit is not."""
    machine = real_machine(program_of(name), 3)
    row = machine.program.equations.parameters[asked]  # type: ignore[attr-defined]
    for value in (row.low, row.high):
        try:
            machine.dials_for(**{asked: value})
        except PotError as error:
            limit = float(str(error).partition(f"whose {asked} is at ")[2].split(":")[0].split()[1])
            assert limit != value
            machine.dials_for(**{asked: limit})
            with pytest.raises(PotError, match=f"{asked} = .* cannot be set"):
                machine.dials_for(**{asked: limit + 0.5 * (value - limit)})
            return
    pytest.fail("every value can be set")


def test_the_limit_at_the_lower_stop_is_a_least_value() -> None:
    machine = real_machine(program_of("silverbox"), 3)
    with pytest.raises(PotError, match="square = 1 cannot be set on program silverbox, whose square is at least 1.2"):
        machine.dials_for(square=1.0)


SHIPPED = {
    "bump-stop": "5a3204392d78586c",
    "dc-motor": "4ef1e4a5f55c8796",
    "duffing": "1f192a2a5a9077c0",
    "front": "a27c7fd536bb4ff9",
    "pendulum": "2e9a0dccc06e2f49",
    "rc-battery": "9ea8268f635380ef",
    "shock": "73e5f63521e16aad",
    "silverbox": "328347d90b82e073",
    "two-mass": "c9957764ad215ffe",
    "two-tanks": "a14aa7d4d75a3a90",
    "van-der-pol": "a2fa8379e492c661",
}
"""Digest of a patch by program: resistors, capacitors, pots, full scales. Recorded hashes of runs depend on them."""


def digest(patched: PatchedProgram) -> str:
    values = [
        (part.name, part.nodes, getattr(part, "ohm", None), getattr(part, "farad", None)) for part in patched.elements
    ]
    pots = [(pot, patched.pot_coefficient(pot, patched.values)) for pot in patched.pots]
    return hashlib.sha256(repr((values, pots, sorted(patched.fulls.items()))).encode()).hexdigest()[:16]


@pytest.mark.parametrize("name", FILES)
def test_patches_of_shipped_programs_stay(name: str) -> None:
    assert digest(program_of(name)) == SHIPPED[name]


# ---- the front suspension on its tyre, against the equations of the thesis and against ngspice


PROGRAM = program_of("two-mass")
TWO_MASS_N = 400
TIME_SCALE = 200.0
QUANTITIES = (
    "force",
    "displacement",
    "velocity",
    "net_force",
    "suspension_force",
    "compression",
    "rate",
    "tyre_net_force",
    "tyre_velocity",
    "tyre_displacement",
)
CHANGES: tuple[PotTurn, ...] = (
    PotTurn(120, {"K2": 18000.0}),
    PotTurn(200, {"M1": 14.0, "B2": 3453.0}),
    PotTurn(280, {"K1": 150e3, "M2": 90.0}),
)


READ_NODES = [PROGRAM.scales.quantities[quantity].node for quantity in QUANTITIES]


def deck_of(computer: SuspensionComputer, changes: Sequence[PotTurn] = CHANGES) -> Deck:
    edges = Excitation().edges(0, TWO_MASS_N * TICKS_PER_SAMPLE, RATE_HZ)
    turns = [PotTurn(change.sample, computer.dials_for(**change.values)) for change in changes]
    return Deck(computer.circuit, TWO_MASS_N, RATE_HZ, {"F": edges}, turns, title="two masses")


def by_equations(changes: Sequence[PotTurn]) -> Volts:
    """Equ 2.1 and 2.2 stepped exactly: (samples, quantities in the order of QUANTITIES), in V at their nodes."""
    values, scales = dict(PROGRAM.values), PROGRAM.scales
    edges = Excitation().edges(0, TWO_MASS_N * TICKS_PER_SAMPLE, RATE_HZ)
    force_v = edges.levels_v[np.searchsorted(edges.ticks, np.arange(TWO_MASS_N) * TICKS_PER_SAMPLE, side="right") - 1]
    settings = {change.sample: change.values for change in changes}
    rows: list[list[float]] = []
    state: Volts = np.zeros(4)
    for k in range(TWO_MASS_N):
        force_n = force_v[k] * scales.full("force") / 10.0
        rows.append(quantities(values, state, force_n))
        values |= settings.get(k, {})
        state = stepped(values, state, force_n)
    return np.array(rows) * [scales.volts_at_node(quantity) for quantity in QUANTITIES]


def quantities(values: Mapping[str, float], state: Volts, force_n: float) -> list[float]:
    x2, v2, x1, v1 = state
    s = values["B2"] * (v2 - v1) + values["K2"] * (x2 - x1)
    tyre = values["B1"] * v1 + values["K1"] * x1
    return [force_n, x2, v2, force_n - s, s, x2 - x1, v2 - v1, s - tyre, v1, x1]


def stepped(values: Mapping[str, float], state: Volts, force_n: float) -> Volts:
    m2, b2, k2, m1, b1, k1 = (values[name] for name in ("M2", "B2", "K2", "M1", "B1", "K1"))
    a = np.zeros((5, 5))
    a[:4] = [
        [0.0, 1.0, 0.0, 0.0, 0.0],
        [-k2 / m2, -b2 / m2, k2 / m2, b2 / m2, force_n / m2],
        [0.0, 0.0, 0.0, 1.0, 0.0],
        [k2 / m1, b2 / m1, -(k1 + k2) / m1, -(b1 + b2) / m1, 0],
    ]
    step: Volts = expm(a * TIME_SCALE / RATE_HZ)
    following: Volts = (step @ np.append(state, 1.0))[:4]
    return following


def test_with_ideal_amplifiers_it_solves_the_equations_of_the_thesis() -> None:
    volts = deck_of(SuspensionComputer(PROGRAM, opamp="ideal")).volts(READ_NODES)
    np.testing.assert_allclose(volts, by_equations(CHANGES), atol=1e-9)


def test_with_real_amplifiers_it_stays_within_25_lsb_of_them() -> None:
    # Bandwidth: the tyre rings at 3.4 kHz of machine time, and the summers have inputs of gain 10.
    volts = deck_of(SuspensionComputer(PROGRAM)).volts(READ_NODES)
    deviation = dict(zip(QUANTITIES, np.abs(volts - by_equations(CHANGES)).max(axis=0) / LSB_V, strict=True))
    moving = ("displacement", "velocity", "compression", "tyre_velocity", "tyre_displacement")
    assert max(deviation[name] for name in moving) < 25.0


def test_no_amplifier_exceeds_10_v() -> None:
    deck = deck_of(SuspensionComputer(PROGRAM))
    assert np.abs(deck.volts([amp.out for amp in deck.circuit.of(OpAmp)])).max() < 10.0


def test_both_springs_in_series_carry_a_constant_force() -> None:
    computer = SuspensionComputer(PROGRAM)
    computer.set(K1=215e3, M1=15.0)
    scale = PROGRAM.scales.quantities["displacement"]
    volts = deck_of(computer, ()).volts([scale.node])
    static_m = 2940.0 / PROGRAM.values["K2"] + 2940.0 / 215e3
    assert volts[49, 0] / PROGRAM.scales.volts_at_node("displacement") == pytest.approx(static_m, rel=0.002)
