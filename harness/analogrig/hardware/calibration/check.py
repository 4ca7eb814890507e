"""How far a twin is from its rig, on a recording that it was not fitted to."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from analogrig.hardware.calibration.recordings import DISPLACEMENT, SquareWaveRecording, Vector, averaged, periods
from analogrig.rigs.emulator import EmulatorDescription, EmulatorRig
from analogrig.run import CHANNELS, MEASURED
from analogrig.scenario import Scenario
from analogrig_emulator import Sampler


def seen_lsb(description: EmulatorDescription, scenario: Scenario, seed: int) -> Vector:
    """What an emulated card sees of force and displacement, without its noise and before rounding: (n, 2), LSB.

    :raises ConfigurationError: the emulator cannot play it.
    :raises RigError: it failed.
    """
    card = description.card.card()
    silent = dataclasses.replace(card, noise_lsb=(0.0,) * card.channels)
    volts = np.concatenate([block.volts for block in EmulatorRig(description).perform(scenario, seed).blocks])
    columns = [CHANNELS.index(name) for name in MEASURED]
    return Sampler(silent, np.random.default_rng(0)).seen_lsb(volts)[:, columns]


def difference_lsb(recording: SquareWaveRecording, twin: EmulatorDescription, noise_lsb: float) -> float:
    """Within how many LSB rms the displacements of rig and twin are: two standard errors above what is found.

    The averages of the recording are compared; what noise and rounding make of the squares is taken out.

    :param noise_lsb: of the rig's displacement.
    :raises ConfigurationError, RigError: as ``seen_lsb``.
    """
    average = averaged(recording, DISPLACEMENT, noise_lsb)
    there = periods(recording, seen_lsb(twin, recording.scenario, 0)[:, DISPLACEMENT]).mean(axis=0)
    mean_square = float(np.mean((average.means - there[average.phases]) ** 2))
    uncertain = average.variance * math.sqrt(2.0 / len(average.means))
    return math.sqrt(max(0.0, mean_square - average.variance) + 2.0 * uncertain)
