"""What is played on a rig to calibrate it: square waves, each with pots, levels and a frequency of its own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from emulator import Excitation
from harness.scenario import PlantChoice, Scenario

Program = Literal["front", "shock"]

SAMPLES = 1400

RATE_HZ = 20e3
"""Of the card: the periods below are whole numbers of its samples."""

_Row = tuple[float, float, float, float, float, int]

_PLAN: Mapping[Program, tuple[_Row, ...]] = {
    "front": (
        (115.0, 3021.0, 24500.0, 0.1, 9.9, 50),
        (115.0, 3021.0, 24500.0, 0.6, 9.5, 10),
        (115.0, 3021.0, 18000.0, 0.2, 8.0, 25),
        (115.0, 2123.0, 20000.0, 1.0, 9.0, 20),
        (60.0, 3021.0, 24500.0, 0.3, 9.7, 8),
        (60.0, 4000.0, 28000.0, 0.4, 9.2, 16),
        (35.0, 2600.0, 19000.0, 0.7, 7.5, 20),
        (230.0, 4200.0, 15000.0, 0.5, 6.0, 32),
        (160.0, 1600.0, 28000.0, 3.0, 9.0, 40),
        (31.0, 2500.0, 26500.0, 0.8, 8.8, 5),
        (80.0, 3600.0, 21500.0, 0.1, 8.5, 10),
        (45.0, 2800.0, 16500.0, 1.2, 6.9, 25),
    ),
    "shock": (
        (2.0, 900.0, 12250.0, 0.1, 9.9, 50),
        (2.0, 900.0, 12250.0, 0.6, 9.5, 10),
        (2.0, 900.0, 9000.0, 0.2, 8.0, 25),
        (2.0, 632.0, 10000.0, 1.0, 9.0, 20),
        (1.6, 900.0, 12250.0, 0.3, 9.7, 8),
        (1.6, 1200.0, 14000.0, 0.4, 9.2, 16),
        (2.6, 780.0, 9500.0, 0.7, 7.5, 20),
        (5.5, 1250.0, 7500.0, 0.5, 6.0, 32),
        (3.5, 600.0, 14000.0, 3.0, 9.0, 40),
        (1.55, 750.0, 13250.0, 0.8, 8.8, 5),
        (2.3, 1070.0, 10750.0, 0.1, 8.5, 10),
        (4.0, 835.0, 8250.0, 1.2, 6.9, 25),
    ),
}
"""kg, N s/m, N/m, V, V, samples of half a period: pots over their ranges, no amplifier overloaded, x within -1..9 V."""

_CHECK: Mapping[Program, _Row] = {
    "front": (95.0, 2700.0, 22500.0, 2.0, 8.2, 64),
    "shock": (1.8, 980.0, 11000.0, 2.0, 8.2, 64),
}


def scenarios(program: Program) -> tuple[Scenario, ...]:
    """What is played on a rig to calibrate it."""
    return tuple(_scenario(program, f"calibration-{i}", row) for i, row in enumerate(_PLAN[program], start=1))


def check_scenario(program: Program) -> Scenario:
    """One more, to compare rig and twin on: its pots, levels and frequency are none of those of ``scenarios``."""
    return _scenario(program, "calibration-check", _CHECK[program])


def _scenario(program: Program, name: str, row: _Row) -> Scenario:
    *plant, low_v, high_v, half_n = row
    wave = Excitation(low_v=low_v, high_v=high_v, frequency_hz=RATE_HZ / (2 * half_n))
    return Scenario(samples=SAMPLES, excitation=wave, plant=PlantChoice(program, *plant), name=name)
