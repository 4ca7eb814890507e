"""The programs that tests take from the operating system, and the Debian packages that provide them: the one list.

Tests declare what they need with ``@pytest.mark.tools("ngspice", ...)``. tests/conftest.py skips those whose tools are
missing, and ends the session with `table`.

    python3 -m tests.tools install    install the packages that are missing (`make tools`)
    python3 -m tests.tools            list the packages that are missing
    python3 -m tests.tools check      fail if a test would skip for lack of a tool

This module runs before the environment exists: standard library only.
"""

from __future__ import annotations

import functools
import os
import re
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
GUEST_LINUX = ROOT / "build" / "can_guest" / "linux"
FIRMWARE = Path(os.environ.get("ANALOGRIG_FIRMWARE", ROOT / "build" / "firmware"))
APT_GET = "apt-get install --no-install-recommends"

SILVERBOX_SETTING, SILVERBOX_FOLDER, SILVERBOX_NAME = "ANALOGRIG_SILVERBOX", "../shared/data/silverbox", "SNLS80mV.csv"
"""Environment variable, its default, and the file in that folder: measured data that is not part of the repository."""


def silverbox_file() -> Path:
    """File of the Silverbox, which may be absent."""
    return Path(os.environ.get(SILVERBOX_SETTING, SILVERBOX_FOLDER)) / SILVERBOX_NAME


PACKAGES = {
    "gcc": "gcc",
    "gcov": "gcc",
    "bash": "bash",
    "g++": "g++",
    "cmake": "cmake",
    "clang": "clang libclang-rt-dev",
    "clang-format-14": "clang-format-14",
    "clang-tidy": "clang-tidy",
    "cppcheck": "cppcheck",
    "frama-c": "frama-c-base",
    "ngspice": "ngspice",
    "chromium": "chromium",
    "qemu-system-arm": "qemu-system-arm",
    "qemu-system-x86_64": "qemu-system-x86",
    "ip": "iproute2",
    "qemu-arm": "qemu-user",
    "qemu-aarch64": "qemu-user",
    "qemu-riscv64": "qemu-user",
    "qemu-ppc": "qemu-user",
    "arm-none-eabi-gcc": "gcc-arm-none-eabi",
    "avr-gcc": "gcc-avr avr-libc",
    "arm-linux-gnueabi-gcc": "gcc-arm-linux-gnueabi libc6-dev-armel-cross",
    "arm-linux-gnueabihf-gcc": "gcc-arm-linux-gnueabihf libc6-dev-armhf-cross",
    "aarch64-linux-gnu-gcc": "gcc-aarch64-linux-gnu libc6-dev-arm64-cross",
    "riscv64-linux-gnu-gcc": "gcc-riscv64-linux-gnu libc6-dev-riscv64-cross",
    "powerpc-linux-gnu-gcc": "gcc-powerpc-linux-gnu libc6-dev-powerpc-cross",
}
"""Packages of each program, separated by blanks."""

ALTERNATIVES = {"chromium": ("chromium", "google-chrome")}
"""Other names of a program."""


@dataclass(frozen=True)
class Built:
    """Files that make builds, and the program it builds them with (None: make tools provides it)."""

    files: tuple[Path, ...]
    target: str
    program: str | None = None


BUILT = {
    "firmware": Built(
        (
            *(FIRMWARE / f"analogrig-{board}.elf" for board in ("m0", "m3", "m4", "m7", "f405")),
            FIRMWARE / "text_firmware.elf",
        ),
        "firmware",
        "arm-none-eabi-gcc",
    ),
    "guest kernel": Built((GUEST_LINUX / "vmlinux",), "build/can_guest/linux"),
}

FIXTURES = {"ngspice": ("ngspice",), "browser": ("chromium",)}
"""Tools of fixtures: a test that uses the fixture needs them."""

BASE = ("gcc", "libc6-dev", "make", "git", "python3", "python3-venv")
"""Packages of the bare machine: enough for `make run` and `make test`."""


def missing(names: Iterable[str]) -> tuple[str, ...]:
    """All tools of ``names`` that this machine lacks, without repetition.

    :raises KeyError: the list has no such tool.
    """
    lacking = []
    for name in names:
        if name in BUILT:
            built = BUILT[name]
            if not all(path.exists() for path in built.files):
                cannot_build = built.program is not None and found(built.program) is None
                lacking.append(str(built.program) if cannot_build else name)
        elif name not in PACKAGES:
            raise KeyError(name)
        elif found(name) is None:
            lacking.append(name)
    return tuple(dict.fromkeys(lacking))


def found(name: str) -> str | None:
    """Path of the program, by whichever name it goes."""
    return next(filter(None, map(shutil.which, ALTERNATIVES.get(name, (name,)))), None)


def reason(lacking: Sequence[str]) -> str:
    """One line: every missing tool, and how to get them."""
    return f"needs {', '.join(lacking)}: {cure(lacking)}"


def cure(lacking: Iterable[str]) -> str:
    """The command that provides the tools."""
    lacking = tuple(lacking)
    packages = resolved(package for name in lacking for package in PACKAGES.get(name, "").split())
    targets = [BUILT[name].target for name in lacking if name in BUILT]
    commands = ((APT_GET, packages), ("make", targets))
    return " && ".join(f"{command} {' '.join(words)}" for command, words in commands if words)


def table(lacking_by_test: Sequence[Sequence[str]]) -> list[str]:
    """Lines: how many tests wait for which tool, and the command that installs all of them."""
    counts = Counter(name for lacking in lacking_by_test for name in lacking)
    rows = [("tests", "tool", "provided by")]
    for name, count in sorted(counts.items(), key=lambda item: (-item[1], item[0])):
        rows.append((str(count), name, f"make {BUILT[name].target}" if name in BUILT else PACKAGES[name]))
    width = max(len(name) for _, name, _ in rows)
    return [
        *(f"{count:>6}  {name:<{width}}  {package}".rstrip() for count, name, package in rows),
        "",
        f"{len(lacking_by_test)} tests wait for a tool. All tools: make tools",
        f"These alone: {cure(sorted(counts))}",
    ]


def resolved(packages: Iterable[str]) -> list[str]:
    """The packages without repetition; the runtime of clang's sanitizers under the name it has here."""
    return list(dict.fromkeys(_runtime_of_clang() if name == "libclang-rt-dev" else name for name in packages))


@functools.cache
def _runtime_of_clang() -> str:
    """Debian's name of the package depends on the version of clang."""
    told = _output("apt-cache", "depends", "clang")
    version = re.search(r"Depends: clang-(\d+)", told)
    return f"libclang-rt-{version[1]}-dev" if version else "libclang-rt-dev"


def wanted() -> list[str]:
    """Every package of the list."""
    return resolved([*BASE, *(package for packages in PACKAGES.values() for package in packages.split())])


def not_installed(packages: Iterable[str]) -> list[str]:
    """Packages that dpkg does not have."""
    status = "--showformat=${db:Status-Status}"
    return [name for name in packages if _output("dpkg-query", "--show", status, name) != "installed"]


def _output(*command: str) -> str:
    try:
        return subprocess.run(command, capture_output=True, text=True, check=False).stdout
    except FileNotFoundError:
        return ""


def install() -> None:
    """Install what is missing, as root or by way of sudo.

    :raises SystemExit: this machine has no apt, or apt failed.
    """
    if shutil.which("apt-get") is None:
        sys.exit(f"make tools needs apt (Debian, Ubuntu); the packages are: {' '.join(wanted())}")
    if not not_installed(wanted()):
        return
    as_root = [] if os.geteuid() == 0 else ["sudo"]
    if as_root and shutil.which("sudo") is None:
        sys.exit(f"make tools needs root, and there is no sudo; as root: {APT_GET} {' '.join(not_installed(wanted()))}")
    retrying = [*as_root, "env", "DEBIAN_FRONTEND=noninteractive", "apt-get", "-o", "Acquire::Retries=3", "-qq"]
    _apt([*retrying, "update"])
    packages = not_installed(wanted())
    unknown = [name for name in packages if not _output("apt-cache", "show", "--no-all-versions", name)]
    if unknown:
        sys.stderr.write(f"make tools: apt knows no package {', '.join(unknown)}; the tests that need it will skip\n")
    packages = [name for name in packages if name not in unknown]
    sys.stdout.write(f"installing {' '.join(packages)}\n")
    sys.stdout.flush()
    _apt([*retrying, "install", "--yes", "--no-install-recommends", *packages])


def _apt(command: list[str]) -> None:
    if subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode != 0:
        sys.exit(f"make tools: failed: {' '.join(command)}")


def main(arguments: Sequence[str]) -> None:
    if list(arguments) == ["install"]:
        install()
    elif list(arguments) == ["check"]:
        if lacking := missing([*PACKAGES, *BUILT]):
            sys.exit(reason(lacking))
    else:
        sys.stdout.write("".join(f"{name}\n" for name in not_installed(wanted())))


if __name__ == "__main__":
    main(sys.argv[1:])
