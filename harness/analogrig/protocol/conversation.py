"""Requests and answers over a link.

Both sides number their messages, which reveals lost and repeated ones. Each answer holds the number of its request.
"""

from __future__ import annotations

import math
from typing import TypeVar

from analogrig.catalogue import SEQS, Configured, Controlled, Firmware, Hello, Message, Status, brief, pack
from analogrig.errors import DeviceError, LinkError, LinkTimeout, TimeLimitReached
from analogrig.links.link import Link
from analogrig.wording import number_of

LATEST = 32
"""Messages within this distance behind the expected number are repetitions; others follow a loss."""

Answer = TypeVar("Answer", Hello, Firmware, Controlled, Configured, Status)


class Conversation:
    """Dialogue of the harness with one device. Errors begin with the device's name."""

    def __init__(self, link: Link, name: str, timeout_s: float) -> None:
        """Use ``link`` to the device ``name``; ``timeout_s`` applies to all answers to one message."""
        self.link = link
        self.name = name
        self.timeout_s = timeout_s
        self.clock = link.clock
        self.limit_s = math.inf
        """End of the run's time limit on the clock [s]."""
        self._seq = 0
        self._expected: int | None = None
        self._heard: dict[int, Message] = {}
        """Latest message, by number."""
        self._last: Message | None = None
        self._damaged_before_n = 0
        """Damaged frames before the last run began."""

    @property
    def last(self) -> str:
        """Short form of the device's last message."""
        return "none" if self._last is None else brief(self._last)

    @property
    def context(self) -> str:
        """Last message and known trouble of the line, for errors about a silent device."""
        trouble = self.link.trouble
        return f"last message: {self.last}{'; ' if trouble else ''}{trouble}"

    def begin(self) -> None:
        """Accept any number in the device's next message."""
        self._expected = None
        self._heard.clear()

    def begin_run(self) -> None:
        """Begin to count the damaged frames of a run."""
        self._damaged_before_n = self.link.counters["frames_dropped"]

    def next_seq(self) -> int:
        """Number for the next message to the device."""
        seq = self._seq
        self._seq = (seq + 1) % SEQS
        return seq

    def send(self, message: Message) -> float:
        """Send a message, and return the deadline of its answers on the clock [s]."""
        try:
            self.link.send([message])
        except LinkError as error:
            raise self._with_name(error) from error
        return self.clock() + self.timeout_s

    def receive(self, deadline_s: float) -> Message | None:
        """The next message of the device, or None at the deadline. Repeated messages are skipped.

        :raises LinkError: messages before it were lost, another node sends as the device, or the line failed.
        :raises TimeLimitReached: none came before the time limit of the run.
        """
        until_s = min(self.limit_s, deadline_s)
        while (left_s := until_s - self.clock()) >= 0.0:  # also ends if messages never cease
            try:
                message = self.link.receive(left_s)
            except LinkError as error:
                raise self._with_name(error) from error
            if message is None:
                break
            if self._expected is None or message.seq == self._expected:
                self._expected = (message.seq + 1) % SEQS
                self._heard[message.seq] = self._last = message
                return message
            if (self._expected - message.seq) % SEQS > LATEST:
                lost = (message.seq - self._expected) % SEQS
                damaged = self.link.counters["frames_dropped"] - self._damaged_before_n
                raise LinkError(
                    f"device {self.name}: {number_of(lost, 'message was', 'messages were')} lost"
                    f" between {self.last} and {brief(message)}, or"
                    f" another node sends as the device ({damaged} frames were damaged in this run)"
                )
            before = self._heard.get(message.seq)
            if before is not None and pack(before) != pack(message):
                raise LinkError(
                    f"device {self.name}: {brief(before)} and {brief(message)} have the same number, {message.seq}:"
                    " the device was reset, or two nodes send as this device"
                )
        if self.limit_s <= deadline_s:
            raise TimeLimitReached(f"device {self.name}: time limit reached ({self.context})")
        return None

    def ask(self, request: Message, kind: type[Answer]) -> Answer:
        """Send ``request`` and return its answer.

        :raises LinkTimeout: it did not come in time.
        """
        return self.answer(request, kind, self.send(request))

    def answer(
        self, request: Message, kind: type[Answer], deadline_s: float, *, after_anything: bool = False
    ) -> Answer:
        """The next answer to ``request``.

        :param after_anything: skip any other message, such as those of an earlier run. Otherwise only answers to
            repeated questions for the identity are skipped.
        :raises LinkTimeout: none came in time.
        :raises DeviceError: another message came first, which no request of now explains.
        """
        while True:
            message = self.receive(deadline_s)
            if message is None:
                raise LinkTimeout(
                    f"device {self.name}: no {kind.__name__} in answer to {type(request).__name__}"
                    f" within {self.timeout_s:g} s ({self.context})"
                )
            if isinstance(message, kind) and message.answers == request.seq:
                return message
            if not after_anything and not isinstance(message, Hello | Firmware):
                raise DeviceError(f"device {self.name}: {brief(message)} came too late")

    def _with_name(self, error: LinkError) -> LinkError:
        return type(error)(f"device {self.name}: {error}")
