"""Checks on the tables in the header of a recording.

``Conditions`` keeps the tables of scenario, rig and device as they were written. A verdict reads some of their keys.
These are checked when the file is read, because a hostile or damaged file may hold anything there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from analogrig import config
from analogrig.datasheet import Datasheet
from analogrig.errors import ConfigurationError
from analogrig.estimator_config import MAX_PARAMETERS, EstimatorConfig
from analogrig.scenario import Expectations
from analogrig_emulator import Excitation

_MOST = 2**31

_NEEDED = ("na", "nb", "offset", "trigger")
"""Settings without a default, because each of them changes the verdict; so does the ceiling of a trigger."""


@dataclass(frozen=True)
class _Rig:
    name: str


@dataclass(frozen=True)
class _Scenario:
    name: str
    description: str = ""
    expect: Expectations = field(default_factory=Expectations)
    excitation: Excitation | None = None


@dataclass(frozen=True)
class _Device:
    name: str
    estimator: EstimatorConfig | None = None
    datasheet: Datasheet | None = None
    kind: str = ""
    report_interval_n: int = 1
    most_lost_n: int = 0
    assumed_n: int = 0
    identity: Mapping[str, int | str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, least in (("report_interval_n", 1), ("most_lost_n", 0), ("assumed_n", 0)):
            if not least <= getattr(self, name) <= _MOST:
                raise ValueError(f"{name} must be {least} to {_MOST}, not {getattr(self, name)}")
        if self.estimator is None and self.datasheet is None:
            raise ValueError("the key 'estimator' or 'datasheet' is lacking")
        if self.estimator is not None:
            self.estimator.check_ranges()
            if self.estimator.parameters > MAX_PARAMETERS:
                raise ValueError(f"estimator: {self.estimator.parameters} parameters, of at most {MAX_PARAMETERS}")


@dataclass(frozen=True)
class _Line:
    """Counters of the line, as ``Conditions.line`` holds them."""

    bitrate: int = 1
    data_bitrate: int = 1
    baud: int = 1
    samples_per_message: int = 1

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 1 <= value <= _MOST:
                raise ValueError(f"{name} must be 1 to {_MOST}, not {value}")


def check_tables(
    where: str, *, scenario: Mapping[str, Any], rig: Mapping[str, Any], dut: Mapping[str, Any], line: Mapping[str, int]
) -> Datasheet:
    """Data sheet of the recorded device, after a check of every key that a verdict reads; ``where`` leads errors.

    :raises ConfigurationError: a key that is read later is missing or wrong.
    """
    _build_known(_Scenario, scenario, f"{where}: scenario")
    _build_known(_Rig, rig, f"{where}: rig")
    _build_known(_Line, line, f"{where}: line")
    settings = dut.get("estimator")
    if isinstance(settings, Mapping):
        needed = _NEEDED if settings.get("trigger") == "none" else (*_NEEDED, "ceiling")
        lacking = [key for key in needed if key not in settings]
        if lacking:
            raise ConfigurationError(f"{where}: dut: estimator: the key {lacking[0]!r} is lacking")
    _build_known(_Device, dut, f"{where}: dut")
    return Datasheet.recorded(dut)


def _build_known(cls: type[Any], table: Mapping[str, Any], where: str) -> Any:
    """Build ``cls`` from the keys that it has; ignore the others."""
    return config.build(cls, {key: value for key, value in table.items() if key in cls.__dataclass_fields__}, where)
