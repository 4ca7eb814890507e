"""Certificates and comparisons: that they say what is true, and not more often wrong than they promise."""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import shutil
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from analogrig.bench import Bench
from analogrig.campaigns.certificate import Question, certify
from analogrig.campaigns.differences import (
    Difference,
    Observation,
    Recorded,
    adjust_by_holm,
    compare,
    compare_sides,
    load,
    permutation_p,
    sign_flip_p,
)
from analogrig.campaigns.plan import rig_table
from analogrig.campaigns.plays import Count
from analogrig.campaigns.trials import Change, Trial
from analogrig.campaigns.workers import Processes, ThisProcess
from analogrig.cli import main
from analogrig.cli.certify import add as add_certify
from analogrig.datasheet import DEFAULT_ARL0
from analogrig.devices.registry import describe, open_dut
from analogrig.errors import ConfigurationError, RecordingError
from analogrig.judging.bursts import upper_count
from analogrig.rigs.description import open_rig
from analogrig.run import Run
from analogrig.scenario import PotChange, Scenario
from tests.harness.simulated_alarms import BEYOND, COVERED, SimulatedPlays

# -------------------------------------------------------------------------------------------------------- certificates


def test_rate_that_is_certified_by_default_is_that_of_the_default_arl0() -> None:
    """The option has a literal: importing the data sheet would delay every command."""
    parser = argparse.ArgumentParser()
    add_certify(parser.add_subparsers())
    assert parser.parse_args(["certify"]).far == 1.0 / DEFAULT_ARL0


def asked(dut: str = "inproc", **settings: Any) -> Question:
    return Question(rig_table("emulator"), describe(dut).as_table(), Scenario.load("healthy"), **settings)


def noisy_device(tmp_path: Path) -> str:
    """One whose trigger is far too sensitive: its ceiling is three standard deviations of the noise."""
    path = tmp_path / "noisy.toml"
    path.write_text('kind = "inproc"\n[estimator]\ntrigger = "prediction-error"\nceiling = 3.0\n')
    return str(path)


def test_quiet_device_is_certified_by_the_number_of_samples_that_this_takes() -> None:
    """The length excludes that no burst was due: burst ln(1 / 0.01) / 1e-4 but for the last samples."""
    for burst, samples in ((1.0, 46_052), (5.0, 230_259)):
        answer = certify(asked(far=1e-4, confidence=0.99, allowed=0, burst=burst), ThisProcess())
        assert answer.outcome == "certified"
        assert answer.alarms == 0
        assert answer.samples == pytest.approx(samples, abs=40)
        assert answer.rate[1] <= 1e-4


def test_noisy_device_is_refuted(tmp_path: Path) -> None:
    question = asked(noisy_device(tmp_path), far=1e-4, confidence=0.999, allowed=0, burst=5.0)
    answer = certify(question, ThisProcess())
    assert answer.outcome == "refuted"
    assert answer.alarms / answer.samples > 1e-4


def certificates(question: Question, kind: str, devices: int) -> Counter[str]:
    """Outcomes of the certificates of simulated devices at the limit."""
    plays = (SimulatedPlays(question, {**COVERED, **BEYOND}[kind], question.far, seed) for seed in range(devices))
    return Counter(certify(question, each).outcome for each in plays)


@pytest.mark.parametrize("name", COVERED)
def test_device_at_the_limit_is_certified_or_refuted_as_seldom_as_bursts_promise(name: str) -> None:
    """Simulated devices of each kind, at most a tenth of them wrong each way: binomial, false failure 1e-8 each."""
    question = asked(far=1e-4, confidence=0.9, burst=5.0, allowed=10)
    found = certificates(question, name, 20)
    most = stats.binom.isf(1e-8, 20, 0.1)
    assert found["certified"] <= most
    assert found["refuted"] <= most


def test_device_at_the_limit_is_certified_as_often_as_promised_if_its_alarms_are_independent_as_assumed() -> None:
    """Independent alarms under ``burst=1``, 100 devices: binomial, false failure 1e-6. No test is more powerful."""
    question = asked(far=1e-4, confidence=0.9, burst=1.0, allowed=3)
    found = certificates(question, "independent", 100)
    assert stats.binom.isf(1.0 - 1e-6, 100, 0.1) <= found["certified"] <= stats.binom.isf(1e-6, 100, 0.1)


def test_certificate_says_what_it_assumed_and_which_bursts_it_saw() -> None:
    """Bursts of twenty show in the counts of the plays, and the bound that is used covers more than five."""
    question = asked(far=1e-5, confidence=0.9, burst=5.0)
    quiet = certify(question, SimulatedPlays(question, COVERED["independent"], 1e-7, 0))
    assert ", for bursts of 5 alarms on average, assumed (" in quiet.reason
    assert quiet.rate[1] == pytest.approx(upper_count(quiet.alarms, 0.9, 5.0) / quiet.samples, rel=1e-3)
    bursty = certify(question, SimulatedPlays(question, BEYOND["bursts of twenty"], 1e-4, 0))
    assert "alarms on average, observed (" in bursty.reason
    assert bursty.rate[0] < 1e-4 < bursty.rate[1]


def test_certificate_by_betting_says_what_it_relies_on() -> None:
    """2441 armed samples a play, in which 41 alarms have room by a hold-off of 60."""
    with_hold_off = dict(describe("inproc").as_table())
    with_hold_off["estimator"] = {**with_hold_off["estimator"], "hold_off_n": 60}
    question = Question(
        rig_table("emulator"), with_hold_off, Scenario.load("healthy"), far=1e-3, confidence=0.95, samples=550 + 2441
    )
    quiet = certify(question, SimulatedPlays(question, COVERED["independent"], 1e-5, 0))
    assert quiet.outcome == "certified"
    assert quiet.rate[1] <= 1e-3
    assert quiet.reason.endswith(", for any dependence within a play, and at most 41 alarms in each")
    loud = certify(question, SimulatedPlays(question, BEYOND["bursts of twenty"], 1e-2, 0))
    assert loud.outcome == "refuted"
    assert loud.rate[0] > 1e-3


class Lying:
    """A device that alarms more often than its hold-off allows."""

    def play(self, _: Any, tasks: Iterator[Any]) -> Iterator[tuple[Any, Any]]:
        return ((task, [Count(50, 1000)]) for task in tasks)


def test_device_that_breaks_its_data_sheet_is_not_certified() -> None:
    table = dict(describe("inproc").as_table())
    table["estimator"] = {**table["estimator"], "hold_off_n": 60}
    question = Question(rig_table("emulator"), table, Scenario.load("healthy"), far=1e-3, confidence=0.95)
    answer = certify(question, Lying())
    assert answer.outcome == "inconclusive"
    assert answer.reason == "50 alarms in a play that can have 10, says the data sheet with hold_off_n = 60"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--allowed", "3"], "alarms are allowed by a test of fixed length: add --bounds bursts"),
        (["--bounds", "betting", "--burst", "5"], "--burst belongs to --bounds bursts, not to betting"),
        (["--bounds", "independent", "--burst", "5"], "--burst belongs to --bounds bursts, not to independent"),
        (["--samples", "550"], "samples must be more than the warm-up of 550, not 550"),
        (["--samples", "0"], "samples must be 1 to 10000000, not 0"),
        (["--burst", "0.5"], "burst must be 1 to 1000, not 0.5"),
    ],
)
def test_options_that_do_not_go_together_are_one_line(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["certify", "--dut", "inproc", "--far", "1e-3", *words]) == 2
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "burst", "assumed"),
    [
        ([], None, "any dependence within a play"),
        (["--bounds", "betting"], None, "any dependence within a play"),
        (["--bounds", "bursts"], 5.0, "bursts of 5 alarms on average, assumed"),
        (["--burst", "3"], 3.0, "bursts of 3 alarms on average, assumed"),
        (["--bounds", "independent"], 1.0, "independent alarms, assumed"),
        (["--burst", "1"], 1.0, "independent alarms, assumed"),
    ],
)
def test_bounds_are_chosen_by_name_and_state_their_assumption_in_the_same_sentence(
    words: list[str], burst: float | None, assumed: str, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--dut", "inproc", "--far", "0.02", "--confidence", "0.9", "--workers", "1"]
    assert main(["certify", *options, *words, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["burst"] == burst
    assert f", for {assumed}" in said["reason"]


class LastFirst:
    """Counts that depend on the seed alone, and come five at a time, the last one first."""

    def play(self, _: Any, tasks: Iterator[Any]) -> Iterator[tuple[Any, Any]]:
        while True:
            for task in reversed(list(itertools.islice(tasks, 5))):
                yield task, [Count(int(np.random.default_rng(task).binomial(100, 0.03)), 100)]


class InTurn:
    def play(self, _: Any, tasks: Iterator[Any]) -> Iterator[tuple[Any, Any]]:
        return ((task, [Count(int(np.random.default_rng(task).binomial(100, 0.03)), 100)]) for task in tasks)


def test_answer_does_not_depend_on_the_workers() -> None:
    question = asked(far=1e-2, confidence=0.9)
    assert certify(question, Processes(2)) == certify(question, ThisProcess())
    question = asked(far=0.01, confidence=0.99)
    assert certify(question, LastFirst()) == certify(question, InTurn())
    assert certify(question, InTurn()).samples % 500 != 0


def test_device_over_a_line_gives_the_same_counts() -> None:
    settings: dict[str, Any] = {"far": 5e-3, "confidence": 0.9, "allowed": 0, "burst": 5.0}
    assert certify(asked("host", **settings), ThisProcess()) == certify(asked(**settings), ThisProcess())


def test_run_that_is_not_valid_leaves_the_answer_open(tmp_path: Path) -> None:
    path = tmp_path / "resetting.toml"
    path.write_text('kind = "inproc"\nwire_faults = "reset@to:300"\n')
    answer = certify(asked(str(path), far=5e-3, confidence=0.9, allowed=0, burst=5.0), ThisProcess())
    assert answer.outcome == "inconclusive"
    assert "seed 0: " in answer.reason


def test_scenario_with_changes_cannot_be_certified() -> None:
    with pytest.raises(ConfigurationError, match="certify: the scenario changes the plant"):
        Question(
            rig_table("emulator"), describe("inproc").as_table(), Scenario.load("thesis"), far=1e-5, confidence=0.9
        )


@pytest.mark.parametrize("way", [[], ["--dut", "host"]])
def test_device_that_is_not_excited_is_not_certified_by_its_silence(
    way: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Edges of 0.1 mV, where a code is 4.9 mV, over less than the 1000 samples after which the device calls it idle."""
    still = tmp_path / "still.toml"
    still.write_text("samples = 2000\n[excitation]\nlow_v = 1.0\nhigh_v = 1.0001\n")
    options = "--dut inproc --far 0.03 --confidence 0.9 --allowed 0 --burst 5 --workers 1".split()
    assert main(["certify", *options, "--scenario", str(still), *way]) == 3
    assert "INCONCLUSIVE\n  seed 0: the trigger was armed in none of" in capsys.readouterr().out


def test_device_of_the_scenario_is_certified_if_it_may_be_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("ANALOGRIG_DUT", raising=False)
    scenario = tmp_path / "quiet.toml"
    command = ["certify", "--scenario", str(scenario), "--far", "1e-3", "--confidence", "0.9", "--workers", "1"]
    rest = "[excitation]\nlow_v = 3.0\nhigh_v = 7.0\n"
    scenario.write_text(f'samples = 500\ndut = "inproc"\nrig = "emulator-0-10v"\n{rest}')
    assert main([*command, "--allowed", "0", "--burst", "5"]) == 0
    assert capsys.readouterr().out.startswith("inproc on emulator-0-10v: ")
    scenario.write_text(f'samples = 500\ndut = "python:no_such_module:It"\n{rest}')
    assert main(command) == 2
    assert "the device imports python:no_such_module:It, which no file may order" in capsys.readouterr().err


def test_samples_that_are_missing_make_a_run_within_this_process_as_invalid_as_elsewhere() -> None:
    """Displacements beyond the card's range of 4 V: most samples are missing, and the scenario allows a quarter."""
    rig = dict(rig_table("emulator"))
    rig["card"] = {**rig["card"], "range_v": {**rig["card"]["range_v"], "displacement": [-1.0, 1.0]}}
    found = []
    for device in ("inproc", "host"):
        table = describe(device).as_table()
        question = Question(rig, table, Scenario.load("healthy"), far=5e-3, confidence=0.9, allowed=0, burst=5.0)
        found.append(certify(question, ThisProcess()))
    assert found[0] == found[1]
    assert found[0].outcome == "inconclusive"
    assert "samples were clipped and missing for the device, more than the 25%" in found[0].reason


@pytest.mark.parametrize(("dut", "far"), [("inproc", "1e-300"), ("inproc", "1e-13"), ("host", "4e-11")])
def test_length_that_nobody_would_live_to_see_is_refused(
    dut: str, far: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """At 99.9 %, with at most 50 alarms in bursts of 5, 140.87 / far samples."""
    assert main(["certify", "--dut", dut, "--far", far, "--bounds", "bursts"]) == 2
    assert f"far = {float(far):g} takes {140.87 / float(far):.2g} samples, and in a year" in capsys.readouterr().err


def test_command_tells_outcome_by_its_status(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--far", "1e-3", "--confidence", "0.99", "--json"]
    assert main(["certify", "--dut", "inproc", "--allowed", "0", "--burst", "5", *options]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["outcome"], said["far"], said["alarms"], said["burst"]) == ("certified", 1e-3, 0, 5.0)
    assert "assumed" in said["basis"]
    assert main(["certify", "--dut", noisy_device(tmp_path), "--far", "1e-3", *options]) == 1
    assert main(["certify", "--dut", "serial:/dev/absent", *options]) == 3
    assert main(["certify", "--dut", "inproc", "--far", "2"]) == 2


def test_device_without_a_trigger_cannot_be_certified(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    none = tmp_path / "none.toml"
    none.write_text('kind = "inproc"\n[estimator]\ntrigger = "none"\n')
    assert main(["certify", "--dut", str(none)]) == 2
    assert "no trigger" in capsys.readouterr().err


# --------------------------------------------------------------------------------------------------------- comparisons


def test_sign_flips_are_counted_exactly() -> None:
    """Five differences of one sign: 2 of the 32 ways are as extreme. By brute force for others."""
    assert sign_flip_p(np.array([1.0, 2.0, 3.0, 4.0, 5.0])) == 2 / 32
    values = np.array([0.5, -1.0, 2.5, 3.0, 0.25, 1.0])
    sums = [abs(np.dot(signs, values)) for signs in itertools.product((-1, 1), repeat=6)]
    assert sign_flip_p(values) == sum(each >= abs(values.sum()) for each in sums) / 64
    assert sign_flip_p(np.zeros(9)) == 1.0


def test_many_sign_flips_agree_with_the_normal_limit() -> None:
    values = np.random.default_rng(1).standard_normal(200) + 0.1
    z = values.sum() / np.sqrt((values**2).sum())
    assert sign_flip_p(values) == pytest.approx(2 * stats.norm.sf(abs(z)), rel=0.05)


def test_permutations_agree_with_scipy() -> None:
    rng = np.random.default_rng(2)
    x, y = rng.standard_normal(6), rng.standard_normal(7) + 1.0
    exact = stats.permutation_test((x, y), lambda a, b, axis: a.mean(axis) - b.mean(axis), n_resamples=np.inf)
    assert permutation_p(x, y) == pytest.approx(exact.pvalue, rel=0.1)


def observed(
    seed: int, latency_n: int | None, *, false_alarms: int = 0, cell: str = "a", theta: int = 0
) -> Observation:
    change = Change(latency_n, 3, latency_n is None, late=False)
    errors = (0.01, 0.02, 0.03)
    return (cell, seed), Trial(seed, "passed", "", 1000, 850, false_alarms, (change,), errors, theta)


def test_slower_build_is_worse_and_the_other_way_round_better() -> None:
    quick = [observed(seed, 4 + seed % 3) for seed in range(12)]
    slow = [observed(seed, 6 + seed % 3, theta=1) for seed in range(12)]
    found = compare(quick, slow)
    assert {each.quantity: each.word for each in found.differences if each.word != "no difference shown"} == {
        "latency": "worse"
    }
    assert found.worse
    assert found.identical == (0, 12)
    assert {each.word for each in compare(slow, quick).differences} == {"better", "no difference shown"}


def test_latency_is_compared_where_both_noticed_and_misses_by_themselves() -> None:
    a = [observed(seed, 5) for seed in range(28)]
    b = [observed(seed, None if seed % 2 else 5) for seed in range(28)]
    words = {each.quantity: (each.word, each.seeds) for each in compare(a, b).differences}
    assert words["latency"] == ("no difference shown", 14)
    assert words["missed"] == ("worse", 28)


def test_change_that_one_side_missed_counts_for_the_latency_of_neither() -> None:
    """Two changes a trial, the second of which B misses: 4 against 4 samples, and not 7 against 4."""
    a, b = (
        [(key, trial._replace(changes=(*trial.changes, second))) for key, trial in (observed(s, 4) for s in range(3))]
        for second in (Change(10, 3, missed=False, late=False), Change(None, 3, missed=True, late=False))
    )
    latency = compare(a, b).differences[0]
    assert (latency.a, latency.b, latency.p) == (4.0, 4.0, 1.0)


def test_probabilities_are_adjusted_as_holm_says() -> None:
    """The smallest times 4, the next times 3, ... and never less than the one before."""
    found = [Difference("x", "", 1.0, 2.0, 9, "", p, p, "worse") for p in (0.01, 0.04, 0.03, 0.005)]
    adjusted = [each.adjusted_p for each in adjust_by_holm(found, 0.025)]
    assert adjusted == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert [each.word for each in adjust_by_holm(found, 0.025)] == [*["no difference shown"] * 3, "worse"]


def test_cells_of_one_seed_are_one_observation() -> None:
    """Forty cells with the same three seeds prove no more than three seeds can: 2 of 8 ways."""
    a, b = ([observed(s, n, cell=str(c)) for c in range(40) for s in range(3)] for n in (4, 9))
    latency = compare(a, b).differences[0]
    assert (latency.seeds, latency.p, latency.word) == (3, 0.25, "no difference shown")


def test_build_that_loses_its_estimates_is_worse() -> None:
    good = [observed(seed, 5) for seed in range(20)]
    bad = [(key, trial._replace(errors=())) for key, trial in good]
    words = {each.quantity: each.word for each in compare(good, bad, estimates="MBK").differences}
    assert {words[f"error of {name}"] for name in "MBK"} == {"worse"}


def test_fewest_seeds_are_those_with_which_something_could_be_called_worse() -> None:
    """Every seed worse in latency, in nothing else: 2 of 2^k ways, times the number of quantities."""
    for seeds, worse in ((10, False), (11, True)):
        found = compare(
            [observed(seed, 4) for seed in range(seeds)], [observed(seed, 9) for seed in range(seeds)], estimates="MBK"
        )
        assert len(found.differences) == 6
        assert (found.least_seeds, found.worse) == (11, worse)


def test_one_in_many_quantities_is_not_called_different_by_chance() -> None:
    """Two equal sides, 200 times: a wrong word at most as often as alpha says, with all six quantities asked at once.

    Binomial(200, 0.1): false failure below 1e-6.
    """
    rng, wrong = np.random.default_rng(3), 0
    for _ in range(200):
        a, b = (
            [observed(s, int(rng.geometric(0.2)), false_alarms=int(rng.integers(3))) for s in range(10)] for _ in "ab"
        )
        wrong += any(each.word != "no difference shown" for each in compare(a, b, alpha=0.1).differences)
    assert wrong <= stats.binom.isf(1e-6, 200, 0.1)


def test_sides_without_a_seed_in_common_are_compared_as_groups() -> None:
    found = compare([observed(s, 4 + s % 3) for s in range(12)], [observed(100 + s, 8 + s % 3) for s in range(9)])
    assert found.worse
    assert found.differences[0].test == "permutation of seeds"
    assert found.identical == (0, 0)


# ----------------------------------------------------------------------------------------- comparisons of recordings


def record(folder: Path, *seeds: int, dut: str = "inproc", rig: str = "emulator", **changed: Any) -> None:
    """Record a run of each seed below a folder, by default of 700 samples of ``healthy`` with these changes."""
    scenario = dataclasses.replace(Scenario.load("healthy"), **{"samples": 700, **changed})
    with open_rig(rig) as opened, open_dut(dut, exchange="block") as device:
        for seed in seeds:
            Bench(opened, device).play(scenario, seed).save(folder / str(seed) / "run.npz")


def softened(factor: float) -> tuple[PotChange, ...]:
    return (PotChange(400, {"K": 24500.0 * factor}),)


def recorded(path: Path) -> Sequence[Observation]:
    """Trials of a folder of recordings."""
    side = load(path)
    assert isinstance(side, Recorded)
    return side.trials


def refused(tmp_path: Path, capsys: pytest.CaptureFixture[str], a: str = "a", b: str = "b", status: int = 2) -> str:
    """Complaint of a comparison of two folders that ends with this status."""
    assert main(["compare", str(tmp_path / a), str(tmp_path / b)]) == status
    return capsys.readouterr().err


def test_recordings_of_one_name_that_played_something_else_are_not_paired(tmp_path: Path) -> None:
    for factor in (0.7, 0.9):
        record(tmp_path / str(factor), 0, name="drawn", changes=softened(factor))
    assert len(dict(recorded(tmp_path))) == 2
    found = compare(recorded(tmp_path / "0.7"), recorded(tmp_path / "0.9"))
    assert found.identical == (0, 0)


def test_folders_of_recordings_are_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record(tmp_path / "a", 0, 1, changes=softened(0.8))
    played = [key for key, _ in recorded(tmp_path / "a")]
    assert [key[2] for key in played] == [0, 1]
    assert played[0][:2] == played[1][:2]
    assert main(["compare", str(tmp_path / "a"), str(tmp_path / "a" / "0" / "run.npz"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["identical"] == [1, 1]
    (tmp_path / "empty").mkdir()
    with pytest.raises(RecordingError, match="empty: holds no valid trial"):
        load(tmp_path / "empty")
    refused(tmp_path, capsys, b="absent.json")


def test_too_few_seeds_to_show_anything_are_inconclusive(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, dut in (("a", "inproc"), ("b", "mean-between-faults")):
        record(tmp_path / name, 0, dut=dut, changes=softened(0.8))
    said = refused(tmp_path, capsys, status=3)
    assert "INCONCLUSIVE: too few seeds (1) to show anything at alpha 0.01: at least" in said


def test_rigs_of_one_name_are_told_apart(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shipped = Path("fixtures/rigs/emulator.toml").read_text()
    for folder, noise_lsb in (("a", 0.2), ("b", 6.0)):
        (tmp_path / folder).mkdir()
        rig_file = tmp_path / folder / "bench.toml"
        rig_file.write_text(shipped.replace("noise_lsb = 1.0", f"noise_lsb = {noise_lsb}"))
        record(tmp_path / folder, 0, rig=str(rig_file))
    said = refused(tmp_path, capsys)
    assert "played nothing in common: rig.card.noise_lsb is 0.2 in A and 6.0 in B" in said


def test_two_recordings_of_one_play_on_one_side_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record(tmp_path / "a" / "one", 0)
    shutil.copytree(tmp_path / "a" / "one", tmp_path / "a" / "two")
    named = " and ".join(str(tmp_path / "a" / name / "0" / "run.npz") for name in ("one", "two"))
    assert f"{named} are of one scenario, rig and seed" in refused(tmp_path, capsys, b="a/one")


def test_recordings_that_have_no_play_in_common_are_not_compared(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record(tmp_path / "a", 0)
    record(tmp_path / "b", 0, samples=710)
    said = refused(tmp_path, capsys)
    assert "A and B played nothing in common: scenario.samples is 700 in A and 710 in B" in said


def test_trials_that_were_inconclusive_on_one_side_alone_are_no_pass(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record(tmp_path / "a", 0, 1, 2)
    for seed in range(3):
        run = Run.load(tmp_path / "a" / str(seed) / "run.npz")
        faults = ("the device was reset",) if seed else ()
        broken = dataclasses.replace(run, conditions=dataclasses.replace(run.conditions, faults=faults))
        broken.save(tmp_path / "b" / str(seed) / "run.npz")
    assert main(["compare", str(tmp_path / "a"), str(tmp_path / "b")]) == 3
    said = capsys.readouterr()
    assert "inconclusive: 0 of A, 2 of B" in said.out
    assert "2 trials of B were inconclusive, 0 of A" in said.err
    assert main(["compare", str(tmp_path / "a"), str(tmp_path / "a")]) == 0


# ------------------------------------------------------------------------------------------- comparisons of campaigns

CAMPAIGN = """
name = "mine"
trials = 12
samples = 700
change_at = 500
devices = [DEVICES]
[grid]
stiffness_factor = [0.8, 0.9]
"""


@pytest.fixture(scope="module")
def own_devices(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Two within this process that differ in their settings."""
    paths = [tmp_path_factory.mktemp("devices") / f"{name}.toml" for name in ("keen", "calm")]
    for path, arl0 in zip(paths, (1e3, 1e6), strict=True):
        path.write_text(f'kind = "inproc"\n[estimator]\narl0 = {arl0}\n')
    return list(map(str, paths))


def campaign(folder: Path, name: str, devices: Sequence[str], *changes: tuple[str, str]) -> str:
    """Plays CAMPAIGN with these changes of its words; the file of its results."""
    spec = CAMPAIGN.replace("DEVICES", ", ".join(map(repr, devices)))
    for old, new in changes:
        assert spec.count(old) == 1
        spec = spec.replace(old, new)
    (folder / f"{name}.toml").write_text(spec)
    out = str(folder / f"{name}.sqlite")
    assert main(["campaign", str(folder / f"{name}.toml"), "--out", out, "--workers", "1"]) in (0, 1)
    return out


@pytest.fixture(scope="module")
def keen(tmp_path_factory: pytest.TempPathFactory, own_devices: list[str]) -> str:
    """Results of CAMPAIGN with the first device."""
    return campaign(tmp_path_factory.mktemp("keen"), "a", own_devices[:1])


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (("[0.8, 0.9]", "[0.7, 0.9]"), "grid.stiffness_factor[0] is 0.8 in A and 0.7 in B"),
        (("trials = 12", "trials = 13"), "trials is 12 in A and 13 in B"),
        (("trials = 12", "trials = 12\nfirst_seed = 9"), "first_seed is 0 in A and 9 in B"),
        (("samples = 700", "samples = 701"), "scenario.samples is 700 in A and 701 in B"),
        (
            ("trials = 12", "trials = 12\nrigs = ['emulator-skewed']"),
            "rigs[0].card.model is 'ideal' in A and 'skewed' in B",
        ),
        (("stiffness_factor", "noise_lsb = [1.5]\nstiffness_factor"), "grid.noise_lsb is absent in A and [1.5] in B"),
    ],
)
def test_campaigns_that_played_something_else_are_not_compared(
    change: tuple[str, str],
    named: str,
    tmp_path: Path,
    keen: str,
    own_devices: list[str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    said = refused(tmp_path, capsys, keen, campaign(tmp_path, "b", own_devices[:1], change))
    assert "A and B are different campaigns: " in said
    assert named in said
    assert said.count("\n") == 1


def test_campaigns_that_differ_in_device_name_and_chunk_are_compared(
    tmp_path: Path, keen: str, own_devices: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    b = campaign(tmp_path, "b", own_devices[1:], ("mine", "other"), ("trials = 12", "trials = 12\nchunk = 1"))
    capsys.readouterr()
    assert main(["compare", keen, b, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["trials"] == [24, 24]
    assert said["identical"][1] == 24


def test_devices_of_two_campaigns_are_matched_by_their_names(tmp_path: Path, own_devices: list[str]) -> None:
    a, b = (Path(campaign(tmp_path, name, own_devices[::step])) for name, step in (("a", 1), ("b", -1)))
    found = compare_sides(load(a), load(b))
    assert found.identical == (48, 48)
    assert not any(each.shown for each in found.differences)
