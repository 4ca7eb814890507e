"""Rig descriptions with real components and the faults of a card."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from harness import config
from harness.errors import ConfigurationError
from harness.rigs.description import open_rig
from harness.run import CHANNELS
from harness.scenario import Scenario

NEEDED = "[card.range_v]"


def codes(rig: str, seed: int = 1) -> np.ndarray:
    with open_rig(rig) as opened:
        return np.concatenate([block.codes for block in opened.perform(Scenario.load("healthy"), seed).blocks])


def described(folder: Path, faults: str) -> str:
    """The rig "emulator" with more lines in its card."""
    path = folder / "own.toml"
    path.write_text(config.locate("rigs", "emulator").read_text().replace(NEEDED, f"{faults}\n{NEEDED}"))
    return str(path)


@pytest.mark.parametrize("rig", ["emulator-real", "emulator-skewed"])
def test_a_real_rig_gives_the_same_codes_for_the_same_seed_and_others_for_another(rig: str) -> None:
    assert np.array_equal(codes(rig), codes(rig))
    assert not np.array_equal(codes(rig), codes(rig, seed=2))


def test_a_skewed_rig_sees_the_displacement_later_and_the_force_at_the_same_instant() -> None:
    """Same noise, same offsets: what differs is when the channels are taken, up to 46 LSB of displacement and 1 more
    for rounding."""
    differences = codes("emulator-skewed").astype(int) - codes("emulator")
    assert not differences[:, CHANNELS.index("force")].any()
    assert 20 < np.abs(differences[:, CHANNELS.index("displacement")]).max() < 60


def test_a_fault_in_the_description_reaches_the_codes(tmp_path: Path) -> None:
    assert np.all(codes(described(tmp_path, "faults = { stuck_high = 1 }")) & 1)


def test_noise_of_the_machine_moves_a_code_now_and_then_by_one(tmp_path: Path) -> None:
    """0.027 LSB rms: nearly all codes stay as they are, and the force, which no amplifier carries, all of them."""
    noisy = tmp_path / "noisy.toml"
    text = config.locate("rigs", "emulator").read_text()
    noisy.write_text(text.replace("[computer]", "[computer]\nnoise = true"))
    differences = codes(str(noisy)).astype(int) - codes("emulator")
    displacement = np.abs(differences[:, CHANNELS.index("displacement")])
    assert not differences[:, CHANNELS.index("force")].any()
    assert displacement.max() == 1 and displacement.mean() < 0.05


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("faults = { stuck = 1 }", "card: faults: unknown key 'stuck'"),
        ("faults = { stuck_high = 5000 }", "card: stuck_high must be a mask"),
        ("faults = { skew_s = [0.0, 1e-5] }", "card: skew_s must have 4 channels"),
        ('faults = { acquisition = "slow" }', "card: faults: "),
        ("faults = { throughput_hz = 5e4 }", "card: throughput_hz 50000 does not carry 4 channels"),
        ('model = "dt9999"', "card: model: must be one of 'ideal', 'dt2821', 'skewed'"),
    ],
)
def test_a_wrong_fault_is_refused_by_name(tmp_path: Path, fault: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        open_rig(described(tmp_path, fault))
