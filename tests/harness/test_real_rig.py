"""Real rig, tested on the emulator served as the instrument in another process; with defects, in a thread."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from analogrig.bench import Bench
from analogrig.devices.registry import open_dut
from analogrig.errors import ConfigurationError, RecordIncomplete, RecordStale, RigClosed, RigError, RigTimeout
from analogrig.judging.verdict import judge
from analogrig.program import Program
from analogrig.rigs.description import describe, open_rig
from analogrig.rigs.rig import Performance
from analogrig.run import Run
from analogrig.scenario import PotChange, Scenario
from analogrig.signals import ENDING
from analogrig_emulator import Excitation
from analogrig_instruments.instrument import DialChange, PotBox
from analogrig_instruments.real import LEAD_N, RealRig, split_records
from analogrig_instruments.red_pitaya import RedPitaya
from analogrig_instruments.rig_wiring import RealDescription
from tests.harness.allowed import open_allowed
from tests.harness.processes import LONG_S
from tests.served.serving import RIG, ROOT, Served, serving, serving_in_thread

THESIS = Scenario.load("thesis")
SHORT = dataclasses.replace(THESIS, samples=700, changes=())


@pytest.fixture(scope="module")
def ideal() -> Iterator[Served]:
    with serving("--rig", "emulator-ideal") as instrument:
        yield instrument


@pytest.fixture
def bench(ideal: Served, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Name of a rig on the ideal instrument."""
    monkeypatch.setenv("ANALOGRIG_RIGS", str(ideal.rigs_file(tmp_path)))
    return "bench"


def played(rig: str, scenario: Scenario, seed: int) -> Run:
    with open_allowed(rig) as opened, open_dut("inproc") as dut:
        return Bench(opened, dut).play(scenario, seed)


def volts(performance: Performance) -> np.ndarray:
    return np.concatenate([block.volts[:, :2] for block in performance.blocks])


# ---- the same as the emulator


@pytest.mark.parametrize("seed", [1, 2])
def test_signals_are_those_of_the_emulated_rig_to_the_converters_step(bench: str, seed: int) -> None:
    with open_allowed(bench) as real, open_rig("emulator-ideal") as emulated:
        measured, exact = volts(real.perform(THESIS, seed)), volts(emulated.perform(THESIS, seed))
    half_step_v = 0.5 * 40.0 / (1 << 14)
    # 0.05 samples between sample and pot, as the change of a real machine comes between two; so much x moves meanwhile
    np.testing.assert_allclose(measured[:1200], exact[:1200], atol=half_step_v + 1e-4)
    np.testing.assert_allclose(measured, exact, atol=half_step_v + 0.03)


def test_verdicts_are_those_of_the_emulated_rig(bench: str) -> None:
    for seed in range(3):
        real, emulated = judge(played(bench, THESIS, seed)), judge(played("emulator-ideal", THESIS, seed))
        assert real.outcome == emulated.outcome == "passed"
        for mine, other in zip(real.changes, emulated.changes, strict=True):
            assert (mine.sample, mine.what) == (other.sample, other.what)
            assert mine.latency_n is not None
            assert other.latency_n is not None
            assert abs(mine.latency_n - other.latency_n) <= 2


def test_each_play_begins_with_the_pots_of_its_scenario(ideal: Served, tmp_path: Path) -> None:
    """Records without noise are the same to the bit."""
    file = ideal.rigs_file(tmp_path)
    file.write_text(file.read_text().replace('range = "HV"', 'range = "HV", noise_lsb = 0.0'))
    with open_allowed(str(file)) as rig:
        first, again = (volts(rig.perform(THESIS, 1)) for _ in range(2))
    np.testing.assert_array_equal(first, again)


def test_scenario_longer_than_a_record_is_played_in_several(bench: str) -> None:
    changes = (PotChange(5000, {"K": 18000.0}), PotChange(16_500, {"B": 3453.0}))
    run = played(bench, dataclasses.replace(THESIS, samples=20_000, changes=changes), 1)
    assert run.conditions.records == (0, 16_384 - (16_384 - (16_500 - LEAD_N)))
    assert run.samples == 20_000
    verdict = judge(run)
    assert verdict.outcome == "passed", verdict.reasons
    assert [change.sample for change in verdict.changes] == [5000, 16_500]
    assert verdict.estimates[-1].error["B"] == pytest.approx(0.0, abs=0.02)


def test_records_start_well_before_changes() -> None:
    assert split_records(1000, 16_384, [500]) == [(0, 1000)]
    assert split_records(20_000, 16_384, []) == [(0, 16_384), (16_384, 20_000)]
    assert split_records(20_000, 16_384, [16_380]) == [(0, 16_380 - LEAD_N), (16_380 - LEAD_N, 20_000)]
    assert split_records(20_000, 16_384, [16_384 + LEAD_N + 1]) == [(0, 16_384), (16_384, 20_000)]


WAVEFORMS = [
    Excitation("pulse", 0.5, 9.0, 100.0, duty=0.2),
    Excitation(clock="free", phase=0.3, low_v=0.1, high_v=9.0, drift_ppm=20.0),
]


@pytest.mark.parametrize("excitation", WAVEFORMS)
def test_waveforms_are_those_of_the_scenario(bench: str, excitation: Excitation) -> None:
    scenario = Scenario(600, excitation, name="waveform")
    with open_allowed(bench) as real, open_rig("emulator-ideal") as emulated:
        measured, exact = volts(real.perform(scenario, 1)), volts(emulated.perform(scenario, 1))
    np.testing.assert_allclose(measured, exact, atol=0.002)


def test_stages_between_instrument_and_computer_are_compensated(tmp_path: Path) -> None:
    stages = {"generator": (-10.0, 0.5), "force": (0.5, 0.0), "displacement": (-1.0, 0.25)}
    defects = [
        part
        for name, (gain, offset_v) in stages.items()
        for part in (f"wiring.{name}.gain={gain}", f"wiring.{name}.offset_v={offset_v}")
    ]
    wired = """
[rig.other]
kind = "real"
instrument = "redpitaya://{address}"
generator = {{ gain = -10.0, offset_v = 0.5 }}
inputs.force = {{ input = 1, range = "HV", gain = 0.5 }}
inputs.displacement = {{ input = 2, range = "HV", gain = -1.0, offset_v = 0.25 }}
pots.kind = "instrument"
self_test = false
"""
    with serving_in_thread(*defects, rig="emulator-ideal") as instrument:
        file = tmp_path / "rigs.toml"
        file.write_text(wired.format(address=instrument.address))
        with open_allowed(f"{file}:other") as real, open_rig("emulator-ideal") as emulated:
            measured, exact = volts(real.perform(SHORT, 1)), volts(emulated.perform(SHORT, 1))
    np.testing.assert_allclose(measured[0], [exact[0, 0], 0.5 * 0.6], atol=0.005)  # at rest under the stage's offset
    np.testing.assert_allclose(measured[200:], exact[200:], atol=0.005)


# ---- what goes wrong


FAILURES = {
    "acquisition.half_filled=true": RecordIncomplete,
    'acquisition.drop_out="zeros"': RecordIncomplete,
    'acquisition.drop_out="hang up"': RigClosed,
    'acquisition.drop_out="silence"': RigTimeout,
    "acquisition.never_filled=true": RigTimeout,
    "acquisition.stale_n=1": RecordStale,
    "acquisition.triggered_early=true": RecordStale,
}


def test_instrument_in_use_is_locked(bench: str) -> None:
    with open_allowed(bench) as first, open_allowed(bench) as second:
        next(first.perform(SHORT, 1).blocks)
        with pytest.raises(RigClosed, match="in use by another process or rig on this machine"):
            next(second.perform(SHORT, 1).blocks)
    with open_allowed(bench) as third:
        next(third.perform(SHORT, 1).blocks)


@pytest.mark.parametrize("host", ["localhost", "LOCALHOST", "127.1"])
def test_instrument_is_locked_under_each_name_of_its_host(tmp_path: Path, host: str) -> None:
    with serving_in_thread() as instrument:
        names = [str(instrument.rigs_file(tmp_path)), f"redpitaya://{host}:{instrument.port}"]
        same = tmp_path / "same.toml"
        same.write_text(Path(names[0]).read_text().replace(f"redpitaya://{instrument.address}", names[1]))
        with open_allowed(names[0]) as first, open_allowed(str(same)) as second:
            next(first.perform(SHORT, 1).blocks)
            with pytest.raises(RigClosed, match=f"{host}:{instrument.port}: in use by another process or rig"):
                next(second.perform(SHORT, 1).blocks)


def test_run_after_a_failed_one_passes(tmp_path: Path) -> None:
    with serving_in_thread('acquisition.drop_out="zeros"', "acquisition.drop_out_record=2") as instrument:
        file = instrument.rigs_file(tmp_path)
        with open_allowed(str(file)) as rig, open_dut("inproc") as dut:
            bench = Bench(rig, dut)
            outcomes = [judge(bench.play(SHORT, 1)).outcome for _ in range(2)]
    assert outcomes == ["inconclusive", "passed"]


def test_stale_record_of_an_earlier_play_is_detected(tmp_path: Path) -> None:
    """The fourth record of the instrument is stale; a record of rest precedes each one that counts."""
    with (
        serving_in_thread("acquisition.stale_n=2", "acquisition.drop_out_record=4") as instrument,
        open_allowed(str(instrument.rigs_file(tmp_path))) as rig,
        open_dut("inproc") as dut,
    ):
        first, second, third = (judge(Bench(rig, dut).play(SHORT, 1)) for _ in range(3))
    assert [first.outcome, second.outcome, third.outcome] == ["passed", "inconclusive", "passed"]
    assert "stale record: it repeats an earlier one to the bit" in second.reasons[0]


class DisplacedPots(PotBox):
    """Pots that make the changes of a record late, or not at all."""

    def __init__(self, box: PotBox, late_s: float) -> None:
        self.names = box.names
        self._box, self._late_s = box, late_s

    def set_one(self, pot: str, dial: float) -> None:
        self._box.set_one(pot, dial)

    def schedule(self, changes: Sequence[DialChange]) -> None:
        late = [DialChange(delay_s + self._late_s, pot, dial) for delay_s, pot, dial in changes]
        self._box.schedule(late if self._late_s else [])


@pytest.mark.parametrize(("late_s", "said"), [(0.0, "nothing in the samples"), (60 / 20e3, "moved at 1260")])
def test_displaced_changes_of_the_instrument_are_detected(late_s: float, said: str, bench: str) -> None:
    def connected(address: str, timeout_s: float) -> RedPitaya:
        instrument = RedPitaya.open(address, timeout_s)
        assert instrument.pots is not None
        instrument.pots = DisplacedPots(instrument.pots, late_s)
        return instrument

    scenario = dataclasses.replace(THESIS, samples=1600, changes=THESIS.changes[:1])
    description = describe(bench)
    assert isinstance(description, RealDescription)
    with RealRig(description, connected) as rig, open_dut("inproc") as dut:
        verdict = judge(Bench(rig, dut).play(scenario, 1))
    assert verdict.outcome == "inconclusive"
    assert "the pot scheduled for sample 1200 (K 18000)" in verdict.reasons[0]
    assert said in verdict.reasons[0]


@pytest.mark.parametrize("defect", FAILURES)
def test_instrument_that_fails_in_a_record_is_a_named_error_and_the_run_inconclusive(
    defect: str, tmp_path: Path
) -> None:
    second = "acquisition.drop_out_record=2"  # the first one is taken while the computer comes to rest
    with serving_in_thread(defect, second) as instrument:
        file = instrument.rigs_file(tmp_path)
        if FAILURES[defect] is RigTimeout:
            file.write_text(file.read_text().replace("timeout_s = 60.0", "timeout_s = 1.0"))
        with open_allowed(str(file)) as rig:
            blocks = rig.perform(SHORT, 1).blocks
            with pytest.raises(FAILURES[defect], match=instrument.address):
                next(blocks)
        if "drop_out" not in defect and "stale" not in defect:  # those are over
            verdict = judge(played(str(file), SHORT, 1))
            assert verdict.outcome == "inconclusive"
            assert instrument.address in verdict.reasons[0]


@pytest.mark.parametrize(
    ("answer", "then", "error", "said"),
    [
        pytest.param(b"", b"", RigTimeout, "no answer within 0.2 s", id="says nothing"),
        pytest.param(b"", b"x", RigTimeout, "no (whole )?answer within 0.2 s", id="drips"),
        pytest.param(b"", None, RigClosed, "connection", id="hangs up"),
        pytest.param(b"nonsense" * 300_000, None, RigError, "instrument 127", id="an answer without end"),
        pytest.param(b"\n\n#9\n\xff\xff\n" * 50, None, RigError, "instrument 127", id="nonsense"),
    ],
)
def test_other_servers_are_a_named_error(
    answer: bytes, then: bytes | None, error: type[RigError], said: str, tmp_path: Path
) -> None:
    """They send ``answer``, and ``then`` every 50 ms; or close the connection."""

    def answers(listening: socket.socket) -> None:
        connection, _ = listening.accept()
        with connection, contextlib.suppress(OSError):
            connection.sendall(answer)
            while then is not None and not done.wait(0.05):
                connection.sendall(then)

    done = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as listening:
        thread = threading.Thread(target=answers, args=(listening,), daemon=True)
        thread.start()
        file = tmp_path / "rigs.toml"
        address = f"127.0.0.1:{listening.getsockname()[1]}"
        file.write_text(RIG.format(address=address, self_test="false").replace("60.0", "0.2"))
        with open_allowed(str(file)) as rig, pytest.raises(error, match=said):
            next(rig.perform(SHORT, 1).blocks)
        done.set()
        thread.join(LONG_S)


def test_unreachable_instrument_is_one_line_and_inconclusive(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"127.0.0.1:{taken.getsockname()[1]}"
    file = tmp_path / "rigs.toml"
    file.write_text(RIG.format(address=address, self_test="false"))
    verdict = judge(played(str(file), SHORT, 1))
    assert verdict.outcome == "inconclusive"
    assert verdict.reasons[0] == f"instrument {address}: cannot be reached: Connection refused"


def output_state(address: str) -> str:
    host, _, port = address.rpartition(":")
    with socket.create_connection((host, int(port)), LONG_S) as connection, connection.makefile("rwb") as lines:
        lines.write(b"OUTPUT1:STATE?\r\n")
        lines.flush()
        return lines.readline().decode().strip()


def test_generator_is_off_while_the_device_works_and_afterwards(bench: str, ideal: Served) -> None:
    with open_allowed(bench) as rig:
        for _ in rig.perform(SHORT, 1).blocks:
            assert output_state(ideal.address) == "OFF"
    assert output_state(ideal.address) == "OFF"


@pytest.mark.parametrize(
    "number", [pytest.param(each, marks=() if each == signal.SIGTERM else pytest.mark.heavy) for each in ENDING]
)
def test_interrupted_run_leaves_the_generator_off(number: signal.Signals, tmp_path: Path) -> None:
    silent = ("--defect", 'acquisition.drop_out="silence"', "--defect", "acquisition.drop_out_record=2")
    with serving(*silent) as instrument:
        file = instrument.rigs_file(tmp_path)
        file.write_text(file.read_text().replace("timeout_s = 60.0", "timeout_s = 10.0"))
        command = [sys.executable, "-m", "analogrig.cli", "run", "--dut", "inproc", "--out", str(tmp_path / "out")]
        with subprocess.Popen(
            [*command, "--rig", str(file), "--allow", instrument.address],
            cwd=ROOT,
            stderr=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        ) as process:
            while output_state(instrument.address) != "ON":  # as soon as it plays; it then waits for its record
                assert process.poll() is None
            process.send_signal(number)
            assert process.wait(LONG_S) == 130
        assert output_state(instrument.address) == "OFF"


# ---- descriptions


def described(folder: Path, change: Callable[[str], str]) -> str:
    file = folder / "rigs.toml"
    file.write_text(change(RIG.format(address="127.0.0.1:1", self_test="false")))
    return str(file)


WRONG = {
    "input = 2": ("input = 1", "force and displacement cannot both be at input 1"),
    'range = "HV" }\npots': ('range = "XV" }\npots', "inputs.displacement: range must be 'LV' or 'HV', not 'XV'"),
    "input = 1": ("input = 3", "inputs.force: input must be 1 and 2, not 3"),
    "inputs.displacement": (
        "inputs.velocity",
        "inputs must be force and displacement, input and output of the program front, not force, velocity",
    ),
    "generator.gain = 10.0": ("generator.gain = 0.0", "gain must be within"),
    "gain = 10.0": ("gain = 10.0\ngenerator.offset_v = 50.0", "limits.input_v"),
    "redpitaya://": ("picoscope://", "give it as redpitaya://HOST[:PORT] or nidaqmx://CARD"),
    "timeout_s": ("time_out_s", "unknown key 'time_out_s'"),
    'pots.kind = "instrument"\n': (
        'pots = { kind = "serial", url = "nosuch://x", line = "{pot} {dial}" }\n',
        "pots: url nosuch://x: invalid URL, protocol 'nosuch' not known",
    ),
    'pots.kind = "instrument"': ('pots.kind = "magic"', "pots"),
    "timeout_s = 60.0": ("timeout_s = 60.0\nlimits.dials.MASS = [0.1, 0.9]", "limits.dials: there is no pot 'MASS'"),
    "10.0": ("10.0\ngenerator.offset_v = 15.0", "when it is off, the computer's input stands at offset_v, 15 V"),
    '2, range = "HV"': (
        '2, range = "HV", least_v = 900.0',
        "inputs.displacement: 0 V at the computer must be within the measured",
    ),
    "127.0.0.1:1": ("127.0.0.1:1/?timeout=1", "give it as redpitaya://HOST[:PORT]"),
    "[rig.bench]": ("[rig.bench]\nlimits.dials.M = [0.5, 2.0]", "dials.M must be"),
}


@pytest.mark.parametrize("right", WRONG)
def test_contradictory_description_is_one_line_with_file_and_key(right: str, tmp_path: Path) -> None:
    wrong, said = WRONG[right]
    name = described(tmp_path, lambda text: text.replace(right, wrong, 1))
    with pytest.raises(ConfigurationError) as caught:
        open_allowed(name)
    assert said in str(caught.value)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_scenario_beyond_the_rigs_limits_is_refused_before_anything_moves(tmp_path: Path) -> None:
    name = described(tmp_path, lambda text: text + "limits.input_v = [0.0, 8.0]\nlimits.dials.M = [0.0, 0.5]\n")
    with open_allowed(name) as rig:  # there is no instrument: nothing is sent
        with pytest.raises(ConfigurationError, match=r"excitation of 0.1 V to 9.9 V exceeds limits.input_v"):
            rig.perform(THESIS, 1)
        mild = dataclasses.replace(THESIS, excitation=dataclasses.replace(THESIS.excitation, high_v=7.0))
        with pytest.raises(ConfigurationError, match=r"changes\[3\] at sample 1600: pot M would stand at"):
            rig.perform(mild, 1)


@pytest.mark.parametrize(
    ("scenario", "said"),
    [
        (dataclasses.replace(SHORT, excitation=Excitation("prbs", 0.1, 9.9)), "no prbs"),
        (dataclasses.replace(SHORT, excitation=Excitation("sine", 0.1, 9.9)), "square, pulse and prbs, not 'sine'"),
        (dataclasses.replace(SHORT, excitation=Excitation(frequency_hz=123.0)), "whole samples"),
        (
            dataclasses.replace(SHORT, excitation=Excitation(frequency_hz=160.0)),
            "whole samples apart, not 62.5 and 62.5",
        ),
        (dataclasses.replace(SHORT, excitation=Excitation("pulse", 0.1, 9.0, 100.0, duty=0.123)), "24.6 and 175.4"),
        (dataclasses.replace(SHORT, program=Program.load("shock")), "program 'shock'"),
        (dataclasses.replace(SHORT, changes=(PotChange(100, {"M": 50.0}, ramp_n=20),)), "ramp_n"),
        (dataclasses.replace(SHORT, excitation=Excitation(low_v=0.1, high_v=10.5)), "1.05 V"),
    ],
)
def test_scenario_that_the_rig_cannot_play_is_refused(scenario: Scenario, said: str, tmp_path: Path) -> None:
    with open_allowed(described(tmp_path, str)) as rig, pytest.raises(ConfigurationError, match=said):
        rig.perform(scenario, 1)


def test_rig_is_found_by_name_in_the_rigs_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    both = RIG + RIG.replace("rig.bench", "rig.shock").replace("pots", 'program = "shock"\npots')
    file = tmp_path / "rigs.toml"
    file.write_text(both.format(address="127.0.0.1:1", self_test="false"))
    monkeypatch.delenv("ANALOGRIG_RIGS", raising=False)
    monkeypatch.chdir(tmp_path)
    with open_allowed("bench") as rig:
        assert rig.description()["name"] == "bench"
    with open_allowed(f"{file}:shock") as rig:
        assert rig.description()["program"] == "shock"
    with open_rig("emulator") as rig:
        assert rig.description()["kind"] == "emulator"
    with pytest.raises(ConfigurationError, match=r"holds 2 rigs: name one as .*:NAME; there are bench, shock"):
        open_allowed(str(file))
    with pytest.raises(ConfigurationError, match=r"no rig is called 'bank' .* there are bench, shock, emulator"):
        open_allowed("bank")
    monkeypatch.setenv("ANALOGRIG_RIGS", str(tmp_path / "absent.toml"))
    with pytest.raises(ConfigurationError, match=r"ANALOGRIG_RIGS: .*absent.toml: no such file"):
        open_allowed("bench")


# ---- the self-test comes before any verdict


SICK = {
    "inputs.skew_s=2e-5": "skew",
    "wiring.swapped=true": "identity",
    "inputs.gain_error=[0.0, 0.12]": "gain of displacement",
    "inputs.offset_v=[0.0, 0.15]": "offset of displacement",
    "wiring.displacement.gain=-1.0": "polarity of displacement",
    "acquisition.clock_ppm=120.0": "clock ratio",
    "inputs.noise_v=[0.0, 0.02]": "noise of displacement",
}


@pytest.mark.parametrize("defect", SICK)
def test_run_on_a_faulty_rig_is_inconclusive_with_the_reason(defect: str, tmp_path: Path) -> None:
    with serving_in_thread(defect) as instrument:
        verdict = judge(played(str(instrument.rigs_file(tmp_path, self_test=True)), THESIS, 1))
    assert verdict.outcome == "inconclusive"
    assert verdict.reasons[0].startswith(f"the rig's self-test: {SICK[defect]}")


def test_noise_is_measured_by_the_self_test(tmp_path: Path) -> None:
    with serving_in_thread("inputs.noise_v=[0.0, 0.0042]", rig="emulator-ideal") as instrument:
        run = played(str(instrument.rigs_file(tmp_path, self_test=True)), THESIS, 1)
    assert run.conditions.channels["displacement"].noise_lsb == pytest.approx(0.0042 * (1 << 14) / 40.0, rel=0.05)


def test_rig_with_drawn_components_is_judged_after_a_good_self_test(tmp_path: Path) -> None:
    with serving_in_thread(rig="emulator-real") as instrument:
        run = played(str(instrument.rigs_file(tmp_path, self_test=True)), THESIS, 1)
    assert judge(run).outcome == "passed", judge(run).reasons


# ---- other programs

MOTOR = (
    RIG.replace("inputs.force", "inputs.u").replace("inputs.displacement", "inputs.omega") + 'program = "dc-motor"\n'
)


def test_motor_is_tested_and_judged_as_on_the_emulated_rig(tmp_path: Path) -> None:
    scenario = Scenario.load("dc-motor")
    with serving_in_thread(program="dc-motor") as instrument:
        file = instrument.rigs_file(tmp_path, self_test=True, template=MOTOR)
        with open_allowed(str(file)) as rig, open_dut("inproc") as dut:
            verdict = judge(Bench(rig, dut).play(scenario, 1))
    assert verdict.outcome == "passed", verdict.reasons
    assert [change.latency_n for change in verdict.changes] == pytest.approx(
        [change.latency_n for change in judge(played("emulator", scenario, 1)).changes], abs=3
    )


def test_program_of_a_rig_is_a_file_beside_it(tmp_path: Path) -> None:
    (tmp_path / "motor.toml").write_text((ROOT / "fixtures/programs/dc-motor.toml").read_text())
    name = described(
        tmp_path, lambda _: MOTOR.format(address="127.0.0.1:1", self_test="false").replace("dc-motor", "motor.toml")
    )
    description = describe(name)
    assert isinstance(description, RealDescription)
    assert description.patched == Program.load("dc-motor")
    with open_allowed(name) as rig, pytest.raises(ConfigurationError, match="has 'dc-motor' patched"):
        rig.perform(THESIS, 1)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ('program = "nosuch"', "no program is called 'nosuch'"),
        ('program = "two-tanks"', "inputs must be inflow and level1, input and output of the program two-tanks, not u"),
        ("scaling.full.force = 3.0", "scaling.full: there is no channel 'force': there are u and omega"),
        ("limits.dials.M = [0.0, 1.0]", "limits.dials: there is no pot 'M': there are "),
    ],
)
def test_other_program_than_its_wiring_is_one_line(line: str, said: str, tmp_path: Path) -> None:
    text = MOTOR.replace('program = "dc-motor"\n', "") if "program" in line else MOTOR
    name = described(tmp_path, lambda _: text.format(address="127.0.0.1:1", self_test="false") + line + "\n")
    with pytest.raises(ConfigurationError, match=said):
        open_allowed(name)


def test_changes_by_hand_of_a_program_that_cannot_be_dated_are_refused(tmp_path: Path) -> None:
    by_hand = MOTOR.replace('pots.kind = "instrument"', 'pots.kind = "operator"')
    name = described(tmp_path, lambda _: by_hand.format(address="127.0.0.1:1", self_test="false"))
    with open_allowed(name) as rig, pytest.raises(ConfigurationError, match="estimated from the samples, .* dc-motor"):
        rig.perform(Scenario.load("dc-motor"), 1)


# ---- the shipped tests


@pytest.mark.heavy
def test_shipped_properties_pass_on_the_real_rig(tmp_path: Path) -> None:
    with serving() as instrument:
        outside = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}  # no worker's
        environment = {**outside, "ANALOGRIG_RIGS": str(instrument.rigs_file(tmp_path))}
        result = subprocess.run(
            [
                *(sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-n", "0"),
                # The suite of the emulator plays these.
                *("-k", "not rightly_named and not computes and not computed and not converses and not misfits"),
                *("--pyargs", "analogrig.testing.properties", "--hil-rig", "bench", "--hil-dut", "inproc"),
                *("--hil-runs-dir", str(tmp_path / "runs"), "--hil-allow", instrument.address),
            ],
            cwd=tmp_path,
            env={**environment, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            check=False,
        )
    assert result.returncode == 0, result.stdout[-3000:]
    assert "25 passed, 3 skipped" in result.stdout  # what takes a million samples, and faults of a line that is none


def test_rig_with_fixed_pots_refuses_changes_beforehand(tmp_path: Path) -> None:
    name = described(tmp_path, lambda text: text.replace('pots.kind = "instrument"', 'pots.kind = "none"'))
    with open_allowed(name) as rig:
        assert "change" not in rig.capabilities
        with pytest.raises(
            ConfigurationError, match=r"changes\[0\] at sample 1200: the pots of this rig cannot be changed"
        ):
            rig.perform(THESIS, 1)


def test_run_is_inconclusive_if_the_self_test_could_not_measure_everything(tmp_path: Path) -> None:
    with serving_in_thread("inputs.noise_v=[0.0, 0.009]", rig="emulator-ideal") as instrument:
        verdict = judge(played(str(instrument.rigs_file(tmp_path, self_test=True)), THESIS, 1))
    assert verdict.outcome == "inconclusive"
    assert verdict.reasons[0].startswith("the rig's self-test: ")
