"""libFuzzer over the C, with address and undefined-behaviour sanitizers: `make fuzz`, and a test.

Every target is linked against all of the C that knows no operating system.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ESTIMATOR = Path(__file__).parents[1]
GENERATED = ESTIMATOR.parent / "build" / "generated"
PARTS = (ESTIMATOR / "core", ESTIMATOR / "isolation", ESTIMATOR / "fit", ESTIMATOR / "device", GENERATED)
LOOP = ESTIMATOR / "ports" / "loop"
HERE = ESTIMATOR / "fuzz"

LONGEST_INPUT = {"fuzz_est": 512, "fuzz_serial": 2048, "fuzz_can": 2048, "fuzz_slcan": 2048}
"""Longest input by target, in bytes: some hundred samples."""
LINES = ("fuzz_serial", "fuzz_can", "fuzz_slcan")
"""Targets that fuzz the device over a line."""

# clang 14 takes minutes for est.c with these sanitizers at -O1, seconds at -O0.
_SANITIZED = ("-g", "-O0", "-fsanitize=fuzzer,address,undefined", "-fno-sanitize-recover=undefined")
_INCLUDE = tuple(f"-I{part}" for part in (*PARTS, LOOP, HERE))
_FLAGS = ("-std=c99", *_SANITIZED, "-ffp-contract=off", "-DEST_NC_MAX=2U", *_INCLUDE)


def build(target: str, folder: Path) -> Path:
    """The program of a target, in ``folder``, where the next target finds the C that they share compiled.

    :raises subprocess.CalledProcessError: it does not compile.
    """
    program, objects = folder / target, folder / "objects"
    if not objects.is_dir():
        parts = [path for part in PARTS for path in sorted(part.glob("*.c"))]
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            subprocess.run(["clang", *_FLAGS, "-c", *map(str, parts)], cwd=scratch, check=True)
            shutil.copytree(scratch, objects)
    line = [HERE / "fuzz_line.c", *sorted(LOOP.glob("*_line.c"))] if target in LINES else []
    sources = [HERE / f"{target}.c", *line, *objects.glob("*.o")]
    subprocess.run(["clang", *_FLAGS, *map(str, sources), "-o", str(program)], check=True)
    return program


def fuzz(program: Path, *options: str) -> tuple[int, str]:
    """Run a program with its corpus beside it. Return the number of inputs tried (0: it found a fault), and its log.

    :param options: of libFuzzer. One of them must end it: ``-runs=N`` or ``-max_total_time=SECONDS``.
    """
    corpus = program.with_name(f"corpus_{program.name}")
    corpus.mkdir(exist_ok=True)
    limits = [f"-max_len={LONGEST_INPUT[program.name]}", "-rss_limit_mb=1024"]
    command = [str(program), *limits, "-print_final_stats=1", *options, corpus.name]
    done = subprocess.run(command, cwd=program.parent, stderr=subprocess.PIPE, text=True, errors="replace", check=False)
    executed = re.search(r"number_of_executed_units: (\d+)", done.stderr)
    return int(executed[1]) if executed is not None and done.returncode == 0 else 0, done.stderr


def main() -> int:
    """Fuzz every target in the folder that is the first argument."""
    folder, seconds = Path(sys.argv[1]).resolve(), int(os.environ["FUZZ_S"])
    folder.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(folder / "objects", ignore_errors=True)  # of the C as it was
    for target in LONGEST_INPUT:
        tried, log = fuzz(build(target, folder), f"-max_total_time={seconds}")
        if not tried:
            print(log[-4000:])
            return 1
        print(f"{target}: {tried} inputs in {seconds} s, nothing found")
    return 0


if __name__ == "__main__":
    sys.exit(main())
