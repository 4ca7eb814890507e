"""The served LUCIDAC: with the manufacturer's own client, and message by message."""

from __future__ import annotations

import itertools
import os
import re
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

import numpy as np
import pytest
from numpy.typing import NDArray

from analogrig.errors import ConfigurationError
from analogrig.scenario import DEFAULT_SEED
from analogrig_emulator.lucidac.configuration import COEFFICIENT_STEPS
from analogrig_emulator.lucidac.machine import Lucidac
from analogrig_instruments.simulator.tcp_server import Client
from analogrig_lucidac import messages as lucidac_messages
from analogrig_lucidac.messages import FrameError, FrameReader, frame, framed, protocol
from analogrig_lucidac.served_machine import CHUNK_VALUES, MAC, LucidacServer, specimen
from tests.harness.processes import LONG_S
from tests.served.lucidac_deviations import calibrated_deviation, deviation, play, read_configuration, run_examples
from tests.served.lucidac_examples import EXAMPLES
from tests.served.serving import Served, in_thread, serving
from tests.soak.hostile_lucidac import nested, varint

CLIENT = os.environ.get("LUCIDAC_CLIENT", sys.executable)
"""Python with the manufacturer's package: make lucidac-next sets one with its newest version."""


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    with serving("--as", "lucidac") as running:
        yield running


@pytest.fixture(scope="module")
def runs(served: Served, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with what the manufacturer's client got in all examples."""
    folder = tmp_path_factory.mktemp("lucidac")
    run_examples(served.port, folder, CLIENT)
    return folder


@pytest.mark.parametrize("name", EXAMPLES)
def test_manufacturers_client_gets_the_ideal_solution_after_calibration_and_not_before(runs: Path, name: str) -> None:
    example, data = EXAMPLES[name], np.load(runs / f"{name}.npz")["data"].T
    assert data.shape == (round(example.op_s * example.sample_rate), example.channels)
    patch, machine = read_configuration(runs, name), specimen(DEFAULT_SEED)
    machine.configure(patch)
    before, after = (deviation(example, patch, values) for values in (play(machine, example), data))
    assert after < 0.01
    assert before > 0.003 and before > 3 * after


@pytest.mark.parametrize("name", ["roessler", "van-der-pol"])
def test_another_calibrated_specimen_gets_the_ideal_solution(runs: Path, name: str) -> None:
    """All examples on twelve specimens: python -m tests.bench.bandwidth_lucidac."""
    assert calibrated_deviation(specimen(5), EXAMPLES[name], read_configuration(runs, name)) < 0.01


def test_generator_comes_through_its_cables(runs: Path) -> None:
    data = np.load(runs / "sine-extra.npz")["data"][2:, :1000]
    t_s = np.arange(1000) / 1e5
    square = np.where(t_s * 1000 % 1 < 0.5, 0.7, -0.2)
    assert np.abs(data[0] + square)[np.arange(1000) % 50 > 0].max() < 0.003
    assert np.abs(data[1] + 0.2 + 0.6 * np.sin(2 * np.pi * 1000 * t_s)).max() < 0.003


def test_manufacturers_report_is_that_of_an_ideal_machine(runs: Path) -> None:
    """The report measures against a grid that ends at the end of the run; samples come at k / rate."""
    plots = np.load(runs / "report.npz")
    misses = {}
    for i, periods in enumerate((1, 10, 20)):
        left = plots[f"sin-{i}"]
        ends, instants = np.linspace(0.0, periods * 2.0 * np.pi, left.shape[1]), 1e4 * np.arange(left.shape[1]) / 31_415
        misses[f"sin, {periods} periods"] = [
            left[k] + wave(ends) - wave(instants) for k, wave in enumerate([np.cos, np.sin] * 4)
        ]
    misses["lanes"] = plots["lane-0"] + 0.56 - quantised(0.56)
    misses["multipliers"] = plots["mul-0"] + 0.56 - quantised(0.8) * quantised(0.7)
    for i, (slope, k0) in enumerate(itertools.product((1.0, 0.1, 0.01), (10_000, 100))):
        left = plots[f"itor-{i}"]
        ramp = quantised(slope) * k0 * np.arange(left.shape[1]) / 40_000
        misses[f"integrators, {slope:g} x {k0}"] = left + np.linspace(0.0, 1.0, left.shape[1]) - ramp
    most = {name: float(np.abs(values).max()) for name, values in misses.items()}
    assert len(most) == 11 and max(most.values()) < 0.002, most


def quantised(factor: float) -> float:
    return round(factor * COEFFICIENT_STEPS) / COEFFICIENT_STEPS


# ---- message by message


class Talk:
    """Client that sends and receives messages."""

    def __init__(self, served: Served) -> None:
        self._connection = served.connect()
        self._reader = FrameReader(1 << 20)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._connection.close()

    def send(self, data: bytes) -> None:
        self._connection.sendall(data)

    def next(self) -> Any:
        """Next envelope; None at the end of the connection."""
        while (content := self._reader.next()) is None:
            data = self._connection.recv(65536)
            if not data:
                return None
            self._reader.feed(data)
        return protocol().Envelope.FromString(content)

    def say(self, kind: str, message_id: str = "7", **fields: Any) -> None:
        message = protocol().MessageV1(id=message_id)
        command = getattr(message, kind)
        command.SetInParent()
        command.MergeFrom(type(command)(**fields))
        self.send(frame(message))

    def ask(self, kind: str, **fields: Any) -> Any:
        """Answer to a command: the message; others that come before it are dropped."""
        self.say(kind, "7", **fields)
        while (message := self.next().message_v1).id != "7":
            pass
        return message

    def error(self, kind: str, **fields: Any) -> str:
        message = self.ask(kind, **fields)
        assert message.WhichOneof("kind") == "error_message", message
        return str(message.error_message.description)

    def configure(self, *items: Any) -> Any:
        return self.ask("config_command", module=protocol().Module(items=items), reset_before=True)

    def start(self, samples: int, rate_hz: int, *, halt: bool = False) -> Any:
        pb = protocol()
        run = pb.RunConfig(op_time=pb.Time(value=round(samples / rate_hz * 1e9), prefix=pb.NANO), halt_on_overload=halt)
        return self.ask(
            "start_run_command", run=pb.Run(id="r"), run_config=run, daq_config=pb.DaqConfig(sample_rate=rate_hz)
        )

    def reset_when_free(self, **fields: Any) -> None:
        """Reset the machine as soon as no run keeps it busy."""
        deadline_s = time.monotonic() + LONG_S
        while self.ask("reset_command", **fields).WhichOneof("kind") == "busy_response":
            assert time.monotonic() < deadline_s

    def samples(self) -> tuple[int, list[str]]:
        """Number of samples of a run, and its states."""
        pb, count, states = protocol(), 0, []
        while True:
            message = self.next().message_v1
            assert not message.id
            if message.WhichOneof("kind") == "run_data_message":
                data = message.run_data_message.data
                assert data.sample_count * data.channel_stride <= CHUNK_VALUES and len(data.channels)
                assert len(data.data) == 2 * data.sample_count * data.channel_stride
                count += data.sample_count
            elif message.WhichOneof("kind") == "run_state_change_message":
                states.append(pb.RunState.Name(message.run_state_change_message.new_))
                if states[-1] in ("DONE", "ERROR"):
                    return count, states


PLACES = {
    "coef_config": "/0/C",
    "itor_config": "/0/M0",
    "select_config": "/0/U",
    "signal_generator_config": "/FP",
    "sum_config": "/0/I",
}


def items(path: str = "", **fields: Any) -> Any:
    """Item of one kind, for the entity that holds it or for another one."""
    pb, (kind,) = protocol(), fields
    return pb.Item(entity=pb.EntityId(path=path or MAC + PLACES.get(kind, "")), **fields)


def ramp(factor: float = -0.5) -> list[Any]:
    """Integrator 0 integrates the constant; the converter reads it on eight channels."""
    pb = protocol()
    return [
        items(coef_config=pb.CoefConfig(elements=[pb.CoefConfig.Element(idx=0, factor=factor)])),
        items(
            select_config=pb.SelectConfig(
                constant=pb.SelectConfig.POS_REF, connections=[pb.SelectConnectionConfig(input=15, output=0)]
            )
        ),
        items(sum_config=pb.SumConfig(connections=[pb.SumConnectionConfig(inputs=[0], output=0)])),
        items(adc_config=pb.AdcConfig(channels=[pb.AdcChannel(idx=0, gain=1.0, probe=i) for i in range(8)])),
    ]


@pytest.fixture
def talk(served: Served) -> Iterator[Talk]:
    with Talk(served) as client:
        yield client


def test_run_has_its_states_and_samples_and_flags_the_overload(talk: Talk) -> None:
    talk.ask("reset_command", overload_reset=True, circuit_reset=True)
    assert talk.configure(*ramp()).WhichOneof("kind") == "config_response"
    assert talk.start(5000, 62_500).WhichOneof("kind") == "start_run_response"
    assert talk.samples() == (5000, ["TAKE_OFF", "IC", "OP", "OP_END", "DONE"])
    status = talk.ask("get_overload_status_command").get_overload_status_response.status
    assert status.global_overload and [(each.entity.path, each.idx) for each in status.elements] == [
        (f"/{MAC}/0/M0", 0)
    ]
    assert talk.start(5000, 62_500, halt=True).WhichOneof("kind") == "start_run_response"
    count, states = talk.samples()
    assert 13 < count < 17 and states[-1] == "DONE"  # 1.05 units after 210 us
    talk.ask("reset_command", overload_reset=True)
    assert not talk.ask("get_overload_status_command").get_overload_status_response.status.global_overload


def test_machine_is_busy_for_others_during_a_run_and_free_when_its_client_is_gone(served: Served, talk: Talk) -> None:
    with Talk(served) as other:
        other.configure(*ramp(0.0))
        other.start(62_500 * 600, 62_500)
        for kind in ("config_command", "reset_command", "calibration_command", "start_run_command"):
            assert talk.ask(kind).WhichOneof("kind") == "busy_response"
        assert talk.ask("udp_data_streaming_command").WhichOneof("kind") == "udp_data_streaming_refused_response"
        assert "no run of this client" in talk.error("stop_run_command")
        assert other.ask("stop_run_command").WhichOneof("kind") == "success_message"
        assert other.samples()[1][-1] == "DONE"
        other.start(62_500 * 600, 62_500)
    talk.reset_when_free()


class Held(Lucidac):
    """Machine whose run computes its only block, with an overload, once it is released."""

    def __init__(self) -> None:
        super().__init__()
        self.computes, self.released = threading.Event(), threading.Event()

    def play(self, samples: int, rate_hz: float, *, halt_on_overload: bool = False) -> Iterator[NDArray[np.int16]]:
        del rate_hz, halt_on_overload
        self.computes.set()
        self.released.wait(LONG_S)
        self.overloads.add(("M0", 0))
        yield np.zeros((samples, 0), np.int16)


class Noticing(LucidacServer):
    """Server that tells when it has noticed that a client is gone."""

    def __init__(self, machine: Lucidac) -> None:
        super().__init__(machine)
        self.noticed = threading.Event()

    def release(self, client: Client) -> None:
        super().release(client)
        self.noticed.set()


def test_machine_stays_busy_until_the_thread_of_a_cancelled_run_has_ended() -> None:
    server = Noticing(machine := Held())
    with in_thread(server) as served, Talk(served) as talk:
        with Talk(served) as gone:
            gone.start(1, 1000)
            assert machine.computes.wait(LONG_S)
        assert server.noticed.wait(LONG_S)
        for _ in range(10):  # the run's task has its turns to end
            talk.ask("extract_command")
        assert talk.ask("reset_command").WhichOneof("kind") == "busy_response"
        machine.released.set()
        talk.reset_when_free(overload_reset=True)
        assert not talk.ask("get_overload_status_command").get_overload_status_response.status.global_overload


def test_stop_ends_a_paced_run_before_its_next_samples_are_due() -> None:
    """The first sample of this run would come after 1000 s."""
    machine = Lucidac()
    with in_thread(LucidacServer(machine, time.monotonic)) as served, Talk(served) as talk:
        talk.configure(*ramp(0.0))
        pb = protocol()
        config = pb.RunConfig(op_time=pb.Time(value=2000))
        talk.ask("start_run_command", run=pb.Run(id="r"), run_config=config, daq_config=pb.DaqConfig(sample_rate=1))
        assert talk.ask("stop_run_command").WhichOneof("kind") == "success_message"
        assert talk.samples()[0] == 0


def test_coefficients_can_be_written_in_op_by_the_client_of_the_run_where_the_parameter_says_so() -> None:
    with serving("--as", "lucidac", "--defect", "writes_in_op=true") as served, Talk(served) as talk:
        coefficients, *rest = ramp(0.0)
        talk.configure(coefficients, *rest)
        talk.start(62_500 * 10, 62_500)
        module = protocol().Module(items=[ramp(0.25)[0]])
        assert talk.ask("config_command", module=module).WhichOneof("kind") == "config_response"
        for more in ({"module": module, "reset_before": True}, {"module": protocol().Module(items=rest)}):
            assert talk.ask("config_command", **more).WhichOneof("kind") == "busy_response"
        with Talk(served) as other:
            assert other.ask("config_command", module=module).WhichOneof("kind") == "busy_response"
        least, state = 0, ""
        while state != "DONE" and least > -20_000:
            message = talk.next().message_v1
            state = protocol().RunState.Name(message.run_state_change_message.new_)
            least = min([0, *np.frombuffer(message.run_data_message.data.data, "<i2")])
        assert least <= -20_000


@pytest.mark.parametrize(
    ("item", "why"),
    [
        (lambda pb: items("AA-BB-CC-DD-EE-FF", adc_config=pb.AdcConfig()), "no entity is called"),
        (lambda pb: items(f"{MAC}/7/C", coef_config=pb.CoefConfig()), f"no entity is called '{MAC}/7/C'"),
        (lambda pb: items(f"{MAC}1", adc_config=pb.AdcConfig()), "no entity is called"),
        (lambda pb: items(f"{MAC}/0/M0", coef_config=pb.CoefConfig()), f"entity '{MAC}/0/M0' of a LUCIDAC has no coef"),
        (lambda pb: items(coef_config=pb.CoefConfig(elements=[pb.CoefConfig.Element(idx=32)])), "0 to 31, not 32"),
        (lambda pb: items(adc_config=pb.AdcConfig(channels=[pb.AdcChannel(idx=16)])), "output must be 0 to 15, not 16"),
        (lambda pb: items(adc_config=pb.AdcConfig(channels=[pb.AdcChannel()] * 9)), "8 channels, not 9"),
        (lambda pb: items(itor_config=pb.ItorConfig(elements=[pb.ItorConfig.Element(idx=1, k=5)])), "k0 must be"),
        (lambda pb: items(port_config=pb.PortConfig(states=[1] * 9)), "8 ports, not 9"),
        (lambda pb: items(select_config=pb.SelectConfig(constant=pb.SelectConfig.ANALOG_INPUT)), "no analogue input"),
        (lambda pb: items(select_config=pb.SelectConfig(constant=77)), "ground or a reference"),
        (lambda pb: items(switch_config=pb.SwitchConfig()), "has no switch_config"),
        (
            lambda pb: items(
                sum_config=pb.SumConfig(connections=[pb.SumConnectionConfig(inputs=[3], output=i) for i in range(2)])
            ),
            "lane 3 cannot feed two inputs",
        ),
        (
            lambda pb: items(signal_generator_config=pb.SignalGeneratorConfig(wave_form=9)),
            "signal generator: wave form",
        ),
    ],
)
def test_impossible_configuration_is_answered_with_its_error(talk: Talk, item: Any, why: str) -> None:
    assert why in talk.error("config_command", module=protocol().Module(items=[item(protocol())]))


def test_impossible_runs_and_unknown_commands_are_answered_with_an_error(talk: Talk) -> None:
    pb = protocol()
    talk.configure(*ramp())
    second = pb.RunConfig(op_time=pb.Time(value=1))
    for run, rate_hz, why in (
        (pb.RunConfig(), 1000, "op_time must be more than 0"),
        (pb.RunConfig(op_time=pb.Time(value=2**62)), 1000, "op_time must be more than 0"),
        (pb.RunConfig(op_time=pb.Time(value=1, prefix=77)), 1000, "op_time must be more than 0"),
        (second, 0, "sample_rate x channels must be 1 to 500000, not 0 x 8"),
        (second, 62_501, "sample_rate x channels must be 1 to 500000, not 62501 x 8"),
    ):
        daq = pb.DaqConfig(sample_rate=rate_hz)
        assert why in talk.error("start_run_command", run_config=run, daq_config=daq)
    assert "update_command is not supported" in talk.error("update_command")
    assert "follows no other" in talk.error("manual_control_command", to=pb.ManualControlCommand.MINION)
    assert talk.ask("manual_control_command", to=pb.ManualControlCommand.IC).WhichOneof("kind") == "success_message"


def test_configuration_can_be_extracted_and_ping_is_answered(talk: Talk) -> None:
    talk.configure(*ramp(0.25))
    module = talk.ask("extract_command", specification=True, configuration=True).extract_response.module
    assert module.items[0].entity_specification.entity.id == f"/{MAC}"
    assert any(item.coef_config.elements and item.coef_config.elements[0].factor == 0.25 for item in module.items)
    ping = protocol().Envelope()
    ping.generic.ping_command.SetInParent()
    talk.send(framed(ping))
    assert talk.next().generic.HasField("ping_response")


def test_device_keeps_one_item_of_a_kind_however_its_entity_is_written(talk: Talk) -> None:
    """A server that kept one for each way of writing would grow without end."""
    pb = protocol()
    paths = (MAC, f"/{MAC}", f"//{MAC.lower()}//")
    talk.configure(*(items(path, device_config=pb.DeviceConfig()) for path in paths))
    kept = talk.ask("extract_command", configuration=True).extract_response.module.items
    assert [item.entity.path for item in kept] == [paths[-1]]


def test_malformed_content_is_answered_and_the_connection_goes_on(talk: Talk) -> None:
    framed_contents = [varint(len(content)) + content for content in (b"", b"\xff" * 50, b"\x12\x05abc")]
    for malformed in (*framed_contents, nested(2000), nested(200_000)):
        talk.send(malformed)
        assert talk.next().message_v1.error_message.description
    assert talk.ask("extract_command", specification=True).WhichOneof("kind") == "extract_response"


@pytest.mark.parametrize("length", [1 << 20, 1 << 31, 1 << 63, (1 << 64) - 1])
def test_frame_too_long_is_answered_and_the_connection_closed(talk: Talk, length: int) -> None:
    talk.send(varint(length) + bytes(100))
    assert re.search("at most", talk.next().message_v1.error_message.description)
    assert talk.next() is None


def test_reader_gives_frames_however_the_stream_is_cut() -> None:
    contents = [b"", b"a" * 127, b"b" * 128, b"c" * 20_000]
    stream = b"".join(varint(len(content)) + content for content in contents)
    for step in (1, 7, 128, len(stream)):
        reader, found = FrameReader(), []
        for start in range(0, len(stream), step):
            reader.feed(stream[start : start + step])
            while (content := reader.next()) is not None:
                found.append(content)
        assert found == contents
    reader = FrameReader()
    reader.feed(b"\x80" * 10)
    with pytest.raises(FrameError, match="a length has at most 10 bytes"):
        reader.next()


def test_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pybrid.base.proto.main_pb2", None)
    lucidac_messages.protocol.cache_clear()
    with pytest.raises(ConfigurationError, match=re.escape("pip install 'analogrig[lucidac]'")):
        protocol()
    monkeypatch.undo()
    lucidac_messages.protocol.cache_clear()
