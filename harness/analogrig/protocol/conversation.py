"""Questions and answers over a link.

Both sides number their messages, so that a message which was lost or repeated on the way does not go unnoticed; and
each answer says which message it answers.
"""

from __future__ import annotations

import math
from typing import TypeVar

from analogrig.errors import DeviceError, LinkError, LinkTimeout, TimeLimitReached
from analogrig.links.link import Link
from analogrig.protocol.catalogue import SEQS, Configured, Controlled, Firmware, Hello, Message, Status, brief, pack
from analogrig.wording import number_of

LATEST = 32
"""A message is one that comes again, and not one after a loss, if its number is at most so far behind."""

Answer = TypeVar("Answer", Hello, Firmware, Controlled, Configured, Status)


class Conversation:
    """What the harness and one device say to each other. Errors lead with the device's name."""

    def __init__(self, link: Link, name: str, timeout_s: float) -> None:
        """Over ``link``, with the device ``name``; ``timeout_s`` is for all the answers to one message."""
        self.link = link
        self.name = name
        self.timeout_s = timeout_s
        self.clock = link.clock
        self.limit_s = math.inf
        """Time on the clock at which the time limit of the run is over."""
        self._seq = 0
        self._expected: int | None = None
        self._heard: dict[int, Message] = {}
        """The last message with each number."""
        self._last: Message | None = None
        self._damaged_before_n = 0
        """Frames, until the last run began."""

    @property
    def last(self) -> str:
        """The last message of the device, in a word or two."""
        return "none" if self._last is None else brief(self._last)

    @property
    def so_far(self) -> str:
        """What was heard last, and what the line itself has to say, to explain a silence."""
        trouble = self.link.trouble
        return f"last message: {self.last}{'; ' if trouble else ''}{trouble}"

    def begin(self) -> None:
        """Whatever number the device's next message has, it is the right one."""
        self._expected = None
        self._heard.clear()

    def begin_run(self) -> None:
        """What was damaged before does not explain what is lost from now on."""
        self._damaged_before_n = self.link.counters["frames_dropped"]

    def next_seq(self) -> int:
        """The number of the next message to the device."""
        seq = self._seq
        self._seq = (seq + 1) % SEQS
        return seq

    def send(self, message: Message) -> float:
        """Send, and return when the last of the answers is due, on the clock."""
        try:
            self.link.send([message])
        except LinkError as error:
            raise self._named(error) from error
        return self.clock() + self.timeout_s

    def receive(self, deadline_s: float) -> Message | None:
        """The next message of the device, or None if none comes in time. One that comes again is passed over.

        :raises LinkError: messages before it were lost, somebody else speaks as the device, or the line failed.
        :raises TimeLimitReached: none came before the time limit of the run.
        """
        until_s = min(self.limit_s, deadline_s)
        while (left_s := until_s - self.clock()) >= 0.0:  # also when messages never cease
            try:
                message = self.link.receive(left_s)
            except LinkError as error:
                raise self._named(error) from error
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
                    f" somebody else speaks as the device ({damaged} frames were damaged in this run)"
                )
            before = self._heard.get(message.seq)
            if before is not None and pack(before) != pack(message):
                raise LinkError(
                    f"device {self.name}: {brief(before)} and {brief(message)} have the same number, {message.seq}:"
                    " it was reset, or two speak as this device"
                )
        if self.limit_s <= deadline_s:
            raise TimeLimitReached(f"device {self.name}: time limit reached ({self.so_far})")
        return None

    def ask(self, request: Message, kind: type[Answer]) -> Answer:
        """Send ``request`` and return its answer.

        :raises LinkTimeout: none came in time.
        """
        return self.answer(request, kind, self.send(request))

    def answer(
        self, request: Message, kind: type[Answer], deadline_s: float, *, after_anything: bool = False
    ) -> Answer:
        """The next answer to ``request``. It may come ``after_anything`` that an earlier run has left in the line, or
        else after nothing but answers to those who asked for the identity several times.

        :raises LinkTimeout: none came in time.
        :raises DeviceError: something else came first: the device has obeyed what it was not told now.
        """
        while True:
            message = self.receive(deadline_s)
            if message is None:
                raise LinkTimeout(
                    f"device {self.name}: no {kind.__name__} in answer to {type(request).__name__}"
                    f" within {self.timeout_s:g} s ({self.so_far})"
                )
            if isinstance(message, kind) and message.answers == request.seq:
                return message
            if not after_anything and not isinstance(message, Hello | Firmware):
                raise DeviceError(f"device {self.name}: {brief(message)} came too late")

    def _named(self, error: LinkError) -> LinkError:
        return type(error)(f"device {self.name}: {error}")
