"""Proof of no undefined behaviour in the core: Frama-C's Eva, an abstract interpreter, over eva.c. `make eva`.

For all orders of the model, any delay, any configuration and any samples: no access outside an array or by a stale
pointer, no read of what was not written, no overflow of whole numbers, no conversion out of range. NaN and the
infinities are numbers here: samples may be such. What keeps them out of the state is asked of est_invariants_hold()
after every step of the fuzzer and of the tests; intervals cannot show it, since they know of no relation between P,
theta and the data.

What was found of each set of orders is written to build/eva.json as soon as it is known; those that are there for this
very core are not analysed again.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import json
import re
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

__all__ = ["DEFAULT", "SHAPES", "Analysis", "Shape", "analysed", "main"]

HERE = Path(__file__).parent
CORE = HERE.parent / "core"
RESULTS = HERE.parents[1] / "build" / "eva.json"
THETA_MAX, NC_MAX = 6, 2
INIT = f"est_init_na2U_nb3U_nk1U_nc{NC_MAX}U_theta{THETA_MAX}U_full"
"""Name that est.h gives to est_init()."""

OPTIONS = (
    "-eva",
    "-main=main",
    "-machdep=x86_32",
    "-eva-auto-loop-unroll=12",
    "-eva-slevel=60",
    "-eva-slevel-function=main:2",
    "-eva-widening-delay=1",
    "-eva-widening-period=1",
    f"-eva-split-return-function=orders_valid:0,est_config_valid:0,{INIT}:0",
    "-warn-special-float=none",
)
"""Within a function as many paths are told apart as it has (with an ambiguous edge or not, each turn of a loop), but a
call has one outcome, or there would be their product. Only of these three functions what they return is told apart:
est_init() == true then means a valid configuration. The loop of main() is one of any samples. On 32 bits, as on the
targets, est_t has no padding at its end that would hide a read beyond its last array."""

SIZES = re.compile(r"^(\s*(?:const )?(?:float|est_past_t)\s+\w+)((?:\[[^]]*\])+)", re.MULTILINE)
"""Pattern of the declarations of arrays, with their sizes."""


@dataclass(frozen=True)
class Shape:
    """The orders of the model; the delay is any."""

    na: int
    nb: int
    nc: int
    offset: int

    @property
    def count(self) -> int:
        """Number of parameters."""
        return self.na + self.nb + self.nc + self.offset

    @property
    def defines(self) -> list[str]:
        """Definitions of the orders in the form that eva.c expects."""
        orders = {"NA": self.na, "NB": self.nb, "NC": self.nc, "OFFSET": self.offset}
        return [f"-DEST_NC_MAX={NC_MAX}U", *(f"-D{name}={value}U" for name, value in orders.items())]


DEFAULT = Shape(2, 3, 0, 1)
SHAPES = tuple(
    sorted(
        (
            shape
            for shape in itertools.starmap(Shape, itertools.product((1, 2), (1, 2, 3), range(NC_MAX + 1), (0, 1)))
            if shape.count <= THETA_MAX
        ),
        key=lambda shape: (shape != DEFAULT, -shape.count),
    )
)
"""Shapes to analyse, the default and the largest first."""


@dataclass(frozen=True)
class Analysis:
    """Result of Eva."""

    alarms: tuple[str, ...]
    reached: float
    """Fraction of statements reached, within the functions that were reached."""


def _literal(sizes: re.Match[str]) -> str:
    """Declaration with literal array sizes: Frama-C 25 stops at any other size."""

    def value(size: re.Match[str]) -> str:
        expression = re.sub(r"\((.*) \? (.*) : (.*)\)", r"(\2) if (\1) else (\3)", size[1].replace("U", ""))
        return f"[{int(eval(expression.replace('/', '//')))}]"  # noqa: S307 - of our own header

    return sizes[1] + re.sub(r"\[([^]]*)\]", value, sizes[2])


def _preprocessed(source: Path, folder: Path, shape: Shape) -> Path:
    share = subprocess.run(["frama-c", "-print-share-path"], check=True, capture_output=True, text=True).stdout.strip()
    options = ["-E", "-nostdinc", f"-I{share}/libc", f"-I{CORE}", "-D__FC_MACHDEP_X86_32", "-U__GNUC__", "-DNDEBUG"]
    done = subprocess.run(["gcc", *options, *shape.defines, source], check=True, capture_output=True, text=True)
    out = folder / f"{source.stem}.i"
    out.write_text(SIZES.sub(_literal, done.stdout))
    return out


def analysed(shape: Shape) -> Analysis:
    """Run Eva; RuntimeError if it does not finish."""
    with tempfile.TemporaryDirectory() as scratch:
        sources = [HERE / "eva.c", *sorted(CORE.glob("*.c"))]
        files = [_preprocessed(source, Path(scratch), shape) for source in sources]
        done = subprocess.run(["frama-c", *OPTIONS, *files], cwd=scratch, capture_output=True, text=True, check=False)
    count = re.search(r"^  (\d+) alarms? generated", done.stdout, re.MULTILINE)
    statements = re.search(r"(\d+) statements reached \(out of (\d+)\)", done.stdout)
    if done.returncode != 0 or count is None or statements is None:
        raise RuntimeError(f"frama-c came to no end: {done.stdout[-2000:]}{done.stderr}")
    alarms = tuple(re.findall(r"^\[eva:alarm\] (.*?)(?=^\[)", done.stdout, re.MULTILINE | re.DOTALL))
    if len(alarms) < int(count[1]):
        raise RuntimeError(f"{count[1]} alarms, of which {len(alarms)} were understood")
    return Analysis(alarms, int(statements[1]) / int(statements[2]))


def _digest() -> str:
    """Digest of the core and of its calls; comments and layout do not count."""
    texts = (re.sub(r"//.*", "", path.read_text()) for path in (HERE / "eva.c", *sorted(CORE.glob("*.[ch]"))))
    return hashlib.sha256(" ".join("".join(texts).split()).encode()).hexdigest()


def _known() -> dict[Shape, Analysis]:
    """Results of earlier runs on this same core."""
    if not RESULTS.exists():
        return {}
    record = json.loads(RESULTS.read_text())
    if record["core"] != _digest():
        return {}
    return {
        Shape(**one["shape"]): Analysis(tuple(one["found"]["alarms"]), one["found"]["reached"])
        for one in record["shapes"]
    }


def _write(known: dict[Shape, Analysis]) -> None:
    shapes = [{"shape": asdict(shape), "found": asdict(found)} for shape, found in known.items()]
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(json.dumps({"core": _digest(), "shapes": shapes}, indent=1) + "\n")


def main() -> int:
    """Prints a line for each shape; the exit status is 1 if there is an alarm."""
    if shutil.which("frama-c") is None:
        sys.stderr.write("make eva needs Frama-C: apt-get install frama-c-base\n")
        return 2
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--jobs", type=int, default=2)
    jobs = parser.parse_args().jobs
    known = _known()
    left = [shape for shape in SHAPES if shape not in known]
    with ThreadPoolExecutor(jobs) as pool:
        for shape, found in zip(left, pool.map(analysed, left), strict=True):
            known[shape] = found
            _write(known)
            print(f"{shape}: {len(found.alarms)} alarms, {100 * found.reached:.0f} % of the statements", flush=True)
    for found in known.values():
        print("".join(found.alarms), end="")
    alarms = sum(len(found.alarms) for found in known.values())
    print(f"{alarms} alarms in {len(known)} shapes")
    return 1 if alarms else 0


if __name__ == "__main__":
    sys.exit(main())
