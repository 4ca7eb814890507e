"""Configuration of the estimator in the device: est_config_t of estimator_c/core/est.h in a user's terms."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Self, get_args

import numpy as np

from analogrig import config
from analogrig.catalogue import Element, Key, Trigger
from analogrig.datasheet import DEFAULT_ARL0
from analogrig.errors import ConfigurationError

TriggerName = Literal["none", "prediction-error", "mean-between-faults", "cusum"]
ResetName = Literal["covariance", "all"]
EdgeInstants = Literal["locked", "may-slip", "anywhere"]
Orders = Literal["given", "program"]

_MODEL_SETTINGS = (
    *("na", "nb", "nk", "nc", "offset", "noise_estimated", "refresh_n", "stuck_n", "idle_n"),
    *("forgetting", "random_walk", "p0", "p0_offset", "noise_variance", "edge_codes", "code_low", "code_high"),
    *("isolation", "force_zero", "misfit"),
)
_TRIGGER_SETTINGS = ("trigger", "ceiling", "hold_off_n", "warm_up_n", "absolute", "edge_instants", "reset")
"""Fields with the same name in the device. The coefficients of C come between the two groups."""

_BY_ORDER = ("na", "nb", "c", "refresh_n", "forgetting", "isolation", "misfit")
"""Fields that ``of_poles`` chooses."""

_OF_POLES = 0.9
"""Zeros of a fixed C, in poles of the plant: nearer, C = A with several slow poles leaves the estimate undetermined."""

_USUAL_NA, _USUAL_NB, _USUAL_PARAMETERS = 2, 3, 6
"""EST_NA_MAX, EST_NB_MAX and EST_THETA_MAX of est.h: room of the usual build."""

_WORDS: Mapping[str, Sequence[str]] = {
    "trigger": [trigger.name.lower().replace("_", "-") for trigger in Trigger],
    "edge_instants": get_args(EdgeInstants),
    "reset": get_args(ResetName),
}
"""Fields whose value in the device is the index of a word: in the order of est_edge_instants_t and est_reset_t."""

MAX_NA = sum(key.name[0] == "C" and key.name[1:].isdecimal() for key in Key)
"""Largest order of C in the catalogue. A build of the device may have a lower limit."""

MAX_PARAMETERS = sum(element.name.startswith("THETA_") for element in Element)
"""Largest number of elements of theta in the catalogue. A build of the device may have a lower limit."""

MOST_CEILING = 1e9
"""EST_CEILING_LIMIT of est.h."""

_VARIANCES, _CODES, _U16 = (1e-9, 1e9), (-1e6, 1e6), (0, 65535)
_SWITCH = (0, 1)

_IN_RANGE: Mapping[str, tuple[int, int] | tuple[float, float]] = {
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
    "misfit": _SWITCH,
    "hold_off_n": _U16,
    "warm_up_n": _U16,
    "absolute": _SWITCH,
    **{name: (0, len(words) - 1) for name, words in _WORDS.items()},
}
"""Widest ranges of est_config_valid() over all builds. Fields with whole limits have whole values."""


@dataclass(frozen=True)
class EstimatorConfig:
    """Configuration of the estimator, fixed before a run; the defaults are those of est_config_default().

    P is in units of the noise variance. The device rejects values out of its range (DeviceRefused, a DeviceError).
    """

    na: int = 2
    nb: int = 3
    nk: int = 0
    nc: int = 0
    """Number of coefficients of C in theta (extended least squares)."""
    offset: bool = True
    noise_estimated: bool = True
    """Follow the variance of the noise, starting from ``noise_variance``."""
    refresh_n: int = 40
    """Equations after which C is set from the estimate of A, and again each time A has moved; 0: never."""
    stuck_n: int = 16
    """Samples of constant output after an edge of the input that count as stuck, up to 255; 0: never."""
    idle_n: int = 1000
    """Samples without an edge of the input after which excitation counts as lost; 0: never."""
    forgetting: float = 0.995
    random_walk: float = 0.0
    """Variance of each parameter's random walk per sample, in noise variances."""
    p0: float = 10.0
    p0_offset: float = 1.0e6
    """codes^2"""
    noise_variance: float = 1.2
    """codes^2"""
    c: tuple[float, ...] = (-1.6, 0.64)
    """Prefilter C = 1 + c[0] z^-1 + ...; further coefficients are zero."""
    edge_codes: float = 64.0
    """Smallest step of the input that counts as an edge; codes."""
    code_low: float = -1.0e6
    """A reading at or below ``code_low``, or at or above ``code_high``, is saturated; codes."""
    code_high: float = 1.0e6
    isolation: bool = True
    """Diagnose after an alarm which parameter has changed, or which channel is faulty; for na = 2, nb + nk <= 3 and the
    trigger ``cusum``."""
    misfit: bool = True
    """Watch whether the model fits, and report the cause of a misfit; for na = 2."""
    force_zero: float = 0.0
    """Code of zero input, for isolation. The bench sets it from the range of the rig's card."""
    edge_instants: EdgeInstants = "may-slip"
    """Instants of the input's edges between two samples: constant (``locked``), nearly constant (``may-slip``), or
    varying (``anywhere``), as with a period that is no whole number of samples."""
    trigger: TriggerName = "cusum"
    ceiling: float | None = None
    """Codes; ln(ARL0) for ``cusum``, where ``arl0`` may be given instead."""
    arl0: float | None = None
    """Mean samples between false alarms; for ``cusum``."""
    hold_off_n: int = 0
    warm_up_n: int = 550
    absolute: bool = False
    reset: ResetName = "covariance"
    orders: Orders = "given"
    """Origin of na, nb, c, refresh_n, forgetting, isolation and misfit: ``given`` here, or chosen by the poles of the
    scenario's ``program``. A device without settings of its own has the latter."""

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

    @classmethod
    def of_poles(cls, poles: Sequence[complex]) -> Self:
        """Configuration for a plant with these poles in z, as ``Program.poles`` has them.

        Up to order 2 the default has the right orders. Beyond it C stays at the plant's poles, moved towards the origin
        by a tenth: C from so many estimated coefficients would raise false alarms. Their estimate takes a longer
        memory, too. Isolation and the watch of the fit are for order 2.

        :raises ValueError: the catalogue has no such order.
        """
        order = len(poles)
        if order <= cls.na:
            return cls()
        return cls(
            na=order,
            nb=order + 1,
            c=tuple(np.poly([_OF_POLES * pole / max(1.0, abs(pole)) for pole in poles]).real[1:].tolist()),
            refresh_n=0,
            forgetting=0.998,
            isolation=False,
            misfit=False,
        )

    def suited(self, poles: Sequence[complex]) -> Self:
        """Configuration for a plant with these poles, if ``orders`` leaves the choice to the program.

        :raises ValueError: the catalogue has no such order.
        """
        if self.orders == "given":
            return self
        chosen = self.of_poles(poles)
        return dataclasses.replace(self, **{name: getattr(chosen, name) for name in _BY_ORDER})

    @property
    def parameters(self) -> int:
        """Number of elements of theta."""
        return self.na + self.nb + self.nc + self.offset

    @property
    def is_wide(self) -> bool:
        """True if the usual build of the device has no room for these orders."""
        return self.na > _USUAL_NA or self.nb > _USUAL_NB or self.parameters > _USUAL_PARAMETERS

    @property
    def room(self) -> str:
        """Compiler options of a build with room for these orders."""
        return f"-DEST_NA_MAX={self.na}U -DEST_NB_MAX={self.nb}U -DEST_THETA_MAX={self.parameters}U"

    @property
    def statistic_ceiling(self) -> float | None:
        """Value of the trigger's statistic that raises an alarm; None without a trigger."""
        if self.trigger == "cusum" and self.ceiling is None:
            return math.log(DEFAULT_ARL0 if self.arl0 is None else self.arl0)
        return self.ceiling

    def settings(self) -> Iterator[tuple[Key, float]]:
        """Every key of the device with its value, in an order that keeps each intermediate state valid."""
        for name in _MODEL_SETTINGS:
            yield Key[name.upper()], float(getattr(self, name))
        for i in range(self.na):
            yield Key[f"C{i + 1}"], self.c[i] if i < len(self.c) else 0.0
        for name in _TRIGGER_SETTINGS:
            value = self.statistic_ceiling if name == "ceiling" else getattr(self, name)
            if value is not None:
                yield Key[name.upper()], float(_WORDS[name].index(value) if name in _WORDS else value)

    def changed(self, where: str, settings: Mapping[str, Any]) -> Self:
        """The configuration with other values of some fields; ``where`` begins every error message.

        Orders that depend on the program become given ones if ``settings`` name any of them.

        :raises ConfigurationError: there is no such field, or the values are no valid configuration.
        """
        origin: dict[str, Any] = {} if settings.keys().isdisjoint(_BY_ORDER) else {"orders": "given"}
        try:
            return dataclasses.replace(self, **origin | dict(settings))
        except (TypeError, ValueError) as error:
            raise ConfigurationError(f"{where}: {error}") from error

    def check_ranges(self) -> None:
        """:raises ValueError: a setting is out of range in every build of the device."""
        for key, value in self.settings():
            if not _is_in_range(key, value):
                raise ValueError(f"estimator: {key.name.lower()} = {value:g} is no setting of an estimator")

    @classmethod
    def from_settings(cls, settings: Mapping[int, float], where: str, most_parameters: int = MAX_PARAMETERS) -> Self:
        """Configuration from values that a device has reported; the others have their defaults.

        :param where: beginning of error messages.
        :param most_parameters: largest number of elements of theta.
        :raises ConfigurationError: the values are no valid configuration.
        """
        # decimal numbers with the fewest digits that have the same value in single precision
        reported = {Key(key): float(str(np.float32(value))) for key, value in settings.items() if key in set(Key)}
        for key, value in reported.items():
            if not _is_in_range(key, value):
                raise ConfigurationError(f"{where}: {key.name.lower()} = {value:g} is no setting of an estimator")
        table: dict[str, Any] = {}
        kinds: dict[str, Any] = {each.name: type(each.default) for each in dataclasses.fields(cls)}
        for name in (*_MODEL_SETTINGS, *_TRIGGER_SETTINGS):
            if (number := reported.get(Key[name.upper()])) is not None:
                kind = kinds[name] if kinds[name] in (int, bool) else float
                table[name] = _WORDS[name][int(number)] if name in _WORDS else kind(number)
        if table.get("trigger") == "none":
            table.pop("ceiling", None)
        if Key.C1 in reported:
            table["c"] = [reported.get(Key[f"C{i + 1}"], 0.0) for i in range(int(table.get("na", cls.na)))]
        made = config.build(cls, table, where)
        if made.parameters > most_parameters:
            raise ConfigurationError(f"{where}: {made.parameters} parameters, of at most {most_parameters}")
        return made

    def as_table(self) -> dict[str, Any]:
        """Plain values, from which ``config.build`` makes the same; with the ceiling instead of arl0."""
        table = dataclasses.asdict(self) | {"c": list(self.c), "ceiling": self.statistic_ceiling, "arl0": None}
        return {key: value for key, value in table.items() if value is not None}


def _is_in_range(key: Key, value: float) -> bool:
    name = key.name.lower()
    low, high = _IN_RANGE.get(name, (-config.MOST_NUMBER, config.MOST_NUMBER))
    is_real = type(high) is float
    return low <= value <= high and (is_real or value.is_integer())
