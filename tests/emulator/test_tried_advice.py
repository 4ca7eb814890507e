"""Advice of the compiler, followed as a user follows it: the program compiles, and plays without overload."""

from __future__ import annotations

import functools
import re
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from analogrig_emulator import COMPONENTS, MULTIPLIERS, EmulatorError, Excitation, SuspensionComputer
from analogrig_emulator.machine.patched_program import PatchedProgram
from analogrig_emulator.machine.program_loader import compile_program, equations_of

_ROUNDS = 3
"""Errors in a file that are mended one after another."""

heavy = functools.partial(pytest.param, marks=pytest.mark.heavy)

_SAMPLES = 1500
_CARD_V = 12.5


def file_of(lines: str, states: str = "x = {}", *, head: str = "speed = 100", more: str = "") -> str:
    """Text of a program with an input u from -0.5 to 0.5."""
    return (
        f'name = "case"\nchannels = ["u", "{states.split(maxsplit=1)[0]}"]\n{head}\nequations = """\n{lines}\n"""\n'
        f"[inputs]\nu = {{ full = 1.0, trial = [-0.5, 0.5] }}\n[states]\n{states}\n{more}"
    )


def advice_of(message: str) -> str:
    return message.rsplit("; ", maxsplit=1)[-1]


def followed(table: Mapping[str, Any], message: str) -> dict[str, Any]:
    """Tables of a file after the advice at the end of a message; AssertionError: it holds none."""
    new = tomllib.loads(tomllib_text(table))
    parts = re.split(r", (?=write |leave out )", advice_of(message))
    for part in parts:
        if spelt := re.fullmatch(r"did you mean '(\w+)'\?", part):
            (unknown,) = re.findall(r"unknown (?:name|function) '(\w+)'", message)
            new["equations"] = re.sub(rf"\b{unknown}\b", spelt[1], new["equations"])
        elif left := re.fullmatch(r"leave out ([\w.]+)", part):
            *path, key = left[1].split(".")
            row_of(new, path).pop(key)
        elif valued := re.fullmatch(r"write ([\w.]+) = (.*)", part):
            *path, key = valued[1].split(".")
            row_of(new, path)[key] = tomllib.loads(f"value = {valued[2]}")["value"]
        elif swapped := re.fullmatch(r"write (.*) for (.*)", part):
            place = rf"\b{re.escape(swapped[2])}" + (r"\b" if swapped[2].isidentifier() else "")
            new["equations"] = re.sub(place, swapped[1], new["equations"])
        else:
            pytest.fail(f"no advice to follow: {message}")
    return new


def row_of(table: dict[str, Any], path: list[str]) -> dict[str, Any]:
    for name in path:
        table = table.setdefault(name, {})
    return table


def tomllib_text(table: Mapping[str, Any]) -> str:
    """Tables as TOML, for a copy of them as a file holds them."""
    return "\n".join(f"{key} = {toml(value)}" for key, value in table.items())


def toml(value: Any) -> str:
    match value:
        case bool():
            return str(value).lower()
        case dict():
            return "{" + ", ".join(f"{key} = {toml(each)}" for key, each in value.items()) + "}"
        case list():
            return "[" + ", ".join(map(toml, value)) + "]"
        case str():
            return '"' + value.replace("\n", "\\n") + '"'
    return repr(value)


@functools.cache
def advised(text: str) -> tuple[str, PatchedProgram]:
    """First message for a file, and the program once its advice was followed. Raises its error if that has none."""
    table, first = tomllib.loads(text), ""
    for _ in range(_ROUNDS):
        try:
            return first, compile_program(equations_of(table))
        except EmulatorError as error:
            if not re.match(r"write |leave out |did you mean ", advice_of(str(error))):
                raise
            first = first or str(error)
            table = followed(table, str(error))
    return first, compile_program(equations_of(table))


def assert_plays(program: PatchedProgram) -> None:
    """The channels of the nominal and of a real machine stay within the card's range, and no lamp lights."""
    (name, quantity), *_ = program.equations.inputs.items()
    low_v, high_v = (level * program.scales.volts(name) for level in quantity.trial)
    real = replace(COMPONENTS["polypropylene"], seed=7, temperature_c=40.0)
    for computer in (
        SuspensionComputer(program),
        SuspensionComputer(program, components=real, multiplier=MULTIPLIERS["ad633"]),
    ):
        volts = computer.play(Excitation(low_v=low_v, high_v=high_v), _SAMPLES)
        assert max(np.abs(each).max() for each in volts) <= _CARD_V
        assert not [name for name, sample in computer.machine.lamps.items() if sample is not None]


ARM = "angle' = omega\nomega' = u - d*omega - k*{0}"
ARM_STATES = "omega = {}\nangle = {}"
ARM_VALUES = "[parameters]\nd = { value = 2.0 }\nk = { value = 20.0 }"

CASES = {
    "sine of a state": file_of(ARM.format("sin(angle)"), ARM_STATES, more=ARM_VALUES),
    "cosine of a state": file_of(ARM.format("angle*cos(angle)"), ARM_STATES, more=ARM_VALUES),
    "sine and cosine of a state": file_of(ARM.format("(sin(angle) + angle*cos(angle))"), ARM_STATES, more=ARM_VALUES),
    "sine of a signal": file_of("s = 2*x\nx' = u - x - sin(s)", more="[signals]\ns = {}"),
    "sine of its own slope": file_of("x' = u - x - 0.3*sin(x)"),
    "hyperbolic tangent": file_of("x' = u - tanh(3*x)"),
    "exponential": file_of("x' = u - exp(x) + 1"),
    "sign": file_of("v' = u - v - 0.2*sign(v)", "v = {}"),
    "saturation": file_of("v' = sat(5*u) - v", "v = {}"),
    "arc tangent": file_of("x' = u - atan(x)"),
    "a misspelt function": file_of("x' = u - x - 0.3*sine(x)"),
    "a misspelt root": file_of("x' = u - x + 0.5*sqr(0.1 + x*x)"),
    "a misspelt name": file_of("x' = u - rate*x - rte*x", more="[parameters]\nrate = { value = 2.0 }"),
    "a root of negative values": file_of("x' = u - x - sqrt(x)"),
    "too slow": file_of("x' = u - x", head="speed = 0.02"),
    "too slow by far": file_of("x' = u - x", head="speed = 1e-4"),
    "too slow at its own scale": file_of("x' = u - 1.3*x", "x = { full = 1.0 }", head="speed = 0.002"),
    "too fast": file_of("x' = 1000*u - 1000*x", head="speed = 1000"),
    "too fast by far": file_of("x' = u - x", head="speed = 1e9"),
    "a full scale too small": file_of("x' = u - x", "x = { full = 0.1 }", head="speed = 100\nperiod_s = 5"),
    "a full scale too small of a weak mode": file_of(
        "x' = v\nv' = u - 0.01*v - x", "x = { full = 1.0 }\nv = { full = 1.0 }", head="speed = 100\nperiod_s = 6.3"
    ),
    "a full scale too large": file_of("x' = u - x", "x = { full = 1e5 }"),
    "full scales apart": file_of("x' = v\nv' = u - v - x", "x = { full = 1.0 }\nv = { full = 5e4 }"),
    "a signal with a gain beyond 10": file_of(
        "s = 50*x\nx' = u - x", "x = { full = 1.0 }", more="[signals]\ns = { full = 1.0 }"
    ),
    "a signal that stays at zero": file_of(
        "s = max(0, x - 3)\nx' = u - x - s", "x = { full = 1.0 }", more="[signals]\ns = {}"
    ),
}


LARGER_SAMPLE = {
    "cosine of a state",
    "sine and cosine of a state",
    "sine of its own slope",
    "arc tangent",
    "a misspelt function",
    "too slow by far",
    "too fast by far",
    "a full scale too small of a weak mode",
}
"""Cases whose advice is of the kind of another case."""


@pytest.mark.parametrize("name", [heavy(each) if each in LARGER_SAMPLE else each for each in CASES])
def test_advice_that_is_followed_plays(name: str) -> None:
    message, program = advised(CASES[name])
    assert message
    assert_plays(program)


@pytest.mark.parametrize(
    ("name", "law"), [("sine of a state", np.sin), ("hyperbolic tangent", np.tanh), ("exponential", np.exp)]
)
def test_points_that_stand_for_a_function_are_near_it(name: str, law: Callable[[Any], Any]) -> None:
    _, program = advised(CASES[name])
    ((table, points),) = program.equations.functions.items()
    (stage,) = (each.stage for each in program.patch if each.stage.function == table)
    reach = program.reach[stage.cords[0].source]
    at = np.linspace(reach.low, reach.high, 101)
    assert np.abs(points(at) - law(at)).max() <= 0.01 * np.ptp(law(at))


DEAD = {
    "two states that multiply each other": ("s' = c*u\nc' = -s*u\nx' = u - x - s", "x = {}\ns = {}\nc = {}"),
    "the same with full scales": (
        "s' = c*u\nc' = -s*u\nx' = u - x - s",
        "x = {}\ns = { full = 1.0 }\nc = { full = 1.0 }",
    ),
    "growth in proportion to itself": ("n' = n*u - n\nx' = u - x - n", "x = {}\nn = { full = 1.0 }"),
    "a quotient of a dead dividend": ("n' = n/(2 + u)\nx' = u - x - n", "x = {}\nn = { full = 1.0 }"),
    "a product of a live and a dead state": ("n' = x*n - n\nx' = u - x - n", "x = {}\nn = { full = 1.0 }"),
    "a dead chain": ("n' = n*u - n\nm' = n - m\nx' = u - x - m", "x = {}\nn = { full = 1.0 }\nm = { full = 1.0 }"),
}


@pytest.mark.parametrize("name", DEAD)
def test_states_that_stay_at_zero_for_ever_are_refused(name: str) -> None:
    with pytest.raises(EmulatorError, match="no input acts on .*, which stays? at 0"):
        compile_program(equations_of(tomllib.loads(file_of(*DEAD[name]))))


ALIVE = {
    "a product with a constant": ("x' = u - x\nn' = (1 + n)*x - n", "x = {}\nn = {}"),
    "a table away from zero": (
        "x' = u - x\nn' = kick(n) - n",
        "x = {}\nn = {}",
        "[functions]\nkick = { points = [[-1, 1], [1, 2]] }",
    ),
}


@pytest.mark.parametrize("name", ALIVE)
def test_states_that_leave_zero_by_a_constant_compile(name: str) -> None:
    lines, states, *more = ALIVE[name]
    compile_program(equations_of(tomllib.loads(file_of(lines, states, more="".join(more)))))


@pytest.mark.parametrize("period_s", [2 * np.pi, 6 * np.pi, 5.0])
@pytest.mark.parametrize("damping", [0.01, 0.1, *map(heavy, (0.02, 0.05, 0.3))])
def test_a_lightly_damped_mode_builds_up_within_its_scale(damping: float, period_s: float) -> None:
    """Under a square wave of 0.5 the full scales hold the steady state, which the frequency response gives."""
    text = file_of(f"x' = v\nv' = u - {damping}*v - x", "x = {}\nv = {}", head=f"speed = 100\nperiod_s = {period_s}")
    program = compile_program(equations_of(tomllib.loads(text)))
    instants_s = np.linspace(0.0, period_s, 4001)
    orders = np.arange(1, 400, 2)[:, None]
    at = 2 * np.pi * orders / period_s
    waves = (2 / (np.pi * orders)) * np.exp(1j * at * instants_s) / (1 - at**2 + 1j * damping * at)
    for name, peak in (
        ("x", np.abs(waves.imag.sum(axis=0)).max()),
        ("v", np.abs((1j * at * waves).imag.sum(axis=0)).max()),
    ):
        assert program.scales.full(name) >= peak
