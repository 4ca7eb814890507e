"""Rigs by name: a shipped or own description, a table of a rigs file, or a recording."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

from analogrig import config
from analogrig.config import Kinds
from analogrig.errors import ConfigurationError
from analogrig.rigs.recording import RecordingDescription
from analogrig.rigs.rig import Rig, RigDescription
from analogrig.trust import Trust

KINDS = Kinds(RigDescription, "analogrig.rigs", {"emulator": "analogrig.rigs.emulator:EmulatorDescription"})
"""Description of each kind of rig."""

DEFAULT_RIG = "emulator"
"""Rig used if neither the user nor the scenario names one."""

RIGS_VARIABLE, RIGS_FILE = "ANALOGRIG_RIGS", "rigs.toml"
"""Environment variable that names the rigs file of a laboratory, and the default file name in the working directory."""


def open_rig(name: str | Path, *, self_test: bool = True, allow: Trust | Iterable[str] = ()) -> Rig:
    """Open a rig by name. Use it in a ``with`` statement: leaving it switches outputs off and closes connections.

    ``recording:FILE`` replays a recording. Other names stand for a table ``[rig.NAME]`` of the rigs file, or else
    for a shipped rig, or else for a kind of rig that an installed package adds. The rigs file is the one that
    ANALOGRIG_RIGS names, or else rigs.toml in this folder. FILE.toml stands for the rig described there, FILE.toml:NAME
    for one of several.

    :param self_test: False: skip the self-test that the description of a real rig may ask for.
    :param allow: addresses, ports and commands that a description may name (``analogrig.trust``).
    :raises ConfigurationError: no such rig, its description is wrong, or it names what is not allowed.
    :raises RecordingError: the recording cannot be read.
    """
    description, where, file = _read(str(name) if isinstance(name, Path) else name)
    try:
        Trust.of(allow).check(description.things, file, where)
        description.check()
        return description.open(self_test=self_test)
    except ConfigurationError as error:
        raise ConfigurationError(f"{where}: {str(error).removeprefix(f'{where}: ')}") from error


def describe(name: str) -> RigDescription:
    """Description of a rig, by its name as for ``open_rig``. Nothing that a file names is checked.

    :raises ConfigurationError: no such rig, or its description is wrong.
    """
    return _read(name)[0]


def from_table(table: Mapping[str, Any], where: str) -> RigDescription:
    """Description from plain values; ``where`` begins every error message.

    :raises ConfigurationError: they describe no rig.
    """
    kind = config.convert(Literal[tuple(KINDS)], table.get("kind", "emulator"), f"{where}: kind")
    return config.build(KINDS[kind], table, where)


def _read(name: str) -> tuple[RigDescription, str, str]:
    """Description of a rig, its place for errors, and its file; no file for a recording."""
    kind, _, recording = name.partition(":")
    if kind == "recording" and recording:
        return RecordingDescription(Path(recording)), name, ""
    if name in KINDS.added and name not in own_rigs()[1] and name not in config.names("rigs"):
        return from_table({"kind": name, "name": name}, name), name, ""
    table, where, file = _find(name)
    return from_table(table, where).placed(file.parent), where, str(file)


def _find(name: str) -> tuple[Mapping[str, Any], str, Path]:
    """Table of a rig, with its name; file and table, for errors; and the file.

    :raises ConfigurationError: there is none.
    """
    file, _, wanted = name.rpartition(":")
    if file.endswith(".toml"):
        return _one_of(Path(file), config.read_toml(config.locate("rigs", file)), wanted)
    own = _rigs_file()
    if own is not None and "/" not in name and not name.endswith(".toml"):
        table = config.read_toml(own)
        if name in _rig_tables(own, table):
            return _one_of(own, table, name)
        if name not in config.names("rigs"):
            there = ", ".join([*_rig_tables(own, table), *config.names("rigs")])
            raise ConfigurationError(f"no rig is called {name!r} in {own}, nor is one shipped: there are {there}")
    path = config.locate("rigs", name)
    table = config.read_toml(path)
    return _one_of(path, table, None) if "rig" in table else ({"name": path.stem, **table}, str(path), path)


def own_rigs() -> tuple[str, Mapping[str, Any]]:
    """The rigs file of ANALOGRIG_RIGS or of this folder, and its tables by name; ("", {}) if there is none.

    :raises ConfigurationError: the file that the variable names is not there, or is no rigs file.
    """
    own = _rigs_file()
    return ("", {}) if own is None else (str(own), _rig_tables(own, config.read_toml(own)))


def _rigs_file() -> Path | None:
    """:raises ConfigurationError: the one that the environment names is not there."""
    if named := os.environ.get(RIGS_VARIABLE):
        if not Path(named).is_file():
            raise ConfigurationError(f"{RIGS_VARIABLE}: {named}: no such file")
        return Path(named)
    own = Path(RIGS_FILE)
    return own if own.is_file() and "rig" in config.read_toml(own) else None  # another program's has no tables of rigs


def _rig_tables(path: Path, table: Mapping[str, Any]) -> Mapping[str, Any]:
    """Rigs of a rigs file, by name.

    :raises ConfigurationError: it is not a rigs file.
    """
    rigs = table.get("rig")
    if not isinstance(rigs, dict) or not rigs or not all(isinstance(each, dict) for each in rigs.values()):
        raise ConfigurationError(f"{path}: has no tables [rig.NAME]")
    for key in table:
        if key != "rig":
            raise ConfigurationError(f"{path}: unknown key {key!r} beside the tables [rig.NAME]")
    return rigs


def _one_of(path: Path, table: Mapping[str, Any], wanted: str | None) -> tuple[Mapping[str, Any], str, Path]:
    rigs = _rig_tables(path, table)
    if wanted is None and len(rigs) > 1:
        raise ConfigurationError(
            f"{path}: holds {len(rigs)} rigs: name one as {path}:NAME; there are {', '.join(rigs)}"
        )
    name = wanted or next(iter(rigs))
    if name not in rigs:
        raise ConfigurationError(f"{path}: holds no rig {name!r}: there are {', '.join(rigs)}")
    return {"name": name, **rigs[name]}, f"{path}: rig.{name}", path
