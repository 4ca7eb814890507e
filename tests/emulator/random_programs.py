"""Random programs of two to six states as text of program files: linear terms, products, limits, dead zones, tables.

The seed selects the family and draws the rest. In turn: general terms, masses with backlash, relaxation oscillators,
saturating control loops, chaotic flows, friction, and stops.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

CURVES = (
    "[[-1, -0.5], [-0.1, 0], [0.1, 0.02], [1, 1.3]]",
    "[[-0.5, -1.5], [-0.2, -0.2], [0, 0], [0.3, 0.3], [0.6, 1.5]]",
    "[[-1, -0.7], [-0.3, -0.6], [0.2, 0], [0.5, 0.7]]",
)
"""Points of the functions: they ascend, and continue beyond their ends."""

REFUSED = (18, 60, 151, 165)
"""Seeds of chaotic flows that errors of real parts drive to infinity: the compiler refuses them."""


class _Draw:
    """Equations under construction. level: trial levels of the input u are level and its negative half."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.lines: list[str] = []
        self.states: list[str] = []
        self.signals: list[str] = []
        self.values: dict[str, float] = {}
        self.curve = str(rng.choice(CURVES))
        self.speeds: tuple[int, ...] = (500, 1000, 2000)
        self.level = 1.0

    def parameter(self, low: float, high: float) -> str:
        """New parameter with a value from low to high."""
        name = f"p{len(self.values)}"
        self.values[name] = float(f"{self.rng.uniform(low, high):.4g}")
        return name

    def pick(self, *choices: str) -> str:
        """One of the choices."""
        return str(self.rng.choice(choices))

    def state(self, name: str, slope: str) -> str:
        """New state with its derivative."""
        self.lines.append(f"{name}' = {slope}")
        self.states.append(name)
        return name

    def signal(self, name: str, formula: str) -> str:
        """New signal."""
        self.lines.append(f"{name} = {formula}")
        self.signals.append(name)
        return name

    def limited(self, of: str, low: float, high: float) -> str:
        """Saturation at a drawn limit."""
        limit = self.parameter(low, high)
        return f"max(-{limit}, min({limit}, {of}))"

    def dead_zone(self, of: str, low: float, high: float) -> str:
        """Excess over a drawn half width."""
        half = self.parameter(low, high)
        return f"(max(0, {of} - {half}) + min(0, {of} + {half}))"

    def followers(self, of: str, most: int) -> None:
        """Append up to `most` states that follow one quantity, straight, limited or through the curve."""
        for _ in range(int(self.rng.integers(0, most + 1))):
            forms = (of, f"abs({of})", f"curve({of})", self.limited(of, 0.1, 0.4), self.dead_zone(of, 0.05, 0.2))
            name = f"f{len(self.states)}"
            of = self.state(name, f"{self.parameter(0.5, 3.0)}*({self.pick(*forms)} - {name})")


def _general(draw: _Draw) -> None:
    """Stable linear part and random non-linear terms."""
    rng, parameter = draw.rng, draw.parameter
    states = [f"x{i}" for i in range(int(rng.integers(2, 7)))]

    def nonlinear() -> str:
        a, b = draw.pick(*states), draw.pick(*states)
        return draw.pick(
            f"{a}*{b}",
            f"{a}**3",
            f"max(0, {a} - {parameter(0.05, 0.2)})",
            f"abs({a})",
            f"min({a}, {b})",
            f"{a}/({parameter(1.5, 2.5)} + {b}**2)",
            f"sqrt({parameter(0.5, 1.0)} + {a}**2)",
            f"curve({a})",
            draw.dead_zone(a, 0.05, 0.2),
            draw.limited(f"{a} - {b}", 0.05, 0.3),
        )

    for state in states:
        terms = [f"{parameter(0.05, 0.3)}*{draw.pick(*states)}", f"{parameter(0.3, 1.0)}*u"]
        terms += [f"{parameter(0.05, 0.3)}*{nonlinear()}" for _ in range(rng.integers(0, 3))]
        body = " ".join(f"{draw.pick('+', '-')} {term}" for term in terms)
        body = f"-{parameter(1.0, 2.0)}*{state} {body}"
        draw.state(state, f"({body}) / {parameter(0.5, 2.0)}" if rng.random() < 0.5 else body)


def _backlash(draw: _Draw) -> None:
    """Two masses that meet across a gap; the first one on a spring, perhaps behind an actuator."""
    parameter = draw.parameter
    drive = "u"
    if draw.rng.random() < 0.6:
        drive = draw.state("a", f"{parameter(2.0, 6.0)}*({draw.limited('u', 0.5, 0.9)} - a)")
    draw.signal("gap", "x - y")
    draw.signal("force", f"{parameter(5.0, 60.0)}*{draw.dead_zone('gap', 0.02, 0.15)}")
    spring = draw.pick("x", "curve(x)")
    draw.state("x", "vx")
    draw.state("vx", f"{drive} - {parameter(0.3, 1.2)}*vx - {parameter(0.5, 2.0)}*{spring} - force")
    draw.state("y", "vy")
    held = draw.pick("", f" - {parameter(0.2, 1.0)}*y")
    draw.state("vy", f"{parameter(0.5, 2.0)}*force - {parameter(0.2, 0.8)}*vy{held}")


def _relaxation(draw: _Draw) -> None:
    """Stiff oscillator: a cubic or a curve in straight pieces, with a slow recovery, and states that follow."""
    parameter = draw.parameter
    cubic = draw.pick("v - v**3/3", "3*max(-1, min(1, v)) - 2*v", "v*(1 - 0.33*v**2)")
    draw.state("v", f"{parameter(1.0, 12.0)}*({cubic} - w + u)")
    draw.state("w", f"(v + {parameter(0.5, 0.8)} - {parameter(0.6, 0.9)}*w) / {parameter(5.0, 15.0)}")
    draw.followers("v", 3)


def _loop(draw: _Draw) -> None:
    """Controller with a saturated actuator around a plant of first or second order."""
    parameter = draw.parameter
    draw.signal("e", "u - x")
    windup = f" - {parameter(0.5, 2.0)}*(c - s)"
    draw.lines.append(f"s = {draw.limited('c', 0.6, 1.5)}")
    draw.lines.append(f"c = {parameter(1.0, 5.0)}*e + i - {parameter(0.1, 0.6)}*r")
    draw.signals += ["s", "c"]
    draw.state("i", f"{parameter(0.3, 1.5)}*e{draw.pick('', windup)}")
    draw.state("a", f"{parameter(2.0, 10.0)}*(s - a)")
    friction = draw.pick("", f" - {parameter(0.05, 0.2)}*r*abs(r)", f" - {parameter(0.05, 0.2)}*x**3")
    draw.state("x", "r")
    draw.state("r", f"{parameter(0.8, 2.0)}*a - {parameter(0.5, 1.5)}*r - {parameter(0.3, 1.0)}*x{friction}")
    draw.followers("x", 2)


def _chaotic(draw: _Draw) -> None:
    """Flow with two products or a cubic, driven."""
    parameter = draw.parameter
    flow = draw.pick("lorenz", "roessler", "duffing", "chua")
    if flow == "lorenz":
        draw.speeds, draw.level = (50, 100), 8.0
        draw.state("x", f"{parameter(8.0, 11.0)}*(y - x) + u")
        draw.state("y", f"{parameter(24.0, 30.0)}*x - y - x*z")
        draw.state("z", f"x*y - {parameter(2.2, 3.0)}*z")
    elif flow == "roessler":
        draw.speeds, draw.level = (400, 800), 1.5
        draw.state("x", "-y - z + u")
        draw.state("y", f"x + {parameter(0.1, 0.2)}*y")
        draw.state("z", f"{parameter(0.15, 0.3)} + z*(x - {parameter(4.5, 5.5)})")
    elif flow == "duffing":
        draw.state("x", "y")
        draw.state("y", f"{parameter(0.8, 1.2)}*x - {parameter(0.8, 1.2)}*x**3 - {parameter(0.1, 0.3)}*y + 0.5*u")
    else:
        draw.speeds = (300, 600)
        draw.signal("g", f"{parameter(0.65, 0.72)}*x - {parameter(0.2, 0.24)}*(abs(x + 1) - abs(x - 1))")
        draw.state("x", f"{parameter(8.0, 9.5)}*(y - x - g) + u")
        draw.state("y", "x - y + z")
        draw.state("z", f"-{parameter(14.0, 16.0)}*y")
    draw.followers("x", 2)


def _friction(draw: _Draw) -> None:
    """Motor with steep dry friction, perhaps behind a shaft that twists."""
    parameter = draw.parameter
    sharp = draw.rng.choice([5.0, 20.0, 60.0])
    dry = f"{parameter(0.15, 0.4)}*max(-1, min(1, {parameter(0.8 * sharp, 1.2 * sharp)}*w))"
    is_stiff = draw.rng.random() < 0.5
    speed = "w" if is_stiff else "m"
    draw.state("i", f"{parameter(3.0, 10.0)}*(u - {parameter(0.8, 1.2)}*i - {parameter(0.3, 0.6)}*{speed})")
    if is_stiff:
        draw.state("w", f"{parameter(0.8, 1.5)}*i - {parameter(0.05, 0.2)}*w - {dry}")
        draw.followers("w", 3)
        return
    draw.state("twist", "m - w")
    draw.state("m", f"{parameter(1.5, 3.0)}*i - {parameter(0.1, 0.4)}*m - {parameter(4.0, 15.0)}*twist")
    draw.state("w", f"{parameter(4.0, 15.0)}*twist - {parameter(0.05, 0.2)}*w - {dry}")


def _stops(draw: _Draw) -> None:
    """Mass between stiff stops of one or both sides, with a damper of another law."""
    draw.speeds, parameter = (300, 600), draw.parameter
    upper = f" - {parameter(20.0, 80.0)}*max(0, x - {parameter(0.1, 0.3)})"
    lower = f" - {parameter(20.0, 80.0)}*min(0, x + {parameter(0.1, 0.3)})"
    damper = draw.pick("v", "v*abs(v)", "curve(v)", "(v + v**3)")
    draw.state("x", "v")
    force = f"{parameter(0.5, 2.0)}*x - {parameter(0.2, 0.8)}*{damper}"
    draw.state("v", f"{parameter(0.8, 1.5)}*u - {force}{upper}{draw.pick('', lower)}")
    if draw.rng.random() < 0.4:
        draw.state("y", "r")
        draw.state("r", f"{parameter(2.0, 6.0)}*x - {parameter(2.0, 6.0)}*y - {parameter(0.2, 0.6)}*r")
    draw.followers("x", 2)


FAMILIES: tuple[Callable[[_Draw], None], ...] = (
    _general,
    _backlash,
    _relaxation,
    _loop,
    _chaotic,
    _friction,
    _stops,
)
"""Families in the order of the seeds."""


def random_program(seed: int) -> str:
    """File of the program of a seed."""
    rng = np.random.default_rng(seed)
    draw = _Draw(rng)
    FAMILIES[seed % len(FAMILIES)](draw)
    text = "\n".join(draw.lines)
    words = set(text.translate(str.maketrans("()*/+-,='", "         ")).split())
    rows = [
        f"{name} = {{ value = {value}, range = [{value * 0.9}, {value * 1.1}] }}"
        for name, value in draw.values.items()
        if name in words
    ]
    curve = f"\n[functions]\ncurve = {{ points = {draw.curve} }}\n" if "curve" in words else ""
    signals = "".join(f"{signal} = {{}}\n" for signal in draw.signals)
    return (
        f'name = "random-{seed}"\nspeed = {rng.choice(draw.speeds)}\nperiod_s = 20.0\n'
        f"equations = '''\n{text}\n'''\n[inputs]\n"
        f"u = {{ full = {draw.level}, trial = [{-0.5 * draw.level}, {draw.level}] }}\n[states]\n"
        + "".join(f"{state} = {{}}\n" for state in draw.states)
        + (f"[signals]\n{signals}" if signals else "")
        + "[parameters]\n"
        + "\n".join(rows)
        + curve
    )
