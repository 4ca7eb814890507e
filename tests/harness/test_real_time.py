"""Real time and the time of a line: paced by a clock, overruns counted, refused where it cannot fit."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from analogrig.bench import Bench
from analogrig.catalogue import BLOCK_SAMPLES, Sample
from analogrig.devices.catalogue_device import CatalogueDevice
from analogrig.devices.device import DeviceDescription
from analogrig.devices.library import InprocDevice, MemoryWire
from analogrig.devices.processes import HostDevice
from analogrig.errors import ConfigurationError
from analogrig.judging.verdict import judge
from analogrig.links.line import SerialLine
from analogrig.links.link import FramedLink, VirtualClock
from analogrig.rigs.description import open_rig
from analogrig.run import UNREPORTED, Run
from analogrig.scenario import Scenario
from tests.harness.fed import fed

PERIOD_S = 5e-5
THESIS = Scenario.load("thesis")
SHORT = dataclasses.replace(THESIS, samples=600, changes=())


def play(description: DeviceDescription, real_time: float | None = None, scenario: Scenario = SHORT) -> Run:
    with open_rig("emulator") as rig, description.connect() as dut:
        return Bench(rig, dut, real_time=real_time).play(scenario, seed=5)


@pytest.fixture(scope="module")
def lock_step() -> Run:
    return play(InprocDevice(name="bob"))


# ---- pace


def test_no_sample_goes_out_before_the_machine_has_taken_it() -> None:
    """A device in this process, and its virtual clock: it waits as long as it has to, and no longer."""
    clock = VirtualClock()
    sent_at: list[float] = []

    class Watched(MemoryWire):
        def write(self, sent: bytes) -> None:
            sent_at.append(clock())
            super().write(sent)

    dut = CatalogueDevice(FramedLink(Watched(1, clock=clock)), InprocDevice(name="bob", exchange="stream"))
    dut.recover()
    dut.configure()
    pace = dut.pace(PERIOD_S)
    dut.start(pace)
    sent_at.clear()
    codes = np.zeros(10 * BLOCK_SAMPLES, np.uint16)
    start_s = clock()
    fed(dut, 0, codes, codes, np.zeros(len(codes), bool))
    due_s = start_s + PERIOD_S * BLOCK_SAMPLES * np.arange(1, 11)
    assert sent_at == pytest.approx(due_s.tolist())
    assert (pace.messages, pace.overruns) == (10, 0)


@pytest.mark.parametrize("exchange", ["sample", "block", "stream"])
@pytest.mark.parametrize("factor", [1.0, 10.0])
def test_real_time_changes_no_estimate(lock_step: Run, exchange: str, factor: float) -> None:
    run = play(InprocDevice(name="bob", exchange=exchange), factor)  # type: ignore[arg-type]
    assert run.theta_hash() == lock_step.theta_hash()
    assert run.conditions.faults == ()
    assert run.conditions.real_time == factor


def test_device_that_is_too_slow_overruns_and_the_run_is_inconclusive(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each answer takes ten times as long as the samples that it is about."""

    class Slow(MemoryWire):
        def read(self, timeout_s: float) -> bytes:
            answers = super().read(timeout_s)
            self.clock.advance(10 * BLOCK_SAMPLES * PERIOD_S if answers else 0.0)
            return answers

    monkeypatch.setattr(InprocDevice, "wire", lambda _: Slow(boot_nonce=1))
    verdict = judge(run := play(InprocDevice(name="bob", exchange="stream", window=2), 1.0))
    assert verdict.outcome == "inconclusive"
    (reason,) = verdict.reasons
    overruns, messages = (int(word) for word in reason.split() if word.isdecimal())
    assert messages == -(-256 // BLOCK_SAMPLES) * 2 + -(-88 // BLOCK_SAMPLES)
    assert messages - 4 <= overruns <= messages
    assert "messages of samples overran" in reason
    assert run.samples == SHORT.samples


def test_process_keeps_up_with_a_slower_machine() -> None:
    """By the clock on the wall: 600 samples of a machine 20 times slower take 0.6 s."""
    run = play(HostDevice(name="bob", exchange="stream"), 20.0)
    assert run.conditions.faults == ()
    assert judge(run).valid


def test_fewer_reports_leave_the_alarms_and_mark_what_was_not_reported() -> None:
    full = play(InprocDevice(name="bob"), scenario=THESIS)
    thin = play(InprocDevice(name="bob", report_interval_n=25), scenario=THESIS)
    reported = np.arange(THESIS.samples) % 25 == 24
    assert np.array_equal((thin.flags & UNREPORTED) == 0, reported)
    assert np.array_equal(thin.theta[reported], full.theta[reported])
    held = np.maximum.accumulate(np.where(reported, np.arange(THESIS.samples), -1))
    assert np.array_equal(thin.theta[24:], full.theta[held[24:]])
    assert not thin.theta[:24].any()
    assert np.array_equal(thin.statistic, full.statistic)
    assert np.array_equal(thin.alarm_index, full.alarm_index)


# ---- what a line can carry


def test_real_time_that_does_not_fit_the_line_is_refused_with_the_arithmetic() -> None:
    """Seven estimates and Stepped in 16 bytes each: 128 bytes a sample, 10 bits a byte, 20,000 samples a second."""
    with pytest.raises(ConfigurationError) as caught:
        play(InprocDevice(name="bob", exchange="stream", baud=921_600), 1.0)
    assert str(caught.value) == (
        "device bob: real time does not fit its line: 20000 samples/s, each of 55.8 us to the device and 1389 us back"
        " (7 estimates every 1 samples), need 27.78 times the capacity of 921600 baud; 27.8 times slower would fit"
    )


@pytest.mark.parametrize(
    ("exchange", "baud", "factor", "report_interval_n", "fits"),
    [
        ("stream", 115_200, 223.0, 1, True),
        ("stream", 115_200, 222.0, 1, False),
        ("stream", 921_600, 4.0, 100, True),
        ("stream", 921_600, 3.0, 100, False),
        ("sample", 3_400_000, 1.0, 1000, True),
        ("sample", 3_200_000, 1.0, 1000, False),
    ],
)
def test_what_fits_is_played(exchange: str, baud: int, factor: float, report_interval_n: int, *, fits: bool) -> None:
    description = InprocDevice(
        name="bob",
        exchange=exchange,  # type: ignore[arg-type]
        baud=baud,
        report_interval_n=report_interval_n,
    )
    if fits:
        assert play(description, factor).samples == SHORT.samples
    else:
        with pytest.raises(ConfigurationError, match="real time does not fit"):
            play(description, factor)


# ---- the time of a line


class Echo:
    """Answers with half of what it is told, in two pieces: 16 bytes of a Sample, then 8."""

    name = "echo"
    clock = staticmethod(VirtualClock())

    def __init__(self) -> None:
        self._pieces: list[bytes] = []

    def write(self, sent: bytes) -> None:
        self._pieces += [sent[: len(sent) // 4], sent[: len(sent) // 4]]

    def read(self, timeout_s: float) -> bytes:
        del timeout_s
        return self._pieces.pop(0) if self._pieces else b""

    def close(self) -> None:
        pass


def test_every_byte_takes_ten_bits_one_direction_after_the_other() -> None:
    link = FramedLink(Echo(), SerialLine(1000))
    for exchanges in (1, 2, 3):
        link.send([Sample(exchanges, 0, 0, 1000, 2000)])
        assert link.receive(0.0) is None and link.receive(0.0) is None
        assert link.line_s == pytest.approx(0.24 * exchanges)


def test_time_of_the_line_is_the_same_every_time_and_for_every_device() -> None:
    """600 samples of 16 bytes and their answers of 128, at 115200 baud."""
    line_s = {play(description).conditions.line_s for description in 2 * [InprocDevice(name="bob", baud=115_200)]}
    line_s.add(play(HostDevice(name="bob", baud=115_200)).conditions.line_s)
    (only,) = line_s
    assert only == pytest.approx(600 * (16 + 128) * 10 / 115_200)
    assert play(InprocDevice(name="bob")).conditions.line_s == 0.0


def test_more_samples_for_each_report_are_advised_where_they_would_do() -> None:
    with pytest.raises(ConfigurationError, match=r"\d times slower would fit, or more samples for each report$"):
        play(InprocDevice(name="bob", exchange="stream", baud=4_000_000), 1.0)
