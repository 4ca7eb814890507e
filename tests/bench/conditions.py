"""Conditions under which ``bench_reality`` plays the shipped device: plant, excitation, card and disturbances.

The circuit emulator and its sampler play a condition. Where they cannot, ``Simulated`` integrates the equation of the
plant, and the table marks the row.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from analogrig_emulator import CARDS, COMPONENTS, NOMINAL, OP_AMP_GRADES, Card, Components, drawn_levels
from tests.emulator.programs import program_of

from .disturbances import (
    backlash,
    drift,
    heavy_tails,
    hum,
    impulses,
    missing,
    popcorn,
    proportional_noise,
    rising_noise,
    warming,
)
from .emulated import Emulated
from .played import CARD, DISPLACEMENT, FORCE, Change, Played
from .simulated import Simulated
from .waveforms import continuous, multisine, pulse, random_bits, random_instants, sine, square, sweep


@dataclass(frozen=True)
class Condition:
    """Row of the table."""

    name: str
    text: str
    source: Emulated | Simulated
    kinds: tuple[str, ...] = ()
    """Kinds of misfit that describe the condition; empty if the model of the device fits it."""
    horizon_n: int = 300
    """Samples after a change; without an alarm in these it is missed."""
    tolerated: tuple[str, ...] = ()
    """Kinds of misfit that a device may report although its model fits: it need not serve the condition."""

    @property
    def fits(self) -> bool:
        """True if the model of the device describes the condition."""
        return not self.kinds

    @property
    def right_kinds(self) -> tuple[str, ...]:
        """Kinds of misfit that may be reported."""
        return self.kinds + self.tolerated

    def play(self, seeds: Sequence[int], samples: int, changes: Sequence[Change | None]) -> Iterator[Played]:
        """Runs of so many samples from rest, one for each seed, with its change."""
        return self.source.play(seeds, samples, changes)


def noisy(lsb: float, card: Card = CARD) -> Card:
    """The card with this noise on all channels."""
    return dataclasses.replace(card, noise_lsb=(lsb,) * card.channels)


def _noisy_force(lsb: float) -> Card:
    """The card with this noise on the force."""
    noise_lsb = list(CARD.noise_lsb)
    noise_lsb[FORCE] = lsb
    return dataclasses.replace(CARD, noise_lsb=tuple(noise_lsb))


def at_rate(rate_hz: float) -> Card:
    """The card at another rate."""
    return dataclasses.replace(CARD, rate_hz=rate_hz)


def doubled(card: Card = CARD) -> Card:
    """The card with one bit more and twice the range: the same LSB, and room for a drift."""
    wider = tuple((low, low + 2.0 * (high - low)) for low, high in card.ranges_v)
    return dataclasses.replace(card, bits=card.bits + 1, ranges_v=wider)


def slower(factor: float) -> Callable[[int], Components]:
    """Capacitors of both integrators so many times the nominal ones."""
    slow = dataclasses.replace(NOMINAL, given={"C1": factor - 1.0, "C2": factor - 1.0})
    return lambda seed: slow  # noqa: ARG005


def real_parts(seed: int) -> Components:
    """Parts of the shipped rig ``emulator-real``, drawn from the seed."""
    grade = OP_AMP_GRADES["tl07x"]
    return dataclasses.replace(COMPONENTS["polypropylene"], temperature_c=40.0, op_amps=grade, seed=seed)


def _real_card() -> Card:
    return dataclasses.replace(CARDS["dt2821"], ranges_v=((-10.0, 10.0),) * 4)


def _skewed_card() -> Card:
    return dataclasses.replace(CARDS["skewed"], ranges_v=CARD.ranges_v, noise_lsb=CARD.noise_lsb)


def _bent_card() -> Card:
    return dataclasses.replace(CARD, levels_lsb=drawn_levels(12, np.random.default_rng(21), inl_lsb=2.0))


def _ranged(low_v: float, high_v: float) -> Card:
    """The card with this range of the displacement."""
    return dataclasses.replace(CARD, ranges_v=(CARD.ranges_v[0], (low_v, high_v), *CARD.ranges_v[2:]))


SQUARE = square()

TWO_MASS, BUMP_STOP = program_of("two-mass"), program_of("bump-stop")

SLOW = ("slow-plant",)

ISSUE: Sequence[Condition] = (
    Condition("nominal", "shipped rig, 12 bits, noise of 1 LSB", Emulated(SQUARE)),
    Condition("noise-2", "noise of 2 LSB", Emulated(SQUARE, noisy(2.0)), tolerated=("noise",)),
    Condition("noise-4", "noise of 4 LSB", Emulated(SQUARE, noisy(4.0)), tolerated=("noise",)),
    Condition("bits-16", "16 bits", Emulated(SQUARE, dataclasses.replace(CARD, bits=16))),
    Condition("slow-3", "plant 3 times slower", Emulated(SQUARE, components=slower(3.0)), tolerated=SLOW),
    Condition("slow-10", "plant 10 times slower", Emulated(SQUARE, components=slower(10.0)), tolerated=SLOW),
    Condition(
        "slow-3-67hz",
        "plant 3 times slower, excitation of 67 Hz",
        Emulated(square(200.0 / 3.0), components=slower(3.0)),
        horizon_n=900,
        tolerated=SLOW,
    ),
    Condition(
        "slow-10-20hz",
        "plant 10 times slower, excitation of 20 Hz",
        Emulated(square(20.0), components=slower(10.0)),
        horizon_n=3000,
        tolerated=SLOW,
    ),
    *(
        Condition(
            f"card-{rate_khz}k",
            f"card at {rate_khz} kHz",
            Emulated(SQUARE, at_rate(1e3 * rate_khz)),
            horizon_n=n,
            tolerated=SLOW,
        )
        for rate_khz, n in ((40, 600), (60, 900), (100, 1500))
    ),
    Condition("ppm-100", "generator on a clock of its own, 100 ppm", Emulated(square(ppm=100.0)), ("edges",)),
    Condition("190hz", "generator on a clock of its own, 190 Hz", Emulated(square(190.0, ppm=0.0)), ("edges",)),
    Condition("any-instants", "edges at random instants", Emulated(random_instants), ("edges",)),
    *(
        Condition(
            f"hum-{n}", f"hum of {n} LSB at 50 Hz on the displacement", Emulated(SQUARE, disturb=hum(n)), ("hum",)
        )
        for n in (1, 3, 10)
    ),
    Condition(
        "drift-.01",
        "displacement drifts 0.01 code a sample",
        Emulated(SQUARE, doubled(), disturb=drift(0.01)),
        ("drift",),
    ),
    Condition(
        "drift-.1", "displacement drifts 0.1 code a sample", Emulated(SQUARE, doubled(), disturb=drift(0.1)), ("drift",)
    ),
    Condition("ar-.9", "autoregressive noise, 0.9, 1 LSB", Emulated(SQUARE, correlation=0.9), ("noise",)),
    *(
        Condition(f"cubic-{percent:g}", f"cubic spring of {percent:g} %", Simulated(percent / 100.0), ("nonlinear",))
        for percent in (0.3, 1.0, 5.0, 20.0)
    ),
    Condition("small", "excitation of 3 % of the range", Emulated(square(part_of_range=0.03)), ("excitation",)),
    Condition("sine", "sine of 200 Hz", Emulated(continuous(sine)), ("excitation",)),
    Condition("sweep", "sweep from 20 to 1,000 Hz", Emulated(continuous(sweep))),
    Condition("multisine", "odd multisine to 950 Hz", Emulated(continuous(multisine))),
    Condition("missing-5", "5 % of the samples are missing", Emulated(SQUARE, arrives=missing(0.05))),
    Condition("missing-20", "20 % of the samples are missing", Emulated(SQUARE, arrives=missing(0.2))),
)
"""Conditions that the requirement names."""

OWN: Sequence[Condition] = (
    Condition("ppm-20", "generator on a clock of its own, 20 ppm", Emulated(square(ppm=20.0))),
    Condition("ppm-200", "generator on a clock of its own, 200 ppm", Emulated(square(ppm=200.0)), ("edges",)),
    Condition("bits-10", "10 bits", Emulated(SQUARE, dataclasses.replace(CARD, bits=10))),
    Condition("bits-18", "18 bits", Simulated(bits=18)),
    Condition("fast", "plant with a pole of 0.3, card at 2.2 kHz", Emulated(square(21.8), at_rate(2180.0))),
    Condition("pulse", "pulses, high for a fifth of the period", Emulated(pulse)),
    Condition("prbs", "pseudorandom binary sequence, bits of 25 samples", Emulated(random_bits)),
    Condition(
        "dac-5",
        "sine of 200 Hz in steps of a 5-bit generator",
        Emulated(continuous(sine, steps=1, levels=32)),
        ("excitation",),
    ),
    Condition("inl", "converter with INL of 2 LSB", Emulated(SQUARE, _bent_card()), ("nonlinear",)),
    Condition(
        "force-noise", "noise of 4 LSB on the force alone", Emulated(SQUARE, _noisy_force(4.0)), tolerated=("noise",)
    ),
    Condition(
        "real",
        "real parts 15 K too warm, DT2821 card",
        Emulated(SQUARE, _real_card(), components=real_parts),
        tolerated=("nonlinear",),
    ),
    Condition("skewed", "displacement taken 10 us after force", Emulated(SQUARE, _skewed_card())),
    Condition(
        "jitter",
        "aperture jitter of 0.5 us",
        Emulated(SQUARE, dataclasses.replace(CARD, aperture_jitter_s=5e-7)),
        ("noise",),
    ),
    Condition("warming", "K falls by 2 % in 10,000 samples", Emulated(SQUARE, wander=warming(-0.02)), ("drift",)),
    Condition("two-mass", "suspension on its tyre, four poles", Emulated(SQUARE, program=TWO_MASS), ("nonlinear",)),
    Condition(
        "loop-100",
        "ground loop of 2 LSB at 100 Hz on both channels",
        Emulated(SQUARE, disturb=hum(2.0, 100.0, (FORCE, DISPLACEMENT))),
        ("hum",),
    ),
    Condition(
        "impulses",
        "impulses of 20 LSB on 0.1 % of the samples",
        Emulated(SQUARE, disturb=impulses(0.001, 20.0)),
        ("noise",),
    ),
    Condition(
        "spikes",
        "impulses of 100 LSB on 0.05 % of the samples",
        Emulated(SQUARE, disturb=impulses(0.0005, 100.0)),
        tolerated=("noise",),
    ),
    Condition(
        "impulses-1",
        "impulses of 8 LSB on 1 % of the samples",
        Emulated(SQUARE, disturb=impulses(0.01, 8.0)),
        ("noise",),
    ),
    Condition(
        "heavy-tails",
        "noise of Student's t distribution, 3 degrees of freedom, 1 LSB",
        Emulated(SQUARE, disturb=heavy_tails(3.0, 1.0)),
        ("noise",),
    ),
    Condition(
        "popcorn",
        "popcorn noise of 1.5 LSB, 200 samples on each level",
        Emulated(SQUARE, disturb=popcorn(1.5, 200.0)),
        ("noise",),
    ),
    Condition(
        "wander", "displacement wanders by 50 LSB at 1 Hz", Emulated(SQUARE, disturb=hum(50.0, 1.0)), ("drift", "hum")
    ),
    Condition("bump-stop", "bump stop within reach", Emulated(SQUARE, program=BUMP_STOP), ("nonlinear",)),
    Condition("backlash", "backlash of 3 LSB of the sensor", Emulated(SQUARE, disturb=backlash(3.0)), ("nonlinear",)),
    Condition(
        "rising", "noise that rises from 1 to 3 LSB", Emulated(SQUARE, disturb=rising_noise(0.0, 2.83)), ("noise",)
    ),
    Condition(
        "proportional",
        "noise of 1 LSB and 0.1 % of the displacement",
        Emulated(SQUARE, disturb=proportional_noise(0.001)),
        ("noise",),
    ),
    Condition("blocks", "blocks of 32 samples are missing, 5 %", Emulated(SQUARE, arrives=missing(0.05, 32))),
    Condition("clipped", "displacement below 0.1 V clips", Emulated(SQUARE, _ranged(0.1, 10.1))),
    Condition("near-end", "range ends 8 LSB above the largest displacement", Emulated(SQUARE, _ranged(-4.01, 5.99))),
)
"""Further conditions."""

CONDITIONS: Mapping[str, Condition] = {each.name: each for each in (*ISSUE, *OWN)}
