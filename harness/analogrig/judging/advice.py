"""Advice beyond the verdict: inconsistent settings, undetectable changes, implausible estimates."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from analogrig.estimator_config import EstimatorConfig
from analogrig.judging.information import QUANTISATION_VARIANCE_LSB2
from analogrig.judging.misread import misreadings
from analogrig.judging.verdict import (
    DIAGNOSES,
    ESTIMATES,
    Verdict,
    is_beyond_model,
    unreported,
)
from analogrig.run import LOST, UNREPORTED, Run
from analogrig.wording import number_of
from analogrig_emulator import TICKS_PER_SAMPLE, Excitation

NOISE_MARGIN = 1.05
"""Largest ratio of the measured to the configured noise variance that needs no advice."""

WARM_UP_EDGES = 2
"""Edges of the excitation that the estimate needs to converge."""

MOST_EDGE_SHIFT = 1.5e-3
"""Largest deviation of an edge interval from whole samples: 30 ppm of drift with an edge every 50 samples."""

_EXAMINED_SAMPLES = 4000

_LEVEL_V = 0.01
"""Difference of two levels that matters to no scale."""


def advice(run: Run, verdict: Verdict) -> tuple[str, ...]:
    """Sentences of advice, the most severe first; empty if there is nothing to advise."""
    if not run.samples:
        return ()
    return (
        *_statement(run),
        *run.conditions.losses,
        *run.conditions.remarks,
        *misreadings(run, verdict),
        *misfits(verdict),
        *_orders(run, verdict),
        *_unjudged_quantities(run, verdict),
        *_theta_without_a_model(run),
        *_assumed_settings(run),
        *_overloads(verdict),
        *_excitation_beyond_the_scales(run, verdict),
        *_inputs_at_rest(run),
        *_channel_faults(verdict),
        *_wrong_diagnoses(verdict),
        *_noise_setting(run),
        *_edge_spacing(run),
        *_warm_up(run),
        *_changes_in_warm_up(run, verdict),
        *_false_alarm_rate(verdict),
        *_undetectable_changes(verdict),
        *_implausible_estimates(run, verdict),
    )


def misfits(verdict: Verdict) -> Iterator[str]:
    """One sentence for each cure of a misfit."""
    for cure, periods in itertools.groupby(
        sorted(verdict.fit or (), key=attrgetter("cure", "cause")), attrgetter("cure")
    ):
        causes = ", ".join(dict.fromkeys(period.cause for period in periods))
        yield f"the model does not fit ({causes}): alarms may be false, and changes missed; {cure}"


def _orders(run: Run, verdict: Verdict) -> Iterator[str]:
    """Sentence on the orders of a model that the program chose, or that are below those of the program."""
    program, model, estimator = run.conditions.program, run.datasheet.model, run.conditions.estimator
    if not run.conditions.segments or model is None or (estimator is not None and estimator.trigger == "none"):
        return
    if estimator is not None and estimator.orders == "program" and model.na != EstimatorConfig.na:
        yield (
            f"the program {program.name}, of order {program.order}, chose the device's settings: na = {model.na},"
            f" nb = {model.nb}, forgetting = {estimator.forgetting:g}, C fixed"
        )
    elif model.na < program.order:
        cure = ' set orders = "program" under [estimator]' if estimator else " choose a model of that order"
        yield f"the device models {model.na} of the {program.order} poles of the program {program.name}:{cure}"
    elif is_beyond_model(run) and (
        model.na < (states := len(program.equations.states)) or (verdict.outcome == "failed" and not verdict.fit)
    ):
        yield (
            f"the program {program.name} is not linear and has {number_of(states, 'state')}, the device's model is"
            f" linear, of order {model.na}: if it does not fit, reduce the amplitude of the excitation, or raise na and"
            " nb in a device file"
        )


def _unjudged_quantities(run: Run, verdict: Verdict) -> Iterator[str]:
    absent = unreported(run.datasheet)
    if {*absent} - {DIAGNOSES}:  # many devices have no diagnoses, and lack nothing
        yield f"not judged, because the device does not report them: {', '.join(absent)}"
    if others := [name for name in verdict.not_judged if name not in absent]:
        yield f"not judged on the program {run.conditions.program.name}: {', '.join(others)}"
    if verdict.cannot_tell:
        yield f"the device's protocol does not show: {', '.join(verdict.cannot_tell)}"


def _theta_without_a_model(run: Run) -> Iterator[str]:
    sheet = run.datasheet
    if sheet.theta_n and sheet.model is None:
        yield (
            f"the {number_of(sheet.theta_n, 'element')} of theta are recorded, but their model is not known: state"
            " na, nb and offset under [datasheet.model] to have estimates judged"
        )


def _statement(run: Run) -> Iterator[str]:
    if statement := run.conditions.played.statement:
        yield (
            f"the scenario's [statement] {statement.name} is not judged here, only [expect]:"
            " pytest --hil-scenario-dir FOLDER judges the statement"
        )


def _assumed_settings(run: Run) -> Iterator[str]:
    if assumed_n := run.conditions.device.assumed_n:
        settings = number_of(
            assumed_n,
            "setting of the device is not in the log and was",
            "settings of the device are not in the log and were",
        )
        yield (
            f"{settings} replaced by the default; if that is wrong, so are bounds and estimates:"
            " capture from the handshake on"
        )


def _excitation_beyond_the_scales(run: Run, verdict: Verdict) -> Iterator[str]:
    played, program = run.conditions.played.excitation, run.conditions.program
    if not run.conditions.segments or played is None or not (verdict.overloads or run.clipped.any()):
        return
    driven, volts = program.channels[0], program.circuit.scales.volts(program.channels[0])
    low_v, high_v = (level * volts for level in program.equations.inputs[driven].trial)
    levels_v = played.samples_v or (played.low_v, played.high_v)
    if min(levels_v) < low_v - _LEVEL_V or max(levels_v) > high_v + _LEVEL_V:
        yield (
            f"samples are clipped or overloaded, and the excitation goes from {min(levels_v):g} to {max(levels_v):g} V:"
            f" the program {program.name} is scaled for its trial levels, {low_v:.4g} to {high_v:.4g} V; change the"
            " excitation, or trial in the program file"
        )


def _inputs_at_rest(run: Run) -> Iterator[str]:
    program = run.conditions.program
    driven, *others = program.equations.inputs
    if run.conditions.segments and others and not program.equations.diagram:
        yield f"{' and '.join(others)}: held at 0 V, the generator drives {driven} alone"


def _overloads(verdict: Verdict) -> Iterator[str]:
    if verdict.overloads:
        names = ", ".join(sorted(verdict.overloads))
        yield (
            f"{names} overloaded from sample {min(verdict.overloads.values())} on: the computer no longer matched the"
            " plant of the scenario, so estimates and alarms may be correct for the overloaded computer"
        )


def _channel_faults(verdict: Verdict) -> Iterator[str]:
    """One sentence for each fault. The scenario has none: the rig has it, or the device is wrong."""
    for name, faults in itertools.groupby(sorted(verdict.channel_faults, key=attrgetter("name")), attrgetter("name")):
        first, *others = faults
        more = f" and {number_of(len(others), 'later sample')}" if others else ""
        yield (
            f"the device diagnosed a fault of a channel ({name}) at sample {first.sample}{more}, not a change of the"
            f" plant; {first.cure}"
        )


def _wrong_diagnoses(verdict: Verdict) -> Iterator[str]:
    for change in verdict.changes:
        if change.diagnosis is not None and not change.diagnosis.right:
            yield (
                f"the device named {change.diagnosis.named} where {change.what} changed at {change.sample}: this does"
                " not fail the run, since one diagnosis in twenty may be wrong; isolates() of a test judges diagnoses"
            )


def _noise_setting(run: Run) -> Iterator[str]:
    if run.conditions.estimator is not None and run.conditions.estimator.noise_estimated:
        return  # the device follows the noise, starting with noise_variance
    measured = run.conditions.output.noise_lsb**2 + QUANTISATION_VARIANCE_LSB2
    expected = run.datasheet.noise_variance
    if expected is not None and measured > NOISE_MARGIN * expected:
        yield (
            f"the rig's noise has a variance of {measured:.2g} codes^2, the device is set for {expected:.2g}:"
            " expect false alarms; raise noise_variance"
        )


def _edge_spacing(run: Run) -> Iterator[str]:
    excitation = _excitation(run)
    if excitation is None or excitation.clock == "card":
        return
    if run.conditions.estimator is None or run.conditions.estimator.edge_instants == "anywhere":
        return
    intervals = np.diff(_edge_instants(run, excitation))
    if len(intervals) and np.abs(intervals - np.round(intervals)).max() > MOST_EDGE_SHIFT:
        yield (
            "the edges of the excitation are not a whole number of samples apart: expect false alarms;"
            ' set edge_instants = "anywhere" (as the device any-edges does)'
        )


def _warm_up(run: Run) -> Iterator[str]:
    excitation, sheet = _excitation(run), run.datasheet
    if excitation is None or sheet.armed:
        return
    warm_up_n = sheet.warm_up_n
    instants = _edge_instants(run, excitation)
    if len(instants) < WARM_UP_EDGES or instants[WARM_UP_EDGES - 1] >= warm_up_n:
        yield (
            f"the device's warm-up of {number_of(warm_up_n, 'sample')} ends before edge {WARM_UP_EDGES} of the"
            " excitation: expect false alarms at the first edges; raise warm_up_n"
        )


def _changes_in_warm_up(run: Run, verdict: Verdict) -> Iterator[str]:
    sheet = run.datasheet
    for change in verdict.changes:
        if change.sample < sheet.warm_up_n and not sheet.armed:
            yield (
                f"{change.what} at {change.sample} changes within the device's warm-up of"
                f" {number_of(sheet.warm_up_n, 'sample')}, which raises no alarm: change it later"
            )


def _excitation(run: Run) -> Excitation | None:
    """Recorded excitation with edges; None if the scenario has none, or nothing is known of it."""
    found = run.conditions.played.excitation if run.conditions.segments else None
    return None if found is None or found.is_smooth else found


def _edge_instants(run: Run, excitation: Excitation) -> NDArray[np.float64]:
    """Edges after the first level, (e,) in samples, up to sample 4000."""
    edges = excitation.edges(0, _EXAMINED_SAMPLES * TICKS_PER_SAMPLE, 1.0 / run.conditions.sample_period_s)
    return np.asarray(edges.ticks[1:] / TICKS_PER_SAMPLE)


def _false_alarm_rate(verdict: Verdict) -> Iterator[str]:
    if len(verdict.false_alarms) > max(2, len(verdict.changes)):
        yield "with so many false alarms, an alarm soon after a change may be coincidence; ignore its latency"


def _undetectable_changes(verdict: Verdict) -> Iterator[str]:
    for change in verdict.changes:
        if change.bound_n is None and change.is_bounded and not change.unseen:
            yield f"{change.what} at {change.sample} is not judged: not detectable before the next change or the end"
        elif change.is_cut and change.latency_n is None:
            yield f"{change.what} at {change.sample} is not judged: the run ends before an alarm would be late"


def _implausible_estimates(run: Run, verdict: Verdict) -> Iterator[str]:
    if ESTIMATES in verdict.not_judged:
        return
    for segment in verdict.estimates:
        if segment.estimate is None:
            samples = f"{segment.start}-{segment.end - 1}"
            if (run.flags[: segment.end] & np.uint8(UNREPORTED | LOST)).all():
                yield f"the device has reported no estimate until the end of samples {samples}"
            else:
                yield f"the last estimate of samples {samples} describes no plant of the program"
