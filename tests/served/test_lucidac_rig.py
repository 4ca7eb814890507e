"""The rig on a LUCIDAC, against the served one."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import json
import socket
import threading
import tomllib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from analogrig import Bench, Run, Scenario, judge, open_dut, open_rig
from analogrig.catalogue import Change
from analogrig.cli import main
from analogrig.errors import ConfigurationError, RigClosed, RigError, RigRefused, RigTimeout
from analogrig.plant import Plant
from analogrig.program import Program
from analogrig.rigs.description import describe
from analogrig.scenario import DEFAULT_SEED, PotChange
from analogrig_emulator import Capacitor, Excitation, PotTurn, SuspensionComputer
from analogrig_emulator.lucidac.configuration import Configuration, SignalGenerator
from analogrig_emulator.lucidac.lucidac_circuit import FAST_FARAD
from analogrig_instruments.calibration.averages import record, scenarios
from analogrig_instruments.calibration.fit import calibrate
from analogrig_instruments.instrument import DialChange
from analogrig_instruments.real import RealRig
from analogrig_instruments.rig_wiring import RealDescription
from analogrig_instruments.self_test import self_test
from analogrig_lucidac import connection as lucidac_connection
from analogrig_lucidac.connection import LucidacConnection
from analogrig_lucidac.driver import LucidacInstrument
from analogrig_lucidac.linear_patch import LinearPatch
from analogrig_lucidac.messages import FrameReader, frame, protocol
from analogrig_lucidac.served_machine import specimen
from tests.served.serving import Served, serving

MOST_LATENCY_N = 3
"""Largest difference of a latency from that on the emulated rig."""

MOST_ERRORS = 4.0
"""Largest error of an estimate, in its standard errors."""

SQUARE = Excitation(low_v=0.02, high_v=1.98, frequency_hz=100.0)
"""Force at the generator; a machine unit, 2 V, stands for 10 V."""


DRAWN = "components.capacitors.tolerance=0.01"
"""Lanes have wrong gains and offsets of their own, which depend on their coefficients as no pot of a computer does."""


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    with serving("--as", "lucidac", "--defect", DRAWN) as running:
        yield running


@pytest.fixture
def instrument(served: Served) -> Iterator[LucidacInstrument]:
    opened = LucidacInstrument.open(served.address, 30.0)
    opened.patch("front")
    opened.set_inputs([(0, "unit"), (1, "unit")])
    opened.set_excitation(SQUARE)
    yield opened
    opened.close()


def played(rig: str, address: str) -> Run:
    with open_rig(rig, allow=[address], self_test=False) as opened, open_dut("inproc") as dut:
        return Bench(opened, dut).play(Scenario.load("thesis"), seed=7)


def test_thesis_has_the_verdict_of_the_emulated_rig(served: Served, tmp_path: Path) -> None:
    """On 20 seeds: analogrig compare-rigs emulator lucidac --plays 20."""
    verdicts = [judge(played(rig, served.address)) for rig in (served.lucidac_file(tmp_path), "emulator")]
    assert [verdict.outcome for verdict in verdicts] == ["passed", "passed"]
    latencies = [[change.latency_n for change in verdict.changes] for verdict in verdicts]
    assert np.abs(np.diff(np.array(latencies, np.float64), axis=0)).max() <= MOST_LATENCY_N


def test_self_test_finds_nothing_wrong(served: Served, tmp_path: Path) -> None:
    with open_rig(served.lucidac_file(tmp_path), allow=[served.address], self_test=False) as rig:
        assert not self_test(rig, 0, "front").reasons


def test_run_says_which_parameters_the_steps_of_the_coefficients_moved_with_a_change(
    served: Served, tmp_path: Path
) -> None:
    """A mass acts on three coefficients, a spring on one. So "several" is no wrong name for a change of the mass."""
    changes = (PotChange(600, {"M": 92.0}), PotChange(900, {"K": 19600.0}))
    scenario = dataclasses.replace(Scenario.load("thesis"), samples=1200, changes=changes)
    address = served.address
    with open_rig(served.lucidac_file(tmp_path), allow=[address], self_test=False) as rig, open_dut("inproc") as dut:
        run = Bench(rig, dut).play(scenario, seed=7)
    run.save(tmp_path / "run.npz")
    run = Run.load(tmp_path / "run.npz")
    assert [each.also for each in run.conditions.segments] == [(), ("B", "K"), ()]
    several = dataclasses.replace(run, diagnosis_change=np.full_like(run.diagnosis_change, Change.SEVERAL))
    diagnoses = [change.diagnosis for change in judge(several).changes]
    assert [each is not None and each.right for each in diagnoses] == [True, False]


class Uncalibrated(LucidacInstrument):
    def _calibrate(self) -> None:
        """Leave the machine as it was drawn."""


def test_calibration_finds_the_drawn_capacitors(served: Served, tmp_path: Path) -> None:
    """Values are those of the rounded coefficients. With the machine's own calibration nothing is left to find."""
    description = describe(served.lucidac_file(tmp_path))
    assert isinstance(description, RealDescription)
    with RealRig(dataclasses.replace(description, self_test=False), Uncalibrated.open) as rig:
        recordings = [record(rig, scenario, 0) for scenario in scenarios("front")[:7]]
    assert all(value != 24500.0 for each in recordings for value in each.scenario.set.values())
    found = calibrate(recordings, op_amp="ideal", stocks=["nominal"], pots=["coefficient"])
    machine = specimen(DEFAULT_SEED, [DRAWN])
    patch = LinearPatch(Program.load("front"))
    machine.configure(patch.configuration(recordings[0].scenario.plant.parameters(), [0.0, 0.0], SignalGenerator()))
    drawn = machine.wiring.specimen()
    for name, capacitor in (("C2", "CF0"), ("C1", "CF1")):
        each, element = found.estimate(name), drawn[capacitor]
        assert isinstance(element, Capacitor)
        deviation = element.farad / FAST_FARAD - 1.0
        assert abs(deviation) > 20.0 * each.standard_error
        assert abs(each.value - deviation) < MOST_ERRORS * each.standard_error
    assert found.explains_all and found.chi_square > found.freedom - 5.0 * (2.0 * found.freedom) ** 0.5


def test_record_is_the_program_on_an_ideal_computer_through_its_changes(instrument: LucidacInstrument) -> None:
    """Changes come where displacement and velocity are large: a wrong state at the beginning of a run shows."""
    assert instrument.pots is not None
    turns = [PotTurn(109, {"K_dial": 0.5}), PotTurn(216, {"M_dial": 0.5})]
    instrument.pots.schedule([DialChange((n + 0.05) / 20e3, "KM"[i], 0.5) for i, (n, _, _) in enumerate(turns)])
    record = instrument.record(400)
    computer = SuspensionComputer("front", opamp="ideal")
    ideal = np.concatenate(list(computer.play(dataclasses.replace(SQUARE, low_v=0.1, high_v=9.9), 400, turns)))[:, :2]
    np.testing.assert_allclose(5.0 * record.volts, ideal, atol=0.02)  # coefficients have steps
    assert not record.clipped.any() and not record.repeats


def test_change_after_the_last_sample_acts_on_the_next_record(instrument: LucidacInstrument) -> None:
    assert instrument.pots is not None
    before = instrument.record(100)
    instrument.pots.schedule([DialChange(99.05 / 20e3, "K", 0.5)])
    np.testing.assert_allclose(instrument.record(100).volts, before.volts, atol=0.002)
    assert np.abs(instrument.record(100).volts - before.volts)[:, 1].max() > 0.02


def test_record_of_a_program_with_a_squared_parameter_is_that_program(
    instrument: LucidacInstrument, tmp_path: Path
) -> None:
    (file := tmp_path / "squared.toml").write_text("""
name = "squared"
speed = 1000
channels = ["u", "x"]
equations = "x' = w**2*u - d*x"
inputs = { u = { full = 1.0, trial = [0.0, 0.1] } }
states = { x = { full = 1.2 } }
[parameters]
w = { value = 1.5, range = [1.0, 2.0] }
d = { value = 1.0, range = [0.5, 2.0] }
""")
    instrument.patch(str(file))
    computer = SuspensionComputer(Program.load(str(file)).circuit, opamp="ideal")
    ideal = np.concatenate(list(computer.play(dataclasses.replace(SQUARE, low_v=0.1, high_v=4.0), 100, [])))
    instrument.set_excitation(dataclasses.replace(SQUARE, low_v=0.02, high_v=0.8))
    np.testing.assert_allclose(5.0 * instrument.record(100).volts, ideal, atol=0.02)


def test_overload_names_the_element_and_the_run(instrument: LucidacInstrument) -> None:
    """The first run is well: it is not named."""
    assert instrument.pots is not None
    dials = {"M": 0.99, "B": 0.01, "K": 0.01}
    instrument.pots.schedule([DialChange(100.05 / 20e3, pot, dial) for pot, dial in dials.items()])
    with pytest.raises(RigError, match=r"overload of .*/0/M0/[01] in samples 100 to 1999: rescale the program"):
        instrument.record(2000)


def test_state_from_which_no_run_begins_is_one_line(
    instrument: LucidacInstrument, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between 1 and the level of the overload flags."""
    values = np.full((101, 3), 0.5)
    values[-1, 2] = 1.02
    monkeypatch.setattr(instrument._connection, "run", lambda *_: (values, np.zeros(values.shape, np.bool_)))
    assert instrument.pots is not None
    instrument.pots.schedule([DialChange(100.05 / 20e3, "K", 0.5)])
    with pytest.raises(RigError, match="stands at 1.020 machine units at the change, and no run begins beyond 1"):
        instrument.record(200)
    values[-1, 2] = 1.0009
    instrument.pots.schedule([DialChange(100.05 / 20e3, "K", 0.6)])
    assert len(instrument.record(201).volts) == 201
    values[-1, 2] = 1.02
    assert len(instrument.record(101).volts) == 101  # no run begins after the last one


def test_configuration_of_another_client_is_noticed_before_the_run(
    served: Served, instrument: LucidacInstrument, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interfere() -> None:
        other = LucidacConnection("127.0.0.1", served.port, 30.0)
        other.ask("config_command", module=protocol().Module(), reset_before=True)
        other.close()

    monkeypatch.setattr(instrument, "_calibrate", interfere)
    with pytest.raises(RigError, match="another client has changed the configuration: let only one work with"):
        instrument.record(10)


def test_generator_sleeps_between_records(served: Served, instrument: LucidacInstrument) -> None:
    def sleeps() -> bool:
        other = LucidacConnection("127.0.0.1", served.port, 30.0)
        items = other.ask("extract_command", configuration=True).extract_response.module.items
        other.close()
        return any(item.signal_generator_config.sleep for item in items)

    instrument.record(10)
    assert not sleeps()
    instrument.make_safe()
    assert sleeps()


def test_doctor_asks_whether_coefficients_can_be_written_in_op(
    instrument: LucidacInstrument, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert instrument.remarks() == ("the machine accepts no coefficients during OP: a change is a new run",)
    with serving("--as", "lucidac", "--defect", "writes_in_op=true") as other:
        assert main(["doctor", "--rig", other.lucidac_file(tmp_path), "--allow", other.address, "--json"]) == 0
    (remark,) = json.loads(capsys.readouterr().out)["remarks"]
    assert "accepts coefficients during OP" in remark


def test_answer_after_op_is_none(instrument: LucidacInstrument, monkeypatch: pytest.MonkeyPatch) -> None:
    """A device may answer once the run is over: then it did not write during OP."""
    pb, asked = protocol(), []

    def run(*_: object) -> Iterator[object]:
        asked.append(1)
        for state in (pb.RunState.OP, pb.RunState.OP_END, pb.RunState.DONE):
            yield pb.MessageV1(run_state_change_message=pb.RunStateChangeMessage(new_=state))
        yield pb.MessageV1(id="7", config_response=pb.ConfigResponse())

    monkeypatch.setattr(instrument._connection, "_messages_of_run", run)
    monkeypatch.setattr(instrument._connection, "_command", lambda *_, **__: "7")
    assert not instrument._connection.accepts_in_op(pb.Module(), 3) and len(asked) == 3


def test_busy_machine_and_refused_commands_are_one_line(served: Served, instrument: LucidacInstrument) -> None:
    other = LucidacConnection("127.0.0.1", served.port, 30.0)
    pb = protocol()
    config = pb.RunConfig(op_time=pb.Time(value=600))
    other.ask("start_run_command", run_config=config, daq_config=pb.DaqConfig(sample_rate=1000))
    with pytest.raises(RigRefused, match=r"reset_command: the device is busy with another client's run"):
        instrument.record(10)
    with pytest.raises(RigRefused, match=r"instrument .*: update_command: 'update_command is not supported'"):
        other.ask("update_command")
    other.close()


@pytest.mark.parametrize(
    ("excitation", "why"),
    [
        (Excitation("prbs", 0.0, 1.0), "the generator of a LUCIDAC has no prbs: use square"),
        (Excitation(high_v=2.1), "the generator would have to give 0 V to 2.1 V, and has -2 V to 2 V"),
        (Excitation(high_v=1.0, frequency_hz=123.0), 'on the clock "card" needs edges that are whole samples apart'),
    ],
)
def test_waveform_that_the_generator_lacks_is_refused(excitation: Excitation, why: str) -> None:
    with pytest.raises(ConfigurationError, match=why):
        LucidacInstrument.check(excitation)


# ---- programs


def nominal(program: Program) -> Plant:
    return Plant(program, tuple(row.value for row in program.parameters.values()))


def configured(patch: LinearPatch) -> Configuration:
    """Configuration for the values of the program."""
    return patch.configuration(nominal(patch.program).parameters(), [0.0] * len(patch.states), SignalGenerator())


def factors(name: str) -> dict[tuple[int, int], float]:
    """Sum of the lanes by input and output."""
    found: dict[tuple[int, int], float] = {}
    for lane in configured(LinearPatch(Program.load(name))).lanes.values():
        if lane.source is not None:
            key = (lane.target, lane.source)
            found[key] = found.get(key, 0.0) + lane.factor * lane.gain
    return found


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("front", {(0, 1): -0.2004, (1, 12): 0.256, (1, 1): 0.525, (1, 0): 0.425}),
        ("shock", {(0, 1): -0.2004, (1, 12): 7.35, (1, 1): 9.0, (1, 0): 12.225}),
    ],
)
def test_lanes_of_the_thesis_programs(name: str, expected: dict[tuple[int, int], float]) -> None:
    """Worked by hand: 200 F / (M v), 200 B / M, 200 K x / (M v), 200 v / x with full scales, over 10,000.

    Signs are those of an integrator that inverts; the force comes inverted.
    """
    found = factors(name)
    assert found.keys() == expected.keys()
    for key, factor in expected.items():
        assert found[key] == pytest.approx(factor, rel=2e-2), key


@pytest.mark.parametrize("name", ["duffing", "pendulum", "van-der-pol"])
def test_program_that_cannot_be_patched_is_one_line(name: str) -> None:
    with pytest.raises(ConfigurationError, match=f"program {name}: .* linear programs alone"):
        LinearPatch(Program.load(name))


def test_other_linear_program_fits() -> None:
    assert len(factors("dc-motor")) == 5


def test_lanes_of_ports_without_a_cable_are_free() -> None:
    table = tomllib.loads("""
name = "coupled"
speed = 90_000
channels = ["u", "a"]
equations = '''
a' = u*g - a - b - c - d
b' = a - b - c - d
c' = a + b - c
d' = a - d
'''
inputs = { u = { full = 1.0, trial = [0.0, 0.5] } }
states = { a = { full = 1.0 }, b = { full = 1.0 }, c = { full = 1.0 }, d = { full = 1.0 } }
parameters = { g = { value = 1.0, range = [0.9, 1.1] } }
""")
    lanes = configured(LinearPatch(Program.from_table(table, "coupled"))).lanes
    assert len(lanes) == 1 + 2 * 14 and lanes[26].source is None


@pytest.mark.parametrize("name", ["front", "shock", "dc-motor"])
def test_rounded_values_have_the_response_of_the_rounded_coefficients(name: str) -> None:
    """The response is computed by hand from the lanes: poles of the patch, and its gain, by machine time."""
    program = Program.load(name)
    patch = LinearPatch(program)
    plant = nominal(program)
    rounded = plant.changed(patch.rounded(plant.parameters()))
    assert rounded.values != plant.values
    n, lanes = len(patch.states), factors(name)
    matrix = np.array([[-lanes.get((i, j), 0.0) for j in range(n)] for i in range(n)])
    k0 = np.array([each.k0 for each in configured(patch).integrators[:n]])
    poles = np.linalg.eigvals(k0[:, None] * matrix) / program.equations.speed
    expected = np.poly(poles)[:0:-1]
    response = rounded.response()
    np.testing.assert_allclose([response[f"s{i}"] for i in range(n)], expected, rtol=1e-9 if n == 2 else 2e-3)


def test_program_whose_output_has_no_integrator_is_one_line() -> None:
    with pytest.raises(ConfigurationError, match="program two-mass: its output 'displacement' is no state"):
        LinearPatch(Program.load("two-mass"))


# ---- a device that misbehaves


@pytest.mark.parametrize(
    ("said", "why"),
    [(b"", "connection closed"), (b"\xff" * 20, "at most"), (b"\x03\xff\xff\xff", "sent no message of this protocol")],
)
def test_malformed_device_is_one_line(said: bytes, why: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def answer() -> None:
            connection, _ = listening.accept()
            connection.recv(65536)
            connection.sendall(said)
            connection.close()

        thread = threading.Thread(target=answer)
        thread.start()
        with pytest.raises(RigError, match=why) as caught:
            LucidacInstrument.open(f"127.0.0.1:{listening.getsockname()[1]}", 30.0)
        thread.join()
    assert str(caught.value).startswith("instrument 127.0.0.1:")


def test_unreachable_device_is_one_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
    with pytest.raises(RigClosed, match="cannot be reached"):
        LucidacInstrument.open(f"127.0.0.1:{port}", 30.0)


def test_address_of_version_6_is_shown_in_brackets(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError("refused")

    monkeypatch.setattr(socket, "create_connection", refuse)
    with pytest.raises(RigClosed, match=r"instrument \[::1\]:5732: cannot be reached: refused"):
        LucidacInstrument.open("[::1]", 30.0)


def test_data_of_another_form_is_refused(served: Served) -> None:
    connection = LucidacConnection("127.0.0.1", served.port, 30.0)
    pb = protocol()
    good = pb.DaqData(data=bytes(8), sample_count=2, channel_stride=2)
    good.type.integer.bitwidth = 16
    good.channels.add(gain=1.0, probe=1)
    good.channels.add(gain=1.0, probe=0)
    assert connection._samples(good, 2)[0].shape == (2, 2)
    for change in (
        {"sample_count": 2**31},
        {"channel_stride": 1},
        {"type": pb.DataType(integer=pb.IntegerType(bitwidth=12))},
        {"channels": [pb.AdcChannel(gain=1.0, probe=7)] * 2},
    ):
        fields = {
            "data": bytes(8),
            "sample_count": 2,
            "channel_stride": 2,
            "type": good.type,
            "channels": good.channels,
        }
        with pytest.raises(RigError, match="sent"):
            connection._samples(pb.DaqData(**{**fields, **change}), 2)
    connection.close()


class Peer:
    """Device that answers each command as ``answers`` does, and notes the kinds of the commands."""

    def __init__(self, answers: Callable[[Any], Iterable[Any]]) -> None:
        self.heard: list[str] = []
        self._answers = answers
        self._listening = socket.create_server(("127.0.0.1", 0))
        self._thread = threading.Thread(target=self._serve)

    def __enter__(self) -> LucidacConnection:
        self._thread.start()
        self._connection = LucidacConnection("127.0.0.1", self._listening.getsockname()[1], 0.5)
        return self._connection

    def __exit__(self, *_: object) -> None:
        self._connection.close()
        self._thread.join()
        self._listening.close()

    def _serve(self) -> None:
        reader = FrameReader()
        with contextlib.suppress(OSError), self._listening.accept()[0] as client:
            while data := client.recv(65536):
                reader.feed(data)
                while (content := reader.next()) is not None:
                    command = protocol().Envelope.FromString(content).message_v1
                    self.heard.append(str(command.WhichOneof("kind")))
                    for answer in self._answers(command):
                        client.sendall(frame(answer))


def entered(state: str) -> Any:
    pb = protocol()
    return pb.MessageV1(run_state_change_message=pb.RunStateChangeMessage(new_=pb.RunState.Value(state)))


def a_run_with(*messages: Any) -> Callable[[Any], Iterator[Any]]:
    """Answers of a device whose run sends these messages and then operates until it is stopped."""
    pb = protocol()

    def answers(command: Any) -> Iterator[Any]:
        if command.HasField("start_run_command"):
            yield pb.MessageV1(id=command.id, start_run_response=pb.StartRunResponse())
            yield from (entered("OP"), *messages)
        elif command.HasField("stop_run_command"):
            yield from (pb.MessageV1(id=command.id, success_message=pb.SuccessMessage()), entered("DONE"))
        elif command.HasField("extract_command"):
            yield pb.MessageV1(id=command.id, extract_response=pb.ExtractResponse())

    return answers


def samples(count: int) -> Any:
    pb = protocol()
    data = pb.DaqData(data=bytes(2 * count), sample_count=count, channel_stride=1, channels=[pb.AdcChannel(gain=1.0)])
    data.type.integer.bitwidth = 16
    return pb.MessageV1(run_data_message=pb.RunDataMessage(data=data))


@pytest.mark.parametrize(
    ("messages", "failure", "why"),
    [
        ([], RigTimeout, "the run: no answer within 0.5 s"),
        ([samples(0)] * 20, RigTimeout, "the run: no answer within 0.5 s"),
        ([protocol().MessageV1(run_data_message=protocol().RunDataMessage())], RigError, "a form that was not asked"),
        ([samples(10_000), samples(10_000)], RigError, "sends more than the 10 samples"),
        ([protocol().MessageV1(ping_command=protocol().PingCommand())], KeyboardInterrupt, "by the user"),
    ],
    ids=["silent", "empty data", "malformed", "too many", "interrupted"],
)
def test_run_that_is_given_up_is_stopped(
    messages: list[Any], failure: type[BaseException], why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    peer = Peer(a_run_with(*messages))
    with peer as connection:
        if failure is KeyboardInterrupt:
            interrupt_at(connection, "ping_command", monkeypatch)
        with pytest.raises(failure, match=why):
            connection.run(10, 1000, 1)
        connection.ask("extract_command")
    assert peer.heard == ["start_run_command", "stop_run_command", "extract_command"]


def test_samples_and_end_of_an_earlier_run_are_not_taken_for_those_of_this_one() -> None:
    stale, end, own = samples(10), entered("DONE"), samples(10)
    stale.run_data_message.run.id = end.run_state_change_message.run.id = "earlier"
    own.run_data_message.data.data = bytes((1, 0)) * 10
    with Peer(a_run_with(stale, end, own, entered("DONE"))) as connection:
        np.testing.assert_array_equal(connection.run(10, 1000, 1)[0], np.ones((10, 1)))


def test_device_that_ignores_the_stop_costs_a_limited_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lucidac_connection, "_STOP_S", 0.2)
    run = a_run_with()
    peer = Peer(lambda command: [] if command.HasField("stop_run_command") else run(command))
    with peer as connection, pytest.raises(RigTimeout, match="the run: no answer within 0.5 s"):
        connection.run(10, 1000, 1)
    assert peer.heard == ["start_run_command", "stop_run_command"]


def interrupt_at(connection: LucidacConnection, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Raise KeyboardInterrupt where the connection gets a message of a kind."""
    following = connection._next

    def interrupting(what: str, deadline_s: float) -> Any:
        message = following(what, deadline_s)
        if message.WhichOneof("kind") == kind:
            raise KeyboardInterrupt("by the user")
        return message

    monkeypatch.setattr(connection, "_next", interrupting)


def test_only_data_with_samples_extend_the_time_out(
    instrument: LucidacInstrument, monkeypatch: pytest.MonkeyPatch
) -> None:
    connection, clock, deadlines = instrument._connection, itertools.count(), []
    sent = iter([samples(0), samples(0), samples(4), entered("DONE")])

    def following(_: str, deadline_s: float) -> Any:
        deadlines.append(deadline_s)
        return next(sent)

    monkeypatch.setattr(connection, "ask", lambda *_, **__: None)
    monkeypatch.setattr(connection, "_clock", lambda: float(next(clock)))
    monkeypatch.setattr(connection, "_next", following)
    assert len(connection.run(4, 1000, 1)[0]) == 4
    assert deadlines[0] == deadlines[1] == deadlines[2] < deadlines[3]


def test_run_of_another_client_is_not_stopped() -> None:
    pb = protocol()
    peer = Peer(lambda command: [pb.MessageV1(id=command.id, busy_response=pb.DeviceBusyMessage())])
    with peer as connection, pytest.raises(RigRefused, match="busy with another client's run"):
        connection.run(10, 1000, 1)
    assert peer.heard == ["start_run_command"]


def test_configuration_is_read_back_without_what_a_calibration_changes() -> None:
    """A device that refuses tells nothing."""
    pb, asked = protocol(), itertools.count()

    def answers(command: Any) -> Iterator[Any]:
        number = next(asked)
        element = pb.CoefConfig.Element(factor=0.5 if number < 2 else 0.25, gain_correction=1.0 + 0.01 * number)
        items = [
            pb.Item(coef_config=pb.CoefConfig(elements=[element])),
            pb.Item(mul_config=pb.MulConfig(calibration=[pb.MulConfig.Calibration(gain=number)])),
        ]
        told = {"extract_response": pb.ExtractResponse(module=pb.Module(items=items))}
        yield pb.MessageV1(id=command.id, **told if number < 3 else {"error_message": pb.ErrorMessage()})

    with Peer(answers) as connection:
        first, second, third, fourth = (connection.configuration() for _ in range(4))
    assert first == second != third and fourth == {}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"\0", "sent no message of this protocol; is a LUCIDAC at this address"),
        (frame(protocol().MessageV1(id="of another")), "no answer within 0.5 s"),
    ],
    ids=["empty", "of another"],
)
def test_peer_that_sends_frames_without_end_is_given_up(content: bytes, message: str) -> None:
    def flood() -> None:
        with contextlib.suppress(OSError), listening.accept()[0] as client:
            while True:
                client.sendall(100 * content)

    with socket.create_server(("127.0.0.1", 0)) as listening:
        thread = threading.Thread(target=flood)
        thread.start()
        connection = LucidacConnection("127.0.0.1", listening.getsockname()[1], 0.5)
        with pytest.raises(RigError, match=message):
            connection.carrier()
        connection.close()
        thread.join()


def test_silence_of_a_device_that_has_told_its_kind_raises_no_doubt(instrument: LucidacInstrument) -> None:
    assert instrument._connection._silence("the run").endswith("the run: no answer within 30 s")


def test_coefficient_that_rounds_to_nothing_is_refused() -> None:
    patch = LinearPatch(Program.load("front"))
    values = {name: row.value for name, row in patch.program.parameters.items()}
    with pytest.raises(ConfigurationError, match="below half a step of 1/2048"):
        patch.configuration({**values, "B": 1e-3}, [0.0, 0.0], SignalGenerator("sine and square"))
