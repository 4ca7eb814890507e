"""The page on the served instrument: its example, its commands and its table of faults."""

from __future__ import annotations

import dataclasses
import re
import subprocess
import sys
import tomllib
from pathlib import Path

from analogrig import config
from analogrig_instruments.simulator.served import InstrumentDescription
from tests.harness.processes import LONG_S
from tests.served.serving import serving
from tests.served.talk import interpreter

PAGE = (Path(__file__).parents[2] / "harness/docs/howto/serve-the-emulator.md").read_text(encoding="utf-8")


def block(language: str) -> str:
    return str(re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)[0])


def test_table_of_faults_has_every_key_with_its_default() -> None:
    table = tomllib.loads(block("toml"))["instrument"]
    assert config.build(InstrumentDescription, table, "page") == InstrumentDescription()
    known = dataclasses.asdict(InstrumentDescription())
    assert {name: set(part) for name, part in table.items()} == {name: set(part) for name, part in known.items()}


def test_example_runs_unchanged(tmp_path: Path) -> None:
    with serving("--rig", "emulator-ideal") as served:
        program = block("python").replace("5000", str(served.port))
        program += "assert len(force_v) == len(displacement_v) == 16384 and 9.8 < max(force_v) < 10.0\n"
        subprocess.run([sys.executable, "-c", program], check=True, timeout=LONG_S, cwd=tmp_path)


def test_every_command_of_the_instrument_is_in_the_table() -> None:
    """Each of its words, but those that are optional."""
    rows = PAGE.partition("| commands | effect |")[2].partition("\n\n")[0]
    words = {word for code in re.findall(r"`([^`]+)`", rows) for word in re.findall(r"[A-Za-z]+", code)}
    for expression, *_ in interpreter()._commands:
        long = re.findall(r"\(\?:(\w+)\|", expression.pattern)
        assert set(long) <= words | {"Factor", "NEXT", "FIX"}, expression.pattern
