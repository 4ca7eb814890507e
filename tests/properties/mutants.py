"""Mutants of the device against the shipped properties alone.

`make mutants` draws mutants of core, isolation, device and codec with a seed, builds each as the library of the device
in this process, and runs the shipped properties on it until one fails. It prints those that none fails. SURVIVORS.md
explains them; one that it does not explain is a failure, and so is a score below LEAST.

Only code that the library can reach counts: a mutant whose library has the same bytes is equivalent. The properties are
loaded and run once on the device as it is, and forked for each mutant, those first that fail most in the least time.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import multiprocessing
import os
import re
import shutil
import subprocess
import sys
import tempfile
import textwrap
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from estimator_c.evidence.mutate import Mutant, Outcome, Session, explained, mutants_of, sampled, shown, table
from tests.properties.planted import FOUND_ONLY, GENERATED, ROOT, SOURCES

PARTS = ("core", "isolation", "device")
"""Folders whose sources are altered."""
BESIDE = ("fit", "ports/library")
"""Folders of other sources of the library."""
LEAST = 0.95
"""Least part of the mutants with other code that the shipped properties fail."""

DEADLINE_S = 15
"""Longest time of one property on a mutant, which may not come to an end, in seconds of the processor."""

EXPORTED = ("library_*", *(f"{port}_device_{name}" for port in ("serial", "can") for name in ("size", "init", "run")))
"""Functions of the library that the harness calls."""

OPTIONS = (
    *("-std=c99", "-O2", "-w", "-fPIC", "-ffp-contract=off", "-D__OPTIMIZE_SIZE__=1", "-DEST_NC_MAX=2U", "-DNDEBUG"),
    "-flto=1",
)
"""One copy of each equation's code, as for ``make mutate``. The linker drops what nothing reaches."""

RECORD = ROOT / "build" / "mutants.json"
PAGE = ROOT / "harness" / "docs" / "evidence" / "mutants.md"
SURVIVORS = Path(__file__).with_name("SURVIVORS.md")
UNEXPLAINED = "not explained"
EQUIVALENT = "Equivalent: "
"""Beginning of the headings of survivors that no input of the device could show."""
PROGRESS_N, MOST_SHOWN, WIDTH = 50, 20, 98


def every_mutant() -> list[Mutant]:
    """All of core, isolation, device and codec, in the order of the sources."""
    files = [path for part in PARTS for path in sorted((SOURCES / part).glob("*.[ch]"))]
    return [mutant for path in (*files, *sorted(GENERATED.glob("*.c"))) for mutant in mutants_of(path)]


class Build:
    """The device in a folder; only what a mutant alters is compiled again."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        self.folder = folder
        self._exports = folder / "exports"
        self._exports.write_text(f"{{ global: {'; '.join(EXPORTED)}; local: *; }};\n")
        for part in (*PARTS, *BESIDE):
            for path in sorted((SOURCES / part).glob("*.[ch]")):
                shutil.copy(path, folder)
        for path in GENERATED.glob("*.[ch]"):
            shutil.copy(path, folder)
        self._compile(self._sources())
        self._bytes = self.linked().read_bytes()

    def _sources(self) -> list[str]:
        return sorted(path.name for path in self.folder.glob("*.c"))

    def _compile(self, names: Sequence[str], into: Path | None = None) -> None:
        for name in names:
            out = (into or self.folder) / f"{Path(name).stem}.o"
            command = ["gcc", *OPTIONS, f"-iquote{into or self.folder}", f"-I{self.folder}", "-c"]
            source = (into / name) if into and (into / name).exists() else self.folder / name
            subprocess.run([*command, str(source), "-o", str(out)], check=True, capture_output=True)

    def linked(self, other: Path | None = None) -> Path:
        """The library, with the objects of ``other`` in place of its own."""
        objects = {path.name: path for folder in (self.folder, other) if folder for path in folder.glob("*.o")}
        out = (other or self.folder) / "device.so"
        command = ["gcc", "-shared", *OPTIONS, "-Wl,--build-id=none", f"-Wl,--version-script={self._exports}"]
        files = [str(path) for _, path in sorted(objects.items())]
        subprocess.run([*command, *files, "-s", "-o", str(out)], check=True, capture_output=True)
        return out

    def mutated(self, mutant: Mutant, folder: Path) -> Path | None:
        """The library with a mutant; None if it has the same bytes. CalledProcessError if it does not compile."""
        lines = (self.folder / mutant.file).read_text(encoding="utf-8").splitlines()
        lines[mutant.line - 1] = mutant.after
        if mutant.file.endswith(".c"):
            (folder / mutant.file).write_text("\n".join(lines) + "\n", encoding="utf-8")
            names = [mutant.file]
        else:  # sources include headers beside them first
            names = [name for name in self._sources() if self._includes(name, mutant.file)]
            for path in (*self.folder.glob("*.h"), *(self.folder / name for name in names)):
                shutil.copy(path, folder)
            (folder / mutant.file).write_text("\n".join(lines) + "\n", encoding="utf-8")
        self._compile(names, folder)
        library = self.linked(folder)
        return None if library.read_bytes() == self._bytes else library

    def _includes(self, source: str, header: str) -> bool:
        """True if a source may include a header: all do but those of the codec."""
        return not source.startswith("analogrig_") or header.startswith("analogrig_")


_library: list[Path] = []
"""The library of the mutant in this process; the last one counts."""

_begun: list[tuple[Session, Build]] = []


def _load_mutants(device: Path) -> None:
    """Have ctypes load the mutant wherever the device is asked for, which is not the bundled library."""
    load: Callable[..., Any] = ctypes.CDLL

    def load_mutant(name: Any, *args: Any, **kwargs: Any) -> Any:
        return load(str(_library[-1]) if name == str(device) else name, *args, **kwargs)

    ctypes.CDLL = load_mutant  # type: ignore[assignment,misc]


def _forget_devices(session: pytest.Session) -> None:
    """Close the devices of the session: the next one is the mutant."""
    from analogrig.testing.plugin.devices import DEVICES

    session.config.stash[DEVICES].close()


def _try(mutant: Mutant) -> Outcome:
    """Try a mutant in a worker of the pool, a fork of the process that has begun the session."""
    session, build = _begun[-1]
    with tempfile.TemporaryDirectory() as scratch:
        try:
            library = build.mutated(mutant, Path(scratch))
        except subprocess.CalledProcessError:
            return Outcome(mutant, "invalid")
        if library is None:
            return Outcome(mutant, "equivalent")
        _library.append(library)
        failed = session.first_failure()
        return Outcome(mutant, "killed", failed) if failed else Outcome(mutant, "survived")


def try_all(
    chosen: Sequence[Mutant],
    jobs: int,
    noticed: Mapping[str, int],
    tell: Callable[[Outcome], None],
    only: str = "",
) -> None:
    """Report each outcome as soon as it is known; RuntimeError if a property fails on the device as it is."""
    with tempfile.TemporaryDirectory() as scratch:
        build = Build(Path(scratch, "device"))
        device = build.folder / "device.so"
        _library.append(device)
        _load_mutants(device)

        def work(session: Session) -> None:
            _begun.append((session, build))
            with ProcessPoolExecutor(jobs, multiprocessing.get_context("fork")) as pool:
                for future in as_completed([pool.submit(_try, mutant) for mutant in chosen]):
                    tell(future.result())

        arguments = [
            *("-c", os.devnull, f"--rootdir={scratch}", "-p", "no:randomly", "-p", FOUND_ONLY, "--tb=no"),
            *(
                "--pyargs",
                "analogrig.testing.properties",
                "--hil-dut",
                f"inproc:{device}",
                "--hil-runs-dir",
                f"{scratch}/runs",
            ),
            *(("-k", only) if only else ()),
        ]
        Session(arguments, noticed, work, begin=_forget_devices, deadline_s=DEADLINE_S).run()


def main() -> int:
    """Print what survived; the exit status is 1 if something is unexplained, or the score is too low."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sample", type=int, help="so many mutants, by chance (default: all)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the draw")
    parser.add_argument("--only", default="", help="mutants of the files whose name matches this")
    parser.add_argument("--properties", default="", help="properties to run, as for pytest -k")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--again", action="store_true", help="try only the survivors of the run that wrote --out")
    parser.add_argument("--out", type=Path, default=RECORD)
    arguments = parser.parse_args()
    every = [mutant for mutant in every_mutant() if re.search(arguments.only, mutant.file)]
    chosen = sampled(every, len(every), arguments.seed)[: arguments.sample]
    before = _recorded(arguments.out)
    noticed = Counter(outcome.by for outcome in before if outcome.fate == "killed")
    outcomes: list[Outcome] = []
    if arguments.again:
        outcomes = [outcome for outcome in before if outcome.fate != "survived"]
        chosen = [outcome.mutant for outcome in before if outcome.fate == "survived"]
    known = explained(SURVIVORS)

    def tell(outcome: Outcome) -> None:
        outcomes.append(outcome)
        if outcome.fate == "survived" and outcome.mutant.key not in known:
            _say(f"{shown(outcome.mutant.key)}   line {outcome.mutant.line}")
        if len(outcomes) % PROGRESS_N == 0:
            _say(f"{len(outcomes)} tried: {_score(outcomes, known)}")
        _write(arguments.out, outcomes)

    _say(f"{len(chosen)} of {len(every)} mutants, seed {arguments.seed}")
    try_all(chosen, arguments.jobs, noticed, tell, arguments.properties)
    survivors = {outcome.mutant.key for outcome in outcomes if outcome.fate == "survived"}
    command = " ".join(["make mutants", *(['ARGS="' + " ".join(sys.argv[1:]) + '"'] if sys.argv[1:] else [])])
    page = _page(command, arguments.seed, every, outcomes, {key: known.get(key, UNEXPLAINED) for key in survivors})
    if not arguments.only:
        PAGE.write_text(page, encoding="utf-8")
    _say(page)
    return 1 if survivors - known.keys() or _part_killed(outcomes, known) < LEAST else 0


def _part_killed(outcomes: Sequence[Outcome], known: Mapping[tuple[str, str, str, str], str]) -> float:
    """Part of the mutants failed by a property, of those that are not known to be equivalent."""
    killed = sum(outcome.fate == "killed" for outcome in outcomes)
    missed = [outcome.mutant.key for outcome in outcomes if outcome.fate == "survived"]
    others = sum(not known.get(key, UNEXPLAINED).startswith(EQUIVALENT) for key in missed)
    return killed / max(killed + others, 1)


def _score(outcomes: Sequence[Outcome], known: Mapping[tuple[str, str, str, str], str]) -> str:
    fates = Counter(outcome.fate for outcome in outcomes)
    return (
        f"{fates['killed']} failed by a property, {fates['survived']} survived: {_part_killed(outcomes, {}):.1%}, or"
        f" {_part_killed(outcomes, known):.1%} of those not known to be equivalent;"
        f" {fates['equivalent']} of the same code, {fates['invalid']} do not compile"
    )


def _page(
    command: str,
    seed: int,
    every: Sequence[Mutant],
    outcomes: Sequence[Outcome],
    survivors: Mapping[tuple[str, str, str, str], str],
) -> str:
    """Page of the documentation."""
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    killers = Counter(outcome.by for outcome in outcomes if outcome.fate == "killed").most_common(MOST_SHOWN)
    headings = Counter(survivors.values())
    lines = [
        "# Mutants against the shipped properties",
        "",
        f"`{command}`,",
        f"{time.strftime('%Y-%m-%d')}, commit {commit.stdout.strip()}, seed {seed}:",
        "the shipped properties alone, on the device in this process, each mutant until the first property",
        "fails.",
        *(
            ("With `--again` the survivors of a run before were tried anew, and no others.",)
            if "--again" in command
            else ()
        ),
        "",
        *textwrap.wrap(f"**{_score(outcomes, survivors)}.**", WIDTH),
        "",
        table(every, outcomes),
        "",
        "A mutant has the same code if the library is the same to the byte: the linker drops what no",
        "function that the harness calls can reach. `slcan` is part of the device program, not of the",
        "library.",
        "",
        "## Survivors",
        "",
        "`tests/properties/SURVIVORS.md` names those that have a reason.",
        "",
        "| reason | survivors |",
        "|---|---|",
        *(f"| {heading} | {count} |" for heading, count in headings.most_common()),
        "",
        "## Properties that failed most",
        "",
        "| property | mutants |",
        "|---|---|",
        *(f"| `{name.partition('::')[2] or name}` | {count} |" for name, count in killers),
        "",
    ]
    return "\n".join(lines)


def _write(path: Path, outcomes: Sequence[Outcome]) -> None:
    """Write all outcomes at once: a run may be ended at any time."""
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_suffix(".unfinished")
    unfinished.write_text(json.dumps([asdict(outcome) for outcome in outcomes], indent=1) + "\n")
    unfinished.replace(path)


def _recorded(path: Path) -> list[Outcome]:
    tables = json.loads(path.read_text()) if path.exists() else []
    return [Outcome(**{**each, "mutant": Mutant(**each["mutant"])}) for each in tables]


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
