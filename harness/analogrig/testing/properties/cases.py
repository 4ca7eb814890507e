"""Cases in which a device is compared with the bundled library: a scenario, settings, and changes of the samples."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from analogrig.rigs.rig import Block, Performance, Rig
from analogrig.run import INPUT, OUTPUT
from analogrig.scenario import PotChange, Scenario
from analogrig_emulator import Excitation

U, Y = INPUT, OUTPUT

Codes = NDArray[np.uint16]
Reals = NDArray[np.float64]
Spoil = Callable[[Codes, NDArray[np.bool_]], None]
"""Change of the codes (n, 4), in place, and of the samples that are missing (n,)."""


@dataclass(frozen=True)
class PlayedCase:
    """Settings of the estimator beside its defaults, and the samples that it receives."""

    scenario: Scenario
    settings: Mapping[str, Any] = field(default_factory=dict)
    spoil: Spoil | None = None
    exchange: Literal["", "block"] = ""
    """Exchange of the device, if it runs in this process; empty: that of the session."""
    is_optional: bool = False
    """True if a build of the device may lack the settings."""


class SpoiledRig(Rig):
    """Rig whose samples a case has changed."""

    def __init__(self, rig: Rig, spoil: Spoil) -> None:
        self._rig, self._spoil = rig, spoil
        self.capabilities = rig.capabilities

    def description(self) -> Mapping[str, Any]:
        return self._rig.description()

    def perform(self, scenario: Scenario, seed: int) -> Performance:
        performance = self._rig.perform(scenario, seed)
        return dataclasses.replace(performance, blocks=self._blocks(performance.blocks))

    def _blocks(self, blocks: Iterator[Block]) -> Iterator[Block]:
        every = list(blocks)
        codes = np.concatenate([block.codes for block in every])
        missing = np.zeros(len(codes), np.bool_)
        self._spoil(codes, missing)
        for block in every:
            here = slice(block.first, block.first + len(block.codes))
            clipped = block.clipped | missing[here, np.newaxis]
            yield dataclasses.replace(block, codes=codes[here], clipped=clipped)


def edges_of(codes: Codes) -> NDArray[np.int64]:
    """Samples with another level of the force than the sample before."""
    steps = np.abs(np.diff(codes[:, U].astype(np.int64)))
    return np.flatnonzero(steps > steps.max() // 2) + 1


# ----------------------------------------------------------------------------------------------------------- scenarios

PLANT = {"M": 35.0, "B": 2400.0, "K": 24_500.0}
"""A fast plant: its prefilter amplifies rounding little, for devices that round otherwise."""

SQUARE = Excitation(low_v=0.1, high_v=3.0)
FREE = dataclasses.replace(SQUARE, clock="free")
_SHIFTED = dataclasses.replace(FREE, phase=0.133)


def scenario_of(name: str, excitation: Excitation, samples: int = 640, **changed: float) -> Scenario:
    """Scenario of ``PLANT`` that changes at sample 420."""
    changes = (PotChange(420, changed),) if changed else ()
    return Scenario(samples=samples, excitation=excitation, set=PLANT, changes=changes, name=name)


SOFTER = scenario_of("softer", _SHIFTED, K=19_600.0)
SOFTER_LATER = dataclasses.replace(SOFTER, samples=720, changes=(PotChange(640, {"K": 19_600.0}),))
LOCKED = scenario_of("softer, one clock", SQUARE, K=19_600.0)
HEALTHY = scenario_of("healthy", _SHIFTED, 420)
FAULTY = scenario_of("healthy", _SHIFTED, 520)
LONG = scenario_of("healthy, long", _SHIFTED, 2000)
LATE = scenario_of("late edges", dataclasses.replace(FREE, phase=4e-5, drift_ppm=-20.0), 520)
EARLY = scenario_of("early edges", dataclasses.replace(FREE, phase=1.0 - 4e-5, drift_ppm=20.0), 520)
DISPLACED = scenario_of("displaced edges", dataclasses.replace(FREE, frequency_hz=211.3), 600)
DISPLACED_LATER = scenario_of("edges displaced later", dataclasses.replace(_SHIFTED, frequency_hz=117.9), 720)
RARE_EDGES = scenario_of("rare edges", dataclasses.replace(_SHIFTED, frequency_hz=40.0), 560)
SUCCESSION = dataclasses.replace(
    scenario_of("small changes in close succession", _SHIFTED, 800),
    changes=tuple(PotChange(200 + 100 * n, {"K": 24_500.0 if n % 2 else 23_700.0}) for n in range(6)),
)

CHANGES: Mapping[str, dict[str, float]] = {
    "M falls": {"M": 30.1},
    "M rises": {"M": 45.5},
    "B falls": {"B": 1920.0},
    "B rises": {"B": 2880.0},
    "K falls": {"K": 19_600.0},
    "K rises": {"K": 28_000.0},
    "B and K fall": {"B": 1500.0, "K": 17_500.0},
    "M and K rise": {"M": 60.0, "K": 28_500.0},
    "M doubles": {"M": 70.0},
}

# --------------------------------------------------------------------------------------------- changes of the samples


def leave_out(codes: Codes, missing: NDArray[np.bool_]) -> None:
    """Single samples, pairs and stretches: at the start, beside edges, and after an alarm."""
    edges = edges_of(codes)
    missing[[0, 3, 40, 41, 90, 435, 436, 460]] = True
    missing[200:230] = True
    for number, edge in enumerate(edges[3:9].tolist()):
        missing[edge + (-1, 0, 1, 2, 5, 11)[number % 6]] = True


def leave_out_near_edges(codes: Codes, missing: NDArray[np.bool_]) -> None:
    """One sample near each edge, of each distance within a doubt."""
    for number, edge in enumerate(edges_of(codes).tolist()):
        missing[edge + (1, 0, 2, 5, 9, 11, 12, 3)[number % 8] :][:1] = True


def leave_out_before_edges(codes: Codes, missing: NDArray[np.bool_]) -> None:
    """Gaps of a dozen samples, too many for a prediction, that end few samples before an edge."""
    for number, edge in enumerate(edges_of(codes).tolist()[2::2]):
        end = edge - number % 4
        missing[max(end - 12, 0) : end] = True


def gap_from(first: int) -> Spoil:
    """A dozen missing samples, too many for a prediction."""

    def spoil(codes: Codes, missing: NDArray[np.bool_]) -> None:  # noqa: ARG001
        missing[first : first + 12] = True

    return spoil


LOW, HIGH = 360, 1360


def saturate(codes: Codes, missing: NDArray[np.bool_]) -> None:
    """Codes at the limits of the range, and one beside them."""
    missing[[150]] = True
    codes[[60, 61], Y] = (LOW, LOW + 1)
    codes[[130, 131], Y] = (HIGH, HIGH - 1)
    codes[170, U] = LOW
    codes[180:184, U] = HIGH
    codes[250, [U, Y]] = (LOW - 1, HIGH + 1)


def hold(codes: Codes, missing: NDArray[np.bool_]) -> None:
    """A displacement that is stuck across edges, shortly and for long, and across a missing sample."""
    edges = edges_of(codes).tolist()
    codes[edges[2] - 2 : edges[2] + 7, Y] = codes[edges[2] - 2, Y]
    codes[edges[4] - 2 : edges[4] + 8, Y] = codes[edges[4] - 2, Y]
    codes[edges[6] - 30 : edges[6] + 60, Y] = codes[edges[6] - 30, Y]
    missing[edges[6] + 20] = True


def strike(codes: Codes, missing: NDArray[np.bool_]) -> None:
    """Single samples far beyond their neighbours: at every phase of an edge, and beside gaps."""
    edges = edges_of(codes).tolist()
    struck = {
        edges[4] + 30: 40,
        edges[5] - 1: -60,
        edges[5]: 50,
        edges[6]: -500,
        edges[7] + 1: 300,
        edges[8] + 11: -45,
        edges[9] + 12: 45,
        edges[10] + 20: 90,
        edges[11] + 25: 22,
        edges[11] + 40: -16,
    }
    for at, deviation in struck.items():
        codes[at, Y] = min(max(int(codes[at, Y]) + deviation, 0), 4095)
    missing[edges[10] + 19] = True
    missing[[edges[8] + 12, edges[8] + 13]] = True


def added(disturbance: Callable[[Reals], Reals], gap_n: int = 0) -> Spoil:
    """Disturbance of the displacement, computed from the sample numbers.

    :param gap_n: length of the gap at each 150th sample.
    """

    def spoil(codes: Codes, missing: NDArray[np.bool_]) -> None:
        k = np.arange(len(codes), dtype=np.float64)
        codes[:, Y] = np.clip(np.round(codes[:, Y] + disturbance(k)), 0.0, 4095.0)
        missing[200:] |= k[:-200] % 150 < gap_n

    return spoil


def bend(codes: Codes, missing: NDArray[np.bool_]) -> None:  # noqa: ARG001
    """A displacement that is not linear."""
    codes[:, Y] = np.round(codes[:, Y] + 3e-4 * (codes[:, Y] - 400.0) ** 2)


def hum(k: Reals, period: float = 142.0) -> Reals:
    """Two codes of hum. The frequency of the usual period fills two bytes."""
    return np.asarray(2.0 * np.sin(2.0 * np.pi * k / period), np.float64)


def outliers(k: Reals) -> Reals:
    """Forty codes, once in some hundred samples."""
    return np.asarray(40.0 * np.isin(k, np.random.default_rng(1995).integers(600, len(k), len(k) // 110)), np.float64)


def slow_noise(k: Reals, correlation: float = 0.9) -> Reals:
    """Noise that follows its last value."""
    noise = np.random.default_rng(1995).normal(0.0, 1.5, len(k))
    for n in range(1, len(k)):
        noise[n] += correlation * noise[n - 1]
    return noise


def _fails(channel: int, wrong: Callable[[Reals], Reals]) -> Spoil:
    """Codes of a channel from sample 420 on, made of the true ones, which begin one sample earlier."""

    def spoil(codes: Codes, missing: NDArray[np.bool_]) -> None:  # noqa: ARG001
        codes[420:, channel] = np.round(wrong(codes[419:, channel].astype(np.float64)))

    return spoil


def _noise(deviation: float, codes: Reals) -> Reals:
    return codes[1:] + np.random.default_rng(1995).normal(0.0, deviation, len(codes) - 1)


FAULTS: Mapping[str, Spoil] = {
    "offset of the force": _fails(U, lambda codes: codes[1:] + 150.0),
    "gain of the force": _fails(U, lambda codes: 341.0 + 1.3 * (codes[1:] - 341.0)),
    "late force": _fails(U, lambda codes: codes[:-1]),
    "stuck force": _fails(U, lambda codes: np.repeat(codes[:1], len(codes) - 1)),
    "noisy force": _fails(U, functools.partial(_noise, 40.0)),
    "offset of the displacement": _fails(Y, lambda codes: codes[1:] + 25.0),
    "gain of the displacement": _fails(Y, lambda codes: 410.0 + 0.8 * (codes[1:] - 410.0)),
    "late displacement": _fails(Y, lambda codes: codes[:-1]),
    "stuck displacement": _fails(Y, lambda codes: np.repeat(codes[:1], len(codes) - 1)),
    "noisy displacement": _fails(Y, functools.partial(_noise, 8.0)),
}
"""Faults of a channel, one at a time. Gains are counted from where the force is zero."""

# --------------------------------------------------------------------------------------------------------- named cases

ARMED = {"warm_up_n": 150}
"""Plays are too short for the default."""

FIXED = {"refresh_n": 0, "c": (-1.45, 0.51)}
"""C near the plant's A, and never refreshed: rounding decides whether A has moved."""

SHORT_MEMORY = {"forgetting": 0.97, "warm_up_n": 100}
FREE_ALARMS = {"warm_up_n": 60, "refresh_n": 0}
TWO_B = {"nb": 2, "nk": 1, "offset": False, "edge_instants": "locked"}
ONE_CLOCK = {**FIXED, **ARMED, "nb": 2, "nk": 1, "edge_instants": "locked", "forgetting": 0.995}
"""Settings without a slip, which a late force would be taken for."""

STRONG = {"p0": 1e-6, "p0_offset": 1e-2, "forgetting": 0.95, "noise_variance": 50.0, "isolation": False}

CASES: Mapping[str, PlayedCase] = {
    "default": PlayedCase(SOFTER_LATER),
    "default in blocks": PlayedCase(SOFTER, ARMED, exchange="block"),
    "one clock": PlayedCase(LOCKED, {**TWO_B, **FIXED, **ARMED, "forgetting": 0.997, "isolation": False}),
    "anywhere": PlayedCase(SOFTER, {**SHORT_MEMORY, "edge_instants": "anywhere", "edge_codes": 500.0}),
    "edges become late": PlayedCase(LATE, SHORT_MEMORY),
    "edges become early": PlayedCase(EARLY, SHORT_MEMORY),
    "edges become early, delayed": PlayedCase(EARLY, {"warm_up_n": 100, "nk": 1, "nb": 2, "c": (-1.2, 0.36)}),
    "edges anywhere": PlayedCase(DISPLACED, FIXED),
    "edges anywhere after the warm-up": PlayedCase(DISPLACED_LATER, {**FIXED, "warm_up_n": 190}),
    "missing while in doubt": PlayedCase(
        EARLY, {**FIXED, "noise_variance": 0.7, "ceiling": 1e4, "warm_up_n": 0}, leave_out_near_edges
    ),
    "gap 2 samples after a late edge": PlayedCase(LATE, SHORT_MEMORY, gap_from(253)),
    "gap 5 samples after an early edge": PlayedCase(EARLY, SHORT_MEMORY, gap_from(205)),
    "strong prior": PlayedCase(SOFTER, {**FIXED, **ARMED, **STRONG}),
    "missing": PlayedCase(SOFTER, SHORT_MEMORY, leave_out),
    "missing before edges": PlayedCase(SOFTER, SHORT_MEMORY, leave_out_before_edges),
    "saturated": PlayedCase(HEALTHY, {"code_low": float(LOW), "code_high": float(HIGH)}, saturate),
    "stuck": PlayedCase(HEALTHY, {**FIXED, "stuck_n": 8}, hold),
    "idle": PlayedCase(RARE_EDGES, {**SHORT_MEMORY, "idle_n": 60}),
    "noise estimated": PlayedCase(SOFTER, {**ARMED, "noise_estimated": True, "noise_variance": 4.0}),
    "random walk": PlayedCase(SOFTER, {**ARMED, "random_walk": 1e-5, "forgetting": 1.0}),
    "extended": PlayedCase(SOFTER, {**TWO_B, "nc": 2, "c": (), "refresh_n": 0, "trigger": "none"}, is_optional=True),
    "first order": PlayedCase(SOFTER, {"na": 1, "nb": 1, "nk": 1, "c": (-0.7,), "trigger": "none", "refresh_n": 0}),
    "longest": PlayedCase(SOFTER, {**SHORT_MEMORY, "nk": 1, "c": (-1.2, 0.4), "p0": 0.5, "p0_offset": 1e4}),
    "prediction error": PlayedCase(
        SOFTER, {"trigger": "prediction-error", "ceiling": 12.0, "hold_off_n": 30, "reset": "all", **FREE_ALARMS}
    ),
    "mean": PlayedCase(SOFTER, {"trigger": "mean-between-faults", "ceiling": 0.6, "hold_off_n": 4, **FREE_ALARMS}),
    "mean of magnitudes": PlayedCase(
        SOFTER, {"trigger": "mean-between-faults", "ceiling": 0.5, "absolute": True, "hold_off_n": 20, **FREE_ALARMS}
    ),
    "no trigger": PlayedCase(SOFTER, {"trigger": "none", "c": (), "refresh_n": 35, "idle_n": 0, "forgetting": 0.97}),
    "often refreshed": PlayedCase(SOFTER, {**SHORT_MEMORY, "refresh_n": 18, "c": (-0.9, 0.2)}),
    "no isolation": PlayedCase(SOFTER, {"isolation": False, "warm_up_n": 40, "idle_n": 1}, exchange="block"),
    "low ceiling": PlayedCase(
        SOFTER, {**FIXED, "arl0": 30.0, "noise_variance": 0.4, "hold_off_n": 10, "warm_up_n": 90}
    ),
    **{
        name: PlayedCase(scenario_of(name, dataclasses.replace(FREE, phase=0.1 + 0.08 * number), 530, **changed), ARMED)
        for number, (name, changed) in enumerate(CHANGES.items())
    },
    **{name: PlayedCase(FAULTY, ONE_CLOCK if "late" in name else ARMED, spoil) for name, spoil in FAULTS.items()},
    "lone outliers": PlayedCase(SOFTER_LATER, {**FIXED, **ARMED}, strike),
    "lone outliers, one clock": PlayedCase(SOFTER_LATER, ONE_CLOCK, strike),
    "slow noise, known noise": PlayedCase(
        LONG, {**ARMED, "noise_estimated": False, "arl0": 1e3}, added(functools.partial(slow_noise, correlation=0.6))
    ),
    "more alarms than may be justified": PlayedCase(
        SUCCESSION, {"warm_up_n": 100, "noise_estimated": False, "noise_variance": 6.0, "arl0": 1e3}
    ),
}


HEARD = {**ONE_CLOCK, "noise_estimated": False, "noise_variance": 2.0, "ceiling": 1e4}
"""Settings without alarms and doubts."""


def _misfit(spoil: Spoil | None, blocks: int = 4, settings: Mapping[str, Any] = {}) -> PlayedCase:
    """Case of so many blocks, after each of which the watch of the fit judges it."""
    scenario = scenario_of("misfit", SQUARE, 332 + 792 * blocks)
    return PlayedCase(scenario, {**settings, "misfit": True}, spoil, is_optional=True)


MISFITS: Mapping[str, PlayedCase] = {
    "none": _misfit(None),
    "hum": _misfit(added(hum), 4, HEARD),
    "hum with gaps": _misfit(added(hum, gap_n=12)),
    "hum ends": _misfit(added(lambda k: hum(k) * (k < 3200)), 6, HEARD),
    "hum begins": _misfit(added(lambda k: hum(k) * (k > 3000)), 5, HEARD),
    "another hum": _misfit(added(lambda k: np.where(k < 3300, hum(k), hum(k, 97.0))), 6, HEARD),
    "drift": _misfit(added(lambda k: 0.05 * k)),
    "slow noise": _misfit(added(slow_noise)),
    "slow noise ends": _misfit(added(lambda k: slow_noise(k) * (k < 3000)), 6, HEARD),
    "outliers": _misfit(added(outliers)),
    "bent characteristic": _misfit(bend),
}
"""Disturbances that the model does not explain, for the watch of the fit."""

# --------------------------------------------------------------------------------------------------------- drawn cases

DRAWN_N = 150
"""Drawn cases that are tried, the first ones of an endless series."""

_SETTINGS: Sequence[Mapping[str, Sequence[Any]]] = (
    {"forgetting": (0.97, 0.98, 0.99, 0.995, 0.998)},
    {"refresh_n": (0, 18, 40)},
    {"noise_estimated": (True, True, False), "noise_variance": (0.4, 1.0, 3.0)},
    {"edge_instants": ("locked", "may-slip", "anywhere")},
    {"nb": (1, 2, 2), "nk": (1,), "offset": (True, False)},
    {"c": ((-1.45, 0.51), (-0.6,), (-1.2, 0.36))},
    {"arl0": (30.0, 1e3, 1e6), "hold_off_n": (1, 20, 60)},
    {"p0": (1e-3, 1.0, 100.0), "p0_offset": (1.0, 1e3, 1e6), "reset": ("all", "covariance")},
    {"stuck_n": (0, 2, 8, 30), "idle_n": (0, 20, 120), "edge_codes": (20.0, 100.0, 400.0)},
    {"code_low": (300.0, float(LOW)), "code_high": (1200.0, float(HIGH))},
    {"random_walk": (1e-7, 1e-5), "forgetting": (1.0,)},
)
"""Settings that change together, in one case of three, and their values."""

_SPOILS: Sequence[Spoil] = (
    *FAULTS.values(),
    *(leave_out_near_edges, leave_out_before_edges, hold, bend, gap_from(210)),
    *(added(hum), added(slow_noise), added(functools.partial(slow_noise, correlation=0.5))),
    added(lambda k: slow_noise(k, 0.0) * 4.0 * (k // 90 % 2)),
    added(lambda k: 40.0 * (k % 97 == 5.0)),
)


@functools.lru_cache(maxsize=DRAWN_N)
def drawn(number: int) -> PlayedCase:
    """Case with this number: plant, changes, excitation, settings and changes of the samples are drawn."""
    rng = np.random.default_rng((1995, number))

    def one(*values: Any) -> Any:
        return values[int(rng.integers(len(values)))]

    samples = one(560, 640, 1600)
    plant = {"M": one(40.0, 50.0, 65.0), "B": one(1400.0, 2400.0, 3200.0), "K": one(18_000.0, 20_000.0, 22_000.0)}
    first, name = int(rng.integers(300, samples - 100)), one(*PLANT)
    changes = [PotChange(first, {name: round(plant[name] * one(0.75, 0.9, 1.1, 1.3), 1)})] if one(0, 1, 1) else []
    excitation = dataclasses.replace(
        one(SQUARE, FREE, FREE),
        shape=one("square", "square", "prbs", "pulse"),
        high_v=one(1.5, 2.2, 3.0),
        frequency_hz=one(100.0, 200.0, 200.0, 211.3, 250.0),
        phase=round(float(rng.uniform(0.0, 0.999)), 4),
    )
    settings: dict[str, Any] = {"warm_up_n": one(60, 150, 250, 450)}
    for group in _SETTINGS:
        if rng.random() < 0.3:
            settings |= {name: one(*values) for name, values in group.items()}
    spoils = [one(*_SPOILS) for _ in range(one(0, 1, 1, 2, 2, 3))]

    def spoil(codes: Codes, missing: NDArray[np.bool_]) -> None:
        for each in spoils:
            each(codes, missing)

    scenario = Scenario(samples, excitation, set=plant, changes=tuple(changes), name=f"drawn {number}")
    return PlayedCase(scenario, settings, spoil if spoils else None)


def case_of(name: str) -> PlayedCase:
    """Case with this name, or the drawn one with this number."""
    return drawn(int(name)) if name.isdecimal() else CASES.get(name) or MISFITS[name]


def first_with_samples(name: str) -> str:
    """Name of the first case with the samples of this one."""
    case = case_of(name)
    same = (each for each, other in CASES.items() if (other.scenario, other.spoil) == (case.scenario, case.spoil))
    return next(same, name)
