"""Record of a self-test: the scenario played, and the samples of force and displacement."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig.errors import SelfTestError
from analogrig.plant import Plant
from analogrig.rigs.rig import Rig
from analogrig.run import CHANNELS, MEASURED, Channel
from analogrig.scenario import PLANTS, PlantChoice, Scenario
from analogrig_emulator import Excitation

SAMPLES = 16_384
"""Samples that an instrument of the class of a Red Pitaya takes without a gap."""

LOW_V, HIGH_V = 0.5, 9.5
"""Levels at the computer's input. No signal of a healthy computer comes near its limits, or falls below 0 V."""

FREQUENCY_HZ = 823 * 125e6 / 2**30
"""95.81 Hz: half periods of 104 samples, after which all signals have settled. It is a multiple of the resolution of a
Red Pitaya's generator (30 bits). At 20 kHz the edges of 0.8 s sample all parts of a sample period, at most 0.017
apart."""

LEAST_PERIODS = 13
"""Fewest periods in the record that determine the timing of the edges and the noise."""

PROGRAMS = ("front", "shock")


def scenario(program: str) -> Scenario:
    """Scenario of the self-test.

    :raises SelfTestError: it does not support this program.
    """
    if program not in PROGRAMS:
        raise SelfTestError(f"the self-test supports the programs {', '.join(PROGRAMS)}, not {program}")
    excitation = Excitation(low_v=LOW_V, high_v=HIGH_V, frequency_hz=FREQUENCY_HZ, clock="free")
    return Scenario(SAMPLES, excitation, random_phase=True, plant=PlantChoice(set=program), name="self-test")  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class SelfTestRecord:
    """Samples of force and displacement, with what was played."""

    program: str
    sample_period_s: float
    time_scale: float
    channels: Mapping[str, Channel]
    codes: Mapping[str, NDArray[np.uint16]]
    """Codes of each channel (n,)."""
    clipped: Mapping[str, NDArray[np.bool_]]

    @classmethod
    def take(cls, rig: Rig, seed: int, program: str) -> SelfTestRecord:
        """Play the self-test on a rig.

        :raises ConfigurationError: the rig cannot play it.
        :raises SelfTestError: the rig samples too fast, or its samples have a gap.
        :raises RigError: the rig failed.
        """
        performance = rig.perform(scenario(program), seed)
        if performance.sample_period_s * SAMPLES * FREQUENCY_HZ < LEAST_PERIODS:
            most_hz = SAMPLES * FREQUENCY_HZ / LEAST_PERIODS
            rate_hz = 1.0 / performance.sample_period_s
            raise SelfTestError(f"the self-test goes up to {most_hz:.0f} samples/s, and the rig takes {rate_hz:.0f}")
        blocks = list(performance.blocks)
        codes = np.concatenate([block.codes for block in blocks])
        clipped = np.concatenate([block.clipped for block in blocks])
        if len(codes) < SAMPLES:
            raise SelfTestError(f"the rig gave {len(codes)} of {SAMPLES} samples")
        if len({block.record for block in blocks}) > 1:
            raise SelfTestError(f"the rig does not take {SAMPLES} samples without a gap")
        column = {name: CHANNELS.index(name) for name in MEASURED}
        return cls(
            program,
            performance.sample_period_s,
            performance.time_scale,
            {name: performance.channels[name] for name in column},
            {name: codes[:, i] for name, i in column.items()},
            {name: clipped[:, i] for name, i in column.items()},
        )

    @property
    def plant(self) -> Plant:
        """Plant that the pots are set for."""
        return PLANTS[self.program]

    @property
    def half_period_n(self) -> float:
        return 0.5 / (FREQUENCY_HZ * self.sample_period_s)

    def volts(self, channel: str) -> NDArray[np.float64]:
        """(n,) voltage at the computer."""
        return self.channels[channel].volts(self.codes[channel])

    def swing_v(self, channel: str) -> float:
        """Range of the voltage between its 1 % and 99 % quantiles."""
        low, high = np.quantile(self.volts(channel), (0.01, 0.99))
        return float(high - low)

    def swing_codes(self, channel: str) -> float:
        """Same range in codes."""
        return self.swing_v(channel) / self.channels[channel].lsb_v

    def sharpness(self, channel: str) -> float:
        """Step between neighbouring samples that is exceeded once in two half periods, in parts of the swing.

        It is about 1 for a square wave; a drop-out or a spike in another signal does not affect it.
        """
        steps = np.sort(np.abs(np.diff(self.volts(channel))))
        return float(steps[-int(0.5 * len(steps) / self.half_period_n)] / self.swing_v(channel))
