"""CAN traffic in files: what a run leaves beside its recording, and what somebody's tool has captured on a bench.

Files are those of python-can: candump's .log, Vector's .asc and .blf, .mf4 (with asammdf), and to be read PEAK's .trc.
A capture knows neither the rig nor the plant: the scenario and the description of the rig say what they were. What it
lacks is as if it had been lost on the way to the device; from the numbers of the messages it is known what that is.
"""

from __future__ import annotations

import contextlib
import dataclasses
import gc
import io
import itertools
import struct
import sys
import typing
from collections import Counter as Tally
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TextIO

import numpy as np

from harness import catalogue
from harness.catalogue import CATALOGUE_HASH, LAYOUTS, RUN_SHIFT, RUNS, Message, SteppedFlag, pack, unpack
from harness.errors import ConfigurationError, RecordingError
from harness.estimator_config import MAX_PARAMETERS, EstimatorConfig
from harness.run import CHANNELS, LOST, UNREPORTED, Conditions, Run
from harness.scenario import Scenario

if TYPE_CHECKING:
    import can

    from harness.rigs.rig import Rig

WRITTEN = ("log", "blf", "asc", "mf4")
"""Formats that a run can leave, by the suffix of the file."""
READ = (*WRITTEN, "trc")

_SEQ = 256
_INDICES = 1 << 16
"""Sequence numbers and indices of samples are modulo these in a message."""
_FLAGS = sum(SteppedFlag)
_MOST_NAMED = 3
_COUNTERS = ("updated", "refused", "alarms", "samples_lost")
"""Of the device; by these it is known whether all that it did was heard."""


# --------------------------------------------------------------------------------------------------------- writing


class _Writer(Protocol):
    def __call__(self, frame: can.Message) -> None: ...

    def stop(self) -> None: ...


class CanLog:
    """A listener to a link that writes each frame to a file; there is none before the first frame after ``begin``.

    A disk that is full does not end the run: ``close`` tells.
    """

    def __init__(self, path: Path) -> None:
        """The suffix of ``path`` is one of WRITTEN."""
        self.path = path
        self._held: list[can.Message] | None = []
        """What passed before the beginning."""
        self._writer: _Writer | None = None
        self._failure: Exception | None = None

    @property
    def has_heard(self) -> bool:
        """Whether a frame has passed before the beginning; after the handshake with a device on a CAN bus some have."""
        return bool(self._held)

    def begin(self) -> None:
        """The device has answered: what an earlier run has left in the file may go, what was said so far is written."""
        held, self._held = self._held or [], None
        for frame in held:
            self(frame)

    def __call__(self, frame: can.Message) -> None:
        if self._held is not None:
            self._held.append(frame)
            return
        if self._failure is not None:
            return
        try:
            if self._writer is None:
                self._writer = _writer(self.path)
            self._writer(frame)
        except Exception as error:  # noqa: BLE001 - the formats raise what they like; the run goes on
            self._failure = error

    def close(self) -> None:
        """Finish the file. May be called twice.

        :raises RecordingError: not all of it could be written.
        """
        writer, self._writer = self._writer, None
        try:
            if writer is not None:
                writer.stop()
        except Exception as error:  # noqa: BLE001 - as above
            self._failure = self._failure or error
        failure, self._failure = self._failure, None
        if failure is not None:
            said = getattr(failure, "strerror", None) or " ".join(str(failure).split())
            raise RecordingError(f"{self.path}: cannot be written: {said}") from failure


def _writer(path: Path) -> _Writer:
    import can

    writers: Mapping[str, Any] = {
        "log": can.CanutilsLogWriter,
        "blf": can.BLFWriter,
        "asc": can.ASCWriter,
        "mf4": can.MF4Writer,
    }
    writer: _Writer = writers[path.suffix[1:]](path)
    return writer


# --------------------------------------------------------------------------------------------------------- reading


class _Lines(io.TextIOBase):
    """A text file that knows where it is."""

    def __init__(self, file: TextIO) -> None:
        self._file = file
        self.number = 0

    def readline(self, _size: int | None = -1, /) -> str:  # type: ignore[override]
        line = self._file.readline()
        self.number += line != ""
        return line


@dataclass
class CapturedFrames:
    """The frames of a file, as python-can reads them; to be taken once."""

    path: Path
    damaged: list[int] = field(default_factory=list)
    """Lines that are no frames, and were passed over."""
    end: str = ""
    """Why it ended before its end, if it did."""

    def __post_init__(self) -> None:
        """:raises RecordingError: no such file, or none of a format that is known."""
        if self.path.suffix[1:].lower() not in READ:
            raise RecordingError(f"{self.path}: not a CAN log: the suffix must be one of .{', .'.join(READ)}")
        try:
            with self.path.open("rb"):
                pass
        except OSError as error:
            raise RecordingError(f"{self.path}: {error.strerror or error}") from error

    def __iter__(self) -> Iterator[can.Message]:
        return self._of_lines() if self.path.suffix.lower() == ".log" else self._of_file()

    def _of_lines(self) -> Iterator[can.Message]:
        """candump's, where a line stands for itself."""
        import can

        with self.path.open(encoding="ascii", errors="replace") as file:
            lines = _Lines(file)
            while True:
                before = lines.number
                try:
                    yield from can.CanutilsLogReader(typing.cast(TextIO, lines))
                except Exception:  # noqa: BLE001 - whatever a line makes of python-can
                    self.damaged.append(lines.number)
                    if lines.number > before:
                        continue
                return

    def _of_file(self) -> Iterator[can.Message]:
        """The others, which cannot be read on after a fault."""
        import can

        readers: Mapping[str, Any] = {
            "blf": can.BLFReader,
            "asc": can.ASCReader,
            "mf4": can.MF4Reader,
            "trc": can.TRCReader,
        }
        suffix = self.path.suffix[1:].lower()
        n = 0
        # Opened here, since readers that fail leave the file open.
        with self.path.open("rb") as raw:
            file = io.TextIOWrapper(raw, "utf-8", "replace") if suffix in {"asc", "trc"} else raw
            with _asammdf_silenced():
                try:
                    for frame in readers[suffix](file):
                        yield frame
                        n += 1
                except Exception as error:  # noqa: BLE001 - as above
                    said = " ".join(str(error).split()) or type(error).__name__
                    self.end = f"{self.path} is damaged after {n} frames: {said}"
                if self.end:
                    gc.collect()


@contextlib.contextmanager
def _asammdf_silenced() -> Iterator[None]:
    """Of a file that it could not open its destructor complains, with a traceback and when the garbage is collected."""
    before = sys.unraisablehook

    def hook(unraisable: sys.UnraisableHookArgs) -> None:
        if not str(getattr(unraisable.object, "__module__", "")).startswith("asammdf"):
            before(unraisable)

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = before


class Dictionary:
    """The messages as they are on the bus: those of this build, or those of a DBC that has them elsewhere."""

    def __init__(self, dbc: Path | None = None) -> None:
        """:raises ConfigurationError: ``dbc`` is none, or a message that it has lacks a signal or is multiplexed."""
        self.dbc = dbc
        self._messages = {} if dbc is None else _messages(dbc)

    def message(self, frame: can.Message) -> Message | None:
        """What it says; None if it is none of ours."""
        if frame.is_error_frame or frame.is_remote_frame:
            return None
        if self.dbc is not None:
            known = self._messages.get((frame.arbitration_id, frame.is_extended_id))
            return None if known is None else _translated(known, bytes(frame.data))
        if frame.is_extended_id or frame.arbitration_id > 0xFF:
            return None
        return unpack(bytes((frame.arbitration_id,)) + bytes(frame.data))

    def is_ours(self, frame: can.Message) -> bool:
        """Whether the identifier is that of a message."""
        if frame.is_error_frame:
            return False
        if self.dbc is not None:
            return (frame.arbitration_id, frame.is_extended_id) in self._messages
        return not frame.is_extended_id and frame.arbitration_id in _IDENTIFIERS


_IDENTIFIERS = {layout.id for layout in LAYOUTS.values()}


def _messages(dbc: Path) -> dict[tuple[int, bool], Any]:
    import cantools

    try:
        database: Any = cantools.database.load_file(str(dbc), database_format="dbc")
    except OSError as error:
        raise ConfigurationError(f"--dbc {dbc}: {error.strerror or error}") from error
    except Exception as error:
        said = " ".join(str(error).split())
        raise ConfigurationError(f"--dbc {dbc}: not a DBC: {said}") from error
    known = [message for message in database.messages if message.name in LAYOUTS]
    if not known:
        raise ConfigurationError(f"--dbc {dbc}: has none of the messages {', '.join(LAYOUTS)}")
    for message in known:
        lacking = set(_signals(message.name)) - {signal.name for signal in message.signals}
        if lacking:
            raise ConfigurationError(f"--dbc {dbc}: message {message.name} lacks {', '.join(sorted(lacking))}")
        if message.is_multiplexed():
            raise ConfigurationError(f"--dbc {dbc}: message {message.name} is multiplexed")
    return {(message.frame_id, message.is_extended_frame): message for message in known}


def _signals(name: str) -> list[str]:
    """As the DBC calls the fields and bits of a message."""
    layout = LAYOUTS[name]
    return [_signal(each) for each in (*layout.fields, *layout.bits) if each != "flags"]


def _signal(name: str) -> str:
    return "".join(word.capitalize() for word in name.split("_"))


def _translated(known: Any, data: bytes) -> Message | None:
    """By the names of message and signals; None: of the wrong length, or with a value that ours cannot have."""
    from cantools.database import DecodeError

    layout = LAYOUTS[known.name]
    if len(data) != known.length:
        return None
    try:
        said = known.decode(data, decode_choices=False, scaling=False)
        flags = sum(int(said[_signal(bit)]) << shift for bit, (shift, _) in layout.bits.items())
        values = [flags if name == "flags" else said[_signal(name)] for name in layout.fields]
        if known.name == "SampleBlock":
            values = [*values[:4], tuple(values[4:])]
        message: Message = getattr(catalogue, known.name)(*values)
        return unpack(pack(message))
    except (DecodeError, struct.error, ArithmeticError, ValueError):
        return None


# -------------------------------------------------------------------------------------------------- what was said


@dataclass
class CapturedRun:
    """What the frames say about one run of a device, from its START to the next."""

    run: int | None = None
    """Its id; None: the capture began later."""
    report_interval_n: int = 1
    settings: Mapping[int, float] = field(default_factory=dict)
    """Of the estimator, by the Key, as far as they were heard."""
    identity: Mapping[str, int] = field(default_factory=dict)
    samples: dict[int, tuple[int, int, bool]] = field(default_factory=dict)
    """By its index: force, displacement, and whether it was said to be missing."""
    estimates: dict[int, dict[int, float]] = field(default_factory=dict)
    """By the index of the sample, then by the element."""
    steps: dict[int, tuple[int, float]] = field(default_factory=dict)
    """By the index: flags and statistic."""
    alarms: list[tuple[int, int, float]] = field(default_factory=list)
    diagnoses: list[tuple[int, int, int, float]] = field(default_factory=list)
    counters: dict[str, int] = field(default_factory=dict)
    torn: set[int] = field(default_factory=set)
    """Samples among whose answers messages are not there."""
    faults: list[str] = field(default_factory=list)
    """Why it cannot be judged."""

    @property
    def extent(self) -> int:
        """Samples up to the last that anything is known of."""
        return 1 + max((*self.samples, *self.steps), default=-1)


class _Listener:
    """Makes runs of messages, whoever they were said to."""

    def __init__(self, dictionary: Dictionary) -> None:
        self._dictionary = dictionary
        self.runs: list[CapturedRun] = []
        self.line: Tally[str] = Tally()
        self._settings: dict[int, float] = {}
        self._identity: dict[str, int] = {}
        self._report_interval_n = 1
        self._last: dict[bool, Message] = {}
        """Of the harness and of the device."""
        self._early_faults: list[str] = []
        """What was wrong before the run."""
        self._torn = False
        self._undated: catalogue.Diagnosis | None = None
        self._at = {True: 0, False: 0}
        """Of samples and answers: the last index, which tells how often the 16 bits went around."""

    def hear(self, frame: can.Message) -> None:
        message = self._dictionary.message(frame)
        if message is None:
            kind = "frames_dropped" if self._dictionary.is_ours(frame) else "frames_foreign"
            self.line["error_frames" if frame.is_error_frame else kind] += 1
        elif self._is_next(message):
            handle = getattr(self, f"_{type(message).__name__.lower()}", None)
            if handle is not None:
                handle(message)

    def _is_next(self, message: Message) -> bool:
        """Not one that came before; notes what is lacking before it."""
        from_harness = LAYOUTS[type(message).__name__].from_harness
        last = self._last.get(from_harness)
        self._last[from_harness] = message
        if last is None or isinstance(message, catalogue.Identify | catalogue.Hello):
            return True
        step = (message.seq - last.seq) % _SEQ
        if step == 0:
            if type(message) is not type(last) or message != last:
                who = "harness" if from_harness else "device"
                self._doubt(f"{_brief(last)} and {_brief(message)} have the same number: two speak as the {who}")
            self.line["messages_repeated"] += 1
            return False
        self.line["messages_lacking"] += step - 1
        self._torn |= step > 1 and not from_harness
        return True

    def _doubt(self, fault: str) -> None:
        """Of what was said nobody knows what is true; once for each run is enough."""
        is_over = not self.runs or bool(self.runs[-1].counters)
        for faults in (*([self.runs[-1].faults] if self.runs else []), *([self._early_faults] if is_over else [])):
            if not faults:
                faults.append(fault)

    def _begun(self) -> CapturedRun:
        if not self.runs:
            self._begin(None)
        return self.runs[-1]

    def _begin(self, run: int | None) -> None:
        self.runs.append(
            CapturedRun(
                run, self._report_interval_n, dict(self._settings), dict(self._identity), faults=self._early_faults
            )
        )
        self._early_faults = []
        self._at, self._torn, self._undated = {True: 0, False: 0}, False, None

    def _index(self, wire_index: int, *, of_sample: bool) -> int:
        last = self._at[of_sample]
        half = _INDICES // 2
        index = last + (wire_index - last + half) % _INDICES - half
        if index >= 0:
            self._at[of_sample] = max(last, index)
        return index

    def _is_of(self, flags: int) -> bool:
        """Whether it belongs to the run; one that began before the capture has the id that comes first."""
        run, begun = flags >> RUN_SHIFT & (RUNS - 1), self._begun()
        if begun.run is None:
            begun.run = run
        self.line["messages_of_other_runs"] += begun.run != run
        return begun.run == run

    # ---- of the harness

    def _sample(self, message: catalogue.Sample) -> None:
        if self._is_of(message.flags):
            missing = bool(message.flags & catalogue.SampleFlag.MISSING)
            self._enter(message.sample_index, message.force, message.displacement, missing=missing)

    def _sampleblock(self, message: catalogue.SampleBlock) -> None:
        n = message.flags & ((1 << LAYOUTS["SampleBlock"].bits["samples"][1]) - 1)
        if self._is_of(message.flags) and 1 <= n <= catalogue.BLOCK_SAMPLES:
            for i in range(n):
                force, displacement = message.codes[2 * i : 2 * i + 2]
                index = (message.sample_index + i) % _INDICES
                self._enter(index, force, displacement, missing=bool(message.missing >> i & 1))

    def _enter(self, wire_index: int, force: int, displacement: int, *, missing: bool) -> None:
        index = self._index(wire_index, of_sample=True)
        if index >= 0:
            sample = (force, displacement, missing)
            if self.runs[-1].samples.setdefault(index, sample) != sample:
                self._doubt(f"sample {index} was sent twice, and not the same")

    # ---- of the device

    def _hello(self, message: catalogue.Hello) -> None:
        """:raises RecordingError: it speaks another catalogue, and nobody says which."""
        if self._dictionary.dbc is None and message.catalogue_hash != CATALOGUE_HASH:
            raise RecordingError(
                f"the device speaks catalogue {message.catalogue_hash:#010x}, this harness {CATALOGUE_HASH:#010x}:"
                " say --dbc with the DBC that it was built from"
            )
        self._identity |= {"catalogue_hash": message.catalogue_hash, "theta_max": message.theta_max}

    def _firmware(self, message: catalogue.Firmware) -> None:
        before = self._identity.get("boot_nonce", message.boot_nonce)
        if before != message.boot_nonce and self.runs and not self.runs[-1].counters:
            self.runs[-1].faults.append("the device was reset during the run")
        self._identity |= {"boot_nonce": message.boot_nonce, "firmware_id": message.firmware_id}

    def _configured(self, message: catalogue.Configured) -> None:
        self._settings[message.key] = message.value

    def _controlled(self, message: catalogue.Controlled) -> None:
        if message.result != catalogue.Result.APPLIED:
            return
        if message.command == catalogue.Command.START:
            self._begin(message.argument % RUNS)
        elif message.command == catalogue.Command.REPORT_INTERVAL:
            self._report_interval_n = max(1, message.argument)

    def _status(self, message: catalogue.Status) -> None:
        known = {int(counter): counter.name.lower() for counter in catalogue.Counter}
        if self.runs and self.runs[-1].steps and message.counter in known:
            self.runs[-1].counters[known[message.counter]] = message.value

    def _estimate(self, message: catalogue.Estimate) -> None:
        index = self._index(message.sample_index, of_sample=False)
        elements = self._begun().estimates.setdefault(index, {})
        if elements.setdefault(message.element, message.value) != message.value:
            self._doubt(f"element {message.element} of the estimate of sample {index} was said twice, and not the same")

    def _alarm(self, message: catalogue.Alarm) -> None:
        index = self._index(message.sample_index, of_sample=False)
        self._begun().alarms.append((index, message.trigger, message.statistic))

    def _diagnosis(self, message: catalogue.Diagnosis) -> None:
        self._undated = message

    def _date_diagnosis(self, index: int) -> None:
        """It names no sample: that of the next Stepped is meant."""
        said, self._undated = self._undated, None
        if said is not None and said.change in set(catalogue.Change) - {catalogue.Change.UNDECIDED}:
            onset = index - (index - said.onset_index) % _INDICES
            self.runs[-1].diagnoses.append((index, said.change, onset, said.extent))

    def _stepped(self, message: catalogue.Stepped) -> None:
        if not self._is_of(message.flags):
            return
        index, run = self._index(message.sample_index, of_sample=False), self.runs[-1]
        if self._torn:
            run.torn.add(index)
            self._torn = False
        self._date_diagnosis(index)
        step = (message.flags & _FLAGS, message.statistic)
        if run.steps.setdefault(index, step) != step:
            self._doubt(f"the step of sample {index} was said twice, and not the same")


def _brief(message: Message) -> str:
    """Its type, and its sample if it is about one."""
    index = getattr(message, "sample_index", None)
    return type(message).__name__ if index is None else f"{type(message).__name__} {index}"


def _heard(listener: _Listener, frames: CapturedFrames) -> None:
    """:raises RecordingError: see ``_Listener``; names the file."""
    try:
        for frame in frames:
            listener.hear(frame)
    except RecordingError as error:
        raise RecordingError(f"{frames.path}: {error}") from error


# ----------------------------------------------------------------------------------------------------------- a run


def captured_run(
    path: Path,
    scenario: Scenario,
    rig: Rig,
    *,
    dbc: Path | None = None,
    number: int | None = None,
    most_lost_n: int = 0,
) -> Run:
    """The run that a CAN log holds, with the truth of ``scenario`` and the units of ``rig``.

    Samples without codes or without all of their answers are LOST, and those without codes missing. Velocity and net
    force do not travel: their codes are zero, and marked as clipped.

    :param number: which of several runs, from 1; None: there is only one.
    :raises RecordingError: the file cannot be read, or there is no such run in it.
    :raises ConfigurationError: ``dbc`` is wrong, or the scenario is not the one of the log.
    """
    frames, listener = CapturedFrames(path), _Listener(Dictionary(dbc))
    _heard(listener, frames)
    said = _chosen(path, listener, frames, number)
    if said.extent > scenario.samples:
        raise ConfigurationError(
            f"{path}: has {said.extent} samples, scenario {scenario.name} {scenario.samples}: is it another one?"
        )
    return _run(path, said, scenario, rig, most_lost_n=most_lost_n, line=_line(listener, frames), end=frames.end)


def retold(run: Run, scenario: Scenario) -> Run:
    """A recorded run with what another scenario says of its plant and asks of its device.

    :raises ConfigurationError: it has fewer samples.
    """
    if run.samples > scenario.samples:
        raise ConfigurationError(
            f"the recording has {run.samples} samples, scenario {scenario.name} {scenario.samples}"
        )
    conditions = dataclasses.replace(
        run.conditions,
        scenario=scenario.as_table(),
        segments=scenario.segments(),
        samples_asked=scenario.samples,
    )
    return dataclasses.replace(run, conditions=conditions)


def _line(listener: _Listener, frames: CapturedFrames) -> dict[str, int]:
    """What else was seen, by name."""
    seen = {**listener.line, "lines_damaged": len(frames.damaged)}
    return {name: n for name, n in seen.items() if n}


def _chosen(path: Path, listener: _Listener, frames: CapturedFrames, number: int | None) -> CapturedRun:
    runs = [run for run in listener.runs if run.samples]
    if not runs:
        raise RecordingError(f"{path}: holds no run of a device{_why(listener, frames)}")
    if number is None and len(runs) > 1:
        raise RecordingError(f"{path}: holds {len(runs)} runs: say --run 1 to {len(runs)}")
    if number is not None and not 1 <= number <= len(runs):
        raise RecordingError(f"{path}: has no run {number}: there are {len(runs)}")
    return runs[(number or 1) - 1]


def _why(listener: _Listener, frames: CapturedFrames) -> str:
    """As far as that can be told."""
    if frames.end:
        return f": {frames.end}"
    if frames.damaged:
        first = ", ".join(map(str, frames.damaged[:_MOST_NAMED]))
        return f": {len(frames.damaged)} lines are no frames (at {first}); candump -L writes what can be read"
    foreign = listener.line["frames_foreign"]
    return f": {foreign} frames have other identifiers; --dbc says which are ours" if foreign else ""


def _run(
    path: Path, said: CapturedRun, scenario: Scenario, rig: Rig, *, most_lost_n: int, line: Mapping[str, int], end: str
) -> Run:
    most = min(MAX_PARAMETERS, said.identity.get("theta_max", MAX_PARAMETERS))
    estimator = EstimatorConfig.from_settings(said.settings, str(path), most)
    rows = _Rows(said, estimator.parameters)
    n = said.extent
    lost = int(((rows.flags & LOST) != 0).sum())
    counters = dict(said.counters)
    if counters.get("alarms", len(said.alarms)) != len(said.alarms):
        said.faults.append(f"the device raised {counters['alarms']} alarms, {path} holds {len(said.alarms)}")
    lacking = [name for name in _COUNTERS if name not in counters]
    if lacking:
        said.faults.append(f"the device's counters {', '.join(lacking)} after the run are not in {path}")
    if lost > counters.get("samples_lost", lost):  # it has seen what the capture has not
        counters = {name: value for name, value in counters.items() if name not in {"samples_lost", "updated"}}
    performance = rig.perform(scenario, 0)
    alarms = [alarm for alarm in said.alarms if 0 <= alarm[0] < n]
    diagnoses = [each for each in said.diagnoses if 0 <= each[0] < n]
    return Run(
        conditions=Conditions(
            seed=0,
            samples_asked=scenario.samples,
            sample_period_s=performance.sample_period_s,
            time_scale=performance.time_scale,
            channels=performance.channels,
            segments=scenario.segments(),
            scenario=scenario.as_table(),
            rig=rig.description(),
            dut={
                "name": "captured",
                "kind": "log",
                "report_interval_n": said.report_interval_n,
                "most_lost_n": most_lost_n,
                "estimator": estimator.as_table(),
                "assumed_n": sum(key not in said.settings for key, _ in estimator.settings()),
                "identity": dict(said.identity),
            },
            link=str(path),
            counters=counters,
            link_counters=line,
            faults=(*scenario.caveats, *said.faults, *([end] if end else [])),
        ),
        codes=rows.codes,
        clipped=rows.clipped,
        theta=rows.values[:, :-1],
        innovation=rows.values[:, -1],
        statistic=rows.statistic,
        flags=rows.flags,
        **_columns(alarms, ("alarm_index", "alarm_kind", "alarm_statistic")),
        **_columns(diagnoses, ("diagnosis_index", "diagnosis_change", "diagnosis_onset", "diagnosis_extent")),
    )


_TYPES = {"index": np.int64, "onset": np.int64, "kind": np.uint8, "change": np.uint8}


def _columns(rows: Sequence[Sequence[float]], names: Sequence[str]) -> dict[str, Any]:
    columns: Iterable[Sequence[float]] = zip(*rows, strict=True) if rows else itertools.repeat(())
    types = [_TYPES.get(name.rpartition("_")[2], np.float32) for name in names]
    return {name: np.array(column, kind) for name, kind, column in zip(names, types, columns, strict=False)}


class _Rows:
    """The arrays of a run."""

    def __init__(self, said: CapturedRun, parameters: int) -> None:
        n, elements = said.extent, (*range(parameters), int(catalogue.Element.INNOVATION))
        self.codes = np.zeros((n, len(CHANNELS)), np.uint16)
        self.clipped = np.ones((n, len(CHANNELS)), np.bool_)
        self.values = np.zeros((n, len(elements)), np.float32)
        self.statistic = np.zeros(n, np.float32)
        self.flags = np.zeros(n, np.uint8)
        used = [CHANNELS.index("force"), CHANNELS.index("displacement")]
        for k in range(n):
            sample, estimate = said.samples.get(k), said.estimates.get(k, {})
            is_whole = set(estimate) >= set(elements)
            if sample is not None:
                self.codes[k, used], self.clipped[k, used] = sample[:2], sample[2]
            elif k:
                self.codes[k] = self.codes[k - 1]
            if is_whole:
                self.values[k] = [estimate[element] for element in elements]
            elif k:
                self.values[k, :-1] = self.values[k - 1, :-1]
            flags, self.statistic[k] = said.steps.get(k, (LOST, self.statistic[k - 1] if k else 0.0))
            is_due = bool(estimate) or said.report_interval_n == 1
            if sample is None or k in said.torn or (is_due and not is_whole):
                flags |= LOST
            self.flags[k] = flags if is_whole or flags & LOST else flags | UNREPORTED
