"""Messages of an ECU: samples to frames, and frames to answers, by its device file and its DBC.

cantools encodes and decodes. Every name and every range is checked once, when the device file is read.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from analogrig.answers import LARGEST_FLOAT32
from analogrig.config import suggest
from analogrig.devices.can_dbc import CanDbcDevice, Request, Units, scale
from analogrig.errors import ConfigurationError
from analogrig.links.can_station import Identifier
from analogrig.links.dbc import check_layout, load_dbc
from analogrig.links.python_can import can
from analogrig.run import Channel

CLASSIC_BYTES = 8
FD_BYTES = 64

_LARGEST_FLOAT = {16: 65504.0, 32: LARGEST_FLOAT32, 64: math.inf}
"""Largest finite value of a float signal by its length in bits."""

_INPUTS = ("u", "y")


class Answer(NamedTuple):
    """Part of the device's answer to a sample: one frame."""

    message: str
    values: Mapping[str, float]
    """Values of the signals that [receive] names, as ``Message.Signal``."""
    counter: int | None
    """Value of its counter; None if [receive] names none in this message."""


class SamplePart(NamedTuple):
    """Part of a sample as sent: one frame."""

    message: str
    values: Mapping[str, float]
    """Physical values by key of [send]: u, y, valid."""
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

    def __init__(self, description: CanDbcDevice) -> None:
        """Find and check all messages.

        :raises ConfigurationError: names file, table and key.
        """
        self._description = description
        self._path = Path(description.dbc)
        self._database = load_dbc(self._path)
        self._frames: dict[str, Any] = {}
        """Messages in use by name."""
        self._find_sent()
        self._find_received()
        self.start = self._request("start", description.start)
        self.reset = self._request("reset", description.reset)
        self._check_identifiers()

    # ------------------------------------------------------------------------------------------------------ identifiers

    @property
    def own(self) -> frozenset[Identifier]:
        """Identifiers of the harness's frames."""
        requests = [request.message for request in (self.start, self.reset) if request]
        return frozenset(_identifier(self._frames[name]) for name in (*self.order, *requests))

    @property
    def of_device(self) -> frozenset[Identifier]:
        """Identifiers of the device's frames."""
        answers = [request.answer for request in (self.start, self.reset) if request and request.answer]
        return frozenset(_identifier(self._frames[name]) for name in (*self._answers, *answers))

    def _check_identifiers(self) -> None:
        names: dict[Identifier, str] = {}
        for name, message in self._frames.items():
            other = names.setdefault(_identifier(message), name)
            if other != name:
                raise self._error("dbc", f"messages {other} and {name} have the same identifier")
        if both := self.own & self.of_device:
            raise self._error("receive", f"message {names[min(both)]} is sent to the device as well")

    # ------------------------------------------------------------------------------------------------------- to the bus

    def encoder(
        self, channels: Mapping[str, Channel] | None = None
    ) -> Callable[[int, int, int, bool], list[can.Message]]:
        """Function that returns the frames of a sample, from its index, its codes of u and y, and valid.

        :param channels: channels of the rig; None: units that depend on them are not checked.
        :raises ConfigurationError: a code does not fit its signal.
        """
        tables = {key: self._raw_values(key, None if channels is None else channels[key]) for key in _INPUTS}
        u_of, y_of = tables["u"], tables["y"]
        parts = [self._encode_part(self._frames[name]) for name in self.order]

        def encode(index: int, u: int, y: int, valid: bool) -> list[can.Message]:  # noqa: FBT001
            given = {"u": u_of[u], "y": y_of[y], "valid": int(valid)}
            return [part(index, given) for part in parts]

        return encode

    def _encode_part(self, message: Any) -> Callable[[int, Mapping[str, float]], can.Message]:
        """Function that returns the frame of one message of a sample."""
        fixed = self._fixed[message.name]
        keys = [(found.signal.name, key) for key, found in self._carriers.items() if found.message is message]
        counter = self._send_counters.get(message.name)
        modulus = 1 if counter is None else _modulus(counter)
        name = "" if counter is None else counter.signal.name

        def encode(index: int, given: Mapping[str, float]) -> can.Message:
            values = fixed.copy()
            for signal, key in keys:
                values[signal] = given[key]
            if name:
                values[name] = index % modulus
            return self._frame(message, values)

        return encode

    def _frame(self, message: Any, raw: Mapping[str, float]) -> can.Message:
        data = message.encode(raw, scaling=False, strict=False)
        is_fd = message.is_fd or len(data) > CLASSIC_BYTES
        return can.Message(
            arbitration_id=message.frame_id,
            is_extended_id=message.is_extended_frame,
            data=data if len(data) <= CLASSIC_BYTES else data.ljust(_frame_bytes(len(data)), b"\0"),
            is_fd=is_fd,
            bitrate_switch=is_fd and self._description.data_bitrate is not None,
            is_rx=False,
        )

    def request(self, request: Request) -> can.Message:
        """Frame of [start] or [reset]."""
        return self._frame(self._frames[request.message], self._fixed[request.message])

    def is_answer(self, request: Request, frame: can.Message) -> bool:
        """True if the frame is the answer to [start] or [reset]."""
        message = self._frames[request.answer]
        if _identifier(message) != (frame.arbitration_id, frame.is_extended_id):
            return False
        values = _decode(message, frame)
        return values is not None and all(values.get(name) == value for name, value in request.answered.items())

    # ----------------------------------------------------------------------------------------------------- from the bus

    def answer(self, frame: can.Message) -> Answer | None:
        """Answer in a frame of the device; None if it is damaged, or none of [receive]."""
        message = self._by_identifier.get((frame.arbitration_id, frame.is_extended_id))
        values = None if message is None else _decode(message, frame)
        if message is None or values is None:
            return None
        wanted = {}
        for name, full in self._answers[message.name].items():
            if name in values:
                wanted[full] = values[name]
        counter = self._receive_counters.get(message.name)
        return Answer(message.name, wanted, None if counter is None else int(values.get(counter.signal.name, -1)))

    def is_of_answer(self, frame: can.Message) -> bool:
        """True if the frame has the identifier of a message of [receive]."""
        return (frame.arbitration_id, frame.is_extended_id) in self._by_identifier

    def is_start(self, frame: can.Message) -> bool:
        """True if the frame is that of [start]."""
        return self.start is not None and self._equals(self.request(self.start), frame)

    @staticmethod
    def _equals(one: can.Message, other: can.Message) -> bool:
        return (one.arbitration_id, one.is_extended_id, bytes(one.data)) == (
            other.arbitration_id,
            other.is_extended_id,
            bytes(other.data),
        )

    def is_of_sample(self, frame: can.Message) -> bool:
        """True if the frame has the identifier of a message of [send]."""
        return any((frame.arbitration_id, frame.is_extended_id) == _identifier(self._frames[n]) for n in self.order)

    def sample_part(self, frame: can.Message) -> SamplePart | None:
        """Part of a sample in a captured frame of the harness; None if it is damaged, or none of [send]."""
        identifier = frame.arbitration_id, frame.is_extended_id
        message = next(
            (self._frames[name] for name in self.order if _identifier(self._frames[name]) == identifier), None
        )
        values = None if message is None else _decode(message, frame)
        if message is None or values is None:
            return None
        carried = {key: found.signal.name for key, found in self._carriers.items() if found.message is message}
        if not all(name in values and math.isfinite(values[name]) for name in carried.values()):
            return None
        counter = self._send_counters.get(message.name)
        count = None if counter is None else int(values.get(counter.signal.name, -1))
        return SamplePart(message.name, {key: values[name] for key, name in carried.items()}, count)

    def decoder(self, channels: Mapping[str, Channel]) -> Callable[[Mapping[str, float]], tuple[int, int, bool] | None]:
        """Function that returns the codes of u and y, and valid, from the values of all parts; None outside the range.

        It is the inverse of ``encoder``, as far as the signals have a step for each code.
        """
        known = {key: scale(self._units(key), channels[key]) for key in _INPUTS}
        scales = {key: factors for key, factors in known.items() if factors is not None}
        most = {key: channels[key].codes for key in _INPUTS}

        def decode(values: Mapping[str, float]) -> tuple[int, int, bool] | None:
            codes = {key: round((values[key] - offset) / factor) for key, (factor, offset) in scales.items()}
            if not all(0 <= code < most[key] for key, code in codes.items()):
                return None
            return codes["u"], codes["y"], bool(values.get("valid", 1))

        return decode

    # ------------------------------------------------------------------------------------------------------------- send

    def _find_sent(self) -> None:
        sent = self._description.send
        self._carriers = {key: self._signal(f"send.{key}", getattr(sent, key)) for key in _INPUTS}
        if sent.valid:
            self._carriers["valid"] = self._signal("send.valid", sent.valid)
        self._send_counters = self._counters("send.counter", sent.counter)
        constants = [self._signal(f"send.constant.{name}", name) for name in sent.constant]
        carriers = (*self._carriers.values(), *self._send_counters.values())
        used = {found.name for found in carriers}
        if len(used) < len(carriers):
            raise self._error("send", "one signal carries two quantities")
        if twice := used & set(sent.constant):
            raise self._error("send.constant", f"{min(twice)} carries a quantity of the sample")
        named = [found.message.name for found in (*carriers, *constants)]
        self.order = sent.order or tuple(dict.fromkeys(named))
        if sorted(self.order) != sorted(set(named)):
            raise self._error("send.order", f"must name each of {', '.join(dict.fromkeys(named))} once")
        if len({_modulus(found) for found in self._send_counters.values()}) > 1:
            raise self._error("send.counter", "the counters have different ranges")
        self._fixed: dict[str, dict[str, float]] = {}
        for name in self.order:
            self._fixed[name] = self._start_values(
                f"send.{'constant' if constants else 'order'}",
                self._frames[name],
                {found.signal.name: sent.constant[found.name] for found in constants if found.message.name == name},
                [found.signal for found in carriers if found.message.name == name],
            )
        self.encoder()

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

    def _raw_values(self, key: str, channel: Channel | None) -> Sequence[float]:
        """Raw value of the signal for each code.

        :raises ConfigurationError: a value does not fit.
        """
        found = self._carriers[key]
        codes = self._description.send.codes if channel is None else channel.codes
        factors = scale(self._units(key), channel)
        if factors is None:
            return ()
        factor, offset = factors
        if factor == 0.0:
            raise self._error(f"send.units.{key}", "the scale is 0")
        for code in (0, codes - 1):
            try:
                self._raw(f"send.{key}", f"{found.name}: code {code}", found.signal, code * factor + offset)
            except ConfigurationError as error:
                cure = f"set send.units.{key}, or correct scale and range of {found.name} in the DBC"
                raise ConfigurationError(f"{error}: {cure}") from error
        return [_to_raw(found.signal, code * factor + offset) for code in range(codes)]

    def _units(self, key: str) -> Units:
        units: Units = getattr(self._description.send.units, key)
        return units

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
        if received.complete:
            self._answers.setdefault(self._message("receive.complete", received.complete).name, {})
        self._receive_counters = self._counters("receive.counter", received.counter)
        for name in self._receive_counters:
            if name not in self._answers:
                raise self._error("receive.counter", f"message {name} carries nothing else of an answer")
        if received.counter and received.counter_is == "echo":
            self._check_echo()
        self._by_identifier = {_identifier(self._frames[name]): self._frames[name] for name in self._answers}

    def _check_echo(self) -> None:
        """Check that echoed counters fit.

        :raises ConfigurationError: there is no counter to echo, or it has another range.
        """
        if not self._send_counters:
            raise self._error("receive.counter", "an echo needs send.counter; or set counter_is = 'own'")
        sent = _modulus(next(iter(self._send_counters.values())))
        for found in self._receive_counters.values():
            if _modulus(found) > sent:
                raise self._error(
                    "receive.counter", f"{found.name} counts to {_modulus(found) - 1}, send.counter to {sent - 1}"
                )

    @property
    def count_moduli(self) -> Mapping[str, int]:
        """Modulus of the counter of each message of an answer that has one."""
        return {name: _modulus(found) for name, found in self._receive_counters.items()}

    @property
    def sample_modulus(self) -> int | None:
        """Modulus of the sample's counter; None without one."""
        return next(map(_modulus, self._send_counters.values()), None)

    @property
    def is_each_answer_counted(self) -> bool:
        """True if each message of an answer has a counter."""
        return set(self._receive_counters) == set(self._answers)

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
        if request.answered and not request.answer:
            raise self._error(f"{table}.answered", "no answer is named")
        if request.answer:
            answer = self._message(f"{table}.answer", request.answer)
            for name in request.answered:
                self._signal_of(f"{table}.answered", answer, name)
        return request

    # ------------------------------------------------------------------------------------------------------------ names

    def _error(self, where: str, problem: str) -> ConfigurationError:
        table, _, key = where.partition(".")
        return ConfigurationError(f"[{table}] {key}: {problem}" if key else f"{table}: {problem}")

    def _message(self, where: str, name: str) -> Any:
        """Message of that name, whose layout is checked.

        :raises ConfigurationError: there is none, or it cannot be used.
        """
        if name in self._frames:
            return self._frames[name]
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
        self._frames[name] = message
        return message

    def _signal(self, where: str, name: str) -> _Found:
        """Signal ``Message.Signal``; errors as ``_message``."""
        message_name, dot, signal_name = name.rpartition(".")
        if not dot:
            raise self._error(where, f"must be Message.Signal, not {name!r}")
        message = self._message(where, message_name)
        return _Found(message, self._signal_of(where, message, signal_name), name)

    def _signal_of(self, where: str, message: Any, name: str) -> Any:
        signal = next((each for each in message.signals if each.name == name), None)
        if signal is None:
            known = [each.name for each in message.signals]
            raise self._error(where, f"message {message.name} has no signal {name!r}{suggest(name, known)}")
        if signal.scale == 0:
            raise self._error(where, f"{message.name}.{name} has the scale 0 in the DBC")
        return signal

    def _counters(self, where: str, names: Iterable[str]) -> dict[str, _Found]:
        """Counters by message."""
        counters: dict[str, _Found] = {}
        for name in names:
            found = self._signal(where, name)
            signal = found.signal
            if signal.is_float or signal.is_signed or (signal.scale, signal.offset) != (1, 0):
                raise self._error(where, f"{name} is not an unsigned number with the scale 1 and the offset 0")
            if signal.multiplexer_ids is not None:
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


def _identifier(message: Any) -> Identifier:
    return message.frame_id, message.is_extended_frame


def _integer_range(signal: Any) -> tuple[int, int]:
    if signal.is_signed:
        return -(1 << signal.length - 1), (1 << signal.length - 1) - 1
    return 0, (1 << signal.length) - 1


def _modulus(found: _Found) -> int:
    """Number of values of a counter, which runs from 0 to its maximum in the DBC or to that of its bits."""
    signal = found.signal
    maximum = _integer_range(signal)[1]
    return 1 + (maximum if signal.maximum is None else round(min(maximum, _to_raw(signal, float(signal.maximum)))))


def _to_raw(signal: Any, value: float) -> float:
    """Value before the DBC's scaling; a whole number unless the signal is a float."""
    raw = (value - signal.offset) / signal.scale
    return float(raw) if signal.is_float or not math.isfinite(raw) else round(raw)


def _frame_bytes(n: int) -> int:
    """Length of the shortest frame that holds ``n`` bytes."""
    return int(can.util.dlc2len(can.util.len2dlc(n)))


def _decode(message: Any, frame: can.Message) -> dict[str, float] | None:
    """Physical values of the signals in a frame; None if it is damaged."""
    length = message.length
    if len(frame.data) != length and len(frame.data) != _frame_bytes(length):
        return None
    try:
        values: dict[str, float] = message.decode_simple(bytes(frame.data[:length]), decode_choices=False)
    except Exception:  # noqa: BLE001 - the exceptions of cantools and bitstruct have no common base
        return None
    return values
