"""The rigs: the same seed the same codes, and what they say of themselves."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from analogrig import config
from analogrig.errors import ConfigurationError
from analogrig.rigs.description import open_rig
from analogrig.rigs.recording import RecordingRig
from analogrig.rigs.rig import Block, Rig
from analogrig.run import CHANNELS
from analogrig.scenario import PotChange, Scenario


def blocks(rig: Rig, scenario: Scenario, seed: int) -> list[Block]:
    return list(rig.perform(scenario, seed).blocks)


def codes(name: str, scenario: Scenario, seed: int) -> np.ndarray:
    with open_rig(name) as rig:
        return np.concatenate([block.codes for block in blocks(rig, scenario, seed)])


def test_same_seed_gives_the_same_codes_and_another_seed_others() -> None:
    thesis = Scenario.load("thesis")
    first = codes("emulator", thesis, 7)
    assert first.tobytes() == codes("emulator", thesis, 7).tobytes()
    assert first.tobytes() != codes("emulator", thesis, 8).tobytes()


def test_blocks_are_consecutive_and_complete() -> None:
    thesis = Scenario.load("thesis")
    with open_rig("emulator") as rig:
        parts = blocks(rig, thesis, 1)
    assert [part.first for part in parts] == list(np.cumsum([0, *(len(part.codes) for part in parts[:-1])]))
    assert sum(len(part.codes) for part in parts) == thesis.samples


def test_channels_translate_codes_to_the_quantities_of_the_suspension() -> None:
    """At rest under a constant force x = F / K: 2910.6 N / 24500 N/m = 0.1188 m, to 1 % with 12 bits and mV offsets."""
    scenario = dataclasses.replace(
        Scenario.load("healthy"),
        samples=400,
        random_phase=False,
        excitation=dataclasses.replace(Scenario.load("healthy").excitation, frequency_hz=10.0),
    )
    with open_rig("emulator") as rig:
        performance = rig.perform(scenario, 3)
        last = np.concatenate([block.codes for block in performance.blocks])[-50:]
    values = {name: performance.channels[name].physical(last[:, i]).mean() for i, name in enumerate(CHANNELS)}
    assert values["force"] == pytest.approx(9.9 / 10.0 * 2940.0, rel=2e-3)
    assert values["displacement"] == pytest.approx(values["force"] / 24500.0, rel=1e-2)
    assert values["velocity"] == pytest.approx(0.0, abs=5e-3)
    assert values["net_force"] == pytest.approx(0.0, abs=5.0)


def test_undershoot_clips_on_the_unipolar_range_and_not_on_the_wide_one() -> None:
    thesis = Scenario.load("thesis")
    displacement = CHANNELS.index("displacement")
    clipped = {}
    for name in ("emulator", "emulator-0-10v"):
        with open_rig(name) as rig:
            clipped[name] = np.concatenate([block.clipped for block in blocks(rig, thesis, 2)])[:, displacement].sum()
    assert clipped["emulator"] == 0
    assert clipped["emulator-0-10v"] > 5


def test_segments_tell_the_truth_after_each_tweak() -> None:
    with open_rig("emulator") as rig:
        segments = rig.perform(Scenario.load("thesis"), 1).hindsight().segments
    assert [segment.start for segment in segments] == [0, 1200, 1400, 1500, 1600]
    assert list(segments[-1].plant.parameters().values()) == [30.0, 2123.0, 20000.0]


def test_tweak_to_the_same_value_is_no_change() -> None:
    scenario = dataclasses.replace(Scenario.load("healthy"), tweaks=(PotChange(sample=50, mass_kg=115.0),))
    assert len(scenario.segments()) == 1


def test_pot_beyond_its_track_is_refused_before_the_run() -> None:
    scenario = dataclasses.replace(Scenario.load("healthy"), tweaks=(PotChange(sample=50, mass_kg=20.0),))
    with (
        open_rig("emulator") as rig,
        pytest.raises(ConfigurationError, match=r"healthy: tweaks\[0\] at sample 50: pot M: .*M_kg = 20"),
    ):
        rig.perform(scenario, 1)


def test_rig_names_its_file_when_it_is_wrong(tmp_path: Path) -> None:
    path = tmp_path / "bench.toml"
    text = config.locate("rigs", "emulator").read_text()
    path.write_text(text.replace("noise_lsb", "noise_lbs"))
    with pytest.raises(ConfigurationError, match=r"bench.toml: card: unknown key 'noise_lbs'"):
        open_rig(str(path))


def test_recording_plays_its_own_scenario_and_no_other(recorded_thesis: Path) -> None:
    rig = RecordingRig.open(recorded_thesis)
    with rig, pytest.raises(ConfigurationError, match="holds the scenario 'thesis' and can play no other"):
        rig.perform(Scenario.load("healthy"), 1)
    again = np.concatenate([block.codes for block in blocks(rig, rig.scenario(), rig.run.conditions.seed)])
    assert again.tobytes() == rig.run.codes.tobytes()
