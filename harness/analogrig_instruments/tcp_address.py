"""Instruments over TCP: their addresses, HOST[:PORT], and connections whose errors name them."""

from __future__ import annotations

import contextlib
import socket
from urllib.parse import urlsplit

from analogrig.errors import RigClosed, RigTimeout


class InstrumentSocket:
    """TCP connection to an instrument."""

    def __init__(self, host: str, port: int, timeout_s: float) -> None:
        """:raises RigError: the connection failed."""
        self.name = place_of(host, port)
        try:
            self._socket = socket.create_connection((host, port), timeout_s)
        except TimeoutError as error:
            raise RigTimeout(f"instrument {self.name}: no connection within {timeout_s:g} s") from error
        except OSError as error:
            raise RigClosed(f"instrument {self.name}: cannot be reached: {error.strerror or error}") from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, data: bytes, what: str, within_s: float) -> None:
        """Send the bytes of the command ``what``."""
        try:
            self._socket.settimeout(within_s)
            self._socket.sendall(data)
        except TimeoutError as error:
            raise RigTimeout(f"instrument {self.name}: accepted no command for {within_s:g} s") from error
        except OSError as error:
            raise self._lost(what, error) from error

    def receive(self, most: int, what: str, within_s: float) -> bytes:
        """Next bytes of the answer to ``what``, at most ``most``.

        :raises TimeoutError: none came in time.
        """
        self._socket.settimeout(within_s)
        try:
            received = self._socket.recv(most)
        except TimeoutError:
            raise
        except OSError as error:
            raise self._lost(what, error) from error
        if not received:
            raise RigClosed(f"instrument {self.name}: connection closed at {what}")
        return received

    def _lost(self, what: str, error: OSError) -> RigClosed:
        return RigClosed(f"instrument {self.name}: connection lost at {what}: {error.strerror or error}")

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._socket.close()


def host_and_port(address: str, default_port: int) -> tuple[str, int]:
    """Host and port of a valid address."""
    split = urlsplit(f"//{address}")
    return split.hostname or "", default_port if split.port is None else split.port


def tcp_place(address: str, default_port: int) -> str:
    """Host and port as one text; empty if the address is malformed."""
    try:
        split, (host, port) = urlsplit(f"//{address}"), host_and_port(address, default_port)
    except ValueError:
        return ""
    if not (host and port) or split.path or split.query or split.fragment or split.username or " " in address:
        return ""
    return place_of(host, port)


def resolved_places(place: str) -> list[str]:
    """A place with each address of its host. One that is no host and port, or that has no address, stays as it is."""
    host, port = host_and_port(place, 0)
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM) if port else []
    except (OSError, UnicodeError):
        found = []
    return sorted({place_of(str(address[0]), port) for *_, address in found}) or [place.lower()]


def place_of(host: str, port: int) -> str:
    """Host and port as one text, an IPv6 address in brackets."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
