"""ECU on a CAN bus, with messages of its own: one sample at a time, each answered before the next."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping

from analogrig.answers import Answers, Samples
from analogrig.devices.can_dbc import CanDbcDevice, Request
from analogrig.devices.device import Device
from analogrig.devices.ecu_answers import MISSING, EcuAnswers
from analogrig.errors import ConfigurationError, LinkError, LinkTimeout, TimeLimitReached
from analogrig.links.can_bus import CanBus
from analogrig.links.can_station import CanStation
from analogrig.links.link import CanListener
from analogrig.links.python_can import can
from analogrig.protocol.exchange import MOST_TIMEOUTS
from analogrig.protocol.pace import Pace
from analogrig.run import UNREPORTED, Channel

_SETTLING_S = 0.02
"""Time after the last sample in which a frame shows that an answer was repeated or late."""


class EcuDevice(Device):
    """ECU on a CAN bus, with messages of its own."""

    def __init__(self, description: CanDbcDevice, bus: CanBus) -> None:
        """Take over ``bus``. Nothing is sent yet.

        :raises ConfigurationError: the device file does not fit its DBC.
        """
        super().__init__(description)
        self._description: CanDbcDevice = description
        self._messages = description.messages()
        self._station = CanStation(bus, self._messages.own, self._messages.of_device)
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
            self._skip(block)
            try:
                for index, sample in enumerate(samples, block.first):
                    self._exchange(index, *sample)
            except (LinkError, TimeLimitReached):
                answered = len(self._answers.rows.flags)
                yield self._take(answered, block.first + answered)
                raise
            yield self._take(len(block), block.first + len(block))

    def _skip(self, block: Samples) -> None:
        """Send the skipped samples before the block as missing ones, and forget their answers."""
        skipped_n = block.skipped_after(self._answers.next_index)
        for index in range(block.first - skipped_n, block.first):
            self._exchange(index, 0, 0, valid=False)
        self._answers.rows.take(skipped_n, block.first)

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
            self._await_answer()
        except LinkError as error:
            raise type(error)(f"device {self.name}: sample {index}: {error}") from error

    def _await_answer(self) -> None:
        """Take frames until the latest sample is answered, or the time-out is over.

        :raises LinkTimeout: too many samples were not answered.
        """
        deadline_s = self._clock() + self._description.timeout_s
        while not self._answers.is_complete:
            frame = self._receive(deadline_s)
            if frame is None:
                self._lose()
                return
            self._take_frame(frame)

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
        answer = self._messages.answer(frame)
        if answer is not None:
            self._answers.add(answer)
        elif self._messages.is_of_answer(frame):
            self._station.counted["frames_dropped"] += 1

    def _lose(self) -> None:
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
        hint, trouble = self._description.hint(self._station.name), self._station.trouble
        return f"{hint}; {trouble}" if trouble else hint

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

        :raises DeviceError: a frame came after all answers, so that one of them may belong to another sample.
        """
        if not self._messages.is_each_answer_counted:
            until_s = self._clock() + _SETTLING_S
            while (frame := self._receive(until_s)) is not None:
                self._take_frame(frame)
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
    def line_s(self) -> float:
        return self._station.line_s - self._line_s

    @property
    def line(self) -> Mapping[str, int]:
        line = self._station.line
        return {**({} if line is None else line.rates()), "samples_per_message": 1, "window": 1}

    def listen(self, listener: CanListener) -> None:
        self._station.listen(listener)
