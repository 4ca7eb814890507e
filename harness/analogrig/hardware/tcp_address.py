"""TCP addresses of instruments: HOST[:PORT]."""

from __future__ import annotations

import socket
from urllib.parse import urlsplit


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
