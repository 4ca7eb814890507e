"""Machinery of the table of conditions: every row plays, and the counts of alarms and delays are right."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from scipy import signal, stats
from scipy.linalg import toeplitz

from analogrig.campaigns.together import direct_bench
from analogrig.catalogue import SteppedFlag
from analogrig.devices.library import InprocDevice
from analogrig.estimator_config import EstimatorConfig
from analogrig.judging.information import QUANTISATION_VARIANCE_LSB2, change_information
from analogrig.rigs.description import open_rig
from analogrig.rigs.emulator import EmulatorRig
from analogrig.run import Run
from analogrig.scenario import PotChange, Scenario
from tests.bench import __main__ as benchmarks
from tests.bench import bench_reality, bench_statistics, silverbox
from tests.bench.bench_reality import Effort, Healthy, delays_of
from tests.bench.conditions import CONDITIONS
from tests.bench.false_alarms import CLUSTER_N, FalseAlarms, count_false_alarms
from tests.bench.played import Change, accumulate
from tests.bench.shipped import Misfit, answers_to, exposure_n, shipped
from tests.estimator_c.performance import FULL
from tests.estimator_c.plants import FRONT, PERIOD_S, plants_of_any_speed

pytestmark = pytest.mark.heavy

SAMPLES, CHANGE = 500, Change("K", 1.2, 420)


@pytest.mark.parametrize("name", CONDITIONS)
def test_a_row_plays_a_healthy_and_a_changed_run(name: str) -> None:
    """The change is visible, and not before its sample."""
    condition = CONDITIONS[name]
    (healthy,) = condition.play([5], SAMPLES, [None])
    (changed,) = condition.play([5], SAMPLES, [CHANGE])
    assert healthy.u.shape == healthy.y.shape == healthy.valid.shape == (SAMPLES,)
    assert 0.5 < healthy.valid.mean() <= 1.0
    assert not healthy.information.any()
    assert not changed.information[: CHANGE.sample + 1].any()
    assert changed.information[-1] > 0.0
    assert (np.diff(changed.information) >= 0.0).all()


def test_the_nominal_row_is_the_shipped_rig() -> None:
    """Same codes and alarms; the harness's bounds follow the measured force instead of the noise-free displacement."""
    (played,) = CONDITIONS["nominal"].play([5], SAMPLES, [CHANGE])
    run = _shipped_rig_run(PotChange(CHANGE.sample, {"K": CHANGE.factor * 24500.0}))
    assert np.array_equal(run.codes[:, :2], np.stack([played.u, played.y], axis=1))
    assert [alarm.index for alarm in answers_to(shipped(), played).alarms] == run.alarm_index.tolist()
    (gathered,) = change_information(run)
    visible = gathered > 1.0
    assert played.information[CHANGE.sample + 1 :][visible] == pytest.approx(gathered[visible], rel=0.1)


def _shipped_rig_run(change: PotChange) -> Run:
    rig = open_rig("emulator")
    assert isinstance(rig, EmulatorRig)
    scenario = dataclasses.replace(Scenario.load("healthy"), samples=SAMPLES, changes=(change,))
    return direct_bench(rig, InprocDevice(name="shipped"), alarms_only=True).play(scenario, 5)


def test_a_disturbance_has_the_stated_size() -> None:
    """Against the undisturbed run of the same seed: hum of 10 LSB, drift of 0.1 code a sample, backlash of 3 LSB."""
    plain, hum, drift, backlash = (
        next(CONDITIONS[name].play([5], SAMPLES, [None])).y for name in ("nominal", "hum-10", "drift-.1", "backlash")
    )
    assert np.abs(hum - plain).max() == pytest.approx(10.0, abs=1.0)
    assert drift - plain - (drift - plain)[0] == pytest.approx(0.1 * np.arange(SAMPLES), abs=1.0)
    assert np.abs(backlash - plain).max() <= 3.0 and (backlash != plain).any()


def test_the_simulated_plant_without_a_cubic_part_is_the_emulated_one() -> None:
    """To the effects of the amplifiers, in codes of 18 bits that are 64 times finer."""
    simulated, emulated = (next(CONDITIONS[name].play([5], SAMPLES, [None])) for name in ("bits-18", "nominal"))
    assert np.abs(simulated.u / 64.0 - emulated.u).max() < 5.0
    assert np.abs(simulated.y / 64.0 - emulated.y).max() < 8.0


def test_information_in_coloured_noise_is_the_generalised_least_squares_one() -> None:
    seen = np.random.default_rng(0).standard_normal(30)
    covariance = 1.7 * toeplitz(0.9 ** np.arange(30)) + QUANTISATION_VARIANCE_LSB2 * np.eye(30)
    assert accumulate(seen, 1.7, 0.9)[-1] == pytest.approx(0.5 * seen @ np.linalg.solve(covariance, seen))


# ----------------------------------------------------------------------------------------------------------- statistics


def test_alarms_close_together_are_one_cluster() -> None:
    found = count_false_alarms([[200, 300, 301 + CLUSTER_N + 300], [], [7]], [1000, 1000, 500])
    assert (found.by_run, found.clusters, found.exposure_n) == ((3, 0, 1), (2, 1, 1), 2500)


def test_the_bound_of_independent_alarms_is_that_of_a_poisson_count() -> None:
    none, some = (count_false_alarms([alarms] * 4, [10_000] * 4) for alarms in ([], [2_000, 7_000]))
    assert none.upper_rate() == pytest.approx(-math.log(0.01) / 40_000)
    assert some.upper_rate() == pytest.approx(stats.chi2.ppf(0.99, 2 * 9) / 2.0 / 40_000)


def test_the_bound_of_alarms_in_bursts_holds() -> None:
    """At 90 %, of 500 devices with 30 bursts of 5 on average; a bound of that confidence fails with p = 0.001."""
    rng, runs, run_n, bursts = np.random.default_rng(0), 10, 100_000, 30.0
    covered = 0
    for _ in range(500):
        counts = rng.poisson(bursts / runs, runs)
        starts = [np.sort(rng.choice(run_n // 1000, count, replace=False)) * 1000 for count in counts]
        alarms = [[start + k for start in each.tolist() for k in range(5)] for each in starts]
        covered += count_false_alarms(alarms, [run_n] * runs).upper_rate(0.9) >= 5.0 * bursts / (runs * run_n)
    assert covered >= stats.binom.ppf(0.001, 500, 0.9)


def test_delays_count_from_the_change_to_the_first_later_alarm() -> None:
    found = delays_of([[90, 104, 105], [], [50], [130], []], [100] * 5, [2, 3, 4, 10, None])
    assert found.delay_n.tolist() == [4.0, 30.0] and found.bound_n.tolist() == [2.0, 10.0]
    assert (found.missed, found.hidden) == (2, 1)
    assert found.ratio()[0] == pytest.approx(34.0 / 12.0)


def test_misfits_count_by_their_kind() -> None:
    """The right misfit excuses the rate, and what is missed; where the model fits, none may be reported."""
    noisy, quiet = count_false_alarms([[500]] * 4, [1000] * 4), count_false_alarms([[]] * 4, [10**6] * 4)
    hum, drift = Misfit("hum", 300), Misfit("drift", 5)
    condition, nominal = CONDITIONS["hum-3"], CONDITIONS["nominal"]
    detected, missed = delays_of([], [], []), delays_of([[]] * 3, [0] * 3, [5] * 3)
    half = Healthy(noisy, [[hum], [drift, hum], [drift], []])
    assert half.kinds(condition.kinds) == ["hum", "hum", "drift"] and half.right_share(condition.kinds) == 0.5
    assert [*bench_reality.faults(condition, half, missed)] == ["rate", "missed"]
    assert [*bench_reality.faults(condition, Healthy(noisy, [[hum]] * 4), missed)] == []
    assert [*bench_reality.faults(condition, Healthy(quiet, None), detected)] == []
    assert [*bench_reality.faults(nominal, Healthy(quiet, [[hum], [], [], []]), detected)] == [
        "MISFIT of a model that fits"
    ]
    assert [*bench_reality.faults(nominal, Healthy(quiet, None), missed)] == ["missed"]


def test_a_row_yields_all_columns() -> None:
    figures = bench_reality.measure("hum-3", Effort(runs=2, run_n=1000, trials=1))
    rows, columns = zip(*(figure.name.split(": ") for figure in figures), strict=True)
    assert set(rows) == {"hum-3, hum of 3 LSB at 50 Hz on the displacement"}
    assert columns == ("false alarms per 1e5", "99 % bound", "MISFIT", "missed", "delay over bound", "required")
    assert len(list(bench_reality.lines(iter(figures)))) == 1


def test_plants_of_any_speed_have_the_stated_poles() -> None:
    for plant, half_n in plants_of_any_speed(50, seed=3):
        assert 0.3 <= max(abs(np.exp(pole * PERIOD_S)) for pole in plant.poles()) <= 0.999
        assert 10.0 <= half_n <= 500.0


def test_delays_of_the_shipped_device_are_close_to_the_bound() -> None:
    """Twenty trials of one change, all within the horizon; no device is faster than 0.7 bounds on average."""
    played = bench_statistics.play_shipped(bench_statistics.CELLS[0], ("M", 1.2), trials=20, seed=0)
    figure = played.figure("delay", 1e5)
    assert 0.7 < figure.value < 2.0
    alarms = bench_statistics.healthy_alarms(FRONT, FULL, bench_statistics.RUN_N, seed=1)
    assert alarms.exposure_n > 0.9 * bench_statistics.RUN_N


@pytest.mark.parametrize("name", ["nominal", "missing-20", "blocks"])
def test_the_exposure_is_the_samples_with_an_equation_beyond_the_warm_up(name: str) -> None:
    """The warm-up counts equations: it ends the later, the more samples are missing."""
    device, (played,) = shipped(), CONDITIONS[name].play([5], 4000, [None])
    answers = answers_to(device, played)
    equations = (answers.flags & (SteppedFlag.MISSING | SteppedFlag.GATHERING)) == 0
    assert not (equations & ~played.valid).any()
    assert exposure_n(device, played, answers) == equations.sum() - EstimatorConfig().warm_up_n


def test_the_promise_on_false_alarms_holds_as_soon_as_the_trigger_is_armed() -> None:
    """Ten random plants of any speed, 580,000 samples; with the rate of 1.1e-6 more than 3 alarms come in 1 of 100."""
    plants, run_n = plants_of_any_speed(10, seed=4), bench_statistics.START_N
    found = FalseAlarms.joined(
        bench_statistics.healthy_alarms(
            plant, dataclasses.replace(FULL, half_period_n=half_n), 40 * run_n, i, run_n=run_n
        )
        for i, (plant, half_n) in enumerate(plants)
    )
    warm_up_n = EstimatorConfig().warm_up_n
    assert len(found.by_run) == 400
    assert 0.95 < found.exposure_n / (400 * (run_n - warm_up_n)) <= 1.0
    assert found.alarms <= 3


# ------------------------------------------------------------------------------------------------------------ Silverbox


def test_the_linear_part_of_the_silverbox_responds_as_scipy_says() -> None:
    """With an input that is linear between the samples, as of ``lsim``."""
    input_v = np.random.default_rng(0).standard_normal(200)
    rate = 2.0 * math.pi * silverbox.RESONANCE_HZ
    system = ([rate**2], [1.0, 2.0 * silverbox.DAMPING * rate, rate**2])
    _, expected, _ = signal.lsim(system, input_v, np.arange(200) / silverbox.RATE_HZ)
    assert silverbox.respond(input_v)[:, 0] == pytest.approx(expected, abs=1e-9)


def test_a_change_is_spliced_into_the_record_from_its_sample_on() -> None:
    record = _made_record()
    spliced = record.spliced(5000, 1.2)
    assert record.gain == pytest.approx(2.5, rel=0.01)
    assert len(spliced.output_v) == 5000 + silverbox.HORIZON_N + 1
    assert np.array_equal(spliced.output_v[:5001], record.output_v[:5001])
    assert (spliced.output_v[5001:] != record.output_v[5001 : len(spliced.output_v)]).all()


def test_a_record_becomes_rows_of_the_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    record = _made_record()
    volts = np.stack([record.input_v, record.output_v], axis=1)
    np.savetxt(tmp_path / silverbox.FILE, volts, delimiter=",", header='"V1","V2",', comments="")
    monkeypatch.setenv(silverbox.FOLDER_SETTING, str(tmp_path))
    assert np.allclose(silverbox.Record.load().output_v, record.output_v)
    columns = [figure.name.rpartition(": ")[2] for figure in silverbox.figures()]
    assert columns.count("required") == 5 and "median delay" in columns and columns.count("MISFIT") == 1


def test_an_absent_record_is_skipped_with_its_setting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(silverbox.FOLDER_SETTING, str(tmp_path))
    assert not list(silverbox.figures())
    assert f"set {silverbox.FOLDER_SETTING} to the folder" in capsys.readouterr().out


def _made_record() -> silverbox.Record:
    """Linear record of the length of the arrow head with the noise of the measured one."""
    rng = np.random.default_rng(0)
    input_v = 0.02 * rng.standard_normal(silverbox.GROWTH_END + 100)
    output_v = 2.5 * silverbox.respond(input_v)[:, 0] + 3e-4 * rng.standard_normal(len(input_v))
    return silverbox.Record(input_v, output_v)


# --------------------------------------------------------------------------------------------------------- command line


def test_words_after_a_benchmark_are_its_options() -> None:
    asked = benchmarks.requests(["engine", "reality", "--rows", "hum,drift", "link"])
    assert asked == [("engine", []), ("reality", ["--rows", "hum,drift"]), ("link", [])]
    with pytest.raises(SystemExit, match="no benchmark is called --rows"):
        benchmarks.requests(["engine", "--rows"])


def test_rows_are_named_by_their_beginnings(capsys: pytest.CaptureFixture[str]) -> None:
    effort, names, jobs = bench_reality.arguments(["--rows", "hum,silver", "--quick", "--jobs", "3"])
    assert (effort, list(names), jobs) == (bench_reality.QUICK, ["hum-1", "hum-3", "hum-10", "silverbox"], 3)
    with pytest.raises(SystemExit):
        bench_reality.arguments(["--rows", "nosuch"])
    assert "no row is called nosuch; there are nominal, " in capsys.readouterr().err
