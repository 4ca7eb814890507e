"""Random programs: two to six states, linear and not, as text of program files."""

from __future__ import annotations

import re

import numpy as np


def random_program(seed: int) -> str:
    """File of a program with a stable linear part and random non-linear terms."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 7))
    states = [f"x{i}" for i in range(count)]
    parameters: dict[str, float] = {}

    def parameter(low: float, high: float) -> str:
        name = f"p{len(parameters)}"
        parameters[name] = float(np.round(rng.uniform(low, high), 4))
        return name

    def one() -> str:
        return str(rng.choice(states))

    def nonlinear() -> str:
        a, b = one(), one()
        forms = (
            f"{a}*{b}",
            f"{a}**3",
            f"max(0, {a} - {parameter(0.05, 0.2)})",
            f"abs({a})",
            f"min({a}, {b})",
            f"{a}/({parameter(1.5, 2.5)} + {b}**2)",
            f"sqrt({parameter(0.5, 1.0)} + {a}**2)",
            f"curve({a})",
        )
        return str(rng.choice(forms))

    lines = []
    for state in states:
        terms = [f"{parameter(0.05, 0.3)}*{rng.choice(states)}", f"{parameter(0.3, 1.0)}*u"]
        terms += [f"{parameter(0.05, 0.3)}*{nonlinear()}" for _ in range(rng.integers(0, 3))]
        signs = rng.choice(["+", "-"], len(terms))
        body = f"-{parameter(1.0, 2.0)}*{state} " + " ".join(f"{s} {t}" for s, t in zip(signs, terms, strict=True))
        lines.append(f"{state}' = ({body}) / {parameter(0.5, 2.0)}" if rng.random() < 0.5 else f"{state}' = {body}")
    text = "\n".join(lines)
    used = {name: parameters[name] for name in dict.fromkeys(re.findall(r"\bp\d+\b", text))}
    rows = [f"{name} = {{ value = {value}, range = [{value * 0.9}, {value * 1.1}] }}" for name, value in used.items()]
    curve = (
        "\n[functions]\ncurve = { points = [[-1, -0.5], [-0.1, 0], [0.1, 0.02], [1, 1.3]] }\n"
        if "curve(" in text
        else ""
    )
    return (
        f'name = "random-{seed}"\nspeed = {rng.choice([500, 1000, 2000])}\nperiod_s = 20.0\n'
        f"equations = '''\n{text}\n'''\n[inputs]\nu = {{ full = 1.0, trial = [-0.5, 1.0] }}\n[states]\n"
        + "".join(f"{state} = {{}}\n" for state in states)
        + "[parameters]\n"
        + "\n".join(rows)
        + curve
    )
