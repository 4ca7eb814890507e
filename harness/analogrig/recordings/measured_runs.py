"""Runs of measured data, which no device has answered, and their conversion to units and clock of a program."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from analogrig.errors import ConfigurationError
from analogrig.plant import Segment
from analogrig.run import IMPORTED, Channel, Conditions, Run
from analogrig.scenario import Scenario
from analogrig_emulator import ProgramError, parse_unit

if TYPE_CHECKING:
    from analogrig_emulator import Equations

UNSEEN = "no device has seen these samples: pass the recording to analogrig replay"
"""Fault of a recording that was imported and not played."""

_LEAST_PERIOD_S = 1e-9


def scaled_to_program(conditions: Conditions) -> Conditions:
    """Conditions of imported columns with the speed of their program; those of any other run as they are.

    :raises ConfigurationError: a column is in another unit than its quantity of the program, its clock is not stated,
        or the machine is too fast.
    """
    rig = conditions.rig
    if conditions.source.kind != IMPORTED or "rig" in rig:  # a play, or data with the units and the rate of a rig
        return conditions
    program, clock = conditions.program, rig.get("clock")
    conditions = in_units(conditions, program.equations, program.measured)
    speed = program.equations.speed
    if clock is None and speed != 1.0:
        raise ConfigurationError(
            f"program {program.name}: the machine runs at {speed:g} times the speed of the plant: import the recording"
            " with --clock plant if its rate is in time of the plant, or with --clock machine"
        )
    period_s = conditions.sample_period_s if clock == "machine" else conditions.sample_period_problem_s / speed
    if period_s < _LEAST_PERIOD_S:
        raise ConfigurationError(
            f"program {program.name}: the recording has {1.0 / period_s:.3g} samples per second of the machine, more"
            f" than {1.0 / _LEAST_PERIOD_S:g}: check its rate and --clock"
        )
    return dataclasses.replace(conditions, sample_period_s=period_s, time_scale=speed)


def in_units(conditions: Conditions, equations: Equations, quantities: Sequence[str]) -> Conditions:
    """Conditions with the two measured channels in the units of these quantities of a program.

    :raises ConfigurationError: no factor between the units is known; names both, and the options that convert a column.
    """
    channels = dict(conditions.channels)
    for side, name, quantity in zip(("input", "output"), conditions.program.measured, quantities, strict=True):
        unit, channel = equations.quantities[quantity].unit, channels[name]
        measured = channel.unit
        if unit is None or unit.text == measured:
            continue
        try:
            factor = parse_unit(measured).factor_to(unit)
        except ProgramError:
            factor = None
        if factor is None:
            raise ConfigurationError(
                f"{quantity} of program {equations.name} is in {unit.text}, {name} of the recording in {measured}:"
                f" import it with --{side}-unit {unit.text}, and --{side}-scale {unit.text} per number in its column"
            )
        channels[name] = dataclasses.replace(channel, unit=unit.text, unit_per_v=channel.unit_per_v * factor)
    return dataclasses.replace(conditions, channels=channels)


def unanswered(
    codes: NDArray[np.uint16],
    clipped: NDArray[np.bool_],
    channels: Mapping[str, Channel],
    period_s: float,
    time_scale: float,
    rig: Mapping[str, Any],
    scenario: Scenario,
    segments: tuple[Segment, ...],
) -> Run:
    """Recording without answers of a device.

    :param codes: (n, c), with ``clipped`` for the channels of the scenario's program.
    :param segments: true plant; empty if it is unknown.
    """
    samples = len(codes)
    return Run(
        conditions=Conditions(
            seed=0,
            samples_asked=scenario.samples,
            sample_period_s=period_s,
            time_scale=time_scale,
            channels=dict(channels),
            segments=segments,
            scenario=scenario.as_table(),
            rig=rig,
            dut={"name": "none", "kind": IMPORTED, "datasheet": {"alarms": False}},
            link="none",
            faults=(UNSEEN,),
            program=scenario.program,
        ),
        codes=codes,
        clipped=clipped,
        theta=np.zeros((samples, 0), np.float32),
        innovation=np.zeros(samples, np.float32),
        statistic=np.zeros(samples, np.float32),
        flags=np.zeros(samples, np.uint8),
    )
