"""The documentation site: it builds without a warning, and its commands, files and examples work."""

from __future__ import annotations

import dataclasses
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from analogrig import config
from analogrig.campaigns.spec import CampaignSpec
from analogrig.cli import command_line
from analogrig.devices.registry import from_table
from analogrig.estimator_config import EstimatorConfig
from analogrig.rigs.description import describe
from analogrig.rigs.emulator import CardDescription, ComputerDescription, MeasuredValues
from analogrig.scenario import Scenario
from analogrig_emulator.machine.program_loader import load_patch
from analogrig_imports.imported import ImportDescription
from analogrig_instruments.rig_wiring import RealDescription
from analogrig_instruments.simulator.served import ServedDescription

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "harness" / "docs"
PAGES = sorted(path for folder in ("tutorials", "howto", "background") for path in (DOCS / folder).glob("*.md"))
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
COMMAND = re.compile(r"(?:^|\s)(analogrig (?!serve --port 5000 &).*)$")
PROSE = [
    *(path for path in sorted(DOCS.rglob("*.md")) if path.parent.name != "reference"),
    *(ROOT / name for name in ("README.md", "harness/README.md", "emulator/README.md", "harness/examples/README.md")),
]
MOST_WORDS, MOST_CELL_WORDS, MOST_COLUMNS = 25, 20, 100
BLOCKS = re.compile(r"^ *```.*?^ *```|^:::.*?^::::$", re.MULTILINE | re.DOTALL)
NO_PROSE = re.compile(r"^(?:\||#|!\[)[^\n]*$", re.MULTILINE)
"""Tables, headings and pictures."""
LEAST_COMMANDS = 40
LEAST_BLOCKS = {"toml": 7, "python": 5}
"""Least numbers over all pages, by language."""
WALKS = 5
RUN_BY_ANOTHER_TEST = {"serve-the-emulator", "import-measured-data"}
"""Pages whose Python needs a server, or a recording: tests/served/test_page.py, tests/harness/test_pytest_plugin.py."""
SET_BY_THE_HARNESS = {"force_zero"}
"""Settings that a device file need not give: the code of zero force follows from the card's range."""


def blocks(page: Path, language: str) -> list[str]:
    """Texts of the fenced blocks of a language."""
    return [text for name, text in BLOCK.findall(page.read_text(encoding="utf-8")) if name == language]


def commands(page: Path) -> Iterator[str]:
    """Calls of analogrig on a page, without comments and shell operators."""
    for text in [*blocks(page, "console"), *blocks(page, "sh")]:
        for line in text.splitlines():
            if found := COMMAND.search(line.removeprefix("$ ").replace(".venv/bin/", "")):
                yield re.sub(r"\s*(\|\||&|#).*$", "", found.group(1)) if "'" not in line else found.group(1)


@pytest.mark.heavy
def test_site_builds_without_a_warning(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html", "-d", str(tmp_path / "trees")]
    done = subprocess.run([*command, DOCS, tmp_path / "site"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "site" / "reference" / "commands.html").read_text(encoding="utf-8")
    assert "--wire-faults" in page
    remote = re.compile(r'<(?:link|script|img)[^>]+(?:href|src)="https?://')
    assert not [path for path in (tmp_path / "site").rglob("*.html") if remote.search(path.read_text(encoding="utf-8"))]


def test_blocks_of_the_pages_are_found() -> None:
    """A page without blocks passes the tests below. A pattern that finds none must not."""
    assert sum(len(list(commands(page))) for page in PAGES) >= LEAST_COMMANDS
    found = {language: sum(len(blocks(page, language)) for page in PAGES) for language in LEAST_BLOCKS}
    assert {language: n for language, n in found.items() if n < LEAST_BLOCKS[language]} == {}


def test_every_command_of_a_page_is_understood() -> None:
    parser = command_line.make_parser()
    lost = []
    for name, command in [(page.name, command) for page in PAGES for command in commands(page)]:
        try:
            parser.parse_args(shlex.split(command, comments=True)[1:])
        except SystemExit as ended:  # --help ends with 0
            if ended.code != 0:
                lost.append(f"{name}: {command}")
    assert lost == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_toml_file_of_a_page_is_accepted(page: Path, tmp_path: Path) -> None:
    for text in blocks(page, "toml"):
        table = tomllib.loads(text)
        path = tmp_path / "example.toml"
        path.write_text(text, encoding="utf-8")
        if "instrument" in table:
            rig = config.locate("rigs", "emulator-ideal").read_text(encoding="utf-8")
            path.write_text(f"{rig}\n{text}", encoding="utf-8")
            ServedDescription.load(str(path))
        elif isinstance(table.get("rig"), dict):
            for rig in table["rig"].values():  # a page may show the pots alone
                rest = {key: value for key, value in red_pitaya().items() if key not in rig}
                config.build(RealDescription, {**rest, **rig}, "rig")
        elif table.get("kind") == "emulator":
            describe(str(path))
        elif "equations" in table:
            load_patch(path)
            path.rename(tmp_path / f"{table['name']}.toml")  # for the scenarios of the page
        elif "input" in table:
            config.build(ImportDescription, table, "example")
        elif "trials" in table:
            CampaignSpec.load(str(path))
        elif table.keys() & {"kind", "datasheet"}:  # a page may show the data sheet alone
            without_kind = {} if "kind" in table else {"kind": "library", "library": "mine.so"}
            from_table({"name": "example", **without_kind, **table}, "example")
        else:
            Scenario.load(str(path))


def test_every_python_example_of_a_page_runs(tmp_path: Path) -> None:
    """Each in a module of its own, of one session."""
    for page in PAGES:
        for i, text in enumerate(blocks(page, "python") if page.stem not in RUN_BY_ANOTHER_TEST else ()):
            (tmp_path / f"test_{page.stem}_{i}.py").write_text(
                text if "def test_" in text else f"def test_it():\n{_indented(text)}"
            )
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--hil-dut", "inproc", str(tmp_path)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def _indented(text: str) -> str:
    return "".join(f"    {line}" if line.strip() else line for line in text.splitlines(keepends=True))


def red_pitaya() -> Mapping[str, Any]:
    """The shipped description of a real rig."""
    return tomllib.loads(config.locate("rigs", "red-pitaya").read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    ("page", "described"),
    [
        ("connect-a-device", EstimatorConfig),
        ("describe-an-emulated-rig", ComputerDescription),
        ("describe-an-emulated-rig", CardDescription),
        ("describe-an-emulated-rig", MeasuredValues),
    ],
)
def test_page_has_every_key(page: str, described: type) -> None:
    text = (DOCS / "howto" / f"{page}.md").read_text(encoding="utf-8")
    keys = [each.name for each in dataclasses.fields(described) if each.name not in SET_BY_THE_HARNESS]
    assert [key for key in keys if not re.search(rf"\b{key}\b", text)] == []


def test_sentences_cells_and_lines_are_short() -> None:
    assert [f"{page.relative_to(ROOT)}: {text}" for page in PROSE for text in long_texts(page)] == []


def long_texts(page: Path) -> list[str]:
    text = BLOCKS.sub("", page.read_text(encoding="utf-8"))
    prose = NO_PROSE.sub("", text)
    sentences = re.split(r"(?<=[.!?:])\s+|\n\n|\n *- |\n\d+\. ", prose)
    cells = [cell for line in text.splitlines() if line.startswith("|") for cell in re.split(r" \| |[.;:] ", line)]
    long = [sentence for sentence in sentences if len(sentence.split()) > MOST_WORDS]
    long += [cell for cell in cells if len(cell.strip("| ").split()) > MOST_CELL_WORDS]
    long += [line for line in prose.splitlines() if len(line) > MOST_COLUMNS]
    return long


def test_page_of_the_keys_of_a_scenario_is_written_from_the_dataclass_that_reads_it() -> None:
    """The test of the site writes every other page too."""
    sys.path.insert(0, str(DOCS))
    try:
        from generated import FILES, _file
    finally:
        sys.path.remove(str(DOCS))
    page = "\n".join(_file(*FILES["scenario-files"]))
    assert [key for key in Scenario.__dataclass_fields__ if key != "name" and f"`{key}`" not in page] == []
    assert config.names("scenarios")


def test_architecture_lists_every_folder_and_module_once() -> None:
    text = (DOCS / "background" / "architecture.md").read_text(encoding="utf-8")
    listed = text.partition("harness/analogrig/\n")[2].partition("harness/analogrig_thesis/")[0].strip().splitlines()
    names = [Path(word).stem for line in listed for word in re.split("  |(?<=/) ", line.strip())[0].split()]
    package = ROOT / "harness" / "analogrig"
    parts = [*package.glob("[a-z]*.py"), *(path.parent for path in package.glob("*/__init__.py"))]
    assert sorted(names) == sorted(path.stem for path in parts)


def test_walks_of_the_architecture_name_each_file_once() -> None:
    text = (DOCS / "background" / "architecture.md").read_text(encoding="utf-8")
    walks = [re.findall(r"^\d+\. `([^`\s]+/[^`\s]+)`", part, re.MULTILINE) for part in text.split("\n## ")]
    walks = [walk for walk in walks if walk]
    assert len(walks) == WALKS
    assert [path for walk in walks for path in walk if not (ROOT / path).exists() or walk.count(path) > 1] == []
