"""TCP addresses of instruments: HOST[:PORT]."""

from __future__ import annotations

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
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
