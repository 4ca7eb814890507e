"""Devices of the kind ``python``: an object in this process whose method ``step`` takes one sample."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib
import importlib.util
import inspect
import math
import re
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NoReturn, Self

import numpy as np

from analogrig import config
from analogrig.answers import Answers, Samples
from analogrig.datasheet import Datasheet
from analogrig.devices.adapted import AdaptedDescription
from analogrig.devices.description import Capability
from analogrig.devices.device import Device
from analogrig.devices.python_answers import Rows, WrongAnswer
from analogrig.errors import ConfigurationError, DeviceError, DeviceRefused, TimeLimitReached
from analogrig.identity import DeviceFile
from analogrig.protocol.pace import Pace
from analogrig.trust import Thing
from analogrig.wording import error_text

_FACTORY = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*(\.[^\W\d]\w*)*")

_FAILURES = (Exception, SystemExit, GeneratorExit)
"""Errors that are always failures of foreign code. Others may end a test or a task: pytest, asyncio and Ctrl-C."""


@dataclass(frozen=True, kw_only=True)
class PythonDescription(AdaptedDescription):
    """A Python object in this process.

    Modules of the working directory can be imported, before installed ones, as with ``python -m``.
    """

    kind: ClassVar[str] = "python"
    usage: ClassVar[str] = "python:MODULE:FACTORY[?SETTING=VALUE&...]"
    summary: ClassVar[str] = "Python object with a method step(u, y, valid), in this process"
    collects: ClassVar[str] = "settings"
    factory: str
    """Class or function that makes the object: ``package.module:name``. ``settings`` are its keyword arguments."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not _FACTORY.fullmatch(self.factory):
            raise ValueError(f"factory must be package.module:name, not {self.factory!r}")

    @classmethod
    def _place(cls, name: str, place: str) -> dict[str, Any]:
        if not place:
            raise ConfigurationError(f"device {name!r}: names no factory: pass {cls.kind}:package.module:name")
        return {"factory": place}

    @property
    def capabilities(self) -> frozenset[Capability]:
        return frozenset({"blocks", "configure", "in-process"})

    @property
    def things(self) -> tuple[Thing, ...]:
        return (Thing("Python module", f"{self.kind}:{self.factory}", "the device imports"),)

    def open(self) -> Device:
        return PythonDevice(self)

    def _check_files(self, device: Device, before: tuple[DeviceFile, ...]) -> None:
        """Accept any: to find the file of a module beforehand would already run its package."""


class PythonDevice(Device):
    """Python object with a method ``step`` or ``step_block`` (docs/howto/test-a-python-estimator.md)."""

    def __init__(self, description: PythonDescription) -> None:
        """Import the module.

        :raises ConfigurationError: it cannot be imported, or has no such factory.
        """
        super().__init__(description)
        self._description: PythonDescription = description
        self._as_opened = description.settings
        module, self._factory = _load(description.name, description.factory)
        self._code = module.origin
        self._files = (DeviceFile(description.name, module.origin, module.sha256),)
        self._until_s = math.inf
        self._object: Any = None
        self._has_started = False
        """True if the object has begun a record."""
        self._use(self._make(description.settings))

    @property
    def datasheet(self) -> Datasheet:
        return self._datasheet

    def recover(self) -> None:
        self._use(self._make(self._description.settings))

    def configure(self, **settings: Any) -> None:
        wanted = {**self._as_opened, **settings}
        self._use(self._make(wanted))
        self._description = dataclasses.replace(self._description, settings=wanted)

    def start(self, pace: Pace | None = None) -> None:  # noqa: ARG002
        if not self._has_started:
            self._has_started = True
        elif (reset := self._method(self._object, "reset")) is not None:
            self._attempt(reset, "reset")
        else:
            self._object = self._make(self._description.settings)

    def play(self, blocks: Iterable[Samples]) -> Iterator[Answers]:
        rows, next_sample = Rows(self._datasheet), 0
        for block in blocks:
            if skipped_n := block.skipped_after(next_sample):
                nothing = np.zeros(skipped_n, np.uint16)
                skipped = Samples(next_sample, nothing, nothing, np.zeros(skipped_n, np.bool_))
                rows.begin(skipped)
                self._answer(skipped, rows)
            next_sample = block.first + len(block)
            rows.begin(block)
            try:
                self._answer(block, rows)
            except (DeviceError, TimeLimitReached):
                if rows.n:
                    yield rows.answers()
                raise
            yield rows.answers()

    def limit(self, left_s: float) -> None:
        self._until_s = time.monotonic() + left_s

    def _answer(self, block: Samples, rows: Rows) -> None:
        """Have the object answer one block."""
        self._check_time()
        if self._steps_blocks:
            what = f"step_block of the samples {block.first} to {block.first + len(block) - 1}"
            arrays = (block.u.copy(), block.y.copy(), block.valid.copy())
            self._attempt(lambda: rows.fill(self._object.step_block(*arrays)), what)
            return
        step = self._attempt(lambda: self._object.step, f"step of sample {block.first}")
        for u, y, valid in zip(block.u.tolist(), block.y.tolist(), block.valid.tolist(), strict=True):
            self._check_time()
            try:
                rows.add(step(u, y, valid))
            except BaseException as error:  # noqa: BLE001 - of foreign code
                self._raise_failure(f"step of sample {rows.next_sample}", error)

    def _check_time(self) -> None:
        if time.monotonic() >= self._until_s:
            raise TimeLimitReached("the time limit of the run is over")

    # ---------------------------------------------------------------------------------------------------- the object

    def _make(self, settings: Mapping[str, Any]) -> Any:
        """New object from the factory.

        :raises DeviceRefused: the factory takes no such settings.
        :raises DeviceError: the factory failed, or made no estimator.
        """
        self._check_settings(settings)
        made = self._attempt(lambda: self._factory(**settings), self._description.factory)
        if all(self._method(made, name) is None for name in ("step", "step_block")):
            raise DeviceError(
                f"device {self.name}: {self._description.factory} made a {type(made).__name__}, which has no method"
                " step(u, y, valid)"
            )
        return made

    def _check_settings(self, settings: Mapping[str, Any]) -> None:
        """:raises DeviceRefused: names a setting that the factory does not take, or one that it needs."""
        try:
            parameters = inspect.signature(self._factory).parameters.values()
        except (TypeError, ValueError):  # a built-in function, which has none
            return
        named = {each.name: each for each in parameters if each.kind in (each.POSITIONAL_OR_KEYWORD, each.KEYWORD_ONLY)}
        where = f"device {self.name}: {self._description.factory}"
        if not any(each.kind is each.VAR_KEYWORD for each in parameters):
            for name in settings.keys() - named.keys():
                raise DeviceRefused(f"{where} has no setting {name}; it has {', '.join(named) or 'none'}")
        for name, parameter in named.items():
            if parameter.default is parameter.empty and name not in settings:
                raise DeviceRefused(f"{where} needs the setting {name}")

    def _use(self, made: Any) -> None:
        """Let ``made`` answer from the next record on.

        :raises ConfigurationError: its data sheet is wrong.
        """
        self._datasheet = self._combine(made)
        self._steps_blocks = self._method(made, "step_block") is not None
        self._object = made
        self._has_started = False

    def _method(self, made: Any, name: str) -> Callable[..., Any] | None:
        """Method of the object; None if it has none."""
        method = self._attempt(lambda: getattr(made, name, None), f"{name} of {self._description.factory}")
        return method if callable(method) else None

    def _combine(self, made: Any) -> Datasheet:
        """The stated data sheet, with what the object states in place of it."""
        what = f"datasheet of {self._description.factory}"
        where = f"device {self.name}: {what}"
        own = self._attempt(lambda: getattr(made, "datasheet", {}), what)
        table = own.as_table() if isinstance(own, Datasheet) else own
        if not isinstance(table, Mapping):
            raise ConfigurationError(f"{where}: must be a mapping, not a {type(own).__name__}")
        try:
            return config.build(Datasheet, {**self._description.datasheet.as_table(), **config.plain(table)}, where)
        except ConfigurationError:
            raise
        except BaseException as error:  # noqa: BLE001 - of foreign code
            self._raise_failure(what, error)

    def _attempt(self, act: Callable[[], Any], what: str) -> Any:
        """:raises DeviceError: the foreign code failed."""
        try:
            return act()
        except BaseException as error:  # noqa: BLE001 - of foreign code
            self._raise_failure(what, error)

    def _raise_failure(self, what: str, error: BaseException) -> NoReturn:
        """:raises DeviceError: the foreign code failed. An error that must end more than the device is raised again."""
        if not _is_failure(error, self._code):
            raise error
        text = f": {error}" if isinstance(error, WrongAnswer) else f" raised {_text(error, self._code)}"
        cause = None if isinstance(error, KeyboardInterrupt) else error  # by which the command would be interrupted
        raise DeviceError(f"device {self.name}: {what}{text}") from cause

    def description(self) -> Mapping[str, Any]:
        return {**self._description.as_table(), "datasheet": self.datasheet.as_table()}


# ------------------------------------------------------------------------------------------------------ foreign modules


@dataclass(frozen=True)
class _Module:
    """A module as it was when it was imported first."""

    origin: str
    """Its file; its name if it has none."""
    sha256: str

    @classmethod
    @functools.cache
    def of(cls, name: str) -> Self:
        origin = getattr(importlib.import_module(name), "__file__", None)
        return cls(origin or name, DeviceFile.of(name, Path(origin)).sha256 if origin else "")


def _file_of(module: str) -> str:
    """File of a module that cannot be imported; empty if there is none."""
    with contextlib.suppress(Exception):
        spec = importlib.util.find_spec(module)
        return "" if spec is None else spec.origin or ""
    return ""


def _load(device: str, factory: str) -> tuple[_Module, Callable[..., Any]]:
    """Module and function of ``package.module:name``.

    :raises ConfigurationError: there is none, or the module cannot be imported.
    """
    name, _, attribute = factory.partition(":")
    folder = str(Path.cwd())
    if folder not in sys.path:
        sys.path.insert(0, folder)
    try:
        module = _Module.of(name)
        made: Any = importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{name}.".startswith(f"{error.name}."):
            raise ConfigurationError(f"device {device}: {name} cannot be imported: {_text(error, '')}") from error
        raise ConfigurationError(
            f"device {device}: there is no module {error.name}, neither in {folder} nor installed"
        ) from error
    except BaseException as error:
        if not _is_failure(error, _file_of(name)):
            raise
        cause = None if isinstance(error, KeyboardInterrupt) else error
        raise ConfigurationError(f"device {device}: {name} cannot be imported: {_text(error, '')}") from cause
    for part in attribute.split("."):
        if not hasattr(made, part):
            raise ConfigurationError(f"device {device}: {module.origin} has no {attribute}")
        made = getattr(made, part)
    if not callable(made):
        raise ConfigurationError(f"device {device}: {factory} is a {type(made).__name__}, which cannot be called")
    return module, made


def _is_failure(error: BaseException, code: str) -> bool:
    """True if an error shows that foreign code failed: always such a one, or raised in the file ``code``.

    A KeyboardInterrupt seems to be raised where Ctrl-C found the code, unless the command line handles signals.
    """
    if isinstance(error, _FAILURES):
        return True
    if isinstance(error, KeyboardInterrupt) and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        return False
    frames = traceback.extract_tb(error.__traceback__)
    return bool(frames) and frames[-1].filename == code


def _text(error: BaseException, code: str) -> str:
    """Type, text and place of an error: the innermost line of ``code``, else of any file but the import system's."""
    if isinstance(error, SyntaxError):
        return error_text(error)
    frames = [each for each in traceback.extract_tb(error.__traceback__) if not each.filename.startswith("<frozen ")]
    ours = [each for each in frames if each.filename == code]
    others = [each for each in frames if not _is_here(each.filename)]
    place = next((f" ({each.filename}:{each.lineno})" for each in reversed(ours or others)), "")
    return f"{error_text(error)}{place}"


def _is_here(file: str) -> bool:
    """True if a file is this module, or the import system."""
    return file in (__file__, importlib.__file__)
