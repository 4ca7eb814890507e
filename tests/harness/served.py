"""Emulated rig served as an instrument in another process."""

from __future__ import annotations

import contextlib
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from tests.served.serving import serving

ROOT = Path(__file__).parents[2]

RIG = """\
[rig.bench]
kind = "real"
instrument = "redpitaya://{address}"
timeout_s = 60.0
generator.gain = 10.0
inputs.force = {{ input = 1, range = "HV" }}
inputs.displacement = {{ input = 2, range = "HV" }}
pots.kind = "instrument"
self_test = {self_test}
"""


class Served(NamedTuple):
    process: subprocess.Popen[str]
    address: str

    def rigs_file(self, folder: Path, *, self_test: bool = False, more: str = "") -> Path:
        """Rigs file with the rig ``bench``: this instrument, correctly wired."""
        path = folder / "rigs.toml"
        path.write_text(RIG.format(address=self.address, self_test=str(self_test).lower()) + more)
        return path


@contextlib.contextmanager
def served(*arguments: str) -> Iterator[Served]:
    """Run ``analogrig serve`` with some arguments until the end of the block."""
    with serving(*arguments) as instrument:
        yield Served(instrument.process, instrument.said["address"])
