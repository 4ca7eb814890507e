"""`analogrig serve`: the instrument in another process, over TCP, with third-party clients."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import pyvisa

from analogrig.cli import main
from analogrig.program import Program
from analogrig.rigs.description import open_rig
from analogrig.rigs.emulator import EmulatorRig
from analogrig.scenario import Scenario
from analogrig.signals import ENDING
from analogrig_emulator import Excitation
from analogrig_instruments.simulator.scpi import Interpreter
from analogrig_instruments.simulator.served import ServedDescription
from tests.harness.processes import LONG_S
from tests.served.serving import ServedByProcess, ended, serving
from tests.served.talk import POINT_SAMPLES, SEQUENCE, asking, front, record, say

LSB_V = 40.0 / 2**14


@pytest.fixture(scope="module")
def served() -> Iterator[ServedByProcess]:
    """Server of the ideal rig."""
    with serving("--rig", "emulator-ideal") as served:
        yield served


@pytest.fixture
def visa(served: ServedByProcess) -> Iterator[pyvisa.resources.MessageBasedResource]:
    """PyVISA resource, opened as programs for the real instrument do."""
    manager = pyvisa.ResourceManager("@py")
    address = f"TCPIP::127.0.0.1::{served.port}::SOCKET"
    opened = manager.open_resource(address, read_termination="\r\n", write_termination="\r\n", timeout=1e3 * LONG_S)
    assert isinstance(opened, pyvisa.resources.MessageBasedResource)
    yield opened
    opened.close()
    manager.close()


def test_pyvisa_drives_the_published_sequence_and_reads_both_channels(
    visa: pyvisa.resources.MessageBasedResource,
) -> None:
    """In ASCII and in blocks of IEEE 488.2, and both are the volts of the emulator with ideal amplifiers."""
    for line in POINT_SAMPLES:
        visa.write(line)
    assert visa.query("ACQ:TRig:STAT?") == "TD" and visa.query("ACQ:TRig:FILL?") == "1"
    texts = [visa.query_ascii_values(f"ACQ:SOUR{n}:DATA?", converter=lambda v: float(v.strip("{}"))) for n in (1, 2)]
    visa.write("ACQ:DATA:FORMAT BIN")
    blocks = [visa.query_binary_values(f"ACQ:SOUR{n}:DATA?", datatype="f", is_big_endian=True) for n in (1, 2)]
    assert visa.query("SYST:ERR?") == '0,"No error"'
    with open_rig("emulator-ideal") as rig:
        assert isinstance(rig, EmulatorRig)
        computer = rig.set_up(Scenario.load("healthy"), 0).computer
    played = np.concatenate(list(computer.play(Excitation("square", 0.1, 9.9, 100.0, clock="free"), 16384)))
    for channel in (0, 1):
        assert np.abs(np.array(texts[channel]) - played[:, channel]).max() < 0.5 * LSB_V + 6e-5
        assert np.abs(np.array(blocks[channel]) - played[:, channel]).max() < 0.5 * LSB_V + 1e-6


def test_pyvisa_turns_pots(visa: pyvisa.resources.MessageBasedResource) -> None:
    names = visa.query("POT:CATalog?").split(",")
    visa.write(f"POT{1 + names.index('K')}:DIAL 0.5")
    assert float(visa.query("POT3:DIAL?")) == pytest.approx(0.5, abs=1e-3)
    visa.write(f"POT3:DIAL {front(20e3).dials['K']:.9f}")


@pytest.mark.parametrize("rig", ["emulator", "emulator-real"])
@pytest.mark.parametrize("plant", ["front", "shock"])
def test_served_computer_has_the_components_of_the_emulated_rig_with_the_same_seed(rig: str, plant: str) -> None:
    scenario = Scenario.load("shock" if plant == "shock" else "healthy")
    with open_rig(rig) as opened:
        assert isinstance(opened, EmulatorRig)
        emulated = [opened.set_up(scenario, seed).computer.circuit for seed in (1, 2)]
    described = ServedDescription.load(rig)
    served = [described.set_up(Program.load(plant), seed)._computer._computer.circuit for seed in (1, 2)]
    assert [circuit.elements for circuit in served] == [circuit.elements for circuit in emulated]
    assert served[0].elements != served[1].elements


def test_noise_depends_on_the_seed_alone() -> None:
    description = ServedDescription.load("emulator-ideal", ["inputs.noise_v=[0.01,0.01]"])

    def noisy(seed: int) -> np.ndarray:
        ask = asking(Interpreter(description.set_up(Program.load("front"), seed).commands))
        say(ask, SEQUENCE)
        return record(ask)

    assert np.array_equal(noisy(1), noisy(1))
    assert not np.array_equal(noisy(1), noisy(2))


def test_faults_of_the_card_are_added_to_the_instrument_and_others_are_named() -> None:
    """Faults of emulator-skewed: displacement 10 us after force; 1 LSB rms of 12 V and of 10 V on 12 bits."""
    description = ServedDescription.load("emulator-skewed", ["inputs.skew_s=2e-6", "inputs.noise_v=[0.0,0.004]"])
    inputs = description.combined_instrument().inputs
    assert inputs.skew_s == pytest.approx(12e-6)
    assert inputs.noise_v == pytest.approx((12 / 4096, np.hypot(10 / 4096, 0.004)))
    assert description.unsupported == ()
    assert "card.levels_lsb" in ServedDescription.load("emulator-real").unsupported


# ---- the command


def test_first_line_names_rig_and_address() -> None:
    command = [sys.executable, "-m", "analogrig.cli", "serve", "--port", "0", "--program", "shock", "--seed", "7"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        process.kill()
    start, _, port = line.rstrip("\n").rpartition(":")
    assert start == "rig emulator (shock, seed 7) at 127.0.0.1" and int(port) > 0


@pytest.mark.parametrize("sign", ENDING)
def test_signal_ends_the_server_and_closes_connections(sign: signal.Signals) -> None:
    with serving() as served:
        client = served.client()
        client.say(*SEQUENCE)
        assert client.ask("OUTPUT1:STATE?") == "ON"
        served.process.send_signal(sign)
        assert client.rest() == b""
        assert ended(served, [130]) == "analogrig: interrupted\n"
        client.close()


def test_json_has_the_same_content(served: ServedByProcess) -> None:
    address = f"127.0.0.1:{served.port}"
    place = {"host": "127.0.0.1", "port": served.port, "address": address}
    assert served.said == {"rig": "emulator-ideal", "program": "front", "seed": 1995, **place}


def test_server_listens_on_the_loopback_interface_only(served: ServedByProcess) -> None:
    """/proc/net/tcp: 0100007F is 127.0.0.1, state 0A is listening."""
    rows = [row.split() for row in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    assert [row[1] for row in rows if row[3] == "0A" and row[1].endswith(f":{served.port:04X}")] == [
        f"0100007F:{served.port:04X}"
    ]


def test_faults_of_the_instrument_can_be_given_in_a_file(tmp_path: Path) -> None:
    path = tmp_path / "bench.toml"
    ideal = (Path(__file__).parents[2] / "fixtures" / "rigs" / "emulator-ideal.toml").read_text()
    path.write_text(f"{ideal}\n[instrument.wiring]\nswapped = true\nforce = {{ gain = -1.0 }}\n")
    with serving("--rig", str(path), "--defect", "acquisition.half_filled=true") as served:
        client = served.client()
        client.say(*SEQUENCE)
        first = client.ask("ACQ:SOUR2:DATA?").strip("{}").split(",")
        assert float(first[0]) == pytest.approx(-9.9, abs=LSB_V)
        assert set(first[8192:]) == {"0"}
        client.close()


def status_of(*options: str) -> int:
    """Run the command in this process; it fails before it serves."""
    try:
        return main(["serve", *options])
    except SystemExit as usage:
        return int(usage.code or 0)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--rig", "bench"], "no rig is called 'bench'"),
        (["--defect", "swapped"], "--defect swapped: Expected '='"),
        (["--defect", "wiring.swopped=true"], "instrument: wiring: unknown key 'swopped'"),
        (["--defect", "inputs.skew_s=1"], "instrument: inputs: skew_s must be -0.001 to 0.001, not 1"),
        (["--defect", "acquisition.drop_out='now'"], "instrument: acquisition: drop_out: must be one of 'none'"),
        (["--defect", "wiring.force.limits_v=[1,0]"], "force: limits_v must be (low, high), not (1, 0)"),
        (["--host", "192.0.2.1"], "cannot listen at 192.0.2.1:0"),
        (["--host", ""], "cannot listen: the host is empty"),
        (["--port", "65536"], "argument --port: must be a whole number from 0 to 65535"),
        (["--program", "rear"], "no program is called 'rear'"),
    ],
)
def test_unusable_description_is_one_line_and_status_2(
    options: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert status_of("--port", "0", *options) == 2
    out, wrong = capsys.readouterr()
    assert out == "" and wrong.count("\n") == 1 and said in wrong


def test_port_in_use_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert status_of("--port", str(port)) == 2
    assert f"cannot listen at 127.0.0.1:{port}" in capsys.readouterr().err
