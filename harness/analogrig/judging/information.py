"""Information bounds: delays of the best detector and of the best isolation of a change, to first order.

Detection: with a mean time between false alarms of ARL0, the least mean delay grows with ARL0 as the number of samples
in which

    I(n) = sum over the first n samples of (y_changed - y_unchanged)^2 / (2 sigma^2)

reaches ln ARL0 (Lorden 1971; Lai 1998). This is an asymptotic bound as ARL0 grows. At an ARL0 of 1e5, a window-limited
GLR test that knows both plants has 0.962 of it. A single delay may be shorter still. I(n) compares the plant before and
after the change. It depends on the phase of the excitation, so it is computed for each change in each run.

Isolation: the changed parameter is known with 95 % confidence once I(n) between the true plant and its best rival
reaches ln 20. A rival is a plant with one other parameter changed.

The courses y come from a noise-free play of the machine of the run (machine_model.py). Runs of a rig without one, such
as a real rig or a CAN log, use the program under the measured input if it is linear (linear.py).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from analogrig.errors import ConfigurationError
from analogrig.judging import isolation, machine_model
from analogrig.judging.courses import Model, PlantChange, changes_between, first_at_level
from analogrig.judging.linear import LinearPlant
from analogrig.run import CHUNK_SAMPLES, Run
from analogrig.scenario import Scenario

if TYPE_CHECKING:
    from analogrig.program import Program
    from analogrig.rigs.rig import Rig

QUANTISATION_VARIANCE_LSB2 = 1.0 / 12.0


def change_information(run: Run, model: Model | None = None) -> list[NDArray[np.float64]]:
    """I(1), I(2), ... of each change of ``run``, up to the next change or the end: float64 arrays; empty if unknown.

    Both courses start from the true state at the change. Samples that the device could not use carry no information.

    :param model: as of ``model_of``, if known.
    :raises ConfigurationError: the recorded rig or scenario does not describe a machine.
    """
    model, weight = model or model_of(run), weights(run.missing, run.conditions.output.noise_lsb)
    if model is None:
        return [np.zeros(0) for _ in run.segments[1:]]
    return [information_of(model, change, weight) for change in _run_changes(run, model)]


def is_bounded(run: Run) -> bool:
    """True if the information in ``run`` is known: a machine played it, or its program is linear."""
    return machine_model.is_played(run) or run.conditions.program.is_linear


def isolation_bounds(run: Run, model: Model | None = None) -> list[int | None]:
    """Isolation bound of each change of ``run`` in samples; None: not before the next change or the end.

    The rival hypotheses are changes of one other parameter by any factor from 1/4 to 4.

    :param model: as of ``model_of``, if known.
    :raises ConfigurationError: as ``change_information``.
    """
    model, weight = model or model_of(run), weights(run.missing, run.conditions.output.noise_lsb)
    if model is None:
        return [None for _ in run.segments[1:]]
    return [
        # The device restarts with each record and has nothing to isolate.
        None if change.start in run.conditions.records else isolation.bound(model, change, weight[change.start + 1 :])
        for change in _run_changes(run, model)
    ]


def detectable(scenario: Scenario | str, arl0: float, *, rig: str | Rig, program: Program | str | None = None) -> bool:
    """True if every change of a scenario is detectable before the next one: its information I(n) reaches ln ARL0.

    A prediction from a noise-free play of the scenario's program on an emulated rig, with the resolution, the range and
    the noise of its card. The phase is the scenario's own even if the seed draws one.

    :param scenario: a scenario, its shipped name or its .toml file.
    :param arl0: average run length between false alarms, in samples.
    :param rig: an emulated rig, or its name.
    :param program: program of the computer instead of the scenario's: the program, its shipped name or .toml file.
    :raises ConfigurationError: the rig is not emulated, or cannot play the scenario; ``arl0`` is not above 1.
    """
    return all(bound is not None for bound in predicted_bounds(scenario, arl0, rig=rig, program=program))


def predicted_bounds(
    scenario: Scenario | str, arl0: float, *, rig: str | Rig, program: Program | str | None = None
) -> list[int | None]:
    """Predicted information bound of each change of a scenario; None: not detectable before the next one or the end.

    Parameters and errors as ``detectable``.
    """
    given: Any = arl0  # a user need not have a type checker
    is_number = isinstance(given, int | float | np.number) and not isinstance(given, bool)
    if not is_number or not 1.0 < arl0 < math.inf:
        raise ConfigurationError(f"arl0 must be a finite number of samples above 1, not {str(arl0)[:40]!r}")
    scenario = Scenario.load(scenario) if isinstance(scenario, str) else scenario
    scenario = scenario if program is None else scenario.on_program(program)
    model, output = machine_model.predicted(scenario, rig)
    weight = np.full(scenario.samples, _per_lsb2(output.noise_lsb))
    segments = scenario.segments()
    ends = [*(segment.start for segment in segments[1:]), scenario.samples]
    stretches = [(each.start, end, each.plant.parameters()) for each, end in zip(segments, ends, strict=True)]
    ramps_n = {segment.start: segment.ramp_n for segment in segments}
    return [
        first_at_level(information_of(model, change, weight), math.log(arl0))
        for change in changes_between(model, stretches, ramps_n)
    ]


def model_of(run: Run) -> Model | None:
    """Model of the plant in ``run``: its machine, or its program under the measured input if that is linear.

    :raises ConfigurationError: as ``change_information``.
    """
    machine = machine_model.machine_of(run)
    if machine is None and run.conditions.program.is_linear:
        return LinearPlant.of(run)
    return machine


def _run_changes(run: Run, model: Model) -> Iterator[PlantChange]:
    """Changes of the plant in ``run``, including those at the start of a record."""
    ramps_n = {segment.start: segment.ramp_n for segment in run.conditions.segments}
    stretches = [(start, end, plant.parameters()) for start, end, plant in run.segments]
    return changes_between(model, stretches, ramps_n, run.conditions.records)


def weights(missing: NDArray[np.bool_], noise_lsb: float) -> NDArray[np.float64]:
    """(n,) information per squared LSB of each sample; 0 for a missing one."""
    return np.where(missing, 0.0, _per_lsb2(noise_lsb))


def _per_lsb2(noise_lsb: float) -> float:
    return 1.0 / (2.0 * (noise_lsb**2 + QUANTISATION_VARIANCE_LSB2))


def information_of(model: Model, change: PlantChange, weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """I(1), I(2), ... of one change, float64, for the ``weights`` of all samples; its course is overwritten."""
    out = change.course_lsb
    unchanged = model.course(change.moment, change.before, change.before, 0)
    gathered = 0.0
    for first in range(0, len(out), CHUNK_SAMPLES):
        part = slice(first, min(first + CHUNK_SAMPLES, len(out)))
        difference_lsb = out[part] - unchanged.advance(part.stop - part.start)
        informative = difference_lsb**2 * weight[change.start + 1 :][part]
        informative[0] += gathered
        np.cumsum(informative, out=out[part])
        gathered = float(out[part][-1])
    return out
