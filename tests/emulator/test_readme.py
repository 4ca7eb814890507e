"""The examples of emulator/README.md and of the how-to page on own circuits run, and do what they state."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.linalg
from numpy.typing import NDArray

from analogrig_emulator import Deck
from tests.emulator.plays import LSB_V, NgSpice

ROOT = Path(__file__).parents[2]
README = "emulator/README.md"
OWN_CIRCUIT = "harness/docs/howto/write-a-netlist.md"


def names_after(page: str) -> dict[str, Any]:
    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)
    names: dict[str, Any] = {}
    exec(compile(example, page, "exec"), names)  # noqa: S102  of our own pages
    return names


def displacement_m(samples: int) -> NDArray[np.float64]:
    """Solution of M x'' + B x' + K x = F: K changes after sample 200, F is 2940 N in the first half of a period."""
    mass_kg, damping, states = 115.0, 3021.0, [np.zeros(2)]
    for k in range(samples - 1):
        stiffness = 24500.0 if k < 200 else 18000.0
        rest = np.array([2940.0 / stiffness if k % 100 < 50 else 0.0, 0.0])
        flow = np.array([[0.0, 1.0], [-stiffness / mass_kg, -damping / mass_kg]])
        states.append(rest + scipy.linalg.expm(flow * 200 * 50e-6) @ (states[-1] - rest))
    return np.array(states)[:, 0]


def test_the_readme_plays_and_samples_its_changes() -> None:
    """Within 10 LSB: offsets of 3 mV move the displacement by 5 LSB, and the card has 1 LSB of noise."""
    names = names_after(README)
    assert names["codes"].shape == names["clipped"].shape == (800, 4)
    assert names["codes"].dtype == np.uint16
    volts = names["card"].volts(names["codes"])[:600, 1]
    np.testing.assert_allclose(volts, displacement_m(600) / 0.1996 * 10.0, rtol=0, atol=10 * 12.0 / 4096)
    coefficient = names["computer"].program.coefficient("M", 30.0)
    assert names["computer"].coefficients["M"] == pytest.approx(coefficient)


def test_every_module_of_the_readme_exists_and_every_module_is_listed() -> None:
    listed = set(re.findall(r"`(\w+\.py)`", (ROOT / README).read_text().partition("## Folders")[2].partition("## ")[0]))
    package = ROOT / "emulator" / "analogrig_emulator"
    assert listed == {path.name for path in package.rglob("*.py")} - {"__init__.py"}


@pytest.fixture(scope="module")
def oscillator() -> dict[str, Any]:
    return names_after(OWN_CIRCUIT)


def test_the_oscillator_of_the_how_to_solves_its_equation(oscillator: dict[str, Any]) -> None:
    """To 10 LSB, the finite bandwidth of four TL07x amplifiers: 7.4 LSB at 3 MHz, and a tenth of it at 30 MHz."""
    step = scipy.linalg.expm(np.array([[0.0, 1.0], [-8e7, -2500.0]]) * 50e-6)
    expected_v = np.array([(np.linalg.matrix_power(step, k) @ [5.0, 0.0])[0] for k in range(100)])
    np.testing.assert_allclose(oscillator["volts"][1:, 0], expected_v[1:], rtol=0, atol=10 * LSB_V)


def test_the_deck_of_the_oscillator_agrees_with_ngspice_and_the_machine(
    oscillator: dict[str, Any], ngspice: NgSpice
) -> None:
    nodes = ("u3", "u2")
    deck = Deck(oscillator["machine"].circuit, samples=100, initial_v={"C2": -5.0, "U3": 5.0, "U1": -4.0})
    volts = deck.volts(nodes)
    assert np.abs(volts[1:] - ngspice(deck.text(nodes=nodes), nodes, 100)[1:]).max() < 0.05 * LSB_V
    assert np.abs(volts[1:] - oscillator["volts"][1:]).max() < 1.0 * LSB_V
