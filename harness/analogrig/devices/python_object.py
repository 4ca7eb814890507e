"""Python object of a device: its module, its factory, and its answers, checked and written to records."""

from __future__ import annotations

import contextlib
import importlib
import inspect
import json
import sys
import traceback
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from analogrig import config
from analogrig.answers import LARGEST_FLOAT32, MOST_FREQUENCY
from analogrig.catalogue import Cause, Change
from analogrig.datasheet import Datasheet
from analogrig.devices.foreign_memory import SharedLayout, Slot, StepFailed
from analogrig.errors import ConfigurationError, DeviceError, DeviceRefused
from analogrig.wording import error_text

LAYOUT = SharedLayout(
    np.dtype([("u", "<u2"), ("y", "<u2"), ("valid", "?")]),
    (
        ("unreported", "u1"),
        *(("change", "u1"), ("onset", "<i8"), ("extent", "<f8")),
        *(("cause", "u1"), ("frequency", "<f8")),
    ),
)
"""``change`` and ``cause``: 0 stands for no report, and a cause is that of the catalogue + 1."""

_QUANTITIES = ("alarm", "theta", "innovation", "statistic", "armed", "diagnosis", "misfit")
"""Names in an answer: keys of a mapping, or attributes of an object."""

_CHANGES = {change.name.lower(): change for change in Change if change is not Change.UNDECIDED}

_DIAGNOSIS = ("change", "onset", "extent")

_CAUSES = {cause.name.lower().replace("_", " "): cause for cause in Cause}

_MISFIT = ("cause", "frequency")

_CURES = {name: f"datasheet.{name} = true" for name in _QUANTITIES} | {
    "theta": "datasheet.theta_n = number of elements",
    "diagnosis": "datasheet.diagnoses = true",
    "misfit": "datasheet.misfits = true",
}

_MOST_SHOWN = 60


class WrongAnswer(Exception):  # noqa: N818 - PythonObject makes a StepFailed of it
    """The object returned something else than an answer."""


class Rows:
    """Writer of the answers to one block after another into records, one a sample."""

    def __init__(self, sheet: Datasheet, states: Collection[int | str] = ()) -> None:
        """``states`` are those that stand for an alarm; empty: an alarm is true or false."""
        self._sheet, self._states = sheet, frozenset(states)
        numbers = {"theta": sheet.theta_n > 0, "innovation": sheet.innovation, "statistic": sheet.statistic}
        self._shapes = {name: (sheet.theta_n,) if name == "theta" else () for name, is_in in numbers.items() if is_in}
        """Shape of one row of each reported quantity of numbers."""
        reported = {**numbers, "armed": sheet.armed, "diagnosis": sheet.diagnoses, "misfit": sheet.misfits}
        self._named = tuple(name for name in _QUANTITIES if name == "alarm" or reported[name])
        self._unstated = tuple(name for name in _QUANTITIES if name not in self._named)
        self._is_bare = not any(reported.values()) and not states
        """True if an answer is an alarm and nothing else."""
        self._last: dict[str, Any] = {name: np.zeros(shape) if shape else 0.0 for name, shape in self._shapes.items()}
        """Last reported row of each, which stands for those that are not reported."""
        self.next_sample = 0
        """Index of the sample that has no record yet."""

    def begin(self, records: NDArray[Any]) -> None:
        """Begin the answers to the samples of these records."""
        self._fields = {name: records[name] for name in records.dtype.names or ()}
        self._done = self._fields["done"]
        self._n, self._at = len(records), 0

    def add(self, result: object) -> None:
        """Add the answer to the next sample.

        :raises WrongAnswer: it is not a valid answer.
        """
        at, fields = self._at, self._fields
        if not (self._is_bare and (result is False or result is True)):
            self._add_quantities(result, at)
        elif result:
            fields["alarm"][at] = 1
        self._done[at] = 1
        self._at = at + 1
        self.next_sample += 1

    def _add_quantities(self, result: object, at: int) -> None:
        is_alarm = isinstance(result, (int, str, np.generic) if self._states else (bool, np.bool_))
        answer = self._quantities({"alarm": result} if is_alarm else result)
        fields, alarm = self._fields, answer.get("alarm")
        if self._states and isinstance(alarm, int | str | np.generic):
            alarm = alarm in self._states
        if not isinstance(alarm, bool | np.bool_):
            raise WrongAnswer(f"must return True, False or an object with such an alarm, not {_shown(result)}")
        for name, shape in self._shapes.items():
            if (value := answer.get(name)) is None:
                fields["unreported"][at] = 1
            else:
                self._last[name] = _numbers(value, shape, name)
            fields[name][at] = self._last[name]
        if self._sheet.armed and answer.get("armed"):
            fields["armed"][at] = 1
        if (diagnosis := answer.get("diagnosis")) is not None:
            self._write(at, _DIAGNOSIS, _diagnosis(diagnosis, self.next_sample))
        if (misfit := answer.get("misfit")) is not None:
            self._write(at, _MISFIT, _misfit(misfit))
        fields["alarm"][at] = alarm

    def fill(self, result: object) -> None:
        """Add the answers to the whole block: an array of alarms, or an object with an array of each quantity.

        :raises WrongAnswer: they are not valid answers.
        """
        n, fields = self._n, self._fields
        answer = self._quantities({"alarm": result} if isinstance(result, np.ndarray) else result)
        alarm = answer.get("alarm")
        if self._states:
            alarm = np.array([state in self._states for state in np.asarray(alarm).ravel().tolist()], np.bool_)
        fields["alarm"][:] = _bools(alarm, n, "alarm")
        for name, shape in self._shapes.items():
            if (value := answer.get(name)) is None:
                fields["unreported"][:] = 1
                fields[name][:] = self._last[name]
            elif n:
                fields[name][:] = values = _numbers(value, (n, *shape), name)
                self._last[name] = np.asarray(values)[-1]
        if self._sheet.armed:
            fields["armed"][:] = _bools(answer.get("armed"), n, "armed")
        for at, diagnosis in enumerate(_list(answer.get("diagnosis"), n, "diagnosis")):
            if diagnosis is not None:
                self._write(at, _DIAGNOSIS, _diagnosis(diagnosis, self.next_sample + at))
        for at, misfit in enumerate(_list(answer.get("misfit"), n, "misfit")):
            if misfit is not None:
                self._write(at, _MISFIT, _misfit(misfit))
        self._done[:] = 1
        self.next_sample += n

    def _write(self, at: int, names: Sequence[str], values: Sequence[float]) -> None:
        for name, value in zip(names, values, strict=True):
            self._fields[name][at] = value

    def _quantities(self, result: object) -> Mapping[str, Any]:
        """Quantities of an answer by name.

        :raises WrongAnswer: one is unknown, or the data sheet says that it is not reported.
        """
        answer = _named(result, _QUANTITIES)
        for name in self._unstated:
            if answer.get(name) is not None:
                raise WrongAnswer(f"returned {name}, which the data sheet does not state: {_CURES[name]}")
        return answer


def _named(result: object, names: Sequence[str]) -> Mapping[str, Any]:
    """The values of a mapping, or of the attributes of these names.

    :raises WrongAnswer: the mapping has other keys.
    """
    if not isinstance(result, Mapping):
        return {name: getattr(result, name, None) for name in names}
    for key in result:
        if key not in names:
            raise WrongAnswer(f"unknown key {key!r} (known: {', '.join(names)})")
    return result


def _numbers(value: Any, shape: tuple[int, ...], name: str) -> Any:
    """Finite numbers of this shape: the value, or an array of it.

    :raises WrongAnswer: the value is something else; names the row.
    """
    if not shape and type(value) is float and -LARGEST_FLOAT32 <= value <= LARGEST_FLOAT32:
        return value  # the usual case, in a tenth of the time
    array = np.asarray(value)
    if array.shape != shape or array.dtype.kind not in "iuf":
        wanted = f"{' x '.join(map(str, shape))} numbers, as the data sheet states" if shape else "a number"
        raise WrongAnswer(f"{name} must be {wanted}, not {_shown(value)}")
    is_small = len(shape) == 1 and array.dot(array) <= LARGEST_FLOAT32  # in a fifth of the time of the next line
    if not is_small and not (np.abs(array) <= LARGEST_FLOAT32).all():
        raise WrongAnswer(f"{name} is {_shown(value)}: non-finite, or beyond float32")
    return array


def _bools(value: object, n: int, name: str) -> NDArray[np.bool_]:
    """:raises WrongAnswer: the value is no array of ``n`` truth values."""
    array = np.asarray(value)
    if array.shape != (n,) or array.dtype != np.bool_:
        raise WrongAnswer(f"{name} must be an array of {n} truth values, not {_shown(value)}")
    return array


def _list(value: object, n: int, name: str) -> Sequence[object]:
    """Reports of n samples; None where there is none.

    :raises WrongAnswer: the value is no such list.
    """
    given = value or [None] * n
    if not isinstance(given, Sequence) or len(given) != n:
        raise WrongAnswer(f"{name} must be a list of {n}, with None for no {name}, not {_shown(given)}")
    return given


def _misfit(value: object) -> tuple[int, float]:
    """Cause + 1, since 0 stands for no report, and frequency.

    :raises WrongAnswer: the value is no misfit.
    """
    given = _named(value, _MISFIT)
    cause, frequency = given.get("cause"), given.get("frequency")
    if not (isinstance(cause, str) and cause in _CAUSES):
        raise WrongAnswer(f"misfit: cause must be one of {', '.join(_CAUSES)}, not {_shown(cause)}")
    if frequency is None:
        return _CAUSES[cause] + 1, 0.0
    if (
        isinstance(frequency, bool)
        or not isinstance(frequency, int | float | np.floating)
        or not 0.0 <= frequency <= MOST_FREQUENCY
    ):
        wanted = f"must be 0 to {MOST_FREQUENCY:g} cycles per sample"
        raise WrongAnswer(f"misfit: frequency {wanted}, not {_shown(frequency)}")
    return _CAUSES[cause] + 1, float(frequency)


def _diagnosis(value: object, index: int) -> tuple[int, int, float]:
    """Change, onset and extent of a diagnosis at the sample ``index``.

    :raises WrongAnswer: the value is no diagnosis.
    """
    given = _named(value, _DIAGNOSIS)
    change, onset, extent = (given.get(name) for name in _DIAGNOSIS)
    if not (isinstance(change, str) and change in _CHANGES):
        raise WrongAnswer(f"diagnosis: change must be one of {', '.join(_CHANGES)}, not {_shown(change)}")
    if isinstance(onset, bool) or not isinstance(onset, int | np.integer) or not 0 <= onset <= index:
        raise WrongAnswer(f"diagnosis: onset must be a sample from 0 to {index}, not {_shown(onset)}")
    if (
        isinstance(extent, bool)
        or not isinstance(extent, int | float | np.floating)
        or not 0.0 < extent <= LARGEST_FLOAT32
    ):
        raise WrongAnswer(f"diagnosis: extent must be a number above 0, not {_shown(extent)}")
    return _CHANGES[change], int(onset), float(extent)


def _shown(value: object) -> str:
    """A value in a message."""
    text = " ".join(repr(value).split())
    return f"{text if len(text) <= _MOST_SHOWN else f'{text[:_MOST_SHOWN]}...'} ({type(value).__name__})"


ERRORS = {kind.__name__: kind for kind in (ConfigurationError, DeviceError, DeviceRefused)}
"""Errors that the child reports instead of a data sheet."""


class PythonObject:
    """A factory of objects with a method ``step`` or ``step_block``, and the object of the present record."""

    def __init__(
        self,
        device: str,
        factory: str,
        failures: tuple[type[BaseException], ...],
        states: Collection[int | str] = (),
    ) -> None:
        """Import the module of ``factory``, which is ``package.module:name``.

        :param states: states that stand for an alarm; empty: it is true or false.
        :param failures: errors that are failures of the device; others pass.
        :raises ConfigurationError: there is no such module or name, or the module cannot be imported.
        """
        self._device, self._name, self._failures, self._states = device, factory, failures, states
        self.origin, self._factory = self._load()
        """File of the module; its name if it has none."""
        self._parameters = _parameters(self._factory)
        self.sheet_text = ""
        """Last data sheet that the objects stated, in JSON; empty if it has no such form."""

    def begin(self, settings: Mapping[str, Any], stated: Mapping[str, Any]) -> Datasheet:
        """Make the object of a record. Return its data sheet: ``stated``, with what the object states in place of it.

        :raises DeviceRefused: the factory takes no such settings.
        :raises DeviceError: the factory failed, or made no estimator.
        :raises ConfigurationError: its data sheet is wrong.
        """
        self._check_settings(settings)
        made = self._attempt(lambda: self._factory(**settings), self._name)
        self._step, self._step_block = (self._method(made, name) for name in ("step", "step_block"))
        if self._step is None and self._step_block is None:
            raise DeviceError(
                f"device {self._device}: {self._name} made a {type(made).__name__}, which has no method"
                " step(u, y, valid)"
            )
        self._made = made  # which its methods may not keep
        sheet = self._combine(made, stated)
        self._rows = Rows(sheet, self._states)
        return sheet

    def step(self, slot: Slot, n: int) -> None:
        """Write the answers to the first ``n`` samples of a slot into its records.

        :raises StepFailed: the object failed, or gave a wrong answer; names the sample.
        """
        rows = self._rows
        rows.begin(slot.records[:n])
        samples = (slot.u[:n], slot.y[:n], slot.valid[:n])
        if self._step_block is not None:
            first, block, arrays = rows.next_sample, self._step_block, [array.copy() for array in samples]
            what = f"step_block of the samples {first} to {first + n - 1}"
            self._attempt(lambda: rows.fill(block(*arrays)), what, StepFailed)
        elif (step := self._step) is not None:
            add = rows.add
            try:
                for u, y, valid in zip(*(array.tolist() for array in samples), strict=True):
                    add(step(u, y, valid))
            except self._failures as error:
                self._raise_failure(f"step of sample {rows.next_sample}", error, StepFailed)

    def _check_settings(self, settings: Mapping[str, Any]) -> None:
        """:raises DeviceRefused: names a setting that the factory does not take, or one that it needs."""
        parameters = self._parameters
        named = {each.name: each for each in parameters if each.kind in (each.POSITIONAL_OR_KEYWORD, each.KEYWORD_ONLY)}
        where = f"device {self._device}: {self._name}"
        if not any(each.kind is each.VAR_KEYWORD for each in parameters):
            for name in settings.keys() - named.keys():
                raise DeviceRefused(f"{where} has no setting {name}; it has {', '.join(named) or 'none'}")
        for name, parameter in named.items():
            if parameter.default is parameter.empty and name not in settings:
                raise DeviceRefused(f"{where} needs the setting {name}")

    def _method(self, made: Any, name: str) -> Callable[..., Any] | None:
        """Method of the object; None if it has none."""
        method = self._attempt(lambda: getattr(made, name, None), f"{name} of {self._name}")
        return method if callable(method) else None

    def _combine(self, made: Any, stated: Mapping[str, Any]) -> Datasheet:
        what = f"datasheet of {self._name}"
        where = f"device {self._device}: {what}"
        own = self._attempt(lambda: getattr(made, "datasheet", {}), what)
        table = own.as_table() if isinstance(own, Datasheet) else own
        if not isinstance(table, Mapping):
            raise ConfigurationError(f"{where}: must be a mapping, not a {type(own).__name__}")
        try:
            combined = {**stated, **config.plain(table)}
            text = ""
            with contextlib.suppress(TypeError, ValueError, RecursionError):
                text = json.dumps(combined)
            return self.read_sheet(text, where) if text else config.build(Datasheet, combined, where)
        except ConfigurationError:
            raise
        except self._failures as error:
            self._raise_failure(what, error, DeviceError)

    def read_sheet(self, text: str, where: str = "") -> Datasheet:
        """Data sheet from its JSON: that of the last time if it is the same.

        :raises ConfigurationError: it is wrong.
        """
        if text != self.sheet_text:
            self._sheet = config.build(Datasheet, json.loads(text), where)
            self.sheet_text = text
        return self._sheet

    def _attempt(self, act: Callable[[], Any], what: str, kind: type[DeviceError] = DeviceError) -> Any:
        """Result of foreign code.

        :raises DeviceError: it failed; an error of this ``kind``.
        """
        try:
            return act()
        except self._failures as error:
            self._raise_failure(what, error, kind)

    def _raise_failure(self, what: str, error: BaseException, kind: type[DeviceError]) -> NoReturn:
        text = f": {error}" if isinstance(error, WrongAnswer) else f" raised {_text(error, self.origin)}"
        raise kind(f"device {self._device}: {what}{text}") from error

    def _load(self) -> tuple[str, Callable[..., Any]]:
        """File of the module, and the function that is called ``package.module:name``."""
        device = f"device {self._device}"
        name, _, attribute = self._name.partition(":")
        folder = str(Path.cwd())
        if folder not in sys.path:
            sys.path.insert(0, folder)
        try:
            made: Any = importlib.import_module(name)
        except ModuleNotFoundError as error:
            if error.name is None or not f"{name}.".startswith(f"{error.name}."):
                raise ConfigurationError(f"{device}: {name} cannot be imported: {_text(error, '')}") from error
            raise ConfigurationError(
                f"{device}: there is no module {error.name}, neither in {folder} nor installed"
            ) from error
        except self._failures as error:
            raise ConfigurationError(f"{device}: {name} cannot be imported: {_text(error, '')}") from error
        origin = getattr(made, "__file__", None) or name
        for part in attribute.split("."):
            if not hasattr(made, part):
                raise ConfigurationError(f"{device}: {origin} has no {attribute}")
            made = getattr(made, part)
        if not callable(made):
            raise ConfigurationError(f"{device}: {self._name} is a {type(made).__name__}, which cannot be called")
        return origin, made


def _parameters(factory: Callable[..., Any]) -> Collection[inspect.Parameter]:
    """Parameters of a function or class; any keyword arguments if it does not state them, as some built-in ones."""
    try:
        return inspect.signature(factory).parameters.values()
    except (TypeError, ValueError):
        return (inspect.Parameter("settings", inspect.Parameter.VAR_KEYWORD),)


def _text(error: BaseException, code: str) -> str:
    """Type, text and place of an error: the innermost line of ``code``, else of any file but the import system's."""
    if isinstance(error, SyntaxError):
        return error_text(error)
    frames = [each for each in traceback.extract_tb(error.__traceback__) if not each.filename.startswith("<frozen ")]
    ours = [each for each in frames if each.filename == code]
    others = [each for each in frames if each.filename not in (__file__, importlib.__file__)]
    place = next((f" ({each.filename}:{each.lineno})" for each in reversed(ours or others)), "")
    return f"{error_text(error)}{place}"
