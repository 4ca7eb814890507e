"""Rigs, which play a scenario and yield samples: the interface for kinds of rigs of your own.

A kind is two classes. The description, a frozen dataclass with the fields ``name`` and ``kind``, is a table of a rigs
file; it opens the rig, which performs scenarios. An installed package adds the kind as an entry point. Its name alone,
as in ``--rig mykind``, stands for a description with all defaults:

    [project.entry-points."analogrig.rigs"]
    mykind = "my_package.my_module:MyDescription"

=============  ==========================================================================================
describe       ``RigDescription`` (base class), ``Thing``
perform        ``Rig`` (base class), ``Performance``, ``Hindsight``, ``CAPABILITIES``
sample         ``Block``, ``Channel``, ``Segment``, ``BLOCK_SAMPLES``, ``WRONG_SAMPLES``, ``DEFAULT_RIG``
emulator       ``EmulatorRig``, ``EmulatorDescription``, ``ComputerDescription``, ``CardDescription``,
               ``MeasuredValues``, ``Stream``, ``emulator_errors``, ``is_emulated``; for plays in steps
               ``SetUp``, ``channels_of``, ``lit_lamps``, ``sampled``
errors         ``RigTimeout``, ``RigClosed``, ``RigRefused``, ``RecordIncomplete``, ``RecordStale``; ``RigError``
               is in ``analogrig``
=============  ==========================================================================================
"""

from __future__ import annotations

from typing import TYPE_CHECKING

CAPABILITIES = ("excite", "change")
"""Optional capabilities of a rig beyond sampling, for ``Rig.capabilities``."""

if TYPE_CHECKING:
    from analogrig.errors import RecordIncomplete, RecordStale, RigClosed, RigRefused, RigTimeout
    from analogrig.plant import Segment
    from analogrig.rigs.description import DEFAULT_RIG
    from analogrig.rigs.emulator import (
        CardDescription,
        ComputerDescription,
        EmulatorDescription,
        EmulatorRig,
        MeasuredValues,
        SetUp,
        Stream,
        channels_of,
        emulator_errors,
        is_emulated,
        lit_lamps,
        sampled,
    )
    from analogrig.rigs.recording import WRONG_SAMPLES
    from analogrig.rigs.rig import BLOCK_SAMPLES, Block, Hindsight, Performance, Rig, RigDescription
    from analogrig.run import Channel
    from analogrig.trust import Thing
else:
    from analogrig.lazy import loader

    __getattr__ = loader(
        __name__,
        {
            "analogrig.rigs.description": "DEFAULT_RIG",
            "analogrig.errors": "RecordIncomplete RecordStale RigClosed RigRefused RigTimeout",
            "analogrig.plant": "Segment",
            "analogrig.rigs.emulator": (
                "CardDescription ComputerDescription EmulatorDescription EmulatorRig MeasuredValues SetUp Stream "
                "channels_of emulator_errors is_emulated lit_lamps sampled"
            ),
            "analogrig.rigs.recording": "WRONG_SAMPLES",
            "analogrig.rigs.rig": "BLOCK_SAMPLES Block Hindsight Performance Rig RigDescription",
            "analogrig.run": "Channel",
            "analogrig.trust": "Thing",
        },
    )

__all__ = [
    "BLOCK_SAMPLES",
    "CAPABILITIES",
    "DEFAULT_RIG",
    "WRONG_SAMPLES",
    "Block",
    "CardDescription",
    "Channel",
    "ComputerDescription",
    "EmulatorDescription",
    "EmulatorRig",
    "Hindsight",
    "MeasuredValues",
    "Performance",
    "RecordIncomplete",
    "RecordStale",
    "Rig",
    "RigClosed",
    "RigDescription",
    "RigRefused",
    "RigTimeout",
    "Segment",
    "SetUp",
    "Stream",
    "Thing",
    "channels_of",
    "emulator_errors",
    "is_emulated",
    "lit_lamps",
    "sampled",
]
