"""Cases in which a device is compared with the reference: settings, a scenario, and what becomes of its samples."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from analogrig.rigs.rig import Block, Performance, Rig
from analogrig.run import INPUT, OUTPUT
from analogrig.scenario import PotChange, Scenario
from analogrig.testing.reference.fit import STATED_N
from analogrig_emulator import Excitation

U, Y = INPUT, OUTPUT

Codes = NDArray[np.uint16]
Spoil = Callable[[Codes, NDArray[np.bool_]], None]
"""Change of the codes (n, 4), in place, and of the samples that are missing (n,)."""

PLANT = {"M": 35.0, "B": 2400.0, "K": 24_500.0}
"""A fast plant. Its prefilter amplifies rounding little: float32 stays within a twentieth of the noise."""

RINGING = PLANT | {"B": 900.0}
CREEPING = PLANT | {"B": 3600.0}
"""Plants with complex poles, and with poles far apart."""

_SQUARE = Excitation(low_v=0.1, high_v=3.0)
_FREE = dataclasses.replace(_SQUARE, clock="free")


def _scenario(name: str, excitation: Excitation, samples: int = 640, **changed: float) -> Scenario:
    changes = (PotChange(420, changed),) if changed else ()
    return Scenario(samples=samples, excitation=excitation, set=PLANT, tweaks=changes, name=name)


SOFTER = _scenario("softer", dataclasses.replace(_FREE, phase=0.133), K=19_600.0)
SOFTER_LATER = dataclasses.replace(SOFTER, samples=720, tweaks=(PotChange(640, {"K": 19_600.0}),))
LOCKED = _scenario("softer, one clock", _SQUARE, K=19_600.0)
_SINGLE = {
    "M falls": {"M": 30.1},
    "M rises": {"M": 45.5},
    "B falls": {"B": 1920.0},
    "B rises": {"B": 2880.0},
    "K falls": {"K": 19_600.0},
    "K rises": {"K": 28_000.0},
    "B and K fall": {"B": 1500.0, "K": 17_500.0},
    "M and K rise": {"M": 60.0, "K": 28_500.0},
}
_LARGE = {
    "M falls by half": ("M", 70.0, 35.0),
    "M doubles": ("M", 35.0, 70.0),
    "B falls to a third": ("B", 2400.0, 800.0),
    "B triples": ("B", 1400.0, 4200.0),
    "K falls by half": ("K", 24_500.0, 12_250.0),
    "K doubles": ("K", 12_250.0, 24_500.0),
}
"""Changes against which the isolation has a prior: parameter, before, after."""


def _large(name: str, high_v: float, phase: float) -> Scenario:
    parameter, before, after = _LARGE[name]
    excitation = dataclasses.replace(_FREE, high_v=high_v, phase=phase % 1.0)
    return dataclasses.replace(
        _scenario(f"{name}, {high_v} V", excitation, 560, **{parameter: after}), set=PLANT | {parameter: before}
    )


SUCCESSION = dataclasses.replace(
    _scenario("small changes in close succession", dataclasses.replace(_FREE, phase=0.133), 800),
    tweaks=tuple(PotChange(200 + 100 * n, {"K": 24_500.0 if n % 2 else 23_700.0}) for n in range(6)),
)
SUCCESSIONS = dataclasses.replace(
    SUCCESSION,
    samples=6300,
    tweaks=tuple(
        PotChange(at, {"K": 24_500.0 if n % 2 else 23_700.0})
        for n, at in enumerate((200, 300, 400, 500, 5940, 6040, 6140))
    ),
    name="small changes in close succession, twice",
)
HEALTHY = _scenario("healthy", dataclasses.replace(_FREE, phase=0.133), 420)
FAULTY = _scenario("healthy", dataclasses.replace(_FREE, phase=0.133), 520)
LONG = _scenario("healthy, long", dataclasses.replace(_FREE, phase=0.133), 2000)
LATE = _scenario("late edges", dataclasses.replace(_FREE, phase=0.0 + 4e-5, drift_ppm=-20.0), 520)
EARLY = _scenario("early edges", dataclasses.replace(_FREE, phase=1.0 - 4e-5, drift_ppm=20.0), 520)
DISPLACED = _scenario("displaced edges", dataclasses.replace(_FREE, frequency_hz=211.3), 600)
DISPLACED_LATER = _scenario("edges displaced later", dataclasses.replace(_FREE, frequency_hz=117.9, phase=0.133), 720)
RARE_EDGES = _scenario("rare edges", dataclasses.replace(_FREE, frequency_hz=40.0, phase=0.133), 560)


@dataclass(frozen=True)
class ReferenceCase:
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


# ------------------------------------------------------------------------------------------------- what becomes of them


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
        missing[edge + (1, 0, 2, 5, 9, 11, 12, 3)[number % 8]] = True


def _jump_after_gap(samples: int) -> Spoil:
    """A displacement that jumps so far that it is noticed at once, so many samples after a gap."""

    def spoil(codes: Codes, missing: NDArray[np.bool_]) -> None:
        missing[300:312] = True
        codes[312 + samples :, Y] += 90

    return spoil


def _gap_from(first: int) -> Spoil:
    """A dozen samples, too many for a prediction."""

    def spoil(codes: Codes, missing: NDArray[np.bool_]) -> None:  # noqa: ARG001
        missing[first : first + 12] = True

    return spoil


def leave_out_later(codes: Codes, missing: NDArray[np.bool_]) -> None:
    """Few samples shortly before a change."""
    missing[[edges_of(codes)[-3] - 9]] = True
    missing[404] = True


def leave_out_after_alarm(codes: Codes, missing: NDArray[np.bool_]) -> None:  # noqa: ARG001
    """One sample between the alarm for a change of K and its diagnosis."""
    missing[427] = True


def saturate(codes: Codes, missing: NDArray[np.bool_]) -> None:
    """Codes at the limits of the range, and one beside them."""
    missing[[150]] = True
    codes[[60, 61], Y] = (LOW, LOW + 1)
    codes[[130, 131], Y] = (HIGH, HIGH - 1)
    codes[170, U] = LOW
    codes[180:184, U] = HIGH
    codes[250, [U, Y]] = (LOW - 1, HIGH + 1)


LOW, HIGH = 360, 1360


def hold(codes: Codes, missing: NDArray[np.bool_]) -> None:
    """A displacement that is stuck across edges, shortly and for long, and across a missing sample."""
    edges = edges_of(codes).tolist()
    codes[edges[2] - 2 : edges[2] + 7, Y] = codes[edges[2] - 2, Y]
    codes[edges[4] - 2 : edges[4] + 8, Y] = codes[edges[4] - 2, Y]
    codes[edges[6] - 30 : edges[6] + 60, Y] = codes[edges[6] - 30, Y]
    missing[edges[6] + 20] = True


def hum(codes: Codes, missing: NDArray[np.bool_]) -> None:  # noqa: ARG001
    """Two codes of hum on the displacement, with a period of 142 samples: its frequency fills two bytes."""
    disturbance = 2.0 * np.sin(2.0 * np.pi * np.arange(len(codes)) / 142.0)
    codes[:, Y] = np.round(codes[:, Y] + disturbance)


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


def strike_twice(codes: Codes, missing: NDArray[np.bool_]) -> None:  # noqa: ARG001
    """Two successive samples far beyond their neighbours, after one alone."""
    codes[300, Y] += 70
    codes[340:342, Y] += 70


def strike_edges(codes: Codes, missing: NDArray[np.bool_]) -> None:
    """Outliers twice after an edge, after the next but one, and further away; a gap before an edge."""
    edges = edges_of(codes).tolist()
    for at in (edges[4], edges[4] + 2, edges[6] + 2, edges[9] + 2, edges[10] + 3):
        codes[at, Y] += 80
    missing[edges[8] - 8 : edges[8]] = True


def strike_slow_noise(codes: Codes, missing: NDArray[np.bool_]) -> None:  # noqa: ARG001
    """A slow noise, and an outlier in every third block, at each phase of a block."""
    steps = np.random.default_rng(1995).normal(0.0, 1.5, len(codes))
    noise = np.zeros(len(codes))
    for n in range(1, len(codes)):
        noise[n] = 0.8 * noise[n - 1] + steps[n]
    codes[:, Y] = np.round(codes[:, Y] + noise)
    codes[260::47, Y] += 250


FAULT_AT = 420
"""First sample of a faulty channel."""


def _fails(channel: int, wrong: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> Spoil:
    """Codes of a channel from FAULT_AT on, made of the true ones, which begin one sample earlier."""

    def spoil(codes: Codes, missing: NDArray[np.bool_]) -> None:  # noqa: ARG001
        codes[FAULT_AT:, channel] = np.round(wrong(codes[FAULT_AT - 1 :, channel].astype(np.float64)))

    return spoil


def _noise(deviation: float) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    return lambda codes: codes[1:] + np.random.default_rng(1995).normal(0.0, deviation, len(codes) - 1)


def _noisy_force(codes: Codes, missing: NDArray[np.bool_]) -> None:  # noqa: ARG001
    """A noise of the force that ends long before a change."""
    codes[360:420, U] = np.round(_noise(40.0)(codes[359:420, U].astype(np.float64)))


def _noisy_at_last(codes: Codes, missing: NDArray[np.bool_]) -> None:  # noqa: ARG001
    """A noise of the displacement once the edges are known to come anywhere."""
    codes[590:, Y] = np.round(_noise(3.0)(codes[589:, Y].astype(np.float64)))


FAULTS: Mapping[str, Spoil] = {
    "offset of the force": _fails(U, lambda codes: codes[1:] + 150.0),
    "gain of the force": _fails(U, lambda codes: 341.0 + 1.3 * (codes[1:] - 341.0)),
    "late force": _fails(U, lambda codes: codes[:-1]),
    "stuck force": _fails(U, lambda codes: np.repeat(codes[:1], len(codes) - 1)),
    "noisy force": _fails(U, _noise(40.0)),
    "offset of the displacement": _fails(Y, lambda codes: codes[1:] + 25.0),
    "gain of the displacement": _fails(Y, lambda codes: 410.0 + 0.8 * (codes[1:] - 410.0)),
    "late displacement": _fails(Y, lambda codes: codes[:-1]),
    "stuck displacement": _fails(Y, lambda codes: np.repeat(codes[:1], len(codes) - 1)),
    "noisy displacement": _fails(Y, _noise(8.0)),
}
"""Faults of a channel, one at a time. Gains are counted from where the force is zero."""


def _coarse_and_stuck(codes: Codes, missing: NDArray[np.bool_]) -> None:
    """A displacement in steps of 6 codes, most of which repeat, and which gets stuck."""
    codes[:, Y] = 6 * np.round(codes[:, Y] / 6)
    FAULTS["stuck displacement"](codes, missing)


_ARMED = {"warm_up_n": 150}
"""Plays are too short for the default."""

_FIXED = {"refresh_n": 0, "c": (-1.45, 0.51)}
"""C near the plant's A. A refresh depends on whether A has moved by REFRESH_STEP, which rounding may decide."""

_RESTLESS = {"forgetting": 0.97, "warm_up_n": 100}
"""A short memory: A moves by more than REFRESH_STEP nearly always."""

_FREE_ALARMS = {"warm_up_n": 60, "refresh_n": 0}
_TWO_B = {"nb": 2, "nk": 1, "offset": False, "edge_instants": "locked"}
_ONE_CLOCK = {**_FIXED, **_ARMED, "nb": 2, "nk": 1, "edge_instants": "locked", "forgetting": 0.995}
"""Settings without a slip, which a late force would be taken for."""

HUM = ReferenceCase(
    _scenario("hum", _SQUARE, STATED_N + 1),
    {**_ONE_CLOCK, "noise_estimated": False, "noise_variance": 2.0, "ceiling": 1e4, "misfit": True},
    hum,
    is_optional=True,
)
"""Disturbance that the watch of the fit names."""

CASES: Mapping[str, ReferenceCase] = {
    "default": ReferenceCase(SOFTER_LATER),
    "default in blocks": ReferenceCase(SOFTER, _ARMED, exchange="block"),
    "one clock": ReferenceCase(LOCKED, {**_TWO_B, **_FIXED, **_ARMED, "forgetting": 0.997, "isolation": False}),
    "anywhere": ReferenceCase(SOFTER, {**_RESTLESS, "edge_instants": "anywhere", "edge_codes": 500.0}),
    "edges become late": ReferenceCase(LATE, _RESTLESS),
    "edges become early": ReferenceCase(EARLY, _RESTLESS),
    "edges become late, delayed": ReferenceCase(LATE, {**_FIXED, "warm_up_n": 100, "nk": 1}),
    "edges become early, delayed": ReferenceCase(EARLY, {"warm_up_n": 100, "nk": 1, "nb": 2, "c": (-1.2, 0.36)}),
    "edges anywhere": ReferenceCase(DISPLACED, _FIXED),
    "edges anywhere after the warm-up": ReferenceCase(DISPLACED_LATER, {**_FIXED, "warm_up_n": 190}, _noisy_at_last),
    "edges anywhere, known noise": ReferenceCase(DISPLACED, {**_FIXED, "noise_estimated": False}),
    "missing while in doubt": ReferenceCase(
        EARLY, {**_FIXED, "noise_variance": 0.7, "ceiling": 1e4, "warm_up_n": 0}, leave_out_near_edges
    ),
    **{
        f"gap {n} samples after {kind} edge": ReferenceCase(scenario, _RESTLESS, _gap_from(edge + n))
        for kind, scenario, edge in (("a late", LATE, 251), ("an early", EARLY, 200))
        for n in (2, 5)
    },
    "strong prior": ReferenceCase(
        SOFTER,
        {
            **_FIXED,
            **_ARMED,
            "p0": 1e-6,
            "p0_offset": 1e-2,
            "forgetting": 0.95,
            "noise_variance": 50.0,
            "isolation": False,
        },
    ),
    "missing": ReferenceCase(SOFTER, _RESTLESS, leave_out),
    "saturated": ReferenceCase(HEALTHY, {"code_low": float(LOW), "code_high": float(HIGH)}, saturate),
    "stuck": ReferenceCase(HEALTHY, {**_FIXED, "stuck_n": 8}, hold),
    "idle": ReferenceCase(RARE_EDGES, {**_RESTLESS, "idle_n": 60}),
    "noise estimated": ReferenceCase(SOFTER, {**_ARMED, "noise_estimated": True, "noise_variance": 4.0}),
    "random walk": ReferenceCase(SOFTER, {**_ARMED, "random_walk": 1e-5, "forgetting": 1.0}),
    "extended": ReferenceCase(
        SOFTER, {**_TWO_B, "nc": 2, "c": (), "refresh_n": 0, "trigger": "none"}, is_optional=True
    ),
    "extended by one": ReferenceCase(
        SOFTER, {**_TWO_B, "nc": 1, "c": (-0.5,), "refresh_n": 0, "trigger": "none"}, is_optional=True
    ),
    "extended with an offset": ReferenceCase(
        SOFTER,
        {**_ARMED, **_TWO_B, "nc": 1, "offset": True, "c": (-0.5,), "refresh_n": 0, "p0": 1e-4, "forgetting": 0.97},
        is_optional=True,
    ),
    "first order": ReferenceCase(SOFTER, {"na": 1, "nb": 1, "nk": 1, "c": (-0.7,), "trigger": "none", "refresh_n": 0}),
    "longest": ReferenceCase(SOFTER, {**_RESTLESS, "nk": 1, "c": (-1.2, 0.4), "p0": 0.5, "p0_offset": 1e4}),
    "prediction error": ReferenceCase(
        SOFTER, {"trigger": "prediction-error", "ceiling": 12.0, "hold_off_n": 30, "reset": "all", **_FREE_ALARMS}
    ),
    "mean": ReferenceCase(SOFTER, {"trigger": "mean-between-faults", "ceiling": 0.6, "hold_off_n": 4, **_FREE_ALARMS}),
    "mean of magnitudes": ReferenceCase(
        SOFTER, {"trigger": "mean-between-faults", "ceiling": 0.5, "absolute": True, "hold_off_n": 20, **_FREE_ALARMS}
    ),
    "no trigger": ReferenceCase(SOFTER, {"trigger": "none", "c": (), "refresh_n": 35, "idle_n": 0, "forgetting": 0.97}),
    "often refreshed": ReferenceCase(SOFTER, {**_RESTLESS, "refresh_n": 18, "c": (-0.9, 0.2)}),
    **{
        name: ReferenceCase(
            _scenario(name, dataclasses.replace(_FREE, phase=0.1 + 0.11 * number), 530, **changed), _ARMED
        )
        for number, (name, changed) in enumerate(_SINGLE.items())
    },
    **{
        f"{name}, {high_v} V": ReferenceCase(_large(name, high_v, 0.07 + 0.09 * number), _ARMED)
        for number, (name, high_v) in enumerate(itertools.product(_LARGE, (0.4, 1.0, 3.0)))
    },
    "M falls at an edge": ReferenceCase(
        _scenario("M falls at an edge", dataclasses.replace(_FREE, phase=0.968), 530, **_SINGLE["M falls"]), _ARMED
    ),
    "M falls, one clock": ReferenceCase(
        _scenario("M falls, one clock", _SQUARE, 530, **_SINGLE["M falls"]),
        _ONE_CLOCK,
    ),
    "ringing plant": ReferenceCase(
        dataclasses.replace(_scenario("ringing", _FREE, 530, B=1250.0), set=RINGING), _RESTLESS
    ),
    "creeping plant": ReferenceCase(
        dataclasses.replace(_scenario("creeping", _FREE, 530, B=2600.0), set=CREEPING), _RESTLESS
    ),
    "K falls, missing after the alarm": ReferenceCase(
        _scenario("K falls, missing", dataclasses.replace(_FREE, phase=0.133), 530, **_SINGLE["K falls"]),
        _RESTLESS,
        leave_out_after_alarm,
    ),
    "B rises, missing": ReferenceCase(_scenario("B rises", _FREE, 560, **_SINGLE["B rises"]), _ARMED, leave_out_later),
    **{name: ReferenceCase(FAULTY, _ONE_CLOCK if "late" in name else _ARMED, spoil) for name, spoil in FAULTS.items()},
    "stuck displacement of coarse codes": ReferenceCase(
        dataclasses.replace(FAULTY, excitation=dataclasses.replace(_FREE, frequency_hz=40.0, high_v=0.6, phase=0.7)),
        {"warm_up_n": 150, "stuck_n": 0, "arl0": 100.0},
        _coarse_and_stuck,
    ),
    **{
        f"fault {n} samples after a gap": ReferenceCase(HEALTHY, {**_FIXED, **_ARMED}, _jump_after_gap(n))
        for n in range(5, 9)
    },
    "lone outliers": ReferenceCase(SOFTER_LATER, {**_FIXED, **_ARMED}, strike),
    "lone outliers, one clock": ReferenceCase(SOFTER_LATER, _ONE_CLOCK, strike),
    "lone outliers, known noise": ReferenceCase(
        SOFTER_LATER, {**_FIXED, **_ARMED, "noise_estimated": False, "refresh_n": 40}, strike
    ),
    "outliers at edges": ReferenceCase(SOFTER_LATER, {**_ONE_CLOCK, "stuck_n": 0}, strike_edges),
    "outliers in slow noise": ReferenceCase(LONG, {**_FIXED, **_ARMED}, strike_slow_noise),
    "two outliers": ReferenceCase(SOFTER, {**_FIXED, **_ARMED}, strike_twice),
    "K falls after a noisy force": ReferenceCase(SOFTER_LATER, _ARMED, _noisy_force),
    "more alarms than may be justified": ReferenceCase(
        SUCCESSION, {"warm_up_n": 100, "noise_estimated": False, "noise_variance": 6.0, "arl0": 1e3}
    ),
    "alarms may be justified again": ReferenceCase(
        SUCCESSIONS,
        {**_FIXED, "warm_up_n": 100, "noise_estimated": False, "noise_variance": 6.0, "arl0": 1e3, "isolation": False},
    ),
    "no isolation": ReferenceCase(SOFTER, {"isolation": False, "warm_up_n": 40, "idle_n": 1}, exchange="block"),
    "low ceiling": ReferenceCase(
        SOFTER, {**_FIXED, "arl0": 30.0, "noise_variance": 0.4, "hold_off_n": 10, "warm_up_n": 90}
    ),
}
