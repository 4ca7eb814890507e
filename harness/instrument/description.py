"""The served rig as a TOML file has it: that of an emulated rig, and beyond it the table ``[instrument]``."""

from __future__ import annotations

from dataclasses import dataclass, field

from harness.instrument.acquisition import AcquisitionFaults
from harness.instrument.inputs import InputFaults
from harness.instrument.table import Wiring


@dataclass(frozen=True)
class InstrumentDescription:
    """The ``[instrument]`` table: how it is connected, and what is wrong with it."""

    wiring: Wiring = field(default_factory=Wiring)
    inputs: InputFaults = field(default_factory=InputFaults)
    acquisition: AcquisitionFaults = field(default_factory=AcquisitionFaults)
