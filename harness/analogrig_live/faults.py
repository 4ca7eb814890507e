"""Faults that a hand injects: of the channel of the output, between computer and card, and of the device's line."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from analogrig.run import OUTPUT
from analogrig_live.commands import Fault

NOISE_LSB = 20.0
"""Rms of the noise."""
HUM_LSB, HUM_HZ = 40.0, 50.0
"""Amplitude and frequency of the hum, in machine time."""
SKEW_N = 0.5
"""Delay of the skewed channel, in samples."""


LINE_LABELS: Mapping[str, str] = {
    "flip": "bits flipped",
    "lose": "bytes lost",
    "insert": "bytes inserted",
    "truncate": "frame cut short",
    "drop": "frame lost",
    "duplicate": "frame doubled",
    "outage": "many frames lost",
    "reorder": "frame after later ones",
    "repeat": "frame repeated later",
    "delay": "delay of up to 3 s",
    "error": "error frame, then sent again",
    "remote": "remote frame before it",
    "collide": "other frame of its identifier",
    "fd": "frame of CAN FD",
    "bus-off": "bus-off for up to 3 s",
    "babble": "noise without end",
    "jam": "foreign frames without end",
    "disconnect": "line cut",
    "hang": "nothing passes",
    "stranger": "another catalogue",
    "reset": "device reset",
    "wrong-baud": "wrong baud rate",
    "wrong-bitrate": "wrong bit rate",
}
"""Labels of the faults of lines."""


def labels(channel: str) -> Mapping[Fault, str]:
    """Faults with their labels, for the name of the channel."""
    return {
        "noise": f"noise of {NOISE_LSB:g} LSB on channel {channel}",
        "hum": f"hum of {HUM_HZ:g} Hz on channel {channel}",
        "stuck": f"channel {channel} stuck",
        "skew": f"channel {channel} sampled half a period late",
    }


class ChannelFaults:
    """Faults in force, and their effect on the volts of consecutive blocks."""

    def __init__(self, lsb_v: float, sample_rate_hz: float, rng: np.random.Generator) -> None:
        self._lsb_v = lsb_v
        self._rate_hz = sample_rate_hz
        self._rng = rng
        self._samples = 0
        self._before_v: float | None = None
        """Volts of the last sample, before any fault."""
        self._stuck_v = 0.0
        self.on: set[Fault] = set()

    def switch(self, fault: Fault, *, on: bool) -> None:
        """Switch a fault on or off, from the next sample on."""
        (self.on.add if on else self.on.discard)(fault)
        if fault == "stuck":
            self._stuck_v = self._before_v or 0.0

    def alter(self, volts: NDArray[np.float64]) -> NDArray[np.float64]:
        """Volts with the faults: (n, channels)."""
        true_v = volts[:, OUTPUT]
        late_v = np.append(true_v[:1] if self._before_v is None else self._before_v, true_v[:-1])
        times_s = (self._samples + np.arange(len(volts))) / self._rate_hz
        self._samples += len(volts)
        self._before_v = float(true_v[-1]) if len(volts) else self._before_v
        if not self.on:
            return volts
        out_v = true_v.copy()
        if "skew" in self.on:
            out_v += SKEW_N * (late_v - true_v)
        if "hum" in self.on:
            out_v += HUM_LSB * self._lsb_v * np.sin(2.0 * np.pi * HUM_HZ * times_s)
        if "noise" in self.on:
            out_v += NOISE_LSB * self._lsb_v * self._rng.standard_normal(len(volts))
        if "stuck" in self.on:
            out_v[:] = self._stuck_v
        altered = volts.copy()
        altered[:, OUTPUT] = out_v
        return altered
