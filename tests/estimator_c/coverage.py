"""Which lines and branches of the core its tests, through the public header, never take: gcov.

`make coverage` prints them.
"""

from __future__ import annotations

import gzip
import json
import os
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
TESTS = [str(HERE / f"test_est_{part}.py") for part in ("adversarial", "estimation", "trigger", "watch")]

# Each function once, not once for each shape that it is inlined for. Asserts are excluded: programmer's mistakes.
OPTIONS = "-O0 --coverage -DNDEBUG -Dalways_inline=unused"

WRAPPER = f"""#!/bin/sh
exec gcc "$@" {OPTIONS} -dumpdir {{folder}}/
"""


def record(folder: Path) -> None:
    """Runs the tests with the core compiled for gcov, the records in the folder."""
    compiler = folder / "cc"
    compiler.write_text(WRAPPER.format(folder=folder))
    compiler.chmod(0o755)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *TESTS]
    environment = os.environ | {"CC": str(compiler)}
    done = subprocess.run(command, env=environment, cwd=HERE.parents[1], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"the tests of the core failed under gcov:\n{done.stdout[-3000:]}")


def files(folder: Path) -> Iterator[dict[str, Any]]:
    """What gcov says of each source, once for each translation unit that includes it."""
    for data in sorted(folder.glob("*.gcda")):
        subprocess.run(
            ["gcov", "--json-format", "--branch-probabilities", data.name], cwd=folder, check=True, capture_output=True
        )
    for report in sorted(folder.glob("*.gcov.json.gz")):
        yield from json.loads(gzip.decompress(report.read_bytes()))["files"]


def never_taken(folder: Path) -> tuple[list[str], int]:
    """Lines and branches of the core never taken, as file:line: what, and how many of both there are."""
    taken: defaultdict[tuple[str, int, int], int] = defaultdict(int)
    for file in files(folder):
        path = Path(file["file"])
        if path.parent.name != "core":
            continue
        for line in file["lines"]:
            place = (path.name, line["line_number"])
            taken[*place, -1] += line["count"]
            for index, branch in enumerate(line["branches"]):
                taken[*place, index] += branch["count"]
    missed = [
        f"{name}:{line}: {'line' if index < 0 else f'branch {index}'} never taken"
        for (name, line, index), times in sorted(taken.items())
        if times == 0
    ]
    return missed, len(taken)


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        record(Path(folder))
        missed, total = never_taken(Path(folder))
    sys.stdout.write("".join(f"{each}\n" for each in missed))
    sys.stdout.write(f"{total - len(missed)} of {total} lines and branches of the core are taken by its tests\n")


if __name__ == "__main__":
    main()
