"""Strategies for hypothesis: plants, changes, excitations, noise, cards, computers, link faults, and whole scenarios.

Each strategy shrinks towards the usual case. Usual are the front suspension with its own parameters, one jump of the
stiffness, the square wave of the thesis, and the ideal card. A scenario that fails keeps only the parts that matter.
``detectable`` of analogrig.judging.information selects the changes that a device must detect.

Needs the extra ``analogrig[pytest]``.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from hypothesis import HealthCheck, Phase, assume, settings
from hypothesis import strategies as st

from analogrig.plant import Plant
from analogrig.program import Program
from analogrig.rigs.emulator import CardDescription, ComputerDescription, EmulatorDescription
from analogrig.scenario import DEFAULT_PROGRAM, Expectations, PotChange, Scenario
from analogrig.testing.plugin.hil_options import EXAMPLES, current_profile
from analogrig_emulator import Excitation, ProgramParameter

REACH = {"M": (35.0, 150.0), "K": (17_000.0, 29_000.0)}
DAMPING_RATIO = (0.4, 1.2)
"""The plants that the default device is held to, all of which the pots can show. Slower ones:
harness/docs/background/properties.md."""

WIDE_RANGES_V = {
    "force": (-1.0, 11.0),
    "displacement": (-1.0, 9.0),
    "velocity": (-10.0, 10.0),
    "net_force": (-12.5, 12.5),
}
"""Ranges of the card of the rig ``emulator``: they hold every signal."""

FIRST_CHANGE_N, BETWEEN_CHANGES_N = 700, 300
"""Samples before the first change, and between two: the default device is armed and has learned the plant."""

QUIET_N = 1300
"""Samples of a scenario in which nothing changes."""

MOST_DISPLACEMENT_V = 8.0
"""Largest displacement that a scenario may reach."""

for _name, _examples in EXAMPLES.items():
    settings.register_profile(
        f"analogrig-{_name}",
        max_examples=_examples,
        derandomize=_name == "ci",
        deadline=None,
        print_blob=_name != "ci",
        report_multiple_bugs=False,  # the files that are left are those of one
        phases=[Phase.explicit, Phase.reuse, Phase.generate, Phase.target, Phase.shrink],  # to explain takes minutes
        suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
    )


def profile(name: str = "") -> settings:
    """Settings of hypothesis for a property: 15 examples (``ci``, derandomised), 300 (``nightly``) or 5000 (``soak``).

    :param name: one of these profiles; empty: that of --hil-profile, in a session without the plugin that of the
        environment variable ANALOGRIG_HIL_PROFILE, else ``ci``.
    """
    return settings.get_profile(f"analogrig-{name or current_profile()}")


def _usually(usual: Any, others: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    """Strategy that shrinks to the usual value."""
    return st.one_of(st.just(usual), others)


@functools.cache
def _number(low: float, high: float, digits: int = 3) -> st.SearchStrategy[float]:
    """Evenly distributed numbers with few digits, so that a file shows them exactly."""
    step = 10.0 ** math.floor(math.log10(high) - digits + 1)
    return st.integers(math.ceil(low / step), math.floor(high / step)).map(lambda n: float(f"{n * step:.12g}"))


# ------------------------------------------------------------------------------------------------------ what is played


@functools.cache
def suspensions() -> st.SearchStrategy[Plant]:
    """Front suspensions with any mass, damping and stiffness that the pots can show."""
    front = _front().parameters()
    mass, stiffness = (_usually(front[name], _number(*REACH[name])) for name in ("M", "K"))
    return st.builds(_suspension, mass, stiffness, _usually(None, _number(*DAMPING_RATIO, 2)))


def plants(program: Program | str) -> st.SearchStrategy[Plant]:
    """Plants of a program with each parameter anywhere in its range; the usual ones are the program's own values."""
    program = Program.of(program, "program")
    drawn = {
        name: _usually(row.value, st.floats(row.low, row.high).map(_round).filter(_within(row)))
        for name, row in _ranged(program).items()
    }
    return st.fixed_dictionaries(drawn).map(lambda values: Plant.of(program, values))


def _ranged(program: Program) -> dict[str, ProgramParameter]:
    """Parameters whose pots have a range."""
    return {name: row for name, row in program.parameters.items() if row.low < row.high}


def _within(row: ProgramParameter) -> Callable[[float], bool]:
    return lambda value: row.low <= value <= row.high


def random_suspensions(count: int, seed: int) -> list[Plant]:
    """Random suspensions, drawn evenly: for statistics over plants, where hypothesis would look for the extreme."""
    rng = np.random.default_rng(seed)
    drawn = (rng.uniform(*ends, count).tolist() for ends in (REACH["M"], REACH["K"], DAMPING_RATIO))
    return [_suspension(_round(m), _round(k), zeta) for m, k, zeta in zip(*drawn, strict=True)]


@functools.cache
def _front() -> Plant:
    return Plant.of(Program.load(DEFAULT_PROGRAM))


def _suspension(mass_kg: float, stiffness_n_per_m: float, damping_ratio: float | None) -> Plant:
    """Suspension with these parameters; without a damping ratio, that of the front suspension."""
    front = _front()
    critical = 2.0 * math.sqrt(mass_kg * stiffness_n_per_m)
    damping = front.parameters()["B"] if damping_ratio is None else _round(damping_ratio * critical)
    if not DAMPING_RATIO[0] <= damping / critical <= DAMPING_RATIO[1]:
        damping = _round(0.8 * critical)
    return front.changed({"M": mass_kg, "B": damping, "K": stiffness_n_per_m})


def _round(value: float) -> float:
    return float(f"{value:.5g}")


def _within_reach(plant: Plant) -> bool:
    if plant.program != _front().program:
        values = plant.parameters()
        return all(_within(row)(values[name]) for name, row in _ranged(plant.program).items())
    ratio = _damping_ratio(plant)
    values = plant.parameters()
    return DAMPING_RATIO[0] <= ratio <= DAMPING_RATIO[1] and all(
        low <= values[name] <= high for name, (low, high) in REACH.items()
    )


def _damping_ratio(plant: Plant) -> float:
    mass_kg, damping, stiffness = plant.values
    return damping / (2.0 * math.sqrt(stiffness * mass_kg))


@st.composite
def changes(
    draw: st.DrawFn,
    plant: Plant | None = None,
    *,
    parameters: Sequence[str] = (),
    sizes: tuple[float, float] = (0.1, 0.3),
    at: st.SearchStrategy[int] | None = None,
    together: int = 1,
    longest_ramp_n: int = 0,
) -> PotChange:
    """Changes of the pots during a play.

    :param plant: the plant that changes, within the ranges of its program; None: the front suspension.
    :param parameters: names of those that may change; none: K, B and M of the front suspension, or all with a range.
    :param sizes: the least and the largest relative change, up or down as the pots allow.
    :param at: the sample; None: the first after the warm-up.
    :param together: so many parameters may change at once.
    :param longest_ramp_n: 0: only jumps.
    """
    changed = plant or _front()
    usual = ("K", "B", "M") if changed.program == _front().program else tuple(_ranged(changed.program))
    count = draw(st.integers(1, together))
    names = draw(st.lists(st.sampled_from(tuple(parameters) or usual), min_size=count, max_size=count, unique=True))
    for name in names:
        size = draw(_number(sizes[0], sizes[1], 2))
        ways = [changed.scaled(name, factor) for factor in (1.0 - size, 1.0 + size)]
        able = [way for way in ways if _within_reach(way)]
        assume(able)
        changed = draw(st.sampled_from(able))
    values = changed.parameters()
    turned = {name: _round(values[name]) for name in names}
    sample = FIRST_CHANGE_N if at is None else draw(at)
    return PotChange(sample, turned, draw(st.integers(0, longest_ramp_n)))


@functools.cache
def excitations(*, free: bool = False) -> st.SearchStrategy[Excitation]:
    """Two-level waveforms within the card's range, never longer than 10 ms without an edge; the usual is the thesis's
    square wave.

    :param free: also generators with a clock of their own, up to 20 ppm fast or slow.
    """
    clocks = (
        _usually(("card", 0.0), st.tuples(st.just("free"), _number(1.0, 20.0, 2))) if free else st.just(("card", 0.0))
    )
    return st.builds(
        _excitation,
        _usually("square", st.sampled_from(["pulse", "prbs"])),
        _usually((0.1, 9.9), st.tuples(_number(0.1, 2.0, 2), _number(7.0, 9.9, 2))),
        _usually(200.0, st.sampled_from([100.0, 125.0, 160.0, 250.0, 400.0])),
        _usually(0.0, _number(0.01, 0.99, 2)),
        clocks,
    )


def _excitation(
    shape: str, levels_v: tuple[float, float], frequency_hz: float, phase: float, clock: tuple[str, float]
) -> Excitation:
    """Excitation; a random sequence keeps its level for up to as many bits as its register has."""
    return Excitation(
        shape=shape,
        low_v=levels_v[0],
        high_v=levels_v[1],
        frequency_hz=4.0 * frequency_hz if shape == "prbs" else frequency_hz,
        phase=phase,
        duty=0.4 if shape == "pulse" else 0.5,
        clock=clock[0],
        drift_ppm=clock[1],
        register_length=4 if shape == "prbs" else 9,
    )


def _within_range(excitation: Excitation, plants: Sequence[Plant]) -> Excitation:
    """With its upper level so low that no displacement goes beyond the card's range. What undershoots it is missing.

    About the middle of the levels the displacement swings by at most half their difference, over K, times what the
    impulse response of such a plant adds up to in magnitude: coth(pi zeta / (2 sqrt(1 - zeta^2))).
    """
    scales = plants[0].program.circuit.scales
    n_per_v, volts_per_m = (
        scales.volts(name) ** power for name, power in zip(plants[0].program.measured, (-1, 1), strict=True)
    )
    low, high = excitation.low_v, excitation.high_v
    for plant in plants:
        v_per_v = n_per_v * volts_per_m / plant.parameters()["K"]
        zeta = _damping_ratio(plant)
        swing = 1.0 if zeta >= 1.0 else 1.0 / math.tanh(0.5 * math.pi * zeta / math.sqrt(1.0 - zeta * zeta))
        # low + high, over two, and (high - low) over two times the swing, are at most MOST_DISPLACEMENT_V together
        most = (2.0 * MOST_DISPLACEMENT_V / v_per_v + low * (swing - 1.0)) / (swing + 1.0)
        high = min(high, math.floor(10.0 * most) / 10.0)
    return dataclasses.replace(excitation, high_v=max(high, low))


# ---------------------------------------------------------------------------------------------------- on what it plays


def noise(most_lsb: float = 1.0) -> st.SearchStrategy[float]:
    """Noise of a card, rms in LSB; the default device is set for no more than 1."""
    return _usually(most_lsb, _number(0.1 * most_lsb, most_lsb, 2))


def cards(most_noise_lsb: float = 1.0) -> st.SearchStrategy[CardDescription]:
    """Cards with ranges that hold the signals: ideal, or with the faults of good ones."""
    faults = {
        "gain_error": st.lists(_number(1e-4, 2e-3, 2), min_size=4, max_size=4).map(tuple),
        "offset_lsb": st.lists(_number(0.1, 3.0, 2), min_size=4, max_size=4).map(tuple),
        "aperture_jitter_s": st.just(1e-9),
    }
    return st.builds(
        CardDescription,
        range_v=st.just(WIDE_RANGES_V),
        noise_lsb=noise(most_noise_lsb),
        faults=_usually({}, st.fixed_dictionaries({}, optional=faults)),
    )


def computers() -> st.SearchStrategy[ComputerDescription]:
    """Machines of ideal or real amplifiers, whose offsets, and whose components, the seed draws."""
    return st.builds(
        ComputerDescription,
        op_amp=_usually("tl07x", st.sampled_from(["ideal", "opa627"])),
        offset_v=_usually(0.0, _number(1e-3, 3e-3, 2)),
        components=_usually("nominal", st.just("polypropylene")),
    )


def rigs(most_noise_lsb: float = 1.0) -> st.SearchStrategy[EmulatorDescription]:
    """Emulated computers with their cards."""
    return st.builds(EmulatorDescription, card=cards(most_noise_lsb), computer=computers(), name=st.just("drawn"))


def seeds() -> st.SearchStrategy[int]:
    """Seeds of all random parts of a play."""
    return st.integers(0, 2**31 - 1)


def link_faults(kinds: Sequence[str] | None = None, most: int = 3) -> st.SearchStrategy[str]:
    """Link faults in the syntax of ``--wire-faults``; shrinks to a line without faults."""
    from analogrig.links.wire_faults import FaultyWire

    where = st.one_of(
        st.builds("{}:{}".format, st.sampled_from(["to", "from"]), st.integers(0, 400)),
        _number(0.001, 0.02, 2).map("{:g}".format),
    )
    fault = st.builds("{}@{}".format, st.sampled_from(sorted(kinds or FaultyWire.KINDS)), where)
    return st.lists(fault, max_size=most, unique_by=lambda text: text.partition("@")[0]).flatmap(
        lambda faults: seeds().map(lambda seed: ",".join([*faults, f"seed={seed}"]) if faults else "")
    )


# ----------------------------------------------------------------------------------------------------------- scenarios


@st.composite
def scenarios(
    draw: st.DrawFn,
    *,
    most_changes: int = 2,
    sizes: tuple[float, float] = (0.1, 0.3),
    together: int = 1,
    longest_ramp_n: int = 0,
    free: bool = False,
    expect: Expectations | None = None,
    program: Program | str | None = None,
) -> Scenario:
    """Scenarios: a plant, an excitation, and changes with time to learn in between.

    ``detectable`` selects the changes that can be seen.

    :param program: program of the plant, excited by the square wave of its trial play; None: the front suspension,
        with any of ``excitations``.
    """
    plant = draw(suspensions() if program is None else plants(program))
    excitation = draw(excitations(free=free)) if program is None else Scenario.of_program(program).excitation
    drawn: list[PotChange] = []
    sample, now, passed = FIRST_CHANGE_N, plant, [plant]
    for _ in range(draw(st.integers(min(1, most_changes), most_changes))):
        sample += draw(st.integers(0, 60))
        change = draw(changes(now, sizes=sizes, at=st.just(sample), together=together, longest_ramp_n=longest_ramp_n))
        drawn.append(change)
        now = now.changed(change.set)
        passed.append(now)
        sample += change.ramp_n + BETWEEN_CHANGES_N
    return Scenario(
        samples=sample if drawn else QUIET_N,
        excitation=_within_range(excitation, passed) if program is None else excitation,
        program=plant.program,
        set=plant.overrides,
        changes=tuple(drawn),
        expect=expect or Expectations(),
        name="drawn",
    )
