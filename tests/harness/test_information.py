"""The harness's own plant and the information bound, against scipy and closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.optimize import minimize_scalar
from scipy.signal import cont2discrete

from analogrig.datasheet import ModelOrders
from analogrig.judging import information
from analogrig.judging.courses import first_at_level
from analogrig.plant import Plant, SampledPlant, estimated_parameters
from tests.harness.runs import made_run

from .plants import PROGRAM, front

FRONT = front(115.0, 3021.0, 24500.0)
SOFT = front(115.0, 3021.0, 18000.0)


@pytest.mark.parametrize("plant", [FRONT, front(2.0, 900.0, 12250.0), front(30.0, 2123.0, 20000.0)], ids=str)
def test_sampled_plant_is_the_exact_zero_order_hold(plant: Plant) -> None:
    m, b, k = plant.parameters()["M"], plant.parameters()["B"], plant.parameters()["K"]
    exact = expm(np.array([[0, 1, 0], [-k / m, -b / m, 1 / m], [0, 0, 0]]) * 0.01)
    sampled = SampledPlant.from_plant(plant, 0.01)
    assert np.reshape(sampled.transition, (2, 2)) == pytest.approx(exact[:2, :2], rel=1e-12)
    assert np.array(sampled.response) == pytest.approx(exact[:2, 2], rel=1e-12)
    assert sampled.next(sampled.at_rest, 100.0) == pytest.approx(tuple(100.0 * exact[:2, 2]), rel=1e-12)


@pytest.mark.parametrize("plant", [FRONT, front(2.0, 900.0, 12250.0), front(30.0, 2123.0, 20000.0)], ids=str)
def test_theta_of_the_exact_discretisation_gives_the_plant(plant: Plant) -> None:
    """Discretise with scipy and convert back; thesis Equ 4.3, 4.8 as recomputed."""
    m, b, k = plant.parameters()["M"], plant.parameters()["B"], plant.parameters()["K"]
    (numerator,), denominator, _ = cont2discrete(([1.0], [m, b, k]), 0.01, "zoh")
    n_per_code, m_per_code = 0.7, 5e-5
    gains = numerator * n_per_code / m_per_code
    theta = np.array([[*denominator[1:], *gains, 3.0]], dtype=np.float64)
    read = estimated_parameters(PROGRAM, theta, ModelOrders(2, 3), n_per_code, m_per_code, 0.01)
    assert read[0] == pytest.approx([m, b, k], rel=1e-6)


@pytest.mark.parametrize(
    "theta",
    [[0.0] * 6, [-1.7, -0.1, 0.1, 0.1, 0.1, 0.0], [-1.75, 0.77, -0.1, -0.1, 0.0, 0.0], [np.nan] * 6],
    ids=["zero", "unstable", "negative gain", "nan"],
)
def test_implausible_theta_gives_nan(theta: list[float]) -> None:
    assert np.isnan(
        estimated_parameters(PROGRAM, np.array([theta], np.float32), ModelOrders(2, 3), 1.0, 1e-4, 0.01)
    ).all()


def test_information_of_a_stiffness_change_under_a_settled_load() -> None:
    """From rest at x0 = F / K the step to K' is the step response of the changed plant: closed form of an overdamped
    second-order system (zeta = 1.05), (x0' - x0)(1 - exp(-s t)(cosh r t + s / r sinh r t))."""
    force_n, noise_lsb = 2940.0, 1.0
    run = made_run(force_n=np.full(600, force_n), plants=[(0, FRONT), (400, SOFT)], noise_lsb=noise_lsb)
    (gathered,) = information.change_information(run)
    lsb_m = run.conditions.channels["displacement"].lsb
    s = SOFT.parameters()["B"] / (2.0 * SOFT.parameters()["M"])
    r = math.sqrt(s * s - SOFT.parameters()["K"] / SOFT.parameters()["M"])
    t = 0.01 * np.arange(1, 51)
    amplitude = force_n / SOFT.parameters()["K"] - force_n / FRONT.parameters()["K"]
    step = 1.0 - np.exp(-s * t) * (np.cosh(r * t) + s / r * np.sinh(r * t))
    expected = np.cumsum((amplitude * step / lsb_m) ** 2) / (2.0 * (noise_lsb**2 + 1.0 / 12.0))
    assert gathered[:50] == pytest.approx(expected, rel=1e-3)


def test_clipped_samples_carry_no_information() -> None:
    clipped = np.zeros(600, bool)
    clipped[401:410] = True
    force = np.full(600, 2940.0)
    whole = made_run(force_n=force, plants=[(0, FRONT), (400, SOFT)])
    holed = made_run(force_n=force, plants=[(0, FRONT), (400, SOFT)], clipped=clipped)
    (all_of_it,), (rest,) = information.change_information(whole), information.change_information(holed)
    assert (rest[:9] == 0.0).all()
    assert rest[20] == pytest.approx(all_of_it[20] - all_of_it[8])


def test_change_of_an_unloaded_suspension_is_not_detectable() -> None:
    run = made_run(force_n=np.zeros(600), plants=[(0, FRONT), (400, SOFT)])
    (gathered,) = information.change_information(run)
    assert first_at_level(gathered, math.log(1e5)) is None


def test_first_reaching_counts_from_one() -> None:
    assert first_at_level([0.0, 5.0, 5.0, 12.0], 5.0) == 2
    assert first_at_level([6.0], 5.0) == 1
    assert first_at_level([], 5.0) is None


@pytest.mark.parametrize(
    "after", [SOFT, front(92.0, 3021.0, 24500.0), front(115.0, 2400.0, 24500.0), front(115.0, 2400.0, 20000.0)], ids=str
)
def test_isolation_bound_is_the_sample_with_ln_20_against_the_best_rival(after: Plant) -> None:
    """Compare with scipy: plants by expm, the best factor of each rival by a numerical search."""
    force = np.where(np.arange(700) // 50 % 2, 2900.0, 0.0)
    run = made_run(force_n=force, plants=[(0, FRONT), (420, after)])
    (bound_n,) = information.isolation_bounds(run)
    assert bound_n is not None
    force_n = run.channel("force")
    lsb_m = run.conditions.channels["displacement"].lsb

    def course(plant: Plant, state: NDArray[np.float64], forces: NDArray[np.float64]) -> NDArray[np.float64]:
        m, b, k = plant.parameters()["M"], plant.parameters()["B"], plant.parameters()["K"]
        step = expm(np.array([[0, 1, 0], [-k / m, -b / m, 1 / m], [0, 0, 0]]) * 0.01)[:2]
        out = [state]
        for each in forces:
            out.append(step @ [*out[-1], each])
        return np.array(out[1:])

    state = course(FRONT, np.zeros(2), force_n[:420])[-1]
    truth = course(after, state, force_n[420 : 420 + bound_n])[:, 0]

    def divergence(factor: float, name: str, samples: int) -> float:
        rival = course(FRONT.scaled(name, factor), state, force_n[420 : 420 + samples])[:, 0]
        return float(np.sum(((rival - truth[:samples]) / lsb_m) ** 2) / (2.0 * (1.0 + 1.0 / 12.0)))

    def least(samples: int) -> float:
        rivals = [name for name in "MBK" if (name,) != tuple(FRONT.changes_to(after))]
        searches = (
            minimize_scalar(divergence, bounds=bounds, args=(name, samples), method="bounded", options={"xatol": 1e-6})
            for name in rivals
            for bounds in ((0.25, 1.0), (1.0, 4.0))
        )
        return min(float(search.fun) for search in searches)

    assert least(bound_n) >= math.log(20.0) * 0.98
    assert least(bound_n - 1) < math.log(20.0) * 1.02


def test_change_of_an_unloaded_suspension_cannot_be_isolated() -> None:
    run = made_run(force_n=np.zeros(600), plants=[(0, FRONT), (400, SOFT)])
    assert information.isolation_bounds(run) == [None]
