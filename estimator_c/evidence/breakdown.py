"""Breakdown of a step's instructions on a Cortex-M4F, by function of the source and by kind; and the bytes of code.

python -m estimator_c.evidence.breakdown

An instruction belongs to the function that it was written in, wherever the compiler has put it. Beside what was counted
stands what the algebra alone needs: so many floating-point operations, and a load of each number that comes in and a
store of each that changes, once, if all others were kept in registers.
"""

from __future__ import annotations

import re
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from estimator_c.evidence.cost import (
    EVERYTHING,
    HERE,
    LARGE,
    M4F,
    SMALL,
    TRIGGER_ALONE,
    Orders,
    all_sources,
    core_sources,
    executed,
    link,
    missing_tools,
    run,
)

__all__ = ["bytes_by_function", "instructions", "least", "main"]

STEPS_N = 600
"""Steps of image.c."""

KINDS = (
    ("arithmetic", r"v(add|sub|mul|div|neg|nmul|abs|sqrt|cvt|ml|fm|nml)"),
    ("compare", r"(vcmp|vmrs|cmp|cmn|tst|teq|it)"),
    ("load, store", r"(v?ldr|v?str|v?ldm|v?stm|v?push|v?pop)"),
    ("branch", r"(b|bl|bx|blx|cbz|cbnz|b(eq|ne|cs|cc|mi|pl|vs|vc|hi|ls|ge|lt|gt|le))(\\.[nw])?$"),
    ("move", r"v?mov"),
    ("whole numbers", r""),
)
"""Kinds of instruction by the beginning of the mnemonic; the first match counts."""


def least(orders: Orders) -> dict[str, int]:
    """Least operations of a plain step: whitening with the gains settled, prediction, update, cumulative sum."""
    n, na = orders.count, orders.na
    whiten = (n + 1) * na * 2  # a multiplication and a subtraction for each past value of each element
    predict = 2 * n
    # Bierman's update, column j of n: v, p, alpha, 1 / alpha, d and its least; with each u above it f, u and the gain;
    # the first has no p, and there are the weight, what it makes of the noise and of the variance, and theta
    update = sum(8 + 6 * j for j in range(n)) - 1 + 3 + 1 + 2 * n
    trigger = 6
    # past values, theta, d, u and the weight in and out; the gains in
    moved = 2 * (n + 1) * na + 2 * n + 2 * n + n * (n - 1) + 2 + na
    return {"arithmetic": whiten + predict + update + trigger, "load, store": moved}


def _kind(mnemonic: str) -> str:
    return next(kind for kind, pattern in KINDS if re.match(pattern, mnemonic))


def _counted(image: Path) -> Counter[int]:
    """Number of executions of each instruction, by address."""
    blocks: dict[int, list[int]] = {}
    runs: Counter[int] = Counter()
    block = 0
    for line in executed(image, M4F.machine):
        if line.startswith(b"Trace "):
            runs[int(line.split(b"/", 2)[1], 16)] += 1
        elif line.startswith(b"IN:"):
            block = 0
        elif line.startswith(b"0x"):
            address = int(line[:10], 16)
            if not block:
                block, blocks[address] = address, []
            blocks[block].append(address)
    out: Counter[int] = Counter()
    for begin, count in runs.items():
        for address in blocks[begin]:
            out[address] += count
    return out


def _functions(image: Path, addresses: Sequence[int]) -> Iterator[str]:
    """The innermost function of the source at each address."""
    for at in range(0, len(addresses), 500):
        part = [f"{address:#x}" for address in addresses[at : at + 500]]
        yield from run(["arm-none-eabi-addr2line", "-f", "-e", image, *part]).splitlines()[::2]


def _disassembled(image: Path, *options: str) -> dict[int, tuple[str, int]]:
    """Mnemonic and bytes of each instruction."""
    listing = run(["arm-none-eabi-objdump", "-d", *options, image])
    rows = re.findall(r"^ *([0-9a-f]+):\t([0-9a-f ]+?) *\t(\S+)", listing, re.MULTILINE)
    return {int(address, 16): (name, len(code.replace(" ", "")) // 2) for address, code, name in rows}


def instructions(folder: Path, orders: Orders, *flags: str, fixed: bool) -> dict[str, Counter[str]]:
    """Instructions of all steps together, by function and kind."""
    sources = [HERE / "image.c", HERE / "subject_est.c", *core_sources()]
    image = link(folder / "image.elf", sources, ("-O2", "-g", *M4F.flags, *orders.flags(fixed=fixed), *flags))
    counted, code = _counted(image), _disassembled(image)
    addresses = sorted(counted)
    out: dict[str, Counter[str]] = {}
    for address, function in zip(addresses, _functions(image, addresses), strict=True):
        out.setdefault(function, Counter())[_kind(code[address][0])] += counted[address]
    return out


def bytes_by_function(folder: Path, *flags: str) -> Counter[str]:
    """Code at -Os of the core, without tables of constants, by the function of the source that it comes from."""
    image = link(folder / "footprint.elf", [HERE / "footprint.c", *all_sources()], ("-Os", "-g", *M4F.flags, *flags))
    code = _disassembled(image, "-j", ".text")
    out: Counter[str] = Counter()
    for (_, size), function in zip(code.values(), _functions(image, list(code)), strict=True):
        out[function] += size
    return out


def _print(found: Mapping[str, Counter[str]], least_of: Mapping[str, int]) -> None:
    kinds = [kind for kind, _ in KINDS]
    print(f"{'':32}{'all':>8}" + "".join(f"{kind:>15}" for kind in kinds))
    rows = sorted(found.items(), key=lambda row: -row[1].total())
    rows = [(name, row) for name, row in rows if row.total() >= STEPS_N]
    total = sum(found.values(), Counter())
    for name, row in (*rows, ("all", total)):
        shown = "".join(f"{row[kind] / STEPS_N:15.1f}" for kind in kinds)
        print(f"{name:32}{row.total() / STEPS_N:8.1f}{shown}")
    print(f"{'at least':32}{'':8}" + "".join(f"{least_of.get(kind, ''):>15}" for kind in kinds))


def main() -> int:
    """Print the tables."""
    if missing := missing_tools():
        sys.stderr.write(f"apt-get install {' '.join(missing)}\n")
        return 2
    with tempfile.TemporaryDirectory() as scratch:
        for orders in (SMALL, LARGE):
            for what, flags in (("", ()), (", trigger alone", TRIGGER_ALONE)):
                print(f"\n{orders.name}, fixed{what}: instructions a step, on average")
                _print(instructions(Path(scratch), orders, *flags, fixed=True), least(orders))
        for what, flags in (("everything", EVERYTHING), ("trigger alone", TRIGGER_ALONE)):
            found = bytes_by_function(Path(scratch), *flags)
            print(f"\n-Os, {what}: {found.total()} B of code")
            print("  ".join(f"{name} {size}" for name, size in found.most_common() if size >= 20))
    return 0


if __name__ == "__main__":
    sys.exit(main())
