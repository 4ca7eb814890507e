"""Programs beyond one mass, damper and spring, and tweaks that last: from scenario to verdict, deck and signals."""

from __future__ import annotations

import dataclasses
import json
import typing
from pathlib import Path

import numpy as np
import pytest

from analogrig import cli
from analogrig.bench import Bench
from analogrig.cli import options
from analogrig.devices.opening import open_dut
from analogrig.errors import ConfigurationError
from analogrig.judging import information
from analogrig.judging.verdict import as_json, judge
from analogrig.plant import Plant, SampledPlant, Segment
from analogrig.reporting.export import netlist
from analogrig.rigs.description import open_rig
from analogrig.rigs.emulator import EmulatorRig
from analogrig.rigs.recording import RecordingRig
from analogrig.run import Run
from analogrig.scenario import PlantChoice, PotChange, Scenario
from analogrig_emulator import PROGRAMS, SuspensionComputer
from tests.harness.runs import made_run

FRONT, SOFT = Plant(115.0, 3021.0, 24500.0), Plant(115.0, 3021.0, 18000.0)
SQUARE_N = np.where(np.arange(900) % 100 < 50, 2900.0, 30.0)

CHANGE_AT = 700
"""Beginning of the ramp: after the warm-up of the device."""

RAMPED = f"""
samples = 1100
[excitation]
low_v = 0.1
high_v = 9.9
[[tweaks]]
sample = {CHANGE_AT}
stiffness_n_per_m = 18000.0
ramp_n = 60
"""


@pytest.fixture(scope="module")
def ramped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("ramped") / "ramped.toml"
    path.write_text(RAMPED)
    return path


def played(scenario: Scenario) -> Run:
    with open_rig("emulator") as rig, open_dut("host") as dut:
        return Bench(rig, dut).play(scenario, 1)


# ---- programs


def test_every_program_has_its_name_in_scenarios_and_on_the_command_line() -> None:
    assert set(typing.get_args(typing.get_type_hints(PlantChoice)["set"])) == set(PROGRAMS) == set(options.PROGRAMS)


@pytest.mark.parametrize("program", ["bump-stop", "two-mass"])
def test_run_of_another_program_is_played_and_not_judged(program: str) -> None:
    scenario = Scenario.load("thesis")
    run = played(dataclasses.replace(scenario, plant=PlantChoice(program)))  # type: ignore[arg-type]
    verdict = judge(run)
    assert run.samples == scenario.samples
    assert verdict.outcome == "inconclusive"
    assert verdict.reasons[0].startswith(f"the program {program} is not a single mass, damper and spring")


def test_two_masses_sit_where_their_springs_in_series_say() -> None:
    """2910.6 N on 24500 N/m and 180 kN/m in series."""
    scenario = Scenario.load("healthy")
    still = dataclasses.replace(scenario.excitation, frequency_hz=10.0)
    scenario = dataclasses.replace(
        scenario, samples=400, excitation=still, random_phase=False, plant=PlantChoice("two-mass")
    )
    with open_rig("emulator") as rig:
        performance = rig.perform(scenario, 3)
        codes = np.concatenate([block.codes for block in performance.blocks])[-50:, 1]
    assert performance.channels["displacement"].physical(codes).mean() == pytest.approx(
        2910.6 / 24500.0 + 2910.6 / 180e3, rel=1e-2
    )


@pytest.mark.parametrize("program", PROGRAMS)
def test_every_program_can_be_written_as_a_deck_and_as_signals(
    program: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    common = ["--scenario", "shock" if program == "shock" else "thesis", "--program", program]
    assert cli.main(["netlist", *common, "--out", str(tmp_path / "deck.cir")]) == 0
    amplifiers = SuspensionComputer(program).program.amplifiers
    deck = (tmp_path / "deck.cir").read_text().lower()
    assert f"u{amplifiers}" in deck
    assert (("diode_limiter" in deck), (f"u{amplifiers + 1}" in deck)) == (program == "bump-stop", False)
    capsys.readouterr()
    assert cli.main(["emulate", *common, "--out", str(tmp_path / "signals.npz"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["overloads"] == {}


def test_program_that_is_none_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(["emulate", "--program", "rear"])
    assert ended.value.code == 2
    assert "invalid choice: 'rear'" in capsys.readouterr().err


# ---- ramps


def test_latency_of_a_ramp_counts_from_its_start(ramped: Path) -> None:
    verdict = judge(played(Scenario.load(str(ramped))))
    (tweak,) = verdict.tweaks
    assert verdict.outcome == "passed"
    assert tweak.sample == CHANGE_AT
    assert tweak.bound_n is not None
    assert tweak.latency_n is not None
    assert 0.5 * tweak.bound_n < tweak.latency_n < 60
    jump = dataclasses.replace(Scenario.load(str(ramped)), tweaks=(PotChange(CHANGE_AT, stiffness_n_per_m=18000.0),))
    assert as_json(judge(played(jump)))["tweaks"][0]["bound"] < tweak.bound_n


@pytest.mark.parametrize("seed", range(1, 5))
def test_latencies_of_ramps_are_near_their_bounds(seed: int) -> None:
    """The trigger comes near the bound for jumps; if it does for ramps, too, their bound is right."""
    with open_rig("emulator") as rig, open_dut("host") as dut:
        verdict = judge(Bench(rig, dut).play(Scenario.load("slow"), seed))
    assert verdict.outcome == "passed"
    for tweak in verdict.tweaks:
        assert tweak.bound_n is not None
        assert tweak.latency_n is not None
        assert tweak.bound_n <= tweak.latency_n < 2 * tweak.bound_n


def test_alarms_while_a_change_lasts_and_the_first_after_it_are_not_false() -> None:
    run = with_ramp(60)
    alarmed = dataclasses.replace(
        run,
        alarm_index=np.array([100, 420, 450, 500, 600], np.int64),
        alarm_kind=np.full(5, 3, np.uint8),
        alarm_statistic=np.full(5, 12.0, np.float32),
    )
    verdict = judge(alarmed)
    assert verdict.tweaks[0].latency_n == 10
    assert verdict.false_alarms == (100, 600)


def test_ramp_is_in_the_recording(ramped: Path, tmp_path: Path) -> None:
    run = played(Scenario.load(str(ramped)))
    run.save(tmp_path / "run.npz")
    assert Run.load(tmp_path / "run.npz").conditions.segments[1] == Segment(CHANGE_AT, SOFT, 60)
    assert RecordingRig.open(tmp_path / "run.npz").scenario().tweaks[0].ramp_n == 60
    assert judge(Run.load(tmp_path / "run.npz")) == judge(run)


def with_ramp(ramp_n: int) -> Run:
    run = made_run(SQUARE_N, [(0, FRONT), (410, SOFT)])
    segments = (Segment(0, FRONT), Segment(410, SOFT, ramp_n))
    return dataclasses.replace(run, conditions=dataclasses.replace(run.conditions, segments=segments))


def test_information_on_a_ramp_is_that_of_a_plant_that_changes_a_little_every_sample() -> None:
    """Against a staircase of jumps of a sixtieth each, whose plants this test makes by itself."""
    (ramped_information,) = information.change_information(with_ramp(60))
    period_s = 5e-5 * 200.0
    unchanged = changed = (0.0, 0.0)
    force_n = np.round(SQUARE_N / (2940.0 / 4096)) * (2940.0 / 4096)
    before = SampledPlant.from_plant(FRONT, period_s)
    for force in force_n[:410]:
        unchanged = before.next(unchanged, force)
    changed, total = unchanged, 0.0
    for k, force in enumerate(force_n[410:480]):
        stiffness = 24500.0 - 6500.0 * min((k + 0.5) / 60, 1.0)
        now = SampledPlant.from_plant(Plant(115.0, 3021.0, stiffness), period_s)
        unchanged, changed = before.next(unchanged, force), now.next(changed, force)
        total += ((changed[0] - unchanged[0]) / (0.1996 / 4096)) ** 2 / (2 * (1 + 1 / 12))
        assert ramped_information[k] == pytest.approx(total, rel=1e-9)


def test_information_of_a_jump_is_that_of_a_ramp_of_no_length() -> None:
    (jump,) = information.change_information(made_run(SQUARE_N, [(0, FRONT), (410, SOFT)]))
    (ramp,) = information.change_information(with_ramp(0))
    assert np.array_equal(jump, ramp)
    longer = information.change_information(with_ramp(2000))[0]
    assert len(longer) == len(jump)
    assert (longer <= jump).all()


@pytest.mark.parametrize(
    ("given", "limit_lsb"), [({"stiffness_n_per_m": 18000.0}, 10.0), ({"mass_kg": 40.0}, 3.0)], ids=str
)
def test_plant_of_the_truth_follows_the_emulated_machine_through_a_ramp(
    ramped: Path, given: dict[str, float], limit_lsb: float
) -> None:
    """1/M, B and K change evenly in the harness, dials in the machine, which the load of the pots tells apart."""
    scenario = dataclasses.replace(Scenario.load(str(ramped)), tweaks=(PotChange(CHANGE_AT, ramp_n=60, **given),))
    after = dataclasses.replace(FRONT, **given)
    with open_rig("emulator-ideal") as rig:
        volts = np.concatenate([block.volts for block in rig.perform(scenario, 1).blocks])
    state, plants = (0.0, 0.0), [FRONT] * CHANGE_AT
    plants += [FRONT.interpolate(after, (k + 0.5) / 60) for k in range(60)] + [after] * 340
    seen = []
    for plant, force_v in zip(plants, volts[:, 0], strict=True):
        seen.append(state[0] / 0.01996)
        state = SampledPlant.from_plant(plant, 0.01).next(state, force_v * 294.0)
    error_lsb = np.abs(np.array(seen) - volts[:, 1]) / (10.0 / 4096)
    assert error_lsb[:CHANGE_AT].max() < 0.01
    assert error_lsb[CHANGE_AT:].max() < limit_lsb


def test_deck_of_a_ramp_plays_what_the_rig_plays(ramped: Path) -> None:
    """A step of the dial a sample: at most 2 LSB beside the engine's finer pieces."""
    scenario = Scenario.load(str(ramped))
    with open_rig("emulator-ideal") as rig:
        assert isinstance(rig, EmulatorRig)
        deck = netlist(rig, scenario, 1)
        volts = np.concatenate([block.volts for block in rig.perform(scenario, 1).blocks])
    assert np.abs(deck.volts(["u5"])[:, 0] - volts[:, 1]).max() < 2.0 * 10.0 / 4096
    assert deck.turns[-1][0] == CHANGE_AT + 60


@pytest.mark.parametrize(
    ("tweaks", "message"),
    [
        (
            (PotChange(300, mass_kg=60.0, ramp_n=60), PotChange(350, mass_kg=70.0)),
            "at sample 300 lasts 60 samples, beyond",
        ),
        ((PotChange(1099, mass_kg=60.0), PotChange(1100, mass_kg=70.0)), "beyond the last of 1100 samples"),
    ],
)
def test_ramps_that_cannot_be_are_refused(ramped: Path, tweaks: tuple[PotChange, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(Scenario.load(str(ramped)), tweaks=tweaks)


def test_ramp_of_no_whole_number_is_refused_naming_the_key(tmp_path: Path) -> None:
    (tmp_path / "wrong.toml").write_text(RAMPED.replace("ramp_n = 60", "ramp_n = -1"))
    with pytest.raises(ConfigurationError, match=r"wrong.toml: tweaks\[0\]: ramp_n must be in 0 .. 100000, not -1"):
        Scenario.load(str(tmp_path / "wrong.toml"))


def test_wiper_noise_is_off_until_the_rig_asks_for_it(ramped: Path, tmp_path: Path) -> None:
    text = Path("fixtures/rigs/emulator-ideal.toml").read_text()
    (tmp_path / "noisy.toml").write_text(text.replace("[card]", "wiper_noise_ohm = 100.0\n\n[card]", 1))
    codes = {}
    for name in ("emulator-ideal", str(tmp_path / "noisy.toml")):
        with open_rig(name) as rig:
            codes[name] = np.concatenate([b.codes for b in rig.perform(Scenario.load(str(ramped)), 1).blocks])
    silent, noisy = codes.values()
    moved = np.abs(silent.astype(int) - noisy.astype(int)).max(axis=1)
    assert moved[: CHANGE_AT + 1].max() == 0
    assert moved[CHANGE_AT + 1 : CHANGE_AT + 60].max() > 0
