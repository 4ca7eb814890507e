"""Soak of the emulated LUCIDAC: random configurations against ngspice; seeds are printed.

python -m tests.bench.soak_lucidac [COUNT [FIRST_SEED]]

A deck that ngspice gives up, or that takes it longer than LIMIT_S, is replaced by that of a further seed.
"""

from __future__ import annotations

import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from tests.emulator.conftest import UnfinishedError, ngspice_in
from tests.emulator.lucidac_decks import ngspice_error_lsb

MOST_LSB = 0.05
LIMIT_S = 120
PROCESSES = 2


def compare(seed: int) -> float | str:
    """Largest difference in LSB, or the reason why there is none."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            return ngspice_error_lsb(ngspice_in(Path(folder), LIMIT_S), seed)
        except UnfinishedError as error:
            return str(error)


def main(count: int = 50, first: int = 0) -> int:
    """Exit status: 1 if a configuration differs from ngspice by more than MOST_LSB, or too few were compared."""
    errors_lsb: dict[int, float] = {}
    left_out: dict[int, str] = {}
    seeds = range(first, first + 2 * count)
    with ProcessPoolExecutor(PROCESSES) as pool:
        for seed, found in zip(seeds, pool.map(compare, seeds), strict=True):
            if isinstance(found, str):
                left_out[seed] = found
                print(f"seed {seed}: {found}", flush=True)
            else:
                errors_lsb[seed] = found
                print(f"seed {seed}: {found:.4f} LSB", flush=True)
            if len(errors_lsb) == count:
                pool.shutdown(wait=False, cancel_futures=True)
                break
    failed = [seed for seed, error_lsb in errors_lsb.items() if error_lsb > MOST_LSB]
    print(f"{len(errors_lsb)} configurations: at most {max(errors_lsb.values()):.4f} LSB of 16 bits; {failed=}")
    print(f"{len(left_out)} not compared: {left_out}")
    return 1 if failed or len(errors_lsb) < count else 0


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:])))
