"""The rigs: the same seed the same codes, real components, and the faults of a card."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from analogrig import config
from analogrig.errors import ConfigurationError
from analogrig.program import Program
from analogrig.rigs.description import open_rig
from analogrig.rigs.emulator import EmulatorRig
from analogrig.rigs.recording import RecordingRig
from analogrig.rigs.rig import Block, Rig
from analogrig.scenario import PotChange, Scenario
from analogrig_emulator import (
    CHANNELS,
    DIELECTRICS,
    MULTIPLIERS,
    Capacitor,
    Multiplier,
    MultiplierModel,
    OpAmp,
    Resistor,
)

NEEDED = "[card.range_v]"


def blocks(rig: Rig, scenario: Scenario, seed: int) -> list[Block]:
    return list(rig.perform(scenario, seed).blocks)


def codes(name: str, seed: int = 1, scenario: str = "healthy") -> np.ndarray:
    with open_rig(name) as rig:
        return np.concatenate([block.codes for block in blocks(rig, Scenario.load(scenario), seed)])


@pytest.mark.parametrize(
    ("rig", "scenario"), [("emulator", "thesis"), ("emulator-real", "healthy"), ("emulator-skewed", "healthy")]
)
def test_same_seed_gives_the_same_codes_and_another_seed_others(rig: str, scenario: str) -> None:
    first = codes(rig, 7, scenario)
    assert np.array_equal(first, codes(rig, 7, scenario))
    assert not np.array_equal(first, codes(rig, 8, scenario))


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


def test_segments_tell_the_truth_after_each_change() -> None:
    with open_rig("emulator") as rig:
        segments = rig.perform(Scenario.load("thesis"), 1).hindsight().segments
    assert [segment.start for segment in segments] == [0, 1200, 1400, 1500, 1600]
    assert list(segments[-1].plant.parameters().values()) == [30.0, 2123.0, 20000.0]


def test_change_to_the_same_value_is_no_change() -> None:
    scenario = dataclasses.replace(Scenario.load("healthy"), changes=(PotChange(sample=50, set={"M": 115.0}),))
    assert len(scenario.segments()) == 1


def test_pot_beyond_its_track_is_refused_before_the_run() -> None:
    scenario = dataclasses.replace(Scenario.load("healthy"), changes=(PotChange(sample=50, set={"M": 20.0}),))
    with (
        open_rig("emulator") as rig,
        pytest.raises(ConfigurationError, match=r"healthy: changes\[0\] at sample 50: M = 20 cannot be set .*: pot M"),
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


# ---- faults of the card


def described(folder: Path, faults: str) -> str:
    """The rig "emulator" with more lines in its card."""
    path = folder / "own.toml"
    path.write_text(config.locate("rigs", "emulator").read_text().replace(NEEDED, f"{faults}\n{NEEDED}"))
    return str(path)


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


def test_hum_of_the_supply_moves_codes_without_noise(tmp_path: Path) -> None:
    """10 V over a rejection of 1e5: 0.1 mV at each amplifier, a fraction of an LSB in the displacement; none drawn."""
    humming = tmp_path / "humming.toml"
    text = config.locate("rigs", "emulator").read_text()
    humming.write_text(text.replace("[computer]", "[computer]\nsupply_hum_v = 10.0"))
    differences = codes(str(humming)).astype(int) - codes("emulator")
    displacement = np.abs(differences[:, CHANNELS.index("displacement")])
    assert not differences[:, CHANNELS.index("force")].any()
    assert displacement.max() == 1 and displacement.mean() < 0.2


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


# ---- a machine that was measured

VALUES = """
[computer.values]
deviation = { RF = 0.01, C1 = -0.02 }
offset_v = { U1 = 2e-3 }
bandwidth = { U1 = 0.1 }
slew = { U1 = -0.1 }

[card]"""


def own(folder: Path, computer: str, name: str = "own") -> str:
    """The rig "emulator" with another [computer]."""
    path = folder / f"{name}.toml"
    card = config.locate("rigs", "emulator").read_text().partition("[card]")[2]
    path.write_text(f"[computer]\n{computer}\n[card]{card}")
    return str(path)


def elements(rig: str, seed: int, scenario: str = "healthy") -> dict[str, object]:
    with open_rig(rig) as opened:
        assert isinstance(opened, EmulatorRig)
        return {each.name: each for each in opened.set_up(Scenario.load(scenario), seed).computer.circuit.elements}


def test_fine_effects_of_the_amplifiers_are_a_switch(tmp_path: Path) -> None:
    coarse, fine = (
        elements(own(tmp_path, f'components = "polyester"\nfine_effects = {switch}', switch), 1)
        for switch in ("false", "true")
    )
    added = {"U1_minus_farad", "U2_minus_farad"}
    assert not added & set(coarse) and added <= set(fine)
    before, after = coarse["U1"], fine["U1"]
    assert isinstance(before, OpAmp) and isinstance(after, OpAmp)
    assert (before.model.limits_current, after.model.limits_current) == (False, True)
    assert (before.model.cmrr, after.model.cmrr) == (math.inf, 1e5)


def multipliers(rig: str, seed: int) -> list[MultiplierModel]:
    return [each.model for each in elements(rig, seed, "duffing").values() if isinstance(each, Multiplier)]


ERRORS = ("gain_error", "x_offset_v", "y_offset_v", "z_offset_v", "x_nonlinearity", "y_nonlinearity")


def test_multipliers_of_a_real_rig_have_drawn_errors_and_the_limits_of_the_data_sheet() -> None:
    models = multipliers("emulator-real", 1)
    assert len(models) == 2 and models[0] != models[1] and models != multipliers("emulator-real", 2)
    for model in models:
        assert all(getattr(model, error) for error in ERRORS)
        assert dataclasses.replace(model, **dict.fromkeys(ERRORS, 0.0)) == MULTIPLIERS["ad633"]  # type: ignore[arg-type]


def test_multipliers_are_a_switch(tmp_path: Path) -> None:
    real = own(tmp_path, 'components = "polyester"\nmultiplier = "ideal"', "real")
    nominal = own(tmp_path, 'multiplier = "ad633"', "nominal")
    assert multipliers("emulator", 1) == multipliers(real, 1) == 2 * [MULTIPLIERS["ideal"]]
    assert multipliers(nominal, 1) == 2 * [MULTIPLIERS["ad633"]]


def test_multipliers_of_a_measured_machine_have_no_drawn_errors(tmp_path: Path) -> None:
    measured = own(tmp_path, 'components = "polyester"\n[computer.values]\noffset_v = { U1 = 1e-3 }', "measured")
    assert multipliers(measured, 1) == 2 * [MULTIPLIERS["ad633"]]


def test_measured_values_are_those_of_the_machine_whatever_the_seed(tmp_path: Path) -> None:
    rig = own(tmp_path, 'components = "polyester"' + VALUES.removesuffix("[card]"))
    there = elements(rig, 1)
    assert there == elements(rig, 2)
    force, capacitor, summer = there["RF"], there["C1"], there["U1"]
    assert isinstance(force, Resistor) and force.ohm == pytest.approx(101e3)
    assert isinstance(capacitor, Capacitor) and capacitor.farad == pytest.approx(
        0.98e-9 * DIELECTRICS["polyester"].instantaneous
    )
    assert isinstance(summer, OpAmp)
    assert (summer.model.vos_v, summer.model.gbw_hz) == pytest.approx((2e-3, 3.3e6))
    assert summer.model.slew_v_per_s == pytest.approx(11.7e6)
    other = there["RB"]
    assert isinstance(other, Resistor) and other.ohm == 33.2e3


def test_runs_of_one_specimen_are_of_the_same_machine_with_other_noise(tmp_path: Path) -> None:
    drawn = 'components = "polyester"\noffset_v = 0.003'
    one = own(tmp_path, f"{drawn}\nspecimen = 7", "one")
    assert elements(one, 1) == elements(one, 2) == elements(own(tmp_path, drawn, "drawn"), 7)
    assert not np.array_equal(codes(one, 1), codes(one, 2))


def test_noise_can_be_given_channel_by_channel(tmp_path: Path) -> None:
    text = config.locate("rigs", "emulator").read_text()
    by_name = "noise_lsb = { force = 0.0, displacement = 1.0, velocity = 1.0, net_force = 1.0 }"
    path = tmp_path / "own.toml"
    path.write_text(text.replace("noise_lsb = 1.0", by_name))
    assert len(np.unique(codes(str(path))[:, CHANNELS.index("force")])) == 2
    assert np.array_equal(codes(str(path))[:, 1:], codes("emulator")[:, 1:])


@pytest.mark.parametrize(
    ("computer", "message"),
    [
        ("values = { offsets = { U1 = 0.1 } }", "values: unknown key 'offsets'"),
        ("values = { deviation = { RF = -1.0 } }", r"values: deviation.RF must be within \+-0.9, not -1"),
        ("values = { slew = { U1 = nan } }", "values: slew.U1: must be a number"),
        ("specimen = 3\nvalues = { }", "offset_v and specimen are for what is drawn"),
        ("specimen = -3", "specimen must be 0 to"),
    ],
)
def test_wrong_measured_values_are_refused_by_name(tmp_path: Path, computer: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=f"own.toml: computer.*{message}"):
        open_rig(own(tmp_path, computer))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ("deviation = { R99 = 0.1 }", "values: deviation: unknown key 'R99' \\(known: RF, "),
        ("deviation = { U1 = 0.1 }", "values: deviation: unknown key 'U1'"),
        ("offset_v = { RF = 0.1 }", r"values: offset_v: unknown key 'RF' \(known: U1, U2"),
        ("slew = { U6 = 0.1 }", r"values: slew: unknown key 'U6' \(known: U1, .*U5\)"),
    ],
)
def test_measured_values_of_elements_that_a_program_lacks_are_refused(
    tmp_path: Path, values: str, message: str
) -> None:
    with (
        open_rig(own(tmp_path, f"values = {{ {values} }}")) as rig,
        pytest.raises(ConfigurationError, match=message),
    ):
        rig.perform(Scenario.load("healthy"), 1)


def test_measured_values_name_elements_of_any_program(tmp_path: Path) -> None:
    scenario = Scenario.of_program(Program.load("dc-motor"))
    with open_rig(own(tmp_path, "values = { deviation = { J = 0.2 }, offset_v = { U5 = 1e-3 } }")) as rig:
        altered = next(rig.perform(scenario, 1).blocks).volts
    with open_rig(own(tmp_path, "values = { }")) as rig:
        assert not np.array_equal(next(rig.perform(scenario, 1).blocks).volts, altered)


@pytest.mark.parametrize(("pots", "at_start", "after"), [("coefficient", 0.83, 0.6098), ("dial", 0.8199, 0.5966)])
def test_a_pot_set_by_its_dial_passes_what_track_and_load_make_of_it(
    tmp_path: Path, pots: str, at_start: float, after: float
) -> None:
    """Pot K at 24500 and 18000 N/m (facts 1: coefficients .8300 and .6098, dials .8511 and .6380) with a track of 15k
    into 49.9k: .8511 / (1 + .8511 x .1489 x 15 / 49.9) = .8199, likewise .5966."""
    rig = own(tmp_path, f'pots = "{pots}"\nvalues = {{ deviation = {{ K = 0.5 }} }}')
    scenario = dataclasses.replace(Scenario.load("healthy"), changes=(PotChange(100, {"K": 18000.0}),))
    with open_rig(rig) as opened:
        assert isinstance(opened, EmulatorRig)
        computer, _, changes = opened.set_up(scenario, 1)
    assert computer.coefficients["K"] == pytest.approx(at_start, abs=1e-4)
    computer.set(**changes[0][1])
    assert computer.coefficients["K"] == pytest.approx(after, abs=1e-4)
