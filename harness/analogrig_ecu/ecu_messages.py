"""Messages of an ECU: samples to frames, and frames to answers, by its device file and its DBC.

cantools encodes and decodes. Every name and every range is checked once, when the device file is read.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import can

from analogrig import ConfigurationError
from analogrig.answers import LARGEST_FLOAT32
from analogrig.config import suggest
from analogrig.devices.device import Causes
from analogrig.links.dbc import check_layout, load_dbc
from analogrig.links.link import Identifier
from analogrig.run import Channel
from analogrig_ecu.dbc_description import DbcDescription, Request, scale
from analogrig_ecu.ecu_checksum import COUNTED_TO_14, ChecksumSpec, FrameChecksum
from analogrig_ecu.ecu_traffic import EcuTraffic
from analogrig_ecu.message_reader import MessageReader, frame_bytes

CLASSIC_BYTES = 8
FD_BYTES = 64

_LARGEST_FLOAT = {16: 65504.0, 32: LARGEST_FLOAT32, 64: math.inf}
"""Largest finite value of a float signal by its length in bits."""

_INPUTS = ("u", "y")

_LEAST_FLAGS, _RESTLESS = 16, 0.8
"""Frames from which on a flag is judged, and the share of them in which none that is right is away from rest."""


class Answer(NamedTuple):
    """Part of the device's answer to a sample: one frame."""

    message: str
    values: Mapping[str, float]
    """Values of the signals that [receive] names, as ``Message.Signal``."""
    counter: int | None
    """Value of its counter; None if [receive] names none in this message."""
    absent: frozenset[str] = frozenset()
    """Signals among ``values`` whose value stands for none."""


class SamplePart(NamedTuple):
    """Part of a sample as sent: one frame."""

    message: str
    values: Mapping[str, float]
    """Physical values by key of [send]: u, y."""
    is_missing: bool
    """True if the frame carries a missing sample, or no number."""
    counter: int | None
    """Value of its counter, if it has one."""


class _Found(NamedTuple):
    """Signal of the DBC."""

    message: Any
    signal: Any
    name: str
    """``Message.Signal``."""


class EcuMessages:
    """Messages that a device file names, as the DBC defines them."""

    def __init__(self, description: DbcDescription) -> None:
        """Find and check all messages.

        :raises ConfigurationError: names file, table and key.
        """
        self._description = description
        self._path = Path(description.dbc)
        self._database = load_dbc(self._path)
        self.causes = Causes()
        """Causes of frames that are not used."""
        self._flags: dict[str, str] = {}
        """Key of each flag: alarm, armed, valid."""
        self._readers: dict[str, MessageReader] = {}
        """Readers of the messages in use by name."""
        self.events = frozenset(description.receive.events)
        """Messages that come only with something to report."""
        self._find_sent()
        self._find_received()
        self._count_moduli()
        self.start = self._request("start", description.start)
        self.reset = self._request("reset", description.reset)
        names: dict[Identifier, str] = {}
        for name, reader in self._readers.items():
            if (other := names.setdefault(reader.identifier, name)) != name:
                raise self._error("dbc", f"messages {other} and {name} have the same identifier")
        if both := self.own & self.of_device:
            raise self._error("receive", f"message {names[min(both)]} is sent to the device as well")
        self.traffic = EcuTraffic(self._readers, self.causes)

    # ------------------------------------------------------------------------------------------------------ identifiers

    @property
    def own(self) -> frozenset[Identifier]:
        """Identifiers of the harness's frames."""
        requests = [request.message for request in (self.start, self.reset) if request]
        return frozenset(self._readers[name].identifier for name in (*self.order, *requests))

    @property
    def of_device(self) -> frozenset[Identifier]:
        """Identifiers of the device's frames."""
        answers = [request.answer for request in (self.start, self.reset) if request and request.answer]
        return frozenset(self._readers[name].identifier for name in (*self._answers, *answers))

    # ------------------------------------------------------------------------------------------------------- to the bus

    def encoder(
        self, channels: Mapping[str, Channel] | None = None
    ) -> Callable[[int, int, int, bool], list[can.Message]]:
        """Function that returns the frames of a sample, from its index, its codes of u and y, and valid.

        :param channels: channels of the rig; None: units that depend on them are not checked.
        :raises ConfigurationError: a code does not fit its signal.
        """
        tables: dict[str, Sequence[float]] = {}
        for key in _INPUTS:
            channel = None if channels is None else channels[key]
            codes = range(self._description.send.codes if channel is None else channel.codes)
            factor, offset = self._check_range(key, channel) or (0.0, 0.0)
            signal = self._carriers[key].signal
            tables[key] = [_to_raw(signal, code * factor + offset) for code in codes] if factor else ()
        u_of, y_of = tables["u"], tables["y"]
        parts = [self._encode_part(self._readers[name].message) for name in self.order]

        def encode(index: int, u: int, y: int, valid: bool) -> list[can.Message]:  # noqa: FBT001
            given = {"u": u_of[u], "y": y_of[y], "valid": int(valid)}
            return [part(index, given) for part in parts]

        return encode

    def _encode_part(self, message: Any) -> Callable[[int, Mapping[str, float]], can.Message]:
        """Function that returns the frame of one message of a sample."""
        fixed = self._fixed[message.name]
        keys = [(found.signal.name, key) for key, found in self._carriers.items() if found.message is message]
        counter = self._send_counters.get(message.name)
        modulus = 1 if counter is None else self._modulus(counter)
        name = "" if counter is None else counter.signal.name
        checksum = self._readers[message.name].checksum

        def encode(index: int, given: Mapping[str, float]) -> can.Message:
            values = fixed.copy()
            for signal, key in keys:
                values[signal] = given[key]
            if name:
                values[name] = index % modulus
            if checksum is not None:
                values[checksum.name] = 0
                data = message.encode(values, scaling=False, strict=False)
                values[checksum.name] = checksum.value(data, values)
            return self._frame(message, values)

        return encode

    def _frame(self, message: Any, raw: Mapping[str, float]) -> can.Message:
        data = message.encode(raw, scaling=False, strict=False)
        is_fd = message.is_fd or len(data) > CLASSIC_BYTES
        return can.Message(
            arbitration_id=message.frame_id,
            is_extended_id=message.is_extended_frame,
            data=data if len(data) <= CLASSIC_BYTES else data.ljust(frame_bytes(len(data)), b"\0"),
            is_fd=is_fd,
            bitrate_switch=is_fd and self._description.data_bitrate is not None,
            is_rx=False,
        )

    def request(self, request: Request) -> can.Message:
        """Frame of [start] or [reset]."""
        return self._frame(self._readers[request.message].message, self._fixed[request.message])

    def is_answer(self, request: Request, frame: can.Message) -> bool:
        """True if the frame is the answer to [start] or [reset]."""
        reader = self._readers[request.answer]
        return reader.is_of(frame) and self._has(reader, request.answered, frame)

    def is_start(self, frame: can.Message) -> bool:
        """True if the frame is that of [start], whatever its length and its other signals."""
        if self.start is None or not (reader := self._readers[self.start.message]).is_of(frame):
            return False
        is_start = self._has(reader, self.start.signals, frame)
        if not is_start:
            self.causes.add(f"{reader.title} has other values than [start]")
        return is_start

    @staticmethod
    def _has(reader: MessageReader, wanted: Mapping[str, float], frame: can.Message) -> bool:
        """True if a frame has these values."""
        found = reader.read(frame)
        return found is not None and all(found.values.get(signal) == value for signal, value in wanted.items())

    # ----------------------------------------------------------------------------------------------------- from the bus

    def answer(self, frame: can.Message) -> Answer | None:
        """Answer in a frame of the device; None if it cannot be used, or is none of [receive]."""
        reader = self._by_identifier.get((frame.arbitration_id, frame.is_extended_id))
        found = None if reader is None else reader.read(frame)
        if reader is None or found is None:
            return None
        name = reader.message.name
        full = self._answers[name]
        values = {full[signal]: value for signal, value in found.values.items() if signal in full}
        counter = self._receive_counters.get(name)
        count = None if counter is None else found.values.get(counter.signal.name)
        if (full and not values) or (counter is not None and count is None):
            return None
        if counter is not None and count is not None:
            self.traffic.count(counter.name, int(count), self.count_moduli[name])
        absent = frozenset(full[signal] for signal in found.absent if signal in full)
        return Answer(name, values, None if count is None else int(count), absent)

    def is_of_answer(self, frame: can.Message) -> bool:
        """True if the frame has the identifier of a message of [receive]."""
        return (frame.arbitration_id, frame.is_extended_id) in self._by_identifier

    def is_of_sample(self, frame: can.Message) -> bool:
        """True if the frame has the identifier of a message of [send]."""
        return any(self._readers[name].is_of(frame) for name in self.order)

    def sample_part(self, frame: can.Message) -> SamplePart | None:
        """Part of a sample in a captured frame of the harness; None if it cannot be used, or is none of [send]."""
        reader = next((self._readers[name] for name in self.order if self._readers[name].is_of(frame)), None)
        found = None if reader is None else reader.read(frame)
        if reader is None or found is None:
            return None
        name = reader.message.name
        carried = {key: each for key, each in self._carriers.items() if each.message.name == name}
        counter = self._send_counters.get(name)
        if gone := [each.name for each in carried.values() if each.signal.name not in found.values]:
            self.causes.add(f"a frame {name} has no {', '.join(gone)}", detail=bytes(frame.data).hex())
            return None
        count = None if counter is None else found.values.get(counter.signal.name)
        if counter is not None and count is None:
            return None
        values = {key: found.values[each.signal.name] for key, each in carried.items()}
        is_missing = values.pop("valid", 1.0) == 0.0
        for key, each in carried.items():
            if each.signal.name in found.absent or not math.isfinite(found.values[each.signal.name]):
                if not is_missing and key != "valid":
                    self.causes.add(f"{each.name} is no number: a missing sample")
                is_missing = True
                values[key] = 0.0
        if counter is not None and count is not None:
            self.traffic.count(counter.name, int(count), self._modulus(counter))
        return SamplePart(name, values, is_missing, None if count is None else int(count))

    def decoder(self, channels: Mapping[str, Channel]) -> Callable[[Mapping[str, float], str], tuple[int, int] | None]:
        """Function that returns the codes of u and y from the values of all parts; None outside the range.

        A value outside the range is counted as a cause, unless its place is empty.

        It is the inverse of ``encoder``, as far as the signals have a step for each code.
        """
        known = {key: scale(getattr(self._description.send.units, key), channels[key]) for key in _INPUTS}
        scales = {key: factors for key, factors in known.items() if factors is not None}
        most = {key: channels[key].codes for key in _INPUTS}

        def decode(values: Mapping[str, float], place: str) -> tuple[int, int] | None:
            codes = {key: round((values[key] - offset) / factor) for key, (factor, offset) in scales.items()}
            for key, code in codes.items():
                if not 0 <= code < most[key] and not place:
                    return None
                if not 0 <= code < most[key]:
                    text = f"{self._carriers[key].name} is beyond the range of the rig, codes 0 to {most[key] - 1}"
                    detail = f"{values[key]:g} is code {code}"
                    self.causes.add(text, noun="sample", place=place, detail=detail, loses=True)
                    return None
            return codes["u"], codes["y"]

        return decode

    # ------------------------------------------------------------------------------------------------------------- send

    def _find_sent(self) -> None:
        sent = self._description.send
        self._carriers = {key: self._signal(f"send.{key}", getattr(sent, key)) for key in _INPUTS}
        if sent.valid:
            self._carriers["valid"] = self._signal("send.valid", sent.valid)
            self._watch_flag("valid", sent.valid)
        self._send_counters = self._counters("send.counter", sent.counter)
        constants = [self._signal(f"send.constant.{name}", name) for name in sent.constant]
        carriers = (*self._carriers.values(), *self._send_counters.values())
        self._set_checksums(
            "send.checksum", sent.checksum, self._send_counters, {found.message.name for found in carriers}
        )
        used = {found.name for found in carriers} | set(sent.checksum)
        if len(used) < len(carriers) + len(sent.checksum):
            raise self._error("send", "one signal carries two quantities")
        if twice := used & set(sent.constant):
            raise self._error("send.constant", f"{min(twice)} carries a quantity of the sample")
        named = [found.message.name for found in (*carriers, *constants)]
        self.order = sent.order or tuple(dict.fromkeys(named))
        if sorted(self.order) != sorted(set(named)):
            raise self._error("send.order", f"must name each of {', '.join(dict.fromkeys(named))} once")
        self._fixed: dict[str, dict[str, float]] = {}
        for name in self.order:
            self._fixed[name] = self._start_values(
                f"send.{'constant' if constants else 'order'}",
                self._readers[name].message,
                {found.signal.name: sent.constant[found.name] for found in constants if found.message.name == name},
                [found.signal for found in carriers if found.message.name == name],
            )
        self.carriers = {key: self._carriers[key].name for key in _INPUTS}
        """Signals that carry u and y, as ``Message.Signal``."""
        for key in _INPUTS:
            self._check_range(key, None)
            self._readers[self._carriers[key].message.name].watch(self._carriers[key].signal.name)
        for found in carriers:
            self._readers[found.message.name].use([found.signal.name])

    def _watch_flag(self, key: str, name: str) -> None:
        """Count the frames in which a flag is set."""
        self._flags[name] = key
        message, _, signal = name.rpartition(".")
        self._readers[message].watch_flag(signal)

    def _start_values(
        self, where: str, message: Any, constant: Mapping[str, float], carriers: Sequence[Any]
    ) -> dict[str, float]:
        """Raw values of all signals of a message, before those of a sample.

        :raises ConfigurationError: a value does not fit, or a multiplexer does not select a signal in use.
        """
        values: dict[str, float] = {}
        for signal in message.signals:
            start = signal.raw_initial or 0
            if not math.isfinite(start):
                raise self._error(where, f"the initial value of {message.name}.{signal.name} is {start}")
            values[signal.name] = float(start) if signal.is_float else int(start)
        for name, value in constant.items():
            values[name] = self._raw(where, f"{message.name}.{name}", message.get_signal_by_name(name), value)
        for signal in (*carriers, *(message.get_signal_by_name(name) for name in constant)):
            selector = signal.multiplexer_signal
            if signal.multiplexer_ids is not None and values.get(selector) not in signal.multiplexer_ids:
                ids = ", ".join(map(str, signal.multiplexer_ids[:8]))
                raise self._error(
                    where, f"{message.name}.{signal.name} is not in the frame unless {message.name}.{selector} is {ids}"
                )
            if signal.is_multiplexer and signal in carriers:
                raise self._error("send", f"{message.name}.{signal.name} is a multiplexer and must be constant")
        try:
            message.encode(values, scaling=False, strict=False)
        except Exception as error:  # the exceptions of cantools and bitstruct have no common base
            raise self._error(where, f"message {message.name} cannot be encoded: {error}") from error
        return values

    def _check_range(self, key: str, channel: Channel | None) -> tuple[float, float] | None:
        """Scale and offset of the value of a code; None if they depend on a channel that is not known.

        :raises ConfigurationError: a value does not fit.
        """
        found = self._carriers[key]
        codes = self._description.send.codes if channel is None else channel.codes
        factors = scale(getattr(self._description.send.units, key), channel)
        if factors is None:
            return None
        factor, offset = factors
        if factor == 0.0:
            raise self._error(f"send.units.{key}", "the scale is 0")
        for code in (0, codes - 1):
            try:
                self._raw(f"send.{key}", f"{found.name}: code {code}", found.signal, code * factor + offset)
            except ConfigurationError as error:
                cure = f"set send.units.{key}, or correct scale and range of {found.name} in the DBC"
                raise ConfigurationError(f"{error}: {cure}") from error
        return factors

    # ---------------------------------------------------------------------------------------------------------- receive

    def _find_received(self) -> None:
        received = self._description.receive
        self._answers: dict[str, dict[str, str]] = {}
        """Signals of each message of an answer: their names in the message, and with it."""
        self.quantities: list[tuple[str, str]] = []
        """Key and ``Message.Signal`` of each quantity."""
        for key, name in received.quantities():
            found = self._signal(f"receive.{key}", name)
            if found.name in (full for _, full in self.quantities):
                raise self._error(f"receive.{key}", f"{name} carries two quantities")
            self._answers.setdefault(found.message.name, {})[found.signal.name] = found.name
            self.quantities.append((key, found.name))
        if not self.quantities:
            raise self._error("receive", "no signal is named: name alarm, theta, or both")
        self._check_events()
        self.alarm_states = self._states(received.alarm)
        if received.complete:
            self._answers.setdefault(self._message("receive.complete", received.complete).name, {})
        self._receive_counters = self._counters("receive.counter", received.counter)
        self._set_checksums("receive.checksum", received.checksum, self._receive_counters, self._answers)
        for name in self._receive_counters:
            if name not in self._answers:
                raise self._error("receive.counter", f"message {name} carries nothing else of an answer")
        if received.counter and received.counter_is == "echo" and not self._send_counters:
            raise self._error("receive.counter", "an echo needs send.counter; or set counter_is = 'own'")
        self._read_answers()

    def _read_answers(self) -> None:
        """Read the signals of the answers in their frames."""
        self._by_identifier = {self._readers[name].identifier: self._readers[name] for name in self._answers}
        for name, signals in self._answers.items():
            self._readers[name].use(signals)
        for key, name in self.quantities:
            message, _, signal = name.rpartition(".")
            if key in {"alarm", "armed"}:
                self._watch_flag(key, name)
            else:
                self._readers[message].watch(signal)
        for name, counter in self._receive_counters.items():
            self._readers[name].use([counter.signal.name])

    def _check_events(self) -> None:
        """:raises ConfigurationError: an event carries more than the alarm, or no other message answers a sample."""
        received = self._description.receive
        for name in received.events:
            carried = set(self._answers.get(self._message("receive.events", name).name, {}).values())
            if carried != {received.alarm}:
                raise self._error("receive.events", f"message {name} must carry alarm, and no other quantity")
        if not received.complete and self.events >= set(self._answers):
            cure = "name a signal of one that comes with each sample, or complete"
            raise self._error("receive.events", f"no other message shows that a sample was taken: {cure}")

    def _states(self, alarm: str) -> frozenset[float] | None:
        """Values that stand for an alarm; None if every nonzero one does.

        :raises ConfigurationError: the DBC names no such value.
        """
        if not alarm or not self._description.states:
            return None
        signal = self._signal("receive.alarm", alarm).signal
        scaled = {
            str(name): signal.conversion.raw_to_scaled(value, decode_choices=False)
            for value, name in (signal.choices or {}).items()
        }
        names = {name: float(value) for name, value in scaled.items()}
        for state in self._description.states:
            if isinstance(state, str) and state not in names:
                raise self._error("receive.alarm_is", f"{alarm} has no value {state!r}{suggest(state, names)}")
        return frozenset(names[state] if isinstance(state, str) else float(state) for state in self._description.states)

    def _count_moduli(self) -> None:
        """Find out how far each counter counts."""
        received = self._description.receive
        self.counter_names = {name: found.name for name, found in self._receive_counters.items()}
        """Counter of each message of an answer that has one, as ``Message.Signal``."""
        self.sent_counters = {name: found.name for name, found in self._send_counters.items()}
        """Counter of each message of a sample that has one, as ``Message.Signal``."""
        self.sent_moduli = {name: self._modulus(found) for name, found in self._send_counters.items()}
        """Modulus of the counter of each message of a sample that has one."""
        sent = set(self.sent_moduli.values())
        self.sample_modulus = max(sent, default=None)
        """Largest modulus of a counter of the sample; None without one."""
        moduli = {name: self._modulus(found) for name, found in self._receive_counters.items()}
        is_bounded = received.counter_is == "echo" and self.sample_modulus is not None
        self.count_moduli = {name: min(n, self.sample_modulus or n) if is_bounded else n for name, n in moduli.items()}
        """Modulus of the counter of each message of an answer that has one; an echo has no more than the sample's."""
        self.echo_moduli = {name: n if n in sent else max(sent, default=1) for name, n in self.count_moduli.items()}
        """Modulus of the sample's counter that each counter of an answer echoes: the same, or else the largest."""
        self.is_each_answer_counted = set(self._receive_counters) >= set(self._answers) - self.events
        """True if each message of an answer has a counter."""

    def conclude(self, *, in_log: bool) -> None:
        """State the findings on the frames so far; ``in_log`` if they include those of the harness."""
        needed = (*self.order, *self._answers) if in_log else tuple(self._answers)
        self.traffic.conclude(needed, self.events, self._description.receive.alarm.rpartition(".")[0])
        if in_log and self.start is not None and (texts := self.traffic.never_came([self.start.message])):
            self.causes.state("start", f"{texts[0]}, with which [start] begins a run", loses=False)
        for reader in self._readers.values():
            for name, text in reader.misreadings():
                self.causes.state(f"{name} reading", text, loses=False)
            for name, text in reader.pages_that_never_came():
                self.causes.state(f"{name} page", text, loses=True)
            for name, n, total in reader.flags():
                self._conclude_flag(name, n, total)

    def _conclude_flag(self, name: str, n: int, total: int) -> None:
        """Name a flag that is hardly ever at rest."""
        key = self._flags[name]
        if total < _LEAST_FLAGS or (n if key == "alarm" else total - n) <= _RESTLESS * total:
            return
        texts = {
            "alarm": f"{name} is not 0 in {n} of {total} frames: is it inverted, or a state (receive.alarm_is)?",
            "armed": f"{name} is 0 in {total - n} of {total} frames: is it inverted?",
            "valid": f"{name} is 0 in {total - n} of {total} frames, which are missing samples: is it inverted?",
        }
        self.causes.state(f"{name} flag", texts[key], loses=key == "valid")

    @property
    def never_came(self) -> tuple[str, ...]:
        """Messages of [receive] that never came, each in a sentence; events need not come."""
        return self.traffic.never_came(name for name in self._answers if name not in self.events)

    # --------------------------------------------------------------------------------------------------------- requests

    def _request(self, table: str, request: Request | None) -> Request | None:
        if request is None:
            return None
        message = self._message(f"{table}.message", request.message)
        for name in request.signals:
            self._signal_of(f"{table}.signals", message, name)
        if message.name in self._fixed:
            raise self._error(f"{table}.message", f"message {message.name} is used twice")
        self._fixed[message.name] = self._start_values(f"{table}.signals", message, request.signals, ())
        self._readers[message.name].use(request.signals)
        if request.answered and not request.answer:
            raise self._error(f"{table}.answered", "no answer is named")
        if request.answer:
            answer = self._message(f"{table}.answer", request.answer)
            for name in request.answered:
                self._signal_of(f"{table}.answered", answer, name)
            self._readers[answer.name].use(request.answered)
        return request

    # ------------------------------------------------------------------------------------------------------------ names

    def _error(self, where: str, problem: str) -> ConfigurationError:
        table, _, key = where.partition(".")
        return ConfigurationError(f"[{table}] {key}: {problem}" if key else f"{table}: {problem}")

    def _message(self, where: str, name: str) -> Any:
        """Message of that name, whose layout is checked.

        :raises ConfigurationError: there is none, or it cannot be used.
        """
        if name in self._readers:
            return self._readers[name].message
        message = next((each for each in self._database.messages if each.name == name), None)
        if message is None:
            known = [each.name for each in self._database.messages]
            raise self._error(where, f"{self._path} has no message {name!r}{suggest(name, known)}")
        most = FD_BYTES if self._description.fd else CLASSIC_BYTES
        if message.length > most:
            cure = "" if self._description.fd or message.length > FD_BYTES else ": set fd = true"
            raise self._error(where, f"message {name} has {message.length} bytes, a frame at most {most}{cure}")
        if message.is_fd and not self._description.fd:
            raise self._error(where, f"message {name} is one of CAN FD: set fd = true")
        try:
            check_layout(message)
        except ValueError as error:
            raise self._error(where, f"{self._path}: {error}") from error
        self._readers[name] = MessageReader(message, self.causes)
        return message

    def _signal(self, where: str, name: str) -> _Found:
        """Signal ``Message.Signal``; errors as ``_message``."""
        message_name, dot, signal_name = name.rpartition(".")
        if not dot:
            raise self._error(where, f"must be Message.Signal, not {name!r}")
        message = self._message(where, message_name)
        return _Found(message, self._signal_of(where, message, signal_name), name)

    def _whole(self, where: str, name: str) -> _Found:
        """Signal that is an unsigned number, unscaled; errors as ``_message``."""
        found = self._signal(where, name)
        signal = found.signal
        if signal.is_float or signal.is_signed or (signal.scale, signal.offset) != (1, 0):
            raise self._error(where, f"{name} is not an unsigned number with the scale 1 and the offset 0")
        return found

    def _signal_of(self, where: str, message: Any, name: str) -> Any:
        signal = next((each for each in message.signals if each.name == name), None)
        if signal is None:
            known = [each.name for each in message.signals]
            raise self._error(where, f"message {message.name} has no signal {name!r}{suggest(name, known)}")
        if signal.scale == 0:
            raise self._error(where, f"{message.name}.{name} has the scale 0 in the DBC")
        return signal

    def _set_checksums(
        self, where: str, specs: Mapping[str, ChecksumSpec], counters: Mapping[str, _Found], used: Collection[str]
    ) -> None:
        """Give the messages their checksums.

        :raises ConfigurationError: a signal cannot hold its checksum, or its message is not among ``used``.
        """
        for name, spec in specs.items():
            found = self._whole(where, name)
            signal, message = found.signal, found.message.name
            if message not in used:
                raise self._error(where, f"message {message} carries nothing else of [{where.partition('.')[0]}]")
            if signal.multiplexer_ids is not None or self._readers[message].checksum is not None:
                raise self._error(where, f"{name} is multiplexed, or the second checksum of its message")
            counter = counters.get(message)
            try:
                checksum = FrameChecksum(spec, signal, None if counter is None else counter.signal.name)
            except ValueError as error:
                raise self._error(where, f"{name}: {error}") from error
            self._readers[message].checksum = checksum

    def _modulus(self, found: _Found) -> int:
        """Number of values of a counter: those of the DBC, without 15 in a profile that leaves it out."""
        checksums = {**self._description.send.checksum, **self._description.receive.checksum}
        methods = {spec.method for name, spec in checksums.items() if name.rpartition(".")[0] == found.message.name}
        return min(_counted(found), 15) if methods & set(COUNTED_TO_14) else _counted(found)

    def _counters(self, where: str, names: Iterable[str]) -> dict[str, _Found]:
        """Counters by message."""
        counters: dict[str, _Found] = {}
        for name in names:
            found = self._whole(where, name)
            if found.signal.multiplexer_ids is not None:
                raise self._error(where, f"{name} is multiplexed: not every frame of its message has it")
            if counters.setdefault(found.message.name, found) is not found:
                raise self._error(where, f"message {found.message.name} has two counters")
        return counters

    def _raw(self, where: str, what: str, signal: Any, value: float) -> float:
        """Raw value of a signal.

        :raises ConfigurationError: it does not fit; ``what`` names the value.
        """
        raw = _to_raw(signal, value)
        if signal.is_float:
            high = _LARGEST_FLOAT.get(signal.length, math.inf)
            low = -high
        else:
            low, high = _integer_range(signal)
        if not low <= raw <= high:
            raise self._error(
                where,
                f"{what} is {value:g} {signal.unit or ''}, raw {raw:g}; {signal.length} bits hold {low:g} to {high:g}",
            )
        least = -math.inf if signal.minimum is None else float(signal.minimum)
        most = math.inf if signal.maximum is None else float(signal.maximum)
        slack = 1e-6 * abs(signal.scale)
        if not least - slack <= value <= most + slack:
            raise self._error(where, f"{what} is {value:g}, outside [{least:g}|{most:g}] of the DBC")
        return raw


def _integer_range(signal: Any) -> tuple[int, int]:
    if signal.is_signed:
        return -(1 << signal.length - 1), (1 << signal.length - 1) - 1
    return 0, (1 << signal.length) - 1


def _counted(found: _Found) -> int:
    """Number of values of a counter, which runs from 0 to its maximum in the DBC or to that of its bits."""
    signal = found.signal
    maximum = _integer_range(signal)[1]
    return 1 + (maximum if signal.maximum is None else round(min(maximum, _to_raw(signal, float(signal.maximum)))))


def _to_raw(signal: Any, value: float) -> float:
    """Value before the DBC's scaling; a whole number unless the signal is a float."""
    raw = (value - signal.offset) / signal.scale
    return float(raw) if signal.is_float or not math.isfinite(raw) else round(raw)
