"""Framing of messages, and firmwares with protocols of their own behind a pseudo-terminal."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from analogrig.answers import Answers, Samples
from analogrig.devices.registry import from_table
from analogrig_lines.framing import FrameLayout
from tests.harness.own_protocols import DESCRIPTIONS
from tests.harness.processes import LONG_S

FIRMWARE = Path(__file__).with_name("own_protocols.py")


@contextlib.contextmanager
def firmware(protocol: str) -> Iterator[str]:
    """Terminal behind which the firmware runs."""
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    with subprocess.Popen([sys.executable, FIRMWARE, protocol], stdin=ours, stdout=ours) as process:
        os.close(ours)
        try:
            yield os.ttyname(theirs)
        finally:
            process.kill()
            os.close(theirs)


def described(protocol: str, **changes: Any) -> Any:
    table = {"kind": "frames", "name": "bob", "echo": "index", "timeout_s": LONG_S, **DESCRIPTIONS[protocol], **changes}
    return from_table(table, "bob.toml")


def record(n: int, missing: tuple[int, ...] = ()) -> Samples:
    index = np.arange(n)
    return Samples(0, (100 + index).astype(np.uint16), (20 * index).astype(np.uint16), ~np.isin(index, missing))


@pytest.mark.parametrize("protocol", DESCRIPTIONS)
def test_protocol_of_its_own_is_a_device_file(protocol: str) -> None:
    samples = record(300, missing=(7, 8))
    with firmware(protocol) as url, described(protocol, url=url).connect() as device:
        device.start()
        answers: list[Answers] = list(device.play([samples]))
        device.stop()
    (found,) = answers
    assert found.theta is not None
    a1 = samples.u.astype(float) + samples.y
    assert found.theta[samples.valid, 0].tolist() == a1[samples.valid].tolist()
    assert [alarm.index for alarm in found.alarms][:1] == [5]
    assert np.flatnonzero(found.flags).tolist() == [7, 8]


LAYOUTS: dict[str, tuple[dict[str, Any], int | None, bytes, list[bytes], bool]] = {
    "CRLF": ({"framing": "lines"}, None, b"a\r\nb\r\n", [b"a", b"b"], False),
    "LF": ({"framing": "lines"}, None, b"a\nb\nc", [b"a", b"b"], False),
    "CR": ({"framing": "lines"}, None, b"a\rb\rc", [b"a", b"b"], False),
    "an empty line between": ({"framing": "lines"}, None, b"a\r\n\r\nb\r\n", [b"a", b"", b"b"], False),
    "LF before CR": ({"framing": "lines"}, None, b"a\n\rb\n\r", [b"a", b"", b"b", b""], False),
    "COBS of zeros": ({"framing": "cobs"}, None, b"\1\1\0\3\x11\x22\2\x33\0", [b"\0", b"\x11\x22\0\x33"], False),
    "COBS, cut": ({"framing": "cobs"}, None, b"\5ab\0\2c\0", [b"c"], True),
    "SLIP of both special bytes": ({"framing": "slip"}, None, b"\xc0a\xdb\xdc\xdb\xdd\xc0", [b"a\xc0\xdb"], False),
    "SLIP, wrong escape": ({"framing": "slip"}, None, b"a\xdbb\xc0c\xc0", [b"c"], True),
    "length": ({"framing": "length"}, None, b"\2ab\1c", [b"ab", b"c"], False),
    "length that counts itself": ({"framing": "length", "length_extra": 1}, None, b"\3ab\2c", [b"ab", b"c"], False),
    "length after a header and noise": (
        {"framing": "length", "header": b"\xaa\x55", "length": "u16be"},
        None,
        b"\xaax\xaa\x55\0\2ab\x55\xaa\x55\0\1c",
        [b"ab", b"c"],
        True,
    ),
    "length of nothing is no frame": ({"framing": "length", "header": b"#"}, None, b"#\0#\1a", [b"a"], True),
    "delimiter of two bytes": ({"framing": "delimiter", "delimiter": b";;"}, None, b"a;b;;c;;", [b"a;b", b"c"], False),
    "delimiter inside a record": ({"framing": "delimiter", "delimiter": b"!"}, 3, b"a!b!!!!!", [b"a!b", b"!!!"], False),
    "short message of another kind": ({"framing": "delimiter", "delimiter": b"!"}, 3, b"a!bcd!", [b"a", b"bcd"], False),
    "records": ({"framing": "none"}, 2, b"abcde", [b"ab", b"cd"], False),
    "records behind a header": ({"framing": "none", "header": b"#$"}, 2, b"x#$ab#$cd#", [b"ab", b"cd"], True),
}


@pytest.mark.parametrize("step", [1, 2, 3, 100])
@pytest.mark.parametrize("name", LAYOUTS)
def test_frames_are_found_however_the_bytes_come(name: str, step: int) -> None:
    layout, content_n, stream, contents, is_damaged = LAYOUTS[name]
    framer = FrameLayout(**layout).framer(content_n)
    found = [each for at in range(0, len(stream), step) for each in framer.feed(stream[at : at + step])]
    assert found == contents
    assert bool(framer.dropped) == is_damaged


@pytest.mark.parametrize("name", LAYOUTS)
def test_framer_reads_what_it_writes(name: str) -> None:
    layout, content_n, *_ = LAYOUTS[name]
    contents = [bytes([i, 0, 0xC0, 0xDB, 255 - i][: content_n or 5]) for i in range(1, 200)]
    if layout["framing"] in ("lines", "delimiter"):
        contents = [b"%03d" % i for i in range(200)]
    framer = FrameLayout(**layout).framer(content_n)
    end = b"\n" if layout["framing"] == "lines" else b""
    assert framer.feed(b"".join(framer.frame(content + end) for content in contents)) == contents
    assert not framer.dropped
