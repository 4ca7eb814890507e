"""Watch of the fit: share of the runs in which the right cause is stated, and misfits of healthy plants.

The front suspension at 12 bits and 1 LSB, its generator free-running at 20 ppm, random phase, fixed seed.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from tests.estimator_c import misfits
from tests.estimator_c.est_driver import WARM_UP_N, Estimator, compile_driver
from tests.estimator_c.plants import FRONT, Mechanics, random_plants, simulate

from .figure import Figure

STATED_BY_N = 2000
LATER_N = 4000
HEALTHY_N = 20_000
CHANGED_AT = 1500
SEED = 41


def figures(trials: int = 100) -> Iterator[Figure]:
    """One row a condition, then the healthy plants and the changes."""
    with tempfile.TemporaryDirectory() as folder:
        estimator = Estimator(compile_driver(Path(folder)))
        assert estimator.init(warm_up_n=WARM_UP_N)
        for name, condition in misfits.CONDITIONS.items():
            watched = estimator.watch_fit(*condition.play(trials, LATER_N, SEED))
            by_then, later = (100.0 * watched.share(condition.cause, k) for k in (STATED_BY_N - 1, LATER_N - 1))
            remark = f"{condition.cause}; {later:.0f} % at sample {LATER_N}"
            yield Figure(f"{name}: right cause at sample {STATED_BY_N}", by_then, "%", remark)
        plants = {"healthy front suspension": [FRONT], "healthy random plants": random_plants(10, SEED)}
        for name, every in plants.items():
            runs = [_misfits(estimator, (plant, plant), HEALTHY_N, trials // len(every)) for plant in every]
            yield Figure(f"{name}, {HEALTHY_N} samples: runs with a misfit", float(sum(runs)), f"of {trials}")
        for parameter in "MBK":
            for factor in (0.8, 1.2):
                found = _misfits(estimator, (FRONT, FRONT.scaled(parameter, factor)), LATER_N, trials)
                name = f"{parameter}{100 * (factor - 1):+.0f}% at sample {CHANGED_AT}: runs with a misfit"
                yield Figure(name, float(found), f"of {trials}")


def _misfits(estimator: Estimator, plants: tuple[Mechanics, Mechanics], samples: int, trials: int) -> int:
    """Number of runs in which some misfit was stated."""
    onset = np.full(trials, CHANGED_AT)
    played = simulate(plants, onset, misfits.FREE, samples, SEED)
    return int(estimator.watch_fit(played.u, played.y).cause.any(axis=1).sum())
