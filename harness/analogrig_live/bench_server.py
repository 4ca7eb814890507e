"""Web server of a live session: one page, its frames and commands, and the endpoint of other viewers.

    GET /?token=T         the page
    /live?token=T         WebSocket of the page: frames and states out, views and commands in
    /foxglove?token=T     WebSocket with the subprotocol foxglove.websocket.v1 (foxglove.py)

One client of the page drives, the others watch; a viewer sets pots only while no page drives. When the driver is
gone, the generator is switched off.

Messages of the page are JSON objects; frames are binary (scope.py).

    to the server   {"do": "view", "id": N, ...}     fields of View (scope.py)
                    {"do": "drive", "id": N}         drive if no other client does
                    {"do": COMMAND, "id": N, ...}    names and fields of commands (commands.py)
    to the page     {"bench": {...}}                 first: names, limits and drawing (panel.py)
                    {"state": {...}}                 state of the bench (panel.py) and role of the client
                    {"re": N, "ok": true}            message N was accepted
                    {"re": N, "error": "..."}        message N was refused

Limits of a client:

    address  the token, a Host of this server, an Origin of the page (viewers outside a browser have none)
    memory   messages of MOST_MESSAGE_BYTES, one frame on its way, the buffers of the connection
    time     a client that accepts no data for SLOW_S, or answers no ping for SILENT_S, is dropped
    place    one of MOST_CLIENTS; before it is let in, one of MOST_SOCKETS, the oldest of which gives way to a newcomer
    work     watchers get their frames one after another, for at most half of the time; a message each WATCHER_PAUSE_S
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import json
import logging
import secrets
import socket as socketlib
import time
from collections.abc import AsyncIterator, Collection
from dataclasses import dataclass, field
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import SplitResult, parse_qs, quote, urlsplit

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from analogrig import AnalogrigError, ConfigurationError
from analogrig.config import build
from analogrig.reporting import PLOTS, assemble_page
from analogrig.wording import one_line
from analogrig_live import foxglove
from analogrig_live.commands import command_of
from analogrig_live.panel import bench_table, state_table
from analogrig_live.scope import Screen, View, signals_of

if TYPE_CHECKING:
    from analogrig_live.live_session import LiveSession

MOST_CLIENTS = 16
MOST_SOCKETS = 4 * MOST_CLIENTS
"""Open sockets, also of those that send no request."""
MOST_MESSAGE_BYTES = 8192
BUFFERED_BYTES = 262_144
SLOW_S = 10.0
PING_S, SILENT_S = 1.0, 4.0
"""Time between two pings, and the longest time until their answer: a driver that has stopped is gone soon."""
WATCHER_PAUSE_S = 0.005
"""Least time between two messages of a client that does not drive."""
FRAME_S = 1.0 / 50.0
"""Time between two frames."""
LEAST_PAUSE_S = 0.002
"""Least time between the work for two frames, which is left to other clients."""
STATE_S = 0.2
"""Time between two states while the session plays."""
_PAGE = Path(__file__).parent / "page"
_LIVE, _FOXGLOVE = "/live", "/foxglove"

_log = logging.getLogger(__name__)


@dataclass(eq=False)
class _PageClient:
    """Client of the page."""

    socket: ServerConnection
    screen: Screen = field(default_factory=Screen)
    changed: asyncio.Event = field(default_factory=asyncio.Event)
    """Set when it must get the state at once."""


class _Connection(ServerConnection):
    """Connection that is noted as long as its socket is open. One too many replaces the oldest without a place."""

    def __init__(self, *arguments: Any, noted: dict[ServerConnection, bool], **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        self._noted = noted

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        if len(self._noted) >= MOST_SOCKETS:
            oldest = next(each for each, has_place in self._noted.items() if not has_place)
            del self._noted[oldest]  # at once, as it ends only after other newcomers may have come
            oldest.transport.abort()
        self._noted[self] = False

    def connection_lost(self, exc: Exception | None) -> None:
        self._noted.pop(self, None)
        super().connection_lost(exc)


class BenchServer:
    """Server of one session for the clients of its page and for other viewers."""

    def __init__(
        self,
        session: LiveSession,
        *,
        token: str = "",
        origins: Collection[str] = (),
        slow_s: float = SLOW_S,
        silent_s: float = SILENT_S,
        frame_s: float = FRAME_S,
    ) -> None:
        """Prepare the page.

        :param token: by default a random one.
        :param origins: origins of other pages that may use the endpoint of viewers.
        :param slow_s: a client that takes nothing for so long is dropped.
        :param silent_s: a client that answers no ping for so long is dropped.
        :param frame_s: least time between two frames.
        :raises RecordingError: uPlot is not installed by the build.
        :raises ConfigurationError: an origin is none.
        """
        for origin in origins:
            _check_origin(origin)
        self.session = session
        self.token = token or secrets.token_urlsafe(16)
        self._origins = frozenset(origins)
        self._slow_s, self._silent_s = slow_s, silent_s
        self._frame_s = frame_s
        self._clients: list[_PageClient] = []
        self._open: dict[ServerConnection, bool] = {}
        """Connections with an open socket; true for those that have a place."""
        self._driver: _PageClient | None = None
        self._setter: ServerConnection | None = None
        """Viewer that sets parameters while no client of the page drives."""
        self._server: Server | None = None
        self._hosts: frozenset[str] = frozenset()
        self._page = page()
        self._work = asyncio.Lock()
        """Held by the watcher that is being served."""

    @property
    def address(self) -> str:
        """URL of the page."""
        return f"http://{self._host}/?token={quote(self.token, safe='')}"

    async def listen(self, host: str = "127.0.0.1", port: int = 0) -> None:
        """Listen at an address of this machine; port 0: any free one.

        :raises ConfigurationError: listening there failed, or the address is that of all networks.
        """
        if host in ("", "0.0.0.0", "::"):  # noqa: S104 - refused
            raise ConfigurationError(f"cannot listen at {host!r}: name the one address that browsers open")
        try:
            self._server = await serve(
                self._serve_socket,
                host,
                port,
                process_request=self._answer_request,
                subprotocols=[foxglove.SUBPROTOCOL],  # type: ignore[list-item]  # a NewType of str
                select_subprotocol=_select_subprotocol,
                compression=None,
                max_size=MOST_MESSAGE_BYTES,
                max_queue=4,
                open_timeout=5,
                close_timeout=1,
                ping_interval=None,  # such a ping would wait as long as a full buffer does
                server_header=None,
                create_connection=functools.partial(_Connection, noted=self._open),  # type: ignore[arg-type]
            )
        except (OSError, UnicodeError) as error:
            reason = error.strerror if isinstance(error, OSError) and error.strerror else one_line(str(error))
            raise ConfigurationError(f"cannot listen at {host[:80]!r}:{port}: {reason}") from error
        for listening in self._server.sockets:  # accepted connections inherit the options
            listening.setsockopt(socketlib.SOL_SOCKET, socketlib.SO_RCVBUF, BUFFERED_BYTES)
            listening.setsockopt(socketlib.SOL_SOCKET, socketlib.SO_SNDBUF, BUFFERED_BYTES)
        number = next(iter(self._server.sockets)).getsockname()[1]
        name = f"[{host}]" if ":" in host else host
        self._host = f"{name}:{number}"
        self._hosts = frozenset(f"{each}:{number}" for each in (name, "127.0.0.1", "localhost", "[::1]"))

    async def close(self) -> None:
        """Close all connections."""
        if self._server is not None:
            self._server.close()
            await self._server.wait_closed()

    # ---- requests

    def _answer_request(self, connection: ServerConnection, request: Request) -> Response | None:
        """Page, refusal, or None for a WebSocket that may open: it has a place from now on."""
        try:
            url = urlsplit(request.path)
        except ValueError:
            return connection.respond(HTTPStatus.BAD_REQUEST, "the address is malformed\n")
        refusal = self._refusal(url, request.headers)
        if refusal is None and url.path == _FOXGLOVE and not _offers_subprotocol(request.headers):
            refusal = HTTPStatus.BAD_REQUEST, f"the subprotocol {foxglove.SUBPROTOCOL} is needed\n"
        if refusal is not None:
            return connection.respond(*refusal)
        if url.path == "/":
            return _page_response(self._page)
        if connection in self._open:
            self._open[connection] = True
        return None

    def _refusal(self, url: SplitResult, headers: Headers) -> tuple[HTTPStatus, str] | None:
        """Status and reason if the request is refused."""
        token = parse_qs(url.query).get("token", [""])[0]
        if _one(headers, "Host") not in self._hosts:
            return HTTPStatus.FORBIDDEN, "this Host is not served\n"
        if url.path not in ("/", _LIVE, _FOXGLOVE):
            return HTTPStatus.NOT_FOUND, "there is nothing here\n"
        if not secrets.compare_digest(token.encode(), self.token.encode()):
            return HTTPStatus.FORBIDDEN, "open the address that analogrig bench has printed\n"
        if url.path != "/" and not self._is_welcome(_one(headers, "Origin"), url.path):
            return HTTPStatus.FORBIDDEN, "this Origin is not served\n"
        if url.path != "/" and sum(self._open.values()) >= MOST_CLIENTS:
            return HTTPStatus.SERVICE_UNAVAILABLE, f"there are {MOST_CLIENTS} clients already\n"
        return None

    def _is_welcome(self, origin: str | None, path: str) -> bool:
        own = {f"http://{host}" for host in self._hosts}
        return origin in own or (path == _FOXGLOVE and (origin is None or origin in self._origins))

    async def _serve_socket(self, socket: ServerConnection) -> None:
        path = "" if socket.request is None else urlsplit(socket.request.path).path
        pinging = asyncio.create_task(self._drop_when_silent(socket))
        pinging.add_done_callback(lambda _: socket.transport.abort())
        with contextlib.suppress(ConnectionClosed, TimeoutError):
            if path == _FOXGLOVE:
                try:
                    viewer = foxglove.Viewer(
                        socket,
                        self.session,
                        may_set=lambda: self._may_set(socket),
                        work=self._share_work,
                        slow_s=self._slow_s,
                        pause_s=WATCHER_PAUSE_S,
                    )
                    await viewer.serve()
                finally:
                    self._setter = None if self._setter is socket else self._setter
            else:
                await self._serve_client(_PageClient(socket))

    async def _drop_when_silent(self, socket: ServerConnection) -> None:
        """Return once a client has not answered a ping for ``silent_s``, or has gone."""
        with contextlib.suppress(ConnectionClosed, TimeoutError):
            while True:
                await asyncio.sleep(PING_S)
                async with asyncio.timeout(self._silent_s):
                    await (await socket.ping())

    def _may_set(self, viewer: ServerConnection) -> bool:
        """True if a viewer may set parameters: it is the one that does."""
        if self._driver is None and self._setter is None:
            self._setter = viewer
        return self._driver is None and self._setter is viewer

    # ---- clients of the page

    async def _serve_client(self, client: _PageClient) -> None:
        self._clients.append(client)
        self._appoint(client)
        sending = asyncio.create_task(self._send_all(client))
        sending.add_done_callback(lambda _: client.socket.transport.abort())
        try:
            async for message in client.socket:
                await self._send(client, json.dumps(self._reply(client, message)))
                if client is not self._driver:
                    await asyncio.sleep(WATCHER_PAUSE_S)
        finally:
            sending.cancel()
            for error in await asyncio.gather(sending, return_exceptions=True):
                if isinstance(error, Exception):
                    _log.error("frames have ended", exc_info=error)
            self._clients.remove(client)
            if client is self._driver:
                self._driver = None
                self.session.make_safe()
            self._wake_all()

    def _appoint(self, client: _PageClient) -> None:
        """Let a client drive if nobody does."""
        if self._driver is None:
            self._driver = client
        self._wake_all()

    def _wake_all(self) -> None:
        for client in self._clients:
            client.changed.set()

    def _reply(self, client: _PageClient, message: str | bytes) -> dict[str, Any]:
        """Carry a message out, and return the answer."""
        number: Any = None
        try:
            table = _table_of(message)
            number = table.pop("id", None)
            self._carry_out(client, table.pop("do", None), table)
        except AnalogrigError as error:
            return {"re": number, "error": one_line(str(error))}
        return {"re": number, "ok": True}

    def _carry_out(self, client: _PageClient, name: object, table: dict[str, Any]) -> None:
        """:raises ConfigurationError: the message is wrong, or this client does not drive."""
        if name == "view":
            view = build(View, table, "view")
            known = signals_of(self.session)
            for signal in (*view.signals, view.trigger.source):
                if signal not in known:
                    raise ConfigurationError(f"no signal is called {signal!r}: there are {', '.join(known)}")
            client.screen.change(view)
        elif name == "drive":
            if table:
                raise ConfigurationError(f"drive: unknown key {next(iter(table))!r}")
            if self._driver not in (None, client):
                raise ConfigurationError("another client drives")
            self._appoint(client)
        elif client is not self._driver:
            raise ConfigurationError("this page watches: another client drives")
        else:
            self.session.do(command_of(name, table))
            self._wake_all()

    async def _send_all(self, client: _PageClient) -> None:
        """Send the bench, then frames and states as fast as the client takes them."""
        try:
            await self._send(client, json.dumps({"bench": bench_table(self.session)}))
            told_s, version = 0.0, -1
            while True:
                began_s = time.monotonic()
                async with self._share_work() if client is not self._driver else contextlib.nullcontext():
                    frame = client.screen.frame(self.session)
                if frame is not None:
                    await self._send(client, frame)
                is_due = self.session.is_playing and time.monotonic() - told_s >= STATE_S
                if is_due or client.changed.is_set() or version != self.session.version:
                    client.changed.clear()
                    told_s, version = time.monotonic(), self.session.version
                    await self._send(client, json.dumps({"state": self._state(client)}))
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(max(LEAST_PAUSE_S, began_s + self._frame_s - time.monotonic())):
                        await client.changed.wait()
        except ConnectionClosed:
            pass
        except TimeoutError:
            _log.info("a client accepts no data: dropped")

    @contextlib.asynccontextmanager
    async def _share_work(self) -> AsyncIterator[None]:
        """Work for one watcher at a time; afterwards, nothing is done for any for as long as it has taken."""
        async with self._work:
            began_s = time.monotonic()
            yield
            await asyncio.sleep(time.monotonic() - began_s)

    def _state(self, client: _PageClient) -> dict[str, Any]:
        roles = {"drives": client is self._driver, "driven": self._driver is not None, "clients": len(self._clients)}
        return state_table(self.session) | roles

    async def _send(self, client: _PageClient, message: str | bytes) -> None:
        """:raises TimeoutError: the client takes nothing."""
        async with asyncio.timeout(self._slow_s):
            await client.socket.send(message)


def page() -> bytes:
    """Page of the bench.

    :raises RecordingError: uPlot is not installed by the build.
    """
    text = assemble_page(
        _PAGE / "bench.html",
        (*PLOTS, _PAGE / "bench.js"),
        title="analogrig bench",
        more_styles=(_PAGE / "bench.css",),
        connect="'self'",
    )
    return text.encode()


def _page_response(body: bytes) -> Response:
    headers = Headers(
        {
            "Content-Type": "text/html; charset=utf-8",
            "Content-Length": str(len(body)),
            "Cache-Control": "no-store",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "X-Frame-Options": "DENY",
            "Connection": "close",
        }
    )
    return Response(HTTPStatus.OK.value, HTTPStatus.OK.phrase, headers, body)


def _one(headers: Headers, name: str) -> str | None:
    """Value of a header; a text that nothing equals if it comes several times."""
    values = headers.get_all(name)
    return None if not values else values[0] if len(values) == 1 else "\0"


def _check_origin(origin: str) -> None:
    """:raises ConfigurationError: an origin is not a scheme and a host, as browsers send it."""
    with contextlib.suppress(ValueError):
        url = urlsplit(origin)
        is_plain = origin.isascii() and origin.isprintable() and " " not in origin
        if is_plain and url.scheme and url.netloc and origin == f"{url.scheme}://{url.netloc}":
            return
    raise ConfigurationError(f"origin {origin[:80]!r}: expected one such as http://localhost:8080, without a path")


def _offers_subprotocol(headers: Headers) -> bool:
    offered = ",".join(headers.get_all("Sec-WebSocket-Protocol"))
    return foxglove.SUBPROTOCOL in map(str.strip, offered.split(","))


def _select_subprotocol(socket: ServerConnection, offered: Any) -> Any:
    """Subprotocol of an endpoint: that of viewers has one, that of the page has none."""
    path = "" if socket.request is None else urlsplit(socket.request.path).path
    return foxglove.SUBPROTOCOL if path == _FOXGLOVE and foxglove.SUBPROTOCOL in offered else None


def _table_of(message: str | bytes) -> dict[str, Any]:
    """:raises ConfigurationError: a message is not one JSON object."""
    try:
        table = json.loads(message, parse_constant=int) if isinstance(message, str) else None  # int refuses NaN
    except (ValueError, RecursionError):
        table = None
    if not isinstance(table, dict):
        raise ConfigurationError("a message is one JSON object")
    return table
