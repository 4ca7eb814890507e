"""False-positive rate of the self-test on machines within tolerance, and their distance from its limits.

python -m tests.bench self-test
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from analogrig.judging.statistics import upper_rate
from analogrig.rigs.emulator import CardDescription, ComputerDescription, EmulatorDescription, EmulatorRig
from analogrig_emulator import CHANNELS
from analogrig_instruments.self_test import self_test

from .figure import Figure

MACHINES = 200
"""Machines of each program, drawn from the seeds from 0 on."""

CONFIDENCE = 0.95


def figures() -> Iterator[Figure]:
    """Machines with a false positive; for each quantity the largest part of its limit that was measured."""
    card = CardDescription(range_v=dict.fromkeys(CHANNELS, (-10.0, 10.0)), noise_lsb=1.0)
    rig = EmulatorRig(EmulatorDescription(card, computer=ComputerDescription(components="polyester"), name="drawn"))
    for program in ("front", "shock"):
        found = [self_test(rig, seed, program) for seed in range(MACHINES)]
        wrong = sum(not findings.well for findings in found)
        yield Figure(
            f"self-test, {program}: machines of 1 % and 5 % parts that are found wrong, of {MACHINES}",
            wrong,
            "",
            bounds=(0.0, MACHINES * upper_rate(wrong, MACHINES, CONFIDENCE)),
        )
        for i, check in enumerate(found[0].checks):
            if check.error:
                values = np.array([findings.checks[i].value for findings in found])
                yield Figure(
                    f"self-test, {program}: {check.title}",
                    float(np.abs(values).max()),
                    f"{check.unit}, limit {check.most:.3g}",
                )
