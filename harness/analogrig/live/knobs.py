"""Knobs of a bench: the parameters that the pots of a program show, with their units and limits."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from analogrig.errors import ConfigurationError
from analogrig.plant import Plant
from analogrig_emulator import EmulatorError
from analogrig_emulator.machine.program import Program

_UNITS = {"kg": "kg", "n_s_per_m": "N s/m", "n_per_m": "N/m"}
"""Units by the end of a setting's name."""

_SEARCHED = 1e3
"""Factor on both sides of a parameter's value within which its limits are searched."""

_BISECTIONS = 40


@dataclass(frozen=True)
class Knob:
    """Parameter of the program, as the pot that shows it can be turned."""

    setting: str
    """Name of the parameter in the program."""
    label: str
    unit: str
    low: float
    """Least value within the limits of the rig; ``high`` is the largest."""
    high: float
    field: str
    """Name of the parameter in a scenario; empty if no scenario can change it."""

    def check(self, value: float) -> None:
        """:raises ConfigurationError: a value is outside the limits."""
        if not self.low <= value <= self.high:
            raise ConfigurationError(
                f"{self.label} must be {self.low:.6g} to {self.high:.6g} {self.unit}, not {value:.6g}"
            )


def knobs_of(program: Program, check: Callable[[Mapping[str, float]], object]) -> dict[str, Knob]:
    """Knobs by setting, in the order of the program.

    :param check: raises ConfigurationError or EmulatorError for settings beyond the limits of the rig.
    """
    names = {setting: name for name, setting in settings_names(program).items()}
    out = {}
    for setting, value in program.values.items():
        low, high = _limits(check, setting, value)
        field = names.get(setting, "")
        unit = _UNITS.get(setting.partition("_")[2], "")
        out[setting] = Knob(setting, _label(program, setting), unit, low, high, field)
    return out


def settings_names(program: Program) -> dict[str, str]:
    """Settings of a program by their names in a scenario."""
    return dict(zip((field.name for field in dataclasses.fields(Plant)), program.values, strict=False))


def _label(program: Program, setting: str) -> str:
    """Name of the pot that the setting alone turns; else that of the setting."""
    return next((pot for pot, row in program.pots.items() if row.settings == (setting,)), setting)


def _limits(check: Callable[[Mapping[str, float]], object], setting: str, value: float) -> tuple[float, float]:
    """Least and largest value that the rig accepts."""

    def is_possible(trial: float) -> bool:
        try:
            check({setting: trial})
        except (EmulatorError, ConfigurationError):
            return False
        return True

    ends = []
    for end in (value / _SEARCHED, value * _SEARCHED):
        good, bad = value, end
        if is_possible(end):
            good = end
        else:
            for _ in range(_BISECTIONS):
                middle = (good * bad) ** 0.5
                good, bad = (middle, bad) if is_possible(middle) else (good, middle)
        ends.append(good)
    return ends[0], ends[1]


def scenario_values(knobs: Mapping[str, Knob], settings: Mapping[str, float]) -> dict[str, Any]:
    """Settings by their names in a scenario; those that no scenario can change are left out."""
    return {knobs[name].field: value for name, value in settings.items() if knobs[name].field}
