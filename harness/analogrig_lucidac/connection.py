"""Client of a LUCIDAC over TCP: commands with their answers, and runs with their samples."""

from __future__ import annotations

import contextlib
import math
import time
import uuid
from collections.abc import Generator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig import RigError
from analogrig.errors import RecordIncomplete, RigRefused, RigTimeout
from analogrig.links import Clock
from analogrig_instruments import InstrumentSocket
from analogrig_lucidac.messages import FrameError, FrameReader, frame, parse_envelope, protocol

_MOST_ANSWER_BYTES = 1 << 20

_MOST_SPARE = 10_000
"""Samples beyond those asked for that a run may send."""

_STOP_S = 2.0
"""Longest time to stop a run that is given up."""

_READ_BACK = frozenset(
    (
        "adc_config",
        "coef_config",
        "itor_config",
        "limiter_config",
        "port_config",
        "select_config",
        "signal_generator_config",
        "sum_config",
    )
)
"""Items of a configuration that a client sets, and that a device leaves as they are until another client does."""

_QUESTION_RATE_HZ = 1000
_QUESTION_SAMPLES = (100, 1000, 10_000)
"""Lengths of runs during which a configuration is sent: the next one if the answer comes too late."""


class LucidacConnection:
    """Connection that exchanges messages, each answer within a time-out."""

    def __init__(self, host: str, port: int, timeout_s: float, clock: Clock = time.monotonic) -> None:
        """:raises ConfigurationError: the package with the messages is not installed.
        :raises RigError: the connection failed.
        """
        self._pb = protocol()
        self._clock = clock
        self._timeout_s = timeout_s
        self._reader = FrameReader(_MOST_ANSWER_BYTES)
        self._doubt = "; is a LUCIDAC at this address?"
        """Question of the error messages until the device has told what it is."""
        self._socket = InstrumentSocket(host, port, timeout_s)
        self.name = self._socket.name

    def ask_once(self, kind: str, **fields: Any) -> Any:
        """Send a command. Return the message that answers it, be it an error."""
        command_id = self._command(kind, **fields)
        deadline_s = self._clock() + self._timeout_s
        while (answer := self._next(kind, deadline_s)).id != command_id:
            pass
        return answer

    def ask(self, kind: str, **fields: Any) -> Any:
        """Send a command. Return the message that answers it.

        :raises RigRefused: it is an error, or the device is busy.
        """
        answer = self.ask_once(kind, **fields)
        answered = answer.WhichOneof("kind")
        if answered == "error_message":
            raise RigRefused(f"instrument {self.name}: {kind}: {answer.error_message.description[:200]!r}")
        if answered == "busy_response":
            raise RigRefused(f"instrument {self.name}: {kind}: the device is busy with another client's run")
        return answer

    def carrier(self) -> str:
        """Address (MAC) of the device.

        :raises RigError: it is no LUCIDAC.
        """
        module = self.ask("extract_command", recursive=True, specification=True).extract_response.module
        roots = [item.entity_specification.entity for item in module.items if item.HasField("entity_specification")]
        for entity in [*roots, *(child for root in roots for child in root.children)]:
            if entity.class_ == self._pb.Entity.CARRIER:
                self._doubt = ""
                return str(entity.id).strip("/")
        raise RigError(f"instrument {self.name}: names no carrier board: it is no LUCIDAC")

    def run(self, samples: int, rate_hz: int, channels: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Run. Return values in machine units and the ends of the converter's range, each (samples, channels).

        :raises RecordIncomplete: samples are missing.
        """
        values, ends, taken = np.empty((samples, channels)), np.zeros((samples, channels), np.bool_), 0
        with contextlib.closing(self._messages_of_run(samples, rate_hz, channels)) as messages:
            for message in messages:
                if message.WhichOneof("kind") == "run_data_message":
                    part, at_end = self._samples(message.run_data_message.data, channels)
                    count = min(len(part), samples - taken)
                    values[taken : taken + count], ends[taken : taken + count] = part[:count], at_end[:count]
                    taken += count
        if taken < samples:
            raise RecordIncomplete(f"instrument {self.name}: returned {taken} of {samples} samples")
        return values, ends

    def accepts_in_op(self, module: Any, channels: int) -> bool:
        """True if the device accepts a configuration while it operates, and answers before OP ends."""
        answers = (self._ask_in_op(module, samples, channels) for samples in _QUESTION_SAMPLES)
        return next(filter(None, answers), "") in ("config_response", "success_message")

    def _ask_in_op(self, module: Any, samples: int, channels: int) -> str:
        """Kind of the answer to a configuration sent in OP; empty if it came too late."""
        states, command_id, operates, answered = self._pb.RunState, "", False, ""
        with contextlib.closing(self._messages_of_run(samples, _QUESTION_RATE_HZ, channels)) as messages:
            for message in messages:
                if message.WhichOneof("kind") == "run_state_change_message":
                    operates = message.run_state_change_message.new_ == states.OP
                    if operates:
                        command_id = self._command("config_command", module=module)
                elif operates and message.id == command_id:
                    answered = message.WhichOneof("kind")
        return answered

    def _messages_of_run(self, samples: int, rate_hz: int, channels: int) -> Generator[Any, None, None]:
        """Start a run. Yield all messages until it is done; stop it if it is given up before."""
        pb, op_ns, is_over, run_id = self._pb, math.ceil(samples / rate_hz * 1e9), False, str(uuid.uuid4())
        try:
            self.ask(
                "start_run_command",
                run=pb.Run(id=run_id),
                run_config=pb.RunConfig(
                    ic_time=pb.Time(value=1, prefix=pb.MILLI), op_time=pb.Time(value=op_ns, prefix=pb.NANO)
                ),
                daq_config=pb.DaqConfig(num_channels=channels, sample_rate=rate_hz, sample_op=True),
            )
            within_s = self._timeout_s + op_ns * 1e-9
            deadline_s, spare = self._clock() + within_s, samples + _MOST_SPARE
            while not is_over:
                message = self._next_of_run("the run", run_id, deadline_s)
                if message.WhichOneof("kind") == "run_data_message" and message.run_data_message.data.sample_count:
                    deadline_s = self._clock() + within_s
                    spare -= message.run_data_message.data.sample_count
                    if spare < 0:
                        raise RigError(
                            f"instrument {self.name}: sends more than the {samples} samples that were asked for"
                        )
                change = message.run_state_change_message
                is_over = self._is_end(change)
                yield message
                if change.new_ == pb.RunState.ERROR:
                    raise RigError(f"instrument {self.name}: the run failed: {change.reason[:200]!r}")
        except RigRefused:
            is_over = True  # the machine may be at the run of another client
            raise
        finally:
            if not is_over:
                self._stop_run(run_id)

    def _is_end(self, change: Any) -> bool:
        return change.new_ in (self._pb.RunState.DONE, self._pb.RunState.ERROR)

    def _next_of_run(self, what: str, run_id: str, deadline_s: float) -> Any:
        """Next message without those of an earlier run that outlived its stop."""
        while True:
            message = self._next(what, deadline_s)
            of_run = (message.run_data_message, message.run_data_end_message, message.run_state_change_message)
            if all(each.run.id in ("", run_id) for each in of_run):
                return message

    def _stop_run(self, run_id: str) -> None:
        """Stop the run, and await its end, as far as the device takes part within _STOP_S."""
        deadline_s = self._clock() + _STOP_S
        with contextlib.suppress(RigError):
            self._command("stop_run_command", within_s=_STOP_S)
            while not self._is_end(self._next_of_run("stop", run_id, deadline_s).run_state_change_message):
                pass

    def configuration(self) -> dict[tuple[str, str], bytes]:
        """Present configuration of the device: items by entity and kind, without what a calibration may change.

        Empty if the device refuses to tell.
        """
        items = {}
        answer = self.ask_once("extract_command", recursive=True, configuration=True)
        for item in answer.extract_response.module.items:
            kind = item.WhichOneof("kind")
            for element in item.coef_config.elements:
                element.ClearField("gain_correction")
            if kind in _READ_BACK:
                items[item.entity.path, kind] = item.SerializeToString(deterministic=True)
        return items

    def overloads(self) -> list[str]:
        """Elements that were overloaded since the flags were cleared."""
        status = self.ask("get_overload_status_command").get_overload_status_response.status
        return [f"{each.entity.path.strip('/')}/{each.idx}" for each in status.elements if each.overload]

    def close(self) -> None:
        self._socket.close()

    def _samples(self, data: Any, channels: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Values by probe, and which of them are at an end of the converter's range."""
        stride, count, bits = data.channel_stride, data.sample_count, data.type.integer.bitwidth
        is_signed = data.type.integer.signess == self._pb.IntegerType.Signed
        kind = "<f4" if data.type.HasField("float_") else {16: "<i2", 32: "<i4"}.get(bits) if is_signed else None
        probes = [channel.probe for channel in data.channels]
        if kind is None or sorted(probes) != list(range(channels)) or stride < channels:
            raise RigError(f"instrument {self.name}: sent samples of a form that was not asked for")
        if len(data.data) != count * stride * np.dtype(kind).itemsize:
            raise RigError(f"instrument {self.name}: sent {len(data.data)} bytes for {count} samples of {stride}")
        raw = np.frombuffer(data.data, kind).reshape(count, stride)[:, :channels]
        order = np.argsort(probes)
        gains, offsets = (np.array([getattr(c, name) for c in data.channels]) for name in ("gain", "offset"))
        values = (raw * gains + offsets)[:, order]
        if not np.isfinite(values).all():
            raise RecordIncomplete(f"instrument {self.name}: returned non-finite samples")
        limits = np.iinfo(raw.dtype) if raw.dtype.kind == "i" else None
        at_end = np.zeros(raw.shape, np.bool_) if limits is None else (raw == limits.min) | (raw == limits.max)
        return values, at_end[:, order]

    def _command(self, kind: str, within_s: float | None = None, **fields: Any) -> str:
        """Send a command, within the time-out unless another time is given. Return the id of its answer."""
        message = self._pb.MessageV1(id=str(uuid.uuid4()))
        command = getattr(message, kind)
        command.SetInParent()
        command.MergeFrom(type(command)(**fields))
        self._socket.send(frame(message), kind, self._timeout_s if within_s is None else within_s)
        return str(message.id)

    def _next(self, what: str, deadline_s: float) -> Any:
        """Next message, of whatever sender.

        :raises RigTimeout: it does not come in time.
        """
        while True:
            left_s = deadline_s - self._clock()
            if left_s <= 0.0:
                raise RigTimeout(self._silence(what))
            try:
                content = self._reader.next()
            except FrameError as error:
                raise RigError(f"instrument {self.name}: {what}: {error}{self._doubt}") from error
            if content is not None:
                envelope = parse_envelope(content)
                if envelope is None or not envelope.HasField("message_v1"):
                    raise RigError(f"instrument {self.name}: {what}: sent no message of this protocol{self._doubt}")
                return envelope.message_v1
            try:
                self._reader.feed(self._socket.receive(1 << 18, what, left_s))
            except TimeoutError as error:
                raise RigTimeout(self._silence(what)) from error

    def _silence(self, what: str) -> str:
        return f"instrument {self.name}: {what}: no answer within {self._timeout_s:g} s{self._doubt}"
