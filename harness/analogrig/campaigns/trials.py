"""Closed-loop trials without a line: circuit, card and the C estimator in this process, whole blocks at a time.

A trial is bit-identical to the one that Bench plays with the device ``inproc``: codes, estimates and alarms. It lacks
only what other messages carry: the diagnoses of isolation, and the flags RESTARTED and IDLE.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig.catalogue import SteppedFlag, Trigger
from analogrig.devices.description import DeviceDescription
from analogrig.devices.estimator import Estimator, EstimatorOutput, StepStatus
from analogrig.judging.exposure import Exposure, ObservedRecord, record_exposure
from analogrig.rigs.emulator import EmulatorRig, is_emulated
from analogrig.rigs.rig import Block, Performance, Rig
from analogrig.run import CHANNELS, Conditions, Run, missing_samples
from analogrig.scenario import Scenario

BLOCK_SAMPLES = 16_384
"""Block length in samples from the circuit to the card and the estimator; such blocks fit in the cache."""

_FORCE, _DISPLACEMENT = CHANNELS.index("force"), CHANNELS.index("displacement")

_FLAGS = np.zeros(len(StepStatus), np.uint8)
_FLAGS[StepStatus.MISSING] = SteppedFlag.MISSING
_FLAGS[StepStatus.REFUSED] = SteppedFlag.REFUSED
_FLAGS[StepStatus.GATHERING] = SteppedFlag.GATHERING


def are_possible(rig: Rig, device: DeviceDescription) -> bool:
    """True if trials match Bench: the rig is emulated, and the device's line does not alter the samples."""
    return is_emulated(rig) and device.can_run_in_blocks


@dataclass(frozen=True, eq=False)
class Watched:
    """Alarms of a trial, with the exposure that they are to be judged by."""

    alarms: NDArray[np.int64]
    """(a,): samples with an alarm."""
    exposure: Exposure
    missing: int
    refused: int


class Trials:
    """Emulated rig and estimator, for any number of consecutive trials."""

    def __init__(self, rig: EmulatorRig, device: DeviceDescription) -> None:
        """:raises ConfigurationError: the estimator refuses its configuration.
        :raises LinkError: the library was not built.
        """
        self._rig = rig
        zero = rig.force_zero
        self._device = dataclasses.replace(device, estimator=dataclasses.replace(device.estimator, force_zero=zero))
        self._estimator = Estimator(self._device.estimator, library=device.estimator_library)
        # Runs share their tables: to write them anew for each takes as long as to play a thousand samples.
        self._tables = rig.description(), self._device.as_table()
        self._scenario_table: tuple[Scenario | None, Mapping[str, Any]] = (None, {})

    def alarms(self, scenario: Scenario, seed: int) -> NDArray[np.int64]:
        """Samples with an alarm, (a,), and nothing else: the fastest way.

        :raises ConfigurationError: the scenario cannot be played on this rig.
        :raises RigError: the emulator failed.
        """
        self._estimator.restart()
        performance = self._rig.perform(scenario, seed, BLOCK_SAMPLES)
        found = [block.first + self._estimator.alarms(*entered(block)) for block in performance.blocks]
        return np.concatenate(found)

    def watched(self, scenario: Scenario, seed: int) -> Watched:
        """Alarms as from ``alarms``, with their exposure."""
        self._estimator.restart()
        n = scenario.samples
        force, status = np.empty(n, np.uint16), np.empty(n, np.uint8)
        innovation, statistic = np.empty(n, np.float32), np.empty(n, np.float32)
        found = []
        performance = self._rig.perform(scenario, seed, BLOCK_SAMPLES)
        for block in performance.blocks:
            u, y, valid = entered(block)
            its = slice(block.first, block.first + len(u))
            force[its] = u
            found.append(
                block.first
                + self._estimator.alarms(
                    u, y, valid, status=status[its], innovation=innovation[its], statistic=statistic[its]
                )
            )
        flags, alarms = flags_of(status), np.concatenate(found)
        shown = record_exposure(
            ObservedRecord(force, flags, np.isfinite(innovation) & np.isfinite(statistic), alarms),
            self._tables[1]["estimator"],
            performance.channels["force"].noise_lsb,
        )
        missing, refused = (int(np.count_nonzero(flags & flag)) for flag in (SteppedFlag.MISSING, SteppedFlag.REFUSED))
        return Watched(alarms, shown, missing, refused)

    def run(self, scenario: Scenario, seed: int) -> Run:
        """Play one trial, for ``judge``; errors as ``alarms``."""
        self._estimator.restart()
        performance = self._rig.perform(scenario, seed, BLOCK_SAMPLES)
        blocks: list[Block] = []
        parts: list[EstimatorOutput] = []
        for block in performance.blocks:
            blocks.append(block)
            parts.append(self._estimator.run(*entered(block)))
        return self._run(scenario, seed, performance, blocks, parts)

    def _run(
        self, scenario: Scenario, seed: int, performance: Performance, blocks: list[Block], parts: list[EstimatorOutput]
    ) -> Run:
        statistic = np.concatenate([steps.statistic for steps in parts])
        alarms = np.concatenate([block.first + steps.alarms for block, steps in zip(blocks, parts, strict=True)])
        trigger = Trigger[self._device.estimator.trigger.replace("-", "_").upper()]
        return Run(
            conditions=self._conditions(scenario, seed, performance),
            codes=np.concatenate([block.codes for block in blocks]),
            clipped=np.concatenate([block.clipped for block in blocks]),
            theta=np.concatenate([steps.theta for steps in parts]),
            innovation=np.concatenate([steps.innovation for steps in parts]),
            statistic=statistic,
            flags=flags_of(np.concatenate([steps.status for steps in parts])),
            alarm_index=alarms,
            alarm_kind=np.full(len(alarms), trigger, np.uint8),
            alarm_statistic=statistic[alarms],
        )

    def _conditions(self, scenario: Scenario, seed: int, performance: Performance) -> Conditions:
        if self._scenario_table[0] is not scenario:
            self._scenario_table = scenario, scenario.as_table()
        rig, dut = self._tables
        hindsight = performance.hindsight()
        return Conditions(
            seed=seed,
            samples_asked=scenario.samples,
            sample_period_s=performance.sample_period_s,
            time_scale=performance.time_scale,
            channels=performance.channels,
            segments=hindsight.segments,
            scenario=self._scenario_table[1],
            rig=rig,
            dut=dut,
            link="none",
            counters=self._estimator.counters,
            faults=scenario.caveats,
            overloads=hindsight.lamps,
        )


def entered(block: Block) -> tuple[NDArray[np.uint16], NDArray[np.uint16], NDArray[np.bool_]]:
    """Estimator inputs of one block: force, displacement, and True for each sample that is not missing; (n,) each."""
    return block.codes[:, _FORCE], block.codes[:, _DISPLACEMENT], ~missing_samples(block.clipped)


def flags_of(status: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Flags of a Run for each StepStatus; (n,) each."""
    return _FLAGS.take(status)
