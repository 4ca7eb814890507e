"""Endpoint of other viewers, by a client written from the specification of foxglove.websocket.v1.

The specification is docs/spec.md of github.com/foxglove/ws-protocol.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from websockets.asyncio.client import ClientConnection

from analogrig_live import foxglove
from analogrig_live.bench_server import BenchServer
from tests.harness.live.benches import LiveBench
from tests.harness.live.test_server import open_client, played

SUBPROTOCOL = "foxglove.websocket.v1"


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[BenchServer]:
    with LiveBench(tmp_path) as server:
        yield server


def open_viewer(bench: BenchServer) -> Any:
    """Connection of a viewer outside a browser: it has no origin."""
    return open_client(bench, "/foxglove", origin=None)


async def text(socket: ClientConnection, operation: str) -> dict[str, Any]:
    """Next message in JSON with this operation."""
    while True:
        message = await socket.recv()
        if isinstance(message, str):
            table: dict[str, Any] = json.loads(message)
            assert isinstance(table["op"], str)
            if table["op"] == operation:
                return table


async def data(socket: ClientConnection, subscription: int) -> tuple[int, dict[str, Any]]:
    """Next Message Data of a subscription: its time in ns, and its payload."""
    while True:
        message = await socket.recv()
        if isinstance(message, bytes):
            operation, number, time_ns = struct.unpack_from("<BIQ", message)
            assert operation == 1
            if number == subscription:
                return int(time_ns), json.loads(message[13:])


def test_server_selects_the_subprotocol_and_introduces_itself(bench: BenchServer) -> None:
    async def work() -> None:
        async with open_viewer(bench) as socket:
            assert socket.subprotocol == SUBPROTOCOL
            info = json.loads(await socket.recv())
            assert info["op"] == "serverInfo"
            assert isinstance(info["name"], str)
            assert set(info["capabilities"]) == {"parameters", "parametersSubscribe"}
            assert "supportedEncodings" not in info  # only of servers that clients publish to
            advertised = json.loads(await socket.recv())
            assert advertised["op"] == "advertise"
            numbers = [channel["id"] for channel in advertised["channels"]]
            assert len(set(numbers)) == len(numbers)
            for channel in advertised["channels"]:
                assert channel["encoding"] == "json"
                assert channel["schemaEncoding"] == "jsonschema"
                assert channel["schemaName"]
                assert json.loads(channel["schema"])["type"] == "object"

    played(work)


def test_subscribed_channels_send_what_their_schemas_describe(bench: BenchServer) -> None:
    async def work() -> None:
        async with open_viewer(bench) as socket:
            channels = {each["topic"]: each for each in (await text(socket, "advertise"))["channels"]}
            wanted = [
                {"id": 70 + i, "channelId": channels[topic]["id"]} for i, topic in enumerate(("/signals", "/state"))
            ]
            await socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
            before_ns, first = await data(socket, 70)
            after_ns, second = await data(socket, 70)
            schema = json.loads(channels["/signals"]["schema"])["properties"]
            assert set(first) == set(schema)
            assert second["sample"] > first["sample"]
            assert before_ns > 1_600_000_000_000_000_000
            apart_s = (second["sample"] - first["sample"]) / bench.session.sample_rate_hz
            assert after_ns - before_ns == pytest.approx(1e9 * apart_s, abs=1000)
            _, state = await data(socket, 71)
            assert state["mode"] == "OPERATE"
            await socket.send(json.dumps({"op": "unsubscribe", "subscriptionIds": [70, 71]}))
            await socket.send(json.dumps({"op": "getParameters", "parameterNames": [], "id": "end"}))
            await text(socket, "parameterValues")
            await socket.send(json.dumps({"op": "getParameters", "parameterNames": [], "id": "later"}))
            assert isinstance(await socket.recv(), str)  # no data after the end of the subscriptions

    played(work)


def test_pots_are_parameters_that_can_be_read_set_and_watched(bench: BenchServer) -> None:
    async def work() -> None:
        async with open_viewer(bench) as socket, open_viewer(bench) as other:
            await other.send(json.dumps({"op": "subscribeParameterUpdates", "parameterNames": ["K"]}))
            await socket.send(json.dumps({"op": "getParameters", "parameterNames": [], "id": "one"}))
            answer = await text(socket, "parameterValues")
            assert answer["id"] == "one"
            assert {each["name"]: each["value"] for each in answer["parameters"]} == bench.session.values
            setting = {"name": "K", "value": 18000, "type": "float64"}
            await socket.send(json.dumps({"op": "setParameters", "parameters": [setting], "id": "two"}))
            answer = await text(socket, "parameterValues")
            assert answer["id"] == "two"
            assert [each["name"] for each in answer["parameters"]] == ["K"]
            while True:  # the first report may be of the value before
                told = await text(other, "parameterValues")
                if told["parameters"][0]["value"] == 18000.0:
                    break
            assert "id" not in told

    played(work)


def test_alarm_is_sent_with_its_latency(bench: BenchServer) -> None:
    async def work() -> None:
        async with open_viewer(bench) as socket:
            channels = {each["topic"]: each["id"] for each in (await text(socket, "advertise"))["channels"]}
            await socket.send(
                json.dumps({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": channels["/alarms"]}]})
            )
            while bench.session.ring.end < 2000:
                await socket.send(json.dumps({"op": "getParameters", "parameterNames": []}))
                await text(socket, "parameterValues")
            setting = {"name": "K", "value": 15000.0}
            await socket.send(json.dumps({"op": "setParameters", "parameters": [setting]}))
            alarm: dict[str, Any] = {"what": ""}
            while alarm["what"] != "K":
                _, alarm = await data(socket, 1)
            assert alarm["latency_n"] > 0

    played(work)


def test_viewer_whose_messages_fail_is_disconnected(bench: BenchServer, monkeypatch: pytest.MonkeyPatch) -> None:
    async def work() -> None:
        async with open_viewer(bench) as socket:
            channels = {each["topic"]: each["id"] for each in (await text(socket, "advertise"))["channels"]}
            monkeypatch.setattr(foxglove.Viewer, "_rows", lambda *_: 1 / 0)
            subscription = {"id": 1, "channelId": channels["/signals"]}
            await socket.send(json.dumps({"op": "subscribe", "subscriptions": [subscription]}))
            await socket.wait_closed()

    played(work)


def test_parameters_obey_the_limits_and_the_driver(bench: BenchServer) -> None:
    async def work() -> None:
        async with open_viewer(bench) as socket:
            beyond = {"op": "setParameters", "parameters": [{"name": "K", "value": 1e9}]}
            await socket.send(json.dumps(beyond))
            status = await text(socket, "status")
            assert status["level"] == 2
            assert "K must be" in status["message"]
            huge = 10**400  # beyond the range of a float
            for values in ({"K": 16000.0, "M": 1e9}, {"K": 16000.0, "M": huge}):
                settings = [{"name": name, "value": value} for name, value in values.items()]
                await socket.send(json.dumps({"op": "setParameters", "parameters": settings}))
                assert (await text(socket, "status"))["level"] == 2
            await socket.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": 1e999, "channelId": 1}]}))
            assert "as the protocol describes" in (await text(socket, "status"))["message"]
            assert bench.session.ordered_values["K"] == 24500.0
            setting = json.dumps({"op": "setParameters", "parameters": [{"name": "K", "value": 2e4}]})
            async with open_viewer(bench) as second:
                await second.send(setting)
                assert "another client drives" in (await text(second, "status"))["message"]
            async with open_client(bench):
                await socket.send(setting)
                assert "another client drives" in (await text(socket, "status"))["message"]

    played(work)
    assert bench.session.values["K"] != 2e4
