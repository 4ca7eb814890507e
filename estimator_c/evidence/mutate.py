"""Mutation test of the core: every operator, constant, condition and statement, one at a time.

`make mutate` makes each mutant, runs the tests on it until one fails, and prints those that none notices. MUTATION.md
explains them; one that it does not explain, or an explanation whose mutant is noticed or gone, is a failure.
They are tried in an order by chance, so that a run which ends early has tried a sample; ARGS="--sample 60" takes so
many, --seed 2 others. What became of each is written as soon as it is known. ARGS=--resume goes on with a run that
ended early, and after a change of core or tests tries again what the change may have altered: the mutants of functions
that were rewritten, and the survivors that nobody has explained.

The tests are loaded and collected once and forked for each mutant, those first that notice most in the least time, and
what they simulate is kept.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import dataclasses
import functools
import hashlib
import importlib
import itertools
import json
import multiprocessing
import os
import pickle
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import hypothesis
import pytest
from hypothesis import Phase

__all__ = [
    "EXPLAINED",
    "Mutant",
    "Outcome",
    "Session",
    "explained",
    "main",
    "mutants",
    "mutants_of",
    "recalled",
    "sampled",
    "sources",
    "table",
    "try_all",
    "write",
]

ROOT = Path(__file__).parents[2]
CORE = ROOT / "estimator_c" / "core"
EXPLAINED = ROOT / "estimator_c" / "evidence" / "MUTATION.md"
GENERATED = ROOT / "build" / "generated"

TESTS = (
    *("tests/estimator_c/test_est_estimation.py", "tests/estimator_c/test_est_watch.py"),
    *("tests/estimator_c/test_est_trigger.py", "tests/estimator_c/test_est_adversarial.py"),
    "tests/estimator_c/test_est_correlation.py",
    *("tests/estimator_c/test_numerics.py", "tests/estimator_c/test_reference.py"),
)
LONG = "not millions_of_samples and not long_free_running and not rarer_than_promised"
DEADLINE_S = 8
"""A mutant may not come to an end. For each test, in seconds of the processor: the machine may be busy. A test that
takes long on the core as it is has four times that."""

FLAGS = (
    *("-std=c99", "-O1", "-w", "-fPIC", "-ffp-contract=off", "-D__OPTIMIZE_SIZE__=1", "-DEST_NC_MAX=2U", "-DNDEBUG"),
    *("-fsanitize=bounds-strict", "-fsanitize-undefined-trap-on-error"),
    *(f"-I{path}" for path in (*(CORE.parent / part for part in ("device", "isolation", "fit")), GENERATED)),
)
"""One copy of each equation's code: the others are for speed, and test_est_builds.py compares them."""

TESTED, HASHED = (), ("-DEST_THETA_MAX=8U",)
"""Compiler options of the core for the tests, and for bit_exact.c."""

AROUND = {
    TESTED: (
        ROOT / "tests" / "estimator_c" / "est_driver.c",
        *(CORE.parent / "ports" / "library").glob("*.c"),
        *(CORE.parent / "isolation").glob("*.c"),
        *(CORE.parent / "fit").glob("*.c"),
        CORE.parent / "device" / "settings.c",
    ),
    HASHED: (CORE.parent / "evidence" / "bit_exact.c", *(CORE.parent / "isolation").glob("*.c")),
}
"""Sources that call the core, by its compiler options."""

SWAPS = {
    "<": ("<=", ">="),
    ">": (">=", "<="),
    "<=": ("<", ">"),
    ">=": (">", "<"),
    "==": ("!=",),
    "!=": ("==",),
    "+": ("-",),
    "-": ("+",),
    "*": ("/",),
    "/": ("*",),
    "&&": ("||",),
    "||": ("&&",),
    "+=": ("-=",),
    "-=": ("+=",),
    "*=": ("/=",),
}
OPERATOR = re.compile(rf"(?<= )({'|'.join(re.escape(op) for op in sorted(SWAPS, key=len, reverse=True))})(?= )")
"""The layout of the sources puts blanks around binary operators, and around no other."""

NOT = re.compile(r"!(?=[\w(])")
MINUS = re.compile(r"(?<=[(?:,=] )-(?=[\w(])|(?<=\()-(?=[\w(])")
WHOLE = re.compile(r"\b(\d+)[Uu]\b")
REAL = re.compile(r"\b(\d+\.\d+(?:e-?\d+)?)F\b")
CONDITION = re.compile(r"\b(?:if|while) \((.*)\) \{$")
STATEMENT = re.compile(r"^ +(?!return|break|const|static|float|bool|u?int\w*_t|est_\w+_t |\(void\))[\w*(][^;]*;$")
DEFINITION = re.compile(r"^(?!#|typedef|static const|__attribute__)(?:\w[\w* ]*?\b)?(\w+)\(")
CONSTANT = re.compile(r"^#define (\w+) \S*\d")
SETTING = re.compile(r"EST_(?:N[ABCK]|THETA)_MAX|EST_VERSION|EST_WITH|EST_FIXED")


@dataclass(frozen=True)
class Mutant:
    """One line, altered."""

    file: str
    line: int
    function: str
    """Name of the function or macro."""
    before: str
    after: str

    @property
    def key(self) -> tuple[str, str, str, str]:
        """Key of the mutant, independent of its line number."""
        return self.file, self.function, code_of(self.before).strip(), code_of(self.after).strip()


@dataclass(frozen=True)
class Outcome:
    """Outcome of one mutant."""

    mutant: Mutant
    fate: str
    """killed, survived, equivalent (the same machine code), or invalid (it does not compile)."""
    by: str = ""
    """The test that noticed it."""
    source: str = ""
    """A digest of the function that was altered, as it was."""


def code_of(line: str) -> str:
    """Line of code without its comment."""
    return line.split("//", maxsplit=1)[0]


def altered(line: str) -> Iterator[str]:
    """The line with each alteration in turn."""
    code = code_of(line)

    def put(start: int, end: int, text: str) -> str:
        return line[:start] + text + line[end:]

    for match in OPERATOR.finditer(code):
        yield from (put(*match.span(), other) for other in SWAPS[match[0]])
    for pattern in (NOT, MINUS):
        yield from (put(*match.span(), "") for match in pattern.finditer(code))
    for match in WHOLE.finditer(code):
        number = int(match[1])
        yield from (put(*match.span(), f"{other}U") for other in (number + 1, number - 1) if other >= 0)
    for match in REAL.finditer(code):
        others = ("1.0F",) if float(match[1]) == 0.0 else (f"({match[0]} + 1.0F)", f"(-{match[0]})")
        yield from (put(*match.span(), other) for other in others)
    if condition := CONDITION.search(code.rstrip()):
        yield from (put(*condition.span(1), truth) for truth in ("true", "false"))
    if STATEMENT.match(code.rstrip()):
        yield line[: len(line) - len(line.lstrip())] + ";"


def mutants() -> list[Mutant]:
    """All of the core, in the order of the sources."""
    return [mutant for path in sorted(CORE.glob("*.[ch]")) for mutant in mutants_of(path)]


def mutants_of(path: Path) -> Iterator[Mutant]:
    """Mutants of one file, in the order of its lines."""
    for number, function, line in _lines_of(path):
        yield from (Mutant(path.name, number, function, line, after) for after in altered(line))


def _lines_of(path: Path) -> Iterator[tuple[int, str, str]]:
    """Number, function or macro, and text of each line that may be altered."""
    function = ""
    for number, line in enumerate(path.read_text().splitlines(), 1):
        constant, definition = CONSTANT.match(line), DEFINITION.match(line)
        if definition:
            function = definition[1]
        if constant and not SETTING.search(constant[1]):
            yield number, constant[1], line
        elif function and not line.startswith("#") and "EST_ASSERT" not in line:
            yield number, function, line
        if (line.rstrip().endswith("}") and (line.startswith("}") or definition)) or line.endswith(");"):
            function = function if line.startswith(" ") else ""


@functools.cache
def sources() -> dict[tuple[str, str], str]:
    """A digest of each function and macro of the core, by file and name; remarks do not count."""
    text: dict[tuple[str, str], list[str]] = {}
    for path in sorted(CORE.glob("*.[ch]")):
        for _, function, line in _lines_of(path):
            text.setdefault((path.name, function), []).append(code_of(line).strip())
    return {
        where: hashlib.sha256("\n".join(filter(None, lines)).encode()).hexdigest()[:16] for where, lines in text.items()
    }


def sampled(every: Sequence[Mutant], count: int, seed: int = 1) -> list[Mutant]:
    """Random sample of ``count`` mutants. It stays the same when lines move or other mutants come or go."""
    return sorted(every, key=lambda mutant: hashlib.sha256(repr((seed, mutant.key)).encode()).digest())[:count]


def shown(key: tuple[str, str, str, str]) -> str:
    """Key of a mutant in the form of MUTATION.md."""
    file, function, before, after = key
    return f"@ {file} {function}\n- {before}\n+ {after}"


def explained(path: Path = EXPLAINED) -> dict[tuple[str, str, str, str], str]:
    """The mutants of MUTATION.md, or of another list like it, and the heading that each stands under."""
    found, heading, where = {}, "", ("", "")
    before = ""
    for line in path.read_text().splitlines():
        if line.startswith("## "):
            heading = line[3:]
        elif match := re.match(r"@ (\S+) (\S+)$", line):
            where = (match[1], match[2])
        elif line.startswith("- "):
            before = line[2:]
        elif line.startswith("+ "):
            found[*where, before, line[2:]] = heading
    return found


# ---- what is known of an earlier run


def _numbered(every: Iterable[Mutant]) -> Iterator[tuple[Mutant, tuple[object, ...]]]:
    """Mutants with unique names: the key, and the number of earlier mutants with that key."""
    seen: Counter[tuple[str, str, str, str]] = Counter()
    for mutant in every:
        yield mutant, (*mutant.key, seen[mutant.key])
        seen[mutant.key] += 1


def recalled(
    record: Path, every: Sequence[Mutant], known: Container[tuple[str, str, str, str]]
) -> dict[Mutant, Outcome]:
    """The outcomes of an earlier run that still hold: the function is as it was, and a survivor has been explained."""
    if not record.exists():
        return {}
    before = [
        Outcome(**{**outcome, "mutant": Mutant(**outcome["mutant"])})
        for outcome in json.loads(record.read_text())["mutants"]
    ]
    names = dict(_numbered(outcome.mutant for outcome in before))
    outcomes = {names[outcome.mutant]: outcome for outcome in before}
    held = {}
    for mutant, name in _numbered(every):
        outcome = outcomes.get(name)
        if outcome is None or outcome.source != sources()[mutant.file, mutant.function]:
            continue
        if outcome.fate != "survived" or mutant.key in known:
            held[mutant] = dataclasses.replace(outcome, mutant=mutant)
    return held


def write(record: Path, outcomes: Iterable[Outcome]) -> None:
    """Write all outcomes at once: a run may be ended at any time."""
    ordered = sorted(outcomes, key=lambda outcome: (outcome.mutant.file, outcome.mutant.line, outcome.mutant.after))
    fates = Counter(outcome.fate for outcome in ordered)
    record.parent.mkdir(parents=True, exist_ok=True)
    unfinished = record.with_suffix(".unfinished")
    unfinished.write_text(
        json.dumps({"fates": fates, "mutants": [asdict(outcome) for outcome in ordered]}, indent=1) + "\n"
    )
    unfinished.replace(record)


# ---- the tests, loaded once


_library = Path()


KEPT = {
    "tests.estimator_c.test_est_trigger": ("suspension", "statistic_of_the_twin"),
    "tests.estimator_c.test_est_estimation": ("batch",),
    "tests.estimator_c.test_numerics": ("wide",),
    "tests.estimator_c.test_reference": ("followed",),
}
"""Functions of the tests that take time and do not ask the core. A module comes before those that import from it."""


def _kept(function: Callable[..., Any]) -> Callable[..., Any]:
    """Function with cached results: tests may write into the results that they get."""
    known: dict[bytes, bytes] = {}

    @functools.wraps(function)
    def kept(*arguments: Any) -> Any:
        key = pickle.dumps(arguments)
        if key not in known:
            known[key] = pickle.dumps(function(*arguments))
        return pickle.loads(known[key])  # noqa: S301 - our own

    return kept


def _load_tests() -> None:
    """Makes every test use the library of the mutant."""
    sys.path.insert(0, str(ROOT))
    hypothesis.settings.register_profile(
        "mutants",
        phases=(Phase.explicit, Phase.generate),  # the smallest example is not wanted
    )
    hypothesis.settings.load_profile("mutants")
    driver = importlib.import_module("tests.estimator_c.est_driver")
    driver.compile_driver = lambda _: _library  # type: ignore[attr-defined]
    for name, functions in KEPT.items():
        module = importlib.import_module(name)
        for function in functions:
            setattr(module, function, _kept(getattr(module, function)))
    estimator = importlib.import_module("analogrig.devices.library").Estimator
    start = estimator.__init__

    @functools.wraps(start)
    def start_mutant(self: Any, config: Any = None) -> None:
        start(self, config, library=_library)

    estimator.__init__ = start_mutant


class Session:
    """A session of pytest: each test twice on the core as it is, to fill what is kept and to see how long it takes.

    Then ``work``, which has them run again in forks.

    :param arguments: what pytest runs.
    :param noticed: how many mutants each test is known to have noticed.
    :param begin: called in each fork before its first test.
    :param deadline_s: longest time of a test in a fork, in seconds of the processor; a slow test has more.
    """

    def __init__(
        self,
        arguments: Sequence[str],
        noticed: Mapping[str, int],
        work: Callable[[Session], None],
        *,
        begin: Callable[[pytest.Session], None] = lambda _: None,
        deadline_s: int = DEADLINE_S,
    ) -> None:
        self._arguments, self._noticed, self._work = arguments, noticed, work
        self._begin, self._deadline_s = begin, deadline_s
        self._tests: list[pytest.Item] = []
        self._seconds: dict[str, float] = {}
        self._outside = sys.stdout
        self._failed = ""
        self._before_each: Callable[[pytest.Item], None] = lambda _: None

    def run(self) -> None:
        """Run the session; RuntimeError if a test fails on the core as it is."""
        options = "-q --assert=plain -p no:xdist -p no:cacheprovider -o timeout=0 -s -p no:faulthandler".split()
        with Path(os.devnull).open("w") as nothing, contextlib.redirect_stdout(nothing):
            status = pytest.main([*options, *self._arguments], plugins=[self])
        if self._failed or status != pytest.ExitCode.OK:
            raise RuntimeError(f"the tests fail on the core as it is: {self._failed or status!r}")

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Replace the test loop of pytest."""
        self._tests, self._session = session.items, session
        if not (self._first_failure() or self._first_failure()):
            self._tests.sort(key=self._price)
            with contextlib.redirect_stdout(self._outside):
                self._work(self)
        return True

    def _price(self, test: pytest.Item) -> float:
        """Seconds that a test takes for each mutant noticed."""
        return self._seconds[test.nodeid] / (1 + self._noticed.get(_name(test.nodeid), 0))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note the first failure."""
        if report.failed and not self._failed:
            self._failed = _name(report.nodeid)

    def _first_failure(self) -> str:
        for test, following in itertools.zip_longest(self._tests, self._tests[1:]):
            self._before_each(test)
            start = time.process_time()
            test.ihook.pytest_runtest_protocol(item=test, nextitem=following)
            self._seconds[test.nodeid] = time.process_time() - start
            if self._failed:
                break
        return self._failed

    def _limit(self, test: pytest.Item) -> None:
        """Limit the time of the next test in this fork."""
        _set_deadline(max(self._deadline_s, 4 * int(self._seconds[test.nodeid] + 1.0)))

    def first_failure(self) -> str:
        """First failure with the present library, in a fork; a crash or a time-out counts as one."""
        receiver, sender = os.pipe()
        child = os.fork()
        if child == 0:
            self._before_each = self._limit
            self._begin(self._session)
            nothing = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nothing, 1)
            os.dup2(nothing, 2)
            os.write(sender, self._first_failure().encode())
            os._exit(0)
        os.close(sender)
        with os.fdopen(receiver) as pipe:
            said = pipe.read()
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        if status == -signal.SIGXCPU:
            return "no end"
        return said if status == 0 else f"crash: {status}"


def _set_deadline(deadline_s: int = DEADLINE_S) -> None:
    now = resource.getrusage(resource.RUSAGE_SELF)
    ends = int(now.ru_utime + now.ru_stime) + deadline_s
    resource.setrlimit(resource.RLIMIT_CPU, (ends, resource.RLIM_INFINITY))


def _name(nodeid: str) -> str:
    return nodeid.rsplit("/", 1)[-1]


# ---- the mutants


class _Build:
    """The core in a folder, with all that calls it; only what a mutant alters is compiled again."""

    def __init__(self, folder: Path, options: tuple[str, ...]) -> None:
        self._folder, self._options = folder, options
        shutil.copytree(CORE, folder)
        (folder / "around").mkdir()
        self._sources = sorted(path.name for path in folder.glob("*.c"))
        self._compile(self._sources)
        generated = sorted(GENERATED.glob("*.c")) if options == TESTED else []
        for path in (*AROUND[options], *generated):
            self._object(path, folder / "around")

    def copy(self, folder: Path) -> _Build:
        """Copy of the build, so that a mutant leaves nothing behind."""
        other = copy.copy(self)
        other._folder = shutil.copytree(self._folder, folder)  # noqa: SLF001 - of its own kind
        return other

    def _object(self, source: Path, into: Path) -> Path:
        out = into / f"{source.stem}.o"
        command = ["gcc", f"-I{self._folder}", *FLAGS, *self._options, "-c", str(source), "-o", str(out)]
        subprocess.run(command, check=True, capture_output=True)
        return out

    def _compile(self, names: Sequence[str]) -> bytes:
        """The machine code of these files."""
        return b"".join(self._object(self._folder / name, self._folder).read_bytes() for name in names)

    def differs(self, mutant: Mutant) -> bool:
        """Puts the mutant in; false if the machine code is as before. CalledProcessError if it does not compile."""
        names = [mutant.file] if mutant.file.endswith(".c") else self._sources
        before = b"".join((self._folder / name).with_suffix(".o").read_bytes() for name in names)
        lines = (CORE / mutant.file).read_text().splitlines()
        lines[mutant.line - 1] = mutant.after
        (self._folder / mutant.file).write_text("\n".join(lines) + "\n")
        return self._compile(names) != before

    def linked(self, *options: str) -> Path:
        """The library or the program."""
        out = self._folder / "out"
        objects = sorted(self._folder.rglob("*.o"))
        subprocess.run(["gcc", *options, *map(str, objects), "-o", str(out)], check=True, capture_output=True)
        return out


_begun: list[tuple[Session, tuple[_Build, _Build], str]] = []
"""The session, the core as it is, and its hash."""


def _hash(program: Path) -> str:
    done = subprocess.run([program], capture_output=True, text=True, preexec_fn=_set_deadline, check=False)
    return done.stdout + str(done.returncode)


def _try(mutant: Mutant) -> Outcome:
    """Try a mutant in a worker of the pool, a fork of the process that has begun the session."""
    global _library  # noqa: PLW0603 - the tests, in a fork of this process, look there
    session, plain, expected = _begun[-1]
    with tempfile.TemporaryDirectory() as scratch:
        try:
            tested = plain[0].copy(Path(scratch, "tested"))
            if not tested.differs(mutant):
                return Outcome(mutant, "equivalent")
            _library = tested.linked("-shared")
        except subprocess.CalledProcessError:
            return Outcome(mutant, "invalid")
        failed = session.first_failure()
        if failed:
            return Outcome(mutant, "killed", failed)
        hashed = plain[1].copy(Path(scratch, "hashed"))
        hashed.differs(mutant)
        same = _hash(hashed.linked()) == expected
        return Outcome(mutant, "survived", "same bits" if same else "other bits")


def try_all(
    chosen: Sequence[Mutant],
    jobs: int,
    noticed: Mapping[str, int],
    tell: Callable[[Outcome], None],
    marked: str = "",
) -> None:
    """Report each outcome as soon as it is known; RuntimeError if the tests fail on the core as it is.

    :param noticed: how many mutants each test is known to have noticed.
    :param marked: which tests run, by their marks.
    """
    global _library  # noqa: PLW0603
    os.chdir(ROOT)
    with tempfile.TemporaryDirectory() as scratch:
        plain = (_Build(Path(scratch, "tested"), TESTED), _Build(Path(scratch, "hashed"), HASHED))
        _library = plain[0].linked("-shared")
        expected = _hash(plain[1].linked())

        def work(session: Session) -> None:
            _begun.append((session, plain, expected))
            with ProcessPoolExecutor(jobs, multiprocessing.get_context("fork")) as pool:
                for future in as_completed([pool.submit(_try, mutant) for mutant in chosen]):
                    outcome = future.result()
                    where = (outcome.mutant.file, outcome.mutant.function)
                    tell(dataclasses.replace(outcome, source=sources()[where]))

        _load_tests()
        Session(["-k", LONG, "-m", marked, f"--rootdir={ROOT}", *TESTS], noticed, work).run()


def table(every: Sequence[Mutant], outcomes: Sequence[Outcome]) -> str:
    """Table of evidence/README.md: for each file the mutants, those tried, and their outcomes."""
    rows = ["| | mutants | tried | noticed | the same machine code | do not compile | not noticed |", f"|{'---|' * 7}"]
    for name, count in [*Counter(mutant.file for mutant in every).most_common(), ("all", len(every))]:
        fates = [outcome.fate for outcome in outcomes if name in ("all", outcome.mutant.file)]
        counts = (fates.count(fate) for fate in ("killed", "equivalent", "invalid", "survived"))
        rows.append(f"| {' | '.join(map(str, (name, count, len(fates), *counts)))} |")
    return "\n".join(rows)


def main() -> int:
    """Prints what survived; the exit status is 1 if something is unexplained."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sample", type=int, help="so many mutants, by chance, and no heavy test")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="mutants of the files whose name contains this")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "mutation.json")
    parser.add_argument("--resume", action="store_true", help="keep what still holds of the run that wrote --out")
    arguments = parser.parse_args()
    every = mutants()
    chosen = [mutant for mutant in sampled(every, len(every), arguments.seed) if arguments.only in mutant.file]
    chosen = chosen[: arguments.sample]
    known = explained()
    outcomes = recalled(arguments.out, every, known) if arguments.resume else {}
    noticed = Counter(outcome.by for outcome in outcomes.values() if outcome.fate == "killed")

    def tell(outcome: Outcome) -> None:
        outcomes[outcome.mutant] = outcome
        write(arguments.out, outcomes.values())
        if outcome.fate == "survived" and outcome.mutant.key not in known:
            print(shown(outcome.mutant.key), flush=True)

    if left := [mutant for mutant in chosen if mutant not in outcomes]:
        try_all(left, arguments.jobs, noticed, tell, "not heavy" if arguments.sample else "")
    print(table(every, list(outcomes.values())))
    survivors = {outcome.mutant.key for outcome in outcomes.values() if outcome.fate == "survived"}
    stale = known.keys() - survivors if len(outcomes) == len(every) else set()
    for key in sorted(stale):
        print(f"explained, but noticed or gone:\n{shown(key)}")
    return 1 if stale or survivors - known.keys() else 0


if __name__ == "__main__":
    sys.exit(main())
