"""What harness and device said to each other, from the frames of a bus on which somebody listened."""

from __future__ import annotations

from collections import Counter as Tally
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from analogrig import catalogue
from analogrig.catalogue import (
    CATALOGUE_HASH,
    INDICES,
    LAYOUTS,
    RUN_SHIFT,
    RUNS,
    SEQS,
    STEPPED_FLAGS,
    Message,
    brief,
    index_up_to,
)
from analogrig.errors import RecordingError
from analogrig.recordings.dictionary import FrameDecoder

if TYPE_CHECKING:
    import can


@dataclass(slots=True)
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


class CaptureDecoder:
    """Makes runs of messages, whoever they were said to."""

    def __init__(self, dictionary: FrameDecoder, frames: Iterable[can.Message]) -> None:
        """Listen to all of them.

        :raises RecordingError: the device speaks another catalogue, and nobody says which.
        """
        self._dictionary = dictionary
        self.runs: list[CapturedRun] = []
        """Those with samples, and perhaps a last one without."""
        self.line: Tally[str] = Tally()
        """What was no message of either, or not heard as it should be, by name."""
        self._settings: Mapping[int, float] = {}
        self._identity: Mapping[str, int] = {}
        """Both are shared by the runs to which they apply, and never changed."""
        self._report_interval_n = 1
        self._last: dict[bool, Message] = {}
        """Of the harness and of the device."""
        self._early_faults: list[str] = []
        """What was wrong before the run."""
        self._has_gap = False
        self._undated: catalogue.Diagnosis | None = None
        self._at = {True: 0, False: 0}
        """Of samples and answers: the last index, which tells how often the 16 bits went around."""
        for frame in frames:
            self._decode(frame)

    def _decode(self, frame: can.Message) -> None:
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
        step = (message.seq - last.seq) % SEQS
        if step == 0:
            if type(message) is not type(last) or message != last:
                who = "harness" if from_harness else "device"
                self._add_fault(f"{brief(last)} and {brief(message)} have the same number: two speak as the {who}")
            self.line["messages_repeated"] += 1
            return False
        self.line["messages_lacking"] += step - 1
        self._has_gap |= step > 1 and not from_harness
        return True

    def _add_fault(self, fault: str) -> None:
        """Of what was said nobody knows what is true; once for each run is enough."""
        is_over = not self.runs or bool(self.runs[-1].counters)
        for faults in (*([self.runs[-1].faults] if self.runs else []), *([self._early_faults] if is_over else [])):
            if not faults:
                faults.append(fault)

    def _current_run(self) -> CapturedRun:
        if not self.runs:
            self._begin(None)
        return self.runs[-1]

    def _begin(self, run: int | None) -> None:
        if self.runs and not self.runs[-1].samples:
            self.runs.pop()
        self.runs.append(
            CapturedRun(run, self._report_interval_n, self._settings, self._identity, faults=self._early_faults)
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
        """Whether it belongs to the run; one that began before the capture has the id that comes first."""
        run, begun = flags >> RUN_SHIFT & (RUNS - 1), self._current_run()
        if begun.run is None:
            begun.run = run
        self.line["messages_of_other_runs"] += begun.run != run
        return begun.run == run

    # ---- of the harness

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
                self._add_fault(f"sample {index} was sent twice, and not the same")

    # ---- of the device

    def _hello(self, message: catalogue.Hello) -> None:
        """:raises RecordingError: it speaks another catalogue, and nobody says which."""
        if self._dictionary.dbc is None and message.catalogue_hash != CATALOGUE_HASH:
            raise RecordingError(
                f"the device speaks catalogue {message.catalogue_hash:#010x}, this harness {CATALOGUE_HASH:#010x}:"
                " say --dbc with the DBC that it was built from"
            )
        said = {"catalogue_hash": message.catalogue_hash, "theta_max": message.theta_max}
        self._identity = {**self._identity, **said}

    def _firmware(self, message: catalogue.Firmware) -> None:
        before = self._identity.get("boot_nonce", message.boot_nonce)
        if before != message.boot_nonce and self.runs and not self.runs[-1].counters:
            self.runs[-1].faults.append("the device was reset during the run")
        said = {"boot_nonce": message.boot_nonce, "firmware_id": message.firmware_id}
        self._identity = {**self._identity, **said}

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
            self._add_fault(
                f"element {message.element} of the estimate of sample {index} was said twice, and not the same"
            )

    def _alarm(self, message: catalogue.Alarm) -> None:
        index = self._index(message.sample_index, of_sample=False)
        self._current_run().alarms.append((index, message.trigger, message.statistic))

    def _diagnosis(self, message: catalogue.Diagnosis) -> None:
        self._undated = message

    def _date_diagnosis(self, index: int) -> None:
        """It names no sample: that of the next Stepped is meant."""
        said, self._undated = self._undated, None
        if said is not None and said.change in set(catalogue.Change) - {catalogue.Change.UNDECIDED}:
            onset = index_up_to(index, said.onset_index)
            self.runs[-1].diagnoses.append((index, said.change, onset, said.extent))

    def _stepped(self, message: catalogue.Stepped) -> None:
        if not self._belongs_to_run(message.flags):
            return
        index, run = self._index(message.sample_index, of_sample=False), self.runs[-1]
        if self._has_gap:
            run.torn.add(index)
            self._has_gap = False
        self._date_diagnosis(index)
        step = (message.flags & STEPPED_FLAGS, message.statistic)
        if run.steps.setdefault(index, step) != step:
            self._add_fault(f"the step of sample {index} was said twice, and not the same")
