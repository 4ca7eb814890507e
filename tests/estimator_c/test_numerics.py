"""Float32 over long runs, against extended precision, and at any scale."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.signal import lfilter

from tests.estimator_c.est_driver import LOCKED, NONE, UPDATED, Estimator
from tests.estimator_c.test_est_estimation import record
from tests.estimator_c.test_est_trigger import FRONT, suspension

Codes = NDArray[np.float64]
Extended = NDArray[np.longdouble]

REST_CODES = 410.0
"""The displacement that suspension() has without force."""
A_FRONT = (-1.7499, 0.7687)
"""a1 and a2 of the front suspension, sampled at 100 Hz of problem time."""
BLOCK_N = 500_000


def excited(edges_n: int, samples: int, seed: int) -> tuple[Codes, Codes]:
    return suspension([(0, FRONT)], np.linspace(10.0, 50.0 * edges_n - 40.0, edges_n), samples, 1.0, seed)


QUIET_N = 2_000_000
"""The weight halves 88,000 times: what grows by 0.1 % each time is beyond float32 by then, as exp(88) is."""


@pytest.mark.parametrize("noise_lsb", [0.0, 1.0], ids=["silent", "1 LSB of noise"])
def test_millions_of_samples_without_excitation_do_no_harm(estimator: Estimator, noise_lsb: float) -> None:
    """The driver asks est_invariants_hold() after every sample: theta finite, every d positive and finite."""
    rng = np.random.default_rng(1)
    assert estimator.init(forgetting=0.97, noise_estimated=0, ceiling=20.0)
    estimator.run(*excited(6, 400, seed=4))
    for _ in range(QUIET_N // BLOCK_N):
        y = REST_CODES + np.round(rng.normal(0.0, 1.0, BLOCK_N) * noise_lsb)
        quiet = estimator.run(np.zeros(BLOCK_N), y)
        assert np.isfinite(quiet.innovation).all()
        assert np.isfinite(quiet.variance).all()
        assert len(quiet.alarms) == 0
    assert quiet.counters["updated"] == QUIET_N + 400
    returned = estimator.run(*excited(6, 300, seed=3))
    assert returned.theta[10 + 30 :, :2] == pytest.approx(np.tile(A_FRONT, (260, 1)), abs=0.02)
    assert len(returned.alarms) == 0


class WideFactors:
    """Bierman's measurement update (1977, section V.3), in long double; each time the weight halves d is limited."""

    def __init__(self, prior: list[np.longdouble]) -> None:
        self.prior = np.array(prior, np.longdouble)
        self.d, self.u = self.prior.copy(), np.eye(len(prior), dtype=np.longdouble)
        self.theta, self.weight = np.zeros(len(prior), np.longdouble), np.longdouble(1.0)

    def enter(self, phi: Extended, y: np.longdouble, forgetting: np.longdouble) -> None:
        if self.weight < 0.5:
            self.d, self.weight = np.minimum(self.d / self.weight, self.prior), np.longdouble(1.0)
        f = self.u.T @ phi
        v = self.d * f
        self.weight *= forgetting
        innovation, alpha = y - phi @ self.theta, self.weight
        gain = np.zeros_like(v)
        for j in range(len(v)):
            before, alpha = alpha, alpha + f[j] * v[j]
            self.d[j] *= before / alpha
            column = self.u[:j, j].copy()
            self.u[:j, j] -= gain[:j] * (f[j] / before)
            gain[:j] += column * v[j]
            gain[j] = v[j]
        self.theta += gain * (innovation / alpha)


class Wide(NamedTuple):
    """Result of exact arithmetic on a record."""

    theta: Extended
    """(n, p) after each sample."""
    phi: Extended
    """(n, p): the regressor of each sample, prefiltered; zero before the first equation."""
    y: Extended
    """(n,) likewise."""


def wide(u: Codes, y: Codes, settings: Mapping[str, Any]) -> Wide:
    """With the constants of the estimator, which are float32."""
    na, nb, nk, offset = (int(settings[name]) for name in ("na", "nb", "nk", "offset"))
    forgetting, p0, *c = (
        np.longdouble(np.float32(x)) for x in (settings["forgetting"], settings["p0"], *settings["c"])
    )
    first = max(na, nb + nk - 1)
    signals = [*(-np.roll(y, i + 1) for i in range(na)), *(np.roll(u, nk + i) for i in range(nb))]
    signals += [np.ones_like(y)] * offset
    columns = [lfilter([1.0], [1.0, *c], x[first:].astype(np.longdouble)) for x in (*signals, y)]
    equations = np.zeros((len(y), len(columns)), np.longdouble)
    equations[first:] = np.column_stack(columns)
    phi, target = equations[:, :-1], equations[:, -1]
    factors = WideFactors([p0] * (na + nb) + [np.longdouble(1e6)] * offset)
    theta = np.zeros_like(phi)
    for k in range(first, len(y)):
        factors.enter(phi[k], target[k], forgetting)
        theta[k] = factors.theta
    return Wide(theta, phi, target)


PLAIN: dict[str, Any] = {"kind": NONE, "edge_instants": LOCKED, "refresh_n": 0, "stuck_n": 0, "p0_offset": 1e6}


@pytest.mark.parametrize(
    ("c", "forgetting"),
    [((0.0, 0.0), 0.97), ((0.0, 0.0), 0.99), ((0.0, 0.0), 1.0), ((-1.6, 0.64), 0.97), ((-1.6, 0.64), 0.99)],
    ids=str,
)
def test_theta_on_rich_data_is_that_of_extended_precision(
    estimator: Estimator, c: tuple[float, float], forgetting: float
) -> None:
    """A random binary force moves every element of theta; by sample 1000 the gains of the whitening have come to C."""
    data = record(3000, noise=3.0, offset=40.0)
    settings = PLAIN | {"na": 2, "nb": 2, "nk": 0, "offset": 1, "c": c, "forgetting": forgetting, "p0": 10.0}
    assert estimator.init(**settings)
    theta = estimator.run(*data).theta[1000:]
    expected = wide(*data, settings).theta[1000:]
    for part in (slice(0, 2), slice(2, 4), slice(4, 5)):  # a, b and the offset, each against the largest of its kind
        error = np.abs(theta[:, part] - expected[:, part]).max(axis=1)
        assert (error <= 1e-5 * np.abs(expected[:, part]).max(axis=1)).all()


@pytest.mark.parametrize("c", [(0.0, 0.0), (-1.6, 0.64)], ids=str)
@pytest.mark.parametrize("forgetting", [0.97, 0.99, 0.998])
def test_suspension_is_predicted_as_in_extended_precision(
    estimator: Estimator, c: tuple[float, float], forgetting: float
) -> None:
    """A square wave tells the b's hardly apart, so that what is compared is what theta says of the displacement."""
    edges = np.cumsum(np.random.default_rng(0).integers(3, 40, 100)).astype(float)
    u, y = suspension([(0, FRONT)], edges, 2000, 1.0, 3)
    settings = PLAIN | {"na": 2, "nb": 3, "nk": 0, "offset": 1, "c": c, "forgetting": forgetting, "p0": 10.0}
    assert estimator.init(**settings)
    exact = wide(u, y, settings)
    error = ((estimator.run(u, y).theta - exact.theta) * exact.phi).sum(axis=1)[1000:]
    assert np.abs(error).max() <= 1e-5 * np.abs(exact.y).max()


@settings(
    max_examples=80,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    orders=st.fixed_dictionaries(
        {"na": st.integers(1, 2), "nb": st.integers(1, 3), "nk": st.integers(0, 1), "offset": st.integers(0, 1)}
    ),
    forgetting=st.sampled_from([0.9, 0.97, 1.0]),
    exponents=st.tuples(st.floats(-6.0, 5.5), st.floats(-6.0, 5.5)),
    vagueness=st.floats(-2.0, 8.0),
    seed=st.integers(0, 2**32 - 1),
)
def test_prediction_at_any_order_and_scale_is_that_of_extended_precision(
    estimator: Estimator,
    orders: dict[str, int],
    forgetting: float,
    exponents: tuple[float, float],
    vagueness: float,
    seed: int,
) -> None:
    """Codes from 1e-6 to the limit of 1e6, each channel at its own scale; the prior up to 1e8 times as vague as an
    equation. Beyond some 1e14, the square of what float32 resolves, the first equations cannot be told apart."""
    rng = np.random.default_rng(seed)
    scale_u, scale_y = 10.0 ** exponents[0], 10.0 ** exponents[1]
    p0 = float(np.clip(10.0**vagueness / max(scale_u, scale_y) ** 2, 1.1e-9, 0.9e9))
    u = rng.integers(0, 2, 300) * 2.0 - 1.0
    y = np.asarray(lfilter([0.0, -0.9], [1.0, 0.5, 0.8], u)) / 4.0 + rng.normal(0.1, 0.01, 300)
    codes = [(x * scale).astype(np.float32).astype(np.float64) for x, scale in ((u, scale_u), (y, scale_y))]
    settings = PLAIN | orders | {"c": (0.0, 0.0), "forgetting": forgetting, "p0": p0}
    assert estimator.init(**settings)
    exact = wide(codes[0], codes[1], settings)
    result = estimator.run(*codes)
    assert (result.status[3:] == UPDATED).all()
    error = ((result.theta - exact.theta) * exact.phi).sum(axis=1)
    assert np.abs(error).max() <= 1e-5 * np.abs(exact.y).max()


def test_a_c_is_taken_iff_its_zeros_are_inside_the_unit_circle(estimator: Estimator) -> None:
    """Omit zeros closer to the circle than 0.02: double zeros there would filter the data into overflow."""
    for c1 in np.linspace(-2.3, 2.3, 47):
        for c2 in np.linspace(-1.2, 1.2, 25):
            radius = np.abs(np.roots([1.0, c1, c2])).max()
            if abs(radius - 1.0) > 0.02:
                assert estimator.init(c=(float(c1), float(c2))) == (radius < 1.0), (c1, c2)


def test_extended_least_squares_finds_a_c_of_one_element(estimator: Estimator) -> None:
    """40,000 samples: the standard error of c1 is 0.005."""
    rng = np.random.default_rng(1)
    u = np.where(rng.random(40_000) < 0.5, -500.0, 500.0)
    e = rng.normal(0.0, 20.0, len(u))
    a, b, c = [1.0, -1.5, 0.7], [0.0, 0.2], [1.0, 0.5]
    y = lfilter(b, a, u) + lfilter(c, a, e)
    assert estimator.init(na=2, nb=1, nk=1, nc=1, offset=0, c=(0.0, 0.0), kind=NONE, forgetting=1.0, refresh_n=0)
    theta = estimator.run(u, y).theta[-1]
    assert theta[:4] == pytest.approx([a[1], a[2], b[1], c[1]], abs=0.03)
