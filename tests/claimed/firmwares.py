"""The three firmwares as devices: compiled, described in a device file, each with one planted defect."""

from __future__ import annotations

import binascii
import contextlib
import subprocess
import uuid
from collections.abc import Iterator
from pathlib import Path

from analogrig.devices.device import Device
from analogrig.devices.registry import open_dut
from tests.claimed.can_node import DBC, TOML, Node

HERE = Path(__file__).parent
CORE = HERE.parents[1] / "estimator_c" / "core"

JSON = r"""
kind = "exec"
arguments = ["PROGRAM", "BUG"]
send = "{{\"i\":{index:d},\"u\":{u:d},\"y\":{y:d}}}\n"
missing = "{{\"i\":{index:d},\"u\":null,\"y\":null}}\n"
receive = "{{\"i\":{index:d},\"a\":[{a1:g},{a2:g}],\"b\":[{b0:g},{b1:g},{b2:g}],\"d\":{d:g},\"e\":{innovation:g},\"s\":{statistic:g},\"alarm\":{alarm:d}}}\n"
echo = "index"
reset = "{\"cmd\":\"reset\"}\n"
reset_answer = "{\"ok\":\"reset\"}"

[estimator]
"""  # noqa: E501 - one line of the protocol


def _with_crc(kind: int) -> str:
    return f"{kind:02x} {binascii.crc_hqx(bytes([kind]), 0xFFFF).to_bytes(2, 'little').hex(' ')}"


_FLOATS = "".join(f"{{{name}:f32}}" for name in ("a1", "a2", "b0", "b1", "b2", "offset", "innovation", "statistic"))

COBS = f"""
kind = "exec"
arguments = ["PROGRAM", "BUG"]
format = "binary"
framing = "cobs"
checksum = "crc16"
send = "01 {{index:u16}}{{u:u16}}{{y:u16}}{{valid:u8}}{{checksum:u16}}"
receive = "81 {{index:u16}}{_FLOATS}{{alarm:u8}}{{checksum:u16}}"
echo = "index"
reset = "{_with_crc(0x02)}"
reset_answer = "{_with_crc(0x82)}"

[estimator]
"""


class Firmwares:
    """The compiled firmwares in a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        for name in ("json_lines", "cobs"):
            options: list[str | Path] = [
                "-O1",
                "-Wall",
                "-Wextra",
                "-Werror",
                "-ffp-contract=off",
                f"-I{CORE}",
                "-o",
                folder / name,
            ]
            subprocess.run(["gcc", *options, HERE / f"{name}.c", CORE / "est.c", "-lm"], check=True)

    @contextlib.contextmanager
    def open(self, firmware: str, bug: int = 0) -> Iterator[Device]:
        """Device of the firmware ``json``, ``cobs`` or ``can`` with the planted defect of this number; 0: none."""
        with contextlib.ExitStack() as stack:
            file, allow = self._can(stack, bug) if firmware == "can" else self._program(firmware, bug)
            yield stack.enter_context(open_dut(str(file), allow=[allow]))

    def _program(self, firmware: str, bug: int) -> tuple[Path, str]:
        program = str(self._folder / {"json": "json_lines", "cobs": "cobs"}[firmware])
        file = self._folder / f"{firmware}-{bug}.toml"
        text = {"json": JSON, "cobs": COBS}[firmware]
        file.write_text(text.replace("PROGRAM", program).replace("BUG", str(bug)), encoding="utf-8")
        return file, program

    def _can(self, stack: contextlib.ExitStack, bug: int) -> tuple[Path, str]:
        channel = f"node-{uuid.uuid4().hex}x"
        (self._folder / "node.dbc").write_text(DBC, encoding="utf-8")
        file = self._folder / f"can-{bug}.toml"
        file.write_text(TOML.replace("CHANNEL", channel), encoding="utf-8")
        stack.enter_context(Node(channel, bug))
        return file, f"virtual/{channel}"
