"""The decks by which `make bench ARGS=engine` measures ngspice differ as the benchmark says."""

from __future__ import annotations

import re

import numpy as np
import pytest

from analogrig_emulator import Excitation, SuspensionComputer
from tests.benchmarks.bench_engine import ACCURACIES, LSB_V, THESIS_TWEAKS, TOLERATED_LSB, decks, simulate, variants

SAMPLES = 800


def periods_s(deck: str) -> list[float]:
    return [float(text) for text in re.findall(r"^X\S* clock \S+ period=(\S+)$", deck, re.MULTILINE)]


def test_two_of_three_decks_have_no_time_points_on_the_samples() -> None:
    found = [periods_s(deck) for deck in decks(SAMPLES, THESIS_TWEAKS)]
    assert found == [[5e-5], [1.0], [1.0]] * len(ACCURACIES)


def test_deck_that_is_written_otherwise_is_refused() -> None:
    deck = next(decks(SAMPLES, THESIS_TWEAKS)).replace("Xclock", "Vtimepoints")
    with pytest.raises(ValueError, match="0 matches"):
        list(variants(deck))


@pytest.mark.tools("ngspice")
def test_decks_without_time_points_on_the_samples_compute_the_same_signals() -> None:
    exact = np.concatenate(list(SuspensionComputer("front").play(Excitation(), SAMPLES, THESIS_TWEAKS)))[:, 1]
    number = next(i for i, each in enumerate(ACCURACIES) if each.max_step_s == 8e-6)
    for deck in list(decks(SAMPLES, THESIS_TWEAKS))[3 * number : 3 * number + 3]:
        _, volts = simulate(deck, SAMPLES)
        assert np.abs(volts - exact).max() <= TOLERATED_LSB * LSB_V
