"""A Run: everything that one play of a scenario yielded, and the one file it is kept in.

The file is an uncompressed ``.npz``: the arrays under their own names and ``header``, a JSON text. Nothing in it is
ever executed (``allow_pickle=False``); a verdict can be computed from it alone, today or in ten years.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import math
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, BinaryIO, Self

import numpy as np
from numpy.typing import NDArray

from analogrig import config
from analogrig.catalogue import Change
from analogrig.errors import ConfigurationError, RecordingError
from analogrig.identity import Identity
from analogrig.plant import Plant
from analogrig.storage import replacing

if TYPE_CHECKING:
    from analogrig.estimator_config import EstimatorConfig

FORMAT = "analogrig-run"
FORMAT_VERSION = 1

CHUNK_SAMPLES = 1 << 16
"""Long runs are worked on in parts of this length, so that intermediate results take no memory to speak of."""

MAX_SAMPLES = 10_000_000
"""A run is kept in memory, some 70 bytes a sample."""

MAX_CHANGES = 1_000
"""Changes of the plant in a run, and its records: what can be known of each takes milliseconds to compute."""

MAX_CODES = 1 << 16

_NEAR, _FAR = 1e-12, 1e9
"""Short of and beyond any unit, time or noise that is one."""

CHANNELS = ("force", "displacement", "velocity", "net_force")
"""Order of the columns of ``Run.codes`` and ``Run.clipped``."""

MEASURED = ("force", "displacement")
"""Those that every rig has, and that the device is given."""

LOST = 0x20
"""In the flags of a sample, beside SteppedFlag: it was lost on the way to the device, for which it is missing."""
UNREPORTED = 0x40
"""... the device was asked not to report every estimate, and this one is that of the row before."""

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

_LATER_ARRAYS: dict[str, tuple[str, int]] = {
    "diagnosis_index": ("int64", 1),
    "diagnosis_change": ("uint8", 1),
    "diagnosis_onset": ("int64", 1),
    "diagnosis_extent": ("float32", 1),
}
"""Recordings made before a device could say what has changed lack them: they are empty."""


@dataclass(frozen=True)
class Channel:
    """How the codes of one channel translate: volts = low_v + code * lsb_v, physical = volts * unit_per_v."""

    low_v: float
    lsb_v: float
    unit: str
    unit_per_v: float
    noise_lsb: float
    """rms of the noise before quantisation, as far as the rig knows it."""
    codes: int = 4096
    """How many there are, from 0 on."""

    def physical(self, codes: NDArray[np.uint16]) -> NDArray[np.float64]:
        """Codes of any shape to ``unit`` (float64, same shape)."""
        return self.volts(codes) * self.unit_per_v

    def volts(self, codes: NDArray[np.uint16]) -> NDArray[np.float64]:
        """Codes of any shape to volts at the rig (float64, same shape)."""
        return self.low_v + codes.astype(np.float64) * self.lsb_v

    @property
    def zero(self) -> float:
        """The code of zero volts, not rounded; it may lie outside the range."""
        return -self.low_v / self.lsb_v

    @property
    def lsb(self) -> float:
        """One code in ``unit``."""
        return self.lsb_v * self.unit_per_v


def missing_to_device(clipped: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(n,) of (n, 4): a sample whose force or displacement was clipped is no measurement."""
    used = [CHANNELS.index(name) for name in MEASURED]
    return np.asarray(clipped[:, used].any(axis=1))


@dataclass(frozen=True)
class Segment:
    """The plant from a sample on, until the next segment."""

    start: int
    """Sample index."""
    plant: Plant
    ramp_n: int = 0
    """So many samples go by until it has become so."""
    start_low: int | None = None
    """The earliest instant at which it may have begun, where the samples had to tell; None: it is exact ..."""
    start_high: int | None = None
    """... and the latest."""
    end_low: int | None = None
    """The earliest instant at which a ramp may have been over ..."""
    end_high: int | None = None
    """... and the latest."""
    unseen: str = ""
    """Why nobody knows whether the plant changed, somewhere on the ramp; empty if one does."""

    def earliest(self) -> Self:
        """As if it had begun, and been over, as early as it may have."""
        return self._between(self.start_low, self.end_low)

    def latest(self) -> Self:
        """... as late as it may have."""
        return self._between(self.start_high, self.end_high)

    def _between(self, start: int | None, end: int | None) -> Self:
        start = self.start if start is None else start
        ramp_n = self.ramp_n if end is None else max(0, end - start)
        return dataclasses.replace(self, start=start, ramp_n=ramp_n)

    @property
    def is_exact(self) -> bool:
        return self.start_low is None and self.start_high is None and self.end_low is None and self.end_high is None


@dataclass(frozen=True)
class Conditions:
    """Conditions of a run: seed, sample times, the true plant, and the descriptions of scenario, rig, device and link.

    They are the header of the file. Instants are sample indices, times are in seconds.
    """

    seed: int
    samples_asked: int
    sample_period_s: float
    """Machine time between samples."""
    time_scale: float
    """Problem time per machine time (200: the computer runs 200 times faster than the motorcycle)."""
    channels: Mapping[str, Channel]
    segments: tuple[Segment, ...]
    """The truth, which the device never saw; empty if the rig does not know it."""
    scenario: Mapping[str, Any]
    """The scenario's TOML, with its name."""
    rig: Mapping[str, Any]
    """The rig's description, with its name."""
    dut: Mapping[str, Any]
    """Device: name, kind, estimator settings, identity (firmware, catalogue hash, boot nonce)."""
    link: str
    counters: Mapping[str, int] = field(default_factory=dict)
    """The device's own counters at the end."""
    faults: tuple[str, ...] = ()
    """Why the run is not valid; empty if it is."""
    overloads: Mapping[str, int] = field(default_factory=dict)
    """Of each amplifier whose overload lamp lit, the first sample that was taken with the lamp lit."""
    real_time: float = 0.0
    """By how much the machine's time was stretched to be that of the clock on the wall; 0: lock-step, in no time."""
    link_counters: Mapping[str, int] = field(default_factory=dict)
    """What was on the line since it was opened that was no message of the device: damaged frames, those of others..."""
    records: tuple[int, ...] = (0,)
    """First samples of the gap-free records, each of which the device began afresh and from rest."""
    line_s: float = 0.0
    """How long a line of the described speed would have taken, in lock-step; 0: none is described."""
    line: Mapping[str, int] = field(default_factory=dict)
    """How the samples went (``Dut.line``); empty if that is not recorded."""
    identity: Identity | None = None
    """Provenance; None in older recordings, and where a program plays that keeps none."""

    @property
    def sample_period_problem_s(self) -> float:
        """Problem time between samples."""
        return self.sample_period_s * self.time_scale


@dataclass(frozen=True, eq=False)
class Run:
    """Codes, estimates and alarms of one play: n samples, p parameters; n may be less than ``samples_asked``.

    ``save`` and ``load`` keep a run in one file and raise RecordingError. A verdict needs nothing else (``judge``).
    """

    conditions: Conditions
    codes: NDArray[np.uint16]
    """(n, 4), columns as ``CHANNELS``."""
    clipped: NDArray[np.bool_]
    """(n, 4): the code is the limit of the range, not a measurement."""
    theta: NDArray[np.float32]
    """(n, p): the estimate after each sample, in codes per code; order of est.h."""
    innovation: NDArray[np.float32]
    """(n,) codes."""
    statistic: NDArray[np.float32]
    """(n,): the trigger's statistic."""
    flags: NDArray[np.uint8]
    """(n,): SteppedFlag of the device, LOST, UNREPORTED."""
    alarm_index: NDArray[np.int64]
    """(a,): sample index of each alarm."""
    alarm_kind: NDArray[np.uint8]
    alarm_statistic: NDArray[np.float32]
    diagnosis_index: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """(d,): sample after which the device said what had changed."""
    diagnosis_change: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))
    """(d,): Change of the catalogue."""
    diagnosis_onset: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """(d,): the sample of the change, as the device has it."""
    diagnosis_extent: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    """(d,): new over old."""

    @property
    def samples(self) -> int:
        return len(self.codes)

    @property
    def missing(self) -> NDArray[np.bool_]:
        """(n,): the device was told that this sample is missing."""
        return missing_to_device(self.clipped)

    @property
    def lost(self) -> NDArray[np.bool_]:
        """(n,): this sample was lost on the way to the device."""
        return np.asarray((self.flags & LOST) != 0)

    def channel(self, name: str) -> NDArray[np.float64]:
        """One channel in its physical unit, (n,) float64."""
        return self.conditions.channels[name].physical(self.codes[:, CHANNELS.index(name)])

    @property
    def segments(self) -> tuple[tuple[int, int, Plant], ...]:
        """The stretches (start, end, plant) of the samples start <= k < end that were played, in order.

        Each begins with a change of the plant or with a record.
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
        """The gap-free records (start, end) of the samples start <= k < end that were played, in order."""
        starts = [start for start in self.conditions.records if start < self.samples]
        return tuple(itertools.pairwise([*starts, self.samples]))

    def supposing(self, instant: Callable[[Segment], Segment]) -> Run:
        """The same run if each change had come at another instant, within its record and before the end."""
        segments = []
        for segment in self.conditions.segments:
            first, end = next((span for span in self.records if span[0] <= segment.start < span[1]), (-1, -1))
            supposed = instant(segment)
            if first < segment.start < end:
                supposed = dataclasses.replace(supposed, start=min(max(supposed.start, first + 1), end - 1))
            segments.append(supposed)
        return dataclasses.replace(self, conditions=dataclasses.replace(self.conditions, segments=tuple(segments)))

    def made_by(self, identity: Identity) -> Run:
        """Return the same run with this provenance."""
        return dataclasses.replace(self, conditions=dataclasses.replace(self.conditions, identity=identity))

    def theta_hash(self) -> str:
        """SHA-256 over the little-endian float32 bits of every estimate, row by row."""
        digest = hashlib.sha256()
        for first in range(0, self.samples, CHUNK_SAMPLES):
            digest.update(np.ascontiguousarray(self.theta[first : first + CHUNK_SAMPLES], dtype="<f4").data)
        return digest.hexdigest()

    def save(self, path: Path) -> None:
        """Write atomically: the file is either the whole run or not there.

        :raises RecordingError: the file cannot be written.
        """
        header = json.dumps({"format": FORMAT, "version": FORMAT_VERSION, "conditions": _to_json(self.conditions)})
        arrays = {name: getattr(self, name) for name in _ARRAYS | _LATER_ARRAYS}
        with replacing(path) as file, zipfile.ZipFile(file, "w") as archive:
            for name, array in {"header": np.array(header), **arrays}.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    _write_array(member, array)

    @classmethod
    def load(cls, path: Path) -> Run:
        """Read a recording.

        :raises RecordingError: the file is absent, truncated, damaged, or not a recording of this format.
        """
        if path.exists() and not path.is_file():
            raise RecordingError(f"{path}: not a file")
        try:
            with path.open("rb") as raw:
                _check_archive(raw)
                with np.load(raw, allow_pickle=False) as file:
                    header = json.loads(str(file["header"]), parse_float=_finite, parse_constant=_finite)
                    names = (*_ARRAYS, *(name for name in _LATER_ARRAYS if name in file))
                    arrays = {name: _checked(name, file[name]) for name in names}
        except OSError as error:
            raise RecordingError(f"{path}: cannot read the recording: {error.strerror or error}") from error
        except Exception as error:  # numpy and zipfile raise a dozen types on damaged archives, undocumented
            raise RecordingError(f"{path}: truncated, or not a recording of analogrig") from error
        run = cls(conditions=_conditions(header, path), **arrays)
        run._check_consistency(path)
        return run

    def _estimator(self, path: Path) -> EstimatorConfig:
        """:raises RecordingError: a table of the header is not what is read of it later."""
        from analogrig.header import check_tables  # which needs the types of scenarios, and these ours

        ran = self.conditions
        try:
            return check_tables(
                f"{path}: the header of the recording", scenario=ran.scenario, rig=ran.rig, dut=ran.dut, line=ran.line
            )
        except ConfigurationError as error:
            raise RecordingError(str(error)) from error

    def _check_consistency(self, path: Path) -> None:
        """The arrays belong together, and so do they and the header."""
        n, alarms, diagnoses = self.samples, len(self.alarm_index), len(self.diagnosis_index)
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
            and all(len(getattr(self, name)) == diagnoses for name in _LATER_ARRAYS),
            "channels": set(MEASURED) <= set(conditions.channels) <= set(CHANNELS)
            and self.codes.shape[1] == self.clipped.shape[1] == len(CHANNELS),
            "sample times": all(_NEAR < each < _FAR for each in (conditions.sample_period_s, conditions.time_scale))
            and all(0.0 <= each < _FAR for each in (conditions.real_time, conditions.line_s)),
            "number of samples": n <= conditions.samples_asked <= MAX_SAMPLES,
            "seed": 0 <= conditions.seed < 2**63,
            "units": all(
                _NEAR < channel.lsb_v < _FAR
                and _NEAR < abs(channel.unit_per_v) < _FAR
                and abs(channel.low_v) < _FAR
                and 0.0 <= channel.noise_lsb < _FAR
                and 1 <= channel.codes <= MAX_CODES
                for channel in conditions.channels.values()
            ),
            "ramps": all(0 <= segment.ramp_n <= max(n, conditions.samples_asked) for segment in conditions.segments),
            "records": _ascend(conditions.records) and 1 <= len(conditions.records) <= MAX_CHANGES,
            "segments": len(starts) <= MAX_CHANGES + 1
            and all(_ascend(starts) for starts in (earliest, starts, latest))
            and all(low <= start <= high for low, start, high in zip(earliest, starts, latest, strict=True)),
            "alarms": _is_rising(self.alarm_index, n),
            "diagnoses": _is_rising(self.diagnosis_index, n)
            and set(self.diagnosis_change.tolist()) <= set(Change) - {Change.UNDECIDED},
            "line": all(value > 0 for value in conditions.line.values()),
            "overloads": all(0 <= sample < n for sample in conditions.overloads.values()),
            "estimator": self.theta.shape[1] == self._estimator(path).parameters,
        }
        wrong = [what for what, holds in checks.items() if not holds]
        if wrong:
            raise RecordingError(f"{path}: damaged recording: its {', '.join(wrong)} do not fit together")


def _write_array(file: IO[bytes], array: NDArray[Any]) -> None:
    """Write in the npy format, in parts: np.savez would copy 16 MB at a time."""
    described = {"descr": np.lib.format.dtype_to_descr(array.dtype), "fortran_order": False, "shape": array.shape}
    np.lib.format.write_array_header_1_0(file, described)
    rows = np.atleast_1d(array)
    for first in range(0, len(rows), CHUNK_SAMPLES):
        file.write(rows[first : first + CHUNK_SAMPLES].tobytes())


def _finite(number: str) -> float:
    """A number of the header, which goes to other programs as JSON again.

    :raises ValueError: it is none that JSON has.
    """
    value = float(number)
    if not math.isfinite(value):
        raise ValueError(f"{number} in the header")
    return value


def _is_rising(indices: NDArray[np.int64], n: int) -> bool:
    """True if all are samples of a run, in their order."""
    return not len(indices) or bool(indices[0] >= 0 and indices[-1] < n and (np.diff(indices) >= 0).all())


def _ascend(starts: Sequence[int]) -> bool:
    """From 0."""
    return not starts or (starts[0] == 0 and list(starts) == sorted(set(starts)))


def _check_archive(raw: BinaryIO) -> None:
    """Refuses what would be far larger in memory than on disk: a recording is not compressed."""
    with zipfile.ZipFile(raw) as archive:
        if any(member.compress_type != zipfile.ZIP_STORED for member in archive.infolist()):
            raise ValueError("compressed")
        damaged = archive.testzip()
        if damaged is not None:
            raise ValueError(damaged)
    raw.seek(0)


def _checked(name: str, array: NDArray[Any]) -> NDArray[Any]:
    dtype, dimensions = (_ARRAYS | _LATER_ARRAYS)[name]
    if array.dtype != np.dtype(dtype) or array.ndim != dimensions:
        raise ValueError(f"array {name} is {array.dtype} with {array.ndim} dimensions")
    return array


def _to_json(conditions: Conditions) -> dict[str, Any]:
    out = dict(vars(conditions))
    if (identity := out.pop("identity")) is not None:
        out["identity"] = identity.as_table()
    out["channels"] = {name: vars(channel) for name, channel in conditions.channels.items()}
    out["segments"] = [
        {**{key: value for key, value in vars(s).items() if value is not None}, "plant": vars(s.plant)}
        for s in conditions.segments
    ]
    return out


def _conditions(header: Any, path: Path) -> Conditions:
    """:raises RecordingError: the header is not one, or of another format."""
    if not isinstance(header, dict) or header.get("format") != FORMAT or header.get("version") != FORMAT_VERSION:
        raise RecordingError(f"{path}: not of the format {FORMAT} {FORMAT_VERSION}")
    table = header.get("conditions")
    if not isinstance(table, dict):
        raise RecordingError(f"{path}: the header of the recording has no conditions")
    try:
        return config.build(Conditions, table, f"{path}: the header of the recording")
    except ConfigurationError as error:
        raise RecordingError(str(error)) from error
