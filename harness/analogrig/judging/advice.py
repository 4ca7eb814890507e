"""What a user should know beyond the verdict: settings that do not fit together, and what could not be seen."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from analogrig import config
from analogrig.judging.information import QUANTISATION_VARIANCE_LSB2
from analogrig.judging.verdict import Verdict
from analogrig.run import Run
from analogrig.wording import number_of
from analogrig_emulator import TICKS_PER_SAMPLE, Excitation

NOISE_MARGIN = 1.05
"""The device may be set for this much less noise than there is before it matters."""

WARM_UP_EDGES = 2
"""Without so many the estimate knows next to nothing of the plant."""

MOST_EDGE_SHIFT = 1.5e-3
"""From one edge to the next, in samples: 30 ppm of drift at an edge every 50 samples."""

_SAMPLES_LOOKED_AT = 4000


def advice(run: Run, verdict: Verdict) -> tuple[str, ...]:
    """Sentences, the gravest first; empty if all is well."""
    return (
        *_assumed_settings(run),
        *_overloads(verdict),
        *_noise_setting(run),
        *_edge_spacing(run),
        *_warm_up(run),
        *_false_alarm_rate(verdict),
        *_undetectable_changes(verdict),
        *_implausible_estimates(verdict),
    )


def _assumed_settings(run: Run) -> Iterator[str]:
    assumed_n = run.conditions.dut.get("assumed_n", 0)
    if assumed_n:
        settings = number_of(
            assumed_n,
            "setting of the device is not in the log and was",
            "settings of the device are not in the log and were",
        )
        yield (
            f"{settings} taken to be as by default:"
            " if they were not, bounds and estimates are wrong; capture from the handshake on"
        )


def _overloads(verdict: Verdict) -> Iterator[str]:
    if verdict.overloads:
        names = ", ".join(sorted(verdict.overloads))
        yield (
            f"{names} overloaded from sample {min(verdict.overloads.values())} on: the computer was then not the plant"
            " of the scenario, and estimates and alarms may be true to it"
        )


def _noise_setting(run: Run) -> Iterator[str]:
    there = run.conditions.channels["displacement"].noise_lsb ** 2 + QUANTISATION_VARIANCE_LSB2
    expected = float(run.conditions.dut["estimator"].get("noise_variance", np.inf))
    if there > NOISE_MARGIN * expected:
        yield (
            f"the rig's noise has a variance of {there:.2g} codes^2, the device is set for {expected:.2g}:"
            " false alarms are to be expected until its noise_variance is raised"
        )


def _edge_spacing(run: Run) -> Iterator[str]:
    estimator = run.conditions.dut["estimator"]
    if "excitation" not in run.conditions.scenario or estimator.get("edge_instants") == "anywhere":
        return
    excitation = config.build(Excitation, run.conditions.scenario["excitation"], "the recorded excitation")
    if excitation.clock == "card":
        return
    rate_hz = 1.0 / run.conditions.sample_period_s
    instants = excitation.edges(0, _SAMPLES_LOOKED_AT * TICKS_PER_SAMPLE, rate_hz).ticks[1:] / TICKS_PER_SAMPLE
    intervals = np.diff(instants)
    if len(intervals) and np.abs(intervals - np.round(intervals)).max() > MOST_EDGE_SHIFT:
        yield (
            "the edges of the excitation do not come a whole number of samples apart: false alarms are to be expected"
            ' until the device is set to edge_instants = "anywhere" (as the device any-edges is)'
        )


def _warm_up(run: Run) -> Iterator[str]:
    warm_up_n = run.conditions.dut["estimator"].get("warm_up_n")
    if "excitation" not in run.conditions.scenario or warm_up_n is None:
        return
    excitation = config.build(Excitation, run.conditions.scenario["excitation"], "the recorded excitation")
    rate_hz = 1.0 / run.conditions.sample_period_s
    instants = excitation.edges(0, _SAMPLES_LOOKED_AT * TICKS_PER_SAMPLE, rate_hz).ticks[1:] / TICKS_PER_SAMPLE
    if len(instants) < WARM_UP_EDGES or instants[WARM_UP_EDGES - 1] >= warm_up_n:
        yield (
            f"the device's warm-up of {number_of(warm_up_n, 'sample')} ends before {WARM_UP_EDGES} edges of the"
            " excitation came: false alarms are to be expected at the first ones until its warm_up_n is longer"
        )


def _false_alarm_rate(verdict: Verdict) -> Iterator[str]:
    if len(verdict.false_alarms) > max(2, len(verdict.tweaks)):
        yield "with so many false alarms, an alarm soon after a change may be chance and its latency no merit"


def _undetectable_changes(verdict: Verdict) -> Iterator[str]:
    for tweak in verdict.tweaks:
        if tweak.bound_n is None and not tweak.unseen:
            yield f"{tweak.what} at {tweak.sample} could not be seen before the next change or the end: not judged"


def _implausible_estimates(verdict: Verdict) -> Iterator[str]:
    for segment in verdict.estimates:
        if segment.estimate is None:
            yield f"the last estimate of samples {segment.start}-{segment.end - 1} describes no mass, damper and spring"
