"""No file has anything executed, loaded or connected to unless the command line allows that very thing.

Every kind of thing, in every kind of file that can name it, through every command that reads such a file. A witness
shows what happened: a library whose constructor leaves a file, programs that leave a file, a listening socket that
counts connections, a terminal that knows whether it was opened.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import fcntl
import json
import os
import pickle
import re
import select
import shlex
import shutil
import socket
import sqlite3
import struct
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol, get_args

import pytest

from analogrig import config
from analogrig.campaigns.plan import Plan
from analogrig.campaigns.spec import CampaignSpec
from analogrig.campaigns.store import Store
from analogrig.cli import main
from analogrig.devices.can import CanDevice
from analogrig.devices.port import SerialDevice
from analogrig.devices.registry import KINDS, describe, from_table, named_things, open_dut, reopen_dut
from analogrig.errors import ConfigurationError
from analogrig.rigs.description import open_rig
from analogrig.run import Run
from analogrig.scenario import Scenario
from analogrig.testing.counterexample import Counterexample
from analogrig.trust import FiledName, Thing, Trust, resolve_name
from analogrig_instruments.instrument import DRIVERS
from analogrig_instruments.pots import InstrumentPots, PotsDescription
from analogrig_instruments.rig_wiring import Input, RealDescription
from tests.harness.commands import error_of
from tests.served.serving import serving

pytestmark = pytest.mark.filterwarnings("ignore:Exception ignored in. <_io:pytest.PytestUnraisableExceptionWarning")
"""The spy:// of pyserial does not close its file."""

REFUSED = 2
"""Exit status: usage or configuration."""

LONG_S = 60.0
"""For what comes at once unless something is broken."""

SCENARIO = """\
samples = 400
{head}
[excitation]
low_v = 0.1
high_v = 9.9
frequency_hz = 200.0
"""

RIG = """\
kind = "real"
instrument = "redpitaya://{address}"
timeout_s = 1.0
self_test = false
generator.gain = 10.0
inputs.force = {{ input = 1, range = "HV" }}
inputs.displacement = {{ input = 2, range = "HV" }}
"""


# ------------------------------------------------------------------------------------------------------- the witnesses


_OPEN = contextlib.ExitStack()
"""Witnesses of the test, closed at its end."""


class Witness(Protocol):
    def happened(self) -> bool:
        """True if the thing was loaded, run or connected to since the beginning."""


@dataclasses.dataclass
class LeavesFile:
    """Witness of code that leaves a file when it runs."""

    path: Path

    def happened(self) -> bool:
        return self.path.exists()


class Listens:
    """A port at which connections are counted; nobody takes them."""

    def __init__(self) -> None:
        self.socket = _OPEN.enter_context(socket.create_server(("127.0.0.1", 0)))
        self.port = int(self.socket.getsockname()[1])

    def happened(self) -> bool:
        return bool(select.select([self.socket], [], [], 0.0)[0])


class Terminal:
    """A pseudo-terminal: that its other end was opened shows as data from it or as its hanging up."""

    GET_NUMBER, SET_LOCK = 0x80045430, 0x40045431
    """TIOCGPTN and TIOCSPTLCK of Linux: openpty() would open the other end itself."""

    def __init__(self) -> None:
        self.fd = os.open("/dev/ptmx", os.O_RDWR | os.O_NOCTTY)
        _OPEN.callback(os.close, self.fd)
        fcntl.ioctl(self.fd, self.SET_LOCK, struct.pack("i", 0))
        (number,) = struct.unpack("i", fcntl.ioctl(self.fd, self.GET_NUMBER, struct.pack("i", 0)))
        self.path = f"/dev/pts/{number}"

    def happened(self) -> bool:
        watched = select.poll()
        watched.register(self.fd, select.POLLIN)
        return bool(watched.poll(0))


@dataclasses.dataclass(frozen=True)
class Bait:
    """A thing that a file names."""

    allow: str
    """Value of --allow."""
    witness: Witness
    name: str = ""
    """Name of a device in a scenario or a campaign; empty for a rig."""
    toml: str = ""
    """File of the device or the rig."""
    besides: tuple[str, ...] = ()
    """Options that allow whatever stands before the thing."""


@pytest.fixture(scope="session")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its constructor creates the file that TRUST_WITNESS names."""
    folder = tmp_path_factory.mktemp("library")
    (folder / "evil.c").write_text(
        "#include <fcntl.h>\n#include <stdlib.h>\n"
        "__attribute__((constructor)) static void loaded(void)\n"
        '{ const char *path = getenv("TRUST_WITNESS"); if (path) { (void)creat(path, 0600); } }\n'
    )
    subprocess.run(["cc", "-shared", "-fPIC", "-o", "evil.so", "evil.c"], cwd=folder, check=True)
    return folder / "evil.so"


@pytest.fixture(scope="session")
def instrument() -> Iterator[str]:
    """The address of an instrument that answers."""
    with serving("--port", "0") as running:
        yield running.address


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Working directory of the user; the files are in its folder ``theirs``. Code that runs may leave ``witness``."""
    for variable in [name for name in os.environ if name.startswith("ANALOGRIG_") and name != "ANALOGRIG_FIRMWARE"]:
        monkeypatch.delenv(variable)
    monkeypatch.setenv("TRUST_WITNESS", str(tmp_path / "witness"))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "theirs").mkdir()
    with _OPEN:
        yield tmp_path


def executable(path: Path) -> Path:
    """A program that leaves the witness, and fails."""
    path.write_text('#!/bin/sh\n: > "$TRUST_WITNESS"\nexit 1\n')
    path.chmod(0o755)
    return path


# ---- devices


def a_library(folder: Path, monkeypatch: pytest.MonkeyPatch, library: Path) -> Bait:  # noqa: ARG001
    shutil.copyfile(library, folder / "theirs" / "evil.so")  # another file: it has not been loaded yet
    return Bait(
        "./theirs/evil.so",
        LeavesFile(folder / "witness"),
        "inproc:evil.so",
        'kind = "inproc"\nlibrary = "./evil.so"\n',
    )


def a_firmware(folder: Path, monkeypatch: pytest.MonkeyPatch, library: Path) -> Bait:  # noqa: ARG001
    """QEMU here is a program that leaves the witness."""
    (folder / "bin").mkdir()
    executable(folder / "bin" / "qemu-system-arm")
    monkeypatch.setenv("PATH", f"{folder / 'bin'}:{os.environ['PATH']}")
    (folder / "theirs" / "my.elf").write_bytes(b"\x7fELF")
    return Bait(
        "./theirs/my.elf",
        LeavesFile(folder / "witness"),
        "qemu-m4:my.elf",
        'kind = "qemu-m4"\nfirmware = "my.elf"\n',
    )


def a_terminal(folder: Path, monkeypatch: pytest.MonkeyPatch, library: Path) -> Bait:  # noqa: ARG001
    witness = Terminal()
    toml = f'kind = "serial"\nurl = "{witness.path}"\ntimeout_s = 0.1\n'
    return Bait(witness.path, witness, f"serial:{witness.path}", toml)


def a_url(folder: Path, monkeypatch: pytest.MonkeyPatch, library: Path) -> Bait:  # noqa: ARG001
    witness = Listens()
    url = f"socket://127.0.0.1:{witness.port}"
    return Bait(url, witness, f"serial:{url}", f'kind = "serial"\nurl = "{url}"\ntimeout_s = 0.1\n')


def a_spied_url(folder: Path, monkeypatch: pytest.MonkeyPatch, library: Path) -> Bait:  # noqa: ARG001
    """The spy:// of pyserial writes a file as soon as its URL is taken apart, before the port is opened."""
    url = f"spy:///dev/null?file={folder / 'witness'}"
    toml = f'kind = "serial"\nurl = "{url}"\ntimeout_s = 0.1\n'
    return Bait(url, LeavesFile(folder / "witness"), f"serial:{url}", toml)


def a_can_adapter(folder: Path, monkeypatch: pytest.MonkeyPatch, library: Path) -> Bait:  # noqa: ARG001
    witness = Terminal()
    toml = f'kind = "can"\ninterface = "slcan"\nchannel = "{witness.path}"\ntimeout_s = 0.1\n'
    toml += "[options]\nsleep_after_open = 0.0\n"
    name = f"can:slcan/{witness.path}?sleep_after_open=0.0"
    return Bait(name, witness, name, toml)


def a_can_server(folder: Path, monkeypatch: pytest.MonkeyPatch, library: Path) -> Bait:  # noqa: ARG001
    """An adapter at a URL, with an option of python-can: the option is part of what is allowed."""
    witness = Listens()
    toml = 'kind = "can"\ninterface = "serial"\ntimeout_s = 0.1\n'
    toml += f'channel = "socket://127.0.0.1:{witness.port}"\n[options]\nbaudrate = 9600\n'
    name = f"can:serial/socket://127.0.0.1:{witness.port}?baudrate=9600"
    return Bait(name, witness, name, toml)


def a_python_module(folder: Path, monkeypatch: pytest.MonkeyPatch, library: Path) -> Bait:  # noqa: ARG001
    """Calling its function leaves the witness; it is imported by the first test that allows it."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    (folder / "evil_estimator.py").write_text(
        "import os, pathlib\ndef make():\n    pathlib.Path(os.environ['TRUST_WITNESS']).touch()\n"
    )
    name = "python:evil_estimator:make"
    toml = 'kind = "python"\nfactory = "evil_estimator:make"\ndatasheet.theta_n = 6\n'
    return Bait(name, LeavesFile(folder / "witness"), name, toml)


DEVICES = (a_library, a_firmware, a_terminal, a_url, a_spied_url, a_can_adapter, a_can_server, a_python_module)


# ---- rigs


def an_instrument(folder: Path, address: Callable[[], str]) -> Bait:  # noqa: ARG001
    witness = Listens()
    toml = RIG.format(address=f"127.0.0.1:{witness.port}") + 'pots.kind = "instrument"\n'
    return Bait(f"127.0.0.1:{witness.port}", witness, toml=toml)


def a_command(folder: Path, address: Callable[[], str]) -> Bait:
    executable(folder / "theirs" / "setpot")
    pots = 'pots = { kind = "command", arguments = ["./setpot", "{pot}", "{dial}"] }\n'
    toml = RIG.format(address=address()) + pots
    return Bait("./theirs/setpot", LeavesFile(folder / "witness"), toml=toml, besides=("--allow", address()))


def pots_at(folder: Path, address: Callable[[], str], url: str, witness: Witness) -> Bait:  # noqa: ARG001
    pots = f'kind = "serial", url = "{url}", line = "{{pot}} {{dial}}", reply = "ok", timeout_s = 0.1'
    toml = RIG.format(address=address()) + f"pots = {{ {pots} }}\n"
    return Bait(url, witness, toml=toml, besides=("--allow", address()))


def pots_at_a_terminal(folder: Path, address: Callable[[], str]) -> Bait:
    witness = Terminal()
    return pots_at(folder, address, witness.path, witness)


def pots_at_a_url(folder: Path, address: Callable[[], str]) -> Bait:
    witness = Listens()
    return pots_at(folder, address, f"socket://127.0.0.1:{witness.port}", witness)


def pots_at_a_spied_url(folder: Path, address: Callable[[], str]) -> Bait:
    return pots_at(folder, address, f"spy:///dev/null?file={folder / 'witness'}", LeavesFile(folder / "witness"))


RIGS = (an_instrument, a_command, pots_at_a_terminal, pots_at_a_url, pots_at_a_spied_url)


# ------------------------------------------------------------------------------------------- the files and the commands


def written(name: str, text: str) -> str:
    path = Path("theirs") / name
    path.write_text(text)
    return str(path)


def recording(recorded: Path, name: str, **conditions: Any) -> str:
    """A recording with other conditions."""
    run = Run.load(recorded)
    path = Path("theirs") / name
    dataclasses.replace(run, conditions=dataclasses.replace(run.conditions, **conditions)).save(path)
    return str(path)


def device_file(bait: Bait) -> str:
    return written("device.toml", bait.toml)


def recorded_device(bait: Bait, recorded: Path) -> str:
    """A recording of a run with the device."""
    description = from_table({"name": "it", **tomllib.loads(bait.toml)}, "it")
    return recording(recorded, "run.npz", dut={**description.as_table(), "identity": {}})


def scenario_of(bait: Bait, recorded: Path) -> str:  # noqa: ARG001
    return written("scenario.toml", SCENARIO.format(head=f'dut = "{bait.name}"'))


def scenario_of_file(bait: Bait, recorded: Path) -> str:  # noqa: ARG001
    device_file(bait)
    return written("scenario.toml", SCENARIO.format(head='dut = "device.toml"'))


def recorded_scenario(bait: Bait, recorded: Path) -> str:
    """A recording of a scenario that names the device."""
    table = {**Run.load(recorded).conditions.scenario, "dut": bait.name}
    return f"recording:{recording(recorded, 'run.npz', scenario=table)}"


def campaign_of(bait: Bait, name: str) -> list[str]:
    spec = f'scenario = "healthy"\nsamples = 700\ntrials = 1\ndevices = ["{name}"]\n'
    device_file(bait)
    return ["campaign", written("campaign.toml", spec), "--workers", "1", "--out", "build/campaign.sqlite"]


def certify(*words: str) -> list[str]:
    return ["certify", *words, "--far", "0.01", "--confidence", "0.9", "--workers", "1"]


DEVICE_ROUTES: dict[str, Callable[[Bait, Path], list[str]]] = {
    "run, device file": lambda bait, _: ["run", "--dut", device_file(bait)],
    "run, scenario": lambda bait, recorded: ["run", "--scenario", scenario_of(bait, recorded)],
    "run, scenario and device file": lambda bait, recorded: ["run", "--scenario", scenario_of_file(bait, recorded)],
    "run, scenario in a recording": lambda bait, recorded: ["run", "--rig", recorded_scenario(bait, recorded)],
    "replay, recording": lambda bait, recorded: ["replay", recorded_device(bait, recorded)],
    "replay, device file": lambda bait, recorded: ["replay", str(recorded), "--dut", device_file(bait)],
    "campaign, campaign file": lambda bait, _: campaign_of(bait, bait.name),
    "campaign, device file": lambda bait, _: campaign_of(bait, "device.toml"),
    "certify, device file": lambda bait, _: certify("--dut", device_file(bait)),
    "compare-rigs, device file": lambda bait, _: [
        *("compare-rigs", "emulator", "emulator", "--plays", "2", "--dut", device_file(bait))
    ],
}


def rig_file(bait: Bait) -> str:
    return written("rig.toml", bait.toml)


def rigs_file(bait: Bait) -> str:
    """The rig ``bench`` in a file of several."""
    lines = [f"[rig.bench]\n{bait.toml}", '[rig.other]\nkind = "emulator"\n']
    return written("rigs.toml", "\n".join(lines))


def scenario_on(bait: Bait) -> str:
    rig_file(bait)
    return written("scenario.toml", SCENARIO.format(head='rig = "rig.toml"'))


def campaign_on(bait: Bait) -> list[str]:
    rig_file(bait)
    spec = 'scenario = "healthy"\nsamples = 700\ntrials = 1\nrigs = ["rig.toml"]\ndevices = ["host"]\n'
    return ["campaign", written("campaign.toml", spec), "--workers", "1", "--out", "build/campaign.sqlite"]


def here(bait: Bait) -> str:
    """The rig ``bench`` of a rigs.toml in the folder where the user is."""
    text = Path(rigs_file(bait)).read_text().replace('"./setpot"', '"./theirs/setpot"')
    Path("rigs.toml").write_text(text)
    return "bench"


RIG_ROUTES: dict[str, Callable[[Bait], list[str]]] = {
    "run, rig file": lambda bait: ["run", "--dut", "inproc", "--rig", rig_file(bait)],
    "run, table of a rigs file": lambda bait: ["run", "--dut", "inproc", "--rig", f"{rigs_file(bait)}:bench"],
    "run, rigs.toml here": lambda bait: ["run", "--dut", "inproc", "--rig", here(bait)],
    "run, scenario": lambda bait: ["run", "--dut", "inproc", "--scenario", scenario_on(bait)],
    "emulate, rig file": lambda bait: ["emulate", "--rig", rig_file(bait), "--scenario", "healthy"],
    "emulate, scenario": lambda bait: ["emulate", "--scenario", scenario_on(bait)],
    "campaign, campaign file": campaign_on,
    "certify, rig file": lambda bait: certify("--dut", "inproc", "--rig", rig_file(bait)),
    "compare-rigs, A": lambda bait: ["compare-rigs", rig_file(bait), "emulator", "--plays", "2", "--dut", "inproc"],
    "compare-rigs, B": lambda bait: ["compare-rigs", "emulator", rig_file(bait), "--plays", "2", "--dut", "inproc"],
    "doctor, rig file": lambda bait: ["doctor", "--rig", rig_file(bait)],
    "calibrate, rig file": lambda bait: ["calibrate", "--rig", rig_file(bait)],
}

UNPLAYED_ROUTES: dict[str, Callable[[Bait], list[str]]] = {
    "netlist, rig file": lambda bait: ["netlist", "--rig", rig_file(bait)],
    "netlist, scenario": lambda bait: ["netlist", "--scenario", scenario_on(bait)],
    "judge, rig file": lambda bait: ["judge", "no.log", "--scenario", "healthy", "--rig", rig_file(bait)],
    "replay, rig file": lambda bait: [
        *("replay", "no.log", "--scenario", "healthy", "--dut", "host", "--rig", rig_file(bait))
    ],
}
"""Commands that read such a file, and get no further with a real rig or a log that is not there."""


def check_refused(argv: list[str], bait: Bait, capsys: pytest.CaptureFixture[str]) -> None:
    """One line that names the option, and nothing happens."""
    capsys.readouterr()
    assert main(argv) == REFUSED
    out, err = capsys.readouterr()
    assert out == ""
    line, end = err[:-1], err[-1]
    assert end == "\n" and line.startswith("analogrig: theirs/") | line.startswith("analogrig: rigs.toml")
    assert line.isprintable()
    assert "which no file may order: pass --allow " in line
    assert shlex.split(line.rpartition(": pass ")[2])[-2:] == ["--allow", bait.allow]
    assert not bait.witness.happened()


@pytest.mark.parametrize("route", DEVICE_ROUTES)
@pytest.mark.parametrize("kind", DEVICES)
def test_what_a_file_names_as_device_is_opened_only_if_the_command_line_allows_it(
    kind: Callable[..., Bait],
    route: str,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    library: Path,
    recorded_thesis: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    bait = kind(folder, monkeypatch, library)
    argv = DEVICE_ROUTES[route](bait, recorded_thesis)
    check_refused(argv, bait, capsys)
    check_refused([*argv, "--allow", "./theirs", "--allow", "device.toml", "--allow", "127.0.0.1"], bait, capsys)
    if kind is a_library or route == "run, device file":  # every route and every kind is opened once
        main([*argv, "--allow", bait.allow])
        assert bait.witness.happened()


@pytest.mark.parametrize("route", RIG_ROUTES)
@pytest.mark.parametrize("kind", RIGS)
def test_what_a_file_names_as_rig_is_opened_only_if_the_command_line_allows_it(
    kind: Callable[..., Bait],
    route: str,
    folder: Path,
    request: pytest.FixtureRequest,
    capsys: pytest.CaptureFixture[str],
) -> None:
    bait = kind(folder, lambda: request.getfixturevalue("instrument"))
    argv = [*RIG_ROUTES[route](bait), *bait.besides]
    check_refused(argv, bait, capsys)
    if kind is an_instrument or route == "run, rig file":  # every route and every kind is opened once
        main([*argv, "--allow", bait.allow])
        assert bait.witness.happened()


@pytest.mark.parametrize("route", UNPLAYED_ROUTES)
@pytest.mark.parametrize("kind", RIGS)
def test_command_that_only_reads_a_rig_refuses_its_file_too(
    kind: Callable[..., Bait],
    route: str,
    folder: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    bait = kind(folder, lambda: "127.0.0.1:9")
    argv = [*UNPLAYED_ROUTES[route](bait), *bait.besides]
    check_refused(argv, bait, capsys)
    if "spy:" not in bait.allow:
        assert main([*argv, "--allow", bait.allow]) == REFUSED
        assert "may order" not in capsys.readouterr().err
        assert not bait.witness.happened()


@pytest.mark.parametrize("kind", RIGS)
def test_serve_serves_no_real_rig(kind: Callable[..., Bait], folder: Path) -> None:
    bait = kind(folder, lambda: "127.0.0.1:9")
    assert error_of("serve", "--port", "0", "--rig", rig_file(bait), status=REFUSED).count("\n") == 1
    assert not bait.witness.happened()


def test_rigs_file_of_the_environment_is_a_file(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bait = an_instrument(folder, str)
    monkeypatch.setenv("ANALOGRIG_RIGS", rigs_file(bait))
    monkeypatch.setenv("ANALOGRIG_RIG", "bench")
    check_refused(["doctor"], bait, capsys)
    main(["doctor", "--allow", bait.allow])
    assert bait.witness.happened()


# -------------------------------------------------------------------------------------------------- what may be trusted


def lose_patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten the time-out of devices that no file describes: nobody answers them."""
    for described in (SerialDevice, CanDevice):
        defaults = described.__init__.__kwdefaults__
        assert defaults
        monkeypatch.setitem(defaults, "timeout_s", 0.1)


@pytest.mark.parametrize("kind", [kind for kind in DEVICES if kind is not a_firmware])
@pytest.mark.parametrize("through", ["--dut", "ANALOGRIG_DUT"])
def test_device_that_the_command_line_or_the_environment_names_is_opened(
    kind: Callable[..., Bait], through: str, folder: Path, monkeypatch: pytest.MonkeyPatch, library: Path
) -> None:
    lose_patience(monkeypatch)
    bait = kind(folder, monkeypatch, library)
    name = bait.name.replace("inproc:", "inproc:theirs/")
    if through == "--dut":
        main(["run", "--dut", name])
    else:
        monkeypatch.setenv(through, name)
        main(["run"])
    assert bait.witness.happened()


def test_thing_that_the_command_line_names_is_trusted_where_a_file_names_it_too(folder: Path) -> None:
    """The pots of a rig at the port that --dut names."""
    trust = Trust(option="--allow").also(named_things("serial:/dev/ttyACM0"))
    trust.check((Thing("serial port", "/dev/ttyACM0", "pots open the serial port"),), "bench.toml")
    with pytest.raises(ConfigurationError, match=r"pass --allow /dev/ttyACM1$"):
        trust.check((Thing("serial port", "/dev/ttyACM1", "pots open the serial port"),), "bench.toml")
    (folder / "board.toml").write_text('kind = "serial"\nurl = "/dev/ttyACM1"\n')
    assert named_things("board.toml") == ()


def test_shipped_rig_red_pitaya_may_connect_to_this_machine(folder: Path) -> None:  # noqa: ARG001
    with open_rig("red-pitaya", allow=Trust()) as rig:
        assert rig.description()["instrument"] == "redpitaya://127.0.0.1"
    for kind in ("devices", "rigs"):
        for name in config.names(kind):
            if kind == "rigs":
                open_rig(name, allow=Trust()).__exit__(None, None, None)
            else:
                assert describe(name).things == ()


def test_copy_of_a_shipped_rig_is_a_file_like_any_other(folder: Path) -> None:
    shutil.copyfile(config.fixtures() / "rigs" / "red-pitaya.toml", folder / "red-pitaya.toml")
    with pytest.raises(ConfigurationError, match="connects to 127.0.0.1:5000, which no file may order"):
        open_rig("./red-pitaya.toml")


@pytest.mark.parametrize(
    "toml",
    [
        'kind = "inproc"\n',
        'kind = "host"\n',
        'kind = "qemu-m3"\n',
        'kind = "can"\ninterface = "virtual"\nchannel = "here"\n',
        'kind = "can"\ninterface = "virtual"\nbitrate = 500000\n[options]\nreceive_own_messages = true\n',
        'kind = "inproc"\nbaud = 9600\nwire_faults = "flip@0.001,seed=7"\nexchange = "stream"\n',
    ],
)
def test_what_analogrig_ships_needs_no_option(folder: Path, toml: str) -> None:
    (folder / "device.toml").write_text(toml)
    assert describe("device.toml").things == ()


def test_names_are_compared_as_they_are_and_paths_where_they_lead(folder: Path) -> None:
    (folder / "real.so").touch()
    (folder / "link.so").symlink_to("real.so")
    loads = Thing("library", str(folder / "theirs" / ".." / "link.so"), "the device loads the library")
    for name in ("real.so", "./link.so", str(folder / "real.so")):
        Trust([name]).check((loads,), "x.toml")
    for name in ("other.so", "", ".", "inproc:real.so"):
        with pytest.raises(ConfigurationError):
            Trust([name]).check((loads,), "x.toml")
    for allowed, wanted in (("bench:5000", "bench:5001"), ("can:socketcan/can0", "can:socketcan/can0?x=1")):
        at = Thing("address", wanted, "the rig connects to")
        Trust([wanted]).check((at,), "x.toml")
        with pytest.raises(ConfigurationError):
            Trust([allowed]).check((at,), "x.toml")


def test_command_without_a_path_is_allowed_by_its_name_alone(folder: Path) -> None:
    toml = RIG.format(address="bench") + 'pots = { kind = "command", arguments = ["setpot", "{pot}", "{dial}"] }\n'
    (folder / "rig.toml").write_text(toml)
    (folder / "setpot").touch()
    for wrong in ("./setpot", "/usr/bin/setpot"):
        with pytest.raises(ConfigurationError, match=re.escape("pots run the command setpot '{pot}' '{dial}'")):
            open_rig("rig.toml", allow=["bench:5000", wrong])
    open_rig("rig.toml", allow=["bench:5000", "setpot"]).__exit__(None, None, None)


def test_all_that_a_file_names_is_refused_in_one_line_with_all_options(folder: Path) -> None:
    (folder / "theirs" / "rig.toml").write_text(
        RIG.format(address="[::1]") + 'pots = { kind = "command", arguments = ["./set pot", "{pot}", "{dial}"] }\n'
    )
    with pytest.raises(ConfigurationError) as caught:
        open_rig("theirs/rig.toml", allow=Trust(option="--allow"))
    assert str(caught.value) == (
        "theirs/rig.toml: the rig connects to [::1]:5000 and pots run the command './theirs/set pot' '{pot}' '{dial}',"
        " which no file may order: pass --allow '[::1]:5000' --allow './theirs/set pot'"
    )


@pytest.mark.parametrize("name", ["evil\\n.so", "\\u001b[2Jevil.so", "a" * 5000])
def test_name_that_no_terminal_shows_is_refused_in_one_line_whatever_is_allowed(folder: Path, name: str) -> None:
    (folder / "device.toml").write_text(f'kind = "inproc"\nlibrary = "{name}"\n')
    library = describe("device.toml").things[0].name
    with pytest.raises(ConfigurationError) as caught:
        open_dut("device.toml", allow=[library])
    assert str(caught.value).isprintable() and len(str(caught.value)) < 500
    assert "no option can name" in str(caught.value)


# ----------------------------------------------------------------------------------------------- places and other doors


def test_relative_path_is_relative_to_the_file_that_names_it(folder: Path) -> None:
    """Not to where the user is: there is another of that name."""
    for name in ("lib.so", "theirs/lib.so"):
        (folder / name).touch()
    written("device.toml", 'kind = "inproc"\nlibrary = "lib.so"\n')
    written("scenario.toml", SCENARIO.format(head='dut = "inproc:lib.so?exchange=block"\nrig = "rig.toml:bench"'))
    written("campaign.toml", 'scenario = "scenario.toml"\nrigs = ["rig.toml"]\ndevices = ["inproc:lib.so", "inproc"]\n')
    scenario, spec = Scenario.load("theirs/scenario.toml"), CampaignSpec.load("theirs/campaign.toml")
    expected = str(folder / "theirs" / "lib.so")
    for name in ("theirs/device.toml", scenario.dut, spec.devices[0]):
        assert [thing.name for thing in describe(name).things] == [expected]
    assert scenario.rig == "theirs/rig.toml:bench"
    assert (spec.scenario, spec.rigs) == ("theirs/scenario.toml", ("theirs/rig.toml",))
    assert resolve_name(Path("theirs/scenario.toml"), "recording:run.npz") == "recording:theirs/run.npz"
    assert [thing.name for thing in describe("inproc:lib.so").things] == [str(folder / "lib.so")]


def test_name_of_a_file_remembers_it_through_copies(folder: Path) -> None:  # noqa: ARG001
    name = FiledName("inproc:evil.so", "theirs/scenario.toml")
    for copied in (copy.copy(name), copy.deepcopy(name), pickle.loads(pickle.dumps(name))):  # noqa: S301 - our own
        assert copied == "inproc:evil.so" and copied.file == "theirs/scenario.toml"
    written("scenario.toml", SCENARIO.format(head='dut = "inproc:evil.so"'))
    scenario = dataclasses.replace(Scenario.load("theirs/scenario.toml"), samples=100)
    with pytest.raises(ConfigurationError, match="scenario.toml: the device loads the library"):
        open_dut(scenario.dut)


def test_functions_of_python_take_what_is_allowed(folder: Path, library: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bait = a_library(folder, monkeypatch, library)
    with pytest.raises(ConfigurationError, match=re.escape("order: pass allow=['./theirs/evil.so']")):
        open_dut(device_file(bait))
    with pytest.raises(ConfigurationError, match="no file may order"):
        Plan.of(CampaignSpec.load(campaign_of(bait, bait.name)[1]))
    with pytest.raises(ConfigurationError, match="no file may order"):
        reopen_dut(describe(device_file(bait)).as_table(), "run.npz")
    assert not bait.witness.happened()
    with pytest.raises(ConfigurationError, match="is no library of a device"):
        open_dut(device_file(bait), allow="theirs/evil.so")
    assert bait.witness.happened()


def test_name_in_the_code_counts_like_the_command_line(
    folder: Path, library: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bait = a_library(folder, monkeypatch, library)
    with pytest.raises(ConfigurationError, match="is no library of a device"):
        open_dut("inproc:theirs/evil.so")
    assert bait.witness.happened()


@pytest.mark.parametrize("workers", [("--workers", "2"), ("--cluster", "")])
def test_campaign_is_checked_before_there_are_workers(
    folder: Path,
    library: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    workers: tuple[str, str],
) -> None:
    bait, scheduler = a_library(folder, monkeypatch, library), Listens()
    argv = campaign_of(bait, bait.name)
    argv[2:4] = [workers[0], workers[1] or f"tcp://127.0.0.1:{scheduler.port}"]
    check_refused(argv, bait, capsys)
    assert not scheduler.happened()


def test_worker_plays_on_the_rig_that_was_checked_whatever_its_file_says_by_then(folder: Path) -> None:
    from analogrig.campaigns.plan import open_table, rig_table

    checked, other = an_instrument(folder, str), an_instrument(folder, str)
    table = json.loads(json.dumps(rig_table(rig_file(checked), [checked.allow])))
    rig_file(other)
    with open_table(table) as rig:
        assert rig.description()["instrument"] == f"redpitaya://{checked.allow}"


def test_store_of_a_campaign_opens_nothing(folder: Path, library: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bait = a_library(folder, monkeypatch, library)
    argv = campaign_of(bait, "inproc")
    assert main(argv) == 0
    results = Path("build/campaign.sqlite")
    with contextlib.closing(sqlite3.connect(results)) as file:
        (text,) = file.execute("SELECT plan FROM campaign").fetchone()
        forged_text = re.sub(r'"kind": ?"inproc"', '"kind":"inproc","library":"theirs/evil.so"', text)
        assert forged_text != text
        file.execute("UPDATE campaign SET plan = ?", (forged_text,))
        file.commit()
    main(["compare", str(results), str(results)])
    main(argv)
    results.unlink()
    plan = Plan.of(CampaignSpec.load(argv[1]))
    forged = dataclasses.replace(plan, devices=({**plan.devices[0], "library": "theirs/evil.so"},))
    Store.write(results, forged).close()
    assert main(argv) == REFUSED
    assert not bait.witness.happened()


def test_counterexample_repeats_with_what_it_names_allowed(folder: Path, recorded_thesis: Path) -> None:
    """From any folder: its files hold absolute paths, and its command allows them."""
    run, library = Run.load(recorded_thesis), folder / "theirs" / "my.so"
    device = describe("inproc:theirs/my.so").as_table()
    rig = dataclasses.asdict(config.build(RealDescription, rig_of_a_command(folder), "rig"))
    conditions = dataclasses.replace(run.conditions, dut={**device, "identity": {}}, rig={**rig, "name": "bench"})
    left = Counterexample(dataclasses.replace(run, conditions=conditions), dut="inproc:theirs/my.so")
    left.write(folder / "left", page=False)
    assert config.read_toml(folder / "left" / "dut.toml")["library"] == str(library)
    named = ["--allow", "bench:5000", "--allow", "./theirs/setpot"]
    assert shlex.split(left.command(Path("left/scenario.toml")))[-6:] == ["--dut", "inproc:theirs/my.so", *named]
    suite = shlex.split(left.suite_command(Path("left")))
    assert suite[-6::2] == ["--hil-allow"] * 3
    assert suite[-5::2] == ["./theirs/my.so", "bench:5000", "./theirs/setpot"]


def rig_of_a_command(folder: Path) -> dict[str, Any]:
    bait = a_command(folder, lambda: "bench")
    return tomllib.loads(bait.toml.replace("./setpot", str(folder / "theirs" / "setpot")))


def test_recorded_rig_is_never_opened(folder: Path, recorded_thesis: Path) -> None:
    bait = an_instrument(folder, str)
    table = {**tomllib.loads(bait.toml), "name": "bench"}
    file = recording(recorded_thesis, "run.npz", rig=table)
    for argv in (["judge", file], ["replay", file, "--dut", "inproc"], ["run", "--rig", f"recording:{file}"]):
        assert main(argv) in (0, 1)
    assert not bait.witness.happened()


def test_every_kind_of_device_and_pots_states_its_things() -> None:
    """A new kind must say what it opens: none inherits that it opens nothing."""
    harmless = {"host"}
    assert {kind for kind, cls in KINDS.items() if "things" not in vars_of(cls)} == harmless
    pots = {cls.__name__ for cls in get_args(PotsDescription) if not isinstance(cls.__dict__.get("things"), property)}
    assert pots == {"OperatorPots", "NoPots", "InstrumentPots"}
    inputs = {"force": Input(input=1, range="HV"), "displacement": Input(input=2, range="HV")}
    things = {"redpitaya://bench": "bench:5000", "nidaqmx://Dev1": "nidaqmx://Dev1", "lucidac://box": "box:5732"}
    assert {url.partition(":")[0] for url in things} == set(DRIVERS)
    for url, name in things.items():
        assert RealDescription("real", url, inputs, InstrumentPots("instrument")).things[0].name == name


def vars_of(cls: type) -> set[str]:
    """Names that the class or one between it and DeviceDescription defines."""
    return {name for each in cls.__mro__ if each.__name__ != "DeviceDescription" for name in vars(each)}
