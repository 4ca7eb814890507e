"""Comparison of two rigs: known differences are found, bounds have their coverage, and noise is no difference."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from analogrig.bench import Bench
from analogrig.cli import main
from analogrig.devices.registry import open_dut
from analogrig.judging.statistics import mean_interval
from analogrig.rigs.emulator import CardDescription, EmulatorDescription, EmulatorRig
from analogrig.run import Run
from analogrig.scenario import Scenario
from analogrig_emulator import CHANNELS
from analogrig_instruments.rig_comparison import RigComparison, compare_rigs, signal_difference
from tests.harness.commands import error_of, output_of
from tests.harness.runs import made_run

from .plants import front

WIDE = {"force": (-1.0, 11.0), "displacement": (-1.0, 9.0), "velocity": (-10.0, 10.0), "net_force": (-12.5, 12.5)}
DISPLACEMENT = CHANNELS.index("displacement")
FRONT = front(115.0, 3021.0, 24500.0)


def rig(noise_lsb: float = 1.0, **faults: object) -> EmulatorRig:
    return EmulatorRig(EmulatorDescription(CardDescription(WIDE, noise_lsb=noise_lsb, faults=faults), name="drawn"))


def compare(a: EmulatorRig, b: EmulatorRig, plays: int = 4, *, noise_estimated: bool = True) -> RigComparison:
    with open_dut("inproc") as dut:
        dut.configure(noise_estimated=noise_estimated)
        found = compare_rigs(Bench(a, dut), Bench(b, dut), Scenario.load("thesis"), range(plays))
    assert isinstance(found, RigComparison)
    return found


# --------------------------------------------------------------------------------------------------------- the signals

PLAYS, SAMPLES, SETS = 6, 1000, 100
CONFIDENCE = 0.9


def run_of(displacement: np.ndarray, rng: np.random.Generator) -> Run:
    """Run of a displacement in codes, with 1 LSB of noise; the force jumps every 100 samples."""
    force_n = np.where(np.arange(len(displacement)) // 100 % 2, 2500.0, 300.0)
    run = made_run(force_n, [(0, FRONT)])
    codes = run.codes.copy()
    codes[:, DISPLACEMENT] = np.rint(displacement + rng.standard_normal(len(displacement)))
    return dataclasses.replace(run, codes=codes)


def test_bound_of_the_difference_has_its_coverage() -> None:
    """Wave of 0.5 LSB rms under 1.4 LSB of noise. Fewer than 80 of 100 bounds of 90 % hold with a probability of 1e-3.

    The mean estimate is within 4 of its standard errors.
    """
    rng = np.random.default_rng(3)
    k = np.arange(SAMPLES)
    signal = 2000.0 + 800.0 * np.sin(k / 30.0)
    wave = 0.5 * np.sqrt(2.0) * np.sin(k / 17.0)
    found = [
        signal_difference(
            [(run_of(signal, rng), run_of(signal + wave, rng)) for _ in range(PLAYS)], "displacement", CONFIDENCE
        )
        for _ in range(SETS)
    ]
    held = sum(each.rms_most_lsb >= 0.5 for each in found)
    assert held >= stats.binom.ppf(1e-3, SETS, CONFIDENCE)
    squares = np.array([each.rms_lsb**2 for each in found])
    assert abs(squares.mean() - 0.25) < 4.0 * squares.std() / np.sqrt(SETS) + 0.02
    assert np.mean([each.noise_lsb for each in found]) == pytest.approx(np.sqrt(2.0 + 2.0 / 12.0), rel=0.02)


def test_offset_is_a_difference_and_noise_is_not() -> None:
    found = compare(rig(noise_lsb=0.5), rig(noise_lsb=2.0, offset_lsb=[0.0, 3.0, 0.0, 0.0]))
    force, displacement = found.signals
    assert displacement.rms_lsb == pytest.approx(3.0, abs=0.15)
    assert displacement.rms_most_lsb >= displacement.rms_lsb
    assert displacement.mean_lsb == pytest.approx(3.0, abs=0.1)
    assert displacement.mean_least_lsb < displacement.mean_lsb < displacement.mean_most_lsb
    assert displacement.mean_most_lsb - displacement.mean_least_lsb < 0.5
    assert displacement.noise_lsb == pytest.approx(np.hypot(1.5, np.sqrt(2.0 / 12.0)), rel=0.1)
    assert force.rms_lsb < 0.5


def test_skew_shows_where_the_displacement_moves() -> None:
    """A skew of 10 us causes up to 46 LSB on a front suspension (by ngspice)."""
    found = compare(rig(), rig(skew_s=[0.0, 10e-6, 0.0, 0.0]))
    force, displacement = found.signals
    assert force.rms_lsb == 0.0
    assert 5.0 < displacement.rms_lsb < 25.0
    assert 30.0 < abs(displacement.largest_lsb) < 60.0
    assert displacement.largest_noise_lsb < 5.0


def test_edges_that_lie_apart_are_counted_and_left_out() -> None:
    rng = np.random.default_rng(4)
    run = run_of(np.full(SAMPLES, 2000.0), rng)
    later = dataclasses.replace(run, codes=np.concatenate((run.codes[:1], run.codes[:-1])))
    force = signal_difference([(run, later), (run, later)], "force", 0.95)
    assert force.rms_lsb == 0.0
    assert force.edges_apart == 2 * 9


def test_mean_interval_is_that_of_student() -> None:
    values = np.random.default_rng(1).normal(3.0, 2.0, 7)
    mean, low, high = mean_interval(values, 0.9)
    assert mean == pytest.approx(values.mean())
    assert (low, high) == pytest.approx(stats.t.interval(0.9, 6, values.mean(), stats.sem(values)))
    with pytest.raises(ValueError, match="at least two values"):
        mean_interval([1.0], 0.9)


# -------------------------------------------------------------------------------------------------------- the verdicts


def test_rig_equals_itself() -> None:
    found = compare(rig(), rig())
    assert [each.rms_most_lsb for each in found.signals] == [0.0, 0.0]
    assert found.latency is not None
    assert (found.latency.mean_n, found.latency.unequal) == (0.0, 0)
    # None of about 13 latencies differs; by Clopper and Pearson up to 21 % may, by a sample each.
    assert found.latency.within_n == pytest.approx(1.0 - 0.05 ** (1.0 / found.latency.changes))
    assert found.verdicts.identical == (4, 4)
    assert "no difference is shown" in found.sentence


def test_noise_beyond_the_setting_of_the_device_changes_the_verdicts() -> None:
    found = compare(rig(noise_lsb=0.3), rig(noise_lsb=8.0), plays=12, noise_estimated=False)
    assert found.latency is not None
    assert found.latency.least_n > 0.0
    assert found.latency.quantiles_n[1][1] > found.latency.quantiles_n[0][1]
    quiet, noisy = found.false_alarms
    assert quiet.most < noisy.least
    assert "false alarms is worse" in found.sentence


def test_command_prints_the_sentence_and_fails_beyond_the_limits() -> None:
    command = ["compare-rigs", "emulator", "emulator-skewed", "--dut", "inproc", "--plays", "3"]
    first = output_of(*command).splitlines()[0]
    assert first.startswith("emulator-skewed follows emulator within 15 LSB")
    assert "in 3 plays of thesis" in first
    assert json.loads(output_of(*command, "--most-lsb", "10", "--json", status=1))["sentence"] == first
    assert main([*command, "--most-lsb", "20", "--most-samples", "0.001"]) == 1


def test_invalid_plays_are_not_compared(tmp_path: Path) -> None:
    """Clipped samples beyond the scenario's limit make every run of one rig inconclusive."""
    table = "[card]\n[card.range_v]\nforce = [-1.0, 5.0]\ndisplacement = [-1.0, 9.0]\nvelocity = [-10.0, 10.0]\n"
    clipping = tmp_path / "clipping.toml"
    clipping.write_text(f"{table}net_force = [-12.5, 12.5]\n")
    error = error_of("compare-rigs", "emulator", str(clipping), "--dut", "inproc", "--plays", "2", status=3)
    assert error.startswith("analogrig: INCONCLUSIVE: nothing can be compared: clipping, seed 0: ")


@pytest.mark.parametrize(("option", "value"), [("--plays", "1"), ("--confidence", "0.4"), ("--confidence", "1")])
def test_invalid_options_are_usage_errors(option: str, value: str) -> None:
    assert option in error_of("compare-rigs", "emulator", "emulator", option, value)
