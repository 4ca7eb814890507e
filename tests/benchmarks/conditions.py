"""Conditions under which ``bench_reality`` plays the shipped device: plant, excitation, card and disturbances.

The circuit emulator and its sampler play a condition. Where they cannot, ``Simulated`` integrates the equation of the
plant, and the table marks the row.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analogrig.judging.information import QUANTISATION_VARIANCE_LSB2
from analogrig.rigs.emulator import Stream
from analogrig.run import CHANNELS, missing_samples
from analogrig_emulator import (
    CARDS,
    COMPONENTS,
    NOMINAL,
    OP_AMP_GRADES,
    PROGRAMS,
    TICKS_PER_SAMPLE,
    Card,
    Components,
    Edges,
    Excitation,
    PotTurn,
    Sampler,
    SuspensionComputer,
    acquired,
    drawn_levels,
    probes_per_sample,
)

Array = NDArray[np.float64]

PARAMETERS = "MBK"

HALF_PERIOD_N = 50
LOW_V, HIGH_V = 0.1, 9.9
"""Shipped excitation: 200 Hz at 20,000 samples/s."""

DISTURBANCE_STREAM = 10
"""Random stream of a seed beside those of the emulated rig."""

FORCE, DISPLACEMENT = (CHANNELS.index(name) for name in ("force", "displacement"))

CARD = Card(ranges_v=((-1.0, 11.0), (-1.0, 9.0), (-10.0, 10.0), (-12.5, 12.5)), noise_lsb=(1.0,) * 4)
"""Card of the shipped rig ``emulator``."""

OFFSET_V = 0.003
"""Amplifiers' offsets of the shipped rig: drawn within plus and minus this."""


class Change(NamedTuple):
    """Change of one parameter; the next sample is the first one affected."""

    parameter: str
    """``M``, ``B`` or ``K``."""
    factor: float
    sample: int


@dataclass(frozen=True, eq=False)
class Played:
    """Samples of one run; all arrays are (n,)."""

    u: Array
    """Force in codes."""
    y: Array
    """Displacement in codes."""
    valid: NDArray[np.bool_]
    information: Array
    """I of ``analogrig.judging.information`` up to each sample, between the plants with and without the change; 0
    without one."""

    def until(self, end: int) -> Played:
        """Samples before this one."""
        return Played(self.u[:end], self.y[:end], self.valid[:end], self.information[:end])


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

    @property
    def fits(self) -> bool:
        """True if the model of the device describes the condition."""
        return not self.kinds

    def play(self, seeds: Sequence[int], samples: int, changes: Sequence[Change | None]) -> Iterator[Played]:
        """Runs of so many samples from rest, one for each seed, with its change."""
        return self.source.play(seeds, samples, changes)


# ------------------------------------------------------------------------------------------------------------ emulator


Draw = Callable[[np.random.Generator, int], Excitation]
"""Function from a random generator and the number of samples to an excitation."""

Disturbance = Callable[[Array, np.random.Generator], Array]
"""Function from the card's inputs (n, channels) in LSB to the disturbed ones."""

Validity = Callable[[int, np.random.Generator], NDArray[np.bool_]]
"""Function from the number of samples to a mask of those that arrive."""

Wander = Callable[[int], Sequence[PotTurn]]
"""Function from a number of samples to the turns of the pots of a healthy machine in these."""


@dataclass(frozen=True)
class Waveform(Excitation):
    """Excitation with given edges, in ticks of a machine at the card's rate."""

    given: Edges = field(default_factory=Edges.none)

    def edges(self, start_tick: int, stop_tick: int, sample_rate_hz: float) -> Edges:
        del sample_rate_hz
        return self.given.within(start_tick, stop_tick)


@dataclass(frozen=True)
class Emulated:
    """Condition that the emulated computer and its card play."""

    draw: Draw
    card: Card = CARD
    program: str = "front"
    components: Callable[[int], Components] = lambda seed: NOMINAL  # noqa: ARG005
    """Components of the machine of a seed."""
    disturb: Disturbance | None = None
    arrives: Validity | None = None
    wander: Wander | None = None
    """It ends at the change."""
    correlation: float = 0.0
    """Of successive noise samples, if the noise on the displacement is autoregressive instead of the card's."""

    def play(self, seeds: Sequence[int], samples: int, changes: Sequence[Change | None]) -> Iterator[Played]:
        for seed, change in zip(seeds, changes, strict=True):
            yield self._run(seed, samples, change)

    def _run(self, seed: int, samples: int, change: Change | None) -> Played:
        turns = [] if self.wander is None else [*self.wander(samples if change is None else change.sample)]
        lsb = self._inputs_lsb(seed, samples, turns, change)
        codes, clipped = self._sampled(lsb, seed)
        valid = ~missing_samples(clipped)
        if self.arrives is not None:
            valid &= self.arrives(samples, self._rng(seed, 1))
        information = np.zeros(samples)
        if change is not None:
            seen = lsb[:, DISPLACEMENT] - self._inputs_lsb(seed, samples, turns, None)[:, DISPLACEMENT]
            first = change.sample + 1
            variance = self.card.noise_lsb[DISPLACEMENT] ** 2
            information[first:] = accumulate(seen[first:] * valid[first:], variance, self.correlation)
        return Played(codes[:, FORCE].astype(np.float64), codes[:, DISPLACEMENT].astype(np.float64), valid, information)

    def _inputs_lsb(self, seed: int, samples: int, turns: Sequence[PotTurn], change: Change | None) -> Array:
        """Inputs of the card without its noise, (samples, channels) LSB."""
        card = self.card
        machine = SuspensionComputer(
            self.program,
            rng=Stream.COMPONENTS.generator(seed),
            offset_v=OFFSET_V,
            components=self.components(seed),
            sample_rate_hz=card.true_rate_hz * probes_per_sample(card),
        )
        if change is not None:
            setting, value = list(machine.program.values.items())[PARAMETERS.index(change.parameter)]
            turns = [*turns, PotTurn(change.sample, {setting: value * change.factor})]
        excitation = self.draw(Stream.EXCITATION.generator(seed), samples)
        jitter = Stream.APERTURE.generator(seed)
        (volts,) = acquired(machine, card, excitation, samples, turns, rng=jitter, block_samples=samples)
        lsb = (volts - card.low_v) / card.lsb_v
        return lsb if self.disturb is None else self.disturb(lsb, self._rng(seed, 0))

    def _sampled(self, lsb: Array, seed: int) -> tuple[NDArray[np.uint16], NDArray[np.bool_]]:
        """Codes and clipping flags. The card's noise on the displacement may be autoregressive."""
        card, rng = self.card, Stream.CARD.generator(seed)
        volts = card.low_v + lsb * card.lsb_v
        if not self.correlation:
            return Sampler(card, rng).sample(volts)
        normals = rng.standard_normal(lsb.shape)
        normals[:, DISPLACEMENT] = autoregressive(normals[:, DISPLACEMENT], self.correlation)
        return Sampler(card, rng).sample(volts, normals)

    @staticmethod
    def _rng(seed: int, part: int) -> np.random.Generator:
        return np.random.default_rng([seed, DISTURBANCE_STREAM + part])


def autoregressive(white: Array, correlation: float) -> Array:
    """First-order autoregressive noise of variance 1 from white noise of variance 1, (n,)."""
    from scipy.signal import lfilter

    driven = white * math.sqrt(1.0 - correlation**2)
    driven[0] = white[0]
    return np.asarray(lfilter([1.0], [1.0, -correlation], driven))


def accumulate(seen_lsb: Array, variance_lsb2: float, correlation: float = 0.0) -> Array:
    """Information up to each sample of a difference (n,) in first-order autoregressive noise and quantisation.

    A Kalman filter of the noise whitens the difference.
    """
    whitened = np.empty(len(seen_lsb))
    predicted, spread = 0.0, variance_lsb2
    for k, seen in enumerate(seen_lsb.tolist()):
        error, variance = seen - predicted, spread + QUANTISATION_VARIANCE_LSB2
        whitened[k] = error / math.sqrt(variance)
        gain = spread / variance
        predicted = correlation * (predicted + gain * error)
        spread = correlation**2 * (1.0 - gain) * spread + (1.0 - correlation**2) * variance_lsb2
    return np.asarray(np.cumsum(whitened**2) / 2.0)


# --------------------------------------------------------------------------------------------------------- excitations


def square(frequency_hz: float = 200.0, part_of_range: float = 1.0, ppm: float | None = None) -> Draw:
    """Square wave of random phase; with ``ppm`` on a clock of its own that runs so much fast."""
    clock, drift_ppm = ("card", 0.0) if ppm is None else ("free", ppm)

    def draw(rng: np.random.Generator, samples: int) -> Excitation:
        del samples
        return Excitation(
            low_v=LOW_V,
            high_v=LOW_V + part_of_range * (HIGH_V - LOW_V),
            frequency_hz=frequency_hz,
            phase=float(rng.uniform()),
            clock=clock,
            drift_ppm=drift_ppm,
        )

    return draw


def random_bits(rng: np.random.Generator, samples: int) -> Excitation:
    """Pseudorandom binary sequence with bits of 25 samples."""
    del samples
    seed = int(rng.integers(511))
    return Excitation(shape="prbs", low_v=LOW_V, high_v=HIGH_V, frequency_hz=800.0, seed=seed)


def random_instants(rng: np.random.Generator, samples: int) -> Excitation:
    """Edges at any instants, whose distances are exponentially distributed."""
    gaps = rng.exponential(HALF_PERIOD_N * TICKS_PER_SAMPLE, 2 * samples // HALF_PERIOD_N + 50)
    ticks = np.unique(np.cumsum(gaps).astype(np.int64))
    levels_v = np.where(np.arange(len(ticks) + 1) % 2, LOW_V, HIGH_V)
    return Waveform(given=Edges(np.append(0, ticks), levels_v))


def continuous(wave: Callable[[Array, np.random.Generator], Array], steps: int = 4, levels: int = 0) -> Draw:
    """Waveform with values within +-1 at instants in samples, held for 1/``steps`` of a sample.

    :param levels: number of levels of the generator's converter; 0: any.
    """

    def draw(rng: np.random.Generator, samples: int) -> Excitation:
        instants = np.arange((samples + 2) * steps) / steps
        shape = 0.5 + 0.5 * wave(instants + 0.5 / steps, rng)
        if levels:
            shape = np.rint(shape * (levels - 1)) / (levels - 1)
        ticks = np.rint(instants * TICKS_PER_SAMPLE).astype(np.int64)
        return Waveform(given=Edges(ticks, LOW_V + shape * (HIGH_V - LOW_V)))

    return draw


def sine(instants_n: Array, rng: np.random.Generator) -> Array:
    """Sine of 200 Hz."""
    return np.sin(math.pi * (instants_n / HALF_PERIOD_N + 2.0 * rng.uniform()))


def sweep(instants_n: Array, rng: np.random.Generator) -> Array:
    """Linear sweep from 20 to 1,000 Hz within 4,000 samples, repeated."""
    at = (instants_n / 4000.0 + rng.uniform()) % 1.0
    return np.sin(2.0 * math.pi * 4000.0 / 20e3 * (20.0 * at + 0.5 * 980.0 * at**2))


def multisine(instants_n: Array, rng: np.random.Generator) -> Array:
    """Sum of the odd harmonics of 50 Hz up to 950 Hz with random phases, scaled to its peak."""
    phases = rng.uniform(0.0, 2.0 * math.pi, 10)
    harmonics = 2.0 * math.pi * 50.0 / 20e3 * np.arange(1, 20, 2)
    period = np.arange(400.0)[:, None] * harmonics + phases
    peak = np.abs(np.sin(period).sum(axis=1)).max()
    total = np.zeros_like(instants_n)
    for harmonic, phase in zip(harmonics, phases, strict=True):
        total += np.sin(instants_n * harmonic + phase)
    return np.asarray(np.clip(total / peak, -1.0, 1.0))


# -------------------------------------------------------------------------------------------------------- disturbances


def hum(amplitude_lsb: float, frequency_hz: float = 50.0, channels: Sequence[int] = (DISPLACEMENT,)) -> Disturbance:
    """Sine of this amplitude and of random phase, at 20,000 samples/s."""

    def disturb(lsb: Array, rng: np.random.Generator) -> Array:
        phase = 2.0 * math.pi * (np.arange(len(lsb)) * frequency_hz / 20e3 + rng.uniform())
        lsb[:, channels] += amplitude_lsb * np.sin(phase)[:, None]
        return lsb

    return disturb


def drift(codes_per_sample: float) -> Disturbance:
    """Displacement that rises with every sample."""

    def disturb(lsb: Array, rng: np.random.Generator) -> Array:
        del rng
        lsb[:, DISPLACEMENT] += codes_per_sample * np.arange(len(lsb))
        return lsb

    return disturb


def impulses(share: float, amplitude_lsb: float) -> Disturbance:
    """Impulses of either sign on single samples of the displacement."""

    def disturb(lsb: Array, rng: np.random.Generator) -> Array:
        hit = rng.uniform(size=len(lsb)) < share
        lsb[:, DISPLACEMENT] += np.where(hit, amplitude_lsb * rng.choice([-1.0, 1.0], len(lsb)), 0.0)
        return lsb

    return disturb


def backlash(width_lsb: float) -> Disturbance:
    """Play of the displacement sensor: it follows the motion at half this width on either side."""

    def disturb(lsb: Array, rng: np.random.Generator) -> Array:
        del rng
        at, half = lsb[0, DISPLACEMENT], 0.5 * width_lsb
        for k, moved in enumerate(lsb[:, DISPLACEMENT].tolist()):
            at = min(max(at, moved - half), moved + half)
            lsb[k, DISPLACEMENT] = at
        return lsb

    return disturb


def rising_noise(lsb_before: float, lsb_after: float) -> Disturbance:
    """White noise on the displacement, beside the card's, that rises linearly along the run."""

    def disturb(lsb: Array, rng: np.random.Generator) -> Array:
        lsb[:, DISPLACEMENT] += rng.standard_normal(len(lsb)) * np.linspace(lsb_before, lsb_after, len(lsb))
        return lsb

    return disturb


def proportional_noise(part: float) -> Disturbance:
    """White noise on the displacement, beside the card's, in proportion to its code."""

    def disturb(lsb: Array, rng: np.random.Generator) -> Array:
        lsb[:, DISPLACEMENT] *= 1.0 + part * rng.standard_normal(len(lsb))
        return lsb

    return disturb


def missing(share: float, together_n: int = 1) -> Validity:
    """Loss of this share of the samples at random, ``together_n`` consecutive ones at a time."""

    def arrives(samples: int, rng: np.random.Generator) -> NDArray[np.bool_]:
        blocks = rng.uniform(size=-(-samples // together_n)) >= share
        return np.repeat(blocks, together_n)[:samples]

    return arrives


def warming(part: float, within_n: int = 10_000, step_n: int = 100) -> Wander:
    """Stiffness that turns by this part of it within so many samples, in small steps, as with a warming machine."""

    def wander(samples: int) -> Sequence[PotTurn]:
        stiffness = PROGRAMS["front"].values["K_n_per_m"]
        return [PotTurn(k, {"K_n_per_m": stiffness * (1.0 + part * k / within_n)}) for k in range(0, samples, step_n)]

    return wander


# ---------------------------------------------------------------------------------------------------------- simulation


@dataclass(frozen=True)
class Simulated:
    """Condition that the emulator cannot play: M x'' + B x' + K x (1 + cubic (x / x_full)^2) = F, by Runge and Kutta.

    x_full is the displacement of the linear spring at the largest force. Scales are those of the front suspension on
    the shipped rig's card.
    """

    cubic: float = 0.0
    bits: int = 12
    noise_lsb: float = 1.0
    steps: int = 4
    """Integration steps in a sample period."""

    def play(self, seeds: Sequence[int], samples: int, changes: Sequence[Change | None]) -> Iterator[Played]:
        program, lanes = PROGRAMS["front"], len(seeds)
        lsb = CARD.lsb_v * 2.0 ** (CARD.bits - self.bits)
        phases = np.array([Stream.EXCITATION.generator(seed).uniform() for seed in seeds])
        at_n = np.arange(samples)[:, None] + np.floor(2 * HALF_PERIOD_N * phases)
        volts = np.where(at_n // HALF_PERIOD_N % 2 == 0, HIGH_V, LOW_V)
        force_n = volts / program.scales.volts("force")
        per_m = program.scales.volts("displacement") / lsb[DISPLACEMENT]
        seen = self._motion_m(force_n, changes) * per_m
        seen_unchanged = self._motion_m(force_n, [None] * lanes) * per_m if any(changes) else seen
        low_lsb = CARD.low_v / lsb
        for lane, (seed, change) in enumerate(zip(seeds, changes, strict=True)):
            information = np.zeros(samples)
            if change is not None:
                first = change.sample + 1
                apart = seen[first:, lane] - seen_unchanged[first:, lane]
                information[first:] = accumulate(apart, self.noise_lsb**2)
            noise = self.noise_lsb * Stream.CARD.generator(seed).standard_normal((2, samples))
            u = np.rint(volts[:, lane] / lsb[FORCE] - low_lsb[FORCE] + noise[0])
            y = np.rint(seen[:, lane] - low_lsb[DISPLACEMENT] + noise[1])
            yield Played(u, y, np.ones(samples, np.bool_), information)

    def _motion_m(self, force_n: Array, changes: Sequence[Change | None]) -> Array:
        """Displacement at each sample, of the shape of ``force_n``: (samples, lanes)."""
        samples, lanes = force_n.shape
        program = PROGRAMS["front"]
        parameters = np.tile(np.array(list(program.values.values())[:3])[:, None], lanes)
        bent = self.cubic / (program.scales.full("force") / parameters[2, 0]) ** 2
        h = program.scales.time / CARD.rate_hz / self.steps
        due = {lane: change for lane, change in enumerate(changes) if change is not None}
        out, x, v = np.empty_like(force_n), np.zeros(lanes), np.zeros(lanes)
        for k in range(samples):
            out[k] = x
            for lane in [lane for lane, change in due.items() if change.sample == k]:
                change = due.pop(lane)
                parameters[PARAMETERS.index(change.parameter), lane] *= change.factor
            m, b, stiffness = parameters
            force = force_n[k]

            def acceleration(
                x: Array, v: Array, m: Array = m, b: Array = b, stiffness: Array = stiffness, force: Array = force
            ) -> Array:
                return np.asarray((force - b * v - stiffness * x * (1.0 + bent * x * x)) / m)

            for _ in range(self.steps):
                a1 = acceleration(x, v)
                x2, v2 = x + 0.5 * h * v, v + 0.5 * h * a1
                a2 = acceleration(x2, v2)
                x3, v3 = x + 0.5 * h * v2, v + 0.5 * h * a2
                a3 = acceleration(x3, v3)
                x4, v4 = x + h * v3, v + h * a3
                a4 = acceleration(x4, v4)
                x = x + h / 6.0 * (v + 2.0 * v2 + 2.0 * v3 + v4)
                v = v + h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
        return out


# --------------------------------------------------------------------------------------------------------------- table


def noisy(lsb: float, card: Card = CARD) -> Card:
    """The card with this noise on all channels."""
    return dataclasses.replace(card, noise_lsb=(lsb,) * card.channels)


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

ISSUE: Sequence[Condition] = (
    Condition("nominal", "shipped rig, 12 bits, noise of 1 LSB", Emulated(SQUARE)),
    Condition("noise-2", "noise of 2 LSB", Emulated(SQUARE, noisy(2.0))),
    Condition("noise-4", "noise of 4 LSB", Emulated(SQUARE, noisy(4.0))),
    Condition("bits-16", "16 bits", Emulated(SQUARE, dataclasses.replace(CARD, bits=16))),
    Condition("slow-3", "plant 3 times slower", Emulated(SQUARE, components=slower(3.0))),
    Condition("slow-10", "plant 10 times slower", Emulated(SQUARE, components=slower(10.0))),
    Condition(
        "slow-3-67hz",
        "plant 3 times slower, excitation of 67 Hz",
        Emulated(square(200.0 / 3.0), components=slower(3.0)),
        horizon_n=900,
    ),
    Condition(
        "slow-10-20hz",
        "plant 10 times slower, excitation of 20 Hz",
        Emulated(square(20.0), components=slower(10.0)),
        horizon_n=3000,
    ),
    *(
        Condition(
            f"card-{rate_khz}k", f"card at {rate_khz} kHz", Emulated(SQUARE, at_rate(1e3 * rate_khz)), horizon_n=n
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
    Condition("prbs", "pseudorandom binary sequence, bits of 25 samples", Emulated(random_bits)),
    Condition(
        "dac-5",
        "sine of 200 Hz in steps of a 5-bit generator",
        Emulated(continuous(sine, steps=1, levels=32)),
        ("excitation",),
    ),
    Condition("inl", "converter with INL of 2 LSB", Emulated(SQUARE, _bent_card()), ("nonlinear",)),
    Condition("real", "real parts 15 K too warm, DT2821 card", Emulated(SQUARE, _real_card(), components=real_parts)),
    Condition("skewed", "displacement taken 10 us after force", Emulated(SQUARE, _skewed_card())),
    Condition(
        "jitter",
        "aperture jitter of 0.5 us",
        Emulated(SQUARE, dataclasses.replace(CARD, aperture_jitter_s=5e-7)),
        ("edges",),
    ),
    Condition("warming", "K falls by 2 % in 10,000 samples", Emulated(SQUARE, wander=warming(-0.02)), ("drift",)),
    Condition("two-mass", "suspension on its tyre, four poles", Emulated(SQUARE, program="two-mass"), ("nonlinear",)),
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
