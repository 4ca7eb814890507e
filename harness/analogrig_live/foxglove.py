"""Endpoint of other viewers, such as Foxglove, Lichtblick and PlotJuggler.

The subprotocol is foxglove.websocket.v1 (github.com/foxglove/ws-protocol, docs/spec.md): channels are JSON with a
schema, the pots are parameters. While no client of the page drives, the first viewer that sets a parameter drives.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import struct
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from websockets.exceptions import ConnectionClosed

from analogrig import AnalogrigError, ConfigurationError
from analogrig.wording import one_line
from analogrig_live.commands import Turn
from analogrig_live.scope import read_signal, signals_of

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection

    from analogrig_live.live_session import LiveSession

SUBPROTOCOL = "foxglove.websocket.v1"

_MESSAGE_DATA = 1
_PERIOD_S = 0.02
_ROWS = 8
"""Samples of the signals that are sent in each period."""
_MOST_SUBSCRIPTIONS = 64
_WARNING, _ERROR = 1, 2

_log = logging.getLogger(__name__)

_NUMBER: Mapping[str, Any] = {"type": "number"}
_UNKNOWN_OR_NUMBER: Mapping[str, Any] = {"type": ["number", "null"]}
_TEXT: Mapping[str, Any] = {"type": "string"}


@dataclass(frozen=True)
class Topic:
    """Topic of messages in JSON."""

    number: int
    topic: str
    properties: Mapping[str, Any]
    description: str

    def advertisement(self) -> dict[str, Any]:
        """Entry of the message ``advertise``."""
        schema = {"type": "object", "description": self.description, "properties": self.properties}
        return {
            "id": self.number,
            "topic": self.topic,
            "encoding": "json",
            "schemaName": f"analogrig{self.topic.replace('/', '.')}",
            "schemaEncoding": "jsonschema",
            "schema": json.dumps(schema),
        }


def channels_of(session: LiveSession) -> dict[int, Topic]:
    """Channels of a session by number."""
    signals = dict.fromkeys(signals_of(session), _UNKNOWN_OR_NUMBER)
    alarm = {"take": _NUMBER, "sample": _NUMBER, "what": _TEXT}
    alarm |= dict.fromkeys(("latency_n", "bound_n"), _UNKNOWN_OR_NUMBER)
    state = {"mode": _TEXT, "samples": _NUMBER, "speed": _NUMBER, "take": _NUMBER}
    rows = f"{_ROWS} evenly spaced samples every {_PERIOD_S:g} s, at machine time from the start of the take"
    topics = (
        ("/signals", {"sample": _NUMBER, **signals}, rows),
        ("/alarms", alarm, "alarms of the device, at the time of sending"),
        ("/state", state, "state of the bench, at the time of sending"),
    )
    return {number: Topic(number, *topic) for number, topic in enumerate(topics, 1)}


class Viewer:
    """One viewer at its connection."""

    def __init__(
        self,
        socket: ServerConnection,
        session: LiveSession,
        *,
        may_set: Callable[[], bool],
        work: Callable[[], AbstractAsyncContextManager[None]],
        slow_s: float,
        pause_s: float,
    ) -> None:
        """Prepare; nothing is sent before ``serve``.

        :param may_set: true while this viewer may set parameters.
        :param work: context of work that other clients must wait for.
        :param slow_s: a viewer that takes nothing for so long is dropped.
        :param pause_s: least time between two messages of the viewer.
        """
        self._socket = socket
        self._session = session
        self._may_set = may_set
        self._work = work
        self._slow_s, self._pause_s = slow_s, pause_s
        self._channels = channels_of(session)
        self._subscribed: dict[int, int] = {}
        """Channels by number of the subscription."""
        self._watched: set[str] = set()
        """Parameters whose changes are reported."""

    async def serve(self) -> None:
        """Serve until the connection closes."""
        name = f"analogrig bench: {self._session.desk.program.name}"
        capabilities = ["parameters", "parametersSubscribe"]
        info = {"name": name, "capabilities": capabilities, "metadata": {}, "sessionId": str(id(self._session))}
        await self._tell("serverInfo", **info)
        await self._tell("advertise", channels=[channel.advertisement() for channel in self._channels.values()])
        publishing = asyncio.create_task(self._publish())
        publishing.add_done_callback(lambda _: self._socket.transport.abort())
        try:
            async for message in self._socket:
                await self._receive(message)
                await asyncio.sleep(self._pause_s)
        finally:
            publishing.cancel()
            for error in await asyncio.gather(publishing, return_exceptions=True):
                if isinstance(error, Exception):
                    _log.error("messages to a viewer have ended", exc_info=error)

    async def _receive(self, message: str | bytes) -> None:
        """Carry out one message; a wrong one is answered by a status."""
        try:
            table = json.loads(message) if isinstance(message, str) else None
            operation = table["op"] if isinstance(table, dict) else None
            if not isinstance(operation, str) or operation not in _OPERATIONS:
                await self._tell("status", level=_WARNING, message="this server has no such operation")
                return
            await _OPERATIONS[operation](self, table)
        except AnalogrigError as error:
            await self._tell("status", level=_ERROR, message=one_line(str(error)))
        except (ValueError, TypeError, LookupError, ArithmeticError, AttributeError, RecursionError):
            await self._tell("status", level=_ERROR, message="the message is not as the protocol describes it")

    async def _subscribe(self, table: Mapping[str, Any]) -> None:
        for each in table["subscriptions"]:
            number, channel = int(each["id"]), int(each["channelId"])
            if channel not in self._channels or not 0 <= number < 1 << 32:
                raise ValueError(channel)
            if len(self._subscribed) < _MOST_SUBSCRIPTIONS:
                self._subscribed[number] = channel

    async def _unsubscribe(self, table: Mapping[str, Any]) -> None:
        for number in table["subscriptionIds"]:
            self._subscribed.pop(number, None)

    async def _get_parameters(self, table: Mapping[str, Any]) -> None:
        await self._tell_parameters(self._named(table), table.get("id"))

    async def _set_parameters(self, table: Mapping[str, Any]) -> None:
        if not self._may_set():
            raise ConfigurationError("another client drives: close it to set parameters here")
        turns = []
        for each in table["parameters"]:
            name, value = str(each["name"]), each["value"]
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise TypeError(name)
            turns.append(Turn(name, float(value)))
        self._session.do(*turns)
        if table.get("id") is not None:
            await self._tell_parameters({turn.name for turn in turns}, table["id"])

    async def _watch_parameters(self, table: Mapping[str, Any]) -> None:
        self._watched |= self._named(table)

    async def _unwatch_parameters(self, table: Mapping[str, Any]) -> None:
        self._watched -= self._named(table)

    def _named(self, table: Mapping[str, Any]) -> set[str]:
        """Parameters that a message names; all if it names none."""
        known = set(self._session.knobs)
        return known & set(map(str, table["parameterNames"])) if table["parameterNames"] else known

    async def _tell_parameters(self, names: Collection[str], number: Any = None) -> None:
        values = [
            {"name": name, "value": value, "type": "float64"}
            for name, value in self._session.ordered_values.items()
            if name in names
        ]
        await self._tell("parameterValues", parameters=values, **({} if number is None else {"id": str(number)}))

    # ---- messages of channels

    async def _publish(self) -> None:
        """Publish what is subscribed to."""
        told: dict[str, float] = {}
        sent_alarms, end, take = self._session.notes.alarm_count, 0, 0
        began_ns = sent_ns = 0  # times of the first sample of the take, and of the last sample sent
        with contextlib.suppress(ConnectionClosed, TimeoutError):
            while True:
                await asyncio.sleep(_PERIOD_S)
                session = self._session
                last = end
                before, (take, end) = take, session.ring.place
                if take != before:
                    last, began_ns = 0, max(time.time_ns(), sent_ns)
                rows: list[dict[str, Any]] = []
                if "/signals" in self._topics():
                    async with self._work():
                        rows = self._rows(last, end)
                for row in rows:
                    sent_ns = began_ns + round(1e9 * row["sample"] / session.sample_rate_hz)
                    await self._send("/signals", row, sent_ns)
                for alarm in [each for each in list(session.notes.alarms) if each.number > sent_alarms]:
                    sent_alarms = alarm.number
                    table = {"take": alarm.take, "sample": alarm.sample, "what": alarm.what}
                    await self._send("/alarms", table | {"latency_n": alarm.latency_n, "bound_n": alarm.bound_n})
                if end != last:
                    state = {
                        "mode": session.mode,
                        "samples": end,
                        "speed": session.meter.rates.samples_hz,
                        "take": take,
                    }
                    await self._send("/state", state)
                changed = {name: value for name, value in session.ordered_values.items() if told.get(name) != value}
                told |= changed
                if self._watched & set(changed):
                    await self._tell_parameters(self._watched & set(changed))

    def _topics(self) -> set[str]:
        return {self._channels[number].topic for number in self._subscribed.values()}

    def _rows(self, first: int, end: int) -> list[dict[str, Any]]:
        """Samples between two ends, evenly spaced."""
        first = max(first, end - int(self._session.sample_rate_hz), self._session.ring.start)
        if end <= first:
            return []
        stride = max(1, (end - first) // _ROWS)
        try:
            read = {name: read_signal(self._session, name, first, end)[::stride] for name in signals_of(self._session)}
        except LookupError:
            return []
        samples = range(first, end, stride)
        return [
            {"sample": sample, **{name: _finite(float(values[i])) for name, values in read.items()}}
            for i, sample in enumerate(samples)
        ]

    async def _send(self, topic: str, table: Mapping[str, Any], time_ns: int = 0) -> None:
        """Send a message to its subscriptions.

        :param time_ns: 0: now.
        """
        payload = json.dumps(table, allow_nan=False).encode()
        for number, channel in list(self._subscribed.items()):
            if self._channels[channel].topic == topic:
                await self._put(struct.pack("<BIQ", _MESSAGE_DATA, number, time_ns or time.time_ns()) + payload)

    async def _tell(self, operation: str, **table: Any) -> None:
        await self._put(json.dumps({"op": operation, **table}))

    async def _put(self, message: str | bytes) -> None:
        try:
            async with asyncio.timeout(self._slow_s):
                await self._socket.send(message)
        except TimeoutError:
            self._socket.transport.abort()
            raise


def _finite(value: float) -> float | None:
    return value if abs(value) < float("inf") else None


_OPERATIONS: Mapping[str, Any] = {
    "subscribe": Viewer._subscribe,  # noqa: SLF001 - its own table
    "unsubscribe": Viewer._unsubscribe,  # noqa: SLF001
    "getParameters": Viewer._get_parameters,  # noqa: SLF001
    "setParameters": Viewer._set_parameters,  # noqa: SLF001
    "subscribeParameterUpdates": Viewer._watch_parameters,  # noqa: SLF001
    "unsubscribeParameterUpdates": Viewer._unwatch_parameters,  # noqa: SLF001
}
