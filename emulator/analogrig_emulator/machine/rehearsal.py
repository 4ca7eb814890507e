"""Plays of a patch on drawn machines, from which its full scales are raised where real parts need more.

The trial play solves the equations. Offsets and tolerances of parts carry a chaotic flow or a drifting integrator
further, and a slow card plays for longer. The amplifiers here have no limits: their voltages show the scale needed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from analogrig_emulator.card.excitation import Excitation
from analogrig_emulator.circuit.components import COMPONENTS, NOMINAL
from analogrig_emulator.exceptions import EngineError, UnfitError
from analogrig_emulator.machine.patched_program import PatchedProgram
from analogrig_emulator.machine.suspension import SuspensionComputer
from analogrig_emulator.machine.trial import Reach

_SAMPLES = 1500
"""Samples of a run without a scenario."""

_BLOCK = 25
"""Samples after which a play is given up that goes to infinity: the engine's steps become short there."""

_MACHINES = ((20e3, 12), (1e3, 4))
"""Sample rates of the emulated rigs, and how many machines play at each: every other one of real parts."""

_OFFSETS_V = (4.5e-3, 1.5e-3)
"""Limit of the offsets that are drawn for nominal and for real parts, which have their own: 1.5 times those of rigs."""

_WARM_C = 50.0
_LARGEST_V = 300.0
"""Voltage beyond which no full scale holds the play."""


def rehearsed(program: PatchedProgram) -> dict[str, Reach]:
    """Range of each patched quantity on these machines, in its unit.

    Raises UnfitError for a flow that errors of the parts drive to infinity.
    """
    lengths, nodes = [_BLOCK] * (_SAMPLES // _BLOCK), [each.node for each in program.patch]
    low, high = np.full(len(nodes), np.inf), np.full(len(nodes), -np.inf)
    for computer, excitation in _plays(program):
        try:
            for _ in computer.play_in_steps(excitation, lengths, nodes):
                volts = computer.probed
                if not (np.abs(volts) < _LARGEST_V).all():
                    raise unfit(program)
                low, high = np.minimum(low, volts.min(axis=0)), np.maximum(high, volts.max(axis=0))
        except EngineError:
            raise unfit(program) from None
    per_v = np.array([each.sign * each.full / 10.0 for each in program.patch])
    ends = np.sort([low * per_v, high * per_v], axis=0).T
    return {each.stage.name: Reach(*pair) for each, pair in zip(program.patch, ends.tolist(), strict=True)}


def unfit(program: PatchedProgram) -> UnfitError:
    """Error for a program that no full scales hold on machines of real parts; smaller inputs may cure it."""
    equations = program.equations
    return UnfitError(
        "offsets and tolerances of real parts drive the program to infinity, at any full scale",
        edits=[
            {("inputs", name, "trial"): [float(f"{level * times:.3g}") for level in row.trial]}
            for times in (0.5, 0.2, 0.05)
            for name, row in equations.inputs.items()
        ],
        otherwise="lower the trial levels of the inputs or their effect; with a full scale for every state it "
        "is patched all the same, for ideal parts",
    )


def _plays(program: PatchedProgram) -> Iterator[tuple[SuspensionComputer, Excitation]]:
    """Machines of real and of nominal parts, at the rates of the rigs, under the square wave of a run."""
    name, quantity = next(iter(program.equations.inputs.items()))
    low_v, high_v = (level * program.scales.volts(name) for level in quantity.trial)
    real = replace(COMPONENTS["polypropylene"], temperature_c=_WARM_C)
    for rate_hz, machines in _MACHINES:
        for seed in range(machines):
            rng = np.random.default_rng(seed)
            computer = SuspensionComputer(
                program,
                opamp="ideal",
                components=replace(real, seed=seed) if seed % 2 else NOMINAL,
                rng=rng,
                offset_v=_OFFSETS_V[seed % 2],
                sample_rate_hz=rate_hz,
            )
            yield computer, Excitation(low_v=low_v, high_v=high_v, phase=float(rng.random()))
