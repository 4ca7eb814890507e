"""Cost of the estimator on a Cortex-M: instructions per step, bytes of code, bytes of state. `make cost`.

Every block of code that QEMU executes is logged, and the instructions of a step are counted, from its first to its
last: exact, and the same each time. The caller (the section .outside of image.ld) is not counted. Prints a table and
writes build/cost.json, a list of {name, value, unit, limit, compared_with, ratio}.
"""

from __future__ import annotations

import itertools
import json
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from estimator_c.evidence import stack

__all__ = ["Cost", "costs", "count_steps", "executed", "link", "main", "missing_tools"]

HERE = Path(__file__).parent
CORE = HERE.parent / "core"
FLOAT_ROUTINES = HERE.parent / "ports" / "cortex_m0" / "float.S"
ISOLATION = HERE.parent / "isolation"
FIT = HERE.parent / "fit"
DEVICE = HERE.parent / "device"
LIBC = HERE.parent / "ports" / "loop" / "include"
CODECS = Path("build/generated")
RESULTS = Path("build/cost.json")

COMPILER = "arm-none-eabi-gcc"
SIMULATOR = "qemu-system-arm"
PACKAGES = {COMPILER: "gcc-arm-none-eabi", SIMULATOR: "qemu-system-arm", "avr-gcc": "gcc-avr avr-libc"}

FLAGS = (
    *("-std=c99", "-mthumb", "-ffreestanding", "-ffp-contract=off", "-DNDEBUG", "-ffunction-sections"),
    *("-Wall", "-Wextra", "-Wdouble-promotion", "-Werror"),
    *("-nostdlib", "-nostartfiles", "-Wl,--gc-sections", f"-I{CORE}", f"-I{ISOLATION}", f"-I{FIT}"),
)

SLICES_N = int(re.findall(r"define DEVICE_ISOLATION_SLICES (\d+)U", (DEVICE / "device.h").read_text("utf-8"))[0])
"""Slices of work on a diagnosis that the device does for each sample."""

CLOCK_MHZ, CYCLES = 168.0, 1.5
"""For estimates of time: the clock of a usual M4F, and cycles per instruction (1.2 to 2, as its memory has it)."""

EVEN = 1.25
"""Largest ratio of the instructions of the worst step to those of a typical step."""


@dataclass(frozen=True)
class Processor:
    """Processor, the board of QEMU that runs its code, and the needs beyond the compiler's library."""

    name: str
    flags: tuple[str, ...]
    machine: str
    library: tuple[Path, ...] = ()


M4F = Processor("M4F", ("-mcpu=cortex-m4", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16"), "mps2-an386")
M3 = Processor("M3", ("-mcpu=cortex-m3",), "mps2-an385")
M0 = Processor("M0", ("-mcpu=cortex-m0",), "mps2-an385", (FLOAT_ROUTINES,))
"""QEMU has no board of this kind with an M0, whose instructions are some of an M3's."""


@dataclass(frozen=True)
class Orders:
    """na, nb, nk and the offset, of a generator on the card's clock or, with may_slip, on one of its own."""

    na: int
    nb: int
    nk: int
    offset: int
    may_slip: bool = False

    @property
    def count(self) -> int:
        """Number of parameters."""
        return self.na + self.nb + self.offset

    @property
    def name(self) -> str:
        """Name of the orders in the table."""
        return f"n = {self.count}, edges {'may slip' if self.may_slip else 'locked'}"

    def flags(self, *, fixed: bool) -> tuple[str, ...]:
        """Compiler options for the subject; and for the core, if the orders are fixed at compile time."""
        orders = {"NA": self.na, "NB": self.nb, "NK": self.nk, "OFFSET": self.offset}
        chosen = tuple(f"-DSUBJECT_{name}={value}U" for name, value in orders.items())
        if not self.may_slip:
            chosen += ("-DSUBJECT_LOCKED",)
        if not fixed:
            return chosen
        return (*chosen, *(f"-DEST_FIXED_{name}={value}U" for name, value in {**orders, "NC": 0}.items()))


SMALL = Orders(2, 2, 1, 0)
LARGE = Orders(2, 3, 0, 1)
FREE = Orders(2, 3, 0, 1, may_slip=True)
"""The default configuration."""

# A build with the default trigger and nothing that can be left out; its configuration has been checked on the host.
TRIGGER_ALONE = tuple(
    f"-DEST_WITH_{what}=0" for what in ("EDGES", "TRIGGERS", "ADAPTATION", "WATCH", "CHECKS", "ROBUSTNESS")
)


# What footprint.c is to use.
EVERYTHING = ("-DFOOTPRINT_ALL",)
ISOLATES = "-DFOOTPRINT_ISOLATES"
WATCHES = "-DFOOTPRINT_WATCHES"


@dataclass(frozen=True)
class Cost:
    """One line of the table. ratio: the value over the limit, or over what it is compared with."""

    name: str
    value: float
    unit: str
    limit: float | None = None
    compared_with: str = ""
    ratio: float | None = None

    def __str__(self) -> str:
        """A row of the table that is printed."""
        row = f"{self.name:<58} {self.value:>6.6g} {self.unit:<12}"
        if self.limit is not None:
            row += f" {'within' if self.value <= self.limit else 'BEYOND'} {self.limit:g}"
        if self.compared_with:
            row += f" {self.ratio:.2f} times {self.compared_with}"
        return row.rstrip()


# ---- images


def run(command: Sequence[str | Path]) -> str:
    """Output of a tool; SystemExit with its error message if it fails."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise SystemExit(f"cost: {' '.join(map(str, command[:1]))} failed:\n{done.stderr}")
    return done.stdout


def link(image: Path, sources: Iterable[Path], flags: Iterable[str]) -> Path:
    """Compile and link the sources into the file ``image``; laid out by image.ld."""
    script = HERE / "image.ld"
    run([COMPILER, *FLAGS, *flags, "-T", script, *sources, "-lgcc", "-o", image])
    return image


def core_sources() -> list[Path]:
    """The estimator, whatever files it has."""
    return sorted(CORE.glob("*.c"))


def all_sources() -> list[Path]:
    """Sources of the estimator with isolation and the watch of the fit."""
    return [*core_sources(), *sorted(ISOLATION.glob("*.c")), *sorted(FIT.glob("*.c"))]


def symbols(image: Path) -> dict[str, tuple[int, int]]:
    """Address and size of each symbol of an image; without the lowest bit, which stands for Thumb code."""
    rows = (line.split() for line in run(["arm-none-eabi-nm", "-S", image]).splitlines())
    sized = {row[-1]: (int(row[0], 16) & ~1, int(row[1], 16) if len(row) == 4 else 0) for row in rows if len(row) >= 3}
    return {name: place for name, place in sized.items() if not name.startswith("$")}


def section_bytes(image: Path, *names: str) -> int:
    """The size of these sections together."""
    rows = (line.split() for line in run(["arm-none-eabi-size", "-A", image]).splitlines())
    return sum(int(row[1]) for row in rows if row and row[0] in names)


# ---- instructions


def _between(log: Iterable[bytes], ends: set[int]) -> Iterator[tuple[int, int]]:
    """Each of these addresses that was come to, and the instructions executed from there to the next of them.

    QEMU disassembles each block of straight-line code once, after "IN:", and names it each time it executes it:
    Trace 0: 0x7f.. [00000000/address/flags/flags] function
    """
    length: dict[int, int] = {}
    block = count = begun = 0
    for line in log:
        if line.startswith(b"Trace "):
            address = int(line.split(b"/", 2)[1], 16)
            if address in ends:
                if begun:
                    yield begun, count
                begun, count = address, 0
            count += length[address]
        elif line.startswith(b"IN:"):
            block = 0
        elif line.startswith(b"0x"):
            address = int(line[:10], 16)
            block = block or address
            length[block] = 1 if address == block else length[block] + 1


def executed(image: Path, machine: str) -> Iterator[bytes]:
    """The log of QEMU's run of an image, line by line: what it executes of the measured sections, block by block.

    SystemExit if the image judges that its run was not what it is made for: subject_judge() in its source.
    """
    places = symbols(image)
    first, last = places["measured_start"][0], places["measured_end"][0]
    command = [
        "timeout",
        "120",
        SIMULATOR,
        "-M",
        machine,
        "-kernel",
        str(image),
        "-nographic",
        "-monitor",
        "none",
        "-serial",
        "null",
    ]
    command += ["-semihosting", "-d", "in_asm,exec,nochain", "-dfilter", f"{first:#x}..{last - 1:#x}"]
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE) as simulator:
        assert simulator.stderr is not None  # noqa: S101 - it is a pipe
        yield from simulator.stderr
    if simulator.returncode != 0:
        raise SystemExit(
            f"cost: {image.name} ended with status {simulator.returncode}: see subject_judge() in its source"
        )


def count_steps(image: Path, machine: str, step: str, *others: str) -> list[int]:
    """Instructions of each call of the function ``step``, in the order of the calls.

    The program calls ``others`` in between. SystemExit under the conditions of ``executed``.
    """
    places = symbols(image)
    ends = {places[name][0] for name in (step, *others, "after_last_step")}
    return [count for begun, count in _between(executed(image, machine), ends) if begun == places[step][0]]


@dataclass(frozen=True)
class Steps:
    """The instructions of each step of a run, and what was run."""

    name: str
    counts: Sequence[int]

    @property
    def typical(self) -> float:
        """The median."""
        return statistics.median(self.counts)

    def costs(self, limit: float | None) -> Iterator[Cost]:
        """The typical step, and how much longer the longest is."""
        yield Cost(self.name, self.typical, "instructions", limit)
        worst = max(self.counts)
        yield Cost(
            f"{self.name}, worst", worst, "instructions", EVEN * self.typical, "the typical step", worst / self.typical
        )


class ImageRunner:
    """Make images in a folder, and run them."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def estimator(self, processor: Processor, orders: Orders, *, fixed: bool = False, alone: bool = False) -> Steps:
        """The steps of the estimator; orders fixed at compile time or not, with all it can do or the trigger alone."""
        name = f"{processor.name}, {orders.name}{', fixed' if fixed else ''}{', trigger alone' if alone else ''}"
        sources = [HERE / "image.c", HERE / "subject_est.c", *core_sources()]
        flags = (*orders.flags(fixed=fixed), *(TRIGGER_ALONE if alone else ()))
        return self._steps(name, processor, sources, flags, "est_step")

    def isolation(self, processor: Processor, orders: Orders) -> Iterator[Steps]:
        """Steps of isolation: entering a sample, which costs most at an alarm, and each slice of work after that."""
        calls = ("est_isolation_work", "est_isolation_enter", "est_step")
        sources = [HERE / "image.c", HERE / "subject_est.c", *all_sources()]
        flags = ("-O2", *processor.flags, *orders.flags(fixed=False), "-DSUBJECT_ISOLATES")
        image = link(self._folder / "image.elf", sources, flags)
        work = count_steps(image, processor.machine, *calls)
        slices = [count for count in work if count > min(work)]
        yield Steps(f"{processor.name}, isolation, a slice of work", slices)
        together = [sum(slices[first : first + SLICES_N]) for first in range(len(slices) - SLICES_N)]
        yield Steps(f"{processor.name}, isolation, the {SLICES_N} slices of a sample", together)
        entered = count_steps(image, processor.machine, *calls[1:], calls[0])
        yield Steps(f"{processor.name}, isolation, a sample entered", entered)

    def fit(self, processor: Processor, orders: Orders) -> Steps:
        """Samples entered into the watch of the fit, over more than a block of it."""
        sources = [HERE / "image.c", HERE / "subject_est.c", *all_sources()]
        flags = ("-O2", *processor.flags, *orders.flags(fixed=False), "-DSUBJECT_WATCHES", "-DSAMPLES_N=1400U")
        image = link(self._folder / "image.elf", sources, flags)
        return Steps(
            f"{processor.name}, fit, a sample entered",
            count_steps(image, processor.machine, "est_fit_enter", "est_step"),
        )

    def device(self, processor: Processor) -> Steps:
        """The steps of the device: a frame decoded, a sample entered, its answers encoded."""
        sources = [HERE / "image.c", HERE / "subject_device.c", *all_sources()]
        sources += [*sorted(DEVICE.glob("*.c")), *sorted(CODECS.glob("*.c"))]
        folders = [f"-I{folder}" for folder in (DEVICE, CODECS, LIBC)]
        late = ("-DSAMPLES_N=800U", "-DLATE_SAMPLE=581U")  # edge and change come after the default warm-up
        image = link(self._folder / "image.elf", sources, ("-O2", *processor.flags, *folders, *late))
        counts = count_steps(image, processor.machine, "device_step", "between_steps")
        return Steps(f"{processor.name}, the whole device, n = 6", counts)

    def _steps(
        self, name: str, processor: Processor, sources: Sequence[Path], flags: Sequence[str], step: str
    ) -> Steps:
        image = link(self._folder / "image.elf", [*sources, *processor.library], ("-O2", *processor.flags, *flags))
        return Steps(name, count_steps(image, processor.machine, step))

    def text_bytes(self, *flags: str) -> int:
        """Code and constants of the core, without memset and memcpy of a C library."""
        return section_bytes(self._footprint(*flags), ".text", ".rodata")

    def state_bytes(self, state: str, *flags: str) -> int:
        """The size of what the variable ``state`` of footprint.c holds."""
        return symbols(self._footprint(*flags))[state][1]

    def _footprint(self, *flags: str) -> Path:
        sources = [HERE / "footprint.c", *all_sources()]
        return link(self._folder / "footprint.elf", sources, ("-Os", *M4F.flags, *flags))


# ---- the table


def costs(folder: Path) -> Iterator[Cost]:
    """All costs; images are made in ``folder``."""
    bench = ImageRunner(folder)
    yield from instructions(bench)
    yield from soft_float(bench)
    for name, flags, limit in (
        ("code of the core at -Os, everything", EVERYTHING, 4600),
        ("code of the core at -Os, trigger alone", TRIGGER_ALONE, 1536),
    ):
        text_bytes = bench.text_bytes(*flags)
        yield Cost(f"M4F, {name}", text_bytes, "B", limit, ratio=text_bytes / limit)
    state_bytes = bench.state_bytes("estimator")
    yield Cost("M4F, state: sizeof(est_t)", state_bytes, "B", 448, ratio=state_bytes / 448)
    for build, level in itertools.product(stack.BUILDS, stack.LEVELS):
        yield Cost(f"{build.name}, stack of est_step() at {level}", stack.stack_bytes(build, level, folder), "B")
    yield from isolation(bench)
    yield from fit(bench)
    for processor in (M4F, M3):
        yield from device(bench.device(processor))


def device(steps: Steps) -> Iterator[Cost]:
    """A sample's frame in, the eight frames of its answer out; and the time that this may take."""
    yield Cost(steps.name, steps.typical, "instructions")
    yield Cost(f"{steps.name}, worst", max(steps.counts), "instructions")
    estimate_us = steps.typical * CYCLES / CLOCK_MHZ
    yield Cost(f"{steps.name}, an estimate of its time at {CLOCK_MHZ:g} MHz", round(estimate_us, 1), "us")


def isolation(bench: ImageRunner) -> Iterator[Cost]:
    """Costs of isolation beside the core, on the M4F."""
    for steps in bench.isolation(M4F, LARGE):
        yield Cost(steps.name, steps.typical, "instructions")
        yield Cost(f"{steps.name}, worst", max(steps.counts), "instructions")
    text_bytes = bench.text_bytes(*EVERYTHING, ISOLATES) - bench.text_bytes(*EVERYTHING)
    yield Cost("M4F, code of isolation at -Os, beside the core's", text_bytes, "B")
    yield Cost("M4F, state: sizeof(est_isolation_t)", bench.state_bytes("isolation", ISOLATES), "B")


def fit(bench: ImageRunner) -> Iterator[Cost]:
    """Costs of the watch of the fit beside the core, on the M4F."""
    steps = bench.fit(M4F, LARGE)
    yield Cost(steps.name, steps.typical, "instructions")
    yield Cost(f"{steps.name}, worst", max(steps.counts), "instructions")
    text_bytes = bench.text_bytes(*EVERYTHING, WATCHES) - bench.text_bytes(*EVERYTHING)
    yield Cost("M4F, code of the watch of the fit at -Os, beside the core's", text_bytes, "B")
    yield Cost("M4F, state: sizeof(est_fit_watch_t)", bench.state_bytes("fit", WATCHES), "B")


def instructions(bench: ImageRunner) -> Iterator[Cost]:
    """Costs in instructions, on the M4F."""
    for orders, at_run_time, at_compile_time in ((SMALL, 400, 340), (LARGE, 750, 520), (FREE, 750, 520)):
        for fixed, limit in ((False, at_run_time), (True, at_compile_time)):
            yield from bench.estimator(M4F, orders, fixed=fixed).costs(limit)
            if not orders.may_slip:
                yield from bench.estimator(M4F, orders, fixed=fixed, alone=True).costs(limit)


def soft_float(bench: ImageRunner) -> Iterator[Cost]:
    """On processors without floating point: libgcc's routines, whose length depends on the numbers."""
    for processor in (M3, M0):
        yield from bench.estimator(processor, SMALL).costs(7000)


def missing_tools() -> list[str]:
    """The Debian packages that this machine lacks."""
    return [package for program, package in PACKAGES.items() if shutil.which(program) is None]


def main() -> None:
    """Print the table and write the file."""
    if missing_tools():
        sys.exit(f"make cost needs a cross compiler and a simulator: apt-get install {' '.join(missing_tools())}")
    measured = []
    with tempfile.TemporaryDirectory() as folder:
        for cost in costs(Path(folder)):
            print(cost, flush=True)
            measured.append(cost)
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(json.dumps([asdict(cost) for cost in measured], indent=1) + "\n")


if __name__ == "__main__":
    main()
