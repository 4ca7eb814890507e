"""Scenarios of a calibration: square waves, each with its own pots, levels and frequency."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from analogrig.scenario import PlantChoice, Scenario
from analogrig_emulator import Excitation

Program = Literal["front", "shock"]

SAMPLES = 1400

RATE_HZ = 20e3
"""Sample rate of the card. The periods below are whole numbers of its samples."""

_Plant = tuple[float, float, float]
_Wave = tuple[float, float, int]

_PLANTS: Mapping[Program, tuple[_Plant, ...]] = {
    "front": (
        (115.0, 3021.0, 24500.0),
        (115.0, 3021.0, 24500.0),
        (115.0, 3021.0, 18000.0),
        (115.0, 2123.0, 20000.0),
        (60.0, 3021.0, 24500.0),
        (60.0, 4000.0, 28000.0),
        (35.0, 2600.0, 19000.0),
        (230.0, 4200.0, 15000.0),
        (160.0, 1600.0, 28000.0),
        (31.0, 2500.0, 26500.0),
        (80.0, 3600.0, 21500.0),
        (45.0, 2800.0, 16500.0),
    ),
    "shock": (
        (2.0, 900.0, 12250.0),
        (2.0, 900.0, 12250.0),
        (2.0, 900.0, 9000.0),
        (2.0, 632.0, 10000.0),
        (1.6, 900.0, 12250.0),
        (1.6, 1200.0, 14000.0),
        (2.6, 780.0, 9500.0),
        (5.5, 1250.0, 7500.0),
        (3.5, 600.0, 14000.0),
        (1.55, 750.0, 13250.0),
        (2.3, 1070.0, 10750.0),
        (4.0, 835.0, 8250.0),
    ),
}
"""M (kg), B (N s/m), K (N/m), which cover the ranges of the pots."""

_WAVES: tuple[_Wave, ...] = (
    (0.1, 9.9, 50),
    (0.6, 9.5, 10),
    (0.2, 8.0, 25),
    (1.0, 9.0, 20),
    (0.3, 9.7, 8),
    (0.4, 9.2, 16),
    (0.7, 7.5, 20),
    (0.5, 6.0, 32),
    (3.0, 9.0, 40),
    (0.8, 8.8, 5),
    (0.1, 8.5, 10),
    (1.2, 6.9, 25),
)
"""Low and high level (V) and half period (samples), one for each plant. No amplifier is overloaded, and the
displacement stays within -1..9 V."""

_CHECK_PLANTS: Mapping[Program, _Plant] = {"front": (95.0, 2700.0, 22500.0), "shock": (1.8, 980.0, 11000.0)}
_CHECK_WAVE: _Wave = (2.0, 8.2, 64)


def scenarios(program: Program) -> tuple[Scenario, ...]:
    """Scenarios that the twin is fitted to."""
    rows = zip(_PLANTS[program], _WAVES, strict=True)
    return tuple(_scenario(program, f"calibration-{i}", *row) for i, row in enumerate(rows, start=1))


def check_scenario(program: Program) -> Scenario:
    """Scenario to validate the twin; its pots, levels and frequency differ from all ``scenarios``."""
    return _scenario(program, "calibration-check", _CHECK_PLANTS[program], _CHECK_WAVE)


def _scenario(program: Program, name: str, plant: _Plant, wave: _Wave) -> Scenario:
    low_v, high_v, half_n = wave
    excitation = Excitation(low_v=low_v, high_v=high_v, frequency_hz=RATE_HZ / (2 * half_n))
    return Scenario(samples=SAMPLES, excitation=excitation, plant=PlantChoice(program, *plant), name=name)
