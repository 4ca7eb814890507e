"""Run: the complete result of one play of a scenario, and its file format.

The file is an uncompressed ``.npz``: the arrays under their own names, and ``header``, a JSON text. It is read with
``allow_pickle=False`` and contains everything that a verdict needs.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import itertools
import json
import math
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, BinaryIO, TypeVar

import numpy as np
from numpy.typing import NDArray

from analogrig import config
from analogrig.answers import LOST as LOST  # noqa: PLC0414 - callers take it, like its neighbours, from here
from analogrig.answers import MOST_FREQUENCY, AlarmIs
from analogrig.catalogue import Cause, Change
from analogrig.datasheet import Datasheet
from analogrig.errors import ConfigurationError, RecordingError
from analogrig.estimator_config import MAX_PARAMETERS, EstimatorConfig
from analogrig.identity import Identity
from analogrig.output import replace_file
from analogrig.plant import MAX_CHANGES, MAX_SAMPLES, Plant, Segment
from analogrig.program import Program
from analogrig.scenario import DEFAULT_PROGRAM, Expectations, Statement, program_of
from analogrig_emulator import Excitation

__all__ = ["IMPORTED", "INPUT", "LOST", "MAX_CODES", "OUTPUT", "Channel", "missing_samples"]
"""Names for packages beside the core."""

FORMAT = "analogrig-run"
FORMAT_VERSION = 1

CHUNK_SAMPLES = 1 << 16
"""Samples per chunk. Long runs are processed in chunks to bound the memory of intermediate results."""

MAX_CODES = 1 << 16

_MOST_COUNT = 2**31
"""Largest number of samples, bits per second or the like in a description."""

_NEEDED_SETTINGS = ("na", "nb", "offset", "trigger")
"""Settings without a default, because each of them changes the verdict; so does the ceiling of a trigger."""

_LEAST_MAGNITUDE, _MOST_MAGNITUDE = 1e-12, 1e9
"""Limits of every plausible unit, time or noise, exclusive."""

IMPORTED = "import"
"""Kind, in the rig's description, of measured data that no device has seen."""

INPUT, OUTPUT = 0, 1
"""Columns of the plant's input and output, which every rig measures and every device receives."""

UNREPORTED = 0x40
"""Flag of a sample, beside SteppedFlag: the device reported no estimate, and theta repeats the previous row."""
UNARMED = 0x80
"""Flag of a sample, beside SteppedFlag: the device reported that its trigger was not armed."""

_ARRAYS: dict[str, tuple[str, int]] = {
    "codes": ("uint16", 2),
    "clipped": ("bool", 2),
    "theta": ("float32", 2),
    "innovation": ("float32", 1),
    "statistic": ("float32", 1),
    "flags": ("uint8", 1),
    "alarm_index": ("int64", 1),
    "alarm_kind": ("uint8", 1),
    "alarm_statistic": ("float32", 1),
}

_DIAGNOSIS_ARRAYS: dict[str, tuple[str, int]] = {
    "diagnosis_index": ("int64", 1),
    "diagnosis_change": ("uint8", 1),
    "diagnosis_onset": ("int64", 1),
    "diagnosis_extent": ("float32", 1),
}

_MISFIT_ARRAYS: dict[str, tuple[str, int]] = {
    "misfit_index": ("int64", 1),
    "misfit_cause": ("uint8", 1),
    "misfit_frequency": ("float32", 1),
    "misfit_strength": ("float32", 1),
}

_OPTIONAL_ARRAYS = _DIAGNOSIS_ARRAYS | _MISFIT_ARRAYS
"""Arrays that are absent from older recordings, and then empty."""


@dataclass(frozen=True)
class Channel:
    """Scale of one channel: volts = low_v + code * lsb_v, physical = volts * unit_per_v.

    Imported columns have no volts at a rig: unit_per_v is 1, and low_v and lsb_v are in ``unit``.
    """

    low_v: float
    lsb_v: float
    unit: str
    unit_per_v: float
    noise_lsb: float
    """Noise before quantisation, rms in LSB; 0 if unknown."""
    codes: int = 4096
    """Number of codes, from 0 on."""

    def physical(self, codes: NDArray[np.uint16]) -> NDArray[np.float64]:
        """Values in ``unit`` of codes of any shape (float64, same shape)."""
        return self.volts(codes) * self.unit_per_v

    def volts(self, codes: NDArray[np.uint16]) -> NDArray[np.float64]:
        """Volts at the rig of codes of any shape (float64, same shape)."""
        return self.low_v + codes.astype(np.float64) * self.lsb_v

    @property
    def zero(self) -> float:
        """Code of zero volts, not rounded; may lie outside the range."""
        return -self.low_v / self.lsb_v

    @property
    def lsb(self) -> float:
        """Size of one code in ``unit``."""
        return self.lsb_v * self.unit_per_v


def stack(arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """(r, ...) from r arrays of one shape; a view of a single one, which may be long."""
    return np.stack(arrays) if len(arrays) > 1 else arrays[0][None]


def missing_samples(clipped: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(n,) bool from (n, c) bool: samples whose input or output was clipped."""
    return np.asarray(clipped[:, INPUT] | clipped[:, OUTPUT])


@dataclass(frozen=True)
class ScenarioFacts:
    """Keys of a recorded scenario that a verdict or a page reads."""

    name: str
    description: str = ""
    expect: Expectations = field(default_factory=Expectations)
    excitation: Excitation | None = None
    statement: Statement | None = None


@dataclass(frozen=True)
class RigFacts:
    """Keys of a rig's description that a verdict or a page reads."""

    name: str
    kind: str = ""


@dataclass(frozen=True)
class DeviceFacts:
    """Keys of a device's description that a verdict or a page reads."""

    name: str
    kind: str = ""
    estimator: Mapping[str, Any] | None = None
    """Settings of an estimator of our catalogue; ``Conditions.estimator`` has them typed."""
    datasheet: Datasheet | None = None
    alarm_is: AlarmIs = "event"
    report_interval_n: int = 1
    most_lost_n: int = 0
    assumed_n: int = 0
    """Settings that a CAN log lacks."""
    identity: Mapping[str, int | str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, least in (("report_interval_n", 1), ("most_lost_n", 0), ("assumed_n", 0)):
            if not least <= getattr(self, name) <= _MOST_COUNT:
                raise ValueError(f"{name} must be {least} to {_MOST_COUNT}, not {getattr(self, name)}")
        if self.estimator is None and self.datasheet is None:
            raise ValueError("missing key 'estimator' or 'datasheet'")

    def settings(self, where: str) -> EstimatorConfig | None:
        """``estimator`` typed; ``where`` leads every error.

        :raises ConfigurationError: a setting is wrong, or one is absent that changes the verdict.
        """
        if self.estimator is None:
            return None
        needed = (*_NEEDED_SETTINGS, *(() if self.estimator.get("trigger") == "none" else ("ceiling",)))
        if missing := [key for key in needed if key not in self.estimator]:
            raise ConfigurationError(f"{where}: estimator: missing key {missing[0]!r}")
        settings = config.build(EstimatorConfig, self.estimator, f"{where}: estimator")
        try:
            settings.check_ranges()
        except ValueError as error:
            raise ConfigurationError(f"{where}: {error}") from error
        if settings.parameters > MAX_PARAMETERS:
            raise ConfigurationError(
                f"{where}: estimator: {settings.parameters} parameters, of at most {MAX_PARAMETERS}"
            )
        return settings


Facts = TypeVar("Facts", ScenarioFacts, RigFacts, DeviceFacts)


def _facts(kind: type[Facts], table: Mapping[str, Any], where: str) -> Facts:
    """Build ``kind`` from the keys that it has; ignore the others, which replays read."""
    names = {each.name for each in dataclasses.fields(kind)}
    return config.build(kind, {key: value for key, value in table.items() if key in names}, where)


@dataclass(frozen=True)
class Conditions:
    """Conditions of a run: seed, sample times, the true plant, and the descriptions of scenario, rig, device and link.

    Stored as the header of the file. Instants are sample indices, times are in seconds.
    """

    seed: int
    samples_asked: int
    sample_period_s: float
    """Machine time between samples."""
    time_scale: float
    """Problem time per machine time: the computer runs ``speed`` times faster than the plant."""
    channels: Mapping[str, Channel]
    segments: tuple[Segment, ...]
    """True plant, which the device never receives; empty if the rig does not know it."""
    scenario: Mapping[str, Any]
    """Scenario as a TOML table, with its name; ``played`` has what a verdict reads of it."""
    rig: Mapping[str, Any]
    """Description of the rig, with its name; ``source`` has what a verdict reads of it."""
    dut: Mapping[str, Any]
    """Device: name, kind, settings, data sheet, identity (firmware, catalogue hash, boot nonce); ``device``,
    ``estimator`` and ``datasheet`` have what a verdict reads of it."""
    link: str
    counters: Mapping[str, int] = field(default_factory=dict)
    """Counters of the device at the end."""
    faults: tuple[str, ...] = ()
    """Reasons that the run is not valid; empty if it is."""
    losses: tuple[str, ...] = ()
    """Known causes of lost samples and of unused frames, each with its count and first place."""
    remarks: tuple[str, ...] = ()
    """What the line showed besides, and cost no sample."""
    overloads: Mapping[str, int] = field(default_factory=dict)
    """First sample with a lit overload lamp, by amplifier."""
    real_time: float = 0.0
    """Wall-clock time per machine time; 0: lock-step."""
    link_counters: Mapping[str, int] = field(default_factory=dict)
    """Traffic on the line other than messages of the device, such as damaged or foreign frames, by name."""
    records: tuple[int, ...] = (0,)
    """First samples of the gap-free records. Plant and device start each record from rest."""
    line_s: float = 0.0
    """Transmission time of a lock-step run at the configured line speed; 0: no speed is configured."""
    line: Mapping[str, int] = field(default_factory=dict)
    """Speed and packing of the line (``Device.line``); empty if not recorded."""
    identity: Identity | None = None
    """Provenance; None if not recorded."""
    program: Program = field(default_factory=lambda: Program.load(DEFAULT_PROGRAM))
    """Program of the scenario; its channels are the columns of the samples."""

    @functools.cached_property
    def played(self) -> ScenarioFacts:
        """:raises ConfigurationError: the scenario lacks a key that a verdict reads, or has a wrong one."""
        return _facts(ScenarioFacts, self.scenario, "the recorded scenario")

    @functools.cached_property
    def source(self) -> RigFacts:
        """:raises ConfigurationError: as ``played``, of the rig."""
        return _facts(RigFacts, self.rig, "the recorded rig")

    @functools.cached_property
    def device(self) -> DeviceFacts:
        """:raises ConfigurationError: as ``played``, of the device."""
        return _facts(DeviceFacts, self.dut, "the recorded device")

    @functools.cached_property
    def estimator(self) -> EstimatorConfig | None:
        """Settings of the device; None if it is none of our catalogue.

        :raises ConfigurationError: as ``played``, of the device.
        """
        return self.device.settings("the recorded device")

    @functools.cached_property
    def datasheet(self) -> Datasheet:
        """Data sheet of the device: its own, or that of its estimator's settings."""
        return self.device.datasheet or Datasheet.of_estimator(self.dut["estimator"])

    def again(self, **changes: Any) -> Conditions:
        """Conditions of another run with the same scenario, rig and device, whose facts are read once for all."""
        if described := changes.keys() & {"scenario", "rig", "dut"}:
            raise TypeError(f"another {min(described)} has facts of its own")
        out = dataclasses.replace(self, **changes)
        vars(out).update({name: getattr(self, name) for name in ("played", "source", "device", "datasheet")})
        return out

    def check(self, where: str) -> None:
        """Check each key of the descriptions that a verdict reads; ``where`` leads every error.

        :raises ConfigurationError: a key is absent or wrong.
        """
        _facts(ScenarioFacts, self.scenario, f"{where}: scenario")
        _facts(RigFacts, self.rig, f"{where}: rig")
        _facts(DeviceFacts, self.dut, f"{where}: dut").settings(f"{where}: dut")
        for name, value in self.line.items():
            if not 1 <= value <= _MOST_COUNT:
                raise ConfigurationError(f"{where}: line: {name} must be 1 to {_MOST_COUNT}, not {value}")

    @property
    def sample_period_problem_s(self) -> float:
        """Problem time between samples."""
        return self.sample_period_s * self.time_scale

    @property
    def input(self) -> Channel:
        """Channel of the plant's input."""
        return self.channels[self.program.channels[INPUT]]

    @property
    def output(self) -> Channel:
        """Channel of the plant's output."""
        return self.channels[self.program.channels[OUTPUT]]


@dataclass(frozen=True, eq=False)
class Run:
    """Codes, estimates and alarms of one play: n samples, p parameters; n may be less than ``samples_asked``.

    ``save`` and ``load`` keep a run in one file and raise RecordingError. A verdict needs nothing else (``judge``).
    """

    conditions: Conditions
    codes: NDArray[np.uint16]
    """(n, c), columns as the channels of the program."""
    clipped: NDArray[np.bool_]
    """(n, c): the code is the limit of the range, not a measurement."""
    theta: NDArray[np.float32]
    """(n, p): the estimate after each sample, in codes per code; order of est.h. (n, 0) if it is not reported."""
    innovation: NDArray[np.float32]
    """(n,) prediction errors in codes; zeros if they are not reported (``datasheet``)."""
    statistic: NDArray[np.float32]
    """(n,): the trigger's statistic; zeros if it is not reported (``datasheet``)."""
    flags: NDArray[np.uint8]
    """(n,): SteppedFlag of the device, with LOST, UNREPORTED and UNARMED."""
    alarm_index: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """(a,): sample index of each alarm."""
    alarm_kind: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))
    alarm_statistic: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    diagnosis_index: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """(d,): sample after which the device reported the diagnosis."""
    diagnosis_change: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))
    """(d,): Change of the catalogue."""
    diagnosis_onset: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """(d,): sample of the change according to the device."""
    diagnosis_extent: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    """(d,): ratio of the new to the old value of the parameter."""
    misfit_index: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """(f,): sample after which the device reported another cause of a misfit."""
    misfit_cause: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))
    """(f,): Cause of the catalogue."""
    misfit_frequency: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    """(f,): frequency of the disturbance in cycles per sample; 0 unless the cause is HUM."""
    misfit_strength: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    """(f,): statistic over its limit; 0 if it is not reported."""

    @property
    def samples(self) -> int:
        """Number of samples that were played."""
        return len(self.codes)

    @property
    def datasheet(self) -> Datasheet:
        """Data sheet of the device."""
        return self.conditions.datasheet

    @functools.cached_property
    def missing(self) -> NDArray[np.bool_]:
        """(n,): samples sent to the device as missing."""
        return missing_samples(self.clipped)

    @property
    def lost(self) -> NDArray[np.bool_]:
        """(n,): samples lost on the way to the device."""
        return np.asarray((self.flags & LOST) != 0)

    def channel(self, name: str) -> NDArray[np.float64]:
        """Values of one channel in its physical unit, (n,) float64."""
        return self.conditions.channels[name].physical(self.codes[:, self.conditions.program.channels.index(name)])

    @functools.cached_property
    def segments(self) -> tuple[tuple[int, int, Plant], ...]:
        """Stretches (start, end, plant) of the played samples start <= k < end, in order.

        A new stretch begins at each change of the plant and at each record.
        """
        plants = {segment.start: segment.plant for segment in self.conditions.segments if segment.start < self.samples}
        if not plants:
            return ()
        starts = sorted({*plants, *(start for start, _ in self.records)})
        out: list[tuple[int, int, Plant]] = []
        for start, end in itertools.pairwise([*starts, self.samples]):
            out.append((start, end, plants[start] if start in plants else out[-1][2]))
        return tuple(out)

    @property
    def records(self) -> tuple[tuple[int, int], ...]:
        """Gap-free records (start, end) of the played samples start <= k < end, in order."""
        starts = [start for start in self.conditions.records if start < self.samples]
        return tuple(itertools.pairwise([*starts, self.samples]))

    def with_change_instants(self, instant: Callable[[Segment], Segment]) -> Run:
        """The same run with each segment replaced by ``instant(segment)``, which moves the instant of its change.

        The instants are limited to the record of the change.
        """
        segments = []
        for segment in self.conditions.segments:
            first, end = next((span for span in self.records if span[0] <= segment.start < span[1]), (-1, -1))
            moved = instant(segment)
            if first < segment.start < end:
                moved = dataclasses.replace(moved, start=min(max(moved.start, first + 1), end - 1))
            segments.append(moved)
        return dataclasses.replace(self, conditions=dataclasses.replace(self.conditions, segments=tuple(segments)))

    def with_identity(self, identity: Identity) -> Run:
        """The same run with this provenance."""
        return dataclasses.replace(self, conditions=dataclasses.replace(self.conditions, identity=identity))

    def theta_hash(self) -> str:
        """SHA-256 over the little-endian float32 bits of every estimate, row by row; empty without estimates."""
        if not self.theta.shape[1]:
            return ""
        digest = hashlib.sha256()
        for first in range(0, self.samples, CHUNK_SAMPLES):
            digest.update(np.ascontiguousarray(self.theta[first : first + CHUNK_SAMPLES], dtype="<f4").data)
        return digest.hexdigest()

    def alarm_hash(self) -> str:
        """SHA-256 over the little-endian int64 sample indices of the alarms."""
        return hashlib.sha256(np.ascontiguousarray(self.alarm_index, dtype="<i8").data).hexdigest()

    def save(self, path: str | Path) -> None:
        """Write the run to one file, atomically.

        :raises RecordingError: the file cannot be written.
        """
        path = Path(path)
        header = json.dumps({"format": FORMAT, "version": FORMAT_VERSION, "conditions": _to_json(self.conditions)})
        arrays = {name: getattr(self, name) for name in _ARRAYS | _OPTIONAL_ARRAYS}
        with replace_file(path) as file, zipfile.ZipFile(file, "w") as archive:
            for name, array in {"header": np.array(header), **arrays}.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    _write_array(member, array)

    @classmethod
    def load(cls, path: str | Path) -> Run:
        """Read a recording.

        :raises RecordingError: the file is absent, truncated, damaged, or not a recording of this format.
        """
        path = Path(path)
        if path.exists() and not path.is_file():
            raise RecordingError(f"{path}: not a file")
        try:
            with path.open("rb") as raw:
                _check_archive(raw)
                with np.load(raw, allow_pickle=False) as file:
                    header = json.loads(str(file["header"]), parse_float=_parse_finite, parse_constant=_parse_finite)
                    names = (*_ARRAYS, *(name for name in _OPTIONAL_ARRAYS if name in file))
                    arrays = {name: _check_array(name, file[name]) for name in names}
        except OSError as error:
            raise RecordingError(f"{path}: cannot read the recording: {error.strerror or error}") from error
        except Exception as error:  # numpy and zipfile raise a dozen types on damaged archives, undocumented
            cure = "analogrig import makes one of measured data"
            raise RecordingError(f"{path}: truncated, or not a recording of analogrig; {cure}") from error
        run = cls(conditions=_parse_conditions(header, path), **arrays)
        run._check_consistency(path)
        return run

    def _check_consistency(self, path: Path) -> None:
        """Check the arrays against each other and against the header.

        :raises RecordingError: names every check that failed, or the key of a description that is wrong.
        """
        try:
            self.conditions.check(f"{path}: the header of the recording")
        except ConfigurationError as error:
            raise RecordingError(str(error)) from error
        n, alarms, diagnoses = self.samples, len(self.alarm_index), len(self.diagnosis_index)
        misfits = len(self.misfit_index)
        conditions = self.conditions
        earliest, starts, latest = (
            [each.start for each in segments]
            for segments in (
                [segment.earliest() for segment in conditions.segments],
                conditions.segments,
                [segment.latest() for segment in conditions.segments],
            )
        )
        checks = {
            "arrays of different lengths": all(
                len(getattr(self, name)) == n for name in ("clipped", "theta", "innovation", "statistic", "flags")
            )
            and len(self.alarm_kind) == len(self.alarm_statistic) == alarms
            and all(len(getattr(self, name)) == diagnoses for name in _DIAGNOSIS_ARRAYS)
            and all(len(getattr(self, name)) == misfits for name in _MISFIT_ARRAYS),
            "channels": set(conditions.program.measured) <= set(conditions.channels) <= set(conditions.program.channels)
            and self.codes.shape[1] == self.clipped.shape[1] == len(conditions.program.channels),
            "sample times": all(
                _LEAST_MAGNITUDE < each < _MOST_MAGNITUDE
                for each in (conditions.sample_period_s, conditions.time_scale)
            )
            and all(0.0 <= each < _MOST_MAGNITUDE for each in (conditions.real_time, conditions.line_s)),
            "number of samples": n <= conditions.samples_asked <= MAX_SAMPLES,
            "seed": 0 <= conditions.seed < 2**63,
            "units": all(
                _LEAST_MAGNITUDE < channel.lsb_v < _MOST_MAGNITUDE
                and _LEAST_MAGNITUDE < abs(channel.unit_per_v) < _MOST_MAGNITUDE
                and abs(channel.low_v) < _MOST_MAGNITUDE
                and 0.0 <= channel.noise_lsb < _MOST_MAGNITUDE
                and 1 <= channel.codes <= MAX_CODES
                for channel in conditions.channels.values()
            ),
            "ramps": all(0 <= segment.ramp_n <= max(n, conditions.samples_asked) for segment in conditions.segments),
            "records": _start_at_zero_and_rise(conditions.records) and 1 <= len(conditions.records) <= MAX_CHANGES,
            "segments": len(starts) <= MAX_CHANGES + 1
            and all(_start_at_zero_and_rise(starts) for starts in (earliest, starts, latest))
            and all(low <= start <= high for low, start, high in zip(earliest, starts, latest, strict=True)),
            "alarms": _are_sample_indices(self.alarm_index, n),
            "diagnoses": _are_sample_indices(self.diagnosis_index, n)
            and set(self.diagnosis_change.tolist()) <= set(Change) - {Change.UNDECIDED},
            "misfits": _are_sample_indices(self.misfit_index, n)
            and set(self.misfit_cause.tolist()) <= set(Cause)
            and bool(((self.misfit_frequency >= 0.0) & (self.misfit_frequency <= MOST_FREQUENCY)).all()),
            "overloads": all(0 <= sample < n for sample in conditions.overloads.values()),
            "theta": self.theta.shape[1] == conditions.datasheet.theta_n,
        }
        wrong = [what for what, holds in checks.items() if not holds]
        if wrong:
            raise RecordingError(f"{path}: damaged recording: its {', '.join(wrong)} do not fit together")


def _write_array(file: IO[bytes], array: NDArray[Any]) -> None:
    """Write an array in the npy format, in chunks: np.savez would copy 16 MB at a time."""
    described = {"descr": np.lib.format.dtype_to_descr(array.dtype), "fortran_order": False, "shape": array.shape}
    np.lib.format.write_array_header_1_0(file, described)
    rows = np.atleast_1d(array)
    for first in range(0, len(rows), CHUNK_SAMPLES):
        file.write(rows[first : first + CHUNK_SAMPLES].tobytes())


def _parse_finite(number: str) -> float:
    """Value of a number in the header.

    :raises ValueError: the number is non-finite, which JSON cannot express.
    """
    value = float(number)
    if not math.isfinite(value):
        raise ValueError(f"{number} in the header")
    return value


def _are_sample_indices(indices: NDArray[np.int64], n: int) -> bool:
    """True if all ``indices`` are in 0 .. n - 1, in ascending order."""
    return not len(indices) or bool(indices[0] >= 0 and indices[-1] < n and (np.diff(indices) >= 0).all())


def _start_at_zero_and_rise(starts: Sequence[int]) -> bool:
    """True if ``starts`` is empty, or begins with 0 and ascends strictly."""
    return not starts or (starts[0] == 0 and list(starts) == sorted(set(starts)))


def _check_archive(raw: BinaryIO) -> None:
    """Check the archive's checksums, and reject compressed members, which could exhaust the memory.

    :raises ValueError: a member is compressed or damaged.
    """
    with zipfile.ZipFile(raw) as archive:
        if any(member.compress_type != zipfile.ZIP_STORED for member in archive.infolist()):
            raise ValueError("compressed")
        damaged = archive.testzip()
        if damaged is not None:
            raise ValueError(damaged)
    raw.seek(0)


def _check_array(name: str, array: NDArray[Any]) -> NDArray[Any]:
    """Return ``array`` if its type and dimensions are those of ``name``; else raise ValueError."""
    dtype, dimensions = (_ARRAYS | _OPTIONAL_ARRAYS)[name]
    if array.dtype != np.dtype(dtype) or array.ndim != dimensions:
        raise ValueError(f"array {name} is {array.dtype} with {array.ndim} dimensions")
    return array


def _to_json(conditions: Conditions) -> dict[str, Any]:
    """Header of the file in plain JSON types."""
    names = (each.name for each in dataclasses.fields(conditions) if each.name != "program")  # the scenario holds it
    out = {name: getattr(conditions, name) for name in names}
    if (identity := out.pop("identity")) is not None:
        out["identity"] = identity.as_table()
    out["channels"] = {name: vars(channel) for name, channel in conditions.channels.items()}
    out["segments"] = [
        {**{key: value for key, value in vars(s).items() if value not in (None, ())}, "plant": s.plant.parameters()}
        for s in conditions.segments
    ]
    return out


def _parse_conditions(header: Any, path: Path) -> Conditions:
    """Conditions from the header of a file.

    :raises RecordingError: ``header`` is malformed, or of another format.
    """
    if not isinstance(header, dict) or header.get("format") != FORMAT or header.get("version") != FORMAT_VERSION:
        raise RecordingError(f"{path}: not of the format {FORMAT} {FORMAT_VERSION}")
    table = header.get("conditions")
    if not isinstance(table, dict):
        raise RecordingError(f"{path}: the header of the recording has no conditions")
    where = f"{path}: the header of the recording"
    try:
        program = program_of(table.get("scenario"), f"{where}: scenario")
        table = {**table, "program": program}
        if isinstance(segments := table.get("segments"), list):
            named = ((each, f"{where}: segments[{i}]") for i, each in enumerate(segments))
            table["segments"] = [_with_plant(each, program, place) for each, place in named]
        return config.build(Conditions, table, where)
    except ConfigurationError as error:
        raise RecordingError(str(error)) from error


def _with_plant(segment: Any, program: Program, where: str) -> Any:
    """Segment of a header with its plant, which is there as values by name.

    :raises ConfigurationError: the values are no plant of the program.
    """
    if not isinstance(segment, Mapping) or "plant" not in segment:
        return segment
    values = config.convert(Mapping[str, float], segment["plant"], f"{where}: plant")
    try:
        return {**segment, "plant": Plant.of(program, values)}
    except ValueError as error:
        raise ConfigurationError(f"{where}: plant: {error}") from error
