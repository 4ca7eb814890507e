"""`make metrics`: figures of the structure and of the documents, of one commit or of several beside each other.

python -m tests.metrics [--arrows | --write] [COMMIT ...]; without a commit, of the files as they are. ``--arrows``
lists the imports between the folders of ``analogrig`` instead. ``--write`` writes the table to the evidence page.
"""

from __future__ import annotations

import ast
import functools
import itertools
import json
import re
import subprocess
import sys
import textwrap
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]

PAGE = ROOT / "harness" / "docs" / "evidence" / "house.md"

PARTS = ("harness", "emulator", "estimator_c", "tests")
PRODUCT = PARTS[:3]

FEW, SMALL = 6, 60
"""Lines of a function, and of a module, below which a reader may gain if it joins another."""

NOW = "now"
"""Name of the tree of the files as they are."""

CODE = re.compile(r"\.(py|c|h|S|js|html|css|ld|dbc)$")
"""Files whose lines count as code."""

BAD_START = re.compile(r"(What|Whether|Of|As|How|Who|Whatever|Whoever|That|Those|Why|In which|Where|When)\b")
"""First words of docstrings that need the name above them to mean anything."""

CONCRETE = re.compile(
    r"\b(EmulatorRig|RecordingRig|RealRig|EmulatorDescription|RealDescription"
    r"|InprocDevice|HostDevice|QemuDevice|SerialDevice|CanDevice|Inproc|Host|Qemu|Serial|Can)\b"
)
"""Classes of rigs and devices that have an interface."""

LEVELS: tuple[tuple[str, ...], ...] = (
    (
        "errors",
        "config",
        "wording",
        "catalogue",
        "_catalogue",
        "estimator_config",
        "entry_points",
        "program",
        "plant",
        "lazy",
        "pages",
        "answers",
        "datasheet",
    ),
    ("run", "scenario", "trust", "identity", "signals", "output"),
    ("links",),
    ("devices", "rigs", "judging"),
    ("bench",),
    ("recordings", "claims"),
    ("campaigns", "testing", "reporting", "analogrig"),
    ("cli", "device_program"),
)
"""Modules and folders of ``analogrig``, lowest level first. An import to a higher level runs upwards."""


@dataclass(frozen=True)
class Tree:
    """The files of a commit."""

    name: str
    files: Mapping[str, str]
    """Text of each file, by path."""

    def python(self, *parts: str) -> Iterator[tuple[str, ast.Module]]:
        """Path and syntax tree of each Python file of the parts; not of what `analogrig new` writes."""
        for path, text in self.files.items():
            if path.endswith(".py") and path.partition("/")[0] in parts and "/templates/" not in path:
                yield path, _parsed(text)


@functools.cache
def _parsed(text: str) -> ast.Module:
    return ast.parse(text)


@functools.cache
def _nodes(module: ast.Module) -> Sequence[ast.AST]:
    return list(ast.walk(module))


def read(commit: str | None) -> Tree:
    """The tree of ``commit``; None: the tracked files as they are."""
    if commit is None:
        names = _git("ls-files").splitlines()
        texts = {name: (ROOT / name).read_bytes() for name in names if (ROOT / name).is_file()}
        name = NOW
    else:
        names = _git("ls-tree", "-r", "--name-only", commit).splitlines()
        wanted = [each for each in names if CODE.search(each) or each.endswith((".md", ".toml"))]
        texts = dict(zip(wanted, _contents(commit, wanted), strict=True))
        name = commit
    return Tree(name, {each: text.decode("utf-8", "replace") for each, text in texts.items()})


def _git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True).stdout


def _contents(commit: str, names: Sequence[str]) -> Iterator[bytes]:
    """Content of each file of a commit."""
    asked = "".join(f"{commit}:{name}\n" for name in names).encode()
    told = subprocess.run(["git", "cat-file", "--batch"], cwd=ROOT, input=asked, capture_output=True, check=True).stdout
    at = 0
    for _ in names:
        end = told.index(b"\n", at)
        size = int(told[at:end].split()[2])
        yield told[end + 1 : end + 1 + size]
        at = end + size + 2


def metrics(tree: Tree) -> dict[str, str]:
    """Every figure of the table, by its name."""
    return {
        **{f"lines of Python: {part}": f"{n:,}" for part, n in _python_lines(tree).items()},
        **{f"lines of code: {part}": f"{_lines(tree, part):,}" for part in PARTS},
        "Python modules of the product": str(len(list(tree.python(*PRODUCT)))),
        "public names at the top of modules": str(sum(1 for _ in _public(tree))),
        "type names with two meanings": _named(doubled(tree)),
        "module names with two meanings": _named(_doubled_modules(tree)),
        "isinstance on concrete rigs and devices": str(isinstances(tree)),
        "imports that run upwards": _named([f"{a} to {b}" for a, b in upward(arrows(tree))]),
        "circles of imports between folders": _named([" ".join(sorted(circle)) for circle in circles(arrows(tree))]),
        "circles of imports between modules": _named([" ".join(sorted(each)) for each in circles(module_arrows(tree))]),
        "depth of classes": str(max(class_depths(tree).values(), default=0)),
        f"private functions called once, of at most {FEW} lines": str(len(called_once(tree))),
        f"modules below {SMALL} lines": str(len(small_modules(tree))),
        **(_traced() if tree.name == NOW else {}),
        "docstrings": f"{len(_docstrings(tree)):,}",
        "docstrings with a bad first word": f"{share_of_bad(tree):.1%}",
        "most frequent first words": ", ".join(word for word, _ in _first_words(tree).most_common(6)),
        "dependencies, without extras": str(
            len(tomllib.loads(tree.files["pyproject.toml"])["project"]["dependencies"])
        ),
        "words of documentation": f"{_words(tree):,}",
        "lines of README.md": f"{len(tree.files['README.md'].splitlines()):,}",
    }


def _named(names: Sequence[str]) -> str:
    return f"{len(names)}" + (f" ({', '.join(names)})" if 0 < len(names) <= 6 else "")


def _lines(tree: Tree, part: str) -> int:
    wanted = [text for name, text in tree.files.items() if name.startswith(f"{part}/") and CODE.search(name)]
    return sum(text.count("\n") for text in wanted)


def _python_lines(tree: Tree) -> Counter[str]:
    """Lines of the core, of each package beside it, and of the other parts."""
    lines: Counter[str] = Counter()
    for path, text in tree.files.items():
        part, _, rest = path.partition("/")
        if path.endswith(".py") and part in PARTS:
            package = rest.partition("/")[0] if part == "harness" else part
            lines[package if package.startswith("analogrig") else part] += text.count("\n")
    return lines


def _traced() -> dict[str, str]:
    """Figures of tests.traced; none without the environment of make."""
    python = ROOT / ".venv" / "bin" / "python"
    if not python.exists():
        return {}
    done = subprocess.run([python, "-m", "tests.traced"], cwd=ROOT, capture_output=True, text=True, check=True)
    return {name: str(value) for name, value in json.loads(done.stdout).items()}


def module_arrows(tree: Tree) -> Arrows:
    """Imports between the modules of the product, those within functions included, but not those for types alone."""
    modules = {
        path.partition("/")[2].removesuffix(".py").removesuffix("/__init__").replace("/", "."): module
        for path, module in tree.python("harness", "emulator")
    }
    found: dict[tuple[str, str], list[tuple[str, str]]] = {}
    for name, module in modules.items():
        for node in _run_nodes(module):
            if isinstance(node, ast.ImportFrom) and node.module:
                for alias in node.names:
                    inner = f"{node.module}.{alias.name}"
                    target = inner if inner in modules else node.module
                    if target in modules and target != name:
                        found[name, target] = [(name, target)]
    return found


def _run_nodes(module: ast.Module) -> Iterator[ast.AST]:
    """Nodes of a module except those below ``if TYPE_CHECKING:``."""
    ahead: list[ast.AST] = [module]
    while ahead:
        node = ahead.pop()
        yield node
        is_typing = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        ahead += node.orelse if is_typing and isinstance(node, ast.If) else ast.iter_child_nodes(node)


def class_depths(tree: Tree) -> dict[str, int]:
    """Classes of the product above each of its classes, itself included; errors are a tree of their own."""
    bases = {
        node.name: [ast.unparse(base).partition("[")[0].rpartition(".")[2] for base in node.bases]
        for _, module in tree.python(*PRODUCT)
        for node in _nodes(module)
        if isinstance(node, ast.ClassDef)
    }

    def depth(name: str) -> int:
        return 1 + max((depth(base) for base in bases[name] if base in bases and base != name), default=0)

    def is_error(name: str) -> bool:
        return (name not in bases and name.endswith(("Error", "Exception", "Interrupt"))) or any(
            is_error(base) for base in bases.get(name, ()) if base != name
        )

    return {name: depth(name) for name in bases if not is_error(name)}


def called_once(tree: Tree) -> list[str]:
    """Private functions of at most FEW lines, without docstring, whose name stands once beside its definition."""
    found = []
    for path, module in tree.python(*PRODUCT):
        names = Counter(node.id for node in _nodes(module) if isinstance(node, ast.Name))
        names += Counter(node.attr for node in _nodes(module) if isinstance(node, ast.Attribute))
        for node in _nodes(module):
            if isinstance(node, ast.FunctionDef) and node.name.startswith("_") and not node.name.startswith("__"):
                body = node.body[1:] if ast.get_docstring(node) else node.body
                lines = (node.end_lineno or 0) - (body[0].lineno if body else node.lineno) + 2
                if names[node.name] == 1 and lines <= FEW and not node.decorator_list:
                    found.append(f"{path}: {node.name}")
    return found


def small_modules(tree: Tree) -> list[str]:
    """Modules of the product below SMALL lines, without those that every package has."""
    return [
        path
        for path, text in tree.files.items()
        if path.endswith(".py") and path.partition("/")[0] in PRODUCT and "/templates/" not in path
        if not Path(path).name.startswith("__") and "/examples/" not in path and text.count("\n") < SMALL
    ]


def _words(tree: Tree) -> int:
    return sum(len(text.split()) for name, text in tree.files.items() if name.endswith(".md"))


def _public(tree: Tree) -> Iterator[str]:
    for _, module in tree.python(*PRODUCT):
        for node in module.body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                yield node.name


def doubled(tree: Tree) -> list[str]:
    """Names of classes of the product that are defined more than once."""
    classes = [
        node.name for _, module in tree.python(*PRODUCT) for node in _nodes(module) if isinstance(node, ast.ClassDef)
    ]
    return sorted(name for name, times in Counter(classes).items() if times > 1)


def _doubled_modules(tree: Tree) -> list[str]:
    names = [Path(path).stem for path, _ in tree.python(*PRODUCT)]
    return sorted(name for name, times in Counter(names).items() if times > 1 and not name.startswith("__"))


def isinstances(tree: Tree) -> int:
    """Number of isinstance calls on the classes of CONCRETE."""
    return sum(
        1
        for _, module in tree.python(*PRODUCT)
        for node in _nodes(module)
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id == "isinstance"
        and CONCRETE.search(ast.unparse(node.args[1]))
    )


def _docstrings(tree: Tree) -> list[str]:
    """Docstrings of modules, classes and functions, and the texts below attributes."""
    found = []
    for _, module in tree.python(*PRODUCT):
        for node in _nodes(module):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                found.append(ast.get_docstring(node) or "")
            body = getattr(node, "body", [])
            pairs = itertools.pairwise(body) if isinstance(body, list) else ()
            found += [
                below.value.value
                for above, below in pairs
                if isinstance(above, ast.Assign | ast.AnnAssign)
                and isinstance(below, ast.Expr)
                and isinstance(below.value, ast.Constant)
                and isinstance(below.value.value, str)
            ]
    return [text.strip() for text in found if text.strip()]


def share_of_bad(tree: Tree) -> float:
    """Share of the docstrings that begin with a word of BAD_START, 0 to 1."""
    docstrings = _docstrings(tree)
    return sum(1 for text in docstrings if BAD_START.match(text)) / len(docstrings)


def _first_words(tree: Tree) -> Counter[str]:
    return Counter(text.split()[0] for text in _docstrings(tree))


Arrows = Mapping[tuple[str, str], Sequence[tuple[str, str]]]
"""Imports from one folder of ``analogrig`` to another, each from module to module."""


def arrows(tree: Tree) -> Arrows:
    """Imports between the folders of ``analogrig``, those within functions included."""
    package = next(
        (each for each in ("harness/analogrig", "harness") if f"{each}/__init__.py" in tree.files), "harness"
    )
    root = Path(package).name
    modules = {
        path.removeprefix(f"{package}/").removesuffix(".py").removesuffix("/__init__").replace("/", "."): module
        for path, module in tree.python("harness")
        if path.startswith(f"{package}/")
    }
    found: dict[tuple[str, str], list[tuple[str, str]]] = {}
    for name, module in modules.items():
        own = _folder(name)
        for target in _imported(module, root, modules):
            if _folder(target) != own:
                found.setdefault((own, _folder(target)), []).append((name, target))
    return {pair: sorted(set(imports)) for pair, imports in sorted(found.items())}


def _folder(module: str) -> str:
    """Folder of a module, or its own name at the top of the package."""
    top = module.partition(".")[0]
    return "analogrig" if top == "__init__" else top


def _imported(module: ast.Module, root: str, modules: Mapping[str, ast.Module]) -> Iterator[str]:
    """Modules of the package that a module imports."""
    for node in _nodes(module):
        if isinstance(node, ast.Import):
            for each in node.names:
                if each.name.startswith(f"{root}."):
                    yield each.name.removeprefix(f"{root}.")
        if isinstance(node, ast.ImportFrom) and node.module and f"{node.module}.".startswith(f"{root}."):
            base = node.module.removeprefix(root).lstrip(".")
            for each in node.names:
                inner = f"{base}.{each.name}".lstrip(".")
                yield inner if inner in modules else base or "__init__"


def upward(found: Arrows) -> list[tuple[str, str]]:
    """Arrows that run from a lower level to a higher one."""
    rank = {name: number for number, level in enumerate(LEVELS) for name in level}
    return [(a, b) for a, b in found if rank.get(b, -1) > rank.get(a, len(LEVELS))]


def circles(found: Arrows) -> list[set[str]]:
    """Sets of folders that import each other, directly or through others."""
    targets: dict[str, set[str]] = {}
    for a, b in found:
        targets.setdefault(a, set()).add(b)
    reached: dict[str, set[str]] = {}
    for start in targets:
        reached[start], ahead = set(), [start]
        while ahead:
            new = targets.get(ahead.pop(), set()) - reached[start]
            reached[start] |= new
            ahead += new
    of = {a: {b for b in reached[a] if a in reached.get(b, ())} for a in reached}
    return [set(each) for each in sorted({frozenset(circle) for circle in of.values() if circle}, key=sorted)]


def table(trees: Sequence[Tree], headings: Sequence[str]) -> str:
    """Markdown table with a column of figures for each tree."""
    columns = [metrics(tree) for tree in trees]
    rows = [("", *headings), ("---",) * (len(trees) + 1)]
    names = dict.fromkeys(name for column in reversed(columns) for name in column)
    rows += [(name, *(column.get(name, "-") for column in columns)) for name in names]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def write_page(trees: Sequence[Tree], page: Path = PAGE) -> None:
    """Write the table of the trees to ``page``, with hash and date of each commit."""
    headings = [
        tree.name if tree.name == NOW else _git("log", "-1", "--format=%h, %cs", tree.name).strip() for tree in trees
    ]
    command = " ".join(["--write", *(tree.name for tree in trees if tree.name != NOW)])
    page.write_text(
        f'# Structure\n\nWritten by `make metrics ARGS="{command}"`. Each column is a commit, with its date.\n\n'
        f"{table(trees, headings)}"
        + "".join(
            f"\n## Levels at {name}\n\n{_LEVELS_TEXT}\n\n{drawing(tree)}"
            for tree, name in zip(trees, headings, strict=True)
        ),
        encoding="utf-8",
    )


_LEVELS_TEXT = """Folders and modules of the package `analogrig`, or `harness` before. Each imports only from lines
below its own."""


def drawing(tree: Tree) -> str:
    """The folders by level, the highest first, as a block of text; a circle stands in brackets."""
    found = arrows(tree)
    imports = {name: {b for a, b in found if a == name} for pair in found for name in pair}
    rings = {name: frozenset(circle) for circle in circles(found) for name in circle}
    groups = {rings.get(name, frozenset({name})) for name in imports}
    level: dict[frozenset[str], int] = {}
    while len(level) < len(groups):
        for group in groups - level.keys():
            below = {rings.get(b, frozenset({b})) for name in group for b in imports[name]} - {group}
            if below <= level.keys():
                level[group] = 1 + max((level[each] for each in below), default=0)
    lines = []
    for number in sorted(set(level.values()), reverse=True):
        names = sorted(_ring(group) for group, own in level.items() if own == number)
        lines += textwrap.wrap(f"{number:2}  {'  '.join(names)}", 98, subsequent_indent="    ", break_on_hyphens=False)
    return "\n".join(["```text", *lines, "```", ""])


def _ring(group: frozenset[str]) -> str:
    return " ".join(sorted(group)) if len(group) == 1 else f"[{' '.join(sorted(group))}]"


def show_arrows(tree: Tree) -> None:
    found = arrows(tree)
    wrong = set(upward(found))
    for pair, imports in found.items():
        inner = "; ".join(f"{a} imports {b}" for a, b in imports) if pair in wrong else ""
        print(f"{'UP ' if pair in wrong else '   '}{pair[0]} -> {pair[1]} {len(imports)}  {inner}".rstrip())


def main(arguments: Sequence[str]) -> None:
    commits = [each for each in arguments if each not in ("--arrows", "--write")]
    trees = [read(commit) for commit in commits] or [read(None)]
    if "--arrows" in arguments:
        for tree in trees:
            show_arrows(tree)
    elif "--write" in arguments:
        write_page(trees)
    else:
        print(table(trees, [tree.name for tree in trees]), end="")


if __name__ == "__main__":
    main(sys.argv[1:])
