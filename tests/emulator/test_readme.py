"""The Python of emulator/README.md runs as it stands there, and does what the page says."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.linalg
from numpy.typing import NDArray

README = (Path(__file__).parents[2] / "emulator" / "README.md").read_text()
EXAMPLES = re.findall(r"```python\n(.*?)```", README, re.DOTALL)

NgSpice = Callable[[str, Sequence[str], int], NDArray[np.float64]]
LSB_V = 10.0 / 4096


def names_after(example: str) -> dict[str, Any]:
    names: dict[str, Any] = {}
    exec(compile(example, "emulator/README.md", "exec"), names)  # noqa: S102  of our own page
    return names


@pytest.mark.parametrize("number", range(len(EXAMPLES)))
def test_an_example_of_the_readme_runs(number: int) -> None:
    names_after(EXAMPLES[number])


@pytest.fixture(scope="module")
def oscillator() -> dict[str, Any]:
    return names_after(next(example for example in EXAMPLES if "tl07x = preset" in example))


def test_the_oscillator_of_the_readme_solves_its_equation(oscillator: dict[str, Any]) -> None:
    """To 10 LSB, the finite bandwidth of four TL07x amplifiers: 7.4 LSB at 3 MHz, and a tenth of it at 30 MHz."""
    step = scipy.linalg.expm(np.array([[0.0, 1.0], [-8e7, -2500.0]]) * 50e-6)
    expected_v = np.array([(np.linalg.matrix_power(step, k) @ [5.0, 0.0])[0] for k in range(100)])
    np.testing.assert_allclose(oscillator["volts"][1:, 0], expected_v[1:], rtol=0, atol=10 * LSB_V)


def test_the_deck_of_the_readmes_oscillator_agrees_with_ngspice_and_the_machine(
    oscillator: dict[str, Any], ngspice: NgSpice
) -> None:
    deck, nodes = oscillator["deck"], ("u3", "u2")
    volts = deck.volts(nodes)
    assert np.abs(volts[1:] - ngspice(deck.text(nodes=nodes), nodes, 100)[1:]).max() < 0.05 * LSB_V
    assert np.abs(volts[1:] - oscillator["volts"][1:]).max() < 1.0 * LSB_V
