"""Reference of the settings: the values that a device accepts one by one, and the configurations that it starts."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import numpy as np

from analogrig.catalogue import Key, Result
from analogrig.errors import ConfigurationError
from analogrig.estimator_config import EstimatorConfig
from analogrig.testing.reference.regression import is_stable

_NOISE_SHARE = 1024.0
"""Square of the smallest ratio of the range of the codes to the standard deviation of the noise."""

_LEAST = float(np.finfo(np.float32).tiny)
_VARIANCE, _CODE, _U16, _U8 = (1e-9, 1e9), (-1e6, 1e6), (0, 65_535), (0, 255)
_DEFAULT = EstimatorConfig()
_EDGE = _DEFAULT.edge_codes

RANGES: Mapping[Key, tuple[float, float]] = {
    Key.OFFSET: (0, 1),
    Key.NOISE_ESTIMATED: (0, 1),
    Key.REFRESH_N: _U16,
    Key.STUCK_N: _U8,
    Key.IDLE_N: _U16,
    Key.EDGE_INSTANTS: (0, 2),
    Key.TRIGGER: (0, 3),
    Key.RESET: (0, 1),
    Key.ABSOLUTE: (0, 1),
    Key.HOLD_OFF_N: _U16,
    Key.WARM_UP_N: _U16,
    Key.ISOLATION: (0, 1),
    Key.MISFIT: (0, 1),
    Key.FORGETTING: (0.5, 1.0),
    Key.RANDOM_WALK: (0.0, 1e9),
    Key.P0: _VARIANCE,
    Key.P0_OFFSET: _VARIANCE,
    Key.NOISE_VARIANCE: _VARIANCE,
    Key.EDGE_CODES: (_LEAST, 2e6),
    Key.CODE_LOW: (-1e6, 1e6 - _EDGE),
    Key.CODE_HIGH: (-1e6 + _EDGE, 1e6),
    Key.CEILING: (1e-45, 1e9),
    Key.FORCE_ZERO: _CODE,
}
"""Accepted values of est.h with the other fields at their defaults. Fields with whole limits have whole values."""

WHOLE = frozenset(key for key, (low, _) in RANGES.items() if isinstance(low, int))
ORDERS = (Key.NA, Key.NB, Key.NK, Key.NC)
"""Keys whose largest value is a matter of the build."""


@dataclasses.dataclass
class ReferenceSettings:
    """Settings of a device, by key."""

    most: Mapping[Key, int]
    """Largest orders of the build."""
    values: dict[int, float] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.values:
            self.values = {int(key): float(np.float32(value)) for key, value in _DEFAULT.settings()}

    def defaults(self) -> ReferenceSettings:
        """The same build with default settings."""
        return ReferenceSettings(self.most)

    def range_of(self, key: int) -> tuple[float, float] | None:
        """Least and largest value of a key; None if the build has none of that number."""
        if key in ORDERS:
            return (0 if key in (Key.NK, Key.NC) else 1), self.most[Key(key)]
        if Key.C1 <= key < Key.C1 + self.most[Key.NA]:
            largest = float(np.finfo(np.float32).max)
            return -largest, largest
        return RANGES.get(Key(key)) if key in set(Key) else None

    def put(self, key: int, value: float) -> Result:
        """Set a value, if it is accepted."""
        limits = self.range_of(key)
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
