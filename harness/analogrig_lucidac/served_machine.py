"""Emulated LUCIDAC behind the protocol of its firmware 2: one machine, shared by all clients.

Commands: extract, reset, config, calibration, start and stop of a run, overload status, manual control, ping. A run
sends its state changes and its samples to the client that started it; meanwhile other commands that would change the
machine are answered as busy. UDP streaming is refused, so that data comes over the same connection. Anything else, and
everything malformed, is answered with an error; a stream that cannot be cut into frames is closed after it.

What no public document says, and is assumed here:

    config         leaves the machine uncalibrated; reset_before starts from an empty machine
                   during a run: busy; with the parameter writes_in_op the run's client may write coefficients, which
                   act some blocks later and leave the calibration as it is
    reset          keeps the circuit unless circuit_reset is set
    manual control is accepted for IC, OP and HALT; the mode changes no answer, as only runs are sampled and watched for
                   overload, and each begins at its initial conditions
    samples        at k / rate, n = floor(op time x rate); rate x channels at most MOST_RATE_HZ
    run data end   holds the last sample
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig.config import build
from analogrig.links import Clock
from analogrig_emulator import EmulatorError
from analogrig_emulator.lucidac.lucidac_circuit import LucidacParts
from analogrig_emulator.lucidac.machine import Lucidac
from analogrig_instruments import (
    IDLE_S,
    SLOW_S,
    Client,
    Keys,
    TcpServer,
    is_http,
    may_become_http,
    merge,
    now_s,
    parse_defect,
)
from analogrig_lucidac.messages import (
    FrameError,
    FrameReader,
    enum_name,
    frame,
    framed,
    parse_envelope,
    protocol,
)
from analogrig_lucidac.registers import Registers, entity_of

MAC = "04-E9-E5-00-00-01"
MOST_RATE_HZ = 500_000
MOST_OP_S = 3600.0
CHUNK_VALUES = 8000
"""Most values of a data message: a longer one aborts the manufacturer's client."""

_PREFIXES = {"NONE": 1.0, "MILLI": 1e-3, "MICRO": 1e-6, "NANO": 1e-9}
_BLOCKS = (
    ("M0", "M_BLOCK", 1),
    ("M1", "M_BLOCK", 2),
    ("U", "U_BLOCK", 1),
    ("C", "C_BLOCK", 1),
    ("I", "I_BLOCK", 1),
    ("SH", "SH_BLOCK", 1),
)
"""Name, class and type of each block of the cluster."""


class RefusedError(Exception):
    """Command that the device answers with an error."""


def specimen(seed: int, settings: Sequence[str] = ()) -> Lucidac:
    """Machine drawn by a seed, with settings of its parameters as lines of TOML.

    :raises ConfigurationError: a line sets no parameter.
    """
    table: Keys = {}
    for setting in settings:
        table = merge(table, parse_defect(setting))
    parts = build(LucidacParts, table, "lucidac")
    return Lucidac(replace(parts, components=replace(parts.components, seed=seed)))


class LucidacServer(TcpServer):
    """Server of one emulated LUCIDAC."""

    what = "an emulated LUCIDAC of analogrig serve, which speaks protobuf"

    def __init__(
        self, machine: Lucidac, clock: Clock | None = None, *, slow_s: float = SLOW_S, idle_s: float = IDLE_S
    ) -> None:
        """With a ``clock`` a run takes its real time.

        :raises ConfigurationError: the package with the messages is not installed.
        """
        super().__init__(slow_s=slow_s, idle_s=idle_s)
        self._pb = protocol()
        self._machine = machine
        self._clock = clock
        self._registers = Registers()
        self._items: list[Any] = []
        self._runner: Client | None = None
        self._run: asyncio.Task[None] | None = None
        self._block: asyncio.Task[NDArray[np.int16] | None] | None = None
        """Computes the next block of the run in a thread, which a cancelled run cannot stop."""
        self._stopping = asyncio.Event()
        self._commands: dict[str, Callable[[Client, Any], Any]] = {
            "extract_command": self._extract,
            "reset_command": self._reset,
            "config_command": self._configure,
            "calibration_command": self._calibrate,
            "start_run_command": self._start_run,
            "stop_run_command": self._stop_run,
            "manual_control_command": self._control_by_hand,
            "udp_data_streaming_command": self._refuse_udp,
            "get_overload_status_command": self._overload_status,
        }

    # ---- clients

    def keeps_place(self, client: Client) -> bool:
        return client is self._runner

    def release(self, client: Client) -> None:
        """End the run of a client that is gone."""
        if client is self._runner and self._run is not None:
            self._run.cancel()

    def silence(self) -> None:
        """End a run."""
        if self._run is not None:
            self._run.cancel()

    async def converse(self, client: Client) -> None:
        reader = FrameReader()
        with contextlib.suppress(FrameError):
            start: bytes | None = b""
            while data := await client.reader.read(self.most_read_bytes):
                if start is not None:
                    start += data
                    if may_become_http(start):
                        continue
                    if is_http(start):
                        self.admit(client, start)
                        return
                    data, start = start, None
                reader.feed(data)
                while (content := self._next(client, reader)) is not None:
                    if not self.admit(client, b""):
                        return
                    client.heard_s = now_s()
                    client.writer.write(self._answer(client, content))
                    await self.drain(client)
                    await asyncio.sleep(0)  # waiting clients have a turn

    def _next(self, client: Client, reader: FrameReader) -> bytes | None:
        """Content of the next frame. A stream that cannot be cut is answered before its end."""
        try:
            return reader.next()
        except FrameError as error:
            client.writer.write(frame(self._message(self._error(str(error)))))
            raise

    # ---- messages

    def _message(self, body: Any, message_id: str = "") -> Any:
        """MessageV1 with a body in the field of its kind; a notification has no id."""
        message = self._pb.MessageV1(id=message_id) if message_id else self._pb.MessageV1()
        field = next(
            each
            for each in self._pb.MessageV1.DESCRIPTOR.oneofs_by_name["kind"].fields
            if each.message_type == body.DESCRIPTOR
        )
        getattr(message, field.name).CopyFrom(body)
        getattr(message, field.name).SetInParent()
        return message

    def _error(self, why: str) -> Any:
        return self._pb.ErrorMessage(description=why)

    def _answer(self, client: Client, content: bytes) -> bytes:
        """Frame that answers the content of a frame."""
        envelope = parse_envelope(content)
        if envelope is None:
            return frame(self._message(self._error("no envelope of this protocol")))
        if envelope.HasField("generic") and envelope.generic.HasField("ping_command"):
            pong = self._pb.Envelope()
            pong.generic.ping_response.micros = int(now_s() * 1e6) & 0xFFFFFFFF
            return framed(pong)
        command = envelope.message_v1
        version = envelope.version if envelope.HasField("version") else None
        return frame(self._message(self._execute(client, command), command.id), version)

    def _execute(self, client: Client, command: Any) -> Any:
        """Body of the answer to a command."""
        kind = command.WhichOneof("kind")
        action = self._commands.get(kind)
        if action is None:
            return self._error(f"{kind or 'an empty message'} is not supported")
        try:
            return action(client, getattr(command, kind))
        except (RefusedError, EmulatorError) as error:
            return self._error(str(error))
        except BlockingIOError:
            return self._pb.DeviceBusyMessage()

    def _require_idle(self) -> None:
        """:raises BlockingIOError: a run is under way."""
        if self._runner is not None:
            raise BlockingIOError

    # ---- commands

    def _extract(self, _: Client, command: Any) -> Any:
        response = self._pb.ExtractResponse()
        if command.specification:
            response.module.items.append(
                self._pb.Item(entity_specification=self._pb.EntitySpecification(entity=self._tree()))
            )
        if command.configuration:
            response.module.items.extend(self._items)
        return response

    def _tree(self) -> Any:
        entity, classes = self._pb.Entity, self._pb.Entity.Class
        blocks = [
            entity(
                id=f"/{name}", class_=classes.Value(kind), type=variety, variant=1, version=self._pb.Version(major=1)
            )
            for name, kind, variety in _BLOCKS
        ]
        cluster = entity(id="/0", class_=entity.CLUSTER, type=1, variant=1, version=self._pb.Version(major=1))
        cluster.children.extend(blocks)
        carrier = entity(id=f"/{MAC}", class_=entity.CARRIER, type=1, variant=1, version=self._pb.Version(major=1))
        carrier.children.extend(
            [
                cluster,
                entity(id="/CTRL", class_=entity.CTRL_BLOCK, type=1, variant=1),
                entity(id="/FP", class_=entity.FRONT_PANEL, type=1, variant=1),
            ]
        )
        return carrier

    def _reset(self, _: Client, command: Any) -> Any:
        self._require_idle()
        if not command.keep_calibration:
            self._machine.forget_calibration()
        if command.overload_reset:
            self._machine.overloads.clear()
        if command.circuit_reset:
            self._machine.configure(Registers().configuration())
            self._registers, self._items = Registers(), []
        return self._pb.ResetResponse(entity=command.entity)

    def _configure(self, client: Client, command: Any) -> Any:
        writes_in_op = client is self._runner and self._may_write_in_op(command)
        if not writes_in_op:
            self._require_idle()
        before, items = (Registers(), []) if command.reset_before else (self._registers, self._items)
        registers, items = before.with_items(command.module.items, MAC), _merged(items, list(command.module.items))
        (self._machine.turn if writes_in_op else self._machine.configure)(registers.configuration())
        self._registers, self._items = registers, items
        return self._pb.ConfigResponse()

    def _may_write_in_op(self, command: Any) -> bool:
        kinds = {item.WhichOneof("kind") for item in command.module.items}
        return self._machine.parts.writes_in_op and not command.reset_before and kinds == {"coef_config"}

    def _calibrate(self, _: Client, command: Any) -> Any:
        self._require_idle()
        enabled = self._pb.CalibrationConfig.Enabled
        self._machine.calibrate(gain=command.config.gain == enabled, offset=command.config.offset == enabled)
        return self._pb.CalibrationResponse()

    def _control_by_hand(self, _: Client, command: Any) -> Any:
        self._require_idle()
        if command.to == self._pb.ManualControlCommand.MINION:
            raise RefusedError("this device follows no other")
        return self._pb.SuccessMessage()

    def _refuse_udp(self, _: Client, __: Any) -> Any:
        return self._pb.UdpDataStreamingRefusedResponse(reason="data comes over this connection")

    def _overload_status(self, _: Client, __: Any) -> Any:
        status = self._pb.OverloadStatus(global_overload=bool(self._machine.overloads))
        for block, index in sorted(self._machine.overloads):
            entity = self._pb.EntityId(path=f"/{MAC}/0/{block}")
            status.elements.append(self._pb.OverloadStatus.Element(entity=entity, idx=index, overload=True))
        return self._pb.GetOverloadStatusResponse(status=status)

    # ---- runs

    def _start_run(self, client: Client, command: Any) -> Any:
        self._require_idle()
        op_s, rate_hz = self._seconds(command.run_config.op_time), command.daq_config.sample_rate
        channels = len(self._registers.probes)
        if not 0 < op_s <= MOST_OP_S:
            raise RefusedError(f"op_time must be more than 0 and at most {MOST_OP_S:g} s, not {op_s:g} s")
        if not 0 < rate_hz * max(channels, 1) <= MOST_RATE_HZ:
            raise RefusedError(f"sample_rate x channels must be 1 to {MOST_RATE_HZ}, not {rate_hz} x {channels}")
        samples = math.floor(round(op_s * rate_hz, 6))
        codes = self._machine.play(samples, rate_hz, halt_on_overload=command.run_config.halt_on_overload)
        self._runner, self._stopping = client, asyncio.Event()
        self._run = asyncio.ensure_future(self._conduct(client, command, codes, rate_hz))
        self._run.add_done_callback(lambda _: self._end_run())
        return self._pb.StartRunResponse()

    def _end_run(self) -> None:
        """Free the machine, but not before the thread of a cancelled run is done with it."""
        if self._block is None or self._block.done():
            self._runner = self._run = self._block = None
        else:
            self._block.add_done_callback(lambda _: self._end_run())

    def _stop_run(self, client: Client, _: Any) -> Any:
        if self._run is None or client is not self._runner:
            raise RefusedError("there is no run of this client")
        self._stopping.set()
        return self._pb.SuccessMessage()

    def _seconds(self, time: Any) -> float:
        """Seconds of a time; 0 for an unknown prefix."""
        return float(time.value * _PREFIXES.get(enum_name(self._pb.Prefix, time.prefix), 0.0))

    async def _conduct(self, client: Client, command: Any, blocks: Iterator[NDArray[np.int16]], rate_hz: int) -> None:
        """Run to its end: state changes, samples, and the reason if it fails."""
        states, taken, started_s = self._pb.RunState, 0, self._clock() if self._clock else 0.0
        run = self._pb.Run(id=command.run.id)
        await asyncio.sleep(0)  # the answer to the command goes first
        state = states.NEW
        last: NDArray[np.int16] | None = None

        async def enter(new: int, reason: str = "") -> None:
            nonlocal state
            time = self._pb.Time(value=round(taken / rate_hz * 1e9), prefix=self._pb.NANO)
            await self._notify(
                client, self._pb.RunStateChangeMessage(run=run, old=state, new_=new, time=time, reason=reason)
            )
            state = new

        try:
            for new in (states.TAKE_OFF, states.IC, states.OP):
                await enter(new)
            while not self._stopping.is_set() and (codes := await self._next_block(blocks)) is not None:
                for part in _chunks(codes):
                    if self._clock:
                        await self._wait(started_s + (taken + len(part)) / rate_hz - self._clock())
                    if self._stopping.is_set():
                        break
                    taken += len(part)
                    message = self._pb.RunDataMessage(run=run, entity=self._pb.EntityId(path=f"/{MAC}"))
                    self._fill(message.data, part)
                    run.chunk += 1
                    last = part[-1:]
                    await self._notify(client, message)
            await enter(states.OP_END)
            if last is not None:
                end = self._pb.RunDataEndMessage(run=run, entity=self._pb.EntityId(path=f"/{MAC}"))
                self._fill(end.data, last)
                await self._notify(client, end)
            await enter(states.DONE)
        except EmulatorError as error:
            await enter(states.ERROR, str(error))
        except OSError:
            client.hang_up()

    async def _next_block(self, blocks: Iterator[NDArray[np.int16]]) -> NDArray[np.int16] | None:
        """Next block of a run; None at its end."""
        self._block = asyncio.ensure_future(asyncio.to_thread(next, blocks, None))
        return await asyncio.shield(self._block)

    async def _wait(self, seconds: float) -> None:
        """Wait, but no longer than until the run is stopped."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._stopping.wait()

    async def _notify(self, client: Client, body: Any) -> None:
        client.writer.write(frame(self._message(body)))
        await self.drain(client)

    def _fill(self, data: Any, codes: NDArray[np.int16]) -> None:
        """Enter samples in a data message, each channel with the scale that makes values of its codes."""
        data.data = codes.astype("<i2").tobytes()
        data.type.integer.signess = self._pb.IntegerType.Signed
        data.type.integer.bitwidth = 16
        data.sample_count, data.channel_stride = codes.shape
        for probe, scale in zip(self._registers.probes, self._machine.scales, strict=True):
            data.channels.add(
                idx=probe.output,
                gain=scale.gain * probe.gain,
                offset=scale.offset * probe.gain + probe.offset,
                probe=probe.probe,
            )


def _chunks(codes: NDArray[np.int16]) -> Iterator[NDArray[np.int16]]:
    samples, channels = codes.shape
    most = CHUNK_VALUES // max(channels, 1)
    if channels:
        for start in range(0, samples, most):
            yield codes[start : start + most]


def _merged(items: list[Any], newer: list[Any]) -> list[Any]:
    """Items, each replaced by the newer one of the same entity and kind."""
    merged = {(entity_of(item), item.WhichOneof("kind")): item for item in (*items, *newer)}
    return list(merged.values())
