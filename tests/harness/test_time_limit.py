"""The time limit of a run: it ends every wait, and what was answered until then is kept."""

from __future__ import annotations

import math
import re
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import pytest

from analogrig.bench import Bench
from analogrig.catalogue import Sample, SampleBlock, unpack_any
from analogrig.devices.catalogue_device import CatalogueDevice
from analogrig.devices.library import InprocDevice, MemoryWire
from analogrig.errors import TimeLimitReached
from analogrig.judging.verdict import judge
from analogrig.links.link import FrameDecoder, FramedLink
from analogrig.rigs.description import open_rig
from analogrig.rigs.rig import BLOCK_SAMPLES
from analogrig.run import Run
from analogrig.scenario import Scenario
from tests.harness.commands import called

SCENARIO = Scenario.load("thesis")

ExchangeMode = Literal["sample", "block", "stream"]


class SlowWire(MemoryWire):
    """A device that answers every message of samples after ``latency_s`` of the wire's own clock."""

    latency_s = 0.0

    def __init__(self) -> None:
        super().__init__(boot_nonce=1)
        self._ready_s = 0.0

    def write(self, sent: bytes) -> None:
        super().write(sent)
        if has_samples(sent):
            self._ready_s = self.clock() + self.latency_s

    def read(self, timeout_s: float) -> bytes:
        left_s = self._ready_s - self.clock()
        if left_s > timeout_s:
            self.clock.advance(timeout_s)
            return b""
        self.clock.advance(max(0.0, left_s))
        return super().read(timeout_s)


def has_samples(sent: bytes) -> bool:
    messages = map(unpack_any, FrameDecoder().feed(sent))
    return any(isinstance(message, Sample | SampleBlock) for message in messages)


def slow_dut(latency_s: float, exchange: ExchangeMode = "sample", window: int = 1) -> tuple[CatalogueDevice, SlowWire]:
    wire = SlowWire()
    wire.latency_s = latency_s
    description = InprocDevice(name="slow", timeout_s=2.0, exchange=exchange, window=window)
    dut = CatalogueDevice(FramedLink(wire), description)
    dut.recover()
    dut.configure()
    return dut, wire


def played(dut: CatalogueDevice, wire: SlowWire, limit_s: float | None) -> Run:
    with open_rig("emulator") as rig:
        return Bench(rig, dut, time_limit_s=limit_s, clock=wire.clock).play(SCENARIO, 1)


def test_limit_ends_the_run_and_keeps_every_sample_that_was_answered() -> None:
    run = played(*slow_dut(1.0), limit_s=60.5)
    assert run.conditions.faults == (f"time limit of 60.5 s reached after 60 of {SCENARIO.samples} samples",)
    assert run.samples == 60
    verdict = judge(run)
    assert verdict.outcome == "inconclusive"
    assert verdict.reasons[0] == run.conditions.faults[0]


def test_samples_that_were_kept_are_those_of_the_whole_run() -> None:
    whole, cut = played(*slow_dut(0.0), limit_s=None), played(*slow_dut(0.01), limit_s=10.005)
    assert whole.conditions.faults == ()
    assert cut.samples == 1000
    assert (cut.theta == whole.theta[:1000]).all()
    assert (cut.codes == whole.codes[:1000]).all()
    assert (cut.flags == whole.flags[:1000]).all()
    assert cut.alarm_index.tolist() == [index for index in whole.alarm_index.tolist() if index < 1000]


@pytest.mark.parametrize("exchange", ["block", "stream"])
def test_limit_ends_a_run_of_blocks(exchange: ExchangeMode) -> None:
    whole = played(*slow_dut(0.0), limit_s=None)
    run = played(*slow_dut(1.0, exchange, window=4), limit_s=10.5)
    assert 0 < run.samples < SCENARIO.samples
    assert run.conditions.faults == (f"time limit of 10.5 s reached after {run.samples} of {SCENARIO.samples} samples",)
    assert (run.theta == whole.theta[: run.samples]).all()


def test_limit_ends_the_wait_for_a_device_that_is_silent() -> None:
    dut, wire = slow_dut(math.inf)
    run = played(dut, wire, limit_s=1.5)
    assert wire.clock() == pytest.approx(1.5)
    assert run.conditions.faults == (f"time limit of 1.5 s reached after 0 of {SCENARIO.samples} samples",)


def test_limit_ends_a_run_on_a_slow_rig() -> None:
    dut, _ = slow_dut(0.0)
    now_s = 0.0

    def clock() -> float:
        nonlocal now_s
        now_s += 1.0  # once when the play begins, once for the wait, and then with each block
        return now_s

    with open_rig("emulator") as rig:
        run = Bench(rig, dut, time_limit_s=4.5, clock=clock).play(SCENARIO, 1)
    assert run.samples == 3 * BLOCK_SAMPLES - 1  # the answer to the last one is read when the next one is sent
    assert run.conditions.faults == (f"time limit of 4.5 s reached after 767 of {SCENARIO.samples} samples",)


def test_limit_is_that_of_one_play() -> None:
    dut, wire = slow_dut(1.0)
    assert played(dut, wire, limit_s=5.5).samples == 5
    dut.recover()
    assert played(dut, wire, limit_s=7.5).samples == 7
    wire.latency_s = 0.0
    dut.recover()
    assert played(dut, wire, limit_s=None).conditions.faults == ()


def test_question_beyond_the_limit_is_not_waited_for() -> None:
    dut, wire = slow_dut(0.0)
    dut.limit(0.0)
    wire.clock.advance(1.0)
    with pytest.raises(TimeLimitReached, match="^device slow: time limit reached"):
        dut.status()


# ---- the command, and a device that is slow in real time


class SlowServer:
    """A device behind TCP that answers every message of samples after 0.3 s."""

    def __init__(self) -> None:
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = self._server.getsockname()[1]
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        wire = MemoryWire(boot_nonce=5)
        while True:
            try:
                line, _ = self._server.accept()
            except OSError:
                return
            with line:
                self._answer(line, wire)

    def _answer(self, line: socket.socket, wire: MemoryWire) -> None:
        while True:
            try:
                if not (received := line.recv(65536)):
                    return
                wire.write(received)
                if has_samples(received):
                    time.sleep(0.3)
                line.sendall(wire.read(0.0))
            except OSError:
                return

    def close(self) -> None:
        self._server.close()


@pytest.fixture
def slow() -> Iterator[SlowServer]:
    server = SlowServer()
    yield server
    server.close()


@pytest.mark.parametrize("verb", ["run", "replay"])
def test_command_ends_at_its_limit_and_keeps_what_was_recorded(tmp_path: Path, slow: SlowServer, verb: str) -> None:
    what: tuple[str, ...] = ("--scenario", "thesis")
    if verb == "replay":
        with (
            open_rig("emulator") as rig,
            CatalogueDevice(FramedLink(MemoryWire(1)), InprocDevice(name="inproc")) as dut,
        ):
            dut.recover()
            dut.configure()
            Bench(rig, dut).play(SCENARIO, 1).save(tmp_path / "before.npz")
        what = (str(tmp_path / "before.npz"),)
    device = ("--dut", f"serial:socket://127.0.0.1:{slow.port}", "--exchange", "sample")
    done = called(verb, *what, *device, "--time-limit", "1.5", "--out", tmp_path / "out")
    assert done.status == 3, done.err
    (line,) = done.err.splitlines()
    told = re.fullmatch(r"analogrig: INCONCLUSIVE: time limit of 1.5 s reached after (\d+) of 1800 samples", line)
    assert told is not None, line
    assert int(told[1]) <= 5
    assert Run.load(tmp_path / "out" / "run.npz").samples == int(told[1])
    assert "time limit of 1.5 s" in (tmp_path / "out" / "report.html").read_text()


def test_limit_ends_a_play_of_the_plugin(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch, slow: SlowServer
) -> None:
    monkeypatch.setenv("ANALOGRIG_DUT", f"serial:socket://127.0.0.1:{slow.port}")
    pytester.makepyfile("def test_it(hil_play):\n    hil_play('thesis')\n")
    result = pytester.runpytest_inprocess("-p", "no:cacheprovider", "-p", "no:xdist", "--hil-time-limit", "1.5")
    result.assert_outcomes(failed=1)
    result.stdout.re_match_lines([r".*INCONCLUSIVE: time limit of 1.5 s reached after \d+ of 1800 samples"])


@pytest.mark.parametrize("limit", ["0", "soon", "nan"])
def test_invalid_limit_of_the_plugin_is_refused(pytester: pytest.Pytester, limit: str) -> None:
    result = pytester.runpytest_inprocess("-p", "no:cacheprovider", "--hil-time-limit", limit)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines([f"*--hil-time-limit: must be seconds from 0.001 to 1e9, not {limit!r}"])


@pytest.mark.parametrize("limit", ["0", "-1", "nan", "soon", "1e99"])
def test_invalid_limit_is_refused_in_one_line(limit: str, tmp_path: Path) -> None:
    done = called("run", f"--time-limit={limit}", "--out", tmp_path)
    assert done.status == 2
    (line,) = done.err.splitlines()
    assert "--time-limit" in line
