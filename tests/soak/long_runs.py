"""Synthetic runs of any length, without rig and device."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from analogrig.run import Run
from tests.harness.plants import front
from tests.harness.reported import reported_run
from tests.harness.runs import made_run

FIRM, SOFT = front(115.0, 3021.0, 24500.0), front(115.0, 3021.0, 18000.0)
SETTLED = 1100
"""A sample of ``reported_run`` whose estimate is the plant FIRM."""


def long_run(samples: int, false_alarms: int = 3, changes: int = 1) -> Run:
    """A square force and noise in every signal, which no compression makes small; ``changes`` of the plant, each
    noticed after five samples, and false alarms evenly over the rest."""
    rng = np.random.default_rng(3)
    changed_at = [(k + 1) * samples // (changes + 1) for k in range(changes)]
    plants = [(0, FIRM), *((at, SOFT if k % 2 == 0 else FIRM) for k, at in enumerate(changed_at))]
    false = np.linspace(2000, samples - 2000, false_alarms, dtype=int).tolist()
    alarms = sorted({*(at + 5 for at in changed_at), *false})
    run = made_run(
        np.where(np.arange(samples) // 50 % 2, 2900.0, 30.0),
        plants,
        alarms=alarms,
        theta=np.broadcast_to(reported_run().theta[SETTLED], (samples, 6)),
    )
    codes = run.codes
    codes[:, 1:] = rng.integers(1000, 3000, (samples, 3), dtype=np.uint16)
    theta = run.theta
    for i in range(theta.shape[1]):
        theta[:, i] *= rng.normal(1.0, 1e-5, samples).astype(np.float32)
    statistic = rng.exponential(1.0, samples).astype(np.float32)
    return replace(run, statistic=statistic)
