"""The documentation site: it builds without a warning, and what its pages tell a reader to type works."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from analogrig import cli, config
from analogrig.campaigns.spec import CampaignSpec
from analogrig.devices.registry import from_table
from analogrig.rigs.description import described
from analogrig.scenario import Scenario

DOCS = Path(__file__).parents[1] / "harness" / "docs"
PAGES = sorted(path for folder in ("tutorials", "howto") for path in (DOCS / folder).glob("*.md"))
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
COMMAND = re.compile(r"(?:^|\s)(analogrig (?!serve --port 5000 &).*)$")
MOST_WORDS = 35


def blocks(page: Path, language: str) -> list[str]:
    """Texts of the fenced blocks of a language."""
    return [text for name, text in BLOCK.findall(page.read_text(encoding="utf-8")) if name == language]


def commands(page: Path) -> Iterator[str]:
    """Calls of analogrig on a page, without comments and shell operators."""
    for text in [*blocks(page, "console"), *blocks(page, "sh")]:
        for line in text.splitlines():
            if found := COMMAND.search(line.removeprefix("$ ").replace(".venv/bin/", "")):
                yield re.sub(r"\s*(\|\||&|#).*$", "", found.group(1)) if "'" not in line else found.group(1)


def test_site_builds_without_a_warning(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html", "-d", str(tmp_path / "trees")]
    done = subprocess.run([*command, DOCS, tmp_path / "site"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "site" / "reference" / "commands.html").read_text(encoding="utf-8")
    assert "--wire-faults" in page
    remote = re.compile(r'<(?:link|script|img)[^>]+(?:href|src)="https?://')
    assert not [path for path in (tmp_path / "site").rglob("*.html") if remote.search(path.read_text(encoding="utf-8"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_command_of_a_page_is_understood(page: Path) -> None:
    parser = cli._parser()
    for command in commands(page):
        words = shlex.split(command, comments=True)[1:]
        try:
            parser.parse_args(words)
        except SystemExit:
            pytest.fail(f"{page.name}: {command}")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_toml_file_of_a_page_is_accepted(page: Path, tmp_path: Path) -> None:
    for text in blocks(page, "toml"):
        table = tomllib.loads(text)
        path = tmp_path / "example.toml"
        path.write_text(text, encoding="utf-8")
        if "rig" in table:
            assert described(str(path))
        elif "trials" in table:
            CampaignSpec.load(str(path))
        elif "kind" in table:
            from_table({"name": "example", **table}, "example")
        else:
            Scenario.load(str(path))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_python_example_of_a_page_runs(page: Path, tmp_path: Path) -> None:
    texts = blocks(page, "python")
    if not texts:
        return
    for i, text in enumerate(texts):
        (tmp_path / f"test_example_{i}.py").write_text(
            text if "def test_" in text else f"def test_it():\n{_indented(text)}"
        )
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--hil-dut", "inproc", str(tmp_path)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def _indented(text: str) -> str:
    return "".join(f"    {line}" if line.strip() else line for line in text.splitlines(keepends=True))


def test_sentences_of_the_pages_are_short() -> None:
    long = []
    for path in sorted(DOCS.rglob("*.md")):
        if path.parent.name == "reference":
            continue
        text = re.sub(r"^```.*?^```|^\|.*$|^#.*$", "", path.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
        long += [f"{path.name}: {s}" for s in re.split(r"(?<=[.!?:])\s+|\n\n", text) if len(s.split()) > MOST_WORDS]
    assert not long


def test_every_page_of_a_key_is_written_from_the_dataclass_that_reads_it(tmp_path: Path) -> None:
    sys.path.insert(0, str(DOCS))
    try:
        from generated import write_reference
    finally:
        sys.path.remove(str(DOCS))
    write_reference(tmp_path)
    page = (tmp_path / "scenario-files.md").read_text(encoding="utf-8")
    for key in Scenario.__dataclass_fields__:
        assert key == "name" or f"`{key}`" in page
    assert config.names("scenarios")
