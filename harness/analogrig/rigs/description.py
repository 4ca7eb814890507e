"""Rigs by name: a shipped or own description, a table of a rigs file, or a recording."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from analogrig import config
from analogrig.errors import ConfigurationError
from analogrig.hardware.real import RealRig
from analogrig.hardware.wiring import RealDescription
from analogrig.rigs.emulator import EmulatorDescription, EmulatorRig, emulator_errors
from analogrig.rigs.recording import RecordingRig
from analogrig.rigs.rig import Rig
from analogrig.trust import Trust

DEFAULT_RIG = "emulator"
"""Rig used if neither the user nor the scenario names one."""

RIGS_VARIABLE, RIGS_FILE = "ANALOGRIG_RIGS", "rigs.toml"
"""Environment variable that names the rigs file of a laboratory, and the default file name in the working directory."""


def open_rig(name: str, *, self_test: bool = True, allow: Trust | Iterable[str] = ()) -> Rig:
    """Open a rig by name. Use it in a ``with`` statement: leaving it switches outputs off and closes connections.

    ``recording:FILE`` replays a recording. Other names stand for a table ``[rig.NAME]`` of the rigs file, or else
    for a shipped rig. The rigs file is the one that ANALOGRIG_RIGS names, or else rigs.toml in this folder. FILE.toml
    stands for the rig described there, FILE.toml:NAME for one of several.

    :param self_test: False: skip the self-test that the description of a real rig may ask for.
    :param allow: addresses, ports and commands that a description may name (``analogrig.trust``).
    :raises ConfigurationError: no such rig, its description is wrong, or it names what is not allowed.
    :raises RecordingError: the recording cannot be read.
    """
    return _made(name, Trust.of(allow), self_test=self_test)


def looked_at(name: str) -> Rig:
    """Rig as from ``open_rig``, for inspection only; every name in a file is accepted."""
    return _made(name, None)


def _made(name: str, trust: Trust | None, *, self_test: bool = True) -> Rig:
    kind, _, rest = name.partition(":")
    if kind == "recording" and rest:
        return RecordingRig.open(Path(rest))
    table, where, file = described(name)
    if table.get("kind", "emulator") != "real":
        emulated = config.build(EmulatorDescription, table, where)
        with emulator_errors(f"{where}: "):
            return EmulatorRig(emulated)
    with _names(where):
        description = config.build(RealDescription, table, where).placed(file.parent)
        if trust is not None:
            trust.check(description.things, str(file), where)
            description.pots.check()
        return RealRig(dataclasses.replace(description, self_test=description.self_test and self_test))


@contextlib.contextmanager
def _names(where: str) -> Iterator[None]:
    """Prefix errors with the place."""
    try:
        yield
    except ConfigurationError as error:
        raise ConfigurationError(f"{where}: {str(error).removeprefix(f'{where}: ')}") from error


class Described(NamedTuple):
    """A rig as a file describes it."""

    table: Mapping[str, Any]
    """Table of the rig, with its name."""
    where: str
    """File and table, for errors."""
    file: Path


def described(name: str) -> Described:
    """The table that describes the rig ``name``, and where it is.

    :raises ConfigurationError: there is none.
    """
    file, _, wanted = name.rpartition(":")
    if file.endswith(".toml"):
        return _one_of(Path(file), config.read_toml(config.locate("rigs", file)), wanted)
    own = _rigs_file()
    if own is not None and "/" not in name and not name.endswith(".toml"):
        table = config.read_toml(own)
        if name in _named(own, table):
            return _one_of(own, table, name)
        if name not in config.names("rigs"):
            there = ", ".join([*_named(own, table), *config.names("rigs")])
            raise ConfigurationError(f"no rig is called {name!r} in {own}, nor is one shipped: there are {there}")
    path = config.locate("rigs", name)
    table = config.read_toml(path)
    return _one_of(path, table, None) if "rig" in table else Described({"name": path.stem, **table}, str(path), path)


def own_rigs() -> tuple[str, Mapping[str, Any]]:
    """The rigs file of ANALOGRIG_RIGS or of this folder, and its tables by name; ("", {}) if there is none.

    :raises ConfigurationError: the file that the variable names is not there, or is no rigs file.
    """
    own = _rigs_file()
    return ("", {}) if own is None else (str(own), _named(own, config.read_toml(own)))


def _rigs_file() -> Path | None:
    """:raises ConfigurationError: the one that the environment names is not there."""
    if named := os.environ.get(RIGS_VARIABLE):
        if not Path(named).is_file():
            raise ConfigurationError(f"{RIGS_VARIABLE}: {named}: no such file")
        return Path(named)
    return Path(RIGS_FILE) if Path(RIGS_FILE).is_file() else None


def _named(path: Path, table: Mapping[str, Any]) -> Mapping[str, Any]:
    """Rigs of a rigs file, by name.

    :raises ConfigurationError: it is none.
    """
    rigs = table.get("rig")
    if not isinstance(rigs, dict) or not rigs or not all(isinstance(each, dict) for each in rigs.values()):
        raise ConfigurationError(f"{path}: has no tables [rig.NAME]")
    for key in table:
        if key != "rig":
            raise ConfigurationError(f"{path}: unknown key {key!r} beside the tables [rig.NAME]")
    return rigs


def _one_of(path: Path, table: Mapping[str, Any], wanted: str | None) -> Described:
    rigs = _named(path, table)
    if wanted is None and len(rigs) > 1:
        raise ConfigurationError(f"{path}: holds {len(rigs)} rigs: say {path}:NAME, one of {', '.join(rigs)}")
    name = wanted or next(iter(rigs))
    if name not in rigs:
        raise ConfigurationError(f"{path}: holds no rig {name!r}: there are {', '.join(rigs)}")
    return Described({"name": name, **rigs[name]}, f"{path}: rig.{name}", path)
