"""Rates of rare alarms: against alarms that were waited for, against themselves, and as a certificate."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from analogrig.bench import direct_bench
from analogrig.campaigns import rare
from analogrig.campaigns.certificate import Question, certify, estimate_once
from analogrig.campaigns.plan import rig_table
from analogrig.campaigns.rare import FOLLOWED_N, PLAY_N, false_alarm_rate
from analogrig.campaigns.workers import Processes, ThisProcess
from analogrig.cli import main
from analogrig.devices.catalogue_description import CatalogueDescription, has_snapshots
from analogrig.devices.estimator import Estimator
from analogrig.devices.registry import describe
from analogrig.errors import ConfigurationError
from analogrig.judging.statistics import mean_bounds
from analogrig.rigs.description import open_rig
from analogrig.rigs.emulator import EmulatorRig
from analogrig.scenario import Scenario

SURELY = 5.3
"""Standard errors; a normal variable is farther off once in ten million times."""

HEALTHY = Scenario.load("healthy")


def emulator() -> EmulatorRig:
    rig = open_rig("emulator")
    assert isinstance(rig, EmulatorRig)
    return rig


def device(arl0: float) -> CatalogueDescription:
    described = describe("inproc")
    assert has_snapshots(described)
    return dataclasses.replace(described, estimator=dataclasses.replace(described.estimator, arl0=arl0))


def mean_rate(arl0: float, plays: int, branches: int) -> tuple[float, float]:
    """Mean rate of plays from seed 0 on, with its standard error."""
    rates = [false_alarm_rate(emulator(), device(arl0), HEALTHY, seed, branches).rate for seed in range(plays)]
    return float(np.mean(rates)), float(np.std(rates, ddof=1)) / math.sqrt(plays)


def waited_for(device: CatalogueDescription, plays: int) -> tuple[float, float, NDArray[np.int64]]:
    """First alarms per sample of plays up to the first, with the standard error of a count; later alarms of each."""
    first = device.estimator.warm_up_n + 16
    bench = direct_bench(emulator(), device, alarms_only=True)
    played = dataclasses.replace(HEALTHY, samples=first + PLAY_N + FOLLOWED_N)
    alarms = [bench.play(played, seed).alarm_index - first for seed in range(1000, 1000 + plays)]
    firsts = [min(each[each >= 0].tolist(), default=PLAY_N) for each in alarms]
    events, samples = sum(each < PLAY_N for each in firsts), sum(min(each + 1, PLAY_N) for each in firsts)
    later = [
        np.count_nonzero((each > start) & (each <= start + FOLLOWED_N))
        for each, start in zip(alarms, firsts, strict=True)
        if start < PLAY_N
    ]
    return events / samples, math.sqrt(events) / samples, np.array(later)


def test_rate_is_that_of_alarms_that_were_waited_for() -> None:
    """A device with one false alarm in about 60,000 samples, none of which come in bursts."""
    (rate, error), (waited, off, _) = mean_rate(6000.0, plays=16, branches=500), waited_for(device(6000.0), plays=250)
    assert abs(rate - waited) < SURELY * math.hypot(error, off)
    assert math.hypot(error, off) < 0.2 * waited


def test_alarms_after_an_alarm_are_as_many_as_those_that_were_waited_for() -> None:
    """A device too sure of the zeros with which it begins after an alarm: some 0.7 alarms in the next 1024 samples."""
    keen = device(4000.0)
    keen = dataclasses.replace(keen, estimator=dataclasses.replace(keen.estimator, reset="all", p0=0.1))
    found = [false_alarm_rate(emulator(), keen, HEALTHY, seed, 300) for seed in range(16)]
    every, first = np.array([each.rate for each in found]), np.array([each.bursts for each in found])
    _, _, waited = waited_for(keen, plays=100)
    ratio, expected = every.sum() / first.sum() - 1.0, waited.mean()
    error = np.std(every - (1.0 + ratio) * first) / first.mean() / math.sqrt(len(first))
    assert abs(ratio - expected) < SURELY * math.hypot(error, waited.std() / math.sqrt(len(waited)))
    assert 0.3 < expected < 1.2


def test_rate_does_not_depend_on_how_loud_the_branches_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """One false alarm in 730,000 samples: the weights make up for every loudness."""
    rate, error = mean_rate(1e5, plays=16, branches=1000)
    monkeypatch.setattr(rare, "LOUDER", np.array([1.8, 2.3]))
    other, off = mean_rate(1e5, plays=16, branches=1000)
    assert abs(rate - other) < SURELY * math.hypot(error, off)
    assert math.hypot(error, off) < 0.2 * rate
    assert 1e-8 < rate < 1e-5


def test_rate_counts_only_the_samples_on_the_ground(monkeypatch: pytest.MonkeyPatch) -> None:
    """The exposure factor: with the same climbs in twice as many samples, alarms are half as frequent."""
    rate, ground = false_alarm_rate(emulator(), device(100.0), HEALTHY, 0, 100).rate, rare._Climbs._ground

    def sparser(self: Any, first: int) -> tuple[NDArray[np.intp], int]:
        found, length = ground(self, first)
        return found, 2 * length

    monkeypatch.setattr(rare._Climbs, "_ground", sparser)
    assert rate > 0.0
    assert false_alarm_rate(emulator(), device(100.0), HEALTHY, 0, 100).rate == pytest.approx(rate / 2.0)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer branches, within this process."""
    monkeypatch.setattr(
        "analogrig.campaigns.certificate.false_alarm_rate", functools.partial(false_alarm_rate, branches=200)
    )


@pytest.mark.usefixtures("quick")
def test_rig_on_which_no_branch_comes_to_an_alarm_leaves_the_answer_open() -> None:
    """Without noise there is nothing to be louder; that is no proof of silence."""
    device, ideal = describe("inproc").as_table(), rig_table("emulator-ideal")
    answer = certify(Question(ideal, device, HEALTHY, far=1e-5, confidence=0.99, rare=64), ThisProcess())
    assert (answer.outcome, answer.alarms, answer.rate) == ("inconclusive", 0, (0.0, 1.0))


def test_branch_goes_on_as_the_estimator_would_have() -> None:
    rng = np.random.default_rng(3)
    u = np.where(np.arange(1200) // 50 % 2, 3600.0, 400.0)
    y = 0.5 * u + rng.normal(0.0, 40.0, 1200)
    estimator = Estimator()
    whole = estimator.run(u, y)
    estimator.restart()
    estimator.run(u[:1000], y[:1000])
    saved, valid = np.stack([estimator.save()] * 2), np.ones((2, 100), np.bool_)
    other = np.stack([y[1000:1100], y[900:1000]])
    statistic, alarm, after = estimator.branch(saved, np.stack([u[1000:1100]] * 2), other, valid)
    assert whole.statistic[1000:].any()
    assert statistic[0].tobytes() == whole.statistic[1000:1100].tobytes()
    assert np.flatnonzero(alarm[0]).tolist() == [at - 1000 for at in whole.alarms if 1000 <= at < 1100]
    assert statistic[1].tobytes() != statistic[0].tobytes()
    again, _, _ = estimator.branch(after[:1], u[None, 1100:], y[None, 1100:], valid[:1])
    assert again[0].tobytes() == whole.statistic[1100:].tobytes()


# ------------------------------------------------------------------------------------------------ bounds of their mean


def test_bounds_of_a_mean_are_those_of_the_table() -> None:
    """Student's t for 9 degrees of freedom at 97.5 %: 2.262 (any table)."""
    low, high = mean_bounds([1.0, 3.0] * 5, 0.975)
    spread = math.sqrt(10.0 / 9.0) / math.sqrt(10.0)
    assert ((high - 2.0) / spread, (2.0 - low) / spread) == pytest.approx((2.262, 2.262), abs=5e-4)
    assert mean_bounds([0.0] * 9 + [1.0], 0.999)[0] == 0.0
    assert mean_bounds([2.0] * 9, 0.999) == (2.0, 2.0)
    with pytest.raises(ValueError, match="at least 8 estimates, not 2"):
        mean_bounds([1.0, 2.0], 0.9)


def test_bounds_of_the_mean_of_skewed_estimates_are_wrong_about_as_often_as_they_say() -> None:
    """Exponential ones, of which the skewness is 2: 1 % is promised above and below; Student's t alone is wrong above
    in more than 3 %. 4000 means of 64; 4.7 standard errors are allowed."""
    samples = np.random.default_rng(5).exponential(size=(4000, 64)).tolist()
    bounds = [mean_bounds(each, 0.99) for each in samples]
    below, above = sum(high < 1.0 for _, high in bounds), sum(low > 1.0 for low, _ in bounds)
    most = 4000 * 0.01 + 4.7 * math.sqrt(4000 * 0.01)
    assert 0 < below < 1.5 * most
    assert 0 < above < most


# -------------------------------------------------------------------------------------------------- as a certificate


def asked(dut: str = "inproc", **settings: Any) -> Any:
    return Question(rig_table("emulator"), describe(dut).as_table(), HEALTHY, **settings)


class Remembering(ThisProcess):
    """Plays each seed once, whatever is asked of the rate."""

    def __init__(self) -> None:
        self._known: dict[Any, Any] = {}

    def play(self, work: Callable[[Any], Any], tasks: Iterator[Any]) -> Iterator[tuple[Any, Any]]:
        for task in tasks:
            if task not in self._known:
                self._known[task] = work(task)
            yield task, self._known[task]


@pytest.mark.usefixtures("quick")
def test_rare_rate_certifies_refutes_or_stays_open() -> None:
    settings: dict[str, Any] = {"confidence": 0.99, "rare": 64}
    worker = Remembering()
    certified = certify(asked(far=1e-5, **settings), worker)
    assert certified.outcome == "certified"
    assert certified.basis.startswith("a mean burst size of 1, measured")
    assert 1e-8 < certified.rate[0] < certified.rate[1] < 3e-6
    assert certify(asked(far=sum(certified.rate) / 2.0, **settings), worker).outcome == "inconclusive"
    assert certify(asked(far=1e-9, **settings), worker).outcome == "refuted"


def test_estimates_do_not_depend_on_the_workers() -> None:
    work = functools.partial(estimate_once, asked(far=1e-5, confidence=0.99, rare=64))
    assert dict(Processes(2).play(work, iter(range(4)))) == dict(ThisProcess().play(work, iter(range(4))))


@pytest.mark.usefixtures("quick")
def test_device_whose_rare_rate_is_above_the_limit_is_refuted(capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--far", "1e-9", "--confidence", "0.99", "--rare", "64", "--workers", "1"]
    assert main(["certify", "--dut", "inproc", *options]) == 1
    assert "(a rare rate): REFUTED" in capsys.readouterr().out


def test_device_that_is_not_excited_has_no_rare_rate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    still = tmp_path / "still.toml"
    still.write_text("samples = 2000\n[excitation]\nlow_v = 1.0\nhigh_v = 1.0001\n")
    options = ["--far", "1e-5", "--rare", "--workers", "1", "--scenario", str(still)]
    assert main(["certify", "--dut", "inproc", *options]) == 3
    assert "INCONCLUSIVE: the trigger was armed in none of" in capsys.readouterr().err


def test_what_cannot_be_is_refused(tmp_path: Path) -> None:
    other = tmp_path / "other.toml"
    other.write_text('kind = "inproc"\n[estimator]\ntrigger = "prediction-error"\nceiling = 50.0\n')
    with pytest.raises(ConfigurationError, match="for the trigger cusum, not prediction-error of other"):
        certify(asked(str(other), far=1e-8, confidence=0.99, rare=64), ThisProcess())
    with pytest.raises(ConfigurationError, match="certify: a rare rate is estimated within this process"):
        certify(asked("host", far=1e-8, confidence=0.99, rare=64), ThisProcess())
    for few in (0, 3, 63):
        with pytest.raises(ConfigurationError, match=f"certify: rare must be 64 to 10000 estimates, not {few}"):
            asked(far=1e-8, confidence=0.99, rare=few)
    with pytest.raises(ConfigurationError, match="certify: a rare rate is estimated, or alarms are waited for"):
        asked(far=1e-8, confidence=0.99, rare=64, sequential=True)
