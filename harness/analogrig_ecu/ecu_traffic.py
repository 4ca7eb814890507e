"""Findings on the whole traffic of an ECU: messages that never came, identifiers that resemble theirs, counters."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import can

from analogrig.devices.device import Causes
from analogrig.links.link import Identifier, identifier_text
from analogrig.wording import number_of
from analogrig_ecu.message_reader import MessageReader

_FIRST_DESTINED = 240
"""PDU format of J1939 from which on the next byte belongs to the parameter group, not to a destination."""

_TRANSPORT, _TRANSPORT_BYTES = 0xEC00, 8
"""Parameter group and length of the frames that announce a message in several frames; bytes 5 to 7 are its group."""

_OFTEN, _SELDOM = 0.9, 0.5
"""Shares of the samples from which on a message came with nearly all, and below which with few of them."""

_LEAST = 3
"""Occurrences of a pattern that are no chance."""

_JUMPING = 0.2
"""Jumps of a counter over its frames that no loss of a few explains."""

_MOST_OTHERS, _SHOWN_OTHERS = 1000, 4


@dataclass
class _Counted:
    """Counter of a message: its values so far."""

    modulus: int
    last: int | None = None
    n: int = 0
    has_moved: bool = False
    jumps: Counter[tuple[int, int]] = field(default_factory=Counter)
    distances: Counter[int] = field(default_factory=Counter)
    """Distances of an echoed counter from that of the sample."""


class EcuTraffic:
    """Tally of the frames of an ECU and of its harness."""

    def __init__(self, readers: Mapping[str, MessageReader], causes: Causes) -> None:
        """Take the readers of all messages in use."""
        self._readers, self._causes = readers, causes
        self._by_identifier = {reader.identifier: reader for reader in readers.values()}
        self._by_number = {reader.identifier[0]: reader for reader in readers.values()}
        self._by_group = {_group(reader.identifier): reader for reader in readers.values() if reader.identifier[1]}
        self._resembling: dict[str, str] = {}
        """Identifier that resembles that of a message, by message, with the difference."""
        self._transported: dict[str, bool] = {}
        """Messages that came in several frames of J1939's transport protocol."""
        self._others: Counter[Identifier] = Counter()
        self._came: Counter[str] = Counter()
        """Frames by message."""
        self._with_sample: Counter[str] = Counter()
        """Samples by message of their answer."""
        self._again: Counter[str] = Counter()
        """Frames after the answer by message."""
        self._counters: dict[str, _Counted] = {}
        self.samples_n = 0

    def take(self, frame: can.Message) -> MessageReader | None:
        """Reader of a frame in use; None for any other, which is tallied."""
        identifier = frame.arbitration_id, frame.is_extended_id
        reader = None if frame.is_error_frame else self._by_identifier.get(identifier)
        if reader is None:
            self._take_other(frame, identifier)
        elif frame.is_remote_frame:
            self._causes.add(f"{reader.title} came as a remote frame, which has no data")
            return None
        else:
            self._came[reader.message.name] += 1
        return reader

    def _take_other(self, frame: can.Message, identifier: Identifier) -> None:
        if frame.is_error_frame or frame.is_remote_frame:
            return
        if identifier in self._others or len(self._others) < _MOST_OTHERS:
            self._others[identifier] += 1
        if frame.is_extended_id and _group(identifier) == _TRANSPORT and len(frame.data) == _TRANSPORT_BYTES:
            group = _group((int.from_bytes(frame.data[5:8], "little") << 8, True))
            if (carried := self._by_group.get(group)) is not None:
                self._transported[carried.message.name] = True
        difference = f"is an identifier of {'29' if frame.is_extended_id else '11'} bits"
        if (reader := self._by_number.get(frame.arbitration_id)) is None and frame.is_extended_id:
            difference = "has another source address, destination or priority"
            reader = self._by_group.get(_group(identifier))
        if reader is not None:
            text = f"{identifier_text(identifier)} {difference}"
            self._resembling.setdefault(reader.message.name, text)
            self._causes.add(f"{text}, not that of {reader.title}")

    def answered(self, message: str) -> None:
        """Count a message as part of the answer to the current sample."""
        self._with_sample[message] += 1

    def came_again(self, message: str) -> None:
        """Count a message that came after the answer to which it belongs."""
        self._again[message] += 1
        text = f"{message} came {number_of(self._again[message], 'time')} more often than with each sample"
        self._causes.state(f"{message} again", text, loses=False)

    def count(self, name: str, value: int, modulus: int) -> None:
        """Take the value of a counter of ``modulus`` values in a frame."""
        counted = self._counters.setdefault(name, _Counted(modulus))
        before, counted.last = counted.last, value
        counted.n += 1
        if before is None or before == value:
            return
        counted.has_moved = True
        if (value - before) % modulus != 1 and len(counted.jumps) < _MOST_OTHERS:
            counted.jumps[before, value] += 1

    def echo(self, name: str, distance: int) -> None:
        """Take the distance of an echoed counter from that of the sample."""
        if len(distances := self._counters[name].distances) < _MOST_OTHERS or distance in distances:
            distances[distance] += 1

    # --------------------------------------------------------------------------------------------------------- findings

    def conclude(self, needed: Iterable[str], events: frozenset[str], alarms: str) -> None:
        """State the findings so far on the messages ``needed``, of which ``events`` need not come with a sample.

        :param alarms: message that carries the alarm.
        """
        for counter, counted in self._counters.items():
            self._conclude_counter(counter, counted)
        for name in needed:
            if texts := self.never_came([name]):
                self._causes.state(name, *texts, loses=name not in events)
            elif name not in events and name in self._with_sample:
                self._conclude_cycle(name, is_alarm=name == alarms)

    def never_came(self, needed: Iterable[str]) -> tuple[str, ...]:
        """Messages among ``needed`` that have not come so far, each in a sentence."""
        return tuple(
            f"no frame {self._readers[name].title} came{self._seen(name)}" for name in needed if not self._came[name]
        )

    def _seen(self, name: str) -> str:
        """Clause that names an identifier that resembles it, or else the commonest others; empty without one."""
        if text := self._resembling.get(name):
            return f", but {text}"
        if self._transported.get(name):
            return ", but messages of its parameter group in J1939's transport protocol, which are not assembled"
        if not self._others:
            return ""
        common = [f"{identifier_text(each)} ({n})" for each, n in self._others.most_common(_SHOWN_OTHERS)]
        more = ", ..." if len(self._others) > _SHOWN_OTHERS else ""
        return f"; other frames: {', '.join(common)}{more}"

    def _conclude_cycle(self, name: str, *, is_alarm: bool) -> None:
        """Name a message that did not come with each sample."""
        share = self._with_sample[name] / max(1, self.samples_n)
        if share >= _OFTEN or self.samples_n < _LEAST:
            return
        with_n = f"{name} came with {self._with_sample[name]} of {number_of(self.samples_n, 'sample')}"
        cycle_ms = self._readers[name].message.cycle_time
        cycle = f"; its cycle in the DBC is {cycle_ms} ms" if cycle_ms else ""
        others = [n for other, n in self._with_sample.items() if other != name]
        is_event = is_alarm and share < _SELDOM and others and max(others) >= _OFTEN * self.samples_n
        cure = f"; if it comes only with an alarm, name it in receive.events: events = [{name!r}]" if is_event else ""
        self._causes.state(f"{name} cycle", f"{with_n}{cycle}{cure}", loses=True)

    def _conclude_counter(self, name: str, counted: _Counted) -> None:
        if counted.n > _LEAST and not counted.has_moved:
            text = f"{name} is {counted.last} in all of {counted.n} frames: its sender does not count"
            self._causes.state(f"{name} still", text, loses=True)
        elif not counted.distances and counted.jumps.total() > _JUMPING * counted.n and self._wrap(counted) is None:
            (before, after), _ = counted.jumps.most_common(1)[0]
            text = f"{name} jumps {number_of(counted.jumps.total(), 'time')} in {counted.n} frames"
            text = f"{text}, such as from {before} to {after}: more than one sender, or frames out of order?"
            self._causes.state(f"{name} jumps", text, loses=True)
        elif (last := self._wrap(counted)) is not None:
            text = f"{name} wraps after {last}, in the DBC after {counted.modulus - 1}: state [0|{last}] there"
            self._causes.state(f"{name} wrap", text, loses=True)
        elif distances := {each: n for each, n in counted.distances.items() if each}:
            distance, n = max(distances.items(), key=lambda pair: pair[1])
            total = counted.distances.total()
            if n > _LEAST and n > _SELDOM * total:
                ahead = distance if distance <= counted.modulus // 2 else distance - counted.modulus
                where = f"{abs(ahead)} {'ahead of' if ahead > 0 else 'behind'} the counter of the sample"
                text = f"{name} is {where} in {n} of {total} frames"
                self._causes.state(f"{name} echo", text, loses=True)
            elif sum(distances.values()) > _SELDOM * total and total > _LEAST:
                text = f"{name} does not follow the counter of the sample: does the device count its own messages?"
                self._causes.state(f"{name} echo", f'{text} set counter_is = "own"', loses=True)

    @staticmethod
    def _wrap(counted: _Counted) -> int | None:
        """Last value of a counter that starts again before its end; None if it does not."""
        back = {before: n for (before, after), n in counted.jumps.items() if after == 0}
        if len(back) != 1 or sum(counted.jumps.values()) != sum(back.values()) or sum(back.values()) < 2:
            return None
        return next(iter(back))


def _group(identifier: Identifier) -> int:
    """Parameter group of J1939 in an identifier of 29 bits."""
    group = identifier[0] >> 8 & 0x3FFFF
    return group if group >> 8 & 0xFF >= _FIRST_DESTINED else group & 0x3FF00
