"""Polarities of a patch: signs at the nodes that need the fewest inverters.

Integrators, summers, rectifiers, roots and dividers invert; the sign of a multiplier or a function generator is free.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.machine.stages import REFERENCE, PatchStage, StageKind

_MOST_TRIED_AT_ONCE = 14
"""Stages up to which all combinations of signs are tried."""

_Needs = Sequence[tuple[str, str, int]]
"""Rows (stage, source, -1 or 1): the cord needs the source with this times the stage's sign."""


def signs_of(stages: Sequence[PatchStage], inputs: Sequence[str], divisor_signs: Mapping[str, int]) -> dict[str, int]:
    """Sign of every input (1) and stage at its node.

    divisor_signs: sign of the divisor by divider.
    """
    names = [stage.name for stage in stages]
    needs = list(_needs(stages, divisor_signs))
    if len(names) <= _MOST_TRIED_AT_ONCE:
        every = np.array(list(itertools.product((1, -1), repeat=len(names))), dtype=np.int8)
        best = every[int(np.argmin(_inverters(every, names, inputs, needs)))]
    else:
        best = _improved(names, inputs, needs)
    return dict.fromkeys(inputs, 1) | dict(zip(names, best.tolist(), strict=True))


def inverted(stages: Sequence[PatchStage], signs: Mapping[str, int], divisor_signs: Mapping[str, int]) -> list[str]:
    """Sources that need an inverter with these signs, in order of use."""
    needs = [(source, times * signs[stage]) for stage, source, times in _needs(stages, divisor_signs)]
    return list(dict.fromkeys(source for source, sign in needs if sign != signs[source]))


def cord_sign(kind: StageKind, number: float, divisor_sign: int) -> int:
    """Sign of the source that a cord needs, relative to that of its stage; 0 if either will do."""
    if not kind.has_amplifier:
        return 0
    return -(1 if number > 0 else -1) * divisor_sign


def _needs(stages: Sequence[PatchStage], divisor_signs: Mapping[str, int]) -> Iterator[tuple[str, str, int]]:
    for stage in stages:
        cords = stage.cords[:1] if stage.kind is StageKind.QUOTIENT else stage.cords
        for cord in cords:
            times = cord_sign(stage.kind, cord.number, divisor_signs.get(stage.name, 1))
            if times and cord.source != REFERENCE:
                yield stage.name, cord.source, times


def _inverters(every: NDArray[np.int8], names: Sequence[str], inputs: Sequence[str], needs: _Needs) -> NDArray[np.intp]:
    """Number of inverters for each row of signs."""
    column = {name: every[:, i] for i, name in enumerate(names)}
    column |= {name: np.ones(len(every), np.int8) for name in inputs}
    wrong: dict[str, NDArray[np.bool_]] = {}
    for stage, source, times in needs:
        differs = times * column[stage] != column[source]
        wrong[source] = wrong[source] | differs if source in wrong else differs
    return np.asarray(sum((each.astype(np.intp) for each in wrong.values()), np.zeros(len(every), np.intp)))


def _improved(names: Sequence[str], inputs: Sequence[str], needs: _Needs) -> NDArray[np.int8]:
    """Signs that no change of one or two of them improves."""
    best = np.ones(len(names), np.int8)
    pairs = [*((i,) for i in range(len(names))), *itertools.combinations(range(len(names)), 2)]
    changes = np.ones((len(pairs), len(names)), np.int8)
    for row, places in enumerate(pairs):
        changes[row, list(places)] = -1
    count = int(_inverters(best[None], names, inputs, needs)[0])
    while True:
        tried = best * changes
        counts = _inverters(tried, names, inputs, needs)
        if counts.min() >= count:
            return best
        best, count = tried[int(np.argmin(counts))], int(counts.min())
