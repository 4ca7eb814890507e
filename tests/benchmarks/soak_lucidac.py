"""Soak of the emulated LUCIDAC: random configurations against ngspice; seeds are printed.

python -m tests.benchmarks.soak_lucidac [COUNT [FIRST_SEED]]
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from tests.emulator.conftest import ngspice_in
from tests.emulator.lucidac_decks import ngspice_error_lsb

MOST_LSB = 0.05


def main(count: int = 50, first: int = 0) -> int:
    """Exit status: 1 if a configuration differs from ngspice by more than MOST_LSB."""
    errors_lsb = {}
    for seed in range(first, first + count):
        with tempfile.TemporaryDirectory() as folder:
            errors_lsb[seed] = ngspice_error_lsb(ngspice_in(Path(folder)), seed)
        print(f"seed {seed}: {errors_lsb[seed]:.4f} LSB", flush=True)
    failed = [seed for seed, error_lsb in errors_lsb.items() if error_lsb > MOST_LSB]
    print(f"seeds {first} to {first + count - 1}: at most {max(errors_lsb.values()):.4f} LSB of 16 bits; {failed=}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:])))
