"""When a pot was turned, learned from the samples: on machines of real components, and against the likelihood itself.

``make bench ARGS=onset`` is the same with a thousand trials.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from analogrig.hardware.dating.jump import Instant, NoInstant, Problem, colour, date_jump, interval
from analogrig.hardware.dating.turn import TurnInstants, date_turn
from analogrig.hardware.dating.two_filter import (
    ANYWHERE,
    BackwardFilter,
    EdgePlace,
    ForwardFilter,
    PlantModel,
    Signals,
    join,
)
from analogrig.plant import Plant, SampledPlant
from analogrig_emulator import COMPONENTS, Excitation, PotChange, SuspensionComputer
from tests.harness.dating_trials import FRONT, Trial, played, scenario_of, still

N_PER_LSB, M_PER_LSB, PERIOD_S = 2940.0 / 4096, 0.1996 / 4096, 0.01
NOISE_LSB = (1.0 + 1.0 / 12.0) ** 0.5

SOFT = FRONT.scaled("K", 0.7)


def simulated(
    plants: Sequence[tuple[int, Plant]], samples: int, seed: int, *, place: float = 1.0, half_n: int = 50
) -> Signals:
    """What a card would take of plants (each from a sample on) on a square wave whose edges all come at one place of
    the sample period: the exact response over both parts of it, noise, whole codes."""
    rng = np.random.default_rng(seed)
    force_n = np.where((np.arange(samples + 1) + rng.integers(100)) // half_n % 2, 2910.0, 30.0)
    state, displacement_m = (0.0, 0.0), np.empty(samples)
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


def found(signals: Signals, after: Plant | None, search: range, before: Plant = FRONT) -> Instant:
    out = date_jump(signals, before, after, search)
    assert isinstance(out, Instant), out
    return out


def reason(signals: Signals, after: Plant | None, search: range) -> str:
    out = date_jump(signals, FRONT, after, search)
    assert isinstance(out, NoInstant), out
    return out.reason


# ---- jumps


@pytest.mark.parametrize("clock", ["card", "free"])
def test_interval_holds_the_instant_on_machines_of_real_components(clock: str) -> None:
    """One that held it in only 95 % of all cases would miss it more than 4 times in 20 once in 400 sets of seeds."""
    trials = [Trial.jump(seed, clock) for seed in range(20)]  # type: ignore[arg-type]
    every = [trial.found() for trial in trials]
    held = [isinstance(each, Instant) and each.low <= trial.sample <= each.high for trial, each in
            zip(trials, every, strict=True)]  # fmt: skip
    assert held.count(False) <= 4
    widths = [each.high - each.low + 1 for each in every if isinstance(each, Instant)]
    assert np.mean(widths) <= 2.25 * np.mean([trial.width_bound() for trial in trials])


@pytest.mark.parametrize("place", [0.0, 0.3, 0.7, 1.0])
@pytest.mark.parametrize("after", [SOFT, FRONT.scaled("M", 0.5), FRONT.scaled("B", 1.3).scaled("K", 0.6)])
def test_large_change_just_after_an_edge_is_found_to_the_sample(after: Plant, place: float) -> None:
    quiet = simulated([(0, FRONT)], 1200, seed=3, place=place)
    edge = 600 + int(np.flatnonzero(np.abs(np.diff(quiet.force_n[600:])) > 1000.0)[0])
    signals = simulated([(0, FRONT), (edge + 4, after)], 1200, seed=3, place=place)
    assert found(signals, after, range(400, 800)) == Instant(edge + 4, edge + 4, edge + 4)


def test_change_while_nothing_moves_may_have_come_at_any_time_until_the_next_edge() -> None:
    """A damper does nothing there. What is left of an edge's 1200 LSB falls by a factor e in 8 samples (the sum of the
    plant's poles): by a fifth more or less of it can be told until some 40 samples after the edge."""
    after = FRONT.scaled("B", 1.2)
    quiet = simulated([(0, FRONT)], 1600, seed=5, half_n=100)
    edges = 600 + np.flatnonzero(np.abs(np.diff(quiet.force_n[600:])) > 1000.0)
    signals = simulated([(0, FRONT), (int(edges[0]) + 75, after)], 1600, seed=5, half_n=100)
    out = found(signals, after, range(500, 1000))
    assert edges[0] + 30 <= out.low <= edges[0] + 60
    assert edges[1] - 2 <= out.high <= edges[1] + 2


def test_rig_that_is_some_per_cent_beside_its_nominal_values_makes_no_difference() -> None:
    beside = Plant(115.0 * 1.08, 3021.0 * 0.94, 24500.0 * 1.07)
    signals = simulated([(0, beside), (600, beside.scaled("K", 0.72))], 1200, seed=7, place=0.4)
    assert found(signals, SOFT, range(400, 800)) == found(signals, None, range(400, 800))
    assert found(signals, SOFT, range(400, 800)).sample == 600


def test_instant_is_found_though_nobody_says_what_the_plant_becomes() -> None:
    signals = simulated([(0, FRONT), (600, FRONT.scaled("M", 0.55))], 1200, seed=9)
    told, untold = (found(signals, after, range(400, 800)) for after in (FRONT.scaled("M", 0.55), None))
    assert untold.low <= 600 <= untold.high
    assert abs(untold.low - told.low) <= 1 and abs(untold.high - told.high) <= 1


def test_offsets_of_both_channels_make_no_difference() -> None:
    signals = simulated([(0, FRONT), (600, SOFT)], 1200, seed=11)
    shifted = dataclasses.replace(
        signals, force_n=signals.force_n + 25.0 * N_PER_LSB, displacement_m=signals.displacement_m - 40.0 * M_PER_LSB
    )
    assert found(shifted, SOFT, range(400, 800)) == found(signals, SOFT, range(400, 800))


def test_noise_that_is_larger_than_it_is_said_to_be_makes_the_interval_wider() -> None:
    """Eight times as large."""
    rng = np.random.default_rng(37)
    wider_by = 0
    for seed in (6, 7, 8):
        trial = Trial.jump(seed, "card")
        noise_m = 8.0 * M_PER_LSB * rng.normal(size=len(trial.signals))
        noisy = dataclasses.replace(trial.signals, displacement_m=trial.signals.displacement_m + noise_m)
        out, usual = (found(each, trial.after, trial.search) for each in (noisy, trial.signals))
        assert out.low <= trial.sample <= out.high
        wider_by += (out.high - out.low) - (usual.high - usual.low)
    assert wider_by > 0


def test_finer_card_is_not_believed_more_than_real_components_deserve() -> None:
    """Machines with polyester capacitors at a card of 16 bits from -10 to 10 V."""
    for seed in range(4, 8):
        sample, lsb_v = 1500 + 17 * seed, 20.0 / 65536
        drawn = dataclasses.replace(COMPONENTS["polyester"], seed=seed)
        computer = SuspensionComputer("front", rng=np.random.default_rng(seed), components=drawn)
        turned = [PotChange(sample, {"B_n_s_per_m": 2123.0}), PotChange(sample + 112, {"K_n_per_m": 20000.0})]
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


def test_samples_that_are_none_are_not_looked_at() -> None:
    signals = simulated([(0, FRONT), (600, SOFT)], 1200, seed=13)
    gone = np.zeros(1200, bool)
    gone[[300, 301, 302, 590, 591, 604, 605, 606]] = True
    wild = np.where(gone, 0.3, signals.displacement_m)
    out = found(dataclasses.replace(signals, displacement_m=wild, valid=~gone), SOFT, range(400, 800))
    assert out.low <= 600 <= out.high
    assert out.high - out.low <= 4


def test_twice_the_confidence_is_a_wider_interval() -> None:
    trial = Trial.jump(36, "card")  # K that falls by a third while the force is low
    usual = found(trial.signals, trial.after, trial.search)
    sure = date_jump(trial.signals, FRONT, trial.after, trial.search, confidence=0.999)
    assert isinstance(sure, Instant)
    assert sure.low < usual.low and usual.high <= sure.high


# ---- nothing to be found


@pytest.mark.parametrize("clock", ["card", "free"])
def test_pot_that_was_not_turned_is_said_to_be_so(clock: str) -> None:
    for seed in range(8):
        trial = still(seed, clock)  # type: ignore[arg-type]
        assert isinstance(trial.found(), NoInstant), seed


def test_change_that_cannot_be_seen_is_not_made_up() -> None:
    """The force stands still, and so does the mass."""
    signals = simulated([(0, FRONT), (600, FRONT.scaled("M", 0.5))], 1200, seed=15)
    at_rest = dataclasses.replace(
        signals,
        force_n=signals.force_n * 0.0 + 30.0,
        displacement_m=M_PER_LSB * np.round(np.random.default_rng(1).normal(size=1200)),
    )
    said = reason(at_rest, FRONT.scaled("M", 0.5), range(400, 800))
    assert said == "nothing in the samples 400 to 799 shows that the plant has changed"


def test_change_just_behind_the_range_is_not_taken_for_one_in_it() -> None:
    """By two samples, while the mass is moving."""
    light = FRONT.scaled("M", 0.9)
    quiet = simulated([(0, FRONT)], 1200, seed=18)
    sample = 604 + int(np.flatnonzero(np.abs(np.diff(quiet.force_n[600:])) > 1000.0)[0])
    signals = simulated([(0, FRONT), (sample, light)], 1200, seed=18)
    assert found(signals, light, range(sample - 50, sample + 50)).sample == sample
    said = reason(signals, light, range(sample - 100, sample - 1))
    assert said == f"the plant seems to have changed before or after the samples {sample - 100} to {sample - 2}"


@pytest.mark.parametrize(
    ("search", "said"),
    [
        (range(400, 500), "the plant seems to have changed before or after the samples 400 to 499"),
        (range(700, 800), "the residuals of a plant that changes once have"),
    ],
    ids=["long before it", "long after it"],
)
def test_change_far_outside_of_the_range_is_not_taken_for_one_in_it(search: range, said: str) -> None:
    signals = simulated([(0, FRONT), (600, SOFT)], 1200, seed=17)
    found = date_jump(signals, FRONT, SOFT, search)
    assert isinstance(found, NoInstant)
    assert not found.unchanged
    assert found.reason.startswith(said)


def test_another_change_nearby_is_kept_out() -> None:
    signals = simulated([(0, FRONT), (600, SOFT), (700, FRONT.scaled("M", 0.5).scaled("K", 0.7))], 1200, seed=35)
    crowded = date_jump(signals, FRONT, SOFT, range(500, 650))
    assert isinstance(crowded, Instant)
    assert crowded.high - crowded.low > 5
    assert date_jump(signals, FRONT, SOFT, range(500, 650), within=range(700)) == Instant(600, 600, 600)
    with pytest.raises(ValueError, match=r"leaves range\(550, 700\), in which the plant changes no other time"):
        date_jump(signals, FRONT, SOFT, range(500, 650), within=range(550, 700))


def test_change_between_two_others_is_found_from_the_few_samples_about_its_range() -> None:
    """49 samples before the range and 50 after it, which begin while the mass is on its way from the change before."""
    for seed in range(20):
        signals = simulated([(0, SOFT), (300, FRONT), (550, SOFT)], 800, seed)
        out = date_jump(signals, FRONT, SOFT, range(350, 750), within=range(301, 800), confidence=0.999)
        assert isinstance(out, Instant), (seed, out)
        assert out.low <= 550 <= out.high, (seed, out)
        assert out.high - out.low < 50, (seed, out)  # it is at the latest edge, or at the next


def test_place_that_only_the_samples_after_the_range_tell_is_not_taken_for_noise() -> None:
    """In half of the records no edge comes within the 49 samples before the range. What is left of some 60 samples is
    their noise, on average over 16 records to 5 %."""
    ratios = []
    for seed in range(16):
        signals = simulated([(0, SOFT), (300, FRONT), (550, SOFT)], 800, seed, place=0.3, half_n=100)
        problem = Problem.of(signals, FRONT, SOFT, range(350, 750), range(301, 800))
        ratios.append(problem.fit().noise_ratio * (problem.signals.noise_m / signals.noise_m) ** 2)
    assert 0.85 < np.mean(ratios) < 1.15


def test_samples_of_something_else_are_refused() -> None:
    signals = simulated([(0, FRONT), (600, SOFT)], 1200, seed=19)
    turned_round = dataclasses.replace(signals, displacement_m=signals.displacement_m[::-1].copy())
    assert "times the noise variance" in reason(turned_round, SOFT, range(400, 800))


@pytest.mark.parametrize("search", [range(0), range(400, 1300), range(-5, 100), range(400, 800, 2)])
def test_range_that_leaves_the_record_is_a_mistake_of_the_caller(search: range) -> None:
    signals = simulated([(0, FRONT)], 1200, seed=21)
    with pytest.raises(ValueError, match="leaves the 1200 samples of the record"):
        date_jump(signals, FRONT, SOFT, search)


# ---- turns by hand


def test_begin_and_end_of_an_even_turn_are_within_their_intervals() -> None:
    """On machines of real components. The mean width of a hundred begins is 21 to 22 samples (README), of ten instants
    it is below twice that."""
    beside, widths = 0, []
    for seed in range(5):
        trial = Trial.ramp(seed, "free" if seed % 2 else "card")
        out = trial.turned()
        assert isinstance(out, TurnInstants), out
        beside += not out.begin.low <= trial.sample <= out.begin.high
        beside += not out.end.low <= trial.sample + trial.ramp_n <= out.end.high
        widths += [each.high - each.low + 1 for each in (out.begin, out.end)]
    assert beside == 0
    assert np.mean(widths) < 44.0


def test_gentle_turn_of_a_hand_is_found_from_its_begin_to_its_end() -> None:
    """Least jerk, as a hand goes: 0.9 % of the way is gone after a tenth of the time."""
    times = (np.arange(300) + 0.5) / 300.0
    gone = times**3 * (10.0 - 15.0 * times + 6.0 * times**2)
    way = [(600 + k, FRONT.interpolate(SOFT, part)) for k, part in enumerate(gone.tolist())]
    signals = simulated_way([(0, FRONT), *way, (900, SOFT)], 1600)
    out = date_turn(signals, FRONT, SOFT, range(450, 1050))
    assert isinstance(out, TurnInstants), out
    assert out.begin.low <= 600 <= out.begin.high
    assert out.end.low <= 900 <= out.end.high
    assert out.begin.high < 700 and out.end.low > 800


def test_two_pots_that_jump_one_after_the_other_are_both_found() -> None:
    """On machines of real components, the second 5 to 120 samples after the first. Of twelve instants more than two are
    beside their intervals of 95 % once in 50 sets of seeds, and never by more than a few samples."""
    orders = [("B", "K", 5), ("K", "M", 40), ("B", "K", 120), ("M", "B", 60), ("M", "K", 90), ("K", "B", 20)]
    beside_n = []
    for seed, (first, second, gap) in enumerate(orders):
        middle = FRONT.scaled(first, 0.75)
        after = middle.scaled(second, 0.7)
        scenario = scenario_of(2200, "card", 200.0, middle, 1000 + 7 * seed)
        (tweak,) = scenario.tweaks
        (later,) = scenario_of(2200, "card", 200.0, after, tweak.sample + gap).tweaks
        signals = played(dataclasses.replace(scenario, tweaks=(tweak, later)), seed)
        out = date_turn(signals, FRONT, after, range(800, 1400), middle=middle)
        assert isinstance(out, TurnInstants), out
        for each, sample in ((out.begin, tweak.sample), (out.end, later.sample)):
            beside_n.append(max(0, each.low - sample, sample - each.high))
        assert out.end.high - out.begin.low <= gap + 60
    assert sum(n > 0 for n in beside_n) <= 2
    assert max(beside_n) <= 5


def simulated_way(plants: Sequence[tuple[int, Plant]], samples: int) -> Signals:
    """As ``simulated``, fast enough for a plant that is another one at every sample."""
    starts = dict(plants)
    signals = simulated([(0, FRONT)], samples, seed=23)
    level_n = np.where(signals.force_n > 1500.0, 2910.0, 30.0)
    state, out, plant = (0.0, 0.0), np.empty(samples), SampledPlant.from_plant(FRONT, PERIOD_S)
    for k in range(samples):
        out[k] = state[0]
        if k in starts:
            plant = SampledPlant.from_plant(starts[k], PERIOD_S)
        state = plant.next(state, float(level_n[k]))
    noise = np.random.default_rng(24).normal(size=samples)
    return dataclasses.replace(signals, displacement_m=M_PER_LSB * np.round(out / M_PER_LSB + noise))


def test_pot_that_no_hand_turned_is_said_to_be_so() -> None:
    trial = still(1, "card")
    out = trial.turned()
    assert isinstance(out, NoInstant)
    assert "shows that the plant has changed" in out.reason


def test_turn_that_goes_on_beyond_the_range_is_not_taken_for_one_in_it() -> None:
    trial = Trial.ramp(4, "card")
    cut = range(trial.sample - 60, trial.sample + trial.ramp_n // 3)
    assert isinstance(date_turn(trial.signals, FRONT, trial.after, cut), NoInstant)


# ---- the likelihood itself


def test_two_filters_give_the_likelihood_of_all_samples_at_once() -> None:
    """Against the normal density of all displacements together, their covariance written out, for each instant."""
    signals = simulated([(0, FRONT), (70, SOFT)], 140, seed=25, place=0.4)
    edges = EdgePlace(0.4, 0.2)
    old, new = (PlantModel.of(plant, edges, signals) for plant in (FRONT, SOFT))
    costs = cost_of_each_instant(signals, old, new)
    dense = [minus_twice_log_density(signals, old, new, sample) for sample in range(12, 139, 9)]
    assert np.diff(costs[12:139:9]) == pytest.approx(np.diff(dense), rel=1e-7, abs=2e-3)


def cost_of_each_instant(signals: Signals, old: PlantModel, new: PlantModel) -> NDArray[np.float64]:
    still = np.zeros((len(signals), 2))
    before = ForwardFilter.of(old, signals, still, (0.0, 0.0))
    after = BackwardFilter.of(new, signals, still, (0.0, 0.0))
    form, log = join(before.state, before.covariance, after.vector, after.information)
    return np.asarray((form + before.misfit + after.misfit)[:, 0, 0] + log + before.log + after.log)


def minus_twice_log_density(signals: Signals, old: PlantModel, new: PlantModel, sample: int) -> float:
    """Of the displacements in units of their noise, but for a constant."""
    n = len(signals)
    mean, covariance = np.zeros(2 * n), np.zeros((2 * n, 2 * n))
    covariance[:2, :2] = 1e6 * np.eye(2)
    for k in range(n - 1):
        model = old if k < sample else new
        here, there = slice(2 * k, 2 * k + 2), slice(2 * k + 2, 2 * k + 4)
        mean[there] = model.transition @ mean[here] + model.inputs(signals, 0.0)[k]
        covariance[there, : 2 * k + 2] = model.transition @ covariance[here, : 2 * k + 2]
        covariance[: 2 * k + 2, there] = covariance[there, : 2 * k + 2].T
        covariance[there, there] = (
            model.transition @ covariance[here, here] @ model.transition.T + model.disturbances(signals)[k]
        )
    size = covariance[::2, ::2] + np.eye(n)
    left = signals.displacement_m / signals.noise_m - mean[::2]
    return float(left @ np.linalg.solve(size, left) + np.linalg.slogdet(size)[1])


def test_plant_that_does_not_change_is_as_likely_to_do_so_at_any_instant() -> None:
    signals = simulated([(0, FRONT)], 300, seed=27)
    model = PlantModel.of(FRONT, ANYWHERE, signals)
    costs = cost_of_each_instant(signals, model, model)
    assert np.ptp(costs) < 1e-6 * costs.max()


def test_edge_that_may_come_anywhere_disturbs_by_what_it_does_on_average() -> None:
    """Against 200,000 places drawn at random."""
    signals = simulated([(0, FRONT)], 10, seed=29)
    model = PlantModel.of(FRONT, ANYWHERE, signals)
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


def test_interval_holds_what_the_likelihood_ratio_allows_and_the_asked_part_of_the_likelihood() -> None:
    """3.84 is the 95 % point of chi squared with one degree of freedom."""
    samples = np.arange(10, 18)
    assert interval(np.array([50.0, 9.0, 3.83, 0.0, 3.85, 40.0, 50.0, 60.0]), samples, 0.95) == Instant(13, 12, 14)
    flat = np.zeros(100)
    out = interval(flat, np.arange(100), 0.95)
    assert (out.low, out.high) == (0, 99)
    heavy = np.concatenate([[0.0], np.full(99, 4.2)])  # each refused, of all likelihood 0.9 of 1.0
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
def test_colour_is_the_variance_of_the_long_run(filtered: Callable[..., NDArray[np.float64]], wanted: float) -> None:
    """Of w(k) + 0.5 w(k-1) it is 1.5 squared, of a difference 0, where 1 is the least."""
    white = np.random.default_rng(31).normal(size=40_000)
    assert colour([filtered(white)]) == pytest.approx(wanted, rel=0.1)


def test_slow_wandering_makes_the_interval_wider() -> None:
    trial = Trial.jump(36, "card")
    rng = np.random.default_rng(33)
    wandering = np.zeros(len(trial.signals))
    for k in range(1, len(wandering)):
        wandering[k] = 0.97 * wandering[k - 1] + 0.25 * rng.normal()
    shaken = dataclasses.replace(
        trial.signals, displacement_m=trial.signals.displacement_m + wandering * trial.signals.noise_m
    )
    still_found = found(shaken, trial.after, trial.search)
    usual = found(trial.signals, trial.after, trial.search)
    assert still_found.high - still_found.low > usual.high - usual.low
    assert still_found.low <= trial.sample <= still_found.high
