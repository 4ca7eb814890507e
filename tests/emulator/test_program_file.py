"""Program files: what a healthy one holds, and one clear line for each way to spoil it."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from analogrig_emulator.exceptions import ProgramError
from analogrig_emulator.machine.formula import parse_formula
from analogrig_emulator.machine.program_loader import load_patch, parse_program
from analogrig_emulator.machine.units import parse_unit

MOTOR = """
name = "motor"
speed = 10
channels = ["u", "omega", "i"]
equations = '''
i' = (u - R*i - k*omega) / L
torque = k*i
omega' = (torque - d*omega) / J   # viscous friction
'''
[inputs]
u = { unit = "V", full = 24.0, trial = [0.0, 20.0] }
[states]
i = { unit = "A" }
omega = { unit = "rad/s", full = 300.0 }
[parameters]
R = { value = 1.2, unit = "ohm", range = [0.9, 1.6] }
L = { value = 4e-3, unit = "H" }
k = { value = 0.08, unit = "V s/rad" }
J = { value = 8e-5, unit = "kg m^2" }
d = { value = 2e-4, unit = "N m s/rad", pot = false }
"""

SLOW = """
name = "oven"
speed = 1
channels = ["u", "y"]
equations = "y' = (u - y) / T"
inputs.u.full = 10.0
states.y.full = 10.0
parameters.T.value = 3000.0
"""

I0 = 'i0 = { value = 4e3, unit = "mA" }'
"""Row of a parameter in another size of unit than the state i."""

Change = Callable[[str], str]


def swapped(old: str, new: str) -> Change:
    def swap(text: str) -> str:
        assert text.count(old) == 1
        return text.replace(old, new)

    return swap


def equation(line: str, *more: Change) -> Change:
    """Instead of omega' = ..."""

    def change(text: str) -> str:
        text = swapped("omega' = (torque - d*omega) / J   # viscous friction", line)(text)
        for each in more:
            text = each(text)
        return text

    return change


def without_units(text: str) -> str:
    return re.sub(r'unit = "[^"]*",? ?', "", re.sub(r', unit = "[^"]*"', "", text))


def with_row(table: str, row: str) -> Change:
    return swapped(f"[{table}]\n", f"[{table}]\n{row}\n")


def test_motor_is_read() -> None:
    motor = parse_program(MOTOR, "motor.toml")
    assert (motor.name, motor.speed, motor.channels) == ("motor", 10.0, ("u", "omega", "i"))
    assert (list(motor.states), list(motor.inputs), list(motor.signals)) == (["i", "omega"], ["u"], ["torque"])
    assert (motor.parameters["R"].low, motor.parameters["R"].high, motor.parameters["L"].low) == (0.9, 1.6, 4e-3)
    assert [line.place for line in motor.derivatives] == ["equations, line 1", "equations, line 3"]
    unit = motor.signals["torque"].unit
    assert unit is not None and unit.text == "kg m^2 s^-2"


BAD: dict[str, tuple[Change, str]] = {
    "alias of two": (
        lambda text: swapped('"ohm"', '"ohm", alias = "it"')(swapped('"H"', '"H", alias = "it"')(text)),
        "parameters.L.alias: it is the alias of R already",
    ),
    "alias that is a state": (
        swapped('unit = "H"', 'unit = "H", alias = "i"'),
        "parameters.L.alias: i is one of states already; choose another",
    ),
    "alias of two words": (
        swapped('unit = "H"', 'unit = "H", alias = "of coil"'),
        "parameters.L.alias: 'of coil': write a letter",
    ),
    "diagnosis of two": (
        lambda text: swapped('"ohm"', '"ohm", diagnosis = "mass"')(swapped('"H"', '"H", diagnosis = "mass"')(text)),
        "parameters.L.diagnosis: mass is the diagnosis of R already",
    ),
    "estimate of a fixed parameter": (
        lambda text: text + "[estimates]\nd = '1 / gain'\n",
        r"estimates.d: no pot shows a parameter 'd'; there are R, L, k, J",
    ),
    "trailing junk": (lambda text: text + "\n}} end", "is no TOML: .*line"),
    "no text": (lambda text: text.replace("motor", "m\udce9tor"), "is no UTF-8 text: byte"),
    "huge": (lambda text: text + "#" * 70_000, "larger than 65536 bytes"),
    "nested deeply": (lambda text: text + "a = " + "[" * 9000, "is (no TOML|nested too deeply)"),
    "number of many digits": (swapped("1.2,", "1" * 5000 + ","), "is no TOML|exceeds 1e"),
    "unknown key": (swapped("speed =", "sped ="), "unknown key 'sped'; did you mean 'speed'"),
    "unknown key of a row": (swapped("pot = false", "pots = false"), "parameters.d: unknown key 'pots'; did you mean"),
    "no name": (swapped('name = "motor"', ""), "name is missing"),
    "control characters": (
        swapped("speed = 10", 'speed = 10\ndescription = "a\\u001b[2J"'),
        "description: write one line",
    ),
    "name with a slash": (swapped('name = "motor"', 'name = "../motor"'), "name '../motor': write letters, digits"),
    "no speed": (swapped("speed = 10", ""), "speed is missing"),
    "speed of zero": (swapped("speed = 10", "speed = 0"), "speed: 0 is zero; it must be positive"),
    "speed is text": (swapped("speed = 10", 'speed = "fast"'), "speed: 'fast' is no number"),
    "no equations": (lambda text: text.replace("equations =", "description ="), "equations is missing"),
    "no states": (
        lambda text: text[: text.index("[states]")] + text[text.index("[parameters]") :],
        "states: there is none",
    ),
    "no inputs": (
        lambda text: text[: text.index("[inputs]")] + text[text.index("[states]") :],
        "inputs: there is none",
    ),
    "input without full scale": (swapped("full = 24.0, ", ""), "inputs.u: full is missing; give the value that 10 V"),
    "trial beyond the full scale": (swapped("20.0]", "30.0]"), r"inputs.u.trial: \[0, 30\] exceeds the full scale 24"),
    "trial without a step": (swapped("[0.0, 20.0]", "[1, 1]"), r"inputs.u.trial: \[1, 1\] excites nothing; write a"),
    "unknown channel": (swapped('"omega",', '"omga",'), "channels: unknown quantity 'omga'; did you mean 'omega'"),
    "channel twice": (swapped('"omega",', '"u",'), "channels: 'u' stands there twice"),
    "unknown name": (equation("omega' = (torque - d*omga) / J"), "line 3: unknown name 'omga'; did you mean 'omega'"),
    "unknown function": (equation("omega' = sgn(torque) / J"), "line 3: unknown function 'sgn'; "),
    "too many arguments": (equation("omega' = abs(torque, d*omega) / J"), "line 3: abs takes 1 argument, not 2"),
    "call of Python": (equation("omega' = __import__('os').system('id')"), "line 3: (a derivative|.* is not allowed)"),
    "attribute": (equation("omega' = (torque - d*omega).real / J"), "line 3: .* is not allowed"),
    "comparison": (equation("omega' = (torque > d) * J"), "line 3: 'torque > d' is not allowed"),
    "lambda": (equation("omega' = (lambda: 1)()"), "line 3: .* is no formula"),
    "unbalanced bracket": (equation("omega' = (torque - d*omega / J"), "line 3: .* is no formula"),
    "brackets without end": (equation("omega' = " + "(" * 300 + "torque"), "line 3: .* is no formula"),
    "deep formula": (
        equation("omega' = " + "-" * 60 + "torque / J"),
        "line 3: formula of more than 400 parts or 40 levels",
    ),
    "long formula": (equation("omega' = " + "torque + " * 200 + "0"), "line 3: formula of 1[0-9]+ characters"),
    "empty right side": (equation("omega' ="), "line 3: the formula is missing"),
    "no equation": (equation("omega"), "line 3: 'omega' is no equation; write x' = ... or S = ..."),
    "caret": (
        equation("omega' = (torque - d*omega^2) / J"),
        "line 3: \\^ is no operator here; write \\*\\* for a power",
    ),
    "fractional power": (equation("omega' = (torque - d*omega**1.5) / J"), "line 3: power 1.5: write an integer"),
    "tower of powers": (equation("omega' = (torque - 9**9**9) / J"), r"line 3: power 9 \*\* 9: write an integer"),
    "number beyond all floats": (
        equation("omega' = (torque - 1e999*d*omega) / J"),
        r"equations, line 3: number 1e999 exceeds 1e\+100; scale the quantities",
    ),
    "number that underflows": (
        equation("omega' = (torque - 1e-400*d*omega) / J"),
        "equations, line 3: number 1e-400 is smaller than 1e-100; write 0, or scale the quantities",
    ),
    "coefficient of zero at the end of a range": (
        equation("omega' = (torque - d*omega/(R - 0.9)) / J", without_units),
        r"equations, line 3: R - 0.9 is 0 with R = 0.9; a pot needs it positive",
    ),
    "estimate divided by zero": (
        lambda text: text + "[estimates]\nJ = 's0/0'\n",
        "estimates.J: s0 / 0 divides by zero",
    ),
    "estimate divided by a formula of zero": (
        lambda text: text + "[estimates]\nJ = '1/gain + s0/(2 - 2)'\n",
        r"estimates.J: s0 / \(2 - 2\) divides by zero",
    ),
    "estimate with the root of a negative number": (
        lambda text: text + "[estimates]\nJ = 'gain*sqrt(-1)'\n",
        r"estimates.J: sqrt\(-1\) is the root of a negative number",
    ),
    "estimate beyond all floats": (
        lambda text: text + "[estimates]\nJ = '1e999*gain'\n",
        r"estimates.J: number 1e999 exceeds 1e\+100; scale the quantities",
    ),
    "estimate that is a number": (
        lambda text: text + "[estimates]\nJ = '8e-5'\n",
        "estimates.J: 8e-05 is the same for every response; write it with gain, s0, s1",
    ),
    "complex number": (equation("omega' = (torque - 1j*omega) / J"), "line 3: 1j is no number"),
    "second derivative": (equation("omega'' = torque / J"), "line 3: omega'' is no first derivative; write omega' = v"),
    "derivative on the right": (
        equation("omega' = (torque - d*i') / J"),
        "line 3: a derivative stands within a formula",
    ),
    "derivative of no state": (
        equation("omga' = torque / J"),
        "line 3: omga' is the derivative of no state; did you mean",
    ),
    "state without derivative": (equation(""), "states.omega: no equation gives omega'; write it"),
    "derivative twice": (
        equation("omega' = torque/J\nomega' = d*omega/J"),
        "line 4: omega' is given on line 3 already",
    ),
    "state as a signal": (equation("omega = torque / J"), "line 3: omega is a state; write omega' ="),
    "equation for an input": (equation("omega' = torque/J\nu = d*omega"), "line 4: u is an input or parameter"),
    "name twice": (with_row("parameters", "u = { value = 1.0 }"), "parameters.u: this name is one of inputs already"),
    "name of a function": (with_row("parameters", "max = { value = 1.0 }"), "parameters.max: this name is a function"),
    "name with a dash": (with_row("parameters", '"a-b" = { value = 1.0 }'), "parameters: name 'a-b': write a letter"),
    "signal without equation": (
        lambda text: text + "\n[signals]\npower = {}\n",
        "signals.power: no equation gives power",
    ),
    "unused parameter": (with_row("parameters", "q = { value = 1.0 }"), "parameters.q: no equation uses it; delete it"),
    "unused input": (with_row("inputs", "w = { full = 1.0 }"), "inputs.w: no equation uses it; delete it"),
    "algebraic loop": (
        equation("omega' = (torque - p) / J\np = d*q\nq = omega - p/d"),
        "line 4: algebraic loop p needs q needs p; solve",
    ),
    "wrong unit": (swapped('unit = "V s/rad"', 'unit = "V"'), "line 1: .* is in .* and k \\* omega in .*; make both"),
    "root of a unit": (
        swapped("- k*omega) / L", "- sqrt(k)*omega) / L"),
        r"line 1: u - R \* i is in V and sqrt\(k\) \* omega in kg\^0.5 m s\^-2 A\^-0.5; make both units the same",
    ),
    "wrong size of a unit": (
        swapped('unit = "H"', 'unit = "mH"'),
        "line 1: i' is in A s\\^-1, the right side in 1000 A",
    ),
    "terms of one unit in two sizes": (
        equation("omega' = (torque - d*omega*(1 + (i/i0)**2)) / J", with_row("parameters", I0)),
        r"line 3: 1 is in 1 and \(i / i0\) \*\* 2 in 1e\+06; the dimension is the same, the size is not: write",
    ),
    "unknown unit": (swapped('unit = "H"', 'unit = "henry"'), "parameters.L: unit 'henry': unknown symbol 'henry'"),
    "unit ends early": (swapped('unit = "H"', 'unit = "V s/"'), "parameters.L: unit 'V s/' ends before a symbol"),
    "length under a number": (
        equation("omega' = (torque - d*sin(L)*omega) / J"),
        "line 3: sin\\(L\\): the argument is in",
    ),
    "L of zero": (swapped("value = 4e-3", "value = 0.0"), "parameters.L.value: 0 is zero; it must be positive"),
    "negative parameter": (swapped("value = 8e-5", "value = -8e-5"), "parameters.J.value: -8e-05 is negative"),
    "infinite parameter": (swapped("value = 8e-5", "value = inf"), "parameters.J.value: inf is not finite"),
    "NaN": (swapped("value = 8e-5", "value = nan"), "parameters.J.value: nan is not finite"),
    "value is true": (swapped("value = 8e-5", "value = true"), "parameters.J.value: 'True' is no number"),
    "no value": (swapped("value = 8e-5, ", ""), "parameters.J: value is missing"),
    "range descends": (swapped("[0.9, 1.6]", "[1.6, 0.9]"), r"parameters.R.range: \[1.6, 0.9\] descends"),
    "range of three": (swapped("[0.9, 1.6]", "[0.9, 1, 2]"), "parameters.R.range: write two numbers"),
    "range below zero": (
        swapped("[0.9, 1.6]", "[-0.9, 1.6]"),
        "parameters.R.range: -0.9 is not positive; write the sign",
    ),
    "value outside its range": (swapped("[0.9, 1.6]", "[1.3, 1.6]"), r"parameters.R: value 1.2 lies outside its range"),
    "row is no table": (
        swapped('R = { value = 1.2, unit = "ohm", range = [0.9, 1.6] }', "R = 1.2"),
        "parameters.R: write a",
    ),
    "many rows": (
        with_row("parameters", "\n".join(f"p{i} = {{ value = 1 }}" for i in range(70))),
        "parameters: 75 rows",
    ),
    "scale exceeded": (
        swapped("full = 300.0", "full = 150.0"),
        "states.omega: omega reaches .* 15.* V at full scale 150; wr",
    ),
    "state that stays at zero": (
        equation(
            "omega' = (torque - d*omega) / J\nz' = -z/tau",
            with_row("states", "z = {}"),
            with_row("parameters", "tau = { value = 1 }"),
        ),
        "line 4: no input acts on z, which stays at 0, where states start; add a term with an input",
    ),
    "state that grows without bound": (
        equation("omega' = (torque + 1e7*d*omega) / J"),
        "the trial play grows without end: state i exceeds 1e.30 at .* s; the plant is unstable: correct a sign",
    ),
    "input that cancels": (
        equation("omega' = (torque - d*omega) / J", swapped("(u - R*i", "(u - u - R*i")),
        "line 1: no input acts on i, omega, which stay at 0, where states start; add a term with an input",
    ),
    "name of 400 letters": (
        equation("omega' = (torque - d*" + "x" * 400 + ") / J"),
        "line 3: unknown name 'x{40}'; there are",
    ),
    "formula of many factors": (
        equation("omega' = (torque - d*omega - 1e-9*((0.001*omega)**8)**8) / J", without_units),
        r"line 3: term .{,60} of .{,60} (has|needs) a coefficient",
    ),
    "plant that grows in the trial play": (
        equation("omega' = (torque + 1e2*d*omega) / J", swapped(", full = 300.0", "")),
        "the trial play grows without end: state i reaches .* at 0.1 s; the plant is unstable",
    ),
    "machine slower than the plant": (
        lambda _: SLOW,
        "line 1: .* the integrator is slow, at most .* with 1 uF; write speed = 25000$",
    ),
    "coefficient beyond 10": (
        lambda text: equation("omega' = (torque - d*omega) / J")(text) + "\n[signals]\ntorque = { full = 0.05 }\n",
        "line 2: torque reaches .* in the trial play",
    ),
    "gain beyond 10": (
        lambda text: (
            swapped('i = { unit = "A" }', 'i = { unit = "A", full = 2000.0 }')(text)
            + "\n[signals]\ntorque = { full = 1.5 }\n"
        ),
        "line 2: term \\+ k\\*i of torque needs a coefficient of 107, .*; write signals.torque.full = 20$",
    ),
    "machine too fast": (
        swapped("speed = 10", "speed = 1e6"),
        "integrator of .* needs a coefficient of .* with 1 nF, beyond 10; write speed = ",
    ),
    "coefficient below one winding": (
        equation("omega' = (torque - d*omega - 1e-9*torque*d) / J", without_units),
        "line 3: term - 1e-09\\*d\\*torque of .* has a coefficient of .*, below one winding of a pot",
    ),
    "division by a state that is zero at rest": (
        equation("omega' = (torque - d*omega + d/omega) / J", without_units),
        "line 3: 1/omega divides by omega, which is zero at rest; add an offset",
    ),
    "division by a state that crosses zero": (
        equation("omega' = (torque - d*omega + 1e-6*d/(i - 2)) / J", without_units),
        "line 3: 1/\\(i - 2\\) divides by i - 2, which reaches zero in the trial play",
    ),
    "root of negative values": (
        equation("omega' = (torque - d*omega - d*sqrt(-i)) / J", without_units),
        "line 3: sqrt\\(-i\\) takes the root of negative values in the trial play",
    ),
    "sine of a state": (
        equation("omega' = (torque - d*sin(omega)) / J", without_units),
        "line 3: sin\\(omega\\): no element computes sin of a signal",
    ),
    "coefficient that changes its sign": (
        equation("omega' = (torque - (d - 1e-3)*omega) / J", without_units),
        "d - 0.001 is -0.0008 with d = 0.0002; a pot needs it positive",
    ),
    "division by a zero after others": (equation("omega' = (torque - d*omega) / J / 0"), "line 3: a division by zero"),
    "division by zero": (equation("omega' = (torque - d*omega) / (0*J)"), "line 3: a division by zero"),
    "right side of zero": (equation("omega' = d*omega/J - omega*d/J"), "line 3: the right side is zero; delete"),
    "root of a negative number": (
        equation("omega' = (torque - (1 + sqrt(2 - 3))*d*omega) / J"),
        "line 3: sqrt\\(2 - 3\\) is the root of a negative number",
    ),
    "number of no value": (
        equation("omega' = (torque - log(0)*d*omega) / J"),
        "line 3: log\\(0\\) is no finite number",
    ),
    "terms without end": (
        equation("omega' = (torque + i + d*omega + u)**8 / J", without_units),
        "line 3: .*more than 64 terms",
    ),
    "points that do not ascend": (
        lambda text: text + "[functions]\nf = { points = [[0, 0], [0, 1]] }\n",
        r"functions.f.points\[1\]: x 0 does not exceed 0; sort",
    ),
    "one point": (
        lambda text: text + "[functions]\nf = { points = [[0, 0]] }\n",
        "functions.f.points: write 2 to 64 pairs",
    ),
}


@pytest.mark.parametrize("kind", [kind for kind, (_, message) in BAD.items()])
def test_bad_file_is_refused_in_one_line(kind: str, tmp_path: Path) -> None:
    change, message = BAD[kind]
    path = tmp_path / "bad.toml"
    path.write_bytes(change(MOTOR).encode("utf-8", "surrogateescape"))
    with pytest.raises(ProgramError, match=f"{path}: .*{message}") as refusal:
        load_patch(path)
    text = str(refusal.value)
    assert "\n" not in text and len(text) < 400
    assert text.count(str(path)) == 1


def test_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ProgramError, match="absent.toml: cannot be read: No such file"):
        load_patch(tmp_path / "absent.toml")


def test_pipe_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.toml")
    with pytest.raises(ProgramError, match="pipe.toml: cannot be read: it is no regular file"):
        load_patch(tmp_path / "pipe.toml")


@pytest.mark.parametrize("name", ["lambda", "in", "is", "from", "class"])
def test_a_keyword_of_python_is_a_name(name: str) -> None:
    with_keyword = re.sub(r"\bk\b", name, MOTOR)
    assert name in parse_program(with_keyword, "").parameters
    known = {name: 3.0, "i": 2.0}
    assert parse_formula(f"-{name}**2*i").law({})(known) == -18.0 and str(parse_formula(f"1/{name}")) == f"1 / {name}"


@pytest.mark.parametrize("name", ["and", "or", "not", "if", "else"])
def test_a_word_that_is_no_name_is_called_reserved(name: str) -> None:
    with pytest.raises(ProgramError, match=f"'{name}' is a reserved word and no name; choose another name"):
        parse_formula(f"u - R*i - {name}*omega")


def test_a_fractional_power_of_a_unit_is_named() -> None:
    with pytest.raises(ProgramError, match=r"unit 'm\^2.5/s': a power is no whole number"):
        parse_unit("m^2.5/s")
