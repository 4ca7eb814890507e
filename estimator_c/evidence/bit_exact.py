"""Bit-exactness of the estimates over all compilers and targets. `make bit-exact`.

Builds bit_exact.c in each way, runs it (foreign code in QEMU's user mode) and compares what it prints. x87 is none of
the targets: it computes in another precision.
"""

from __future__ import annotations

import itertools
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from estimator_c.evidence.cost import FLOAT_ROUTINES

__all__ = ["BUILDS", "QUICK", "Build", "main", "missing_tools", "outcome"]

HERE = Path(__file__).parent
CORE = HERE.parent / "core"
ISOLATION = HERE.parent / "isolation"

FLAGS = (
    *("-std=c99", "-static", "-Wall", "-Wextra", "-Wdouble-promotion", "-Werror"),
    *("-DEST_NC_MAX=2U", "-DEST_THETA_MAX=8U", f"-I{ISOLATION}"),
)
EXACT = "-ffp-contract=off"
LEVELS = ("-O0", "-O1", "-O2", "-O3")


@dataclass(frozen=True)
class Target:
    """A processor to make programs for, what runs them here, Debian's package of its C library, and sources of ours."""

    name: str
    compiler: str
    emulator: str
    libc: str
    library: tuple[str, ...] = ()


FOREIGN = (
    Target("ARM, soft float", "arm-linux-gnueabi-gcc", "qemu-arm", "libc6-dev-armel-cross"),
    Target("Cortex-M0's float", "arm-linux-gnueabi-gcc", "qemu-arm", "libc6-dev-armel-cross", (str(FLOAT_ROUTINES),)),
    Target("ARM, hard float", "arm-linux-gnueabihf-gcc", "qemu-arm", "libc6-dev-armhf-cross"),
    Target("aarch64", "aarch64-linux-gnu-gcc", "qemu-aarch64", "libc6-dev-arm64-cross"),
    Target("riscv64", "riscv64-linux-gnu-gcc", "qemu-riscv64", "libc6-dev-riscv64-cross"),
    Target("PowerPC, big-endian", "powerpc-linux-gnu-gcc", "qemu-ppc", "libc6-dev-powerpc-cross"),
)
PACKAGES = {
    "gcc": "gcc",
    "clang": "clang",
    **{target.compiler: f"gcc-{target.compiler.removesuffix('-gcc')} {target.libc}" for target in FOREIGN},
    **{target.emulator: "qemu-user" for target in FOREIGN},
}


@dataclass(frozen=True)
class Build:
    """One way to make and run the program."""

    name: str
    command: tuple[str, ...]
    runner: tuple[str, ...] = ()


def _builds() -> Iterator[Build]:
    here = (*((level,) for level in LEVELS), ("-O3", "-march=native"))
    for compiler, flags in itertools.product(("gcc", "clang"), here):
        yield Build(f"this machine, {compiler} {' '.join(flags)}", (compiler, *flags))
    for target, level in itertools.product(FOREIGN, LEVELS):
        yield Build(f"{target.name}, gcc {level}", (target.compiler, level, *target.library), (target.emulator,))


BUILDS = tuple(_builds())
QUICK = tuple(build for build in BUILDS if "-O2" in build.command or (not build.runner and "-O3" in build.command))
"""Each target once, and three ways of each compiler on this machine."""


def run(command: Sequence[str | Path]) -> str:
    """Output of a program; SystemExit with its error message if it fails."""
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    if done.returncode != 0:
        raise SystemExit(f"bit-exact: {command[0]} ended with status {done.returncode}:\n{done.stdout}{done.stderr}")
    return done.stdout.strip()


def outcome(build: Build, *, contraction: str = EXACT, core: Path = CORE) -> str:
    """Output of the program built in the given way, with the core of this folder."""
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder, "bit_exact")
        sources = [HERE / "bit_exact.c", *sorted(core.glob("*.c")), *sorted(ISOLATION.glob("*.c"))]
        run([*build.command, *FLAGS, f"-I{core}", contraction, *sources, "-o", program])
        return run([*build.runner, program])


def missing_tools() -> list[str]:
    """The Debian packages that this machine lacks."""
    return sorted({package for program, package in PACKAGES.items() if shutil.which(program) is None})


def main() -> None:
    """Print a line for each build; exit with 1 unless all are the same."""
    if missing_tools():
        sys.exit(f"make bit-exact needs compilers and emulators: apt-get install {' '.join(missing_tools())}")
    with ThreadPoolExecutor(2) as pool:
        outcomes = []
        for build, line in zip(BUILDS, pool.map(outcome, BUILDS), strict=True):
            print(f"{build.name:<38} {line}", flush=True)
            outcomes.append(line)
    if len(set(outcomes)) > 1:
        sys.exit("bit-exact: the results differ")


if __name__ == "__main__":
    main()
