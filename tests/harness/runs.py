"""Synthetic runs for tests."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig.catalogue import Cause, Change
from analogrig.plant import Plant, Segment
from analogrig.run import Channel, Conditions, Run
from analogrig_emulator import CHANNELS

N_PER_CODE, M_PER_CODE = 2940.0 / 4096, 0.1996 / 4096

_DTYPES = {"index": np.int64, "onset": np.int64, "kind": np.uint8, "change": np.uint8, "cause": np.uint8}
"""Types of arrays by the second word of their names; others are float32."""

ESTIMATOR = {"na": 2, "nb": 3, "nk": 0, "offset": True, "trigger": "cusum", "ceiling": 11.512925}


def made_run(
    force_n: NDArray[np.float64],
    plants: Sequence[tuple[int, Plant]],
    noise_lsb: float = 1.0,
    clipped: NDArray[np.bool_] | None = None,
    alarms: Sequence[int] = (),
    diagnoses: Sequence[tuple[int, Change, int, float]] = (),
    misfits: Sequence[tuple[int, Cause, float, float]] = (),
    expect: Mapping[str, float] | None = None,
    faults: tuple[str, ...] = (),
    samples_asked: int | None = None,
    theta: NDArray[np.floating] | None = None,
    estimator: Mapping[str, object] | None = None,
) -> Run:
    """Run of the given force; ``clipped`` applies to the displacement. Without ``theta`` all estimates are zero.

    :param diagnoses: of each the sample after which it was said, what, the onset and the extent.
    :param misfits: of each the sample, the cause, the frequency in cycles per sample, and the strength.
    """
    n = len(force_n)
    codes = np.zeros((n, 4), np.uint16)
    codes[:, 0] = np.round(force_n / N_PER_CODE)
    flags = np.zeros((n, 4), bool)
    if clipped is not None:
        flags[:, CHANNELS.index("displacement")] = clipped
    conditions = Conditions(
        seed=1,
        samples_asked=n if samples_asked is None else samples_asked,
        sample_period_s=5e-5,
        time_scale=200.0,
        channels=_channels(noise_lsb),
        segments=tuple(Segment(start, plant) for start, plant in plants),
        scenario={"name": "made", "expect": expect or {}},
        rig={"name": "by hand"},
        dut={"name": "nobody", "estimator": estimator or ESTIMATOR},
        link="none",
        faults=faults,
    )
    return Run(
        conditions=conditions,
        codes=codes,
        clipped=flags,
        theta=np.zeros((n, 6), np.float32) if theta is None else theta.astype(np.float32),
        innovation=np.zeros(n, np.float32),
        statistic=np.zeros(n, np.float32),
        flags=np.zeros(n, np.uint8),
        **_columns(("alarm_index", "alarm_kind", "alarm_statistic"), [(alarm, 3, 12.0) for alarm in alarms]),
        **_columns(("diagnosis_index", "diagnosis_change", "diagnosis_onset", "diagnosis_extent"), diagnoses),
        **_columns(("misfit_index", "misfit_cause", "misfit_frequency", "misfit_strength"), misfits),
    )


def _channels(noise_lsb: float) -> dict[str, Channel]:
    return {
        "force": Channel(0.0, 10.0 / 4096, "N", 294.0, noise_lsb),
        "displacement": Channel(0.0, 10.0 / 4096, "m", 0.01996, noise_lsb),
        "velocity": Channel(-10.0, 20.0 / 4096, "m/s", 0.2, noise_lsb),
        "net_force": Channel(-12.5, 25.0 / 4096, "N", 294.0, noise_lsb),
    }


def _columns(names: Sequence[str], rows: Sequence[Sequence[float]]) -> dict[str, Any]:
    """Arrays of a run, one for each name, from rows of what the device said."""
    columns = list(zip(*rows, strict=True)) or [()] * len(names)
    return {
        name: np.array(column, _DTYPES.get(name.split("_")[1], np.float32))
        for name, column in zip(names, columns, strict=True)
    }


def with_fault(run: Run, fault: str) -> Run:
    """The same run with a fault, which makes it invalid."""
    return dataclasses.replace(run, conditions=dataclasses.replace(run.conditions, faults=(fault,)))
