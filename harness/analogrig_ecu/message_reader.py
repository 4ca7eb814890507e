"""Readers of the frames of one message: cantools decodes them, and what does not fit the DBC is named.

Frames are accepted as cantools accepts them: longer ones, and shorter ones as far as they go.
"""

from __future__ import annotations

import math
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import can

from analogrig.devices.device import Causes
from analogrig.links.link import Identifier, identifier_text
from analogrig.wording import number_of
from analogrig_ecu.ecu_checksum import FrameChecksum
from analogrig_ecu.readings import layout_of, misreading

_ABSENT = re.compile(
    r"sna|n/?a|nan|(signal|data|value)?[\s_]*(is[\s_]*)?(not|un)[\s_]*(avail|defined|valid|known)\w*|invalid\w*"
    r"|no[\s_]*(data|value|signal)",
    re.IGNORECASE,
)
"""Names of values in VAL_ that stand for no value."""

_SHOWN = 4
"""Values of a multiplexer that a sentence lists."""

_MOST_KEPT = 4096
"""Frames of a message that are kept for a comparison of readings."""


class Reading(NamedTuple):
    """Signals of one frame."""

    values: Mapping[str, float]
    """Physical values by signal, of those in use that the frame holds."""
    absent: frozenset[str]
    """Signals whose value stands for none: a name in VAL_, or all bits set beyond the range of the DBC."""


def frame_bytes(n: int) -> int:
    """Length of the shortest frame that holds ``n`` bytes."""
    return int(can.util.dlc2len(can.util.len2dlc(n)))


class MessageReader:
    """Reader of the frames of one message."""

    def __init__(self, message: Any, causes: Causes) -> None:
        self.message, self._causes = message, causes
        self.identifier: Identifier = (message.frame_id, message.is_extended_frame)
        self.title = f"{message.name} ({identifier_text(self.identifier)})"
        self.checksum: FrameChecksum | None = None
        """Checksum of the message, if its frames have one."""
        self._kept: dict[str, list[bytes]] = {}
        """Data of the first frames with each signal whose course is compared with other readings."""
        self._flags: dict[str, Counter[bool]] = {}
        """Frames in which each flag is set (True) and not."""
        self._pages: dict[str, set[int]] = defaultdict(set)
        """Values of each multiplexer so far."""
        self._signals: dict[str, Any] = {}
        self._multiplexers: set[str] = set()
        self._states_fd = "VFrameFormat" in (message.dbc.attributes if message.dbc else {})

    def is_of(self, frame: can.Message) -> bool:
        """True if a frame has the identifier of this message."""
        return (frame.arbitration_id, frame.is_extended_id) == self.identifier

    def use(self, names: Iterable[str]) -> None:
        """Read these signals as well."""
        self._signals |= {name: self.message.get_signal_by_name(name) for name in names}
        self._multiplexers = {name for each in self._signals.values() if (name := each.multiplexer_signal) is not None}

    def watch(self, name: str) -> None:
        """Keep frames with a signal, whose course is compared with other readings."""
        self._kept.setdefault(name, [])

    def watch_flag(self, name: str) -> None:
        """Count the frames in which a flag is set."""
        self._flags.setdefault(name, Counter())

    def flags(self) -> Iterator[tuple[str, int, int]]:
        """Each watched flag as ``Message.Signal``, with the frames in which it is set, and with all."""
        for name, counts in self._flags.items():
            yield f"{self.message.name}.{name}", counts[True], counts.total()

    def pages_that_never_came(self) -> Iterator[tuple[str, str]]:
        """Signals in use that no multiplexer selected, each with a sentence."""
        for name, signal in self._signals.items():
            seen, ids = self._pages.get(signal.multiplexer_signal), signal.multiplexer_ids
            if seen and ids is not None and not seen & set(ids):
                full, needs = f"{self.message.name}.{name}", " or ".join(map(str, ids[:_SHOWN]))
                values = ", ".join(map(str, sorted(seen)[:_SHOWN]))
                mux = f"{self.message.name}.{signal.multiplexer_signal}"
                yield full, f"{full} never came: it needs {mux} = {needs}, which was {values}"

    def misreadings(self) -> Iterator[tuple[str, str]]:
        """Watched signals that another byte order, sign or type fits far better, each with a sentence."""
        for name, kept in self._kept.items():
            signal, full = self._signals[name], f"{self.message.name}.{name}"
            if text := misreading(kept, layout_of(signal), float(signal.scale)):
                yield full, f"{full} looks misread: {text} (in {number_of(len(kept), 'frame')} from the first on)"

    def read(self, frame: can.Message) -> Reading | None:
        """Signals of a frame; None if it cannot be used, for a cause that is counted."""
        data = bytes(frame.data)
        try:
            raw = self.message.decode_simple(data, decode_choices=False, scaling=False, allow_truncated=True)
        except Exception as error:  # noqa: BLE001 - the exceptions of cantools and bitstruct have no common base
            self._causes.add(f"{self.title}: {' '.join(str(error).split())}, by the DBC", loses=True)
            return None
        if self.checksum is not None:
            right, told = self.checksum.value(data[: self.message.length], raw), raw.get(self.checksum.name, "none")
            if told != right:
                detail = f"{told} instead of {right} in {data.hex()}"
                self._causes.add(f"{self.title} has a wrong checksum {self.checksum.name}", detail=detail, loses=True)
                return None
        self._note_form(frame, raw)
        self._tally(data, raw)
        values, absent = {}, set()
        for name, signal in self._signals.items():
            if name in raw:
                values[name] = float(signal.conversion.raw_to_scaled(raw[name], decode_choices=False))
                if self._is_absent(signal, raw[name], values[name]):
                    absent.add(name)
        return Reading(values, frozenset(absent))

    def _tally(self, data: bytes, raw: Mapping[str, Any]) -> None:
        """Keep what the findings on all frames need."""
        for name in self._multiplexers:
            if name in raw:
                self._pages[name].add(int(raw[name]))
        for name, kept in self._kept.items():
            if name in raw and len(data) >= self.message.length and len(kept) < _MOST_KEPT:
                kept.append(data[: self.message.length])
        for name, counts in self._flags.items():
            if name in raw:
                counts[bool(raw[name])] += 1

    def _note_form(self, frame: can.Message, raw: Mapping[str, Any]) -> None:
        """Name a length, or a kind of frame, other than that of the DBC."""
        n, length = len(frame.data), self.message.length
        if n > frame_bytes(length):
            self._note_length(n, "the rest is ignored", loses=False)
        elif n < length:
            missing = []
            for name in self._signals.keys() - raw.keys():  # unless its multiplexer does not select it
                ids, selector = self._signals[name].multiplexer_ids, self._signals[name].multiplexer_signal
                if ids is None or raw.get(selector) in ids:
                    missing.append(name)
            missing.sort(key=list(self._signals).index)
            consequence = f"without {', '.join(missing)}" if missing else "the signals in use are complete"
            self._note_length(n, consequence, loses=bool(missing))
        if self._states_fd and frame.is_fd != self.message.is_fd:
            kinds = ("a classic frame", "a frame of CAN FD")
            self._causes.add(f"{self.title} is {kinds[frame.is_fd]}, the DBC says {kinds[self.message.is_fd]}")

    def _note_length(self, n: int, consequence: str, *, loses: bool) -> None:
        bytes_n = number_of(n, "byte")
        self._causes.add(f"{self.title} has {bytes_n}, the DBC says {self.message.length}: {consequence}", loses=loses)

    def _is_absent(self, signal: Any, raw: float, value: float) -> bool:
        """True if a value stands for none; counts it, and any other outside the range of the DBC."""
        is_outside = is_beyond(signal, value)
        if not is_outside and not signal.choices:
            return False
        what = f"{self.message.name}.{signal.name}"
        name = str((signal.choices or {}).get(raw, ""))
        is_signed = signal.is_signed
        marker = -(1 << signal.length - 1) if is_signed else (1 << signal.length) - 1
        if _ABSENT.fullmatch(name.strip()) or (is_outside and not signal.is_float and raw == marker):
            self._causes.add(f"{what} is {name or 'not available'} (raw {raw}): no value")
            return True
        if is_outside:
            text = f"{what} lies outside [{signal.minimum:g}|{signal.maximum:g}] of the DBC"
            self._causes.add(text, detail=f"{value:g}")
        return False


def is_beyond(signal: Any, value: float) -> bool:
    """True if a value lies outside the range that the DBC states, if it states one."""
    if signal.minimum is None or signal.maximum is None or not math.isfinite(value):
        return False
    slack = 0.5 * abs(signal.scale) if not signal.is_float else 1e-6 * max(abs(signal.minimum), abs(signal.maximum))
    return not float(signal.minimum) - slack <= value <= float(signal.maximum) + slack
