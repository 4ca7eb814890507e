"""Reference of the settings: the values that a device accepts one by one, and the configurations that it starts."""

from __future__ import annotations

import math

import numpy as np

from analogrig.catalogue import Result
from analogrig.errors import ConfigurationError
from analogrig.estimator_config import EstimatorConfig
from analogrig.testing.properties.scripts import DEFAULTS, ORDERS, WHOLE, DeviceBuild
from tests.reference.regression import is_stable

_NOISE_SHARE = 1024.0
"""Square of the smallest ratio of the range of the codes to the standard deviation of the noise."""


class ReferenceSettings:
    """Settings of a device, by key."""

    def __init__(self, build: DeviceBuild) -> None:
        self._build, self.values = build, dict(DEFAULTS)

    def defaults(self) -> ReferenceSettings:
        """The same build with default settings."""
        return ReferenceSettings(self._build)

    def put(self, key: int, value: float) -> Result:
        """Set a value, if it is accepted."""
        limits = self._build.range_of(key)
        if limits is None:
            return Result.UNKNOWN
        is_whole = key in WHOLE or key in ORDERS
        low, high = (float(np.float32(limit)) for limit in limits)
        if not math.isfinite(value) or not low <= value <= high or (is_whole and not value.is_integer()):
            return Result.OUT_OF_RANGE
        self.values[key] = value
        return Result.APPLIED

    def value(self, key: int) -> float:
        """Present value; 0 of an unknown key."""
        return self.values.get(key, 0.0)

    def config(self, most_parameters: int) -> EstimatorConfig:
        """The configuration.

        :raises ConfigurationError: the fields do not go together.
        """
        config = EstimatorConfig.from_settings(self.values, "settings", most_parameters)
        span = config.code_high - config.code_low
        if not is_stable(config.c) or config.edge_codes > span or config.noise_variance * _NOISE_SHARE > span * span:
            raise ConfigurationError("settings: the fields do not go together")
        return config
