"""Detection over many seeds: emulated computer and card, C estimator in this process, shipped settings."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig.bench import Bench
from analogrig.devices.device import DeviceDescription
from analogrig.devices.library import InprocDevice
from analogrig.devices.registry import open_dut
from analogrig.judging.verdict import SegmentEstimate, Verdict, judge
from analogrig.rigs.description import open_rig
from analogrig.scenario import Scenario


@dataclass(frozen=True, eq=False)
class Detection:
    """Results of r runs of a scenario with t pot changes."""

    latencies_n: NDArray[np.float64]
    """(r, t) samples; NaN without an alarm."""
    bounds_n: NDArray[np.float64]
    """(r, t) samples; NaN for a change that cannot be detected."""
    errors: NDArray[np.float64]
    """(r, t + 1, 3) relative errors of M, B, K at the end of each stretch; NaN without an estimate."""
    missed: int
    false_alarms: int
    inconclusive: int
    runs: int

    def ratios(self) -> NDArray[np.float64]:
        """Mean latency over mean bound (t,), over the runs with both."""
        both = np.isfinite(self.latencies_n) & np.isfinite(self.bounds_n)
        latency, bound = (np.where(both, x, 0.0).sum(axis=0) for x in (self.latencies_n, self.bounds_n))
        return np.asarray(latency / bound)

    def ratio_errors(self) -> NDArray[np.float64]:
        """Standard error (t,) of each ratio, by the delta method."""
        means = np.nanmean(self.bounds_n, axis=0)
        residuals = self.latencies_n - self.ratios() * self.bounds_n
        return np.asarray(np.nanstd(residuals, axis=0, ddof=1) / np.sqrt(self.runs) / means)


def shipped_device_in_process() -> DeviceDescription:
    """Device with the settings of `host` in this process: same C, same messages, no pseudo terminal."""
    with open_dut("host") as dut:
        table = dict(dut.description())
    with open_dut("inproc") as dut:
        assert dut.description()["estimator"] == table["estimator"]
    return InprocDevice(name="inproc", exchange="block")


def detect(scenario_name: str, rig_name: str, seeds: Iterable[int]) -> Detection:
    """Play a shipped scenario on a shipped rig once for each seed."""
    scenario = Scenario.load(scenario_name)
    with open_rig(rig_name) as rig, shipped_device_in_process().connect() as dut:
        bench = Bench(rig, dut)
        verdicts = [judge(bench.play(scenario, seed)) for seed in seeds]
    return Detection(
        latencies_n=_by_change(verdicts, "latency_n"),
        bounds_n=_by_change(verdicts, "bound_n"),
        errors=np.array([[_errors(segment) for segment in verdict.estimates] for verdict in verdicts]),
        missed=sum(change.missed for verdict in verdicts for change in verdict.changes),
        false_alarms=sum(len(verdict.false_alarms) for verdict in verdicts),
        inconclusive=sum(not verdict.valid for verdict in verdicts),
        runs=len(verdicts),
    )


def _errors(segment: SegmentEstimate) -> list[float]:
    return [segment.error.get(name, np.nan) for name in segment.truth]


def _by_change(verdicts: list[Verdict], field: str) -> NDArray[np.float64]:
    return np.array([[getattr(change, field) for change in verdict.changes] for verdict in verdicts], dtype=np.float64)
