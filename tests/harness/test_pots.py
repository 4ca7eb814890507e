"""Pots set by a command, a box on a serial line or an operator: real processes, real terminals."""

from __future__ import annotations

import os
import pty
import shlex
import signal
import sys
import threading
import tty
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from analogrig import config
from analogrig.errors import ConfigurationError, RigError
from analogrig_instruments.instrument import Pots
from analogrig_instruments.pots import OperatorPots, PotsDescription
from tests.harness.processes import LONG_S, ends

DIALS = {"K": 0.6380, "B": 0.8152}
KINDS = "kind: must be one of 'instrument', 'command', 'serial', 'operator', 'none', not "
WORDS = "K 18000 N/m, B 3453 N s/m"


@dataclass(frozen=True)
class Rig:
    pots: PotsDescription


def described(**table: Any) -> PotsDescription:
    return config.build(Rig, {"pots": table}, "rigs.toml: rig.bench").pots


def opened(**table: Any) -> Pots:
    return described(**table).open()


# ---- what a description may say


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({}, "missing key 'kind'"),
        ({"kind": "comand"}, KINDS + "'comand'"),
        ({"kind": ["command"]}, KINDS + "['command']"),
        ({"kind": "command"}, "missing key 'arguments'"),
        ({"kind": "command", "arguments": []}, "arguments must begin with the program"),
        ({"kind": "command", "arguments": ["set", "{pot}"]}, "arguments must have {pot}, and {dial} or {step}, in it"),
        ({"kind": "command", "arguments": ["set", "{pot}", "{dail}"]}, "arguments: unknown placeholder {dail}"),
        ({"kind": "command", "arguments": ["set-{pot}", "{pot} {dial}"]}, "without placeholders, not 'set-{pot}'"),
        ({"kind": "command", "arguments": ["set {pot} {dial}"], "shell": True}, "unknown key 'shell'"),
        ({"kind": "command", "arguments": ["{pot} {dial}"], "timeout_s": 0}, "timeout_s must be more than 0"),
        ({"kind": "command", "arguments": ["{pot} {dial}"], "steps": 1}, "steps must be 2 to"),
        ({"kind": "serial", "line": "{pot} {dial}"}, "missing key 'url'"),
        ({"kind": "serial", "url": "/dev/null", "line": "{pot}"}, "line must have {pot}, and {dial} or {step}, in it"),
        (
            {"kind": "serial", "url": "/dev/null", "line": "{pot} {dial}", "reply": "{ok}"},
            "reply: unknown placeholder {ok}",
        ),
        ({"kind": "operator", "timeout_s": 3}, "unknown key 'timeout_s'"),
    ],
)
def test_wrong_description_is_one_line_that_names_the_key(table: Mapping[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError) as raised:
        described(**table)
    assert str(raised.value).startswith("rigs.toml: rig.bench: pots")
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


def test_error_names_the_keys_of_the_chosen_kind_only() -> None:
    with pytest.raises(ConfigurationError) as raised:
        described(kind="serial", url="/dev/null", line="{pot} {dial}", retries=3)
    known = "steps, names, timeout_s, kind, url, baud, line, reply"
    assert str(raised.value) == f"rigs.toml: rig.bench: pots: unknown key 'retries' (known: {known})"


# ---- a command


def script(folder: Path, body: str) -> list[str]:
    """Program that appends its arguments to a file, one call a line, and then runs ``body``."""
    program = folder / "set_pot.py"
    program.write_text(
        f"import os, sys, time\nopen({str(folder / 'calls')!r}, 'a').write(repr(sys.argv[1:]) + '\\n')\n{body}"
    )
    return [sys.executable, str(program)]


def calls(folder: Path) -> list[str]:
    return (folder / "calls").read_text().splitlines()


def test_command_receives_each_pot_and_its_dial(tmp_path: Path) -> None:
    pots = opened(
        kind="command", arguments=[*script(tmp_path, ""), "--pot={pot}", "{dial}", "{step}"], names={"K": "2"}
    )
    pots.set(DIALS, WORDS, recording=False)
    pots.set({"K": 1.0}, WORDS, recording=True)
    assert calls(tmp_path) == [
        "['--pot=2', '0.6380', '163']",
        "['--pot=B', '0.8152', '208']",
        "['--pot=2', '1.0000', '255']",
    ]


@pytest.mark.parametrize(
    ("kind", "standing"),
    [
        ({"kind": "command", "arguments": ["set", "{pot}", "{step}"], "steps": 101}, {"K": 0.64, "B": 0.82}),
        ({"kind": "command", "arguments": ["set", "{pot}", "{dial}"]}, {"K": 0.6380, "B": 0.8152}),
        ({"kind": "serial", "url": "loop://", "line": "{pot} {step}", "steps": 11}, {"K": 0.6, "B": 0.8}),
        ({"kind": "none"}, {"K": 0.63801, "B": 0.81524}),
    ],
)
def test_pots_stand_at_a_step_or_a_decimal(kind: Mapping[str, Any], standing: Mapping[str, float]) -> None:
    pots = opened(**kind)
    assert pots.standing({"K": 0.63801, "B": 0.81524}) == pytest.approx(standing)
    pots.close()


def test_no_shell_interprets_the_arguments(tmp_path: Path) -> None:
    pots = opened(kind="command", arguments=[*script(tmp_path, ""), "{pot}", "{dial}; touch $HOME/x && `id` {oops"])
    pots.set({"K": 0.5}, WORDS, recording=True)
    assert calls(tmp_path) == ["['K', '0.5000; touch $HOME/x && `id` {oops']"]


def test_failed_command_is_an_error_with_status_and_output(tmp_path: Path) -> None:
    body = "print('no such pot'); sys.stderr.write('try 1 to 4\\n'); sys.exit(7)"
    pots = opened(kind="command", arguments=[*script(tmp_path, body), "{pot}", "{dial}"])
    with pytest.raises(RigError) as raised:
        pots.set(DIALS, WORDS, recording=True)
    assert str(raised.value).startswith("pot K to 0.6380: ")
    assert "ended with status 7, output: " in str(raised.value)
    assert "no such pot" in str(raised.value) and "try 1 to 4" in str(raised.value)
    assert "\n" not in str(raised.value)
    assert len(calls(tmp_path)) == 1, "the pot after one that failed was not to be touched"


def test_killed_command_is_an_error_with_the_signal(tmp_path: Path) -> None:
    body = f"os.kill(os.getpid(), {int(signal.SIGKILL)})"
    pots = opened(kind="command", arguments=[*script(tmp_path, body), "{pot}", "{dial}"])
    with pytest.raises(RigError, match="ended with signal 9"):
        pots.set({"K": 0.5}, WORDS, recording=True)


def test_hanging_command_is_killed_with_its_children(tmp_path: Path) -> None:
    hanging = f"sleep 600 & echo $$ $! > {shlex.quote(str(tmp_path / 'pids'))}; wait"  # a shell is up at once
    pots = opened(kind="command", arguments=["sh", "-c", hanging, "{pot}", "{dial}"], timeout_s=2.0)
    with pytest.raises(RigError, match=r"pot K to 0\.5000: .*: not done within 2 s, killed"):
        pots.set({"K": 0.5}, WORDS, recording=True)
    assert all(ends(int(pid)) for pid in (tmp_path / "pids").read_text().split())


def test_missing_command_is_named(tmp_path: Path) -> None:
    pots = opened(kind="command", arguments=[str(tmp_path / "no-such-program"), "{pot}", "{dial}"])
    with pytest.raises(RigError, match=r"no-such-program K 0\.5000: cannot be started: No such file or directory"):
        pots.set({"K": 0.5}, WORDS, recording=True)


# ---- a box at a serial line


class Box:
    """Box on a pseudo-terminal that answers each line with the next of ``answers``."""

    def __init__(self, *answers: bytes) -> None:
        self.heard: list[bytes] = []
        self._answers = answers
        self._far, self._near = pty.openpty()
        tty.setraw(self._near)
        self.url = os.ttyname(self._near)
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        for answer in self._answers:
            line = b""
            while not line.endswith(b"\n"):
                line += os.read(self._far, 1)
            self.heard.append(line)
            os.write(self._far, answer)

    def greet(self, said: bytes) -> None:
        os.write(self._far, said)

    def read(self, count: int) -> bytes:
        out = b""
        while len(out) < count:
            out += os.read(self._far, count)
        return out

    def close(self) -> None:
        self._thread.join(LONG_S)
        os.close(self._far)
        os.close(self._near)


@pytest.fixture
def boxes() -> Iterator[list[Box]]:
    out: list[Box] = []
    yield out
    for box in out:
        box.close()


def test_box_gets_a_line_for_each_pot_and_its_answers_are_checked(boxes: list[Box]) -> None:
    box = Box(b"OK K\r\n", b"OK B\r\n")
    boxes.append(box)
    pots = opened(kind="serial", url=box.url, line="W {pot} {step}\n", reply="OK {pot}", steps=1024)
    box.greet(b"pot box 1.2\r\n")
    pots.set(DIALS, WORDS, recording=False)
    pots.close()
    assert box.heard == [b"W K 653\n", b"W B 834\n"]


def test_box_without_replies_is_not_awaited(boxes: list[Box]) -> None:
    box = Box()
    boxes.append(box)
    pots = opened(kind="serial", url=box.url, line="{pot}={dial};")
    pots.set(DIALS, WORDS, recording=True)
    assert box.read(len(b"K=0.6380;B=0.8152;")) == b"K=0.6380;B=0.8152;"
    pots.close()


def test_refusal_of_a_box_is_an_error_with_its_reply(boxes: list[Box]) -> None:
    box = Box(b"ERR locked\n")
    boxes.append(box)
    pots = opened(kind="serial", url=box.url, line="{pot} {dial}\n", reply="OK")
    with pytest.raises(RigError) as raised:
        pots.set(DIALS, WORDS, recording=True)
    assert str(raised.value) == f"pot K to 0.6380: {box.url}: answered 'ERR locked', not 'OK'"
    assert box.heard == [b"K 0.6380\n"], "the pot after one that failed was not to be touched"
    pots.close()


def test_box_that_stops_within_a_reply_is_a_time_out(boxes: list[Box]) -> None:
    box = Box(b"O")
    boxes.append(box)
    pots = opened(kind="serial", url=box.url, line="{pot} {dial}\n", reply="OK", timeout_s=2.0)
    with pytest.raises(RigError, match=r"no answer 'OK' within 2 s, output: O"):
        pots.set({"K": 0.5}, WORDS, recording=True)
    pots.close()


def test_endless_reply_is_cut_off(boxes: list[Box]) -> None:
    box = Box(b"x" * 4096)
    boxes.append(box)
    pots = opened(kind="serial", url=box.url, line="{pot} {dial}\n", reply="OK")
    with pytest.raises(RigError, match=r"answered 'x{300}\.\.\.', not 'OK'"):
        pots.set({"K": 0.5}, WORDS, recording=True)
    pots.close()


def test_missing_port_is_an_error_of_the_rig() -> None:
    with pytest.raises(RigError, match="pots: cannot open /dev/no-such-port: No such file or directory"):
        opened(kind="serial", url="/dev/no-such-port", line="{pot} {dial}\n")


# ---- an operator


class Terminal:
    def __init__(self) -> None:
        self.far, self._near = pty.openpty()
        self.path = Path(os.ttyname(self._near))

    def shown(self, until: bytes) -> str:
        text = b""
        while not text.endswith(until):
            text += os.read(self.far, 1024)
        return text.decode()

    def type(self, typed: bytes) -> None:
        os.write(self.far, typed)

    def close(self) -> None:
        os.close(self.far)
        os.close(self._near)


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    out = Terminal()
    yield out
    out.close()


def asked(terminal: Terminal, typed: bytes, *, turn: bool) -> tuple[str, list[BaseException]]:
    """Prompt for an operator who types ``typed``, and the resulting errors."""
    pots = OperatorPots(kind="operator").open(terminal.path)
    failed: list[BaseException] = []

    def wait() -> None:
        try:
            pots.set(DIALS, WORDS, recording=turn)
        except RigError as error:
            failed.append(error)

    waiting = threading.Thread(target=wait, daemon=True)
    waiting.start()
    shown = terminal.shown(b"press Enter: ")
    assert waiting.is_alive(), "did not wait for the operator"
    terminal.type(typed)
    waiting.join(LONG_S)
    assert not waiting.is_alive()
    pots.close()
    return shown, failed


def test_operator_is_prompted_and_awaited(terminal: Terminal) -> None:
    shown, failed = asked(terminal, b"\n", turn=False)
    assert shown == f"Set the pots to K 0.6380, B 0.8152 ({WORDS}), then press Enter: "
    assert not failed


def test_operator_is_prompted_within_a_record(terminal: Terminal) -> None:
    shown, failed = asked(terminal, b"done\n", turn=True)
    assert shown.startswith("NOW turn to K 0.6380, B 0.8152")
    assert not failed


def test_enter_typed_before_the_prompt_does_not_count(terminal: Terminal) -> None:
    terminal.type(b"\n\n")
    terminal.shown(b"\r\n\r\n")  # echoed: they wait in the terminal's input
    _, failed = asked(terminal, b"\n", turn=False)
    assert not failed


def test_end_of_input_is_an_error(terminal: Terminal) -> None:
    _, (failed,) = asked(terminal, b"\x04", turn=False)
    assert str(failed) == f"pots: the operator at {terminal.path} has left (end of input)"


@pytest.mark.parametrize(
    ("path", "reason"), [("/dev/null", "is no terminal"), ("/nowhere/tty", "No such file or directory")]
)
def test_operator_needs_a_terminal(path: str, reason: str) -> None:
    with pytest.raises(ConfigurationError, match=f'kind "operator" needs a terminal.*{reason}'):
        OperatorPots(kind="operator").open(Path(path))
