"""Stack of est_step() by processor and level of optimisation, in bytes: a part of `make cost`.

The deepest chain of calls, from the frames of -fstack-usage and the calls in the assembly. Arithmetic routines and
memcpy() of the compiler's library are not counted; they need some 20 bytes more.
"""

from __future__ import annotations

import functools
import re
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

__all__ = ["AVR", "BUILDS", "CORTEX_M0", "CORTEX_M4F", "LEVELS", "Toolchain", "stack_bytes"]

CORE = Path(__file__).parents[1] / "core"

LEVELS = ("-O0", "-Os", "-O2", "-O3")

CALL = re.compile(r"^\s+(?:r?call|bl?|b\.w|r?jmp)\s+([A-Za-z_][\w.]*)\s*$", re.MULTILINE)
FUNCTION = re.compile(r"^([A-Za-z_][\w.]*):\n(.*?)^\s+\.size\s+\1,", re.MULTILINE | re.DOTALL)
CLONE = re.compile(r"(\.(?:constprop|isra|part))\.\d+\b")
"""Name and number of a copy that gcc makes of a function. The list of the frames lacks the number."""
FRAME = re.compile(r"^.*:([\w.]+)\t(\d+)\t(?:static|dynamic,bounded)$", re.MULTILINE)


@dataclass(frozen=True)
class Toolchain:
    """Processor and the compiler for it. Frames of avr-gcc include the return address."""

    name: str
    compiler: str
    flags: tuple[str, ...]


CORTEX_M0 = Toolchain("M0", "arm-none-eabi-gcc", ("-mcpu=cortex-m0", "-mthumb"))
CORTEX_M4F = Toolchain(
    "M4F", "arm-none-eabi-gcc", ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16")
)
AVR = Toolchain("AVR", "avr-gcc", ("-mmcu=atmega328p",))
BUILDS = (CORTEX_M4F, CORTEX_M0, AVR)


def stack_bytes(processor: Toolchain, level: str, folder: Path, *options: str, root: str = "est_step") -> int:
    """Bytes of stack that a call of ``root`` needs; the compiler's files are left in ``folder``.

    :raises ValueError: the calls are recursive, or a frame has no fixed size.
    """
    assembly = folder / "est.s"
    flags = ("-std=c99", "-ffp-contract=off", "-ffreestanding", "-DNDEBUG", "-fstack-usage", "-S", f"-I{CORE}")
    command = [processor.compiler, level, *processor.flags, *flags, *options, str(CORE / "est.c"), "-o", str(assembly)]
    subprocess.run(command, check=True)
    usage = assembly.with_suffix(".su").read_text()
    frames = {name: int(size) for name, size in FRAME.findall(usage)}
    if len(frames) != len(usage.splitlines()):
        raise ValueError(f"a frame has no fixed size, or two have one name: {usage}")
    code = CLONE.sub(r"\1", assembly.read_text())
    calls = {name: CALL.findall(body) for name, body in FUNCTION.findall(code)}
    return deepest(root, frames, calls)


def deepest(root: str, frames: Mapping[str, int], calls: Mapping[str, Sequence[str]]) -> int:
    """Sum of the frames along the deepest chain of calls from ``root``; unknown functions count nothing.

    :raises ValueError: a function calls itself, at once or by way of others.
    """

    @functools.cache
    def below(name: str, above: frozenset[str]) -> int:
        if name in above:
            raise ValueError(f"{name} is recursive")
        inside = [below(called, above | {name}) for called in set(calls.get(name, ())) - {name}]
        return frames.get(name, 0) + max(inside, default=0)

    return below(root, frozenset())
