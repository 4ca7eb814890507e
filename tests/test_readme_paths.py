"""Every link and every path in the README files and the pages of the site leads somewhere."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

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


@functools.cache
def read(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def without_blocks(text: str) -> str:
    return re.sub(r"```.*?```", "", text, flags=re.DOTALL)


@functools.cache
def tree() -> set[str]:
    """Files and folders of the checkout by every end of their paths: a page may leave out what its reader knows."""
    ends = set()
    tops = [path for path in CHECKOUT.iterdir() if path.name not in {".git", ".venv", "build"}]
    for path in (path for top in tops for path in (top, *top.rglob("*"))):
        parts = path.relative_to(CHECKOUT).parts
        if "__pycache__" not in parts:
            ends |= {"/".join(parts[i:]) for i in range(len(parts))}
    return ends


def anchors(path: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ +(.*)$", without_blocks(read(path)), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def lost(wrong: Callable[[Path], Iterable[str]]) -> list[str]:
    """What is wrong on each page, with its name."""
    return [f"{page.relative_to(CHECKOUT)}: {each}" for page in PAGES for each in sorted(wrong(page))]


def lost_links(page: Path) -> Iterator[str]:
    for link in re.findall(r"\]\(([^)\s]+)\)", without_blocks(read(page))):
        if re.match(r"[a-z]+:", link):
            continue
        file, _, anchor = link.partition("#")
        target = (page.parent / file) if file else page
        if target.parent.resolve() == DOCS / "reference":
            continue  # written when the site is built, which reports lost references
        if not target.exists() or (anchor and anchor not in anchors(target)):
            yield link


def test_every_relative_link_leads_to_a_file_and_a_heading() -> None:
    assert lost(lost_links) == []


def lost_paths(page: Path) -> set[str]:
    words = {word for code in re.findall(r"`([^`\n]+)`", without_blocks(read(page))) for word in code.split()}
    paths = {word.removeprefix("PYTEST_ARGS=").strip('"') for word in words}
    paths = {path for path in paths if IS_PATH.fullmatch(path) and path not in MADE_UP and not NOT_OURS.match(path)}
    return {path for path in paths if path.rstrip("/") not in tree()}


def test_every_path_in_backticks_exists() -> None:
    assert lost(lost_paths) == []


def lost_modules(page: Path) -> set[str]:
    modules = re.findall(r"python -m ((?:tests|estimator_c|analogrig\w*)(?:\.\w+)*)", read(page))
    return {each for each in modules if not {f"{each.replace('.', '/')}.py", each.replace(".", "/")} & tree()}


def test_every_module_run_by_python_exists() -> None:
    assert lost(lost_modules) == []


def test_every_named_test_exists() -> None:
    files = (path for folder in ("tests", "harness") for path in (CHECKOUT / folder).rglob("test_*.py"))
    defined = "\n".join(re.findall(r"def test_\w+", "\n".join(map(read, files))))

    def lost_tests(page: Path) -> set[str]:
        named = set(re.findall(r"`(test_\w+)(?:\.\.\.)?`", without_blocks(read(page))))
        return {each for each in named if f"def {each}" not in defined}

    assert lost(lost_tests) == []


LONGEST = {"README.md": 120, "estimator_c/README.md": 100, "harness/README.md": 100, "emulator/README.md": 100}
"""Largest number of lines."""


def test_readmes_are_short() -> None:
    assert [page for page, most in LONGEST.items() if len(read(CHECKOUT / page).splitlines()) > most] == []
