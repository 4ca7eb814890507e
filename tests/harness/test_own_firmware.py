"""Firmwares with habits of their own under `analogrig run`, each a process behind a pseudo-terminal."""

from __future__ import annotations

import contextlib
import socket
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from analogrig import Bench, Scenario, open_rig
from analogrig.campaigns.together import direct_bench
from analogrig.cli import main
from analogrig.config import to_toml
from analogrig.devices.registry import from_table
from analogrig.rigs.emulator import is_emulated
from analogrig.run import Run
from tests.harness.library_builds import FAULTY, build
from tests.harness.processes import LONG_S

HEAD = """\
import os, sys
out = lambda text: os.write(1, text.encode())
"""

FIRMWARES: dict[str, tuple[str, dict[str, Any], list[int], str]] = {
    # program, device file, alarms, a line of the summary
    "CR and LF in two writes": ("for line in sys.stdin: out('0\\r'); out('\\n')", {}, [], "PASSED"),
    "CR alone": ("for line in sys.stdin: out('0\\r')", {}, [], "PASSED"),
    "prompt": ("out('> ')\nfor line in sys.stdin: out('0\\r\\n> ')", {"prompt": "> "}, [], "PASSED"),
    "JSON": (
        "for line in sys.stdin: out('{\"alarm\": false}\\r\\n')",
        {"receive": '{{"alarm":{alarm:b}}}\n'},
        [],
        "PASSED",
    ),
    "boot": (
        "out('boot\\r\\n0\\r\\nREADY\\r\\n')\nfor line in sys.stdin: out('0\\r\\n')",
        {"starting_s": 60.0, "banner": "READY"},
        [],
        "PASSED",
    ),
    "a flag with a hold time": (
        "for n, line in enumerate(sys.stdin): out('1\\n' if 300 <= n < 350 else '0\\n')",
        {"alarm_is": "level"},
        [300],
        "1 false alarm, at most 0 expected",
    ),
    "the same flag as events": (
        "for n, line in enumerate(sys.stdin): out('1\\n' if 300 <= n < 350 else '0\\n')",
        {},
        list(range(300, 350)),
        'alarms in 50 samples in a row, from sample 300 on: if the device holds its alarm, set alarm_is = "level"',
    ),
    "a state": (
        "for n, line in enumerate(sys.stdin): out(('TRIP' if n > 379 else 'WARN' if n > 99 else 'RUN') + '\\n')",
        {"receive": "{alarm:s}\n", "alarm_is": ["TRIP"]},
        [380],
        "1 false alarm",
    ),
    "wrong answers": (
        "for n, line in enumerate(sys.stdin): out('busy\\n' * (n == 40) + '0\\n')",
        {},
        [],
        "on the line: 1 line other",
    ),
}


@pytest.fixture
def short(tmp_path: Path) -> Path:
    file = tmp_path / "short.toml"
    excitation = {"shape": "square", "low_v": 0.1, "high_v": 5.0, "frequency_hz": 200.0}
    file.write_text(to_toml({"samples": 400, "program": "front", "excitation": excitation}))
    return file


@pytest.mark.parametrize("name", FIRMWARES)
def test_firmware_under_run(
    name: str, short: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    program, table, alarms, told = FIRMWARES[name]
    monkeypatch.chdir(tmp_path)
    Path("firmware.py").write_text(HEAD + program)
    arguments = ["python3", "firmware.py"]
    device = {"kind": "exec", "arguments": arguments, "pty": True, "timeout_s": LONG_S, **table}
    Path("device.toml").write_text(to_toml(device))
    status = main(["run", "--dut", "device.toml", "--allow", "python3", "--scenario", str(short)])
    assert told in capsys.readouterr().out
    assert status == (1 if alarms else 0)
    assert Run.load(Path("build/run/run.npz")).alarm_index.tolist() == alarms


@contextlib.contextmanager
def board() -> Iterator[str]:
    """Board that starts when its port is opened: it hears nothing before its banner."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def run() -> None:
            line, _ = server.accept()
            with line:
                line.settimeout(0.2)
                with contextlib.suppress(TimeoutError):
                    line.recv(65536)
                line.settimeout(None)
                line.sendall(b"READY\r\n")
                rest = b""
                while received := line.recv(4096):
                    *samples, rest = (rest + received).split(b"\n")
                    line.sendall(b"".join(sample.split(b",")[0] + b",0\r\n" for sample in samples))

        thread = threading.Thread(target=run)
        thread.start()
        yield f"socket://127.0.0.1:{server.getsockname()[1]}"
        thread.join(LONG_S)


@pytest.mark.parametrize("banner", ["READY", ""])
def test_board_that_starts_when_its_port_is_opened_loses_no_sample(short: Path, banner: str) -> None:
    table = {"send": "{index:d},{u:d},{y:d}\n", "receive": "{index:d},{alarm:d}\n", "echo": "index"}
    starting_s = LONG_S if banner else 2.0
    with board() as url, open_rig("emulator") as rig:
        described = from_table(
            {"kind": "lines", "name": "bob", "url": url, "starting_s": starting_s, "banner": banner, **table}, "bob"
        )
        with described.connect() as device:
            run = Bench(rig, device).play(Scenario.load(str(short)), seed=1)
    assert not run.conditions.faults
    assert not run.flags.any()


OBJECTS: dict[str, tuple[str, Any, list[int]]] = {
    "flag, as a level": ("300 <= self.n < 350", "level", [300]),
    "flag, as events": ("300 <= self.n < 350", "event", list(range(300, 350))),
    "word": ("'FAULT' if 300 <= self.n < 350 else 'RUN'", ["FAULT", "TRIP"], [300]),
    "words in turn": ("{300: 'FAULT', 301: 'TRIP', 303: 'TRIP'}.get(self.n, 'RUN')", ["FAULT", "TRIP"], [300, 303]),
    "number": ("3 if self.n in (10, 11, 20) else 1", [3], [10, 20]),
    "number of an answer": ("{'alarm': 3 if self.n in (10, 11, 20) else 1}", [3], [10, 20]),
}


@pytest.mark.parametrize("in_process", [False, True])
@pytest.mark.parametrize("name", OBJECTS)
def test_level_or_state_of_a_python_object_is_one_alarm(
    short: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, *, in_process: bool
) -> None:
    returned, alarm_is, alarms = OBJECTS[name]
    step = f"        self.n += 1\n        return {returned}\n"
    (tmp_path / "held_flag.py").write_text(f"class Held:\n    n = -1\n    def step(self, u, y, valid):\n{step}")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "held_flag", raising=False)
    table = {"kind": "python", "name": "bob", "factory": "held_flag:Held", "alarm_is": alarm_is}
    described = from_table({**table, "in_process": in_process}, "bob.toml")
    with open_rig("emulator") as rig, described.connect() as device:
        run = Bench(rig, device).play(Scenario.load(str(short)), seed=1)
    assert run.alarm_index.tolist() == alarms


@pytest.mark.parametrize(("alarm_is", "alarms"), [("level", [99, 199, 299, 399]), ([2], [])])
def test_level_or_state_of_a_library_is_one_alarm(
    short: Path, tmp_path: Path, alarm_is: Any, alarms: list[int]
) -> None:
    """The library raises its alarm, 1, at every hundredth sample."""
    library = build(tmp_path / "faulty.so", FAULTY)
    described = from_table({"kind": "library", "name": "bob", "library": str(library), "alarm_is": alarm_is}, "bob")
    scenario = Scenario.load(str(short))
    with open_rig("emulator") as rig:
        assert is_emulated(rig)
        bench = direct_bench(rig, described)
        with bench.dut:
            (run,) = bench.play_all(scenario, [1])
        with described.connect() as device:
            again = Bench(rig, device).play(scenario, seed=1)
    assert run.alarm_index.tolist() == again.alarm_index.tolist() == alarms
