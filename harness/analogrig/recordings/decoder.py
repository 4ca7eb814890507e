"""Decoder of captured CAN traffic: frames to messages, and messages to the runs of a device."""

from __future__ import annotations

import struct
from collections import Counter as Tally
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analogrig import catalogue
from analogrig.answers import AnswerRows, Answers, RaisedAlarm, ReportedDiagnosis, ReportedMisfit
from analogrig.catalogue import INDICES, LAYOUTS, RUNS, Message, brief, index_up_to, pack, unpack
from analogrig.devices.captured import CapturedRun
from analogrig.devices.device import Causes
from analogrig.devices.exchange import misfit_of
from analogrig.errors import ConfigurationError, RecordingError
from analogrig.estimator_config import MAX_PARAMETERS, EstimatorConfig
from analogrig.links.dbc import check_layout, load_dbc
from analogrig.links.link import Identifier
from analogrig.run import LOST, UNREPORTED
from analogrig.wording import number_of

if TYPE_CHECKING:
    import can


_COUNTERS = ("updated", "refused", "alarms", "samples_lost")
"""Counters of the device that prove whether the capture is complete."""


class FrameDictionary:
    """Meaning of frames, by the catalogue of this build or by a DBC with other identifiers and layouts."""

    def __init__(self, dbc: Path | None = None) -> None:
        """Decode by ``dbc``; None: by the catalogue of this build.

        :raises ConfigurationError: ``dbc`` is not a DBC, or one of its messages lacks a signal or is multiplexed.
        """
        self.is_own = dbc is None
        self._decoders: Mapping[tuple[int, bool], Callable[[bytes], Message | None]]
        if dbc is None:
            self._decoders = {(layout.id, False): partial(_decode_own, layout.id) for layout in LAYOUTS.values()}
        else:
            self._decoders = {key: partial(_decode_by_dbc, known) for key, known in _messages(dbc).items()}

    def message(self, frame: can.Message) -> Message | None:
        """Message in a frame; None if the frame holds none of the catalogue."""
        if frame.is_remote_frame or not self.is_known(frame):
            return None
        return self._decoders[frame.arbitration_id, frame.is_extended_id](bytes(frame.data))

    @property
    def known(self) -> Collection[Identifier]:
        """Identifiers of the catalogue."""
        return self._decoders.keys()

    def is_known(self, frame: can.Message) -> bool:
        """True if the identifier of the frame belongs to the catalogue."""
        return not frame.is_error_frame and (frame.arbitration_id, frame.is_extended_id) in self._decoders


def _decode_own(identifier: int, data: bytes) -> Message | None:
    return unpack(bytes((identifier,)) + data)


def _messages(dbc: Path) -> dict[tuple[int, bool], Any]:
    try:
        database = load_dbc(dbc)
    except ConfigurationError as error:
        raise ConfigurationError(f"--dbc {error}") from error
    known = [message for message in database.messages if message.name in LAYOUTS]
    if not known:
        raise ConfigurationError(f"--dbc {dbc}: has none of the messages {', '.join(LAYOUTS)}")
    for message in known:
        try:
            check_layout(message)
        except ValueError as error:
            raise ConfigurationError(f"--dbc {dbc}: {error}") from error
        layout = LAYOUTS[message.name]
        wanted = {_signal(each) for each in (*layout.fields, *layout.bits) if each != "flags"}
        missing = wanted - {signal.name for signal in message.signals}
        if missing:
            raise ConfigurationError(f"--dbc {dbc}: message {message.name} lacks {', '.join(sorted(missing))}")
        if message.is_multiplexed():
            raise ConfigurationError(f"--dbc {dbc}: message {message.name} is multiplexed")
    return {(message.frame_id, message.is_extended_frame): message for message in known}


def _signal(name: str) -> str:
    """Name in the DBC of a field or bit."""
    return "".join(word.capitalize() for word in name.split("_"))


def _decode_by_dbc(known: Any, data: bytes) -> Message | None:
    """Message by the names of its signals; None if its length or a value does not fit the catalogue."""
    from cantools.database import DecodeError

    layout = LAYOUTS[known.name]
    if len(data) != known.length:
        return None
    try:
        signals = known.decode(data, decode_choices=False, scaling=False)
        flags = sum(int(signals[_signal(bit)]) << shift for bit, (shift, _) in layout.bits.items())
        values = [flags if name == "flags" else signals[_signal(name)] for name in layout.fields]
        if known.name == "SampleBlock":
            values = [*values[:4], tuple(values[4:])]
        message: Message = getattr(catalogue, known.name)(*values)
        return unpack(pack(message))
    except (DecodeError, struct.error, ArithmeticError, ValueError):
        return None


@dataclass
class CatalogueRun(CapturedRun):
    """Run of a device of our catalogue, from its START to the next."""

    run: int | None = None
    """Run id; None if the capture began during the run."""
    report_interval_n: int = 1
    settings: Mapping[int, float] = field(default_factory=dict)
    """Captured settings of the estimator, by Key."""
    identity: Mapping[str, int] = field(default_factory=dict)
    estimates: dict[int, dict[int, float]] = field(default_factory=dict)
    """Values by sample index, then by element."""
    steps: dict[int, tuple[int, float]] = field(default_factory=dict)
    """Flags and statistic by sample index."""
    alarms: list[tuple[int, int, float]] = field(default_factory=list)
    diagnoses: list[tuple[int, int, int, float]] = field(default_factory=list)
    misfits: list[ReportedMisfit] = field(default_factory=list)
    counters: dict[str, int] = field(default_factory=dict)
    incomplete: set[int] = field(default_factory=set)
    """Samples some of whose answers are not in the capture."""

    @property
    def extent(self) -> int:
        return 1 + max((*self.samples, *self.steps), default=-1)

    def device(self, path: Path) -> Mapping[str, Any]:
        estimator = self._estimator(path)
        return {
            "name": "captured",
            "kind": "log",
            "report_interval_n": self.report_interval_n,
            "estimator": estimator.as_table(),
            "assumed_n": sum(key not in self.settings for key, _ in estimator.settings()),
            "identity": dict(self.identity),
        }

    def _estimator(self, path: Path) -> EstimatorConfig:
        most = min(MAX_PARAMETERS, self.identity.get("theta_max", MAX_PARAMETERS))
        return EstimatorConfig.from_settings(self.settings, str(path), most)

    def answers(self, path: Path) -> Answers:
        parameters = self._estimator(path).parameters
        rows = AnswerRows(parameters + 1)
        elements = (*range(parameters), int(catalogue.Element.INNOVATION))
        for k in range(self.extent):
            self._enter(rows, k, elements)
        rows.alarms = [RaisedAlarm(*alarm) for alarm in self.alarms if 0 <= alarm[0] < self.extent]
        rows.diagnoses = [ReportedDiagnosis(*each) for each in self.diagnoses if 0 <= each[0] < self.extent]
        rows.misfits = [misfit for misfit in self.misfits if 0 <= misfit.index < self.extent]
        return rows.take(self.extent, self.extent)

    def _enter(self, rows: AnswerRows, k: int, elements: Sequence[int]) -> None:
        """Enter the answer to sample k."""
        estimate = self.estimates.get(k, {})
        is_whole = set(estimate) >= set(elements)
        is_due = bool(estimate) or self.report_interval_n == 1
        flags, statistic = self.steps.get(k, (LOST, None))
        if k not in self.samples or k in self.incomplete or (is_due and not is_whole):
            flags |= LOST
        if is_whole:
            rows.values += [estimate[element] for element in elements]
            rows.finish(flags, rows.statistic if statistic is None else statistic)
        else:
            rows.repeat(flags if flags & LOST else flags | UNREPORTED, statistic)

    def capture_faults(self, path: Path) -> Iterator[str]:
        alarms = self.counters.get("alarms", len(self.alarms))
        if alarms != len(self.alarms):
            yield f"the device raised {number_of(alarms, 'alarm')}, {path} holds {len(self.alarms)}"
        missing = [name for name in _COUNTERS if name not in self.counters]
        if missing:
            yield f"the device's counters {', '.join(missing)} after the run are not in {path}"


class CaptureDecoder:
    """Decoder of a capture: assembles the runs of a device from the messages in both directions."""

    def __init__(self, dictionary: FrameDictionary, frames: Iterable[can.Message]) -> None:
        """Decode all ``frames``.

        :raises RecordingError: the device uses another catalogue, and no DBC was given.
        """
        self._dictionary = dictionary
        self.runs: list[CatalogueRun] = []
        """Runs with samples, and possibly a last one without."""
        self.line: Tally[str] = Tally()
        """Counts of foreign frames and of damaged, repeated or missing messages, by name."""
        self.causes = Causes()
        self._settings: Mapping[int, float] = {}
        """Current settings. Replaced, never modified: runs share them."""
        self._identity: Mapping[str, int] = {}
        """Current identity, likewise."""
        self._report_interval_n = 1
        self._last: dict[bool, Message] = {}
        """Last message of the harness (True) and of the device (False)."""
        self._early_faults: list[str] = []
        """Faults since the end of the last run."""
        self._has_gap = False
        self._undated: catalogue.Diagnosis | None = None
        self._at = {True: 0, False: 0}
        """Last index of the samples (True) and of the answers (False), which resolves the overflow of 16 bits."""
        for frame in frames:
            self._decode(frame)

    @property
    def known(self) -> Collection[Identifier]:
        return self._dictionary.known

    @property
    def carriers(self) -> Mapping[str, str]:
        return {}

    def _decode(self, frame: can.Message) -> None:
        message = self._dictionary.message(frame)
        if message is None:
            kind = "frames_dropped" if self._dictionary.is_known(frame) else "frames_foreign"
            self.line["error_frames" if frame.is_error_frame else kind] += 1
        elif self._is_next(message):
            handle = getattr(self, f"_{type(message).__name__.lower()}", None)
            if handle is not None:
                handle(message)

    def _is_next(self, message: Message) -> bool:
        """True unless the message is a repetition; counts the messages missing before it."""
        from_harness = LAYOUTS[type(message).__name__].from_harness
        last = self._last.get(from_harness)
        self._last[from_harness] = message
        if last is None or isinstance(message, catalogue.Identify | catalogue.Hello):
            return True
        step = (message.seq - last.seq) % catalogue.SEQS
        if step == 0:
            if type(message) is not type(last) or message != last:
                sender = "harness" if from_harness else "device"
                self._add_fault(f"{brief(last)} and {brief(message)} have the same number: more than one {sender}")
            self.line["messages_repeated"] += 1
            return False
        self.line["messages_missing"] += step - 1
        self._has_gap |= step > 1 and not from_harness
        return True

    def _add_fault(self, fault: str) -> None:
        """Record a fault of contradictory messages, one per run: in the current run and, after its end, in the next."""
        is_over = not self.runs or bool(self.runs[-1].counters)
        for faults in (*([self.runs[-1].faults] if self.runs else []), *([self._early_faults] if is_over else [])):
            if not faults:
                faults.append(fault)

    def _current_run(self) -> CatalogueRun:
        if not self.runs:
            self._begin(None)
        return self.runs[-1]

    def _begin(self, run: int | None) -> None:
        if self.runs and not self.runs[-1].samples:
            self.runs.pop()
        self.runs.append(
            CatalogueRun(
                run=run,
                report_interval_n=self._report_interval_n,
                settings=self._settings,
                identity=self._identity,
                faults=self._early_faults,
            )
        )
        self._early_faults = []
        self._at, self._has_gap, self._undated = {True: 0, False: 0}, False, None

    def _index(self, wire_index: int, *, of_sample: bool) -> int:
        last = self._at[of_sample]
        half = INDICES // 2
        index = index_up_to(last + half - 1, wire_index)
        if index >= 0:
            self._at[of_sample] = max(last, index)
        return index

    def _belongs_to_run(self, flags: int) -> bool:
        """True if the run id in ``flags`` is that of the current run, which adopts the first id if it has none."""
        run, current = flags >> catalogue.RUN_SHIFT & (RUNS - 1), self._current_run()
        if current.run is None:
            current.run = run
        self.line["messages_of_other_runs"] += current.run != run
        return current.run == run

    # ---- messages of the harness

    def _sample(self, message: catalogue.Sample) -> None:
        if self._belongs_to_run(message.flags):
            missing = bool(message.flags & catalogue.SampleFlag.MISSING)
            self._add_sample(message.sample_index, message.force, message.displacement, missing=missing)

    def _sampleblock(self, message: catalogue.SampleBlock) -> None:
        n = message.flags & ((1 << LAYOUTS["SampleBlock"].bits["samples"][1]) - 1)
        if self._belongs_to_run(message.flags) and 1 <= n <= catalogue.BLOCK_SAMPLES:
            for i in range(n):
                force, displacement = message.codes[2 * i : 2 * i + 2]
                index = (message.sample_index + i) % INDICES
                self._add_sample(index, force, displacement, missing=bool(message.missing >> i & 1))

    def _add_sample(self, wire_index: int, force: int, displacement: int, *, missing: bool) -> None:
        index = self._index(wire_index, of_sample=True)
        if index >= 0:
            sample = (force, displacement, missing)
            if self.runs[-1].samples.setdefault(index, sample) != sample:
                self._add_fault(f"sample {index} was sent twice with different codes")

    # ---- messages of the device

    def _hello(self, message: catalogue.Hello) -> None:
        """Keep the identity.

        :raises RecordingError: the device uses another catalogue, and no DBC was given.
        """
        if self._dictionary.is_own and message.catalogue_hash != catalogue.CATALOGUE_HASH:
            raise RecordingError(
                f"the device uses catalogue {message.catalogue_hash:#010x}, this harness"
                f" {catalogue.CATALOGUE_HASH:#010x}: pass the DBC of the device with --dbc"
            )
        hello = {"catalogue_hash": message.catalogue_hash, "theta_max": message.theta_max}
        self._identity = {**self._identity, **hello}

    def _firmware(self, message: catalogue.Firmware) -> None:
        before = self._identity.get("boot_nonce", message.boot_nonce)
        if before != message.boot_nonce and self.runs and not self.runs[-1].counters:
            self.runs[-1].faults.append("the device was reset during the run")
        firmware = {"boot_nonce": message.boot_nonce, "firmware_id": message.firmware_id}
        self._identity = {**self._identity, **firmware}

    def _configured(self, message: catalogue.Configured) -> None:
        self._settings = {**self._settings, message.key: message.value}

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
        elements = self._current_run().estimates.setdefault(index, {})
        if elements.setdefault(message.element, message.value) != message.value:
            self._add_fault(f"element {message.element} of the estimate of sample {index} was sent with two values")

    def _alarm(self, message: catalogue.Alarm) -> None:
        index = self._index(message.sample_index, of_sample=False)
        self._current_run().alarms.append((index, message.trigger, message.statistic))

    def _misfit(self, message: catalogue.Misfit) -> None:
        if message.cause in set(catalogue.Cause):
            index = self._index(message.sample_index, of_sample=False)
            self._current_run().misfits.append(misfit_of(index, message))

    def _diagnosis(self, message: catalogue.Diagnosis) -> None:
        self._undated = message

    def _stepped(self, message: catalogue.Stepped) -> None:
        if not self._belongs_to_run(message.flags):
            return
        index, run = self._index(message.sample_index, of_sample=False), self.runs[-1]
        if self._has_gap:
            run.incomplete.add(index)
            self._has_gap = False
        diagnosis, self._undated = self._undated, None  # its sample is that of the Stepped that follows it
        if diagnosis is not None and diagnosis.change in set(catalogue.Change) - {catalogue.Change.UNDECIDED}:
            onset = index_up_to(index, diagnosis.onset_index)
            run.diagnoses.append((index, diagnosis.change, onset, diagnosis.extent))
        step = (message.flags & catalogue.STEPPED_FLAGS, message.statistic)
        if run.steps.setdefault(index, step) != step:
            self._add_fault(f"the step of sample {index} was sent twice with different values")
