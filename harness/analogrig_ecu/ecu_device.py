"""ECU on a CAN bus, with messages of its own: one sample at a time, each answered before the next."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping

import can

from analogrig import ConfigurationError, DeviceError, LinkError, LinkTimeout
from analogrig.answers import LARGEST_FLOAT32, AnswerRows
from analogrig.devices import (
    LOST,
    UNARMED,
    UNREPORTED,
    Answers,
    Device,
    RaisedAlarm,
    Samples,
    SteppedFlag,
    TimeLimitReached,
)
from analogrig.devices.device import MOST_TIMEOUTS
from analogrig.devices.pace import Pace
from analogrig.links.can_bus import CanBus
from analogrig.links.can_station import CanStation
from analogrig.links.link import CanListener
from analogrig.run import Channel
from analogrig_ecu.dbc_description import DbcDescription, ReceivedSignals, Request
from analogrig_ecu.ecu_messages import Answer, EcuMessages

MISSING = int(SteppedFlag.MISSING)


class EcuAnswers:
    """Rows of a record, one for each sample, from the frames of the device in their order.

    A frame with an echoed counter belongs to the sample with that counter. Any other belongs to the latest sample.
    """

    def __init__(self, name: str, received: ReceivedSignals, messages: EcuMessages) -> None:
        """Begin a record. ``name`` is that of the device, for errors."""
        self._name = name
        self._received, self._messages = received, messages
        self._causes, self._traffic = messages.causes, messages.traffic
        self._is_echo = received.counter_is == "echo"
        quantities = messages.quantities
        self._reports = [full for key, full in quantities if key in {"theta", "innovation", "statistic"}]
        self._of_key = {key: full for key, full in quantities if key != "theta"}
        self._theta = [full for key, full in quantities if key == "theta"]
        self._needed = {full for _, full in quantities if full.rpartition(".")[0] not in messages.events}
        """Signals without which an answer is not complete."""
        self.rows = AnswerRows(len(self._theta) + 1)
        self.counted: Counter[str] = Counter()
        """Counts of irregular answers by name."""
        self._index = -1
        """The latest sample."""
        self._is_open = False
        self._is_missing = False
        self._absent: set[str] = set()
        """Signals of its answer so far whose value stands for none."""
        self._values: dict[str, float] = {}
        """Values of its answer so far."""
        self._seen: dict[tuple[str, ...], Mapping[str, float]] = {}
        """Values of each frame of its answer, by message and signals."""
        self._seen_before: dict[tuple[str, ...], Mapping[str, float]] = {}
        """The same of the sample before."""
        self._counts: dict[str, int] = {}
        """Latest own count of each message."""
        self._was_raised = False
        """True if the latest event raised an alarm."""
        self.is_complete = False
        """True if the latest sample is answered."""

    @property
    def next_index(self) -> int:
        """Index of the sample after the latest."""
        return self._index + 1

    def begin(self, index: int, *, missing: bool) -> None:
        """Await the answer to a sample."""
        self._index, self._is_missing = index, missing
        self._is_open, self.is_complete = True, False
        self._values, self._absent, self._seen, self._seen_before = {}, set(), {}, self._seen
        self._traffic.samples_n += 1

    def skip(self, index: int, flags: int) -> None:
        """Enter a sample that was not sent, or is not known."""
        self._index = index
        self._seen, self._seen_before = {}, self._seen
        self.rows.repeat(flags)

    def add(self, answer: Answer) -> None:
        """Take a frame of the device.

        :raises DeviceError: no sample awaits it, and nothing shows to which it belongs; it contradicts another; or a
            value is not finite.
        """
        key = (answer.message, *answer.values)
        index = self._index_of(answer)
        seen = self._seen if index == self._index else self._seen_before
        if index is None:
            return
        if answer.message in self._messages.events:
            self._add_event(answer, index)
            return
        absent = answer.absent | self._not_finite(answer, index)
        if self._is_open and index == self._index and key not in seen:
            seen[key] = answer.values
            self._values.update(answer.values)
            self._absent |= absent
            ends = self._received.complete
            if answer.message == ends or (not ends and self._needed <= self._values.keys()):
                self.is_complete = True
                self.end()
        elif not (self._is_echo and answer.counter is not None):
            cure = "" if answer.counter is not None else ", and has no counter (receive.counter)"
            self._traffic.came_again(answer.message)
            raise DeviceError(
                f"device {self._name}: a frame {answer.message} came after the answer to sample {index}{cure}"
            )
        elif key not in seen:
            self.counted["answers_late"] += 1
        elif seen[key] == answer.values:
            self._note_repeated(answer.message)
        else:
            raise DeviceError(
                f"device {self._name}: a frame {answer.message} answers sample {index} a second time with other values"
            )

    def _index_of(self, answer: Answer) -> int | None:
        """Sample to which a frame belongs: the latest or, by an echo, the one before; None for any other."""
        if answer.counter is None:
            return self._index
        modulus = self._messages.count_moduli[answer.message]
        if self._is_echo:
            sent = self._messages.echo_moduli[answer.message]
            self._traffic.echo(
                self._messages.counter_names[answer.message], (answer.counter - self._index % sent) % modulus
            )
            for index in (self._index, self._index - 1):
                if answer.counter == index % sent % modulus:
                    return index
            self.counted["answers_late"] += 1
            return None
        before = self._counts.get(answer.message)
        self._counts[answer.message] = answer.counter
        step = 1 if before is None else (answer.counter - before) % modulus
        if step == 0:
            self._note_repeated(answer.message)
            return None
        self.counted["answers_missing"] += step - 1
        return self._index

    def _note_repeated(self, message: str) -> None:
        """Count an answer that came again."""
        self.counted["answers_repeated"] += 1
        self._causes.add(f"a frame {message} came again with the same counter", place=f"sample {self._index}")

    def end(self) -> None:
        """Enter the latest sample as far as it is answered; does nothing if it has been entered."""
        if not self._is_open:
            return
        self._is_open = False
        for message in {message for message, *_ in self._seen}:
            self._traffic.answered(message)
        # Lost if nothing shows that the device has taken the sample, or if its alarm is not known.
        decisive = [self._of_key[key] for key in ("alarm", "armed") if self._of_key.get(key) in self._needed]
        is_lost = not (self._seen and self._values.keys() >= set(decisive))
        self._note_missing(loses=is_lost)
        if is_lost:
            self.counted["samples_unanswered"] += 1
            self.rows.repeat(LOST | MISSING)
            return
        known = {full: value for full, value in self._values.items() if full not in self._absent}
        is_unarmed = any(self._of_key.get(key, "") in self._absent for key in ("alarm", "armed"))
        is_unarmed |= known.get(self._of_key.get("armed", ""), 1.0) == 0.0
        flags = MISSING * self._is_missing | UNARMED * is_unarmed
        statistic = known.get(self._of_key.get("statistic", ""))
        if (alarm := self._of_key.get("alarm", "")) in self._needed:
            self._enter_alarm(known.get(alarm, 0.0), statistic or 0.0)
        if all(full in known for full in self._reports):
            self.rows.values += [known[full] for full in self._theta]
            self.rows.values.append(known.get(self._of_key.get("innovation", ""), 0.0))
            self.rows.finish(flags, statistic or 0.0)
        else:
            self.counted["answers_incomplete"] += 1
            self.rows.repeat(flags | UNREPORTED, statistic)

    def _note_missing(self, *, loses: bool) -> None:
        """Name the messages and signals that an answer lacks."""
        missing = sorted(self._needed - self._values.keys())
        came = {message for message, *_ in self._seen}
        for message in sorted({full.rpartition(".")[0] for full in missing}):
            gone = [full for full in missing if full.rpartition(".")[0] == message]
            text = f"an answer without {', '.join(gone)}" if message in came else f"an answer without a frame {message}"
            self._causes.add(text, noun="sample", place=f"sample {self._index}", loses=loses)

    def _not_finite(self, answer: Answer, index: int) -> frozenset[str]:
        """Signals that are no number in the answer to a missing sample.

        :raises DeviceError: one is no number in the answer to another, or too large for a float.
        """
        wrong = frozenset(full for full, value in answer.values.items() if not abs(value) <= LARGEST_FLOAT32)
        for full in wrong - answer.absent:
            value = answer.values[full]
            if not (self._is_missing and index == self._index):
                raise DeviceError(
                    f"device {self._name}: {full} = {value:g} for sample {index},"
                    " which is not finite or too large for a float"
                )
            self._causes.add(f"{full} = {value:g} at missing samples", noun="sample", place=f"sample {index}")
        return wrong

    def _add_event(self, answer: Answer, index: int) -> None:
        """Enter what a message reports that comes only with something to report."""
        alarm = self._of_key.get("alarm", "")
        if alarm not in answer.values or alarm in answer.absent:
            return
        before = len(self.rows.alarms)
        self._enter_alarm(answer.values[alarm], 0.0, index)
        is_raised = len(self.rows.alarms) > before
        if self._was_raised and self._received.alarm_is != "event":
            del self.rows.alarms[before:]  # the level lasts until an event ends it
        self._was_raised = is_raised

    def _enter_alarm(self, alarm: float, statistic: float, index: int | None = None) -> None:
        states = self._messages.alarm_states
        if alarm != 0.0 if states is None else alarm in states:
            self.rows.alarms.append(RaisedAlarm(self._index if index is None else index, statistic=statistic))


_SETTLING_S = 0.02
"""Time after the last sample in which a frame shows that an answer was repeated or late."""


class EcuDevice(Device):
    """ECU on a CAN bus, with messages of its own."""

    def __init__(self, description: DbcDescription, bus: CanBus) -> None:
        """Take over ``bus``. Nothing is sent yet.

        :raises ConfigurationError: the device file does not fit its DBC.
        """
        super().__init__(description)
        self._description: DbcDescription = description
        self._messages = EcuMessages(description)
        self.causes = self._messages.causes
        self._station = CanStation(bus, self._messages.own, self._messages.of_device)
        self._station.on_other = self._messages.traffic.take
        self._messages.causes.place = lambda: f"sample {self._answers.next_index - 1}"
        self._clock = self._station.clock
        self._encode = self._messages.encoder()
        self._limit_s = math.inf
        self._pace: Pace | None = None
        self._answers = self._new_answers()
        self._counted: Counter[str] = Counter()
        """Irregular answers of the records before."""
        self._timeouts = 0
        self._line_s = 0.0

    # ------------------------------------------------------------------------------------------------- before the run

    def recover(self) -> None:
        self._drain()
        self._request("reset", self._messages.reset)

    def prepare(self, channels: Mapping[str, Channel], period_s: float) -> None:  # noqa: ARG002
        """Take the scales of the channels.

        :raises ConfigurationError: a code does not fit its signal.
        """
        try:
            self._encode = self._messages.encoder(channels)
        except ConfigurationError as error:
            raise ConfigurationError(f"device {self.name}: {error}") from error

    def pace(self, period_s: float) -> Pace:
        return Pace(self._clock, period_s)

    def start(self, pace: Pace | None = None) -> None:
        if pace is not None:
            pace.restart()
        self._pace = pace
        self._drain()
        self._request("start", self._messages.start)
        self._counted += self._answers.counted
        self._answers = self._new_answers()
        self._timeouts = 0
        self._line_s = self._station.line_s

    def _new_answers(self) -> EcuAnswers:
        return EcuAnswers(self.name, self._description.receive, self._messages)

    def _drain(self) -> None:
        """Skip the frames that have come so far."""
        while self._receive(0.0) is not None:
            pass

    def _request(self, table: str, request: Request | None) -> None:
        """Send the frame of [start] or [reset], and await its answer if one is named.

        :raises LinkTimeout: the answer did not come.
        """
        if request is None:
            return
        self._station.send(self._messages.request(request))
        deadline_s = self._clock() + self._description.timeout_s
        while request.answer:
            frame = self._receive(deadline_s)
            if frame is None:
                raise LinkTimeout(
                    f"device {self.name}: no answer {request.answer} to [{table}] {request.message}"
                    f" within {self._description.timeout_s:g} s ({self._context()})"
                )
            if self._messages.is_answer(request, frame):
                return

    # --------------------------------------------------------------------------------------------------------- the run

    def play(self, blocks: Iterable[Samples]) -> Iterator[Answers]:
        for block in blocks:
            samples = zip(block.u.tolist(), block.y.tolist(), block.valid.tolist(), strict=True)
            skipped_n = block.skipped_after(self._answers.next_index)
            for index in range(block.first - skipped_n, block.first):  # as missing ones, whose answers are forgotten
                self._exchange(index, 0, 0, valid=False)
            self._answers.rows.take(skipped_n, block.first)
            try:
                for index, sample in enumerate(samples, block.first):
                    self._exchange(index, *sample)
            except (LinkError, TimeLimitReached):
                answered = len(self._answers.rows.flags)
                yield self._take(answered, block.first + answered)
                raise
            yield self._take(len(block), block.first + len(block))

    def _exchange(self, index: int, u: int, y: int, valid: bool) -> None:  # noqa: FBT001
        """Send one sample, and take its answer.

        :raises LinkError, DeviceError: names the sample.
        """
        try:
            self._wait(index)
            if not valid and not self._description.send.valid:
                self._answers.skip(index, MISSING | UNREPORTED)
                return
            for frame in self._encode(index, u, y, valid):
                self._station.send(frame)
            self._answers.begin(index, missing=not valid)
            deadline_s = self._clock() + self._description.timeout_s
            while not self._answers.is_complete:
                if (answer := self._receive(deadline_s)) is None:
                    self._lose()
                    return
                self._take_frame(answer)
        except LinkError as error:
            raise type(error)(f"device {self.name}: sample {index}: {error}") from error

    def _wait(self, index: int) -> None:
        """Take the frames that come before the sample is due."""
        due_s = 0.0
        if self._pace is not None:
            due_s = self._pace.due_s(index + 1)
        while (frame := self._receive(due_s)) is not None:
            self._take_frame(frame)
        if self._pace is not None:
            self._pace.sending(index + 1, 1, is_full=False)

    def _take_frame(self, frame: can.Message) -> None:
        """:raises DeviceError: no sample awaits the frame."""
        self._messages.traffic.take(frame)
        answer = self._messages.answer(frame)
        if answer is not None:
            self._answers.add(answer)
        elif self._messages.is_of_answer(frame):
            self._station.counted["frames_dropped"] += 1

    def _lose(self) -> None:
        """:raises LinkTimeout: too many samples were not answered."""
        self._answers.end()
        self._timeouts += 1
        if self._timeouts > MOST_TIMEOUTS:
            raise LinkTimeout(
                f"no complete answer within {self._description.timeout_s:g} s, for the {self._timeouts}th time"
                f" ({self._context()})"
            )

    def _receive(self, until_s: float) -> can.Message | None:
        """The next frame of the device; None if there is none until ``until_s``.

        :raises TimeLimitReached: the time limit has passed.
        """
        frame = self._station.receive(max(0.0, min(until_s, self._limit_s) - self._clock()))
        if frame is None and self._clock() >= self._limit_s:
            raise TimeLimitReached("the time limit of the run is over")
        return frame

    def _context(self) -> str:
        self._messages.conclude(in_log=False)
        known = (self._description.hint(self._station.name), self._station.trouble, *self.causes.losses[:1])
        return "; ".join(text for text in known if text)

    def _take(self, n: int, before: int) -> Answers:
        """Answers to the first ``n`` samples, without the quantities that the device does not report."""
        answers, sheet = self._answers.rows.take(n, before), self.datasheet
        return dataclasses.replace(
            answers,
            theta=answers.theta if sheet.theta_n else None,
            innovation=answers.innovation if sheet.innovation else None,
            statistic=answers.statistic if sheet.statistic else None,
        )

    def stop(self) -> Mapping[str, int]:
        """End the record.

        :raises DeviceError: a frame came after all answers, so that one of them may belong to another sample; or a
            message never came.
        """
        if not self._messages.is_each_answer_counted:
            until_s = self._clock() + _SETTLING_S
            while (frame := self._receive(until_s)) is not None:
                self._take_frame(frame)
        if self._answers.next_index and (texts := self._messages.never_came):
            raise DeviceError(f"device {self.name}: {texts[0]}")
        return {}

    def limit(self, left_s: float) -> None:
        self._limit_s = self._clock() + left_s

    def close(self) -> None:
        self._station.close()

    # -------------------------------------------------------------------------------------------------------- its line

    @property
    def link_name(self) -> str:
        return self._station.name

    @property
    def link_counters(self) -> Mapping[str, int]:
        return {**self._station.counters, **(self._counted + self._answers.counted)}

    @property
    def losses(self) -> tuple[str, ...]:
        self._messages.conclude(in_log=False)
        bus = f"the bus: {self._station.trouble}" if self._station.counted["error_frames"] else ""
        return (*self.causes.losses, *([bus] if bus else []))

    @property
    def line_s(self) -> float:
        return self._station.line_s - self._line_s

    @property
    def line(self) -> Mapping[str, int]:
        line = self._station.line
        return {**({} if line is None else line.rates()), "samples_per_message": 1, "window": 1}

    def listen(self, listener: CanListener) -> None:
        self._station.listen(listener)
