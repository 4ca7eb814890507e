"""Reference of the conversation: the answers that a device of our catalogue owes to each message.

It follows the catalogue and the manual device.h. Values come from the reference estimator.
"""

from __future__ import annotations

from collections.abc import Iterator

from analogrig.catalogue import (
    BLOCK_SAMPLES,
    CATALOGUE_HASH,
    INDICES,
    RUN_SHIFT,
    RUNS,
    SEQS,
    Alarm,
    Command,
    Configure,
    Configured,
    Control,
    Controlled,
    Counter,
    Element,
    Estimate,
    Firmware,
    Hello,
    Identify,
    Message,
    Result,
    Sample,
    SampleBlock,
    SampleFlag,
    Status,
    Stepped,
    Trigger,
)
from analogrig.errors import ConfigurationError
from analogrig.estimator_config import EstimatorConfig
from tests.reference.estimator import COUNTERS, ReferenceEstimator
from tests.reference.settings import ReferenceSettings

LATE_MAX, GAP_MAX, MOST_INTERVAL = 32, 1024, 65_535
"""Sequence numbers that count as repeated, samples of a gap that are entered, and longest interval of reports."""

_SAMPLES_MASK = (1 << 4) - 1


class ReferenceDevice:
    """Device whose answers are expected. ``enter`` a message, and compare the answers."""

    def __init__(self, hello: Hello, firmware: Firmware, settings: ReferenceSettings, *, on_can: bool) -> None:
        """``hello`` and ``firmware``: answers to the first Identify, which state the limits of the build.

        :param on_can: messages that are not of the harness come from other nodes.
        """
        self._counts_others = "frames_foreign" if on_can else "messages_refused"
        self._hello, self._firmware = hello, firmware
        self._settings = settings
        self._seq = (firmware.seq + 1) % SEQS
        self._expected: int | None = (hello.answers + 1) % SEQS
        self._reset()

    def _reset(self) -> None:
        self._settings = self._settings.defaults()
        self._estimator = ReferenceEstimator(EstimatorConfig())
        self.counters = dict.fromkeys((counter.name.lower() for counter in Counter), 0)
        self._is_running, self._run, self._next_index = False, 0, 0
        self._interval_n, self._unreported_n = 1, 0

    def enter(self, message: Message) -> list[Message]:
        """Answers due for a message, in order."""
        if not isinstance(message, Identify | Control | Configure | Sample | SampleBlock):
            self.counters[self._counts_others] += 1
            return []
        if not self._follows(message):
            return []
        answers = list(self._answers(message))
        numbered = [each._replace(seq=(self._seq + n) % SEQS) for n, each in enumerate(answers)]
        self._seq = (self._seq + len(answers)) % SEQS
        return numbered

    def _follows(self, message: Message) -> bool:
        """True unless the message is a repetition."""
        if not isinstance(message, Identify) and self._expected is not None:
            behind = (self._expected - message.seq) % SEQS
            if 1 <= behind <= LATE_MAX:
                self.counters["messages_repeated"] += 1
                return False
            self.counters["sequence_gaps"] += message.seq != self._expected
        self._expected = (message.seq + 1) % SEQS
        return True

    def _answers(self, message: Message) -> Iterator[Message]:
        seq = message.seq
        match message:
            case Identify():
                yield self._hello._replace(answers=seq, catalogue_hash=CATALOGUE_HASH)
                yield self._firmware._replace(answers=seq)
            case Control(command=Command.STATUS):
                for counter in Counter:
                    yield Status(0, counter, seq, self._count(counter.name.lower()))
            case Control(command=command, argument=argument):
                yield Controlled(0, command, seq, self._control(command, argument), argument)
            case Configure(key=key, value=value):
                result = Result.RUNNING if self._is_running else self._settings.put(key, value)
                yield Configured(0, key, seq, result, self._settings.value(key))
            case Sample(flags=flags, sample_index=index, force=u, displacement=y):
                if self._accepts(flags >> RUN_SHIFT, 1):
                    yield from self._enter_sample(index, u, y, is_valid=not flags & SampleFlag.MISSING)
            case SampleBlock():
                yield from self._enter_block(message)

    def _count(self, name: str) -> int:
        return self._estimator.counters[name] if name in COUNTERS else self.counters[name]

    # ---- control

    def _control(self, command: int, argument: int) -> Result:
        match command:
            case Command.START:
                return self._start(argument)
            case Command.STOP:
                self._is_running = False
            case Command.RESET:
                self._reset()
            case Command.REPORT_INTERVAL:
                if not 1 <= argument <= MOST_INTERVAL:
                    return Result.OUT_OF_RANGE
                self._interval_n, self._unreported_n = argument, 0
            case _:
                return Result.UNKNOWN
        return Result.APPLIED

    def _start(self, run: int) -> Result:
        if self._is_running:
            return Result.RUNNING
        try:
            config = self._settings.config(self._hello.theta_max)
        except ConfigurationError:
            config = None
        if config is None or run >= RUNS:
            return Result.OUT_OF_RANGE
        self._estimator = ReferenceEstimator(config)
        self._is_running, self._run, self._next_index, self._unreported_n = True, run, 0, 0
        return Result.APPLIED

    # ---- samples

    def _accepts(self, run: int, samples: int) -> bool:
        if not self._is_running or not 1 <= samples <= BLOCK_SAMPLES:
            self.counters["messages_refused"] += 1
            return False
        if run != self._run:
            self.counters["samples_of_other_runs"] += samples
            return False
        return True

    def _enter_block(self, block: SampleBlock) -> Iterator[Message]:
        samples = block.flags & _SAMPLES_MASK
        if not self._accepts(block.flags >> RUN_SHIFT, samples):
            return
        for i in range(samples):
            u, y = block.codes[2 * i : 2 * i + 2]
            is_valid = not block.missing >> i & 1
            yield from self._enter_sample((block.sample_index + i) % INDICES, u, y, is_valid=is_valid)

    def _enter_sample(self, index: int, u: int, y: int, *, is_valid: bool) -> Iterator[Message]:
        ahead = (index - self._next_index) % INDICES
        if ahead >= INDICES // 2:
            self.counters["samples_ignored"] += 1
            return
        if ahead:
            self._estimator.step(0.0, 0.0, valid=False)  # further ones are counted, and change nothing
            self._estimator.counters["missing"] += min(ahead, GAP_MAX) - 1
        self.counters["samples_lost"] += ahead
        self._unreported_n = (self._unreported_n + ahead) % self._interval_n
        step = self._estimator.step(u, y, valid=is_valid)
        if step.alarm:
            trigger = Trigger[self._estimator.config.trigger.upper().replace("-", "_")]
            yield Alarm(0, trigger, index, step.statistic)
        self._unreported_n += 1
        if self._unreported_n >= self._interval_n:
            self._unreported_n = 0
            for element, value in enumerate(self._estimator.theta):
                yield Estimate(0, element, index, value)
            yield Estimate(0, Element.INNOVATION, index, step.innovation)
        yield Stepped(0, step.flags | self._run << RUN_SHIFT, index, step.statistic)
        self._next_index = (index + 1) % INDICES
