"""Firmwares with protocols of their own, on the standard input and output of a process.

They share no code with the harness: framing and checksums are written here from their definitions. The estimate a1 of a
sample is u + y, and it raises its alarm where u is 105.

    python3 own_protocols.py PROTOCOL
"""

from __future__ import annotations

import os
import struct
import sys
from collections.abc import Callable, Iterator
from typing import Any


def crc(data: bytes, width: int, poly: int, init: int, *, reflect: bool, xor_out: int = 0) -> int:
    """CRC bit by bit; ``poly`` is not reflected."""
    register, top = init, 1 << (width - 1)
    for byte in data:
        bits = [byte >> i & 1 for i in (range(8) if reflect else range(7, -1, -1))]
        for bit in bits:
            has_carry = bool(register & top) != bool(bit)
            register = (register << 1) & ((1 << width) - 1)
            register ^= poly if has_carry else 0
    if reflect:
        register = int(f"{register:0{width}b}"[::-1], 2)
    return register ^ xor_out


def modbus(data: bytes) -> bytes:
    return struct.pack("<H", crc(data, 16, 0x8005, 0xFFFF, reflect=True))


def ccitt(data: bytes) -> bytes:
    return struct.pack(">H", crc(data, 16, 0x1021, 0xFFFF, reflect=False))


def maxim(data: bytes) -> bytes:
    return bytes([crc(data, 8, 0x31, 0, reflect=True)])


def ethernet(data: bytes) -> bytes:
    return struct.pack("<I", crc(data, 32, 0x04C11DB7, 0xFFFFFFFF, reflect=True, xor_out=0xFFFFFFFF))


def xor(data: bytes) -> bytes:
    value = 0
    for byte in data:
        value ^= byte
    return bytes([value])


def unchecked(data: bytes) -> bytes:  # noqa: ARG001
    return b""


def stuff(data: bytes) -> bytes:
    """COBS of at most 254 bytes."""
    out = b""
    for piece in data.split(b"\0"):
        out += bytes([len(piece) + 1]) + piece
    return out


def unstuff(data: bytes) -> bytes:
    out, at = b"", 0
    while at < len(data):
        out += data[at + 1 : at + data[at]] + b"\0"
        at += data[at]
    return out[:-1]


def escape(data: bytes) -> bytes:
    return b"".join({0xC0: b"\xdb\xdc", 0xDB: b"\xdb\xdd"}.get(byte, bytes([byte])) for byte in data)


def unescape(data: bytes) -> bytes:
    return data.replace(b"\xdb\xdc", b"\xc0").replace(b"\xdb\xdd", b"\xdb")


def read_until(end: bytes) -> Iterator[bytes]:
    """Pieces of the input between two end bytes."""
    data = b""
    while received := os.read(0, 4096):
        *pieces, data = (data + received).split(end)
        yield from filter(None, pieces)


def read_sizes(head: int, size_of: Callable[[bytes], int]) -> Iterator[bytes]:
    """Frames whose size follows from their first ``head`` bytes."""
    data = b""
    while received := os.read(0, 4096):
        data += received
        while len(data) >= head and len(data) >= size_of(data):
            frame, data = data[: size_of(data)], data[size_of(data) :]
            yield frame


def write(data: bytes) -> None:
    """Write in two pieces, as a line delivers them."""
    os.write(1, data[: len(data) // 2])
    os.write(1, data[len(data) // 2 :])


def checked(frame: bytes, check: Callable[[bytes], bytes]) -> bytes:
    """Content of a frame whose checksum is right; a firmware sends nothing to any other."""
    n = len(check(b""))
    content, got = frame[: len(frame) - n], frame[len(frame) - n :]
    return content if got == check(content) else b""


def answers(frames: Iterator[bytes], sample: str, answer: str, check: Callable[[bytes], bytes]) -> Iterator[bytes]:
    """Answers to samples ``sample`` (index, u, y) of ``struct``, in the format ``answer`` (index, alarm, a1)."""
    for frame in frames:
        content = checked(frame, check)
        if content:
            index, u, y = struct.unpack(sample, content)
            out = struct.pack(answer, index, u == 105, u + y)
            yield out + check(out)


def cobs_modbus() -> None:
    for out in answers(map(unstuff, read_until(b"\0")), "<HHH", "<HBf", modbus):
        write(stuff(out) + b"\0")


def cobs_crc32() -> None:
    for out in answers(map(unstuff, read_until(b"\0")), "<HHH", "<HBf", ethernet):
        write(b"\0" + stuff(out) + b"\0")


def slip_ccitt() -> None:
    for out in answers(map(unescape, read_until(b"\xc0")), ">HHH", ">HBf", ccitt):
        write(b"\xc0" + escape(out) + b"\xc0")


def slip_plain() -> None:
    for out in answers(map(unescape, read_until(b"\xc0")), "<BHH", "<BBd", unchecked):
        write(escape(out) + b"\xc0")


def length_maxim() -> None:
    frames = (frame[1:] for frame in read_sizes(1, lambda data: 1 + data[0]))
    for out in answers(frames, "<HHH", "<HBf", maxim):
        write(bytes([len(out)]) + out)


def header_length_over_all() -> None:
    """AA 55, a big-endian length that leaves out the CRC, content, CRC over all before it."""
    for frame in read_sizes(4, lambda data: 6 + (data[2] << 8) + data[3]):
        content = checked(frame, ccitt)[4:]
        if content:
            index, u, y = struct.unpack(">HHH", content)
            out = struct.pack(">HBf", index, u == 105, u + y)
            head = b"\xaa\x55" + struct.pack(">H", len(out))
            write(head + out + ccitt(head + out))


def delimiter_xor() -> None:
    """STX, type byte, content with any bytes, XOR, ETX: the length shows where it ends."""
    for frame in read_sizes(1, lambda _: 10):
        content = checked(frame[1:-1], xor)[1:]
        if content:
            index, u, y = struct.unpack("<HHH", content)
            out = b"A" + struct.pack("<HBf", index, u == 105, u + y)
            write(b"\x02" + out + xor(out) + b"\x03")


def fixed_header() -> None:
    """A sync word and a record of fixed length."""
    for frame in read_sizes(1, lambda _: 8):
        index, u, y = struct.unpack("<HHH", frame[2:])
        write(b"noise"[: index % 3] + b"\xbe\xef" + struct.pack("<HBf", index, u == 105, u + y))


def json_lines() -> None:
    import json

    for line in read_until(b"\n"):
        told = json.loads(line)
        alarm = told["u"] == 105
        text = json.dumps({"k": told["k"], "alarm": alarm, "a1": float(told["u"] + told["y"]), "armed": True})
        write(text.encode() + b"\r\n")


def states() -> None:
    """A state word, and lines that end with CR alone."""
    for line in read_until(b"\r"):
        index, u, y = map(int, line.split(b","))
        write(f"{index} {'FAULT' if 105 <= u < 107 else 'RUN'} {u + y}\r".encode())


def prompt() -> None:
    """A shell: a prompt when it awaits a sample, and an echo of what it received."""
    write(b"\r\nshell 1.2\r\n> ")
    for line in read_until(b"\n"):
        index, u, y = map(int, line.split(b","))
        write(line + f"\r\n{index};{int(u == 105)};{u + y}\r\n> ".encode())


def json_in_cobs() -> None:
    for frame in map(unstuff, read_until(b"\0")):
        index, u, y = map(int, frame.split(b","))
        write(stuff(f'{{"k":{index},"alarm":{"true" if u == 105 else "false"},"a1":{u + y}}}'.encode()) + b"\0")


HEX = "{index:u16}{u:u16}{y:u16}"
BACK = "{index:u16}{alarm:u8}{a1:f32}"
BIG, BIG_BACK = "{index:u16be}{u:u16be}{y:u16be}", "{index:u16be}{alarm:u8}{a1:f32be}"

DESCRIPTIONS: dict[str, dict[str, Any]] = {
    "cobs_modbus": {
        "send": HEX + "{checksum:u16}",
        "receive": BACK + "{checksum:u16}",
        "checksum": "CRC-16/MODBUS",
    },
    "cobs_crc32": {"send": HEX + "{checksum:u32}", "receive": BACK + "{checksum:u32}", "checksum": "CRC-32"},
    "slip_ccitt": {
        "framing": "slip",
        "send": BIG + "{checksum:u16be}",
        "receive": BIG_BACK + "{checksum:u16be}",
        "checksum": "CRC-16/CCITT-FALSE",
    },
    "slip_plain": {
        "framing": "slip",
        "send": "{index:u8}{u:u16}{y:u16}",
        "receive": "{index:u8}{alarm:u8}{a1:f64}",
    },
    "length_maxim": {
        "framing": "length",
        "send": HEX + "{checksum:u8}",
        "receive": BACK + "{checksum:u8}",
        "checksum": "CRC-8/MAXIM",
    },
    "header_length_over_all": {
        "framing": "length",
        "header": "aa 55",
        "length": "u16be",
        "length_extra": -2,
        "checksum": "crc16",
        "checksum_over": "header",
        "send": BIG + "{checksum:u16be}",
        "receive": BIG_BACK + "{checksum:u16be}",
    },
    "delimiter_xor": {
        "framing": "delimiter",
        "header": "02",
        "delimiter": "03",
        "checksum": "xor",
        "send": "53" + HEX + "{checksum:u8}",
        "receive": "41" + BACK + "{checksum:u8}",
    },
    "fixed_header": {"framing": "none", "header": "beef", "send": HEX, "receive": BACK},
    "json_lines": {
        "kind": "lines",
        "send": '{{"k":{index:d},"u":{u:d},"y":{y:d}}}\n',
        "receive": '{{"k":{index:d},"alarm":{alarm:b},"a1":{a1:g},"armed":{armed:b}}}\n',
    },
    "states": {
        "kind": "lines",
        "send": "{index:d},{u:d},{y:d}\r",
        "receive": "{index:d} {alarm:s} {a1:g}\n",
        "alarm_is": ["FAULT"],
    },
    "prompt": {
        "kind": "lines",
        "send": "{index:d},{u:d},{y:d}\n",
        "receive": "{index:d};{alarm:d};{a1:g}\n",
        "prompt": "> ",
        "starting_s": 20.0,
    },
    "json_in_cobs": {
        "kind": "lines",
        "framing": "cobs",
        "send": "{index:d},{u:d},{y:d}",
        "receive": '{{"k":{index:d},"alarm":{alarm:b},"a1":{a1:g}}}',
    },
}
"""Device file of each firmware, without the port."""


if __name__ == "__main__":
    globals()[sys.argv[1]]()
