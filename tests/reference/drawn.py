"""Cases drawn at random: settings, plants, changes, faults of the channels, and missing samples, of every kind."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig.scenario import PotChange, Scenario
from analogrig.testing.properties.cases import Codes, PlayedCase, Spoil, U, Y, edges_of
from analogrig_emulator import Excitation

PLANT_M, PLANT_K, PLANT_DAMPING = (30.0, 60.0), (17_000.0, 28_500.0), (0.3, 1.5)
"""Drawn plants: fast ones, whose prefilter amplifies rounding little."""

MOST_SAMPLES = 2600

USUAL_HZ, ODD_HZ = (40.0, 100.0, 200.0, 250.0, 400.0), (90.0, 310.0)
"""Frequencies whose period is a whole number of samples, and limits of others."""

DISTURBED, DISTURBED_WARM_UP_N = 0.4, (180, 450)
"""Part of the cases with a lasting disturbance, and their warm-up, which it takes to estimate a correlation."""

ZERO_CODE = 400.0
"""Code of either channel, near enough, where no force acts."""

OTHER_PLANTS = 1000
"""First number of the cases with a plant that no pots show."""

OUTLIERS = 10_000
"""First number of the cases with lone outliers. Case OUTLIERS + n is case n with outliers."""

ROUNDED = frozenset({17, 118, 137})
"""Drawn cases that are left out: float32, with products fused or not, makes another decision, which the reference does
not foresee, or comes within a factor of 2 of an allowed deviation."""

TELLING = (
    *(275, 307, 326, 343, 459, 468, 543, 552, 566, 614, 621, 637, 657, 741),
    *(1118, 1145, 1182, 1215, 1272, 1290, 1353, 1391, 1455, 1641, 1672, 1696, 1810, 1814, 2076, 2261, 2282, 2329, 2407),
)
"""Drawn cases that tell altered devices which the first 160 let pass, chosen from 2100."""

SERIES = (*range(160), *range(OTHER_PLANTS, OTHER_PLANTS + 20), *range(OUTLIERS, OUTLIERS + 12))

DRAWN = [number for number in (*SERIES, *TELLING) if number not in ROUNDED]
"""Drawn cases, from three endless series."""

SHAPES = ("square", "square", "square", "square", "prbs", "pulse", "sine")


class Draw:
    """Random numbers of one case."""

    def __init__(self, number: int) -> None:
        self._rng = np.random.default_rng((1995, number))

    def chance(self, probability: float) -> bool:
        return bool(self._rng.random() < probability)

    def one(self, *values: Any) -> Any:
        return values[int(self._rng.integers(len(values)))]

    def whole(self, low: int, high: int) -> int:
        return int(self._rng.integers(low, high + 1))

    def real(self, low: float, high: float) -> float:
        return float(self._rng.uniform(low, high))

    def size(self, low: float, high: float) -> float:
        """Number whose logarithm is drawn evenly."""
        return math.exp(self.real(math.log(low), math.log(high)))

    def normal(self, deviation: float, n: int) -> NDArray[np.float64]:
        return self._rng.normal(0.0, deviation, n)

    def wholes(self, n: int, most: int) -> Sequence[int]:
        return [int(each) for each in self._rng.integers(0, most, n)]


@functools.lru_cache(maxsize=1024)
def drawn(number: int) -> PlayedCase:
    """Case with this number: below OTHER_PLANTS of every kind, every sixth long; then of a plant that no pots show.

    From OUTLIERS on, case n is that of n - OUTLIERS with lone outliers.
    """
    draw = Draw(number)
    if number >= OUTLIERS:
        return _struck(draw, drawn(number - OUTLIERS))
    if number >= OTHER_PLANTS:
        return _diagnosed(draw, number)
    is_long = number % 6 == 5
    samples = draw.whole(1500, MOST_SAMPLES) if is_long else draw.whole(430, 700)
    first = draw.whole(300, samples - 100)
    plant = _plant(draw)
    spoils: list[Spoil] = []
    changes: list[PotChange] = []
    instants = [first, *(_instants(draw, samples) if is_long or draw.chance(0.4) else [])]
    for at in instants:
        if draw.chance(0.5):
            changes.append(PotChange(at, _changed(draw, plant), draw.one(0, 0, 0, 15)))
        else:
            spoils.append(_fault(draw, at, draw.one(samples, at + draw.whole(30, 200))))
    if draw.chance(0.2):
        spoils.append(_gaps(draw, first))
    if draw.chance(0.5 if is_long else 0.1):
        spoils.append(_bursts(draw, samples))
    excitation, settings = _excitation(draw), _settings(draw)
    if draw.chance(DISTURBED):
        spoils.append(_disturbance(draw, samples))
        settings |= {"warm_up_n": draw.whole(*DISTURBED_WARM_UP_N), "noise_estimated": draw.chance(0.9)}
    scenario = Scenario(
        samples=samples, excitation=excitation, set=plant, changes=_ordered(changes), name=f"drawn {number}"
    )
    return PlayedCase(scenario, settings, _all_of(spoils) if spoils else None)


def _struck(draw: Draw, case: PlayedCase) -> PlayedCase:
    """The case with single samples of the displacement far beyond their neighbours."""
    scenario = dataclasses.replace(case.scenario, name=f"{case.scenario.name}, outliers")
    instants = draw.wholes(draw.whole(3, 12), case.scenario.samples)
    deviations = [round(draw.size(10.0, 600.0)) * draw.one(-1, 1) for _ in instants]
    near_edges = [(draw.whole(0, 30), draw.whole(-2, 13)) for _ in range(5)]

    def spoil(codes: Codes, missing: NDArray[np.bool_]) -> None:
        if case.spoil is not None:
            case.spoil(codes, missing)
        edges = edges_of(codes).tolist()
        beside = [edges[at] + after for at, after in near_edges if at < len(edges)]
        for at, deviation in zip([*instants, *beside], deviations + deviations[::-1], strict=False):
            k = min(max(at, 0), len(codes) - 1)
            codes[k, Y] = min(max(int(codes[k, Y]) + deviation, 0), 4095)

    return dataclasses.replace(case, scenario=scenario, spoil=spoil)


def _diagnosed(draw: Draw, number: int) -> PlayedCase:
    """Plant that no pots show, with one change or fault, or two, under settings with a diagnosis."""
    instants = [draw.whole(380, 430)]
    if draw.chance(0.3):
        instants.append(instants[0] + draw.whole(20, 180))
    samples = instants[-1] + draw.whole(40, 130)
    excitation = dataclasses.replace(_excitation(draw), shape="square", duty=0.5, high_v=draw.real(0.4, 3.2))
    settings = {"warm_up_n": 150, "refresh_n": draw.one(0, 40), "forgetting": draw.one(0.98, 0.99, 0.995)}
    settings |= draw.one({}, {}, {"nb": 2, "nk": 1, "edge_instants": "locked"})
    is_changed = [draw.chance(0.7) for _ in instants]
    spoils = [_other_plant(draw, samples, [at for at, changed in zip(instants, is_changed, strict=True) if changed])]
    spoils += [_fault(draw, at, samples) for at, changed in zip(instants, is_changed, strict=True) if not changed]
    if draw.chance(0.1):
        spoils.append(_gaps(draw, instants[0]))
    scenario = Scenario(samples=samples, excitation=excitation, name=f"drawn {number}")
    return PlayedCase(scenario, settings, _all_of(spoils))


def _plant(draw: Draw) -> dict[str, float]:
    mass, stiffness, damping = draw.real(*PLANT_M), draw.real(*PLANT_K), draw.size(*PLANT_DAMPING)
    return {
        "M": round(mass, 1),
        "B": round(min(2.0 * damping * math.sqrt(mass * stiffness), 4400.0), 1),
        "K": round(stiffness, 1),
    }


def _changed(draw: Draw, plant: dict[str, float]) -> dict[str, float]:
    """One or two parameters, by a few per cent to a factor of two."""
    names = draw.one(("M",), ("M",), ("B",), ("B",), ("K",), ("K",), ("M", "K"), ("B", "K"), ("M", "B"))
    factors = {name: draw.size(1.04, 1.5) ** draw.one(-1, 1) for name in names}
    limits = {"M": (29.5, 110.0), "B": (500.0, 4400.0), "K": (14_000.0, 29_000.0)}
    return {name: round(min(max(plant[name] * factors[name], limits[name][0]), limits[name][1]), 1) for name in names}


def _instants(draw: Draw, samples: int) -> list[int]:
    return list(range(draw.whole(200, 400), samples - 20, draw.whole(100, 400)))


def _ordered(changes: Sequence[PotChange]) -> tuple[PotChange, ...]:
    """Changes in order, none before the ramp of the one before has ended."""
    out: list[PotChange] = []
    for change in sorted(changes, key=lambda each: each.sample):
        if not out or change.sample > out[-1].sample + out[-1].ramp_n:
            out.append(change)
    return tuple(out)


def _excitation(draw: Draw) -> Excitation:
    clock, shape = draw.one("free", "free", "card"), draw.one(*SHAPES)
    is_odd = draw.chance(0.15)
    return Excitation(
        shape=shape,
        duty=draw.one(0.04, 0.05, 0.06, 0.07, 0.3) if shape == "pulse" else 0.5,
        low_v=0.1,
        high_v=draw.real(1.5, 3.2),
        frequency_hz=round(draw.real(*ODD_HZ), 1) if is_odd else draw.one(*USUAL_HZ, 200.0, 200.0, 200.0),
        phase=round(draw.real(0.0, 0.999), 4),
        clock=clock,
        drift_ppm=draw.one(0.0, 0.0, 20.0, -20.0) if clock == "free" else 0.0,
    )


def _settings(draw: Draw) -> dict[str, Any]:
    """Settings of the estimator. All are inside the limits, some are far from the defaults."""
    out: dict[str, Any] = {
        "warm_up_n": draw.whole(60, 250),
        "forgetting": draw.one(0.97, 0.98, 0.99, 0.995, 0.995, 0.998),
        "refresh_n": draw.one(0, 0, 0, 18, 40, 40),
        "noise_estimated": draw.chance(0.7),
        "noise_variance": draw.size(0.4, 3.0),
        "edge_instants": draw.one("locked", "may-slip", "may-slip", "may-slip"),
    }
    if draw.chance(0.3):
        out |= draw.one({"nb": 2, "nk": 1}, {"nb": 2, "nk": 1, "offset": False}, {"nb": 2}, {"nb": 1, "nk": 1})
    if draw.chance(0.4):
        zero = draw.real(0.5, 0.85)
        out["c"] = draw.one((-2.0 * zero, zero**2), (-zero,), (-1.45, 0.51))
    rare: dict[str, Callable[[], dict[str, Any]]] = {
        "arl0": lambda: {"arl0": draw.size(30.0, 1e6)},
        "hold-off": lambda: {"hold_off_n": draw.whole(1, 60)},
        "edges": lambda: {"edge_codes": draw.size(20.0, 400.0)},
        "walk": lambda: {"random_walk": draw.size(1e-7, 1e-4), "forgetting": 1.0},
        "prior": lambda: {"p0": draw.size(1e-3, 100.0), "p0_offset": draw.size(1.0, 1e6)},
        "reset": lambda: {"reset": "all"},
        "stuck": lambda: {"stuck_n": draw.whole(2, 30)},
        "idle": lambda: {"idle_n": draw.whole(20, 120)},
        "range": lambda: {"code_low": draw.real(300.0, 420.0), "code_high": draw.real(1000.0, 1400.0)},
        "anywhere": lambda: {"edge_instants": "anywhere"},
    }
    for settings in rare.values():
        if draw.chance(0.07):
            out |= settings()
    return out


def _other_plant(draw: Draw, samples: int, changes: Sequence[int]) -> Spoil:
    """Displacement of a plant with poles anywhere, up to a period of two samples, whose parameters change.

    With M = 1 and the sample as unit of time, x'' = -B x' - K x + K0 (u - u0), u held from sample to sample.
    """
    if draw.chance(0.5):  # complex poles
        decay, angle = draw.real(0.1, 1.2), draw.real(0.3, 2.9)
        damping, stiffness = 2.0 * decay, decay**2 + angle**2
    else:
        fast, slow = draw.size(0.8, 8.0), draw.size(0.3, 2.0)
        damping, stiffness = fast + slow, fast * slow
    gain, noise = draw.size(0.3, 1.2), draw.normal(draw.size(0.3, 2.0), samples)
    changed = [draw.one((0,), (1,), (2,), (0,), (1,), (2,), (0, 1), (0, 2), (1, 2)) for _ in changes]
    factors = [{name: draw.size(1.04, 2.5) ** draw.one(-1, 1) for name in each} for each in changed]

    def spoil(codes: Codes, missing: NDArray[np.bool_]) -> None:  # noqa: ARG001
        from scipy.linalg import expm

        plant = [1.0, damping, stiffness]
        force = gain * stiffness * (codes[:, U].astype(np.float64) - ZERO_CODE)
        out, state = np.empty(samples), np.zeros(3)
        for first, end, change in zip((0, *changes), (*changes, samples), ({}, *factors), strict=True):
            for parameter, factor in change.items():
                plant[parameter] *= factor
            step = expm([[0.0, 1.0, 0.0], [-plant[2] / plant[0], -plant[1] / plant[0], 1.0 / plant[0]], [0.0] * 3])
            for k in range(first, end):
                out[k], state[2] = state[0], force[k]
                state = step @ state
        codes[:, Y] = np.clip(np.round(ZERO_CODE + out + noise), 0.0, 4095.0)

    return spoil


def _fault(draw: Draw, at: int, end: int) -> Spoil:
    """Fault of a channel in the samples from ``at`` to ``end``."""
    channel, kind = draw.one(U, Y), draw.one("offset", "gain", "delay", "stuck", "noise")
    sizes = {U: (20.0, 150.0, 8.0, 80.0), Y: (4.0, 30.0, 2.0, 12.0)}[channel]
    offset, part = draw.size(*sizes[:2]) * draw.one(-1, 1), draw.size(0.05, 0.3) * draw.one(-1, 1)
    noise = draw.normal(draw.size(*sizes[2:]), MOST_SAMPLES)

    def spoil(codes: Codes, missing: NDArray[np.bool_]) -> None:  # noqa: ARG001
        true = codes[at - 1 : end, channel].astype(np.float64)
        now, before = true[1:], true[:-1]
        wrong = {
            "offset": now + offset,
            "gain": ZERO_CODE + (1.0 + part) * (now - ZERO_CODE),
            "delay": before,
            "stuck": np.full(len(now), now[0]),
            "noise": now + noise[: len(now)],
        }[kind]
        codes[at:end, channel] = np.clip(np.round(wrong), 0.0, 4095.0)

    return spoil


def _gaps(draw: Draw, near: int) -> Spoil:
    """Missing samples, alone and in rows, anywhere, near edges, and near a change."""
    single, first, long = draw.wholes(6, 420), draw.whole(0, 300), draw.whole(2, 12)
    after, offsets = draw.one(-9, 3, 7, 15, 60), draw.wholes(8, 13)

    def spoil(codes: Codes, missing: NDArray[np.bool_]) -> None:
        missing[single] = True
        missing[first : first + long] = True
        missing[min(near + after, len(missing) - 1)] = True
        for edge, offset in zip(edges_of(codes).tolist(), offsets, strict=False):
            missing[min(edge + offset, len(missing) - 1)] = True

    return spoil


def _bursts(draw: Draw, samples: int) -> Spoil:
    """Disturbances of the displacement that come and go, and that no model explains."""
    starts, deviation = draw.wholes(6, samples), draw.size(3.0, 30.0)
    noise = draw.normal(deviation, 40)

    def spoil(codes: Codes, missing: NDArray[np.bool_]) -> None:  # noqa: ARG001
        for start in starts:
            now = codes[start : start + len(noise), Y]
            now[:] = np.clip(np.round(now + noise[: len(now)]), 0.0, 4095.0)

    return spoil


def _disturbance(draw: Draw, samples: int) -> Spoil:
    """Lasting disturbance of the displacement: coloured or intermittent noise, a hum, or a bent characteristic."""
    kind = draw.one("coloured", "coloured", "intermittent", "hum", "bent")
    size, turn, interval = draw.size(1.5, 12.0), draw.whole(150, samples), draw.size(40.0, 300.0)
    later, bend = draw.size(0.5, 5.0), draw.size(2e-5, 5e-4) * draw.one(-1, 1)
    colour, other = _partial_correlations(draw), draw.one(_partial_correlations(draw), (0.0, 0.0))
    k, white = np.arange(samples), draw.normal(size, samples)
    added = {
        "coloured": np.concatenate([_coloured(white[:turn], *colour), later * _coloured(white[turn:], *other)]),
        "intermittent": white * (k // interval % 2),
        "hum": 2.0 * size * np.sin(8.0 * np.pi * k / interval) * ((k < turn) ^ (later < 1.0)),
        "bent": np.zeros(samples),
    }[kind]

    def spoil(codes: Codes, missing: NDArray[np.bool_]) -> None:  # noqa: ARG001
        true = codes[:, Y].astype(np.float64)
        bent = bend * (true - ZERO_CODE) ** 2 if kind == "bent" else 0.0
        codes[:, Y] = np.clip(np.round(true + added + bent), 0.0, 4095.0)

    return spoil


def _partial_correlations(draw: Draw) -> tuple[float, float]:
    return draw.real(-0.6, 0.99), draw.real(-0.7, 0.7)


def _coloured(white: NDArray[np.float64], first: float, second: float) -> NDArray[np.float64]:
    """Noise with these partial correlations at lags 1 and 2, and the variance of the white noise."""
    out = [0.0, 0.0]
    for each in (white * math.sqrt((1.0 - first**2) * (1.0 - second**2))).tolist():
        out.append(first * (1.0 - second) * out[-1] + second * out[-2] + each)
    return np.array(out[2:])


def _all_of(spoils: Sequence[Spoil]) -> Spoil:
    def spoil(codes: Codes, missing: NDArray[np.bool_]) -> None:
        for each in spoils:
            each(codes, missing)

    return spoil
