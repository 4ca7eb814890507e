"""Trials of dating: pot changes at unknown instants, on emulated machines of real components."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from analogrig import config
from analogrig.judging.isolation import ISOLATION_INFORMATION
from analogrig.plant import Plant, SampledPlant
from analogrig.rigs.emulator import EmulatorDescription, EmulatorRig
from analogrig.rigs.rig import Rig
from analogrig.scenario import PotChange, Scenario
from analogrig_emulator import Excitation
from analogrig_instruments.by_hand import PlannedChange
from analogrig_instruments.dating.instants import Instant, NoInstant, TurnInstants, date_jump, date_turn
from analogrig_instruments.dating.two_filter import Signals

from .plants import front

FRONT = front()

PARAMETERS = tuple(FRONT.parameters())

Clock = Literal["card", "free"]

LARGEST_UP = {"M": 0.5, "B": 0.3, "K": 0.15}
"""Largest relative increases within the range of each pot; a decrease by half is always within it."""

QUIET_N = 900
"""Samples before the first instant of a change."""


@functools.cache
def machines() -> EmulatorRig:
    """Rig whose seed draws polyester capacitors, 1 % resistors and amplifiers of the grade; noise of 1 LSB."""
    table = config.read_toml(config.locate("rigs", "emulator"))
    described = config.build(EmulatorDescription, {"name": "polyester", **table}, "emulator")
    computer = dataclasses.replace(described.computer, components="polyester")
    return EmulatorRig(dataclasses.replace(described, computer=computer))


def play(scenario: Scenario, seed: int, rig: Rig | None = None) -> Signals:
    """Samples of a scenario on one of the machines, or on another rig."""
    performance = (rig or machines()).perform(scenario, seed)
    blocks = list(performance.blocks)
    codes, clipped = (np.concatenate([getattr(block, name) for block in blocks]) for name in ("codes", "clipped"))
    return Signals.of(codes, clipped, performance.channels, performance.sample_period_s * performance.time_scale)


def scenario_of(
    samples: int, clock: Clock, frequency_hz: float, plant: Plant = FRONT, sample: int = 0, ramp_n: int = 0
) -> Scenario:
    """Scenario of the front suspension, which becomes ``plant`` at a sample."""
    changes = (change_of(sample, FRONT, plant, ramp_n),) if plant != FRONT else ()
    return Scenario(samples, square(clock, frequency_hz, 9.9), random_phase=True, changes=changes, name="onset")


def square(clock: Clock, frequency_hz: float, high_v: float) -> Excitation:
    drift_ppm = 20.0 if clock == "free" else 0.0
    return Excitation(low_v=0.1, high_v=high_v, frequency_hz=frequency_hz, clock=clock, drift_ppm=drift_ppm)


def change_of(sample: int, before: Plant, after: Plant, ramp_n: int = 0) -> PotChange:
    return PotChange(sample, {name: new for name, (_, new) in before.changes_to(after).items()}, ramp_n)


def change_front(rng: np.random.Generator, least: float, most: float, together: int) -> Plant:
    """Front suspension with ``together`` of M, B, K changed, by factors from 1 +- least to 1 +- most."""
    plant = FRONT
    for name in rng.choice(PARAMETERS, size=together, replace=False).tolist():
        size = math.exp(rng.uniform(math.log(least), math.log(most)))
        up = rng.uniform() < 0.5 and size <= LARGEST_UP[name]
        plant = plant.scaled(name, 1.0 + size if up else 1.0 - size)
    return plant


@dataclass(frozen=True, eq=False)
class Trial:
    """Change of the front suspension at an instant that the search is not given."""

    signals: Signals
    after: Plant
    sample: int
    ramp_n: int
    search: range
    known: bool
    """True if the search is given the plant after the change."""

    @classmethod
    def jump(cls, seed: int, clock: Clock) -> Trial:
        """Change of one or two parameters by 5 to 50 %, in a range of 600 samples.

        Edges come every 50 or 100 samples; the plant after the change is given in five of six trials.
        """
        rng = np.random.default_rng([9, seed])
        after = change_front(rng, 0.05, 0.5, together=int(rng.integers(1, 3)))
        sample = QUIET_N + int(rng.integers(200))
        first = sample - int(rng.integers(50, 550))
        scenario = scenario_of(2200, clock, float(rng.choice([100.0, 200.0])), after, sample)
        return cls(play(scenario, seed), after, sample, 0, range(first, first + 600), bool(rng.uniform() < 5.0 / 6.0))

    @classmethod
    def ramp(cls, seed: int, clock: Clock) -> Trial:
        """Change of one parameter by 10 to 50 % within 20 to 600 samples, 50 to 300 samples inside the range."""
        rng = np.random.default_rng([10, seed])
        after = change_front(rng, 0.1, 0.5, together=1)
        sample, ramp_n = QUIET_N + int(rng.integers(200)), int(math.exp(rng.uniform(math.log(20.0), math.log(600.0))))
        search = range(sample - int(rng.integers(50, 300)), sample + ramp_n + int(rng.integers(50, 300)))
        scenario = scenario_of(3000, clock, 200.0, after, sample, ramp_n)
        return cls(play(scenario, seed), after, sample, ramp_n, search, known=True)

    def date_jump(self) -> Instant | NoInstant:
        return date_jump(self.signals, FRONT, self.after if self.known else None, self.search)

    def date_turn(self) -> TurnInstants | NoInstant:
        return date_turn(self.signals, FRONT, self.after if self.known else None, self.search)

    def width_bound(self) -> int:
        """Number of instants that no method separates from the true one with 95 % confidence.

        The information between the courses of the displacement is below ln 20, as in analogrig.judging.isolation.
        """
        first = max(0, self.sample - 400)
        samples = np.arange(max(self.search.start, self.sample - 120), min(self.search.stop, self.sample + 120))
        courses_m = self._courses(first, samples)
        true_m = courses_m[samples == self.sample]
        gathered = ((courses_m - true_m) ** 2).sum(axis=1) / (2.0 * self.signals.noise_m**2)
        return int((gathered < ISOLATION_INFORMATION).sum())

    def _courses(self, first: int, samples: NDArray[np.int64]) -> NDArray[np.float64]:
        """(m, 800) displacement in metres from sample ``first`` on, for a change at each of ``samples`` (m,)."""
        before, after = (SampledPlant.from_plant(plant, self.signals.period_s) for plant in (FRONT, self.after))
        x, v = np.zeros(len(samples)), np.zeros(len(samples))
        out = []
        for k, force in enumerate(self.signals.force_n[first : first + 800].tolist(), start=first):
            out.append(x)
            (xa, va), (xb, vb) = (_next(plant, x, v, force) for plant in (before, after))
            changed = k >= samples
            x, v = np.where(changed, xb, xa), np.where(changed, vb, va)
        return np.array(out).T


@dataclass(frozen=True, eq=False)
class Several:
    """Several changes of one record at known samples."""

    signals: Signals
    changes: tuple[PlannedChange, ...]

    @classmethod
    def of(cls, seed: int, clock: Clock, rig: Rig | None = None) -> Several:
        """Eight changes, 150 to 600 samples apart: one of M, B, K by 5 to 74 %, and back.

        The force overloads no amplifier where K is least.
        """
        rng = np.random.default_rng([12, seed])
        away = [change_front(rng, 0.05, 0.74, together=1) for _ in range(4)]
        plants = [FRONT, *(plant for each in away for plant in (each, FRONT))]
        instants = 600 + np.append(0, np.cumsum(rng.integers(150, 600, size=8)))
        pairs = list(zip(instants.tolist(), plants, plants[1:], strict=False))
        softest = min(1.0, *(plant.parameters()["K"] / FRONT.parameters()["K"] for plant in away))
        scenario = Scenario(
            samples=int(instants[-1]),
            excitation=square(clock, float(rng.choice([100.0, 200.0])), 9.0 * softest),
            random_phase=True,
            changes=tuple(change_of(*pair) for pair in pairs),
            name="several",
        )
        return cls(play(scenario, seed, rig), tuple(PlannedChange(sample, {}, *both) for sample, *both in pairs))

    def stretches(self) -> Iterator[tuple[PlannedChange, range]]:
        """Each change with the samples between its neighbours."""
        starts = [change.sample for change in self.changes]
        for change, before, after in zip(self.changes, [0, *starts], [*starts[1:], len(self.signals)], strict=False):
            yield change, range(before + 1, after)


def _next(
    plant: SampledPlant, x: NDArray[np.float64], v: NDArray[np.float64], force_n: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return SampledPlant.next for many states."""
    (xx, xv), (vx, vv) = plant.transition
    xf, vf = plant.response
    return xx * x + xv * v + xf * force_n, vx * x + vv * v + vf * force_n


def still(seed: int, clock: Clock) -> Trial:
    """Trial without a change, although a pot was to turn."""
    rng = np.random.default_rng([11, seed])
    signals = play(scenario_of(2200, clock, 200.0), seed)
    return Trial(
        signals, change_front(rng, 0.05, 0.5, together=1), 0, 0, range(800, 1400), bool(rng.uniform() < 5.0 / 6.0)
    )
