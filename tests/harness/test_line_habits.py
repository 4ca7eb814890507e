"""Habits of firmwares with a protocol of their own, and what the harness says of their faults."""

from __future__ import annotations

import binascii
import re
import struct
from collections.abc import Callable
from typing import Any

import anycrc
import numpy as np
import pytest
from cobs import cobs

from analogrig.answers import AlarmLevel, Answers, RaisedAlarm
from analogrig.catalogue import SteppedFlag
from analogrig.devices.registry import from_table
from analogrig.errors import ConfigurationError
from analogrig.run import LOST
from tests.harness.scripted_line import Firmware, opened, played

MISSING = int(SteppedFlag.MISSING)


def in_order(*answers: bytes | list[bytes]) -> Firmware:
    """Firmware with these answers, of which the last is repeated."""
    left = list(answers)
    return lambda _: left.pop(0) if len(left) > 1 else left[0]


HABITS: dict[str, tuple[dict[str, Any], Firmware, bytes | list[bytes]]] = {
    "CR and LF in two reads": ({}, in_order([b"0\r", b"\n"]), b""),
    "digit, CR and LF in three reads": ({}, in_order([b"0", b"\r", b"\n"]), b""),
    "CR and LF in two writes of the next answer": ({}, in_order(b"0\r", b"\n0\r"), b""),
    "CR alone": ({}, in_order(b"0\r"), b""),
    "LF alone, byte by byte": ({"receive": "{a1:d} {alarm:d}\n"}, in_order([b"1", b"2", b" ", b"0", b"\n"]), b""),
    "LF before CR": ({}, in_order(b"0\n\r"), b""),
    "LF before CR, in two reads": ({}, in_order([b"0\n", b"\r"]), b""),
    "an empty line before each answer": ({}, in_order(b"\r\n0\r\n"), b""),
    "line ends change": ({}, in_order(b"0\n", b"0\r\n", b"0\r", b"0\n"), b""),
    "template with CR LF": ({"receive": "{alarm:d}\r\n"}, in_order(b"0\r\n"), b""),
    "template with CR": ({"receive": "{alarm:d}\r", "send": "{u:d} {y:d}\r"}, in_order(b"0\r"), b""),
    "prompt before the answer": ({"prompt": "> "}, in_order(b"> 0\r\n"), b""),
    "prompt after the answer": ({"prompt": "> "}, in_order(b"0\r\n> "), b"> "),
    "prompt on a line of its own": ({"prompt": "ok>"}, in_order(b"0\r\nok>\r\n"), b""),
    "prompt without its space": ({"prompt": "> "}, in_order(b">0\r\n>"), b""),
    "prompt twice": ({"prompt": "> "}, in_order(b"> > 0\r\n"), b""),
    "prompt behind the answer on its line": ({"prompt": "$"}, in_order(b"0 $\r\n"), b""),
    "prompt and echo of the sample": ({"prompt": "# "}, in_order(b"100,0\r\n0\r\n# "), b"# "),
    "JSON true and false": ({"receive": '{{"alarm":{alarm:b}}}\n'}, in_order(b'{"alarm":false}\n'), b""),
    "JSON with spaces": (
        {"receive": '{{"a1":{a1:g},"alarm":{alarm:b}}}\n'},
        in_order(b'{ "a1": 1, "alarm": false }\n'),
        b"",
    ),
    "JSON without the spaces of the template": (
        {"receive": '{{ "a1": {a1:g}, "alarm": {alarm:b} }}\n'},
        in_order(b'{"a1":1.5,"alarm":False}\r\n'),
        b"",
    ),
    "truth values as 0 and 1": ({"receive": "{alarm:b};{armed:b}\n"}, in_order(b"0;1\n"), b""),
    "spaces of a table": ({"receive": "{a1:g} {alarm:d}\n"}, in_order(b"  1.25    0\r\n"), b""),
    "banner when the port is opened": ({"starting_s": 3.0}, in_order(b"0\r\n"), b"READY\r\n"),
    "late banner": ({"starting_s": 3.0}, in_order(b"0\r\n"), [b"boot\r\n", b"0\r\nREADY\r\n"]),
    "banner that looks like an answer": ({"starting_s": 2.0}, in_order(b"0\r\n"), b"0\r\n0\r\n"),
    "banner that is known": ({"starting_s": 3.0, "banner": "READY"}, in_order(b"0\r\n"), b"READY 1.2\r\n"),
    "prompt that ends the start": ({"starting_s": 3.0, "prompt": "> "}, in_order(b"0\r\n> "), b"hello\r\n> "),
    "state word": ({"receive": "{alarm:s}\n", "alarm_is": ("FAULT", "TRIP")}, in_order(b"RUN\n"), b""),
    "state number": ({"receive": "{alarm:d}\n", "alarm_is": (3,)}, in_order(b"1\n"), b""),
}


@pytest.mark.parametrize("name", HABITS)
def test_habit_costs_no_sample(name: str) -> None:
    changes, firmware, boot = HABITS[name]
    device = opened(firmware, boot, **changes)
    for _ in range(2):
        answers, error = played(device)
        assert error == ""
        assert answers is not None
        assert len(answers) == 12
        assert not answers.flags.any() or "armed" in changes.get("receive", "")
        assert len(answers.alarms) == 0
    assert not device.losses


def test_start_is_awaited_again_after_the_port_was_opened_anew() -> None:
    """Board that hears nothing in its first two seconds."""
    device = opened(in_order(b"0\r\n", b"", b"", b"0\r\n"), [b"", b"READY\r\n"], starting_s=2.0)
    assert "no answer" in played(device)[1]
    before_s = device._wire.clock
    answers, error = played(device)
    assert (error, answers is not None) == ("", True)
    assert device._wire.clock is not before_s
    assert device._wire.clock() >= 2.0


# ----------------------------------------------------------------------------------------- the right cause of a silence


def framed(content: bytes) -> bytes:
    return bytes(cobs.encode(content)) + b"\0"


def with_crc(model: str, order: str = "<H") -> Firmware:
    compute = anycrc.Model(model).calc
    return lambda _: framed(b"\1" + struct.pack(order, compute(b"\1")))


CHECKED = {"framing": "cobs", "receive": "{alarm:u8}{checksum:u16}", "checksum": "CRC-16/MODBUS"}

SILENCES: dict[str, tuple[dict[str, Any], Firmware, tuple[str, ...]]] = {
    "no byte": ({}, in_order(b""), ("no answer to sample 0", "no byte came")),
    "no byte of a frame": ({"framing": "cobs"}, in_order(b""), ("no byte came",)),
    "bytes without a frame": ({"framing": "cobs"}, in_order(b"\5ab\0"), ("8 bytes came, and no valid frame",)),
    "bytes without an end": ({"framing": "cobs"}, in_order(b"\5ab"), ("last frame was 05 61 62",)),
    "line without an end": ({}, in_order(b"0"), ("last line was '0'",)),
    "another template": ({}, in_order(b"ok 1\n"), ("'ok 1' does not match receive = '{alarm:d}\\n'",)),
    "record of another length": (
        {"framing": "cobs"},
        in_order(framed(b"\0\0\0")),
        ("00 00 00 does not match receive",),
    ),
    "CRC of another name": (CHECKED, with_crc("CRC16-KERMIT"), ("with a wrong CRC-16/MODBUS", "right as CRC16-KERMIT")),
    "CRC in the other byte order": (
        CHECKED,
        with_crc("CRC16-MODBUS", ">H"),
        ("they are right as CRC16-MODBUS, byte-swapped",),
    ),
    "no CRC at all": (CHECKED, in_order(framed(b"\0\1\2")), ("2 frames came with a wrong CRC-16", "another checksum?")),
    "text CRC of another name": (
        {"receive": "{alarm:d}*{checksum:x}\n", "checksum": "crc16"},
        in_order(b"0*%04x\n" % binascii.crc_hqx(b"0*", 0)),
        ("2 lines came with a wrong crc16: they are right as", "CRC16-XMODEM"),
    ),
    "a prompt that is not stated": ({}, in_order(b"> 0\r\n"), ("'> 0' does not match receive", 'set prompt = ">"')),
}  # fmt: skip


@pytest.mark.parametrize("name", SILENCES)
def test_silence_is_told_with_its_cause(name: str) -> None:
    changes, firmware, told = SILENCES[name]
    _, error = played(opened(firmware, **changes))
    for each in told:
        assert each in error, error


LOSSES: dict[str, tuple[dict[str, Any], Firmware, str]] = {
    "no answer": ({}, in_order(b"0\n", b"0\n", b"", b"0\n"), "no byte came within 1 s (sample 2)"),
    "another line": (
        {},
        in_order(b"0\n", b"busy\n", b"0\n"),
        "a line came that does not match receive (sample 1: 'busy')",
    ),
    "part of a line": ({}, in_order(b"0\n", b"1", b"\n0\n", b"0\n"), "a line came in part (sample 1: '1')"),
    "two of a kind": (
        {},
        in_order(b"0\n", b"", b"0\n", b"", b"0\n"),
        "no byte came within 1 s (2 samples from sample 1 on)",
    ),
    "wrong checksum": (
        {**CHECKED},
        in_order(with_crc("CRC16-MODBUS")(b""), framed(b"\0\1\2"), with_crc("CRC16-MODBUS")(b"")),
        "an answer came with a wrong checksum (sample 1: 00 01 02)",
    ),
    "broken frame": (
        {"framing": "cobs"},
        in_order(framed(b"\0"), b"\5a\0", framed(b"\0")),
        "bytes came that are no cobs frame (sample 1: 05 61 00)",
    ),
    "both": (
        {**CHECKED},
        in_order(with_crc("CRC16-MODBUS")(b""), b"\5a\0" + framed(b"\0\1\2"), with_crc("CRC16-MODBUS")(b"")),
        "bytes came that are no cobs frame and an answer came with a wrong checksum (sample 1: ",
    ),
    "later sample first": (
        {"send": "{index:d},{u:d}\n", "receive": "{index:d},{alarm:d}\n", "echo": "index", "window": 12},
        lambda sent: b"".join(line.split(b",")[0] + b",0\n" for line in sent.split() if not line.startswith(b"3,")),
        "a later sample was answered before it (sample 3)",
    ),
}


@pytest.mark.parametrize("name", LOSSES)
def test_lost_sample_is_told_with_its_cause(name: str) -> None:
    changes, firmware, told = LOSSES[name]
    device = opened(firmware, **changes)
    _, error = played(device)
    assert error == ""
    (loss,) = device.losses
    assert loss.startswith(told)


def test_answer_after_its_time_out_is_told_with_the_cure() -> None:
    changes: dict[str, Any] = {"send": "{index:d},{u:d}\n", "receive": "{index:d},{alarm:d}\n", "echo": "index"}
    device = opened(in_order(b"0,0\n", b"", b"1,0\n2,0\n", *(b"%d,0\n" % k for k in range(3, 12))), **changes)
    assert played(device)[1] == ""
    assert device.remarks == ("an answer came after its time-out of 1 s: raise timeout_s (sample 2)",)


# ------------------------------------------------------------------------------------------------------ levels, floats


LEVELS: dict[str, tuple[str, str, list[int]]] = {
    # alarms, flags (M missing, L lost, . none), alarms that are left
    "one row": ("00111100", "........", [2]),
    "two rows": ("01100110", "........", [1, 5]),
    "from the first sample": ("11100000", "........", [0]),
    "to the last sample": ("00000111", "........", [5]),
    "single alarms": ("01010101", "........", [1, 3, 5, 7]),
    "never": ("00000000", "........", []),
    "always": ("11111111", "........", [0]),
    "held over a missing sample": ("01101100", "...M....", [1]),
    "held over lost samples": ("01100110", "...LL...", [1]),
    "ended during missing samples": ("01100010", "...MM...", [1, 6]),
    "raised at a missing sample": ("00011000", "...M....", [3]),
    "missing from the start": ("00010000", "MMM.....", [3]),
}


@pytest.mark.parametrize("block", [1, 3, 8])
@pytest.mark.parametrize("name", LEVELS)
def test_level_is_one_alarm_in_blocks_of_any_length(name: str, block: int) -> None:
    raised, shown, expected = LEVELS[name]
    flags = np.array([{"M": MISSING, "L": LOST | MISSING, ".": 0}[each] for each in shown], np.uint8)
    level, found = AlarmLevel(), []
    for at in range(0, 8, block):
        rows = range(at, min(at + block, 8))
        alarms = tuple(RaisedAlarm(k) for k in rows if raised[k] == "1")
        found += [alarm.index for alarm in level.rises(Answers(flags[at : at + block], alarms), at).alarms]
    assert found == expected


def words_swapped(value: float) -> bytes:
    low, high = struct.unpack("<HH", struct.pack("<f", value))
    return struct.pack("<HH", high, low)


def test_event_that_comes_in_a_later_block_counts_once() -> None:
    level, flags = AlarmLevel(), np.zeros(3, np.uint8)
    assert len(level.rises(Answers(flags), 0).alarms) == 0
    late = level.rises(Answers(flags, (RaisedAlarm(2), RaisedAlarm(3), RaisedAlarm(5))), 3)
    assert [alarm.index for alarm in late.alarms] == [2, 5]


NUMBERS: dict[str, tuple[str, Callable[[int], bytes], tuple[int, ...], str]] = {
    "NaN at a missing sample": (
        "{alarm:u8}{a1:f32}{valid:u8}",
        lambda k: struct.pack("<BfB", 0, float("nan") if k == 4 else 1.0, 1),
        (4,),
        "a1 = nan for sample 4, which is not finite or too large for a float: the sample is missing",
    ),
    "NaN at any sample": (
        "{alarm:u8}{a1:f32}",
        lambda k: struct.pack("<Bf", 0, float("nan") if k == 4 else 1.0),
        (),
        "a1 = nan for sample 4, which is not finite or too large for a float$",
    ),
    "big-endian floats": (
        "{alarm:u8}{a1:f32}",
        lambda k: struct.pack(">Bf", 0, 1.0 + k / 7.0) if k != 5 else struct.pack(">BI", 0, 0x0000807F),
        (),
        "byte-swapped, such values are plausible: correct the byte order$",
    ),
    "word-swapped floats": (
        "{alarm:u8}{a1:f32}",
        lambda k: b"\0" + (words_swapped(3.0 + k / 7.0) if k != 5 else b"\0\0\x80\x7f"),
        (),
        "word-swapped.*such values are plausible",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", NUMBERS)
def test_number_that_is_not_finite_is_told_with_its_cause(name: str) -> None:
    receive, content, missing, told = NUMBERS[name]
    count = iter(range(100))
    send = "{u:u16}{y:u16}{valid:u8}"
    device = opened(lambda _: framed(content(next(count))), framing="cobs", send=send, receive=receive)
    error = played(device, 40, missing)[1]
    assert re.search(told, error), error


CAN: dict[str, Any] = {
    "kind": "can-dbc",
    "interface": "virtual",
    "channel": "c",
    "dbc": "x.dbc",
    "send": {"u": "M.U", "y": "M.Y"},
    "receive": {"alarm": "S.A"},
}
KINDS: dict[str, dict[str, Any]] = {
    "lines": {"kind": "lines", "url": "p"},
    "frames": {"kind": "frames", "url": "p"},
    "exec": {"kind": "exec", "arguments": ["p"]},
    "python": {"kind": "python", "factory": "m:C"},
    "library": {"kind": "library", "library": "l.so"},
    "can-dbc": CAN,
    "serial": {"kind": "serial", "url": "p"},
    "host": {"kind": "host"},
    "inproc": {"kind": "inproc"},
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_device_can_hold_its_alarm(kind: str) -> None:
    described = from_table({"name": "bob", "alarm_is": "level", **KINDS[kind]}, "bob.toml")
    assert described.alarm_is == "level"
    assert from_table(described.as_table(), "").alarm_is == "level"


@pytest.mark.parametrize(
    ("kind", "states", "told"),
    [
        ("lines", ["FAULT", 3], ""),
        ("exec", ["FAULT", 3], ""),
        ("frames", [3, 4], ""),
        ("can-dbc", ["FAULT", 3], ""),
        ("frames", ["FAULT"], "alarm_is: the states of a binary record are numbers"),
        ("python", ["FAULT", 3], ""),
        ("library", [3], ""),
        ("library", ["FAULT"], "alarm_is: a device of the kind library has no state 'FAULT': its states are numbers"),
        ("host", [3], "alarm_is: a device of the kind host has no state 3: its alarm is true or false"),
        ("lines", [], 'alarm_is must be "event", "level", or an array'),
    ],
)
def test_state_is_one_that_the_kind_of_device_can_report(kind: str, states: list[Any], told: str) -> None:
    table = {"name": "bob", "alarm_is": states, **KINDS[kind]}
    if not told:
        assert from_table(table, "bob.toml").states == tuple(states)
        return
    with pytest.raises(ConfigurationError) as raised:
        from_table(table, "bob.toml")
    assert str(raised.value).startswith(f"bob.toml: {told}")
