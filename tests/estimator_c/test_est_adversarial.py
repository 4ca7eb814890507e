"""Invariants of the state, for any configuration and any data."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray

from tests.estimator_c.est_driver import Estimator

N = 300

VARIANCES = st.floats(-9.0, 9.0).map(lambda exponent: 10.0**exponent).filter(lambda x: 1e-9 < x < 1e9)

CONFIGURATIONS = st.fixed_dictionaries(
    {
        "na": st.integers(1, 2),
        "nb": st.integers(1, 3),
        "nk": st.integers(0, 1),
        "nc": st.sampled_from([0, 0, 1, 2]),
        "noise_estimated": st.integers(0, 1),
        "refresh_n": st.sampled_from([0, 1, 20]),
        "stuck_n": st.sampled_from([0, 1, 16]),
        "random_walk": st.sampled_from([0.0, 0.0, 1e-9, 1.0, 1e9]),
        "offset": st.integers(0, 1),
        "forgetting": st.sampled_from([0.5, 0.97, 0.998, 1.0]),
        "p0": VARIANCES,
        "p0_offset": VARIANCES,
        "noise_variance": VARIANCES,
        "c": st.tuples(st.floats(-0.99, 0.99), st.floats(-0.99, 0.99)).map(
            lambda poles: (-poles[0] - poles[1], poles[0] * poles[1])
        ),
        "edge_codes": st.sampled_from([1.0, 64.0]),
        "edge_instants": st.integers(0, 2),
        "kind": st.integers(0, 3),
        "ceiling": st.floats(1e-3, 1e6),
        "hold_off_n": st.integers(0, 9),
        "warm_up_n": st.integers(0, 9),
        "absolute": st.integers(0, 1),
        "reset": st.integers(0, 1),
    }
)


def signal(kind: str, scale: float, rng: np.random.Generator) -> NDArray[np.float64]:
    k = np.arange(N)
    signs = rng.choice([-1.0, 1.0], N)
    signals: dict[str, ArrayLike] = {
        "noise": rng.normal(size=N) * scale,
        "square": np.where(k // 7 % 2, scale, -scale),
        "alternating": np.where(k % 2, scale, -scale),
        "growing": np.geomspace(1e-6, 0.99e6, N) * (-1.0) ** (k // 5),
        "logarithmic": signs * 10.0 ** rng.uniform(-6.0, 6.0, N),
        "impulses": np.where(rng.random(N) < 0.02, 0.99e6 * signs, scale),
        "zero": np.zeros(N),
        "constant": np.full(N, scale),
        "denormal": np.full(N, 1e-42),
    }
    return np.asarray(signals[kind])


KINDS = st.sampled_from("noise square alternating growing logarithmic impulses zero constant denormal".split())


@pytest.mark.parametrize("examples", [100, pytest.param(400, marks=pytest.mark.heavy)])
def test_invariants_hold_after_every_sample(estimator: Estimator, examples: int) -> None:
    """The driver asks est_invariants_hold() after every sample, and fails if it does not."""

    @settings(max_examples=examples, deadline=None, derandomize=True, database=None)
    @given(
        configuration=CONFIGURATIONS,
        kinds=st.tuples(KINDS, KINDS),
        exponent=st.floats(-6.0, 6.0),
        missing=st.sampled_from([0.0, 0.02, 0.3]),
        seed=st.integers(0, 2**32 - 1),
    )
    def hold(
        configuration: dict[str, float], kinds: tuple[str, str], exponent: float, missing: float, seed: int
    ) -> None:
        rng = np.random.default_rng(seed)
        assume(estimator.init(**configuration))
        u, y = (signal(kind, 10.0**exponent, rng) for kind in kinds)
        result = estimator.run(u, y, rng.random(N) >= missing)
        for values in (result.theta, result.innovation, result.statistic, result.variance):
            assert np.isfinite(values).all()

    hold()


def barely_excited(seed: int, n: int, *, rest: float, busy: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A u that rests but for a part of the samples, a y that says more."""
    rng = np.random.default_rng(seed)
    u = np.where(rng.random(n) < busy, 4095.0 * rng.choice([-1.0, 1.0], n), rest)
    return u, np.where(np.arange(n) % 2, 1e5, -1e5)


VAGUE = {"p0": 1e3, "forgetting": 0.5, "ceiling": 1e6, "warm_up_n": 150, "edge_instants": 0}
"""A prior much vaguer than such data, and a short memory: theta grows beyond any number."""


@pytest.mark.parametrize(
    "settings",
    [{}, {"kind": 0, "warm_up_n": 0}, {"warm_up_n": 2000}, {"warm_up_n": 2000, "edge_instants": 1}, {"nc": 2, "nb": 2}],
    ids=["sum", "none", "held", "in doubt", "residuals"],
)
def test_theta_that_overflows_begins_anew(estimator: Estimator, settings: dict[str, float]) -> None:
    anew = 0
    for seed in range(60):
        assert estimator.init(**VAGUE | {"p0": 1e6, "offset": 0} | settings)
        result = estimator.run(*barely_excited(seed, 2000, rest=1e-4, busy=0.2))
        assert np.isfinite(result.theta).all()
        overflowed = result.alarms[~(result.statistic[result.alarms] < np.finfo(np.float32).max)]
        assert (result.theta[overflowed] == 0.0).all()
        anew += len(overflowed)
    assert anew > 0  # it does happen


def test_p_that_overflows_with_theta_begins_anew_at_once(estimator: Estimator) -> None:
    """Says est_invariants_hold(), which the driver asks; otherwise P waits for the next sample."""
    for seed in range(60):
        assert estimator.init(**VAGUE)
        estimator.run(*barely_excited(seed, 400, rest=1e-6, busy=0.1))
