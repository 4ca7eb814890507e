"""Every link and every path in the README files and the pages of the site leads somewhere."""

from __future__ import annotations

import functools
import re
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).parents[1]
READMES = sorted(
    path
    for folder in (".", "emulator", "estimator_c", "estimator_c/evidence", "harness", "harness/examples", "tests/*")
    for path in CHECKOUT.glob(f"{folder}/README.md")
)
DOCS = CHECKOUT / "harness" / "docs"
SITE = sorted(path for path in DOCS.rglob("*.md") if path.parent.name != "reference")
PAGES = [*READMES, *SITE]

MADE_UP = {
    *(
        "FILE.toml",
        "bench.asc",
        "bench.dbc",
        "bench.toml",
        "dut.toml",
        "rig.toml",
        "mine.toml",
        "quiet.toml",
        "rigs.toml",
        "scenario.toml",
        "soft.toml",
    ),  # files of a reader
    *("claims.json", "report.html", "run.npz", "simulated.npz", "thesis.html", "verdict.json"),  # results
    *("/run", "dx/dt", "generated/", "without/", "suite/"),  # in a guest, or beside the page
    *("components/", "libraries/"),  # folders of a reader's project
}
"""Paths of files that are not in this repository, and directories named by their last part."""

IS_PATH = re.compile(r"(?!CRC-)\w[\w.-]+(?:/[\w.-]*)+|[\w-]+\.(?:py|c|h|toml|json|npz|html|css|js|dbc|ld|S)")

NOT_OURS = re.compile(r"build/|DIR/|\.venv/|/dev/|CLONE/|~|.*/dev/")


def read(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def name(path: Path) -> str:
    return str(path.relative_to(CHECKOUT))


def without_blocks(text: str) -> str:
    return re.sub(r"```.*?```", "", text, flags=re.DOTALL)


def tree() -> set[str]:
    """Files and folders of the checkout by every end of their paths: a page may leave out what its reader knows."""
    ends = set()
    tops = [path for path in CHECKOUT.iterdir() if path.name not in {".git", ".venv", "build"}]
    for path in (path for top in tops for path in (top, *top.rglob("*"))):
        parts = path.relative_to(CHECKOUT).parts
        if "__pycache__" not in parts:
            ends |= {"/".join(parts[i:]) for i in range(len(parts))}
    return ends


TREE = tree()


def anchors(path: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ +(.*)$", without_blocks(read(path)), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_every_relative_link_leads_to_a_file_and_a_heading(page: Path) -> None:
    lost = []
    for link in re.findall(r"\]\(([^)\s]+)\)", without_blocks(read(page))):
        if re.match(r"[a-z]+:", link):
            continue
        file, _, anchor = link.partition("#")
        target = (page.parent / file) if file else page
        if target.parent.resolve() == DOCS / "reference":
            continue  # written when the site is built, which reports lost references
        if not target.exists() or (anchor and anchor not in anchors(target)):
            lost.append(link)
    assert lost == []


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_every_path_in_backticks_exists(page: Path) -> None:
    words = {word for code in re.findall(r"`([^`\n]+)`", without_blocks(read(page))) for word in code.split()}
    paths = {word.removeprefix("PYTEST_ARGS=").strip('"') for word in words}
    paths = {path for path in paths if IS_PATH.fullmatch(path) and path not in MADE_UP and not NOT_OURS.match(path)}
    assert sorted(path for path in paths if path.rstrip("/") not in TREE) == []


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_every_module_run_by_python_exists(page: Path) -> None:
    modules = re.findall(r"python -m ((?:tests|estimator_c|analogrig\w*)(?:\.\w+)*)", read(page))
    assert (
        sorted({each for each in modules if not {f"{each.replace('.', '/')}.py", each.replace(".", "/")} & TREE}) == []
    )


@functools.cache
def sources_of_tests() -> str:
    """Source of every test of the repository."""
    return "\n".join(read(path) for folder in ("tests", "harness") for path in (CHECKOUT / folder).rglob("test_*.py"))


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_every_named_test_exists(page: Path) -> None:
    named = set(re.findall(r"`(test_\w+)(?:\.\.\.)?`", without_blocks(read(page))))
    assert sorted(each for each in named if f"def {each}" not in sources_of_tests()) == []


LONGEST = {"README.md": 120, "estimator_c/README.md": 100, "harness/README.md": 100, "emulator/README.md": 100}
"""Largest number of lines."""


@pytest.mark.parametrize(("page", "most"), LONGEST.items())
def test_readme_is_short(page: str, most: int) -> None:
    assert len(read(CHECKOUT / page).splitlines()) <= most
