"""Calibration of twenty random rigs: distance of the twins, and coverage of their standard errors.

python -m tests.bench.bench_calibration [FIRST LAST]    prints a line a rig besides
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator

import numpy as np
from scipy.stats import chi2

from analogrig_instruments.calibration.averages import check_scenario
from analogrig_instruments.calibration.fit import POTS, Calibration
from tests.harness.calibration_rigs import DrawnRig, calibrate_rig, draw_rig, rms_lsb, thesis_profile, truth

from .figure import Figure

RIGS_N = 20
LIMIT_LSB = 1.0
CONFIDENCE = 0.998


def figures(numbers: Iterable[int] = range(RIGS_N), *, talkative: bool = False) -> Iterator[Figure]:
    """Figures of the rigs: distances on two scenarios outside the fit, kinds told right, chi-square of each value."""
    thesis, check, deviations = [], [], dict[str, list[float]]()
    right = 0
    for number in numbers:
        rig = draw_rig(number)
        found = calibrate_rig(rig, number, ("polypropylene", "polyester"), POTS)
        thesis.append(rms_lsb(rig, found.twin, thesis_profile(rig.program)))
        check.append(rms_lsb(rig, found.twin, check_scenario(rig.program)))
        right += _kind_is_right(rig, found)
        drawn_values = truth(rig)
        for each in found.estimates:
            deviations.setdefault(each.name, []).append((each.value - drawn_values[each.name]) / each.standard_error)
        if talkative:
            print(_line(number, rig, found, thesis[-1], check[-1]), flush=True)
    for name, distances in (("the thesis profile", thesis), ("other pots, levels and frequency", check)):
        remark = f"limit {LIMIT_LSB:g}: median {np.median(distances):.2f}, {len(distances)} rigs"
        yield Figure(f"calibration: largest distance of a twin, {name}", max(distances), "LSB rms", remark)
    yield Figure("calibration: rigs whose capacitors and way of setting pots are told", right, f"of {len(thesis)}")
    for name, z in deviations.items():
        yield _coverage(name, np.array(z))


def _coverage(name: str, z: np.ndarray) -> Figure:
    """Chi-square of a value over the rigs. Correct standard errors keep it in the given range with CONFIDENCE."""
    low, high = (float(chi2.ppf(0.5 + side * CONFIDENCE / 2, len(z))) for side in (-1, 1))
    remark = f"expected {len(z)}, {low:.1f} to {high:.1f}; the farthest {np.abs(z).max():.1f} standard errors off"
    return Figure(f"calibration: chi-square of {name}", float(z @ z), "", remark)


def _kind_is_right(rig: DrawnRig, found: Calibration) -> bool:
    there, twin = rig.description.computer, found.twin.computer
    return (there.components, there.pots) == (twin.components, twin.pots)


def _line(number: int, rig: DrawnRig, found: Calibration, thesis_lsb: float, check_lsb: float) -> str:
    computer = rig.description.computer
    return (
        f"{number:3} {rig.program:6} {computer.components:14} {computer.pots:12} {rig.description.card.bits} bits"
        f" chi-square {found.chi_square:4.0f} of {found.freedom}, {thesis_lsb:.2f} and {check_lsb:.2f} LSB"
        f"{'' if _kind_is_right(rig, found) else ', kind taken for another'}"
    )


def main() -> None:
    """Print the rows of the rigs from FIRST to LAST, or of the twenty."""
    first, last = map(int, sys.argv[1:3]) if len(sys.argv) == 3 else (0, RIGS_N - 1)
    for figure in figures(range(first, last + 1), talkative=True):
        print(figure, flush=True)


if __name__ == "__main__":
    main()
