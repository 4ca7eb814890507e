"""The settings of the estimator in the device: est_config_t of estimator_c/core/est.h, as a user writes them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Self

import numpy as np

from analogrig import config
from analogrig.errors import ConfigurationError
from analogrig.protocol.catalogue import Element, Key, Trigger

TriggerName = Literal["none", "prediction-error", "mean-between-faults", "cusum"]
ResetName = Literal["covariance", "all"]
EdgeInstants = Literal["locked", "may-slip", "anywhere"]

_RESETS: tuple[ResetName, ...] = ("covariance", "all")
"""In the order of est_reset_t."""

_EDGE_INSTANTS: tuple[EdgeInstants, ...] = ("locked", "may-slip", "anywhere")
"""In the order of est_edge_instants_t."""

_SETTINGS = (
    *("na", "nb", "nk", "nc", "offset", "noise_estimated", "refresh_n", "stuck_n", "idle_n"),
    *("forgetting", "random_walk", "p0", "p0_offset", "noise_variance", "edge_codes", "code_low", "code_high"),
    *("isolation", "force_zero"),
)
"""The fields that the device knows under the same name and as they are."""

DEFAULT_ARL0 = 1e5

MAX_NA = sum(key.name[0] == "C" and key.name[1:].isdecimal() for key in Key)
"""The catalogue has keys for so many coefficients of C; a build of the device may take fewer."""

MAX_PARAMETERS = sum(element.name.startswith("THETA_") for element in Element)
"""The catalogue has names for so many elements of theta; a build of the device may have fewer."""

MOST_CEILING = 1e9
"""As EST_CEILING_LIMIT in est.h."""

_VARIANCES, _CODES, _U16 = (1e-9, 1e9), (-1e6, 1e6), (0, 65535)
_SWITCH = (0, 1)

_IN_RANGE: Mapping[str, tuple[float, float]] = {
    "na": (1, MAX_NA),
    "nb": (1, MAX_PARAMETERS),
    "nk": (0, 255),
    "nc": (0, MAX_PARAMETERS),
    "offset": _SWITCH,
    "noise_estimated": _SWITCH,
    "refresh_n": _U16,
    "stuck_n": (0, 255),
    "idle_n": _U16,
    "forgetting": (0.5, 1.0),
    "random_walk": (0.0, _VARIANCES[1]),
    "p0": _VARIANCES,
    "p0_offset": _VARIANCES,
    "noise_variance": _VARIANCES,
    "edge_codes": (0.0, _CODES[1]),
    "code_low": _CODES,
    "code_high": _CODES,
    "isolation": _SWITCH,
    "hold_off_n": _U16,
    "warm_up_n": _U16,
    "absolute": _SWITCH,
    "trigger": (0, len(Trigger) - 1),
    "edge_instants": (0, len(_EDGE_INSTANTS) - 1),
    "reset": (0, len(_RESETS) - 1),
}
"""What est_config_valid() lets through at most, whatever the build."""
_NOT_WHOLE = frozenset(
    {"forgetting", "random_walk", "p0", "p0_offset", "noise_variance", "edge_codes", "code_low", "code_high"}
)


@dataclass(frozen=True)
class EstimatorConfig:
    """Configuration of the estimator, fixed before a run; the defaults are those of est_config_default().

    P is in units of the noise variance. The device rejects values out of its range (DeviceRefused, a DeviceError).
    """

    na: int = 2
    nb: int = 3
    nk: int = 0
    nc: int = 0
    """Coefficients of C to be estimated along with theta (extended least squares)."""
    offset: bool = True
    noise_estimated: bool = False
    """Follow the variance of the noise, beginning with ``noise_variance``."""
    refresh_n: int = 40
    """Take C from the estimate of A after so many equations, and each time A has moved; 0: never."""
    stuck_n: int = 16
    """The displacement is stuck once it was the same for so many samples after an edge of the force, at most
    255; 0: never."""
    idle_n: int = 1000
    """Excitation is lost once the force had no edge for so many samples; 0: never."""
    forgetting: float = 0.99
    random_walk: float = 0.0
    """Variance by which each parameter walks per sample, in noise variances."""
    p0: float = 10.0
    p0_offset: float = 1.0e6
    """codes^2"""
    noise_variance: float = 1.2
    """codes^2"""
    c: tuple[float, ...] = (-1.6, 0.64)
    """Prefilter C = 1 + c[0] z^-1 + ...; what is not given is zero."""
    edge_codes: float = 64.0
    """A step of the force at least this large is an edge; codes."""
    code_low: float = -1.0e6
    """A reading at or below ``code_low``, or at or above ``code_high``, is saturated; codes."""
    code_high: float = 1.0e6
    isolation: bool = True
    """Say after an alarm which of M, B, K has changed; for na = 2, nb + nk <= 3 and the trigger ``cusum``."""
    force_zero: float = 0.0
    """The code at which the force is zero, for that. The bench sets it, by the range of the rig's card."""
    edge_instants: EdgeInstants = "may-slip"
    """Where between two samples the edges of the force come: always at the same place (``locked``), at nearly the same
    (``may-slip``), or each elsewhere (``anywhere``), as when the period is no whole number of samples."""
    trigger: TriggerName = "cusum"
    ceiling: float | None = None
    """Codes; ln(ARL0) for ``cusum``, where ``arl0`` may be given instead."""
    arl0: float | None = None
    """Mean samples between false alarms; for ``cusum``."""
    hold_off_n: int = 0
    warm_up_n: int = 150
    absolute: bool = False
    reset: ResetName = "covariance"

    def __post_init__(self) -> None:
        self._check_prefilter()
        self._check_ceiling()

    def _check_prefilter(self) -> None:
        if not 1 <= self.na <= MAX_NA:
            raise ValueError(f"na must be in 1 .. {MAX_NA}, not {self.na}")
        if len(self.c) > self.na:
            raise ValueError(f"c must have at most na = {self.na} elements, not {len(self.c)}")
        if any(abs(root) >= 1.0 for root in np.roots([1.0, *self.c])):
            raise ValueError(f"c makes an unstable prefilter: {', '.join(format(x, 'g') for x in self.c)}")

    def _check_ceiling(self) -> None:
        if self.arl0 is not None and (self.trigger != "cusum" or self.ceiling is not None):
            raise ValueError("arl0 goes with the trigger 'cusum' and without a ceiling")
        if self.arl0 is not None and not self.arl0 > 1.0:
            raise ValueError(f"arl0 must be more than 1 sample, not {self.arl0:g}")
        if self.ceiling is None and self.trigger in ("prediction-error", "mean-between-faults"):
            raise ValueError(f"the trigger {self.trigger!r} needs a ceiling")
        if self.ceiling is not None and self.trigger == "none":
            raise ValueError("the trigger 'none' has no ceiling")
        if self.ceiling is not None and not 0.0 < self.ceiling <= MOST_CEILING:
            raise ValueError(f"ceiling must be more than 0 and at most {MOST_CEILING:g}, not {self.ceiling:g}")

    @property
    def parameters(self) -> int:
        """The number of elements of theta."""
        return self.na + self.nb + self.nc + self.offset

    @property
    def statistic_ceiling(self) -> float | None:
        """Where the trigger's statistic raises an alarm; None without a trigger."""
        if self.trigger == "cusum" and self.ceiling is None:
            return math.log(DEFAULT_ARL0 if self.arl0 is None else self.arl0)
        return self.ceiling

    def settings(self) -> Iterator[tuple[Key, float]]:
        """Every key of the device with its value, in an order in which each is in range if all are."""
        for name in _SETTINGS:
            yield Key[name.upper()], float(getattr(self, name))
        for i in range(self.na):
            yield Key[f"C{i + 1}"], self.c[i] if i < len(self.c) else 0.0
        yield Key.TRIGGER, float(Trigger[self.trigger.replace("-", "_").upper()])
        if self.statistic_ceiling is not None:
            yield Key.CEILING, self.statistic_ceiling
        for name in ("hold_off_n", "warm_up_n", "absolute"):
            yield Key[name.upper()], float(getattr(self, name))
        yield Key.EDGE_INSTANTS, float(_EDGE_INSTANTS.index(self.edge_instants))
        yield Key.RESET, float(_RESETS.index(self.reset))

    def check_ranges(self) -> None:
        """:raises ValueError: no device can have these settings."""
        for key, value in self.settings():
            if not _is_possible(key, value):
                raise ValueError(f"estimator: {key.name.lower()} = {value:g} is no setting of an estimator")

    @classmethod
    def from_settings(cls, settings: Mapping[int, float], where: str, most_parameters: int = MAX_PARAMETERS) -> Self:
        """What a device says that it has, by its keys; what it has not said is as by default.

        :param most_parameters: it has room for no more elements of theta.
        :raises ConfigurationError: no device can have that; ``where`` leads.
        """
        said = {Key(key): _shortest(value) for key, value in settings.items() if key in set(Key)}
        for key, value in said.items():
            if not _is_possible(key, value):
                raise ConfigurationError(f"{where}: {key.name.lower()} = {value:g} is no setting of an estimator")
        table: dict[str, Any] = {}
        kinds: dict[str, Any] = {each.name: type(each.default) for each in dataclasses.fields(cls)}
        for name in (*_SETTINGS, "ceiling", "hold_off_n", "warm_up_n", "absolute"):
            if Key[name.upper()] in said:
                kind = kinds[name] if kinds[name] in (int, bool) else float
                table[name] = kind(said[Key[name.upper()]])
        words: Mapping[Key, Sequence[str]] = {
            Key.TRIGGER: [trigger.name.lower().replace("_", "-") for trigger in Trigger],
            Key.EDGE_INSTANTS: _EDGE_INSTANTS,
            Key.RESET: _RESETS,
        }
        for key, names in words.items():
            if key in said:
                table[key.name.lower()] = names[int(said[key])]
        if table.get("trigger") == "none":
            table.pop("ceiling", None)
        if Key.C1 in said:
            table["c"] = [said.get(Key[f"C{i + 1}"], 0.0) for i in range(int(table.get("na", cls.na)))]
        made = config.build(cls, table, where)
        if made.parameters > most_parameters:
            raise ConfigurationError(f"{where}: {made.parameters} parameters, of at most {most_parameters}")
        return made

    def as_table(self) -> dict[str, Any]:
        """In plain values, from which the same can be made; the ceiling instead of arl0."""
        table = dataclasses.asdict(self) | {"c": list(self.c), "ceiling": self.statistic_ceiling, "arl0": None}
        return {key: value for key, value in table.items() if value is not None}


def _is_possible(key: Key, value: float) -> bool:
    name = key.name.lower()
    low, high = _IN_RANGE.get(name, (-config.MOST_NUMBER, config.MOST_NUMBER))
    is_whole = name not in _IN_RANGE or name in _NOT_WHOLE or value.is_integer()
    return low <= value <= high and is_whole


def _shortest(value: float) -> float:
    """Of all numbers that are this one in single precision, the one with the fewest digits."""
    return float(str(np.float32(value)))
