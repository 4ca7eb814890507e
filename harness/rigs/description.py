"""Rigs by name: a shipped or own description, or a recording."""

from __future__ import annotations

from pathlib import Path

from harness import config
from harness.rigs.emulator import EmulatorDescription, EmulatorRig, emulator_errors
from harness.rigs.recording import RecordingRig
from harness.rigs.rig import Rig

DEFAULT_RIG = "emulator"
"""When neither the user nor the scenario says another."""


def open_rig(name: str) -> Rig:
    """The rig of a shipped or own description, or ``recording:FILE``.

    :raises ConfigurationError: there is none, or its description is wrong.
    :raises RecordingError: the recording cannot be read.
    """
    kind, _, rest = name.partition(":")
    if kind == "recording" and rest:
        return RecordingRig.open(Path(rest))
    path = config.locate("rigs", name)
    description = config.build(EmulatorDescription, {"name": path.stem, **config.read_toml(path)}, str(path))
    with emulator_errors(f"{path}: "):
        return EmulatorRig(description)
