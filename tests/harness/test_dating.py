"""Dating of pot changes by the samples: on machines of real components, and against the exact likelihood.

``make bench ARGS=onset`` repeats it with a thousand trials.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from analogrig.plant import Plant, SampledPlant
from analogrig_emulator import COMPONENTS, Excitation, PotTurn, SuspensionComputer
from analogrig_instruments.dating.instants import (
    Instant,
    NoInstant,
    TurnInstants,
    colour,
    date_jump,
    date_turn,
    interval,
)
from analogrig_instruments.dating.two_filter import (
    BackwardFilter,
    EdgePlace,
    ForwardFilter,
    Motion,
    PlantModel,
    Signals,
    join,
)
from tests.harness.dating_trials import FRONT, Trial, play, scenario_of, still

from .plants import front

N_PER_LSB, M_PER_LSB, PERIOD_S = 2940.0 / 4096, 0.1996 / 4096, 0.01
NOISE_LSB = (1.0 + 1.0 / 12.0) ** 0.5

SOFT = FRONT.scaled("K", 0.7)
ANYWHERE = EdgePlace(0.5, 0.5)


def simulate(
    plants: Sequence[tuple[int, Plant]], samples: int, seed: int, *, place: float = 1.0, half_n: int = 50
) -> Signals:
    """Samples of plants (each from a sample on) on a square wave whose edges have one place in the sample period.

    The response is exact over both parts of the period; noise and rounding are added.
    """
    rng = np.random.default_rng(seed)
    force_n = np.where((np.arange(samples + 1) + rng.integers(100)) // half_n % 2, 2910.0, 30.0)
    state, displacement_m = SampledPlant.from_plant(FRONT, PERIOD_S).at_rest, np.empty(samples)
    for k in range(samples):
        displacement_m[k] = state[0]
        plant = [each for start, each in plants if start <= k][-1]
        parts = [(place, force_n[k]), (1.0 - place, force_n[k + 1])]
        for part, force in parts:
            if part > 0.0:
                state = SampledPlant.from_plant(plant, part * PERIOD_S).next(state, float(force))
    noise = rng.normal(size=(2, samples))
    return Signals(
        N_PER_LSB * np.round(force_n[:-1] / N_PER_LSB + noise[0]),
        M_PER_LSB * np.round(displacement_m / M_PER_LSB + noise[1]),
        np.ones(samples, bool),
        PERIOD_S,
        N_PER_LSB * NOISE_LSB,
        M_PER_LSB * NOISE_LSB,
    )


def jump_instant(signals: Signals, after: Plant | None, search: range, before: Plant = FRONT) -> Instant:
    out = date_jump(signals, before, after, search)
    assert isinstance(out, Instant), out
    return out


def rejection(signals: Signals, after: Plant | None, search: range) -> str:
    out = date_jump(signals, FRONT, after, search)
    assert isinstance(out, NoInstant), out
    return out.reason


# ---- jumps


def test_interval_holds_the_instant_on_machines_of_real_components() -> None:
    """At a coverage of 95 %, more than 4 misses in 20 have a probability of 1 in 400."""
    trials = [Trial.jump(seed, "free" if seed % 2 else "card") for seed in range(20)]
    every = [trial.date_jump() for trial in trials]
    held = [isinstance(each, Instant) and each.low <= trial.sample <= each.high for trial, each in
            zip(trials, every, strict=True)]  # fmt: skip
    assert held.count(False) <= 4
    widths = [each.high - each.low + 1 for each in every if isinstance(each, Instant)]
    assert np.mean(widths) <= 2.25 * np.mean([trial.width_bound() for trial in trials])


@pytest.mark.parametrize("place", [0.0, 0.3, 0.7, 1.0])
@pytest.mark.parametrize("after", [SOFT, FRONT.scaled("M", 0.5), FRONT.scaled("B", 1.3).scaled("K", 0.6)])
def test_large_change_just_after_an_edge_is_found_to_the_sample(after: Plant, place: float) -> None:
    quiet = simulate([(0, FRONT)], 1200, seed=3, place=place)
    edge = 600 + int(np.flatnonzero(np.abs(np.diff(quiet.force_n[600:])) > 1000.0)[0])
    signals = simulate([(0, FRONT), (edge + 4, after)], 1200, seed=3, place=place)
    assert jump_instant(signals, after, range(400, 800)) == Instant(edge + 4, edge + 4, edge + 4)


def test_interval_of_a_change_at_rest_reaches_to_the_next_edge() -> None:
    """A damper has no effect at rest. Edges of 1200 LSB decay by a factor e in 8 samples (sum of the poles).

    A change of a fifth is therefore visible until some 40 samples after the edge.
    """
    after = FRONT.scaled("B", 1.2)
    quiet = simulate([(0, FRONT)], 1600, seed=5, half_n=100)
    edges = 600 + np.flatnonzero(np.abs(np.diff(quiet.force_n[600:])) > 1000.0)
    signals = simulate([(0, FRONT), (int(edges[0]) + 75, after)], 1600, seed=5, half_n=100)
    out = jump_instant(signals, after, range(500, 1000))
    assert edges[0] + 30 <= out.low <= edges[0] + 60
    assert edges[1] - 2 <= out.high <= edges[1] + 2


def test_deviation_of_some_per_cent_from_nominal_values_leaves_the_date() -> None:
    deviating = front(115.0 * 1.08, 3021.0 * 0.94, 24500.0 * 1.07)
    signals = simulate([(0, deviating), (600, deviating.scaled("K", 0.72))], 1200, seed=7, place=0.4)
    assert jump_instant(signals, SOFT, range(400, 800)) == jump_instant(signals, None, range(400, 800))
    assert jump_instant(signals, SOFT, range(400, 800)).sample == 600


def test_instant_is_found_if_the_plant_after_the_change_is_unknown() -> None:
    signals = simulate([(0, FRONT), (600, FRONT.scaled("M", 0.55))], 1200, seed=9)
    given, unknown = (jump_instant(signals, after, range(400, 800)) for after in (FRONT.scaled("M", 0.55), None))
    assert unknown.low <= 600 <= unknown.high
    assert abs(unknown.low - given.low) <= 1 and abs(unknown.high - given.high) <= 1


def test_offsets_of_both_channels_leave_the_date() -> None:
    signals = simulate([(0, FRONT), (600, SOFT)], 1200, seed=11)
    shifted = dataclasses.replace(
        signals, force_n=signals.force_n + 25.0 * N_PER_LSB, displacement_m=signals.displacement_m - 40.0 * M_PER_LSB
    )
    assert jump_instant(shifted, SOFT, range(400, 800)) == jump_instant(signals, SOFT, range(400, 800))


def test_noise_above_the_stated_one_widens_the_interval() -> None:
    """Noise of eight times the stated one."""
    rng = np.random.default_rng(37)
    wider_by = 0
    for seed in (6, 7, 8):
        trial = Trial.jump(seed, "card")
        noise_m = 8.0 * M_PER_LSB * rng.normal(size=len(trial.signals))
        noisy = dataclasses.replace(trial.signals, displacement_m=trial.signals.displacement_m + noise_m)
        out, usual = (jump_instant(each, trial.after, trial.search) for each in (noisy, trial.signals))
        assert out.low <= trial.sample <= out.high
        wider_by += (out.high - out.low) - (usual.high - usual.low)
    assert wider_by > 0


def test_interval_on_a_finer_card_allows_for_real_components() -> None:
    """Machines with polyester capacitors on a card of 16 bits from -10 to 10 V."""
    for seed in range(4, 8):
        sample, lsb_v = 1500 + 17 * seed, 20.0 / 65536
        drawn = dataclasses.replace(COMPONENTS["polyester"], seed=seed)
        computer = SuspensionComputer("front", rng=np.random.default_rng(seed), components=drawn)
        turned = [PotTurn(sample, {"B": 2123.0}), PotTurn(sample + 112, {"K": 20000.0})]
        blocks = list(computer.play(Excitation(low_v=0.1, high_v=9.9), 3500, turned))
        volts = np.concatenate(blocks)[:, :2]
        volts = lsb_v * np.rint(volts / lsb_v + np.random.default_rng(seed).normal(size=volts.shape))
        noise_v = NOISE_LSB * lsb_v
        force_n, displacement_m = 294.0 * volts[:, 0], 0.01996 * volts[:, 1]
        valid = np.ones(3500, bool)
        signals = Signals(force_n, displacement_m, valid, PERIOD_S, 294.0 * noise_v, 0.01996 * noise_v)
        middle = FRONT.scaled("B", 2123.0 / 3021.0)
        out = date_turn(signals, FRONT, middle.scaled("K", 20000.0 / 24500.0), range(1200, 2200), middle=middle)
        assert isinstance(out, TurnInstants), out
        assert out.begin.low - 1 <= sample <= out.begin.high + 1
        assert out.end.low - 1 <= sample + 112 <= out.end.high + 1


def test_invalid_samples_are_ignored() -> None:
    signals = simulate([(0, FRONT), (600, SOFT)], 1200, seed=13)
    invalid = np.zeros(1200, bool)
    invalid[[300, 301, 302, 590, 591, 604, 605, 606]] = True
    wild = np.where(invalid, 0.3, signals.displacement_m)
    out = jump_instant(dataclasses.replace(signals, displacement_m=wild, valid=~invalid), SOFT, range(400, 800))
    assert out.low <= 600 <= out.high
    assert out.high - out.low <= 4


def test_higher_confidence_widens_the_interval() -> None:
    trial = Trial.jump(36, "card")  # K that falls by a third while the force is low
    usual = jump_instant(trial.signals, trial.after, trial.search)
    sure = date_jump(trial.signals, FRONT, trial.after, trial.search, confidence=0.999)
    assert isinstance(sure, Instant)
    assert sure.low < usual.low and usual.high <= sure.high


# ---- no change


@pytest.mark.parametrize("clock", ["card", "free"])
def test_no_instant_without_a_change(clock: str) -> None:
    for seed in range(5):
        trial = still(seed, clock)  # type: ignore[arg-type]
        assert isinstance(trial.date_jump(), NoInstant), seed


def test_invisible_change_has_no_instant() -> None:
    """Force and mass are at rest."""
    signals = simulate([(0, FRONT), (600, FRONT.scaled("M", 0.5))], 1200, seed=15)
    at_rest = dataclasses.replace(
        signals,
        force_n=signals.force_n * 0.0 + 30.0,
        displacement_m=M_PER_LSB * np.round(np.random.default_rng(1).normal(size=1200)),
    )
    message = rejection(at_rest, FRONT.scaled("M", 0.5), range(400, 800))
    assert message == "nothing in the samples 400 to 799 shows that the plant has changed"


def test_change_just_after_the_range_has_no_instant() -> None:
    """The change is two samples after the range, while the mass moves."""
    light = FRONT.scaled("M", 0.9)
    quiet = simulate([(0, FRONT)], 1200, seed=18)
    sample = 604 + int(np.flatnonzero(np.abs(np.diff(quiet.force_n[600:])) > 1000.0)[0])
    signals = simulate([(0, FRONT), (sample, light)], 1200, seed=18)
    assert jump_instant(signals, light, range(sample - 50, sample + 50)).sample == sample
    message = rejection(signals, light, range(sample - 100, sample - 1))
    assert message == f"the plant seems to have changed before or after the samples {sample - 100} to {sample - 2}"


@pytest.mark.parametrize(
    ("search", "message"),
    [
        (range(400, 500), "the plant seems to have changed before or after the samples 400 to 499"),
        (range(700, 800), "the residuals of a plant that changes once have"),
    ],
    ids=["long before it", "long after it"],
)
def test_change_far_outside_the_range_has_no_instant(search: range, message: str) -> None:
    signals = simulate([(0, FRONT), (600, SOFT)], 1200, seed=17)
    out = date_jump(signals, FRONT, SOFT, search)
    assert isinstance(out, NoInstant)
    assert not out.unchanged
    assert out.reason.startswith(message)


def test_within_excludes_another_change_nearby() -> None:
    signals = simulate([(0, FRONT), (600, SOFT), (700, FRONT.scaled("M", 0.5).scaled("K", 0.7))], 1200, seed=35)
    crowded = date_jump(signals, FRONT, SOFT, range(500, 650))
    assert isinstance(crowded, Instant)
    assert crowded != Instant(600, 600, 600)
    assert date_jump(signals, FRONT, SOFT, range(500, 650), within=range(700)) == Instant(600, 600, 600)
    with pytest.raises(ValueError, match=r"leaves range\(550, 700\), in which the plant changes no other time"):
        date_jump(signals, FRONT, SOFT, range(500, 650), within=range(550, 700))


def test_change_between_two_others_is_found_from_few_samples() -> None:
    """49 samples before the range and 50 after it; the mass still moves from the previous change."""
    for seed in range(20):
        signals = simulate([(0, SOFT), (300, FRONT), (550, SOFT)], 800, seed)
        out = date_jump(signals, FRONT, SOFT, range(350, 750), within=range(301, 800), confidence=0.999)
        assert isinstance(out, Instant), (seed, out)
        assert out.low <= 550 <= out.high, (seed, out)
        assert out.high - out.low < 50, (seed, out)  # it is at the latest edge, or at the next


def test_samples_of_no_such_plant_are_rejected() -> None:
    signals = simulate([(0, FRONT), (600, SOFT)], 1200, seed=19)
    turned_round = dataclasses.replace(signals, displacement_m=signals.displacement_m[::-1].copy())
    assert "times the noise variance" in rejection(turned_round, SOFT, range(400, 800))


@pytest.mark.parametrize("search", [range(0), range(400, 1300), range(-5, 100), range(400, 800, 2)])
def test_range_that_leaves_the_record_raises(search: range) -> None:
    signals = simulate([(0, FRONT)], 1200, seed=21)
    with pytest.raises(ValueError, match="leaves the 1200 samples of the record"):
        date_jump(signals, FRONT, SOFT, search)


# ---- turns


def test_begin_and_end_of_an_even_turn_are_within_their_intervals() -> None:
    """Machines of real components. The mean width of a hundred begins is 21 to 22 samples (dating.md); ten instants
    stay below twice that."""
    misses, widths = 0, []
    for seed in range(5):
        trial = Trial.ramp(seed, "free" if seed % 2 else "card")
        out = trial.date_turn()
        assert isinstance(out, TurnInstants), out
        misses += not out.begin.low <= trial.sample <= out.begin.high
        misses += not out.end.low <= trial.sample + trial.ramp_n <= out.end.high
        widths += [each.high - each.low + 1 for each in (out.begin, out.end)]
    assert misses == 0
    assert np.mean(widths) < 44.0


def test_gentle_turn_of_a_hand_is_found_from_its_begin_to_its_end() -> None:
    """Least jerk, as of a hand: 0.9 % of the path after a tenth of the time."""
    times = (np.arange(300) + 0.5) / 300.0
    done = times**3 * (10.0 - 15.0 * times + 6.0 * times**2)
    way = [(600 + k, FRONT.interpolate(SOFT, part)) for k, part in enumerate(done.tolist())]
    signals = simulate_path([(0, FRONT), *way, (900, SOFT)], 1600)
    out = date_turn(signals, FRONT, SOFT, range(450, 1050))
    assert isinstance(out, TurnInstants), out
    assert out.begin.low <= 600 <= out.begin.high
    assert out.end.low <= 900 <= out.end.high
    assert out.begin.high < 700 and out.end.low > 800


def test_two_pots_that_jump_in_succession_are_both_found() -> None:
    """Machines of real components; the second pot jumps 5 to 120 samples after the first.

    At a coverage of 95 %, more than two misses of eight have a probability of 1 in 170, each by a few samples.
    """
    orders = [("B", "K", 5), ("B", "K", 120), ("M", "K", 90), ("K", "B", 20)]
    miss_n = []
    for seed, (first, second, gap) in enumerate(orders):
        middle = FRONT.scaled(first, 0.75)
        after = middle.scaled(second, 0.7)
        scenario = scenario_of(2200, "card", 200.0, middle, 1000 + 7 * seed)
        (change,) = scenario.changes
        (later,) = scenario_of(2200, "card", 200.0, after, change.sample + gap).changes
        signals = play(dataclasses.replace(scenario, changes=(change, later)), seed)
        out = date_turn(signals, FRONT, after, range(800, 1400), middle=middle)
        assert isinstance(out, TurnInstants), out
        for each, sample in ((out.begin, change.sample), (out.end, later.sample)):
            miss_n.append(max(0, each.low - sample, sample - each.high))
        assert out.end.high - out.begin.low <= gap + 60
    assert sum(n > 0 for n in miss_n) <= 2
    assert max(miss_n) <= 5


def simulate_path(plants: Sequence[tuple[int, Plant]], samples: int) -> Signals:
    """Samples as of ``simulate``, fast enough for a plant that changes at every sample."""
    starts = dict(plants)
    signals = simulate([(0, FRONT)], samples, seed=23)
    level_n = np.where(signals.force_n > 1500.0, 2910.0, 30.0)
    out, plant = np.empty(samples), SampledPlant.from_plant(FRONT, PERIOD_S)
    state = plant.at_rest
    for k in range(samples):
        out[k] = state[0]
        if k in starts:
            plant = SampledPlant.from_plant(starts[k], PERIOD_S)
        state = plant.next(state, float(level_n[k]))
    noise = np.random.default_rng(24).normal(size=samples)
    return dataclasses.replace(signals, displacement_m=M_PER_LSB * np.round(out / M_PER_LSB + noise))


def test_no_turn_without_a_change() -> None:
    trial = still(1, "card")
    out = trial.date_turn()
    assert isinstance(out, NoInstant)
    assert "shows that the plant has changed" in out.reason


def test_turn_that_continues_beyond_the_range_has_no_instants() -> None:
    trial = Trial.ramp(4, "card")
    cut = range(trial.sample - 60, trial.sample + trial.ramp_n // 3)
    assert isinstance(date_turn(trial.signals, FRONT, trial.after, cut), NoInstant)


# ---- the likelihood itself


def test_two_filters_give_the_likelihood_of_all_samples_at_once() -> None:
    """Compare with the joint normal density of all displacements, its covariance written out, for each instant."""
    signals = simulate([(0, FRONT), (70, SOFT)], 140, seed=25, place=0.4)
    edges = EdgePlace(0.4, 0.2)
    old, new = (Motion.of(plant, edges, signals) for plant in (FRONT, SOFT))
    costs = cost_of_each_instant(old, new)
    dense = [minus_twice_log_density(old, new, sample) for sample in range(12, 139, 9)]
    assert np.diff(costs[12:139:9]) == pytest.approx(np.diff(dense), rel=1e-7, abs=2e-3)


def cost_of_each_instant(old: Motion, new: Motion) -> NDArray[np.float64]:
    still = np.zeros((len(old.signals), 2))
    before, after = ForwardFilter.of(old, still), BackwardFilter.of(new, still)
    form, log = join(before.state, before.covariance, after.vector, after.information)
    return np.asarray((form + before.misfit + after.misfit)[:, 0, 0] + log + before.log + after.log)


def minus_twice_log_density(old: Motion, new: Motion, sample: int) -> float:
    """Cost of the displacements in units of their noise, up to a constant."""
    n = len(old.signals)
    mean, covariance = np.zeros(2 * n), np.zeros((2 * n, 2 * n))
    covariance[:2, :2] = 1e6 * np.eye(2)
    for k in range(n - 1):
        motion = old if k < sample else new
        transition = motion.model.transition
        here, there = slice(2 * k, 2 * k + 2), slice(2 * k + 2, 2 * k + 4)
        mean[there] = transition @ mean[here] + motion.known[k]
        covariance[there, : 2 * k + 2] = transition @ covariance[here, : 2 * k + 2]
        covariance[: 2 * k + 2, there] = covariance[there, : 2 * k + 2].T
        covariance[there, there] = transition @ covariance[here, here] @ transition.T + motion.disturbances[k]
    size = covariance[::2, ::2] + np.eye(n)
    left = old.measured[:, 0] - mean[::2]
    return float(left @ np.linalg.solve(size, left) + np.linalg.slogdet(size)[1])


def test_constant_plant_gives_all_instants_the_same_likelihood() -> None:
    motion = Motion.of(FRONT, ANYWHERE, simulate([(0, FRONT)], 300, seed=27))
    costs = cost_of_each_instant(motion, motion)
    assert np.ptp(costs) < 1e-6 * costs.max()


def test_edge_at_an_unknown_place_has_mean_and_covariance_of_random_places() -> None:
    """Compare with 200,000 random places."""
    signals = simulate([(0, FRONT)], 10, seed=29)
    (model,) = PlantModel.of([FRONT], ANYWHERE, signals)
    rng = np.random.default_rng(30)
    m, b, k = FRONT.parameters().values()
    decay, swing = b / (2.0 * m), np.emath.sqrt(k / m - (b / (2.0 * m)) ** 2)
    late_s = (1.0 - rng.uniform(size=200_000)) * PERIOD_S
    turned = np.exp(-decay * late_s)
    at = (1.0 - turned * (np.cos(swing * late_s) + decay / swing * np.sin(swing * late_s))).real / k
    speed = (turned * np.sin(swing * late_s) / (m * swing)).real
    responses = np.stack([at, speed * PERIOD_S]) / signals.noise_m
    assert model.edge == pytest.approx(responses.mean(axis=1), rel=0.01)
    assert model.edge_covariance == pytest.approx(np.cov(responses), rel=0.04)


# ---- intervals


def test_interval_holds_accepted_instants_and_the_requested_likelihood() -> None:
    """3.84 is the 95 % point of chi squared with one degree of freedom."""
    samples = np.arange(10, 18)
    assert interval(np.array([50.0, 9.0, 3.83, 0.0, 3.85, 40.0, 50.0, 60.0]), samples, 0.95) == Instant(13, 12, 14)
    flat = np.zeros(100)
    out = interval(flat, np.arange(100), 0.95)
    assert (out.low, out.high) == (0, 99)
    heavy = np.concatenate([[0.0], np.full(99, 4.2)])  # each rejected, together 0.9 of the likelihood
    assert interval(heavy, np.arange(100), 0.95).high > 80


@pytest.mark.parametrize(
    ("filtered", "wanted"),
    [
        (np.copy, 1.0),
        (lambda white: white[1:] + 0.5 * white[:-1], 2.25),
        (np.diff, 1.0),
    ],
    ids=["white", "moving average", "difference"],
)
def test_colour_is_the_long_run_variance(filtered: Callable[..., NDArray[np.float64]], wanted: float) -> None:
    """It is 1.5 squared for w(k) + 0.5 w(k-1), and 0 for a difference, which is raised to 1."""
    white = np.random.default_rng(31).normal(size=40_000)
    assert colour([filtered(white)]) == pytest.approx(wanted, rel=0.1)


def test_slow_drift_widens_the_interval() -> None:
    trial = Trial.jump(36, "card")
    rng = np.random.default_rng(33)
    drift = np.zeros(len(trial.signals))
    for k in range(1, len(drift)):
        drift[k] = 0.97 * drift[k - 1] + 0.25 * rng.normal()
    shaken = dataclasses.replace(
        trial.signals, displacement_m=trial.signals.displacement_m + drift * trial.signals.noise_m
    )
    drifting = jump_instant(shaken, trial.after, trial.search)
    usual = jump_instant(trial.signals, trial.after, trial.search)
    assert drifting.high - drifting.low > usual.high - usual.low
    assert drifting.low <= trial.sample <= drifting.high
